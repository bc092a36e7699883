//! Steps, restarts and the ends of runs.

mod across;

use super::*;
use crate::dataset::{
    Background, Split,
    sample::{ball, ball_ahead},
};
use crate::encoding::hash_grid::HashGridConfig;
use crate::field::{ClassicConfig, InstantConfig};
use crate::losses::Loss;
use crate::model::{PoseMotion, RefinedParam};
use crate::sampling::SamplerConfig;
use crate::sampling::hierarchical::HierarchicalConfig;
use crate::sampling::marching::MarchingConfig;
use crate::space::occupancy::Threshold;
use crate::training::stats::STUCK;
use crate::{FieldConfig, Preset};
use glam::DVec3;
use raygrad_autograd::Tensor;
use raygrad_nn::Schedule;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

#[test]
fn cameras_without_view_of_the_box_are_an_error() {
    let mut data = ball(Split::Train, 8);
    data.frames.truncate(3);
    for frame in &mut data.frames {
        frame.camera.pose.translation *= 3.0;
    }
    let message = Trainer::new(tiny(), Arc::new(data.clone())).err().unwrap().to_string();
    let expected = "no ray of the 3 images meets the box";
    assert!(message.contains(expected) && message.contains("on average: scale and move"), "{message}");
    // One camera that sees a part is enough.
    data.frames[2].camera.pose.translation /= 3.0;
    Trainer::new(tiny(), Arc::new(data.clone())).unwrap();
    // Near enough, but looking away.
    data.frames.drain(..2);
    data.frames[0].camera.pose.matrix3 = -data.frames[0].camera.pose.matrix3;
    let message = data.check_reach(data.bounds).unwrap_err().to_string();
    assert!(message.contains("most cameras look away from it: for matrices with OpenCV's axes, negate"), "{message}");
}

#[test]
fn forward_facing_fields_use_ndc() {
    let data = ball_ahead(8);
    let ndc = data.ndc.unwrap();
    assert!(data.frames.iter().all(|frame| ndc.pixels(&frame.camera, DVec3::ZERO) < 20.0));
    assert!((data.pixels_per_side() - ndc.pixels(&data.frames[2].camera, DVec3::ZERO)).abs() < 2.0);
    let config = tiny_table().with_scene_type(data.scene_type);
    let trainer = Trainer::new(config.clone(), Arc::new(data.clone())).unwrap();
    assert_eq!(trainer.model.scene_box.ndc, Some(ndc));
    // In front of the near plane, all points of a ray from the eye are equal; without NDC they differ.
    let places = [0.5, 0.9, 1.5].map(|depth| ndc.eye - depth * ndc.near * ndc.axes.z_axis);
    let places = places.map(|place| place.as_vec3().to_array());
    let densities = |trainer: &Trainer| {
        let mut densities = [0.0; 3];
        trainer.model.densities(&places, &mut densities);
        densities
    };
    let [a, b, c] = densities(&trainer);
    assert!((a - b).abs() < 1e-7 && (a - c).abs() > 1e-6, "{a} {b} {c}");
    let unbounded = Dataset { scene_type: SceneType::Unbounded, ..data.clone() };
    assert!(unbounded.pixels_per_side() != data.pixels_per_side());
    let other = Trainer::new(config.clone(), Arc::new(unbounded)).unwrap();
    assert_eq!(other.model.scene_box.ndc, None);
    let [a, b, _] = densities(&other);
    assert!((a - b).abs() > 1e-6, "{a} {b}");
    let refused = |config: &Config, data: &Dataset| {
        Trainer::new(config.clone(), Arc::new(data.clone())).err().unwrap().to_string()
    };
    assert!(refused(&tiny_table(), &data).contains("`unbounded`"));
    assert!(refused(&config, &Dataset { ndc: None, ..data.clone() }).contains("Ndc::around"));
    // The state resumes NDC scenes too.
    let mut trainer = trainer;
    trainer.step(0.0);
    let state = trainer.state().unwrap();
    let mut later = Trainer::new(config, Arc::new(data)).unwrap();
    later.load_state(&state).unwrap();
    assert_eq!(later.step(0.5).loss, trainer.step(0.5).loss);
    assert_eq!(trainer.model.cast::<f64>().unwrap().scene_box.ndc, Some(ndc));
}

