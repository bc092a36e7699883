//! Cameras that are wrong, corrected while the scene is trained (Lin et al. 2021, "BARF"): poses that are two degrees and two
//! per cent of the scene's size off, and a focal length that is five per cent too long.
//!
//! ```text
//! cargo run --release --example refine [seconds=60|steps=..] [pixels=200] [folder=.. downscale=1] [degrees=2 share=0.02 focal=1.05]
//!     [only=right|wrong|corrected] [every=10] [poses=1 focal_rate=1 coarse=0.4]
//! ```
//!
//! Without a folder the embedded scene is rendered. It trains with the right cameras, with the wrong ones, and with the
//! wrong ones that are corrected, a minute or a number of steps each, and prints how far cameras are from the truth and how well new views are
//! met. A scene and its cameras can turn, move and grow together without any image changing; so the true cameras are
//! first brought to those that were found by the similarity that fits best.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use raygrad::Schedule;
use raygrad::nerf::camera::rotation_matrix;
use raygrad::nerf::dataset::{Dataset, SceneTransform, Split, evenly_spaced, load};
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::imaging::metrics::psnr;
use raygrad::nerf::model::RefinedParam;
use raygrad::nerf::{Background, Budget, Camera, Config, Model, Preset, Result, Trainer};
use raygrad_scenes::embedded;
use std::collections::HashMap;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Duration;

/// Views that are compared.
const VIEWS: usize = 8;

/// A direction of length 1.
fn direction(rng: &mut StdRng) -> DVec3 {
    loop {
        let v = DVec3::from([(); 3].map(|()| rng.random_range(-1.0..1.0)));
        if v.length() < 1.0 && v.length() > 0.1 {
            return v.normalize();
        }
    }
}

/// The same images, said to be from elsewhere.
fn disturbed(data: &Dataset, degrees: f64, share: f64, factor: f64) -> Dataset {
    let mut wrong = data.clone();
    let (rng, size) = (&mut StdRng::seed_from_u64(7), (data.bounds[1] - data.bounds[0]).max_element());
    for frame in &mut wrong.frames {
        let turn = rotation_matrix(degrees.to_radians() * direction(rng));
        frame.camera.pose.matrix3 = turn * frame.camera.pose.matrix3;
        frame.camera.pose.translation += share * size * direction(rng);
        frame.camera.focal = frame.camera.focal.map(|focal| factor * focal);
    }
    wrong
}

/// How cameras as they were found are off the true ones.
struct Found {
    transform: SceneTransform,
    degrees: f64,
    share: f64,
    focal: f64,
}

fn compare(found: &[Camera], right: &Dataset) -> Option<Found> {
    let places = |cameras: &[Camera]| -> Vec<DVec3> { cameras.iter().map(|camera| camera.pose.translation).collect() };
    let truth: Vec<Camera> = right.frames.iter().map(|frame| frame.camera.clone()).collect();
    let transform = SceneTransform::between(&places(&truth), &places(found))?;
    let (size, count) = ((right.bounds[1] - right.bounds[0]).max_element(), found.len() as f64);
    let (mut degrees, mut share, mut focal) = (0.0, 0.0, 0.0);
    for (found, right) in found.iter().zip(&truth) {
        let placed = transform.camera(right);
        let turn = found.pose.matrix3.transpose() * placed.pose.matrix3;
        let cosine = 0.5 * (turn.x_axis.x + turn.y_axis.y + turn.z_axis.z - 1.0);
        degrees += cosine.clamp(-1.0, 1.0).acos().to_degrees() / count;
        share += found.pose.translation.distance(placed.pose.translation) / (transform.scale * size * count);
        focal += 100.0 * (found.focal[0] / right.focal[0] - 1.0) / count;
    }
    Some(Found { transform, degrees, share: 100.0 * share, focal })
}

