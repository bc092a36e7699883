//! Random streams, and jitter of samples.

use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// A generator for one purpose. Mixing the parts gives neighbouring seeds unrelated streams.
pub(crate) fn stream(seed: u64, parts: [u64; 2]) -> Pcg64Mcg {
    Pcg64Mcg::seed_from_u64(mixed(seed, parts))
}

/// The seed of such a generator.
pub(crate) fn mixed(seed: u64, parts: [u64; 2]) -> u64 {
    let mut state = seed ^ 0x9e37_79b9_7f4a_7c15;
    for part in parts {
        // The finaliser of SplitMix64 (Steele, Lea, Flood 2014).
        state = state.wrapping_add(part).wrapping_add(0x9e37_79b9_7f4a_7c15);
        state = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        state = (state ^ (state >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        state ^= state >> 31;
    }
    state
}

/// The position of samples within their bins: at the centre for renders, random in training.
pub enum Jitter<'a> {
    /// Every sample at the centre of its bin: the same image each time.
    Middle,
    /// Every sample at a uniformly random place in its bin.
    Random(&'a mut dyn Rng),
}

impl Jitter<'_> {
    pub(crate) fn draw(&mut self) -> f64 {
        match self {
            Jitter::Middle => 0.5,
            Jitter::Random(rng) => rng.random::<f64>(),
        }
    }

    /// A seed for other random numbers.
    pub(crate) fn seed(&mut self) -> u64 {
        match self {
            Jitter::Middle => 0,
            Jitter::Random(rng) => rng.random(),
        }
    }
}
