//! The exposure model: exposure and white balance per image, and vignetting.

use crate::dataset::batch::Batch;
use crate::range::check_schedule;
use crate::{Error, Result};
use raygrad_autograd::{Scalar, Tensor, Var};
use raygrad_nn::{Bound, ParamId, Params, Schedule};
use serde::{Deserialize, Serialize};

/// The name of the exposure parameter.
pub(crate) const EXPOSURE: &str = "exposure";
/// The name of the vignetting parameter.
pub(crate) const VIGNETTING: &str = "vignetting";
/// Coefficients of the vignetting polynomial.
const POWERS: usize = 3;

/// Configuration of the [`ExposureModel`].
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ExposureConfig {
    /// Learning rate of the exposures over the run; null learns none. `--refine exposure` sets it. Each image has a
    /// gain for red, green and blue, so white balance is included. See [`ExposureModel`].
    pub exposure: Option<Schedule>,
    /// Learning rate of the vignetting over the run; null learns none. `--refine vignetting` sets it. All images
    /// share three coefficients.
    pub vignetting: Option<Schedule>,
}

impl ExposureConfig {
    /// Checks that all values are in range.
    ///
    /// # Errors
    /// If a value is out of range.
    pub fn check(&self) -> Result<()> {
        check_schedule("exposure_model.exposure", self.exposure)?;
        check_schedule("exposure_model.vignetting", self.vignetting)
    }
}

/// Learned gains from the scene's colours to those of each image; parameters of 0 leave colours unchanged.
///
/// The gain is `exp(e + v1 s + v2 s^2 + v3 s^3)`, applied to stored (sRGB) values:
/// - `exposure` `[images, 3]`: e for red, green and blue, which includes white balance (per-image exposure of Mueller
///   et al. 2022, instant-ngp). Between 0.2 and 1, a gain of light is nearly a gain of stored values.
/// - `vignetting` `[3]`: v1, v2 and v3, shared by all images. s is the square of a pixel's [distance from the optical
///   axis](crate::camera::Camera::off_axis) in units of half the diagonal. This is equation 2 of Goldman and Chen 2005,
///   "Vignette and exposure calibration and compensation", as a logarithm, so that no gain is negative.
///
/// The background is not multiplied. Renders use the geometric mean of all exposures, or the exposure of
/// [`appearance_image`](crate::Model::appearance_image), and no vignetting unless
/// [`vignetted`](crate::Model::vignetted) is set. Values clipped at white are not recovered.
#[derive(Debug, Clone)]
pub struct ExposureModel {
    exposure: Option<ParamId>,
    vignetting: Option<ParamId>,
}

/// The gain of a render.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Gain {
    exposure: [f64; 3],
    vignetting: [f64; POWERS],
}

impl ExposureModel {
    /// An exposure model with gains of 1 for `frames` images; `None` if nothing is learned.
    ///
    /// # Errors
    /// If exposures are learned and `frames` is 0.
    pub(crate) fn new<T: Scalar>(
        config: &ExposureConfig,
        frames: usize,
        params: &mut Params<T>,
    ) -> Result<Option<Self>> {
        if config.exposure.is_some() && frames == 0 {
            let what = "needs the number of images; set `SceneBox::frames`";
            return Err(Error::setting("exposure_model.exposure", what));
        }
        let exposure = config.exposure.map(|_| params.add(EXPOSURE, Tensor::zeros(&[frames, 3])));
        let vignetting = config.vignetting.map(|_| params.add(VIGNETTING, Tensor::zeros(&[POWERS])));
        // Sparse updates, since a step uses few of the images.
        params.set_lazy(|name| name == EXPOSURE, exposure.is_some());
        Ok((exposure.is_some() || vignetting.is_some()).then_some(ExposureModel { exposure, vignetting }))
    }

    /// The gains of a batch's rays, `[rays, 3]`.
    ///
    /// # Panics
    /// If a ray's frame index is out of range.
    #[track_caller]
    pub(crate) fn gains<'t, T: Scalar>(&self, params: &Bound<'t, T>, batch: &Batch) -> Var<'t, T> {
        let exposure = self.exposure.map(|id| params[id].gather_rows(&batch.frames));
        let vignetting = self.vignetting.map(|id| {
            let powers = batch.off_axis.iter().flat_map(|&s| [s, s * s, s * s * s]);
            let powers = powers.map(|power| T::from_f64(power.into())).collect();
            let powers = params.tape().constant(Tensor::from_vec(&[batch.off_axis.len(), POWERS], powers));
            powers.matmul(params[id].reshape(&[POWERS, 1])).broadcast_to(&[batch.off_axis.len(), 3])
        });
        let sum = [exposure, vignetting].into_iter().flatten().reduce(|a, b| a + b);
        sum.map_or_else(|| params.tape().constant(Tensor::ones(&[batch.rays.len(), 3])), |sum| sum.exp())
    }

    /// The gain of renders: of the image `look`, or the mean of all images.
    ///
    /// # Panics
    /// If `look` is out of range.
    pub(crate) fn gain<T: Scalar>(&self, params: &Params<T>, look: Option<u32>, vignetted: bool) -> Gain {
        let exposure = self.exposure.map_or([0.0; 3], |id| {
            let all = params.get(id).as_slice().as_chunks::<3>().0;
            let own = look.map_or(all, |look| &all[look as usize..=look as usize]);
            std::array::from_fn(|k| own.iter().map(|row| row[k].to_f64()).sum::<f64>() / own.len() as f64)
        });
        let vignetting = self.vignetting.filter(|_| vignetted).map_or([0.0; POWERS], |id| {
            let numbers = params.get(id).as_slice();
            std::array::from_fn(|k| numbers[k].to_f64())
        });
        Gain { exposure, vignetting }
    }
}

