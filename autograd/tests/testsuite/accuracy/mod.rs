//! Errors of elementwise operations in units in the last place, over all bits of arguments and incoming gradients.
//!
//! Values and gradients are compared one by one with a reference of 100 bits ([`exact`]). Arguments are drawn from all
//! bit patterns, close to kinks and borders, and where functions are used; incoming gradients from all bit patterns, and
//! so that the result is a normal number. `ACCURACY_DRAWS` sets how many and `ACCURACY_SEED` which;
//! `ACCURACY_ONLY=gelu,tanh` and `ACCURACY_OPERANDS=1` select operations. `ACCURACY_DUMP` names a folder for arguments and exact results, which
//! `benches/peers/accuracy.py` reads. [`singles`] has many more cases in f32.

pub mod exact;
mod operations;
mod second;
mod singles;

use exact::{Exact, scaled};
use operations::{Operation, Reference, one, operations};
use raygrad_autograd::{Scalar, Tape, Tensor, Var};
use rayon::prelude::*;
use std::sync::LazyLock;

/// Errors above this many units in the last place are breaches.
const GATE: f64 = 8.0;

/// The functions of docs/library/vector-math.md whose values are within 2.
const FUNCTIONS: [&str; 24] = [
    "exp",
    "expm1",
    "exp2",
    "ln",
    "ln1p",
    "log2",
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
    "sigmoid",
    "softplus",
    "atan2",
    "hypot",
    "pow",
    "remainder",
];

/// A float format.
pub struct Format {
    pub digits: i64,
    pub least: i64,
    pub greatest: i64,
}

