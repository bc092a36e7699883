//! Cameras of a run's images, without the pixels.

use std::collections::HashSet;

use raygrad::nerf::dataset::{Capture, SceneTransform, Split, View};
use raygrad::nerf::{Camera, Error, Model, Result};

use super::run::Run;
use super::scene::Scene;

/// An image's camera in scene coordinates.
pub struct Photograph {
    pub name: String,
    /// The camera, with pose refinement.
    pub camera: Camera,
    /// Nearest and farthest visible depth, if known.
    pub bounds: Option<[f64; 2]>,
}

/// The images of a split, at least one, in order of loading. Reads no pixels.
///
/// # Errors
///
/// Fails if the capture cannot be read, the split has no images, or the training images differ from those of the run.
pub fn photographs(run: &Run, model: &Model<f32>, scene: Option<&Scene>, split: Split) -> Result<Vec<Photograph>> {
    let capture = run.capture(scene)?;
    let views = if split == Split::Train { trained(run, &capture)? } else { present(&capture, split)? };
    if views.is_empty() {
        return Err(Error::file(&capture.file, format!("has no {split} images")));
    }
    let transform = model.scene_box.transform;
    let given: Vec<Camera> = views.iter().map(|view| transform.camera(&view.camera)).collect();
    let cameras = match split {
        Split::Train => given.iter().enumerate().map(|(i, given)| model.learned_camera(i, given)).collect(),
        _ => model.other_cameras(&given),
    };
    let photograph = |(view, camera): (&&View, Camera)| Photograph {
        name: view.name.clone(),
        camera,
        bounds: bounds(view, transform.scale),
    };
    Ok(views.iter().zip(cameras).map(photograph).collect())
}

/// The learned transform of all cameras: from the scene coordinates of the capture to those of the model.
pub fn learned_transform(model: &Model<f32>) -> SceneTransform {
    model.camera_optimizer.as_ref().and_then(|refine| refine.transform(&model.params)).unwrap_or_default()
}

/// Near and far depth of a view in scene units. `scale` is the scale of the scene transform.
fn bounds(view: &View, scale: f64) -> Option<[f64; 2]> {
    view.bounds.map(|ends| ends.map(|end| scale * end))
}

/// The views of a split whose image files exist, in order of loading, which numbers them. Built-in scenes have all.
pub fn present(capture: &Capture, split: Split) -> Result<Vec<&View>> {
    let is_made = capture.present().next().is_none();
    Ok(capture.split(split)?.into_iter().filter(|view| is_made || view.image.is_some()).collect())
}

/// The training views of a run in order of loading, without the images that masks hide as a whole: training left them out.
///
/// # Errors
///
/// Fails if they differ from the images that the run was trained on.
pub fn trained<'c>(run: &Run, capture: &'c Capture) -> Result<Vec<&'c View>> {
    let mut views = present(capture, Split::Train)?;
    let names: HashSet<&String> = run.config.images.iter().collect();
    views.retain(|view| names.is_empty() || view.mask.is_none() || names.contains(&view.name));
    check_trained(run, capture, &views)?;
    Ok(views)
}

fn check_trained(run: &Run, capture: &Capture, views: &[&View]) -> Result<()> {
    // 0 if it is not known.
    let count = run.config.scene_box.frames;
    let bad = |what: String| Err(Error::file(&capture.file, format!("{what}: name their folder with --scene")));
    if count > 0 && views.len() != count {
        return bad(format!("has {} training images, and the run was trained on {count}", views.len()));
    }
    let (names, is_made) = (&run.config.images, capture.present().next().is_none());
    // Runs of the first version have no names, and names of built-in scenes differ.
    if !is_made && !names.is_empty() && !views.iter().map(|view| &view.name).eq(names) {
        return bad("has other training images than the run was trained on".to_owned());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_are_in_scene_units() {
        let mut capture = Scene::Embedded.capture(None, None).unwrap();
        let mut view = capture.views.remove(0);
        assert_eq!(bounds(&view, 3.0), None);
        view.bounds = Some([2.0, 7.0]);
        assert_eq!(bounds(&view, 3.0), Some([6.0, 21.0]));
    }
}
