//! Corrected cameras, compared with their rays and with finite differences.

use super::*;
use crate::dataset::SceneType;
use crate::model::{Config, Model, Preset};
use glam::DMat3;
use raygrad_autograd::check::{Check, check_function};
use raygrad_autograd::{Real, Tape};
use raygrad_nn::Schedule;

const BOX: [DVec3; 2] = [DVec3::splat(-1.0), DVec3::splat(1.0)];
const SPAN: [f64; 2] = [0.5, 9.0];

const MIDDLE: DVec3 = DVec3::new(0.1, -0.2, 0.3);

/// The box of a scene with `frames` images.
fn extent(frames: usize) -> SceneBox {
    SceneBox { unit: 1.5, frames, ..SceneBox::new([MIDDLE - 1.0, MIDDLE + 1.0], SPAN) }
}

/// The six parameters of a rotation and translation.
fn numbers(refine: &CameraOptimizer, number: usize, correction: [f64; POSE]) -> [f64; POSE] {
    let matrix = &refine.balance[number];
    let mut found = [0.0; POSE];
    for row in (0..POSE).rev() {
        let rest: f64 = (row + 1..POSE).map(|k| matrix[row][k] * found[k]).sum();
        found[row] = (correction[row] - rest) / matrix[row][row];
    }
    found
}

/// Six images by cameras of five kinds; the first two share one camera.
fn cameras() -> Vec<Camera> {
    let pose = |x: f64| Camera::look_at(DVec3::new(x, -3.0, 2.0), DVec3::ZERO, DVec3::Z);
    let camera =
        |x: f64, lens| Camera { centre: [3.0, 5.5], focal: [8.0, 8.5], lens, ..Camera::from_angle(9, 7, 0.8, pose(x)) };
    let brown = Lens::Brown { k: [0.1, -0.05, 0.01, 0.02, 0.0, 0.0], p: [0.01, -0.02] };
    let fisheye = Lens::Fisheye { k: [0.05, -0.02, 0.003, 0.0], p: [0.002, 0.001], s: [0.0; 2] };
    let lenses = [brown, brown, fisheye, Lens::Fov { omega: 0.7 }, Lens::Pinhole, Lens::Equirectangular];
    lenses.into_iter().enumerate().map(|(i, lens)| camera(1.0 + 0.3 * i as f64, lens)).collect()
}

fn all() -> CameraOptimizerConfig {
    let rate = Some(Schedule::Constant { lr: 1e-3 });
    CameraOptimizerConfig { focal: rate, lens: rate, ..CameraOptimizerConfig::default() }
}

const FRAMES: [u32; 8] = [0, 1, 1, 2, 3, 4, 5, 2];
const PIXELS: [[u32; 2]; 8] = [[0, 0], [8, 1], [4, 6], [2, 3], [7, 4], [1, 6], [3, 2], [8, 6]];

fn given(cameras: &[Camera]) -> Rays<f64> {
    let mut rays = Rays::new();
    for (frame, pixel) in FRAMES.into_iter().zip(PIXELS) {
        rays.push_pixel(&cameras[frame as usize], pixel.map(|x| x as usize), BOX, SPAN);
    }
    rays
}

