//! Errors that name the file, the field and what to do.

use std::path::{Path, PathBuf};

/// What can go wrong between a folder of photographs and a trained field. Every message is one line.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file or folder that cannot be read, written or decoded.
    #[error("{}: {what}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it and what to do.
        what: String,
    },
    /// A field of a file that has no usable value.
    #[error("{}: `{field}`: {what}", path.display())]
    Field {
        /// The file.
        path: PathBuf,
        /// The field, written as a path into the document: `frames[3].transform_matrix`.
        field: String,
        /// What is wrong with it and what to do.
        what: String,
    },
    /// A setting that contradicts another or lies outside its range.
    #[error("`{name}`: {what}")]
    Setting {
        /// The setting.
        name: String,
        /// What is wrong with it and what to do.
        what: String,
    },
}

impl Error {
    /// An error about the file `path`.
    pub fn file(path: impl AsRef<Path>, what: impl ToString) -> Self {
        Error::File { path: path.as_ref().into(), what: what.to_string() }
    }

    /// An error about one field of the file `path`.
    pub fn field(path: impl AsRef<Path>, field: impl ToString, what: impl ToString) -> Self {
        Error::Field { path: path.as_ref().into(), field: field.to_string(), what: what.to_string() }
    }

    /// An error about the setting `name`.
    pub fn setting(name: impl ToString, what: impl ToString) -> Self {
        Error::Setting { name: name.to_string(), what: what.to_string() }
    }
}

/// A result whose error is [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;
