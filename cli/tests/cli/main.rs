//! The command line: the built program on small folders.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::LazyLock;

use raygrad::nerf::Image;
use raygrad::nerf::dataset::{Split, evenly_spaced, load};
use raygrad_scenes::ANGLE_X;
use raygrad_scenes::embedded;
use serde_json::{Value, json};
use tempfile::TempDir;

#[cfg(target_os = "linux")]
mod attack;
#[cfg(unix)]
mod browser;
mod captures;
mod convert;
mod dialects;
mod export;
mod lpips;
#[cfg(feature = "mpi")]
mod mpi;
mod outside;
mod overwrite;
#[cfg(unix)]
mod owners;
// Scripts replace other programs.
#[cfg(unix)]
mod prepare;

mod render;

#[cfg(unix)]
mod faults;
#[cfg(target_os = "linux")]
mod power;
#[cfg(unix)]
mod records;

#[cfg(unix)]
mod resume;
#[cfg(unix)]
mod shards;
#[cfg(unix)]
mod signals;
#[cfg(unix)]
mod view;
#[cfg(target_os = "linux")]
mod writers;

/// Settings of an instant model whose steps and renders take milliseconds in a debug build.
const SMALL: &str = "--set field.grid.levels=4 --set field.grid.log2_table=10 --set field.density_width=16 \
                     --set field.color_width=16 --set sampler.occupancy.resolution=16 --set sampler.samples=1024 \
                     --set sampler.step=0.02 --set sampler.view_step=0.02 --set sampler.cone=0.03";

/// Settings besides [`SMALL`] for tests that need a run of few steps to diverge, or to learn its cameras: what makes
/// training faster changes both.
const PLAIN: &str = "--set field.color_depth=2 --set field.gradient_cut=0 --set sampler.early_stop_eps=0.001 \
                     --background random";

/// The same for the preset small, which samples hierarchically.
const CLASSIC: &str = "--preset small --set field.width=16 --set field.view_width=16 --set sampler.proposal.width=16 \
                       --set sampler.batch=64 --set sampler.coarse=16 --set sampler.fine=16";

/// Width and height of the test images.
const SIZE: usize = 24;

/// Files of a place that many tests start from.
struct Kept {
    root: String,
    files: BTreeMap<PathBuf, Vec<u8>>,
}

/// The files below a folder with their contents, by their paths below it.
fn files_below(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut folders, mut files) = (vec![root.to_owned()], BTreeMap::new());
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                files.insert(path.strip_prefix(root).unwrap().to_owned(), std::fs::read(&path).unwrap());
            }
        }
    }
    files
}

impl Kept {
    fn of(place: &Place) -> Self {
        let root = place.0.path().canonicalize().unwrap();
        Kept { files: files_below(&root), root: root.to_str().unwrap().to_owned() }
    }

    /// A new place with these files; paths of the old place are replaced.
    fn place(&self) -> Place {
        let place = Place::empty();
        self.add_to(&place);
        place
    }

    fn add_to(&self, place: &Place) {
        let root = place.0.path().canonicalize().unwrap();
        for (name, bytes) in &self.files {
            let path = root.join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            match std::str::from_utf8(bytes) {
                Ok(text) => std::fs::write(path, text.replace(&self.root, root.to_str().unwrap())).unwrap(),
                Err(_) => std::fs::write(path, bytes).unwrap(),
            }
        }
    }
}

/// Resets ignored signals: programs inherit them, and background jobs of a shell ignore some. A handler with the
/// default action is not inherited.
#[cfg(unix)]
static SIGNALS: LazyLock<()> = LazyLock::new(|| {
    use signal_hook::consts::{SIGHUP, SIGINT};
    for signal in [SIGINT, SIGHUP] {
        let always = std::sync::Arc::new(true.into());
        signal_hook::flag::register_conditional_default(signal, always).unwrap();
    }
});

/// A temporary folder with a dataset in `scene`; commands run in it.
struct Place(TempDir);

impl Place {
    fn empty() -> Self {
        #[cfg(unix)]
        LazyLock::force(&SIGNALS);
        Place(tempfile::tempdir().unwrap())
    }

    /// A place with a small dataset in the Blender format: 6 training, 2 validation and 3 test images.
    fn with_scene() -> Self {
        static SCENE: LazyLock<Kept> = LazyLock::new(|| Kept::of(&Place::drawn()));
        SCENE.place()
    }

    /// A place with a dataset, and a run of a few steps in `run`.
    fn with_run() -> Self {
        static RUN: LazyLock<Kept> = LazyLock::new(|| {
            let place = Place::with_scene();
            place.succeeds(&format!("train scene --steps 3 {CLASSIC}"));
            Kept::of(&place)
        });
        RUN.place()
    }

    /// Adds a dataset of an unbounded scene to `around`, in nerfstudio's format.
    #[cfg(unix)]
    fn add_landscape(&self) {
        static LANDSCAPE: LazyLock<Kept> = LazyLock::new(|| {
            let place = Place::empty();
            place.succeeds("prepare landscape --to nerfstudio --size 32 --out around");
            Kept::of(&place)
        });
        LANDSCAPE.add_to(self);
    }