#[test]
fn corrected_rays_equal_those_of_the_camera() {
    let cameras = cameras();
    for (poses, config) in [
        (true, CameraOptimizerConfig::default()),
        (false, CameraOptimizerConfig { lens: None, ..all() }),
        (false, CameraOptimizerConfig { focal: None, ..all() }),
        (true, all()),
    ] {
        let mut params = Params::<f64>::new();
        let refine = CameraOptimizer::new(poses, &config, (&extent(6), false), &cameras, &mut params).unwrap().unwrap();
        let rays = given(&cameras);
        for scale in [0.0, 1.0] {
            for value in params.values_mut() {
                value.as_mut_slice().iter_mut().enumerate().for_each(|(i, x)| *x = scale * 0.1 * (i as f64).sin());
            }
            let mut expected = Rays::<f64>::new();
            for (frame, pixel) in FRAMES.into_iter().zip(PIXELS) {
                let camera = refine.camera(&params, frame as usize, &cameras[frame as usize]);
                expected.push_pixel(&camera, pixel.map(|x| x as usize), BOX, SPAN);
            }
            let tape = Tape::new();
            let (vars, moved) = refine.rays(&params.bind(&tape), &rays, (&FRAMES, &PIXELS), BOX, SPAN);
            let apart = |a: &[[f64; 3]], b: &[[f64; 3]]| {
                let pairs = a.as_flattened().iter().zip(b.as_flattened());
                pairs.map(|(a, b)| (a - b).abs()).fold(0.0, Real::maximum)
            };
            assert!(apart(&moved.origins, &expected.origins) < 1e-14, "{config:?}");
            let numbers = moved.origins.iter().chain(&moved.directions);
            assert!(numbers.flatten().all(|x| x.is_finite()), "{moved:?}");
            let spans = |rays: &Rays<f64>| rays.spans.as_flattened().to_vec();
            assert!(spans(&moved).iter().zip(spans(&expected)).all(|(a, b)| (a - b).abs() < 1e-12), "{config:?}");
            assert!(apart(&moved.directions, &expected.directions) < 1e-13, "{config:?}, {moved:?}, {expected:?}");
            assert_eq!(vars.directions.value().as_slice(), moved.directions.as_flattened());
            let same = apart(&moved.directions, &rays.directions);
            assert_eq!(same < 1e-13, scale == 0.0, "{same}");
        }
    }
}

/// A function of rays as lines, independent of their origins: of their moments and directions.
fn seen<'t>(vars: &RayVars<'t, f64>) -> Var<'t, f64> {
    let RayVars { origins, directions } = vars;
    let at = |var: &Var<'t, f64>, i: usize| var.slice_axis(1, i..i + 1);
    let moment = |i: usize, j: usize| at(origins, i) * at(directions, j) - at(origins, j) * at(directions, i);
    let moments = Var::concat(&[&moment(1, 2), &moment(2, 0), &moment(0, 1)], 1);
    (moments.sin() * directions.exp()).sum()
}

#[test]
fn camera_corrections_match_differences() {
    let cameras = cameras();
    let mut layout = Params::<f64>::new();
    let refine = CameraOptimizer::new(true, &all(), (&extent(6), false), &cameras, &mut layout).unwrap().unwrap();
    let shapes: Vec<_> = layout.values().iter().map(|value| value.shape().to_vec()).collect();
    assert_eq!(shapes, [vec![6, 6], vec![5, 2], vec![5, 4]], "two photographs are of one camera");
    let rays = given(&cameras);
    for at in [0.0, 0.05] {
        let start = |shape: &Vec<usize>| Tensor::from_fn(shape, |i| at * (1.3 * i as f64).sin());
        let starts: Vec<_> = shapes.iter().map(start).collect();
        // A Newton step has the root's first derivatives, but not its second ones.
        let check = Check { second_order: false, ..Check::default() };
        let report = check_function(&check, &starts, |x| {
            let bound = layout.layout().bind(x.to_vec());
            let (vars, _) = refine.rays(&bound, &rays, (&FRAMES, &PIXELS), BOX, SPAN);
            seen(&vars)
        });
        assert!(report.unwrap().comparisons > 60);
    }
    // The gradient of the origins along their rays is 0.
    let tape = Tape::new();
    let bound = layout.bind(&tape);
    let (vars, moved) = refine.rays(&bound, &rays, (&FRAMES, &PIXELS), BOX, SPAN);
    let along = tape.constant(Tensor::from_vec(&[8, 3], moved.directions.as_flattened().to_vec()));
    let slid = (&vars.origins * along).sum().grad(&bound.vars());
    assert!(slid.iter().flat_map(|grad| grad.as_slice()).all(|slope| slope.abs() < 1e-12), "{slid:?}");
    // All parameters with an effect have a gradient.
    let tape = Tape::new();
    let bound = layout.bind(&tape);
    let (vars, _) = refine.rays(&bound, &rays, (&FRAMES, &PIXELS), BOX, SPAN);
    let grads = seen(&vars).grad(&bound.vars());
    assert!(grads[1].as_slice().iter().all(|slope| slope.abs() > 1e-6), "{:?}", grads[1]);
    let still: Vec<usize> = (0..20).filter(|&i| grads[2].as_slice()[i] == 0.0).collect();
    // The last two of a fisheye, the last three of a FOV lens, and all of an equirectangular camera.
    assert_eq!(still, [6, 7, 9, 10, 11, 16, 17, 18, 19]);
}

