//! LPIPS: how far apart two images are for a network that has learned to see.
//!
//! Zhang, Isola, Efros, Shechtman and Wang, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric" (CVPR
//! 2018), version 0.1, as the authors' package `lpips` computes it. raygrad ships no weights: a file of them is made from
//! that package's by `benches/peers/lpips_weights.py`.

use crate::dataset::image::Image;
use crate::error::{Error, Result};
use raygrad_autograd::{Conv2dConfig, Pool2dConfig, Scalar, Tape, Tensor, Var};
use safetensors::tensor::{Dtype, SafeTensors};
use serde::Serialize;
use std::fmt;
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// The network whose features are compared. Distances of one are no measure of those of the other: a figure means something
/// beside others of the same alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Backbone {
    /// AlexNet: quick.
    Alex,
    /// VGG-16: some 20 times the work.
    Vgg,
}

impl fmt::Display for Backbone {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Backbone::Alex => "alex",
            Backbone::Vgg => "vgg",
        })
    }
}

/// A convolution with a bias and a ReLU.
#[derive(Clone, Copy)]
struct Convolution {
    /// Its number among torchvision's `features`.
    layer: usize,
    outputs: usize,
    kernel: usize,
    stride: usize,
    padding: usize,
}

/// One that keeps the extents.
const fn same(layer: usize, outputs: usize, kernel: usize) -> Convolution {
    Convolution { layer, outputs, kernel, stride: 1, padding: kernel / 2 }
}

/// What is compared is what each of five slices of the network gives.
const SLICES: usize = 5;

const ALEX: [&[Convolution]; SLICES] = [
    &[Convolution { layer: 0, outputs: 64, kernel: 11, stride: 4, padding: 2 }],
    &[same(3, 192, 5)],
    &[same(6, 384, 3)],
    &[same(8, 256, 3)],
    &[same(10, 256, 3)],
];
const VGG: [&[Convolution]; SLICES] = [
    &[same(0, 64, 3), same(2, 64, 3)],
    &[same(5, 128, 3), same(7, 128, 3)],
    &[same(10, 256, 3), same(12, 256, 3), same(14, 256, 3)],
    &[same(17, 512, 3), same(19, 512, 3), same(21, 512, 3)],
    &[same(24, 512, 3), same(26, 512, 3), same(28, 512, 3)],
];

impl Backbone {
    fn slices(self) -> [&'static [Convolution]; SLICES] {
        match self {
            Backbone::Alex => ALEX,
            Backbone::Vgg => VGG,
        }
    }

    /// The max pooling before a slice.
    fn pool(self, slice: usize) -> Option<Pool2dConfig> {
        match (self, slice) {
            (Backbone::Alex, 1 | 2) => Some(Pool2dConfig { stride: [2, 2], ..Pool2dConfig::new([3, 3]) }),
            (Backbone::Vgg, 1..) => Some(Pool2dConfig::new([2, 2])),
            _ => None,
        }
    }

    /// Width and height of the smallest image that the network can see, in pixels.
    pub fn smallest(self) -> usize {
        match self {
            Backbone::Alex => 31,
            Backbone::Vgg => 16,
        }
    }

    /// About how many bytes of memory [`Lpips::distance`] takes for each pixel of an image.
    pub fn bytes(self) -> f64 {
        match self {
            Backbone::Alex => 400.0,
            Backbone::Vgg => 2700.0,
        }
    }

    /// A tensor that only this network has.
    fn sign(self) -> &'static str {
        match self {
            Backbone::Alex => "net.slice2.3.weight",
            Backbone::Vgg => "net.slice1.2.weight",
        }
    }
}

/// Longest file that is read, in bytes: the weights of VGG-16 are 59 MB.
const LONGEST: u64 = 1 << 27;
/// What to do where a file does not serve.
const MAKE: &str = "benches/peers/lpips_weights.py makes the file from the package `lpips`";

