//! Walks along an axis, in either direction.

use crate::{ShapeError, Var};
use raygrad_tensor::{Scalar, Shape};
use std::ops::Range;

/// The order in which a scan walks an axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Walk {
    /// The axis.
    pub axis: usize,
    /// Whether to walk from the last entry to the first.
    pub reverse: bool,
}

impl Walk {
    /// The other direction.
    pub fn back(self) -> Self {
        Walk { reverse: !self.reverse, ..self }
    }

    /// Returns the shape of the result: that of the operand.
    pub fn check(&self, x: &[usize]) -> Result<Shape, ShapeError> {
        if self.axis < x.len() { Ok(Shape::from_slice(x)) } else { Err(format!("there is no axis {}", self.axis)) }
    }

    /// Calls `f(state, i)` for every element in the order of the walk. Each line along the axis has one state, which
    /// starts as `start`. States are wider than the type, so they are not rounded to it.
    #[inline(always)]
    pub fn run<S: Copy>(self, shape: &[usize], start: S, mut f: impl FnMut(&mut S, usize)) {
        let (count, inner) = (shape[self.axis], shape[self.axis + 1..].iter().product::<usize>());
        let outer: usize = shape[..self.axis].iter().product();
        if inner == 1 {
            // Several lines side by side: in one, each entry waits for the entry before.
            const LINES: usize = 8;
            let mut lines = |first: usize, states: &mut [S]| {
                for step in 0..count {
                    let entry = if self.reverse { count - 1 - step } else { step };
                    for (k, state) in states.iter_mut().enumerate() {
                        f(state, (first + k) * count + entry);
                    }
                }
            };
            let whole = outer - outer % LINES;
            (0..whole).step_by(LINES).for_each(|first| lines(first, &mut [start; LINES]));
            (whole..outer).for_each(|line| lines(line, &mut [start]));
            return;
        }
        walk_rows((0..outer).map(|o| o * count..(o + 1) * count), inner, self.reverse, start, f);
    }

    /// Entry `i` of the result is the entry that the walk passes before `i` (after it with `next`), and `fill` at the
    /// end.
    pub fn neighbour<'t, T: Scalar>(self, x: &Var<'t, T>, next: bool, fill: f64) -> Var<'t, T> {
        let axis = self.axis as isize;
        if x.shape()[self.axis] == 0 {
            return x.clone();
        }
        let mut shape = Shape::from_slice(x.shape());
        shape[self.axis] = 1;
        let end = x.tape().constant(x.tape().pool().full(&shape, T::from_f64(fill)));
        if self.reverse == next {
            Var::concat(&[&end, &x.slice_axis(axis, ..-1)], axis)
        } else {
            Var::concat(&[&x.slice_axis(axis, 1..), &end], axis)
        }
    }
}

/// Calls `f(state, i)` for every element of these ranges of rows, with `inner` elements in a row. It walks from the
/// first row of a range to the last, or in `reverse`. Each column of a range has a state that starts as `start`.
#[inline(always)]
pub(super) fn walk_rows<S: Copy>(
    ranges: impl Iterator<Item = Range<usize>>,
    inner: usize,
    reverse: bool,
    start: S,
    mut f: impl FnMut(&mut S, usize),
) {
    let mut states = vec![start; inner];
    // Without columns there may be any number of rows.
    if inner == 0 {
        return;
    }
    for rows in ranges {
        states.fill(start);
        for step in 0..rows.len() {
            let row = if reverse { rows.end - 1 - step } else { rows.start + step };
            for (j, state) in states.iter_mut().enumerate() {
                f(state, row * inner + j);
            }
        }
    }
}
