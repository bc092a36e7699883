//! Weight initialisation.

use rand::{Rng, RngExt};
use raygrad_tensor::random::standard_normal;
use raygrad_tensor::{Scalar, Tensor};

/// The initial distribution of a layer's weights.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Init {
    /// Uniform in `+-sqrt(6 / (inputs + outputs))` (Glorot and Bengio 2010, equation 16).
    Glorot,
    /// Normal with variance `2 / (inputs + outputs)` (Glorot and Bengio 2010, equation 12).
    GlorotNormal,
    /// Uniform in `+-sqrt(6 / inputs)` (He et al. 2015, equation 10). It keeps the variance through ReLU layers.
    He,
    /// Normal with variance `2 / inputs` (He et al. 2015, equation 10).
    HeNormal,
    /// Uniform in plus or minus this bound.
    Uniform(f64),
    /// Normal with this standard deviation.
    Normal(f64),
    /// This factor times a uniformly random orthogonal matrix. Its rows or columns, whichever are fewer, are orthogonal
    /// and have this length (Saxe, McClelland and Ganguli 2014).
    Orthogonal(f64),
    /// All weights 0.
    Zeros,
}

impl Init {
    /// Draws a weight matrix `[inputs, outputs]`.
    pub fn weight<T: Scalar>(self, inputs: usize, outputs: usize, rng: &mut (impl Rng + ?Sized)) -> Tensor<T> {
        self.tensor(&[inputs, outputs], [inputs, outputs], rng)
    }

    /// Draws a weight of any shape. Each output of the layer depends on `inputs` numbers, and each input affects
    /// `outputs` numbers. [`Orthogonal`](Self::Orthogonal) treats the weight as a matrix whose rows are the first axis.
    pub fn tensor<T: Scalar>(
        self,
        shape: &[usize],
        [inputs, outputs]: [usize; 2],
        rng: &mut (impl Rng + ?Sized),
    ) -> Tensor<T> {
        let both = (inputs + outputs).max(1) as f64;
        let inputs = inputs.max(1) as f64;
        match self {
            Init::Glorot => uniform((6.0 / both).sqrt(), shape, rng),
            Init::He => uniform((6.0 / inputs).sqrt(), shape, rng),
            Init::Uniform(bound) => uniform(bound, shape, rng),
            Init::GlorotNormal => Tensor::normal(shape, 0.0, (2.0 / both).sqrt(), rng),
            Init::HeNormal => Tensor::normal(shape, 0.0, (2.0 / inputs).sqrt(), rng),
            Init::Normal(deviation) => Tensor::normal(shape, 0.0, deviation, rng),
            Init::Orthogonal(gain) => orthogonal(gain, shape, rng),
            Init::Zeros => Tensor::zeros(shape),
        }
    }
}

fn uniform<T: Scalar>(bound: f64, shape: &[usize], rng: &mut (impl Rng + ?Sized)) -> Tensor<T> {
    Tensor::from_fn(shape, |_| T::from_f64(bound * (2.0 * rng.random::<f64>() - 1.0)))
}

