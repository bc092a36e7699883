//! Captures whose files name paths outside of their folder. Commands read these and write nothing there. A new dataset
//! contains copies of them only with the flag that allows it.

use super::{Place, SMALL};
use raygrad::nerf::Image;
use raygrad::nerf::dataset::{Split, evenly_spaced};
use raygrad::nerf::glam::{DMat3, DQuat, DVec3};
use raygrad_scenes::embedded;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const SIZE: usize = 24;

/// Paths of images as a capture may name them, relative to its folder; all exist.
fn names(place: &Place) -> Vec<String> {
    let absolute = place.path("elsewhere/absolute.png").to_str().unwrap().to_owned();
    let inside = (0..3).map(|i| format!("images/{i}.png"));
    inside
        .chain(["../../x.png", "images/../../../elsewhere/y.png", "../masks/z.png"].map(String::from))
        .chain([absolute])
        .collect()
}

/// The name of an image and its camera-to-world matrix.
type Named = (String, [[f64; 4]; 4]);

/// A place whose folder `work/scene` has cameras of images inside and outside of it.
fn place() -> (Place, Vec<Named>) {
    let place = Place::empty();
    for folder in ["work/scene/images", "work/masks", "elsewhere"] {
        std::fs::create_dir_all(place.path(folder)).unwrap();
    }
    let names = names(&place);
    let frames = evenly_spaced(embedded(Split::Train, SIZE).frames, names.len());
    let views = names.into_iter().zip(frames).map(|(name, frame)| {
        frame.image.over([1.0; 3]).save_png(place.path("work/scene").join(&name)).unwrap();
        let (rotation, eye) = (frame.camera.pose.matrix3, frame.camera.pose.translation);
        let row = |r: usize| [rotation.row(r).x, rotation.row(r).y, rotation.row(r).z, eye[r]];
        (name, [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]])
    });
    let views = views.collect();
    Image { width: SIZE, height: SIZE, channels: 1, data: vec![1.0; SIZE * SIZE] }
        .save_png(place.path("elsewhere/mask.png"))
        .unwrap();
    (place, views)
}

/// All files of a place except those in some folders, with their contents.
fn files(place: &Place, but: &[&str]) -> BTreeMap<PathBuf, Vec<u8>> {
    fn walk(folder: &Path, but: &[PathBuf], out: &mut BTreeMap<PathBuf, Vec<u8>>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if but.contains(&path) {
            } else if path.is_dir() {
                out.insert(path.clone(), vec![]);
                walk(&path, but, out);
            } else {
                out.insert(path.clone(), std::fs::read(&path).unwrap());
            }
        }
    }
    let (but, mut out) = (but.iter().map(|name| place.path(name)).collect::<Vec<_>>(), BTreeMap::new());
    walk(&place.path(""), &but, &mut out);
    out
}

/// Runs commands in `work` that may write only to `work/out` or `work/run`.
fn only_there(place: &Place, commands: &[&str]) {
    for arguments in commands {
        let before = files(place, &["work/out", "work/run", "work/out.json"]);
        let output = place.command(arguments).current_dir(place.path("work")).output().unwrap();
        // The doctor may have findings.
        assert!(matches!(output.status.code(), Some(0 | 3)), "{arguments}: {output:?}");
        let after = files(place, &["work/out", "work/run", "work/out.json"]);
        assert_eq!(before.keys().collect::<Vec<_>>(), after.keys().collect::<Vec<_>>(), "{arguments}");
        assert!(before == after, "{arguments}: a file has changed");
        let written = place.path("work/out");
        if written.is_dir() {
            // The output contains all images.
            let inside = files(place, &[]).into_keys().filter(|path| path.starts_with(&written));
            let pictures = inside.filter(|path| path.extension().is_some_and(|ending| ending == "png")).count();
            assert!(!arguments.contains("--to") || pictures >= 7, "{arguments}");
            std::fs::remove_dir_all(written).unwrap();
        }
        let _ = std::fs::remove_file(place.path("work/out.json"));
    }
}

