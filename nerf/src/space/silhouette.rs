//! Visual hull carving: a fully transparent pixel shows that its ray is empty.

use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::dataset::{Dataset, Frame};
use crate::space::occupancy::OccupancyGrid;
use glam::{DAffine3, DVec3};
use raygrad_tensor::parallel;

/// The margin in pixels that must be transparent too: the footprint of the image's filter.
const MARGIN: f64 = 1.5;

/// The silhouette of one image, as a pinhole sees it.
struct Silhouette {
    world_to_camera: DAffine3,
    /// The columns and rows.
    size: [usize; 2],
    focal: [f64; 2],
    centre: [f64; 2],
    /// The margin in pixels that must be transparent too.
    margin: f64,
    /// For each corner between pixels, row-major, the number of pixels above it and to its left that are not fully
    /// transparent.
    sums: Vec<u32>,
}

impl Silhouette {
    /// `None` if the image has no transparency, or is a panorama. `rectified` keeps the map for the next image, which
    /// usually has the same camera.
    fn new(frame: &Frame, rectified: &mut Option<Rectified>) -> Option<Self> {
        let Frame { camera, image, mask, .. } = frame;
        if !image.has_alpha() || camera.lens == Lens::Equirectangular {
            return None;
        }
        let size = [image.width, image.height];
        let is_opaque = |x: usize, y: usize| {
            let used = mask.as_ref().is_none_or(|mask| mask.uses(x, y));
            !used || image.pixel(x, y)[3] > 0.0
        };
        let sums = sums(size, is_opaque);
        let Camera { focal, centre, .. } = *camera;
        let world_to_camera = camera.pose.inverse();
        if camera.lens == Lens::Pinhole {
            return Some(Silhouette { world_to_camera, size, focal, centre, margin: MARGIN, sums });
        }
        let known = rectified.take().filter(|map| map.is_of(camera));
        let map = rectified.insert(known.unwrap_or_else(|| Rectified::new(camera)));
        let Rectified { size, focal, centre, ref windows, .. } = *map;
        let stride = camera.width + 1;
        let is_opaque = |x: usize, y: usize| {
            windows[y * size[0] + x]
                .is_none_or(|window| !is_clear(&sums, stride, window.map(|ends| ends.map(|end| end as usize))))
        };
        let sums = self::sums(size, is_opaque);
        Some(Silhouette { world_to_camera, size, focal, centre, margin: 0.0, sums })
    }

    /// Returns true if the whole ball projects into the image, onto fully transparent pixels only.
    fn is_clear(&self, centre: DVec3, radius: f64) -> bool {
        let local = self.world_to_camera.transform_point3(centre);
        let depth = -local.z;
        if depth <= 1.01 * radius {
            return false;
        }
        let mut window = [[0; 2]; 2];
        for (axis, tangent) in [local.x / depth, -local.y / depth].into_iter().enumerate() {
            // |(x + dx) / (z + dz) - x / z| = |dx - (x / z) dz| / (z + dz) for a point of the ball.
            let reach = radius * (1.0 + tangent.abs()) / (depth - radius);
            let ends = [tangent - reach, tangent + reach].map(|t| self.centre[axis] + self.focal[axis] * t);
            let Some(ends) = pixels(ends, self.margin, self.size[axis]) else { return false };
            window[axis] = ends.map(|end| end as usize);
        }
        is_clear(&self.sums, self.size[0] + 1, window)
    }
}

/// The pixels of an interval with a margin, from the first to beyond the last; `None` if they are not all within the
/// image.
fn pixels([low, high]: [f64; 2], margin: f64, side: usize) -> Option<[u32; 2]> {
    let (low, high) = ((low - margin).floor(), (high + margin).ceil());
    (low >= 0.0 && high <= side as f64).then_some([low as u32, high as u32])
}

