use super::*;

/// A folder `scene` with these files.
fn scene(files: &[&str]) -> (tempfile::TempDir, PathBuf) {
    let parent = tempfile::tempdir().unwrap();
    let folder = parent.path().join("scene");
    std::fs::create_dir(&folder).unwrap();
    for file in files {
        let path = folder.join(file);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, b"").unwrap();
    }
    (parent, folder)
}

/// The files that are found, below the folder, and the assumptions; or the name's index and the message.
fn found(files: &[&str], names: &[&str]) -> Result<(Vec<Option<String>>, Vec<String>), Ambiguity> {
    let (_parent, folder) = scene(files);
    let mut assumptions = vec![];
    let inside = |file: Located| file.path.strip_prefix(&folder).unwrap().to_str().unwrap().to_owned();
    let located = locate(&folder, names, &HashSet::new(), &mut assumptions)?;
    Ok((located.into_iter().map(|file| file.map(inside)).collect(), assumptions))
}

#[track_caller]
fn finds(files: &[&str], names: &[&str], expected: &[&str]) {
    let (paths, assumptions) = found(files, names).unwrap();
    let paths: Vec<&str> = paths.iter().map(|path| path.as_deref().unwrap_or("")).collect();
    assert_eq!(paths, expected);
    let is_moved = paths.iter().zip(names).any(|(path, name)| !path.is_empty() && path != name);
    assert_eq!(assumptions.len(), usize::from(is_moved), "{assumptions:?}");
}

#[track_caller]
fn refuses(files: &[&str], names: &[&str], parts: &[&str]) {
    let (_, what) = found(files, names).unwrap_err();
    parts.iter().for_each(|part| assert!(what.contains(part), "no `{part}` in: {what}"));
}

#[test]
fn listed_files_come_first() {
    finds(&["images/0.png", "other/0.png"], &["images/0.png", "other/0.png"], &["images/0.png", "other/0.png"]);
    finds(&["images/0.png"], &["images/0.png", "images/1.png"], &["images/0.png", ""]);
}

#[test]
fn folders_are_found_by_the_end_of_the_path() {
    let files = ["images/frame_1.jpg", "images/frame_2.jpg", "transforms.json"];
    let places = ["../slike", "C:/data", "/home/someone/data/images", "scene/images", "scene", "", "a/b/images"];
    for place in places.into_iter().chain(["D:/depth-scans/mine/images", "/train/normal/mine/images"]) {
        let names = ["frame_1.jpg", "frame_2.jpg"].map(|name| format!("{place}/{name}"));
        let names = names.each_ref().map(|name| name.trim_start_matches('/'));
        let names =
            if place.starts_with('/') { names.map(|name| format!("/{name}")) } else { names.map(str::to_owned) };
        finds(&files, &names.each_ref().map(String::as_str), &["images/frame_1.jpg", "images/frame_2.jpg"]);
    }
    // The capture's own folder.
    finds(&["0.jpg", "b/0.jpg"], &["/home/someone/scene/0.jpg"], &["0.jpg"]);
    // Cameras with images of the same names.
    let files = ["images/cam1/0.png", "images/cam2/0.png"];
    finds(&files[1..], &["D:/x/cam2/0.png"], &["images/cam2/0.png"]);
    let (paths, assumptions) = found(&files, &["D:/x/cam1/0.png", "D:/x/cam2/0.png"]).unwrap();
    assert_eq!(paths, files.map(|file| Some(file.to_owned())));
    assert_eq!(assumptions.len(), 2, "one for each folder: {assumptions:?}");
}

#[test]
fn folders_are_searched_to_a_depth() {
    finds(&["1/2/3/4/5/6/7/8/0.png"], &["images/0.png"], &["1/2/3/4/5/6/7/8/0.png"]);
    finds(&["1/2/3/4/5/6/7/8/9/0.png"], &["images/0.png"], &[""]);
}

#[test]
fn letter_case_and_extension_may_differ() {
    finds(&["Images/IMG_1.JPG"], &["images/img_1.jpg"], &["Images/IMG_1.JPG"]);
    finds(&["images/a.png", "images/b.png"], &["images/a.jpg", "images/b.jpg"], &["images/a.png", "images/b.png"]);
    finds(&["images/a.png", "images/B.PNG"], &["images/a.png", "images/b.png"], &["images/a.png", "images/B.PNG"]);
    // Beside images that are there, one with another extension is another image.
    finds(&["images/a.jpg", "images/b.png"], &["images/a.jpg", "images/b.jpg"], &["images/a.jpg", ""]);
    // The same extension comes first.
    finds(&["images/A.jpg", "images/a.png"], &["images/a.JPG"], &["images/A.jpg"]);
    // Names without an extension, as Blender writes them.
    finds(&["images/r_0.png"], &["./x/r_0"], &["images/r_0.png"]);
}

