//! candle on the CPU, in f32. `cargo run --release --bin candle [scalars] [training] [operations]`
//!
//! Its fused softmax and layer norm have no gradient; these are the differentiable ones.

use candle_core::{DType, Device, Result, Tensor, Var};
use candle_nn::{AdamW, Module, Optimizer, ParamsAdamW, VarBuilder, VarMap, loss, ops};
use rust_peers::{CNN, DENSE, MLP, asked, median, report};

fn main() -> Result<()> {
    let device = Device::Cpu;
    if asked("scalars") {
        scalars(&device)?;
    }
    if asked("training") {
        training(&device)?;
    }
    if asked("operations") {
        operations(&device)?;
    }
    Ok(())
}

/// x <- w x + w, 500 times over.
fn scalars(device: &Device) -> Result<()> {
    let w = Var::new(0.999_f32, device)?;
    let chain = || -> Result<Tensor> {
        let mut x = w.as_tensor().clone();
        for _ in 0..500 {
            x = ((&x * w.as_tensor())? + w.as_tensor())?;
        }
        Ok(x)
    };
    let forward = median(100, || drop(chain().unwrap()));
    let both = median(100, || drop(chain().unwrap().backward().unwrap()));
    let figures = [("nanoseconds_forward_per_op", forward * 1e6), ("nanoseconds_backward_per_op", (both - forward) * 1e6)];
    report("candle", "scalar chain, 1000 recorded operations", &figures);
    Ok(())
}

fn train(what: &str, vars: &VarMap, loss_of: impl Fn() -> Result<Tensor>) -> Result<()> {
    let params = ParamsAdamW { weight_decay: 0.0, ..ParamsAdamW::default() };
    let mut adam = AdamW::new(vars.all_vars(), params)?;
    let (mut first, mut last) = (None, 0.0);
    let seconds = median(60, || {
        let loss = loss_of().unwrap();
        adam.backward_step(&loss).unwrap();
        last = f64::from(loss.to_scalar::<f32>().unwrap());
        first.get_or_insert(last);
    });
    let figures = [("seconds_per_step", seconds), ("loss_first", first.unwrap_or(0.0)), ("loss_last", last)];
    report("candle", what, &figures);
    Ok(())
}

fn training(device: &Device) -> Result<()> {
    let classes = Tensor::from_iter((0..128).map(|i| i % 10_u32), device)?;
    let stack = |sizes: &[usize], vars: &VarMap| -> Result<Vec<candle_nn::Linear>> {
        let builder = VarBuilder::from_varmap(vars, DType::F32, device);
        (1..sizes.len()).map(|i| candle_nn::linear(sizes[i - 1], sizes[i], builder.pp(i))).collect()
    };
    let forward = |layers: &[candle_nn::Linear], x: &Tensor| -> Result<Tensor> {
        let (last, hidden) = layers.split_last().unwrap();
        let h = hidden.iter().try_fold(x.clone(), |h, layer| layer.forward(&h)?.relu())?;
        last.forward(&h)
    };

    let vars = VarMap::new();
    let layers = stack(&[32, 64, 64, 64, 3], &vars)?;
    let (x, target) = (Tensor::rand(0.0_f32, 1.0, (256, 32), device)?, Tensor::rand(0.0_f32, 1.0, (256, 3), device)?);
    train(MLP, &vars, || loss::mse(&forward(&layers, &x)?, &target))?;

    let vars = VarMap::new();
    let layers = stack(&[784, 512, 512, 10], &vars)?;
    let x = Tensor::rand(0.0_f32, 1.0, (128, 784), device)?;
    train(DENSE, &vars, || loss::cross_entropy(&forward(&layers, &x)?, &classes))?;

    let vars = VarMap::new();
    let builder = VarBuilder::from_varmap(&vars, DType::F32, device);
    let padded = candle_nn::Conv2dConfig { padding: 1, ..Default::default() };
    let first = candle_nn::conv2d(1, 8, 3, padded, builder.pp("first"))?;
    let second = candle_nn::conv2d(8, 16, 3, padded, builder.pp("second"))?;
    let last = candle_nn::linear(16 * 7 * 7, 10, builder.pp("last"))?;
    let (x, classes) = (Tensor::rand(0.0_f32, 1.0, (64, 1, 28, 28), device)?, classes.narrow(0, 0, 64)?);
    train(CNN, &vars, || {
        let h = first.forward(&x)?.relu()?.max_pool2d(2)?;
        let h = second.forward(&h)?.relu()?.max_pool2d(2)?;
        loss::cross_entropy(&last.forward(&h.flatten_from(1)?)?, &classes)
    })
}

/// The gradient of the sum of f(x).
fn operation(what: &str, x: &Var, f: impl Fn(&Tensor) -> Result<Tensor>) {
    let seconds = median(30, || drop(f(x.as_tensor()).and_then(|y| y.sum_all()?.backward()).unwrap()));
    report("candle", what, &[("seconds_forward_backward", seconds)]);
}

fn operations(device: &Device) -> Result<()> {
    let random = |shape: &[usize]| Var::from_tensor(&Tensor::randn(0.0_f32, 1.0, shape, device)?);
    let x = random(&[1024, 512])?;
    let weight = random(&[1024, 512])?.as_detached_tensor();
    operation("softmax 1024x512", &x, |x| ops::softmax(x, 1)? * &weight);
    let (gain, bias) = (Var::ones(512, DType::F32, device)?, Var::zeros(512, DType::F32, device)?);
    operation("layer norm 1024x512", &x, |x| {
        ops::layer_norm_slow(x, gain.as_tensor(), bias.as_tensor(), 1e-5)? * &weight
    });
    let x = random(&[1_000_000])?;
    operation("elementwise chain, 1M", &x, |x| {
        let bump = ((x * x)? * -0.5)?.exp()?;
        ((x.affine(1.5, 0.5)?.tanh()? * x)? + bump)? - x
    });
    let x = random(&[4096, 1024])?;
    operation("sum over axis 0, 4096x1024", &x, |x| x.sum(0));
    operation("sum over axis 1, 4096x1024", &x, |x| x.sum(1));
    operation("sum, 4096x1024", &x, Tensor::sum_all);
    Ok(())
}
