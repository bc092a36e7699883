//! The doctor names faults planted in a good capture, and finds none in the capture itself.

use raygrad::nerf::dataset::{Capture, Depths, Format, Point, SceneAnalysis, SceneType, Split, View, evenly_spaced};
use raygrad::nerf::doctor::{
    DoctorOptions, Finding, FindingKind as Kind, Report, Resolution, Severity, examine, examine_cameras,
};
use raygrad::nerf::glam::{DAffine3, DMat3, DQuat, DVec3};
use raygrad::nerf::{Camera, Image, Lens, Result};
use raygrad_scenes::{Landscape, Scene, embedded, walk_cameras, window_cameras};
use std::f64::consts::PI;
use std::path::PathBuf;
use std::sync::LazyLock;
use tempfile::TempDir;

/// The side of the images.
const SIZE: usize = 160;

/// The number of images.
const ALL: usize = 48;

/// Images of the embedded scene: 40 for training, 8 for testing.
static PHOTOGRAPHS: LazyLock<Vec<(Split, Camera, Image)>> = LazyLock::new(|| {
    let of = |split: Split, count: usize| {
        let frames = evenly_spaced(embedded(split, SIZE).frames, count);
        frames.into_iter().map(move |frame| (split, frame.camera, frame.image.to_image()))
    };
    of(Split::Train, 40).chain(of(Split::Test, 8)).collect()
});

/// Their encoded files.
static FILES: LazyLock<Vec<Vec<u8>>> = LazyLock::new(|| PHOTOGRAPHS.iter().map(|(.., image)| image.to_png()).collect());

/// A capture in a temporary folder for planted faults.
struct Planted {
    folder: TempDir,
    capture: Capture,
    scene_type: Option<SceneType>,
}

impl Planted {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let views = PHOTOGRAPHS.iter().zip(&*FILES).enumerate().map(|(i, ((split, camera, _), file))| {
            let name = format!("{i:02}.png");
            let path = folder.path().join(&name);
            std::fs::write(&path, file).unwrap();
            View { image: Some(path), split: Some(*split), ..View::new(name, format!("frames[{i}]"), camera.clone()) }
        });
        let capture =
            Capture::new(folder.path(), folder.path().join("transforms.json"), Format::Transforms, views.collect());
        Planted { folder, capture, scene_type: None }
    }

    /// A capture of rendered images, of which every eighth is held out.
    fn of(cameras: Vec<Camera>, render: impl Fn(&Camera) -> Image) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let views = cameras.into_iter().enumerate().map(|(i, camera)| {
            let name = format!("{i:02}.png");
            let path = folder.path().join(&name);
            render(&camera).save_png(&path).unwrap();
            let split = Some(if i % 8 == 0 { Split::Test } else { Split::Train });
            View { image: Some(path), split, ..View::new(name, format!("frames[{i}]"), camera) }
        });
        let capture =
            Capture::new(folder.path(), folder.path().join("transforms.json"), Format::Transforms, views.collect());
        Planted { folder, capture, scene_type: None }
    }

    fn camera(&mut self, view: usize) -> &mut Camera {
        &mut self.capture.views[view].camera
    }

    fn path(&self, view: usize) -> PathBuf {
        self.capture.views[view].image.clone().unwrap()
    }

    fn redraw(&self, view: usize, change: impl Fn(&Image) -> Image) {
        change(&PHOTOGRAPHS[view].2).save_png(self.path(view)).unwrap();
    }

    fn repose(&mut self, change: impl Fn(DAffine3) -> DAffine3) {
        self.capture.views.iter_mut().for_each(|view| view.camera.pose = change(view.camera.pose));
    }

    fn mask(&mut self, view: usize, value: f32) {
        let path = self.folder.path().join(format!("mask{view}.png"));
        Image { width: SIZE, height: SIZE, channels: 1, data: vec![value; SIZE * SIZE] }.save_png(&path).unwrap();
        self.capture.views[view].mask = Some(path);
    }

    fn analysis(&self) -> Result<SceneAnalysis> {
        self.capture.analyze_scene(self.scene_type)
    }

    fn cameras(&self) -> Report {
        examine_cameras(&self.capture, self.analysis().as_ref())
    }

    /// Compares a quarter of the images with their neighbours, which takes most of the time.
    fn report(&self) -> Report {
        self.report_of(12)
    }

    /// Compares `compared` images with their neighbours.
    fn report_of(&self, compared: usize) -> Report {
        examine(&self.capture, self.analysis().as_ref(), &DoctorOptions { compared, ..DoctorOptions::default() })
    }
}

/// Checks a finding's severity and views. No other kind except `beside` may be above a note.
#[track_caller]
fn found(report: &Report, kind: Kind, severity: Severity, views: &[usize], beside: &[Kind]) {
    let finding = report.finds(kind).unwrap_or_else(|| panic!("no {kind} among {:#?}", report.findings));
    assert_eq!(finding.severity, severity, "{finding:#?}");
    let named: Vec<usize> = finding.views.iter().map(|name| name.trim_end_matches(".png").parse().unwrap()).collect();
    assert_eq!(named, views, "{finding:#?}");
    let other = |finding: &&Finding| finding.severity > Note && finding.kind != kind && !beside.contains(&finding.kind);
    let others: Vec<_> = report.findings.iter().filter(other).collect();
    assert!(others.is_empty(), "beside {kind}: {others:#?}");
}

use Severity::{Error, Note, Warning};

