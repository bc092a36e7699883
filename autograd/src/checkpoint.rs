//! Gradient checkpointing (rematerialisation): a part of a computation saves only its inputs, and runs again in the
//! backward pass.

use crate::op::Given;
use crate::sweep::parts;
use crate::{Error, Grads, Op, ShapeError, Tape, Var, Vjp};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};
use smallvec::SmallVec;

/// y = f(x), of which the tape saves only x.
///
/// The backward pass runs `f` again on a separate tape that shares the pool, and differentiates there. `f` is also its
/// own reference, so a recorded pass goes through the plain operations.
struct Checkpoint<F> {
    f: F,
    /// For each argument of `f`, the number of its input. A variable that is given twice is one input: `f` may take
    /// gradients, and those of a copy would be others.
    places: SmallVec<[usize; 4]>,
    shape: Shape,
}

/// The arguments of a checkpointed function, from the inputs.
fn arguments<'a, T: Scalar>(places: &[usize], inputs: &[Var<'a, T>]) -> Vec<Var<'a, T>> {
    places.iter().map(|&place| inputs[place].clone()).collect()
}

impl<T, F> Op<T> for Checkpoint<F>
where
    T: Scalar,
    F: for<'a> Fn(&[Var<'a, T>]) -> Var<'a, T> + Send + Sync + 'static,
{
    fn name(&self) -> &'static str {
        "checkpoint"
    }

    fn shape(&self, _x: &[&[usize]]) -> Result<Shape, ShapeError> {
        Ok(self.shape.clone())
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        run(&self.f, &self.places, &Tape::with_pool(pool.clone()), x)
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        cx.tape().or_raise(self.try_vjp(cx))
    }

    fn try_vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Result<Grads<'t, T>, Error> {
        let (tape, at) = (cx.tape().nested(), cx.tape().line());
        // Inputs whose gradient is not needed are leaves too: `f` may take gradients with respect to them.
        let x: Vec<Var<'_, T>> = (0..cx.len()).map(|i| tape.unchecked_leaf(cx.input(i).clone(), at)).collect();
        let leaves: SmallVec<[usize; 4]> = (0..cx.len()).filter(|&i| cx.needs(i)).collect();
        let y = (self.f)(&arguments(&self.places, &x));
        let seed = tape.constant(cx.g().value().clone());
        let mut given: Vec<Option<Given<'t, T>>> = vec![None; cx.len()];
        let wanted: Vec<_> = leaves.iter().map(|&i| &x[i]).collect();
        for (&i, shares) in leaves.iter().zip(parts(&y, seed, &wanted, at)?) {
            // From the tape of the replay to that of the pass.
            let moved = |share| match share {
                Given::Dense(grad) => Some(Given::Dense(cx.constant(grad.into_value()))),
                Given::Sparse(part) => Some(Given::Sparse(part)),
                Given::Parts(_) => None,
            };
            given[i] = Some(Given::Parts(shares.into_iter().filter_map(moved).collect()));
        }
        Ok(Grads(given.into_iter().collect()))
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let x: Vec<_> = x.iter().map(Var::tracked).collect();
        Some((self.f)(&arguments(&self.places, &x)))
    }
}

/// The value of `f` on a temporary tape. It is recorded there, so that `f` may take gradients.
fn run<T: Scalar>(
    f: impl for<'a> Fn(&[Var<'a, T>]) -> Var<'a, T>,
    places: &[usize],
    tape: &Tape<T>,
    x: &[&Tensor<T>],
) -> Tensor<T> {
    let x: Vec<_> = x.iter().map(|&x| tape.unchecked_leaf(x.clone(), tape.line())).collect();
    f(&arguments(places, &x)).into_value()
}

