use super::*;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Keyframes without any symmetry.
fn keys() -> Vec<Keyframe> {
    let key = |[x, y, z]: [f64; 3], axis: DVec3, angle: f64, angle_y: f64| Keyframe {
        pose: DAffine3 { matrix3: DMat3::from_axis_angle(axis.normalize(), angle), translation: DVec3::new(x, y, z) },
        angle_y,
    };
    vec![
        key([0.0, 0.3, 1.0], DVec3::new(1.0, 2.0, 0.5), 0.4, 0.7),
        key([1.0, 0.1, 1.2], DVec3::new(0.2, 1.0, 0.1), 0.9, 0.9),
        key([1.3, 2.0, 0.7], DVec3::new(0.1, 0.3, 1.0), 1.4, 0.5),
        key([3.0, 2.2, 0.1], DVec3::new(-1.0, 0.3, 1.0), 1.0, 0.6),
        key([3.1, -1.0, 0.2], DVec3::new(-1.0, 1.3, 0.2), 0.3, 1.1),
    ]
}

/// The distance between two keyframes, in rotation, position and field of view.
fn apart(a: &Keyframe, b: &Keyframe) -> f64 {
    let rotation = (a.pose.matrix3 - b.pose.matrix3).to_cols_array().iter().map(|x| x * x).sum::<f64>().sqrt();
    rotation + a.pose.translation.distance(b.pose.translation) + (a.angle_y - b.angle_y).abs()
}

/// The velocities of position, rotation and zoom just before and just after a share of the path.
fn speeds(path: &CameraPath, share: f64) -> [[f64; 7]; 2] {
    const STEP: f64 = 1e-5;
    [[share - STEP, share], [share, share + STEP]].map(|[from, to]| {
        let [from, to] = [path.at(from), path.at(to)];
        let (moved, turned) = (to.pose.translation - from.pose.translation, turn(&from.pose, &to.pose));
        let zoomed = (0.5 * to.angle_y).tan().ln() - (0.5 * from.angle_y).tan().ln();
        [moved.x, moved.y, moved.z, turned.x, turned.y, turned.z, zoomed].map(|x| x / STEP)
    })
}

#[test]
fn path_passes_keyframes_with_continuous_speed() {
    for closed in [false, true] {
        let path = CameraPath::through(keys(), closed);
        let shares = path.shares();
        assert!(shares[0] == 0.0 && shares.windows(2).all(|pair| pair[0] < pair[1]), "{shares:?}");
        assert_eq!(shares[4] == 1.0, !closed);
        for (share, key) in shares.iter().zip(keys()) {
            assert!(apart(&path.at(*share), &key) < 1e-12, "{share}: {:?} {key:?}", path.at(*share));
        }
        for &share in if closed { &shares[1..] } else { &shares[1..4] } {
            let [before, after] = speeds(&path, share);
            let worst = before.iter().zip(after).map(|(a, b)| (a - b).abs()).fold(0.0, raygrad_tensor::Real::maximum);
            let most = before.iter().map(|x| x.abs()).fold(0.0, raygrad_tensor::Real::maximum);
            assert!(worst < 1e-2 * most && most > 0.1, "{share}: {before:?} {after:?}");
        }
        // A closed path is continuous where it starts again.
        if closed {
            assert!(apart(&path.at(1.0), &keys()[0]) < 1e-12);
            let [before, after] = [speeds(&path, 1.0 - 2e-5)[0], speeds(&path, 2e-5)[1]];
            assert!(before.iter().zip(after).all(|(a, b)| (a - b).abs() < 2e-2), "{before:?} {after:?}");
        }
    }
}

