//! Errors of elementwise operations in units in the last place, over all bits of arguments and incoming gradients.
//!
//! Values and gradients are compared one by one with a reference of 100 bits ([`exact`]). Arguments are drawn from all
//! bit patterns, close to kinks and borders, and where functions are used; incoming gradients from all bit patterns, and
//! so that the result is a normal number. `ACCURACY_DRAWS` sets how many, `ACCURACY_ONLY=gelu,tanh` which operations.
//! `ACCURACY_DUMP` names a folder for arguments and exact results, which `benches/peers/accuracy.py` reads.

mod exact;
mod operations;

use exact::Exact;
use operations::{Operation, Reference, operations};
use raygrad_autograd::{Scalar, Tape, Tensor, Var};
use rayon::prelude::*;

/// Errors above this many units in the last place are breaches.
const GATE: f64 = 8.0;

/// The same for values of the functions of docs/library/vector-math.md that are within 2.
const FUNCTIONS: [&str; 26] = [
    "exp",
    "expm1",
    "exp2",
    "ln",
    "ln1p",
    "log2",
    "sqrt",
    "erf",
    "sin",
    "cos",
    "sin_pi",
    "cos_pi",
    "tan",
    "asin",
    "acos",
    "atan",
    "sinh",
    "cosh",
    "tanh",
    "abs",
    "sigmoid",
    "softplus",
    "atan2",
    "hypot",
    "pow",
    "remainder",
];

/// A float format.
struct Format {
    digits: i64,
    least: i64,
    greatest: i64,
}

impl Format {
    fn of<T: Scalar>() -> Format {
        if size_of::<T>() == 4 {
            Format { digits: 23, least: -126, greatest: 127 }
        } else {
            Format { digits: 52, least: -1022, greatest: 1023 }
        }
    }

    /// The exponent of a unit in the last place of the exact result or of its largest term.
    fn unit(&self, exact: Exact, term: Exact) -> i64 {
        // A zero has no exponent.
        let exponent = |x: Exact| if x.is_zero() { self.least } else { x.exponent() };
        exponent(exact).max(exponent(term)).max(self.least) - self.digits
    }

    /// The error of `got`, in units in the last place of the exact result or of its largest term. Infinite where the
    /// result should be infinite or NaN and is not, or the other way round.
    fn error(&self, got: f64, exact: Exact, term: Exact) -> f64 {
        if !exact.is_finite() {
            let same = got == exact.to_f64() || got.is_nan() && exact.to_f64().is_nan();
            return if same { 0.0 } else { f64::INFINITY };
        }
        let unit = self.unit(exact, term);
        let (limit, sign) = (Exact::new(1.0).shifted(self.greatest + 1), if exact.is_negative() { -1.0 } else { 1.0 });
        if exact.abs() >= limit && got == sign * f64::INFINITY {
            return 0.0;
        }
        // Infinity stands for the number after the largest.
        let got = if got == sign * f64::INFINITY { Exact::new(sign) * limit } else { Exact::new(got) };
        if !got.is_finite() {
            return f64::INFINITY;
        }
        (got - exact).abs().shifted(-unit).to_f64()
    }
}

/// Random bits (SplitMix64).
struct Random(u64);

