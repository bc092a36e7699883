//! The catalogue: every operation with the inputs it is checked on and its values at extremes.

use crate::elementwise::{Binary, Map, Unary, Zip};
use crate::ops::trigonometric;
use crate::ops::{
    Activation, Segments, activation, arithmetic, exponential, gather, linear, matmul, reduce, segment, shape,
};
use crate::ops::{extremum, layer_norm, loss, moments, piecewise, power, product, scan, select, softmax};
use crate::{Dual, Op};
use raygrad_tensor::{Layout, Shape, Tensor};
use std::ops::Range;
use std::sync::Arc;

/// Where an elementwise formula is sampled, and what it gives at extremes.
#[derive(Debug, Clone, Default)]
pub struct Cases {
    linear: bool,
    /// For each input the ranges that samples are drawn from.
    domains: Vec<Vec<Range<f64>>>,
    extremes: Vec<Extreme>,
}

/// The exact value and gradients at one point, chosen because naive formulas fail there.
#[derive(Debug, Clone)]
pub struct Extreme {
    /// The inputs.
    pub x: Vec<f64>,
    /// The value; NaN if it is to be NaN.
    pub y: f64,
    /// The gradient of each input for a gradient of 1.
    pub grads: Vec<f64>,
}

impl Cases {
    /// The function is linear, which is checked too.
    pub fn linear(&mut self) -> &mut Self {
        self.linear = true;
        self
    }

    /// The range of the next input.
    pub fn domain(&mut self, range: Range<f64>) -> &mut Self {
        self.domains.push(vec![range]);
        self
    }

    /// A further range of the last input, for a function with a gap: samples alternate between the ranges.
    pub fn domain_also(&mut self, range: Range<f64>) -> &mut Self {
        if let Some(last) = self.domains.last_mut() {
            last.push(range);
        }
        self
    }

    /// The value `y` and the gradients at `x`.
    pub fn at<const N: usize>(&mut self, x: [f64; N], y: f64, grads: [f64; N]) -> &mut Self {
        self.extremes.push(Extreme { x: x.into(), y, grads: grads.into() });
        self
    }
}

/// An elementwise formula on dual numbers.
type DualFormula = Box<dyn Fn(&[Dual]) -> Dual>;

/// One operation as the checks see it: for f64, for f32, and what to feed it.
pub struct Entry {
    /// The operation's name.
    pub name: &'static str,
    /// Whether it is linear in all inputs together.
    pub linear: bool,
    /// Sets of inputs.
    pub samples: Vec<Vec<Tensor<f64>>>,
    /// Exact values.
    pub extremes: Vec<Extreme>,
    pub(crate) f64: Arc<dyn Op<f64>>,
    pub(crate) f32: Arc<dyn Op<f32>>,
    pub(crate) dual: Option<DualFormula>,
}

impl Entry {
    /// An operation without samples.
    pub fn new<O: Op<f64> + Op<f32> + Clone>(op: O) -> Self {
        Entry::of(op.clone(), op)
    }

    /// As [`new`](Self::new), for an operation that holds tensors and so has a value of its own in each precision.
    pub fn of(f64: impl Op<f64>, f32: impl Op<f32>) -> Self {
        let name = f64.name();
        let (f64, f32) = (Arc::new(f64), Arc::new(f32));
        Entry { name, linear: false, samples: vec![], extremes: vec![], f64, f32, dual: None }
    }

    /// A further set of inputs, of these shapes, with values in -1..1.
    pub fn sample(mut self, shapes: &[&[usize]]) -> Self {
        let inputs =
            shapes.iter().enumerate().map(|(i, shape)| spread(shape, &[-1.0..1.0], i + 7 * self.samples.len()));
        let inputs = inputs.collect();
        self.samples.push(inputs);
        self
    }

    /// A further set of inputs.
    pub fn sample_of(mut self, inputs: Vec<Tensor<f64>>) -> Self {
        self.samples.push(inputs);
        self
    }

    /// The operation is linear, which is checked too.
    pub fn linear(self) -> Self {
        Entry { linear: true, ..self }
    }

    /// A function of one number.
    pub fn unary<U: Unary>(op: U) -> Self {
        let mut cases = Cases::default();
        op.cases(&mut cases);
        let entry = Entry { dual: Some(Box::new(move |x| op.f(x[0]))), ..Entry::new(Map(op)) };
        entry.elementwise(cases, &[&[&[2, 3]], &[&[]], &[&[0, 3]], &[&[37]]])
    }

