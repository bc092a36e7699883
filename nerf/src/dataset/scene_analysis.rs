//! Analysis of a capture's cameras: scene transform (up, centre, scale), type of scene, scene box, near and far plane.

use super::capture::{Capture, Format, Point, View};
use super::formats::DEEPEST;
use super::frames::evenly_spaced;
use super::scene_transform::SceneTransform;
use super::scene_type::SceneType;
use crate::camera::Ndc;
use crate::camera::axes::{across, axes};
use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};
use crate::numbers::{mean, median, outer};
use glam::{DAffine3, DMat3, DVec3};
use raygrad_tensor::parallel;

/// The scene transform, type, box, near and far plane that a capture's cameras suggest.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneAnalysis {
    /// From the capture's coordinates to those of the scene.
    pub transform: SceneTransform,
    /// Bounded, unbounded or forward-facing.
    pub scene_type: SceneType,
    /// Lower and upper corner of the scene box, in scene units.
    pub bounds: [DVec3; 2],
    /// Near plane: distance along a ray, in scene units. No ray of a camera meets the box of a bounded scene before it.
    pub near: f64,
    /// Far plane: distance along a ray, in scene units. No ray of a camera meets the box of a bounded scene behind it.
    pub far: f64,
    /// The NDC frustum of a [forward-facing](SceneType::ForwardFacing) scene.
    pub ndc: Option<Ndc>,
    /// Why the background seems empty, if it does.
    pub empty: Option<EmptyBackground>,
    /// Whether alpha is transparent inside an opaque border in most of the images that were looked at, as if it were
    /// inverted.
    pub hollow: bool,
    /// The reason for `scene_type`, in a few words.
    pub reason: String,
}

/// Why the background of a capture seems empty.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EmptyBackground {
    /// The images have a transparent background.
    Transparent,
    /// The images show an object in front of white.
    White,
    /// Masks [cut out an object](super::LoadOptions::mask_as_alpha).
    Masks,
}

impl EmptyBackground {
    fn reason(self) -> &'static str {
        match self {
            EmptyBackground::Transparent => "images have a transparent background",
            EmptyBackground::White => "images show an object before white",
            EmptyBackground::Masks => "masks cut out an object",
        }
    }
}

/// Half of the box's side in scene units, as in the NeRF-synthetic scenes.
const HALF_BOX: f64 = 1.5;
/// The scene box.
const BOX: [DVec3; 2] = [DVec3::splat(-HALF_BOX), DVec3::splat(HALF_BOX)];
/// Distances of cameras from the origin that suggest the convention of the NeRF-synthetic scenes, whose files do not give
/// the scene's position.
const CONVENTION: [f64; 2] = [2.5, 5.5];
/// The share by which near and far plane of a bounded scene exceed the box: pose refinement moves cameras.
const MARGIN: f64 = 0.01;
/// The default near plane of an unbounded scene, as a share of the cameras' distance from its centre.
const NEAR_SHARE: f64 = 0.05;
/// The least near plane of a bounded scene, as a share of the cameras' usual distance from its centre.
const LEAST_NEAR: f64 = 0.01;
/// The far plane of an unbounded scene, in sides of its box.
const FAR_SIDES: f64 = 1000.0;
/// Half of the box of an unbounded scene, as a share of the cameras' distance from its centre.
const INNER_SHARE: f64 = 0.5;
/// The default distance of the scene for cameras that look the same way, in multiples of their spread.
const AHEAD: f64 = 5.0;
/// The same for cameras that look all around.
const AROUND: f64 = 3.0;
/// The share of all images that must show what one of them shows in a forward-facing scene: most of them.
const SHARED: f64 = 0.5;
/// Iterations of the reweighted least squares for the centre.
const ROUNDS: usize = 8;

