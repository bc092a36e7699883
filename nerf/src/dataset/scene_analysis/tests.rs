use super::*;
use std::path::{Path, PathBuf};

fn camera(eye: DVec3, target: DVec3, up: DVec3) -> Camera {
    Camera { focal: [500.0, 250.0], ..Camera::from_angle(400, 300, 0.8, Camera::look_at(eye, target, up)) }
}

fn capture(format: Format, cameras: Vec<Camera>) -> Capture {
    let view = |(i, camera): (usize, Camera)| View {
        image: Some(PathBuf::from(format!("{i}.png"))),
        ..View::new(format!("{i}.png"), format!("frames[{i}]"), camera)
    };
    Capture::new(
        Path::new("scene"),
        "scene/transforms.json".into(),
        format,
        cameras.into_iter().enumerate().map(view).collect(),
    )
}

const CENTRE: DVec3 = DVec3::new(10.0, 20.0, 5.0);

/// Cameras on a quarter circle of that radius around the centre, pitched down, with y downwards as in COLMAP.
fn quarter(radius: f64) -> Vec<Camera> {
    let eye = |i: usize| {
        let angle = i as f64 * 0.3;
        CENTRE + radius * DVec3::new(0.8 * angle.cos(), -0.6, 0.8 * angle.sin())
    };
    (0..6).map(|i| camera(eye(i), CENTRE, DVec3::NEG_Y)).collect()
}

#[test]
fn centre_and_up_come_from_cameras() {
    let analysis = SceneAnalysis::new(&capture(Format::Colmap, quarter(4.0)), None, None).unwrap();
    assert_eq!(analysis.scene_type, SceneType::Unbounded);
    // Damping pulls the centre a little towards the cameras.
    assert!(analysis.transform.origin.distance(CENTRE) < 0.05, "{}", analysis.transform.origin);
    let up = analysis.transform.rotation * DVec3::NEG_Y;
    assert!(up.distance(DVec3::Z) < 1e-3, "{up}");
    analysis.transform.check().unwrap();
    // Half of the box is half of the cameras' distance, which becomes 1.5 units.
    assert!((analysis.transform.scale - 1.5 / 2.0).abs() < 0.005, "{}", analysis.transform.scale);
    assert_eq!(analysis.bounds, [DVec3::splat(-1.5), DVec3::splat(1.5)]);
    assert!((analysis.near - 0.05 * 3.0).abs() < 1e-3 && (analysis.far - 3000.0).abs() < 1e-9, "{analysis:?}");
    // An outlier, far away and looking elsewhere, has little influence.
    let mut cameras = quarter(4.0);
    cameras.push(camera(CENTRE + DVec3::new(300.0, 50.0, 0.0), CENTRE + DVec3::new(300.0, 90.0, 20.0), DVec3::NEG_Y));
    let lost = SceneAnalysis::new(&capture(Format::Colmap, cameras), None, None).unwrap();
    assert!(lost.transform.origin.distance(CENTRE) < 0.5, "{}", lost.transform.origin);
}

#[test]
fn outward_cameras_are_at_the_centre() {
    let outwards = [[1.0, 0.0], [0.0, 1.0], [0.3, -1.0], [2.0, 0.5]].map(|[x, y]| {
        let eye = DVec3::new(x, y, 0.0);
        camera(eye, 3.0 * eye, DVec3::Z)
    });
    let mean = outwards.iter().map(|camera| camera.pose.translation).sum::<DVec3>() / 4.0;
    let analysis = SceneAnalysis::new(&capture(Format::Transforms, outwards.to_vec()), None, None).unwrap();
    assert!(analysis.transform.origin.distance(mean) < 1e-9, "{}", analysis.transform.origin);
    assert!(analysis.transform.rotation.abs_diff_eq(DMat3::IDENTITY, 1e-9), "upright already");
    assert!(analysis.reason.ends_with("; cameras look around"), "{}", analysis.reason);
    // The scene is assumed to be three times as far as the cameras' spread, unless points give a distance.
    let spread = median(outwards.iter().map(|camera| camera.pose.translation.distance(mean)));
    let half = |analysis: &SceneAnalysis| 1.5 / analysis.transform.scale;
    assert!((half(&analysis) - 3.0 * spread).abs() < 1e-9, "{}", half(&analysis));
    let mut room = capture(Format::Colmap, outwards.to_vec());
    let wall = |i: usize| mean + 7.0 * DVec3::new((i as f64).cos(), (i as f64).sin(), 0.0);
    room.points = (0..150).map(|i| Point { position: wall(i), color: [0; 3], error: 1.0, views: 3 }).collect();
    assert!((half(&SceneAnalysis::new(&room, None, None).unwrap()) - 7.0).abs() < 1e-9);
    // Points among the cameras do not shrink the box below the cameras' spread.
    room.points.iter_mut().for_each(|point| point.position = mean + 1e-3 * point.position);
    assert!((half(&SceneAnalysis::new(&room, None, None).unwrap()) - spread).abs() < 1e-9);
}

