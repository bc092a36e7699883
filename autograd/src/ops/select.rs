//! Comparisons, selection by a mask, and interpolation.

use crate::error::ensure;
use crate::{Cases, Formula, Grads, Op, Operand, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::{Mask, Pool, Real, Scalar, Shape, Tensor, broadcast_shape, choose};

/// y = yes where the mask is true, else no.
#[derive(Clone)]
pub struct Where(pub Mask);

impl<T: Scalar> Op<T> for Where {
    fn name(&self) -> &'static str {
        "where"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let [yes, no] = x else { return Err("two choices, and the mask between them".into()) };
        broadcast_shape(&[self.0.shape(), yes, no])
            .ok_or_else(|| format!("they do not broadcast with a mask of shape {:?}", self.0.shape()))
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        choose(&self.0, x[0], x[1], pool)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        // Chosen and not multiplied: an infinite gradient on one side leaves no NaN on the other.
        let (g, zero) = (cx.g(), cx.g().constant(0.0));
        let yes = cx.needs(0).then(|| cx.tape().apply(self.clone(), &[g, &zero]).sum_to(cx.shape(0)));
        let no = cx.needs(1).then(|| cx.tape().apply(self.clone(), &[&zero, g]).sum_to(cx.shape(1)));
        Grads::new([yes, no])
    }
}

/// y = a + w (b - a), and exactly b for w = 1; da = g (1 - w), db = g w, dw = g (b - a).
#[derive(Clone, Copy)]
pub struct Lerp;

impl Lerp {
    /// `(b - a) c` and c, which is 1, or 1/2 where the difference overflows.
    #[inline(always)]
    fn difference<E: Real>(a: E, b: E) -> [E; 2] {
        let (zero, half, one) = (a.like(0.0), a.like(0.5), a.like(1.0));
        let scale = (one + (b - a) * zero).if_positive(one, half);
        [b * scale - a * scale, scale]
    }
}

impl Formula<3> for Lerp {
    const NAME: &'static str = "lerp";
    #[inline(always)]
    fn f<E: Real>(&self, [a, b, w]: [E; 3]) -> E {
        let [difference, scale] = Lerp::difference(a, b);
        // From the nearer end.
        let is_far = w - w.like(0.5);
        let (from, share) = (is_far.if_positive(b, a), is_far.if_positive(w - w.like(1.0), w));
        share.mul_add(difference, from * scale) / scale
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [a, b, w]: [E; 3], _y: E) -> [E; 3] {
        let [difference, scale] = Lerp::difference(a, b);
        [g * (w.like(1.0) - w), g * w, g * difference / scale]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).domain(-3.0..3.0).domain(-1.0..2.0);
        c.at([0.1, 0.7, 0.0], 0.1, [1.0, 0.0, 0.6]).at([0.1, 0.7, 1.0], 0.7, [0.0, 1.0, 0.6]);
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// A comparison of values that broadcast together.
    #[track_caller]
    fn compare(&self, op: &'static str, other: impl Operand<'t, T>, holds: fn(&Tensor<T>, &Tensor<T>) -> Mask) -> Mask {
        let other = other.on(self.tape());
        let fits = broadcast_shape(&[self.shape(), other.shape()]).is_some();
        self.tape().fits(op, &[self, &other], ensure(fits, || "the shapes do not broadcast".into()));
        holds(self.value(), other.value())
    }

    /// Where `self > other`. Shapes broadcast. NaN compares as in Rust: it equals no number.
    ///
    /// The result is a [`Mask`], which has no gradient. Use it in [`where_`](Self::where_) and
    /// [`masked_select`](Self::masked_select), or convert it to numbers with [`Mask::cast`].
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from([-2.0, 0.0, 3.0]));
    /// assert_eq!((x.gt(-1.0) & x.lt(1.0)).as_slice(), [false, true, false]);
    /// ```
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn gt(&self, other: impl Operand<'t, T>) -> Mask {
        self.compare("gt", other, |a, b| a.gt(b))
    }

    /// Where `self >= other`; see [`gt`](Self::gt).
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn ge(&self, other: impl Operand<'t, T>) -> Mask {
        self.compare("ge", other, |a, b| a.ge(b))
    }

    /// Where `self < other`; see [`gt`](Self::gt).
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn lt(&self, other: impl Operand<'t, T>) -> Mask {
        self.compare("lt", other, |a, b| a.lt(b))
    }

    /// Where `self <= other`; see [`gt`](Self::gt).
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn le(&self, other: impl Operand<'t, T>) -> Mask {
        self.compare("le", other, |a, b| a.le(b))
    }

    /// Where both are equal; see [`gt`](Self::gt).
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    #[doc(alias = "eq")]
    pub fn elementwise_eq(&self, other: impl Operand<'t, T>) -> Mask {
        self.compare("elementwise_eq", other, |a, b| a.elementwise_eq(b))
    }

    /// `self` where `mask` is true, else `other` (`torch.where`; `where` is a Rust keyword). All three broadcast
    /// together. The gradient goes to the selected operand.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from([-2.0, 0.0, 3.0]));
    /// let y = x.square().where_(&x.lt(1.0), &x);
    /// assert_eq!(y.value(), [4.0, 0.0, 3.0]);
    /// assert_eq!(y.sum().grad(&[&x])[0], [-4.0, 0.0, 1.0]);
    /// ```
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn where_(&self, mask: &Mask, other: impl Operand<'t, T>) -> Self {
        self.tape().apply(Where(mask.clone()), &[self, &other.on(self.tape())])
    }

    /// The elements where `mask` is true, as a vector in row-major order (`x[mask]` in NumPy, `torch.masked_select`).
    ///
    /// # Panics
    /// If the mask has another shape.
    #[track_caller]
    pub fn masked_select(&self, mask: &Mask) -> Self {
        let same = ensure(mask.shape() == self.shape(), || format!("the mask has the shape {:?}", mask.shape()));
        self.fits("masked_select", same);
        self.reshape(&[self.value().len()]).gather_rows(mask.flatnonzero())
    }

    /// Linear interpolation, `self + weight * (end - self)`, exact at weights 0 and 1. Shapes broadcast.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn lerp(&self, end: impl Operand<'t, T>, weight: impl Operand<'t, T>) -> Self {
        Lerp.on([self, &end.on(self.tape()), &weight.on(self.tape())])
    }
}