/// The mean PSNR of new views, from the true cameras moved to where the scene was found.
fn score(model: &Model<f32>, views: &Dataset, found: &Found) -> f64 {
    let each = views.frames.iter().map(|frame| {
        let factor = 1.0 + 0.01 * found.focal;
        let camera = found.transform.camera(&frame.camera);
        let camera = Camera { focal: camera.focal.map(|focal| factor * focal), ..camera };
        psnr(&model.render(&camera, [1.0; 3]).color, &frame.image.over([1.0; 3]))
    });
    each.sum::<f64>() / views.frames.len() as f64
}

fn main() -> Result<()> {
    let arguments: HashMap<String, String> = std::env::args()
        .skip(1)
        .filter_map(|argument| argument.split_once('=').map(|(name, value)| (name.to_owned(), value.to_owned())))
        .collect();
    let number = |name: &str, usual: f64| arguments.get(name).and_then(|text| text.parse().ok()).unwrap_or(usual);
    let [right, mut views] = match arguments.get("folder") {
        Some(folder) => {
            let downscale = number("downscale", 1.0) as usize;
            [load(folder, Split::Train, downscale)?, load(folder, Split::Test, downscale)?]
        }
        None => [Split::Train, Split::Test].map(|split| embedded(split, number("pixels", 200.0) as usize)),
    };
    views.frames = evenly_spaced(views.frames, VIEWS);
    let wrong = disturbed(&right, number("degrees", 2.0), number("share", 0.02), number("focal", 1.05));
    let budget = match arguments.get("steps").and_then(|text| text.parse().ok()) {
        Some(steps) => Budget::Steps(steps),
        None => Budget::Time(Duration::from_secs_f64(number("seconds", 60.0))),
    };
    let plain = Config::preset(Preset::Instant).for_budget(budget.samples(), right.pixels_per_side());
    let mut plain = plain.with_scene_type(right.scene_type);
    if !right.has_alpha() {
        plain.background = Background::White;
    }
    let mut refined = plain.clone().with_refined(&[RefinedParam::Poses, RefinedParam::Focal]);
    // To try others.
    let faster = |schedule: Option<Schedule>, name: &str| {
        let factor = number(name, 1.0);
        match schedule {
            Some(Schedule::Exponential { from, to, warmup }) => {
                Some(Schedule::Exponential { from: factor * from, to: factor * to, warmup })
            }
            other => other,
        }
    };
    refined.poses = faster(refined.poses, "poses");
    refined.camera_optimizer.focal = faster(refined.camera_optimizer.focal, "focal_rate");
    refined.camera_optimizer.coarse = number("coarse", refined.camera_optimizer.coarse);
    println!("{} images, {budget:?} each", right.frames.len());
    println!("cameras             turned (deg)  moved (% of scene)  focal length (%)  PSNR (dB)");
    let runs = [("right", &plain, &right), ("wrong", &plain, &wrong), ("wrong, corrected", &refined, &wrong)];
    for (name, config, data) in runs {
        if arguments.get("only").is_some_and(|only| !name.ends_with(only.as_str())) {
            continue;
        }
        let mut trainer = Trainer::new(config.clone(), Arc::new(data.clone()))?;
        let each = number("every", 1e9);
        let mut next = each;
        let report = |name: &str, model: &Model<f32>| {
            let frames = data.frames.iter().enumerate();
            let found: Vec<Camera> = frames.map(|(i, frame)| model.learned_camera(i, &frame.camera)).collect();
            if let Some(found) = compare(&found, &right) {
                let Found { degrees, share, focal, .. } = found;
                let psnr = score(model, &views, &found);
                println!("{name:18}  {degrees:12.3}  {share:18.3}  {focal:16.3}  {psnr:9.2}");
            }
        };
        trainer.run(budget, |trainer| {
            if trainer.stats().train_seconds > next {
                next += each;
                report(&format!("after {:.0} s", trainer.stats().train_seconds), &trainer.model);
            }
            ControlFlow::Continue(())
        });
        report(name, &trainer.model);
    }
    Ok(())
}
