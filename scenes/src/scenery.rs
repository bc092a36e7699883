//! The scenery of the landscape: objects of many sizes, near and far, and the hills on the horizon.
//!
//! Sizes grow with the distance from the origin, so that near and far objects cover about as many pixels.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};

use super::form::{Form, Placed};
use super::golden::GOLDEN_ANGLE;
use super::noise::random;
use super::paint::{Paint, Pattern, linear, road_distance};
use super::shape::{Axis, Profile, Shape};

/// Height of the ground, on which the bulldozer's base plate lies.
pub const GROUND: f64 = -0.2825;
/// The range of distances from the origin of low objects, which cameras can walk around in.
const LOW: [f64; 2] = [2.4, 6.0];
/// The number of low objects.
const LOW_COUNT: usize = 22;
/// The range of distances of all other objects except hills.
const TALL: [f64; 2] = [7.5, 760.0];
/// The number of these objects.
const TALL_COUNT: usize = 170;
/// The number of hills on the horizon.
const HILLS: usize = 26;
/// The number of mountains behind them.
const MOUNTAINS: usize = 17;

/// Solids of one object, and its position.
struct Site<'a> {
    solids: &'a mut Vec<(Placed, Paint)>,
    base: DVec3,
    turn: DVec2,
    scale: f64,
}

impl Site<'_> {
    fn add(&mut self, form: Form, paint: Paint) {
        self.solids.push((Placed { form, base: self.base, turn: self.turn, scale: self.scale }, paint));
    }

    fn block(&mut self, paint: Paint, min: [f64; 3], max: [f64; 3]) {
        self.add(Form::Extrusion(Shape::cuboid(min.into(), max.into())), paint);
    }

    fn cylinder(&mut self, paint: Paint, [from, to]: [f64; 2], radius: f64) {
        self.add(Form::Extrusion(Shape::cylinder(Axis::Z, from * DVec3::Z, radius, to - from)), paint);
    }

    fn cone(&mut self, paint: Paint, [from, to]: [f64; 2], radius: f64) {
        self.add(Form::Cone { base: from * DVec3::Z, radius, height: to - from }, paint);
    }

    fn ball(&mut self, paint: Paint, centre: [f64; 3], radii: [f64; 3]) {
        self.add(Form::Ellipsoid { centre: centre.into(), radii: radii.into() }, paint);
    }

    /// A prism along x between `x[0]` and `x[1]` with the corners (y, z), counter-clockwise.
    fn prism(&mut self, paint: Paint, x: [f64; 2], corners: &[[f64; 2]]) {
        let corners = corners.iter().copied().map(DVec2::from).collect();
        self.add(Form::Extrusion(Shape { axis: Axis::X, span: x, profile: Profile::Polygon(corners) }), paint);
    }
}

fn plain(color: [u8; 3]) -> Paint {
    Paint { colors: [linear(color); 2], pattern: Pattern::Plain }
}

fn patterned(colors: [[u8; 3]; 2], pattern: Pattern) -> Paint {
    Paint { colors: colors.map(linear), pattern }
}

/// One of the colours, chosen by a number in 0..1.
fn choose<const N: usize>(colors: [[u8; 3]; N], choice: f64) -> [u8; 3] {
    colors[((choice * N as f64) as usize).min(N - 1)]
}

/// A colour times a number.
fn shade(color: [u8; 3], factor: f64) -> [u8; 3] {
    color.map(|code| (f64::from(code) * factor).clamp(0.0, 255.0) as u8)
}

/// A fir of height 1.
fn fir(site: &mut Site<'_>, choice: f64) {
    let green = choose([[44, 92, 56], [58, 104, 52], [36, 80, 66]], choice);
    let needles = patterned([shade(green, 0.78), shade(green, 1.3)], Pattern::Mottled(0.12));
    site.cylinder(plain([98, 70, 48]), [0.0, 0.3], 0.045);
    for (from, to, radius) in [(0.14, 0.6, 0.29), (0.36, 0.8, 0.22), (0.58, 1.0, 0.15)] {
        site.cone(needles, [from, to], radius);
    }
}

/// A broad tree of height 1.
fn tree(site: &mut Site<'_>, choice: f64) {
    let green = choose([[84, 138, 50], [108, 146, 48], [186, 130, 44], [70, 122, 58]], choice);
    let leaves = patterned([shade(green, 0.72), shade(green, 1.25)], Pattern::Mottled(0.16));
    site.cylinder(plain([104, 78, 54]), [0.0, 0.5], 0.055);
    site.ball(leaves, [0.0, 0.0, 0.7], [0.29, 0.29, 0.3]);
    site.ball(leaves, [0.2, 0.06, 0.56], [0.2, 0.2, 0.18]);
    site.ball(leaves, [-0.16, -0.13, 0.54], [0.21, 0.2, 0.17]);
}

