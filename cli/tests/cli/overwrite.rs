//! Commands replace their own output and no other files.

use super::{Place, SMALL};
use raygrad::nerf::Image;

/// A place with a run, and an image at the given paths.
fn place(photographs: &[&str]) -> Place {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 2 --scene-type unbounded --out run {SMALL}"));
    for name in photographs {
        std::fs::create_dir_all(place.path(name).parent().unwrap()).unwrap();
        photograph().save_png(place.path(name)).unwrap();
    }
    place
}

fn photograph() -> Image {
    Image { width: 4, height: 3, channels: 3, data: vec![0.25; 36] }
}

/// Checks that a command fails because of this file and leaves it unchanged.
#[track_caller]
fn refuses(place: &Place, arguments: &str, file: &str) {
    let before = place.bytes(file);
    let expected = format!(
        "{file}: exists, and another command or other options made it: choose another output or add --overwrite"
    );
    place.fails(arguments, &[&expected]);
    assert!(place.bytes(file) == before, "{arguments} has changed {file}");
}

#[test]
fn foreign_outputs_are_refused_own_ones_replaced() {
    let place = place(&["p/0001.png", "scene/depth/0000.png", "photo.png", "video.gif.frames/0000.png"]);
    std::fs::write(place.path("walk.mp4"), b"footage").unwrap();
    std::fs::write(place.path("walk.gif"), b"footage").unwrap();
    let transforms = "scene/transforms_train.json";
    let frames = "--frames 2 --size 12x9";
    for (arguments, file) in [
        (format!("export run {transforms}"), transforms),
        (format!("render run {frames} --out p"), "p/0001.png"),
        (format!("render run {frames} --save normals,depth --out scene"), "scene/depth/0000.png"),
        (format!("render run {frames} --out photo.png"), "photo.png"),
        (format!("render run {frames} --out walk.gif"), "walk.gif"),
        (format!("render run {frames} --out walk.mp4"), "walk.mp4"),
        (format!("render run {frames} --out video.gif"), "video.gif.frames/0000.png"),
    ] {
        refuses(&place, &arguments, file);
    }
    assert!(
        !place.path("p/0000.png").exists()
            && !place.path("scene/0000.png").exists()
            && !place.path("video.gif").exists()
    );
    std::fs::remove_dir_all(place.path("video.gif.frames")).unwrap();
    // Each command replaces its own output, also after the model changed; another command does not.
    let commands =
        |out: &str| [format!("render run {frames} --out {out}"), format!("render run {frames} --fov 30 --out {out}")];
    let outputs = ["frames", "video.gif", "video.apng", "picture.png"];
    for out in outputs {
        let [command, other] = commands(out);
        place.succeeds(&command);
        place.succeeds(&command);
        refuses(&place, &other, if out == "frames" { "frames/0000.png" } else { out });
    }
    place.succeeds(&format!("render run {frames} --save depth --out deep"));
    let exports = [
        "cameras.json",
        "mesh.ply --iso-value 1e-6 --resolution 9",
        "mesh.obj --iso-value 1e-6 --resolution 9",
        "points.glb --points=9",
        "scene.html",
    ];
    for export in exports {
        place.succeeds(&format!("export run {export}"));
    }
    place.succeeds("train --resume run --steps 3");
    for out in outputs {
        let [command, other] = commands(out);
        place.succeeds(&command);
        place.succeeds(&format!("{other} --overwrite"));
        place.succeeds(&format!("{command} --overwrite"));
    }
    place.succeeds(&format!("render run {frames} --save depth --out deep"));
    for export in exports {
        place.succeeds(&format!("export run {export}"));
    }
    refuses(&place, "export run mesh.ply --iso-value 1e-6 --resolution 10", "mesh.ply");
    // Another run counts as another command, from any folder.
    place.succeeds(&format!("train scene --steps 2 --out other {SMALL}"));
    refuses(&place, &format!("render other {frames} --out video.gif"), "video.gif");
    refuses(&place, "export other cameras.json", "cameras.json");
    place.succeeds(&format!("render ./other/../run/ {frames} --out video.gif"));
    // `--overwrite` replaces it.
    place.succeeds(&format!("export run {transforms} --overwrite"));
    assert!(place.json(transforms)["frames"].is_array());
    // All flags that change the image count.
    for flag in ["--show depth", "--background black", "--skip off", "--precision f64", "--radius 2"] {
        refuses(&place, &format!("render run {frames} {flag} --out picture.png"), "picture.png");
    }
    refuses(&place, &format!("render run {frames} --out deep"), "deep/0000.png");
    refuses(&place, &format!("render run {frames} --save normals --out deep"), "deep/0000.png");
    refuses(&place, &format!("render run {frames} --save depth --depth-unit 0.5 --out deep"), "deep/depth/0000.png");
    // The run's own image folder is replaced without a flag.
    place.succeeds("render run --frames 1");
    place.succeeds("render run --frames 2 --fov 30");
}

