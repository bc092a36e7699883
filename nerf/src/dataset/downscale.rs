//! The size at which images are loaded, where the caller sets none.

use super::capture::{Capture, View};
use super::frames::{Split, evenly_spaced, pixels_across};
use super::load::fitting;
use super::photo::Header;
use super::scene_analysis::SceneAnalysis;
use super::scene_type::SceneType;
use crate::camera::lens::Lens;
use crate::numbers::median;

/// The longest side of an image, and of a panorama, after automatic downscaling.
const LONGEST: f64 = 1600.0;
const LONGEST_OF_PANORAMA: f64 = 6400.0;
/// The least share of these sides to which the cells of a grid bring an image.
const LEAST_SHARE: f64 = 0.25;
/// The most bytes of all training images after automatic downscaling.
const MOST_BYTES: f64 = 3e9;
/// The number of images whose headers decide.
const MEASURED: usize = 25;

/// What the header of an image says, with its camera.
struct Measured {
    /// Factor that brings the longest side to its limit.
    side: f64,
    /// Bytes of the loaded image.
    bytes: f64,
    /// Pixels along the longest side of the scene box, at its centre.
    across: f64,
}

impl Measured {
    /// `None` if the header cannot be read or does not fit the camera; loading reports the error.
    fn new(view: &View, analysis: &SceneAnalysis) -> Option<Self> {
        let path = view.image.as_ref()?;
        let header = Header::read(path).ok()?;
        let [width, height] = fitting(&header, path, &view.camera).ok()?;
        let SceneAnalysis { transform, scene_type, bounds, ndc, .. } = analysis;
        let camera = transform.camera(&view.camera.resized(width, height));
        let longest = if camera.lens == Lens::Equirectangular { LONGEST_OF_PANORAMA } else { LONGEST };
        Some(Measured {
            side: width.max(height) as f64 / longest,
            bytes: header.pixel as f64 * (width * height) as f64,
            across: pixels_across(&camera, *bounds, ndc.filter(|_| *scene_type == SceneType::ForwardFacing)),
        })
    }
}

impl Capture {
    /// Returns the smallest downscale factor with which most images suit a training. It is 1 for images whose headers
    /// cannot be read.
    ///
    /// The longest side is then at most 1600 pixels, as nerfstudio's, or 6400 of a panorama. All training images
    /// together take at most 3 GB. And there are fewer than two pixels for each of the `cells` along the scene box, or
    /// across the NDC frustum, as a grid with those cells does not resolve more; images that are larger than 400 pixels
    /// (1600 for panoramas) stay so.
    pub fn automatic_downscale(&self, analysis: &SceneAnalysis, cells: f64) -> usize {
        let trained: Vec<&View> =
            self.split(Split::Train).into_iter().flatten().filter(|view| view.image.is_some()).collect();
        let count = trained.len();
        let measured = evenly_spaced(trained, MEASURED).into_iter().filter_map(|view| Measured::new(view, analysis));
        factor(&measured.collect::<Vec<_>>(), count, cells)
    }
}

/// The factor for `count` images like the measured ones.
fn factor(measured: &[Measured], count: usize, cells: f64) -> usize {
    let typical = |value: fn(&Measured) -> f64| median(measured.iter().map(value));
    let bytes = count as f64 * typical(|image| image.bytes);
    let side = typical(|image| image.side);
    let by_cells = (typical(|image| image.across) / cells).min(side / LEAST_SHARE).floor();
    [side.ceil(), (bytes / MOST_BYTES).sqrt().ceil(), by_cells].into_iter().fold(1.0, f64::max) as usize
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Camera;
    use crate::dataset::Image;
    use crate::dataset::capture::Format;
    use glam::DVec3;

    const FEW: Measured = Measured { side: 0.5, bytes: 1e6, across: 400.0 };

    #[test]
    fn each_limit_sets_the_factor() {
        let made = |change: fn(&mut Measured), count: usize, cells: f64| {
            let mut image = FEW;
            change(&mut image);
            factor(&[image], count, cells)
        };
        assert_eq!(made(|_| (), 100, 512.0), 1);
        for (side, expected) in [(1.0, 1), (1.001, 2), (2.6, 3)] {
            assert_eq!(factor(&[Measured { side, ..FEW }], 1, 512.0), expected, "{side}");
        }
        // 3000, 3001 and 27000 images of 1 MB.
        for (count, expected) in [(3000, 1), (3001, 2), (27000, 3), (27001, 4)] {
            assert_eq!(made(|_| (), count, 512.0), expected, "{count}");
        }
        // Less than two pixels a cell stay.
        for (across, expected) in [(1023.0, 1), (1024.0, 2), (1600.0, 3)] {
            assert_eq!(factor(&[Measured { across, side: 1.0, ..FEW }], 1, 512.0), expected, "{across}");
        }
        assert_eq!(made(|image| image.across = 1e5, 1, f64::INFINITY), 1, "a field without cells");
        assert_eq!(made(|image| image.across = 1e5, 1, 512.0), 2, "800 pixels become 400 at least");
        assert_eq!(factor(&[], 5, 512.0), 1, "no header could be read");
        // A single large image does not count.
        assert_eq!(factor(&[Measured { side: 9.0, ..FEW }, FEW, FEW], 3, 512.0), 1);
    }

    /// Panoramas of 8000 x 4000 pixels may have 6400; others 1600. Held-out and absent images do not count.
    #[test]
    fn headers_of_training_images_decide() {
        let folder = tempfile::tempdir().unwrap();
        let view = |i: usize, lens: Lens, split: Split| {
            let path = folder.path().join(format!("{i}.png"));
            Image::new(6500 >> (4 * (i % 2)), 2, 1).save_png(&path).unwrap();
            let pose = Camera::look_at(DVec3::new(i as f64, 3.0, 1.0), DVec3::ZERO, DVec3::Z);
            let camera = Camera { lens, ..Camera::from_angle(3250 >> (4 * (i % 2)), 1, 0.8, pose) };
            let image = (i != 7).then_some(path);
            View { image, split: Some(split), ..View::new(format!("{i}.png"), format!("frames[{i}]"), camera) }
        };
        let factor = |views: Vec<View>| {
            let capture = Capture::new(folder.path(), "t.json".into(), Format::Transforms, views);
            let analysis = SceneAnalysis::new(&capture, None, None).unwrap();
            capture.automatic_downscale(&analysis, f64::INFINITY)
        };
        let all = |lens: Lens, split: fn(usize) -> Split| factor((0..9).map(|i| view(i, lens, split(i))).collect());
        assert_eq!(all(Lens::Pinhole, |_| Split::Train), 5, "five of eight are 6500 wide");
        assert_eq!(all(Lens::Equirectangular, |_| Split::Train), 2);
        assert_eq!(all(Lens::Pinhole, |i| if i < 5 { Split::Test } else { Split::Train }), 5);
        assert_eq!(all(Lens::Pinhole, |i| if i % 2 == 0 { Split::Test } else { Split::Train }), 1);
    }
}
