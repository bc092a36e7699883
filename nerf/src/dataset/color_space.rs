//! The sRGB transfer curve between linear light and stored values.
//!
//! NeRF is trained and blended in stored values: half of white over black is 0.5, while half of the light would be
//! 0.735. Use these operations for a model with linear colours.

#[cfg(any(test, feature = "check"))]
use raygrad_autograd::check::Entry;
use raygrad_autograd::{Cases, Formula, Real, Scalar, Var};

/// The linear and the encoded value at the end of the linear segment (IEC 61966-2-1).
const KNEE: [f64; 2] = [0.003_130_8, 0.040_45];
const SLOPE: f64 = 12.92;
const OFFSET: f64 = 0.055;
const EXPONENT: f64 = 2.4;

/// The operation y = 12.92 x up to x = 0.0031308, else 1.055 x^(1/2.4) - 0.055: linear light to sRGB values.
///
/// The line extends below 0 and the curve beyond 1, so the gradient is finite everywhere, at most 12.92. The standard's
/// rounded constants leave a step of 2.9e-8 at the knee. NaN stays NaN.
#[derive(Debug, Clone, Copy)]
pub struct SrgbEncode;

/// The operation y = x / 12.92 up to x = 0.04045, else ((x + 0.055) / 1.055)^2.4: sRGB values to linear light, the
/// inverse of [`SrgbEncode`] up to the standard's rounding.
#[derive(Debug, Clone, Copy)]
pub struct SrgbDecode;

/// The maximum of `x` and the knee, as the argument of the power: its gradient must be finite when the linear branch is
/// chosen.
#[inline(always)]
fn beyond<E: Real>(x: E, knee: f64) -> [E; 2] {
    let excess = x - x.like(knee);
    let limit = x.like(knee);
    [excess.if_positive(x, limit), excess]
}

impl Formula<1> for SrgbEncode {
    const NAME: &'static str = "srgb_encode";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        let [clamped, excess] = beyond(x, KNEE[0]);
        let line = x.like(SLOPE) * x;
        let power = x.like(1.0 + OFFSET) * clamped.pow(x.like(1.0 / EXPONENT)) - x.like(OFFSET);
        // NaN chooses the linear branch and stays NaN.
        excess.if_positive(power, line)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..1.5).domain_also(-0.5..0.001);
        c.at([0.0], 0.0, [SLOPE]).at([-0.1], -1.292, [SLOPE]).at([1e-8], 1.292e-7, [SLOPE]);
        c.at([1.0], 1.0, [(1.0 + OFFSET) / EXPONENT]).at([0.5], 0.735_356_983_052_449_5, [0.658_630_819_210_374_6]);
        c.at([f64::INFINITY], f64::INFINITY, [0.0]).at([f64::NAN], f64::NAN, [SLOPE]);
    }
}

impl Formula<1> for SrgbDecode {
    const NAME: &'static str = "srgb_decode";
    #[inline(always)]
    fn f<E: Real>(&self, [x]: [E; 1]) -> E {
        let [clamped, excess] = beyond(x, KNEE[1]);
        let line = x / x.like(SLOPE);
        let power = ((clamped + x.like(OFFSET)) / x.like(1.0 + OFFSET)).pow(x.like(EXPONENT));
        excess.if_positive(power, line)
    }
    fn cases(&self, c: &mut Cases) {
        c.domain(0.1..1.5).domain_also(-0.5..0.03);
        c.at([0.0], 0.0, [1.0 / SLOPE]).at([-0.1], -0.1 / SLOPE, [1.0 / SLOPE]);
        c.at([1.0], 1.0, [EXPONENT / (1.0 + OFFSET)]).at([f64::NAN], f64::NAN, [1.0 / SLOPE]);
    }
}

/// Encodes linear light, of any shape, as sRGB values; see [`SrgbEncode`].
///
/// ```
/// use raygrad_autograd::{Tape, Tensor};
/// use raygrad_nerf::srgb_encode;
/// let tape = Tape::<f64>::new();
/// let light = tape.leaf(Tensor::from([-0.1, 0.0, 0.5]));
/// let codes = srgb_encode(&light);
/// assert!((codes.value().as_slice()[2] - 0.735357).abs() < 1e-6);
/// assert!(codes.sum().grad(&[&light])[0].as_slice().iter().all(|slope| slope.is_finite()));
/// ```
#[track_caller]
pub fn srgb_encode<'t, T: Scalar>(light: &Var<'t, T>) -> Var<'t, T> {
    SrgbEncode.on([light])
}

/// Decodes sRGB values, of any shape, to linear light; see [`SrgbDecode`].
#[track_caller]
pub fn srgb_decode<'t, T: Scalar>(codes: &Var<'t, T>) -> Var<'t, T> {
    SrgbDecode.on([codes])
}

/// The catalogue entries of this file.
#[cfg(any(test, feature = "check"))]
pub(crate) fn entries() -> Vec<Entry> {
    vec![Entry::examined(SrgbEncode), Entry::examined(SrgbDecode)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_codes_round_trip() {
        for code in 0..=255 {
            let code = f64::from(code) / 255.0;
            assert!((SrgbEncode.f([SrgbDecode.f([code])]) - code).abs() < 1e-6);
        }
    }
}
