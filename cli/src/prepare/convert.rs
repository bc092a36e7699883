//! Conversion of a dataset to another format.

use std::collections::HashMap;
use std::path::{Component, Path, PathBuf};

use clap::ValueEnum;
use raygrad::nerf::dataset::formats::colmap::Encoding;
use raygrad::nerf::dataset::formats::{blender, colmap, llff, transforms};
use raygrad::nerf::dataset::{Capture, Depths, Format, Photo, Split, View};
use raygrad::nerf::{Camera, Error, Result, create_folder, rename_durable};
use raygrad::nn::TEMPORARY_PREFIX;
use serde_json::{Value, json};

use super::root::Root;
use super::undistort;
use super::workplace::Workplace;
use super::{bounds, next};
use crate::interrupt::Work;
use crate::merge;
use crate::output::{complain, entries, is_written, note, print, remove};
use crate::parse::read_text;
use crate::progress::Progress;
use crate::run::write_json;
use crate::shard::{self, Complete, Part, Shard, Whole};

/// Formats that can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Target {
    /// transforms.json, of nerfstudio and instant-ngp
    Nerfstudio,
    /// sparse/0/*.bin
    Colmap,
    /// sparse/0/*.txt
    ColmapText,
    /// poses_bounds.npy
    Llff,
    /// transforms_train.json and its like, of the NeRF-synthetic scenes
    Blender,
}

impl Target {
    /// The target of this format.
    pub fn of(format: Format) -> Self {
        match format {
            Format::Blender => Target::Blender,
            Format::Transforms => Target::Nerfstudio,
            Format::Colmap => Target::Colmap,
            Format::Llff => Target::Llff,
        }
    }

    /// Returns true if the format has one camera for all images, without distortion and with the principal point in the
    /// centre.
    pub fn is_plain(self) -> bool {
        matches!(self, Target::Llff | Target::Blender)
    }

    /// Whether the format has masks and sparse points.
    fn has_masks_and_points(self) -> bool {
        !matches!(self, Target::Llff | Target::Blender)
    }

    /// Whether the format has measured depths.
    fn has_depths(self) -> bool {
        self == Target::Nerfstudio
    }

    /// Whether the format stores which images are held out.
    fn has_splits(self) -> bool {
        self != Target::Llff
    }

    /// Where in a folder of this format an image is, and what its view is called. `inner` is its path among the images.
    fn place(self, inner: &str, rest: &str, split: Option<Split>) -> (String, String) {
        let flat = |name: &str| name.replace('/', "_");
        match self {
            Target::Nerfstudio if rest.contains('/') && rest == inner => (rest.to_owned(), rest.to_owned()),
            Target::Nerfstudio => (format!("images/{inner}"), format!("images/{inner}")),
            Target::Colmap | Target::ColmapText => (format!("images/{inner}"), inner.to_owned()),
            Target::Llff => (format!("images/{}", flat(inner)), flat(inner)),
            Target::Blender => {
                let split = split.unwrap_or(Split::Train).name();
                let inner = inner.strip_prefix(split).and_then(|inner| inner.strip_prefix('/')).unwrap_or(inner);
                let name = format!("{split}/{}", flat(inner));
                (name.clone(), name)
            }
        }
    }

    fn write(self, capture: &Capture, folder: &Path) -> Result<()> {
        match self {
            Target::Nerfstudio => transforms::write(capture, folder),
            Target::Colmap => colmap::write(capture, folder, Encoding::Binary),
            Target::ColmapText => colmap::write(capture, folder, Encoding::Text),
            Target::Llff => llff::write(capture, folder),
            Target::Blender => blender::write(capture, folder),
        }
    }
}

/// An image to convert.
struct Job {
    /// The view in the source.
    from: View,
    /// The view in the target. Its files are in the new folder.
    to: View,
    /// The new camera, if the image must be resampled.
    seen_by: Option<Camera>,
}

/// A conversion to another format.
pub struct Conversion {
    pub capture: Capture,
    pub target: Target,
    pub undistort: bool,
    /// Whether files outside of the capture's folder may be copied. A capture may name any file, and those who receive
    /// the dataset could read it.
    pub allow_outside: bool,
}

