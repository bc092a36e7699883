//! `raygrad prepare` between formats keeps all rays.

use super::{CLASSIC, Place};
use raygrad::nerf::dataset::{Capture, Format, Photo, Split, View};
use raygrad::nerf::glam::{DMat3, DVec3};
use raygrad::nerf::{Camera, Image, Lens};
use raygrad_test_support::skip::skipped;
use serde_json::{Value, json};
use std::collections::HashSet;
use std::path::PathBuf;

/// The largest error of a ray after all conversions, in pixels.
const OFF: f64 = 1e-5;

/// The folder of instant-ngp's fox capture, if available.
fn fox() -> Option<PathBuf> {
    let here = || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data"));
    let fox = std::env::var_os("RAYGRAD_DATA").map_or_else(here, PathBuf::from).join("fox");
    let is_there = fox.join("transforms.json").is_file();
    if !is_there {
        skipped(&format!("there is no {}; RAYGRAD_DATA may say where the fox is", fox.display()));
    }
    is_there.then_some(fox)
}

/// Writes a dataset with a lens, a mask, images in two folders and an absent image to `scene`.
fn with_lens(place: &Place) {
    let mut frames = vec![];
    std::fs::create_dir_all(place.path("scene/images/more")).unwrap();
    std::fs::create_dir_all(place.path("scene/masks")).unwrap();
    for i in 0..10 {
        let name = format!("images/{}{i}.{}", if i > 7 { "more/" } else { "" }, if i > 4 { "png" } else { "jpg" });
        if i != 3 {
            let data = (0..48 * 32 * 3).map(|k| ((k * 7 + i) % 251) as f32 / 255.0).collect();
            let image = Photo::from(Image { width: 48, height: 32, channels: 3, data });
            image.save(place.path(&format!("scene/{name}"))).unwrap();
        }
        let angle = 0.6 * i as f64;
        let (sin, cos) = angle.sin_cos();
        let (third, two) = (1.0 / 3.0, (8.0_f64 / 9.0).sqrt());
        let matrix = json!([
            [-sin, -cos * third, cos * two, 3.0 * cos],
            [cos, -sin * third, sin * two, 3.0 * sin],
            [0.0, two, third, 1.0 + 0.1 * i as f64],
            [0.0, 0.0, 0.0, 1.0]
        ]);
        let mut frame = json!({ "file_path": name, "transform_matrix": matrix });
        if i == 1 {
            Image { data: vec![1.0; 48 * 32], ..Image::new(48, 32, 1) }
                .save_png(place.path("scene/masks/1.png"))
                .unwrap();
            frame["mask_path"] = "masks/1.png".into();
        }
        frames.push(frame);
    }
    let transforms = json!({
        "fl_x": 40.0 / 3.0 * 3.1, "fl_y": 41.7, "cx": 24.3, "cy": 15.1, "w": 48, "h": 32,
        "k1": 0.05 / 3.0, "k2": -0.02, "p1": 1e-3 / 3.0, "p2": -2e-3, "frames": frames
    });
    std::fs::write(place.path("scene/transforms.json"), transforms.to_string()).unwrap();
}

fn read(place: &Place, folder: &str) -> Capture {
    Capture::read(place.path(folder)).unwrap()
}

/// The views of a capture with the stems of their names, sorted.
fn by_name(capture: &Capture) -> Vec<(String, &View)> {
    let stem = |view: &View| {
        let inner = view.name.trim_start_matches("images/").replace('/', "_");
        inner.rsplit_once('.').map_or(inner.clone(), |(stem, _)| stem.to_owned())
    };
    let mut views: Vec<_> = capture.views.iter().map(|view| (stem(view), view)).collect();
    views.sort_by(|a, b| a.0.cmp(&b.0));
    views
}

