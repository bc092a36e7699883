//! GIF and APNG animations.

use std::io::Write;

use gif::Repeat;
use raygrad::nerf::{Image, quantise};

/// Quantiser speed for 256 colours, from 1 (best quality) to 30.
const QUANTISER_SPEED: i32 = 10;

/// An endless animation, written frame by frame. All RGB images have one size.
pub enum Animation<W: Write> {
    /// Each frame has its own 256 colours.
    Gif {
        /// The encoder.
        encoder: Box<gif::Encoder<W>>,
        /// Frames per second.
        fps: f64,
        /// Number of frames so far.
        frames: u32,
    },
    /// Lossless colours.
    Apng(Box<png::Writer<W>>),
}

impl<W: Write> Animation<W> {
    /// An empty GIF with a comment. Frame times are in hundredths of a second and are rounded, so that the total time
    /// is exact.
    pub fn gif(to: W, [width, height]: [u16; 2], fps: f64, comment: &str) -> Result<Self, String> {
        let mut encoder = gif::Encoder::new(to, width, height, &[]).map_err(|e| e.to_string())?;
        encoder.set_repeat(Repeat::Infinite).map_err(|e| e.to_string())?;
        let comment = [comment.as_bytes()];
        encoder.write_raw_extension(gif::Extension::Comment.into(), &comment).map_err(|e| e.to_string())?;
        Ok(Animation::Gif { encoder: Box::new(encoder), fps, frames: 0 })
    }

    /// An empty APNG of this number of frames, with a comment.
    pub fn apng(to: W, [width, height]: [u16; 2], fps: f64, frames: u32, comment: &str) -> Result<Self, String> {
        let mut encoder = png::Encoder::new(to, width.into(), height.into());
        encoder.add_text_chunk("Comment".to_owned(), comment.to_owned()).map_err(|e| e.to_string())?;
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let animated = encoder.set_animated(frames, 0);
        // The delay is a fraction with 16-bit terms, so that slow rates use hundredths of a second.
        let (delay, of) =
            if fps < 1.0 { ((100.0 / fps).round() as u16, 100) } else { (100, (100.0 * fps).round() as u16) };
        let animated = animated.and_then(|()| encoder.set_frame_delay(delay, of));
        let writer = animated.and_then(|()| encoder.write_header()).map_err(|e| e.to_string())?;
        Ok(Animation::Apng(Box::new(writer)))
    }

    /// Appends a frame.
    pub fn push(&mut self, image: &Image) -> Result<(), String> {
        let bytes: Vec<u8> = image.data.iter().map(|&value| quantise(value)).collect();
        match self {
            Animation::Gif { encoder, fps, frames } => {
                let end = |frames: u32| (100.0 * f64::from(frames) / *fps).round();
                let delay = (end(*frames + 1) - end(*frames)) as u16;
                *frames += 1;
                let [width, height] = [image.width as u16, image.height as u16];
                let frame = gif::Frame::from_rgb_speed(width, height, &bytes, QUANTISER_SPEED);
                encoder.write_frame(&gif::Frame { delay, ..frame }).map_err(|e| e.to_string())
            }
            Animation::Apng(writer) => writer.write_image_data(&bytes).map_err(|e| e.to_string()),
        }
    }

    /// Finishes the file.
    pub fn finish(self) -> Result<(), String> {
        match self {
            Animation::Gif { encoder, .. } => {
                encoder.into_inner().and_then(|mut to| Ok(to.flush()?)).map_err(|e| e.to_string())
            }
            Animation::Apng(writer) => writer.finish().map_err(|e| e.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn apng_frame_delay_matches_the_rate() {
        for fps in [0.01, 0.015, 0.7, 1.0, 12.5, 29.97, 240.0] {
            let mut bytes = vec![];
            let mut animation = Animation::apng(&mut bytes, [4, 3], fps, 1, "a comment").unwrap();
            animation.push(&Image::new(4, 3, 3)).unwrap();
            animation.finish().unwrap();
            let at = bytes.windows(4).position(|window| window == b"fcTL").unwrap() + 4 + 20;
            let number = |at: usize| f64::from(u16::from_be_bytes([bytes[at], bytes[at + 1]]));
            assert!(
                (number(at) / number(at + 2) * fps - 1.0).abs() < 1e-3,
                "{fps}: {} / {}",
                number(at),
                number(at + 2)
            );
        }
    }

    #[test]
    fn gif_total_time_matches_the_rate() {
        // At 30 frames per second, a frame is not a whole number of hundredths.
        for (fps, frames) in [(30.0, 60), (40.0, 7), (25.0, 5)] {
            let mut bytes = vec![];
            let mut animation = Animation::gif(&mut bytes, [4, 3], fps, "a comment").unwrap();
            (0..frames).for_each(|_| animation.push(&Image::new(4, 3, 3)).unwrap());
            animation.finish().unwrap();
            let mut decoder = gif::Decoder::new(&bytes[..]).unwrap();
            let (mut total, mut count) = (0.0, 0);
            while let Some(frame) = decoder.read_next_frame().unwrap() {
                assert!((f64::from(frame.delay) - 100.0 / fps).abs() < 1.0);
                (total, count) = (total + f64::from(frame.delay), count + 1);
            }
            assert!(count == frames && (total - 100.0 * f64::from(frames) / fps).abs() <= 0.5, "{fps}: {total}");
        }
    }
}
