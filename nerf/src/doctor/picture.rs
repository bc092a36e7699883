//! A small grey pinhole image, undistorted from any lens.

use crate::camera::{Camera, Lens};
use crate::dataset::load::WHITE;
use crate::dataset::{Image, Photo};

/// Half of the width of a patch, in pixels.
pub(super) const HALF: i32 = 3;
/// Pixels in a patch.
pub(super) const PATCH: usize = SIDE * SIDE;
/// The width of a patch, in pixels.
const SIDE: usize = 2 * HALF as usize + 1;
/// The side of the squares that give at most one patch each.
const CELL: usize = 16;
/// The most patches of an image.
const PATCHES: usize = 36;
/// The least contrast of a patch: the root mean square of its gradient in the weakest direction.
const CONTRAST: f32 = 0.02;

/// The colour behind transparent pixels.
const BEHIND: [f32; 3] = [0.5; 3];

/// A grey image of a pinhole camera, in image axes: x right, y down, z ahead.
pub(super) struct Picture {
    pub width: usize,
    pub height: usize,
    pub focal: [f64; 2],
    pub centre: [f64; 2],
    /// Row-major; NaN for unknown pixels.
    values: Vec<f32>,
    /// Positions of corners.
    pub corners: Vec<[f64; 2]>,
}

/// A patch of mean 0 and length 1.
pub(super) type Patch = [f32; PATCH];

impl Picture {
    /// Undistorts a small image; `None` if its lens is equirectangular.
    pub fn new(camera: &Camera, photo: &Photo, mask: Option<&Photo>) -> Option<Picture> {
        let camera = camera.resized(photo.width, photo.height);
        if camera.lens == Lens::Equirectangular || !(camera.focal[0] > 0.0 && camera.focal[1] > 0.0) {
            return None;
        }
        let Camera { width, height, focal, centre, lens, .. } = camera;
        let mut image = grey(photo, BEHIND);
        if let Some(mask) = mask {
            hide(&mut image, mask);
        }
        let mut picture = Picture { width, height, focal, centre, values: image.data, corners: vec![] };
        if lens != Lens::Pinhole {
            let pixels = (0..width * height).map(|i| {
                let [x, y] = [(i % width) as f64 + 0.5, (i / width) as f64 + 0.5];
                let direction = glam::DVec3::new((x - centre[0]) / focal[0], (y - centre[1]) / focal[1], 1.0);
                let place = lens.place(direction);
                place.map_or(f32::NAN, |[x, y]| {
                    picture.at((x * focal[0] + centre[0]) as f32, (y * focal[1] + centre[1]) as f32)
                })
            });
            picture.values = pixels.collect();
        }
        picture.corners = picture.find_corners();
        Some(picture)
    }

    /// The value at a place, between pixels; NaN outside.
    fn at(&self, x: f32, y: f32) -> f32 {
        let [x, y] = [x - 0.5, y - 0.5];
        if !(x >= 0.0 && y >= 0.0 && x < (self.width - 1) as f32 && y < (self.height - 1) as f32) {
            return f32::NAN;
        }
        let (column, row) = (x as i32 as usize, y as i32 as usize);
        self.between([column, row], [x - column as f32, y - row as f32])
    }

    /// The patch around a place whose columns and rows step by these vectors; `None` where something is not known or
    /// there is no contrast.
    pub fn patch(&self, place: [f64; 2], steps: [[f64; 2]; 2]) -> Option<Patch> {
        let (mut patch, mean, length) = self.values_around(place, steps)?;
        patch.iter_mut().for_each(|value| *value = (*value - mean) / length);
        Some(patch)
    }

    /// The normalised cross-correlation of a patch with the one here; `None` where [`patch`](Self::patch) is.
    pub fn correlation(&self, with: &Patch, place: [f64; 2], steps: [[f64; 2]; 2]) -> Option<f32> {
        let (values, _, length) = self.values_around(place, steps)?;
        // The mean of `with` is 0, so that of the values does not count.
        Some(with.iter().zip(&values).map(|(x, y)| x * y).sum::<f32>() / length)
    }

