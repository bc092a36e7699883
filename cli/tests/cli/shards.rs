//! `--shard` and `raygrad merge`: several programs, one result.

use super::{Place, files_below, png, wait};
use raygrad::nerf::Image;
use raygrad::nerf::dataset::Split;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fs::File;
use std::path::PathBuf;
use std::process::{Child, Output, Stdio};

const FOLDER: &str = "unfinished-shards";

/// The files below a folder of a place.
fn files(place: &Place, folder: &str) -> BTreeMap<PathBuf, Vec<u8>> {
    files_below(&place.path(folder))
}

fn start(place: &Place, arguments: &str) -> Child {
    place.command(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Runs a command in `count` shards at once, and returns what they printed.
fn at_once(place: &Place, command: &str, count: usize) -> Vec<String> {
    let shards: Vec<Child> = (1..=count).map(|i| start(place, &format!("{command} --shard {i}/{count}"))).collect();
    let printed = |child: Child| {
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success(), "{command}: {output:?}");
        String::from_utf8(output.stdout).unwrap()
    };
    shards.into_iter().map(printed).collect()
}

/// The record of a shard.
fn record(place: &Place, at: &str, number: usize) -> Option<Value> {
    let bytes = std::fs::read(place.path(&format!("{at}/{FOLDER}/shard-{number}.json"))).ok()?;
    Some(serde_json::from_slice(&bytes).unwrap())
}

/// Kills a command when its first shard has two complete items.
fn killed(place: &Place, command: &str, at: &str) -> u64 {
    let done = || record(place, at, 1).map_or(0, |record| record["done"].as_u64().unwrap());
    let mut child = start(place, command);
    wait(&mut child, || done() >= 2);
    child.kill().unwrap();
    child.wait().unwrap();
    done()
}

fn said(output: &Output) -> String {
    assert!(output.status.success(), "{output:?}");
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Runs the last shard while the first seems to have begun, as if the last was killed before it merged.
fn unmerged(place: &Place, command: &str, at: &str) {
    place.succeeds(&format!("{command} --shard 1/2"));
    let file = place.path(&format!("{at}/{FOLDER}/shard-1.json"));
    let mut changed = record(place, at, 1).unwrap();
    let share = changed["done"].take();
    changed["done"] = json!(0);
    std::fs::write(&file, changed.to_string()).unwrap();
    let printed = place.succeeds(&format!("{command} --shard 2/2"));
    assert_eq!(printed, format!("shard    2/2 is complete; still missing 1/2 (stopped, 0 of {share})\n"));
    changed["done"] = share;
    std::fs::write(&file, changed.to_string()).unwrap();
}

#[cfg(not(feature = "mpi"))]
#[test]
fn ranks_without_mpi_are_refused() {
    let place = Place::with_run();
    for command in ["train scene --steps 1", "render run --frames 2 --out frames", "eval run"] {
        let output = place.command(command).env("OMPI_COMM_WORLD_SIZE", "2").output().unwrap();
        let expected = ["`mpi`: ", "2 processes were started together, but this raygrad is built without MPI"];
        super::complained(command, &output, &expected);
    }
    // Launchers start job arrays and other commands too.
    for command in ["doctor scene --json", "render run --frames 2 --size 4x4 --out frames --shard 1/2"] {
        let output = place.command(command).env("PMI_SIZE", "2").output().unwrap();
        // The doctor finds few images.
        let code = if command.starts_with("doctor") { 3 } else { 0 };
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(code) && !said.contains("mpi"), "{output:?}");
    }
}

#[test]
fn render_in_shards_equals_the_whole() {
    let place = Place::with_run();
    let render = "render run --frames 7 --size 8x6 --save depth,normals --out";
    place.succeeds(&format!("{render} whole"));
    place.succeeds("render run --frames 7 --size 8x6 --out whole.gif");
    let whole = files(&place, "whole");
    assert_eq!(whole.len(), 3 * 7);
    for count in [1, 2, 5, 8] {
        let out = format!("frames-{count}");
        let printed = at_once(&place, &format!("{render} {out}"), count);
        let merged = printed.iter().filter(|text| text.starts_with("rendered 7 frames of 8x6")).count();
        assert_eq!(merged, 1, "{printed:?}");
        assert!(files(&place, &out) == whole, "{count} shards: {:?}", files(&place, &out).keys());
        // One after the other, into a video.
        let film = format!("film-{count}.gif");
        for i in 1..=count {
            assert!(!place.path(&film).exists());
            place.succeeds(&format!("render run --frames 7 --size 8x6 --out {film} --shard {i}/{count}"));
        }
        assert!(place.bytes(&film) == place.bytes("whole.gif") && !place.path(&format!("{film}.frames")).exists());
    }
    // The same command replaces its own files, with and without shards.
    at_once(&place, &format!("{render} whole"), 3);
    place.succeeds(&format!("{render} frames-5"));
    assert!(files(&place, "whole") == whole && files(&place, "frames-5") == whole);
}

#[test]
fn killed_shard_renders_the_missing_frames() {
    let place = Place::with_run();
    let render = "render run --frames 40 --size 24x18 --keep-frames --out";
    place.succeeds(&format!("{render} whole.apng"));
    let shard = format!("{render} film.apng --shard");
    let at = "film.apng.frames";
    let done = killed(&place, &format!("{shard} 1/2"), at);
    assert!((2..20).contains(&done), "{done}");
    // A frame that is there is not rendered again; one that has gone is, with all after it.
    let changed = |frame: &str| std::fs::metadata(place.path(&format!("{at}/{frame}"))).unwrap().modified().unwrap();
    let before = changed("0000.png");
    std::fs::remove_file(place.path(&format!("{at}/0002.png"))).unwrap();
    std::fs::write(place.path(&format!("{at}/{FOLDER}/shard-1.part")), b"half").unwrap();
    place.succeeds(&format!("{shard} 2/2"));
    let output = place.command(&format!("{shard} 1/2")).output().unwrap();
    assert!(said(&output).starts_with(&format!("resuming after 1 of 20 frames: {at}\n")), "{output:?}");
    assert_eq!(changed("0000.png"), before);
    assert!(
        files(&place, at) == files(&place, "whole.apng.frames")
            && place.bytes("film.apng") == place.bytes("whole.apng")
    );
    assert!(
        place.path("").read_dir().unwrap().all(|entry| !entry.unwrap().file_name().to_string_lossy().starts_with('.'))
    );
}

#[test]
fn shard_of_another_job_is_refused() {
    let place = Place::with_run();
    let render = "render run --frames 4 --size 8x6 --out out";
    place.succeeds(&format!("{render} --shard 1/2"));
    let before = files(&place, "out");
    let again =
        format!("use the same arguments, or remove out/{FOLDER} and what its shards wrote beside it to start again");
    let refused = |command: &str, differences: &[&str]| {
        let expected = [&["out: holds shards of another job: "], differences, &[&again]].concat();
        place.fails(command, &expected);
        assert!(files(&place, "out") == before, "{command}");
    };
    refused("render run --frames 4 --size 8x7 --out out --shard 2/2", &["`size` is [8,6] there, [8,7] here"]);
    refused(
        "render run --frames 5 --size 8x6 --out out --shard 2/2",
        &["`frames` is 4 there, 5 here", "`cameras` is "],
    );
    refused("render run --seconds 4 --fps 1 --size 8x6 --out out --shard 2/2", &["`seconds` is null there, 4.0 here"]);
    refused(&format!("{render} --save depth --shard 2/2"), &["`save` is [] there, [\"depth\"] here"]);
    refused(&format!("{render} --shard 2/3"), &["`shards` is 2 there, 3 here"]);
    // Its own record too.
    refused(&format!("{render} --background black --shard 1/2"), &["`background` is null there, [0.0,0.0,0.0] here"]);
    place.fails_with(
        render,
        &format!("out: holds shards: finish them with `raygrad merge out`, or remove out/{FOLDER}"),
    );
    // Another model.
    place.succeeds("train --resume run --steps 4");
    refused(&format!("{render} --shard 2/2"), &["`model` is \""]);
    // As the message says.
    std::fs::remove_dir_all(place.path("out")).unwrap();
    at_once(&place, &format!("{render} --background black"), 2);
    for (shard, flags) in [("1/2", "--out one.png"), ("1/1", "--out one.png")] {
        place.fails_with(
            &format!("render run {flags} --shard {shard}"),
            "`shard`: needs several frames: name a folder or a video with --out",
        );
    }
    for shard in ["0/2", "3/2", "1", "1/0", "1/10001", "1/2/3", "a/b"] {
        let output = place.command(&format!("eval run --shard {shard}")).output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && message.contains("write I/N such as 1/5"), "{shard}: {message}");
    }
}

