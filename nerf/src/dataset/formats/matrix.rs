//! Matrices of transforms in JSON: three or four rows of four numbers.

use super::json::{Object, shown};
use super::rigid::{TOLERANCE, is_orthonormal, rotation};
use crate::error::Result;
use glam::{DAffine3, DMat3, DVec3};
use serde_json::{Value, json};

/// Reads an invertible affine transform.
pub(super) fn affine(object: &Object<'_>, name: &str) -> Result<Option<DAffine3>> {
    let Some(matrix) = object.get(name) else { return Ok(None) };
    let transform = rows(matrix).map_err(|what| object.error(name, what))?;
    let determinant = transform.matrix3.determinant();
    if !(determinant != 0.0 && determinant.is_finite()) {
        return Err(object.error(name, format!("must be invertible, but its determinant is {determinant}")));
    }
    Ok(Some(transform))
}

/// Reads a camera-to-world matrix: a rotation and a translation.
pub(super) fn pose(object: &Object<'_>, name: &str) -> Result<DAffine3> {
    let matrix = object.required(name)?;
    rows(matrix).and_then(rigid).map_err(|what| object.error(name, what))
}

/// Three or four rows of four finite numbers, where a fourth is `0 0 0 1`; or an error message.
fn rows(matrix: &Value) -> std::result::Result<DAffine3, String> {
    let shape = || format!("must be 3 or 4 rows of 4 numbers, is {}", shown(matrix));
    let rows = matrix.as_array().filter(|rows| rows.len() == 3 || rows.len() == 4).ok_or_else(shape)?;
    let mut m = [[0.0, 0.0, 0.0, 1.0]; 4];
    for (r, row) in rows.iter().enumerate() {
        let row = row.as_array().filter(|row| row.len() == 4).ok_or_else(shape)?;
        for (c, value) in row.iter().enumerate() {
            let finite = value.as_f64().filter(|x| x.is_finite());
            let what = || format!("row {r}, column {c} is not a finite number: {}", shown(value));
            m[r][c] = finite.ok_or_else(what)?;
        }
    }
    if m[3].iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(value, expected)| (value - expected).abs() > TOLERANCE) {
        return Err(format!("the last row must be 0 0 0 1, is {} {} {} {}", m[3][0], m[3][1], m[3][2], m[3][3]));
    }
    let column = |c: usize| DVec3::new(m[0][c], m[1][c], m[2][c]);
    Ok(DAffine3 { matrix3: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) })
}

/// Checks that a transform is a rotation and a translation; returns it or an error message.
fn rigid(transform: DAffine3) -> std::result::Result<DAffine3, String> {
    let m = transform.matrix3;
    let scale = (m.x_axis.length() + m.y_axis.length() + m.z_axis.length()) / 3.0;
    let scales = scale > 0.0 && scale.is_finite() && is_orthonormal(&(m * scale.recip()), TOLERANCE);
    if scales && !is_orthonormal(&m, TOLERANCE) {
        return Err(format!(
            "the upper left 3x3 must be a rotation, but scales by {scale:.6}: divide these nine numbers by \
             that, and leave the position in the last column as it is"
        ));
    }
    rotation(&m).map_err(|what| format!("the upper left 3x3 {what}"))?;
    Ok(transform)
}

/// The rows of a matrix for [`affine`] and [`pose`]: three, or four for a pose, as all programs write it.
pub(super) fn to_json(transform: DAffine3, count: usize) -> Value {
    let (m, t) = (transform.matrix3, transform.translation);
    let row = |r: usize| match r {
        0..3 => json!([m.x_axis[r], m.y_axis[r], m.z_axis[r], t[r]]),
        _ => json!([0.0, 0.0, 0.0, 1.0]),
    };
    (0..count).map(row).collect()
}
