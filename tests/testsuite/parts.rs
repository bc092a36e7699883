//! Components of a model, combined through the public interface: custom and built-in fields, samplers and loss terms.

use raygrad::nerf::camera::stratified;
use raygrad::nerf::dataset::{Dataset, Split};
use raygrad::nerf::encoding::hash_grid::HashGridConfig;
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::losses::{DistortionConfig, EntropyConfig, OrientationConfig};
use raygrad::nerf::sampling::marching::MarchingConfig;
use raygrad::nerf::sampling::proposal::ProposalConfig;
use raygrad::nerf::space::occupancy::{OccupancyConfig, Skip, Skipping};
use raygrad::nerf::volume::quadrature::Quadrature;
use raygrad::nerf::volume::{RayVars, VisibleSamples};
use raygrad::nerf::{
    Budget, BuildContext, ComponentConfig, Config, Density, Field, FieldConfig, Fields, InstantConfig, Jitter,
    LossTermConfig, Model, Preset, Query, Ray, Rays, Result, SamplerConfig, Samples, SceneBox, Space, Trainer,
    ViewInputs, register,
};
use raygrad::{Bound, Init, Linear, Schedule};
use raygrad::{Scalar, Tape, Tensor, Var};
use raygrad_scenes::embedded;
use serde::{Deserialize, Serialize};
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, LazyLock};
use std::time::Duration;

static DATA: LazyLock<Arc<Dataset>> = LazyLock::new(|| Arc::new(embedded(Split::Train, 20)));

/// A small instant model.
fn instant() -> Config {
    let mut config = Config::preset(Preset::Instant);
    let field = config.field.get_mut::<InstantConfig>().unwrap();
    field.grid = HashGridConfig { levels: 4, features: 2, log2_table: 10, coarsest: 4, finest: 32 };
    (field.density_width, field.color_width) = (16, 16);
    let sampler = config.sampler.get_mut::<MarchingConfig>().unwrap();
    (sampler.step, sampler.view_step, sampler.samples, sampler.occupancy.resolution) = (0.02, 0.01, 4096, 32);
    config
}

/// Takes `steps` steps; returns the first loss and the mean of the last ones.
fn train(trainer: &mut Trainer, steps: u32) -> [f64; 2] {
    let losses: Vec<f64> = (0..steps).map(|i| trainer.step(f64::from(i) / f64::from(steps)).loss).collect();
    let last = &losses[losses.len() - 5..];
    [losses[0], last.iter().sum::<f64>() / 5.0]
}

/// Saves a model, loads it with its serialised configuration and checks that both render the same image, which it
/// returns.
fn comes_back(model: &Model<f32>) -> Vec<f32> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    model.save(&path).unwrap();
    let text = serde_json::to_string(&model.config).unwrap();
    let read: Config = serde_json::from_str(&text).unwrap();
    assert_eq!(read, model.config);
    let extent: SceneBox = serde_json::from_str(&serde_json::to_string(&model.scene_box).unwrap()).unwrap();
    let loaded = Model::load(&path, read, extent).unwrap();
    let camera = &DATA.frames[1].camera;
    let [one, other] = [model, &loaded].map(|model| model.render(camera, [1.0; 3]).color.data);
    assert_eq!(one, other);
    one
}

