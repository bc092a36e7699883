//! Shading of surfaces: glossy plastic under a soft sun and a hemispheric sky.

use std::f64::consts::PI;

use glam::{DVec2, DVec3};

use super::bvh::{Bvh, Hit};
use super::golden::GOLDEN_ANGLE;
use raygrad_nerf::Ray;

/// A diffuse material with a clear coat of some roughness.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// Diffuse reflectance, linear RGB in 0..=1.
    pub albedo: DVec3,
    /// The width of the highlight: GGX roughness, above 0 (a mirror) and up to 1 (matt).
    pub roughness: f64,
}

/// Direction to the centre of the sun, not normalised.
const SUN: DVec3 = DVec3::new(0.55, 0.50, 0.85);
/// Radius of the sun as the tangent of an angle: large, for soft shadows.
const SUN_RADIUS: f64 = 0.06;
/// Irradiance of a surface that faces the sun, linear RGB.
const SUN_COLOR: DVec3 = DVec3::new(2.65, 2.5, 2.3);
/// Irradiance of a surface that faces up, from the sky alone.
const SKY_COLOR: DVec3 = DVec3::new(1.25, 1.35, 1.45);
/// Irradiance of a surface that faces down.
const GROUND_COLOR: DVec3 = DVec3::new(0.85, 0.8, 0.72);
/// Reflectance of plastic at normal incidence (refractive index 1.5).
const F0: f64 = 0.04;
/// The distances from a surface at which others occlude it, in scene units, and the weight of each.
const OCCLUDERS: [(f64, f64); 4] = [(0.02, 0.2), (0.06, 0.25), (0.14, 0.25), (0.3, 0.2)];
/// The offset of secondary rays from the surface, well above the rounding error of a hit.
const OFFSET: f64 = 1e-6;

/// The direction to one of `count` points spread evenly over the sun's disc (Vogel's spiral).
pub fn sun_direction(index: usize, count: usize) -> DVec3 {
    let radius = SUN_RADIUS * ((index as f64 + 0.5) / count as f64).sqrt();
    let offset = radius * DVec2::from_angle(index as f64 * GOLDEN_ANGLE);
    let towards = SUN.normalize();
    let right = towards.any_orthonormal_vector();
    (towards + offset.x * right + offset.y * towards.cross(right)).normalize()
}

/// The share of the sky's light that arrives at a surface, in 0..=1: ambient occlusion.
///
/// It samples the distance field along the normal. If the field grows more slowly than the distance from the surface,
/// something is near.
pub fn openness(bvh: &Bvh, point: DVec3, normal: DVec3) -> f64 {
    let occlusion = OCCLUDERS.map(|(reach, weight)| {
        let distance = bvh.distance(point + reach * normal, reach).max(0.0);
        weight * (1.0 - distance / reach)
    });
    1.0 - occlusion.iter().sum::<f64>()
}

/// The light that a surface reflects along a ray, linear RGB. The sun is a point in the direction `sun`, and the sky is
/// dimmed by `openness`. `occluded` returns true if a ray is blocked.
pub fn radiance(
    occluded: impl Fn(&Ray) -> bool,
    material: &Material,
    ray: &Ray,
    hit: &Hit,
    sun: DVec3,
    openness: f64,
) -> DVec3 {
    let (normal, view) = (hit.normal, -ray.direction);
    let reflected = ray.direction.reflect(normal);
    let facing = normal.dot(view).max(0.0);
    let mut light =
        openness / PI * (material.albedo * sky(normal) + sheen(material.roughness, facing) * sky(reflected));
    let cosine = normal.dot(sun);
    if cosine > 0.0 && !occluded(&Ray { origin: ray.at(hit.distance) + OFFSET * normal, direction: sun }) {
        light += cosine * SUN_COLOR * (material.albedo / PI + highlight(material.roughness, normal, view, sun));
    }
    light
}

/// The irradiance from the hemisphere around a direction, linear RGB.
fn sky(direction: DVec3) -> DVec3 {
    GROUND_COLOR.lerp(SKY_COLOR, 0.5 + 0.5 * direction.z)
}

/// Fresnel reflectance of the surface towards the sky (Schlick, damped for rough surfaces).
fn sheen(roughness: f64, facing: f64) -> f64 {
    F0 + ((1.0 - roughness).max(F0) - F0) * (1.0 - facing).powi(5)
}

/// The specular part of the reflectance distribution (Cook-Torrance with GGX).
fn highlight(roughness: f64, normal: DVec3, view: DVec3, sun: DVec3) -> f64 {
    let half = (view + sun).normalize_or_zero();
    let (n_h, n_v, n_l) = (normal.dot(half).max(0.0), normal.dot(view).max(1e-4), normal.dot(sun).max(1e-4));
    let alpha_sq = roughness.powi(4);
    let distribution = alpha_sq / (PI * (n_h * n_h * (alpha_sq - 1.0) + 1.0).powi(2));
    let smith = |c: f64| c + (alpha_sq + (1.0 - alpha_sq) * c * c).sqrt();
    let fresnel = F0 + (1.0 - F0) * (1.0 - view.dot(half).max(0.0)).powi(5);
    distribution * fresnel / (smith(n_v) * smith(n_l))
}

