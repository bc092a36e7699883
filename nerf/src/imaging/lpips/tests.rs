use super::*;
use raygrad_autograd::check::{Check, check_function};
use raygrad_nn::{Params, Storage};
use std::collections::{BTreeMap, HashMap};
use std::path::PathBuf;
use std::sync::LazyLock;

/// Pseudo-random numbers from -1 to 1, as in `tests/reference/lpips.py`.
fn noise(i: usize, salt: u32) -> f64 {
    let mut i = (i as u32).wrapping_mul(2_654_435_761).wrapping_add(salt.wrapping_mul(40503));
    for _ in 0..2 {
        i = (i ^ (i >> 16)).wrapping_mul(0x45d_9f3b);
    }
    f64::from(i ^ (i >> 16)) / 2.0_f64.powi(31) - 1.0
}

/// Names and shapes in the order of the authors' package.
fn names(backbone: Backbone) -> Vec<(String, Vec<usize>)> {
    let [stem, layers]: [&[usize]; 2] = match backbone {
        Backbone::Alex => [&[11, 5, 3, 3, 3], &[10, 23, 36, 48, 510]],
        Backbone::Vgg => [&[3; 13], &[10, 12, 25, 27, 310, 312, 314, 417, 419, 421, 524, 526, 528]],
    };
    let channels: &[usize] = match backbone {
        Backbone::Alex => &[3, 64, 192, 384, 256, 256],
        Backbone::Vgg => &[3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512],
    };
    let ends = match backbone {
        Backbone::Alex => [64, 192, 384, 256, 256],
        Backbone::Vgg => [64, 128, 256, 512, 512],
    };
    // The first digit is the slice; the others are its layer.
    let split = |layer: &usize| {
        let text = layer.to_string();
        format!("net.slice{}.{}", &text[..1], &text[1..])
    };
    let convolutions = layers.iter().zip(stem).zip(channels.windows(2)).flat_map(|((layer, kernel), channels)| {
        let weight = vec![channels[1], channels[0], *kernel, *kernel];
        [(format!("{}.weight", split(layer)), weight), (format!("{}.bias", split(layer)), vec![channels[1]])]
    });
    let shares = ends.iter().enumerate().map(|(i, c)| (format!("lin{i}.model.1.weight"), vec![1, *c, 1, 1]));
    convolutions.chain(shares).collect()
}

/// The weights of `tests/reference/lpips.py`.
fn weights(backbone: Backbone) -> Params<f32> {
    let mut params = Params::new();
    for (salt, (name, shape)) in names(backbone).into_iter().enumerate() {
        let spread = (6.0 / shape[1..].iter().product::<usize>() as f64).sqrt();
        let value = |i: usize| match noise(i, salt as u32) {
            x if name.starts_with("lin") => 0.5 * (x + 1.0),
            x if name.ends_with("bias") => 0.1 * x,
            x => x * spread,
        };
        params.add(&name, Tensor::from_fn(&shape, |i| value(i) as f32));
    }
    params
}

fn bytes(params: &Params<f32>) -> Vec<u8> {
    params.to_safetensors(Storage::Full, &BTreeMap::new(), &[]).unwrap()
}

fn opened(bytes: &[u8]) -> Result<Lpips> {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), bytes).unwrap();
    Lpips::open(file.path())
}

static ALEX_WEIGHTS: LazyLock<Params<f32>> = LazyLock::new(|| weights(Backbone::Alex));
static VGG_WEIGHTS: LazyLock<Params<f32>> = LazyLock::new(|| weights(Backbone::Vgg));
static WITH_ALEX: LazyLock<Lpips> = LazyLock::new(|| opened(&bytes(&ALEX_WEIGHTS)).unwrap());
static WITH_VGG: LazyLock<Lpips> = LazyLock::new(|| opened(&bytes(&VGG_WEIGHTS)).unwrap());

