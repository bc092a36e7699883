use super::{f32 as single, f64 as double};
use crate::simd;

/// The same value down to the sign of zero, or both NaN.
#[track_caller]
fn assert_same<T: Into<f64>>(function: &str, x: T, got: T, expected: T) {
    let (x, got, expected) = (x.into(), got.into(), expected.into());
    let same = got.to_bits() == expected.to_bits() || got.is_nan() && expected.is_nan();
    assert!(same, "{function}({x:e}) is {got:e}, expected {expected:e}");
}

/// `module, type: function: argument => result, ...;` for arguments whose result is exact.
macro_rules! exact {
    ($m:ident, $t:ty: $($f:ident: $($x:expr => $y:expr),+;)+) => {
        $($(assert_same::<$t>(stringify!($f), $x, $m::$f($x), $y);)+)+
    };
}

macro_rules! specials {
    ($test:ident, $m:ident, $t:ident) => {
        #[test]
        fn $test() {
            const INF: $t = $t::INFINITY;
            const NAN: $t = $t::NAN;
            const TINY: $t = $t::from_bits(1);
            exact! { $m, $t:
                exp: 0.0 => 1.0, -0.0 => 1.0, INF => INF, -INF => 0.0, NAN => NAN, 1e4 => INF, -1e4 => 0.0;
                exp2: 0.0 => 1.0, -3.0 => 0.125, 10.0 => 1024.0, INF => INF, -INF => 0.0, NAN => NAN;
                expm1: 0.0 => 0.0, -0.0 => -0.0, INF => INF, -INF => -1.0, NAN => NAN, TINY => TINY, -TINY => -TINY;
                ln: 0.0 => -INF, -0.0 => -INF, 1.0 => 0.0, INF => INF, -TINY => NAN, -INF => NAN, NAN => NAN;
                ln1p: 0.0 => 0.0, -0.0 => -0.0, -1.0 => -INF, INF => INF, -1.5 => NAN, NAN => NAN, -TINY => -TINY;
                log2: 0.0 => -INF, 1.0 => 0.0, 1024.0 => 10.0, 0.125 => -3.0, INF => INF, -1.0 => NAN, NAN => NAN;
                sin: 0.0 => 0.0, -0.0 => -0.0, INF => NAN, -INF => NAN, NAN => NAN, -TINY => -TINY;
                cos: 0.0 => 1.0, -0.0 => 1.0, INF => NAN, -INF => NAN, NAN => NAN, TINY => 1.0;
                sin_pi: 0.0 => 0.0, -0.0 => -0.0, 1.0 => 0.0, -3.0 => -0.0, 2.5 => 1.0, 1e30 => 0.0, INF => NAN;
                cos_pi: -0.0 => 1.0, 1.0 => -1.0, 0.5 => 0.0, -1.5 => 0.0, 1e30 => 1.0, INF => NAN, NAN => NAN;
                tanh: 0.0 => 0.0, -0.0 => -0.0, INF => 1.0, -INF => -1.0, NAN => NAN, -TINY => -TINY, 1e4 => 1.0;
                sigmoid: 0.0 => 0.5, -0.0 => 0.5, INF => 1.0, -INF => 0.0, NAN => NAN, 1e4 => 1.0, -1e4 => 0.0;
                softplus: INF => INF, -INF => 0.0, NAN => NAN, 1e4 => 1e4, -1e4 => 0.0;
                erf: 0.0 => 0.0, -0.0 => -0.0, INF => 1.0, -INF => -1.0, NAN => NAN, 1e4 => 1.0, -1e4 => -1.0;
            }
            assert_eq!($m::exp2(TINY.log2()), TINY, "the smallest power of two");
            assert_eq!($m::log2(TINY), TINY.log2(), "the logarithm of the smallest number");
        }
    };
}

specials!(specials_f32, single, f32);
specials!(specials_f64, double, f64);

#[test]
fn saturating_functions_keep_their_digits() {
    assert_eq!(single::sigmoid(-89.0), 2.227_363_6e-39);
    assert_eq!(single::softplus(-20.0), 2.061_153_6e-9);
    assert_eq!(single::softplus(-89.0), 2.227_363_6e-39);
    assert_eq!(single::softplus(89.0), 89.0);
    assert_eq!(single::expm1(1e-8), 1e-8);
}

