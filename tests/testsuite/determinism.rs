//! The same seed gives the same bits, on any number of threads.

use raygrad::nerf::dataset::{Dataset, Split};
use raygrad::nerf::encoding::hash_grid::HashGridConfig;
use raygrad::nerf::sampling::hierarchical::HierarchicalConfig;
use raygrad::nerf::sampling::marching::MarchingConfig;
use raygrad::nerf::{
    ClassicConfig, Config, FieldConfig, InstantConfig, Preset, SamplerConfig, StepStats, Trainer, VoxelConfig,
};
use raygrad_scenes::embedded;
use std::sync::Arc;

/// Small networks, with an odd number of tiles, and an incomplete last tile.
fn config(seed: u64) -> Config {
    let field = ClassicConfig { depth: 2, width: 32, skip_layers: vec![], view_width: 16, ..ClassicConfig::paper() };
    let sampler = HierarchicalConfig {
        proposal: field.clone(),
        coarse: 8,
        fine: 8,
        batch: 99,
        tile: 4,
        ..HierarchicalConfig::default()
    };
    let (field, sampler) = (FieldConfig::new(field), SamplerConfig::new(sampler));
    Config { field, sampler, seed, ..Config::preset(Preset::Small) }
}

/// A marched hash grid with hashed levels.
fn instant(seed: u64) -> Config {
    let mut config = Config { seed, ..Config::preset(Preset::Instant) };
    if let Some(field) = config.field.get_mut::<InstantConfig>() {
        field.grid = HashGridConfig { levels: 3, log2_table: 10, finest: 64, ..field.grid };
    }
    if let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() {
        (sampler.step, sampler.samples) = (0.02, 4096);
        sampler.occupancy.resolution = 32;
    }
    config
}

/// A marched voxel grid with enough rows for several tasks of the optimizer.
fn voxel(seed: u64) -> Config {
    let field = FieldConfig::new(VoxelConfig { resolution: 48, direction_degree: 2 });
    Config { field, sampler: instant(seed).sampler, seed, ..Config::preset(Preset::Voxel) }
}

/// The bits of some steps and of a render.
#[derive(Debug, PartialEq)]
struct Outcome {
    params: Vec<u32>,
    pixels: Vec<u32>,
    losses: Vec<u64>,
}

/// With `None` it runs on a thread outside of rayon, as the command line does.
fn outcome(data: &Arc<Dataset>, config: Config, steps: u32, threads: Option<usize>) -> Outcome {
    let bits = |values: &[f32]| values.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    let run = || {
        let mut trainer = Trainer::new(config, data.clone()).unwrap();
        let done: Vec<StepStats> = (0..steps).map(|step| trainer.step(f64::from(step) / f64::from(steps))).collect();
        trainer.model.finish();
        let view = trainer.model.render(&data.frames[0].camera, [1.0; 3]);
        Outcome {
            params: trainer.model.params.values().iter().flat_map(|x| bits(x.as_slice())).collect(),
            pixels: [view.color, view.depth, view.opacity].iter().flat_map(|image| bits(&image.data)).collect(),
            losses: done.iter().flat_map(|step| [step.loss, step.psnr, step.opacity].map(f64::to_bits)).collect(),
        }
    };
    match threads {
        Some(threads) => rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(run),
        None => run(),
    }
}

#[test]
fn training_has_equal_bits_on_any_threads() {
    let data = Arc::new(embedded(Split::Val, 32));
    // Marched models take more steps, so that their occupancy grids change meanwhile.
    for (name, config, steps) in [("hierarchical", config(7), 5), ("instant", instant(7), 20), ("voxel", voxel(7), 20)]
    {
        let one = outcome(&data, config.clone(), steps, Some(1));
        for threads in [Some(2), Some(4), None] {
            let other = outcome(&data, config.clone(), steps, threads);
            assert!(other.losses == one.losses, "{name}: losses on {threads:?} threads");
            assert!(other.params == one.params, "{name}: parameters on {threads:?} threads");
            assert!(other.pixels == one.pixels, "{name}: a view on {threads:?} threads");
        }
    }
}

#[test]
fn other_seed_gives_other_parameters_and_rays() {
    let data = Arc::new(embedded(Split::Val, 32));
    let [mut one, mut two] = [7, 8].map(|seed| Trainer::new(config(seed), data.clone()).unwrap());
    for ((name, a), b) in one.model.params.iter().zip(two.model.params.values()) {
        assert!(a != b || name.ends_with("bias"), "{name} is the same");
    }
    two.model.params.assign(&one.model.params);
    assert_ne!(one.step(0.1).loss, two.step(0.1).loss, "the same rays");
}

#[test]
fn training_step_updates_every_parameter() {
    // Without it, the test above could pass on a trainer that does nothing.
    let data = Arc::new(embedded(Split::Val, 32));
    let mut trainer = Trainer::new(config(7), data).unwrap();
    let before = trainer.model.params.clone();
    for _ in 0..2 {
        trainer.step(0.1);
    }
    for ((name, before), after) in before.iter().zip(trainer.model.params.values()) {
        assert_ne!(before, after, "{name}");
    }
}
