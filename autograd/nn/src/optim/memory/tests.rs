//! Lazy parameters, in Adam's hands.

use super::*;
use crate::{Adam, AdamConfig, AdamW, Optimizer};
use raygrad_autograd::{Gradient, RowGrad, RowShare, SparseGrad};
use raygrad_tensor::Tensor;
use std::sync::Arc;

/// A table alone in a store, and its optimizer.
struct Alone<T: Scalar> {
    params: Params<T>,
    adam: Adam<T>,
}

impl<T: Scalar> Alone<T> {
    fn new(adam: Adam<T>, shape: [usize; 2], value: f64, lazy: bool) -> Self {
        let mut params = Params::new();
        params.add("table", Tensor::full(&shape, T::from_f64(value)));
        params.set_lazy(|_| true, lazy);
        Alone { params, adam }
    }

    fn lazy(config: AdamConfig, shape: [usize; 2], value: f64) -> Self {
        Alone::new(Adam::new(config), shape, value, true)
    }

    fn values(&self) -> &[T] {
        self.params.values()[0].as_slice()
    }

    fn update(&mut self, grad: impl Into<Gradient<T>>, rate: f64) -> UpdateReport {
        self.adam.update(&mut self.params, &[grad.into()], rate)
    }

    /// A step against a dense gradient.
    fn against(&mut self, grad: &[T], rate: f64) -> UpdateReport {
        self.update(Tensor::from_vec(self.params.values()[0].shape(), grad.to_vec()), rate)
    }
}

/// A gradient of these rows, of one number each.
fn rows<T: Scalar>(table_rows: usize, rows: &[(u32, T)]) -> Gradient<T> {
    let (index, values): (Vec<_>, Vec<_>) = rows.iter().copied().unzip();
    shared(&[table_rows, 1], RowGrad::new(&[table_rows, 1], index.into(), Tensor::from_vec(&[values.len(), 1], values)))
}

fn shared<T: Scalar>(shape: &[usize], share: impl SparseGrad<T>) -> Gradient<T> {
    let mut grad = Gradient::zero(shape);
    grad.add_sparse(Arc::new(share));
    grad
}

#[test]
fn equals_dense_adam_where_every_row_has_a_gradient() {
    let shapes = [[21, 1], [8, 2], [13, 4], [30, 8], [5, 3], [1, 70], [3, 24]];
    for (shape, decay) in shapes.into_iter().flat_map(|shape| [(shape, 0.0), (shape, 0.5)]) {
        let config = AdamConfig { beta2: 0.99, eps: 1e-15, ..AdamConfig::default() };
        let [mut lazy, mut dense] =
            [true, false].map(|lazy| Alone::<f32>::new(AdamW::new(config, decay), shape, 0.5, lazy));
        let len = shape[0] * shape[1];
        for t in 1..=1500 {
            let grad: Vec<f32> = (0..len).map(|i| ((i * 7 + t * 13) as f32).sin() + 1e-3).collect();
            assert_eq!(dense.against(&grad, 1e-3).check(), Ok(len));
            assert_eq!(lazy.against(&grad, 1e-3).check(), Ok(len));
        }
        for (got, expected) in lazy.values().iter().zip(dense.values()) {
            assert!((got - expected).abs() <= 1e-5, "{got} instead of {expected}");
        }
    }
}

#[test]
fn lazy_row_counts_its_own_steps() {
    // One row gets a gradient at every third step, the other at every step: lazily, both take the same way.
    let gradient = |t: usize| (0.3 * t as f64).sin() + 0.1;
    let run = |every: usize| {
        let mut table = Alone::<f64>::lazy(AdamConfig::default(), [9, 1], 0.0);
        for t in 0..60 * every {
            let used = if t % every == 0 { vec![(8, gradient(t / every))] } else { vec![] };
            table.update(rows(9, &used), 0.01).check().unwrap();
        }
        table.values().to_vec()
    };
    assert_eq!(run(1), run(3));
    // The documented recurrence.
    let (mut m, mut v, mut x) = (0.0, 0.0, 0.0);
    for t in 1..=60 {
        let g = gradient(t - 1);
        (m, v) = (0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g);
        let (first, second) = (m / (1.0 - 0.9_f64.powi(t as i32)), v / (1.0 - 0.999_f64.powi(t as i32)));
        x -= 0.01 * first / (second.sqrt() + 1e-8);
    }
    assert!((run(1)[8] - x).abs() <= 1e-12);
}

