//! Newton's method for a function of many variables without ever writing down its Hessian: conjugate gradients need only
//! products with it, which cost a few gradients each. Rosenbrock's curved valley, where gradient descent crawls.
//!
//! ```text
//! cargo run --release --example 07_newton
//! ```

use raygrad::{Tape, Tensor, Var, derivatives::value_and_grad};

const DIMENSIONS: usize = 100;

/// The sum of `100 (x[i + 1] - x[i]^2)^2 + (1 - x[i])^2`; 0 where all are 1.
fn rosenbrock<'t>(x: &Var<'t, f64>) -> Var<'t, f64> {
    let (head, tail) = (x.slice_axis(0, 0..DIMENSIONS - 1), x.slice_axis(0, 1..1 + DIMENSIONS - 1));
    (100.0 * (tail - head.square()).square() + (1.0 - head).square()).sum()
}

/// Value, gradient, Newton's direction `-H^-1 g` as far as the curvature along the way is positive, and the number of
/// products with the Hessian that it took.
fn newton(x: &Tensor<f64>) -> (f64, Tensor<f64>, Tensor<f64>, usize) {
    let tape = Tape::new();
    let x = tape.leaf(x.clone());
    let y = rosenbrock(&x);
    // Recorded once; a product with the Hessian is the gradient of its gradient along a direction.
    let slope = y.grad_graph(&[&x]).remove(0);
    let g = slope.value().clone();
    let mut solution = Tensor::zeros(g.shape());
    let mut residual = -&g;
    let mut direction = residual.clone();
    // Loose far away, tight close to the minimum: fast convergence in the end.
    let size = g.norm();
    let enough = size * size.sqrt().min(0.1);
    for products in 0..2 * g.len() {
        let square = residual.dot(&residual);
        if square.sqrt() <= enough {
            return (y.item(), g, solution, products);
        }
        let along = tape.constant(direction.clone());
        let image = tape.no_grad(|| slope.vjp(&along, &[&x])).remove(0).into_value();
        let curvature = direction.dot(&image);
        if curvature <= 0.0 {
            // Downhill without end: go along what there is, or straight down.
            let solution = if products == 0 { direction } else { solution };
            return (y.item(), g, solution, products + 1);
        }
        let step = square / curvature;
        solution += &(step * &direction);
        residual -= &(step * &image);
        direction = &residual + residual.dot(&residual) / square * direction;
    }
    let products = 2 * g.len();
    (y.item(), g, solution, products)
}

fn value(x: Tensor<f64>) -> f64 {
    let tape = Tape::new();
    rosenbrock(&tape.constant(x)).item()
}

fn main() {
    // With the first variable near -1 there is a second valley with a minimum of its own.
    let start = Tensor::zeros(&[DIMENSIONS]);
    println!("Rosenbrock's function of {DIMENSIONS} variables");
    let (mut x, mut products) = (start.clone(), 0);
    for iteration in 0..200 {
        let (y, g, direction, used) = newton(&x);
        products += used;
        let size = g.norm();
        if iteration % 10 == 0 || size < 1e-6 {
            println!("  iteration {iteration:3}: value {y:9.2e}, gradient {size:8.1e}, {products} Hessian products");
        }
        if size < 1e-10 {
            break;
        }
        // Half as far until the value falls enough (Armijo).
        let slope = g.dot(&direction);
        let mut h = 1.0;
        while value(&x + h * &direction) > y + 1e-4 * h * slope && h > 1e-12 {
            h *= 0.5;
        }
        x += &(h * &direction);
    }
    let farthest = x.max_abs_diff(&Tensor::ones(x.shape()));
    println!("  all variables are 1 within {farthest:.0e}");
    assert!(farthest < 1e-6, "another minimum, or none");

    let mut x = start;
    let steps = 20_000;
    for _ in 0..steps {
        let (_, g) = value_and_grad(|x| rosenbrock(&x[0]), std::slice::from_ref(&x));
        x -= &(5e-4 * &g[0]);
    }
    println!("Gradient descent for comparison, {steps} steps: value {:.2e}", value(x));
}
