//! Skipping: empty cells, and samples behind opaque ones.

use super::support::*;
use raygrad::nerf::Jitter;
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::sampling::marching::MarchingConfig;
use raygrad::nerf::space::occupancy::{MarchBuffer, OccupancyConfig, OccupancyGrid, Skip, Step, Threshold, Update};
use raygrad::nerf::volume::VisibleSamples;
use raygrad::nerf::volume::quadrature::Quadrature;
use raygrad::nerf::{Camera, Config, Density, Field, Model, Preset, Query, Samples, SceneBox, ViewInputs, VoxelConfig};
use raygrad::{Bound, Params, Scalar, Segments, Tape, Tensor, Var};
use std::sync::Arc;

/// A uniform fog in a cube of +-1. It is black in the front half (z < 0) and white behind, or of one colour.
struct Fog {
    sigma: f64,
    white_behind: bool,
}

impl<T: Scalar> Field<T> for Fog {
    fn density<'t>(&self, _: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
        let sigma = Tensor::full(&[positions.shape()[0]], T::from_f64(self.sigma));
        Density { value: positions.tape().constant(sigma), log: false, features: positions.clone() }
    }
    fn color<'t>(&self, _: &Bound<'t, T>, features: &Var<'t, T>, _: &ViewInputs<'_, 't, T>) -> Var<'t, T> {
        let z = features.slice_axis(1, 2..3);
        let white = z.gt(if self.white_behind { 0.0 } else { -5.0 });
        z.tape().constant(white.cast()).broadcast_to(&[features.shape()[0], 3])
    }
}

/// Matrix: training's early termination at the exact threshold of T, with a background unlike the front, without
/// renormalising.
fn training_ends_rays_within_the_bound<T: Scalar>() {
    for (eps, steps) in [(0.25, 2), (0.125, 3), (1.0 / 1024.0, 10), (1e-3, 10), (1e-4, 13), (0.0, 5)] {
        for white_behind in [false, true] {
            // Each step halves the light, so T is a power of two exactly.
            let n = 40;
            let delta = 2.0_f64.ln();
            let rays = ray_along_z::<T>(-1.0, [0.0, 2.0]);
            let t = vector::<T>(&(0..n).map(|i| 2.0 * i as f64 / n as f64).collect::<Vec<_>>());
            let tape = Tape::new();
            let samples = Samples::new(&rays, Segments::uniform(1, n), t, vector(&vec![delta; n]), tape.pool());
            let params = Params::new().bind(&tape);
            let fog = Fog { sigma: 1.0, white_behind };
            let query = Query::new(&fog, &params);
            let [all, some] = [0.0, eps].map(|least| Quadrature::Midpoint.render(&query, &samples, least));
            assert_eq!(all.visible, n);
            assert!(
                some.visible <= n && (eps == 0.0 || some.visible.abs_diff(steps) <= 1),
                "{eps}: {} kept",
                some.visible
            );
            for background in [0.0, 1.0] {
                let pixel = |seen: &VisibleSamples<'_, T>| {
                    let [color, left] =
                        [&seen.rendered.color, &seen.rendered.transmittance()].map(|x| numbers(x.value()));
                    color[0] + background * left[0]
                };
                let [whole, part] = [&all, &some].map(pixel);
                within(
                    &format!("threshold {eps}, background {background}"),
                    part,
                    whole,
                    eps + by_type::<T>(1e-6, 1e-14),
                );
            }
        }
    }
}

both!(training_ends_rays_within_the_bound);

/// A model of this fog, and a camera in front of it.
fn fog_model(fog: Fog, skip: Skip) -> (Model<f32>, Camera) {
    let mut config = Config::preset(Preset::Voxel);
    if let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() {
        sampler.occupancy.resolution = 16;
        sampler.occupancy.skip = skip.into();
        sampler.step = 1.0 / 128.0;
    }
    let extent = SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [0.0, 10.0]);
    if let Some(voxel) = config.field.get_mut::<VoxelConfig>() {
        voxel.resolution = 4;
    }
    let mut model = Model::new(config, extent, 0).unwrap();
    model.field = Arc::new(fog);
    let pose = Camera::look_at(DVec3::new(0.2, 0.3, -4.0), DVec3::ZERO, DVec3::Y);
    (model, Camera::from_angle(16, 16, 0.4, pose))
}

/// Matrix: early termination of renders, which renormalise, at both levels and over both backgrounds.
#[test]
fn rendering_ends_rays_within_the_bound() {
    // The losses allowed at each level: remaining light, and colours of small weights.
    for (skip, bound) in [(Skip::NearLossless, 1e-4 + 1e-4), (Skip::Fast, 1e-3 + 2e-3)] {
        for sigma in [0.05, 1.0, 4.0, 6.9, 30.0, 1e3, 1e30] {
            for white_behind in [false, true] {
                for background in [0.0, 1.0] {
                    let view = |skip| {
                        let (mut model, camera) = fog_model(Fog { sigma, white_behind }, skip);
                        model.finish();
                        model.render(&camera, [background; 3])
                    };
                    let (whole, part) = (view(Skip::Off), view(skip));
                    for (a, b) in whole.color.data.iter().zip(&part.color.data) {
                        let what = format!("{skip}, density {sigma}, background {background}");
                        within(&what, (*b).into(), (*a).into(), bound + 1e-6);
                    }
                    let all = [&part.color, &part.depth, &part.opacity];
                    assert!(all.iter().flat_map(|x| &x.data).all(|x| x.is_finite()));
                }
            }
        }
    }
}