impl Conversion {
    /// Writes the dataset, with images, to `out`.
    pub fn run(mut self, out: &Path) -> Work<()> {
        self.check()?;
        let place = Workplace::new(out)?;
        let jobs = self.write(place.folder())?;
        let costs: Vec<u64> = jobs.iter().map(|job| job.from.decoding_memory()).collect();
        Progress::new().each(&costs, "images written", |i| Ok(jobs[i].run()?))?;
        place.finish()?;
        Ok(describe(&self.capture, &jobs, out)?)
    }

    /// Writes the images of one shard, and all other files. [`merge`] moves them to `out`.
    pub fn run_shard(mut self, out: &Path, shard: Shard) -> Work<()> {
        self.check()?;
        let at = staging(out)?;
        if out.symlink_metadata().is_ok() {
            return Err(Error::file(out, "exists: choose another --out, or leave out --shard").into());
        }
        let views: String = self.capture.views.iter().map(recorded).collect();
        let inputs = json!({
            "raygrad": env!("CARGO_PKG_VERSION"),
            "input": source(&self.capture).to_string_lossy(),
            "images": format!("{:08x}", crc32fast::hash(views.as_bytes())),
            "to": self.target.to_possible_value().map(|value| value.get_name().to_owned()),
            "undistort": self.undistort,
            "allow_outside": self.allow_outside,
        });
        let whole = Whole { command: COMMAND.to_owned(), inputs, items: self.capture.views.len() };
        let folder = at.join(DATASET);
        // A shard writes its record first, and only merging removes it.
        if folder.exists() && shard::own_facts::<Value>(&at)?.is_empty() {
            return Err(Error::file(&at, "holds a dataset without the records of its shards: remove it").into());
        }
        let mut part = Part::open(&at, shard, whole, Value::Null)?;
        create_folder(&folder)?;
        let jobs = self.write(&folder)?;
        let inside = |path: &Path| path.strip_prefix(&folder).unwrap_or(path).to_owned();
        let list: Vec<Vec<PathBuf>> = jobs.iter().map(|job| job.files().map(inside).collect()).collect();
        write_json(&at.join(LIST), &list)?;
        part.retain(|i| jobs[i].files().all(is_written))?;
        let items: Vec<usize> = part.items().skip(part.done()).collect();
        let progress = Progress::new();
        for items in items.chunks(4 * rayon::current_num_threads()) {
            let costs: Vec<u64> = items.iter().map(|&i| jobs[i].from.decoding_memory()).collect();
            progress.each(&costs, "images written", |i| Ok(jobs[items[i]].run()?))?;
            items.iter().try_for_each(|&i| jobs[i].sync())?;
            part.advance(items.len())?;
        }
        drop(progress);
        part.finish();
        merge::merge_if_complete(&at, shard)
    }

    /// Reduces the capture to the views that can be written, with the cameras of their images.
    fn check(&mut self) -> Result<()> {
        let Conversion { capture, target, undistort, allow_outside } = self;
        if *undistort || *target == Target::Llff {
            // The format cannot hold views without images.
            capture.views.retain(|view| view.image.is_some());
        }
        if *target == Target::Blender && capture.views.iter().any(|view| view.split.is_some()) {
            // The format has no place for others.
            let count = capture.views.len();
            capture.views.retain(|view| view.split.is_some());
            if capture.views.len() < count {
                note(&format!("left out {} images that are in no split", count - capture.views.len()));
            }
        }
        if capture.present().next().is_none() && *undistort {
            return Err(Error::file(&capture.file, "none of its images exists: check their paths"));
        }
        for view in &mut capture.views {
            // Images may be smaller than the camera file states. The target needs the actual size.
            if view.image.is_some() {
                view.camera = view.camera_of_image().map_err(|e| Error::field(&capture.file, &view.field, e))?;
            }
        }
        if *allow_outside { Ok(()) } else { check_inside(capture) }
    }

