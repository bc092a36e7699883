//! Boxes, directions, contraction, normalised device coordinates, lenses.

use super::support::*;
use raygrad::nerf::glam::{DMat3, DVec3};
use raygrad::nerf::{Lens, Ndc, Ray, Space, clip_near_far, contract, intersect_box};
use raygrad::{Scalar, Tape};

const UNIT: [DVec3; 2] = [DVec3::NEG_ONE, DVec3::ONE];

/// A ray with numbers rounded to the type.
fn ray<T: Scalar>(origin: [f64; 3], direction: [f64; 3]) -> Ray {
    Ray { origin: origin.map(round::<T>).into(), direction: direction.map(round::<T>).into() }
}

/// Matrix: slabs with d = +-0 on each axis; origin on face, edge, corner; inside; behind; d = 1e-40; NaN.
fn rays_along_the_axes_of_a_box<T: Scalar>() {
    let places = [-2.0, beside::<T>(-1.0, false), -1.0, -0.5, 0.0, -0.0, 1.0, beside::<T>(1.0, true), 2.0];
    for axis in 0..3 {
        for (p, q) in places.iter().flat_map(|&p| places.map(|q| (p, q))) {
            for along in [-3.0, -1.0, 0.0, 1.0, 3.0] {
                for (sign, zero) in [(1.0, 0.0), (1.0, -0.0), (-1.0, 0.0), (-1.0, -0.0)] {
                    let (mut o, mut d) = ([0.0; 3], [zero; 3]);
                    (o[axis], o[(axis + 1) % 3], o[(axis + 2) % 3]) = (along, p, q);
                    d[axis] = sign;
                    // A hit: between the faces, unless the box is entirely behind.
                    let hits = p.abs() <= 1.0 && q.abs() <= 1.0 && sign * along <= 1.0;
                    let expected = hits.then(|| [f64::max(0.0, -1.0 - sign * along), 1.0 - sign * along]);
                    assert_eq!(intersect_box(&ray::<T>(o, d), UNIT), expected, "{o:?} {d:?}");
                }
            }
        }
    }
    // The cases of the document: the naive formula gives NaN for the first and a miss for the second.
    for zero in [0.0, -0.0, 1e-40, -1e-40] {
        let got = intersect_box(&ray::<T>([0.0, 0.0, -3.0], [zero, 0.0, 1.0]), UNIT);
        assert_eq!(got, Some([2.0, 4.0]), "{zero:e}");
    }
    let face = intersect_box(&ray::<T>([1.0, 0.0, -3.0], [0.0, 0.0, 1.0]), UNIT);
    assert_eq!(face, Some([2.0, 4.0]));
    for k in 0..6 {
        let mut numbers = [0.1, 0.2, -3.0, 0.1, 0.1, 0.9];
        numbers[k] = f64::NAN;
        let [a, b, c, d, e, f] = numbers;
        let ray = ray::<T>([a, b, c], [d, e, f]);
        assert_eq!(intersect_box(&ray, UNIT), None, "NaN at {k}");
        assert_eq!(clip_near_far(&ray, UNIT, [2.0, 6.0]), [2.0, 2.0]);
    }
}

/// Matrix: slabs are symmetric in axis and sign, and agree with a search along the ray.
fn box_intersection_is_symmetric<T: Scalar>() {
    let mut random = noise(3);
    let mut hits = 0;
    for _ in 0..500 {
        let (o, d) = ([0; 3].map(|_| 6.0 * random() - 3.0), [0; 3].map(|_| 2.0 * random() - 1.0));
        let base = ray::<T>(o, d);
        let expected = intersect_box(&base, UNIT);
        for turn in 0..3 {
            for signs in 0..8_usize {
                let turned = |v: DVec3| {
                    let mut out = [0.0; 3];
                    (0..3).for_each(|k| out[(k + turn) % 3] = if signs >> k & 1 == 1 { -v[k] } else { v[k] });
                    DVec3::from(out)
                };
                let other = Ray { origin: turned(base.origin), direction: turned(base.direction) };
                assert_eq!(intersect_box(&other, UNIT), expected);
            }
        }
        // The points in the box of a fine comb along the ray.
        let inside: Vec<f64> =
            (0..20_000).map(|i| i as f64 * 1e-3).filter(|&t| base.at(t).abs().max_element() <= 1.0).collect();
        match expected {
            Some([enter, leave]) => {
                hits += 1;
                if let (Some(first), Some(last)) = (inside.first(), inside.last()) {
                    assert!(first - enter <= 1.001e-3 && first >= &(enter - 1e-9), "{first} {enter}");
                    assert!(leave.min(20.0) - last <= 1.001e-3 && last <= &(leave + 1e-9), "{last} {leave}");
                } else {
                    assert!(leave - enter < 1e-3 || enter > 19.9, "{enter} {leave}");
                }
            }
            None => assert!(inside.is_empty()),
        }
    }
    assert!(hits > 50, "{hits} hits");
}

