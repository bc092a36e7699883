//! Tensors of random numbers, from any generator of the crate `rand`. Start with [`Tensor::rand`] and
//! [`Tensor::randn`].

use crate::{Indices, Scalar, Tensor};
use rand::{Rng, RngExt};
use std::f64::consts::TAU;
use std::ops::Range;

/// A normal random number with mean 0 and variance 1 (Box and Muller 1958).
pub fn standard_normal(rng: &mut (impl Rng + ?Sized)) -> f64 {
    // 1 - u is in (0, 1], so that the logarithm is finite.
    (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt() * (TAU * rng.random::<f64>()).cos()
}

/// A uniform number in 0..1 at the type's precision, so that rounding to `f32` cannot reach 1.
fn unit<T: Scalar>(rng: &mut (impl Rng + ?Sized)) -> f64 {
    let digits = if size_of::<T>() == 4 { 24 } else { 53 };
    (rng.next_u64() >> (64 - digits)) as f64 / (1_u64 << digits) as f64
}

impl<T: Scalar> Tensor<T> {
    /// Uniform random numbers in 0..1 (`numpy.random.rand`). 1 is excluded.
    ///
    /// ```
    /// use rand::{SeedableRng, rngs::StdRng};
    /// use raygrad_tensor::Tensor;
    /// let mut rng = StdRng::seed_from_u64(1);
    /// let x = Tensor::<f32>::rand(&[2, 500], &mut rng);
    /// assert!(x.min() >= 0.0 && x.max() < 1.0 && (x.mean() - 0.5).abs() < 0.05);
    /// ```
    pub fn rand(shape: &[usize], rng: &mut (impl Rng + ?Sized)) -> Self {
        Tensor::from_fn(shape, |_| T::from_f64(unit::<T>(rng)))
    }

    /// Uniform random numbers of a range. The end is excluded, unless rounding reaches it.
    ///
    /// # Panics
    /// If an end is infinite or NaN.
    #[track_caller]
    pub fn uniform(shape: &[usize], range: Range<f64>, rng: &mut (impl Rng + ?Sized)) -> Self {
        let Range { start, end } = range;
        assert!(start.is_finite() && end.is_finite(), "uniform numbers from {start} to {end}");
        Tensor::from_fn(shape, |_| {
            let part = unit::<T>(rng);
            // Of both ends, so that no difference overflows. Rounding may lead out of a short range.
            T::from_f64((start * (1.0 - part) + end * part).clamp(start.min(end), start.max(end)))
        })
    }

    /// Normal random numbers with mean 0 and variance 1 (`torch.randn`).
    pub fn randn(shape: &[usize], rng: &mut (impl Rng + ?Sized)) -> Self {
        Tensor::normal(shape, 0.0, 1.0, rng)
    }

    /// Normal random numbers with this mean and standard deviation.
    ///
    /// # Panics
    /// If the deviation is negative, infinite or NaN.
    #[track_caller]
    pub fn normal(shape: &[usize], mean: f64, deviation: f64, rng: &mut (impl Rng + ?Sized)) -> Self {
        assert!((0.0..f64::INFINITY).contains(&deviation), "normal numbers of standard deviation {deviation}");
        Tensor::from_fn(shape, |_| T::from_f64(mean + deviation * standard_normal(rng)))
    }

    /// 1 with probability `p`, else 0 (`torch.bernoulli`).
    ///
    /// # Panics
    /// If `p` is not within 0 to 1.
    #[track_caller]
    pub fn bernoulli(shape: &[usize], p: f64, rng: &mut (impl Rng + ?Sized)) -> Self {
        assert!((0.0..=1.0).contains(&p), "a probability of {p}");
        Tensor::from_fn(shape, |_| if rng.random::<f64>() < p { T::ONE } else { T::ZERO })
    }
}

impl Indices {
    /// Random integers of a range, each equally likely (`torch.randint`).
    ///
    /// # Panics
    /// If the range is empty and the shape is not.
    #[track_caller]
    pub fn random(shape: &[usize], range: Range<u32>, rng: &mut (impl Rng + ?Sized)) -> Self {
        let len = crate::layout::len_of(shape);
        Indices::new(shape, (0..len).map(|_| rng.random_range(range.clone())).collect::<Vec<_>>())
    }

    /// A random permutation of `0..n`, each equally likely (Fisher and Yates): `[n]`.
    pub fn permutation(n: u32, rng: &mut (impl Rng + ?Sized)) -> Self {
        let mut order: Vec<u32> = (0..n).collect();
        for i in (1..order.len()).rev() {
            order.swap(i, rng.random_range(0..=i));
        }
        Indices::from(order)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand::rngs::StdRng;

    #[test]
    fn uniform_numbers_of_a_short_range_are_within_it() {
        let rng = &mut StdRng::seed_from_u64(1);
        let a = 1.0 / 3.0;
        for end in [a, a + f64::EPSILON] {
            let all = Tensor::<f64>::uniform(&[1000], a..end, rng);
            assert!(all.as_slice().iter().all(|x| (a..=end).contains(x)));
        }
    }

    /// The largest distance between the distribution of some numbers and the expected one, in units of the distance
    /// expected by chance. A value beyond 1.95 comes once in a thousand draws (Kolmogorov and Smirnov).
    fn distance(x: &Tensor<f32>, expected: impl Fn(f64) -> f64) -> f64 {
        let mut x: Vec<f64> = x.iter().map(f64::from).collect();
        x.sort_by(f64::total_cmp);
        let n = x.len() as f64;
        let apart = |(i, &x): (usize, &f64)| {
            let below = expected(x);
            assert!(below.is_finite());
            (below - i as f64 / n).abs().max(((i + 1) as f64 / n - below).abs())
        };
        x.iter().enumerate().map(apart).fold(0.0, crate::Real::maximum) * n.sqrt()
    }

    #[test]
    fn random_numbers_match_their_distribution() {
        let mut rng = StdRng::seed_from_u64(7);
        let cases = [
            (Tensor::rand(&[100, 200], &mut rng), 0.5, 1.0 / 12.0),
            (Tensor::uniform(&[20_000], -3.0..5.0, &mut rng), 1.0, 64.0 / 12.0),
            (Tensor::randn(&[20_000], &mut rng), 0.0, 1.0),
            (Tensor::normal(&[20_000], -2.0, 0.5, &mut rng), -2.0, 0.25),
        ];
        let normal = |x: f64| 0.5 * (1.0 + crate::Real::erf(x / 2.0_f64.sqrt()));
        assert!(distance(&cases[0].0, |x| x) < 1.95);
        assert!(distance(&cases[1].0, |x| (x + 3.0) / 8.0) < 1.95);
        assert!(distance(&cases[2].0, normal) < 1.95);
        assert!(distance(&cases[3].0, |x| normal((x + 2.0) / 0.5)) < 1.95);
        for (x, mean, variance) in cases as [(Tensor<f32>, f64, f64); 4] {
            let x: Vec<f64> = x.iter().map(|x| (f64::from(x) - mean) / variance.sqrt()).collect();
            let product = x.windows(2).map(|pair| pair[0] * pair[1]).sum::<f64>() / (x.len() as f64).sqrt();
            assert!(product.abs() < 3.5, "neighbours are correlated: {product}");
        }
        let p = Tensor::<f64>::bernoulli(&[10_000], 0.3, &mut rng);
        assert!((p.mean() - 0.3).abs() < 0.02 && p.iter().all(|x| x == 0.0 || x == 1.0));
        assert_eq!(Tensor::<f64>::bernoulli(&[9], 1.0, &mut rng).sum(), 9.0);
        let classes = Indices::random(&[3, 1000], 2..5, &mut rng);
        let count = |class| classes.as_slice().iter().filter(|&&other| other == class).count() as f64;
        assert!((2..5).all(|class| (count(class) - 1000.0).abs() < 100.0) && classes.shape() == [3, 1000]);
    }

    #[test]
    fn uniform_f32_largest_is_below_one() {
        /// Returns ones alone.
        struct Ones;
        impl rand::TryRng for Ones {
            type Error = std::convert::Infallible;
            fn try_next_u32(&mut self) -> Result<u32, Self::Error> {
                Ok(u32::MAX)
            }
            fn try_next_u64(&mut self) -> Result<u64, Self::Error> {
                Ok(u64::MAX)
            }
            fn try_fill_bytes(&mut self, bytes: &mut [u8]) -> Result<(), Self::Error> {
                bytes.fill(u8::MAX);
                Ok(())
            }
        }
        assert_eq!(Tensor::<f32>::rand(&[1], &mut Ones).item(), 1.0 - f32::EPSILON / 2.0);
        assert_eq!(Tensor::<f64>::rand(&[1], &mut Ones).item(), 1.0 - f64::EPSILON / 2.0);
    }

    #[test]
    fn what_is_no_distribution_is_refused() {
        let refused = |f: fn(&mut StdRng) -> Tensor<f32>| {
            std::panic::catch_unwind(|| f(&mut StdRng::seed_from_u64(1))).unwrap_err();
        };
        refused(|rng| Tensor::normal(&[1], 0.0, -1.0, rng));
        refused(|rng| Tensor::normal(&[1], 0.0, f64::INFINITY, rng));
        refused(|rng| Tensor::uniform(&[1], 0.0..f64::INFINITY, rng));
        refused(|rng| Tensor::bernoulli(&[1], 1.5, rng));
        refused(|rng| Tensor::bernoulli(&[1], f64::NAN, rng));
        let mut rng = StdRng::seed_from_u64(1);
        assert!(Tensor::<f64>::uniform(&[99], -1e308..1.5e308, &mut rng).is_finite());
        assert_eq!(Tensor::<f64>::bernoulli(&[99], 0.0, &mut rng).sum(), 0.0);
    }

    #[test]
    fn every_order_is_equally_likely() {
        let mut rng = StdRng::seed_from_u64(3);
        let mut counts = std::collections::HashMap::new();
        for _ in 0..6000 {
            *counts.entry(Indices::permutation(3, &mut rng).as_slice().to_vec()).or_insert(0) += 1;
        }
        assert!(counts.len() == 6 && counts.values().all(|count| (850..1150).contains(count)), "{counts:?}");
        assert!(Indices::permutation(0, &mut rng).as_slice().is_empty());
    }
}
