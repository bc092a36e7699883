//! Accepted captures with damaged files are usable: a training step and a render succeed.

use proptest::prelude::*;
use raygrad_nerf::dataset::formats::{blender, colmap, llff, transforms};
use raygrad_nerf::dataset::{Capture, Format, Image, LoadOptions, Point, SceneAnalysis, Split, View};
use raygrad_nerf::encoding::hash_grid::HashGridConfig;
use raygrad_nerf::glam::DVec3;
use raygrad_nerf::sampling::marching::MarchingConfig;
use raygrad_nerf::{Camera, Config, InstantConfig, Preset, Result, Trainer};
use raygrad_test_support::damage::{Damage, clear, damage, damaged};
use raygrad_test_support::memory::peak;
use raygrad_test_support::tally::{Bound, Tally, cases};
use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Images of a capture.
const VIEWS: usize = 5;

/// Writes a capture of grey images whose names begin with `prefix`.
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
            image: Some(image),
            split: Some(if i == 0 { Split::Test } else { Split::Train }),
            bounds: Some([1.0, 6.0]),
            ..View::new(
                name,
                format!("frames[{i}]"),
                Camera::from_angle(8, 6, 0.9, Camera::look_at(place, DVec3::ZERO, DVec3::Z)),
            )
        }
    };
    let point = |i: usize| Point {
        position: DVec3::new((i % 3) as f64, (i % 5) as f64, (i % 7) as f64) / 7.0,
        color: [6 * i as u8, 128, 255],
        error: 0.5,
        views: 3,
    };
    Capture {
        points: (0..40).map(point).collect(),
        ..Capture::new(folder, folder.join("transforms.json"), Format::Transforms, (0..VIEWS).map(view).collect())
    }
}

/// Files of a format; one at a time is damaged.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Transforms,
    Ply,
    Blender,
    ColmapText,
    ColmapBinary,
    Llff,
}

impl Kind {
    /// Writes a capture; returns the files of this kind.
    fn write(self, folder: &Path) -> Vec<PathBuf> {
        let prefix = if matches!(self, Kind::Transforms | Kind::Ply | Kind::Blender) { "images/" } else { "" };
        let capture = capture(folder, prefix);
        let (done, files) = match self {
            Kind::Transforms => (transforms::write(&capture, folder), vec!["transforms.json"]),
            Kind::Ply => (transforms::write(&capture, folder), vec!["sparse_pc.ply"]),
            Kind::Blender => (blender::write(&capture, folder), vec!["transforms_train.json", "transforms_test.json"]),
            Kind::ColmapText => (
                colmap::write(&capture, folder, colmap::Encoding::Text),
                vec!["sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"],
            ),
            Kind::ColmapBinary => (
                colmap::write(&capture, folder, colmap::Encoding::Binary),
                vec!["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"],
            ),
            Kind::Llff => (llff::write(&capture, folder), vec!["poses_bounds.npy"]),
        };
        done.unwrap();
        files.into_iter().map(|file| folder.join(file)).collect()
    }
}

/// An object of one member takes 7 bytes of a document and about 600 of memory. The rest of a capture is small.
const BOUND: Bound = Bound { times: 256, plus: 1 << 18 };

/// The smallest model.
fn tiny() -> Config {
    let mut config = Config::preset(Preset::Instant);
    let field = config.field.get_mut::<InstantConfig>().unwrap();
    field.grid = HashGridConfig { levels: 2, features: 2, log2_table: 8, coarsest: 2, finest: 8 };
    (field.density_width, field.color_width) = (8, 8);
    config
}

/// The results of a training step on a damaged capture, and a render by its first camera.
struct Outcome {
    loss: f64,
    view: Image,
    /// The camera's size.
    size: [usize; 2],
}

impl Outcome {
    fn is_right(&self) -> bool {
        let whole = self.view.data.iter().all(|x| x.is_finite());
        self.loss.is_finite() && [self.view.width, self.view.height] == self.size && whole
    }
}

