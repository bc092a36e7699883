//! A kit to build models from: coloured bricks with studs, blocks, cylinders and bars.
//!
//! Lengths are in stud pitches. A plate is 0.4 high and a brick 1.2.

use glam::{DVec2, DVec3};

use super::paint::linear;
use super::shade::Material;
use super::shape::{Axis, Profile, Shape, Surface};

/// Scene units per stud pitch.
const PITCH: f64 = 0.113;
/// The model point at the scene's origin.
const CENTRE: DVec3 = DVec3::new(1.0, 0.0, 2.1);
/// Height of a plate.
pub const PLATE: f64 = 0.4;
/// Height of a brick.
pub const BRICK: f64 = 1.2;
/// Bricks are smaller than their grid by this much on each side and on top, which leaves visible seams.
const GAP: f64 = 0.03;

/// A colour as sRGB codes, and its roughness: see [`Material`].
#[derive(Clone, Copy)]
pub struct Paint([u8; 3], f64);

const PLASTIC: f64 = 0.3;
const RUBBER: f64 = 0.6;
pub const YELLOW: Paint = Paint([250, 188, 10], PLASTIC);
pub const BLACK: Paint = Paint([38, 38, 40], RUBBER);
pub const DARK: Paint = Paint([72, 76, 80], PLASTIC);
pub const GREY: Paint = Paint([160, 165, 170], PLASTIC);
pub const GREEN: Paint = Paint([60, 140, 72], PLASTIC);
pub const RED: Paint = Paint([196, 28, 24], PLASTIC);
pub const BLUE: Paint = Paint([24, 92, 178], PLASTIC);
pub const WHITE: Paint = Paint([240, 240, 236], PLASTIC);
pub const ORANGE: Paint = Paint([236, 104, 16], PLASTIC);
pub const TAN: Paint = Paint([196, 164, 112], PLASTIC);
pub const BROWN: Paint = Paint([112, 66, 36], PLASTIC);

impl Paint {
    fn material(self) -> Material {
        Material { albedo: linear(self.0), roughness: self.1 }
    }
}

/// Solids in scene units; methods take stud pitches. Coordinates are x forwards, y to the left and z up.
#[derive(Default)]
pub struct Model {
    solids: Vec<(Shape, Material)>,
    studs: Vec<(Shape, Material)>,
}

impl Model {
    /// A block without studs between two corners.
    pub fn block(&mut self, paint: Paint, min: [f64; 3], max: [f64; 3]) {
        self.solids.push((Shape::cuboid(place(min), place(max)), paint.material()));
    }

    /// A brick with its smallest corner at `corner`, `size` studs long and wide, with studs on top.
    pub fn brick(&mut self, paint: Paint, corner: [f64; 3], size: [usize; 2], height: f64) {
        let [x, y, z] = corner;
        let [end_x, end_y] = [x + size[0] as f64, y + size[1] as f64];
        let top = z + height - GAP;
        self.block(paint, [x + GAP, y + GAP, z], [end_x - GAP, end_y - GAP, top]);
        for i in 0..size[0] {
            for j in 0..size[1] {
                let base = place([x + i as f64 + 0.5, y + j as f64 + 0.5, top]);
                let stud = Shape::cylinder(Axis::Z, base, 0.3 * PITCH, 0.2 * PITCH);
                self.studs.push((stud, paint.material()));
            }
        }
    }

    /// A cylinder with the centre of its lower end at `base`.
    pub fn cylinder(&mut self, paint: Paint, axis: Axis, base: [f64; 3], radius: f64, length: f64) {
        self.solids.push((Shape::cylinder(axis, place(base), radius * PITCH, length * PITCH), paint.material()));
    }

    /// A cylinder along y between `y[0]` and `y[1]` around the axle (x, z).
    pub fn wheel(&mut self, paint: Paint, y: [f64; 2], axle: [f64; 2], radius: f64) {
        self.cylinder(paint, Axis::Y, [axle[0], y[0], axle[1]], radius, y[1] - y[0]);
    }

    /// A prism along y between `y[0]` and `y[1]` whose side has the corners (x, z), counter-clockwise as seen with x to
    /// the right and z up. They must be convex.
    pub fn prism(&mut self, paint: Paint, y: [f64; 2], corners: &[[f64; 2]]) {
        let [start, end] = y.map(|y| place([0.0, y, 0.0]).y);
        // Profiles along y are in the plane (z, x), which has the opposite orientation.
        let corners = corners.iter().rev().map(|&[x, z]| place([x, 0.0, z])).map(|p| DVec2::new(p.z, p.x)).collect();
        let shape = Shape { axis: Axis::Y, span: [start, end], profile: Profile::Polygon(corners) };
        self.solids.push((shape, paint.material()));
    }

    /// A prism along y between `y[0]` and `y[1]`: a bar of the given thickness from one point (x, z) to another.
    pub fn bar(&mut self, paint: Paint, y: [f64; 2], from: [f64; 2], to: [f64; 2], thickness: f64) {
        let (from, to) = (DVec2::from(from), DVec2::from(to));
        let across = (to - from).normalize().perp() * thickness / 2.0;
        let corners = [from - across, to - across, to + across, from + across];
        self.prism(paint, y, &corners.map(DVec2::into));
    }

    /// All solids, without the studs that others hide.
    pub fn finish(self) -> Vec<(Shape, Material)> {
        let Model { mut solids, mut studs } = self;
        studs.retain(|(stud, _)| {
            let [min, max] = stud.bounds();
            solids.iter().all(|(solid, _)| solid.distance((min + max) / 2.0) > 0.0)
        });
        solids.extend(studs);
        solids
    }
}

/// Converts a model point to scene units.
fn place(point: [f64; 3]) -> DVec3 {
    (DVec3::from(point) - CENTRE) * PITCH
}