#[test]
fn transforms_paths_outside_are_never_written() {
    let (place, views) = place();
    let mask = "../../elsewhere/mask.png";
    let frames = views.iter().enumerate().map(|(i, (name, matrix))| {
        let depth = if i == 0 { json!("../../elsewhere/mask.png") } else { Value::Null };
        json!({ "file_path": name, "transform_matrix": matrix, "mask_path": mask, "depth_file_path": depth })
    });
    let frames: Vec<Value> = frames.collect();
    let write = |frames: &[Value]| {
        let all = json!({ "camera_angle_x": 0.69, "k1": 0.01, "depth_unit_scale_factor": 0.01, "frames": frames });
        std::fs::write(place.path("work/scene/transforms.json"), all.to_string()).unwrap();
    };
    write(&frames);
    only_there(
        &place,
        &[
            "prepare scene --to nerfstudio --out out --allow-outside",
            "prepare scene --to nerfstudio --undistort --out out --allow-outside",
            "prepare scene --to colmap --undistort --out out --allow-outside",
            "prepare scene --to llff --undistort --out out --allow-outside",
            &format!("train scene --steps 3 --out run {SMALL}"),
            "eval run --split train",
            "eval run --split test",
            "render run --frames 2 --out out",
            "export run out.json",
            "doctor scene --out out",
        ],
    );
    // Names are kept; the first one is held out.
    assert_eq!(place.json("work/run/eval-test-fast.json")["per_view"][0]["name"], "../../x.png");
    assert!(place.json("work/run/config.json")["images"].as_array().unwrap().contains(&json!("../masks/z.png")));
    // Blender's format has no masks.
    let mut plain = frames.clone();
    plain.iter_mut().for_each(|frame| drop(frame.as_object_mut().unwrap().remove("mask_path")));
    write(&plain);
    only_there(&place, &["prepare scene --to blender --undistort --out out --allow-outside"]);
    // Names that no file can have.
    for name in ["a\0b.png", "a\nb.png"] {
        let mut frames = frames.clone();
        frames[1]["file_path"] = json!(name);
        write(&frames);
        let output = place
            .command("prepare scene --to nerfstudio --out out --allow-outside")
            .current_dir(place.path("work"))
            .output();
        super::complained(name, &output.unwrap(), &["file_path", "without control characters"]);
    }
    // A run whose configuration names images elsewhere is not resumed.
    write(&frames);
    let mut config = place.json("work/run/config.json");
    config["images"][0] = json!("../../../x");
    std::fs::write(place.path("work/run/config.json"), config.to_string()).unwrap();
    let output = place.command("train --resume run --steps 4").current_dir(place.path("work")).output().unwrap();
    super::complained("resume", &output, &["other images"]);
}

#[test]
fn colmap_paths_outside_are_never_written() {
    let (place, views) = place();
    std::fs::create_dir_all(place.path("work/scene/sparse/0")).unwrap();
    let focal = 0.5 * SIZE as f64 / (0.5_f64 * 0.69).tan();
    let half = SIZE as f64 / 2.0;
    std::fs::write(
        place.path("work/scene/sparse/0/cameras.txt"),
        format!("1 PINHOLE {SIZE} {SIZE} {focal} {focal} {half} {half}\n"),
    )
    .unwrap();
    std::fs::write(place.path("work/scene/sparse/0/points3D.txt"), "").unwrap();
    // COLMAP's images are in `images`.
    let name = |name: &str| match name.strip_prefix("images/") {
        Some(inside) if !inside.starts_with("..") => inside.to_owned(),
        _ if name.starts_with('/') => name.to_owned(),
        _ => format!("../{name}"),
    };
    let lines = views.iter().enumerate().map(|(i, (file, m))| {
        // From a camera-to-world matrix that looks along -z to a world-to-camera one that looks along z.
        let axes = [0, 1, 2].map(|c| [m[0][c], m[1][c], m[2][c]]);
        let rows = [axes[0], axes[1].map(|x| -x), axes[2].map(|x| -x)].map(DVec3::from);
        let matrix = DMat3::from_cols(rows[0], rows[1], rows[2]).transpose();
        let (q, t) = (DQuat::from_mat3(&matrix), -(matrix * DVec3::new(m[0][3], m[1][3], m[2][3])));
        format!("{} {} {} {} {} {} {} {} 1 {}\n\n", i + 1, q.w, q.x, q.y, q.z, t.x, t.y, t.z, name(file))
    });
    let lines: String = lines.collect();
    std::fs::write(place.path("work/scene/sparse/0/images.txt"), &lines).unwrap();
    only_there(
        &place,
        &[
            "prepare scene --to nerfstudio --out out --allow-outside",
            "prepare scene --to colmap-text --out out --allow-outside",
            "prepare scene --to llff --undistort --out out --allow-outside",
            "prepare scene --to blender --undistort --out out --allow-outside",
            &format!("train scene --steps 3 --out run {SMALL}"),
            "eval run --split train",
            "export run out.json",
            "export run --to nerfstudio out --allow-outside",
        ],
    );
    // A points file that is a link to elsewhere.
    #[cfg(unix)]
    {
        let points = place.path("work/scene/sparse/0/points3D.txt");
        std::fs::write(place.path("elsewhere/points.txt"), "1 0 0 0 0 0 0 1 1 0\n").unwrap();
        std::fs::remove_file(&points).unwrap();
        std::os::unix::fs::symlink(place.path("elsewhere/points.txt"), &points).unwrap();
        let inside: String = lines.split_inclusive("\n\n").take(3).collect();
        std::fs::write(place.path("work/scene/sparse/0/images.txt"), inside).unwrap();
        let convert = "prepare scene --to colmap --out out";
        refused(&place, convert, &["images.txt: ", "points3D.txt lies outside of", "add --allow-outside to copy it"]);
        only_there_converted(&place, &format!("{convert} --allow-outside"));
        std::fs::write(place.path("elsewhere/points.txt"), "").unwrap();
        // From the folder of the model as from that of the scene.
        only_there_converted(&place, "prepare scene/sparse/0 --to nerfstudio --out out");
    }
    std::fs::write(place.path("work/scene/sparse/0/images.txt"), lines.replace("0.png", "a\0b.png")).unwrap();
    let output = place.command("prepare scene --to colmap --out out").current_dir(place.path("work")).output().unwrap();
    super::complained("colmap", &output, &["images.txt", "has a control character"]);
}

