//! 2-D convolution of images `[n, channels, height, width]`, and the two products that are its gradients. These three
//! form a closed set, so gradients of any order are convolutions.
//!
//! The kernel unfolds each image to a matrix of windows ("im2col"), a large image in strips, and multiplies. Images run
//! in parallel on rayon's threads. Sums over images use a fixed number of groups, so results have the same bits for any
//! number of threads.

use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::matmul::{Matrix, gemm};
use raygrad_tensor::parallel::chunks;
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, Windows, sum_rows};
use serde::{Deserialize, Serialize};
use smallvec::smallvec;

/// Groups of images over which a weight's gradient is summed first.
const SLOTS: usize = 16;

/// Elements of an image that are unfolded at a time for its convolution, about. Without strips, an image of 64 channels
/// and 800x800 pixels would take 1.5 GB for a 3x3 kernel.
const STRIP: usize = 1 << 22;

/// Stride, padding and dilation of a 2-D convolution, by axis: `[rows, columns]`.
///
/// ```
/// use raygrad_autograd::Conv2dConfig;
/// let same = Conv2dConfig { padding: [1, 1], ..Conv2dConfig::default() }; // a 3x3 kernel keeps the extents
/// assert_eq!((same.stride, same.dilation), ([1, 1], [1, 1]));
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Conv2dConfig {
    /// Pixels from one window to the next; at least 1.
    pub stride: [usize; 2],
    /// Rows and columns of zeros added at both ends.
    pub padding: [usize; 2],
    /// Pixels from one element of the kernel to the next; at least 1.
    pub dilation: [usize; 2],
}

impl Default for Conv2dConfig {
    /// Stride 1, no padding, dilation 1.
    fn default() -> Self {
        Conv2dConfig { stride: [1, 1], padding: [0, 0], dilation: [1, 1] }
    }
}

impl Conv2dConfig {
    fn windows(&self, image: [usize; 2], kernel: [usize; 2]) -> Result<Windows, ShapeError> {
        Windows::new(image, kernel, self.stride, self.padding, self.dilation)
    }
}

/// y = x * w (+ b): each output pixel is the inner product of the weight with a window of the image, not flipped.
///
/// x `[n, c, h, w]`, w `[o, c, kh, kw]`, b `[o]`, y `[n, o, oh, ow]`. dx = [`Conv2dInput`] of g and w,
/// dw = [`Conv2dWeight`] of x and g, db = g summed over images and pixels.
#[derive(Clone, Copy)]
pub struct Conv2d(
    /// Stride, padding, dilation.
    pub Conv2dConfig,
);

/// The gradient of the image: x = each window of g's shape, weighted by g and added to its place in the image. This is
/// the "transposed convolution". g `[n, o, oh, ow]`, w `[o, c, kh, kw]`, x `[n, c, h, w]`.
#[derive(Clone, Copy)]
pub struct Conv2dInput {
    /// Stride, padding, dilation.
    pub config: Conv2dConfig,
    /// Height and width of the image.
    pub image: [usize; 2],
}

/// The gradient of the weight: w = sum over images and windows of the window times its g. x `[n, c, h, w]`,
/// g `[n, o, oh, ow]`, w `[o, c, kh, kw]`.
#[derive(Clone, Copy)]
pub struct Conv2dWeight {
    /// Stride, padding, dilation.
    pub config: Conv2dConfig,
    /// Height and width of the kernel.
    pub kernel: [usize; 2],
}

/// The extents of one convolution.
struct Sizes {
    windows: Windows,
    /// Images.
    n: usize,
    /// Output channels.
    o: usize,
    /// Elements of an image.
    image: usize,
    /// Elements of a window: rows of the unfolded image.
    rows: usize,
    /// Windows: its columns.
    count: usize,
}

impl Sizes {
    fn new(config: &Conv2dConfig, x: &[usize], w: &[usize]) -> Self {
        let windows = match config.windows([x[2], x[3]], [w[2], w[3]]) {
            Ok(windows) => windows,
            Err(_) => unreachable!("`shape` has accepted these extents"),
        };
        let rows = w[1] * w[2] * w[3];
        Sizes { windows, n: x[0], o: w[0], image: x[1] * x[2] * x[3], rows, count: windows.count() }
    }

    /// Multiply-adds of the whole batch.
    fn work(&self) -> usize {
        self.n * self.o * self.rows * self.count
    }