#[test]
fn step_stats_add_up_and_name_the_failing_step() {
    let mut data = ball(Split::Train, 8);
    data.frames.truncate(3);
    let config = Config { background: Background::White, ..tiny_table() };
    let mut trainer = Trainer::new(config, Arc::new(data)).unwrap();
    let counts = |trainer: &mut Trainer| {
        trainer.step(0.0);
        let StepStats {
            rays,
            placed_samples: marched,
            density_queries: samples,
            color_queries: shaded,
            unskipped,
            moved,
            loss,
            psnr,
            ..
        } = trainer.stats();
        assert!((psnr - psnr_from_mse(loss)).abs() < 1e-9 && psnr > 1.0, "{psnr} {loss}");
        [rays, marched, samples, shaded, unskipped, moved]
    };
    let [first, second, third] = [(); 3].map(|()| counts(&mut trainer));
    for i in 0..6 {
        // Steps have similar counts.
        let [a, b, c] = [first[i], second[i] - first[i], third[i] - second[i]].map(|count| count as f64);
        assert!(a > 0.0 && (0.5..2.0).contains(&(b / a)) && (0.5..2.0).contains(&(c / b)), "{i}: {a} {b} {c}");
    }
}

#[test]
fn last_tile_has_the_remaining_rays() {
    let mut data = ball(Split::Train, 8);
    data.frames.truncate(2);
    let data = Arc::new(data);
    let marched = |batch: usize| {
        let mut config = tiny();
        config.sampler.get_mut::<HierarchicalConfig>().unwrap().batch = batch;
        let mut trainer = Trainer::new(config, data.clone()).unwrap();
        let stats = trainer.step(0.0);
        assert_eq!(stats.rays, batch as u64);
        stats.placed_samples
    };
    assert!(marched(8) > 0);
    // Every ray has the same number of samples; tiles have eight rays.
    assert_eq!(8 * marched(21), 21 * marched(8));
}

#[test]
fn restart_keeps_frozen_values_and_lr_scales() {
    let mut data = ball(Split::Train, 8);
    data.frames.truncate(2);
    let mut trainer = Trainer::new(tiny(), Arc::new(data)).unwrap();
    let params = &mut trainer.model.params;
    let ids: Vec<_> = params.ids().collect();
    let frozen = params.name(ids[0]).to_owned();
    params.get_mut(ids[0]).as_mut_slice().fill(0.25);
    params.freeze(|name| name == frozen);
    params.set_lr_scale(|name| name != frozen, 0.5);
    let before: Vec<_> = params.values().to_vec();
    trainer.restart();
    let params = &trainer.model.params;
    let ids: Vec<_> = params.ids().collect();
    assert!(params.is_frozen(ids[0]) && params.lr_scale(ids[1]) == 0.5 && !params.is_frozen(ids[1]));
    assert_eq!(params.values()[0], before[0]);
    assert!(params.values().iter().zip(&before).skip(1).any(|(new, old)| new != old), "other numbers");
}

#[test]
fn restart_resets_refined_cameras() {
    let mut data = ball(Split::Train, 8);
    data.frames.truncate(3);
    let config = tiny().with_refined(&[RefinedParam::Poses, RefinedParam::Focal, RefinedParam::Exposure]);
    let mut trainer = Trainer::new(config, Arc::new(data.clone())).unwrap();
    trainer.step(0.0);
    trainer.restart();
    let cameras: Vec<Camera> = data.frames.iter().map(|frame| frame.camera.clone()).collect();
    assert_eq!(trainer.model.cameras(), cameras);
    assert!(trainer.model.exposure.is_some() && trainer.model.camera_optimizer.is_some());
    // The cameras start as given and are refined again.
    let moved = |trainer: &Trainer| trainer.model.learned_camera(1, &cameras[1]) != cameras[1];
    assert!(!moved(&trainer));
    let before = trainer.stats().step;
    for fraction in [0.3, 0.4, 0.5] {
        trainer.step(fraction);
    }
    assert!(trainer.stats().step == before + 3 && moved(&trainer));
}

