//! HEIC and AVIF images, which other programs convert to JPEG.

use std::path::{Path, PathBuf};

use raygrad::nerf::dataset::{Photo, copy_cleared, heif_size};
use raygrad::nerf::{Error, Result};

use super::program::{FFMPEG, HEIF_CONVERT, HEIF_DEC, Program, file_url};
use super::workplace::Workplace;
use crate::interrupt::{Stop, Work};

/// Programs that convert, the best first: ffmpeg leaves out EXIF data, and some versions do not read tiled images.
const PROGRAMS: [Program; 3] = [HEIF_CONVERT, HEIF_DEC, FFMPEG];
/// Of 100. The loss is not visible.
const QUALITY: &str = "95";
/// Bytes of memory per pixel of a conversion.
const PIXEL: u64 = 12;

/// The HEIC and AVIF images among others, and the program that converts them.
pub struct Heif {
    /// The size of each HEIC or AVIF image; `None` for other images.
    sizes: Vec<Option<[u64; 2]>>,
    program: Program,
}

impl Heif {
    /// Finds these images by their content.
    ///
    /// # Errors
    ///
    /// Fails if there are some and no program is installed that converts them.
    pub fn find(images: &[PathBuf]) -> Work<Self> {
        let sizes = images.iter().map(heif_size).collect::<Result<Vec<_>>>()?;
        let mut program = HEIF_CONVERT;
        if let Some((image, _)) = images.iter().zip(&sizes).find(|(_, size)| size.is_some()) {
            let what = format!("is HEIC or AVIF, which heif-convert reads: install it with {}", HEIF_CONVERT.install);
            let installed = PROGRAMS.into_iter().find(|program| program.check().is_ok());
            program = installed.ok_or_else(|| Error::file(image, what))?;
        }
        Ok(Heif { sizes, program })
    }

    /// Bytes of memory of each conversion; 0 for other images.
    pub fn memory(&self) -> impl Iterator<Item = u64> {
        self.sizes.iter().map(|size| size.map_or(0, |[width, height]| PIXEL.saturating_mul(width * height)))
    }

    /// Converts the image `from`, which has the number `i`, to a JPEG; returns false for other images.
    pub fn convert(&self, i: usize, from: &Path, to: &Path, place: &Workplace) -> Work<bool> {
        let Some(size) = self.sizes[i] else { return Ok(false) };
        let name = format!("heif-{i}");
        let folder = place.make(&name)?;
        let mut command = self.program.command();
        command.current_dir(&folder);
        if self.program == FFMPEG {
            command.args(["-hide_banner", "-nostdin", "-loglevel", "error", "-protocol_whitelist", "file"]);
            command.args(["-f", "mov", "-i"]).arg(file_url(from)?);
            command.args(["-frames:v", "1", "-qmin", "1", "-q:v", "1", "0.jpg"]);
        } else {
            let from = std::path::absolute(from).map_err(|e| Error::file(from, format!("cannot be read: {e}")))?;
            command.args(["-q", QUALITY]).arg(from).arg("0.jpg");
        }
        self.program.run(&mut command, None, |_| {}).map_err(|stop| match stop {
            Stop::Failed(error) => self.failed(from, &error.to_string()),
            interrupted => interrupted,
        })?;
        // Files with several images become `0-1.jpg`, `0-2.jpg`, ...
        let made = ["0.jpg", "0-1.jpg"].map(|name| folder.join(name)).into_iter().find(|path| path.exists());
        let Some(made) = made else {
            return Err(self.failed(from, &format!("was not converted: {} wrote no image", self.program.name)));
        };
        let ([[width, height], _], [w, h]) = (Photo::size_of_file(&made)?, size);
        if 2 * (width * height) as u64 <= w * h {
            let read = format!("{} read only {width}x{height} of {w}x{h} pixels", self.program.name);
            return Err(self.failed(from, &format!("was not converted: {read}")));
        }
        copy_cleared(&made, to)?;
        place.remove(&name);
        Ok(true)
    }

    /// An error about an image; ffmpeg may be too old for it.
    fn failed(&self, from: &Path, what: &str) -> Stop {
        let advice = match self.program == FFMPEG {
            true => format!("; install heif-convert with {}", HEIF_CONVERT.install),
            false => String::new(),
        };
        Error::file(from, format!("{what}{advice}")).into()
    }
}
