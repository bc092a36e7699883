use super::*;
use crate::dataset::formats::cases;
use proptest::prelude::*;
use raygrad_test_support::damage::{clear, damage, damaged};
use std::fs;

/// Two rows by hand. One camera is at (1, 2, 3) and looks along -z of the world with +y up. The other is at (0, 0, 5)
/// and looks along -x with +z up.
#[rustfmt::skip]
const ROWS: [[f64; COLUMNS]; 2] = [
    [0.0, 1.0, 0.0, 1.0, 30.0,
     -1.0, 0.0, 0.0, 2.0, 40.2,
     0.0, 0.0, 1.0, 3.0, 55.5, 1.5, 20.0],
    [0.0, 0.0, 1.0, 0.0, 30.0,
     0.0, 1.0, 0.0, 0.0, 40.2,
     -1.0, 0.0, 0.0, 5.0, 55.5, 2.5, 9.0],
];

/// A file in NumPy's encoding.
fn npy(rows: &[[f64; COLUMNS]]) -> Vec<u8> {
    let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({}, 17), }}\n", rows.len());
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.bytes());
    rows.iter().flatten().for_each(|value| bytes.extend(value.to_le_bytes()));
    bytes
}

fn folder(bytes: &[u8], images: &[&str]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join(FILE), bytes).unwrap();
    for image in images {
        let path = folder.path().join(image);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, "").unwrap();
    }
    folder
}

/// The images of two rows, and entries that are not images.
const IMAGES: [&str; 5] = ["images/b.JPG", "images/a.png", "images/notes.txt", "images/c.png/x", "images/._a.png"];

#[test]
fn llff_rows_follow_image_names() {
    let folder = folder(&npy(&ROWS), &IMAGES);
    #[cfg(unix)]
    {
        use std::os::unix::ffi::OsStrExt;
        let other = std::ffi::OsStr::from_bytes(b"images/caf\xe9.txt");
        fs::write(folder.path().join(other), "").unwrap();
    }
    let capture = read(folder.path()).unwrap();
    let [a, b] = &capture.views[..] else { panic!("{} views", capture.views.len()) };
    assert_eq!((a.name.as_str(), b.name.as_str(), a.field.as_str()), ("a.png", "b.JPG", "row 0"));
    assert_eq!(a.image, Some(folder.path().join("images/a.png")));
    assert_eq!((a.bounds, b.bounds), (Some([1.5, 20.0]), Some([2.5, 9.0])));
    let pose = DAffine3 { matrix3: DMat3::IDENTITY, translation: DVec3::new(1.0, 2.0, 3.0) };
    let expected = Camera { width: 40, height: 30, focal: [55.5; 2], centre: [20.0, 15.0], lens: Lens::Pinhole, pose };
    assert_eq!(a.camera, expected);
    let pose = Camera::look_at(DVec3::new(0.0, 0.0, 5.0), DVec3::new(-9.0, 0.0, 5.0), DVec3::Z);
    assert_eq!(b.camera, Camera { pose, ..expected });
    // The point is to the right of the axis and above it.
    assert_eq!(a.camera.pixel_of(DVec3::new(2.0, 4.0, 2.0)), Some([20.0 + 55.5, 15.0 - 111.0]));
    assert_eq!((capture.format, capture.file), (Format::Llff, folder.path().join(FILE)));
}

#[test]
fn reduced_images_replace_absent_ones() {
    let all =
        folder(&npy(&ROWS), &["images_8/0.png", "images_8/1.png", "images_4/2.png", "images_4/3.png", "images_x/y"]);
    assert_eq!(read(all.path()).unwrap().views[0].name, "2.png", "the least reduced");
    fs::create_dir(all.path().join("images")).unwrap();
    assert_eq!(read(all.path()).unwrap().views[0].name, "2.png", "an empty folder has none");
    let none = folder(&npy(&ROWS), &[]);
    let message = read(none.path()).unwrap_err().to_string();
    assert!(message.contains("images") && message.contains("has no images (png, jpg, webp, tif)"), "{message}");
}

