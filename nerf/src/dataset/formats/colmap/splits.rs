//! Lists of the images of each split beside a model.

use super::super::locate::{fitting, shown};
use crate::dataset::capture::Capture;
use crate::dataset::frames::Split;
use crate::error::{Error, Result};
use std::path::{Path, PathBuf};

/// nerfstudio's lists, in the folder of the capture. 3D Gaussian Splatting has `test.txt` in that of the model.
const LISTS: [(&str, Split); 3] =
    [("train_list.txt", Split::Train), ("validation_list.txt", Split::Val), ("test_list.txt", Split::Test)];

/// Sets the split of each view that a list names, one name a line.
///
/// # Errors
/// If a list cannot be read, or a name fits several images or one of another list.
pub(super) fn attach(capture: &mut Capture, model: &Path) -> Result<()> {
    let lists = LISTS.map(|(name, split)| (capture.folder.join(name), split));
    for (file, split) in lists.into_iter().chain([(model.join("test.txt"), Split::Test)]) {
        if file.is_file() {
            read(capture, &file, split)?;
        }
    }
    Ok(())
}

fn read(capture: &mut Capture, file: &PathBuf, split: Split) -> Result<()> {
    let text = std::fs::read_to_string(file).map_err(|e| Error::file(file, format!("cannot be read: {e}")))?;
    let mut absent = vec![];
    for (i, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let name = line.trim().replace('\\', "/");
        if name.is_empty() || name.starts_with('#') {
            continue;
        }
        let names = fitting(capture.views.iter().map(|view| view.name.as_str()), &name);
        let field = format!("line {}", i + 1);
        let [only] = names[..] else {
            let [one, two, ..] = names[..] else {
                absent.push(name);
                continue;
            };
            return Err(Error::field(file, &field, format!("fits `{one}` and `{two}`: write more of the path")));
        };
        let Some(view) = capture.views.iter().position(|view| view.name == only) else { continue };
        let other = capture.views[view].split.filter(|other| *other != split);
        if let Some(other) = other {
            let what = format!("`{only}` is a {other} image by another list: remove it from one of them");
            return Err(Error::field(file, &field, what));
        }
        capture.views[view].split = Some(split);
    }
    if let [first, ..] = &absent[..] {
        let list = shown(file.strip_prefix(&capture.folder).unwrap_or(file));
        let what = format!("`{list}` lists {} images that the model lacks, such as `{first}`", absent.len());
        capture.assumptions.push(what);
    }
    Ok(())
}