/// Checks that two captures have the same images, and the same rays through their pixels.
#[track_caller]
fn same_rays(a: &Capture, b: &Capture, most: f64) {
    let (a, b) = (by_name(a), by_name(b));
    let names = |views: &[(String, &View)]| views.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
    assert_eq!(names(&a), names(&b));
    for ((name, one), (_, other)) in a.iter().zip(&b) {
        let (one, other) = (&one.camera, &other.camera);
        assert_eq!((one.width, one.height), (other.width, other.height), "{name}");
        for (x, y) in grid(one) {
            let (ray, again) = (one.ray(x, y), other.ray(x, y));
            let off = one.focal[0].max(one.focal[1]) * ray.direction.distance(again.direction);
            assert!(off < most, "{name} {x} {y}: {off} pixels");
            assert!(ray.origin.distance(again.origin) < 1e-9 * (1.0 + ray.origin.length()), "{name}");
        }
    }
}

/// Positions all over an image, including its corners.
fn grid(camera: &Camera) -> impl Iterator<Item = (f64, f64)> {
    let [w, h] = [camera.width as f64, camera.height as f64];
    (0..=6).flat_map(move |j| (0..=6).map(move |i| (w * f64::from(i) / 6.0, h * f64::from(j) / 6.0)))
}

/// Converts through all formats that support lenses, and back.
fn there_and_back(place: &Place, scene: &str, most: f64) {
    place.succeeds(&format!("prepare {scene} --to colmap-text --out text"));
    place.succeeds("prepare text --to colmap --out binary");
    place.succeeds("prepare binary --to nerfstudio --out back");
    let original = read(place, scene);
    for (folder, format) in [("text", Format::Colmap), ("binary", Format::Colmap), ("back", Format::Transforms)] {
        let capture = read(place, folder);
        assert_eq!(capture.format, format);
        same_rays(&original, &capture, most);
        let present = |capture: &Capture| capture.present().count();
        assert_eq!(present(&original), present(&capture), "{folder}");
    }
    assert!(place.path("text/sparse/0/cameras.txt").exists() && place.path("binary/sparse/0/cameras.bin").exists());
}

#[test]
fn lenses_and_poses_survive_every_format() {
    let place = Place::empty();
    with_lens(&place);
    there_and_back(&place, "scene", OFF);
    let back = read(&place, "back");
    assert_eq!(back.views.iter().filter(|view| view.mask.is_some()).count(), 1);
    for name in ["0.jpg", "7.png", "more/9.png"] {
        assert_eq!(place.bytes(&format!("scene/images/{name}")), place.bytes(&format!("back/images/{name}")), "{name}");
    }
    let original = read(&place, "scene");
    let splits = |capture: &Capture| by_name(capture).iter().map(|(_, view)| view.split).collect::<Vec<_>>();
    assert_eq!(splits(&original), splits(&back), "the same photographs are held out");
    let output = place.command("prepare scene --to colmap-text --out again").output().unwrap();
    let expected = "raygrad: note: 1 of 9 images have a `mask_path`; 8 have no mask, and use all pixels\n";
    assert_eq!(String::from_utf8(output.stderr).unwrap(), expected);
    assert_eq!(splits(&original), splits(&read(&place, "again")), "nerfstudio's lists");
    // A foreign dataset is trained on without conversion.
    place.succeeds(&format!("train back --scene-type bounded --steps 1 {CLASSIC}"));
}

#[test]
fn unsupported_formats_are_refused_before_writing() {
    let place = Place::empty();
    with_lens(&place);
    for format in ["blender", "llff"] {
        let output = place.command(&format!("prepare scene --to {format} --out made")).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        let expected = ["has lens distortion", "--undistort", "1 masks are not converted: the format has none"];
        assert!(output.status.code() == Some(1) && expected.iter().all(|part| said.contains(part)), "{said}");
    }
    // Without listed masks, those of this folder would be used.
    std::fs::remove_dir_all(place.path("scene/masks")).unwrap();
    // Two images whose names would collide in one folder.
    std::fs::copy(place.path("scene/images/7.png"), place.path("scene/images/more_9.png")).unwrap();
    let mut transforms = place.json("scene/transforms.json");
    transforms["frames"][0]["file_path"] = "images/more_9.png".into();
    transforms["frames"][1].as_object_mut().unwrap().remove("mask_path");
    std::fs::write(place.path("scene/transforms.json"), transforms.to_string()).unwrap();
    place.fails("prepare scene --to llff --undistort --out made", &["more_9.png", "would both become"]);
    // One image twice.
    let frame = transforms["frames"][0].clone();
    transforms["frames"].as_array_mut().unwrap().push(frame);
    std::fs::write(place.path("scene/transforms.json"), transforms.to_string()).unwrap();
    let twice = "lists `images/more_9.png` a second time: remove one of them";
    place.fails("prepare scene --to colmap --out made", &["`frames[", twice]);
    transforms["frames"].as_array_mut().unwrap().pop();
    std::fs::write(place.path("scene/transforms.json"), transforms.to_string()).unwrap();
    place.fails_with("prepare scene --to colmap --out scene", "scene: is not empty: choose another folder");
    std::fs::write(place.path("scene/images/5.png"), "no picture").unwrap();
    place.fails("prepare scene --to colmap --out made", &["`frames[5]`", "5.png: cannot be decoded"]);
    assert_eq!(std::fs::read_dir(place.path("")).unwrap().count(), 1, "nothing is left");
}

