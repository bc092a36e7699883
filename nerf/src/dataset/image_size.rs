//! Sizes of image files against those of their cameras, and downscaled copies.

use super::formats;
use super::photo::Header;
use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};
use std::path::{Path, PathBuf};

/// The size of an image in the orientation of its camera: as stored, or as shown.
pub(super) fn size_for(path: &Path, camera: &Camera) -> Result<[usize; 2]> {
    fitting(&Header::read(path)?, path, camera)
}

/// The size of an image in the orientation of its camera, from its header.
pub(super) fn fitting(header: &Header, path: &Path, camera: &Camera) -> Result<[usize; 2]> {
    used_size(header.sizes, camera).ok_or_else(|| {
        let (Camera { width, height, .. }, [w, h]) = (camera, header.sizes[0]);
        let what = format!("has {w}x{h} pixels but its camera {width}x{height}; use one aspect ratio");
        Error::file(path, what)
    })
}

/// The image in a folder of downscaled images, such as `images_4` beside `images`, if it has that size, with the
/// remaining factor; otherwise the image itself. Also its header, and its size in the orientation of its camera.
pub(super) fn made_smaller(
    folder: &Path,
    path: &Path,
    camera: &Camera,
    downscale: usize,
) -> Result<(PathBuf, Header, [usize; 2], usize)> {
    let header = Header::read(path)?;
    let size = fitting(&header, path, camera)?;
    let inside = path.strip_prefix(folder).unwrap_or(Path::new(""));
    // The capture itself refers to downscaled images.
    let factor = formats::factor_of(inside);
    if factor > 1 {
        return Ok((path.to_owned(), header, size, downscale.div_ceil(factor)));
    }
    let other = (downscale > 1).then(|| smaller_copy(folder, path, inside, downscale)).flatten();
    let fits = |copy: PathBuf| {
        let header = Header::read(&copy).ok()?;
        let own = fitting(&header, &copy, camera).ok()?;
        let is_of_factor = |i: usize| own[i].abs_diff(size[i] / downscale) <= 1 + size[i] / downscale / 32;
        (is_of_factor(0) && is_of_factor(1)).then_some((copy, header, own, 1))
    };
    Ok(other.and_then(fits).unwrap_or_else(|| (path.to_owned(), header, size, downscale)))
}

/// The copy of an image `inside` a folder that is downscaled by this factor.
pub(super) fn smaller_copy(folder: &Path, path: &Path, inside: &Path, downscale: usize) -> Option<PathBuf> {
    let mut parts = inside.components();
    let first = parts.next().and_then(|part| part.as_os_str().to_str()).unwrap_or("");
    if first != "images" {
        return None;
    }
    let other = folder.join(format!("images_{downscale}")).join(parts.as_path());
    // An image of that name has a copy of its own.
    let endings = ["png", "jpg", "JPG", "jpeg", "webp"].into_iter().filter(|end| !path.with_extension(end).is_file());
    let endings: Vec<PathBuf> = endings.map(|ending| other.with_extension(ending)).collect();
    [other].into_iter().chain(endings).find(|path| path.is_file())
}

/// The size of an image in the orientation of its camera, of those [as stored and as shown](Photo::size_of_file).
pub(crate) fn used_size(sizes: [[usize; 2]; 2], camera: &Camera) -> Option<[usize; 2]> {
    sizes.into_iter().find(|size| same_shape(*size, camera))
}

/// Returns true if the aspect ratios of an image and a camera agree, up to the rounding of a side. ffmpeg, and so
/// nerfstudio, drops the fractions of both sides.
pub(crate) fn same_shape([width, height]: [usize; 2], camera: &Camera) -> bool {
    let factor = camera.width / width.max(1);
    if [width, height] == [camera.width, camera.height].map(|side| side / factor.max(1)) {
        return true;
    }
    let [w, h] = [width as f64, height as f64];
    let [cw, ch] = [camera.width as f64, camera.height as f64];
    // Half a pixel of the smaller size, at the scale of the larger.
    cw > 0.0 && ch > 0.0 && (w * ch - h * cw).abs() <= 0.51 * cw.max(ch).max(w).max(h)
}
