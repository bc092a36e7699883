use super::super::kit;
use super::*;
use crate::dataset::capture::View;
use crate::dataset::formats::colmap::Encoding;

fn read(path: &Path, asked: Option<Format>) -> Result<Capture> {
    super::read(path, asked, true)
}

/// Writes a capture of `total` images of which `present` exist, in a format; COLMAP's in the model `number`.
fn write(folder: &Path, format: Format, [present, total]: [usize; 2], number: usize) {
    let capture = kit::picture_with_camera(folder);
    let view = |i: usize| {
        let name = format!("{i}.png");
        let image = folder.join("images").join(&name);
        if i < present {
            kit::picture(&image, 8, 6);
        }
        View { name, image: Some(image), ..capture.views[0].clone() }
    };
    let prefix = |view: View| View { name: format!("images/{}", view.name), ..view };
    let views: Vec<View> = (0..total).map(view).collect();
    let capture = match format {
        Format::Colmap | Format::Llff => Capture { views, ..capture },
        _ => Capture { views: views.into_iter().map(prefix).collect(), ..capture },
    };
    match format {
        Format::Transforms => transforms::write(&capture, folder).unwrap(),
        Format::Blender => blender::write(&capture, folder).unwrap(),
        Format::Llff => llff::write(&capture, folder).unwrap(),
        Format::Colmap => {
            let other = tempfile::tempdir().unwrap();
            colmap::write(&capture, other.path(), Encoding::Binary).unwrap();
            std::fs::create_dir_all(folder.join("sparse")).unwrap();
            std::fs::rename(other.path().join("sparse/0"), folder.join(format!("sparse/{number}"))).unwrap();
        }
    }
}

#[test]
fn earlier_formats_have_priority() {
    let folder = tempfile::tempdir().unwrap();
    let message = read(folder.path(), None).unwrap_err().to_string();
    for expected in ["is not a dataset", "transforms.json", "transforms_train.json", "sparse/0", "poses_bounds.npy"] {
        assert!(message.contains(expected), "{message}");
    }
    // Written from the last format to the first: each has priority over the existing ones.
    for format in [Format::Llff, Format::Colmap, Format::Blender, Format::Transforms] {
        write(folder.path(), format, [1, 1], 0);
        let capture = read(folder.path(), None).unwrap();
        assert_eq!((capture.format, capture.assumptions), (format, vec![]));
    }
    for format in [Format::Llff, Format::Colmap, Format::Blender, Format::Transforms] {
        assert_eq!(read(folder.path(), Some(format)).unwrap().format, format);
    }
}

/// Writes a file of frames with these paths, and a picture for each.
fn write_frames(folder: &Path, file: &str, names: &[&str]) {
    let document = serde_json::json!({ "camera_angle_x": 0.8, "frames": kit::frames(names) });
    std::fs::create_dir_all(folder).unwrap();
    std::fs::write(folder.join(file), document.to_string()).unwrap();
    names.iter().for_each(|name| kit::picture(&folder.join(name), 8, 6));
}

/// The splits of the images by name, and the assumptions.
fn splits_of(folder: &Path) -> (Vec<(String, Option<Split>)>, Vec<String>) {
    let capture = Capture::read(folder).unwrap();
    (capture.views.into_iter().map(|view| (view.name, view.split)).collect(), capture.assumptions)
}

