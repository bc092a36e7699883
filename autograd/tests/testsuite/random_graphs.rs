//! Random expressions: first and second derivatives against finite differences, whatever is combined with whatever.

use proptest::prelude::*;
use raygrad_autograd::check::{Check, check_function};
use raygrad_autograd::{Activation, Axes, Tensor, Var};

/// One step of a random program: an operation on two of the values so far.
type Step = (u8, u8, u8);

/// A value of any shape as a number within -1..1.
fn number<'t>(x: &Var<'t, f64>) -> Var<'t, f64> {
    (x.sum() * 0.1).tanh()
}

/// `b` so that it broadcasts with `a`.
fn beside<'t>(a: &Var<'t, f64>, b: &Var<'t, f64>) -> Var<'t, f64> {
    if raygrad_tensor::broadcast_shape(&[a.shape(), b.shape()]).is_some() { b.clone() } else { number(b) }
}

/// A product of matrices if both are matrices with a common extent, scaled down by it.
fn product<'t>(a: &Var<'t, f64>, b: &Var<'t, f64>, fused: bool) -> Option<Var<'t, f64>> {
    let (&[rows, columns], &[inner, width]) = (a.shape(), b.shape()) else { return None };
    let scale = 1.0 / columns.max(rows).max(1) as f64;
    if columns == inner && fused {
        return Some(a.linear(b, None, Activation::Identity) * scale);
    }
    let (ta, tb) = [(false, false), (true, false), (false, true), (true, true)].into_iter().find(|&(ta, tb)| {
        let (last, first) = (if ta { rows } else { columns }, if tb { width } else { inner });
        last == first
    })?;
    let turned = |x: &Var<'t, f64>, turn: bool| if turn { x.t() } else { x.clone() };
    Some(turned(a, ta).matmul(turned(b, tb)) * scale)
}

/// Every operation keeps its values within about -3..3, so that no depth of nesting makes differences useless.
fn step<'t>(op: u8, a: &Var<'t, f64>, b: &Var<'t, f64>) -> Var<'t, f64> {
    let axes = a.shape().len();
    match op % 22 {
        0 => (a + beside(a, b)) * 0.5,
        1 => (beside(a, b) - a) * 0.5,
        2 => (a * beside(a, b)).tanh(),
        3 => a / (beside(a, b).square() + 1.0),
        4 => a.sin(),
        5 => (a * 0.5).exp() * 0.3,
        6 => a.cos(),
        7 => a.sigmoid(),
        8 => a.softplus() * 0.5,
        9 => (a.square() + 0.5).sqrt() * 0.5,
        10 => (a.square() + 1.0).ln(),
        11 if axes > 0 => a.sum_over(Axes::from(-1).keepdims()) * 0.3,
        12 => product(a, b, false).unwrap_or_else(|| number(a)),
        13 if axes == 2 => a.permute(&[1, 0]),
        14 if axes > 0 => {
            Var::concat(&[a, &a.sin()], 0).slice_axis(0, a.shape()[0] / 2..a.shape()[0] / 2 + a.shape()[0])
        }
        15 => (a.reshape(&[a.value().len()]) * 0.9).reshape(a.shape()),
        16 if axes > 0 && a.shape()[0] > 0 => a.gather_rows([a.shape()[0] as u32 - 1, 0, 0]),
        17 if axes > 0 => a.flip(0) * 0.7,
        // A variable that is used in and beside a segment that runs again.
        18 => a.tape().checkpoint(&[a, &beside(a, b)], |x| (&x[0] * &x[1]).sin()) + a * 0.1,
        19 => a.inspect_grad(|_| ()) * 0.8,
        20 => product(a, b, true).unwrap_or_else(|| number(a)),
        21 => (a * a * 0.3).expm1() * 0.1,
        _ => number(a),
    }
}

fn run<'t>(program: &[Step], inputs: &[Var<'t, f64>]) -> Var<'t, f64> {
    let mut values = inputs.to_vec();
    for &(op, a, b) in program {
        let next = step(op, &values[usize::from(a) % values.len()], &values[usize::from(b) % values.len()]);
        values.push(next);
    }
    // Everything counts, so that no part of the program is dead.
    values[inputs.len()..].iter().fold(number(&inputs[0]), |total, x| total + number(x))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, ..ProptestConfig::default() })]

    #[test]
    fn random_graph_derivatives_match_differences(
        program in prop::collection::vec(any::<Step>(), 1..14),
        values in prop::collection::vec(-1.0..1.0_f64, 6 + 3 + 1 + 4),
    ) {
        let shapes: [&[usize]; 5] = [&[2, 3], &[3], &[], &[2, 2], &[0, 3]];
        let mut rest = &values[..];
        let inputs: Vec<_> = shapes.iter().map(|shape| {
            let (here, after) = rest.split_at(shape.iter().product());
            rest = after;
            Tensor::from_vec(shape, here.to_vec())
        }).collect();
        let report = check_function(&Check::default(), &inputs, |x| run(&program, x));
        prop_assert!(report.is_ok(), "{}", report.unwrap_err());
    }
}

#[test]
fn every_operation_of_the_programs_is_reached() {
    let tape = raygrad_autograd::Tape::new();
    let leaf = |shape: &[usize]| tape.leaf(Tensor::full(shape, 0.3));
    for op in 0..22 {
        let before = tape.len();
        let y = step(op, &leaf(&[2, 3]), &leaf(&[3, 2]));
        // Two leaves and at least one operation, whose result depends on the first of them.
        assert!(tape.len() > before + 2 && y.is_on_graph(), "operation {op}");
        assert!(y.value().as_slice().iter().all(|y| y.abs() <= 3.0), "operation {op}: {y:?}");
    }
}
