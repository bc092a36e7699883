//! The pixels of an image that its lens sees.

use super::mask::Mask;
use crate::camera::pinhole::Camera;
use std::ops::Range;

/// The pixels whose centres a camera's lens sees; `None` if it sees all.
///
/// The region has no holes and is connected: from the principal point it reaches up to the first fold in each direction.
/// So a block of pixels whose border is all seen is seen inside too, and one whose border is all dark is dark, unless it
/// contains the principal point. Other blocks are divided. The cost follows the length of the region's border.
pub(super) fn seen_pixels(camera: &Camera) -> Option<Mask> {
    let (columns, rows) = (0..camera.width, 0..camera.height);
    let mut blocks = Blocks { camera, seen: vec![] };
    if blocks.border(&columns, &rows) == Some(true) {
        return None;
    }
    blocks.seen = vec![false; camera.width * camera.height];
    blocks.fill(columns, rows);
    Some(Mask::new(camera.width, camera.height, |x, y| blocks.seen[y * camera.width + x]))
}

/// The most pixels of a block that is not divided.
const SMALL: usize = 16;

struct Blocks<'a> {
    camera: &'a Camera,
    /// Row-major.
    seen: Vec<bool>,
}

impl Blocks<'_> {
    fn sees(&self, x: usize, y: usize) -> bool {
        self.camera.sees(x as f64 + 0.5, y as f64 + 0.5)
    }

    /// Whether all pixels of the border of a block are seen, or none is; `None` if some are.
    fn border(&self, columns: &Range<usize>, rows: &Range<usize>) -> Option<bool> {
        let across = columns.clone().flat_map(|x| [(x, rows.start), (x, rows.end - 1)]);
        let down = rows.clone().flat_map(|y| [(columns.start, y), (columns.end - 1, y)]);
        let first = self.sees(columns.start, rows.start);
        across.chain(down).all(|(x, y)| self.sees(x, y) == first).then_some(first)
    }

    /// Finds the seen pixels of a block.
    fn fill(&mut self, columns: Range<usize>, rows: Range<usize>) {
        if columns.is_empty() || rows.is_empty() {
            return;
        }
        let width = self.camera.width;
        if columns.len() * rows.len() <= SMALL {
            for y in rows {
                for x in columns.clone() {
                    self.seen[y * width + x] = self.sees(x, y);
                }
            }
            return;
        }
        let contains = |range: &Range<usize>, at: f64| (range.start as f64..=range.end as f64).contains(&at);
        let centre = self.camera.centre;
        let border = self.border(&columns, &rows);
        if border == Some(true) {
            for y in rows {
                self.seen[y * width..][columns.clone()].fill(true);
            }
        } else if border.is_none() || contains(&columns, centre[0]) && contains(&rows, centre[1]) {
            let halves = |range: &Range<usize>| {
                let middle = range.start + range.len() / 2;
                [range.start..middle, middle..range.end]
            };
            for rows in halves(&rows) {
                for columns in halves(&columns) {
                    self.fill(columns, rows.clone());
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::lens::Lens;
    use glam::DAffine3;

    /// Cameras whose images have dark corners, dark sides or a small disc, also beside the image's middle.
    fn cameras() -> Vec<Camera> {
        let mut cameras = vec![];
        let barrel = |k1: f64, k2: f64| Lens::Brown { k: [k1, k2, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
        let tangential = Lens::Brown { k: [-0.4, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.02, -0.03] };
        let fisheye = Lens::Fisheye { k: [-0.08, 0.0, 0.0, 0.0], p: [0.01, 0.0], s: [0.01, 0.0] };
        for lens in [barrel(-0.5, 0.0), barrel(-0.3, 0.05), tangential, fisheye, Lens::Fov { omega: 1.2 }] {
            for (width, height) in [(31, 19), (12, 30), (1, 1)] {
                for (focal, shift) in [(0.2, 0.0), (0.5, 0.3), (0.05, -0.4), (0.3, 0.8)] {
                    let side = width.max(height) as f64;
                    cameras.push(Camera {
                        width,
                        height,
                        focal: [focal * side, 1.1 * focal * side],
                        centre: [(0.5 + shift) * width as f64, 0.5 * height as f64],
                        lens,
                        pose: DAffine3::IDENTITY,
                    });
                }
            }
        }
        cameras
    }

    #[test]
    fn seen_pixels_equal_those_of_each_pixel() {
        let mut counts = [0; 3];
        for camera in cameras() {
            let sees = |x: usize, y: usize| camera.sees(x as f64 + 0.5, y as f64 + 0.5);
            let each = Mask::new(camera.width, camera.height, sees);
            let all = each.used() == camera.width * camera.height;
            match seen_pixels(&camera) {
                None => assert!(all, "{camera:?}"),
                Some(mask) => assert!(mask == each && !all, "{camera:?}: {} of {}", mask.used(), each.used()),
            }
            counts[if all {
                0
            } else if each.used() > 0 {
                1
            } else {
                2
            }] += 1;
        }
        assert!(counts[0] > 10 && counts[1] > 20, "{counts:?}");
    }

    #[test]
    fn large_image_asks_the_lens_along_the_border_alone() {
        let camera = Camera {
            width: 16_384,
            height: 16_384,
            focal: [4000.0; 2],
            centre: [8192.0; 2],
            lens: Lens::Brown { k: [-0.5, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] },
            pose: DAffine3::IDENTITY,
        };
        let start = std::time::Instant::now();
        let mask = seen_pixels(&camera).unwrap();
        // A disc.
        let radius = mask.used() as f64 / std::f64::consts::PI;
        assert!(radius.sqrt() > 1000.0 && mask.uses(8192, 8192) && !mask.uses(0, 0));
        // Each pixel would take minutes.
        assert!(start.elapsed().as_secs() < 60, "{:?}", start.elapsed());
    }
}
