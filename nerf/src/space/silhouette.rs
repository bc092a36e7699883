//! Visual hull carving: a fully transparent pixel shows that its ray is empty.

use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::dataset::{Dataset, Frame};
use crate::space::occupancy::OccupancyGrid;
use glam::{DAffine3, DVec3};

/// The margin in pixels that must be transparent too: the footprint of the image's filter.
const MARGIN: f64 = 1.5;

/// The silhouette of one image.
struct Silhouette<'a> {
    camera: &'a Camera,
    world_to_camera: DAffine3,
    /// For each corner between pixels, row-major, the number of pixels above it and to its left that are not fully
    /// transparent.
    sums: Vec<u32>,
}

impl<'a> Silhouette<'a> {
    /// `None` if the image has no transparency, or is a panorama.
    fn new(frame: &'a Frame) -> Option<Self> {
        let Frame { camera, image, mask, .. } = frame;
        if !image.has_alpha() || camera.lens == Lens::Equirectangular {
            return None;
        }
        let stride = image.width + 1;
        let mut sums = vec![0; stride * (image.height + 1)];
        for y in 0..image.height {
            let mut row = 0;
            for x in 0..image.width {
                let used = mask.as_ref().is_none_or(|mask| mask.uses(x, y));
                row += u32::from(!used || image.pixel(x, y)[3] > 0.0);
                sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + row;
            }
        }
        Some(Silhouette { camera, world_to_camera: camera.pose.inverse(), sums })
    }

    /// Returns true if the whole ball projects into the image, onto fully transparent pixels only.
    fn is_clear(&self, centre: DVec3, radius: f64) -> bool {
        let local = self.world_to_camera.transform_point3(centre);
        let depth = -local.z;
        if depth <= 1.01 * radius {
            return false;
        }
        let tangents = [local.x / depth, -local.y / depth].map(|tangent| {
            // |(x + dx) / (z + dz) - x / z| = |dx - (x / z) dz| / (z + dz) for a point of the ball.
            let reach = radius * (1.0 + tangent.abs()) / (depth - radius);
            [tangent - reach, tangent + reach]
        });
        let Some(places) = distorted(&self.camera.lens, tangents) else { return false };
        let mut window = [[0; 2]; 2];
        let sizes = [self.camera.width, self.camera.height];
        for (axis, places) in places.into_iter().enumerate() {
            let [low, high] = places.map(|place| self.camera.centre[axis] + self.camera.focal[axis] * place);
            let (low, high) = ((low - MARGIN).floor(), (high + MARGIN).ceil());
            if !(low >= 0.0 && high <= sizes[axis] as f64) {
                return false;
            }
            window[axis] = [low as usize, high as usize];
        }
        let [[left, right], [top, bottom]] = window;
        let at = |x: usize, y: usize| self.sums[y * (self.camera.width + 1) + x];
        at(right, bottom) + at(left, top) == at(left, bottom) + at(right, top)
    }
}

/// The share of its size by which the box of distorted points is grown on each side, and the least size of the box as a
/// share of the undistorted one.
const GROWN: f64 = 0.25;
const SHRUNK: f64 = 0.25;

/// The lower and the upper ends of the places that a lens gives to a rectangle of tangents `[[left, right], [top,
/// bottom]]`; `None` if it does not see all of it, or nearly folds it.
///
/// The box of nine points, grown. Between points that are half a side `h` apart, the places leave their box by at most
/// `h^2 / 8` times the second derivative. That is less than the growth, `h / 2` times the first derivative, unless the
/// first derivative changes by a factor of four within `h`.
fn distorted(lens: &Lens, tangents: [[f64; 2]; 2]) -> Option<[[f64; 2]; 2]> {
    if *lens == Lens::Pinhole {
        return Some(tangents);
    }
    let three = tangents.map(|[low, high]| [low, 0.5 * (low + high), high]);
    let mut ends = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
    for x in three[0] {
        for y in three[1] {
            let place = lens.place(DVec3::new(x, y, 1.0))?;
            for (end, place) in ends.iter_mut().zip(place) {
                *end = [end[0].min(place), end[1].max(place)];
            }
        }
    }
    let is_wide = |axis: usize| {
        let [size, before] = [ends, tangents].map(|ends| ends[axis][1] - ends[axis][0]);
        size >= SHRUNK * before
    };
    let grown = ends.map(|[low, high]| [low - GROWN * (high - low), high + GROWN * (high - low)]);
    (is_wide(0) && is_wide(1)).then_some(grown)
}

/// Images per required vote, if there are few images.
const EACH: usize = 8;

/// Permanently empties the cells that `votes` images see through; of few images, one in eight suffices. The rest is the
/// visual hull (Laurentini 1994), robust to wrong masks in fewer images. Images without transparency do not vote; 0
/// votes carve nothing.
pub(crate) fn carve(grid: &mut OccupancyGrid, data: &Dataset, votes: u32) {
    let views = data.frames.iter().filter_map(Silhouette::new);
    carve_views(grid, &views.collect::<Vec<_>>(), votes);
}

