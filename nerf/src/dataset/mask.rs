//! Masks of used pixels.

use super::image::pixel_index;
use rand::{Rng, RngExt};

/// A mask of the pixels of an image that training and evaluation use.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Mask {
    width: usize,
    height: usize,
    /// A bit per pixel, row-major.
    words: Vec<u64>,
    /// For each word, the number of used pixels before it.
    before: Vec<u32>,
    used: usize,
}

impl Mask {
    /// Creates a mask of the pixels (column, row) for which `used` is true.
    pub fn new(width: usize, height: usize, used: impl Fn(usize, usize) -> bool) -> Self {
        let mut words = vec![0_u64; (width * height).div_ceil(64)];
        for pixel in (0..width * height).filter(|pixel| used(pixel % width, pixel / width)) {
            words[pixel / 64] |= 1 << (pixel % 64);
        }
        let (mut count, mut before) = (0, Vec::with_capacity(words.len()));
        for word in &words {
            before.push(count);
            count += word.count_ones();
        }
        Mask { width, height, words, before, used: count as usize }
    }

    /// Returns width and height.
    pub fn size(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    /// Returns the number of used pixels.
    pub fn used(&self) -> usize {
        self.used
    }

    /// Returns whether a pixel is used.
    ///
    /// # Panics
    /// If it lies outside of the image.
    pub fn uses(&self, x: usize, y: usize) -> bool {
        let pixel = pixel_index(self.size(), x, y, "mask");
        self.words[pixel / 64] >> (pixel % 64) & 1 == 1
    }

    /// Draws a uniformly random used pixel (column, row).
    ///
    /// # Panics
    /// If none is used.
    pub fn draw(&self, rng: &mut (impl Rng + ?Sized)) -> [usize; 2] {
        assert!(self.used > 0, "the mask has no used pixel");
        let number = rng.random_range(0..self.used) as u32;
        let word = self.before.partition_point(|before| *before <= number) - 1;
        let mut left = self.words[word];
        for _ in self.before[word]..number {
            left &= left - 1;
        }
        let pixel = 64 * word + left.trailing_zeros() as usize;
        [pixel % self.width, pixel / self.width]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand::rngs::StdRng;

    #[test]
    fn mask_draws_used_pixels_uniformly() {
        let mask = Mask::new(10, 7, |x, y| (x + y) % 3 == 0);
        assert_eq!((mask.used(), mask.size()), (24, [10, 7]));
        let (mut rng, mut counts) = (StdRng::seed_from_u64(1), vec![0; 70]);
        for _ in 0..24_000 {
            let [x, y] = mask.draw(&mut rng);
            assert!(mask.uses(x, y) && (x + y) % 3 == 0);
            counts[10 * y + x] += 1;
        }
        assert!(counts.iter().filter(|n| **n > 0).all(|n| (850..1150).contains(n)), "{counts:?}");
        for place in [[3, 99], [0, 0], [99, 99]] {
            let single = Mask::new(100, 100, |x, y| [x, y] == place);
            assert_eq!(single.draw(&mut rng), place);
        }
    }

    #[test]
    #[should_panic(expected = "the mask has no used pixel")]
    fn empty_mask_has_no_pixel_to_draw() {
        Mask::new(3, 3, |_, _| false).draw(&mut StdRng::seed_from_u64(1));
    }
}
