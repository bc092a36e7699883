//! The encoding as an operation.

use super::kernel::{BLOCK, Cells, Points};
use super::{HashGrad, HashGrid, HashLevel};
#[cfg(any(test, feature = "check"))]
use raygrad_autograd::check::Entry;
use raygrad_autograd::{Grads, Op, Pool, Real, RowSums, Scalar, Shape, ShapeError, Tensor, Var, Vjp};
use raygrad_tensor::simd;
use std::mem::swap;
use std::sync::Arc;

/// Calls `$self.$method::<F>(..)` with the grid's number of features as `F`.
macro_rules! with_features {
    ($grid:expr, $method:ident($($argument:expr),*)) => {
        match $grid.features() {
            1 => $grid.$method::<_, 1>($($argument),*),
            2 => $grid.$method::<_, 2>($($argument),*),
            4 => $grid.$method::<_, 4>($($argument),*),
            8 => $grid.$method::<_, 8>($($argument),*),
            16 => $grid.$method::<_, 16>($($argument),*),
            32 => $grid.$method::<_, 32>($($argument),*),
            _ => unreachable!("`HashGrid::new` allows powers of two from 1 to 32"),
        }
    };
}

impl HashGrid {
    /// Writes the features of `positions` (`[samples, 3]`, clamped to the unit cube) to `out` (`[samples, width]`).
    pub(super) fn encode<T: Scalar>(&self, positions: &[T], table: &[T], out: &mut [T]) {
        with_features!(self, encode_rows(positions, table, out))
    }

    fn encode_rows<T: Scalar, const F: usize>(&self, positions: &[T], table: &[T], out: &mut [T]) {
        assert_eq!(table.len(), self.rows() * F, "the table must have the grid's rows");
        let (table, _) = table.as_chunks::<F>();
        let (levels, width) = (self.levels(), self.width());
        simd::dispatch(
            #[inline(always)]
            || {
                let mut points = Points::new();
                let (mut cells, mut next) = (&mut Cells::new(), &mut Cells::new());
                for (positions, out) in positions.chunks(3 * BLOCK).zip(out.chunks_mut(width * BLOCK)) {
                    points.load(positions);
                    cells.locate(&levels[0], &points);
                    for (l, level) in levels.iter().enumerate() {
                        if let Some(finer) = levels.get(l + 1) {
                            next.locate(finer, &points);
                            next.prefetch(&table[finer.rows.clone()]);
                        }
                        cells.gather(&table[level.rows.clone()], out, width, l * F);
                        swap(&mut cells, &mut next);
                    }
                }
            },
        );
    }

    /// Adds the gradient of one level's rows to `grad`, in the order of the samples.
    ///
    /// `positions` are `[samples, 3]`, `d_out` `[samples, width]` is the gradient of their encoding. Samples whose
    /// gradients on this level are all at most `cut` in magnitude add nothing; with a `cut` of 0 these are the zeros. For
    /// the others, a NaN coordinate gives NaN.
    ///
    /// # Panics
    /// If `level` is out of range or a length does not fit.
    #[track_caller]
    pub fn scatter_level<T: Scalar>(&self, level: usize, positions: &[T], d_out: &[T], cut: T, grad: &mut RowSums<T>) {
        let (rows, samples) = (self.levels()[level].rows.len(), positions.len() / 3);
        assert_eq!(positions.len(), 3 * samples, "positions must be [samples, 3]");
        assert_eq!(d_out.len(), samples * self.width(), "gradients must be [{samples}, width]");
        assert_eq!(grad.table_rows(), rows, "sums must have the rows of level {level}");
        with_features!(self, scatter_rows(level, positions, d_out, cut, grad))
    }

    fn scatter_rows<T: Scalar, const F: usize>(
        &self,
        level: usize,
        positions: &[T],
        d_out: &[T],
        cut: T,
        grad: &mut RowSums<T>,
    ) {
        let mut grad = grad.of_width::<F>();
        let (width, column) = (self.width(), level * F);
        simd::dispatch(
            #[inline(always)]
            || {
                let mut points = Points::new();
                let (mut cells, mut next) = (&mut Cells::new(), &mut Cells::new());
                let mut blocks = positions.chunks(3 * BLOCK);
                let level = &self.levels()[level];
                if let Some(first) = blocks.next() {
                    points.load(first);
                    cells.locate(level, &points);
                }
                for d_out in d_out.chunks(width * BLOCK) {
                    if let Some(block) = blocks.next() {
                        points.load(block);
                        next.locate(level, &points);
                        next.prefetch_sums(&grad);
                    }
                    cells.scatter(d_out, width, column, cut, &mut grad);
                    swap(&mut cells, &mut next);
                }
            },
        );
    }

