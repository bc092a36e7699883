//! The sRGB transfer curve, and the space of blending.

use super::support::*;
use raygrad::nerf::{Image, SrgbDecode, SrgbEncode, dataset::background, quantise, srgb_decode, srgb_encode};
use raygrad::{Formula, Scalar, Tape};

/// Matrix: sRGB at -.1, 0, 1e-8, knee +- ulp, 1, 2. Catalogue: `where` + pow.
fn the_curve_and_its_slope_are_finite_everywhere<T: Scalar>() {
    let knee = round::<T>(0.0031308);
    let mut x = vec![-0.1, -1e30, -0.0, 0.0, 1e-8, 1.0, 2.0, 0.5, 1e30, smallest::<T>(), greatest::<T>()];
    x.extend([beside::<T>(knee, false), knee, beside::<T>(knee, true)]);
    for decode in [false, true] {
        let tape = Tape::new();
        let leaf = tape.leaf(vector::<T>(&x));
        // Decoding 1e30 overflows f32, where no finite result exists.
        let y = if decode { srgb_decode(&leaf.slice_axis(0, 2..8)) } else { srgb_encode(&leaf) };
        finite("value", y.value());
        finite("slope", &y.sum().grad(&[&leaf])[0]);
        let first = y.sum().grad_graph(&[&leaf]).remove(0);
        finite("second derivative", &first.sum().grad(&[&leaf])[0]);
    }
    let at = |x: f64| {
        let tape = Tape::new();
        let leaf = tape.leaf(vector::<T>(&[x]));
        let y = srgb_encode(&leaf).sum();
        [y.item().to_f64(), y.grad(&[&leaf])[0].item().to_f64()]
    };
    let tolerance = by_type::<T>(3e-7, 1e-15);
    near::<T>("-.1", at(-0.1)[0], 12.92 * round::<T>(-0.1), tolerance);
    near::<T>("sRGB(.5)", at(0.5)[0], constant("sRGB(.5)"), tolerance);
    near::<T>("sRGB(2)", at(2.0)[0], constant("sRGB(2)"), tolerance);
    within("sRGB(1)", at(1.0)[0], 1.0, tolerance);
    assert_eq!(at(0.0), [0.0, round::<T>(12.92)]);
    let (below, above) = (at(beside::<T>(knee, false)), at(beside::<T>(knee, true)));
    within("the step at the knee", above[0] - below[0], constant("sRGB jump at the knee"), by_type::<T>(3e-8, 1e-12));
    within("the slope above the knee", above[1], constant("sRGB slope just above the knee"), 1e-4);
    near::<T>("the slope below", below[1], 12.92, tolerance);
}

/// Matrix: 256 codes round-trip, also through image bytes.
fn all_codes_round_trip<T: Scalar>() {
    let codes: Vec<f64> = (0..256).map(|code| f64::from(code) / 255.0).collect();
    let tape = Tape::new();
    let again = numbers(srgb_encode(&srgb_decode(&tape.constant(vector::<T>(&codes)))).value());
    for (code, again) in again.into_iter().enumerate() {
        within(&format!("code {code}"), again, codes[code], 1e-6);
        assert_eq!(usize::from(quantise(again as f32)), code);
    }
    let light = numbers(srgb_decode(&tape.constant(vector::<T>(&codes))).value());
    assert!(light.is_sorted() && light[0] == 0.0);
}

both!(the_curve_and_its_slope_are_finite_everywhere, all_codes_round_trip);

/// Catalogue: half of white over black is 0.5 in the space of the files, where blending happens here, and 0.735 in
/// linear light.
#[test]
fn blending_happens_in_code_values() {
    let half = Image { width: 1, height: 1, channels: 4, data: vec![1.0, 1.0, 1.0, 0.5] };
    assert_eq!(half.over([0.0; 3]).data, [0.5; 3]);
    assert_eq!(background::over(&[1.0, 1.0, 1.0, 0.5], [0.0; 3]), [0.5; 3]);
    let light = SrgbEncode.f([0.5 * SrgbDecode.f([1.0_f64])]);
    near::<f64>("in light", light, constant("sRGB(.5)"), 1e-14);
}