    /// Rows of windows of a strip.
    fn strip(&self) -> usize {
        let [rows, columns] = self.windows.output();
        if self.windows.are_pixels() {
            // Nothing is unfolded.
            return rows;
        }
        (STRIP / (self.rows * columns).max(1)).clamp(1, rows)
    }

    /// Scratch space for an unfolded strip of an image, and for its product.
    fn strip_scratch<T: Scalar>(&self, pool: &Pool<T>) -> [Tensor<T>; 2] {
        let count = self.strip() * self.windows.output()[1];
        if self.strip() == self.windows.output()[0] {
            return [self.scratch(pool), pool.tensor(&[0])];
        }
        [pool.tensor(&[self.rows * count]), pool.tensor(&[self.o * count])]
    }

    /// Scratch space for an unfolded image.
    fn scratch<T: Scalar>(&self, pool: &Pool<T>) -> Tensor<T> {
        pool.tensor(&[if self.windows.are_pixels() { 0 } else { self.rows * self.count }])
    }

    /// Image `i` unfolded, in `scratch` if needed. `x` are all images: each task would copy a view.
    fn unfolded<'a, T: Scalar>(&self, x: &'a [T], i: usize, scratch: &'a mut Tensor<T>) -> Matrix<'a, T> {
        let image = &x[i * self.image..][..self.image];
        if self.windows.are_pixels() {
            return Matrix::new(image, self.rows, self.count);
        }
        self.windows.unfold(image, scratch.as_mut_slice());
        Matrix::new(scratch.as_slice(), self.rows, self.count)
    }

    /// The output or its gradient for image `i`, as a matrix of channels and windows.
    fn output<'a, T: Scalar>(&self, g: &'a [T], i: usize) -> Matrix<'a, T> {
        Matrix::new(&g[i * self.o * self.count..][..self.o * self.count], self.o, self.count)
    }
}

/// The extents of a tensor of four axes.
fn four(x: &[usize], what: &str) -> Result<[usize; 4], ShapeError> {
    x.try_into().map_err(|_| format!("{what} must have four axes"))
}

impl<T: Scalar> Op<T> for Conv2d {
    fn name(&self) -> &'static str {
        "conv2d"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let ([n, channels, height, width], [o, c, kh, kw]) = (four(x[0], "the image")?, four(x[1], "the weight")?);
        if channels != c {
            return Err(format!("the weight takes {c} channels"));
        }
        if x.len() > 2 && x[2] != [o] {
            return Err(format!("the bias must have shape [{o}]"));
        }
        let [oh, ow] = self.0.windows([height, width], [kh, kw])?.output();
        Ok(smallvec![n, o, oh, ow])
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let s = Sizes::new(&self.0, x[0].shape(), x[1].shape());
        let [oh, ow] = s.windows.output();
        let mut y = pool.tensor(&[s.n, s.o, oh, ow]);
        let (images, weight) = (x[0].as_slice(), Matrix::new(x[1].as_slice(), s.o, s.rows));
        let product = |unfolded: Matrix<'_, T>, y: &mut [T]| {
            if let Some(bias) = x.get(2) {
                y.chunks_exact_mut(unfolded.columns()).zip(bias.as_slice()).for_each(|(y, &b)| y.fill(b));
            }
            gemm(weight, unfolded, y, x.len() > 2);
        };
        let image = |[scratch, part]: &mut [Tensor<T>; 2], i: usize, y: &mut [T]| {
            if part.is_empty() {
                return product(s.unfolded(images, i, scratch), y);
            }
            for start in (0..oh).step_by(s.strip()) {
                let rows = start..oh.min(start + s.strip());
                let count = rows.len() * ow;
                let (unfolded, part) =
                    (&mut scratch.as_mut_slice()[..s.rows * count], &mut part.as_mut_slice()[..s.o * count]);
                s.windows.unfold_rows(&images[i * s.image..][..s.image], rows, unfolded);
                product(Matrix::new(unfolded, s.rows, count), part);
                let strips = y.chunks_exact_mut(s.count).map(|y| &mut y[start * ow..][..count]);
                strips.zip(part.chunks_exact(count)).for_each(|(y, part)| y.copy_from_slice(part));
            }
        };
        chunks(y.as_mut_slice(), s.o * s.count, s.work(), || s.strip_scratch(pool), &image);
        y
    }

    fn reads(&self) -> Reads {
        Reads::only(&[0, 1])
    }

    fn reads_for(&self, has_gradient: &dyn Fn(usize) -> bool) -> Reads {
        Reads::NOTHING.and_if(has_gradient(0), Reads::only(&[1])).and_if(has_gradient(1), Reads::only(&[0]))
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (g, tape) = (cx.g(), cx.tape());
        let (image, kernel) = ([cx.shape(0)[2], cx.shape(0)[3]], [cx.shape(1)[2], cx.shape(1)[3]]);
        let dx = cx.needs(0).then(|| tape.apply(Conv2dInput { config: self.0, image }, &[g, &cx.x(1)]));
        let dw = cx.needs(1).then(|| tape.apply(Conv2dWeight { config: self.0, kernel }, &[&cx.x(0), g]));
        if cx.len() < 3 {
            return Grads::new([dx, dw]);
        }
        let db = cx.needs(2).then(|| g.sum_to(&[cx.shape(2)[0], 1, 1]).reshape(cx.shape(2)));
        Grads::new([dx, dw, db])
    }
}

