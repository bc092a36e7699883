//! Colour maps of depth and error.

use crate::dataset::image::Image;

/// The mean absolute error at which [`error_map`] reaches the brightest colour.
pub const ERROR_MAP_RANGE: f32 = 0.25;

/// Returns the viridis colour of `t`: 0 is dark violet, 1 is yellow, and lightness rises evenly.
///
/// `t` is clamped to 0 to 1; NaN is black, which the map does not contain. The sixth-degree polynomial is Matt Zucker's
/// fit (<https://www.shadertoy.com/view/WlfXRN>, CC0) to matplotlib's table, within 0.02 of it.
pub fn viridis(t: f32) -> [f32; 3] {
    const COEFFICIENTS: [[f32; 3]; 7] = [
        [0.2777273272234177, 0.005407344544966578, 0.3340998053353061],
        [0.1050930431085774, 1.404613529898575, 1.384590162594685],
        [-0.3308618287255563, 0.214847559468213, 0.09509516302823659],
        [-4.634230498983486, -5.799100973351585, -19.33244095627987],
        [6.228269936347081, 14.17993336680509, 56.69055260068105],
        [4.776384997670288, -13.74514537774601, -65.35303263337234],
        [-5.435455855934631, 4.645852612178535, 26.3124352495832],
    ];
    if t.is_nan() {
        return [0.0; 3];
    }
    let t = t.clamp(0.0, 1.0);
    std::array::from_fn(|c| COEFFICIENTS.iter().rev().fold(0.0, |sum, row| sum * t + row[c]).clamp(0.0, 1.0))
}

/// Maps a one-channel depth image to [`viridis`] colours: yellow at `near`, dark violet at `far`, linear in between and
/// clamped outside. Depths of 0 (no surface) and NaN are black.
///
/// # Panics
/// If `depth` has more than one channel, or unless `near < far`.
#[track_caller]
pub fn depth_map(depth: &Image, near: f64, far: f64) -> Image {
    assert_eq!(depth.channels, 1, "a depth image must have one channel");
    assert!(near < far, "near {near} must be less than far {far}");
    let nearness = |z: f32| ((far - f64::from(z)) / (far - near)) as f32;
    let color = |&z: &f32| viridis(if z == 0.0 { f32::NAN } else { nearness(z) });
    let data = depth.data.iter().flat_map(color).collect();
    Image { width: depth.width, height: depth.height, channels: 3, data }
}

/// Maps the absolute difference of two images, averaged over channels, to [`viridis`] colours: dark violet is 0, yellow
/// is [`ERROR_MAP_RANGE`] or more. NaN is black.
///
/// The scale is fixed, so maps of different images are comparable.
///
/// # Panics
/// If the images differ in size or channels.
#[track_caller]
pub fn error_map(a: &Image, b: &Image) -> Image {
    a.assert_same_shape(b);
    let mut out = Image::new(a.width, a.height, 3);
    let pixels = a.data.chunks_exact(a.channels).zip(b.data.chunks_exact(a.channels));
    for (colour, (p, q)) in out.data.chunks_exact_mut(3).zip(pixels) {
        let error = p.iter().zip(q).map(|(p, q)| (p - q).abs()).sum::<f32>() / a.channels as f32;
        colour.copy_from_slice(&viridis(error / ERROR_MAP_RANGE));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grey(data: &[f32]) -> Image {
        Image { width: data.len(), height: 1, channels: 1, data: data.to_vec() }
    }

    #[test]
    fn viridis_equals_matplotlib() {
        // matplotlib's `viridis` at entries 0, 64, 128, 192 and 255 of 255.
        let table = [
            (0, [0.267004, 0.004874, 0.329415]),
            (64, [0.229739, 0.322361, 0.545706]),
            (128, [0.127568, 0.566949, 0.550556]),
            (192, [0.369214, 0.788888, 0.382914]),
            (255, [0.993248, 0.906157, 0.143936]),
        ];
        for (entry, expected) in table {
            for (got, expected) in viridis(entry as f32 / 255.0).into_iter().zip(expected) {
                assert!((got - expected).abs() < 0.02, "{entry}: {got} for {expected}");
            }
        }
    }

    #[test]
    fn viridis_lightness_rises() {
        let luma = |t: f32| viridis(t).iter().zip([0.2126, 0.7152, 0.0722]).map(|(c, w)| c * w).sum::<f32>();
        assert!((0..100).all(|i| luma(i as f32 / 100.0) < luma((i + 1) as f32 / 100.0)));
    }

    #[test]
    fn depth_map_runs_from_yellow_to_violet() {
        let map = depth_map(&grey(&[2.0, 4.0, 6.0, 0.0, f32::INFINITY, f32::NAN]), 2.0, 6.0);
        let expected = [1.0, 0.5, 0.0, f32::NAN, 0.0, f32::NAN].map(viridis);
        assert_eq!(map.data, expected.concat());
        assert_eq!(map.data[9..12], [0.0; 3], "nothing there: black");
    }

    #[test]
    fn error_map_averages_and_saturates() {
        let rgb = |data: [f32; 3]| Image { width: 1, height: 1, channels: 3, data: data.to_vec() };
        let map = |a, b| error_map(&rgb(a), &rgb(b)).data;
        assert_eq!(map([0.5; 3], [0.5; 3]), viridis(0.0));
        assert_eq!(map([0.5, 0.5, 0.5], [0.5, 0.125, 0.5]), viridis(0.5));
        assert_eq!(map([1.0; 3], [0.0; 3]), viridis(1.0));
        assert_eq!(map([f32::NAN; 3], [0.0; 3]), [0.0; 3]);
    }
}
