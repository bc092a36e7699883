use super::*;
use crate::camera::pinhole::Camera;
use crate::dataset::formats::kit::{cases, damage, failure, frames, is_whole, picture, remove, says};
use glam::{DAffine3, DMat3, DVec3};
use proptest::prelude::*;
use raygrad_test_support::skip::skipped;
use serde_json::json;

const FILE: &str = "transforms_train.json";

fn document(names: &[&str]) -> Value {
    json!({ "camera_angle_x": 0.8, "frames": frames(names) })
}

/// A folder with the images `train/r_0.png` and `train/r_1.png` of 8x6 pixels, and a changed training split.
fn folder(change: impl FnOnce(&mut Value)) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    picture(&folder.path().join("train/r_0.png"), 8, 6);
    picture(&folder.path().join("train/r_1.png"), 8, 6);
    let mut document = document(&["./train/r_0", "./train/r_1"]);
    change(&mut document);
    std::fs::write(folder.path().join(FILE), document.to_string()).unwrap();
    folder
}

#[track_caller]
fn good(change: impl FnOnce(&mut Value)) -> Capture {
    let capture = read(folder(change).path()).unwrap();
    is_whole(&capture);
    capture
}

#[track_caller]
fn fails(change: impl FnOnce(&mut Value), parts: &[&str]) {
    says(&failure(read(folder(change).path()), FILE), parts);
}

#[test]
fn images_and_cameras_are_read() {
    let folder = folder(|_| {});
    assert_eq!(file(folder.path()), Some(folder.path().join(FILE)));
    assert_eq!(file(tempfile::tempdir().unwrap().path()), None);
    let capture = read(folder.path()).unwrap();
    assert_eq!((capture.views.len(), capture.format), (2, Format::Blender));
    let view = &capture.views[1];
    assert_eq!((view.name.as_str(), view.field.as_str(), view.split), ("train/r_1", "frames[1]", Some(Split::Train)));
    assert_eq!(view.image, Some(folder.path().join("train/r_1.png")));
    let camera = &view.camera;
    assert_eq!((camera.width, camera.height, camera.centre), (8, 6, [4.0, 3.0]));
    assert_eq!((camera.focal, camera.lens), ([4.0 / 0.4f64.tan(); 2], Lens::Pinhole));
    let ray = camera.ray(4.0, 3.0);
    assert_eq!((ray.origin, ray.direction), (DVec3::new(0.0, 0.0, 4.0), DVec3::NEG_Z));
}

#[test]
fn vertical_angles_are_those_of_the_sensor() {
    let capture = good(|d| d["frames"][1]["camera_angle_y"] = json!(0));
    assert_eq!(capture.views.len(), 2, "{:?}", capture.assumptions);
}

#[test]
fn blender_masks_are_found() {
    let folder = folder(|_| {});
    let mask = folder.path().join("masks/train/r_1.png");
    picture(&mask, 8, 6);
    let capture = read(folder.path()).unwrap();
    assert_eq!(capture.views.iter().map(|view| view.mask.clone()).collect::<Vec<_>>(), [None, Some(mask)]);
    let [some, used] = &capture.assumptions[..] else { panic!("{:?}", capture.assumptions) };
    assert_eq!(some, "1 of 2 images have a mask in `masks`; 1 have no mask, and use all pixels");
    says(used, &["no frame lists a mask: used those beside them, such as `masks/train/r_1.png`"]);
    // Without the folder of the split, if the name is that of a single image.
    let plain = folder.path().join("masks/r_0.png");
    picture(&plain, 8, 6);
    assert_eq!(read(folder.path()).unwrap().views[0].mask, Some(plain));
    std::fs::write(folder.path().join("transforms_test.json"), document(&["./test/r_0"]).to_string()).unwrap();
    picture(&folder.path().join("test/r_0.png"), 8, 6);
    let masks: Vec<_> = read(folder.path()).unwrap().views.iter().map(|view| view.mask.is_some()).collect();
    assert_eq!(masks, [false, true, false]);
}