#[test]
fn splits_of_blenders_files_are_those_of_the_same_images() {
    let folder = tempfile::tempdir().unwrap();
    let names = ["images/0.png", "images/1.png", "images/2.png", "images/3.png"];
    write_frames(folder.path(), "transforms.json", &names);
    write_frames(folder.path(), "transforms_train.json", &names[..3]);
    write_frames(folder.path(), "transforms_test.json", &names[3..]);
    let [train, _, test] = Split::ALL.map(Some);
    let expected: Vec<_> =
        names.into_iter().zip([train, train, train, test]).map(|(name, split)| (name.to_owned(), split)).collect();
    let note = "the splits are those of `transforms_train.json` and the files like it".to_owned();
    assert_eq!(splits_of(folder.path()), (expected.clone(), vec![note.clone()]));
    // A run reads the file that it has read before.
    let file = folder.path().join("transforms.json");
    let again = Capture::read_description(folder.path(), &file).unwrap();
    assert_eq!(again.views.into_iter().map(|view| (view.name, view.split)).collect::<Vec<_>>(), expected);
    // Images beside the folder of both.
    std::fs::create_dir(folder.path().join("ngp")).unwrap();
    for name in ["transforms.json", "transforms_train.json", "transforms_test.json"] {
        std::fs::copy(folder.path().join(name), folder.path().join("ngp").join(name)).unwrap();
    }
    assert_eq!(splits_of(&folder.path().join("ngp")).0, expected);
    // An image that they lack is in no split.
    write_frames(folder.path(), "transforms_train.json", &names[..2]);
    let (splits, notes) = splits_of(folder.path());
    assert_eq!((splits[2].1, splits[3].1), (None, test));
    let [counts, splits_note, unused] = &notes[..] else { panic!("{notes:?}") };
    kit::says(counts, &["images found: `transforms.json` 4 of 4, `transforms_train.json` 3 of 3; used the first"]);
    assert_eq!(splits_note, &note);
    assert_eq!(unused, "1 images are in no split, such as `images/2.png`: they are not used");
    // As many other images are no twin.
    std::fs::remove_file(folder.path().join("transforms_train.json")).unwrap();
    write_frames(folder.path(), "transforms_test.json", &["t/0.png", "t/1.png", "t/2.png", "t/3.png"]);
    let (_, notes) = splits_of(folder.path());
    kit::says(&notes[0], &["images found: `transforms.json` 4 of 4, `transforms_test.json` 4 of 4; used the first"]);
    assert_eq!(notes.len(), 1);
    // Files that are no JSON say nothing, and neither do those that give all images that exist one split.
    std::fs::write(folder.path().join("transforms_test.json"), "{").unwrap();
    let (_, notes) = splits_of(folder.path());
    assert!(notes.iter().any(|note| note.starts_with("the splits of `transforms_test.json` and")), "{notes:?}");
    write_frames(folder.path(), "transforms_test.json", &names);
    std::fs::remove_file(folder.path().join("images/3.png")).unwrap();
    let splits: Vec<_> = splits_of(folder.path()).0.into_iter().map(|(_, split)| split).collect();
    assert_eq!(splits, [test, train, train, train], "every eighth");
    // Lists of the file itself come first.
    write_frames(folder.path(), "transforms_test.json", &names);
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, text.replacen('{', "{\"test_filenames\": [\"images/0.png\"],", 1)).unwrap();
    assert_eq!(splits_of(folder.path()).0[..2], [(names[0].to_owned(), test), (names[1].to_owned(), train)]);
}

#[test]
fn folders_of_images_are_splits() {
    use Split::{Test, Train, Val};
    for (names, expected) in [
        (&["train/0.png", "train/1.png", "test/2.png"][..], Some([Train, Train, Test])),
        (&["images/Train/0.png", "images/EVAL/1.png", "images/train/2.png"], Some([Train, Val, Train])),
        (&["test/train/0.png", "test/val/1.png", "test/test/2.png"], Some([Train, Val, Test])),
        // All images are of one split, or some of none.
        (&["train/0.png", "train/1.png", "train/2.png"], None),
        (&["test/0.png", "test/1.png", "test/2.png"], None),
        (&["a/0.png", "test/1.png", "train/2.png"], None),
        (&["test/absent.png", "train/1.png", "train/2.png", "train/3.png"], None),
        (&["training/0.png", "test/1.png", "train/2.png"], None),
    ] {
        let folder = tempfile::tempdir().unwrap();
        write_frames(folder.path(), "transforms.json", names);
        let _ = std::fs::remove_file(folder.path().join("test/absent.png"));
        let (splits, notes) = splits_of(folder.path());
        let splits: Vec<_> = splits.into_iter().filter_map(|(_, split)| split).collect();
        match expected {
            Some(expected) => {
                assert_eq!(splits, expected, "{names:?}");
                kit::says(&notes[0], &["folders of the images are splits, such as that of `"]);
            }
            // Every eighth, from the first by name.
            None => {
                assert_eq!(splits, [vec![Test], vec![Train; names.len() - 1]].concat(), "{names:?}");
                assert!(notes.is_empty(), "{notes:?}");
            }
        }
    }
}

