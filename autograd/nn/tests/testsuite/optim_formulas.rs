//! Optimizers, schedules, averages and clipping against their published formulas in higher precision, over the range of
//! both number types. Errors are relative and of each element: in units in the last place of the step or, where its terms
//! cancel, of their sum of magnitudes. `reference/make_formulas.py` says what the reference holds and writes it.

use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::{Gradient, Scalar, Tensor};
use raygrad_nn::{
    Adam, AdamConfig, AdamW, Ema, Optimizer, Params, Schedule, Sgd, SgdConfig, clip_norm, clip_value, global_norm,
};
use std::ops::{Add, Div, Mul, Neg, Sub};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// An unevaluated sum of two f64, of about 31 digits (Dekker 1971).
#[derive(Clone, Copy, Debug)]
struct Dd(f64, f64);

impl Dd {
    fn sum(a: f64, b: f64) -> Dd {
        let sum = a + b;
        let rest = sum - a;
        Dd(sum, (a - (sum - rest)) + (b - rest))
    }
    fn sqrt(self) -> Dd {
        if self.0 == 0.0 {
            return self;
        }
        let root = Dd::from(self.0.sqrt());
        root + (self - root * root) * Dd::from(0.5 / root.0)
    }
    fn pow(self, n: u64) -> Dd {
        (0..64).rev().fold(Dd(1.0, 0.0), |power, bit| {
            let square = power * power;
            if n >> bit & 1 == 1 { square * self } else { square }
        })
    }
    fn abs(self) -> Dd {
        if self.0 < 0.0 { -self } else { self }
    }
}

impl From<f64> for Dd {
    fn from(x: f64) -> Dd {
        Dd(x, 0.0)
    }
}

impl Neg for Dd {
    type Output = Dd;
    fn neg(self) -> Dd {
        Dd(-self.0, -self.1)
    }
}

impl Add for Dd {
    type Output = Dd;
    fn add(self, other: Dd) -> Dd {
        let (high, low) = (Dd::sum(self.0, other.0), Dd::sum(self.1, other.1));
        let high = Dd::sum(high.0, high.1 + low.0);
        Dd::sum(high.0, high.1 + low.1)
    }
}

impl Sub for Dd {
    type Output = Dd;
    fn sub(self, other: Dd) -> Dd {
        self + -other
    }
}

impl Mul for Dd {
    type Output = Dd;
    fn mul(self, other: Dd) -> Dd {
        let product = self.0 * other.0;
        Dd::sum(product, self.0.mul_add(other.0, -product) + (self.0 * other.1 + self.1 * other.0))
    }
}

impl Div for Dd {
    type Output = Dd;
    fn div(self, other: Dd) -> Dd {
        let first = Dd::from(self.0 / other.0);
        let rest = self - first * other;
        let second = Dd::from(rest.0 / other.0);
        first + second + Dd::from((rest - second * other).0 / other.0)
    }
}

fn dd(x: f64) -> Dd {
    Dd::from(x)
}

/// The distance of neighbouring numbers of the type at `x`; its smallest normal number at least.
fn ulp<T: Scalar>(x: f64) -> f64 {
    let least = if size_of::<T>() == 4 { f32::MIN_POSITIVE.into() } else { f64::MIN_POSITIVE };
    2.0_f64.powi(x.abs().max(least).log2().floor() as i32) * T::EPSILON
}

