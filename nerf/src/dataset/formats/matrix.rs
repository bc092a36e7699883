//! Matrices of transforms in JSON: three or four rows of four numbers, nested or flat.

use super::json::{Object, number, shown};
use super::rigid::{TOLERANCE, is_orthonormal, rotation};
use crate::error::Result;
use glam::{DAffine3, DMat3, DVec3};
use serde_json::{Value, json};

/// The largest deviation of `R' R` from the identity for matrices of two decimals.
const ROUNDED: f64 = 2e-2;

/// Reads an invertible affine transform.
pub(super) fn affine(object: &Object<'_>, name: &str) -> Result<Option<DAffine3>> {
    let Some(matrix) = object.get(name) else { return Ok(None) };
    let transform = transform(matrix).map_err(|what| object.error(name, what))?;
    let determinant = transform.matrix3.determinant();
    if !(determinant != 0.0 && determinant.is_finite()) {
        return Err(object.error(name, format!("must be invertible, but its determinant is {determinant}")));
    }
    Ok(Some(transform))
}

/// Reads a camera-to-world matrix: a rotation, up to [`ROUNDED`], and a translation. The inner error is that of a matrix
/// that some programs write where they found no pose: none, an empty one, zeros, or numbers that are not finite. The
/// rotation is divided by a `scale`.
pub(super) fn pose(object: &Object<'_>, name: &str, scale: Option<f64>) -> Result<Result<DAffine3>> {
    let rigid = |mut transform: DAffine3| {
        transform.matrix3 *= scale.unwrap_or(1.0).recip();
        rigid(transform)
    };
    let matrix = object.required(name);
    let is_none = matrix.as_ref().map_or(true, |matrix| entries(matrix, 4).is_some_and(|entries| has_none(&entries)));
    let pose = matrix.and_then(|matrix| transform(matrix).and_then(rigid).map_err(|what| object.error(name, what)));
    if is_none { Ok(pose) } else { pose.map(Ok) }
}

/// The scale that all matrices of frames have in place of rotations, if it is one and not 1: that of a Blender camera's
/// parent, or of IDR's scene. Those without a pose do not count.
pub(super) fn shared_scale(frames: &[&Object<'_>], name: &str) -> Option<f64> {
    let mut scales = frames.iter().filter_map(|frame| {
        let m = transform(frame.get(name)?).ok()?.matrix3;
        let scale = scale_of(&m);
        (scale != 0.0).then_some((scale, is_orthonormal(&(m * scale.recip()), TOLERANCE)))
    });
    let (first, is_rotation) = scales.next()?;
    let is_shared = scales.all(|(scale, is_rotation)| is_rotation && (scale / first - 1.0).abs() < TOLERANCE);
    (is_rotation && is_shared && (first - 1.0).abs() > ROUNDED).then_some(first)
}

/// The mean length of the columns.
fn scale_of(m: &DMat3) -> f64 {
    (m.x_axis.length() + m.y_axis.length() + m.z_axis.length()) / 3.0
}

/// Returns true if the entries of a matrix say that there is no pose. JavaScript writes null for NaN.
fn has_none(entries: &[&Value]) -> bool {
    let is_lost = |value: &&Value| value.is_null() || number(value).is_some_and(|number| !number.is_finite());
    entries.iter().any(is_lost) || entries.iter().take(12).all(|value| number(value) == Some(0.0))
}

/// Replaces a matrix that is no rotation to [`TOLERANCE`] by the nearest rotation; returns whether it did.
pub(super) fn straighten(pose: &mut DAffine3) -> bool {
    let is_rounded = !is_orthonormal(&pose.matrix3, TOLERANCE);
    if is_rounded {
        // Newton's method for the polar decomposition.
        for _ in 0..8 {
            pose.matrix3 = 0.5 * (pose.matrix3 + pose.matrix3.inverse().transpose());
        }
    }
    is_rounded
}

/// The entries of a matrix with this number of columns, row by row: a list of rows or a flat list. `None` for other
/// values.
pub(super) fn entries(matrix: &Value, columns: usize) -> Option<Vec<&Value>> {
    let rows = matrix.as_array()?;
    if rows.iter().any(Value::is_array) {
        let rows: Option<Vec<&Vec<Value>>> =
            rows.iter().map(|row| row.as_array().filter(|row| row.len() == columns)).collect();
        return Some(rows?.into_iter().flatten().collect());
    }
    rows.len().is_multiple_of(columns).then(|| rows.iter().collect())
}

/// Three or four rows of four finite numbers, where a fourth is `0 0 0 1`; or an error message.
fn transform(matrix: &Value) -> std::result::Result<DAffine3, String> {
    let entries = entries(matrix, 4).filter(|entries| matches!(entries.len(), 12 | 16));
    let entries = entries.ok_or_else(|| format!("must be 3 or 4 rows of 4 numbers, is {}", shown(matrix)))?;
    let mut m = [[0.0, 0.0, 0.0, 1.0]; 4];
    for (i, value) in entries.into_iter().enumerate() {
        let [r, c] = [i / 4, i % 4];
        let what = || format!("row {r}, column {c} is not a finite number: {}", shown(value));
        m[r][c] = number(value).filter(|x| x.is_finite()).ok_or_else(what)?;
    }
    let [x, y, z, one] = m[3];
    let is_last = |row: [f64; 4]| row.iter().zip([0.0, 0.0, 0.0, 1.0]).all(|(a, b)| (a - b).abs() <= TOLERANCE);
    if !is_last(m[3]) && is_last(m.map(|row| row[3])) {
        return Err(format!(
            "is transposed: its last column is 0 0 0 1 and its last row {x} {y} {z} {one}; write rows, where ARKit and \
             three.js store columns"
        ));
    }
    if !is_last(m[3]) {
        return Err(format!("the last row must be 0 0 0 1, is {x} {y} {z} {one}"));
    }
    let column = |c: usize| DVec3::new(m[0][c], m[1][c], m[2][c]);
    Ok(DAffine3 { matrix3: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) })
}

/// Checks that a transform is a rotation, up to [`ROUNDED`], and a translation; returns it or an error message.
fn rigid(transform: DAffine3) -> std::result::Result<DAffine3, String> {
    let m = transform.matrix3;
    let scale = scale_of(&m);
    let scales = scale > 0.0 && scale.is_finite() && is_orthonormal(&(m * scale.recip()), TOLERANCE);
    if scales && !is_orthonormal(&m, TOLERANCE) {
        return Err(format!(
            "the upper left 3x3 must be a rotation, but scales by {scale:.6}: divide these nine numbers by \
             that, and leave the position in the last column as it is"
        ));
    }
    if m.determinant() < 0.0 && is_orthonormal(&m, ROUNDED) {
        return Err(
            "the upper left 3x3 mirrors (its determinant is -1): if all frames do, their world or camera has left-handed \
             axes, as in Unity and Unreal, so export right-handed axes; otherwise remove or correct this frame"
                .to_owned(),
        );
    }
    if !is_orthonormal(&m, ROUNDED) {
        let more = "write more digits, or a rotation without scale and shear";
        rotation(&m).map_err(|what| format!("the upper left 3x3 {what}: {more}"))?;
    }
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
