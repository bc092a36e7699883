//! `raygrad train` and `eval` on captures with depth, inaccurate cameras and varying exposure.

use super::{PLAIN, Place, SIZE, SMALL, png};
use raygrad::Real;
use raygrad::nerf::dataset::{Capture, Dataset, Split, load};
use raygrad::nerf::{Camera, Config, Image, Model, SceneBox};
use serde_json::{Value, json};

/// The model of a run.
pub fn model(place: &Place, run: &str) -> Model<f32> {
    let config = place.json(&format!("{run}/config.json"));
    let extent: SceneBox = serde_json::from_value(config["scene_box"].clone()).unwrap();
    let settings: Config = serde_json::from_value(config["config"].clone()).unwrap();
    Model::load(place.path(&format!("{run}/model.safetensors")), settings, extent).unwrap()
}

fn terms(place: &Place, run: &str) -> Value {
    place.json(&format!("{run}/config.json"))["config"]["loss_terms"].clone()
}

#[test]
fn depth_loss_uses_depth_files() {
    let place = Place::with_scene();
    place.succeeds("prepare scene --to nerfstudio --out captured");
    let mut transforms = place.json("captured/transforms.json");
    std::fs::create_dir(place.path("captured/depths")).unwrap();
    let depth = Image { width: SIZE, height: SIZE, channels: 1, data: vec![40.0 / 255.0; SIZE * SIZE] };
    depth.save_png(place.path("captured/depths/all.png")).unwrap();
    transforms["depth_unit_scale_factor"] = json!(0.1);
    for frame in transforms["frames"].as_array_mut().unwrap() {
        frame["depth_file_path"] = json!("depths/all.png");
    }
    let loss = |flags: &str, run: &str| {
        place.succeeds(&format!("train captured --steps 1 --out {run} {SMALL} {flags}"));
        let text = String::from_utf8(place.bytes(&format!("{run}/metrics.jsonl"))).unwrap();
        serde_json::from_str::<Value>(text.lines().next().unwrap()).unwrap()["loss"].as_f64().unwrap()
    };
    // Without depth files there is nothing to learn from.
    place.fails(&format!("train captured --steps 1 --depth-loss {SMALL}"), &["`loss_terms`", "depth_file_path"]);
    std::fs::write(place.path("captured/transforms.json"), transforms.to_string()).unwrap();
    let [plain, usual, heavy] = [loss("", "plain"), loss("--depth-loss", "usual"), loss("--depth-loss=2", "heavy")];
    assert_eq!(terms(&place, "usual"), json!([{ "kind": "depth", "weight": 0.1 }]));
    assert_eq!(terms(&place, "heavy"), json!([{ "kind": "depth", "weight": 2.0 }]));
    assert!(usual > plain, "{usual} {plain}");
    assert!(((heavy - plain) / (usual - plain) - 20.0).abs() < 1e-3, "{plain} {usual} {heavy}");
    // Conversions keep depth if the format supports it, and warn otherwise.
    place.succeeds("prepare captured --to nerfstudio --out again");
    assert_eq!(place.json("again/transforms.json")["depth_unit_scale_factor"], json!(0.1));
    let again = place.json("again/transforms.json")["frames"][0]["depth_file_path"].as_str().unwrap().to_owned();
    assert!(place.bytes(&format!("again/{again}")) == place.bytes("captured/depths/all.png"));
    for flags in ["--to colmap --out left", "--undistort --out straight"] {
        let output = place.command(&format!("prepare captured {flags}")).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success() && said.contains("depth files are not converted: "), "{flags}: {said}");
    }
    // The landscape provides exact distances.
    place.succeeds(&format!("train landscape --downscale 20 --steps 1 --depth-loss --out far {SMALL}"));
    assert_eq!(terms(&place, "far")[1], json!({ "kind": "depth", "weight": 0.1 }));
    place.fails(&format!("train embedded --downscale 20 --steps 1 --depth-loss {SMALL}"), &["`loss_terms`"]);
}