impl Format {
    pub fn of<T: Scalar>() -> Format {
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
    pub fn error(&self, got: f64, exact: Exact, term: Exact) -> f64 {
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
pub struct Random(u64);

/// The number in the environment variable.
fn setting(name: &str) -> Option<usize> {
    std::env::var(name).ok().map(|text| text.parse().unwrap_or_else(|_| panic!("{name}={text} is not a number")))
}

/// Whether `ACCURACY_ONLY` and `ACCURACY_OPERANDS` ask for the operation.
fn is_asked(name: &str, operands: usize) -> bool {
    let only = std::env::var("ACCURACY_ONLY").unwrap_or_default();
    let is_named = only.is_empty() || only.split(',').any(|part| name.starts_with(part));
    is_named && setting("ACCURACY_OPERANDS").is_none_or(|number| number == operands)
}

impl Random {
    /// For a case of an operation.
    pub fn of(name: &str, case: u64) -> Random {
        // FNV-1a: every operation has cases of its own.
        let hash = name
            .bytes()
            .fold(0xcbf2_9ce4_8422_2325, |hash: u64, byte| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3));
        static SEED: LazyLock<u64> = LazyLock::new(|| setting("ACCURACY_SEED").unwrap_or(0) as u64);
        let mut random = Random(hash ^ SEED.rotate_left(32));
        Random(random.bits() ^ case)
    }

    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let x = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let x = (x ^ x >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ x >> 31
    }

    pub fn below(&mut self, n: i64) -> i64 {
        ((u128::from(self.bits()) * n as u128) >> 64) as i64
    }

    /// A number with this exponent, of either sign.
    pub fn of_exponent<T: Scalar>(&mut self, exponent: i64) -> f64 {
        let fraction = 1.0 + self.bits() as f64 / 2.0_f64.powi(64);
        // Rounded to the type; instead of an overflow, half of the power of two.
        let x = T::from_f64(scaled(fraction, exponent)).to_f64();
        let x = if x.is_finite() { x } else { scaled(1.0, exponent - 1) };
        if self.bits() & 1 == 0 { x } else { -x }
    }

    /// Any finite bit pattern.
    pub fn pattern<T: Scalar>(&mut self) -> f64 {
        loop {
            let bytes = self.bits().to_le_bytes();
            let x = T::read_le(&bytes[..size_of::<T>()])[0].to_f64();
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
                let step = scaled(1.0, -self.below(format.digits + 1));
                let x = T::from_f64(place * (1.0 + step * (self.below(3) - 1) as f64)).to_f64();
                let x = if x.is_finite() { x } else { place };
                if self.below(2) == 0 { x } else { -x }
            }
        }
    }

    /// The same operands; one time in four the second is equal or close to the first.
    fn related<T: Scalar>(&mut self, mut x: Vec<f64>) -> Vec<f64> {
        if x.len() > 1 && self.below(16) == 0 {
            // Differences and sums beyond the largest number.
            let most = Format::of::<T>().greatest;
            for x in &mut x {
                let down = self.below(4);
                *x = self.of_exponent::<T>(most - down * down);
            }
        } else if x.len() > 1 && self.below(4) == 0 {
            let step = scaled(1.0, -self.below(Format::of::<T>().digits + 2));
            let near = T::from_f64(x[0] * (1.0 + step * (self.below(3) - 1) as f64)).to_f64();
            x[1] = if near.is_finite() { near } else { x[0] };
        }
        x
    }

    /// An incoming gradient: of any bits, or so that a gradient is a normal number; for the exponents of derivatives.
    fn gradient<T: Scalar>(&mut self, slopes: &[Option<i64>]) -> f64 {
        let slope = slopes[self.below(slopes.len() as i64) as usize];
        if self.below(32) == 0 {
            return 0.0;
        }
        let Some(slope) = slope.filter(|_| self.below(2) == 1) else { return self.pattern::<T>() };
        let format = Format::of::<T>();
        let lowest = format.least - format.digits;
        let target = lowest + self.below(format.greatest - lowest + 1);
        self.of_exponent::<T>((target - slope).clamp(lowest, format.greatest))
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

    /// Both columns as one.
    fn joined(self, other: Column) -> Column {
        let (worst, rest) = if other.worst > self.worst || self.count == 0 { (other, self) } else { (self, other) };
        Column {
            sum: worst.sum + rest.sum,
            count: worst.count + rest.count,
            breaches: worst.breaches + rest.breaches,
            ..worst
        }
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

/// Cases that are evaluated together, with the same constants.
fn batch<T: Scalar>(operation: &Operation<T>) -> usize {
    if operation.constants.is_some() { 1 << 4 } else { 1 << 14 }
}

/// The constants of a batch, numbers of the type.
fn constants<T: Scalar>(operation: &Operation<T>, batch: usize) -> [f64; 2] {
    let mut random = Random::of(operation.name, !(batch as u64));
    operation.constants.map_or([0.0; 2], |constants| constants([random.argument::<T>(), random.argument::<T>()]))
}

/// Value and gradients of the operation.
fn evaluate<T: Scalar>(operation: &Operation<T>, constants: [f64; 2], x: Vec<Vec<T>>, g: Vec<T>) -> Vec<Tensor<T>> {
    let (tape, n) = (Tape::<T>::new(), g.len());
    let x: Vec<_> = x.into_iter().map(|x| tape.leaf(Tensor::from_vec(&[n], x))).collect();
    let y = (operation.function)(&x, constants);
    let grads = tape.no_grad(|| y.vjp(&tape.constant(Tensor::from_vec(&[n], g)), &x.iter().collect::<Vec<_>>()));
    [y].into_iter().chain(grads).map(Var::into_value).collect()
}

/// The results that are compared: exact results and their largest terms, for an incoming gradient. Conventions decide at
/// a few points, and a derivative is compared where the value is finite.
fn compared(reference: &Reference, g: f64, value: f64) -> Vec<Option<(Exact, Exact)>> {
    let g = Exact::new(g);
    let slopes = reference.slopes.iter().map(|&(slope, term)| {
        let exact = g * slope;
        (exact.is_finite() && value.is_finite()).then(|| (exact, g * term))
    });
    [reference.value].into_iter().chain(slopes).collect()
}

/// Values that are rounded once, or not at all.
const ROUNDED: [&str; 14] = [
    "sqrt", "abs", "sign", "floor", "ceil", "round", "relu", "clamp", "affine", "add", "sub", "mul", "maximum",
    "minimum",
];

/// The limit for errors of the value, or of a gradient.
fn gate(name: &str, is_gradient: bool) -> f64 {
    let name = name.split(',').next().unwrap_or(name);
    match name {
        _ if is_gradient => GATE,
        name if ROUNDED.contains(&name) => 0.5,
        name if FUNCTIONS.contains(&name) => 2.0,
        "normal_cdf" => 6.0,
        _ => GATE,
    }
}

/// The errors of the value and of the gradient by each operand.
fn examine<T: Scalar>(operation: &Operation<T>, draws: usize) -> Vec<Column> {
    let mut columns = vec![Column::default(); 1 + operation.operands];
    let (format, mut dump) = (Format::of::<T>(), Dump::new::<T>(operation.name, operation.operands));
    let size = batch(operation);
    for start in (0..draws).step_by(size) {
        let n = (draws - start).min(size);
        let constants = constants(operation, start / size);
        let cases: Vec<(Vec<f64>, Reference, f64)> = (0..n)
            .into_par_iter()
            .map(|i| {
                let mut random = Random::of(operation.name, (start + i) as u64);
                let x: Vec<f64> = (0..operation.operands).map(|_| random.argument::<T>()).collect();
                let x = (operation.domain)(random.related::<T>(x));
                let reference = (operation.reference)(&x, constants);
                let exponent =
                    |&(slope, _): &(Exact, Exact)| (!slope.is_zero() && slope.is_finite()).then(|| slope.exponent());
                let g = random.gradient::<T>(&reference.slopes.iter().map(exponent).collect::<Vec<_>>());
                (x, reference, g)
            })
            .collect();
        let column = |f: &dyn Fn(usize) -> f64| (0..n).map(|i| T::from_f64(f(i))).collect::<Vec<_>>();
        let x = (0..operation.operands).map(|k| column(&|i| cases[i].0[k])).collect();
        let results = evaluate(operation, constants, x, column(&|i| cases[i].2));
        for (i, (x, reference, g)) in cases.iter().enumerate() {
            let got = |k: usize| results[k].as_slice()[i].to_f64();
            dump.numbers(x);
            dump.numbers(&[*g]);
            for (k, exact) in compared(reference, *g, got(0)).into_iter().enumerate() {
                let error = exact.map(|(exact, term)| format.error(got(k), exact, term));
                let (exact, term) = exact.unwrap_or((Exact::ZERO, Exact::ZERO));
                dump.result(&format, exact, term, error.unwrap_or(f64::NAN));
                if let Some(error) = error {
                    columns[k].add(error, gate(operation.name, k > 0), || place(x, (k > 0).then_some(*g), constants));
                }
            }
        }
    }
    columns
}

/// Arguments, incoming gradient and constants.
fn place(x: &[f64], g: Option<f64>, constants: [f64; 2]) -> Vec<f64> {
    x.iter().copied().chain(g).chain(constants.into_iter().filter(|&c| c != 0.0)).collect()
}

/// Prints a row for each operation and returns the breaches.
fn check<T: Scalar>(draws: usize) -> Vec<String> {
    let asked = operations::<T>().into_iter().filter(|operation| is_asked(operation.name, operation.operands));
    asked.flat_map(|operation| report::<T>(operation.name, examine(&operation, draws), draws / 10)).collect()
}

/// Prints the columns of an operation, and returns those with breaches or with fewer than `least` results.
fn report<T: Scalar>(name: &str, columns: Vec<Column>, least: usize) -> Vec<String> {
    let mut failed = vec![];
    for (k, column) in columns.into_iter().enumerate() {
        let of = if k == 0 { "value".to_string() } else { format!("gradient {k}") };
        let mean = column.sum / column.count.max(1) as f64;
        let row = format!(
            "{name:<16} {} {of:<10} {:>9.3} {mean:>7.3} {:>7} of {:>7}  {:e}",
            T::NAME,
            column.worst,
            column.breaches,
            column.count,
            Places(&column.at),
        );
        println!("{row}");
        if column.breaches > 0 || column.count < least {
            failed.push(row);
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
    let draws = setting("ACCURACY_DRAWS").unwrap_or(2000);
    let is_any = operations::<f32>().iter().any(|operation| is_asked(operation.name, operation.operands));
    assert!(is_any && draws > 0, "nothing is measured");
    let failed: Vec<_> = check::<f32>(draws).into_iter().chain(check::<f64>(draws)).collect();
    assert!(failed.is_empty(), "beyond {GATE} units in the last place:\n{}", failed.join("\n"));
}

#[test]
fn every_elementwise_operation_is_measured() {
    // An operation that changes nothing, and those that only gradients use.
    let not_measured = ["alias", "ratio", "mul_add", "cosine", "logistic_density"];
    let has_row = |name| operations::<f32>().iter().any(|row| row.name.split(',').next() == Some(name));
    assert!(FUNCTIONS.into_iter().chain(ROUNDED).all(has_row));
    let operations = operations::<f32>();
    for entry in raygrad_autograd::check::catalogue().iter().filter(|entry| entry.is_elementwise()) {
        let mut rows = operations.iter().filter(|row| row.name.split(',').next() == Some(entry.name));
        assert!(rows.next().is_some() || not_measured.contains(&entry.name), "no row for {}", entry.name);
    }
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
        let alone = gradient(f, &x, 3.7);
        for extreme in [1e-30, 1e30, -100.0, -90.0, -1e-30, f32::NAN] {
            let with: Vec<f32> = x.iter().copied().chain([extreme]).collect();
            assert_eq!(gradient(f, &with, 3.7)[..1000], alone, "function {k} beside {extreme}");
        }
    }
}

/// Recorded gradients are as accurate as plain ones, where arguments and gradients are far from the ends of the range.
#[test]
fn recorded_gradients_are_within_8_units_in_the_last_place() {
    fn check<T: Scalar>() -> Vec<String> {
        let format = Format::of::<T>();
        let is_ordinary = |x: Exact| x.is_zero() || x.is_finite() && 3 * x.exponent().abs() < format.greatest;
        let errors = |operation: &Operation<T>| {
            let mut columns = vec![Column::default(); operation.operands];
            let mut random = Random::of(operation.name, 1 << 40);
            let constants = operation.constants.map_or([0.0; 2], |constants| constants([1.75, -0.5]));
            let cases: Vec<_> = (0..2000)
                .map(|_| {
                    let x = (0..operation.operands).map(|_| random.argument::<T>()).collect();
                    (operation.domain)(random.related::<T>(x))
                })
                .map(|x| ((operation.reference)(&x, constants), x))
                .filter(|(reference, x)| {
                    let mut slopes = reference.slopes.iter();
                    x.iter().all(|&x| is_ordinary(Exact::new(x))) && slopes.all(|&(slope, _)| is_ordinary(slope))
                })
                .collect();
            let (tape, n) = (Tape::<T>::new(), cases.len());
            let column = |k: usize| Tensor::from_fn(&[n], |i| T::from_f64(cases[i].1[k]));
            let x: Vec<_> = (0..operation.operands).map(|k| tape.leaf(column(k))).collect();
            let y = (operation.function)(&x, constants).sum();
            let grads = y.tracked().grad_graph(&x.iter().collect::<Vec<_>>());
            for (i, (reference, x)) in cases.iter().enumerate() {
                for (k, &(exact, term)) in reference.slopes.iter().enumerate() {
                    let error = format.error(grads[k].value().as_slice()[i].to_f64(), exact, term);
                    columns[k].add(error, GATE, || place(x, None, constants));
                }
            }
            [Column { count: 200, ..Column::default() }].into_iter().chain(columns).collect()
        };
        // Constants of 2^100 take products out of the range.
        let all = operations::<T>().into_iter().filter(|operation| !operation.name.contains("2^"));
        all.flat_map(|operation| report::<T>(operation.name, errors(&operation), 200)).collect()
    }
    let failed: Vec<_> = check::<f32>().into_iter().chain(check::<f64>()).collect();
    assert!(failed.is_empty(), "beyond {GATE} units in the last place:\n{}", failed.join("\n"));
}

/// Second derivatives in which the difference of two terms or the square of a bell would lose the digits.
#[test]
fn second_derivatives_are_within_8_units_in_the_last_place() {
    type Row<T> = (for<'t> fn(&Var<'t, T>) -> Var<'t, T>, fn(Exact) -> Exact);
    fn check<T: Scalar>() {
        let rows: [Row<T>; 6] = [
            (|x| x.asin(), |x| x / (one() - x.square()).sqrt() / (one() - x.square())),
            (|x| x.acos(), |x| -x / (one() - x.square()).sqrt() / (one() - x.square())),
            (|x| x.erf(), |x| -x.shifted(2) * (-x.square()).exp() / Exact::PI.sqrt()),
            (|x| x.normal_cdf(), |x| -x * (-x.square().shifted(-1)).exp() / Exact::PI.shifted(1).sqrt()),
            (|x| x.sigmoid(), |x| -x.sigmoid() * (-x).sigmoid() * x.shifted(-1).tanh()),
            (|x| x.tanh(), |x| -(x.shifted(1).sigmoid() * (-x.shifted(1)).sigmoid() * x.tanh()).shifted(3)),
        ];
        for (k, (f, second)) in rows.into_iter().enumerate() {
            let end = if k < 2 { 1.0 } else { f64::INFINITY };
            let (format, mut random) = (Format::of::<T>(), Random::of("second", k as u64));
            let x: Vec<f64> = (0..4000).map(|_| random.argument::<T>()).filter(|x| x.abs() < end).collect();
            let tape = Tape::<T>::new();
            let vars = tape.leaf(Tensor::from_fn(&[x.len()], |i| T::from_f64(x[i])));
            let got = f(&vars).sum().grad_graph(&[&vars]).remove(0).sum().grad(&[&vars]).remove(0);
            for (&x, got) in x.iter().zip(got.as_slice()) {
                let exact = second(Exact::new(x));
                // Ordinary products: those of a bell that is no normal number have lost digits.
                if !exact.is_zero() && exact.exponent() > format.least + 8 {
                    let error = format.error(got.to_f64(), exact, exact);
                    assert!(error <= GATE, "function {k} of {x:e} in {}: {got:?}, {error} units off", T::NAME);
                }
            }
        }
    }
    check::<f32>();
    check::<f64>();
}

/// The second derivatives of a length are products, also where one component is small.
#[test]
fn second_derivatives_of_lengths_are_within_8_units_in_the_last_place() {
    fn check<T: Scalar>() {
        let (format, mut random) = (Format::of::<T>(), Random::of("hypot", 1));
        for _ in 0..2000 {
            let [a, b] = [0; 2].map(|_| {
                let exponent = random.below(40) - 20;
                random.of_exponent::<T>(exponent)
            });
            let tape = Tape::<T>::new();
            let [x, y] = [a, b].map(|x| tape.leaf(Tensor::scalar(T::from_f64(x))));
            let got = x.hypot(&y).grad_graph(&[&x]).remove(0).grad(&[&x, &y]);
            let [a, b] = [a, b].map(Exact::new);
            let cube = (a.square() + b.square()) * (a.square() + b.square()).sqrt();
            for (got, exact) in got.iter().zip([b.square() / cube, -a * b / cube]) {
                let error = format.error(got.item().to_f64(), exact, exact);
                assert!(error <= GATE, "{a:?}, {b:?} in {}: {got:?}, {error} units off", T::NAME);
            }
        }
    }
    check::<f32>();
    check::<f64>();
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

#[test]
fn limits_at_infinity_and_at_the_ends_of_constants() {
    let grads = |f: Double, a: f64, b: f64| {
        let tape = Tape::new();
        let [a, b] = [a, b].map(|x| tape.leaf(Tensor::scalar(x)));
        let y = f(&a, &b);
        let (plain, recorded) = (y.grad(&[&a, &b]), y.grad_graph(&[&a, &b]));
        for (plain, recorded) in plain.iter().zip(recorded) {
            let are_nan = plain.item().is_nan() && recorded.item().is_nan();
            assert!(plain.item() == recorded.item() || are_nan, "{plain:?}, {recorded:?}");
        }
        [y.item()].into_iter().chain(plain.iter().map(Tensor::item)).collect::<Vec<_>>()
    };
    let inf = f64::INFINITY;
    assert_eq!(grads(|a, b| a.atan2(b), 1.0, inf), [0.0; 3]);
    assert_eq!(grads(|a, b| a.hypot(b), 0.0, inf)[..2], [inf, 0.0]);
    assert_eq!(grads(|a, b| a.binary_cross_entropy_with_logits(b), inf, 1.0)[..2], [0.0, 0.0]);
    assert_eq!(grads(|a, b| a.binary_cross_entropy_with_logits(b), -inf, 0.0)[..2], [0.0, 0.0]);
    assert!(grads(|a, b| a.binary_cross_entropy_with_logits(b), 1.0, f64::NAN)[0].is_nan());
    // Powers that have vanished, with an infinite exponent or an infinite base.
    let mut random = Random::of("pow", 0);
    for _ in 0..1000 {
        let x = random.pattern::<f64>().abs();
        let exponent = if x < 1.0 { inf } else { -inf };
        if x != 1.0 {
            assert_eq!(grads(|a, b| a.pow(b), x, exponent), [0.0; 3], "{x:e}");
        }
        if x != 0.0 {
            assert_eq!(grads(|a, b| a.pow(b), inf, -x), [0.0; 3], "{x:e}");
        }
    }
    // The exponent -2^31, which has no predecessor.
    assert_eq!(grads(|a, _| a.powi(i32::MIN), -1.0, 0.0)[1], 2.0_f64.powi(31));
    // A parabola of a width that rounds to 0.
    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::scalar(1.0));
    let first = x.smooth_l1(tape.constant(Tensor::scalar(0.5)), 1e-50).grad_graph(&[&x]).remove(0);
    assert_eq!((first.item(), first.grad(&[&x])[0].item()), (1.0, 0.0));
    // Beyond 2^128, whose incoming gradient brings it back.
    assert_eq!(gradient(|x| x.exp2(), &[256.0], 1e-45)[0], (2.0_f64.powi(256 - 149) * std::f64::consts::LN_2) as f32);
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