    /// Writes all files to a folder, except for the images. Returns what is to be done with each image.
    fn write(&self, folder: &Path) -> Result<Vec<Job>> {
        let Conversion { capture, target, undistort, .. } = self;
        let mut jobs = jobs(capture, *target, *undistort, folder)?;
        if *undistort {
            undistort::plan(&mut jobs.iter_mut().map(|job| (&mut job.to.camera, &mut job.seen_by)), target.is_plain())?;
        }
        let mut guessed = 0;
        if *target == Target::Llff {
            let bounds;
            (bounds, guessed) = bounds::of(capture)?;
            jobs.iter_mut().zip(bounds).for_each(|(job, bounds)| job.to.bounds = Some(bounds));
        }
        let views = jobs.iter().map(|job| job.to.clone()).collect();
        let written = Capture { folder: folder.into(), views, ..capture.clone() };
        // Written first, so that unsupported features fail before images are copied.
        target.write(&written, folder)?;
        if guessed > 0 {
            note(&format!(
                "{guessed} images see too few points for a depth range: raygrad wrote that of the scene box"
            ));
        }
        Ok(jobs)
    }
}

/// What the record of a shard holds of a view.
fn recorded(view: &View) -> String {
    let has = [view.image.is_some(), view.mask.is_some(), view.mask_is_dynamic, view.depth.is_some()];
    json!((&view.name, &view.camera, view.split, has)).to_string()
}

/// The name of the command in records.
pub const COMMAND: &str = "prepare";
/// The folder of the dataset in [`staging`].
const DATASET: &str = "dataset";
/// The list of each image's files in [`staging`], as paths in the dataset.
const LIST: &str = "files.json";

/// The folder of unfinished shards of a dataset, beside it.
pub fn staging(out: &Path) -> Result<PathBuf> {
    let absolute = std::path::absolute(out).map_err(|e| Error::file(out, e))?;
    let name = absolute.file_name().and_then(|name| name.to_str());
    let name = name.ok_or_else(|| Error::file(out, "is not a folder name in Unicode: choose another --out"))?;
    Ok(absolute.with_file_name(format!(".{name}{STAGED}")))
}

/// The end of the name of [`staging`].
const STAGED: &str = "-unfinished-shards";

/// Makes the dataset of complete shards.
pub fn merge(complete: Complete) -> Work<()> {
    let at = complete.at().to_owned();
    let name = at.file_name().and_then(|name| name.to_str());
    let name = name.and_then(|name| name.strip_prefix('.')?.strip_suffix(STAGED));
    let out = at.with_file_name(name.ok_or_else(|| Error::file(&at, "was renamed: name it as before"))?);
    let dataset = at.join(DATASET);
    // It is absent if an earlier merge was killed after it.
    if dataset.exists() {
        if out.symlink_metadata().is_ok() {
            return Err(Error::file(&out, "exists: move it away, then run `raygrad merge` again").into());
        }
        let list = at.join(LIST);
        let text = read_text(&list, "a list of images")?;
        let files: Vec<Vec<PathBuf>> = serde_json::from_str(&text).map_err(|e| Error::file(&list, e))?;
        for (i, files) in files.iter().enumerate() {
            files.iter().try_for_each(|file| complete.check(i, &dataset.join(file)))?;
        }
        remove_temporary(&dataset)?;
        rename_durable(&dataset, &out)?;
    } else if !out.exists() {
        let what = "is missing, as is what it would become: remove the folder around it and run all shards again";
        return Err(Error::file(&dataset, what).into());
    }
    shard::clear(&at);
    let images = complete.whole.items;
    complete.lock.remove();
    if let Err(e) = std::fs::remove_dir_all(&at) {
        complain(&format!("warning: {}: cannot be removed: {e}", at.display()));
    }
    print(&format!("scene    {}: {images} cameras\n", out.display()))?;
    Ok(next(&out)?)
}