#[test]
fn one_program_works_on_a_shard() {
    let place = Place::with_run();
    let render = "render run --frames 4 --size 8x6 --out out";
    place.succeeds(&format!("{render} --shard 2/3"));
    let lock = File::create(place.path(&format!("out/{FOLDER}/shard-1.lock"))).unwrap();
    lock.lock().unwrap();
    place.fails_with(&format!("{render} --shard 1/3"), "out: another raygrad works on shard 1/3: wait until it ends");
    // Others do not wait for it, and the merge names it.
    let printed = place.succeeds(&format!("{render} --shard 3/3"));
    assert_eq!(printed, "shard    3/3 is complete; still missing 1/3 (not begun)\n");
    drop(lock);
    // A program that writes all frames, or merges them.
    let whole = File::create(place.path("out/unfinished.lock")).unwrap();
    whole.lock().unwrap();
    let busy = "out: another raygrad writes or merges all results there: wait until it ends";
    place.fails_with(&format!("{render} --shard 1/3"), busy);
    assert!(record(&place, "out", 1).is_none());
    drop(whole);
    place.succeeds(&format!("{render} --shard 1/3"));
    // Unfinished frames without shards.
    let count = |name: &str| place.path(name).read_dir().unwrap().count();
    assert_eq!(count("out"), 4);
    std::fs::write(place.path("out/unfinished.json"), "{}").unwrap();
    place.fails(&format!("{render} --shard 1/3"), &["out: holds unfinished frames of a render without shards"]);
    // The user's files.
    std::fs::create_dir(place.path("mine")).unwrap();
    std::fs::write(place.path("mine/0003.png"), b"photograph").unwrap();
    place.fails("render run --frames 4 --size 8x6 --out mine --shard 1/3", &["mine/0003.png: exists, and"]);
    assert_eq!(count("mine"), 1);
}

