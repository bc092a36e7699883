//! Why images are read with convolutions: digits that stand anywhere in a small noisy picture, once told apart by a linear
//! function of the pixels and once by a network of two convolutions. Both see the same pictures; only the convolutions
//! recognise a stroke wherever it stands.
//!
//! ```text
//! cargo run --release --example 06_cnn_digits
//! ```
//!
//! Takes some seconds. The pictures are drawn from a 5x7 bitmap font with random shifts, contrast and noise, so nothing is
//! downloaded, and the test set is drawn with another seed than training.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use raygrad::autograd::{
    Activation, Adam, AdamConfig, Bound, Conv2dConfig, INFER, Indices, Init, Linear, ParamId, Params, Pool2dConfig,
    Tape, Tensor, Var,
};

const STEPS: usize = 400;
const BATCH: usize = 64;
const TESTS: usize = 2000;
/// Side of a picture.
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

/// Pictures `[count, 1, SIDE, SIDE]` of random digits, and which digits they are.
fn pictures(count: usize, rng: &mut StdRng) -> (Tensor<f32>, Indices) {
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
    (Tensor::from_vec(&[count, 1, SIDE, SIDE], pixels), Indices::new(&[count, 1], labels))
}

/// Something that gives a score to each digit.
trait Model {
    /// Scores `[count, 10]` of pictures `[count, 1, SIDE, SIDE]`.
    fn scores<'t>(&self, params: &Bound<'t, f32>, x: &Var<'t, f32>) -> Var<'t, f32>;
}

/// Each score is a weighted sum of the pixels.
struct Pixels(Linear);

impl Model for Pixels {
    fn scores<'t>(&self, params: &Bound<'t, f32>, x: &Var<'t, f32>) -> Var<'t, f32> {
        self.0.forward(params, &x.reshape(&[x.shape()[0], INFER]))
    }
}

/// Weight and bias of 3x3 convolutions, and a linear function of what they find.
struct Strokes {
    convolutions: Vec<[ParamId; 2]>,
    head: Linear,
}

impl Strokes {
    fn new(channels: &[usize], params: &mut Params<f32>, rng: &mut StdRng) -> Self {
        let mut convolutions = vec![];
        for (i, pair) in channels.windows(2).enumerate() {
            // He's initialisation for the nine pixels of each channel that a kernel sees.
            let weight: Tensor<f32> = Init::He.weight(9 * pair[0], pair[1], rng);
            let weight = weight.reshape(&[pair[1], pair[0], 3, 3]);
            let bias = Tensor::zeros(&[pair[1]]);
            convolutions
                .push([params.add(format!("conv{i}.weight"), weight), params.add(format!("conv{i}.bias"), bias)]);
        }
        let side = SIDE >> convolutions.len();
        let sizes = [channels[channels.len() - 1] * side * side, FONT.len()];
        Strokes { convolutions, head: Linear::new(params, "head", sizes, Activation::Identity, Init::Glorot, rng) }
    }
}

impl Model for Strokes {
    fn scores<'t>(&self, params: &Bound<'t, f32>, x: &Var<'t, f32>) -> Var<'t, f32> {
        let same = Conv2dConfig { padding: [1, 1], ..Conv2dConfig::default() };
        let mut h = x.clone();
        for &[weight, bias] in &self.convolutions {
            h = h.conv2d_bias(&params[weight], &params[bias], &same).relu().max_pool2d(&Pool2dConfig::new([2, 2]));
        }
        self.head.forward(params, &h.reshape(&[x.shape()[0], INFER]))
    }
}

/// The mean of `-ln(probability of the right digit)`, the probabilities being proportional to `e^score`.
fn cross_entropy<'t>(scores: &Var<'t, f32>, labels: &Indices) -> Var<'t, f32> {
    // Scores far below the best do not count, and those above 88 would overflow: count from the best.
    let best = scores.sort(1, true).0.slice(1, 0, 1).detach();
    let scores = scores - best;
    (scores.exp().sum_axes(&[1]).ln() - scores.gather(1, labels)).mean()
}

/// The share of pictures whose highest score is that of the right digit.
fn accuracy(model: &dyn Model, params: &Params<f32>, (x, labels): &(Tensor<f32>, Indices)) -> f64 {
    let tape = Tape::new();
    let scores = model.scores(&params.bind_constant(&tape), &tape.constant(x.clone()));
    let best = scores.argsort(1, true);
    let firsts = best.as_slice().chunks_exact(FONT.len()).map(|order| order[0]);
    firsts.zip(labels.as_slice()).filter(|(first, label)| first == *label).count() as f64 / TESTS as f64
}

/// Trains a model and returns its accuracy on the test set.
fn train(name: &str, params: &mut Params<f32>, model: &dyn Model) -> f64 {
    let test = pictures(TESTS, &mut StdRng::seed_from_u64(1));
    let mut rng = StdRng::seed_from_u64(2);
    let mut adam = Adam::new(AdamConfig::default());
    println!("{name}, {} parameters:", params.elements());
    for step in 0..=STEPS {
        let (x, labels) = pictures(BATCH, &mut rng);
        let tape = Tape::new();
        let bound = params.bind(&tape);
        let loss = cross_entropy(&model.scores(&bound, &tape.constant(x)), &labels);
        if step % (STEPS / 4) == 0 {
            let right = 100.0 * accuracy(model, params, &test);
            println!("  step {step:3}: loss {:.3}, {right:.1} % of {TESTS} test digits right", loss.item());
        }
        adam.step(params.values_mut(), &loss.grad_once(&bound.vars()), 5e-3);
    }
    accuracy(model, params, &test)
}

fn main() {
    let (x, labels) = pictures(3, &mut StdRng::seed_from_u64(0));
    println!("Three pictures, of {:?}:", labels.as_slice());
    for row in 0..SIDE {
        let line = |picture: usize| -> String {
            let pixels = &x.as_slice()[(picture * SIDE + row) * SIDE..][..SIDE];
            pixels.iter().flat_map(|&x| [b" .:+#"[(x * 5.0).clamp(0.0, 4.0) as usize] as char; 2]).collect()
        };
        println!("  {}  |  {}  |  {}", line(0), line(1), line(2));
    }
    let mut rng = StdRng::seed_from_u64(3);
    let mut params = Params::new();
    let sizes = [SIDE * SIDE, FONT.len()];
    let pixels = Pixels(Linear::new(&mut params, "pixels", sizes, Activation::Identity, Init::Glorot, &mut rng));
    let linear = train("A linear function of the pixels", &mut params, &pixels);
    let mut params = Params::new();
    let strokes = Strokes::new(&[1, 8, 16], &mut params, &mut rng);
    let convolutional = train("Two convolutions", &mut params, &strokes);
    println!("Right in the end: {:.1} % and {:.1} %", 100.0 * linear, 100.0 * convolutional);
}
