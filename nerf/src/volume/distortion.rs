//! The distortion loss, which concentrates the weights along a ray.

#[cfg(any(test, feature = "check"))]
use raygrad_autograd::check::Entry;
use raygrad_autograd::{Grads, Op, Pool, Reads, Scalar, Segments, Shape, ShapeError, Tensor, Var, Vjp};

/// The operation `sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 d_i` for each ray: weights `w` `[samples]` to `[rays]`,
/// with midpoints `m` and interval lengths `d` (Barron et al. 2022, mip-NeRF 360, equation 15).
///
/// The double sum is `w . D w` with `(D w)_i = sum_j w_j |m_i - m_j|`. Two passes give its parts from the left and from
/// the right. From the left it is `L_(i+1) = L_i + W_i (m_(i+1) - m_i)`, with W the sum of the weights so far. Only
/// neighbouring midpoints are subtracted, so samples close together keep their digits. dw = g (2 D w + 2/3 d w).
///
/// Midpoints and lengths are constants, usually as shares of the ray's span.
#[derive(Debug, Clone)]
pub struct Distortion<T: Scalar> {
    midpoints: Tensor<T>,
    lengths: Tensor<T>,
    segments: Segments,
}

impl<T: Scalar> Distortion<T> {
    /// Creates the operation for midpoints `[samples]`, rising within each ray, and interval lengths `[samples]`.
    ///
    /// # Panics
    /// If there is not one midpoint and one length per row of the segments, midpoints fall within a ray, or a length is
    /// negative or NaN.
    #[track_caller]
    pub fn new(midpoints: Tensor<T>, lengths: Tensor<T>, segments: Segments) -> Self {
        for (what, values) in [("midpoint", &midpoints), ("length", &lengths)] {
            assert_eq!(values.shape(), [segments.rows()], "there must be one {what} per sample");
        }
        let m = midpoints.as_slice();
        for (ray, mut rows) in segments.ranges().enumerate() {
            let rises = rows.clone().skip(1).all(|i| m[i] >= m[i - 1]) && rows.all(|i| m[i].is_finite());
            assert!(rises, "the midpoints of ray {ray} must rise");
        }
        assert!(lengths.as_slice().iter().all(|&d| d >= T::ZERO), "lengths must be at least 0");
        Distortion { midpoints, lengths, segments }
    }

    /// `2 D w + 2/3 d w` of one ray, in f64.
    fn slopes(&self, weights: &[T], rows: std::ops::Range<usize>, out: &mut Vec<f64>) {
        let (m, d) = (&self.midpoints.as_slice()[rows.clone()], &self.lengths.as_slice()[rows.clone()]);
        let (w, n) = (&weights[rows.clone()], rows.len());
        out.clear();
        out.extend((0..n).map(|i| 2.0 / 3.0 * d[i].to_f64() * w[i].to_f64()));
        let gap = |i: usize| m[i + 1].to_f64() - m[i].to_f64();
        let (mut sum, mut moment) = (0.0, 0.0);
        for i in 0..n.saturating_sub(1) {
            sum += w[i].to_f64();
            moment += sum * gap(i);
            out[i + 1] += 2.0 * moment;
        }
        (sum, moment) = (0.0, 0.0);
        for i in (0..n.saturating_sub(1)).rev() {
            sum += w[i + 1].to_f64();
            moment += sum * gap(i);
            out[i] += 2.0 * moment;
        }
    }
}

