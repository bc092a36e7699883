//! Focal lengths, principal points and sizes: of a whole file, or of a frame of it.

use super::json::{Object, number, shown};
use super::layers::Layers;
use super::lens;
use super::matrix::entries;
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::error::Result;
use glam::DAffine3;
use serde_json::{Map, Value};
use std::f64::consts::PI;

/// Unsupported camera fields of instant-ngp and nerfstudio. Ignoring them silently would spoil every image.
const NOT_READ: [&str; 14] = [
    "x_fov",
    "y_fov",
    "distortion_params",
    "fisheye_crop_radius",
    "ftheta_p0",
    "ftheta_p1",
    "ftheta_p2",
    "ftheta_p3",
    "ftheta_p4",
    "latlong",
    "equirectangular",
    "rolling_shutter",
    "transform_matrix_start",
    "transform_matrix_end",
];

/// Names of a 3x3 intrinsic matrix: focal lengths on the diagonal, the principal point in the last column.
const MATRICES: [&str; 5] = ["K", "intrinsics", "camera_intrinsics", "intrinsic_matrix", "camera_matrix"];

/// The least focal length of such a matrix, as a share of the image's side: some matrices are in units of the side.
const SHORTEST: f64 = 0.05;

/// The largest difference of two values of a length, in pixels.
const SAME: f64 = 0.01;

/// Ranges of a camera's lengths in pixels.
const FOCAL: std::ops::RangeInclusive<f64> = 1e-3..=1e9;
const CENTRE: f64 = 1e9;
const SIDE: f64 = 1048576.0;

/// The relative difference of two focal lengths that is no rounding of a field of view.
const DIFFERS: f64 = 0.01;

/// The relative tolerance of a panorama's fields.
const PANORAMA: f64 = 0.01;

/// Checks that an object has no unsupported camera field, unless its value has no effect.
///
/// # Errors
/// If it has one.
pub(super) fn check_known(object: &Object<'_>) -> Result<()> {
    fn nothing(value: &Value) -> bool {
        match value {
            Value::Bool(flag) => !flag,
            Value::Number(value) => value.as_f64() == Some(0.0),
            Value::Array(values) => values.iter().all(nothing),
            _ => false,
        }
    }
    let named = NOT_READ.into_iter().find_map(|name| Some((name, object.get(name).filter(|value| !nothing(value))?)));
    let Some((name, value)) = named else { return Ok(()) };
    let what = match name {
        "x_fov" | "y_fov" => "write the field of view in radians as camera_angle_x and camera_angle_y",
        "latlong" | "equirectangular" => "write camera_model EQUIRECTANGULAR for such panoramas",
        "distortion_params" => "write the coefficients by name (k1, k2, p1, p2) with their camera_model",
        "fisheye_crop_radius" => "write masks of the pixels to use, as mask_path",
        "rolling_shutter" | "transform_matrix_start" | "transform_matrix_end" => {
            "rolling shutter is not supported; remove it to ignore it"
        }
        _ => "such cameras are not supported; remove it to ignore it",
    };
    Err(object.error(name, format!("is {}, which raygrad does not read: {what}", shown(value))))
}

impl Layers<'_, '_> {
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
        let [x, y] = self.centre()?;
        let centre = [x.unwrap_or(middle[0]), y.unwrap_or(middle[1])];
        let focal = self.focal([width, height], angle_y)?;
        Ok(Camera { width, height, focal, centre, lens, pose })
    }

    /// The principal point, if the frame or the file gives it.
    pub(super) fn centre(&self) -> Result<[Option<f64>; 2]> {
        let axis = |i: usize, name: &str| {
            let of = |object: &Object<'_>| {
                let of_matrix = matrix_of(object)?.map(|matrix| matrix[2 + i]);
                agreeing(object, name, object.number(name)?, of_matrix)
            };
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
        match (given, top) {
            ([Some(x), Some(y)], _) => Ok([x, y]),
            ([None, None], _) => {
                let what = "is missing: give the horizontal field of view in radians, or focal lengths in pixels as fl_x and fl_y";
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
        contradiction(self.top, own.unwrap_or(size), angle_y)
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

/// The focal lengths that one object gives: `fl_x` and `fl_y`, or else the angles.
fn focal_of(object: &Object<'_>, size: [usize; 2], angle_y: bool) -> Result<[Option<f64>; 2]> {
    let matrix = matrix_of(object)?;
    let axis = |length: &str, angle: &str, side: usize| {
        let of_matrix = matrix.map(|matrix| matrix[usize::from(length == "fl_y")]);
        let own = object.number(length)?;
        if let Some(f) = agreeing(object, length, own, of_matrix)? {
            if own.is_none() && f < SHORTEST * side as f64 {
                let what =
                    format!("is {f} in the intrinsic matrix, which must be in pixels, of an image {side} wide or high");
                return Err(object.error(length, what));
            }
            if !FOCAL.contains(&f) {
                return Err(object.error(length, format!("must be a focal length in pixels, 1e-3 to 1e9, is {f}")));
            }
            return Ok(Some(f));
        }
        if angle == "camera_angle_y" && !angle_y {
            return Ok(None);
        }
        let Some(a) = object.number(angle)? else { return Ok(None) };
        let f = focal_length(side, a);
        if !(a > 0.0 && a < PI) || (side > 0 && !FOCAL.contains(&f)) {
            return Err(object.error(angle, format!("must be an angle in radians between 0 and pi, is {a}")));
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

/// The focal lengths and the principal point of an object's intrinsic matrix, if it has one.
fn matrix_of(object: &Object<'_>) -> Result<Option<[f64; 4]>> {
    let Some((name, value)) =
        MATRICES.iter().find_map(|name| Some((name, object.get(name).filter(|value| value.is_array())?)))
    else {
        return Ok(None);
    };
    // Lists of other shapes belong to other programs.
    let Some(entries) = entries(value, 3).filter(|entries| entries.len() == 9) else { return Ok(None) };
    let m: Option<Vec<f64>> = entries.into_iter().map(number).collect();
    let m: Option<[f64; 9]> = m.filter(|m| m.iter().all(|x| x.is_finite())).and_then(|m| m.try_into().ok());
    let Some(m) = m else {
        return Err(object.error(name, format!("must be a 3x3 intrinsic matrix, is {}", shown(value))));
    };
    // Some programs store columns. Only the principal point can stand outside of the diagonal.
    let ([fx, fy], skew, rest) = ([m[0], m[4]], [m[1], m[3]], m[8]);
    let [right, below] = [[m[2], m[5]], [m[6], m[7]]];
    let (centre, other) = if right == [0.0; 2] { (below, right) } else { (right, below) };
    if skew != [0.0; 2] || other != [0.0; 2] || rest != 1.0 {
        let what = "must have the rows fx 0 cx, 0 fy cy and 0 0 1";
        return Err(object.error(name, format!("{what}, is {}", shown(value))));
    }
    Ok(Some([fx, fy, centre[0], centre[1]]))
}

/// A length that is given by its own member, by the intrinsic matrix, or equally by both.
fn agreeing(object: &Object<'_>, name: &str, own: Option<f64>, of_matrix: Option<f64>) -> Result<Option<f64>> {
    match (own, of_matrix) {
        (Some(own), Some(other)) if !((own - other).abs() <= SAME) => {
            Err(object.error(name, format!("is {own}, but the intrinsic matrix has {other}: remove one of them")))
        }
        (own, of_matrix) => Ok(own.or(of_matrix)),
    }
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
