//! Convex solids: a plane profile extruded along a coordinate axis.
//!
//! Boxes, cylinders and prisms are all extrusions, so one clipping routine intersects them and one formula gives their
//! distance.

use glam::{DVec2, DVec3, Vec3Swizzles};

use raygrad_nerf::Ray;

/// A surface for ray tracing.
pub trait Surface {
    /// The first intersection of a ray with the surface: its distance, positive, and the outward unit normal. A ray
    /// that starts inside hits the surface at its exit.
    fn intersect(&self, ray: &Ray) -> Option<(f64, DVec3)>;

    /// The corners of an axis-aligned box around the shape, preferably the smallest.
    fn bounds(&self) -> [DVec3; 2];
}

/// A coordinate axis, along which a profile is extruded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Axis {
    /// Extruded along x; the plane of the profile is (y, z).
    X,
    /// Extruded along y; the plane of the profile is (z, x).
    Y,
    /// Extruded along z; the plane of the profile is (x, y).
    Z,
}

impl Axis {
    /// Splits a vector into its part in the plane of the profile and its part along the axis.
    fn split(self, v: DVec3) -> (DVec2, f64) {
        match self {
            Axis::X => (v.yz(), v.x),
            Axis::Y => (v.zx(), v.y),
            Axis::Z => (v.xy(), v.z),
        }
    }

    /// The inverse of [`split`](Self::split).
    fn join(self, plane: DVec2, along: f64) -> DVec3 {
        match self {
            Axis::X => DVec3::new(along, plane.x, plane.y),
            Axis::Y => DVec3::new(plane.y, along, plane.x),
            Axis::Z => DVec3::new(plane.x, plane.y, along),
        }
    }
}

/// A convex region of the plane.
#[derive(Debug, Clone, PartialEq)]
pub enum Profile {
    /// An axis-aligned rectangle between two corners.
    Rectangle {
        /// The smaller coordinates.
        min: DVec2,
        /// The larger coordinates.
        max: DVec2,
    },
    /// A disc.
    Disc {
        /// Its centre.
        centre: DVec2,
        /// Its radius, positive.
        radius: f64,
    },
    /// A convex polygon: its corners, counter-clockwise.
    Polygon(Vec<DVec2>),
}

/// A convex solid: a profile extruded along an axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Shape {
    /// The direction of extrusion.
    pub axis: Axis,
    /// The range of the solid along the axis.
    pub span: [f64; 2],
    /// Its cross section.
    pub profile: Profile,
}

/// The part of a line inside a convex region: the entry and the exit, with outward normals of any length.
struct Chord {
    enter: (f64, DVec3),
    leave: (f64, DVec3),
}

impl Chord {
    /// Keeps the part on the inner side of the plane that the line crosses at `gap / speed`.
    ///
    /// `gap` is the distance from the ray's origin to the plane along the outward normal `normal()`. `speed` is the
    /// component of the ray's direction along it. Returns false if nothing remains. A line parallel to the plane (a
    /// speed of +0 or -0) is entirely inside or outside: dividing would give NaN for an origin on the plane.
    fn clip(&mut self, gap: f64, speed: f64, normal: impl Fn() -> DVec3) -> bool {
        if speed == 0.0 {
            return gap >= 0.0;
        }
        let t = gap / speed;
        if speed < 0.0 {
            if t > self.enter.0 {
                self.enter = (t, normal());
            }
        } else if t < self.leave.0 {
            self.leave = (t, normal());
        }
        self.enter.0 <= self.leave.0
    }
}

impl Shape {
    /// The box between two corners.
    pub fn cuboid(min: DVec3, max: DVec3) -> Self {
        let profile = Profile::Rectangle { min: min.xy(), max: max.xy() };
        Shape { axis: Axis::Z, span: [min.z, max.z], profile }
    }

    /// The cylinder of length `length` along `axis` whose lower end has its centre at `base`.
    pub fn cylinder(axis: Axis, base: DVec3, radius: f64, length: f64) -> Self {
        let (centre, start) = axis.split(base);
        Shape { axis, span: [start, start + length], profile: Profile::Disc { centre, radius } }
    }