#[test]
fn merge_makes_the_result_of_complete_shards() {
    let place = Place::with_run();
    let render = "render run --frames 5 --size 8x6 --out";
    place.succeeds(&format!("{render} whole.gif"));
    place.fails("merge film.gif", &["film.gif: holds no shards: name the --out"]);
    let wait_or_repeat = "wait for those that run, repeat the others with --shard";
    place.succeeds(&format!("{render} film.gif --shard 2/3"));
    let missing = |shards: &str| format!("film.gif: misses shards {shards}: {wait_or_repeat}");
    place.fails_with("merge film.gif", &missing("1/3 (not begun), 3/3 (not begun)"));
    let file = place.path(&format!("film.gif.frames/{FOLDER}/shard-2.json"));
    let whole_record = record(&place, "film.gif.frames", 2).unwrap();
    let write = |key: &str, value: Value| {
        let mut changed = whole_record.clone();
        changed[key] = value;
        std::fs::write(&file, changed.to_string()).unwrap();
    };
    write("done", json!(1));
    place.fails_with("merge film.gif", &missing("1/3 (not begun), 2/3 (stopped, 1 of 2), 3/3 (not begun)"));
    // Damaged records, and those of another job.
    let unsound = "is no record of this raygrad (its numbers do not fit)";
    for (key, value, why) in [
        ("done", json!(3), unsound),
        ("shards", json!(1), unsound),
        ("items", json!(10_000_001), unsound),
        ("inputs", Value::Null, "holds shards of another job"),
        ("items", json!(10_000_000), "holds shards of another job"),
    ] {
        write(key, value);
        place.fails(&format!("{render} film.gif --shard 1/3"), &["film.gif.frames", why]);
    }
    std::fs::write(&file, "{").unwrap();
    place.fails("merge film.gif", &["shard-2.json: is no record of this raygrad", "remove it and run its shard again"]);
    std::fs::remove_dir_all(place.path("film.gif.frames")).unwrap();
    // The last shard was killed before it merged.
    unmerged(&place, &format!("{render} film.gif"), "film.gif.frames");
    let frame = place.path("film.gif.frames/0004.png");
    std::fs::rename(&frame, place.path("aside")).unwrap();
    for there in [false, true] {
        if there {
            std::fs::write(&frame, "").unwrap();
        }
        let expected = ["0004.png: is missing or empty: remove ", "shard-1.json and run shard 1/2 again"];
        place.fails("merge film.gif", &expected);
    }
    std::fs::rename(place.path("aside"), &frame).unwrap();
    // The layers are part of a frame.
    let layers = "render run --frames 2 --size 8x6 --save opacity --out layers";
    unmerged(&place, layers, "layers");
    std::fs::write(place.path("layers/opacity/0001.png"), "").unwrap();
    std::fs::write(place.path("layers/0001.png"), "").unwrap();
    place.fails("merge layers", &["/0001.png: is missing or empty: remove ", "and run shard 2/2 again"]);
    std::fs::remove_file(place.path(&format!("layers/{FOLDER}/shard-2.json"))).unwrap();
    place.succeeds(&format!("{layers} --shard 2/2"));
    assert!(files(&place, "layers").len() == 4 && files(&place, "layers").values().all(|bytes| !bytes.is_empty()));
    // Records of two jobs. The folder held other images only if all shards saw them.
    let first = place.path(&format!("film.gif.frames/{FOLDER}/shard-1.json"));
    let sound = record(&place, "film.gif.frames", 1).unwrap();
    let mut changed = sound.clone();
    changed["inputs"]["of"]["size"] = json!([9, 6]);
    std::fs::write(&first, changed.to_string()).unwrap();
    place.fails("merge film.gif", &["holds shards of another job: `size` is [9,6] there, [8,6] here"]);
    changed.clone_from(&sound);
    changed["own"]["strange"] = json!(true);
    std::fs::write(&first, changed.to_string()).unwrap();
    assert!(!place.path("film.gif").exists());
    let lock = File::create(place.path("film.gif.frames/unfinished.lock")).unwrap();
    lock.lock().unwrap();
    place.fails_with("merge film.gif", "film.gif: another raygrad merges the shards: wait until it ends");
    drop(lock);
    assert!(place.succeeds("merge film.gif").starts_with("rendered 5 frames of 8x6: film.gif\n"));
    assert!(place.bytes("film.gif") == place.bytes("whole.gif") && !place.path("film.gif.frames").exists());
    // Numbered images that were there before stay.
    std::fs::create_dir(place.path("other.gif.frames")).unwrap();
    std::fs::write(place.path("other.gif.frames/0009.png"), b"photograph").unwrap();
    at_once(&place, &format!("{render} other.gif"), 2);
    assert_eq!(place.bytes("other.gif.frames/0009.png"), b"photograph");
}