#[test]
fn parallel_cameras_put_the_centre_ahead() {
    let wall = (0..5).map(|i| {
        let eye = DVec3::new(0.1 * f64::from(i), 0.05 * f64::from(i % 2), 0.0);
        camera(eye, eye + DVec3::Y, DVec3::Z)
    });
    let mut wall = capture(Format::Colmap, wall.collect());
    let mean = wall.views.iter().map(|view| view.camera.pose.translation).sum::<DVec3>() / 5.0;
    let spread = median(wall.views.iter().map(|view| view.camera.pose.translation.distance(mean)));
    let analysis = SceneAnalysis::new(&wall, None, None).unwrap();
    assert!(analysis.transform.origin.distance(mean + 5.0 * spread * DVec3::Y) < 1e-9, "{}", analysis.transform.origin);
    assert_eq!(
        analysis.reason,
        "images are opaque, so they show a background, and all cameras look ahead; cameras look the same way"
    );
    assert_eq!(analysis.scene_type, SceneType::ForwardFacing);
    let placed: Vec<Camera> = wall.views.iter().map(|view| analysis.transform.camera(&view.camera)).collect();
    assert_eq!(analysis.ndc, Some(Ndc::around(&placed, analysis.near).unwrap()));
    let asked = SceneAnalysis::new(&wall, None, Some(SceneType::Unbounded)).unwrap();
    assert_eq!(
        asked,
        SceneAnalysis {
            scene_type: SceneType::Unbounded,
            ndc: None,
            reason: "as requested; cameras look the same way".into(),
            ..analysis
        }
    );
    assert_eq!(SceneAnalysis::new(&wall, Some(EmptyBackground::White), None).unwrap().scene_type, SceneType::Bounded);
    let place = |i: usize| DVec3::new(0.2 + 0.1 * (i as f64).sin(), 4.0, 0.0);
    wall.points = (0..150).map(|i| Point { position: place(i), color: [0; 3], error: 1.0, views: 3 }).collect();
    let analysis = SceneAnalysis::new(&wall, None, None).unwrap();
    assert!(analysis.transform.origin.distance(mean + 3.98 * DVec3::Y) < 0.01, "{}", analysis.transform.origin);
    assert!((1.5 / analysis.transform.scale - 1.99).abs() < 0.03, "half of the distance");
    // Depth alone counts, not lateral distance: a flight at a height of 50 over a wide field.
    let flight = (0..25).map(|i| {
        let eye = DVec3::new(100.0 * f64::from(i % 5), 100.0 * f64::from(i / 5), 50.0);
        // Slightly tilted, so that the axes have no common point.
        let askew = 3.0 * DVec3::new((7.0 * f64::from(i)).sin(), (3.0 * f64::from(i)).cos(), 0.0);
        camera(eye, eye + askew - 50.0 * DVec3::Z, DVec3::Y)
    });
    let mut flight = capture(Format::Colmap, flight.collect());
    let field = |i: usize| DVec3::new(400.0 * (i as f64).sin().powi(2), 400.0 * (1.3 * i as f64).cos().powi(2), 0.0);
    flight.points = (0..500).map(|i| Point { position: field(i), color: [0; 3], error: 1.0, views: 3 }).collect();
    // Many unreliable points.
    let bad = Point { position: DVec3::new(0.0, 0.0, -900.0), color: [0; 3], error: 9.0, views: 1 };
    flight.points.extend(std::iter::repeat_n(bad, 600));
    let analysis = SceneAnalysis::new(&flight, None, None).unwrap();
    assert!(analysis.reason.ends_with("; cameras look the same way"), "{}", analysis.reason);
    assert!(analysis.transform.origin.distance(DVec3::new(200.0, 200.0, 0.0)) < 8.0, "{}", analysis.transform.origin);
    assert!(1.5 / analysis.transform.scale > 100.0, "all of the flight is in the box");
    // Ninety-nine points are too few.
    wall.points.truncate(99);
    let few = SceneAnalysis::new(&wall, None, None).unwrap();
    assert!(few.transform.origin.distance(mean + 5.0 * spread * DVec3::Y) < 1e-9);
}

