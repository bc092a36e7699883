//! The size at which images are loaded, where the caller sets none.

use super::capture::{Capture, View};
use super::formats;
use super::frames::{Split, evenly_spaced, pixels_across};
use super::image_size::fitting;
use super::photo::Header;
use super::scene_analysis::SceneAnalysis;
use super::scene_type::SceneType;
use crate::camera::lens::Lens;
use crate::numbers::median;
use std::path::Path;

/// The longest side of an image, and of a panorama, after automatic downscaling.
const LONGEST: f64 = 1600.0;
const LONGEST_OF_PANORAMA: f64 = 6400.0;
/// The least share of these sides to which the cells of a grid bring an image.
const LEAST_SHARE: f64 = 0.5;
/// The most bytes of all training images after automatic downscaling.
const MOST_BYTES: f64 = 3e9;
/// The number of images whose headers decide.
const MEASURED: usize = 25;

/// A downscale factor for a training.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AutomaticDownscale {
    /// The factor, at least 1.
    pub factor: usize,
    /// What sets the factor. `None` if it is 1.
    pub limit: Option<DownscaleLimit>,
}

/// A limit of the size of training images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DownscaleLimit {
    /// The longest side of an image.
    Side,
    /// The memory of all images.
    Memory,
    /// The cells of a grid.
    Cells,
}

/// What the header of an image says, with its camera.
struct Measured {
    /// The factor by which the capture itself has downscaled the image.
    made: f64,
    /// Factor that brings the longest side to its limit.
    side: f64,
    /// Bytes of the loaded image.
    bytes: f64,
    /// Pixels along the longest side of the scene box, at its centre.
    across: f64,
}

