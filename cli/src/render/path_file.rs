//! Camera path files: nerfstudio's `camera_path.json`, and those of instant-ngp.
//!
//! Nerfstudio lists the camera of each frame (`camera_path`) and the key frames (`keyframes`). The key frames count
//! only without a list of frames. Poses are camera-to-world matrices, row by row. Cameras look along `-z` with `y` up,
//! and angles are vertical, in degrees. The world is that of the capture, recentred and scaled by
//! `dataparser_transforms.json`.
//!
//! Instant-ngp lists key frames of a cubic B-spline: quaternions `x y z w` and positions. Cameras look along `z` with
//! `y` down. Positions are in a unit cube. Its `x y z` are `y z x` of the capture times 0.33, plus one half. The
//! capture's `transforms.json` may set another scale and offset.

use std::path::Path as File;

use raygrad::nerf::camera::{CameraPath, Curve, Keyframe};
use raygrad::nerf::dataset::formats::rigid;
use raygrad::nerf::glam::{DAffine3, DMat3, DQuat, DVec3};
use raygrad::nerf::{Error, Result};
use serde::de::{DeserializeOwned, Error as _};
use serde::{Deserialize, Deserializer};
use serde_json::Value;

use crate::output::note;
use crate::parse::{FPS, LARGEST, read_text};

/// Most frames and key frames.
const MOST: usize = 100_000;
/// Smallest vertical angle in degrees. The largest is 180 minus this.
const SMALLEST_FOV: f64 = 0.001;
/// Default scale and offset of instant-ngp's unit cube.
const NGP: Cube = Cube { scale: 0.33, offset: [0.5; 3] };
/// Nerfstudio's default seconds between key frames.
const TRANSITION: f64 = 1.0;

/// A path in the capture's coordinates.
#[derive(Debug)]
pub struct Path {
    pub motion: Motion,
    /// Image size, if the file has one.
    pub size: Option<[usize; 2]>,
    /// Frames per second, if the file has a rate.
    pub fps: Option<f64>,
}

/// Frames or key frames.
#[derive(Debug)]
pub enum Motion {
    /// A list of all frames.
    Frames(Vec<Keyframe>),
    /// Key frames, with the total time if the file has one.
    Keys { path: CameraPath, seconds: Option<f64> },
}

/// Nerfstudio's `camera_path.json`. Fields for its viewer are ignored.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Nerfstudio {
    #[serde(deserialize_with = "side")]
    render_width: usize,
    #[serde(deserialize_with = "side")]
    render_height: usize,
    camera_type: Option<String>,
    fps: Option<f64>,
    seconds: Option<f64>,
    is_cycle: Option<bool>,
    smoothness_value: Option<f64>,
    #[serde(rename = "default_fov")]
    _default_fov: Option<f64>,
    #[serde(rename = "default_time")]
    _default_time: Option<f64>,
    default_transition_sec: Option<f64>,
    camera_path: Option<Vec<Shot>>,
    keyframes: Option<Value>,
    crop: Option<Value>,
    /// Coordinate system, which raygrad's viewer writes.
    coordinates: Option<Coordinates>,
}

#[derive(Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Coordinates {
    /// The capture's coordinates.
    Capture,
}

/// A frame.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Shot {
    camera_to_world: [f64; 16],
    fov: f64,
    #[serde(rename = "aspect")]
    _aspect: Option<f64>,
    render_time: Option<f64>,
}

/// A key frame.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NerfstudioKeyframe {
    matrix: [f64; 16],
    fov: f64,
    #[serde(rename = "aspect")]
    _aspect: Option<f64>,
    override_transition_enabled: Option<bool>,
    override_transition_sec: Option<f64>,
    render_time: Option<f64>,
    #[serde(rename = "override_time_enabled")]
    _override_time_enabled: Option<bool>,
}

/// A path of instant-ngp. Fields on playback and display are ignored.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Ngp {
    path: Vec<NgpKey>,
    #[serde(rename = "loop", default)]
    closed: bool,
    #[serde(rename = "time")]
    _time: Option<f64>,
    duration_seconds: Option<f64>,
    spline_order: Option<u32>,
}

/// A key frame.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NgpKey {
    #[serde(rename = "R")]
    rotation: [f64; 4],
    #[serde(rename = "T")]
    position: [f64; 3],
    fov: f64,
    /// Focus distance, like the next field. It matters only with an aperture, which is not supported.
    #[serde(rename = "slice")]
    _slice: Option<f64>,
    #[serde(rename = "scale")]
    _scale: Option<f64>,
    #[serde(alias = "dof", default)]
    aperture_size: f64,
    #[serde(default)]
    glow_mode: u32,
    #[serde(rename = "glow_y_cutoff")]
    _glow_y_cutoff: Option<f64>,
    timestamp: Option<f64>,
}