/// A trainer that refines these parameters and has taken `steps` steps, and whose poses have then moved each image by
/// this angle in degrees.
fn refining(parts: &[RefinedParam], steps: u64, motion: f64) -> Trainer {
    let config = tiny_table().with_refined(parts);
    let mut trainer = Trainer::new(config, Arc::new(ball(Split::Train, 32))).unwrap();
    (0..steps).for_each(|_| _ = trainer.step(0.01));
    let poses = trainer.model.params.find(POSES).unwrap();
    let each = (motion.to_radians() / 6.0_f64.sqrt()) as f32;
    trainer.model.params.get_mut(poses).as_mut_slice().fill(each);
    trainer
}

/// Whether the trainer treats the given poses as right: all detail, and a low learning rate of the poses.
fn keeps_given_poses(trainer: &Trainer) -> bool {
    let params = &trainer.model.params;
    let poses = params.find(POSES).unwrap();
    let signs = [trainer.model.detail() == 1.0, params.lr_scale(poses) < 0.1];
    assert_eq!(signs[0], signs[1]);
    signs[0]
}

#[test]
fn poses_that_hardly_move_are_restored() {
    for (motion, right) in [(0.3, true), (0.39, true), (0.41, false), (0.6, false)] {
        let mut trainer = refining(&[RefinedParam::Poses], 100, motion);
        // Too early in the run.
        trainer.step(0.04);
        assert!(!keeps_given_poses(&trainer) && trainer.stats().pose_motion.is_none());
        let poses = trainer.model.params.find(POSES).unwrap();
        trainer.model.params.set_lr_scale(|name| name == POSES, 0.5);
        let found = trainer.step(0.05).pose_motion.unwrap();
        assert!((found.median - motion).abs() < 0.02, "{found:?} {motion}");
        let scale = trainer.model.params.lr_scale(poses);
        assert!((scale - if right { 0.01 } else { 0.5 }).abs() < 1e-12, "{scale}");
        let left = trainer.model.camera_optimizer.as_ref().unwrap().pose_motion(&trainer.model.params).unwrap();
        assert!((left.median < 0.01) == right && (left.median > 0.3) != right, "{left:?}");
        assert_eq!((keeps_given_poses(&trainer), trainer.stats().given_poses_are_right()), (right, right));
        // The first check counts, also after a restart.
        trainer.model.params.get_mut(poses).as_mut_slice().fill(if right { 0.1 } else { 0.0 });
        assert_eq!(trainer.step(0.06).pose_motion, Some(found));
        trainer.restart();
        trainer.step(0.07);
        assert_eq!((keeps_given_poses(&trainer), trainer.stats().pose_motion), (right, Some(found)));
    }
}

#[test]
fn poses_are_right_if_no_image_moves_far() {
    for (median, largest, right) in [(0.39, 0.84, true), (0.39, 0.86, false), (0.41, 0.5, false)] {
        let stats = StepStats { pose_motion: Some(PoseMotion { median, largest }), ..StepStats::default() };
        assert_eq!(stats.given_poses_are_right(), right, "{median} {largest}");
    }
    assert!(!StepStats::default().given_poses_are_right());
}

#[test]
fn poses_are_checked_after_steps_of_the_model() {
    let mut trainer = refining(&[RefinedParam::Poses], 98, 0.0);
    assert_eq!(trainer.step(0.5).pose_motion, None);
    trainer.restart();
    let mut checked = |steps: u64| (0..steps).filter(|_| trainer.step(0.5).pose_motion.is_some()).count();
    assert_eq!([checked(100), checked(1)], [0, 1]);
    let mut trainer = refining(&[RefinedParam::Focal, RefinedParam::Poses], 100, 0.0);
    trainer.model.config.camera_optimizer.check_at = 0.0;
    assert_eq!(trainer.step(0.5).pose_motion, None);
    // Many images have few rays each.
    let mut trainer = refining(&[RefinedParam::Poses], 100, 0.0);
    trainer.done.rays = 100 * trainer.data.frames.len() as u64 - 1;
    assert_eq!([trainer.step(0.5), trainer.step(0.5)].map(|stats| stats.pose_motion.is_some()), [false, true]);
}