    /// [`with_scene`](Self::with_scene), rendered again.
    fn drawn() -> Self {
        let place = Place::empty();
        for (split, views) in [(Split::Train, 6), (Split::Val, 2), (Split::Test, 3)] {
            std::fs::create_dir_all(place.path(&format!("scene/{split}"))).unwrap();
            let mut frames = vec![];
            for (i, frame) in evenly_spaced(embedded(split, SIZE).frames, views).into_iter().enumerate() {
                let name = format!("{split}/r_{i}");
                frame.image.to_image().save_png(place.path(&format!("scene/{name}.png"))).unwrap();
                let (rotation, eye) = (frame.camera.pose.matrix3, frame.camera.pose.translation);
                let row = |r: usize| [rotation.row(r).x, rotation.row(r).y, rotation.row(r).z, eye[r]];
                let matrix = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
                frames.push(json!({ "file_path": format!("./{name}"), "transform_matrix": matrix }));
            }
            place.write_transforms(split, &json!({ "camera_angle_x": ANGLE_X, "frames": frames }));
        }
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn transforms(&self, split: Split) -> Value {
        self.json(&format!("scene/transforms_{split}.json"))
    }

    fn write_transforms(&self, split: Split, transforms: &Value) {
        std::fs::write(self.path(&format!("scene/transforms_{split}.json")), transforms.to_string()).unwrap();
    }

    fn json(&self, name: &str) -> Value {
        serde_json::from_slice(&self.bytes(name)).unwrap()
    }

    fn bytes(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path(name)).unwrap()
    }

    fn command(&self, arguments: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_raygrad"));
        command.args(arguments.split_whitespace()).current_dir(self.0.path());
        command
    }

    fn succeeds(&self, arguments: &str) -> String {
        let output = self.command(arguments).output().unwrap();
        assert!(output.status.success(), "{arguments}: {output:?}");
        String::from_utf8(output.stdout).unwrap()
    }

    /// Checks that a command fails with one line besides notes and warnings, which starts with the program's name and contains all of `expected`.
    #[track_caller]
    fn fails(&self, arguments: &str, expected: &[&str]) {
        complained(arguments, &self.command(arguments).output().unwrap(), expected);
    }

    /// Checks that a command fails with this message after the program's name, and nothing else on standard error.
    #[track_caller]
    fn fails_with(&self, arguments: &str, message: &str) {
        complained_of(arguments, &self.command(arguments).output().unwrap(), message);
    }
}

/// Checks that a program ended with this message, and nothing else on standard error.
#[track_caller]
fn complained_of(what: &str, output: &Output, message: &str) {
    let said = (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned());
    assert_eq!(said, (Some(1), format!("raygrad: {message}\n")), "{what}");
}

#[track_caller]
fn complained(what: &str, output: &Output, expected: &[&str]) {
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{what}: {message}");
    let is_remark = |line: &str| ["note", "warning"].iter().any(|kind| line.starts_with(&format!("raygrad: {kind}: ")));
    let mut lines = message.lines().filter(|line| !is_remark(line));
    let one_line = lines.next().is_some_and(|line| line.starts_with("raygrad: ")) && lines.next().is_none();
    assert!(one_line && expected.iter().all(|part| message.contains(part)), "{what}: {message}");
}

/// Reads a PNG file.
fn png(path: &Path) -> Image {
    Image::open(path).unwrap()
}

/// PSNR in dB of constant images, each of its image's mean colour: the mean of the first `views` test images.
fn psnr_of_mean_colours(place: &Place, views: usize) -> f64 {
    let frames = evenly_spaced(load(place.path("scene"), Split::Test, 1).unwrap().frames, views);
    let one = |image: &Image| {
        let pixels = || image.data.chunks_exact(3).map(|pixel| [0, 1, 2].map(|c: usize| f64::from(pixel[c])));
        let count = (image.width * image.height) as f64;
        let mean = [0, 1, 2].map(|c: usize| pixels().map(|pixel| pixel[c]).sum::<f64>() / count);
        let error = pixels().map(|pixel| (0..3).map(|c| (pixel[c] - mean[c]).powi(2)).sum::<f64>()).sum::<f64>();
        -10.0 * (error / (3.0 * count)).log10()
    };
    frames.iter().map(|frame| one(&frame.image.to_image().over([1.0; 3]))).sum::<f64>() / frames.len() as f64
}

