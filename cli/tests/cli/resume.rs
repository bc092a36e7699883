//! Interrupted runs, and resuming them.

use super::{PLAIN, Place, SMALL};
use serde_json::Value;
use std::fs::File;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// The lines of a run's metrics without times.
fn metrics(place: &Place, run: &str) -> Vec<Value> {
    let text = String::from_utf8(place.bytes(&format!("{run}/metrics.jsonl"))).unwrap();
    let line = |line: &str| {
        let mut value: Value = serde_json::from_str(line).unwrap();
        value.as_object_mut().unwrap().remove("train_seconds");
        value
    };
    text.lines().map(line).collect()
}

/// The checkpoints of a run, the earliest first.
fn checkpoints(place: &Place, run: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(place.path(&format!("{run}/checkpoints"))).unwrap();
    let mut found: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    found.sort();
    found
}

pub fn assert_same(place: &Place, a: &str, b: &str) {
    let model = |run: &str| place.bytes(&format!("{run}/model.safetensors"));
    assert!(model(a) == model(b), "the models of {a} and {b} differ");
    assert_eq!(metrics(place, a), metrics(place, b));
}

/// `KILLS=50 cargo test --release --test cli killed` kills a run 50 times.
#[test]
fn killed_run_ends_as_if_undisturbed() {
    let kills: u32 = std::env::var("KILLS").map_or(4, |kills| kills.parse().unwrap());
    let place = Place::with_scene();
    let steps = 30 * kills.max(4);
    let start = Instant::now();
    place.succeeds(&format!("train scene --steps {steps} --out whole {SMALL}"));
    let whole = start.elapsed();
    let (mut killed, mut at) = (0, vec![]);
    let mut arguments = format!("train scene --steps {steps} --out run --checkpoint-every 0.02s {SMALL}");
    loop {
        let mut child = place.command(&arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        // At a varying point of the remaining time, by the golden ratio. The last run is not killed.
        let share = (f64::from(killed) * 0.618).fract();
        let until = Instant::now() + whole.mul_f64(0.1 + 0.9 * share) / kills.max(4) * 2;
        while child.try_wait().unwrap().is_none() && (killed >= kills || Instant::now() < until) {
            std::thread::sleep(Duration::from_millis(1));
        }
        if let Some(status) = child.try_wait().unwrap() {
            assert!(status.success());
            break;
        }
        child.kill().unwrap();
        child.wait().unwrap();
        killed += 1;
        if place.path("run/config.json").exists() {
            arguments = "train --resume run --checkpoint-every 0.02s".to_owned();
            let found = if place.path("run/checkpoints").exists() { checkpoints(&place, "run") } else { vec![] };
            at.push(found.into_iter().rfind(|path| path.extension().is_some_and(|e| e == "checkpoint")));
        }
    }
    println!("{killed} kills, after {at:?}");
    assert!(killed > 0, "it was too quick to be killed");
    assert_same(&place, "whole", "run");
    assert_eq!(checkpoints(&place, "run").len(), 2, "what was about to be written is swept away");
}

#[test]
fn interrupted_run_names_resume_and_can_be_extended() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 200 --out whole {SMALL}"));
    let arguments = format!("train scene --steps 200 --out run {SMALL}");
    let mut child = place.command(&arguments).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    // Two lines: training has begun and makes steps.
    let lines = || std::fs::read(place.path("run/metrics.jsonl")).map_or(0, |text| text.split(|b| *b == b'\n').count());
    super::wait(&mut child, || lines() > 2);
    Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap();
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    if output.status.code() == Some(130) {
        assert!(said.contains("resume   raygrad train --resume run\n"), "{said}");
        assert_eq!(checkpoints(&place, "run").len(), 2, "of the beginning and the end: a minute has not passed");
        let said = place.succeeds("train --resume run");
        assert!(said.contains("resumed  at step ") && !said.contains("resumed  at step 0\n"), "{said}");
    }
    assert_same(&place, "whole", "run");
    // Resuming a finished run is not an error. It names the program that resumed it.
    let config = String::from_utf8(place.bytes("run/config.json")).unwrap();
    let own = format!("\"raygrad\": \"{}\"", env!("CARGO_PKG_VERSION"));
    assert!(config.contains(&own));
    std::fs::write(place.path("run/config.json"), config.replace(&own, "\"raygrad\": \"0.0.1\"")).unwrap();
    place.succeeds("train --resume run");
    assert_eq!(place.json("run/config.json")["raygrad"], env!("CARGO_PKG_VERSION"));
    assert_same(&place, "whole", "run");
    let kept = |place: &Place| place.json("run/config.json")["keep_checkpoints"].clone();
    assert_eq!(kept(&place), 2);
    let said = place.succeeds("train --resume run --steps 220 --keep-checkpoints 3");
    assert_eq!((kept(&place), checkpoints(&place, "run").len()), (3.into(), 3));
    assert!(said.contains("resumed  at step 200\n") && said.contains("trained  220 steps"), "{said}");
    assert_eq!(metrics(&place, "run").last().unwrap()["step"], 220);
    assert_eq!(metrics(&place, "run")[..21], metrics(&place, "whole")[..]);
    assert_eq!(place.json("run/config.json")["budget"]["steps"], 220);
    // The number stays from then on. At least two checkpoints must stay.
    place.succeeds("train --resume run --steps 221");
    assert_eq!((kept(&place), checkpoints(&place, "run").len()), (3.into(), 3));
    for (number, goes) in [(2, true), (16384, true), (0, false), (1, false), (16385, false)] {
        let mut config = place.json("run/config.json");
        config["keep_checkpoints"] = number.into();
        std::fs::write(place.path("run/config.json"), config.to_string()).unwrap();
        match goes {
            true => drop(place.succeeds("train --resume run")),
            false => place.fails("train --resume run", &["config.json", "`keep_checkpoints`", "2 to 16384"]),
        }
    }
}