#[test]
fn cameras_without_any_image_give_a_warning() {
    let place = Place::empty();
    with_lens(&place);
    std::fs::remove_dir_all(place.path("scene/images")).unwrap();
    let output = place.command("prepare scene --to colmap --out made").output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    let warning = "warning: scene/transforms.json: no image exists, so only the cameras are converted";
    assert!(output.status.success() && said.contains(warning), "{said}");
    assert_eq!(read(&place, "made").views.len(), 10);
}

#[test]
fn blender_has_no_images_without_a_split() {
    let place = Place::empty();
    with_lens(&place);
    let file = place.path("scene/transforms.json");
    let mut transforms: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    transforms["train_filenames"] = json!(["images/1.jpg", "images/5.png", "images/6.png"]);
    transforms["test_filenames"] = json!(["images/7.png", "images/3.jpg"]);
    std::fs::write(file, transforms.to_string()).unwrap();
    let output = place.command("prepare scene --to blender --undistort --out made").output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{said}");
    let expected = [
        "note: 5 images are in no split, such as `images/0.jpg`: they are not used",
        "left out 5 images that are in no split",
        "warning: scene: 1 masks are not converted: the format has none",
    ];
    assert!(expected.iter().all(|part| said.contains(part)), "{said}");
    let made: Vec<_> = read(&place, "made").views.into_iter().map(|view| (view.name, view.split)).collect();
    let [train, test] = [Some(Split::Train), Some(Split::Test)];
    let names = [("train/1.jpg", train), ("train/5", train), ("train/6", train), ("test/7", test)];
    assert_eq!(made, names.map(|(name, split)| (name.to_owned(), split)));
}

#[test]
fn undistorted_images_fit_every_format() {
    let place = Place::empty();
    with_lens(&place);
    place.succeeds("prepare scene --undistort --out flat");
    let flat = read(&place, "flat");
    // The absent image is left out.
    assert_eq!((flat.format, flat.views.len(), flat.present().count()), (Format::Transforms, 9, 9));
    let original = read(&place, "scene");
    for (name, view) in by_name(&flat) {
        let camera = &view.camera;
        assert_eq!(camera.lens, Lens::Pinhole);
        assert_eq!(Photo::size_of_file(view.image.as_ref().unwrap()).unwrap()[0], [camera.width, camera.height]);
        let (_, before) = by_name(&original).into_iter().find(|(other, _)| *other == name).unwrap();
        assert_same_directions(camera, &before.camera);
        assert_eq!(view.mask.is_some(), before.mask.is_some());
    }
    // Pinhole cameras fit all formats, and nothing is resampled twice.
    std::fs::remove_dir_all(place.path("flat/masks")).unwrap();
    let mut transforms = place.json("flat/transforms.json");
    for frame in transforms["frames"].as_array_mut().unwrap() {
        frame.as_object_mut().unwrap().remove("mask_path");
    }
    std::fs::write(place.path("flat/transforms.json"), transforms.to_string()).unwrap();
    let flat = read(&place, "flat");
    for to in ["llff", "blender", "colmap", "nerfstudio"] {
        place.succeeds(&format!("prepare flat --to {to} --undistort --out {to}"));
    }
    for to in ["llff", "colmap", "nerfstudio"] {
        same_rays(&flat, &read(&place, to), OFF);
    }
    assert_eq!(place.bytes("flat/images/1.jpg"), place.bytes("llff/images/1.jpg"));
    let blender = read(&place, "blender");
    assert_eq!(blender.split(Split::Test).unwrap().len(), flat.split(Split::Test).unwrap().len());
    assert!(blender.views.iter().all(|view| view.image.is_some()));
    let llff = read(&place, "llff");
    assert!(llff.views.iter().all(|view| view.bounds.is_some_and(|[near, far]| near > 0.0 && near < 3.0 && far > 3.0)));
}