#[test]
fn prepare_in_shards_equals_the_whole() {
    let place = Place::with_scene();
    let mut transforms = place.transforms(Split::Train);
    transforms["k1"] = json!(0.05);
    place.write_transforms(Split::Train, &transforms);
    for flags in ["--to nerfstudio", "--undistort", "--undistort --to llff"] {
        let convert = format!("prepare scene {flags} --out");
        place.succeeds(&format!("{convert} whole"));
        for count in [1, 2, 5] {
            let out = format!("made-{count}");
            for i in 1..=count {
                assert!(!place.path(&out).exists());
                place.succeeds(&format!("{convert} {out} --shard {i}/{count}"));
            }
            assert!(files(&place, &out) == files(&place, "whole"), "{flags} in {count}");
            std::fs::remove_dir_all(place.path(&out)).unwrap();
        }
        std::fs::remove_dir_all(place.path("whole")).unwrap();
    }
    let convert = "prepare scene --to colmap --out made";
    at_once(&place, convert, 3);
    place.succeeds("prepare scene --to colmap --out whole");
    assert!(files(&place, "made") == files(&place, "whole"));
    place.fails_with(&format!("{convert} --shard 1/2"), "made: exists: choose another --out, or leave out --shard");
    std::fs::remove_dir_all(place.path("made")).unwrap();
    place.succeeds(&format!("{convert} --shard 1/2"));
    place.fails("prepare scene --to llff --out made --shard 2/2", &["`to` is \"colmap\" there, \"llff\" here"]);
    place.fails(&format!("{convert} --undistort --shard 2/2"), &["`undistort` is false there, true here"]);
    transforms["frames"][0]["transform_matrix"][0][3] = json!(0.5);
    place.write_transforms(Split::Train, &transforms);
    place.fails(&format!("{convert} --shard 2/2"), &["`images` is \""]);
    place.fails("merge made", &["made: misses shards 2/2 (not begun)"]);
    // Files of a removed job do not get into another one.
    std::fs::remove_dir_all(place.path(&format!(".made-unfinished-shards/{FOLDER}"))).unwrap();
    place.fails(
        &format!("{convert} --shard 1/2"),
        &[".made-unfinished-shards: holds a dataset without the records of its shards: remove it"],
    );
    place.fails_with("prepare scene --out new --shard 1/2", "`shard`: needs a conversion: add --to or --undistort");
    std::fs::remove_dir_all(place.path(".made-unfinished-shards")).unwrap();
    unmerged(&place, convert, ".made-unfinished-shards");
    // A shard converts what has gone, and only that.
    let image = |i: usize| place.path(&format!(".made-unfinished-shards/dataset/images/train/r_{i}.png"));
    std::fs::remove_file(image(2)).unwrap();
    place.fails("merge made", &["r_2.png: is missing or empty: remove ", "shard-1.json and run shard 1/2 again"]);
    let before = std::fs::metadata(image(0)).unwrap().modified().unwrap();
    let second = place.path(&format!(".made-unfinished-shards/{FOLDER}/shard-2.json"));
    std::fs::rename(&second, place.path("aside")).unwrap();
    place.succeeds(&format!("{convert} --shard 1/2"));
    std::fs::rename(place.path("aside"), second).unwrap();
    assert!(image(2).exists() && std::fs::metadata(image(0)).unwrap().modified().unwrap() == before);
    std::fs::write(place.path(".made-unfinished-shards/dataset/images/.raygrad-tmp-abc"), b"half").unwrap();
    place.succeeds("merge made");
    assert!(!place.path("made/images/.raygrad-tmp-abc").exists() && place.path("made/images").is_dir());
    // Neither the dataset of the shards nor the result.
    std::fs::remove_dir_all(place.path("made")).unwrap();
    unmerged(&place, convert, ".made-unfinished-shards");
    std::fs::remove_dir_all(place.path(".made-unfinished-shards/dataset")).unwrap();
    place.fails("merge made", &["dataset: is missing, as is what it would become"]);
    std::fs::remove_dir_all(place.path(".made-unfinished-shards")).unwrap();
    let names = place.path("").read_dir().unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    assert_eq!(names.filter(|name| name.starts_with('.')).count(), 0);
}

