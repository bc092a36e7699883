//! Focal lengths, principal points and sizes: of a whole file, or of a frame of it.

use super::json::{Object, number, shown};
use super::layers::Layers;
use super::lens;
use super::limits::{unfit_centre, unfit_focal};
use super::other_names::{MATRICES, OtherNames, agreeing, matrix_of, unread_matrix, unusable};
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::error::Result;
use glam::DAffine3;
use serde_json::{Map, Value};
use std::f64::consts::PI;

/// Names of a focal length that may be in millimetres, and of a field of view that may be in degrees.
const UNCLEAR: [&str; 8] = ["focal_length", "focal", "fov", "fovx", "fov_x", "FovX", "hfov", "field_of_view"];

/// The least focal length of other names than instant-ngp's, as a share of the image's side: some are in units of the
/// side.
const SHORTEST: f64 = 0.05;

/// Limits of a camera's lengths in pixels.
const CENTRE: f64 = 1e9;
const SIDE: f64 = 1048576.0;

/// A principal point is that of the image on its side if it is nearer to that image's middle than this share of its
/// distance from the own middle.
const TURNED: f64 = 0.1;
/// The least ratio of the sides of an image that has a turned shape.
const OBLONG: f64 = 1.1;

/// The relative distance of a principal point from the middle of a larger image that is that image's.
const LARGER: f64 = 0.02;
/// The longest side, in pixels, of an image whose principal point may be within one pixel of its corner.
const SMALLEST: usize = 16;

/// The relative difference of two focal lengths that is no rounding of a field of view.
const DIFFERS: f64 = 0.01;

/// The relative tolerance of a panorama's fields.
const PANORAMA: f64 = 0.01;

impl Layers<'_, '_> {
    /// Checks that the frame's own principal point is finite, and its focal lengths or fields of view above 0, as far as
    /// they count. Those of images without a pose are not, in some files.
    ///
    /// # Errors
    /// If one is not.
    pub(super) fn check_lengths(&self, angle_y: bool) -> Result<()> {
        let frame = self.frame;
        for name in ["cx", "cy"] {
            if frame.get(name).and_then(number).is_some_and(|x| !x.is_finite()) {
                frame.number(name)?;
            }
        }
        // Panoramas have no focal length.
        if lens::read(self).is_ok_and(|lens| lens == Lens::Equirectangular) {
            return Ok(());
        }
        let matrix = matrix_of(frame);
        if let Some((name, value, entries)) = &matrix
            && let Some(what) = unusable(entries)
        {
            return Err(frame.error(name, format!("{what}, is {}", shown(value))));
        }
        let has_own = ["fl_x", "fl_y"].iter().any(|name| frame.get(name).is_some());
        for [own, other, angle] in [["fl_x", "fx", "camera_angle_x"], ["fl_y", "fy", "camera_angle_y"]] {
            // The first counts, as in `focal_of`.
            let other = (!has_own).then_some(other);
            let angle = (angle_y || angle == "camera_angle_x").then_some(angle);
            let others = other.into_iter().chain(angle).filter(|_| matrix.is_none());
            let name = [own].into_iter().chain(others).find(|name| frame.get(name).is_some());
            if let Some(name) = name.filter(|name| frame.get(name).and_then(number).is_some()) {
                frame.positive(name)?;
            }
        }
        Ok(())
    }

    /// Reads a side of the image, in pixels. BlenderNeRF writes fractions, which Blender and nerfstudio drop.
    fn side(&self, name: &str) -> Result<Option<usize>> {
        match self.number(name)? {
            Some(x) if !(1.0..=SIDE).contains(&x) => {
                Err(self.error(name, format!("must be a number of pixels, 1 to {SIDE}, is {x}")))
            }
            // A product such as 1000 * 0.7 may lie just below an integer.
            other => Ok(other.map(|x| (x + 1e-6).floor() as usize)),
        }
    }

    /// The width and height, if the file gives them.
    fn size(&self) -> Result<Option<[usize; 2]>> {
        match (self.side("w")?, self.side("h")?) {
            (Some(w), Some(h)) => Ok(Some([w, h])),
            (None, None) => Ok(None),
            (Some(_), None) => Err(self.of("w").error("h", "is missing beside `w`")),
            (None, Some(_)) => Err(self.of("h").error("w", "is missing beside `h`")),
        }
    }

