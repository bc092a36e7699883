//! Resampling of images to another pixel grid.

use super::{Photo, Values};
use crate::dataset::average::Stored;

/// The width of a new pixel, in pixels of the image, above which it is averaged over several points. A little above 1,
/// since smaller widths do not alias and an average would only blur.
const COVERED: f64 = 1.25;
/// The most points per row and column of a new pixel.
const MOST_PLACES: usize = 16;

impl Photo {
    /// Resamples to another pixel grid; `from` maps each continuous position in the new image to one in this image.
    ///
    /// Values are interpolated by cubic splines (Catmull and Rom 1974). A new pixel that covers several is the average
    /// over as many places. Outside of the image the border repeats. Colours are weighted by alpha.
    ///
    /// # Panics
    /// If a side is 0.
    #[track_caller]
    pub fn resampled(&self, [width, height]: [usize; 2], from: impl Fn([f64; 2]) -> [f64; 2]) -> Photo {
        assert!(width > 0 && height > 0, "both sides must be at least 1, are {width}x{height}");
        let places = places([width, height], from);
        let values = match &self.values {
            Values::Bytes(values) => Values::Bytes(self.at(values, places)),
            Values::Words(values) => Values::Words(self.at(values, places)),
            Values::Floats(values) => Values::Floats(self.at(values, places)),
        };
        Photo { width, height, channels: self.channels, values }
    }

    fn at<S: Stored>(&self, values: &[S], places: impl Iterator<Item = Place>) -> Vec<S> {
        let mut out = vec![];
        for Place { middle, across, down } in places {
            let count = |step: [f64; 2]| {
                let covered = step[0].hypot(step[1]) - (COVERED - 1.0);
                // The steps are not finite where the lens has no image; one point is enough there.
                (covered.ceil() as usize).clamp(1, MOST_PLACES)
            };
            let counts = [count(across), count(down)];
            let offset = |i: usize, count: usize| (i as f64 + 0.5) / count as f64 - 0.5;
            let mut sum = Sum::default();
            for j in 0..counts[1] {
                for i in 0..counts[0] {
                    let (s, t) = (offset(i, counts[0]), offset(j, counts[1]));
                    let place = [0, 1].map(|axis| middle[axis] + s * across[axis] + t * down[axis]);
                    sum.add(values, self.channels, [self.width, self.height], place);
                }
            }
            sum.finish(self.channels, &mut out);
        }
        out
    }
}

/// The position of a new pixel in the image: its centre, and the steps to the next pixel across and down.
struct Place {
    middle: [f64; 2],
    across: [f64; 2],
    down: [f64; 2],
}

/// The positions of all pixels, row-major. `from` is evaluated once per pixel: steps are differences of neighbours.
fn places([width, height]: [usize; 2], from: impl Fn([f64; 2]) -> [f64; 2]) -> impl Iterator<Item = Place> {
    // From one before the first pixel to one after the last.
    let row = move |y: f64| -> Vec<[f64; 2]> { (0..width + 2).map(|x| from([x as f64 - 0.5, y])).collect() };
    let mut rows = [vec![], row(-0.5), row(0.5)];
    (0..height).flat_map(move |y| {
        rows.rotate_left(1);
        rows[2] = row(y as f64 + 1.5);
        let half = |a: [f64; 2], b: [f64; 2]| [0.5 * (b[0] - a[0]), 0.5 * (b[1] - a[1])];
        let [above, this, below] = &rows;
        let place = |x: usize| Place {
            middle: this[x],
            across: half(this[x - 1], this[x + 1]),
            down: half(above[x], below[x]),
        };
        (1..=width).map(place).collect::<Vec<_>>()
    })
}

/// A sum of pixels; weights may be negative.
#[derive(Default)]
struct Sum {
    colors: [f64; 3],
    alpha: f64,
    weight: f64,
}

impl Sum {
    /// Adds the interpolated value at a position.
    fn add<S: Stored>(&mut self, values: &[S], channels: usize, size: [usize; 2], place: [f64; 2]) {
        let [columns, rows] = [0, 1].map(|axis| taps(place[axis], size[axis]));
        for (y, down) in rows {
            for (x, across) in columns {
                let pixel = &values[(y * size[0] + x) * channels..][..channels];
                let weight = across * down;
                let alpha = pixel.get(3).map_or(weight, |alpha| weight * f64::from(alpha.unit()));
                (self.weight, self.alpha) = (self.weight + weight, self.alpha + alpha);
                self.colors.iter_mut().zip(pixel).for_each(|(sum, x)| *sum += alpha * f64::from(x.unit()));
            }
        }
    }

