//! Cameras of renders: orbits like the training cameras, and views at other image sizes.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use glam::DVec3;
use raygrad::nerf::dataset::Dataset;
use raygrad::nerf::{Camera, Error, Result, SceneBox};
use serde::{Deserialize, Serialize};

use super::memory::MOST_PIXELS;

/// The average training camera, which allows orbits without the images.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Viewpoint {
    /// Width of the training images. Unit: pixels. Range: 1 to 65536.
    pub width: usize,
    /// Height of the training images. Unit: pixels. Range: 1 to 65536, and at most 2^28 pixels with `width`.
    pub height: usize,
    /// Horizontal field of view. Unit: radians. Range: more than 0 and less than pi.
    pub angle_x: f64,
    /// Mean distance of the cameras from the centre of the scene box. Unit: scene units. Range: 0 or more.
    pub distance: f64,
    /// Mean angle of the cameras above the horizon, seen from that centre. Unit: radians. Range: between -pi/2 and
    /// pi/2.
    pub elevation: f64,
    /// Mean direction of the cameras about the vertical, where they stand in a part of the circle. Unit: radians.
    #[serde(default)]
    pub azimuth: f64,
    /// Angle that the cameras cover on either side of `azimuth`; pi where they stand all around. Unit: radians.
    /// Range: 0 to pi.
    #[serde(default = "all_around")]
    pub reach: f64,
}

fn all_around() -> f64 {
    PI
}

/// Largest gap in radians between the directions of cameras that surround the scene.
const GAP: f64 = 2.0 * PI / 3.0;

/// Within this angle of a pole, in radians, the up direction is ambiguous.
const FROM_POLE: f64 = 0.1;

/// Cameras within this distance of the centre, as a fraction of the box's side, look outwards.
const FROM_CENTRE: f64 = 0.02;

/// Largest side of a training image in pixels. Larger values come from damaged files.
const LARGEST: usize = 1 << 16;

impl Viewpoint {
    /// The average of a dataset's cameras. The dataset is not empty.
    pub fn of(data: &Dataset) -> Self {
        let camera = &data.frames[0].camera;
        let count = data.frames.len() as f64;
        let centre = 0.5 * (data.bounds[0] + data.bounds[1]);
        let offsets = || data.frames.iter().map(|frame| frame.camera.pose.translation - centre);
        let elevation = offsets().map(|offset| offset.z.atan2(offset.truncate().length())).sum::<f64>() / count;
        let (azimuth, reach) = arc(offsets().map(|offset| offset.y.atan2(offset.x)).collect());
        Viewpoint {
            azimuth,
            reach,
            width: camera.width,
            height: camera.height,
            angle_x: 2.0 * (0.5 * camera.width as f64 / camera.focal[0]).atan(),
            distance: offsets().map(DVec3::length).sum::<f64>() / count,
            elevation: elevation.clamp(FROM_POLE - FRAC_PI_2, FRAC_PI_2 - FROM_POLE),
        }
    }

    /// Fails if a number is out of range.
    pub fn check(&self) -> Result<()> {
        let positive = |x: f64| x > 0.0 && x.is_finite();
        let checks = [
            ("viewpoint.width", self.width as f64, (1..=LARGEST).contains(&self.width), "1 to 65536"),
            ("viewpoint.height", self.height as f64, (1..=LARGEST).contains(&self.height), "1 to 65536"),
            (
                "viewpoint.height",
                self.height as f64,
                self.width.saturating_mul(self.height) <= MOST_PIXELS,
                "at most 2^28 pixels with `width`",
            ),
            (
                "viewpoint.angle_x",
                self.angle_x,
                positive(self.angle_x) && self.angle_x < PI,
                "more than 0 and less than pi",
            ),
            ("viewpoint.distance", self.distance, self.distance >= 0.0 && self.distance.is_finite(), "0 or more"),
            ("viewpoint.elevation", self.elevation, self.elevation.abs() < FRAC_PI_2, "between -pi/2 and pi/2"),
            ("viewpoint.azimuth", self.azimuth, self.azimuth.is_finite(), "a finite angle"),
            ("viewpoint.reach", self.reach, (0.0..=PI).contains(&self.reach), "0 to pi"),
        ];
        match checks.iter().find(|(_, _, good, _)| !good) {
            Some((name, value, _, range)) => Err(Error::setting(name, format!("is {value}; use {range}"))),
            None => Ok(()),
        }
    }