impl Random {
    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let x = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ x >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ x >> 31
    }

    fn below(&mut self, n: i64) -> i64 {
        (self.bits() % n as u64) as i64
    }

    /// A number with this exponent, of either sign.
    fn of_exponent<T: Scalar>(&mut self, exponent: i64) -> f64 {
        let fraction = 1.0 + self.bits() as f64 / 2.0_f64.powi(64);
        let x = Exact::new(fraction).shifted(exponent).to_f64();
        // Rounded to the type; an overflow is the largest number.
        let x = T::from_f64(x).to_f64();
        let x = if x.is_finite() { x } else { Exact::new(1.0).shifted(exponent - 1).to_f64() };
        if self.bits() & 1 == 0 { x } else { -x }
    }

    /// Any finite bit pattern.
    fn pattern<T: Scalar>(&mut self) -> f64 {
        loop {
            let bytes = self.bits().to_le_bytes();
            let x = T::read_le(&bytes[..size_of::<T>()]).to_f64();
            if x.is_finite() {
                return x;
            }
        }
    }

    /// An argument: of any bits, of the size that is used, or close to a place where something changes.
    fn argument<T: Scalar>(&mut self) -> f64 {
        const PLACES: [f64; 24] = [
            0.0, 0.25, 0.5, 0.55, 0.92, 1.0, 1.278, 2.0, 2.5, 5.0, 8.0, 13.2, 17.3, 20.0, 38.5, 65536.0, 87.34, 88.72,
            103.97, 709.78, 745.13, 1e9, 1e-9, 0.7518,
        ];
        match self.below(8) {
            0..3 => self.pattern::<T>(),
            3..5 => {
                let exponent = self.below(24) - 12;
                self.of_exponent::<T>(exponent)
            }
            5 => {
                let exponent = self.below(9);
                self.of_exponent::<T>(exponent)
            }
            6 => {
                let whole = self.below(1 << 20) as f64;
                T::from_f64(whole * [1.0, 0.5, std::f64::consts::FRAC_PI_2][self.below(3) as usize]).to_f64()
            }
            _ => {
                let format = Format::of::<T>();
                let place = match self.below(27) {
                    24 => T::from_f64(f64::from(f32::MAX)).to_f64(),
                    25 => 2.0_f64.powi(format.least as i32),
                    26 => 2.0_f64.powi(format.greatest as i32),
                    k => PLACES[k as usize],
                };
                let step = 2.0_f64.powi(-(self.below(format.digits + 1)) as i32);
                let x = T::from_f64(place * (1.0 + step * (self.below(3) - 1) as f64)).to_f64();
                let x = if x.is_finite() { x } else { place };
                if self.below(2) == 0 { x } else { -x }
            }
        }
    }

    /// The same operands; one time in four the second is equal or close to the first.
    fn related<T: Scalar>(&mut self, mut x: Vec<f64>) -> Vec<f64> {
        if x.len() > 1 && self.below(4) == 0 {
            let step = 2.0_f64.powi(-(self.below(Format::of::<T>().digits + 2)) as i32);
            let near = T::from_f64(x[0] * (1.0 + step * (self.below(3) - 1) as f64)).to_f64();
            x[1] = if near.is_finite() { near } else { x[0] };
        }
        x
    }

    /// An incoming gradient: of any bits, or so that a gradient is a normal number.
    fn gradient<T: Scalar>(&mut self, reference: &Reference) -> f64 {
        let slope = reference.slopes[self.below(reference.slopes.len() as i64) as usize].0;
        if self.below(32) == 0 {
            return 0.0;
        }
        if self.below(2) == 0 || slope.is_zero() || !slope.is_finite() {
            return self.pattern::<T>();
        }
        let format = Format::of::<T>();
        let lowest = format.least - format.digits;
        let target = lowest + self.below(format.greatest - lowest + 1);
        self.of_exponent::<T>((target - slope.exponent()).clamp(lowest, format.greatest))
    }
}

/// The worst and the mean error of a column, and where the worst was.
#[derive(Default, Clone)]
struct Column {
    worst: f64,
    at: Vec<f64>,
    sum: f64,
    count: usize,
    breaches: usize,
}

impl Column {
    fn add(&mut self, error: f64, gate: f64, at: impl FnOnce() -> Vec<f64>) {
        if error > self.worst || self.count == 0 {
            (self.worst, self.at) = (error, at());
        }
        self.sum += if error.is_finite() { error } else { 0.0 };
        self.count += 1;
        self.breaches += usize::from(!(error <= gate));
    }
}

/// A file of arguments, gradients and exact results for `benches/peers/accuracy.py`: the number of operands, and for
/// each case the arguments, the incoming gradient, and what [`Dump::result`] writes of the value and of each gradient.
struct Dump(Option<std::io::BufWriter<std::fs::File>>);

