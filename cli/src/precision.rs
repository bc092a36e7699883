//! Rendering in single precision with skipping, or in double precision without skipping.

use clap::ValueEnum;
use raygrad::nerf::{Camera, Image, Model, Render, Result};
use serde::{Deserialize, Serialize};

/// Arithmetic of a render.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Single precision
    #[default]
    F32,
    /// Double precision, and every sample in an occupied cell: slow, to measure others against
    F64,
}

/// A model in the precision of its renders.
pub enum Renderer {
    /// The trained model.
    Single(Box<Model<f32>>),
    /// The same parameters with f64 arithmetic.
    Double(Box<Model<f64>>),
}

impl Renderer {
    /// A renderer for a model.
    pub fn new(model: Model<f32>, precision: Precision) -> Result<Self> {
        Ok(match precision {
            Precision::F32 => Renderer::Single(Box::new(model)),
            Precision::F64 => Renderer::Double(Box::new(model.cast()?)),
        })
    }

    /// Sets the appearance embedding to that of this image, or to none.
    pub fn look_like(&mut self, number: Option<u32>) {
        match self {
            Renderer::Single(model) => model.appearance_image = number,
            Renderer::Double(model) => model.appearance_image = number,
        }
    }

    /// Renders the view of a camera over a background.
    pub fn view(&self, camera: &Camera, background: [f32; 3]) -> Render {
        match self {
            Renderer::Single(model) => model.render(camera, background),
            Renderer::Double(model) => model.render_reference(camera, background.map(f64::from), 1).picture(),
        }
    }

    /// Renders the normals from a camera: see [`Model::normals`].
    pub fn normals(&self, camera: &Camera) -> Image {
        match self {
            Renderer::Single(model) => model.normals(camera),
            Renderer::Double(model) => model.normals(camera),
        }
    }
}