/// The images of `tests/reference/lpips.py`.
fn pictures(width: usize, height: usize) -> [Tensor<f32>; 2] {
    let shape = [2, 3, height, width];
    let stripes = |i: usize| ((i % (7 * width) + 3 * (i % width)) % 64) as f64 / 63.0;
    let a = Tensor::from_fn(&shape, |i| (0.75 * stripes(i) + 0.125 * (noise(i, 100) + 1.0)) as f32);
    let b = |i: usize| 0.875 * f64::from(a.as_slice()[i]) + 0.0625 * (noise(i, 101) + 1.0);
    let b = Tensor::from_fn(&shape, |i| b(i) as f32);
    [a, b]
}

/// An image of a batch.
fn image(batch: &Tensor<f32>, i: usize) -> Image {
    let &[_, channels, height, width] = batch.shape() else { panic!("no images") };
    let at = |p: usize| ((i * channels + p % channels) * height * width) + p / channels;
    let data = (0..channels * height * width).map(|p| batch.as_slice()[at(p)]).collect();
    Image { width, height, channels, data }
}

fn of<T: Scalar>(lpips: &Lpips<T>, pair: &[Tensor<f32>; 2]) -> Vec<Vec<f64>> {
    let tape = Tape::<T>::new();
    let [a, b] = pair.each_ref().map(|x| tape.constant(x.cast()));
    let layers = lpips.layers(&a, &b);
    assert!(tape.is_empty() && layers.len() == 5);
    let layer = |layer: &Var<'_, T>| layer.value().as_slice().iter().map(|x| x.to_f64()).collect::<Vec<_>>();
    let layers: Vec<Vec<f64>> = layers.iter().map(layer).collect();
    (0..2).map(|i| layers.iter().map(|layer| layer[i]).collect()).collect()
}

/// `tests/reference/lpips.py` computed the expected values with the authors' package.
#[test]
fn lpips_equals_the_authors_package_by_layer() {
    let file = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/reference/lpips.json");
    let values: HashMap<String, Vec<Vec<f64>>> = serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap();
    assert_eq!(values.len(), 4);
    for (name, expected) in values {
        let (backbone, size) = name.split_once(' ').unwrap();
        let [width, height] = size.split('x').map(|n| n.parse().unwrap()).collect::<Vec<_>>()[..] else { panic!() };
        let lpips = if backbone == "alex" { &*WITH_ALEX } else { &*WITH_VGG };
        assert_eq!(lpips.backbone().to_string(), backbone);
        let pair = pictures(width, height);
        let close = |got: &[Vec<f64>], tolerance: f64| {
            let both = got.iter().flatten().zip(expected.iter().flatten());
            assert!(both.clone().count() == 10, "{name}");
            both.for_each(|(got, e)| assert!((got - e).abs() <= tolerance * e, "{name}: {got} for {e}"));
        };
        close(&of(&lpips.cast::<f64>(), &pair), 1e-11);
        close(&of(lpips, &pair), 1e-4);
        for (i, layers) in expected.iter().enumerate() {
            let [a, b] = pair.each_ref().map(|batch| image(batch, i));
            let (got, expected) = (lpips.distance(&a, &b), layers.iter().sum::<f64>());
            assert!((got - expected).abs() <= 2e-5 * expected, "{name}: {got} for {expected}");
        }
    }
}

#[test]
fn lpips_is_zero_for_equal_images_and_symmetric() {
    let [a, b] = pictures(35, 32).each_ref().map(|batch| image(batch, 1));
    for lpips in [&*WITH_ALEX, &*WITH_VGG] {
        assert_eq!([lpips.distance(&a, &a), lpips.distance(&b, &b)], [0.0; 2]);
        assert!(lpips.distance(&a, &b) > 1e-3 && lpips.distance(&a, &b) == lpips.distance(&b, &a));
        for at in [0, 35 * 32 * 3 / 2, 35 * 32 * 3 - 1] {
            let mut bad = b.clone();
            bad.data[at] = f32::NAN;
            assert!(lpips.distance(&a, &bad).is_nan() && lpips.distance(&bad, &bad).is_nan(), "{at}");
        }
    }
}

