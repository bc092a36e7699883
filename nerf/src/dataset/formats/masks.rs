//! Masks in a folder beside the images, and dynamic masks among them.

use super::locate::{IMAGES, factor_in, stem};
use super::paths::{extension, folded};
use crate::dataset::capture::{Capture, View};
use crate::error::{Error, Result};
use std::collections::{BTreeSet, HashMap, HashSet};
use std::path::{Path, PathBuf};

/// Names of mask folders, in any case; downscaled masks have their factor after it, as `masks_4`.
const FOLDERS: [&str; 2] = ["masks", "mask"];

/// The mask folders of a capture. Of each name, larger masks come first.
fn folders(root: &Path) -> Vec<PathBuf> {
    let rated = |path: PathBuf| {
        let name = path.file_name()?.to_str()?;
        let lower = name.to_lowercase();
        let place = |base: &&str| Some((factor_in(&lower, base)?, FOLDERS.iter().position(|other| other == base)?));
        let (factor, place) = FOLDERS.iter().find_map(place)?;
        path.is_dir().then(|| (factor, place, name != lower, path.clone()))
    };
    let entries = std::fs::read_dir(root).into_iter().flatten().flatten();
    let mut found: Vec<_> = entries.filter_map(|entry| rated(entry.path())).collect();
    found.sort();
    found.into_iter().map(|(.., path)| path).collect()
}

/// Sets the masks of views without one that have one in a mask folder of `roots`. An assumption says if only some have
/// one.
///
/// # Errors
/// If a mask fits two images.
pub(super) fn attach(capture: &mut Capture, roots: &[PathBuf]) -> Result<()> {
    let folders: Vec<PathBuf> = roots.iter().flat_map(|root| folders(root)).collect();
    let Some(name) = folders.first().and_then(|folder| folder.file_name()).map(Path::new) else {
        return Ok(());
    };
    let (mut listings, mut counts) = (HashMap::new(), HashMap::new());
    for view in &capture.views {
        *counts.entry(plain(&view.name).to_owned()).or_insert(0) += 1;
    }
    for view in capture.views.iter_mut().filter(|view| view.mask.is_none()) {
        // COLMAP's own naming comes first. A name without folders must be that of a single image.
        let last = Some(plain(&view.name)).filter(|last| counts[*last] == 1);
        let own = [Path::new(&view.name)].into_iter().chain(inner(&view.name)).chain(last);
        let names = own.flat_map(|own| {
            let whole = PathBuf::from(format!("{}.png", own.display()));
            let others = ["jpg", "jpeg", "webp"].map(|ending| own.with_extension(ending));
            [whole, own.with_extension("png"), own.to_owned()].into_iter().chain(others)
        });
        let names: Vec<PathBuf> = names.collect();
        let mut paths = folders.iter().flat_map(|folder| names.iter().map(move |name| folder.join(name)));
        let exact = paths.clone().find(|path| path.is_file());
        view.mask = exact.or_else(|| paths.find_map(|path| in_any_case(&mut listings, &path)));
    }
    let mut owners: HashMap<PathBuf, usize> = HashMap::new();
    for i in 0..capture.views.len() {
        let view = &capture.views[i];
        let Some(mask) = view.mask.clone().filter(|_| view.image.is_some() && is_masked(&view)) else { continue };
        let first = *owners.entry(mask.clone()).or_insert(i);
        if capture.views[first].image == view.image {
            continue;
        }
        // A mask with an image's exact name is that image's alone.
        let [other, name] = [first, i].map(|i| &capture.views[i].name);
        match [other, name].map(|name| mask.ends_with(name)) {
            [true, false] => capture.views[i].mask = None,
            [false, true] => {
                owners.insert(mask, i);
                capture.views[first].mask = None;
            }
            _ => {
                let mask = mask.display();
                let what =
                    format!("has a mask that also fits `{other}`, {mask}: name masks `{other}.png` and `{name}.png`");
                return Err(Error::field(&capture.file, &view.field, what));
            }
        }
    }
    // Names with a number may also be those of objects.
    let name_of = |folder: &PathBuf| folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let is_used = |folder: &&PathBuf| {
        capture.present().filter_map(|view| view.mask.as_ref()).any(|mask| mask.starts_with(folder))
    };
    let numbered = folders.iter().filter(is_used).map(name_of).find(|name| name.contains('_'));
    capture.assumptions.extend(numbered.map(|name| format!("there are no larger masks: used those in `{name}`")));
    note_unmasked(capture, &format!("a mask in `{}`", name.display()));
    Ok(())
}