#[test]
fn loss_terms_and_near_plane_are_configurable() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 1 --out one {SMALL} --loss entropy=0.001 --near 2.5"));
    assert_eq!(terms(&place, "one"), json!([{ "kind": "entropy", "weight": 0.001 }]));
    assert_eq!(place.json("one/config.json")["scene_box"]["near_far"][0], 2.5);
    // Loss terms of the scene type are replaced or removed.
    for (flag, expected) in [
        ("distortion=0", json!([])),
        ("distortion=0.5", json!([{ "kind": "distortion", "weight": 0.5 }])),
        ("entropy=0", json!([{ "kind": "distortion", "weight": 0.1 }])),
    ] {
        place.succeeds(&format!("train scene --scene-type unbounded --steps 1 --out {flag} {SMALL} --loss {flag}"));
        assert_eq!(terms(&place, flag), expected);
    }
    // In units of the files, which differ from scene units here.
    place.succeeds(&format!("train scene --scene-type unbounded --steps 1 --out near --near 0.25 {SMALL}"));
    let config = place.json("near/config.json");
    let scale = config["scene_box"]["transform"]["scale"].as_f64().unwrap();
    assert!(
        (config["scene_box"]["near_far"][0].as_f64().unwrap() - 0.25 * scale).abs() < 1e-12 && scale != 1.0,
        "{config}"
    );
    for near in ["9", "-1"] {
        let expected = [&format!("`near`: is {near}; use 0 to less than 6.") as &str, ", the far plane"];
        place.fails(&format!("train scene --steps 1 {SMALL} --near={near}"), &expected);
    }
    place.fails(&format!("train scene --steps 1 {SMALL} --loss fog=1"), &["`loss`: cannot be fog=1: ", "entropy"]);
    for bad in ["entropy", "entropy=x", "entropy=-1", "entropy=NaN"] {
        let output = place.command(&format!("train scene --steps 1 --loss {bad}")).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{bad}: {output:?}");
    }
}

/// The rendered part of the first picture of an evaluation.
pub fn rendered(place: &Place, name: &str) -> Image {
    let picture = png(&place.path(&format!("{name}/000.png")));
    let data = (0..SIZE * SIZE).flat_map(|i| picture.pixel(SIZE + i % SIZE, i / SIZE).to_vec()).collect();
    Image { width: SIZE, height: SIZE, channels: 3, data }
}

/// How far two images are apart, at most.
pub fn apart(a: &Image, b: &Image) -> f32 {
    assert_eq!([a.width, a.height], [b.width, b.height]);
    a.data.iter().zip(&b.data).map(|(a, b)| (a - b.clamp(0.0, 1.0)).abs()).fold(0.0, Real::maximum)
}

#[test]
fn eval_uses_the_models_cameras() {
    let place = Place::with_scene();
    // A large learning rate, so that the refinement is visible.
    let fast = r#"--set poses={"constant":{"rate":0.05}} --set camera_optimizer={"focal":{"constant":{"rate":0.02}}}"#;
    place.succeeds(&format!("train scene --steps 40 --out run {SMALL} {PLAIN} {fast}"));
    let model = model(&place, "run");
    let view = |camera: &Camera| model.render(camera, [1.0; 3]).color;
    // Animations through images use them too.
    place.succeeds("render run --path test --out way");
    let first = png(&place.path("way/0000.png"));
    let given = &load(place.path("scene"), Split::Test, 1).unwrap().frames[0].camera;
    assert!(apart(&first, &view(&model.other_camera(given))) < 0.01 && apart(&first, &view(given)) > 0.05);
    let trained = &load(place.path("scene"), Split::Train, 1).unwrap().frames[2].camera;
    place.succeeds("render run --path spline --keyframes 2 --frames 1 --out through");
    let through = png(&place.path("through/0000.png"));
    assert!(apart(&through, &view(&model.other_camera(trained))) > 0.02);
    // A path's cameras have square pixels and the vertical field of view of the image.
    let learned = model.learned_camera(2, trained);
    let learned = Camera { focal: [learned.focal[1]; 2], ..learned };
    assert!(apart(&through, &view(&learned)) < 0.01);
    // Or with poses fitted to the images.
    place.succeeds("eval run --fit-poses --views 2");
    let fitted = place.json("run/eval-test-fast-2-poses.json");
    assert_eq!(fitted["cameras"], "each fitted to its own image");
    let psnr = |value: &Value| value["psnr_mean"].as_f64().unwrap();
    place.succeeds("eval run --views 2");
    assert!(psnr(&fitted) > psnr(&place.json("run/eval-test-fast-2.json")), "{fitted}");
    for split in [Split::Train, Split::Test] {
        place.succeeds(&format!("eval run --split {split}"));
        let shown = rendered(&place, if split == Split::Train { "run/eval-train-fast" } else { "run/eval-test-fast" });
        let data: Dataset = load(place.path("scene"), split, 1).unwrap();
        let given = &data.frames[0].camera;
        let right = if split == Split::Train { model.learned_camera(0, given) } else { model.other_camera(given) };
        let [from_there, from_where_it_was] = [&right, given].map(|camera| apart(&shown, &view(camera)));
        assert!(from_there < 0.01, "{split}: {from_there}");
        assert!(from_where_it_was > 0.05, "{split}: {from_where_it_was}");
    }
}