#[test]
fn lpips_gradients_equal_differences() {
    let lpips = WITH_ALEX.cast::<f64>();
    let [a, b] =
        pictures(33, 31).map(|x| Tensor::from_vec(&[1, 3, 31, 33], x.as_slice()[..3 * 31 * 33].to_vec()).cast());
    let check = Check { second_order: false, step: 1e-6, tolerance: 1e-5, ..Check::default() };
    let report = check_function(&check, &[a, b], |x| lpips.loss(&x[0], &x[1])).unwrap();
    assert!(report.comparisons > 10);
}

#[test]
fn ray_without_density_has_no_depth_or_gradient() {
    let mut params = VGG_WEIGHTS.clone();
    for name in ["net.slice1.2.bias", "net.slice3.14.bias"] {
        let id = params.find(name).unwrap();
        params.get_mut(id).as_mut_slice().fill(-1e3);
    }
    let lpips = opened(&bytes(&params)).unwrap();
    let pair = pictures(17, 16);
    let tape = Tape::<f32>::new();
    let [a, b] = pair.each_ref().map(|x| tape.leaf(x.clone()));
    let layers = lpips.layers(&a, &b);
    assert_eq!([&layers[0], &layers[2]].map(|layer| layer.value().as_slice()), [[0.0; 2]; 2]);
    let distance = lpips.loss(&a, &b).sum();
    assert_eq!(distance.grad(&[&a])[0].as_slice(), [0.0; 2 * 3 * 17 * 16]);
}

#[test]
fn lpips_of_too_small_images_panics() {
    for (lpips, side) in [(&*WITH_ALEX, 31), (&*WITH_VGG, 16)] {
        assert_eq!(lpips.backbone().smallest(), side);
        let of = |width: usize, height: usize| {
            let [a, b] = pictures(width, height).each_ref().map(|batch| image(batch, 0));
            let distance = std::panic::catch_unwind(|| lpips.distance(&a, &b));
            distance.map_err(|panic| panic.downcast_ref::<String>().unwrap().clone())
        };
        assert!(of(side, side).unwrap() > 0.0);
        let expected = |size: String| {
            format!("LPIPS with {} needs at least {side}x{side} pixels, the images have {size}", lpips.backbone())
        };
        assert_eq!(of(side - 1, side).unwrap_err(), expected(format!("{}x{side}", side - 1)));
        assert_eq!(of(side, side - 1).unwrap_err(), expected(format!("{side}x{}", side - 1)));
    }
}

#[test]
#[should_panic(expected = "images must have the same height, width and channels")]
fn lpips_of_different_shapes_panics() {
    WITH_ALEX.distance(&Image::new(40, 41, 3), &Image::new(41, 40, 3));
}

#[test]
#[should_panic(expected = "LPIPS needs three channels: red, green and blue")]
fn lpips_of_transparent_images_panics() {
    WITH_ALEX.distance(&Image::new(40, 41, 4), &Image::new(40, 41, 4));
}

