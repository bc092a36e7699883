//! Functions of angles that are smooth through 0, generic over the number type.

use raygrad_autograd::Real;

/// `sin(r) / r` and `cos(r)` for `r = sqrt(s)`, smooth through 0. Range of `s`: 0 or more.
///
/// Generic over [`Real`], so that variables give derivatives of every order. Each branch gets an argument in its own
/// domain: a gradient of 0 times infinity would be NaN.
#[inline(always)]
pub(crate) fn sinc_and_cos_of_root<E: Real>(s: E) -> [E; 2] {
    let one = s.like(1.0);
    let excess = s - one;
    let (near, far) = (excess.if_positive(one, s), excess.if_positive(s, one));
    // Up to s = 1 the truncation error is below 1e-20. `1 - s / (n (n + 1)) (1 - s / ((n + 2) (n + 3)) (..))`.
    let series = |first: u32| {
        (0..11).rev().fold(s.like(1.0), |sum, k| {
            let n = f64::from(first + 2 * k);
            s.like(1.0) - s.like(1.0 / (n * (n + 1.0))) * near * sum
        })
    };
    let root = far.sqrt();
    let sinc = root.sin() / root;
    [excess.if_positive(sinc, series(2)), excess.if_positive(root.cos(), series(1))]
}

/// `atan2(v, w) / v` for `v = sqrt(v2)`: the angle of the vector `(w, v)`, from 0 to pi, divided by `v`. Smooth through
/// `v = 0` for `w > 0`; for `w <= 0`, `v` must not be 0.
#[inline(always)]
pub(crate) fn angle_over<E: Real>(v2: E, w: E) -> E {
    let one = w.like(1.0);
    // For r = (v/w)^2 up to 1/16, a series of atan(v/w) / (v/w).
    let excess = w.if_positive(v2 - w.like(0.0625) * w * w, one);
    let w_near = excess.if_positive(one, w);
    let r = excess.if_positive(v2.like(0.0), v2) / (w_near * w_near);
    let series = (0..14).rev().fold(r.like(0.0), |sum, k| {
        let term = if k % 2 == 0 { 1.0 } else { -1.0 } / f64::from(2 * k + 1);
        sum * r + r.like(term)
    });
    let v = excess.if_positive(v2, one).sqrt();
    let far = v.atan2(w) / v;
    excess.if_positive(far, series / w_near)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angle_over_is_accurate_near_zero_and_pi() {
        for v in [1e-150, 1e-9, 0.1, 0.2499, 0.2501, 1.0, 7.0] {
            for w in [1.0, 0.3, 1e-3, -1e-3, -1.0] {
                let (y, exact) = (angle_over(v * v, w), f64::atan2(v, w) / v);
                assert!((y / exact - 1.0).abs() < 1e-15, "{v} {w}: {y} for {exact}");
            }
        }
        assert_eq!((angle_over(0.0, 1.0), angle_over(0.0, 4.0)), (1.0, 0.25));
    }
}
