//! LPIPS, a perceptual distance of images. Start with [`Lpips::open`].
//!
//! Zhang, Isola, Efros, Shechtman and Wang, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric"
//! (CVPR 2018), version 0.1, as the authors' package `lpips` computes it. raygrad ships no weights;
//! `benches/peers/lpips_weights.py` converts those of the package.

use crate::dataset::image::Image;
use crate::error::{Error, Result};
use raygrad_autograd::{Conv2dConfig, Pool2dConfig, Scalar, Tape, Tensor, Var};
use safetensors::tensor::{Dtype, SafeTensors};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// The network whose features LPIPS compares. Distances of different networks are not comparable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Backbone {
    /// AlexNet: fast.
    Alex,
    /// VGG-16: about 20 times the work of AlexNet.
    Vgg,
}

impl fmt::Display for Backbone {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

/// A convolution with a bias and a ReLU.
#[derive(Clone, Copy)]
struct Convolution {
    /// Its index in torchvision's `features`.
    layer: usize,
    outputs: usize,
    kernel: usize,
    stride: usize,
    padding: usize,
}

/// A convolution with stride 1 that keeps the extents.
const fn same(layer: usize, outputs: usize, kernel: usize) -> Convolution {
    Convolution { layer, outputs, kernel, stride: 1, padding: kernel / 2 }
}

/// A network with the features of five slices.
struct Network {
    /// For each slice, the window of the max pooling before it (stride 2), and its convolutions.
    slices: [(Option<usize>, &'static [Convolution]); 5],
    smallest: usize,
    bytes: f64,
    /// A tensor that this network alone has.
    sign: &'static str,
}

const ALEX: Network = Network {
    slices: [
        (None, &[Convolution { layer: 0, outputs: 64, kernel: 11, stride: 4, padding: 2 }]),
        (Some(3), &[same(3, 192, 5)]),
        (Some(3), &[same(6, 384, 3)]),
        (None, &[same(8, 256, 3)]),
        (None, &[same(10, 256, 3)]),
    ],
    smallest: 31,
    bytes: 400.0,
    sign: "net.slice2.3.weight",
};
const VGG: Network = Network {
    slices: [
        (None, &[same(0, 64, 3), same(2, 64, 3)]),
        (Some(2), &[same(5, 128, 3), same(7, 128, 3)]),
        (Some(2), &[same(10, 256, 3), same(12, 256, 3), same(14, 256, 3)]),
        (Some(2), &[same(17, 512, 3), same(19, 512, 3), same(21, 512, 3)]),
        (Some(2), &[same(24, 512, 3), same(26, 512, 3), same(28, 512, 3)]),
    ],
    smallest: 16,
    bytes: 2700.0,
    sign: "net.slice1.2.weight",
};

impl Backbone {
    fn network(self) -> &'static Network {
        match self {
            Backbone::Alex => &ALEX,
            Backbone::Vgg => &VGG,
        }
    }

    /// Returns the smallest side of an image that the network accepts, in pixels.
    pub fn smallest(self) -> usize {
        self.network().smallest
    }

    /// Returns the approximate memory of [`Lpips::distance`], in bytes per pixel of an image.
    pub fn bytes(self) -> f64 {
        self.network().bytes
    }
}

/// The largest weights file, in bytes. VGG-16 takes 59 MB.
const LONGEST: u64 = 1 << 27;
/// The remedy for an unusable file.
const MAKE: &str = "make the file with benches/peers/lpips_weights.py";

/// The mean and standard deviation of images from -1 to 1, per channel, as in the authors' package.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Added to the length of features before the division by it.
const EPSILON: f64 = 1e-10;

/// LPIPS weights, which compute a perceptual distance: 0 for identical images, up to about 1.
///
/// Both images pass through the first layers of an ImageNet classifier. At the ends of five slices `l`, the features
/// `f` of each place are normalised, and
///
/// ```text
/// u = f / (|f| + 1e-10)        d = sum over l of mean over places of sum over channels c of w_lc (u_lc(a) - u_lc(b))^2
/// ```
///
/// with weights `w >= 0` that were fitted to human judgements. Distances depend on the network and the weights.
#[derive(Debug, Clone)]
pub struct Lpips<T: Scalar = f32> {
    backbone: Backbone,
    slices: Vec<Slice<T>>,
}

/// A slice of the network, and the weights of its features.
#[derive(Debug, Clone)]
struct Slice<T: Scalar> {
    pool: Option<Pool2dConfig>,
    convolutions: Vec<(Conv2dConfig, Tensor<T>, Tensor<T>)>,
    /// One weight per channel.
    shares: Tensor<T>,
}

impl Lpips<f32> {
    /// Reads weights from a safetensors file of f32 tensors, and recognises the network by their names.
    ///
    /// Names are those of the `state_dict` of the package's `lpips.LPIPS(net="alex")` or `lpips.LPIPS(net="vgg")`.
    /// Other tensors are ignored.
    ///
    /// # Errors
    /// If the file cannot be read, is not a safetensors file, or lacks a tensor. If a tensor has another shape or type
    /// or a non-finite number, or a channel weight is negative.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let unread = |error: std::io::Error| Error::file(path, format!("cannot be read: {error}"));
        let mut bytes = vec![];
        File::open(path).map_err(unread)?.take(LONGEST + 1).read_to_end(&mut bytes).map_err(unread)?;
        if bytes.len() as u64 > LONGEST {
            return Err(Error::file(
                path,
                format!("has more than {LONGEST} bytes, too many for LPIPS weights: {MAKE}"),
            ));
        }
        let file = SafeTensors::deserialize(&bytes)
            .map_err(|error| Error::file(path, format!("is not a safetensors file ({error}): {MAKE}")))?;
        let has = |backbone: &Backbone| file.tensor(backbone.network().sign).is_ok();
        let Some(backbone) = [Backbone::Alex, Backbone::Vgg].into_iter().find(has) else {
            let [alex, vgg] = [ALEX.sign, VGG.sign];
            let what = format!("has no LPIPS weights, neither `{alex}` (alex) nor `{vgg}` (vgg): {MAKE}");
            return Err(Error::file(path, what));
        };
        let read = |name: &str, shape: &[usize], least: f32| {
            tensor(&file, name, shape, least)
                .map_err(|what| Error::field(path, name, format!("{what}, in LPIPS weights for {backbone}: {MAKE}")))
        };
        let (mut slices, mut inputs) = (vec![], SHIFT.len());
        for (i, (window, layers)) in backbone.network().slices.into_iter().enumerate() {
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
            let pool = window.map(|window| Pool2dConfig { stride: [2, 2], ..Pool2dConfig::new([window; 2]) });
            slices.push(Slice { pool, convolutions, shares });
        }
        Ok(Lpips { backbone, slices })
    }
}

/// A tensor of a file, checked to be finite and at least `least`; or an error message.
fn tensor(file: &SafeTensors<'_>, name: &str, shape: &[usize], least: f32) -> std::result::Result<Tensor<f32>, String> {
    let Ok(found) = file.tensor(name) else { return Err(format!("is missing, should be F32{shape:?}")) };
    if found.dtype() != Dtype::F32 || found.shape() != shape {
        return Err(format!("is {:?}{:?}, should be F32{shape:?}", found.dtype(), found.shape()));
    }
    let values = f32::read_le(found.data());
    match values.iter().find(|x| !(x.is_finite() && **x >= least)) {
        Some(x) if x.is_finite() => Err(format!("has the value {x}, should be at least 0")),
        Some(x) => Err(format!("has the value {x}, should be finite")),
        None => Ok(Tensor::from_vec(shape, values)),
    }
}

impl<T: Scalar> Lpips<T> {
    /// Returns the network whose features are compared.
    pub fn backbone(&self) -> Backbone {
        self.backbone
    }