#[test]
fn right_poses_carve_unless_lenses_are_refined() {
    use RefinedParam::{Focal, Lens, Poses};
    let carved = Trainer::new(tiny_table(), Arc::new(ball(Split::Train, 32))).unwrap().stats().occupied;
    assert!((0.05..0.95).contains(&carved), "{carved}");
    for (parts, motion, carves) in
        [(&[Poses][..], 0.1, true), (&[Poses], 0.6, false), (&[Poses, Focal], 0.1, false), (&[Poses, Lens], 0.1, false)]
    {
        let mut trainer = refining(parts, 100, motion);
        let before = trainer.stats().occupied;
        trainer.check_poses(0.2);
        assert!(trainer.stats().pose_motion.is_some_and(|found| (found.median - motion).abs() < 0.01), "{parts:?}");
        // Cells that are known to be empty stay so.
        let after = trainer.stats().occupied;
        assert!(after <= before && (carves || after == before), "{parts:?} {motion}: {after}, {before} before");
        let mut grid = trainer.model.sampler.grid().unwrap().clone();
        grid.threshold(&Threshold { min_sigma: -1.0, or_mean: false, dilate: false });
        assert_eq!(grid.occupied_share(), if carves { carved } else { 1.0 }, "{parts:?} {motion}");
    }
}

#[test]
fn run_resumes_before_and_after_the_check_of_poses() {
    for motion in [0.3, 0.6] {
        let mut trainer = refining(&[RefinedParam::Poses], 100, motion);
        let fractions = [0.04, 0.05, 0.06];
        for i in 0..3 {
            let state = trainer.state().unwrap();
            let (config, data) = (trainer.model.config.clone(), trainer.data.clone());
            let mut later = Trainer::new(config, data).unwrap();
            later.load_state(&state).unwrap();
            fractions[i..].iter().for_each(|fraction| _ = later.step(*fraction));
            trainer.step(fractions[i]);
            let mut rest = Trainer::new(trainer.model.config.clone(), trainer.data.clone()).unwrap();
            rest.load_state(&trainer.state().unwrap()).unwrap();
            fractions[i + 1..].iter().for_each(|fraction| _ = rest.step(*fraction));
            assert_eq!(later.model.params.values(), rest.model.params.values(), "{motion} {i}");
            assert_eq!(later.stats().pose_motion, rest.stats().pose_motion);
            assert!(later.stats().pose_motion.is_some() && keeps_given_poses(&later) == (motion < 0.4));
        }
    }
}

/// Two tiny networks, with few rays of few samples.
fn tiny() -> Config {
    let paper = ClassicConfig::paper();
    let field = ClassicConfig { depth: 2, width: 16, skip_layers: vec![], view_width: 8, position_levels: 3, ..paper };
    let sampler = HierarchicalConfig {
        proposal: field.clone(),
        coarse: 6,
        fine: 4,
        batch: 16,
        tile: 8,
        ..HierarchicalConfig::default()
    };
    let (field, sampler) = (FieldConfig::new(field), SamplerConfig::new(sampler));
    Config { field, sampler, ..Config::preset(Preset::Small) }
}

/// A small hash grid.
fn tiny_table() -> Config {
    let mut config = Config::preset(Preset::Instant);
    if let Some(field) = config.field.get_mut::<InstantConfig>() {
        field.grid = HashGridConfig { levels: 3, features: 2, log2_table: 8, coarsest: 4, finest: 16 };
        (field.density_width, field.color_width) = (16, 16);
    }
    if let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() {
        (sampler.step, sampler.samples, sampler.occupancy.resolution) = (0.04, 1024, 16);
    }
    config
}

