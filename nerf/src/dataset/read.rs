//! Reading of captures, and their splits.

use super::capture::{Capture, Format, View};
use super::formats;
use super::frames::{CHOOSE, Split};
use super::hold_out::split_of;
use crate::error::{Error, Result};
use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

/// Without splits in the files, every this many images by name, from the first, is held out.
const HELD_OUT: usize = 8;

/// The split that the innermost of a path's folders with the name of one has.
fn split_of_folders(path: &Path) -> Option<Split> {
    path.ancestors().skip(1).find_map(|folder| match folder.file_name()?.to_str()?.to_lowercase().as_str() {
        "train" => Some(Split::Train),
        "val" | "eval" => Some(Split::Val),
        "test" => Some(Split::Test),
        _ => None,
    })
}

impl Capture {
    /// Reads the cameras of a folder in any [format](super::formats), without decoding images.
    ///
    /// `path` may also be a file that describes a capture: a `.json` file, `poses_bounds.npy`, or a file of a COLMAP
    /// model. If a folder holds several descriptions, the one with most existing images counts; of equally many, the
    /// first of `transforms.json`, Blender, COLMAP and LLFF. [`assumptions`](Self::assumptions) states the choice.
    ///
    /// Without splits in the files, those of Blender's files beside them count. Without these, folders such as `train` and
    /// `test` are splits if all existing images are in some. Otherwise every eighth image by name, from the first, is a
    /// [test](Split::Test) image, even if its file does not exist. The others are training images. If the files list
    /// only training images, the others are test images; if they list only held-out images, the others are training
    /// images. If they list both, others are [not used](Self::assumptions).
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
        self.split_by_folders();
        self.split_by_default();
        self.check_splits()?;
        let unused: Vec<&View> = self.present().filter(|view| view.split.is_none()).collect();
        if let [first, ..] = unused[..] {
            let count = unused.len();
            let what = format!("{count} images are in no split, such as `{}`: they are not used", first.name);
            self.assumptions.push(what);
        }
        Ok(self)
    }

    /// Sets the splits of images in folders such as `train` and `test`, if the files give none. All existing ones must be
    /// in such folders, of training images and of held-out ones.
    fn split_by_folders(&mut self) {
        if self.views.iter().any(|view| view.split.is_some()) {
            return;
        }
        let present = self.present().map(|view| (view, split_of_folders(self.inside(view))));
        let (trained, others): (Vec<_>, Vec<_>) = present.partition(|(_, split)| *split == Some(Split::Train));
        let Some((first, _)) = others.first().filter(|_| !trained.is_empty()) else { return };
        if others.iter().any(|(_, split)| split.is_none()) {
            return;
        }
        let (count, first) = (others.len(), self.inside(first).display());
        let what = format!("folders of the images are splits, such as that of `{first}`: {count} are held out");
        let splits: Vec<_> = self.views.iter().map(|view| split_of_folders(self.inside(view))).collect();
        self.views.iter_mut().zip(splits).for_each(|(view, split)| view.split = split);
        self.assumptions.push(what);
    }

    /// The path of a view's image below the capture's folder, or its name.
    fn inside<'a>(&self, view: &'a View) -> &'a Path {
        let inside = view.image.as_deref().and_then(|image| image.strip_prefix(&self.folder).ok());
        inside.unwrap_or(Path::new(&view.name))
    }

    /// Returns true if a folder or its parent describes a capture, if the folder holds one below, or if it is an export of
    /// another program that first needs its own conversion. Other folders of images need poses.
    pub fn is_described(folder: impl AsRef<Path>) -> bool {
        formats::is_described(folder.as_ref())
    }

    pub(super) fn split_by_default(&mut self) {
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
    pub(super) fn check_splits(&self) -> Result<()> {
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
}
