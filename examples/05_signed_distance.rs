//! A shape as the level set of a network: from points on a curve alone, a function whose value is the distance to the
//! curve, negative inside. What makes it a distance is the eikonal equation, that its gradient has length 1 everywhere
//! (Gropp et al. 2020). The gradient by position is part of the loss, so training differentiates a gradient.
//!
//! ```text
//! cargo run --release --example 05_signed_distance [folder for the image]
//! ```
//!
//! Takes less than a minute.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use raygrad::nerf::Image;
use raygrad::{
    Activation, Adam, AdamConfig, Axes, Bound, Init, Linear, Mode, Optimizer, Params, Pool, Schedule, Sequential, Tape,
    Tensor, Var,
};
use std::f32::consts::TAU;
use std::path::PathBuf;

const STEPS: u64 = 3000;
/// Points on the curve, and as many anywhere, in each step.
const BATCH: usize = 256;
/// The image shows -SIDE..SIDE, on so many pixels.
const SIDE: f32 = 1.2;
const PIXELS: usize = 400;

/// A flower: the point of the curve at an angle.
fn curve(angle: f32) -> [f32; 2] {
    let r = 0.6 + 0.2 * (5.0 * angle).cos();
    [r * angle.cos(), r * angle.sin()]
}

/// The distance that the network is to find without having been told, from many points of the border.
fn exact_distance(border: &[[f32; 2]], at: [f32; 2]) -> f32 {
    let square = |p: &[f32; 2]| (p[0] - at[0]).powi(2) + (p[1] - at[1]).powi(2);
    let nearest = border.iter().map(square).fold(f32::INFINITY, raygrad::Real::minimum).sqrt();
    let edge = curve(at[1].atan2(at[0]));
    if at[0].hypot(at[1]) < edge[0].hypot(edge[1]) { -nearest } else { nearest }
}

/// The distances `[n, 1]` of positions `[n, 2]`: those from a circle, which settles what is inside, and what the network
/// adds to them.
fn distance<'t>(network: &Sequential<f32>, params: &Bound<'t, f32>, x: &Var<'t, f32>, mode: Mode) -> Var<'t, f32> {
    let circle = (x.square().sum_over(Axes::from(1).keepdims()) + 1e-4).sqrt() - 0.6;
    circle + network.forward(params, x, mode)
}

/// Distances, and the lengths of their gradients by position, which are on the graph too.
fn distance_and_slope<'t>(
    network: &Sequential<f32>,
    params: &Bound<'t, f32>,
    x: &Var<'t, f32>,
    mode: Mode,
) -> (Var<'t, f32>, Var<'t, f32>) {
    let d = distance(network, params, x, mode);
    // Each distance depends on its own position only, so the gradient of the sum holds that of each.
    let slope = d.sum().grad_graph(&[x]).remove(0).norm_over(1);
    (d, slope)
}

/// Blue inside, orange outside, a line at each tenth, a black one at 0.
fn color(d: f32) -> [f32; 3] {
    let hue = if d < 0.0 { [0.35, 0.6, 0.85] } else { [0.95, 0.7, 0.4] };
    let line = |width: f32, d: f32| (d.abs() / width).clamp(0.0, 1.0);
    let to_next = (d * 10.0 - (d * 10.0).round()) / 10.0;
    let shade = (0.6 + 0.4 * line(0.008, to_next)) * (1.0 - 0.3 * d.abs().min(1.0)) * line(0.012, d);
    hue.map(|c: f32| c * shade)
}

fn image(distances: impl Iterator<Item = f32>) -> Image {
    Image { data: distances.flat_map(color).collect(), ..Image::new(PIXELS, PIXELS, 3) }
}

fn main() -> raygrad::nerf::Result<()> {
    let folder = PathBuf::from(std::env::args().nth(1).unwrap_or("target/examples-out".into()));
    std::fs::create_dir_all(&folder).expect("the folder for images can be made");
    let mut rng = StdRng::seed_from_u64(5);
    let mut params = Params::<f32>::new();
    let mut network = Sequential::new();
    for (i, sizes) in [[2, 64], [64, 64], [64, 64]].into_iter().enumerate() {
        let name = format!("hidden{i}");
        let layer = Linear::new(&mut params, &name, sizes, Activation::Identity, Init::Glorot, &mut rng);
        network = network.then(layer).map(|x| x.tanh());
    }
    let network = network.then(Linear::new(&mut params, "out", [64, 1], Activation::Identity, Init::Glorot, &mut rng));

    let mut adam = Adam::new(AdamConfig::default());
    let schedule = Schedule::Cosine { from: 3e-3, to: 0.0, warmup: 0.05 };
    let pool = Pool::new();
    for step in 0..STEPS {
        let on_curve = (0..BATCH).flat_map(|_| curve(rng.random_range(0.0..TAU))).collect::<Vec<_>>();
        let anywhere = (0..2 * BATCH).map(|_| rng.random_range(-SIDE..SIDE));
        let points = Tensor::from_vec(&[2 * BATCH, 2], on_curve.iter().copied().chain(anywhere).collect());
        let tape = Tape::with_pool(pool.clone());
        let bound = params.bind(&tape);
        let (d, slope) = distance_and_slope(&network, &bound, &tape.leaf(points), Mode::Train(step));
        let on_curve = d.slice_axis(0, 0..BATCH).abs().mean();
        let eikonal = (slope - 1.0).square().mean();
        if step % (STEPS / 6) == 0 {
            let (off, bend) = (on_curve.item(), eikonal.item().sqrt());
            println!("step {step:4}: the curve is missed by {off:.4}, slopes are off 1 by {bend:.3}");
        }
        // With more weight on the curve, slopes fold up inside before they are 1, and the shape gets a hole.
        let loss = on_curve + eikonal;
        let grads = bound.backward(&loss);
        adam.update(&mut params, &grads, schedule.at_step(step, STEPS)).check().expect("finite gradients");
    }

    let centre = |i: usize| ((2 * i + 1) as f32 / PIXELS as f32 - 1.0) * SIDE;
    let pixels: Vec<[f32; 2]> = (0..PIXELS * PIXELS).map(|i| [centre(i % PIXELS), -centre(i / PIXELS)]).collect();
    let (mut found, mut slope) = (vec![], vec![]);
    for rows in pixels.chunks(10 * PIXELS) {
        let tape = Tape::with_pool(pool.clone());
        let x = tape.leaf(Tensor::from_vec(&[rows.len(), 2], rows.concat()));
        let (d, length) = distance_and_slope(&network, &params.bind_constant(&tape), &x, Mode::Evaluate);
        found.extend_from_slice(d.value().as_slice());
        slope.extend_from_slice(length.value().as_slice());
    }
    let border: Vec<_> = (0..2000).map(|k| curve(k as f32 * TAU / 2000.0)).collect();
    let truth: Vec<f32> = pixels.iter().map(|&at| exact_distance(&border, at)).collect();
    let mean = |errors: &mut dyn Iterator<Item = f32>| errors.sum::<f32>() / pixels.len() as f32;
    println!(
        "Over the image, distances are off by {:.4},",
        mean(&mut found.iter().zip(&truth).map(|(f, t)| (f - t).abs()))
    );
    println!("and slopes off 1 by {:.4}, in the mean.", mean(&mut slope.iter().map(|s| (s - 1.0).abs())));
    let path = folder.join("05_signed_distance.png");
    Image::hconcat(&[&image(found.iter().copied()), &image(truth.into_iter())]).save_png(&path)?;
    println!("{}: learned, exact", path.display());
    Ok(())
}
