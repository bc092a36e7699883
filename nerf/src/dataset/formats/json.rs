//! JSON documents whose errors name the field.

use super::encodings::decoded;
use super::points::reason;
use crate::error::{Error, Result};
use crate::files::write_atomic;
use serde_json::{Map, Value};
use std::path::Path;

/// The most characters of a value in an error.
const SHOWN: usize = 40;

/// Names of members that some programs use in place of instant-ngp's.
const OTHER_NAMES: [(&str, &str); 2] = [("w", "width"), ("h", "height")];

/// A number, also as a string, as some programs write it.
pub(super) fn number(value: &Value) -> Option<f64> {
    value.as_f64().or_else(|| value.as_str()?.trim().parse().ok())
}

/// Returns true if a member counts as absent: null or an empty string, as some programs write it.
fn is_empty(value: &Value) -> bool {
    value.is_null() || value.as_str().is_some_and(|text| text.trim().is_empty())
}

/// A field that training does not use. If it is wrong, it counts as absent, with a note.
pub(super) fn unused<T>(field: Result<Option<T>>, notes: &mut Vec<String>) -> Option<T> {
    field.unwrap_or_else(|error| {
        notes.push(format!("ignored {}", reason(error)));
        None
    })
}

/// The first of several notes that differ in names alone, with the number of the others.
pub(super) fn first_of(notes: &[String]) -> Option<String> {
    let others = match notes.len() {
        0 | 1 => String::new(),
        count => format!(", and {} more likewise", count - 1),
    };
    notes.first().map(|first| first.clone() + &others)
}

/// Reads and parses a file.
pub(super) fn read(file: &Path) -> Result<Value> {
    let bytes = std::fs::read(file).map_err(|e| Error::file(file, format!("cannot be read: {e}")))?;
    parse(&decoded(&bytes)).map_err(|e| Error::file(file, format!("is not valid JSON: {e}")))
}

/// Writes a file atomically. Finite numbers round-trip bit for bit.
pub(super) fn write(file: &Path, object: &Value) -> Result<()> {
    let text = serde_json::to_string_pretty(object);
    let text = text.map_err(|e| Error::file(file, format!("cannot be written: {e}")))?;
    write_atomic(file, (text + "\n").as_bytes())
}

/// Parses JSON.
///
/// Python also writes NaN and Infinity, which JSON does not have. They are read as strings, so that the error can name
/// the field instead of a line. As null they would count as absent.
fn parse(text: &str) -> serde_json::Result<Value> {
    serde_json::from_str(text).or_else(|error| serde_json::from_str(&quoted(text)).map_err(|_| error))
}

/// Puts quotes around all non-finite numbers.
fn quoted(text: &str) -> String {
    let (mut out, mut rest, mut in_string) = (String::with_capacity(text.len()), text, false);
    while let Some(c) = rest.chars().next() {
        let word = ["NaN", "Infinity", "-Infinity"].into_iter().find(|word| !in_string && rest.starts_with(word));
        let taken = match word {
            Some(word) => word.len(),
            // A character after a backslash does not end a string.
            None if c == '\\' => rest.chars().take(2).map(char::len_utf8).sum(),
            None => c.len_utf8(),
        };
        in_string ^= c == '"';
        let (part, after) = rest.split_at(taken);
        match word {
            Some(word) => out.extend(["\"", word, "\""]),
            None => out.push_str(part),
        }
        rest = after;
    }
    out
}

/// A value for an error: on one line, truncated.
pub(super) fn shown(value: &Value) -> String {
    let text = value.to_string();
    match text.char_indices().nth(SHOWN) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text,
    }
}

/// An object of a document, with its path.
#[derive(Debug, Clone)]
pub(super) struct Object<'a> {
    /// The file, for errors.
    pub(super) file: &'a Path,
    /// Its path in the document: empty at the top, or as `frames[3]`.
    pub(super) path: String,
    members: &'a Map<String, Value>,
}

impl<'a> Object<'a> {
    /// The top object of a document.
    pub(super) fn top(file: &'a Path, document: &'a Value) -> Result<Self> {
        let members = document.as_object().ok_or_else(|| {
            let what = format!("must be an object with a list `frames`, is {}", shown(document));
            Error::file(file, what)
        })?;
        Ok(Object { file, path: String::new(), members })
    }