#[test]
fn damaged_checkpoint_falls_back_to_the_previous() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 30 --out whole {SMALL}"));
    place.succeeds(&format!("train scene --steps 30 --out run --checkpoint-every 0.001s {SMALL}"));
    let last = checkpoints(&place, "run").pop().unwrap();
    let bytes = std::fs::read(&last).unwrap();
    std::fs::write(&last, &bytes[..bytes.len() - 1]).unwrap();
    std::fs::write(place.path("run/checkpoints/.raygrad-tmp-123"), b"half").unwrap();
    let [old, new] = [".raygrad-tmp-456", ".raygrad-tmp-789"].map(|name| place.path("run").join(name));
    for folder in [&old, &new] {
        std::fs::create_dir(folder).unwrap();
        std::fs::write(folder.join("video"), b"half").unwrap();
    }
    // The lock of a killed program is free. A folder without a lock is not raygrad's.
    let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    std::fs::write(old.join(".raygrad-lock"), boot.trim()).unwrap();
    // Files of others.
    std::fs::write(place.path("run/.tmp-notes"), b"mine").unwrap();
    let output = place.command("train --resume run").output().unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(
        output.status.success() && message.contains("warning: ") && message.contains("damaged: it has"),
        "{message}"
    );
    assert!(String::from_utf8(output.stdout).unwrap().contains("resumed  at step 29\n"));
    assert_same(&place, "whole", "run");
    assert!(!place.path("run/checkpoints/.raygrad-tmp-123").exists());
    assert!((!old.exists() || boot.is_empty()) && new.exists() && place.path("run/.tmp-notes").exists());
    // An unreadable checkpoint is not skipped: it may be valid.
    std::fs::create_dir(place.path("run/checkpoints/00000089.checkpoint")).unwrap();
    place.fails(
        "train --resume run",
        &["00000089.checkpoint: cannot be read", "delete it to resume from the checkpoint before it"],
    );
    std::fs::remove_dir(place.path("run/checkpoints/00000089.checkpoint")).unwrap();
    // A damaged later checkpoint does not displace a valid one.
    std::fs::write(place.path("run/checkpoints/00000090.checkpoint"), b"").unwrap();
    let output = place.command("train --resume run --steps 31").output().unwrap();
    assert!(output.status.success() && String::from_utf8(output.stdout).unwrap().contains("resumed  at step 30\n"));
    assert_eq!(
        checkpoints(&place, "run"),
        [&last, &place.path("run/checkpoints/00000031.checkpoint")].map(Clone::clone)
    );
    place.succeeds("train --resume run --steps 32");
    let [before, last] = checkpoints(&place, "run").try_into().unwrap();
    // Incomplete metrics lines are rewritten.
    let mut text = place.bytes("run/metrics.jsonl");
    text.truncate(text.len() - 5);
    std::fs::write(place.path("run/metrics.jsonl"), text).unwrap();
    for path in [&before, &last] {
        let mut bytes = std::fs::read(path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 4;
        std::fs::write(path, bytes).unwrap();
    }
    let model = place.bytes("run/model.safetensors");
    let output = place.command("train --resume run").output().unwrap();
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(
        output.status.code() == Some(1) && message.contains("checkpoints: every checkpoint is damaged"),
        "{message}"
    );
    assert_eq!(message.matches("its checksum does not match").count(), 2, "{message}");
    assert!(place.bytes("run/model.safetensors") == model, "nothing is lost");
    // Runs of earlier versions are not started again.
    std::fs::remove_dir_all(place.path("run/checkpoints")).unwrap();
    place.fails_with(
        "train --resume run",
        "run: has no checkpoints, like runs of earlier versions, and cannot resume: train a new run",
    );
    assert!(place.bytes("run/model.safetensors") == model);
    // A run that was killed before its first step starts again.
    std::fs::remove_file(place.path("run/metrics.jsonl")).unwrap();
    assert!(place.succeeds("train --resume run").contains("resumed  at step 0\n"));
    place.succeeds(&format!("train scene --steps 32 --out other {SMALL}"));
    assert_same(&place, "other", "run");
}

