//! Max and average pooling of images `[n, channels, height, width]`. Channels run on rayon's threads.

use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::parallel::chunks;
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, Windows, checked_len};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The windows of a 2-D pooling, by axis: `[rows, columns]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Pool2dConfig {
    /// Extents of a window.
    pub kernel: [usize; 2],
    /// Pixels from one window to the next; at least 1.
    pub stride: [usize; 2],
    /// Rows and columns of padding at both ends; at most half the window.
    pub padding: [usize; 2],
}

impl Pool2dConfig {
    /// Windows side by side, without padding.
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

    /// The windows of a shape that [`windows`](Self::windows) has accepted.
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

/// y = the largest element of each window, NaN if there is one; padding does not count. dx = [`ScatterPlanes`] of g: to
/// the first element that is the largest.
#[derive(Clone, Copy)]
pub struct MaxPool2d(
    /// The windows.
    pub Pool2dConfig,
);

/// y = the elements of each plane (the last two axes) at the positions that an index names; dx = [`ScatterPlanes`].
#[derive(Clone)]
pub struct GatherPlanes {
    /// For each element of the output its position in its plane of the input, row-major.
    pub index: Arc<[u32]>,
    /// The last two extents of the output.
    pub plane: [usize; 2],
}

/// The adjoint of [`GatherPlanes`]: zeros to which each element is added at its position.
#[derive(Clone)]
pub struct ScatterPlanes {
    /// For each element of the input its position in its plane of the output, row-major.
    pub index: Arc<[u32]>,
    /// The last two extents of the output.
    pub plane: [usize; 2],
}

/// y = the mean of each window; padding counts as 0. dx = [`AvgPool2dInput`] of g.
#[derive(Clone, Copy)]
pub struct AvgPool2d(
    /// The windows.
    pub Pool2dConfig,
);

/// The adjoint of [`AvgPool2d`]: each element, divided by the size of a window, added to all of its window.
#[derive(Clone, Copy)]
pub struct AvgPool2dInput {
    /// The windows.
    pub config: Pool2dConfig,
    /// Height and width of the output.
    pub image: [usize; 2],
}

/// The last two extents replaced.
fn with_plane(shape: &[usize], plane: [usize; 2]) -> Shape {
    let mut out = Shape::from_slice(shape);
    let lead = out.len() - 2;
    out[lead..].copy_from_slice(&plane);
    out
}

/// Elements of the last two axes together.
fn plane_len(shape: &[usize]) -> usize {
    shape[shape.len() - 2..].iter().product()
}

/// A tensor of `shape` of which `f(plane of x, plane of the output)` writes each plane.
fn planes<T: Scalar>(
    x: &Tensor<T>,
    shape: &[usize],
    pool: &Pool<T>,
    f: impl Fn(&[T], &mut [T]) + Send + Sync,
) -> Tensor<T> {
    let mut out = pool.tensor(shape);
    let (from, to) = (plane_len(x.shape()), plane_len(shape));
    let each = |_: &mut (), i: usize, out: &mut [T]| f(&x.as_slice()[i * from..][..from], out);
    chunks(out.as_mut_slice(), to, 2 * x.len().max(shape.iter().product()), || (), &each);
    out
}

impl MaxPool2d {
    /// Where the largest elements stand, for [`GatherPlanes`].
    fn index<T: Scalar>(&self, x: &Tensor<T>) -> Arc<[u32]> {
        let windows = self.0.accepted(x.shape());
        let (from, to) = (plane_len(x.shape()), windows.count());
        let mut index = vec![0; x.len() / from * to];
        let each = |best: &mut Vec<T>, i: usize, out: &mut [u32]| {
            windows.arg_maxima(&x.as_slice()[i * from..][..from], best, out);
        };
        chunks(&mut index, to, 4 * x.len(), || vec![T::ZERO; to], &each);
        index.into()
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
        let plane = [cx.shape(0)[2], cx.shape(0)[3]];
        Grads::one(cx.tape().apply(ScatterPlanes { index: self.index(cx.x(0).value()), plane }, &[cx.g()]))
    }
}

/// The shape with another plane, or why the index does not fit: `elements` is what it must count, and its values lie
/// below `bound`.
fn check_planes(x: &[usize], plane: [usize; 2], index: &[u32], scatter: bool) -> Result<Shape, ShapeError> {
    if x.len() < 2 {
        return Err("there must be two axes at least".into());
    }
    let out = with_plane(x, plane);
    if checked_len(&out).is_none() {
        return Err(format!("planes of {plane:?} have too many elements"));
    }
    let (indexed, bound) = if scatter { (x, plane_len(&out)) } else { (&out[..], plane_len(x)) };
    if indexed.iter().product::<usize>() != index.len() {
        return Err(format!("{} indices for {indexed:?}", index.len()));
    }
    match index.iter().enumerate().find(|&(_, &position)| position as usize >= bound) {
        None => Ok(out),
        Some((i, position)) => Err(format!("index {i} is {position}, but a plane has {bound} elements")),
    }
}

impl<T: Scalar> Op<T> for GatherPlanes {
    fn name(&self) -> &'static str {
        "gather_planes"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        check_planes(x[0], self.plane, &self.index, false)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(&with_plane(x[0].shape(), self.plane));
        let (from, to) = (plane_len(x[0].shape()), plane_len(out.shape()).max(1));
        let each = |_: &mut (), i: usize, out: &mut [T]| {
            let x = &x[0].as_slice()[i * from..][..from];
            out.iter_mut().zip(&self.index[i * to..]).for_each(|(out, &at)| *out = x[at as usize]);
        };
        chunks(out.as_mut_slice(), to, self.index.len(), || (), &each);
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let [.., height, width] = *cx.shape(0) else { unreachable!("`shape` wants two axes") };
        let op = ScatterPlanes { index: self.index.clone(), plane: [height, width] };
        Grads::one(cx.tape().apply(op, &[cx.g()]))
    }
}

impl<T: Scalar> Op<T> for ScatterPlanes {
    fn name(&self) -> &'static str {
        "scatter_planes"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        check_planes(x[0], self.plane, &self.index, true)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(&with_plane(x[0].shape(), self.plane));
        let (from, to) = (plane_len(x[0].shape()), plane_len(out.shape()).max(1));
        let each = |_: &mut (), i: usize, out: &mut [T]| {
            out.fill(T::ZERO);
            let x = &x[0].as_slice()[i * from..][..from];
            x.iter().zip(&self.index[i * from..]).for_each(|(&x, &at)| out[at as usize] += x);
        };
        let work = 2 * self.index.len() + out.len();
        chunks(out.as_mut_slice(), to, work, || (), &each);
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let [.., height, width] = *cx.shape(0) else { unreachable!("`shape` wants two axes") };
        let op = GatherPlanes { index: self.index.clone(), plane: [height, width] };
        Grads::one(cx.tape().apply(op, &[cx.g()]))
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
        let size = T::from_f64(windows.kernel_len() as f64);
        planes(x[0], &with_plane(x[0].shape(), windows.output()), pool, |x, y| {
            windows.sums(x, y);
            y.iter_mut().for_each(|y| *y = *y / size);
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
        let size = T::from_f64(windows.kernel_len() as f64);
        planes(x[0], &shape, pool, |g, x| {
            x.fill(T::ZERO);
            windows.spread(g, x);
            x.iter_mut().for_each(|x| *x = *x / size);
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
    /// The largest element of each window of images `[n, channels, height, width]`, NaN if there is one; padding does
    /// not count. The result is `[n, channels, oh, ow]` with `oh = (height + 2 padding - kernel) / stride + 1`, rounded
    /// down. The gradient goes to the first of equal elements, in row-major order.
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
    /// If there are not four axes, the image has no pixels or 2^32 and more, a window is larger than the padded image, the
    /// padding is more than half a window, or a stride is 0.
    #[track_caller]
    pub fn max_pool2d(&self, config: &Pool2dConfig) -> Self {
        self.tape().apply(MaxPool2d(*config), &[self])
    }

    /// The mean of each window of images `[n, channels, height, width]`, where padding counts as zeros. The result is
    /// `[n, channels, oh, ow]` with `oh = (height + 2 padding - kernel) / stride + 1`, rounded down. The gradient is
    /// spread evenly over the window.
    ///
    /// # Panics
    /// As [`max_pool2d`](Self::max_pool2d).
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
    fn an_index_beyond_the_plane_is_a_shape_error() {
        let tape = Tape::<f32>::new();
        let x = tape.constant(Tensor::zeros(&[1, 2, 2]));
        let error = tape.try_apply(GatherPlanes { index: [0, 4].into(), plane: [1, 2] }, &[&x]).unwrap_err();
        assert!(error.to_string().contains("index 1 is 4, but a plane has 4 elements"), "{error}");
        let error = tape.try_apply(ScatterPlanes { index: [0, 4].into(), plane: [1, 2] }, &[&x]).unwrap_err();
        assert!(error.to_string().contains("2 indices for [1, 2, 2]"), "{error}");
    }

    #[test]
    fn planes_whose_sizes_wrap_are_shape_errors() {
        let tape = Tape::<f32>::new();
        let x = tape.constant(Tensor::zeros(&[1, 2, 2]));
        let half = 1 << (usize::BITS - 1);
        let error = |op: &dyn Fn() -> Result<(), crate::Error>| op().unwrap_err().to_string();
        // A plane of 2 (2^63 + 1) elements, that is of 2, and one of 2^64, that is of none.
        let gather = GatherPlanes { index: [0, 0].into(), plane: [half + 1, 2] };
        let scatter = ScatterPlanes { index: [0; 4].into(), plane: [1 << 32, 1 << 32] };
        for message in [
            error(&|| tape.try_apply(gather.clone(), &[&x]).map(drop)),
            error(&|| tape.try_apply(scatter.clone(), &[&x]).map(drop)),
        ] {
            assert!(message.contains("have too many elements"), "{message}");
        }
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