impl<T: Scalar> Op<T> for Conv2dInput {
    fn name(&self) -> &'static str {
        "conv2d_input"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let ([n, channels, height, width], [o, c, kh, kw]) = (four(x[0], "the input")?, four(x[1], "the weight")?);
        if channels != o {
            return Err(format!("the weight takes {o} channels"));
        }
        let windows = self.config.windows(self.image, [kh, kw])?.output();
        if windows != [height, width] {
            return Err(format!("an image {:?} has {windows:?} windows", self.image));
        }
        Ok(smallvec![n, c, self.image[0], self.image[1]])
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let shape = [x[0].shape()[0], x[1].shape()[1], self.image[0], self.image[1]];
        let s = Sizes::new(&self.config, &shape, x[1].shape());
        let mut out = pool.tensor(&shape);
        let (g, weight) = (x[0].as_slice(), Matrix::new(x[1].as_slice(), s.o, s.rows).t());
        let image = |scratch: &mut Tensor<T>, i: usize, image: &mut [T]| {
            if s.windows.are_pixels() {
                return gemm(weight, s.output(g, i), image, false);
            }
            gemm(weight, s.output(g, i), scratch.as_mut_slice(), false);
            image.fill(T::ZERO);
            s.windows.fold(scratch.as_slice(), image);
        };
        chunks(out.as_mut_slice(), s.image, s.work(), || s.scratch(pool), &image);
        out
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (g, tape) = (cx.g(), cx.tape());
        let kernel = [cx.shape(1)[2], cx.shape(1)[3]];
        let dx = cx.needs(0).then(|| tape.apply(Conv2d(self.config), &[g, &cx.x(1)]));
        let dw = cx.needs(1).then(|| tape.apply(Conv2dWeight { config: self.config, kernel }, &[g, &cx.x(0)]));
        Grads::new([dx, dw])
    }
}

