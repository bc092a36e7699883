//! The points of a file. Training only profits from them, so damage costs points, never the capture.

use crate::dataset::capture::{Capture, Point};
use crate::error::Error;
use std::path::Path;

/// The readable points of a file.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Points {
    pub(super) points: Vec<Point>,
    /// The number of points in the file, with those that were left out.
    pub(super) total: u64,
    /// Why points were left out.
    reason: Option<String>,
}

impl Points {
    /// The points of a file that announces `total`.
    pub(super) fn of(total: u64) -> Self {
        Points { total, ..Points::default() }
    }

    /// The points of an unreadable file: none.
    pub(super) fn unreadable(reason: impl ToString) -> Self {
        Points { reason: Some(reason.to_string()), ..Points::default() }
    }

    /// Adds a point; returns false if it was left out because its position is not finite. `entry` names it.
    pub(super) fn push(&mut self, point: Point, entry: impl FnOnce() -> String) -> bool {
        let whole = point.position.is_finite();
        if whole {
            self.points.push(Point { error: if point.error.is_finite() { point.error } else { 0.0 }, ..point });
        } else {
            self.leave_out(|| format!("{} has no finite position", entry()));
        }
        whole
    }

    /// Leaves out a point. The first reason counts.
    pub(super) fn leave_out(&mut self, reason: impl FnOnce() -> String) {
        self.reason.get_or_insert_with(reason);
    }

    /// Leaves out all further points, since the file ends or cannot be followed. This reason counts.
    pub(super) fn end(&mut self, reason: String) {
        self.reason = Some(reason);
    }

    /// Leaves out what follows the last of the announced points. This reason joins another.
    pub(super) fn follow(&mut self, reason: String) {
        let first = self.reason.take().map_or(String::new(), |first| format!("{first}; "));
        self.reason = Some(first + &reason);
    }

    /// Gives the points to a capture, with an assumption if some were left out.
    pub(super) fn attach(self, capture: &mut Capture, file: &Path) {
        let Points { points, total, reason } = self;
        if let Some(reason) = reason {
            let count = match points.len() as u64 {
                0 => "the points".to_owned(),
                count if count == total => "the rest".to_owned(),
                count => format!("{} of {total} points", total - count),
            };
            let name = file.strip_prefix(&capture.folder).unwrap_or(file).display();
            capture.assumptions.push(format!("left out {count} of `{name}`: {reason}"));
        }
        capture.points_file = (!points.is_empty()).then(|| file.to_owned());
        capture.points = points;
    }
}

/// An error's message without the file.
pub(super) fn reason(error: Error) -> String {
    match error {
        Error::File { what, .. } => what,
        Error::Field { field, what, .. } => format!("`{field}`: {what}"),
        Error::Setting { .. } => error.to_string(),
    }
}
