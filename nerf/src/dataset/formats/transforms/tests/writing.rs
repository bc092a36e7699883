//! Round trips of written files, and the fields that other programs need.

use super::*;
use crate::dataset::capture::Point;
use crate::dataset::formats::kit::{is_whole, picture, says};
use glam::{DMat3, DVec3};
use std::f64::consts::PI;

/// A camera with many digits in all numbers.
fn camera(i: usize) -> Camera {
    let turn = DMat3::from_rotation_y(0.1 + i as f64) * DMat3::from_rotation_x(0.3);
    let pose = DAffine3 { matrix3: turn, translation: DVec3::new(0.1, -1.0 / 3.0, 1e-17 + i as f64) };
    let lens = Lens::Brown { k: [0.1 / 3.0, -0.2, 1e-9, 0.0, 0.0, 0.0], p: [-1e-4 / 3.0, 0.7e-5] };
    Camera { width: 64, height: 48, focal: [100.1, 99.9 / 3.0], centre: [31.1, 24.7], lens, pose }
}

/// Three views with everything that the format can hold.
fn capture(folder: &Path) -> Capture {
    let view = |i: usize| {
        let (image, mask) = (folder.join(format!("images/{i}.png")), folder.join(format!("masks/{i}.png")));
        let depth = folder.join(format!("depths/{i}.npy"));
        picture(&image, 64, 48);
        picture(&mask, 64, 48);
        std::fs::create_dir_all(depth.parent().unwrap()).unwrap();
        std::fs::write(&depth, b"").unwrap();
        View {
            name: format!("images/{i}.png"),
            field: format!("frames[{i}]"),
            image: Some(image),
            camera: camera(i),
            split: Some(Split::ALL[i]),
            mask: Some(mask),
            mask_is_dynamic: false,
            depth: Some((depth, 0.1 / 3.0)),
            sharpness: Some(10.0 / 3.0),
            bounds: None,
        }
    };
    let point = |i: u8| Point { position: DVec3::splat(0.1 * f64::from(i)), color: [i, 2, 3], error: 0.3, views: 4 };
    Capture {
        folder: folder.to_owned(),
        file: folder.join(FILE),
        format: Format::Transforms,
        views: (0..3).map(view).collect(),
        points: (0..5).map(point).collect(),
        points_file: Some(folder.join(POINTS)),
        aabb_scale: Some(16.0),
        applied: DAffine3 {
            matrix3: DMat3::from_rotation_z(0.4) * (1.0 / 3.0),
            translation: DVec3::new(0.1, 0.2, 0.7),
        },
        assumptions: vec![],
    }
}

/// Writes a capture over itself; returns it read again, and the document.
#[track_caller]
fn written(capture: &Capture) -> (Capture, Value) {
    write(capture, &capture.folder).unwrap();
    let again = read(&capture.folder).unwrap();
    is_whole(&again);
    (again, json::read(&capture.file).unwrap())
}

#[test]
fn transforms_round_trip_is_exact() {
    let folder = tempfile::tempdir().unwrap();
    let capture = capture(folder.path());
    let (again, document) = written(&capture);
    assert_eq!(again, capture);
    // The fields that nerfstudio reads.
    assert_eq!(document["camera_model"], "OPENCV");
    assert_eq!(document["ply_file_path"], "sparse_pc.ply");
    assert_eq!((&document["w"], &document["fl_x"]), (&64.into(), &100.1.into()));
    assert_eq!(document["applied_transform"].as_array().map(Vec::len), Some(3));
    for name in ["train_filenames", "val_filenames", "test_filenames"] {
        assert_eq!(document[name].as_array().map(Vec::len), Some(1), "{name}");
    }
    let frame = &document["frames"][1];
    assert_eq!((&frame["file_path"], &frame["mask_path"]), (&"images/1.png".into(), &"masks/1.png".into()));
    assert_eq!(frame["depth_file_path"], "depths/1.npy");
    assert_eq!(frame["transform_matrix"].as_array().map(Vec::len), Some(4));
    assert_eq!(frame.get("fl_x"), None, "all cameras are equal");
    let names = std::fs::read_dir(folder.path()).unwrap().count();
    assert_eq!(names, 5, "no temporary file stays behind");
}

#[test]
fn written_captures_can_move_to_another_folder() {
    let (from, to) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let capture = capture(from.path());
    write(&capture, to.path()).unwrap();
    let others = ["images", "masks", "depths"];
    for folder in others {
        std::fs::rename(from.path().join(folder), to.path().join(folder)).unwrap();
    }
    let again = read(to.path()).unwrap();
    for (view, before) in again.views.iter().zip(&capture.views) {
        assert_eq!((&view.name, &view.camera, view.split), (&before.name, &before.camera, before.split));
        assert!([&view.image, &view.mask].into_iter().flatten().all(|path| path.starts_with(to.path())));
    }
    assert_eq!(again.points, capture.points);
}

#[test]
fn different_cameras_are_written_per_frame() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path());
    capture.views[1].camera.focal = [1.0 / 3.0, 2.0 / 3.0];
    capture.views[2].camera.lens = Lens::Pinhole;
    capture.views[2].depth.as_mut().unwrap().1 = 0.5;
    let (again, document) = written(&capture);
    assert_eq!(again, capture);
    // nerfstudio reads a single model: that of the lens, which a pinhole is without coefficients.
    assert_eq!((document.get("fl_x"), document.get("camera_model")), (None, Some(&"OPENCV".into())));
    assert_eq!((&document["frames"][2]["camera_model"], &document["frames"][2]["k1"]), (&"OPENCV".into(), &0.0.into()));
}