#[test]
fn images_beside_the_folder_of_a_file_are_found() {
    let folder = tempfile::tempdir().unwrap();
    let inner = folder.path().join("ngp");
    write_frames(&inner, "transforms.json", &["images/0.png", "images/1.png"]);
    std::fs::rename(inner.join("images"), folder.path().join("images")).unwrap();
    for path in [&inner, &inner.join("transforms.json")] {
        let capture = read(path, None).unwrap();
        assert_eq!(capture.present().count(), 2);
        let [note] = &capture.assumptions[..] else { panic!("{:?}", capture.assumptions) };
        kit::says(note, &["no images are beside `", "transforms.json`: used others, such as `images/0.png`"]);
    }
    // What is wrong with the images there is the error.
    let file = inner.join("transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, text.replacen("\"file_path\"", "\"mask_path\": \"masks/0.png\", \"file_path\"", 1)).unwrap();
    kit::says(&read(&inner, None).unwrap_err().to_string(), &["there is no file masks/0.png: copy it there"]);
    std::fs::write(&file, text).unwrap();
    // Images of the same names in other folders are those of other captures.
    std::fs::remove_dir_all(folder.path().join("images")).unwrap();
    for other in ["b", "b/images"] {
        (0..2).for_each(|i| kit::picture(&folder.path().join(other).join(format!("{i}.png")), 8, 6));
        let capture = read(&inner, None).unwrap();
        assert_eq!((capture.present().count(), capture.views.len(), capture.assumptions.len()), (0, 2, 0), "{other}");
    }
    std::fs::remove_dir_all(folder.path().join("b")).unwrap();
    for near in ["images_2", "rgb", "."] {
        (0..2).for_each(|i| kit::picture(&folder.path().join(near).join(format!("{i}.png")), 8, 6));
        assert_eq!(read(&inner, None).unwrap().present().count(), 2, "{near}");
        (0..2).for_each(|i| std::fs::remove_file(folder.path().join(near).join(format!("{i}.png"))).unwrap());
    }
}

#[test]
fn most_complete_description_counts() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    write(path, Format::Colmap, [2, 2], 0);
    write(path, Format::Colmap, [5, 7], 1);
    let capture = read(path, None).unwrap();
    assert_eq!(capture.file, path.join("sparse/1/images.bin"));
    assert_eq!(capture.assumptions, ["images found: `sparse/1` 5 of 7, `sparse/0` 2 of 2; used the first"]);
    // A file whose images are all absent.
    write(path, Format::Transforms, [0, 3], 0);
    let file = path.join("transforms.json");
    let text = std::fs::read_to_string(&file).unwrap().replace("images/", "../images_of_old/x");
    std::fs::write(&file, text).unwrap();
    let capture = read(path, None).unwrap();
    assert_eq!(capture.format, Format::Colmap);
    let expected = ["images found: `sparse/1` 5 of 7, `transforms.json` 0 of 3, `sparse/0` 2 of 2; used the first"];
    assert_eq!(capture.assumptions, expected);
    // LLFF with all images of the folder.
    std::fs::remove_dir_all(path.join("sparse/1")).unwrap();
    write(path, Format::Llff, [5, 5], 0);
    assert_eq!(read(path, None).unwrap().format, Format::Llff);
    assert!(
        read(path, Some(Format::Blender))
            .unwrap_err()
            .to_string()
            .ends_with("holds no capture in the format Blender, but `transforms.json`, `sparse/0`, `poses_bounds.npy`")
    );
}

