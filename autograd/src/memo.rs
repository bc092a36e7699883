//! Outputs of operations that one pass saves and another reuses.

#[cfg(doc)]
use crate::Op;
use crate::Tape;
use crate::tape::with_cell;
use raygrad_tensor::{Pool, Scalar, Tensor};

/// Saved outputs of the [cacheable](Op::is_cacheable) operations of a pass, in the order in which they ran.
#[derive(Debug, Clone)]
pub struct CachedOutputs<T: Scalar> {
    values: Vec<Tensor<T>>,
}

impl<T: Scalar> CachedOutputs<T> {
    /// The outputs, in order.
    pub fn values(&self) -> &[Tensor<T>] {
        &self.values
    }

    /// Rows of several memos of the same operations, joined to one memo. Row `i` of the result is row `row` of memo
    /// `memo`, for `[memo, row] = rows[i]`. Use it where each memo comes from other rows of one tensor.
    ///
    /// # Panics
    /// If the memos are not of the same operations, an output is a scalar, or a row is out of range.
    #[track_caller]
    pub fn gather(memos: &[CachedOutputs<T>], rows: &[[u32; 2]], pool: &Pool<T>) -> CachedOutputs<T> {
        let Some(first) = memos.first() else { return CachedOutputs { values: vec![] } };
        let gather = |which: usize| {
            let parts: Vec<&[T]> = memos.iter().map(|memo| memo.values[which].as_slice()).collect();
            let mut shape = first.values[which].shape().to_vec();
            assert!(!shape.is_empty(), "rows of an output that is a number");
            let width: usize = shape[1..].iter().product();
            shape[0] = rows.len();
            let mut out = pool.tensor(&shape);
            for (out, &[memo, row]) in out.as_mut_slice().chunks_exact_mut(width.max(1)).zip(rows) {
                out.copy_from_slice(&parts[memo as usize][row as usize * width..(row as usize + 1) * width]);
            }
            out
        };
        let row = |value: &Tensor<T>| value.shape().get(1..).map(<[usize]>::to_vec);
        let alike = |memo: &CachedOutputs<T>| memo.values.iter().map(row).eq(first.values.iter().map(row));
        assert!(memos.iter().all(alike), "memos of the same operations");
        CachedOutputs { values: (0..first.values.len()).map(gather).collect() }
    }
}

impl<T: Scalar> Tape<T> {
    /// Runs `f`, and returns its result and the outputs of its [cacheable](Op::is_cacheable) operations, for
    /// [`reuse_outputs`](Self::reuse_outputs).
    pub fn cache_outputs<R>(&self, f: impl FnOnce() -> R) -> (R, CachedOutputs<T>) {
        let (result, values) = with_cell(&self.cached, Some(vec![]), f);
        let values = values.unwrap_or_default();
        // An enclosing `cache_outputs` saves these outputs too.
        values.iter().for_each(|value| self.cache(value));
        (result, CachedOutputs { values })
    }

