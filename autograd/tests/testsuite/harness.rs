//! The gradient checker is checked: each way in which an operation can be wrong is caught, by the check that is meant
//! to catch it.

use raygrad_autograd::check::{Cases, Check, Entry, Extreme, check_function, check_op};
use raygrad_autograd::{Elementwise, Formula, Grads, Op, Pool, Real, Scalar, Shape, ShapeError, Tensor, Var, Vjp};
use raygrad_tensor::{broadcast_shape, map};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

/// What is wrong with [`Wave`].
#[derive(Debug, Clone, Copy, PartialEq)]
enum Fault {
    Nothing,
    WrongSign,
    TwiceTheGradient,
    MissingReduction,
    NanGradient,
    GradientToTheWrongInput,
    ForgottenInput,
    /// The values of the recorded gradient are right, but it is cut off the graph.
    WrongSecondDerivative,
    /// The recorded gradient has other values than the unrecorded one.
    AnotherGradientWhenRecorded,
    /// The fused value is not that of the reference; their gradients agree.
    WrongReference,
    MissingReference,
    WrongInSinglePrecision,
    /// Exact but for one element in f32.
    WrongElementInSinglePrecision,
    /// No two runs give the same bits, though every one is accurate.
    Nondeterministic,
    /// The kernel adds to old numbers that it finds in a buffer, but overwrites NaN: only the check with a used buffer sees it.
    StaleBuffer,
    /// A gradient that is wrong where both inputs are one variable.
    ConfusedByAliases,
    NanValue,
    /// A gradient so small that its error is below any absolute tolerance.
    WrongWhereSmall,
}

use Fault::*;

/// y = a sin b with broadcasting; da = g sin b, db = g a cos b, each summed to the shape of its input. With one fault.
#[derive(Clone)]
struct Wave {
    fault: Fault,
    runs: Arc<AtomicU32>,
}

impl<T: Scalar> Op<T> for Wave {
    fn name(&self) -> &'static str {
        "wave"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        broadcast_shape(x).ok_or_else(|| "the shapes do not broadcast".into())
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let run = self.runs.fetch_add(1, Ordering::Relaxed);
        let error = match self.fault {
            WrongInSinglePrecision if size_of::<T>() == 4 => 1e-5,
            Nondeterministic => f64::from(run % 7) * 1e-15,
            _ => 0.0,
        };
        let mut y = map([x[0], x[1]], pool, |[a, b]| a * b.sin() + T::from_f64(error));
        match self.fault {
            StaleBuffer => {
                let mut sum = pool.tensor(y.shape());
                let adds = |sum: T, y| if sum.to_f64().is_nan() { y } else { sum + y };
                sum.as_mut_slice().iter_mut().zip(y.as_slice()).for_each(|(sum, &y)| *sum = adds(*sum, y));
                return sum;
            }
            WrongElementInSinglePrecision if size_of::<T>() == 4 => y.as_mut_slice()[0] += T::from_f64(1.5e-6),
            NanValue => y.as_mut_slice()[0] = T::from_f64(f64::NAN),
            WrongWhereSmall => y = map([&y], pool, |[y]| y * T::from_f64(1e-9)),
            _ => {}
        }
        y
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (a, mut b, g) = (cx.x(0), cx.x(1), cx.g());
        if self.fault == WrongSecondDerivative {
            b = b.detach();
        }
        let aliased = a.value().as_slice().as_ptr() == b.value().as_slice().as_ptr();
        let mut da = (g * b.sin()).sum_to(cx.shape(0));
        let mut db = g * a * b.cos();
        if self.fault != MissingReduction {
            db = db.sum_to(cx.shape(1));
        }
        match self.fault {
            WrongSign => db = -db,
            TwiceTheGradient => da *= 2.0,
            NanGradient => db *= f64::NAN,
            GradientToTheWrongInput => (da, db) = (db.sum_to(cx.shape(0)), da.sum_to(cx.shape(1))),
            ForgottenInput => return Grads::new([Some(da), None]),
            ConfusedByAliases if aliased => da *= 2.0,
            WrongWhereSmall => (da, db) = (da * 1e-9, db * 1.02e-9),
            AnotherGradientWhenRecorded if cx.recording() => da *= 1.0 + 1e-8,
            _ => {}
        }
        Grads::new([Some(da), Some(db)])
    }

    fn is_fused(&self) -> bool {
        matches!(self.fault, WrongReference | MissingReference)
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        (self.fault == WrongReference).then(|| &x[0] * x[1].sin() + 1e-9)
    }
}

fn entry(fault: Fault) -> Entry {
    let entry = Entry::new(Wave { fault, runs: Arc::default() });
    match fault {
        MissingReduction => entry.sample(&[&[2, 3], &[3]]),
        // Tensors of up to 64 elements have no old buffers.
        WrongElementInSinglePrecision | StaleBuffer => entry.sample(&[&[10, 7], &[10, 7]]),
        _ => entry.sample(&[&[2, 3], &[2, 3]]),
    }
}

