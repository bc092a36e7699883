//! The inner loops of the hash grid.
//!
//! Samples come in blocks. For a block and a level, rows and weights of all corners are computed first, side by side in
//! vector registers. Then the rows are visited one sample after the other. While a level is read, the rows of the next
//! one are prefetched. The table is larger than the caches near a core, and without prefetching, reading takes twice as
//! long.
//!
//! Adding visits one level of many samples at a time; there the rows of the next block are prefetched. Products are not
//! fused, so the bits are the same on every instruction set.

use super::grid::{HashLevel, PRIMES};
use raygrad_autograd::{RowAdder, Scalar};
use raygrad_tensor::simd;

/// Samples per block.
pub(super) const BLOCK: usize = 64;

/// Up to [`BLOCK`] positions, axis by axis, clamped to the unit cube.
pub(super) struct Points<T> {
    axes: [[T; BLOCK]; 3],
    len: usize,
}

impl<T: Scalar> Points<T> {
    pub(super) fn new() -> Self {
        Points { axes: [[T::ZERO; BLOCK]; 3], len: 0 }
    }

    /// Loads `[len, 3]` positions. NaN stays NaN.
    #[inline(always)]
    pub(super) fn load(&mut self, positions: &[T]) {
        self.len = (positions.len() / 3).min(BLOCK);
        for i in 0..self.len {
            for axis in 0..3 {
                let x = positions[3 * i + axis];
                let x = if x < T::ZERO { T::ZERO } else { x };
                self.axes[axis][i] = if x > T::ONE { T::ONE } else { x };
            }
        }
    }
}

/// The cells of a block's samples on one level.
pub(super) struct Cells<T> {
    /// Rows of the corners within the level. Bit `k` of a corner's number is its step along axis `k`.
    rows: [[u32; BLOCK]; 8],
    /// Position within the cell along each axis, in 0..=1.
    place: [[T; BLOCK]; 3],
    /// Trilinear weights of the corners.
    weights: [[T; BLOCK]; 8],
    len: usize,
}

impl<T: Scalar> Cells<T> {
    pub(super) fn new() -> Self {
        Cells { rows: [[0; BLOCK]; 8], place: [[T::ZERO; BLOCK]; 3], weights: [[T::ZERO; BLOCK]; 8], len: 0 }
    }

    /// Computes rows, positions and weights of `points` on `level`.
    ///
    /// Every row is below the level's number of rows, for any points. A NaN coordinate counts as cell 0 and makes the
    /// weights NaN.
    ///
    /// It is not inlined: with the numbers of features of its callers it was compiled thirty times.
    #[inline(never)]
    pub(super) fn locate(&mut self, level: &HashLevel, points: &Points<T>) {
        simd::dispatch(
            #[inline(always)]
            || match level.hashed {
                true => self.locate_as(level, true, points),
                false => self.locate_as(level, false, points),
            },
        )
    }

    #[inline(always)]
    fn locate_as(&mut self, level: &HashLevel, hashed: bool, points: &Points<T>) {
        self.len = points.len;
        let side = level.resolution + 1;
        let mask = level.rows.len() as u32 - 1;
        let scale = T::from_f64(f64::from(level.resolution));
        let last = level.resolution as i32 - 1;
        for i in 0..BLOCK {
            // For the low and the high side of the cell along each axis: the contribution to the row, and the weight.
            let mut step = [[0; 2]; 3];
            let mut weight = [[T::ZERO; 2]; 3];
            for axis in 0..3 {
                let x = points.axes[axis][i] * scale;
                // At least 0, because points are clamped and the conversion turns NaN into 0.
                let cell = (x.to_f64() as i32).min(last);
                let place = x - T::from_f64(f64::from(cell));
                self.place[axis][i] = place;
                weight[axis] = [T::ONE - place, place];
                let cell = cell as u32;
                let stride = if hashed { [1, PRIMES[0], PRIMES[1]] } else { [1, side, side.wrapping_mul(side)] };
                let low = cell.wrapping_mul(stride[axis]);
                step[axis] = [low, low.wrapping_add(stride[axis])];
            }
            for corner in 0..8 {
                let [x, y, z] = [corner & 1, corner >> 1 & 1, corner >> 2];
                let [sx, sy, sz] = [step[0][x], step[1][y], step[2][z]];
                self.rows[corner][i] = if hashed { (sx ^ sy ^ sz) & mask } else { sx + sy + sz };
                self.weights[corner][i] = weight[0][x] * (weight[1][y] * weight[2][z]);
            }
        }
    }

    /// Prefetches the rows of all corners; `table` is the level's.
    #[inline(always)]
    pub(super) fn prefetch<const F: usize>(&self, table: &[[T; F]]) {
        for i in 0..self.len {
            for corner in 0..8 {
                simd::prefetch(table.as_ptr().wrapping_add(self.rows[corner][i] as usize));
            }
        }
    }