    /// Adds to `grad` (`[samples, 3]`) the gradient of `positions` for the output gradient `d_out` (`[samples,
    /// width]`).
    pub(super) fn slopes<T: Scalar>(&self, positions: &[T], table: &[T], d_out: &[T], grad: &mut [T]) {
        with_features!(self, slope_rows(positions, table, d_out, grad))
    }

    fn slope_rows<T: Scalar, const F: usize>(&self, positions: &[T], table: &[T], d_out: &[T], grad: &mut [T]) {
        let (table, _) = table.as_chunks::<F>();
        let width = self.width();
        simd::dispatch(
            #[inline(always)]
            || {
                let (mut points, mut cells) = (Points::new(), Cells::new());
                let gradients = d_out.chunks(width * BLOCK).zip(grad.chunks_mut(3 * BLOCK));
                for (positions, (d_out, grad)) in positions.chunks(3 * BLOCK).zip(gradients) {
                    points.load(positions);
                    for (l, level) in self.levels().iter().enumerate() {
                        cells.locate(level, &points);
                        let scale = T::from_f64(f64::from(level.resolution));
                        cells.slopes(&table[level.rows.clone()], d_out, width, l * F, scale, grad);
                    }
                    for (grad, &x) in grad.iter_mut().zip(positions) {
                        // Outside of the cube the features are constant.
                        *grad = if x < T::ZERO || x > T::ONE { T::ZERO } else { *grad };
                    }
                }
            },
        );
    }
}

/// The operation of the hash encoding: features of positions on all levels, interpolated trilinearly within cells.
///
/// Inputs are positions `[samples, 3]` in the unit cube and the table `[rows, features]`; the output is
/// `[samples, levels * features]`, coarsest level first. On a level of `N` cells per side, `x N` lies in the cell
/// `min(floor(x N), N - 1)`.
///
/// Positions outside of the cube are clamped, with gradient 0 along the clamped axes. A NaN coordinate makes the
/// sample's features NaN. The gradient of a position jumps between cells; there it is that of the upper cell.
#[derive(Debug, Clone)]
pub struct HashEncoding {
    grid: HashGrid,
    gradient_cut: f64,
}

impl HashEncoding {
    /// The encoding by `grid`, with its exact gradient.
    pub fn new(grid: HashGrid) -> Self {
        HashEncoding { grid, gradient_cut: 0.0 }
    }

    /// The encoding whose table gets no gradient from samples where that of a level's features is small: at most
    /// `gradient_cut` times its root mean square, over the samples and features of a call of the operation.
    ///
    /// The dropped gradient of the features is at most that share of the whole, in the Euclidean norm; a row loses at most
    /// that root mean square times `gradient_cut` and its number of samples. Where many small gradients agree and large
    /// ones cancel, a row may lose most of its sum.
    ///
    /// It makes training faster, since an optimizer such as Adam moves a row by about the same length however small its
    /// gradient is. Gradients that can be differentiated again, and those of the positions, are exact.
    ///
    /// # Panics
    /// If `gradient_cut` is not 0 to 1.
    #[must_use]
    #[track_caller]
    pub fn with_gradient_cut(self, gradient_cut: f64) -> Self {
        assert!((0.0..=1.0).contains(&gradient_cut), "a gradient cut of {gradient_cut}; use 0 to 1");
        HashEncoding { gradient_cut, ..self }
    }

    /// The grid.
    pub fn grid(&self) -> &HashGrid {
        &self.grid
    }

    /// The largest gradient of each level that is dropped.
    pub(super) fn cuts<T: Scalar>(&self, d_out: &[T]) -> Vec<T> {
        let (width, features) = (self.grid.width(), self.grid.features());
        if self.gradient_cut == 0.0 {
            return vec![T::ZERO; self.grid.levels().len()];
        }
        let mut squares = vec![0.0; width];
        for row in d_out.chunks_exact(width) {
            for (sum, x) in squares.iter_mut().zip(row) {
                *sum += x.to_f64() * x.to_f64();
            }
        }
        let values = (d_out.len() / width * features) as f64;
        let cut = |squares: &[f64]| self.gradient_cut * (squares.iter().sum::<f64>() / values).sqrt();
        // Beyond the range nothing is dropped.
        let cuts = squares.chunks_exact(features).map(cut).map(|cut| if cut.is_finite() { cut } else { 0.0 });
        cuts.map(T::from_f64).collect()
    }
}

