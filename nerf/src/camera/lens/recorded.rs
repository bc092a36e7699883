//! Differentiable projection through lenses.

use crate::camera::lens::Lens;
use raygrad_autograd::{Scalar, Var, record};
#[cfg(any(test, feature = "check"))]
use raygrad_autograd::{Tensor, check::Entry};

/// Projects directions `[.., 3]` of any length to places `[.., 2]`, differentiable with respect to both arguments.
///
/// `lens` only chooses the model. `coefficients` are `[n]`, or `[.., n]` for one lens per direction, in the order of
/// [`Lens::coefficients`]. The axes are those of [`Lens`]; [`Lens::project`] is the formula.
///
/// ```
/// use raygrad_autograd::{Tape, Tensor};
/// use raygrad_nerf::{Lens, lens_places};
/// let lens = Lens::Fov { omega: 0.9 };
/// let tape = Tape::<f64>::new();
/// let coefficients = tape.leaf(Tensor::from_vec(&[1], lens.coefficients()));
/// let directions = tape.leaf(Tensor::from_vec(&[2, 3], vec![0.3, 0.1, 1.0, -0.5, 0.2, 0.8]));
/// let places = lens_places(&lens, &coefficients, &directions);
/// assert_eq!(places.shape(), [2, 2]);
/// assert_eq!(places.sum().grad(&[&coefficients])[0].shape(), [1]);
/// ```
///
/// # Panics
/// If the last axis of directions is not 3, or that of coefficients is not the number that the lens has.
#[track_caller]
pub fn lens_places<'t, T: Scalar>(lens: &Lens, coefficients: &Var<'t, T>, directions: &Var<'t, T>) -> Var<'t, T> {
    assert_eq!(directions.shape().last(), Some(&3), "the last axis of directions must be 3");
    let count = lens.coefficients().len();
    assert_eq!(
        coefficients.shape().last(),
        Some(&count),
        "the last axis of coefficients must be the number that {lens:?} has"
    );
    let inputs = (0..3).map(|i| directions.slice_axis(-1, i..i + 1));
    let inputs: Vec<_> = inputs.chain((0..count).map(|i| coefficients.slice_axis(-1, i..i + 1))).collect();
    let places = match count {
        0 => places_of::<T, 3>(lens, &inputs),
        1 => places_of::<T, 4>(lens, &inputs),
        _ => places_of::<T, 11>(lens, &inputs),
    };
    Var::concat(&[&places[0], &places[1]], -1)
}

/// The projection of `N` variables: a direction, then coefficients.
fn places_of<'t, T: Scalar, const N: usize>(lens: &Lens, inputs: &[Var<'t, T>]) -> [Var<'t, T>; 2] {
    record::<T, N, 2>(std::array::from_fn(|i| &inputs[i]), |x| lens.project(&x[3..], [x[0], x[1], x[2]]))
}

/// The catalogue entries of this file.
#[cfg(any(test, feature = "check"))]
pub(crate) fn entries() -> Vec<Entry> {
    let directions = |from: f64, to: f64| {
        let wave = |i: usize| ((i * 7) % 13) as f64 / 6.0 - 1.0;
        let z = |i: usize| from + (to - from) * (0.5 + 0.5 * wave(i + 4));
        Tensor::from_fn(&[6, 3], |i| if i % 3 == 2 { z(i) } else { wave(i) + 0.03 })
    };
    let entry = |name, lens: Lens, depths: [f64; 2], coefficients: &[&[f64]]| {
        let entry =
            Entry::function(name, move |x| lens_places(&lens, &x[0], &x[1]), move |x| lens_places(&lens, &x[0], &x[1]));
        coefficients.iter().fold(entry, |entry, coefficients| {
            let coefficients = Tensor::from_vec(&[coefficients.len()], coefficients.to_vec());
            entry.sample_of(vec![coefficients, directions(depths[0], depths[1])])
        })
    };
    let (ahead, aside) = ([0.8, 1.5], [-0.1, 1.2]);
    let brown = Lens::Brown { k: [0.1, -0.2, 0.03, 0.2, -0.05, 0.01], p: [0.002, -0.003] };
    let fisheye = Lens::Fisheye { k: [0.05, -0.02, 0.003, 0.001], p: [0.002, -0.003], s: [0.004, -0.001] };
    vec![
        entry("lens_brown", brown, ahead, &[&brown.coefficients()]),
        entry("lens_fisheye", fisheye, aside, &[&fisheye.coefficients()]),
        entry("lens_fov", Lens::Fov { omega: 0.9 }, ahead, &[&[0.9], &[1e-3]]),
        entry("lens_equirectangular", Lens::Equirectangular, aside, &[&[]]),
        entry("lens_pinhole", Lens::Pinhole, ahead, &[&[]]),
    ]
}
