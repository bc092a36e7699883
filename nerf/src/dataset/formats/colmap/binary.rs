//! COLMAP's `.bin` files: numbers in a row, little-endian, each list after its length.

use super::super::encodings::decoded;
use super::super::points::{Points, reason};
use super::entries::{CameraEntry, ImageEntry, Place};
use super::models;
use super::table::Table;
use crate::dataset::capture::Point;
use crate::error::{Error, Result};
use glam::DVec3;
use std::path::Path;

/// The bytes of an observation: its position and the observed point.
const OBSERVATION: usize = 8 + 8 + 8;
/// The bytes of a track element: an image and the index of its observation.
const TRACK_ELEMENT: usize = 4 + 4;
/// The bytes of a camera with the fewest parameters.
const LEAST_CAMERA: usize = 4 + 4 + 8 + 8 + 2 * 8;
/// The bytes of an image with an empty name and no observation.
const LEAST_IMAGE: usize = 4 + 7 * 8 + 4 + 1 + 8;

/// The unread part of a file.
struct Cursor<'a> {
    file: &'a Path,
    rest: &'a [u8],
}

impl<'a> Cursor<'a> {
    /// Reads the number of entries of a list. The remaining bytes bound it, so that a damaged count cannot exhaust
    /// memory.
    fn count(&mut self, list: &str, least: usize) -> Result<usize> {
        let bad = |what: String| Error::field(self.file, list, what);
        let Some((head, rest)) = self.rest.split_first_chunk() else {
            return Err(bad("the file ends before their number: copy it again".into()));
        };
        let (count, most) = (u64::from_le_bytes(*head), rest.len() / least);
        self.rest = rest;
        match usize::try_from(count) {
            Ok(count) if count <= most => Ok(count),
            _ => Err(bad(format!(
                "announces {count} entries, but {} bytes hold {most} at most: copy the file again",
                rest.len()
            ))),
        }
    }

    /// Checks that nothing follows the entries. Of entries in another layout, the last would end elsewhere.
    fn end(&self, list: &str, count: u64) -> Result<()> {
        match self.rest.len() {
            0 => Ok(()),
            bytes => {
                let what = format!(
                    "{bytes} bytes follow the last of {count} entries: copy the file again, or convert it with COLMAP's \
                     `model_converter`"
                );
                Err(Error::field(self.file, list, what))
            }
        }
    }

    fn ended(&self, place: Place, member: &str) -> Error {
        place.error(self.file, member, "the file ends here: copy it again")
    }

    fn array<const N: usize>(&mut self, place: Place, member: &str) -> Result<[u8; N]> {
        let (head, rest) = self.rest.split_first_chunk().ok_or_else(|| self.ended(place, member))?;
        self.rest = rest;
        Ok(*head)
    }

    fn u32(&mut self, place: Place, member: &str) -> Result<u32> {
        self.array(place, member).map(u32::from_le_bytes)
    }

    fn u64(&mut self, place: Place, member: &str) -> Result<u64> {
        self.array(place, member).map(u64::from_le_bytes)
    }

    fn f64(&mut self, place: Place, member: &str) -> Result<f64> {
        self.array(place, member).map(f64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self, place: Place, member: &str) -> Result<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64(place, member)?;
        }
        Ok(values)
    }

    /// Reads a text that ends in a zero byte.
    fn text(&mut self, place: Place, member: &str) -> Result<String> {
        let end = self.rest.iter().position(|byte| *byte == 0).ok_or_else(|| self.ended(place, member))?;
        let (text, rest) = self.rest.split_at(end);
        self.rest = &rest[1..];
        Ok(decoded(text))
    }

    /// Skips a list; returns its length.
    fn skip_list(&mut self, place: Place, member: &str, size: usize) -> Result<u64> {
        let count = self.u64(place, member)?;
        let bytes = usize::try_from(count).ok().and_then(|count| count.checked_mul(size));
        let Some((_, rest)) = bytes.and_then(|bytes| self.rest.split_at_checked(bytes)) else {
            let what =
                format!("announces {count} entries, but only {} bytes follow: copy the file again", self.rest.len());
            return Err(place.error(self.file, member, what));
        };
        self.rest = rest;
        Ok(count)
    }
}

