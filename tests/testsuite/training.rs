//! Training options: appearance embeddings, pose refinement, depth, smooth tables, and resuming.

use raygrad::Schedule;
use raygrad::nerf::camera::rotation_matrix;
use raygrad::nerf::dataset::{Dataset, Split};
use raygrad::nerf::encoding::hash_grid::HashGridConfig;
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::losses::{DepthConfig, LossInputs, TotalVariationConfig};
use raygrad::nerf::sampling::marching::MarchingConfig;
use raygrad::nerf::sampling::proposal::ProposalConfig;
use raygrad::nerf::{
    BuildContext, ComponentConfig, Config, FieldConfig, GroupConfig, Image, InstantConfig, LossTerm, LossTermConfig,
    LossTerms, Model, Preset, Result, SamplerConfig, SceneBox, Trainer, VoxelConfig,
};
use raygrad::{Real, Scalar, Var};
use raygrad_scenes::Scene;
use raygrad_scenes::embedded;
use serde::{Deserialize, Serialize};
use std::collections::HashSet;
use std::sync::{Arc, Mutex};

/// A small instant model.
fn instant() -> Config {
    let mut config = Config::preset(Preset::Instant);
    let field = config.field.get_mut::<InstantConfig>().unwrap();
    field.grid = HashGridConfig { levels: 6, features: 2, log2_table: 12, coarsest: 4, finest: 64 };
    (field.density_width, field.color_width) = (16, 16);
    let sampler = config.sampler.get_mut::<MarchingConfig>().unwrap();
    (sampler.step, sampler.view_step, sampler.samples, sampler.occupancy.resolution) = (0.02, 0.01, 4096, 32);
    config
}

/// Square images of the embedded scene.
fn photographs(count: usize, size: usize) -> Dataset {
    let mut data = embedded(Split::Train, size);
    data.frames.truncate(count);
    data
}

/// Takes `steps` steps; returns the mean of the last losses.
fn train(trainer: &mut Trainer, steps: u32) -> f64 {
    let losses: Vec<f64> = (0..steps).map(|i| trainer.step(f64::from(i) / f64::from(steps)).loss).collect();
    let last = &losses[losses.len().saturating_sub(10)..];
    last.iter().sum::<f64>() / last.len() as f64
}

#[test]
fn training_resumes_from_its_state_bit_for_bit() {
    let data = Arc::new(photographs(12, 20));
    let mut everything = instant();
    everything.field.get_mut::<InstantConfig>().unwrap().appearance_embedding_dim = 3;
    everything.poses = Some(Schedule::Constant { lr: 1e-3 });
    let smooth = TotalVariationConfig { weight: 0.1, params: "field.density.0.weight".into(), cells: None, draws: 2 };
    everything.loss_terms = vec![LossTermConfig::new(smooth)];
    let proposal = ProposalConfig { samples: 8, batch: 128, tile: 32, anneal: 30, ..ProposalConfig::default() };
    let proposals = Config { sampler: SamplerConfig::new(proposal), ..instant() };
    for (i, config) in [everything, proposals].into_iter().enumerate() {
        let new = || Trainer::new(config.clone(), data.clone()).unwrap();
        let mut trainer = new();
        trainer.model.params.freeze(|name| name.starts_with("field.color.0"));
        trainer.model.params.set_lr_scale(|name| name.starts_with("field.color.1"), 0.5);
        trainer.model.params.set_weight_decay_scale(|name| name.starts_with("field.color.1"), 0.25);
        let go_on = |trainer: &mut Trainer, steps: std::ops::Range<u32>| -> Vec<u64> {
            steps.map(|i| trainer.step(f64::from(i) / 60.0).loss.to_bits()).collect()
        };
        trainer.model.params.set_lazy(|name| name == "field.codes", false);
        // One beyond the steps that update all cells of the grid, and far within those.
        let before = [261, 21][i];
        go_on(&mut trainer, 0..before);
        let state = trainer.state().unwrap();
        let mut later = new();
        later.model.params.freeze(|name| name.starts_with("field.density"));
        go_on(&mut later, 0..5);
        later.load_state(&state).unwrap();
        let sampler = &later.model.sampler;
        let grows = sampler.training_state() != sampler.state();
        assert_eq!(grows, sampler.grid().is_some(), "what a run needs beyond a model is the grid's densities");
        let (now, then) = (trainer.stats(), later.stats());
        assert_eq!(
            (now.step, now.rays, now.density_queries, now.moved),
            (then.step, then.rays, then.density_queries, then.moved)
        );
        assert_eq!((now.train_seconds, now.loss), (then.train_seconds, then.loss));
        assert_eq!(trainer.state().unwrap(), later.state().unwrap(), "what is written down is all there is");
        let more = before..before + 40;
        assert_eq!(go_on(&mut trainer, more.clone()), go_on(&mut later, more), "configuration {i}");
        assert_eq!(later.stats().lr, later.model.config.schedule.lr(f64::from(before + 39) / 60.0));
        assert_eq!(trainer.model.params.values(), later.model.params.values());
        let find = |part: &str| later.model.params.find(&format!("field.color.{part}.weight")).unwrap();
        let color = find("1");
        assert_eq!([later.model.params.lr_scale(color), later.model.params.weight_decay_scale(color)], [0.5, 0.25]);
        assert!(later.model.params.is_frozen(find("0")) && !later.model.params.is_frozen(color));
        trainer.model.finish();
        later.model.finish();
        let [one, other] =
            [&trainer, &later].map(|trainer| trainer.model.render(&data.frames[0].camera, [1.0; 3]).color);
        assert_eq!(one, other);
    }
}