#[test]
fn write_failures_do_not_end_a_run() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 150 --out whole {SMALL}"));
    let arguments = format!("train scene --steps 150 --out run --checkpoint-every 0.01s {SMALL}");
    let lost_its_folder = || {
        let mut child = place.command(&arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let begun = || std::fs::metadata(place.path("run/metrics.jsonl")).is_ok_and(|file| file.len() > 0);
        super::wait(&mut child, begun);
        // Repeatedly, since the program recreates it for each checkpoint.
        while std::fs::remove_dir_all(place.path("run")).is_err() {}
        let output = child.wait_with_output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{said}");
        // On a busy machine the last checkpoint may have been written before.
        said.contains("training continues").then_some((said, output.stdout))
    };
    let (said, shown) = (0..9).find_map(|_| lost_its_folder()).expect("it ended too soon nine times");
    let is_same = place.bytes("run/model.safetensors") == place.bytes("whole/model.safetensors");
    assert!(is_same, "{said}{}{}", String::from_utf8_lossy(&shown), place.json("run/summary.json"));
    place.succeeds("eval run --views 1");
}

#[test]
fn resume_needs_the_lock_and_the_training_images() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 2 --out run --near 2.5 {SMALL}"));
    let lock = File::options().write(true).open(place.path("run/lock")).unwrap();
    lock.lock().unwrap();
    place.fails_with("train --resume run", "run: another raygrad is training it: wait until it ends");
    drop(lock);
    place.succeeds("train --resume run --steps 4");
    assert_eq!(place.json("run/config.json")["scene_box"]["near_far"][0], 2.5);
    // A folder without a finished file may become a run.
    std::fs::create_dir(place.path("begun")).unwrap();
    std::fs::write(place.path("begun/.raygrad-tmp-x1"), b"{").unwrap();
    place.succeeds(&format!("train scene --steps 1 --out begun {SMALL}"));
    place.fails_with("train --resume absent", "absent: there is no such folder");
    for flag in ["scene --resume run", "--resume run --seed 3", "--resume run --set seed=3", "--resume run --out other"]
    {
        assert_eq!(place.command(&format!("train {flag}")).output().unwrap().status.code(), Some(2), "{flag}");
    }
    let mut config = place.json("run/config.json");
    config["budget"] = Value::Null;
    std::fs::write(place.path("run/config.json"), config.to_string()).unwrap();
    place.fails_with("train --resume run", "`budget`: the run has none: add --budget or --steps");
    config["images"][0] = "other".into();
    std::fs::write(place.path("run/config.json"), config.to_string()).unwrap();
    place.fails("train --resume run --steps 5", &["run: ", "other images"]);
}