    /// The distance from a point to the surface, negative inside.
    pub fn distance(&self, point: DVec3) -> f64 {
        let (p, along) = self.axis.split(point);
        let across = match &self.profile {
            Profile::Rectangle { min, max } => outside(((min - p).max(p - max)).to_array()),
            Profile::Disc { centre, radius } => p.distance(*centre) - radius,
            Profile::Polygon(corners) => {
                let (mut nearest, mut inside) = (f64::INFINITY, true);
                for (a, b) in edges(corners) {
                    let (edge, from) = (b - a, p - a);
                    let along = (from.dot(edge) / edge.length_squared()).clamp(0.0, 1.0);
                    nearest = nearest.min((from - along * edge).length_squared());
                    inside &= edge.perp_dot(from) >= 0.0;
                }
                if inside { -nearest.sqrt() } else { nearest.sqrt() }
            }
        };
        outside([across, (self.span[0] - along).max(along - self.span[1])])
    }
}

impl Surface for Shape {
    /// A ray within a face hits the solid.
    fn intersect(&self, ray: &Ray) -> Option<(f64, DVec3)> {
        let axis = self.axis;
        let (o, o_along) = axis.split(ray.origin);
        let (d, d_along) = axis.split(ray.direction);
        let plane = |normal: DVec2| axis.join(normal, 0.0);
        let mut chord = Chord { enter: (f64::NEG_INFINITY, DVec3::ZERO), leave: (f64::INFINITY, DVec3::ZERO) };
        if !chord.clip(o_along - self.span[0], -d_along, || axis.join(DVec2::ZERO, -1.0))
            || !chord.clip(self.span[1] - o_along, d_along, || axis.join(DVec2::ZERO, 1.0))
        {
            return None;
        }
        let crossed = match &self.profile {
            Profile::Rectangle { min, max } => {
                chord.clip(o.x - min.x, -d.x, || plane(DVec2::NEG_X))
                    && chord.clip(max.x - o.x, d.x, || plane(DVec2::X))
                    && chord.clip(o.y - min.y, -d.y, || plane(DVec2::NEG_Y))
                    && chord.clip(max.y - o.y, d.y, || plane(DVec2::Y))
            }
            Profile::Disc { centre, radius } => {
                let (from, dd) = (o - centre, d.length_squared());
                if dd == 0.0 {
                    from.length_squared() <= radius * radius
                } else {
                    // r^2 d^2 - (from x d)^2 is the discriminant without the cancellation of b^2 - ac.
                    let root = dd * radius * radius - from.perp_dot(d).powi(2);
                    if root < 0.0 {
                        return None;
                    }
                    let (middle, half) = (-from.dot(d) / dd, root.sqrt() / dd);
                    let normal = |t: f64| plane(from + t * d);
                    if middle - half > chord.enter.0 {
                        chord.enter = (middle - half, normal(middle - half));
                    }
                    if middle + half < chord.leave.0 {
                        chord.leave = (middle + half, normal(middle + half));
                    }
                    chord.enter.0 <= chord.leave.0
                }
            }
            Profile::Polygon(corners) => edges(corners).all(|(a, b)| {
                let normal = -(b - a).perp();
                chord.clip(normal.dot(a - o), normal.dot(d), || plane(normal))
            }),
        };
        let (t, normal) = if chord.enter.0 > 0.0 { chord.enter } else { chord.leave };
        (crossed && t > 0.0).then(|| (t, normal.normalize()))
    }

    fn bounds(&self) -> [DVec3; 2] {
        let [min, max] = match &self.profile {
            Profile::Rectangle { min, max } => [*min, *max],
            Profile::Disc { centre, radius } => [centre - radius, centre + radius],
            Profile::Polygon(corners) => [
                corners.iter().fold(DVec2::INFINITY, |m, c| m.min(*c)),
                corners.iter().fold(DVec2::NEG_INFINITY, |m, c| m.max(*c)),
            ],
        };
        [self.axis.join(min, self.span[0]), self.axis.join(max, self.span[1])]
    }
}

/// The edges of a closed polygon.
fn edges(corners: &[DVec2]) -> impl Iterator<Item = (DVec2, DVec2)> {
    let next = corners.iter().cycle().skip(1);
    corners.iter().zip(next).map(|(a, b)| (*a, *b))
}

/// The distance to the product of two regions, from the signed distances to each.
fn outside([a, b]: [f64; 2]) -> f64 {
    DVec2::new(a.max(0.0), b.max(0.0)).length() + a.max(b).min(0.0)
}

#[cfg(test)]
pub(crate) mod tests {
    use proptest::prelude::*;

