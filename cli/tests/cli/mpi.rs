//! Ranks of an MPI job, with the feature `mpi`. They need `mpirun` of Open MPI.

use super::{Place, SMALL, files_below, wait};
use std::process::{Child, Command, Output, Stdio};

/// A command on several ranks.
fn on_ranks(place: &Place, ranks: usize, arguments: &str) -> Command {
    let mut command = Command::new("mpirun");
    command.args(["--allow-run-as-root", "--oversubscribe", "--bind-to", "none", "-n", &ranks.to_string()]);
    command.arg(env!("CARGO_BIN_EXE_raygrad")).args(arguments.split_whitespace()).current_dir(place.path(""));
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// What a command printed, on all ranks together.
#[track_caller]
fn succeeds(place: &Place, ranks: usize, arguments: &str) -> String {
    let output = on_ranks(place, ranks, arguments).output().expect("mpirun of Open MPI is needed");
    assert!(output.status.success(), "{ranks} ranks, {arguments}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The process of a rank.
fn process(job: &Child, rank: usize) -> Option<String> {
    let children = Command::new("pgrep").args(["-P", &job.id().to_string()]).output().unwrap();
    let children = String::from_utf8(children.stdout).unwrap();
    let is_it = |process: &&str| {
        let environment = std::fs::read(format!("/proc/{process}/environ")).unwrap_or_default();
        let wanted = format!("OMPI_COMM_WORLD_RANK={rank}");
        environment.split(|byte| *byte == 0).any(|variable| variable == wanted.as_bytes())
    };
    children.lines().find(is_it).map(str::to_owned)
}

/// The steps of the checkpoints of a run.
fn checkpoints(place: &Place) -> Vec<u64> {
    let files = std::fs::read_dir(place.path("run/checkpoints")).into_iter().flatten().flatten();
    let names = files.map(|file| file.file_name().to_string_lossy().into_owned());
    names.filter_map(|name| name.strip_suffix(".checkpoint")?.parse().ok()).collect()
}

/// Starts a long training on ranks, and sends a signal to one of them when it has trained and, if it is to save
/// checkpoints every second, saved one.
fn disturbed(place: &Place, arguments: &str, rank: usize, signal: &str) -> Output {
    let mut job = on_ranks(place, 2, &format!("train scene {SMALL} --out run {arguments}")).spawn().unwrap();
    let metrics = place.path("run/metrics.jsonl");
    let saves = arguments.contains("--checkpoint-every 1s");
    wait(&mut job, || {
        let has_saved = !saves || checkpoints(place).into_iter().any(|step| step > 0);
        has_saved && std::fs::metadata(&metrics).is_ok_and(|file| file.len() > 0)
    });
    let process = process(&job, rank).unwrap();
    assert!(Command::new("kill").args([format!("-{signal}"), process]).status().unwrap().success());
    job.wait_with_output().unwrap()
}

#[test]
fn ranks_train_the_model_of_one_process() {
    let place = Place::with_scene();
    let train = |steps: usize, out: &str| format!("train scene --steps {steps} {SMALL} --out {out}");
    place.succeeds(&train(12, "one"));
    for ranks in [1, 2, 3, 4] {
        let out = format!("ranks-{ranks}");
        let printed = succeeds(&place, ranks, &train(12, &out));
        assert_eq!(printed.matches("trained  12 steps").count(), 1, "{printed}");
        assert_eq!(printed.contains(&format!("ranks    {ranks}, connected by MPI")), ranks > 1, "{printed}");
        assert!(place.bytes(&format!("{out}/model.safetensors")) == place.bytes("one/model.safetensors"), "{ranks}");
        assert_eq!(place.json(&format!("{out}/summary.json"))["ranks"], ranks);
    }
    // More steps on another number of ranks.
    succeeds(&place, 3, "train --resume ranks-2 --steps 20");
    place.succeeds("train --resume one --steps 20");
    assert!(place.bytes("ranks-2/model.safetensors") == place.bytes("one/model.safetensors"));
}

#[test]
fn ranks_share_frames_and_views() {
    let place = Place::with_run();
    let render = "render run --frames 5 --size 8x6 --save depth --out";
    place.succeeds(&format!("{render} one"));
    let printed = succeeds(&place, 3, &format!("{render} ranks"));
    assert_eq!(printed.matches("rendered 5 frames").count(), 1, "{printed}");
    assert_eq!(files_below(&place.path("ranks")), files_below(&place.path("one")));
    let measured = |printed: String| {
        let lines = printed.lines().filter(|line| line.starts_with("test/") || line.starts_with("mean"));
        lines.map(str::to_owned).collect::<Vec<_>>()
    };
    let one = measured(place.succeeds("eval run"));
    assert_eq!(measured(succeeds(&place, 2, "eval run")), one);
    assert_eq!(one.len(), 3 + 1);
    succeeds(&place, 2, "render run --frames 4 --size 8x6 --out ranks.gif");
    place.succeeds("render run --frames 4 --size 8x6 --out one.gif");
    assert_eq!(place.bytes("ranks.gif"), place.bytes("one.gif"));
    // A single image is rendered by one rank.
    succeeds(&place, 2, "render run --size 8x6 --out image.png");
}

#[test]
fn interrupted_rank_saves_the_run_of_all() {
    let place = Place::with_scene();
    // The checkpoint is that of the end.
    let output = disturbed(&place, "--budget 1h --checkpoint-every 1h", 1, "TERM");
    assert_eq!(output.status.code(), Some(130), "{output:?}");
    assert_eq!(place.json("run/summary.json")["ended"], "interrupted");
    let stopped = place.json("run/summary.json")["steps"].as_u64().unwrap();
    let printed = succeeds(&place, 2, &format!("train --resume run --steps {}", stopped + 3));
    assert!(printed.contains(&format!("resumed  at step {stopped}")), "{printed}");
}

#[test]
fn dead_and_hung_ranks_end_the_job_with_the_last_checkpoint() {
    for (signal, arguments, expected) in [
        ("KILL", "--budget 1h --checkpoint-every 1s", "signal 9"),
        ("STOP", "--budget 1h --checkpoint-every 1s --rank-timeout 3s", "rank 1 has sent nothing for 3 s"),
    ] {
        let place = Place::with_scene();
        let output = disturbed(&place, arguments, 1, signal);
        assert!(!output.status.success() && said(&output).contains(expected), "{signal}: {}", said(&output));
        let last = checkpoints(&place).into_iter().max().unwrap();
        let printed = place.succeeds("train --resume run --budget 1s");
        assert!(printed.contains(&format!("resumed  at step {last}")) && last > 0, "{printed}");
    }
}

/// The same command works when the rank has what it lacked. Ranks share a path, so one that each of them finds in its
/// own folder stands for the disks of two machines.
#[test]
fn ranks_that_cannot_begin_leave_no_run() {
    let [place, other] = [0, 1].map(|_| Place::with_scene());
    let image = std::fs::read_dir(other.path("scene/train")).unwrap().next().unwrap().unwrap().path();
    std::fs::remove_file(image).unwrap();
    let train = format!("train /proc/self/cwd/scene --steps 3 {SMALL} --out run");
    let mut ranks = Command::new("mpirun");
    ranks.args(["--allow-run-as-root", "--oversubscribe", "--bind-to", "none"]);
    for (i, place) in [&place, &other].into_iter().enumerate() {
        ranks.args(&[":", "-n", "1", "--wdir"][usize::from(i == 0)..]).arg(place.path(""));
        ranks.arg(env!("CARGO_BIN_EXE_raygrad")).args(train.split_whitespace());
    }
    let output = ranks.output().unwrap();
    assert!(!output.status.success() && said(&output).contains("raygrad: rank 1: "), "{}", said(&output));
    assert!(!place.path("run").exists());
    succeeds(&place, 2, &train);
}

#[test]
fn errors_of_a_rank_end_all() {
    let place = Place::with_scene();
    let output = on_ranks(&place, 2, "train missing --steps 3").output().unwrap();
    assert!(!output.status.success() && said(&output).contains("raygrad: rank 0: missing:"), "{}", said(&output));
    let output = on_ranks(&place, 2, "train scene --steps 3 --port 8000").output().unwrap();
    assert_eq!(said(&output).matches("--host and --port need --view").count(), 1, "{}", said(&output));
    let place = Place::with_run();
    let output = on_ranks(&place, 2, "eval run --json").output().unwrap();
    assert!(!output.status.success() && said(&output).contains("`json`: needs a single process"), "{output:?}");
}