pub(super) fn cameras(file: &Path, bytes: &[u8]) -> Result<Vec<CameraEntry>> {
    let mut cursor = Cursor { file, rest: bytes };
    let count = cursor.count("cameras", LEAST_CAMERA)?;
    let mut cameras = Vec::with_capacity(count);
    for index in 0..count {
        let place = Place::Item("cameras", index);
        let id = cursor.u32(place, "camera_id")?;
        let model = cursor.array(place, "model").map(i32::from_le_bytes)?;
        let model = models::by_id(model);
        let size = [cursor.u64(place, "width")?, cursor.u64(place, "height")?];
        let camera = match model {
            Ok(model) => {
                let params = models::params(model).map(|name| cursor.f64(place, name)).collect::<Result<Vec<f64>>>()?;
                models::camera(model, size, &params).map_err(|(member, what)| place.error(file, member, what))
            }
            Err((Some(count), what)) => {
                (0..count).try_for_each(|_| cursor.f64(place, "params").map(drop))?;
                Err(place.error(file, "model", what))
            }
            // The next camera starts after an unknown number of parameters.
            Err((None, what)) => return Err(place.error(file, "model", what)),
        };
        cameras.push(CameraEntry { place, id, camera });
    }
    cursor.end("cameras", count as u64)?;
    Ok(cameras)
}

pub(super) fn images(file: &Path, bytes: &[u8]) -> Result<Vec<ImageEntry>> {
    let mut cursor = Cursor { file, rest: bytes };
    let count = cursor.count("images", LEAST_IMAGE)?;
    let mut images = Vec::with_capacity(count);
    for index in 0..count {
        let place = Place::Item("images", index);
        let id = cursor.u32(place, "image_id")?;
        let (q, t) = (cursor.f64s(place, "qvec")?, cursor.f64s(place, "tvec")?);
        let camera = cursor.u32(place, "camera_id")?;
        let name = cursor.text(place, "name")?;
        cursor.skip_list(place, "points2D", OBSERVATION)?;
        images.push(ImageEntry::new(file, place, id, q, t, camera, &name)?);
    }
    cursor.end("images", count as u64)?;
    Ok(images)
}

/// Reads the points up to the first that is not whole.
pub(super) fn points(file: &Path, bytes: &[u8]) -> Points {
    let Some((head, rest)) = bytes.split_first_chunk() else {
        return Points::unreadable("ends before the number of points: copy it again");
    };
    let (mut cursor, mut points) = (Cursor { file, rest }, Points::of(u64::from_le_bytes(*head)));
    for index in 0..usize::try_from(points.total).unwrap_or(usize::MAX) {
        let place = Place::Item("points3D", index);
        match point(&mut cursor, place) {
            Ok(point) => _ = points.push(point, || place.name()),
            Err(error) => {
                points.end(reason(error));
                return points;
            }
        }
    }
    if let Err(error) = cursor.end("points3D", points.total) {
        points.follow(reason(error));
    }
    points
}

fn point(cursor: &mut Cursor<'_>, place: Place) -> Result<Point> {
    let mut float = |member: &str| cursor.array(place, member).map(f64::from_le_bytes);
    float("point3D_id")?;
    let position = DVec3::new(float("xyz")?, float("xyz")?, float("xyz")?);
    let color = cursor.array(place, "rgb")?;
    let error = cursor.array(place, "error").map(f64::from_le_bytes)?;
    let views = cursor.skip_list(place, "track", TRACK_ELEMENT)?;
    Ok(Point { position, color, error, views: u32::try_from(views).unwrap_or(u32::MAX) })
}

pub(super) fn encode(table: &Table<'_>) -> [Vec<u8>; 3] {
    let (mut cameras, mut images, mut points) = (vec![], vec![], vec![]);
    let numbers = |out: &mut Vec<u8>, values: &[f64]| values.iter().for_each(|x| out.extend(x.to_le_bytes()));
    cameras.extend((table.cameras.len() as u64).to_le_bytes());
    for camera in &table.cameras {
        cameras.extend(camera.id.to_le_bytes());
        cameras.extend(camera.model.id.to_le_bytes());
        camera.size.iter().for_each(|side| cameras.extend(side.to_le_bytes()));
        numbers(&mut cameras, &camera.params);
    }
    images.extend((table.images.len() as u64).to_le_bytes());
    for image in &table.images {
        images.extend(image.id.to_le_bytes());
        numbers(&mut images, &image.q);
        numbers(&mut images, &image.t);
        images.extend(image.camera.to_le_bytes());
        images.extend(image.name.as_bytes());
        // The terminator of the name, and a count of 0 observations.
        images.push(0);
        images.extend(0_u64.to_le_bytes());
    }
    points.extend((table.points.len() as u64).to_le_bytes());
    for (id, point) in (1_u64..).zip(table.points) {
        points.extend(id.to_le_bytes());
        numbers(&mut points, &point.position.to_array());
        points.extend(point.color);
        numbers(&mut points, &[point.error]);
        // An empty track.
        points.extend(0_u64.to_le_bytes());
    }
    [cameras, images, points]
}