    /// Runs `f`, whose [cacheable](Op::is_cacheable) operations take their outputs from `memo` instead of computing
    /// them.
    ///
    /// The memo must come from the same operations on the same inputs. The operations are recorded as usual. So an
    /// unrecorded pass can find the rows that matter, and a recorded pass can reuse their outputs.
    ///
    /// ```
    /// use raygrad_autograd::{Grads, CachedOutputs, Op, ShapeError, Tape, Vjp};
    /// use raygrad_tensor::{Pool, Scalar, Shape, Tensor, map};
    ///
    /// /// y = x^2, at a price.
    /// struct Square;
    /// impl<T: Scalar> Op<T> for Square {
    ///     fn name(&self) -> &'static str { "square" }
    ///     fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> { Ok(x[0].into()) }
    ///     fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> { map([x[0]], pool, |[x]| x * x) }
    ///     fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> { Grads::one(cx.g() * &cx.x(0) * 2.0) }
    ///     fn is_cacheable(&self) -> bool { true }
    /// }
    ///
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::from([1.0, 2.0, 3.0]));
    /// let (y, memo) = tape.no_grad(|| tape.cache_outputs(|| tape.apply(Square, &[&x])));
    /// let large: Vec<u32> = (0..3).filter(|&i| y.value().as_slice()[i as usize] > 2.0).collect();
    /// let rows: Vec<[u32; 2]> = large.iter().map(|&row| [0, row]).collect();
    /// let memo = CachedOutputs::gather(&[memo], &rows, tape.pool());
    /// let again = tape.reuse_outputs(memo, || tape.apply(Square, &[&x.gather_rows(large)]));
    /// assert_eq!(again.value(), [4.0, 9.0]);
    /// assert_eq!(again.sum().grad(&[&x])[0], [0.0, 4.0, 6.0]);
    /// ```
    ///
    /// An empty memo is ignored: all outputs are computed.
    ///
    /// # Panics
    /// If `f` runs fewer or other cacheable operations than those of the memo; other operations are found by their
    /// shapes.
    #[track_caller]
    pub fn reuse_outputs<R>(&self, memo: CachedOutputs<T>, f: impl FnOnce() -> R) -> R {
        if memo.values.is_empty() {
            return f();
        }
        let (result, left) = with_cell(&self.reused, Some(memo.values.into_iter()), f);
        assert_eq!(left.map_or(0, |left| left.len()), 0, "outputs of a memo that no operation asked for");
        result
    }

    /// The output of an operation from the memo, if one is in use.
    #[track_caller]
    pub(crate) fn reuse(&self, op: &'static str, shape: &[usize]) -> Option<Tensor<T>> {
        let mut values = self.reused.take()?;
        let value = values.next();
        self.reused.set(Some(values));
        let value = value.unwrap_or_else(|| panic!("{op}: a memo that ends before this operation"));
        assert_eq!(value.shape(), shape, "{op}: a memo holds an output of another shape for it");
        Some(value)
    }

    /// Saves an output, if outputs are being saved.
    pub(crate) fn cache(&self, value: &Tensor<T>) {
        if let Some(mut values) = self.cached.take() {
            values.push(value.clone());
            self.cached.set(Some(values));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Grads, Op, ShapeError, Var, Vjp};
    use raygrad_tensor::{Shape, map};
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// y = 2 x, with a count of its runs.
    struct Twice(Arc<AtomicUsize>);

    impl<T: Scalar> Op<T> for Twice {
        fn name(&self) -> &'static str {
            "twice"
        }
        fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
            Ok(x[0].into())
        }
        fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
            self.0.fetch_add(1, Ordering::Relaxed);
            map([x[0]], pool, |[x]| x + x)
        }
        fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
            Grads::one(cx.g() * 2.0)
        }
        fn is_cacheable(&self) -> bool {
            true
        }
    }

    /// `4 x + 1`, by two operations that are kept and one that is not.
    fn run<'t>(x: &Var<'t, f64>, count: &Arc<AtomicUsize>) -> Var<'t, f64> {
        let once = x.tape().apply(Twice(count.clone()), &[x]);
        x.tape().apply(Twice(count.clone()), &[&once]) + 1.0
    }

    #[test]
    fn cached_outputs_are_reused_with_gradient() {
        let (tape, count) = (Tape::new(), Arc::default());
        let x = tape.leaf(Tensor::from([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]));
        let (first, a) = tape.no_grad(|| tape.cache_outputs(|| run(&x.gather_rows([2, 0]), &count)));
        let (_, b) = tape.no_grad(|| tape.cache_outputs(|| run(&x.gather_rows([1]), &count)));
        assert!(a.values().len() == 2 && !first.is_on_graph() && count.load(Ordering::Relaxed) == 4);
        // Rows 0 and 1, which are the second of the first memo and the only one of the second.
        let memo = CachedOutputs::gather(&[a, b], &[[0, 1], [1, 0]], tape.pool());
        let seen = tape.reuse_outputs(memo, || run(&x.gather_rows([0, 1]), &count));
        assert_eq!((seen.value(), count.load(Ordering::Relaxed)), (&Tensor::from([[5.0, 9.0], [13.0, 17.0]]), 4));
        assert_eq!(seen.sum().grad(&[&x])[0], [[4.0, 4.0], [4.0, 4.0], [0.0, 0.0]]);
        // Afterwards everything is as it was.
        run(&x, &count);
        assert_eq!(count.load(Ordering::Relaxed), 6);
        tape.reuse_outputs(CachedOutputs::gather(&[], &[], tape.pool()), || run(&x, &count));
        assert_eq!(count.load(Ordering::Relaxed), 8);
    }

    #[test]
    fn the_nan_finder_looks_at_what_is_recalled() {
        let (tape, count) = (Tape::new(), Arc::default());
        let (bad, good) = (tape.leaf(Tensor::from([1.0, f64::INFINITY])), tape.leaf(Tensor::from([1.0, 2.0])));
        let twice = |x: &Var<'_, f64>| x.tape().try_apply(Twice(Arc::clone(&count)), &[x]).map(|y| y.into_value());
        let (_, memo) = tape.cache_outputs(|| twice(&bad).unwrap());
        tape.check_finite(true);
        assert!(twice(&good).is_ok() && tape.reuse_outputs(memo, || twice(&good)).is_err());
    }

    #[test]
    #[should_panic(expected = "rows of an output that is a number")]
    fn numbers_have_no_rows() {
        let tape = Tape::new();
        let x = tape.leaf(Tensor::scalar(1.0));
        let (_, memo) = tape.cache_outputs(|| run(&x, &Arc::default()));
        CachedOutputs::gather(&[memo], &[[0, 0]], tape.pool());
    }

    #[test]
    fn passes_within_passes_remember_and_recall_their_own() {
        let (tape, count) = (Tape::new(), Arc::default());
        let x = tape.leaf(Tensor::from([1.0, 2.0]));
        let ((_, inner), outer) = tape.cache_outputs(|| tape.cache_outputs(|| run(&x, &count)));
        assert_eq!((inner.values().len(), outer.values().len()), (2, 2));
        let (seen, again) = tape.reuse_outputs(outer, || tape.cache_outputs(|| run(&x, &count)));
        assert_eq!(
            (seen.value(), again.values().len(), count.load(Ordering::Relaxed)),
            (&Tensor::from([5.0, 9.0]), 2, 2)
        );
        // A panic leaves nothing behind.
        let caught =
            std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| tape.cache_outputs(|| panic!("on purpose"))));
        assert!(caught.is_err() && tape.cache_outputs(|| ()).1.values().is_empty());
        run(&x, &count);
        assert_eq!(count.load(Ordering::Relaxed), 4);
    }

    #[test]
    #[should_panic(expected = "twice: a memo holds an output of another shape for it")]
    fn a_memo_of_something_else_is_refused() {
        let (tape, count) = (Tape::new(), Arc::default());
        let (_, memo) = tape.cache_outputs(|| run(&tape.leaf(Tensor::zeros(&[3])), &count));
        tape.reuse_outputs(memo, || run(&tape.leaf(Tensor::zeros(&[2])), &count));
    }

    #[test]
    #[should_panic(expected = "outputs of a memo that no operation asked for")]
    fn a_memo_of_more_than_is_asked_for_is_refused() {
        let tape = Tape::<f64>::new();
        let (_, memo) = tape.cache_outputs(|| run(&tape.leaf(Tensor::zeros(&[3])), &Arc::default()));
        tape.reuse_outputs(memo, || ());
    }
}
