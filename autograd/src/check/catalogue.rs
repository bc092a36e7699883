//! The catalogue: every operation with sample inputs, and with exact values at extremes.

use crate::cases::Extreme;
use crate::formula::derived;
use crate::ops::gradient_op::GradientOp;
use crate::ops::trigonometric;
use crate::ops::{Activation, Segments, activation, arithmetic, cross_entropy, exponential, extremum, layer_norm};
use crate::ops::{linear, loss, matmul, moments, piecewise, power, product, reduce, scan, segment, select, shape};
use crate::ops::{softmax, walk};
use crate::{Cases, Elementwise, Formula, Op};
use raygrad_tensor::{Shape, Tensor};
use std::ops::Range;
use std::sync::Arc;

impl Cases {
    /// Sets of operands.
    fn samples(&self) -> Vec<Vec<Tensor<f64>>> {
        // The shapes of one operand, and of several: taken over and over where there are more.
        let shapes: &[&[&[usize]]] = match self.domains.len() {
            1 => &[&[&[2, 3]], &[&[]], &[&[0, 3]], &[&[37]]],
            _ => &[&[&[2, 3]], &[&[4, 1], &[3]], &[&[], &[2]], &[&[0, 1], &[3]], &[&[2, 1, 2], &[1]], &[&[]]],
        };
        let set = |(k, shapes): (usize, &&[&[usize]])| {
            let operands = self.domains.iter().zip(shapes.iter().cycle()).enumerate();
            operands.map(|(i, (domain, shape))| spread(shape, domain, i + 7 * k)).collect()
        };
        shapes.iter().enumerate().map(set).collect()
    }
}

/// An elementwise formula and its derivatives by dual numbers, of the operands and the gradient of the result.
pub(crate) type DualFormula = dyn Fn(&[f64], f64) -> (f64, Vec<f64>);

/// A catalogue entry: one operation in f64 and f32, with sample inputs and exact values.
pub struct Entry {
    /// The operation's name.
    pub name: &'static str,
    /// Whether it is linear in all inputs together.
    pub linear: bool,
    /// Sets of sample inputs, each with one tensor per operand.
    pub samples: Vec<Vec<Tensor<f64>>>,
    /// Exact values and gradients at single points.
    pub extremes: Vec<Extreme>,
    /// The operation in double precision.
    pub f64: Arc<dyn Op<f64>>,
    /// The operation in single precision.
    pub f32: Arc<dyn Op<f32>>,
    pub(crate) dual: Option<Box<DualFormula>>,
}

impl Entry {
    /// An entry without samples.
    pub fn new<O: Op<f64> + Op<f32> + Clone>(op: O) -> Self {
        Entry::of(op.clone(), op)
    }

    /// An entry without samples, with one operation for each precision. For an operation that holds tensors.
    pub fn of(f64: impl Op<f64>, f32: impl Op<f32>) -> Self {
        let name = f64.name();
        let (f64, f32) = (Arc::new(f64), Arc::new(f32));
        Entry { name, linear: false, samples: vec![], extremes: vec![], f64, f32, dual: None }
    }

    /// Adds a set of inputs of these shapes, with values in -1..1.
    pub fn sample(mut self, shapes: &[&[usize]]) -> Self {
        let inputs =
            shapes.iter().enumerate().map(|(i, shape)| spread(shape, &[-1.0..1.0], i + 7 * self.samples.len()));
        let inputs = inputs.collect();
        self.samples.push(inputs);
        self
    }

    /// Adds a set of inputs.
    pub fn sample_of(mut self, inputs: Vec<Tensor<f64>>) -> Self {
        self.samples.push(inputs);
        self
    }

    /// Whether the operation is a [`Formula`].
    pub fn is_elementwise(&self) -> bool {
        self.dual.is_some()
    }

    /// Marks the operation as linear. The checks then verify linearity too.
    pub fn linear(self) -> Self {
        Entry { linear: true, ..self }
    }

    /// An entry for a formula, with the formula's own [cases](Formula::cases).
    ///
    /// # Panics
    /// If there is not one domain for each operand.
    pub fn examined<const N: usize>(formula: impl Formula<N>) -> Self {
        let mut cases = Cases::default();
        formula.cases(&mut cases);
        Entry::formula(formula, &cases)
    }

    /// [`examined`](Self::examined) for the formula of method `name` of [`Var`](crate::Var).
    pub(crate) fn method<const N: usize>(name: &str, formula: impl Formula<N>) -> Self {
        let entry = Entry::examined(formula);
        assert_eq!(entry.name, name, "the formula of a method has its name");
        entry
    }