    /// The camera at `pose`.
    ///
    /// `header` reads the image size if the file gives none, and returns zeros without an image. `angle_y` is true if
    /// `camera_angle_y` is that of the image; Blender's is that of its sensor.
    pub(super) fn camera(
        &self,
        pose: DAffine3,
        header: impl FnOnce() -> Result<[usize; 2]>,
        angle_y: bool,
    ) -> Result<Camera> {
        let [width, height] = self.size()?.map_or_else(header, Ok)?;
        let lens = lens::read(self)?;
        let middle = [0.5 * width as f64, 0.5 * height as f64];
        if lens == Lens::Equirectangular {
            let focal = self.panorama([width, height])?;
            return Ok(Camera { width, height, focal, centre: middle, lens, pose });
        }
        let given = self.centre()?;
        for (i, side) in [width, height].into_iter().enumerate().filter(|(_, side)| *side > 0) {
            if let Some(what) = given[i].and_then(|x| unfit_centre(x, side)) {
                return Err(self.error(["cx", "cy"][i], what));
            }
        }
        let centre = [0, 1].map(|i| given[i].unwrap_or(middle[i]));
        let from = |[x, y]: [f64; 2]| (centre[0] - x).hypot(centre[1] - y);
        let is_oblong = middle[0].max(middle[1]) > OBLONG * middle[0].min(middle[1]);
        // A frame's own crop may lie anywhere.
        let is_shared = given != [None; 2] && self.own_centre()? == [None; 2];
        if is_oblong && is_shared && from([middle[1], middle[0]]) < TURNED * from(middle) {
            let swapped = if self.size()?.is_some() { ", or swap `w` and `h`" } else { "" };
            let name = MATRICES.into_iter().find(|name| self.top.get(name).is_some());
            let what = format!(
                "gives the principal point {}, {}, the middle of {height}x{width} pixels, but {} has {width}x{height}: \
                 give the frame's own `cx` and `cy`{swapped}",
                centre[0], centre[1], self.frame.path
            );
            return Err(self.top.error(name.filter(|_| self.top.get("cx").is_none()).unwrap_or("cx"), what));
        }
        let focal = self.focal([width, height], angle_y)?;
        if let ([Some(x), Some(y)], true) = (given, is_shared && width.min(height) > 0)
            && let Some(what) = other_unit([x, y], [width, height], &self.frame.path)
        {
            return Err(self.top.error("cx", what));
        }
        Ok(Camera { width, height, focal, centre, lens, pose })
    }

    /// The principal point that the frame gives.
    fn own_centre(&self) -> Result<[Option<f64>; 2]> {
        Layers { top: self.frame, frame: self.frame }.centre()
    }

    /// The principal point, if the frame or the file gives it.
    pub(super) fn centre(&self) -> Result<[Option<f64>; 2]> {
        let axis = |i: usize, name: &str| {
            let of = |object: &Object<'_>| agreeing(object, name, &OtherNames::of(object)?, 2 + i);
            let value = of(self.frame)?.map_or_else(|| of(self.top), |own| Ok(Some(own)))?;
            match value.filter(|value| value.abs() > CENTRE) {
                Some(value) => Err(self.error(name, format!("must be a position in pixels, is {value}"))),
                None => Ok(value),
            }
        };
        Ok([axis(0, "cx")?, axis(1, "cy")?])
    }

    /// The focal lengths of the frame or, if it has none, of the file. A single one counts for both axes, as in
    /// instant-ngp.
    fn focal(&self, size: [usize; 2], angle_y: bool) -> Result<[f64; 2]> {
        let [top, frame] = [focal_of(self.top, size, angle_y)?, focal_of(self.frame, size, angle_y)?];
        let given = if frame == [None; 2] { top } else { frame };
        // The file's focal length would take the place of that of the frame.
        if frame == [None; 2]
            && top != [None; 2]
            && let Some((name, value)) = unread_matrix(self.frame)
        {
            let what = "which raygrad does not read: write a 3x3 matrix, fx, fy, cx and cy, or remove it to use the \
                        file's focal length";
            return Err(self.frame.error(name, format!("is {}, {what}", shown(value))));
        }
        match (given, top) {
            ([Some(x), Some(y)], _) => Ok([x, y]),
            ([None, None], _) => {
                let unread = [self.frame, self.top].into_iter().find_map(|object| {
                    let mut names = MATRICES.into_iter().chain(UNCLEAR);
                    names.find_map(|name| Some((object.field(name), object.get(name)?)))
                });
                let unread =
                    unread.map(|(field, value)| format!("; raygrad does not read `{field}`, {}", shown(value)));
                let what = format!(
                    "is missing: give the horizontal field of view in radians, or focal lengths in pixels as fl_x and \
                     fl_y{}",
                    unread.unwrap_or_default()
                );
                Err(self.top.error("camera_angle_x", what))
            }
            // Programs disagree on the other one: the file's, or the frame's for both axes.
            ([x, _], [Some(a), Some(b)]) if a != b => {
                let [given, missing] = if x.is_some() { ["fl_x", "fl_y"] } else { ["fl_y", "fl_x"] };
                let what = format!(
                    "is missing beside the frame's `{given}`: give both, since the file's focal lengths differ, {a} and {b}"
                );
                Err(self.frame.error(missing, what))
            }
            ([Some(f), None] | [None, Some(f)], _) => Ok([f, f]),
        }
    }