#[test]
fn blender_splits_are_all_read() {
    let folder = folder(|d| d["aabb_scale"] = json!(2));
    let file = |split: &str, text: String| std::fs::write(folder.path().join(format!("transforms_{split}.json")), text);
    file("test", document(&["test/r_0"]).to_string()).unwrap();
    let of = || {
        let capture = read(folder.path()).unwrap();
        let views = capture.views.iter().map(|view| (view.split, view.field.clone())).collect::<Vec<_>>();
        (capture.file, views)
    };
    let [train, val, test] = Split::ALL.map(Some);
    let (path, views) = of();
    assert_eq!(path, folder.path().join(FILE));
    let at = |split, field: &str| (split, field.to_owned());
    let expected = [at(train, "frames[0]"), at(train, "frames[1]"), at(test, "transforms_test.json frames[0]")];
    assert_eq!(views, expected);
    std::fs::remove_file(folder.path().join(FILE)).unwrap();
    file("val", document(&["train/r_0"]).to_string()).unwrap();
    let (path, views) = of();
    assert_eq!(path, folder.path().join("transforms_val.json"));
    assert_eq!(views, [at(val, "frames[0]"), at(test, "transforms_test.json frames[0]")]);
    file("test", "{}".to_owned()).unwrap();
    says(&failure(read(folder.path()), "transforms_test.json"), &["`frames`: is missing"]);
    file("test", "{\"frames\": []}".to_owned()).unwrap();
    let capture = read(folder.path()).unwrap();
    assert_eq!(
        (capture.views.len(), &capture.assumptions[..]),
        (1, &["`transforms_test.json` has no frames".into()][..])
    );
    file("val", "{\"frames\": []}".to_owned()).unwrap();
    says(&failure(read(folder.path()), "transforms_val.json"), &["`frames`: is empty"]);
    let none = tempfile::tempdir().unwrap();
    says(&read(none.path()).unwrap_err().to_string(), &["is not a Blender dataset", "transforms_val.json"]);
}

#[test]
fn size_comes_from_the_file_or_the_first_image() {
    let sizes = |capture: Capture| capture.views.iter().map(|v| [v.camera.width, v.camera.height]).collect::<Vec<_>>();
    let folder = folder(|d| d["frames"] = frames(&["train/r_9", "train/r_0", "train/r_1"]));
    picture(&folder.path().join("train/r_1.png"), 5, 5);
    assert_eq!(sizes(read(folder.path()).unwrap()), [[8, 6]; 3], "who loads the images compares");
    let given = good(|d| (d["w"], d["h"]) = (json!(16), json!(12)));
    assert_eq!(given.views[0].camera.focal, [8.0 / 0.4f64.tan(); 2]);
    assert_eq!(sizes(given), [[16, 12]; 2]);
    let absent = good(|d| d["frames"] = frames(&["train/r_8", "train/r_9"]));
    assert!(absent.views.iter().all(|view| view.image.is_none()));
    assert_eq!(sizes(absent), [[0, 0]; 2]);
}

#[test]
fn names_with_extension_are_read() {
    let folder = folder(|d| d["frames"] = frames(&["train/r_0.png", "train/r_1.5", "train/../train/r_1"]));
    std::fs::copy(folder.path().join("train/r_0.png"), folder.path().join("train/r_1.5.png")).unwrap();
    let capture = read(folder.path()).unwrap();
    let names: Vec<&str> = capture.views.iter().map(|view| view.name.as_str()).collect();
    assert_eq!(names, ["train/r_0.png", "train/r_1.5", "train/../train/r_1"]);
    assert!(capture.views.iter().all(|view| view.image.is_some()));
}

