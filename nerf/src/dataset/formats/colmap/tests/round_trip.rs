//! Round trips of written models, and the choice of the camera model.

use super::*;
use proptest::prelude::*;

fn view(name: &str, lens: Lens, pose: DAffine3) -> View {
    let camera = Camera { width: 64, height: 48, focal: [50.1, 49.9], centre: [31.7, 24.3], lens, pose };
    View::new(name, format!("frames[{name}]"), camera)
}

fn capture(views: Vec<View>, points: Vec<Point>) -> Capture {
    Capture { points, ..Capture::new(Path::new("scene"), "transforms.json".into(), Format::Transforms, views) }
}

/// Lenses, and the name and number of parameters of the model for each.
const LENSES: [(Lens, &str, usize); 9] = [
    (Lens::Pinhole, "PINHOLE", 4),
    (Lens::Brown { k: [0.1, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] }, "OPENCV", 8),
    (Lens::Brown { k: [0.1, -0.2, 0.0, 0.0, 0.0, 0.0], p: [1e-3, -2e-7] }, "OPENCV", 8),
    (Lens::Brown { k: [0.1, -0.2, 0.03, 0.04, -0.05, 1.0 / 3.0], p: [0.0, 5e-300] }, "FULL_OPENCV", 12),
    (Lens::Brown { k: [0.0, 0.0, 0.0, 0.0, 0.0, 0.1], p: [0.0; 2] }, "FULL_OPENCV", 12),
    (Lens::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] }, "OPENCV_FISHEYE", 8),
    (Lens::Fisheye { k: [0.1, 0.2, 0.3, 0.4], p: [0.0; 2], s: [0.0; 2] }, "OPENCV_FISHEYE", 8),
    (Lens::Fisheye { k: [0.1, 0.2, 0.3, 0.4], p: [0.5, 0.6], s: [0.7, 0.8] }, "THIN_PRISM_FISHEYE", 12),
    (Lens::Fov { omega: 0.9 }, "FOV", 5),
];

/// A rotation by thirds and quarters of a turn: products of its entries are exact.
fn exact_pose(i: usize) -> DAffine3 {
    let quaternions = [
        DQuat::IDENTITY,
        DQuat::from_xyzw(0.5, 0.5, 0.5, 0.5),
        DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0),
        DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5),
    ];
    let translation = DVec3::new(i as f64, 0.1, -1.0 / 3.0);
    DAffine3 { matrix3: DMat3::from_quat(quaternions[i % 4]), translation }
}

/// Writes and reads a capture.
fn again(capture: &Capture, encoding: Encoding) -> (Capture, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    write(capture, folder.path(), encoding).unwrap();
    (read(folder.path()).unwrap(), folder)
}

/// Writes and reads a capture in memory.
fn parsed(capture: &Capture, encoding: Encoding) -> Capture {
    let (folder, table) = (Path::new("scene"), Table::new(capture, encoding).unwrap());
    let [cameras, images, points] = match encoding {
        Encoding::Binary => binary::encode(&table),
        Encoding::Text => text::encode(&table),
    };
    parse(folder, encoding, &encoding.files(folder), [&cameras, &images], Some(Ok(points))).unwrap()
}

#[test]
fn colmap_round_trip_is_exact() {
    let views =
        LENSES.iter().enumerate().map(|(i, (lens, _, _))| view(&format!("{i}.png"), *lens, exact_pose(i))).collect();
    let point = |i: u8| Point {
        position: DVec3::new(0.1, 1e-300, -1e17) * f64::from(i),
        color: [i, 255, 0],
        error: 1.0 / 3.0,
        views: 0,
    };
    let before = capture(views, (0..5).map(point).collect());
    for encoding in Encoding::ALL {
        let (after, folder) = again(&before, encoding);
        for (a, b) in before.views.iter().zip(&after.views) {
            assert_eq!((&a.name, &a.camera), (&b.name, &b.camera), "{encoding:?}");
        }
        assert_eq!((after.views.len(), &after.points), (before.views.len(), &before.points));
        // The result round-trips through both encodings again.
        for other in Encoding::ALL {
            let (last, _folder) = again(&after, other);
            let cameras = |capture: &Capture| capture.views.iter().map(|view| view.camera.clone()).collect::<Vec<_>>();
            assert_eq!((cameras(&last), &last.points), (cameras(&after), &after.points));
        }
        // Overwrites the files of the same model.
        write(&before, folder.path(), encoding).unwrap();
        assert_eq!(fs::read_dir(folder.path().join("sparse/0")).unwrap().count(), 3, "nothing else is left");
    }
}