/// Returns true for a view with a mask that is white where pixels are used.
fn is_masked(view: &&View) -> bool {
    view.mask.is_some() && !view.mask_is_dynamic
}

/// Adds an assumption if only some images have such masks.
fn note_unmasked(capture: &mut Capture, masks: &str) {
    let [present, masked] = [capture.present().count(), capture.present().filter(is_masked).count()];
    let unmasked = capture.present().filter(|view| view.mask.is_none()).count();
    if masked < present {
        let rest = if unmasked > 0 { format!("; {unmasked} have no mask, and use all pixels") } else { String::new() };
        capture.assumptions.push(format!("{masked} of {present} images have {masks}{rest}"));
    }
}

/// [`attach`] for files whose frames may list masks. If any does, no others are used.
///
/// # Errors
/// If a mask fits two images.
pub(super) fn attach_unlisted(capture: &mut Capture) -> Result<()> {
    if capture.views.iter().any(|view| is_masked(&view)) {
        note_unmasked(capture, "a `mask_path`");
        return Ok(());
    }
    let root = capture.folder.clone();
    attach(capture, &[root])?;
    let mask = capture.present().filter(is_masked).find_map(|view| view.mask.clone());
    if let Some(mask) = mask {
        let mask = mask.strip_prefix(&capture.folder).unwrap_or(&mask).display();
        let what = format!("no frame lists a mask: used those beside them, such as `{mask}` (white is used)");
        capture.assumptions.push(what);
    }
    Ok(())
}

/// The name of an image without its folders.
fn plain(name: &str) -> &Path {
    Path::new(name).file_name().unwrap_or_default().as_ref()
}

/// The path of an image below its folder of images, if it starts with one.
fn inner(name: &str) -> Option<&Path> {
    let (folder, inner) = name.split_once('/')?;
    let folder = folded(folder);
    (IMAGES.contains(&&*folder) || factor_in(&folder, "images").is_some()).then(|| Path::new(inner))
}

/// The start of the names of instant-ngp's dynamic masks.
const DYNAMIC: &str = "dynamic_mask_";

/// Sets instant-ngp's masks of moving objects, which stand beside images, where a view has no other. Returns notes on
/// them, and on those that fit no image.
pub(super) fn attach_dynamic(views: &mut [&mut View]) -> Vec<String> {
    let of = |image: &PathBuf| Some(image.with_file_name(format!("{DYNAMIC}{}.png", image.file_stem()?.to_str()?)));
    let images: Vec<PathBuf> = views.iter().filter_map(|view| view.image.clone()).collect();
    let unused = unused(views, &images);
    // A name that differs in case may be that of another image's mask.
    let exact: HashSet<PathBuf> = images.iter().filter_map(of).collect();
    let (mut listings, mut first, mut count) = (HashMap::new(), None, 0);
    for view in views.iter_mut().filter(|view| view.mask.is_none()) {
        let Some(path) = view.image.as_ref().and_then(of) else { continue };
        let mut other = |path: &Path| in_any_case(&mut listings, path).filter(|mask| !exact.contains(mask));
        let Some(mask) = (if path.is_file() { Some(path) } else { other(&path) }) else { continue };
        first.get_or_insert_with(|| mask.clone());
        (view.mask, view.mask_is_dynamic) = (Some(mask), true);
        count += 1;
    }
    let name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let used = first.iter().map(|first| {
        let (first, present) = (name(first), images.len());
        format!(
            "{count} of {present} images have a dynamic mask of instant-ngp, such as `{first}`: used only its black pixels"
        )
    });
    let unused = unused.first().map(|first| {
        let (first, count) = (name(first), unused.len());
        format!(
            "{count} dynamic masks fit no image, such as `{first}`: name that of `NAME.jpg` `{DYNAMIC}NAME.png` to use it"
        )
    });
    used.chain(unused).collect()
}