/// The mean and the spread of photographs from -1 to 1, in each channel, as the package has them.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Added to the length of features before they are divided by it.
const EPSILON: f64 = 1e-10;

/// The weights of LPIPS, which say how far apart images are: 0 for identical ones, and more the less they are alike, up to
/// about 1.
///
/// Both images pass the first layers of a network that was trained to tell 1000 kinds of things apart. At the ends of five
/// slices `l` of it, the features `f` of each place are divided by their length, and
///
/// ```text
/// u = f / (|f| + 1e-10)        d = sum over l of mean over places of sum over channels c of w_lc (u_lc(a) - u_lc(b))^2
/// ```
///
/// with weights `w >= 0` that were fitted to people's judgement. The figure depends on the network and on the weights: it
/// means something beside figures of the same.
#[derive(Debug, Clone)]
pub struct Lpips<T: Scalar = f32> {
    backbone: Backbone,
    slices: Vec<Slice<T>>,
}

/// A part of the network, and what its features count.
#[derive(Debug, Clone)]
struct Slice<T: Scalar> {
    pool: Option<Pool2dConfig>,
    convolutions: Vec<(Conv2dConfig, Tensor<T>, Tensor<T>)>,
    /// One weight a channel.
    shares: Tensor<T>,
}

impl Lpips<f32> {
    /// Reads weights from a safetensors file with tensors in f32, named as in the `state_dict` of the package's
    /// `lpips.LPIPS(net="alex")` or `lpips.LPIPS(net="vgg")`; by them it is known which it is. Other tensors of the file are
    /// not looked at.
    ///
    /// # Errors
    /// If the file cannot be read, is no such file, or lacks a tensor; if a tensor has another shape or type, a number in it is
    /// not finite, or one by which a channel counts is negative.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let unread = |error: std::io::Error| Error::file(path, format!("cannot be read: {error}"));
        let mut bytes = vec![];
        File::open(path).map_err(unread)?.take(LONGEST + 1).read_to_end(&mut bytes).map_err(unread)?;
        if bytes.len() as u64 > LONGEST {
            return Err(Error::file(
                path,
                format!("has more than {LONGEST} bytes, too many for weights of LPIPS: {MAKE}"),
            ));
        }
        let file = SafeTensors::deserialize(&bytes)
            .map_err(|error| Error::file(path, format!("not a safetensors file: {error}; {MAKE}")))?;
        let backbone =
            [Backbone::Alex, Backbone::Vgg].into_iter().find(|backbone| file.tensor(backbone.sign()).is_ok());
        let Some(backbone) = backbone else {
            let [alex, vgg] = [Backbone::Alex, Backbone::Vgg].map(Backbone::sign);
            let what = format!("has no weights of LPIPS, neither `{alex}` (alex) nor `{vgg}` (vgg): {MAKE}");
            return Err(Error::file(path, what));
        };
        let read = |name: &str, shape: &[usize], least: f32| {
            tensor(&file, name, shape, least).map_err(|what| {
                Error::field(path, name, format!("{what}, in weights of LPIPS with {backbone}: {MAKE}"))
            })
        };
        let (mut slices, mut inputs) = (vec![], SHIFT.len());
        for (i, layers) in backbone.slices().into_iter().enumerate() {
            let mut convolutions = vec![];
            for &Convolution { layer, outputs, kernel, stride, padding } in layers {
                let name = format!("net.slice{}.{layer}", i + 1);
                let weight = read(&format!("{name}.weight"), &[outputs, inputs, kernel, kernel], f32::MIN)?;
                let bias = read(&format!("{name}.bias"), &[outputs], f32::MIN)?;
                let config = Conv2dConfig { stride: [stride; 2], padding: [padding; 2], dilation: [1, 1] };
                convolutions.push((config, weight, bias));
                inputs = outputs;
            }
            let shares = read(&format!("lin{i}.model.1.weight"), &[1, inputs, 1, 1], 0.0)?.reshape(&[inputs]);
            slices.push(Slice { pool: backbone.pool(i), convolutions, shares });
        }
        Ok(Lpips { backbone, slices })
    }
}

