//! The records of a run beside its model: TensorBoard event files, a summary, an exit code.

use super::Place;
use super::SMALL;
use raygrad::nerf::dataset::Split;
use raygrad_test_support::skip::skipped;
use serde_json::{Map, Value, json};
use std::path::PathBuf;
use std::process::{Command, Stdio};

/// Prints the contents of a folder by TensorBoard's two readers: steps and values of scalars, steps and sizes of
/// images.
const READER: &str = r#"
import json, sys
from tensorboard.backend.event_processing import event_accumulator, plugin_event_accumulator
from tensorboard.util import tensor_util
every = {"scalars": 0, "images": 0, "tensors": 0}
old = event_accumulator.EventAccumulator(sys.argv[1], size_guidance=every).Reload()
new = plugin_event_accumulator.EventAccumulator(sys.argv[1], size_guidance=every).Reload()
scalars = {tag: [[e.step, e.value] for e in old.Scalars(tag)] for tag in old.Tags()["scalars"]}
images = {tag: [[e.step, e.width, e.height] for e in old.Images(tag)] for tag in old.Tags()["images"]}
tensors = {tag: [[e.step, tensor_util.make_ndarray(e.tensor_proto).tolist()] for e in new.Tensors(tag)]
           for tag in new.Tags()["tensors"] if tag in scalars}
shown = [e.step for e in new.Tensors("preview/picture")]
def known(value):
    return None if value != value else value
for tags in [scalars, tensors]:
    for tag in tags:
        tags[tag] = [[step, known(value)] for step, value in tags[tag]]
print(json.dumps({"scalars": scalars, "images": images, "tensors": tensors, "shown": shown}))
"#;

/// The Python with TensorBoard: `RAYGRAD_PYTHON`, or the installed one.
fn python() -> Option<String> {
    let python = std::env::var("RAYGRAD_PYTHON").unwrap_or_else(|_| "python3".into());
    let imported = Command::new(&python).args(["-c", "import tensorboard"]).stderr(Stdio::null()).status();
    imported.is_ok_and(|status| status.success()).then_some(python)
}

fn metrics(place: &Place, run: &str) -> Vec<Map<String, Value>> {
    let text = String::from_utf8(place.bytes(&format!("{run}/metrics.jsonl"))).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

fn event_files(place: &Place, run: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(place.path(&format!("{run}/tensorboard"))).unwrap();
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

#[test]
fn tensorboard_reads_metrics_of_a_resumed_run() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 40 --checkpoint-every 0.001s --tensorboard --out run {SMALL}"));
    assert_eq!(event_files(&place, "run").len(), 1);
    // As if it had been killed after step 39, with different later steps.
    std::fs::remove_file(place.path("run/checkpoints/00000040.checkpoint")).unwrap();
    place.succeeds("train --resume run --steps 60");
    // A run without the flag has no event files.
    assert_eq!(event_files(&place, "run").len(), 2);
    place.succeeds(&format!("train scene --steps 1 --out other {SMALL}"));
    assert!(!place.path("other/tensorboard").exists());

    let Some(python) = python() else {
        skipped("no Python has TensorBoard; name one that has in RAYGRAD_PYTHON");
        return;
    };
    let folder = place.path("run/tensorboard");
    let output = Command::new(python).args(["-c", READER]).arg(folder).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && !said.contains("Error"), "{said}");
    let read: Value = serde_json::from_slice(&output.stdout).unwrap();
    let metrics = metrics(&place, "run");
    assert_eq!(
        metrics.iter().map(|line| line["step"].as_u64().unwrap()).collect::<Vec<_>>(),
        [1, 10, 20, 30, 40, 50, 60]
    );
    let mut tags = 0;
    for name in metrics[0].keys().filter(|name| *name != "step") {
        let rounded = |value: &Value| value.as_f64().map(|value| f64::from(value as f32));
        let expected: Vec<Value> = metrics.iter().map(|line| json!([line["step"], rounded(&line[name])])).collect();
        for reader in ["scalars", "tensors"] {
            assert_eq!(read[reader][format!("train/{name}")], json!(expected), "{reader} {name}");
        }
        tags += 1;
    }
    assert_eq!(tags, 15, "all that there is in a line");
    let last = metrics.last().unwrap();
    let speed = last["rays"].as_f64().unwrap() / last["train_seconds"].as_f64().unwrap();
    let found = &read["scalars"]["train/rays_per_second"][6];
    assert!(found[0] == 60 && (found[1].as_f64().unwrap() / speed - 1.0).abs() < 1e-6, "{found} {speed}");
    // The preview at the end of the first part belongs to a step that was repeated. A slow machine writes others in
    // between.
    let pictures = read["images"]["preview/picture"].as_array().unwrap();
    assert_eq!(pictures.last(), Some(&json!([60, 48, 24])));
    let steps: Vec<u64> = pictures.iter().map(|picture| picture[0].as_u64().unwrap()).collect();
    assert!(steps.is_sorted() && !steps.contains(&40), "{steps:?}");
    assert_eq!(read["shown"], json!(steps));
    let shown = &place.json("run/summary.json")["preview"];
    let psnr = f64::from(shown["psnr"].as_f64().unwrap() as f32);
    assert_eq!(read["scalars"]["preview/psnr"].as_array().unwrap().last(), Some(&json!([60, psnr])));
}

