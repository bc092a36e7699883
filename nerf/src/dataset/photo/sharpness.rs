//! Sharpness of images.

use super::Photo;

impl Photo {
    /// Computes the variance of the Laplacian of brightness (Pech-Pacheco et al. 2000).
    ///
    /// More is sharper, among images of one subject and size. It is 0 if a side is shorter than 3 pixels.
    pub fn sharpness(&self) -> f64 {
        let luma = |[r, g, b, _]: [f32; 4]| 0.299 * r + 0.587 * g + 0.114 * b;
        let line = |y: usize| (0..self.width).map(|x| luma(self.pixel(x, y))).collect();
        laplacian_variance([self.width, self.height], line)
    }
}

/// The variance of the Laplacian of a grey image; 0 if a side is shorter than 3 pixels. `line` returns a row by number.
/// Pixels that are NaN, and those beside them, do not count.
pub(crate) fn laplacian_variance([width, height]: [usize; 2], line: impl Fn(usize) -> Vec<f32>) -> f64 {
    if width < 3 || height < 3 {
        return 0.0;
    }
    let mut lines = [line(0), line(1), line(2)];
    let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
    for y in 1..height - 1 {
        let [above, this, below] = &lines;
        for x in 1..width - 1 {
            let [left, right, above, below, middle] =
                [this[x - 1], this[x + 1], above[x], below[x], this[x]].map(f64::from);
            let value = left + right + above + below - 4.0 * middle;
            if !value.is_nan() {
                (count, sum, squares) = (count + 1.0, sum + value, squares + value * value);
            }
        }
        if y + 2 < height {
            lines.rotate_left(1);
            lines[2] = line(y + 2);
        }
    }
    if count == 0.0 { 0.0 } else { squares / count - (sum / count) * (sum / count) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::image::Image;

    #[test]
    fn blurred_images_are_less_sharp() {
        let stripes = |value: fn(usize) -> f32| {
            let data = (0..40 * 30).flat_map(|i| [value(i % 40 + i / 40); 3]).collect();
            Photo::from(Image { width: 40, height: 30, channels: 3, data }).sharpness()
        };
        let sharp = stripes(|x| f32::from(u8::from(x % 8 < 4)));
        let blurred = stripes(|x| [0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25][x % 8]);
        assert!(sharp > 4.0 * blurred && blurred > 0.0, "{sharp} {blurred}");
        // A gradient is not sharp, however steep.
        assert!(stripes(|x| x as f32 / 70.0) < 1e-10);
        // The Laplacian of three equal rows [0 0 1 0 0] is 1, -2, 1; its variance is 2.
        let data = [0.0, 0.0, 1.0, 0.0, 0.0].repeat(3).iter().flat_map(|x| [*x; 3]).collect();
        let line = Photo::from(Image { width: 5, height: 3, channels: 3, data });
        assert!((line.sharpness() - 2.0).abs() < 1e-6);
        assert_eq!(Photo::from(Image::new(2, 9, 3)).sharpness(), 0.0);
    }
}