impl SceneAnalysis {
    /// Analyses the cameras of all images that exist.
    ///
    /// Only pixels show whether the background is `empty`; [`Capture::analyze_scene`] finds it. `asked` overrides the
    /// type of scene.
    ///
    /// # Errors
    /// If there is no image, if all cameras stand in one place, or if `asked` is forward-facing and the cameras are
    /// not.
    pub fn new(capture: &Capture, empty: Option<EmptyBackground>, asked: Option<SceneType>) -> Result<SceneAnalysis> {
        let cameras: Vec<&Camera> = capture.present().map(|view| &view.camera).collect();
        if cameras.is_empty() {
            let Some(first) = capture.views.first() else {
                return Err(Error::file(&capture.file, "lists no images; add frames to it"));
            };
            let what = format!(
                "none of the {} images exists (the first is `{}`) in {} or up to {DEEPEST} folders below it; correct the \
                 paths or copy the images there",
                capture.views.len(),
                first.name,
                capture.folder.display()
            );
            return Err(Error::field(&capture.file, &first.field, what));
        }
        // Opaque images show a background, wherever their cameras are.
        let bounded = asked.map_or(empty.is_some(), |scene_type| scene_type == SceneType::Bounded);
        if capture.format == Format::Blender && bounded && conventional(&cameras) {
            let [near, far] = around_box(cameras.iter().map(|camera| camera.pose.translation), BOX);
            return Ok(SceneAnalysis {
                transform: SceneTransform::default(),
                scene_type: SceneType::Bounded,
                bounds: BOX,
                near,
                far,
                ndc: None,
                empty,
                hollow: false,
                reason: "the NeRF-synthetic convention: all within 1.5 units of the origin".to_owned(),
            });
        }
        let depths: Vec<(&Camera, [f64; 2])> =
            capture.present().filter_map(|view| Some((&view.camera, view.bounds?))).collect();
        let points = trusted(&capture.points);
        let (scene_type, reason) = match (asked, empty) {
            (Some(scene_type), _) => (scene_type, "as requested"),
            (None, Some(empty)) => (SceneType::Bounded, empty.reason()),
            (None, None) if Ndc::around(cameras.iter().copied(), 1.0).is_err() => {
                (SceneType::Unbounded, "images are opaque, so they show a background")
            }
            (None, None) if overlap(&cameras, &depths, &points).is_some_and(|share| share <= SHARED) => (
                SceneType::Unbounded,
                "images are opaque, and all cameras look ahead, but most images overlap little, as in an aerial survey",
            ),
            (None, None) => {
                (SceneType::ForwardFacing, "images are opaque, so they show a background, and all cameras look ahead")
            }
        };
        let Layout { middle, inner, looks } = Layout::new(&cameras, &depths, &points);
        let sideways = if is_sideways(&cameras) { "; all images are on their side" } else { "" };
        let reason = format!("{reason}; {looks}{sideways}");
        let distance = median(cameras.iter().map(|camera| camera.pose.translation.distance(middle)));
        if !(distance > 1e-9 * (1.0 + middle.length())) {
            let (count, total) = (cameras.len(), capture.views.len());
            let absent = capture.views.iter().find(|view| view.image.is_none());
            if let Some(absent) = absent.filter(|_| 2 * count < total) {
                let what = format!(
                    "only {count} of {total} images exist, all from one place (the first absent one is `{}`); correct \
                     the paths or copy the images there",
                    absent.name
                );
                return Err(Error::field(&capture.file, &absent.field, what));
            }
            let what = format!(
                "has all cameras in one place, so the scene has no scale: check the last columns of the matrices; \
                 `raygrad doctor {}` finds world-to-camera matrices and other conventions",
                capture.folder.display()
            );
            return Err(Error::file(&capture.file, what));
        }
        let rotation = upright(&cameras);
        let half = match scene_type {
            SceneType::Bounded => half_width(&cameras, middle).min(clearance(&cameras, middle, rotation)),
            SceneType::Unbounded | SceneType::ForwardFacing => inner,
        };
        let transform = SceneTransform { rotation, scale: HALF_BOX / half, origin: middle };
        let [near, far] = match scene_type {
            SceneType::Bounded => around_box(cameras.iter().map(|c| transform.point(c.pose.translation)), BOX),
            SceneType::Unbounded | SceneType::ForwardFacing => {
                let given = depths.iter().map(|(_, [near, _])| *near).reduce(f64::min);
                let near = given.or_else(|| nearest_point(&cameras, &points));
                let near = near.map_or(NEAR_SHARE * distance, |near| 0.5 * near);
                [near.min(0.5 * distance), FAR_SIDES * 2.0 * half].map(|length| length * transform.scale)
            }
        };
        let ndc = match scene_type {
            SceneType::ForwardFacing => {
                let placed: Vec<Camera> = cameras.iter().map(|camera| transform.camera(camera)).collect();
                Some(Ndc::around(&placed, near)?)
            }
            SceneType::Bounded | SceneType::Unbounded => None,
        };
        Ok(SceneAnalysis { transform, scene_type, bounds: BOX, near, far, ndc, empty, hollow: false, reason })
    }
}