#[test]
fn foreign_state_is_an_error_and_changes_nothing() {
    let data = Arc::new(photographs(6, 16));
    let new = |config: Config| Trainer::new(config, data.clone()).unwrap();
    let mut trainer = new(instant());
    train(&mut trainer, 3);
    let before = trainer.state().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    trainer.model.save(&path).unwrap();
    let mut other = instant();
    other.field.get_mut::<InstantConfig>().unwrap().color_width = 8;
    let mut grouped = instant();
    grouped.groups = vec![GroupConfig {
        params: "field.color".into(),
        adam: grouped.adam,
        schedule: grouped.schedule,
        weight_decay: 0.0,
    }];
    let cases = [
        (b"no state".to_vec(), "safetensors"),
        (before[..before.len() - 9].to_vec(), "safetensors"),
        (std::fs::read(path).unwrap(), "holds a model"),
        (new(other).state().unwrap(), "field.color"),
        (new(grouped).state().unwrap(), "another configuration"),
        (new(Config { seed: 1, ..instant() }).state().unwrap(), "another configuration"),
        (
            Trainer::new(instant(), Arc::new(photographs(7, 16))).unwrap().state().unwrap(),
            "another configuration or to other images",
        ),
    ];
    for (bytes, expected) in cases {
        let error = trainer.load_state(&bytes).unwrap_err().to_string();
        assert!(error.contains(expected) && !error.contains('\n'), "{error}");
        assert!(trainer.state().unwrap() == before, "after {expected}");
    }
}