#[test]
fn all_lenses_round_trip() {
    let fisheye = |p, s| Lens::Fisheye { k: [0.1, -0.2 / 3.0, 0.3, -0.4], p, s };
    let full = Lens::Brown { k: [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], p: [0.7, 0.8] };
    for (lens, model) in [
        (Lens::Pinhole, "PINHOLE"),
        (full, "FULL_OPENCV"),
        (fisheye([0.0; 2], [0.0; 2]), "OPENCV_FISHEYE"),
        (fisheye([0.1, 0.2], [0.3, 0.4]), "THIN_PRISM_FISHEYE"),
        (fisheye([0.0; 2], [0.0, 0.4]), "THIN_PRISM_FISHEYE"),
        (Lens::Fov { omega: 0.9 }, "FOV"),
        (Lens::Equirectangular, "EQUIRECTANGULAR"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let mut capture = capture(folder.path());
        for camera in capture.views.iter_mut().map(|view| &mut view.camera) {
            camera.lens = lens;
            if lens == Lens::Equirectangular {
                (camera.focal, camera.centre) = ([64.0 / (2.0 * PI), 48.0 / PI], [32.0, 24.0]);
            }
        }
        let (again, document) = written(&capture);
        assert_eq!(again, capture, "{lens:?}");
        assert_eq!(document["camera_model"], model);
        assert_eq!(document.get("is_fisheye").is_some(), model == "OPENCV_FISHEYE", "instant-ngp has no other");
    }
}

#[test]
fn absent_fields_are_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path());
    (capture.points, capture.points_file) = (vec![], None);
    (capture.aabb_scale, capture.applied) = (None, DAffine3::IDENTITY);
    for view in &mut capture.views {
        (view.split, view.mask, view.depth, view.sharpness) = (None, None, None, None);
    }
    // Without listed masks, those of this folder would be used.
    std::fs::remove_dir_all(folder.path().join("masks")).unwrap();
    let (again, document) = written(&capture);
    assert_eq!(again, capture);
    let absent = ["applied_transform", "aabb_scale", "ply_file_path", "train_filenames", "depth_unit_scale_factor"];
    assert!(absent.iter().all(|name| document.get(name).is_none()), "{document}");
    assert!(!folder.path().join(POINTS).exists());
}

#[test]
fn validation_list_defaults_to_the_test_list() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path());
    capture.views[1].split = Some(Split::Test);
    let (again, document) = written(&capture);
    assert_eq!(again, capture);
    assert_eq!(document["val_filenames"], document["test_filenames"]);
}

#[test]
fn names_without_extension_get_the_image_extension() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path());
    capture.views[0].name = "images/0".into();
    let (again, document) = written(&capture);
    assert_eq!(again.views[0].name, "images/0.png");
    assert_eq!(document["train_filenames"][0], "images/0.png");
}

#[test]
fn unwritable_transforms_captures_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let fails = |change: fn(&mut Capture), part: &str| {
        let mut capture = capture(folder.path());
        change(&mut capture);
        let message = write(&capture, folder.path()).unwrap_err().to_string();
        says(&message, &["transforms.json: cannot be written: ", part]);
        assert!(!capture.file.exists());
    };
    fails(|c| c.views.clear(), "there are no images");
    fails(|c| c.views[1].camera.width = 0, "camera of images/1.png");
    fails(|c| c.views[1].camera.focal[1] = f64::NAN, "camera of images/1.png");
    fails(|c| c.views[1].camera.centre[0] = f64::INFINITY, "camera of images/1.png");
    fails(|c| c.views[1].camera.pose.translation.x = f64::NAN, "camera of images/1.png");
    fails(|c| c.views[1].camera.lens = Lens::Fov { omega: f64::NAN }, "camera of images/1.png");
    fails(|c| c.views[1].camera.lens = Lens::Equirectangular, "images/1.png does not cover all directions");
    fails(|c| c.views[1].depth.as_mut().unwrap().1 = f64::NAN, "camera of images/1.png");
    fails(|c| c.applied.translation.x = f64::NAN, "`applied`, `aabb_scale` or a point has a non-finite number");
    fails(|c| c.aabb_scale = Some(f64::INFINITY), "`applied`, `aabb_scale` or a point has a non-finite number");
    fails(|c| c.points[2].position.y = f64::NAN, "a point");
    let absent = folder.path().join("absent");
    says(
        &write(&capture(folder.path()), &absent).unwrap_err().to_string(),
        &["absent/sparse_pc.ply: cannot be written"],
    );
}

#[test]
fn any_camera_numbers_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path());
    capture.views.truncate(1);
    let numbers = (
        prop::array::uniform2(1e-3..1e9_f64),
        prop::array::uniform2(-2.0..4.0_f64),
        prop::array::uniform6(-1.0..1.0_f64),
        prop::array::uniform2(-1.0..1.0_f64),
        -4.0..4.0_f64,
        prop::array::uniform3(prop::num::f64::NORMAL | prop::num::f64::SUBNORMAL | prop::num::f64::ZERO),
    );
    let config = ProptestConfig { cases: 100, ..ProptestConfig::default() };
    proptest!(config, |((focal, centre, k, p, angle, place) in numbers)| {
        let pose = DAffine3 { matrix3: DMat3::from_rotation_z(angle), translation: DVec3::from_array(place) };
        let camera = Camera { width: 3, height: 2, focal, centre, lens: Lens::Brown { k, p }, pose };
        let mut capture = capture.clone();
        capture.views[0].camera = camera.clone();
        write(&capture, folder.path()).unwrap();
        let again = read(folder.path()).unwrap().views[0].camera.clone();
        prop_assert_eq!(format!("{again:?}"), format!("{camera:?}"), "signs of zeros too");
    });
}
