//! The scene's box, near and far plane, and transform.

use crate::camera::Ndc;
use crate::dataset::SceneTransform;
use crate::error::{Error, Result};
use crate::space::cube::Space;
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// The scene box with near and far plane, number of images and scene transform; stored with the model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneBox {
    /// Lower and upper corner of the scene box. Unit: scene units.
    pub bounds: [DVec3; 2],
    /// Distances from the camera between which rays are sampled. Unit: scene units. Range: 0 <= near < far.
    #[serde(alias = "span")]
    pub near_far: [f64; 2],
    /// Length by which the field measures densities: a density of 1 means 1 / `unit`. See [`Space::unit`]. Unit:
    /// scene units. Range: more than 0.
    #[serde(default = "crate::range::one")]
    pub unit: f64,
    /// Number of training images; 0 if unknown.
    #[serde(default)]
    pub frames: usize,
    /// Scene transform, from the coordinates of the capture to those of the scene.
    #[serde(default)]
    #[serde(alias = "placement")]
    pub transform: SceneTransform,
    /// Normalised device coordinates of a forward-facing scene; null for other scenes. See [`Space::ndc`].
    #[serde(default)]
    pub ndc: Option<Ndc>,
}

impl SceneBox {
    /// Creates a scene box with a third of its longest side as unit, without images, transform or NDC.
    pub fn new(bounds: [DVec3; 2], span: [f64; 2]) -> Self {
        SceneBox {
            bounds,
            near_far: span,
            unit: Space::within(bounds).unit,
            frames: 0,
            transform: SceneTransform::default(),
            ndc: None,
        }
    }

    /// Checks that near and far are in range, and that the transform is a similarity. [`Space::check`] checks the rest.
    ///
    /// # Errors
    /// If they are not.
    pub fn check(&self) -> Result<()> {
        let [near, far] = self.near_far;
        self.transform.check()?;
        if near >= 0.0 && near < far && far.is_finite() {
            return Ok(());
        }
        let what = format!("is {near} to {far}; near must be at least 0 and less than far, and far finite");
        Err(Error::setting("scene_box.near_far", what))
    }

    /// Returns whether a point (scene units) is inside the box, faces included.
    pub fn contains(&self, place: DVec3) -> bool {
        let [low, high] = self.bounds;
        place.cmpge(low).all() && place.cmple(high).all()
    }

    /// Returns the map to the unit cube of a bounded scene; [`Model::space`](crate::Model::space) contracts unbounded
    /// ones.
    pub fn space(&self) -> Space {
        Space { unit: self.unit, ndc: self.ndc, ..Space::within(self.bounds) }
    }
}
