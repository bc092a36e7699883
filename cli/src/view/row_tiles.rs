//! Rendering in tiles of rows.

use std::sync::Arc;
use std::time::Duration;

use raygrad::nerf::dataset::{Photo, SceneTransform};
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::space::occupancy::Skip;
use raygrad::nerf::{Camera, Image, Model, RayTolerance, Render, RenderOptions};

use super::messages::{View, at_size};
use crate::output::depth_colors;
use crate::render::shown::{Show, facing, over};

/// Time limit of a tile, in seconds.
const PIECE: f64 = 0.08;
/// Renders with more pixels are large.
pub const LARGE: usize = 1 << 20;

/// A render in progress, in tiles of rows.
pub struct RowTiles {
    pub camera: Camera,
    /// The compared image at the render's size.
    pub truth: Option<(usize, Image)>,
    pub color: Image,
    pub rows: usize,
    /// Rows per tile; 0 before the first tile.
    band: usize,
}

impl RowTiles {
    /// Starts a render. With an image's camera, the render keeps the image's aspect ratio. `truth` is the compared
    /// image, if any.
    pub fn new(
        camera: Camera,
        is_photograph: bool,
        size: [usize; 2],
        truth: Option<(usize, Arc<Photo>)>,
        model: &Model<f32>,
    ) -> Self {
        let sides = [camera.width, camera.height];
        // The whole image is visible. Compared images are not enlarged.
        let largest = truth.as_ref().map_or(size, |(_, photo)| [photo.width.min(size[0]), photo.height.min(size[1])]);
        let share = (0..2).map(|i| largest[i] as f64 / sides[i] as f64).fold(f64::INFINITY, f64::min);
        let [width, height] = [0, 1].map(|i| ((sides[i] as f64 * share).round() as usize).clamp(1, largest[i]));
        let camera = if is_photograph { camera.resized(width, height) } else { camera };
        let background = model.config.background.shown();
        let truth = truth.map(|(number, photo)| (number, at_size(&photo, [width, height], background)));
        RowTiles { color: Image::new(camera.width, camera.height, 3), camera, truth, rows: 0, band: 0 }
    }

    /// Number of rays so far, including the current tile.
    pub fn asked(&self) -> usize {
        self.camera.width * (self.rows + self.band).min(self.camera.height)
    }

    pub fn is_whole(&self) -> bool {
        self.rows == self.camera.height
    }

    pub fn is_large(&self) -> bool {
        self.camera.width * self.camera.height > LARGE
    }

    /// Renders as many rows as the time limit allows; `None` if it was cancelled.
    pub fn paint(
        &mut self,
        view: &View,
        model: &Model<f32>,
        rate: f64,
        goes_on: &(dyn Fn() -> bool + Sync),
    ) -> Option<()> {
        let Camera { width, height, centre, .. } = self.camera;
        if self.band == 0 {
            self.band = rows_in(PIECE, rate, width);
        }
        self.band = self.band.clamp(1, height);
        let rows = self.band.min(height - self.rows);
        // Moves the principal point, so that the camera starts at this row.
        let band = Camera { height: rows, centre: [centre[0], centre[1] - self.rows as f64], ..self.camera.clone() };
        let background = match view.background {
            Some(color) => color.map(|value| f32::from(value) / 255.0),
            None => model.config.background.shown(),
        };
        // Comparisons use the background of evaluation.
        let background = if self.truth.is_some() { model.config.background.shown() } else { background };
        // Comparisons show the whole scene.
        let crop = view.crop.filter(|_| self.truth.is_none());
        let crop = crop.map_or(RenderOptions::over(background).crop, |corners| corners.map(DVec3::from));
        // Models from the cache already have their skipping. This override disables it for other models too.
        let limits = (view.skip == Some(Skip::Off)).then_some(RayTolerance::NONE);
        let viewing = RenderOptions { background, tolerance: limits, crop, keep_going: goes_on };
        let picture = model.render_cancellable(&band, &viewing)?;
        let image = match view.show {
            Show::Color => picture.color,
            Show::Depth => depth_colors(&picture, model.scene_box.near_far),
            Show::Opacity => grey(&picture),
            Show::Normals => normals(model, &band, &viewing, &picture, &model.scene_box.transform)?,
        };
        let start = 3 * width * self.rows;
        self.color.data[start..start + image.data.len()].copy_from_slice(&image.data);
        self.rows += rows;
        Some(())
    }

    /// Sets the rows of the next tile from the time of the last one. It grows at most twofold, as later rows may be
    /// slower.
    pub fn lr_scale(&mut self, spent: Duration) {
        let fitting = self.band as f64 * PIECE / spent.as_secs_f64().max(1e-4);
        self.band = (fitting as usize).clamp(1, 2 * self.band);
    }
}