impl Capture {
    /// Returns the images that exist.
    pub fn present(&self) -> impl Iterator<Item = &View> {
        self.views.iter().filter(|view| view.image.is_some())
    }
}

/// Returns true if the cameras are around the origin like those of the NeRF-synthetic scenes, and look at it.
fn conventional(cameras: &[&Camera]) -> bool {
    let [least, most] = CONVENTION;
    cameras.iter().all(|camera| {
        let eye = camera.pose.translation;
        let looks = -camera.pose.matrix3.z_axis;
        (least..most).contains(&eye.length()) && looks.dot(-eye.normalize()) > 0.7
    })
}

/// The near and far plane of a bounded scene: the distances between which rays from the eyes, in any direction, can be in
/// the box. Near is at least a share of the usual distance, also if an eye is inside.
fn around_box(eyes: impl Iterator<Item = DVec3>, [low, high]: [DVec3; 2]) -> [f64; 2] {
    let eyes: Vec<DVec3> = eyes.collect();
    let [near, far] = eyes.iter().fold([f64::INFINITY, 0.0], |[near, far], &eye| {
        let corner = (eye - low).abs().max((eye - high).abs());
        [near.min(eye.distance(eye.clamp(low, high))), far.max(corner.length())]
    });
    let usual = median(eyes.iter().map(|eye| eye.distance(0.5 * (low + high))));
    [((1.0 - MARGIN) * near).max(LEAST_NEAR * usual), (1.0 + MARGIN) * far]
}

/// The position and size of the scene, from the cameras' arrangement.
struct Layout {
    middle: DVec3,
    /// Half of the box of an unbounded scene.
    inner: f64,
    /// A short description of the arrangement.
    looks: &'static str,
}

impl Layout {
    /// `depths` are the nearest and farthest depths of the cameras with known ones, which count if they are at least
    /// half of all. `points` are a sample of the visible points.
    fn new(cameras: &[&Camera], depths: &[(&Camera, [f64; 2])], points: &[DVec3]) -> Self {
        let distances = |middle: DVec3| median(cameras.iter().map(|camera| camera.pose.translation.distance(middle)));
        let mean = average(cameras, |pose| pose.translation);
        let forward = average(cameras, |pose| -pose.matrix3.z_axis);
        let spread = distances(mean);
        let is_parallel = forward.length() > 0.8;
        if 2 * depths.len() >= cameras.len() {
            let middle = ahead(depths);
            // The box holds all of a flight, whose cameras may move farther than they look.
            let inner = (INNER_SHARE * distances(middle)).max(if is_parallel { spread } else { 0.0 });
            return Layout { middle, inner, looks: "depths give its position" };
        }
        if let Some(middle) = middle(cameras) {
            return Layout { middle, inner: INNER_SHARE * distances(middle), looks: "cameras look at one place" };
        }
        let known = points.len() >= FEWEST;
        if is_parallel {
            let forward = forward.normalize();
            let depth = known.then(|| median(points.iter().map(|point| (*point - mean).dot(forward))));
            let middle = mean + depth.filter(|depth| *depth > 0.0).unwrap_or(AHEAD * spread) * forward;
            let inner = (INNER_SHARE * distances(middle)).max(spread);
            return Layout { middle, inner, looks: "cameras look the same way" };
        }
        let seen = known.then(|| median(points.iter().map(|point| point.distance(mean))));
        Layout { middle: mean, inner: seen.unwrap_or(AROUND * spread).max(spread), looks: "cameras look around" }
    }
}

/// The centre of the cameras' views: the least-squares point nearest to their optical axes. `None` if they do not look
/// at one place, as in a room or along a wall.
fn middle(cameras: &[&Camera]) -> Option<DVec3> {
    let mean = average(cameras, |pose| pose.translation);
    let spread = cameras.iter().map(|camera| camera.pose.translation.distance(mean)).fold(0.0, f64::max);
    let mut weights = vec![1.0; cameras.len()];
    let mut found = mean;
    // Outliers must not move the centre: weights fall with the distance of an axis.
    for _ in 0..ROUNDS {
        let (matrix, sum) = axes(cameras.iter().map(|camera| &camera.pose).zip(weights.iter().copied()), mean);
        // Nearly parallel axes have no well-defined intersection; damping keeps the solution near the cameras.
        let damping = DMat3::from_diagonal(DVec3::splat(1e-3 * weights.iter().sum::<f64>()));
        found = mean + (matrix + damping).inverse() * sum;
        let passes = passes_at(found);
        let usual = median(cameras.iter().map(&passes)).max(1e-2 * spread);
        weights = cameras.iter().map(|camera| 1.0 / (1.0 + (passes(camera) / (3.0 * usual)).powi(2))).collect();
    }
    let passes = passes_at(found);
    let ahead = |camera: &&&Camera| (found - camera.pose.translation).dot(-camera.pose.matrix3.z_axis) > 0.0;
    let most = 4 * cameras.iter().filter(ahead).count() > 3 * cameras.len();
    // The axes must converge there: nearly parallel ones may come close by chance.
    let together =
        2.0 * median(cameras.iter().map(&passes)) < median(cameras.iter().map(|c| c.pose.translation.distance(mean)));
    (most && together && found.is_finite() && found.distance(mean) < 100.0 * spread).then_some(found)
}