/// Removes the temporary files that killed shards left in a dataset.
fn remove_temporary(folder: &Path) -> Result<()> {
    for path in entries(folder)? {
        if path.is_dir() {
            remove_temporary(&path)?;
        } else if path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(TEMPORARY_PREFIX)) {
            remove(&[path]);
        }
    }
    Ok(())
}

/// Fails if a file of a capture is outside of its folder. Links are resolved.
fn check_inside(capture: &Capture) -> Result<()> {
    let root = Root::of_capture(capture)?;
    for view in &capture.views {
        let depth = view.depth.as_ref().map(|(path, _)| path);
        for path in [view.image.as_ref(), view.mask.as_ref(), depth].into_iter().flatten() {
            root.check(path).map_err(|what| Error::field(&capture.file, &view.field, what))?;
        }
    }
    let points = capture.points_file.as_ref().map_or(Ok(()), |path| root.check(path));
    points.map_err(|what| Error::file(&capture.file, what))
}

/// The folder or the built-in scene that a capture is from.
fn source(capture: &Capture) -> &Path {
    // The images of a built-in scene have only been in a temporary folder.
    if capture.file.starts_with(&capture.folder) { &capture.folder } else { &capture.file }
}

fn describe(capture: &Capture, jobs: &[Job], out: &Path) -> Result<()> {
    let changed = jobs.iter().filter(|job| job.seen_by.is_some()).count();
    let copied = jobs.iter().filter(|job| job.from.image.is_some()).count() - changed;
    let absent = jobs.len() - changed - copied;
    if absent == jobs.len() {
        complain(&format!("warning: {}: no image exists, so only the cameras are converted", capture.file.display()));
    }
    let mut parts = vec![format!("{} cameras", jobs.len())];
    for (count, what) in [(copied, "images copied"), (changed, "images undistorted"), (absent, "images absent")] {
        if count > 0 {
            parts.push(format!("{count} {what}"));
        }
    }
    print(&format!("capture  {} ({})\n", source(capture).display(), capture.format))?;
    if let Some(Camera { width, height, .. }) = jobs.iter().find_map(|job| job.seen_by.as_ref()) {
        parts.push(format!("the first to {width}x{height}"));
    }
    print(&format!("scene    {}: {}\n", out.display(), parts.join(", ")))
}

/// Warnings about masks, points, depth files and splits that the new dataset does not have, or only for some programs.
fn lost(capture: &Capture, target: Target, undistorted: bool) -> Vec<String> {
    let count = |has: fn(&View) -> bool| capture.views.iter().filter(|view| has(view)).count();
    let masks = count(|view| view.mask.is_some());
    let dynamic = count(|view| view.mask_is_dynamic);
    let depths = count(|view| view.depth.is_some());
    let held_out = count(|view| view.split.is_some_and(|split| split != Split::Train));
    let mut warnings = vec![];
    if masks > 0 && !target.has_masks_and_points() {
        warnings.push(format!("{masks} masks are not converted: the format has none"));
    }
    if dynamic > 0 && target == Target::Nerfstudio {
        warnings.push(format!("{dynamic} dynamic masks become a `mask_path`, which instant-ngp does not read"));
    }
    if target == Target::Nerfstudio {
        for (count, what) in [(masks, "masks"), (depths, "depths")] {
            if (1..capture.views.len()).contains(&count) {
                let all = capture.views.len();
                warnings
                    .push(format!("{count} of {all} images have {what}: nerfstudio reads those of all images or none"));
            }
        }
    }
    if !capture.points.is_empty() && !target.has_masks_and_points() {
        warnings.push(format!("{} sparse points are not converted: the format has none", capture.points.len()));
    }
    if depths > 0 && !target.has_depths() {
        warnings.push(format!("{depths} depth files are not converted: the format has none"));
    } else if depths > 0 && undistorted {
        warnings.push(format!("{depths} depth files are not converted: --undistort does not change them"));
    }
    if held_out > 0 && !target.has_splits() {
        warnings.push(format!(
            "{held_out} held-out images lose their split, which the format cannot store: readers may hold out others, \
             such as every eighth"
        ));
    }
    warnings
}

