//! Whether a capture's background is empty, by the pixels of a few images.

use super::capture::{Capture, Format, View};
use super::frames::evenly_spaced;
use super::photo::{OPAQUE, Photo};
use super::scene_analysis::{EmptyBackground, SceneAnalysis};
use super::scene_type::SceneType;
use crate::error::{Error, Result};

/// Images that decide on an empty background.
const LOOKED_AT: usize = 3;
/// The transparent share of an image from which its background counts as empty.
const CLEAR: f64 = 0.05;
/// The white share of the border from which an image shows an object in front of white.
const WHITE_BORDER: f64 = 0.98;

impl Capture {
    /// Finds the scene transform, type, box, near and far plane from cameras and a few images; `asked` overrides the
    /// type.
    ///
    /// # Errors
    /// If an image with an alpha channel cannot be read, if all have one alpha below 1 or 12 bits in 16, or as
    /// [`SceneAnalysis::new`].
    pub fn analyze_scene(&self, asked: Option<SceneType>) -> Result<SceneAnalysis> {
        let looked_at = evenly_spaced(self.present().collect(), LOOKED_AT);
        let ([mut clear, mut white, mut alpha, mut hollow], total) = ([0; 4], looked_at.len());
        let (mut faint, mut low) = (vec![], vec![]);
        for view in looked_at {
            let Some(path) = &view.image else { continue };
            let name = |error| Error::field(&self.file, &view.field, error);
            let has_alpha = Photo::file_has_alpha(path).map_err(name)?;
            match Photo::open(path, None) {
                Ok(photo) => {
                    let (least, most) = photo.alpha_range();
                    faint.extend((least == most && most < OPAQUE).then_some((view, most)));
                    low.extend(photo.unscaled_bits().map(|most| (view, most)));
                    // A transparent border may be left by undistortion, so it is no sign of an empty background.
                    clear += usize::from(photo.transparent_share() > CLEAR);
                    alpha += usize::from(least < 1.0);
                    hollow += usize::from(photo.is_hollow());
                    white += usize::from(least >= OPAQUE && photo.white_border() > WHITE_BORDER);
                }
                Err(error) if has_alpha => return Err(name(error)),
                // Loading reports the error.
                Err(_) => {}
            }
        }
        if let Some((view, most)) = faint.first().filter(|_| faint.len() == total) {
            let what = format!(
                "has alpha {:.0} of 255 in every pixel of `{}`, and the other images that were looked at have one value \
                 too: remove the alpha channel, or make the object opaque in it",
                255.0 * most,
                view.name
            );
            return Err(Error::field(&self.file, &view.field, what));
        }
        if let Some((view, most)) = low.first().filter(|_| low.len() == total) {
            let what = format!(
                "has 16 bits per channel in `{}`, but no value above {most} of 65535, nor have the other images that \
                 were looked at: multiply all values by {}",
                view.name,
                match most {
                    0..256 => 257,
                    256..1024 => 64,
                    _ => 16,
                }
            );
            return Err(Error::field(&self.file, &view.field, what));
        }
        let empty = match (2 * clear > total, white == total) {
            (true, _) => Some(EmptyBackground::Transparent),
            (_, true) => Some(EmptyBackground::White),
            // An object may fill most of the image. Blender writes an alpha channel without one, too.
            _ if 2 * alpha > total && self.format == Format::Blender => Some(EmptyBackground::Transparent),
            _ => None,
        };
        Ok(SceneAnalysis { hollow: 2 * hollow > total, ..SceneAnalysis::new(self, empty, asked)? })
    }

    /// [Analyses](Self::analyze_scene) a scene whose masks [cut out an object](super::LoadOptions::mask_as_alpha): the
    /// background is empty.
    ///
    /// # Errors
    /// As [`SceneAnalysis::new`].
    pub fn analyze_cutout(&self, asked: Option<SceneType>) -> Result<SceneAnalysis> {
        let analysis = SceneAnalysis::new(self, Some(EmptyBackground::Masks), asked)?;
        let looked_at = evenly_spaced(self.present().collect(), LOOKED_AT);
        // Loading reports errors.
        let is_hollow = |view: &&&View| self.cutout(view).is_ok_and(|photo| photo.is_hollow());
        Ok(SceneAnalysis { hollow: 2 * looked_at.iter().filter(is_hollow).count() > looked_at.len(), ..analysis })
    }
}