#[test]
fn good_capture_has_no_findings() {
    let report = Planted::new().report_of(ALL);
    assert!(report.findings.is_empty(), "{:#?}", report.findings);
    assert!(report.facts.agreement.unwrap() > 0.4, "{:?}", report.facts.agreement);
    let parts: Vec<_> = report.facts.subsets.iter().map(|part| (part.split, part.present, part.absent)).collect();
    assert_eq!(parts, [(Split::Train, 40, 0), (Split::Test, 8, 0)]);
    assert_eq!(report.facts.resolutions, [Resolution { width: SIZE, height: SIZE, images: 48 }]);
    let again: Report = serde_json::from_str(&serde_json::to_string(&report).unwrap()).unwrap();
    assert_eq!(again, report);
}

/// A camera in a place of the landscape with a direction in degrees, around and up.
fn outdoors(place: [f64; 3], [yaw, pitch]: [f64; 2], field: f64) -> Camera {
    let ([yaw, pitch], place) = ([yaw, pitch].map(f64::to_radians), DVec3::from(place));
    let ahead = DVec3::new(yaw.cos() * pitch.cos(), yaw.sin() * pitch.cos(), pitch.sin());
    Camera::from_angle(160, 120, field.to_radians(), Camera::look_at(place, place + ahead, DVec3::Z))
}

/// Numbers between -1 and 1 without a pattern.
fn scattered(i: usize) -> f64 {
    2.0 * (i as f64 * 0.618_034).fract() - 1.0
}

/// Captures as people make them have nothing above a note.
#[test]
fn good_captures_of_other_kinds_have_no_findings() {
    let landscape = Landscape::new();
    let all = |of: fn(Split, usize) -> Vec<Camera>| evenly_spaced(of(Split::Train, 160), 24);
    let arm = (0..30).map(|i| {
        // Turning on the spot, the phone in the hand.
        let yaw = 12.0 * i as f64 + 5.0 * scattered(i);
        let [x, y] = [yaw.to_radians().cos(), yaw.to_radians().sin()].map(|x| 0.45 * x);
        outdoors([4.0 + x, -4.0 + y, 1.0 + 0.1 * scattered(7 * i)], [yaw, 10.0 * scattered(3 * i)], 65.0)
    });
    let panoramas = (0..8).map(|i| Camera {
        width: 256,
        height: 128,
        focal: [128.0 / PI; 2],
        centre: [128.0, 64.0],
        lens: Lens::Equirectangular,
        ..outdoors([2.5 + 0.3 * i as f64, -3.0 - 0.4 * scattered(i), 0.5 + 0.2 * scattered(3 * i)], [20.0, 0.0], 65.0)
    });
    for (name, cameras, compared) in [
        ("a walk", all(walk_cameras), 24),
        ("forward-facing", all(window_cameras), 24),
        ("turning on the spot", arm.collect::<Vec<_>>(), 30),
        ("panoramas", panoramas.collect(), 0),
    ] {
        let planted = Planted::of(cameras, |camera| landscape.render(camera, 2));
        let report = planted.report_of(ALL);
        let above: Vec<_> = report.findings.iter().filter(|finding| finding.severity > Note).collect();
        assert!(above.is_empty(), "{name}: {above:#?}");
        assert_eq!(report.facts.compared, compared, "{name}");
        assert!(
            report.facts.agreement.is_none_or(|agreement| agreement > 0.25),
            "{name}: {:?}",
            report.facts.agreement
        );
        assert_eq!(report.facts.agreement.is_none(), name == "panoramas", "{name}");
    }
    // An object through the wide lens of a phone, from above.
    let scene = Scene::bulldozer();
    let orbit = (0..24).map(|i| {
        let (turn, up) = (15.0 * i as f64, 35.0 + 10.0 * scattered(i));
        let [turn, up] = [turn, up].map(f64::to_radians);
        let eye = 2.4 * DVec3::new(turn.cos() * up.cos(), turn.sin() * up.cos(), up.sin());
        Camera::from_angle(SIZE, SIZE, 76_f64.to_radians(), Camera::look_at(eye, DVec3::ZERO, DVec3::Z))
    });
    let planted = Planted::of(orbit.collect(), |camera| scene.render(camera, 2).color);
    let report = planted.report_of(ALL);
    assert!(report.findings.is_empty(), "{:#?}", report.findings);
    let [low, high] = report.facts.layout.as_ref().unwrap().bounds;
    let [least, most] = scene.bounds();
    let scale = report.facts.layout.as_ref().unwrap().scale;
    let middle = report.facts.layout.unwrap().middle;
    let [least, most] = [least, most].map(|corner| scale * (corner - middle));
    assert!(low.cmple(least).all() && high.cmpge(most).all(), "the box holds the object: {low} {least} {most} {high}");
}

/// Without pixels too, a known convention and points count for more than the directions of the axes.
#[test]
fn cameras_that_look_outward_are_no_fault_where_the_convention_is_known() {
    let cameras = (0..48).map(|i| {
        let yaw = 7.5 * i as f64;
        let [x, y] = [yaw.to_radians().cos(), yaw.to_radians().sin()].map(|x| 0.45 * x);
        outdoors([x, y, 1.0], [yaw, 5.0 * scattered(i)], 65.0)
    });
    let mut planted = Planted::of(cameras.collect(), |camera| Image::new(camera.width, camera.height, 3));
    assert!(planted.cameras().finds(Kind::LooksAway).is_some());
    planted.capture.format = Format::Colmap;
    assert!(planted.cameras().finds(Kind::LooksAway).is_none());
    planted.capture.format = Format::Transforms;
    let point = |i: usize| {
        let turn = 0.1 * i as f64;
        let position = DVec3::new(3.0 * turn.cos(), 3.0 * turn.sin(), 1.0 + 0.3 * scattered(i));
        Point { position, color: [0; 3], error: 0.5, views: 4 }
    };
    planted.capture.points = (0..100).map(point).collect();
    assert!(planted.cameras().finds(Kind::LooksAway).is_none());
}

