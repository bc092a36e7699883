//! Backward passes side by side and inside each other: eight threads, a thousand rounds, the bits of one thread alone.

use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::{Activation, Gradient, Pool, Tape, Tensor, Var};
use raygrad_nn::{Dropout, Init, Linear, Mode, Optimizer, Params, Sequential, Sgd, SgdConfig};
use std::sync::{Arc, Barrier, Mutex};

const THREADS: usize = 8;
const ROUNDS: usize = 1000;

fn model(params: &mut Params<f32>) -> Sequential<f32> {
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    let mut dense = |params: &mut _, name: &str, sizes| {
        Linear::new(params, name, sizes, Activation::Relu, Init::Orthogonal(1.2), &mut rng)
    };
    let first = dense(params, "first", [5, 16]);
    let second = dense(params, "second", [16, 3]);
    Sequential::new().then(first).map(|x| x.softplus()).then(Dropout::new(0.2)).then(second)
}

/// A gradient taken while another one is: the gradient of a gradient, on a tape of its own.
fn inner_gradient(x: f32) -> f32 {
    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::scalar(x));
    (x.sin() * &x).grad_graph(&[&x]).remove(0).grad(&[&x]).remove(0).item()
}

/// One round's numbers, folded into a fingerprint: a step of training, second derivatives, a checkpoint, a hook that
/// differentiates.
fn round(
    tape: &mut Tape<f32>,
    model: &Sequential<f32>,
    params: &mut Params<f32>,
    sgd: &mut Sgd<f32>,
    seed: u64,
) -> u64 {
    let mut fingerprint = 0xcbf2_9ce4_8422_2325_u64;
    let mut mix = |x: &Tensor<f32>| {
        for x in x.as_slice() {
            fingerprint = (fingerprint ^ u64::from(x.to_bits())).wrapping_mul(0x0100_0000_01b3);
        }
    };
    {
        let bound = params.bind(tape);
        let x = tape.leaf(Tensor::from_fn(&[7, 5], |i| ((i as u64 * 31 + seed) as f32 * 0.17).sin()));
        let mut inputs = vec![&x];
        inputs.extend(bound.vars());
        let (network, layout) = (model.clone(), params.layout());
        let y = tape.checkpoint(&inputs, move |x: &[Var<'_, f32>]| {
            network.forward(&layout.bind(x[1..].to_vec()), &x[0], Mode::Train(seed))
        });
        let y = y.map_grad(|g| g * (1.0 + 1e-3 * f64::from(inner_gradient(g.value().as_slice()[0]))));
        let loss = y.square().mean();
        // The gradient by the input, recorded, is part of the loss.
        let slope = loss.grad_graph(&[&x]).remove(0);
        let total = loss + slope.square().sum();
        let grads = bound.backward(&total);
        grads.iter().filter_map(Gradient::dense).for_each(&mut mix);
        mix(total.value());
        sgd.update(params, &grads, 0.01).check().unwrap();
    }
    tape.clear();
    params.values().iter().for_each(&mut mix);
    fingerprint
}

fn rounds(which: usize, pool: Pool<f32>, start: &Params<f32>, model: &Sequential<f32>, count: usize) -> Vec<u64> {
    let mut params = start.clone();
    let mut sgd = Sgd::new(SgdConfig { momentum: 0.9, ..SgdConfig::default() });
    let mut tape = Tape::with_pool(pool);
    (0..count).map(|i| round(&mut tape, model, &mut params, &mut sgd, (which * 7919 + i) as u64)).collect()
}

#[test]
fn eight_threads_give_the_bits_of_one() {
    let mut params = Params::new();
    let model = model(&mut params);
    let alone: Vec<_> = (0..THREADS).map(|which| rounds(which, Pool::new(), &params, &model, ROUNDS)).collect();
    // All threads take their buffers from one pool, share one model, and start together.
    let (pool, barrier) = (Pool::new(), Barrier::new(THREADS));
    let together = Mutex::new(vec![vec![]; THREADS]);
    std::thread::scope(|scope| {
        for which in 0..THREADS {
            let (pool, barrier, together, params, model) = (pool.clone(), &barrier, &together, &params, &model);
            scope.spawn(move || {
                barrier.wait();
                let got = rounds(which, pool, params, model, ROUNDS);
                together.lock().unwrap()[which] = got;
            });
        }
    });
    let together = together.into_inner().unwrap();
    for which in 0..THREADS {
        assert_eq!(alone[which].len(), ROUNDS);
        let first = (0..ROUNDS).find(|&i| alone[which][i] != together[which][i]);
        assert_eq!(first, None, "thread {which}: the first round that differs");
    }
    assert_ne!(alone[0], alone[1], "threads do different work");
    assert_ne!(alone[0][0], alone[0][1], "so do rounds");
}

#[test]
fn tape_moves_between_threads() {
    // A tensor recorded on one thread is read on others while that thread differentiates.
    let params = {
        let mut params = Params::<f32>::new();
        params.add("w", Tensor::from_fn(&[64, 64], |i| (i as f32 * 0.01).sin()));
        Arc::new(params)
    };
    let gradient = |params: &Params<f32>| {
        let tape = Tape::new();
        let bound = params.bind(&tape);
        let w = bound.vars()[0];
        w.matmul(w).tanh().sum().grad(&[w]).remove(0)
    };
    let expected = gradient(&params);
    let handles: Vec<_> = (0..THREADS)
        .map(|_| {
            let params = params.clone();
            std::thread::spawn(move || (0..20).map(|_| gradient(&params)).collect::<Vec<_>>())
        })
        .collect();
    for handle in handles {
        assert!(handle.join().unwrap().iter().all(|got| *got == expected));
    }
    let tape = Tape::<f32>::new();
    let value = std::thread::spawn(move || tape.leaf(Tensor::scalar(2.0)).square().item()).join().unwrap();
    assert_eq!(value, 4.0);
}
