//! Ray directions of pixels, differentiable with respect to focal length and lens.
//!
//! The direction of a pixel is the root of an equation: the lens must project it to the pixel. A solver finds it in
//! plain numbers. One step of Newton's method from there, recorded on the tape with a constant Jacobian, does not move
//! it and has its exact gradient, by the implicit function theorem.

use crate::camera::lens::Lens;
use crate::camera::lens_places;
use crate::camera::pinhole::Camera;
use glam::DVec3;
use raygrad_autograd::{Dual, Scalar, Tape, Tensor, Var};
use std::mem::{Discriminant, discriminant};

/// The number of corrections of a lens.
pub(super) const CORRECTIONS: usize = 4;

/// Below this determinant of its Jacobian a lens is close to a fold, and its inverse has no usable derivative.
const FOLDED: f64 = 1e-6;

/// The indices of the corrected coefficients: `k1, k2, p1, p2`, or `k1, k2` of a fisheye. Others hardly affect images
/// and would drift.
pub(super) fn corrected(lens: &Lens) -> &'static [usize] {
    match lens {
        Lens::Pinhole | Lens::Equirectangular => &[],
        Lens::Brown { .. } => &[0, 1, 6, 7],
        Lens::Fisheye { .. } => &[0, 1],
        Lens::Fov { .. } => &[0],
    }
}

/// The lens with `added` on its [`corrected`] coefficients.
pub(super) fn with_corrections(lens: &Lens, added: [f64; CORRECTIONS]) -> Lens {
    let mut coefficients = lens.coefficients();
    corrected(lens).iter().zip(added).for_each(|(&i, x)| coefficients[i] += x);
    lens.with_coefficients(&coefficients)
}

/// The direction of a pixel for the current camera, and its derivative by the position in the image plane.
struct Sight {
    lens: Lens,
    /// Position in units of the given focal length, from the principal point.
    given: [f64; 2],
    /// Position in units of the current focal length.
    place: [f64; 2],
    /// Direction in the axes of the [`Lens`].
    local: DVec3,
    /// Direction in the axes of the scene, like its slopes.
    direction: DVec3,
    slopes: [DVec3; 2],
}

impl Sight {
    /// For a continuous pixel position. `given` is the original camera, whose pose the result has; `now` has the
    /// current focal length and lens.
    fn new(given: &Camera, now: &Camera, [x, y]: [f64; 2]) -> Self {
        let plane =
            |camera: &Camera| [(x - camera.centre[0]) / camera.focal[0], (y - camera.centre[1]) / camera.focal[1]];
        let (lens, place) = (now.lens, plane(now));
        let found = lens.direction(place);
        let local = found.unwrap_or_else(|| lens.nearest(place));
        let slopes = found.and_then(|local| slopes(&lens, local)).unwrap_or([DVec3::ZERO; 2]);
        let turned = |v: DVec3| given.pose.matrix3 * (v * DVec3::new(1.0, -1.0, -1.0));
        Sight { lens, given: plane(given), place, local, direction: turned(local), slopes: slopes.map(turned) }
    }
}

/// The derivative of the unit direction by the two coordinates of its image-plane position; `None` at a fold of the
/// lens.
fn slopes(lens: &Lens, local: DVec3) -> Option<[DVec3; 2]> {
    let (a, b) = local.any_orthonormal_pair();
    let direction = [0, 1, 2].map(|i| Dual { value: local[i], slopes: [Some(a[i]), Some(b[i])] });
    let coefficients: Vec<_> =
        lens.coefficients().into_iter().map(|value| Dual { value, slopes: [None, None] }).collect();
    let [[ua, ub], [va, vb]] =
        lens.project(&coefficients, direction).map(|place| place.slopes.map(|slope| slope.unwrap_or(0.0)));
    let determinant = ua * vb - ub * va;
    let found = [(vb * a - va * b) / determinant, (ua * b - ub * a) / determinant];
    (determinant.abs() > FOLDED && found.iter().all(|slope| slope.is_finite())).then_some(found)
}

/// Unit directions `[rays, 3]` of pixels, in the axes of the scene, before pose corrections.
///
/// Each ray has its given camera, its current camera and the continuous position of its pixel. `focal` `[rays, 2]`
/// holds the logarithms of the focal lengths' growth. `lens` `[rays, 4]` holds the corrections of the coefficients.
/// `None` is not learned.
pub(super) fn directions<'t, T: Scalar>(
    tape: &'t Tape<T>,
    pixels: &[(&Camera, &Camera, [f64; 2])],
    focal: Option<&Var<'t, T>>,
    lens: Option<&Var<'t, T>>,
) -> Var<'t, T> {
    let sights: Vec<_> = pixels.iter().map(|(given, now, at)| Sight::new(given, now, *at)).collect();
    let count = sights.len();
    let table = |width: usize, of: &dyn Fn(&Sight, usize) -> f64| {
        tape.constant(Tensor::from_fn(&[count, width], |i| T::from_f64(of(&sights[i / width], i % width))))
    };
    let target = match focal {
        Some(focal) => table(2, &|sight, i| sight.given[i]) * (-focal).exp(),
        None => table(2, &|sight, i| sight.place[i]),
    };
    let start = table(3, &|sight, i| sight.direction[i]);
    // One Newton step. The residual is 0, but it has a gradient.
    let step = |miss: Var<'t, T>, of: &dyn Fn(&Sight) -> bool| {
        let slopes = table(6, &|sight, i| if of(sight) { sight.slopes[i % 2][i / 2] } else { 0.0 });
        (slopes.reshape(&[count, 3, 2]) * miss.reshape(&[count, 1, 2])).sum_over(-1)
    };
    // One formula per kind of lens. Rays of other kinds get the optical axis, and their steps are masked out.
    let mut kinds: Vec<(Discriminant<Lens>, Lens)> = vec![];
    for (given, now, _) in pixels {
        let kind = discriminant(&now.lens);
        if !kinds.iter().any(|(other, _)| *other == kind) {
            kinds.push((kind, given.lens));
        }
    }
    kinds.into_iter().fold(start, |found, (kind, given)| {
        let own = |sight: &Sight| discriminant(&sight.lens) == kind;
        let axis = |sight: &Sight, i: usize| if own(sight) { sight.local[i] } else { [0.0, 0.0, 1.0][i] };
        let moved = corrected(&given);
        let width = given.coefficients().len();
        let places = if let Some(lens) = lens.filter(|_| !moved.is_empty()) {
            let base = Tensor::from_fn(&[count, width], |i| {
                let (given, now, _) = pixels[i / width];
                T::from_f64(if discriminant(&now.lens) == kind { given.lens.coefficients()[i % width] } else { 0.0 })
            });
            let spread = Tensor::from_fn(&[CORRECTIONS, width], |i| {
                T::from_f64(if moved.get(i / width) == Some(&(i % width)) { 1.0 } else { 0.0 })
            });
            let coefficients = tape.constant(base) + lens.matmul(tape.constant(spread));
            lens_places(&given, &coefficients, &table(3, &axis))
        } else {
            table(2, &|sight, i| sight.place[i])
        };
        found - step(places - &target, &own)
    })
}
