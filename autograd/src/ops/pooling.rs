//! Max and average pooling of images `[n, channels, height, width]`. Channels run in parallel on rayon's threads.

use super::pick::{Method, PIXELS, Pick, Places, Put};
use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::parallel::chunks;
use raygrad_tensor::scale::powers;
use raygrad_tensor::{Indices, Pool, Scalar, Shape, Tensor, Windows, map};
use serde::{Deserialize, Serialize};

/// Kernel, stride and padding of a 2-D pooling, by axis: `[rows, columns]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Pool2dConfig {
    /// Height and width of a window.
    pub kernel: [usize; 2],
    /// Pixels from one window to the next; at least 1.
    pub stride: [usize; 2],
    /// Rows and columns of padding at both ends; at most half the window.
    pub padding: [usize; 2],
}

impl Pool2dConfig {
    /// Adjacent windows without overlap or padding.
    pub fn new(kernel: [usize; 2]) -> Self {
        Pool2dConfig { kernel, stride: kernel, padding: [0, 0] }
    }

    fn windows(&self, shape: &[usize]) -> Result<Windows, ShapeError> {
        let &[_, _, height, width] = shape else { return Err("the image must have four axes".into()) };
        if (0..2).any(|axis| self.padding[axis] > self.kernel[axis] / 2) {
            return Err(format!("padding {:?} is more than half the window {:?}", self.padding, self.kernel));
        }
        if height == 0 || width == 0 {
            return Err("the image has no pixels".into());
        }
        Windows::new([height, width], self.kernel, self.stride, self.padding, [1, 1])
    }

    /// The windows for a shape that [`windows`](Self::windows) has accepted.
    fn accepted(&self, shape: &[usize]) -> Windows {
        match self.windows(shape) {
            Ok(windows) => windows,
            Err(_) => unreachable!("`shape` has accepted these extents"),
        }
    }

    fn pooled(&self, shape: &[usize]) -> Result<Shape, ShapeError> {
        let [height, width] = self.windows(shape)?.output();
        Ok([shape[0], shape[1], height, width].into_iter().collect())
    }
}

/// y = the largest element of each window, NaN if there is one; padding is ignored. dx = [`Put`] of g at the first
/// largest element.
#[derive(Clone, Copy)]
pub struct MaxPool2d(
    /// The windows.
    pub Pool2dConfig,
);

/// y = the mean of each window; padding counts as 0. dx = [`AvgPool2dInput`] of g.
#[derive(Clone, Copy)]
pub struct AvgPool2d(
    /// The windows.
    pub Pool2dConfig,
);

/// The adjoint of [`AvgPool2d`]: adds each element, divided by the size of a window, to all of its window.
#[derive(Clone, Copy)]
pub struct AvgPool2dInput {
    /// The windows.
    pub config: Pool2dConfig,
    /// Height and width of the output.
    pub image: [usize; 2],
}

/// Gradients of one pixel that are added in their own type.
const FEW: usize = 16;

/// The last two extents replaced.
fn with_plane(shape: &[usize], plane: [usize; 2]) -> Shape {
    let mut out = Shape::from_slice(shape);
    let lead = out.len() - 2;
    out[lead..].copy_from_slice(&plane);
    out
}

/// Number of elements of the last two axes together.
fn plane_len(shape: &[usize]) -> usize {
    shape[shape.len() - 2..].iter().product()
}

/// A tensor of `shape`; `f(plane of x, plane of the output)` writes each plane.
fn planes<T: Scalar>(
    x: &Tensor<T>,
    shape: &[usize],
    pool: &Pool<T>,
    f: impl Fn(&[T], &mut [T]) + Send + Sync,
) -> Tensor<T> {
    let mut out = pool.tensor(shape);
    let (from, to) = (plane_len(x.shape()), plane_len(shape));
    // Each task would copy a view.
    let x = x.as_slice();
    let each = |_: &mut (), i: usize, out: &mut [T]| f(&x[i * from..][..from], out);
    chunks(out.as_mut_slice(), to, 2 * x.len().max(shape.iter().product()), || (), &each);
    out
}

