//! Loss terms from the literature.

use super::{LossInputs, LossTerm, LossTerms};
use crate::Result;
use crate::component::{BuildContext, ComponentConfig};
use crate::range::check_range;
use crate::volume::distortion::Distortion;
use raygrad_autograd::{Scalar, Tensor, Var};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The [distortion](Distortion) loss (kind `distortion`): it concentrates weights along each ray, against floaters and
/// fog (Barron et al. 2022, equation 15).
///
/// Distances are shares of the ray's span. In an unbounded scene, distances beyond half the box's side count by their
/// inverses, as in the [contraction](crate::Contraction).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DistortionConfig {
    /// Weight of the term. Usual are 0.001 to 0.01, and 0.1 in an unbounded scene without proposals. Range: 0
    /// to 1000000.
    pub weight: f64,
}

/// The entropy loss (kind `entropy`): `-o ln o - (1 - o) ln(1 - o)` of each ray's opacity `o`, which drives it to 0 or
/// 1 (Kim et al. 2022, "InfoNeRF", for whole rays).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EntropyConfig {
    /// Weight of the term. Usual are 0.0001 to 0.01. Range: 0 to 1000000.
    pub weight: f64,
}

/// The orientation loss (kind `orientation`): `sum w max(0, n . d)^2` penalises surfaces that face away from the camera
/// (Verbin et al. 2022, "Ref-NeRF", equation 11).
///
/// w are weights, n [normals](crate::Rendered::normals) and d ray directions. It differentiates the density twice,
/// which takes several times as long as a step without it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OrientationConfig {
    /// Weight of the term. Usual is 0.1. Range: 0 to 1000000.
    pub weight: f64,
}

/// The depth loss (kind `depth`): `sum w e(t) + T e(far)` with `e(t) = min(1, ((t - d) / u)^2)`.
///
/// w are the weights of samples at t, T is the transmittance at the far end of the span, d the measured
/// [distance](crate::dataset::Frame::distances) and u the scene's [unit](crate::Space::unit). It is minimal if all
/// weight lies at d, or, if d lies beyond the span, if no light is blocked. Rays without a measurement, or with one
/// before the span, add nothing. It is related to Deng et al. 2022, "Depth-supervised NeRF", section 4; the clamped
/// square replaces their likelihood, so that it is finite everywhere.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthConfig {
    /// Weight of the term. `--depth-loss` uses 0.1. Range: 0 to 1000000.
    pub weight: f64,
}

/// Implements terms whose configuration is the term itself.
macro_rules! terms {
    ($($kind:literal $config:ty),*) => {
        $(impl ComponentConfig<LossTerms> for $config {
            const KIND: &'static str = $kind;
            fn check(&self) -> Result<()> {
                check_range(concat!($kind, ".weight"), self.weight, 0.0, 1e6)
            }
            fn build<T: Scalar>(&self, _: BuildContext<'_, T>) -> Result<Arc<dyn LossTerm<T>>> {
                Ok(Arc::new(*self))
            }
        })*
    };
}

terms!("entropy" EntropyConfig, "orientation" OrientationConfig);

impl ComponentConfig<LossTerms> for DistortionConfig {
    const KIND: &'static str = "distortion";

    fn check(&self) -> Result<()> {
        check_range("distortion.weight", self.weight, 0.0, 1e6)
    }

    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<Arc<dyn LossTerm<T>>> {
        let reach = site.space.unbounded.then_some(0.5 * site.space.side());
        Ok(Arc::new(DistortionLoss { weight: self.weight, reach }))
    }
}

/// The distortion loss with its scale of distances.
struct DistortionLoss {
    weight: f64,
    /// Half of the side of an unbounded scene's box: beyond it distances are inverted.
    reach: Option<f64>,
}

impl DistortionLoss {
    /// Maps a distance to a share of the span, monotonically.
    fn place(&self, distance: f64, [near, far]: [f64; 2]) -> f64 {
        match self.reach {
            None => (distance - near) / (far - near).max(1e-12),
            Some(reach) if distance <= reach => 0.5 * distance / reach,
            Some(reach) => 1.0 - 0.5 * reach / distance,
        }
    }
}

impl ComponentConfig<LossTerms> for DepthConfig {
    const KIND: &'static str = "depth";

    fn check(&self) -> Result<()> {
        check_range("depth.weight", self.weight, 0.0, 1e6)
    }

    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<Arc<dyn LossTerm<T>>> {
        Ok(Arc::new(Depth { weight: self.weight, unit: site.space.unit }))
    }
}

