//! Views against ndarray's own, and kernels on views against the same kernels on copies.

use ndarray::{ArrayD, Axis, Slice, SliceInfoElem};
use proptest::prelude::*;
use proptest::test_runner::Config;
use raygrad_tensor::matmul::{Matrix, gemm};
use raygrad_tensor::{Layout, Pool, Tensor, map, s, sum_to};

/// One step from a tensor to a view of it; numbers are taken modulo what there is.
#[derive(Debug, Clone)]
enum Step {
    Turn(usize),
    Swap(usize, usize),
    Cut(usize, usize, usize, isize),
    Pick(usize, usize),
    Flip(usize),
    Stretch(usize, usize),
    Windows(usize, usize, usize),
    Diagonal(isize),
    Flatten(usize),
    Unsqueeze(usize),
}

fn step() -> impl Strategy<Value = Step> {
    let n = 0_usize..8;
    prop_oneof![
        n.clone().prop_map(Step::Turn),
        (n.clone(), n.clone()).prop_map(|(a, b)| Step::Swap(a, b)),
        (n.clone(), n.clone(), n.clone(), prop_oneof![-3_isize..0, 1_isize..4])
            .prop_map(|(a, b, c, d)| Step::Cut(a, b, c, d)),
        (n.clone(), n.clone()).prop_map(|(a, b)| Step::Pick(a, b)),
        n.clone().prop_map(Step::Flip),
        (n.clone(), 1_usize..4).prop_map(|(a, b)| Step::Stretch(a, b)),
        (n.clone(), 1_usize..4, 1_usize..4).prop_map(|(a, b, c)| Step::Windows(a, b, c)),
        (-2_isize..3).prop_map(Step::Diagonal),
        n.clone().prop_map(Step::Flatten),
        n.prop_map(Step::Unsqueeze),
    ]
}

