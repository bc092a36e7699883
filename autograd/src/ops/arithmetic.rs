//! Addition, subtraction, multiplication and division, also with constants.

use super::power::ConstPowi;
use crate::slopes::multiple;
use crate::{Cases, Formula, Grads, Op, Operand, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::{Pool, Real, Scalar, Shape, Tensor, map};

/// y = a + b.
#[derive(Clone, Copy)]
pub struct Add;
impl Formula<2> for Add {
    const NAME: &'static str = "add";
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        a + b
    }
    fn cases(&self, c: &mut Cases) {
        c.linear().domain(-3.0..3.0).domain(-3.0..3.0);
        c.at([1e30, -1e30], 0.0, [1.0, 1.0]).at([f64::INFINITY, 1.0], f64::INFINITY, [1.0, 1.0]);
    }
}

/// y = a - b.
#[derive(Clone, Copy)]
pub struct Sub;
impl Formula<2> for Sub {
    const NAME: &'static str = "sub";
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        a - b
    }
    fn cases(&self, c: &mut Cases) {
        c.linear().domain(-3.0..3.0).domain(-3.0..3.0);
        c.at([1e30, 1e30], 0.0, [1.0, -1.0]).at([1.0, f64::INFINITY], f64::NEG_INFINITY, [1.0, -1.0]);
    }
}

/// y = a b.
#[derive(Clone, Copy)]
pub struct Mul;
impl Formula<2> for Mul {
    const NAME: &'static str = "mul";
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        a * b
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).domain(-3.0..3.0);
        c.at([0.0, 5.0], 0.0, [5.0, 0.0]).at([f64::INFINITY, 2.0], f64::INFINITY, [2.0, f64::INFINITY]);
        c.at([0.0, f64::INFINITY], f64::NAN, [f64::INFINITY, 0.0]);
    }
}

/// y = a b + c, rounded once; the rounding error of a product is one of these.
#[derive(Clone, Copy)]
pub struct MulAdd;
impl Formula<3> for MulAdd {
    const NAME: &'static str = "mul_add";
    #[inline(always)]
    fn f<E: Real>(&self, [a, b, c]: [E; 3]) -> E {
        a.mul_add(b, c)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).domain(-3.0..3.0).domain(-3.0..3.0);
        // (1 + 2^-23)^2 - (1 + 2^-22) in f32, whose rounded product is the second number.
        let x = 1.0 + 2.0_f64.powi(-23);
        c.at([x, x, -1.0 - 2.0_f64.powi(-22)], 2.0_f64.powi(-46), [x, x, 1.0]);
    }
}

/// y = a / b; da = g / b, db = -g a / b^2. Division by 0 follows IEEE 754.
#[derive(Clone, Copy)]
pub struct Div;
impl Formula<2> for Div {
    const NAME: &'static str = "div";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        a / b
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).domain(0.5..3.0);
        c.at([0.0, 2.0], 0.0, [0.5, 0.0]).at([1.0, f64::INFINITY], 0.0, [0.0, 0.0]);
        c.at([1.0, 0.0], f64::INFINITY, [f64::INFINITY, f64::NEG_INFINITY]);
    }
}

/// y = a - b floor(a / b), with the sign of b; da = g, db = -g floor(a / b).
#[derive(Clone, Copy)]
pub struct Remainder;
impl Formula<2> for Remainder {
    const NAME: &'static str = "remainder";
    const WIDE_GRADIENT: bool = true;
    #[inline(always)]
    fn f<E: Real>(&self, [a, b]: [E; 2]) -> E {
        a.remainder(b)
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, [a, b]: [E; 2], y: E) -> [E; 2] {
        [g, -multiple(g, a, b, y)]
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(2.1..2.6).domain_also(4.1..4.4).domain(0.9..1.0);
        c.at([-1.0, 3.0], 2.0, [1.0, 1.0]).at([7.0, -3.0], -2.0, [1.0, 3.0]).at([6.0, 3.0], 0.0, [1.0, -2.0]);
    }
}

