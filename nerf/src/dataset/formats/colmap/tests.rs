use super::*;
use crate::camera::lens::Lens;
use crate::dataset::Split;
use crate::dataset::capture::Point;
use glam::{DAffine3, DMat3, DQuat, DVec3};
use std::fs;

mod damaged;
mod reference;
mod round_trip;

/// Bytes in the layout of COLMAP's documentation.
#[derive(Default)]
pub(super) struct Bytes(pub Vec<u8>);

impl Bytes {
    fn u8s(mut self, values: &[u8]) -> Self {
        self.0.extend(values);
        self
    }

    fn u32(self, value: u32) -> Self {
        self.u8s(&value.to_le_bytes())
    }

    fn u64(self, value: u64) -> Self {
        self.u8s(&value.to_le_bytes())
    }

    fn f64s(self, values: &[f64]) -> Self {
        values.iter().fold(self, |bytes, value| bytes.u8s(&value.to_le_bytes()))
    }
}

/// Cameras, images and points: two of each, with numbers that are exact in binary.
pub(super) fn binary() -> [Vec<u8>; 3] {
    let cameras = Bytes::default().u64(2);
    let cameras = cameras.u32(7).u32(1).u64(640).u64(480).f64s(&[500.5, 501.5, 320.25, 240.75]);
    let cameras = cameras.u32(9).u32(2).u64(100).u64(80).f64s(&[90.0, 50.0, 40.0, -0.125]);
    let images = Bytes::default().u64(2);
    let images = images.u32(3).f64s(&[0.5, 0.5, 0.5, 0.5]).f64s(&[1.0, 2.0, 3.0]).u32(9).u8s(b"b/second.png\0");
    let images = images.u64(2).f64s(&[10.5, 11.5]).u64(1).f64s(&[12.5, 13.5]).u64(u64::MAX);
    let images = images.u32(1).f64s(&[1.0, 0.0, 0.0, 0.0]).f64s(&[0.0, 0.0, 4.0]).u32(7).u8s(b"a.png\0").u64(0);
    let points = Bytes::default().u64(2);
    let points = points.u64(11).f64s(&[0.5, -1.5, 2.0]).u8s(&[1, 2, 255]).f64s(&[0.25]);
    let points = points.u64(2).u32(3).u32(0).u32(1).u32(5);
    let points = points.u64(12).f64s(&[3.0, 4.0, 5.0]).u8s(&[9, 8, 7]).f64s(&[-1.0]).u64(0);
    [cameras.0, images.0, points.0]
}

/// The same as text.
pub(super) const TEXT: [&str; 3] = [
    "# Camera list\n7 PINHOLE 640 480 500.5 501.5 320.25 240.75\n\n9 SIMPLE_RADIAL 100 80 90 50 40 -0.125\n",
    "# Image list\n# with two lines each\n3 0.5 0.5 0.5 0.5 1 2 3 9 b/second.png\n10.5 11.5 1 12.5 13.5 -1 \n\
     1 1 0 0 0 0 0 4.0e0 7 a.png\n\n",
    "# Points\n11 0.5 -1.5 2 1 2 255 0.25 3 0 1 5\n12 3 4 5 9 8 7 -1\n",
];

pub(super) fn text() -> [Vec<u8>; 3] {
    TEXT.map(|text| text.as_bytes().to_vec())
}

/// A capture's folder with these files in the folder `place`.
pub(super) fn folder(encoding: Encoding, place: &str, files: &[Vec<u8>; 3]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir_all(folder.path().join(place)).unwrap();
    for (path, bytes) in encoding.files(&folder.path().join(place)).iter().zip(files) {
        fs::write(path, bytes).unwrap();
    }
    folder
}

