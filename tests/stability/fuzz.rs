//! Every parser on damaged input: an error that names the file, and never a panic.

use crate::damage::{clear, damage, damaged};
use proptest::prelude::*;
use raygrad::nerf::dataset::{Capture, Reading, Split, load};
use raygrad::nerf::encoding::hash_grid::HashGridConfig;
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::sampling::marching::MarchingConfig;
use raygrad::nerf::space::occupancy::{OccupancyConfig, OccupancyGrid, Skip};
use raygrad::nerf::{Background, ClassicConfig, Config, Extent, Image, InstantConfig, Model, Preset};
use raygrad::{Params, Scalar, Storage, Tensor};
use std::collections::HashMap;
use std::path::Path;
use std::sync::LazyLock;

/// A dataset of two pictures of 4 x 4 pixels.
fn scene(folder: &Path) -> Vec<u8> {
    for i in 0..2 {
        let image = Image { width: 4, height: 4, channels: 4, data: vec![0.25 * (i + 1) as f32; 64] };
        std::fs::write(folder.join(format!("r_{i}.png")), image.to_png()).unwrap();
    }
    let text = r#"{ "camera_angle_x": 0.6911112070083618, "frames": [
        { "file_path": "./r_0", "rotation": 0.0125, "transform_matrix": [
            [1.0, 0.0, 0.0, 0.5], [0.0, 0.6, -0.8, -2.0], [0.0, 0.8, 0.6, 3.5], [0.0, 0.0, 0.0, 1.0]] },
        { "file_path": "./r_1", "rotation": 0.0125, "transform_matrix": [
            [0.0, -1.0, 0.0, 0.5], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, 1.0, 3.5], [0.0, 0.0, 0.0, 1.0]] } ] }"#;
    std::fs::write(folder.join("transforms_train.json"), text).unwrap();
    assert_eq!(load(folder, Split::Train, 1).unwrap().frames.len(), 2);
    text.as_bytes().to_vec()
}

fn config() -> Config {
    let mut config = Config::preset(Preset::Instant);
    if let Some(field) = config.field.get_mut::<InstantConfig>() {
        field.grid = HashGridConfig { levels: 2, features: 2, log2_table: 6, coarsest: 3, finest: 8 };
        (field.density_width, field.features, field.color_width, field.direction_degree) = (6, 4, 5, 2);
    }
    if let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() {
        sampler.occupancy = OccupancyConfig { resolution: 4, ..sampler.occupancy };
    }
    config
}

fn extent() -> Extent {
    Extent { unit: 1.0, ..Extent::new([DVec3::NEG_ONE, DVec3::ONE], [2.0, 6.0]) }
}

fn params<T: Scalar>() -> Params<T> {
    let mut params = Params::new();
    params.add("layer.weight", Tensor::from_fn(&[3, 4], |i| T::from_f64(i as f64 * 0.1)));
    params.add("layer.bias", Tensor::zeros(&[4]));
    params.add("scale", Tensor::scalar(T::ONE));
    params
}

/// Whether no number of the field or the grid makes a model too large to be built in a test.
fn is_small(config: &Config) -> bool {
    let all = serde_json::to_value(config).unwrap();
    fn most(value: &serde_json::Value) -> f64 {
        match value {
            serde_json::Value::Number(number) => number.as_f64().unwrap_or(f64::INFINITY),
            serde_json::Value::Array(values) => values.iter().map(most).fold(0.0, raygrad::Real::maximum),
            serde_json::Value::Object(values) => values.values().map(most).fold(0.0, raygrad::Real::maximum),
            _ => 0.0,
        }
    }
    most(&all["field"]) <= 40.0
        && most(&all["sampler"]["occupancy"]) <= 64.0
        && most(&all["sampler"]["proposal"]) <= 40.0
}

