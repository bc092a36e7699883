//! A training step in parallel tiles, with the same bits for any number of threads and processes.

use crate::exchange::{Exchange, ExchangeError, Frame, Reader};
use crate::{Bound, ParamId, Params};
use raygrad_autograd::{Gradient, ReadSparse, RowGrad, SparseGrad, SparseParts, Tape, Var};
use raygrad_tensor::parallel::locked;
use raygrad_tensor::{Pool, Scalar, Tensor, add_assign, parallel};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::{Arc, Mutex};

/// Number of slots. Gradients are summed within each slot, then those of slots in pairs, the pairs in pairs, and so on.
/// The number is fixed, so that sums do not depend on the number of threads and processes; at most this many threads
/// work at a time. In a step of this many tiles, each slot has one.
pub const SLOTS: usize = 8;

/// Differentiates a training step in tiles, in parallel. A tile is a part of a batch that is small enough for the
/// caches of a core. Each tile has its own tape, which is recorded, differentiated and cleared at once. The gradient of
/// the step is the sum of the tiles' gradients.
///
/// Tiles go to 8 slots in turn. A slot sums its tiles one after another, and the sums of the slots are added in pairs.
/// So the bits are the same for any number of threads. Sparse contributions are not summed, but stay in the order of
/// the tiles. Tapes and scratch data (`S`) are kept from step to step, one for each thread at work. After the first
/// steps no tensor-sized memory is allocated.
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

/// A sparse contribution and the number of its tile.
type Share<T> = (usize, Arc<dyn SparseGrad<T>>);

/// Whether this step has a dense sum, and its buffer.
type Sum<T> = (bool, Option<Tensor<T>>);

