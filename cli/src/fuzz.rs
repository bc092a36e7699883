//! Property tests of inputs of the command line: damaged input gives an error, never a panic.

use std::path::Path;

use super::cameras::Viewpoint;
use super::checkpoint;
use super::compare;
use super::parse;
use super::render::frames;
use super::render::path_file::{self, Motion};
use super::run::{Run, RunConfig};
use super::scene::Scene;
use super::shard;
use super::train::changed;
use super::view::messages::{ClientMessage, Eye, View};
use proptest::prelude::*;
use raygrad::nerf::glam::{DAffine3, DVec3};
use raygrad::nerf::{Config, Error, Preset, SceneBox};
use raygrad_test_support::{
    campaign::campaign,
    damage::clear,
    memory::peak,
    tally::{Bound, cases},
};
use serde_json::{Value, json};

pub fn run_config() -> RunConfig {
    RunConfig {
        budget: None,
        keep_checkpoints: 2,
        images: vec!["train/0".into()],
        raygrad: "0.1.0".into(),
        scene: Scene::Embedded,
        downscale: 1,
        description: None,
        test: None,
        mask_as_alpha: false,
        scene_box: SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [2.0, 6.0]),
        viewpoint: Viewpoint {
            width: 8,
            height: 6,
            angle_x: 0.7,
            distance: 4.0,
            elevation: 0.5,
            azimuth: 0.0,
            reach: 1.0,
        },
        config: Config::preset(Preset::Instant),
    }
}

/// The dotted names of all values of a configuration.
fn names(value: &Value, name: &str, out: &mut Vec<String>) {
    let join = |key: &str| if name.is_empty() { key.to_owned() } else { format!("{name}.{key}") };
    match value {
        Value::Object(members) => members.iter().for_each(|(key, value)| names(value, &join(key), out)),
        Value::Array(items) => items.iter().enumerate().for_each(|(i, value)| names(value, &join(&i.to_string()), out)),
        _ => {}
    }
    out.push(name.to_owned());
}

/// Values as a user may type them.
fn typed() -> impl Strategy<Value = String> {
    let numbers = any::<f64>().prop_map(|x| x.to_string());
    let words =
        ["", "null", "true", "[]", "{}", "-0", "1e999", "18446744073709551616", "\"mse\"", "voxel", "[1,2]", "0x1"];
    prop_oneof![3 => "\\PC{0,12}", 3 => numbers, 3 => any::<i64>().prop_map(|x| x.to_string()), 3 => (0..words.len()).prop_map(move |i| words[i].to_owned())]
}

proptest! {
    #![proptest_config(cases())]

    #[test]
    fn setting_fuzzed_is_clear(text in "\\PC{0,20}", which in any::<prop::sample::Index>(), typed in typed()) {
        let config = run_config().config;
        let mut all = vec![];
        names(&serde_json::to_value(&config).unwrap(), "", &mut all);
        for text in [text, format!("{}={typed}", which.get(&all))] {
            let Ok((name, value)) = parse::setting(&text) else { continue };
            match changed(&config, &name, &value).and_then(|config| config.check()) {
                Ok(()) => {}
                // Errors name the last part of the setting.
                Err(error) => clear(error, "`"),
            }
        }
    }

    #[test]
    fn duration_and_size_fuzzed(text in "\\PC{0,12}", number in any::<f64>(), unit in "[smhx]?", [a, b] in any::<[u64; 2]>()) {
        for text in [text, format!("{number}{unit}"), format!("{number:e}{unit}")] {
            if let Ok(duration) = parse::duration(&text) {
                prop_assert!(!duration.is_zero());
            }
        }
        for text in [format!("{a}x{b}"), format!("{}x{}", a % 20_000, b % 20_000)] {
            if let Ok([width, height]) = parse::size(&text) {
                prop_assert!(width > 0 && height > 0 && width.max(height) <= 16_384);
            }
        }
    }
}

#[test]
fn campaign_run_configs() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("config.json");
    let config = |preset, scene| {
        let config = RunConfig { config: Config::preset(preset), scene, ..run_config() };
        serde_json::to_vec(&config).unwrap()
    };
    let whole =
        [config(Preset::Instant, Scene::Embedded), config(Preset::Classic, Scene::Folder("/photographs".into()))];
    std::fs::write(&file, &whole[0]).unwrap();
    assert_eq!(Run::open(folder.path()).unwrap().config, run_config());
    let parse = |bytes: &[u8]| {
        std::fs::write(&file, bytes).unwrap();
        let run = Run::open(folder.path())?;
        // Checked configurations give valid orbits.
        for camera in run.config.viewpoint.orbit(&run.config.scene_box, 3) {
            assert!(camera.width > 0 && camera.width <= 1 << 16 && camera.focal[0] > 0.0, "{camera:?}");
        }
        Ok::<(), Error>(())
    };
    // An image name takes three bytes of the document and 24 bytes of memory.
    let bound = Bound { times: 256, plus: 1 << 18 };
    campaign("run's config.json", &whole, bound, parse, |error| clear(error, "config.json"));
}

