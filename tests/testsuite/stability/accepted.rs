//! Damaged captures that the readers accept go through everything that follows: checks, conversion, training, rendering.
//!
//! The suite takes one for each file. `ACCEPTED=200 cargo test --release --test testsuite accepted -- --nocapture` takes
//! two hundred for each of five files.

use proptest::strategy::{Strategy, ValueTree};
use proptest::test_runner::TestRunner;
use raygrad::nerf::dataset::formats::colmap::{self, Encoding};
use raygrad::nerf::dataset::formats::{blender, llff, transforms};
use raygrad::nerf::dataset::{Capture, Image, LoadOptions, Split};
use raygrad::nerf::doctor::{DoctorOptions, examine};
use raygrad::nerf::sampling::marching::MarchingConfig;
use raygrad::nerf::{Background, Camera, Config, Trainer};
use raygrad_test_support::damage::{clear, damage, damaged};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// The number of accepted captures of each format.
fn wanted() -> usize {
    std::env::var("ACCEPTED").ok().and_then(|count| count.parse().ok()).unwrap_or(1)
}

/// A capture of three images of 6 x 4 pixels as a nerfstudio dataset, with a lens.
fn nerfstudio(folder: &Path) {
    std::fs::create_dir_all(folder.join("images")).unwrap();
    let frames: Vec<_> = (0..3)
        .map(|i| {
            let data = (0..6 * 4 * 3).map(|k| ((k * (i + 2)) % 17) as f32 / 16.0).collect();
            let name = format!("images/{i}.png");
            std::fs::write(folder.join(&name), Image { width: 6, height: 4, channels: 3, data }.to_png()).unwrap();
            let (sin, cos) = (0.7 * i as f64).sin_cos();
            serde_json::json!({ "file_path": name, "transform_matrix":
                [[-sin, 0.0, cos, 4.0 * cos], [cos, 0.0, sin, 4.0 * sin], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0]] })
        })
        .collect();
    let scene = serde_json::json!({ "camera_model": "OPENCV", "w": 6, "h": 4, "fl_x": 6.0, "fl_y": 6.1, "cx": 3.0,
        "cy": 2.0, "k1": -0.05, "k2": 0.01, "p1": 0.001, "p2": 0.0, "frames": frames });
    std::fs::write(folder.join("transforms.json"), scene.to_string()).unwrap();
}

/// A model whose steps take milliseconds.
fn config() -> Config {
    let mut config = super::fuzz::config();
    if let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() {
        (sampler.samples, sampler.step, sampler.view_step) = (256, 0.1, 0.1);
    }
    config
}

/// Reads a capture and does all that follows; an error is clear and ends it. Returns true if it was trained on.
fn use_capture(folder: &Path) -> bool {
    let stop = |error: raygrad::nerf::Error| {
        clear(error, "");
        false
    };
    let capture = match Capture::read(folder) {
        Ok(capture) => capture,
        Err(error) => return stop(error),
    };
    let analysis = capture.analyze_scene(None);
    examine(&capture, analysis.as_ref(), &DoctorOptions::default());
    let out = tempfile::tempdir().unwrap();
    let at = |name: &str| {
        let folder = out.path().join(name);
        std::fs::create_dir(&folder).unwrap();
        folder
    };
    for written in [
        transforms::write(&capture, &at("nerfstudio")),
        blender::write(&capture, &at("blender")),
        colmap::write(&capture, &at("colmap"), Encoding::Binary),
        colmap::write(&capture, &at("text"), Encoding::Text),
        llff::write(&capture, &at("llff")),
    ] {
        if let Err(error) = written {
            stop(error);
        }
    }
    // What was written is read again, where the format could hold it.
    for name in ["nerfstudio", "colmap", "text"] {
        let folder = out.path().join(name);
        if std::fs::read_dir(&folder).unwrap().next().is_some()
            && let Err(error) = Capture::read(&folder)
        {
            stop(error);
        }
    }
    let cameras: Vec<&Camera> = capture.views.iter().map(|view| &view.camera).collect();
    if let Err(error) = Camera::undistorted(&cameras) {
        stop(error);
    }
    let loaded = analysis.and_then(|analysis| capture.load(Split::Train, &analysis, &LoadOptions::default()));
    let data = match loaded {
        Ok(data) => Arc::new(data),
        Err(error) => return stop(error),
    };
    let mut trainer = match Trainer::new(config().with_scene_type(data.scene_type), data.clone()) {
        Ok(trainer) => trainer,
        Err(error) => return stop(error),
    };
    for step in 0..20 {
        trainer.step(f64::from(step) / 20.0);
    }
    assert!(trainer.first_non_finite(1.0).is_none(), "training is finite");
    let frame = &data.frames[0];
    let render = trainer.model.render(&frame.camera, Background::White.shown());
    assert!(render.color.data.iter().all(|x| (0.0..=1.0).contains(x)), "the render is finite");
    true
}

/// Damages a file of a capture until as many damaged ones as wanted were trained on.
fn campaign(name: &str, file: &str, make: impl Fn(&Path)) {
    let folder = tempfile::tempdir().unwrap();
    make(folder.path());
    assert!(use_capture(folder.path()), "{name}: the whole capture");
    let path = folder.path().join(file);
    let whole = std::fs::read(&path).unwrap();
    let (mut runner, start) = (TestRunner::deterministic(), Instant::now());
    let (mut tried, mut accepted) = (0, 0);
    while accepted < wanted() {
        let damage = damage().new_tree(&mut runner).unwrap().current();
        let bytes = damaged(&whole, &whole, &damage);
        tried += 1;
        assert!(tried < 1000 * (accepted + 10), "{name}: nothing is accepted");
        if bytes == whole {
            continue;
        }
        std::fs::write(&path, bytes).unwrap();
        accepted += usize::from(use_capture(folder.path()));
    }
    let seconds = start.elapsed().as_secs_f64();
    println!("accepted | {name} | {tried} damaged | {accepted} trained on | {seconds:.1} s");
}

#[test]
fn accepted_nerfstudio_captures_train_and_render() {
    campaign("transforms.json", "transforms.json", nerfstudio);
}

#[test]
fn accepted_colmap_models_train_and_render() {
    let colmap = |folder: &Path, encoding: Encoding| {
        let source = tempfile::tempdir().unwrap();
        nerfstudio(source.path());
        std::fs::create_dir(folder.join("images")).unwrap();
        let mut capture = Capture::read(source.path()).unwrap();
        for view in &mut capture.views {
            let image = view.image.take().unwrap();
            let name = image.file_name().unwrap().to_str().unwrap().to_owned();
            std::fs::copy(&image, folder.join("images").join(&name)).unwrap();
            (view.image, view.name) = (Some(folder.join("images").join(&name)), name);
        }
        capture.folder = folder.to_owned();
        colmap::write(&capture, folder, encoding).unwrap();
    };
    for file in ["cameras.txt", "images.txt"] {
        campaign(file, &format!("sparse/0/{file}"), |folder| colmap(folder, Encoding::Text));
    }
    for file in ["cameras.bin", "images.bin"] {
        campaign(file, &format!("sparse/0/{file}"), |folder| colmap(folder, Encoding::Binary));
    }
}
