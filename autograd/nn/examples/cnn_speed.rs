//! The training step of a small convolutional network: 64 images of 28x28, 1-16-32 channels, cross-entropy, Adam. The
//! same network as `train CNN` of `benches/peers/ops.py`.
//!
//! ```text
//! cargo run --release -p raygrad-nn --example cnn_speed [steps]
//! ```
//!
//! Once with one tape, where only convolutions and poolings use all threads, and once with a tape for every eight images.

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::{Activation, Axes, Conv2dConfig, Gradient, INFER, Indices, Pool2dConfig, Tape, Tensor, Var};
use raygrad_nn::{Adam, AdamConfig, Bound, Init, Linear, Optimizer, ParamId, Params};
use rayon::prelude::*;
use std::time::Instant;

const IMAGES: usize = 64;
const TILE: usize = 8;
const SIDE: usize = 28;

struct Network {
    convolutions: [[ParamId; 2]; 2],
    head: Linear,
}

impl Network {
    fn new(params: &mut Params<f32>) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(0);
        let convolutions = [[1, 16], [16, 32]].map(|[c, o]| {
            let weight: Tensor<f32> = Init::He.weight(9 * c, o, &mut rng);
            let weight = params.add(format!("{c}-{o}.weight"), weight.reshape(&[o, c, 3, 3]));
            [weight, params.add(format!("{c}-{o}.bias"), Tensor::zeros(&[o]))]
        });
        let head = Linear::new(params, "head", [32 * 49, 10], Activation::Identity, Init::Glorot, &mut rng);
        Network { convolutions, head }
    }

    /// The sum of the cross-entropies, over the number of images in a batch.
    fn loss<'t>(&self, params: &Bound<'t, f32>, x: &Var<'t, f32>, labels: &Indices) -> Var<'t, f32> {
        let same = Conv2dConfig { padding: [1, 1], ..Conv2dConfig::default() };
        let mut h = x.clone();
        for [weight, bias] in self.convolutions {
            h = h.conv2d_bias(&params[weight], &params[bias], &same).relu().max_pool2d(&Pool2dConfig::new([2, 2]));
        }
        let scores = self.head.forward(params, &h.reshape(&[x.shape()[0], INFER]));
        (scores.exp().sum_over(Axes::from(1).keepdims()).ln() - scores.gather(1, labels)).sum() * (1.0 / IMAGES as f64)
    }
}

/// Loss and gradients of some of the images.
fn tile(tape: &Tape<f32>, net: &Network, params: &Params<f32>, x: &[f32], labels: &[u32]) -> (f32, Vec<Gradient<f32>>) {
    let bound = params.bind(tape);
    let x = tape.constant(tape.pool().copy_of(&[labels.len(), 1, SIDE, SIDE], x));
    let loss = net.loss(&bound, &x, &Indices::new(&[labels.len(), 1], labels));
    let value = loss.item();
    (value, bound.backward(&loss))
}

fn main() {
    let steps = std::env::args().nth(1).and_then(|steps| steps.parse().ok()).unwrap_or(200);
    let x: Vec<f32> = (0..IMAGES * SIDE * SIDE).map(|i| (i as f32 * 0.618_034).fract()).collect();
    let labels: Vec<u32> = (0..IMAGES as u32).map(|i| i % 10).collect();
    for tiled in [false, true, false, true] {
        let mut params = Params::new();
        let net = Network::new(&mut params);
        let mut adam = Adam::new(AdamConfig::default());
        let count = if tiled { IMAGES / TILE } else { 1 };
        let mut tapes: Vec<_> = (0..count).map(|_| Tape::new()).collect();
        let (mut times, mut losses) = (vec![], vec![]);
        for _ in 0..steps {
            let start = Instant::now();
            let each = IMAGES / count;
            let work = |(i, tape): (usize, &mut Tape<f32>)| {
                let range = i * each..(i + 1) * each;
                let result =
                    tile(tape, &net, &params, &x[range.start * SIDE * SIDE..range.end * SIDE * SIDE], &labels[range]);
                tape.clear();
                result
            };
            let mut tiles: Vec<_> = tapes.par_iter_mut().enumerate().map(work).collect();
            let (mut loss, mut grads) = tiles.remove(0);
            for (value, others) in tiles {
                loss += value;
                grads.iter_mut().zip(others).for_each(|(sum, grad)| sum.add(grad));
            }
            adam.update(&mut params, &grads, 1e-3).check().expect("finite gradients");
            times.push(start.elapsed().as_secs_f64());
            losses.push(loss);
        }
        times.sort_by(f64::total_cmp);
        println!(
            "{}: {:.3} ms a step, loss {:.4} to {:.4}",
            if tiled { "a tape for every 8 images" } else { "one tape" },
            1e3 * times[times.len() / 2],
            losses[0],
            losses[losses.len() - 1]
        );
    }
}