#[test]
fn writing_uses_the_smallest_exact_model() {
    let views = LENSES.iter().enumerate().map(|(i, (lens, _, _))| view(&format!("{i}.png"), *lens, exact_pose(0)));
    let (_, folder) = again(&capture(views.collect(), vec![]), Encoding::Text);
    let text = fs::read_to_string(folder.path().join("sparse/0/cameras.txt")).unwrap();
    let lines: Vec<Vec<&str>> = text.lines().skip(1).map(|line| line.split(' ').collect()).collect();
    assert_eq!(lines.len(), LENSES.len());
    for (i, (line, (_, name, params))) in lines.iter().zip(LENSES).enumerate() {
        assert_eq!((line[0].parse(), line[1], line.len()), (Ok(i + 1), name, 4 + params));
    }
    assert_eq!(lines[7].join(" "), "8 THIN_PRISM_FISHEYE 64 48 50.1 49.9 31.7 24.3 0.1 0.2 0.5 0.6 0.3 0.4 0.7 0.8");
    assert_eq!(lines[3][8..].join(" "), "0.1 -0.2 0.0 5e-300 0.03 0.04 -0.05 0.3333333333333333");
}

#[test]
fn equal_colmap_cameras_share_one_entry() {
    let none = Lens::Brown { k: [0.0; 6], p: [0.0; 2] };
    let lenses = [Lens::Pinhole, none, Lens::Fov { omega: 0.0 }, Lens::Fov { omega: 0.5 }, Lens::Fov { omega: 0.5 }];
    let views: Vec<View> =
        lenses.iter().enumerate().map(|(i, lens)| view(&i.to_string(), *lens, exact_pose(i))).collect();
    let (after, folder) = again(&capture(views, vec![]), Encoding::Binary);
    let bytes = fs::read(folder.path().join("sparse/0/cameras.bin")).unwrap();
    assert_eq!((bytes[0], bytes.len()), (2, 8 + 2 * 24 + 32 + 40));
    let lenses = after.views.iter().map(|view| view.camera.lens).collect::<Vec<_>>();
    assert_eq!(lenses[..3], [Lens::Pinhole; 3]);
    assert_eq!(lenses[3..], [Lens::Fov { omega: 0.5 }; 2]);
}

#[test]
fn unwritable_colmap_captures_are_named() {
    let fails = |change: &dyn Fn(&mut Capture), encoding, expected: &str| {
        let mut capture = capture(
            vec![view("a.png", Lens::Pinhole, exact_pose(1)), view("b.png", Lens::Pinhole, exact_pose(2))],
            vec![],
        );
        change(&mut capture);
        let folder = tempfile::tempdir().unwrap();
        let message = write(&capture, folder.path(), encoding).unwrap_err().to_string();
        assert!(message.starts_with("transforms.json: ") && message.contains(expected), "{message}");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0, "nothing is written");
    };
    let camera = |change: &dyn Fn(&mut Camera), expected: &str| {
        fails(&|capture| change(&mut capture.views[1].camera), Encoding::Binary, &format!("`frames[b.png].{expected}"));
    };
    camera(&|c| c.lens = Lens::Fov { omega: 4.0 }, "camera`: omega: must be below pi (radians)");
    camera(&|c| c.lens = Lens::Brown { k: [f64::NAN; 6], p: [0.0; 2] }, "camera`: k1: must be a finite number");
    camera(&|c| c.focal[1] = 0.0, "camera`: focal length: must be 1e-3 to 1e9 pixels");
    camera(&|c| c.centre[0] = f64::INFINITY, "camera`: cx: must be a finite number");
    camera(&|c| c.width = 0, "camera`: width: must be 1 to");
    camera(&|c| c.pose.matrix3 *= 1.01, "pose`: must be a rotation");
    camera(&|c| c.pose.translation.x = f64::NAN, "pose`: must have a finite position");
    let name = |name: &str, encoding, expected: &str| {
        fails(
            &|capture| name.clone_into(&mut capture.views[1].name),
            encoding,
            &format!("`frames[b.png].name`: {expected}"),
        );
    };
    for encoding in Encoding::ALL {
        for bad in ["", "x\ny", " x", "x ", "./x", "x\0"] {
            name(bad, encoding, &format!("{bad:?} is not a valid image name: rename the file"));
        }
        name("a.png", encoding, "`a.png` is there twice");
        fails(&|capture| capture.views.clear(), encoding, "has no images to write: add at least one");
    }
    name("x y", Encoding::Text, "`x y` has a space");
    let point = Point { position: DVec3::splat(f64::NAN), color: [0; 3], error: 0.0, views: 0 };
    fails(
        &|capture| capture.points = vec![point],
        Encoding::Text,
        "`points[0]`: has a non-finite number: remove the point",
    );
}