#[test]
fn one_far_camera_hides_nothing() {
    let mut planted = Planted::new();
    planted.camera(10).pose.translation *= 1000.0;
    found(&planted.cameras(), Kind::FarCamera, Warning, &[10], &[Kind::MissesBox]);
    // All others are on a line.
    let mut x = 0.0;
    planted.capture.views.iter_mut().enumerate().filter(|(i, _)| *i != 10).for_each(|(_, view)| {
        x += 0.1;
        view.camera.pose = Camera::look_at(DVec3::new(x - 2.5, -4.0, 1.0), DVec3::ZERO, DVec3::Z);
    });
    assert!(planted.cameras().finds(Kind::OnALine).is_some());
    assert!(planted.cameras().finds(Kind::Leak).is_none());
}

#[test]
fn images_in_no_split_are_neither_trained_on_nor_held_out() {
    let mut planted = Planted::new();
    let pose = planted.camera(8).pose;
    planted.camera(9).pose = pose;
    for (splits, expected) in [
        ([Some(Split::Train), None], None),
        ([None, Some(Split::Test)], None),
        ([Some(Split::Train), Some(Split::Train)], Some(Kind::DuplicatePoses)),
        ([Some(Split::Train), Some(Split::Test)], Some(Kind::Leak)),
    ] {
        for (view, split) in planted.capture.views[8..10].iter_mut().zip(splits) {
            view.split = split;
        }
        let report = planted.cameras();
        let kinds: Vec<Kind> = report.findings.iter().map(|finding| finding.kind).collect();
        assert_eq!(kinds, Vec::from_iter(expected), "{splits:?}");
    }
}

#[test]
fn doctor_finds_a_single_other_focal_length() {
    let mut planted = Planted::new();
    planted.camera(5).focal = planted.camera(5).focal.map(|focal| 2.0 * focal);
    found(&planted.cameras(), Kind::FocalLength, Note, &[5], &[]);
    // As many as another lens would have.
    (0..10).for_each(|i| planted.camera(i).focal = PHOTOGRAPHS[0].1.focal.map(|focal| 2.0 * focal));
    assert!(planted.cameras().finds(Kind::FocalLength).is_none());
}

#[test]
fn masked_pixels_do_not_count_as_light_or_blur() {
    let mut planted = Planted::new();
    // Someone in white, who moved, and a smooth wall.
    let painted = |image: &Image| {
        let mut image = image.over([0.4; 3]);
        (20..100).for_each(|y| (0..80).for_each(|x| image.pixel_mut(x, y).fill(1.0)));
        image
    };
    (0..ALL).for_each(|view| planted.redraw(view, |image| image.over([0.4; 3])));
    planted.redraw(6, painted);
    assert!(planted.report().finds(Kind::ExposureJump).is_some());
    let mut mask = Image { width: SIZE, height: SIZE, channels: 1, data: vec![1.0; SIZE * SIZE] };
    (20..100).for_each(|y| (0..80).for_each(|x| mask.pixel_mut(x, y)[0] = 0.0));
    let path = planted.folder.path().join("mask.png");
    mask.save_png(&path).unwrap();
    planted.capture.views[6].mask = Some(path);
    let above: Vec<_> = planted.report().findings.into_iter().filter(|finding| finding.severity > Note).collect();
    assert!(above.is_empty(), "{above:#?}");
    // Blur in what the mask leaves is found, its own edge notwithstanding.
    planted.redraw(6, |image| blurred(&painted(image), 3));
    found(&planted.report(), Kind::Blurred, Warning, &[6], &[]);
}

#[test]
fn doctor_finds_depth_files_that_training_refuses() {
    let mut planted = Planted::new();
    for (view, size) in [(2, SIZE), (3, SIZE / 2), (4, SIZE)] {
        let path = planted.folder.path().join(format!("depth{view}.png"));
        Image { width: size, height: size, channels: 1, data: vec![0.5; size * size] }.save_png(&path).unwrap();
        planted.capture.views[view].depth = Some((path, 1.0));
    }
    assert!(planted.report().findings.is_empty());
    std::fs::write(planted.folder.path().join("depth4.png"), b"no depths").unwrap();
    let path = planted.folder.path().join("depth2.png");
    Image { width: SIZE, height: 8, channels: 1, data: vec![0.5; 8 * SIZE] }.save_png(path).unwrap();
    let report = planted.report();
    found(&report, Kind::DepthsUndecodable, Warning, &[2, 4], &[]);
    let what = &report.finds(Kind::DepthsUndecodable).unwrap().what;
    assert!(
        what.contains("depths of 2 images; the first: ") && what.contains("depth2.png: has 160x8 depths"),
        "{what}"
    );
}