/// A place with a run and 24 test images of one colour each, so that ranks of PSNR and places differ.
fn with_many_views() -> Place {
    let place = Place::with_run();
    let mut transforms = place.transforms(Split::Test);
    let frames: Vec<Value> = (0..24)
        .map(|i: usize| {
            let mut image = png(&place.path("scene/test/r_0.png"));
            let value = (i * 7 % 24) as f32 / 24.0;
            image = Image { data: vec![value; image.data.len()], ..image };
            image.save_png(place.path(&format!("scene/test/r_{i}.png"))).unwrap();
            let mut frame = transforms["frames"][i % 3].clone();
            frame["file_path"] = json!(format!("./test/r_{i}"));
            frame
        })
        .collect();
    transforms["frames"] = json!(frames);
    place.write_transforms(Split::Test, &transforms);
    place
}

/// The result of an evaluation without wall times: its file, and the files of its page.
fn result(place: &Place) -> (Value, BTreeMap<PathBuf, Vec<u8>>) {
    let mut report = place.json("run/eval-test.json");
    let seconds = report["seconds_per_view"].take();
    assert!(seconds.as_f64().unwrap() > 0.0);
    let mut page = files(place, "run/eval-test");
    let index = page.get_mut(&PathBuf::from("index.html")).unwrap();
    *index = String::from_utf8(index.clone()).unwrap().replacen(&seconds.to_string(), "", 1).into_bytes();
    (report, page)
}