#[test]
fn campaign_viewer_messages() {
    let pose = [[1.0, 0.0, 0.0, 0.5], [0.0, 0.0, -1.0, -4.0], [0.0, 1.0, 0.0, 1.0]];
    let free = json!({ "ask": "view", "id": 7, "view": { "eye": { "free": { "pose": pose, "fov": 40.5 } },
        "size": [640, 480], "show": "normals", "background": [255, 0, 7], "crop": [[-1, -1, -1], [1, 1, 1]], "skip": "off", "checkpoint": 12 } });
    let kept = json!({ "ask": "save", "view": { "eye": { "photograph": 3 }, "size": [8, 8] } });
    let video = json!({ "ask": "video", "path": { "render_width": 64, "render_height": 48, "seconds": 1.5, "fps": 25 }, "skip": "fast" });
    let others = [
        video,
        json!({ "ask": "share", "share": 0.3 }),
        json!({ "ask": "stop" }),
        json!({ "ask": "pause", "pause": true }),
    ];
    let whole: Vec<Vec<u8>> =
        [free, kept].iter().chain(&others).map(|message| message.to_string().into_bytes()).collect();
    let parse = |bytes: &[u8]| {
        // The server closes the connection for messages that are not text.
        let ask = ClientMessage::read(std::str::from_utf8(bytes).map_err(|e| e.to_string())?)?;
        if let ClientMessage::View { view, .. } | ClientMessage::Save { view } = &ask {
            let [width, height] = view.size.map(|side| side as usize);
            assert!((1..=1 << 22).contains(&(width * height)), "{width} {height}");
            if let Eye::Free { pose, fov } = &view.eye {
                let camera = View::camera(pose, *fov, [width, height]);
                assert!(camera.pose.is_finite() && camera.focal[0] > 0.0 && camera.focal[0].is_finite(), "{camera:?}");
            }
        }
        Ok::<(), String>(())
    };
    campaign("page's message", &whole, Bound { times: 64, plus: 1 << 14 }, parse, |error| clear(error, ""));
}

#[test]
fn campaign_checkpoints() {
    let path = Path::new("00000007.checkpoint");
    let whole = [checkpoint::framed(b"a state of some length"), checkpoint::framed(&[])];
    let parse = |bytes: &[u8]| checkpoint::parse(path, bytes.to_vec()).map(drop);
    let bound = Bound { times: 4, plus: 1 << 14 };
    campaign("checkpoint", &whole, bound, parse, |error| clear(error, "00000007.checkpoint"));
    for length in [u64::MAX, 1 << 63, (1 << 63) - 1, 1 << 60, 1 << 32, 23] {
        let announced = format!("raygrad checkpoint 1 00000000 {length}\na state of some length");
        let (result, taken) = peak(|| parse(announced.as_bytes()));
        clear(result.unwrap_err(), "00000007.checkpoint");
        assert!(taken < 1 << 14, "{length}: {taken} bytes of memory");
    }
}

/// A parser of a file in a new folder.
fn from_file<T, E>(name: &str, parse: impl Fn(&Path) -> Result<T, E>) -> impl Fn(&[u8]) -> Result<T, E> {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join(name);
    move |bytes: &[u8]| {
        std::fs::write(&file, bytes).unwrap();
        // The folder lives as long as its parser.
        assert!(file.starts_with(folder.path()));
        parse(&file)
    }
}