#[test]
fn run_is_complete_and_can_be_evaluated() {
    let place = Place::with_run();
    let config = place.json("run/config.json");
    assert_eq!(config["raygrad"], env!("CARGO_PKG_VERSION"));
    assert_eq!(config["downscale"], 1);
    assert!(config["scene"]["folder"].as_str().unwrap().ends_with("scene"));
    let metrics = String::from_utf8(place.bytes("run/metrics.jsonl")).unwrap();
    let steps: Vec<Value> = metrics.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(steps.iter().map(|line| line["step"].as_u64().unwrap()).collect::<Vec<_>>(), [1, 3]);
    assert!(steps.iter().all(|line| line["loss"].as_f64().unwrap() > 0.0 && line["psnr"].is_f64()));
    let preview = png(&place.path("run/previews/000003.png"));
    assert_eq!([preview.width, preview.height], [2 * SIZE, SIZE]);

    let printed: Value = serde_json::from_str(&place.succeeds("--threads 3 eval run --json")).unwrap();
    assert_eq!(printed, place.json("run/eval-test.json"));
    let fields = ["split", "views", "background", "width", "height", "pixel_offset", "quantisation"];
    let values = fields.map(|field| printed[field].clone());
    assert_eq!(json!(values), json!(["test", 3, "white", SIZE, SIZE, 0.5, "none"]));
    let views = printed["per_view"].as_array().unwrap();
    assert_eq!(
        json!(views.iter().map(|v| &v["name"]).collect::<Vec<_>>()),
        json!(["test/r_0", "test/r_1", "test/r_2"])
    );
    for metric in ["psnr", "ssim"] {
        let mean = views.iter().map(|view| view[metric].as_f64().unwrap()).sum::<f64>() / 3.0;
        assert!((printed[format!("{metric}_mean")].as_f64().unwrap() - mean).abs() < 1e-9);
    }
    assert!(printed["seconds_per_view"].as_f64().unwrap() > 0.0);
    let picture = png(&place.path("run/eval-test/002.png"));
    assert_eq!([picture.width, picture.height], [4 * SIZE, SIZE]);

    assert_eq!(printed["hold_out"], "as the capture says");
    let model = &printed["model"];
    let fields = ["steps", "seed", "images", "field", "sampler", "raygrad"].map(|field| model[field].clone());
    assert_eq!(json!(fields), json!([3, 0, 6, "classic", "hierarchical", env!("CARGO_PKG_VERSION")]));
    let crc = crc32fast::hash(&place.bytes("run/model.safetensors"));
    assert!(model["crc32"] == format!("{crc:08x}") && model["budget"] == json!({ "steps": 3 }), "{model}");
    assert!(printed["threads"] == 3 && !printed["processor"].as_str().unwrap().is_empty());
    // The page lists the views, the worst first, and refers only to the images beside it.
    let page = String::from_utf8(place.bytes("run/eval-test/index.html")).unwrap();
    let mut order: Vec<(f64, &str)> =
        views.iter().map(|view| (view["psnr"].as_f64().unwrap(), view["name"].as_str().unwrap())).collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    let places: Vec<usize> = order.iter().map(|(_, name)| page.find(&format!("alt=\"{name},")).unwrap()).collect();
    assert!(places.is_sorted() && !page.contains("http") && page.matches("<img").count() == 3, "{page}");
    assert!(page.contains("<tr><th>model seed</th><td>0</td></tr>"), "{page}");

    let table = place.succeeds("eval run --split val --views 1");
    assert!(table.contains("worst: val/r_0 (") && table.contains("val images (as the capture says)"), "{table}");
    assert!(table.contains("mean of 1") && table.contains("val/r_0") && !table.contains("val/r_1"), "{table}");
    // In its own file; the other result stays.
    assert_eq!(place.json("run/eval-val-1.json")["split"], "val");
    assert_eq!(place.json("run/eval-test.json"), printed);
    assert!(place.path("run/eval-val-1/000.png").exists() && printed["skip"].is_null());
    // Compared with another run.
    place.succeeds(&format!("train scene --steps 2 --seed 9 --out other {CLASSIC}"));
    place.fails_with("compare run other", "other: has no eval results: run `raygrad eval` first");
    place.succeeds("eval other");
    let table = place.succeeds("compare run other --only eval-test");
    let psnr =
        |run: &str| format!("{:.2}", place.json(&format!("{run}/eval-test.json"))["psnr_mean"].as_f64().unwrap());
    let rows: Vec<Vec<&str>> = table.lines().take(3).map(|line| line.split_whitespace().collect()).collect();
    assert!(rows[0].contains(&"model.seed") && rows[1][..3] == ["run", "eval-test", &psnr("run")], "{table}");
    assert!(rows[2][..3] == ["other", "eval-test", &psnr("other")] && !table.contains("different"), "{table}");
    let output = place.command("compare run").output().unwrap();
    assert!(String::from_utf8_lossy(&output.stdout).contains("different images"));
    assert!(output.stderr.is_empty(), "{output:?}");
    // The results are older than the model.
    place.succeeds("train --resume run --steps 4");
    let output = place.command("compare run other").output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    std::fs::create_dir_all(place.path("run/eval-test/unfinished")).unwrap();
    std::fs::write(place.path("run/eval-test/unfinished/999.png"), b"half").unwrap();
    let stale = "the model was trained further after this result";
    assert!(output.status.success() && said.matches(stale).count() == 2 && !said.contains("other/"), "{said}");
    // Only one evaluation may run at a time.
    let lock = std::fs::File::create(place.path("run/eval-test/unfinished.lock")).unwrap();
    lock.lock().unwrap();
    place.fails_with("eval run", "run/eval-test: another raygrad is writing it: wait until it ends");
    drop(lock);
    // The remains of a killed evaluation are replaced, and new results are not stale.
    place.succeeds("eval run");
    let left: Vec<_> =
        std::fs::read_dir(place.path("run/eval-test")).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left.len(), 4, "three pictures and a page: {left:?}");
    // Results remain if the model is deleted.
    std::fs::remove_file(place.path("other/model.safetensors")).unwrap();
    let output = place.command("compare run other --only eval-test").output().unwrap();
    assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
}

/// Of many views, ten evenly spaced ones and the three worst are drawn.
#[test]
fn worst_of_many_views_are_drawn() {
    let place = Place::empty();
    place.succeeds(&format!("train --downscale 20 --steps 1 --out run {SMALL}"));
    place.succeeds("eval run --split train");
    let views = place.json("run/eval-train-fast.json")["per_view"].as_array().unwrap().clone();
    assert_eq!(views.len(), 60);
    let mut order: Vec<usize> = (0..60).collect();
    order.sort_by(|&a, &b| views[a]["psnr"].as_f64().unwrap().total_cmp(&views[b]["psnr"].as_f64().unwrap()));
    let mut expected: Vec<String> =
        (0..10).map(|i| 6 * i).chain(order[..3].iter().copied()).map(|i| format!("{i:03}.png")).collect();
    expected.sort();
    expected.dedup();
    assert!(expected.len() > 10, "the test is of views that are drawn because they are the worst: {order:?}");
    let found = std::fs::read_dir(place.path("run/eval-train-fast")).unwrap();
    let found = found.map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned());
    let mut found: Vec<String> = found.filter(|name| name.ends_with(".png")).collect();
    found.sort();
    assert_eq!(found, expected);
}