/// The orthogonal factor of a matrix of normal random numbers. Its triangular factor has a positive diagonal, so every
/// orthogonal matrix is equally likely (Mezzadri 2007).
fn orthogonal<T: Scalar>(gain: f64, shape: &[usize], rng: &mut (impl Rng + ?Sized)) -> Tensor<T> {
    let rows = shape.first().copied().unwrap_or(1);
    let columns: usize = shape.iter().skip(1).product();
    let (count, length) = (rows.min(columns), rows.max(columns));
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(count);
    while basis.len() < count {
        let mut v: Vec<f64> = (0..length).map(|_| standard_normal(rng)).collect();
        // Gram-Schmidt twice is orthogonal to the last digits (Giraud et al. 2005).
        for _ in 0..2 {
            for unit in &basis {
                let along: f64 = v.iter().zip(unit).map(|(v, u)| v * u).sum();
                v.iter_mut().zip(unit).for_each(|(v, u)| *v -= along * u);
            }
        }
        let norm = v.iter().map(|v| v * v).sum::<f64>().sqrt();
        // The remainder of a vector in the span of the others is noise: draw another.
        if norm > 1e-8 {
            v.iter_mut().for_each(|v| *v /= norm);
            basis.push(v);
        }
    }
    Tensor::from_fn(shape, |i| {
        let (row, column) = (i / columns, i % columns);
        T::from_f64(gain * if rows <= columns { basis[row][column] } else { basis[column][row] })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;

    fn rng() -> Pcg64Mcg {
        Pcg64Mcg::seed_from_u64(5)
    }

    #[test]
    fn init_matches_variance_and_bounds() {
        let n = 200.0 * 300.0;
        let cases = [
            (Init::Glorot, 2.0 / 500.0, 1.8),
            (Init::GlorotNormal, 2.0 / 500.0, 3.0),
            (Init::He, 2.0 / 200.0, 1.8),
            (Init::HeNormal, 2.0 / 200.0, 3.0),
            (Init::Uniform(0.3), 0.03, 1.8),
            (Init::Normal(0.5), 0.25, 3.0),
        ];
        for (init, variance, fourth) in cases {
            let x = init.weight::<f64>(200, 300, &mut rng());
            let moment = |k: i32| x.as_slice().iter().map(|x| x.powi(k)).sum::<f64>() / n;
            assert!(moment(1).abs() < 5.0 * (variance / n).sqrt(), "{init:?}: mean {}", moment(1));
            assert!((moment(2) / variance - 1.0).abs() < 0.03, "{init:?}: variance {}", moment(2));
            // The fourth moment tells a uniform variable (1.8) from a normal one (3).
            let ratio = moment(4) / moment(2).powi(2);
            assert!((ratio - fourth).abs() < 0.1, "{init:?}: {ratio}");
            if fourth < 2.0 {
                let bound = (3.0 * variance).sqrt();
                assert!(x.as_slice().iter().all(|x| x.abs() <= bound), "{init:?} leaves {bound}");
            }
        }
        assert_eq!(Init::Zeros.weight::<f32>(2, 3, &mut rng()), Tensor::zeros(&[2, 3]));
    }

    #[test]
    fn init_orthogonal_along_shorter_side() {
        for shape in [&[7, 7][..], &[40, 9], &[9, 40], &[6, 3, 5], &[1, 4], &[4], &[0, 3], &[3, 0]] {
            let gain = 2.5_f64.sqrt();
            let x = Init::Orthogonal(gain).tensor::<f64>(shape, [1, 1], &mut rng());
            assert_eq!(x.shape(), shape);
            let rows = shape[0];
            let columns: usize = shape[1..].iter().product();
            let at = |i: usize, j: usize| x.as_slice()[if rows <= columns { i * columns + j } else { j * columns + i }];
            let (count, length) = (rows.min(columns), rows.max(columns));
            for i in 0..count {
                for j in 0..count {
                    let product: f64 = (0..length).map(|k| at(i, k) * at(j, k)).sum();
                    let expected = if i == j { 2.5 } else { 0.0 };
                    assert!((product - expected).abs() < 1e-13, "{shape:?}: {i} and {j}: {product}");
                }
            }
        }
        // Equally likely: the mean of an element over many draws is 0, its square 1 / n.
        let mut rng = rng();
        let draws: Vec<_> = (0..4000).map(|_| Init::Orthogonal(1.0).weight::<f64>(3, 3, &mut rng)).collect();
        for place in 0..9 {
            let mean = |k| draws.iter().map(|x| x.as_slice()[place].powi(k)).sum::<f64>() / 4000.0;
            assert!(mean(1).abs() < 0.05 && (mean(2) - 1.0 / 3.0).abs() < 0.03, "{place}: {} {}", mean(1), mean(2));
        }
    }

    /// Kolmogorov and Smirnov's statistic: the largest distance between the share of values below x and `cdf(x)`, times
    /// the root of their number. It is above 1.95 for one sample in a thousand.
    fn kolmogorov_smirnov(values: &[f64], cdf: impl Fn(f64) -> f64) -> f64 {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let n = sorted.len() as f64;
        let distance = |(i, &x): (usize, &f64)| (cdf(x) - i as f64 / n).abs().max((cdf(x) - (i + 1) as f64 / n).abs());
        n.sqrt() * sorted.iter().enumerate().map(distance).fold(0.0, raygrad_tensor::Real::maximum)
    }

    #[test]
    fn values_are_distributed_as_their_formula_says() {
        let (inputs, outputs) = (120, 80);
        let uniform = |bound: f64| move |x: f64| (0.5 + 0.5 * x / bound).clamp(0.0, 1.0);
        let normal =
            |deviation: f64| move |x: f64| 0.5 + 0.5 * raygrad_tensor::Real::erf(x / deviation / 2.0_f64.sqrt());
        type Cdf = Box<dyn Fn(f64) -> f64>;
        let cases: [(Init, Cdf); 6] = [
            (Init::Glorot, Box::new(uniform(0.03_f64.sqrt()))),
            (Init::He, Box::new(uniform(0.05_f64.sqrt()))),
            (Init::Uniform(0.3), Box::new(uniform(0.3))),
            (Init::GlorotNormal, Box::new(normal(0.1))),
            (Init::HeNormal, Box::new(normal((2.0_f64 / 120.0).sqrt()))),
            (Init::Normal(0.5), Box::new(normal(0.5))),
        ];
        for (init, cdf) in &cases {
            for seed in 0..5 {
                let x = init.weight::<f64>(inputs, outputs, &mut Pcg64Mcg::seed_from_u64(seed));
                let distance = kolmogorov_smirnov(x.as_slice(), cdf);
                assert!(distance < 2.2, "{init:?}, seed {seed}: {distance}");
                // The test sees a deviation of a fifth.
                assert!(kolmogorov_smirnov(x.as_slice(), |x| cdf(1.2 * x)) > 2.2, "{init:?}, seed {seed}");
            }
        }
    }

    #[test]
    fn layers_and_seeds_are_independent() {
        let n = 200 * 50;
        for init in [Init::Glorot, Init::HeNormal, Init::Normal(1.0), Init::Orthogonal(1.0)] {
            // Two layers of each of three seeds.
            let seed = |seed| {
                let mut rng = Pcg64Mcg::seed_from_u64(seed);
                [(); 2].map(|()| init.weight::<f64>(200, 50, &mut rng))
            };
            let all: Vec<_> = (0..3).flat_map(seed).collect();
            let product = |a: &Tensor<f64>, b: &[f64]| a.as_slice().iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            for (i, a) in all.iter().enumerate() {
                let square = product(a, a.as_slice());
                for b in &all[..i] {
                    let correlation = product(a, b.as_slice()) / (square * product(b, b.as_slice())).sqrt();
                    assert!(correlation.abs() < 4.5 / f64::from(n).sqrt(), "{init:?}: {correlation}");
                }
                // Nor do neighbours within a layer know of each other.
                let neighbours = product(a, &a.as_slice()[1..]) / square;
                assert!(neighbours.abs() < 4.5 / f64::from(n).sqrt(), "{init:?}: {neighbours}");
            }
        }
        let again = |seed| Init::He.weight::<f32>(3, 4, &mut Pcg64Mcg::seed_from_u64(seed));
        assert!(again(7) == again(7) && again(7) != again(8));
    }
}
