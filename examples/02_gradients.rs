//! Gradients, gradients of gradients, Jacobians and Hessians, next to what calculus says.
//!
//! ```text
//! cargo run --release --example 02_gradients
//! ```

use raygrad::check::{Check, check_function};
use raygrad::{
    Tape, Tensor, Var,
    derivatives::{hessian, hvp, jacobian},
};

/// From polar coordinates `[r, phi]` to `[x, y]`.
fn cartesian<'t>(polar: &[Var<'t, f64>]) -> Var<'t, f64> {
    let (r, phi) = (polar[0].slice_axis(0, ..1), polar[0].slice_axis(0, 1..2));
    Var::concat(&[&(&r * phi.cos()), &(&r * phi.sin())], 0)
}

fn main() {
    // One gradient: d/dx of x sin x is sin x + x cos x.
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::from([0.5, 1.0, 2.0]));
    let y = &x * x.sin();
    let slope = y.sum().grad_graph(&[&x]).remove(0);
    println!("x          {}", x.value());
    println!("y'         {:.12}", slope.value());
    println!("expected   {:.12}", x.value().map(|x| x.sin() + x * x.cos()));

    // The gradient is on the tape like anything else, so it has a gradient; and so on.
    let mut derivative = slope;
    for order in 2..=4 {
        derivative = derivative.sum().grad_graph(&[&x]).remove(0);
        println!("order {order}    {:.12}", derivative.value());
    }
    println!("expected   {:.12}", x.value().map(|x| x * x.sin() - 4.0 * x.cos()));

    // Derivatives of functions. The Jacobian of polar coordinates has the determinant r.
    let polar = Tensor::from([3.0, 0.7]);
    let j = jacobian(cartesian, std::slice::from_ref(&polar)).remove(0);
    println!("\nJacobian\n{j:.6}");
    println!("determinant {:.12} for r = 3", j[[0, 0]] * j[[1, 1]] - j[[0, 1]] * j[[1, 0]]);

    // A Hessian, and its product with a vector, which costs no more for a million inputs than a few gradients.
    let point = Tensor::from([1.0, 2.0]);
    let h = hessian(|x| x[0].square().sum().square(), std::slice::from_ref(&point)).remove(0).remove(0);
    println!("\nHessian of |x|^4 at (1, 2)\n{h}");
    let v = Tensor::from([1.0, -1.0]);
    let product = hvp(|x| x[0].square().sum().square(), &[point], &[v]).remove(0);
    println!("times (1, -1)                {product}");

    // And the check that all of this is right: finite differences of first and second order.
    let report = check_function(&Check::default(), &[polar], cartesian).expect("the derivatives are right");
    println!("\nchecked against differences: {:.0e} and {:.0e}", report.first_order, report.second_order);
}