#[test]
fn differing_cameras_become_one_where_needed() {
    let place = Place::empty();
    with_lens(&place);
    // Without listed masks, those of this folder would be used.
    std::fs::remove_dir_all(place.path("scene/masks")).unwrap();
    let mut transforms = place.json("scene/transforms.json");
    for (i, frame) in transforms["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
        frame.as_object_mut().unwrap().remove("mask_path");
        if i % 2 == 0 {
            (frame["fl_x"], frame["fl_y"], frame["cx"]) = (50.0.into(), 50.5.into(), 22.0.into());
        }
    }
    std::fs::write(place.path("scene/transforms.json"), transforms.to_string()).unwrap();
    let original = read(&place, "scene");
    for (to, one) in [("llff", true), ("blender", true), ("colmap", false)] {
        place.succeeds(&format!("prepare scene --undistort --to {to} --out {to}"));
        let made = read(&place, to);
        let sizes = made.views.iter().map(|view| [view.camera.width, view.camera.height]);
        assert_eq!(sizes.collect::<HashSet<_>>().len() == 1, one, "{to}");
        if to == "blender" {
            // The names of this format contain the split.
            continue;
        }
        for (name, view) in by_name(&made) {
            let (_, before) = by_name(&original).into_iter().find(|(other, _)| *other == name).unwrap();
            let pose = before.camera.pose;
            assert!(view.camera.pose.abs_diff_eq(pose, 1e-9));
            assert_same_directions(&Camera { pose, ..view.camera.clone() }, &before.camera);
        }
    }
}

#[test]
fn cameras_are_written_for_the_size_that_images_have() {
    let place = Place::empty();
    with_lens(&place);
    // The images were downsized without a change of the file.
    for view in read(&place, "scene").present() {
        let path = view.image.as_ref().unwrap();
        Photo::open(path, None).unwrap().resized([24, 16]).save(path).unwrap();
    }
    place.succeeds("prepare scene --to nerfstudio --out made");
    let original = read(&place, "scene");
    for (name, view) in by_name(&read(&place, "made")).into_iter().filter(|(_, view)| view.image.is_some()) {
        assert_eq!([view.camera.width, view.camera.height], [24, 16]);
        let (_, before) = by_name(&original).into_iter().find(|(other, _)| *other == name).unwrap();
        let [one, other] = [view.camera.ray(6.0, 11.0), before.camera.ray(12.0, 22.0)];
        assert!(one.direction.distance(other.direction) < 1e-9, "{name}");
    }
}

/// Checks that each pixel of an undistorted camera shows the same direction of the original.
#[track_caller]
fn assert_same_directions(flat: &Camera, original: &Camera) {
    assert_eq!(flat.pose, original.pose);
    for (x, y) in grid(flat) {
        let [u, v] = original.pixel_of(flat.ray(x, y).at(2.0)).unwrap();
        let slack = 1e-3;
        let inside = (-slack..=original.width as f64 + slack).contains(&u)
            && (-slack..=original.height as f64 + slack).contains(&v);
        assert!(inside, "{x} {y} is empty: {u} {v}");
        let [x_back, y_back] = flat.pixel_of(original.ray(u, v).at(2.0)).unwrap();
        assert!((x_back - x).hypot(y_back - y) < OFF, "{x} {y}: {x_back} {y_back}");
    }
}