impl Measured {
    /// `None` if the header cannot be read or does not fit the camera; loading reports the error.
    fn new(view: &View, folder: &Path, analysis: &SceneAnalysis) -> Option<Self> {
        let path = view.image.as_ref()?;
        let made = formats::factor_of(path.strip_prefix(folder).unwrap_or(Path::new("")));
        let header = Header::read(path).ok()?;
        let [width, height] = fitting(&header, path, &view.camera).ok()?;
        let SceneAnalysis { transform, scene_type, bounds, ndc, .. } = analysis;
        let camera = transform.camera(&view.camera.resized(width, height));
        let longest = if camera.lens == Lens::Equirectangular { LONGEST_OF_PANORAMA } else { LONGEST };
        Some(Measured {
            made: made as f64,
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
    /// together take about 3 GB at most. And there are fewer than two pixels for each of the `cells` along the scene
    /// box, or across the NDC frustum, as a grid with those cells does not resolve more. This third limit leaves images
    /// at half of those sides or more: 800 pixels, or 3200 of a panorama.
    ///
    /// If the capture refers to images in a folder such as `images_2`, the factor is relative to the full size, as that
    /// of [`LoadOptions`](crate::dataset::LoadOptions).
    pub fn automatic_downscale(&self, analysis: &SceneAnalysis, cells: f64) -> AutomaticDownscale {
        let trained: Vec<&View> =
            self.split(Split::Train).into_iter().flatten().filter(|view| view.image.is_some()).collect();
        let count = trained.len();
        let measured: Vec<Measured> = evenly_spaced(trained, MEASURED)
            .into_iter()
            .filter_map(|view| Measured::new(view, &self.folder, analysis))
            .collect();
        automatic(&measured, count, cells)
    }
}

/// The factor for `count` images like the measured ones.
fn automatic(measured: &[Measured], count: usize, cells: f64) -> AutomaticDownscale {
    let typical = |value: fn(&Measured) -> f64| median(measured.iter().map(value));
    let bytes = count as f64 * typical(|image| image.bytes);
    let side = typical(|image| image.side);
    let by_cells = (typical(|image| image.across) / cells).min(side / LEAST_SHARE).floor();
    let limits = [
        (DownscaleLimit::Side, side.ceil()),
        (DownscaleLimit::Memory, (bytes / MOST_BYTES).sqrt().ceil()),
        (DownscaleLimit::Cells, by_cells),
    ];
    let none = AutomaticDownscale { factor: 1, limit: None };
    let made = typical(|image| image.made).max(1.0);
    let largest = limits.into_iter().filter(|(_, factor)| *factor > 1.0).max_by(|(_, a), (_, b)| a.total_cmp(b));
    largest.map_or(none, |(limit, factor)| AutomaticDownscale { factor: (factor * made) as usize, limit: Some(limit) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Camera;
    use crate::dataset::Image;
    use crate::dataset::capture::Format;
    use glam::DVec3;

    const FEW: Measured = Measured { made: 1.0, side: 0.5, bytes: 1e6, across: 400.0 };

    #[test]
    fn each_limit_sets_the_factor() {
        let factor = |measured: &[Measured], count: usize, cells: f64| automatic(measured, count, cells).factor;
        assert_eq!(automatic(&[FEW], 100, 512.0), AutomaticDownscale { factor: 1, limit: None });
        for (side, expected) in [(1.0, 1), (1.001, 2), (2.6, 3)] {
            assert_eq!(factor(&[Measured { side, ..FEW }], 1, 512.0), expected, "{side}");
        }
        // 3000, 3001 and 27000 images of 1 MB.
        for (count, expected) in [(3000, 1), (3001, 2), (27000, 3), (27001, 4)] {
            assert_eq!(factor(&[FEW], count, 512.0), expected, "{count}");
        }
        // Less than two pixels a cell stay.
        for (across, expected) in [(1023.0, 1), (1024.0, 2), (1535.0, 2), (1600.0, 3)] {
            assert_eq!(factor(&[Measured { across, side: 2.0, ..FEW }], 1, 512.0), expected.max(2), "{across}");
        }
        let wide = Measured { across: 1e5, ..FEW };
        assert_eq!(factor(&[wide], 1, f64::INFINITY), 1, "a field without cells");
        let large = |side: f64| factor(&[Measured { across: 1e5, side, ..FEW }], 1, 512.0);
        assert_eq!([0.99, 1.0, 1.5, 2.6].map(large), [1, 2, 3, 5], "800 pixels stay");
        assert_eq!(factor(&[], 5, 512.0), 1, "no header could be read");
        // A single large image does not count.
        assert_eq!(factor(&[Measured { side: 9.0, ..FEW }, FEW, FEW], 3, 512.0), 1);
        // The limit that needs the largest factor is named.
        let limit = |side: f64, bytes: f64, across: f64| {
            automatic(&[Measured { made: 1.0, side, bytes, across }], 1, 512.0).limit.unwrap()
        };
        assert_eq!(limit(2.0, 26e9, 600.0), DownscaleLimit::Memory);
        assert_eq!(limit(3.5, 26e9, 600.0), DownscaleLimit::Side);
        assert_eq!(limit(3.5, 26e9, 4000.0), DownscaleLimit::Cells);
        // Images that are downscaled already keep their size, or get a multiple of their factor.
        assert_eq!(factor(&[Measured { made: 4.0, ..FEW }], 1, 512.0), 1);
        assert_eq!(factor(&[Measured { made: 4.0, side: 1.5, ..FEW }], 1, 512.0), 8);
    }

    /// A view of an image with this path.
    fn view(folder: &Path, name: &str, [width, height]: [usize; 2], camera: Camera) -> View {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        Image::new(width, height, 1).save_png(&path).unwrap();
        View { image: Some(path), split: Some(Split::Train), ..View::new(name, name, camera) }
    }

    fn of(folder: &Path, views: Vec<View>, cells: f64) -> usize {
        let capture = Capture::new(folder, "t.json".into(), Format::Transforms, views);
        let analysis = SceneAnalysis::new(&capture, None, None).unwrap();
        capture.automatic_downscale(&analysis, cells).factor
    }

    fn pose(i: usize) -> glam::DAffine3 {
        Camera::look_at(DVec3::new(i as f64, 3.0, 1.0), DVec3::ZERO, DVec3::Z)
    }

    /// Panoramas of 8000 x 4000 pixels may have 6400; others 1600. Held-out and absent images do not count.
    #[test]
    fn headers_of_training_images_decide() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        let made = |i: usize, lens: Lens, split: Split| {
            let wide = 6500 >> (4 * (i % 2));
            let camera = Camera { lens, ..Camera::from_angle(wide / 2, 1, 0.8, pose(i)) };
            let view = view(folder, &format!("{i}.png"), [wide, 2], camera);
            View { image: view.image.filter(|_| i != 7), split: Some(split), ..view }
        };
        let all = |lens: Lens, split: fn(usize) -> Split| {
            of(folder, (0..9).map(|i| made(i, lens, split(i))).collect(), f64::INFINITY)
        };
        assert_eq!(all(Lens::Pinhole, |_| Split::Train), 5, "five of eight are 6500 wide");
        assert_eq!(all(Lens::Equirectangular, |_| Split::Train), 2);
        assert_eq!(all(Lens::Pinhole, |i| if i < 5 { Split::Test } else { Split::Train }), 5);
        assert_eq!(all(Lens::Pinhole, |i| if i % 2 == 0 { Split::Test } else { Split::Train }), 1);
        // The typical image of all counts, not the first ones: 20 of 51 are large.
        let many = (0..51)
            .map(|i| {
                let camera = Camera::from_angle(20, 1, 0.8, pose(i));
                view(folder, &format!("many/{i}.png"), if i < 20 { [3240, 162] } else { [20, 1] }, camera)
            })
            .collect();
        assert_eq!(of(folder, many, f64::INFINITY), 1);
    }

    /// The camera file states half of the size of the tall images.
    #[test]
    fn sizes_of_images_count_in_pixels_of_their_longest_side() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        let tall = |inside: &str| {
            (0..3)
                .map(|i| {
                    let camera = Camera::from_angle(100, 900, 0.8, pose(i));
                    view(folder, &format!("{inside}/{i}.png"), [200, 1800], camera)
                })
                .collect::<Vec<_>>()
        };
        assert_eq!(of(folder, tall("images"), f64::INFINITY), 2);
        assert_eq!(of(folder, tall("images_4"), f64::INFINITY), 8);
        // Cells along the box, which is as wide as a share of the focal length in pixels.
        let capture = Capture::new(folder, "t.json".into(), Format::Transforms, tall("images"));
        let analysis = SceneAnalysis::new(&capture, None, None).unwrap();
        let is_forward_facing = analysis.scene_type == SceneType::ForwardFacing;
        let across = median(capture.views.iter().map(|view| {
            let camera = analysis.transform.camera(&view.camera.resized(200, 1800));
            pixels_across(&camera, analysis.bounds, analysis.ndc.filter(|_| is_forward_facing))
        }));
        let factor = |cells: f64| capture.automatic_downscale(&analysis, cells);
        assert_eq!(factor(across / 1.9).limit, Some(DownscaleLimit::Side));
        assert_eq!(factor(across / 2.5), AutomaticDownscale { factor: 2, limit: Some(DownscaleLimit::Cells) });
        assert_eq!(factor(across / 100.0).factor, 2, "900 pixels");
    }

    /// The memory of an image is that of its channels and bits.
    #[test]
    fn bytes_follow_the_header() {
        let folder = tempfile::tempdir().unwrap();
        let bytes = |name: &str, channels: usize| {
            let views = (0..3).map(|i| {
                let view = view(folder.path(), &format!("{i}{name}"), [6, 4], Camera::from_angle(6, 4, 0.8, pose(i)));
                Image::new(6, 4, channels).save_png(view.image.as_ref().unwrap()).unwrap();
                view
            });
            let capture = Capture::new(folder.path(), "t.json".into(), Format::Transforms, views.collect());
            let analysis = SceneAnalysis::new(&capture, None, None).unwrap();
            Measured::new(&capture.views[0], folder.path(), &analysis).unwrap().bytes
        };
        assert_eq!([bytes("rgb.png", 3), bytes("rgba.png", 4)], [72.0, 96.0]);
        // All training images share the memory: 999 and 1001 of 3 MB.
        let large = Image::new(1000, 1000, 3);
        large.save_png(folder.path().join("large.png")).unwrap();
        let many = |count: usize| {
            let view = |i: usize| View {
                image: Some(folder.path().join("large.png")),
                split: Some(Split::Train),
                ..View::new(format!("{i}"), format!("{i}"), Camera::from_angle(1000, 1000, 0.8, pose(i)))
            };
            of(folder.path(), (0..count).map(view).collect(), f64::INFINITY)
        };
        assert_eq!([many(999), many(1001)], [1, 2]);
    }
}