/// Elements whose gradient or new value is not finite rest alone, in a lazy table as in a dense one.
#[test]
fn lazy_rows_without_gradient_rest() {
    for lazy in [true, false] {
        let mut table = Alone::<f32>::new(Adam::new(AdamConfig::default()), [16, 2], 1.0, lazy);
        let mut grad = [0.0; 32];
        (grad[2], grad[7], grad[9]) = (1.0, f32::NAN, f32::INFINITY);
        let report = table.against(&grad, 0.1);
        // Rows 1, 3 and 4 have a gradient.
        assert_eq!((report.updated, report.skipped), (if lazy { 4 } else { 30 }, 2));
        let moved: Vec<_> = (0..32).filter(|&i| table.values()[i] != 1.0).collect();
        assert_eq!(moved, [2], "row 1 moves, and in it the element that has a gradient");
        let state = table.adam.state(&table.params);
        assert!([7, 9].iter().all(|&i| state.tensors.values().all(|numbers| numbers.as_slice()[i] == 0.0)));
        let report = table.against(&[0.0; 32], 0.1);
        assert_eq!(report.check(), Ok(if lazy { 0 } else { 32 }));
        // A step that would overflow is not taken.
        let mut table = Alone::<f32>::new(Adam::new(AdamConfig::default()), [2, 1], f64::from(f32::MAX), lazy);
        table.params.set_lr_scale(|_| true, 1e30);
        let report = table.against(&[-1.0, 1.0], 1e7);
        assert_eq!((report.updated, report.skipped), (1, 1));
        assert!(table.values()[0] == f32::MAX && table.values()[1].is_finite(), "{:?}", table.values());
        table.params.set_lr_scale(|_| true, f64::MAX);
        assert_eq!(table.against(&[-1.0, 1.0], 1.0).skipped, 2);
    }
}

#[test]
fn extreme_gradients_keep_steps_bounded() {
    let mut table = Alone::<f32>::lazy(AdamConfig { eps: 1e-15, ..AdamConfig::default() }, [8, 1], 0.0);
    let gradients = [1e-30, 1e-10, 1e30, -1e30, 1.0, f32::MIN_POSITIVE, 1e-42, 0.0];
    for _ in 0..1000 {
        let before = table.values().to_vec();
        table.against(&gradients, 1.0).check().unwrap();
        let near = table.values().iter().zip(before).all(|(x, before)| (x - before).abs() <= 3.2);
        assert!(near, "{:?}", table.values());
    }
    let state = table.adam.state(&table.params);
    assert!(state.tensors.values().flat_map(Tensor::as_slice).all(|m| !m.is_subnormal()), "{state:?}");
    // Nor does decay leave any.
    let mut table = Alone::new(AdamW::new(AdamConfig::default(), 0.5e30), [8, 1], 1e-37, true);
    for _ in 0..10 {
        table.against(&[1e-30_f32; 8], 1e-30).check().unwrap();
        assert!(table.values().iter().all(|x| !x.is_subnormal()), "{:?}", table.values());
    }
}

/// A share of every second row of a table in three parts, or in one.
struct InParts {
    step: usize,
    whole: bool,
}

const SIZES: [usize; 3] = [5, 300, 4];