#[test]
fn points_give_bounds_and_are_converted() {
    let place = Place::empty();
    with_lens(&place);
    let points: String =
        (0..60).map(|i| format!("{} {} 0.0\n", 0.1 * f64::from(i % 8) - 0.4, 0.1 * f64::from(i / 8) - 0.4)).collect();
    let header =
        "ply\nformat ascii 1.0\nelement vertex 60\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    std::fs::write(place.path("scene/points.ply"), format!("{header}{points}")).unwrap();
    let mut transforms = place.json("scene/transforms.json");
    transforms["ply_file_path"] = "points.ply".into();
    std::fs::write(place.path("scene/transforms.json"), transforms.to_string()).unwrap();
    place.succeeds("prepare scene --to colmap --out sparse");
    assert_eq!(read(&place, "sparse").points.len(), 60);
    place.succeeds("prepare sparse --to llff --undistort --out llff");
    for view in &read(&place, "llff").views {
        let [near, far] = view.bounds.unwrap();
        // Cameras are about 3 to 4 away from points, which lie within 0.6 of the origin.
        assert!(near > 2.0 && far < 4.5 && far - near > 0.1, "{near} {far}");
    }
}

/// Replaces the rotation of a matrix by the nearest exact one, with Newton's method.
fn make_rigid(matrix: &mut Value) {
    let at = |r: usize, c: usize| matrix[r][c].as_f64().unwrap();
    let column = |c: usize| DVec3::new(at(0, c), at(1, c), at(2, c));
    let mut rotation = DMat3::from_cols(column(0), column(1), column(2));
    for _ in 0..5 {
        rotation = rotation * (DMat3::IDENTITY * 3.0 - rotation.transpose() * rotation) * 0.5;
    }
    for (r, c) in (0..9).map(|i| (i / 3, i % 3)) {
        matrix[r][c] = rotation.col(c)[r].into();
    }
}

#[test]
fn fox_round_trips_through_all_formats() {
    let Some(fox) = fox() else { return };
    let place = Place::empty();
    let mut transforms: Value = serde_json::from_slice(&std::fs::read(fox.join("transforms.json")).unwrap()).unwrap();
    // A few images are enough; some of the listed ones are absent.
    transforms["frames"].as_array_mut().unwrap().truncate(6);
    std::fs::create_dir_all(place.path("fox/images")).unwrap();
    for frame in transforms["frames"].as_array().unwrap() {
        let name = frame["file_path"].as_str().unwrap();
        if fox.join(name).is_file() {
            std::fs::copy(fox.join(name), place.path("fox").join(name)).unwrap();
        }
    }
    std::fs::write(place.path("fox/transforms.json"), transforms.to_string()).unwrap();
    // The matrices are rotations to about 1e-6 only, which quaternions cannot keep.
    there_and_back(&place, "fox", 2e-3);
    for folder in ["text", "binary", "back"] {
        std::fs::remove_dir_all(place.path(folder)).unwrap();
    }
    for frame in transforms["frames"].as_array_mut().unwrap() {
        make_rigid(&mut frame["transform_matrix"]);
    }
    std::fs::write(place.path("fox/transforms.json"), transforms.to_string()).unwrap();
    there_and_back(&place, "fox", OFF);
    place.succeeds("prepare fox --undistort --to llff --out llff");
    let (original, llff) = (read(&place, "fox"), read(&place, "llff"));
    assert_eq!(llff.views.len(), original.present().count());
    for (name, view) in by_name(&llff) {
        let (_, before) = by_name(&original).into_iter().find(|(other, _)| *other == name).unwrap();
        assert_same_directions(&view.camera, &before.camera);
        let kept = view.camera.width * view.camera.height;
        assert!(10 * kept > 9 * before.camera.width * before.camera.height, "{:?}", view.camera);
    }
}