/// Scalar code, baseline vectors and the best vectors of this machine must agree to the bit.
#[test]
fn the_same_bits_with_and_without_vectors() {
    macro_rules! check {
        ($m:ident, $t:ident, $step:expr; $($f:ident)+) => {
            let x: Vec<$t> = (0..1 << 14).map(|i| $t::from_bits(i * $step)).collect();
            let mut y = vec![0.0; x.len()];
            $(
                simd::dispatch(
                    #[inline(always)]
                    || {
                        for (y, &x) in y.iter_mut().zip(&x) {
                            *y = $m::$f(x);
                        }
                    },
                );
                for (&x, &y) in x.iter().zip(&y) {
                    assert_same(stringify!($f), x, y, $m::$f(x));
                }
            )+
        };
    }
    check!(single, f32, 262_139; exp exp2 expm1 ln ln1p log2 sin cos sin_pi cos_pi tanh sigmoid softplus erf);
    check!(double, f64, 1_125_899_906_842_597; exp exp2 expm1 ln ln1p log2 sin cos sin_pi cos_pi tanh sigmoid softplus erf);
}

/// Values from 40-digit arithmetic, rounded.
#[test]
fn f64_within_two_ulp() {
    macro_rules! near {
        ($f:ident: $($x:expr => $y:expr),+) => {
            $({
                let (got, expected): (f64, f64) = (double::$f($x), $y);
                let error = got.to_bits().abs_diff(expected.to_bits());
                assert!(error <= 2, "{}({:e}) is {got:e}, {error} ULP from {expected:e}", stringify!($f), $x);
            })+
        };
    }
    near!(exp:
        -740.5 => 2.5e-322, -104.25 => 5.306403388120991e-46, -0.001 => 0.999000499833375,
        0.3 => 1.3498588075760032, 1.7 => 5.4739473917272, 709.5 => 1.3549863193146328e308
    );
    near!(exp2:
        -1074.5 => 5e-324, -0.3 => 0.8122523963562356, 0.7 => 1.624504792712471,
        1023.9 => 1.6773070034857416e308
    );
    near!(expm1:
        -30.5 => -0.9999999999999433, -0.6 => -0.45118836390597356, -1e-9 => -9.999999995e-10,
        0.4 => 0.49182469764127035, 17.3 => 32605774.72099587, 709.75 => 1.7398368732641605e308
    );
    near!(ln:
        5e-324 => -744.4400719213812, 1e-310 => -713.8013788281542, 0.7 => -0.35667494393873245,
        1.00001 => 9.999950000398841e-6, 1.42 => 0.35065687161316933, 1e300 => 690.7755278982137
    );
    near!(ln1p:
        -0.9999 => -9.210340371976294, -0.3 => -0.35667494393873234, 1e-12 => 9.999999999995e-13,
        0.42 => 0.35065687161316933, 3.5 => 1.5040773967762742, 1e300 => 690.7755278982137, f64::MAX => 709.782712893384
    );
    near!(log2:
        1e-310 => -1029.7977094150824, 0.7 => -0.5145731728297583, 1.4 => 0.48542682717024166,
        1e17 => 56.47277761308516
    );
    near!(sin:
        1e-9 => 1e-9, 3.0 => 0.1411200080598672, 100000.0 => 0.03574879797201651, 1e22 => -0.8522008497671888,
        -1e300 => 0.8178819121159085
    );
    near!(cos:
        1e-9 => 1.0, 1.6 => -0.029199522301288815, 100000.0 => -0.9993608074382124, 1e22 => 0.523214785395139,
        -1e300 => -0.5753861119575491
    );
    near!(sin_pi:
        1e-9 => 3.1415926535897936e-9, 0.2 => 0.5877852522924731, 0.26 => 0.7289686274214116,
        -1.7 => 0.8090169943749475, 2.9999 => 0.0003141592601919295, 123456.789 => 0.6153863701685053
    );
    near!(cos_pi:
        1e-9 => 1.0, 0.2 => 0.8090169943749475, 0.26 => 0.6845471059286886, -1.7 => 0.587785252292473,
        2.4999 => 0.0003141592601919295, 123456.789 => -0.7882256119987674
    );
    near!(tanh:
        1e-9 => 1e-9, 0.5 => 0.46211715726000974, 0.56 => 0.5079774328978962, -1.3 => -0.8617231593133063,
        9.5 => 0.9999999887944072, 18.7 => 0.9999999999999999
    );
    near!(sigmoid:
        -740.5 => 2.5e-322, -89.0 => 2.2273635617957438e-39, -20.0 => 2.0611536181902037e-9,
        -1.2 => 0.23147521650098238, 0.4 => 0.598687660112452, 17.3 => 0.999999969330588
    );
    near!(softplus:
        -740.5 => 2.5e-322, -89.0 => 2.2273635617957438e-39, -20.0 => 2.061153620314381e-9,
        -0.83 => 0.36189579198797783, 0.4 => 0.9130152523999526, 17.3 => 17.300000030669413, 800.0 => 800.0
    );
    near!(erf:
        1e-9 => 1.1283791670955127e-9, 0.5 => 0.5204998778130465, 0.95 => 0.8208908072732779,
        -1.3 => -0.9340079449406524, 2.7 => 0.9998656672600594, 5.1 => 0.9999999999994507
    );
}