#[test]
fn doctor_finds_absent_broken_and_misshapen_images() {
    let mut planted = Planted::new();
    planted.capture.views[3].image = None;
    found(&planted.cameras(), Kind::ImagesAbsent, Warning, &[3], &[]);

    let planted = Planted::new();
    std::fs::write(planted.path(5), b"not an image").unwrap();
    let bytes = std::fs::read(planted.path(7)).unwrap();
    std::fs::write(planted.path(7), &bytes[..bytes.len() / 2]).unwrap();
    found(&planted.report(), Kind::ImagesUndecodable, Error, &[5, 7], &[]);

    let planted = Planted::new();
    let cropped =
        |image: &Image| Image { height: SIZE - 20, data: image.data[..4 * SIZE * (SIZE - 20)].to_vec(), ..*image };
    planted.redraw(4, cropped);
    found(&planted.cameras(), Kind::ShapeMismatch, Error, &[4], &[]);

    let planted = Planted::new();
    planted.redraw(4, |image| image.downscaled(2));
    let report = planted.report();
    found(&report, Kind::MixedResolutions, Note, &[], &[]);
    assert_eq!(report.facts.resolutions.len(), 2);
}

#[test]
fn doctor_finds_implausible_cameras() {
    let mut planted = Planted::new();
    planted.camera(2).focal = [10.0; 2];
    found(&planted.cameras(), Kind::FieldOfView, Warning, &[2], &[]);
    planted.camera(2).focal = [4000.0; 2];
    found(&planted.cameras(), Kind::FieldOfView, Warning, &[2], &[]);
    let mut planted = Planted::new();
    planted.camera(6).focal[1] *= 1.2;
    found(&planted.cameras(), Kind::PixelAspect, Warning, &[6], &[]);
    let mut planted = Planted::new();
    planted.camera(6).centre[0] = 30.0;
    found(&planted.cameras(), Kind::PrincipalPoint, Warning, &[6], &[]);
    let mut planted = Planted::new();
    planted.camera(9).lens = Lens::Brown { k: [-2.0, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
    found(&planted.cameras(), Kind::LensFolds, Warning, &[9], &[]);
    planted.camera(9).lens = Lens::Brown { k: [0.02, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
    assert!(planted.cameras().findings.is_empty());
    planted.camera(9).lens = Lens::Brown { k: [2.0, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
    found(&planted.cameras(), Kind::StrongDistortion, Note, &[9], &[]);
}

/// A pose in another program's convention.
type Convention = fn(DAffine3) -> DAffine3;

/// Flips axes of the camera.
fn turned(pose: DAffine3, signs: [f64; 3]) -> DAffine3 {
    DAffine3 { matrix3: pose.matrix3 * DMat3::from_diagonal(signs.into()), ..pose }
}

/// OpenCV's axes: y down, z ahead.
fn opencv(pose: DAffine3) -> DAffine3 {
    turned(pose, [1.0, -1.0, -1.0])
}

/// Mirrors x of the world and negates a column of the rotation, which stays a rotation.
fn mirrored(pose: DAffine3, signs: [f64; 3]) -> DAffine3 {
    turned(DAffine3::from_mat3(DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0))) * pose, signs)
}

#[test]
fn doctor_identifies_pose_conventions() {
    let conventions: [(&str, Convention, Kind); 8] = [
        ("OpenCV", opencv, Kind::OpenCvAxes),
        ("upside-down images", |pose| turned(pose, [-1.0, -1.0, 1.0]), Kind::TurnedCameras),
        ("Mitsuba", |pose| turned(pose, [-1.0, 1.0, -1.0]), Kind::TurnedCameras),
        ("world to camera", |pose| pose.inverse(), Kind::WorldToCamera),
        ("world to OpenCV camera", |pose| opencv(pose).inverse(), Kind::WorldToCamera),
        ("mirrored", |pose| mirrored(pose, [-1.0, 1.0, 1.0]), Kind::Mirrored),
        ("upside down", |pose| mirrored(pose, [1.0, -1.0, 1.0]), Kind::Mirrored),
        ("backwards", |pose| mirrored(pose, [1.0, 1.0, -1.0]), Kind::Mirrored),
    ];
    for (name, convention, kind) in conventions {
        let mut planted = Planted::new();
        // Not around the origin, like most captures.
        let offset = DVec3::new(1.0, -2.0, 0.5);
        planted.repose(|pose| convention(DAffine3 { translation: pose.translation + offset, ..pose }));
        let surveyed = planted.report();
        let settled = surveyed.finds(kind).unwrap_or_else(|| panic!("{name}: {:#?}", surveyed.findings));
        assert_eq!(settled.severity, Error);
        let advice = match name {
            "upside-down images" => "first and the second one",
            "Mitsuba" => "first and the third one",
            "world to OpenCV camera" => "Then negate the second and third",
            _ => "",
        };
        assert!(settled.advice.contains(advice), "{name}: {}", settled.advice);
        let beside = [Kind::CameraInBox, Kind::MissesBox, Kind::FarCamera, Kind::Leak];
        found(&surveyed, kind, Error, &[], &beside);
    }
}

#[test]
fn doctor_identifies_conventions_by_poses_alone() {
    let mut planted = Planted::new();
    planted.repose(opencv);
    found(&planted.cameras(), Kind::LooksAway, Warning, &[], &[Kind::CameraInBox, Kind::MissesBox]);
    let mut planted = Planted::new();
    planted.repose(|pose| pose.inverse());
    found(&planted.cameras(), Kind::WorldToCamera, Warning, &[], &[Kind::Refused]);
    // Points confirm it.
    let points =
        (0..100).map(|i| DVec3::new((f64::from(i) * 0.7).sin(), (f64::from(i) * 1.3).cos(), 0.01 * f64::from(i)));
    let points: Vec<Point> = points.map(|p| Point { position: 0.5 * p, color: [0; 3], error: 0.5, views: 4 }).collect();
    let mut planted = Planted::new();
    planted.capture.points = points;
    assert!(planted.cameras().findings.is_empty());
    planted.repose(opencv);
    found(&planted.cameras(), Kind::OpenCvAxes, Error, &[], &[Kind::CameraInBox, Kind::MissesBox]);
}

#[test]
fn doctor_finds_wrong_scales_and_lost_digits() {
    let mut planted = Planted::new();
    planted.capture.points = vec![Point { position: DVec3::splat(5000.0), color: [0; 3], error: 0.1, views: 5 }; 20];
    found(&planted.cameras(), Kind::Scale, Warning, &[], &[]);
    let mut planted = Planted::new();
    planted.capture.format = Format::Blender;
    assert!(planted.cameras().findings.is_empty());
    planted.repose(|pose| DAffine3 { translation: 1000.0 * pose.translation, ..pose });
    found(&planted.cameras(), Kind::Scale, Note, &[], &[]);
    let mut planted = Planted::new();
    planted.repose(|pose| DAffine3 { translation: pose.translation + DVec3::new(5e6, 0.0, 0.0), ..pose });
    found(&planted.cameras(), Kind::FarFromOrigin, Note, &[], &[]);
}

#[test]
fn doctor_finds_single_wrong_poses() {
    let mut planted = Planted::new();
    // The pose looks at the same place from another side than the image.
    let other = planted.camera(20).pose;
    let turn = DMat3::from_quat(DQuat::from_rotation_z(0.6));
    planted.camera(11).pose = DAffine3 { matrix3: turn * other.matrix3, translation: turn * other.translation };
    // The camera is turned by 6 degrees.
    let pose = planted.camera(30).pose;
    planted.camera(30).pose.matrix3 = DMat3::from_quat(DQuat::from_rotation_x(0.1)) * pose.matrix3;
    found(&planted.report_of(ALL), Kind::WrongPose, Warning, &[11, 30], &[]);

    let mut planted = Planted::new();
    planted.camera(10).pose = planted.capture.views[12].camera.pose;
    found(
        &planted.report(),
        Kind::DuplicatePoses,
        Warning,
        &[12],
        &[Kind::WrongPose, Kind::ExposureJump, Kind::WhiteBalanceJump],
    );

    let mut planted = Planted::new();
    planted.camera(10).pose.translation *= 12.0;
    found(&planted.cameras(), Kind::FarCamera, Warning, &[10], &[]);
    // In any unit.
    planted.repose(|pose| DAffine3 { translation: 0.01 * pose.translation, ..pose });
    assert_eq!(planted.cameras().finds(Kind::FarCamera).unwrap().views, ["10.png"]);
    let mut planted = Planted::new();
    planted.camera(10).pose.translation *= 2.0;
    planted.repose(|pose| DAffine3 { translation: 1000.0 * pose.translation, ..pose });
    assert!(planted.cameras().finds(Kind::FarCamera).is_none(), "twice the usual distance is not far");

    let mut planted = Planted::new();
    planted.camera(10).pose.matrix3 *= DMat3::from_rotation_z(1.6);
    found(&planted.cameras(), Kind::Roll, Note, &[10], &[]);

    // Images and poses in different orders.
    let mut planted = Planted::new();
    let poses: Vec<DAffine3> = planted.capture.views.iter().map(|view| view.camera.pose).collect();
    (0..48).for_each(|i| planted.camera(i).pose = poses[(i * 17 + 5) % 48]);
    found(&planted.report(), Kind::NoAgreement, Warning, &[], &[]);
}

#[test]
fn doctor_identifies_orders_of_poses() {
    let mut as_text: Vec<usize> = (0..ALL).collect();
    as_text.sort_by_key(|i| i.to_string());
    // For each image, the index of the one whose pose it has. The order's own tests have the others.
    let late: Vec<usize> = (0..ALL).map(|i| (i + ALL - 1) % ALL).collect();
    for (order, text) in
        [(late, "the poses are one image late"), (as_text, "the poses are in the order of the text of the names")]
    {
        let mut planted = Planted::new();
        for (i, &from) in order.iter().enumerate() {
            planted.camera(i).pose = PHOTOGRAPHS[from].1.pose;
            planted.capture.views[i].name = format!("{i}.png");
        }
        let report = planted.report();
        found(&report, Kind::PoseOrder, Error, &[], &[Kind::Leak, Kind::ExposureJump, Kind::WhiteBalanceJump]);
        let finding = report.finds(Kind::PoseOrder).unwrap();
        assert!(finding.what.starts_with(text), "{}", finding.what);
    }
}

#[test]
fn doctor_finds_one_image_under_two_names() {
    let planted = Planted::new();
    std::fs::copy(planted.path(8), planted.path(9)).unwrap();
    found(
        &planted.report(),
        Kind::DuplicateImages,
        Warning,
        &[9],
        &[Kind::WrongPose, Kind::ExposureJump, Kind::WhiteBalanceJump],
    );
    let mut planted = Planted::new();
    std::fs::copy(planted.path(8), planted.path(41)).unwrap();
    planted.camera(41).pose = planted.capture.views[8].camera.pose;
    // Another copy with a pose of its own; the held-out image may come first.
    std::fs::copy(planted.path(20), planted.path(44)).unwrap();
    planted.capture.views.swap(3, 44);
    let report = planted.report();
    let leaks = report.findings.iter().filter(|finding| finding.kind == Kind::Leak);
    let named: Vec<&[String]> = leaks.map(|finding| &finding.views[..]).collect();
    assert_eq!(named, [["41.png".to_owned()], ["44.png".to_owned()]]);
}

#[test]
fn doctor_finds_blur_exposure_and_colour_jumps() {
    let planted = Planted::new();
    planted.redraw(6, |image| blurred(image, 3));
    found(&planted.report(), Kind::Blurred, Warning, &[6], &[]);
    let planted = Planted::new();
    planted.redraw(6, |image| tinted(image, [0.6; 3]));
    found(&planted.report(), Kind::ExposureJump, Warning, &[6], &[]);
    let planted = Planted::new();
    planted.redraw(6, |image| tinted(image, [1.0, 0.95, 0.45]));
    found(&planted.report(), Kind::WhiteBalanceJump, Warning, &[6], &[]);
}

#[test]
fn doctor_finds_useless_masks_and_alpha() {
    let mut planted = Planted::new();
    planted.mask(3, 0.0);
    planted.mask(4, 1.0);
    let report = planted.report();
    found(&report, Kind::MaskHidesAll, Warning, &[3], &[]);
    found(&report, Kind::MaskHidesNothing, Note, &[4], &[Kind::MaskHidesAll]);
    (0..ALL).for_each(|view| planted.mask(view, 0.0));
    found(&planted.report(), Kind::MaskHidesAll, Error, &(0..ALL).collect::<Vec<_>>(), &[]);

    let planted = Planted::new();
    planted.redraw(3, |image| image.over([1.0; 3]));
    found(&planted.cameras(), Kind::NoAlpha, Warning, &[3], &[]);
    let opaque_over = |image: &Image, behind: f32| {
        let over = image.over([behind; 3]);
        let data = over.data.chunks_exact(3).flat_map(|p| [p[0], p[1], p[2], 1.0]).collect();
        Image { channels: 4, data, ..over }
    };
    (0..48).filter(|view| *view != 3).for_each(|view| planted.redraw(view, |image| opaque_over(image, 1.0)));
    assert!(planted.cameras().finds(Kind::NoAlpha).is_none(), "a white background");
    let mut blender = planted;
    blender.capture.format = Format::Blender;
    assert!(blender.cameras().finds(Kind::NoAlpha).is_none(), "before white at the distance of Blender's cameras");

    let planted = Planted::new();
    let opaque = |image: &Image| opaque_over(image, 0.0);
    planted.redraw(3, opaque);
    found(
        &planted.report_of(ALL),
        Kind::OpaqueAlpha,
        Warning,
        &[3],
        &[Kind::ExposureJump, Kind::WhiteBalanceJump, Kind::Blurred],
    );
    // Of a scene with a background, undistortion has cleared a corner.
    (0..48).for_each(|view| planted.redraw(view, opaque));
    planted.redraw(5, |image| {
        let mut image = opaque(image);
        image.pixel_mut(0, 0)[3] = 0.0;
        image
    });
    assert_eq!(planted.report().finds(Kind::OpaqueAlpha).unwrap().severity, Note);
    planted.redraw(5, opaque);
    found(&planted.report_of(ALL), Kind::OpaqueAlpha, Note, &(0..48).collect::<Vec<_>>(), &[]);
}

#[test]
fn doctor_finds_hollow_alpha_and_identical_images() {
    let planted = Planted::new();
    let inverted = |image: &Image| {
        let data = image.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2], 1.0 - p[3]]).collect();
        Image { data, ..image.clone() }
    };
    planted.redraw(3, inverted);
    assert!(planted.report().finds(Kind::HollowAlpha).is_none(), "a single image");
    assert!(planted.cameras().finds(Kind::HollowAlpha).is_none());
    (0..ALL).for_each(|view| planted.redraw(view, inverted));
    let cameras = planted.cameras();
    let finding = cameras.finds(Kind::HollowAlpha).unwrap();
    assert_eq!(finding.what, "the alpha channel of most images is transparent inside an opaque border");
    let report = planted.report();
    assert_eq!(report.findings.iter().filter(|finding| finding.kind == Kind::HollowAlpha).count(), 1);
    let hollow = report.finds(Kind::HollowAlpha).unwrap();
    assert!(hollow.severity == Warning && hollow.views.len() > ALL / 2, "{hollow:#?}");
    let grey = Image { width: SIZE, height: SIZE, channels: 3, data: vec![0.5; 3 * SIZE * SIZE] };
    for image in [&grey, &PHOTOGRAPHS[0].2] {
        (0..ALL).for_each(|view| planted.redraw(view, |_| image.clone()));
        let report = planted.report();
        let finding = report.finds(Kind::IdenticalImages).unwrap();
        assert_eq!(
            (finding.severity, finding.views.len(), &finding.what[..]),
            (Error, ALL, "all 48 images have the same pixels")
        );
        assert!(report.finds(Kind::DuplicateImages).is_none() && report.finds(Kind::Leak).is_none());
    }
}

#[test]
fn doctor_finds_images_that_training_refuses() {
    let mut planted = Planted::new();
    (0..ALL).for_each(|view| {
        planted.redraw(view, |image| {
            let data = image.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2], 0.5]).collect();
            Image { data, ..image.clone() }
        });
    });
    *planted.camera(2) = Camera { centre: [20.0, 80.0], ..planted.camera(2).clone() };
    // Another error does not hide it.
    planted.camera(3).width /= 2;
    let report = planted.cameras();
    found(&report, Kind::Refused, Error, &[], &[Kind::PrincipalPoint, Kind::ShapeMismatch]);
    assert!(report.finds(Kind::ShapeMismatch).is_some());
    assert!(report.finds(Kind::Refused).unwrap().what.contains("has alpha 128 of 255 in every pixel of `00.png`"));
    assert!(report.finds(Kind::PrincipalPoint).is_some() && report.facts.layout.is_none());
}