#[test]
fn doctor_exit_code_is_that_of_the_worst_finding() {
    const SIZE: usize = 64;
    let place = Place::empty();
    std::fs::create_dir_all(place.path("capture/images")).unwrap();
    let mut frames = vec![];
    for (i, frame) in evenly_spaced(embedded(Split::Train, SIZE).frames, 40).into_iter().enumerate() {
        let name = format!("images/{i:02}.png");
        frame.image.to_image().save_png(place.path(&format!("capture/{name}"))).unwrap();
        let (rotation, eye) = (frame.camera.pose.matrix3, frame.camera.pose.translation);
        let row = |r: usize| [rotation.row(r).x, rotation.row(r).y, rotation.row(r).z, eye[r]];
        let matrix = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
        frames.push(json!({ "file_path": name, "transform_matrix": matrix }));
    }
    let (side, focal) = (SIZE as f64, 0.5 * SIZE as f64 / (0.5 * ANGLE_X).tan());
    let transforms = json!({
        "w": SIZE, "h": SIZE, "fl_x": focal, "fl_y": focal, "cx": 0.5 * side, "cy": 0.5 * side, "frames": frames
    });
    std::fs::write(place.path("capture/transforms.json"), transforms.to_string()).unwrap();

    let table = place.succeeds("doctor capture");
    assert!(
        table.contains("no problems found") && table.contains("bounded: images have a transparent background"),
        "{table}"
    );
    assert!(
        table.contains("  resolution     64x64\n") && table.contains("  images         35 train, 5 test\n"),
        "{table}"
    );
    let picture = png(&place.path("doctor/cameras.png"));
    assert!(picture.width > 1000 && picture.data.iter().any(|value| *value < 0.5));
    let page = String::from_utf8(place.bytes("doctor/doctor.html")).unwrap();
    assert!(page.contains("images/07.png") && !page.contains("{{") && !page.contains("http"));

    let report_of = |flags: &str, code: i32| -> Value {
        let output = place.command(&format!("doctor capture --json --out other {flags}")).output().unwrap();
        assert_eq!(output.status.code(), Some(code), "{output:?}");
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let report = |code: i32| report_of("", code);
    assert_eq!(report(0)["findings"], json!([]));
    let layout = |flags: &str| report_of(flags, 0)["facts"]["layout"].clone();
    assert_eq!(layout("")["scene_type"], "bounded");
    let asked = layout("--scene-type unbounded");
    assert_eq!(
        json!([asked["scene_type"], asked["reason"]]),
        json!(["unbounded", "as requested; cameras look at one place"])
    );
    std::fs::remove_file(place.path("capture/images/05.png")).unwrap();
    let found = report(3)["findings"][0].clone();
    assert_eq!(
        json!([found["kind"], found["severity"], found["views"]]),
        json!(["images-absent", "warning", ["images/05.png"]])
    );
    std::fs::write(place.path("capture/images/09.png"), b"no image").unwrap();
    assert_eq!(report(4)["findings"][0]["kind"], "images-undecodable");
    assert!(String::from_utf8(place.bytes("other/doctor.html")).unwrap().contains("images-undecodable"));
    // Training refuses it. The report keeps its other findings.
    for i in 0..40 {
        let data = (0..SIZE * SIZE).flat_map(|pixel| [0.01 * ((i + pixel) % 100) as f32, 0.5, 0.5, 0.5]).collect();
        let faint = Image { width: SIZE, height: SIZE, channels: 4, data };
        faint.save_png(place.path(&format!("capture/images/{i:02}.png"))).unwrap();
    }
    let found = report(4)["findings"].clone();
    assert_eq!(json!([found[0]["kind"], found[1]["kind"]]), json!(["refused", "opaque-alpha"]), "{found}");
    let what = found[0]["what"].as_str().unwrap();
    assert!(what.contains("alpha 128 of 255 in every pixel of `images/00.png`"), "{what}");
    place.fails_with("doctor embedded", "`scene`: built-in scenes have no files to check: name a folder");
    place.fails("doctor absent", &["absent: there is no such folder"]);
}

#[test]
fn render_writes_images_and_animations() {
    let place = Place::with_run();
    place.succeeds("render run --frames 2");
    let [first, second] = ["0000", "0001"].map(|name| png(&place.path(&format!("run/orbit/{name}.png"))));
    assert_eq!([first.width, first.height], [SIZE, SIZE]);
    assert_ne!(first, second);
    assert!(!place.path("run/orbit/0002.png").exists());
    // Frames of a longer path stay, with a warning.
    let output = place.command("render run --frames 1").output().unwrap();
    assert!(output.status.success() && place.path("run/orbit/0001.png").exists());
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("orbit also holds 1 numbered images of a longer path"), "{said}");
    // An evaluation removes the images of the previous one, and nothing else.
    std::fs::create_dir(place.path("run/eval-test")).unwrap();
    for name in ["007.png", "0007.png", "7.png", "notes.txt"] {
        std::fs::write(place.path(&format!("run/eval-test/{name}")), "old").unwrap();
    }
    place.succeeds("eval run");
    let left =
        ["007.png", "0007.png", "7.png", "notes.txt"].map(|name| place.path(&format!("run/eval-test/{name}")).exists());
    assert_eq!(left, [false, true, true, true]);
    place.succeeds("render run --size 20x10 --out wide.PNG --show depth");
    place.succeeds("render run --size 20x10 --out single.png");
    place.succeeds("render run --size 20x10 --out double.png --precision f64");
    let [single, double] = ["single.png", "double.png"].map(|name| png(&place.path(name)));
    let differences = single.data.iter().zip(&double.data).map(|(a, b)| (a - b).abs());
    assert!(differences.fold(0.0, raygrad::Real::maximum) <= 1.5 / 255.0, "both precisions show the same");
    let wide = png(&place.path("wide.PNG"));
    assert_eq!([wide.width, wide.height], [20, 10]);
    place.succeeds("render run --path test --out test.gif");
    let gif = place.bytes("test.gif");
    let mut decoder = gif::Decoder::new(&gif[..]).unwrap();
    let mut frames = 0;
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        assert_eq!([frame.width as usize, frame.height as usize, frame.delay as usize], [SIZE, SIZE, 4]);
        frames += 1;
    }
    assert_eq!(frames, 3);
    // An orbit needs no images, and a moved capture can be named.
    std::fs::rename(place.path("scene"), place.path("moved")).unwrap();
    place.succeeds("render run --frames 1 --out one.png");
    place.fails("eval run", &["scene: ", "--scene"]);
    place.fails("render run --path test", &["scene: ", "--scene"]);
    place.succeeds("eval run --scene moved --views 1");
}

