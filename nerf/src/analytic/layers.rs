//! Layers of constant density along z.

use super::{Exact, Medium};

/// A layer of constant density.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Layer {
    /// Start along z, in scene units.
    pub from: f64,
    /// End along z, in scene units.
    pub to: f64,
    /// Density, above 0, in 1 / scene unit.
    pub sigma: f64,
    /// Coefficients of the colour `color[0] + color[1] z`.
    pub color: [f64; 2],
}

/// A medium of layers across the z axis, empty in between. Each density is an amplitude.
#[derive(Debug, Clone, PartialEq)]
pub struct Layers(Vec<Layer>);

impl Layers {
    /// Creates a medium of layers in rising order without overlap.
    ///
    /// # Panics
    /// If layers overlap or are not in order, or a density is not above 0.
    #[track_caller]
    pub fn new(layers: &[Layer]) -> Self {
        let rising = layers.windows(2).all(|pair| pair[0].to <= pair[1].from);
        assert!(rising && layers.iter().all(|layer| layer.from < layer.to), "layers must rise and must not overlap");
        assert!(layers.iter().all(|layer| layer.sigma > 0.0), "a layer's density must be above 0");
        Layers(layers.to_vec())
    }

    /// Computes the exact integrals from z = 0 along the z axis up to `length`, over a background.
    pub fn exact(&self, length: f64, background: f64) -> Exact {
        let parts: Vec<Layer> = self.0.iter().map(|layer| layer.clipped(length)).collect();
        let mut transmittance = vec![1.0];
        for layer in &parts {
            transmittance.push(transmittance[transmittance.len() - 1] * (-layer.depth()).exp());
        }
        let left = transmittance[parts.len()];
        let mut exact = Exact {
            color: background,
            depth: 0.0,
            transmittance: left,
            d_color: vec![0.0; self.0.len()],
            d_depth: vec![0.0; self.0.len()],
            d_transmittance: vec![0.0; self.0.len()],
        };
        // Back to front: `color` and `depth` arrive from behind, and each layer attenuates them and the derivatives
        // behind it.
        for (k, layer) in parts.iter().enumerate().rev() {
            let (through, length) = ((-layer.depth()).exp(), layer.to - layer.from);
            for (behind, color, d) in [
                (&mut exact.color, layer.color, &mut exact.d_color),
                (&mut exact.depth, [0.0, 1.0], &mut exact.d_depth),
            ] {
                let [own, d_own] = layer.emitted(color);
                d[k] = transmittance[k] * (d_own - length * through * *behind);
                *behind = own + through * *behind;
            }
            exact.d_transmittance[k] = -length * left;
        }
        exact
    }

    /// The layer that contains a position, or the nearest one.
    fn nearest(&self, z: f64) -> &Layer {
        let distance = |layer: &Layer| (layer.from - z).max(z - layer.to);
        self.0.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(&EMPTY)
    }
}

/// A layer without density.
const EMPTY: Layer = Layer { from: 0.0, to: 0.0, sigma: 0.0, color: [0.0; 2] };

impl Layer {
    /// The part in `0..=length`, which may be empty.
    fn clipped(self, length: f64) -> Self {
        Layer { from: self.from.clamp(0.0, length), to: self.to.clamp(0.0, length), ..self }
    }

    fn depth(&self) -> f64 {
        self.sigma * (self.to - self.from)
    }

    /// The integral of `sigma e^(-sigma (z - from)) (color[0] + color[1] z)` over the layer, and its derivative by
    /// sigma.
    fn emitted(&self, color: [f64; 2]) -> [f64; 2] {
        let (x, length) = (self.depth(), self.to - self.from);
        let through = (-x).exp();
        let (opacity, moment) = (-(-x).exp_m1(), -(-x).exp_m1() - x * through);
        let first = color[0] + color[1] * self.from;
        let value = first * opacity + color[1] * moment / self.sigma;
        let slope =
            first * length * through + color[1] * (length * length * through - moment / (self.sigma * self.sigma));
        [value, slope]
    }
}

impl Medium for Layers {
    fn amplitudes(&self) -> Vec<f64> {
        self.0.iter().map(|layer| layer.sigma).collect()
    }

    fn shapes(&self, [_, _, z]: [f64; 3], out: &mut [f64]) {
        for (out, layer) in out.iter_mut().zip(&self.0) {
            *out = if (layer.from..=layer.to).contains(&z) { 1.0 } else { 0.0 };
        }
    }

    fn color(&self, [_, _, z]: [f64; 3]) -> f64 {
        let [first, slope] = self.nearest(z).color;
        first + slope * z
    }
}
