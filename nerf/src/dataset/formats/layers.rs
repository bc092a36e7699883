//! A file of JSON and one of its frames, whose fields count before those of the file.

use super::json::Object;
use crate::error::{Error, Result};

/// The fields of a file and those of a frame, which have priority.
pub(super) struct Layers<'a, 'b> {
    pub(super) top: &'b Object<'a>,
    pub(super) frame: &'b Object<'a>,
}

impl<'a, 'b> Layers<'a, 'b> {
    /// The object whose field has priority.
    pub(super) fn of(&self, name: &str) -> &'b Object<'a> {
        if self.frame.get(name).is_none() && self.top.get(name).is_some() { self.top } else { self.frame }
    }

    pub(super) fn find<T>(&self, name: &str, read: impl Fn(&'b Object<'a>, &str) -> Result<T>) -> Result<T> {
        read(self.of(name), name)
    }

    pub(super) fn number(&self, name: &str) -> Result<Option<f64>> {
        self.of(name).number(name)
    }

    pub(super) fn error(&self, name: &str, what: impl ToString) -> Error {
        self.of(name).error(name, what)
    }
}