#[test]
fn built_in_scenes_convert_to_other_formats() {
    let place = Place::empty();
    for (scene, format, size, count) in
        [("embedded", "nerfstudio", [24, 24], 90), ("landscape", "colmap", [16, 12], 130)]
    {
        let said = place.succeeds(&format!("prepare {scene} --to {format} --size {} --out {scene}-made", size[0]));
        assert!(said.starts_with(&format!("capture  {scene} (")), "{said}");
        let capture = Capture::read(place.path(&format!("{scene}-made"))).unwrap();
        assert_eq!(capture.present().count(), count);
        let view = capture.present().find(|view| view.name.ends_with("test/3.png")).unwrap();
        let photo = Photo::open(view.image.as_ref().unwrap(), None).unwrap();
        assert_eq!(([photo.width, photo.height], photo.has_alpha()), (size, scene == "embedded"));
        let data = match scene {
            "embedded" => raygrad_scenes::embedded(Split::Test, size[0]),
            _ => raygrad_scenes::landscape(Split::Test, size[0]),
        };
        let (found, expected) = (view.camera_of_image().unwrap(), &data.frames[3].camera);
        let [a, b] = [&found, expected].map(|camera| camera.ray(5.5, 3.5));
        assert!(a.origin.distance(b.origin) < 1e-6 && a.direction.distance(b.direction) < 1e-7, "{found:?}");
        place.succeeds(&format!("train {scene}-made --steps 1 --scene-type bounded --out run-{scene} {CLASSIC}"));
    }
    place.fails_with(
        "prepare embedded --out other",
        "embedded: is a built-in scene: choose the format to write with --to",
    );
    place.fails_with(
        "prepare landscape --to colmap --size 15 --out other",
        "`size`: is 15; the landscape is 4:3, so use a multiple of 4",
    );
    place.fails_with("prepare absent --to colmap --out other", "absent: there is no such folder");
    place.fails("prepare embedded-made --to colmap --size 16 --out other", &["`size`: is for built-in scenes"]);
    assert!(!place.path("other").exists());
}

/// File names reach messages, pages and the terminal; control characters in them do not.
#[cfg(unix)]
#[test]
fn control_characters_of_names_do_not_reach_the_terminal() {
    let place = Place::empty();
    place.succeeds("prepare embedded --size 16 --to llff --out llff");
    let images = place.path("llff/images");
    let mut names: Vec<_> = std::fs::read_dir(&images).unwrap().map(|entry| entry.unwrap().path()).collect();
    names.sort();
    let evil = "\u{1b}[2J\u{7}<!--<script>.png";
    std::fs::rename(&names[1], images.join(evil)).unwrap();
    // The second image is of two pixels, so that errors name it.
    std::fs::rename(&names[3], images.join("\u{9b}31m\n.png")).unwrap();
    let run = |arguments: &str| place.command(arguments).output().unwrap();
    let clean = |arguments: &str| {
        let output = run(arguments);
        for text in [&output.stdout, &output.stderr] {
            let text = String::from_utf8_lossy(text).into_owned();
            let bad = text.chars().find(|c| c.is_control() && !"\n\t".contains(*c));
            assert_eq!(bad, None, "{arguments}: {text:?}");
        }
        output
    };
    assert!(clean("doctor llff --out checked").status.success());
    let page = std::fs::read_to_string(place.path("checked/doctor.html")).unwrap();
    assert!(!page.contains("<!--<script>") && !page.contains('\u{1b}'), "the name is escaped in the page");
    assert!(clean(&format!("train llff --steps 2 --out run {}", super::SMALL)).status.success());
    assert!(clean("eval run").status.success() && clean("render run --path test --out test").status.success());
    assert!(clean("prepare llff --to nerfstudio --out other").status.success());
    // An error about a damaged image names it.
    std::fs::write(images.join(evil), b"no image").unwrap();
    for arguments in
        ["doctor llff --out again", "train llff --steps 1 --out next", "prepare llff --undistort --out last"]
    {
        let output = clean(arguments);
        let said = String::from_utf8([output.stdout, output.stderr].concat()).unwrap();
        assert!(said.contains("\\u{1b}[2J\\u{7}<!--<script>.png"), "{arguments}: {said}");
    }
}