#[test]
fn doctor_finds_missing_parallax_and_gaps() {
    let mut planted = Planted::new();
    planted.repose(|pose| DAffine3 { translation: DVec3::ZERO, ..pose });
    found(&planted.cameras(), Kind::OnePlace, Error, &[], &[]);

    let mut planted = Planted::new();
    let mut x = 0.0;
    planted.capture.views.iter_mut().for_each(|view| {
        x += 0.1;
        let eye = DVec3::new(x - 2.5, -4.0, 1.0);
        view.camera.pose = Camera::look_at(eye, DVec3::ZERO, DVec3::Z);
    });
    found(&planted.cameras(), Kind::OnALine, Warning, &[], &[]);

    let mut planted = Planted::new();
    planted.capture.views.retain(|view| view.camera.pose.translation.y > 0.5);
    found(&planted.cameras(), Kind::CoverageGap, Note, &[], &[Kind::FewImages]);

    let mut planted = Planted::new();
    planted.scene_type = Some(SceneType::Bounded);
    planted.camera(7).pose.translation *= 0.2;
    planted.camera(8).pose.matrix3 *= DMat3::from_rotation_y(3.0);
    let report = planted.cameras();
    found(&report, Kind::CameraInBox, Warning, &[7], &[Kind::MissesBox]);
    found(&report, Kind::MissesBox, Warning, &[8], &[Kind::CameraInBox]);
}