#[test]
fn event_file_failures_do_not_end_a_run() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 10 --out run {SMALL}"));
    std::fs::write(place.path("run/tensorboard"), b"in the way").unwrap();
    let output = place.command("train --resume run --steps 20 --tensorboard").output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && said.contains("tensorboard: cannot be created"), "{said}");
    assert_eq!(metrics(&place, "run").len(), 3);
}

/// A shell that ignores SIGXFSZ makes writes fail at the size limit, as on a full disk.
#[test]
fn partial_metrics_line_is_removed() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 20 --out run {SMALL}"));
    let path = place.path("run/metrics.jsonl");
    let mut text = place.bytes("run/metrics.jsonl");
    // All but a hundred bytes of four megabytes.
    let blocks = 8192;
    let most = 512 * blocks;
    text.extend(format!("{{\"step\":20,\"more\":\"{}\"}}\n", " ".repeat(most - 100 - text.len() - 22)).bytes());
    assert_eq!(text.len(), most - 100);
    std::fs::write(&path, &text).unwrap();
    let binary = env!("CARGO_BIN_EXE_raygrad");
    let script = format!("trap '' XFSZ; ulimit -f {blocks}; exec '{binary}' train --resume run --steps 50");
    let output = Command::new("sh").args(["-c", &script]).current_dir(place.path("")).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && said.contains("metrics.jsonl: cannot be written"), "{said}");
    assert!(place.bytes("run/metrics.jsonl") == text, "whole lines alone");
}

#[test]
fn summary_has_the_end_and_cost_of_a_run() {
    let place = Place::with_scene();
    let train = format!("train scene --seed 7 --steps 30 --checkpoint-every 0.001s --threads 2 --out run {SMALL}");
    place.succeeds(&train);
    let summary = place.json("run/summary.json");
    let last = metrics(&place, "run").pop().unwrap();
    for (name, expected) in [("ended", json!("done")), ("seed", json!(7)), ("budget", json!({ "steps": 30 }))] {
        assert_eq!(summary[name], expected);
    }
    assert_eq!([&summary["steps"], &summary["resumed"], &summary["threads"]], [&json!(30), &json!(0), &json!(2)]);
    for name in ["rays", "placed_samples", "density_queries", "color_queries", "unskipped", "restarts"] {
        assert_eq!(summary[name], last[name], "{name}");
    }
    assert_eq!(summary["averaged_steps"], 30);
    let number = |summary: &Value, name: &str| summary[name].as_f64().unwrap_or(f64::NAN);
    assert!((0.001..0.5).contains(&number(&summary, "loss")) && (3.0..40.0).contains(&number(&summary, "psnr")));
    let preview = &summary["preview"];
    assert_eq!(
        [&preview["name"], &preview["held_out"], &preview["step"]],
        [&json!("val/r_0"), &json!(true), &json!(30)]
    );
    let [wall, time] = ["wall_seconds", "train_seconds"].map(|name| number(&summary, name));
    assert!(0.0 < time && time <= wall && wall < 600.0, "{time} {wall}");
    if cfg!(target_os = "linux") {
        let memory = number(&summary, "peak_memory_bytes");
        assert!((2e6..2e10).contains(&memory) && summary["processor"] != "unknown", "{summary}");
    }
    // Resumed: times and counts add up, including those of a killed part.
    place.succeeds("train --resume run --steps 50");
    let later = place.json("run/summary.json");
    assert_eq!([&later["steps"], &later["resumed"], &later["ended"]], [&json!(50), &json!(1), &json!("done")]);
    assert!(number(&later, "wall_seconds") > wall && number(&later, "train_seconds") > time, "{later}");
    assert_eq!(later["averaged_steps"], 21, "of the steps of this part, and the one that it began at");
    let mut child = place.command("train --resume run --budget 1h --checkpoint-every 0.001s");
    let mut child = child.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let steps = || place.json("run/summary.json")["steps"].as_u64().unwrap();
    super::wait(&mut child, || steps() > 50);
    child.kill().unwrap();
    child.wait().unwrap();
    let killed = place.json("run/summary.json");
    assert_eq!([&killed["ended"], &killed["resumed"]], [&Value::Null, &json!(2)]);
    // A damaged summary does not prevent resuming.
    std::fs::write(place.path("run/summary.json"), b"{").unwrap();
    place.succeeds(&format!("train --resume run --steps {}", steps_of_last_checkpoint(&place) + 1));
    assert_eq!(place.json("run/summary.json")["resumed"], 1);
    // Training that must diverge.
    let arguments = "train --downscale 10 --steps 300 --set schedule.linear.from=1e30 --set sampler.occupancy.resolution=16 --out vain";
    assert_eq!(place.command(arguments).output().unwrap().status.code(), Some(1));
    let vain = place.json("vain/summary.json");
    assert_eq!([&vain["ended"], &vain["psnr"]], [&json!("diverged"), &Value::Null]);
    assert_eq!([&vain["retreats"], &vain["steps"]], [&json!(3), &json!(0)], "its model is that of the last checkpoint");
}

