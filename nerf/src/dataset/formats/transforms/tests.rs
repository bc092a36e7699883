use super::*;
use crate::dataset::capture::Point;
use crate::dataset::formats::kit::{cases, damage, failure, frames, is_whole, picture, pose, remove, says};
use crate::dataset::formats::rigid;
use glam::{DMat3, DVec3};
use proptest::prelude::*;
use raygrad_test_support::skip::skipped;
use serde_json::json;

mod writing;

fn document() -> Value {
    json!({ "fl_x": 10.0, "w": 8, "h": 6, "frames": frames(&["./images/0.png", "images/1.png", "images/2.png"]) })
}

/// A folder with the first two images, and a changed document.
fn folder(change: impl FnOnce(&mut Value)) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    picture(&folder.path().join("images/0.png"), 8, 6);
    picture(&folder.path().join("images/1.png"), 8, 6);
    let mut document = document();
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
fn views_keep_file_order_and_their_field() {
    let folder = folder(|_| {});
    let capture = read(folder.path()).unwrap();
    let names: Vec<_> = capture.views.iter().map(|view| (view.name.as_str(), view.field.as_str())).collect();
    let expected = [("images/0.png", "frames[0]"), ("images/1.png", "frames[1]"), ("images/2.png", "frames[2]")];
    assert_eq!(names, expected);
    assert_eq!(capture.views[1].image, Some(folder.path().join("images/1.png")));
    assert_eq!(capture.views[2].image, None, "absent");
    assert_eq!(capture.views[0].camera.pose.translation, DVec3::new(0.0, 0.0, 4.0));
    assert_eq!((capture.format, capture.file), (Format::Transforms, folder.path().join(FILE)));
    assert_eq!((capture.points.len(), capture.aabb_scale, capture.applied), (0, None, DAffine3::IDENTITY));
}

#[test]
fn poses_are_read_unchanged() {
    let turned = json!([[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0]]);
    let capture = good(|d| d["frames"][1]["transform_matrix"] = turned);
    let pose = capture.views[1].camera.pose;
    assert_eq!((pose.translation, pose.matrix3.x_axis), (DVec3::new(1.0, 2.0, 3.0), DVec3::Y));
    // instant-ngp's cube does not change the cameras.
    let other = good(|d| {
        (d["scale"], d["offset"], d["aabb"]) = (json!(0.5), json!([0.1, 0.2, 0.3]), json!([[0, 0, 0], [2, 2, 2]]));
    });
    assert_eq!(other.views[0].camera, good(|_| {}).views[0].camera);
}

#[test]
fn invalid_poses_are_named() {
    let bad = |value: Value, part: &str| {
        fails(|d| d["frames"][1]["transform_matrix"] = value, &["`frames[1].transform_matrix`: ", part]);
    };
    let with = |row: usize, column: usize, value: f64| {
        let mut pose = pose();
        pose[row][column] = json!(value);
        pose
    };
    for value in [json!("identity"), json!([[["deep"]]]), json!([[1, 0, 0, 0], [0, 1, 0, 0]]), json!([[1], [1], [1]])] {
        bad(value, "must be 3 or 4 rows of 4 numbers");
    }
    bad(with(0, 0, 1.01), "not orthonormal");
    bad(with(0, 1, 0.03), "not orthonormal to 1e-3: write more digits, or a rotation without scale and shear");
    bad(with(1, 1, 1e200), "not orthonormal");
    bad(with(2, 2, -1.0), "mirrors");
    bad(with(3, 3, 0.0), "the last row must be 0 0 0 1, is 0 0 0 0");
    bad(with(3, 1, 0.5), "the last row must be 0 0 0 1");
    bad(json!([[2, 0, 0, 0], [0, 0, -2, 0], [0, 2, 0, 4]]), "but scales by 2.000000: divide");
    bad(json!([[0, 0, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]]), "not orthonormal");
    bad(json!([[1, 0, 0, "x"], [0, 1, 0, 0], [0, 0, 1, 0]]), "row 0, column 3 is not a finite number: \"x\"");
    for value in ["NaN", "Infinity", "-Infinity"] {
        let folder = folder(|_| {});
        let text = document().to_string();
        std::fs::write(folder.path().join(FILE), text.replacen("4.0", value, 1)).unwrap();
        let capture = read(folder.path()).unwrap();
        assert_eq!((capture.views.len(), capture.views[0].name.as_str()), (2, "images/1.png"));
        let what = format!("row 2, column 3 is not a finite number: \"{value}\"");
        let expected = format!(
            "left out 1 of 3 frames without a usable camera, such as `images/0.png`: `frames[0].transform_matrix`: {what}"
        );
        assert_eq!(capture.assumptions, [expected]);
        // Most frames must be whole.
        std::fs::write(folder.path().join(FILE), text.replacen("4.0", value, 2)).unwrap();
        says(&failure(read(folder.path()), FILE), &["`frames[0].transform_matrix`", &what]);
    }
    assert!(
        good(|d| d["frames"][1]["transform_matrix"] = with(0, 1, 1e-4)).views[1].camera.pose.matrix3.y_axis.x == 1e-4
    );
}