/// A tensor of a file whose numbers are finite and not less than `least`; or what is wrong with it.
fn tensor(file: &SafeTensors<'_>, name: &str, shape: &[usize], least: f32) -> std::result::Result<Tensor<f32>, String> {
    let Ok(found) = file.tensor(name) else { return Err(format!("is missing; F32{shape:?} is expected")) };
    if found.dtype() != Dtype::F32 || found.shape() != shape {
        return Err(format!("is {:?}{:?}, not F32{shape:?}", found.dtype(), found.shape()));
    }
    let values: Vec<f32> = found.data().chunks_exact(size_of::<f32>()).map(f32::read_le).collect();
    match values.iter().find(|x| !(x.is_finite() && **x >= least)) {
        Some(x) if x.is_finite() => Err(format!("holds {x}, and may hold nothing negative")),
        Some(x) => Err(format!("holds {x}, and must be finite")),
        None => Ok(Tensor::from_vec(shape, values)),
    }
}

impl<T: Scalar> Lpips<T> {
    /// The network whose features are compared.
    pub fn backbone(&self) -> Backbone {
        self.backbone
    }

    /// The same weights as numbers of another type.
    pub fn cast<U: Scalar>(&self) -> Lpips<U> {
        let slice = |slice: &Slice<T>| Slice {
            pool: slice.pool,
            convolutions: slice.convolutions.iter().map(|(config, w, b)| (*config, w.cast(), b.cast())).collect(),
            shares: slice.shares.cast(),
        };
        Lpips { backbone: self.backbone, slices: self.slices.iter().map(slice).collect() }
    }

    /// The distance of two RGB images with values in 0..=1; NaN when a value is NaN.
    ///
    /// Nothing is recorded, and features are kept for no longer than until they have been compared. Two images of 400x400
    /// take 0.1 s and 0.1 GB with AlexNet and 0.9 s and 0.5 GB with VGG-16, of 800x800 0.2 s and 0.2 GB, and 4.5 s and
    /// 1.7 GB (two threads; `/usr/bin/time -v target/release/examples/lpips FILE.safetensors FIRST.png SECOND.png`).
    ///
    /// # Panics
    /// If the images differ in size, have no three channels, or are smaller than [`Backbone::smallest`].
    #[track_caller]
    pub fn distance(&self, a: &Image, b: &Image) -> f64 {
        a.assert_same_shape(b);
        assert_eq!(a.channels, SHIFT.len(), "LPIPS needs red, green and blue");
        // AlexNet's first windows leave out up to three columns and rows at the end.
        if a.data.iter().chain(&b.data).any(|value| value.is_nan()) {
            return f64::NAN;
        }
        let tape = Tape::new();
        let [a, b] = [a, b].map(|image| {
            let rows = Tensor::from_vec(&[1, image.height, image.width, image.channels], image.data.clone());
            tape.constant(rows.permute(&[0, 3, 1, 2]).cast())
        });
        self.loss(&a, &b).item().to_f64()
    }