    /// The elements of the list `frames`, at least one.
    pub(super) fn frames(&self) -> Result<Vec<Object<'a>>> {
        let frames = self.required("frames")?;
        let frames = frames.as_array().ok_or_else(|| self.error("frames", "must be a list"))?;
        if frames.is_empty() {
            return Err(self.error("frames", "is empty: add at least one frame"));
        }
        let object = |(i, frame): (usize, &'a Value)| {
            let path = format!("frames[{i}]");
            let what = || Error::field(self.file, &path, format!("must be an object, is {}", shown(frame)));
            let members = frame.as_object().ok_or_else(what)?;
            Ok(Object { file: self.file, path, members })
        };
        frames.iter().enumerate().map(object).collect()
    }

    /// A member, or that of its [other name](OTHER_NAMES); `None` if it is absent, null or an empty string.
    pub(super) fn get(&self, name: &str) -> Option<&'a Value> {
        let member = |name: &str| self.members.get(name).filter(|value| !is_empty(value));
        let other = || OTHER_NAMES.iter().find(|(usual, _)| *usual == name).and_then(|(_, other)| member(other));
        member(name).or_else(other)
    }

    /// A required member. The error lists others, of which one may be it under another name.
    pub(super) fn required(&self, name: &str) -> Result<&'a Value> {
        const LISTED: usize = 8;
        self.get(name).ok_or_else(|| {
            let others = self.members.keys().filter(|other| *other != name).take(LISTED);
            let others: Vec<String> = others.map(|other| shown(&Value::from(other.as_str()))).collect();
            let beside = if others.is_empty() { String::new() } else { format!(" beside {}", others.join(", ")) };
            self.error(name, format!("is missing{beside}"))
        })
    }

    /// The path of a member in the document.
    pub(super) fn field(&self, name: &str) -> String {
        if self.path.is_empty() { name.to_owned() } else { format!("{}.{name}", self.path) }
    }

    /// An error about a member.
    pub(super) fn error(&self, name: &str, what: impl ToString) -> Error {
        Error::field(self.file, self.field(name), what)
    }

    /// Reads a member with `read`; an error says that it must be `what`.
    fn typed<T>(&self, name: &str, what: &str, read: impl Fn(&'a Value) -> Option<T>) -> Result<Option<T>> {
        let Some(value) = self.get(name) else { return Ok(None) };
        let found = read(value).ok_or_else(|| self.error(name, format!("must be {what}, is {}", shown(value))));
        found.map(Some)
    }

    /// A finite number.
    pub(super) fn number(&self, name: &str) -> Result<Option<f64>> {
        self.typed(name, "a finite number", |value| number(value).filter(|x| x.is_finite()))
    }

    /// A number above 0.
    pub(super) fn positive(&self, name: &str) -> Result<Option<f64>> {
        match self.number(name)? {
            Some(x) if x <= 0.0 => Err(self.error(name, format!("must be above 0, is {x}"))),
            other => Ok(other),
        }
    }

    /// A string.
    pub(super) fn text(&self, name: &str) -> Result<Option<&'a str>> {
        self.typed(name, "a string", Value::as_str)
    }

    /// A boolean, also as a string in any case, or a number as in Python.
    pub(super) fn flag(&self, name: &str) -> Result<Option<bool>> {
        self.typed(name, "true or false", truth)
    }
}

/// A boolean, also as a string in any case, or a number as in Python.
pub(super) fn truth(value: &Value) -> Option<bool> {
    let word = |value: &Value| value.as_str().and_then(|text| text.trim().to_lowercase().parse().ok());
    value.as_bool().or_else(|| number(value).map(|x| x != 0.0)).or_else(|| word(value))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn non_finite_numbers_become_strings() {
        let text = "{\"NaN\\\"NaN\": [NaN, -Infinity, Infinity, \"Infinity \\\\\", 1.5], \"\u{e9}\": NaN}";
        let expected = json!({ "NaN\"NaN": ["NaN", "-Infinity", "Infinity", "Infinity \\", 1.5], "\u{e9}": "NaN" });
        assert_eq!(parse(text).unwrap(), expected);
        assert!(parse("{\"a\": NaNa}").unwrap_err().to_string().contains("column 7"), "the place in the file");
        assert!(parse("\"\\").is_err() && parse("").is_err());
    }

    #[test]
    fn long_values_are_truncated() {
        assert_eq!(shown(&json!([1, 2])), "[1,2]");
        let long = shown(&json!("\u{e9}".repeat(100)));
        assert_eq!(long.chars().count(), SHOWN + 3);
    }
}
