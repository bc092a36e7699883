//! The bulldozer in an unbounded landscape: a plane with scenery, hills on the horizon, and a sky.

use glam::{DVec3, Vec3Swizzles};
use raygrad_tensor::parallel;

use super::Scene;
use super::bvh::{Bvh, Hit};
use super::form::Placed;
use super::paint::{Paint, ground, sky, through_air};
use super::render::Pattern;
use super::scenery::{self, GROUND};
use super::shade::{self, Material};
use raygrad_autograd::Formula;
use raygrad_nerf::Image;
use raygrad_nerf::SrgbEncode;
use raygrad_nerf::{Camera, Ray};

/// The roughness of everything but the bulldozer.
const ROUGHNESS: f64 = 0.95;
/// The largest factor by which a slanted surface enlarges the footprint of a pixel on solids.
const STEEPEST: f64 = 8.0;
/// The bulldozer occludes the sky on the ground up to this distance from the origin, in scene units.
const DIMMED: f64 = 2.0;

/// The [bulldozer](Scene::bulldozer) on a plane that reaches to hills a thousand units away, under an infinitely
/// distant sky.
///
/// Everything is analytic, so distances are exact to rounding. Trees, houses, rocks and towers stand at distances that
/// grow by a constant factor, and so do their sizes: near and far ones cover about as many pixels. The ground has
/// detail of every size, filtered to the pixel, so that nothing flickers between views.
#[derive(Debug, Clone)]
pub struct Landscape {
    bulldozer: Scene,
    scenery: Bvh<Placed>,
    /// The solids of the scenery with their paints, by their indices in `scenery`.
    things: Vec<(Placed, Paint)>,
}

impl Default for Landscape {
    fn default() -> Self {
        Self::new()
    }
}