#[test]
fn embedded_scene_needs_no_files() {
    let place = Place::empty();
    let printed = place
        .succeeds(&format!("train --steps 1 --downscale 10 --no-positional-encoding --background random {CLASSIC}"));
    place.fails(
        "train --steps 1 --downscale 10 --no-positional-encoding",
        &["`no-positional-encoding`: the preset instant has none: add --preset small or classic"],
    );
    assert!(printed.contains("embedded: 60 images of 20x20") && printed.contains("raygrad eval run"), "{printed}");
    let config = place.json("run/config.json");
    assert_eq!([&config["scene"], &config["config"]["background"]], ["embedded", "random"]);
    assert_eq!(config["config"]["field"]["position_levels"], 0);
    place.succeeds("eval run --views 1");
    assert_eq!(place.json("run/eval-test-1.json")["background"], "white");
    place.succeeds("render run --out one.png");
    place.fails_with("train --downscale 3", "`downscale`: 3 does not divide the image size 200x200");
    place.fails_with("train landscape --downscale 16", "`downscale`: 16 does not divide the image size 400x300");
}

#[test]
fn same_seed_any_threads_give_same_bits() {
    let place = Place::with_scene();
    for (seed, threads, out) in [(7, 1, "one"), (7, 2, "two"), (8, 2, "other")] {
        place.succeeds(&format!("train scene --steps 4 --seed {seed} --threads {threads} --out {out} {CLASSIC}"));
    }
    let [one, two, other] = ["one", "two", "other"].map(|run| place.bytes(&format!("{run}/model.safetensors")));
    assert!(one == two && one != other);
}

#[test]
fn train_overwrites_no_folder() {
    let place = Place::with_run();
    let before = place.bytes("run/model.safetensors");
    for name in ["run-2", "run-3"] {
        assert!(place.succeeds(&format!("train scene --steps 1 {CLASSIC}")).contains(name));
    }
    place.fails_with(
        "train scene --preset small --steps 1 --out run",
        "run: already holds a run: choose another --out, or continue it with --resume",
    );
    place.fails_with(
        "train scene --preset small --steps 1 --out scene",
        "scene: holds files that do not belong to a run: choose another folder with --out",
    );
    assert_eq!(place.bytes("run/model.safetensors"), before);
    assert!(!place.path("scene/config.json").exists());
    // An empty folder may become a run.
    std::fs::create_dir(place.path("empty")).unwrap();
    place.succeeds(&format!("train scene --steps 1 --out empty {CLASSIC}"));
    std::fs::remove_file(place.path("run/config.json")).unwrap();
    place.fails_with(
        "train scene --preset small --steps 1",
        "run: holds files that do not belong to a run: choose another folder with --out",
    );
    assert_eq!(place.bytes("run/model.safetensors"), before);
}

#[test]
fn bad_scenes_are_named_and_leave_no_run() {
    let place = Place::with_scene();
    let file = "scene/transforms_train.json";
    let good = place.transforms(Split::Train);
    let edited = |edit: fn(&mut Value)| {
        let mut transforms = good.clone();
        edit(&mut transforms);
        transforms.to_string()
    };
    let no_frames = edited(|t| t["frames"] = json!([]));
    // Most poses: single ones are left out.
    let not_finite = edited(|t| (0..6).for_each(|i| t["frames"][i]["transform_matrix"][1][3] = json!("X")));
    let not_finite = not_finite.replace("\"X\"", "NaN");
    let not_rigid = edited(|t| t["frames"][1]["transform_matrix"][0][0] = json!(7.0));
    let bad = [
        ("{", ["is not valid JSON", "line 1"]),
        (&no_frames, ["`frames`", "is empty"]),
        (&not_finite, ["`frames[0].transform_matrix`", "not a finite number"]),
        (&not_rigid, ["`frames[1].transform_matrix`", "must be a rotation"]),
    ];
    for (text, expected) in bad {
        std::fs::write(place.path(file), text).unwrap();
        place.fails("train scene --preset small", &[&[file][..], &expected].concat());
    }
    place.write_transforms(Split::Train, &good);
    std::fs::write(place.path("scene/train/r_3.png"), b"no picture").unwrap();
    place.fails("train scene --preset small", &["`frames[3]`", "r_3.png", "cannot be decoded"]);
    Image::new(SIZE, SIZE + 1, 3).save_png(place.path("scene/train/r_3.png")).unwrap();
    place.fails("train scene --preset small", &["`frames[3]`", "has 24x25 pixels"]);
    place.fails("train scene --preset small --downscale 5", &["`frames[3]`"]);
    place.fails("train absent", &["absent: there is no such folder"]);
    std::fs::create_dir(place.path("empty")).unwrap();
    place.fails("train empty", &["empty: is not a dataset"]);
    assert!(!place.path("run").exists());
}

#[test]
fn images_beyond_the_free_memory_are_an_error() {
    let place = Place::empty();
    // A header of 16384 x 16384 pixels; the rest is not there, and is not needed.
    let mut bytes = Image::new(1, 1, 3).to_png();
    bytes[16..24].copy_from_slice(&[0, 0, 64, 0, 0, 0, 64, 0]);
    let checksum = crc32(&bytes[12..29]).to_be_bytes();
    bytes[29..33].copy_from_slice(&checksum);
    bytes.resize(1 << 17, 0);
    std::fs::write(place.path("0.png"), bytes).unwrap();
    (1..500).for_each(|i| std::fs::hard_link(place.path("0.png"), place.path(&format!("{i}.png"))).unwrap());
    let pose = |i: usize| json!([[1, 0, 0, i], [0, 0, -1, -4], [0, 1, 0, 1], [0, 0, 0, 1]]);
    let frame = |i: usize| json!({ "file_path": format!("{i}.png"), "transform_matrix": pose(i) });
    let frames: Vec<Value> = (0..500).map(frame).collect();
    let names: Vec<String> = (0..500).map(|i| format!("{i}.png")).collect();
    let scene = json!({ "camera_angle_x": 0.7, "w": 64, "h": 64, "frames": frames, "train_filenames": names });
    std::fs::write(place.path("transforms.json"), scene.to_string()).unwrap();
    // .4 TB.
    place.fails(
        "train . --downscale 1 --steps 1 --out run",
        &["transforms.json: 500 images need 403.5 GB of memory, but ", " GB are free: a downscale of "],
    );
    assert!(!place.path("run").exists());
}