    /// True if the frame has the file's focal length, which is of no size, and does not describe a crop.
    ///
    /// # Errors
    /// If that focal length is of another size than the frame's own.
    pub(super) fn is_focal_alone(&self, camera: &Camera, angle_y: bool) -> Result<bool> {
        let size = [camera.width, camera.height];
        if camera.lens == Lens::Equirectangular || focal_of(self.frame, size, angle_y)? != [None; 2] {
            return Ok(false);
        }
        let [of_file, own] = [self.top, self.frame].map(|object| Layers { top: object, frame: object }.size());
        let (of_file, own) = (of_file?, own?);
        if own.is_some() && self.own_centre()? != [None; 2] {
            return Ok(false);
        }
        let (Some([w, h]), Some(own)) = (of_file, own) else { return Ok(of_file.is_none()) };
        // Images may stand on their side. An angle is that of any size.
        let is_same = own == [w, h] || own == [h, w];
        if is_same || focal_of(self.top, [w, h], angle_y)? != focal_of(self.top, own, angle_y)? {
            return Ok(false);
        }
        let what = format!(
            "is {}, but the file's focal length is of {w}x{h} pixels: give the frame its own `fl_x` and `fl_y` if it is \
             scaled, or its own `cx` and `cy` if it is cropped",
            own[0]
        );
        Err(self.frame.error("w", what))
    }

    /// A note on a field of view that contradicts the focal length of `camera`, which counts, as in other programs.
    /// Those of fisheye lenses have several conventions.
    pub(super) fn contradiction(&self, camera: &Camera, angle_y: bool) -> Option<String> {
        if !matches!(camera.lens, Lens::Pinhole | Lens::Brown { .. }) || camera.width == 0 {
            return None;
        }
        let size = [camera.width, camera.height];
        if focal_of(self.frame, size, angle_y).ok()? != [None; 2] {
            return contradiction(self.frame, size, angle_y);
        }
        // The file's lengths belong to its own size.
        let own = Layers { top: self.top, frame: self.top }.size().ok()?;
        contradiction(self.top, own.unwrap_or(size), angle_y).or_else(|| {
            let unclear = UNCLEAR.into_iter().find_map(|name| Some((self.frame.field(name), self.frame.get(name)?)));
            let of_file = || unread_matrix(self.top).map(|(name, value)| (self.top.field(name), value));
            let (field, value) = unclear.or_else(of_file)?;
            Some(format!("`{field}` is {}, which raygrad does not read: used the file's focal length", shown(value)))
        })
    }

    /// The focal lengths of a panorama of all directions, in pixels per radian.
    fn panorama(&self, [width, height]: [usize; 2]) -> Result<[f64; 2]> {
        let [w, h] = [width as f64, height as f64];
        let focal = [w / (2.0 * PI), h / PI];
        // nerfstudio's are in pixels per half turn.
        let rules: [(&str, [f64; 2], f64); 6] = [
            ("fl_x", [focal[0], 0.5 * w], 0.0),
            ("fl_y", [focal[1], h], 0.0),
            ("cx", [0.5 * w; 2], 0.5),
            ("cy", [0.5 * h; 2], 0.5),
            ("camera_angle_x", [2.0 * PI; 2], 0.0),
            ("camera_angle_y", [PI; 2], 0.0),
        ];
        for (name, allowed, slack) in rules {
            let Some(value) = self.number(name)? else { continue };
            if width > 0 && !allowed.iter().any(|x| (value - x).abs() <= f64::max(PANORAMA * x, slack)) {
                let what = format!("must be {:.3} or absent for camera_model EQUIRECTANGULAR, is {value}", allowed[1]);
                return Err(self.error(name, what));
            }
        }
        Ok(focal)
    }
}

