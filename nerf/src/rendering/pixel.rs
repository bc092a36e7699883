//! The result of rendering one ray.

/// The rendered result of one ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pixel {
    /// Colour, RGB.
    pub color: [f64; 3],
    /// Depth sum `sum w t` along the ray, in scene units, not divided by opacity.
    pub depth: f64,
    /// Transmittance behind the last sample, 0 to 1.
    pub transmittance: f64,
}

impl Default for Pixel {
    /// An empty ray: black, with transmittance 1.
    fn default() -> Self {
        Pixel { color: [0.0; 3], depth: 0.0, transmittance: 1.0 }
    }
}

impl Pixel {
    /// Composites the pixel over a background.
    pub fn over(mut self, background: [f64; 3]) -> Self {
        self.color.iter_mut().zip(background).for_each(|(value, behind)| *value += self.transmittance * behind);
        self
    }
}