impl Dump {
    fn new<T: Scalar>(name: &str, operands: usize) -> Dump {
        let folder = std::env::var("ACCURACY_DUMP").ok().filter(|folder| !folder.is_empty());
        let path = folder.map(|folder| format!("{folder}/{}.{}", name.replace(", ", "_"), T::NAME));
        let mut dump = Dump(path.map(|path| std::io::BufWriter::new(std::fs::File::create(path).unwrap())));
        dump.numbers(&[operands as f64]);
        dump
    }

    fn numbers(&mut self, numbers: &[f64]) {
        use std::io::Write;
        if let Some(file) = &mut self.0 {
            numbers.iter().for_each(|x| file.write_all(&x.to_le_bytes()).unwrap());
        }
    }

    /// The exact result as a sum of two numbers in units in the last place, the exponent of the unit, and the error of
    /// this result. A result that is not compared has NaN as its error.
    fn result(&mut self, format: &Format, exact: Exact, term: Exact, error: f64) {
        let unit = if exact.is_finite() { format.unit(exact, term) } else { 0 };
        let [high, low] = exact.shifted(-unit).parts();
        self.numbers(&[high, low, unit as f64, error]);
    }
}

/// The errors of the value and of the gradient by each operand.
fn examine<T: Scalar>(operation: &Operation<T>, draws: usize) -> Vec<Column> {
    let mut columns = vec![Column::default(); 1 + operation.operands];
    let (format, mut dump) = (Format::of::<T>(), Dump::new::<T>(operation.name, operation.operands));
    for (batch, start) in (0..draws).step_by(1 << 14).enumerate() {
        let n = (draws - start).min(1 << 14);
        let cases: Vec<(Vec<f64>, Reference, f64)> = (0..n)
            .into_par_iter()
            .map(|i| {
                let mut random = Random((batch as u64) << 32 | i as u64);
                random.bits();
                let x: Vec<f64> = (0..operation.operands).map(|_| random.argument::<T>()).collect();
                let x = (operation.domain)(random.related::<T>(x));
                let reference = (operation.reference)(&x);
                let g = random.gradient::<T>(&reference);
                (x, reference, g)
            })
            .collect();
        let tape = Tape::<T>::new();
        let column = |f: &dyn Fn(usize) -> f64| Tensor::from_fn(&[n], |i| T::from_f64(f(i)));
        let x: Vec<_> = (0..operation.operands).map(|k| tape.leaf(column(&|i| cases[i].0[k]))).collect();
        let y = (operation.function)(&x);
        let grads = tape.no_grad(|| y.vjp(&tape.constant(column(&|i| cases[i].2)), &x.iter().collect::<Vec<_>>()));
        for (i, (x, reference, g)) in cases.iter().enumerate() {
            let value = y.value().as_slice()[i].to_f64();
            dump.numbers(x);
            dump.numbers(&[*g]);
            let g_exact = Exact::new(*g);
            let slopes = reference.slopes.iter().map(|&(slope, term)| Some((g_exact * slope, g_exact * term)));
            let got = grads.iter().map(|grad| grad.value().as_slice()[i].to_f64());
            for (k, (exact, got)) in
                [reference.value].into_iter().chain(slopes).zip([value].into_iter().chain(got)).enumerate()
            {
                // Conventions decide at a few points, and a derivative is compared where the value is finite.
                let exact = exact.filter(|(exact, _)| k == 0 || exact.is_finite() && value.is_finite());
                let is_compared = exact.is_some();
                let gate = if k == 0 && FUNCTIONS.contains(&operation.name) { 2.0 } else { GATE };
                let (exact, term) = exact.unwrap_or((Exact::ZERO, Exact::ZERO));
                let error = if is_compared { format.error(got, exact, term) } else { f64::NAN };
                dump.result(&format, exact, term, error);
                if is_compared {
                    columns[k].add(error, gate, || x.iter().copied().chain((k > 0).then_some(*g)).collect());
                }
            }
        }
    }
    columns
}