    /// An entry for a formula, with one or more sampling ranges for each operand.
    ///
    /// ```
    /// use raygrad_autograd::check::{Cases, Check, Entry, check_op};
    /// use raygrad_autograd::formula;
    /// let swish = formula!(|x, beta| x * (beta * x).sigmoid());
    /// let mut cases = Cases::default();
    /// cases.domain(-3.0..3.0).domain(0.5..2.0).at([0.0, 1.0], 0.0, [0.5, 0.0]);
    /// check_op(&Check::default(), &Entry::formula(swish, &cases)).unwrap();
    /// ```
    ///
    /// # Panics
    /// If there is not one domain for each operand.
    pub fn formula<F: Formula<N>, const N: usize>(formula: F, cases: &Cases) -> Self {
        assert_eq!(cases.domains.len(), N, "{}: one domain for each operand", F::NAME);
        let dual = move |x: &[f64], g: f64| {
            let x = std::array::from_fn(|i| x[i]);
            (formula.f(x), derived(&formula, g, x).to_vec())
        };
        Entry {
            samples: cases.samples(),
            linear: cases.linear,
            extremes: cases.extremes.clone(),
            dual: Some(Box::new(dual)),
            ..Entry::new(Elementwise(formula))
        }
    }
}

/// Reproducible values that fill the ranges evenly and follow no pattern that could hide an error.
pub(crate) fn spread(shape: &[usize], ranges: &[Range<f64>], salt: usize) -> Tensor<f64> {
    const GOLDEN: f64 = 0.618_033_988_749_894_9;
    Tensor::from_fn(shape, |i| {
        let range = &ranges[i % ranges.len()];
        let unit = ((i + 1) as f64 * GOLDEN + salt as f64 * 0.377).fract();
        range.start + unit * (range.end - range.start)
    })
}

/// The entries of all operations of this crate.
pub fn catalogue() -> Vec<Entry> {
    let formulas = [
        arithmetic::entries(),
        exponential::entries(),
        trigonometric::entries(),
        activation::entries(),
        piecewise::entries(),
        power::entries(),
        loss::entries(),
    ];
    formulas.into_iter().chain([core(), choices(), reductions(), losses()]).flatten().collect()
}

/// Selection by a mask, and interpolation.
fn choices() -> Vec<Entry> {
    // Values that are equal in places, and that no step of a difference takes past each other.
    let ranks = |shape: &[usize], step: usize| Tensor::from_fn(shape, |i| ((i * step) % 5) as f64);
    let choice = |shape: &[usize]| Entry::new(select::Where(ranks(shape, 3).gt(0.0)));
    vec![
        choice(&[2, 3]).sample(&[&[2, 3], &[3]]),
        choice(&[3]).sample(&[&[2, 1], &[]]).sample(&[&[0, 3], &[1]]),
        choice(&[2, 1]).sample(&[&[1, 3], &[]]),
        choice(&[]).sample(&[&[], &[]]),
        Entry::examined(select::Lerp),
    ]
}