/// The numbers of opaque pixels above and to the left of each corner.
fn sums([width, height]: [usize; 2], is_opaque: impl Fn(usize, usize) -> bool) -> Vec<u32> {
    let stride = width + 1;
    let mut sums = vec![0; stride * (height + 1)];
    for y in 0..height {
        let mut row = 0;
        for x in 0..width {
            row += u32::from(is_opaque(x, y));
            sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + row;
        }
    }
    sums
}

/// Returns true if no pixel of the window `[[left, right], [top, bottom]]` is opaque.
fn is_clear(sums: &[u32], stride: usize, [[left, right], [top, bottom]]: [[usize; 2]; 2]) -> bool {
    let at = |x: usize, y: usize| sums[y * stride + x];
    at(right, bottom) + at(left, top) == at(left, bottom) + at(right, top)
}

/// A map from the pixels of a pinhole to those that a lens gives them, with [`MARGIN`].
struct Rectified {
    camera: Camera,
    size: [usize; 2],
    focal: [f64; 2],
    centre: [f64; 2],
    /// For each pixel of the pinhole, the window of the image; `None` if the image does not show all of it.
    windows: Vec<Option<[[u32; 2]; 2]>>,
}

/// The largest side of a rectified image, as a multiple of that of the image. It cuts the border of wide fisheyes.
const WIDEST: f64 = 1.5;

/// The least side of a rectified image, whose pixels blur a silhouette, as far as four times the resolution suffices.
const FINEST: f64 = 600.0;

impl Rectified {
    /// The pinhole covers what the image shows, at its resolution or above.
    fn new(camera: &Camera) -> Self {
        let sides = [camera.width as f64, camera.height as f64];
        let mut ends = [[0.0_f64; 2]; 2];
        // The border shows the outermost directions.
        let along = |side: usize| (0..=BORDER).map(move |i| i as f64 / BORDER as f64 * sides[side]);
        let columns = along(0).flat_map(|x| [[x, 0.0], [x, sides[1]]]);
        for place in columns.chain(along(1).flat_map(|y| [[0.0, y], [sides[0], y]])) {
            let place = [0, 1].map(|axis| (place[axis] - camera.centre[axis]) / camera.focal[axis]);
            let direction = camera.lens.nearest(place);
            for axis in 0..2 {
                let most = WIDEST * sides[axis] / camera.focal[axis];
                let tangent =
                    if direction.z > 0.0 { direction[axis] / direction.z } else { most * direction[axis].signum() };
                let tangent = tangent.clamp(-0.5 * most, 0.5 * most);
                ends[axis] = [ends[axis][0].min(tangent), ends[axis][1].max(tangent)];
            }
        }
        let focal = camera.focal.map(|focal| focal * (FINEST / sides[0].max(sides[1])).clamp(1.0, 4.0));
        let size = [0, 1].map(|axis| ((ends[axis][1] - ends[axis][0]) * focal[axis]).ceil().max(1.0) as usize);
        let centre = [0, 1].map(|axis| -ends[axis][0] * focal[axis]);
        let window = |x: usize, y: usize| {
            let tangents = |axis: usize, pixel: usize| {
                [pixel, pixel + 1].map(|corner| (corner as f64 - centre[axis]) / focal[axis])
            };
            let places = distorted(&camera.lens, [tangents(0, x), tangents(1, y)])?;
            let ends = |axis: usize| {
                let places = places[axis].map(|place| camera.centre[axis] + camera.focal[axis] * place);
                pixels(places, MARGIN, [camera.width, camera.height][axis])
            };
            Some([ends(0)?, ends(1)?])
        };
        let rows = parallel::collect(size[1], |y| (0..size[0]).map(|x| window(x, y)).collect::<Vec<_>>());
        Rectified { camera: camera.clone(), size, focal, centre, windows: rows.concat() }
    }

    /// Returns true if it holds for the camera, apart from its pose.
    fn is_of(&self, camera: &Camera) -> bool {
        Camera { pose: self.camera.pose, ..camera.clone() } == self.camera
    }
}

/// Places along each side of an image whose directions bound what it shows.
const BORDER: usize = 256;

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
    let mut rectified = None;
    let views = data.frames.iter().filter_map(|frame| Silhouette::new(frame, &mut rectified));
    carve_views(grid, &views.collect::<Vec<_>>(), votes);
}