/// Compares with the content of the fixture, worked out by hand.
#[track_caller]
fn is_the_fixture(capture: &Capture) {
    let [a, b] = &capture.views[..] else { panic!("{} views", capture.views.len()) };
    assert_eq!((a.name.as_str(), b.name.as_str()), ("a.png", "b/second.png"));
    // Four units behind the origin, looking at it; up in the image is -y of the world.
    let pose =
        DAffine3 { matrix3: DMat3::from_cols(DVec3::X, -DVec3::Y, -DVec3::Z), translation: DVec3::new(0.0, 0.0, -4.0) };
    let pinhole =
        Camera { width: 640, height: 480, focal: [500.5, 501.5], centre: [320.25, 240.75], lens: Lens::Pinhole, pose };
    assert_eq!(a.camera, pinhole);
    // The origin is on the optical axis; the other point is up and to the left of it.
    assert_eq!(a.camera.pixel_of(DVec3::ZERO), Some([320.25, 240.75]));
    assert_eq!(a.camera.pixel_of(DVec3::new(-4.0, -2.0, 0.0)), Some([320.25 - 500.5, 240.75 - 0.5 * 501.5]));
    // The quaternion maps x to y, y to z and z to x, so the camera's axes are the world's y, z, x.
    let pose = DAffine3 {
        matrix3: DMat3::from_cols(DVec3::Z, -DVec3::X, -DVec3::Y),
        translation: DVec3::new(-2.0, -3.0, -1.0),
    };
    let lens = Lens::Brown { k: [-0.125, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
    let radial = Camera { width: 100, height: 80, focal: [90.0; 2], centre: [50.0, 40.0], lens, pose };
    assert_eq!(b.camera, radial);
    let points = [
        Point { position: DVec3::new(0.5, -1.5, 2.0), color: [1, 2, 255], error: 0.25, views: 2 },
        Point { position: DVec3::new(3.0, 4.0, 5.0), color: [9, 8, 7], error: -1.0, views: 0 },
    ];
    assert_eq!(capture.points, points);
    assert_eq!((capture.format, capture.applied, capture.aabb_scale), (Format::Colmap, DAffine3::IDENTITY, None));
    assert!(capture.views.iter().all(|v| v.split.is_none() && v.depth.is_none() && v.bounds.is_none()));
}

#[test]
fn both_encodings_are_read_from_all_folders() {
    for (encoding, files) in [(Encoding::Binary, binary()), (Encoding::Text, text())] {
        for place in ["sparse/0", "sparse/12", "sparse", "", "colmap/sparse/0", "distorted/sparse/0"] {
            let folder = folder(encoding, place, &files);
            let capture = read(folder.path()).unwrap();
            is_the_fixture(&capture);
            let expected = encoding.files(&folder.path().join(place))[1].clone();
            assert_eq!((&capture.file, capture.folder.as_path()), (&expected, folder.path()), "{place}");
        }
    }
    let empty = tempfile::tempdir().unwrap();
    assert!(models(empty.path()).is_empty());
    assert!(read(empty.path()).unwrap_err().to_string().contains("has no COLMAP model"));
}

#[test]
fn fields_are_list_indices_or_lines() {
    let fields = |encoding, files| {
        let capture = read(folder(encoding, "sparse/0", &files).path()).unwrap();
        capture.views.into_iter().map(|view| view.field).collect::<Vec<_>>()
    };
    assert_eq!(fields(Encoding::Binary, binary()), ["images[1]", "images[0]"]);
    assert_eq!(fields(Encoding::Text, text()), ["line 5", "line 3"]);
}

#[test]
fn integers_may_be_written_as_floats() {
    let [cameras, images, points] = TEXT;
    for (sizes, id) in [("100.0 80.000000", "9.0 b"), ("1e2 8.0e+01", "9.000000000000000000e+00 b")] {
        assert!(cameras.contains("100 80") && images.contains(" 9 b") && images.contains(" -1 \n"));
        let images = images.replace(" 9 b", &format!(" {id}")).replace(" -1 \n", " -1.0\n");
        let files = [cameras.replace("100 80", sizes), images, points.to_owned()];
        is_the_fixture(&read(folder(Encoding::Text, "sparse/0", &files.map(String::into_bytes)).path()).unwrap());
    }
}

#[test]
fn colmap_binary_comes_first_rigs_are_skipped() {
    let folder = folder(Encoding::Binary, "sparse/0", &binary());
    let model = folder.path().join("sparse/0");
    for file in ["cameras.txt", "images.txt", "rigs.bin", "frames.bin"] {
        fs::write(model.join(file), "?").unwrap();
    }
    is_the_fixture(&read(folder.path()).unwrap());
    // The points file is optional.
    fs::remove_file(model.join("points3D.bin")).unwrap();
    assert_eq!(read(folder.path()).unwrap().points, []);
}

#[test]
fn images_and_masks_are_found() {
    let folder = folder(Encoding::Binary, "sparse/0", &binary());
    let root = folder.path();
    let touch = |path: &str| {
        let path = root.join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, "").unwrap();
        path
    };
    let found = |folder: &Path| {
        let views = read(folder).unwrap().views;
        views.into_iter().map(|view| [view.image, view.mask]).collect::<Vec<_>>()
    };
    assert_eq!(found(root), [[None, None], [None, None]]);
    let a = touch("a.png");
    assert_eq!(found(root)[0], [Some(a), None], "names may begin at the folder");
    let b = touch("input/b/second.png");
    assert_eq!(found(root), [[None, None], [Some(b), None]], "images come from one folder");
    let (a, b) = (touch("images/a.png"), touch("images/b/second.png"));
    let (mask_a, mask_b) = (touch("mask/a.png"), touch("masks/b/second.png.png"));
    assert_eq!(found(root), [[Some(a), Some(mask_a)], [Some(b), Some(mask_b)]]);
    let mask_a = touch("masks/a.png.png");
    assert_eq!(found(root)[0][1], Some(mask_a), "COLMAP's own name comes first");
    assert_eq!(read(root).unwrap().assumptions, [""; 0]);
    // Reading the folder of the model finds the same files.
    let from_model = found(&root.join("sparse/0"));
    assert!(from_model.iter().flatten().all(Option::is_some), "{from_model:?}");
}

#[test]
fn masks_are_found_in_any_case() {
    for (mask, is_found) in [
        ("a.png.png", true),
        ("A.PNG.png", true),
        ("a.PNG", true),
        ("A.png", true),
        ("a.jpg", true),
        ("A.JPEG", true),
        ("a.webp", true),
        ("a.npy", false),
        ("a.mask.png", false),
        ("b.png", false),
        ("a.png/x", false),
    ] {
        let folder = folder(Encoding::Binary, "sparse/0", &binary());
        for path in ["images/a.png", "images/b/second.png", &format!("masks/{mask}")] {
            let path = folder.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        }
        let capture = read(folder.path()).unwrap();
        let expected = is_found.then(|| folder.path().join("masks").join(mask));
        assert_eq!((&capture.views[0].mask, &capture.views[1].mask), (&expected, &None), "{mask}");
        let count = usize::from(is_found);
        let without = 2 - count;
        let said = format!("{count} of 2 images have a mask in `masks`; {without} have no mask, and use all pixels");
        assert_eq!(capture.assumptions, [said]);
    }
}

/// Reads the fixture with one file replaced and expects an error about that file.
#[track_caller]
pub(super) fn fails(encoding: Encoding, which: usize, bytes: &[u8], field: &str, expected: &str) {
    let mut files = match encoding {
        Encoding::Binary => binary(),
        Encoding::Text => text(),
    };
    files[which] = bytes.to_vec();
    let folder = folder(encoding, "sparse/0", &files);
    let message = read(folder.path()).unwrap_err().to_string();
    let file = encoding.files(Path::new(""))[which].display().to_string();
    assert!(message.contains(&file) && message.contains(field) && message.contains(expected), "{message}");
    assert!(message.lines().count() == 1, "{message}");
}

#[test]
fn text_errors_name_the_line() {
    let cases = [
        (0, "-0.125", "NaN", "`line 4`", "k1: must be a finite number, is NaN"),
        (0, "-0.125", "1e400", "`line 4`", "k1: must be a finite number"),
        (0, " -0.125", "", "`line 4`", "k1: is missing"),
        (0, "-0.125", "0 0", "`line 4`", "PARAMS: SIMPLE_RADIAL takes 4: remove the others"),
        (0, "SIMPLE_RADIAL", "EUCM", "`line 4`", "EUCM is not supported"),
        (0, "SIMPLE_RADIAL", "radial_4", "`line 4`", "MODEL: `RADIAL_4` is no known camera model"),
        (0, "9 SIMPLE", "7 SIMPLE", "`line 4`", "camera_id: is `7`, as that of line 2 is"),
        (0, "100 80", "0 80", "`line 4`", "width: must be 1 to"),
        (0, "100 80", "100 99999999999", "`line 4`", "height: must be 1 to"),
        (0, "100 80", "100.5 80", "`line 4`", "WIDTH: must be an integer of 64 bits, is `100.5`"),
        (0, " 90 ", " -90 ", "`line 4`", "focal length: must be 1e-3 to 1e9 pixels, is -90"),
        (0, "9 SIMPLE", "-9 SIMPLE", "`line 4`", "CAMERA_ID: must be an integer of 32 bits"),
        (1, "0.5 0.5 0.5 0.5", "0 0 0 0", "`line 3`", "qvec: is a quaternion of length 0"),
        (1, "0.5 0.5 0.5 0.5", "inf 0 0 0", "`line 3`", "qvec: must be a finite number, is inf"),
        (1, " 9 b", " 8 b", "`line 3`", "camera_id: is 8, but"),
        (1, "1 1 0", "3 1 0", "`line 5`", "image_id: is `3`, as that of line 3 is"),
        (1, "a.png", "b/second.png", "`line 5`", "name: is `b/second.png`, as that of line 3 is"),
        (1, " a.png", "", "`line 5`", "name: is empty"),
        (1, "13.5 -1 \n", "13.5\n", "`line 4`", "POINTS2D: must be triples"),
    ];
    for (which, from, to, field, expected) in cases {
        assert_eq!(TEXT[which].matches(from).count(), 1, "{from}");
        fails(Encoding::Text, which, TEXT[which].replacen(from, to, 1).as_bytes(), field, expected);
    }
    fails(Encoding::Text, 1, b"# nothing\n", "`images`", "is empty");
    fails(Encoding::Text, 0, b"\xff", "cameras.txt", "CAMERA_ID: must be an integer");
}

/// The bytes with other ones at a place.
fn with(bytes: &[u8], at: usize, new: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    bytes[at..at + new.len()].copy_from_slice(new);
    bytes
}

#[test]
fn damaged_points_are_left_out() {
    let read = |encoding, bytes: &[u8]| {
        let mut files = if encoding == Encoding::Text { text() } else { binary() };
        files[2] = bytes.to_vec();
        let capture = read(folder(encoding, "sparse/0", &files).path()).unwrap();
        assert!(capture.views.len() == 2 && capture.points_file.is_some() != capture.points.is_empty());
        let heights: Vec<f64> = capture.points.iter().map(|point| point.position.z).collect();
        (heights, capture.assumptions)
    };
    let text = |from: &str, to: &str, heights: &[f64], expected: &str| {
        let (found, said) = read(Encoding::Text, TEXT[2].replacen(from, to, 1).as_bytes());
        assert_eq!((&found[..], &said[..]), (heights, &[format!("left out 1 of 2 points of {expected}")][..]));
    };
    let file = "`sparse/0/points3D.txt`";
    text("2 1 2 255", "2 1 2 256", &[5.0], &format!("{file}: `line 2`: B: must be an integer of 8 bits, is `256`"));
    text("5 9 8", "nan 9 8", &[2.0], &format!("{file}: `line 3`: Z: must be a finite number, is NaN"));
    text("7 -1", "7 -1 5", &[2.0], &format!("{file}: `line 3`: TRACK: must be pairs IMAGE_ID POINT2D_IDX"));
    text(" -1\n", "", &[2.0], &format!("{file}: `line 3`: ERROR: is missing"));
    let (found, said) = read(Encoding::Text, b"\xff");
    let expected = format!("left out the points of {file}: `line 1`: POINT3D_ID: must be an integer");
    assert!(found.is_empty() && said[0].starts_with(&expected), "{said:?}");
    let [_, _, points] = binary();
    let binary = |bytes: &[u8], heights: &[f64], expected: &str| {
        let (found, said) = read(Encoding::Binary, bytes);
        assert_eq!((&found[..], said.len()), (heights, 1), "{said:?}");
        let expected = expected.replacen("points of:", "points of `sparse/0/points3D.bin`:", 1);
        assert_eq!(said[0], format!("left out {expected}"));
    };
    let nan = f64::NAN.to_le_bytes();
    binary(&with(&points, 16, &nan), &[5.0], "1 of 2 points of: points3D[0] has no finite position");
    let ends = "the file ends here: copy it again";
    binary(&points[..points.len() - 1], &[2.0], &format!("1 of 2 points of: `points3D[1].track`: {ends}"));
    binary(&points[..4], &[], "the points of: ends before the number of points: copy it again");
    for count in [u64::MAX, 1 << 60, 3] {
        let what = format!("{} of {count} points of: `points3D[2].point3D_id`: {ends}", count - 2);
        binary(&with(&points, 0, &count.to_le_bytes()), &[2.0, 5.0], &what);
    }
    let (found, said) = read(Encoding::Binary, &with(&points, 51, &[200]));
    assert!(found.is_empty() && said[0].contains("`points3D[0].track`: announces 200 entries"), "{said:?}");
    // The second point has 51 bytes.
    let [one, none] = [1_u64, 0].map(|count| with(&points, 0, &count.to_le_bytes()));
    let said = |bytes: &[u8]| read(Encoding::Binary, bytes).1;
    let file = "`sparse/0/points3D.bin`";
    let more = "`points3D`: 51 bytes follow the last of 1 entries: copy the file again, or convert it with COLMAP's \
                `model_converter`";
    assert_eq!(read(Encoding::Binary, &one), (vec![2.0], vec![format!("left out the rest of {file}: {more}")]));
    let both = format!("left out the points of {file}: points3D[0] has no finite position; {more}");
    assert_eq!(said(&with(&one, 16, &nan)), [both]);
    let all = format!("left out the points of {file}: `points3D`: 118 bytes follow the last of 0 entries");
    assert!(said(&none)[0].starts_with(&all), "{:?}", said(&none));
    assert_eq!(said(&points), [""; 0]);
    // The error of a point is not known.
    assert_eq!(read(Encoding::Binary, &with(&points, 43, &nan)), (vec![2.0, 5.0], vec![]));
}

#[test]
fn binary_errors_name_the_entry() {
    use Encoding::Binary;
    let [cameras, images, _] = binary();
    // The second camera begins after 8 + 24 + 32 bytes: the count, and the number, model, width, height and parameters
    // of the first.
    let second = 64;
    fails(Binary, 0, &with(&cameras, second, &[7]), "`cameras[1].camera_id`", "is `7`, as that of cameras[0] is");
    let model = |id: u32, expected| {
        let bytes = with(&cameras, second + 4, &id.to_le_bytes());
        fails(Binary, 0, &bytes, "`cameras[1].model`", expected);
    };
    for (id, name, parameters) in [(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16), (13, "DIVISION", 5)] {
        let cameras = with(&cameras, second + 4, &u32::to_le_bytes(id));
        let parameters = vec![0.5; parameters];
        let bytes = Bytes(cameras[..second + 24].to_vec()).f64s(&parameters).0;
        fails(Binary, 0, &bytes, "`cameras[1].model`", &format!("{name} ({id}) is not supported"));
    }
    model(18, "18 is not supported");
    model(u32::MAX, "-1 is not supported");
    fails(Binary, 0, &with(&cameras, second + 8, &[0]), "`cameras[1].width`", "must be 1 to");
    fails(Binary, 0, &with(&cameras, second + 16, &[255; 8]), "`cameras[1].height`", "must be 1 to");
    fails(Binary, 0, &with(&cameras, second + 48, &f64::NAN.to_le_bytes()), "`cameras[1].k1`", "finite number, is NaN");
    fails(Binary, 0, &with(&cameras, second + 24, &[0; 8]), "`cameras[1].focal length`", "1e-3 to 1e9 pixels, is 0");
    fails(Binary, 0, &cameras[..cameras.len() - 1], "`cameras[1].k1`", "the file ends here");
    fails(Binary, 0, &cameras[..5], "`cameras`", "the file ends before their number");
    // Counts that no memory could hold, and one that is just beyond the end.
    for count in [u64::MAX, 1 << 60, 1 << 33, 3] {
        for (which, bytes, list) in [(0, &cameras, "`cameras`"), (1, &images, "`images`")] {
            fails(Binary, which, &with(bytes, 0, &count.to_le_bytes()), list, &format!("announces {count} entries"));
        }
    }
    // The first image begins at 8, its name at 8 + 4 + 56 + 4 = 72, its observations at 72 + 13.
    fails(Binary, 1, &with(&images, 12, &[0; 32]), "`images[0].qvec`", "length 0");
    fails(Binary, 1, &with(&images, 44, &f64::INFINITY.to_le_bytes()), "`images[0].tvec`", "finite number, is inf");
    fails(Binary, 1, &with(&images, 68, &[8]), "`images[0].camera_id`", "is 8, but");
    fails(Binary, 1, &with(&images, 72, &[0]), "`images[0]", "");
    fails(Binary, 1, &with(&images, 73, b"\n"), "`images[0].name`", "`b\\nsecond.png` has a control character");
    for count in [u64::MAX, 1 << 61, 100] {
        let what = format!("announces {count} entries");
        fails(Binary, 1, &with(&images, 85, &count.to_le_bytes()), "`images[0].points2D`", &what);
    }
    let third = 85 + 8 + 48;
    fails(Binary, 1, &with(&images, third, &[3]), "`images[1].image_id`", "is `3`, as that of images[0] is");
    fails(Binary, 1, &0_u64.to_le_bytes(), "`images`", "is empty");
    // A count that is too small, or a model with fewer parameters. Bytes after the points are ignored.
    let mut longer = binary();
    longer.iter_mut().for_each(|bytes| bytes.extend([1, 2, 3]));
    for (which, list) in [(0, "cameras"), (1, "images")] {
        let what =
            "3 bytes follow the last of 2 entries: copy the file again, or convert it with COLMAP's `model_converter`";
        fails(Binary, which, &longer[which], &format!("`{list}`"), what);
    }
    let [cameras, images, _] = binary();
    let [.., points] = longer;
    is_the_fixture(&read(folder(Binary, "sparse", &[cameras, images, points]).path()).unwrap());
}

#[test]
fn hand_written_text_files_are_read() {
    let mut files = text();
    // Windows line ends, names with spaces and dots, a byte-order mark, and no empty last line.
    files[1] = "\u{feff}# images\r\n5 -1 0 0 0 0 0 4 7 ./dir/my image (1).png\r\n\r\n6\t1 0 0 0 0 0 4 7 b.png".into();
    let views = read(folder(Encoding::Text, "sparse", &files).path()).unwrap().views;
    assert_eq!(views.iter().map(|view| view.name.as_str()).collect::<Vec<_>>(), ["b.png", "dir/my image (1).png"]);
    assert_eq!(views[0].camera, views[1].camera, "a quaternion and its negative are one rotation");
    let turned = DQuat::from_xyzw(0.0, 0.0, 0.0, 1.0);
    assert_eq!(
        DMat3::from_quat(turned),
        views[0].camera.pose.matrix3 * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0))
    );
}