    /// The values of a patch, their mean, and the length of their differences from it.
    fn values_around(&self, place: [f64; 2], [across, down]: [[f64; 2]; 2]) -> Option<([f32; PATCH], f32, f32)> {
        let [[x, y], across, down] = [place, across, down].map(|vector| vector.map(|x| x as f32));
        let [x, y] = [x - 0.5, y - 0.5];
        let reach = |axis: usize| HALF as f32 * (across[axis].abs() + down[axis].abs());
        let fits = |x: f32, reach: f32, extent: usize| x - reach >= 0.0 && x + reach < extent as f32 - 1.0;
        if !(fits(x, reach(0), self.width) && fits(y, reach(1), self.height)) {
            return None;
        }
        // Rounding may lead one pixel too far.
        let [last_column, last_row] = [self.width - 2, self.height - 2];
        let mut patch = [0.0; PATCH];
        let mut sum = 0.0;
        for (row, v) in patch.chunks_exact_mut(SIDE).zip(-HALF..) {
            let [x, y] = [x + v as f32 * down[0], y + v as f32 * down[1]];
            for (value, u) in row.iter_mut().zip(-HALF..) {
                let [x, y] = [x + u as f32 * across[0], y + u as f32 * across[1]];
                // The conversion to i32 is one instruction.
                let (column, row) = ((x as i32 as usize).min(last_column), (y as i32 as usize).min(last_row));
                *value = self.between([column, row], [x - column as f32, y - row as f32]);
                sum += *value;
            }
        }
        // One NaN makes the sum NaN.
        let mean = sum / PATCH as f32;
        let length = patch.iter().map(|value| (value - mean) * (value - mean)).sum::<f32>().sqrt();
        (length > 0.005 * (PATCH as f32).sqrt()).then_some((patch, mean, length))
    }

    /// The value at a share of the way from a pixel to the next ones.
    #[inline(always)]
    fn between(&self, [column, row]: [usize; 2], [s, t]: [f32; 2]) -> f32 {
        let start = row * self.width + column;
        let [a, b] = [self.values[start], self.values[start + 1]];
        let [c, d] = [self.values[start + self.width], self.values[start + self.width + 1]];
        let (above, below) = (a + s * (b - a), c + s * (d - c));
        above + t * (below - above)
    }

    /// Corners (Shi and Tomasi 1994): in each cell the position with the largest change under a shift in its weakest
    /// direction, the best first.
    fn find_corners(&self) -> Vec<[f64; 2]> {
        let border = HALF as usize + 2;
        if self.width <= 2 * border + 1 || self.height <= 2 * border + 1 {
            return vec![];
        }
        let value = |x: usize, y: usize| self.values[y * self.width + x];
        let tensor = |x: usize, y: usize| {
            let mut sums = [0.0_f32; 3];
            for (u, v) in (y - 2..=y + 2).flat_map(|v| (x - 2..=x + 2).map(move |u| (u, v))) {
                let [across, down] = [value(u + 1, v) - value(u - 1, v), value(u, v + 1) - value(u, v - 1)];
                sums = [sums[0] + across * across, sums[1] + across * down, sums[2] + down * down];
            }
            let [a, b, c] = sums.map(|sum| sum / (4.0 * 25.0));
            0.5 * (a + c) - (0.25 * (a - c) * (a - c) + b * b).sqrt()
        };
        let mut best: Vec<(f32, [f64; 2])> = vec![];
        for top in (border..self.height - border).step_by(CELL) {
            for left in (border..self.width - border).step_by(CELL) {
                let rows = top..(top + CELL).min(self.height - border);
                let places = rows.flat_map(|y| (left..(left + CELL).min(self.width - border)).map(move |x| (x, y)));
                let strengths = places.map(|(x, y)| (tensor(x, y), [x as f64 + 0.5, y as f64 + 0.5]));
                let strong = strengths.filter(|(strength, _)| *strength > CONTRAST * CONTRAST);
                best.extend(strong.max_by(|a, b| a.0.total_cmp(&b.0)));
            }
        }
        best.sort_by(|a, b| b.0.total_cmp(&a.0));
        best.into_iter().take(PATCHES).map(|(_, place)| place).collect()
    }
}

/// Brightness, one value per pixel, in the file's transfer curve, which is perceptually even.
pub(super) fn grey(photo: &Photo, behind: [f32; 3]) -> Image {
    let image = photo.over(behind);
    let data = image.data.chunks_exact(3).map(|rgb| 0.299 * rgb[0] + 0.587 * rgb[1] + 0.114 * rgb[2]).collect();
    Image { channels: 1, data, ..image }
}

/// Returns true for white pixels of a mask.
pub(super) fn is_used(pixel: [f32; 4]) -> bool {
    pixel[0] >= WHITE
}

/// Sets pixels that a mask does not use to unknown.
pub(super) fn hide(image: &mut Image, mask: &Photo) {
    let Image { width, height, .. } = *image;
    for (i, value) in image.data.iter_mut().enumerate() {
        let [column, row] = [i % width * mask.width / width, i / width * mask.height / height];
        if !is_used(mask.pixel(column, row)) {
            *value = f32::NAN;
        }
    }
}
