//! Property tests of inputs of the command line: damaged input gives an error, never a panic.

use std::path::Path;

use super::cameras::Viewpoint;
use super::checkpoint;
use super::parse;
use super::run::{Run, RunConfig};
use super::scene::Scene;
use super::train::changed;
use super::view::messages::{ClientMessage, Eye, View};
use proptest::prelude::*;
use raygrad::nerf::glam::DVec3;
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
