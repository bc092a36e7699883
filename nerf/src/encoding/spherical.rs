//! Spherical harmonics of viewing directions.

#[cfg(any(test, feature = "check"))]
use raygrad_autograd::check::Entry;
use raygrad_autograd::{Grads, Op, Pool, Real, Scalar, Shape, ShapeError, Tensor, Var, Vjp, record};
use raygrad_tensor::simd;

/// The operation of real spherical harmonics: unit directions `[rays, 3]` to `[rays, degree^2]`.
///
/// The output has the bands `l = 0, 1, ..` below `degree`, each from order `m = -l` to `l`. They are orthonormal on the
/// sphere with the Condon-Shortley phase: band 1 is `(-y, z, -x)` times `sqrt(3 / (4 pi))` (Sloan 2008, "Stupid
/// Spherical Harmonics Tricks", appendix A2). Vectors are not normalised; the gradient is that of the polynomials in
/// free x, y and z.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SphericalHarmonics {
    degree: usize,
}

/// The number of functions up to the highest degree.
const MOST: usize = 16;

/// `1 / sqrt(4 pi)`.
const BAND_0: f64 = 0.282_094_791_773_878_14;
/// `sqrt(3 / (4 pi))`.
const BAND_1: f64 = 0.488_602_511_902_919_9;
/// `sqrt(n / (pi d))` for `n/d` = 15/4, 5/16 and 15/16: orders 1 and -2, 0, and 2.
const BAND_2: [f64; 3] = [1.092_548_430_592_079_2, 0.315_391_565_252_520_05, 0.546_274_215_296_039_6];
/// The same for 7/16, 21/32, 105/4, 105/16 and 35/32: orders 0, 1, -2, 2 and 3.
const BAND_3: [f64; 5] = [
    0.373_176_332_590_115_4,
    0.457_045_799_464_465_8,
    2.890_611_442_640_554,
    1.445_305_721_320_277,
    0.590_043_589_926_643_5,
];

impl SphericalHarmonics {
    /// Creates the harmonics of the bands below `degree`, 1 to 4.
    ///
    /// # Panics
    /// If `degree` is not in 1..=4.
    #[track_caller]
    pub fn new(degree: usize) -> Self {
        assert!((1..=4).contains(&degree), "the degree of spherical harmonics must be 1 to 4, is {degree}");
        SphericalHarmonics { degree }
    }

    /// Returns the number of output channels, `degree^2`.
    pub fn width(&self) -> usize {
        self.degree * self.degree
    }
}

/// Every function at a direction: the operation for numbers, its reference for variables.
#[inline(always)]
fn values<E: Real>([x, y, z]: [E; 3]) -> [E; MOST] {
    let times = |factor: f64, e: E| e.like(factor) * e;
    let [xx, yy, zz] = [x * x, y * y, z * z];
    let (one, three) = (x.like(1.0), x.like(3.0));
    let xy = x * y;
    let five = times(5.0, zz);
    let difference = xx - yy;
    [
        x.like(BAND_0),
        times(-BAND_1, y),
        times(BAND_1, z),
        times(-BAND_1, x),
        times(BAND_2[0], xy),
        times(-BAND_2[0], y * z),
        times(BAND_2[1], times(3.0, zz) - one),
        times(-BAND_2[0], x * z),
        times(BAND_2[2], difference),
        times(-BAND_3[4], y * (times(3.0, xx) - yy)),
        times(BAND_3[2], xy * z),
        times(-BAND_3[1], y * (five - one)),
        times(BAND_3[0], z * (five - three)),
        times(-BAND_3[1], x * (five - one)),
        times(BAND_3[3], z * difference),
        times(-BAND_3[4], x * (xx - times(3.0, yy))),
    ]
}

