//! `raygrad train` on captures as other programs and other machines leave them.

use super::{Place, SIZE, SMALL, png};
use raygrad::nerf::Image;
use serde_json::{Value, json};

/// A capture in nerfstudio's format in `plain`, with images in `plain/train` and other folders of splits.
fn plain() -> Place {
    let place = Place::with_scene();
    place.succeeds("prepare scene --to nerfstudio --out plain");
    place
}

/// Copies the files of `plain`, except its description.
fn copy(place: &Place, to: &str) {
    copy_images(place, "plain", to);
}

fn copy_images(place: &Place, from: &str, to: &str) {
    for folder in ["train", "val", "test"] {
        std::fs::create_dir_all(place.path(&format!("{to}/{folder}"))).unwrap();
        for entry in std::fs::read_dir(place.path(&format!("{from}/{folder}"))).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap();
            std::fs::copy(&path, place.path(&format!("{to}/{folder}/{name}"))).unwrap();
        }
    }
}

/// The standard error of a command that succeeds.
#[track_caller]
fn said(place: &Place, arguments: &str) -> String {
    let output = place.command(arguments).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{arguments}: {said}");
    said
}

/// The training images of a run.
fn images(place: &Place, run: &str) -> Vec<String> {
    let images = place.json(&format!("{run}/config.json"))["images"].clone();
    images.as_array().unwrap().iter().map(|name| name.as_str().unwrap().to_owned()).collect()
}

#[test]
fn dialects_train_to_the_same_model() {
    let place = plain();
    let transforms = place.json("plain/transforms.json");
    let frames = |change: &dyn Fn(&mut Value)| {
        let mut document = transforms.clone();
        document["frames"].as_array_mut().unwrap().iter_mut().for_each(change);
        document
    };
    let matrix = |top: &Value| json!([[top["fl_x"], 0, top["cx"]], [0, top["fl_y"], top["cy"]], [0, 0, 1]]);
    let by_matrix = {
        let mut document = transforms.clone();
        document["K"] = matrix(&transforms);
        ["fl_x", "fl_y", "cx", "cy"].iter().for_each(|name| _ = document.as_object_mut().unwrap().remove(*name));
        document
    };
    // Also in the lists of splits.
    let windows = transforms.to_string().replace("\"./", "\"");
    let windows = ["train", "val", "test"].into_iter().fold(windows, |text, split| {
        text.replace(&format!("\"{split}/"), &format!("\"C:\\\\captures\\\\mine\\\\{split}\\\\"))
    });
    let windows = windows.replace(".png\"", ".JPG\"");
    let flat = frames(&|frame| {
        let rows = frame["transform_matrix"].as_array().unwrap().clone();
        frame["transform_matrix"] = rows.iter().flat_map(|row| row.as_array().unwrap().clone()).collect();
    });
    let strings = frames(&|frame| {
        for row in frame["transform_matrix"].as_array_mut().unwrap() {
            row.as_array_mut().unwrap().iter_mut().for_each(|value| *value = json!(value.to_string()));
        }
    });
    let wide = |text: &str| [0xff, 0xfe].into_iter().chain(text.encode_utf16().flat_map(u16::to_le_bytes)).collect();
    place.succeeds(&format!("train plain --steps 60 --out run {SMALL}"));
    let model = place.bytes("run/model.safetensors");
    let variants: [(&str, Vec<u8>, &str); 5] = [
        ("matrix", by_matrix.to_string().into_bytes(), ""),
        ("windows", windows.into_bytes(), "does not exist: used `train"),
        ("flat", flat.to_string().into_bytes(), ""),
        ("strings", strings.to_string().into_bytes(), ""),
        ("utf16", wide(&transforms.to_string()), ""),
    ];
    for (name, bytes, note) in variants {
        copy(&place, name);
        std::fs::write(place.path(&format!("{name}/transforms.json")), bytes).unwrap();
        let said = said(&place, &format!("train {name} --steps 60 --out run-{name} {SMALL}"));
        assert_eq!(said.contains("note: "), !note.is_empty(), "{name}: {said}");
        assert!(said.contains(note), "{name}: {said}");
        assert!(place.bytes(&format!("run-{name}/model.safetensors")) == model, "{name}");
    }
    // The same name in two folders.
    std::fs::create_dir(place.path("windows/other")).unwrap();
    std::fs::copy(place.path("windows/train/r_0.png"), place.path("windows/train/r_0.webp")).unwrap();
    place.fails(&format!("train windows --steps 1 {SMALL}"), &["`frames[0].file_path`", "r_0.png` and `", "fit"]);
}

