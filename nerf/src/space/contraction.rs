//! Scene contraction: all of space in a ball of radius 2, for unbounded scenes.

#[cfg(any(test, feature = "check"))]
use raygrad_autograd::check::Entry;
use raygrad_autograd::{Grads, Op, Pool, Reads, Scalar, Shape, ShapeError, Tensor, Var, Vjp};

/// The operation y = x inside the unit ball, else (2 - 1/r) x / r with r = |x| (Barron et al. 2022, mip-NeRF 360,
/// equation 10).
///
/// Rows of the last axis are points. Space outside of the unit ball maps to radii of 1 to 2, evenly in disparity.
///
/// dx = (f/r) g + (f' - f/r) (n . g) n with n = x/r, f = 2 - 1/r, f' = 1/r^2: the identity inside, and continuous where
/// the two meet.
///
/// Rows are divided by their largest element first, so the farthest representable point keeps its direction. Beyond a
/// radius of 1e4 all points of a direction map to radius 1.9999, with gradient 0 along the ray, so the result is always
/// inside of the ball. That holds for infinite elements too; NaN gives a row of NaN.
#[derive(Debug, Clone, Copy)]
pub struct Contraction;

/// The largest radius; farther points move to it.
const FARTHEST: f64 = 1e4;

/// A point as a direction and a distance.
struct Polar<T> {
    /// `2 - 1/r` with the limited radius.
    radius: T,
    /// Its derivative along the ray.
    along: T,
    /// Its derivative across, `radius / r`.
    across: T,
}

/// Writes the direction of `x` to `unit`. `None` for points inside of the ball, which do not move.
fn polar<T: Scalar>(x: &[T], unit: &mut [T]) -> Option<Polar<T>> {
    let mut scale = T::ZERO;
    for &x in x {
        let size = Scalar::to_f64(x).abs();
        if size.is_nan() {
            unit.fill(x);
            return Some(Polar { radius: x, along: x, across: x });
        }
        scale = if size > scale.to_f64() { T::from_f64(size) } else { scale };
    }
    let infinite = !scale.is_finite();
    let mut squares = 0.0;
    for (unit, &x) in unit.iter_mut().zip(x) {
        // For infinite points only the infinite coordinates count.
        *unit = if infinite { T::from_f64(if x.is_finite() { 0.0 } else { x.to_f64().signum() }) } else { x / scale };
        squares += unit.to_f64() * unit.to_f64();
    }
    let norm = squares.sqrt();
    let r = scale.to_f64() * norm;
    // Written so that a row of zeros, whose direction is NaN, returns too.
    if !(r > 1.0) {
        return None;
    }
    unit.iter_mut().for_each(|unit| *unit = T::from_f64(unit.to_f64() / norm));
    let radius = 2.0 - 1.0 / r.min(FARTHEST);
    let along = if r <= FARTHEST { 1.0 / (r * r) } else { 0.0 };
    Some(Polar { radius: T::from_f64(radius), along: T::from_f64(along), across: T::from_f64(radius / r) })
}

impl<T: Scalar> Op<T> for Contraction {
    fn name(&self) -> &'static str {
        "contraction"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0].is_empty() { Err("points must have at least one axis".into()) } else { Ok(x[0].into()) }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(x[0].shape());
        let width = x[0].shape()[x[0].ndim() - 1].max(1);
        let mut unit = vec![T::ZERO; width];
        for (x, y) in x[0].as_slice().chunks_exact(width).zip(out.as_mut_slice().chunks_exact_mut(width)) {
            match polar(x, &mut unit) {
                None => y.copy_from_slice(x),
                Some(Polar { radius, .. }) => y.iter_mut().zip(&unit).for_each(|(y, &unit)| *y = radius * unit),
            }
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let mut grad = cx.g().value().clone();
        let width = cx.shape(0)[cx.shape(0).len() - 1].max(1);
        let mut unit = vec![T::ZERO; width];
        for (x, g) in cx.x(0).value().as_slice().chunks_exact(width).zip(grad.as_mut_slice().chunks_exact_mut(width)) {
            let Some(Polar { along, across, .. }) = polar(x, &mut unit) else { continue };
            let inner: f64 = unit.iter().zip(g.iter()).map(|(u, g)| u.to_f64() * g.to_f64()).sum();
            let radial = (along - across) * T::from_f64(inner);
            g.iter_mut().zip(&unit).for_each(|(g, &unit)| *g = across * *g + radial * unit);
        }
        Grads::one(cx.constant(grad))
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let x = &x[0];
        let axis = x.shape().len() - 1;
        let mut column = Shape::from_slice(x.shape());
        let width = std::mem::replace(&mut column[axis], 1);
        // The scale of a row, at least 1, cancels, so it is a constant.
        let largest = |row: &[T]| T::from_f64(row.iter().fold(1.0, |most: f64, x| most.max(x.to_f64().abs())));
        let scales: Vec<T> = match width {
            0 => vec![T::ONE; column.iter().product()],
            _ => x.value().as_slice().chunks_exact(width).map(largest).collect(),
        };
        let least: Vec<T> = scales.iter().map(|&s| T::ONE / (s * s)).collect();
        let constant = |values: Vec<T>| x.tape().constant(Tensor::from_vec(&column, values));
        let (scale, least) = (constant(scales), constant(least));
        let unit = x / &scale;
        // max(1, |x|) / scale, inside both branches: as radius it makes the formula the identity in the ball.
        let norm = unit.square().sum_over(-1).reshape(&column).maximum(least).sqrt();
        let radius = (&norm * scale).minimum(FARTHEST);
        Some(unit * ((2.0 - radius.reciprocal()) / norm))
    }
}

/// Contracts points `[.., d]` into a ball of radius 2; see [`Contraction`].
///
/// ```
/// use raygrad_autograd::{Tape, Tensor};
/// use raygrad_nerf::contract;
/// let tape = Tape::<f32>::new();
/// let x = tape.leaf(Tensor::from_vec(&[2, 3], vec![0.5, 0.0, 0.0, 0.0, 4.0, 0.0]));
/// assert_eq!(contract(&x).value(), [[0.5, 0.0, 0.0], [0.0, 1.75, 0.0]]);
/// ```
///
/// # Panics
/// If `points` is a scalar.
#[track_caller]
pub fn contract<'t, T: Scalar>(points: &Var<'t, T>) -> Var<'t, T> {
    points.tape().apply(Contraction, &[points])
}

/// The catalogue entries of this file.
#[cfg(any(test, feature = "check"))]
pub(crate) fn entries() -> Vec<Entry> {
    let points = |scale: f64| Tensor::from_fn(&[5, 3], |i| scale * (((i * 7) % 11) as f64 / 5.0 - 1.0));
    vec![
        Entry::new(Contraction)
            .sample_of(vec![points(0.4)])
            .sample_of(vec![points(3.0)])
            .sample_of(vec![points(40.0)])
            .sample(&[&[0, 3]])
            .sample(&[&[2, 0]]),
    ]
}