#[test]
fn doctor_finds_few_or_no_held_out_images() {
    let mut planted = Planted::new();
    planted.capture.views.retain(|view| view.split == Some(Split::Train));
    found(&planted.cameras(), Kind::NothingHeldOut, Note, &[], &[]);
    planted.capture.views.truncate(12);
    found(&planted.cameras(), Kind::FewImages, Warning, &[], &[]);
    planted.capture.views.truncate(4);
    found(&planted.cameras(), Kind::FewImages, Error, &[], &[]);
    // Nor does that hide why training refuses them.
    (0..4).for_each(|view| {
        planted.redraw(view, |image| {
            let data = image.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2], 0.5]).collect();
            Image { data, ..image.clone() }
        });
    });
    found(&planted.cameras(), Kind::Refused, Error, &[], &[Kind::FewImages]);
    planted.capture.views.clear();
    let report = planted.report();
    assert!(report.facts.layout.is_none());
    found(&report, Kind::FewImages, Error, &[], &[]);
}

#[test]
fn finding_kinds_have_distinct_names() {
    let names: std::collections::BTreeSet<_> = Kind::ALL.iter().map(|kind| kind.name()).collect();
    assert_eq!(names.len(), Kind::ALL.len());
    for kind in Kind::ALL {
        assert_eq!(serde_json::to_string(kind).unwrap(), format!("\"{kind}\""));
        assert!(kind.name().chars().all(|c| c.is_ascii_lowercase() || c == '-'));
    }
}

