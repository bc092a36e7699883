//! Limits for the contents of a capture's files, and what becomes of images beyond them.

use crate::error::{Error, Result};
use std::ops::RangeInclusive;

/// The most pixels of an image side; more means that the file is damaged.
pub(super) const MOST_PIXELS: usize = 1 << 24;

/// Focal lengths in pixels; others mean that the file is damaged.
const FOCAL: RangeInclusive<f64> = 1e-3..=1e9;

/// What is wrong with a focal length in pixels.
pub(super) fn unfit_focal(focal: f64) -> Option<String> {
    let is_fit = FOCAL.contains(&focal);
    (!is_fit).then(|| format!("must be 1e-3 to 1e9 pixels, is {focal}"))
}

/// What is wrong with a coordinate of the principal point of an image with this side. Crops may lie beside the point, but
/// not far from it.
pub(super) fn unfit_centre(x: f64, side: usize) -> Option<String> {
    let is_fit = (-(side as f64)..=2.0 * side as f64).contains(&x);
    (!is_fit).then(|| format!("is {x}, far outside of an image {side} wide or high: scale it with the image"))
}

/// Says that images without a valid camera, by the first one's name and error, are left out of `kept` others. Without most
/// images the scene would be bad, so that is the error.
pub(super) fn leave_out(
    count: usize,
    kept: usize,
    (name, error): (String, Error),
    assumptions: &mut Vec<String>,
) -> Result<()> {
    if kept <= count {
        return Err(error);
    }
    let total = count + kept;
    assumptions.push(format!("left out {count} of {total} images without a valid camera, such as `{name}`: {error}"));
    Ok(())
}

/// The start of a word from a file, short enough for a one-line message.
pub(super) fn start(word: &str) -> String {
    word.chars().take(80).flat_map(char::escape_debug).collect()
}
