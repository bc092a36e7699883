//! What is not the model's fault: where the cameras of photographs are, and how these were exposed.

use raygrad::nerf::dataset::{Dataset, Split};
use raygrad::nerf::{Error, InstantConfig, Model, Result};
use serde::Serialize;

/// From where views are rendered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub enum Alignment {
    /// From where the scene has its cameras: the model has learned nothing of them.
    #[serde(rename = "none")]
    None,
    /// From where the model has found the cameras of its photographs to be.
    #[serde(rename = "as learned")]
    Learned,
    /// Focal length and lens are those that were found; poses are the scene's.
    #[serde(rename = "focal length and lens as learned")]
    Glass,
    /// As well, and poses moved by the similarity that takes the training cameras from where they were given to where they
    /// were found.
    #[serde(rename = "similarity of the training cameras")]
    Similarity,
    /// From where the model shows each most nearly, found from where one of the above has them.
    #[serde(rename = "each fitted to its own photograph")]
    Fitted,
}

impl Alignment {
    /// Puts the cameras of the photographs where the model has them.
    ///
    /// # Errors
    /// If a photograph is said to be one of those that were trained on, whose names are `trained`, and is not.
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

/// What is done about what photographs differ in and nobody knows of one that was held out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub enum Appearance {
    /// Nothing: the model takes all photographs to be alike.
    #[serde(rename = "none")]
    None,
    /// Views have the mean of what was learned of the photographs that were trained on: of their codes, and of their exposures.
    #[serde(rename = "mean of the training photographs")]
    Mean,
    /// Views have what was learned of the photograph itself: it was trained on.
    #[serde(rename = "each photograph's own")]
    Own,
    /// As the mean, and a gain for each channel makes the left half most like the photograph's; the right half is compared.
    #[serde(rename = "gains fitted to the left half, right half compared")]
    Half,
}

impl Appearance {
    /// How many columns on the left of an image are not compared.
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