#[test]
fn frozen_parameters_rest_others_have_own_lr() {
    let data = Arc::new(ball(Split::Train, 12));
    for config in [tiny(), tiny_table()] {
        for round in 0..3 {
            let mut trainer = Trainer::new(config.clone(), data.clone()).unwrap();
            let params = &mut trainer.model.params;
            let names: Vec<String> = params.names().map(String::from).collect();
            let rests = |name: &str| names.iter().position(|other| other == name).is_some_and(|i| i % 3 == round);
            if round == 1 {
                params.set_lr_scale(rests, 0.0)
            } else {
                params.freeze(rests)
            };
            let before = params.clone();
            for _ in 0..2 {
                trainer.step(0.1);
            }
            assert!(trainer.stats().non_finite == 0 && !trainer.stats().has_diverged());
            for ((name, before), after) in before.iter().zip(trainer.model.params.values()) {
                assert_eq!(before == after, rests(name), "{name}, round {round}");
            }
            // Unfrozen parameters change again.
            trainer.model.params.unfreeze(|_| true);
            let before = trainer.model.params.clone();
            trainer.step(0.1);
            let moved = |(before, after)| before != after;
            let count = before.values().iter().zip(trainer.model.params.values()).filter(|&pair| moved(pair)).count();
            assert_eq!(count == before.len(), round != 1, "round {round}");
        }
    }
}

#[test]
fn overflowing_networks_end_the_run() {
    let data = Arc::new(ball(Split::Train, 12));
    let mut trainer = Trainer::new(tiny_table(), data).unwrap();
    trainer.step(0.0);
    let ids: Vec<_> = trainer.model.params.ids().collect();
    for id in ids {
        if trainer.model.params.name(id).contains("color.0") {
            let weights = trainer.model.params.get_mut(id).as_mut_slice();
            weights.iter_mut().enumerate().for_each(|(i, x)| *x = if i % 2 == 0 { 3e38 } else { -3e38 });
        }
    }
    trainer.run(Budget::Steps(1000), |_| ControlFlow::Continue(()));
    assert!(trainer.stats().has_diverged() && trainer.stats().step < 200, "{:?}", trainer.stats());
}

#[test]
fn diverged_run_ends() {
    let data = Arc::new(ball(Split::Train, 12));
    for config in [tiny(), tiny_table()] {
        let mut trainer = Trainer::new(config, data.clone()).unwrap();
        trainer.step(0.0);
        trainer.model.params.values_mut().iter_mut().for_each(|x| x.as_mut_slice().fill(f32::NAN));
        trainer.run(Budget::Steps(1000), |trainer| {
            assert!(trainer.stats().non_finite_steps + 1 == trainer.stats().step && trainer.stats().non_finite > 0);
            ControlFlow::Continue(())
        });
        assert!(trainer.stats().has_diverged() && trainer.stats().step == 1 + STUCK);
    }
}

#[test]
fn first_non_finite_names_value_and_line() {
    let data = Arc::new(ball(Split::Train, 12));
    for config in
        [tiny(), tiny_table(), tiny().with_refined(&[RefinedParam::Poses, RefinedParam::Focal, RefinedParam::Exposure])]
    {
        let mut trainer = Trainer::new(config, data.clone()).unwrap();
        for _ in 0..3 {
            assert!(trainer.first_non_finite(0.5).is_none());
            trainer.step(0.5);
        }
        // Values computed from the last weights of the colours.
        let ids: Vec<_> = trainer.model.params.ids().collect();
        let last = ids.into_iter().rfind(|id| trainer.model.params.name(*id).contains("color")).unwrap();
        trainer.model.params.get_mut(last).as_mut_slice()[0] = f32::NAN;
        let error = trainer.first_non_finite(0.5).unwrap();
        let GraphError::NonFinite { value, at, .. } = &error else { panic!("{error}") };
        assert!(!value.is_finite() && at.file().ends_with(".rs") && at.line() > 0, "{error}");
        assert!(trainer.step(0.5).non_finite_steps > 0 && trainer.first_non_finite(0.5).is_some());
    }
}

