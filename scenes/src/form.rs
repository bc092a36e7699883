//! The solids of the landscape: round and angular forms, rotated, scaled and placed.

use glam::{DVec2, DVec3, Vec3Swizzles};

use super::shape::{Shape, Surface};
use raygrad_nerf::Ray;

/// A convex solid.
#[derive(Debug, Clone, PartialEq)]
pub enum Form {
    /// A box, a cylinder or a prism.
    Extrusion(Shape),
    /// A ball, stretched along the coordinate axes.
    Ellipsoid {
        /// Its centre.
        centre: DVec3,
        /// Half its extent along each axis, positive.
        radii: DVec3,
    },
    /// An upright cone.
    Cone {
        /// The centre of the disc that it stands on.
        base: DVec3,
        /// The radius of that disc.
        radius: f64,
        /// The height of the tip above it.
        height: f64,
    },
}

impl Surface for Form {
    fn intersect(&self, ray: &Ray) -> Option<(f64, DVec3)> {
        match self {
            Form::Extrusion(shape) => shape.intersect(ray),
            Form::Ellipsoid { centre, radii } => {
                let (o, d) = ((ray.origin - centre) / radii, ray.direction / radii);
                let dd = d.length_squared();
                // The discriminant, written without the cancellation of b^2 - ac.
                let root = dd - o.cross(d).length_squared();
                if root < 0.0 {
                    return None;
                }
                let (middle, half) = (-o.dot(d) / dd, root.sqrt() / dd);
                let t = if middle - half > 0.0 { middle - half } else { middle + half };
                (t > 0.0).then(|| (t, ((o + t * d) / radii).normalize()))
            }
            Form::Cone { base, radius, height } => cone(ray, base + height * DVec3::Z, *radius, *height),
        }
    }

    fn bounds(&self) -> [DVec3; 2] {
        match self {
            Form::Extrusion(shape) => shape.bounds(),
            Form::Ellipsoid { centre, radii } => [centre - radii, centre + radii],
            Form::Cone { base, radius, height } => {
                let side = DVec2::splat(*radius);
                [base - side.extend(0.0), base + side.extend(*height)]
            }
        }
    }
}

/// The first intersection of a ray with the upright cone below `tip`.
fn cone(ray: &Ray, tip: DVec3, radius: f64, height: f64) -> Option<(f64, DVec3)> {
    let (o, d) = (ray.origin - tip, ray.direction);
    let slope = (radius / height).powi(2);
    // The lateral surface satisfies x^2 + y^2 = slope z^2; the half with z below 0 is the cone.
    let form = |a: DVec3, b: DVec3| a.xy().dot(b.xy()) - slope * a.z * b.z;
    let (a, b, c) = (form(d, d), form(o, d), form(o, o));
    let mut nearest: Option<(f64, DVec3)> = None;
    let mut meet = |t: f64, normal: DVec3| {
        if t > 0.0 && nearest.is_none_or(|(first, _)| t < first) {
            nearest = Some((t, normal));
        }
    };
    let root = b * b - a * c;
    if root >= 0.0 {
        // The larger numerator of the two roots does not cancel and gives both roots. For a ray along the surface a is
        // 0. One root is then infinite or NaN and fails the comparison.
        let q = -(b + root.sqrt().copysign(b));
        for t in [q / a, c / q] {
            let point = o + t * d;
            if (-height..0.0).contains(&point.z) {
                meet(t, point.xy().extend(-slope * point.z).normalize());
            }
        }
    }
    let t = (-height - o.z) / d.z;
    if (o + t * d).xy().length_squared() <= radius * radius {
        meet(t, DVec3::NEG_Z);
    }
    nearest
}

/// A form with a rotation around the vertical, a scale and a position, applied in this order.
#[derive(Debug, Clone, PartialEq)]
pub struct Placed {
    /// The form before the transform.
    pub form: Form,
    /// The position of its origin.
    pub base: DVec3,
    /// Cosine and sine of the angle of rotation.
    pub turn: DVec2,
    /// The scale factor, positive.
    pub scale: f64,
}

impl Placed {
    /// Transforms a point of the scene into the coordinates of the form.
    pub fn local(&self, point: DVec3) -> DVec3 {
        self.turned_back(point - self.base) / self.scale
    }

    fn turned_back(&self, v: DVec3) -> DVec3 {
        DVec2::new(self.turn.dot(v.xy()), self.turn.perp_dot(v.xy())).extend(v.z)
    }

    fn turned(&self, v: DVec3) -> DVec3 {
        self.turn.rotate(v.xy()).extend(v.z)
    }
}

impl Surface for Placed {
    fn intersect(&self, ray: &Ray) -> Option<(f64, DVec3)> {
        let local = Ray { origin: self.local(ray.origin), direction: self.turned_back(ray.direction) };
        let (t, normal) = self.form.intersect(&local)?;
        Some((t * self.scale, self.turned(normal)))
    }