#[test]
fn proposals_are_trained_rendered_and_stored() {
    let proposal = ProposalConfig { samples: 12, batch: 256, tile: 64, anneal: 20, ..ProposalConfig::default() };
    let mut config = Config { sampler: SamplerConfig::new(proposal), ..instant() };
    config.schedule = Schedule::Constant { lr: 1e-2 };
    let mut trainer = Trainer::new(config, DATA.clone()).unwrap();
    let names: Vec<String> =
        trainer.model.params.names().filter(|name| name.contains("proposal")).map(String::from).collect();
    let before = trainer.model.params.clone();
    let [first, last] = train(&mut trainer, 80);
    assert!(last < 0.5 * first, "{first} to {last}");
    for name in &names {
        let id = before.find(name).unwrap();
        assert!(before.get(id) != trainer.model.params.get(id), "{name} has learned nothing");
    }
    assert!(names.len() == 6 && trainer.stats().density_queries > trainer.stats().color_queries);
    trainer.model.finish();
    // Proposals follow the field: most of the last samples of a ray that hits something are near its weights.
    let model = &trainer.model;
    let picture = comes_back(model);
    assert!(picture.iter().all(|x| x.is_finite()) && picture.iter().any(|&x| x < 0.5));
    let double = model.cast::<f64>().unwrap().render_reference(&DATA.frames[1].camera, [1.0; 3], 1).picture();
    let worst = double.color.data.iter().zip(&picture).map(|(a, b)| (a - b).abs());
    let worst = worst.fold(0.0, raygrad::Real::maximum);
    assert!(worst < 0.02, "what views leave out, and digits: {worst}");
    let tape = Tape::new();
    let params = model.params.bind_constant(&tape);
    let mut rays = Rays::new();
    rays.push_pixel(&DATA.frames[1].camera, [10, 10], model.scene_box.bounds, model.scene_box.near_far);
    let purpose = raygrad::nerf::Purpose::View { finer: 1 };
    let sampled = model.sampler.sample(&Query::new(&*model.field, &params), &rays, purpose, &mut Jitter::Middle);
    let [near, far] = rays.spans[0].map(f64::from);
    let t = sampled.samples.t.as_slice();
    let spread = f64::from(t[t.len() - 2] - t[1]) / (far - near);
    assert!(spread < 0.5 && sampled.histograms.len() == 2, "of the span: {spread}");
}

#[test]
fn unbounded_scene_beyond_the_box_is_trained() {
    let mut data = (**DATA).clone();
    data.bounds = data.bounds.map(|corner| 0.4 * corner);
    let mut config = instant();
    let marching = config.sampler.get_mut::<MarchingConfig>().unwrap();
    marching.occupancy = OccupancyConfig { cascades: 2, ..marching.occupancy };
    let wrong = config.check().unwrap_err().to_string();
    assert!(wrong.starts_with("`occupancy.cascades`: is 2") && wrong.contains("unbounded"), "{wrong}");
    config.unbounded = true;
    config.sampler.get_mut::<MarchingConfig>().unwrap().cone = 1.0 / 256.0;
    let mut trainer = Trainer::new(config, Arc::new(data)).unwrap();
    let [inner, outer] = [trainer.model.scene_box.bounds, trainer.model.reach()];
    assert!((outer[1].x - outer[0].x) > 1.9 * (inner[1].x - inner[0].x));
    let [first, last] = train(&mut trainer, 80);
    assert!(last < 0.5 * first, "{first} to {last}");
    trainer.model.finish();
    comes_back(&trainer.model);
    // Rays that miss the box see something too.
    let camera = &DATA.frames[1].camera;
    let seen = trainer.model.render(camera, [1.0; 3]).opacity;
    let misses = |i: &usize| {
        let ray = camera.pixel_ray(i % camera.width, i / camera.width);
        raygrad::nerf::intersect_box(&ray, inner).is_none()
    };
    let beyond: Vec<f32> = (0..seen.data.len()).filter(misses).map(|i| seen.data[i]).collect();
    assert!(beyond.len() > 50 && beyond.iter().filter(|&&x| x > 0.5).count() > 10, "{}", beyond.len());
}

/// A custom field: one small network on bare coordinates. It counts colour queries with and without image indices.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct BareConfig {
    width: usize,
}

struct Bare {
    space: Space,
    layers: [Linear; 2],
}

static ASKED: [AtomicUsize; 2] = [AtomicUsize::new(0), AtomicUsize::new(0)];