#[test]
fn eval_in_shards_equals_the_whole() {
    let place = with_many_views();
    place.succeeds("--threads 2 eval run");
    let whole = result(&place);
    assert!(whole.1.len() > 11, "an image beside the evenly spaced ones");
    // A network of 16 samples, and one of these and 16 more.
    assert_eq!(whole.0["unskipped_per_pixel"], json!(48.0));
    let remove = || {
        std::fs::remove_file(place.path("run/eval-test.json")).unwrap();
        std::fs::remove_dir_all(place.path("run/eval-test")).unwrap();
    };
    for count in [1, 2, 5, 25] {
        remove();
        for i in 1..=count {
            assert!(!place.path("run/eval-test.json").exists());
            let printed = place.succeeds(&format!("--threads 2 eval run --shard {i}/{count}"));
            assert!(printed.contains("mean of 24") == (i == count), "{printed}");
        }
        assert!(result(&place) == whole, "{count} shards");
    }
    // At once, and over an older result.
    at_once(&place, "--threads 2 eval run", 2);
    assert!(result(&place) == whole);
    // Killed, and then killed before it merged.
    remove();
    let done = killed(&place, "--threads 2 eval run --shard 1/2", "run/eval-test");
    let output = place.command("--threads 2 eval run --shard 1/2").output().unwrap();
    assert!(output.status.success(), "{output:?}");
    assert!(done == 12 || said(&output).contains(&format!("resuming after {done} of 12 images of shard 1/2")));
    // A view that has gone is measured again.
    std::fs::remove_file(place.path(&format!("run/eval-test/{FOLDER}/view-2.json"))).unwrap();
    place.fails("merge run/eval-test", &["misses shards 2/2 (not begun)"]);
    let output = place.command("--threads 2 eval run --shard 1/2").output().unwrap();
    assert!(said(&output).contains("resuming after 1 of 12 images of shard 1/2"));
    place.succeeds("--threads 2 eval run --shard 2/2");
    assert!(result(&place) == whole);
    remove();
    unmerged(&place, "--threads 2 eval run", "run/eval-test");
    // Another result of the run is not complete. The error names it, and this one is merged all the same.
    place.succeeds("render run --frames 2 --size 8x6 --out run/a --shard 1/2");
    place.fails("merge run", &["run/a: misses shards 2/2 (not begun)"]);
    std::fs::remove_dir_all(place.path("run/a")).unwrap();
    assert!(result(&place) == whole);
    place.fails("merge run", &["run: holds no shards"]);
    remove();
    unmerged(&place, "--threads 2 eval run", "run/eval-test");
    said(&place.command("merge .").current_dir(place.path("run/eval-test")).output().unwrap());
    assert!(result(&place) == whole);
    place.fails("merge run/eval-test", &["run/eval-test: holds no shards"]);
    // Shards of several machines.
    place.succeeds("--threads 2 eval run --shard 1/2");
    place.succeeds("--threads 1 eval run --shard 2/2");
    let (mut report, _) = result(&place);
    assert_eq!(report["threads"], json!([1, 2]));
    report["threads"] = json!(2);
    assert!(report == whole.0);
}

#[test]
fn eval_shard_of_another_job_is_refused() {
    let place = Place::with_run();
    place.succeeds("eval run --shard 1/2");
    let before = files(&place, "run/eval-test");
    let refused = |command: &str, difference: &str| {
        let expected = ["run/eval-test: holds shards of another job: ", difference, "to start again"];
        place.fails(command, &expected);
        assert!(files(&place, "run/eval-test") == before, "{command}");
    };
    refused("eval run --shard 2/4", "`shards` is 2 there, 4 here");
    place.fails_with(
        "eval run",
        &format!("run/eval-test: holds shards: finish them with `raygrad merge run/eval-test`, or remove run/eval-test/{FOLDER}"),
    );
    let transforms = place.transforms(Split::Test);
    let mut moved = transforms.clone();
    moved["frames"][1]["transform_matrix"][0][3] = json!(0.5);
    place.write_transforms(Split::Test, &moved);
    refused("eval run --shard 2/2", "`images` is ");
    place.write_transforms(Split::Test, &transforms);
    let config = place.bytes("run/config.json");
    std::fs::write(place.path("run/config.json"), [&config[..], b"\n"].concat()).unwrap();
    refused("eval run --shard 2/2", "`config` is \"");
    std::fs::write(place.path("run/config.json"), config).unwrap();
    let lock = File::create(place.path("run/eval-test/unfinished.lock")).unwrap();
    lock.lock().unwrap();
    place.fails("eval run --shard 2/2", &["another raygrad writes or merges all results there"]);
    drop(lock);
    std::fs::remove_file(place.path("run/eval-test/unfinished.lock")).unwrap();
    place.succeeds("train --resume run --steps 4");
    refused("eval run --shard 2/2", "`crc32` is \"");
}
