//! A training step in parallel tiles, with the same bits for any number of threads and processes.

use crate::exchange::{Exchange, ExchangeError, Frame, Reader};
use crate::{Bound, Params};
use raygrad_autograd::{Gradient, ReadSparse, RowGrad, SparseParts, Tape, Var};
use raygrad_tensor::parallel::locked;
use raygrad_tensor::{Pool, Scalar, parallel};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::iter::Peekable;
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
    pub fn differentiate<R: Send>(
        &self,
        params: &Params<T>,
        count: usize,
        loss: impl for<'t> Fn(usize, &Bound<'t, T>, &mut S) -> (Var<'t, T>, R) + Sync,
    ) -> TileSums<T, R> {
        let parts = self.run(params, 0..count, 0..count, &loss);
        parts.into_iter().next().map_or_else(|| TileSums::zero(params), |(_, sums)| sums)
    }

    /// As [`differentiate`](Self::differentiate), with the tiles shared between the processes of an exchange. Each
    /// computes a part of the tiles and gets the gradient and the results of all, with the bits of a single process.
    ///
    /// All processes need the same parameters, and a loss that depends on the number of the tile and the parameters
    /// alone. If they start with the same parameters and optimizer, they then make the same steps. Processes beyond the
    /// number of tiles do not help.
    ///
    /// What is sent: the largest sums of dense gradients in the tree that the tiles of a process make, sparse gradients
    /// as their [parts](raygrad_autograd::SparseGrad::to_parts), and the results.
    ///
    /// ```
    /// use raygrad_autograd::Tensor;
    /// use raygrad_nn::{Exchange, InProcess, Params, Tiles};
    /// let train = |mut exchange: InProcess| {
    ///     let mut params = Params::<f32>::new();
    ///     let x = params.add("x", Tensor::from([1.0, 2.0]));
    ///     let tiles = Tiles::<f32>::new();
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
    pub fn differentiate_across<R: Send + Serialize + DeserializeOwned>(
        &self,
        exchange: &mut dyn Exchange,
        params: &Params<T>,
        count: usize,
        loss: impl for<'t> Fn(usize, &Bound<'t, T>, &mut S) -> (Var<'t, T>, R) + Sync,
    ) -> Result<TileSums<T, R>, ExchangeError> {
        let (rank, ranks) = (exchange.rank(), exchange.ranks());
        let own = self.run(params, 0..count, tiles_of(rank, ranks, count), &loss);
        let message = message(params, count, &own).or_else(|error| {
            // The others must not wait for it.
            exchange.all_gather(&[])?;
            Err(error)
        })?;
        let (mut parts, mut own) = (vec![], Some(own));
        for (other, message) in exchange.all_gather(&message)?.iter().enumerate() {
            let received = match own.take_if(|_| other == rank) {
                Some(own) => Ok(own),
                None => self.receive(params, count, tiles_of(other, ranks, count), &mut Reader(message)),
            };
            parts.extend(received.map_err(|what| ExchangeError::Differs { rank: other, what })?);
        }
        let mut parts = parts.into_iter().peekable();
        Ok(joined(0..count, &mut parts, params))
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

    /// Reads the [`message`] of another process with these tiles.
    fn receive<R: DeserializeOwned>(
        &self,
        params: &Params<T>,
        count: usize,
        own: Range<usize>,
        reader: &mut Reader<'_>,
    ) -> Result<Vec<Part<T, R>>, String> {
        let damaged = || "has sent a message that cannot be read; start all ranks with the same program".to_owned();
        if reader.0.is_empty() {
            return Err("cannot send its gradients".into());
        }
        let (tiles, trainable) = (reader.number().ok_or_else(damaged)?, reader.number().ok_or_else(damaged)?);
        let here = params.trainable().count();
        if (tiles, trainable) != (count, here) {
            let here = format!("this rank has {count} and {here}");
            return Err(format!("has {tiles} tiles and {trainable} parameters in this step, and {here}"));
        }
        let mut parts = vec![];
        for range in parts_of(0..count, &own) {
            let mut sums = TileSums::zero(params);
            for _ in range.clone() {
                let result = reader.bytes().and_then(|bytes| postcard::from_bytes(bytes).ok());
                sums.results.push(result.ok_or_else(damaged)?);
            }
            for (grad, id) in sums.grads.iter_mut().zip(params.trainable()) {
                let (shape, name) = (params.get(id).shape(), params.name(id));
                if reader.number().filter(|is_set| *is_set < 2).ok_or_else(damaged)? == 1 {
                    grad.add_dense(reader.tensor().filter(|sum| sum.shape() == shape).ok_or_else(damaged)?);
                }
                for parts in reader.sequence(sparse_parts).ok_or_else(damaged)? {
                    let read = self.readers.get(&*parts.kind).ok_or_else(|| {
                        format!("has sent a gradient of kind `{}` for `{name}`: add `Tiles::with_reader`", parts.kind)
                    })?;
                    grad.add_sparse(read(shape, parts).ok_or_else(damaged)?);
                }
            }
            parts.push((range, sums));
        }
        if reader.0.is_empty() { Ok(parts) } else { Err(damaged()) }
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

/// The tiles of a rank.
fn tiles_of(rank: usize, ranks: usize, count: usize) -> Range<usize> {
    count * rank / ranks..count * (rank + 1) / ranks
}

/// The largest ranges of the tree below `range` that are in `own`.
fn parts_of(range: Range<usize>, own: &Range<usize>) -> Vec<Range<usize>> {
    if own.start <= range.start && range.end <= own.end && !range.is_empty() {
        return vec![range];
    }
    let inside = halves(&range).filter(|_| range.start < own.end && own.start < range.end);
    inside.into_iter().flatten().flat_map(|half| parts_of(half, own)).collect()
}

/// The sum of the parts of a range, which come in their order.
fn joined<T: Scalar, R>(
    range: Range<usize>,
    parts: &mut Peekable<impl Iterator<Item = Part<T, R>>>,
    params: &Params<T>,
) -> TileSums<T, R> {
    match (parts.next_if(|(part, _)| *part == range), halves(&range)) {
        (Some((_, sums)), _) => sums,
        (None, Some([left, right])) => joined(left, parts, params).add(joined(right, parts, params)),
        (None, None) => TileSums::zero(params),
    }
}

/// The sums of a process, for other processes.
fn message<T: Scalar, R: Serialize>(
    params: &Params<T>,
    count: usize,
    parts: &[Part<T, R>],
) -> Result<Vec<u8>, ExchangeError> {
    let mut frame = Frame::default();
    frame.number(count);
    frame.number(params.trainable().count());
    for (_, TileSums { grads, results }) in parts {
        for result in results {
            let result = postcard::to_allocvec(result)
                .map_err(|error| ExchangeError::Connection(format!("a tile's result cannot be sent: {error}")))?;
            frame.bytes(&result);
        }
        for (grad, id) in grads.iter().zip(params.trainable()) {
            frame.number(grad.dense().is_some().into());
            grad.dense().into_iter().for_each(|sum| frame.tensor(sum));
            frame.number(grad.sparse().len());
            for share in grad.sparse() {
                let Some(SparseParts { kind, integers, tensors }) = share.to_parts() else {
                    return Err(ExchangeError::NotSent { param: params.name(id).to_owned() });
                };
                frame.bytes(kind.as_bytes());
                frame.integers(&integers);
                frame.number(tensors.len());
                tensors.iter().for_each(|tensor| frame.tensor(tensor));
            }
        }
    }
    Ok(frame.0)
}

/// Reads a sparse contribution.
fn sparse_parts<T: Scalar>(reader: &mut Reader<'_>) -> Option<SparseParts<T>> {
    let kind = String::from_utf8(reader.bytes()?.to_vec()).ok()?.into();
    let integers = reader.sequence(Reader::integer)?.into();
    let tensors = reader.sequence(Reader::tensor)?;
    Some(SparseParts { kind, integers, tensors })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{InProcess, ParamId};
    use raygrad_autograd::SparseGrad;
    use raygrad_tensor::Tensor;
    use std::sync::Arc;

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
        let tiles = Tiles::<f32>::new();
        for count in [1, 3, 8, 100, 19, 2, 0] {
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
                assert!(worst <= 1e-5 * 10.max(count) as f32, "{count} tiles: {worst}");
            }
        }
    }

    #[test]
    fn halves_are_added_first() {
        let mut params = Params::new();
        let x = params.add("x", Tensor::scalar(1.0_f32));
        let v = [1e8, 1.0, -1e8, 0.3, 5.7, 1e7, 0.01, -1e7];
        let sum = |count: usize| {
            let step = Tiles::<f32>::new()
                .differentiate(&params, count, |tile, params, ()| (&params[x] * f64::from(v[tile]), ()));
            step.grads[0].dense().unwrap().item()
        };
        assert_eq!(sum(8), ((v[0] + v[1]) + (v[2] + v[3])) + ((v[4] + v[5]) + (v[6] + v[7])));
        assert_eq!(sum(5), (v[0] + v[1]) + (v[2] + (v[3] + v[4])));
    }

    #[test]
    fn another_model_may_follow() {
        let tiles = Tiles::<f64>::new();
        for shape in [[2, 3], [3, 2], [4, 5], [2, 3]] {
            let mut params = Params::new();
            let x = params.add("x", Tensor::ones(&shape));
            let step = tiles.differentiate(&params, 10, |_, params, _| (params[x].square().sum(), ()));
            assert_eq!(step.grads[0].shape(), shape);
            assert_eq!(step.grads[0].dense().unwrap(), &Tensor::full(&shape, 20.0));
        }
    }

    /// Gradients, results and sent bytes of steps of 21, 5 and 0 tiles, on each of several ranks.
    fn across(count: usize, frozen: &str) -> Vec<(Vec<Vec<f32>>, Vec<f32>, u64)> {
        let train = |mut exchange: InProcess| {
            let (mut params, ids) = store();
            params.freeze(|name| name == frozen);
            let tiles = Tiles::<f32>::new();
            let mut steps = (vec![], vec![], 0);
            for tile_count in [21, 5, 0] {
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
            let tiles = Tiles::<f32>::new();
            let mut expected = (vec![], vec![]);
            for tile_count in [21, 5, 0] {
                let step = tiles.differentiate(&params, tile_count, |tile, params, _| loss(tile, params, ids));
                let trainable: Vec<ParamId> = params.trainable().collect();
                for (grad, id) in step.grads.iter().zip(trainable) {
                    let dense = grad.clone().into_dense(&Pool::none());
                    expected.0.push(dense.as_slice().to_vec());
                    *params.get_mut(id) += &dense;
                }
                expected.1.extend(step.results);
            }
            for count in [1, 2, 3, 4, 5, 8, 11, 25] {
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

    /// Those of the first 5 tiles of 9, as a rank sends them.
    fn parts(params: &Params<f32>, ids: [ParamId; 3]) -> Vec<Part<f32, f32>> {
        Tiles::<f32>::new().run(params, 0..9, 0..5, &|tile, params, (): &mut ()| loss(tile, params, ids))
    }

    fn add_share(parts: &mut [Part<f32, f32>], share: impl SparseGrad<f32>) {
        parts[0].1.grads[2].add_sparse(Arc::new(share));
    }

    #[test]
    fn sparse_gradients_need_parts_and_a_reader() {
        let (params, ids) = store();
        let mut own = parts(&params, ids);
        add_share(&mut own, Foreign(None));
        let error = message(&params, 9, &own).unwrap_err();
        assert_eq!(error, ExchangeError::NotSent { param: "table".into() });
        let mut own = parts(&params, ids);
        add_share(&mut own, Foreign(Some("foreign")));
        let message = message(&params, 9, &own).unwrap();
        let read = |tiles: Tiles<f32>| tiles.receive::<f32>(&params, 9, 0..5, &mut Reader(&message));
        let error = read(Tiles::new()).err().unwrap();
        assert!(error.contains("of kind `foreign` for `table`"), "{error}");
        let reader: ReadSparse<f32> = |shape, parts| {
            let is_whole = shape == [7, 2] && *parts.integers == [1, 2] && parts.tensors.is_empty();
            is_whole.then(|| Arc::new(Foreign(None)) as Arc<dyn SparseGrad<f32>>)
        };
        assert_eq!(read(Tiles::new().with_reader("foreign", reader)).unwrap()[0].1.grads[2].sparse().len(), 5);
    }

    #[test]
    fn ranks_that_differ_are_named() {
        let train = |mut exchange: InProcess, tile_count: usize| {
            let (params, ids) = store();
            let tiles = Tiles::<f32>::new();
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
        let own = parts(&params, ids);
        // The first half of nine, and the first tile of the second.
        let ranges: Vec<_> = own.iter().map(|(range, _)| range.clone()).collect();
        assert_eq!(ranges, [0..4, 4..5]);
        let whole = message(&params, 9, &own).unwrap();
        let read = |message: &[u8]| Tiles::<f32>::new().receive::<f32>(&params, 9, 0..5, &mut Reader(message));
        for ((range, sums), (own_range, own)) in read(&whole).unwrap().iter().zip(&own) {
            assert!(range == own_range && sums.results == own.results && sums.grads.len() == 3);
            for (sum, own) in sums.grads.iter().zip(&own.grads) {
                let [sum, own] = [sum, own].map(|grad| grad.clone().into_dense(&Pool::none()));
                assert!(sum == own);
            }
        }
        for len in 0..whole.len() {
            assert!(read(&whole[..len]).is_err(), "{len} bytes");
        }
        assert!(read(&[&whole[..], &[0]].concat()).is_err(), "a byte too many");
        // The numbers of tiles, of parameters, and of bytes.
        for at in [0, 8, 16] {
            let mut message = whole.clone();
            message[at] ^= 1;
            assert!(read(&message).is_err(), "byte {at}");
        }
        // A sum of another shape; a row that does not exist; rows of another width.
        type Parts = [Part<f32, f32>];
        type Change<'a> = &'a dyn Fn(&mut Parts);
        let refused = |change: Change<'_>| {
            let mut own = parts(&params, ids);
            change(&mut own);
            read(&message(&params, 9, &own).unwrap()).err().unwrap()
        };
        let set = |parts: &mut Parts, i: usize, shape: &[usize]| {
            parts[0].1.grads[i] = Tensor::<f32>::ones(shape).into();
        };
        let set_rows = |parts: &mut Parts, shape: [usize; 2], row: u32| {
            parts[0].1.grads[2] = Gradient::zero(&shape);
            add_share(parts, RowGrad::new(&shape, [row].into(), Tensor::<f32>::ones(&[1, shape[1]])));
        };
        let changes: [(&str, Change<'_>); 4] = [
            ("shape of a sum", &|parts| set(parts, 0, &[3, 6])),
            ("shape of a table", &|parts| set(parts, 2, &[2, 7])),
            ("row 7 of 7", &|parts| set_rows(parts, [8, 2], 7)),
            ("rows of width 3", &|parts| set_rows(parts, [7, 3], 0)),
        ];
        for (what, change) in changes {
            assert!(refused(change).contains("cannot be read"), "{what}");
        }
        let mut fewer = parts(&params, ids);
        fewer[0].1.results.pop();
        assert!(read(&message(&params, 9, &fewer).unwrap()).is_err(), "a result is missing");
    }

    #[test]
    fn parts_of_ranks_make_the_tree() {
        for count in [0, 1, 2, 5, 8, 13] {
            for ranks in 1..=15 {
                let own: Vec<_> = (0..ranks).map(|rank| tiles_of(rank, ranks, count)).collect();
                let tiles: Vec<usize> = own.iter().flat_map(|own| own.clone()).collect();
                assert_eq!(tiles, (0..count).collect::<Vec<_>>());
                let even = own.iter().map(|own| own.len() * ranks).all(|len| len.abs_diff(count) < ranks);
                assert!(even, "{count} tiles on {ranks} ranks: {own:?}");
                for own in own {
                    let is_inside = |range: &Range<usize>| own.start <= range.start && range.end <= own.end;
                    // Ranges of the tree with their parents, in the order of their tiles.
                    let mut nodes = vec![(0..count, 0..ranks * count + 1)];
                    let mut at = 0;
                    while let Some((range, _)) = nodes.get(at).cloned() {
                        nodes.extend(halves(&range).into_iter().flatten().map(|half| (half, range.clone())));
                        at += 1;
                    }
                    let largest = nodes.into_iter().filter(|(range, parent)| is_inside(range) && !is_inside(parent));
                    let mut expected: Vec<_> =
                        largest.map(|(range, _)| range).filter(|range| !range.is_empty()).collect();
                    expected.sort_by_key(|range| range.start);
                    assert_eq!(parts_of(0..count, &own), expected, "{own:?} of {count}");
                }
            }
        }
        assert_eq!(parts_of(0..8, &(2..8)), [2..4, 4..8]);
    }

    #[test]
    fn tiles_any_threads_give_same_bits() {
        let (mut params, ids) = store();
        params.freeze(|name| name == "b");
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let tiles = Tiles::<f32, Vec<usize>>::new();
            let step = || {
                let step = tiles.differentiate(&params, 21, |tile, params, seen| {
                    seen.push(tile); // kept from tile to tile
                    loss(tile, params, ids)
                });
                let dense: Vec<Vec<f32>> =
                    step.grads.iter().map(|grad| grad.clone().into_dense(&Pool::none()).as_slice().to_vec()).collect();
                (dense, step.results)
            };
            let both = pool.install(|| [step(), step()]);
            let seen: usize = locked(&tiles.free).iter().map(|(_, seen)| seen.len()).sum();
            assert!(seen == 42 && locked(&tiles.free).len() <= threads);
            both
        };
        let [first, second] = run(1);
        assert!(first == second && first.0.len() == 2);
        for threads in [2, 3, 8, 21] {
            assert!(run(threads) == [first.clone(), second.clone()], "{threads} threads");
        }
    }
}
