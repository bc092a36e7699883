//! Dead networks: a ReLU density may be 0 everywhere from the first step or soon after, and such a network never
//! learns.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use raygrad::nerf::dataset::{Dataset, Split};
use raygrad::nerf::sampling::hierarchical::HierarchicalConfig;
use raygrad::nerf::{ClassicConfig, Config, Field, FieldConfig, Model, Preset, SamplerConfig, SceneBox, Trainer};
use raygrad::{Tape, Tensor};
use raygrad_scenes::embedded;
use std::sync::Arc;

/// Networks as deep as the paper's, and so narrow that many seeds are dead.
fn narrow(seed: u64) -> Config {
    let field = ClassicConfig { width: 4, view_width: 4, position_levels: 2, ..ClassicConfig::paper() };
    let sampler = HierarchicalConfig {
        proposal: field.clone(),
        coarse: 4,
        fine: 4,
        batch: 16,
        tile: 16,
        ..HierarchicalConfig::default()
    };
    let (field, sampler) = (FieldConfig::new(field), SamplerConfig::new(sampler));
    Config { field, sampler, seed, ..Config::preset(Preset::Small) }.with_relu_density()
}

fn data() -> Arc<Dataset> {
    Arc::new(embedded(Split::Val, 8))
}

/// The least share, over both fields, of random points in the box with density.
fn density_share(model: &Model<f32>) -> f64 {
    let mut rng = StdRng::seed_from_u64(1);
    let [low, high] = model.scene_box.bounds.map(|corner| corner.to_array());
    let points = Tensor::from_fn(&[400, 3], |i| rng.random_range(low[i % 3] as f32..high[i % 3] as f32));
    let share = |field: &dyn Field<f32>| {
        let tape = Tape::new();
        let params = model.params.bind_constant(&tape);
        let density = field.density(&params, &tape.constant(points.clone())).sigma();
        density.value().as_slice().iter().filter(|&&sigma| sigma > 0.0).count() as f64 / 400.0
    };
    model.fields().into_iter().map(share).fold(1.0, raygrad::Real::minimum)
}

#[test]
fn none_of_100_seeds_starts_dead() {
    let data = data();
    let extent = SceneBox::new(data.bounds, [data.near, data.far]);
    let (mut dead, mut passed_over) = (0, 0);
    for seed in 0..100 {
        let bare = density_share(&Model::new(narrow(seed), extent, seed).unwrap());
        dead += usize::from(bare < 0.005);
        let trainer = Trainer::new(narrow(seed), data.clone()).unwrap();
        let share = density_share(&trainer.model);
        assert!(share > 0.005, "seed {seed}: density at {share} of the points");
        passed_over += usize::from(trainer.stats().restarts > 0);
    }
    println!("{dead} dead seeds, {passed_over} passed over");
    assert!(dead >= 10, "only {dead} of these networks start dead: the test shows nothing");
    assert!(passed_over >= dead);
}

/// Removes all density, as a few unlucky steps can.
fn collapse(trainer: &mut Trainer) {
    let biases: Vec<_> = trainer.model.params.iter().map(|(name, _)| name.ends_with("density.bias")).collect();
    for (value, _) in trainer.model.params.values_mut().iter_mut().zip(biases).filter(|(_, is_bias)| *is_bias) {
        value.as_mut_slice().fill(-1e3);
    }
    assert_eq!(density_share(&trainer.model), 0.0);
}

/// The number of restarts within some steps.
fn restarts_within(trainer: &mut Trainer, steps: u32) -> u32 {
    let before = trainer.stats().restarts;
    for _ in 0..steps {
        trainer.step(0.1);
    }
    trainer.stats().restarts - before
}

#[test]
fn collapsed_run_restarts_with_another_seed() {
    let data = data();
    // Seeds accepted at once, and seeds after rejected ones, which do not count as collapses.
    let mut passed_over = 0;
    for seed in 0..25 {
        let mut trainer = Trainer::new(narrow(seed), data.clone()).unwrap();
        passed_over = passed_over.max(trainer.stats().restarts);
        collapse(&mut trainer);
        assert_eq!(restarts_within(&mut trainer, 99), 0, "seed {seed}: too early to judge");
        assert_eq!(restarts_within(&mut trainer, 1), 1, "seed {seed}");
        assert!(density_share(&trainer.model) > 0.005, "seed {seed}");
        assert_eq!(restarts_within(&mut trainer, 5), 0, "seed {seed}: the new model is judged after steps of its own");
    }
    assert!(passed_over >= 3, "no seed was passed over often");
}

#[test]
fn empty_scene_stops_restarting() {
    let mut trainer = Trainer::new(narrow(0), data()).unwrap();
    let restarts = [(); 5].map(|()| {
        collapse(&mut trainer);
        restarts_within(&mut trainer, 100)
    });
    assert_eq!(restarts, [1, 1, 1, 0, 0]);
}

#[test]
fn learning_run_does_not_restart() {
    let mut config = Config::preset(Preset::Small);
    if let Some(sampler) = config.sampler.get_mut::<HierarchicalConfig>() {
        sampler.batch = 32;
    }
    let mut trainer = Trainer::new(config, data()).unwrap();
    assert_eq!(restarts_within(&mut trainer, 110), 0);
    assert!(trainer.stats().opacity > 0.05);
}
