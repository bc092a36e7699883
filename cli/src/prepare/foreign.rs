//! Images that other programs convert to JPEG: HEIC and AVIF, and those of high dynamic range.

use std::path::{Path, PathBuf};
use std::process::Command;

use raygrad::nerf::dataset::{ForeignFormat, ForeignImage, Photo, copy_cleared};
use raygrad::nerf::{Error, Result};

use super::program::{FFMPEG, HEIF_CONVERT, HEIF_DEC, Program, file_url};
use super::tone;
use super::workplace::Workplace;
use crate::interrupt::{Stop, Work};
use crate::output::complain;

/// Programs that convert HEIC and AVIF, the best first: ffmpeg leaves out EXIF data, and some versions do not read tiled
/// images.
const OF_HEIF: [Program; 3] = [HEIF_CONVERT, HEIF_DEC, FFMPEG];
/// Of 100. The loss is not visible.
const QUALITY: &str = "95";
/// Bytes of memory per pixel of a conversion.
const PIXEL: u64 = 12;
/// The same for high dynamic range: several copies in floats.
const DEEP_PIXEL: u64 = 80;

/// The images among others that need a conversion, and the programs for it.
pub struct Foreign {
    /// `None` for images that raygrad reads.
    images: Vec<Option<ForeignImage>>,
    /// Converts HEIC and AVIF.
    of_heif: Program,
}

impl Foreign {
    /// Finds these images by their content. Says how images of high dynamic range are converted.
    ///
    /// # Errors
    ///
    /// Fails if there are some and no program is installed that converts them.
    pub fn find(images: &[PathBuf]) -> Work<Self> {
        let found = images.iter().map(ForeignImage::find).collect::<Result<Vec<_>>>()?;
        let first = |is_heif: bool| {
            let is_one = |image: &ForeignImage| (image.format == ForeignFormat::Heif) == is_heif;
            images.iter().zip(&found).find(|(_, image)| image.as_ref().is_some_and(is_one)).map(|(path, _)| path)
        };
        let installed = |programs: &[Program]| programs.iter().copied().find(|program| program.check().is_ok());
        let missing = |path: &Path, what: &str, program: Program| {
            Error::file(path, format!("is {what}, which {} reads: install it with {}", program.name, program.install))
        };
        let mut of_heif = HEIF_CONVERT;
        if let Some(path) = first(true) {
            of_heif = installed(&OF_HEIF).ok_or_else(|| missing(path, "HEIC or AVIF", HEIF_CONVERT))?;
        }
        if let Some(path) = first(false) {
            installed(&[FFMPEG]).ok_or_else(|| missing(path, "EXR or HDR PNG", FFMPEG))?;
            if !tone::can_map()? {
                let what =
                    "is EXR or HDR PNG, which this ffmpeg cannot map to sRGB: install one with the filter zscale";
                return Err(Error::file(path, what).into());
            }
            let count = found.iter().flatten().filter(|image| image.format != ForeignFormat::Heif).count();
            complain(&format!("note: {count} images of high dynamic range become sRGB: {}", tone::MAPPING));
        }
        Ok(Foreign { images: found, of_heif })
    }

    /// Whether the image number `i` is converted.
    pub fn contains(&self, i: usize) -> bool {
        self.images[i].is_some()
    }

    /// Bytes of memory of each conversion; 0 for other images.
    pub fn memory(&self) -> impl Iterator<Item = u64> {
        self.images.iter().map(|image| {
            image.map_or(0, |ForeignImage { format, size: [width, height] }| {
                let pixel = if format == ForeignFormat::Heif { PIXEL } else { DEEP_PIXEL };
                width.saturating_mul(height).saturating_mul(pixel)
            })
        })
    }

    /// Converts the image `from`, which has the number `i`, to a JPEG; returns false for other images.
    pub fn convert(&self, i: usize, from: &Path, to: &Path, place: &Workplace) -> Work<bool> {
        let Some(image) = self.images[i] else { return Ok(false) };
        let name = format!("foreign-{i}");
        let folder = place.make(&name)?;
        let (program, mut command) = self.command(image.format, from)?;
        command.current_dir(&folder).arg("0.jpg");
        program.run(&mut command, None, |_| {}).map_err(|stop| match stop {
            Stop::Failed(error) => failed(program, image.format, from, &error.to_string()),
            interrupted => interrupted,
        })?;
        // Files with several images become `0-1.jpg`, `0-2.jpg`, ...
        let made = ["0.jpg", "0-1.jpg"].map(|name| folder.join(name)).into_iter().find(|path| path.exists());
        let Some(made) = made else {
            let what = format!("was not converted: {} wrote no image", program.name);
            return Err(failed(program, image.format, from, &what));
        };
        let ([[width, height], _], [w, h]) = (Photo::size_of_file(&made)?, image.size);
        if 2 * (width * height) as u64 <= w.saturating_mul(h) {
            let read = format!("{} read only {width}x{height} of {w}x{h} pixels", program.name);
            return Err(failed(program, image.format, from, &format!("was not converted: {read}")));
        }
        copy_cleared(&made, to)?;
        place.remove(&name);
        Ok(true)
    }

    /// The program for an image, and its command without the output.
    fn command(&self, format: ForeignFormat, from: &Path) -> Work<(Program, Command)> {
        // The demuxer of ffmpeg, and the colours of high dynamic range.
        let (demuxer, colors) = match format {
            ForeignFormat::Heif => ("mov", None),
            // ffmpeg has the numbers of ITU-T H.273: 8 is linear, and 1 are the primaries of sRGB.
            ForeignFormat::Exr => ("exr_pipe", Some([8, 1])),
            ForeignFormat::Png { primaries, transfer } => ("png_pipe", Some([transfer, primaries])),
        };
        let program = if colors.is_some() { FFMPEG } else { self.of_heif };
        let mut command = program.command();
        if program != FFMPEG {
            let from = std::path::absolute(from).map_err(|e| Error::file(from, format!("cannot be read: {e}")))?;
            command.args(["-q", QUALITY]).arg(from);
            return Ok((program, command));
        }
        command.args(["-hide_banner", "-nostdin", "-loglevel", "error", "-protocol_whitelist", "file"]);
        command.args(["-f", demuxer, "-i"]).arg(file_url(from)?);
        if let Some([transfer, primaries]) = colors {
            let rgb = format!("tin={transfer}:pin={primaries}:min=gbr:rin=full:p={primaries}:m=gbr:r=full");
            command.args(["-vf", &tone::map(&rgb)]);
        }
        command.args(["-frames:v", "1", "-qmin", "1", "-q:v", "1"]);
        Ok((program, command))
    }
}

/// An error about an image; ffmpeg may be too old for HEIC.
fn failed(program: Program, format: ForeignFormat, from: &Path, what: &str) -> Stop {
    let advice = match program == FFMPEG && format == ForeignFormat::Heif {
        true => format!("; install heif-convert with {}", HEIF_CONVERT.install),
        false => String::new(),
    };
    Error::file(from, format!("{what}{advice}")).into()
}