    fn bounds(&self) -> [DVec3; 2] {
        let corners = self.form.bounds();
        let place = |i: usize| {
            let pick = |axis: usize| corners[i >> axis & 1][axis];
            self.base + self.scale * self.turned(DVec3::new(pick(0), pick(1), pick(2)))
        };
        (1..8).fold([place(0); 2], |[low, high], i| [low.min(place(i)), high.max(place(i))])
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::shape::tests::ray;
    use super::*;

    /// A signed distance along the vertical or the radius, relative to the solid: 0 on the surface, below 0 inside.
    fn implicit(form: &Form, point: DVec3) -> f64 {
        match form {
            Form::Extrusion(shape) => shape.distance(point),
            Form::Ellipsoid { centre, radii } => ((point - centre) / radii).length() - 1.0,
            Form::Cone { base, radius, height } => {
                let up = (point.z - base.z) / height;
                (point.xy().distance(base.xy()) / radius - (1.0 - up)).max(-up)
            }
        }
    }

    fn placed() -> impl Strategy<Value = Placed> {
        let point = || (-0.5..0.5f64, -0.5..0.5f64, -0.5..0.5f64).prop_map(DVec3::from);
        let size = || (0.2..1.0f64, 0.2..1.0f64, 0.2..1.0f64).prop_map(DVec3::from);
        let form = prop_oneof![
            (point(), size()).prop_map(|(a, b)| Form::Extrusion(Shape::cuboid(a, a + b))),
            (point(), size()).prop_map(|(centre, radii)| Form::Ellipsoid { centre, radii }),
            (point(), size()).prop_map(|(base, s)| Form::Cone { base, radius: s.x, height: s.y }),
        ];
        (form, point(), 0.0..7.0f64, 0.3..3.0f64).prop_map(|(form, base, angle, scale)| Placed {
            form,
            base,
            turn: DVec2::from_angle(angle),
            scale,
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]
        #[test]
        fn solids_are_hit_at_their_first_surface(placed in placed(), ray in ray()) {
            let at = |t: f64| implicit(&placed.form, placed.local(ray.at(t)));
            let hit = placed.intersect(&ray);
            let inside = at(0.0) < 0.0;
            if let Some((t, normal)) = hit {
                prop_assert!(t > 0.0 && at(t).abs() < 1e-9, "{}", at(t));
                prop_assert!((normal.length() - 1.0).abs() < 1e-12);
                prop_assert!((normal.dot(ray.direction) > 0.0) == inside);
                // The normal points out of the solid.
                let step = 1e-5 * placed.scale;
                let out = |side: f64| implicit(&placed.form, placed.local(ray.at(t) + side * step * normal));
                prop_assert!(out(1.0) > 0.0, "{}", out(1.0));
                if let Form::Ellipsoid { .. } = placed.form {
                    // A tangential step leaves the surface by its square only.
                    let aside = step * normal.any_orthonormal_vector();
                    let sides = [aside, normal.cross(aside)].map(|u| implicit(&placed.form, placed.local(ray.at(t) + u)));
                    prop_assert!(sides.iter().all(|side| side.abs() < 1e-7), "{sides:?}");
                }
                let [low, high] = placed.bounds();
                prop_assert!(ray.at(t).cmpge(low - 1e-9).all() && ray.at(t).cmple(high + 1e-9).all());
            }
            let end = hit.map_or(20.0, |(t, _)| t);
            for i in 0..200 {
                let outwards = at(end * i as f64 / 200.0) * if inside { -1.0 } else { 1.0 };
                prop_assert!(outwards > -1e-9, "{outwards}");
            }
        }
    }

    #[test]
    fn solids_are_hit_at_known_distances() {
        let ball = Form::Ellipsoid { centre: DVec3::new(0.0, 0.0, 2.0), radii: DVec3::ONE };
        let cone = Form::Cone { base: DVec3::ZERO, radius: 1.0, height: 2.0 };
        let place =
            |form, scale| Placed { form, base: DVec3::new(100.0, 0.0, 0.0), turn: DVec2::from_angle(0.3), scale };
        let along = |z: f64| Ray { origin: DVec3::new(0.0, 0.0, z), direction: DVec3::X };
        for (form, scale, z, distance) in [
            (&ball, 10.0, 20.0, 90.0),
            // A chord of the ball at 6 from its centre has half the length sqrt(10^2 - 6^2) = 8.
            (&ball, 10.0, 26.0, 92.0),
            (&cone, 10.0, 10.0, 95.0),
            (&cone, 10.0, 5.0, 92.5),
        ] {
            let (t, _) = place(form.clone(), scale).intersect(&along(z)).unwrap();
            assert!((t - distance).abs() < 1e-10, "{form:?}: {t}");
            assert!(place(form.clone(), scale).intersect(&along(41.0)).is_none());
        }
        // Straight down through the side near the tip, and up through the base.
        let down = Ray { origin: DVec3::new(0.25, 0.0, 5.0), direction: DVec3::NEG_Z };
        assert!((cone.intersect(&down).unwrap().0 - 3.5).abs() < 1e-12);
        let up = Ray { origin: DVec3::new(0.25, 0.0, -5.0), direction: DVec3::Z };
        assert_eq!(cone.intersect(&up), Some((5.0, DVec3::NEG_Z)));
    }
}
