//! Operations along segments: consecutive rows that belong together, such as the samples of a ray.

use super::scan::CarriedSum;
use super::walk::walk_rows;
use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};
use std::ops::Range;
use std::sync::Arc;

/// A division of `0..rows` into consecutive segments; some may be empty. Cloning copies a reference.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Segments(Arc<[u32]>);

impl Segments {
    /// Segment `i` holds rows `offsets[i]..offsets[i + 1]`.
    ///
    /// # Panics
    /// If the offsets do not start at 0, or if they decrease.
    #[track_caller]
    pub fn new(offsets: impl Into<Arc<[u32]>>) -> Self {
        let offsets = offsets.into();
        assert_eq!(offsets.first(), Some(&0), "segment offsets start at 0");
        assert!(offsets.windows(2).all(|pair| pair[0] <= pair[1]), "segment offsets do not fall");
        Segments(offsets)
    }

    /// `count` segments of `len` rows each.
    ///
    /// # Panics
    /// If there are 2^32 rows or more.
    #[track_caller]
    pub fn uniform(count: usize, len: usize) -> Self {
        let at = |i: usize| match i.checked_mul(len).map(u32::try_from) {
            Some(Ok(row)) => row,
            _ => panic!("{count} segments of {len} rows are 2^32 rows or more"),
        };
        Segments((0..=count).map(at).collect())
    }

    /// Number of segments.
    pub fn len(&self) -> usize {
        self.0.len() - 1
    }

    /// Whether there is no segment.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of rows in all segments.
    pub fn rows(&self) -> usize {
        self.0[self.len()] as usize
    }

    /// The rows of segment `i`.
    ///
    /// # Panics
    /// If there is no segment `i`.
    #[inline]
    pub fn range(&self, i: usize) -> Range<usize> {
        self.0[i] as usize..self.0[i + 1] as usize
    }

    /// The rows of each segment, in order.
    pub fn ranges(&self) -> impl ExactSizeIterator<Item = Range<usize>> + '_ {
        (0..self.len()).map(|i| self.range(i))
    }

    /// The offsets: segment `i` holds rows `offsets[i]..offsets[i + 1]`.
    pub fn offsets(&self) -> &[u32] {
        &self.0
    }

    fn check(&self, x: &[usize], rows: usize) -> Result<(), ShapeError> {
        match x.first() {
            Some(&extent) if extent == rows => Ok(()),
            _ => Err(format!("{} segments of {} rows need {rows} along the first axis", self.len(), self.rows())),
        }
    }
}

/// The first extent replaced.
fn with_rows(shape: &[usize], rows: usize) -> Shape {
    let mut out = Shape::from_slice(shape);
    out[0] = rows;
    out
}

/// y[i] = sum of the rows of segment i; dx = [`SegmentExpand`] of g.
#[derive(Clone)]
pub struct SegmentSum(
    /// The segments.
    pub Segments,
);

impl<T: Scalar> Op<T> for SegmentSum {
    fn name(&self) -> &'static str {
        "segment_sum"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        self.0.check(x[0], self.0.rows())?;
        Ok(with_rows(x[0], self.0.len()))
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let width: usize = x[0].shape()[1..].iter().product();
        let mut out = pool.tensor(&with_rows(x[0].shape(), self.0.len()));
        for (out, rows) in out.as_mut_slice().chunks_exact_mut(width.max(1)).zip(self.0.ranges()) {
            raygrad_tensor::sum_rows(&x[0].as_slice()[rows.start * width..rows.end * width], out);
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.g().segment_expand(&self.0))
    }
}

/// y = row i of x at every row of segment i; dx = [`SegmentSum`] of g.
#[derive(Clone)]
pub struct SegmentExpand(
    /// The segments.
    pub Segments,
);

impl<T: Scalar> Op<T> for SegmentExpand {
    fn name(&self) -> &'static str {
        "segment_expand"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        self.0.check(x[0], self.0.len())?;
        Ok(with_rows(x[0], self.0.rows()))
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let width: usize = x[0].shape()[1..].iter().product();
        let mut out = pool.tensor(&with_rows(x[0].shape(), self.0.rows()));
        if width > 0 {
            for (x, rows) in x[0].as_slice().chunks_exact(width).zip(self.0.ranges()) {
                for out in out.as_mut_slice()[rows.start * width..rows.end * width].chunks_exact_mut(width) {
                    out.copy_from_slice(x);
                }
            }
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.g().segment_sum(&self.0))
    }
}

/// y = the cumulative sum of x within each segment, in twice the digits of f32 or f64. The adjoint runs the other way.
#[derive(Clone)]
pub struct SegmentCumsum {
    /// The segments.
    pub segments: Segments,
    /// Whether a row's sum leaves out its own value.
    pub exclusive: bool,
    /// Whether to run from the last row of a segment to the first.
    pub reverse: bool,
}

impl SegmentCumsum {
    fn sums<S: CarriedSum, T: Scalar>(&self, width: usize, x: &[T], y: &mut [T]) {
        walk_rows(self.segments.ranges(), width, self.reverse, S::default(), |sum, i| {
            let before = *sum;
            *sum = sum.plus(x[i].to_f64());
            y[i] = T::from_f64(if self.exclusive { before } else { *sum }.value());
        });
    }
}

impl<T: Scalar> Op<T> for SegmentCumsum {
    fn name(&self) -> &'static str {
        "segment_cumsum"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        self.segments.check(x[0], self.segments.rows())?;
        Ok(Shape::from_slice(x[0]))
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let width: usize = x[0].shape()[1..].iter().product();
        let mut out = pool.tensor(x[0].shape());
        let (x, y) = (x[0].as_slice(), out.as_mut_slice());
        if T::EPSILON > 1e-10 {
            self.sums::<f64, T>(width, x, y)
        } else {
            self.sums::<[f64; 2], T>(width, x, y)
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let adjoint = SegmentCumsum { reverse: !self.reverse, ..self.clone() };
        Grads::one(cx.tape().apply(adjoint, &[cx.g()]))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// Sums the rows of each segment: `[rows, ..]` to `[segments, ..]`.
    ///
    /// # Panics
    /// If the first extent is not the number of rows.
    #[track_caller]
    pub fn segment_sum(&self, segments: &Segments) -> Self {
        self.tape().apply(SegmentSum(segments.clone()), &[self])
    }

    /// Repeats row `i` at every row of segment `i`: `[segments, ..]` to `[rows, ..]`.
    ///
    /// # Panics
    /// If the first extent is not the number of segments.
    #[track_caller]
    pub fn segment_expand(&self, segments: &Segments) -> Self {
        self.tape().apply(SegmentExpand(segments.clone()), &[self])
    }

    /// The cumulative sum along the rows of each segment. With `exclusive`, a row's sum leaves out its own value.
    ///
    /// # Panics
    /// If the first extent is not the number of rows.
    #[track_caller]
    pub fn segment_cumsum(&self, segments: &Segments, exclusive: bool) -> Self {
        self.tape().apply(SegmentCumsum { segments: segments.clone(), exclusive, reverse: false }, &[self])
    }
}