#[test]
fn bad_fields_are_named() {
    for value in [json!(0), json!(-0.5), json!(3.2)] {
        let is = format!("is {value}");
        fails(|d| d["camera_angle_x"] = value, &["`camera_angle_x`", "between 0 and pi", &is]);
    }
    fails(|d| d["camera_angle_x"] = json!("wide"), &["`camera_angle_x`: must be a finite number, is \"wide\""]);
    fails(|d| d["camera_angle_x"] = json!(null), &["`camera_angle_x`: is missing"]);
    fails(|d| remove(d, "camera_angle_x"), &["`camera_angle_x`: is missing"]);
    fails(|d| remove(&mut d["frames"][1], "file_path"), &["`frames[1].file_path`: is missing"]);
    fails(|d| remove(&mut d["frames"][1], "transform_matrix"), &["`frames[1].transform_matrix`: is missing"]);
    assert_eq!(good(|d| d["aabb_scale"] = json!(0)).assumptions, ["ignored `aabb_scale`: must be above 0, is 0"]);
    fails(|d| d["frames"][1]["transform_matrix"][2][2] = json!(-1), &["`frames[1].transform_matrix`", "mirrors"]);
    fails(|d| d["frames"] = json!([]), &["`frames`: is empty"]);
    let folder = folder(|_| {});
    std::fs::write(folder.path().join("train/r_0.png"), b"not a picture").unwrap();
    says(&failure(read(folder.path()), FILE), &["`frames[0].file_path`: ", "r_0.png: cannot be decoded"]);
}

#[test]
fn fields_of_other_programs_are_read() {
    let of = |fields: Value| {
        good(|d| d.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone())).views.remove(0).camera
    };
    let plain = of(json!({}));
    assert_eq!(
        of(json!({ "camera_angle_y": 0.4711, "scale": 0.33, "offset": [0.5, 0.5, 0.5] })),
        plain,
        "its sensor's"
    );
    assert_eq!(of(json!({ "fl_x": 9.0 })).focal, [9.0; 2]);
    let sensor = good(|d| {
        remove(d, "camera_angle_x");
        (d["fl_x"], d["fl_y"], d["camera_angle_y"]) = (json!(9), json!(9), json!(0.4711));
    });
    assert_eq!(sensor.assumptions, [""; 0], "the sensor contradicts nothing");
    assert_eq!(of(json!({ "cx": 4.5 })).centre, [4.5, 3.0]);
    assert_ne!(of(json!({ "k1": 0.1 })).lens, plain.lens);
    assert_eq!(of(json!({ "k1": 0, "camera_model": "SIMPLE_RADIAL", "is_fisheye": 0 })), plain);
    let own = good(|d| d["frames"][1]["camera_angle_x"] = json!(0.9));
    assert_eq!(own.views[1].camera.focal, [4.0 / 0.45f64.tan(); 2]);
    fails(|d| d["x_fov"] = json!(45.8), &["`x_fov`: is 45.8, which raygrad does not read"]);
}

#[test]
fn lego_is_read() {
    let lego = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data/lego"));
    if !lego.is_dir() {
        skipped(&format!("there is no folder {}", lego.display()));
        return;
    }
    let capture = read(lego).unwrap();
    let count = |split| capture.views.iter().filter(|view| view.split == Some(split)).count();
    assert_eq!(Split::ALL.map(count), [100, 100, 200]);
    for view in &capture.views {
        assert!(view.image.is_some() && (view.camera.width, view.camera.height) == (400, 400));
        assert!((view.camera.pose.translation.length() - 4.0).abs() < 0.1);
    }
}

/// A capture with a view for each split.
fn capture(folder: &Path) -> Capture {
    let view = |i: usize| {
        let image = folder.join(format!("images/r_{i}.png"));
        picture(&image, 8, 6);
        let pose = DAffine3 { matrix3: DMat3::from_rotation_x(i as f64), translation: DVec3::new(0.1, 0.2, 0.3) };
        View {
            image: Some(image),
            split: Some(Split::ALL[i]),
            ..View::new(format!("images/r_{i}"), "frames[0]", Camera::from_angle(8, 6, 0.8, pose))
        }
    };
    let mut capture = good(|d| d["aabb_scale"] = json!(4));
    (capture.folder, capture.file) = (folder.to_owned(), folder.join(FILE));
    capture.views = (0..3).map(view).collect();
    capture.views[1].field = "transforms_val.json frames[0]".into();
    capture.views[2].field = "transforms_test.json frames[0]".into();
    capture
}