#[test]
fn images_have_their_own_balance() {
    let mut cameras = cameras();
    cameras[3].pose = Camera::look_at(DVec3::new(0.0, 9.0, -1.0), MIDDLE, DVec3::Z);
    for unbounded in [false, true] {
        let extent = SceneBox { near_far: [0.5, 30.0], ..extent(6) };
        let mut params = Params::<f64>::new();
        let config = CameraOptimizerConfig::default();
        let refine = CameraOptimizer::new(true, &config, (&extent, unbounded), &cameras, &mut params).unwrap().unwrap();
        for (i, camera) in cameras.iter().enumerate() {
            let expected = balance(camera, extent.bounds, extent.near_far, extent.unit, unbounded);
            assert!(refine.balance[i] == expected && expected != plain(extent.unit), "{i}");
        }
        // Each of the six moves the image by about its own size.
        for k in 0..POSE {
            let id = params.find(POSES).unwrap();
            params.get_mut(id).as_mut_slice().fill(0.0);
            params.get_mut(id).as_mut_slice()[3 * POSE + k] = 1e-4;
            let [a, b] = [&cameras[3], &refine.camera(&params, 3, &cameras[3])].map(|camera| camera.pose.inverse());
            let off = (0..8).map(|j| {
                let place = MIDDLE + 0.5 * DVec3::from([0, 1, 2].map(|d| f64::from(j >> d & 1) * 2.0 - 1.0));
                a.transform_point3(place).angle_between(b.transform_point3(place)) / 1e-4
            });
            let mean = off.sum::<f64>() / 8.0;
            assert!((0.1..3.0).contains(&mean), "{k}: {mean}");
        }
    }
}

#[test]
fn pose_motion_is_that_of_the_images() {
    let cameras = cameras();
    let mut params = Params::<f64>::new();
    let config = CameraOptimizerConfig::default();
    let new = |poses, params: &mut Params<f64>| {
        CameraOptimizer::new(poses, &config, (&extent(6), false), &cameras, params).unwrap()
    };
    let refine = new(true, &mut params).unwrap();
    let none = Some(PoseMotion { median: 0.0, largest: 0.0 });
    assert_eq!(refine.pose_motion(&params), none);
    // A rotation about an axis across the view moves all points by about as much.
    let id = params.find(POSES).unwrap();
    for (i, degrees) in [(4, 0.75), (1, 0.5), (2, 0.25), (5, 0.25)] {
        let axis = cameras[i].pose.matrix3.x_axis * f64::to_radians(degrees);
        let row = numbers(&refine, i, [axis.x, axis.y, axis.z, 0.0, 0.0, 0.0]);
        params.get_mut(id).as_mut_slice()[i * POSE..(i + 1) * POSE].copy_from_slice(&row);
    }
    let PoseMotion { median, largest } = refine.pose_motion(&params).unwrap();
    assert!((0.9..1.1).contains(&(4.0 * median)) && (0.9..1.1).contains(&(largest / 0.75)), "{median} {largest}");
    params.get_mut(id).as_mut_slice()[3 * POSE] = f64::NAN;
    assert!(refine.pose_motion(&params).unwrap().largest.is_nan());
    refine.reset_poses(&mut params);
    assert!(refine.pose_motion(&params) == none && refine.camera(&params, 4, &cameras[4]) == cameras[4]);
    let params = &mut Params::<f64>::new();
    let refine = CameraOptimizer::new(false, &all(), (&extent(5), false), &cameras[..5], params).unwrap().unwrap();
    assert_eq!(refine.pose_motion(params), None);
}

