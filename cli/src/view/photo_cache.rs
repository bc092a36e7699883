//! The images of a run, loaded on demand.

use std::sync::{Arc, Mutex};

use raygrad::nerf::dataset::{Capture, Frame, Photo, Point, Split, View};
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::{Camera, Error, Lens, Model, Result};
use raygrad::tensor::parallel::locked;

use super::cache::{Cache, Cached};
use super::messages::{AboutPhotograph, rows};
use super::requests::Requests;
use crate::builtin;
use crate::eval::alignment::Appearance;
use crate::photographs::{learned_transform, present, trained};
use crate::run::Run;
use crate::scene::{EMBEDDED_SIZE, LANDSCAPE_SIZE, Scene};

/// Number of images in memory.
const KEPT: usize = 4;
/// Longest side of an image in memory, in pixels.
const LONGEST: usize = 1600;
/// Most points that a page gets.
const MOST_POINTS: usize = 4000;

/// The images of all splits, by number.
pub struct PhotoCache {
    capture: Capture,
    scene: Scene,
    /// Downscale factor of training and evaluation.
    downscale: usize,
    /// True if masks are alpha, as in training.
    mask_as_alpha: bool,
    entries: Vec<Entry>,
    /// The best points of the capture, in scene coordinates.
    points: Vec<(DVec3, [u8; 3])>,
    kept: Cache<usize, Photo>,
    /// The images of a split of a built-in scene, which are rendered together.
    made: Mutex<Option<(Split, Vec<Frame>)>>,
    width: usize,
}

struct Entry {
    split: Split,
    /// Index in the split.
    number: usize,
    view: View,
    /// The camera from the files, in scene coordinates.
    given: Camera,
}

impl PhotoCache {
    /// Opens the training and held-out images of a run. Reads no pixels.
    ///
    /// # Errors
    ///
    /// Fails if the capture cannot be read or the training images differ from those of the run.
    pub fn open(run: &Run, scene: Option<&Scene>) -> Result<Self> {
        let scene = run.scene(scene)?.clone();
        let capture = run.capture(Some(&scene))?;
        let width = if scene == Scene::Landscape { LANDSCAPE_SIZE[0] } else { EMBEDDED_SIZE };
        let transform = run.config.scene_box.transform;
        let mut entries = vec![];
        for split in Split::ALL {
            // A capture may lack splits.
            let Ok(mut views) = present(&capture, split) else { continue };
            // Without a validation split, its views are the test views.
            let names = |views: &[&View]| views.iter().map(|view| view.name.clone()).collect::<Vec<_>>();
            let are_tests = |tests: Vec<&View>| names(&tests) == names(&views);
            if split == Split::Val && present(&capture, Split::Test).is_ok_and(are_tests) {
                continue;
            }
            if split == Split::Train {
                views = trained(run, &capture)?;
            }
            entries.extend(views.into_iter().enumerate().map(|(number, view)| {
                let given = transform.camera(&view.camera);
                Entry { split, number, view: view.clone(), given }
            }));
        }
        let points = best(&capture.points).map(|point| (transform.point(point.position), point.color)).collect();
        let (downscale, mask_as_alpha) = (run.config.downscale, run.config.mask_as_alpha);
        let (kept, made) = (Cache::new(KEPT), Mutex::default());
        Ok(PhotoCache { capture, scene, downscale, mask_as_alpha, entries, points, kept, made, width })
    }

    /// Returns true if an image has this number.
    pub fn has(&self, number: usize) -> bool {
        number < self.entries.len()
    }

    /// The camera of an image, with pose refinement.
    pub fn camera(&self, number: usize, model: &Model<f32>) -> Option<Camera> {
        let Entry { split, number, given, .. } = self.entries.get(number)?;
        Some(match split {
            Split::Train => model.learned_camera(*number, given),
            _ => model.other_camera(given),
        })
    }

    /// All cameras.
    fn cameras(&self, model: &Model<f32>) -> Vec<Camera> {
        let given: Vec<Camera> = self.entries.iter().map(|entry| entry.given.clone()).collect();
        let camera = |(entry, other): (&Entry, Camera)| match entry.split {
            Split::Train => model.learned_camera(entry.number, &entry.given),
            _ => other,
        };
        self.entries.iter().zip(model.other_cameras(&given)).map(camera).collect()
    }