#[test]
fn runs_resume_with_images_that_moved_and_totals_from_their_start() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 3 --out run {SMALL}"));
    std::fs::rename(place.path("scene"), place.path("moved")).unwrap();
    place.fails("train --resume run --steps 4", &["the run's images are no longer here", "with --scene"]);
    let said = place.succeeds("train --resume run --scene moved --steps 4");
    assert!(said.contains("resumed  at step 3\n") && said.contains("trained  4 steps"), "{said}");
    let folder = place.json("run/config.json")["scene"]["folder"].clone();
    assert!(folder.as_str().unwrap().ends_with("moved"), "{folder}");
    place.fails("train moved --scene moved", &["`scene`: is for --resume"]);
    // Two more steps are meant; the total stays.
    let said = place.succeeds("train --resume run --steps 2");
    assert!(said.contains("at step 4, and the total that was given is not beyond it"), "{said}");
    assert_eq!(place.json("run/config.json")["budget"]["steps"], 4);
    // The checkpoints of a changed configuration are not damaged.
    let config = String::from_utf8(place.bytes("run/config.json")).unwrap();
    std::fs::write(place.path("run/config.json"), config.replacen("\"seed\": 0", "\"seed\": 9", 1)).unwrap();
    place.fails("train --resume run --steps 5", &["The checkpoint is intact. If config.json was changed, restore"]);
    std::fs::write(place.path("run/config.json"), config).unwrap();
    // An evaluation states the steps of the model, although training was killed later.
    let mut metrics = place.bytes("run/metrics.jsonl");
    let last = metrics.split(|byte| *byte == b'\n').rfind(|line| !line.is_empty()).unwrap().to_vec();
    let mut later: Value = serde_json::from_slice(&last).unwrap();
    later["step"] = 900.into();
    metrics.extend(format!("{later}\n").bytes());
    std::fs::write(place.path("run/metrics.jsonl"), metrics).unwrap();
    let result: Value = serde_json::from_str(&place.succeeds("eval run --views 1 --json")).unwrap();
    assert_eq!(result["model"]["steps"], 4);
    // Before the first checkpoint there is no model.
    std::fs::remove_file(place.path("run/model.safetensors")).unwrap();
    place.fails("render run --out x.png", &["run: has no model.safetensors; `raygrad train --resume run` writes it"]);
}

/// A run that ended after 20 steps, in the first version with checkpoints. All later versions must resume it.
#[test]
fn checkpoint_of_first_version_resumes() {
    let place = Place::empty();
    let stored = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/reference/run-checkpoint-1");
    std::fs::create_dir_all(place.path("run/checkpoints")).unwrap();
    for name in ["config.json", "model.safetensors", "metrics.jsonl", "checkpoints/00000020.checkpoint"] {
        std::fs::copy(stored.join(name), place.path(&format!("run/{name}"))).unwrap();
    }
    let before = metrics(&place, "run");
    let printed = place.succeeds("train --resume run --steps 40");
    assert!(printed.contains("resumed  at step 20"), "{printed}");
    let after = metrics(&place, "run");
    assert_eq!(after[..before.len()], before, "what was known stays");
    let [first, last] = [&before[0], after.last().unwrap()].map(|line| line["loss"].as_f64().unwrap());
    assert!(last < 0.75 * first && after.last().unwrap()["step"] == 40, "{first} {last}");
    // It did not start again: its counts continue.
    assert!(after.last().unwrap()["rays"].as_f64().unwrap() > 1.5 * before.last().unwrap()["rays"].as_f64().unwrap());
    // Checkpoints of a later raygrad are errors.
    let path = place.path("run/checkpoints/00000040.checkpoint");
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, [b"raygrad checkpoint 2", &bytes[20..]].concat()).unwrap();
    // Nor is it skipped for the earlier valid one.
    assert!(place.path("run/checkpoints/00000020.checkpoint").exists());
    let (succeeds, said) = complaints(&place, "train --resume run --steps 50");
    assert!(
        !succeeds
            && said.contains("has format version 2, and this raygrad reads up to 1: use the raygrad that wrote it"),
        "{said}"
    );
    assert!(!said.contains("warning") && path.exists(), "{said}");
    let mut config = place.json("run/config.json");
    (config["raygrad"], config["extra"]) = ("99.0.0".into(), 1.into());
    std::fs::write(place.path("run/config.json"), config.to_string()).unwrap();
    place.fails("eval run", &["run/config.json: raygrad 99.0.0 wrote it", "use 99.0.0 or newer"]);
}

/// The standard error of a run, and whether it succeeded.
fn complaints(place: &Place, arguments: &str) -> (bool, String) {
    let output = place.command(arguments).output().unwrap();
    assert!(output.status.success() || output.status.code() == Some(1), "{output:?}");
    (output.status.success(), String::from_utf8(output.stderr).unwrap())
}