#[test]
fn files_of_a_run_are_never_an_output() {
    let place = place(&[]);
    place.succeeds(&format!("train scene --steps 2 --out other --tensorboard {SMALL}"));
    for (arguments, name) in [
        ("export run run/config.json --overwrite", "config.json"),
        ("export run ./run/../run/summary.json --overwrite", "summary.json"),
        ("render run --frames 1 --out run/checkpoints --overwrite", "checkpoints"),
        ("render run --frames 1 --out run/previews/a.png --overwrite", "previews"),
        ("render run --frames 1 --out run/eval-test/0.png --overwrite", "eval-test"),
        ("export run run/Lock --to colmap", "lock"),
        // Files of another run neither.
        ("export run other/config.json --overwrite", "config.json"),
        ("render run --frames 1 --out other/tensorboard/0 --overwrite", "tensorboard"),
    ] {
        std::fs::create_dir_all(place.path("run/eval-test")).unwrap();
        place.fails(arguments, &[&format!("`{name}` belongs to a run: choose another name")]);
    }
    place.succeeds("train --resume run --steps 3");
    // New files beside them are allowed.
    place.succeeds("export run run/cameras.json");
    place.succeeds("render run --frames 1 --out run/picture.png");
}

#[test]
fn unknown_file_extensions_are_named() {
    let place = place(&[]);
    std::fs::write(place.path("walk.mp4"), b"footage").unwrap();
    for out in ["walk.mp4", "cameras", "cameras.txt", "mesh.stl"] {
        let expected = "use .json for cameras, .ply, .obj or .glb for a mesh, .html for a scene page";
        place.fails(&format!("export run {out}"), &[&format!("{out}: has no known file extension: "), expected]);
        place.fails(&format!("export run {out} --overwrite"), &[expected]);
    }
    assert_eq!(place.bytes("walk.mp4"), b"footage");
    for out in ["walk.mkv", "photo.jpg", "orbit.2"] {
        place.fails(
            &format!("render run --out {out}"),
            &["is not an image or video extension: use .png, .gif, .apng, .mp4 or .webm, or end a folder's name with \
               `/`"],
        );
    }
    place.succeeds("render run --frames 1 --out orbit.2/");
    assert!(place.path("orbit.2/0000.png").exists());
}

#[test]
fn doctor_replaces_its_own_files_alone() {
    let place = Place::with_scene();
    photograph().save_png(place.path("scene/cameras.png")).unwrap();
    let run = |arguments: &str| place.command(arguments).output().unwrap();
    // Warnings about a small capture are not errors of the command.
    for out in ["", "--out again"] {
        for _ in 0..2 {
            assert_eq!(run(&format!("doctor scene {out}")).status.code(), Some(3), "{out}");
        }
    }
    assert!(place.path("doctor/cameras.png").exists() && place.path("again/doctor.html").exists());
    refuses(&place, "doctor scene --out scene", "scene/cameras.png");
    assert!(!place.path("scene/doctor.html").exists());
    assert_eq!(run("doctor scene --out scene --overwrite").status.code(), Some(3));
}

#[test]
fn ffmpeg_videos_carry_the_mark_of_their_command() {
    if !super::render::has_ffmpeg() {
        return;
    }
    let place = place(&[]);
    for video in ["video.mp4", "video.webm"] {
        let command = format!("render run --frames 3 --size 12x9 --out {video}");
        place.succeeds(&command);
        place.succeeds(&command);
        refuses(&place, &format!("{command} --fov 30"), video);
    }
}
