//! The frames of a JSON file as views.

use super::json::{Object, first_of, unused};
use super::layers::Layers;
use super::locate::{Located, locate};
use super::paths::extension;
use super::points::reason;
use super::unsupported::check_supported;
use super::{masks, matrix, paths};
use crate::dataset::capture::View;
use crate::dataset::photo::{Header, Photo};
use crate::error::{Error, Result};
use serde_json::Value;
use std::cmp::Ordering;
use std::collections::{BTreeSet, HashMap, HashSet};
use std::path::{Path, PathBuf};

/// The relative difference of equal poses.
const SAME_POSE: f64 = 1e-6;

/// The relative difference of focal lengths of one camera, as shares of the longer side.
const SAME_CAMERA: f64 = 0.02;

/// The unit of integer depth images in nerfstudio: a millimetre in scenes in metres.
const DEPTH_UNIT: f64 = 1e-3;

/// The programs that a file is for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Dialect {
    /// instant-ngp and nerfstudio. Images may differ in size unless the file gives one.
    Transforms,
    /// Blender. All images have one size, and `camera_angle_y` is not that of the images.
    Blender,
}

/// The frames of one capture, in one or several documents.
#[derive(Debug, Default)]
pub(super) struct Frames {
    /// The views of each document, in the order of its frames.
    pub(super) views: Vec<Vec<View>>,
    /// Names of frames without a usable camera, which were left out.
    pub(super) left_out: HashSet<String>,
    /// The name and error of the first of them.
    error: Option<(String, Error)>,
    /// The scale of all rotations, if they have one.
    scale: Option<f64>,
    /// Names of frames that are marked as bad.
    bad: Vec<String>,
    /// Sentences about files found elsewhere, and frames left out.
    pub(super) assumptions: Vec<String>,
}