/// The dynamic masks in the folders of `images` that fit neither an image there nor an absent one.
fn unused(views: &[&mut View], images: &[PathBuf]) -> BTreeSet<PathBuf> {
    let absent: HashSet<String> = views
        .iter()
        .filter(|view| view.image.is_none())
        .map(|view| stem(view.name.rsplit('/').next().unwrap_or_default()))
        .collect();
    let masks = views.iter().filter_map(|view| view.mask.as_ref());
    let depths = views.iter().filter_map(|view| Some(&view.depth.as_ref()?.0));
    let listed: HashSet<&PathBuf> = images.iter().chain(masks).chain(depths).collect();
    let folders: BTreeSet<&Path> = images.iter().filter_map(|image| image.parent()).collect();
    let mut out = BTreeSet::new();
    for folder in folders {
        let files: Vec<PathBuf> = files(folder).collect();
        let name = |path: &PathBuf| Some(folded(path.file_name()?.to_str()?));
        let stems: HashSet<String> = files.iter().filter_map(name).map(|name| stem(&name)).collect();
        let is_unused = |file: &PathBuf| {
            let Some(name) = name(file).filter(|name| extension(name).is_some()) else { return false };
            let Some(of) = name.strip_prefix(DYNAMIC) else { return false };
            let fits = |of: &str| stems.contains(of) || absent.contains(of);
            !listed.contains(file) && !of.strip_suffix(".png").is_some_and(fits)
        };
        out.extend(files.iter().filter(|file| is_unused(file)).cloned());
    }
    out
}

/// The files of a folder.
fn files(folder: &Path) -> impl Iterator<Item = PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    entries.filter(|path| path.is_file())
}

/// The files of each folder, by folded name.
type Listings = HashMap<PathBuf, HashMap<String, PathBuf>>;