/// What is to be done with each photograph.
fn jobs(capture: &Capture, target: Target, undistorted: bool, folder: &Path) -> Result<Vec<Job>> {
    let has_masks = target.has_masks_and_points();
    let has_depths = target.has_depths() && !undistorted;
    let mut taken = HashMap::new();
    let mut jobs = vec![];
    for view in &capture.views {
        let rest = relative(&capture.folder, view)?;
        let inner = inner(&rest);
        let (image, name) = target.place(inner, &rest, view.split);
        let of_field = |what: String| Err(Error::field(&capture.file, &view.field, what));
        match taken.insert(image.clone(), &view.image) {
            Some(other) if other.is_some() && *other == view.image => {
                return of_field(format!("lists `{}` a second time: remove one of them", view.name));
            }
            Some(_) => {
                return of_field(format!("`{}` and another image would both become {image}: rename one", view.name));
            }
            None => {}
        }
        let mut to = view.clone();
        to.image = view.image.as_ref().map(|_| folder.join(&image));
        to.name = name;
        // Written masks are white for used pixels. COLMAP's naming.
        to.mask_is_dynamic = false;
        to.mask = view.mask.as_ref().filter(|_| has_masks).map(|_| folder.join("masks").join(format!("{inner}.png")));
        to.depth = view.depth.as_ref().filter(|_| has_depths).map(|(path, unit)| {
            let ending = path.extension().unwrap_or_default().to_string_lossy();
            (folder.join("depths").join(format!("{inner}.{ending}")), *unit)
        });
        jobs.push(Job { from: view.clone(), to, seen_by: None });
    }
    for what in lost(capture, target, undistorted) {
        complain(&format!("warning: {}: {what}", capture.folder.display()));
    }
    Ok(jobs)
}

/// The path of a view's image relative to the capture's folder, with slashes. Images from elsewhere give their file
/// name.
pub fn relative(folder: &Path, view: &View) -> Result<String> {
    let path = view.image.as_deref().unwrap_or(Path::new(&view.name));
    let inside = match path.strip_prefix(folder) {
        Ok(inside) => inside,
        Err(_) if path.is_relative() && view.image.is_none() => path,
        Err(_) => Path::new(path.file_name().unwrap_or_default()),
    };
    // For a path outside of the folder, the part after the last `..`.
    let parts = inside.components().rev().take_while(|part| !matches!(part, Component::ParentDir));
    let parts: Option<Vec<&str>> = parts
        .filter_map(|part| match part {
            Component::Normal(name) => Some(name.to_str()),
            _ => None,
        })
        .collect();
    match parts {
        Some(parts) if !parts.is_empty() => Ok(parts.into_iter().rev().collect::<Vec<_>>().join("/")),
        _ => Err(Error::file(path, "has a name that is not Unicode: rename it")),
    }
}

/// The path within an image folder: `0.jpg` for `images/0.jpg` and `images_4/0.jpg`. Other names, such as
/// `images_train`, tell images apart.
fn inner(path: &str) -> &str {
    let is_factor = |name: &str| name.strip_prefix("images_").is_some_and(|factor| factor.parse::<u32>().is_ok());
    match path.split_once('/') {
        Some((first, rest)) if first == "images" || is_factor(first) => rest,
        _ => path,
    }
}

impl Job {
    /// The files that [`run`](Self::run) writes.
    fn files(&self) -> impl Iterator<Item = &Path> {
        let View { image, mask, depth, .. } = &self.to;
        let mask = mask.as_ref().filter(|_| image.is_some());
        let depth = depth.as_ref().map(|(path, _)| path);
        [image.as_ref(), mask, depth].into_iter().flatten().map(PathBuf::as_path)
    }

    /// Flushes the files, which a record then counts as complete.
    fn sync(&self) -> Result<()> {
        self.files().try_for_each(|path| {
            let synced = std::fs::File::open(path).and_then(|file| file.sync_all());
            synced.map_err(|e| Error::file(path, format!("cannot be written: {e}")))
        })
    }