    /// Returns `count` cameras on a circle around the centre of the box. All of them look at it, with z upwards. If the
    /// images cover a part of the circle, the cameras swing to and fro on that part. The cameras of a panorama stand at
    /// the centre and look around.
    pub fn orbit(&self, extent: &SceneBox, count: usize) -> Vec<Camera> {
        let centre = 0.5 * (extent.bounds[0] + extent.bounds[1]);
        let camera = |i: usize| {
            let outwards = self.distance <= FROM_CENTRE * extent.space().side();
            let turn = i as f64 / count as f64 * TAU;
            let swings = self.reach < PI && !outwards;
            let (sin, cos) = if swings { self.azimuth + self.reach * turn.sin() } else { turn }.sin_cos();
            let (height, radius) = self.elevation.sin_cos();
            let eye = centre + self.distance * DVec3::new(radius * cos, radius * sin, height);
            let target = if outwards { centre + DVec3::new(radius * cos, radius * sin, height) } else { centre };
            let pose = Camera::look_at(if outwards { centre } else { eye }, target, DVec3::Z);
            Camera::from_angle(self.width, self.height, self.angle_x, pose)
        };
        (0..count).map(camera).collect()
    }
}

/// Middle and half width of the arc of these angles; half a turn if there is no large gap.
fn arc(mut angles: Vec<f64>) -> (f64, f64) {
    angles.sort_by(f64::total_cmp);
    let next = angles.iter().skip(1).copied().chain(angles.first().map(|first| first + TAU));
    let gaps = angles.iter().zip(next).map(|(from, to)| [*from, to]);
    match gaps.max_by(|a, b| (a[1] - a[0]).total_cmp(&(b[1] - b[0]))) {
        Some([from, to]) if to - from > GAP => (0.5 * (from + to) + PI, (PI - 0.5 * (to - from)).max(0.0)),
        _ => (0.0, PI),
    }
}

/// Fits a camera to another image size. The whole original view remains visible and pixels keep their shape. A
/// relatively longer side shows more.
pub fn fitted(camera: &Camera, [width, height]: [usize; 2]) -> Camera {
    let old = [camera.width as f64, camera.height as f64];
    let new = [width as f64, height as f64];
    let scale = (new[0] / old[0]).min(new[1] / old[1]);
    let centre = |axis: usize| 0.5 * new[axis] + scale * (camera.centre[axis] - 0.5 * old[axis]);
    Camera { width, height, focal: camera.focal.map(|f| f * scale), centre: [centre(0), centre(1)], ..*camera }
}