#[test]
fn frames_without_a_pose_are_left_out() {
    let check = |capture: Capture, why: &str| {
        let expected =
            format!("left out 1 of 3 frames without a usable camera, such as `images/1.png`: `frames[1].{why}");
        assert_eq!((capture.views.len(), capture.assumptions.len()), (2, 1));
        assert!(capture.assumptions[0].starts_with(&expected), "{:?}", capture.assumptions);
    };
    for value in [json!(null), json!([]), json!(([[0; 4]; 4])), json!(([[(); 4]; 4])), json!(([0; 16]))] {
        let set = |d: &mut Value| d["frames"][1]["transform_matrix"] = value;
        check(good(set), "transform_matrix`: ");
    }
    check(good(|d| remove(&mut d["frames"][1], "transform_matrix")), "transform_matrix`: is missing");
    for (field, value, why) in [
        ("fl_x", json!("NaN"), "fl_x`: must be a finite number"),
        ("fl_x", json!(0), "fl_x`: must be above 0, is 0"),
        ("fl_y", json!(-800.5), "fl_y`: must be above 0, is -800.5"),
        ("cx", json!("Infinity"), "cx`: must be a finite number"),
        ("fx", json!(0), "fx`: must be above 0, is 0"),
        ("fy", json!("-12"), "fy`: must be above 0, is -12"),
        ("fx", json!("NaN"), "fx`: must be a finite number"),
        ("camera_angle_x", json!(0), "camera_angle_x`: must be above 0, is 0"),
        ("camera_angle_y", json!(-0.5), "camera_angle_y`: must be above 0, is -0.5"),
        ("K", json!([[0, 0, 4], [0, 9, 3], [0, 0, 1]]), "K`: must have focal lengths above 0, is [[0,0,4]"),
        ("intrinsics", json!([9, 0, 4, 3]), "intrinsics`: must have focal lengths above 0, is [9,0,4,3]"),
        ("camera_matrix", json!(([[0; 3]; 3])), "camera_matrix`: must have focal lengths above 0"),
        (
            "intrinsics",
            json!([[9, 0, 4, 0], [0, -9, 3, 0], [0, 0, 1, 0]]),
            "intrinsics`: must have focal lengths above",
        ),
        ("K", json!([[9, 0, "NaN"], [0, 9, 3], [0, 0, 1]]), "K`: must have finite numbers"),
        ("K", json!({ "fx": 9, "fy": null, "cx": 4, "cy": 3 }), "K`: must have finite numbers"),
    ] {
        check(good(|d| d["frames"][1][field] = value), why);
    }
    // Lengths that do not count.
    let matrix = json!([[9, 0, 4], [0, 9, 3], [0, 0, 1]]);
    for fields in [
        json!({ "fl_x": 12, "fx": 0 }),
        json!({ "fl_x": 12, "fy": 0 }),
        json!({ "fl_x": 12, "camera_angle_x": 0 }),
        json!({ "fl_y": 12, "camera_angle_y": 0 }),
        json!({ "K": matrix, "fx": 0 }),
        json!({ "K": matrix, "camera_angle_x": 0 }),
        json!({ "K": matrix, "cam_K": ([[0; 3]; 3]) }),
        json!({ "camera_model": "EQUIRECTANGULAR", "fl_x": 4, "fx": 0, "K": ([[0; 3]; 3]) }),
    ] {
        let with = |d: &mut Value| d["frames"][1].as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
        assert_eq!(good(with).views.len(), 3, "{fields}");
    }
    // Most frames must have one, and other values are mistakes.
    let most = |field: &'static str, value: Value| {
        move |d: &mut Value| (1..3).for_each(|i| d["frames"][i][field] = value.clone())
    };
    fails(most("transform_matrix", json!(null)), &["`frames[1].transform_matrix`: is missing"]);
    fails(most("fl_x", json!("NaN")), &["`frames[1].fl_x`: must be a finite number"]);
    fails(most("fl_x", json!(0)), &["`frames[1].fl_x`: must be above 0, is 0"]);
    fails(most("camera_angle_x", json!(0)), &["`frames[1].camera_angle_x`: must be above 0, is 0"]);
    fails(most("K", json!(([[0; 3]; 3]))), &["`frames[1].K`: must have focal lengths above 0, is [[0,0,0],"]);
    fails(
        |d| d["frames"][1]["camera_angle_x"] = json!(4),
        &["`frames[1].camera_angle_x`: must be an angle in radians"],
    );
    let skewed = json!([[9, 1, 4], [0, 9, 3], [0, 0, 1]]);
    fails(|d| d["frames"][1]["K"] = skewed, &["`frames[1].K`: must have the rows fx 0 cx"]);
    fails(|d| d["frames"][1]["fl_x"] = json!("wide"), &["`frames[1].fl_x`: must be a finite number"]);
}

#[test]
fn rounded_rotations_become_the_nearest() {
    let exact = DMat3::from_rotation_x(0.3) * DMat3::from_rotation_y(0.7);
    let with = |digits: f64| {
        let m = exact.to_cols_array_2d();
        let row = |r: usize| json!([m[0][r], m[1][r], m[2][r], 1.0]).as_array().unwrap().clone();
        let rounded = |x: &Value| json!((x.as_f64().unwrap() * digits).round() / digits);
        let rows: Vec<Vec<Value>> = (0..3).map(|r| row(r).iter().map(rounded).collect()).collect();
        move |d: &mut Value| (0..2).for_each(|i| d["frames"][i]["transform_matrix"] = json!(rows))
    };
    let capture = good(with(100.0));
    let [pose, other] = [0, 2].map(|i| capture.views[i].camera.pose);
    assert!(rigid::pose(&pose).is_ok() && pose.matrix3.abs_diff_eq(exact, 0.01));
    assert!((pose.matrix3.transpose() * pose.matrix3).abs_diff_eq(DMat3::IDENTITY, 1e-12));
    assert_eq!((pose.translation, other.matrix3), (DVec3::ONE, DMat3::IDENTITY));
    // The nearest rotation to a rotation times a symmetric matrix close to 1 is the rotation.
    let symmetric = DMat3::from_cols_array(&[1.003, 0.002, -0.001, 0.002, 0.998, 0.004, -0.001, 0.004, 1.001]);
    let mut stretched = DAffine3::from_mat3(exact * symmetric);
    assert!(matrix::straighten(&mut stretched) && stretched.matrix3.abs_diff_eq(exact, 1e-12));
    let note = "`frames[0].transform_matrix` is a rotation with rounding errors: used the nearest rotation, and 1 more \
                likewise";
    assert_eq!(capture.assumptions, [note]);
    assert_eq!(good(with(1e5)).assumptions, [""; 0]);
    fails(with(10.0), &["`frames[0].transform_matrix`", "not orthonormal", "write more digits"]);
}

