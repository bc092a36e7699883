//! Adam, dense and lazy.

use super::support::*;
use raygrad::{Adam, AdamConfig, AdamW, Gradient, Optimizer, Params, Scalar, Sgd, SgdConfig, Tensor};

const TABLE: AdamConfig = AdamConfig { beta1: 0.9, beta2: 0.99, eps: 1e-15 };

/// The largest step in learning rates, by Cauchy and Schwarz: `m^2 <= v sum (1-b1)^2 b1^2k / ((1-b2) b2^k)`.
///
/// It exceeds the customary `max(1, (1-b1) / sqrt(1-b2))`, which holds for gradients of equal size or a single one:
/// 7.27 instead of 3.16 for the default constants, and 2.35 instead of 1 for those of tables.
pub fn bound(config: &AdamConfig) -> f64 {
    let AdamConfig { beta1, beta2, .. } = *config;
    let q = beta1 * beta1 / beta2;
    let at = |t: i32| {
        let sum = (1.0 - q.powi(t)) / (1.0 - q);
        let correction = (1.0 - beta2.powi(t)).sqrt() / (1.0 - beta1.powi(t));
        (1.0 - beta1) / (1.0 - beta2).sqrt() * sum.sqrt() * correction
    };
    (1..100_000).step_by(7).map(at).fold(1.0, raygrad::Real::maximum)
}

/// A store of one parameter.
fn store<T: Scalar>(value: Tensor<T>) -> Params<T> {
    let mut params = Params::new();
    params.add("x", value);
    params
}

/// A store of one lazy table of zeros.
fn lazy_store<T: Scalar>(shape: &[usize]) -> Params<T> {
    let mut params = store(Tensor::zeros(shape));
    params.set_lazy(|_| true, true);
    params
}

/// A gradient of a table that is zero except in one row.
fn row_of<T: Scalar>(shape: &[usize], row: usize, g: f64) -> Tensor<T> {
    Tensor::from_fn(shape, |i| if i / shape[1] == row { T::from_f64(g) } else { T::ZERO })
}

/// Takes a step; returns the number of elements that did not change.
fn step<T: Scalar>(adam: &mut dyn Optimizer<T>, params: &mut Params<T>, gradient: Tensor<T>, rate: f64) -> usize {
    adam.update(params, &[Gradient::from(gradient)], rate).skipped
}

/// The change of each element in each step with these gradients.
fn ways<T: Scalar>(config: AdamConfig, gradients: &[Vec<f64>], rate: f64) -> Vec<Vec<f64>> {
    let n = gradients[0].len();
    let mut adam = Adam::<T>::new(config);
    let mut x = store(Tensor::zeros(&[n]));
    let way = |gradient: &Vec<f64>| {
        // From 0 each time, so that small steps are precise.
        x.values_mut()[0].as_mut_slice().fill(T::ZERO);
        step(&mut adam, &mut x, vector(gradient), rate);
        numbers(&x.values()[0])
    };
    gradients.iter().map(way).collect()
}

/// Matrix: Adam with g = 0, 1e-30, 1e-10, 1e30, NaN at t = 1. Catalogue: Adam epsilon, bias correction.
fn first_steps<T: Scalar>() {
    let gradients = vec![0.0, -0.0, 1e-30, 1e-10, -1e-10, 1.0, 1e30, -1e30, smallest::<T>(), greatest::<T>()];
    for config in [AdamConfig::default(), TABLE] {
        let way = ways::<T>(config, std::slice::from_ref(&gradients), 0.5).remove(0);
        for (g, way) in gradients.iter().zip(&way) {
            // The textbook's first step is lr g / (|g| + epsilon).
            let g = round::<T>(*g);
            let expected = if g == 0.0 { 0.0 } else { -0.5 * g / (g.abs() + config.eps) };
            let tiny = if g.abs() < 1e-25 { 1e-9 } else { 0.0 };
            within(&format!("g {g:e}"), *way, expected, by_type::<T>(1e-6, 1e-12) * expected.abs() + tiny);
            assert!(way.abs() <= 0.5 * bound(&config) * (1.0 + 1e-6), "{g:e}: {way:e}");
        }
    }
    let first =
        |epsilon: f64| ways::<T>(AdamConfig { eps: epsilon, ..AdamConfig::default() }, &[vec![1e-10]], 1.0)[0][0];
    for epsilon in ["1e-8", "1e-15"] {
        let expected = constant(&format!("Adam's first step / lr for a gradient of 1e-10 and epsilon {epsilon}"));
        near::<T>(epsilon, -first(epsilon.parse().unwrap()), expected, by_type::<T>(2e-6, 1e-12));
    }
}