/// `means(x, size)`, sums of at most `size` elements of `x` divided by `size`. A sum may overflow where its mean does not.
fn in_range<T: Scalar>(
    x: &Tensor<T>,
    size: usize,
    pool: &Pool<T>,
    means: impl Fn(&Tensor<T>, T) -> Tensor<T>,
) -> Tensor<T> {
    let size = T::from_f64(size as f64);
    let quick = means(x, size);
    if quick.is_finite() {
        return quick;
    }
    // Half the reciprocal of the size, rounded down to a power of two: exact, and no sum of such products overflows.
    let [down, _] = powers(size + size);
    let small = means(&x.map(|x| x * down), size * down);
    // Other means have their digits, which small elements lose.
    map(
        [&quick, &small],
        pool,
        #[inline(always)]
        |[mean, small]| if mean.is_finite() { mean } else { small },
    )
}

impl MaxPool2d {
    /// The indices of the largest elements in each single-channel image: `[images, windows]`.
    fn index<T: Scalar>(&self, x: &Tensor<T>) -> Indices {
        let windows = self.0.accepted(x.shape());
        let (from, to) = (plane_len(x.shape()), windows.count());
        let mut index = vec![0; x.len() / from * to];
        let x = x.as_slice();
        let each = |best: &mut Vec<T>, i: usize, out: &mut [u32]| {
            windows.arg_maxima(&x[i * from..][..from], best, out);
        };
        chunks(&mut index, to, 4 * x.len(), || vec![T::ZERO; to], &each);
        Indices::new(&[x.len() / from, to], index)
    }
}

impl<T: Scalar> Op<T> for MaxPool2d {
    fn name(&self) -> &'static str {
        "max_pool2d"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let shape = self.0.pooled(x[0])?;
        // The gradient names places in 32 bits.
        match plane_len(x[0]) {
            pixels if u32::try_from(pixels).is_err() => Err(format!("an image of {pixels} pixels is too large")),
            _ => Ok(shape),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let windows = self.0.accepted(x[0].shape());
        planes(x[0], &with_plane(x[0].shape(), windows.output()), pool, |x, y| windows.maxima(x, y))
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let index = self.index(cx.x(0).value());
        let g = cx.g().reshape(index.shape());
        let method = Method { few_meet: self.0.accepted(cx.shape(0)).overlap() <= FEW, ..PIXELS };
        let pick = Pick { method, axis: 1, places: Places::Elements(index) };
        let put = Put { pick, extent: plane_len(cx.shape(0)) };
        Grads::one(cx.tape().apply(put, &[&g]).reshape(cx.shape(0)))
    }
}

impl<T: Scalar> Op<T> for AvgPool2d {
    fn name(&self) -> &'static str {
        "avg_pool2d"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        self.0.pooled(x[0])
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let windows = self.0.accepted(x[0].shape());
        let shape = with_plane(x[0].shape(), windows.output());
        in_range(x[0], windows.kernel_len(), pool, |x, size| {
            planes(x, &shape, pool, |x, y| {
                windows.sums(x, y);
                y.iter_mut().for_each(|y| *y = *y / size);
            })
        })
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let op = AvgPool2dInput { config: self.0, image: [cx.shape(0)[2], cx.shape(0)[3]] };
        Grads::one(cx.tape().apply(op, &[cx.g()]))
    }
}

