//! `raygrad export`: the cameras of a run.

use super::{CLASSIC, Place, SMALL};
use raygrad::nerf::dataset::{Capture, Split};
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::{Camera, Config, Model, SceneBox};
use std::path::Path;

/// The cameras of an exported file, read as those of a dataset in `scene`.
fn exported(place: &Place, file: &str) -> Vec<(String, Option<Split>, Camera)> {
    let folder = tempfile::tempdir_in(place.path("")).unwrap();
    std::fs::copy(place.path(file), folder.path().join("transforms.json")).unwrap();
    cameras(folder.path())
}

fn cameras(folder: &Path) -> Vec<(String, Option<Split>, Camera)> {
    let capture = Capture::read(folder).unwrap();
    let name = |name: &str| name.trim_end_matches(".png").to_owned();
    capture.views.iter().map(|view| (name(&view.name), view.split, view.camera.clone())).collect()
}

#[test]
fn exported_cameras_return_as_given() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 1 --out plain {SMALL}"));
    let said = place.succeeds("export plain cameras.json");
    assert_eq!(said, "exported 11 cameras, 0 of them refined: cameras.json\n");
    let given = cameras(&place.path("scene"));
    let close = |a: &Camera, b: &Camera, slack: f64| a.pose.abs_diff_eq(b.pose, slack);
    for (before, after) in given.iter().zip(exported(&place, "cameras.json")) {
        assert_eq!((&before.0, before.1, before.2.focal), (&after.0, after.1, after.2.focal));
        assert_eq!(before.2.pose, after.2.pose, "to the last bit");
    }

    let learned = r#"--set poses={"constant":{"rate":0.001}}"#;
    place.succeeds(&format!("train scene --steps 8 --out run --scene-type unbounded {SMALL} {learned}"));
    let said = place.succeeds("export run run/cameras.json");
    assert_eq!(said, "exported 11 cameras, 6 of them refined: run/cameras.json\n");
    let config = place.json("run/config.json");
    let part = |name: &str| config[name].clone();
    let extent: SceneBox = serde_json::from_value(part("scene_box")).unwrap();
    let settings: Config = serde_json::from_value(part("config")).unwrap();
    let model = Model::<f32>::load(place.path("run/model.safetensors"), settings, extent).unwrap();
    let mut number = 0;
    for (before, after) in given.iter().zip(exported(&place, "run/cameras.json")) {
        if before.1 == Some(Split::Train) {
            let learned = model.learned_camera(number, &extent.transform.camera(&before.2));
            number += 1;
            let drift = model.camera_optimizer.as_ref().unwrap().transform(&model.params).unwrap();
            let back = extent.transform.camera_back(&drift.camera_back(&learned));
            assert!(close(&back, &after.2, 1e-12) && !close(&back, &before.2, 1e-5), "{}", before.0);
        }
        let trained = before.1 == Some(Split::Train);
        // Cameras that were not trained on stay, since the common drift is removed.
        assert_eq!(close(&before.2, &after.2, 1e-9), !trained, "{}", before.0);
        // The change is small in units of the files.
        assert!(close(&before.2, &after.2, 0.5), "{}: {:?} {:?}", before.0, before.2.pose, after.2.pose);
    }
    // As a dataset: the same cameras, with images.
    place.succeeds("export run colmap --to colmap");
    let (file, colmap) = (exported(&place, "run/cameras.json"), cameras(&place.path("colmap")));
    for (name, _, camera) in &colmap {
        let (_, _, before) = file.iter().find(|(other, ..)| other == name).unwrap();
        assert!(close(camera, before, 1e-9), "{name}");
    }
    assert!(colmap.len() == 11 && place.path("colmap/images/train/r_0.png").exists());
    // Also for captures whose names differ from the paths of their images.
    place.succeeds(&format!("train colmap --steps 1 --out other {SMALL}"));
    place.succeeds("export other colmap/again.json");
    for frame in place.json("colmap/again.json")["frames"].as_array().unwrap() {
        let path = frame["file_path"].as_str().unwrap();
        assert!(place.path(&format!("colmap/{path}")).is_file(), "{path}");
    }
    place.fails_with(
        "export run scene",
        "scene: has no known file extension: use .json for cameras, .ply, .obj or .glb for a mesh, .html for a scene \
         page, or name a format with --to",
    );
    place.fails_with("export run colmap --to llff", "colmap: is not empty: choose another folder");
    // Refined cameras need the training images of the run.
    std::fs::remove_file(place.path("scene/train/r_3.png")).unwrap();
    place.fails("export run other.json", &["has 5 training images", "trained on 6"]);
    assert!(!place.path("other.json").exists());
}

#[test]
fn built_in_scene_exports_its_cameras() {
    let place = Place::empty();
    place.succeeds(&format!("train --steps 1 --downscale 10 {CLASSIC}"));
    assert!(place.succeeds("export run cameras.json").starts_with("exported 90 cameras, 0 of them refined"));
    let cameras = exported(&place, "cameras.json");
    let of = |split: Split| cameras.iter().filter(|(_, given, _)| *given == Some(split)).count();
    assert_eq!((of(Split::Train), of(Split::Val), of(Split::Test)), (60, 10, 20));
}