impl Frames {
    /// Reads the frames of the documents. No image is decoded; headers are read if a document gives no size.
    pub(super) fn read(tops: &[Object<'_>], folder: &Path, dialect: Dialect) -> Result<Self> {
        let mut out = Frames::default();
        let mut frames = vec![];
        for top in tops {
            check_supported(top)?;
            frames.push(top.frames()?);
        }
        let all: Vec<&Object<'_>> = frames.iter().flatten().collect();
        for frame in &all {
            frame.required("file_path")?;
        }
        out.scale = matrix::shared_scale(&all, "transform_matrix");
        if let Some(scale) = out.scale {
            let what =
                format!("all rotations scale by {scale:.6}: divided them by it, and left the positions as they are");
            out.assumptions.push(what);
        }
        // A mask or depth that stands beside the images is no image.
        let mut taken = HashSet::new();
        for member in ["mask_path", "depth_file_path", "depth_path"] {
            let named = |frame: &&Object<'_>| paths::normal(frame, member, frame.get(member)?).ok();
            taken.extend(all.iter().filter_map(named).filter_map(|name| paths::find(folder, &name)));
        }
        let images = files(&all, "file_path", folder, &taken, &mut out.assumptions)?;
        let taken: HashSet<PathBuf> =
            images.iter().flatten().filter_map(|(_, image)| Some(image.as_ref()?.path.clone())).collect();
        let mut images = images.into_iter();
        for (top, frames) in tops.iter().zip(&frames) {
            let images: Vec<_> = images.by_ref().take(frames.len()).flatten().collect();
            let views = out.document(top, frames, &images, (folder, &taken), dialect)?;
            out.views.push(views);
        }
        if let Some((name, error)) = out.error.take() {
            // Images that are mostly left out make a bad scene.
            let count = out.left_out.len().saturating_sub(out.bad.len());
            if 2 * count >= all.len() {
                return Err(error);
            }
            let (total, why) = (all.len(), reason(error));
            out.assumptions
                .push(format!("left out {count} of {total} frames without a usable camera, such as `{name}`: {why}"));
        }
        if let Some(first) = out.bad.first() {
            let (count, total) = (out.bad.len(), all.len());
            out.assumptions.push(format!("left out {count} of {total} frames that `is_bad` marks, such as `{first}`"));
        }
        out.assumptions.extend(moving(&all));
        out.assumptions.extend(masks::attach_dynamic(&mut out.views.iter_mut().flatten().collect::<Vec<_>>()));
        Ok(out)
    }

    fn document(
        &mut self,
        top: &Object<'_>,
        frames: &[Object<'_>],
        images: &[Named],
        (folder, taken): (&Path, &HashSet<PathBuf>),
        dialect: Dialect,
    ) -> Result<Vec<View>> {
        let layers: Vec<Layers<'_, '_>> = frames.iter().map(|frame| Layers { top, frame }).collect();
        let all: Vec<&Object<'_>> = frames.iter().collect();
        let masks = files(&all, "mask_path", folder, taken, &mut self.assumptions)?;
        let depths = Depths::of(top, &all, (folder, taken), &mut self.assumptions)?;
        let first = frames.iter().zip(images).find_map(|(frame, (_, image))| Some((frame, image.as_ref()?)));
        let (mut common, mut unclear, mut contradicting) = (None, BTreeSet::new(), None);
        let mut views = Vec::with_capacity(frames.len());
        let (mut rounded, mut blunt, mut shared) = (vec![], vec![], vec![]);
        for (i, (frame, (name, image))) in frames.iter().zip(images).enumerate() {
            check_supported(frame)?;
            if frame.flag("is_bad")? == Some(true) {
                self.bad.push(name.clone());
                self.left_out.insert(name.clone());
                continue;
            }
            let angle_y = dialect == Dialect::Transforms;
            let pose = matrix::pose(frame, "transform_matrix", self.scale)?;
            let pose = pose.and_then(|pose| layers[i].check_lengths(angle_y).map(|()| pose));
            let mut pose = match pose {
                Ok(pose) => pose,
                Err(error) => {
                    self.error.get_or_insert_with(|| (name.clone(), error));
                    self.left_out.insert(name.clone());
                    continue;
                }
            };
            if matrix::straighten(&mut pose) {
                let field = frame.field("transform_matrix");
                rounded.push(format!("`{field}` is a rotation with rounding errors: used the nearest rotation"));
            }
            let header = || {
                // An absent image is assumed to be as large as the first.
                let own = image.as_ref().filter(|_| dialect == Dialect::Transforms).map(|image| (frame, image));
                match (own, first) {
                    (Some(own), _) => size(top, own, &mut unclear),
                    (None, Some(first)) => {
                        let size = common.map_or_else(|| size(top, first, &mut unclear), Ok)?;
                        common = Some(size);
                        Ok(size)
                    }
                    (None, None) => Ok([0, 0]),
                }
            };
            let camera = layers[i].camera(pose, header, angle_y)?;
            if contradicting.is_none() {
                contradicting = layers[i].contradiction(&camera, angle_y);
            }
            if image.is_some() && layers[i].is_focal_alone(&camera, angle_y)? {
                shared.push(views.len());
            }
            views.push(View {
                image: image.as_ref().map(|image| image.path.clone()),
                mask: needed(frame, "mask_path", &masks[i], image.is_some())?,
                depth: depths.of_frame(i, &layers[i])?,
                sharpness: unused(frame.number("sharpness"), &mut blunt),
                ..View::new(name, &frame.path, camera)
            });
        }
        self.assumptions.extend(depths.absent(images));
        self.assumptions.extend(short_depths(&views, folder));
        check_distinct(top, &views)?;
        check_same_camera(top, shared.into_iter().map(|i| &views[i]))?;
        self.assumptions.extend(contradicting.into_iter().chain(first_of(&rounded)).chain(first_of(&blunt)));
        if let Some(first) = unclear.first() {
            let first = first.strip_prefix(folder).unwrap_or(first).display();
            // Of Blender's images, a single header is read.
            let count = match dialect {
                Dialect::Transforms => format!("{} ", unclear.len()),
                Dialect::Blender => String::new(),
            };
            self.assumptions.push(format!(
                "{count}images have an EXIF orientation but no `w` and `h`, such as `{first}`: used their pixels as \
                 stored; give the width and height of the turned images to turn them"
            ));
        }
        Ok(views)
    }
}

/// Checks that no image of a document has two poses.
///
/// # Errors
/// If one has.
fn check_distinct(top: &Object<'_>, views: &[View]) -> Result<()> {
    let mut known: HashMap<&Path, &View> = HashMap::new();
    for view in views {
        let image = view.image.as_deref().unwrap_or(Path::new(&view.name));
        let first = *known.entry(image).or_insert(view);
        let [one, two] = [first, view].map(|view| view.camera.pose);
        let is_near = one.translation.distance(two.translation) <= SAME_POSE * one.translation.length();
        if !(is_near && one.matrix3.abs_diff_eq(two.matrix3, SAME_POSE)) {
            let what =
                format!("has another pose for the image of {}, `{}`: remove one of them", first.field, view.name);
            return Err(top.error(&view.field, what));
        }
    }
    Ok(())
}

/// Checks that images with the file's focal length, which gives no size, are of one camera: copies of any size, upright
/// or on their side.
///
/// # Errors
/// If two are not.
fn check_same_camera<'a>(top: &Object<'_>, mut views: impl Iterator<Item = &'a View>) -> Result<()> {
    let share = |view: &View| view.camera.focal[0] / view.camera.width.max(view.camera.height) as f64;
    let Some(first) = views.next() else { return Ok(()) };
    let Some(other) = views.find(|view| (share(view) / share(first) - 1.0).abs() > SAME_CAMERA) else { return Ok(()) };
    let [one, two] =
        [first, other].map(|View { name, camera, .. }| format!("{}x{} (`{name}`)", camera.width, camera.height));
    let what = format!(
        "is missing beside the focal length, which images of {one} and {two} share: if they are scaled, cropped or \
         turned, give each frame its own `w`, `h` and `fl_x`"
    );
    Err(top.error("w", what))
}

/// A note on the frames of a scene that moves, as those of D-NeRF.
fn moving(frames: &[&Object<'_>]) -> Option<String> {
    let mut times = frames.iter().map(|frame| frame.get("time").and_then(Value::as_f64));
    let first = times.next()?;
    let what = "frames have different times (`time`); all are trained as one still scene, so what moves is blurred";
    times.any(|time| time != first).then(|| what.to_owned())
}

/// A listed path and its file, if it exists.
type Named = (String, Option<Located>);

/// The files of one member of each frame; `None` for frames without it.
fn files(
    frames: &[&Object<'_>],
    member: &str,
    folder: &Path,
    taken: &HashSet<PathBuf>,
    assumptions: &mut Vec<String>,
) -> Result<Vec<Option<Named>>> {
    let name = |frame: &&Object<'_>| frame.get(member).map(|value| paths::normal(frame, member, value)).transpose();
    let names = frames.iter().map(name).collect::<Result<Vec<Option<String>>>>()?;
    let listed: Vec<usize> = (0..frames.len()).filter(|&i| names[i].is_some()).collect();
    let paths: Vec<&str> = names.iter().flatten().map(String::as_str).collect();
    let found = locate(folder, &paths, taken, assumptions);
    let mut found = found.map_err(|(i, what)| frames[listed[i]].error(member, what))?;
    // ScanNet++ lists masks by their names alone, which are in a folder of masks.
    let in_masks = |path: &str| (member == "mask_path" && !path.contains('/')).then(|| format!("masks/{path}"));
    for rename in [&paths::plain as &dyn Fn(&str) -> Option<String>, &in_masks] {
        let lost = (0..paths.len()).filter(|&i| found[i].is_none());
        let (lost, renamed): (Vec<usize>, Vec<String>) = lost.filter_map(|i| Some((i, rename(paths[i])?))).unzip();
        if lost.is_empty() {
            continue;
        }
        let taken = found.iter().flatten().map(|file| file.path.clone()).chain(taken.iter().cloned()).collect();
        let renamed: Vec<&str> = renamed.iter().map(String::as_str).collect();
        let others = locate(folder, &renamed, &taken, &mut vec![]);
        let others = others.map_err(|(i, what)| frames[listed[lost[i]]].error(member, what))?;
        let mut notes = vec![];
        for (i, file) in lost.into_iter().zip(others).filter_map(|(i, file)| Some((i, file?))) {
            let inside = file.path.strip_prefix(folder).unwrap_or(&file.path).display();
            notes.push(format!("`{}` does not exist: used `{inside}`", paths[i]));
            found[i] = Some(file);
        }
        assumptions.extend(first_of(&notes));
    }
    let mut found = found.into_iter();
    Ok(names.into_iter().map(|name| Some((name?, found.next().flatten()))).collect())
}

/// The size of a frame's image, from its header. Programs that measure cameras read no EXIF orientation, so it is the
/// stored size, unless the principal point is nearer to the middle of the turned image. Images whose two sizes differ
/// are added to `unclear` without a principal point that decides.
fn size(
    top: &Object<'_>,
    (frame, image): (&Object<'_>, &Located),
    unclear: &mut BTreeSet<PathBuf>,
) -> Result<[usize; 2]> {
    let sizes = Photo::size_of_file(&image.path).map_err(|e| match e {
        Error::File { path, what } => frame.error("file_path", format!("{}: {what}", path.display())),
        other => other,
    })?;
    let [stored, shown] = sizes.map(|size| size.map(|side| side * image.factor));
    if stored == shown {
        return Ok(stored);
    }
    if let [Some(x), Some(y)] = (Layers { top, frame }).centre()? {
        let distance = |[w, h]: [usize; 2]| f64::hypot(x - 0.5 * w as f64, y - 0.5 * h as f64);
        match distance(stored).total_cmp(&distance(shown)) {
            Ordering::Less => return Ok(stored),
            Ordering::Greater => return Ok(shown),
            Ordering::Equal => {}
        }
    }
    unclear.insert(image.path.clone());
    Ok(stored)
}

/// A file, if it exists.
fn file(named: &Option<Named>) -> Option<PathBuf> {
    named.as_ref().and_then(|(_, file)| Some(file.as_ref()?.path.clone()))
}

/// The mask of an image. It must exist if the image does.
fn needed(frame: &Object<'_>, member: &str, named: &Option<Named>, needed: bool) -> Result<Option<PathBuf>> {
    match named {
        Some((path, None)) if needed => {
            let what =
                format!("there is no file {path}: copy it there, or remove the field to use the image without it");
            Err(frame.error(member, what))
        }
        named => Ok(file(named)),
    }
}

/// A note on depth images of 8 bits in the default unit: they hold no depth beyond a quarter of a unit. Images of one
/// capture have one format, so it reads a single header.
fn short_depths(views: &[View], folder: &Path) -> Option<String> {
    let is_image = |(path, unit): &&(PathBuf, f64)| *unit == DEPTH_UNIT && extension(&path.to_string_lossy()).is_some();
    let (path, unit) = views.iter().filter_map(|view| view.depth.as_ref()).find(is_image)?;
    if !Header::read(path).is_ok_and(|header| header.pixel == header.channels) {
        return None;
    }
    let (path, most) = (path.strip_prefix(folder).unwrap_or(path).display(), 255.0 * unit);
    Some(format!(
        "depth images have 8 bits, such as `{path}`: in units of {unit}, no depth exceeds {most}; check \
         `depth_unit_scale_factor`"
    ))
}

/// The depth files of a document: nerfstudio's `depth_file_path`, or instant-ngp's `depth_path`, which needs an
/// `integer_depth_scale`.
struct Depths {
    nerfstudio: Vec<Option<Named>>,
    ngp: Vec<Option<Named>>,
    ngp_unit: f64,
}

impl Depths {
    fn of(
        top: &Object<'_>,
        frames: &[&Object<'_>],
        (folder, taken): (&Path, &HashSet<PathBuf>),
        assumptions: &mut Vec<String>,
    ) -> Result<Self> {
        let nerfstudio = files(frames, "depth_file_path", folder, taken, assumptions)?;
        let unit = top.number("integer_depth_scale")?.filter(|scale| *scale > 0.0);
        let is_used = top.flag("enable_depth_loading")? != Some(false);
        let ngp = match unit.filter(|_| is_used) {
            Some(_) => files(frames, "depth_path", folder, taken, assumptions)?,
            None => vec![None; frames.len()],
        };
        Ok(Depths { nerfstudio, ngp, ngp_unit: unit.unwrap_or(1.0) })
    }

    /// The file and unit of a frame.
    fn of_frame(&self, i: usize, layers: &Layers<'_, '_>) -> Result<Option<(PathBuf, f64)>> {
        if let Some(path) = file(&self.nerfstudio[i]) {
            // Float arrays are in scene units.
            let floats = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("npy"));
            let default = if floats { 1.0 } else { DEPTH_UNIT };
            let unit = layers.find("depth_unit_scale_factor", |object, name| object.positive(name))?;
            return Ok(Some((path, unit.unwrap_or(default))));
        }
        Ok(file(&self.ngp[i]).map(|path| (path, self.ngp_unit)))
    }

    /// A note on depth files of existing images that do not exist. Training without depths does not need them.
    fn absent(&self, images: &[Named]) -> Option<String> {
        let of_images = |depths| images.iter().zip(depths).filter(|((_, image), _)| image.is_some());
        let all = || of_images(&self.nerfstudio).chain(of_images(&self.ngp)).filter_map(|(_, depth)| depth.as_ref());
        let (first, _) = all().find(|(_, file)| file.is_none())?;
        let count = all().filter(|(_, file)| file.is_none()).count();
        Some(format!("{count} of {} depth files do not exist, such as `{first}`: left them out", all().count()))
    }
}