#[test]
fn forward_walk_is_not_forward_facing() {
    let walk = (0..5).map(|i| {
        let eye = DVec3::new(0.1 * f64::from(i % 2), 0.3 * f64::from(i), 0.0);
        camera(eye, eye + DVec3::Y, DVec3::Z)
    });
    let analysis = SceneAnalysis::new(&capture(Format::Colmap, walk.collect()), None, None).unwrap();
    assert_eq!((analysis.scene_type, analysis.ndc), (SceneType::Unbounded, None));
    let asked = SceneAnalysis::new(&capture(Format::Colmap, quarter(4.0)), None, Some(SceneType::ForwardFacing))
        .unwrap_err()
        .to_string();
    let expected = "cannot be forward-facing: cameras look in different directions; use unbounded";
    assert_eq!(asked, format!("`scene-type`: {expected}"));
    assert!(analysis.reason.starts_with("images are opaque, so they show a background; "), "{}", analysis.reason);
}

/// The cameras, turned about their optical axes: images on their side, as phones store portraits.
fn rolled(cameras: &[Camera], degrees: f64) -> Vec<Camera> {
    let turn = DMat3::from_rotation_z(degrees.to_radians());
    let roll = |camera: &Camera| {
        let pose = DAffine3 { matrix3: camera.pose.matrix3 * turn, ..camera.pose };
        Camera { pose, ..camera.clone() }
    };
    cameras.iter().map(roll).collect()
}

#[test]
fn up_of_images_on_their_side_is_that_of_upright_ones() {
    let orbit = |pitch: f64, arc: f64| {
        let eye = move |i: usize| {
            let (sin, cos) = (arc * i as f64 / 12.0).sin_cos();
            CENTRE + 4.0 * DVec3::new(pitch.cos() * cos, pitch.cos() * sin, pitch.sin())
        };
        (0..12).map(|i| camera(eye(i), CENTRE, DVec3::Z)).collect::<Vec<_>>()
    };
    let analyse = |cameras| SceneAnalysis::new(&capture(Format::Colmap, cameras), None, None).unwrap();
    let up = |cameras| analyse(cameras).transform.rotation.transpose() * DVec3::Z;
    for (pitch, arc) in [(0.3, 6.2), (0.6, 6.2), (0.4, 3.1), (0.2, 2.2)] {
        let upright = orbit(pitch, arc);
        for degrees in [0.0, 90.0, -90.0] {
            let cameras = rolled(&upright, degrees);
            assert!(up(cameras.clone()).distance(DVec3::Z) < 0.02, "{pitch} {arc} {degrees}: {}", up(cameras));
        }
        let is_said =
            |degrees: f64| analyse(rolled(&upright, degrees)).reason.ends_with("; all images are on their side");
        assert_eq!([0.0, 90.0, -90.0].map(is_said), [false, true, true]);
    }
    // Level cameras tell no side, so that of phones counts: up is on the left.
    let level = orbit(0.0, 6.2);
    assert!(up(rolled(&level, -90.0)).distance(DVec3::Z) < 0.02 && up(rolled(&level, 90.0)).distance(-DVec3::Z) < 0.02);
    // Cameras that all look the same way have no axis that is more parallel.
    assert!(!analyse(quarter(4.0)).reason.contains("side"));
}