/// The hit of a ray.
enum Part<'a> {
    Bulldozer(&'a Material),
    Thing(&'a (Placed, Paint)),
    Ground,
}

impl Landscape {
    /// Creates the landscape.
    pub fn new() -> Self {
        let things = scenery::solids();
        let scenery = Bvh::new(things.iter().map(|(solid, _)| solid.clone()).collect());
        Landscape { bulldozer: Scene::bulldozer(), scenery, things }
    }

    /// Returns the lower and upper corner of the bulldozer's bounding box, in scene units.
    pub fn bulldozer_bounds(&self) -> [DVec3; 2] {
        self.bulldozer.bounds()
    }

    /// Height of the ground in scene units: the plane `z = GROUND`.
    pub const GROUND: f64 = GROUND;

    /// Finds the first surface along a ray; returns `None` if it leaves into the sky.
    ///
    /// [`Hit::solid`] counts the solids of the bulldozer as in [its own scene](Scene), then all others, and the ground
    /// last.
    pub fn trace(&self, ray: &Ray) -> Option<Hit> {
        let first = self.bulldozer.materials.len();
        let height = ray.origin.z - GROUND;
        let distance = -height / ray.direction.z;
        // The ground has no lower side, and a ray that starts on it must not hit it at a distance of rounding.
        let mut nearest = (height > 0.0 && ray.direction.z < 0.0).then_some(Hit {
            distance,
            normal: DVec3::Z,
            solid: first + self.things.len(),
        });
        let limit = |nearest: Option<Hit>| nearest.map_or(f64::INFINITY, |hit| hit.distance);
        nearest = self.bulldozer.bvh.trace_before(ray, limit(nearest)).or(nearest);
        let thing = self.scenery.trace_before(ray, limit(nearest));
        thing.map(|hit| Hit { solid: first + hit.solid, ..hit }).or(nearest)
    }

    fn part(&self, hit: &Hit) -> Part<'_> {
        let bulldozer = &self.bulldozer.materials;
        match bulldozer.get(hit.solid) {
            Some(material) => Part::Bulldozer(material),
            None => self.things.get(hit.solid - bulldozer.len()).map_or(Part::Ground, Part::Thing),
        }
    }

    /// Renders the landscape with `samples` rays per pixel, as [`Scene::render`], before a sky: three sRGB channels, 0
    /// to 1, with the same bits on any number of threads.
    ///
    /// # Panics
    /// If `samples` is 0.
    pub fn render(&self, camera: &Camera, samples: usize) -> Image {
        assert!(samples > 0, "`samples` must be at least 1");
        let pattern = Pattern::new(samples);
        rows(camera, 3, |column, row, out| out.copy_from_slice(&self.pixel(camera, column, row, &pattern)))
    }

    /// Computes exact distances: one channel, along the unit ray through each pixel's centre, in scene units; 0 for the
    /// sky, as in [`View::depth`](super::View::depth).
    pub fn distances(&self, camera: &Camera) -> Image {
        rows(camera, 1, |column, row, out| {
            out[0] = self.trace(&camera.pixel_ray(column, row)).map_or(0.0, |hit| hit.distance as f32);
        })
    }

    /// The mean colour of a pixel.
    fn pixel(&self, camera: &Camera, column: usize, row: usize, pattern: &Pattern) -> [f32; 3] {
        let samples = pattern.0.len() as f64;
        // The angle of a pixel in radians, slightly too large towards the edges of the image.
        let angle = 1.0 / camera.focal[0].min(camera.focal[1]);
        let mut sum = DVec3::ZERO;
        let mut last: Option<(Hit, f64)> = None;
        let mut behind: Option<DVec3> = None;
        for &(offset, sun) in &pattern.0 {
            let ray = camera.ray(column as f64 + 0.5 + offset.x, row as f64 + 0.5 + offset.y);
            let Some(hit) = self.trace(&ray) else {
                // The sky is filtered to the pixel, so one ray is enough.
                sum += *behind.get_or_insert_with(|| sky(ray.direction, shade::sun_direction(0, 1), angle));
                continue;
            };
            let point = ray.at(hit.distance);
            let slant = -hit.normal.dot(ray.direction);
            let (material, openness) = match self.part(&hit) {
                Part::Bulldozer(material) => (*material, self.bulldozer.openness(&hit, point, &mut last)),
                Part::Thing((solid, paint)) => {
                    let footprint = hit.distance * angle / slant.max(1.0 / STEEPEST);
                    let local = solid.local(point);
                    let albedo = paint.albedo(local, footprint / solid.scale);
                    // Near the ground less of the sky is visible.
                    (Material { albedo, roughness: ROUGHNESS }, 0.6 + 0.4 * (local.z / 0.4).clamp(0.0, 1.0))
                }
                Part::Ground => {
                    let across = hit.distance * angle;
                    // The rays of a pixel have different heights, so each takes its share of the footprint's length.
                    let along = across * (1.0 / (slant * samples)).max(1.0);
                    let albedo = ground(point.xy(), ray.direction.xy().normalize_or_zero(), [along, across]);
                    let near = point.xy().length() < DIMMED;
                    let openness = if near { self.bulldozer.openness(&hit, point, &mut last) } else { 1.0 };
                    (Material { albedo, roughness: ROUGHNESS }, openness)
                }
            };
            let occluded = |ray: &Ray| self.bulldozer.bvh.occluded(ray) || self.scenery.occluded(ray);
            let light = shade::radiance(occluded, &material, &ray, &hit, sun, openness);
            // Clamped before the mean: otherwise the edge of a highlight would be jagged.
            sum += through_air(light, hit.distance).clamp(DVec3::ZERO, DVec3::ONE);
        }
        (sum / samples).to_array().map(|c| SrgbEncode.f([c]) as f32)
    }
}