#[test]
fn blender_writing_round_trips() {
    let folder = tempfile::tempdir().unwrap();
    let mut before = capture(folder.path());
    write(&before, folder.path()).unwrap();
    let mut again = read(folder.path()).unwrap();
    for (view, other) in again.views.iter_mut().zip(&before.views) {
        let [f, expected] = [view.camera.focal, other.camera.focal];
        assert!((f[0] - expected[0]).abs() < 1e-14 * expected[0] && f[0] == f[1], "{f:?} {expected:?}");
        view.camera.focal = expected;
    }
    assert_eq!(again, before);
    let document = json::read(&folder.path().join("transforms_val.json")).unwrap();
    assert_eq!(document["frames"][0]["file_path"], "./images/r_1", "other programs put .png behind it");
    // Other extensions stay, and views without a split become training views.
    let other = tempfile::tempdir().unwrap();
    before.views.iter_mut().for_each(|view| view.split = None);
    before.views[2].image = Some(folder.path().join("images/r_2.JPG"));
    write(&before, other.path()).unwrap();
    let document = json::read(&other.path().join(FILE)).unwrap();
    assert_eq!(document["frames"][2]["file_path"], "./images/r_2.JPG");
    assert_eq!(std::fs::read_dir(other.path()).unwrap().count(), 1);
}

#[test]
fn unsupported_views_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let before = capture(folder.path());
    let fails = |change: fn(&mut View), parts: &[&str]| {
        let mut capture = before.clone();
        change(&mut capture.views[1]);
        let message = write(&capture, folder.path()).unwrap_err().to_string();
        says(&message, &["cannot be written in Blender's format: images/r_1 "]);
        says(&message, parts);
        assert_eq!(file(folder.path()), None);
    };
    let undistort = "`raygrad prepare --undistort --to blender`";
    fails(|v| v.camera.lens = Lens::Fov { omega: 0.9 }, &["has lens distortion", undistort]);
    fails(|v| v.camera.focal[1] *= 1.01, &["so no square pixels", undistort]);
    fails(|v| v.camera.centre[0] += 0.5, &["at 4.5, 3, not at the centre", undistort]);
    fails(|v| v.camera.centre[1] += 0.5, &["at 4, 3.5, not at the centre", undistort]);
    fails(|v| v.camera.focal = [9.0; 2], &["differs in size or focal length from images/r_0", undistort]);
    fails(|v| (v.camera.height, v.camera.centre[1]) = (8, 4.0), &["differs in size", undistort]);
    fails(|v| v.camera.pose.translation.x = f64::NAN, &["non-finite number"]);
    fails(|v| v.camera.focal = [f64::NAN; 2], &["so no square pixels"]);
    fails(|v| v.mask = Some("mask.png".into()), &["has a mask"]);
    fails(|v| v.split = None, &["has no split while others do, or the reverse"]);
    let empty = Capture { views: vec![], ..before.clone() };
    says(&write(&empty, folder.path()).unwrap_err().to_string(), &["there are no images"]);
}

#[test]
fn damaged_blender_files_are_named() {
    let folder = folder(|_| {});
    let file = folder.path().join(FILE);
    let whole = [false, true].map(|sized| {
        let mut document = document(&["./train/r_0", "./train/r_1"]);
        if sized {
            (document["w"], document["h"]) = (json!(8), json!(6));
        }
        document.to_string().into_bytes()
    });
    let config = ProptestConfig { cases: cases(), ..ProptestConfig::default() };
    proptest!(config, |(damage in damage::damage(), sized in any::<bool>())| {
        std::fs::write(&file, damage::damaged(&whole[usize::from(sized)], &whole[usize::from(!sized)], &damage)).unwrap();
        match read(folder.path()) {
            Ok(capture) => is_whole(&capture),
            Err(error) => damage::clear(error, FILE),
        }
    });
}

