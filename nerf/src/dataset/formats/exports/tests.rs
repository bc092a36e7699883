use super::*;
use crate::dataset::Capture;

/// The messages of the folder `inside` another one, as it is named, and of the file.
fn messages(file: &str, content: &str) -> [String; 3] {
    let outer = tempfile::tempdir().unwrap();
    let folder = outer.path().join("scan");
    let file = folder.join(file);
    std::fs::create_dir_all(file.parent().unwrap()).unwrap();
    std::fs::write(&file, content).unwrap();
    assert!(Capture::is_described(&folder), "{}", file.display());
    [&folder, outer.path(), &file].map(|path| Capture::read(path).unwrap_err().to_string())
}

#[test]
fn exports_of_other_programs_are_named() {
    for (name, what, remedy) in EXPORTS {
        let [folder, above, _] = messages(name, "");
        assert!(folder.contains(what) && folder.contains(remedy), "{folder}");
        assert!(above.contains("its folder `scan` is") && above.contains(what) && above.contains(remedy), "{above}");
    }
}

#[test]
fn exports_under_other_names_are_known_by_their_ending_or_content() {
    let chunk = "<?xml version=\"1.0\"?>\n<document version=\"1.5.0\">\n  <chunk label=\"1\">";
    let frames = r#"{ "frames": [{ "file_path": "0.png", "transform_matrix": [] }] }"#;
    let splats = r#"[{"id": 0, "img_name": "0", "width": 8, "position": [], "rotation": []}]"#;
    for (name, content, what) in [
        ("project.psx", "", "Agisoft Metashape"),
        ("my project.xml", chunk, "Agisoft Metashape"),
        ("blocks.xml", "<?xml version=\"1.0\"?>\n<BlocksExchange version=\"3.2\">", "BlocksExchange"),
        ("scene.nvm", "NVM_V3", "VisualSFM"),
        ("Barn_COLMAP_SfM.log", "0 0 0", "Tanks and Temples"),
        ("walk_calibrated_camera_parameters.txt", "fileName", "Pix4D"),
        ("sfm.sfm", "{}", "Meshroom"),
        ("views.json", r#"{"version": ["1"], "views": [], "intrinsics": []}"#, "Meshroom"),
        ("bundle/bundle.rd.out", "", "Bundler"),
        ("cams_1/00000001_cam.txt", "", "MVSNet"),
        ("shots.geojson", "{}", "OpenDroneMap"),
        ("cameras.json", splats, "3D Gaussian Splatting"),
        ("poses.csv", "#name,x,y,alt,heading,pitch,roll\n", "RealityCapture"),
    ] {
        let [folder, _, file] = messages(name, content);
        assert!(folder.contains(&format!("holds `{name}`, which is ")) && folder.contains(what), "{folder}");
        assert!(file.contains("which raygrad does not read") && file.contains(what), "{file}");
    }
    let [folder, ..] = messages("scene.json", frames);
    let expected = "holds `scene.json`, which is of the form of transforms.json: name that file";
    assert!(folder.ends_with(expected), "{folder}");
}

#[test]
fn a_model_with_a_missing_file_is_named() {
    for (found, missing) in [("cameras.txt", "images.txt"), ("sparse/0/images.bin", "sparse/0/cameras.bin")] {
        let [folder, ..] = messages(found, "# Image list");
        assert!(folder.contains(&format!("with `{found}` and no `{missing}`")), "{folder}");
    }
}

/// Files beside images that say nothing about cameras.
#[test]
fn other_files_beside_images_are_no_exports() {
    let folder = tempfile::tempdir().unwrap();
    for (name, content) in [
        ("a.xml", "<x:xmpmeta/>"),
        ("a.csv", "a,b\n"),
        ("a.json", "{\"frames\": 3}"),
        ("a.xmp", ""),
        ("images.txt", "0.png"),
    ] {
        std::fs::write(folder.path().join(name), content).unwrap();
    }
    assert!(of_folder(folder.path()).is_none() && below(folder.path()).is_none());
    assert!(!Capture::is_described(folder.path()));
}