#[test]
fn diverged_run_returns_at_a_lower_lr() {
    let place = Place::empty();
    let (succeeds, said) = complaints(
        &place,
        &format!(
            "train --downscale 10 --steps 120 --out run --tensorboard {SMALL} {PLAIN} --set schedule.linear.from=3e7"
        ),
    );
    assert!(succeeds && said.contains("recorded at nerf/src/field/instant.rs:"), "{said}");
    let retreats = said.matches("resuming from step 0 with 0.25 times the learning rate").count() as i32;
    assert!((1..=3).contains(&retreats) && !said.contains("training diverged: "), "{said}");
    // Each retreat starts an event file, which makes TensorBoard drop the later steps.
    let events = std::fs::read_dir(place.path("run/tensorboard")).unwrap().count() as i32;
    assert!(events == retreats + 1 && place.json("run/summary.json")["retreats"] == retreats, "{events}");
    // Each begins with a version record, then one with its first step: a time and, in one byte, the number 1.
    for file in std::fs::read_dir(place.path("run/tensorboard")).unwrap() {
        let bytes = std::fs::read(file.unwrap().path()).unwrap();
        let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        let start = &bytes[length + 16..][12..];
        assert_eq!([start[0], start[9], start[10]], [0x09, 0x10, 1], "{:x?}", &start[..11]);
    }
    // The metrics are those of a single run at the last learning rate.
    let metrics = metrics(&place, "run");
    let steps: Vec<u64> = metrics.iter().map(|line| line["step"].as_u64().unwrap()).collect();
    assert_eq!(steps, [1, 10, 20, 30, 40, 50, 60, 70, 80, 90, 100, 110, 120]);
    let config: Value = serde_json::from_slice(&place.bytes("run/config.json")).unwrap();
    let schedule = &config["config"]["schedule"]["linear"];
    let [from, to, warmup] = ["from", "to", "warmup"].map(|name| schedule[name].as_f64().unwrap());
    for line in &metrics {
        let done = (line["step"].as_f64().unwrap() - 1.0) / 120.0;
        let rate = (done / warmup).min(1.0) * (from + (to - from) * done) * 0.25_f64.powi(retreats);
        assert!((line["lr"].as_f64().unwrap() - rate).abs() <= 1e-9 * rate, "{line}: {rate}");
    }
    // Resuming keeps the lower learning rate.
    let rate = metrics.last().unwrap()["lr"].as_f64().unwrap();
    place.succeeds("train --resume run --steps 121");
    let last = self::metrics(&place, "run").pop().unwrap();
    assert!(last["step"] == 121 && (last["lr"].as_f64().unwrap() / rate - 1.0).abs() < 0.2, "{last} after {rate}");
}

#[test]
fn run_diverging_again_ends_with_last_good_model() {
    let place = Place::empty();
    // It learns until the learning rate is too large. Whether numbers overflow then, or all units rest, depends on the
    // seed. With this one they overflow early: there is room for 100 steps without a finite value, four times.
    let schedule = r#"{"exponential":{"from":0.0001,"to":1e30,"warmup":0.0}}"#;
    let rates = format!("--set schedule={schedule} --checkpoint-every 0.02s");
    let output = place
        .command(&format!("train --downscale 10 --steps 400 --seed 4 --out run {SMALL} {PLAIN} {rates}"))
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let [printed, said] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    assert!(!printed.contains("raygrad render"), "{printed}");
    assert_eq!(said.matches("with 0.25 times the learning rate").count(), 3, "{said}");
    let end = said.split("training diverged: ").nth(1).unwrap();
    assert!(end.contains("recorded at nerf/src/") && end.contains("schedule.exponential.from"), "{end}");
    let step: u64 =
        end.split("the saved model is from step ").nth(1).unwrap().split(';').next().unwrap().parse().unwrap();
    let kept = checkpoints(&place, "run");
    assert!(step > 0 && kept.last().unwrap().ends_with(format!("{step:08}.checkpoint")), "{step} {kept:?}");
    // No metrics of later steps remain.
    assert!(metrics(&place, "run").iter().all(|line| line["step"].as_u64().unwrap() <= step));
    // The model is the one before the overflow.
    let left = place.bytes("run/model.safetensors");
    place.succeeds(&format!("train --resume run --steps {step}"));
    assert!(place.bytes("run/model.safetensors") == left);
    place.succeeds("eval run --views 1");
}
