use serde_json::{Value, json};

use super::*;
use crate::dataset::load;

/// A camera 4 units up the z axis that looks down at the origin.
fn pose() -> Value {
    json!([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]])
}

fn document(names: &[&str]) -> Value {
    let frames: Vec<Value> =
        names.iter().map(|name| json!({ "file_path": name, "transform_matrix": pose() })).collect();
    json!({ "camera_angle_x": 0.8, "frames": frames })
}

fn picture(width: usize, height: usize) -> Image {
    let data = (0..width * height * 4).map(|i| (i % 256) as f32 / 255.0).collect();
    Image { width, height, channels: 4, data }
}

/// A folder with two good images of 8x6, `train/r_0.png` and `train/r_1.png`, and the given training split.
fn folder(transforms: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("train")).unwrap();
    for name in ["train/r_0.png", "train/r_1.png"] {
        picture(8, 6).save_png(folder.path().join(name)).unwrap();
    }
    std::fs::write(folder.path().join("transforms_train.json"), transforms).unwrap();
    folder
}

fn good() -> tempfile::TempDir {
    folder(&document(&["./train/r_0", "./train/r_1"]).to_string())
}

/// The one-line message with which loading fails; it names the transforms file.
fn failure(folder: &tempfile::TempDir) -> String {
    let message = load(folder.path(), Split::Train, 1).unwrap_err().to_string();
    assert!(message.contains("transforms_train.json: ") && !message.contains('\n'), "{message}");
    message
}

/// The failure after one change to a good document.
fn failure_after(change: impl FnOnce(&mut Value)) -> String {
    let mut document = document(&["./train/r_0", "./train/r_1"]);
    change(&mut document);
    failure(&folder(&document.to_string()))
}

#[track_caller]
fn says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "no `{part}` in: {message}");
    }
}

#[test]
fn loads_images_and_cameras() {
    let data = load(good().path(), Split::Train, 1).unwrap();
    assert_eq!(data.frames.len(), 2);
    assert_eq!(data.frames[1].name, "train/r_1");
    assert_eq!(data.frames[1].image, picture(8, 6));
    assert_eq!((data.near, data.far, data.has_alpha()), (2.0, 6.0, true));
    assert_eq!(data.bounds, [DVec3::splat(-1.5), DVec3::splat(1.5)]);
    assert!(data.skipped.is_empty());
    let camera = &data.frames[0].camera;
    assert_eq!(camera.focal, [4.0 / 0.4f64.tan(); 2]);
    let ray = camera.ray(4.0, 3.0);
    assert_eq!((ray.origin, ray.direction), (DVec3::new(0.0, 0.0, 4.0), DVec3::NEG_Z));
}

#[test]
fn downscaling_shrinks_image_and_camera_alike() {
    let folder = good();
    let full = load(folder.path(), Split::Train, 1).unwrap();
    let half = load(folder.path(), Split::Train, 2).unwrap();
    assert_eq!(half.frames[0].camera, full.frames[0].camera.resized(4, 3));
    assert_eq!(half.frames[0].image, picture(8, 6).downscaled(2));
    let message = load(folder.path(), Split::Train, 4).unwrap_err().to_string();
    assert_eq!(message, "`downscale`: 4 does not divide the image size 8x6");
}

#[test]
fn names_may_carry_their_extension() {
    let folder = folder(&document(&["train/r_0.png", "train/r_1.5", "train/../train/r_1"]).to_string());
    std::fs::copy(folder.path().join("train/r_0.png"), folder.path().join("train/r_1.5.png")).unwrap();
    let data = load(folder.path(), Split::Train, 1).unwrap();
    let names: Vec<&str> = data.frames.iter().map(|frame| frame.name.as_str()).collect();
    assert_eq!(names, ["train/r_0.png", "train/r_1.5", "train/../train/r_1"]);
}

#[test]
fn an_absent_image_is_skipped_and_reported() {
    let transforms = document(&["./train/r_7", "./train/r_1"]).to_string();
    let data = load(folder(&transforms).path(), Split::Train, 1).unwrap();
    assert_eq!((data.frames.len(), data.skipped), (1, vec!["train/r_7".to_owned()]));
    let message = failure(&folder(&document(&["./train/r_7", "./train/r_8"]).to_string()));
    says(&message, &["`frames`", "none of the images exists", "train/r_7"]);
}

