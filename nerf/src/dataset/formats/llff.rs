//! `poses_bounds.npy` of LLFF (Mildenhall et al. 2019): a row of 17 numbers for each image.
//!
//! The first 15 are a 3x5 matrix: the camera's directions down, right and backwards, its position, and height, width
//! and focal length in pixels. The last two are the nearest and farthest depth. Rows belong to the images of a
//! folder, usually `images`, in the order of their names, or to those of them that `view_imgs.txt` lists.

use super::limits::{MOST_PIXELS, leave_out, start, unfit_focal};
use super::locate::{IMAGES, folders, stem};
use super::npy::Matrix;
use super::paths::{extension, usual_extension};
use super::{masks, rigid};
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::dataset::capture::{Capture, Format, View};
use crate::error::{Error, Result};
use crate::files::write_atomic;
use glam::{DAffine3, DMat3, DVec3};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

const FILE: &str = "poses_bounds.npy";
/// The names of the images with a pose, by LLFF's `imgs2poses` of many tools.
const LIST: &str = "view_imgs.txt";
const COLUMNS: usize = 17;
/// The extensions that readers of the format know.
const EXTENSIONS: [&str; 3] = ["png", "jpg", "jpeg"];
/// The most by which the farthest depth may exceed the nearest. Other depths are no measurement.
const MOST_RATIO: f64 = 1e4;
/// The condition on depths, for messages.
const DEPTHS: &str = "must be above 0 and rise, by a factor of 10000 at most";

/// The file of a capture's folder.
pub(super) fn file(folder: &Path) -> PathBuf {
    folder.join(FILE)
}

/// Reads the cameras of `folder`. No image is decoded. Invalid depths are ignored, and single images without a valid
/// camera left out, as [`Capture::assumptions`] says.
///
/// # Errors
/// If a file is absent or damaged, half of the rows or more are not valid for a camera, or the numbers of images and
/// cameras differ without a `view_imgs.txt`. The error names the file and the row, counted from 0.
pub fn read(folder: &Path) -> Result<Capture> {
    let file = file(folder);
    let bytes = std::fs::read(&file).map_err(|e| Error::file(&file, format!("cannot be read: {e}")))?;
    let images = images(folder)?;
    let place = images.first().and_then(|(_, path)| path.parent()).unwrap_or(folder).to_owned();
    let mut capture = parse(folder, &bytes, images)?;
    let name = place.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    if place == folder || !name.starts_with("images") {
        let place = place.strip_prefix(folder).unwrap_or(&place).display().to_string();
        let place = if place.is_empty() { format!("beside `{FILE}`") } else { format!("of `{place}`") };
        capture.assumptions.push(format!("there are no images in `images`: used those {place}"));
    }
    masks::attach(&mut capture, &[folder.to_owned()])?;
    Ok(capture)
}

/// [`read`] for the bytes of the file and the images of the folder.
fn parse(folder: &Path, bytes: &[u8], images: Vec<(String, PathBuf)>) -> Result<Capture> {
    let file = file(folder);
    let matrix = Matrix::read(bytes).map_err(|what| Error::file(&file, what))?;
    let shape = |what: String| Error::field(&file, "shape", what);
    if matrix.columns != COLUMNS {
        return Err(shape(format!("must have {COLUMNS} columns, has {}", matrix.columns)));
    }
    if matrix.rows == 0 {
        return Err(shape("has no rows: add one per image".into()));
    }
    let (count, mut assumptions) = (images.len(), vec![]);
    let mut images: Vec<(String, Option<PathBuf>)> =
        images.into_iter().map(|(name, path)| (name, Some(path))).collect();
    if matrix.rows != count || is_other_list(folder, matrix.rows, &images) {
        images = listed(folder, matrix.rows, images)?;
        assumptions.push(format!("took the {} images that `{LIST}` lists, of {count}", matrix.rows));
    }
    let (mut views, mut invalid, mut left_out) = (Vec::with_capacity(matrix.rows), vec![], vec![]);
    for (index, (row, (name, image))) in matrix.values.chunks_exact(COLUMNS).zip(images).enumerate() {
        let field = format!("row {index}");
        let bad = |what| Error::field(&file, &field, what);
        let row = row.try_into().map_err(|_| bad("must have 17 numbers".into()))?;
        let (camera, bounds) = match camera(row) {
            Ok(valid) => valid,
            Err(what) => {
                left_out.push((name, bad(what)));
                continue;
            }
        };
        if bounds.is_none() {
            invalid.push(format!("row {index} has {} and {}", row[15], row[16]));
        }
        views.push(View { image, bounds, ..View::new(name, field, camera) });
    }
    if let Some(first) = invalid.first() {
        assumptions.push(format!(
            "ignored the depths of {} of {} rows, which {DEPTHS}: {first}",
            invalid.len(),
            views.len()
        ));
    }
    let count = left_out.len();
    if let Some(first) = left_out.into_iter().next() {
        leave_out(count, views.len(), first, &mut assumptions)?;
    }
    Ok(Capture { assumptions, ..Capture::new(folder, file, Format::Llff, views) })
}

