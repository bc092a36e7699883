//! The model: a yellow bulldozer of plastic bricks on a studded base plate.
//!
//! Lengths are in stud pitches: x forwards, y to the left, z up from the top of the base plate.

use std::f64::consts::PI;

use glam::DVec2;

use super::kit::{BLACK, BLUE, BRICK, BROWN, DARK, GREEN, GREY, Model, ORANGE, PLATE, RED, TAN, WHITE, YELLOW};
use super::shade::Material;
use super::shape::{Axis, Shape};

/// The solids of the bulldozer, its driver, its load and the base plate, in scene units.
pub fn solids() -> Vec<(Shape, Material)> {
    let mut model = Model::default();
    ground(&mut model);
    for side in [-1.0, 1.0] {
        track(&mut model, side);
        side_parts(&mut model, side);
    }
    chassis(&mut model);
    engine(&mut model);
    cab(&mut model);
    driver(&mut model);
    blade(&mut model);
    ripper(&mut model);
    model.finish()
}

/// The base plate and the objects on it.
fn ground(model: &mut Model) {
    model.brick(GREEN, [-9.0, -6.0, -PLATE], [20, 12], PLATE);
    // In front of the blade.
    model.brick(RED, [9.0, -1.0, 0.0], [2, 4], BRICK);
    model.brick(BLUE, [9.0, 0.0, BRICK], [2, 2], BRICK);
    model.brick(TAN, [9.0, -4.0, 0.0], [2, 2], BRICK);
    model.brick(BROWN, [9.0, 3.0, 0.0], [1, 2], BRICK);
    model.brick(WHITE, [9.0, -4.0, BRICK], [1, 2], PLATE);
    // Traffic cones at the rear corners.
    for y in [-4.5, 4.5] {
        let x = -7.5;
        model.block(BLACK, [x - 0.7, y - 0.7, 0.2], [x + 0.7, y + 0.7, 0.4]);
        for (i, paint) in [ORANGE, ORANGE, WHITE, ORANGE, ORANGE].into_iter().enumerate() {
            let i = i as f64;
            model.cylinder(paint, Axis::Z, [x, y, 0.4 + 0.3 * i], 0.52 - 0.09 * i, 0.3);
        }
    }
}

/// The interval of y from `near` to `far` on the left (`side` 1) or on the right (-1).
fn span(side: f64, near: f64, far: f64) -> [f64; 2] {
    if side > 0.0 { [near, far] } else { [-far, -near] }
}

/// Positions of the tracks' axles along x, and their height.
const REAR_AXLE: f64 = -4.0;
const FRONT_AXLE: f64 = 3.6;
const AXLE_HEIGHT: f64 = 1.75;
/// Radius of the belt around the axles, without treads.
const BELT: f64 = 1.35;

/// One track: belt, wheels and the frame between them.
fn track(model: &mut Model, side: f64) {
    for x in [REAR_AXLE, FRONT_AXLE] {
        // The belt's round end is a whole cylinder; wheel, hub and axle protrude on both sides.
        let axle = [x, AXLE_HEIGHT];
        model.wheel(BLACK, span(side, 2.7, 4.5), axle, BELT);
        model.wheel(GREY, span(side, 2.6, 4.6), axle, 1.0);
        model.wheel(YELLOW, span(side, 2.5, 4.7), axle, 0.6);
        model.wheel(DARK, span(side, 2.4, 4.8), axle, 0.22);
    }
    for z in [AXLE_HEIGHT - BELT, AXLE_HEIGHT + BELT - 0.2] {
        model.bar(BLACK, span(side, 2.7, 4.5), [REAR_AXLE, z + 0.1], [FRONT_AXLE, z + 0.1], 0.2);
    }
    model.bar(DARK, span(side, 2.9, 4.3), [REAR_AXLE, AXLE_HEIGHT + 0.05], [FRONT_AXLE, AXLE_HEIGHT + 0.05], 1.3);
    for x in [-2.5, -1.0, 0.5, 2.0] {
        model.wheel(GREY, span(side, 2.75, 4.45), [x, AXLE_HEIGHT - 0.7], 0.45);
    }
    treads(model, side);
}