/// Reductions, and operations along an axis.
fn reductions() -> Vec<Entry> {
    let shape = |extents: &[usize]| Shape::from_slice(extents);
    let variance =
        |extents: &[usize], correction, root| Entry::new(moments::Variance { shape: shape(extents), correction, root });
    let extremum = |from, behind, greatest| {
        // Far enough apart for the steps of differences.
        let apart = |extents: &[usize]| Tensor::from_fn(extents, |i| ((i * 7 + 3) % 24) as f64 * 0.1 - 1.0);
        let entry = Entry::new(extremum::Extremum { from, behind, greatest });
        let empty: &[usize] = if from == 0 { &[2, 3, 0] } else { &[0, 2, 3] };
        entry.sample_of(vec![apart(&[2, 3, 4])]).sample(&[empty])
    };
    let zeros = |extents: &[usize], every: usize| {
        let values = spread(extents, &[-1.5..1.5], 2);
        vec![Tensor::from_fn(extents, |i| if i % every == 1 { 0.0 } else { values.as_slice()[i] })]
    };
    let walk = |axis, reverse| walk::Walk { axis, reverse };
    let wide: &[&[usize]] = &[&[3, 40]];
    let layer_norm_grad = |input| {
        Entry::new(GradientOp { op: layer_norm::LayerNorm { eps: 1e-3 }, input })
            .sample(&[&[3, 5], &[5], &[5], &[3, 5]])
            .sample(&[&[2, 4, 3], &[3], &[3], &[2, 4, 3]])
            .sample(&[&[0, 3], &[3], &[3], &[0, 3]])
    };
    vec![
        extremum(1, 3, true),
        extremum(0, 2, false),
        extremum(1, 1, true),
        variance(&[2, 1], 1.0, false).sample(&[&[2, 5]]).sample(&[&[2, 40]]),
        variance(&[1, 3, 1], 0.0, false).sample(&[&[2, 3, 4]]).sample(&[&[5, 3, 1]]),
        variance(&[], 0.0, false).sample(&[&[]]),
        variance(&[0, 1], 0.0, false).sample(&[&[0, 4]]),
        Entry::examined(moments::Ratio),
        variance(&[2, 1], 1.0, true).sample(&[&[2, 5]]).sample(&[&[2, 40]]),
        variance(&[1, 3, 1], 0.0, true).sample(&[&[2, 3, 4]]),
        Entry::new(moments::Norm { shape: shape(&[2, 1]) }).sample(&[&[2, 5]]).sample(&[&[2, 40]]),
        Entry::new(moments::Norm { shape: shape(&[1, 3]) }).sample(&[&[4, 3]]),
        Entry::new(moments::Norm { shape: shape(&[]) }).sample(&[&[]]),
        Entry::new(moments::Norm { shape: shape(&[1, 1]) }).sample(&[&[2, 3]]),
        Entry::new(scan::Cumsum(walk(1, false))).linear().sample(&[&[2, 3]]).sample(&[&[2, 3, 2]]).sample(&[&[2, 0]]),
        Entry::new(scan::Cumsum(walk(0, true))).linear().sample(&[&[5]]).sample(&[&[3, 2]]).sample(&[&[0]]),
        Entry::new(scan::Cumprod(walk(1, false)))
            .sample(&[&[2, 4]])
            .sample_of(zeros(&[3, 4], 2))
            .sample_of(zeros(&[3, 4, 2], 5))
            .sample(&[&[2, 0]]),
        Entry::new(scan::Cumprod(walk(0, true))).sample(&[&[4]]).sample_of(zeros(&[5], 3)),
        Entry::new(scan::CumprodGrad(walk(1, false)))
            .sample(&[&[2, 4], &[2, 4]])
            .sample_of(vec![zeros(&[3, 4], 2).remove(0), zeros(&[3, 4], 5).remove(0)])
            .sample(&[&[2, 3, 2], &[2, 3, 2]])
            .sample(&[&[2, 0], &[2, 0]]),
        Entry::new(scan::CumprodGrad(walk(0, true))).sample(&[&[4], &[4]]),
        Entry::new(scan::Recurrence(walk(0, false))).sample(&[&[5], &[5]]).sample(&[&[4, 2], &[4, 2]]),
        Entry::new(scan::Recurrence(walk(1, true))).sample(&[&[2, 4], &[2, 4]]).sample(&[&[2, 0], &[2, 0]]),
        Entry::new(GradientOp { op: scan::Recurrence(walk(0, false)), input: 0 }).sample(&[&[4, 2], &[4, 2], &[4, 2]]),
        Entry::new(GradientOp { op: scan::Recurrence(walk(1, true)), input: 0 }).sample(&[&[2, 4], &[2, 4], &[2, 4]]),
        Entry::new(product::Product)
            .sample(&[&[2, 4]])
            .sample_of(zeros(&[3, 4], 5))
            .sample_of(zeros(&[2, 5], 2))
            .sample(&[&[2, 0]])
            .sample(&[&[1]]),
        Entry::new(softmax::Softmax)
            .sample(&[&[2, 5]])
            .sample(wide)
            .sample(&[&[0, 3]])
            .sample(&[&[2, 0]])
            .sample(&[&[1]]),
        Entry::new(softmax::LogSoftmax).sample(&[&[2, 5]]).sample(wide).sample(&[&[0, 3]]).sample(&[&[2, 0]]),
        Entry::new(softmax::LogSumExp).sample(&[&[2, 5]]).sample(wide).sample(&[&[0, 3]]).sample(&[&[3]]),
        Entry::new(layer_norm::LayerNorm { eps: 1e-3 })
            .sample(&[&[3, 5], &[5], &[5]])
            .sample(&[&[2, 20, 3], &[3], &[3]])
            .sample(&[&[2, 40], &[40], &[40]])
            .sample(&[&[0, 3], &[3], &[3]])
            .sample(&[&[2, 0], &[0], &[0]]),
        layer_norm_grad(0),
        layer_norm_grad(1),
        Entry::new(softmax::SOFTMAX_GRAD).sample(&[&[2, 5], &[2, 5], &[2, 5]]).sample(&[&[0, 3], &[0, 3], &[0, 3]]),
        Entry::new(GradientOp { op: softmax::LogSoftmax, input: 0 }).sample(&[&[2, 5], &[2, 5]]).sample(&[&[3], &[3]]),
        Entry::new(GradientOp { op: softmax::LogSumExp, input: 0 }).sample(&[&[2, 5], &[2]]).sample(&[&[3], &[]]),
        Entry::new(GradientOp { op: product::Product, input: 0 })
            .sample(&[&[2, 4], &[2]])
            .sample_of(vec![zeros(&[3, 4], 5).remove(0), spread(&[3], &[0.3..1.0], 1)])
            .sample(&[&[2, 0], &[2]]),
    ]
}