#[test]
fn an_image_has_one_pose() {
    let twice = |z: f64| {
        move |d: &mut Value| {
            d["frames"][2] = d["frames"][0].clone();
            d["frames"][2]["transform_matrix"][2][3] = json!(z);
        }
    };
    assert_eq!(good(twice(4.0)).views.len(), 3);
    assert_eq!(good(twice(4.0 + 1e-9)).views.len(), 3, "rounded");
    fails(twice(4.0001), &["`frames[2]`: has another pose"]);
    fails(twice(5.0), &["`frames[2]`: has another pose for the image of frames[0], `images/0.png`: remove one"]);
}

#[test]
fn web_addresses_and_blanks_in_paths_are_read() {
    let capture = |paths: [&str; 3]| {
        let folder = folder(|d| (0..3).for_each(|i| d["frames"][i]["file_path"] = json!(paths[i])));
        std::fs::rename(folder.path().join("images/0.png"), folder.path().join("images/my shot.png")).unwrap();
        picture(&folder.path().join("images/100%25.png"), 8, 6);
        let capture = read(folder.path()).unwrap();
        let name = |view: &View| Some(view.image.as_ref()?.file_name()?.to_str()?.to_owned());
        (capture.views.iter().map(name).collect::<Vec<_>>(), capture.assumptions)
    };
    let found = |names: [&str; 3]| names.map(|name| (!name.is_empty()).then(|| name.to_owned())).to_vec();
    let (images, notes) = capture(["images/my%20shot.png", "https://host/a/images/1.png?v=1", "images/100%25.png"]);
    assert_eq!(images, found(["my shot.png", "1.png", "100%25.png"]));
    let note = "`images/my%20shot.png` does not exist: used `images/my shot.png`, and 1 more likewise";
    assert_eq!(notes, [note]);
    // A file of the listed name counts, also in another folder.
    let (images, notes) = capture(["images/my shot.png ", "C:\\data\\100%25.png", "images/my%20shot2.png"]);
    assert_eq!((images, notes.len()), (found(["my shot.png", "100%25.png", ""]), 2));
}

#[test]
fn fields_that_training_does_not_use_are_ignored_if_they_are_wrong() {
    for (field, value, what) in [
        ("aabb_scale", json!(-4), "must be above 0, is -4"),
        ("aabb_scale", json!([4]), "must be a finite number, is [4]"),
        ("aabb_scale", json!("auto"), "must be a finite number"),
        ("applied_scale", json!(0), "must be above 0"),
        ("applied_transform", json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]]), "must be 3 or 4 rows"),
        ("applied_transform", json!(([["NaN"; 4]; 3])), "row 0, column 0 is not a finite number"),
        ("applied_transform", json!([[1, 0, 0, 0], [0, 0, 0, 0], [0, -1, 0, 0]]), "must be invertible"),
        ("ply_file_path", json!(false), "must be a string"),
    ] {
        let Capture { assumptions, .. } = good(|d| d[field] = value);
        let expected = format!("ignored `{field}`: {what}");
        assert!(matches!(&assumptions[..], [note] if note.starts_with(&expected)), "{assumptions:?}");
    }
    let of_frames = good(|d| (0..3).for_each(|i| d["frames"][i]["sharpness"] = json!("NaN")));
    let expected = "ignored `frames[0].sharpness`: must be a finite number, is \"NaN\", and 2 more likewise";
    assert_eq!(of_frames.assumptions, [expected]);
    let absent = good(|d| {
        (d["ply_file_path"], d["depth_unit_scale_factor"]) = (json!(""), json!(0));
        (d["frames"][0]["mask_path"], d["frames"][0]["depth_file_path"]) = (json!(""), json!(" "));
    });
    assert_eq!((&absent.views[0].mask, &absent.views[0].depth, absent.points.len()), (&None, &None, 0));
    assert_eq!(absent.assumptions, [""; 0]);
}

#[test]
fn invalid_documents_are_located() {
    let of = |text: &str| {
        let folder = folder(|_| {});
        std::fs::write(folder.path().join(FILE), text).unwrap();
        failure(read(folder.path()), FILE)
    };
    says(&of("{\n  \"frames\": [}\n"), &["is not valid JSON", "line 2 column 14"]);
    says(&of(""), &["is not valid JSON"]);
    says(&of("[]"), &["must be an object"]);
    says(&failure(read(tempfile::tempdir().unwrap().path()), FILE), &["cannot be read"]);
    fails(|d| remove(d, "frames"), &["`frames`: is missing"]);
    fails(|d| d["frames"] = json!([]), &["`frames`: is empty"]);
    fails(|d| d["frames"] = json!({}), &["`frames`: must be a list"]);
    fails(|d| d["frames"][1] = json!(7), &["`frames[1]`: must be an object, is 7"]);
    fails(
        |d| remove(&mut d["frames"][1], "file_path"),
        &["`frames[1].file_path`: is missing beside \"transform_matrix\""],
    );
    let renamed = |d: &mut Value| {
        (d["frames"][1]["file"], d["frames"][1]["c2w"]) = (json!("images/1.png"), json!(0));
        remove(&mut d["frames"][1], "file_path");
    };
    fails(renamed, &["`frames[1].file_path`: is missing beside \"c2w\", \"file\", \"transform_matrix\""]);
    fails(|d| d["frames"][1]["file_path"] = json!(3), &["`frames[1].file_path`: must be a string"]);
}