#[test]
fn text_images_without_empty_lines_are_read() {
    let [cameras, _, points] = text();
    let images = |text: &str| {
        let files = [cameras.clone(), text.as_bytes().to_vec(), points.clone()];
        let capture = read(folder(Encoding::Text, "sparse/0", &files).path())?;
        Ok::<_, Error>(capture.views.into_iter().map(|view| view.name).collect::<Vec<_>>())
    };
    let observed = "1 1 0 0 0 0 0 4 7 a.png\n10.5 11.5 1 12.5 13.5 -1\n";
    let names = images(&format!("{observed}2 1 0 0 0 0 0 4 7 b c.JPG\n3 1 0 0 0 0 0 4 7 d.png\n\n")).unwrap();
    assert_eq!(names, ["a.png", "b c.JPG", "d.png"]);
    // Comments between, and images that raygrad does not decode, whose lines are no observations.
    let other = "1 1 0 0 0 0 0 4 7 a.tif\n# none\n2 1 0 0 0 0 0 4 7 b.HEIC\n#\n\n3 1 0 0 0 0 0 4 7 c.bmp\n";
    assert_eq!(images(other).unwrap(), ["a.tif", "b.HEIC", "c.bmp"]);
    // Neither observations nor an image.
    for line in ["2 1 0 0 0 0 0 4 7 b", "2 1 0 0 0 x 0 4 7 b.png", "1 0 0 0 0 0 4 7 b.png x"] {
        let message = images(&format!("1 1 0 0 0 0 0 4 7 a.png\n{line}\n")).unwrap_err().to_string();
        assert!(message.contains("`line 2`: POINTS2D: must be triples"), "{message}");
    }
}

