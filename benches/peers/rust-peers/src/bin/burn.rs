//! burn on the CPU, in f32: its back end `flex`, or the older `ndarray` with `--ndarray`.
//! `cargo run --release --bin burn [scalars] [training] [operations] [--ndarray]`

use burn::module::{Module, Param};
use burn::nn::conv::{Conv2d, Conv2dConfig};
use burn::nn::loss::{CrossEntropyLossConfig, MseLoss, Reduction};
use burn::nn::pool::{MaxPool2d, MaxPool2dConfig};
use burn::nn::{Linear, LinearConfig, PaddingConfig2d};
use burn::optim::{AdamConfig, GradientsParams};
use burn::tensor::{Device, Distribution, Int, Tensor, activation};
use rust_peers::{CNN, DENSE, MLP, asked, median, report};

struct Back {
    device: Device,
    name: &'static str,
}

fn main() {
    let older = std::env::args().any(|a| a == "--ndarray");
    #[allow(deprecated)]
    let (device, name) = if older { (Device::ndarray(), "burn-ndarray") } else { (Device::flex(), "burn-flex") };
    let back = Back { device: device.autodiff(), name };
    if asked("scalars") {
        back.scalars();
    }
    if asked("training") {
        back.training();
    }
    if asked("operations") {
        back.operations();
    }
}

#[derive(Module, Debug)]
struct Mlp {
    layers: Vec<Linear>,
}

impl Mlp {
    fn new(sizes: &[usize], device: &Device) -> Self {
        Mlp { layers: sizes.windows(2).map(|pair| LinearConfig::new(pair[0], pair[1]).init(device)).collect() }
    }

    fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let (last, hidden) = self.layers.split_last().unwrap();
        last.forward(hidden.iter().fold(x, |h, layer| activation::relu(layer.forward(h))))
    }
}

#[derive(Module, Debug)]
struct Cnn {
    first: Conv2d,
    second: Conv2d,
    pool: MaxPool2d,
    last: Linear,
}

impl Cnn {
    fn new(device: &Device) -> Self {
        let conv = |channels| {
            let config = Conv2dConfig::new(channels, [3, 3]).with_padding(PaddingConfig2d::Explicit(1, 1, 1, 1));
            config.init(device)
        };
        Cnn {
            first: conv([1, 8]),
            second: conv([8, 16]),
            pool: MaxPool2dConfig::new([2, 2]).with_strides([2, 2]).init(),
            last: LinearConfig::new(16 * 7 * 7, 10).init(device),
        }
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<2> {
        let h = self.pool.forward(activation::relu(self.first.forward(x)));
        let h = self.pool.forward(activation::relu(self.second.forward(h)));
        self.last.forward(h.flatten(1, 3))
    }
}

impl Back {
    /// x <- w x + w, 500 times over. The smallest tensor has one axis.
    fn scalars(&self) {
        let w = Tensor::<1>::from_floats([0.999], &self.device).require_grad();
        let chain = || (0..500).fold(w.clone(), |x, _| x * w.clone() + w.clone());
        let forward = median(100, || drop(chain()));
        let both = median(100, || drop(w.grad(&chain().backward()).unwrap()));
        let figures =
            [("nanoseconds_forward_per_op", forward * 1e6), ("nanoseconds_backward_per_op", (both - forward) * 1e6)];
        report(self.name, "scalar chain, 1000 recorded operations", &figures);
    }

    fn train<M: Module>(&self, what: &str, model: M, loss_of: impl Fn(&M) -> Tensor<1>) {
        let mut adam = AdamConfig::new().init();
        let mut model = Some(model);
        let (mut first, mut last) = (None, 0.0);
        let seconds = median(60, || {
            let now = model.take().unwrap();
            let loss = loss_of(&now);
            let grads = GradientsParams::from_grads(loss.backward(), &now);
            model = Some(adam.step(1e-3, now, grads));
            last = f64::from(loss.into_scalar::<f32>());
            first.get_or_insert(last);
        });
        let figures = [("seconds_per_step", seconds), ("loss_first", first.unwrap_or(0.0)), ("loss_last", last)];
        report(self.name, what, &figures);
    }

    fn uniform<const D: usize>(&self, shape: [usize; D]) -> Tensor<D> {
        Tensor::random(shape, Distribution::Uniform(0.0, 1.0), &self.device)
    }

    fn training(&self) {
        let device = &self.device;
        let (x, target) = (self.uniform([256, 32]), self.uniform([256, 3]));
        self.train(MLP, Mlp::new(&[32, 64, 64, 64, 3], device), |model| {
            MseLoss::new().forward(model.forward(x.clone()), target.clone(), Reduction::Mean)
        });
        let entropy = CrossEntropyLossConfig::new().init(device);
        let classes = |count: i64| Tensor::<1, Int>::arange(0..count, device).remainder_scalar(10);
        let (x, target) = (self.uniform([128, 784]), classes(128));
        self.train(DENSE, Mlp::new(&[784, 512, 512, 10], device), |model| {
            entropy.forward(model.forward(x.clone()), target.clone())
        });
        let (x, target) = (self.uniform([64, 1, 28, 28]), classes(64));
        self.train(CNN, Cnn::new(device), |model| entropy.forward(model.forward(x.clone()), target.clone()));
    }

    /// The gradient of the sum of f(x).
    fn operation<const D: usize, const E: usize>(&self, what: &str, x: &Tensor<D>, f: impl Fn(Tensor<D>) -> Tensor<E>) {
        let seconds = median(30, || drop(x.grad(&f(x.clone()).sum().backward()).unwrap()));
        report(self.name, what, &[("seconds_forward_backward", seconds)]);
    }

    fn operations(&self) {
        fn random<const D: usize>(back: &Back, shape: [usize; D]) -> Tensor<D> {
            Tensor::random(shape, Distribution::Normal(0.0, 1.0), &back.device)
        }
        let weight = random(self, [1024, 512]);
        let x = random(self, [1024, 512]).require_grad();
        self.operation("softmax 1024x512", &x, |x| activation::softmax(x, 1) * weight.clone());
        let norm = burn::nn::LayerNormConfig::new(512).init(&self.device);
        self.operation("layer norm 1024x512", &x, |x| norm.forward(x) * weight.clone());
        let x = random(self, [1_000_000]).require_grad();
        self.operation("elementwise chain, 1M", &x, |x| {
            let bump = (x.clone() * x.clone() * -0.5).exp();
            (x.clone() * 1.5 + 0.5).tanh() * x.clone() + bump - x
        });
        let x = random(self, [4096, 1024]).require_grad();
        self.operation("sum over axis 0, 4096x1024", &x, |x| x.sum_dim(0));
        self.operation("sum over axis 1, 4096x1024", &x, |x| x.sum_dim(1));
        self.operation("sum, 4096x1024", &x, |x| x.sum());
        let _: Option<Param<Tensor<1>>> = norm.beta;
    }
}
