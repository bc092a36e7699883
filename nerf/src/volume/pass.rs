//! Forward passes over samples, as graph code: fields, compositing, background, loss.

use crate::camera::rays::Samples;
use crate::field::{Density, Field};
use raygrad_autograd::{Scalar, Tape, Tensor, Var};
use raygrad_nn::Bound;

/// Colour (and distance, if `with_depth`) of samples, composited along their rays: `[rays, 4 or 5]`, the last channel
/// being the transmittance that is left. Also the weight of each sample, as a constant.
pub fn composite_samples<'t, T: Scalar>(
    field: &dyn Field<T>,
    params: &Bound<'t, T>,
    samples: &Samples<T>,
    with_depth: bool,
    tape: &'t Tape<T>,
) -> (Var<'t, T>, Tensor<T>) {
    let encoding = field.encode(params, &tape.constant(samples.positions.clone()));
    let density = field.density(params, &encoding);
    let composite = density.composite(samples.delta.clone(), samples.segments.clone());
    let [_, weights] = composite.transmittance_and_weights(density.value.value(), tape.pool());
    (composite_density(field, params, samples, &density, with_depth, tape), weights)
}

/// As [`composite_samples`], from the density at the samples' positions, and without the weights.
pub fn composite_density<'t, T: Scalar>(
    field: &dyn Field<T>,
    params: &Bound<'t, T>,
    samples: &Samples<T>,
    density: &Density<'t, T>,
    with_depth: bool,
    tape: &'t Tape<T>,
) -> Var<'t, T> {
    let features = features(field, params, samples, density, with_depth, tape);
    let composite = density.composite(samples.delta.clone(), samples.segments.clone());
    tape.apply(composite, &[&density.value, &features])
}

/// The features of samples of this density that are composited: colour, and distance if `with_depth`.
pub(crate) fn features<'t, T: Scalar>(
    field: &dyn Field<T>,
    params: &Bound<'t, T>,
    samples: &Samples<T>,
    density: &Density<'t, T>,
    with_depth: bool,
    tape: &'t Tape<T>,
) -> Var<'t, T> {
    let directions = tape.constant(samples.directions.clone());
    let color = field.color(params, &density.features, &directions, &samples.segments);
    if !with_depth {
        return color;
    }
    Var::concat(&[&color, &tape.constant(samples.t.reshape(&[samples.len(), 1]))], 1)
}

/// The colour of composited features `[rays, 3 or more, + 1]` over a background `[rays, 3]`.
pub fn over_background<'t, T: Scalar>(rendered: &Var<'t, T>, background: &Tensor<T>) -> Var<'t, T> {
    let channels = rendered.shape()[1];
    let left = rendered.slice_axis(1, channels - 1..channels - 1 + 1);
    rendered.slice_axis(1, ..3) + left * rendered.tape().constant(background.clone())
}

/// The sum of squared differences between composited colours and `target` `[rays, 3]`.
pub fn squared_error<'t, T: Scalar>(rendered: &Var<'t, T>, target: &Tensor<T>, background: &Tensor<T>) -> Var<'t, T> {
    (over_background(rendered, background) - rendered.tape().constant(target.clone())).square().sum()
}