/// No gradients of any sizes, in any order and after any pause, make a step longer than the bound.
fn no_step_is_longer_than_the_bound<T: Scalar>() {
    let sizes =
        [1e-38, 1e-30, 1e-20, 3e-16, 1e-15, 3e-15, 1e-14, 1e-12, 1e-8, 1e-4, 1.0, 1e8, 1e18, 1e19, 1e20, 1e30, 1e38];
    for config in [AdamConfig::default(), TABLE, AdamConfig { eps: 1e-15, ..AdamConfig::default() }] {
        let bound = bound(&config) * (1.0 + 1e-5);
        let mut random = noise(17);
        let n = sizes.len();
        let pattern = |step: usize| -> Vec<f64> {
            (0..n)
                .map(|i| if step % 7 == 3 { 0.0 } else { sizes[i] * if random() < 0.3 { -1.0 } else { 1.0 } })
                .collect()
        };
        let gradients: Vec<_> = (0..300).map(pattern).collect();
        for (step, way) in ways::<T>(config, &gradients, 1.0).iter().enumerate() {
            for (way, size) in way.iter().zip(sizes) {
                assert!(way.abs() <= bound, "step {step}, |g| {size:e}, epsilon {:e}: {way:e}", config.eps);
            }
        }
        // Sizes that follow each other.
        let gradients: Vec<_> = (0..200).map(|step| vec![sizes[(step * 5) % n], -sizes[(step * 3) % n]]).collect();
        let ways = ways::<T>(config, &gradients, 1.0);
        assert!(ways.iter().flatten().all(|way| way.abs() <= bound), "{:?}", config);
    }
}

/// The document's bound does not hold: gradients that grow by `b2 / b1` attain the bound by Cauchy and Schwarz.
fn growing_gradients_reach_the_bound<T: Scalar>() {
    for (config, name) in [(AdamConfig::default(), "default"), (TABLE, "table's")] {
        let growth = config.beta2 / config.beta1;
        let warm = (0..4000).map(|_| vec![1e-10]);
        let gradients: Vec<_> = warm.chain((0..160).map(|k| vec![1e-10 * growth.powi(k)])).collect();
        let config = AdamConfig { eps: by_type::<T>(1e-15, 1e-20), ..config };
        let most = ways::<T>(config, &gradients, 1.0).iter().map(|way| way[0].abs()).fold(0.0, raygrad::Real::maximum);
        let customary = constant(&format!("bound of Adam's step / lr for the {name} betas"));
        let expected = constant(&format!("bound of Adam's step / lr for the {name} betas, by Cauchy and Schwarz"));
        assert!(most > 1.5 * customary, "{name}: {most} and {customary}");
        near::<T>(name, most, expected, 0.02);
        assert!(most <= bound(&config) * (1.0 + 1e-5));
    }
}

/// An element recovers after a huge gradient.
fn element_recovers_after_a_huge_gradient<T: Scalar>() {
    let config = AdamConfig { beta2: 0.9, ..AdamConfig::default() };
    let mut gradients = vec![vec![greatest::<T>()]];
    gradients.extend((0..10_000).map(|_| vec![1.0]));
    let ways = ways::<T>(config, &gradients, 1.0);
    near::<T>("the last step", -ways[10_000][0], 1.0, 1e-5);
}