/// Losses.
fn losses() -> Vec<Entry> {
    let of_classes = |classes: &[u32]| Entry::new(cross_entropy::CrossEntropy { classes: classes.into() });
    vec![
        Entry::new(loss::MeanLoss(loss::SquaredError)).sample(&[&[2, 3], &[2, 3], &[2, 3]]).sample(&[&[], &[], &[]]),
        Entry::new(cross_entropy::MeanCrossEntropy { classes: [2, 0, 2].into() }).sample(&[&[3], &[3, 4]]),
        of_classes(&[2, 0, 2]).sample(&[&[3, 4]]).sample(&[&[3, 40]]).sample(&[&[1, 3, 3]]),
        Entry::new(GradientOp { op: cross_entropy::CrossEntropy { classes: [2, 0, 2].into() }, input: 0 })
            .sample(&[&[3, 4], &[3]])
            .sample(&[&[1, 3, 3], &[1, 3]]),
        of_classes(&[1]).sample(&[&[2]]),
        of_classes(&[]).sample(&[&[0, 3]]),
    ]
}

/// Arithmetic, products, shapes, tables and segments.
fn core() -> Vec<Entry> {
    let shape = |extents: &[usize]| Shape::from_slice(extents);
    let segments = || Segments::new([0, 3, 3, 4, 7]);
    let sum = |extents: &[usize], mean| reduce::SumTo { shape: shape(extents), mean };
    let cumsum = |exclusive, reverse| segment::SegmentCumsum { segments: segments(), exclusive, reverse };
    let mut entries = vec![
        Entry::new(arithmetic::IfPositive).sample(&[&[2, 3], &[2, 3], &[3]]).sample(&[&[4], &[], &[4]]),
        Entry::new(matmul::Matmul).sample(&[&[3, 4], &[4, 2]]).sample(&[&[0, 4], &[4, 2]]).sample(&[&[3, 0], &[0, 2]]),
        Entry::new(linear::LinearOp(Activation::Identity))
            .sample(&[&[5, 3], &[3, 4], &[4]])
            .sample(&[&[5, 3], &[3, 4]]),
        Entry::new(linear::LinearOp(Activation::Relu))
            .sample(&[&[5, 3], &[3, 4], &[4]])
            .sample(&[&[2, 5, 3], &[3, 4]])
            .sample(&[&[0, 3], &[3, 4], &[4]]),
        Entry::new(sum(&[], false)).linear().sample(&[&[2, 3]]).sample(&[&[]]).sample(&[&[0, 2]]),
        Entry::new(sum(&[3, 1], false)).linear().sample(&[&[2, 3, 4]]).sample(&[&[3, 1]]),
        Entry::new(sum(&[], true)).linear().sample(&[&[2, 3]]).sample(&[&[]]),
        Entry::new(sum(&[3, 1], true)).linear().sample(&[&[2, 3, 4]]).sample(&[&[3, 1]]),
        Entry::new(reduce::BroadcastTo { shape: shape(&[2, 3, 4]), divided: false })
            .linear()
            .sample(&[&[3, 1]])
            .sample(&[&[]]),
        Entry::new(reduce::BroadcastTo { shape: shape(&[2, 3, 4]), divided: true })
            .linear()
            .sample(&[&[3, 1]])
            .sample(&[&[]]),
        Entry::new(shape::Reshape { shape: shape(&[3, 2]) }).linear().sample(&[&[2, 3]]).sample(&[&[6]]),
        Entry::new(shape::Concat { axis: 1 }).linear().sample(&[&[2, 3], &[2, 1], &[2, 0]]).sample(&[&[2, 3]]),
        Entry::new(segment::SegmentSum(segments())).linear().sample(&[&[7]]).sample(&[&[7, 2]]),
        Entry::new(segment::SegmentExpand(segments())).linear().sample(&[&[4]]).sample(&[&[4, 2]]),
        Entry::new(cumsum(false, false)).linear().sample(&[&[7]]).sample(&[&[7, 2]]),
        Entry::new(cumsum(true, false)).linear().sample(&[&[7]]),
        Entry::new(cumsum(true, true)).linear().sample(&[&[7, 3]]),
    ];
    entries.extend(super::arrays::entries());
    entries
}
