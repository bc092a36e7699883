//! Volume rendering: what arrives at the eye from the samples along a ray.

use crate::{Error, Result};
#[cfg(feature = "check")]
use raygrad_autograd::check::Entry;
use raygrad_autograd::{Grads, Op, Pool, Reads, Scalar, Segments, Shape, ShapeError, Tensor, Var, Vjp};
use raygrad_tensor::map;

/// Composites the features of packed samples, front to back (Mildenhall et al. 2020, equation 3; Max 1995).
///
/// Inputs are the density `[samples]`, at least 0 (or its logarithm, see [`of_log_density`](Self::of_log_density)), and
/// `features [samples, channels]`: colour, depth or whatever else. The output is `[rays, channels + 1]`: the sum of
/// `w_i features_i`, with `w_i = T_i alpha_i`, `alpha_i = 1 - exp(-x_i)`, `T_i = exp(-sum of x_j for j < i)` and the
/// optical depth `x_i = sigma_i delta_i`; and as last channel the transmittance that is left behind the last sample,
/// which a background is multiplied by.
///
/// The gradient runs back to front, `B_i = alpha_i c_i + (1 - alpha_i) B_(i+1)` and
/// `dL/dx_i = T_(i+1) g (c_i - B_(i+1))`: nothing is divided by a transmittance, so it is accurate behind opaque samples
/// too. A density of 0 counts as no optical depth even if `delta` is infinite; where `delta` is infinite the gradient of
/// the density is defined as 0.
#[derive(Debug, Clone)]
pub struct Composite<T: Scalar> {
    delta: Tensor<T>,
    segments: Segments,
    log_density: bool,
}

/// Logarithms of densities are cut here: `e^80 delta` is opaque for any interval above 1e-32, and finite.
const MOST_LOG_DENSITY: f64 = 80.0;

/// What happens to light on its way, for each sample.
struct Light<T: Scalar> {
    /// Optical depth of the sample's interval.
    depth: Tensor<T>,
    /// Light that arrives at the sample.
    transmittance: Tensor<T>,
    /// Share of it that the sample blocks.
    alpha: Tensor<T>,
}

impl<T: Scalar> Composite<T> {
    /// For densities of samples that stand for intervals of length `delta` `[samples]`. The operation panics where a
    /// density is negative; ask [`check`](Self::check) first if one may be.
    ///
    /// # Panics
    /// As [`try_new`](Self::try_new).
    #[track_caller]
    pub fn new(delta: Tensor<T>, segments: Segments) -> Self {
        Composite::try_new(delta, segments).unwrap_or_else(|error| panic!("{error}"))
    }

    /// As [`new`](Self::new).
    ///
    /// # Errors
    /// If an interval is negative or NaN, or there is not one for each row of the segments.
    pub fn try_new(delta: Tensor<T>, segments: Segments) -> Result<Self> {
        if delta.shape() != [segments.rows()] {
            let what = format!("has shape {:?}: one interval for each of {} samples", delta.shape(), segments.rows());
            return Err(Error::setting("delta", what));
        }
        match delta.as_slice().iter().position(|&delta| !(delta >= T::ZERO)) {
            Some(i) => Err(Error::setting(format!("delta[{i}]"), format!("is {}; use 0 or more", delta.as_slice()[i]))),
            None => Ok(Composite { delta, segments, log_density: false }),
        }
    }

    /// The same for logarithms z of densities, `sigma = e^z`. The exponential is part of the operation, whose gradient
    /// `x e^-x` stays finite and right where that of a separate exponential is infinity times 0.
    #[track_caller]
    pub fn of_log_density(delta: Tensor<T>, segments: Segments) -> Self {
        Composite { log_density: true, ..Composite::new(delta, segments) }
    }

    /// Whether every density is one: at least 0, or NaN, which is somebody else's fault and passes through. Any number is
    /// the logarithm of one.
    ///
    /// # Errors
    /// If a density is negative; the error says which.
    pub fn check(&self, density: &Tensor<T>) -> Result<()> {
        let density = density.as_slice();
        match density.iter().position(|&sigma| !self.log_density && sigma < T::ZERO) {
            Some(i) => {
                let what = format!("is {}; a density is at least 0: end the network with a softplus", density[i]);
                Err(Error::setting(format!("density[{i}]"), what))
            }
            None => Ok(()),
        }
    }

