//! Terms of the loss that are known to help.

use super::{Outputs, Term, Terms};
use crate::Result;
use crate::kind::{Kind, Site};
use crate::range::check_range;
use crate::volume::distortion::Distortion;
use raygrad_autograd::{Scalar, Tensor, Var};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The [distortion](Distortion) of the weights along each ray, over its span: pulls them together, against floaters and fog
/// (Barron et al. 2022, equation 15).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DistortionConfig {
    /// Its weight, 0 to 1e6: 0.001 to 0.01 is usual.
    pub weight: f64,
}

/// The entropy of each ray's opacity `o`, `-o ln o - (1 - o) ln(1 - o)`: a ray is to meet something or nothing (Kim et al.
/// 2022, "InfoNeRF", of a whole ray).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EntropyConfig {
    /// Its weight, 0 to 1e6: 0.0001 to 0.01 is usual.
    pub weight: f64,
}

/// `w max(0, n . d)^2` of the weights w and [normals](crate::Rendered::normals) n of samples that are seen along d:
/// surfaces are to face the viewer (Verbin et al. 2022, "Ref-NeRF", equation 11). It differentiates the density twice, which
/// takes several times as long as a step without it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OrientationConfig {
    /// Its weight, 0 to 1e6: 0.1 is usual.
    pub weight: f64,
}

/// The mean square of how far from what was measured the light of a ray comes from, in its span:
/// `sum of w ((t - d) / s)^2 + T ((far - d) / s)^2` for the weights w of samples at t, the light T that is left at the far
/// end of the span, of length s, and the [distance](crate::dataset::Frame::distances) d. It is least where all light comes
/// from d. Rays of which nothing was measured count nothing. (Of the kind of Deng et al. 2022, "Depth-supervised NeRF",
/// section 4; the square stands in place of their likelihood, so that it has no width to choose and is finite everywhere.)
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthConfig {
    /// Its weight, 0 to 1e6: 0.1 to 1 is usual.
    pub weight: f64,
}

/// A configuration is its own term.
macro_rules! terms {
    ($($kind:literal $config:ty),*) => {
        $(impl Kind<Terms> for $config {
            const KIND: &'static str = $kind;
            fn check(&self) -> Result<()> {
                check_range(concat!($kind, ".weight"), self.weight, 0.0, 1e6)
            }
            fn build<T: Scalar>(&self, _: Site<'_, T>) -> Result<Arc<dyn Term<T>>> {
                Ok(Arc::new(*self))
            }
        })*
    };
}

terms!(
    "distortion" DistortionConfig,
    "entropy" EntropyConfig,
    "orientation" OrientationConfig,
    "depth" DepthConfig
);

impl<T: Scalar> Term<T> for DistortionConfig {
    fn loss<'t>(&self, seen: &Outputs<'_, 't, T>) -> Var<'t, T> {
        let samples = &seen.rendered.samples;
        let (mut middles, mut lengths) = (Vec::with_capacity(samples.len()), Vec::with_capacity(samples.len()));
        for (rows, [near, far]) in samples.segments.ranges().zip(&seen.rays.spans) {
            let scale = 1.0 / (far.to_f64() - near.to_f64()).max(1e-12);
            // A sample may stand for an interval that ends beyond the span.
            let share = |x: f64| T::from_f64(x * scale);
            middles.extend(samples.t.as_slice()[rows.clone()].iter().map(|t| share(t.to_f64() - near.to_f64())));
            lengths.extend(samples.delta.as_slice()[rows].iter().map(|delta| share(delta.to_f64())));
        }
        let tensor = |values: Vec<T>| Tensor::from_vec(&[samples.len()], values);
        let op = Distortion::new(tensor(middles), tensor(lengths), samples.segments.clone());
        seen.rendered.weights.tape().apply(op, &[&seen.rendered.weights]).sum() * self.weight
    }
}