impl ComponentConfig<Fields> for BareConfig {
    const KIND: &'static str = "bare";
    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<Arc<dyn Field<T>>> {
        let BuildContext { space, params, name, rng, .. } = site;
        let mut layer = |part: &str, sizes| {
            let activation = raygrad::Activation::Identity;
            Linear::new(params, &format!("{name}.{part}"), sizes, activation, Init::Glorot, &mut *rng)
        };
        Ok(Arc::new(Bare { space, layers: [layer("in", [3, self.width]), layer("out", [self.width, 4])] }))
    }
}

impl<T: Scalar> Field<T> for Bare {
    fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
        let hidden = (self.layers[0].forward(params, &self.space.centred(positions)) * 3.0).sin();
        let features = self.layers[1].forward(params, &hidden);
        let value = features.slice_axis(1, ..1).reshape(&[positions.shape()[0]]) * 5.0;
        Density { value, log: true, features }
    }
    fn color<'t>(&self, _: &Bound<'t, T>, features: &Var<'t, T>, seen: &ViewInputs<'_, 't, T>) -> Var<'t, T> {
        ASKED[usize::from(seen.frames.is_some())].fetch_add(1, Relaxed);
        if let Some(frames) = seen.frames {
            assert!(frames.len() == seen.segments.len() && frames.iter().all(|&i| (i as usize) < DATA.frames.len()));
        }
        features.slice_axis(1, 1..4).sigmoid()
    }
}

#[test]
fn custom_field_is_trained_rendered_saved_and_loaded() {
    let text = r#"{"kind": "bare", "width": 8}"#;
    let read = || serde_json::from_str::<FieldConfig>(text);
    let config = Config { field: FieldConfig::new(BareConfig { width: 8 }), ..instant() };
    let written = serde_json::to_value(&config).unwrap();
    assert_eq!(written["field"], serde_json::from_str::<serde_json::Value>(text).unwrap());
    let error = serde_json::from_value::<Config>(written).unwrap_err().to_string();
    assert!(error.contains("unknown field `bare`; use classic, instant, voxel; a library user"), "{error}");
    register::<Fields, BareConfig>();
    assert_eq!(read().unwrap(), config.field);
    assert!(read().unwrap() != FieldConfig::new(BareConfig { width: 9 }), "numbers count");
    assert!(config.field != instant().field && read().unwrap().get::<InstantConfig>().is_none());
    for (wrong, what) in [
        (r#"{"kind": "bare", "width": 8, "depth": 2}"#, "field `bare`: unknown field `depth`"),
        (r#"{"width": 8}"#, "a field needs the field `kind` with its name"),
    ] {
        let error = serde_json::from_str::<FieldConfig>(wrong).unwrap_err().to_string();
        assert!(error.contains(what), "{error}");
    }
    let mut trainer = Trainer::new(config, DATA.clone()).unwrap();
    let [first, last] = train(&mut trainer, 60);
    assert!(last < 0.8 * first, "{first} to {last}");
    assert!(ASKED[1].load(Relaxed) > 60 && ASKED[0].load(Relaxed) == 0, "training knows the photographs");
    trainer.model.finish();
    comes_back(&trainer.model);
    assert!(ASKED[0].load(Relaxed) > 0, "views do not");
}

/// An instant model in double precision that is not empty, and rays through it.
fn busy() -> (Model<f64>, Rays<f64>) {
    let extent = SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [0.5, 4.0]);
    let mut model = Model::<f64>::new(instant(), extent, 5).unwrap();
    let ids: Vec<_> = model.params.ids().collect();
    for id in ids {
        let name = model.params.name(id);
        let gain = if name.ends_with("table") { 3000.0 } else { 1.0 + 2.0 * f64::from(name.contains("density")) };
        model.params.get_mut(id).as_mut_slice().iter_mut().for_each(|x| *x *= gain);
    }
    let mut rays = Rays::new();
    for (i, target) in [[0.1, 0.2, 0.0], [-0.4, 0.1, 0.3], [0.3, -0.5, 0.2]].into_iter().enumerate() {
        let origin = DVec3::new(0.3 * i as f64, -1.7, 1.1);
        rays.push(&Ray { origin, direction: (DVec3::from(target) - origin).normalize() }, [0.9, 2.9]);
    }
    (model, rays)
}

#[test]
fn two_passes_equal_one_with_every_quadrature() {
    let (model, rays) = busy();
    let rules = [Quadrature::Left, Quadrature::Midpoint, Quadrature::PiecewiseLinear, Quadrature::Gauss2];
    for rule in rules {
        let tape = Tape::new();
        let params = model.params.bind(&tape);
        let query = Query::new(&*model.field, &params);
        let steps = stratified(&rays, 24, &mut Jitter::Middle, tape.pool());
        let [one, two] = [0.0, 1e-300].map(|least| rule.render(&query, &steps, least));
        assert_eq!(one.visible, two.visible, "{rule}: nothing is left out");
        let color = |seen: &VisibleSamples<'_, f64>| seen.rendered.color.value().as_slice().to_vec();
        assert!(color(&one) == color(&two) && color(&one).iter().any(|&x| x > 0.1), "{rule}: {:?}", color(&one));
        let grads = |seen: &VisibleSamples<'_, f64>| {
            let mixed = seen.rendered.color.square().sum() + seen.rendered.depth().sum() * 0.1;
            mixed.grad(&params.vars())
        };
        for (a, b) in grads(&one).iter().zip(grads(&two)) {
            let worst = a.as_slice().iter().zip(b.as_slice()).map(|(a, b)| (a - b).abs());
            let worst = worst.fold(0.0, raygrad::Real::maximum);
            let largest = a.as_slice().iter().map(|x| x.abs()).fold(0.0, raygrad::Real::maximum);
            assert!(worst <= 1e-12 * largest.max(1e-3), "{rule}: {worst}");
        }
        // And with a limit that drops samples.
        let some = rule.render(&query, &steps, 0.8);
        assert!(some.visible < one.visible, "{rule}");
        for (a, b) in color(&one).into_iter().zip(color(&some)) {
            assert!((a - b).abs() <= 0.8, "{rule}: {a} {b}");
        }
    }
}