/// The remaining light is attributed to the samples in front: a white body over black is white, not 1 - 1e-3.
#[test]
fn early_terminated_ray_has_the_full_colour() {
    for skip in [Skip::NearLossless, Skip::Fast] {
        let (mut model, camera) = fog_model(Fog { sigma: 10.0, white_behind: false }, skip);
        model.finish();
        let view = model.render(&camera, [0.0; 3]);
        let brightest = view.color.data.iter().copied().fold(0.0_f32, raygrad::Real::maximum);
        within("brightest", brightest.into(), 1.0, 1e-6);
    }
}

/// Catalogue: sum w = 0. An empty pixel has the depth 0, not NaN.
#[test]
fn depth_of_an_empty_pixel_is_zero() {
    for sigma in [0.0, 1e-30, 1e-6] {
        let (model, camera) = fog_model(Fog { sigma, white_behind: true }, Skip::Off);
        let picture = model.render(&camera, [1.0; 3]);
        assert!(picture.depth.data.iter().all(|&d| d == 0.0), "density {sigma}");
        assert!(picture.color.data.iter().all(|c| (c - 1.0).abs() < 1e-5));
    }
}

/// Matrix: occupancy with a fog of sigma dt = 0.0099 in every cell. Neither training nor renders lose any of it,
/// although the usual threshold of 0.01 per step would delete a fog of alpha 0.997.
#[test]
fn fog_just_below_the_usual_threshold_stays() {
    let step = 1.0 / 128.0;
    let sigma = 0.0099 / step as f32;
    let config = OccupancyConfig { resolution: 16, ..OccupancyConfig::default() };
    let fog = |points: &[[f32; 3]], out: &mut [f32]| out[..points.len()].fill(sigma);
    let mut grid = OccupancyGrid::new([DVec3::NEG_ONE, DVec3::ONE], &config).unwrap();
    for training_step in 0..20 {
        grid.update(&Update::ALL, 0, training_step, &fog);
        grid.threshold(&Threshold { min_sigma: 0.01 / step as f32, or_mean: true, dilate: false });
        assert_eq!(grid.occupied_share(), 1.0, "in training, step {training_step}");
    }
    for skip in [Skip::NearLossless, Skip::Fast] {
        grid.rebuild(skip.min_sigma(grid.longest_path()), false, &fog);
        assert_eq!(grid.occupied_share(), 1.0, "{skip}");
    }
    // Without density no cell stays.
    let nothing = |points: &[[f32; 3]], out: &mut [f32]| out[..points.len()].fill(0.0);
    let mut grid = OccupancyGrid::new([DVec3::NEG_ONE, DVec3::ONE], &config).unwrap();
    grid.update(&Update::ALL, 0, 0, &nothing);
    grid.threshold(&Threshold { min_sigma: 0.01 / step as f32, or_mean: true, dilate: false });
    assert_eq!(grid.occupied_share(), 0.0);
}

/// Matrix: the most that may be skipped, along the longest ray, changes a colour by at most the declared bound.
#[test]
fn skipped_fog_error_is_within_its_bound() {
    for skip in [Skip::NearLossless, Skip::Fast] {
        let config = OccupancyConfig { resolution: 16, ..OccupancyConfig::default() };
        let mut grid = OccupancyGrid::new([DVec3::NEG_ONE, DVec3::ONE], &config).unwrap();
        let sigma = skip.min_sigma(grid.longest_path());
        let share = |grid: &mut OccupancyGrid, sigma: f32| {
            let fog = move |points: &[[f32; 3]], out: &mut [f32]| out[..points.len()].fill(sigma);
            grid.rebuild(skip.min_sigma(grid.longest_path()), false, &fog);
            grid.occupied_share()
        };
        assert_eq!(share(&mut grid, sigma.next_up()), 1.0);
        assert_eq!(share(&mut grid, sigma), 0.0);
        // From corner to corner, alpha is the loss of white fog over black.
        let lost = -(-f64::from(sigma) * grid.longest_path()).exp_m1();
        assert!(lost <= skip.error_bound() * (1.0 + 1e-6) && lost > 0.9 * skip.error_bound(), "{skip}: {lost}");
    }
}

/// The remaining samples do not depend on what is skipped.
#[test]
fn skipping_keeps_sample_positions() {
    let config = OccupancyConfig { resolution: 16, ..OccupancyConfig::default() };
    let mut grid = OccupancyGrid::new([DVec3::NEG_ONE, DVec3::ONE], &config).unwrap();
    let rays = ray_along_z::<f32>(-3.0, [0.0, 10.0]);
    let step = Step::uniform(0.013);
    let (mut all, mut some) = (MarchBuffer::default(), MarchBuffer::default());
    grid.march(&rays, &step, &mut Jitter::Middle, &mut all);
    let ball = |points: &[[f32; 3]], out: &mut [f32]| {
        points.iter().zip(out).for_each(|(p, out)| *out = if p[2].abs() < 0.3 { 1.0 } else { 0.0 });
    };
    grid.rebuild(0.5, false, &ball);
    grid.march(&rays, &step, &mut Jitter::Middle, &mut some);
    assert!(some.t.len() < all.t.len() / 2 && some.t.len() > 10);
    assert!(some.t.iter().all(|t| all.t.contains(t)));
    assert_eq!(all.steps, some.steps);
}