#[test]
fn unicode_normal_forms_may_differ() {
    let [composed, decomposed] = ["Caf\u{e9}", "Cafe\u{301}"];
    for (listed, stored) in [(composed, decomposed), (decomposed, composed)] {
        let [file, name] = [stored, listed].map(|name| format!("images/{name}.jpg"));
        finds(&[&file], &[&name], &[&file]);
        let note = format!("`{name}` does not exist: used `{file}` (in another Unicode normal form)");
        assert_eq!(found(&[&file], &[&name]).unwrap().1, [note]);
        // Beside images that are there as listed, and with other letters or another extension.
        finds(&[&file, "images/0.jpg"], &["images/0.jpg", &name], &["images/0.jpg", &file]);
        finds(&[&file], &[&name.to_uppercase()], &[&file]);
        finds(&[&file], &[&name.replace("jpg", "png")], &[&file]);
        // A folder.
        let [inside, place] = [stored, listed].map(|name| format!("{name}/0.jpg"));
        finds(&[&inside, "other/0.jpg"], &[&place], &[&inside]);
        // The name itself comes first, then the same letters in another form.
        finds(&[&file, &name], &[&name], &[&name]);
        finds(&[&file, &file.to_lowercase()], &[&name], &[&file]);
        let upper = format!("images/{}.jpg", listed.to_uppercase());
        let parts = ["does not exist", "(in another Unicode normal form) fit: correct the path"];
        refuses(&[&file, &name], &[&upper], &parts);
        assert!(found(&[&file], &[&file, &name]).unwrap().0[1].is_none(), "a file that another name lists");
    }
    // Other letters are other names.
    finds(&["images/Cafe.jpg"], &["images/Caf\u{e9}.jpg"], &[""]);
}

#[test]
fn ambiguous_files_are_refused() {
    refuses(
        &["a/0.png", "b/0.png"],
        &["images/0.png"],
        &["`images/0.png` does not exist", "`a/0.png` and `b/0.png` fit"],
    );
    refuses(&["images/0.png", "images/0.webp"], &["x/0.jpg"], &["`images/0.png` and `images/0.webp` fit"]);
    refuses(&["images/A.jpg", "images/a.jpg"], &["x/a.JPG"], &["`images/A.jpg` and `images/a.jpg` fit"]);
    let what = ["`left/0.png` and `right/0.png` do not exist", "`images/0.png` fits both"];
    refuses(&["images/0.png"], &["left/0.png", "right/0.png"], &what);
    assert_eq!(
        found(&["a/0.png", "a/1.png", "b/1.png", "b/0.png"], &["x/2.png", "y/0.png", "y/1.png"]).unwrap_err().0,
        1
    );
    // A file with another's exact name is no copy in another format.
    finds(&["photos/0.png"], &["images/0.jpg", "images/0.png"], &["", "photos/0.png"]);
    finds(&["photos/a.png"], &["images/a.png", "images/A.png"], &["photos/a.png", ""]);
    // A folder without a common part must hold most names.
    finds(&["a/0.png", "b/1.png"], &["x/0.png", "x/1.png"], &["", ""]);
    finds(&["x/a/0.png", "x/b/1.png"], &["y/a/0.png", "y/a/2.png"], &["x/a/0.png", ""]);
    // The same name twice is no ambiguity.
    assert!(found(&["images/0.png"], &["x/0.png", "x/0.png"]).is_ok());
}