/// The vertices of a PLY file, and its header.
fn vertices(place: &Place, file: &str) -> (Vec<DVec3>, String) {
    let bytes = place.bytes(file);
    let end = bytes.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8(bytes[..end].to_vec()).unwrap();
    let count = header.lines().find_map(|line| line.strip_prefix("element vertex ")).unwrap().parse().unwrap();
    // Three doubles, three floats and three bytes per vertex.
    let number = |row: &[u8], axis: usize| f64::from_le_bytes(row[8 * axis..][..8].try_into().unwrap());
    let rows = bytes[end..].chunks_exact(39).take(count);
    (rows.map(|row| DVec3::new(number(row, 0), number(row, 1), number(row, 2))).collect(), header)
}

#[test]
fn meshes_are_in_capture_coordinates() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 2 --out run --scene-type unbounded {SMALL}"));
    let extent: SceneBox = serde_json::from_value(place.json("run/config.json")["scene_box"].clone()).unwrap();
    assert!((extent.transform.scale - 1.0).abs() > 0.01, "the test is of coordinates that differ");
    // The model is still a fog: at a low iso-value its surface is the box.
    let said = place.succeeds("export run mesh.ply --iso-value 1e-6 --resolution 20");
    assert!(
        said.starts_with("exported ") && said.contains(", closed; iso-value 0.0000 per scene unit, 20 cells"),
        "{said}"
    );
    assert!(!said.contains(", 0 small components removed"), "small components go by default: {said}");
    let (mesh, header) = vertices(&place, "mesh.ply");
    assert!(header.contains("element face") && mesh.len() > 1000, "{header}");
    let within = |places: &[DVec3], slack: f64| {
        let [low, high] = extent.bounds;
        let slack = DVec3::splat(slack);
        places.iter().all(|x| {
            let x = extent.transform.point(*x);
            x.cmpge(low - slack).all() && x.cmple(high + slack).all()
        })
    };
    let cell = extent.space().side() / 20.0;
    assert!(within(&mesh, cell) && !within(&mesh, -cell));
    let open = place.succeeds("export run open.ply --iso-value 1e-6 --resolution 20 --min-component 0 --open-boundary");
    assert!(open.contains("0 small components removed") && !open.contains(", closed"), "{open}");

    let few = place.succeeds("export run few.glb --iso-value 1e-6 --resolution 20 --triangles 500");
    assert!(few.contains(" 500 triangles, closed"), "{few}");
    // Four triangles are too few for a closed surface with such a topology; the program says so.
    let output = place.command("export run few.ply --iso-value 1e-6 --resolution 20 --triangles 4").output().unwrap();
    let [said, noted] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    let count = said.split(" triangles").next().unwrap().rsplit(' ').next().unwrap();
    assert!(count.parse::<usize>().unwrap() > 4, "{said}");
    let expected = format!("the mesh keeps {count} triangles, more than 4: fewer would fold it or lose a component\n");
    assert_eq!(noted, expected, "{said}");
    assert_eq!(&place.bytes("few.glb")[..4], b"glTF");
    place.succeeds("export run mesh.OBJ --iso-value 1e-6 --resolution 20");
    assert!(place.bytes("mesh.OBJ").starts_with(b"# x y z red green blue"));

    let said = place.succeeds("export run points.ply --points=50");
    let (points, header) = vertices(&place, "points.ply");
    assert!(said.contains(&format!("exported {} points, from ", points.len())) && !header.contains("face"), "{said}");
    assert!((10..=50).contains(&points.len()) && within(&points, 1e-9));
    place.fails("export run no.ply --iso-value=-1", &["`iso_value`: is -1; use a density above 0"]);
    place.fails("export run no.ply --iso-value 1e30 --no-fill-unseen", &["`iso_value`: is 1", "use a smaller"]);
    place.fails_with(
        "export run cameras.json --triangles 9",
        "`triangles`: applies to meshes and point clouds: name a .ply, .obj or .glb file",
    );
    place.fails_with(
        "export run cameras.json --points",
        "`points`: applies to meshes and point clouds: name a .ply, .obj or .glb file",
    );
    // Six images and four rings of twelve views; the rings are enough if the capture is gone.
    assert!(said.contains("in 54 views"), "{said}");
    std::fs::rename(place.path("scene"), place.path("moved")).unwrap();
    assert!(place.succeeds("export run some.ply --points=20").contains("in 48 views"));
    let moved = place.succeeds("export run some.ply --points=20 --scene moved");
    assert!(moved.contains("in 54 views"), "{moved}");
    place.fails("export run no.ply --scene scene", &["scene: there is no such folder"]);
    place.fails_with(
        "export run no.ply --to colmap --open-boundary",
        "`open-boundary`: applies to meshes and point clouds: name a .ply, .obj or .glb file",
    );
    place.fails("export run absent/no.ply", &["absent"]);
    std::fs::create_dir(place.path("folder.glb")).unwrap();
    place.fails_with("export run folder.glb", "folder.glb: is a folder, not a file");
    assert!(!place.path("no.ply").exists());
}