/// The treads of a track, evenly spaced on its belt.
fn treads(model: &mut Model, side: f64) {
    let (straight, bend) = (FRONT_AXLE - REAR_AXLE, PI * BELT);
    let count = 38;
    for i in 0..count {
        // Forwards along the top, around the front, backwards along the bottom, around the rear.
        let way = i as f64 / count as f64 * 2.0 * (straight + bend);
        let (x, angle) = if way < straight {
            (REAR_AXLE + way, PI / 2.0)
        } else if way < straight + bend {
            (FRONT_AXLE, PI / 2.0 - (way - straight) / BELT)
        } else if way < 2.0 * straight + bend {
            (FRONT_AXLE - (way - straight - bend), -PI / 2.0)
        } else {
            (REAR_AXLE, -PI / 2.0 - (way - 2.0 * straight - bend) / BELT)
        };
        let (centre, out) = (DVec2::new(x, AXLE_HEIGHT), DVec2::from_angle(angle));
        let [from, to] = [BELT - 0.1, BELT + 0.2].map(|radius| (centre + radius * out).into());
        model.bar(BLACK, span(side, 2.6, 4.6), from, to, 0.4);
    }
}

/// The parts of each side: a fender, a push arm, a hydraulic ram and lamps.
fn side_parts(model: &mut Model, side: f64) {
    for x in [-5.0, -2.0] {
        model.brick(YELLOW, [x, span(side, 3.0, 5.0)[0], 3.6], [3, 2], PLATE);
    }
    model.bar(DARK, span(side, 3.0, 3.3), [-5.0, 3.0], [1.0, 3.0], 1.2);
    // The push arm rotates on a pin at the middle of the track and carries the blade; the ram lifts it.
    model.bar(YELLOW, span(side, 4.9, 5.3), [-0.4, 1.5], [7.0, 1.1], 0.6);
    model.wheel(DARK, span(side, 4.6, 5.45), [-0.4, 1.5], 0.5);
    model.bar(DARK, span(side, 2.15, 2.65), [4.6, 4.3], [6.2, 3.3], 0.5);
    model.bar(GREY, span(side, 2.28, 2.52), [6.0, 3.4], [6.95, 2.8], 0.24);
    // Headlight and tail light.
    model.cylinder(DARK, Axis::X, [5.0, side, 5.2], 0.46, 0.4);
    model.cylinder(WHITE, Axis::X, [5.3, side, 5.2], 0.36, 0.25);
    model.cylinder(RED, Axis::X, [-5.7, 1.5 * side, 4.0], 0.32, 0.3);
}

/// The body between the tracks.
fn chassis(model: &mut Model) {
    model.block(DARK, [-4.8, -2.4, 1.0], [5.0, 2.4, 2.8]);
    for x in [-5.0, 0.0] {
        model.brick(YELLOW, [x, -3.0, 2.8], [5, 6], PLATE);
    }
}

/// Bonnet, grille, exhaust and air filter.
fn engine(model: &mut Model) {
    for (row, split) in [2, 3].into_iter().enumerate() {
        let z = 3.2 + row as f64 * BRICK;
        model.brick(YELLOW, [0.0, -2.0, z], [split, 4], BRICK);
        model.brick(YELLOW, [split as f64, -2.0, z], [5 - split, 4], BRICK);
    }
    for i in 0..5 {
        let z = 3.35 + 0.32 * i as f64;
        model.block(DARK, [4.9, -1.7, z], [5.15, 1.7, z + 0.18]);
    }
    // Cooling slots on the sides.
    for i in 0..4 {
        let x = 1.2 + 0.7 * i as f64;
        model.block(BLACK, [x, -2.02, 3.7], [x + 0.35, 2.02, 5.1]);
    }
    // Exhaust, with a dark disc for its opening, and air filter.
    model.cylinder(DARK, Axis::Z, [3.5, 0.5, 5.6], 0.42, 0.5);
    model.cylinder(GREY, Axis::Z, [3.5, 0.5, 6.1], 0.26, 1.8);
    model.cylinder(DARK, Axis::Z, [3.5, 0.5, 7.9], 0.34, 0.35);
    model.cylinder(BLACK, Axis::Z, [3.5, 0.5, 8.25], 0.2, 0.02);
    model.cylinder(BLACK, Axis::Z, [1.5, -0.5, 5.6], 0.4, 0.6);
    model.cylinder(YELLOW, Axis::Z, [1.5, -0.5, 6.2], 0.55, 0.35);
}