#[test]
fn files_of_another_kind_take_no_place() {
    let absent = |files: &[&str], names: &[&str]| finds(files, names, &vec![""; names.len()]);
    absent(&["test/r_0.png"], &["train/r_0.png"]);
    absent(&["val/r_0.png", "test/r_0.png"], &["train/r_0.png"]);
    absent(&["masks/0.png", "depth/0.png", "normals/0.png", "segmentation/0.png"], &["images/0.jpg"]);
    absent(&["confidence/0.png", "alpha/0.png", "label/0.png", "Labels/0.png"], &["images/0.jpg"]);
    for layer in ["disparity", "semantic", "instance", "seg", "flow", "edges", "matte", "thumbnails", "preview_jpg"] {
        absent(&[&format!("{layer}/0.png")], &["images/0.png"]);
    }
    for scene in ["flower", "matterhorn", "hedges"] {
        let file = format!("{scene}/0.png");
        finds(&[&file], &["images/0.png"], &[&file]);
    }
    finds(&["confidence/0.png", "rgb/0.png"], &["images/0.png"], &["rgb/0.png"]);
    absent(&["images/0.png"], &["masks/0.png"]);
    absent(&["train_hr/r_0.png"], &["test/r_0.png"]);
    let (_parent, folder) = scene(&["pictures/0.png"]);
    let taken = HashSet::from([folder.join("pictures/0.png")]);
    assert_eq!(locate(&folder, &["images/0.jpg"], &taken, &mut vec![]).unwrap(), [None], "the file of a mask");
    absent(&[".thumbnails/0.png", "images/._0.png"], &["images/0.png"]);
    absent(&["images/00.png", "images/0.txt"], &["images/0.png"]);
    // A listed folder of which a file exists is the right one.
    finds(&["images/0.png", "old/1.png"], &["images/0.png", "images/1.png"], &["images/0.png", ""]);
    // A file that another name lists.
    finds(&["images/0.png", "x/1.png"], &["images/0.png", "y/0.png"], &["images/0.png", ""]);
    finds(&["masks/0.png", "images/0.png"], &["C:/x/masks/0.png"], &["masks/0.png"]);
    finds(&["set/train/0.png", "set/test/0.png"], &["C:/x/train/0.png"], &["set/train/0.png"]);
}

#[test]
fn downscaled_images_count_after_those_of_full_size() {
    finds(&["images_4/0.png", "photos/0.png"], &["frames/0.png"], &["photos/0.png"]);
    finds(&["images_8/0.png", "images_4/0.png"], &["images/0.jpg"], &["images_4/0.png"]);
    let (_parent, folder) = scene(&["images_4/0.png"]);
    let located = locate(&folder, &["images/0.png"], &HashSet::new(), &mut vec![]).unwrap();
    assert_eq!(located[0].as_ref().unwrap().factor, 4);
    let (_parent, nested) = scene(&["dense/images_4/0.png"]);
    let located = locate(&nested, &["images/0.png"], &HashSet::new(), &mut vec![]).unwrap();
    assert_eq!(located[0].as_ref().unwrap().factor, 4);
    let located = locate(&folder, &["images_4/0.png"], &HashSet::new(), &mut vec![]).unwrap();
    assert_eq!(located[0].as_ref().unwrap().factor, 1, "as listed");
    for (name, expected) in
        [("images_8/0.png", 8), ("images_2024/0.png", 1), ("images_0/0.png", 1), ("images_a/0.png", 1)]
    {
        assert_eq!(factor_of(Path::new(name)), expected, "{name}");
    }
}

#[test]
fn assumptions_name_the_first_file_and_count_the_others() {
    let of = |files: &[&str], names: &[&str]| found(files, names).unwrap().1;
    assert_eq!(of(&["images/0.png"], &["x/0.jpg"]), ["`x/0.jpg` does not exist: used `images/0.png`"]);
    let files = ["images/0.png", "images/1.png", "images/2.png"];
    let expected = ["`x/0.jpg` does not exist: used `images/0.png`, and 2 files likewise"];
    assert_eq!(of(&files, &["x/0.jpg", "x/1.jpg", "x/2.jpg"]), expected);
}

#[cfg(unix)]
#[test]
fn names_that_are_not_utf8_and_links_are_found() {
    use std::os::unix::ffi::OsStrExt;
    let (_parent, folder) = scene(&["images/0.png"]);
    let name = OsStr::from_bytes(b"caf\xe9.jpg");
    std::fs::write(folder.join("images").join(name), b"").unwrap();
    let located = locate(&folder, &["images/0.png", "images/caf\u{fffd}.jpg"], &HashSet::new(), &mut vec![]).unwrap();
    assert_eq!(located[1].as_ref().unwrap().path, folder.join("images").join(name));
    // A folder that contains a link to itself.
    std::os::unix::fs::symlink(&folder, folder.join("images/again")).unwrap();
    std::os::unix::fs::symlink(folder.join("images"), folder.join("photos")).unwrap();
    let located = locate(&folder, &["x/0.png"], &HashSet::new(), &mut vec![]).unwrap();
    assert_eq!(located[0].as_ref().unwrap().path, folder.join("images/0.png"), "found once");
}