    /// A function of two numbers.
    pub fn binary<B: Binary>(op: B) -> Self {
        let mut cases = Cases::default();
        op.cases(&mut cases);
        let entry = Entry { dual: Some(Box::new(move |x| op.f(x[0], x[1]))), ..Entry::new(Zip(op)) };
        let same: &[&[usize]] = &[&[2, 3], &[2, 3]];
        entry.elementwise(
            cases,
            &[same, &[&[4, 1], &[3]], &[&[], &[2]], &[&[0, 1], &[3]], &[&[2, 1, 2], &[1]], &[&[], &[]]],
        )
    }

    fn elementwise(self, cases: Cases, shapes: &[&[&[usize]]]) -> Self {
        let set = |(k, shapes): (usize, &&[&[usize]])| {
            shapes.iter().zip(&cases.domains).enumerate().map(|(i, (s, d))| spread(s, d, i + 7 * k)).collect()
        };
        let samples = shapes.iter().enumerate().map(set).collect();
        Entry { samples, linear: cases.linear, extremes: cases.extremes, ..self }
    }
}

/// Reproducible values that fill the ranges evenly and follow no pattern that an error could hide in.
pub(crate) fn spread(shape: &[usize], ranges: &[Range<f64>], salt: usize) -> Tensor<f64> {
    const GOLDEN: f64 = 0.618_033_988_749_894_9;
    Tensor::from_fn(shape, |i| {
        let range = &ranges[i % ranges.len()];
        let unit = ((i + 1) as f64 * GOLDEN + salt as f64 * 0.377).fract();
        range.start + unit * (range.end - range.start)
    })
}

/// Every operation of this crate.
pub fn catalogue() -> Vec<Entry> {
    [core(), elementwise(), reductions(), losses()].into_iter().flatten().collect()
}

/// Functions of one, two and three numbers.
fn elementwise() -> Vec<Entry> {
    use select::Compare::{Equal, Greater, GreaterEqual, Less, LessEqual, NotEqual};
    // Powers of both signs, of 0 and of 1 have conventions of their own.
    let powi = [0, 1, 5, -4].map(|exponent| Entry::unary(power::Powi { exponent }));
    let powers =
        [Entry::unary(power::ConstPowi::<2>), Entry::unary(power::ConstPowi::<3>), Entry::unary(power::ConstPowi::<4>)];
    let powf = [0.0, 0.5, 1.5, 2.0, 2.5, -0.5].map(|exponent| Entry::unary(power::Powf { exponent }));
    // Values that are equal in places, and that no step of a difference takes past each other.
    let ranks = |shape: &[usize], step: usize| Tensor::from_fn(shape, |i| ((i * step) % 5) as f64);
    let compare = [Greater, GreaterEqual, Less, LessEqual].map(|comparison| {
        let apart = |i: usize| Tensor::from_fn(&[2, 3], |k| (k + i * (2 * k % 3)) as f64 + 0.5 * i as f64);
        let apart = vec![apart(0), apart(1)];
        Entry::new(comparison).sample_of(apart).sample(&[&[0, 1], &[3]]).sample(&[&[], &[]])
    });
    let equal = [Equal, NotEqual].map(|comparison| {
        Entry::new(comparison).sample(&[&[2, 3], &[3]]).sample(&[&[0, 1], &[3]]).sample(&[&[], &[2]])
    });
    let mask = |shape: &[usize]| ranks(shape, 3);
    let choice = |shape: &[usize], others: [&[usize]; 2]| {
        let others = others.iter().enumerate().map(|(i, shape)| spread(shape, &[-1.0..1.0], i + 3));
        std::iter::once(mask(shape)).chain(others).collect::<Vec<_>>()
    };
    let rest = vec![
        Entry::unary(exponential::Exp2),
        Entry::unary(exponential::Log2),
        Entry::unary(exponential::Rsqrt),
        Entry::unary(exponential::Erf),
        Entry::unary(trigonometric::Tan),
        Entry::unary(trigonometric::Asin),
        Entry::unary(trigonometric::Acos),
        Entry::unary(trigonometric::Atan),
        Entry::binary(trigonometric::Atan2),
        Entry::unary(trigonometric::Sinh),
        Entry::unary(trigonometric::Cosh),
        Entry::unary(activation::LogSigmoid),
        Entry::unary(activation::LeakyRelu { slope: 0.125 }),
        Entry::unary(activation::Elu { alpha: 1.5 }),
        Entry::unary(activation::Gelu),
        Entry::unary(activation::GeluTanh),
        Entry::unary(activation::Silu),
        Entry::unary(piecewise::Abs),
        Entry::unary(piecewise::Sign),
        Entry::binary(piecewise::Maximum),
        Entry::binary(piecewise::Minimum),
        Entry::unary(piecewise::Clamp { low: -1.0, high: 2.0 }),
        Entry::unary(piecewise::Floor),
        Entry::unary(piecewise::Ceil),
        Entry::unary(piecewise::Round),
        Entry::unary(power::Reciprocal),
        Entry::binary(power::Pow),
        Entry::binary(power::Xlogy),
        Entry::new(select::Where)
            .sample_of(choice(&[2, 3], [&[2, 3], &[3]]))
            .sample_of(choice(&[3], [&[2, 1], &[]]))
            .sample_of(choice(&[0, 3], [&[3], &[1]]))
            .sample_of(choice(&[], [&[], &[]])),
        Entry::new(select::Lerp).sample(&[&[2, 3], &[2, 3], &[2, 3]]).sample(&[&[3], &[2, 1], &[]]).sample(&[
            &[0, 3],
            &[3],
            &[1],
        ]),
    ];
    powi.into_iter().chain(powers).chain(powf).chain(compare).chain(equal).chain(rest).collect()
}