/// Nerfstudio's `dataparser_transforms.json`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Dataparser {
    transform: [[f64; 4]; 3],
    scale: f64,
}

/// The unit cube of instant-ngp, from `transforms.json`.
#[derive(Deserialize)]
struct Cube {
    scale: f64,
    offset: [f64; 3],
}

/// Reads a path in the capture's coordinates, with the `transform` file. `applied` returns the transform that the
/// capture's file states as already applied. Nerfstudio's transform includes it.
pub fn read(file: &File, transform: Option<&File>, applied: impl FnOnce() -> Result<DAffine3>) -> Result<Path> {
    let document: Value = parse(file)?;
    let has = |name: &str| document.get(name).is_some_and(|value| !value.is_null());
    if has("path") {
        let named = transform.unwrap_or(file);
        let to_capture = transform.map_or(Ok(NGP), parse)?.to_capture(named)?;
        return ngp(file, whole(file, document)?, &to_capture);
    }
    if !has("camera_path") && !has("keyframes") {
        let what = "not a camera path: it has no `camera_path`, `keyframes` (nerfstudio) or `path` (instant-ngp)";
        return Err(Error::file(file, what));
    }
    let path: Nerfstudio = whole(file, document)?;
    let to_capture = match (transform, path.coordinates) {
        (None, Some(Coordinates::Capture)) => DAffine3::IDENTITY,
        (Some(_), Some(Coordinates::Capture)) => {
            return Err(Error::field(file, "coordinates", "is already `capture`: remove --path-transform"));
        }
        (None, None) => {
            note(&format!(
                "{}: assuming capture coordinates; for a path from nerfstudio, add --path-transform \
                 dataparser_transforms.json",
                file.display()
            ));
            DAffine3::IDENTITY
        }
        (Some(transform), None) => parse::<Dataparser>(transform)?.to_capture(transform, applied()?)?,
    };
    nerfstudio(file, path, &to_capture)
}

fn parse<T: DeserializeOwned>(file: &File) -> Result<T> {
    let text = read_text(file, "a camera path")?;
    serde_json::from_str(&text).map_err(|e| Error::file(file, format!("is malformed: {e}")))
}

/// A number of pixels, which nerfstudio's viewer writes as `1920.0`.
fn side<'de, D: Deserializer<'de>>(deserializer: D) -> std::result::Result<usize, D::Error> {
    let number = f64::deserialize(deserializer)?;
    // Other numbers saturate, and are refused as sides.
    if number.fract() == 0.0 {
        Ok(number as usize)
    } else {
        Err(D::Error::custom(format!("{number} is no whole number")))
    }
}

fn whole<T: DeserializeOwned>(file: &File, document: Value) -> Result<T> {
    serde_json::from_value(document).map_err(|e| Error::file(file, format!("is malformed: {e}")))
}