#[test]
fn images_of_phones_are_found_after_their_conversion() {
    for listed in ["images/0.HEIC", "images/0.tif", "C:/dcim/0.dng", "images/0.avif"] {
        finds(&["images/0.jpg"], &[listed], &["images/0.jpg"]);
    }
    // What cannot be decoded is found too, for an error with the remedy; but what can be comes first.
    finds(&["images/0.HEIC"], &["images/0.jpg"], &["images/0.HEIC"]);
    finds(&["images/0.HEIC", "images/0.png"], &["images/0.jpg"], &["images/0.png"]);
    finds(&["images/0.png", "images/0.TIF"], &["images/0.jpg"], &["images/0.png"]);
    finds(&["images/0.HEIC", "images/0.TIF"], &["images/0.jpg"], &["images/0.TIF"]);
    refuses(&["images/0.heic", "images/0.dng"], &["images/0.jpg"], &["`images/0.dng` and `images/0.heic` fit"]);
    finds(&["images/0.jpg.bak", "images/0.mov"], &["images/0.heic"], &[""]);
}

#[test]
fn names_without_ending_fit_one_format() {
    let (paths, _) = found(&["images/0.jpg", "images/1.PNG"], &["images/0", "images/1"]).unwrap();
    assert_eq!(paths, [Some("images/0.jpg".to_owned()), Some("images/1.PNG".to_owned())]);
    let expected = "`images/0` has no ending, and `images/0.jpg` and `images/0.png` fit: write the ending";
    refuses(&["images/0.jpg", "images/0.png"], &["images/0"], &[expected]);
    finds(&["images/0.jpg", "images/0.png"], &["images/0.jpg"], &["images/0.jpg"]);
    // As `raygrad prepare` writes them in Blender's format, whose names lack `.png`.
    let (paths, _) = found(&["0.jpg", "0.png"], &["0.jpg", "0"]).unwrap();
    assert_eq!(paths, [Some("0.jpg".to_owned()), Some("0.png".to_owned())]);
    finds(&["images/0", "images/0.jpg", "images/0.png"], &["images/0"], &["images/0"]);
}

#[test]
fn listed_paths_count_as_they_stand() {
    // Most images were deleted.
    let names = ["images/0.png", "images/1.png", "images/2.png"];
    finds(&["images/0.png", "backup/0.png", "backup/1.png", "backup/2.png"], &names, &["images/0.png", "", ""]);
    // Of several folders, that with images that can be decoded.
    finds(&["jpg/0.jpg", "raw/0.dng"], &["images/0.png"], &["jpg/0.jpg"]);
    finds(&["heic/0.HEIC", "jpg/0.jpg"], &["images/0.JPG"], &["jpg/0.jpg"]);
}

#[test]
fn folders_of_splits_count_together() {
    let names = ["images/0.png", "images/1.png", "images/2.png"];
    let files = ["images/train/0.png", "images/train/1.png", "images/test/2.png"];
    finds(&files, &names, &files);
    let plain = names.map(|name| name.strip_prefix("images/").unwrap());
    finds(&files, &plain, &files);
    let outer = ["train/images/0.png", "train/images/1.png", "eval/images/2.png"];
    finds(&outer, &names, &outer);
    // The images of one split may be those of another file's.
    finds(&files[..2], &names, &[""; 3]);
    finds(&["images/train/0.png", "train/images/1.png"], &names[..2], &[""; 2]);
    // Those of two captures are not those of one.
    for other in ["b/images/train/1.png", "b/images/test/1.png"] {
        finds(&["a/images/train/0.png", other], &names[..2], &[""; 2]);
    }
    // Names that state a split have no others.
    finds(&files, &["val/0.png", "val/1.png", "val/2.png"], &[""; 3]);
    refuses(
        &["images/train/0.png", "images/test/0.png"],
        &names[..1],
        &["`images/test/0.png`", "`images/train/0.png`"],
    );
    // Images of no split come first.
    finds(&["images/train/0.png", "images/test/1.png", "a/images/0.png"], &names[..2], &["a/images/0.png", ""]);
}