/// The CRC-32 of PNG and zlib.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| if crc & 1 == 1 { (crc >> 1) ^ 0xedb8_8320 } else { crc >> 1 })
    })
}

#[test]
fn absent_images_are_skipped_with_a_warning() {
    let place = Place::with_scene();
    std::fs::remove_file(place.path("scene/train/r_3.png")).unwrap();
    let output = place.command(&format!("train scene --steps 1 {CLASSIC}")).output().unwrap();
    let (printed, warned) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success() && printed.contains("5 images of 24x24"), "{printed}{warned}");
    assert!(
        warned.contains("raygrad: warning: scene: 1 of 6 images is missing and was skipped: `train/r_3`\n"),
        "{warned}"
    );
}

/// Runs of version 0.1 stored the whole grid; they must load in all later versions.
#[test]
fn run_of_first_version_loads_and_renders_the_same() {
    let place = Place::empty();
    std::fs::create_dir(place.path("run")).unwrap();
    for name in ["config.json", "model.safetensors"] {
        let stored = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference/run-0.1").join(name);
        std::fs::copy(stored, place.path(&format!("run/{name}"))).unwrap();
    }
    let report: Value = serde_json::from_str(&place.succeeds("eval run --views 2 --json")).unwrap();
    for (view, expected) in report["per_view"].as_array().unwrap().iter().zip([17.708_592_9, 17.012_243_8]) {
        assert!((view["psnr"].as_f64().unwrap() - expected).abs() < 0.01, "{report}");
    }
    assert_eq!(report["views"], 2);
}

#[test]
fn marched_models_restore_occupancy_grids() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --preset instant --steps 120 {SMALL}"));
    let voxel = "--set field.resolution=24 --set sampler.view_step=0.02 --set loss={\"huber\":{\"delta\":0.1}}";
    place.succeeds(&format!("train scene --preset voxel --steps 60 {voxel}"));
    let blank = psnr_of_mean_colours(&place, 1);
    for run in ["run", "run-2"] {
        place.succeeds(&format!("eval {run} --views 1 --skip off"));
        let report = place.json(&format!("{run}/eval-test-off-1.json"));
        assert!(report["psnr_mean"].as_f64().unwrap() > blank + 2.0, "{blank}: {report}");
        assert_eq!(report["skip"]["pruning"], 0.0, "{report}");
        // The silhouettes have emptied cells, which are empty in a model that is read.
        let share = captures::model(&place, run).sampler.grid().unwrap().occupied_share();
        assert!((0.01..0.9).contains(&share), "{share}");
    }
    assert_eq!(place.json("run-2/config.json")["config"]["field"]["resolution"], 24);
    place.fails("train scene --preset voxel --set field.resolution=513", &["`resolution`", "use 1 to 512"]);
    let model = place.path("run/model.safetensors");
    let bytes = std::fs::read(&model).unwrap();
    std::fs::write(&model, &bytes[..bytes.len() / 2]).unwrap();
    place.fails("eval run", &["run/model.safetensors"]);
}