#[test]
fn downward_cameras_have_up_behind_them() {
    // Two strips of a flight; the second is flown back, so the cameras have no common up axis.
    let flight = (0..8).map(|i| {
        let north = if i % 2 == 0 { DVec3::Y } else { DVec3::NEG_Y };
        let eye = DVec3::new(f64::from(i), f64::from(i % 3), 50.0);
        camera(eye, eye - DVec3::Z * 50.0, north)
    });
    let analysis = SceneAnalysis::new(&capture(Format::Colmap, flight.collect()), None, None).unwrap();
    assert!((analysis.transform.rotation * DVec3::Z).z > 0.9, "{:?}", analysis.transform.rotation);
}

#[test]
fn bounded_scene_is_as_wide_as_cameras_see() {
    let eyes = [DVec3::new(3.0, 0.0, 0.0), DVec3::new(0.0, 4.0, 0.0), DVec3::new(-8.0, 0.0, 0.0)];
    let cameras = eyes.map(|eye| camera(eye, DVec3::ZERO, DVec3::Z));
    let analysis =
        SceneAnalysis::new(&capture(Format::Transforms, cameras.to_vec()), Some(EmptyBackground::Transparent), None)
            .unwrap();
    assert_eq!(analysis.scene_type, SceneType::Bounded);
    // Half of 300 rows over a focal length of 250 is more than half of 400 columns over 500: 0.6 of the distance 4.
    let half = 1.5 / analysis.transform.scale;
    assert!((half - 2.4).abs() < 0.02, "{half}");
    let (near, far) = (analysis.near / analysis.transform.scale, analysis.far / analysis.transform.scale);
    // The first camera is 3 - 2.4 from the box, the last 8 + 2.4 along x from its far side; both with a margin of 1 %.
    assert!((near - 0.99 * 0.6).abs() < 0.03, "{near}");
    assert!((far - 1.01 * DVec3::new(10.4, 2.4, 2.4).length()).abs() < 0.1, "{far}");
}

#[test]
fn near_and_far_of_bounded_scenes_hold_the_box() {
    let orbit = |radius: f64| {
        let eye = |i: usize| {
            let (sin, cos) = (0.7 * i as f64).sin_cos();
            radius * DVec3::new(0.8 * cos, 0.8 * sin, 0.6)
        };
        let cameras = (0..9).map(|i| camera(eye(i), DVec3::ZERO, DVec3::Z)).collect();
        SceneAnalysis::new(&capture(Format::Blender, cameras), Some(EmptyBackground::Transparent), None).unwrap()
    };
    // Lego-like, near, and beyond the convention.
    for radius in [4.0, 2.6, 9.0] {
        let analysis = orbit(radius);
        let [mut near, mut far] = [f64::INFINITY, 0.0_f64];
        for i in 0..9 {
            let (sin, cos) = (0.7 * f64::from(i)).sin_cos();
            let eye = analysis.transform.point(radius * DVec3::new(0.8 * cos, 0.8 * sin, 0.6));
            for j in 0..60 * 60 {
                let target = 1.499 * DVec3::new(f64::from(j % 60) / 29.5 - 1.0, f64::from(j / 60) / 29.5 - 1.0, 0.0);
                for target in [target, target + 1.499 * DVec3::Z, target - 1.499 * DVec3::Z] {
                    let ray = crate::Ray { origin: eye, direction: (target - eye).normalize() };
                    let [enter, leave] = crate::intersect_box(&ray, analysis.bounds).unwrap();
                    (near, far) = (near.min(enter), far.max(leave));
                }
            }
        }
        // All of the box is within the planes, and they are no farther apart than its rays need.
        assert!((0.95 * near..=near).contains(&analysis.near), "{radius}: {near} {}", analysis.near);
        assert!((far..1.05 * far).contains(&analysis.far), "{radius}: {far} {}", analysis.far);
    }
    // Some of the box is visible from inside.
    let mut inside = capture(Format::Transforms, quarter(4.0));
    inside.views[0].camera.pose.translation = CENTRE + DVec3::new(0.1, 0.2, 0.3);
    let inside = SceneAnalysis::new(&inside, Some(EmptyBackground::Transparent), None).unwrap();
    assert!((0.001..0.1).contains(&inside.near), "{}", inside.near);
}

