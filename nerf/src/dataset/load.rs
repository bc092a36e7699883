//! Loading of a capture's images.

use super::capture::{Capture, Format, View};
use super::depth::{Depths, distances};
use super::formats;
use super::frames::{CHOOSE, Dataset, Frame, Split, evenly_spaced};
use super::hold_out::split_of;
use super::lens_mask::seen_pixels;
use super::mask::Mask;
use super::photo::{Header, OPAQUE, Photo};
use super::scene_analysis::{EmptyBackground, SceneAnalysis};
use super::scene_transform::SceneTransform;
use super::scene_type::SceneType;
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};
use crate::memory::{available_memory, gigabytes};
use glam::DAffine3;
use raygrad_tensor::parallel::{self, locked};
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

/// Without splits in the files, every this many images by name, from the first, is held out.
const HELD_OUT: usize = 8;
/// Images that decide on an empty background.
const LOOKED_AT: usize = 3;
/// The transparent share of an image from which its background counts as empty.
const CLEAR: f64 = 0.05;
/// The white share of the border from which an image shows an object in front of white.
const WHITE_BORDER: f64 = 0.98;
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
    /// Reads the cameras of a folder in any [format](super::formats), without decoding images.
    ///
    /// `path` may also be a file that describes a capture: a `.json` file, `poses_bounds.npy`, or a file of a COLMAP
    /// model. If a folder holds several descriptions, the one with most existing images counts; of equally many, the
    /// first of `transforms.json`, Blender, COLMAP and LLFF. [`assumptions`](Self::assumptions) states the choice.
    ///
    /// Without splits in the files, every eighth image by name, from the first, is a [test](Split::Test) image, even if
    /// its file does not exist. The others are training images. If the files list only training images, the others are
    /// test images; if they list only held-out images, the others are training images.
    ///
    /// # Errors
    /// If the path is absent or has no known format, a file has a bad field, or an image is in both the training and
    /// the test split.
    pub fn read(path: impl AsRef<Path>) -> Result<Capture> {
        Capture::read_format(path, None)
    }

    /// [`read`](Self::read) for a folder with a description in this format.
    ///
    /// # Errors
    /// As [`read`](Self::read), or if there is no description in the format.
    pub fn read_format(path: impl AsRef<Path>, format: Option<Format>) -> Result<Capture> {
        formats::read(path.as_ref(), format, true)?.with_default_splits()
    }

    /// Reads the capture of `folder` by a file that describes it, such as the [`file`](Self::file) of an earlier
    /// reading.
    ///
    /// # Errors
    /// As [`read`](Self::read), or if the file does not describe a capture.
    pub fn read_description(folder: impl AsRef<Path>, file: impl AsRef<Path>) -> Result<Capture> {
        formats::read_file(folder.as_ref(), file.as_ref(), true)?.with_default_splits()
    }

    /// Reads the capture of `folder` by the file `description` or, without one, as [`read_format`](Self::read_format)
    /// does, but without splits. [`hold_out`](Self::hold_out) then makes them.
    ///
    /// # Errors
    /// As [`read_format`](Self::read_format), but not if splits are wrong. Blender's files of held-out images are left
    /// out if they are no JSON, as [`assumptions`](Self::assumptions) say.
    pub fn read_unsplit(
        folder: impl AsRef<Path>,
        description: Option<&Path>,
        format: Option<Format>,
    ) -> Result<Capture> {
        let folder = folder.as_ref();
        let read = description.map(|file| formats::read_file(folder, file, false));
        let mut capture = read.unwrap_or_else(|| formats::read(folder, format, false))?;
        capture.views.iter_mut().for_each(|view| view.split = None);
        Ok(capture)
    }

    fn with_default_splits(mut self) -> Result<Capture> {
        self.split_by_default();
        self.check_splits()?;
        Ok(self)
    }

    /// Returns true if a folder or its parent describes a capture, if the folder holds one below, or if it is an export of
    /// another program that first needs its own conversion. Other folders of images need poses.
    pub fn is_described(folder: impl AsRef<Path>) -> bool {
        formats::is_described(folder.as_ref())
    }

    fn split_by_default(&mut self) {
        let held_out = |view: &View| matches!(view.split, Some(Split::Val | Split::Test));
        if self.views.iter().all(|view| view.split.is_none()) {
            self.views.sort_by(|a, b| a.name.cmp(&b.name));
            let few = self.present().count() < 3;
            let held_out = if few { HashSet::new() } else { self.every(HELD_OUT) };
            self.hold_out_images(&held_out);
            return;
        }
        // The images that no list has are of the other kind.
        let is_held_out = self.views.iter().any(held_out);
        let is_trained = self.views.iter().any(|view| view.split == Some(Split::Train));
        if !(is_held_out && is_trained) {
            let other = if is_held_out { Split::Train } else { Split::Test };
            self.views.iter_mut().for_each(|view| view.split = view.split.or(Some(other)));
        }
    }

    /// Returns whether the held-out images are every eighth by name, as [`read`](Self::read) chooses without splits in
    /// the files.
    pub fn holds_out_every_eighth(&self) -> bool {
        let held_out = self.every(HELD_OUT);
        self.views.len() > 1 && self.views.iter().all(|view| view.split == Some(split_of(view, &held_out)))
    }

    /// Checks that no held-out image is also trained on.
    fn check_splits(&self) -> Result<()> {
        let train = self.present().filter(|view| view.split == Some(Split::Train));
        let trained: HashMap<&PathBuf, &View> = train.filter_map(|view| Some((view.image.as_ref()?, view))).collect();
        for view in self.present().filter(|view| view.split != Some(Split::Train)) {
            if let Some(other) = view.image.as_ref().and_then(|image| trained.get(image)) {
                let what = format!(
                    "`{}` is held out, but its image is trained on as {}: remove one of them; {CHOOSE}",
                    view.name, other.field
                );
                return Err(Error::field(&self.file, &view.field, what));
            }
        }
        Ok(())
    }

    /// Returns the images of a split. A capture with a single held-out set returns it for [`Split::Val`] and
    /// [`Split::Test`].
    ///
    /// # Errors
    /// If there is none.
    pub fn split(&self, split: Split) -> Result<Vec<&View>> {
        let of = |split: Split| self.views.iter().filter(|view| view.split == Some(split)).collect::<Vec<_>>();
        let other = match split {
            Split::Train => Split::Train,
            Split::Val => Split::Test,
            Split::Test => Split::Val,
        };
        let mut found = of(split);
        if found.is_empty() && self.format != Format::Blender {
            found = of(other);
        }
        if found.is_empty() {
            let first = self.views.first().filter(|_| self.present().next().is_none());
            let why = match (first, split) {
                (Some(view), _) => format!(": none of its images exists, such as `{}`", view.name),
                (None, Split::Train) => String::new(),
                (None, _) => format!("; {CHOOSE}"),
            };
            return Err(Error::file(&self.file, format!("has no {split} images{why}")));
        }
        Ok(found)
    }

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

    /// [Analyses](Self::analyze_scene) a scene whose masks [cut out an object](LoadOptions::mask_as_alpha): the
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

/// Reads an image in the orientation of its camera.
pub(super) fn open(path: &Path, camera: &Camera) -> Result<Photo> {
    Photo::open(path, Some(size_for(path, camera)?))
}

/// The image in a folder of downscaled images, such as `images_4` beside `images`, if it has that size, with the
/// remaining factor; otherwise the image itself. Also its header, and its size in the orientation of its camera.
fn made_smaller(
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
fn smaller_copy(folder: &Path, path: &Path, inside: &Path, downscale: usize) -> Option<PathBuf> {
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
