//! What the direction does to a colour: a NeRF's field learns the glossy surface of the embedded scene, once with and once
//! without the viewing direction. Then points of the surface are held still and looked at from everywhere above.
//!
//! ```text
//! cargo run --release --example view_dependence [folder for the image]
//! ```
//!
//! Takes about half a minute on two cores. Each disc is the hemisphere of directions from which one point is seen, from
//! straight above in the middle to flat at the rim: ray-traced at the top, then as learnt, then as learnt without
//! direction. The bright spot is the reflected sun; a colour without direction can only be the average. From grey
//! directions the point is hidden. Where the surface lies is taken from the scene here: the examples that train a whole
//! NeRF have to find it.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::{BuildContext, Camera, Classic, ClassicConfig, Field, Image, Ray, Result, Space, ViewInputs};
use raygrad::{Adam, AdamConfig, Bound, Optimizer, Params, Schedule, Segments, Tape, Tensor, Var};
use raygrad_scenes::{Scene, train_cameras};
use std::path::PathBuf;

const STEPS: usize = 6000;
const BATCH: usize = 1024;
/// Width of a disc in the image, in pixels.
const SIZE: usize = 96;
const HIDDEN: [f32; 3] = [0.8; 3];

/// A point of a surface, the direction in which light leaves it, and the light's colour.
struct Sight {
    point: DVec3,
    viewer: DVec3,
    color: [f32; 3],
}

/// What many cameras see of the scene.
fn sights(scene: &Scene) -> Vec<Sight> {
    let mut sights = vec![];
    for camera in train_cameras(600, 64) {
        let view = scene.render(&camera, 5);
        for (i, color) in view.color.data.chunks_exact(4).enumerate().filter(|(_, color)| color[3] == 1.0) {
            let ray = camera.pixel_ray(i % camera.width, i / camera.width);
            let point = ray.at(f64::from(view.depth.data[i]));
            sights.push(Sight { point, viewer: -ray.direction, color: [color[0], color[1], color[2]] });
        }
    }
    sights
}

/// A field's colours of points, each seen by a viewer of its own; the same viewer for all if the direction is withheld.
fn look<'t>(
    field: &Classic,
    params: &Bound<'t, f32>,
    tape: &'t Tape<f32>,
    at: &[[DVec3; 2]],
    seen: bool,
) -> Var<'t, f32> {
    let rows = |f: &dyn Fn(&[DVec3; 2]) -> DVec3| {
        let values = at.iter().flat_map(|pair| f(pair).as_vec3().to_array()).collect();
        tape.constant(Tensor::from_vec(&[at.len(), 3], values))
    };
    let density = field.density(params, &rows(&|pair| pair[0]));
    let directions = &rows(&|pair| if seen { -pair[1] } else { DVec3::NEG_Z });
    // A ray for each point, with the point as its only sample.
    let segments = &Segments::uniform(at.len(), 1);
    field.color(params, &density.features, &ViewInputs { directions, segments, frames: None })
}

/// Teaches a field the colours of the surface.
fn learn(scene: &Scene, sights: &[Sight], seen: bool) -> Result<(Classic, Params<f32>)> {
    let mut rng = StdRng::seed_from_u64(0);
    let mut params = Params::new();
    let config = ClassicConfig { depth: 4, width: 96, skip_layers: vec![], view_width: 64, ..ClassicConfig::paper() };
    let field = {
        let space = Space::within(scene.bounds());
        Classic::new(&config, BuildContext { space, frames: 0, params: &mut params, name: "field", rng: &mut rng })?
    };
    let mut adam = Adam::new(AdamConfig::default());
    let schedule = Schedule::Exponential { from: 3e-3, to: 1e-4, warmup: 0.02 };
    for step in 0..STEPS {
        let batch: Vec<_> = (0..BATCH).map(|_| &sights[rng.random_range(0..sights.len())]).collect();
        let at: Vec<_> = batch.iter().map(|sight| [sight.point, sight.viewer]).collect();
        let colors = batch.iter().flat_map(|sight| sight.color).collect();
        let tape = Tape::new();
        let bound = params.bind(&tape);
        let error = look(&field, &bound, &tape, &at, seen) - tape.constant(Tensor::from_vec(&[BATCH, 3], colors));
        let loss = error.square().mean();
        let grads = bound.backward(&loss);
        adam.update(&mut params, &grads, schedule.lr(step as f64 / STEPS as f64)).check().expect("finite gradients");
        if step % (STEPS / 5) == 0 {
            let name = if seen { "with direction" } else { "without direction" };
            println!("{name}: step {step}, mean squared error {:.5}", loss.item());
        }
    }
    Ok((field, params))
}