/// The cameras and images of eight views, each with its camera; the lines of one can be replaced.
fn eight(change: impl Fn(usize) -> Option<[String; 2]>) -> [Vec<u8>; 3] {
    let own = |i: usize| [format!("{i} PINHOLE 8 6 9 9 4 3"), format!("{i} 1 0 0 0 0 0 4 {i} {i}.png\n")];
    let lines: Vec<[String; 2]> = (0..8).map(|i| change(i).unwrap_or_else(|| own(i))).collect();
    let [cameras, images] = [0, 1].map(|part| lines.iter().map(|line| line[part].clone() + "\n").collect::<String>());
    [cameras.into_bytes(), images.into_bytes(), vec![]]
}

#[test]
fn principal_points_of_tiles_are_far_outside() {
    let tile = |i: usize| {
        [format!("{i} PINHOLE 8 6 9 9 {} -14", 32 - 8 * i as i32), format!("{i} 1 0 0 0 0 0 4 {i} {i}.png\n")]
    };
    let capture = read(folder(Encoding::Text, "sparse/0", &eight(|i| Some(tile(i)))).path()).unwrap();
    assert_eq!(capture.views.len(), 8, "{:?}", capture.assumptions);
    assert!(capture.views.iter().any(|view| view.camera.centre == [32.0, -14.0]));
}