/// A cab with open windows, a roof and a beacon.
fn cab(model: &mut Model) {
    let [floor, sill, roof] = [3.2, 4.8, 8.4];
    for y in [[-2.0, -1.7], [1.7, 2.0]] {
        model.block(YELLOW, [-3.97, y[0], floor], [-1.4, y[1], sill]);
        for x in [-3.97, -0.33] {
            model.block(YELLOW, [x, y[0], floor], [x + 0.3, y[1], roof]);
        }
        model.block(YELLOW, [-1.6, y[0], sill - 0.2], [-1.4, y[1], roof]);
    }
    model.block(YELLOW, [-3.97, -1.7, floor], [-3.67, 1.7, sill]);
    model.block(YELLOW, [-0.33, -1.7, floor], [-0.03, 1.7, sill + 0.6]);
    model.block(DARK, [-4.2, -2.2, roof - 0.15], [0.2, 2.2, roof]);
    model.brick(YELLOW, [-4.5, -2.5, roof], [5, 5], PLATE);
    model.cylinder(DARK, Axis::Z, [-2.0, 0.0, roof + PLATE], 0.42, 0.25);
    model.cylinder(ORANGE, Axis::Z, [-2.0, 0.0, roof + PLATE + 0.25], 0.34, 0.55);
    // Work lights on the front edge of the roof.
    for y in [-1.5, 1.5] {
        model.cylinder(WHITE, Axis::X, [0.5, y, roof + 0.2], 0.2, 0.1);
    }
    // Seat, dashboard and levers.
    model.block(DARK, [-3.4, -0.9, floor], [-1.9, 0.9, floor + 0.7]);
    model.block(DARK, [-3.6, -0.9, floor], [-3.2, 0.9, floor + 2.4]);
    model.block(DARK, [-0.9, -1.2, floor], [-0.4, 1.2, floor + 1.9]);
    for y in [-1.3, 1.3] {
        model.cylinder(BLACK, Axis::Z, [-1.2, y, floor], 0.08, 2.0);
        model.cylinder(RED, Axis::Z, [-1.2, y, floor + 2.0], 0.16, 0.25);
    }
}

/// A driver in a hard hat.
fn driver(model: &mut Model) {
    let seat = 3.9;
    for side in [-1.0, 1.0] {
        model.bar(BLUE, span(side, 0.05, 0.75), [-3.1, seat + 0.3], [-1.4, seat + 0.3], 0.6);
    }
    let torso = [[-3.1, seat + 0.6], [-2.2, seat + 0.6], [-2.3, seat + 2.0], [-3.0, seat + 2.0]];
    model.prism(RED, [-0.75, 0.75], &torso);
    for side in [-1.0, 1.0] {
        model.bar(RED, span(side, 0.75, 1.05), [-2.65, seat + 1.7], [-1.9, seat + 0.9], 0.4);
        model.bar(YELLOW, span(side, 0.8, 1.0), [-1.95, seat + 0.95], [-1.5, seat + 1.1], 0.3);
    }
    let head = [-2.65, 0.0, seat + 2.0];
    model.cylinder(YELLOW, Axis::Z, head, 0.45, 0.85);
    model.cylinder(WHITE, Axis::Z, [head[0] + 0.08, 0.0, head[2] + 0.65], 0.62, 0.1);
    model.cylinder(WHITE, Axis::Z, [head[0], 0.0, head[2] + 0.75], 0.52, 0.35);
    for y in [-0.17, 0.17] {
        model.cylinder(BLACK, Axis::X, [head[0] + 0.4, y, head[2] + 0.45], 0.06, 0.06);
    }
}