/// A house of height 1 with a gabled roof.
fn house(site: &mut Site<'_>, choice: f64) {
    let wall = choose([[226, 214, 190], [204, 120, 88], [216, 190, 120], [150, 176, 196], [236, 232, 224]], choice);
    let roof = choose([[150, 58, 42], [92, 84, 90], [122, 74, 50]], (7.0 * choice).fract());
    let walls = patterned([wall, shade(wall, 0.75)], Pattern::Courses(0.07));
    site.block(walls, [-0.55, -0.38, 0.0], [0.55, 0.38, 0.55]);
    site.prism(walls, [-0.55, 0.55], &[[-0.38, 0.549], [0.38, 0.549], [0.0, 0.93]]);
    let tiles = patterned([roof, shade(roof, 0.7)], Pattern::Courses(0.06));
    for side in [-1.0, 1.0] {
        let mut corners = [[0.46 * side, 0.47], [0.46 * side, 0.53], [0.0, 1.0], [0.0, 0.93]];
        if side < 0.0 {
            corners.reverse();
        }
        site.prism(tiles, [-0.62, 0.62], &corners);
    }
    site.block(plain(shade(roof, 0.8)), [0.2, 0.1, 0.6], [0.34, 0.24, 1.08]);
    let glass = plain([58, 76, 96]);
    for x in [-0.4, 0.16] {
        site.block(glass, [x, -0.39, 0.22], [x + 0.2, 0.39, 0.42]);
    }
    site.block(plain([96, 62, 40]), [-0.1, -0.392, 0.0], [0.08, 0.392, 0.36]);
    site.block(glass, [-0.56, -0.12, 0.24], [0.56, 0.12, 0.44]);
}

/// A striped tower of height 1 with a pointed roof.
fn tower(site: &mut Site<'_>, choice: f64) {
    let color = choose([[198, 44, 38], [40, 92, 170], [226, 140, 30]], choice);
    site.cylinder(patterned([color, [238, 234, 226]], Pattern::Striped(0.26)), [0.0, 0.74], 0.13);
    site.cylinder(plain([70, 72, 78]), [0.74, 0.78], 0.18);
    site.cylinder(plain([240, 226, 160]), [0.78, 0.86], 0.1);
    site.cone(plain(shade(color, 0.8)), [0.86, 1.0], 0.16);
}

/// A silo of height 1 with a round roof.
fn silo(site: &mut Site<'_>, choice: f64) {
    let metal = choose([[190, 194, 198], [150, 160, 150], [206, 188, 150]], choice);
    site.cylinder(patterned([metal, shade(metal, 0.72)], Pattern::Courses(0.1)), [0.0, 0.8], 0.24);
    site.ball(plain(shade(metal, 0.85)), [0.0, 0.0, 0.8], [0.24, 0.24, 0.2]);
}

/// A pile of giant toy blocks of height 1.
fn blocks(site: &mut Site<'_>, choice: f64) {
    let colors = [[206, 52, 40], [42, 100, 184], [238, 182, 34], [64, 148, 84], [236, 116, 34]];
    let color = |k: f64| plain(choose(colors, (choice + 0.41 * k).fract()));
    site.block(color(0.0), [-0.42, -0.3, 0.0], [0.05, 0.25, 0.5]);
    site.block(color(1.0), [0.1, -0.22, 0.0], [0.5, 0.3, 0.42]);
    site.block(color(2.0), [-0.25, -0.2, 0.5], [0.05, 0.2, 0.8]);
    site.block(color(3.0), [0.12, -0.15, 0.42], [0.4, 0.2, 0.66]);
    site.cone(color(4.0), [0.8, 1.0], 0.14);
}

/// A rock half as high as 1.
fn rock(site: &mut Site<'_>, choice: f64) {
    let grey = choose([[142, 136, 128], [120, 118, 120], [160, 142, 120]], choice);
    let stone = patterned([shade(grey, 0.7), shade(grey, 1.15)], Pattern::Mottled(0.3));
    site.ball(stone, [0.0, 0.0, 0.1], [0.55, 0.42, 0.4]);
    site.ball(stone, [0.36, 0.2, 0.05], [0.34, 0.4, 0.3]);
}

