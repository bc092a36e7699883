//! Backgrounds, and compositing over them.

use std::fmt;
use std::str::FromStr;

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

use crate::dataset::image::Image;
use crate::error::{Error, Result};
use crate::range::by_name;

/// The background behind images with alpha, in training and output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Background {
    /// White, as in published results on the synthetic scenes.
    #[default]
    White,
    /// Black.
    Black,
    /// A random colour for each training ray, so that no density can imitate the background. Rendered and evaluated
    /// images get white.
    Random,
    /// The mean of the loss over all background colours: as `random`, without its noise. Only a squared error has this
    /// closed form; with another loss, colours are random. Rendered and evaluated images get white.
    Expected,
}

impl Background {
    /// Returns the colour behind a training ray. Only [`Random`](Self::Random) draws from `rng`: three uniform values,
    /// 0 to 1. [`Expected`](Self::Expected) is their mean.
    pub fn draw(self, rng: &mut (impl Rng + ?Sized)) -> [f32; 3] {
        match self {
            Background::Random => rng.random(),
            Background::Expected => [0.5; 3],
            fixed => fixed.shown(),
        }
    }

    /// Returns the background of output and evaluation: white in place of those that only training has.
    #[must_use]
    pub fn in_output(self) -> Background {
        match self {
            Background::White | Background::Random | Background::Expected => Background::White,
            Background::Black => Background::Black,
        }
    }

    /// Returns the colour behind images in output and evaluation.
    pub fn shown(self) -> [f32; 3] {
        if self.in_output() == Background::Black { [0.0; 3] } else { [1.0; 3] }
    }
}

impl fmt::Display for Background {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Background {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        by_name(text)
            .ok_or_else(|| Error::setting("background", format!("is `{text}`; use white, black, random or expected")))
    }
}

/// Composites one pixel over a background colour: `alpha c + (1 - alpha) background` for RGBA with straight alpha. RGB
/// passes through.
///
/// # Panics
/// If the pixel has neither 3 nor 4 channels.
#[track_caller]
pub fn over(pixel: &[f32], background: [f32; 3]) -> [f32; 3] {
    match *pixel {
        [r, g, b] => [r, g, b],
        [r, g, b, alpha] => {
            let [below_r, below_g, below_b] = background.map(|value| (1.0 - alpha) * value);
            [alpha * r + below_r, alpha * g + below_g, alpha * b + below_b]
        }
        _ => panic!("a pixel needs 3 or 4 channels, not {}", pixel.len()),
    }
}

impl Image {
    /// Composites the image [over](over()) a background colour: returns RGB of the same size.
    ///
    /// # Panics
    /// If the image has neither 3 nor 4 channels.
    #[track_caller]
    pub fn over(&self, background: [f32; 3]) -> Image {
        let data = self.data.chunks_exact(self.channels).flat_map(|pixel| over(pixel, background)).collect();
        Image { width: self.width, height: self.height, channels: 3, data }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand::rngs::StdRng;

    #[test]
    fn over_mixes_by_alpha() {
        let background = [1.0, 0.5, 0.0];
        assert_eq!(over(&[0.5, 0.5, 0.5, 1.0], background), [0.5; 3]);
        assert_eq!(over(&[0.5, 0.5, 0.5, 0.0], background), background);
        assert_eq!(over(&[0.5, 0.0, 1.0, 0.25], background), [0.875, 0.375, 0.25]);
        assert_eq!(over(&[0.1, 0.2, 0.3], background), [0.1, 0.2, 0.3]);
    }

    #[test]
    fn over_returns_rgb() {
        let image = Image { width: 2, height: 1, channels: 4, data: vec![0.5, 0.5, 0.5, 1.0, 0.5, 0.5, 0.5, 0.0] };
        let flat = image.over([0.0, 0.25, 1.0]);
        assert_eq!((flat.width, flat.height, flat.channels), (2, 1, 3));
        assert_eq!(flat.data, [0.5, 0.5, 0.5, 0.0, 0.25, 1.0]);
        assert_eq!(flat.over([0.0; 3]), flat);
    }

    #[test]
    #[should_panic(expected = "3 or 4 channels, not 1")]
    fn over_rejects_grey_images() {
        Image::new(1, 1, 1).over([0.0; 3]);
    }

    #[test]
    fn background_random_alone_draws() {
        let (mut rng, mut untouched) = (StdRng::seed_from_u64(3), StdRng::seed_from_u64(3));
        assert_eq!(Background::White.draw(&mut rng), [1.0; 3]);
        assert_eq!(Background::Black.draw(&mut rng), [0.0; 3]);
        let colour = Background::Random.draw(&mut rng);
        assert_eq!(colour, untouched.random::<[f32; 3]>());
        assert_ne!(colour, Background::Random.draw(&mut rng));
        assert_eq!(Background::Expected.draw(&mut rng), [0.5; 3]);
    }

    #[test]
    fn output_has_fixed_backgrounds() {
        for (background, output, color) in [
            (Background::White, Background::White, 1.0),
            (Background::Black, Background::Black, 0.0),
            (Background::Random, Background::White, 1.0),
            (Background::Expected, Background::White, 1.0),
        ] {
            assert_eq!((background.in_output(), background.shown()), (output, [color; 3]));
        }
    }

    #[test]
    fn names_round_trip() {
        for background in [Background::White, Background::Black, Background::Random, Background::Expected] {
            assert_eq!(background.to_string().parse::<Background>().unwrap(), background);
            assert_eq!(serde_json::to_string(&background).unwrap(), format!("\"{background}\""));
        }
        let message = "grey".parse::<Background>().unwrap_err().to_string();
        assert_eq!(message, "`background`: is `grey`; use white, black, random or expected");
    }

    proptest! {
        #[test]
        fn over_stays_between_its_colours(c in 0.0f32..=1.0, alpha in 0.0f32..=1.0, below in 0.0f32..=1.0) {
            let [mixed, ..] = over(&[c, c, c, alpha], [below; 3]);
            prop_assert!(mixed >= c.min(below) - 1e-6 && mixed <= c.max(below) + 1e-6);
        }
    }
}