#[test]
fn images_of_another_split_take_no_place() {
    let folder = folder(|_| {});
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("transforms_test.json"), document(&["test/r_0"]).to_string()).unwrap();
    picture(&at("unlisted/r_0.png"), 8, 6);
    picture(&at("unlisted/r_1.png"), 8, 6);
    std::fs::rename(at("train"), at("val")).unwrap();
    // Two splits list the name, and a folder of another kind fits neither.
    says(
        &failure(read(folder.path()), FILE),
        &["`test/r_0` and `train/r_0` do not exist", "`unlisted/r_0.png` fits both"],
    );
    std::fs::remove_dir_all(at("unlisted")).unwrap();
    assert!(read(folder.path()).unwrap().views.iter().all(|view| view.image.is_none()));
}

#[test]
fn files_of_held_out_images_may_be_broken_if_their_splits_are_not_needed() {
    use crate::dataset::HoldOut;
    let folder = tempfile::tempdir().unwrap();
    let document = json!({ "camera_angle_x": 0.8, "w": 8, "h": 6, "frames": frames(&["./a", "./b"]) });
    std::fs::write(file_of(folder.path(), Split::Train), document.to_string()).unwrap();
    let test = file_of(folder.path(), Split::Test);
    picture(&folder.path().join("a.png"), 8, 6);
    // The same image in two splits.
    std::fs::write(&test, document.to_string()).unwrap();
    let message = failure(Capture::read(folder.path()), "transforms_train.json");
    says(
        &message,
        &["`a` is held out, but its image is trained on", "remove one of them; `raygrad train --test` chooses other"],
    );
    let mut capture = Capture::read_unsplit(folder.path(), None, None).unwrap();
    assert!(capture.views.len() == 4 && capture.views.iter().all(|view| view.split.is_none()));
    capture.hold_out(&HoldOut::Images(vec!["a".into()])).unwrap();
    let splits: Vec<_> = capture.views.iter().map(|view| view.split.unwrap()).collect();
    assert_eq!(splits, [Split::Test, Split::Train, Split::Test, Split::Train]);
    std::fs::write(&test, "{").unwrap();
    says(&failure(Capture::read(folder.path()), "transforms_test.json"), &["is not valid JSON"]);
    let capture = Capture::read_unsplit(folder.path(), None, None).unwrap();
    assert_eq!(capture.views.len(), 2);
    assert!(matches!(&capture.assumptions[..], [note] if note.starts_with("left out the frames of ")
        && note.contains("transforms_test.json: is not valid JSON")));
    // Fields count, also those of held-out images.
    std::fs::write(&test, "{}").unwrap();
    let message = failure(Capture::read_unsplit(folder.path(), None, None), "transforms_test.json");
    says(&message, &["`frames`: is missing"]);
    std::fs::write(&test, "{").unwrap();
    // Training images are needed.
    std::fs::rename(&test, file_of(folder.path(), Split::Train)).unwrap();
    says(&failure(Capture::read_unsplit(folder.path(), None, None), "transforms_train.json"), &["is not valid JSON"]);
}

#[test]
fn turned_images_are_not_counted_by_a_single_header() {
    let folder = tempfile::tempdir().unwrap();
    let document = json!({ "camera_angle_x": 0.8, "frames": frames(&["a", "b"]) });
    std::fs::write(file_of(folder.path(), Split::Train), document.to_string()).unwrap();
    for name in ["a.jpg", "b.jpg"] {
        std::fs::write(folder.path().join(name), crate::dataset::photo::tests::jpeg(6)).unwrap();
    }
    let notes = read(folder.path()).unwrap().assumptions;
    let expected = "images have an EXIF orientation but no `w` and `h`, such as `a.jpg`: ";
    assert!(matches!(&notes[..], [note] if note.starts_with(expected)), "{notes:?}");
}