#[test]
fn test_images_can_be_chosen() {
    let place = Place::with_scene();
    let train = |flags: &str, run: &str| {
        place.succeeds(&format!("train scene --steps 1 --out {run} {SMALL} {flags}"));
        images(&place, run)
    };
    assert_eq!(train("", "usual").len(), 6);
    // All images, also those that the files hold out.
    assert_eq!(train("--test none", "all").len(), 11);
    place.fails("eval all", &["has no test images"]);
    place.succeeds("train --resume all --steps 2");
    assert_eq!(train("--test every:2", "half").len(), 5);
    place.succeeds("eval half");
    let result = place.json("half/eval-test-fast.json");
    assert_eq!((&result["views"], &result["hold_out"]), (&json!(6), &json!("as `train --test` chose")));
    // Few images fade in detail.
    assert_eq!(place.json("half/config.json")["config"]["camera_optimizer"]["coarse"], 0.5);
    place.succeeds("export half half-scene --to nerfstudio");
    let lists = place.json("half-scene/transforms.json");
    let count = |list: &str| lists[list].as_array().unwrap().len();
    assert_eq!([count("train_filenames"), count("test_filenames")], [5, 6]);
    let chosen = train("--test r_3,val/r_1", "named");
    assert!(chosen.len() == 9 && !chosen.contains(&"train/r_3".to_owned()), "{chosen:?}");
    // A path along training images counts those of the run.
    place.succeeds("render all --path spline --keyframes 0,10 --frames 2 --size 4x4");
    place.succeeds("export all cameras.json");
    place.fails("train scene --test r_0 --steps 1", &["names `r_0`, which fits `", "write more of the path"]);
    let usage = |flag: &str| {
        let output = place.command(&format!("train scene --steps 1 {flag}")).output().unwrap();
        assert_eq!(output.status.code(), Some(2));
        String::from_utf8(output.stderr).unwrap()
    };
    assert!(usage("--test every:1").contains("--test <IMAGES>': use every:N with N of at least 2"));
    assert!(usage("--format other").contains("--format <FORMAT>': use transforms, blender, colmap or llff"));
    place.fails("train embedded --test none --steps 1", &["built-in scenes have their own test images"]);
}

#[test]
fn formats_can_be_chosen() {
    let place = Place::with_scene();
    place.succeeds("prepare scene --to colmap --out both");
    place.succeeds("prepare scene --to nerfstudio --out other");
    // A stale description: none of its images exist.
    let stale = place.json("other/transforms.json").to_string().replace(".png", "_old.png");
    std::fs::write(place.path("both/transforms.json"), &stale).unwrap();
    let train = |scene: &str, run: &str| said(&place, &format!("train {scene} --steps 1 --out {run} {SMALL}"));
    let note = "note: images found: `sparse/0` 11 of 11, `transforms.json` 0 of 11; used the first";
    assert!(train("both", "run").contains(note));
    assert!(!train("both --format colmap", "asked").contains("note: images"));
    let described = |run: &str| place.json(&format!("{run}/config.json"))["description"].clone();
    assert!(["run", "asked"].iter().all(|run| described(run) == "sparse/0/images.bin"));
    place.succeeds("eval asked --views 1");
    // A run keeps its description, though a later one is as complete.
    let fresh = place.bytes("other/transforms.json");
    std::fs::write(place.path("both/transforms.json"), &fresh).unwrap();
    copy_images(&place, "other", "both");
    train("both", "later");
    assert_eq!(described("later"), json!("transforms.json"));
    place.succeeds("train --resume asked --steps 2");
    place.succeeds("eval asked");
    train("both --format transforms", "transforms");
    place.succeeds("eval transforms --views 1");
    place.fails(
        "train both/transforms.json --format colmap",
        &["describes a capture in the format transforms.json, not COLMAP"],
    );
    std::fs::write(place.path("both/transforms.json"), stale).unwrap();
    place.fails("train both --format transforms", &["none of the 11 images exists"]);
    place.fails("train both/transforms.json", &["none of the 11 images exists"]);
    place
        .fails("train both --format llff", &["holds no capture in the format LLFF, but `transforms.json`, `sparse/0`"]);
}

