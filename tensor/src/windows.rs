//! The windows of a 2-D convolution or pooling. Kernels work on one image; a caller loops over a batch.

use crate::parallel::{ELEMENT, chunks};
use crate::{Scalar, add_assign, checked_len, simd};
use std::ops::Range;

/// The positions of the windows of one image. Window `(i, j)` starts at row `i * stride[0] - padding[0]` and column
/// `j * stride[1] - padding[1]`, and its elements are `dilation` apart. Positions outside the image are padding.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Windows {
    image: [usize; 2],
    kernel: [usize; 2],
    stride: [usize; 2],
    padding: [usize; 2],
    dilation: [usize; 2],
    output: [usize; 2],
}

impl Windows {
    /// Windows of `kernel` elements on an image of `[height, width]`. Along each axis there are
    /// `(image + 2 padding - span) / stride + 1` of them, rounded down, where `span = dilation (kernel - 1) + 1`.
    ///
    /// # Errors
    /// If a kernel extent, stride or dilation is 0, or a window is larger than the padded image. If an extent of the
    /// padded image is out of range. If the image, or all its windows, have more elements than a buffer can hold.
    pub fn new(
        image: [usize; 2],
        kernel: [usize; 2],
        stride: [usize; 2],
        padding: [usize; 2],
        dilation: [usize; 2],
    ) -> Result<Self, String> {
        let mut output = [0; 2];
        for axis in 0..2 {
            if kernel[axis] == 0 || stride[axis] == 0 || dilation[axis] == 0 {
                return Err(format!("kernel {kernel:?}, stride {stride:?} and dilation {dilation:?} must be positive"));
            }
            let what = || format!("an image {image:?} with padding {padding:?}");
            let extent = padding[axis].checked_mul(2).and_then(|padding| padding.checked_add(image[axis]));
            let extent = extent.ok_or_else(|| format!("{} is too large", what()))?;
            // A span beyond every number does not fit either.
            let span = dilation[axis].checked_mul(kernel[axis] - 1).and_then(|way| way.checked_add(1));
            let Some(rest) = span.and_then(|span| extent.checked_sub(span)) else {
                return Err(format!("a kernel {kernel:?} with dilation {dilation:?} does not fit {}", what()));
            };
            output[axis] = rest / stride[axis] + 1;
        }
        let unfolded = [kernel[0], kernel[1], output[0], output[1]];
        if checked_len(&unfolded).is_none() || checked_len(&image).is_none() {
            return Err(format!(
                "{output:?} windows of {kernel:?} elements on an image {image:?} have too many elements"
            ));
        }
        Ok(Windows { image, kernel, stride, padding, dilation, output })
    }

    /// Number of windows along each axis: the extents of the output.
    pub fn output(&self) -> [usize; 2] {
        self.output
    }

    /// Number of windows.
    pub fn count(&self) -> usize {
        self.output[0] * self.output[1]
    }

    /// Number of elements of a window.
    pub fn kernel_len(&self) -> usize {
        self.kernel[0] * self.kernel[1]
    }

    /// Whether every window is one pixel and every pixel a window, so that [`unfold`](Self::unfold) would only copy.
    pub fn are_pixels(&self) -> bool {
        self.kernel == [1, 1] && self.stride == [1, 1] && self.padding == [0, 0]
    }

    /// The windows along one axis whose element `k` is inside the image.
    #[inline(always)]
    fn inside(&self, axis: usize, k: usize) -> Range<usize> {
        let (stride, offset) = (self.stride[axis], k * self.dilation[axis]);
        let first = self.padding[axis].saturating_sub(offset).div_ceil(stride);
        let end = (self.image[axis] + self.padding[axis]).saturating_sub(offset).div_ceil(stride);
        let end = end.min(self.output[axis]);
        first.min(end)..end
    }

