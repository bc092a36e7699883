//! Weights of samples.

#[cfg(any(test, feature = "check"))]
use raygrad_autograd::check::Entry;
use raygrad_autograd::{Grads, Op, Pool, Reads, Scalar, Segments, Shape, ShapeError, Tensor, Var, Vjp};
use raygrad_tensor::map;
use std::sync::Arc;

/// The operation `w_i = T_i alpha_i`: optical depths `x` `[samples]` to weights `[samples]`, front to back along each
/// ray (Mildenhall et al. 2020, equation 3; Max 1995).
///
/// `alpha_i = 1 - exp(-x_i)`, and `T_i = exp(-sum of x_j for j < i)` is the transmittance in front of the sample.
/// Together with the transmittance behind the last sample, `exp(-sum x)`, the weights of a ray sum to 1.
///
/// The gradient runs back to front: `B_i = alpha_i g_i + (1 - alpha_i) B_(i+1)` and `dx_i = T_(i+1) (g_i - B_(i+1))`.
/// It divides by no transmittance, so it is accurate behind opaque samples too.
///
/// ```
/// use raygrad_autograd::{Segments, Tape, Tensor};
/// use raygrad_nerf::volume::weights;
/// let tape = Tape::<f64>::new();
/// // One ray; each interval blocks half of the light that reaches it.
/// let x = tape.leaf(Tensor::full(&[3], f64::ln(2.0)));
/// let w = weights(&x, &Segments::new([0, 3]));
/// assert!(w.value().as_slice().iter().zip([0.5, 0.25, 0.125]).all(|(w, half)| (w - half).abs() < 1e-15));
/// ```
#[derive(Debug, Clone)]
pub struct Weights {
    segments: Segments,
    /// Optical depth in front of each ray's first sample, if any.
    before: Option<Arc<[f64]>>,
}

impl Weights {
    /// Creates the operation for the samples of these rays.
    pub fn new(segments: Segments) -> Self {
        Weights { segments, before: None }
    }

    /// Creates the operation with an optical depth `before` `[rays]`, at least 0, in front of each ray's first sample,
    /// for rays that are marched piece by piece.
    ///
    /// # Panics
    /// If `before` has not one entry per ray.
    #[track_caller]
    pub fn behind(segments: Segments, before: impl Into<Arc<[f64]>>) -> Self {
        let before = before.into();
        assert_eq!(before.len(), segments.len(), "`before` must have one entry per ray");
        Weights { segments, before: Some(before) }
    }

    /// Computes the transmittance `T_i` in front of each sample, `[samples]`, from optical depths `x` `[samples]`.
    ///
    /// # Panics
    /// If `x` has not one entry per sample.
    #[track_caller]
    pub fn transmittance<T: Scalar>(&self, x: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
        assert_eq!(x.shape(), [self.segments.rows()], "optical depths must have one entry per sample");
        let mut before = pool.tensor(x.shape());
        let (depth, out) = (x.as_slice(), before.as_mut_slice());
        for (ray, rows) in self.segments.ranges().enumerate() {
            let mut sum = self.before.as_ref().map_or(0.0, |before| before[ray]);
            for i in rows {
                out[i] = T::from_f64(sum);
                sum += depth[i].to_f64();
            }
        }
        map(
            [&before],
            pool,
            #[inline(always)]
            |[tau]| (-tau).exp(),
        )
    }
}

impl<T: Scalar> Op<T> for Weights {
    fn name(&self) -> &'static str {
        "weights"
    }

    fn arity(&self) -> Option<usize> {
        Some(1)
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        match x[0] == [self.segments.rows()] {
            true => Ok(x[0].into()),
            false => Err(format!("optical depths must be [{}], one per sample", self.segments.rows())),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        map(
            [&self.transmittance(x[0], pool), x[0]],
            pool,
            #[inline(always)]
            |[t, x]| t * -(-x).expm1(),
        )
    }

    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (x, pool) = (cx.input(0), cx.pool());
        let transmittance = self.transmittance(x, pool);
        let alpha = map(
            [x],
            pool,
            #[inline(always)]
            |[x]| -(-x).expm1(),
        );
        // e^-x instead of 1 - alpha, which loses its digits behind an opaque sample.
        let passed = map(
            [x],
            pool,
            #[inline(always)]
            |[x]| (-x).exp(),
        );
        let (transmittance, alpha, passed) = (transmittance.as_slice(), alpha.as_slice(), passed.as_slice());
        let mut grad = pool.tensor(x.shape());
        let (g, out) = (cx.g().value().as_slice(), grad.as_mut_slice());
        for rows in self.segments.ranges() {
            // In f64, so that the light from behind is precise on rays of any number of samples.
            let mut behind = 0.0;
            for i in rows.rev() {
                let (own, blocked) = (g[i].to_f64(), alpha[i].to_f64());
                // The transmitted share: 1 - alpha is precise for thin samples and sums with alpha to 1; e^-x is
                // precise for thick ones.
                let passes = if blocked < 0.5 { 1.0 - blocked } else { passed[i].to_f64() };
                out[i] = transmittance[i] * passed[i] * T::from_f64(own - behind);
                behind = blocked * own + passes * behind;
            }
        }
        Grads::one(cx.constant(grad))
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let mut before = x[0].segment_cumsum(&self.segments, true);
        if let Some(depths) = &self.before {
            let depths = depths.iter().map(|&x| T::from_f64(x)).collect();
            let depths = x[0].tape().constant(Tensor::from_vec(&[self.segments.len()], depths));
            before += depths.segment_expand(&self.segments);
        }
        Some((-before).exp() * -(-&x[0]).expm1())
    }
}

/// The catalogue entries of this file.
#[cfg(any(test, feature = "check"))]
pub(crate) fn entries() -> Vec<Entry> {
    let segments = || Segments::new([0, 3, 3, 4, 7]);
    let x = |values: [f64; 7]| Tensor::from_vec(&[7], values.to_vec());
    vec![
        Entry::new(Weights::new(segments()))
            .sample_of(vec![x([0.1, 0.65, 0.25, 0.05, 3.0, 0.7, 0.2])])
            .sample_of(vec![x([7.5, 0.25, 1.2, 0.005, 20.0, 5.0, 15.0])]),
        Entry::new(Weights::behind(segments(), [0.5, 0.0, 2.0, 0.1]))
            .sample_of(vec![x([0.1, 0.65, 0.25, 0.05, 3.0, 0.7, 0.2])]),
        Entry::new(Weights::new(Segments::new([0, 0]))).sample(&[&[0]]),
    ]
}