#[test]
fn eval_states_exposure_of_held_out_images() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 12 --out plain {SMALL}"));
    let fast =
        r#"--set exposure_model={"exposure":{"constant":{"rate":0.05}},"vignetting":{"constant":{"rate":0.05}}}"#;
    place.succeeds(&format!("train scene --steps 12 --out run {SMALL} {fast}"));
    place.succeeds(&format!("train scene --steps 1 --out codes {SMALL} --set field.appearance_embedding_dim=2"));
    for (run, expected) in [("plain", "none"), ("run", "mean of the training images")] {
        place.succeeds(&format!("eval {run}"));
        assert_eq!(place.json(&format!("{run}/eval-test-fast.json"))["appearance"], expected);
    }
    assert!(
        place
            .succeeds("eval codes --views 1")
            .contains("exposure and appearance embeddings: mean of the training images")
    );
    // The mean exposure, and the vignetting of all images.
    let mut model = model(&place, "run");
    let camera = &load(place.path("scene"), Split::Test, 1).unwrap().frames[0].camera;
    let shown = rendered(&place, "run/eval-test-fast");
    let bright = apart(&shown, &model.render(camera, [1.0; 3]).color);
    model.vignetted = true;
    let own = apart(&shown, &model.render(camera, [1.0; 3]).color);
    assert!(own < 0.01 && bright > 0.02, "{own} {bright}");
    // With a gain fitted to the left half, the right half is compared.
    place.succeeds("eval plain --fit-half");
    let half = place.json("plain/eval-test-fast-half.json");
    assert_eq!(half["appearance"], "gains fitted to the left half, right half compared");
    let render = rendered(&place, "plain/eval-test-fast-half");
    assert!(apart(&render, &rendered(&place, "plain/eval-test-fast")) > 0.01);
    let truth = png(&place.path("plain/eval-test-fast-half/000.png"));
    let errors = (0..SIZE * SIZE).filter(|i| i % SIZE >= SIZE / 2).flat_map(|i| {
        let [a, b] = [&render, &truth].map(|image| image.pixel(i % SIZE, i / SIZE).to_vec());
        (0..3).map(move |k| f64::from(a[k] - b[k]).powi(2))
    });
    let mse = errors.sum::<f64>() / (3 * SIZE * SIZE / 2) as f64;
    let psnr = half["per_view"][0]["psnr"].as_f64().unwrap();
    assert!((psnr + 10.0 * mse.log10()).abs() < 0.05, "{psnr} {mse}");
    // Training images have their own exposure.
    place.succeeds("eval run --split train");
    assert_eq!(place.json("run/eval-train-fast.json")["appearance"], "each image's own");
    let camera = &load(place.path("scene"), Split::Train, 1).unwrap().frames[0].camera;
    let shown = rendered(&place, "run/eval-train-fast");
    let usual = apart(&shown, &model.render(camera, [1.0; 3]).color);
    model.appearance_image = Some(0);
    let own = apart(&shown, &model.render(camera, [1.0; 3]).color);
    assert!(own < 0.01 && usual > 0.02, "{own} {usual}");
}