/// The distance of a camera's optical axis from a point.
fn passes_at(place: DVec3) -> impl Fn(&&Camera) -> f64 {
    move |camera| (across(&camera.pose) * (place - camera.pose.translation)).length()
}

/// The mean of a property of the poses.
fn average(cameras: &[&Camera], of: fn(&DAffine3) -> DVec3) -> DVec3 {
    mean(cameras.iter().map(|camera| of(&camera.pose)))
}

/// The centre of the scene for cameras with known near and far depths: halfway in inverse depth along the axes.
fn ahead(depths: &[(&Camera, [f64; 2])]) -> DVec3 {
    mean(
        depths
            .iter()
            .map(|(camera, depths)| camera.pose.translation - camera.pose.matrix3.z_axis * middle_depth(*depths)),
    )
}

/// Halfway in inverse depth.
fn middle_depth([near, far]: [f64; 2]) -> f64 {
    2.0 / (1.0 / near + 1.0 / far)
}

/// The least length of the mean of axes that are nearly parallel.
const PARALLEL: f64 = 0.7;
/// By how much it must exceed that of the other axes.
const MORE_PARALLEL: f64 = 0.05;

/// Returns true if the images lie on their side, such as portraits that are stored in landscape: their x axes are nearly
/// parallel, and more so than their y axes.
///
/// That is never so for cameras with level x axes and one pitch: the mean of their y axes is at least as long.
fn is_sideways(cameras: &[&Camera]) -> bool {
    let [x, y] = [|pose: &DAffine3| pose.matrix3.x_axis, |pose: &DAffine3| pose.matrix3.y_axis]
        .map(|axis| average(cameras, axis).length());
    x > PARALLEL && y < x - MORE_PARALLEL
}

/// A rotation that turns up to z. People hold cameras level or on their side, so up is perpendicular to the horizontal
/// axes of all (their least principal axis). It is on the side of the cameras' up axes. Of images on their side, it is on
/// the side from which the cameras look down, or else to the left, as phones store portraits.
fn upright(cameras: &[&Camera]) -> DMat3 {
    let is_sideways = is_sideways(cameras);
    let mean = match is_sideways {
        true => -average(cameras, |pose| pose.matrix3.x_axis),
        false => average(cameras, |pose| pose.matrix3.y_axis),
    };
    let mut spread = DMat3::from_diagonal(DVec3::splat(1e-4));
    for camera in cameras {
        let axes = &camera.pose.matrix3;
        spread += outer(if is_sideways { axes.y_axis } else { axes.x_axis }) * (1.0 / cameras.len() as f64);
    }
    let inverse = spread.inverse();
    let mut up = if mean.length() > 1e-3 { mean.normalize() } else { DVec3::Z };
    for _ in 0..64 {
        up = (inverse * up).normalize();
    }
    if !up.is_finite() {
        return DMat3::IDENTITY;
    }
    // Cameras that look straight down have no common up axis; the direction opposite to their views is up.
    let back = average(cameras, |pose| pose.matrix3.z_axis);
    let sides = [up.dot(mean), up.dot(back)];
    let [first, second] = if is_sideways { [sides[1], sides[0]] } else { sides };
    let side = if first.abs() > 0.1 { first } else { second };
    let up = if side < 0.0 { -up } else { up };
    // The shortest rotation leaves an upright capture unchanged.
    DMat3::from_quat(glam::DQuat::from_rotation_arc(up, DVec3::Z))
}

/// Half of the width of the cameras' views at the centre of the scene.
fn half_width(cameras: &[&Camera], middle: DVec3) -> f64 {
    median(cameras.iter().map(|camera| {
        let [x, y] = [0, 1].map(|axis| {
            let size = [camera.width, camera.height][axis] as f64;
            0.5 * size / camera.focal[axis]
        });
        camera.pose.translation.distance(middle) * x.max(y).min(1.0)
    }))
}