impl<T: Scalar> Op<T> for Conv2dWeight {
    fn name(&self) -> &'static str {
        "conv2d_weight"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let ([n, c, height, width], [images, o, oh, ow]) = (four(x[0], "the image")?, four(x[1], "the gradient")?);
        let windows = self.config.windows([height, width], self.kernel)?.output();
        if n != images || windows != [oh, ow] {
            return Err(format!("{n} images have {windows:?} windows each"));
        }
        Ok(smallvec![o, c, self.kernel[0], self.kernel[1]])
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let shape = [x[1].shape()[1], x[0].shape()[1], self.kernel[0], self.kernel[1]];
        let s = Sizes::new(&self.config, x[0].shape(), &shape);
        let mut out = pool.full(&shape, T::ZERO);
        let (slots, len) = (s.n.min(SLOTS), out.len());
        if slots * len == 0 {
            return out;
        }
        let mut sums = pool.tensor(&[slots, len]);
        let (images, g) = (x[0].as_slice(), x[1].as_slice());
        let slot = |scratch: &mut Tensor<T>, slot: usize, sum: &mut [T]| {
            let first = slot * s.n / slots;
            for i in first..(slot + 1) * s.n / slots {
                gemm(s.output(g, i), s.unfolded(images, i, scratch).t(), sum, i > first);
            }
        };
        chunks(sums.as_mut_slice(), len, s.work(), || s.scratch(pool), &slot);
        sum_rows(sums.as_slice(), out.as_mut_slice());
        out
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (g, tape) = (cx.g(), cx.tape());
        let image = [cx.shape(0)[2], cx.shape(0)[3]];
        let dx = cx.needs(0).then(|| tape.apply(Conv2dInput { config: self.config, image }, &[&cx.x(1), g]));
        let dg = cx.needs(1).then(|| tape.apply(Conv2d(self.config), &[&cx.x(0), g]));
        Grads::new([dx, dg])
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// 2-D convolution of images `[n, channels, height, width]` with a `weight`
    /// `[outputs, channels, kernel height, kernel width]` (`torch.nn.functional.conv2d`).
    ///
    /// As in neural networks, the kernel is not flipped. The result is `[n, outputs, oh, ow]`, where
    /// `oh = (height + 2 padding - dilation (kernel - 1) - 1) / stride + 1`, rounded down.
    ///
    /// ```
    /// use raygrad_autograd::{Conv2dConfig, Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let image = tape.constant(Tensor::from_vec(&[1, 1, 1, 4], vec![1.0, 4.0, 9.0, 16.0]));
    /// let weight = tape.leaf(Tensor::from_vec(&[1, 1, 1, 2], vec![-1.0, 1.0]));
    /// let slope = image.conv2d(&weight, &Conv2dConfig::default());
    /// assert_eq!(slope.value().as_slice(), [3.0, 5.0, 7.0]);
    /// assert_eq!(slope.sum().grad(&[&weight])[0].as_slice(), [14.0, 29.0]);
    /// ```
    ///
    /// # Panics
    /// If the shapes do not fit, or a stride or dilation is 0. If the kernel is larger than the padded image, or the
    /// padded image or the result is too large.
    #[track_caller]
    pub fn conv2d(&self, weight: &Self, config: &Conv2dConfig) -> Self {
        self.tape().apply(Conv2d(*config), &[self, weight])
    }

    /// As [`conv2d`](Self::conv2d), and adds a `bias` `[outputs]` in the same pass.
    ///
    /// # Panics
    /// Where [`conv2d`](Self::conv2d) panics, and if the bias has another shape.
    #[track_caller]
    pub fn conv2d_bias(&self, weight: &Self, bias: &Self, config: &Conv2dConfig) -> Self {
        self.tape().apply(Conv2d(*config), &[self, weight, bias])
    }

