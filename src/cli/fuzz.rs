//! What the command line reads, on damaged input: an error, and never a panic.

use super::cameras::Viewpoint;
use super::parse;
use super::run::{Run, RunConfig};
use super::scene::Scene;
use super::train::changed;
use damage::{clear, damage, damaged};
use proptest::prelude::*;
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::{Config, Extent, Preset};
use serde_json::Value;

#[path = "../../tests/stability/damage.rs"]
mod damage;

pub fn run_config() -> RunConfig {
    RunConfig {
        budget: None,
        photographs: vec!["train/0".into()],
        raygrad: "0.1.0".into(),
        scene: Scene::Embedded,
        downscale: 1,
        extent: Extent::new([DVec3::NEG_ONE, DVec3::ONE], [2.0, 6.0]),
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

/// Values as somebody may type them.
fn typed() -> impl Strategy<Value = String> {
    let numbers = any::<f64>().prop_map(|x| x.to_string());
    let words =
        ["", "null", "true", "[]", "{}", "-0", "1e999", "18446744073709551616", "\"mse\"", "voxel", "[1,2]", "0x1"];
    prop_oneof![3 => "\\PC{0,12}", 3 => numbers, 3 => any::<i64>().prop_map(|x| x.to_string()), 3 => (0..words.len()).prop_map(move |i| words[i].to_owned())]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn run_configurations(damage in damage()) {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("config.json");
        let whole = serde_json::to_vec(&run_config()).unwrap();
        std::fs::write(&file, &whole).unwrap();
        prop_assert_eq!(Run::open(folder.path()).unwrap().config, run_config());
        std::fs::write(&file, damaged(&whole, &damage)).unwrap();
        match Run::open(folder.path()) {
            // The path of the camera, for whatever has passed the checks.
            Ok(run) => for camera in run.config.viewpoint.orbit(&run.config.extent, 3) {
                prop_assert!(camera.width > 0 && camera.width <= 1 << 16 && camera.focal[0] > 0.0, "{:?}", camera);
            },
            Err(error) => clear(error, "config.json"),
        }
    }

    #[test]
    fn settings(text in "\\PC{0,20}", which in any::<prop::sample::Index>(), typed in typed()) {
        let config = run_config().config;
        let mut all = vec![];
        names(&serde_json::to_value(&config).unwrap(), "", &mut all);
        for text in [text, format!("{}={typed}", which.get(&all))] {
            let Ok((name, value)) = parse::setting(&text) else { continue };
            match changed(&config, &name, &value).and_then(|config| config.check()) {
                Ok(()) => {}
                // What is out of range is named by its last part.
                Err(error) => clear(error, "`"),
            }
        }
    }

    #[test]
    fn durations_and_sizes(text in "\\PC{0,12}", number in any::<f64>(), unit in "[smhx]?", [a, b] in any::<[u64; 2]>()) {
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