#[test]
fn spline_positions_are_centripetal_hermite() {
    // Without rotations, times are square roots of distances: 1, 4 and 9 apart, the last at a right angle.
    let places = [[0.0, 0.0], [1.0, 0.0], [5.0, 0.0], [5.0, 9.0]].map(|[x, y]| DVec3::new(x, y, 2.0));
    let keys = places.map(|place| Keyframe { pose: DAffine3::from_translation(place), angle_y: 1.0 });
    let path = CameraPath::through(keys.to_vec(), false);
    let knots = [0.0, 1.0, 3.0, 6.0];
    for (share, knot) in path.shares().iter().zip(knots) {
        assert!((share - knot / 6.0).abs() < 1e-12);
    }
    // Slopes at the inner knots by non-uniform finite differences, with cubic Hermite polynomials between them.
    let slope = |i: usize| {
        let over = |a: usize, b: usize| (places[b] - places[a]) / (knots[b] - knots[a]);
        over(i - 1, i) - over(i - 1, i + 1) + over(i, i + 1)
    };
    for u in [0.0, 0.2, 0.5, 0.9] {
        let (a, b, leg) = (places[1], places[2], 2.0);
        let [h00, h10] = [(1.0 + 2.0 * u) * (1.0 - u) * (1.0 - u), u * (1.0 - u) * (1.0 - u)];
        let [h01, h11] = [u * u * (3.0 - 2.0 * u), u * u * (u - 1.0)];
        let expected = h00 * a + h10 * leg * slope(1) + h01 * b + h11 * leg * slope(2);
        let found = path.at((1.0 + leg * u) / 6.0).pose.translation;
        assert!(found.distance(expected) < 1e-12, "{u}: {found} {expected}");
    }
    // The first leg is mirrored at its start, so the initial slope is that of the leg.
    let first = path.at(1e-6).pose.translation / 6e-6;
    assert!((first.x - 1.0).abs() < 1e-4 && first.y == 0.0, "{first}");
}

#[test]
fn constant_turn_stays_constant_and_short() {
    // One turn around the vertical by seven keyframes; the signs of the quaternions differ.
    let key = |i: usize| {
        let angle = i as f64 * TAU / 7.0;
        let eye = 3.0 * DVec3::new(angle.cos(), angle.sin(), 0.5);
        Keyframe { pose: Camera::look_at(eye, DVec3::new(0.0, 0.0, 1.5), DVec3::Z), angle_y: 0.8 }
    };
    let path = CameraPath::through((0..7).map(key).collect(), true);
    let frames = path.frames(70);
    for (i, frame) in frames.iter().enumerate() {
        let angle = i as f64 * TAU / 70.0;
        let [x, y, z] = frame.pose.translation.to_array();
        assert!((x.hypot(y) - 3.0).abs() < 0.05 && (z - 1.5).abs() < 1e-12, "{i}");
        if i % 10 == 5 {
            // Halfway: nine sixteenths of each neighbour, minus one sixteenth of each next one.
            let [near, far] = [1.0, 3.0].map(|legs| (legs * PI / 7.0).cos());
            assert!((x.hypot(y) - 3.0 * (9.0 * near - far) / 8.0).abs() < 1e-12, "{i}");
        }
        let back = DVec3::new(angle.cos(), angle.sin(), 0.0);
        assert!(frame.pose.matrix3.z_axis.distance(back) < 1e-9, "{i}: turns evenly");
        assert!(frame.pose.matrix3.y_axis.distance(DVec3::Z) < 1e-12 && (frame.angle_y - 0.8).abs() < 1e-12);
    }
    assert!(apart(&frames[10], &key(1)) < 1e-9 && apart(&frames[0], &key(0)) < 1e-9);
    // A turn of 350 degrees is one of -10 degrees.
    let turned = |degrees: f64| Keyframe { pose: DAffine3::from_rotation_y(degrees.to_radians()), angle_y: 0.8 };
    let between = turned(5.0).mix(&turned(355.0), 0.25);
    assert!(apart(&between, &turned(2.5)) < 1e-12);
    // A turn of 210 degrees is one of -150, for either sign of the matrix's quaternion.
    for axis in [DVec3::X, DVec3::Y, DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y, DVec3::NEG_Z] {
        let about =
            |degrees: f64| Keyframe { pose: DAffine3::from_axis_angle(axis, degrees.to_radians()), angle_y: 0.8 };
        assert!(apart(&about(0.0).mix(&about(210.0), 0.5), &about(-75.0)) < 1e-12, "{axis}");
    }
}

