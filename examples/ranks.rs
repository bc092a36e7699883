//! One model on several processes: a network learns a curve, and each process computes a part of every step.
//!
//! ```text
//! cargo run --release --example ranks                                   2 ranks as threads of one process
//! cargo build --release --example ranks --features mpi
//! mpirun -n 4 target/release/examples/ranks                             4 ranks of an MPI job
//! ```
//!
//! The printed loss is the same for any number of ranks, to the last digit.

use rand::SeedableRng;
use rand::rngs::StdRng;
use raygrad::nn::{Exchange, ExchangeError};
use raygrad::{Activation, Adam, AdamConfig, Bound, Init, Linear, Mlp};
use raygrad::{Optimizer, Params, Schedule, Tensor, Tiles, Var};

const STEPS: usize = 400;
const TILES: usize = 16;
/// Points of a tile.
const POINTS: usize = 64;

/// The curve.
fn truth(x: f32) -> f32 {
    (5.0 * x).sin() * (-x * x).exp()
}

/// The mean squared error of a tile's points.
fn loss<'t>((trunk, head): &(Mlp, Linear), params: &Bound<'t, f32>, tile: usize) -> (Var<'t, f32>, f64) {
    let x = |i: usize| 4.0 * (i * TILES + tile) as f32 / (POINTS * TILES) as f32 - 2.0;
    let [inputs, wanted] = [|x| x, truth].map(|y: fn(f32) -> f32| Tensor::from_fn(&[POINTS, 1], |i| y(x(i))));
    let found = head.forward(params, &trunk.forward(params, &params.tape().constant(inputs)));
    let loss = (found - wanted).square().sum() / (POINTS * TILES) as f64;
    let value = f64::from(loss.item());
    (loss, value)
}

/// Trains on one of the ranks. All have the same parameters after each step.
fn train(exchange: &mut dyn Exchange) -> Result<f64, ExchangeError> {
    let mut params = Params::new();
    let rng = &mut StdRng::seed_from_u64(0);
    let trunk = Mlp::new(&mut params, "trunk", [1, 64, 2], &[], rng);
    let head = Linear::new(&mut params, "head", [64, 1], Activation::Identity, Init::Glorot, rng);
    let network = (trunk, head);
    let mut adam = Adam::new(AdamConfig::default());
    let schedule = Schedule::Cosine { from: 1e-2, to: 0.0, warmup: 0.05 };
    let tiles = Tiles::<f32>::new();
    let mut last = f64::NAN;
    for step in 0..STEPS {
        let sums =
            tiles.differentiate_across(exchange, &params, TILES, |tile, params, ()| loss(&network, params, tile))?;
        adam.update(&mut params, &sums.grads, schedule.at_step(step as u64, STEPS as u64))
            .check()
            .expect("finite gradients");
        last = sums.results.iter().sum();
        if exchange.rank() == 0 && (step + 1) % (STEPS / 4) == 0 {
            println!("step {:3}  mean squared error {last}", step + 1);
        }
    }
    if exchange.rank() == 0 {
        println!("{} ranks; each sent {} bytes in a step", exchange.ranks(), exchange.sent_bytes() / STEPS as u64);
    }
    Ok(last)
}

#[cfg(feature = "mpi")]
fn main() -> Result<(), ExchangeError> {
    let mut mpi = raygrad::nn::Mpi::initialize(std::time::Duration::from_secs(60))?;
    train(&mut mpi)?;
    raygrad::nn::Mpi::finalize();
    Ok(())
}

#[cfg(not(feature = "mpi"))]
fn main() {
    let start = |mut exchange| std::thread::spawn(move || train(&mut exchange));
    let ranks: Vec<_> = raygrad::nn::InProcess::ranks(2).into_iter().map(start).collect();
    for rank in ranks {
        rank.join().expect("no panic").expect("both ranks work");
    }
}
