//! What a surface of the built-in scene is measured against: points of the true one, and the field as a grid of numbers.
//!
//! ```text
//! raygrad train --steps 2500 --out run
//! cargo run --release --example surface_truth -- run truth [cells]
//! python benches/peers/surface.py truth mesh.ply
//! ```
//!
//! Into the folder `truth` go `seen.ply`, points that cameras see, and `all.ply`, points that are seen from
//! all sides, each with the true normal; and `density.npy`, the density at the nodes of a lattice, x slowest, as images have
//! it: 0 in cells that are not occupied. `density.json` says where its nodes are. For a run of another scene there is only the
//! latter.

use glam::DVec3;
use raygrad::nerf::geometry::{ColoredMesh, Mesh, files};
use raygrad::nerf::{Camera, Config, Model, SceneBox, write_atomic};
use raygrad_scenes::{Scene, train_cameras};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::error::Error;
use std::path::Path;

/// Cameras, and pixels on a side of the image of each: two million points.
const CAMERAS: usize = 150;
const PIXELS: usize = 200;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(run), Some(out)) = (arguments.next(), arguments.next()) else {
        return Err("name a run and a folder: surface_truth RUN TRUTH [CELLS]".into());
    };
    let cells: usize = arguments.next().map_or(Ok(256), |cells| cells.parse())?;
    let (run, out) = (Path::new(&run), Path::new(&out));
    std::fs::create_dir_all(out)?;
    let about: Value = serde_json::from_str(&std::fs::read_to_string(run.join("config.json"))?)?;
    let config: Config = serde_json::from_value(about["config"].clone())?;
    let extent: SceneBox = serde_json::from_value(about["scene_box"].clone())?;
    if about["scene"] == "embedded" {
        let above = train_cameras(CAMERAS, PIXELS);
        let mut all = above.clone();
        for camera in &above {
            // The same from below.
            let eye = camera.pose.translation * DVec3::new(1.0, 1.0, -1.0);
            all.push(Camera { pose: Camera::look_at(eye, DVec3::ZERO, DVec3::Z), ..camera.clone() });
        }
        files::write(&hits(&above), out.join("seen.ply"))?;
        files::write(&hits(&all), out.join("all.ply"))?;
    }
    let model = Model::<f32>::load(run.join("model.safetensors"), config, extent)?;
    density(&model, cells, out)
}

/// Where rays through pixels meet the scene.
fn hits(cameras: &[Camera]) -> ColoredMesh {
    let scene = Scene::bulldozer();
    let of = |camera: &Camera| {
        let rays = (0..PIXELS * PIXELS).map(|pixel| camera.pixel_ray(pixel % PIXELS, pixel / PIXELS));
        let hit = |ray| scene.trace(&ray).map(|hit| (ray.at(hit.distance), hit.normal));
        rays.filter_map(hit).collect::<Vec<_>>()
    };
    let (positions, normals): (Vec<DVec3>, Vec<DVec3>) = cameras.par_iter().flat_map_iter(of).unzip();
    let colors = vec![[128; 3]; positions.len()];
    ColoredMesh { mesh: Mesh { positions, triangles: vec![] }, normals, colors }
}

/// Writes the densities at the nodes of a lattice over the box.
fn density(model: &Model<f32>, cells: usize, out: &Path) -> Result<(), Box<dyn Error>> {
    let [low, high] = model.scene_box.bounds;
    let cell = (high - low).max_element() / cells as f64;
    let nodes = ((high - low) / cell).round().to_array().map(|cells| cells as usize + 1);
    let grid = model.marching().ok_or("the model has no occupancy grid")?.view_grid();
    let mut values = vec![0.0_f32; nodes.iter().product()];
    values.par_chunks_mut(4096).enumerate().for_each(|(chunk, values)| {
        let node = |i: usize| [i / (nodes[1] * nodes[2]), i / nodes[2] % nodes[1], i % nodes[2]].map(|i| i as f64);
        let place = |row: usize| low + cell * DVec3::from(node(4096 * chunk + row));
        let rows: Vec<usize> = (0..values.len()).filter(|&row| grid.is_occupied(place(row))).collect();
        let points: Vec<[f32; 3]> = rows.iter().map(|&row| place(row).as_vec3().to_array()).collect();
        let mut found = vec![0.0; rows.len()];
        if !rows.is_empty() {
            model.densities(&points, &mut found);
        }
        rows.iter().zip(found).for_each(|(&row, value)| values[row] = value);
    });
    let shape = nodes.map(|count| count.to_string()).join(", ");
    let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({shape}), }}");
    // The header ends at a multiple of 64 bytes.
    let length = (header.len() + 11).next_multiple_of(64) - 10;
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((length as u16).to_le_bytes());
    bytes.extend(format!("{header:<width$}\n", width = length - 1).bytes());
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    write_atomic(out.join("density.npy"), &bytes)?;
    let about = json!({ "low": low.to_array(), "cell": cell });
    Ok(write_atomic(out.join("density.json"), about.to_string().as_bytes())?)
}