/// y = scale x + shift, rounded once.
#[derive(Clone, Copy)]
pub struct Affine {
    /// The factor.
    pub scale: f64,
    /// The summand.
    pub shift: f64,
}
impl Formula<1> for Affine {
    const NAME: &'static str = "affine";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        let (scale, shift) = (x.like(self.scale), x.like(self.shift));
        x.mul_add(scale, shift)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(-3.0..3.0).at([0.0], self.shift, [self.scale]);
        c.at([f64::INFINITY], f64::INFINITY * self.scale, [self.scale]);
    }
}

/// y = x, as a new node. It separates an input's own contribution to a gradient from that of inputs which depend on it.
#[derive(Clone, Copy)]
pub struct Alias;
impl Formula<1> for Alias {
    const NAME: &'static str = "alias";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x
    }
    fn cases(&self, c: &mut Cases) {
        c.linear().domain(-3.0..3.0).at([f64::INFINITY], f64::INFINITY, [1.0]);
    }
}

/// y = yes where x > 0, else no. The choice has derivative 0; a NaN chooses `no`.
#[derive(Clone, Copy)]
pub struct IfPositive;

impl<T: Scalar> Op<T> for IfPositive {
    fn name(&self) -> &'static str {
        "if_positive"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        raygrad_tensor::broadcast_shape(x).ok_or_else(|| "the shapes do not broadcast".into())
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        map(
            [x[0], x[1], x[2]],
            pool,
            #[inline(always)]
            |[x, yes, no]| x.if_positive(yes, no),
        )
    }

    fn reads(&self) -> Reads {
        Reads::only(&[0])
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (x, g, zero) = (cx.x(0), cx.g(), cx.g().constant(0.0));
        let yes = cx.needs(1).then(|| x.if_positive(g, &zero).sum_to(cx.shape(1)));
        let no = cx.needs(2).then(|| x.if_positive(&zero, g).sum_to(cx.shape(2)));
        Grads::new([None, yes, no])
    }
}

#[track_caller]
pub(crate) fn add<'t, T: Scalar>(a: &Var<'t, T>, b: &Var<'t, T>) -> Var<'t, T> {
    Add.on([a, b])
}

#[track_caller]
pub(crate) fn sub<'t, T: Scalar>(a: &Var<'t, T>, b: &Var<'t, T>) -> Var<'t, T> {
    Sub.on([a, b])
}

#[track_caller]
pub(crate) fn mul<'t, T: Scalar>(a: &Var<'t, T>, b: &Var<'t, T>) -> Var<'t, T> {
    Mul.on([a, b])
}

#[track_caller]
pub(crate) fn div<'t, T: Scalar>(a: &Var<'t, T>, b: &Var<'t, T>) -> Var<'t, T> {
    Div.on([a, b])
}

impl<'t, T: Scalar> Var<'t, T> {
    /// `scale * self + shift`, for constants `scale` and `shift`.
    #[track_caller]
    pub fn affine(&self, scale: f64, shift: f64) -> Self {
        Affine { scale, shift }.on([self])
    }

    /// `self * self`.
    #[track_caller]
    pub fn square(&self) -> Self {
        ConstPowi::<2>.on([self])
    }

    /// The same value as a new node.
    #[track_caller]
    pub(crate) fn alias(&self) -> Self {
        Alias.on([self])
    }

    /// `yes` where this tensor is greater than 0, else `no`; also `no` where it is NaN. All three broadcast together.
    /// The gradient goes to the selected operand; `self` has gradient 0.
    ///
    /// ```
    /// # use raygrad_autograd::Tape;
    /// # use raygrad_tensor::Tensor;
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from([-2.0, 0.0, 3.0]));
    /// assert_eq!(x.if_positive(&x, &x.constant(9.0)).value(), [9.0, 9.0, 3.0]);
    /// ```
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn if_positive(&self, yes: impl Operand<'t, T>, no: impl Operand<'t, T>) -> Self {
        let (yes, no) = (yes.on(self.tape()), no.on(self.tape()));
        self.tape().apply(IfPositive, &[self, &yes, &no])
    }
}

elementwise! {
    /// `self` modulo `divisor`, as in Python: `self - divisor * floor(self / divisor)`, with the sign of `divisor`. Shapes
    /// broadcast.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[doc(alias = "fmod")]
    remainder(divisor) = Remainder;
    also examined: Add, Sub, Mul, Div, MulAdd, Affine { scale: -2.5, shift: 0.75 }, Alias;
}
