//! Cameras and the rays through their pixels.

use crate::camera::lens::Lens;
use glam::{DAffine3, DVec3};
use serde::{Deserialize, Serialize};

/// A ray: the points `origin + t * direction` with `t >= 0`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// The origin, in scene units.
    pub origin: DVec3,
    /// The direction, of length 1, so that `t` is a distance in scene units.
    pub direction: DVec3,
}

impl Ray {
    /// Returns the point at distance `t`.
    pub fn at(&self, t: f64) -> DVec3 {
        self.origin + t * self.direction
    }
}

/// A camera: image size, intrinsics, lens and pose.
///
/// Axes follow OpenGL and Blender: the camera looks along its `-z`, `+x` points right and `+y` up. Pixel coordinates
/// are continuous, with `(0, 0)` at the upper left corner of the image. So the centre of the pixel in column `i` and
/// row `j` is `(i + 0.5, j + 0.5)`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// Image width in pixels.
    pub width: usize,
    /// Image height in pixels.
    pub height: usize,
    /// Horizontal and vertical focal length in pixels.
    pub focal: [f64; 2],
    /// The principal point in pixels.
    pub centre: [f64; 2],
    /// The lens model with its distortion coefficients.
    pub lens: Lens,
    /// Camera-to-world transform: a rotation and a translation.
    pub pose: DAffine3,
}

impl Camera {
    /// Creates a pinhole camera with square pixels and its principal point at the image centre.
    ///
    /// `angle_x` is the horizontal field of view in radians: `focal = width / (2 tan(angle_x / 2))`.
    pub fn from_angle(width: usize, height: usize, angle_x: f64, pose: DAffine3) -> Self {
        let focal = 0.5 * width as f64 / (0.5 * angle_x).tan();
        let centre = [0.5 * width as f64, 0.5 * height as f64];
        Camera { width, height, focal: [focal; 2], centre, lens: Lens::Pinhole, pose }
    }

    /// Returns the pose at `eye` that looks at `target`, with `up` upwards in the image.
    ///
    /// `up` must not be parallel to the viewing direction.
    pub fn look_at(eye: DVec3, target: DVec3, up: DVec3) -> DAffine3 {
        let back = (eye - target).normalize();
        let right = up.cross(back).normalize();
        DAffine3 { matrix3: glam::DMat3::from_cols(right, back.cross(right), back), translation: eye }
    }

    /// Returns the ray through the continuous pixel position `(x, y)`.
    ///
    /// Where the [lens](Lens) maps no direction to it, the ray has the outermost direction towards there: see
    /// [`sees`](Self::sees).
    pub fn ray(&self, x: f64, y: f64) -> Ray {
        let [x, y] = self.plane(x, y);
        let local = match self.lens {
            Lens::Pinhole => DVec3::new(x, -y, -1.0),
            lens => lens.nearest([x, y]) * DVec3::new(1.0, -1.0, -1.0),
        };
        Ray { origin: self.pose.translation, direction: (self.pose.matrix3 * local).normalize() }
    }

    /// Returns whether the [lens](Lens) maps a direction to the continuous pixel position `(x, y)`.
    pub fn sees(&self, x: f64, y: f64) -> bool {
        self.lens.direction(self.plane(x, y)).is_some()
    }

    /// Projects a point in world coordinates to a continuous pixel position, which may lie outside of the image.
    ///
    /// Returns `None` for points that the lens does not see, such as those behind a pinhole.
    pub fn pixel_of(&self, point: DVec3) -> Option<[f64; 2]> {
        let local = self.pose.matrix3.transpose() * (point - self.pose.translation);
        let [x, y] = self.lens.place(local * DVec3::new(1.0, -1.0, -1.0))?;
        Some([x * self.focal[0] + self.centre[0], y * self.focal[1] + self.centre[1]])
    }

    /// Returns true if a point in world coordinates projects into the image.
    pub(crate) fn shows(&self, point: DVec3) -> bool {
        let [width, height] = [self.width as f64, self.height as f64];
        self.pixel_of(point).is_some_and(|[x, y]| (0.0..width).contains(&x) && (0.0..height).contains(&y))
    }

    /// Directions of rays along the border of the image; where the lens sees none, the outermost direction towards it.
    pub(crate) fn border(&self) -> impl Iterator<Item = DVec3> {
        /// Places along each side.
        const PLACES: usize = 16;
        let [width, height] = [self.width as f64, self.height as f64];
        let shares = (0..=PLACES).map(|i| i as f64 / PLACES as f64);
        let places = shares.flat_map(|share| [[share, 0.0], [share, 1.0], [0.0, share], [1.0, share]]);
        places.map(move |[x, y]| self.ray(x * width, y * height).direction)
    }

    fn plane(&self, x: f64, y: f64) -> [f64; 2] {
        [(x - self.centre[0]) / self.focal[0], (y - self.centre[1]) / self.focal[1]]
    }

    /// Column and row of the pixel with this index, in row-major order.
    pub(crate) fn place_of(&self, pixel: usize) -> [usize; 2] {
        [pixel % self.width, pixel / self.width]
    }

    /// Returns the ray through the centre of the pixel in column `column` and row `row`.
    pub fn pixel_ray(&self, column: usize, row: usize) -> Ray {
        self.ray(column as f64 + 0.5, row as f64 + 0.5)
    }

    /// Returns the squared distance of the centre of pixel `[column, row]` from the principal point.
    ///
    /// The unit is half the image's diagonal, so that corners of a centred image have 1.
    pub fn off_axis(&self, [column, row]: [usize; 2]) -> f64 {
        let [x, y] = [column as f64 + 0.5 - self.centre[0], row as f64 + 0.5 - self.centre[1]];
        let [width, height] = [self.width, self.height].map(|side| 0.5 * side as f64);
        (x * x + y * y) / (width * width + height * height)
    }

    /// Returns the weight of the pixels of a row, 0.001 to 1: for an [equirectangular](Lens::Equirectangular) lens their
    /// solid angle relative to the horizon, the cosine of the latitude; 1 for others.
    pub fn row_weight(&self, row: usize) -> f64 {
        match self.lens {
            // Above 0, so that rejection by weights ends.
            Lens::Equirectangular => self.plane(0.0, row as f64 + 0.5)[1].cos().max(1e-3),
            _ => 1.0,
        }
    }

    /// Returns the same view at another image size.
    pub fn resized(&self, width: usize, height: usize) -> Self {
        let (sx, sy) = (width as f64 / self.width as f64, height as f64 / self.height as f64);
        Camera {
            width,
            height,
            focal: [self.focal[0] * sx, self.focal[1] * sy],
            centre: [self.centre[0] * sx, self.centre[1] * sy],
            ..*self
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn off_axis_distance_is_in_half_diagonals() {
        let camera = Camera::from_angle(30, 20, 0.8, DAffine3::IDENTITY);
        assert!((camera.off_axis([29, 19]) - (14.5 * 14.5 + 9.5 * 9.5) / 325.0).abs() < 1e-12);
        let shifted = Camera { centre: [10.0, 5.0], ..camera };
        assert!((shifted.off_axis([13, 9]) - (3.5 * 3.5 + 4.5 * 4.5) / 325.0).abs() < 1e-12);
        assert_eq!(Camera { centre: [10.5, 5.5], ..shifted }.off_axis([10, 5]), 0.0);
    }
}
