//! Means of pixels, in the numbers that they are stored as.

/// The stored type of a pixel's values.
pub(super) trait Stored: Copy {
    /// The value in 0..=1.
    fn unit(self) -> f32;
    /// Rounds a value in 0..=1.
    fn nearest(value: f64) -> Self;
}

impl Stored for u8 {
    fn unit(self) -> f32 {
        f32::from(self) / 255.0
    }

    fn nearest(value: f64) -> Self {
        (value * 255.0).round() as u8
    }
}

impl Stored for u16 {
    fn unit(self) -> f32 {
        f32::from(self) / 65535.0
    }

    fn nearest(value: f64) -> Self {
        (value * 65535.0).round() as u16
    }
}

impl Stored for f32 {
    fn unit(self) -> f32 {
        self
    }

    fn nearest(value: f64) -> Self {
        value as f32
    }
}

/// Averages `channels` values over the areas of an image of the size `from` that the pixels of the size `to` cover.
///
/// Sums are f64, so that a constant keeps its value to the last bit.
pub(super) fn average<S: Stored>(values: &[S], channels: usize, from: [usize; 2], to: [usize; 2]) -> Vec<S> {
    let (columns, rows) = (shares(from[0], to[0]), shares(from[1], to[1]));
    let mut out = Vec::with_capacity(to[0] * to[1] * channels);
    for row in &rows {
        for column in &columns {
            let (mut sum, mut alphas, mut weights) = ([0.0_f64; 3], 0.0, 0.0);
            for &(y, down) in row {
                for &(x, across) in column {
                    let start = (y * from[0] + x) * channels;
                    let pixel = &values[start..start + channels];
                    let weight = down * across;
                    let alpha = pixel.get(3).map_or(weight, |alpha| weight * f64::from(alpha.unit()));
                    (weights, alphas) = (weights + weight, alphas + alpha);
                    sum.iter_mut().zip(pixel).for_each(|(sum, x)| *sum += alpha * f64::from(x.unit()));
                }
            }
            let mean = |sum: &f64| S::nearest(if alphas == 0.0 { 0.0 } else { sum / alphas });
            out.extend(sum.iter().take(channels).map(mean));
            if channels == 4 {
                out.push(S::nearest(alphas / weights));
            }
        }
    }
    out
}

/// For each of `to` equal parts of a line of `from` pixels, the covered pixels and the covered share of each.
fn shares(from: usize, to: usize) -> Vec<Vec<(usize, f64)>> {
    // In units of 1 / `to` of a pixel, all ends are integers.
    let part = |i: usize| {
        let [start, end] = [i * from, (i + 1) * from];
        let covered = |pixel: usize| (end.min((pixel + 1) * to) - start.max(pixel * to)) as f64 / to as f64;
        (start / to..end.div_ceil(to)).map(|pixel| (pixel, covered(pixel))).collect()
    };
    (0..to).map(part).collect()
}