/// Prints a row for each operation and returns the breaches.
fn check<T: Scalar>(draws: usize) -> Vec<String> {
    let only = std::env::var("ACCURACY_ONLY").unwrap_or_default();
    let mut failed = vec![];
    for operation in operations::<T>() {
        if !only.is_empty() && !only.split(',').any(|name| operation.name.starts_with(name)) {
            continue;
        }
        for (k, column) in examine(&operation, draws).into_iter().enumerate() {
            let of = if k == 0 { "value".to_string() } else { format!("gradient {k}") };
            let mean = column.sum / column.count.max(1) as f64;
            let row = format!(
                "{:<16} {} {of:<10} {:>9.3} {mean:>7.3} {:>7} of {:>7}  {:e}",
                operation.name,
                T::NAME,
                column.worst,
                column.breaches,
                column.count,
                Places(&column.at),
            );
            println!("{row}");
            if column.breaches > 0 || column.count < draws / 10 {
                failed.push(row);
            }
        }
    }
    failed
}

/// Arguments as numbers with exponents.
struct Places<'a>(&'a [f64]);

impl std::fmt::LowerExp for Places<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.iter().try_for_each(|x| write!(f, " {x:e}"))
    }
}

#[test]
fn every_operation_is_within_8_units_in_the_last_place() {
    let draws = std::env::var("ACCURACY_DRAWS").map_or(2000, |draws| draws.parse().unwrap());
    let failed: Vec<_> = check::<f32>(draws).into_iter().chain(check::<f64>(draws)).collect();
    assert!(failed.is_empty(), "beyond {GATE} units in the last place:\n{}", failed.join("\n"));
}

/// A function of one operand in single precision.
type Single = for<'t> fn(&Var<'t, f32>) -> Var<'t, f32>;

/// A function of two operands in double precision.
type Double = for<'t> fn(&Var<'t, f64>, &Var<'t, f64>) -> Var<'t, f64>;

/// The gradient of one function at many arguments, for one incoming gradient.
fn gradient(f: Single, x: &[f32], g: f32) -> Vec<f32> {
    let tape = Tape::new();
    let x = tape.leaf(Tensor::from_vec(&[x.len()], x.to_vec()));
    let y = f(&x);
    let g = tape.constant(Tensor::full(y.shape(), g));
    tape.no_grad(|| y.vjp(&g, &[&x])).remove(0).value().as_slice().to_vec()
}

/// Blocks with an extreme element run again: that changes no other element.
#[test]
fn no_element_depends_on_its_neighbours() {
    let functions: [Single; 11] = [
        |x| x.exp(),
        |x| x.tanh(),
        |x| x.sigmoid(),
        |x| x.softplus(),
        |x| x.gelu(),
        |x| x.gelu_tanh(),
        |x| x.silu(),
        |x| x.reciprocal(),
        |x| x.powi(3),
        |x| x.powf(1.75),
        |x| x.rsqrt(),
    ];
    let x: Vec<f32> = (0..1000).map(|i| 0.01 + i as f32 * 0.003).collect();
    for (k, f) in functions.into_iter().enumerate() {
        let alone = gradient(f, &x, 0.7);
        for extreme in [1e-30, 1e30, -100.0, f32::NAN] {
            let with: Vec<f32> = x.iter().copied().chain([extreme]).collect();
            assert_eq!(gradient(f, &with, 0.7)[..1000], alone, "function {k} beside {extreme}");
        }
    }
}

