//! Rendering in single precision, as fast as the model allows, or in double precision with nothing left out.

use clap::ValueEnum;
use raygrad::nerf::{Camera, Image, Model, Render, Result};
use serde::Serialize;

/// The arithmetic of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Single precision
    #[default]
    F32,
    /// Double precision, and every sample in an occupied cell: slow, to measure others against
    F64,
}

/// A model in the precision that it is rendered in.
pub enum Renderer {
    /// As trained.
    Single(Box<Model<f32>>),
    /// The same numbers, and all arithmetic on them in f64.
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

    /// Lets views look like the photograph of this number, or like none in particular.
    pub fn look_like(&mut self, number: Option<u32>) {
        match self {
            Renderer::Single(model) => model.appearance_image = number,
            Renderer::Double(model) => model.appearance_image = number,
        }
    }

    /// The view from a camera over a background.
    pub fn view(&self, camera: &Camera, background: [f32; 3]) -> Render {
        match self {
            Renderer::Single(model) => model.render(camera, background),
            Renderer::Double(model) => model.render_reference(camera, background.map(f64::from), 1).picture(),
        }
    }

    /// The normals that are seen from a camera: see [`Model::normals`].
    pub fn normals(&self, camera: &Camera) -> Image {
        match self {
            Renderer::Single(model) => model.normals(camera),
            Renderer::Double(model) => model.normals(camera),
        }
    }
}