impl InParts {
    fn add(&self, part: usize, offset: usize, sums: &mut RowSums<f32>) {
        let first: usize = SIZES[..part].iter().sum();
        for row in (0..SIZES[part]).step_by(2) {
            let place = (first + row) * 7 + self.step;
            sums.add(offset + row, &[place as f32 % 5.0 - 2.0, 1.0 + (first + row) as f32]);
        }
    }
}

impl SparseGrad<f32> for InParts {
    fn shape(&self) -> &[usize] {
        &[309, 2]
    }
    fn add_to(&self, _: &mut Tensor<f32>) {}
    fn as_rows(&self) -> Option<&dyn RowShare<f32>> {
        Some(self)
    }
}

impl RowShare<f32> for InParts {
    fn scatter(&self, sums: &mut RowSums<f32>) {
        (0..3).for_each(|part| self.add(part, SIZES[..part].iter().sum(), sums));
    }
    fn parts(&self) -> Vec<usize> {
        if self.whole { vec![] } else { SIZES.to_vec() }
    }
    fn scatter_part(&self, part: usize, sums: &mut RowSums<f32>) {
        self.add(part, 0, sums);
    }
}

#[test]
fn parts_share_a_table() {
    let run = |whole: bool| {
        let mut table = Alone::<f32>::lazy(AdamConfig::default(), [309, 2], 0.25);
        for step in 0..3 {
            assert_eq!(table.update(shared(&[309, 2], InParts { step, whole }), 0.1).check(), Ok(2 * (3 + 150 + 2)));
        }
        (table.values().to_vec(), table.adam.state(&table.params))
    };
    assert_eq!(run(false), run(true));
}

/// Puts sums of its own in the place of those of the first of two parts of two rows.
struct Replaced([usize; 2]);

impl SparseGrad<f32> for Replaced {
    fn shape(&self) -> &[usize] {
        &[4, 2]
    }
    fn add_to(&self, _: &mut Tensor<f32>) {}
    fn as_rows(&self) -> Option<&dyn RowShare<f32>> {
        Some(self)
    }
}

impl RowShare<f32> for Replaced {
    fn scatter(&self, _: &mut RowSums<f32>) {}
    fn parts(&self) -> Vec<usize> {
        vec![2, 2]
    }
    fn scatter_part(&self, part: usize, sums: &mut RowSums<f32>) {
        let [rows, features] = if part == 0 { self.0 } else { [2, 2] };
        *sums = RowSums::new(rows, features);
        sums.add(rows - 1, &vec![1.0; features]);
    }
}

#[test]
fn sums_of_another_size_are_refused() {
    let replace = |size: [usize; 2]| {
        let mut table = Alone::<f32>::lazy(AdamConfig::default(), [4, 2], 1.0);
        table.update(shared(&[4, 2], Replaced(size)), 0.1)
    };
    for other in [[4, 2], [3, 2], [1, 2], [2, 1], [2, 4]] {
        let error = std::panic::catch_unwind(|| replace(other)).expect_err("sums of another size");
        let message = error.downcast_ref::<String>().map_or("", String::as_str);
        assert!(message.contains("rows and features of part 0 of `table`"), "{message}");
    }
    // Others of the same size are as good.
    assert_eq!(replace([2, 2]).check(), Ok(4));
}

#[test]
fn tasks_share_a_table() {
    // More rows than one task takes, backwards: each is moved once, by any task.
    let count = 3 * ROWS + 5;
    let values: Vec<_> = (0..count as u32).rev().map(|row| (row, if row % 2 == 0 { 1.0 } else { -1.0 })).collect();
    let mut table = Alone::<f32>::lazy(AdamConfig::default(), [count, 1], 0.0);
    assert_eq!(table.update(rows(count, &values), 0.5).check(), Ok(count));
    assert!(table.values().chunks(2).all(|pair| (pair[0] + 0.5).abs() < 1e-6));
    assert!(table.values().iter().skip(1).step_by(2).all(|x| (x - 0.5).abs() < 1e-6));
}
