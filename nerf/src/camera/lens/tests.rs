//! The domain and the inverse of distortions, compared with simpler methods.

use crate::camera::lens::Lens;
use crate::camera::lens::inverse::Distortion;
use proptest::prelude::*;
use raygrad_autograd::Dual;
use std::f64::consts::PI;

fn brown(k: [f64; 6], p: [f64; 2]) -> Distortion {
    Distortion::Rational([k[0], k[1], k[2], k[3], k[4], k[5], p[0], p[1]])
}

/// The determinant of a distortion's Jacobian, with dual numbers.
fn determinant(distortion: &Distortion, [x, y]: [f64; 2]) -> f64 {
    let x = Dual { value: x, slopes: [Some(1.0), None] };
    let y = Dual { value: y, slopes: [None, Some(1.0)] };
    let [[a, b], [c, d]] = distortion.of([x, y]).map(|u| u.slopes.map(|s| s.unwrap_or(0.0)));
    a * d - b * c
}

/// The first radius at which the determinant is not positive, by small steps.
fn marched(distortion: &Distortion, e: [f64; 2], end: f64) -> Option<f64> {
    let at = |r: f64| determinant(distortion, e.map(|e| e * r));
    let steps = 20_000;
    let found = (1..=steps).find(|i| !(at(end * f64::from(*i) / f64::from(steps)) > 0.0))?;
    let [mut low, mut high] = [found - 1, found].map(|i| end * f64::from(i) / f64::from(steps));
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if at(middle) > 0.0 { low = middle } else { high = middle }
    }
    Some(low)
}

#[test]
fn fold_is_the_first_root_of_the_determinant() {
    let distortions = [
        brown([-0.5, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
        brown([-0.3, 0.01, 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
        brown([0.2, -0.1, 0.0, 0.0, 0.0, 0.0], [0.02, -0.03]),
        brown([-0.3, 0.12, -0.02, 0.0, 0.0, 0.0], [0.002, -0.003]),
        brown([0.0; 6], [0.05, 0.02]),
        brown([0.5, 0.1, 0.0, 0.8, 0.3, 0.1], [0.01, 0.0]),
        brown([0.5, 0.5, 0.0, 0.0, 0.0, 0.0], [0.0; 2]),
        Distortion::ThinPrism([-0.05, 0.01, 0.0, 0.0, -0.01, 0.008, 0.02, 0.015]),
        Distortion::ThinPrism([-0.08, 0.02, -0.01, 0.001, 0.0, 0.0, 0.0, 0.0]),
        Distortion::ThinPrism([0.02, 0.0, 0.0, -0.001, 0.0, 0.0, 0.05, 0.0]),
    ];
    let mut folds = 0;
    for distortion in &distortions {
        for turn in 0..12 {
            let (sin, cos) = (f64::from(turn) * PI / 6.0 + 0.1).sin_cos();
            let (found, expected) = (distortion.domain().edge([cos, sin], 3.0), marched(distortion, [cos, sin], 3.0));
            match (found, expected) {
                (None, None) => (),
                (Some(found), Some(expected)) => {
                    folds += 1;
                    assert!((found - expected).abs() < 1e-9, "{distortion:?}: {found}, not {expected}");
                    for (r, inside) in [(0.999, true), (1.001, false)] {
                        let place = [cos, sin].map(|e| e * r * found);
                        assert_eq!(distortion.domain().holds(place), inside, "{distortion:?} at {place:?}");
                    }
                }
                _ => panic!("{distortion:?}: {found:?}, not {expected:?}"),
            }
        }
    }
    assert!(folds > 50, "{folds} folds");
}

#[test]
fn pole_ends_the_domain() {
    // The denominator is 1 - s: points diverge towards r = 1 and change sign beyond it.
    let distortion = brown([0.0, 0.0, 0.0, -1.0, 0.0, 0.0], [0.0; 2]);
    assert!((distortion.domain().edge([1.0, 0.0], 5.0).unwrap() - 1.0).abs() < 1e-12);
    let lens = Lens::Brown { k: [0.0, 0.0, 0.0, -1.0, 0.0, 0.0], p: [0.0; 2] };
    for r in [0.1, 1.0, 30.0, 1e6] {
        let direction = lens.direction([r, 0.0]).unwrap();
        let before = direction.x / direction.z;
        assert!(before < 1.0 && (before / (1.0 - before * before) / r - 1.0).abs() < 1e-6, "{r}: {before}");
    }
    assert_eq!(lens.place(glam::DVec3::new(1.5, 0.0, 1.0)), None);
}

#[test]
fn double_root_is_a_fold() {
    // The slope is (1 - s)^2: zero at 1, and positive again beyond it.
    let distortion = brown([-2.0 / 3.0, 0.2, 0.0, 0.0, 0.0, 0.0], [0.0; 2]);
    let edge = distortion.domain().edge([1.0, 0.0], 5.0).unwrap();
    assert!((edge - 1.0).abs() < 1e-6, "{edge}");
}

proptest! {
    /// For any coefficients, the inverse lies in the domain and maps back to the target.
    #[test]
    fn inverse_stays_inside_the_fold(
        c in prop::array::uniform8(-0.3..0.3_f64), prism: bool, off in 0.0..0.2_f64, u in -1.2..1.2_f64, v in -1.2..1.2_f64,
    ) {
        let c = [c[0], c[1], c[2], c[3], if prism { off * c[4] } else { c[4] }, if prism { off * c[5] } else { c[5] },
            off * c[6], off * c[7]];
        let distortion = if prism { Distortion::ThinPrism(c) } else { Distortion::Rational(c) };
        let (Ok(place) | Err(place)) = distortion.undo([u, v]);
        let r = place[0].hypot(place[1]);
        let e = place.map(|x| x / r);
        prop_assert!(marched(&distortion, e, r * (1.0 - 1e-6)).is_none(), "{:?}", place);
        if distortion.undo([u, v]).is_ok() {
            let again = distortion.of(place);
            prop_assert!((again[0] - u).hypot(again[1] - v) < 1e-11, "{:?} for {:?}", again, [u, v]);
        }
    }

    /// Distorted points of the domain come back.
    #[test]
    fn inverse_of_distortion_is_the_point(
        c in prop::array::uniform8(-0.3..0.3_f64), prism: bool, off in 0.0..0.1_f64, turn in -PI..PI, share in 0.0..0.99_f64,
    ) {
        let c = [c[0], c[1], c[2], c[3], if prism { off * c[4] } else { c[4] }, if prism { off * c[5] } else { c[5] },
            off * c[6], off * c[7]];
        let distortion = if prism { Distortion::ThinPrism(c) } else { Distortion::Rational(c) };
        let e = [turn.cos(), turn.sin()];
        let r = share * distortion.domain().edge(e, 2.0).unwrap_or(2.0);
        let place = e.map(|e| e * r);
        prop_assert!(distortion.domain().holds(place));
        let again = distortion.undo(distortion.of(place));
        prop_assert!(again.is_ok(), "{:?}", again);
        let again = again.unwrap();
        prop_assert!((again[0] - place[0]).hypot(again[1] - place[1]) < 1e-9, "{:?} for {:?}", again, place);
    }
}