#[test]
fn embeddings_absorb_differences_of_images() {
    let mut data = photographs(24, 20);
    // Each camera has two images; the first is darker.
    for i in (0..24).step_by(2) {
        data.frames[i] = data.frames[i + 1].clone();
    }
    for frame in data.frames.iter_mut().step_by(2) {
        let mut image = frame.image.to_image();
        image.data.chunks_exact_mut(4).for_each(|pixel| pixel[..3].iter_mut().for_each(|x| *x *= 0.5));
        frame.image = image.into();
    }
    let data = Arc::new(data);
    let mut with = instant();
    with.field.get_mut::<InstantConfig>().unwrap().appearance_embedding_dim = 4;
    let mut trainers = [instant(), with.clone()].map(|config| Trainer::new(config, data.clone()).unwrap());
    let [bare, coded] = trainers.each_mut().map(|trainer| train(trainer, 250));
    assert!(coded < 0.5 * bare, "{coded} with codes, {bare} without");
    let model = &mut trainers[1].model;
    let codes = model.params.get(model.params.find("field.codes").unwrap());
    assert_eq!(codes.shape(), [24, 4]);
    model.finish();
    // New views have the mean brightness of both kinds.
    let camera = &data.frames[3].camera;
    let mean = |model: &Model<f32>| {
        let seen = model.render(camera, [0.0; 3]);
        f64::from(seen.color.data.iter().sum::<f32>()) / f64::from(seen.opacity.data.iter().sum::<f32>()) / 3.0
    };
    let with_code = |model: &Model<f32>, number: u32| {
        let mut own = model.clone();
        own.appearance_image = Some(number);
        let [view, dense] = [own.render(camera, [0.0; 3]), own.render_reference(camera, [0.0; 3], 1).picture()];
        let apart = view.color.data.iter().zip(&dense.color.data).map(|(a, b)| (a - b).abs());
        assert!(apart.fold(0.0, Real::maximum) < 0.01, "views and references have the same look");
        mean(&own)
    };
    let [dark, bright, usual] = [with_code(model, 2), with_code(model, 3), mean(model)];
    assert!(bright > 1.5 * dark && usual > 1.1 * dark && usual < bright / 1.1, "{dark} {usual} {bright}");
    // The number of images is stored with the model.
    let extent: SceneBox = serde_json::from_str(&serde_json::to_string(&model.scene_box).unwrap()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    model.save(&path).unwrap();
    let read = Model::load(&path, with.clone(), extent).unwrap();
    assert_eq!(mean(&read), usual);
    let error = Model::<f32>::new(with, SceneBox { frames: 0, ..extent }, 0).err().unwrap().to_string();
    assert!(error.starts_with("`appearance_embedding_dim`"), "{error}");
}

#[test]
fn pose_refinement_finds_known_offsets() {
    let right = photographs(24, 32);
    let config = Config { poses: Some(Schedule::Exponential { from: 4e-3, to: 4e-4, warmup: 0.0 }), ..instant() };
    let mut known = Trainer::new(config.clone(), Arc::new(right.clone())).unwrap();
    known.model.params.freeze(|name| name == "poses");
    train(&mut known, 300);
    // One or two degrees, and a few hundredths of the scene's size.
    let mut wrong = right.clone();
    for (i, frame) in wrong.frames.iter_mut().enumerate() {
        let [a, b, c] = [1.0, 2.0, 3.0].map(|k| (k * (i as f64 + 1.0)).sin());
        let turn = rotation_matrix(DVec3::new(0.02 * a, -0.03 * b, 0.02 * c));
        frame.camera.pose.matrix3 = turn * frame.camera.pose.matrix3;
        frame.camera.pose.translation += 0.04 * DVec3::new(b, c, a);
    }
    let mut trainer = Trainer::new(config, Arc::new(wrong.clone())).unwrap();
    trainer.model.params.assign(&known.model.params);
    trainer.model.sampler = known.model.sampler.boxed();
    trainer.model.params.freeze(|_| true);
    trainer.model.params.unfreeze(|name| name == "poses");
    let errors = |trainer: &Trainer| -> [f64; 2] {
        let pairs = wrong.frames.iter().zip(&right.frames).enumerate();
        let each: Vec<[f64; 2]> = pairs
            .map(|(i, (wrong, right))| {
                let [found, right] = [trainer.model.learned_camera(i, &wrong.camera).pose, right.camera.pose];
                let turn = (found.matrix3.transpose() * right.matrix3).col(2).angle_between(DVec3::Z);
                // At scene points, since images cannot separate the common effect of a rotation and a sideways step.
                let places = (0..8).map(|i| 0.5 * DVec3::from([0, 1, 2].map(|k| f64::from(i >> k & 1) * 2.0 - 1.0)));
                let apart = places.map(|place| {
                    let [a, b] = [found, right].map(|pose| pose.matrix3.transpose() * (place - pose.translation));
                    a.angle_between(b)
                });
                [turn, apart.sum::<f64>() / 8.0]
            })
            .collect();
        [0, 1].map(|k| each.iter().map(|error| error[k]).sum::<f64>() / each.len() as f64)
    };
    let before = errors(&trainer);
    let first = trainer.step(0.0).loss;
    let last = train(&mut trainer, 300);
    let after = errors(&trainer);
    println!("poses: {before:?} to {after:?}, loss {first} to {last}");
    assert!(last < 0.5 * first, "{first} {last}");
    assert!(after[0] < 0.6 * before[0] && after[1] < 0.3 * before[1], "{before:?} {after:?}");
    // With pose refinement nothing is carved: the given poses may be wrong.
    assert_eq!(Trainer::new(known.model.config.clone(), Arc::new(wrong.clone())).unwrap().stats().occupied, 1.0);
    let error = Model::<f32>::new(trainer.model.config.clone(), SceneBox { frames: 0, ..trainer.model.scene_box }, 0);
    assert!(error.err().unwrap().to_string().starts_with("`poses`"));
    let mut bad = trainer.model.config.clone();
    bad.poses = Some(Schedule::Constant { lr: -1.0 });
    assert!(bad.check().unwrap_err().to_string().starts_with("`poses.constant.lr`"));
}

#[test]
fn scene_and_poses_are_learned_together() {
    let mut wrong = photographs(40, 32);
    for (i, frame) in wrong.frames.iter_mut().enumerate() {
        let [a, b, c] = [1.0, 2.0, 3.0].map(|k| (k * (i as f64 + 1.0)).sin());
        let turn = rotation_matrix(DVec3::new(0.03 * a, -0.03 * b, 0.03 * c));
        frame.camera.pose.matrix3 = turn * frame.camera.pose.matrix3;
    }
    let proposal = ProposalConfig { samples: 16, batch: 256, tile: 64, anneal: 50, ..ProposalConfig::default() };
    for sampler in [instant().sampler, SamplerConfig::new(proposal)] {
        let data = Arc::new(wrong.clone());
        let loss = |poses| {
            let mut config = Config { poses, sampler: sampler.clone(), ..instant() };
            // Pose refinement does not carve, so the comparison does not either.
            if let Some(marching) = config.sampler.get_mut::<MarchingConfig>() {
                marching.occupancy.skip.carving = 0;
            }
            train(&mut Trainer::new(config, data.clone()).unwrap(), 200)
        };
        let fixed = loss(None);
        let learned = loss(Some(Schedule::Exponential { from: 3e-3, to: 3e-5, warmup: 0.1 }));
        println!("{}: loss {fixed} with fixed poses, {learned} with learned ones", sampler.kind());
        assert!(learned < 0.7 * fixed, "{}: {learned} {fixed}", sampler.kind());
    }
}

#[test]
fn depth_loss_finds_measured_surfaces() {
    let scene = Scene::bulldozer();
    let mut data = photographs(60, 24);
    let test = data.frames.split_off(57);
    data.frames.truncate(3);
    let with = |config: &Config, data: &Dataset| {
        let mut trainer = Trainer::new(config.clone(), Arc::new(data.clone())).unwrap();
        train(&mut trainer, 250);
        trainer.model.finish();
        let (mut error, mut count) = (0.0, 0);
        for frame in &test {
            let truth = scene.render(&frame.camera, 1).depth;
            let found = trainer.model.render(&frame.camera, [1.0; 3]).depth;
            for (&truth, &found) in truth.data.iter().zip(&found.data).filter(|(truth, _)| **truth > 0.0) {
                error += f64::from(if found > 0.0 { (truth - found).abs() } else { 1.0 });
                count += 1;
            }
        }
        error / f64::from(count)
    };
    let bare = with(&instant(), &data);
    let depth = Config { loss_terms: vec![LossTermConfig::new(DepthConfig { weight: 1.0 })], ..instant() };
    let error = Trainer::new(depth.clone(), Arc::new(data.clone())).err().unwrap().to_string();
    assert!(error.starts_with("`loss_terms`") && error.contains("Frame::distances"), "{error}");
    for frame in &mut data.frames {
        frame.distances = Some(scene.render(&frame.camera, 1).depth);
    }
    let measured = with(&depth, &data);
    println!("distances of three photographs: {bare} without, {measured} with");
    assert!(measured < 0.7 * bare, "{measured} {bare}");
    for (width, height, channels) in [(24, 23, 1), (23, 24, 1), (24, 24, 3)] {
        data.frames[1].distances = Some(Image::new(width, height, channels));
        let error = Trainer::new(depth.clone(), Arc::new(data.clone())).err().unwrap().to_string();
        assert!(
            error.starts_with("`train/1`") && error.contains(&format!("[{width}, {height}, {channels}]")),
            "{error}"
        );
    }
    for bad in [f32::INFINITY, -1.0, f32::NAN] {
        let mut image = Image::new(24, 24, 1);
        image.data[77] = bad;
        data.frames[1].distances = Some(image);
        let error = Trainer::new(depth.clone(), Arc::new(data.clone())).err().unwrap().to_string();
        assert!(error.starts_with("`train/1`") && error.contains(&format!("the distance {bad}")), "{error}");
    }
}

/// A loss term of 0 that records its seeds.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SpyConfig {
    number: usize,
}