/// Reads and analyses a capture.
fn read(folder: &Path) -> Result<(Capture, SceneAnalysis)> {
    let capture = Capture::read(folder)?;
    let analysis = capture.analyze_scene(None)?;
    Ok((capture, analysis))
}

/// Trains one step on a capture and renders it.
fn used((capture, analysis): &(Capture, SceneAnalysis)) -> Result<Outcome> {
    let data = capture.load(Split::Train, analysis, &LoadOptions::default())?;
    let mut config = tiny().with_scene_type(data.scene_type);
    let sampler = config.sampler.get_mut::<MarchingConfig>().unwrap();
    (sampler.samples, sampler.occupancy.resolution) = (256, 16);
    // Long steps save time: the number of samples per ray does not matter here.
    (sampler.step, sampler.view_step) = (0.25, 0.25);
    let camera = data.frames[0].camera.clone();
    let mut trainer = Trainer::new(config, Arc::new(data))?;
    let loss = trainer.step(0.0).loss;
    Ok(Outcome { loss, view: trainer.model.render(&camera, [1.0; 3]).color, size: [camera.width, camera.height] })
}

/// Damage that often leaves a file valid: digits for digits, and a few other bytes.
fn light() -> impl Strategy<Value = Vec<Damage>> {
    let one = (0.0..1.0_f64, prop_oneof![4 => b'0'..=b'9', 1 => any::<u8>()]);
    prop::collection::vec(one.prop_map(|(at, byte)| Damage::Set(at, byte)), 1..3)
}

/// Of the accepted captures after this many, one in a hundred is used. A million of each format then take about an
/// hour.
const ALL_USED: u64 = 5_000;

/// Tests damaged files of a kind.
fn campaign(kind: Kind) {
    // One thread, so that the memory can be measured.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    pool.install(|| damage_again_and_again(kind));
}

fn damage_again_and_again(kind: Kind) {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    let files = kind.write(folder);
    let whole: Vec<Vec<u8>> = files.iter().map(|file| std::fs::read(file).unwrap()).collect();
    let outcome = used(&read(folder).unwrap()).unwrap();
    assert!(outcome.size == [8, 6] && outcome.is_right(), "{kind:?}");
    let tally = Tally::new(&format!("{kind:?}"));
    let trained = Cell::new(0_u64);
    let which = any::<prop::sample::Index>;
    let strategy = (which(), which(), prop_oneof![damage(), light()]);
    proptest!(cases(), |((file, other, damage) in strategy)| {
        let (file, other) = (file.index(files.len()), other.get(&whole));
        let bytes = damaged(&whole[file], other, &damage);
        std::fs::write(&files[file], &bytes).unwrap();
        // All other files are read too.
        let length = whole.iter().map(Vec::len).sum::<usize>() + bytes.len();
        let captured = tally.parse(length, BOUND, || read(folder));
        let [accepted, _] = tally.counts();
        let outcome = match captured {
            Ok(captured) if accepted < ALL_USED || accepted.is_multiple_of(100) => used(&captured).map(Some),
            captured => captured.map(|_| None),
        };
        std::fs::write(&files[file], &whole[file]).unwrap();
        match outcome {
            Ok(Some(outcome)) => {
                trained.set(trained.get() + 1);
                prop_assert!(outcome.is_right(), "{:?}", kind);
            }
            Ok(None) => {}
            Err(error) => {
                let folder = folder.to_str().unwrap();
                let named = error.to_string().contains(folder);
                clear(error, if named { folder } else { "`" });
            }
        }
    });
    let [accepted, refused] = tally.counts();
    assert!(accepted > 5 && trained.get() > 5, "{kind:?}: {accepted} accepted");
    // Damaged points are left out.
    assert_eq!(refused > 5, kind != Kind::Ply, "{kind:?}: {refused} refused");
}

#[test]
fn campaign_transforms() {
    campaign(Kind::Transforms);
}

