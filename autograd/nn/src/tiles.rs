//! A training step in parallel tiles, with the same bits for any number of threads.

use crate::{Bound, Params};
use raygrad_autograd::{Gradient, SparseGrad, Tape, Var};
use raygrad_tensor::parallel::locked;
use raygrad_tensor::{Pool, Scalar, Tensor, add_assign, parallel};
use std::sync::{Arc, Mutex};

/// Number of slots. Gradients are summed within each slot and then in slot order. The number is fixed, so that sums do
/// not depend on the number of threads; at most this many threads work at a time. In a step of this many tiles, each
/// slot has one.
pub const SLOTS: usize = 8;

/// Differentiates a training step in tiles, in parallel. A tile is a part of a batch that is small enough for the
/// caches of a core. Each tile has its own tape, which is recorded, differentiated and cleared at once. The gradient of
/// the step is the sum of the tiles' gradients.
///
/// Tiles go to 8 slots in turn. A slot sums its tiles one after another, and the sums of the slots are added in order.
/// So the bits are the same for any number of threads. Sparse contributions are not summed, but stay in the order of
/// the tiles. Tapes and scratch data (`S`) are kept from step to step, one for each thread at work. After the first
/// steps no tensor-sized memory is allocated.
///
/// ```
/// use raygrad_autograd::Tensor;
/// use raygrad_nn::{Adam, AdamConfig, Optimizer, Params, Tiles};
/// // Fits a line to 1000 points, 100 in a tile.
/// let points: Vec<[f32; 2]> = (0..1000).map(|i| i as f32 / 1000.0).map(|x| [x, 3.0 * x - 1.0]).collect();
/// let mut params = Params::<f32>::new();
/// let (a, b) = (params.add("a", Tensor::scalar(0.0)), params.add("b", Tensor::scalar(0.0)));
/// let mut adam = Adam::new(AdamConfig::default());
/// let mut tiles = Tiles::<f32>::new();
/// for _ in 0..500 {
///     let step = tiles.differentiate(&params, 10, |tile, params, _| {
///         let part = &points[100 * tile..100 * (tile + 1)];
///         let [x, y] = [0, 1].map(|i| Tensor::from_fn(&[100], |row| part[row][i]));
///         let tape = params.tape();
///         let error = (tape.constant(x) * &params[a] + &params[b] - tape.constant(y)).square().sum() / 1000.0;
///         let value = error.item();
///         (error, value)
///     });
///     let loss: f32 = step.results.iter().sum();
///     assert!(loss < 2.0);
///     adam.update(&mut params, &step.grads, 0.05).check().unwrap();
///     tiles.take_back(step.grads);
/// }
/// assert!((params.get(a).item() - 3.0).abs() < 0.01 && (params.get(b).item() + 1.0).abs() < 0.01);
/// ```
pub struct Tiles<T: Scalar, S = ()> {
    slots: Vec<Slot<T>>,
    /// Tapes and scratch data that no thread is using.
    free: Mutex<Vec<(Tape<T>, S)>>,
    pool: Pool<T>,
}

/// The result of a step.
pub struct TileSums<T: Scalar, R> {
    /// The gradient of each parameter that is not frozen, in order, for an [`Optimizer`](crate::Optimizer).
    pub grads: Vec<Gradient<T>>,
    /// The second result of each tile's `loss`, in the order of the tiles.
    pub results: Vec<R>,
}

/// A sparse contribution and the number of its tile.
type Share<T> = (usize, Arc<dyn SparseGrad<T>>);

/// Sums over the tiles of one slot.
struct Slot<T: Scalar> {
    /// For each parameter that is not frozen: whether this step has a dense sum, and its buffer.
    sums: Vec<(bool, Option<Tensor<T>>)>,
    /// For each parameter that is not frozen, its sparse contributions.
    shares: Vec<Vec<Share<T>>>,
}

impl<T: Scalar, S: Default + Send> Default for Tiles<T, S> {
    fn default() -> Self {
        Tiles::new()
    }
}

impl<T: Scalar, S: Default + Send> Tiles<T, S> {
    /// An empty set of slots, without kept tapes.
    pub fn new() -> Self {
        let slot = || Slot { sums: vec![], shares: vec![] };
        Tiles { slots: (0..SLOTS).map(|_| slot()).collect(), free: Mutex::default(), pool: Pool::new() }
    }

