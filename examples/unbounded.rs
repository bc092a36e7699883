//! Compares ways to represent an unbounded scene, by their errors near, far and in the sky.
//!
//! ```text
//! cargo run --release --example unbounded [seconds=60] [pixels=200] [from=walk|window] [only=bounded|contraction|cascades|ndc]
//! ```
//!
//! The bulldozer in its landscape (exact out to a thousand units) is trained as if it ended at the box of the bulldozer and
//! the cameras; contracted, with samples that proposals place (Barron et al. 2022, "Mip-NeRF 360"); and contracted, with
//! steps that grow through cascades of an occupancy grid (Mueller et al. 2022, "Instant NGP"), which is what `raygrad
//! train` does. From a window, where all images look the same way, what they see can be the cube instead of all of space:
//! normalised device coordinates (Mildenhall et al. 2020, appendix C), with the same steps. Of the views that it has not seen, near is what lies in the box.

use raygrad::nerf::dataset::{Dataset, SceneType, Split, evenly_spaced};
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::imaging::metrics::psnr_from_mse;
use raygrad::nerf::sampling::proposal::ProposalConfig;
use raygrad::nerf::{Background, Budget, Config, Model, Preset, Result, SamplerConfig, Trainer};
use raygrad_scenes::{landscape, landscape_ahead, landscape_distances};
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Views that are compared.
const VIEWS: usize = 6;

/// PSNR of near, far, sky and all of it, in dB.
fn score(model: &Model<f32>, views: &Dataset) -> [f64; 4] {
    let mut sums = [[0.0; 2]; 4];
    let [low, high] = views.bounds;
    for frame in &views.frames {
        let camera = &frame.camera;
        let (seen, truth) = (model.render(camera, [1.0; 3]).color, frame.image.to_image());
        for (i, distance) in landscape_distances(camera).data.iter().enumerate() {
            let ray = camera.ray((i % truth.width) as f64 + 0.5, (i / truth.width) as f64 + 0.5);
            let place: DVec3 = ray.at(f64::from(*distance));
            let is_near = place.cmpge(low).all() && place.cmple(high).all();
            let part = if *distance == 0.0 { 2 } else { usize::from(!is_near) };
            let error: f64 = (0..3).map(|k| f64::from(seen.data[3 * i + k] - truth.data[3 * i + k]).powi(2)).sum();
            for part in [part, 3] {
                sums[part][0] += error;
                sums[part][1] += 3.0;
            }
        }
    }
    sums.map(|[error, count]| psnr_from_mse(error / count))
}

fn main() -> Result<()> {
    let argument =
        |name: &str| std::env::args().find_map(|text| Some(text.strip_prefix(name)?.strip_prefix('=')?.to_owned()));
    let number = |name: &str, usual: f64| argument(name).and_then(|text| text.parse().ok()).unwrap_or(usual);
    let (seconds, pixels) = (number("seconds", 60.0), number("pixels", 200.0) as usize);
    let window = argument("from").is_some_and(|from| from == "window");
    let seen = if window { landscape_ahead } else { landscape };
    let (train, mut views) = (seen(Split::Train, pixels), seen(Split::Test, pixels));
    views.frames = evenly_spaced(views.frames, VIEWS);
    let budget = Budget::Time(Duration::from_secs_f64(seconds));
    let usual = Config { background: Background::White, ..Config::preset(Preset::Instant) };
    println!("way           steps  near (dB)  far (dB)  sky (dB)  all (dB)  seconds a view");
    for (name, scene_type) in [
        ("bounded", SceneType::Bounded),
        ("contraction", SceneType::Unbounded),
        ("cascades", SceneType::Unbounded),
        ("ndc", SceneType::ForwardFacing),
    ] {
        let leave_out = scene_type == SceneType::ForwardFacing && !window;
        if leave_out || argument("only").is_some_and(|only| only != name) {
            continue;
        }
        let data = Dataset { scene_type, ..train.clone() };
        let mut config = usual.clone().for_budget(budget.samples(), data.pixels_per_side());
        if name == "contraction" {
            config.sampler = SamplerConfig::new(ProposalConfig::default());
        }
        let config = config.with_scene_type(scene_type);
        let mut trainer = Trainer::new(config, Arc::new(data))?;
        trainer.run(budget, |_| ControlFlow::Continue(()));
        let start = Instant::now();
        let [near, far, sky, all] = score(&trainer.model, &views);
        let each = start.elapsed().as_secs_f64() / VIEWS as f64;
        let steps = trainer.stats().step;
        println!("{name:11}  {steps:6}  {near:9.2}  {far:8.2}  {sky:8.2}  {all:8.2}  {each:14.2}");
    }
    Ok(())
}
