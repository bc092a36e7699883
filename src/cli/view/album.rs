//! The photographs of a run, one at a time.

use std::sync::Arc;

use raygrad::nerf::dataset::{Capture, Dataset, Photo, Point, Split, View, embedded, landscape};
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::{Camera, Error, Model, Result};

use super::hub::Hub;
use super::messages::{AboutPhotograph, rows};
use super::store::{Got, Store};
use crate::cli::builtin;
use crate::cli::eval::alignment::Appearance;
use crate::cli::photographs::{check_trained, present};
use crate::cli::run::Run;
use crate::cli::scene::{EMBEDDED_SIZE, LANDSCAPE_SIZE, Scene};

/// Photographs that are kept in memory.
const KEPT: usize = 4;
/// Longest side that they are kept at.
const LONGEST: usize = 1600;
/// Most points that a page is told of.
const MOST_POINTS: usize = 4000;

/// The photographs of all splits, by number.
pub struct Album {
    capture: Capture,
    scene: Scene,
    entries: Vec<Entry>,
    kept: Store<usize, Photo>,
}

struct Entry {
    split: Split,
    /// Which of its split it is.
    number: usize,
    view: View,
    /// The camera as the files have it, in the scene.
    given: Camera,
}

impl Album {
    /// Those that a run was trained on and those that were held out. No image is read.
    ///
    /// # Errors
    /// If the capture cannot be read, or those to train on are others.
    pub fn open(run: &Run, scene: Option<&Scene>) -> Result<Self> {
        let scene = run.scene(scene)?.clone();
        let capture = match &scene {
            Scene::Folder(folder) => Capture::read(folder)?,
            made => builtin::capture(made, None, None)?,
        };
        let placement = run.config.extent.placement;
        let mut entries = vec![];
        for split in Split::ALL {
            // A capture need not have all of them.
            let Ok(views) = present(&capture, split) else { continue };
            // Where there are none to validate with, those are the test views.
            let names = |views: &[&View]| views.iter().map(|view| view.name.clone()).collect::<Vec<_>>();
            let are_tests = |tests: Vec<&View>| names(&tests) == names(&views);
            if split == Split::Val && present(&capture, Split::Test).is_ok_and(are_tests) {
                continue;
            }
            if split == Split::Train {
                check_trained(run, &capture, &views, run.config.extent.frames)?;
            }
            entries.extend(views.into_iter().enumerate().map(|(number, view)| {
                let given = placement.camera(&view.camera);
                Entry { split, number, view: view.clone(), given }
            }));
        }
        Ok(Album { capture, scene, entries, kept: Store::new(KEPT) })
    }

    /// The camera of a photograph, where a model has it.
    pub fn camera(&self, number: usize, model: &Model<f32>) -> Option<Camera> {
        let Entry { split, number, given, .. } = self.entries.get(number)?;
        let learned = *split == Split::Train && model.refine.is_some();
        Some(if learned { model.learned_camera(*number, given) } else { model.other_camera(given) })
    }

    /// All of them.
    fn cameras(&self, model: &Model<f32>) -> Vec<Camera> {
        let is_learned = |entry: &&Entry| entry.split == Split::Train;
        let others: Vec<Camera> =
            self.entries.iter().filter(|entry| !is_learned(entry)).map(|e| e.given.clone()).collect();
        let mut others = model.other_cameras(&others).into_iter();
        let camera = |entry: &Entry| match is_learned(&entry) {
            true => model.learned_camera(entry.number, &entry.given),
            false => others.next().unwrap_or_else(|| entry.given.clone()),
        };
        self.entries.iter().map(camera).collect()
    }

    /// Whether evaluations see a photograph otherwise than a page: without what its mask covers, or with what was learned of it alone.
    pub fn is_special(&self, number: usize, model: &Model<f32>) -> bool {
        let own = |entry: &Entry| Appearance::of(model, entry.split, false) == Appearance::Own;
        self.entries.get(number).is_some_and(|entry| entry.view.mask.is_some() || own(entry))
    }