    /// The distances `[n]` of `n` pairs of images `[n, 3, height, width]` with values in 0..=1: ordinary operations on the
    /// tape, so that it serves as a loss. The weights are constants.
    ///
    /// Where all features of a place are 0 their gradient is too, as that of the ReLU that made them. A recorded pass keeps
    /// the features of all layers, and its gradient unfolds each image whole: crops cost what their pixels do.
    ///
    /// ```no_run
    /// use raygrad_autograd::{Tape, Tensor};
    /// use raygrad_nerf::pictures::lpips::Lpips;
    /// let lpips = Lpips::open("lpips-vgg.safetensors")?;
    /// let tape = Tape::new();
    /// let (rendered, target) = (tape.leaf(Tensor::zeros(&[2, 3, 64, 48])), Tensor::ones(&[2, 3, 64, 48]));
    /// let loss = lpips.loss(&rendered, &tape.constant(target)).mean();
    /// let gradient = &loss.grad(&[&rendered])[0];
    /// # Ok::<(), raygrad_nerf::Error>(())
    /// ```
    ///
    /// # Panics
    /// If the shapes differ or are others, or the images are smaller than [`Backbone::smallest`].
    #[track_caller]
    pub fn loss<'t>(&self, a: &Var<'t, T>, b: &Var<'t, T>) -> Var<'t, T> {
        let mut layers = self.layers(a, b).into_iter();
        let first = layers.next();
        layers.fold(first.unwrap_or_else(|| unreachable!("there are five layers")), |sum, layer| sum + layer)
    }

    /// What each of the five slices adds to [`loss`](Self::loss), `[n]` each.
    ///
    /// # Panics
    /// As [`loss`](Self::loss).
    #[track_caller]
    pub fn layers<'t>(&self, a: &Var<'t, T>, b: &Var<'t, T>) -> Vec<Var<'t, T>> {
        assert_eq!(a.shape(), b.shape(), "LPIPS compares images of one size");
        let &[_, 3, height, width] = a.shape() else { panic!("LPIPS needs images [n, 3, h, w], not {:?}", a.shape()) };
        let side = self.backbone.smallest();
        let fits = width >= side && height >= side;
        assert!(fits, "LPIPS with {} needs {side}x{side} pixels, the images have {width}x{height}", self.backbone);
        let [shift, scale] = [SHIFT, SCALE].map(|x| Tensor::from_fn(&[3, 1, 1], |i| T::from_f64(x[i].into())));
        let mut features = [a, b].map(|x| (x * 2.0 - 1.0 - &shift) / &scale);
        let each = |slice: &Slice<T>| {
            // One image after the other, so that they need the space of what is between only once.
            features.iter_mut().for_each(|x| *x = slice.features(x));
            slice.distance(&features)
        };
        self.slices.iter().map(each).collect()
    }
}