/// A striped ball of height 1.
fn ball(site: &mut Site<'_>, choice: f64) {
    let color = choose([[214, 60, 48], [52, 120, 196], [240, 178, 40]], choice);
    site.ball(patterned([color, [240, 236, 228]], Pattern::Striped(0.4)), [0.0, 0.0, 0.5], [0.5; 3]);
}

/// A traffic cone of height 1.
fn traffic_cone(site: &mut Site<'_>, _choice: f64) {
    site.block(plain([40, 40, 42]), [-0.34, -0.34, 0.0], [0.34, 0.34, 0.08]);
    site.cone(patterned([[236, 96, 24], [240, 238, 232]], Pattern::Striped(0.5)), [0.08, 1.1], 0.28);
}

/// A crate of height 1.
fn crate_(site: &mut Site<'_>, choice: f64) {
    let wood = choose([[176, 130, 82], [150, 106, 66]], choice);
    site.block(patterned([wood, shade(wood, 0.6)], Pattern::Courses(0.25)), [-0.5, -0.5, 0.0], [0.5, 0.5, 1.0]);
}

/// Builds an object at a site; a number in 0..1 varies it.
type Kind = fn(&mut Site<'_>, f64);

/// All solids of the scenery on the ground, without the bulldozer.
pub fn solids() -> Vec<(Placed, Paint)> {
    let mut solids = vec![];
    let low: [Kind; 5] = [rock, traffic_cone, ball, crate_, rock];
    scatter(&mut solids, LOW_COUNT, LOW, &low, |_, i| 0.12 + 0.2 * random(i, 31));
    let tall: [Kind; 12] = [fir, tree, house, fir, rock, tower, tree, blocks, fir, silo, tree, ball];
    scatter(&mut solids, TALL_COUNT, TALL, &tall, |distance, i| distance * (0.055 + 0.06 * random(i, 32)));
    hills(&mut solids);
    solids
}

/// Objects at distances that grow by a constant factor, in all directions, off the road.
fn scatter(
    solids: &mut Vec<(Placed, Paint)>,
    count: usize,
    [nearest, farthest]: [f64; 2],
    kinds: &[Kind],
    size: impl Fn(f64, usize) -> f64,
) {
    for i in 0..count {
        let distance = nearest * (farthest / nearest).powf((i as f64 + 0.5) / count as f64);
        let place = distance * DVec2::from_angle(0.7 + i as f64 * GOLDEN_ANGLE);
        let kind = kinds[((random(i, 33) * kinds.len() as f64) as usize).min(kinds.len() - 1)];
        let scale = size(distance, i);
        if road_distance(place) < 1.6 + 0.8 * scale {
            continue;
        }
        let turn = DVec2::from_angle(random(i, 34) * TAU);
        kind(&mut Site { solids, base: place.extend(GROUND), turn, scale }, random(i, 35));
    }
}

/// A closed ring of wooded hills, and snow-capped mountains that rise above it.
fn hills(solids: &mut Vec<(Placed, Paint)>) {
    let ring =
        |solids: &mut Vec<(Placed, Paint)>, count, distance: f64, seed, build: &dyn Fn(usize) -> (Form, Paint)| {
            for i in 0..count {
                let angle = (i as f64 + 0.3 * random(i, seed)) / count as f64 * TAU;
                let place = distance * (0.95 + 0.1 * random(i, seed + 1)) * DVec2::from_angle(angle);
                let (form, paint) = build(i);
                let turn = DVec2::from_angle(angle);
                solids.push((Placed { form, base: place.extend(GROUND), turn, scale: 100.0 }, paint));
            }
        };
    ring(solids, HILLS, 940.0, 41, &|i| {
        let radii = DVec3::new(1.3, 1.9 + 0.5 * random(i, 43), 0.35 + 0.45 * random(i, 44));
        let wood = patterned([[62, 92, 56], [104, 122, 66]], Pattern::Mottled(1.2));
        (Form::Ellipsoid { centre: DVec3::ZERO, radii }, wood)
    });
    ring(solids, MOUNTAINS, 1080.0, 45, &|i| {
        let height = 1.2 + 1.3 * random(i, 47);
        let rock = patterned([[112, 108, 112], [236, 240, 244]], Pattern::Above(0.62 * height));
        (Form::Cone { base: DVec3::ZERO, radius: 1.5 + 0.6 * height, height }, rock)
    });
}