#[cfg(test)]
mod tests {
    #[test]
    fn orbit_of_panorama_looks_outwards() {
        let viewpoint =
            Viewpoint { width: 40, height: 30, angle_x: 1.0, distance: 0.0, elevation: 0.0, azimuth: 0.3, reach: 0.2 };
        viewpoint.check().unwrap();
        let extent = SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [0.0, 4.0]);
        let cameras = viewpoint.orbit(&extent, 4);
        let looks: Vec<DVec3> = cameras.iter().map(|camera| camera.ray(20.0, 15.0).direction).collect();
        for (look, expected) in looks.iter().zip([DVec3::X, DVec3::Y, DVec3::NEG_X, DVec3::NEG_Y]) {
            assert!(look.distance(expected) < 1e-12, "{look}");
        }
        assert!(cameras.iter().all(|camera| camera.pose.translation == DVec3::ZERO));
    }

    use super::*;
    use raygrad::nerf::dataset::Split;
    use raygrad_scenes::embedded;

    fn viewpoint() -> (Viewpoint, SceneBox) {
        let data = embedded(Split::Test, 8);
        (Viewpoint::of(&data), SceneBox::new(data.bounds, [data.near, data.far]))
    }

    #[test]
    fn orbit_keeps_distance_elevation_and_angle() {
        let (view, extent) = viewpoint();
        let centre = 0.5 * (extent.bounds[0] + extent.bounds[1]);
        for camera in view.orbit(&extent, 7) {
            let offset = camera.pose.translation - centre;
            assert!((offset.length() - view.distance).abs() < 1e-12);
            assert!((offset.z - view.distance * view.elevation.sin()).abs() < 1e-12);
            assert!(camera.ray(4.0, 4.0).at(view.distance).distance(centre) < 1e-12);
        }
        assert!((view.angle_x - raygrad_scenes::ANGLE_X).abs() < 1e-12);
        view.check().unwrap();
    }

    #[test]
    fn mean_camera_equals_values_by_hand() {
        // Around (1, 2, 3): above, above and below it.
        let offsets = [DVec3::new(3.0, 0.0, 4.0), DVec3::new(0.0, -12.0, 5.0), DVec3::new(-8.0, 0.0, -6.0)];
        let mut data = embedded(Split::Test, 8);
        data.bounds = [DVec3::ZERO, DVec3::new(2.0, 4.0, 6.0)];
        data.frames.truncate(3);
        for (frame, offset) in data.frames.iter_mut().zip(offsets) {
            let pose = Camera::look_at(DVec3::new(1.0, 2.0, 3.0) + offset, DVec3::new(1.0, 2.0, 3.0), DVec3::Z);
            frame.camera = Camera { focal: [50.0, 25.0], ..Camera::from_angle(40, 30, 1.0, pose) };
        }
        let view = Viewpoint::of(&data);
        assert_eq!([view.width, view.height], [40, 30]);
        // 2 atan(20 / 50); (5 + 13 + 10) / 3; the mean of asin(4 / 5), asin(5 / 13) and -asin(3 / 5). All stand in the
        // half of the circle about -y.
        for (name, value, expected) in [
            ("angle_x", view.angle_x, 0.761_012_754_224_729_8),
            ("distance", view.distance, 9.333_333_333_333_334),
            ("elevation", view.elevation, 0.226_195_076_302_696_43),
            ("azimuth", view.azimuth, 1.5 * PI),
            ("reach", view.reach, 0.5 * PI),
        ] {
            assert!((value - expected).abs() < 1e-12, "{name}: {value} {expected}");
        }
        let up = data.frames[0].camera.pose.translation + DVec3::Z;
        data.bounds = [up - DVec3::new(1.0, 1.0, 9.0), up + DVec3::new(1.0, 1.0, -7.0)];
        data.frames.truncate(1);
        assert!((Viewpoint::of(&data).elevation - 1.470_796_326_794_896_6).abs() < 1e-9, "0.1 from the pole");
    }

    #[test]
    fn orbit_cameras_equal_values_by_hand() {
        let (angle_x, elevation) = (0.761_012_754_224_729_8, 0.643_501_108_793_284_4);
        let view = Viewpoint { width: 40, height: 30, angle_x, distance: 10.0, elevation, azimuth: 0.0, reach: PI };
        let extent = SceneBox::new([DVec3::ZERO, DVec3::new(2.0, 4.0, 6.0)], [0.5, 9.0]);
        let cameras = view.orbit(&extent, 4);
        let eyes = [[9.0, 2.0, 9.0], [1.0, 10.0, 9.0], [-7.0, 2.0, 9.0], [1.0, -6.0, 9.0]];
        assert_eq!(cameras.len(), 4);
        for (camera, eye) in cameras.iter().zip(eyes) {
            assert!(camera.pose.translation.distance(eye.into()) < 1e-12, "{camera:?}");
            assert_eq!(([camera.width, camera.height], camera.centre), ([40, 30], [20.0, 15.0]));
            assert!(camera.focal.iter().all(|focal| (focal - 50.0).abs() < 1e-9), "{camera:?}");
            let look = (DVec3::new(1.0, 2.0, 3.0) - DVec3::from(eye)) / 10.0;
            assert!(camera.ray(20.0, 15.0).direction.distance(look) < 1e-12, "{camera:?}");
        }
        // The middle of the upper border, 15 / 50 above the axis: (-0.8, 0, -0.6) + 0.3 (-0.6, 0, 0.8).
        let up = DVec3::new(-0.98, 0.0, -0.36).normalize();
        assert!(cameras[0].ray(20.0, 0.0).direction.distance(up) < 1e-9, "{:?}", cameras[0].ray(20.0, 0.0));
    }

    #[test]
    fn one_sided_images_are_known_by_direction() {
        let mut data = embedded(Split::Train, 8);
        let centre = 0.5 * (data.bounds[0] + data.bounds[1]);
        // Within 40 degrees of the y axis.
        data.frames.retain(|frame| {
            let offset = frame.camera.pose.translation - centre;
            offset.y > 0.0 && offset.x.abs() < 0.8 * offset.y
        });
        assert!(data.frames.len() > 5);
        let view = Viewpoint::of(&data);
        assert!((view.azimuth.rem_euclid(TAU) - FRAC_PI_2).abs() < 0.3 && (0.3..0.9).contains(&view.reach), "{view:?}");
    }

    #[test]
    fn orbit_one_sided_swings_on_the_arc() {
        assert_eq!(viewpoint().0.reach, PI, "they are from all around");
        assert_eq!(arc((0..4).map(|i| f64::from(i) * FRAC_PI_2).collect()), (0.0, PI));
        // An arc across the discontinuity of the angle.
        let (middle, half) = arc(vec![3.0, -3.0, 2.5, -2.8]);
        let ends = [2.5, TAU - 2.8];
        assert!((half - 0.5 * (ends[1] - ends[0])).abs() < 1e-12, "{half}");
        assert!((middle - 0.5 * (ends[0] + ends[1])).rem_euclid(TAU).min(TAU - 1e-9) < 1e-9, "{middle}");
        let (view, extent) = viewpoint();
        let view = Viewpoint { azimuth: 1.0, reach: 0.4, ..view };
        let centre = 0.5 * (extent.bounds[0] + extent.bounds[1]);
        let angles = view.orbit(&extent, 8).into_iter().map(|camera| {
            let offset = camera.pose.translation - centre;
            offset.y.atan2(offset.x)
        });
        for (angle, expected) in angles.zip([
            1.0,
            1.0 + 0.4 * 0.5_f64.sqrt(),
            1.4,
            1.0 + 0.4 * 0.5_f64.sqrt(),
            1.0,
            1.0 - 0.4 * 0.5_f64.sqrt(),
            0.6,
        ]) {
            assert!((angle - expected).abs() < 1e-12, "{angle} {expected}");
        }
    }

    #[test]
    fn fitted_view_keeps_the_original_rays() {
        let (view, extent) = viewpoint();
        let camera = &view.orbit(&extent, 1)[0];
        assert_eq!(fitted(camera, [8, 8]), *camera);
        let wide = fitted(camera, [32, 16]);
        // The central square of the wide image is the original image.
        for (x, y) in [(0.0, 0.0), (8.0, 0.0), (3.0, 5.0)] {
            let (old, new) = (camera.ray(x, y), wide.ray(8.0 + 2.0 * x, 2.0 * y));
            assert!(old.direction.distance(new.direction) < 1e-12);
        }
    }

    #[test]
    fn viewpoint_out_of_range_is_refused() {
        let (view, _) = viewpoint();
        let message = Viewpoint { distance: -1.0, ..view }.check().unwrap_err().to_string();
        assert_eq!(message, "`viewpoint.distance`: is -1; use 0 or more");
    }
}