    /// The optical depth of each sample's interval, `[samples]`, for densities `[samples]`.
    pub(crate) fn optical_depth(&self, density: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
        if let Err(error) = self.check(density) {
            panic!("{error}");
        }
        let most = T::from_f64(MOST_LOG_DENSITY);
        if self.log_density {
            map(
                [density, &self.delta],
                pool,
                #[inline(always)]
                |[z, delta]| (if z > most { most } else { z }).exp() * delta,
            )
        } else {
            map(
                [density, &self.delta],
                pool,
                #[inline(always)]
                // Not the product alone, which is NaN for 0 times infinity.
                |[sigma, delta]| if sigma == T::ZERO { T::ZERO } else { sigma * delta },
            )
        }
    }

    fn light(&self, density: &Tensor<T>, pool: &Pool<T>) -> Light<T> {
        let depth = self.optical_depth(density, pool);
        let mut before = pool.tensor(density.shape());
        let out = before.as_mut_slice();
        for rows in self.segments.ranges() {
            let mut sum = 0.0;
            for i in rows {
                out[i] = T::from_f64(sum);
                sum += depth.as_slice()[i].to_f64();
            }
        }
        let transmittance = map(
            [&before],
            pool,
            #[inline(always)]
            |[tau]| (-tau).exp(),
        );
        let alpha = map(
            [&depth],
            pool,
            #[inline(always)]
            |[depth]| -(-depth).expm1(),
        );
        Light { depth, transmittance, alpha }
    }

    /// Optical depths out of plain operations.
    fn depth<'t>(&self, density: &Var<'t, T>) -> Var<'t, T> {
        let sigma = if self.log_density { density.exp() } else { density.clone() };
        let constant = |f: &dyn Fn(T, T) -> T| {
            let pairs = self.delta.as_slice().iter().zip(sigma.value().as_slice());
            let values = pairs.map(|(&delta, &sigma)| f(delta, sigma)).collect();
            sigma.tape().constant(Tensor::from_vec(self.delta.shape(), values))
        };
        // An infinite interval adds a constant: nothing to no density, and infinity to any.
        let finite = constant(&|delta, _| if delta.is_finite() { delta } else { T::ZERO });
        if self.delta.is_finite() {
            return sigma * finite;
        }
        let infinite = constant(&|delta, sigma| if delta.is_finite() || sigma == T::ZERO { T::ZERO } else { delta });
        sigma * finite + infinite
    }

    fn weights_from<'t>(&self, depth: &Var<'t, T>) -> Var<'t, T> {
        let transmittance = (-depth.segment_cumsum(&self.segments, true)).exp();
        transmittance * -(-depth).expm1()
    }

    /// The weight `w_i` of each sample, `[samples]`, out of plain operations: for losses of the weights themselves, such
    /// as [`Distortion`](crate::Distortion).
    ///
    /// # Panics
    /// If there is not one density for each sample.
    #[track_caller]
    pub fn weights<'t>(&self, density: &Var<'t, T>) -> Var<'t, T> {
        self.weights_from(&self.depth(density))
    }

    /// The transmittance `T_i` in front of each sample and its weight `w_i`, each `[samples]`.
    ///
    /// # Panics
    /// If there is not one density for each sample.
    pub fn transmittance_and_weights(&self, density: &Tensor<T>, pool: &Pool<T>) -> [Tensor<T>; 2] {
        assert_eq!(density.shape(), self.delta.shape(), "one density for each sample");
        let Light { transmittance, alpha, .. } = self.light(density, pool);
        let weights = map(
            [&transmittance, &alpha],
            pool,
            #[inline(always)]
            |[t, a]| t * a,
        );
        [transmittance, weights]
    }

    /// The gradients of the density and of the features for the gradient `g` of the output.
    pub(crate) fn backward(
        &self,
        density: &Tensor<T>,
        features: &Tensor<T>,
        g: &Tensor<T>,
        pool: &Pool<T>,
    ) -> [Tensor<T>; 2] {
        let channels = features.shape()[1];
        let light = self.light(density, pool);
        let (depth, transmittance, alpha) =
            (light.depth.as_slice(), light.transmittance.as_slice(), light.alpha.as_slice());
        // e^-x, not 1 - alpha, which has no digits behind an opaque sample.
        let passed = map(
            [&light.depth],
            pool,
            #[inline(always)]
            |[depth]| (-depth).exp(),
        );
        let (passed, delta) = (passed.as_slice(), self.delta.as_slice());
        let (mut d_density, mut d_features) = (pool.tensor(density.shape()), pool.tensor(features.shape()));
        let (d_density_out, d_features_out) = (d_density.as_mut_slice(), d_features.as_mut_slice());
        let features = features.as_slice();
        // In f64, so that the light from behind keeps its digits on rays of any number of samples.
        let mut behind = vec![0.0_f64; channels + 1];
        for (g, rows) in g.as_slice().chunks_exact(channels + 1).zip(self.segments.ranges()) {
            // Behind the last sample there are no features, and all that is left of the light.
            behind.fill(0.0);
            behind[channels] = 1.0;
            for i in rows.rev() {
                let weight = transmittance[i] * alpha[i];
                let blocked = alpha[i].to_f64();
                // What passes: of thin samples 1 - alpha has all digits and adds up with alpha, of thick ones e^-x has.
                let passes = if blocked < 0.5 { 1.0 - blocked } else { passed[i].to_f64() };
                let mut difference = -(g[channels].to_f64() * behind[channels]);
                for c in 0..channels {
                    let feature = features[i * channels + c].to_f64();
                    d_features_out[i * channels + c] = weight * g[c];
                    difference += g[c].to_f64() * (feature - behind[c]);
                    behind[c] = blocked * feature + passes * behind[c];
                }
                behind[channels] *= passes;
                // dx/dz = x for x = e^z delta, and dx/dsigma = delta.
                let slope = if self.log_density { depth[i] } else { delta[i] };
                let d_depth = transmittance[i] * passed[i] * T::from_f64(difference);
                d_density_out[i] = if slope.is_finite() { slope * d_depth } else { T::ZERO };
            }
        }
        [d_density, d_features]
    }
}

