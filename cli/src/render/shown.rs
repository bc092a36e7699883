//! Outputs of a render: the displayed quantity and its layers.

use clap::ValueEnum;
use raygrad::nerf::dataset::{Depths, SceneTransform};
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::{Camera, Image, Render, SceneBox};
use serde::{Deserialize, Serialize};

use crate::output::depth_colors;
use crate::precision::Renderer;

/// Displayed quantity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Show {
    /// What a photograph would
    #[default]
    Color,
    /// Depth in false colour: yellow near, violet far, black where there is nothing
    Depth,
    /// Which way surfaces face: red, green and blue for x, y and z in the capture's axes, from -1 to 1
    Normals,
    /// How much light is blocked: white for all of it
    Opacity,
}

/// Layer files of each frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Layer {
    /// Depth along the optical axis: depth/NUMBER.png, 16 bits in steps of --depth-unit, 0 where there is nothing
    Depth,
    /// The same in the capture's units: depth/NUMBER.npy, f32 [height, width]
    DepthNpy,
    /// normals/NUMBER.png: 0.5 + 0.5 n in the capture's axes, black where there is nothing
    Normals,
    /// opacity/NUMBER.png, grey
    Opacity,
    /// alpha/NUMBER.png: RGBA without the background, colours not multiplied by alpha
    Alpha,
}

impl Layer {
    /// Folder and extension of the files.
    pub fn place(self) -> (&'static str, &'static str) {
        match self {
            Layer::Depth => ("depth", "png"),
            Layer::DepthNpy => ("depth", "npy"),
            Layer::Normals => ("normals", "png"),
            Layer::Opacity => ("opacity", "png"),
            Layer::Alpha => ("alpha", "png"),
        }
    }
}

/// Below this opacity, a pixel has no depth and no normal.
const SOLID: f32 = 0.5;

/// Settings of the frames.
pub struct Shown<'a> {
    pub renderer: &'a Renderer,
    /// Scene box, with the scene transform.
    pub extent: SceneBox,
    pub background: [f32; 3],
    pub show: Show,
    pub save: &'a [Layer],
    /// Step of 16-bit depths, in capture units.
    pub depth_unit: f64,
}

/// A rendered frame.
pub struct Frame {
    /// The displayed image.
    pub image: Image,
    /// Contents of the layer files.
    pub layers: Vec<(Layer, Vec<u8>)>,
    /// Number of depths that exceed 16 bits.
    pub beyond: usize,
}

impl Shown<'_> {
    /// Renders the frame of a camera.
    pub fn frame(&self, camera: &Camera) -> Frame {
        let picture = self.renderer.view(camera, self.background);
        let faces = self.show == Show::Normals || self.save.contains(&Layer::Normals);
        let normals = faces.then(|| self.normals(camera));
        let mut beyond = 0;
        let mut contents = |layer: Layer| match layer {
            Layer::Depth => {
                let (png, count) = self.depths(&picture, camera).to_png(self.depth_unit);
                beyond = count;
                png
            }
            Layer::DepthNpy => self.depths(&picture, camera).to_npy(),
            Layer::Normals => normals.as_ref().map_or(vec![], |of| solid(of, &picture).to_png()),
            Layer::Opacity => picture.opacity.to_png(),
            Layer::Alpha => picture.rgba(self.background).to_png(),
        };
        let layers = self.save.iter().map(|&layer| (layer, contents(layer))).collect();
        let image = match (self.show, normals) {
            (Show::Depth, _) => depth_colors(&picture, self.extent.near_far),
            (Show::Normals, Some(normals)) => over(&normals, &picture.opacity, self.background),
            (Show::Opacity, _) => picture.opacity,
            (Show::Color | Show::Normals, _) => picture.color,
        };
        Frame { image, layers, beyond }
    }

    fn normals(&self, camera: &Camera) -> Image {
        facing(self.renderer.normals(camera), &self.extent.transform)
    }

    fn depths(&self, picture: &Render, camera: &Camera) -> Depths {
        depths(picture, camera, &self.extent.transform)
    }
}

/// Unit normals as colours, in the capture's axes.
pub fn facing(mut normals: Image, transform: &SceneTransform) -> Image {
    let back = transform.rotation.transpose();
    for pixel in normals.data.chunks_exact_mut(3) {
        let normal = DVec3::new(pixel[0].into(), pixel[1].into(), pixel[2].into());
        let color = 0.5 + 0.5 * (back * normal).normalize_or_zero();
        pixel.copy_from_slice(&color.as_vec3().to_array());
    }
    normals
}

/// Depths of opaque pixels in capture units.
fn depths(picture: &Render, camera: &Camera, transform: &SceneTransform) -> Depths {
    Depths::new(&solid(&picture.depth, picture), camera, transform.scale.recip())
}

/// The image, with 0 where pixels are not opaque.
fn solid(image: &Image, picture: &Render) -> Image {
    let mut image = image.clone();
    for (pixel, opacity) in image.data.chunks_exact_mut(image.channels).zip(&picture.opacity.data) {
        if !(*opacity >= SOLID) {
            pixel.fill(0.0);
        }
    }
    image
}

/// Colours over a background, weighted by the opacity.
pub fn over(colors: &Image, opacity: &Image, background: [f32; 3]) -> Image {
    let mut image = colors.clone();
    for (pixel, opacity) in image.data.chunks_exact_mut(3).zip(&opacity.data) {
        pixel.iter_mut().zip(background).for_each(|(value, behind)| *value = behind + opacity * (*value - behind));
    }
    image
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::Evaluations;
    use raygrad::nerf::glam::{DAffine3, DMat3};

    fn image(channels: usize, data: &[f32]) -> Image {
        Image { width: data.len() / channels, height: 1, channels, data: data.to_vec() }
    }

    #[test]
    fn normals_and_depths_use_capture_units() {
        // The capture's x, y and z axes are the scene's y, z and x axes, with scale 2.
        let rotation = DMat3::from_cols(DVec3::Y, DVec3::Z, DVec3::X);
        let transform = SceneTransform { rotation, scale: 2.0, origin: DVec3::ONE };
        let colors = facing(image(3, &[0.0, 0.7, 0.0, 0.0, 0.0, -0.3, 0.0, 0.0, 0.0]), &transform);
        assert_eq!(colors.data, [1.0, 0.5, 0.5, 0.5, 0.0, 0.5, 0.5, 0.5, 0.5]);
        let picture = Render {
            color: image(3, &[0.0; 9]),
            depth: image(1, &[6.0, 6.0, 6.0]),
            opacity: image(1, &[0.49, 0.5, 1.0]),
            evaluations: Evaluations::default(),
        };
        let camera = Camera::from_angle(3, 1, 1e-6, DAffine3::IDENTITY);
        let npy = depths(&picture, &camera, &transform).to_npy();
        let found = npy[npy.len() - 12..].chunks_exact(4).map(|x| f32::from_le_bytes(x.try_into().unwrap()));
        assert_eq!(found.collect::<Vec<_>>(), [0.0, 3.0, 3.0], "of what is solid, in the capture's units");
    }

    #[test]
    fn frame_colours_blend_over_background() {
        let seen = over(&image(3, &[1.0, 0.0, 0.5, 1.0, 0.0, 0.5]), &image(1, &[0.25, 1.0]), [0.0, 1.0, 0.5]);
        assert_eq!(seen.data, [0.25, 0.75, 0.5, 1.0, 0.0, 0.5]);
    }
}