#[test]
fn moved_captures_render_from_their_cameras() {
    let place = Place::with_scene();
    place.succeeds(&format!(
        "train scene --scene-type unbounded --steps 12 --out run {SMALL} --refine exposure,vignetting"
    ));
    let config = place.json("run/config.json");
    assert!(config["scene_box"]["transform"]["scale"].as_f64().unwrap() != 1.0);
    let tone = &config["config"]["exposure_model"];
    assert!(tone["exposure"].is_object() && tone["vignetting"].is_object(), "{tone}");
    let mut model = model(&place, "run");
    model.vignetted = true;
    place.succeeds("eval run");
    let given = &load(place.path("scene"), Split::Test, 1).unwrap().frames[0].camera;
    let moved = model.scene_box.transform.camera(given);
    let [right, wrong] = [&moved, given]
        .map(|camera| apart(&rendered(&place, "run/eval-test-fast"), &model.render(camera, [1.0; 3]).color));
    assert!(right < 0.005 && wrong > 0.012, "{right} {wrong}");
}

#[test]
fn images_in_no_split_are_not_counted() {
    let place = Place::with_scene();
    let train = place.transforms(Split::Train);
    let name = |i: usize| train["frames"][i]["file_path"].clone();
    let mut transforms = train.clone();
    transforms["train_filenames"] = json!([name(0), name(1), name(2)]);
    transforms["test_filenames"] = json!([name(3)]);
    std::fs::write(place.path("scene/transforms.json"), transforms.to_string()).unwrap();
    let output = place.command(&format!("train scene/transforms.json --steps 1 --out run {SMALL}")).output().unwrap();
    let [printed, said] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    assert!(printed.contains("6 of 6 images found, 1 held out; "), "{printed}{said}");
    assert!(said.contains("note: 2 images are in no split, such as `train/r_4`: they are not used"), "{said}");
}

#[test]
fn runs_do_not_switch_to_another_description() {
    let place = Place::with_scene();
    place.succeeds("prepare scene --to nerfstudio --out both");
    place.succeeds("prepare scene --to colmap --out other");
    std::fs::rename(place.path("other/sparse"), place.path("both/sparse")).unwrap();
    place.succeeds(&format!("train both --format colmap --steps 1 --out run {SMALL}"));
    place.succeeds("eval run");
    std::fs::rename(place.path("both/sparse"), place.path("aside")).unwrap();
    let expected = ["both/sparse/0/images.bin: the run was trained on this file, which is no longer here: put it back"];
    for command in ["eval run", "export run cameras.json", "train --resume run --steps 2"] {
        place.fails(command, &expected);
    }
    // A capture in another place may have another description, which the run then keeps to.
    std::fs::remove_file(place.path("both/transforms.json")).unwrap();
    std::fs::create_dir_all(place.path("both/colmap")).unwrap();
    std::fs::rename(place.path("aside"), place.path("both/colmap/sparse")).unwrap();
    std::fs::rename(place.path("both"), place.path("moved")).unwrap();
    place.succeeds("train --resume run --scene moved --steps 2");
    assert_eq!(place.json("run/config.json")["description"], "colmap/sparse/0/images.bin");
    place.succeeds("eval run");
}

#[test]
fn runs_keep_the_splits_of_blenders_files() {
    let place = Place::with_scene();
    let mut transforms = place.transforms(Split::Train);
    for split in [Split::Val, Split::Test] {
        let frames = place.transforms(split)["frames"].as_array().unwrap().clone();
        transforms["frames"].as_array_mut().unwrap().extend(frames);
    }
    std::fs::write(place.path("scene/transforms.json"), transforms.to_string()).unwrap();
    for (scene, run) in [("scene", "run"), ("scene/transforms.json", "other")] {
        let printed = place.succeeds(&format!("train {scene} --steps 1 --out {run} {SMALL}"));
        assert!(printed.contains("transforms.json, 11 of 11 images found, 5 held out; "), "{printed}");
        assert!(place.succeeds(&format!("eval {run}")).contains("mean of 3"));
        place.succeeds(&format!("train --resume {run} --steps 2"));
    }
}

#[test]
fn hash_grid_resolution_follows_the_images() {
    let place = Place::with_scene();
    let small = SMALL.replace("--set field.grid.log2_table=10", "");
    place.succeeds(&format!("train scene --steps 1 --out run {small}"));
    let footprints = load(place.path("scene"), Split::Train, 1).unwrap().pixels_per_side();
    let grid = place.json("run/config.json")["config"]["field"]["grid"].clone();
    assert_eq!((&grid["finest"], &grid["log2_table"]), (&json!((2.0 * footprints).ceil() as usize), &json!(17)));
}

