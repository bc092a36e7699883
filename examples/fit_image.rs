//! Why NeRF encodes positions: a network that maps (x, y) to a colour learns one image, once from the bare coordinates
//! and once from their positional encoding. Without it the network finds only a blur.
//!
//! ```text
//! cargo run --release --example fit_image [folder for the image]
//! ```
//!
//! Takes about half a minute. It uses the tape, layers and optimizer of `raygrad` directly: nothing here is
//! special to NeRF but the encoding itself.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use raygrad::nerf::imaging::metrics;
use raygrad::nerf::{Image, PositionalEncoding};
use raygrad::{
    Activation, Adam, AdamConfig, Bound, Init, Linear, Mlp, Optimizer, Params, Schedule, Tape, Tensor, Tiles, Var,
};
use raygrad_scenes::{Scene, train_cameras};
use std::path::PathBuf;

const STEPS: usize = 3000;
const BATCH: usize = 4096;
/// Pixels that are worked out together, on one core.
const TILE: usize = 512;
const WIDTH: usize = 128;

/// An image as a function of position: encoding, three hidden layers, a colour.
struct Network {
    encoding: PositionalEncoding,
    trunk: Mlp,
    head: Linear,
}

impl Network {
    fn new(levels: usize, params: &mut Params<f32>, rng: &mut StdRng) -> Self {
        let encoding = PositionalEncoding { levels, input: true };
        let trunk = Mlp::new(params, "trunk", [encoding.width(2), WIDTH, 3], &[], rng);
        let head = Linear::new(params, "color", [WIDTH, 3], Activation::Identity, Init::Glorot, rng);
        Network { encoding, trunk, head }
    }

    /// Colours `[n, 3]` at positions `[n, 2]` in -1..1.
    fn color<'t>(&self, params: &Bound<'t, f32>, positions: &Var<'t, f32>) -> Var<'t, f32> {
        let encoded = positions.tape().apply(self.encoding, &[positions]);
        self.head.forward(params, &self.trunk.forward(params, &encoded)).sigmoid()
    }
}

/// The positions of the pixels with these numbers.
fn positions(image: &Image, pixels: &[usize]) -> Tensor<f32> {
    let centre = |i: usize, extent: usize| (2 * i + 1) as f32 / extent as f32 - 1.0;
    let at = |&i: &usize| [centre(i % image.width, image.width), centre(i / image.width, image.height)];
    Tensor::from_vec(&[pixels.len(), 2], pixels.iter().flat_map(at).collect())
}

/// What a network with `levels` frequencies makes of an image.
fn fit(truth: &Image, levels: usize) -> Image {
    let mut rng = StdRng::seed_from_u64(0);
    let mut params = Params::new();
    let network = Network::new(levels, &mut params, &mut rng);
    let mut adam = Adam::new(AdamConfig::default());
    let schedule = Schedule::Exponential { from: 5e-3, to: 5e-4, warmup: 0.02 };
    // A step in tiles, which keep all cores busy and their caches warm.
    let tiles = Tiles::<f32>::new();
    for step in 0..STEPS {
        let pixels: Vec<_> = (0..BATCH).map(|_| rng.random_range(0..truth.width * truth.height)).collect();
        let sums = tiles.differentiate(&params, BATCH / TILE, |tile, params, _| {
            let pixels = &pixels[tile * TILE..(tile + 1) * TILE];
            let colors = pixels.iter().flat_map(|&i| truth.pixel(i % truth.width, i / truth.width)).copied().collect();
            let found = network.color(params, &params.tape().constant(positions(truth, pixels)));
            let loss = (found - Tensor::from_vec(&[TILE, 3], colors)).square().sum() / (3 * BATCH) as f32;
            let value = f64::from(loss.item());
            (loss, value)
        });
        adam.update(&mut params, &sums.grads, schedule.lr(step as f64 / STEPS as f64))
            .check()
            .expect("finite gradients");
        if step % (STEPS / 4) == 0 {
            println!("  step {step:4}: {:.2} dB on its pixels", metrics::psnr_from_mse(sums.results.iter().sum()));
        }
    }
    let tape = Tape::new();
    let all: Vec<_> = (0..truth.width * truth.height).collect();
    let image = network.color(&params.bind_constant(&tape), &tape.constant(positions(truth, &all)));
    Image { data: image.value().as_slice().to_vec(), ..*truth }
}

fn main() -> raygrad::nerf::Result<()> {
    let folder = PathBuf::from(std::env::args().nth(1).unwrap_or("target/examples-out".into()));
    std::fs::create_dir_all(&folder).expect("the folder for images can be made");
    let truth = Scene::bulldozer().render(&train_cameras(60, 200)[20], 9).color.over([1.0; 3]);
    let images = [0, 7].map(|levels| {
        println!("{levels} frequencies:");
        let image = fit(&truth, levels);
        println!("  the whole image: {:.2} dB", metrics::psnr(&image, &truth));
        image
    });
    let path = folder.join("fit_image.png");
    Image::hconcat(&[&images[0], &images[1], &truth]).save_png(&path)?;
    println!("{}: bare coordinates, encoded coordinates, truth", path.display());
    Ok(())
}