#[test]
fn single_invalid_cameras_are_left_out() {
    let whole = |i: usize| [format!("{i} PINHOLE 8 6 9 9 4 3"), format!("{i} 1 0 0 0 0 0 4 {i} {i}.png\n")];
    let read = |files: &[Vec<u8>; 3]| read(folder(Encoding::Text, "sparse/0", files).path());
    for (camera, image, expected) in [
        ("3 PINHOLE 8 6 nan 9 4 3", "", "fx: must be a finite number, is NaN"),
        ("3 PINHOLE 0 6 9 9 4 3", "", "width: must be 1 to"),
        ("3 PINHOLE 8 6 9 1e300 4 3", "", "focal length: must be 1e-3 to 1e9 pixels, is 1"),
        ("3 EUCM 8 6 9 9 4 3 1 1", "", "EUCM is not supported"),
        ("3 EQUIRECTANGULAR 8 6 8 7", "", "must be those of the image, 8 and 6, are 8 and 7"),
        ("", "3 0 0 0 0 0 0 4 3 3.png\n", "qvec: is a quaternion of length 0"),
        ("", "3 1 0 0 0 inf 0 4 3 3.png\n", "tvec: must be a finite number, is inf"),
        ("", "3 -nan(ind) 0 0 0 0 0 4 3 3.png\n", "qvec: must be a finite number, is NaN"),
        ("", "3 1 0 0 0 0 1.#QNAN 4 3 3.png\n", "tvec: must be a finite number, is NaN"),
        ("3 PINHOLE 8 6 -1.#IND 9 4 3", "", "fx: must be a finite number, is NaN"),
        ("3 pinhole2 8 6 9 9 4 3", "", "`PINHOLE2` is no known camera model"),
    ] {
        let bad = |i: usize| {
            let lines = |own: String, other: &str| if other.is_empty() { own } else { other.to_owned() };
            let [own_camera, own_image] = whole(i);
            [lines(own_camera, camera), lines(own_image, image)]
        };
        let capture = read(&eight(|i| (i == 3).then(|| bad(3)))).unwrap();
        assert_eq!(capture.views.len(), 7);
        assert!(capture.views.iter().all(|view| view.name != "3.png"));
        let [what] = &capture.assumptions[..] else { panic!("{:?}", capture.assumptions) };
        assert!(what.starts_with("left out 1 of 8 images without a valid camera, such as `3.png`: "), "{what}");
        assert!(what.contains(expected), "{what}");
        // Half of the images make no scene.
        let with_number = |i: usize| bad(i).map(|line| line.replacen('3', &i.to_string(), 1));
        let most =
            eight(|i| (i >= 4).then(|| with_number(i).map(|line| line.replace(" 3 3.png", &format!(" {i} {i}.png")))));
        assert!(read(&most).unwrap_err().to_string().contains(expected));
    }
}