#[test]
fn images_are_found_by_all_path_styles() {
    for path in ["images/0.png", "./images/0.png", ".\\images\\0.png", "images/0", "images/0.PNG"] {
        let folder = folder(|d| d["frames"][0]["file_path"] = json!(path));
        let view = &read(folder.path()).unwrap().views[0];
        assert_eq!(view.image, Some(folder.path().join("images/0.png")), "{path}");
        assert!(view.name.starts_with("images/0"));
    }
    let (elsewhere, folder) = (folder(|_| {}), folder(|_| {}));
    let mut document = document();
    let path = elsewhere.path().join("images/1.png");
    document["frames"][0]["file_path"] = json!(path);
    std::fs::write(folder.path().join(FILE), document.to_string()).unwrap();
    assert_eq!(read(folder.path()).unwrap().views[0].image, Some(path));
}

#[test]
fn masks_depths_and_sharpness_are_read() {
    let folder = folder(|d| {
        let own = json!({ "mask_path": "masks/0.png", "depth_file_path": "depth/0.png", "sharpness": 31.5 });
        d["frames"][0].as_object_mut().unwrap().extend(own.as_object().unwrap().clone());
        d["frames"][1]["depth_file_path"] = json!(".\\depth\\1.npy");
        // A mask of an absent image.
        d["frames"][2]["mask_path"] = json!("masks/2.png");
    });
    let at = |name: &str| folder.path().join(name);
    says(&failure(read(folder.path()), FILE), &["`frames[0].mask_path`: there is no file masks/0.png"]);
    picture(&at("masks/0.png"), 8, 6);
    // Training without depths does not need them.
    let capture = read(folder.path()).unwrap();
    assert!(capture.views.iter().all(|view| view.depth.is_none()));
    let expected = "2 of 2 depth files do not exist, such as `depth/0.png`: left them out";
    assert!(capture.assumptions.iter().any(|what| what == expected), "{:?}", capture.assumptions);
    picture(&at("depth/0.png"), 8, 6);
    std::fs::write(at("depth/1.npy"), b"").unwrap();
    let views = read(folder.path()).unwrap().views;
    assert_eq!((views[0].mask.clone(), views[0].sharpness), (Some(at("masks/0.png")), Some(31.5)));
    assert_eq!(views[0].depth, Some((at("depth/0.png"), 1e-3)));
    assert_eq!(views[1].depth, Some((at("depth/1.npy"), 1.0)));
    assert_eq!((views[1].mask.clone(), views[2].mask.clone(), views[1].sharpness), (None, None, None));
    let with = |name: &str, value: Value| {
        let mut document: Value = serde_json::from_slice(&std::fs::read(at(FILE)).unwrap()).unwrap();
        document[name] = value;
        document["frames"][2]["depth_path"] = json!("depth/0.png");
        document["integer_depth_scale"] = json!(0.02);
        let text = document.to_string();
        let other = tempfile::tempdir_in(folder.path()).unwrap();
        std::fs::write(other.path().join(FILE), text.replace("masks/", "../masks/").replace("depth/", "../depth/"))
            .unwrap();
        let text = std::fs::read_to_string(other.path().join(FILE)).unwrap().replace("images/", "../images/");
        std::fs::write(other.path().join(FILE), text.replace(".\\\\depth\\\\", "../depth/")).unwrap();
        read(other.path())
            .map(|capture| capture.views.iter().map(|v| v.depth.as_ref().map(|d| d.1)).collect::<Vec<_>>())
    };
    let units = |name, value| with(name, value).unwrap();
    assert_eq!(units("depth_unit_scale_factor", json!(0.25)), [Some(0.25), Some(0.25), Some(0.02)]);
    assert_eq!(units("enable_depth_loading", json!(false)), [Some(1e-3), Some(1.0), None]);
    let message = with("depth_unit_scale_factor", json!(0)).unwrap_err().to_string();
    says(&message, &["`depth_unit_scale_factor`: must be above 0, is 0"]);
}

#[test]
fn masks_beside_frames_without_masks_are_used() {
    let folder = folder(|_| {});
    let at = |name: &str| folder.path().join(name);
    picture(&at("masks/0.png"), 8, 6);
    picture(&at("masks/images/1.png"), 8, 6);
    let capture = read(folder.path()).unwrap();
    let masks: Vec<_> = capture.views.iter().map(|view| view.mask.clone()).collect();
    assert_eq!(masks, [Some(at("masks/0.png")), Some(at("masks/images/1.png")), None]);
    let note = "no frame lists a mask: used those beside them, such as `masks/0.png` (white is used)";
    assert_eq!(capture.assumptions, [note]);
    // A single listed mask states which are used.
    let mut document = document();
    document["frames"][1]["mask_path"] = json!("masks/0.png");
    std::fs::write(at(FILE), document.to_string()).unwrap();
    let capture = read(folder.path()).unwrap();
    let masks: Vec<_> = capture.views.iter().map(|view| view.mask.clone()).collect();
    assert_eq!(masks, [None, Some(at("masks/0.png")), None]);
    assert_eq!(capture.assumptions, ["1 of 2 images have a `mask_path`; 1 have no mask, and use all pixels"]);
}

#[test]
fn depth_images_of_8_bits_need_a_unit() {
    let folder = folder(|d| d["frames"][0]["depth_file_path"] = json!("depth/0.png"));
    let path = folder.path().join("depth/0.png");
    picture(&path, 8, 6);
    let expected = "depth images have 8 bits, such as `depth/0.png`: in units of 0.001, no depth exceeds 0.255; check \
                    `depth_unit_scale_factor`";
    assert_eq!(read(folder.path()).unwrap().assumptions, [expected]);
    let file = folder.path().join(FILE);
    let plain = std::fs::read_to_string(&file).unwrap();
    let mut document: Value = serde_json::from_str(&plain).unwrap();
    document["depth_unit_scale_factor"] = json!(0.02);
    std::fs::write(&file, document.to_string()).unwrap();
    assert!(read(folder.path()).unwrap().assumptions.is_empty());
    std::fs::write(file, plain).unwrap();
    image::ImageBuffer::<image::Luma<u16>, _>::new(8, 6).save(path).unwrap();
    assert!(read(folder.path()).unwrap().assumptions.is_empty());
}