fn carve_views(grid: &mut OccupancyGrid, views: &[Silhouette<'_>], votes: u32) {
    let votes = (votes as usize).min(views.len().div_ceil(EACH));
    if votes == 0 {
        return;
    }
    grid.carve(&|centre, radius| {
        views.iter().filter(|view| view.is_clear(centre, radius)).take(votes).count() == votes
    });
    grid.occupy_all_but_carved();
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{Image, Mask};
    use crate::space::occupancy::OccupancyConfig;

    /// A camera that looks along -z, with an image whose middle third is opaque.
    fn view(eye: DVec3, up: DVec3) -> Frame {
        let mut image = Image::new(60, 60, 4);
        for y in 20..40 {
            for x in 20..40 {
                image.pixel_mut(x, y)[3] = 0.01;
            }
        }
        let camera = Camera::from_angle(60, 60, 0.5, Camera::look_at(eye, DVec3::ZERO, up));
        Frame { name: String::new(), camera, image: image.into(), mask: None, distances: None }
    }

    #[test]
    fn carving_needs_every_pixel_transparent() {
        let frame = view(DVec3::new(0.0, 0.0, 10.0), DVec3::Y);
        let silhouette = Silhouette::new(&frame).unwrap();
        // At the distance 10 the image is 5.1 wide, and a pixel 0.085.
        assert!(!silhouette.is_clear(DVec3::ZERO, 0.01), "in the middle");
        assert!(silhouette.is_clear(DVec3::new(1.7, 0.0, 0.0), 0.3));
        assert!(!silhouette.is_clear(DVec3::new(1.7, 0.0, 0.0), 0.9), "reaches into the silhouette");
        assert!(!silhouette.is_clear(DVec3::new(0.0, 2.5, 0.0), 0.3), "reaches out of the picture");
        assert!(!silhouette.is_clear(DVec3::new(0.0, 0.0, 12.0), 0.3), "behind the camera");
        assert!(!silhouette.is_clear(DVec3::new(1.0, 0.0, 9.9), 0.3), "around the camera");
        let (right, up) = (DVec3::new(1.0, 0.0, 0.0), DVec3::new(0.0, 1.0, 0.0));
        assert!(
            silhouette.is_clear(1.1 * right + 1.1 * up, 0.02) && !silhouette.is_clear(0.8 * right + 0.8 * up, 0.02)
        );
        let opaque = Frame { image: Image::new(60, 60, 3).into(), ..frame.clone() };
        let panorama =
            Frame { camera: Camera { lens: Lens::Equirectangular, ..frame.camera.clone() }, ..frame.clone() };
        assert!(Silhouette::new(&opaque).is_none() && Silhouette::new(&panorama).is_none());
        // Masked pixels are unknown, so they may be opaque.
        let masked = Frame { mask: Some(Mask::new(60, 60, |x, _| x < 40).into()), ..frame.clone() };
        assert!(!Silhouette::new(&masked).unwrap().is_clear(DVec3::new(1.7, 0.0, 0.0), 0.3));
    }

    #[test]
    fn carving_by_two_views_leaves_their_intersection() {
        let views = [view(DVec3::new(0.0, 0.0, 10.0), DVec3::Y), view(DVec3::new(10.0, 0.0, 0.0), DVec3::Y)];
        let mut grid =
            OccupancyGrid::new([DVec3::splat(-1.5), DVec3::splat(1.5)], &OccupancyConfig::default()).unwrap();
        let views: Vec<_> = views.iter().map(|frame| Silhouette::new(frame).unwrap()).collect();
        carve_views(&mut grid, &views, 1);
        // A third of 5.1 in perspective, with a margin of two pixels and a cell.
        for axis in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().flat_map(|axis| [axis, -axis]) {
            assert!(grid.is_occupied(0.85 * axis) && !grid.is_occupied(1.35 * axis), "{axis}");
        }
        let share = grid.occupied_share();
        assert!((0.2..0.4).contains(&share), "{share}");
    }

    /// Lenses with distortions as of phones, action cameras and fisheyes.
    fn lenses() -> [Lens; 5] {
        let brown = |k1: f64, k2: f64, p1: f64| Lens::Brown { k: [k1, k2, 0.0, 0.0, 0.0, 0.0], p: [p1, -p1] };
        let fisheye = Lens::Fisheye { k: [-0.02, 0.004, 0.0, 0.0], p: [0.0; 2], s: [0.0; 2] };
        [brown(1e-6, 0.0, 0.0), brown(-0.2, 0.05, 0.002), brown(0.3, 0.1, 0.0), fisheye, Lens::Fov { omega: 0.8 }]
    }

    #[test]
    fn window_of_a_lens_contains_the_whole_ball() {
        use rand::rngs::StdRng;
        use rand::{RngExt, SeedableRng};
        let mut rng = StdRng::seed_from_u64(3);
        let (mut tried, mut size) = (0, [0.0; 2]);
        for _ in 0..400 {
            let lens = lenses()[rng.random_range(0..5)];
            let centre = DVec3::new(rng.random_range(-0.6..0.6), rng.random_range(-0.6..0.6), 1.0) * 4.0;
            let radius = rng.random_range(0.01..0.4);
            let tangents = [centre.x / centre.z, centre.y / centre.z].map(|tangent: f64| {
                let reach = radius * (1.0 + tangent.abs()) / (centre.z - radius);
                [tangent - reach, tangent + reach]
            });
            let Some(places) = distorted(&lens, tangents) else { continue };
            tried += 1;
            for axis in 0..2 {
                size[0] += tangents[axis][1] - tangents[axis][0];
                size[1] += places[axis][1] - places[axis][0];
            }
            for _ in 0..60 {
                let on =
                    DVec3::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0));
                let place = lens.place(centre + radius * on.normalize()).unwrap();
                let inside = (0..2).all(|axis| (places[axis][0]..=places[axis][1]).contains(&place[axis]));
                assert!(inside, "{lens:?} {centre} {radius}: {place:?} {places:?}");
            }
        }
        assert!(tried > 380 && size[1] < 1.7 * size[0], "{tried} {size:?}");
        // Beyond the fold, and close to it.
        let barrel = Lens::Brown { k: [-0.5, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
        assert_eq!(distorted(&barrel, [[0.7, 0.9], [-0.1, 0.1]]), None);
        assert_eq!(distorted(&barrel, [[0.75, 0.81], [-0.03, 0.03]]), None);
    }

    #[test]
    fn carving_through_a_lens_leaves_as_much_as_a_pinhole() {
        let kept = |lens: Lens| {
            let views = [view(DVec3::new(0.0, 0.0, 10.0), DVec3::Y), view(DVec3::new(10.0, 0.0, 0.0), DVec3::Y)];
            let views = views.map(|frame| {
                // The same silhouette, seen through the lens.
                let camera = Camera { lens, ..frame.camera.clone() };
                let mut image = Image::new(60, 60, 4);
                for y in 0..60 {
                    for x in 0..60 {
                        let place = [x, y].map(|i| (i as f64 + 0.5 - 30.0) / camera.focal[0]);
                        let from =
                            lens.direction(place).map(|d| [d.x / d.z, d.y / d.z].map(|t| 30.0 + camera.focal[0] * t));
                        let is_object = from.is_some_and(|from| from.iter().all(|at| (20.0..40.0).contains(at)));
                        image.pixel_mut(x, y)[3] = if is_object { 0.01 } else { 0.0 };
                    }
                }
                Frame { camera, image: image.into(), ..frame }
            });
            let config = OccupancyConfig { resolution: 64, ..OccupancyConfig::default() };
            let mut grid = OccupancyGrid::new([DVec3::splat(-1.5), DVec3::splat(1.5)], &config).unwrap();
            let views: Vec<_> = views.iter().map(|frame| Silhouette::new(frame).unwrap()).collect();
            carve_views(&mut grid, &views, 1);
            for axis in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().flat_map(|axis| [axis, -axis]) {
                assert!(grid.is_occupied(0.8 * axis), "{lens:?}: {axis} is the object's");
            }
            grid.occupied_share()
        };
        let pinhole = kept(Lens::Pinhole);
        for lens in lenses() {
            let share = kept(lens);
            assert!((pinhole..1.2 * pinhole).contains(&share), "{lens:?}: {share}, and {pinhole} without a lens");
        }
    }

    #[test]
    fn carving_with_two_votes_ignores_a_wrong_mask() {
        // Sixteen cameras around the box; the image of one is entirely transparent.
        let around = |i: usize| {
            let angle = i as f64 * std::f64::consts::TAU / 16.0;
            view(DVec3::new(10.0 * angle.cos(), 0.0, 10.0 * angle.sin()), DVec3::Y)
        };
        let left = |wrong: Option<usize>, votes: u32| {
            let mut views: Vec<_> = (0..16).map(around).collect();
            if let Some(wrong) = wrong {
                views[wrong].image = Image::new(60, 60, 4).into();
            }
            let config = OccupancyConfig { resolution: 32, ..OccupancyConfig::default() };
            let mut grid = OccupancyGrid::new([DVec3::splat(-1.5), DVec3::splat(1.5)], &config).unwrap();
            let views: Vec<_> = views.iter().map(|frame| Silhouette::new(frame).unwrap()).collect();
            carve_views(&mut grid, &views, votes);
            grid.occupied_share()
        };
        let [right, two] = [1, 2].map(|votes| left(None, votes));
        assert!(right > 0.1 && (right..1.3 * right).contains(&two), "{right} {two}");
        assert!(left(Some(5), 1) < 0.3 * right, "one mask takes what it sees");
        assert!(left(Some(5), 2) >= right);
        assert_eq!((left(Some(5), 0), left(None, 99)), (1.0, two), "of sixteen two are asked for, at most");
    }
}