    /// The transposed convolution: the adjoint of [`conv2d`](Self::conv2d).
    ///
    /// Takes `[n, inputs, oh, ow]` and a `weight` `[inputs, channels, kernel height, kernel width]` to images
    /// `[n, channels, height, width]`. `image` is `[height, width]`; a convolution of such images must give `oh` times
    /// `ow` pixels. Several image sizes do so if the stride is above 1. The smallest height is
    /// `(oh - 1) stride - 2 padding + dilation (kernel - 1) + 1`.
    ///
    /// # Panics
    /// If the shapes do not fit, or a convolution of `image` would have other extents than this tensor.
    #[track_caller]
    pub fn conv2d_transpose(&self, weight: &Self, config: &Conv2dConfig, image: [usize; 2]) -> Self {
        self.tape().apply(Conv2dInput { config: *config, image }, &[self, weight])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Tape;
    use crate::check::spread;
    use crate::s;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn convolution_agrees_with_seven_loops(
            n in 0usize..3, c in 0usize..3, o in 0usize..4, image in [1usize..7, 1usize..7],
            kernel in [1usize..4, 1usize..4], stride in [1usize..3, 1usize..3], padding in [0usize..3, 0usize..3],
            dilation in [1usize..3, 1usize..3]
        ) {
            let config = Conv2dConfig { stride, padding, dilation };
            let tape = Tape::<f64>::new();
            let x = tape.constant(spread(&[n, c, image[0], image[1]], &[-1.0..1.0], 1));
            let w = tape.constant(spread(&[o, c, kernel[0], kernel[1]], &[-1.0..1.0], 2));
            let b = tape.constant(spread(&[o], &[-1.0..1.0], 3));
            let Ok(y) = tape.try_apply(Conv2d(config), &[&x, &w, &b]) else { return Ok(()) };
            let (x, w, y, b) = (x.value().view(), w.value().view(), y.value().view(), b.value().as_slice());
            for (at, &y) in y.indexed_iter() {
                let mut sum = b[at[1]];
                for k in 0..c {
                    for (i, j) in (0..kernel[0]).flat_map(|i| (0..kernel[1]).map(move |j| (i, j))) {
                        let row = (at[2] * stride[0] + i * dilation[0]).wrapping_sub(padding[0]);
                        let column = (at[3] * stride[1] + j * dilation[1]).wrapping_sub(padding[1]);
                        if row < image[0] && column < image[1] {
                            sum += w[[at[1], k, i, j]] * x[[at[0], k, row, column]];
                        }
                    }
                }
                prop_assert!((y - sum).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn a_large_image_is_convolved_strip_by_strip() {
        let (c, o, [height, width], stride) = (48, 3, [130, 171], [1, 2]);
        let config = Conv2dConfig { stride, padding: [2, 1], dilation: [2, 1] };
        let tape = Tape::<f64>::new();
        let x = tape.constant(spread(&[2, c, height, width], &[-1.0..1.0], 1));
        let w = tape.constant(spread(&[o, c, 3, 3], &[-1.0..1.0], 2));
        let b = tape.constant(spread(&[o], &[-1.0..1.0], 3));
        let s = Sizes::new(&config, x.shape(), w.shape());
        let ([rows, _], strip) = (s.windows.output(), s.strip());
        assert!(strip > 1 && rows > strip && !rows.is_multiple_of(strip), "strips of {strip} of {rows} rows");
        let [y, plain] = [x.conv2d_bias(&w, &b, &config), x.conv2d(&w, &config)];
        // The rows of each side of an edge, and those at the ends, from the rows of the image that they see.
        for row in [0, strip - 1, strip, rows - 1] {
            let first = row.max(2) - 2;
            let seen = x.slice(s![.., .., first..height.min(row + 3)]);
            let expected = seen.conv2d_bias(&w, &b, &config);
            let expected = expected.slice(s![.., .., row - first..row - first + 1]);
            assert!(y.slice(s![.., .., row..row + 1]).value().allclose(expected.value(), 1e-12, 1e-12), "row {row}");
        }
        let difference = y - plain - b.reshape(&[o, 1, 1]);
        assert!(difference.abs().value().as_slice().iter().all(|x| *x <= 1e-12));
    }

    /// Value and gradients of a batch that is large enough for several threads.
    fn large() -> Vec<Tensor<f32>> {
        let tape = Tape::<f32>::new();
        let x = tape.leaf(spread(&[37, 3, 17, 16], &[-1.0..1.0], 1).cast());
        let w = tape.leaf(spread(&[8, 3, 3, 3], &[-1.0..1.0], 2).cast());
        let b = tape.leaf(spread(&[8], &[-1.0..1.0], 3).cast());
        let y = x.conv2d_bias(&w, &b, &Conv2dConfig { padding: [1, 1], ..Default::default() });
        let mut all = y.max_pool2d(&crate::Pool2dConfig::new([2, 2])).square().sum().grad(&[&x, &w, &b]);
        all.push(y.into_value());
        all
    }

    #[test]
    fn the_bits_do_not_depend_on_the_number_of_threads() {
        // On one of rayon's threads nothing is cut.
        let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(large);
        assert!(alone == large());
    }

    #[test]
    fn extents_that_do_not_fit_are_shape_errors() {
        let tape = Tape::<f32>::new();
        let zeros = |shape: &[usize]| tape.constant(Tensor::zeros(shape));
        let conv = Conv2d(Conv2dConfig::default());
        let error = |inputs: &[&Var<'_, f32>]| tape.try_apply(conv, inputs).unwrap_err().to_string();
        let x = zeros(&[1, 2, 4, 4]);
        assert!(error(&[&x, &zeros(&[3, 1, 2, 2])]).contains("the weight takes 1 channels"));
        assert!(error(&[&x, &zeros(&[3, 2, 5, 2])]).contains("does not fit an image [4, 4]"));
        assert!(error(&[&x, &zeros(&[3, 2, 2])]).contains("the weight must have four axes"));
        assert!(error(&[&x, &zeros(&[3, 2, 2, 2]), &zeros(&[2])]).contains("the bias must have shape [3]"));
        let still = Conv2d(Conv2dConfig { stride: [0, 1], ..Default::default() });
        assert!(tape.try_apply(still, &[&x, &zeros(&[3, 2, 2, 2])]).unwrap_err().to_string().contains("positive"));
    }
}