/// Matrix: normalise 0, 1e-40, 1e-23, 1e20, max. Catalogue: `v / norm(v)`.
fn directions_of_vectors_of_every_size<T: Scalar>() {
    let more = by_type::<T>(1.0, 1e-300);
    for scale in [smallest::<T>() * 8.0, 1e-40, 1e-23, more, 1.0, 1e20, 0.25 * greatest::<T>()] {
        for shape in [[0.6, 0.8, 0.0], [1.0, -2.0, 2.0], [1.0, 1e-3, 0.0], [0.0, 0.0, -1.0]] {
            let row = shape.map(|x| round::<T>(x * scale));
            let largest = row.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
            let scaled = row.map(|x| x / largest);
            let length = scaled.iter().map(|x| x * x).sum::<f64>().sqrt();
            let tape = Tape::new();
            let x = tape.leaf(tensor::<T>(&[1, 3], &row));
            let unit = x.normalize();
            for (got, x) in numbers(unit.value()).into_iter().zip(scaled) {
                near::<T>(&format!("{shape:?} times {scale:e}"), got, x / length, 2.0 * T::EPSILON);
            }
            finite("gradient", &unit.slice_axis(1, ..1).sum().grad(&[&x])[0]);
        }
    }
    let top = greatest::<T>();
    let tape = Tape::new();
    let x = tape.leaf(tensor::<T>(&[2, 2], &[0.0, -0.0, top, top]));
    let unit = x.normalize();
    let slopes = numbers(&unit.sum().grad(&[&x])[0]);
    assert_eq!((&numbers(unit.value())[..2], &slopes[..2]), (&[0.0, 0.0][..], &[0.0, 0.0][..]));
    near::<T>("max", unit.value().as_slice()[2].to_f64(), 0.5_f64.sqrt(), 2.0 * T::EPSILON);
    assert!(slopes[2].abs() <= 1.0 / top && slopes[3].abs() <= 1.0 / top);
}

/// Matrix: contraction of 0, norm 1 +- ulp, 1e4, 1e20, inf.
fn contraction_is_smooth_and_bounded<T: Scalar>() {
    let at = |point: [f64; 3]| {
        let tape = Tape::new();
        let x = tape.leaf(tensor::<T>(&[1, 3], &point));
        let y = contract(&x);
        let rows: Vec<f64> = (0..3).flat_map(|i| numbers(&y.slice_axis(1, i..i + 1).sum().grad(&[&x])[0])).collect();
        (numbers(y.value()), rows)
    };
    let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    assert_eq!(at([0.0, -0.0, 0.0]), (vec![0.0; 3], identity.to_vec()));
    assert_eq!(at([0.6, 0.5, -0.2]).1, identity);
    let (below, above) = (beside::<T>(1.0, false), beside::<T>(1.0, true));
    let tolerance = 8.0 * T::EPSILON;
    for r in [below, 1.0, above] {
        let (y, slopes) = at([0.0, r, 0.0]);
        within("value at the sphere", y[1], r, tolerance);
        (0..9).for_each(|k| within(&format!("slope {k} at {r}"), slopes[k], identity[k], tolerance));
    }
    let norm = |y: &[f64]| y.iter().map(|y| y * y).sum::<f64>().sqrt();
    near::<T>("norm 1e4", at([0.0, 0.0, 1e4]).0[2], constant("contraction of norm 1e4"), T::EPSILON);
    for size in [3.0, 1e4, 1e20, 0.5 * greatest::<T>(), greatest::<T>(), f64::INFINITY] {
        for shape in [[1.0, 0.0, 0.0], [0.6, -0.8, 0.0], [1.0, 1.0, -1.0]] {
            let (y, slopes) = at(shape.map(|x: f64| if x == 0.0 { 0.0 } else { x * size }));
            assert!(norm(&y) < 2.0 && slopes.iter().all(|s| s.is_finite()), "{size:e} {shape:?}: {y:?} {slopes:?}");
            let length = norm(&shape);
            let largest = if size.is_infinite() { y.clone() } else { shape.map(|x| x / length * norm(&y)).to_vec() };
            (0..3).for_each(|k| within("direction", y[k], largest[k], 4.0 * T::EPSILON));
        }
    }
    // Across the ray a step scales with the radius; along it, with 1 / r^2.
    let (_, slopes) = at([0.0, 4.0, 0.0]);
    within("across", slopes[0], 1.75 / 4.0, tolerance);
    within("along", slopes[4], 1.0 / 16.0, tolerance);
    let y = at([f64::NAN, 0.5, 0.0]).0;
    assert!(y.iter().all(|y| y.is_nan()));
}