#[test]
fn bad_runs_are_named() {
    let place = Place::with_run();
    std::fs::create_dir(place.path("empty")).unwrap();
    for command in ["eval", "render"] {
        place.fails_with(&format!("{command} absent"), "absent: there is no such folder");
        place.fails_with(
            &format!("{command} empty"),
            "empty: is not a run: it has no config.json; `raygrad train` creates runs",
        );
    }
    let config = place.json("run/config.json");
    let write = |config: &str| std::fs::write(place.path("run/config.json"), config).unwrap();
    let edited = |path: &str, value: Value| {
        let mut config = config.clone();
        *config.pointer_mut(path).unwrap() = value;
        config.to_string()
    };
    let bad = [
        ("{ \"raygrad\": ".to_owned(), ["run/config.json", "line 1"]),
        ("{}".to_owned(), ["run/config.json", "missing field"]),
        (edited("/downscale", json!(0)), ["run/config.json", "`downscale`: is 0; use 1 or more"]),
        (
            edited("/scene_box/near_far", json!([6.0, 2.0])),
            ["run/config.json", "`scene_box.near_far`: is 6 to 2; near must"],
        ),
        (
            edited("/scene_box/transform/scale", json!(0.0)),
            ["run/config.json", "`scene_box.transform`: needs a rotation"],
        ),
        (edited("/scene_box/transform/rotation/0", json!(2.0)), ["run/config.json", "`scene_box.transform`: needs"]),
        (edited("/scene_box/bounds/0/0", json!(9.0)), ["`bounds`", "use finite corners, the lower below the upper"]),
        (edited("/viewpoint/width", json!(0)), ["run/config.json", "`viewpoint.width`: is 0; use 1 to 65536"]),
        (
            edited(
                "/viewpoint",
                json!({ "width": 16_385, "height": 16_384, "angle_x": 1, "distance": 1, "elevation": 0 }),
            ),
            ["run/config.json", "`viewpoint.height`: is 16384; use at most 2^28 pixels with `width`"],
        ),
        (edited("/config/sampler/batch", json!(0)), ["run/config.json", "`batch`"]),
        (edited("/config/field/width", json!(64)), ["run/model.safetensors", "in the file"]),
        (edited("/config/field/depth", json!(3)), ["run/model.safetensors", "another configuration"]),
    ];
    for (text, expected) in bad {
        write(&text);
        place.fails("eval run", &expected);
    }
    write(&config.to_string());
    let model = place.bytes("run/model.safetensors");
    std::fs::write(place.path("run/model.safetensors"), &model[..model.len() / 2]).unwrap();
    place.fails("eval run", &["run/model.safetensors: not a safetensors file"]);
    let mut damaged = model.clone();
    let end = damaged.len();
    damaged[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
    std::fs::write(place.path("run/model.safetensors"), damaged).unwrap();
    place.fails("eval run", &["run/model.safetensors: is damaged: `", "` has values that are not finite"]);
    std::fs::remove_file(place.path("run/model.safetensors")).unwrap();
    place.fails("render run", &["run: has no model.safetensors; `raygrad train --resume run` writes it"]);
    assert!(!place.path("run/eval-test.json").exists() && !place.path("run/orbit").exists());
}

#[test]
fn unwritable_outputs_are_named() {
    let place = Place::with_run();
    place.fails(
        "train scene --preset small --steps 1 --out scene/transforms_test.json/run",
        &["transforms_test.json/run: cannot be"],
    );
    place.fails(
        "train scene --preset small --steps 1 --out scene/transforms_test.json",
        &["transforms_test.json: cannot be used"],
    );
    place.fails_with(
        "render run --out run/config.json/frames",
        "run/config.json/frames: `config.json` belongs to a run: choose another name",
    );
    place.fails("render run --out absent/picture.png", &["absent: cannot be written to"]);
    std::fs::create_dir(place.path("folder.gif")).unwrap();
    place.fails_with("render run --out folder.gif", "folder.gif: is a folder, not a file");
    // A file is in the place of the image folder.
    std::fs::write(place.path("run/eval-test"), b"").unwrap();
    place.fails("eval run", &["run/eval-test: cannot be created"]);
    assert_eq!(place.bytes("run/eval-test"), b"");
}

#[test]
fn carving_votes_are_configurable() {
    let place = Place::with_scene();
    for (flag, expected) in [("", 3), ("--carve 0", 0), ("--carve 5 --skip near-lossless", 5)] {
        place.succeeds(&format!("train scene --steps 1 --out run-{expected} {SMALL} {flag}"));
        let config = place.json(&format!("run-{expected}/config.json"));
        assert_eq!(config["config"]["sampler"]["occupancy"]["skip"]["carving"], expected, "{config}");
    }
    place.fails_with(
        "train scene --preset small --steps 1 --carve 2",
        "`carve`: the preset small has no occupancy grid to carve: add --skip fast",
    );
}

#[test]
fn embeddings_and_poses_are_trained_and_stored() {
    let place = Place::with_scene();
    let learned = r#"--set field.appearance_embedding_dim=4 --set poses={"constant":{"lr":0.001}}"#;
    place.succeeds(&format!("train scene --steps 20 --out run {SMALL} {learned}"));
    let config = place.json("run/config.json");
    let fields = [&config["config"]["field"]["appearance_embedding_dim"], &config["scene_box"]["frames"]];
    assert_eq!(json!([fields, config["config"]["poses"]]), json!([[4, 6], { "constant": { "lr": 0.001 } }]));
    let mut model = captures::model(&place, "run");
    for (i, frame) in load(place.path("scene"), Split::Train, 1).unwrap().frames.iter().enumerate() {
        let [given, learned] = [frame.camera.pose, model.learned_camera(i, &frame.camera).pose];
        assert!(!learned.abs_diff_eq(given, 1e-4) && learned.abs_diff_eq(given, 0.5), "{i}: {given:?} {learned:?}");
    }
    // Evaluations show the stored model with the mean embedding, from a held-out camera in the model's coordinates.
    place.succeeds("eval run --split test");
    let shown = captures::rendered(&place, "run/eval-test-fast");
    let given = &load(place.path("scene"), Split::Test, 1).unwrap().frames[0].camera;
    let camera = model.other_camera(given);
    assert!(captures::apart(&shown, &model.render(&camera, [1.0; 3]).color) < 0.01);
    let looks = [0, 5].map(|image| {
        model.appearance_image = Some(image);
        model.render(&camera, [1.0; 3]).color
    });
    assert!(captures::apart(&looks[0], &looks[1]) > 1e-3, "each image has its own embedding");
}

#[test]
fn refined_cameras_are_reported() {
    let place = Place::with_scene();
    let runs = [("", "none", "none"), ("poses,focal,lens", "similarity of the training cameras", "as learned")];
    let glass = ("focal", "focal length and lens as learned", "as learned");
    for (i, (parts, test, train)) in runs.into_iter().chain([glass]).enumerate() {
        let refine = if parts.is_empty() { String::new() } else { format!("--refine {parts}") };
        place.succeeds(&format!("train scene --steps 2 --out run-{i} {SMALL} {refine}"));
        for (split, expected) in [("test", test), ("train", train)] {
            place.succeeds(&format!("eval run-{i} --split {split}"));
            let name = if split == "test" { "eval-test-fast" } else { "eval-train-fast" };
            assert_eq!(place.json(&format!("run-{i}/{name}.json"))["cameras"], expected);
        }
    }
}

#[test]
fn bad_arguments_are_usage_errors() {
    let place = Place::empty();
    let bad = [
        ("fly", "unrecognized subcommand"),
        ("train --no-such", "unexpected argument"),
        ("train --budget 10m --steps 5", "cannot be used with"),
        ("train --budget 10", "90s, 10m or 1.5h"),
        ("train --budget 0s", "more than 0"),
        ("train --steps 0", "write a whole number of at least 1"),
        ("train --downscale 0", "write a whole number from 1 to 16384"),
        ("train --threads 0", "write a whole number from 1 to 1024"),
        ("train --preset huge", "use classic, small, instant or voxel"),
        ("train --background grey", "white, black, random or expected"),
        ("train --refine all", "use poses, focal, lens, exposure or vignetting"),
        ("eval", "required arguments"),
        ("eval run --split all", "use train, val or test"),
        ("eval run --views 0", "write a whole number of at least 1"),
        ("render run --size 0x0", "WIDTHxHEIGHT"),
        ("render run --path fly", "use orbit, spiral, spline, test or a FILE.json"),
    ];
    for (arguments, expected) in bad {
        let output = place.command(arguments).output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && message.contains(expected), "{arguments}: {message}");
    }
    let output = place.command("train --steps 1").env("RAYGRAD_SIMD", "avx").output().unwrap();
    complained("RAYGRAD_SIMD", &output, &["RAYGRAD_SIMD is \"avx\"", "scalar, v3 or v4"]);
    // Page options without a page are errors before training.
    for place_of_page in ["--host ::1", "--port 7000"] {
        place.fails_with(
            &format!("train --steps 1 {place_of_page}"),
            "`view`: is missing: --host and --port need --view",
        );
    }
    assert_eq!(std::fs::read_dir(place.path("")).unwrap().count(), 0);
}