/// What is wrong with a principal point in units of the image's sides, or in pixels of an image that is a few times
/// larger.
fn other_unit(centre: [f64; 2], sides: [usize; 2], frame: &str) -> Option<String> {
    let [width, height] = sides;
    if sides.iter().all(|side| *side > SMALLEST) && centre.iter().all(|x| (0.0..=1.0).contains(x) && *x > 0.0) {
        return Some(format!(
            "and `cy` are {} and {}, in units of the image's sides: multiply them by {width} and {height}",
            centre[0], centre[1]
        ));
    }
    let times = [0, 1].map(|i| 2.0 * centre[i] / sides[i] as f64);
    let factor = times[0].round();
    let is_middle = times.iter().all(|times| (times / factor - 1.0).abs() < LARGER);
    (factor >= 2.0 && is_middle).then(|| {
        let [large, high] = sides.map(|side| side as f64 * factor);
        format!(
            "and `cy` are the middle of {large}x{high} pixels, but {frame} has {width}x{height}: give `w` and `h` of the \
             larger image, or each frame's own `cx` and `cy` if the images are crops"
        )
    })
}

/// The focal lengths that one object gives: `fl_x` and `fl_y`, or else the angles.
fn focal_of(object: &Object<'_>, size: [usize; 2], angle_y: bool) -> Result<[Option<f64>; 2]> {
    let others = OtherNames::of(object)?;
    let axis = |length: &str, angle: &str, side: usize| {
        if let Some(f) = agreeing(object, length, &others, usize::from(length == "fl_y"))? {
            if object.get(length).is_none() && f < SHORTEST * side as f64 {
                let what = format!(
                    "is {f} in `{}`, which must be in pixels, of an image {side} wide or high",
                    object.field(others.name)
                );
                return Err(object.error(length, what));
            }
            // Lengths of these names may be in millimetres.
            let is_other = ["fx", "fy"].contains(&others.name) && side > 0;
            let angle_of = object.get(angle).and_then(number).filter(|_| is_other);
            if let Some(a) = angle_of.filter(|_| angle_y || angle == "camera_angle_x")
                && (f - focal_length(side, a)).abs() > DIFFERS * f
            {
                let other = object.field(others.name);
                let what = format!("is {a}, but `{other}` has a focal length of {f} pixels: remove the wrong one");
                return Err(object.error(angle, what));
            }
            return unfit_focal(f).map_or(Ok(Some(f)), |what| Err(object.error(length, what)));
        }
        if angle == "camera_angle_y" && !angle_y {
            return Ok(None);
        }
        let Some(a) = object.number(angle)? else { return Ok(None) };
        let f = focal_length(side, a);
        if !(a > 0.0 && a < PI) || (side > 0 && unfit_focal(f).is_some()) {
            let advice = match a {
                _ if a > 2.001 * PI => ": multiply degrees by pi / 180",
                _ if a >= PI => ": give the `camera_model` and the focal length of a wider lens",
                _ => "",
            };
            return Err(object.error(angle, format!("must be an angle in radians between 0 and pi, is {a}{advice}")));
        }
        Ok(Some(f))
    };
    Ok([axis("fl_x", "camera_angle_x", size[0])?, axis("fl_y", "camera_angle_y", size[1])?])
}

/// A note on a field of view that contradicts the focal length of the same object.
fn contradiction(object: &Object<'_>, size: [usize; 2], angle_y: bool) -> Option<String> {
    let given = focal_of(object, size, angle_y).ok()?;
    ["camera_angle_x", "camera_angle_y"].into_iter().zip(given).zip(size).find_map(|((angle, focal), side)| {
        let is_of_image = angle_y || angle == "camera_angle_x";
        let (a, f) = (object.get(angle).and_then(number).filter(|_| is_of_image)?, focal?);
        let own = 2.0 * (0.5 * side as f64 / f).atan();
        let differs = (f - focal_length(side, a)).abs() > DIFFERS * f;
        let field = object.field(angle);
        let what =
            format!("`{field}` is {a}, but the focal length of {f} pixels gives {own:.4}: used the focal length");
        differs.then_some(what)
    })
}

/// The focal length in pixels of a field of view across `side` pixels.
fn focal_length(side: usize, angle: f64) -> f64 {
    0.5 * side as f64 / (0.5 * angle).tan()
}

/// Writes everything of a camera except its pose, for the model `model`.
pub(super) fn write(camera: &Camera, model: &str, out: &mut Map<String, Value>) {
    let Camera { width, height, focal, centre, lens, .. } = camera;
    // nerfstudio's focal lengths of a panorama are in pixels per half turn.
    let focal = match lens {
        Lens::Equirectangular => [0.5 * *width as f64, *height as f64],
        _ => *focal,
    };
    let numbers = [("fl_x", focal[0]), ("fl_y", focal[1]), ("cx", centre[0]), ("cy", centre[1])];
    out.extend(numbers.map(|(name, value)| (name.to_owned(), value.into())));
    out.extend([("w", width), ("h", height)].map(|(name, &side)| (name.to_owned(), side.into())));
    out.insert("camera_model".to_owned(), model.into());
    lens::write(lens, model, out);
}

#[cfg(test)]
mod tests;
