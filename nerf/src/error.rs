//! The crate's error type.

use std::path::{Path, PathBuf};

/// An error of this crate. Every message is one line: it names the file, field or setting, what is wrong, and the fix.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file or folder that cannot be read, written or decoded.
    #[error("{}: {what}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The problem and the fix.
        what: String,
    },
    /// A field of a file with an unusable value.
    #[error("{}: `{field}`: {what}", path.display())]
    Field {
        /// The file.
        path: PathBuf,
        /// The path of the field in the document, such as `frames[3].transform_matrix`.
        field: String,
        /// The problem and the fix.
        what: String,
    },
    /// A setting that is out of range or contradicts another.
    #[error("`{name}`: {what}")]
    Setting {
        /// The setting.
        name: String,
        /// The problem and the fix.
        what: String,
    },
}

impl Error {
    /// Creates an error about the file `path`.
    pub fn file(path: impl AsRef<Path>, what: impl ToString) -> Self {
        Error::File { path: path.as_ref().into(), what: line(what) }
    }

    /// Creates an error about one field of the file `path`.
    pub fn field(path: impl AsRef<Path>, field: impl ToString, what: impl ToString) -> Self {
        Error::Field { path: path.as_ref().into(), field: line(field), what: line(what) }
    }

    /// Creates an error about the setting `name`.
    pub fn setting(name: impl ToString, what: impl ToString) -> Self {
        Error::Setting { name: line(name), what: line(what) }
    }

    /// The same error with more advice.
    pub(crate) fn with(mut self, advice: &str) -> Self {
        let (Error::File { what, .. } | Error::Field { what, .. } | Error::Setting { what, .. }) = &mut self;
        *what = line(format!("{what}; {advice}"));
        self
    }
}

/// The most characters of a part of a message: it may repeat a name from a file.
const LONGEST: usize = 1000;

/// Escapes control characters, which names from files may contain, and truncates long text.
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
    fn messages_are_one_line_for_all_file_names() {
        let message = Error::field("a.json", "fra\nmes", "is `\u{1b}[2J`, not \u{e9}").to_string();
        assert_eq!(message, "a.json: `fra\\nmes`: is `\\u{1b}[2J`, not \u{e9}");
        assert_eq!(Error::setting("a\tb", "is\r0").to_string(), "`a\\tb`: is\\r0");
        let long = Error::file("a", "\u{e9}".repeat(1001)).to_string();
        assert_eq!(long, format!("a: {}...", "\u{e9}".repeat(1000)));
        assert_eq!(Error::file("a", "\u{e9}".repeat(1000)).to_string().chars().count(), 1003);
    }
}