/// Sums over the tiles of one slot.
struct Slot<T: Scalar> {
    /// For each parameter that is not frozen: its sum.
    sums: Vec<Sum<T>>,
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
        let readers = BTreeMap::from([(RowGrad::<T>::KIND, RowGrad::read as ReadSparse<T>)]);
        Tiles { slots: (0..SLOTS).map(|_| slot()).collect(), free: Mutex::default(), pool: Pool::new(), readers }
    }

    /// Reads sparse contributions of this [kind](SparseParts::kind) from other processes. That of
    /// [`RowGrad`] is known.
    pub fn with_reader(mut self, kind: &'static str, read: ReadSparse<T>) -> Self {
        self.readers.insert(kind, read);
        self
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
        let results = self.run(params, count, 0..SLOTS, &loss);
        self.add_pairs(|_| true);
        let results = dealt(results).collect();
        TileSums { grads: self.gradients(params), results }
    }

    /// As [`differentiate`](Self::differentiate), with the tiles shared between the processes of an exchange. Each
    /// computes those of its slots and gets the gradient and the results of all, with the bits of a single process.
    ///
    /// All processes need the same parameters, and a loss that depends on the number of the tile and the parameters
    /// alone. If they start with the same parameters and optimizer, they then make the same steps. More than 8
    /// processes do not help: the others have no slot.
    ///
    /// What is sent: dense gradients as sums over slots, sparse ones as their [parts](SparseGrad::to_parts), and the
    /// results.
    ///
    /// ```
    /// use raygrad_autograd::Tensor;
    /// use raygrad_nn::{Exchange, InProcess, Params, Tiles};
    /// let train = |mut exchange: InProcess| {
    ///     let mut params = Params::<f32>::new();
    ///     let x = params.add("x", Tensor::from([1.0, 2.0]));
    ///     let mut tiles = Tiles::<f32>::new();
    ///     let step = tiles.differentiate_across(&mut exchange, &params, 10, |tile, params, ()| {
    ///         ((&params[x] * tile as f64).square().sum(), tile)
    ///     });
    ///     let step = step.unwrap();
    ///     (step.grads[0].dense().unwrap().as_slice().to_vec(), step.results)
    /// };
    /// let ranks: Vec<_> = InProcess::ranks(2).into_iter().map(|rank| std::thread::spawn(move || train(rank))).collect();
    /// for rank in ranks {
    ///     assert_eq!(rank.join().unwrap(), (vec![570.0, 1140.0], (0..10).collect()));
    /// }
    /// ```
    ///
    /// # Errors
    /// If a process is lost, or works with other parameters or another number of tiles. If a sparse contribution cannot be
    /// sent or read.
    ///
    /// # Panics
    /// Where [`Var::backward`](Var::backward) panics.
    #[track_caller]
    pub fn differentiate_across<R: Send + Serialize + DeserializeOwned>(
        &mut self,
        exchange: &mut dyn Exchange,
        params: &Params<T>,
        count: usize,
        loss: impl for<'t> Fn(usize, &Bound<'t, T>, &mut S) -> (Var<'t, T>, R) + Sync,
    ) -> Result<TileSums<T, R>, ExchangeError> {
        let (rank, ranks) = (exchange.rank(), exchange.ranks());
        let own = slots_of(rank, ranks);
        let mut results = self.run(params, count, own.clone(), &loss);
        self.add_pairs(|pair| own.start <= pair.start && pair.end <= own.end);
        let message = self.message(params, count, own, &results).or_else(|error| {
            // The others must not wait for it.
            exchange.all_gather(&[])?;
            Err(error)
        })?;
        for (other, message) in exchange.all_gather(&message)?.iter().enumerate().filter(|(other, _)| *other != rank) {
            self.receive(params, count, slots_of(other, ranks), &mut Reader(message), &mut results)
                .map_err(|what| ExchangeError::Differs { rank: other, what })?;
        }
        let is_inside = |pair: &Range<usize>, rank| {
            let own = slots_of(rank, ranks);
            own.start <= pair.start && pair.end <= own.end
        };
        self.add_pairs(|pair| !(0..ranks).any(|rank| is_inside(&pair, rank)));
        let results = dealt(results).collect();
        Ok(TileSums { grads: self.gradients(params), results })
    }

    /// Differentiates the tiles of these slots. Returns the results of each slot, in the order of its tiles.
    #[track_caller]
    fn run<R: Send>(
        &mut self,
        params: &Params<T>,
        count: usize,
        slots: Range<usize>,
        loss: &(impl for<'t> Fn(usize, &Bound<'t, T>, &mut S) -> (Var<'t, T>, R) + Sync),
    ) -> Vec<Vec<R>> {
        let (free, wanted) = (&self.free, params.trainable().count());
        self.slots.iter_mut().for_each(|slot| slot.begin(wanted));
        let work = |index: usize, slot: &mut Slot<T>| {
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
        let mut results: Vec<Vec<R>> = (0..SLOTS).map(|_| vec![]).collect();
        let used = slots.start..slots.end.min(count).max(slots.start);
        let each = self.slots[used.clone()].iter_mut().zip(&mut results[used.clone()]);
        parallel::each_of(each, |index, (slot, results)| *results = work(used.start + index, slot));
        results
    }

    /// Adds the sums of slots in pairs, the pairs in pairs, and so on, in parallel over parameters: those sums for whose
    /// slots `which` is true.
    fn add_pairs(&mut self, which: impl Fn(Range<usize>) -> bool + Sync) {
        let mut columns: Vec<Vec<&mut Sum<T>>> = self.slots[0].sums.iter().map(|_| vec![]).collect();
        for slot in &mut self.slots {
            columns.iter_mut().zip(&mut slot.sums).for_each(|(column, sum)| column.push(sum));
        }
        parallel::each_of(columns, |_, mut column| {
            for half in [1, 2, 4] {
                for start in (0..SLOTS).step_by(2 * half).filter(|&start| which(start..start + 2 * half)) {
                    let (before, after) = column.split_at_mut(start + half);
                    let (sum, other) = (&mut *before[start], &mut *after[0]);
                    match (&mut *sum, &mut *other) {
                        ((true, Some(sum)), (is_set @ true, Some(other))) => {
                            add_assign(sum.as_mut_slice(), other.as_slice());
                            *is_set = false;
                        }
                        ((false, _), (true, _)) => std::mem::swap(sum, other),
                        _ => {}
                    }
                }
            }
        });
    }

    /// The sums of all slots, after [`add_pairs`](Self::add_pairs).
    fn gradients(&mut self, params: &Params<T>) -> Vec<Gradient<T>> {
        let gradient = |(i, id): (usize, ParamId)| {
            let mut gradient: Gradient<T> = Gradient::zero(params.get(id).shape());
            if let (true, sum) = &mut self.slots[0].sums[i]
                && let Some(sum) = sum.take()
            {
                gradient.add_dense(sum);
            }
            let mut shares: Vec<Share<T>> = self.slots.iter_mut().flat_map(|slot| slot.shares[i].drain(..)).collect();
            shares.sort_by_key(|(tile, _)| *tile);
            shares.into_iter().for_each(|(_, share)| gradient.add_sparse(share));
            gradient
        };
        params.trainable().enumerate().map(gradient).collect()
    }

    /// The results and gradients of these slots, for other processes.
    fn message<R: Serialize>(
        &self,
        params: &Params<T>,
        count: usize,
        slots: Range<usize>,
        results: &[Vec<R>],
    ) -> Result<Vec<u8>, ExchangeError> {
        let mut frame = Frame::default();
        frame.number(count);
        frame.number(params.trainable().count());
        for slot in slots {
            for result in &results[slot] {
                let result = postcard::to_allocvec(result)
                    .map_err(|error| ExchangeError::Connection(format!("a tile's result cannot be sent: {error}")))?;
                frame.bytes(&result);
            }
            let Slot { sums, shares } = &self.slots[slot];
            for ((sum, shares), id) in sums.iter().zip(shares).zip(params.trainable()) {
                match sum {
                    (true, Some(sum)) => {
                        frame.number(1);
                        frame.tensor(sum);
                    }
                    _ => frame.number(0),
                }
                frame.number(shares.len());
                for (tile, share) in shares {
                    let Some(SparseParts { kind, integers, tensors }) = share.to_parts() else {
                        return Err(ExchangeError::NotSent { param: params.name(id).to_owned() });
                    };
                    frame.number(*tile);
                    frame.bytes(kind.as_bytes());
                    frame.integers(&integers);
                    frame.number(tensors.len());
                    tensors.iter().for_each(|tensor| frame.tensor(tensor));
                }
            }
        }
        Ok(frame.0)
    }

    /// Reads the [`message`](Self::message) of another process with these slots.
    fn receive<R: DeserializeOwned>(
        &mut self,
        params: &Params<T>,
        count: usize,
        slots: Range<usize>,
        reader: &mut Reader<'_>,
        results: &mut [Vec<R>],
    ) -> Result<(), String> {
        let damaged = || "has sent a message that cannot be read; start all ranks with the same program".to_owned();
        if reader.0.is_empty() {
            return Err("cannot send its gradients".into());
        }
        let (tiles, trainable) = (reader.number().ok_or_else(damaged)?, reader.number().ok_or_else(damaged)?);
        let own = params.trainable().count();
        if (tiles, trainable) != (count, own) {
            let here = format!("this rank has {count} and {own}");
            return Err(format!("has {tiles} tiles and {trainable} parameters in this step, and {here}"));
        }
        for slot in slots {
            for _ in (slot..count).step_by(SLOTS) {
                let result = reader.bytes().and_then(|bytes| postcard::from_bytes(bytes).ok());
                results[slot].push(result.ok_or_else(damaged)?);
            }
            for (i, id) in params.trainable().enumerate() {
                let (shape, name) = (params.get(id).shape(), params.name(id));
                if reader.number().filter(|is_set| *is_set < 2).ok_or_else(damaged)? == 1 {
                    let sum = reader.tensor().filter(|sum| sum.shape() == shape).ok_or_else(damaged)?;
                    self.slots[slot].sums[i] = (true, Some(sum));
                }
                let shares = reader
                    .sequence(share)
                    .filter(|shares| shares.iter().all(|(tile, _)| *tile < count && tile % SLOTS == slot));
                for (tile, parts) in shares.ok_or_else(damaged)? {
                    let read = self.readers.get(&*parts.kind).ok_or_else(|| {
                        format!("has sent a gradient of kind `{}` for `{name}`: add `Tiles::with_reader`", parts.kind)
                    })?;
                    self.slots[slot].shares[i].push((tile, read(shape, parts).ok_or_else(damaged)?));
                }
            }
        }
        if reader.0.is_empty() { Ok(()) } else { Err(damaged()) }
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

/// The slots of a rank.
fn slots_of(rank: usize, ranks: usize) -> Range<usize> {
    SLOTS * rank / ranks..SLOTS * (rank + 1) / ranks
}

/// The results of slots in the order of their tiles, which were dealt in turn.
fn dealt<R>(results: Vec<Vec<R>>) -> impl Iterator<Item = R> {
    let mut results: Vec<_> = results.into_iter().map(Vec::into_iter).collect();
    (0..).map_while(move |tile: usize| results[tile % SLOTS].next())
}

/// Reads the number of a tile and its sparse contribution.
fn share<T: Scalar>(reader: &mut Reader<'_>) -> Option<(usize, SparseParts<T>)> {
    let tile = reader.number()?;
    let kind = String::from_utf8(reader.bytes()?.to_vec()).ok()?.into();
    let integers = reader.sequence(Reader::integer)?.into();
    let tensors = reader.sequence(Reader::tensor)?;
    Some((tile, SparseParts { kind, integers, tensors }))
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
    use crate::InProcess;

    /// Two matrices, and a table of which few rows are used.
    fn store() -> (Params<f32>, [ParamId; 3]) {
        let mut params = Params::new();
        let value = |i: usize| (i as f32 * 0.37).sin();
        let mut add = |name: &str, shape: [usize; 2]| params.add(name, Tensor::from_fn(&shape, value));
        let ids = [add("a", [6, 3]), add("b", [4, 3]), add("table", [7, 2])];
        (params, ids)
    }

    /// The loss of a tile: of `b` only in every third one.
    fn loss<'t>(tile: usize, params: &Bound<'t, f32>, [a, b, table]: [ParamId; 3]) -> (Var<'t, f32>, f32) {
        let x = Tensor::from_fn(&[4, 6], |i| ((i + 5 * tile) as f32).cos());
        let mut y = params.tape().constant(x).matmul(&params[a]);
        if tile % 3 == 1 {
            y *= &params[b];
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
                let mut sums = raygrad_autograd::RowSums::new(7, 2);
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

    /// Gradients, results and sent bytes of two steps of 21 tiles on each of several ranks.
    fn across(count: usize, frozen: &str) -> Vec<(Vec<Vec<f32>>, Vec<f32>, u64)> {
        let train = |mut exchange: InProcess| {
            let (mut params, ids) = store();
            params.freeze(|name| name == frozen);
            let mut tiles = Tiles::<f32>::new();
            let mut steps = (vec![], vec![], 0);
            for tile_count in [21, 5] {
                let TileSums { grads, results } = tiles
                    .differentiate_across(&mut exchange, &params, tile_count, |tile, params, _| loss(tile, params, ids))
                    .unwrap();
                let table = grads.last().unwrap();
                assert!(table.is_rows() && table.sparse().len() == tile_count);
                let ids: Vec<ParamId> = params.trainable().collect();
                for (grad, id) in grads.iter().zip(ids) {
                    let dense = grad.clone().into_dense(&Pool::none());
                    steps.0.push(dense.as_slice().to_vec());
                    *params.get_mut(id) += &dense;
                }
                steps.1.extend(results);
                tiles.take_back(grads);
            }
            (steps.0, steps.1, exchange.sent_bytes())
        };
        std::thread::scope(|scope| {
            let start = |exchange| scope.spawn(move || train(exchange));
            let ranks: Vec<_> = InProcess::ranks(count).into_iter().map(start).collect();
            ranks.into_iter().map(|rank| rank.join().unwrap()).collect()
        })
    }

    #[test]
    fn tiles_any_processes_give_same_bits() {
        for frozen in ["", "a"] {
            let (mut params, ids) = store();
            params.freeze(|name| name == frozen);
            let mut tiles = Tiles::<f32>::new();
            let mut expected = (vec![], vec![]);
            for tile_count in [21, 5] {
                let step = tiles.differentiate(&params, tile_count, |tile, params, _| loss(tile, params, ids));
                let trainable: Vec<ParamId> = params.trainable().collect();
                for (grad, id) in step.grads.iter().zip(trainable) {
                    let dense = grad.clone().into_dense(&Pool::none());
                    expected.0.push(dense.as_slice().to_vec());
                    *params.get_mut(id) += &dense;
                }
                expected.1.extend(step.results);
            }
            for count in [1, 2, 3, 4, 5, 8, 11] {
                for (rank, (grads, results, sent)) in across(count, frozen).into_iter().enumerate() {
                    assert!((&grads, &results) == (&expected.0, &expected.1), "rank {rank} of {count}");
                    assert_eq!(sent > 0, count > 1);
                }
            }
        }
    }

    /// A contribution that cannot be sent, or one of an unknown kind.
    #[derive(Clone)]
    struct Foreign(Option<&'static str>);

    impl SparseGrad<f32> for Foreign {
        fn shape(&self) -> &[usize] {
            &[7, 2]
        }
        fn add_to(&self, _: &mut Tensor<f32>) {}
        fn to_parts(&self) -> Option<SparseParts<f32>> {
            Some(SparseParts { kind: self.0?.into(), integers: [1, 2].into(), tensors: vec![] })
        }
    }

    #[test]
    fn sparse_gradients_need_parts_and_a_reader() {
        let (params, ids) = store();
        let mut tiles = Tiles::<f32>::new();
        let results = tiles.run(&params, 3, 0..4, &|tile, params, (): &mut ()| loss(tile, params, ids));
        tiles.slots[1].shares[2][0].1 = Arc::new(Foreign(None));
        let error = tiles.message(&params, 3, 0..4, &results).unwrap_err();
        assert_eq!(error, ExchangeError::NotSent { param: "table".into() });
        tiles.slots[1].shares[2][0].1 = Arc::new(Foreign(Some("foreign")));
        let message = tiles.message(&params, 3, 0..4, &results).unwrap();
        let read = |mut tiles: Tiles<f32>| {
            tiles.slots.iter_mut().for_each(|slot| slot.begin(3));
            let mut results = vec![Vec::<f32>::new(); SLOTS];
            tiles.receive(&params, 3, 0..4, &mut Reader(&message), &mut results)
        };
        let error = read(Tiles::new()).unwrap_err();
        assert!(error.contains("of kind `foreign` for `table`"), "{error}");
        let reader: ReadSparse<f32> = |shape, parts| {
            let is_whole = shape == [7, 2] && *parts.integers == [1, 2] && parts.tensors.is_empty();
            is_whole.then(|| Arc::new(Foreign(None)) as Arc<dyn SparseGrad<f32>>)
        };
        read(Tiles::new().with_reader("foreign", reader)).unwrap();
    }

    #[test]
    fn ranks_that_differ_are_named() {
        let train = |mut exchange: InProcess, tile_count: usize| {
            let (params, ids) = store();
            let mut tiles = Tiles::<f32>::new();
            let step = tiles
                .differentiate_across(&mut exchange, &params, tile_count, |tile, params, _| loss(tile, params, ids));
            step.err()
        };
        let errors: Vec<_> = std::thread::scope(|scope| {
            let ranks: Vec<_> = InProcess::ranks(2)
                .into_iter()
                .map(|exchange| (3 + exchange.rank(), exchange))
                .map(|(count, exchange)| scope.spawn(move || train(exchange, count)))
                .collect();
            ranks.into_iter().map(|rank| rank.join().unwrap()).collect()
        });
        for (rank, error) in errors.into_iter().enumerate() {
            let Some(ExchangeError::Differs { rank: other, what }) = error else { panic!("{error:?}") };
            assert!(other == 1 - rank && what.contains(&format!("has {} tiles", 4 - rank)), "{what}");
        }
    }

    #[test]
    fn messages_hold_sums_and_cut_ones_are_refused() {
        let (params, ids) = store();
        let mut tiles = Tiles::<f32>::new();
        let results = tiles.run(&params, 9, 0..4, &|tile, params, (): &mut ()| loss(tile, params, ids));
        let message = tiles.message(&params, 9, 0..4, &results).unwrap();
        let read = |message: &[u8]| {
            let (mut tiles, mut results) = (Tiles::<f32>::new(), vec![Vec::<f32>::new(); SLOTS]);
            tiles.slots.iter_mut().for_each(|slot| slot.begin(3));
            tiles.receive(&params, 9, 0..4, &mut Reader(message), &mut results)
        };
        assert!(read(&message).is_ok());
        for len in 0..message.len() {
            assert!(read(&message[..len]).is_err(), "{len} bytes");
        }
        assert!(read(&[&message[..], &[0]].concat()).is_err(), "a byte too many");
        // The numbers of tiles, of parameters, and of bytes.
        for at in [0, 8, 16] {
            let mut message = message.clone();
            message[at] ^= 1;
            assert!(read(&message).is_err(), "byte {at}");
        }
        // Shares of foreign tiles, and of tiles that do not exist; a sum of another shape; an unknown kind; a missing row.
        let refused = |change: &dyn Fn(&mut Tiles<f32>)| {
            let mut tiles = Tiles::<f32>::new();
            let results = tiles.run(&params, 9, 0..4, &|tile, params, (): &mut ()| loss(tile, params, ids));
            change(&mut tiles);
            read(&tiles.message(&params, 9, 0..4, &results).unwrap()).unwrap_err()
        };
        let rows = |shape: &[usize], row: u32| {
            Arc::new(RowGrad::new(shape, [row].into(), Tensor::<f32>::ones(&[1, shape[1]]))) as Arc<dyn SparseGrad<f32>>
        };
        type Change<'a> = &'a dyn Fn(&mut Tiles<f32>);
        let changes: [(&str, Change<'_>); 5] = [
            ("tile of another slot", &|tiles| tiles.slots[1].shares[2][0].0 = 2),
            ("tile 16 of 9", &|tiles| tiles.slots[0].shares[2][0].0 = 16),
            ("shape of a sum", &|tiles| tiles.slots[0].sums[0].1 = Some(Tensor::ones(&[3, 6]))),
            ("row 7 of 7", &|tiles| tiles.slots[0].shares[2][0].1 = rows(&[8, 2], 7)),
            ("rows of width 3", &|tiles| tiles.slots[0].shares[2][0].1 = rows(&[7, 3], 0)),
        ];
        for (what, change) in changes {
            assert!(refused(change).contains("cannot be read"), "{what}");
        }
        let mut fewer = results.clone();
        fewer[2].clear();
        assert!(read(&tiles.message(&params, 9, 0..4, &fewer).unwrap()).is_err(), "a result is missing");
        // Four slots have a sum of `a`, and one has one of `b`. Of sums over slots, one each is sent.
        tiles.add_pairs(|pair| pair.end <= 4);
        let summed = tiles.message(&params, 9, 0..4, &results).unwrap();
        assert_eq!(message.len() - summed.len(), 3 * (8 * 3 + 4 * 18));
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
