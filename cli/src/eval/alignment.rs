//! Cameras and appearance of the evaluated views. Errors in them are not errors of the model.

use raygrad::nerf::dataset::{Dataset, Split};
use raygrad::nerf::{Error, InstantConfig, Model, Result};
use serde::{Deserialize, Serialize};

/// Cameras of the evaluated views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Alignment {
    /// The cameras of the scene; the model has no pose refinement.
    #[serde(rename = "none")]
    None,
    /// The refined cameras of the training images.
    #[serde(rename = "as learned")]
    Learned,
    /// The poses of the scene with the refined focal length and lens.
    #[serde(rename = "focal length and lens as learned")]
    Glass,
    /// As [`Glass`](Self::Glass), with poses mapped by the similarity between given and refined training cameras.
    #[serde(rename = "similarity of the training cameras")]
    Similarity,
    /// Each camera is fitted to the model, starting from one of the above.
    #[serde(rename = "each fitted to its own image")]
    Fitted,
}

impl Alignment {
    /// Sets the cameras of the images.
    ///
    /// # Errors
    ///
    /// Fails if the split is the training split and an image is not in `trained`, the names of the training images.
    pub fn apply(model: &Model<f32>, trained: &[String], split: Split, data: &mut Dataset) -> Result<Self> {
        let Some(refine) = &model.camera_optimizer else { return Ok(Alignment::None) };
        if split == Split::Train {
            for frame in &mut data.frames {
                let number = trained.iter().position(|name| *name == frame.name).ok_or_else(|| {
                    let what = format!(
                        "`{}` is not a training image of the run, which has no camera for it: name the unchanged \
                         capture with --scene",
                        frame.name
                    );
                    Error::setting("scene", what)
                })?;
                frame.camera = model.learned_camera(number, &frame.camera);
            }
            return Ok(Alignment::Learned);
        }
        let given: Vec<_> = data.frames.iter().map(|frame| frame.camera.clone()).collect();
        data.frames.iter_mut().zip(model.other_cameras(&given)).for_each(|(frame, camera)| frame.camera = camera);
        Ok(match refine.transform(&model.params) {
            Some(_) => Alignment::Similarity,
            None if refine.has_poses() => Alignment::None,
            None => Alignment::Glass,
        })
    }
}

/// Appearance of the evaluated views, as that of held-out images is unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Appearance {
    /// The model has no appearance parameters.
    #[serde(rename = "none")]
    None,
    /// The mean over the training images of appearance embedding and exposure.
    #[serde(rename = "mean of the training images")]
    Mean,
    /// The appearance of the image itself, for training images.
    #[serde(rename = "each image's own")]
    Own,
    /// As [`Mean`](Self::Mean), with one gain per channel fitted to the left half. The right half is compared.
    #[serde(rename = "gains fitted to the left half, right half compared")]
    Half,
}

impl Appearance {
    /// Number of left columns of an image that are excluded from the comparison.
    pub fn fitted_columns(self, width: usize) -> usize {
        if self == Appearance::Half { width / 2 } else { 0 }
    }

    pub fn of(model: &Model<f32>, split: Split, fit_half: bool) -> Self {
        let has_codes =
            model.config.field.get::<InstantConfig>().is_some_and(|field| field.appearance_embedding_dim > 0);
        match (fit_half, has_codes || model.config.exposure_model.exposure.is_some()) {
            (true, _) => Appearance::Half,
            (_, false) => Appearance::None,
            (_, true) if split == Split::Train => Appearance::Own,
            (_, true) => Appearance::Mean,
        }
    }
}