/// The half width of a cube around the centre of the scene that leaves out cameras at the usual distance in nearly all
/// directions: with a wide lens, their views are wider than that.
fn clearance(cameras: &[&Camera], middle: DVec3, rotation: DMat3) -> f64 {
    /// The share of the directions whose cameras may be inside, and of the distance to them that the cube takes.
    const SHARES: [f64; 2] = [0.05, 0.95];
    let offsets = cameras.iter().map(|camera| rotation * (camera.pose.translation - middle));
    let offsets: Vec<DVec3> = offsets.filter(|offset| *offset != DVec3::ZERO).collect();
    let mut sides: Vec<f64> = offsets.iter().map(|offset| offset.normalize().abs().max_element()).collect();
    sides.sort_by(f64::total_cmp);
    let side = sides.get((SHARES[0] * sides.len() as f64) as usize).copied().unwrap_or(f64::INFINITY);
    SHARES[1] * side * median(offsets.iter().map(|offset| offset.length()))
}

/// The most cameras and points that are used; more would not change the result.
const ASKED: [usize; 2] = [64, 20_000];
/// The fewest points that are used.
const FEWEST: usize = 100;

/// The share of the images that show a point, averaged over the points of each image: the mean overlap of two images.
/// Without points it takes the middle depths of the images; `None` without either.
fn overlap(cameras: &[&Camera], depths: &[(&Camera, [f64; 2])], points: &[DVec3]) -> Option<f64> {
    /// Places along each side of an image.
    const PLACES: usize = 8;
    let sample = evenly_spaced((0..cameras.len()).collect(), ASKED[0]);
    let at_depth = |(camera, depths): (&Camera, [f64; 2])| -> Vec<DVec3> {
        let depth = middle_depth(depths);
        let place = |i: usize, side: usize| (i as f64 + 0.5) / PLACES as f64 * side as f64;
        let point = |i: usize| {
            let ray = camera.ray(place(i % PLACES, camera.width), place(i / PLACES, camera.height));
            ray.at(depth / ray.direction.dot(-camera.pose.matrix3.z_axis))
        };
        (0..PLACES * PLACES).map(point).collect()
    };
    let points: Vec<DVec3> = match points.len() >= FEWEST {
        true => points.to_vec(),
        false if 2 * depths.len() >= cameras.len() => {
            evenly_spaced(depths.to_vec(), ASKED[0]).into_iter().flat_map(at_depth).collect()
        }
        false => return None,
    };
    let shown = |i: usize| sample.iter().filter(|number| cameras[**number].shows(points[i])).count() as f64;
    let counts = parallel::collect(points.len(), shown);
    let sum: f64 = counts.iter().sum();
    (sum > 0.0).then(|| counts.iter().map(|count| count * count).sum::<f64>() / (sum * sample.len() as f64))
}

/// A sample of the reliable points.
fn trusted(points: &[Point]) -> Vec<DVec3> {
    /// The fewest images and the largest reprojection error, in pixels, of a reliable point.
    const TRUSTED: (u32, f64) = (3, 2.0);
    // Some files do not count the images of a point.
    let trusted = |p: &&Point| (p.views == 0 || p.views >= TRUSTED.0) && !(p.error > TRUSTED.1);
    evenly_spaced(points.iter().filter(trusted).map(|p| p.position).collect(), ASKED[1])
}

/// The distance of the nearest points from the cameras that see them; `None` if too few are reliable.
fn nearest_point(cameras: &[&Camera], trusted: &[DVec3]) -> Option<f64> {
    if trusted.len() < FEWEST {
        return None;
    }
    let nearest = |camera: &Camera| {
        let seen = trusted.iter().filter(|point| camera.shows(**point));
        let mut depths: Vec<f64> = seen.map(|point| point.distance(camera.pose.translation)).collect();
        depths.sort_by(f64::total_cmp);
        // The nearest of every two hundred is skipped: a few are always wrong.
        depths.get(depths.len() / 200).copied()
    };
    let asked = evenly_spaced(cameras.to_vec(), ASKED[0]);
    let nearest = parallel::collect(asked.len(), |i| nearest(asked[i]));
    let mut nearest: Vec<f64> = nearest.into_iter().flatten().collect();
    nearest.sort_by(f64::total_cmp);
    nearest.get(nearest.len() / 20).copied()
}

#[cfg(test)]
mod tests;
