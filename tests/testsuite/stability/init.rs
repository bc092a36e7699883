//! New fields have gradients to learn from.

use super::support::noise;
use raygrad::nerf::InstantConfig;
use raygrad::nerf::dataset::Split;
use raygrad::nerf::{Config, Field, Model, Preset, SceneBox, Trainer};
use raygrad::{Tape, Tensor};
use raygrad_scenes::embedded;
use std::sync::Arc;

/// The least share, over the fields of a model, of random points whose density has a gradient.
fn alive_share(model: &Model<f32>) -> f64 {
    let points = 256;
    let mut random = noise(1);
    let [low, high] = model.scene_box.bounds.map(|corner| corner.to_array());
    let points = Tensor::from_fn(&[points, 3], |i| (low[i % 3] + random() * (high[i % 3] - low[i % 3])) as f32);
    let share = |field: &dyn Field<f32>| {
        let tape = Tape::new();
        let params = model.params.bind_constant(&tape);
        let positions = tape.leaf(points.clone());
        let sigma = field.density(&params, &positions).sigma();
        assert!(sigma.value().is_finite());
        let slopes = sigma.sum().grad(&[&positions]).remove(0);
        assert!(slopes.is_finite());
        let moved = slopes.as_slice().chunks_exact(3).filter(|slope| slope.iter().any(|x| *x != 0.0)).count();
        moved as f64 / points.shape()[0] as f64
    };
    model.fields().into_iter().map(share).fold(1.0, raygrad::Real::minimum)
}

/// Matrix: of 100 seeds, all have a density gradient at more than 1 % of random points. Catalogue: ReLU density.
#[test]
fn presets_have_gradients_for_100_seeds() {
    let data = embedded(Split::Val, 8);
    let extent = SceneBox::new(data.bounds, [data.near, data.far]);
    for preset in [Preset::Small, Preset::Classic, Preset::Instant] {
        let mut least = 1.0_f64;
        // The paper's network is large: fewer seeds take as long.
        let seeds = if preset == Preset::Classic { 10 } else { 100 };
        let config = match preset {
            Preset::Instant => small_table(Config::preset(preset)),
            _ => Config::preset(preset),
        };
        for seed in 0..seeds {
            least = least.min(alive_share(&Model::new(config.clone(), extent, seed).unwrap()));
        }
        assert!(least > 0.01, "{preset:?}: {least}");
    }
}

/// A table that is quick to initialise.
fn small_table(mut config: Config) -> Config {
    if let Some(field) = config.field.get_mut::<InstantConfig>() {
        (field.grid.log2_table, field.grid.levels) = (10, 4);
    }
    config
}

/// A ReLU density may be dead; the trainer then tries other seeds.
#[test]
fn trainer_starts_with_a_density_gradient() {
    let data = Arc::new(embedded(Split::Val, 8));
    for seed in 0..10 {
        let config = Config { seed, ..Config::preset(Preset::Small) }.with_relu_density();
        let trainer = Trainer::new(config, data.clone()).unwrap();
        assert!(alive_share(&trainer.model) > 0.005, "seed {seed}");
    }
}