/// A box blur.
fn blurred(image: &Image, half: usize) -> Image {
    let mut out = image.clone();
    for y in 0..image.height {
        for x in 0..image.width {
            let columns = x.saturating_sub(half)..(x + half + 1).min(image.width);
            let rows = y.saturating_sub(half)..(y + half + 1).min(image.height);
            let count = (columns.len() * rows.len()) as f32;
            for channel in 0..image.channels {
                let values = rows.clone().flat_map(|v| columns.clone().map(move |u| (u, v)));
                out.pixel_mut(x, y)[channel] = values.map(|(u, v)| image.pixel(u, v)[channel]).sum::<f32>() / count;
            }
        }
    }
    out
}

/// Multiplies the colours.
fn tinted(image: &Image, factors: [f32; 3]) -> Image {
    let mut out = image.clone();
    for pixel in out.data.chunks_exact_mut(image.channels) {
        (0..3).for_each(|i| pixel[i] *= factors[i]);
    }
    out
}

#[test]
fn doctor_compares_the_unit_of_depths_with_points() {
    let (mut planted, scene) = (Planted::new(), Scene::bulldozer());
    planted.capture.views.truncate(40);
    // Points on the surfaces that every fourth camera sees; others do not see all of them.
    for view in planted.capture.views.iter().step_by(4) {
        let pixels = (0..SIZE * SIZE).step_by(97).map(|i| view.camera.pixel_ray(i % SIZE, i / SIZE));
        let places = pixels.filter_map(|ray| Some(ray.at(scene.trace(&ray)?.distance)));
        planted.capture.points.extend(places.map(|position| Point { position, color: [0; 3], error: 0.5, views: 4 }));
    }
    for view in 0..40 {
        let camera = planted.camera(view).clone();
        let rays = (0..SIZE * SIZE).map(|i| camera.pixel_ray(i % SIZE, i / SIZE));
        let data = rays.map(|ray| scene.trace(&ray).map_or(0.0, |hit| hit.distance as f32)).collect();
        let distances = Image { width: SIZE, height: SIZE, channels: 1, data };
        let path = planted.folder.path().join(format!("{view}.npy"));
        std::fs::write(&path, Depths::new(&distances, &camera, 1.0).to_npy()).unwrap();
        planted.capture.views[view].depth = Some((path, 1.0));
    }
    assert!(planted.report().finds(Kind::DepthUnit).is_none());
    for unit in [1e-3, 1e3, 2.0] {
        planted.capture.views.iter_mut().for_each(|view| view.depth.as_mut().unwrap().1 = unit);
        let report = planted.report();
        let finding = report.finds(Kind::DepthUnit).unwrap();
        let factor: f64 = finding.what.split(' ').nth(3).unwrap().parse().unwrap();
        assert!(finding.severity == Warning && (factor / unit - 1.0).abs() < 0.02, "{}", finding.what);
    }
}

