//! The photographs of a run, without their pictures.

use raygrad::nerf::dataset::{Capture, Split, View};
use raygrad::nerf::{Camera, Error, Model, Result};

use super::builtin;
use super::run::Run;
use super::scene::Scene;

/// A photograph, in the scene's coordinates.
pub struct Photograph {
    pub name: String,
    /// Where the model has it.
    pub camera: Camera,
    /// The nearest and the farthest depth that it shows, if that is known.
    pub bounds: Option<[f64; 2]>,
}

/// Those of a split, at least one, in the order in which they are read. No image is read.
///
/// # Errors
/// If the capture cannot be read, or has none; or to train on others than the run was trained on.
pub fn photographs(run: &Run, model: &Model<f32>, scene: Option<&Scene>, split: Split) -> Result<Vec<Photograph>> {
    let capture = builtin::capture(run.scene(scene)?, None, None)?;
    let views = present(&capture, split)?;
    if views.is_empty() {
        return Err(Error::file(&capture.file, format!("has no {split} images")));
    }
    if split == Split::Train {
        check_trained(run, &capture, &views, model.scene_box.frames)?;
    }
    let placement = model.scene_box.transform;
    let given: Vec<Camera> = views.iter().map(|view| placement.camera(&view.camera)).collect();
    let cameras = match split {
        Split::Train => given.iter().enumerate().map(|(i, given)| model.learned_camera(i, given)).collect(),
        _ => model.other_cameras(&given),
    };
    let photograph = |(view, camera): (&&View, Camera)| Photograph {
        name: view.name.clone(),
        camera,
        bounds: bounds(view, placement.scale),
    };
    Ok(views.iter().zip(cameras).map(photograph).collect())
}

/// The depths that a view shows at most, in scene units, of which one of the capture's has `scale`.
fn bounds(view: &View, scale: f64) -> Option<[f64; 2]> {
    view.bounds.map(|ends| ends.map(|end| scale * end))
}

/// The views of a split whose photographs are there, in the order in which these are read, which numbers them. Of a built-in
/// scene all are.
pub fn present(capture: &Capture, split: Split) -> Result<Vec<&View>> {
    let is_made = capture.present().next().is_none();
    Ok(capture.split(split)?.into_iter().filter(|view| is_made || view.image.is_some()).collect())
}

/// Whether these views to train on are the `count` photographs that a run was trained on; of 0, that is not known.
pub fn check_trained(run: &Run, capture: &Capture, views: &[&View], count: usize) -> Result<()> {
    let bad = |what: String| Err(Error::file(&capture.file, format!("{what}: name their folder with --scene")));
    if count > 0 && views.len() != count {
        return bad(format!("has {} training images, and the run was trained on {count}", views.len()));
    }
    let (names, is_made) = (&run.config.photographs, capture.present().next().is_none());
    // Runs of the first edition have no names, and those of built-in scenes have others.
    if !is_made && !names.is_empty() && !views.iter().map(|view| &view.name).eq(names) {
        return bad("has other training images than the run was trained on".to_owned());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depths_are_in_scene_units() {
        let mut capture = builtin::capture(&Scene::Embedded, None, None).unwrap();
        let mut view = capture.views.remove(0);
        assert_eq!(bounds(&view, 3.0), None);
        view.bounds = Some([2.0, 7.0]);
        assert_eq!(bounds(&view, 3.0), Some([6.0, 21.0]));
    }
}