#[test]
fn field_of_view_mixes_by_focal_length() {
    let key = |angle_y: f64| Keyframe { pose: DAffine3::IDENTITY, angle_y };
    // The tangents are 1 and 1/4; the geometric mean is 1/2.
    let between = key(FRAC_PI_2).mix(&key(2.0 * 0.25_f64.atan()), 0.5);
    assert!((between.angle_y - 2.0 * 0.5_f64.atan()).abs() < 1e-12);
    // 60 degrees span the 300 rows, for any width.
    let camera = key(PI / 3.0).camera([400, 300]);
    let focal = 150.0 * 3.0_f64.sqrt();
    assert!(camera.focal.iter().all(|f| (f - focal).abs() < 1e-9) && camera.centre == [200.0, 150.0]);
    assert!((Keyframe::of(&camera).angle_y - PI / 3.0).abs() < 1e-12);
    let stretched = Camera { focal: [100.0, 150.0], ..camera };
    assert!((Keyframe::of(&stretched).angle_y - FRAC_PI_2).abs() < 1e-12, "it is that of the vertical");
}

#[test]
fn near_curve_is_a_cubic_b_spline() {
    let keys = keys();
    let path = CameraPath::timed(keys.clone(), vec![1.0, 2.0, 0.5, 1.5], false, Curve::Near);
    assert_eq!(path.shares(), [0.0, 0.2, 0.6, 0.7, 1.0]);
    let mean = |weights: [f64; 5], of: fn(&Keyframe) -> DVec3| -> DVec3 {
        keys.iter().zip(weights).map(|(key, weight)| weight * of(key)).sum()
    };
    let sixths = |weights: [f64; 5]| weights.map(|weight| weight / 6.0);
    // In the middle of a leg the weights are 1, 23, 23 and 1 over 48. At an open end the last keyframe repeats.
    for (share, weights) in [
        (0.2, sixths([1.0, 4.0, 1.0, 0.0, 0.0])),
        (0.6, sixths([0.0, 1.0, 4.0, 1.0, 0.0])),
        (0.0, sixths([5.0, 1.0, 0.0, 0.0, 0.0])),
        (1.0, sixths([0.0, 0.0, 0.0, 1.0, 5.0])),
        (0.4, [1.0, 23.0, 23.0, 1.0, 0.0].map(|weight| weight / 48.0)),
    ] {
        let found = path.at(share);
        assert!(found.pose.translation.distance(mean(weights, |key| key.pose.translation)) < 1e-12, "{share}");
        let angle_y: f64 = keys.iter().zip(weights).map(|(key, weight)| weight * key.angle_y).sum();
        assert!((found.angle_y - angle_y).abs() < 1e-12, "{share}");
        let excess = found.pose.matrix3.transpose() * found.pose.matrix3 - DMat3::IDENTITY;
        assert!(excess.to_cols_array().iter().all(|x| x.abs() < 1e-12));
    }
    // The mean of two equal turns about one axis is halfway, for either sign of a quaternion.
    let turned = |degrees: f64| Keyframe { pose: DAffine3::from_rotation_z(degrees.to_radians()), angle_y: 0.8 };
    let around = CameraPath::timed([170.0, 170.0, 190.0, 190.0].map(turned).to_vec(), vec![1.0; 3], false, Curve::Near);
    assert!(apart(&around.at(0.5), &turned(180.0)) < 1e-12);
}

/// Cameras two apart look in opposite directions, so that their quaternions have no common half space.
#[test]
fn near_curve_of_few_keyframes_around_an_object_does_not_jump() {
    for count in [3, 4, 5] {
        let key = |i: usize| {
            let angle = i as f64 / count as f64 * TAU;
            let eye = DVec3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 0.3);
            Keyframe { pose: Camera::look_at(eye, DVec3::ZERO, DVec3::Z), angle_y: 0.8 }
        };
        let path = CameraPath::timed((0..count).map(key).collect(), vec![1.0; count], true, Curve::Near);
        let frames = path.frames(3600);
        for pair in frames.windows(2) {
            assert!(apart(&pair[0], &pair[1]) < 0.02, "{count}: {pair:?}");
        }
    }
}