impl Gain {
    /// The gain at a pixel with this [distance from the axis](crate::camera::Camera::off_axis).
    pub fn at(&self, off_axis: f64) -> [f64; 3] {
        let falloff = self.vignetting.iter().rev().fold(0.0, |sum, v| off_axis * (v + sum));
        self.exposure.map(|e| (e + falloff).exp())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_autograd::Tape;
    use raygrad_autograd::check::{Check, check_function};

    const RATE: Option<Schedule> = Some(Schedule::Constant { lr: 0.1 });

    /// A trained exposure model of two images.
    fn learned() -> (ExposureModel, Params<f64>) {
        let mut params = Params::new();
        let config = ExposureConfig { exposure: RATE, vignetting: RATE };
        let tone = ExposureModel::new(&config, 2, &mut params).unwrap().unwrap();
        let [exposure, vignetting] = [EXPOSURE, VIGNETTING].map(|name| params.find(name).unwrap());
        params.get_mut(exposure).as_mut_slice().copy_from_slice(&[0.1, 0.2, 0.3, -0.5, 0.0, 0.1]);
        params.get_mut(vignetting).as_mut_slice().copy_from_slice(&[-0.4, 0.2, -0.1]);
        (tone, params)
    }

    fn batch() -> Batch {
        Batch { frames: vec![1, 0, 1], off_axis: vec![0.5, 1.0, 0.0], ..Batch::default() }
    }

    #[test]
    fn training_and_renders_have_equal_gains() {
        let (tone, params) = learned();
        let tape = Tape::new();
        let gains = tone.gains(&params.bind(&tape), &batch());
        // -0.4 / 2 + 0.2 / 4 - 0.1 / 8, and -0.4 + 0.2 - 0.1.
        let falloffs = [-0.1625_f64, -0.3, 0.0];
        let exposures = [[-0.5, 0.0, 0.1], [0.1, 0.2, 0.3], [-0.5, 0.0, 0.1]];
        for (ray, (falloff, exposure)) in falloffs.into_iter().zip(exposures).enumerate() {
            let view = tone.gain(&params, Some(batch().frames[ray]), true).at(batch().off_axis[ray].into());
            for k in 0..3 {
                let expected = (exposure[k] + falloff).exp();
                assert!((gains.value().as_slice()[3 * ray + k] - expected).abs() < 1e-12, "{ray} {k}");
                assert!((view[k] - expected).abs() < 1e-12, "{ray} {k}: {view:?}");
            }
        }
        // Without an image, the mean brightness of all, without vignetting.
        let usual = tone.gain(&params, None, false).at(1.0);
        for (gain, expected) in usual.into_iter().zip([-0.2_f64, 0.1, 0.2]) {
            assert!((gain - expected.exp()).abs() < 1e-12, "{usual:?}");
        }
    }

    #[test]
    fn exposure_gradients_equal_differences() {
        let (tone, params) = learned();
        let values: Vec<Tensor<f64>> = params.values().to_vec();
        let report = check_function(&Check::default(), &values, |x| {
            tone.gains(&params.layout().bind(x.to_vec()), &batch()).square().sum()
        });
        assert!(report.is_ok(), "{report:?}");
    }

    #[test]
    fn exposure_and_vignetting_are_independent() {
        for (config, names) in [
            (ExposureConfig::default(), &[][..]),
            (ExposureConfig { exposure: RATE, ..ExposureConfig::default() }, &[EXPOSURE]),
            (ExposureConfig { vignetting: RATE, ..ExposureConfig::default() }, &[VIGNETTING]),
        ] {
            let mut params = Params::<f32>::new();
            let tone = ExposureModel::new(&config, 2, &mut params).unwrap();
            assert_eq!((params.names().collect::<Vec<_>>(), tone.is_none()), (names.to_vec(), names.is_empty()));
            let Some(tone) = tone else { continue };
            let tape = Tape::new();
            let gains = tone.gains(&params.bind(&tape), &batch());
            assert!(gains.shape() == [3, 3] && gains.value().as_slice().iter().all(|gain| *gain == 1.0), "{names:?}");
        }
        let nobody = ExposureModel::new(
            &ExposureConfig { exposure: RATE, ..ExposureConfig::default() },
            0,
            &mut Params::<f32>::new(),
        );
        assert!(nobody.err().unwrap().to_string().contains("exposure_model.exposure"));
    }
}