impl<T: Scalar> Term<T> for EntropyConfig {
    fn loss<'t>(&self, seen: &Outputs<'_, 't, T>) -> Var<'t, T> {
        // With x the optical depth, ln(1 - o) = -x: exact where the ray is opaque, and o keeps its digits where it is thin.
        let (opacity, x) = (seen.rendered.opacity(), &seen.rendered.optical_depth);
        let met = &opacity * opacity.maximum(1e-20).ln();
        let left = seen.rendered.transmittance() * x.minimum(1e3);
        (left - met).sum() * self.weight
    }
}

impl<T: Scalar> Term<T> for OrientationConfig {
    fn loss<'t>(&self, seen: &Outputs<'_, 't, T>) -> Var<'t, T> {
        let rendered = seen.rendered;
        let tape = rendered.weights.tape();
        let directions = tape.constant(rendered.samples.directions.clone()).segment_expand(&rendered.samples.segments);
        let away = (rendered.normals() * directions).sum_over(1).relu().square();
        (away * &rendered.weights).sum() * self.weight
    }

    fn reads_normals(&self) -> bool {
        true
    }
}

impl<T: Scalar> Term<T> for DepthConfig {
    fn loss<'t>(&self, seen: &Outputs<'_, 't, T>) -> Var<'t, T> {
        let samples = &seen.rendered.samples;
        let (mut errors, mut behind) = (Vec::with_capacity(samples.len()), Vec::with_capacity(seen.rays.len()));
        let measured = seen.distances.iter().map(|&distance| (distance > 0.0).then_some(f64::from(distance)));
        for ((rows, [near, far]), measured) in samples.segments.ranges().zip(&seen.rays.spans).zip(measured) {
            let [near, far] = [near, far].map(|x| x.to_f64());
            let error = |t: f64| match measured {
                Some(distance) if near < far => T::from_f64(((t - distance) / (far - near)).powi(2)),
                _ => T::ZERO,
            };
            errors.extend(samples.t.as_slice()[rows].iter().map(|t| error(t.to_f64())));
            behind.push(error(far));
        }
        let tape = seen.rendered.weights.tape();
        let met = (tape.constant(Tensor::from_vec(&[samples.len()], errors)) * &seen.rendered.weights).sum();
        let left = tape.constant(Tensor::from_vec(&[seen.rays.len()], behind)) * seen.rendered.transmittance();
        (met + left.sum()) * self.weight
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Ray;
    use crate::camera::rays::{Rays, stratified};
    use crate::field::{Density, Field, Seen};
    use crate::random::Jitter;
    use crate::volume::quadrature::Plan;
    use crate::volume::query::Query;
    use glam::DVec3;
    use raygrad_autograd::check::{Check, check_function};
    use raygrad_autograd::{Pool, Tape};
    use raygrad_nn::{Bound, Params};

    /// A density that rises or falls along z, with two parameters: how much there is, and how steep it is.
    struct Slope;

    impl<T: Scalar> Field<T> for Slope {
        fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
            let vars = params.vars();
            let z = positions.slice_axis(1, 2..3).reshape(&[positions.shape()[0]]);
            Density { value: z * vars[1] + vars[0], log: true, features: positions.clone() }
        }
        fn color<'t>(&self, _: &Bound<'t, T>, features: &Var<'t, T>, _: &Seen<'_, 't, T>) -> Var<'t, T> {
            features.constant(0.5).broadcast_to(features.shape())
        }
    }

