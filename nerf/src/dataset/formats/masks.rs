//! Masks in a folder beside the images.

use super::paths::folded;
use crate::dataset::capture::Capture;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// Names of mask folders.
const FOLDERS: [&str; 2] = ["masks", "mask"];

/// Sets the masks of views that have one in a mask folder of `roots`. An assumption says if only some have one.
pub(super) fn attach(capture: &mut Capture, roots: &[PathBuf]) {
    let folders = roots.iter().flat_map(|root| FOLDERS.map(|name| root.join(name)));
    let folders: Vec<PathBuf> = folders.filter(|folder| folder.is_dir()).collect();
    let Some(name) = folders.first().and_then(|folder| folder.file_name()).map(Path::new) else { return };
    let mut listings = HashMap::new();
    for view in &mut capture.views {
        // COLMAP's own naming comes first.
        let own = Path::new(&view.name);
        let names = [format!("{}.png", view.name).into(), own.with_extension("png"), own.to_owned()];
        let mut paths = folders.iter().flat_map(|folder| names.iter().map(move |name| folder.join(name)));
        let exact = paths.clone().find(|path| path.is_file());
        view.mask = exact.or_else(|| paths.find_map(|path| in_any_case(&mut listings, &path)));
    }
    let present = capture.present().count();
    let masked = capture.present().filter(|view| view.mask.is_some()).count();
    if masked < present {
        let name = name.display();
        let what = format!("{masked} of {present} images have a mask in `{name}`; the others use all pixels");
        capture.assumptions.push(what);
    }
}

/// The files of each folder, by folded name.
type Listings = HashMap<PathBuf, HashMap<String, PathBuf>>;

/// The file of this path with its name in any case and Unicode normal form.
fn in_any_case(listings: &mut Listings, path: &Path) -> Option<PathBuf> {
    let lower = |path: &Path| Some(folded(path.file_name()?.to_str()?));
    let folder = path.parent()?;
    let listing = listings.entry(folder.to_owned()).or_insert_with(|| {
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
        let mut files: Vec<PathBuf> = entries.filter(|path| path.is_file()).collect();
        files.sort();
        files.into_iter().filter_map(|path| Some((lower(&path)?, path))).collect()
    });
    listing.get(&lower(path)?).cloned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::formats::kit::{picture, picture_with_camera};

    #[test]
    fn mask_names_match_in_every_unicode_normal_form() {
        for (name, mask) in [("Caf\u{e9}.jpg", "cafe\u{301}.png"), ("Cafe\u{301}.jpg", "Caf\u{e9}.jpg.png")] {
            let folder = tempfile::tempdir().unwrap();
            let mut capture = picture_with_camera(folder.path());
            capture.views[0].name = name.into();
            let mask = folder.path().join("masks").join(mask);
            picture(&mask, 8, 6);
            attach(&mut capture, &[folder.path().to_owned()]);
            assert_eq!((capture.views[0].mask.as_ref(), capture.assumptions.len()), (Some(&mask), 0), "{name}");
        }
    }
}