#[test]
fn spherical_and_plain_fisheye_models_are_read() {
    let with = |camera: &str| {
        let line = camera.to_owned();
        let files = eight(|i| (i == 0).then(|| [line.clone(), "0 1 0 0 0 0 0 4 0 0.png\n".to_owned()]));
        read(folder(Encoding::Text, "sparse/0", &files).path()).unwrap().views[0].camera.clone()
    };
    let panorama = with("0 EQUIRECTANGULAR 80 40 80 40");
    // Alone, it is the smallest camera of a binary file.
    let views = vec![View::new("0.png", "images[0]", panorama.clone())];
    let place = tempfile::tempdir().unwrap();
    let alone = Capture::new(place.path(), "transforms.json".into(), Format::Transforms, views);
    for encoding in Encoding::ALL {
        let folder = tempfile::tempdir().unwrap();
        write(&alone, folder.path(), encoding).unwrap();
        assert_eq!(read(folder.path()).unwrap().views[0].camera, panorama, "{encoding:?}");
    }
    assert_eq!(panorama.lens, Lens::Equirectangular);
    // COLMAP's formula: longitude 2 pi (x / w - 1/2), latitude pi (1/2 - y / h), in its axes.
    let (theta, phi) = (2.0 * std::f64::consts::PI * (0.7 - 0.5), std::f64::consts::PI * (0.5 - 0.4));
    let expected = DVec3::new(phi.cos() * theta.sin(), -phi.sin(), phi.cos() * theta.cos());
    assert!(panorama.ray(56.0, 16.0).direction.distance(expected) < 1e-12, "the pose is the identity in COLMAP's axes");
    let lens = Lens::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] };
    let fisheye = with("0 SIMPLE_FISHEYE 8 6 9 4 3");
    assert_eq!((fisheye.lens, fisheye.focal, fisheye.centre), (lens, [9.0; 2], [4.0, 3.0]));
    assert_eq!(with("0 FISHEYE 8 6 9 10 4 3").focal, [9.0, 10.0]);
    assert_eq!(with("0 PINHOLE 8 6 9 10 16 -6").centre, [16.0, -6.0], "a crop beside the principal point");
}