#[test]
fn an_absent_split_is_named() {
    let message = load(good().path(), Split::Val, 1).unwrap_err().to_string();
    says(&message, &["transforms_val.json: cannot be read: "]);
}

#[test]
fn malformed_json_is_located() {
    says(&failure(&folder("{\n  \"frames\": [}\n")), &["is not valid JSON", "line 2 column 14"]);
    says(&failure(&folder("")), &["is not valid JSON", "line 1"]);
}

#[test]
fn a_bad_camera_angle_is_named() {
    let bad = |value: Value| failure_after(|d| d["camera_angle_x"] = value);
    for value in [json!(0), json!(-0.5), json!(3.2)] {
        says(&bad(value.clone()), &["`camera_angle_x`", "between 0 and pi", &format!("is {value}")]);
    }
    for value in [json!("wide"), json!(null)] {
        says(&bad(value), &["`camera_angle_x`", "is not a finite number"]);
    }
}

#[test]
fn missing_fields_are_named() {
    let remove = |object: &mut Value, name: &str| object.as_object_mut().unwrap().remove(name);
    for name in ["camera_angle_x", "frames"] {
        says(&failure_after(|d| drop(remove(d, name))), &[&format!("`{name}`: is missing")]);
    }
    for name in ["file_path", "transform_matrix"] {
        let message = failure_after(|d| drop(remove(&mut d["frames"][1], name)));
        says(&message, &[&format!("`frames[1].{name}`: is missing")]);
    }
    says(&failure(&folder("[]")), &["`camera_angle_x`: is missing"]);
}

#[test]
fn fields_of_another_type_are_named() {
    says(&failure_after(|d| d["frames"] = json!([])), &["`frames`: is empty"]);
    says(&failure_after(|d| d["frames"] = json!({})), &["`frames`: must be a list"]);
    says(&failure_after(|d| d["frames"][1]["file_path"] = json!(3)), &["`frames[1].file_path`: must be a string"]);
}

#[test]
fn a_pose_of_another_shape_is_named() {
    let bad = |value: Value| failure_after(|d| d["frames"][1]["transform_matrix"] = value);
    let mut short = pose();
    short.as_array_mut().unwrap().pop();
    let mut narrow = pose();
    narrow[2].as_array_mut().unwrap().pop();
    for value in [short, narrow, json!("identity"), json!([[["deep"]]])] {
        says(&bad(value), &["`frames[1].transform_matrix`", "must be 4 rows of 4 numbers"]);
    }
}

#[test]
fn a_pose_that_is_not_finite_is_named() {
    for value in ["NaN", "Infinity", "-Infinity", "null"] {
        let text = document(&["train/r_0"]).to_string().replacen("4.0", value, 1);
        let message = failure(&folder(&text));
        says(&message, &["`frames[0].transform_matrix`", "row 2, column 3 is not a finite number"]);
    }
}

#[test]
fn a_pose_that_is_not_rigid_is_named() {
    let bad = |row: usize, column: usize, value: f64| {
        let message = failure_after(|d| d["frames"][1]["transform_matrix"][row][column] = json!(value));
        says(&message, &["`frames[1].transform_matrix`"]);
        message
    };
    says(&bad(0, 0, 1.01), &["not orthonormal"]);
    says(&bad(0, 1, 0.01), &["not orthonormal"]);
    says(&bad(1, 1, 1e200), &["not orthonormal"]);
    says(&bad(2, 2, -1.0), &["mirrors"]);
    says(&bad(3, 3, 0.0), &["the last row must be 0 0 0 1, is 0 0 0 0"]);
    says(&bad(3, 1, 0.5), &["the last row must be 0 0 0 1"]);
}

#[test]
fn rounding_in_a_pose_is_accepted() {
    let mut transforms = document(&["train/r_0"]);
    transforms["frames"][0]["transform_matrix"][0][1] = json!(1e-4);
    assert!(load(folder(&transforms.to_string()).path(), Split::Train, 1).is_ok());
}

#[test]
fn an_image_of_another_size_is_named() {
    let folder = good();
    picture(6, 8).save_png(folder.path().join("train/r_1.png")).unwrap();
    says(&failure(&folder), &["`frames[1].file_path`", "r_1.png", "6x8 pixels", "8x6"]);
}