#[test]
fn lr_scale_scales_all_updates() {
    let data = Arc::new(ball(Split::Train, 12));
    let config = tiny_table().with_refined(&[RefinedParam::Exposure]);
    let [whole, half, none] = [1.0, 0.5, 0.0].map(|factor| {
        let mut trainer = Trainer::new(config.clone(), data.clone()).unwrap();
        trainer.set_lr_scale(factor);
        let before = trainer.model.params.clone();
        let rate = trainer.step(0.3).lr;
        let after = trainer.model.params.values().iter();
        let moved = |(a, b): (&Tensor<f32>, &Tensor<f32>)| {
            let moves = a.as_slice().iter().zip(b.as_slice()).map(|(a, b)| f64::from(a - b).abs());
            moves.fold(0.0, raygrad_tensor::Real::maximum)
        };
        (rate, after.zip(before.values()).map(moved).collect::<Vec<f64>>())
    });
    assert!(whole.0 == 2.0 * half.0 && none.0 == 0.0 && whole.1.iter().all(|moved| *moved > 0.0), "{whole:?}");
    // Adam's first step is the learning rate.
    for ((whole, half), none) in whole.1.iter().zip(&half.1).zip(&none.1) {
        assert!((half / whole - 0.5).abs() < 1e-3 && *none == 0.0, "{whole} {half} {none}");
    }
}

#[test]
fn batch_size_follows_wanted_samples() {
    let mut config = tiny_table();
    config.sampler.get_mut::<MarchingConfig>().unwrap().samples = 24576;
    let mut trainer = Trainer::new(config, Arc::new(ball(Split::Train, 12))).unwrap();
    let mut next = |batch: usize, marched: u64| {
        trainer.batch = batch;
        trainer.adapt_batch(&Work { marched, ..Work::default() });
        trainer.batch
    };
    // 24576 samples of 8 per ray are 3072 rays; the change is half of the difference.
    assert_eq!(next(1024, 8 * 1024), 2048);
    assert_eq!(next(5120, 8 * 5120), 4096);
    // At most twice as many, a multiple of 8, and at least 256.
    assert_eq!([next(1024, 1024), next(1024, 0)], [2048; 2]);
    assert_eq!(next(1500, 8 * 1500), 2288);
    assert_eq!(next(256, 10_000_000), 256);
    // Other numbers of tiles, the last of which may be smaller.
    let mut config = tiny_table();
    let sampler = config.sampler.get_mut::<MarchingConfig>().unwrap();
    (sampler.samples, sampler.tiles) = (40_000, 13);
    let mut trainer = Trainer::new(config, Arc::new(ball(Split::Train, 12))).unwrap();
    for rays in [256, 5000, 5005] {
        trainer.batch = rays;
        assert_eq!(trainer.draw(0.0).tiles(), 13);
    }
    trainer.batch = 1000;
    trainer.adapt_batch(&Work { marched: 8000, ..Work::default() });
    assert_eq!(trainer.batch, 2000);
    // A step is no larger than a checkpoint may say.
    let mut config = tiny_table();
    config.sampler.get_mut::<MarchingConfig>().unwrap().samples = 1 << 24;
    let mut trainer = Trainer::new(config, Arc::new(ball(Split::Train, 12))).unwrap();
    (trainer.batch, trainer.done.step) = (MOST_RAYS, 1);
    trainer.adapt_batch(&Work { marched: 1000, ..Work::default() });
    assert_eq!(trainer.batch, MOST_RAYS);
}

/// The ball, with alpha between 0 and 1 at places.
fn half_transparent() -> Dataset {
    let mut data = ball(Split::Train, 12);
    for frame in &mut data.frames {
        let mut image = frame.image.to_image();
        assert_eq!(image.channels, 4);
        image.data.chunks_mut(4).enumerate().for_each(|(i, pixel)| pixel[3] *= (i % 5) as f32 / 4.0);
        frame.image = image.into();
    }
    data
}