    fn run(&self) -> Result<()> {
        let Job { from, to, seen_by } = self;
        // The file is copied unchanged, so its content is checked.
        if let (Some((from, _)), Some((to, _))) = (&from.depth, &to.depth) {
            Depths::check_file(from)?;
            copy_file(from, to)?;
        }
        let (Some(source), Some(image)) = (&from.image, &to.image) else { return Ok(()) };
        if let Some(camera) = seen_by {
            let (photo, mask) = from.seen_by(camera)?;
            make_parent(image)?;
            photo.save(image)?;
            if let (Some(mask), Some(path)) = (mask, &to.mask) {
                make_parent(path)?;
                mask.save_png(path)?;
            }
            return Ok(());
        }
        Photo::open(source, None)?;
        copy_file(source, image)?;
        let (Some(from), Some(to)) = (&from.mask, &to.mask) else { return Ok(()) };
        let Some(mask) = self.from.mask_photo(None)? else { return Ok(()) };
        let is_png = from.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("png"));
        if is_png && !self.from.mask_is_dynamic {
            return copy_file(from, to);
        }
        make_parent(to)?;
        mask.save(to)
    }
}

fn copy_file(from: &Path, to: &PathBuf) -> Result<()> {
    make_parent(to)?;
    std::fs::copy(from, to)
        .map(drop)
        .map_err(|e| Error::file(from, format!("cannot be copied to {}: {e}", to.display())))
}