/// What makes fewer numbers out of many, and what runs along an axis.
fn reductions() -> Vec<Entry> {
    let shape = |extents: &[usize]| Shape::from_slice(extents);
    let variance = |extents: &[usize], correction| moments::Variance { shape: shape(extents), correction };
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
    let walk = |axis, reverse| scan::Walk { axis, reverse };
    let wide: &[&[usize]] = &[&[3, 40]];
    vec![
        extremum(1, 3, true),
        extremum(0, 2, false),
        extremum(1, 1, true),
        Entry::new(moments::Variance { correction: 1.0, ..variance(&[2, 1], 0.0) })
            .sample(&[&[2, 5]])
            .sample(&[&[2, 40]]),
        Entry::new(variance(&[1, 3, 1], 0.0)).sample(&[&[2, 3, 4]]).sample(&[&[5, 3, 1]]),
        Entry::new(variance(&[], 0.0)).sample(&[&[]]),
        Entry::new(variance(&[0, 1], 0.0)).sample(&[&[0, 4]]),
        Entry::new(moments::Deviation(variance(&[2, 1], 1.0))).sample(&[&[2, 5]]).sample(&[&[2, 40]]),
        Entry::new(moments::Deviation(variance(&[1, 3, 1], 0.0))).sample(&[&[2, 3, 4]]),
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
        Entry::new(scan::Recurrence(walk(0, false))).sample(&[&[5], &[5]]).sample(&[&[4, 2], &[4, 2]]),
        Entry::new(scan::Recurrence(walk(1, true))).sample(&[&[2, 4], &[2, 4]]).sample(&[&[2, 0], &[2, 0]]),
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
    ]
}

/// Losses.
fn losses() -> Vec<Entry> {
    let cross_entropy = |classes: &[u32]| Entry::new(loss::CrossEntropy { classes: classes.into() });
    vec![
        Entry::binary(loss::SquaredError),
        Entry::binary(loss::AbsoluteError),
        Entry::binary(loss::Huber { delta: 0.5 }),
        Entry::binary(loss::SmoothL1 { beta: 0.5 }),
        Entry::binary(loss::SmoothL1 { beta: 0.0 }),
        Entry::binary(loss::BinaryCrossEntropy),
        cross_entropy(&[2, 0, 2]).sample(&[&[3, 4]]).sample(&[&[3, 40]]).sample(&[&[1, 3, 3]]),
        cross_entropy(&[1]).sample(&[&[2]]),
        cross_entropy(&[]).sample(&[&[0, 3]]),
    ]
}

