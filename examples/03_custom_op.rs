//! A custom operation, and the check that finds errors in it.
//!
//! ```text
//! cargo run --release --example 03_custom_op
//! ```

use raygrad::check::{Cases, Check, Entry, check_op};
use raygrad::{Formula, Real, Tape, Tensor, formula};

/// The soft sign, y = x / (1 + |x|), with a gradient by hand that may have a mistake in it; dx = g / (1 + |x|)^2.
///
/// A formula needs none: left out, it follows from the formula. By hand it may be faster or keep more digits.
#[derive(Clone, Copy)]
struct SoftSign {
    mistake: Mistake,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Mistake {
    None,
    Sign,
    Square,
    Naive,
}

impl Formula<1> for SoftSign {
    const NAME: &'static str = "softsign";

    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x / (x.like(1.0) + x.abs())
    }

    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [x]: [E; 1], _y: E) -> [E; 1] {
        let width = x.like(1.0) + x.abs();
        [match self.mistake {
            Mistake::None => g / width / width,
            Mistake::Sign => -(g / width / width),
            Mistake::Square => g / width,
            // The same in theory, but the cube overflows.
            Mistake::Naive => g * width / (width * width * width),
        }]
    }
}

fn main() {
    // It runs as any other operation does, and has derivatives of every order. An `Op` with a gradient on plain tensors
    // has them only with a `reference`; without one, `grad_graph` is an error and never 0.
    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::from([-1.0, 0.5, 3.0]));
    let y = SoftSign { mistake: Mistake::None }.on([&x]);
    let slope = y.sum().grad_graph(&[&x]).remove(0);
    println!("y      {}", y.value());
    println!("slope  {}", slope.value());
    println!("bend   {}", slope.sum().grad(&[&x])[0]);

    // In a line, of several operands that broadcast: one pass forward, and one that gives both gradients.
    let width = tape.leaf(Tensor::scalar(2.0));
    let grads = formula!(|x, w| x / (w + x.abs())).on([&x, &width]).sum().grad(&[&x, &width]);
    println!("by x   {}\nby w   {}\n", grads[0], grads[1]);

    // Sampled on both sides of its kink, and at extremes: there is no tolerance for a NaN.
    let mut cases = Cases::default();
    cases.domain(-3.0..-0.1).domain_also(0.1..3.0);
    cases.at([0.0], 0.0, [1.0]).at([1e15], 1.0, [1e-30]).at([-f64::INFINITY], f64::NAN, [0.0]);
    for mistake in [Mistake::None, Mistake::Sign, Mistake::Square, Mistake::Naive] {
        match check_op(&Check::default(), &Entry::formula(SoftSign { mistake }, &cases)) {
            Ok(report) => println!(
                "{mistake:?}: {} checks passed; worst errors {:.0e} (first order), {:.0e} (second), {:.1} ULP in f32",
                report.comparisons, report.first_order, report.second_order, report.ulps
            ),
            Err(error) => println!("{mistake:?}: {error}"),
        }
    }
}