impl<T: Scalar> Op<T> for Distortion<T> {
    fn name(&self) -> &'static str {
        "distortion"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        match x[0] {
            &[samples] if samples == self.segments.rows() => Ok([self.segments.len()].into_iter().collect()),
            _ => Err(format!("weights must be [{}]", self.segments.rows())),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(&[self.segments.len()]);
        let mut slopes = vec![];
        for (out, rows) in out.as_mut_slice().iter_mut().zip(self.segments.ranges()) {
            self.slopes(x[0].as_slice(), rows.clone(), &mut slopes);
            let products = x[0].as_slice()[rows].iter().zip(&slopes).map(|(w, slope)| w.to_f64() * slope);
            // A quadratic form is half the product of its gradient and its argument.
            *out = T::from_f64(0.5 * products.sum::<f64>());
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let mut grad = cx.pool().tensor(cx.shape(0));
        let x = cx.x(0);
        let mut slopes = vec![];
        for (g, rows) in cx.g().value().as_slice().iter().zip(self.segments.ranges()) {
            self.slopes(x.value().as_slice(), rows.clone(), &mut slopes);
            for (out, slope) in grad.as_mut_slice()[rows].iter_mut().zip(&slopes) {
                *out = T::from_f64(g.to_f64() * slope);
            }
        }
        Grads::one(cx.constant(grad))
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let tape = x[0].tape();
        let m = self.midpoints.as_slice();
        let loss = |rows: std::ops::Range<usize>| {
            let (n, start) = (rows.len(), rows.start);
            let w = x[0].slice_axis(0, start..start + n);
            let distances = Tensor::from_fn(&[n, n], |k| {
                let (i, j) = (start + k / n.max(1), start + k % n.max(1));
                T::from_f64((m[i].to_f64() - m[j].to_f64()).abs())
            });
            let lengths = Tensor::from_vec(&[n], self.lengths.as_slice()[rows].to_vec());
            let apart = (w.reshape(&[1, n]).matmul(tape.constant(distances)).reshape(&[n]) * &w).sum();
            (apart + (w.square() * tape.constant(lengths)).sum() * (1.0 / 3.0)).reshape(&[1])
        };
        let losses: Vec<_> = self.segments.ranges().map(loss).collect();
        if losses.is_empty() {
            return Some(x[0].slice_axis(0, ..0));
        }
        Some(Var::concat(&losses.iter().collect::<Vec<_>>(), 0))
    }
}

/// The catalogue entries of this file. [`Distortion`] holds tensors of its own number type, so each precision has its
/// own.
#[cfg(any(test, feature = "check"))]
pub(crate) fn entries() -> Vec<Entry> {
    let midpoints = || Tensor::<f64>::from_vec(&[7], vec![0.125, 0.25, 0.75, 0.5, 0.0, 0.0, 0.875]);
    let lengths = || Tensor::<f64>::from_vec(&[7], vec![0.25, 0.125, 0.5, 0.5, 1.0, 0.0, 0.375]);
    let segments = || Segments::new([0, 3, 3, 4, 7]);
    let double = Distortion::new(midpoints(), lengths(), segments());
    let single = Distortion::new(midpoints().cast::<f32>(), lengths().cast::<f32>(), segments());
    let none = || (Tensor::zeros(&[0]), Segments::new([0]));
    vec![
        Entry::of(double, single).sample_of(vec![Tensor::from_fn(&[7], |i| ((i * 5) % 7) as f64 / 9.0)]),
        Entry::of(
            Distortion::new(none().0, none().0, none().1),
            Distortion::new(none().0.cast::<f32>(), none().0.cast::<f32>(), none().1),
        )
        .sample(&[&[0]]),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_autograd::Tape;

    #[test]
    #[should_panic(expected = "the midpoints of ray 1 must rise")]
    fn distortion_of_falling_midpoints_panics() {
        Distortion::new(
            Tensor::from_vec(&[3], vec![0.9, 0.5, 0.4]),
            Tensor::<f32>::zeros(&[3]),
            Segments::new([0, 1, 3]),
        );
    }

    #[test]
    fn distortion_of_one_sample_is_its_length() {
        let tape = Tape::<f64>::new();
        let op = Distortion::new(Tensor::full(&[1], 0.5), Tensor::full(&[1], 0.3), Segments::new([0, 1]));
        let w = tape.leaf(Tensor::full(&[1], 0.5));
        let loss = tape.apply(op, &[&w]);
        assert!((loss.value().as_slice()[0] - 0.025).abs() < 1e-16);
    }
}