/// Arithmetic, products, shapes, tables and segments.
fn core() -> Vec<Entry> {
    let shape = |extents: &[usize]| Shape::from_slice(extents);
    let segments = || Segments::new([0, 3, 3, 4, 7]);
    let view = |from: &[usize], layout: fn(Layout) -> Layout| shape::View {
        from: Shape::from_slice(from),
        layout: layout(Layout::contiguous(from)),
    };
    let cumsum = |exclusive, reverse| segment::SegmentCumsum { segments: segments(), exclusive, reverse };
    let mut entries = vec![
        Entry::binary(arithmetic::Add),
        Entry::binary(arithmetic::Sub),
        Entry::binary(arithmetic::Mul),
        Entry::binary(arithmetic::Div),
        Entry::unary(arithmetic::Affine { scale: -2.5, shift: 0.75 }),
        Entry::unary(arithmetic::Alias),
        Entry::new(arithmetic::IfPositive).sample(&[&[2, 3], &[2, 3], &[3]]).sample(&[&[4], &[], &[4]]),
        Entry::unary(exponential::Exp),
        Entry::unary(exponential::Expm1),
        Entry::unary(exponential::Ln),
        Entry::unary(exponential::Ln1p),
        Entry::unary(exponential::Sqrt),
        Entry::unary(trigonometric::Sin),
        Entry::unary(trigonometric::Cos),
        Entry::unary(trigonometric::SinPi),
        Entry::unary(trigonometric::CosPi),
        Entry::unary(trigonometric::Tanh),
        Entry::unary(activation::Relu),
        Entry::unary(activation::Sigmoid),
        Entry::unary(activation::Softplus),
        Entry::new(matmul::Matmul).sample(&[&[3, 4], &[4, 2]]).sample(&[&[0, 4], &[4, 2]]).sample(&[&[3, 0], &[0, 2]]),
        Entry::new(linear::LinearOp(Activation::Identity))
            .sample(&[&[5, 3], &[3, 4], &[4]])
            .sample(&[&[5, 3], &[3, 4]]),
        Entry::new(linear::LinearOp(Activation::Relu))
            .sample(&[&[5, 3], &[3, 4], &[4]])
            .sample(&[&[2, 5, 3], &[3, 4]])
            .sample(&[&[0, 3], &[3, 4], &[4]]),
        Entry::new(reduce::SumTo { shape: shape(&[]) }).linear().sample(&[&[2, 3]]).sample(&[&[]]).sample(&[&[0, 2]]),
        Entry::new(reduce::SumTo { shape: shape(&[3, 1]) }).linear().sample(&[&[2, 3, 4]]).sample(&[&[3, 1]]),
        Entry::new(reduce::BroadcastTo { shape: shape(&[2, 3, 4]) }).linear().sample(&[&[3, 1]]).sample(&[&[]]),
        Entry::new(shape::Reshape { shape: shape(&[3, 2]) }).linear().sample(&[&[2, 3]]).sample(&[&[6]]),
        Entry::new(view(&[2, 3, 4], |layout| layout.permuted(&[2, 0, 1]))).linear().sample(&[&[2, 3, 4]]),
        Entry::new(view(&[4, 5], |layout| layout.sliced(1, 4, 2, -3))).linear().sample(&[&[4, 5]]),
        Entry::new(shape::Scatter(view(&[4, 5], |layout| layout.sliced(1, 1, 3, 1)))).linear().sample(&[&[4, 3]]),
        Entry::new(shape::Concat { axis: 1 }).linear().sample(&[&[2, 3], &[2, 1], &[2, 0]]).sample(&[&[2, 3]]),
        Entry::new(gather::GatherRows { index: [2, 0, 2, 3].into() }).linear().sample(&[&[4]]).sample(&[&[5, 3]]),
        Entry::new(gather::GatherRows { index: [].into() }).linear().sample(&[&[4]]).sample(&[&[0, 3]]),
        Entry::new(gather::ScatterRows { index: [2, 0, 2].into(), rows: 4 })
            .linear()
            .sample(&[&[3]])
            .sample(&[&[3, 2]]),
        Entry::new(segment::SegmentSum(segments())).linear().sample(&[&[7]]).sample(&[&[7, 2]]),
        Entry::new(segment::SegmentExpand(segments())).linear().sample(&[&[4]]).sample(&[&[4, 2]]),
        Entry::new(cumsum(false, false)).linear().sample(&[&[7]]).sample(&[&[7, 2]]),
        Entry::new(cumsum(true, false)).linear().sample(&[&[7]]),
        Entry::new(cumsum(true, true)).linear().sample(&[&[7, 3]]),
    ];
    entries.extend(crate::catalogue_arrays::entries());
    entries
}