#[test]
fn writing_beside_another_model_is_an_error() {
    let capture = capture(vec![view("a.png", Lens::Pinhole, exact_pose(1))], vec![]);
    let folder = tempfile::tempdir().unwrap();
    write(&capture, folder.path(), Encoding::Binary).unwrap();
    let message = write(&capture, folder.path(), Encoding::Text).unwrap_err().to_string();
    assert!(message.contains("cameras.bin") && message.contains("belongs to another model"), "{message}");
    fs::write(folder.path().join("sparse/0/rigs.bin"), "").unwrap();
    let message = write(&capture, folder.path(), Encoding::Binary).unwrap_err().to_string();
    assert!(message.contains("rigs.bin"), "{message}");
}

proptest! {
    #[test]
    fn both_encodings_hold_the_same_numbers(
        numbers in prop::array::uniform32(prop::num::f64::NORMAL | prop::num::f64::SUBNORMAL | prop::num::f64::ZERO),
        q in prop::array::uniform4(-1.0..1.0_f64),
        eye in prop::array::uniform3(-1e3..1e3_f64),
        focal in prop::array::uniform2(1e-3..1e9_f64),
        centre in prop::array::uniform2(-48.0..96.0_f64),
        color in any::<[u8; 3]>(),
    ) {
        prop_assume!(q.iter().map(|x| x * x).sum::<f64>() > 0.01);
        let pose = DAffine3 {
            matrix3: DMat3::from_quat(DQuat::from_array(q).normalize()),
            translation: DVec3::from_array(eye),
        };
        let lens = Lens::Fisheye {
            k: std::array::from_fn(|i| numbers[i]),
            p: [numbers[4], numbers[5]],
            s: [numbers[6], numbers[7]],
        };
        let mut one = view("one", lens, pose);
        (one.camera.focal, one.camera.centre) = (focal, centre);
        let position = DVec3::new(numbers[12], numbers[13], numbers[14]);
        let before = capture(vec![one], vec![Point { position, color, error: numbers[15], views: 0 }]);
        let [a, b] = Encoding::ALL.map(|encoding| parsed(&before, encoding));
        // The debug format tells 0 from -0.
        let said = |capture: &Capture| format!("{:?} {:?}", capture.views[0].camera, capture.points);
        prop_assert_eq!(said(&a), said(&b));
        let camera = &a.views[0].camera;
        let unmoved = Camera { pose, ..camera.clone() };
        let intrinsics = |camera: &Camera| format!("{camera:?}");
        prop_assert_eq!(intrinsics(&unmoved), intrinsics(&before.views[0].camera));
        prop_assert_eq!(format!("{:?}", a.points), format!("{:?}", before.points));
        prop_assert!(camera.pose.matrix3.abs_diff_eq(pose.matrix3, 4e-15));
        prop_assert!(camera.pose.translation.abs_diff_eq(pose.translation, 1e-11));
    }
}
