//! An operation of one's own, and the examination that finds out what is wrong with it.
//!
//! ```text
//! cargo run --release --example 03_custom_op
//! ```

use raygrad::autograd::{Cases, Check, Entry, Map, Reads, Real, Tape, Tensor, Unary, check_op};

/// The soft sign, y = x / (1 + |x|), with a gradient that may have a mistake in it; dx = g / (1 + |x|)^2.
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

impl Unary for SoftSign {
    const NAME: &'static str = "softsign";
    /// The gradient reads the input, so the tape keeps it.
    const READS: Reads = Reads::INPUTS;

    #[inline(always)]
    fn f<E: Real>(&self, x: E) -> E {
        let one = x.like(1.0);
        x.clone() / (one + x.abs())
    }

    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, x: E, _y: E) -> E {
        let width = x.like(1.0) + x.abs();
        match self.mistake {
            Mistake::None => g / width.clone() / width,
            Mistake::Sign => -(g / width.clone() / width),
            Mistake::Square => g / width,
            // The same in theory, but the square overflows.
            Mistake::Naive => g * width.clone() / (width.clone() * width.clone() * width),
        }
    }

    fn cases(&self, cases: &mut Cases) {
        // Sampled on both sides of its kink, and at extremes: there is no tolerance for a NaN.
        cases.domain(-3.0..-0.1).domain_also(0.1..3.0);
        cases.at([0.0], 0.0, [1.0]).at([1e15], 1.0, [1e-30]).at([-f64::INFINITY], f64::NAN, [0.0]);
    }
}

fn main() {
    // It runs as any other operation does, and has derivatives of every order, since its formulas record themselves.
    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::from_vec(&[3], vec![-1.0, 0.5, 3.0]));
    let y = tape.apply(Map(SoftSign { mistake: Mistake::None }), &[&x]);
    let slope = y.sum().grad_graph(&[&x]).remove(0);
    println!("y      {:?}", y.value().as_slice());
    println!("slope  {:?}", slope.value().as_slice());
    println!("bend   {:?}\n", slope.sum().grad(&[&x])[0].as_slice());

    for mistake in [Mistake::None, Mistake::Sign, Mistake::Square, Mistake::Naive] {
        match check_op(&Check::default(), &Entry::unary(SoftSign { mistake })) {
            Ok(report) => println!(
                "{mistake:?}: {} checks passed; worst errors {:.0e} (first order), {:.0e} (second), {:.1} ULP in f32",
                report.comparisons, report.first_order, report.second_order, report.ulps
            ),
            Err(error) => println!("{mistake:?}: {error}"),
        }
    }
}