fn carve_views(grid: &mut OccupancyGrid, views: &[Silhouette], votes: u32) {
    let votes = (votes as usize).min(views.len().div_ceil(EACH));
    if votes == 0 {
        return;
    }
    grid.carve(&|centre, radius| {
        views.iter().filter(|view| view.is_clear(centre, radius)).take(votes).count() == votes
    });
    grid.empty_carved();
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

    fn of(frame: &Frame) -> Silhouette {
        Silhouette::new(frame, &mut None).unwrap()
    }

    #[test]
    fn carving_needs_every_pixel_transparent() {
        let frame = view(DVec3::new(0.0, 0.0, 10.0), DVec3::Y);
        let silhouette = of(&frame);
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
        assert!([opaque, panorama].iter().all(|frame| Silhouette::new(frame, &mut None).is_none()));
        // Masked pixels are unknown, so they may be opaque.
        let masked = Frame { mask: Some(Mask::new(60, 60, |x, _| x < 40).into()), ..frame.clone() };
        assert!(!of(&masked).is_clear(DVec3::new(1.7, 0.0, 0.0), 0.3));
    }

    #[test]
    fn carving_by_two_views_leaves_their_intersection() {
        let views = [view(DVec3::new(0.0, 0.0, 10.0), DVec3::Y), view(DVec3::new(10.0, 0.0, 0.0), DVec3::Y)];
        let mut grid =
            OccupancyGrid::new([DVec3::splat(-1.5), DVec3::splat(1.5)], &OccupancyConfig::default()).unwrap();
        let views: Vec<_> = views.iter().map(of).collect();
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
    fn rectified_silhouettes_equal_those_of_each_lens() {
        // Wide images that are not square, off their centre, with an object in one corner.
        let frame = |lens: Lens| {
            let mut image = Image::new(90, 60, 4);
            let pose = Camera::look_at(DVec3::new(0.0, 0.0, 10.0), DVec3::ZERO, DVec3::Y);
            let camera =
                Camera { lens, focal: [80.0, 70.0], centre: [40.0, 33.0], ..Camera::from_angle(90, 60, 1.0, pose) };
            for y in 0..60 {
                for x in 0..90 {
                    let d = camera.ray(x as f64 + 0.5, y as f64 + 0.5).direction;
                    let at = [d.x / -d.z, d.y / -d.z];
                    let is_object = (0.1..0.3).contains(&at[0]) && (0.05..0.15).contains(&at[1]);
                    image.pixel_mut(x, y)[3] = f32::from(u8::from(is_object));
                }
            }
            Frame { name: String::new(), camera, image: image.into(), mask: None, distances: None }
        };
        let mut rectified = None;
        let frames = [Lens::Pinhole, lenses()[1], lenses()[1], lenses()[3]].map(frame);
        let all = frames.each_ref().map(|frame| Silhouette::new(frame, &mut rectified).unwrap());
        assert!(rectified.is_some_and(|map| map.is_of(&frames[3].camera) && !map.is_of(&frames[2].camera)));
        let (mut same, mut clear) = (0, 0);
        for i in 0..40 {
            for j in 0..40 {
                let centre = DVec3::new(-5.0 + 0.25 * i as f64, -4.0 + 0.2 * j as f64, 0.0);
                let seen = all.each_ref().map(|silhouette| silhouette.is_clear(centre, 0.1));
                same += usize::from(seen == [seen[0]; 4]);
                clear += usize::from(seen[0]);
                let at = centre / 10.0;
                let is_object = (0.1..0.3).contains(&at.x) && (0.05..0.15).contains(&at.y);
                assert!(!is_object || seen == [false; 4], "{centre}");
            }
        }
        // They differ along borders alone.
        assert!(same > 1250 && (700..1400).contains(&clear), "{same} {clear}");
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
            let views: Vec<_> = views.iter().map(of).collect();
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
            let views: Vec<_> = views.iter().map(of).collect();
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