/// Runs a command in `work` that must fail with a message and leave no file.
#[track_caller]
fn refused(place: &Place, arguments: &str, expected: &[&str]) {
    let before = files(place, &[]);
    let output = place.command(arguments).current_dir(place.path("work")).output().unwrap();
    super::complained(arguments, &output, expected);
    assert_eq!(before, files(place, &[]), "{arguments}");
}

#[test]
fn private_files_are_not_copied_into_a_dataset() {
    let (place, views) = place();
    std::fs::write(place.path("elsewhere/secret.txt"), "a private key").unwrap();
    for name in ["depth.npy", "secret.png"] {
        std::fs::write(place.path(&format!("work/scene/images/{name}")), "a private key").unwrap();
    }
    std::fs::copy(place.path("elsewhere/mask.png"), place.path("work/scene/images/mask.png")).unwrap();
    // An image file that contains other data after its beginning.
    let mut cut = place.bytes("work/scene/images/0.png");
    let half = cut.len() / 2;
    cut[half..].fill(b'k');
    std::fs::write(place.path("work/scene/images/cut.png"), cut).unwrap();
    let point = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n";
    std::fs::write(place.path("elsewhere/points.ply"), point).unwrap();
    std::fs::write(place.path("work/scene/points.ply"), point).unwrap();
    // A link with an image's name that leads elsewhere.
    #[cfg(unix)]
    std::os::unix::fs::symlink(place.path("elsewhere/absolute.png"), place.path("work/scene/images/link.png")).unwrap();
    let write = |field: &str, value: &Value| {
        let mut frames: Vec<Value> =
            views[..3].iter().map(|(name, matrix)| json!({ "file_path": name, "transform_matrix": matrix })).collect();
        let mut all = json!({ "camera_angle_x": 0.69 });
        match field {
            "ply_file_path" => all[field] = value.clone(),
            _ => frames[1][field] = value.clone(),
        }
        all["frames"] = json!(frames);
        std::fs::write(place.path("work/scene/transforms.json"), all.to_string()).unwrap();
    };
    let secret = place.path("elsewhere/secret.txt").to_str().unwrap().to_owned();
    let convert = "prepare scene --to nerfstudio --out out";
    // Paths outside, direct or by a link; and files that are no depth, mask or image.
    for (field, value) in [
        ("depth_file_path", secret.as_str()),
        ("depth_file_path", "../../elsewhere/secret.txt"),
        ("mask_path", "../../elsewhere/mask.png"),
        ("file_path", "../../x.png"),
        ("file_path", "images/../../masks/z.png"),
        #[cfg(unix)]
        ("file_path", "images/link.png"),
        #[cfg(unix)]
        ("mask_path", "images/link.png"),
    ] {
        write(field, &json!(value));
        refused(
            &place,
            convert,
            &["transforms.json: `frames[1]`: ", "lies outside of", "add --allow-outside to copy it"],
        );
        refused(&place, "prepare scene --undistort --out out", &["lies outside of"]);
    }
    write("ply_file_path", &json!("../../elsewhere/points.ply"));
    refused(&place, convert, &["transforms.json: ", "points.ply lies outside of"]);
    write("ply_file_path", &json!("points.ply"));
    only_there_converted(&place, convert);
    for (field, value, expected) in [
        ("depth_file_path", secret.as_str(), "secret.txt: "),
        ("depth_file_path", "images/depth.npy", "depth.npy: "),
        ("depth_file_path", "images/secret.png", "secret.png: "),
        ("mask_path", "images/secret.png", "secret.png: "),
        ("mask_path", "images/cut.png", "cut.png: cannot be decoded"),
        ("file_path", "images/cut.png", "cut.png: cannot be decoded"),
        ("file_path", "../../elsewhere/secret.txt", "secret.txt: "),
    ] {
        write(field, &json!(value));
        refused(&place, &format!("{convert} --allow-outside"), &[expected]);
    }
    // Valid files inside are copied.
    write("mask_path", &json!("images/mask.png"));
    only_there_converted(&place, convert);
    // Training may read files outside.
    write("mask_path", &json!("../../elsewhere/mask.png"));
    only_there(&place, &[&format!("train scene --steps 3 --out run {SMALL}")]);
    refused(&place, "export run --to nerfstudio out", &["lies outside of", "--allow-outside"]);
}

/// Converts, and removes the output.
fn only_there_converted(place: &Place, arguments: &str) {
    let output = place.command(arguments).current_dir(place.path("work")).output().unwrap();
    assert!(output.status.success(), "{arguments}: {output:?}");
    std::fs::remove_dir_all(place.path("work/out")).unwrap();
}