/// Opacity as a grey image.
fn grey(picture: &Render) -> Image {
    let Image { width, height, ref data, .. } = picture.opacity;
    Image { width, height, channels: 3, data: data.iter().flat_map(|x| [*x; 3]).collect() }
}

fn normals(
    model: &Model<f32>,
    camera: &Camera,
    viewing: &RenderOptions<'_>,
    picture: &Render,
    transform: &SceneTransform,
) -> Option<Image> {
    let colors = facing(model.normals_cancellable(camera, viewing)?, transform);
    Some(over(&colors, &picture.opacity, viewing.background))
}

/// Number of rows of this width that fit into the time.
fn rows_in(seconds: f64, rate: f64, width: usize) -> usize {
    (rate * seconds / width as f64) as usize
}

#[cfg(test)]
pub mod tests {
    use raygrad::nerf::glam::DAffine3;
    use raygrad::nerf::sampling::marching::MarchingConfig;
    use raygrad::nerf::{Config, InstantConfig, Preset, SceneBox};
    use serde_json::json;

    use super::*;
    use crate::view::messages::Eye;

    /// A free view from this x coordinate towards the scene.
    pub fn free(x: f64, size: [u32; 2]) -> View {
        let pose = [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0]];
        serde_json::from_value(json!({ "eye": { "free": { "pose": pose, "fov": 50.0 } }, "size": size })).unwrap()
    }

    /// A small untrained model, dense enough that skipping is visible.
    pub fn fog() -> Model<f32> {
        let mut config = Config::preset(Preset::Instant);
        config.sampler.get_mut::<MarchingConfig>().unwrap().occupancy.resolution = 16;
        config.field.get_mut::<InstantConfig>().unwrap().grid.log2_table = 6;
        let extent = SceneBox { unit: 0.02, ..SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [0.1, 9.0]) };
        Model::new(config, extent, 0).unwrap()
    }

    #[test]
    fn first_tile_fits_the_time() {
        let model = fog();
        let painted = |view: &View, rate: f64| {
            let Eye::Free { pose, fov } = &view.eye else { panic!() };
            let camera = View::camera(pose, *fov, view.size.map(|side| side as usize));
            let mut parts = RowTiles::new(camera, false, view.size.map(|side| side as usize), None, &model);
            parts.paint(view, &model, rate, &|| true).unwrap();
            parts
        };
        let view = free(0.0, [64, 48]);
        let parts = painted(&view, 12_800.0);
        assert_eq!((parts.rows, parts.asked(), parts.is_whole()), (16, 64 * 32, false));
        let whole = painted(&view, 1e9);
        assert_eq!((whole.rows, whole.asked(), whole.is_whole()), (48, 64 * 48, true));
        assert_eq!(parts.color.data[..3 * 64 * 16], whole.color.data[..3 * 64 * 16], "the upper rows of the same");
        // With skipping disabled.
        let seen = |view: &View| painted(view, 1e9).color;
        let (usual, all) =
            (model.render(&whole.camera, [1.0; 3]), model.render_within(&whole.camera, [1.0; 3], &RayTolerance::NONE));
        assert!(usual.color == seen(&view) && all.color == seen(&View { skip: Some(Skip::Off), ..view.clone() }));
        assert!(usual.color != all.color, "the test is of what differs");
        let nothing = View { crop: Some([[5.0; 3], [6.0; 3]]), background: Some([255, 51, 0]), ..view };
        assert_eq!(seen(&nothing).data[..3], [1.0, 0.2, 0.0]);
    }

    #[test]
    fn next_tile_adapts_to_the_time() {
        assert_eq!([rows_in(0.08, 1e5, 800), rows_in(0.08, 1e3, 800), rows_in(0.5, 1e5, 100)], [10, 0, 500]);
        let camera = Camera::from_angle(64, 64, 1.0, DAffine3::IDENTITY);
        let paced = |milliseconds: u64| {
            let color = Image::new(1, 1, 3);
            let mut parts = RowTiles { camera: camera.clone(), truth: None, color, rows: 0, band: 8 };
            parts.lr_scale(Duration::from_millis(milliseconds));
            parts.band
        };
        // At most twice as many rows, half as many after a tile of twice the time, and at least one.
        assert_eq!([paced(1), paced(80), paced(160), paced(10_000)], [16, 8, 4, 1]);
    }

    #[test]
    fn render_over_a_megapixel_is_large() {
        let is_large = |width: usize, height: usize| {
            let (camera, color) = (Camera::from_angle(width, height, 1.0, DAffine3::IDENTITY), Image::new(1, 1, 3));
            RowTiles { camera, truth: None, color, rows: 0, band: 0 }.is_large()
        };
        assert_eq!([is_large(1024, 1024), is_large(1025, 1024), is_large(4096, 200)], [false, true, false]);
    }
}
