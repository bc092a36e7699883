//! Loading of a capture's images.

use super::capture::{Capture, View};
use super::depth::{Depths, distances};
use super::frames::{Dataset, Frame, Split, evenly_spaced};
use super::image_size::{made_smaller, size_for};
use super::lens_mask::seen_pixels;
use super::mask::Mask;
use super::photo::{Header, Photo};
use super::scene_analysis::SceneAnalysis;
use super::scene_transform::SceneTransform;
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};
use crate::memory::{available_memory, gigabytes};
use glam::DAffine3;
use raygrad_tensor::parallel::{self, locked};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

/// The largest downscale factor that is suggested.
const MOST_DOWNSCALE: u64 = 1 << 14;
/// The least mask value of a used pixel.
pub(crate) const WHITE: f32 = 0.99;

/// Options of [`Capture::load`].
#[derive(Clone, Copy)]
pub struct LoadOptions<'a> {
    /// Divisor of width and height, at least 1; pixels are area averages.
    pub downscale: usize,
    /// Maximum number of images, [evenly spaced](evenly_spaced), at least 1.
    pub views: usize,
    /// Whether to read [distances](Frame::distances) from [depth files](View::depth), which take four bytes per pixel.
    pub distances: bool,
    /// Whether [masks](View::mask) cut out an object: their black pixels become transparent instead of unused, and grey
    /// ones partly transparent. [`Capture::analyze_cutout`] analyses such a scene.
    pub mask_as_alpha: bool,
    /// The most bytes of memory for images, while they are decoded and afterwards; `None` for the
    /// [free memory](crate::available_memory).
    pub memory: Option<u64>,
    /// Progress callback `(read, total)`, in images; called from several threads.
    pub progress: &'a (dyn Fn(usize, usize) + Sync),
}

impl Default for LoadOptions<'_> {
    fn default() -> Self {
        LoadOptions {
            downscale: 1,
            views: usize::MAX,
            distances: false,
            mask_as_alpha: false,
            memory: None,
            progress: &|_, _| {},
        }
    }
}

impl LoadOptions<'_> {
    /// Checks that all values are in range.
    pub(super) fn check(&self) -> Result<()> {
        for (name, value) in [("views", self.views), ("downscale", self.downscale)] {
            if value == 0 {
                return Err(Error::setting(name, "is 0; use 1 or more"));
            }
        }
        Ok(())
    }
}

impl Capture {
    /// Reads one image at full size, in the orientation of its camera, without its mask.
    ///
    /// # Errors
    /// If the image does not exist, cannot be decoded or has another aspect ratio than its camera.
    pub fn photo(&self, view: &View) -> Result<Photo> {
        let Some(path) = &view.image else { return Err(Error::file(&view.name, "does not exist")) };
        self.named(view, open(path, &view.camera))
    }

    /// Reads one image as [`photo`](Self::photo) does, with its mask [as alpha](LoadOptions::mask_as_alpha).
    ///
    /// # Errors
    /// As [`photo`](Self::photo), and if the mask cannot be decoded or has another aspect ratio.
    pub fn cutout(&self, view: &View) -> Result<Photo> {
        self.named(view, cut_out(self.photo(view)?, view))
    }