/// COLMAP's own workspace: a model with a lens, whose images are elsewhere, and undistorted images with their model.
#[test]
fn undistorted_images_are_not_those_of_a_lens() {
    for inner in ["dense/0", "dense"] {
        let folder = tempfile::tempdir().unwrap();
        let (path, inner) = (folder.path(), folder.path().join(inner));
        std::fs::create_dir_all(&inner).unwrap();
        write(&inner, Format::Colmap, [4, 4], 0);
        let mut capture = read(&inner, None).unwrap();
        let lens = Lens::Brown { k: [0.1, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
        capture.views.iter_mut().for_each(|view| view.camera.lens = lens);
        colmap::write(&capture, path, Encoding::Binary).unwrap();
        let used = read(path, None).unwrap();
        assert_eq!((used.folder, used.file), (inner.clone(), inner.join("sparse/0/images.bin")));
        let name = inner.strip_prefix(path).unwrap().display().to_string();
        let expected = format!(
            "`sparse/0/images.bin` has a lens, and its images were undistorted for `{name}/sparse/0/images.bin`: used \
             this"
        );
        assert_eq!(used.assumptions, [expected]);
        let own = path.join("sparse/0/images.bin");
        let message = read(&own, None).unwrap_err().to_string();
        let expected = format!("images.bin: has a lens, and the only images found for it, in `{name}`, are without");
        assert!(message.contains(&expected), "{message}");
        // Its own images, and a model of the same images with a lens, are used as they are.
        for i in 0..4 {
            kit::picture(&path.join(format!("images/{i}.png")), 8, 6);
        }
        for path in [path, &own] {
            let used = read(path, None).unwrap();
            assert_eq!((used.file, used.assumptions), (own.clone(), vec![]));
        }
        std::fs::remove_dir_all(path.join("images")).unwrap();
        std::fs::remove_dir_all(inner.join("sparse")).unwrap();
        std::fs::create_dir_all(inner.join("sparse")).unwrap();
        std::fs::rename(path.join("sparse/0"), inner.join("sparse/0")).unwrap();
        colmap::write(&capture, path, Encoding::Binary).unwrap();
        assert_eq!(read(path, None).unwrap().file, own);
    }
}

#[test]
fn a_stale_list_of_images_gives_way_to_a_complete_model() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    write(path, Format::Colmap, [10, 10], 0);
    write(path, Format::Transforms, [10, 10], 0);
    let file = path.join("transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(
        &file,
        (0..3).fold(text.clone(), |text, i| text.replace(&format!("/{i}.png"), &format!("/old{i}.png"))),
    )
    .unwrap();
    let capture = read(path, None).unwrap();
    assert_eq!((capture.format, capture.present().count()), (Format::Colmap, 10));
    assert_eq!(capture.assumptions, ["images found: `sparse/0` 10 of 10, `transforms.json` 7 of 10; used the first"]);
    assert_eq!(read(path, Some(Format::Transforms)).unwrap().present().count(), 7, "as requested");
    std::fs::write(&file, text).unwrap();
    assert_eq!(read(path, None).unwrap().format, Format::Transforms, "a whole list");
}

#[test]
fn both_encodings_of_a_model_count() {
    let [folder, other] = [0, 1].map(|_| tempfile::tempdir().unwrap());
    let path = folder.path();
    write(path, Format::Colmap, [5, 5], 0);
    // The text of an earlier model, and a newer one.
    for (total, expected) in [(3, "sparse/0/images.bin"), (5, "sparse/0/images.bin"), (7, "sparse/0/images.txt")] {
        write(other.path(), Format::Colmap, [7, total], total);
        let capture = read(&other.path().join(format!("sparse/{total}")), None).unwrap();
        let text = tempfile::tempdir().unwrap();
        colmap::write(&capture, text.path(), Encoding::Text).unwrap();
        for name in ["cameras.txt", "images.txt"] {
            std::fs::copy(text.path().join("sparse/0").join(name), path.join("sparse/0").join(name)).unwrap();
        }
        (0..total).for_each(|i| kit::picture(&path.join(format!("images/{i}.png")), 8, 6));
        let capture = read(path, None).unwrap();
        assert_eq!(capture.file, path.join(expected));
        let note = match total {
            3 => "images found: `sparse/0/images.bin` 5 of 5, `sparse/0/images.txt` 3 of 3; used the first",
            5 => "",
            _ => "images found: `sparse/0/images.txt` 7 of 7, `sparse/0/images.bin` 5 of 5; used the first",
        };
        assert_eq!(capture.assumptions.concat(), note);
    }
    // An empty file is damaged, and the error names the other.
    std::fs::write(path.join("sparse/0/images.bin"), "").unwrap();
    let message = read(path, None).unwrap_err().to_string();
    let advice = "to use `sparse/0/images.txt` instead, name ";
    assert!(message.contains("sparse/0/images.bin") && message.contains(advice), "{message}");
}

#[test]
fn archives_are_to_be_unpacked() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("Scan.ZIP");
    std::fs::write(&file, "PK").unwrap();
    let message = |path: &Path| read(path, None).unwrap_err().to_string();
    assert!(message(&file).contains("Scan.ZIP: is an archive: unpack it, and name the folder"));
    assert!(message(folder.path()).contains("is not a dataset, but holds the archive `Scan.ZIP`: unpack it"));
    std::fs::write(folder.path().join("zip"), "").unwrap();
    assert!(message(&folder.path().join("zip")).contains("does not describe a capture"));
    write(folder.path(), Format::Transforms, [1, 1], 0);
    assert_eq!(read(folder.path(), None).unwrap().views.len(), 1);
}

