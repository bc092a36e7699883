//! Captures of folders and of built-in scenes.

use std::path::Path;

use raygrad::nerf::dataset::{Capture, Dataset, Format, Frame, Photo, Split, View};
use raygrad::nerf::{Camera, Error, Result};
use raygrad_scenes::{embedded, embedded_cameras, landscape, walk_cameras};

use super::output::make_folder;
use super::progress::Progress;
use super::scene::{EMBEDDED_SIZE, LANDSCAPE_SIZE, Scene};

/// Width in pixels of the cameras of a built-in scene before they are scaled.
const SMALL: usize = 8;

/// Renders the images of a split of a built-in scene, so many pixels wide.
pub fn images(scene: &Scene, split: Split, width: usize) -> Dataset {
    if *scene == Scene::Landscape { landscape(split, width) } else { embedded(split, width) }
}

/// Reads the capture of a folder, or builds that of a built-in scene. The images of a built-in scene are `width` pixels
/// wide, by default as for training. They are written to `folder` if it is given.
///
/// # Errors
///
/// Fails if the files cannot be read. For a built-in scene, fails if the width is not supported or the images cannot be
/// written.
pub fn capture(scene: &Scene, width: Option<usize>, folder: Option<&Path>) -> Result<Capture> {
    let (usual, format): ([usize; 2], _) = match scene {
        Scene::Embedded => ([EMBEDDED_SIZE; 2], Format::Blender),
        Scene::Landscape => (LANDSCAPE_SIZE, Format::Transforms),
        Scene::Folder(_) if width.is_some() => {
            return Err(Error::setting("size", "is for built-in scenes, and the images of a folder keep their size"));
        }
        Scene::Folder(folder) => return Capture::read(folder),
    };
    let width = width.unwrap_or(usual[0]);
    let height = width * usual[1] / usual[0];
    if height * usual[0] != width * usual[1] {
        return Err(Error::setting("size", format!("is {width}; the landscape is 4:3, so use a multiple of 4")));
    }
    let is_embedded = *scene == Scene::Embedded;
    let views_of = |split: Split| -> Vec<(Camera, Option<Photo>)> {
        if folder.is_none() {
            let cameras = if is_embedded { embedded_cameras(split, SMALL) } else { walk_cameras(split, SMALL) };
            return cameras.into_iter().map(|camera| (camera, None)).collect();
        }
        let Dataset { frames, .. } = images(scene, split, width);
        frames.into_iter().map(|Frame { camera, image, .. }| (camera, Some(image))).collect()
    };
    let mut views = vec![];
    let progress = Progress::new();
    for (i, split) in Split::ALL.into_iter().enumerate() {
        if folder.is_some() {
            progress.set(i as f64 / Split::ALL.len() as f64, || format!("rendering {split} images"));
        }
        for (number, (camera, image)) in views_of(split).into_iter().enumerate() {
            let name = format!("{split}/{number}");
            let path = folder.map(|folder| folder.join(format!("{name}.png")));
            if let (Some(path), Some(image)) = (&path, image) {
                path.parent().map_or(Ok(()), make_folder)?;
                image.to_image().save_png(path)?;
            }
            let view = View::new(name.as_str(), name.as_str(), camera.resized(width, height));
            views.push(View { image: path, split: Some(split), ..view });
        }
    }
    Ok(Capture::new(folder.unwrap_or(Path::new("")), scene.to_string().into(), format, views))
}