/// Matrix: NaN is skipped and counted, by the same rule in lazy tables. Catalogue: lazy and dense.
fn bad_gradients_are_skipped_and_counted<T: Scalar>() {
    for lazy in [false, true] {
        let table = |values: &[f64; 4]| vector::<T>(values).reshape(&[2, 2]);
        let mut adam = Adam::<T>::new(AdamConfig::default());
        let mut x = store(table(&[1.0; 4]));
        x.set_lazy(|_| true, lazy);
        let bad = table(&[f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1.0]);
        assert_eq!(step(&mut adam, &mut x, bad, 0.1), 3);
        let moved = numbers(&x.values()[0]);
        assert!(moved[..3] == [1.0; 3] && (moved[3] - 0.9).abs() < 1e-6, "{moved:?}");
        // The moments do not keep them.
        step(&mut adam, &mut x, table(&[0.0; 4]), 0.1);
        assert_eq!(numbers(&x.values()[0])[..3], [1.0; 3]);
    }
}

/// Matrix: 10^4 steps without gradient. Long run: 1e5 of them. Catalogue: denormal moments.
fn a_hundred_thousand_steps_without_gradient<T: Scalar>() {
    let mut params = Params::<T>::new();
    let id = params.add("x", vector(&[1.0, -2.0, 1e-20, 0.0]));
    let mut optimizers: Vec<Box<dyn Optimizer<T>>> = vec![
        Box::new(Adam::new(AdamConfig::default())),
        Box::new(Adam::new(TABLE)),
        Box::new(AdamW::new(AdamConfig::default(), 0.01)),
        Box::new(Sgd::new(SgdConfig { momentum: 0.9, ..SgdConfig::default() })),
    ];
    let zeros = [Gradient::from(Tensor::zeros(&[4]))];
    for (k, optimizer) in optimizers.iter_mut().enumerate() {
        step(&mut **optimizer, &mut params, vector(&[1.0, -1.0, 1e-12, 1e-30]), 1e-3);
        let mut last = numbers(params.get(id));
        let mut rest = None;
        for step in 0..100_000_u32 {
            optimizer.update(&mut params, &zeros, 1e-3).check().unwrap();
            let now = numbers(params.get(id));
            let denormal = |x: &f64| *x != 0.0 && x.abs() < by_type::<T>(f32::MIN_POSITIVE.into(), f64::MIN_POSITIVE);
            assert!(now.iter().all(|x| x.is_finite() && !denormal(x)), "optimizer {k}, step {step}: {now:?}");
            if now == last && rest.is_none() {
                rest = Some(step);
            } else if now != last {
                rest = None;
            }
            last = now;
        }
        // Without decay everything stops once the momentum is flushed.
        assert!(k == 2 || rest.is_some_and(|step| step < 2000), "optimizer {k} comes to rest at {rest:?}");
    }
}

/// Matrix: Adam at t = 1e7 and beyond. The bias corrections are 1, and a constant gradient gives a step of 1. The moments
/// come to rest within 100 000 steps, so that later counts are set.
#[test]
fn billions_of_steps() {
    let mut adam = Adam::<f32>::new(AdamConfig::default());
    let mut x = store(Tensor::<f32>::zeros(&[3]));
    let gradient = [Gradient::from(vector::<f32>(&[1.0, -1e-3, 0.0]))];
    let mut step = 0_u64;
    for end in [100_000, 10_000_000, u64::from(u32::MAX) + 5] {
        let mut state = adam.state(&x);
        step = step.max(end - 100_000);
        state.counts.values_mut().for_each(|counts| counts.fill(step));
        adam.load_state(&x, &state).unwrap();
        while step < end {
            step += 1;
            if step % 1000 == 1 || step + 10 > end {
                x.values_mut()[0].as_mut_slice().fill(0.0);
            }
            let before = numbers(&x.values()[0]);
            adam.update(&mut x, &gradient, 1.0).check().unwrap();
            if before == [0.0; 3] {
                let way = numbers(&x.values()[0]);
                let exact = [-1.0, 1.0, 0.0];
                (0..3).for_each(|i| within(&format!("step {step}"), way[i], exact[i], 3e-5));
            }
        }
        assert_eq!(adam.steps(), end);
    }
}