impl<T: Scalar> Op<T> for HashEncoding {
    fn name(&self) -> &'static str {
        "hash_encoding"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let table = [self.grid.rows(), self.grid.features()];
        match x[0] {
            &[samples, 3] if x[1] == table => Ok([samples, self.grid.width()].into_iter().collect()),
            _ => Err(format!("positions must be [samples, 3] and the table {table:?}")),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(&[x[0].shape()[0], self.grid.width()]);
        self.grid.encode(x[0].as_slice(), x[1].as_slice(), out.as_mut_slice());
        out
    }

    fn is_cacheable(&self) -> bool {
        true
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (positions, table) = (cx.x(0).into_value(), cx.x(1).into_value());
        let d_out = cx.g().value().clone();
        let d_positions = cx.needs(0).then(|| {
            let mut grad = cx.pool().full(positions.shape(), T::ZERO);
            self.grid.slopes(positions.as_slice(), table.as_slice(), d_out.as_slice(), grad.as_mut_slice());
            cx.constant(grad)
        });
        let grads = Grads::new([d_positions, None]);
        if !cx.needs(1) {
            return grads;
        }
        let cuts = self.cuts(d_out.as_slice());
        grads.with_sparse(1, Arc::new(HashGrad { grid: self.grid.clone(), positions, d_out, cuts }))
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let levels: Vec<_> = self.grid.levels().iter().map(|level| reference_level(level, &x[0], &x[1])).collect();
        Some(Var::concat(&levels.iter().collect::<Vec<_>>(), 1))
    }
}

/// The features of one level, `[samples, features]`, from plain operations. The choice of the cell alone is constant.
fn reference_level<'t, T: Scalar>(level: &HashLevel, x: &Var<'t, T>, table: &Var<'t, T>) -> Var<'t, T> {
    let (tape, values) = (x.tape(), x.value());
    let column = |f: &dyn Fn(T) -> T, axis: usize| {
        tape.constant(Tensor::from_fn(&[values.shape()[0], 1], |i| f(values.as_slice()[3 * i + axis])))
    };
    let scale = f64::from(level.resolution);
    // The conversion turns NaN into 0.
    let cell = |x: T| {
        let clamped = Real::minimum(Real::maximum(x, T::ZERO), T::ONE);
        ((clamped * T::from_f64(scale)).to_f64() as u32).min(level.resolution - 1)
    };
    let place: [Var<'t, T>; 3] = std::array::from_fn(|axis| {
        let inside = column(&|x| if x < T::ZERO || x > T::ONE { T::ZERO } else { T::ONE }, axis);
        let clamped =
            x.slice_axis(1, axis..axis + 1) * inside + column(&|x| if x > T::ONE { T::ONE } else { T::ZERO }, axis);
        clamped * scale - column(&|x| T::from_f64(cell(x).into()), axis)
    });
    let corner = |corner: u32| {
        let side = |axis: usize| corner >> axis & 1;
        let row = |x: &[T]| level.row(std::array::from_fn(|axis| cell(x[axis]) + side(axis)));
        let rows = values.as_slice().chunks_exact(3).map(|x| level.rows.start as u32 + row(x));
        let weight = |axis: usize| if side(axis) == 1 { place[axis].clone() } else { 1.0 - &place[axis] };
        table.gather_rows(rows.collect::<Vec<_>>()) * (weight(0) * (weight(1) * weight(2)))
    };
    (1..8).fold(corner(0), |sum, k| sum + corner(k))
}

/// The catalogue entries of this file: dense and hashed levels, with positions that stay within their cells in all
/// checks.
#[cfg(any(test, feature = "check"))]
pub(crate) fn entries() -> Vec<Entry> {
    let entry = |levels, features, log2_table, coarsest, finest| {
        let config = super::HashGridConfig { levels, features, log2_table, coarsest, finest };
        HashGrid::new(&config).ok().map(|grid| {
            let table = |seed: u64| {
                let tiny = grid.init::<f64>(seed);
                Tensor::from_fn(tiny.shape(), |i| 1e4 * tiny.as_slice()[i])
            };
            let positions = |values: &[f64]| Tensor::from_vec(&[values.len() / 3, 3], values.to_vec());
            Entry::new(HashEncoding::new(grid.clone()))
                .sample_of(vec![positions(&[0.11, 0.53, 0.92, 0.42, 0.07, 0.28, 0.46, 0.22, 0.71]), table(1)])
                .sample_of(vec![positions(&[]), table(2)])
        })
    };
    [entry(3, 2, 7, 2, 9), entry(1, 1, 10, 4, 4), entry(2, 4, 4, 3, 5), entry(1, 16, 6, 3, 3)]
        .into_iter()
        .flatten()
        .collect()
}
