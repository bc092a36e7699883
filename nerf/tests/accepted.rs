//! Captures whose files are damaged: what is accepted can be used. A step is trained on it, and a view is rendered.

use damage::{Damage, clear, damage, damaged};
use proptest::prelude::*;
use raygrad_nerf::dataset::formats::{blender, colmap, llff, transforms};
use raygrad_nerf::dataset::{Capture, Format, Image, Point, Reading, Split, View};
use raygrad_nerf::encoding::hash_grid::HashGridConfig;
use raygrad_nerf::glam::{DAffine3, DVec3};
use raygrad_nerf::sampling::marching::MarchingConfig;
use raygrad_nerf::{Camera, Config, InstantConfig, Preset, Result, Trainer};
use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::sync::Arc;

#[path = "../../tests/stability/damage.rs"]
mod damage;

/// Photographs of a capture.
const VIEWS: usize = 5;

/// A capture of grey photographs, which are written, with names that begin like that.
fn capture(folder: &Path, prefix: &str) -> Capture {
    std::fs::create_dir_all(folder.join("images")).unwrap();
    let view = |i: usize| {
        let (name, angle) = (format!("{prefix}{i}.png"), i as f64);
        let image = folder.join(format!("images/{i}.png"));
        let mut picture = Image::new(8, 6, 3);
        picture.data.iter_mut().enumerate().for_each(|(k, x)| *x = ((i + k) % 5) as f32 / 4.0);
        picture.save_png(&image).unwrap();
        let place = 3.0 * DVec3::new(angle.cos(), angle.sin(), 0.5);
        View {
            name,
            field: format!("frames[{i}]"),
            image: Some(image),
            camera: Camera::from_angle(8, 6, 0.9, Camera::look_at(place, DVec3::ZERO, DVec3::Z)),
            split: Some(if i == 0 { Split::Test } else { Split::Train }),
            mask: None,
            depth: None,
            sharpness: None,
            bounds: Some([1.0, 6.0]),
        }
    };
    let point = |i: usize| Point {
        position: DVec3::new((i % 3) as f64, (i % 5) as f64, (i % 7) as f64) / 7.0,
        color: [6 * i as u8, 128, 255],
        error: 0.5,
        views: 3,
    };
    Capture {
        folder: folder.into(),
        file: folder.join("transforms.json"),
        format: Format::Transforms,
        views: (0..VIEWS).map(view).collect(),
        points: (0..40).map(point).collect(),
        aabb_scale: None,
        applied: DAffine3::IDENTITY,
    }
}

/// What the formats are called.
const FORMATS: [&str; 5] = ["transforms", "blender", "colmap text", "colmap binary", "llff"];

/// Writes a capture of one of the formats; gives the files that describe its cameras and points.
fn written(which: usize, folder: &Path) -> Vec<PathBuf> {
    let capture = capture(folder, if which < 2 { "images/" } else { "" });
    let (done, files) = match which {
        0 => (transforms::write(&capture, folder), vec!["transforms.json", "sparse_pc.ply"]),
        1 => (blender::write(&capture, folder), vec!["transforms_train.json", "transforms_test.json"]),
        2 => (
            colmap::write(&capture, folder, colmap::Encoding::Text),
            vec!["sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"],
        ),
        3 => (
            colmap::write(&capture, folder, colmap::Encoding::Binary),
            vec!["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"],
        ),
        _ => (llff::write(&capture, folder), vec!["poses_bounds.npy"]),
    };
    done.unwrap();
    files.into_iter().map(|file| folder.join(file)).collect()
}

/// The smallest model.
fn tiny() -> Config {
    let mut config = Config::preset(Preset::Instant);
    let field = config.field.get_mut::<InstantConfig>().unwrap();
    field.grid = HashGridConfig { levels: 2, features: 2, log2_table: 8, coarsest: 2, finest: 8 };
    (field.density_width, field.color_width) = (8, 8);
    config
}

/// What became of a damaged capture.
enum Outcome {
    /// It was trained on for a step of this loss, and this was rendered from the first of its cameras of that size.
    Used(f64, Image, [usize; 2]),
    /// It was read.
    Accepted,
}