#[test]
fn llff_errors_name_the_row() {
    let fails_as = |bytes: &[u8], expected: &str| {
        let message = read(folder(bytes, &IMAGES).path()).unwrap_err().to_string();
        assert!(message.contains(FILE) && message.contains(expected), "{message}");
    };
    let fails = |column: usize, value: f64, expected: &str| {
        let mut rows = ROWS;
        rows[1][column] = value;
        fails_as(&npy(&rows), &format!("`row 1`: {expected}"));
    };
    fails(3, f64::NAN, "column 3 is not a finite number");
    fails(
        2,
        -1.0,
        "its first three columns (down, right, backwards): must be a rotation, but mirrors: its determinant is -1",
    );
    fails(2, 1.002, "its first three columns (down, right, backwards): must be a rotation, but its columns are not");
    fails(4, 0.4, "height must be 1 to");
    fails(9, 1e300, "width must be 1 to");
    fails(14, 0.0, "focal length must be 1e-3 to 1e9 pixels, is 0");
    fails_as(&npy(&ROWS[..1]), "`shape`: has 1 rows, but there are 2 images");
    fails_as(&npy(&[]), "`shape`: has no rows: add one per image");
    fails_as(&Matrix { rows: 2, columns: 15, values: vec![0.0; 30] }.write(), "`shape`: must have 17 columns, has 15");
    fails_as(b"?", "is not a complete npy file: copy it again");
}

#[test]
fn invalid_depths_are_ignored() {
    for (column, value, expected) in [
        (15, -1.0, "-1 and 9"),
        (15, 0.0, "0 and 9"),
        (15, 8e-4, "0.0008 and 9"),
        (16, 2.5, "2.5 and 2.5"),
        (16, f64::NAN, "2.5 and NaN"),
    ] {
        let mut rows = ROWS;
        rows[1][column] = value;
        let capture = read(folder(&npy(&rows), &IMAGES).path()).unwrap();
        assert_eq!(capture.views.iter().map(|view| view.bounds).collect::<Vec<_>>(), [Some([1.5, 20.0]), None]);
        let what = format!("ignored the depths of 1 of 2 rows, which {DEPTHS}: row 1 has");
        assert_eq!(capture.assumptions, [format!("{what} {expected}")]);
    }
    let mut rows = ROWS;
    rows[1][15] = 1e-3;
    for rows in [ROWS, rows] {
        assert_eq!(read(folder(&npy(&rows), &IMAGES).path()).unwrap().assumptions, [""; 0]);
    }
}

#[test]
fn single_invalid_rows_are_left_out() {
    let images = ["images/0.png", "images/1.png", "images/2.png"];
    for (bad, expected) in
        [([0.0; COLUMNS], "must be a rotation, but"), ([f64::NAN; COLUMNS], "column 0 is not a finite number")]
    {
        let capture = read(folder(&npy(&[ROWS[0], bad, ROWS[1]]), &images).path()).unwrap();
        let names: Vec<&str> = capture.views.iter().map(|view| view.name.as_str()).collect();
        assert_eq!((names, capture.views[1].bounds), (vec!["0.png", "2.png"], Some([2.5, 9.0])));
        let [what] = &capture.assumptions[..] else { panic!("{:?}", capture.assumptions) };
        assert!(what.starts_with("left out 1 of 3 images without a valid camera, such as `1.png`: "), "{what}");
        assert!(what.contains("`row 1`: ") && what.contains(expected), "{what}");
        let message = read(folder(&npy(&[ROWS[0], bad, bad]), &images).path()).unwrap_err().to_string();
        assert!(message.contains("`row 1`: ") && message.contains(expected), "{message}");
    }
}