#[test]
fn lists_of_names_are_splits() {
    let splits = |change: fn(&mut Value)| good(change).views.iter().map(|view| view.split).collect::<Vec<_>>();
    assert_eq!(splits(|_| {}), [None; 3]);
    let [train, val, test] = Split::ALL.map(Some);
    let all = splits(|d| {
        d["train_filenames"] = json!(["images/0.png"]);
        d["val_filenames"] = json!([".\\images\\1.png"]);
        d["test_filenames"] = json!(["./images/2.png"]);
    });
    assert_eq!(all, [train, val, test]);
    let both = splits(|d| {
        d["train_filenames"] = json!(["images/2.png"]);
        d["val_filenames"] = json!(["images/1.png"]);
        d["test_filenames"] = json!(["images/1.png"]);
    });
    assert_eq!(both, [None, test, train]);
    fails(|d| d["val_filenames"] = json!("images/0.png"), &["`val_filenames`: must be a list"]);
    fails(|d| d["val_filenames"] = json!([7]), &["`val_filenames[0]`: must be a string"]);
    fails(
        |d| d["test_filenames"] = json!(["images/0.png", "7.png"]),
        &["`test_filenames[1]`: lists 7.png, but no frame has this file_path"],
    );
    let twice = |d: &mut Value| {
        d["train_filenames"] = json!(["images/0.png"]);
        d["test_filenames"] = json!(["images/0.png"]);
    };
    fails(twice, &["`test_filenames[0]`: lists images/0.png, which train_filenames has too"]);
}

#[test]
fn lists_name_frames_that_were_left_out_beside_others() {
    let splits = |change: fn(&mut Value)| {
        let capture = read(folder(change).path()).unwrap();
        capture.views.iter().map(|view| (view.name.clone(), view.split)).collect::<Vec<_>>()
    };
    // A second frame of an image has no pose.
    let found = splits(|d| {
        let mut again = d["frames"][1].clone();
        remove(&mut again, "transform_matrix");
        d["frames"].as_array_mut().unwrap().push(again);
        d["test_filenames"] = json!(["images/1.png"]);
    });
    assert!(found.contains(&("images/1.png".into(), Some(Split::Test))), "{found:?}");
    // A name that fits a frame and one that was left out.
    let change = |name: &'static str| {
        move |d: &mut Value| {
            d["frames"][1]["file_path"] = json!("other/0.png");
            remove(&mut d["frames"][1], "transform_matrix");
            d["test_filenames"] = json!([name]);
        }
    };
    fails(change("0.png"), &["`test_filenames[0]`: lists 0.png, which fits `images/0.png` and `other/0.png`"]);
    assert!(good(change("other/0.png")).views.iter().all(|view| view.split.is_none()));
}

#[test]
fn lists_name_frames_by_an_end_of_their_path() {
    let splits = |names: [&str; 2]| {
        let capture = good(|d| (d["train_filenames"], d["test_filenames"]) = (json!(names), json!(["images/2.png"])));
        (capture.views.iter().map(|view| view.split).collect::<Vec<_>>(), capture.assumptions)
    };
    let expected = vec![Some(Split::Train), Some(Split::Train), Some(Split::Test)];
    assert_eq!(splits(["images/0.png", "images/1.png"]), (expected.clone(), vec![]));
    for names in [["0.png", "1.png"], ["0", "images/1"], ["/data/x/images/0.png", "IMAGES/1.JPG"]] {
        let (found, notes) = splits(names);
        assert_eq!(found, expected, "{names:?}");
        let note = format!("`train_filenames[0]` lists {}, which no frame has: used `images/0.png`", names[0]);
        assert_eq!(notes, [note + ", and 1 more likewise"]);
    }
    let list = |name: &'static str| move |d: &mut Value| d["test_filenames"] = json!([name]);
    for other in ["test/0.png", "10.png", "0.png.png"] {
        fails(list(other), &["`test_filenames[0]`: lists ", "but no frame has this file_path"]);
    }
    let two = |d: &mut Value| {
        d["frames"][1]["file_path"] = json!("other/0.png");
        d["test_filenames"] = json!(["0.png"]);
    };
    fails(two, &["lists 0.png, which fits `images/0.png` and `other/0.png`: write more of the path"]);
}

#[test]
fn applied_transform_includes_its_scale() {
    let applied =
        |fields: Value| good(|d| d.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone())).applied;
    // nerfstudio's matrix from COLMAP's axes.
    let three = json!([[1, 0, 0, 0.5], [0, 0, 1, 0], [0, -1, 0, 0]]);
    let mut four = three.clone();
    four.as_array_mut().unwrap().push(json!([0, 0, 0, 1]));
    for transform in [three, four] {
        let once = applied(json!({ "applied_transform": transform }));
        assert_eq!(once.transform_point3(DVec3::new(1.0, 2.0, 3.0)), DVec3::new(1.5, 3.0, -2.0));
        let scaled = applied(json!({ "applied_transform": transform, "applied_scale": 2.0 }));
        assert_eq!(scaled.transform_point3(DVec3::new(1.0, 2.0, 3.0)), DVec3::new(3.0, 6.0, -4.0));
    }
    assert_eq!(applied(json!({ "applied_scale": 4 })), DAffine3::from_scale(DVec3::splat(4.0)));
}

