//! Why images are read with convolutions: digits that stand anywhere in a small noisy image, once told apart by a linear
//! function of the pixels and once by a network of two convolutions. Both see the same images; only the convolutions
//! recognise a stroke wherever it stands.
//!
//! ```text
//! cargo run --release --example 06_cnn_digits
//! ```
//!
//! Takes some seconds. The images are drawn from a 5x7 bitmap font with random shifts, contrast and noise, so nothing is
//! downloaded, and the test set is drawn with another seed than training.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use raygrad::{
    Activation, Adam, AdamConfig, Conv2d, Conv2dConfig, INFER, Init, Linear, Mode, Optimizer, Params, Pool2dConfig,
    Sequential, Tape, Tensor,
};

const STEPS: u64 = 400;
const BATCH: usize = 64;
const TESTS: usize = 2000;
/// Side of an image.
const SIDE: usize = 12;
/// Rows and columns of a glyph.
const GLYPH: [usize; 2] = [7, 5];

/// The digits, a row in the low five bits of each byte.
const FONT: [[u8; 7]; 10] = [
    [0b01110, 0b10001, 0b10011, 0b10101, 0b11001, 0b10001, 0b01110],
    [0b00100, 0b01100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110],
    [0b01110, 0b10001, 0b00001, 0b00110, 0b01000, 0b10000, 0b11111],
    [0b11111, 0b00010, 0b00100, 0b00010, 0b00001, 0b10001, 0b01110],
    [0b00010, 0b00110, 0b01010, 0b10010, 0b11111, 0b00010, 0b00010],
    [0b11111, 0b10000, 0b11110, 0b00001, 0b00001, 0b10001, 0b01110],
    [0b00110, 0b01000, 0b10000, 0b11110, 0b10001, 0b10001, 0b01110],
    [0b11111, 0b00001, 0b00010, 0b00100, 0b01000, 0b01000, 0b01000],
    [0b01110, 0b10001, 0b10001, 0b01110, 0b10001, 0b10001, 0b01110],
    [0b01110, 0b10001, 0b10001, 0b01111, 0b00001, 0b00010, 0b01100],
];

/// Images `[count, 1, SIDE, SIDE]` of random digits, and which digits they are.
fn images(count: usize, rng: &mut StdRng) -> (Tensor<f32>, Vec<u32>) {
    let mut pixels = Vec::with_capacity(count * SIDE * SIDE);
    let mut labels = Vec::with_capacity(count);
    for _ in 0..count {
        let label = rng.random_range(0..FONT.len());
        let corner = GLYPH.map(|extent| rng.random_range(0..=SIDE - extent));
        let contrast = rng.random_range(0.5..1.0);
        for (row, column) in (0..SIDE).flat_map(|row| (0..SIDE).map(move |column| (row, column))) {
            let (i, j) = (row.wrapping_sub(corner[0]), column.wrapping_sub(corner[1]));
            let ink = i < GLYPH[0] && j < GLYPH[1] && FONT[label][i] >> (GLYPH[1] - 1 - j) & 1 == 1;
            pixels.push(rng.random_range(-0.3..0.3) + if ink { contrast } else { 0.0 });
        }
        labels.push(label as u32);
    }
    (Tensor::from_vec(&[count, 1, SIDE, SIDE], pixels), labels)
}

/// Each score is a weighted sum of the pixels.
fn pixels(params: &mut Params<f32>, rng: &mut StdRng) -> Sequential<f32> {
    let sizes = [SIDE * SIDE, FONT.len()];
    let head = Linear::new(params, "pixels", sizes, Activation::Identity, Init::Glorot, rng);
    Sequential::new().map(|x| x.reshape(&[x.shape()[0], INFER])).then(head)
}

/// 3x3 convolutions that halve the image, and a linear function of what they find.
fn strokes(channels: &[usize], params: &mut Params<f32>, rng: &mut StdRng) -> Sequential<f32> {
    let same = Conv2dConfig { padding: [1, 1], ..Conv2dConfig::default() };
    let mut model = Sequential::new();
    for (i, pair) in channels.windows(2).enumerate() {
        let sizes = [pair[0], pair[1]];
        let layer = Conv2d::new(params, &format!("conv{i}"), sizes, [3, 3], same, Activation::Relu, Init::He, rng);
        model = model.then(layer).map(|x| x.max_pool2d(&Pool2dConfig::new([2, 2])));
    }
    let side = SIDE >> (channels.len() - 1);
    let sizes = [channels[channels.len() - 1] * side * side, FONT.len()];
    let head = Linear::new(params, "head", sizes, Activation::Identity, Init::Glorot, rng);
    model.map(|x| x.reshape(&[x.shape()[0], INFER])).then(head)
}

/// The share of images whose highest score is that of the right digit.
fn accuracy(model: &Sequential<f32>, params: &Params<f32>, (x, labels): &(Tensor<f32>, Vec<u32>)) -> f64 {
    let tape = Tape::new();
    let scores = model.forward(&params.bind_constant(&tape), &tape.constant(x.clone()), Mode::Evaluate);
    let best = scores.argmax(-1);
    let right = best.as_slice().iter().zip(labels).filter(|(best, label)| best == label).count();
    right as f64 / labels.len() as f64
}

/// Trains a model and returns its accuracy on the test set.
fn train(name: &str, params: &mut Params<f32>, model: &Sequential<f32>) -> f64 {
    let test = images(TESTS, &mut StdRng::seed_from_u64(1));
    let mut rng = StdRng::seed_from_u64(2);
    let mut adam = Adam::new(AdamConfig::default());
    println!("{name}, {} parameters:", params.elements());
    for step in 0..=STEPS {
        let (x, labels) = images(BATCH, &mut rng);
        let tape = Tape::new();
        let bound = params.bind(&tape);
        let scores = model.forward(&bound, &tape.constant(x), Mode::Train(step));
        let loss = scores.cross_entropy_loss(&labels);
        if step % (STEPS / 4) == 0 {
            let right = 100.0 * accuracy(model, params, &test);
            println!("  step {step:3}: loss {:.3}, {right:.1} % of {TESTS} test digits right", loss.item());
        }
        let grads = bound.backward(&loss);
        adam.update(params, &grads, 5e-3).check().expect("finite gradients");
    }
    accuracy(model, params, &test)
}

fn main() {
    let (x, labels) = images(3, &mut StdRng::seed_from_u64(0));
    println!("Three images, of {labels:?}:");
    for row in 0..SIDE {
        let line = |image: usize| -> String {
            let pixels = &x.as_slice()[(image * SIDE + row) * SIDE..][..SIDE];
            pixels.iter().flat_map(|&x| [b" .:+#"[(x * 5.0).clamp(0.0, 4.0) as usize] as char; 2]).collect()
        };
        println!("  {}  |  {}  |  {}", line(0), line(1), line(2));
    }
    let mut rng = StdRng::seed_from_u64(3);
    let mut params = Params::new();
    let model = pixels(&mut params, &mut rng);
    let linear = train("A linear function of the pixels", &mut params, &model);
    let mut params = Params::new();
    let model = strokes(&[1, 8, 16], &mut params, &mut rng);
    let convolutional = train("Two convolutions", &mut params, &model);
    println!("Right in the end: {:.1} % and {:.1} %", 100.0 * linear, 100.0 * convolutional);
}