#[test]
fn campaign_camera_paths() {
    let pose = [1.0, 0.0, 0.0, 0.5, 0.0, 0.0, -1.0, -4.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let key = json!({ "matrix": pose, "fov": 50.5, "aspect": 1, "override_transition_enabled": true,
        "override_transition_sec": 1.5 });
    let frames = json!({ "camera_type": "perspective", "render_height": 48, "render_width": 64, "fps": 24, "seconds": 2.5,
        "coordinates": "capture", "camera_path": [{ "camera_to_world": pose, "fov": 50.5, "aspect": 1 }, { "camera_to_world": pose, "fov": 60 }] });
    let keys = json!({ "render_height": 48, "render_width": 64, "coordinates": "capture", "is_cycle": true,
        "default_transition_sec": 2, "keyframes": [key, key, key] });
    let ngp = json!({ "loop": true, "time": 0.5, "path": [
        { "R": [0.1, 0.2, 0.3, 0.9], "T": [0.5, 0.4, 0.3], "fov": 50.5, "dof": 0, "scale": 1, "slice": 0 },
        { "R": [0.1, 0.2, -0.3, 0.9], "T": [0.5, 0.6, 0.3], "fov": 40, "dof": 0, "scale": 1, "slice": 0 }] });
    let whole: Vec<Vec<u8>> = [frames, keys, ngp].iter().map(|path| path.to_string().into_bytes()).collect();
    let parse = from_file("path.json", |file| {
        let path = path_file::read(file, None, || Ok(DAffine3::IDENTITY))?;
        let cameras = match path.motion {
            Motion::Frames(keys) => keys,
            Motion::Keys { path, .. } => path.frames(5),
        };
        for camera in cameras.iter().map(|key| key.camera(path.size.unwrap_or([8, 6]))) {
            assert!(camera.pose.is_finite() && camera.focal[0] > 0.0 && camera.focal[0].is_finite(), "{camera:?}");
        }
        Ok::<(), Error>(())
    });
    campaign("camera path", &whole, Bound { times: 64, plus: 1 << 16 }, parse, |error| clear(error, "path.json"));
}

#[test]
fn campaign_eval_results() {
    let long = "a".repeat(300);
    let whole = [
        json!({ "psnr_mean": 31.5, "ssim_mean": 0.9, "scene": "x", "model": { "seed": 4, "budget": { "steps": 9 } },
            "per_view": [{ "name": "b", "psnr": 1 }, { "name": "a" }] }),
        // Long names of nested values.
        json!({ "psnr_mean": 3, &*long: { &*long: { "a": 1, "b": 2, "c": 3, "d": 4, "e": 5, "f": 6 } } }),
    ];
    let whole = whole.map(|result| result.to_string().into_bytes());
    let parse = from_file("eval-test.json", |file| compare::read(file).map(drop));
    campaign("eval result", &whole, Bound { times: 64, plus: 1 << 16 }, parse, |error| clear(error, "eval-test.json"));
}

#[test]
fn names_of_nested_values_take_linear_memory() {
    let mut inner = json!(1);
    for depth in 0..60 {
        inner = json!({ format!("{depth:0500}"): inner });
    }
    let leaves: serde_json::Map<String, Value> = (0..2000).map(|i| (i.to_string(), json!(0))).collect();
    let mut deep = Value::Object(leaves);
    for depth in 0..60 {
        deep = json!({ format!("{depth:0500}"): deep });
    }
    let bytes = json!({ "psnr_mean": 1, "inner": inner, "deep": deep }).to_string();
    let parse = from_file("eval-test.json", |file| compare::read(file).map(drop));
    let (result, taken) = peak(|| parse(bytes.as_bytes()));
    result.unwrap();
    assert!(taken < 64 * bytes.len(), "{taken} bytes of memory for {}", bytes.len());
}

#[test]
fn campaign_records_of_shards() {
    let inputs = json!({ "arguments": { "run": "/runs/a", "size": [64, 48] }, "of": { "model": "0a1b2c3d" } });
    let record = json!({
        "command": "render", "inputs": inputs, "items": 20, "shards": 3, "done": 5, "own": { "strange": true },
    });
    let parse = from_file("shard-2.json", |file| shard::read(file, 2).map(drop));
    let bound = Bound { times: 64, plus: 1 << 16 };
    campaign("record of a shard", &[record.to_string().into_bytes()], bound, parse, |error| {
        clear(error, "shard-2.json")
    });
}

#[test]
fn campaign_records_of_frames() {
    let of = json!({ "run": "/runs/a", "model": "0a1b2c3d", "frames": 20, "size": [64, 48] });
    let whole =
        [json!({ "of": of, "job": "raygrad-render-83a9722", "done": 7, "strange": true }).to_string().into_bytes()];
    let parse = from_file("unfinished.json", |file| {
        frames::record(file.parent().unwrap()).map(drop).ok_or_else(|| "another record".to_owned())
    });
    campaign("record of frames", &whole, Bound { times: 64, plus: 1 << 16 }, parse, |_| {});
}
