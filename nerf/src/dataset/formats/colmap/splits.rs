//! Lists of the images of each split beside a model.

use super::super::locate::{fitting, shown};
use crate::dataset::capture::Capture;
use crate::dataset::frames::{CHOOSE, Split};
use crate::error::{Error, Result};
use crate::files::write_atomic;
use std::collections::HashMap;
use std::path::Path;

/// nerfstudio's lists, in the folder of the capture. 3D Gaussian Splatting has `test.txt` in that of the model.
const LISTS: [(&str, Split); 4] = [
    ("train_list.txt", Split::Train),
    ("val_list.txt", Split::Val),
    ("validation_list.txt", Split::Val),
    ("test_list.txt", Split::Test),
];

/// Sets the split of each view that a list names, one name a line. An image in lists of both held-out sets is a test
/// image.
///
/// # Errors
/// If a list cannot be read, a name fits several images, or an image is trained on and held out.
pub(super) fn attach(capture: &mut Capture, model: &Path) -> Result<()> {
    let lists = LISTS.map(|(name, split)| (capture.folder.join(name), split));
    for (file, split) in lists.into_iter().chain([(model.join("test.txt"), Split::Test)]) {
        if file.is_file() {
            read(capture, &file, split)?;
        }
    }
    Ok(())
}

/// Writes a list for each split, if images are held out. nerfstudio then requires all three: without validation images
/// that list equals the test list.
pub(super) fn write(capture: &Capture, folder: &Path) -> Result<()> {
    let of = |split: Split| -> String {
        let views = capture.views.iter().filter(|view| view.split == Some(split));
        views.map(|view| format!("{}\n", view.name)).collect()
    };
    if capture.views.iter().all(|view| matches!(view.split, None | Some(Split::Train))) {
        return Ok(());
    }
    for split in Split::ALL {
        let val = Some(of(split)).filter(|names| split != Split::Val || !names.is_empty());
        let names = val.unwrap_or_else(|| of(Split::Test));
        write_atomic(folder.join(format!("{split}_list.txt")), names.as_bytes())?;
    }
    Ok(())
}

fn read(capture: &mut Capture, file: &Path, split: Split) -> Result<()> {
    let text = std::fs::read_to_string(file).map_err(|e| Error::file(file, format!("cannot be read: {e}")))?;
    let names: Vec<String> = capture.views.iter().map(|view| view.name.clone()).collect();
    let exact: HashMap<&str, usize> = names.iter().enumerate().map(|(i, name)| (name.as_str(), i)).collect();
    let mut absent = vec![];
    for (i, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let name = line.trim().replace('\\', "/");
        if name.is_empty() || name.starts_with('#') && !exact.contains_key(name.as_str()) {
            continue;
        }
        let wrong = |what: String| Err(Error::field(file, format!("line {}", i + 1), format!("{what}; {CHOOSE}")));
        let view = match exact.get(name.as_str()) {
            Some(&view) => view,
            None => match fitting(names.iter().map(String::as_str), &name)[..] {
                [] => {
                    absent.push(name);
                    continue;
                }
                [one] => exact[one],
                [one, two, ..] => return wrong(format!("fits `{one}` and `{two}`: write more of the path")),
            },
        };
        let other = capture.views[view].split.replace(split);
        if split != Split::Train && other == Some(Split::Train) {
            return wrong(format!("`{}` is in train_list.txt too: remove it from one of them", names[view]));
        }
    }
    if let [first, ..] = &absent[..] {
        let list = shown(file.strip_prefix(&capture.folder).unwrap_or(file));
        let what = format!("`{list}` lists {} images that the model lacks, such as `{first}`", absent.len());
        capture.assumptions.push(what);
    }
    Ok(())
}