#[test]
fn files_name_their_description() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    write(path, Format::Colmap, [4, 4], 0);
    write(path, Format::Colmap, [2, 2], 3);
    write(path, Format::Transforms, [3, 3], 0);
    std::fs::copy(path.join("transforms.json"), path.join("some.json")).unwrap();
    let count = |file: &str| {
        let capture = read(&path.join(file), None).unwrap();
        assert_eq!((capture.folder.as_path(), capture.assumptions.len()), (path, 0), "{file}");
        capture.present().count()
    };
    for (file, expected) in [
        ("transforms.json", 3),
        ("some.json", 3),
        ("sparse/0/images.bin", 4),
        ("sparse/3/images.bin", 2),
        ("sparse/3/cameras.bin", 2),
        ("sparse/3/points3D.bin", 2),
    ] {
        assert_eq!(count(file), expected, "{file}");
    }
    assert_eq!(count("sparse/3"), 2, "a model's folder");
    // A model, what names its capture, and the capture's folder, which may be called `sparse` too.
    for (model, named, folder) in [
        ("a/colmap/sparse/0", "a/colmap/sparse/0", "a"),
        ("b/distorted/sparse/0", "b/distorted/sparse/0", "b"),
        ("c/sparse", "c/sparse", "c"),
        ("sparse/garden/sparse/0", "sparse/garden", "sparse/garden"),
        ("sparse/garden/sparse/0", "sparse/garden/sparse/0", "sparse/garden"),
    ] {
        let other = path.join("other");
        std::fs::create_dir_all(other.join(model)).unwrap();
        for name in ["cameras.bin", "images.bin"] {
            std::fs::copy(path.join("sparse/3").join(name), other.join(model).join(name)).unwrap();
        }
        assert_eq!(read(&other.join(named), None).unwrap().folder, other.join(folder), "{named}");
    }
    let message = read(&path.join("some.json"), Some(Format::Llff)).unwrap_err().to_string();
    assert!(message.ends_with("some.json: describes a capture in the format transforms.json, not LLFF"), "{message}");
    assert!(read(&path.join("sparse/3/images.bin"), Some(Format::Colmap)).is_ok());
    let message = read(&path.join("images/0.png"), None).unwrap_err().to_string();
    assert!(message.contains("images/0.png: does not describe a capture: name a folder"), "{message}");
    write(path, Format::Blender, [1, 1], 0);
    write(path, Format::Llff, [4, 4], 0);
    assert_eq!(read(&path.join("transforms_train.json"), None).unwrap().format, Format::Blender);
    assert_eq!(read(&path.join("poses_bounds.npy"), None).unwrap().format, Format::Llff);
}

/// A folder in which the files of a capture's description are somewhere else.
fn moved(format: Format, files: &[(&str, &str)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), format, [3, 3], 0);
    for (from, to) in files {
        let to = folder.path().join(to);
        std::fs::create_dir_all(to.parent().unwrap()).unwrap();
        std::fs::rename(folder.path().join(from), to).unwrap();
    }
    _ = std::fs::remove_dir_all(folder.path().join("sparse/0"));
    folder
}