/// Matrix: lazy Adam with a gradient every k steps: the documented recurrence, in which each row counts its own steps.
fn lazy_adam_with_pauses<T: Scalar>() {
    for every in [1, 3, 10] {
        for config in [AdamConfig::default(), TABLE] {
            let mut adam = Adam::<T>::new(config);
            let mut table = lazy_store::<T>(&[16, 1]);
            let (mut m, mut v, mut x, mut t) = (0.0, 0.0, 0.0, 0);
            for step in 0..40 * every {
                let mut grad = Tensor::zeros(&[16, 1]);
                if step % every == 0 {
                    let g = round::<T>((0.3 * step as f64).sin() + 0.2);
                    t += 1;
                    grad = row_of(&[16, 1], 9, g);
                    (m, v) =
                        (config.beta1 * m + (1.0 - config.beta1) * g, config.beta2 * v + (1.0 - config.beta2) * g * g);
                    let (m, v) = (m / (1.0 - config.beta1.powi(t)), v / (1.0 - config.beta2.powi(t)));
                    x -= 0.01 * m / (v.sqrt() + config.eps);
                }
                assert_eq!(self::step(&mut adam, &mut table, grad, 0.01), 0);
                within(
                    &format!("every {every}, step {step}"),
                    numbers(&table.values()[0])[9],
                    x,
                    by_type::<T>(2e-6, 1e-13),
                );
            }
            assert!(numbers(&table.values()[0]).iter().enumerate().all(|(i, x)| i == 9 || *x == 0.0));
        }
    }
    // One late gradient: a lazy row moves by one learning rate; dense Adam moves by this many in total.
    let mut late = vec![vec![0.0]; 2000];
    late.push(vec![1.0]);
    late.extend(vec![vec![0.0]; 2000]);
    let way: f64 = -ways::<T>(TABLE, &late, 1.0).iter().map(|way| way[0]).sum::<f64>();
    let expected = constant("way / lr after one late gradient, dense Adam with beta2 = .99 in all");
    near::<T>("dense", way, expected, by_type::<T>(1e-4, 1e-7));
    let mut table = lazy_store::<T>(&[8, 1]);
    step(&mut Adam::new(TABLE), &mut table, row_of(&[8, 1], 0, 1.0), 1.0);
    near::<T>("lazy", -numbers(&table.values()[0])[0], 1.0, 1e-6);
}

/// The bound holds for lazy Adam too.
fn no_lazy_step_is_longer_than_the_bound<T: Scalar>() {
    for config in [AdamConfig::default(), TABLE] {
        let most = bound(&config) * (1.0 + 1e-5);
        for size in [1e-30, 1e-16, 1e-15, 1e-14, 1e-13, 1e-10, 1.0, 1e18, 1e20, 1e30] {
            let mut adam = Adam::<T>::new(config);
            let mut table = lazy_store::<T>(&[8, 2]);
            for step in 0..200 {
                table.values_mut()[0].as_mut_slice().fill(T::ZERO);
                let sign = if step % 5 == 0 { -1.0 } else { 1.0 };
                assert_eq!(self::step(&mut adam, &mut table, row_of(&[8, 2], 3, sign * size), 1.0), 0);
                let way = numbers(&table.values()[0])[7].abs();
                assert!(way <= most, "|g| {size:e}, step {step}: {way:e}");
            }
        }
    }
}

both!(
    first_steps,
    no_step_is_longer_than_the_bound,
    growing_gradients_reach_the_bound,
    element_recovers_after_a_huge_gradient,
    bad_gradients_are_skipped_and_counted,
    a_hundred_thousand_steps_without_gradient,
    lazy_adam_with_pauses,
    no_lazy_step_is_longer_than_the_bound,
);