#[test]
fn paths_of_few_or_equal_keyframes_are_finite() {
    let [a, b] = [keys()[0], keys()[1]];
    for closed in [false, true] {
        let single = CameraPath::through(vec![a], closed);
        assert_eq!((single.frames(3), single.shares()), (vec![a; 3], vec![0.0]));
        let double = CameraPath::through(vec![a, b], closed);
        assert!(apart(&double.at(if closed { 0.5 } else { 1.0 }), &b) < 1e-12);
        let halt = CameraPath::through(vec![a, a, b], closed);
        assert!(halt.frames(50).iter().all(|key| key.pose.is_finite() && key.angle_y > 0.0));
        let still = CameraPath::through(vec![a, a], closed);
        assert!(still.frames(4).iter().all(|key| apart(key, &a) < 1e-12));
    }
    // Two keyframes give a straight line; the last frame of an open path is its end.
    let frames = CameraPath::through(vec![a, b], false).frames(5);
    assert!(apart(&frames[4], &b) < 1e-12 && apart(&frames[1], &a.mix(&b, 0.25)) < 1e-12);
}

#[test]
fn legs_of_tiny_time_are_passed() {
    for (times, closed) in [(vec![1e-300, 1e6, 1.0, 1e-300], false), (vec![1e6, 1e-300, 1e-9, 1e6, 1e-300], true)] {
        for curve in [Curve::Through, Curve::Near] {
            let path = CameraPath::timed(keys(), times.clone(), closed, curve);
            assert!(path.shares().windows(2).all(|pair| pair[0] < pair[1]), "{:?}", path.shares());
            for key in path.frames(101) {
                assert!(key.pose.is_finite() && key.angle_y > 0.0, "{key:?}");
            }
        }
    }
}

#[test]
fn keyframe_times_keep_the_curve() {
    // Equal steps along x: the curve's parameter is x.
    let key = |x: f64| Keyframe { pose: DAffine3::from_translation(DVec3::new(x, 1.0, 2.0)), angle_y: 0.8 };
    let keys: Vec<Keyframe> = (0..5).map(|i| key(f64::from(i))).collect();
    let along = |path: &CameraPath, time: f64, all: f64| path.at(time / all).pose.translation.x;
    // scipy.interpolate.PchipInterpolator([0, 1, 3, 3.5, 5], [0, 1, 2, 3, 4])
    let open = CameraPath::timed(keys.clone(), vec![1.0, 2.0, 0.5, 1.5], false, Curve::Through);
    for (time, x) in [
        (0.3, 0.3438846153846154),
        (0.9, 0.9264230769230769),
        (1.5, 1.2657342657342658),
        (2.9, 1.9139930069930067),
        (3.2, 2.3650909090909096),
        (4.1, 3.5876363636363635),
        (4.8, 3.9766195286195285),
    ] {
        assert!((along(&open, time, 5.0) - x).abs() < 1e-12, "{time}");
    }
    // The same for the closed path, in the leg from the second keyframe to the third.
    let closed = CameraPath::timed(keys[..4].to_vec(), vec![1.0, 2.0, 0.5, 1.5], true, Curve::Through);
    assert_eq!(closed.shares(), [0.0, 0.2, 0.6, 0.7]);
    for (time, leg, share) in
        [(0.3, 0, 0.29157380457380455), (1.5, 1, 0.2657342657342658), (4.8, 3, 0.8548177268177266)]
    {
        let start = [0.0, 1.0, 3.0, 3.5][leg];
        let found = closed.passed(leg, (time - start) / closed.leg(leg)[0]);
        assert!((found - share).abs() < 1e-12, "{time}: {found}");
    }
    // The path does not reverse before a much faster leg.
    let hasty = CameraPath::timed(keys.clone(), vec![10.0, 0.1, 7.0, 0.01], false, Curve::Through);
    assert!(hasty.frames(1000).windows(2).all(|pair| pair[0].pose.translation.x <= pair[1].pose.translation.x + 1e-12));
    let two = CameraPath::timed(keys[..2].to_vec(), vec![3.0], false, Curve::Through);
    assert!((along(&two, 1.2, 3.0) - 0.4).abs() < 1e-12);
}
