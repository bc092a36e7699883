//! How near the depths and normals of views come to the true ones: a run on the built-in scene, whose surfaces are
//! known exactly.
//!
//! ```text
//! raygrad train --out run
//! cargo run --release --example view_truth -- run
//! ```
//!
//! Normals are minus the gradient of the density. A hash grid's density is rough at the scale of its cells, and so are
//! its normals: each for itself is far off, and the mean of a small patch is not.

use raygrad::nerf::glam::DVec3;
use raygrad::nerf::{Config, Image, Model, SceneBox};
use raygrad_scenes::{Scene, test_cameras};
use serde_json::Value;
use std::error::Error;
use std::path::Path;

/// Views that are compared.
const VIEWS: usize = 4;
/// Their width and height in pixels.
const SIZE: usize = 200;
/// Half the side of a patch in pixels.
const REACH: usize = 2;

fn main() -> Result<(), Box<dyn Error>> {
    let run = std::env::args().nth(1).ok_or("name a run on the built-in scene: view_truth RUN")?;
    let about: Value = serde_json::from_str(&std::fs::read_to_string(Path::new(&run).join("config.json"))?)?;
    let config: Config = serde_json::from_value(about["config"].clone())?;
    let extent: SceneBox = serde_json::from_value(about["scene_box"].clone())?;
    if about["scene"] != "embedded" {
        return Err("the run is not of the built-in scene, so its truth is not known".into());
    }
    let model = Model::load(Path::new(&run).join("model.safetensors"), config, extent)?;
    let scene = Scene::bulldozer();

    let (mut depths, mut angles, mut patches) = (vec![], vec![], vec![]);
    for camera in test_cameras(VIEWS, SIZE) {
        let (truth, seen, normals) =
            (scene.render(&camera, 1), model.render(&camera, [1.0; 3]), model.normals(&camera));
        for (x, y) in (0..SIZE).flat_map(|y| (0..SIZE).map(move |x| (x, y))) {
            if truth.depth.pixel(x, y)[0] == 0.0 || seen.opacity.pixel(x, y)[0] < 0.5 {
                continue;
            }
            depths.push(f64::from((truth.depth.pixel(x, y)[0] - seen.depth.pixel(x, y)[0]).abs()));
            let normal = vector(&truth.normal, x, y);
            angles.push(angle(normal, vector(&normals, x, y)));
            // Within a patch of one flat face.
            let inside = |c: usize| (c.saturating_sub(REACH)..=c + REACH).filter(|c| *c < SIZE);
            let patch: Vec<_> = inside(y).flat_map(|y| inside(x).map(move |x| (x, y))).collect();
            if patch.iter().all(|&(x, y)| vector(&truth.normal, x, y).dot(normal) > 0.999) {
                patches.push(angle(normal, patch.iter().map(|&(x, y)| vector(&normals, x, y)).sum()));
            }
        }
    }
    if depths.is_empty() {
        return Err("no pixel shows more of the model than of the background: train it longer".into());
    }
    println!("{} pixels of {VIEWS} views of {SIZE}x{SIZE}", depths.len());
    println!("                              median      mean");
    row("depth off by, scene units", &mut depths);
    row("normal off by, degrees", &mut angles);
    row("mean of a flat patch's", &mut patches);
    Ok(())
}

fn row(name: &str, values: &mut [f64]) {
    values.sort_by(f64::total_cmp);
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let median = values.get(values.len() / 2).copied().unwrap_or(f64::NAN);
    println!("{name:26}{median:10.4}{mean:10.4}");
}

fn vector(image: &Image, x: usize, y: usize) -> DVec3 {
    let pixel = image.pixel(x, y);
    DVec3::new(pixel[0].into(), pixel[1].into(), pixel[2].into())
}

/// Between a unit vector and one of any length, in degrees.
fn angle(unit: DVec3, other: DVec3) -> f64 {
    unit.dot(other.normalize_or_zero()).clamp(-1.0, 1.0).acos().to_degrees()
}