    use super::*;

    const UNIT: [DVec2; 4] =
        [DVec2::new(-1.0, -1.0), DVec2::new(1.0, -1.0), DVec2::new(1.0, 1.0), DVec2::new(-1.0, 1.0)];

    fn vector() -> impl Strategy<Value = DVec3> {
        prop::array::uniform3(-3.0..3.0f64).prop_map(DVec3::from)
    }

    /// Rays from anywhere in (-3, 3)^3; one in three is parallel to an axis.
    pub(crate) fn ray() -> impl Strategy<Value = Ray> {
        let oblique = vector().prop_filter("no direction", |d| d.length() > 0.1).prop_map(DVec3::normalize);
        let axes = [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y, DVec3::Z, DVec3::NEG_Z];
        let direction = prop_oneof![2 => oblique, 1 => prop::sample::select(axes.to_vec())];
        (vector(), direction).prop_map(|(origin, direction)| Ray { origin, direction })
    }

    /// Every profile along every axis, about 2 in size and near the origin.
    fn shape() -> impl Strategy<Value = Shape> {
        let rectangle = (-1.0..0.0f64, -1.0..0.0f64, 0.2..1.0f64, 0.2..1.0f64)
            .prop_map(|(a, b, c, d)| Profile::Rectangle { min: DVec2::new(a, b), max: DVec2::new(c, d) });
        let disc = (-0.5..0.5f64, -0.5..0.5f64, 0.2..1.2f64)
            .prop_map(|(x, y, radius)| Profile::Disc { centre: DVec2::new(x, y), radius });
        // Points of an ellipse in order are convex.
        let polygon = (3..9usize, 0.3..1.2f64, 0.3..1.2f64, 0.0..1.0f64).prop_map(|(n, a, b, turn)| {
            let angle = |i| (i as f64 + turn) / n as f64 * std::f64::consts::TAU;
            Profile::Polygon((0..n).map(|i| DVec2::from_angle(angle(i)) * DVec2::new(a, b)).collect())
        });
        let profile = prop_oneof![rectangle, disc, polygon];
        let axis = prop::sample::select(vec![Axis::X, Axis::Y, Axis::Z]);
        (axis, -1.0..0.0f64, 0.1..1.0f64, profile).prop_map(|(axis, start, end, profile)| Shape {
            axis,
            span: [start, end],
            profile,
        })
    }

    proptest! {
        #[test]
        fn shape_hit_is_the_first_surface_point(shape in shape(), ray in ray()) {
            let hit = shape.intersect(&ray);
            let inside = shape.distance(ray.origin) < 0.0;
            if let Some((t, normal)) = hit {
                let point = ray.at(t);
                prop_assert!(t > 0.0 && shape.distance(point).abs() < 1e-9);
                prop_assert!((normal.length() - 1.0).abs() < 1e-12);
                prop_assert!((normal.dot(ray.direction) > 0.0) == inside);
                // The surface of a convex solid is nowhere closer to a point above it.
                prop_assert!((shape.distance(point + 0.5 * normal) - 0.5).abs() < 1e-7);
            }
            // Up to the hit, or without end, the ray stays on its side of the surface.
            let end = hit.map_or(10.0, |(t, _)| t);
            for i in 0..200 {
                let distance = shape.distance(ray.at(end * i as f64 / 200.0));
                let outwards = if inside { -distance } else { distance };
                prop_assert!(outwards > -1e-9, "{outwards}");
            }
        }

        #[test]
        fn shape_distance_is_to_the_nearest_point(shape in shape(), point in vector(), other in vector()) {
            let distance = shape.distance(point);
            // No surface point is nearer: rays from the point in all directions hit at `distance` or later ..
            let direction = (other - point).normalize();
            if let Some((t, _)) = shape.intersect(&Ray { origin: point, direction }) {
                prop_assert!(t >= distance.abs() - 1e-9);
            }
            // .. and one is there, along the gradient of the distance.
            let step = 1e-6;
            let slope = |e: DVec3| (shape.distance(point + step * e) - shape.distance(point - step * e)) / (2.0 * step);
            let gradient = DVec3::new(slope(DVec3::X), slope(DVec3::Y), slope(DVec3::Z));
            // Inside, the gradient is undefined where two faces are equally near.
            if distance > 0.0 || (gradient.length() - 1.0).abs() < 1e-6 {
                prop_assert!(shape.distance(point - distance * gradient).abs() < 1e-4);
            }
        }

        #[test]
        fn shape_bounds_are_tight(shape in shape()) {
            let [min, max] = shape.bounds();
            let middle = (min + max) / 2.0;
            for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
                let half = (max - min).dot(axis) / 2.0;
                // Each face of the box touches the solid.
                let [u, v] = [axis.yzx(), axis.zxy()].map(|side| (max - min) * side / 100.0);
                for side in [-1.0, 1.0] {
                    let face = middle + side * half * axis;
                    let points = (0..101 * 101).map(|i| face + (i % 101 - 50) as f64 * u + (i / 101 - 50) as f64 * v);
                    let nearest = points.map(|point| shape.distance(point)).fold(f64::INFINITY, f64::min);
                    prop_assert!((-1e-9..0.03).contains(&nearest), "{nearest}");
                }
            }
        }

