//! Animations as GIF files.

use gif::{Encoder, Frame, Repeat};
use raygrad::nerf::{Image, quantise};

/// Time that a frame is shown, in hundredths of a second.
const DELAY: u16 = 4;
/// Effort of choosing 256 colours, from 1 (most) to 30.
const QUANTISER_SPEED: i32 = 10;

/// An endless animation in memory. Each frame has 256 colours of its own.
pub struct Animation {
    encoder: Encoder<Vec<u8>>,
}

impl Animation {
    /// An animation without frames.
    pub fn new([width, height]: [u16; 2]) -> Result<Self, gif::EncodingError> {
        let mut encoder = Encoder::new(Vec::new(), width, height, &[])?;
        encoder.set_repeat(Repeat::Infinite)?;
        Ok(Animation { encoder })
    }

    /// Adds an RGB image of the animation's size.
    pub fn push(&mut self, image: &Image) -> Result<(), gif::EncodingError> {
        let bytes: Vec<u8> = image.data.iter().map(|&value| quantise(value)).collect();
        let mut frame = Frame::from_rgb_speed(image.width as u16, image.height as u16, &bytes, QUANTISER_SPEED);
        frame.delay = DELAY;
        self.encoder.write_frame(&frame)
    }

    /// The file.
    pub fn finish(self) -> Result<Vec<u8>, gif::EncodingError> {
        self.encoder.into_inner()
    }
}