#[test]
fn captures_are_found_from_within_their_folders() {
    let place = Place::empty();
    with_lens(&place);
    place.succeeds("prepare scene --to colmap --out model");
    std::fs::create_dir_all(place.path("other/colmap")).unwrap();
    std::fs::rename(place.path("model/sparse"), place.path("other/colmap/sparse")).unwrap();
    std::fs::rename(place.path("model/images"), place.path("other/images")).unwrap();
    for (number, (folder, name)) in [
        ("scene", "transforms.json"),
        ("scene", "."),
        ("scene/images", "../transforms.json"),
        (".", "other"),
        ("other", "colmap/sparse/0"),
        ("other/colmap", "sparse/0"),
        ("other/colmap/sparse", "0"),
        ("other/colmap/sparse/0", "."),
        ("other/colmap/sparse/0", "images.bin"),
    ]
    .into_iter()
    .enumerate()
    {
        let to = place.path(&format!("made{number}"));
        let mut command = place.command(&format!("prepare {name} --to nerfstudio --out"));
        let output = command.arg(&to).current_dir(place.path(folder)).output().unwrap();
        assert!(output.status.success(), "{folder}, {name}: {}", String::from_utf8_lossy(&output.stderr));
        let made = Capture::read(&to).unwrap();
        assert_eq!(made.present().count(), 9, "{folder}, {name}");
        assert!(to.join("images/more/8.png").is_file(), "{folder}, {name}: folders tell images apart");
    }
}

#[test]
fn images_that_training_refuses_are_converted_to_llff() {
    let place = Place::with_scene();
    for split in Split::ALL {
        for view in Capture::read(place.path("scene")).unwrap().split(split).unwrap() {
            let path = view.image.as_ref().unwrap();
            let image = Photo::open(path, None).unwrap().to_image();
            let data = image.data.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2], 0.5]).collect();
            Image { data, ..image }.save_png(path).unwrap();
        }
    }
    let what = "has alpha 128 of 255 in every pixel of `";
    place.fails(&format!("train scene --steps 1 {CLASSIC}"), &[what]);
    for (format, warns) in [("llff", true), ("nerfstudio", false)] {
        let output = place.command(&format!("prepare scene --to {format} --out {format}")).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success() && said.contains(what) == warns, "{format}: {said}");
        assert_eq!(read(&place, format).present().count(), 11);
    }
}

#[test]
fn images_with_one_stem_and_two_endings_stay_apart() {
    let place = Place::with_scene();
    let mut transforms = place.transforms(Split::Train);
    let jpeg = Photo::open(place.path("scene/train/r_1.png"), None).unwrap().over([1.0; 3]);
    std::fs::remove_file(place.path("scene/train/r_1.png")).unwrap();
    Photo::from(jpeg).save(place.path("scene/train/r_0.jpg")).unwrap();
    transforms["frames"][1]["file_path"] = "./train/r_0.jpg".into();
    for (frame, depth) in [(0, 0.25), (1, 0.5)] {
        let name = format!("depth{frame}.png");
        let depth = Image { width: 4, height: 4, channels: 1, data: vec![depth; 16] };
        depth.save_png(place.path(&format!("scene/{name}"))).unwrap();
        transforms["frames"][frame]["depth_file_path"] = name.into();
    }
    transforms["depth_unit_scale_factor"] = json!(0.1);
    place.write_transforms(Split::Train, &transforms);
    for format in ["blender", "nerfstudio", "colmap", "llff"] {
        place.succeeds(&format!("prepare scene --to {format} --out {format}"));
        let capture = read(&place, format);
        assert_eq!(capture.present().count(), 11, "{format}");
        for ending in ["png", "jpg"] {
            let views = capture.views.iter().filter_map(|view| view.image.as_ref().map(|image| (view, image)));
            let mut own = views.filter(|(_, image)| {
                image.to_str().unwrap().contains(&format!("train_r_0.{ending}"))
                    || image.ends_with(format!("train/r_0.{ending}"))
            });
            let (view, image) = own.next().unwrap();
            let from = std::fs::read(place.path(&format!("scene/train/r_0.{ending}"))).unwrap();
            assert!(own.next().is_none() && std::fs::read(image).unwrap() == from, "{format} {ending}");
            let Some((depth, _)) = &view.depth else { continue };
            let frame = usize::from(ending == "jpg");
            assert!(std::fs::read(depth).unwrap() == place.bytes(&format!("scene/depth{frame}.png")), "{ending}");
        }
    }
}