#[test]
fn aabb_scale_is_read_other_fields_are_ignored() {
    assert_eq!(good(|d| d["aabb_scale"] = json!(4)).aabb_scale, Some(4.0));
    let harmless = json!({ "n_frames": 2, "up": [0, 0, 1], "white_transparent": true, "orientation_override": "none",
        "auto_scale_poses_override": false, "colmap_im_id": 3, "sharpness_discard_threshold": 1, "rotation": 0.1,
        "from_na": false, "coordinate_system": "opengl", "ply_file_path": "absent.ply", "anything": { "else": [1] } });
    let capture = good(|d| {
        d.as_object_mut().unwrap().extend(harmless.as_object().unwrap().clone());
        d["frames"][0]["colmap_im_id"] = json!(17);
    });
    assert_eq!(
        capture.views.iter().map(|v| &v.camera).collect::<Vec<_>>(),
        good(|_| {}).views.iter().map(|v| &v.camera).collect::<Vec<_>>()
    );
    assert_eq!((capture.points, capture.points_file), (vec![], None));
    assert_eq!(capture.assumptions, ["left out the points of `absent.ply`: there is no such file"]);
}

#[test]
fn other_conventions_that_the_file_states_are_errors() {
    for (name, value, what) in [
        ("from_na", json!(true), "axes of OpenCV (NeuS2): negate the second and the third column"),
        ("frame_convention", json!("OpenCV"), "OpenGL's axes (y up, looking along -z)"),
        ("coordinate_system", json!("colmap"), "convert them, and remove it"),
        ("pose_type", json!("w2c"), "camera-to-world"),
        ("fisheye", json!(true), "write camera_model OPENCV_FISHEYE"),
    ] {
        fails(|d| d[name] = value.clone(), &[&format!("`{name}`: is "), what]);
        fails(|d| d["frames"][1][name] = value, &[&format!("`frames[1].{name}`: is "), what]);
    }
    good(|d| (d["frame_convention"], d["pose_type"], d["fisheye"]) = (json!("opengl"), json!("c2w"), json!(false)));
    good(|d| (d["fisheye"], d["camera_model"]) = (json!(true), json!("OPENCV_FISHEYE")));
}

#[test]
fn one_scale_of_all_rotations_is_divided_out() {
    let scaled = |scales: [f64; 3]| {
        move |d: &mut Value| {
            for (i, scale) in scales.into_iter().enumerate() {
                for (r, c) in (0..9).map(|k| (k / 3, k % 3)) {
                    let entry = &mut d["frames"][i]["transform_matrix"][r][c];
                    *entry = json!(scale * entry.as_f64().unwrap());
                }
            }
        }
    };
    let poses = |capture: &Capture| capture.views.iter().map(|view| view.camera.pose).collect::<Vec<_>>();
    let (plain, halves) = (good(|_| {}), good(scaled([0.5; 3])));
    for (a, b) in poses(&plain).iter().zip(poses(&halves)) {
        assert!(a.abs_diff_eq(b, 1e-12), "{a:?} {b:?}");
    }
    let note = "all rotations scale by 0.500000: divided them by it, and left the positions as they are";
    assert_eq!(halves.assumptions, [note]);
    fails(scaled([0.5, 0.5, 1.0]), &["`frames[0].transform_matrix`", "but scales by 0.500000"]);
    fails(scaled([0.5, 0.4, 0.5]), &["but scales by 0.500000"]);
}

#[test]
fn frames_that_are_marked_as_bad_are_left_out() {
    let capture = good(|d| (d["frames"][0]["is_bad"], d["frames"][1]["is_bad"]) = (json!(true), json!(false)));
    assert_eq!(capture.views.len(), 2);
    assert_eq!(capture.assumptions, ["left out 1 of 3 frames that `is_bad` marks, such as `images/0.png`"]);
}

#[test]
fn principal_points_in_other_units_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    picture(&folder.path().join("images/0.png"), 64, 48);
    picture(&folder.path().join("images/1.png"), 64, 48);
    let read_with = |change: &dyn Fn(&mut Value)| {
        let mut document = document();
        for name in ["w", "h", "cx", "cy", "fl_x", "fl_y"] {
            document.as_object_mut().unwrap().remove(name);
        }
        document["fl_x"] = json!(60);
        change(&mut document);
        std::fs::write(folder.path().join(FILE), document.to_string()).unwrap();
        read(folder.path()).map_err(|error| error.to_string())
    };
    let centre = |x: f64, y: f64| move |d: &mut Value| (d["cx"], d["cy"]) = (json!(x), json!(y));
    for (x, y, what) in [
        (64.0, 48.0, "the middle of 128x96 pixels, but frames[0] has 64x48: give `w` and `h` of the larger image"),
        (64.5, 47.6, "the middle of 128x96 pixels"),
        (0.5, 0.49, "in units of the image's sides: multiply them by 64 and 48"),
    ] {
        let message = read_with(&centre(x, y)).unwrap_err();
        assert!(message.contains("`cx`: and `cy` are ") && message.contains(what), "{message}");
    }
    for (x, y) in [(32.0, 24.0), (30.0, 1.0), (64.0, 30.0), (60.0, 46.0), (-0.5, 0.5)] {
        assert!(read_with(&centre(x, y)).is_ok(), "{x} {y}");
    }
    // With the size that it belongs to, and a frame's own.
    let sized = |d: &mut Value| {
        centre(64.0, 48.0)(d);
        (d["w"], d["h"]) = (json!(128), json!(96));
    };
    assert_eq!(read_with(&sized).unwrap().views[0].camera.centre, [64.0, 48.0]);
    let own = |d: &mut Value| (0..3).for_each(|i| centre(64.0, 48.0)(&mut d["frames"][i]));
    assert!(read_with(&own).is_ok());
}

#[test]
fn transforms_of_instant_ngps_fox_are_read() {
    let fox = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data/fox"));
    if !fox.is_dir() {
        skipped(&format!("there is no folder {}", fox.display()));
        return;
    }
    let capture = read(fox).unwrap();
    is_whole(&capture);
    assert_eq!((capture.views.len(), capture.aabb_scale), (67, Some(4.0)));
    assert_eq!(capture.views.iter().filter(|view| view.image.is_some()).count(), 50);
    let Camera { width, height, focal, centre, lens, .. } = capture.views[0].camera;
    assert_eq!((width, height, focal, centre), (1080, 1920, [1375.52, 1374.49], [554.558, 965.268]));
    let k = [0.0578421, -0.0805099, 0.0, 0.0, 0.0, 0.0];
    assert_eq!(lens, Lens::Brown { k, p: [-0.000980296, 0.00015575] });
    assert_eq!(capture.views[0].sharpness, Some(31.752987436300323));
    assert_eq!(capture.views[0].camera.pose.translation.x, 3.168359405609479);
}