/// The bytes that `write` writes to a file of that name.
fn written(name: &str, write: impl FnOnce(&Path)) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    write(&folder.path().join(name));
    std::fs::read(folder.path().join(name)).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn transforms_of_blender(damage in damage(), downscale in 0..6_usize, views in 0..4_usize) {
        let folder = tempfile::tempdir().unwrap();
        let text = scene(folder.path());
        std::fs::write(folder.path().join("transforms_train.json"), damaged(&text, &damage)).unwrap();
        let read = Capture::read(folder.path()).and_then(|capture| {
            capture.load(Split::Train, &capture.survey(None)?, &Reading { downscale, views, ..Reading::default() })
        });
        match read {
            Ok(data) => {
                prop_assert!(!data.frames.is_empty());
                let frames = data.frames.iter();
                prop_assert!(frames.clone().all(|frame| frame.camera.pose.is_finite() && frame.camera.focal[0] > 0.0));
            }
            Err(error) if downscale == 0 || views == 0 => clear(error, ""),
            Err(error) => clear(error, "transforms_train.json"),
        }
    }

    #[test]
    fn transforms_of_instant_ngp(damage in damage()) {
        let folder = tempfile::tempdir().unwrap();
        let text = scene(folder.path());
        std::fs::rename(folder.path().join("transforms_train.json"), folder.path().join("transforms.json")).unwrap();
        std::fs::write(folder.path().join("transforms.json"), damaged(&text, &damage)).unwrap();
        if let Err(error) = load(folder.path(), Split::Train, 1) {
            clear(error, folder.path().to_str().unwrap());
        }
    }

    #[test]
    fn pictures(damage in damage(), jpeg in prop::bool::ANY) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("picture.png");
        let bytes = if jpeg { include_bytes!("reference/grey.jpg").to_vec() } else {
            Image { width: 9, height: 5, channels: 3, data: (0..135).map(|i| i as f32 / 135.0).collect() }.to_png()
        };
        std::fs::write(&path, &bytes).unwrap();
        prop_assert!(Image::open(&path).is_ok());
        std::fs::write(&path, damaged(&bytes, &damage)).unwrap();
        match Image::open(&path) {
            Ok(image) => prop_assert_eq!(image.data.len(), image.width * image.height * image.channels),
            Err(error) => clear(error, "picture.png"),
        }
    }

    #[test]
    fn parameters_as_safetensors(damage in damage(), noise in prop::collection::vec(any::<u8>(), 0..64)) {
        let metadata = || HashMap::from([("format".to_string(), "raygrad".to_string())]);
        let bytes = params::<f32>().to_safetensors(Storage::Full, metadata(), &[("blob", vec![1, 2, 3])]).unwrap();
        for bytes in [damaged(&bytes, &damage), noise, bytes[..bytes.len() / 2].to_vec()] {
            let mut single = params::<f32>();
            let before = single.values().to_vec();
            if single.load_safetensors(&bytes).is_err() {
                prop_assert_eq!(single.values(), before, "nothing changes");
            }
            prop_assert!(params::<f64>().load_safetensors(&bytes).is_err(), "another number type");
        }
    }

    #[test]
    fn parameters_as_npz(damage in damage(), noise in prop::collection::vec(any::<u8>(), 0..64)) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.npz");
        static WHOLE: LazyLock<Vec<u8>> = LazyLock::new(|| written("model.npz", |path| params::<f32>().save_npz(path).unwrap()));
        for bytes in [damaged(&WHOLE, &damage), noise] {
            std::fs::write(&path, bytes).unwrap();
            if let Err(error) = Params::<f32>::read_npz(&path) {
                clear(error, "model.npz");
            }
            let mut single = params::<f32>();
            let before = single.values().to_vec();
            if single.load_npz(&path).is_err() {
                prop_assert_eq!(single.values(), before, "nothing changes");
            }
        }
    }

    #[test]
    fn models(damage in damage()) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        static WHOLE: LazyLock<Vec<u8>> = LazyLock::new(|| {
            written("model", |path| Model::<f32>::new(config(), extent(), 1).unwrap().save(path).unwrap())
        });
        std::fs::write(&path, damaged(&WHOLE, &damage)).unwrap();
        if let Err(error) = Model::load(&path, config(), extent()) {
            clear(error, "model.safetensors");
        }
    }

    #[test]
    fn occupancy_grids(damage in damage(), noise in prop::collection::vec(any::<u8>(), 0..200)) {
        let grid = OccupancyGrid::new(extent().bounds, &OccupancyConfig { resolution: 8, ..OccupancyConfig::default() });
        let grid = grid.unwrap();
        for bytes in [grid.to_bytes(), grid.occupied_to_bytes()] {
        let mut headed = bytes[..8].to_vec();
        headed.extend(&noise);
        // Its header alone, where damage to so many bytes rarely falls.
        let mut header = damaged(&bytes[..64], &damage);
        header.extend(&bytes[64..]);
        for bytes in [damaged(&bytes, &damage), noise.clone(), headed, header] {
            if let Err(error) = OccupancyGrid::from_bytes(&bytes) {
                clear(error, "`");
            }
        }
        }
    }

    #[test]
    fn configurations(damage in damage(), preset in 0..4_usize) {
        let preset = [Preset::Classic, Preset::Small, Preset::Instant, Preset::Voxel][preset];
        for config in [Config::preset(preset), config()] {
            let bytes = damaged(&serde_json::to_vec(&config).unwrap(), &damage);
            let Ok(config) = serde_json::from_slice::<Config>(&bytes) else { continue };
            if let Err(error) = config.check() {
                clear(error, "`");
            } else if is_small(&config)
                && let Err(error) = Model::<f32>::new(config, extent(), 0)
            {
                clear(error, "`");
            }
        }
    }

    #[test]
    fn words(word in "\\PC{0,12}") {
        for error in [
            word.parse::<Preset>().err().map(|e| e.to_string()),
            word.parse::<Skip>().err().map(|e| e.to_string()),
            word.parse::<Split>().err().map(|e| e.to_string()),
            word.parse::<Background>().err().map(|e| e.to_string()),
        ].into_iter().flatten() {
            prop_assert!(error.contains('`'), "{}", error);
        }
    }
}

/// Settings whose product no memory holds are refused before anything is allocated.
#[test]
fn models_that_no_memory_holds_are_refused() {
    let mut classic = Config::preset(Preset::Classic);
    if let Some(field) = classic.field.get_mut::<ClassicConfig>() {
        (field.depth, field.width) = (1 << 14, 1 << 14);
    }
    let mut instant = Config::preset(Preset::Instant);
    if let Some(field) = instant.field.get_mut::<InstantConfig>() {
        field.grid = HashGridConfig { levels: 32, features: 32, log2_table: 28, coarsest: 512, finest: 65_536 };
    }
    for config in [classic, instant] {
        let error = Model::<f32>::new(config, extent(), 0).err().expect("an error").to_string();
        assert!(error.contains("parameters"), "{error}");
    }
}

/// A box that is none, or that no number describes.
#[test]
fn extents_are_checked() {
    for bad in [f64::NAN, f64::INFINITY, 2.0] {
        let extent = Extent::new([DVec3::splat(bad), DVec3::ONE], [2.0, 6.0]);
        clear(Model::<f32>::new(config(), extent, 0).err().expect("an error"), "bounds");
    }
}