/// The names that `view_imgs.txt` lists, without folders.
fn list(text: &str) -> Vec<&str> {
    let names = text.trim_start_matches('\u{feff}').lines().map(|line| line.trim().rsplit(['/', '\\']).next());
    names.flatten().filter(|name| !name.is_empty()).collect()
}

/// Returns true if `view_imgs.txt` lists an image for each row, and other images than the folder holds.
fn is_other_list(folder: &Path, rows: usize, images: &[(String, Option<PathBuf>)]) -> bool {
    let Ok(text) = std::fs::read_to_string(folder.join(LIST)) else { return false };
    let names = list(&text);
    let listed: BTreeSet<_> = names.iter().copied().map(stem).collect();
    names.len() == rows && listed != images.iter().map(|(name, _)| stem(name)).collect()
}

/// The images of the rows, as `view_imgs.txt` lists them.
fn listed(
    folder: &Path,
    rows: usize,
    images: Vec<(String, Option<PathBuf>)>,
) -> Result<Vec<(String, Option<PathBuf>)>> {
    let file = folder.join(LIST);
    let bad = |what: String| Err(Error::file(&file, what));
    if !file.is_file() {
        let beside = images.first().and_then(|(_, path)| path.as_ref()?.parent());
        let beside = beside.map_or("".into(), |folder| format!(" in {}", folder.display()));
        let what = format!(
            "has {rows} rows, but there are {} images{beside}: give each row its image, in the order of their names, \
            or list the names of the rows' images in {LIST}",
            images.len()
        );
        return Err(Error::field(folder.join(FILE), "shape", what));
    }
    let text = std::fs::read_to_string(&file).map_err(|e| Error::file(&file, format!("cannot be read: {e}")))?;
    let names = list(&text);
    if names.len() != rows {
        return bad(format!("has {} names, but {FILE} has {rows} rows: list the image of each row", names.len()));
    }
    // LLFF writes rows and names in the order of the names.
    if let Some(pair) = names.windows(2).find(|pair| pair[0] >= pair[1]) {
        let [first, second] = [0, 1].map(|i| start(pair[i]));
        return bad(match first == second {
            true => format!("lists `{first}` twice: list the image of each row"),
            false => format!(
                "lists `{second}` after `{first}`: rows may follow these lines or, as LLFF writes them, the names; \
                sort the lines if they follow the names, otherwise sort the rows too"
            ),
        });
    }
    // Downscaled images may have another extension.
    let found = |name: &str| {
        let exact = images.iter().find(|(own, _)| own == name);
        exact.or_else(|| images.iter().find(|(own, _)| stem(own) == stem(name))).cloned()
    };
    Ok(names.into_iter().map(|name| found(name).unwrap_or_else(|| (name.to_owned(), None))).collect())
}

/// The camera of a row and the depth bounds of its image, if these are valid.
fn camera(row: &[f64; COLUMNS]) -> std::result::Result<(Camera, Option<[f64; 2]>), String> {
    if let Some(column) = row[..15].iter().position(|value| !value.is_finite()) {
        return Err(format!("column {column} is not a finite number"));
    }
    let column = |c: usize| DVec3::new(row[c], row[5 + c], row[10 + c]);
    let pose = DAffine3 { matrix3: DMat3::from_cols(column(1), -column(0), column(2)), translation: column(3) };
    rigid::pose(&pose).map_err(|what| format!("its first three columns (down, right, backwards): {what}"))?;
    let [height, width, focal] = column(4).to_array();
    let pixels = |name: &str, value: f64| match value.round() {
        side if side >= 1.0 && side <= MOST_PIXELS as f64 => Ok(side as usize),
        _ => Err(format!("{name} must be 1 to {MOST_PIXELS} pixels, is {value}")),
    };
    let (width, height) = (pixels("width", width)?, pixels("height", height)?);
    if let Some(what) = unfit_focal(focal) {
        return Err(format!("focal length {what}"));
    }
    let bounds = Some([row[15], row[16]]).filter(|[near, far]| *near > 0.0 && far > near && *far <= MOST_RATIO * near);
    let centre = [0.5 * width as f64, 0.5 * height as f64];
    Ok((Camera { width, height, focal: [focal; 2], centre, lens: Lens::Pinhole, pose }, bounds))
}

/// The names and paths of images, sorted by name. They come from the folder `images` in any case or, if that has none,
/// from the least reduced `images_N`, another usual image folder, or the capture's folder itself.
fn images(folder: &Path) -> Result<Vec<(String, PathBuf)>> {
    let mut reduced: Vec<(u32, String)> = vec![];
    for name in names(folder)? {
        reduced.extend(name.strip_prefix("images_").and_then(|n| n.parse().ok()).map(|n: u32| (n, name.clone())));
    }
    reduced.sort();
    let mut places = folders(folder, &IMAGES[..1]);
    places.extend(reduced.into_iter().map(|(_, name)| folder.join(name)).filter(|place| place.is_dir()));
    places.extend(folders(folder, &IMAGES[1..]));
    places.push(folder.to_owned());
    for folder in places {
        let mut found = names(&folder)?;
        found.retain(|name| is_image(name) && folder.join(name).is_file());
        // TIFF beside other images are depths, or copies.
        if found.iter().any(|name| usual_extension(name).is_some()) {
            found.retain(|name| usual_extension(name).is_some());
        }
        found.sort();
        if !found.is_empty() {
            return Ok(found.into_iter().map(|name| (name.clone(), folder.join(name))).collect());
        }
    }
    let what = "has no images (png, jpg, webp, tif): put them in this folder, or in images_4 or images_8";
    Err(Error::file(folder.join("images"), what))
}