#[test]
fn images_are_found_in_other_folders_and_spellings() {
    let [cameras, images, points] = text();
    let images = String::from_utf8(images).unwrap().replace("b/second.png", "b\\second.png").into_bytes();
    let folder = folder(Encoding::Text, "sparse/0", &[cameras, images, points]);
    let touch = |path: &str| {
        let path = folder.path().join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, "").unwrap();
        path
    };
    let found = || {
        read(folder.path())
            .map(|capture| (capture.views.into_iter().map(|view| view.image).collect::<Vec<_>>(), capture.assumptions))
    };
    let second = touch("images/b/second.png");
    assert_eq!(found().unwrap(), (vec![None, Some(second.clone())], vec![]), "of Windows");
    let first = touch("images/A.JPG");
    let expected = ["`a.png` does not exist: used `A.JPG`".to_owned()];
    assert_eq!(found().unwrap(), (vec![Some(first), Some(second)], expected.to_vec()));
    touch("images/a.webp");
    assert!(found().unwrap_err().to_string().contains("`A.JPG` and `a.webp` fit"));
    // Another name of the folder.
    fs::remove_file(folder.path().join("images/a.webp")).unwrap();
    fs::rename(folder.path().join("images"), folder.path().join("photos")).unwrap();
    let (images, assumptions) = found().unwrap();
    assert_eq!(images[1], Some(folder.path().join("photos/b/second.png")));
    assert_eq!(assumptions.len(), 2, "{assumptions:?}");
}

