//! The formats that captures come in, each read and written in a file of its own.

use super::capture::{Capture, Format, View};
use crate::camera::{Camera, Lens};
use crate::error::{Error, Result};
use glam::{DAffine3, DMat3, DVec3};
use std::path::Path;

// TEMPORARY
pub fn read(folder: &Path) -> Result<Capture> {
    let file = folder.join("transforms.json");
    let text = std::fs::read_to_string(&file).map_err(|e| Error::file(&file, e))?;
    let v: serde_json::Value = serde_json::from_str(&text).map_err(|e| Error::file(&file, e))?;
    let n = |k: &str| v[k].as_f64().unwrap_or(0.0);
    let views = v["frames"]
        .as_array()
        .unwrap()
        .iter()
        .enumerate()
        .map(|(i, f)| {
            let name = f["file_path"].as_str().unwrap().to_owned();
            let m: Vec<Vec<f64>> = serde_json::from_value(f["transform_matrix"].clone()).unwrap();
            let c = |k: usize| DVec3::new(m[0][k], m[1][k], m[2][k]);
            let path = folder.join(&name);
            let pose = DAffine3 { matrix3: DMat3::from_cols(c(0), c(1), c(2)), translation: c(3) };
            let lens = Lens::Brown { k: [n("k1"), n("k2"), 0.0, 0.0, 0.0, 0.0], p: [n("p1"), n("p2")] };
            View {
                name,
                field: format!("frames[{i}]"),
                image: path.is_file().then_some(path),
                camera: Camera {
                    width: n("w") as usize,
                    height: n("h") as usize,
                    focal: [n("fl_x"), n("fl_y")],
                    centre: [n("cx"), n("cy")],
                    lens,
                    pose,
                },
                split: None,
                mask: None,
                depth: None,
                sharpness: None,
                bounds: None,
            }
        })
        .collect();
    Ok(Capture {
        folder: folder.into(),
        file,
        format: Format::Transforms,
        views,
        points: vec![],
        aabb_scale: None,
        applied: DAffine3::IDENTITY,
    })
}
