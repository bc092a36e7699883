//! Every parser on damaged input gives an error that names the file, never a panic.

use proptest::prelude::*;
use rawzip::{CompressionMethod, ZipArchiveWriter};
use raygrad::nerf::dataset::{Capture, LoadOptions, Photo, Split, load};
use raygrad::nerf::encoding::hash_grid::HashGridConfig;
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::imaging::lpips::Lpips;
use raygrad::nerf::sampling::marching::MarchingConfig;
use raygrad::nerf::space::occupancy::{OccupancyConfig, OccupancyGrid, Skip};
use raygrad::nerf::{Background, ClassicConfig, Config, Error, Image, InstantConfig, Model, Preset, SceneBox, Trainer};
use raygrad::{OptimizerState, Params, Scalar, Storage, Tensor};
use raygrad_scenes::embedded;
use raygrad_test_support::campaign::campaign;
use raygrad_test_support::damage::{clear, damage, damaged};
use raygrad_test_support::memory::peak;
use raygrad_test_support::tally::{Bound, cases};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;
use std::sync::Arc;

/// A dataset of two images of 4 x 4 pixels.
fn scene(folder: &Path) -> Vec<u8> {
    for i in 0..2 {
        let data = (0..64).map(|k| (k / 4 + 16 * i) as f32 / 32.0).collect();
        let image = Image { width: 4, height: 4, channels: 4, data };
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

/// A model whose steps take milliseconds.
pub fn config() -> Config {
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

fn extent() -> SceneBox {
    SceneBox { unit: 1.0, ..SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [2.0, 6.0]) }
}

fn params<T: Scalar>() -> Params<T> {
    let mut params = Params::new();
    params.add("layer.weight", Tensor::from_fn(&[3, 4], |i| T::from_f64(i as f64 * 0.1)));
    params.add("layer.bias", Tensor::zeros(&[4]));
    params.add("scale", Tensor::scalar(T::ONE));
    params
}

/// Returns true if no number of the field or the grid makes the model too large for a test.
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
    #![proptest_config(cases())]

    #[test]
    fn transforms_of_blender(damage in damage(), downscale in 0..6_usize, views in 0..4_usize) {
        let folder = tempfile::tempdir().unwrap();
        let text = scene(folder.path());
        std::fs::write(folder.path().join("transforms_train.json"), damaged(&text, &text, &damage)).unwrap();
        let read = Capture::read(folder.path()).and_then(|capture| {
            capture.load(Split::Train, &capture.analyze_scene(None)?, &LoadOptions { downscale, views, ..LoadOptions::default() })
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
        std::fs::write(folder.path().join("transforms.json"), damaged(&text, &text, &damage)).unwrap();
        if let Err(error) = load(folder.path(), Split::Train, 1) {
            clear(error, folder.path().to_str().unwrap());
        }
    }

    #[test]
    fn configurations(damage in damage(), preset in 0..4_usize) {
        let preset = [Preset::Classic, Preset::Small, Preset::Instant, Preset::Voxel][preset];
        for config in [Config::preset(preset), config()] {
            let whole = serde_json::to_vec(&config).unwrap();
            let bytes = damaged(&whole, &whole, &damage);
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

/// Runs a parser of files on damaged ones of that name. Errors that concern more than the file must contain `named`.
fn campaign_on(
    name: &str,
    file: &Path,
    whole: &[Vec<u8>],
    bound: Bound,
    parse: impl Fn() -> Result<(), String> + Sync,
) {
    let parse = |bytes: &[u8]| {
        std::fs::write(file, bytes).unwrap();
        parse()
    };
    let named = file.file_name().unwrap().to_str().unwrap();
    alone(|| campaign(name, whole, bound, parse, |error| clear(error, named)));
}

/// Runs on one thread, whose memory is counted.
fn alone(work: impl FnOnce() + Send) {
    rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(work);
}

fn said<T>(result: Result<T, impl ToString>) -> Result<T, String> {
    result.map_err(|error| error.to_string())
}

/// An image of a few pixels in a format.
fn picture(ending: &str, channels: usize) -> Vec<u8> {
    let data = (0..45 * channels).map(|i| (i * i % 97) as f32 / 96.0).collect();
    let photo = Photo::from(Image { width: 9, height: 5, channels, data });
    written(&format!("picture.{ending}"), |path| photo.save(path).unwrap())
}

/// A 16-bit grey PNG whose header has this size, with these bytes uncompressed.
fn deep_png(width: u32, height: u32, data: &[u8]) -> Vec<u8> {
    let chunk = |name: &[u8; 4], data: &[u8]| {
        let named = [name, data].concat();
        let sum = crc32fast::hash(&named).to_be_bytes();
        [&(data.len() as u32).to_be_bytes()[..], &named, &sum].concat()
    };
    let length = data.len() as u16;
    let (a, b) = data.iter().fold((1_u32, 0_u32), |(a, b), byte| {
        let a = (a + u32::from(*byte)) % 65521;
        (a, (b + a) % 65521)
    });
    let stored =
        [&[0x78, 1, 1][..], &length.to_le_bytes(), &(!length).to_le_bytes(), data, &(b << 16 | a).to_be_bytes()];
    let header = [&width.to_be_bytes()[..], &height.to_be_bytes(), &[16, 0, 0, 0, 0]].concat();
    [b"\x89PNG\r\n\x1a\n".to_vec(), chunk(b"IHDR", &header), chunk(b"IDAT", &stored.concat()), chunk(b"IEND", &[])]
        .concat()
}

/// Decoded images may take as much as [`Photo::open`] allows: four times after a conversion of the pixel format, six in
/// the WebP decoder.
const DECODED: Bound = Bound { times: 8 << 14, plus: 8 << 26 };

/// An image with transparency, camera metadata and lossy compression: see `reference/lossy.py`.
const LOSSY: &[u8] = include_bytes!("reference/lossy.webp");

/// Three by two pixels of 24 bits.
const BMP: &[u8] = b"BM\x4e\0\0\0\0\0\0\0\x36\0\0\0\x28\0\0\0\x03\0\0\0\x02\0\0\0\x01\0\x18\0\0\0\0\0\x18\0\0\0\
    \0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\x01\x02\x03\x04\x05\x06\x07\x08\x09\0\0\0\x11\x12\x13\x14\x15\x16\x17\x18\x19\0\0\0";

#[test]
fn campaign_pictures() {
    let grey = include_bytes!("reference/grey.jpg").to_vec();
    for (name, whole) in [
        (
            "PNG",
            vec![
                picture("png", 3),
                picture("png", 4),
                deep_png(6, 4, &[&[0, 7], [90; 11].as_slice()].concat().repeat(4)),
            ],
        ),
        ("JPEG", vec![grey, picture("jpg", 3)]),
        ("WebP", vec![picture("webp", 3), picture("webp", 4), LOSSY.to_vec()]),
        ("TIFF", vec![picture("tif", 3), picture("tif", 4)]),
        ("BMP", vec![BMP.to_vec()]),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("picture.png");
        campaign_on(name, &path, &whole, DECODED, || {
            let sizes = said(Photo::size_of_file(&path));
            let photo = said(Photo::open(&path, None))?;
            assert_eq!(sizes?[1], [photo.width, photo.height]);
            assert_eq!(photo.to_image().data.len(), photo.width * photo.height * photo.channels);
            Ok(())
        });
    }
}
/// Settings whose product no memory could hold are refused before any allocation.
#[test]
fn oversized_models_are_errors() {
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

/// Invalid and non-finite boxes, and too many images.
#[test]
fn extents_are_checked() {
    for bad in [f64::NAN, f64::INFINITY, 2.0] {
        let extent = SceneBox::new([DVec3::splat(bad), DVec3::ONE], [2.0, 6.0]);
        clear(Model::<f32>::new(config(), extent, 0).err().expect("an error"), "bounds");
    }
    let mut codes = config();
    codes.field.get_mut::<InstantConfig>().unwrap().appearance_embedding_dim = 8;
    for frames in [(1 << 20) + 1, 1 << 61, usize::MAX] {
        let error = Model::<f32>::new(codes.clone(), SceneBox { frames, ..extent() }, 0).err().expect("an error");
        clear(error, "scene_box.frames");
    }
}

/// The other files of a capture: masks and depth.
#[test]
fn campaign_masks_and_depths() {
    let npy = |values: &[f32]| {
        let header = format!("{:118}", "{'descr': '<f4', 'fortran_order': False, 'shape': (4, 4), }");
        let values: Vec<u8> = values.iter().flat_map(|x| x.to_le_bytes()).collect();
        [b"\x93NUMPY\x01\x00\x76\x00", header.as_bytes(), &values].concat()
    };
    let folder = tempfile::tempdir().unwrap();
    let text = String::from_utf8(scene(folder.path())).unwrap();
    std::fs::remove_file(folder.path().join("transforms_train.json")).unwrap();
    let text =
        text.replace("\"./r_0\",", "\"./r_0\", \"mask_path\": \"mask.png\", \"depth_file_path\": \"depth.png\",");
    // The cameras must differ in position.
    let text = text.replacen("0.0, 0.5]", "0.0, 1.5]", 1);
    std::fs::write(folder.path().join("transforms.json"), text).unwrap();
    let grey = Image { width: 4, height: 4, channels: 1, data: (0..16).map(|i| (i % 3) as f32 / 2.0).collect() };
    let [mask, depth] = ["mask.png", "depth.png"].map(|name| folder.path().join(name));
    let load = || {
        let capture = said(Capture::read(folder.path()))?;
        let reading = LoadOptions { distances: true, ..LoadOptions::default() };
        let data = said(capture.load(Split::Train, &said(capture.analyze_scene(None))?, &reading))?;
        let distances = data.frames.iter().filter_map(|frame| frame.distances.as_ref());
        assert!(distances.flat_map(|image| &image.data).all(|x| *x >= 0.0 && x.is_finite()));
        Ok(())
    };
    let deep = deep_png(4, 4, &[0, 1, 2, 3, 4, 5, 6, 7, 8].repeat(4));
    std::fs::write(&mask, grey.to_png()).unwrap();
    std::fs::write(&depth, &deep).unwrap();
    campaign_on("mask", &mask, &[grey.to_png(), picture_of(4, 4)], DECODED, load);
    std::fs::write(&mask, grey.to_png()).unwrap();
    campaign_on("depths", &depth, &[deep, grey.to_png(), npy(&[1.5; 16])], DECODED, load);
}

fn picture_of(width: usize, height: usize) -> Vec<u8> {
    Image { width, height, channels: 4, data: (0..4 * width * height).map(|i| (i / 4 % 2) as f32).collect() }.to_png()
}

#[test]
fn campaign_parameters_as_safetensors() {
    let metadata = BTreeMap::from([("format".to_string(), "raygrad".to_string())]);
    let written = |storage| params::<f32>().to_safetensors(storage, &metadata, &[("blob", vec![1, 2, 3])]).unwrap();
    let whole = [written(Storage::Full), written(Storage::F16)];
    let bound = Bound { times: 64, plus: 1 << 16 };
    alone(|| {
        campaign(
            "safetensors",
            &whole,
            bound,
            |bytes| {
                let mut single = params::<f32>();
                let before = single.values().to_vec();
                let loaded = single.load_safetensors(bytes);
                assert!(loaded.is_ok() || single.values() == before, "nothing changes");
                loaded.map(drop)
            },
            |error| clear(error, ""),
        )
    });
    // In 16 bits it fits any number type.
    assert!(params::<f64>().load_safetensors(&whole[0]).is_err(), "another number type");
}

#[test]
fn campaign_states_of_optimisers() {
    let state = OptimizerState::<f32> {
        tensors: [("a.first".to_owned(), Tensor::zeros(&[3, 2])), ("b".to_owned(), Tensor::scalar(1.0))].into(),
        counts: [("a.rows".to_owned(), vec![1, 2, u64::MAX])].into(),
    };
    let whole = [state.to_safetensors().unwrap(), OptimizerState::<f32>::default().to_safetensors().unwrap()];
    let parse = |bytes: &[u8]| OptimizerState::<f32>::from_safetensors(bytes).map(drop);
    alone(|| campaign("optimizer", &whole, Bound { times: 64, plus: 1 << 16 }, parse, |error| clear(error, "")));
}

/// Compressed arrays in an archive, written by NumPy: see `autograd/nn/tests/data/README.md`.
const COMPRESSED: &[u8] = include_bytes!("../../../autograd/nn/tests/data/compressed.npz");

#[test]
fn campaign_parameters_as_npz() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.npz");
    let whole = [written("model.npz", |path| params::<f32>().save_npz(path).unwrap()), COMPRESSED.to_vec()];
    // The unpacked bytes, and as much again for the numbers.
    campaign_on("npz", &path, &whole, Bound { times: 4 << 6, plus: 4 << 26 }, || {
        let read = said(Params::<f32>::read_npz(&path));
        let mut single = params::<f32>();
        let before = single.values().to_vec();
        assert!(single.load_npz(&path).is_ok() || single.values() == before, "nothing changes");
        read.map(drop)
    });
}

#[test]
fn campaign_models() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let whole = [1, 2]
        .map(|seed| written("model", |path| Model::<f32>::new(config(), extent(), seed).unwrap().save(path).unwrap()));
    let parse = || said(Model::load(&path, config(), extent())).map(drop);
    campaign_on("model", &path, &whole, Bound { times: 64, plus: 1 << 20 }, parse);
}

/// The content of a checkpoint, without its checksum.
#[test]
fn campaign_states_of_training() {
    let data = Arc::new(embedded(Split::Train, 4));
    let trained = |steps: usize| {
        let mut trainer = Trainer::new(config(), data.clone()).unwrap();
        for _ in 0..steps {
            trainer.step(0.5);
        }
        trainer
    };
    let whole = [trained(0), trained(2)].map(|trainer| trainer.state().unwrap());
    let trainer = std::cell::RefCell::new(trained(0));
    let parse = |bytes: &[u8]| said(trainer.borrow_mut().load_state(bytes));
    campaign("training", &whole, Bound { times: 64, plus: 4 << 20 }, parse, |error| clear(error, "`"));
    // The last accepted state allows steps.
    assert!(trainer.into_inner().step(0.5).step > 0);
}

#[test]
fn campaign_occupancy_grids() {
    let grid = |resolution: usize| {
        let config = OccupancyConfig { resolution, ..OccupancyConfig::default() };
        OccupancyGrid::new(extent().bounds, &config).unwrap()
    };
    let whole = [grid(8).to_bytes(), grid(8).occupied_to_bytes(), grid(4).to_bytes()];
    // Half of the time only the header is damaged, since damage to so many bytes rarely hits it.
    let heads = whole.each_ref().map(|bytes| bytes[..64].to_vec());
    // Each bit also takes a density and the empty space around it.
    let bound = Bound { times: 128, plus: 1 << 16 };
    campaign("occupancy", &whole, bound, |bytes| OccupancyGrid::from_bytes(bytes).map(drop), |error| clear(error, "`"));
    let rest = &whole[0][64..];
    let parse = |head: &[u8]| OccupancyGrid::from_bytes(&[head, rest].concat()).map(drop);
    let heads = [heads[0].clone()];
    campaign("occupancy's header", &heads, Bound { plus: 1 << 18, ..bound }, parse, |error| clear(error, "`"));
}

#[test]
fn campaign_configurations() {
    let whole: Vec<Vec<u8>> = [Preset::Classic, Preset::Small, Preset::Instant, Preset::Voxel]
        .iter()
        .map(|preset| serde_json::to_vec(&Config::preset(*preset)).unwrap())
        .chain([serde_json::to_vec(&config()).unwrap()])
        .collect();
    let parse = |bytes: &[u8]| {
        let config: Config = said(serde_json::from_slice(bytes).map_err(|e| Error::setting("config", e)))?;
        said(config.check())
    };
    campaign("configuration", &whole, JSON, parse, |error| clear(error, ""));
}

/// An object of one member takes 7 bytes of a document and about 600 of memory.
const JSON: Bound = Bound { times: 256, plus: 1 << 16 };

/// Files that announce more than they contain.
#[test]
fn files_announcing_huge_sizes_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let refused =
        |what: &str, bytes: &[u8], name: &str, bound: Bound, parse: &(dyn Fn(&Path) -> Result<(), String> + Sync)| {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            alone(|| {
                let (result, taken) = peak(|| parse(&path));
                clear(result.expect_err(what), "");
                assert!(taken <= bound.of(bytes.len()), "{what}: {taken} bytes of memory for {}", bytes.len());
            });
        };
    let photo = |path: &Path| said(Photo::open(path, None)).map(drop);
    // An image with more pixels than its bytes can hold is not decoded.
    let little = Bound { times: 64, plus: 1 << 20 };
    for [width, height] in [[65535, 65535], [16384, 16384], [1 << 31, 1], [12000, 12000]] {
        refused("PNG", &deep_png(width, height, &[0; 64]), "a.png", little, &photo);
    }
    let mut jpeg = include_bytes!("reference/grey.jpg").to_vec();
    let frame = jpeg.windows(2).position(|marker| marker == [0xff, 0xc0]).unwrap();
    for side in [65535_u16, 12000] {
        jpeg[frame + 5..frame + 7].copy_from_slice(&side.to_be_bytes());
        jpeg[frame + 7..frame + 9].copy_from_slice(&side.to_be_bytes());
        refused("JPEG", &jpeg, "a.jpg", little, &photo);
    }
    let mut webp = picture("webp", 4);
    let start = webp.windows(4).position(|name| name == b"VP8L").unwrap() + 9;
    webp[start..start + 3].fill(0xff);
    webp[start + 3] |= 0x0f;
    refused("WebP", &webp, "a.webp", little, &photo);
    let mut lossy = LOSSY.to_vec();
    let start = lossy.windows(4).position(|name| name == b"EXIF").unwrap() + 4;
    lossy[start..start + 4].copy_from_slice(&0xffff_fff0_u32.to_le_bytes());
    refused("WebP with EXIF", &lossy, "b.webp", little, &photo);
    let mut safetensors = u64::MAX.to_le_bytes().to_vec();
    let parameters = |path: &Path| said(params::<f32>().load_safetensors(&std::fs::read(path).unwrap())).map(drop);
    for length in [u64::MAX, 1 << 62, 99_999_999, 90] {
        safetensors[..8].copy_from_slice(&length.to_le_bytes());
        safetensors.truncate(8);
        safetensors
            .extend(br#"{"a":{"dtype":"F32","shape":[4611686018427387904,4],"data_offsets":[0,99999999999]}}    "#);
        refused("safetensors", &safetensors, "a.safetensors", little, &parameters);
        refused("weights of LPIPS", &safetensors, "a.safetensors", little, &|path| said(Lpips::open(path)).map(drop));
    }
    let read = |path: &Path| said(Params::<f32>::read_npz(path)).map(drop);
    for size in [1 << 29, 400] {
        refused("npz", &bomb(size), "a.npz", Bound { times: 0, plus: 1 << 22 }, &read);
    }
    let nested = [&b"["[..], b"{\"a\":"].map(|open| open.repeat(200_000));
    for bytes in nested {
        let capture = |path: &Path| said(Capture::read(path.parent().unwrap())).map(drop);
        refused("JSON", &bytes, "transforms.json", JSON, &capture);
        refused("JSON", &bytes, "config.json", JSON, &|path| {
            said(serde_json::from_slice::<Config>(&std::fs::read(path).unwrap())).map(drop)
        });
    }
}

/// An archive of 16 megabytes of zeros that claims this size.
fn bomb(said: u32) -> Vec<u8> {
    let mut npy = format!("\u{93}NUMPY{:118}", "").chars().map(|c| c as u8).collect::<Vec<u8>>();
    npy.resize(1 << 24, 0);
    let mut bytes = vec![];
    let mut archive = ZipArchiveWriter::new(&mut bytes);
    let (mut entry, config) = archive.new_file("a.npy").compression_method(CompressionMethod::DEFLATE).start().unwrap();
    let mut writer = config.wrap(flate2::write::DeflateEncoder::new(&mut entry, flate2::Compression::best()));
    writer.write_all(&npy).unwrap();
    let (encoder, descriptor) = writer.finish().unwrap();
    encoder.finish().unwrap();
    entry.finish(descriptor).unwrap();
    archive.finish().unwrap();
    let entry = bytes.windows(4).position(|mark| mark == b"PK\x01\x02").unwrap();
    bytes[entry + 24..entry + 28].copy_from_slice(&said.to_le_bytes());
    bytes
}