/// The direction to the viewer for each pixel of a disc: the pole in the middle, 75 degrees from it at the rim, and None
/// outside.
fn viewers() -> impl Iterator<Item = Option<DVec3>> {
    (0..SIZE * SIZE).map(|i| {
        let [across, down] = [i % SIZE, i / SIZE].map(|i| (2 * i + 1) as f64 / SIZE as f64 - 1.0);
        let radius = across.hypot(down);
        let (sine, cosine) = (radius * 75.0_f64.to_radians()).sin_cos();
        (radius < 1.0).then(|| DVec3::new(across / radius * sine, -down / radius * sine, cosine))
    })
}

/// The ray-traced colour of a point; None where something stands before it.
fn traced(scene: &Scene, point: DVec3, viewer: DVec3) -> Option<[f32; 3]> {
    let eye = point + 4.0 * viewer;
    let hit = scene.trace(&Ray { origin: eye, direction: -viewer })?;
    let camera = Camera::from_angle(1, 1, 1e-5, Camera::look_at(eye, point, DVec3::Y));
    let color = scene.render(&camera, 9).color.data;
    ((hit.distance - 4.0).abs() < 1e-6).then(|| [color[0], color[1], color[2]])
}

fn main() -> Result<()> {
    let folder = PathBuf::from(std::env::args().nth(1).unwrap_or("target/examples-out".into()));
    std::fs::create_dir_all(&folder).expect("the folder for the image can be made");
    let scene = Scene::bulldozer();
    let sights = sights(&scene);
    println!("{} sights of the surface", sights.len());
    // Tapes share nothing, so both fields learn at the same time.
    let (with, without) = rayon::join(|| learn(&scene, &sights, true), || learn(&scene, &sights, false));
    let (with, without) = (with?, without?);

    let mut columns = vec![];
    for [x, y] in [[-0.17, 0.056], [0.95, 0.2], [0.97, 0.4], [1.05, -0.6], [0.3, -0.45]] {
        let down = Ray { origin: DVec3::new(x, y, 4.0), direction: DVec3::NEG_Z };
        let Some(hit) = scene.trace(&down) else { continue };
        let point = down.at(hit.distance);
        let truth: Vec<_> = viewers().map(|viewer| Some(traced(&scene, point, viewer?).unwrap_or(HIDDEN))).collect();
        let at: Vec<_> = viewers().map(|viewer| [point, viewer.unwrap_or(DVec3::Z)]).collect();
        let mut column = Image::new(SIZE, 3 * SIZE, 3);
        let tape = Tape::new();
        let learnt = [(&with, true), (&without, false)]
            .map(|((field, params), seen)| look(field, &params.bind_constant(&tape), &tape, &at, seen).into_value());
        for (i, truth) in truth.iter().enumerate() {
            let color = |row: usize| match truth {
                None => [1.0; 3],
                Some(HIDDEN) => HIDDEN,
                Some(truth) if row == 0 => *truth,
                Some(_) => std::array::from_fn(|c| learnt[row - 1].as_slice()[3 * i + c]),
            };
            for row in 0..3 {
                column.pixel_mut(i % SIZE, i / SIZE + row * SIZE).copy_from_slice(&color(row));
            }
        }
        columns.push(column);
    }
    let path = folder.join("view_dependence.png");
    Image::hconcat(&columns.iter().collect::<Vec<_>>()).save_png(&path)?;
    println!("{}: the truth, with direction, without direction", path.display());
    Ok(())
}
