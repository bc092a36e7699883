//! Maps with every kind of broadcast, sines in blocks of quick and other ones, lanes.

use super::support::{around, close, in_both, same, values, wide};
use raygrad_tensor::{Pool, Real, Scalar, Tensor, add_assign, broadcast_shape, lanes, lanes_real, map, map_real};

fn tensor<T: Scalar>(shape: &[usize], seed: usize) -> Tensor<T> {
    Tensor::from_vec(shape, values(shape.iter().product(), seed))
}

/// Where element `i` of a tensor of shape `to` stands in one of shape `from` that was stretched to it.
fn source(from: &[usize], to: &[usize], mut i: usize) -> usize {
    let (mut at, mut stride) = (0, 1);
    for axis in (0..to.len()).rev() {
        let index = i % to[axis];
        i /= to[axis];
        if axis + from.len() >= to.len() {
            let extent = from[axis + from.len() - to.len()];
            at += if extent == 1 { 0 } else { index * stride };
            stride *= extent;
        }
    }
    at
}

/// Shapes that broadcast together, with about `n` elements.
fn triples(n: usize) -> Vec<[Vec<usize>; 3]> {
    let (a, b) = (n.div_ceil(37), 37);
    vec![
        [vec![n], vec![n], vec![n]],
        [vec![n], vec![], vec![1]],
        [vec![a, b], vec![b], vec![a, 1]],
        [vec![b, a], vec![1, a], vec![b, 1]],
        [vec![a, 1], vec![1, b], vec![1, 1, 1]],
        [vec![a.div_ceil(3), 3, b], vec![1, 3, 1], vec![a.div_ceil(3), 1, b]],
        [vec![3, a.div_ceil(3), b], vec![a.div_ceil(3), 1], vec![3, 1, b]],
        [vec![1, n], vec![1, 1, n], vec![n]],
    ]
}

fn broadcasts<T: Scalar>() {
    let pool = Pool::new();
    // Below a block, around a block and a piece, and enough for all threads.
    for n in [1, 31].into_iter().chain(around(1024)).chain(around(32_768)).chain([140_009]) {
        for shapes in triples(n) {
            let [x, a, b] = [0, 1, 2].map(|k| tensor::<T>(&shapes[k], k + 1));
            let shape = broadcast_shape(&[&shapes[0], &shapes[1], &shapes[2]]).unwrap();
            let what = format!("{shapes:?}");
            let count = shape.iter().product::<usize>();
            let at = |x: &Tensor<T>, i: usize| x.as_slice()[source(x.shape(), &shape, i)].to_f64();
            let exact = || (0..count).map(|i| at(&x, i) * at(&a, i) + at(&b, i));
            let y = map([&x, &a, &b], &pool, |[x, a, b]| x * a + b);
            assert_eq!(y.shape(), &shape[..]);
            same(&what, y.as_slice(), exact());
            let y = map_real!([&x, &a, &b], &pool, |[x, a, b]| x * a + b);
            assert_eq!(y.shape(), &shape[..]);
            same(&what, y.as_slice(), exact());
            for x in [x, a, b] {
                let y = x.broadcast_to(&shape);
                assert_eq!(y.shape(), &shape[..]);
                same(&what, y.as_slice(), (0..count).map(|i| at(&x, i)));
            }
        }
    }
}

#[test]
fn maps_with_every_kind_of_broadcast() {
    in_both!(broadcasts);
}

fn sines<T: Scalar>() {
    for n in around(1024).into_iter().chain([33_000, 140_009]) {
        let (mut x, a) = (tensor::<T>(&[n], 1), tensor::<T>(&[1], 2));
        for i in (0..n).filter(|i| i % 3000 == 1023 || *i == n - 1) {
            // An angle that the quick reduction is not for, and that is exact in f32.
            x.as_mut_slice()[i] = T::from_f64(2.0_f64.powi(40) * 1.25);
        }
        let y = map_real!([&x, &a], &Pool::new(), |[x, a]| (x * a).sin() + (x * a).tanh().cos());
        let a = a.item().to_f64();
        let exact = wide(x.as_slice()).into_iter().map(|x| (x * a).sin() + (x * a).tanh().cos());
        close(&format!("{n} sines"), y.as_slice(), 4.0, exact.map(|y| [y, 2.0]));
    }
}

#[test]
fn sine_large_angles_at_block_ends() {
    in_both!(sines);
}

fn slices<T: Scalar>() {
    for n in [0, 1, 15, 16, 17].into_iter().chain(around(32)).chain(around(1024)) {
        let (a, b) = (values::<T>(n + 3, 1), values::<T>(n, 2));
        let what = format!("{n} elements");
        let mut out = vec![T::from_f64(f64::NAN); n];
        let (x, y) = (wide(&a), wide(&b));
        lanes([&a, &b], &mut out, |[a, b]| a * b - a);
        same(&what, &out, (0..n).map(|i| x[i] * y[i] - x[i]));
        out.fill(T::from_f64(f64::NAN));
        lanes_real!(&[&a, &b], &mut out, |[a, b]| a * b - a);
        same(&what, &out, (0..n).map(|i| x[i] * y[i] - x[i]));
        add_assign(&mut out, &b);
        same(&what, &out, (0..n).map(|i| x[i] * y[i] - x[i] + y[i]));
    }
}

#[test]
fn lanes_of_any_length() {
    in_both!(slices);
}