/// 5 x 5 cameras in a grid that look straight down from a height of 50 with one heading, and points on the ground. An
/// image shows 40 x 60 units.
fn nadir(spacing: f64, format: Format) -> Capture {
    let eye = |i: usize| spacing * DVec3::new((i % 5) as f64 - 2.0, (i / 5) as f64 - 2.0, 0.0) + 50.0 * DVec3::Z;
    let mut capture = capture(format, (0..25).map(|i| camera(eye(i), eye(i) - DVec3::Z, DVec3::Y)).collect());
    let half = DVec3::new(2.0 * spacing + 20.0, 2.0 * spacing + 30.0, 2.0);
    let point = |i: usize| half * DVec3::new((7.1 * i as f64).sin(), (3.3 * i as f64).cos(), (5.7 * i as f64).sin());
    capture.points = (0..900).map(|i| Point { position: point(i), color: [0; 3], error: 1.0, views: 3 }).collect();
    capture
}

#[test]
fn aerial_survey_is_not_forward_facing() {
    let known_by_depths = |mut capture: Capture| {
        capture.points.clear();
        capture.views.iter_mut().for_each(|view| view.bounds = Some([45.0, 55.0]));
        capture
    };
    // Neighbours overlap by 70 % along x, as in a survey, or by 95 %, as in LLFF's arrays.
    for (spacing, expected) in [(12.0, SceneType::Unbounded), (2.0, SceneType::ForwardFacing)] {
        for capture in [nadir(spacing, Format::Colmap), known_by_depths(nadir(spacing, Format::Llff))] {
            assert!(Ndc::around(capture.views.iter().map(|view| &view.camera), 1.0).is_ok());
            let analysis = SceneAnalysis::new(&capture, None, None).unwrap();
            assert_eq!((analysis.scene_type, analysis.ndc.is_some()), (expected, expected != SceneType::Unbounded));
            let is_survey = analysis.reason.contains("most images overlap little, as in an aerial survey");
            assert_eq!(is_survey, expected == SceneType::Unbounded, "{}", analysis.reason);
            // The ground is in the middle of the box, and nothing of it is before the near plane.
            let near = analysis.near / analysis.transform.scale;
            assert!(analysis.transform.origin.length() < 1.0 && near < 48.0, "{near} {analysis:?}");
            let asked = SceneAnalysis::new(&capture, None, Some(SceneType::ForwardFacing)).unwrap();
            assert!(asked.ndc.is_some());
        }
    }
    // The box of a wide flight holds it, whether points or depths give the distance.
    for capture in [nadir(60.0, Format::Colmap), known_by_depths(nadir(60.0, Format::Llff))] {
        let half = 1.5 / SceneAnalysis::new(&capture, None, None).unwrap().transform.scale;
        assert!(half > 119.0, "{half}");
    }
    // Too few points leave the distance open.
    let mut unknown = nadir(12.0, Format::Colmap);
    unknown.points.truncate(99);
    assert_eq!(SceneAnalysis::new(&unknown, None, None).unwrap().scene_type, SceneType::ForwardFacing);
}

#[test]
fn near_plane_comes_from_points_or_depths() {
    let mut capture = capture(Format::Colmap, quarter(4.0));
    let eye = capture.views[0].camera.pose.translation;
    let towards = (CENTRE - eye).normalize();
    let point = |distance: f64| Point { position: eye + distance * towards, color: [0; 3], error: 1.0, views: 3 };
    // The two nearest of four hundred are ignored.
    capture.points =
        (0..400).map(|i| point([0.1, 0.2, 1.0].get(i).copied().unwrap_or(1.0 + 0.01 * i as f64))).collect();
    let near = |capture: &Capture| {
        let analysis = SceneAnalysis::new(capture, None, None).unwrap();
        analysis.near / analysis.transform.scale
    };
    assert!((near(&capture) - 0.5).abs() < 0.2, "{}", near(&capture));
    let usual = 0.05 * 4.0;
    for spoil in [|p: &mut Point| p.views = 2, |p: &mut Point| p.error = 2.01] {
        let mut spoilt = capture.clone();
        spoilt.points.iter_mut().for_each(spoil);
        assert!((near(&spoilt) - usual).abs() < 0.01, "{}", near(&spoilt));
    }
    // nerfstudio's files do not count the images of a point.
    capture.points.iter_mut().for_each(|p| (p.views, p.error) = (0, f64::NAN));
    assert!((near(&capture) - 0.5).abs() < 0.2);
    // A forward-facing capture: the centre is ahead, halfway in inverse distance.
    let forward = (0..5).map(|i| {
        let eye = DVec3::new(0.1 * f64::from(i), 0.0, 0.0);
        camera(eye, eye + DVec3::Y, DVec3::Z)
    });
    let mut forward = self::capture(Format::Llff, forward.collect());
    forward.views.iter_mut().for_each(|view| view.bounds = Some([2.0, 6.0]));
    let analysis = SceneAnalysis::new(&forward, None, None).unwrap();
    assert!(analysis.transform.origin.distance(DVec3::new(0.2, 3.0, 0.0)) < 1e-9, "{}", analysis.transform.origin);
    assert!((analysis.near / analysis.transform.scale - 1.0).abs() < 1e-9);
    // Half of the cameras are enough; the others do not count.
    forward.views[1].bounds = None;
    forward.views[3].bounds = None;
    let half = SceneAnalysis::new(&forward, None, None).unwrap();
    assert!(half.transform.origin.distance(analysis.transform.origin) < 1e-9 && half.reason == analysis.reason);
    forward.views[2].bounds = None;
    let few = SceneAnalysis::new(&forward, None, None).unwrap();
    assert!(few.reason.ends_with("cameras look the same way"), "{}", few.reason);
}