#[test]
fn expected_background_gives_the_mean_loss_over_all_backgrounds() {
    let data = Arc::new(half_transparent());
    let mut exact = tiny_table();
    if let Some(field) = exact.field.get_mut::<InstantConfig>() {
        field.gradient_cut = 0.0;
    }
    let exposed = exact.clone().with_refined(&[RefinedParam::Exposure]);
    for config in [exact, exposed, Config { background: Background::Expected, ..tiny() }] {
        let mut trainer = Trainer::new(config, data.clone()).unwrap();
        for _ in 0..20 {
            trainer.step(0.0);
        }
        let reach = trainer.model.reach();
        let mut batch = Batch::draw(&data, 64, reach, Background::Expected, &mut stream(1, [0, 0]));
        assert!(batch.alpha.iter().any(|alpha| (0.1..0.9).contains(alpha)));
        let mut loss = |batch: &Batch| {
            let (tape, model) = (Tape::new(), &trainer.model);
            let params = model.params.bind(&tape);
            let rng = &mut stream(2, [0, 0]);
            let (loss, work) = rays_loss(model, &params, batch, 0.0, &mut Jitter::Random(rng));
            let grads = loss.tracked().backward(&params.vars()).into_iter();
            let grads: Vec<Tensor<f32>> = grads.map(|grad| grad.into_dense(&Pool::none())).collect();
            trainer.model.config.background = Background::White;
            ([work.loss, work.error], grads)
        };
        let expected = loss(&batch);
        // Gauss-Legendre quadrature with two nodes is exact for squares.
        let nodes = [0.5 - 12_f32.sqrt().recip(), 0.5 + 12_f32.sqrt().recip()].map(|color| {
            for ((target, background), alpha) in batch.target.iter_mut().zip(&mut batch.background).zip(&batch.alpha) {
                *target = target.map(|x| x + (1.0 - alpha) * (color - background[0]));
                *background = [color; 3];
            }
            loss(&batch)
        });
        for (i, found) in expected.0.into_iter().enumerate() {
            let mean = (nodes[0].0[i] + nodes[1].0[i]) / 2.0;
            assert!((found / mean - 1.0).abs() < 1e-5, "{found} for {mean}");
        }
        for ((found, a), b) in expected.1.iter().zip(&nodes[0].1).zip(&nodes[1].1) {
            let mean = |(a, b): (&f32, &f32)| (a + b) / 2.0;
            let means: Vec<f32> = a.as_slice().iter().zip(b.as_slice()).map(mean).collect();
            let largest = means.iter().fold(0.0_f32, |most, x| most.max(x.abs()));
            for (found, mean) in found.as_slice().iter().zip(means) {
                assert!((found - mean).abs() <= 1e-4 * largest, "{found} for {mean}");
            }
        }
    }
}

#[test]
fn only_squared_errors_have_an_expected_background() {
    let huber = Config { loss: Loss::Huber { delta: 0.1 }, ..tiny_table() };
    let used = |config: &Config| config.training_background();
    assert_eq!([used(&tiny_table()), used(&huber)], [Background::Expected, Background::Random]);
    assert_eq!(used(&Config { background: Background::Black, ..huber.clone() }), Background::Black);
    let random = Config { background: Background::Random, ..huber.clone() };
    let [expected, drawn] = [huber, random].map(|config| {
        let mut trainer = Trainer::new(config, Arc::new(half_transparent())).unwrap();
        [trainer.step(0.0), trainer.step(0.0)].map(|stats| (stats.loss, stats.psnr))
    });
    assert_eq!(expected, drawn);
}

#[test]
fn gradient_cut_moves_fewer_rows() {
    let moved = [0.0, 0.03, 1.0].map(|cut| {
        let mut config = tiny_table();
        if let Some(field) = config.field.get_mut::<InstantConfig>() {
            assert_eq!(field.gradient_cut, 0.03, "the preset's");
            field.gradient_cut = cut;
            // Most rows have one sample.
            (field.grid.log2_table, field.grid.finest) = (18, 256);
        }
        let mut trainer = Trainer::new(config, Arc::new(ball(Split::Train, 12))).unwrap();
        (0..10).map(|_| trainer.step(0.0)).last().unwrap().moved
    });
    assert!(moved[0] > moved[1] && moved[1] > moved[2] && moved[2] > 0, "{moved:?}");
    let mut config = tiny_table();
    if let Some(field) = config.field.get_mut::<InstantConfig>() {
        field.gradient_cut = 1.5;
    }
    let message = config.check().unwrap_err().to_string();
    assert!(message.contains("gradient_cut") && message.contains("1.5"), "{message}");
}

