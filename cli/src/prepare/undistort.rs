//! Target cameras of undistortion.

use raygrad::nerf::{Camera, Lens, Result};

/// Replaces cameras by ones without distortion. Sets the source camera of images that must be resampled.
///
/// Cameras without distortion stay unchanged. With `plain`, all images get one camera with a centred principal point.
pub fn plan(views: &mut dyn Iterator<Item = (&mut Camera, &mut Option<Camera>)>, plain: bool) -> Result<()> {
    let mut views: Vec<_> = views.collect();
    let mut kinds: Vec<Camera> = vec![];
    for (camera, _) in &views {
        if kinds.iter().all(|kind| !alike(kind, camera)) {
            kinds.push((*camera).clone());
        }
    }
    let all: Vec<&Camera> = kinds.iter().collect();
    let done = match kinds.as_slice() {
        [one] if plain => is_plain(one),
        _ => false,
    };
    if done {
        return Ok(());
    }
    let common = if plain { Some(Camera::undistorted(&all)?) } else { None };
    let targets = kinds.iter().map(|kind| match &common {
        Some(common) => Ok(Some(common.clone())),
        None if kind.lens == Lens::Pinhole => Ok(None),
        None => Camera::undistorted(&[kind]).map(Some),
    });
    let targets = targets.collect::<Result<Vec<_>>>()?;
    for (camera, seen_by) in &mut views {
        let kind = kinds.iter().position(|kind| alike(kind, camera)).unwrap_or_default();
        if let Some(target) = &targets[kind] {
            **camera = Camera { pose: camera.pose, ..target.clone() };
            **seen_by = Some(camera.clone());
        }
    }
    Ok(())
}

/// Returns true if two cameras differ in their poses alone.
fn alike(a: &Camera, b: &Camera) -> bool {
    (a.width, a.height, a.focal, a.centre, a.lens) == (b.width, b.height, b.focal, b.centre, b.lens)
}

/// Returns true if every format supports this camera.
fn is_plain(camera: &Camera) -> bool {
    let Camera { width, height, focal, centre, lens, .. } = camera;
    *lens == Lens::Pinhole && focal[0] == focal[1] && *centre == [0.5 * *width as f64, 0.5 * *height as f64]
}
