//! From a capture to photographs in memory.

use super::capture::{Capture, Format, View};
use super::formats;
use super::frames::{Dataset, Frame, Split, evenly_spaced};
use super::mask::Mask;
use super::photo::Photo;
use super::placement::Placement;
use super::survey::{Scope, Survey};
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};
use rayon::prelude::*;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Of photographs that no file puts in a split, every one of this number, from the first by name, is held out to test on.
const HELD_OUT: usize = 8;
/// Photographs that are looked at to find out whether they are transparent anywhere.
const LOOKED_AT: usize = 3;
/// How much of a pixel of a mask must be white for it to be used.
const WHITE: f32 = 0.99;

/// How photographs are read.
#[derive(Clone, Copy)]
pub struct Reading<'a> {
    /// The number that their width and height are divided by, rounded: a pixel is the mean of what it covers.
    pub downscale: usize,
    /// How many of them are read at most, [evenly spaced](evenly_spaced).
    pub views: usize,
    /// Is told how many are read, of how many; from several threads.
    pub progress: &'a (dyn Fn(usize, usize) + Sync),
}

impl Default for Reading<'_> {
    fn default() -> Self {
        Reading { downscale: 1, views: usize::MAX, progress: &|_, _| {} }
    }
}

impl Capture {
    /// What the files of a folder say: its format is found out, and photographs that no file puts in a split are put in
    /// one. Sorted by name, every eighth of those that exist is held out to [test](Split::Test) on, from the first; all
    /// others are to train on.
    ///
    /// # Errors
    /// If the folder is absent or of no known format, or a file has a bad field; if a photograph is to be trained and tested
    /// on.
    pub fn read(folder: impl AsRef<Path>) -> Result<Capture> {
        let folder = folder.as_ref();
        if !folder.is_dir() {
            let what = if folder.exists() { "is not a folder" } else { "there is no such folder" };
            return Err(Error::file(folder, what));
        }
        let mut capture = formats::read(folder)?;
        capture.views.sort_by(|a, b| (a.split.map(Split::name), &a.name).cmp(&(b.split.map(Split::name), &b.name)));
        capture.hold_out();
        capture.check_splits()?;
        Ok(capture)
    }

    fn hold_out(&mut self) {
        if self.views.iter().any(|view| view.split.is_some()) {
            return;
        }
        let few = self.present().count() < 3;
        let mut number = 0;
        for view in &mut self.views {
            let held = !few && view.image.is_some() && number % HELD_OUT == 0;
            number += usize::from(view.image.is_some());
            view.split = Some(if held { Split::Test } else { Split::Train });
        }
    }

    /// Whether no image is both trained and tested on.
    fn check_splits(&self) -> Result<()> {
        let train = self.present().filter(|view| view.split == Some(Split::Train));
        let trained: HashMap<&PathBuf, &View> = train.filter_map(|view| Some((view.image.as_ref()?, view))).collect();
        for view in self.present().filter(|view| view.split != Some(Split::Train)) {
            if let Some(other) = view.image.as_ref().and_then(|image| trained.get(image)) {
                let what = format!("the image `{}` is to be tested on and is trained on as {}", view.name, other.field);
                return Err(Error::field(&self.file, &view.field, what));
            }
        }
        Ok(())
    }