#[test]
fn images_of_other_folders_and_types_are_found() {
    let found = |images: &[&str]| {
        let folder = folder(&npy(&ROWS), images);
        let capture = read(folder.path())?;
        let path = |view: View| view.image.unwrap().strip_prefix(folder.path()).unwrap().display().to_string();
        Ok::<_, Error>((path(capture.views.into_iter().next().unwrap()), capture.assumptions))
    };
    let note = |place: &str| vec![format!("there are no images in `images`: used those {place}")];
    for (images, expected) in [
        (&["images/0.webp", "images/1.WEBP"][..], vec![]),
        (&["Images/0.png", "Images/1.png", "rgb/9.png"], vec![]),
        (&["images_4/0.png", "images_4/1.png", "input/9.png"], vec![]),
        (&["input/0.png", "input/1.png", "9.png"], note("of `input`")),
        (&["RGB/0.jpg", "RGB/1.jpg"], note("of `RGB`")),
        (&["0.jpg", "1.jpg", "masks/0.png"], note("beside `poses_bounds.npy`")),
    ] {
        let mut notes = expected;
        notes.extend(images.contains(&"masks/0.png").then(|| "masks".to_owned()));
        let (first, said) = found(images).unwrap();
        assert_eq!((first.as_str(), said.len()), (images[0], notes.len()));
        assert!(said.iter().zip(&notes).all(|(said, note)| said.contains(note)), "{said:?}");
    }
    let message = found(&["photos/0.png", "photos/1.png"]).unwrap_err().to_string();
    assert!(message.contains("has no images (png, jpg, webp, tif)"), "{message}");
    let message = found(&["input/0.png", "input/1.png", "input/2.png"]).unwrap_err().to_string();
    assert!(message.contains("has 2 rows, but there are 3 images in "), "{message}");
}

#[test]
fn list_names_the_images_of_the_rows() {
    let of = |list: &str, images: &[&str]| {
        let folder = folder(&npy(&ROWS), images);
        fs::write(folder.path().join(LIST), list).unwrap();
        read(folder.path()).map(|capture| {
            let names = capture.views.iter().map(|view| (view.name.clone(), view.image.is_some(), view.camera.height));
            (names.collect::<Vec<_>>(), capture.assumptions)
        })
    };
    let images = ["images/a.png", "images/b.png", "images/c.png"];
    let good = |list: &str, images: &[&str], expected: [(&str, bool); 2]| {
        let (names, said) = of(list, images).unwrap();
        assert_eq!(names, expected.map(|(name, exists)| (name.to_owned(), exists, 30)));
        let count = images.len();
        assert_eq!(said, [format!("took the 2 images that `view_imgs.txt` lists, of {count}")]);
    };
    good("a.png\nc.png", &images, [("a.png", true), ("c.png", true)]);
    good("\u{feff}./images/a.png\r\n\r\n images\\c.png \r\n", &images, [("a.png", true), ("c.png", true)]);
    let reduced = ["images_4/a.png", "images_4/b.png", "images_4/c.png"];
    good("A.JPG\nc.png", &reduced, [("a.png", true), ("c.png", true)]);
    good("b.png\nd.png", &images, [("b.png", true), ("d.png", false)]);
    good("b.png\nd.png", &images[1..2], [("b.png", true), ("d.png", false)]);
    let fails = |list: &str, expected: &str| {
        let message = of(list, &images).unwrap_err().to_string();
        assert!(message.contains(&format!("{LIST}: {expected}")), "{message}");
    };
    fails("a.png", "has 1 names, but poses_bounds.npy has 2 rows: list the image of each row");
    fails("a.png\na.png", "lists `a.png` twice");
    // Two readings.
    fails(
        "c.png\na.png",
        "lists `a.png` after `c.png`: rows may follow these lines or, as LLFF writes them, the names;",
    );
    let folder = folder(&npy(&ROWS), &images);
    let message = read(folder.path()).unwrap_err().to_string();
    assert!(message.contains("has 2 rows, but there are 3 images in ") && message.contains(LIST), "{message}");
    // As many images as rows, but others.
    good("a.png\nb.png", &images[1..], [("a.png", false), ("b.png", true)]);
    // Equal numbers need no list.
    fs::write(folder.path().join(LIST), "?").unwrap();
    fs::remove_file(folder.path().join("images/c.png")).unwrap();
    assert_eq!(read(folder.path()).unwrap().views[1].name, "b.png");
}

#[test]
fn llff_masks_are_found() {
    let folder = folder(&npy(&ROWS), &["images/a.png", "images/b.png", "masks/b.png"]);
    let capture = read(folder.path()).unwrap();
    assert_eq!((&capture.views[0].mask, &capture.views[1].mask), (&None, &Some(folder.path().join("masks/b.png"))));
    assert_eq!(capture.assumptions, ["1 of 2 images have a mask in `masks`; 1 have no mask, and use all pixels"]);
}