    /// Reads the images of a split, in parallel, and maps their cameras to the scene by `analysis`.
    ///
    /// # Errors
    /// If none of the split's images exists, or none has a pixel that is used. If an image or mask cannot be decoded or
    /// has another aspect ratio than its camera, or `downscale` or `views` is 0. Which of several errors is reported does
    /// not depend on timing. Single images that are absent or masked as a whole are not an error: see
    /// [`Dataset::skipped`] and [`Dataset::masked`]. Before any image is decoded: if all of them together
    /// need more than [`LoadOptions::memory`], or an image has neither a mask nor transparency with
    /// [`LoadOptions::mask_as_alpha`].
    pub fn load(&self, split: Split, analysis: &SceneAnalysis, reading: &LoadOptions<'_>) -> Result<Dataset> {
        reading.check()?;
        let (present, absent): (Vec<&View>, Vec<&View>) =
            self.split(split)?.into_iter().partition(|view| view.image.is_some());
        if present.is_empty() {
            let first = &absent[0];
            let what = format!(
                "none of the {split} images exists (the first is `{}`); correct the paths or copy the images there",
                first.name
            );
            return Err(Error::field(&self.file, &first.field, what));
        }
        let present = evenly_spaced(present, reading.views);
        // All headers are checked before any image is decoded.
        let plan = |i: usize| self.named(present[i], Plan::new(self, present[i], *reading));
        let plans = parallel::collect(present.len(), plan);
        let plans = plans.into_iter().collect::<Result<Vec<_>>>()?;
        let (done, total, lit) = (AtomicUsize::new(0), plans.len(), Lit::default());
        let limit = self.decoding_limit(&plans, reading)?;
        let costs: Vec<u64> = plans.iter().map(|plan| plan.decoding).collect();
        let frames = parallel::collect_within(&costs, limit, |i| {
            let frame = plans[i].frame(&analysis.transform, &lit, reading.distances);
            (reading.progress)(done.fetch_add(1, Ordering::Relaxed) + 1, total);
            self.named(plans[i].view, frame)
        });
        let frames = frames.into_iter().collect::<Result<Vec<_>>>()?;
        let unused = plans.iter().zip(&frames).filter(|(_, frame)| frame.is_none());
        let masked: Vec<String> = unused.map(|(plan, _)| plan.view.name.clone()).collect();
        let frames: Vec<Frame> = frames.into_iter().flatten().collect();
        if frames.is_empty() {
            return self.named(plans[0].view, Err(plans[0].without_pixels()));
        }
        Ok(Dataset {
            frames,
            bounds: analysis.bounds,
            near: analysis.near,
            ndc: analysis.ndc,
            far: analysis.far,
            scene_type: analysis.scene_type,
            transform: analysis.transform,
            skipped: absent.into_iter().map(|view| view.name.clone()).collect(),
            masked,
        })
    }

    /// The most bytes for images that are decoded at the same time: what the loaded images leave free.
    fn decoding_limit(&self, plans: &[Plan<'_>], reading: &LoadOptions<'_>) -> Result<u64> {
        let Some(free) = reading.memory.or_else(available_memory) else { return Ok(u64::MAX) };
        let loaded: u64 = plans.iter().map(Plan::loaded).sum();
        let decoding = plans.iter().map(|plan| plan.decoding).max().unwrap_or(0);
        if loaded.saturating_add(decoding) <= free {
            return Ok(free - loaded);
        }
        // At least the largest image must be decoded, whatever its final size.
        let need = |factor: u64| (loaded / (factor * factor)).saturating_add(decoding);
        let fits = (2..=MOST_DOWNSCALE).find(|factor| need(*factor) <= free);
        let advice = match fits {
            Some(factor) => {
                format!("a downscale of {} needs {}", factor * reading.downscale as u64, gigabytes(need(factor)))
            }
            None => "use smaller images, or fewer".to_owned(),
        };
        let what = format!(
            "{} images need {} of memory, but {} are free: {advice}",
            plans.len(),
            gigabytes(need(1)),
            gigabytes(free)
        );
        Err(Error::file(&self.file, what))
    }

    /// Adds the entry of the image in the files to an error.
    fn named<T>(&self, view: &View, result: Result<T>) -> Result<T> {
        result.map_err(|error| Error::field(&self.file, &view.field, error))
    }
}

/// The plan to read one image.
struct Plan<'a> {
    view: &'a View,
    path: PathBuf,
    /// The size of the file's pixels in the orientation of the camera.
    size: [usize; 2],
    /// The size after downscaling.
    to: [usize; 2],
    /// True if the mask becomes alpha.
    is_cut: bool,
    /// Bytes of a pixel after it is loaded, with its distance.
    pixel: u64,
    /// The most bytes while the image, its mask and its depths are decoded.
    decoding: u64,
}