fn nerfstudio(file: &File, path: Nerfstudio, to_capture: &DAffine3) -> Result<Path> {
    let bad = |field: &str, what: &str| Error::field(file, field, what);
    let size = [path.render_width, path.render_height];
    if !size.iter().all(|side| (1..=LARGEST).contains(side)) {
        return Err(bad(
            "render_width",
            &format!("the image size is {}x{}; use 1 to {LARGEST} pixels a side", size[0], size[1]),
        ));
    }
    if path.camera_type.as_deref().is_some_and(|kind| kind != "perspective") {
        return Err(bad("camera_type", "must be `perspective`, the only supported camera type"));
    }
    if path.crop.is_some() {
        return Err(bad("crop", "is not supported: remove it"));
    }
    if let Some(fps) = path.fps.filter(|fps| !FPS.contains(fps)) {
        return Err(bad("fps", &format!("is {fps}; use {} to {}", FPS.start(), FPS.end())));
    }
    for (name, value) in [("seconds", path.seconds), ("default_transition_sec", path.default_transition_sec)] {
        if value.is_some_and(|value| !(value > 0.0 && value <= 1e6)) {
            return Err(bad(name, "must be above 0"));
        }
    }
    let key = |name: String, matrix: &[f64; 16], fov: f64, time: Option<f64>| {
        if time.is_some() {
            return Err(bad(&format!("{name}.render_time"), "is not supported, because scenes are static: remove it"));
        }
        let mut pose = from_rows(matrix).map_err(|what| bad(&name, &what))?;
        // Nerfstudio normalises directions, so axes may have a scale: Blender's add-on writes that of the scene.
        let scale = pose.matrix3.determinant().cbrt();
        if scale > 0.0 && scale.is_finite() {
            pose.matrix3 *= scale.recip();
        }
        key(file, &name, pose, fov, to_capture)
    };
    let shots = path.camera_path.unwrap_or_default();
    let motion = match (shots.is_empty(), path.keyframes) {
        (false, _) => {
            count(file, "camera_path", shots.len())?;
            let each = shots.iter().enumerate();
            let keys = each
                .map(|(i, shot)| key(format!("camera_path[{i}]"), &shot.camera_to_world, shot.fov, shot.render_time));
            Motion::Frames(keys.collect::<Result<_>>()?)
        }
        (true, None) => return Err(bad("camera_path", "is empty")),
        (true, Some(frames)) => {
            if path.smoothness_value.is_some_and(|value| value != 0.0) {
                return Err(bad("smoothness_value", "must be 0 without a `camera_path`: smoothing is not supported"));
            }
            let frames: Vec<NerfstudioKeyframe> =
                serde_json::from_value(frames).map_err(|e| bad("keyframes", &format!("is malformed: {e}")))?;
            count(file, "keyframes", frames.len())?;
            let each = frames.iter().enumerate();
            let keys =
                each.map(|(i, frame)| key(format!("keyframes[{i}]"), &frame.matrix, frame.fov, frame.render_time));
            let keys: Vec<Keyframe> = keys.collect::<Result<_>>()?;
            let closed = path.is_cycle.unwrap_or(false) && keys.len() > 1;
            // A key frame holds the time from the one before it. In a loop, the first one holds the time of the last
            // leg.
            let usual = path.default_transition_sec.unwrap_or(TRANSITION);
            let seconds = |(i, frame): (usize, &NerfstudioKeyframe)| {
                let own = frame.override_transition_sec.filter(|_| frame.override_transition_enabled.unwrap_or(false));
                let seconds = own.unwrap_or(usual);
                let what = || bad(&format!("keyframes[{i}].override_transition_sec"), "must be above 0");
                if seconds > 0.0 && seconds <= 1e6 { Ok(seconds) } else { Err(what()) }
            };
            let mut times = frames.iter().enumerate().map(seconds).collect::<Result<Vec<f64>>>()?;
            times.rotate_left(1);
            times.truncate(if closed { keys.len() } else { keys.len() - 1 });
            let seconds = path.seconds.or(Some(times.iter().sum()).filter(|sum| *sum > 0.0));
            Motion::Keys { path: CameraPath::timed(keys, times, closed, Curve::Through), seconds }
        }
    };
    Ok(Path { motion, size: Some(size), fps: path.fps })
}

fn ngp(file: &File, path: Ngp, to_capture: &DAffine3) -> Result<Path> {
    let bad = |field: &str, what: &str| Error::field(file, field, what);
    count(file, "path", path.path.len())?;
    if path.spline_order.is_some_and(|order| order != 3) {
        return Err(bad("spline_order", "must be 3, the only supported order"));
    }
    let of = |(i, frame): (usize, &NgpKey)| {
        let name = format!("path[{i}]");
        let [x, y, z, w] = frame.rotation;
        let rotation = DQuat::from_xyzw(x, y, z, w);
        if !(1e-3..1e3).contains(&rotation.length()) {
            return Err(bad(&format!("{name}.R"), "must be a quaternion x, y, z, w"));
        }
        if frame.aperture_size != 0.0 {
            return Err(bad(&format!("{name}.aperture_size"), "must be 0: depth of field is not supported"));
        }
        if frame.glow_mode != 0 {
            return Err(bad(&format!("{name}.glow_mode"), "must be 0: glow is not supported"));
        }
        // Instant-ngp's cameras have y down and look along z.
        let turned = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        let matrix3 = DMat3::from_quat(rotation.normalize()) * turned;
        let pose = DAffine3 { matrix3, translation: DVec3::from(frame.position) };
        key(file, &name, pose, frame.fov, to_capture)
    };
    let keys = path.path.iter().enumerate().map(of).collect::<Result<Vec<Keyframe>>>()?;
    let closed = path.closed && keys.len() > 1;
    let legs = if closed { keys.len() } else { keys.len() - 1 };
    // Timestamps are arrival times of the next key frame. They are ignored unless they increase.
    let stamps: Vec<f64> = path.path.iter().filter_map(|frame| frame.timestamp).collect();
    let lengths = stamps.iter().scan(0.0, |before, stamp| Some(stamp - std::mem::replace(before, *stamp)));
    let mut times: Vec<f64> = lengths.collect();
    if times.len() != keys.len() || !times.iter().all(|time| *time > 0.0 && time.is_finite()) {
        times = vec![1.0; keys.len()];
    }
    times.truncate(legs);
    let seconds = path.duration_seconds.filter(|seconds| *seconds > 0.0 && *seconds <= 1e6);
    let path = CameraPath::timed(keys, times, closed, Curve::Near);
    Ok(Path { motion: Motion::Keys { path, seconds }, size: None, fps: None })
}

