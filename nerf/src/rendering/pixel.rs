//! What is seen along a ray.

/// What is seen along one ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pixel {
    /// Colour, RGB.
    pub color: [f64; 3],
    /// Distance times the light that comes from there, in scene units.
    pub depth: f64,
    /// Light that is left, 0..=1.
    pub transmittance: f64,
}

impl Default for Pixel {
    /// Nothing.
    fn default() -> Self {
        Pixel { color: [0.0; 3], depth: 0.0, transmittance: 1.0 }
    }
}

impl Pixel {
    /// The same over a background.
    pub fn over(mut self, background: [f64; 3]) -> Self {
        self.color.iter_mut().zip(background).for_each(|(value, behind)| *value += self.transmittance * behind);
        self
    }
}