#[test]
fn llff_round_trip_is_exact() {
    let mut rows = ROWS;
    // The length that NumPy's float32 rounding may give; it is kept.
    rows[1][2] = 1.0 + 1.0 / 3000.0;
    let before = read(folder(&npy(&rows), &IMAGES).path()).unwrap();
    let other = folder(b"", &IMAGES);
    write(&before, other.path()).unwrap();
    let after = read(other.path()).unwrap();
    let said = |capture: &Capture| {
        capture.views.iter().map(|v| format!("{} {:?} {:?}", v.name, v.camera, v.bounds)).collect::<Vec<_>>()
    };
    assert_eq!(said(&before), said(&after));
    let bits = |bytes: &[u8]| Matrix::read(bytes).unwrap().values;
    let mut whole = bits(&npy(&rows));
    // A camera's sides are whole pixels.
    [9, 26].into_iter().for_each(|i| whole[i] = 40.0);
    assert_eq!(bits(&fs::read(other.path().join(FILE)).unwrap()), whole);
}

#[test]
fn unwritable_llff_captures_are_named() {
    let fails = |change: &dyn Fn(&mut Capture), expected: &str| {
        let mut capture = read(folder(&npy(&ROWS), &IMAGES).path()).unwrap();
        change(&mut capture);
        let message = write(&capture, Path::new("absent")).unwrap_err().to_string();
        assert!(message.contains(FILE) && message.contains(expected), "{message}");
    };
    let camera = |change: &dyn Fn(&mut Camera), expected: &str| {
        fails(&|capture| change(&mut capture.views[1].camera), &format!("`row 1.camera`: {expected}"));
    };
    camera(
        &|c| c.lens = Lens::Fov { omega: 1.0 },
        "has lens distortion; LLFF needs equal pinhole cameras: convert the original with",
    );
    camera(&|c| c.centre[1] = 14.0, "has its principal point at (20, 14), not at the centre");
    camera(&|c| c.focal[1] = 14.0, "has different focal lengths, 55.5 and 14");
    camera(&|c| c.focal = [14.0; 2], "differs in size or focal length from the others; LLFF needs");
    camera(&|c| c.pose.matrix3 *= 2.0, "its first three columns (down, right, backwards): must be a rotation");
    fails(
        &|capture| capture.views[1].bounds = None,
        "`row 1.bounds`: are missing; LLFF needs the nearest and the farthest depth",
    );
    let invalid = format!("`row 1.bounds`: {DEPTHS}, are 2 and 1");
    fails(&|capture| capture.views[1].bounds = Some([2.0, 1.0]), &invalid);
    fails(
        &|capture| capture.views[1].name = "a/b.png".into(),
        "`row 1.name`: `a/b.png` must be a plain png or jpg name",
    );
    fails(&|capture| capture.views[1].name = "b.webp".into(), "`row 1.name`: `b.webp` must be a plain png or jpg name");
    fails(&|capture| capture.views[1].name = "b".into(), "`row 1.name`: `b` must be a plain png or jpg name");
    fails(&|capture| capture.views[1].name = "a.png".into(), "`row 1.name`: `a.png` is there twice");
    fails(&|capture| capture.views.clear(), "has no images to write: add at least one");
}

proptest! {
    #![proptest_config(cases(1000))]

    #[test]
    fn damaged_llff_files_are_named_or_sound(damage in damage()) {
        let images = ["a.png", "b.png"].map(|name| (name.to_owned(), PathBuf::from(name))).to_vec();
        match parse(Path::new("x"), &damaged(&npy(&ROWS), &npy(&ROWS[..1]), &damage), images) {
            Ok(capture) => for View { camera, bounds, .. } in &capture.views {
                prop_assert!(rigid::pose(&camera.pose).is_ok() && camera.focal[0] > 0.0, "{:?}", camera);
                prop_assert!(bounds.is_none_or(|[near, far]| 0.0 < near && near < far && far.is_finite()));
            },
            Err(error) => clear(error, FILE),
        }
    }
}