#[test]
fn captures_are_found_in_unusual_places() {
    let check = |folder: &tempfile::TempDir, file: &str, root: &str| {
        let path = folder.path();
        let capture = read(path, None).unwrap();
        assert_eq!((capture.present().count(), &capture.folder), (3, &path.join(root)), "{file}");
        let (used, others) = capture.assumptions.split_first().unwrap();
        assert_eq!(*used, format!("the usual places hold no capture: used `{file}`"));
        let images = format!("no images are beside `{file}`: used others, such as `images/0.png`");
        assert_eq!(others.iter().collect::<Vec<_>>(), [&images][..usize::from(file.starts_with("output"))].to_vec());
        assert!(is_described(path));
        // As a run keeps it.
        assert_eq!(read_file(&capture.folder, &path.join(file), true).unwrap().present().count(), 3);
    };
    for place in
        ["colmap_sparse/0", "colmap_text", "colmap/sparse", "colmap", "sparse/model", "Sparse/0", "a/b/c", "a/b/c/d"]
    {
        let files = ["cameras.bin", "images.bin"].map(|name| [format!("sparse/0/{name}"), format!("{place}/{name}")]);
        let folder = moved(Format::Colmap, &files.each_ref().map(|[from, to]| (from.as_str(), to.as_str())));
        check(&folder, &format!("{place}/images.bin"), "");
        assert!(matches!(read(folder.path(), Some(Format::Llff)), Err(error) if error.to_string().contains(place)));
    }
    // With images of their own.
    for place in ["dense", "dense/0", "undistorted", "scene"] {
        let files =
            ["cameras.bin", "images.bin"].map(|name| [format!("sparse/0/{name}"), format!("{place}/sparse/{name}")]);
        let folder = moved(Format::Colmap, &files.each_ref().map(|[from, to]| (from.as_str(), to.as_str())));
        let path = folder.path();
        let message = read(path, None).unwrap_err().to_string();
        let expected = "has no images, and may have undistorted ones of its own: copy those to";
        let expected = format!("{place}/sparse/images.bin: {expected} `{place}/images` or, to use");
        assert!(message.contains(&expected), "{message}");
        assert!(message.ends_with("others, such as `images/0.png`, move the model to `sparse/0`"), "{message}");
        std::fs::rename(path.join("images"), path.join(place).join("images")).unwrap();
        check(&folder, &format!("{place}/sparse/images.bin"), place);
    }
    let distort = |model: &Path| {
        let mut bytes = std::fs::read(model.join("cameras.bin")).unwrap();
        // One camera of COLMAP's model OPENCV, which has four more parameters.
        bytes[12] = 4;
        bytes.extend([0.1, 0.0, 0.0, 0.0].map(f64::to_le_bytes).concat());
        std::fs::write(model.join("cameras.bin"), bytes).unwrap();
    };
    // A model with distortion, whose images are those beside its folder.
    for place in ["output/sparse/0", "output/colmap/sparse", "colmap/sparse/0/refined"] {
        let files = ["cameras.bin", "images.bin"].map(|name| [format!("sparse/0/{name}"), format!("{place}/{name}")]);
        let folder = moved(Format::Colmap, &files.each_ref().map(|[from, to]| (from.as_str(), to.as_str())));
        distort(&folder.path().join(place));
        check(&folder, &format!("{place}/images.bin"), "");
    }
    // 3D Gaussian Splatting's, whose images are in `input`.
    let place = "colmap/distorted/sparse/0";
    let files = ["cameras.bin", "images.bin"].map(|name| [format!("sparse/0/{name}"), format!("{place}/{name}")]);
    let folder = moved(Format::Colmap, &files.each_ref().map(|[from, to]| (from.as_str(), to.as_str())));
    distort(&folder.path().join(place));
    let input = folder.path().join("input");
    (0..3).for_each(|i| kit::picture(&input.join(format!("{i}.png")), 8, 6));
    assert_eq!(read(folder.path(), None).unwrap().views[0].image, Some(input.join("0.png")));
    // A fourth level counts if three hold nothing.
    let folder = moved(Format::Transforms, &[("transforms.json", "a/b/c/d/transforms.json")]);
    std::fs::rename(folder.path().join("images"), folder.path().join("a/b/c/d/images")).unwrap();
    check(&folder, "a/b/c/d/transforms.json", "a/b/c/d");
    let [far, near] = ["a/b/c/d", "a/b/c"].map(|place| folder.path().join(place));
    (0..3).for_each(|i| kit::picture(&near.join(format!("images/{i}.png")), 8, 6));
    std::fs::copy(far.join("transforms.json"), near.join("transforms.json")).unwrap();
    check(&folder, "a/b/c/transforms.json", "a/b/c");
    for name in ["Transforms.json", "transform.json", "transforms.json.txt"] {
        check(&moved(Format::Transforms, &[("transforms.json", name)]), name, "");
    }
    for (format, file) in [
        (Format::Transforms, "transforms.json"),
        (Format::Blender, "transforms_train.json"),
        (Format::Llff, "poses_bounds.npy"),
    ] {
        let inside = format!("scene/{file}");
        check(&moved(format, &[(file, &inside), ("images", "scene/images")]), &inside, "scene");
    }
    // Paths from the searched folder, and images beside the folder of the file.
    for (place, images) in [("output", "images"), ("nerfstudio", "resized")] {
        let file = format!("{place}/transforms.json");
        let folder = moved(Format::Transforms, &[("transforms.json", &file)]);
        let path = folder.path();
        if images != "images" {
            std::fs::rename(path.join("images"), path.join(images)).unwrap();
            let text = std::fs::read_to_string(path.join(&file)).unwrap();
            std::fs::write(path.join(&file), text.replace("images/", "")).unwrap();
        }
        // Points are beside the file.
        let text = std::fs::read_to_string(path.join(&file)).unwrap();
        let text = text.replacen('{', "{\"ply_file_path\": \"points.ply\",", 1);
        std::fs::write(path.join(&file), &text).unwrap();
        let points = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                      end_header\n1 2 3\n";
        std::fs::write(path.join(place).join("points.ply"), points).unwrap();
        let capture = read(path, None).unwrap();
        assert_eq!((capture.present().count(), capture.points.len(), &*capture.folder), (3, 1, path), "{file}");
        let note = format!("no images are beside `{file}`: used others, such as `{images}/0.png`");
        assert_eq!(capture.assumptions.last(), Some(&note));
        // The file itself, or a folder above the images, may be named. ScanNet++ lists masks by their names alone.
        assert_eq!(read(&path.join(&file), None).unwrap().present().count(), 3);
        let outer = tempfile::tempdir().unwrap();
        let inner = outer.path().join("dslr");
        for folder in [place, images] {
            std::fs::create_dir_all(inner.join(folder)).unwrap();
            for entry in std::fs::read_dir(path.join(folder)).unwrap().flatten() {
                std::fs::copy(entry.path(), inner.join(folder).join(entry.file_name())).unwrap();
            }
        }
        let mut document: serde_json::Value = serde_json::from_str(&text).unwrap();
        for (i, frame) in document["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
            frame["mask_path"] = serde_json::json!(format!("{i}.png"));
            kit::picture(&inner.join(format!("resized_anon_masks/{i}.png")), 8, 6);
        }
        std::fs::write(inner.join(&file), document.to_string()).unwrap();
        for named in [outer.path().to_owned(), inner.clone(), inner.join(&file)] {
            let capture = read(&named, None).unwrap();
            assert_eq!(capture.present().count(), 3, "{}", named.display());
            assert_eq!(capture.views[0].mask, Some(inner.join("resized_anon_masks/0.png")), "{}", named.display());
        }
        assert_eq!(read_file(path, &path.join(&file), true).unwrap().present().count(), 3, "as a run keeps it");
        // Some images beside the file are its own.
        kit::picture(&path.join(place).join(if images == "images" { "images/0.png" } else { "0.png" }), 8, 6);
        assert_eq!(read(path, None).unwrap().present().count(), 1);
    }
    // Images farther below may be those of another capture, unless the file has their paths.
    let folder = moved(Format::Transforms, &[("transforms.json", "a/transforms.json"), ("images", "b/images")]);
    assert_eq!(read(folder.path(), None).unwrap().present().count(), 0);
    let file = folder.path().join("a/transforms.json");
    let text = std::fs::read_to_string(&file).unwrap();
    std::fs::write(file, text.replace("images/", "b/images/")).unwrap();
    assert_eq!(read(folder.path(), None).unwrap().present().count(), 3);
    // Usual places come first.
    let folder = moved(Format::Transforms, &[("transforms.json", "old/transforms.json"), ("images", "old/images")]);
    write(folder.path(), Format::Llff, [1, 1], 0);
    assert_eq!(read(folder.path(), None).unwrap().format, Format::Llff);
}