impl<'a> Plan<'a> {
    fn new(
        capture: &Capture,
        view: &'a View,
        LoadOptions { downscale, distances, mask_as_alpha, .. }: LoadOptions<'_>,
    ) -> Result<Self> {
        let Some(path) = &view.image else { return Err(Error::file(&view.name, "does not exist")) };
        let (path, header, size, downscale) = made_smaller(&capture.folder, path, &view.camera, downscale)?;
        let to = size.map(|side| ((side as f64 / downscale as f64).round() as usize).max(1));
        let is_cut = mask_as_alpha && view.has_cutout();
        if mask_as_alpha && !is_cut && header.channels == 3 {
            // Other images say that its background is empty.
            let what = "has no mask to cut out the object, and no transparency: add its mask, or use masks to ignore \
                        pixels (without --mask-as-alpha)";
            return Err(Error::file(path, what));
        }
        let bytes = |pixel: u64, [width, height]: [usize; 2]| pixel.saturating_mul((width * height) as u64);
        let depth = view.depth.as_ref().filter(|_| distances);
        let rgba = if is_cut { header.pixel / header.channels * 4 } else { header.pixel };
        let pixel = rgba + if depth.is_some() { 4 } else { 0 };
        let mut decoding = header.decoding;
        if let Some(mask) = &view.mask {
            // The mask, and its copy in the size of the image; then the image with alpha.
            let mask = Header::read(mask)?;
            let copies = if is_cut { bytes(mask.pixel + rgba, size) } else { bytes(mask.pixel, to) };
            decoding = decoding.saturating_add(mask.decoding).saturating_add(copies);
        }
        if let Some((path, _)) = depth {
            decoding = decoding.saturating_add(Depths::decoding_memory(path)?);
        }
        // Masks have a bit and a share of a count per pixel; that of a lens has a byte while it is computed.
        let is_masked = view.mask.is_some() && !is_cut || view.camera.lens != Lens::Pinhole;
        let pixel = pixel + u64::from(is_masked);
        Ok(Plan { view, path, size, to, is_cut, pixel, decoding })
    }

    /// Bytes of the loaded image.
    fn loaded(&self) -> u64 {
        self.pixel.saturating_mul((self.to[0] * self.to[1]) as u64)
    }

    /// Reads the image; `None` if no pixel is used.
    fn frame(&self, transform: &SceneTransform, lit: &Lit, is_measured: bool) -> Result<Option<Frame>> {
        let Plan { view, path, size, to, is_cut, .. } = self;
        let photo = Photo::open(path, Some(*size))?;
        // Before downscaling, which weighs colours by alpha: the background does not bleed into the object.
        let photo = if *is_cut { cut_out(photo, view)? } else { photo };
        let image = if [photo.width, photo.height] == *to { photo } else { photo.resized(*to) };
        let camera = view.camera.resized(to[0], to[1]);
        let given = if *is_cut { None } else { used_pixels(view, *size, *to)? };
        let mask = match (given, lit.of(&camera)) {
            (Some(given), Some(lit)) => {
                Some(Arc::new(Mask::new(to[0], to[1], |x, y| given.uses(x, y) && lit.uses(x, y))))
            }
            (given, lit) => given.map(Arc::new).or(lit),
        };
        if mask.as_ref().is_some_and(|mask| mask.used() == 0) {
            return Ok(None);
        }
        let camera = transform.camera(&camera);
        let measured = view.depth.as_ref().filter(|_| is_measured);
        let distances = measured.map(|(path, unit)| distances(path, unit * transform.scale, &camera)).transpose()?;
        Ok(Some(Frame { name: view.name.clone(), camera, image, mask, distances }))
    }

    /// The error of an image of which no pixel is used, and of which no other image exists.
    fn without_pixels(&self) -> Error {
        let mask = self.view.mask.as_ref();
        let mask = mask.map_or("no mask".to_owned(), |mask| format!("the mask `{}`", mask.display()));
        let what = format!("has no usable pixel, by {mask} and the lens, and no other image has: correct the mask");
        Error::file(&self.path, what)
    }
}

impl View {
    /// Returns whether there is a mask that can cut out an object.
    pub fn has_cutout(&self) -> bool {
        self.mask.is_some() && !self.mask_is_dynamic
    }

