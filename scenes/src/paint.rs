//! Colours of the landscape: paints of its solids, the ground and the sky.

use glam::{DVec2, DVec3, Vec3Swizzles};

use super::noise::{below, fractal, stripes};
use raygrad_autograd::Formula;
use raygrad_nerf::SrgbDecode;

/// Converts sRGB codes to linear light.
pub fn linear(codes: [u8; 3]) -> DVec3 {
    codes.map(|code| SrgbDecode.f([f64::from(code) / 255.0])).into()
}

/// The distribution of two colours on a solid. Lengths are those of the solid before its
/// [placement](super::form::Placed), so that patterns scale with it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pattern {
    /// The first colour alone.
    Plain,
    /// Spots of all sizes up to this one.
    Mottled(f64),
    /// Horizontal stripes, two in this height.
    Striped(f64),
    /// Courses of bricks of this height with gaps between them.
    Courses(f64),
    /// The second colour above this height, with a ragged border.
    Above(f64),
}

/// Two diffuse colours and their pattern.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Paint {
    /// Linear RGB in 0..=1.
    pub colors: [DVec3; 2],
    /// The distribution of the colours.
    pub pattern: Pattern,
}

impl Paint {
    /// The mean colour of a solid over a pixel of the diameter `footprint` around a point.
    pub fn albedo(&self, point: DVec3, footprint: f64) -> DVec3 {
        let share = match self.pattern {
            Pattern::Plain => 0.0,
            Pattern::Mottled(size) => 0.5 + 0.7 * fractal(point, size, 4, 0.7, footprint, 3),
            Pattern::Striped(height) => 1.0 - stripes(point.z / height, footprint / height),
            // Gaps take a tenth of a course.
            Pattern::Courses(height) => {
                let line = |at: f64| stripes(at, footprint / height);
                (line(point.z / height) - line(point.z / height + 0.1)).abs()
            }
            Pattern::Above(height) => {
                let ragged = 0.35 * height * fractal(point, height, 4, 0.6, footprint, 4);
                1.0 - below(point.z - height + ragged, footprint.max(0.02 * height))
            }
        };
        let [first, second] = self.colors;
        first.lerp(second, share.clamp(0.0, 1.0))
    }
}

/// The radius of the bare earth around the bulldozer, in scene units.
const SITE: f64 = 6.0;
/// The border of the bare earth varies by less than this, in scene units.
const RAGGED: f64 = 3.0;
/// The distance of the road from the origin, in scene units, in the direction of `ROAD`.
const ROAD_DISTANCE: f64 = 9.0;
/// Half the width of the road in scene units.
const ROAD_HALF_WIDTH: f64 = 1.3;
/// The unit vector across the road.
const ROAD: DVec2 = DVec2::new(0.28, -0.96);

/// The distance of a point of the plane from the middle of the road, in scene units.
pub fn road_distance(place: DVec2) -> f64 {
    (place.dot(ROAD) - ROAD_DISTANCE).abs()
}

/// The mean colour of the ground over a pixel around a point of the plane z = 0.
///
/// On the plane the pixel is an ellipse: `footprint` long along the unit vector `along`, and `across` wide.
pub fn ground(place: DVec2, along: DVec2, [footprint, across]: [f64; 2]) -> DVec3 {
    let point = place.extend(0.0);
    // The footprint's length limits the noise; its extent across the road limits the road's edges.
    let noise = |longest: f64, octaves: usize, seed: u32| fractal(point, longest, octaves, 1.0, footprint, seed);
    let extent = ROAD.dot(along).abs() * footprint + ROAD.perp_dot(along).abs() * across;
    let fine = noise(10.0, 9, 12);
    let earth = linear([164, 134, 98]) * (1.0 + 0.3 * fine).clamp(0.3, 1.8);
    // Noise shifts the border by less than `RAGGED`.
    let from_border = place.length() - SITE;
    let bare = match from_border.abs() < RAGGED {
        true => below(from_border - 0.4 * RAGGED * noise(4.0, 5, 13), footprint.max(0.5)),
        false => below(from_border, footprint.max(0.5)),
    };
    let grass = |coarse: f64| {
        let meadow = linear([88, 124, 48]).lerp(linear([164, 158, 78]), (0.42 + 0.6 * coarse).clamp(0.0, 1.0));
        meadow * (1.0 + 0.28 * fine).clamp(0.3, 1.8)
    };
    let color = if bare < 1.0 { grass(noise(640.0, 6, 11)).lerp(earth, bare) } else { earth };
    let off = road_distance(place);
    let asphalt = linear([112, 110, 108]) * (1.0 + 0.08 * fine).clamp(0.5, 1.5);
    let verge = below(off - ROAD_HALF_WIDTH - 0.35, extent.max(0.15));
    let line = below(off - 0.06, extent);
    let marked = asphalt.lerp(linear([226, 222, 206]), line);
    color.lerp(earth * 0.9, verge).lerp(marked, below(off - ROAD_HALF_WIDTH, extent))
}

