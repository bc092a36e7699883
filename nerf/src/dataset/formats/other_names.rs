//! Focal lengths and principal points under the names of other programs: intrinsic matrices, lists and `fx`.

use super::json::{Object, number, shown};
use super::matrix::entries;
use crate::error::Result;
use serde_json::Value;

/// Names of an intrinsic matrix (focal lengths on the diagonal, the principal point in the last column), and of a list or
/// object of fx, fy, cx and cy.
pub(super) const MATRICES: [&str; 8] = [
    "K",
    "intrinsics",
    "camera_intrinsics",
    "intrinsic_matrix",
    "camera_matrix",
    "cam_K",
    "intrinsic",
    "cam_intrinsic",
];

/// What is wrong with a matrix with another entry than a finite number.
const NOT_FINITE: &str = "must have finite numbers";

/// The largest difference of two values of a length, in pixels.
const SAME: f64 = 0.01;

/// The first [intrinsic matrix](MATRICES) of an object, with its name and its entries. Values of other shapes belong to
/// other programs.
pub(super) fn matrix_of<'a>(object: &'a Object<'_>) -> Option<(&'static str, &'a Value, Vec<&'a Value>)> {
    MATRICES.into_iter().find_map(|name| {
        let value = object.get(name)?;
        Some((name, value, entries_of(value)?))
    })
}

/// The first value under the name of an [intrinsic matrix](MATRICES) that is none.
pub(super) fn unread_matrix<'a>(object: &'a Object<'_>) -> Option<(&'static str, &'a Value)> {
    let of_name =
        |name| Some((name, object.get(name).filter(|value| !value.is_null() && entries_of(value).is_none())?));
    MATRICES.into_iter().find_map(of_name)
}

/// What is wrong with an [intrinsic matrix](MATRICES) that some programs write for images without a camera.
pub(super) fn unusable(entries: &[&Value]) -> Option<&'static str> {
    let second = match entries.len() {
        4 => 1,
        9 => 4,
        _ => 5,
    };
    let is_lost = |value: &&Value| value.is_null() || number(value).is_some_and(|x| !x.is_finite());
    if entries.iter().any(is_lost) {
        return Some(NOT_FINITE);
    }
    let is_no_length = |i: usize| number(entries[i]).is_some_and(|f| f <= 0.0);
    [0, second].into_iter().any(is_no_length).then_some("must have focal lengths above 0")
}

/// The focal lengths and the principal point of an object, under other names than instant-ngp's.
#[derive(Default)]
pub(super) struct OtherNames {
    /// The member that has them.
    pub name: &'static str,
    /// fx, fy, cx and cy.
    lengths: [Option<f64>; 4],
}

impl OtherNames {
    pub fn of(object: &Object<'_>) -> Result<Self> {
        if let Some((name, value, entries)) = matrix_of(object) {
            let m: Option<Vec<f64>> = entries.iter().map(|x| number(x)).collect();
            let lengths = match (unusable(&entries), m) {
                (None, Some(m)) => lengths(&m, value.is_object()),
                (what, _) => Err(what.unwrap_or(NOT_FINITE)),
            };
            let lengths = lengths.map_err(|what| object.error(name, format!("{what}, is {}", shown(value))))?;
            return Ok(OtherNames { name, lengths: lengths.map(Some) });
        }
        if ["fl_x", "fl_y"].iter().any(|name| object.get(name).is_some()) {
            return Ok(OtherNames::default());
        }
        let [fx, fy] = [object.positive("fx")?, object.positive("fy")?];
        Ok(OtherNames { name: if fx.is_some() { "fx" } else { "fy" }, lengths: [fx, fy, None, None] })
    }
}

/// The entries of a 3x3, 3x4 or 4x4 matrix, row by row, or fx, fy, cx and cy of a list or an object of nothing else.
fn entries_of(value: &Value) -> Option<Vec<&Value>> {
    match value {
        Value::Object(members) if members.len() == 4 => {
            ["fx", "fy", "cx", "cy"].into_iter().map(|name| members.get(name)).collect()
        }
        Value::Array(list) if list.len() == 4 && !list.iter().any(Value::is_array) => Some(list.iter().collect()),
        value => entries(value, 3)
            .filter(|entries| entries.len() == 9)
            .or_else(|| entries(value, 4).filter(|entries| matches!(entries.len(), 12 | 16))),
    }
}

/// fx, fy, cx and cy of their list, which may be `named`, or of an intrinsic matrix; or an error message.
fn lengths(m: &[f64], named: bool) -> std::result::Result<[f64; 4], &'static str> {
    if let [fx, fy, cx, cy] = *m {
        // COLMAP lists a focal length, cx, cy and a coefficient.
        let is_in_order = (0.67..1.5).contains(&(fx / fy)) && (0.25..4.0).contains(&(cx / cy));
        return if named || is_in_order { Ok([fx, fy, cx, cy]) } else { Err("must be fx, fy, cx, cy in this order") };
    }
    let columns = if m.len() == 9 { 3 } else { 4 };
    let at = |row: usize, column: usize| m[row * columns + column];
    let is_nothing = |values: [f64; 2]| values.iter().all(|x| x.abs() <= SAME);
    let is_rest_nothing = (0..m.len()).all(|i| i % columns < 3 && i / columns < 3 || m[i] == f64::from(i == 15));
    // Some programs store columns. Only the principal point can stand outside of the diagonal.
    let [right, below] = [[at(0, 2), at(1, 2)], [at(2, 0), at(2, 1)]];
    let (centre, other) = if right == [0.0; 2] { (below, right) } else { (right, below) };
    match is_nothing([at(0, 1), at(1, 0)]) && other == [0.0; 2] && at(2, 2) == 1.0 && is_rest_nothing {
        true => Ok([at(0, 0), at(1, 1), centre[0], centre[1]]),
        false => Err("must have the rows fx 0 cx, 0 fy cy and 0 0 1"),
    }
}

/// A length that is given by its own member, by the other names, or equally by both.
pub(super) fn agreeing(object: &Object<'_>, name: &str, others: &OtherNames, i: usize) -> Result<Option<f64>> {
    match (object.number(name)?, others.lengths[i]) {
        (Some(own), Some(other)) if !((own - other).abs() <= SAME) => {
            let field = object.field(others.name);
            Err(object.error(name, format!("is {own}, but `{field}` has {other}: remove one of them")))
        }
        (own, other) => Ok(own.or(other)),
    }
}
