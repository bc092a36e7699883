//! A curve through noisy points: the parameters of a damped oscillation, and from the curvature of the loss how well the
//! data determine them.
//!
//! ```text
//! cargo run --release --example 04_curve_fit
//! ```

use rand::SeedableRng;
use rand::rngs::StdRng;
use raygrad::{Adam, AdamConfig, Optimizer, Params, Schedule, Tape, Tensor, Var, derivatives::hvp};

const POINTS: usize = 200;
const STEPS: u64 = 3000;
const NAMES: [&str; 4] = ["amplitude", "damping", "frequency", "phase"];
const TRUTH: [f64; 4] = [1.5, 0.3, 2.4, 0.6];
/// Standard deviation of the noise.
const NOISE: f64 = 0.05;

/// `a e^(-d t) cos(f t + p)` for parameters `[a, d, f, p]`.
fn oscillation<'t>(parameters: &Var<'t, f64>, t: &Var<'t, f64>) -> Var<'t, f64> {
    let part = |i| parameters.slice_axis(0, i..i + 1);
    part(0) * (-(part(1) * t)).exp() * (part(2) * t + part(3)).cos()
}

/// The standard deviation of each parameter: the roots of the diagonal of `2 NOISE^2 H^-1`, with the Hessian of the sum of
/// squares. Each column of the inverse is found by conjugate gradients, which need only products with the Hessian.
fn deviations(loss: impl for<'t> Fn(&[Var<'t, f64>]) -> Var<'t, f64>, at: &Tensor<f64>) -> Vec<f64> {
    let column = |i: usize| {
        let mut solution = Tensor::zeros(at.shape());
        let mut residual = Tensor::zeros(at.shape());
        residual[[i]] = 1.0;
        let mut direction = residual.clone();
        for _ in 0..2 * at.len() {
            let image = hvp(&loss, std::slice::from_ref(at), std::slice::from_ref(&direction)).remove(0);
            let square = residual.dot(&residual);
            let step = square / direction.dot(&image);
            solution += &(step * &direction);
            residual -= &(step * &image);
            let left = residual.dot(&residual);
            if left < 1e-24 {
                break;
            }
            direction = &residual + left / square * direction;
        }
        (2.0 * NOISE * NOISE * solution[[i]]).sqrt()
    };
    (0..at.len()).map(column).collect()
}

fn main() {
    let mut rng = StdRng::seed_from_u64(1);
    let t = Tensor::from_fn(&[POINTS], |i| i as f64 * 8.0 / POINTS as f64);
    let tape = Tape::new();
    let exact = oscillation(&tape.constant(Tensor::from(TRUTH)), &tape.constant(t.clone()));
    let data = exact.value() + &Tensor::normal(&[POINTS], 0.0, NOISE, &mut rng);

    let mut params = Params::<f64>::new();
    let id = params.add("oscillation", Tensor::from([1.0, 0.1, 2.0, 0.0]));
    let mut adam = Adam::new(AdamConfig::default());
    let schedule = Schedule::Cosine { from: 2e-2, to: 0.0, warmup: 0.0 };
    for step in 0..STEPS {
        let tape = Tape::new();
        let bound = params.bind(&tape);
        let curve = oscillation(&bound[id], &tape.constant(t.clone()));
        let loss = curve.mse_loss(&data);
        if step % (STEPS / 5) == 0 {
            println!("step {step:4}: off by {:.4} (root mean square)", loss.item().sqrt());
        }
        let grads = bound.backward(&loss);
        adam.update(&mut params, &grads, schedule.at_step(step, STEPS)).check().expect("finite gradients");
    }

    let found = params.get(id).clone();
    let errors = deviations(
        |x| {
            let tape = x[0].tape();
            oscillation(&x[0], &tape.constant(t.clone())).squared_error(&data).sum()
        },
        &found,
    );
    println!("\n{:<10} {:>8} {:>19}", "", "truth", "found");
    for i in 0..4 {
        println!("{:<10} {:>8.4} {:>9.4} +- {:.4}", NAMES[i], TRUTH[i], found[[i]], errors[i]);
    }
}