impl<T: Scalar> Op<T> for AvgPool2dInput {
    fn name(&self) -> &'static str {
        "avg_pool2d_input"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0].len() != 4 {
            return Err("the input must have four axes".into());
        }
        let out = with_plane(x[0], self.image);
        match self.config.pooled(&out)? {
            pooled if pooled.as_slice() == x[0] => Ok(out),
            pooled => Err(format!("images {out:?} are pooled to {pooled:?}")),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let shape = with_plane(x[0].shape(), self.image);
        let windows = self.config.accepted(&shape);
        in_range(x[0], windows.kernel_len(), pool, |g, size| {
            planes(g, &shape, pool, |g, x| {
                x.fill(T::ZERO);
                windows.spread(g, x);
                x.iter_mut().for_each(|x| *x = *x / size);
            })
        })
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(AvgPool2d(self.config), &[cx.g()]))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// Max pooling: the largest element of each window of images `[n, channels, height, width]`. It is NaN if the
    /// window has a NaN; padding is ignored.
    ///
    /// The result is `[n, channels, oh, ow]` with `oh = (height + 2 padding - kernel) / stride + 1`, rounded down. The
    /// gradient goes to the first of equal elements, in row-major order.
    ///
    /// ```
    /// use raygrad_autograd::{Pool2dConfig, Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from_vec(&[1, 1, 2, 2], vec![1.0, 3.0, 3.0, 2.0]));
    /// let y = x.max_pool2d(&Pool2dConfig::new([2, 2]));
    /// assert_eq!(y.item(), 3.0);
    /// assert_eq!(y.grad(&[&x])[0].as_slice(), [0.0, 1.0, 0.0, 0.0]);
    /// ```
    ///
    /// # Panics
    /// If there are not four axes, or an image has no pixels or at least 2^32. If a window is larger than the padded
    /// image, the padding is more than half a window, or a stride is 0.
    #[track_caller]
    pub fn max_pool2d(&self, config: &Pool2dConfig) -> Self {
        self.tape().apply(MaxPool2d(*config), &[self])
    }

    /// Average pooling: the mean of each window of images `[n, channels, height, width]`. Padding counts as zeros.
    ///
    /// The result is `[n, channels, oh, ow]` with `oh = (height + 2 padding - kernel) / stride + 1`, rounded down. The
    /// gradient is spread evenly over the window.
    ///
    /// # Panics
    /// Where [`max_pool2d`](Self::max_pool2d) panics.
    #[track_caller]
    pub fn avg_pool2d(&self, config: &Pool2dConfig) -> Self {
        self.tape().apply(AvgPool2d(*config), &[self])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Tape;

    #[test]
    fn windows_that_see_only_padding_are_refused() {
        let tape = Tape::<f32>::new();
        let x = tape.constant(Tensor::zeros(&[1, 1, 4, 4]));
        let op = |kernel, padding| MaxPool2d(Pool2dConfig { padding, ..Pool2dConfig::new(kernel) });
        for (kernel, padding) in [([2, 2], [2, 1]), ([4, 3], [2, 2])] {
            let error = tape.try_apply(op(kernel, padding), &[&x]).unwrap_err().to_string();
            assert!(error.contains("more than half the window"), "{error}");
        }
        assert_eq!(tape.try_apply(op([4, 3], [2, 1]), &[&x]).unwrap().shape(), [1, 1, 2, 2]);
        assert!(tape.try_apply(op([5, 2], [0, 0]), &[&x]).unwrap_err().to_string().contains("does not fit"));
        let empty = tape.constant(Tensor::zeros(&[1, 1, 0, 4]));
        assert!(tape.try_apply(op([1, 1], [0, 0]), &[&empty]).unwrap_err().to_string().contains("no pixels"));
    }

    #[test]
    fn images_that_are_too_large_are_shape_errors() {
        let tape = Tape::<f32>::new();
        let image = tape.constant(Tensor::zeros(&[1, 1, 4, 4]));
        // No image at all, of pixels that 32 bits cannot count.
        let many = tape.constant(Tensor::zeros(&[0, 1, 1 << 16, 1 << 16]));
        let error = tape.try_apply(MaxPool2d(Pool2dConfig::new([1, 1])), &[&many]).unwrap_err().to_string();
        assert!(error.contains("an image of 4294967296 pixels is too large"), "{error}");
        assert!(tape.try_apply(AvgPool2d(Pool2dConfig::new([1, 1])), &[&many]).is_ok());
        let op = AvgPool2dInput { config: Pool2dConfig::new([1, 1]), image: [1 << 32, 1 << 32] };
        assert!(tape.try_apply(op, &[&image]).unwrap_err().to_string().contains("too many elements"));
    }
}