#[test]
fn unseen_pixels_give_cameras_no_gradient() {
    let mut cameras = cameras();
    cameras.truncate(1);
    cameras[0].lens = Lens::Brown { k: [-0.5, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
    let mut params = Params::<f64>::new();
    let refine = CameraOptimizer::new(false, &all(), (&extent(1), false), &cameras, &mut params).unwrap().unwrap();
    let mut rays = Rays::new();
    let pixels = [[3, 5], [8, 0]];
    pixels.iter().for_each(|pixel: &[u32; 2]| rays.push_pixel(&cameras[0], pixel.map(|x| x as usize), BOX, SPAN));
    assert!(!cameras[0].sees(8.5, 0.5) && cameras[0].sees(3.5, 5.5));
    let tape = Tape::new();
    let bound = params.bind(&tape);
    let (vars, moved) = refine.rays(&bound, &rays, (&[0, 0], &pixels), BOX, SPAN);
    assert!(moved.directions.as_flattened().iter().all(|x| x.is_finite()));
    for (row, expected) in [(0, true), (1, false)] {
        let grads = vars.directions.slice_axis(0, row..row + 1).sum().grad(&bound.vars());
        let moves = grads.iter().flat_map(|grad| grad.as_slice()).any(|slope| *slope != 0.0);
        assert!(moves == expected && grads.iter().all(Tensor::is_finite), "{grads:?}");
    }
}

#[test]
fn camera_optimizer_checks_its_cameras() {
    let new = |poses, config: &CameraOptimizerConfig, frames, cameras: &[Camera]| {
        CameraOptimizer::new(poses, config, (&extent(frames), false), cameras, &mut Params::<f64>::new())
    };
    let cameras = cameras();
    let none = CameraOptimizerConfig::default();
    assert!(new(false, &none, 6, &cameras).unwrap().is_none());
    // Earlier models stored no cameras: their poses are rotation vectors and translations in scene units.
    let plain = new(true, &none, 6, &[]).unwrap().unwrap();
    assert_eq!(numbers(&plain, 5, [0.1, 0.2, 0.3, 1.5, 3.0, -1.5]), [0.1, 0.2, 0.3, 1.0, 2.0, -1.0]);
    let message = |poses, config: &CameraOptimizerConfig, frames, cameras: &[Camera]| {
        new(poses, config, frames, cameras).err().unwrap().to_string()
    };
    assert!(message(true, &none, 0, &[]).starts_with("`poses`"));
    assert!(message(true, &none, 7, &cameras).starts_with("`poses`"));
    assert!(message(false, &all(), 6, &[]).starts_with("`camera_optimizer.focal`"));
    let panoramas = vec![cameras[5].clone(); 2];
    assert!(
        message(true, &CameraOptimizerConfig { focal: None, ..all() }, 2, &panoramas)
            .starts_with("`camera_optimizer.lens`: cannot be refined: equirect")
    );
    assert!(new(true, &none, 2, &panoramas).unwrap().is_some());
    assert!(
        message(true, &CameraOptimizerConfig { focal: None, ..all() }, 5, &cameras)
            .starts_with("`camera_optimizer.lens`")
    );
}

#[test]
fn held_out_cameras_move_with_the_training_cameras() {
    let cameras = cameras();
    let mut params = Params::<f64>::new();
    let refine = CameraOptimizer::new(true, &all(), (&extent(6), false), &cameras, &mut params).unwrap().unwrap();
    // All cameras move by the same translation.
    let moved = DVec3::new(0.15, -0.3, 0.45);
    let set = |params: &mut Params<f64>, name: &str, values: &[f64]| {
        let id = params.find(name).unwrap();
        let all = params.get_mut(id).as_mut_slice();
        all.iter_mut().enumerate().for_each(|(i, x)| *x = values[i % values.len()]);
    };
    let moves = |refine: &CameraOptimizer| -> Vec<f64> {
        (0..6).flat_map(|i| numbers(refine, i, [0.0, 0.0, 0.0, moved.x, moved.y, moved.z])).collect()
    };
    set(&mut params, "poses", &moves(&refine));
    set(&mut params, "focal", &[0.1, 0.2]);
    set(&mut params, "lens", &[0.01]);
    // The cameras are on a line, so positions alone would leave a rotation about it open.
    let line = refine.transform(&params).unwrap();
    assert!((line.scale - 0.15_f64.exp()).abs() < 1e-9 && line.rotation.abs_diff_eq(DMat3::IDENTITY, 1e-9), "{line:?}");
    // The similarity maps each camera to its refined pose.
    for (i, camera) in cameras.iter().enumerate() {
        let (all, own) = (line.camera(camera).pose, refine.camera(&params, i, camera).pose);
        assert!(all.abs_diff_eq(own, 1e-9), "{i}: {all:?} {own:?}");
    }
    let mut around = cameras.clone();
    around.iter_mut().enumerate().for_each(|(i, camera)| camera.pose.translation.z += (i as f64).sin());
    let mut params = Params::<f64>::new();
    let refine = CameraOptimizer::new(true, &all(), (&extent(6), false), &around, &mut params).unwrap().unwrap();
    set(&mut params, "poses", &moves(&refine));
    // Each group has its own factors: those of the pinhole, the fourth group, are 0.2 and 0.4.
    let each: Vec<f64> = (0..10).map(|i| [0.05, 0.1][i % 2] * (i / 2 + 1) as f64).collect();
    set(&mut params, "focal", &each);
    set(&mut params, "lens", &[0.01, 0.02, 0.03, 0.04]);
    let pose = Camera::look_at(DVec3::new(0.0, 4.0, 1.0), DVec3::ZERO, DVec3::Z);
    // The fifth camera is a pinhole, and the image is twice as large.
    let other = Camera { pose, ..around[4].resized(18, 14) };
    let found = refine.other_cameras(&params, std::slice::from_ref(&other)).remove(0);
    // Its distance grows too, by the mean of the factors of columns and rows.
    let expected = MIDDLE + 0.3_f64.exp() * (pose.translation - MIDDLE) + moved;
    assert!(found.pose.translation.distance(expected) < 1e-9, "{found:?}");
    assert!(found.pose.matrix3.abs_diff_eq(pose.matrix3, 1e-9));
    assert!(((found.focal[0] / 16.0).ln() - 0.2).abs() < 1e-12 && ((found.focal[1] / 17.0).ln() - 0.4).abs() < 1e-12);
    assert!(matches!(found.lens, Lens::Brown { k, p } if k[..3] == [0.01, 0.02, 0.0] && p == [0.03, 0.04]));
    // A camera that took no training image keeps its intrinsics.
    let unknown = Camera { focal: [9.0, 9.0], ..other };
    let found = refine.other_cameras(&params, std::slice::from_ref(&unknown)).remove(0);
    assert_eq!((found.focal, found.lens), (unknown.focal, unknown.lens));
}

#[test]
fn model_tells_cameras_whether_scene_is_unbounded() {
    let cameras = cameras();
    let bounded = Config { poses: all().focal, ..Config::preset(Preset::Voxel) };
    let unbounded = bounded.clone().with_scene_type(SceneType::Unbounded);
    for (config, unbounded) in [(bounded, false), (unbounded, true)] {
        let model = Model::<f32>::with_cameras(config, extent(6), &cameras, 0).unwrap();
        let mut params = Params::<f32>::new();
        let none = CameraOptimizerConfig::default();
        let new =
            |unbounded, params: &mut _| CameraOptimizer::new(true, &none, (&extent(6), unbounded), &cameras, params);
        let expected = new(unbounded, &mut params).unwrap().unwrap();
        let other = new(!unbounded, &mut Params::<f32>::new()).unwrap().unwrap();
        let found = &model.camera_optimizer.as_ref().unwrap().balance;
        assert!(*found == expected.balance && *found != other.balance, "{unbounded}");
    }
}