/// Matrix: NDC of depths 0, +-1e-6, behind, at the near plane and largest.
fn normalised_device_coordinates<T: Scalar>() {
    let ndc = Ndc { eye: DVec3::ZERO, axes: DMat3::IDENTITY, slopes: [1.0, 1.0], near: 1.0 };
    let space = Space { unbounded: true, ndc: Some(ndc), ..Space::within([DVec3::NEG_ONE, DVec3::ONE]) };
    let at = |x: [f64; 3]| {
        let tape = Tape::new();
        let x = tape.leaf(tensor::<T>(&[1, 3], &x));
        let cube = space.cube(&x);
        [numbers(cube.value()), numbers(&cube.sum().grad(&[&x])[0])]
    };
    for z in [0.0, -0.0, 1e-6, -1e-6, 0.5, -0.5, 1e20, greatest::<T>()] {
        let [cube, grad] = at([0.25, -0.5, z]);
        assert_eq!(cube, [0.625, 0.25, 0.0], "what is nearer than the near plane, or behind, is seen at it: {z}");
        assert_eq!(grad, [0.5, 0.5, 0.0], "{z}");
    }
    // Points at the near plane stay exactly.
    assert_eq!(at([0.25, -0.5, -1.0])[0], [0.625, 0.25, 0.0]);
    let tolerance = by_type::<T>(2e-7, 1e-14);
    for (cube, name) in at([0.6, -0.2, -7.0])[0].iter().zip(["x", "y", "z"]) {
        near::<T>(name, *cube, constant(&format!("normalised device coordinates, {name}")), tolerance);
    }
    for z in [-1e6, -1e20, -greatest::<T>()] {
        let [cube, grad] = at([0.25 * z, 0.5 * z, z]);
        assert!((cube[0] - 0.375).abs() < 1e-6 && (cube[1] - 0.25).abs() < 1e-6, "{z}: {cube:?}");
        assert!(cube[2] > 0.99999 && cube[2] <= 1.0 && grad.iter().all(|g| g.is_finite()), "{z}: {cube:?} {grad:?}");
    }
}

/// Matrix: undistortion with k1 = -.5 at r_d = .54, .545, .6 and k1 = .5 at 3. Catalogue: ten Newton steps at .6.
fn lenses<T: Scalar>() {
    let lens = |k1: f64| Lens::Brown { k: [round::<T>(k1), 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
    let undone = |lens: Lens, r: f64| lens.direction([round::<T>(r), 0.0]).map(|direction| direction.x / direction.z);
    let (barrel, pincushion) = (lens(-0.5), lens(0.5));
    // Near the fold the slope is small: rounding 0.54 to f32 is amplified 7 times.
    let r = undone(barrel, 0.54).unwrap();
    within("k1 = -.5, .54", r, constant("undistorted .54 for k1 = -.5"), by_type::<T>(1e-6, 1e-14));
    assert!(undone(barrel, 0.5443).is_some());
    for none in [0.545, 0.6, 2.0, 1e30] {
        assert_eq!(undone(barrel, none), None);
        let [most, _] = barrel.place(barrel.nearest([none, 0.0])).unwrap();
        within("the largest radius", most, constant("largest distorted radius for k1 = -.5"), 1e-15);
    }
    let r = undone(pincushion, 3.0).unwrap();
    near::<T>("k1 = .5, 3", r, constant("undistorted 3 for k1 = .5"), by_type::<T>(1e-7, 1e-15));
    for lens in [barrel, pincushion] {
        assert_eq!(undone(lens, 0.0), Some(0.0));
        assert!([f64::NAN, f64::INFINITY].into_iter().all(|r| undone(lens, r).is_none()));
        near::<T>("tiny", undone(lens, 1e-30).unwrap(), round::<T>(1e-30), 1e-15);
    }
    assert!(undone(pincushion, 1e30).unwrap().is_finite());
}

both!(
    rays_along_the_axes_of_a_box,
    box_intersection_is_symmetric,
    directions_of_vectors_of_every_size,
    contraction_is_smooth_and_bounded,
    normalised_device_coordinates,
    lenses,
);
