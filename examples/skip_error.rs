//! What skipping costs and saves in rendering: a trained run's test views with and without it.
//!
//! ```text
//! raygrad train --out run    # or train path/to/scene
//! cargo run --release --example skip_error -- run [size in pixels]
//! ```
//!
//! `box only` is the same model with every sample in the box evaluated: cells that training left empty are empty in it
//! too, so its image is that of `off`, which leaves those cells out and nothing else. `bare` asks the field in those
//! cells as well, where no image ever judged it.

use raygrad::nerf::dataset::{Capture, LoadOptions, Split, evenly_spaced};
use raygrad::nerf::imaging::metrics::psnr;
use raygrad::nerf::space::occupancy::{OccupancyGrid, Skip};
use raygrad::nerf::{Camera, Config, Evaluations, Image, Model, SceneBox};
use raygrad_scenes::embedded;
use serde_json::Value;
use std::error::Error;
use std::path::Path;
use std::time::Instant;

/// Views that are compared.
const VIEWS: usize = 4;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let run = arguments.next().ok_or("name a run: skip_error RUN [SIZE]")?;
    let size: usize = arguments.next().map_or(Ok(800), |size| size.parse())?;
    let about: Value = serde_json::from_str(&std::fs::read_to_string(Path::new(&run).join("config.json"))?)?;
    let config: Config = serde_json::from_value(about["config"].clone())?;
    let extent: SceneBox = serde_json::from_value(about["scene_box"].clone())?;
    let mut model = Model::load(Path::new(&run).join("model.safetensors"), config, extent)?;
    let views = match (about["scene"].as_str(), about["scene"]["folder"].as_str()) {
        (Some("embedded"), _) => embedded(Split::Test, 200),
        (_, Some(folder)) => {
            let capture = Capture::read(folder)?;
            let options = LoadOptions { views: VIEWS, ..LoadOptions::default() };
            capture.load(Split::Test, &capture.analyze_scene(None)?, &options)?
        }
        _ => return Err("the run's scene is neither `embedded` nor a folder".into()),
    };
    let frames = evenly_spaced(views.frames, VIEWS);
    let cameras: Vec<Camera> = frames.iter().map(|frame| frame.camera.resized(size, size)).collect();

    model.set_skip(Skip::Off);
    let (unskipped, counts, seconds) = render(&model, &cameras);
    let pixels = (size * size * cameras.len()) as f64;
    let per_pixel = |count: u64| count as f64 / pixels;
    println!("{} views of {size}x{size}; evaluations a pixel; times are of one view", cameras.len());
    println!("mode       density   color  fewer than box only   PSNR dB  largest error  seconds");
    println!("box only  {:8.1}{:8.1}", per_pixel(counts.unskipped), per_pixel(counts.unskipped));
    let row = |name: &str, images: &[Image], counts: Evaluations, seconds: f64| {
        let pairs = || images.iter().zip(&unskipped);
        let mean = pairs().map(|(a, b)| psnr(a, b)).sum::<f64>() / images.len() as f64;
        let errors = pairs().flat_map(|(a, b)| a.data.iter().zip(&b.data).map(|(a, b)| (a - b).abs()));
        let largest = errors.fold(0.0, raygrad::Real::maximum);
        let fewer = 2.0 * counts.unskipped as f64 / (counts.density + counts.color) as f64;
        let [density, color] = [counts.density, counts.color].map(per_pixel);
        println!("{name:9} {density:8.1}{color:8.1}{fewer:21.1}{mean:10.1}{largest:15.1e}{seconds:9.2}");
    };
    row("off", &unskipped, counts, seconds);
    for skip in [Skip::NearLossless, Skip::Fast] {
        model.set_skip(skip);
        let (images, counts, seconds) = render(&model, &cameras);
        row(&skip.to_string(), &images, counts, seconds);
    }
    if let Some(marching) = model.marching_mut() {
        marching.grid = OccupancyGrid::new(extent.bounds, &marching.config.occupancy)?;
    }
    model.set_skip(Skip::Off);
    let (images, counts, seconds) = render(&model, &cameras);
    row("bare", &images, counts, seconds);
    Ok(())
}

/// The views in white, how often the field was asked in all, and the mean time of a view.
fn render(model: &Model<f32>, cameras: &[Camera]) -> (Vec<Image>, Evaluations, f64) {
    let start = Instant::now();
    let images: Vec<_> = cameras.iter().map(|camera| model.render(camera, [1.0; 3])).collect();
    let seconds = start.elapsed().as_secs_f64() / cameras.len() as f64;
    let counts = images.iter().fold(Evaluations::default(), |sum, image| sum + image.evaluations);
    (images.into_iter().map(|image| image.color).collect(), counts, seconds)
}