#[cfg(test)]
mod tests {
    use super::super::shape::Shape;
    use super::*;

    /// A white floor.
    fn floor() -> Bvh {
        Bvh::new(vec![Shape::cuboid(DVec3::new(-9.0, -9.0, -1.0), DVec3::new(9.0, 9.0, 0.0))])
    }

    /// The light from the origin on the floor to a viewer in the given direction.
    fn seen_from(viewer: DVec3, roughness: f64) -> DVec3 {
        let ray = Ray { origin: 4.0 * viewer, direction: -viewer };
        let (bvh, material) = (floor(), Material { albedo: DVec3::splat(0.5), roughness });
        let hit = bvh.trace(&ray).unwrap();
        radiance(
            |ray| bvh.occluded(ray),
            &material,
            &ray,
            &hit,
            SUN.normalize(),
            openness(&bvh, ray.at(hit.distance), hit.normal),
        )
    }

    #[test]
    fn highlight_depends_on_the_viewer() {
        let mirror = DVec3::new(-SUN.x, -SUN.y, SUN.z).normalize();
        let (facing, away) = (seen_from(mirror, 0.3), seen_from(SUN.normalize(), 0.3));
        assert!(facing.min_element() > away.max_element() + 0.3, "{facing} against {away}");
    }

    /// The sun's specular reflection conserves energy: its integral over the viewers is below 1.
    #[test]
    fn highlight_conserves_energy() {
        let n = 400;
        for roughness in [0.2, 0.3, 0.6, 1.0] {
            for elevation in [0.2f64, 0.7, 1.3] {
                let sun = DVec3::new(elevation.cos(), 0.0, elevation.sin());
                let cells = (0..n * n).map(|i| {
                    let (z, azimuth) = ((i / n) as f64 + 0.5, (i % n) as f64 + 0.5);
                    let (z, azimuth) = (z / n as f64, azimuth / n as f64 * 2.0 * PI);
                    let plane = (1.0 - z * z).sqrt() * DVec2::from_angle(azimuth);
                    z * highlight(roughness, DVec3::Z, plane.extend(z), sun)
                });
                let reflected = cells.sum::<f64>() * 2.0 * PI / (n * n) as f64;
                assert!((0.01..1.0).contains(&reflected), "{reflected} at roughness {roughness}");
            }
        }
    }

    #[test]
    fn highlight_is_reciprocal_and_finite() {
        let (a, b) = (DVec3::new(0.6, 0.0, 0.8), DVec3::new(0.0, -0.8, 0.6));
        let (there, back) = (highlight(0.3, DVec3::Z, a, b), highlight(0.3, DVec3::Z, b, a));
        assert!((there - back).abs() < 1e-15 * there.abs().max(1.0));
        assert!(highlight(0.3, DVec3::Z, DVec3::X, DVec3::NEG_X).is_finite());
    }

    #[test]
    fn shadows_and_crevices_are_dark() {
        let open = floor();
        assert_eq!(openness(&open, DVec3::ZERO, DVec3::Z), 1.0);
        let wall = Shape::cuboid(DVec3::new(0.01, -9.0, 0.0), DVec3::new(1.0, 9.0, 9.0));
        let bvh = Bvh::new(vec![Shape::cuboid(DVec3::new(-9.0, -9.0, -1.0), DVec3::new(9.0, 9.0, 0.0)), wall]);
        let near = openness(&bvh, DVec3::ZERO, DVec3::Z);
        assert!((0.1..0.6).contains(&near), "{near}");
        assert!(near < openness(&bvh, DVec3::new(-0.1, 0.0, 0.0), DVec3::Z));
        let material = Material { albedo: DVec3::splat(0.5), roughness: 0.3 };
        let ray = Ray { origin: DVec3::new(-0.1, 0.0, 3.0), direction: DVec3::NEG_Z };
        let light = |bvh: &Bvh| {
            let hit = bvh.trace(&ray).unwrap();
            radiance(|ray| bvh.occluded(ray), &material, &ray, &hit, SUN.normalize(), 1.0)
        };
        assert!(light(&bvh).max_element() < 0.6 * light(&open).min_element());
    }

    #[test]
    fn sun_directions_fill_a_disc() {
        let directions: Vec<_> = (0..64).map(|i| sun_direction(i, 64)).collect();
        assert!(directions.iter().all(|d| (d.length() - 1.0).abs() < 1e-12));
        assert!(directions.iter().all(|d| d.angle_between(SUN) < SUN_RADIUS));
        assert!((directions.iter().sum::<DVec3>() / 64.0).distance(SUN.normalize()) < 0.1 * SUN_RADIUS);
    }
}
