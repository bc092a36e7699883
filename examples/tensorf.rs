//! A custom field in one file: planes and vectors in place of a hash grid (Chen et al. 2022, "TensoRF: Tensorial
//! Radiance Fields", section 4.2, the vector-matrix factorisation).
//!
//! ```text
//! cargo run --release --example tensorf [seconds] [folder for the image and the model]
//! ```
//!
//! Trains for 60 seconds on the embedded scene unless told otherwise, saves the model, loads it, and draws it.

use raygrad::nerf::dataset::Split;
use raygrad::nerf::imaging::metrics::psnr;
use raygrad::nerf::{
    Budget, BuildContext, ComponentConfig, Config, Density, Field, FieldConfig, Fields, Image, Model, Preset, Result,
    Space, SphericalHarmonics, Trainer, ViewInputs, register,
};
use raygrad::{Activation, Bound, Init, Linear, ParamId, Scalar, Schedule, Tensor, Var};
use raygrad_scenes::embedded;
use serde::{Deserialize, Serialize};
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// Size of a [`TensorF`].
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct TensorFConfig {
    /// Places along each axis of a plane and of a vector.
    resolution: usize,
    /// Products of a plane and a vector for each axis: of the density, and of the colour.
    components: [usize; 2],
    /// Width of the colour network.
    width: usize,
}

impl ComponentConfig<Fields> for TensorFConfig {
    const KIND: &'static str = "tensorf";

    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<Arc<dyn Field<T>>> {
        let BuildContext { space, params, name, rng, .. } = site;
        let (n, [density, color], direction) = (self.resolution, self.components, SphericalHarmonics::new(3));
        let factors = |axis: usize| {
            let channels = density + color;
            let mut add = |part: &str, rows: usize| {
                params.add(
                    format!("{name}.{part}.{axis}"),
                    Tensor::randn(&[rows, channels], rng).map(|x| x * T::from_f64(0.1)),
                )
            };
            [add("plane", n * n), add("vector", n)]
        };
        let factors = [0, 1, 2].map(factors);
        // Of these tables a step moves only the rows that a sample touches.
        params.set_lazy(|other| other.starts_with(&format!("{name}.plane")), true);
        let mut layer = |part: &str, sizes, activation| {
            Linear::new(params, &format!("{name}.{part}"), sizes, activation, Init::He, &mut *rng)
        };
        Ok(Arc::new(TensorF {
            config: self.clone(),
            space,
            factors,
            basis: layer("basis", [3 * color, 24], Activation::Identity),
            hidden: layer("hidden", [24 + direction.width(), self.width], Activation::Relu),
            color: layer("color", [self.width, 3], Activation::Identity),
            direction,
        }))
    }
}

/// Density and colour features as sums, over the three axes, of a plane across the axis times a vector along it.
struct TensorF {
    config: TensorFConfig,
    space: Space,
    /// For each axis the plane across it, `[resolution^2, channels]`, and the vector along it, `[resolution, channels]`.
    factors: [[ParamId; 2]; 3],
    basis: Linear,
    hidden: Linear,
    color: Linear,
    direction: SphericalHarmonics,
}

/// A coordinate as the number of the place below it and the share of the way to the next one.
struct Place<'t, T: Scalar> {
    below: Vec<u32>,
    share: Var<'t, T>,
}

impl TensorF {
    fn place<'t, T: Scalar>(&self, unit: &Var<'t, T>, axis: usize) -> Place<'t, T> {
        let last = self.config.resolution - 1;
        let x = unit.slice_axis(1, axis..axis + 1).clamp(0.0, 1.0) * last as f64;
        let below: Vec<u32> = x.value().as_slice().iter().map(|x| (x.to_f64() as u32).min(last as u32 - 1)).collect();
        let floor = Tensor::from_fn(x.shape(), |i| T::from_f64(below[i].into()));
        Place { share: x - floor, below }
    }

    /// The products of plane and vector at positions in the unit cube, `[samples, 3 channels]`: linear between places.
    fn products<'t, T: Scalar>(&self, params: &Bound<'t, T>, unit: &Var<'t, T>) -> [Var<'t, T>; 3] {
        let places = [0, 1, 2].map(|axis| self.place(unit, axis));
        let rows = self.config.resolution as u32;
        [0, 1, 2].map(|axis| {
            let [along, u, v] = [axis, (axis + 1) % 3, (axis + 2) % 3].map(|axis| &places[axis]);
            let [plane, vector] = self.factors[axis].map(|id| &params[id]);
            let corner = |du: u32, dv: u32| {
                let index: Vec<u32> = u.below.iter().zip(&v.below).map(|(u, v)| (u + du) + rows * (v + dv)).collect();
                plane.gather_rows(index)
            };
            let near = corner(0, 0).lerp(corner(1, 0), &u.share);
            let far = corner(0, 1).lerp(corner(1, 1), &u.share);
            let next: Vec<u32> = along.below.iter().map(|place| place + 1).collect();
            let line = vector.gather_rows(&along.below[..]).lerp(vector.gather_rows(next), &along.share);
            near.lerp(far, &v.share) * line
        })
    }
}

impl<T: Scalar> Field<T> for TensorF {
    fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
        let [x, y, z] = self.products(params, &self.space.cube(positions));
        let [density, color] = self.config.components;
        let sum = [&x, &y, &z].map(|part| part.slice_axis(1, ..density).sum_over(1));
        let raw = sum.into_iter().sum::<Var<'_, T>>() * 10.0;
        let parts = [&x, &y, &z].map(|part| part.slice_axis(1, density..density + color));
        let features = Var::concat(&parts.each_ref(), 1);
        Density { value: (raw - 1.0).softplus() * (10.0 / self.space.unit), log: false, features }
    }

    fn color<'t>(&self, params: &Bound<'t, T>, features: &Var<'t, T>, seen: &ViewInputs<'_, 't, T>) -> Var<'t, T> {
        let directions = features.tape().apply(self.direction, &[seen.directions]).segment_expand(seen.segments);
        let basis = self.basis.forward(params, features);
        let hidden = self.hidden.forward(params, &Var::concat(&[&basis, &directions], 1));
        self.color.forward(params, &hidden).sigmoid()
    }
}

fn main() -> Result<()> {
    // So that a configuration that names it can be read.
    register::<Fields, TensorFConfig>();
    let mut args = std::env::args().skip(1);
    let seconds = args.next().map_or(60.0, |text| text.parse().expect("the first argument is a number of seconds"));
    let folder = PathBuf::from(args.next().unwrap_or("target/examples-out".into()));
    std::fs::create_dir_all(&folder).expect("the folder for images can be made");

    let [train, test] = [Split::Train, Split::Test].map(|split| embedded(split, 200));
    let field = TensorFConfig { resolution: 128, components: [8, 24], width: 64 };
    let schedule = Schedule::Exponential { from: 2e-2, to: 2e-3, warmup: 0.0 };
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
    let (file, model) = (folder.join("tensorf.safetensors"), &trainer.model);
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
    let path = folder.join("tensorf.png");
    Image::hconcat(&[&truth[0], &seen[0]]).save_png(&path)?;
    println!("{}: truth, view", path.display());
    Ok(())
}
