//! Tiles shared between processes.

use super::{Part, TileSums, Tiles, halves};
use crate::exchange::{Exchange, ExchangeError, Frame, Reader};
use crate::{Bound, Params};
use raygrad_autograd::{ReadSparse, SparseParts, Var};
use raygrad_tensor::Scalar;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::iter::Peekable;
use std::ops::Range;

impl<T: Scalar, S: Default + Send> Tiles<T, S> {
    /// Reads sparse contributions of this [kind](SparseParts::kind) from other processes. That of
    /// [`RowGrad`](raygrad_autograd::RowGrad) is known.
    pub fn with_reader(mut self, kind: &'static str, read: ReadSparse<T>) -> Self {
        self.readers.insert(kind, read);
        self
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

    /// Reads the [`message`] of another process with these tiles.
    pub(super) fn receive<R: DeserializeOwned>(
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
        if reader.number().ok_or_else(damaged)? != fingerprint(params) {
            return Err("has parameters of other names or shapes, or others are frozen there".into());
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
}

/// A hash of the names and shapes of the parameters that are not frozen.
fn fingerprint<T: Scalar>(params: &Params<T>) -> usize {
    let mut hasher = DefaultHasher::new();
    params.trainable().for_each(|id| (params.name(id), params.get(id).shape()).hash(&mut hasher));
    hasher.finish() as usize
}

/// The tiles of a rank.
pub(super) fn tiles_of(rank: usize, ranks: usize, count: usize) -> Range<usize> {
    count * rank / ranks..count * (rank + 1) / ranks
}

/// The largest ranges of the tree below `range` that are in `own`.
pub(super) fn parts_of(range: Range<usize>, own: &Range<usize>) -> Vec<Range<usize>> {
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
pub(super) fn message<T: Scalar, R: Serialize>(
    params: &Params<T>,
    count: usize,
    parts: &[Part<T, R>],
) -> Result<Vec<u8>, ExchangeError> {
    let mut frame = Frame::default();
    frame.number(count);
    frame.number(params.trainable().count());
    frame.number(fingerprint(params));
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
