//! Paths in JSON files: of Windows, without an ending, or with one in other letters.

use super::json::Object;
use crate::error::Result;
use serde_json::Value;
use std::path::{Path, PathBuf};
use unicode_normalization::UnicodeNormalization;

/// Extensions of image files, tried in this order if a name has none.
const EXTENSIONS: [&str; 6] = ["png", "jpg", "jpeg", "webp", "jfif", "jpe"];

/// The same of images that often stand beside those: originals, or depths.
const BESIDE: [&str; 3] = ["tif", "tiff", "bmp"];

/// Extensions of images that other programs list or that stand beside others: converted before, or not decoded here.
const OTHERS: [&str; 9] = ["heic", "heif", "avif", "gif", "dng", "arw", "cr2", "nef", "exr"];

/// The longest path, in bytes. Operating systems allow a few times as many at most.
const LONGEST: usize = 1024;

/// Normalises a path to slashes, without a leading `./`. `name` is its field, for errors.
pub(super) fn normal(object: &Object<'_>, name: &str, value: &Value) -> Result<String> {
    let path = value.as_str().ok_or_else(|| object.error(name, "must be a string"))?;
    if path.len() > LONGEST || path.chars().any(char::is_control) {
        let what = format!("must be a path without control characters, of at most {LONGEST} bytes");
        return Err(object.error(name, what));
    }
    // Windows separators. Names of datasets contain no backslashes.
    let path = path.replace('\\', "/");
    let mut rest = path.as_str();
    while let Some(shorter) = rest.strip_prefix("./") {
        rest = shorter.trim_start_matches('/');
    }
    match rest {
        "" | "." => Err(object.error(name, "must be the path of a file, is empty")),
        rest => Ok(rest.to_owned()),
    }
}

/// A path of a web address or with blanks around it as that of a file: without its query, and with `%20` and the like
/// decoded. `None` if it is one already.
pub(super) fn plain(path: &str) -> Option<String> {
    let (mut bytes, mut rest) = (vec![], path.split('?').next().unwrap_or(path).trim().as_bytes());
    while let Some((&byte, after)) = rest.split_first() {
        let code = after.get(..2).filter(|code| byte == b'%' && code.iter().all(u8::is_ascii_hexdigit));
        let code = code.and_then(|code| u8::from_str_radix(std::str::from_utf8(code).ok()?, 16).ok());
        bytes.push(code.unwrap_or(byte));
        rest = if code.is_some() { &after[2..] } else { after };
    }
    String::from_utf8(bytes)
        .ok()
        .filter(|plain| plain != path && !plain.is_empty() && !plain.contains(char::is_control))
}

/// A path in Unicode's composed form. macOS decomposes names: it stores `é` as two characters.
pub(super) fn composed(path: &str) -> String {
    path.nfc().collect()
}

/// A path for comparisons: in lower case and composed.
pub(super) fn folded(path: &str) -> String {
    composed(&path.to_lowercase())
}

/// The extension of a path if it is one of these.
fn one_of(path: &str, mut known: impl Iterator<Item = &'static &'static str>) -> Option<&str> {
    let (stem, given) = path.rsplit_once('.')?;
    (!stem.is_empty() && known.any(|known| known.eq_ignore_ascii_case(given))).then_some(given)
}

/// The extension of a path if it is that of an image file in a usual format.
pub(super) fn usual_extension(path: &str) -> Option<&str> {
    one_of(path, EXTENSIONS.iter())
}

/// The extension of a path if it is that of an image file.
pub(super) fn extension(path: &str) -> Option<&str> {
    one_of(path, EXTENSIONS.iter().chain(&BESIDE))
}

/// The extension of a path if it is that of an image in any format.
pub(super) fn any_extension(path: &str) -> Option<&str> {
    one_of(path, EXTENSIONS.iter().chain(&BESIDE).chain(&OTHERS))
}