/// The step, taken by the tensor and by ndarray; None where it cannot be.
fn take(x: &Tensor<f64>, a: &ArrayD<f64>, step: &Step) -> Option<(Tensor<f64>, ArrayD<f64>)> {
    let ndim = x.ndim();
    let axis = |i: usize| (ndim > 0).then(|| i % ndim);
    Some(match *step {
        Step::Turn(by) => {
            let mut axes: Vec<usize> = (0..ndim).collect();
            axes.rotate_left(by % ndim.max(1));
            let signed: Vec<isize> = axes.iter().map(|&axis| axis as isize - ndim as isize).collect();
            (x.permute(&signed), a.clone().permuted_axes(axes))
        }
        Step::Swap(i, j) => {
            let (i, j, mut turned) = (axis(i)?, axis(j)?, a.clone());
            turned.swap_axes(i, j);
            (x.transpose(i as isize, j as isize - ndim as isize), turned)
        }
        Step::Cut(i, from, to, by) => {
            let i = axis(i)?;
            let extent = x.shape()[i];
            let (from, to) = (from % (extent + 1), to % (extent + 1));
            let range = from.min(to)..from.max(to);
            let cut = a.slice_axis(Axis(i), Slice::new(range.start as isize, Some(range.end as isize), by)).to_owned();
            let one = x.slice_axis(i as isize, Slice::from(range.clone()).step_by(by));
            // The same by ndarray's notation, with places counted from the end.
            let mut places = vec![SliceInfoElem::Slice { start: 0, end: None, step: 1 }; i + 1];
            let negative = |place: usize| if place == extent { None } else { Some(place as isize - extent as isize) };
            let start = if range.start == extent { extent as isize } else { range.start as isize - extent as isize };
            places[i] = SliceInfoElem::Slice { start, end: negative(range.end), step: by };
            assert_eq!(x.slice(places), one);
            (one, cut)
        }
        Step::Pick(i, j) => {
            let i = axis(i)?;
            let j = j.checked_rem(x.shape()[i])?;
            let mut places = vec![SliceInfoElem::Slice { start: 0, end: None, step: 1 }; i];
            places.push(SliceInfoElem::Index(j as isize - x.shape()[i] as isize));
            (x.slice(places), a.index_axis(Axis(i), j).to_owned())
        }
        Step::Flip(i) => {
            let (i, mut turned) = (axis(i)?, a.clone());
            turned.invert_axis(Axis(i));
            (x.flip(i as isize - ndim as isize), turned)
        }
        Step::Stretch(i, lead) => {
            let i = axis(i)?;
            if x.shape()[i] != 1 {
                return None;
            }
            let mut shape = vec![lead];
            shape.extend_from_slice(x.shape());
            shape[i + 1] = 3;
            (x.broadcast_to(&shape), a.broadcast(shape)?.to_owned())
        }
        Step::Windows(i, size, by) => {
            let i = axis(i)?;
            if x.shape()[i] < size {
                return None;
            }
            let windows: Vec<_> = (0..=x.shape()[i] - size)
                .step_by(by)
                .map(|start| a.slice_axis(Axis(i), Slice::from(start..start + size)).to_owned())
                .collect();
            let views: Vec<_> = windows.iter().map(|window| window.view()).collect();
            // [windows, .., size, ..]: the entries go last, the count where they were.
            let stacked = ndarray::stack(Axis(0), &views).unwrap();
            let mut axes: Vec<usize> = (1..=ndim).collect();
            axes[i] = 0;
            axes.push(i + 1);
            (x.windows(i as isize, size, by), stacked.permuted_axes(axes))
        }
        Step::Diagonal(offset) => {
            if ndim < 2 {
                return None;
            }
            let (rows, columns) = (x.shape()[ndim - 2], x.shape()[ndim - 1]);
            let places: Vec<_> = (0..rows).map(|i| (i, i as isize + offset)).collect();
            let places = places.into_iter().filter(|&(_, j)| j >= 0 && j < columns as isize);
            let entries: Vec<_> = places
                .map(|(i, j)| a.index_axis(Axis(ndim - 2), i).index_axis(Axis(ndim - 2), j as usize).to_owned())
                .collect();
            if entries.is_empty() {
                return None;
            }
            let views: Vec<_> = entries.iter().map(|entry| entry.view()).collect();
            (x.diagonal(offset), ndarray::stack(Axis(ndim - 2), &views).unwrap())
        }
        Step::Flatten(i) => {
            let i = axis(i)?;
            if i + 1 >= ndim {
                return None;
            }
            let mut shape = x.shape().to_vec();
            let extent = shape.remove(i + 1);
            shape[i] *= extent;
            let copy = a.as_standard_layout().into_owned().into_shape_with_order(shape.clone()).unwrap();
            (x.reshape(&shape), copy)
        }
        Step::Unsqueeze(i) => {
            let i = i % (ndim + 1);
            let new = x.unsqueeze(i as isize);
            assert_eq!(new.squeeze(i as isize), *x);
            assert_eq!(new, x.unsqueeze(i as isize - ndim as isize - 1));
            (new, a.clone().insert_axis(Axis(i)))
        }
    })
}

