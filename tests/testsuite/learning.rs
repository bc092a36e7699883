//! End to end: trains on images and cameras, and evaluates held-out views.

use raygrad::nerf::dataset::{Dataset, Split, evenly_spaced, load};
use raygrad::nerf::encoding::hash_grid::HashGridConfig;
use raygrad::nerf::imaging::metrics;
use raygrad::nerf::sampling::hierarchical::HierarchicalConfig;
use raygrad::nerf::sampling::marching::MarchingConfig;
use raygrad::nerf::space::occupancy::Skip;
use raygrad::nerf::{
    Budget, ClassicConfig, Config, FieldConfig, Image, InstantConfig, Loss, Preset, SamplerConfig, Trainer, VoxelConfig,
};
use raygrad_scenes::embedded;
use raygrad_test_support::skip::skipped;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

/// Networks that learn the rough shape of a scene in seconds.
fn config() -> Config {
    let paper = ClassicConfig::paper();
    let fine = ClassicConfig { depth: 3, width: 48, skip_layers: vec![], view_width: 24, position_levels: 5, ..paper };
    let coarse = ClassicConfig { depth: 2, width: 24, position_levels: 4, ..fine.clone() };
    let sampler = HierarchicalConfig {
        proposal: coarse,
        coarse: 24,
        fine: 16,
        batch: 256,
        tile: 16,
        ..HierarchicalConfig::default()
    };
    let (field, sampler) = (FieldConfig::new(fine), SamplerConfig::new(sampler));
    Config { field, sampler, ..Config::preset(Preset::Small) }
}

/// A small marched hash grid with few samples.
fn instant() -> Config {
    let mut config = Config::preset(Preset::Instant);
    if let Some(field) = config.field.get_mut::<InstantConfig>() {
        field.grid = HashGridConfig { levels: 4, log2_table: 14, finest: 128, ..field.grid };
    }
    if let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() {
        sampler.samples = 1 << 13;
        sampler.step = 1.0 / 100.0;
        sampler.occupancy.resolution = 32;
    }
    config
}

/// A coarse marched voxel grid with few samples.
fn voxel() -> Config {
    let field = FieldConfig::new(VoxelConfig { resolution: 32, direction_degree: 2 });
    Config { field, sampler: instant().sampler, ..Config::preset(Preset::Voxel) }
}

/// The mean PSNR, in dB, of held-out views after `steps` on `train`, and that of blank images.
fn learn(config: Config, steps: u64, train: Dataset, test: &Dataset) -> [f64; 2] {
    let white = [1.0; 3];
    let mut trainer = Trainer::new(config, Arc::new(train)).unwrap();
    trainer.run(Budget::Steps(steps), |_| ControlFlow::Continue(()));
    assert_eq!(trainer.stats().non_finite, 0, "no gradient was infinite or NaN");
    let mut sums = [0.0; 2];
    for frame in &test.frames {
        let truth = frame.image.over(white);
        let learnt = trainer.model.render(&frame.camera, white).color;
        let blank = Image { data: vec![1.0; truth.data.len()], ..truth.clone() };
        sums[0] += metrics::psnr(&learnt, &truth);
        sums[1] += metrics::psnr(&blank, &truth);
    }
    sums.map(|sum| sum / test.frames.len() as f64)
}

#[test]
fn embedded_scene_is_learned_in_seconds() {
    // Any field works with any sampler.
    let mut marched = config().with_skip(Skip::Fast);
    let sampler = marched.sampler.get_mut::<MarchingConfig>().unwrap();
    (sampler.step, sampler.occupancy.resolution) = (0.02, 32);
    let huber = Config { loss: Loss::Huber { delta: 0.1 }, ..instant() };
    let configs = [
        ("hierarchical", 100, config()),
        ("marched", 100, marched),
        ("instant", 50, instant()),
        ("huber", 50, huber),
        ("voxel", 50, voxel()),
    ];
    let [train, mut test] = [Split::Train, Split::Test].map(|split| embedded(split, 40));
    test.frames = evenly_spaced(test.frames, 4);
    for (name, steps, config) in configs {
        let [learnt, blank] = learn(config, steps, train.clone(), &test);
        println!("{name}: {learnt:.2} dB against {blank:.2} dB of blank pictures");
        assert!(learnt > 18.0 && learnt > blank + 8.0, "{name}: {learnt:.2} dB against {blank:.2} dB");
    }
}

#[test]
fn lego_is_learned_in_seconds() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/lego");
    if !folder.is_dir() {
        skipped(&format!("there is no folder {}", folder.display()));
        return;
    }
    let [train, mut test] = [Split::Train, Split::Test].map(|split| load(&folder, split, 10).unwrap());
    test.frames.truncate(20);
    let [learnt, blank] = learn(config(), 200, train, &test);
    println!("{learnt:.2} dB against {blank:.2} dB of blank pictures");
    assert!(learnt > 14.0 && learnt > blank + 5.0, "{learnt:.2} dB against {blank:.2} dB");
}