static SEEDS: Mutex<Vec<(usize, u64)>> = Mutex::new(vec![]);

impl ComponentConfig<LossTerms> for SpyConfig {
    const KIND: &'static str = "spy";
    fn build<T: Scalar>(&self, _: BuildContext<'_, T>) -> Result<Arc<dyn LossTerm<T>>> {
        Ok(Arc::new(self.clone()))
    }
}

impl<T: Scalar> LossTerm<T> for SpyConfig {
    fn loss<'t>(&self, seen: &LossInputs<'_, 't, T>) -> Var<'t, T> {
        SEEDS.lock().unwrap().push((self.number, seen.seed));
        assert_eq!([seen.frames.len(), seen.pixels.len(), seen.distances.len()], [seen.rays.len(); 3]);
        seen.rendered.color.sum() * 0.0
    }
}

#[test]
fn loss_terms_get_a_new_seed_per_tile_and_step() {
    let terms = [0, 1].map(|number| LossTermConfig::new(SpyConfig { number })).to_vec();
    let mut trainer = Trainer::new(Config { loss_terms: terms, ..instant() }, Arc::new(photographs(6, 16))).unwrap();
    train(&mut trainer, 3);
    let seeds = SEEDS.lock().unwrap().clone();
    let different: HashSet<u64> = seeds.iter().map(|(_, seed)| *seed).collect();
    assert_eq!((seeds.len(), different.len()), (3 * 8 * 2, 3 * 8 * 2));
    assert_eq!(seeds.iter().filter(|(number, _)| *number == 1).count(), 24);
}