/// The curved blade with its cutting edge and end plates.
fn blade(model: &mut Model) {
    // An arc in the plane (x, z), concave towards the front.
    let (centre, radius, pieces) = (DVec2::new(9.6, 2.6), 2.6, 10);
    let point = |i: usize| centre + radius * DVec2::from_angle(PI + 0.9 - 1.5 * i as f64 / pieces as f64);
    for i in 0..pieces {
        model.bar(YELLOW, [-5.0, 5.0], point(i).into(), point(i + 1).into(), 0.3);
    }
    let [low, high] = [point(0), point(pieces)];
    model.bar(GREY, [-5.0, 5.0], [low.x + 0.1, low.y], [low.x + 0.35, 0.22], 0.2);
    for y in [[-5.2, -5.0], [5.0, 5.2]] {
        let corners = [
            [low.x + 0.35, 0.25],
            [low.x + 0.5, 0.6],
            [high.x + 0.35, high.y],
            [high.x - 0.2, high.y],
            [6.85, 2.6],
            [7.2, 1.4],
            [low.x - 0.2, 0.25],
        ];
        model.prism(YELLOW, y, &corners);
    }
    // Ribs on the back.
    for y in [-2.4, 0.0, 2.4] {
        model.prism(DARK, [y - 0.25, y + 0.25], &[[6.5, 1.4], [7.1, 1.4], [7.0, 3.6], [6.7, 3.6]]);
    }
}

/// The claw at the rear.
fn ripper(model: &mut Model) {
    model.block(YELLOW, [-5.5, -2.0, 2.0], [-5.0, 2.0, 4.6]);
    for y in [-1.3, 1.3] {
        model.bar(DARK, [y - 0.2, y + 0.2], [-5.3, 2.4], [-7.0, 2.1], 0.5);
        model.bar(GREY, [y - 0.15, y + 0.15], [-5.3, 3.6], [-7.0, 2.5], 0.3);
    }
    model.block(DARK, [-7.3, -2.0, 1.8], [-6.7, 2.0, 2.6]);
    for y in [-1.5, 0.0, 1.5] {
        model.prism(DARK, [y - 0.2, y + 0.2], &[[-7.5, 1.0], [-6.8, 1.2], [-6.8, 2.6], [-7.4, 2.6]]);
        model.prism(GREY, [y - 0.2, y + 0.2], &[[-7.1, 0.3], [-6.85, 0.4], [-6.8, 1.2], [-7.5, 1.0]]);
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::super::shape::Profile;
    use super::super::{test_cameras, train_cameras, val_cameras};
    use super::*;
    use crate::shape::Surface;

    #[test]
    fn views_show_the_whole_scene() {
        let solids = solids();
        for camera in [train_cameras(60, 100), val_cameras(10, 100), test_cameras(20, 100)].concat() {
            let view = camera.pose.inverse();
            for (solid, _) in &solids {
                let [min, max] = solid.bounds();
                for corner in 0..8 {
                    let pick = |i: usize| if corner >> i & 1 == 0 { min[i] } else { max[i] };
                    let local = view.transform_point3(DVec3::new(pick(0), pick(1), pick(2)));
                    let pixel = DVec2::new(local.x, local.y) / -local.z * camera.focal[0];
                    assert!(pixel.abs().max_element() < 50.0, "{pixel} of {solid:?}");
                }
            }
        }
    }

    #[test]
    fn solids_are_convex_and_not_empty() {
        for (solid, material) in solids() {
            let [min, max] = solid.bounds();
            assert!((max - min).min_element() > 0.0 && min.is_finite() && max.is_finite(), "{solid:?}");
            assert!(material.albedo.min_element() > 0.0 && material.albedo.max_element() < 1.0);
            if let Profile::Polygon(corners) = &solid.profile {
                for i in 0..corners.len() {
                    let [a, b, c] = [0, 1, 2].map(|k| corners[(i + k) % corners.len()]);
                    assert!((b - a).perp_dot(c - b) > 0.0, "not convex: {solid:?}");
                }
            }
        }
    }

    /// On a visible surface shared by two solids, rounding decides between their colours, so these must be equal.
    #[test]
    fn coplanar_surfaces_have_one_color() {
        let solids = solids();
        for camera in [train_cameras(12, 60), test_cameras(6, 60)].concat() {
            for (column, row) in (0..60).flat_map(|row| (0..60).map(move |column| (column, row))) {
                let ray = camera.pixel_ray(column, row);
                let hits = solids.iter().filter_map(|(solid, material)| Some((solid.intersect(&ray)?, material)));
                let mut hits: Vec<_> = hits.map(|((t, _), material)| (t, material)).collect();
                hits.sort_by(|a, b| a.0.total_cmp(&b.0));
                if let [a, b, ..] = hits[..] {
                    assert!(b.0 - a.0 > 1e-9 || a.1 == b.1, "at {}", ray.at(a.0));
                }
            }
        }
    }
}