#[test]
fn an_image_that_cannot_be_decoded_is_named() {
    let folder = good();
    let path = folder.path().join("train/r_1.png");
    let whole = std::fs::read(&path).unwrap();
    // No image at all, and one whose header is whole.
    for bytes in [&b"not a picture"[..], &whole[..whole.len() / 2]] {
        std::fs::write(&path, bytes).unwrap();
        says(&failure(&folder), &["`frames[1].file_path`", "r_1.png: cannot be decoded"]);
    }
}

#[test]
fn the_lego_scene_loads() {
    let lego = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data/lego"));
    if !lego.is_dir() {
        println!("skipped: there is no {}", lego.display());
        return;
    }
    let data = load(lego, Split::Train, 4).unwrap();
    assert_eq!((data.frames.len(), data.skipped.len(), data.has_alpha()), (100, 0, true));
    for frame in &data.frames {
        assert_eq!((frame.image.width, frame.image.height), (100, 100));
        assert!(frame.image.data.iter().all(|value| (0.0..=1.0).contains(value)));
        assert!((frame.camera.pose.translation.length() - 4.0).abs() < 0.1);
        // Every camera looks at the scene: its middle ray passes through the box.
        let ray = frame.camera.ray(50.0, 50.0);
        assert!(ray.at(-ray.origin.dot(ray.direction)).length() < 0.5);
    }
}

#[test]
fn fields_that_would_change_the_picture_are_no_surprise() {
    let focal = 4.0 / 0.4_f64.tan();
    let neutral = [
        ("fl_x", json!(focal)),
        ("fl_y", json!(focal * 1.0005)),
        ("cx", json!(4)),
        ("cy", json!(2.5)),
        ("w", json!(8)),
        ("h", json!(6.0)),
        ("k1", json!(0)),
        ("k2", json!(null)),
        ("p2", json!(1e-17)),
        ("camera_model", json!("SIMPLE_RADIAL")),
        ("is_fisheye", json!(0)),
        // What sizes the boxes of other programs, and what Blender says of its sensor.
        ("aabb_scale", json!(4)),
        ("scale", json!(0.33)),
        ("offset", json!([0.5, 0.5, 0.5])),
        ("camera_angle_y", json!(0.4711)),
    ];
    let mut document = document(&["./train/r_0", "./train/r_1"]);
    for (name, value) in &neutral {
        document[name] = value.clone();
        document["frames"][1][name] = value.clone();
    }
    document["frames"][1]["camera_angle_x"] = json!(0.8);
    let plain = load(good().path(), Split::Train, 1).unwrap();
    assert_eq!(load(folder(&document.to_string()).path(), Split::Train, 1).unwrap(), plain);
    // Of images that were four times as large.
    for object in ["w", "h", "cx", "cy", "fl_x", "fl_y"] {
        document[object] = json!(4.0 * document[object].as_f64().unwrap());
    }
    document["cy"] = json!(11.5);
    assert_eq!(load(folder(&document.to_string()).path(), Split::Train, 1).unwrap(), plain);
    let others = [
        ("fl_x", json!(1.02 * focal), "must be 9.46089"),
        ("fl_y", json!(0.98 * focal), "must be 9.46089"),
        ("cx", json!(4.6), "must be 4"),
        ("cy", json!(3.6), "must be 3"),
        ("w", json!(16), "must be 8"),
        ("h", json!("6"), "must be 6"),
        ("k1", json!(1e-4), "must be 0"),
        ("k4", json!(-0.1), "must be 0"),
        ("p1", json!(0.01), "must be 0"),
        ("camera_model", json!("OPENCV_FISHEYE"), "must be PINHOLE"),
        ("is_fisheye", json!(true), "must be false"),
        ("latlong", json!(true), "must be false"),
        ("x_fov", json!(45.8), "must be absent"),
        ("rolling_shutter", json!([0, 0, 0, 1]), "must be zeros"),
    ];
    for (name, value, expected) in others {
        let message = failure_after(|document| document[name] = value.clone());
        says(&message, &[&format!("`{name}`"), expected, "images of 8x6", "not supported"]);
        let message = failure_after(|document| document["frames"][1][name] = value);
        says(&message, &[&format!("frames[1].{name}"), expected]);
    }
    let message = failure_after(|document| document["frames"][0]["camera_angle_x"] = json!(0.9));
    says(&message, &["frames[0].camera_angle_x", "must be 0.8"]);
}
