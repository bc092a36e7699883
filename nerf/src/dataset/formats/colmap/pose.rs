//! Poses between COLMAP's form and that of cameras here.

use glam::{DAffine3, DMat3, DQuat, DVec3, DVec4};

/// The rotation of a quaternion of any length with the real part first; `None` if the length is 0.
fn rotation(q: [f64; 4]) -> Option<DMat3> {
    let q = DVec4::from_array(q);
    // Scaled to a maximum of 1 first, so that squares do not underflow.
    let largest = q.abs().max_element();
    let [w, x, y, z] = (largest > 0.0).then(|| (q / largest).normalize().to_array())?;
    Some(DMat3::from_quat(DQuat::from_xyzw(x, y, z, w)))
}

/// The pose of an image; as an error, the wrong member and a message.
pub(super) fn from_file(q: [f64; 4], t: [f64; 3]) -> Result<DAffine3, (&'static str, String)> {
    for (member, values) in [("qvec", &q[..]), ("tvec", &t)] {
        if let Some(value) = values.iter().find(|value| !value.is_finite()) {
            return Err((member, format!("must be a finite number, is {value}")));
        }
    }
    let Some(to_camera) = rotation(q) else {
        return Err(("qvec", "is a quaternion of length 0; use one of length 1".into()));
    };
    let to_world = to_camera.transpose();
    let translation = -(to_world * DVec3::from_array(t));
    if !translation.is_finite() {
        return Err(("tvec", format!("is too large: {t:?}")));
    }
    // From COLMAP's image axes, `y` down and `z` into the scene, to OpenGL's.
    let matrix3 = DMat3::from_cols(to_world.x_axis, -to_world.y_axis, -to_world.z_axis);
    Ok(DAffine3 { matrix3, translation })
}

/// COLMAP's quaternion and translation of a pose. The real part comes first and is not negative.
pub(super) fn to_file(pose: &DAffine3) -> ([f64; 4], [f64; 3]) {
    let DMat3 { x_axis, y_axis, z_axis } = pose.matrix3;
    let q = DQuat::from_mat3(&DMat3::from_cols(x_axis, -y_axis, -z_axis).transpose()).normalize();
    let q = if q.w < 0.0 { -q } else { q };
    let q = [q.w, q.x, q.y, q.z];
    // Readers use the rounded quaternion, so the translation must too: otherwise the camera would move.
    let to_camera = rotation(q).unwrap_or(DMat3::IDENTITY);
    // Adding zero turns a negative zero into a positive one.
    (q, (DVec3::ZERO - to_camera * pose.translation).to_array())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Camera;
    use proptest::prelude::*;

    #[test]
    fn quarter_turn_has_colmaps_sense() {
        // By +90 degrees about z: the world's x is the camera's y, which is down in the image.
        let s = 0.5_f64.sqrt();
        let pose = from_file([s, 0.0, 0.0, s], [1.0, 2.0, 3.0]).unwrap();
        let near = |a: DVec3, b: [f64; 3]| assert!((a - DVec3::from_array(b)).length() < 1e-15, "{a}");
        // Right in the image is the camera's x, which is the world's -y.
        near(pose.matrix3.x_axis, [0.0, -1.0, 0.0]);
        near(pose.matrix3.y_axis, [-1.0, 0.0, 0.0]);
        near(pose.matrix3.z_axis, [0.0, 0.0, -1.0]);
        // R p + t = 0 for R p = (-p.y, p.x, p.z).
        near(pose.translation, [-2.0, 1.0, -3.0]);
    }

    #[test]
    fn quaternions_of_any_length_but_zero_are_read() {
        let pose = from_file([0.9, 0.1, -0.2, 0.3], [1.0, 2.0, 3.0]).unwrap();
        for scale in [1e-300, 1e-310, -1.0, 7.0, 1e300] {
            let other = from_file([0.9, 0.1, -0.2, 0.3].map(|x: f64| x * scale), [1.0, 2.0, 3.0]).unwrap();
            assert!(pose.abs_diff_eq(other, 1e-10), "{scale}");
        }
        assert_eq!(from_file([0.0, -0.0, 0.0, 0.0], [0.0; 3]).unwrap_err().0, "qvec");
        assert!(from_file([0.5; 4], [1.7e308; 3]).is_ok(), "which only changes the order of the three");
        assert_eq!(from_file([0.8, 0.6, 0.0, 0.0], [0.0, 1.7e308, 1.7e308]).unwrap_err().0, "tvec");
    }

    proptest! {
        #[test]
        fn poses_round_trip(
            q in prop::array::uniform4(-1.0..1.0_f64),
            eye in prop::array::uniform3(-1e3..1e3_f64),
        ) {
            prop_assume!(DVec4::from_array(q).length() > 0.1);
            let matrix3 = DMat3::from_quat(DQuat::from_array(q).normalize());
            let pose = DAffine3 { matrix3, translation: DVec3::from_array(eye) };
            let (q, t) = to_file(&pose);
            let again = from_file(q, t).unwrap();
            prop_assert!(again.matrix3.abs_diff_eq(pose.matrix3, 4e-15), "{:?} {:?}", pose, again);
            prop_assert!(again.translation.abs_diff_eq(pose.translation, 4e-15 * (1.0 + pose.translation.length())));
            // The viewing direction is unchanged: the camera's -z is COLMAP's +z.
            let ahead = again.translation - 2.0 * pose.matrix3.z_axis;
            let seen = DMat3::from_quat(DQuat::from_xyzw(q[1], q[2], q[3], q[0])) * ahead + DVec3::from_array(t);
            prop_assert!(seen.abs_diff_eq(DVec3::new(0.0, 0.0, 2.0), 1e-11), "{}", seen);
        }
    }

    #[test]
    fn half_turns_round_trip() {
        for (up, eye) in [(DVec3::Y, DVec3::Z), (DVec3::Y, -DVec3::Z), (DVec3::Z, DVec3::X), (-DVec3::Z, DVec3::Y)] {
            let pose = Camera::look_at(eye, DVec3::ZERO, up);
            let (q, t) = to_file(&pose);
            assert!(q[0] >= 0.0);
            assert!(from_file(q, t).unwrap().abs_diff_eq(pose, 1e-15), "{pose:?}");
        }
    }
}