fn config() -> Config {
    Config { cases: 600, ..Config::default() }
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn views_of_views_are_those_of_ndarray(
        shape in prop::collection::vec(1usize..5, 0..4), steps in prop::collection::vec(step(), 0..7)
    ) {
        let mut x = Tensor::from_fn(&shape, |i| i as f64 + 1.0);
        let mut a = x.clone().into_array();
        for step in steps {
            let Some((view, array)) = take(&x, &a, &step) else { continue };
            prop_assert_eq!(view.shape(), array.shape(), "{:?}", step);
            prop_assert_eq!(view.view(), array.view(), "{:?}", step);
            let values: Vec<f64> = array.iter().copied().collect();
            prop_assert_eq!(&view.to_vec(), &values, "{:?}", step);
            prop_assert_eq!(view.as_slice(), &values[..], "{:?}", step);
            // Only where axes are merged that are no single axis to memory is there a copy.
            if x.buffer().len() > 1 && !view.is_empty() && !matches!(step, Step::Flatten(_)) {
                prop_assert_eq!(view.buffer().as_ptr(), x.buffer().as_ptr(), "{:?} copied", step);
            }
            // A layout over all its elements, applied to it, is a view of the view.
            let whole = Layout::contiguous(view.shape());
            prop_assert_eq!(&view.seen_through(&whole), &view);
            if view.ndim() > 1 && !view.is_empty() {
                let axes: Vec<usize> = (0..view.ndim()).rev().collect();
                prop_assert_eq!(view.seen_through(&whole.permuted(&axes)), Tensor::from(array.view().reversed_axes()));
                let last = view.shape()[view.ndim() - 2];
                let turned = whole.permuted(&axes).sliced(1, last - 1, last, -1);
                let back = turned.inverted().unwrap();
                prop_assert_eq!(view.seen_through(&turned).seen_through(&back).reshape(view.shape()), view.clone());
                let first = view.shape()[0];
                prop_assert!(first < 2 || whole.sliced(0, 1, first - 1, 1).inverted().is_none());
                let every = whole.sliced(0, view.shape()[0].saturating_sub(1), view.shape()[0], -1);
                let mut turned = array.clone();
                turned.invert_axis(Axis(0));
                prop_assert_eq!(view.seen_through(&every), Tensor::from(turned));
                // One that steps over the ends of rows.
                let flat = whole.reshaped(&[view.len()]).unwrap();
                if view.len() > 2 {
                    let picked = view.seen_through(&flat.sliced(0, 1, view.len() - 2, 1));
                    prop_assert_eq!(picked.as_slice(), &values[1..values.len() - 1]);
                }
            }
            (x, a) = (view, array);
        }
        let mut owned = x.clone();
        owned.as_mut_slice().iter_mut().for_each(|x| *x = -*x);
        prop_assert_eq!(owned, Tensor::from(a.mapv(|a| -a)));
        prop_assert_eq!(x.view(), a.view());
        prop_assert_eq!(x.into_array(), a);
    }

    #[test]
    fn kernels_make_of_a_view_what_they_make_of_a_copy(
        shape in prop::collection::vec(1usize..5, 0..4), steps in prop::collection::vec(step(), 0..5), mask in 0usize..32
    ) {
        let pool = Pool::new();
        let base = Tensor::from_fn(&shape, |i| (i as f64 * 0.7).sin());
        let (mut x, mut a) = (base.clone(), base.into_array());
        for step in &steps {
            if let Some(next) = take(&x, &a, step) {
                (x, a) = next;
            }
        }
        let copy = Tensor::from(a.as_standard_layout().into_owned());
        prop_assert!(copy.is_packed());
        // Against a packed tensor of the shape, a view of it turned, a number, a row, and itself.
        let other = Tensor::from_fn(x.shape(), |i| 1.0 + (i % 5) as f64);
        let row = Tensor::from_fn(x.shape().last().map_or(&[], std::slice::from_ref), |i| i as f64 - 2.0);
        let f = |[a, b]: [f64; 2]| 3.0 * a - a * b;
        for y in [&other, &x, &row, &Tensor::scalar(0.3)] {
            let got = map([&x, y], &pool, f);
            let expected = map([&copy, &y.packed()], &pool, f);
            prop_assert_eq!(&got, &expected);
        }
        prop_assert_eq!(map([&x], &pool, |[a]| a + 1.0), map([&copy], &pool, |[a]| a + 1.0));
        let mut kept = x.shape().to_vec();
        (0..kept.len()).filter(|axis| mask >> axis & 1 == 1).for_each(|axis| kept[axis] = 1);
        let (got, expected) = (sum_to(&x, &kept, &pool), sum_to(&copy, &kept, &pool));
        prop_assert_eq!(got.shape(), expected.shape());
        for (got, expected) in got.as_slice().iter().zip(expected.as_slice()) {
            prop_assert!((got - expected).abs() <= 1e-12 * x.len().max(1) as f64, "{got} {expected}");
        }
        if x.ndim() > 0 && !x.is_empty() {
            // As many rows as the other axes count.
            let columns = x.shape()[x.ndim() - 1];
            let right = Tensor::from_fn(&[columns, 3], |i| i as f64 - 1.0);
            let (left, expected) = (Matrix::rows_of(&x), Matrix::rows_of(&copy));
            let mut out = [vec![0.0; left.rows() * 3], vec![0.0; left.rows() * 3]];
            gemm(left, Matrix::rows_of(&right), &mut out[0], false);
            gemm(expected, Matrix::rows_of(&right), &mut out[1], false);
            let close = out[0].iter().zip(&out[1]).all(|(a, b)| (a - b).abs() <= 1e-12);
            prop_assert!(close, "{:?}", out);
        }
        prop_assert_eq!(x.cast::<f32>(), copy.cast::<f32>());
    }
}

