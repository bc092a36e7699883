//! Marching with uniform steps and cones. Marching is f32 alone; rays come in either precision.

use super::support::*;
use raygrad::nerf::Jitter;
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::space::occupancy::{MAX_STEPS, MarchBuffer, OccupancyConfig, OccupancyGrid, Step};

/// The samples of a ray from the origin along z in an occupied box that is wide enough.
fn march(span: [f64; 2], step: Step) -> MarchBuffer {
    let reach = span[1].abs() * 2.0 + 1.0;
    let config = OccupancyConfig { resolution: 16, ..OccupancyConfig::default() };
    let grid = OccupancyGrid::new([DVec3::splat(-reach), DVec3::splat(reach)], &config).unwrap();
    let mut out = MarchBuffer::default();
    grid.march(&ray_along_z(0.0, span), &step, &mut Jitter::Middle, &mut out);
    out
}

/// The step of fast trainers: 1/1024 of the diagonal of the unit cube.
const DT: f32 = 1.691_456e-3;

/// Matrix: march from t0 = 0, 2, 1e3, 32768, 1e6, with steps shorter than an ULP. Catalogue: `t += dt`.
#[test]
fn march_samples_are_exact_at_any_distance() {
    for t0 in [0.0, 2.0, 1e3, 32768.0, 1e6] {
        let out = march([t0, t0 + 3.0], Step::uniform(DT));
        // All samples that fit, up to one at either end, where whole ULPs are lost or gained.
        let expected = 3.0 / f64::from(DT);
        let slack = 1.0 + 2.0 * ulp::<f32>(t0) / f64::from(DT);
        within(&format!("number of samples from {t0}"), out.t.len() as f64, expected, slack);
        assert!(out.t.is_sorted() && out.t[0] >= t0 as f32 && out.t.iter().all(|&t| t <= t0 as f32 + 3.0));
        // Sample i of the ray; the first is half a step behind t0.
        for (i, &t) in out.t.iter().enumerate() {
            let exact = t0 + (i as f64 + 0.5) * f64::from(DT);
            within(&format!("sample {i} from {t0}"), t.into(), exact, ulp::<f32>(exact));
        }
    }
}

/// Marches end for steps far below an ULP, endless spans and non-finite rays.
#[test]
fn marches_always_end() {
    let out = march([1e6, 1e6 + 1.0], Step::uniform(1e-30));
    assert!(out.t.len() <= MAX_STEPS + 32 && out.t.iter().all(|&t| (1e6..=1e6 + 1.0).contains(&t)));
    for span in [[0.0, f64::INFINITY], [f64::INFINITY, f64::INFINITY], [f64::NAN, 1.0], [0.0, f64::NAN], [5.0, 1.0]] {
        let config = OccupancyConfig { resolution: 16, ..OccupancyConfig::default() };
        let grid = OccupancyGrid::new([DVec3::NEG_ONE, DVec3::ONE], &config).unwrap();
        for cone in [0.0, 1.0 / 256.0] {
            let mut out = MarchBuffer::default();
            let step = Step { length: 0.01, cone, max_samples: usize::MAX };
            grid.march(&ray_along_z(0.0, span), &step, &mut Jitter::Middle, &mut out);
            assert!(out.t.len() <= 101 && out.t.iter().all(|t| t.is_finite()), "{span:?}: {}", out.t.len());
        }
    }
    for (length, cone) in
        [(0.0, 0.0), (-1.0, 0.0), (f32::NAN, 0.0), (f32::INFINITY, 0.0), (0.1, -0.1), (0.1, 1.5), (0.1, f32::NAN)]
    {
        assert!(Step { length, cone, max_samples: 1 }.check().is_err(), "{length} {cone}");
    }
}

/// Matrix: cone stepping with c = 0, 1e-6, 1/256, 1.
#[test]
fn cone_steps_grow_and_tend_to_uniform() {
    for cone in [1e-6, 1.0 / 256.0, 1.0] {
        for near in [0.0, 2.0, 1e3] {
            let step = Step { length: 0.01, cone, max_samples: usize::MAX };
            let out = march([near, near + 8.0], step);
            let (c, length) = (f64::from(cone), f64::from(0.01_f32));
            let start = near + 0.5 * (length + c * near);
            assert!(out.t.is_sorted() && out.t.is_empty() == (start > near + 8.0), "cone {cone} from {near}");
            for (i, &t) in out.t.iter().enumerate() {
                let exact = start + (length + c * start) * (i as f64 * c.ln_1p()).exp_m1() / c;
                within(&format!("cone {cone} from {near}, sample {i}"), t.into(), exact, 2.0 * ulp::<f32>(exact));
            }
            // The intervals are between whole steps from the entry, so they are adjacent.
            let total: f64 = out.delta.iter().map(|&d| f64::from(d)).sum();
            let exact = (length + c * near) * (out.t.len() as f64 * c.ln_1p()).exp_m1() / c;
            near_by(total, exact);
        }
    }
    // Five roundings of at most a unit each; the grid of numbers is odd, so that all of them are rounded.
    let mut worst = 0.0;
    for draw in 0..400_u16 {
        let part = |k: f64| (f64::from(draw) * k).fract() as f32;
        let (length, cone, near) = (0.005 + 0.01 * part(0.618), 0.01 + 0.2 * part(0.414), 0.5 + 4.0 * part(0.732));
        let out = march([near.into(), f64::from(near) + 20.0], Step { length, cone, max_samples: usize::MAX });
        let [length, c, near] = [length, cone, near].map(f64::from);
        let start = near + 0.5 * (length + c * near);
        for (i, &t) in out.t.iter().enumerate() {
            let exact = start + (length + c * start) * (i as f64 * c.ln_1p()).exp_m1() / c;
            let error = (f64::from(t) - exact).abs() / ulp::<f32>(exact);
            assert!(error <= 5.0, "{error} ULP: {length} {c} {near}, sample {i}");
            worst = error.max(worst);
        }
    }
    println!("worst of drawn steps: {worst:.2} ULP");
    let [uniform, narrow] = [0.0, 1e-9].map(|cone| march([0.0, 8.0], Step { length: 0.01, cone, max_samples: 10_000 }));
    assert_eq!(uniform.t.len(), narrow.t.len());
    for (i, (a, b)) in uniform.t.iter().zip(&narrow.t).enumerate() {
        within(&format!("sample {i}"), f64::from(*b), f64::from(*a), 1e-9 * 8.0 * 8.0 / 0.01 + 2.0 * ulp::<f32>(8.0));
    }
}

#[track_caller]
fn near_by(got: f64, expected: f64) {
    near::<f32>("the sum of the intervals", got, expected, 1e-6);
}