/// The depth loss.
struct Depth {
    weight: f64,
    /// The unit of errors, in scene units.
    unit: f64,
}

impl<T: Scalar> LossTerm<T> for DistortionLoss {
    fn loss<'t>(&self, seen: &LossInputs<'_, 't, T>) -> Var<'t, T> {
        let samples = &seen.rendered.samples;
        let (mut middles, mut lengths) = (Vec::with_capacity(samples.len()), Vec::with_capacity(samples.len()));
        for (rows, span) in samples.segments.ranges().zip(&seen.rays.spans) {
            let span = span.map(T::to_f64);
            for (t, delta) in samples.t.as_slice()[rows.clone()].iter().zip(&samples.delta.as_slice()[rows]) {
                let (t, half) = (t.to_f64(), 0.5 * delta.to_f64());
                // A sample's interval may end beyond the span.
                let [start, end] = [(t - half).max(0.0), t + half].map(|distance| self.place(distance, span));
                // Intervals of any lengths may overlap; the midpoints rise.
                middles.push(T::from_f64(self.place(t, span)));
                lengths.push(T::from_f64(end - start));
            }
        }
        let tensor = |values: Vec<T>| Tensor::from_vec(&[samples.len()], values);
        let op = Distortion::new(tensor(middles), tensor(lengths), samples.segments.clone());
        seen.rendered.weights.tape().apply(op, &[&seen.rendered.weights]).sum() * self.weight
    }
}

impl<T: Scalar> LossTerm<T> for EntropyConfig {
    fn loss<'t>(&self, seen: &LossInputs<'_, 't, T>) -> Var<'t, T> {
        // With the optical depth x, ln(1 - o) = -x. It is exact for opaque rays, and o is precise for thin ones.
        let (opacity, x) = (seen.rendered.opacity(), &seen.rendered.optical_depth);
        let met = &opacity * opacity.maximum(1e-20).ln();
        let left = seen.rendered.transmittance() * x.minimum(1e3);
        (left - met).sum() * self.weight
    }
}

impl<T: Scalar> LossTerm<T> for OrientationConfig {
    fn loss<'t>(&self, seen: &LossInputs<'_, 't, T>) -> Var<'t, T> {
        let rendered = seen.rendered;
        let directions = rendered.directions.segment_expand(&rendered.samples.segments);
        let away = (rendered.normals() * directions).sum_over(1).relu().square();
        (away * &rendered.weights).sum() * self.weight
    }

    fn needs_normals(&self) -> bool {
        true
    }
}

impl<T: Scalar> LossTerm<T> for Depth {
    fn loss<'t>(&self, seen: &LossInputs<'_, 't, T>) -> Var<'t, T> {
        let samples = &seen.rendered.samples;
        let (mut errors, mut behind) = (Vec::with_capacity(samples.len()), Vec::with_capacity(seen.rays.len()));
        let measured = seen.distances.iter().map(|&distance| (distance > 0.0).then_some(f64::from(distance)));
        for ((rows, [near, far]), measured) in samples.segments.ranges().zip(&seen.rays.spans).zip(measured) {
            let [near, far] = [near, far].map(|x| x.to_f64());
            let error = |t: f64| match measured {
                Some(distance) if near < distance => ((t - distance) / self.unit).powi(2).min(1.0),
                _ => 0.0,
            };
            errors.extend(samples.t.as_slice()[rows].iter().map(|t| T::from_f64(error(t.to_f64()))));
            let is_beyond = measured.is_some_and(|distance| distance >= far);
            behind.push(T::from_f64(if is_beyond { 0.0 } else { error(far) }));
        }
        let tape = seen.rendered.weights.tape();
        let met = (tape.constant(Tensor::from_vec(&[samples.len()], errors)) * &seen.rendered.weights).sum();
        let left = tape.constant(Tensor::from_vec(&[seen.rays.len()], behind)) * seen.rendered.transmittance();
        (met + left.sum()) * self.weight
    }

    fn needs_distances(&self) -> bool {
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Ray;
    use crate::camera::rays::Rays;
    use crate::field::{Density, Field, ViewInputs};
    use crate::space::cube::Space;
    use glam::DVec3;
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;
    use raygrad_autograd::Tape;
    use raygrad_autograd::check::{Check, check_function};
    use raygrad_nn::{Bound, Params};

    /// A log density that is linear in z, with two parameters: its value at 0 and its slope.
    struct Slope;

    impl<T: Scalar> Field<T> for Slope {
        fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
            let vars = params.vars();
            let z = positions.slice_axis(1, 2..3).reshape(&[positions.shape()[0]]);
            Density { value: z * vars[1] + vars[0], log: true, features: positions.clone() }
        }
        fn color<'t>(&self, _: &Bound<'t, T>, features: &Var<'t, T>, _: &ViewInputs<'_, 't, T>) -> Var<'t, T> {
            features.constant(0.5).broadcast_to(features.shape())
        }
    }