    /// The mean, as a pixel.
    fn finish<S: Stored>(&self, channels: usize, out: &mut Vec<S>) {
        let alpha = (self.alpha / self.weight).clamp(0.0, 1.0);
        let color = |sum: f64| if self.alpha > 0.0 { (sum / self.alpha).clamp(0.0, 1.0) } else { 0.0 };
        out.extend(self.colors.iter().map(|sum| S::nearest(color(*sum))));
        if channels == 4 {
            out.push(S::nearest(alpha));
        }
    }
}

/// The pixels around a continuous position on a line of `count`, and their weights, which sum to 1.
fn taps(position: f64, count: usize) -> [(usize, f64); 4] {
    // Far outside all positions are equal. NaN becomes 0.
    let position = (position - 0.5).clamp(-2.0, count as f64 + 1.0);
    let position = if position.is_nan() { 0.0 } else { position };
    let first = position.floor();
    let t = position - first;
    let weights = [
        t * (t * (1.0 - 0.5 * t) - 0.5),
        1.0 + t * t * (1.5 * t - 2.5),
        t * (0.5 + t * (2.0 - 1.5 * t)),
        0.5 * t * t * (t - 1.0),
    ];
    let pixel = |i: usize| (first as i64 + i as i64 - 1).clamp(0, count as i64 - 1) as usize;
    [0, 1, 2, 3].map(|i| (pixel(i), weights[i]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::image::Image;
    use proptest::prelude::*;

    fn photo(width: usize, height: usize, value: impl Fn(f64, f64) -> f64) -> Photo {
        let data = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let data = data.flat_map(|(x, y)| [value(x as f64 + 0.5, y as f64 + 0.5) as f32; 3]).collect();
        Photo::from(Image { width, height, channels: 3, data })
    }

    #[test]
    fn resampling_on_the_same_grid_is_exact() {
        let data = (0..4 * 5 * 3).map(|i| (i * 37 % 256) as u8).map(|x| x.max(1)).collect();
        let photo = Photo { width: 5, height: 3, channels: 4, values: Values::Bytes(data) };
        assert_eq!(photo.resampled([5, 3], |place| place), photo);
        let moved = photo.resampled([3, 3], |[x, y]| [x + 2.0, y]);
        assert!((0..9).all(|i| moved.pixel(i % 3, i / 3) == photo.pixel(i % 3 + 2, i / 3)));
        assert!(matches!(moved.values, Values::Bytes(_)));
    }

    #[test]
    fn transparent_pixels_do_not_bleed() {
        let data = [[200, 100, 0, 255], [0, 255, 255, 0]].concat();
        let photo = Photo { width: 2, height: 1, channels: 4, values: Values::Bytes(data) };
        let between = photo.resampled([1, 1], |_| [1.0, 0.5]).pixel(0, 0);
        assert_eq!(between[..3], photo.pixel(0, 0)[..3]);
        assert!((between[3] - 0.5).abs() < 0.01, "{between:?}");
        assert_eq!(photo.resampled([1, 1], |_| [1.5, 0.5]).pixel(0, 0), [0.0; 4]);
    }

    #[test]
    fn downscaled_images_are_averages() {
        // Stripes of one pixel: a single point would be black or white.
        let stripes = photo(100, 10, |x, _| (x as usize % 2) as f64);
        let small = stripes.resampled([20, 2], |[x, y]| [5.0 * x, 5.0 * y]);
        assert!((2..18).all(|x| (small.pixel(x, 0)[0] - 0.5).abs() < 0.12), "{small:?}");
        let lying = photo(10, 100, |_, y| (y as usize % 2) as f64);
        let small = lying.resampled([2, 20], |[x, y]| [5.0 * x, 5.0 * y]);
        assert!((2..18).all(|y| (small.pixel(0, y)[0] - 0.5).abs() < 0.12), "{small:?}");
        assert!(!stripes.resampled([1, 1], |_| [f64::NAN, f64::INFINITY]).pixel(0, 0)[0].is_nan());
    }

    proptest! {
        #[test]
        fn resampling_is_exact_for_parabolas([a, b, c] in prop::array::uniform3(-0.1..0.1_f64), shift in -0.5..0.5_f64) {
            let value = |x: f64, y: f64| 0.5 + 0.1 * (a * x + b * y) + 0.01 * c * x * x;
            let moved = photo(12, 9, value).resampled([12, 9], |[x, y]| [x + shift, y - shift]);
            for (x, y) in [(3, 3), (6, 4), (8, 5)] {
                let expected = value(x as f64 + 0.5 + shift, y as f64 + 0.5 - shift);
                prop_assert!((f64::from(moved.pixel(x, y)[0]) - expected).abs() < 1e-6);
            }
        }
    }
}