/// The file of this path with its name in any case and Unicode normal form.
fn in_any_case(listings: &mut Listings, path: &Path) -> Option<PathBuf> {
    let lower = |path: &Path| Some(folded(path.file_name()?.to_str()?));
    let folder = path.parent()?;
    let listing = listings.entry(folder.to_owned()).or_insert_with(|| {
        let mut files: Vec<PathBuf> = files(folder).collect();
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
            attach(&mut capture, &[folder.path().to_owned()]).unwrap();
            assert_eq!((capture.views[0].mask.as_ref(), capture.assumptions.len()), (Some(&mask), 0), "{name}");
        }
    }

    #[test]
    fn mask_folders_are_found_in_any_case() {
        let found = |places: &[&str]| {
            let folder = tempfile::tempdir().unwrap();
            let mut capture = picture_with_camera(folder.path());
            places.iter().for_each(|place| picture(&folder.path().join(place).join("0.png"), 8, 6));
            attach(&mut capture, &[folder.path().to_owned()]).unwrap();
            let mask = capture.views.remove(0).mask?;
            let is_noted = capture.assumptions.iter().any(|note| note.starts_with("there are no larger masks: used"));
            assert_eq!(is_noted, mask.to_string_lossy().contains("sk_") || mask.to_string_lossy().contains("sks_"));
            Some(mask.parent()?.file_name()?.to_str()?.to_owned())
        };
        for (places, expected) in [
            (&["Masks"][..], Some("Masks")),
            (&["MASK"], Some("MASK")),
            (&["Masks", "masks"], Some("masks")),
            (&["mask", "Masks"], Some("Masks")),
            (&["masks_4"], Some("masks_4")),
            (&["Mask_2"], Some("Mask_2")),
            (&["masks_8", "masks_4"], Some("masks_4")),
            (&["masks_2", "mask"], Some("mask")),
            (&["masks_old"], None),
            (&["masks_2024"], None),
            (&["mask_1"], None),
            (&["masks_"], None),
        ] {
            assert_eq!(found(places).as_deref(), expected, "{places:?}");
        }
    }

    #[test]
    fn masks_that_fit_two_images_are_refused() {
        let check = |masks: &[&str]| {
            let folder = tempfile::tempdir().unwrap();
            let mut capture = picture_with_camera(folder.path());
            let image = folder.path().join("images/0.jpg");
            capture.views.push(View { name: "0.jpg".into(), image: Some(image), ..capture.views[0].clone() });
            masks.iter().for_each(|mask| picture(&folder.path().join("masks").join(mask), 8, 6));
            attach(&mut capture, &[folder.path().to_owned()]).map_err(|error| error.to_string())?;
            let name = |view: &View| Some(view.mask.as_ref()?.file_name()?.to_str()?.to_owned());
            Ok::<_, String>(capture.views.iter().map(name).collect::<Vec<_>>())
        };
        let message = check(&["0.webp"]).unwrap_err();
        assert!(
            message.contains("has a mask that also fits `0.png`, ") && message.contains("masks/0.webp: name masks")
        );
        assert!(message.ends_with("`0.png.png` and `0.jpg.png`"), "{message}");
        let [own, other] = ["0.png", "0.jpg.png"].map(|name| Some(name.to_owned()));
        assert_eq!(check(&["0.png", "0.jpg.png"]), Ok(vec![own.clone(), other]));
        // The exact name of one.
        assert_eq!(check(&["0.png"]), Ok(vec![own, None]));
        assert_eq!(check(&["0.jpg"]), Ok(vec![None, Some("0.jpg".to_owned())]));
    }

    /// The file name of each view's dynamic mask, and the notes, of images and masks with these names.
    fn dynamic(images: &[&str], absent: &[&str], masks: &[&str]) -> (Vec<Option<String>>, Vec<String>) {
        let folder = tempfile::tempdir().unwrap();
        let mut view = picture_with_camera(folder.path()).views.remove(0);
        let at = |name: &&str| folder.path().join("images").join(name);
        images.iter().chain(masks).for_each(|name| picture(&at(name), 8, 6));
        let mut named = |name: &&str, image| {
            (view.name, view.image) = (format!("images/{name}"), image);
            view.clone()
        };
        let mut views: Vec<View> = images.iter().map(|name| named(name, Some(at(name)))).collect();
        views.extend(absent.iter().map(|name| named(name, None)));
        let notes = attach_dynamic(&mut views.iter_mut().collect::<Vec<_>>());
        assert!(views.iter().all(|view| view.mask_is_dynamic == view.mask.is_some()));
        let name = |path: PathBuf| path.file_name().unwrap().to_str().unwrap().to_owned();
        (views.into_iter().map(|view| view.mask.map(name)).collect(), notes)
    }

    #[test]
    fn dynamic_masks_match_in_any_case_and_unicode_normal_form() {
        for (image, mask) in [
            ("A.png", "dynamic_mask_a.PNG"),
            ("a.jpg", "Dynamic_Mask_A.png"),
            ("Caf\u{e9}.jpg", "dynamic_mask_cafe\u{301}.png"),
        ] {
            let (found, notes) = dynamic(&[image], &[], &[mask]);
            assert_eq!(found, [Some(mask.to_owned())], "{image}");
            let expected = format!("1 of 1 images have a dynamic mask of instant-ngp, such as `{mask}`: ");
            assert!(matches!(&notes[..], [note] if note.starts_with(&expected)), "{notes:?}");
        }
        // Another image's mask is not taken.
        let (found, _) = dynamic(&["a.jpg", "A.png"], &[], &["dynamic_mask_A.png"]);
        assert_eq!(found, [None, Some("dynamic_mask_A.png".to_owned())]);
    }

    #[test]
    fn dynamic_masks_without_an_image_are_noted() {
        let note = |count: usize, first: &str| {
            let rest = "name that of `NAME.jpg` `dynamic_mask_NAME.png` to use it";
            vec![format!("{count} dynamic masks fit no image, such as `{first}`: {rest}")]
        };
        let wrong = ["dynamic_mask_a.jpg.png", "dynamic_mask_b.webp.png", "Dynamic_mask_9.png"];
        for (masks, expected) in [
            (&wrong[..], note(3, "Dynamic_mask_9.png")),
            (&["dynamic_mask_a.jpg"], note(1, "dynamic_mask_a.jpg")),
            (&["dynamic_mask_b.png", "mask_c.png"], vec![]),
        ] {
            assert_eq!(dynamic(&["a.jpg"], &["b.jpg"], masks), (vec![None; 2], expected), "{masks:?}");
        }
    }
}
