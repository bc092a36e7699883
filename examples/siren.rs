//! A custom field in one file: a network of sines without an encoding (Sitzmann et al. 2020, "Implicit Neural
//! Representations with Periodic Activation Functions").
//!
//! ```text
//! cargo run --release --example siren [seconds] [folder for the image and the model]
//! ```
//!
//! Trains for 60 seconds on the embedded scene unless told otherwise, saves the model, loads it, and draws it.

use rand::Rng;
use raygrad::nerf::dataset::Split;
use raygrad::nerf::imaging::metrics::psnr;
use raygrad::nerf::{
    Budget, BuildContext, ComponentConfig, Config, Density, Field, FieldConfig, Fields, Image, Model, Preset, Result,
    Space, SphericalHarmonics, Trainer, ViewInputs, register,
};
use raygrad::{Activation, Bound, Init, Linear, ParamId, Params, Scalar, Schedule, Tensor, Var};
use raygrad_scenes::embedded;
use serde::{Deserialize, Serialize};
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// Size of a [`Siren`].
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SirenConfig {
    /// Hidden layers.
    depth: usize,
    /// Their width.
    width: usize,
    /// What the first layer's arguments are multiplied by: how fine the finest detail can be.
    frequency: f64,
}

impl ComponentConfig<Fields> for SirenConfig {
    const KIND: &'static str = "siren";

    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<Arc<dyn Field<T>>> {
        let BuildContext { space, params, name, rng, .. } = site;
        let mut layers = vec![Sine::new(params, &format!("{name}.0"), [3, self.width], self.frequency, true, rng)];
        for i in 1..self.depth {
            layers.push(Sine::new(params, &format!("{name}.{i}"), [self.width; 2], 1.0, false, rng));
        }
        let direction = SphericalHarmonics::new(3);
        let mut linear = |part: &str, sizes, activation, init| {
            Linear::new(params, &format!("{name}.{part}"), sizes, activation, init, &mut *rng)
        };
        Ok(Arc::new(Siren {
            space,
            layers,
            density: linear("density", [self.width, 1], Activation::Identity, Init::Glorot),
            hidden: linear("hidden", [self.width + direction.width(), self.width], Activation::Relu, Init::He),
            color: linear("color", [self.width, 3], Activation::Identity, Init::Glorot),
            direction,
        }))
    }
}

/// `sin(frequency (x W + b))`, with the paper's weights at the start (section 3.2): so each layer's outputs are spread
/// alike.
struct Sine {
    weight: ParamId,
    bias: ParamId,
    frequency: f64,
}

impl Sine {
    fn new<T: Scalar>(
        params: &mut Params<T>,
        name: &str,
        [inputs, outputs]: [usize; 2],
        frequency: f64,
        first: bool,
        rng: &mut (impl Rng + ?Sized),
    ) -> Self {
        let bound = if first { 1.0 / inputs as f64 } else { (6.0 / inputs as f64).sqrt() };
        let mut add = |part: &str, shape: &[usize]| {
            params.add(format!("{name}.{part}"), Tensor::uniform(shape, -bound..bound, rng))
        };
        Sine { weight: add("weight", &[inputs, outputs]), bias: add("bias", &[outputs]), frequency }
    }

    fn forward<'t, T: Scalar>(&self, params: &Bound<'t, T>, x: &Var<'t, T>) -> Var<'t, T> {
        (x.linear(&params[self.weight], Some(&params[self.bias]), Activation::Identity) * self.frequency).sin()
    }
}

/// Sines of sines of positions.
struct Siren {
    space: Space,
    layers: Vec<Sine>,
    density: Linear,
    hidden: Linear,
    color: Linear,
    direction: SphericalHarmonics,
}

impl<T: Scalar> Field<T> for Siren {
    fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
        let start = self.space.centred(positions);
        let features = self.layers.iter().fold(start, |x, layer| layer.forward(params, &x));
        let raw = self.density.forward(params, &features).reshape(&[positions.shape()[0]]);
        // Sines are bounded: surfaces need room.
        Density { value: (raw * 10.0 - 1.0).softplus() * (1.0 / self.space.unit), log: false, features }
    }

    fn color<'t>(&self, params: &Bound<'t, T>, features: &Var<'t, T>, seen: &ViewInputs<'_, 't, T>) -> Var<'t, T> {
        let directions = features.tape().apply(self.direction, &[seen.directions]).segment_expand(seen.segments);
        let hidden = self.hidden.forward(params, &Var::concat(&[features, &directions], 1));
        self.color.forward(params, &hidden).sigmoid()
    }
}

fn main() -> Result<()> {
    // So that a configuration that names it can be read.
    register::<Fields, SirenConfig>();
    let mut args = std::env::args().skip(1);
    let seconds = args.next().map_or(60.0, |text| text.parse().expect("the first argument is a number of seconds"));
    let folder = PathBuf::from(args.next().unwrap_or("target/examples-out".into()));
    std::fs::create_dir_all(&folder).expect("the folder for images can be made");

    let [train, test] = [Split::Train, Split::Test].map(|split| embedded(split, 200));
    let field = SirenConfig { depth: 4, width: 96, frequency: 30.0 };
    let schedule = Schedule::Exponential { from: 1e-3, to: 1e-4, warmup: 0.01 };
    let config = Config { field: FieldConfig::new(field), schedule, ..Config::preset(Preset::Instant) };
    let mut trainer = Trainer::new(config, Arc::new(train))?;
    let mut next = 0.0;
    trainer.run(Budget::Time(Duration::from_secs_f64(seconds)), |trainer| {
        let now = trainer.stats();
        if now.train_seconds >= next {
            println!("{:6.1} s  step {:5}  loss {:.4}  {:.1} dB", now.train_seconds, now.step, now.loss, now.psnr);
            next = now.train_seconds + seconds / 12.0;
        }
        ControlFlow::Continue(())
    });

    // As any model: saved, loaded from its configuration as text, and drawn.
    let (file, model) = (folder.join("siren.safetensors"), &trainer.model);
    model.save(&file)?;
    let text = serde_json::to_string(&model.config).expect("a configuration is text");
    let loaded = Model::load(&file, serde_json::from_str(&text).expect("that can be read"), model.scene_box)?;
    let frames: Vec<_> = test.frames.iter().step_by(test.frames.len().div_ceil(8)).collect();
    let seen: Vec<_> = frames.iter().map(|frame| loaded.render(&frame.camera, [1.0; 3]).color).collect();
    assert_eq!(seen[0], model.render(&frames[0].camera, [1.0; 3]).color, "what was loaded is what was saved");
    let truth: Vec<_> = frames.iter().map(|frame| frame.image.over([1.0; 3])).collect();
    let mean = seen.iter().zip(&truth).map(|(a, b)| psnr(a, b)).sum::<f64>() / seen.len() as f64;
    let bytes = std::fs::metadata(&file).map_or(0, |file| file.len());
    println!("{} steps, {bytes} bytes, {mean:.2} dB on {} test views", trainer.stats().step, seen.len());
    let path = folder.join("siren.png");
    Image::hconcat(&[&truth[0], &seen[0]]).save_png(&path)?;
    println!("{}: truth, view", path.display());
    Ok(())
}