    /// A term's value for two rays along z, as a function of the two parameters.
    fn value<'t>(term: &dyn Term<f64>, x: &[Var<'t, f64>]) -> Var<'t, f64> {
        let mut params = Params::<f64>::new();
        params.add("much", Tensor::scalar(0.0));
        params.add("steep", Tensor::scalar(0.0));
        let bound = params.layout().bind(x.to_vec());
        let mut rays = Rays::new();
        for shift in [0.0, 0.25] {
            rays.push(&Ray { origin: DVec3::new(shift, 0.0, -1.0), direction: DVec3::Z }, [0.5 + shift, 2.0]);
        }
        let samples = stratified(&rays, 5, &mut Jitter::Middle, &Pool::new());
        let query = Query { slopes: term.reads_normals(), ..Query::new(&Slope, &bound) };
        let rendered = &Plan { samples, intervals: None }.render(&query);
        let nothing = &Tensor::zeros(&[2, 3]);
        let (params, rays, frames, pixels) = (&bound, &rays, &[0, 0][..], &[[0, 0]; 2][..]);
        // Of the second ray nothing was measured.
        let (target, background, distances, seed, fraction) = (nothing, nothing, &[0.65, 0.0][..], 0, 0.5);
        term.loss(&Outputs { params, rays, frames, pixels, distances, seed, fraction, rendered, target, background })
    }

    fn at(term: &dyn Term<f64>, much: f64, steep: f64) -> f64 {
        let tape = Tape::new();
        value(term, &[much, steep].map(|x| tape.leaf(Tensor::scalar(x)))).item()
    }

    #[test]
    fn terms_say_what_they_should_and_have_the_gradients_that_differences_show() {
        let terms: [&dyn Term<f64>; 4] = [
            &DistortionConfig { weight: 2.0 },
            &EntropyConfig { weight: 0.5 },
            &OrientationConfig { weight: 3.0 },
            &DepthConfig { weight: 4.0 },
        ];
        for (i, term) in terms.into_iter().enumerate() {
            let report =
                check_function(&Check::default(), &[Tensor::scalar(0.3), Tensor::scalar(0.4)], |x| value(term, x));
            assert!(report.is_ok(), "term {i}: {report:?}");
        }
        // A thin fog is spread over the span, a thick one stands at its front.
        assert!(at(terms[0], 0.0, 0.0) > 2.0 * at(terms[0], 6.0, 0.0));
        assert!((at(terms[0], 0.5, 0.2) - 2.0 * at(&DistortionConfig { weight: 1.0 }, 0.5, 0.2)).abs() < 1e-12);
        // A wall in the first of five bins has its own length alone, a third of a fifth of the span, for both rays.
        assert!((at(terms[0], 9.0, 0.0) - 2.0 * 2.0 / 15.0).abs() < 1e-6, "{}", at(terms[0], 9.0, 0.0));
        // Nothing and a wall have no entropy; at an opacity of a half each ray has ln 2, in halves of it.
        assert!(at(terms[1], -60.0, 0.0).abs() < 1e-12 && at(terms[1], 9.0, 0.0).abs() < 1e-12);
        let half = (2.0_f64.ln() / 1.5).ln();
        assert!((0.6..0.7).contains(&at(terms[1], half, 0.0)), "the second ray is a little shorter");
        // What grows denser along the ray faces the viewer; what grows thinner faces away with all of its weight.
        assert_eq!(at(terms[2], 0.0, 1.0), 0.0);
        let opacity = at(&Opacity, 0.0, -1.0);
        assert!((at(terms[2], 0.0, -1.0) - 3.0 * opacity).abs() < 1e-9 && opacity > 0.5, "{opacity}");
        // A wall in the first bin, from .5 to .8 of a span to 2, is where it was measured; of a ray that meets nothing all
        // light counts as from the far end.
        assert!(at(terms[3], 9.0, 0.0).abs() < 1e-6, "{}", at(terms[3], 9.0, 0.0));
        assert!((at(terms[3], -60.0, 0.0) - 4.0 * 0.9 * 0.9).abs() < 1e-6, "{}", at(terms[3], -60.0, 0.0));
    }

    /// The sum of opacities.
    struct Opacity;

    impl<T: Scalar> Term<T> for Opacity {
        fn loss<'t>(&self, seen: &Outputs<'_, 't, T>) -> Var<'t, T> {
            seen.rendered.opacity().sum()
        }
    }
}