/// The derivative of every function along each axis.
#[inline(always)]
fn slopes<T: Scalar>([x, y, z]: [T; 3]) -> [[T; 3]; MOST] {
    let number = T::from_f64;
    let times = |factor: f64, slope: [T; 3]| slope.map(|s| number(factor) * s);
    let (zero, one, two) = (T::ZERO, T::ONE, number(2.0));
    let five = number(5.0) * z * z - one;
    let difference = x * x - y * y;
    [
        [zero; 3],
        times(-BAND_1, [zero, one, zero]),
        times(BAND_1, [zero, zero, one]),
        times(-BAND_1, [one, zero, zero]),
        times(BAND_2[0], [y, x, zero]),
        times(-BAND_2[0], [zero, z, y]),
        times(6.0 * BAND_2[1], [zero, zero, z]),
        times(-BAND_2[0], [z, zero, x]),
        times(2.0 * BAND_2[2], [x, -y, zero]),
        times(-3.0 * BAND_3[4], [two * x * y, difference, zero]),
        times(BAND_3[2], [y * z, x * z, x * y]),
        times(-BAND_3[1], [zero, five, number(10.0) * y * z]),
        times(3.0 * BAND_3[0], [zero, zero, five]),
        times(-BAND_3[1], [five, zero, number(10.0) * x * z]),
        times(BAND_3[3], [two * x * z, -(two * y * z), difference]),
        times(-3.0 * BAND_3[4], [difference, -(two * x * y), zero]),
    ]
}

impl<T: Scalar> Op<T> for SphericalHarmonics {
    fn name(&self) -> &'static str {
        "spherical_harmonics"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        match x[0] {
            &[rays, 3] => Ok([rays, self.width()].into_iter().collect()),
            _ => Err("directions must be [rays, 3]".into()),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let width = self.width();
        let mut out = pool.tensor(&[x[0].shape()[0], width]);
        let (directions, _) = x[0].as_slice().as_chunks::<3>();
        let rows = out.as_mut_slice();
        simd::dispatch(
            #[inline(always)]
            || {
                for (row, &direction) in rows.chunks_exact_mut(width).zip(directions) {
                    row.copy_from_slice(&values(direction)[..width]);
                }
            },
        );
        out
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let x = cx.x(0).into_value();
        let mut dx = cx.pool().tensor(x.shape());
        let (directions, _) = x.as_slice().as_chunks::<3>();
        let (grads, _) = dx.as_mut_slice().as_chunks_mut::<3>();
        let g = cx.g().value().as_slice();
        let width = self.width();
        simd::dispatch(
            #[inline(always)]
            || {
                for (grad, (g, &direction)) in grads.iter_mut().zip(g.chunks_exact(width).zip(directions)) {
                    *grad = [T::ZERO; 3];
                    for (g, slope) in g.iter().zip(slopes(direction)) {
                        for axis in 0..3 {
                            grad[axis] += *g * slope[axis];
                        }
                    }
                }
            },
        );
        Grads::one(cx.constant(dx))
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let [x, y, z] = [0, 1, 2].map(|axis| x[0].slice_axis(1, axis..axis + 1));
        let all = record([&x, &y, &z], |direction| values(direction));
        let columns = all[..self.width()].iter().map(|value| value.broadcast_to(x.shape()));
        Some(Var::concat(&columns.collect::<Vec<_>>().iter().collect::<Vec<_>>(), 1))
    }
}

/// The catalogue entries of this file.
#[cfg(any(test, feature = "check"))]
pub(crate) fn entries() -> Vec<Entry> {
    (1..=4).map(|degree| Entry::new(SphericalHarmonics::new(degree)).sample(&[&[4, 3]]).sample(&[&[0, 3]])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    #[test]
    fn spherical_harmonics_are_orthonormal() {
        // Gauss-Legendre with four nodes in z and eight evenly spaced angles is exact up to degree 7; products have
        // degree 6.
        let nodes =
            [(0.861_136_311_594_052_6, 0.347_854_845_137_453_85), (0.339_981_043_584_856_3, 0.652_145_154_862_546_1)];
        let mut inner = [[0.0; MOST]; MOST];
        for (z, weight) in nodes.into_iter().flat_map(|(z, weight)| [(z, weight), (-z, weight)]) {
            for k in 0..8 {
                let (sine, cosine) = (PI * f64::from(k) / 4.0 + 0.1).sin_cos();
                let r = (1.0_f64 - z * z).sqrt();
                let y = values([r * cosine, r * sine, z]);
                for i in 0..MOST {
                    for j in 0..MOST {
                        inner[i][j] += weight * PI / 4.0 * y[i] * y[j];
                    }
                }
            }
        }
        for i in 0..MOST {
            for j in 0..MOST {
                let expected = if i == j { 1.0 } else { 0.0 };
                assert!((inner[i][j] - expected).abs() <= 1e-14, "functions {i} and {j}: {}", inner[i][j]);
            }
        }
    }

    #[test]
    #[should_panic(expected = "the degree of spherical harmonics must be 1 to 4, is 5")]
    fn degree_beyond_the_table_panics() {
        SphericalHarmonics::new(5);
    }
}