/// What the checker says of an entry; a panic within the tape, as of a wrong shape, is a word too.
fn verdict(entry: &Entry) -> Result<(), String> {
    match catch_unwind(AssertUnwindSafe(|| check_op(&Check::default(), entry))) {
        Ok(result) => result.map(|_| ()),
        Err(panic) => Err(panic.downcast_ref::<String>().cloned().unwrap_or_default()),
    }
}

#[track_caller]
fn assert_caught(entry: &Entry, by: &str) {
    match verdict(entry) {
        Ok(()) => panic!("passed, but should fail with `{by}`"),
        Err(error) => assert!(error.contains(by), "`{error}` instead of `{by}`"),
    }
}

#[test]
fn the_correct_operation_passes() {
    assert_eq!(verdict(&entry(Nothing).sample(&[&[2, 3], &[3]]).sample(&[&[], &[0, 2]])), Ok(()));
}

#[test]
fn every_fault_is_caught_by_the_check_meant_for_it() {
    let first = "first derivative by input";
    let faults = [
        (WrongSign, first),
        (TwiceTheGradient, first),
        (MissingReduction, "wave: the gradient of input 1 has another shape"),
        (NanGradient, "got NaN"),
        (GradientToTheWrongInput, first),
        (ForgottenInput, first),
        (WrongSecondDerivative, "second derivative by input"),
        (AnotherGradientWhenRecorded, "the recorded gradient against the unrecorded one"),
        (WrongReference, "fused against reference"),
        (MissingReference, "a fused operation without a reference"),
        (WrongInSinglePrecision, "f32 against f64, result"),
        (WrongElementInSinglePrecision, "f32 against f64 in units in the last place"),
        (Nondeterministic, "two runs differ"),
        (StaleBuffer, "old values of a buffer"),
        (ConfusedByAliases, "one variable as inputs 0 and 1 against two"),
        (NanValue, "NaN"),
        (WrongWhereSmall, first),
    ];
    for (fault, by) in faults {
        println!("{fault:?}");
        assert_caught(&entry(fault), by);
    }
}

#[test]
fn claims_about_an_operation_are_checked() {
    assert_caught(&entry(Nothing).linear(), "f(-2 x) / -2");
    let at = |y, grads: [f64; 2]| {
        let mut entry = entry(Nothing);
        entry.extremes.push(Extreme { x: vec![2.0, 0.0], y, grads: grads.to_vec() });
        entry
    };
    assert_eq!(verdict(&at(0.0, [0.0, 2.0])), Ok(()));
    assert_caught(&at(1e-9, [0.0, 2.0]), "the value at [2.0, 0.0]");
    assert_caught(&at(0.0, [0.0, 2.1]), "gradient 1 at [2.0, 0.0]");
}

/// y = 3 x with a gradient that is off by less than differences can see.
#[derive(Clone, Copy)]
struct Thrice;

impl Formula<1> for Thrice {
    const NAME: &'static str = "thrice";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        x.like(3.0) * x
    }
    #[inline(always)]
    fn vjp<E: Real>(&self, g: E, _x: [E; 1], _y: E) -> [E; 1] {
        [g.like(3.0 + 1e-9) * g]
    }
    fn cases(&self, cases: &mut Cases) {
        cases.domain(-1.0..1.0);
    }
}

#[test]
fn exact_checks_catch_tiny_faults() {
    assert_caught(&Entry::examined(Thrice), "the gradient against dual numbers");
    let by = "the output along a gradient against the input along its adjoint";
    assert_caught(&Entry::new(Elementwise(Thrice)).linear().sample(&[&[2, 3]]), by);
    assert_eq!(verdict(&Entry::new(Elementwise(Thrice)).sample(&[&[2, 3]])), Ok(()));
}

/// y = x^2, with a gradient that is off by a thousandth.
#[derive(Clone)]
struct RoughSquare;

impl<T: Scalar> Op<T> for RoughSquare {
    fn name(&self) -> &'static str {
        "rough_square"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        Ok(Shape::from(x[0]))
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        map([x[0]], pool, |[x]| x * x)
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.g() * cx.x(0) * 2.002)
    }
}

/// With few elements and with many, whose directions are drawn, the step follows the size of the numbers.
#[test]
fn faults_at_large_numbers_are_caught() {
    for n in [6, 60] {
        let x = Tensor::from_fn(&[n], |i| 1e5 + i as f64);
        let report =
            check_function(&Check::default(), std::slice::from_ref(&x), |x| x[0].tape().apply(RoughSquare, &[&x[0]]));
        assert!(report.is_err(), "{n}: {report:?}");
        check_function(&Check::default(), &[x], |x| &x[0] * &x[0]).unwrap();
    }
}