/// The largest error so far, in units in the last place.
struct Worst(f64, &'static str);

impl Worst {
    /// Compares with an exact result, in units of `terms`. `more` is added to the unit.
    #[track_caller]
    fn see<T: Scalar>(&mut self, got: f64, exact: Dd, terms: f64, more: f64, bound: f64, what: impl Fn() -> String) {
        let error = (dd(got) - exact).abs().0 / (ulp::<T>(terms) + more);
        assert!(error <= bound, "{}, {} {}: {got:e} for {:e}, off by {error}", self.1, T::NAME, what(), exact.0);
        self.0 = self.0.max(error);
    }
}

impl Drop for Worst {
    fn drop(&mut self) {
        println!("{}: at most {:.3} ULP", self.1, self.0);
    }
}

const STEPS: usize = 10;
const LEN: usize = 64;

fn round<T: Scalar>(x: f64) -> f64 {
    T::from_f64(x).to_f64()
}

/// Ten gradients of each element: of one size, of mixed sizes, with zeros between, from 1e-18 to 1e18, of both signs.
fn gradients<T: Scalar>(rng: &mut impl Rng) -> Vec<Vec<f64>> {
    let mut size = |_: usize| 10.0_f64.powf(rng.random_range(-17.9..17.9));
    let fixed: Vec<f64> = (0..LEN).map(|i| if i < 2 { [1.0001e-18, 0.9999e18][i] } else { size(i) }).collect();
    let mixed: Vec<f64> = (0..LEN * STEPS).map(size).collect();
    let mut element = |t: usize, i: usize| {
        let size = if i % 4 < 2 { fixed[i] * (1.0 + 0.01 * t as f64).sqrt().min(1.0) } else { mixed[t * LEN + i] };
        let sign = if i % 8 < 4 || rng.random_bool(0.5) { 1.0 } else { -1.0 };
        if i % 3 == 2 && rng.random_bool(0.4) { 0.0 } else { round::<T>(sign * size) }
    };
    (0..STEPS).map(|t| (0..LEN).map(|i| element(t, i)).collect()).collect()
}

fn store<T: Scalar>(shape: &[usize], values: &[f64]) -> Params<T> {
    let mut params = Params::new();
    params.add("x", Tensor::from_vec(shape, values.iter().map(|&x| T::from_f64(x)).collect()));
    params
}

fn gradient<T: Scalar>(shape: &[usize], values: &[f64]) -> [Gradient<T>; 1] {
    [Gradient::from(Tensor::from_vec(shape, values.iter().map(|&x| T::from_f64(x)).collect::<Vec<T>>()))]
}

fn numbers<T: Scalar>(params: &Params<T>) -> Vec<f64> {
    params.values()[0].as_slice().iter().map(|x| x.to_f64()).collect()
}

/// Adam by its formula: Kingma and Ba 2015, algorithm 1.
#[derive(Clone, Copy)]
struct Formula {
    config: AdamConfig,
    t: u64,
    /// Both moments, and the first one of the magnitudes.
    moments: [Dd; 3],
}

impl Formula {
    fn new(config: AdamConfig) -> Self {
        Formula { config, t: 0, moments: [dd(0.0); 3] }
    }
    /// The step at rate 1, and what it would be if no terms cancelled.
    fn step(&mut self, g: f64) -> [Dd; 2] {
        let [beta1, beta2] = [self.config.beta1, self.config.beta2].map(dd);
        let [rest1, rest2] = [beta1, beta2].map(|beta| dd(1.0) - beta);
        let [first, second, size] = self.moments;
        let g = dd(g);
        self.t += 1;
        self.moments = [beta1 * first + rest1 * g, beta2 * second + rest2 * (g * g), beta1 * size + rest1 * g.abs()];
        let [bias1, bias2] = [beta1, beta2].map(|beta| dd(1.0) - beta.pow(self.t));
        let root = (self.moments[1] / bias2).sqrt() + dd(self.config.eps);
        [0, 2].map(|k| self.moments[k] / bias1 / root)
    }
}

fn configs<T: Scalar>() -> Vec<AdamConfig> {
    let of = |beta1, beta2, eps| AdamConfig { beta1, beta2, eps };
    let mut all = vec![
        AdamConfig::default(),
        of(0.9, 0.99, 1e-15),
        of(0.9, 0.9999, 1e-15),
        of(0.5, 0.5, 1e-12),
        of(0.0, 0.0, 1e-15),
        of(0.999, 0.9, 1e-3),
        of(0.9, 0.999999, 1e-10),
        of(0.999999, 0.999999, 1e10),
    ];
    if size_of::<T>() == 8 {
        all.extend([of(0.9, 0.999, 1e-30), of(1.0 - 1e-14, 1.0 - 1e-14, 1e-20)]);
    }
    // Decays between 0 and the largest, and epsilons down to the smallest that fits.
    let mut rng = Pcg64Mcg::seed_from_u64(14);
    let digits = if size_of::<T>() == 4 { 6.0 } else { 14.0 };
    all.extend((0..16).map(|_| {
        let [beta1, beta2] = [(); 2].map(|()| 1.0 - 10.0_f64.powf(-rng.random_range(0.0..digits)));
        let config = of(beta1, beta2, 10.0_f64.powf(rng.random_range(-30.0..20.0)));
        let fitting = [1e-15, 1e-10].map(|least| AdamConfig { eps: config.eps.max(least), ..config });
        [config, fitting[0], fitting[1]].into_iter().find(|config| config.check::<T>().is_ok()).unwrap()
    }));
    all
}

/// Bound of an Adam step's error in units of its last place.
const ADAM: f64 = 16.0;

/// Steps from 0, so that they are precise.
fn ten_steps_of_adam<T: Scalar>(lazy: bool) {
    let mut rng = Pcg64Mcg::seed_from_u64(11);
    let mut worst = Worst(0.0, "Adam");
    for (config, rate) in
        configs::<T>().into_iter().flat_map(|config| [1e-8, 0.000_713, 1.0, 2.37e6].map(|rate| (config, rate)))
    {
        let (mut adam, mut params) = (Adam::<T>::new(config), store::<T>(&[LEN, 1], &[0.0; LEN]));
        params.set_lazy(|_| true, lazy);
        let mut formulas = [Formula::new(config); LEN];
        for (t, grads) in gradients::<T>(&mut rng).iter().enumerate() {
            params.values_mut()[0].as_mut_slice().fill(T::ZERO);
            adam.update(&mut params, &gradient(&[LEN, 1], grads), rate).check().unwrap();
            for (i, got) in numbers(&params).into_iter().enumerate() {
                let [exact, terms] = match lazy && grads[i] == 0.0 {
                    true => [dd(0.0); 2],
                    false => formulas[i].step(grads[i]).map(|step| step * dd(rate)),
                };
                worst.see::<T>(got, -exact, terms.0, 0.0, ADAM, || format!("{config:?} {t} {i} {}", grads[i]));
            }
        }
    }
}

#[test]
fn ten_steps_of_adam_dense() {
    ten_steps_of_adam::<f32>(false);
    ten_steps_of_adam::<f64>(false);
}

#[test]
fn ten_steps_of_adam_lazy() {
    ten_steps_of_adam::<f32>(true);
    ten_steps_of_adam::<f64>(true);
}

/// Decoupled weight decay (Loshchilov and Hutter 2019, algorithm 2, with the learning rate as in PyTorch): one unit of
/// the parameter and those of the step.
fn ten_steps_with_decay<T: Scalar>() {
    let mut rng = Pcg64Mcg::seed_from_u64(12);
    let mut worst = Worst(0.0, "AdamW");
    for (config, decay) in
        configs::<T>().into_iter().flat_map(|c| [1e-7, 0.01, 1.0, 90.0, 100.0].map(|decay| (c, decay)))
    {
        let start: Vec<f64> =
            (0..LEN).map(|i| (i as f64 - 31.5) * 10.0_f64.powf(rng.random_range(-12.0..12.0))).collect();
        let (mut adam, mut params) = (AdamW::new::<T>(config, decay), store::<T>(&[LEN], &start));
        let mut formulas = [Formula::new(config); LEN];
        for (t, grads) in gradients::<T>(&mut rng).iter().enumerate() {
            let before = numbers(&params);
            adam.update(&mut params, &gradient(&[LEN], grads), 0.01).check().unwrap();
            for (i, got) in numbers(&params).into_iter().enumerate() {
                let [step, terms] = formulas[i].step(grads[i]).map(|step| step * dd(0.01));
                let (x, share) = (dd(before[i]), dd(0.01 * decay));
                let exact = x * (dd(1.0) - share) - step;
                let more = ulp::<T>(exact.0.abs().max((x * (dd(1.0) - share)).0.abs()));
                worst.see::<T>(got, exact, terms.0, more, ADAM, || format!("{config:?} {decay} {t} {i}"));
            }
        }
    }
}

#[test]
fn ten_steps_of_adamw() {
    ten_steps_with_decay::<f32>();
    ten_steps_with_decay::<f64>();
}

/// A decay far below one unit of the parameters shrinks their mean all the same.
#[test]
fn small_decay_is_not_lost() {
    let (n, decay) = (1 << 14, 1e-5);
    let start: Vec<f64> = (0..n).map(|i| round::<f32>(1.0 + (i as f64 * 0.618).fract())).collect();
    let grads: Vec<f64> = (0..n).map(|i| round::<f32>(0.1 + (i as f64 * 0.377).fract())).collect();
    let config = AdamConfig { eps: 1.0, ..AdamConfig::default() };
    let (mut adam, mut params) = (AdamW::new::<f32>(config, decay), store::<f32>(&[n], &start));
    adam.update(&mut params, &gradient(&[n], &grads), 1e-3).check().unwrap();
    let shrunk = |i: usize, x: f64| start[i] - Formula::new(config).step(grads[i])[0].0 * 1e-3 - x;
    let mean = numbers(&params).into_iter().enumerate().map(|(i, x)| shrunk(i, x)).sum::<f64>();
    let exact = start.iter().sum::<f64>() * 1e-3 * decay;
    assert!((mean / exact - 1.0).abs() < 0.1, "{mean:e} for {exact:e}");
}

/// Momentum and Nesterov momentum (Sutskever et al. 2013, in PyTorch's form).
fn ten_steps_of_sgd<T: Scalar>() {
    let mut rng = Pcg64Mcg::seed_from_u64(13);
    let mut worst = Worst(0.0, "Sgd");
    let momenta = [0.0, 0.5, 0.9, 0.999, 1.0 - 2.0_f64.powi(-20)];
    let settings = momenta.into_iter().flat_map(|momentum| [0.0, 1e-9, 0.01, 3.0].map(|decay| (momentum, decay)));
    let mut draw = |least, most| 10.0_f64.powf(rng.random_range(least..most));
    let drawn: Vec<_> = (0..12).map(|_| (1.0 - draw(-6.0, 0.0), draw(-12.0, 0.5))).collect();
    let settings = settings.chain(drawn);
    for ((momentum, weight_decay), (nesterov, lazy)) in
        settings.flat_map(|s| [(false, false), (true, false), (false, true)].map(|form| (s, form)))
    {
        let nesterov = nesterov && momentum > 0.0;
        let mut sgd = Sgd::<T>::new(SgdConfig { momentum, nesterov, weight_decay });
        let start: Vec<f64> =
            (0..LEN).map(|i| if i % 5 == 0 || weight_decay == 0.0 { 0.0 } else { i as f64 }).collect();
        let mut params = store::<T>(&[LEN, 1], &start);
        params.set_lazy(|_| true, lazy);
        let mut velocities = [[dd(0.0); 2]; LEN];
        for (t, grads) in gradients::<T>(&mut rng).iter().enumerate() {
            let before = if weight_decay == 0.0 { vec![0.0; LEN] } else { numbers(&params) };
            params = {
                let mut fresh = params;
                fresh.values_mut()[0] = store::<T>(&[LEN, 1], &before).values()[0].clone();
                fresh
            };
            let rate = [1e-8, 0.000_713, 1.0, 2.37e6][t % 4];
            sgd.update(&mut params, &gradient(&[LEN, 1], grads), rate).check().unwrap();
            for (i, got) in numbers(&params).into_iter().enumerate() {
                let x = dd(before[i]);
                if lazy && grads[i] == 0.0 {
                    assert_eq!(got, before[i]);
                    continue;
                }
                // The sum, and that of the magnitudes.
                let h = [dd(grads[i]) + dd(weight_decay) * x, dd(grads[i]).abs() + (dd(weight_decay) * x).abs()];
                let [exact, terms] = [0, 1].map(|k| {
                    velocities[i][k] = dd(momentum) * velocities[i][k] + h[k];
                    dd(rate) * if nesterov { h[k] + dd(momentum) * velocities[i][k] } else { velocities[i][k] }
                });
                let exact = x - exact;
                let more = if before[i] == 0.0 { 0.0 } else { ulp::<T>(exact.0) };
                worst.see::<T>(got, exact, terms.0, more, 8.0, || {
                    format!("{momentum} {nesterov} {weight_decay} {t} {i}")
                });
            }
        }
    }
}

#[test]
fn ten_steps_of_stochastic_descent() {
    ten_steps_of_sgd::<f32>();
    ten_steps_of_sgd::<f64>();
}

/// A single gradient at step `t`, of 1 to the largest number: the bias correction alone.
fn late_steps<T: Scalar>() {
    let mut worst = Worst(0.0, "bias correction");
    for (config, lazy) in configs::<T>().into_iter().flat_map(|config| [(config, false), (config, true)]) {
        for t in [1, 2, 3, 10, 1000, 100_000, 10_000_000, u64::from(u32::MAX)] {
            let grads = [1.0, -1e-18, 1e-9, 1e18].map(round::<T>);
            let mut params = store::<T>(&[4, 1], &[0.0; 4]);
            params.set_lazy(|_| true, lazy);
            let mut adam = Adam::<T>::new(config);
            adam.update(&mut params, &gradient(&[4, 1], &grads), 0.0).check().unwrap();
            let mut state = adam.state(&params);
            state.counts.values_mut().for_each(|counts| counts.fill(t - 1));
            state.tensors.values_mut().for_each(|moments| moments.as_mut_slice().fill(T::ZERO));
            adam.load_state(&params, &state).unwrap();
            adam.update(&mut params, &gradient(&[4, 1], &grads), 1.0).check().unwrap();
            for (g, got) in grads.into_iter().zip(numbers(&params)) {
                let [step, terms] = Formula { t: t - 1, ..Formula::new(config) }.step(g);
                worst.see::<T>(got, -step, terms.0, 0.0, ADAM, || format!("{config:?} {lazy} {t} {g:e}"));
            }
        }
    }
}

#[test]
fn bias_correction_at_every_step() {
    late_steps::<f32>();
    late_steps::<f64>();
}

/// The limits beyond the range: epsilon, decays, huge and tiny gradients.
#[test]
fn constants_without_digits_are_refused() {
    let adam = AdamConfig::default();
    for (config, single, double) in [
        (AdamConfig { eps: 1e-20, ..adam }, "`eps` is 1e-20; use 1e-15 to 1e30", None),
        (AdamConfig { eps: 1e-12, beta2: 0.99999, ..adam }, "`eps` is 1e-12; use 1e-10 to 1e30", None),
        (AdamConfig { beta2: 0.9999999, ..adam }, "`beta2` is 0.9999999; use 0 to 1 - 2^-20", None),
        (AdamConfig { beta1: 0.9999999, ..adam }, "`beta1` is 0.9999999; use 0 to 1 - 2^-20", None),
        (AdamConfig { eps: 1e-31, ..adam }, "use 1e-15 to 1e30", Some("`eps` is 1e-31; use 1e-30 to 1e30")),
        (AdamConfig { beta1: 1.0, ..adam }, "use 0 to 1 - 2^-20", Some("`beta1` is 1.0; use 0 to 1 - 2^-49")),
    ] {
        let error = config.check::<f32>().unwrap_err().to_string();
        assert!(error.contains(single), "{error} for {single}");
        let error = config.check::<f64>().err().map(|error| error.to_string());
        assert_eq!(error.as_deref(), double);
    }
    let sgd = SgdConfig { momentum: 0.9999999, ..SgdConfig::default() };
    assert!(sgd.check::<f32>().unwrap_err().to_string().contains("`momentum` is 0.9999999; use 0 to 1 - 2^-20"));
    assert!(sgd.check::<f64>().is_ok());
    let refused = |f: &dyn Fn()| catch_unwind(AssertUnwindSafe(f)).is_err();
    assert!(refused(&|| drop(Ema::new(&store::<f32>(&[1], &[1.0]), 0.99999999))));
    assert!(!refused(&|| drop(Ema::new(&store::<f64>(&[1], &[1.0]), 0.99999999))));
    for bound in [1e-31, -1.0, f64::NAN] {
        assert!(refused(&|| assert_eq!(clip_value(&mut gradient::<f32>(&[1], &[1.0]), bound), 1)));
        assert!(refused(&|| assert_eq!(clip_norm(&mut gradient::<f32>(&[1], &[1.0]), bound).norm, 1.0)));
    }
    assert!(!refused(&|| assert_eq!(clip_value(&mut gradient::<f64>(&[1], &[1.0]), 1e-31), 1)));
}

/// Beyond 1.1e18 a gradient counts as that; second moments keep their digits down to 4.7e-41, also in a saved state.
#[test]
fn limits_of_moments() {
    let config = AdamConfig { beta2: 0.99, eps: 1e-15, ..AdamConfig::default() };
    let grads = [1e38, -2e18, 1.1e18, 1e18, 1e-18, 1e-19, 1e-22, 9e-30];
    let mut params = store::<f32>(&[8], &[0.0; 8]);
    let mut adam = Adam::new(config);
    adam.update(&mut params, &gradient(&[8], &grads), 1.0).check().unwrap();
    let state = adam.state(&params);
    let moments = state.tensors["x.second"].as_slice();
    for (i, (&g, &moment)) in grads.iter().zip(moments).enumerate() {
        let exact = 0.01 * g.abs().min(1.1e18).powi(2);
        // One that f32 would hold as a denormal number is 256 times that, with a minus sign.
        let exact = if exact < 4.7e-41 {
            0.0
        } else if exact < 1.17e-38 {
            -256.0 * exact
        } else {
            exact
        };
        assert!((f64::from(moment) - exact).abs() <= 1e-6 * exact.abs(), "{g:e}: {moment:e} for {exact:e}");
        assert!(!moment.is_subnormal(), "element {i}");
    }
    assert!(moments[4] < 0.0 && moments[6] == 0.0 && state.tensors["x.first"].as_slice()[7] == 0.0);
    // An epsilon above the limit hides what becomes 0: 7e-21 beside the corrected epsilon.
    for (g, got) in grads.iter().zip(numbers(&params)) {
        let exact = -Formula::new(config).step(round::<f32>(g.clamp(-1.1e18, 1.1e18)))[0].0;
        let exact = if g.abs() < 1e-28 { 0.0 } else { exact };
        assert!((got - exact).abs() <= 1e-4 * exact.abs(), "{g:e}: {got:e} for {exact:e}");
    }
    // The next steps after a restart have the same bits.
    let (mut other, mut copy) = (Adam::new(config), params.clone());
    other.load_state(&params, &state).unwrap();
    for _ in 0..3 {
        adam.update(&mut params, &gradient(&[8], &grads), 1.0).check().unwrap();
        other.update(&mut copy, &gradient(&[8], &grads), 1.0).check().unwrap();
    }
    assert_eq!((params.values(), adam.state(&params)), (copy.values(), other.state(&copy)));
    // A product of rate and moment beyond f32 is no silent step.
    let mut huge = store::<f32>(&[2], &[0.0; 2]);
    let report = Adam::new(config).update(&mut huge, &gradient(&[2], &[1e18, 1.0]), 1e22);
    assert!(report.skipped == 1 && numbers(&huge)[0] == 0.0 && (numbers(&huge)[1] / -1e22 - 1.0).abs() < 1e-6);
    // States of earlier versions have moments up to 1e38.
    let mut earlier = state;
    earlier.tensors.get_mut("x.second").unwrap().as_mut_slice().fill(1e38);
    other.load_state(&params, &earlier).unwrap();
    assert!(other.state(&params).tensors["x.second"].as_slice().iter().all(|moment| (1.3e36..1.4e36).contains(moment)));
}

/// Averages by their recurrence, of parameters of every size.
fn ten_averages<T: Scalar>() {
    let mut rng = Pcg64Mcg::seed_from_u64(14);
    let mut worst = Worst(0.0, "Ema");
    let small: Vec<f64> = (0..20).map(|_| 10.0_f64.powf(rng.random_range(-40.0..0.0))).collect();
    let decays = [0.0, 1e-10, 1e-3, 0.25, 0.5, 0.75, 0.9, 0.999, 1.0 - 2.0_f64.powi(-20), 1.0];
    // Smaller averages become 0.
    let least = if T::NAME == "f32" { 1e-29 } else { 1e-299 };
    for &decay in decays.iter().chain(&small) {
        for warmup in [false, true] {
            let values = gradients::<T>(&mut rng);
            let mut ema = Ema::new(&store::<T>(&[LEN], &values[0]), decay);
            ema = if warmup { ema.with_warmup() } else { ema };
            let mut sums: Vec<_> = values[0].iter().map(|&x| [dd(x), dd(x.abs())]).collect();
            for (t, x) in values.iter().enumerate().skip(1) {
                assert_eq!(ema.update(&store(&[LEN], x)), 0);
                let ramp = dd(t as f64) / dd(9.0 + t as f64);
                let decay = if warmup && ramp.0 < decay { ramp } else { dd(decay) };
                for (i, got) in numbers(ema.params()).into_iter().enumerate() {
                    sums[i] = [0, 1].map(|k| {
                        let x = if k == 0 { dd(x[i]) } else { dd(x[i].abs()) };
                        decay * sums[i][k] + (dd(1.0) - decay) * x
                    });
                    let [exact, terms] = sums[i];
                    let place = || format!("{} {warmup} {t} {i}", decay.0);
                    if terms.0 > least {
                        worst.see::<T>(got, exact, terms.0, 0.0, 12.0, place);
                    } else {
                        assert!(got.abs() <= least, "{}: {got:e}", place());
                    }
                }
            }
        }
    }
}

#[test]
fn averages_of_every_size() {
    ten_averages::<f32>();
    ten_averages::<f64>();
    // The average of a constant is that constant, and does not overflow.
    for decay in [0.3, 0.9, 0.9999, 0.999999] {
        let x = [0.1, -3.4e38, 1e-28, 7.7e15];
        let mut ema = Ema::new(&store::<f32>(&[4], &x), decay);
        (0..100_000).for_each(|_| assert_eq!(ema.update(&store(&[4], &x)), 0));
        assert_eq!(numbers(ema.params()), x.map(round::<f32>), "{decay}");
        ema.update(&store(&[4], &x.map(|x| -x)));
        assert!(ema.params().values()[0].is_finite());
    }
}

/// Rounding errors of many updates do not add up.
#[test]
fn long_averages_do_not_drift() {
    for (decay, bound) in [(0.9, 5e-7), (0.999, 3e-6), (0.9999, 2e-5), (0.99999, 2e-4)] {
        let mut rng = Pcg64Mcg::seed_from_u64(16);
        let mut ema = Ema::new(&store::<f32>(&[8], &[1.0; 8]), decay);
        let mut exact = [1.0_f64; 8];
        for _ in 0..100_000 {
            let x = exact.map(|_| round::<f32>(rng.random_range(0.99..1.01)));
            assert_eq!(ema.update(&store(&[8], &x)), 0);
            (0..8).for_each(|i| exact[i] = decay * exact[i] + (1.0 - decay) * x[i]);
        }
        for (got, exact) in numbers(ema.params()).into_iter().zip(exact) {
            let off = (got / exact - 1.0).abs();
            assert!(off <= bound, "{decay}: {off:e}");
        }
    }
}

/// Clipping of the norm (Pascanu, Mikolov and Bengio 2013, algorithm 1), of gradients of every size by every bound.
fn clipped<T: Scalar>() {
    let mut rng = Pcg64Mcg::seed_from_u64(15);
    let mut worst = Worst(0.0, "clip_norm");
    let (least, most, floor): (i32, i32, f64) =
        if size_of::<T>() == 4 { (-99, 126, 1e-30) } else { (-996, 1021, 1e-300) };
    for case in 0..400 {
        let [size, bound] = [0, 1].map(|_| 2.0_f64.powi(rng.random_range(least..most)));
        let bound = bound * rng.random_range(1.0..2.0);
        let values: Vec<f64> = (0..LEN)
            .map(|i| match i % 8 {
                7 => [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 0.0][i / 8 % 4],
                k => round::<T>(size * 0.01_f64.powi(k as i32 / 3) * rng.random_range(-1.0..1.0)),
            })
            .collect();
        let finite = |x: &&f64| x.is_finite();
        // By a power of two, so that no square leaves the range.
        let unit = dd(values.iter().filter(finite).fold(dd(0.0), |sum, &x| sum + dd(x / size) * dd(x / size)).sqrt().0);
        let mut grads = gradient::<T>(&[LEN], &values);
        let (norm, bad) = global_norm(&grads);
        assert!((norm / size / unit.0 - 1.0).abs() <= 1e-15 && bad == 6, "{norm:e}");
        let report = clip_norm(&mut grads, bound);
        assert_eq!((report.norm, report.bad, report.factor < 1.0), (norm, bad, norm > bound));
        let clipped = grads[0].dense().unwrap().as_slice();
        for (i, (&x, got)) in values.iter().zip(clipped).enumerate() {
            let got = got.to_f64();
            if !x.is_finite() || norm <= bound {
                assert!(got.to_bits() == x.to_bits() || got.is_nan() && x.is_nan(), "{x} became {got}");
                continue;
            }
            let exact = dd(x / size) / unit * dd(bound);
            if exact.0.abs() > 1.001 * floor {
                worst.see::<T>(got, exact, exact.0, 0.0, 4.0, || format!("{case} {i} {size:e} {bound:e}"));
            } else if exact.0.abs() < 0.999 * floor {
                assert_eq!(got, 0.0);
            }
        }
    }
}

#[test]
fn norms_of_every_size_are_limited() {
    clipped::<f32>();
    clipped::<f64>();
    // The error of a sum does not grow with the number of its terms.
    let many = 3 << 20;
    let x = |i: usize| if i == 0 { 0.3 } else { 0.1 };
    let (norm, _) = global_norm(&[Gradient::from(Tensor::<f64>::from_fn(&[many], x))]);
    let exact = (dd(0.3) * dd(0.3) + dd(0.1) * dd(0.1) * dd((many - 1) as f64)).sqrt().0;
    assert!((norm / exact - 1.0).abs() <= 2e-14, "{norm} for {exact}");
    let mut grads = gradient::<f32>(&[4], &[1e30, -1e-18, 3e-30, f64::NAN]);
    assert_eq!(clip_value(&mut grads, 2e-30), 3);
    assert_eq!(grads[0].dense().unwrap().as_slice()[..3], [2e-30, -2e-30, 2e-30]);
    assert_eq!(clip_value(&mut gradient::<f32>(&[2], &[3e38, -3e38]), 1e39), 0);
}

fn reference() -> impl Iterator<Item = (&'static str, Vec<f64>, Vec<f64>)> {
    include_str!("../reference/formulas.txt").lines().map(|line| {
        let (name, rest) = line.split_once(' ').unwrap();
        let numbers = |text: &str| text.split_whitespace().map(|x| x.parse().unwrap()).collect();
        let (inputs, results) = rest.split_once('=').unwrap();
        (name, numbers(inputs), numbers(results))
    })
}

#[test]
fn formula_in_double_double_agrees_with_mpmath() {
    let mut count = 0;
    for (_, inputs, results) in reference().filter(|(name, ..)| *name == "adam") {
        let mut formula = Formula::new(AdamConfig { beta1: inputs[0], beta2: inputs[1], eps: inputs[2] });
        for (g, exact) in inputs[3..].iter().zip(results) {
            let [step, terms] = formula.step(*g);
            assert!((step.0 - exact).abs() <= 1e-16 * exact.abs() + 1e-28 * terms.0, "{:e} for {exact:e}", step.0);
            count += 1;
        }
    }
    assert_eq!(count, 240);
}

#[test]
fn schedules_keep_their_digits_to_the_ends() {
    let (mut worst, mut count) = (Worst(0.0, "Schedule"), 0);
    for (name, inputs, results) in reference() {
        let [from, to, warmup, every, fraction] = inputs[..5].try_into().unwrap();
        let schedule = match name {
            "linear" => Schedule::Linear { from, to, warmup },
            "exponential" => Schedule::Exponential { from, to, warmup },
            "cosine" => Schedule::Cosine { from, to, warmup },
            "step" => Schedule::Step { from, factor: to, every, warmup },
            _ => continue,
        };
        schedule.check().unwrap();
        worst.see::<f64>(schedule.lr(fraction), dd(results[0]), results[0], 0.0, 4.0, || {
            format!("{schedule:?} {fraction}")
        });
        count += 1;
    }
    assert!(count > 500, "{count}");
}

/// A stair whose power of the factor is a subnormal number, although the rate is not.
#[test]
fn small_stairs_keep_their_digits() {
    let mut worst = Worst(0.0, "Schedule::Step");
    for factor in [0.3, 0.51, 0.9, 1e-9] {
        for power in [-300.0, -310.0, -316.0, -320.0, -323.0] {
            let stairs = (power / f64::log10(factor)).floor() as u64;
            let schedule = Schedule::Step { from: 1e30, factor, every: 1.0 / stairs as f64, warmup: 0.0 };
            let half = stairs / 2;
            let exact = dd(1e30) * dd(factor).pow(half) * dd(factor).pow(stairs - half);
            worst.see::<f64>(schedule.lr(1.0), exact, exact.0, 0.0, 4.0, || format!("{factor}^{stairs}"));
        }
    }
    // As many stairs as no number holds.
    assert_eq!(Schedule::Step { from: 1.0, factor: 0.5, every: 5e-324, warmup: 0.0 }.lr(1.0), 0.0);
}

#[test]
fn long_schedules_step_where_they_should() {
    let stairs = Schedule::Step { from: 1.0, factor: 0.5, every: 0.25, warmup: 0.0 };
    for steps in [4, 1000, 1_000_000_000_000, 1 << 48] {
        for stair in 1..4_u64 {
            let at = |step| stairs.at_step(step, steps);
            let rate = 0.5_f64.powi(stair as i32);
            assert_eq!((at(stair * steps / 4 - 1), at(stair * steps / 4)), (2.0 * rate, rate), "{steps} {stair}");
        }
        let cosine = Schedule::Cosine { from: 1.0, to: 0.0, warmup: 0.0 };
        let (half, last) = (std::f64::consts::FRAC_PI_2 * 0.5 / steps as f64, cosine.at_step(steps - 1, steps));
        assert!((last / half.sin().powi(2) - 1.0).abs() < 2e-15 * steps as f64, "{steps}: {last:e}");
        let warmup = Schedule::Linear { from: 2.0, to: 2.0, warmup: 1.0 };
        assert_eq!(warmup.at_step(0, steps), 1.0 / steps as f64);
    }
}