#[test]
fn closed_pipe_is_not_an_error() {
    let place = Place::with_run();
    let mut child = place.command("eval run").stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
    assert!(place.path("run/eval-test.json").exists());
}

#[cfg(unix)]
#[test]
fn ctrl_c_saves_the_model() {
    let place = Place::with_scene();
    let mut command = place.command("train scene --preset small --budget 1h");
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    // The first line of the metrics is written when training has begun.
    wait(&mut child, || std::fs::metadata(place.path("run/metrics.jsonl")).is_ok_and(|file| file.len() > 0));
    let untrained = place.bytes("run/model.safetensors");
    let sent = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("stopped"), "{output:?}");
    assert_ne!(place.bytes("run/model.safetensors"), untrained);
    place.succeeds("eval run --views 1");
}

/// Waits for a condition while the program runs, at most a minute.
#[cfg(unix)]
fn wait(child: &mut std::process::Child, holds: impl Fn() -> bool) {
    use std::time::{Duration, Instant};
    let start = Instant::now();
    while !holds() {
        let running = child.try_wait().unwrap().is_none() && start.elapsed() < Duration::from_secs(60);
        if !running {
            let _ = child.kill();
            panic!("the program ended, or did not get there in a minute");
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn quadrature_is_configurable_and_round_trips() {
    let place = Place::with_scene();
    let set = "--set sampler.samples=512 --set sampler.occupancy.resolution=32 --set field.resolution=16 --set sampler.view_step=0.01";
    let blank = psnr_of_mean_colours(&place, 1);
    for rule in ["left", "piecewise-linear", "gauss2", r#"{"adaptive":{"tolerance":0.01}}"#] {
        place.succeeds(&format!(
            "train scene --preset voxel --steps 20 {set} --set sampler.quadrature={rule} --out run"
        ));
        let stored = place.json("run/config.json")["config"]["sampler"]["quadrature"].clone();
        assert_eq!(stored, serde_json::from_str::<Value>(rule).unwrap_or_else(|_| json!(rule)));
        let report: Value = serde_json::from_str(&place.succeeds("eval run --views 1 --json --precision f64")).unwrap();
        assert!(report["psnr_mean"].as_f64().unwrap() > blank + 2.0, "{rule}: {blank} {report}");
        assert_eq!(report["precision"], "f64");
        std::fs::remove_dir_all(place.path("run")).unwrap();
    }
    let train = format!("train scene --preset voxel --steps 3 {set} --set sampler.quadrature");
    place.fails(&format!("{train}=simpson"), &["sampler.quadrature", "simpson"]);
    let adaptive = r#"{"adaptive":{"tolerance":7}}"#;
    place.fails(&format!("{train}={adaptive}"), &["quadrature.adaptive.tolerance", "is 7"]);
}

#[test]
fn quadrature_benchmark_writes_tables_and_page() {
    let place = Place::empty();
    let bench = "bench --suite quadrature --quick --out";
    // A killed benchmark is repeated.
    let killed = |out: &str, flags: &str| {
        let mut child = place.command(&format!("{bench} {out} {flags}"));
        let mut child = child.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let mut said = String::new();
        BufReader::new(child.stderr.take().unwrap()).read_line(&mut said).unwrap();
        assert!(said.starts_with("quadrature: "), "{said}");
        child.kill().unwrap();
        child.wait().unwrap();
    };
    killed("results", "");
    let printed = place.succeeds(&format!("{bench} results"));
    assert!(printed.contains("at 128 evaluations") && printed.contains("report.html"), "{printed}");
    let text = |name: &str| String::from_utf8(place.bytes(&format!("results/{name}"))).unwrap();
    let table = text("quadrature.csv");
    assert!(table.starts_with("scene,rule,evaluations,") && table.lines().count() > 150, "{table}");
    let page = text("report.html");
    assert!(page.contains("<svg") && page.contains("processor") && page.contains("quadrature-128.csv"));
    for figure in ["quadrature-colour", "quadrature-depth", "quadrature-gradient", "quadrature-time"] {
        assert!(text(&format!("{figure}.svg")).contains("midpoint"));
        assert!(png(&place.path(&format!("results/{figure}.png"))).width > 1000);
    }
    // The existing report stays until the next one is complete.
    killed("results", "");
    assert_eq!(text("report.html"), page);
    std::fs::write(place.path("file"), "").unwrap();
    place.fails(&format!("{bench} file"), &["file: cannot be created"]);
    // Foreign files are replaced on request.
    std::fs::create_dir(place.path("others")).unwrap();
    std::fs::write(place.path("others/plot.png"), "").unwrap();
    place.fails_with(
        &format!("{bench} others"),
        "others: holds files of something else: choose another --out or add --overwrite",
    );
    assert_eq!(std::fs::read_dir(place.path("others")).unwrap().count(), 1);
    killed("others", "--overwrite");
    assert!(place.path("others/report.html").exists() && place.path("others/plot.png").exists());
}