impl<T: Scalar> Op<T> for Composite<T> {
    fn name(&self) -> &'static str {
        "composite"
    }

    fn shape(&self, x: &[&[usize]]) -> std::result::Result<Shape, ShapeError> {
        let samples = self.segments.rows();
        match (x[0], x[1]) {
            (&[density], &[features, channels]) if density == samples && features == samples => {
                Ok([self.segments.len(), channels + 1].into_iter().collect())
            }
            _ => Err(format!("densities must be [{samples}] and features [{samples}, channels]")),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let channels = x[1].shape()[1];
        let features = x[1].as_slice();
        let light = self.light(x[0], pool);
        let (depth, transmittance, alpha) =
            (light.depth.as_slice(), light.transmittance.as_slice(), light.alpha.as_slice());
        let mut out = pool.tensor(&[self.segments.len(), channels + 1]);
        let mut sums = vec![0.0_f64; channels];
        for (out, rows) in out.as_mut_slice().chunks_exact_mut(channels + 1).zip(self.segments.ranges()) {
            sums.fill(0.0);
            let mut total = 0.0;
            for i in rows {
                let weight = (transmittance[i] * alpha[i]).to_f64();
                for (sum, feature) in sums.iter_mut().zip(&features[i * channels..]) {
                    *sum += weight * feature.to_f64();
                }
                total += depth[i].to_f64();
            }
            for (out, &sum) in out.iter_mut().zip(&sums) {
                *out = T::from_f64(sum);
            }
            out[channels] = T::from_f64((-total).exp());
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (density, features) = (cx.x(0).into_value(), cx.x(1).into_value());
        Grads::new(self.backward(&density, &features, cx.g().value(), cx.pool()).map(|d| Some(cx.constant(d))))
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let (features, depth) = (&x[1], self.depth(&x[0]));
        let weighted = features * self.weights_from(&depth).reshape(&[self.segments.rows(), 1]);
        let left = (-depth.segment_sum(&self.segments)).exp().reshape(&[self.segments.len(), 1]);
        Some(Var::concat(&[&weighted.segment_sum(&self.segments), &left], 1))
    }
}

/// The catalogue entries of this file. [`Composite`] holds a tensor of its own number type, so each precision has its own.
#[cfg(feature = "check")]
pub(crate) fn entries() -> Vec<Entry> {
    let delta = || Tensor::<f64>::from_vec(&[7], vec![0.25, 0.5, 0.125, 0.5, 1.0, 0.0, 0.375]);
    let segments = || Segments::new([0, 3, 3, 4, 7]);
    let entry = || Entry::of(Composite::new(delta(), segments()), Composite::new(delta().cast::<f32>(), segments()));
    let sigma = |values: [f64; 7]| Tensor::from_vec(&[7], values.to_vec());
    let features = |channels: usize| Tensor::from_fn(&[7, channels], |i| ((i * 29) % 17) as f64 / 17.0);
    let none = || (Tensor::zeros(&[0]), Segments::new([0, 0]));
    vec![
        entry().sample_of(vec![sigma([0.4, 1.3, 2.0, 0.1, 3.0, 0.7, 0.2]), features(3)]),
        entry().sample_of(vec![sigma([30.0, 0.5, 9.0, 0.01, 20.0, 5.0, 40.0]), features(1)]),
        Entry::of(
            Composite::of_log_density(delta(), segments()),
            Composite::of_log_density(delta().cast::<f32>(), segments()),
        )
        .sample_of(vec![sigma([0.4, -1.3, 2.0, -3.1, 1.0, 0.7, 0.2]), features(2)]),
        Entry::of(Composite::new(none().0, none().1), Composite::new(none().0.cast::<f32>(), none().1))
            .sample_of(vec![Tensor::zeros(&[0]), Tensor::zeros(&[0, 3])]),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_autograd::Tape;

    /// Output and gradients of sigma and features for one ray and a gradient of 1 in every channel.
    fn one_ray<T: Scalar>(sigma: &[f64], delta: &[f64], colour: &[f64]) -> [Vec<f64>; 3] {
        let tensor = |x: &[f64], shape: &[usize]| Tensor::from_vec(shape, x.iter().map(|&x| T::from_f64(x)).collect());
        let n = sigma.len();
        let tape = Tape::new();
        let s = tape.leaf(tensor(sigma, &[n]));
        let c = tape.leaf(tensor(colour, &[n, 1]));
        let out = tape.apply(Composite::new(tensor(delta, &[n]), Segments::uniform(1, n)), &[&s, &c]);
        let grads = out.slice_axis(1, ..1).sum().grad(&[&s, &c]);
        [out.value(), &grads[0], &grads[1]].map(|x| x.as_slice().iter().map(|x| x.to_f64()).collect())
    }

    #[test]
    fn the_exponential_density_has_no_bad_gradient() {
        // One sample of colour 1: C = 1 - e^-x, dC/dz = x e^-x with x = e^z delta.
        for z in [-200.0, -20.0, 0.0, 15.0, 16.0, 88.0, 89.0, 200.0_f64] {
            for delta in [1e-6_f32, 1e-3, 1.0] {
                let tape = Tape::new();
                let density = tape.leaf(Tensor::from_vec(&[1], vec![z as f32]));
                let feature = tape.constant(Tensor::ones(&[1, 1]));
                let op = Composite::of_log_density(Tensor::from_vec(&[1], vec![delta]), Segments::uniform(1, 1));
                let color = tape.apply(op, &[&density, &feature]).slice_axis(1, ..1).sum();
                let x = z.exp() * f64::from(delta);
                let (value, slope) = (f64::from(color.item()), f64::from(color.grad(&[&density])[0].item()));
                let expected = if x > 700.0 { 0.0 } else { x * (-x).exp() };
                assert!((value + (-x).exp_m1()).abs() <= 2e-7 * value.max(1e-30), "z {z}, delta {delta}: {value}");
                assert!(
                    (slope - expected).abs() <= 1e-5 * expected + 1e-37,
                    "z {z}, delta {delta}: {slope} {expected}"
                );
            }
        }
    }

    #[test]
    fn constant_density_and_colour_give_the_exact_integral() {
        // numerics.md, section 2, without the background: c (1 - E) and E.
        let n = 64;
        let [out, ..] = one_ray::<f64>(&vec![1.3; n], &vec![4.0 / n as f64; n], &vec![0.8; n]);
        let e = (-5.2_f64).exp();
        assert!((out[0] - 0.8 * (1.0 - e)).abs() < 1e-14);
        assert!((out[1] - e).abs() < 1e-15);
        assert!((out[0] + out[1] - 0.801_103_312_884_152_1).abs() < 1e-14);
    }

    #[test]
    fn no_samples_nothing_and_everything() {
        let [out, ..] = one_ray::<f32>(&[], &[], &[]);
        assert_eq!(out, [0.0, 1.0], "no samples: the background");
        let [out, ..] = one_ray::<f32>(&[0.0; 3], &[1.0; 3], &[0.9; 3]);
        assert_eq!(out, [0.0, 1.0], "empty space: the background");
        let [out, d_sigma, _] = one_ray::<f32>(&[1e30; 3], &[1.0; 3], &[0.25, 0.5, 0.75]);
        assert_eq!(out, [0.25, 0.0], "opaque: the first colour");
        assert_eq!(d_sigma, [0.0; 3]);
        let [out, d_sigma, _] = one_ray::<f32>(&[0.5, 0.0], &[1.0, f64::INFINITY], &[0.25, 0.5]);
        assert!((out[1] - (-0.5_f64).exp()).abs() < 1e-7 && d_sigma[1] == 0.0, "an empty infinite interval");
    }

    #[test]
    fn tiny_optical_depths_keep_their_digits() {
        let n = 1024;
        let [out, ..] = one_ray::<f32>(&vec![1e-3; n], &vec![1.0 / n as f64; n], &vec![1.0; n]);
        let exact = -(-1e-3_f64).exp_m1();
        assert!((out[0] / exact - 1.0).abs() < 2e-7, "{} against {exact}", out[0]);
    }

    #[test]
    fn the_gradient_survives_opaque_samples() {
        // alpha = (.3, 1, .5), c = (.2, .9, .4): dC/dalpha = (-.7, .49 T, 0); dC/dx_i = (1 - alpha_i) dC/dalpha_i.
        let x = [-(0.7_f64.ln()), f64::INFINITY, 2.0_f64.ln()];
        let [out, d_sigma, d_colour] = one_ray::<f64>(&[x[0], 1e300, x[2]], &[1.0; 3], &[0.2, 0.9, 0.4]);
        assert!((out[0] - (0.3 * 0.2 + 0.7 * 0.9)).abs() < 1e-15);
        assert!((d_sigma[0] - 0.7 * -0.7).abs() < 1e-15 && d_sigma[1] == 0.0 && d_sigma[2] == 0.0);
        assert!((d_colour[1] - 0.7).abs() < 1e-15 && d_colour[2] == 0.0);
    }

    #[test]
    fn f32_keeps_its_accuracy_behind_dense_samples() {
        let n = 192;
        let wave = |i: usize, k: f64| 0.5 + 0.5 * (i as f64 * k).sin();
        for scale in [0.5, 5.0, 40.0] {
            let round = |x: f64| f64::from(x as f32);
            let sigma: Vec<f64> = (0..n).map(|i| round(scale * wave(i, 0.13))).collect();
            let delta: Vec<f64> = (0..n).map(|i| round(4.0 / n as f64 * (0.5 + wave(i, 0.7)))).collect();
            let colour: Vec<f64> = (0..n).map(|i| round(wave(i, 0.31))).collect();
            let [single, d_single, _] = one_ray::<f32>(&sigma, &delta, &colour);
            let [double, d_double, _] = one_ray::<f64>(&sigma, &delta, &colour);
            assert!((single[0] - double[0]).abs() <= 1e-6, "scale {scale}: {} against {}", single[0], double[0]);
            let mut tau = 0.0_f64;
            for i in 0..n {
                let error = (d_single[i] - d_double[i]).abs();
                let t = (-tau).exp();
                assert!(error <= 1e-5 * delta[i] * t + 1e-38, "scale {scale}, sample {i}: {error:e}, T {t:e}");
                tau += sigma[i] * delta[i];
            }
        }
    }
}