    /// Computes the gradient of the sum of the losses of `count` tiles.
    ///
    /// `loss` gets the number of the tile, the parameters bound to its tape, and scratch data. It returns the tile's
    /// loss, a scalar on that tape, and any other result. If no operation of a tile depends on a parameter, its loss
    /// may be a constant.
    ///
    /// # Panics
    /// Where [`Var::backward`](Var::backward) panics.
    #[track_caller]
    pub fn differentiate<R: Send>(
        &mut self,
        params: &Params<T>,
        count: usize,
        loss: impl for<'t> Fn(usize, &Bound<'t, T>, &mut S) -> (Var<'t, T>, R) + Sync,
    ) -> TileSums<T, R> {
        let (free, wanted) = (&self.free, params.trainable().count());
        let used = count.min(SLOTS);
        let work = |index: usize, slot: &mut Slot<T>| {
            slot.begin(wanted);
            let (mut tape, mut scratch) = locked(free).pop().unwrap_or_default();
            let tiles = (index..count).step_by(SLOTS);
            let results: Vec<R> = tiles
                .map(|tile| {
                    parallel::serial(|| slot.add(tile, params, &mut tape, |params| loss(tile, params, &mut scratch)))
                })
                .collect();
            locked(free).push((tape, scratch));
            results
        };
        let mut results: Vec<Vec<R>> = (0..used).map(|_| vec![]).collect();
        let slots = self.slots[..used].iter_mut().zip(&mut results);
        parallel::each_of(slots, |index, (slot, results)| *results = work(index, slot));
        // In the order of the tiles, which were dealt in turn.
        let mut results: Vec<_> = results.into_iter().map(Vec::into_iter).collect();
        let results = (0..count).filter_map(|tile| results[tile % SLOTS].next()).collect();
        TileSums { grads: self.sums(params, used), results }
    }

    /// Sums the slots in order, in parallel over parameters.
    fn sums(&mut self, params: &Params<T>, used: usize) -> Vec<Gradient<T>> {
        let shapes: Vec<_> = params.trainable().map(|id| params.get(id).shape()).collect();
        let Some((first, rest)) = self.slots[..used].split_first_mut() else {
            return shapes.into_iter().map(Gradient::zero).collect();
        };
        parallel::each_of(&mut first.sums, |i, (is_set, sum)| {
            for (_, other) in rest.iter().map(|slot| &slot.sums[i]).filter(|(is_set, _)| *is_set) {
                match (&mut *sum, other) {
                    (Some(sum), Some(other)) if *is_set => add_assign(sum.as_mut_slice(), other.as_slice()),
                    (Some(sum), Some(other)) if sum.shape() == other.shape() => {
                        sum.as_mut_slice().copy_from_slice(other.as_slice());
                    }
                    (sum, other) => *sum = other.clone(),
                }
                *is_set = true;
            }
        });
        let gradient = |(i, shape): (usize, &[usize])| {
            let mut gradient = Gradient::zero(shape);
            if let (true, sum) = &mut self.slots[0].sums[i]
                && let Some(sum) = sum.take()
            {
                gradient.add_dense(sum);
            }
            let mut shares: Vec<Share<T>> =
                self.slots[..used].iter_mut().flat_map(|slot| slot.shares[i].drain(..)).collect();
            shares.sort_by_key(|(tile, _)| *tile);
            shares.into_iter().for_each(|(_, share)| gradient.add_sparse(share));
            gradient
        };
        shapes.into_iter().enumerate().map(gradient).collect()
    }

    /// Reuses the memory of gradients for the next step.
    pub fn take_back(&mut self, grads: Vec<Gradient<T>>) {
        for ((_, sum), grad) in self.slots[0].sums.iter_mut().zip(grads) {
            if grad.dense().is_some() && grad.is_dense() {
                *sum = Some(grad.into_dense(&self.pool));
            }
        }
    }

    /// Frees memory that no tile has needed since the last call.
    pub fn trim(&self) {
        locked(&self.free).iter().for_each(|(tape, _)| tape.pool().trim());
    }
}

impl<T: Scalar> Slot<T> {
    /// Clears the sums of the last step.
    fn begin(&mut self, wanted: usize) {
        if self.sums.len() != wanted {
            self.sums = vec![(false, None); wanted];
            self.shares = vec![vec![]; wanted];
        }
        self.sums.iter_mut().for_each(|(is_set, _)| *is_set = false);
        self.shares.iter_mut().for_each(Vec::clear);
    }