#[test]
fn total_variation_smooths_the_table() {
    let data = Arc::new(photographs(12, 20));
    let mut config = Config::preset(Preset::Voxel);
    config.field = FieldConfig::new(VoxelConfig { resolution: 16, direction_degree: 1 });
    config.sampler = instant().sampler;
    let smooth = |weight| {
        let cells = Some(vec![17; 3]);
        LossTermConfig::new(TotalVariationConfig { weight, params: "field.table".into(), cells, draws: 8 })
    };
    let variation = |config: &Config| {
        let mut trainer = Trainer::new(config.clone(), data.clone()).unwrap();
        let loss = train(&mut trainer, 150);
        assert!(loss.is_finite() && trainer.stats().non_finite == 0);
        let table = trainer.model.params.values()[0].as_slice().chunks_exact(4).collect::<Vec<_>>();
        let squares = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from((a - b) * (a - b))).sum::<f64>();
        (0..table.len() - 1).filter(|i| i % 17 != 16).map(|i| squares(table[i], table[i + 1])).sum::<f64>()
    };
    let bare = variation(&config);
    config.loss_terms = vec![smooth(0.01)];
    let smoothed = variation(&config);
    println!("variation of the table: {bare} without the term, {smoothed} with it");
    assert!(smoothed < 0.5 * bare, "{smoothed} {bare}");
    let read: Config = serde_json::from_str(&serde_json::to_string(&config).unwrap()).unwrap();
    assert_eq!(read, config);
}

#[test]
fn gradient_scaling_damps_samples_near_cameras() {
    let mut data = photographs(12, 24);
    // The unit of the box is 2, and the nearest samples are 2 away.
    data.bounds = [DVec3::splat(-3.0), DVec3::splat(3.0)];
    let data = Arc::new(data);
    let moved = |gradient_scaling_distance: f64| {
        let config = Config { gradient_scaling_distance, ..instant() };
        let mut trainer = Trainer::new(config, data.clone()).unwrap();
        let grid = trainer.model.params.find("field.table").unwrap();
        let before = trainer.model.params.get(grid).clone();
        let first = trainer.step(0.3).loss;
        // Adam's first step has the size of its learning rate for any gradient, so the second step shows the
        // difference.
        let second = trainer.step(0.3).loss;
        let after = trainer.model.params.get(grid);
        let far = before.as_slice().iter().zip(after.as_slice()).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>();
        (first, second, far)
    };
    let (usual, none, all) = (moved(0.0), moved(0.9), moved(1e6));
    assert_ne!(usual, moved(1.3), "some are");
    assert_eq!(usual, none, "no sample is as near as that");
    assert_eq!(usual.0, all.0, "values stay");
    assert!(usual.2 > 0.0 && all.2.is_finite() && usual.2 != all.2, "{usual:?} {all:?}");
    let bad = Config { gradient_scaling_distance: -1.0, ..instant() };
    assert!(bad.check().unwrap_err().to_string().starts_with("`gradient_scaling_distance`"));
}
