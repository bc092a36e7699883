//! Pose conventions, and the point that cameras look at under each.

use crate::camera::axes::axes;
use crate::numbers::{eigen, mean, median, outer};
use glam::{DAffine3, DMat3, DVec3};

/// A possible convention of a capture's matrices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Convention {
    /// As read: camera-to-world, where the camera looks along its -z with y up (OpenGL).
    AsRead,
    /// The camera looks along its +z with y down (OpenCV).
    OpenCv,
    /// The camera is upside down, as its image is if only one of them was turned.
    UpsideDown,
    /// The camera looks along its +z with x to the left (Mitsuba).
    Mitsuba,
    /// World-to-camera.
    WorldToCamera,
    /// World-to-camera, where the camera looks along its +z with y down, as COLMAP stores them.
    WorldToOpenCv,
    /// The world and the cameras are mirrored from side to side.
    Mirrored,
    /// The same, and the cameras are upside down.
    MirroredUpsideDown,
    /// The same, and the cameras look the other way.
    MirroredBackwards,
}

impl Convention {
    /// All of them.
    pub const ALL: [Convention; 9] = [
        Convention::AsRead,
        Convention::OpenCv,
        Convention::UpsideDown,
        Convention::Mitsuba,
        Convention::WorldToCamera,
        Convention::WorldToOpenCv,
        Convention::Mirrored,
        Convention::MirroredUpsideDown,
        Convention::MirroredBackwards,
    ];

    /// Reinterprets a pose under this convention.
    pub fn apply(self, pose: DAffine3) -> DAffine3 {
        let turned = |pose: DAffine3, axes: DVec3| DAffine3 {
            matrix3: pose.matrix3 * DMat3::from_diagonal(axes),
            translation: pose.translation,
        };
        let inverse = || {
            let matrix3 = pose.matrix3.transpose();
            DAffine3 { matrix3, translation: -(matrix3 * pose.translation) }
        };
        let mirror = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0));
        let mirrored = || DAffine3 { matrix3: mirror * pose.matrix3, translation: mirror * pose.translation };
        match self {
            Convention::AsRead => pose,
            Convention::OpenCv => turned(pose, DVec3::new(1.0, -1.0, -1.0)),
            Convention::UpsideDown => turned(pose, DVec3::new(-1.0, -1.0, 1.0)),
            Convention::Mitsuba => turned(pose, DVec3::new(-1.0, 1.0, -1.0)),
            Convention::WorldToCamera => inverse(),
            Convention::WorldToOpenCv => turned(inverse(), DVec3::new(1.0, -1.0, -1.0)),
            Convention::Mirrored => turned(mirrored(), DVec3::new(-1.0, 1.0, 1.0)),
            Convention::MirroredUpsideDown => turned(mirrored(), DVec3::new(1.0, -1.0, 1.0)),
            Convention::MirroredBackwards => turned(mirrored(), DVec3::new(1.0, 1.0, -1.0)),
        }
    }
}

/// The point that the cameras look at.
#[derive(Debug, Clone, Copy)]
pub(super) struct Focus {
    /// The least-squares point nearest to all optical axes.
    pub place: DVec3,
    /// The median distance of the axes from it, as a share of the cameras' distance.
    pub miss: f64,
    /// The share of the cameras that have it before them.
    pub ahead: f64,
    /// The median distance of the cameras from it.
    pub distance: f64,
}

impl Focus {
    /// The focus of poses in OpenGL's axes; `None` if there are fewer than two or the axes are parallel.
    pub fn of(poses: &[DAffine3]) -> Option<Focus> {
        let count = poses.len() as f64;
        let mean = mean(poses.iter().map(|pose| pose.translation));
        let (matrix, sum) = axes(poses.iter().map(|pose| (pose, 1.0)), mean);
        // Axes that differ by less than about 3 degrees have no well-defined intersection.
        if poses.len() < 2 || !(matrix.determinant() > 1e-3 * count.powi(3)) {
            return None;
        }
        let place = mean + matrix.inverse() * sum;
        let offsets = || poses.iter().map(|pose| (place - pose.translation, -pose.matrix3.z_axis));
        let distance = median(offsets().map(|(offset, _)| offset.length()));
        let miss = median(offsets().map(|(offset, axis)| offset.reject_from_normalized(axis).length()));
        let ahead = offsets().filter(|(offset, axis)| offset.dot(*axis) > 0.0).count() as f64 / count;
        Some(Focus { place, miss: miss / distance.max(f64::MIN_POSITIVE), ahead, distance })
    }

    /// Returns true if the cameras clearly surround one place and look at it.
    pub fn is_inward(&self) -> bool {
        self.ahead > 0.9 && self.miss < 0.3
    }
}

/// The root mean square distances of points from their mean along the principal axes, the largest first.
pub(super) fn extents(places: &[DVec3]) -> [f64; 3] {
    let mean = mean(places.iter().copied());
    let mut scatter = DMat3::ZERO;
    places.iter().for_each(|place| scatter += outer(*place - mean) * (1.0 / places.len() as f64));
    eigen(scatter.to_cols_array_2d()).0.map(|square| square.max(0.0).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::dataset::sample::cameras_around;

    #[test]
    fn conventions_are_their_own_inverse() {
        let pose = Camera::look_at(DVec3::new(1.0, 2.0, 3.0), DVec3::new(0.3, -0.2, 0.1), DVec3::Z);
        let undo = |convention: Convention| match convention {
            Convention::WorldToOpenCv => {
                Convention::WorldToCamera.apply(Convention::OpenCv.apply(convention.apply(pose)))
            }
            other => other.apply(other.apply(pose)),
        };
        for convention in Convention::ALL {
            assert!((convention.apply(pose).matrix3.determinant() - 1.0).abs() < 1e-12, "{convention:?}");
            assert!(undo(convention).abs_diff_eq(pose, 1e-12), "{convention:?}");
        }
    }

    #[test]
    fn cameras_around_subject_look_at_it_flipped_away() {
        let poses: Vec<DAffine3> = cameras_around(20, 8).into_iter().map(|camera| camera.pose).collect();
        let focus = Focus::of(&poses).unwrap();
        assert!(focus.place.length() < 1e-9 && (focus.distance - 4.0).abs() < 1e-9 && focus.is_inward());
        let flipped: Vec<DAffine3> = poses.iter().map(|pose| Convention::OpenCv.apply(*pose)).collect();
        assert_eq!(Focus::of(&flipped).unwrap().ahead, 0.0);
        assert!(Focus::of(&poses[..1]).is_none() && Focus::of(&[poses[0]; 5]).is_none());
    }

    #[test]
    fn extents_of_a_box_and_of_a_line() {
        let corners =
            (0..8).map(|i| DVec3::new(f64::from(i & 1) * 6.0, f64::from(i >> 1 & 1) * 4.0, f64::from(i >> 2) * 2.0));
        let [a, b, c] = extents(&corners.collect::<Vec<_>>());
        assert!((a - 3.0).abs() < 1e-6 && (b - 2.0).abs() < 1e-6 && (c - 1.0).abs() < 1e-6, "{a} {b} {c}");
        let line: Vec<DVec3> = (0..5).map(|i| DVec3::new(1.0, 2.0, -1.0) * f64::from(i)).collect();
        assert!(extents(&line)[1] < 1e-6 && extents(&[DVec3::ONE; 3]) == [0.0; 3]);
    }
}