#[test]
fn several_captures_in_unusual_places_are_named() {
    let folder = moved(Format::Transforms, &[("transforms.json", "b/transforms.json"), ("images", "b/images")]);
    let path = folder.path();
    std::fs::create_dir(path.join("a")).unwrap();
    write(&path.join("a"), Format::Llff, [1, 1], 0);
    let message = read(path, None).unwrap_err().to_string();
    let expected = "holds several captures, `a/poses_bounds.npy`, `b/transforms.json`: name one of them";
    assert!(message.ends_with(expected), "{message}");
    assert_eq!(read(path, Some(Format::Llff)).unwrap().folder, path.join("a"));
    assert!(is_described(path));
    // Two descriptions of one capture, and two files like transforms.json.
    std::fs::remove_dir_all(path.join("a")).unwrap();
    write(&path.join("b"), Format::Colmap, [3, 4], 0);
    assert_eq!(read(path, None).unwrap().file, path.join("b/transforms.json"));
    std::fs::copy(path.join("b/transforms.json"), path.join("b/transforms_2.json")).unwrap();
    assert!(read(path, None).unwrap_err().to_string().contains("`b/transforms.json`, `b/transforms_2.json`: name"));
    // Hidden folders and deeper ones.
    let places = [".cache/transforms.json", "a/b/c/d/e/transforms.json"];
    for place in places {
        let folder = moved(Format::Transforms, &[("transforms.json", place)]);
        assert!(read(folder.path(), None).unwrap_err().to_string().contains("is not a dataset"), "{place}");
        assert!(!is_described(folder.path()), "{place}");
    }
    let folder = moved(Format::Transforms, &[("transforms.json", "transform_2.json")]);
    assert!(read(folder.path(), None).unwrap_err().to_string().ends_with("name that file"));
    assert!(is_described(folder.path()) && read(&folder.path().join("transform_2.json"), None).is_ok());
}