impl<T: Scalar> Tape<T> {
    /// Gradient checkpointing: computes `f(inputs)`, of which the tape saves only the inputs.
    ///
    /// The backward pass runs `f` again and differentiates that run. A chain of `n` operations cut into `sqrt(n)` such
    /// segments needs memory for about `2 sqrt(n)` values instead of `n`. The price is one more forward pass (Chen et
    /// al. 2016, "Training Deep Nets with Sublinear Memory Cost").
    ///
    /// `f` gets the inputs in order. It must compute the same values in each run, so random numbers must come from a
    /// seed. It cannot capture variables, so that gradients reach all of them. To use a constant, capture a tensor and
    /// put it on the tape `x[0].tape()`. Checkpoints may nest.
    ///
    /// A gradient has the same bits as without a checkpoint, and stays sparse where it would be sparse. The gradient of
    /// a gradient works, but saves no memory: a recorded pass (`grad_graph`, `vjp`) records the operations of `f`. It
    /// also sums contributions to a gradient in another order.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::scalar(0.5));
    /// let y = tape.checkpoint(&[&x], |x| x[0].sin().exp().square());
    /// assert_eq!(tape.len(), 2); // the leaf and the checkpoint
    /// assert_eq!(y.grad(&[&x]), x.sin().exp().square().grad(&[&x]));
    /// ```
    ///
    /// # Panics
    /// If an input belongs to another tape, or if `f` panics.
    #[track_caller]
    pub fn checkpoint<'t>(
        &'t self,
        inputs: &[&Var<'t, T>],
        f: impl for<'a> Fn(&[Var<'a, T>]) -> Var<'a, T> + Send + Sync + 'static,
    ) -> Var<'t, T> {
        for x in inputs {
            assert!(std::ptr::eq(x.tape(), self), "checkpoint: an input belongs to another tape");
        }
        let (mut unique, mut places) = (SmallVec::<[&Var<'t, T>; 4]>::new(), SmallVec::new());
        for &x in inputs {
            let known = unique.iter().position(|other| x.node.is_some() && other.node == x.node);
            places.push(known.unwrap_or(unique.len()));
            unique.extend(known.is_none().then_some(x));
        }
        let values: SmallVec<[&Tensor<T>; 4]> = unique.iter().map(|x| x.value()).collect();
        let value = run(&f, &places, &self.nested(), &values);
        let shape = Shape::from_slice(value.shape());
        self.record(Box::new(Checkpoint { f, places, shape }), &unique, value, self.line())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Activation, RowGrad};

    fn bits<T: Scalar>(x: &Tensor<T>) -> Vec<u64> {
        x.as_slice().iter().map(|x| x.to_f64().to_bits()).collect()
    }

    /// Uses its inputs often and in an order in which another association would show.
    fn segment<'t>(x: &[Var<'t, f32>]) -> Var<'t, f32> {
        let h = x[0].matmul(&x[1]).tanh();
        let k = (&h * &x[0] + x[2].sigmoid()) * 1.7;
        (k.matmul(&x[1]) + &x[0] * &x[2] + &x[0]).softplus()
    }

    fn leaf<'t>(tape: &'t Tape<f32>, salt: usize) -> Var<'t, f32> {
        tape.leaf(Tensor::from_fn(&[7, 7], |i| ((i * 31 + salt * 17) as f32 * 0.123).sin()))
    }

    #[test]
    fn a_gradient_has_the_bits_of_the_plain_computation() {
        // Inputs are used before, in and after the segments; one is given twice; segments nest.
        let run = |checked: bool| {
            let tape = Tape::<f32>::new();
            let [x, w, b] = [0, 1, 2].map(|salt| leaf(&tape, salt));
            let mut h = &x * 0.3 + &w * &b;
            for round in 0..4 {
                let inputs = if round == 2 { [&h, &w, &w] } else { [&h, &w, &b] };
                h = match (checked, round) {
                    (false, _) => segment(&inputs.map(Clone::clone)),
                    (true, 3) => tape.checkpoint(&inputs, |x| x[0].tape().checkpoint(&[&x[0], &x[1], &x[2]], segment)),
                    (true, _) => tape.checkpoint(&inputs, segment),
                };
                h = h + &b * &w + &x;
            }
            let loss = (h * &x).mean();
            let mut all = loss.grad(&[&x, &w, &b]);
            all.extend(loss.backward(&[&b]).remove(0).dense().cloned());
            all.push(loss.into_value());
            all.iter().flat_map(bits).collect::<Vec<_>>()
        };
        assert_eq!(run(true), run(false));
    }

    /// Gradients that `f` takes know that two arguments are one variable, in all runs.
    #[test]
    fn gradients_inside_count_a_variable_that_is_given_twice_once() {
        fn slope<'t>(x: &[Var<'t, f64>]) -> Var<'t, f64> {
            (x[0].square() * &x[1]).grad_graph(&[&x[0]]).remove(0)
        }
        let tape = Tape::<f64>::new();
        let (x, other) = (tape.leaf(Tensor::scalar(3.0)), tape.leaf(Tensor::scalar(3.0)));
        let y = tape.checkpoint(&[&x, &x], slope);
        // 3 x^2, and its derivatives.
        let graph = y.grad_graph(&[&x]).remove(0);
        assert_eq!(
            [y.item(), y.grad(&[&x])[0].item(), graph.item(), graph.grad(&[&x])[0].item()],
            [27.0, 18.0, 18.0, 6.0]
        );
        // 2 x y for different variables.
        let y = tape.checkpoint(&[&x, &other], slope);
        assert_eq!([y.item(), y.grad(&[&x])[0].item()], [18.0, 6.0]);
    }

    #[test]
    fn memory_is_lower_by_what_the_segments_do_not_keep() {
        let run = |checked: bool| {
            let tape = Tape::<f32>::new();
            let x = tape.leaf(tape.pool().full(&[1000], 0.1));
            let mut h = x.clone();
            for _ in 0..8 {
                h = if checked { tape.checkpoint(&[&h], eight) } else { eight(&[h]) };
            }
            let grad = h.sum().backward(&[&x]).remove(0).into_dense(tape.pool());
            (tape.pool().allocated(), bits(&grad))
        };
        fn eight<'t>(x: &[Var<'t, f32>]) -> Var<'t, f32> {
            (0..8).fold(x[0].clone(), |h, _| h.sin())
        }
        let ((plain, expected), (checked, got)) = (run(false), run(true));
        assert_eq!(got, expected);
        // 64 saved inputs against 8 at the borders and 8 within the segment that runs again.
        assert!(plain >= 64 * 1000, "{plain} elements");
        assert!(checked <= 24 * 1024, "{checked} elements instead of {plain}");
    }

    #[test]
    fn checkpoint_second_order_equals_plain() {
        let run = |checked: bool| {
            let tape = Tape::<f64>::new();
            let x = tape.leaf(Tensor::from_vec(&[3], vec![0.3, -0.8, 1.4]));
            fn f<'t>(x: &[Var<'t, f64>]) -> Var<'t, f64> {
                (&x[0] * x[1].sin()).exp() * &x[0]
            }
            // The second input depends on the first.
            let h = x.square();
            let y = if checked { tape.checkpoint(&[&x, &h], f) } else { f(&[x.clone(), h]) };
            let first = y.sum().grad_graph(&[&x]).remove(0);
            let second = first.square().sum().grad_graph(&[&x]).remove(0);
            let third = second.sum().grad(&[&x]).remove(0);
            [first.into_value(), second.into_value(), third].map(|x| x.as_slice().to_vec())
        };
        for (got, expected) in run(true).iter().flatten().zip(run(false).iter().flatten()) {
            assert!((got - expected).abs() <= 1e-12 * expected.abs().max(1.0), "{got} instead of {expected}");
        }
    }

    #[test]
    fn checkpoint_unneeded_work_costs_nothing() {
        let tape = Tape::<f64>::new();
        let (x, c) = (tape.leaf(Tensor::ones(&[2])), tape.constant(Tensor::ones(&[2])));
        assert!(!tape.checkpoint(&[&c], |x| x[0].exp()).is_on_graph());
        assert!(!tape.no_grad(|| tape.checkpoint(&[&x], |x| x[0].exp())).is_on_graph());
        let y = tape.checkpoint(&[&x, &c], |x| &x[0] * &x[1]);
        assert_eq!(y.sum().grad(&[&x])[0], Tensor::ones(&[2]));
        assert!(matches!(y.sum().try_grad(&[&x, &c]), Err(Error::ByConstant { index: 1, .. })));
        // A part that does not depend on its inputs, and empty and scalar tensors.
        let y = tape.checkpoint(&[&x], |x| x[0].tape().constant(Tensor::scalar(2.0)));
        assert_eq!(y.grad(&[&x])[0].as_slice(), [0.0; 2]);
        let empty = tape.leaf(Tensor::zeros(&[0, 3]));
        assert_eq!(tape.checkpoint(&[&empty], |x| x[0].exp().sum()).grad(&[&empty])[0].shape(), [0, 3]);
    }

    #[test]
    fn a_sparse_gradient_stays_sparse() {
        let tape = Tape::<f64>::new();
        let table = tape.leaf(Tensor::from_fn(&[5, 2], |i| i as f64));
        let y = tape.checkpoint(&[&table], |x| x[0].gather_rows([3, 1, 3]).square());
        let gradient = y.sum().backward(&[&table]).remove(0);
        assert_eq!((gradient.is_rows(), gradient.clone().take::<RowGrad<f64>>().len()), (true, 1));
        let dense = gradient.into_dense(tape.pool());
        assert_eq!(dense.as_slice(), [0.0, 0.0, 4.0, 6.0, 0.0, 0.0, 24.0, 28.0, 0.0, 0.0]);
    }

    #[test]
    fn the_nan_finder_looks_inside() {
        let tape = Tape::<f64>::new();
        tape.check_finite(true);
        let x = tape.leaf(Tensor::from_vec(&[2], vec![1.0, 0.0]));
        let y = tape.checkpoint(&[&x], |x| x[0].sqrt().sum());
        let line = line!() - 1;
        let error = y.try_grad(&[&x]).unwrap_err().to_string();
        let expected = format!("sqrt: the gradient of input 0 is inf at index [1] (recorded at {}:{line}:", file!());
        assert!(error.starts_with(&expected), "{error}");
        // Layers run in it like anything else.
        let w = tape.leaf(Tensor::ones(&[2, 1]));
        let y = tape.checkpoint(&[&x, &w], |x| x[0].reshape(&[1, 2]).linear(&x[1], None, Activation::Relu).sum());
        assert_eq!(y.grad(&[&w])[0].as_slice(), [1.0, 0.0]);
    }
}
