//! Captures whose files are damaged: what is accepted can be used. A step is trained on it, and a view is rendered.

use damage::{Damage, clear, damage, damaged};
use proptest::prelude::*;
use raygrad_nerf::dataset::formats::{blender, colmap, llff, transforms};
use raygrad_nerf::dataset::{Capture, Format, Image, Reading, Split, View};
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
    Capture {
        folder: folder.into(),
        file: folder.join("transforms.json"),
        format: Format::Transforms,
        views: (0..VIEWS).map(view).collect(),
        points: vec![],
        aabb_scale: None,
        applied: DAffine3::IDENTITY,
    }
}

/// Writes a capture of one of the formats; gives the files that describe its cameras.
fn written(which: usize, folder: &Path) -> Vec<PathBuf> {
    let capture = capture(folder, if which < 2 { "images/" } else { "" });
    let (done, files) = match which {
        0 => (transforms::write(&capture, folder), vec!["transforms.json"]),
        1 => (blender::write(&capture, folder), vec!["transforms_train.json", "transforms_test.json"]),
        2 => (
            colmap::write(&capture, folder, colmap::Encoding::Text),
            vec!["sparse/0/cameras.txt", "sparse/0/images.txt"],
        ),
        3 => (
            colmap::write(&capture, folder, colmap::Encoding::Binary),
            vec!["sparse/0/cameras.bin", "sparse/0/images.bin"],
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

/// Reads a capture, trains one step on it and renders a view.
fn used(folder: &Path) -> Result<Image> {
    let capture = Capture::read(folder)?;
    let survey = capture.survey(None)?;
    let data = capture.load(Split::Train, &survey, &Reading::default())?;
    let mut config = tiny().with_scope(data.scope);
    let sampler = config.sampler.get_mut::<MarchingConfig>().unwrap();
    (sampler.samples, sampler.occupancy.resolution) = (256, 16);
    let camera = data.frames[0].camera.clone();
    let mut trainer = Trainer::new(config, Arc::new(data))?;
    trainer.step(0.0);
    Ok(trainer.model.view(&camera, [1.0; 3]).color)
}

/// How many are tried: few, or what PROPTEST_CASES says.
fn cases() -> ProptestConfig {
    let cases = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(300);
    ProptestConfig { cases, ..ProptestConfig::default() }
}

#[test]
fn what_is_accepted_of_damaged_captures_is_trained_and_rendered() {
    let folders: Vec<tempfile::TempDir> = (0..5).map(|_| tempfile::tempdir().unwrap()).collect();
    let files: Vec<Vec<PathBuf>> = folders.iter().enumerate().map(|(i, folder)| written(i, folder.path())).collect();
    let whole: Vec<Vec<Vec<u8>>> =
        files.iter().map(|files| files.iter().map(|file| std::fs::read(file).unwrap()).collect()).collect();
    for (which, folder) in folders.iter().enumerate() {
        let view = used(folder.path()).unwrap();
        assert!([view.width, view.height] == [8, 6] && view.data.iter().all(|x| x.is_finite()), "{which}");
    }
    let accepted = Cell::new(0);
    let strategy = (0..5_usize, any::<prop::sample::Index>(), damage());
    proptest!(cases(), |((which, file, damage) in strategy)| {
        let damage: Vec<Damage> = damage;
        let file = file.index(files[which].len());
        std::fs::write(&files[which][file], damaged(&whole[which][file], &damage)).unwrap();
        let result = used(folders[which].path());
        std::fs::write(&files[which][file], &whole[which][file]).unwrap();
        match result {
            Ok(view) => {
                accepted.set(accepted.get() + 1);
                prop_assert!(view.data.iter().all(|x| x.is_finite()));
            }
            Err(error) => clear(error, ""),
        }
    });
    println!("{} were accepted", accepted.get());
    assert!(accepted.get() > 10);
}
