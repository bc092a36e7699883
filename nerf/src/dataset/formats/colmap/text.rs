//! COLMAP's `.txt` files: an entry a line, and comments that start with `#`.

use super::super::encodings::decoded;
use super::super::limits::start;
use super::super::paths::any_extension;
use super::super::points::{Points, reason};
use super::entries::{CameraEntry, ImageEntry, Place};
use super::models;
use super::table::Table;
use crate::dataset::capture::Point;
use crate::error::{Error, Result};
use glam::DVec3;
use std::fmt::Write;
use std::path::Path;
use std::str::FromStr;

/// The least float whose neighbours are not all integers apart by 1.
const EXACT: f64 = 9_007_199_254_740_992.0;

/// The unread part of a line.
struct Words<'a> {
    file: &'a Path,
    place: Place,
    rest: &'a str,
}

impl<'a> Words<'a> {
    fn error(&self, member: &str, what: impl ToString) -> Error {
        self.place.error(self.file, member, what)
    }

    fn word(&mut self, member: &str) -> Result<&'a str> {
        let rest = self.rest.trim_start();
        let (word, rest) = rest.split_at(rest.find(char::is_whitespace).unwrap_or(rest.len()));
        self.rest = rest;
        if word.is_empty() { Err(self.error(member, "is missing")) } else { Ok(word) }
    }

    /// Reads an integer, which scripts write as `640.0` or `6.4e+02`, too.
    fn integer<T: FromStr>(&mut self, member: &str) -> Result<T> {
        let word = self.word(member)?;
        let whole = || word.parse::<f64>().ok().filter(|x| x.fract() == 0.0 && x.abs() < EXACT);
        word.parse().ok().or_else(|| whole()?.to_string().parse().ok()).ok_or_else(|| {
            let most = 8 * size_of::<T>();
            self.error(member, format!("must be an integer of {most} bits, is `{}`", start(word)))
        })
    }

    /// Reads a number, which may be infinite or NaN.
    fn f64(&mut self, member: &str) -> Result<f64> {
        let word = self.word(member)?;
        let bad = || self.error(member, format!("must be a finite number, is `{}`", start(word)));
        word.parse().ok().or_else(|| nan(word)).ok_or_else(bad)
    }

    fn f64s<const N: usize>(&mut self, member: &str) -> Result<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64(member)?;
        }
        Ok(values)
    }

    fn number(&mut self, member: &str) -> Result<f64> {
        match self.f64(member)? {
            value if value.is_finite() => Ok(value),
            value => Err(self.error(member, format!("must be a finite number, is {value}"))),
        }
    }
}

/// NaN, for a word that Windows writes for a number that is not finite, such as `-nan(ind)` and `1.#QNAN`.
fn nan(word: &str) -> Option<f64> {
    let word = word.trim_start_matches(['-', '+']);
    (word.starts_with("nan(") || word.starts_with("1.#")).then_some(f64::NAN)
}

/// The lines of a file, numbered from 1.
fn lines<'a>(file: &'a Path, text: &'a str) -> impl Iterator<Item = Words<'a>> {
    (1..).zip(text.lines()).map(move |(line, rest)| Words { file, place: Place::Line(line), rest: rest.trim() })
}

/// Returns true unless a line is empty or a comment.
fn speaks(line: &Words<'_>) -> bool {
    !line.rest.is_empty() && !line.rest.starts_with('#')
}

pub(super) fn cameras(file: &Path, bytes: &[u8]) -> Result<Vec<CameraEntry>> {
    let camera = |mut line: Words<'_>| {
        let id = line.integer("CAMERA_ID")?;
        let model = models::by_name(line.word("MODEL")?);
        let size = [line.integer("WIDTH")?, line.integer("HEIGHT")?];
        let model = match model {
            Ok(model) => model,
            Err(what) => return Ok(CameraEntry { place: line.place, id, camera: Err(line.error("MODEL", what)) }),
        };
        let params = models::params(model).map(|name| line.f64(name)).collect::<Result<Vec<f64>>>()?;
        if !line.rest.trim().is_empty() {
            return Err(line.error("PARAMS", format!("{} takes {}: remove the others", model.name, params.len())));
        }
        let camera = models::camera(model, size, &params).map_err(|(member, what)| line.error(member, what));
        Ok(CameraEntry { place: line.place, id, camera })
    };
    lines(file, &decoded(bytes)).filter(speaks).map(camera).collect()
}