#[test]
fn large_views_in_every_order() {
    let pool = Pool::new();
    let shape = [67, 130, 75];
    let x = Tensor::<f32>::from_fn(&shape, |i| (i % 1009) as f32);
    for order in [[0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
        let view = x.permute(&order);
        let at = |i: [usize; 3]| {
            let mut j = [0; 3];
            (0..3).for_each(|axis| j[order[axis] as usize] = i[axis]);
            ((j[0] * shape[1] + j[1]) * shape[2] + j[2]) % 1009
        };
        let [a, b, c] = [0, 1, 2].map(|axis| shape[order[axis] as usize]);
        let other = Tensor::<f32>::from_fn(view.shape(), |i| (i % 7) as f32);
        let sum = map([&view, &other], &pool, |[x, y]| x + y);
        let doubled = map([&view], &pool, |[x]| x + x);
        assert!(!doubled.is_packed(), "the result has the order of the view");
        let (packed, sum, doubled) = (view.as_slice(), sum.as_slice(), doubled.as_slice());
        for i in 0..a {
            for j in 0..b {
                for k in 0..c {
                    let (place, expected) = ((i * b + j) * c + k, at([i, j, k]) as f32);
                    assert_eq!(packed[place], expected);
                    assert_eq!(sum[place], expected + (place % 7) as f32);
                    assert_eq!(doubled[place], 2.0 * expected);
                }
            }
        }
    }
}

#[test]
fn what_is_repeated_is_worked_out_once() {
    let pool = Pool::new();
    let one = Tensor::scalar(3.0_f64).broadcast_to(&[1000, 2000]);
    let before = pool.allocated();
    let (y, total) = (map([&one, &Tensor::scalar(2.0)], &pool, |[a, b]| a * b), sum_to(&one, &[2000], &pool));
    assert_eq!((pool.allocated(), y.buffer().len(), total.buffer().len()), (before, 1, 1));
    assert_eq!((y.shape(), y.as_slice()[1_999_999], total.as_slice()[7]), (&[1000, 2000][..], 6.0, 3000.0));
    let row = Tensor::from_fn(&[1, 3], |i| i as f64).broadcast_to(&[5, 3]);
    assert_eq!(sum_to(&row, &[3], &pool).as_slice(), [0.0, 5.0, 10.0]);
    assert_eq!(sum_to(&row.t(), &[3, 1], &pool).as_slice(), [0.0, 5.0, 10.0]);
    assert_eq!(sum_to(&row, &[], &pool).item(), 15.0);
}

#[test]
fn slices_that_do_not_fit_say_so() {
    let x = Tensor::<f32>::zeros(&[2, 3]);
    let message = |f: &dyn Fn(&Tensor<f32>) -> Tensor<f32>| {
        let panic = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| f(&x))).unwrap_err();
        panic.downcast_ref::<String>().cloned().unwrap_or_else(|| panic.downcast_ref::<&str>().unwrap().to_string())
    };
    assert_eq!(message(&|x| x.slice(s![2])), "slice: 2 lies outside axis 0 of a tensor of shape [2, 3]");
    assert_eq!(message(&|x| x.slice(s![.., -4..])), "slice: -4 lies outside axis 1 of a tensor of shape [2, 3]");
    assert_eq!(message(&|x| x.slice(s![.., .., 0])), "slice: 3 axes are named of a tensor of shape [2, 3]");
    assert!(message(&|x| x.permute(&[0, 0])).contains("does not name every axis"));
    assert!(message(&|x| x.flip(2)).contains("no axis 2 in a tensor of shape [2, 3]"));
    assert!(message(&|x| x.broadcast_to(&[3, 3])).contains("cannot broadcast [2, 3] to [3, 3]"));
    assert!(message(&|x| x.reshape(&[4])).contains("reshape of [2, 3]: [4] holds another number of elements than 6"));
    assert!(message(&|x| x.windows(1, 4, 1)).contains("windows of 4 every 1 along axis 1 of [2, 3]: a window has"));
    assert_eq!(x.slice(s![1..1, ..;-2]).shape(), [0, 2]);
    assert_eq!(x.slice(s![ndarray::NewAxis, .., 0, ndarray::NewAxis]).shape(), [1, 2, 1]);
}
