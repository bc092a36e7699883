//! Rays through several regions of a scene, each with a field of its own.

use raygrad_autograd::{Scalar, Tensor, Var};

/// What rays see of one region alone, over a black background.
///
/// A region is convex, and regions do not overlap: so a ray crosses each once, one after another.
#[derive(Debug, Clone)]
pub struct Region<'t, T: Scalar> {
    /// Colour of each ray within the region, `sum w c`, `[rays, 3]`.
    pub color: Var<'t, T>,
    /// Share of light that passes the region, `[rays]`; 1 for a ray that misses it.
    pub transmittance: Var<'t, T>,
    /// Distance at which each ray enters the region; any number for a ray that misses it.
    pub entry: Vec<f64>,
}

/// Composites regions: the colour `[rays, 3]` and the transmittance `[rays]` of all of them together.
///
/// `C = sum_k C_k prod_(j before k) T_j`, where region `j` is before `k` if the ray enters it first (Li et al. 2024,
/// "NeRF-XL", section 3.2). It equals one integral over all samples, up to rounding, and so do its gradients. If each
/// region belongs to another process, a ray thus needs only five numbers of each region. The own region is a variable,
/// and those of others are constants.
///
/// ```
/// use raygrad_autograd::{Tape, Tensor};
/// use raygrad_nerf::volume::{Region, composite};
/// let tape = Tape::<f64>::new();
/// let region = |light: f64, transmittance: f64, entry: f64| Region {
///     color: tape.constant(Tensor::full(&[1, 3], light)),
///     transmittance: tape.constant(Tensor::full(&[1], transmittance)),
///     entry: vec![entry],
/// };
/// let (color, transmittance) = composite(&[region(0.5, 0.25, 7.0), region(0.25, 0.5, 2.0)]);
/// assert_eq!((color.value().as_slice(), transmittance.item()), (&[0.5; 3][..], 0.125)); // 0.25 + 0.5 * 0.5
/// ```
///
/// # Panics
/// If there is no region, or if shapes do not fit.
#[track_caller]
pub fn composite<'t, T: Scalar>(regions: &[Region<'t, T>]) -> (Var<'t, T>, Var<'t, T>) {
    let mut color: Option<Var<'t, T>> = None;
    for (k, region) in regions.iter().enumerate() {
        let rays = region.entry.len();
        assert_eq!(region.color.shape(), [rays, 3], "the colours of region {k}");
        let mut share = region.color.clone();
        for (j, other) in regions.iter().enumerate().filter(|(j, _)| *j != k) {
            assert_eq!(other.transmittance.shape(), [rays], "the transmittances of region {j}");
            // Of two regions that begin at the same distance the ray misses one.
            let is_before = |ray: usize| (other.entry[ray], j) < (region.entry[ray], k);
            let mask = Tensor::from_fn(&[rays, 1], |ray| if is_before(ray) { T::ONE } else { T::ZERO });
            // 1 where the other region is behind.
            share *= (other.transmittance.reshape(&[rays, 1]) - 1.0) * mask + 1.0;
        }
        color = Some(color.map_or_else(|| share.clone(), |color| color + &share));
    }
    let transmittance = regions.iter().map(|region| region.transmittance.clone()).reduce(|a, b| a * b);
    color.zip(transmittance).expect("there is at least one region")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume::{OpticalDepth, accumulate, weights};
    use raygrad_autograd::{Segments, Tape};
    use raygrad_nn::{Exchange, InProcess};

    const RAYS: usize = 4;
    /// Samples of a ray in each region.
    const SAMPLES: usize = 5;
    const REGIONS: usize = 3;

    /// Which region each ray crosses first, second and third. Ray 3 misses region 1.
    const ORDER: [[usize; REGIONS]; RAYS] = [[0, 1, 2], [2, 1, 0], [1, 0, 2], [2, 0, 1]];

    fn density(region: usize, ray: usize, sample: usize) -> f64 {
        if (region, ray) == (1, 3) { 0.0 } else { 1.0 + ((7 * region + 3 * ray + sample) as f64).sin() }
    }

    fn light(region: usize, ray: usize, sample: usize, channel: usize) -> f64 {
        0.5 + 0.4 * ((5 * region + 2 * ray + 3 * sample + channel) as f64).cos()
    }

    /// The place of a region along a ray.
    fn place(region: usize, ray: usize) -> usize {
        ORDER[ray].iter().position(|other| *other == region).unwrap()
    }

    /// Densities and colours of a region as leaves, and what rays see of it.
    fn region<'t>(tape: &'t Tape<f64>, region: usize) -> ([Var<'t, f64>; 2], Region<'t, f64>) {
        let sigma = tape.leaf(Tensor::from_fn(&[RAYS * SAMPLES], |i| density(region, i / SAMPLES, i % SAMPLES)));
        let light = tape
            .leaf(Tensor::from_fn(&[RAYS * SAMPLES, 3], |i| light(region, i / 3 / SAMPLES, i / 3 % SAMPLES, i % 3)));
        let x = tape.apply(OpticalDepth::new(Tensor::full(&[RAYS * SAMPLES], 0.2)), &[&sigma]);
        let segments = Segments::new((0..=RAYS).map(|ray| (ray * SAMPLES) as u32).collect::<Vec<_>>());
        let w = weights(&x, &segments);
        let color = accumulate(&w, &light, &segments);
        let transmittance = (-x.reshape(&[RAYS, SAMPLES]).sum_over(1)).exp();
        let entry = (0..RAYS).map(|ray| place(region, ray) as f64).collect();
        ([sigma, light], Region { color, transmittance, entry })
    }

    /// A loss that weighs every number of the result.
    fn loss<'t>((color, transmittance): &(Var<'t, f64>, Var<'t, f64>)) -> Var<'t, f64> {
        let tape = color.tape();
        let weight = tape.constant(Tensor::from_fn(&[RAYS, 3], |i| 1.0 + i as f64));
        (color.square() * weight).sum() + (transmittance * tape.constant(Tensor::from([3.0, 1.0, -2.0, 5.0]))).sum()
    }

    /// The whole ray on one tape: the result, and the gradients of each region's densities and colours.
    fn whole() -> (Vec<f64>, Vec<[Vec<f64>; 2]>) {
        let tape = Tape::<f64>::new();
        let all = REGIONS * SAMPLES;
        let at = |i: usize| (ORDER[i / all][i % all / SAMPLES], i / all, i % SAMPLES);
        let sigma = tape.leaf(Tensor::from_fn(&[RAYS * all], |i| {
            let (region, ray, sample) = at(i);
            density(region, ray, sample)
        }));
        let colors = tape.leaf(Tensor::from_fn(&[RAYS * all, 3], |i| {
            let (region, ray, sample) = at(i / 3);
            light(region, ray, sample, i % 3)
        }));
        let x = tape.apply(OpticalDepth::new(Tensor::full(&[RAYS * all], 0.2)), &[&sigma]);
        let segments = Segments::new((0..=RAYS).map(|ray| (ray * all) as u32).collect::<Vec<_>>());
        let color = accumulate(&weights(&x, &segments), &colors, &segments);
        let transmittance = (-x.reshape(&[RAYS, all]).sum_over(1)).exp();
        let result = (color, transmittance);
        let grads = loss(&result).grad(&[&sigma, &colors]);
        let of_region = |region: usize| {
            let rows = |ray: usize| (ray * all + place(region, ray) * SAMPLES)..;
            let rows = (0..RAYS).flat_map(move |ray| rows(ray).take(SAMPLES));
            let sigma = rows.clone().map(|row| grads[0].as_slice()[row]).collect();
            let colors = rows.flat_map(|row| grads[1].as_slice()[3 * row..3 * row + 3].to_vec()).collect();
            [sigma, colors]
        };
        let values = [result.0.value().as_slice(), result.1.value().as_slice()].concat();
        (values, (0..REGIONS).map(of_region).collect())
    }

    fn assert_close(found: &[f64], expected: &[f64], what: &str) {
        assert_eq!(found.len(), expected.len(), "{what}");
        for (a, b) in found.iter().zip(expected) {
            assert!((a - b).abs() <= 1e-14 * (1.0 + b.abs()), "{what}: {a} {b}");
        }
    }

    #[test]
    fn regions_equal_the_whole_ray_with_gradients() {
        let (values, gradients) = whole();
        let tape = Tape::<f64>::new();
        let (leaves, regions): (Vec<_>, Vec<_>) = (0..REGIONS).map(|k| region(&tape, k)).unzip();
        let result = composite(&regions);
        assert_close(&[result.0.value().as_slice(), result.1.value().as_slice()].concat(), &values, "values");
        let loss = loss(&result);
        for (k, ([sigma, light], expected)) in leaves.iter().zip(&gradients).enumerate() {
            let grads = loss.grad(&[sigma, light]);
            assert_close(grads[0].as_slice(), &expected[0], &format!("densities of region {k}"));
            assert_close(grads[1].as_slice(), &expected[1], &format!("colours of region {k}"));
        }
    }

    #[test]
    fn processes_with_a_region_each_get_exact_gradients() {
        let (values, gradients) = whole();
        let run = |mut exchange: InProcess| {
            let (tape, rank) = (Tape::<f64>::new(), exchange.rank());
            let ([sigma, light], own) = region(&tape, rank);
            let mut bytes = vec![];
            for values in [own.color.value().as_slice(), own.transmittance.value().as_slice(), &own.entry] {
                f64::write_le(values, &mut bytes);
            }
            // One exchange in the forward pass, and none in the backward pass.
            let other = |bytes: &Vec<u8>| {
                let numbers = f64::read_le(bytes);
                Region {
                    color: tape.constant(Tensor::from_vec(&[RAYS, 3], numbers[..3 * RAYS].to_vec())),
                    transmittance: tape.constant(Tensor::from_vec(&[RAYS], numbers[3 * RAYS..4 * RAYS].to_vec())),
                    entry: numbers[4 * RAYS..].to_vec(),
                }
            };
            let mut regions: Vec<_> = exchange.all_gather(&bytes).unwrap().iter().map(other).collect();
            assert_eq!(exchange.sent_bytes(), (REGIONS as u64 - 1) * 5 * 8 * RAYS as u64);
            regions[rank] = own;
            let result = composite(&regions);
            assert_close(&[result.0.value().as_slice(), result.1.value().as_slice()].concat(), &values, "values");
            let grads = loss(&result).grad(&[&sigma, &light]);
            assert_close(grads[0].as_slice(), &gradients[rank][0], "densities");
            assert_close(grads[1].as_slice(), &gradients[rank][1], "colours");
        };
        std::thread::scope(|scope| {
            let ranks = InProcess::ranks(REGIONS).into_iter();
            let ranks: Vec<_> = ranks.map(|exchange| scope.spawn(|| run(exchange))).collect();
            ranks.into_iter().for_each(|rank| rank.join().unwrap());
        });
    }
}
