//! The inverse of a distortion.

use crate::camera::lens::fold::Domain;
use crate::camera::lens::maps;
use raygrad_autograd::{Dual, Real};
use std::f64::consts::PI;

/// A distortion of the image plane, with its coefficients.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Distortion {
    /// [`maps::rational`].
    Rational([f64; 8]),
    /// [`maps::thin_prism`].
    ThinPrism([f64; 8]),
}

/// Newton steps from a good start.
const STEPS: usize = 20;
/// Newton steps between bounds. Each is at least as good as a bisection of an interval of doubles.
const MOST_STEPS: usize = 1100;
/// The relative size of the last step. Newton's method converges quadratically, so the error is about its square.
const ALMOST: f64 = 1e-9;
/// The largest relative residual of a solution. Most residuals are a few roundings.
const MISS: f64 = 1e-11;
/// The distance of the outermost direction, as a share of the distance to the fold.
///
/// No inverse can be more precise: near a fold a point depends on the square of the distance to it.
const INSIDE: f64 = 1.0 - 1e-8;
/// The smallest step along the way to a point, as a share of it, and the largest number of steps.
const LEAST_STEP: f64 = 1e-10;
const MOST_TRIES: usize = 400;

impl Distortion {
    /// The distorted position of a point.
    #[inline]
    pub(crate) fn of<E: Real>(&self, place: [E; 2]) -> [E; 2] {
        let lift = |c: &[f64; 8]| c.map(|c| place[0].like(c));
        match self {
            Distortion::Rational(c) => maps::rational(lift(c), place),
            Distortion::ThinPrism(c) => maps::thin_prism(lift(c), place),
        }
    }

    /// The distorted distance of `r` from the axis, without tangential and prism terms.
    #[inline]
    fn of_distance<E: Real>(&self, r: E) -> E {
        let lift = |c: &[f64; 8]| c.map(|c| r.like(c));
        r * match self {
            Distortion::Rational(c) => maps::rational_factor(lift(c), r * r),
            Distortion::ThinPrism(c) => maps::fisheye_factor(lift(c), r * r),
        }
    }

    /// The domain in which the distortion is invertible.
    pub(crate) fn domain(&self) -> Domain {
        match *self {
            Distortion::Rational([k1, k2, k3, k4, k5, k6, p1, p2]) => Domain {
                numerator: [1.0, k1, k2, k3, 0.0],
                denominator: [1.0, k4, k5, k6],
                tangential: [p2, p1],
                prism: [0.0; 2],
                limit: f64::INFINITY,
            },
            Distortion::ThinPrism([k1, k2, k3, k4, p1, p2, sx1, sy1]) => Domain {
                numerator: [1.0, k1, k2, k3, k4],
                denominator: [1.0, 0.0, 0.0, 0.0],
                tangential: [p2, p1],
                prism: [sx1, sy1],
                limit: PI,
            },
        }
    }

    /// The point within the [`Domain`] that the distortion maps to `target`; as an error, the outermost point towards
    /// it.
    pub(crate) fn undo(&self, target: [f64; 2]) -> Result<[f64; 2], [f64; 2]> {
        let domain = self.domain();
        if domain.is_radial() {
            let distance = size(target);
            let along = |r: f64| target.map(|t| if distance > 0.0 { t / distance * r } else { t });
            return self.undo_distance(&domain, distance).map(along).map_err(along);
        }
        match self.newton(target, target).filter(|&place| domain.holds(place)) {
            Some(place) => Ok(place),
            None => self.follow(&domain, target),
        }
    }

    /// The distance that the radial factor maps to `target`, within a radial domain; as an error, the largest distance.
    fn undo_distance(&self, domain: &Domain, target: f64) -> Result<f64, f64> {
        let mut r = target;
        for _ in 0..STEPS {
            let [miss, slope] = self.miss(r, target);
            let step = miss / slope;
            r -= step;
            if !(step.abs() > ALMOST * r) {
                let near = self.miss(r, target)[0].abs() <= MISS * target;
                if near && domain.holds([r, 0.0]) {
                    return Ok(r);
                }
                break;
            }
        }
        self.undo_distance_slowly(domain, target)
    }