    /// Converts the weights to another precision.
    pub fn cast<U: Scalar>(&self) -> Lpips<U> {
        let slice = |slice: &Slice<T>| Slice {
            pool: slice.pool,
            convolutions: slice.convolutions.iter().map(|(config, w, b)| (*config, w.cast(), b.cast())).collect(),
            shares: slice.shares.cast(),
        };
        Lpips { backbone: self.backbone, slices: self.slices.iter().map(slice).collect() }
    }

    /// Computes the distance of two RGB images with values of 0 to 1; NaN if a value is NaN. Nothing is recorded.
    ///
    /// | image | AlexNet | VGG-16 |
    /// |---|---|---|
    /// | 400x400 | 0.1 s, 0.1 GB | 0.9 s, 0.5 GB |
    /// | 800x800 | 0.2 s, 0.2 GB | 4.5 s, 1.7 GB |
    ///
    /// (Two threads; `/usr/bin/time -v target/release/examples/lpips FILE.safetensors FIRST.png SECOND.png`.)
    ///
    /// # Panics
    /// If the images differ in size, do not have three channels, or are smaller than [`Backbone::smallest`].
    #[track_caller]
    pub fn distance(&self, a: &Image, b: &Image) -> f64 {
        a.assert_same_shape(b);
        assert_eq!(a.channels, SHIFT.len(), "LPIPS needs three channels: red, green and blue");
        // AlexNet's first convolution ignores up to three columns and rows at the end, so NaN there would go unnoticed.
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

    /// Computes the distances `[n]` of `n` pairs of images `[n, 3, height, width]`, values 0 to 1, as a differentiable
    /// loss.
    ///
    /// The weights are constants. Where all features of a place are 0, so is their gradient. The tape keeps the
    /// features of all layers; use crops to save memory.
    ///
    /// ```no_run
    /// use raygrad_autograd::{Tape, Tensor};
    /// use raygrad_nerf::imaging::lpips::Lpips;
    /// let lpips = Lpips::open("lpips-vgg.safetensors")?;
    /// let tape = Tape::new();
    /// let (rendered, target) = (tape.leaf(Tensor::zeros(&[2, 3, 64, 48])), Tensor::ones(&[2, 3, 64, 48]));
    /// let loss = lpips.loss(&rendered, &tape.constant(target)).mean();
    /// let gradient = &loss.grad(&[&rendered])[0];
    /// # Ok::<(), raygrad_nerf::Error>(())
    /// ```
    ///
    /// # Panics
    /// If the shapes differ or are not `[n, 3, height, width]`, or the images are smaller than [`Backbone::smallest`].
    #[track_caller]
    pub fn loss<'t>(&self, a: &Var<'t, T>, b: &Var<'t, T>) -> Var<'t, T> {
        let mut layers = self.layers(a, b).into_iter();
        let first = layers.next();
        layers.fold(first.unwrap_or_else(|| unreachable!("there are five layers")), |sum, layer| sum + layer)
    }

    /// Computes the parts of [`loss`](Self::loss) from the five slices, `[n]` each.
    ///
    /// # Panics
    /// As [`loss`](Self::loss).
    #[track_caller]
    pub fn layers<'t>(&self, a: &Var<'t, T>, b: &Var<'t, T>) -> Vec<Var<'t, T>> {
        assert_eq!(a.shape(), b.shape(), "LPIPS needs images of one size");
        let &[_, 3, height, width] = a.shape() else { panic!("LPIPS needs images [n, 3, h, w], not {:?}", a.shape()) };
        let side = self.backbone.smallest();
        let fits = width >= side && height >= side;
        assert!(
            fits,
            "LPIPS with {} needs at least {side}x{side} pixels, the images have {width}x{height}",
            self.backbone
        );
        let [shift, scale] = [SHIFT, SCALE].map(|x| Tensor::from_fn(&[3, 1, 1], |i| T::from_f64(x[i].into())));
        let mut features = [a, b].map(|x| (x * 2.0 - 1.0 - &shift) / &scale);
        let each = |slice: &Slice<T>| {
            // One image after the other, so that both use the same memory for intermediate features.
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
mod tests;