    /// Differentiates a tile and adds its gradients to the sums.
    #[track_caller]
    fn add<R>(
        &mut self,
        tile: usize,
        params: &Params<T>,
        tape: &mut Tape<T>,
        loss: impl for<'t> FnOnce(&Bound<'t, T>) -> (Var<'t, T>, R),
    ) -> R {
        let bound = params.bind(tape);
        let (loss, result) = loss(&bound);
        let grads = if bound.vars().is_empty() { vec![] } else { loss.tracked().backward(&bound.vars()) };
        for (((is_set, sum), shares), mut grad) in self.sums.iter_mut().zip(&mut self.shares).zip(grads) {
            shares.extend(grad.take_sparse().into_iter().map(|share| (tile, share)));
            // A parameter that the tile does not use has no gradient.
            if grad.is_zero() {
                continue;
            }
            let grad = grad.into_dense(tape.pool());
            match sum {
                Some(sum) if *is_set => add_assign(sum.as_mut_slice(), grad.as_slice()),
                Some(sum) if sum.shape() == grad.shape() => sum.as_mut_slice().copy_from_slice(grad.as_slice()),
                _ => *sum = Some(grad),
            }
            *is_set = true;
        }
        drop((loss, bound));
        tape.clear();
        result
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ParamId;

    /// Two matrices, and a table of which few rows are used.
    fn store() -> (Params<f32>, [ParamId; 3]) {
        let mut params = Params::new();
        let value = |i: usize| (i as f32 * 0.37).sin();
        let ids = ["a", "b", "table"].map(|name| params.add(name, Tensor::from_fn(&[6, 3], value)));
        (params, ids)
    }

    /// The loss of a tile: of `b` only in every third one.
    fn loss<'t>(tile: usize, params: &Bound<'t, f32>, [a, b, table]: [ParamId; 3]) -> (Var<'t, f32>, f32) {
        let x = Tensor::from_fn(&[4, 6], |i| ((i + 5 * tile) as f32).cos());
        let mut y = params.tape().constant(x).matmul(&params[a]);
        if tile % 3 == 1 {
            y *= params[b].slice_axis(0, ..4);
        }
        let rows = params[table].gather_rows([tile as u32 % 6, 2]).sum();
        let loss = y.square().sum() + rows.square();
        let value = loss.item();
        (loss, value)
    }

    #[test]
    fn tiled_gradient_equals_sum_of_tiles() {
        let (params, ids) = store();
        let mut tiles = Tiles::<f32>::new();
        for count in [1, 3, 8, 19, 2, 0] {
            let TileSums { grads, results } =
                tiles.differentiate(&params, count, |tile, params, _| loss(tile, params, ids));
            let tape = Tape::new();
            let bound = params.bind(&tape);
            let all: Vec<_> = (0..count).map(|tile| loss(tile, &bound, ids)).collect();
            assert_eq!(results, all.iter().map(|(_, value)| *value).collect::<Vec<_>>());
            let Some(sum) = all.into_iter().map(|(loss, _)| loss).reduce(|a, b| a + b) else {
                assert!(grads.iter().all(Gradient::is_zero) && grads.len() == 3);
                continue;
            };
            let expected = sum.backward(&bound.vars());
            assert_eq!(grads.len(), 3);
            assert!(grads[2].is_rows() && grads[2].sparse().len() == count && grads[1].is_zero() == (count < 2));
            for (tile, share) in grads[2].sparse().iter().enumerate() {
                let mut sums = raygrad_autograd::RowSums::new(6, 3);
                share.as_rows().unwrap().scatter(&mut sums);
                assert_eq!(sums.rows()[0], tile as u32 % 6, "in the order of the tiles");
            }
            for (grad, expected) in grads.iter().zip(expected) {
                let (grad, expected) = (grad.clone().into_dense(&Pool::none()), expected.into_dense(&Pool::none()));
                let pairs = grad.as_slice().iter().zip(expected.as_slice());
                let worst = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, raygrad_tensor::Real::maximum);
                assert!(worst <= 1e-4, "{count} tiles: {worst}");
            }
            tiles.take_back(grads);
        }
    }

    #[test]
    fn another_model_may_follow() {
        let mut tiles = Tiles::<f64>::new();
        for shape in [[2, 3], [3, 2], [4, 5], [2, 3]] {
            let mut params = Params::new();
            let x = params.add("x", Tensor::ones(&shape));
            let step = tiles.differentiate(&params, 10, |_, params, _| (params[x].square().sum(), ()));
            assert_eq!(step.grads[0].shape(), shape);
            assert_eq!(step.grads[0].dense().unwrap(), &Tensor::full(&shape, 20.0));
            tiles.take_back(step.grads);
        }
    }

    #[test]
    fn tiles_any_threads_give_same_bits() {
        let (mut params, ids) = store();
        params.freeze(|name| name == "b");
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut tiles = Tiles::<f32, Vec<usize>>::new();
            let step = |tiles: &mut Tiles<f32, Vec<usize>>| {
                let step = tiles.differentiate(&params, 21, |tile, params, seen| {
                    seen.push(tile); // kept from tile to tile
                    loss(tile, params, ids)
                });
                let dense: Vec<Vec<f32>> =
                    step.grads.iter().map(|grad| grad.clone().into_dense(&Pool::none()).as_slice().to_vec()).collect();
                tiles.take_back(step.grads);
                (dense, step.results)
            };
            let both = pool.install(|| [step(&mut tiles), step(&mut tiles)]);
            let seen: usize = locked(&tiles.free).iter().map(|(_, seen)| seen.len()).sum();
            assert!(seen == 42 && locked(&tiles.free).len() <= threads);
            both
        };
        let [first, second] = run(1);
        assert!(first == second && first.0.len() == 2);
        for threads in [2, 3, 8] {
            assert!(run(threads) == [first.clone(), second.clone()], "{threads} threads");
        }
    }
}
