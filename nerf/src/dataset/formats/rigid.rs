//! Checks of rotations and poses from files.

use glam::{DAffine3, DMat3};

/// The largest deviation of `R' R` from the identity. Files contain rounding errors of about 1e-6.
pub(crate) const TOLERANCE: f64 = 1e-3;

/// Returns true if no entry of `R' R` deviates from the identity by more than `tolerance`.
pub(crate) fn is_orthonormal(matrix: &DMat3, tolerance: f64) -> bool {
    (matrix.transpose() * *matrix - DMat3::IDENTITY).to_cols_array().iter().all(|x| x.abs() <= tolerance)
}

/// Checks that a matrix is a rotation.
///
/// # Errors
/// If it is not one, to 1e-3; the text is a predicate to follow the matrix's name.
pub fn rotation(matrix: &DMat3) -> Result<(), String> {
    if !matrix.is_finite() {
        return Err("must be a rotation, but an entry is not a finite number".to_owned());
    }
    if !is_orthonormal(matrix, TOLERANCE) {
        return Err("must be a rotation, but its columns are not orthonormal to 1e-3".to_owned());
    }
    if matrix.determinant() < 0.0 {
        return Err("must be a rotation, but mirrors: its determinant is -1".to_owned());
    }
    Ok(())
}

/// Checks that a pose is a rotation and a finite translation.
///
/// # Errors
/// As [`rotation`], or if the position is not finite.
pub fn pose(pose: &DAffine3) -> Result<(), String> {
    rotation(&pose.matrix3)?;
    match pose.translation.is_finite() {
        true => Ok(()),
        false => Err("must have a finite position".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};

    #[test]
    fn check_accepts_rotations_alone() {
        let turned = DMat3::from_quat(DQuat::from_xyzw(0.1, -0.2, 0.3, 0.9).normalize());
        assert_eq!(rotation(&turned), Ok(()));
        assert_eq!(rotation(&(turned * 1.0004)), Ok(()));
        let fails = |matrix: DMat3, expected: &str| {
            let what = rotation(&matrix).unwrap_err();
            assert!(what.contains(expected), "{what}");
        };
        fails(turned * 1.001, "orthonormal");
        fails(DMat3::ZERO, "orthonormal");
        fails(DMat3::from_cols(DVec3::X, DVec3::X, DVec3::Z), "orthonormal");
        // Products that overflow, and their differences.
        fails(DMat3::from_cols(DVec3::X, DVec3::splat(1e200), DVec3::new(1e200, -1e200, 0.0)), "orthonormal");
        fails(DMat3::from_cols(DVec3::X, DVec3::Y, -DVec3::Z), "mirrors");
        fails(DMat3::from_cols(DVec3::X, DVec3::Y, DVec3::Z * f64::NAN), "finite");
        let far = DAffine3 { matrix3: turned, translation: DVec3::new(0.0, f64::INFINITY, 0.0) };
        assert!(pose(&far).unwrap_err().contains("position"));
    }
}