impl<T: Scalar> Slice<T> {
    fn features<'t>(&self, x: &Var<'t, T>) -> Var<'t, T> {
        let tape = x.tape();
        let pooled = self.pool.map_or_else(|| x.clone(), |pool| x.max_pool2d(&pool));
        self.convolutions.iter().fold(pooled, |x, (config, weight, bias)| {
            x.conv2d_bias(&tape.constant(weight.clone()), &tape.constant(bias.clone()), config).relu()
        })
    }

    fn distance<'t>(&self, features: &[Var<'t, T>; 2]) -> Var<'t, T> {
        let [a, b] = features.each_ref().map(|x| {
            let &[n, _, height, width] = x.shape() else { unreachable!("features are images") };
            x / (x.norm_over(1).reshape(&[n, 1, height, width]) + EPSILON)
        });
        (a.squared_error(b).mean_over([2, 3]) * &self.shares).sum_over(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_autograd::check::{Check, check_function};
    use raygrad_nn::{Params, Storage};
    use std::collections::{BTreeMap, HashMap};
    use std::path::PathBuf;
    use std::sync::LazyLock;

    /// Numbers from -1 to 1 without a pattern, as in `tests/reference/lpips.py`.
    fn noise(i: usize, salt: u32) -> f64 {
        let mut i = (i as u32).wrapping_mul(2_654_435_761).wrapping_add(salt.wrapping_mul(40503));
        for _ in 0..2 {
            i = (i ^ (i >> 16)).wrapping_mul(0x45d_9f3b);
        }
        f64::from(i ^ (i >> 16)) / 2.0_f64.powi(31) - 1.0
    }

    /// Names and shapes in the order of the package.
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
        // The slice is the first digit, its layer the others.
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

    static WITH_ALEX: LazyLock<Lpips> = LazyLock::new(|| opened(&bytes(&weights(Backbone::Alex))).unwrap());
    static WITH_VGG: LazyLock<Lpips> = LazyLock::new(|| opened(&bytes(&weights(Backbone::Vgg))).unwrap());

    /// The pictures of `tests/reference/lpips.py`.
    fn pictures(width: usize, height: usize) -> [Tensor<f32>; 2] {
        let shape = [2, 3, height, width];
        let stripes = |i: usize| ((i % (7 * width) + 3 * (i % width)) % 64) as f64 / 63.0;
        let a = Tensor::from_fn(&shape, |i| (0.75 * stripes(i) + 0.125 * (noise(i, 100) + 1.0)) as f32);
        let b = |i: usize| 0.875 * f64::from(a.as_slice()[i]) + 0.0625 * (noise(i, 101) + 1.0);
        let b = Tensor::from_fn(&shape, |i| b(i) as f32);
        [a, b]
    }

    /// One of a batch as an image.
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

    /// `tests/reference/lpips.py` asked the authors' package.
    #[test]
    fn distances_are_those_of_the_package_layer_by_layer() {
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
    fn the_distance_is_one() {
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
    fn gradients_are_what_differences_show() {
        let lpips = WITH_ALEX.cast::<f64>();
        let [a, b] = pictures(33, 31).map(|x| x.cast::<f64>());
        let check = Check { second_order: false, step: 1e-6, tolerance: 1e-5, ..Check::default() };
        let report = check_function(&check, &[a, b], |x| lpips.loss(&x[0], &x[1])).unwrap();
        assert!(report.comparisons > 10);
    }

    #[test]
    fn where_nothing_answers_is_no_distance_and_no_gradient() {
        let mut params = weights(Backbone::Vgg);
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
    fn images_that_are_too_small_are_refused() {
        for (lpips, side) in [(&*WITH_ALEX, 31), (&*WITH_VGG, 16)] {
            assert_eq!(lpips.backbone().smallest(), side);
            let of = |width: usize, height: usize| {
                let [a, b] = pictures(width, height).each_ref().map(|batch| image(batch, 0));
                let distance = std::panic::catch_unwind(|| lpips.distance(&a, &b));
                distance.map_err(|panic| panic.downcast_ref::<String>().unwrap().clone())
            };
            assert!(of(side, side).unwrap() > 0.0);
            let expected = |size: String| {
                format!("LPIPS with {} needs {side}x{side} pixels, the images have {size}", lpips.backbone())
            };
            assert_eq!(of(side - 1, side).unwrap_err(), expected(format!("{}x{side}", side - 1)));
            assert_eq!(of(side, side - 1).unwrap_err(), expected(format!("{side}x{}", side - 1)));
        }
    }

    #[test]
    #[should_panic(expected = "differ in height, width or channels")]
    fn other_shapes_are_refused() {
        WITH_ALEX.distance(&Image::new(40, 41, 3), &Image::new(41, 40, 3));
    }

    #[test]
    #[should_panic(expected = "LPIPS needs red, green and blue")]
    fn transparency_is_refused() {
        WITH_ALEX.distance(&Image::new(40, 41, 4), &Image::new(40, 41, 4));
    }

    #[test]
    fn files_that_do_not_serve_are_errors_that_say_why() {
        let good = weights(Backbone::Alex);
        let whole = bytes(&good);
        let refused = |bytes: &[u8], expected: &[&str]| {
            let error = opened(bytes).unwrap_err().to_string();
            assert!(expected.iter().all(|part| error.contains(part)), "{error}");
            assert!(error.contains("lpips_weights.py") && error.lines().count() == 1, "{error}");
        };
        refused(b"", &["not a safetensors file"]);
        for length in [4, 100, whole.len() / 2, whole.len() - 1] {
            refused(&whole[..length], &["not a safetensors file"]);
        }
        // A header that announces more than there is, and more than any memory holds.
        let header = |text: &str| [&(text.len() as u64).to_le_bytes(), text.as_bytes()].concat();
        refused(&(u64::MAX / 2).to_le_bytes(), &["not a safetensors file"]);
        for shape in ["[4000000000,4000000000,3,3]", "[1099511627776]"] {
            let text = format!(r#"{{"net.slice2.3.weight":{{"dtype":"F32","shape":{shape},"data_offsets":[0,4]}}}}"#);
            refused(&header(&text), &["not a safetensors file"]);
        }
        let mut others = Params::new();
        others.add("net.slice1.0.weight", Tensor::zeros(&[1]));
        refused(&bytes(&others), &["neither `net.slice2.3.weight` (alex) nor `net.slice1.2.weight` (vgg)"]);
        // Each tensor is looked for, by its own name and shape.
        let needed = names(Backbone::Alex).into_iter().filter(|(name, _)| name != Backbone::Alex.sign());
        for (absent, shape) in needed {
            let mut others = Params::new();
            for (name, value) in good.iter().filter(|(name, _)| *name != absent) {
                others.add(name, value.clone());
            }
            refused(&bytes(&others), &[&format!("`{absent}`: is missing; F32{shape:?} is expected"), "with alex"]);
        }
        let changed = |name: &str, value: Tensor<f32>| {
            let mut params = Params::new();
            for (own, old) in good.iter() {
                params.add(own, if own == name { value.clone() } else { old.clone() });
            }
            bytes(&params)
        };
        let swapped = changed("net.slice3.6.weight", Tensor::zeros(&[192, 384, 3, 3]));
        refused(&swapped, &["`net.slice3.6.weight`: is F32[192, 384, 3, 3], not F32[384, 192, 3, 3]", "with alex"]);
        let half = good.to_safetensors(Storage::F16, &BTreeMap::new(), &[]).unwrap();
        refused(&half, &["`net.slice1.0.weight`: is F16[64, 3, 11, 11], not F32[64, 3, 11, 11]"]);
        for (name, value, expected) in [
            ("net.slice5.10.bias", f32::NAN, "holds NaN, and must be finite"),
            ("net.slice1.0.weight", f32::INFINITY, "holds inf, and must be finite"),
            ("lin4.model.1.weight", f32::INFINITY, "holds inf, and must be finite"),
            ("lin2.model.1.weight", -1e-3, "holds -0.001, and may hold nothing negative"),
        ] {
            let mut tensor = good.get(good.find(name).unwrap()).clone();
            let last = tensor.len() - 1;
            tensor.as_mut_slice()[last] = value;
            refused(&changed(name, tensor), &[&format!("`{name}`: {expected}")]);
        }
        // What else a `state_dict` holds does no harm.
        let mut more = good.clone();
        more.add("scaling_layer.shift", Tensor::zeros(&[1, 3, 1, 1]));
        assert_eq!(opened(&bytes(&more)).unwrap().backbone(), Backbone::Alex);
        let absent = Lpips::open("absent.safetensors").unwrap_err().to_string();
        assert!(absent.starts_with("absent.safetensors: cannot be read"), "{absent}");
    }

    #[cfg(unix)]
    #[test]
    fn a_file_without_end_is_not_read_to_its_end() {
        let error = Lpips::open("/dev/zero").unwrap_err().to_string();
        assert!(error.starts_with("/dev/zero: has more than 134217728 bytes"), "{error}");
    }

    #[test]
    fn no_number_is_one_at_the_borders_too() {
        // AlexNet's first windows end at the 33rd of 34 columns.
        let mut image = Image::new(34, 31, 3);
        image.pixel_mut(33, 30)[2] = f32::NAN;
        let black = Image::new(34, 31, 3);
        assert!(WITH_ALEX.distance(&image, &black).is_nan() && WITH_ALEX.distance(&black, &image).is_nan());
    }
}