pub(super) fn images(file: &Path, bytes: &[u8]) -> Result<Vec<ImageEntry>> {
    let text = decoded(bytes);
    let mut lines = lines(file, &text).peekable();
    let mut images = vec![];
    while let Some(mut line) = lines.next() {
        if !speaks(&line) {
            continue;
        }
        let id = line.integer("IMAGE_ID")?;
        let (q, t) = (line.f64s("QVEC")?, line.f64s("TVEC")?);
        let camera = line.integer("CAMERA_ID")?;
        // The name is the rest of the line, since it may contain spaces.
        images.push(ImageEntry::new(file, line.place, id, q, t, camera, line.rest.trim())?);
        while lines.next_if(|line| line.rest.trim_start().starts_with('#')).is_some() {}
        // The next line holds the image's observations, also if it is empty. Some programs leave empty lines out.
        if let Some(line) = lines.next_if(|line| !is_image(line.rest)) {
            observations(&line)?;
        }
    }
    Ok(images)
}

/// Returns true for the line of an image. It is no line of observations, as it ends in the name of an image file.
fn is_image(line: &str) -> bool {
    let words: Vec<&str> = line.split_whitespace().collect();
    let is_number = |word: &&str| word.parse::<f64>().is_ok() || nan(word).is_some();
    words.len() >= 10 && words[..9].iter().all(is_number) && any_extension(line).is_some()
}

/// Checks that a line holds observations, so that no image is lost silently.
fn observations(line: &Words<'_>) -> Result<()> {
    let (mut count, mut last) = (0, "-1");
    for word in line.rest.split_whitespace() {
        (count, last) = (count + 1, word);
    }
    let is_id = last.parse::<f64>().is_ok_and(|id| id.fract() == 0.0);
    if count % 3 != 0 || !is_id {
        let what = "must be triples X Y POINT3D_ID of the image in the line before, or empty";
        return Err(line.error("POINTS2D", what));
    }
    Ok(())
}

/// Reads the points of all valid lines.
pub(super) fn points(file: &Path, bytes: &[u8]) -> Points {
    let text = decoded(bytes);
    let mut points = Points::default();
    for line in lines(file, &text).filter(speaks) {
        let place = line.place;
        points.total += 1;
        match point(line) {
            Ok(point) => _ = points.push(point, || place.name()),
            Err(error) => points.leave_out(|| reason(error)),
        }
    }
    points
}

fn point(mut line: Words<'_>) -> Result<Point> {
    line.integer::<u64>("POINT3D_ID")?;
    let position = DVec3::from_array([line.number("X")?, line.number("Y")?, line.number("Z")?]);
    let color = [line.integer("R")?, line.integer("G")?, line.integer("B")?];
    let error = line.number("ERROR")?;
    let track = line.rest.split_whitespace().count();
    if !track.is_multiple_of(2) {
        return Err(line.error("TRACK", "must be pairs IMAGE_ID POINT2D_IDX"));
    }
    Ok(Point { position, color, error, views: u32::try_from(track / 2).unwrap_or(u32::MAX) })
}

pub(super) fn encode(table: &Table<'_>) -> [Vec<u8>; 3] {
    let mut cameras = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n".to_owned();
    let mut images =
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n".to_owned();
    let mut points = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n".to_owned();
    let numbers = |out: &mut String, values: &[f64]| {
        for value in values {
            // `{:?}` prints the fewest digits that keep every bit. Writing to a string cannot fail.
            let _ = write!(out, " {value:?}");
        }
    };
    for camera in &table.cameras {
        let _ = write!(cameras, "{} {} {} {}", camera.id, camera.model.name, camera.size[0], camera.size[1]);
        numbers(&mut cameras, &camera.params);
        cameras.push('\n');
    }
    for image in &table.images {
        let _ = write!(images, "{}", image.id);
        numbers(&mut images, &image.q);
        numbers(&mut images, &image.t);
        // The empty line holds the observations of the image.
        let _ = write!(images, " {} {}\n\n", image.camera, image.name);
    }
    for (id, point) in (1_u64..).zip(table.points) {
        let [r, g, b] = point.color;
        let _ = write!(points, "{id}");
        numbers(&mut points, &point.position.to_array());
        let _ = write!(points, " {r} {g} {b}");
        numbers(&mut points, &[point.error]);
        points.push('\n');
    }
    [cameras, images, points].map(String::into_bytes)
}
