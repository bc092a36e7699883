//! Hooks: functions that read or change a gradient during the backward pass.

use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};

/// y = x; dx = f(g).
struct Hook<F>(F);

impl<T, F> Op<T> for Hook<F>
where
    T: Scalar,
    F: for<'a> Fn(&Var<'a, T>) -> Var<'a, T> + Send + Sync + 'static,
{
    fn name(&self) -> &'static str {
        "hook"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        Ok(Shape::from_slice(x[0]))
    }

    fn forward(&self, x: &[&Tensor<T>], _pool: &Pool<T>) -> Tensor<T> {
        x[0].clone()
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let grad = (self.0)(cx.g());
        assert_eq!(grad.shape(), cx.shape(0), "a hook must give a gradient of the shape that it got");
        Grads::one(grad)
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The same value, with a hook that replaces its gradient: in every backward pass, the summed gradient goes through
    /// `f`.
    ///
    /// `f` works on variables, so a recorded pass records it and differentiates it too. Such a pass fails with
    /// [`Error::Unrecorded`](crate::Error::Unrecorded) if the result does not depend on the gradient. `f` is not called
    /// if no gradient arrives. The hook sees the gradients of the returned variable alone; use that variable in place of
    /// `self`.
    ///
    /// [`jvp`](Self::jvp) and [`jacobian`](Self::jacobian) take gradients as linear in the one that arrives. So they are
    /// right for hooks that are linear, such as a scale, and not for those that clip.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::scalar(3.0));
    /// let reversed = x.map_grad(|g| g * -1.0);
    /// assert_eq!(reversed.square().grad(&[&x])[0].item(), -6.0);
    /// ```
    ///
    /// # Panics
    /// The backward pass panics if `f` returns another shape than it got.
    #[track_caller]
    pub fn map_grad(&self, f: impl for<'a> Fn(&Var<'a, T>) -> Var<'a, T> + Send + Sync + 'static) -> Self {
        self.tape().apply(Hook(f), &[self])
    }

    /// The same value, with a hook that reads its gradient: in every backward pass, `f` gets the summed gradient.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// use std::sync::Mutex;
    /// static SEEN: Mutex<Vec<f64>> = Mutex::new(vec![]);
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::scalar(3.0));
    /// let h = x.square().inspect_grad(|g| SEEN.lock().unwrap().push(g.item()));
    /// (&h * 2.0 + &h).grad(&[&x]);
    /// assert_eq!(*SEEN.lock().unwrap(), [3.0]);
    /// ```
    #[track_caller]
    pub fn inspect_grad(&self, f: impl Fn(&Tensor<T>) + Send + Sync + 'static) -> Self {
        self.map_grad(move |g| {
            f(g.value());
            g.clone()
        })
    }
}

#[cfg(test)]
mod tests {
    use crate::check::{Check, check_function};
    use crate::{Tape, Tensor};
    use std::sync::{Arc, Mutex};

    #[test]
    fn a_hook_sees_the_whole_gradient_once_in_each_pass() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::from_vec(&[2], vec![1.0, 2.0]));
        let seen = Arc::new(Mutex::new(vec![]));
        let log = seen.clone();
        let h = (&x * 1.0).inspect_grad(move |g| log.lock().unwrap().push(g.as_slice().to_vec()));
        let y = (h.square() + &h * 10.0).sum();
        let expected = vec![12.0, 14.0];
        assert_eq!(y.grad(&[&x])[0].as_slice(), expected);
        assert_eq!(y.grad_graph(&[&x])[0].value().as_slice(), expected);
        assert_eq!(*seen.lock().unwrap(), [expected.clone(), expected]);
        // No wanted gradient is behind the hook, so it is not called.
        assert_eq!(y.grad(&[&h])[0].as_slice(), [12.0, 14.0]);
        let constant = tape.constant(Tensor::scalar(1.0)).inspect_grad(|_| panic!("a constant has no gradient"));
        assert!(!constant.is_on_graph());
        assert_eq!(seen.lock().unwrap().len(), 2, "the sweep ends at the hook's output");
    }

    #[test]
    fn what_a_hook_does_is_differentiated_too() {
        // dx becomes g^3: y = x^2 / 2 has the hooked gradient x^3, whose derivative is 3 x^2.
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::scalar(2.0));
        let y = x.map_grad(|g| g * g * g).square() * 0.5;
        let first = y.grad_graph(&[&x]).remove(0);
        // The derivative of `first` by x passes the hook again: 3 x^2 becomes (3 x^2)^3.
        assert_eq!(first.item(), 8.0);
        assert_eq!(first.grad(&[&x])[0].item(), 12.0_f64.powi(3));
    }

    #[test]
    fn a_hook_that_changes_nothing_passes_every_check() {
        for shape in [&[][..], &[0, 2], &[3]] {
            let x = Tensor::from_fn(shape, |i| 0.4 + i as f64);
            check_function(&Check::default(), &[x], |x| (x[0].inspect_grad(|_| ()).sin() * &x[0]).exp()).unwrap();
        }
    }

    #[test]
    #[should_panic(expected = "a hook must give a gradient of the shape that it got")]
    fn a_hook_cannot_change_the_shape() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::ones(&[2]));
        x.map_grad(|g| g.sum()).sum().grad(&[&x]);
    }
}