    /// A term's value for two rays along z, as a function of the two parameters.
    fn value<'t>(term: &dyn LossTerm<f64>, x: &[Var<'t, f64>]) -> Var<'t, f64> {
        value_at(term, x, 0.65)
    }

    /// The same with this distance measured for the first ray, and none for the second.
    fn value_at<'t>(term: &dyn LossTerm<f64>, x: &[Var<'t, f64>], distance: f64) -> Var<'t, f64> {
        let mut params = Params::<f64>::new();
        params.add("much", Tensor::scalar(0.0));
        params.add("steep", Tensor::scalar(0.0));
        let bound = params.layout().bind(x.to_vec());
        let mut rays = Rays::new();
        for shift in [0.0, 0.25] {
            rays.push(&Ray { origin: DVec3::new(shift, 0.0, -1.0), direction: DVec3::Z }, [0.5 + shift, 2.0]);
        }
        LossInputs::render(&Slope, &bound, &rays, 5, |inputs| {
            term.loss(&LossInputs { distances: &[distance as f32, 0.0], ..inputs })
        })
    }

    fn at(term: &dyn LossTerm<f64>, much: f64, steep: f64) -> f64 {
        let tape = Tape::new();
        value(term, &[much, steep].map(|x| tape.leaf(Tensor::scalar(x)))).item()
    }

    #[test]
    fn loss_terms_match_formulas_and_differences() {
        let terms: [&dyn LossTerm<f64>; 4] = [
            &DistortionLoss { weight: 2.0, reach: None },
            &EntropyConfig { weight: 0.5 },
            &OrientationConfig { weight: 3.0 },
            &Depth { weight: 4.0, unit: 1.6 },
        ];
        for (i, term) in terms.into_iter().enumerate() {
            let report =
                check_function(&Check::default(), &[Tensor::scalar(0.3), Tensor::scalar(0.4)], |x| value(term, x));
            assert!(report.is_ok(), "term {i}: {report:?}");
        }
        // Thin fog is spread over the span; thick fog absorbs at its start.
        assert!(at(terms[0], 0.0, 0.0) > 2.0 * at(terms[0], 6.0, 0.0));
        assert!(
            (at(terms[0], 0.5, 0.2) - 2.0 * at(&DistortionLoss { weight: 1.0, reach: None }, 0.5, 0.2)).abs() < 1e-12
        );
        // A wall in the first of five bins has its own length alone: a third of a fifth of the span, for both rays.
        assert!((at(terms[0], 9.0, 0.0) - 2.0 * 2.0 / 15.0).abs() < 1e-6, "{}", at(terms[0], 9.0, 0.0));
        // An unbounded scene with half a box of 1.1: linear up to there, then inverse, with the limit 1.
        let unbounded = DistortionLoss { weight: 2.0, reach: Some(1.1) };
        let places = [0.0, 0.55, 1.1, 2.2, 1e9].map(|distance| unbounded.place(distance, [0.5, 2.0]));
        assert!(places.iter().zip([0.0, 0.25, 0.5, 0.75, 1.0]).all(|(a, b)| (a - b).abs() < 1e-9), "{places:?}");
        // The walls' bins have the lengths 0.3 and 0.25, over 2.2.
        assert!((at(&unbounded, 9.0, 0.0) - 2.0 / 3.0 * 0.55 / 2.2).abs() < 1e-6, "{}", at(&unbounded, 9.0, 0.0));
        // Empty rays and walls have no entropy. At an opacity of 0.5 each ray has ln 2, with the weight 0.5.
        assert!(at(terms[1], -60.0, 0.0).abs() < 1e-12 && at(terms[1], 9.0, 0.0).abs() < 1e-12);
        let half = (2.0_f64.ln() / 1.5).ln();
        assert!((0.6..0.7).contains(&at(terms[1], half, 0.0)), "the second ray is a little shorter");
        // Density that rises along the ray faces the viewer; density that falls faces away with all of its weight.
        assert_eq!(at(terms[2], 0.0, 1.0), 0.0);
        let opacity = at(&Opacity, 0.0, -1.0);
        assert!((at(terms[2], 0.0, -1.0) - 3.0 * opacity).abs() < 1e-9 && opacity > 0.5, "{opacity}");
        // A wall in the first bin, from 0.5 to 0.8, has no error if it was measured within it; otherwise the error is
        // its distance. The light of a ray without density counts as from the far end.
        assert!(at(terms[3], 9.0, 0.0).abs() < 1e-6, "{}", at(terms[3], 9.0, 0.0));
        let far = (1.35_f64 / 1.6).powi(2);
        assert!((at(terms[3], -60.0, 0.0) - 4.0 * far).abs() < 1e-6, "{}", at(terms[3], -60.0, 0.0));
        let wall = |distance: f64| {
            let tape = Tape::new();
            let x = [9.0, 0.0].map(|x| tape.leaf(Tensor::scalar(x)));
            value_at(&Depth { weight: 4.0, unit: 0.2 }, &x, distance).item()
        };
        for (distance, error) in [(0.55, 0.25), (0.75, 0.25), (1.5, 1.0), (9.0, 1.0), (0.5, 0.0), (0.3, 0.0)] {
            assert!((wall(distance) - 4.0 * error).abs() < 1e-5, "{distance}: {}", wall(distance));
        }
        let tape = Tape::new();
        let clear = [-60.0, 0.0].map(|x| tape.leaf(Tensor::scalar(x)));
        let beyond = value_at(&Depth { weight: 4.0, unit: 0.2 }, &clear, 9.0).item();
        assert!(beyond.abs() < 1e-9, "what lies beyond the span is seen through it: {beyond}");
    }

    #[test]
    fn distortion_depends_on_unbounded_scenes() {
        let config = DistortionConfig { weight: 2.0 };
        let space = Space::within([DVec3::splat(-1.1), DVec3::splat(1.1)]);
        for (unbounded, reach) in [(false, None), (true, Some(1.1))] {
            let (space, params) = (Space { unbounded, ..space }, &mut Params::<f64>::new());
            let rng = &mut Pcg64Mcg::seed_from_u64(0);
            let built = config.build(BuildContext { space, frames: 0, params, name: "terms", rng }).unwrap();
            let by_hand = DistortionLoss { weight: 2.0, reach };
            assert_eq!(at(&*built, 0.3, 0.4), at(&by_hand, 0.3, 0.4));
        }
        assert_ne!(
            at(&DistortionLoss { weight: 2.0, reach: None }, 0.3, 0.4),
            at(&DistortionLoss { weight: 2.0, reach: Some(1.1) }, 0.3, 0.4)
        );
    }

    /// A density that falls along (2, 1, 2).
    struct Tilted;

    impl Field<f64> for Tilted {
        fn density<'t>(&self, _: &Bound<'t, f64>, positions: &Var<'t, f64>) -> Density<'t, f64> {
            let fall = positions.tape().constant(Tensor::from([[-2.0], [-1.0], [-2.0]]));
            let value = positions.matmul(&fall).reshape(&[positions.shape()[0]]);
            Density { value, log: true, features: positions.clone() }
        }
        fn color<'t>(&self, _: &Bound<'t, f64>, features: &Var<'t, f64>, _: &ViewInputs<'_, 't, f64>) -> Var<'t, f64> {
            features.constant(0.5).broadcast_to(features.shape())
        }
    }

    #[test]
    fn orientation_uses_one_frame_for_normals_and_rays() {
        let params = Params::<f64>::new();
        let tape = Tape::new();
        let bound = params.bind(&tape);
        let mut rays = Rays::new();
        rays.push(&Ray { origin: DVec3::new(0.1, -0.2, 0.3), direction: DVec3::new(0.6, 0.0, 0.8) }, [0.5, 2.0]);
        let away = (2.0 * 0.6 + 2.0 * 0.8) / 3.0_f64;
        let [found, expected] = LossInputs::render(&Tilted, &bound, &rays, 5, |inputs| {
            let expected = 0.5 * away * away * inputs.rendered.opacity().item();
            [OrientationConfig { weight: 0.5 }.loss(&inputs).item(), expected]
        });
        assert!((found - expected).abs() < 1e-9 && expected > 0.01, "{found} {expected}");
    }

    /// The sum of opacities.
    struct Opacity;

    impl<T: Scalar> LossTerm<T> for Opacity {
        fn loss<'t>(&self, seen: &LossInputs<'_, 't, T>) -> Var<'t, T> {
            seen.rendered.opacity().sum()
        }
    }
}