#[test]
fn lists_of_splits_are_read() {
    let files = eight(|_| None);
    let folder = folder(Encoding::Text, "sparse/0", &files);
    let list = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
    let splits = |needed: bool| {
        let model = folder.path().join("sparse/0/images.txt");
        let capture = read_model(folder.path(), &model, needed)?;
        let of = |split: Option<Split>| capture.views.iter().filter(|view| view.split == split).count();
        let counts = [None, Some(Split::Train), Some(Split::Val), Some(Split::Test)].map(of);
        Ok::<_, Error>((counts, capture.assumptions))
    };
    let names: Vec<String> = read(folder.path()).unwrap().views.into_iter().map(|view| view.name).collect();
    assert_eq!((names.len(), splits(true).unwrap()), (8, ([8, 0, 0, 0], vec![])));
    // Of 3D Gaussian Splatting: with Windows line ends, an empty line and a name without its ending.
    let stem = names[3].rsplit_once('.').unwrap().0;
    list("sparse/0/test.txt", &format!("\u{feff}# test\r\n{}\r\n\r\n{stem}\r\n", names[1]));
    assert_eq!(splits(true).unwrap(), ([6, 0, 0, 2], vec![]));
    assert_eq!(splits(false).unwrap(), ([8, 0, 0, 0], vec![]));
    // Of nerfstudio, with a path and a name that the model lacks.
    list("train_list.txt", &format!("images/{}\n{}\nother.png\n", names[0], names[2]));
    list("val_list.txt", &format!("{}\n{}", names[4], names[1]));
    list("test_list.txt", &names[1]);
    let expected = ["`train_list.txt` lists 1 images that the model lacks, such as `other.png`".to_owned()];
    assert_eq!(splits(true).unwrap(), ([3, 2, 1, 2], expected.to_vec()));
    list("test_list.txt", &format!("{}\n{}", names[1], names[0]));
    let message = splits(true).unwrap_err().to_string();
    let expected = format!("test_list.txt: `line 2`: `{}` is in train_list.txt too: remove it", names[0]);
    assert!(message.contains(&expected), "{message}");
    assert!(splits(false).is_ok());
}

#[test]
fn written_lists_of_splits_are_read_again() {
    let mut capture = read(folder(Encoding::Text, "sparse/0", &eight(|_| None)).path()).unwrap();
    let [train, val, test] = Split::ALL.map(Some);
    for (splits, files) in [([None; 3], 0), ([train, val, test], 3), ([train, test, test], 3), ([train; 3], 0)] {
        capture.views.iter_mut().enumerate().for_each(|(i, view)| view.split = splits[i % 3]);
        capture.views[0].name = "#0.png".to_owned();
        let place = tempfile::tempdir().unwrap();
        write(&capture, place.path(), Encoding::Binary).unwrap();
        assert_eq!(fs::read_dir(place.path()).unwrap().count(), 1 + files, "{splits:?}");
        if splits == [train, test, test] {
            // nerfstudio evaluates on the validation images.
            let [val, test] =
                ["val", "test"].map(|split| fs::read(place.path().join(format!("{split}_list.txt"))).unwrap());
            assert!(val == test && !val.is_empty());
        }
        let again = read(place.path()).unwrap();
        let of = |capture: &Capture| {
            let mut all: Vec<_> = capture.views.iter().map(|view| (view.name.clone(), view.split)).collect();
            all.sort_by(|a, b| a.0.cmp(&b.0));
            all
        };
        let kept =
            if files == 0 { of(&capture).into_iter().map(|(name, _)| (name, None)).collect() } else { of(&capture) };
        assert_eq!((of(&again), again.assumptions), (kept, vec![]), "{splits:?}");
    }
}

#[test]
fn stale_copies_of_images_are_not_used() {
    let folder = folder(Encoding::Text, "sparse/0", &eight(|_| None));
    let write = |place: &str, i: usize, content: &str| {
        let place = folder.path().join(place);
        fs::create_dir_all(&place).unwrap();
        fs::write(place.join(format!("{i}.png")), content).unwrap();
    };
    let found = || {
        let capture = read(folder.path()).unwrap();
        let inside = |place: &str| {
            let images = capture.views.iter().filter_map(|view| view.image.as_ref());
            images.filter(|image| image.starts_with(folder.path().join(place))).count()
        };
        (["images", "input"].map(inside), capture.assumptions.clone())
    };
    (0..8).for_each(|i| write("input", i, "original"));
    (0..3).for_each(|i| write("images", i, "original"));
    let note = "`images` holds 3 of 8 files: used `input`, which holds 8";
    assert_eq!(found(), ([0, 8], vec![note.to_owned()]));
    // Others, such as undistorted images.
    write("images", 1, "other");
    assert_eq!(found(), ([3, 0], vec![]));
    // Half of the images.
    (0..4).for_each(|i| write("images", i, "original"));
    assert_eq!(found(), ([4, 0], vec![]));
}

#[test]
fn distorted_models_have_the_images_of_input() {
    let folder = folder(Encoding::Text, "distorted/sparse/0", &text());
    for name in ["images/a.png", "input/a.png", "images/b/second.png", "input/b/second.png"] {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, "").unwrap();
    }
    let input = Some(folder.path().join("input/a.png"));
    assert_eq!(read(folder.path()).unwrap().views[0].image, input);
    // The folder of the model, by itself and by a file.
    let model = folder.path().join("distorted/sparse/0");
    assert_eq!(root(&model), folder.path());
    assert_eq!(root(&folder.path().join("sparse/0")), folder.path());
    assert_eq!(root(&folder.path().join("colmap/sparse/0")), folder.path());
    assert_eq!(root(&folder.path().join("other")), folder.path().join("other"));
    assert_eq!(read(&model).unwrap().views[0].image, input);
}