/// The colour of the sky in a direction, linear RGB, for a pixel that covers the angle `footprint` in radians.
pub fn sky(direction: DVec3, sun: DVec3, footprint: f64) -> DVec3 {
    let up = direction.z.max(0.0);
    let clear = HAZE.lerp(DVec3::new(0.13, 0.30, 0.66), 1.0 - (-5.0 * up).exp());
    let towards = direction.dot(sun).max(0.0);
    let glow = DVec3::new(0.50, 0.38, 0.20) * (0.5 * towards.powi(6) + 2.0 * towards.powi(200));
    // Clouds form a layer that is seen from below and is thin at its borders.
    let height = up + 0.1;
    let layer = direction.xy() / height;
    let n = fractal(layer.extend(0.0), 1.6, 6, 0.55, footprint * (1.0 + layer.length()) / height, 21);
    let t = ((n + 0.06) / 0.55).clamp(0.0, 1.0);
    let cover = t * t * (3.0 - 2.0 * t) * (up / 0.06).min(1.0);
    // Thick clouds are grey from below.
    let cloud = DVec3::new(0.98, 0.96, 0.94).lerp(DVec3::new(0.66, 0.69, 0.75), 0.8 * (t - 0.5).max(0.0));
    (clear + glow).lerp(cloud + 0.3 * glow, 0.85 * cover).clamp(DVec3::ZERO, DVec3::ONE)
}

/// The colour that the air adds at a distance: that of the horizon, linear RGB.
pub const HAZE: DVec3 = DVec3::new(0.60, 0.72, 0.84);
/// The distance over which the air hides a share of `1 - 1/e`, in scene units.
const CLARITY: f64 = 1600.0;

/// Attenuates light by the air and adds haze.
pub fn through_air(light: DVec3, distance: f64) -> DVec3 {
    HAZE.lerp(light, (-distance / CLARITY).exp())
}

#[cfg(test)]
mod tests {
    use super::super::noise::random;
    use super::super::scenery::GROUND;
    use super::super::walk_cameras;
    use super::*;
    use raygrad_nerf::dataset::Split;

    /// On a far pixel, five rays filtered to their share are closer to the pixel's mean than five point samples.
    #[test]
    fn landscape_far_ground_is_filtered() {
        let (mut filtered, mut points, mut count) = (0.0, 0.0, 0);
        for camera in walk_cameras(Split::Val, 400) {
            for i in 0..4000 {
                let corner = [random(i, 61) * 399.0, random(i, 62) * 299.0];
                // The colour of the ground at the hit of a ray through the pixel, with a footprint of its share.
                let color = |x: f64, y: f64, share: f64| {
                    let ray = camera.ray(corner[0] + x, corner[1] + y);
                    let distance = (GROUND - ray.origin.z) / ray.direction.z;
                    let place = ray.at(distance).xy();
                    let across = share * distance / camera.focal[0];
                    let along = across * (1.0 / (-5.0 * ray.direction.z)).max(1.0);
                    ground(place, ray.direction.xy().normalize(), [along, across])
                };
                let ray = camera.ray(corner[0] + 0.5, corner[1] + 0.5);
                let distance = (GROUND - ray.origin.z) / ray.direction.z;
                // Another test covers the edges of the road.
                if !(20.0..400.0).contains(&distance) || road_distance(ray.at(distance).xy()) < 4.0 {
                    continue;
                }
                let five = |share: f64| {
                    let offsets = [[0.5, 0.5], [0.25, 0.93], [0.75, 0.07], [0.01, 0.64], [0.99, 0.36]];
                    offsets.iter().map(|[x, y]| color(*x, *y, share)).sum::<DVec3>() / 5.0
                };
                let mean =
                    (0..400).map(|k| color(random(k, 63), (k as f64 + 0.5) / 400.0, 1e-9)).sum::<DVec3>() / 400.0;
                filtered += five(1.0).distance_squared(mean);
                points += five(1e-9).distance_squared(mean);
                count += 1;
            }
        }
        let [filtered, points] = [filtered, points].map(|sum: f64| (sum / f64::from(count)).sqrt());
        println!("{filtered:.5} and {points:.5} off over {count} pixels");
        assert!(count > 1000 && filtered < 0.02 && filtered < 0.7 * points, "{filtered} {points} over {count}");
    }
}