#[test]
fn campaign_points_in_ply_files() {
    campaign(Kind::Ply);
}

#[test]
fn campaign_blender() {
    campaign(Kind::Blender);
}

#[test]
fn campaign_colmap_text() {
    campaign(Kind::ColmapText);
}

#[test]
fn campaign_colmap_binary() {
    campaign(Kind::ColmapBinary);
}

#[test]
fn campaign_llff() {
    campaign(Kind::Llff);
}

/// Counts and sizes that no memory could hold.
#[test]
fn captures_announcing_huge_sizes_take_little_memory() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let result_of = |kind: Kind, file: usize, change: &(dyn Fn(&mut Vec<u8>) + Sync)| {
        let folder = tempfile::tempdir().unwrap();
        let files = kind.write(folder.path());
        let mut bytes = std::fs::read(&files[file]).unwrap();
        change(&mut bytes);
        std::fs::write(&files[file], &bytes).unwrap();
        let (result, taken) = pool.install(|| peak(|| read(folder.path())));
        assert!(taken <= 1 << 20, "{kind:?} {file}: {taken} bytes of memory");
        result.map(|(capture, _)| capture).map_err(|error| clear(error, folder.path().to_str().unwrap()))
    };
    let refused = |kind: Kind, file: usize, change: &(dyn Fn(&mut Vec<u8>) + Sync)| {
        assert!(result_of(kind, file, change).is_err(), "{kind:?} {file} is accepted");
    };
    // Points that the file does not hold are left out.
    let points = |kind: Kind, file: usize, change: &(dyn Fn(&mut Vec<u8>) + Sync)| {
        let capture = result_of(kind, file, change).unwrap();
        assert_eq!((capture.points.len(), capture.assumptions.len()), (40, 1), "{:?}", capture.assumptions);
    };
    let replace = |bytes: &mut Vec<u8>, from: &str, to: &str| {
        let start = bytes.windows(from.len()).position(|part| part == from.as_bytes()).expect(from);
        bytes.splice(start..start + from.len(), to.bytes());
    };
    for count in [1 << 62, u64::MAX, u64::MAX / 64 + 2, 1 << 40, 100_000] {
        for file in 0..2 {
            refused(Kind::ColmapBinary, file, &|bytes| bytes[..8].copy_from_slice(&count.to_le_bytes()));
        }
        points(Kind::ColmapBinary, 2, &|bytes| bytes[..8].copy_from_slice(&count.to_le_bytes()));
        // The observations of the first image; then an endless name.
        refused(Kind::ColmapBinary, 1, &|bytes| {
            let end = 8 + 64 + bytes[72..].iter().position(|byte| *byte == 0).unwrap() + 1;
            bytes[end..end + 8].copy_from_slice(&count.to_le_bytes());
        });
        points(Kind::Ply, 0, &|bytes| replace(bytes, "element vertex 40", &format!("element vertex {count}")));
        refused(Kind::Llff, 0, &|bytes| replace(bytes, "(5, 17)", &format!("({count}, 17)")));
        refused(Kind::Llff, 0, &|bytes| replace(bytes, "(5, 17)", &format!("({count}, {count})")));
        // Smaller widths may be valid.
        if count > 1 << 24 {
            refused(Kind::Transforms, 0, &|bytes| replace(bytes, "\"w\": 8", &format!("\"w\": {count}")));
        }
    }
    refused(Kind::Llff, 0, &|bytes| bytes[6..12].copy_from_slice(&[2, 0, 0xff, 0xff, 0xff, 0xff]));
    refused(Kind::ColmapBinary, 1, &|bytes| bytes.iter_mut().skip(72).for_each(|byte| *byte |= 1));
    for open in ["[", "{\"a\":"] {
        refused(Kind::Transforms, 0, &|bytes| *bytes = open.repeat(20_000).into());
        refused(Kind::Blender, 1, &|bytes| *bytes = open.repeat(20_000).into());
    }
}