#[test]
fn ray_variables_have_gradients_of_differences() {
    let (model, rays) = busy();
    let color = |origins: &Tensor<f64>, directions: &Tensor<f64>, grad: bool| {
        let tape = Tape::new();
        let params = model.params.bind_constant(&tape);
        let vars = RayVars { origins: tape.leaf(origins.clone()), directions: tape.leaf(directions.clone()) };
        let query = Query { rays: Some(&vars), ..Query::new(&*model.field, &params) };
        let steps = stratified(&rays, 24, &mut Jitter::Middle, tape.pool());
        let seen = Quadrature::Midpoint.render(&query, &steps, 1e-12).rendered.color.square().sum();
        let grads = if grad { seen.grad(&[&vars.origins, &vars.directions]) } else { vec![] };
        (seen.item(), grads)
    };
    let rows = |x: &[[f64; 3]]| Tensor::from_vec(&[x.len(), 3], x.as_flattened().to_vec());
    let at = [rows(&rays.origins), rows(&rays.directions)];
    let (_, grads) = color(&at[0], &at[1], true);
    let mut largest = 0.0_f64;
    for which in 0..2 {
        for i in 0..9 {
            let moved = |step: f64| {
                let mut at = at.clone();
                at[which].as_mut_slice()[i] += step;
                color(&at[0], &at[1], false).0
            };
            let (found, expected) = (grads[which].as_slice()[i], (moved(1e-7) - moved(-1e-7)) / 2e-7);
            assert!((found - expected).abs() <= 1e-6 * (1.0 + expected.abs()), "{which} {i}: {found} {expected}");
            largest = largest.max(found.abs());
        }
    }
    assert!(largest > 1e-2, "the colours do depend on the rays: {largest}");
}