    /// Reads the mask, if there is one, as grey values: white for used pixels. `size` is that of [`Photo::open`].
    ///
    /// The brightest value counts as white, in any channel; transparent pixels are black.
    ///
    /// # Errors
    /// As [`Photo::open`], or if there are several values or colours besides black, and no white.
    pub fn mask_photo(&self, size: Option<[usize; 2]>) -> Result<Option<Photo>> {
        let Some(path) = &self.mask else { return Ok(None) };
        let mask = Photo::open(path, size)?;
        if self.mask_is_dynamic {
            return Ok(Some(mask.inverted()));
        }
        let what = "has no white, and not one value besides black: write 255 (white) for pixels to use, 0 for others";
        mask.into_mask().map(Some).ok_or_else(|| Error::file(path, what))
    }

    /// Returns the most bytes of memory while the image, its mask and its depths are decoded; without those whose
    /// headers cannot be read, as decoding reports their errors.
    pub fn decoding_memory(&self) -> u64 {
        let files = [&self.image, &self.mask].into_iter().flatten().map(Photo::decoding_memory);
        let depths = self.depth.iter().map(|(path, _)| Depths::decoding_memory(path));
        files.chain(depths).flatten().fold(0, u64::saturating_add)
    }
}

/// Reads an image in the orientation of its camera.
pub(super) fn open(path: &Path, camera: &Camera) -> Result<Photo> {
    Photo::open(path, Some(size_for(path, camera)?))
}

/// Makes the pixels transparent that the mask of a view, if there is one, does not use.
fn cut_out(photo: Photo, view: &View) -> Result<Photo> {
    let size = [photo.width, photo.height];
    let mask = if view.has_cutout() { read_mask(view, size, size)? } else { None };
    Ok(match mask {
        Some(mask) => photo.masked(&mask),
        None => photo,
    })
}

/// Reads the used pixels of an image of the size `of`, downscaled to the size `to`, from its mask.
fn used_pixels(view: &View, of: [usize; 2], to: [usize; 2]) -> Result<Option<Mask>> {
    let mask = read_mask(view, of, to)?;
    Ok(mask.map(|mask| Mask::new(to[0], to[1], |x, y| mask.pixel(x, y)[0] >= WHITE)))
}

/// Returns true if the aspect ratios of a mask and its image agree, up to a pixel of the smaller.
pub(crate) fn mask_fits(mask: [usize; 2], image: [usize; 2]) -> bool {
    let longest = mask.into_iter().chain(image).max().unwrap_or(0);
    (mask[0] * image[1]).abs_diff(mask[1] * image[0]) <= longest
}

/// Reads the mask of an image of the size `of`, resampled to the size `to`.
fn read_mask(view: &View, of: [usize; 2], to: [usize; 2]) -> Result<Option<Photo>> {
    let (Some(path), Some(mask)) = (&view.mask, view.mask_photo(Some(of))?) else { return Ok(None) };
    let from = [mask.width, mask.height];
    if !mask_fits(from, of) {
        let what =
            format!("has {}x{} pixels but its image {}x{}; use one aspect ratio", from[0], from[1], of[0], of[1]);
        return Err(Error::file(path, what));
    }
    Ok(Some(match (0..2).all(|axis| from[axis] >= to[axis]) {
        true => mask.resized(to),
        false => mask.resampled(to, |place| [0, 1].map(|axis| place[axis] * from[axis] as f64 / to[axis] as f64)),
    }))
}

/// The pixels that each lens sees, computed once per camera.
#[derive(Default)]
struct Lit(Mutex<Vec<(Camera, Option<Arc<Mask>>)>>);

impl Lit {
    /// The mask of seen pixels; `None` if the lens sees all.
    fn of(&self, camera: &Camera) -> Option<Arc<Mask>> {
        if camera.lens == Lens::Pinhole {
            return None;
        }
        let here = Camera { pose: DAffine3::IDENTITY, ..camera.clone() };
        let known = |known: &Vec<(Camera, Option<Arc<Mask>>)>| {
            known.iter().find(|(camera, _)| *camera == here).map(|(_, lit)| lit.clone())
        };
        if let Some(lit) = known(&locked(&self.0)) {
            return lit;
        }
        // Other cameras do not wait. Frames that share a camera may compute its mask twice.
        let lit = seen_pixels(&here).map(Arc::new);
        locked(&self.0).push((here, lit.clone()));
        lit
    }
}

#[cfg(test)]
mod tests;