#[test]
fn scene_type_flag_beats_convention_beats_alpha() {
    let around = |radius: f64| {
        let mut capture = capture(Format::Blender, quarter(radius));
        capture.views.iter_mut().for_each(|view| view.camera.pose.translation -= CENTRE);
        capture
    };
    // Opaque images show a background, wherever their cameras are.
    assert_eq!(SceneAnalysis::new(&around(4.0), None, None).unwrap().scene_type, SceneType::Unbounded);
    let asked = SceneAnalysis::new(&around(4.0), None, Some(SceneType::Bounded)).unwrap();
    let conventional = SceneAnalysis::new(&around(4.0), Some(EmptyBackground::Transparent), None).unwrap();
    assert_eq!(SceneAnalysis { empty: Some(EmptyBackground::Transparent), ..asked }, conventional);
    assert_eq!(conventional.transform, SceneTransform::default());
    assert_eq!(conventional.scene_type, SceneType::Bounded);
    assert_eq!(
        SceneAnalysis::new(&around(4.0), Some(EmptyBackground::Transparent), Some(SceneType::Unbounded))
            .unwrap()
            .scene_type,
        SceneType::Unbounded
    );
    for radius in [2.4, 5.6] {
        let other = SceneAnalysis::new(&around(radius), Some(EmptyBackground::Transparent), None).unwrap();
        assert!(other.transform != SceneTransform::default() && other.scene_type == SceneType::Bounded, "{radius}");
        assert_eq!(SceneAnalysis::new(&around(radius), None, None).unwrap().scene_type, SceneType::Unbounded);
    }
    assert_eq!("unbounded".parse::<SceneType>().unwrap().to_string(), "unbounded");
    let message = "endless".parse::<SceneType>().unwrap_err().to_string();
    assert_eq!(message, "`scene-type`: is `endless`; use bounded, unbounded or forward-facing");
}

#[test]
fn captures_without_size_or_images_are_errors() {
    let mut one = capture(Format::Colmap, vec![quarter(4.0)[0].clone(); 5]);
    let message = SceneAnalysis::new(&one, None, None).unwrap_err().to_string();
    assert!(message.contains("one place") && message.contains("`raygrad doctor "), "{message}");
    // Most images are absent.
    one.views[1..].iter_mut().for_each(|view| view.image = None);
    let message = SceneAnalysis::new(&one, None, None).unwrap_err().to_string();
    assert!(message.contains("`frames[1]`: only 1 of 5 images exist, all from one place (the first"), "{message}");
    one.views.iter_mut().for_each(|view| view.image = None);
    let message = SceneAnalysis::new(&one, None, None).unwrap_err().to_string();
    assert!(
        message.contains("frames[0]") && message.contains("none of the 5 images") && message.contains("0.png"),
        "{message}"
    );
    one.views.clear();
    assert!(SceneAnalysis::new(&one, None, None).is_err());
}