#[test]
fn normals_are_unit_vectors_down_the_density() {
    let (model, rays) = busy();
    let tape = Tape::new();
    let params = model.params.bind_constant(&tape);
    let query = Query { position_grad: true, ..Query::new(&*model.field, &params) };
    let steps: Samples<f64> = stratified(&rays, 7, &mut Jitter::Middle, tape.pool());
    let seen = Quadrature::Midpoint.render(&query, &steps, 0.0).rendered;
    let normals = seen.normals();
    let sigma = |position: [f64; 3]| {
        let position = tape.constant(Tensor::from([position]));
        tape.no_grad(|| model.field.density(&params, &position).sigma().item())
    };
    let positions = seen.positions.value().as_slice().chunks_exact(3);
    for (normal, x) in normals.value().as_slice().chunks_exact(3).zip(positions) {
        let slope = DVec3::from_array([0, 1, 2].map(|axis| {
            let moved = |step: f64| {
                let mut x = [x[0], x[1], x[2]];
                x[axis] += step;
                sigma(x)
            };
            (moved(1e-6) - moved(-1e-6)) / 2e-6
        }));
        let normal = DVec3::from_slice(normal);
        assert!((normal.length() - 1.0).abs() < 1e-6, "{normal}");
        assert!(normal.distance(-slope.normalize()) < 1e-4, "{normal} {slope}");
    }
    // They are differentiable.
    let summed = seen.accumulate(&normals).square().sum();
    assert!(summed.grad(&[&seen.positions])[0].is_finite());
}

#[test]
fn densities_are_in_the_unit_of_the_box() {
    let density = |size: f64, preset: Preset| {
        let mut config = Config::preset(preset);
        config.field = if preset == Preset::Instant { instant().field } else { config.field };
        let bounds = [DVec3::splat(-size), DVec3::splat(size)];
        let model = Model::<f64>::new(config, SceneBox::new(bounds, [1.0, 4.0]), 3).unwrap();
        let tape = Tape::new();
        let params = model.params.bind_constant(&tape);
        let positions = tape.constant(Tensor::from([[0.1, -0.3, 0.7]]).map(|x: f64| x * size));
        model.field.density(&params, &positions).sigma().item()
    };
    for preset in [Preset::Instant, Preset::Small] {
        let [one, hundred] = [1.5, 150.0].map(|size| density(size, preset));
        assert!((one / hundred - 100.0).abs() < 1e-6, "{preset}: {one} {hundred}");
    }
    // Files of earlier versions, without the field, use scene units.
    let old = r#"{"bounds": [[-150, -150, -150], [150, 150, 150]], "span": [2, 6]}"#;
    assert_eq!(serde_json::from_str::<SceneBox>(old).unwrap().unit, 1.0);
}

#[test]
fn loss_terms_of_a_file_count_in_training() {
    let bare = instant();
    let mut value = serde_json::to_value(&bare).unwrap();
    value["loss_terms"] =
        serde_json::json!([{"kind": "distortion", "weight": 0.5}, {"kind": "entropy", "weight": 0.25}]);
    let config: Config = serde_json::from_value(value).unwrap();
    let expected =
        [LossTermConfig::new(DistortionConfig { weight: 0.5 }), LossTermConfig::new(EntropyConfig { weight: 0.25 })];
    assert_eq!(config.loss_terms, expected.clone());
    let loss = |config: &Config| Trainer::new(config.clone(), DATA.clone()).unwrap().step(0.0);
    let (plain, more) = (loss(&bare), loss(&config));
    let alone = expected.map(|term| loss(&Config { loss_terms: vec![term], ..bare.clone() }).loss - plain.loss);
    assert!(alone.iter().all(|x| *x > 1e-4) && more.psnr == plain.psnr, "{alone:?}");
    assert!((more.loss - plain.loss - alone[0] - alone[1]).abs() < 1e-5, "each counts: {alone:?} {}", more.loss);
    let mut steep = bare;
    steep.loss_terms = vec![LossTermConfig::new(OrientationConfig { weight: 0.1 })];
    assert!(loss(&steep).loss > plain.loss && steep.check().is_ok());
    steep.loss_terms = vec![LossTermConfig::new(OrientationConfig { weight: -0.1 })];
    assert!(steep.check().unwrap_err().to_string().starts_with("`orientation.weight`"));
    let mut gauss = config;
    gauss.sampler.get_mut::<MarchingConfig>().unwrap().quadrature = Quadrature::Gauss2;
    assert!(gauss.check().unwrap_err().to_string().starts_with("`loss_terms.distortion`"));
}