#[test]
fn unusable_lpips_files_are_errors_with_a_reason() {
    let good = &*ALEX_WEIGHTS;
    let whole = bytes(good);
    let refused = |bytes: &[u8], expected: &[&str]| {
        let error = opened(bytes).unwrap_err().to_string();
        assert!(expected.iter().all(|part| error.contains(part)), "{error}");
        assert!(error.contains("lpips_weights.py") && error.lines().count() == 1, "{error}");
    };
    refused(b"", &["not a safetensors file"]);
    for length in [4, 100, whole.len() / 2, whole.len() - 1] {
        refused(&whole[..length], &["not a safetensors file"]);
    }
    // Headers that announce more than the file, and more than any memory, can hold.
    let header = |text: &str| [&(text.len() as u64).to_le_bytes(), text.as_bytes()].concat();
    refused(&(u64::MAX / 2).to_le_bytes(), &["not a safetensors file"]);
    for shape in ["[4000000000,4000000000,3,3]", "[1099511627776]"] {
        let text = format!(r#"{{"net.slice2.3.weight":{{"dtype":"F32","shape":{shape},"data_offsets":[0,4]}}}}"#);
        refused(&header(&text), &["not a safetensors file"]);
    }
    let mut others = Params::new();
    others.add("net.slice1.0.weight", Tensor::zeros(&[1]));
    refused(&bytes(&others), &["neither `net.slice2.3.weight` (alex) nor `net.slice1.2.weight` (vgg)"]);
    // Each tensor is checked by its own name and shape.
    let needed = names(Backbone::Alex).into_iter().filter(|(name, _)| name != ALEX.sign);
    for (absent, shape) in needed {
        // The same tensor under another name.
        let mut others = whole.clone();
        let quoted = format!("\"{absent}\"");
        let at = whole.windows(quoted.len()).position(|part| part == quoted.as_bytes()).unwrap();
        others[at + 1] = b'x';
        refused(&others, &[&format!("`{absent}`: is missing, should be F32{shape:?}"), "for alex"]);
    }
    let changed = |name: &str, value: Tensor<f32>| {
        let mut params = Params::new();
        for (own, old) in good.iter() {
            params.add(own, if own == name { value.clone() } else { old.clone() });
        }
        bytes(&params)
    };
    let swapped = changed("net.slice3.6.weight", Tensor::zeros(&[192, 384, 3, 3]));
    refused(&swapped, &["`net.slice3.6.weight`: is F32[192, 384, 3, 3], should be F32[384, 192, 3, 3]", "for alex"]);
    let half = good.to_safetensors(Storage::F16, &BTreeMap::new(), &[]).unwrap();
    refused(&half, &["`net.slice1.0.weight`: is F16[64, 3, 11, 11], should be F32[64, 3, 11, 11]"]);
    for (name, value, expected) in [
        ("net.slice5.10.bias", f32::NAN, "has the value NaN, should be finite"),
        ("net.slice1.0.weight", f32::INFINITY, "has the value inf, should be finite"),
        ("lin4.model.1.weight", f32::INFINITY, "has the value inf, should be finite"),
        ("lin2.model.1.weight", -1e-3, "has the value -0.001, should be at least 0"),
    ] {
        let mut tensor = good.get(good.find(name).unwrap()).clone();
        let last = tensor.len() - 1;
        tensor.as_mut_slice()[last] = value;
        refused(&changed(name, tensor), &[&format!("`{name}`: {expected}")]);
    }
    // Other entries of a `state_dict` are ignored.
    let mut more = good.clone();
    more.add("scaling_layer.shift", Tensor::zeros(&[1, 3, 1, 1]));
    assert_eq!(opened(&bytes(&more)).unwrap().backbone(), Backbone::Alex);
    let absent = Lpips::open("absent.safetensors").unwrap_err().to_string();
    assert!(absent.starts_with("absent.safetensors: cannot be read"), "{absent}");
}

#[cfg(unix)]
#[test]
fn endless_lpips_file_is_not_read_to_its_end() {
    let error = Lpips::open("/dev/zero").unwrap_err().to_string();
    assert!(error.starts_with("/dev/zero: has more than 134217728 bytes"), "{error}");
}

#[test]
fn lpips_of_nan_at_the_border_is_nan() {
    // AlexNet's last window ends at the 33rd of 34 columns.
    let mut image = Image::new(34, 31, 3);
    image.pixel_mut(33, 30)[2] = f32::NAN;
    let black = Image::new(34, 31, 3);
    assert!(WITH_ALEX.distance(&image, &black).is_nan() && WITH_ALEX.distance(&black, &image).is_nan());
}
