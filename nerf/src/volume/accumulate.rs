//! Weighted sums along rays.

#[cfg(any(test, feature = "check"))]
use raygrad_autograd::check::Entry;
use raygrad_autograd::{Grads, Op, Pool, Reads, Scalar, Segments, Shape, ShapeError, Tensor, Var, Vjp};

/// The operation `sum_i w_i v_i` over the samples of each ray: weights `[samples]` and values `[samples, channels]` to
/// `[rays, channels]`.
///
/// Values may be colours, distances or normals. Sums are carried in f64.
#[derive(Debug, Clone)]
pub struct Accumulate(
    /// The rows of each ray's samples.
    pub Segments,
);

impl<T: Scalar> Op<T> for Accumulate {
    fn name(&self) -> &'static str {
        "accumulate"
    }

    fn arity(&self) -> Option<usize> {
        Some(2)
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let samples = self.0.rows();
        match (x[0], x[1]) {
            (&[weights], &[values, channels]) if weights == samples && values == samples => {
                Ok([self.0.len(), channels].into_iter().collect())
            }
            _ => Err(format!("weights must be [{samples}] and values [{samples}, channels]")),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let channels = x[1].shape()[1];
        let mut out = pool.tensor(&[self.0.len(), channels]);
        if channels == 0 {
            return out;
        }
        let (weights, values) = (x[0].as_slice(), x[1].as_slice());
        let mut sums = vec![0.0_f64; channels];
        for (out, rows) in out.as_mut_slice().chunks_exact_mut(channels).zip(self.0.ranges()) {
            sums.fill(0.0);
            let values = values[rows.start * channels..rows.end * channels].chunks_exact(channels);
            for (weight, values) in weights[rows].iter().zip(values) {
                let weight = weight.to_f64();
                sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += weight * value.to_f64());
            }
            out.iter_mut().zip(&sums).for_each(|(out, &sum)| *out = T::from_f64(sum));
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (weights, values, g, channels) = (cx.input(0), cx.input(1), cx.g().value(), cx.shape(1)[1]);
        let mut d_weights = cx.pool().full(weights.shape(), T::ZERO);
        let mut d_values = cx.pool().tensor(values.shape());
        if channels > 0 {
            let (out_w, out_v) = (d_weights.as_mut_slice(), d_values.as_mut_slice());
            for (g, rows) in g.as_slice().chunks_exact(channels).zip(self.0.ranges()) {
                for i in rows {
                    let row = i * channels..(i + 1) * channels;
                    let products = g.iter().zip(&values.as_slice()[row.clone()]);
                    out_w[i] = T::from_f64(products.map(|(g, value)| g.to_f64() * value.to_f64()).sum());
                    let weight = weights.as_slice()[i];
                    out_v[row].iter_mut().zip(g).for_each(|(out, &g)| *out = weight * g);
                }
            }
        }
        Grads::new([Some(cx.constant(d_weights)), Some(cx.constant(d_values))])
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        Some((&x[1] * x[0].reshape(&[self.0.rows(), 1])).segment_sum(&self.0))
    }
}

/// The catalogue entries of this file.
#[cfg(any(test, feature = "check"))]
pub(crate) fn entries() -> Vec<Entry> {
    let values = |channels: usize| Tensor::from_fn(&[7, channels], |i| ((i * 29) % 17) as f64 / 17.0);
    let weights = Tensor::from_fn(&[7], |i| ((i * 5) % 7) as f64 / 9.0);
    vec![
        Entry::new(Accumulate(Segments::new([0, 3, 3, 4, 7])))
            .sample_of(vec![weights.clone(), values(3)])
            .sample_of(vec![weights, values(1)])
            .sample(&[&[7], &[7, 0]]),
        Entry::new(Accumulate(Segments::new([0, 0]))).sample(&[&[0], &[0, 2]]),
    ]
}
