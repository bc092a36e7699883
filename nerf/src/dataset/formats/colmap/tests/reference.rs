//! Comparison with COLMAP: `tests/reference/colmap.py` wrote the files and COLMAP's projections of points.

use super::*;
use serde_json::Value;

fn reference() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference/colmap")
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

/// The projection of a point, by the formulas of COLMAP's documentation.
fn pixel(camera: &Camera, point: DVec3) -> [f64; 2] {
    let local = camera.pose.matrix3.transpose() * (point - camera.pose.translation);
    let (x, y) = (local.x / -local.z, -local.y / -local.z);
    let (x, y) = match camera.lens {
        Lens::Brown { k, p } => {
            let r2 = x * x + y * y;
            let radial = k[0] * r2 + k[1] * r2 * r2;
            let dx = x * radial + 2.0 * p[0] * x * y + p[1] * (r2 + 2.0 * x * x);
            let dy = y * radial + 2.0 * p[1] * x * y + p[0] * (r2 + 2.0 * y * y);
            (x + dx, y + dy)
        }
        Lens::Fisheye { k, p, s } => {
            let r = x.hypot(y);
            let (x, y) = (x * r.atan() / r, y * r.atan() / r);
            let r2 = x * x + y * y;
            let radial = k[0] * r2 + k[1] * r2.powi(2) + k[2] * r2.powi(3) + k[3] * r2.powi(4);
            let dx = x * radial + 2.0 * p[0] * x * y + p[1] * (r2 + 2.0 * x * x) + s[0] * r2;
            let dy = y * radial + 2.0 * p[1] * x * y + p[0] * (r2 + 2.0 * y * y) + s[1] * r2;
            (x + dx, y + dy)
        }
        _ => (x, y),
    };
    [x * camera.focal[0] + camera.centre[0], y * camera.focal[1] + camera.centre[1]]
}

#[test]
fn projections_equal_colmaps() {
    let expected: Value =
        serde_json::from_str(&fs::read_to_string(reference().join("expected.json")).unwrap()).unwrap();
    for encoding in ["binary", "text"] {
        let capture = read(&reference().join(encoding)).unwrap();
        let names: Vec<&str> = capture.views.iter().map(|view| view.name.as_str()).collect();
        assert_eq!(names, ["left/a.png", "left/b.png", "right.png"]);
        let points = expected["points"].as_array().unwrap();
        assert_eq!(capture.points.len(), points.len());
        for (point, expected) in capture.points.iter().zip(points) {
            assert_eq!(point.position.to_array().to_vec(), numbers(&expected["position"]));
            assert_eq!(point.color.map(f64::from).to_vec(), numbers(&expected["color"]));
            assert_eq!(Some(u64::from(point.views)), expected["views"].as_u64());
            assert_eq!(Some(point.error), expected["error"].as_f64());
        }
        for view in &capture.views {
            let (camera, expected) = (&view.camera, &expected["images"][&view.name]);
            let size = [&expected["width"], &expected["height"]].map(|side| side.as_u64().unwrap() as usize);
            assert_eq!([camera.width, camera.height], size);
            let near = |a: DVec3, b: &Value| assert!((a - DVec3::from_slice(&numbers(b))).length() < 1e-14, "{a} {b}");
            near(camera.pose.translation, &expected["position"]);
            near(-camera.pose.matrix3.z_axis, &expected["direction"]);
            for (point, expected) in capture.points.iter().zip(expected["pixels"].as_array().unwrap()) {
                let (found, expected) = (pixel(camera, point.position), numbers(expected));
                let error = (found[0] - expected[0]).hypot(found[1] - expected[1]);
                assert!(error < 1e-10, "{}: {found:?} {expected:?}", view.name);
            }
        }
    }
}

/// Writes files for `colmap.py --check`, which compares COLMAP's projections through them with those through its own.
#[test]
#[ignore = "writes to the folder RAYGRAD_COLMAP"]
fn written_models_for_colmap_check() {
    let Some(folder) = std::env::var_os("RAYGRAD_COLMAP").map(PathBuf::from) else { return };
    let capture = read(&reference().join("binary")).unwrap();
    write(&capture, &folder.join("binary"), Encoding::Binary).unwrap();
    write(&capture, &folder.join("text"), Encoding::Text).unwrap();
}