#[test]
fn damaged_transforms_files_are_named() {
    let folder = folder(|d| {
        d["train_filenames"] = json!(["images/0.png"]);
        d["applied_transform"] = json!([[1, 0, 0, 0.5], [0, 0, 1, 0], [0, -1, 0, 0]]);
        (d["camera_model"], d["k1"], d["is_fisheye"]) = (json!("OPENCV"), json!(0.1), json!(false));
        (d["ply_file_path"], d["aabb_scale"]) = (json!("points.ply"), json!(4));
        d["frames"][0]["mask_path"] = json!("images/1.png");
        (d["frames"][1]["fl_x"], d["frames"][1]["camera_angle_y"]) = (json!(10), json!(0.8));
    });
    let point = Point { position: DVec3::new(0.1, 0.2, 0.3), color: [1, 2, 3], error: 0.5, views: 3 };
    let text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
        end_header\n0.5 1 2\n3 -4 5\n";
    let points = [ply::to_bytes(&[point; 3]), text.as_bytes().to_vec()];
    let files = [FILE, "points.ply", "points.ply"].map(|name| folder.path().join(name));
    let whole = [std::fs::read(&files[0]).unwrap(), points[0].clone(), points[1].clone()];
    std::fs::write(&files[1], &whole[1]).unwrap();
    assert_eq!(read(folder.path()).unwrap().points, [point; 3]);
    let config = ProptestConfig { cases: cases(), ..ProptestConfig::default() };
    proptest!(config, |(damage in damage::damage(), which in 0..3_usize)| {
        std::fs::write(&files[which], damage::damaged(&whole[which], &whole[0], &damage)).unwrap();
        let result = read(folder.path());
        std::fs::write(&files[which], &whole[which]).unwrap();
        match result {
            Ok(capture) => is_whole(&capture),
            Err(error) if which > 0 => panic!("damaged points are left out: {error}"),
            Err(error) => damage::clear(error, folder.path().to_str().unwrap()),
        }
    });
}

#[test]
fn matrices_may_be_flat_but_not_transposed_or_mirrored() {
    let poses = |matrix: &Value| good(|d| d["frames"][0]["transform_matrix"] = matrix.clone()).views[0].camera.pose;
    let rows = json!([[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0]]);
    let flat = json!([0.0, -1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 1.0, 3.0]);
    let mut long = flat.clone();
    long.as_array_mut().unwrap().extend([json!(0), json!(0), json!(0), json!(1)]);
    assert_eq!(poses(&flat), poses(&rows));
    assert_eq!(poses(&long), poses(&rows));
    let columns = json!([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]);
    let flat_columns = json!([0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 1, 2, 3, 1]);
    for matrix in [columns, flat_columns] {
        fails(
            |d| d["frames"][0]["transform_matrix"] = matrix,
            &["is transposed: its last column is 0 0 0 1 and its last row 1 2 3 1; write rows", "ARKit and three.js"],
        );
    }
    let mirrored = json!([[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, -1, 3]]);
    fails(|d| d["frames"][0]["transform_matrix"] = mirrored, &["left-handed axes, as in Unity and Unreal"]);
    for matrix in [json!([1, 2, 3]), json!([0, 0, 0, 0, 0]), json!([[1, 0, 0, 0], 0, 0, 0])] {
        fails(|d| d["frames"][0]["transform_matrix"] = matrix, &["must be 3 or 4 rows of 4 numbers"]);
    }
}

#[test]
fn utf16_gives_the_same_capture() {
    let folder = folder(|_| {});
    let plain = read(folder.path()).unwrap();
    let text = document().to_string();
    let bytes: Vec<u8> = [0xff, 0xfe].into_iter().chain(text.encode_utf16().flat_map(u16::to_le_bytes)).collect();
    std::fs::write(folder.path().join(FILE), bytes).unwrap();
    assert_eq!(read(folder.path()).unwrap(), plain);
}

#[test]
fn images_masks_and_depths_of_another_machine_are_found() {
    let moved = |path: &str| format!("C:\\captures\\scene\\{path}");
    let folder = folder(|d| {
        for (i, frame) in d["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
            frame["file_path"] = json!(moved(&format!("images\\{i}.jpg")));
            frame["mask_path"] = json!(moved(&format!("masks\\{i}.png")));
            frame["depth_file_path"] = json!(moved(&format!("depth\\{i}.png")));
        }
    });
    let at = |name: &str| folder.path().join(name);
    for name in ["masks/0.png", "masks/1.png", "depth/0.png", "depth/1.png"] {
        picture(&at(name), 8, 6);
    }
    let capture = read(folder.path()).unwrap();
    for (i, view) in capture.views[..2].iter().enumerate() {
        let files =
            [&view.image, &view.mask, &view.depth.clone().map(|(path, _)| path)].map(|file| file.clone().unwrap());
        assert_eq!(files, ["images", "masks", "depth"].map(|name| at(&format!("{name}/{i}.png"))));
    }
    assert_eq!(capture.views[2].image, None);
    let expected = "`C:/captures/scene/images/0.jpg` does not exist: used `images/0.png`, and 1 file likewise";
    // Images, masks, depths and the bits of the depths.
    assert_eq!((capture.assumptions.len(), capture.assumptions[0].as_str()), (4, expected));
    // Two images that fit.
    picture(&at("images/0.webp"), 8, 6);
    says(&failure(read(folder.path()), FILE), &["`frames[0].file_path`", "`images/0.png` and `images/0.webp` fit"]);
}

