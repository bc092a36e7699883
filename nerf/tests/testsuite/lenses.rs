//! Lenses compared with OpenCV and COLMAP, and round trips over whole images.

use proptest::prelude::*;
use raygrad_nerf::glam::{DAffine3, DVec3};
use raygrad_nerf::{Camera, Lens};
use std::f64::consts::{FRAC_PI_2, PI};

/// The tolerance of pixels.
const PIXEL: f64 = 1e-6;
/// The focal length of the round trips.
const FOCAL: f64 = 1000.0;

fn brown(k: &[f64], p: [f64; 2]) -> Lens {
    let mut all = [0.0; 6];
    all[..k.len()].copy_from_slice(k);
    Lens::Brown { k: all, p }
}

fn fisheye(k: [f64; 4], p: [f64; 2], s: [f64; 2]) -> Lens {
    Lens::Fisheye { k, p, s }
}

/// The lens of instant-ngp's fox capture.
fn fox() -> Lens {
    brown(&[0.0578421, -0.0805099], [-0.000980296, 0.00015575])
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

#[derive(serde::Deserialize)]
struct Reference {
    cases: Vec<Case>,
}

#[derive(serde::Deserialize)]
struct Case {
    library: String,
    model: String,
    lens: Lens,
    focal: [f64; 2],
    centre: [f64; 2],
    rows: Vec<[f64; 5]>,
}

#[test]
fn pixels_equal_opencv_and_colmap() {
    let reference: Reference = serde_json::from_str(include_str!("../reference/lenses.json")).unwrap();
    assert!(reference.cases.len() > 15);
    for Case { library, model, lens, focal, centre, rows } in reference.cases {
        let camera = Camera { width: 1500, height: 2000, focal, centre, lens, pose: DAffine3::IDENTITY };
        for [x, y, z, column, row] in rows {
            let what = format!("{library} {model} {lens:?} at {x} {y} {z}");
            // Cameras have OpenGL's axes.
            let point = DVec3::new(x, -y, -z);
            let pixel = camera.pixel_of(point).unwrap_or_else(|| panic!("{what}: no pixel"));
            assert!(distance(pixel, [column, row]) < PIXEL, "{what}: {pixel:?}, not {column} {row}");
            assert!(camera.sees(column, row), "{what}");
            let miss = (camera.ray(column, row).direction - point.normalize()).length();
            assert!(miss * focal[0].max(focal[1]) < PIXEL, "{what}: a direction off by {miss}");
        }
    }
}

/// Lenses, with true for those that fill an image of 1500 by 2000 pixels at a focal length of 1000.
fn lenses() -> Vec<(Lens, bool)> {
    vec![
        (Lens::Pinhole, true),
        (brown(&[], [0.0; 2]), true),
        (fox(), false),
        (brown(&[-0.05], [0.0; 2]), true),
        (brown(&[-0.3, 0.12, -0.01], [0.002, -0.003]), true),
        (brown(&[-0.5], [0.0; 2]), false),
        (brown(&[-0.4, 0.02], [0.01, 0.02]), false),
        (brown(&[0.5, 0.3, 0.2], [0.02, -0.01]), true),
        (brown(&[0.3, 0.2, 0.1, 0.1, 0.05, 0.02], [-0.01, 0.015]), true),
        (brown(&[6.1, 1.9, 0.05, 6.5, 3.9, 0.4], [1e-4, -2e-4]), true),
        (brown(&[], [0.1, -0.06]), false),
        (fisheye([0.0; 4], [0.0; 2], [0.0; 2]), true),
        (fisheye([0.02, -0.01, 0.003, -0.0005], [0.0; 2], [0.0; 2]), true),
        (fisheye([-0.3, 0.0, 0.0, 0.0], [0.0; 2], [0.0; 2]), false),
        (fisheye([0.02, -0.01, 0.003, 0.0004], [0.002, -0.003], [0.004, -0.001]), true),
        (fisheye([-0.1, 0.02, 0.0, 0.0], [-0.1, 0.08], [0.2, 0.15]), false),
        (Lens::Fov { omega: 0.92 }, true),
        (Lens::Fov { omega: 1e-9 }, true),
        (Lens::Fov { omega: 2.0 }, false),
        (Lens::Equirectangular, true),
    ]
}

#[test]
fn image_points_round_trip() {
    for (lens, filled) in lenses() {
        let (mut seen, mut dark) = (0, 0);
        for row in (0..=2000).step_by(40) {
            for column in (0..=1500).step_by(30) {
                let place = [(f64::from(column) - 750.0) / FOCAL, (f64::from(row) - 1000.0) / FOCAL];
                let nearest = lens.nearest(place);
                assert!((nearest.length() - 1.0).abs() < 1e-12, "{lens:?} at {place:?}: {nearest}");
                let Some(direction) = lens.direction(place) else {
                    dark += 1;
                    let outermost = lens.place(nearest * 0.3);
                    // The outermost direction of a FOV lens is at a right angle to the axis, so it does not project.
                    assert!(outermost.is_some() || matches!(lens, Lens::Fov { .. }), "{lens:?}: {place:?} {nearest}");
                    continue;
                };
                seen += 1;
                assert_eq!(direction, nearest);
                let again = lens.place(direction * 3.0).unwrap_or_else(|| panic!("{lens:?} at {place:?}"));
                assert!(distance(again, place) * FOCAL < PIXEL, "{lens:?}: {again:?} for {place:?}");
            }
        }
        assert!((dark == 0) == filled && seen > 330, "{lens:?}: {seen} seen, {dark} dark");
    }
}

#[test]
fn directions_round_trip() {
    for (lens, _) in lenses() {
        let mut seen = 0;
        for ring in 0..150 {
            let angle = f64::from(ring) / 150.0 * PI;
            for turn in 0..24 {
                let (sin, cos) = (f64::from(turn) * PI / 12.0 + 0.05).sin_cos();
                let toward = |angle: f64| DVec3::new(angle.sin() * cos, angle.sin() * sin, angle.cos());
                let Some(place) = lens.place(2.0 * toward(angle)) else {
                    continue;
                };
                // Near a fold many directions project to one point, and a pinhole's points diverge.
                if lens.place(toward(angle + 0.01)).is_none() || place[0].hypot(place[1]) > 1e3 {
                    continue;
                }
                seen += 1;
                let again = lens.direction(place).unwrap_or_else(|| panic!("{lens:?} at {angle}, {turn}"));
                let miss = (again - toward(angle)).length();
                assert!(miss * FOCAL < PIXEL, "{lens:?} at {angle}, {turn}: {again}, off by {miss}");
            }
        }
        assert!(seen > 250, "{lens:?}: {seen}");
    }
}

#[test]
fn fox_lens_round_trips_and_distorts() {
    let camera = Camera {
        width: 1080,
        height: 1920,
        focal: [1375.52, 1374.49],
        centre: [554.558, 965.268],
        lens: fox(),
        pose: DAffine3::IDENTITY,
    };
    for (column, row) in (0..1080).step_by(9).flat_map(|i| (0..1920).step_by(16).map(move |j| (i, j))) {
        let [x, y] = [f64::from(column) + 0.5, f64::from(row) + 0.5];
        assert!(camera.sees(x, y));
        let ray = camera.ray(x, y);
        assert!(distance(camera.pixel_of(ray.at(2.0)).unwrap(), [x, y]) < PIXEL);
    }
    // The lens distorts: the corner moves by some pixels.
    let pinhole = Camera { lens: Lens::Pinhole, ..camera.clone() };
    let moved = distance(pinhole.pixel_of(camera.ray(0.5, 0.5).at(1.0)).unwrap(), [0.5, 0.5]);
    assert!((1.0..60.0).contains(&moved), "{moved}");
}

#[test]
fn points_beyond_a_fold_have_no_direction() {
    // r (1 - r^2 / 2) is at most (2/3)^(3/2), at sqrt(2/3).
    let (lens, most) = (brown(&[-0.5], [0.0; 2]), (2.0_f64 / 3.0).powf(1.5));
    assert!((most - 0.5443311).abs() < 1e-7);
    let [inside, outside] = [1.0 - 1e-9, 1.0 + 1e-9].map(|part| [0.6 * part * most, -0.8 * part * most]);
    assert!(lens.direction(inside).is_some() && lens.direction(outside).is_none());
    for place in [outside, [0.6, -0.8], [6e8, -8e8]] {
        let nearest = lens.nearest(place);
        let before = [nearest.x / nearest.z, nearest.y / nearest.z];
        assert!(distance(before, [0.6, -0.8].map(|e| e * (2.0_f64 / 3.0).sqrt())) < 1e-7, "{before:?}");
        assert!(distance(lens.place(nearest).unwrap(), [0.6, -0.8].map(|e| e * most)) < 1e-14);
    }
    assert_eq!(lens.place(DVec3::new(0.9, 0.0, 1.0)), None, "beyond the fold");
    assert_eq!(lens.place(DVec3::new(0.1, 0.0, -1.0)), None, "behind");
    assert_eq!(Lens::Pinhole.place(DVec3::new(0.1, 0.0, -1.0)), None, "behind");
    // The slope 1 - 0.9 s + 0.35 s^2 has no root, so every point has a direction.
    let wide = brown(&[-0.3, 0.07], [0.0; 2]);
    for r in [0.1, 1.0, 3.0, 40.0] {
        let direction = wide.direction([r, 0.0]).unwrap();
        assert!((wide.place(direction).unwrap()[0] / r - 1.0).abs() < 1e-12);
    }
}

#[test]
fn fisheye_sees_behind_the_camera() {
    let lens = fisheye([0.0; 4], [0.0; 2], [0.0; 2]);
    for (angle, place) in [(1.0, [1.0, 0.0]), (2.0, [0.0, 2.0]), (3.1, [-3.1, 0.0])] {
        let direction = lens.direction(place).unwrap();
        assert!((direction.z - f64::cos(angle)).abs() < 1e-15);
        assert!(distance(lens.place(direction).unwrap(), place) < 1e-13);
    }
    assert!(lens.direction([3.2, 0.0]).is_none(), "beyond half a turn");
    assert!((lens.nearest([3.2, 0.0]) - DVec3::NEG_Z).length() < 1e-7);
    assert_eq!(lens.place(DVec3::NEG_Z), None, "straight behind is everywhere");
    assert_eq!(lens.place(DVec3::Z), Some([0.0, 0.0]));
}

#[test]
fn fov_lens_of_omega_zero_is_a_pinhole() {
    for omega in [0.0, 1e-300, 1e-160, 1e-12, -1e-12, 1e-9] {
        let lens = Lens::Fov { omega };
        for (x, y) in [(0.3, -0.2), (1e-9, 1e-12), (5.0, 7.0)] {
            let place = lens.place(DVec3::new(x, y, 1.0)).unwrap();
            assert!(distance(place, [x, y]) < 1e-14 * f64::hypot(x, y), "{omega}: {place:?} for {x} {y}");
            let direction = lens.direction([x, y]).unwrap();
            assert!(
                distance([direction.x / direction.z, direction.y / direction.z], [x, y]) < 1e-14 * f64::hypot(x, y)
            );
        }
    }
    // Even in omega, and at a right angle to the axis at pi / (2 omega).
    let (one, other) = (Lens::Fov { omega: 0.9 }, Lens::Fov { omega: -0.9 });
    assert_eq!(one.direction([0.7, 0.4]), other.direction([0.7, 0.4]));
    let edge = FRAC_PI_2 / 0.9;
    assert!(one.direction([edge * (1.0 - 1e-12), 0.0]).is_some() && one.direction([edge, 0.0]).is_none());
    assert!((one.nearest([0.0, 5.0]) - DVec3::Y).length() < 1e-15);
}

#[test]
fn equirectangular_covers_all_directions() {
    let lens = Lens::Equirectangular;
    for (place, direction) in [
        ([0.0, 0.0], DVec3::Z),
        ([FRAC_PI_2, 0.0], DVec3::X),
        ([-FRAC_PI_2, 0.0], DVec3::NEG_X),
        ([0.0, FRAC_PI_2], DVec3::Y),
        ([PI, 0.0], DVec3::NEG_Z),
    ] {
        assert!((lens.direction(place).unwrap() - direction).length() < 1e-15);
        assert!(distance(lens.place(direction).unwrap(), place) < 1e-15);
    }
    for outside in [[3.15, 0.0], [0.0, 1.58], [0.0, -1.58], [-3.15, 0.0]] {
        assert!(lens.direction(outside).is_none());
        assert!(lens.direction(outside.map(|x| 0.99 * x)).is_some());
    }
    assert!((lens.nearest([0.0, 9.0]) - DVec3::Y).length() < 1e-15);
}

#[test]
fn coefficients_round_trip_and_are_checked() {
    for (lens, _) in lenses() {
        let coefficients = lens.coefficients();
        assert_eq!(lens.with_coefficients(&coefficients), lens);
        lens.check().unwrap();
        let direction = DVec3::new(0.2, -0.1, 0.9);
        let place = lens.project(&coefficients, direction.to_array());
        assert!(distance(place, lens.place(direction).unwrap()) < 1e-15, "{lens:?}");
        for i in 0..coefficients.len() {
            for bad in [f64::NAN, f64::INFINITY] {
                let mut broken = coefficients.clone();
                broken[i] = bad;
                let error = lens.with_coefficients(&broken).check().unwrap_err().to_string();
                assert!(error.starts_with("`lens`: ") && !error.contains('\n'), "{error}");
            }
        }
    }
    assert!(Lens::Fov { omega: 3.2 }.check().is_err());
}

/// Numbers of all magnitudes.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        Just(0.0),
        -2.0..2.0_f64,
        (-300.0..300.0_f64, any::<bool>()).prop_map(|(e, minus)| {
            let size = 10.0_f64.powf(e);
            if minus { -size } else { size }
        })
    ]
}