    /// The photograph that was taken nearest to where a camera is, looking the way it looks.
    pub fn nearest(&self, camera: &Camera, model: &Model<f32>) -> Option<usize> {
        let middle = 0.5 * (model.extent.bounds[0] + model.extent.bounds[1]);
        let reach = camera.pose.translation.distance(middle).max(1e-6);
        let apart = |own: &Camera| {
            let away = own.pose.translation.distance(camera.pose.translation) / reach;
            away + own.pose.matrix3.z_axis.distance(camera.pose.matrix3.z_axis)
        };
        let apart = self.cameras(model).iter().map(apart).enumerate().min_by(|a, b| a.1.total_cmp(&b.1));
        apart.map(|(number, _)| number)
    }

    /// A photograph, no larger than a page shows it.
    ///
    /// # Errors
    /// If there is none of this number, or it cannot be read.
    pub fn photo(&self, number: usize) -> Result<Arc<Photo>> {
        self.kept.get_now(number, || self.read(number))
    }

    /// The same, read beside all else; wakes who waits at the hub when it has come.
    pub fn fetch(self: &Arc<Self>, number: usize, hub: &Arc<Hub>) -> Got<Photo> {
        let (album, hub) = (self.clone(), hub.clone());
        self.kept.get(number, move || album.read(number), move || hub.wake())
    }

    fn read(&self, number: usize) -> Result<Photo> {
        let entry = self.entries.get(number);
        let entry = entry.ok_or_else(|| Error::setting("photograph", format!("there is no photograph {number}")))?;
        let photo = match &self.scene {
            Scene::Folder(_) => self.capture.photo(&entry.view)?,
            made => self.made(made, entry)?,
        };
        Ok(if photo.width.max(photo.height) > LONGEST { shrunk(&photo) } else { photo })
    }

    /// A photograph of a scene that is built in.
    fn made(&self, scene: &Scene, entry: &Entry) -> Result<Photo> {
        let Dataset { mut frames, .. } = match scene {
            Scene::Landscape => landscape(entry.split, LANDSCAPE_SIZE[0]),
            _ => embedded(entry.split, EMBEDDED_SIZE),
        };
        Ok(frames.swap_remove(entry.number).image)
    }

    /// What a page is told of them.
    pub fn about(&self, model: &Model<f32>) -> Vec<AboutPhotograph> {
        let about = |(entry, camera): (&Entry, Camera)| AboutPhotograph {
            name: entry.view.name.clone(),
            split: entry.split,
            pose: rows(&camera.pose),
            fov: 2.0 * (0.5 * camera.height as f64 / camera.focal[1]).atan().to_degrees(),
            centre: [camera.centre[0] / camera.width as f64, camera.centre[1] / camera.height as f64],
            size: [camera.width, camera.height],
        };
        self.entries.iter().zip(self.cameras(model)).map(about).collect()
    }

    /// Places of the scene and their colours: the best of them, if there are many.
    pub fn points(&self, model: &Model<f32>) -> Vec<([f32; 3], [u8; 3])> {
        let placement = model.extent.placement;
        // With the cameras, if these are found to have been elsewhere.
        let learned = model.refine.as_ref().and_then(|refine| refine.placement(&model.params)).unwrap_or_default();
        let mut points: Vec<&Point> = self.capture.points.iter().collect();
        points.sort_by(|a, b| b.views.cmp(&a.views).then(a.error.total_cmp(&b.error)));
        let place = |point: DVec3| learned.point(placement.point(point)).as_vec3().to_array();
        points.into_iter().take(MOST_POINTS).map(|point| (place(point.position), point.color)).collect()
    }
}

/// A photograph whose longest side is as long as is kept.
fn shrunk(photo: &Photo) -> Photo {
    let share = LONGEST as f64 / photo.width.max(photo.height) as f64;
    let side = |side: usize| ((side as f64 * share).round() as usize).max(1);
    photo.resized([side(photo.width), side(photo.height)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::Image;

    #[test]
    fn large_photographs_keep_their_proportions() {
        for (size, expected) in [([3200, 100], [1600, 50]), ([20, 1700], [19, 1600]), ([1601, 1], [1600, 1])] {
            let small = shrunk(&Photo::from(Image::new(size[0], size[1], 3)));
            assert_eq!([small.width, small.height], expected);
        }
    }
}