    /// Calls `f(k, windows, first)` for these elements `k` of a window and each row of windows in `among`. It skips rows
    /// in which `k` is outside the image for all windows. `windows` are the numbers of the other windows, counted from
    /// the first row of `among`. `first` is the position of element `k` of the first of them; the next one is
    /// `stride[1]` further.
    #[inline(always)]
    fn runs(&self, elements: Range<usize>, among: Range<usize>, mut f: impl FnMut(usize, Range<usize>, usize)) {
        let width = self.kernel[1];
        for ki in elements.start / width..elements.end.div_ceil(width) {
            let rows = self.inside(0, ki);
            let rows = rows.start.max(among.start)..rows.end.min(among.end);
            for kj in elements.start.saturating_sub(ki * width)..width.min(elements.end - ki * width) {
                let columns = self.inside(1, kj);
                if columns.is_empty() {
                    continue;
                }
                let x = columns.start * self.stride[1] + kj * self.dilation[1] - self.padding[1];
                for i in rows.clone() {
                    let y = i * self.stride[0] + ki * self.dilation[0] - self.padding[0];
                    let start = (i - among.start) * self.output[1];
                    f(ki * self.kernel[1] + kj, start + columns.start..start + columns.end, y * self.image[1] + x);
                }
            }
        }
    }

    /// [`runs`](Self::runs) among all rows of windows, with the best vectors of the machine.
    #[inline(always)]
    fn vector_runs(&self, elements: Range<usize>, f: impl FnMut(usize, Range<usize>, usize)) {
        simd::dispatch(
            #[inline(always)]
            || self.runs(elements, 0..self.output[0], f),
        );
    }

    /// The elements of a channel.
    fn pixels(&self) -> usize {
        self.image[0] * self.image[1]
    }

    /// Checks that an image and its unfolded form, with `per_channel` values a channel, have equal numbers of channels.
    #[track_caller]
    fn check(&self, image: usize, unfolded: usize, per_channel: usize) {
        let channels = unfolded / per_channel;
        assert_eq!(channels * per_channel, unfolded, "{unfolded} values for windows {self:?}");
        assert_eq!(Some(image), channels.checked_mul(self.pixels()), "an image of {image} values for windows {self:?}");
    }

    /// Writes the windows of an image `[channels, height, width]` to `out` ("im2col"). They become the columns of a
    /// matrix `[channels * kernel_len, count]`; padding is 0. A convolution is then a matrix product.
    ///
    /// # Panics
    /// If a slice has another length.
    #[track_caller]
    pub fn unfold<T: Scalar>(&self, image: &[T], out: &mut [T]) {
        self.unfold_rows(image, 0..self.output[0], out);
    }

    /// As [`unfold`](Self::unfold), for some rows of windows. Unfolding multiplies the size of an image by the number
    /// of elements of a window; doing it in parts saves memory. `out` is `[channels * kernel_len, rows * output()[1]]`.
    ///
    /// # Panics
    /// If a slice has another length, or `rows` is outside the rows of windows.
    #[track_caller]
    pub fn unfold_rows<T: Scalar>(&self, image: &[T], rows: Range<usize>, out: &mut [T]) {
        assert!(rows.start <= rows.end && rows.end <= self.output[0], "rows {rows:?} of windows {self:?}");
        let count = rows.len() * self.output[1];
        let per_channel = self.kernel_len() * count;
        if per_channel == 0 {
            return assert!(out.is_empty(), "{} values for no windows", out.len());
        }
        self.check(image.len(), out.len(), per_channel);
        if out.is_empty() {
            return;
        }
        let (step, work, pixels) = (self.stride[1], ELEMENT * out.len(), self.pixels());
        chunks(out, per_channel, work, || (), &|_, channel, out| {
            if self.padding != [0, 0] {
                out.fill(T::ZERO);
            }
            let image = &image[channel * pixels..][..pixels];
            self.runs(0..self.kernel_len(), rows.clone(), |k, windows, first| {
                let out = &mut out[k * count..][windows];
                if step == 1 {
                    out.copy_from_slice(&image[first..first + out.len()]);
                } else {
                    for (out, &x) in out.iter_mut().zip(image[first..].iter().step_by(step)) {
                        *out = x;
                    }
                }
            });
        });
    }

    /// Adds each column to the pixels of its window ("col2im"): the adjoint of [`unfold`](Self::unfold).
    ///
    /// # Panics
    /// If a slice has another length.
    #[track_caller]
    pub fn fold<T: Scalar>(&self, columns: &[T], image: &mut [T]) {
        let (count, per_channel) = (self.count(), self.kernel_len() * self.count());
        self.check(image.len(), columns.len(), per_channel);
        let work = ELEMENT * columns.len();
        chunks(image, self.pixels().max(1), work, || (), &|_, channel, image| {
            let columns = &columns[channel * per_channel..][..per_channel];
            self.add_runs(
                0..self.kernel_len(),
                image,
                #[inline(always)]
                |k, windows| &columns[k * count..][windows],
            );
        });
    }