fn count(file: &File, field: &str, count: usize) -> Result<()> {
    match count {
        0 => Err(Error::field(file, field, "is empty")),
        1..=MOST => Ok(()),
        _ => Err(Error::field(file, field, format!("has {count} frames; the limit is {MOST}"))),
    }
}

/// A key frame in the capture's coordinates, from a pose and a vertical angle in degrees.
fn key(file: &File, name: &str, pose: DAffine3, fov: f64, to_capture: &DAffine3) -> Result<Keyframe> {
    let bad = |what: String| Error::field(file, name, what);
    rigid::pose(&pose).map_err(|what| bad(format!("its pose {what}")))?;
    if !(SMALLEST_FOV..=180.0 - SMALLEST_FOV).contains(&fov) {
        return Err(bad(format!("`fov` is {fov}; use {SMALLEST_FOV} to {} degrees", 180.0 - SMALLEST_FOV)));
    }
    let DAffine3 { matrix3, .. } = to_capture;
    let pose = DAffine3 {
        matrix3: *matrix3 * pose.matrix3 * matrix3.determinant().cbrt().recip(),
        translation: to_capture.transform_point3(pose.translation),
    };
    Ok(Keyframe { pose, angle_y: fov.to_radians() })
}

/// An affine map from sixteen numbers, row by row.
fn from_rows(m: &[f64; 16]) -> std::result::Result<DAffine3, String> {
    let last = &m[12..];
    if last.iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(value, expected)| !((value - expected).abs() < 1e-3)) {
        return Err(format!("the last row of its matrix is {last:?}; write the matrix row by row, ending in 0 0 0 1"));
    }
    let column = |c: usize| DVec3::new(m[c], m[4 + c], m[8 + c]);
    Ok(DAffine3 { matrix3: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) })
}

impl Dataparser {
    /// The map from nerfstudio's world to the capture. A position `x` before the file's own transform maps to `scale *
    /// (transform x)`.
    fn to_capture(&self, file: &File, applied: DAffine3) -> Result<DAffine3> {
        let row = |r: usize| DVec3::from_slice(&self.transform[r][..3]);
        let matrix3 = DMat3::from_cols(row(0), row(1), row(2)).transpose();
        let translation = DVec3::from([0, 1, 2].map(|r: usize| self.transform[r][3]));
        let transform = DAffine3 { matrix3, translation };
        rigid::pose(&transform).map_err(|what| Error::field(file, "transform", what))?;
        // Nerfstudio's scale includes that of the file's own transform; its rotation and translation do not.
        let own = applied.matrix3.determinant().cbrt();
        let scale = self.scale / own;
        if !(scale > 0.0 && scale.is_finite()) {
            return Err(Error::field(file, "scale", "must be above 0"));
        }
        let applied = DAffine3 { matrix3: applied.matrix3 * own.recip(), translation: applied.translation / own };
        Ok(applied * transform.inverse() * DAffine3::from_scale(DVec3::splat(scale.recip())))
    }
}

impl Cube {
    /// The map from instant-ngp's unit cube to the capture.
    fn to_capture(&self, file: &File) -> Result<DAffine3> {
        if !(self.scale > 0.0 && self.scale.is_finite()) {
            return Err(Error::field(file, "scale", "must be above 0"));
        }
        let offset = DVec3::from(self.offset);
        if !offset.is_finite() {
            return Err(Error::field(file, "offset", "must be three finite numbers"));
        }
        // Its x, y and z axes are the capture's y, z and x axes.
        let axes = DMat3::from_cols(DVec3::Y, DVec3::Z, DVec3::X);
        Ok(DAffine3 { matrix3: axes * self.scale.recip(), translation: -offset / self.scale })
    }
}

#[cfg(test)]
mod tests;
