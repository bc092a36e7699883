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
        Error::File { path: path.as_ref().into(), what: line(what) }
    }

    /// An error about one field of the file `path`.
    pub fn field(path: impl AsRef<Path>, field: impl ToString, what: impl ToString) -> Self {
        Error::Field { path: path.as_ref().into(), field: line(field), what: line(what) }
    }

    /// An error about the setting `name`.
    pub fn setting(name: impl ToString, what: impl ToString) -> Self {
        Error::Setting { name: line(name), what: line(what) }
    }
}

/// The most characters of a part of a message: one may repeat a name from a file.
const LONGEST: usize = 1000;

/// A text on one line, whatever names in it come from files; none of them moves a terminal's cursor.
fn line(text: impl ToString) -> String {
    let text = text.to_string();
    if text.len() <= LONGEST && !text.contains(char::is_control) {
        return text;
    }
    let escaped = |c: char| if c.is_control() { c.escape_default().to_string() } else { c.to_string() };
    let mut line: String = text.chars().take(LONGEST).map(escaped).collect();
    if text.chars().nth(LONGEST).is_some() {
        line += "...";
    }
    line
}

/// A result whose error is [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_one_line_whatever_names_files_have() {
        let message = Error::field("a.json", "fra\nmes", "is `\u{1b}[2J`, not \u{e9}").to_string();
        assert_eq!(message, "a.json: `fra\\nmes`: is `\\u{1b}[2J`, not \u{e9}");
        assert_eq!(Error::setting("a\tb", "is\r0").to_string(), "`a\\tb`: is\\r0");
        let long = Error::file("a", "\u{e9}".repeat(1001)).to_string();
        assert_eq!(long, format!("a: {}...", "\u{e9}".repeat(1000)));
        assert_eq!(Error::file("a", "\u{e9}".repeat(1000)).to_string().chars().count(), 1003);
    }
}