proptest! {
    #[test]
    fn lens_results_are_finite_for_any_numbers(c in prop::array::uniform8(number()), x in number(), y in number()) {
        for lens in [
            Lens::Pinhole,
            Lens::Brown { k: [0.0; 6], p: [0.0; 2] }.with_coefficients(&c),
            brown(&c[..2], [0.0; 2]),
            brown(&c[..2], [c[6], 0.0]),
            Lens::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] }.with_coefficients(&c),
            fisheye([c[0], c[1], 0.0, 0.0], [0.0; 2], [0.0; 2]),
            Lens::Fov { omega: c[0] },
            Lens::Equirectangular,
        ] {
            if lens.check().is_err() {
                continue;
            }
            let nearest = lens.nearest([x, y]);
            prop_assert!((nearest.length() - 1.0).abs() < 1e-9, "{:?} at {} {}: {}", lens, x, y, nearest);
            if let Some(direction) = lens.direction([x, y]) {
                prop_assert!((direction.length() - 1.0).abs() < 1e-9, "{:?} at {} {}: {}", lens, x, y, direction);
            }
            if let Some(place) = lens.place(DVec3::new(x, y, 1.0)) {
                prop_assert!(place.iter().all(|x| x.is_finite()));
            }
        }
    }

    #[test]
    fn radial_lenses_round_trip(k in prop::array::uniform3(-1.0..1.0_f64), share in 0.0..0.999_f64, bent: bool) {
        let lens = if bent { fisheye([k[0], k[1], k[2], 0.0], [0.0; 2], [0.0; 2]) } else { brown(&k, [0.0; 2]) };
        let outermost = lens.nearest([1e9, 0.0]);
        let angle = share * outermost.x.atan2(outermost.z).min(1.5);
        let direction = DVec3::new(0.6 * angle.sin(), -0.8 * angle.sin(), angle.cos());
        let again = lens.direction(lens.place(direction).unwrap()).unwrap();
        // Near the fold many directions project to nearly one point.
        prop_assert!((again - direction).length() < 1e-14 / (1.0 - share).min(0.01), "{} for {}", again, direction);
    }
}