/// Returns true for the name of an image. Hidden files, such as the `._` twins of macOS, are none.
fn is_image(name: &str) -> bool {
    !name.starts_with('.') && extension(name).is_some()
}

/// The names of the files in a folder. Those that are not UTF-8 must not be images.
fn names(folder: &Path) -> Result<Vec<String>> {
    let bad = |e: std::io::Error| Error::file(folder, format!("cannot be read: {e}"));
    let entries = std::fs::read_dir(folder).map_err(bad)?;
    let name = |entry: std::io::Result<std::fs::DirEntry>| {
        let entry = match entry {
            Ok(entry) => entry,
            Err(error) => return Some(Err(bad(error))),
        };
        match entry.file_name().into_string() {
            Ok(name) => Some(Ok(name)),
            Err(name) if is_image(&name.to_string_lossy()) => {
                Some(Err(Error::file(folder.join(name), "has a name that is not UTF-8: rename it")))
            }
            Err(_) => None,
        }
    };
    entries.filter_map(name).collect()
}

/// Writes the cameras of `capture` to `poses_bounds.npy` in `folder`, which must exist.
///
/// The caller puts each image in `images` under the name of its view.
///
/// # Errors
/// If the cameras differ in more than their poses, or are not centred pinholes. If a view has no bounds or no plain
/// image name, or the file cannot be written. The error names the view.
pub fn write(capture: &Capture, folder: &Path) -> Result<()> {
    let mut views: Vec<&View> = capture.views.iter().collect();
    views.sort_by(|a, b| a.name.cmp(&b.name));
    let Some(first) = views.first() else {
        return Err(Error::file(&capture.file, "has no images to write: add at least one"));
    };
    let mut values = Vec::with_capacity(COLUMNS * views.len());
    for (index, view) in views.iter().enumerate() {
        let bad = |member: &str, what| Error::field(&capture.file, format!("{}.{member}", view.field), what);
        let ending = extension(&view.name).map(str::to_lowercase).unwrap_or_default();
        if !is_image(&view.name) || !EXTENSIONS.contains(&&*ending) || view.name.contains(['/', '\\']) {
            let what =
                format!("`{}` must be a plain png or jpg name without folders, as LLFF has one folder", view.name);
            return Err(bad("name", what));
        }
        if index > 0 && views[index - 1].name == view.name {
            return Err(bad("name", format!("`{}` is there twice: rename one", view.name)));
        }
        plain(&view.camera, &first.camera).map_err(|what| bad("camera", what))?;
        let Some([near, far]) = view.bounds else {
            return Err(bad("bounds", "are missing; LLFF needs the nearest and the farthest depth".into()));
        };
        let Camera { width, height, focal, pose, .. } = &view.camera;
        let size = [*height as f64, *width as f64, focal[0]];
        let [right, up, back] = [pose.matrix3.x_axis, pose.matrix3.y_axis, pose.matrix3.z_axis];
        let mut row = [0.0; COLUMNS];
        for r in 0..3 {
            row[5 * r..5 * r + 5].copy_from_slice(&[-up[r], right[r], back[r], pose.translation[r], size[r]]);
        }
        [row[15], row[16]] = [near, far];
        // The reader's checks: a written row must be readable.
        if camera(&row).map_err(|what| bad("camera", what))?.1.is_none() {
            return Err(bad("bounds", format!("{DEPTHS}, are {near} and {far}")));
        }
        values.extend(row);
    }
    write_atomic(folder.join(FILE), &Matrix { rows: views.len(), columns: COLUMNS, values }.write())
}

/// Checks that the format can hold a camera together with the first.
fn plain(camera: &Camera, first: &Camera) -> std::result::Result<(), String> {
    const UNDISTORT: &str =
        "LLFF needs equal pinhole cameras: convert the original with `raygrad prepare --undistort --to llff`";
    let Camera { width, height, focal, centre, lens, .. } = camera;
    if *lens != Lens::Pinhole {
        return Err(format!("has lens distortion; {UNDISTORT}"));
    }
    if focal[0] != focal[1] {
        return Err(format!("has different focal lengths, {} and {}; {UNDISTORT}", focal[0], focal[1]));
    }
    if *centre != [0.5 * *width as f64, 0.5 * *height as f64] {
        let [x, y] = centre;
        return Err(format!("has its principal point at ({x}, {y}), not at the centre; {UNDISTORT}"));
    }
    if (*width, *height, *focal) != (first.width, first.height, first.focal) {
        return Err(format!("differs in size or focal length from the others; {UNDISTORT}"));
    }
    Ok(())
}

#[cfg(test)]
mod tests;