#[test]
fn background_follows_transparency() {
    let place = Place::empty();
    let background = |flag: &str, run: &str| {
        place.succeeds(&format!("train landscape --downscale 20 --steps 1 --out {run} {SMALL} {flag}"));
        place.json(&format!("{run}/config.json"))["config"]["background"].clone()
    };
    assert_eq!(background("", "usual"), "white");
    assert_eq!(background("--background expected", "expected"), "expected");
    assert_eq!(background("--background black", "black"), "black");
    assert_eq!(place.json("usual/config.json")["config"]["sampler"]["early_stop_eps"], 0.001);
    place.succeeds(&format!("train embedded --downscale 8 --steps 1 --out transparent {SMALL}"));
    let config = place.json("transparent/config.json")["config"].clone();
    assert_eq!((&config["background"], &config["sampler"]["early_stop_eps"]), (&json!("expected"), &json!(0.01)));
    // Samplers with uniform samples would miss an unbounded scene.
    place.fails_with(
        "train landscape --downscale 20 --steps 1 --preset small",
        "`preset`: hierarchical sampling spaces samples evenly, too few for the long rays of an unbounded scene: use \
         --preset instant or voxel, or add --skip fast or --scene-type bounded",
    );
    let marched = "--preset small --skip fast --set sampler.samples=512 --set sampler.occupancy.resolution=16";
    place.succeeds(&format!("train landscape --downscale 20 --steps 1 --out skipped {marched}"));
}

#[test]
fn training_warns_of_inverted_alpha() {
    let place = Place::with_scene();
    let warns = |run: &str| {
        let output = place.command(&format!("train scene --steps 1 --out {run} {SMALL}")).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{said}");
        said.contains(
            "warning: hollow-alpha: the alpha channel of most images is transparent inside an opaque border; ",
        )
    };
    assert!(!warns("plain"));
    for view in Capture::read(place.path("scene")).unwrap().present() {
        let path = view.image.as_ref().unwrap();
        let mut image = Image::open(path).unwrap();
        image.data.chunks_exact_mut(4).for_each(|pixel| pixel[3] = 1.0 - pixel[3]);
        image.save_png(path).unwrap();
    }
    assert!(warns("inverted"));
}

#[test]
fn eval_of_training_images_as_test_is_an_error() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 1 --out run {SMALL}"));
    let mut test = place.transforms(Split::Test);
    let train = place.transforms(Split::Train);
    // Now the second test image is a former training image, with its name.
    let mut rest = train.clone();
    let moved = rest["frames"].as_array_mut().unwrap().remove(3);
    test["frames"][1] = moved;
    place.write_transforms(Split::Test, &test);
    place.write_transforms(Split::Train, &rest);
    place.fails_with(
        "eval run",
        "`scene`: the test image `train/r_3` was a training image of the run: name the unchanged capture with --scene",
    );
    place.fails("eval run --split val --scene absent", &["absent"]);
    // A path through images needs the training images.
    place.fails("render run --path spline --keyframes 0", &["trained on 6", "name their folder with --scene"]);
    // If no name is known, trained images cannot be told from others.
    let noted = |place: &Place| {
        let output = place.command("eval run --scene scene").output().unwrap();
        assert!(output.status.success(), "{output:?}");
        String::from_utf8_lossy(&output.stderr).contains("names none of the training images")
    };
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 1 --out run {SMALL}"));
    assert!(!noted(&place));
    std::fs::remove_file(place.path("scene/transforms_train.json")).unwrap();
    assert!(noted(&place));
    // Runs of version 0.1 do not store the names of images.
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 1 --out run {SMALL}"));
    let mut config = place.json("run/config.json");
    config["images"] = json!([]);
    std::fs::write(place.path("run/config.json"), config.to_string()).unwrap();
    place.succeeds("render run --path spline --keyframes 0,3 --frames 2 --size 4x4");
    // A run without a refined camera for an image refuses it too.
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 1 --out run {SMALL} --refine poses"));
    let mut train = place.transforms(Split::Train);
    std::fs::rename(place.path("scene/train/r_3.png"), place.path("scene/train/r_9.png")).unwrap();
    train["frames"][3]["file_path"] = json!("./train/r_9");
    place.write_transforms(Split::Train, &train);
    place.fails_with(
        "eval run --split train",
        "`scene`: `train/r_9` is not a training image of the run, which has no camera for it: name the unchanged \
         capture with --scene",
    );
    place.fails("export run other.json", &["has other training images than the run"]);
}