#[test]
fn large_images_are_downscaled() {
    let place = Place::empty();
    let frame = |i: usize| {
        std::fs::create_dir_all(place.path("large/images")).unwrap();
        let image = Image { width: 3204, height: 6, channels: 3, data: vec![0.25 * i as f32; 3204 * 6 * 3] };
        image.save_png(place.path(&format!("large/images/{i}.png"))).unwrap();
        let matrix = json!([[1, 0, 0, i], [0, 1, 0, i * i], [0, 0, 1, 4], [0, 0, 0, 1]]);
        json!({ "file_path": format!("images/{i}.png"), "transform_matrix": matrix })
    };
    let transforms = json!({ "camera_angle_x": 0.8, "frames": (0..3).map(frame).collect::<Vec<_>>() });
    std::fs::write(place.path("large/transforms.json"), transforms.to_string()).unwrap();
    let train = |flags: &str, run: &str| {
        let said = said(&place, &format!("train large --steps 1 --out {run} {SMALL} {flags}"));
        (
            said.contains("note: images are downscaled by 4, to 801x2: this budget resolves no more; --downscale sets"),
            place.json(&format!("{run}/config.json"))["downscale"].clone(),
        )
    };
    // Never below 800 pixels.
    assert_eq!(train("", "run"), (true, json!(4)));
    assert_eq!(train("--downscale 1", "whole"), (false, json!(1)));
    place.succeeds("eval run");
    assert_eq!(place.json("run/eval-test-fast.json")["downscale"], json!(4));
    // Renders have the size of training.
    place.succeeds("render run --path test --out views");
    assert_eq!(png(&place.path("views/0000.png")).width, 801);
}

#[test]
fn masks_as_alpha_stay_in_all_commands() {
    let place = plain();
    let mut transforms = place.json("plain/transforms.json");
    let mut mask = Image { width: SIZE, height: SIZE, channels: 1, data: vec![1.0; SIZE * SIZE] };
    mask.data[..SIZE * SIZE / 2].fill(0.0);
    mask.save_png(place.path("plain/mask.png")).unwrap();
    for frame in transforms["frames"].as_array_mut().unwrap() {
        frame["mask_path"] = json!("mask.png");
    }
    std::fs::write(place.path("plain/transforms.json"), transforms.to_string()).unwrap();
    let psnr = |run: &str, flags: &str| {
        place.succeeds(&format!("train plain --steps 2 --out {run} {SMALL} {flags}"));
        place.succeeds(&format!("train --resume {run} --steps 4"));
        place.succeeds(&format!("eval {run}"));
        let result = place.json(&format!("{run}/eval-test-fast.json"));
        (result["mask_as_alpha"].clone(), result["psnr_mean"].as_f64().unwrap())
    };
    let (ignored, cut) = (psnr("ignored", ""), psnr("cut", "--mask-as-alpha"));
    assert_eq!((ignored.0, cut.0), (Value::Null, json!(true)));
    assert!(ignored.1 != cut.1);
    // The same model, evaluated where masks are ignored.
    let config = place.json("cut/config.json");
    let other = config.to_string().replace("\"mask_as_alpha\":true", "\"mask_as_alpha\":false");
    std::fs::write(place.path("cut/config.json"), other).unwrap();
    place.succeeds("eval cut");
    assert!(place.json("cut/eval-test-fast.json")["psnr_mean"].as_f64().unwrap() != cut.1);
    std::fs::write(place.path("cut/config.json"), config.to_string()).unwrap();
    place.succeeds("eval cut");
    let output = place.command("compare ignored cut").output().unwrap();
    let all = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap()).concat();
    assert!(all.contains("mask_as_alpha"), "{all}");
}