#[cfg(test)]
mod tests {
    use crate::{Scalar, Tape, Tensor};

    #[test]
    fn comparisons_broadcast_and_nan_equals_nothing() {
        let tape = Tape::<f64>::new();
        let a = tape.leaf(Tensor::from([1.0, 2.0, f64::INFINITY, f64::NAN]));
        let b = Tensor::from([2.0, 2.0, f64::INFINITY, f64::NAN]);
        let all = [a.gt(&b), a.ge(&b), a.lt(&b), a.le(&b), a.elementwise_eq(&b)];
        let expected = [[0, 0, 0, 0], [0, 1, 1, 0], [1, 0, 0, 0], [1, 1, 1, 0], [0, 1, 1, 0]];
        for (got, expected) in all.iter().zip(expected) {
            assert_eq!(got.as_slice(), expected.map(|x| x == 1));
        }
        assert_eq!(a.gt(Tensor::zeros(&[0, 1])).shape(), [0, 4]);
    }

    #[test]
    fn what_a_mask_picks_gets_the_gradient() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::from([[1.0, -2.0], [3.0, 4.0]]));
        let y = x.square().masked_select(&x.gt(0.0));
        assert_eq!(y.value(), &Tensor::from([1.0, 9.0, 16.0]));
        assert_eq!(y.sum().grad(&[&x])[0], Tensor::from([[2.0, 0.0], [6.0, 8.0]]));
        assert!(tape.try_run(|| x.masked_select(&x.slice_axis(0, ..1).gt(0.0))).is_err());
    }

    #[test]
    fn select_infinite_gradient_stays_on_its_side() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::from_vec(&[2], vec![0.0, 4.0]));
        let y = x.sqrt().where_(&x.gt(1.0), &x).sum();
        // The root's own slope at 0 is infinite, and 0 times it is NaN: the user must keep the root away from 0.
        let safe = x.maximum(1.0).sqrt().where_(&x.gt(1.0), &x).sum();
        assert!(y.grad(&[&x])[0].as_slice()[0].is_nan());
        assert_eq!(safe.grad(&[&x])[0], [1.0, 0.25]);
        // One that comes from behind: the side that was not chosen gets 0 and not infinity times 0.
        let (a, b) = (tape.leaf(Tensor::from([1.0, 2.0])), tape.leaf(Tensor::from([3.0, 4.0])));
        let chosen = a.where_(&a.gt(1.5), &b);
        let grads = (chosen * Tensor::from([f64::INFINITY, f64::INFINITY])).sum().grad(&[&a, &b]);
        assert_eq!((grads[0].to_vec(), grads[1].to_vec()), (vec![0.0, f64::INFINITY], vec![f64::INFINITY, 0.0]));
    }

    #[test]
    fn interpolation_meets_its_ends_exactly() {
        let tape = Tape::<f32>::new();
        let (a, b) = (tape.leaf(Tensor::scalar(1e8)), tape.leaf(Tensor::scalar(0.1)));
        assert_eq!(a.lerp(&b, 1.0).item(), 0.1);
        assert_eq!(a.lerp(&b, 0.0).item(), 1e8);
    }

    #[test]
    fn interpolation_between_ends_whose_difference_overflows() {
        fn check<T: Scalar>(most: f64) {
            let tape = Tape::<T>::new();
            let [a, b, w] = [most, -most, 0.25].map(|x| tape.leaf(Tensor::scalar(T::from_f64(x))));
            let y = a.lerp(&b, &w);
            assert_eq!(y.item(), T::from_f64(0.5 * most));
            assert_eq!((y * 0.25).grad(&[&w])[0].item(), T::from_f64(-0.5 * most));
        }
        check::<f32>(f32::MAX.into());
        check::<f64>(f64::MAX);
        // The unit of the smallest numbers is kept where it does not.
        let tape = Tape::<f64>::new();
        let [a, b] = [0.0, 5e-324].map(|x| tape.leaf(Tensor::scalar(x)));
        assert_eq!(a.lerp(&b, 1.0).item(), 5e-324);
    }
}