#[test]
fn damaged_descriptions_before_the_best_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    write(path, Format::Colmap, [3, 3], 0);
    std::fs::write(path.join("transforms.json"), "{").unwrap();
    let message = read(path, None).unwrap_err().to_string();
    assert!(message.contains("transforms.json") && message.contains("is not valid JSON"), "{message}");
    assert!(
        message.contains("; to use `sparse/0` instead, name ") && message.ends_with("sparse/0/images.bin"),
        "{message}"
    );
    // Damaged descriptions after the best are named.
    std::fs::remove_file(path.join("transforms.json")).unwrap();
    write(path, Format::Colmap, [1, 1], 1);
    std::fs::write(path.join("sparse/1/images.bin"), "?").unwrap();
    let expected = ["images found: `sparse/0` 3 of 3, `sparse/1` is damaged; used the first"];
    assert_eq!(read(path, None).unwrap().assumptions, expected);
}

#[test]
fn the_folder_above_the_current_one_is_found() {
    let here = std::env::current_dir().unwrap();
    assert_eq!(above(Path::new(".")), here.parent().map(Path::to_owned));
    assert_eq!(above(Path::new("a")), Some(PathBuf::from(".")));
    assert_eq!(above(Path::new("a/b/")), Some(PathBuf::from("a")));
    assert_eq!(above(Path::new("/")), None);
}
