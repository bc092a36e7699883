//! What convolutions and poolings see of an image: large images, steps, padding and dilation.

use super::support::{in_both, same, summed, values, wide};
use raygrad_tensor::{Scalar, Windows};

/// Pixel that element `k` of window `w` along one axis sees.
fn pixel(w: usize, k: usize, [extent, stride, padding, dilation]: [usize; 4]) -> Option<usize> {
    (w * stride + k * dilation).checked_sub(padding).filter(|&at| at < extent)
}

fn walks<T: Scalar>() {
    let cases = [
        // image, kernel, stride, padding, dilation
        ([1, 1], [1, 1], [1, 1], [0, 0], [1, 1]),
        ([37, 65], [3, 3], [1, 1], [1, 1], [1, 1]),
        ([5, 1025], [2, 5], [1, 1], [0, 2], [1, 1]),
        ([131, 33], [3, 2], [2, 2], [1, 0], [1, 1]),
        ([64, 64], [5, 4], [3, 2], [2, 2], [1, 2]),
        ([17, 130], [3, 3], [1, 3], [3, 4], [2, 3]),
        ([9, 4099], [1, 7], [2, 1], [0, 3], [1, 1]),
        ([128, 32], [2, 2], [2, 2], [0, 0], [1, 1]),
    ];
    for (image, kernel, stride, padding, dilation) in cases {
        let windows = Windows::new(image, kernel, stride, padding, dilation).unwrap();
        let what = format!("{windows:?}");
        let along = |axis: usize| [image[axis], stride[axis], padding[axis], dilation[axis]];
        let outputs = [0, 1].map(|axis| {
            let span = dilation[axis] * (kernel[axis] - 1) + 1;
            (0..).take_while(|i| i * stride[axis] + span <= image[axis] + 2 * padding[axis]).count()
        });
        assert_eq!(windows.output(), outputs);
        let (count, elements, pixels) = (outputs[0] * outputs[1], kernel[0] * kernel[1], image[0] * image[1]);
        assert_eq!((windows.count(), windows.kernel_len()), (count, elements));
        let seen = |k: usize, w: usize| {
            let y = pixel(w / outputs[1], k / kernel[1], along(0))?;
            Some(y * image[1] + pixel(w % outputs[1], k % kernel[1], along(1))?)
        };
        let channels = 3;
        let x = values::<T>(channels * pixels, 1);
        let wide_x = wide(&x);
        let mut columns = vec![T::from_f64(f64::NAN); channels * elements * count];
        windows.unfold(&x, &mut columns);
        let exact = |i: usize| {
            let (channel, k, w) = (i / (elements * count), i / count % elements, i % count);
            seen(k, w).map_or(0.0, |at| wide_x[channel * pixels + at])
        };
        same(&format!("unfolded, {what}"), &columns, (0..columns.len()).map(exact));
        // Added to what is there.
        let v = values::<T>(columns.len(), 2);
        let mut back = x.clone();
        windows.fold(&v, &mut back);
        let mut expected: Vec<[f64; 2]> = wide_x.iter().map(|x| [*x, x.abs()]).collect();
        for (i, v) in wide(&v).into_iter().enumerate() {
            let (channel, k, w) = (i / (elements * count), i / count % elements, i % count);
            if let Some(at) = seen(k, w) {
                let [sum, size] = &mut expected[channel * pixels + at];
                (*sum, *size) = (*sum + v, *size + v.abs());
            }
        }
        summed(&format!("folded, {what}"), &back, elements as f64, expected);
        for (c, plane) in x.chunks_exact(pixels).enumerate() {
            let inside = |w: usize| (0..elements).filter_map(move |k| seen(k, w)).map(|at| plane[at].to_f64());
            let mut out = vec![T::from_f64(f64::NAN); count];
            windows.sums(plane, &mut out);
            let sums = (0..count).map(|w| [inside(w).sum(), inside(w).map(f64::abs).sum()]);
            summed(&format!("sums, {what}"), &out, elements as f64, sums);
            windows.maxima(plane, &mut out);
            let largest = |w: usize| inside(w).fold(f64::NEG_INFINITY, |a, b| if b > a { b } else { a });
            same(&format!("maxima, {what}"), &out, (0..count).map(largest));
            if (0..count).all(|w| inside(w).next().is_some()) {
                let (mut at, mut best) = (vec![7; count], vec![T::ZERO; count]);
                windows.arg_maxima(plane, &mut best, &mut at);
                for w in 0..count {
                    let first = (0..elements).filter_map(|k| seen(k, w)).find(|&at| plane[at].to_f64() == largest(w));
                    assert_eq!(Some(at[w] as usize), first, "{what}, window {w}");
                }
            }
            let values = values::<T>(count, 3 + c);
            let mut spread = plane.to_vec();
            windows.spread(&values, &mut spread);
            let mut expected: Vec<[f64; 2]> = plane.iter().map(|x| [x.to_f64(), x.to_f64().abs()]).collect();
            for (w, v) in wide(&values).into_iter().enumerate() {
                for at in (0..elements).filter_map(|k| seen(k, w)) {
                    expected[at] = [expected[at][0] + v, expected[at][1] + v.abs()];
                }
            }
            summed(&format!("spread, {what}"), &spread, elements as f64, expected);
        }
    }
}

#[test]
fn walks_over_windows() {
    in_both!(walks);
}
