//! Undistortion: images as a pinhole camera takes them.

use super::capture::View;
use super::image::Image;
use super::image_size::size_for;
use super::load::{WHITE, open};
use super::photo::Photo;
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};
use glam::DVec3;
use std::f64::consts::PI;

/// The widest field of view of the pinhole for a fisheye, in radians: its border pixels are already stretched 2.4
/// times.
const WIDEST: f64 = 100.0 / 180.0 * PI;
/// The tangent of the largest angle to the optical axis in the search.
const FARTHEST: f64 = 8.0;
/// Aspect ratios in the search, in each direction: up to 4 times as narrow or as wide.
const SHAPES: i32 = 16;
/// Points tested along a side of the image.
const PLACES: usize = 64;
/// Bisections of a length, to a thousandth of a pixel.
const HALVINGS: usize = 32;
/// The error up to which a length counts as whole pixels, in pixels.
const ROUNDING: f64 = 1e-4;

impl Camera {
    /// Finds the largest pinhole camera that all of `cameras` cover, so that its images have no empty pixel.
    ///
    /// It has the pose of the first camera, square pixels, a centred principal point, and their (median) focal length.
    /// Its field of view is at most 100 degrees if a lens is a fisheye.
    ///
    /// # Errors
    /// If there is no camera, one is equirectangular, or one does not see its own optical axis.
    pub fn undistorted(cameras: &[&Camera]) -> Result<Camera> {
        let bad = |what: &str| Error::setting("undistort", what);
        let first = cameras.first().ok_or_else(|| bad("needs at least one camera"))?;
        if cameras.iter().any(|camera| camera.lens == Lens::Equirectangular) {
            return Err(bad("cannot turn equirectangular images into one pinhole image; cut them into views first"));
        }
        let mut focals: Vec<f64> = cameras.iter().map(|camera| (camera.focal[0] * camera.focal[1]).sqrt()).collect();
        focals.sort_by(f64::total_cmp);
        let focal = focals[focals.len() / 2];
        let around = |half: [f64; 2]| cameras.iter().all(|camera| sees_all(camera, half));
        let shape = first.width as f64 / first.height as f64;
        let halves = (-SHAPES..=SHAPES).map(|step| {
            let shape = shape * 4.0_f64.powf(f64::from(step) / f64::from(SHAPES));
            let [x, y] = [shape.sqrt(), shape.sqrt().recip()];
            let scale = last(0.0, |scale| around([scale * x, scale * y]));
            [scale * x, scale * y]
        });
        let best = halves.max_by(|a, b| (a[0] * a[1]).total_cmp(&(b[0] * b[1]))).unwrap_or_default();
        // The best ratio is one of a few, so both sides are grown as far as possible.
        let x = last(best[0], |x| around([x, best[1]]));
        let best = [x, last(best[1], |y| around([x, y]))];
        let [width, height] = best.map(|half| (2.0 * half * focal + ROUNDING) as usize);
        if width == 0 || height == 0 {
            return Err(bad("needs cameras that see their optical axis; check the principal points and lenses"));
        }
        let centre = [0.5 * width as f64, 0.5 * height as f64];
        Ok(Camera { width, height, focal: [focal; 2], centre, lens: Lens::Pinhole, pose: first.pose })
    }
}

/// The largest number for which `good` holds, if it holds for all smaller ones from `low` on.
fn last(mut low: f64, good: impl Fn(f64) -> bool) -> f64 {
    let mut high = FARTHEST.max(low);
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if good(middle) { low = middle } else { high = middle }
    }
    low
}

/// Returns true if a camera sees the rectangle of directions with these half sides. The visible region has no holes, so
/// the border is enough.
fn sees_all(camera: &Camera, [x, y]: [f64; 2]) -> bool {
    let most = match camera.lens {
        Lens::Fisheye { .. } | Lens::Fov { .. } => (0.5 * WIDEST).tan(),
        _ => FARTHEST,
    };
    let [width, height] = [camera.width as f64, camera.height as f64];
    let sees = |a: f64, b: f64| {
        camera.lens.place(DVec3::new(a, b, 1.0)).is_some_and(|place| {
            let [u, v] = [0, 1].map(|axis| place[axis] * camera.focal[axis] + camera.centre[axis]);
            (0.0..=width).contains(&u) && (0.0..=height).contains(&v)
        })
    };
    let along = |i: usize| 2.0 * i as f64 / PLACES as f64 - 1.0;
    let seen = |i: usize| {
        let t = along(i);
        [(t * x, -y), (t * x, y), (-x, t * y), (x, t * y)].into_iter().all(|(a, b)| sees(a, b))
    };
    // The corners fail first.
    x <= most && y <= most && seen(0) && (0..=PLACES).all(seen)
}

impl View {
    /// Returns the camera scaled to the size of the image file, which may differ from the size in the capture.
    ///
    /// # Errors
    /// If there is no image, its header cannot be read, or it has another aspect ratio than the camera.
    pub fn camera_of_image(&self) -> Result<Camera> {
        let Some(image) = &self.image else { return Err(Error::file(&self.name, "does not exist")) };
        let [width, height] = size_for(image, &self.camera)?;
        Ok(self.camera.resized(width, height))
    }

    /// Resamples the image as the camera `to` sees it from the same pose, with its mask (1 where pixels are used).
    ///
    /// # Errors
    /// If an image cannot be read or decoded, or has another aspect ratio than the camera.
    pub fn seen_by(&self, to: &Camera) -> Result<(Photo, Option<Image>)> {
        let Some(image) = &self.image else { return Err(Error::file(&self.name, "does not exist")) };
        let size = [to.width, to.height];
        let moved = |photo: &Photo| {
            let from = self.camera.resized(photo.width, photo.height);
            photo.resampled(size, |pixel| place(to, &from, pixel))
        };
        let photo = moved(&open(image, &self.camera)?);
        let mask = match &self.mask {
            Some(path) => self.mask_photo(Some(size_for(path, &self.camera)?))?,
            None => None,
        };
        let Some(mask) = mask.map(|mask| moved(&mask)) else { return Ok((photo, None)) };
        let data = mask.pixels().map(|pixel| f32::from(u8::from(pixel[0] >= WHITE))).collect();
        Ok((photo, Some(Image { width: size[0], height: size[1], channels: 1, data })))
    }
}

/// The position in the camera `from` of a pixel of the pinhole camera `to`.
fn place(to: &Camera, from: &Camera, pixel: [f64; 2]) -> [f64; 2] {
    let [x, y] = [0, 1].map(|axis| (pixel[axis] - to.centre[axis]) / to.focal[axis]);
    // Positions beside the image are used only for the spacing of pixels; the lens may have none there.
    let place = from.lens.place(DVec3::new(x, y, 1.0)).unwrap_or([f64::NAN; 2]);
    [0, 1].map(|axis| place[axis] * from.focal[axis] + from.centre[axis])
}

#[cfg(test)]
mod tests;