    /// The photographs of a split. A capture that holds out one set alone has it for [`Split::Val`] and for
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
            return Err(Error::file(&self.file, format!("has no {split} photographs")));
        }
        Ok(found)
    }

    /// How the scene lies in the capture; `asked` overrules how far it goes.
    ///
    /// # Errors
    /// If an image that has an alpha channel cannot be read, or as [`Survey::new`].
    pub fn survey(&self, asked: Option<Scope>) -> Result<Survey> {
        let looked_at = evenly_spaced(self.present().collect(), LOOKED_AT);
        let mut transparent = false;
        for view in looked_at {
            let Some(path) = &view.image else { continue };
            if Photo::file_has_alpha(path)? {
                transparent |= Photo::open(path, None)?.is_transparent();
            }
        }
        Survey::new(self, transparent, asked)
    }

    /// Reads the photographs of a split, in parallel, and puts their cameras where the survey says.
    ///
    /// # Errors
    /// If the split has none whose image exists, an image cannot be decoded or is of another shape than its camera, or
    /// `downscale` or `views` is 0. Which of several errors is reported does not depend on timing. A single absent image is
    /// no error: see [`Dataset::skipped`].
    pub fn load(&self, split: Split, survey: &Survey, reading: &Reading<'_>) -> Result<Dataset> {
        for (name, value) in [("views", reading.views), ("downscale", reading.downscale)] {
            if value == 0 {
                return Err(Error::setting(name, "must be 1 or more, is 0"));
            }
        }
        let (present, absent): (Vec<&View>, Vec<&View>) =
            self.split(split)?.into_iter().partition(|view| view.image.is_some());
        if present.is_empty() {
            let first = &absent[0];
            let what = format!("none of the {split} images exists, not even that of the first, `{}`", first.name);
            return Err(Error::field(&self.file, &first.field, what));
        }
        let present = evenly_spaced(present, reading.views);
        let (done, total) = (AtomicUsize::new(0), present.len());
        let frames: Vec<Result<Frame>> = present
            .par_iter()
            .map(|view| {
                let frame = self.frame(view, &survey.placement, reading.downscale);
                (reading.progress)(done.fetch_add(1, Ordering::Relaxed) + 1, total);
                frame.map_err(|error| Error::field(&self.file, &view.field, error))
            })
            .collect();
        Ok(Dataset {
            frames: frames.into_iter().collect::<Result<_>>()?,
            bounds: survey.bounds,
            near: survey.near,
            far: survey.far,
            scope: survey.scope,
            placement: survey.placement,
            skipped: absent.into_iter().map(|view| view.name.clone()).collect(),
        })
    }

    fn frame(&self, view: &View, placement: &Placement, downscale: usize) -> Result<Frame> {
        let Some(path) = &view.image else { return Err(Error::file(&view.name, "does not exist")) };
        let (path, downscale) = match smaller(path, downscale) {
            Some(path) => (path, 1),
            None => (path.clone(), downscale),
        };
        let [stored, shown] = Photo::size_of_file(&path)?;
        let size = [stored, shown].into_iter().find(|size| same_shape(*size, &view.camera)).ok_or_else(|| {
            let Camera { width, height, .. } = view.camera;
            let [w, h] = shown;
            Error::file(
                &path,
                format!("has {w}x{h} pixels, and its camera is for {width}x{height}: they must have one shape"),
            )
        })?;
        let photo = Photo::open(&path, Some(size))?;
        let smaller =
            [photo.width, photo.height].map(|side| ((side as f64 / downscale as f64).round() as usize).max(1));
        let photo = photo.resized(smaller);
        let camera = placement.camera(&view.camera.resized(photo.width, photo.height));
        let mask = view.mask.as_ref().map(|path| read_mask(path, &photo)).transpose()?;
        let mask = seen(&camera, mask);
        if mask.as_ref().is_some_and(|mask| mask.used() == 0) {
            return Err(Error::file(&path, "shows nothing: all of its pixels are masked, or not reached by light"));
        }
        Ok(Frame { name: view.name.clone(), camera, image: photo, mask, distances: None })
    }
}

/// The same image in a folder of images that somebody has made smaller by this factor, as `images_4` beside `images`.
fn smaller(path: &Path, downscale: usize) -> Option<PathBuf> {
    if downscale == 1 {
        return None;
    }
    let folder = path.ancestors().find(|folder| folder.file_name().is_some_and(|name| name == "images"))?;
    let inside = path.strip_prefix(folder).ok()?;
    let other = folder.with_file_name(format!("images_{downscale}")).join(inside);
    let endings = ["", "png", "jpg", "JPG", "jpeg", "webp"];
    let named = |ending: &&str| if ending.is_empty() { other.clone() } else { other.with_extension(ending) };
    endings.iter().map(named).find(|path| path.is_file())
}

/// Whether an image of this size can have been taken by the camera, at another scale: up to the rounding of a side.
fn same_shape([width, height]: [usize; 2], camera: &Camera) -> bool {
    let [w, h] = [width as f64, height as f64];
    let [cw, ch] = [camera.width as f64, camera.height as f64];
    (w * ch - h * cw).abs() <= 1.01 * cw.max(ch).max(w).max(h)
}

/// Reads a mask, white where the photograph is used.
fn read_mask(path: &Path, photo: &Photo) -> Result<Mask> {
    let mask = Photo::open(path, None)?;
    let Photo { width, height, .. } = *photo;
    if mask.width < width || mask.height < height {
        let what = format!("has {}x{} pixels, fewer than its photograph's {width}x{height}", mask.width, mask.height);
        return Err(Error::file(path, what));
    }
    let mask = mask.resized([width, height]);
    Ok(Mask::new(width, height, |x, y| mask.pixel(x, y)[0] >= WHITE))
}

/// Without the pixels that no light reaches through the camera's lens.
fn seen(camera: &Camera, mask: Option<Mask>) -> Option<Mask> {
    let Camera { width, height, .. } = *camera;
    let centre = |x: usize, y: usize| camera.sees(x as f64 + 0.5, y as f64 + 0.5);
    // A lens that reaches the border reaches all that is within.
    let border =
        (0..width).flat_map(|x| [(x, 0), (x, height - 1)]).chain((0..height).flat_map(|y| [(0, y), (width - 1, y)]));
    if camera.lens == Lens::Pinhole || border.into_iter().all(|(x, y)| centre(x, y)) {
        return mask;
    }
    Some(Mask::new(width, height, |x, y| centre(x, y) && mask.as_ref().is_none_or(|mask| mask.uses(x, y))))
}