/// Gradients that are recorded for higher orders are ordinary products, but no worse than that.
#[test]
fn recorded_slopes_are_in_range_where_their_factors_are() {
    let tape = Tape::<f32>::new();
    let recorded = |f: Single, x: f32| {
        let x = tape.leaf(Tensor::scalar(x));
        let first = f(&x).grad_graph(&[&x]).remove(0);
        [first.item(), first.grad(&[&x])[0].item()]
    };
    assert_eq!(recorded(|x| x.powf(2.0), 1e-23), [2e-23, 2.0]);
    assert!((recorded(|x| x.sinh(), 89.0)[0] / 2.244_806_2e38 - 1.0).abs() < 1e-6);
    assert_eq!(recorded(|x| x.tanh(), 0.0), [1.0, 0.0]);
    assert_eq!(recorded(|x| x.sigmoid(), 0.0), [0.25, 0.0]);
    let third = |f: Single| {
        let x = tape.leaf(Tensor::scalar(0.0));
        let second = f(&x).grad_graph(&[&x]).remove(0).grad_graph(&[&x]).remove(0);
        second.grad(&[&x])[0].item()
    };
    assert_eq!((third(|x| x.tanh()), third(|x| x.sigmoid())), (-2.0, -0.125));
}

/// A vector without direction has no derivative of any order, and one that is NaN has no gradient but NaN.
#[test]
fn directions_and_lengths_at_the_origin_and_of_nan() {
    let functions: [Double; 2] = [|a, b| a.hypot(b), |a, b| a.atan2(b)];
    for f in functions {
        let tape = Tape::new();
        let [a, b] = [0.0, 0.0].map(|x| tape.leaf(Tensor::scalar(x)));
        let grads = f(&a, &b).grad_graph(&[&a, &b]);
        for grad in grads {
            let second: Vec<f64> = grad.grad(&[&a, &b]).iter().map(Tensor::item).collect();
            assert_eq!((grad.item(), &second[..]), (0.0, &[0.0; 2][..]));
        }
        let [a, b] = [f64::NAN, 2.0].map(|x| tape.leaf(Tensor::scalar(x)));
        assert!(f(&a, &b).grad(&[&a, &b]).iter().all(|grad| grad.item().is_nan()));
    }
}

/// Values of mpmath, written by `reference/exact.py`.
#[test]
fn reference_agrees_with_mpmath() {
    let path = std::env::var("EXACT").unwrap_or_else(|_| "tests/reference/exact.bin".into());
    let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{path}: {error}"));
    let functions: [fn(f64) -> Exact; 21] = [
        |x| Exact::new(x).exp(),
        |x| Exact::new(x).expm1(),
        |x| Exact::new(x).ln(),
        |x| Exact::new(x).ln1p(),
        |x| Exact::sin_cos(x)[0],
        |x| Exact::sin_cos(x)[1],
        |x| Exact::sin_cos_pi(x)[0],
        |x| Exact::sin_cos_pi(x)[1],
        |x| Exact::new(x).atan(),
        |x| operations::asin(Exact::new(x)),
        |x| operations::acos(Exact::new(x)),
        |x| Exact::new(x).sinh(),
        |x| Exact::new(x).cosh(),
        |x| Exact::new(x).tanh(),
        |x| Exact::new(x).sigmoid(),
        |x| Exact::new(x).softplus(),
        |x| Exact::new(x).erf(),
        |x| Exact::new(x).erfc(),
        |x| Exact::new(x).normal_cdf(),
        |x| Exact::new(x).sqrt(),
        |x| Exact::new(x).pow(Exact::new(1.7)),
    ];
    let records = bytes.len() / 32;
    assert!(records >= 100 * functions.len() && records.is_multiple_of(functions.len()));
    let count = records / functions.len();
    let number = |bytes: &[u8]| f64::from_le_bytes(bytes.try_into().unwrap());
    for (k, record) in bytes.chunks_exact(32).enumerate() {
        let (x, exponent) = (number(&record[..8]), i64::from_le_bytes(record[24..].try_into().unwrap()));
        let expected = Exact::of(number(&record[8..16]), number(&record[16..24]), exponent);
        let error = (functions[k / count](x) - expected) / expected;
        assert!(error.is_zero() || error.exponent() < -75, "function {}, {x:e}: {error:?}", k / count);
    }
}