    /// Returns true if evaluation compares an image at this size and with the same pixels. Excludes images above the
    /// size in memory, and downscaled built-in ones.
    pub fn is_evaluated_at(&self, number: usize, size: [usize; 2]) -> bool {
        let is_averaged = self.downscale == 1 || matches!(self.scene, Scene::Folder(_));
        self.entries.get(number).is_some_and(|Entry { given, .. }| {
            let sides = [given.width, given.height];
            let own = sides.map(|side| ((side as f64 / self.downscale as f64).round() as usize).max(1));
            is_averaged && size == own && sides.iter().all(|side| *side <= LONGEST)
        })
    }

    /// Returns true if evaluation treats an image differently: with a mask, weights of a panorama, or the image's own
    /// appearance embedding.
    pub fn is_special(&self, number: usize, model: &Model<f32>) -> bool {
        let own = |entry: &Entry| Appearance::of(model, entry.split, false) == Appearance::Own;
        let is_masked = |entry: &Entry| entry.view.mask.is_some() && !(self.mask_as_alpha && entry.view.has_cutout());
        let is_weighted = |entry: &Entry| is_masked(entry) || entry.given.lens == Lens::Equirectangular;
        self.entries.get(number).is_some_and(|entry| is_weighted(entry) || own(entry))
    }

    /// The image whose camera is nearest in position and direction.
    pub fn nearest(&self, camera: &Camera, model: &Model<f32>) -> Option<usize> {
        let middle = 0.5 * (model.scene_box.bounds[0] + model.scene_box.bounds[1]);
        let reach = camera.pose.translation.distance(middle).max(1e-6);
        let apart = |own: &Camera| {
            let away = own.pose.translation.distance(camera.pose.translation) / reach;
            away + own.pose.matrix3.z_axis.distance(camera.pose.matrix3.z_axis)
        };
        let apart = self.cameras(model).iter().map(apart).enumerate().min_by(|a, b| a.1.total_cmp(&b.1));
        apart.map(|(number, _)| number)
    }

    /// Loads an image, at most as large as pages show it.
    ///
    /// # Errors
    ///
    /// Fails if no image has this number or it cannot be read.
    pub fn photo(&self, number: usize) -> Result<Arc<Photo>> {
        self.kept.get_now(number, || self.read(number))
    }

    /// Like [`photo`](Self::photo), in the background. Notifies `requests` when the image is ready.
    pub fn fetch(self: &Arc<Self>, number: usize, requests: &Arc<Requests>) -> Cached<Photo> {
        let (photos, requests) = (self.clone(), requests.clone());
        self.kept.get(number, move || photos.read(number), move || requests.wake())
    }

    fn read(&self, number: usize) -> Result<Photo> {
        let entry = self.entries.get(number);
        let entry = entry.ok_or_else(|| Error::setting("image", format!("there is no image {number}")))?;
        let photo = match &self.scene {
            Scene::Folder(_) if self.mask_as_alpha => self.capture.cutout(&entry.view)?,
            Scene::Folder(_) => self.capture.photo(&entry.view)?,
            made => self.made(made, entry)?,
        };
        Ok(photo.at_most(LONGEST))
    }

    /// An image of a built-in scene.
    fn made(&self, scene: &Scene, entry: &Entry) -> Result<Photo> {
        let mut made = locked(&self.made);
        let frames = match made.take_if(|(split, _)| *split == entry.split) {
            Some((_, frames)) => frames,
            None => builtin::images(scene, entry.split, self.width).frames,
        };
        let photo = frames.get(entry.number).map(|frame| frame.image.clone());
        *made = Some((entry.split, frames));
        photo.ok_or_else(|| Error::setting("image", format!("there is no image {}", entry.number)))
    }

    /// The description of the images for pages.
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

    /// Points of the scene with their colours, limited to the best ones.
    pub fn points(&self, model: &Model<f32>) -> Vec<([f32; 3], [u8; 3])> {
        // Points move with the cameras if all cameras have a learned transform.
        let learned = learned_transform(model);
        let place = |(point, color): &(DVec3, [u8; 3])| (learned.point(*point).as_vec3().to_array(), *color);
        self.points.iter().map(place).collect()
    }
}