/// Training leaves such an image out, and so do all commands that need the training cameras.
#[test]
fn images_that_masks_hide_have_no_cameras() {
    let place = Place::with_scene();
    let mask = Image { width: SIZE, height: SIZE, channels: 1, data: vec![0.0; SIZE * SIZE] };
    mask.save_png(place.path("scene/mask.png")).unwrap();
    let mut train = place.transforms(Split::Train);
    train["frames"][2]["mask_path"] = json!("mask.png");
    place.write_transforms(Split::Train, &train);
    place.succeeds(&format!("train scene --steps 1 --out run {SMALL} --refine poses"));
    place.succeeds("render run --path spline --keyframes 0,4 --frames 2 --size 4x4");
    let said = place.succeeds("export run cameras.json");
    assert!(said.contains(" cameras, 5 of them refined"), "{said}");
    // Another image that is absent is not hidden.
    std::fs::remove_file(place.path("scene/train/r_4.png")).unwrap();
    place.fails("export run other.json", &["has 4 training images, and the run was trained on 5"]);
}

#[test]
fn forward_facing_capture_trains_in_ndc() {
    let place = Place::with_scene();
    place.succeeds("prepare scene --to nerfstudio --out captured");
    let mut transforms = place.json("captured/transforms.json");
    for (i, frame) in transforms["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
        let picture = place.path(&format!("captured/{}", frame["file_path"].as_str().unwrap()));
        png(&picture).over([0.2; 3]).save_png(picture).unwrap();
        // Side by side, looking along -z.
        let [x, y] = [0.3 * (i % 3) as f64, 0.2 * (i / 3) as f64];
        frame["transform_matrix"] =
            json!([[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, y], [0.0, 0.0, 1.0, 0.1 * x], [0.0, 0.0, 0.0, 1.0]]);
    }
    std::fs::write(place.path("captured/transforms.json"), transforms.to_string()).unwrap();
    let said = place.succeeds(&format!("train captured --steps 1 --out ahead {SMALL} --set sampler.step=0.1"));
    assert!(
        said.contains("forward-facing: images are opaque, so they show a background, and all cameras look ahead"),
        "{said}"
    );
    let ndc = model(&place, "ahead").scene_box.ndc.unwrap();
    // Up is preserved, and the frustum's eye is behind the cameras. A nearer near plane is nearer in the frustum.
    let survey = Capture::read(place.path("captured")).unwrap().analyze_scene(None).unwrap();
    assert_eq!(survey.ndc, Some(ndc));
    assert!(ndc.axes.y_axis.z > 0.999 && ndc.eye.z.abs() < 1.0, "{ndc:?}");
    place.succeeds(&format!("train captured --near 0.01 --steps 1 --out close {SMALL}"));
    let close = model(&place, "close").scene_box;
    assert!(
        close.near_far[0] < survey.near && close.ndc == Some(ndc.with_near(survey.near, close.near_far[0])),
        "{close:?}"
    );
    assert_eq!(place.json("ahead/config.json")["config"]["unbounded"], json!(true));
    place.succeeds("render ahead --frames 2");
    place.succeeds("eval ahead");
    place.succeeds(&format!("train captured --scene-type unbounded --steps 1 --out around {SMALL}"));
    // A resumed run has its scene type.
    for (run, scope) in [("ahead", "forward-facing"), ("around", "unbounded")] {
        let said = place.succeeds(&format!("train --resume {run} --steps 2"));
        assert!(said.contains(&format!("{scope}: as in training")), "{said}");
    }
    assert_eq!(model(&place, "around").scene_box.ndc, None);
    place.fails(
        &format!("train scene --scene-type forward-facing --steps 1 {SMALL}"),
        &["`scene-type`", "cannot be forward-facing: ", "use unbounded"],
    );
    place
        .fails(&format!("train embedded --downscale 20 --scene-type forward-facing --steps 1 {SMALL}"), &["unbounded"]);
    place.succeeds("eval ahead --fit-poses");
}