#[test]
fn restart_draws_other_rays() {
    let data = Arc::new(ball(Split::Train, 12));
    let [one, other] = [0, 1].map(|restarts| {
        let mut trainer = Trainer::new(tiny_table(), data.clone()).unwrap();
        trainer.done.restarts = restarts;
        trainer.step(0.0).loss
    });
    assert!(one != other && one.is_finite() && other.is_finite(), "{one} {other}");
}

#[test]
fn optimizer_settings_are_checked() {
    let mut config = Config { schedule: Schedule::Constant { lr: 1e300 }, ..tiny() };
    let message = |config: &Config| config.check().unwrap_err().to_string();
    assert_eq!(message(&config), "`schedule.constant.lr`: is 1e300; use 0 to 1e30");
    config.schedule = Schedule::Constant { lr: 0.1 };
    config.adam.beta1 = 1.0;
    assert_eq!(message(&config), "`adam.beta1`: is 1.0; use 0 to 1 - 2^-20");
    config.adam.beta1 = 0.0;
    config.table_adam.beta2 = 2.0;
    assert!(message(&config).contains("`table_adam.beta2`: is 2.0"));
    assert!(Trainer::new(config, Arc::new(ball(Split::Train, 12))).is_err());
}

/// A process that was stopped for an hour has not trained for an hour.
#[test]
fn time_while_stopped_does_not_count() {
    let data = Arc::new(ball(Split::Train, 8));
    let extent = SceneBox::new(data.bounds, [data.near, data.far]);
    let clock = Arc::new(AtomicU64::new(0));
    let now = clock.clone();
    // Each reading of the clock takes a second, and in the fifth step an hour.
    let now = move || {
        let readings = now.fetch_add(1, Relaxed);
        Duration::from_secs(readings + if readings < 11 { 0 } else { 3600 })
    };
    let mut trainer = Trainer::with_clock(tiny_table(), data, extent, now).unwrap();
    let seconds: Vec<f64> = (0..6).map(|_| trainer.step(0.0).train_seconds).collect();
    // The first second is that of the preparation; of the hour, twenty times the mean of 5/4 s count.
    assert_eq!(seconds, [2.0, 3.0, 4.0, 5.0, 30.0, 31.0]);
}

#[test]
fn a_budget_of_no_steps_trains_none() {
    let mut trainer = Trainer::new(tiny_table(), Arc::new(ball(Split::Train, 8))).unwrap();
    trainer.run(Budget::Steps(0), |_| ControlFlow::Continue(()));
    assert_eq!(trainer.stats().step, 0);
}

#[test]
fn near_and_far_are_checked() {
    for near_far in [[0.1, f64::INFINITY], [5.0, 1.0], [f64::NAN, 1.0], [-1.0, 1.0]] {
        let extent = SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], near_far);
        let error = Model::<f32>::new(tiny_table(), extent, 0).err().unwrap().to_string();
        assert!(error.starts_with("`scene_box.near_far`"), "{error}");
    }
}

/// However bright the exposure, renders are at most white, and the background shines through.
#[test]
fn renders_with_an_exposure_are_at_most_white() {
    let data = Arc::new(ball(Split::Train, 8));
    let mut model = Trainer::new(tiny_table().with_refined(&[RefinedParam::Exposure]), data.clone()).unwrap().model;
    let exposure = model.params.find("exposure").unwrap();
    model.params.get_mut(exposure).as_mut_slice().fill(3.0);
    let colors = |model: &Model<f32>| model.render(&data.frames[0].camera, [1.0; 3]).color.data;
    let bright = colors(&model);
    assert!(bright.iter().all(|color| *color <= 1.0 + 1e-6), "{bright:?}");
    assert!(bright.iter().filter(|color| **color > 1.0 - 1e-6).count() > bright.len() / 2);
}