/// Reads a capture and, if it is to be `used`, trains one step on it and renders a view.
fn tried(folder: &Path, used: bool) -> Result<Outcome> {
    let capture = Capture::read(folder)?;
    let survey = capture.survey(None)?;
    if !used {
        return Ok(Outcome::Accepted);
    }
    let data = capture.load(Split::Train, &survey, &Reading::default())?;
    let mut config = tiny().with_scope(data.scope);
    let sampler = config.sampler.get_mut::<MarchingConfig>().unwrap();
    (sampler.samples, sampler.occupancy.resolution) = (256, 16);
    let camera = data.frames[0].camera.clone();
    let mut trainer = Trainer::new(config, Arc::new(data))?;
    let loss = trainer.step(0.0).loss;
    Ok(Outcome::Used(loss, trainer.model.view(&camera, [1.0; 3]).color, [camera.width, camera.height]))
}

/// Damage that leaves a file a file, as often as not: digits for digits, and other bytes.
fn light() -> impl Strategy<Value = Vec<Damage>> {
    let one = (0.0..1.0_f64, prop_oneof![4 => b'0'..=b'9', 1 => any::<u8>()]);
    prop::collection::vec(one.prop_map(|(at, byte)| Damage::Set(at, byte)), 1..3)
}

/// How many are tried: few, or what PROPTEST_CASES says.
fn cases() -> ProptestConfig {
    let cases = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(600);
    ProptestConfig { cases, ..ProptestConfig::default() }
}

/// Of more accepted captures than this one in a hundred is used, so that a million of each format can be tried in an hour.
const ALL_USED: u32 = 5_000;

#[test]
fn what_is_accepted_of_damaged_captures_is_trained_and_rendered() {
    let folders: Vec<tempfile::TempDir> = FORMATS.iter().map(|_| tempfile::tempdir().unwrap()).collect();
    let files: Vec<Vec<PathBuf>> = folders.iter().enumerate().map(|(i, folder)| written(i, folder.path())).collect();
    let whole: Vec<Vec<Vec<u8>>> =
        files.iter().map(|files| files.iter().map(|file| std::fs::read(file).unwrap()).collect()).collect();
    let right = |outcome: &Outcome| match outcome {
        Outcome::Used(loss, view, size) => {
            loss.is_finite() && [view.width, view.height] == *size && view.data.iter().all(|x| x.is_finite())
        }
        Outcome::Accepted => true,
    };
    for (format, folder) in FORMATS.iter().zip(&folders) {
        let outcome = tried(folder.path(), true).unwrap();
        assert!(matches!(outcome, Outcome::Used(_, _, [8, 6])) && right(&outcome), "{format}");
    }
    // Of each format: tried, accepted, used.
    let counts: [[Cell<u32>; 3]; FORMATS.len()] = Default::default();
    let count = |which: usize, what: usize| counts[which][what].set(counts[which][what].get() + 1);
    let strategy = (0..FORMATS.len(), any::<prop::sample::Index>(), prop_oneof![damage(), light()]);
    proptest!(cases(), |((which, file, damage) in strategy)| {
        let file = file.index(files[which].len());
        std::fs::write(&files[which][file], damaged(&whole[which][file], &damage)).unwrap();
        let accepted = counts[which][1].get();
        let outcome = tried(folders[which].path(), accepted < ALL_USED || accepted.is_multiple_of(100));
        std::fs::write(&files[which][file], &whole[which][file]).unwrap();
        count(which, 0);
        match outcome {
            Ok(outcome) => {
                count(which, 1);
                if let Outcome::Used(..) = outcome {
                    count(which, 2);
                }
                prop_assert!(right(&outcome), "{}", FORMATS[which]);
            }
            Err(error) => {
                let folder = folders[which].path().to_str().unwrap();
                let named = error.to_string().contains(folder);
                clear(error, if named { folder } else { "`" });
            }
        }
    });
    let counts = counts.map(|counts| counts.map(|count| count.get()));
    for (format, [tried, accepted, used]) in FORMATS.iter().zip(counts) {
        println!("{format}: {tried} tried, {accepted} accepted, {used} of them used");
        assert!(accepted > 5 && used > 5, "{format}: {accepted} of {tried} accepted");
    }
}