    /// Adds `values(k, windows)` to the pixels that are element `k` of these windows, for these `k`.
    #[inline(always)]
    fn add_runs<'a, T: Scalar>(
        &self,
        elements: Range<usize>,
        image: &mut [T],
        values: impl Fn(usize, Range<usize>) -> &'a [T],
    ) {
        let step = self.stride[1];
        self.vector_runs(
            elements,
            #[inline(always)]
            |k, windows, first| {
                let values = values(k, windows);
                if step == 1 {
                    let pixels = &mut image[first..first + values.len()];
                    for (pixel, &value) in pixels.iter_mut().zip(values) {
                        *pixel += value;
                    }
                } else {
                    for (pixel, &value) in image[first..].iter_mut().step_by(step).zip(values) {
                        *pixel += value;
                    }
                }
            },
        );
    }

    /// Folds these elements of each window of one channel, in order: `f(.. f(f(start, x), x') ..)`.
    #[inline(always)]
    #[track_caller]
    fn reduce<T: Scalar>(&self, elements: Range<usize>, plane: &[T], out: &mut [T], start: T, f: impl Fn(T, T) -> T) {
        self.check(plane.len(), out.len(), self.count());
        out.fill(start);
        let step = self.stride[1];
        self.vector_runs(
            elements,
            #[inline(always)]
            |_, windows, first| {
                let out = &mut out[windows];
                let plane = &plane[first..];
                for i in 0..out.len() {
                    out[i] = f(out[i], plane[i * step]);
                }
            },
        );
    }

    /// The sum of each window of one channel `[height, width]`; padding counts as 0. The sum is pairwise.
    ///
    /// # Panics
    /// If a slice has another length.
    #[track_caller]
    pub fn sums<T: Scalar>(&self, plane: &[T], out: &mut [T]) {
        in_pairs(0..self.kernel_len(), RUN, out, &|elements, out| {
            self.reduce(elements, plane, out, T::ZERO, T::add);
        });
    }

    /// The largest number of windows that a pixel is in, if there are enough windows.
    pub fn overlap(&self) -> usize {
        (0..2).map(|axis| self.kernel[axis].div_ceil(self.stride[axis])).product()
    }

    /// Adds each value to every pixel of its window: the adjoint of [`sums`](Self::sums). The sum is pairwise.
    ///
    /// # Panics
    /// If a slice has another length.
    #[track_caller]
    pub fn spread<T: Scalar>(&self, values: &[T], plane: &mut [T]) {
        self.check(plane.len(), values.len(), self.count());
        // A pixel is element `k` of a window for `overlap` of all `k`.
        let run = RUN * (self.kernel_len() / self.overlap()).max(1);
        in_pairs(0..self.kernel_len(), run, plane, &|elements, plane| {
            self.add_runs(
                elements,
                plane,
                #[inline(always)]
                |_, windows| &values[windows],
            );
        });
    }

    /// The largest element of each window of one channel `[height, width]`, NaN if there is one; padding is ignored. A
    /// window that is all padding gives `-inf`.
    ///
    /// # Panics
    /// If a slice has another length.
    #[track_caller]
    pub fn maxima<T: Scalar>(&self, plane: &[T], out: &mut [T]) {
        self.reduce(
            0..self.kernel_len(),
            plane,
            out,
            T::from_f64(f64::NEG_INFINITY),
            #[inline(always)]
            |best, x| if beats(x, best) { x } else { best },
        );
    }

    /// The pixel positions of the elements that [`maxima`](Self::maxima) finds: the first of equal elements in
    /// row-major order, or the last NaN if there is one. `best` is scratch space for the maxima.
    ///
    /// # Panics
    /// If a slice has another length, a window is all padding, or there are more than 2^32 - 1 pixels.
    #[track_caller]
    pub fn arg_maxima<T: Scalar>(&self, plane: &[T], best: &mut [T], out: &mut [u32]) {
        self.check(plane.len(), out.len(), self.count());
        assert_eq!(best.len(), out.len(), "scratch space for the maxima");
        const NONE: u32 = u32::MAX;
        assert!(plane.len() <= NONE as usize, "places among {} pixels", plane.len());
        out.fill(NONE);
        let step = self.stride[1];
        self.vector_runs(
            0..self.kernel_len(),
            #[inline(always)]
            |_, windows, first| {
                let (out, best) = (&mut out[windows.clone()], &mut best[windows]);
                let pixels = &plane[first..];
                for i in 0..out.len() {
                    let x = pixels[i * step];
                    let wins = out[i] == NONE || beats(x, best[i]);
                    best[i] = if wins { x } else { best[i] };
                    out[i] = if wins { (first + i * step) as u32 } else { out[i] };
                }
            },
        );
        assert!(!out.contains(&NONE), "a window of {self:?} sees no pixel");
    }
}