    /// The residual of the distance `r` for `target`, and its derivative.
    #[inline]
    fn miss(&self, r: f64, target: f64) -> [f64; 2] {
        let Dual { value, slopes: [slope] } = self.of_distance(Dual { value: r, slopes: [Some(1.0)] });
        [value - target, slope.unwrap_or(1.0)]
    }

    /// [`undo_distance`](Self::undo_distance) by bisection and Newton steps between bounds of the root.
    #[cold]
    fn undo_distance_slowly(&self, domain: &Domain, target: f64) -> Result<f64, f64> {
        let mut high = target.clamp(f64::MIN_POSITIVE, domain.limit);
        loop {
            if let Some(edge) = domain.edge([1.0, 0.0], high) {
                high = edge;
                break;
            } else if !(self.miss(high, target)[0] < 0.0) || high >= domain.limit {
                break;
            }
            high = (2.0 * high).min(domain.limit);
            if !high.is_finite() {
                return Err(target);
            }
        }
        let (mut low, outermost) = (0.0, high * INSIDE);
        if self.miss(high, target)[0] < 0.0 {
            return Err(outermost);
        }
        let mut r = 0.5 * high;
        for _ in 0..MOST_STEPS {
            let [miss, slope] = self.miss(r, target);
            if miss > 0.0 {
                high = r
            } else {
                low = r
            }
            let newton = r - miss / slope;
            let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
            if miss == 0.0 || next == r || !(low < next && next < high) {
                break;
            }
            r = next;
        }
        // Near a pole neighbouring floats map far apart, so the residual of a root may be large.
        if self.miss(r, target)[0].abs() <= 1e-6 * target { Ok(r) } else { Err(outermost) }
    }

    /// Newton's method from `start`; `None` if it does not converge to `target`.
    #[inline]
    fn newton(&self, start: [f64; 2], target: [f64; 2]) -> Option<[f64; 2]> {
        let mut place = start;
        for _ in 0..STEPS {
            let [x, y] = place;
            let [u, v] =
                self.of([Dual { value: x, slopes: [Some(1.0), None] }, Dual { value: y, slopes: [None, Some(1.0)] }]);
            let slope = |s: Option<f64>| s.unwrap_or(0.0);
            let ([ux, uy], [vx, vy]) = (u.slopes.map(slope), v.slopes.map(slope));
            let over = 1.0 / (ux * vy - uy * vx);
            let miss = [u.value - target[0], v.value - target[1]];
            let step = [(vy * miss[0] - uy * miss[1]) * over, (ux * miss[1] - vx * miss[0]) * over];
            place = [x - step[0], y - step[1]];
            if !(size(step) > ALMOST * size(place)) {
                let [u, v] = self.of(place);
                let miss = size([u - target[0], v - target[1]]);
                return (miss <= MISS * size(target)).then_some(place);
            }
        }
        None
    }

    /// Newton's method for targets near a fold and beyond it. Adaptive steps along the straight line to `target` keep
    /// all points in the domain.
    #[cold]
    fn follow(&self, domain: &Domain, target: [f64; 2]) -> Result<[f64; 2], [f64; 2]> {
        let solve = |start: [f64; 2], target: [f64; 2]| self.newton(start, target).filter(|&place| domain.holds(place));
        // Strong lenses need a better start than the target: the solution without tangential terms.
        let distance = size(target);
        let radial = Domain { tangential: [0.0; 2], prism: [0.0; 2], ..*domain };
        let (Ok(r) | Err(r)) = self.undo_distance(&radial, distance);
        if let Some(place) = solve(target.map(|t| t / distance * r), target) {
            return Ok(place);
        }
        let (mut place, mut done, mut step) = ([0.0; 2], 0.0, 1.0_f64);
        for _ in 0..MOST_TRIES {
            let next = (done + step).min(1.0);
            match solve(place, target.map(|t| t * next)) {
                Some(found) if next == 1.0 => return Ok(found),
                Some(found) => (place, done, step) = (found, next, 2.0 * step),
                None if step > LEAST_STEP => step *= 0.5,
                None => break,
            }
        }
        Err(place)
    }
}

/// The length of a vector, also if its square overflows or underflows.
fn size([x, y]: [f64; 2]) -> f64 {
    let plain = (x * x + y * y).sqrt();
    if plain > 1e-100 && plain < 1e100 { plain } else { x.hypot(y) }
}
