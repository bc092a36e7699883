//! Helpers for tests of formats.

use crate::camera::pinhole::Camera;
use crate::dataset::capture::{Capture, Format, View};
use crate::dataset::image::Image;
use crate::error::Result;
use glam::DVec3;
use serde_json::{Value, json};
use std::path::Path;

pub(super) use raygrad_test_support::damage;

/// A camera-to-world matrix at 4 on the z axis, looking down at the origin.
pub(super) fn pose() -> Value {
    json!([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]])
}

/// Frames with these paths and that pose.
pub(super) fn frames(names: &[&str]) -> Value {
    names.iter().map(|name| json!({ "file_path": name, "transform_matrix": pose() })).collect()
}

/// Writes a small image and creates its folder.
pub(super) fn picture(path: &Path, width: usize, height: usize) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    Image::new(width, height, 3).save_png(path).unwrap();
}

/// Removes a member.
pub(super) fn remove(object: &mut Value, name: &str) {
    object.as_object_mut().unwrap().remove(name).unwrap();
}

/// The message of an error, which must be one line and name the file.
#[track_caller]
pub(super) fn failure(result: Result<Capture>, file: &str) -> String {
    let message = result.unwrap_err().to_string();
    assert!(message.contains(&format!("{file}: ")) && !message.contains('\n'), "{message}");
    message
}

#[track_caller]
pub(super) fn says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "no `{part}` in: {message}");
    }
}

/// The number of damaged files that a test tries: few, or `PROPTEST_CASES`.
pub(super) fn cases() -> u32 {
    std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(300)
}

/// Checks the invariants of a capture that was read from a file, damaged or not.
#[track_caller]
pub(super) fn is_whole(capture: &Capture) {
    assert!(!capture.views.is_empty() && capture.applied.is_finite());
    assert!(capture.aabb_scale.is_none_or(|scale| scale.is_finite() && scale > 0.0));
    assert!(capture.points.iter().all(|point| point.position.is_finite()));
    for view in &capture.views {
        let camera = &view.camera;
        let [fx, fy] = camera.focal;
        assert!(camera.pose.is_finite() && camera.centre.iter().all(|x| x.is_finite()), "{view:?}");
        assert!(fx.is_finite() && fy.is_finite() && (camera.width == 0 || fx > 0.0 && fy > 0.0), "{view:?}");
        assert!(view.depth.as_ref().is_none_or(|(_, unit)| unit.is_finite() && *unit > 0.0));
        assert!(view.sharpness.is_none_or(f64::is_finite) && !view.name.is_empty() && !view.field.is_empty());
    }
}

/// A capture of one image, written to `images`, that every format can hold.
pub(super) fn picture_with_camera(folder: &Path) -> Capture {
    let image = folder.join("images/0.png");
    picture(&image, 8, 6);
    let pose = Camera::look_at(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, DVec3::Z);
    let view = View {
        image: Some(image),
        bounds: Some([1.0, 2.0]),
        ..View::new("0.png", "frames[0]", Camera::from_angle(8, 6, 0.9, pose))
    };
    Capture::new(folder, folder.join("transforms.json"), Format::Transforms, vec![view])
}