/// Fills the pixels of an image by column and row; rows run in parallel.
fn rows(camera: &Camera, channels: usize, fill: impl Fn(usize, usize, &mut [f32]) + Sync) -> Image {
    let mut image = Image::new(camera.width, camera.height, channels);
    if camera.width > 0 {
        parallel::each_of(image.data.chunks_mut(channels * camera.width), |row, values| {
            values.chunks_mut(channels).enumerate().for_each(|(column, value)| fill(column, row, value));
        });
    }
    image
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use glam::DVec2;

    use super::super::form::Form;
    use super::super::walk_cameras;
    use super::*;
    use raygrad_nerf::dataset::Split;

    /// The rays through the pixels of all views of a split.
    fn rays(split: Split, width: usize) -> Vec<Ray> {
        let each = |camera: Camera| {
            let pixels = (0..camera.width * camera.height).map(move |i| [i % camera.width, i / camera.width]);
            pixels.map(move |[column, row]| camera.pixel_ray(column, row))
        };
        walk_cameras(split, width).into_iter().flat_map(each).collect()
    }

    #[test]
    fn landscape_ground_is_at_known_distances() {
        let landscape = Landscape::new();
        // Downwards along the sides of a 3-4-5 triangle.
        for (height, distance) in [(1.0, 1.25), (2.0, 2.5), (4.0, 5.0)] {
            let origin = DVec3::new(2.0, -2.0, GROUND + height);
            let hit = landscape.trace(&Ray { origin, direction: DVec3::new(0.36, -0.48, -0.8) }).unwrap();
            assert!((hit.distance - distance).abs() < 1e-12 && hit.normal == DVec3::Z, "{hit:?}");
        }
        let mut far = 0;
        for ray in rays(Split::Val, 40) {
            let Some(hit) = landscape.trace(&ray) else { continue };
            if let Part::Ground = landscape.part(&hit) {
                assert!((ray.at(hit.distance).z - GROUND).abs() < 1e-12, "{hit:?}");
                far += usize::from(hit.distance > 100.0);
            }
        }
        assert!(far > 20, "{far}");
    }

    #[test]
    fn landscape_balls_are_at_known_distances() {
        let landscape = Landscape::new();
        let eye = DVec3::new(0.0, 0.0, GROUND + 3.0);
        let [mut near, mut far, first] = [0, 0, landscape.bulldozer.materials.len()];
        for (i, (placed, _)) in landscape.things.iter().enumerate() {
            let Form::Ellipsoid { centre, radii } = placed.form else { continue };
            if radii != DVec3::splat(0.5) {
                continue;
            }
            // Balls lie on the ground.
            assert_eq!(centre, DVec3::new(0.0, 0.0, 0.5));
            let (middle, radius) = (placed.base + placed.scale * centre, 0.5 * placed.scale);
            assert!((middle.z - radius - GROUND).abs() < 1e-12 * radius.max(1.0));
            let away = middle - eye;
            let hit = landscape.trace(&Ray { origin: eye, direction: away.normalize() }).unwrap();
            assert!(hit.distance < away.length() - radius + 1e-9);
            if hit.solid == first + i {
                assert!((hit.distance - (away.length() - radius)).abs() < 1e-9, "{hit:?}");
                if away.length() < 20.0 { near += 1 } else { far += 1 }
            }
        }
        assert!(near > 0 && far > 0, "{near} {far}");
    }

    #[test]
    fn landscape_bulldozer_equals_its_own_scene() {
        let (landscape, alone) = (Landscape::new(), Scene::bulldozer());
        let mut seen = 0;
        for camera in &walk_cameras(Split::Val, 64)[..4] {
            let (outside, inside) = (landscape.render(camera, 3), alone.render(camera, 3));
            let distances = landscape.distances(camera);
            for i in 0..64 * 48 {
                if inside.color.data[4 * i + 3] < 1.0 || distances.data[i] != inside.depth.data[i] {
                    continue;
                }
                // The air in between adds almost nothing.
                let pairs = outside.data[3 * i..][..3].iter().zip(&inside.color.data[4 * i..][..3]);
                assert!(pairs.into_iter().all(|(a, b)| (a - b).abs() < 0.02), "pixel {i}");
                seen += 1;
            }
        }
        assert!(seen > 600, "{seen}");
    }

    #[test]
    fn landscape_is_equal_on_any_number_of_threads() {
        let camera = &walk_cameras(Split::Test, 40)[7];
        let render = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let bits = |image: Image| image.data.into_iter().map(f32::to_bits).collect::<Vec<_>>();
            pool.install(|| {
                let landscape = Landscape::new();
                [bits(landscape.render(camera, 5)), bits(landscape.distances(camera))]
            })
        };
        let serial = render(1);
        assert!(serial == render(2) && serial == render(2));
    }

    /// The cameras see surfaces at all distances, and the sky.
    #[test]
    fn landscape_views_see_all_distances_and_the_sky() {
        let landscape = Landscape::new();
        let all = rays(Split::Train, 40);
        let distances: Vec<_> = all.iter().map(|ray| landscape.trace(ray).map(|hit| hit.distance)).collect();
        let share = |low: f64, high: f64| {
            let within = distances.iter().flatten().filter(|d| (low..high).contains(*d)).count();
            within as f64 / all.len() as f64
        };
        let bands = [0.0, 8.0, 20.0, 100.0, 300.0, 900.0, 1400.0];
        for (pair, least) in bands.windows(2).zip([0.3, 0.05, 0.05, 0.02, 0.02, 0.01]) {
            let share = share(pair[0], pair[1]);
            println!("{pair:?}: {share:.3}");
            assert!(share > least, "{share} of all pixels in {pair:?}");
        }
        let sky = distances.iter().filter(|d| d.is_none()).count() as f64 / all.len() as f64;
        println!("sky: {sky:.3}");
        assert!((0.1..0.5).contains(&sky), "{sky}");
        assert!(distances.iter().flatten().all(|d| (1.0..1400.0).contains(d)));
        assert!(all.iter().zip(&distances).all(|(ray, d)| d.is_some() || ray.direction.z > 0.0));
    }

    /// No camera sees past the hills to the infinite plane.
    #[test]
    fn landscape_hills_have_no_gap() {
        let landscape = Landscape::new();
        for i in 0..3600 {
            let level = DVec2::from_angle(i as f64 / 3600.0 * TAU);
            let ray = Ray { origin: DVec3::new(0.0, 0.0, 2.9), direction: level.extend(0.01).normalize() };
            let hit = landscape.trace(&ray).unwrap_or_else(|| panic!("a gap at {i}"));
            assert!(hit.distance < 1400.0, "{hit:?}");
        }
    }

    /// A ground pixel equals the mean of smaller pixels, near and far: nothing aliases.
    #[test]
    fn landscape_ground_does_not_alias() {
        let landscape = Landscape::new();
        let factor = 8;
        let (mut squares, mut count) = ([0.0, 0.0], [0, 0]);
        for camera in &walk_cameras(Split::Val, 64)[..5] {
            let large = camera.resized(64 * factor, 48 * factor);
            let (seen, truth) = (landscape.render(camera, 5), landscape.render(&large, 1).downscaled(factor));
            for (column, row) in (0..48).flat_map(|row| (0..64).map(move |column| (column, row))) {
                // Corners and centre all see the ground, so that no edge of another object is compared.
                let at = |x: f64, y: f64| landscape.trace(&camera.ray(column as f64 + x, row as f64 + y));
                let hits = [at(0.5, 0.5), at(0.0, 0.0), at(1.0, 0.0), at(0.0, 1.0), at(1.0, 1.0)];
                let ground = |hit: &Option<Hit>| hit.is_some_and(|hit| matches!(landscape.part(&hit), Part::Ground));
                let Some(first) = hits[0].filter(|_| hits.iter().all(ground)) else { continue };
                let pairs = seen.pixel(column, row).iter().zip(truth.pixel(column, row));
                let zone = usize::from(first.distance > 15.0);
                squares[zone] += pairs.map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / 3.0;
                count[zone] += 1;
            }
        }
        // Far away, stripes and shadows are finer than a pixel; five rays sample them worse than 64.
        for (zone, limit) in [0.013, 0.022].into_iter().enumerate() {
            let rms = (squares[zone] / f64::from(count[zone])).sqrt();
            println!("zone {zone}: {rms:.4} over {} pixels", count[zone]);
            assert!(count[zone] > 300 && rms < limit, "zone {zone}: {rms}");
        }
    }

    #[test]
    fn landscape_half_size_views_have_same_mean() {
        let landscape = Landscape::new();
        for camera in walk_cameras(Split::Val, 128) {
            let mean = |camera: &Camera| {
                let image = landscape.render(camera, 5);
                let sum = |channel| image.data.iter().skip(channel).step_by(3).map(|v| f64::from(*v)).sum::<f64>();
                [0, 1, 2].map(|channel| sum(channel) / (camera.width * camera.height) as f64)
            };
            let (full, half) = (mean(&camera), mean(&camera.resized(64, 48)));
            assert!((0..3).all(|i| (full[i] - half[i]).abs() < 0.006), "{full:?} {half:?}");
        }
    }
}