#[test]
fn downscaled_images_keep_the_scale_of_focal_lengths() {
    let folder = folder(|d| {
        remove(d, "w");
        remove(d, "h");
    });
    let camera = |folder: &Path| read(folder).unwrap().views[0].camera.clone();
    let plain = camera(folder.path());
    std::fs::remove_dir_all(folder.path().join("images")).unwrap();
    picture(&folder.path().join("images_2/0.png"), 4, 3);
    assert_eq!(camera(folder.path()), plain);
}

#[test]
fn half_of_the_frames_must_have_a_pose_and_lists_may_name_the_others() {
    let with = |count: usize, bad: usize| {
        let folder = folder(|d| {
            let names: Vec<String> = (0..count).map(|i| format!("images/{i}.png")).collect();
            d["frames"] = frames(&names.iter().map(String::as_str).collect::<Vec<_>>());
            (0..bad).for_each(|i| d["frames"][i]["transform_matrix"][0][3] = json!("nan"));
            d["train_filenames"] = json!(names);
        });
        read(folder.path())
    };
    assert_eq!(with(5, 2).unwrap().views.len(), 3);
    says(&failure(with(4, 2), FILE), &["`frames[0].transform_matrix`", "row 0, column 3 is not a finite number"]);
}

#[test]
fn masks_take_no_place_of_images() {
    let folder = folder(|d| {
        for (i, frame) in d["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
            frame["file_path"] = json!(format!("photos/{i}.jpg"));
            frame["mask_path"] = json!(format!("images/{i}.png"));
        }
    });
    let views = read(folder.path()).unwrap().views;
    assert!(views.iter().all(|view| view.image.is_none()));
    assert_eq!(views[0].mask, Some(folder.path().join("images/0.png")));
}

#[test]
fn frames_in_another_list_give_a_note() {
    let with = |list: Value| good(|d| d["test_frames"] = list).assumptions;
    let note = "the 2 frames of `test_frames` are not read, only those of `frames`";
    assert_eq!(with(frames(&["images/8.png", "images/9.png"])), [note]);
    assert_eq!([with(json!([])), with(json!(null))], [const { Vec::<String>::new() }; 2]);
}

#[test]
fn moving_scenes_give_notes() {
    let timed = |times: [f64; 3]| {
        let set = |d: &mut Value| (0..3).for_each(|i| d["frames"][i]["time"] = json!(times[i]));
        good(set).assumptions
    };
    assert_eq!(timed([0.5; 3]), [""; 0]);
    assert!(matches!(&timed([0.0, 0.0, 1.0])[..], [note] if note.contains("`time`") && note.contains("still scene")));
}

#[test]
fn dynamic_masks_beside_images_are_used_where_no_other_is_given() {
    let masked = |mask: bool| {
        let folder = folder(|d| {
            if mask {
                d["frames"][1]["mask_path"] = json!("images/dynamic_mask_1.png");
            }
        });
        for name in ["images/dynamic_mask_1.png", "images/dynamic_mask_2.png", "dynamic_mask_0.png"] {
            picture(&folder.path().join(name), 8, 6);
        }
        let capture = read(folder.path()).unwrap();
        let masks = capture.views.iter().map(|view| (view.mask.clone(), view.mask_is_dynamic));
        let expected = [None, Some(folder.path().join("images/dynamic_mask_1.png")), None];
        assert_eq!(masks.collect::<Vec<_>>(), expected.map(|path| (path.clone(), path.is_some() && !mask)));
        let again = tempfile::tempdir().unwrap();
        write(&capture, again.path()).unwrap();
        let written = std::fs::read_to_string(file(again.path())).unwrap();
        assert_eq!(written.contains("mask_path"), mask, "readers find dynamic masks beside the images");
        capture.assumptions
    };
    let expected = "1 of 2 images have a `mask_path`; 1 have no mask, and use all pixels";
    assert_eq!(masked(true), [expected], "masks that are named count as others do");
    let expected = "1 of 2 images have a dynamic mask of instant-ngp, such as `dynamic_mask_1.png`: used only its \
                    black pixels";
    assert_eq!(masked(false), [expected]);
}

#[test]
fn lens_models_of_different_cameras_are_written_at_the_top() {
    let mut capture = read(folder(|_| {}).path()).unwrap();
    let fisheye = Lens::Fisheye { k: [0.1, 0.0, 0.0, 0.0], p: [0.0; 2], s: [0.0; 2] };
    capture.views[1].camera.focal[0] *= 1.5;
    for (lenses, expected) in [
        ([fisheye, fisheye], [json!("OPENCV_FISHEYE"), json!(true)]),
        ([Lens::Pinhole, Lens::Pinhole], [json!("PINHOLE"), Value::Null]),
        ([Lens::Pinhole, fisheye], [Value::Null, Value::Null]),
    ] {
        capture.views.truncate(2);
        capture.views.iter_mut().zip(lenses).for_each(|(view, lens)| view.camera.lens = lens);
        let place = tempfile::tempdir().unwrap();
        write(&capture, place.path()).unwrap();
        let written: Value = serde_json::from_slice(&std::fs::read(file(place.path())).unwrap()).unwrap();
        assert_eq!(["camera_model", "is_fisheye"].map(|name| written[name].clone()), expected);
        let own = &written["frames"][1]["is_fisheye"];
        assert_eq!(*own == json!(true), matches!(capture.views[1].camera.lens, Lens::Fisheye { .. }));
        assert!(written.get("fl_x").is_none() && written["frames"][1]["fl_x"].is_number());
        let again = read(place.path()).unwrap();
        let cameras = |capture: &Capture| capture.views.iter().map(|view| view.camera.clone()).collect::<Vec<_>>();
        assert_eq!(cameras(&again), cameras(&capture));
    }
}