/// The points in most images. Among equals, those with the least error come first. Limited to the number for a page.
fn best(points: &[Point]) -> impl Iterator<Item = &Point> {
    let mut points: Vec<&Point> = points.iter().collect();
    points.sort_by(|a, b| b.views.cmp(&a.views).then(a.error.total_cmp(&b.error)));
    points.into_iter().take(MOST_POINTS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::Schedule;
    use raygrad::nerf::dataset::SceneTransform;
    use raygrad::nerf::glam::DAffine3;
    use raygrad::nerf::{Config, Preset, SceneBox};
    use raygrad_scenes::landscape;
    use std::path::PathBuf;

    /// Images of these splits at these positions, looking down.
    fn photos(scene: Scene, places: &[(Split, DVec3)]) -> PhotoCache {
        let capture = Scene::Landscape.capture(None, None).unwrap();
        let mut numbers = [0; 3];
        let entry = |(split, place): &(Split, DVec3)| {
            let which = Split::ALL.iter().position(|own| own == split).unwrap();
            let given = Camera::from_angle(40, 30, 0.8, DAffine3::from_translation(*place));
            numbers[which] += 1;
            Entry { split: *split, number: numbers[which] - 1, view: capture.views[0].clone(), given }
        };
        let entries = places.iter().map(entry).collect();
        let (kept, made) = (Cache::new(KEPT), Mutex::default());
        PhotoCache {
            capture,
            scene,
            downscale: 1,
            mask_as_alpha: false,
            entries,
            points: vec![],
            kept,
            made,
            width: 16,
        }
    }

    fn model(bounds: [DVec3; 2], cameras: &[Camera], learns: bool) -> Model<f32> {
        let poses = learns.then_some(Schedule::Constant { lr: 1e-3 });
        let extent = SceneBox { frames: cameras.len(), ..SceneBox::new(bounds, [0.1, 9.0]) };
        Model::with_cameras(Config { poses, ..Config::preset(Preset::Voxel) }, extent, cameras, 0).unwrap()
    }

    const UNIT: [DVec3; 2] = [DVec3::NEG_ONE, DVec3::ONE];

    #[test]
    fn camera_of_trained_image_is_refined() {
        let at = |x: f64, y: f64| DVec3::new(x, y, 3.0);
        let places = [
            (Split::Train, at(0.0, 1.0)),
            (Split::Train, at(1.0, 0.0)),
            (Split::Train, at(-1.0, 0.5)),
            (Split::Test, at(0.5, 0.0)),
        ];
        let photos = photos(Scene::Embedded, &places);
        let given: Vec<Camera> = photos.entries.iter().map(|entry| entry.given.clone()).collect();
        let mut model = model(UNIT, &given[..3], true);
        assert_eq!((0..4).map(|i| photos.camera(i, &model).unwrap()).collect::<Vec<_>>(), given);
        let poses = model.params.find("poses").unwrap();
        let moved: Vec<f32> = (0..18).map(|i| 0.05 + 0.02 * (i * i % 7) as f32).collect();
        model.params.get_mut(poses).as_mut_slice().copy_from_slice(&moved);
        let expected: Vec<Camera> =
            (0..3).map(|i| model.learned_camera(i, &given[i])).chain([model.other_camera(&given[3])]).collect();
        assert!(expected.iter().zip(&given).all(|(a, b)| a != b));
        assert_eq!((0..4).map(|i| photos.camera(i, &model).unwrap()).collect::<Vec<_>>(), expected);
        assert_eq!(photos.cameras(&model), expected);
        assert!(photos.camera(4, &model).is_none() && photos.has(3) && !photos.has(4));
    }

    #[test]
    fn nearest_uses_position_and_direction() {
        let mut photos = photos(Scene::Embedded, &[(Split::Train, DVec3::new(0.0, 0.0, 5.0)); 3]);
        let model = model([DVec3::ZERO, DVec3::splat(2.0)], &[], false);
        // Two units away and turned by a right angle; six away with equal direction; at the same position, turned
        // round.
        photos.entries[0].given.pose = DAffine3::from_rotation_x(1.5) * DAffine3::from_translation(DVec3::ZERO);
        photos.entries[0].given.pose.translation = DVec3::new(2.0, 0.0, 7.0);
        photos.entries[1].given.pose.translation = DVec3::new(6.0, 0.0, 7.0);
        photos.entries[2].given.pose = DAffine3::from_rotation_x(3.1);
        photos.entries[2].given.pose.translation = DVec3::new(0.0, 0.0, 7.0);
        let camera = Camera::from_angle(4, 3, 0.8, DAffine3::from_translation(DVec3::new(0.0, 0.0, 7.0)));
        // Relative to the distance of 6.16 from the centre (1, 1, 1): .32 + 1.36, .97 + 0, 0 + 2.
        assert_eq!(photos.nearest(&camera, &model), Some(1));
        photos.entries[1].given.pose.translation.x = 11.0;
        assert_eq!(photos.nearest(&camera, &model), Some(0), "1.78");
        photos.entries.clear();
        assert_eq!(photos.nearest(&camera, &model), None);
    }

    #[test]
    fn viewer_psnr_equals_eval() {
        let mut photos =
            photos(Scene::Folder(PathBuf::new()), &[(Split::Train, DVec3::ZERO), (Split::Test, DVec3::ONE)]);
        let model = model(UNIT, &[], false);
        assert!(!photos.is_special(0, &model) && !photos.is_special(7, &model));
        photos.entries[0].view.mask = Some(PathBuf::from("mask.png"));
        assert!(photos.is_special(0, &model) && !photos.is_special(1, &model));
        photos.mask_as_alpha = true;
        assert!(!photos.is_special(0, &model), "the page shows the same alpha");
        photos.entries[0].view.mask_is_dynamic = true;
        assert!(photos.is_special(0, &model), "such a mask cuts out nothing");
        photos.mask_as_alpha = false;
        photos.entries[0].view.mask = None;
        photos.entries[0].given.lens = Lens::Equirectangular;
        assert!(photos.is_special(0, &model));
        // The size of training.
        let at = |photos: &PhotoCache, size: [usize; 2]| photos.is_evaluated_at(1, size);
        assert_eq!([[40, 30], [20, 15], [39, 30], [40, 29]].map(|size| at(&photos, size)), [true, false, false, false]);
        photos.downscale = 4;
        assert_eq!([[40, 30], [10, 8], [10, 7]].map(|size| at(&photos, size)), [false, true, false]);
        // Images of built-in scenes are rendered at the size, not downscaled to it.
        photos.scene = Scene::Landscape;
        assert!(!at(&photos, [10, 8]) && !photos.is_evaluated_at(2, [40, 30]));
        (photos.downscale, photos.entries[1].given.width) = (1, LONGEST + 1);
        assert!(!at(&photos, [LONGEST + 1, 30]), "it is shown smaller");
    }

    #[test]
    fn built_in_images_match_split_and_number() {
        let places = [(Split::Train, DVec3::ZERO), (Split::Test, DVec3::ZERO), (Split::Test, DVec3::ZERO)];
        let photos = photos(Scene::Landscape, &places);
        let tests = landscape(Split::Test, 16).frames;
        assert_eq!(photos.read(2).unwrap().to_image(), tests[1].image.to_image());
        assert_eq!(photos.read(1).unwrap().to_image(), tests[0].image.to_image());
        assert_ne!(photos.read(0).unwrap().to_image(), tests[0].image.to_image());
        assert!(photos.read(3).is_err_and(|error| error.to_string().contains("no image 3")));
    }

    #[test]
    fn points_with_most_views_come_first() {
        let of = |views: u32, error: f64| Point { position: DVec3::ZERO, color: [0; 3], error, views };
        let mut points = vec![of(2, 0.1), of(5, 0.9), of(5, 0.2), of(3, 0.0)];
        let order = best(&points).map(|point| (point.views, point.error)).collect::<Vec<_>>();
        assert_eq!(order, [(5, 0.2), (5, 0.9), (3, 0.0), (2, 0.1)]);
        points.resize(MOST_POINTS + 1, of(1, 0.0));
        assert_eq!(best(&points).count(), MOST_POINTS);
        // In scene coordinates, moved with the cameras.
        let mut photos = photos(Scene::Embedded, &[(Split::Train, DVec3::ZERO)]);
        photos.points = vec![(DVec3::new(1.0, 2.0, 3.0), [4, 5, 6])];
        assert_eq!(photos.points(&model(UNIT, &[], false)), [([1.0, 2.0, 3.0], [4, 5, 6])]);
        assert_eq!(SceneTransform::default().point(DVec3::X), DVec3::X);
    }
}