fn steps_of_last_checkpoint(place: &Place) -> u64 {
    let entries = std::fs::read_dir(place.path("run/checkpoints")).unwrap();
    let step = |path: PathBuf| path.file_stem()?.to_str()?.parse().ok();
    entries.filter_map(|entry| step(entry.unwrap().path())).max().unwrap()
}

/// `doctor_exit_code_is_that_of_the_worst_finding` covers the codes of `doctor`.
#[test]
fn exit_codes_equal_the_help() {
    let place = Place::with_scene();
    let code = |arguments: &str| place.command(arguments).output().unwrap().status.code();
    let mut child = place.command(&format!("train scene --budget 1h --out long {SMALL}"));
    let mut child = child.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    super::wait(&mut child, || std::fs::metadata(place.path("long/metrics.jsonl")).is_ok_and(|file| file.len() > 0));
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    let interrupted = child.wait().unwrap().code();
    assert_eq!(place.json("long/summary.json")["ended"], "interrupted");
    let found = [code("--version"), code("eval nowhere"), code("eval --nonsense"), interrupted];
    assert_eq!(found, [Some(0), Some(1), Some(2), Some(130)]);
    let help = place.succeeds("--help");
    for line in
        ["0    success", "1    error", "2    invalid command line", "3    doctor", "4    doctor", "130  interrupted"]
    {
        assert!(help.contains(&format!("\n  {line}")), "{line}: {help}");
    }
    assert!(include_str!("../../../docs/reference/exit-codes.md").contains("\n| 130 | interrupted"));
}

/// More than 16 images, of which each has some rays in a step.
#[test]
fn check_of_poses_is_told_once_and_recorded() {
    let place = Place::with_scene();
    let mut transforms = place.transforms(Split::Train);
    let frames: Vec<Value> = vec![transforms["frames"].as_array().unwrap().clone(); 3].concat();
    transforms["frames"] = json!(frames);
    place.write_transforms(Split::Train, &transforms);
    let told = |arguments: &str| {
        let output = place.command(arguments).output().unwrap();
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stderr).unwrap().matches("poses    moved images by ").count()
    };
    assert_eq!(told(&format!("train scene --steps 130 --refine poses --out run {SMALL}")), 1);
    let summary = place.json("run/summary.json")["pose_motion"].clone();
    assert!(summary["median"].as_f64().unwrap() > 0.0 && summary["largest"].as_f64() >= summary["median"].as_f64());
    let metrics = String::from_utf8(place.bytes("run/metrics.jsonl")).unwrap();
    let last: Value = serde_json::from_str(metrics.lines().next_back().unwrap()).unwrap();
    assert_eq!(last["pose_motion"], summary);
    assert_eq!(told("train --resume run --steps 131"), 0);
    assert_eq!(place.json("run/summary.json")["pose_motion"], summary);
}