    /// Writes the interpolated features to column `column` of each row of `out` (`[len, width]`); `table` is the
    /// level's.
    #[inline(always)]
    pub(super) fn gather<const F: usize>(&self, table: &[[T; F]], out: &mut [T], width: usize, column: usize) {
        for (i, out) in out.chunks_exact_mut(width).enumerate().take(self.len) {
            let mut sum = [T::ZERO; F];
            for corner in 0..8 {
                // SAFETY: `locate` keeps rows below the level's row count, which callers assert to be the table's. The
                // test `rows_stay_in_bounds` covers the extremes.
                let row = unsafe { table.get_unchecked(self.rows[corner][i] as usize) };
                let weight = self.weights[corner][i];
                for f in 0..F {
                    sum[f] += weight * row[f];
                }
            }
            out[column..column + F].copy_from_slice(&sum);
        }
    }

    /// The adjoint of [`gather`](Self::gather) in the table: adds each sample's gradient to the rows of its corners, in
    /// the order of the samples. Samples whose gradients are all at most `cut` in magnitude change nothing.
    #[inline(always)]
    pub(super) fn scatter<const F: usize>(
        &self,
        d_out: &[T],
        width: usize,
        column: usize,
        cut: T,
        grad: &mut RowAdder<'_, T, F>,
    ) {
        // Neighbouring samples of a ray often share a cell, above all on coarse levels. Their gradients are summed
        // before the table is accessed.
        let (mut sums, mut cell) = ([[T::ZERO; F]; 8], None);
        for (i, d_out) in d_out.chunks_exact(width).enumerate().take(self.len) {
            let mut g = [T::ZERO; F];
            g.copy_from_slice(&d_out[column..column + F]);
            // NaN is not small.
            let mut is_small = true;
            for f in 0..F {
                is_small &= g[f].abs() <= cut;
            }
            if is_small {
                continue;
            }
            let same = cell.is_some_and(
                #[inline(always)]
                |last: usize| self.same_rows(last, i),
            );
            if !same {
                if let Some(last) = cell {
                    self.flush(last, &mut sums, grad);
                }
                cell = Some(i);
            }
            for corner in 0..8 {
                for f in 0..F {
                    sums[corner][f] += self.weights[corner][i] * g[f];
                }
            }
        }
        if let Some(last) = cell {
            self.flush(last, &mut sums, grad);
        }
    }

    /// Returns true if the corners of two samples of the block have the same rows.
    #[inline(always)]
    fn same_rows(&self, a: usize, b: usize) -> bool {
        let mut same = true;
        for rows in &self.rows {
            same &= rows[a] == rows[b];
        }
        same
    }

    /// Adds the sums of sample `i`'s corners to their rows and resets them.
    #[inline(always)]
    fn flush<const F: usize>(&self, i: usize, sums: &mut [[T; F]; 8], grad: &mut RowAdder<'_, T, F>) {
        for corner in 0..8 {
            grad.add(self.rows[corner][i] as usize, &sums[corner]);
            sums[corner] = [T::ZERO; F];
        }
    }

    /// Prefetches the first reads of an addition to the rows of all corners.
    #[inline(always)]
    pub(super) fn prefetch_sums<const F: usize>(&self, grad: &RowAdder<'_, T, F>) {
        for i in 0..self.len {
            for corner in 0..8 {
                grad.prefetch(self.rows[corner][i] as usize);
            }
        }
    }

    /// The adjoint of [`gather`](Self::gather) in the positions: adds the level's part of the gradient to each row of
    /// `grad`, `[len, 3]`. It ignores clamping. `scale` is the resolution.
    #[inline(always)]
    pub(super) fn slopes<const F: usize>(
        &self,
        table: &[[T; F]],
        d_out: &[T],
        width: usize,
        column: usize,
        scale: T,
        grad: &mut [T],
    ) {
        let samples = d_out.chunks_exact(width).zip(grad.chunks_exact_mut(3));
        for (i, (d_out, grad)) in samples.enumerate().take(self.len) {
            let g = &d_out[column..column + F];
            // The gradient with respect to each corner's weight.
            let mut corners = [T::ZERO; 8];
            for corner in 0..8 {
                let row = &table[self.rows[corner][i] as usize];
                for f in 0..F {
                    corners[corner] += g[f] * row[f];
                }
            }
            for axis in 0..3 {
                let (step, [a, b]) = (1 << axis, [(axis + 1) % 3, (axis + 2) % 3]);
                let side = |other: usize, corner: usize| {
                    let place = self.place[other][i];
                    if corner >> other & 1 == 1 { place } else { T::ONE - place }
                };
                let mut slope = T::ZERO;
                for corner in 0..8 {
                    if corner & step == 0 {
                        slope += side(a, corner) * side(b, corner) * (corners[corner + step] - corners[corner]);
                    }
                }
                grad[axis] += scale * slope;
            }
        }
    }
}