        #[test]
        fn square_polygon_equals_a_box(ray in ray()) {
            let square = Shape { axis: Axis::Z, span: [-1.0, 1.0], profile: Profile::Polygon(UNIT.to_vec()) };
            let cube = Shape::cuboid(DVec3::NEG_ONE, DVec3::ONE);
            prop_assert!((square.distance(ray.origin) - cube.distance(ray.origin)).abs() < 1e-12);
            match (square.intersect(&ray), cube.intersect(&ray)) {
                (Some(a), Some(b)) => prop_assert!((a.0 - b.0).abs() < 1e-12 && a.1.distance(b.1) < 1e-12),
                (a, b) => prop_assert!(a.is_none() && b.is_none()),
            }
        }
    }

    #[test]
    fn shape_distances_are_known() {
        let cube = Shape::cuboid(DVec3::ZERO, DVec3::splat(2.0));
        let cylinder = Shape::cylinder(Axis::X, DVec3::ZERO, 1.0, 2.0);
        let corners = [[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]].map(DVec2::from).to_vec();
        let wedge = Shape { axis: Axis::Y, span: [0.0, 1.0], profile: Profile::Polygon(corners) };
        for (shape, point, distance) in [
            (&cube, [1.0, 1.0, 1.5], -0.5),
            (&cube, [1.0, 1.0, 5.0], 3.0),
            (&cube, [5.0, 6.0, 1.0], 5.0),
            (&cylinder, [1.0, 0.0, 3.0], 2.0),
            (&cylinder, [5.0, 0.0, 5.0], 5.0),
            (&cylinder, [0.75, 0.1, 0.0], -0.75),
            // Along y the profile is in the plane (z, x): z up to 3, x up to 4.
            (&wedge, [4.0, 0.5, 3.0], 2.4),
            (&wedge, [1.0, 0.5, 1.0], -0.5),
        ] {
            assert!((shape.distance(point.into()) - distance).abs() < 1e-12, "{shape:?} {point:?}");
        }
    }

    /// Rays within the plane of a face hit the solid, for either sign of zero.
    #[test]
    fn shape_hits_rays_within_faces() {
        let cube = Shape::cuboid(DVec3::NEG_ONE, DVec3::ONE);
        let square = Shape { profile: Profile::Polygon(UNIT.to_vec()), ..cube.clone() };
        let tube = Shape::cylinder(Axis::Z, DVec3::NEG_Z, 1.0, 2.0);
        for zeros in [[0.0, 0.0], [0.0, -0.0], [-0.0, 0.0], [-0.0, -0.0]] {
            let up = DVec3::new(zeros[0], zeros[1], 1.0);
            for shape in [&cube, &square, &tube] {
                for (origin, distance) in [
                    ([1.0, 0.0, -3.0], Some(2.0)),
                    ([-1.0, 0.0, -3.0], Some(2.0)),
                    ([0.0, 1.0, -3.0], Some(2.0)),
                    ([0.0, -1.0, -3.0], Some(2.0)),
                    ([0.5, 0.5, 0.25], Some(0.75)),
                    ([1.5, 0.0, -3.0], None),
                    ([0.0, -1.5, 0.0], None),
                    ([0.0, 0.0, 3.0], None),
                ] {
                    let hit = shape.intersect(&Ray { origin: origin.into(), direction: up });
                    assert_eq!(hit.map(|(t, _)| t), distance, "{shape:?} from {origin:?} along {up}");
                }
            }
        }
    }
}
