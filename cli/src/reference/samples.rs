//! Sample configurations of runs, and their keys by path.

use std::collections::BTreeMap;

use glam::{DMat3, DVec2, DVec3};
use raygrad::nerf::{Config, Ndc, Preset};
use serde_json::{Value, json};

use crate::run::RunConfig;

/// Origin of a sample configuration.
#[derive(Clone, Copy, PartialEq)]
pub enum Origin {
    Preset(&'static str),
    /// A file with the required keys only.
    Minimal,
    /// A file with all keys.
    Full,
    /// The keys that a minimal file lacks.
    Absent,
}

/// Sample configurations of runs, which together have every key.
fn samples() -> Vec<(Origin, Value)> {
    let preset = |preset: Preset| serde_json::to_value(Config::preset(preset)).unwrap();
    let run = |config: Value| {
        json!({
            "raygrad": env!("CARGO_PKG_VERSION"),
            "scene": "embedded",
            "downscale": 1,
            "scene_box": {"bounds": [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], "near_far": [0.5, 6.0]},
            "viewpoint": {"width": 24, "height": 24, "angle_x": 0.7, "distance": 4.0, "elevation": 0.5},
            "config": config,
        })
    };
    let instant = preset(Preset::Instant);
    let with = |key: &str, value: Value| {
        let mut config = instant.clone();
        config[key] = value;
        run(config)
    };
    let mut samples = vec![];
    for (name, each) in
        [("classic", Preset::Classic), ("small", Preset::Small), ("instant", Preset::Instant), ("voxel", Preset::Voxel)]
    {
        samples.push((Origin::Preset(name), run(preset(each))));
    }
    let constant = json!({"constant": {"rate": 0.1}});
    for (key, value) in [
        ("sampler", json!({"kind": "proposal"})),
        ("sampler", json!({"kind": "marching"})),
        ("groups", json!([{"params": "field.", "adam": instant["adam"], "schedule": constant}])),
        ("loss_terms", json!([{"kind": "total_variation", "weight": 0.1, "params": "field.table"}])),
    ] {
        samples.push((Origin::Minimal, with(key, value)));
    }
    let ramp = json!({"from": 0.1, "to": 0.01, "warmup": 0.1});
    let step = json!({"step": {"from": 0.1, "factor": 0.5, "every": 0.1, "warmup": 0.1}});
    for schedule in [constant, step, json!({"linear": ramp}), json!({"exponential": ramp}), json!({"cosine": ramp})] {
        let group = json!([{"params": "field.", "adam": instant["adam"], "schedule": schedule}]);
        let [optics, colors] = [["focal", "lens"], ["exposure", "vignetting"]];
        let both = |[a, b]: [&str; 2]| json!({a: schedule, b: schedule});
        for (key, value) in [
            ("schedule", schedule.clone()),
            ("poses", schedule.clone()),
            ("groups", group),
            ("camera_optimizer", both(optics)),
            ("exposure_model", both(colors)),
        ] {
            samples.push((Origin::Full, with(key, value)));
        }
    }
    for kind in ["distortion", "entropy", "orientation", "depth"] {
        samples.push((Origin::Full, with("loss_terms", json!([{"kind": kind, "weight": 0.1}]))));
    }
    samples.push((Origin::Full, with("loss", json!({"huber": {"delta": 0.1}}))));
    let adaptive = json!({"kind": "marching", "quadrature": {"adaptive": {"tolerance": 1e-3}}, "last_step": 0.002});
    samples.push((Origin::Full, with("sampler", adaptive)));
    let slopes = DVec2::ONE.to_array();
    let ndc = Ndc { eye: DVec3::ZERO, axes: DMat3::IDENTITY, slopes, near: 1.0 };
    for (key, value) in [
        ("scene", json!({"folder": "my-scene"})),
        ("budget", json!({"steps": 5000})),
        ("budget", json!({"seconds": 60.0})),
        ("scene_box", json!({"bounds": [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], "near_far": [0.5, 6.0], "ndc": ndc})),
    ] {
        let mut sample = run(instant.clone());
        sample[key] = value;
        samples.push((Origin::Full, sample));
    }
    samples
}

/// The values of a sample's keys by path: `config.sampler{marching}.step`, `config.groups[].params`.
pub type Keys = BTreeMap<String, Vec<Value>>;

/// Collects the keys of a value with their values.
fn walk(value: &Value, path: &str, keys: &mut Keys) {
    match value {
        Value::Object(fields) => {
            let kind = fields.get("kind").and_then(Value::as_str).map(|kind| format!("{{{kind}}}")).unwrap_or_default();
            for (name, value) in fields.iter().filter(|(name, _)| *name != "kind") {
                let path = format!("{path}{kind}.{name}");
                walk(value, &path, keys);
                keys.entry(path).or_default().push(value.clone());
            }
        }
        Value::Array(all) => all.iter().for_each(|value| walk(value, &format!("{path}[]"), keys)),
        _ => {}
    }
}

/// The value at a path; the first element of lists.
pub fn at<'a>(value: &'a mut Value, path: &str) -> Option<&'a mut Value> {
    path.split('.').skip(1).try_fold(value, |value, part| {
        let name = part.split(['[', '{']).next()?;
        let mut value = value.get_mut(name)?;
        if part.contains("[]") {
            value = value.get_mut(0)?;
        }
        match part.split_once('{') {
            Some((_, kind)) if value["kind"] != kind.trim_end_matches('}') => None,
            _ => Some(value),
        }
    })
}

/// The samples and their keys.
pub struct Samples {
    pub values: Vec<(Origin, Value)>,
    pub keys: Vec<(Origin, Keys)>,
}

impl Samples {
    pub fn new() -> Self {
        let (mut values, mut keys) = (vec![], vec![]);
        for (origin, written) in samples() {
            let read: RunConfig = serde_json::from_value(written.clone()).unwrap();
            let value = serde_json::to_value(read).unwrap();
            let (mut before, mut after) = (Keys::new(), Keys::new());
            walk(&written, "", &mut before);
            walk(&value, "", &mut after);
            if origin == Origin::Minimal {
                keys.push((
                    Origin::Absent,
                    after.clone().into_iter().filter(|(path, _)| !before.contains_key(path)).collect(),
                ));
            }
            keys.push((origin, after));
            values.push((origin, value));
        }
        Samples { values, keys }
    }

    /// Returns true if presets have the key or a file may omit it.
    pub fn has_default(&self, path: &str) -> bool {
        let is_said = |origin: &Origin| matches!(origin, Origin::Preset(_) | Origin::Absent);
        self.keys.iter().any(|(origin, keys)| is_said(origin) && keys.contains_key(path))
    }
}
