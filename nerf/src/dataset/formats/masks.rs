//! Masks in a folder beside the images.

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

/// The files of each folder, by name in lower case.
type Listings = HashMap<PathBuf, HashMap<String, PathBuf>>;

/// The file of this path with its name in any case.
fn in_any_case(listings: &mut Listings, path: &Path) -> Option<PathBuf> {
    let lower = |path: &Path| Some(path.file_name()?.to_str()?.to_lowercase());
    let folder = path.parent()?;
    let listing = listings.entry(folder.to_owned()).or_insert_with(|| {
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
        let mut files: Vec<PathBuf> = entries.filter(|path| path.is_file()).collect();
        files.sort();
        files.into_iter().filter_map(|path| Some((lower(&path)?, path))).collect()
    });
    listing.get(&lower(path)?).cloned()
}