#[test]
fn good_capture_with_lens_and_masks_has_no_findings() {
    let mut planted = Planted::new();
    let size = [200, 130];
    let scene = Scene::bulldozer();
    let mut mask = Image { width: size[0], height: size[1], channels: 1, data: vec![1.0; size[0] * size[1]] };
    // The right quarter, behind the bulldozer, is masked.
    (0..size[1]).for_each(|y| (150..size[0]).for_each(|x| mask.pixel_mut(x, y)[0] = 0.0));
    let hidden = planted.folder.path().join("mask.png");
    mask.save_png(&hidden).unwrap();
    let mut number = 0;
    planted.capture.views.retain(|_| {
        number += 1;
        number % 2 == 0
    });
    let lens = Lens::Brown { k: [-0.12, 0.02, 0.0, 0.0, 0.0, 0.0], p: [0.003, -0.002] };
    for view in &mut planted.capture.views {
        let focal = view.camera.focal[0];
        let (focal, centre) = ([focal, 1.04 * focal], [94.0, 70.0]);
        view.camera = Camera { width: size[0], height: size[1], focal, centre, lens, pose: view.camera.pose };
        view.mask = Some(hidden.clone());
        scene.render(&view.camera, 2).color.save_png(view.image.as_ref().unwrap()).unwrap();
    }
    let turn = DAffine3::from_rotation_x(1.2) * DAffine3::from_rotation_z(0.5);
    planted.repose(|pose| turn * pose);
    let report = planted.report_of(ALL);
    let above: Vec<_> = report.findings.iter().filter(|finding| finding.severity > Note).collect();
    assert!(above.is_empty(), "{above:#?}");
    let facts = report.facts;
    assert!(facts.agreement.unwrap() > 0.4, "{:?}", facts.agreement);
    assert_eq!(facts.resolutions.iter().map(|r| [r.width, r.height]).collect::<Vec<_>>(), [size]);
    let lie = facts.layout.unwrap();
    assert!(lie.up.dot(turn.transform_vector3(DVec3::Z)) > 0.98, "{lie:?}");
    assert!(lie.middle.length() < 0.5 && lie.near < lie.far, "{lie:?}");
    assert_eq!((facts.lenses.len(), facts.points), (1, 0));
}

#[test]
fn doctor_names_each_of_many_equal_poses_once() {
    let mut planted = Planted::new();
    let (first, other) = (planted.capture.views[0].clone(), planted.capture.views[45].clone());
    let count = 1200;
    // Every eighth, the last or the first images are held out, as files have them.
    let splits: [fn(usize) -> bool; 3] = [|i| i % 8 == 0, |i| i >= 600, |i| i < 600];
    for is_held_out in splits {
        let held_out = (0..count).filter(|i| is_held_out(*i)).count();
        planted.capture.views = (0..count)
            .map(|i| View {
                name: format!("{i}.png"),
                split: Some(if is_held_out(i) { Split::Test } else { Split::Train }),
                ..if i == 5 { other.clone() } else { first.clone() }
            })
            .collect();
        let report = planted.cameras();
        let views = |kind: Kind| &report.finds(kind).unwrap().views;
        // All held-out images except an outlier share a pose with a training image. All but the first of each set share
        // one with another.
        assert_eq!(views(Kind::Leak).len(), held_out - usize::from(is_held_out(5)));
        assert_eq!(views(Kind::DuplicatePoses).len(), count - 3);
        assert!(report.finds(Kind::DuplicatePoses).unwrap().what.starts_with("the pose of 1197 images is exactly"));
        assert_eq!(*views(Kind::FarCamera), ["5.png"]);
    }
}

#[test]
fn doctor_names_each_of_few_equal_poses_once() {
    let mut planted = Planted::new();
    let pose = planted.capture.views[10].camera.pose;
    for i in [11, 12, 13] {
        planted.camera(i).pose = pose;
    }
    let report = planted.cameras();
    let finding = report.finds(Kind::DuplicatePoses).unwrap();
    assert_eq!(finding.views, ["11.png", "12.png", "13.png"]);
    let expected = "the pose of 3 images is exactly that of another image: `11.png` and `10.png`, and others";
    assert_eq!(finding.what, expected);
}

#[test]
fn images_from_one_place_are_not_duplicates() {
    let finds = |to: usize, angle: f64, kind: Kind| {
        let mut planted = Planted::new();
        let pose = planted.camera(8).pose;
        planted.camera(to).pose = DAffine3 { matrix3: DMat3::from_rotation_x(angle) * pose.matrix3, ..pose };
        planted.cameras().finds(kind).is_some()
    };
    for (angle, duplicate, leak) in [(0.0, true, true), (1e-4, false, true), (0.02, false, false)] {
        assert_eq!(finds(9, angle, Kind::DuplicatePoses), duplicate, "turned by {angle}");
        assert_eq!(finds(41, angle, Kind::Leak), leak, "turned by {angle}");
    }
}