/// Elements of a window that are added one after another before pairs are formed.
const RUN: usize = 32;

/// A sum over `elements` in pairs of runs. `sum(elements, out)` adds a run to `out`, or to zeros in its place.
#[track_caller]
fn in_pairs<T: Scalar>(elements: Range<usize>, run: usize, out: &mut [T], sum: &impl Fn(Range<usize>, &mut [T])) {
    if elements.len() <= run {
        return sum(elements, out);
    }
    let middle = elements.start + (elements.len() / 2).next_multiple_of(run);
    in_pairs(elements.start..middle, run, out, sum);
    let mut rest = vec![T::ZERO; out.len()];
    in_pairs(middle..elements.end, run, &mut rest, sum);
    add_assign(out, &rest);
}

/// Whether `x` replaces the largest element so far. NaN does, and only another NaN replaces it.
#[inline(always)]
fn beats<T: Scalar>(x: T, best: T) -> bool {
    #[allow(clippy::eq_op)] // NaN differs from itself.
    let nan = x != x;
    x > best || nan
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Element `(ki, kj)` of window `(i, j)` of a plane; None in the padding.
    fn element(w: &Windows, plane: &[f64], [i, j]: [usize; 2], [ki, kj]: [usize; 2]) -> Option<f64> {
        let at = |axis: usize, i: usize, k: usize| {
            (i * w.stride[axis] + k * w.dilation[axis]).checked_sub(w.padding[axis]).filter(|&y| y < w.image[axis])
        };
        Some(plane[at(0, i, ki)? * w.image[1] + at(1, j, kj)?])
    }

    proptest! {
        #[test]
        fn every_walk_agrees_with_the_definition(
            image in [0usize..9, 1usize..10], kernel in [1usize..8, 1usize..8], stride in [1usize..4, 1usize..4],
            padding in [0usize..3, 0usize..3], dilation in [1usize..3, 1usize..3], channels in 0usize..3
        ) {
            let Ok(w) = Windows::new(image, kernel, stride, padding, dilation) else { return Ok(()) };
            let pixels = image[0] * image[1];
            let x: Vec<f64> = (0..channels * pixels).map(|i| ((i * 37) % 11) as f64 - 5.0).collect();
            let mut columns = vec![f64::NAN; channels * w.kernel_len() * w.count()];
            w.unfold(&x, &mut columns);
            // Some rows of windows: the columns of the whole that belong to them.
            let (first, end) = (w.output[0] / 3, w.output[0].div_ceil(2));
            let mut some = vec![f64::NAN; channels * w.kernel_len() * (end - first) * w.output[1]];
            w.unfold_rows(&x, first..end, &mut some);
            let whole = columns.chunks_exact(w.count()).map(|row| &row[first * w.output[1]..end * w.output[1]]);
            prop_assert_eq!(some, whole.collect::<Vec<_>>().concat());
            let v: Vec<f64> = (0..columns.len()).map(|i| ((i * 17) % 7) as f64 - 3.0).collect();
            let mut back = vec![0.0; x.len()];
            w.fold(&v, &mut back);
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            prop_assert_eq!(dot(&columns, &v), dot(&x, &back));
            for c in 0..channels {
                let plane = &x[c * pixels..(c + 1) * pixels];
                let (mut sums, mut maxima) = (vec![f64::NAN; w.count()], vec![f64::NAN; w.count()]);
                w.sums(plane, &mut sums);
                w.maxima(plane, &mut maxima);
                let v = &v[..w.count()];
                let mut back = vec![0.0; pixels];
                w.spread(v, &mut back);
                prop_assert_eq!(dot(&sums, v), dot(plane, &back));
                let mut seen = true;
                for window in 0..w.count() {
                    let (mut sum, mut largest) = (0.0, f64::NEG_INFINITY);
                    for k in 0..w.kernel_len() {
                        let at = [window / w.output[1], window % w.output[1]];
                        let x = element(&w, plane, at, [k / kernel[1], k % kernel[1]]);
                        prop_assert_eq!(columns[(c * w.kernel_len() + k) * w.count() + window], x.unwrap_or(0.0));
                        sum += x.unwrap_or(0.0);
                        largest = largest.max(x.unwrap_or(f64::NEG_INFINITY));
                    }
                    prop_assert_eq!(sums[window], sum);
                    prop_assert_eq!(maxima[window], largest);
                    seen &= largest.is_finite();
                }
                if seen {
                    let (mut index, mut best) = (vec![0; w.count()], vec![0.0; w.count()]);
                    w.arg_maxima(plane, &mut best, &mut index);
                    let found: Vec<f64> = index.iter().map(|&i| plane[i as usize]).collect();
                    prop_assert_eq!(&found, &maxima);
                }
            }
        }
    }

    #[test]
    fn the_first_of_equal_maxima_wins_and_a_nan_beats_all() {
        let w = Windows::new([2, 4], [2, 2], [2, 2], [0, 0], [1, 1]).unwrap();
        let (mut index, mut best) = ([0; 2], [0.0; 2]);
        w.arg_maxima(
            &[3.0, 3.0, -f32::INFINITY, -f32::INFINITY, 3.0, 1.0, -f32::INFINITY, -f32::INFINITY],
            &mut best,
            &mut index,
        );
        assert_eq!(index, [0, 2]);
        let plane = [f32::NAN, 3.0, 1.0, 2.0, 4.0, 1.0, f32::NAN, 5.0];
        let mut out = [0.0; 2];
        w.maxima(&plane, &mut out);
        w.arg_maxima(&plane, &mut best, &mut index);
        assert!(out.iter().all(|x| x.is_nan()));
        assert_eq!(index, [0, 6]);
    }

    #[test]
    fn impossible_windows_are_errors() {
        let one = [1, 1];
        assert!(Windows::new([2, 2], [3, 3], one, [0, 0], one).unwrap_err().contains("does not fit"));
        assert!(Windows::new([2, 2], [2, 2], one, [0, 0], [2, 1]).unwrap_err().contains("does not fit"));
        assert!(Windows::new([2, 2], one, [0, 1], [0, 0], one).unwrap_err().contains("must be positive"));
        assert_eq!(Windows::new([5, 6], [3, 2], [2, 3], [1, 0], [1, 2]).unwrap().output(), [3, 2]);
    }

    #[test]
    fn windows_whose_sizes_wrap_are_errors() {
        let (one, none, half) = ([1, 1], [0, 0], 1 << (usize::BITS - 1));
        // Each of these wrapped to numbers that look possible.
        for (image, kernel, padding, dilation, expected) in [
            ([4, 4], [3, 3], none, [half, 1], "does not fit"),
            ([4, 4], [2, 2], none, [1, usize::MAX], "does not fit"),
            ([4, 4], [half, 2], none, [2, 1], "does not fit"),
            ([4, 4], [2, 2], [half, 0], one, "is too large"),
            ([4, usize::MAX], [2, 2], [0, 1], one, "is too large"),
            ([4, 4], one, [1 << 31, 1 << 31], one, "too many elements"),
            ([1 << 32, 1 << 32], [1 << 32, 1 << 32], none, one, "too many elements"),
            ([usize::MAX / 2, 4], [usize::MAX / 2, 4], none, one, "too many elements"),
        ] {
            let error = Windows::new(image, kernel, one, padding, dilation).unwrap_err();
            assert!(error.contains(expected), "{image:?} {kernel:?} {padding:?} {dilation:?}: {error}");
        }
        // One window of one pixel, of an image that no memory holds.
        let error = Windows::new([1 << 62, 4], one, [usize::MAX; 2], none, one).unwrap_err();
        assert!(error.contains("too many elements"), "{error}");
        // Four channels of 2^62 pixels are as many values as none.
        let w = Windows::new([1 << 62, 1], one, [1 << 62, 1], none, one).unwrap();
        assert!(std::panic::catch_unwind(|| w.fold(&[1.0; 4], &mut [])).is_err());
        // A stride of any length leads to one window.
        assert_eq!(Windows::new([4, 4], one, [usize::MAX; 2], none, one).unwrap().output(), one);
    }
}