/// Finds a file below `folder`: by its path, with an extension appended, or with its extension in the other case.
pub(super) fn find(folder: &Path, path: &str) -> Option<PathBuf> {
    let both = |stem: &str, extension: &str| {
        [extension.to_ascii_lowercase(), extension.to_ascii_uppercase()].map(|extension| format!("{stem}.{extension}"))
    };
    let others: Vec<String> = match extension(path) {
        Some(given) => both(&path[..path.len() - given.len() - 1], given).into(),
        None => EXTENSIONS.iter().chain(&BESIDE).flat_map(|extension| both(path, extension)).collect(),
    };
    let names = std::iter::once(path.to_owned()).chain(others);
    names.map(|name| folder.join(name)).find(|path| path.is_file())
}

/// The written path of a view's image: its name with the extension of the image.
pub(super) fn written(name: &str, image: Option<&Path>) -> String {
    let Some(ending) = image.and_then(Path::to_str).and_then(extension) else { return name.to_owned() };
    match extension(name) {
        None => format!("{name}.{ending}"),
        Some(given) if given.eq_ignore_ascii_case(ending) => {
            format!("{}{ending}", &name[..name.len() - given.len()])
        }
        Some(_) => name.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn paths_are_normal() {
        let (document, file) = (json!({}), Path::new("t.json"));
        let top = Object::top(file, &document).unwrap();
        let of = |path: &str| normal(&top, "file_path", &json!(path));
        for (path, expected) in [
            ("./images/0.png", "images/0.png"),
            (".\\images\\0.png", "images/0.png"),
            ("././/images/0.png", "images/0.png"),
            ("../images/0", "../images/0"),
            ("/data/0.png", "/data/0.png"),
            (".hidden", ".hidden"),
        ] {
            assert_eq!(of(path).unwrap(), expected);
        }
        for path in ["", "./", ".", "a\nb", "a\0", &"x".repeat(2000)] {
            assert!(of(path).unwrap_err().to_string().starts_with("t.json: `file_path`: "), "{path:?}");
        }
        assert!(normal(&top, "file_path", &json!(3)).unwrap_err().to_string().contains("must be a string"));
    }

    #[test]
    fn paths_find_files_by_extension_and_case() {
        let folder = tempfile::tempdir().unwrap();
        let found = |path: &str| find(folder.path(), path).map(|p| p.strip_prefix(folder.path()).unwrap().to_owned());
        for name in ["a.png", "b.JPG", "c.jpeg", "d.1.WEBP", "e.PNG", "f.png", "f.jpg", "f.tif", "h.TIF", "depth.npy"] {
            std::fs::write(folder.path().join(name), b"").unwrap();
        }
        for (path, expected) in [
            ("a.png", "a.png"),
            ("a", "a.png"),
            ("a.PNG", "a.png"),
            ("b", "b.JPG"),
            ("b.jpg", "b.JPG"),
            ("b.Jpg", "b.JPG"),
            ("c", "c.jpeg"),
            ("d.1", "d.1.WEBP"),
            ("e", "e.PNG"),
            ("f", "f.png"),
            ("f.jpg", "f.jpg"),
            ("h", "h.TIF"),
            ("h.tif", "h.TIF"),
            ("depth.npy", "depth.npy"),
        ] {
            assert_eq!(found(path), Some(expected.into()), "{path}");
        }
        assert_eq!(found("a.jpg"), None, "another image");
        assert_eq!(found("g"), None);
        let whole = folder.path().join("a");
        assert_eq!(find(Path::new("elsewhere"), whole.to_str().unwrap()), Some(folder.path().join("a.png")));
    }

    #[test]
    fn written_paths_have_the_image_extension() {
        let of = |name, image| written(name, Some(Path::new(image)));
        assert_eq!(of("train/r_0", "/d/train/r_0.png"), "train/r_0.png");
        assert_eq!(of("r.5", "/d/r.5.JPG"), "r.5.JPG");
        assert_eq!(of("r.jpg", "/d/r.JPG"), "r.JPG");
        assert_eq!(of("r.jpg", "/d/r.jpg"), "r.jpg");
        assert_eq!(written("train/r_0", None), "train/r_0");
    }
}
