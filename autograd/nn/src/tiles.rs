//! A training step in parallel tiles, with the same bits for any number of threads and processes.

mod across;

use crate::{Bound, Params};
use raygrad_autograd::{Gradient, ReadSparse, RowGrad, Tape, Var};
use raygrad_tensor::parallel::locked;
use raygrad_tensor::{Pool, Scalar, parallel};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Mutex;

/// Differentiates a training step in tiles, in parallel. A tile is a part of a batch that is small enough for the
/// caches of a core. Each tile has its own tape, which is recorded, differentiated and cleared at once. The gradient of
/// the step is the sum of the tiles' gradients.
///
/// Gradients are added in a fixed tree: those of each half of the tiles, then the two sums. So the bits are the same for
/// any number of threads, and as many threads can work as there are tiles. Sparse contributions are not summed, but stay
/// in the order of the tiles. Tapes and scratch data (`S`) are kept from step to step, one for each thread at work. They
/// own the memory of gradients too: after some steps of one process no tensor-sized memory is allocated.
///
/// [`differentiate_across`](Self::differentiate_across) shares the tiles between processes.
///
/// ```
/// use raygrad_autograd::Tensor;
/// use raygrad_nn::{Adam, AdamConfig, Optimizer, Params, Tiles};
/// // Fits a line to 1000 points, 100 in a tile.
/// let points: Vec<[f32; 2]> = (0..1000).map(|i| i as f32 / 1000.0).map(|x| [x, 3.0 * x - 1.0]).collect();
/// let mut params = Params::<f32>::new();
/// let (a, b) = (params.add("a", Tensor::scalar(0.0)), params.add("b", Tensor::scalar(0.0)));
/// let mut adam = Adam::new(AdamConfig::default());
/// let tiles = Tiles::<f32>::new();
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
/// }
/// assert!((params.get(a).item() - 3.0).abs() < 0.01 && (params.get(b).item() + 1.0).abs() < 0.01);
/// ```
pub struct Tiles<T: Scalar, S = ()> {
    /// Tapes and scratch data that no thread is using.
    free: Mutex<Vec<(Tape<T>, S)>>,
    /// How to read sparse contributions of other processes, by the names of their kinds.
    readers: BTreeMap<&'static str, ReadSparse<T>>,
}

/// The result of a step.
pub struct TileSums<T: Scalar, R> {
    /// The gradient of each parameter that is not frozen, in the order of the store, for an
    /// [`Optimizer`](crate::Optimizer). [`Params::grad`] finds that of a handle.
    pub grads: Vec<Gradient<T>>,
    /// The second result of each tile's `loss`, in the order of the tiles.
    pub results: Vec<R>,
}

/// The sum of a range of tiles.
type Part<T, R> = (Range<usize>, TileSums<T, R>);

impl<T: Scalar, S: Default + Send> Default for Tiles<T, S> {
    fn default() -> Self {
        Tiles::new()
    }
}

impl<T: Scalar, S: Default + Send> Tiles<T, S> {
    /// Creates tiles that keep no tapes yet.
    pub fn new() -> Self {
        let readers = BTreeMap::from([(RowGrad::<T>::KIND, RowGrad::read as ReadSparse<T>)]);
        Tiles { free: Mutex::default(), readers }
    }

    /// Computes the gradient of the sum of the losses of `count` tiles.
    ///
    /// `loss` gets the number of the tile, the parameters bound to its tape, and scratch data. It returns the tile's
    /// loss, a scalar on that tape, and any other result. If no operation of a tile depends on a parameter, its loss
    /// may be a constant.
    ///
    /// # Panics
    /// Where [`Var::backward`](Var::backward) panics.
    pub fn differentiate<R: Send>(
        &self,
        params: &Params<T>,
        count: usize,
        loss: impl for<'t> Fn(usize, &Bound<'t, T>, &mut S) -> (Var<'t, T>, R) + Sync,
    ) -> TileSums<T, R> {
        let parts = self.run(params, 0..count, 0..count, &loss);
        parts.into_iter().next().map_or_else(|| TileSums::zero(params), |(_, sums)| sums)
    }

    /// Differentiates the tiles of `range` that are in `own`. Returns the largest sums of the tree that these tiles make,
    /// in their order.
    fn run<R: Send>(
        &self,
        params: &Params<T>,
        range: Range<usize>,
        own: Range<usize>,
        loss: &(impl for<'t> Fn(usize, &Bound<'t, T>, &mut S) -> (Var<'t, T>, R) + Sync),
    ) -> Vec<Part<T, R>> {
        if range.end <= own.start || own.end <= range.start {
            return vec![];
        }
        let Some([left, right]) = halves(&range) else {
            let sums = parallel::serial(|| self.tile(range.start, params, loss));
            return vec![(range, sums)];
        };
        let (mut parts, others) = parallel::join(
            || self.run(params, left.clone(), own.clone(), loss),
            || self.run(params, right.clone(), own.clone(), loss),
        );
        parts.extend(others);
        if own.start <= range.start && range.end <= own.end {
            let sums = parts.into_iter().map(|(_, sums)| sums).reduce(TileSums::add);
            return sums.map(|sums| (range, sums)).into_iter().collect();
        }
        parts
    }

    /// Differentiates a tile.
    fn tile<R>(
        &self,
        tile: usize,
        params: &Params<T>,
        loss: &impl for<'t> Fn(usize, &Bound<'t, T>, &mut S) -> (Var<'t, T>, R),
    ) -> TileSums<T, R> {
        // Not in one line: the lock is given back before `S::default` is called, which may wait for other tiles.
        let kept = locked(&self.free).pop();
        let (mut tape, mut scratch) = kept.unwrap_or_default();
        let bound = params.bind(&tape);
        let (value, result) = loss(tile, &bound, &mut scratch);
        let grads = if bound.vars().is_empty() { vec![] } else { value.tracked().backward(&bound.vars()) };
        drop((value, bound));
        tape.clear();
        locked(&self.free).push((tape, scratch));
        TileSums { grads, results: vec![result] }
    }

    /// Frees memory that no tile has needed since the last call.
    pub fn trim(&self) {
        locked(&self.free).iter().for_each(|(tape, _)| tape.pool().trim());
    }
}

impl<T: Scalar, R> TileSums<T, R> {
    /// The sum of no tiles.
    fn zero(params: &Params<T>) -> Self {
        let grads = params.trainable().map(|id| Gradient::zero(params.get(id).shape())).collect();
        TileSums { grads, results: vec![] }
    }

    /// The sum of these tiles and the `others` that follow.
    fn add(mut self, others: Self) -> Self {
        for (grad, mut other) in self.grads.iter_mut().zip(others.grads) {
            let sparse = other.take_sparse();
            if !other.is_zero() {
                grad.add_dense(other.into_dense(&Pool::none()));
            }
            sparse.into_iter().for_each(|share| grad.add_sparse(share));
        }
        self.results.extend(others.results);
        self
    }
}

/// The two parts of a range of tiles whose sums are added. `None` for a single tile.
fn halves(range: &Range<usize>) -> Option<[Range<usize>; 2]> {
    let middle = range.start + range.len() / 2;
    (range.len() > 1).then_some([range.start..middle, middle..range.end])
}

#[cfg(test)]
mod tests;