fn make_parent(path: &Path) -> Result<()> {
    let Some(parent) = path.parent() else { return Ok(()) };
    std::fs::create_dir_all(parent).map_err(|e| Error::file(parent, format!("cannot be created: {e}")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DAffine3, DVec3};
    use raygrad::nerf::dataset::Point;
    use std::collections::HashSet;

    #[test]
    fn place_follows_the_target_format() {
        let of = |target: Target, rest: &str| target.place(inner(rest), rest, Some(Split::Test));
        let pair = |image: &str, name: &str| (image.to_owned(), name.to_owned());
        for (rest, target, image, name) in [
            ("images/a/0.jpg", Target::Nerfstudio, "images/a/0.jpg", "images/a/0.jpg"),
            ("images_4/0.png", Target::Nerfstudio, "images/0.png", "images/0.png"),
            ("images_train/0.png", Target::Nerfstudio, "images_train/0.png", "images_train/0.png"),
            ("test/r_0.png", Target::Nerfstudio, "test/r_0.png", "test/r_0.png"),
            ("0.jpg", Target::Nerfstudio, "images/0.jpg", "images/0.jpg"),
            ("images/a/0.jpg", Target::Colmap, "images/a/0.jpg", "a/0.jpg"),
            ("test/r_0.png", Target::ColmapText, "images/test/r_0.png", "test/r_0.png"),
            ("images/a/0.jpg", Target::Llff, "images/a_0.jpg", "a_0.jpg"),
            ("test/r_0.png", Target::Blender, "test/r_0.png", "test/r_0.png"),
            ("images/a/0.png", Target::Blender, "test/a_0.png", "test/a_0.png"),
        ] {
            assert_eq!(of(target, rest), pair(image, name), "{rest} {target:?}");
        }
    }

    #[test]
    fn records_of_shards_tell_kinds_of_masks_apart() {
        let view = View::new("0.png", "frames[0]", Camera::from_angle(4, 3, 1.0, DAffine3::IDENTITY));
        let masked = View { mask: Some("0.png.png".into()), ..view.clone() };
        let dynamic = View { mask_is_dynamic: true, ..masked.clone() };
        let distinct: HashSet<String> = [view, masked, dynamic].iter().map(recorded).collect();
        assert_eq!(distinct.len(), 3);
    }

    #[test]
    fn dynamic_masks_become_masks_of_used_pixels() {
        use raygrad::nerf::dataset::Image;
        let place = tempfile::tempdir().unwrap();
        let [image, mask] = ["images/0.png", "images/dynamic_mask_0.png"].map(|name| place.path().join(name));
        make_parent(&image).unwrap();
        Image::new(4, 3, 3).save_png(&image).unwrap();
        let mut ignored = Image::new(4, 3, 3);
        ignored.pixel_mut(1, 2)[2] = 0.5;
        ignored.save_png(&mask).unwrap();
        let camera = Camera::from_angle(4, 3, 1.0, DAffine3::IDENTITY);
        let view = View { image: Some(image), mask: Some(mask), ..View::new("images/0.png", "frames[0]", camera) };
        let view = View { mask_is_dynamic: true, ..view };
        let file = place.path().join("transforms.json");
        let capture = Capture::new(place.path(), file, Format::Transforms, vec![view]);
        let jobs = jobs(&capture, Target::Nerfstudio, false, &place.path().join("made")).unwrap();
        jobs[0].run().unwrap();
        assert!(!jobs[0].to.mask_is_dynamic);
        let made = Photo::open(jobs[0].to.mask.as_ref().unwrap(), None).unwrap();
        let black: Vec<usize> = made.pixels().enumerate().filter(|(_, p)| p[0] == 0.0).map(|(i, _)| i).collect();
        assert_eq!(black, [9]);
    }

    #[test]
    fn lost_parts_are_named_for_each_format() {
        let view = |split| View {
            split,
            ..View::new("0.png", "frames[0]", Camera::from_angle(4, 3, 1.0, DAffine3::IDENTITY))
        };
        let mut views: Vec<View> =
            [Some(Split::Train), Some(Split::Val), Some(Split::Test), Some(Split::Test), None].map(view).into();
        views[0].mask = Some("mask.png".into());
        (views[1].depth, views[2].depth) = (Some(("1.npy".into(), 1.0)), Some(("2.npy".into(), 1.0)));
        let mut capture = Capture::new(Path::new("scene"), "scene/transforms.json".into(), Format::Transforms, views);
        capture.points = vec![Point { position: DVec3::ZERO, color: [0; 3], error: 0.5, views: 2 }; 3];
        let points = "3 sparse points are not converted: the format has none";
        let masks = "1 masks are not converted: the format has none";
        let depths = "2 depth files are not converted: the format has none";
        let split = "3 held-out images lose their split, which the format cannot store: readers may hold out others, such \
                     as every eighth";
        let some = ["masks", "depths"].map(|what| {
            let count = if what == "masks" { 1 } else { 2 };
            format!("{count} of 5 images have {what}: nerfstudio reads those of all images or none")
        });
        let some = some.each_ref().map(String::as_str);
        for (target, expected) in [
            (Target::Nerfstudio, some.to_vec()),
            (Target::Blender, vec![masks, points, depths]),
            (Target::Colmap, vec![depths]),
            (Target::ColmapText, vec![depths]),
            (Target::Llff, vec![masks, points, depths, split]),
        ] {
            assert_eq!(lost(&capture, target, false), expected, "{target:?}");
            let undistorted = match target {
                Target::Nerfstudio => {
                    [&some[..], &["2 depth files are not converted: --undistort does not change them"]].concat()
                }
                _ => expected,
            };
            assert_eq!(lost(&capture, target, true), undistorted, "{target:?} undistorted");
        }
        let mut dynamic = View { mask_is_dynamic: true, mask: Some("dynamic_mask_0.png".into()), ..view(None) };
        let mut capture = Capture { views: vec![dynamic.clone(), view(None)], ..capture };
        let warning = "1 dynamic masks become a `mask_path`, which instant-ngp does not read";
        let some = "1 of 2 images have masks: nerfstudio reads those of all images or none";
        assert_eq!(lost(&capture, Target::Nerfstudio, false), [warning, some]);
        assert_eq!(lost(&capture, Target::Colmap, false), [""; 0]);
        dynamic.mask_is_dynamic = false;
        capture.views[0] = dynamic;
        assert_eq!(lost(&capture, Target::Nerfstudio, false), [some]);
        let views = vec![view(Some(Split::Train)), view(None)];
        let capture = Capture { views, points: vec![], ..capture };
        assert_eq!(lost(&capture, Target::Llff, false), Vec::<String>::new());
    }
}