#[test]
fn time_budget_follows_the_given_clock() {
    let clock = Arc::new(AtomicU64::new(0));
    let tick = clock.clone();
    // Each reading of the clock takes a second.
    let now = move || Duration::from_secs(tick.fetch_add(1, Relaxed));
    let extent = SceneBox::new(DATA.bounds, [DATA.near, DATA.far]);
    let mut trainer = Trainer::with_clock(instant(), DATA.clone(), extent, now).unwrap();
    let mut seen = vec![];
    trainer.run(Budget::Time(Duration::from_secs(11)), |trainer| {
        clock.fetch_add(1000, Relaxed); // an observer that takes time
        seen.push(trainer.stats().train_seconds);
        ControlFlow::Continue(())
    });
    // One second for the preparation of the sampler, and one per step.
    assert_eq!(seen, (2..=11).map(f64::from).collect::<Vec<_>>());
}

#[test]
fn skip_switches_of_earlier_versions_are_read() {
    let read = |text: &str| serde_json::from_str::<OccupancyConfig>(text).unwrap().skip;
    let carving = |text: &str| read(text).carving;
    assert_eq!(carving(r#"{"skip": "fast"}"#), 3);
    assert_eq!(carving(r#"{"skip": "fast", "silhouettes": true}"#), 1);
    assert_eq!(carving(r#"{"skip": "fast", "silhouettes": false}"#), 0);
    assert_eq!(carving(r#"{"skip": "off", "silhouettes": true}"#), 0);
    let fast = Skipping { grid: true, carving: 3, pruning: 0.05, early_stop_eps: 1e-3, colors: 2e-3 };
    let lossless = Skipping { pruning: 0.005, early_stop_eps: 1e-4, colors: 1e-4, ..fast };
    assert_eq!([Skip::Fast, Skip::NearLossless].map(Skipping::from), [fast, lossless]);
    // Renders skip as configured; cells that training skipped stay empty.
    let mut trainer = Trainer::new(instant(), DATA.clone()).unwrap();
    train(&mut trainer, 60);
    let model = &mut trainer.model;
    let camera = &DATA.frames[1].camera;
    let mut count = |skip: Skipping| {
        model.set_skip(skip);
        let marching = model.marching().unwrap();
        assert!(marching.config.occupancy.skip.grid && marching.config.occupancy.skip.carving == 3);
        let seen = model.render(camera, [1.0; 3]).evaluations;
        [seen.density, seen.color]
    };
    let none = Skipping::from(Skip::Off);
    let [all, every] = count(none);
    assert_eq!(all, every, "every sample has a colour");
    let [density, color] = count(Skipping { early_stop_eps: 0.05, ..none });
    assert!(density < all && color == density, "rays end early: {density} of {all}");
    let [density, color] = count(Skipping { colors: 0.05, ..none });
    assert!(density == all && color < all, "some have no colour: {color} of {all}");
    let [density, color] = count(Skipping { pruning: 0.9, ..none });
    assert!(density < all && color == density, "cells that hold little go: {density} of {all}");
}
