//! A scene as one HTML page that renders itself: the table, the networks and the occupied cells, and a program for the graphics
//! card that marches through them as views do.

use std::any::Any;
use std::path::Path;

use half::f16;
use raygrad::nerf::encoding::hash_grid::HashGrid;
use raygrad::nerf::field::{Instant, InstantConfig, log_density_shift};
use raygrad::nerf::sampling::marching::{Marching, MarchingConfig};
use raygrad::nerf::volume::quadrature::Quadrature;
use raygrad::nerf::{Error, Model, Result, write_atomic};
use serde_json::{Value, json};

use crate::cli::base64::base64;
use crate::cli::html::{escaped, filled};
use crate::cli::output::print;
use crate::cli::run::Run;
use crate::cli::view;

const PAGE: &str = include_str!("page/scene.html");
const STYLE: &str = include_str!("page/scene.css");
const SCRIPT: &str = include_str!("page/scene.js");
const SHADER: &str = include_str!("page/scene.frag");

/// Whether a file is to be a page.
pub fn is_page(out: &Path) -> bool {
    out.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("html"))
}

/// Writes the page of a run.
pub fn run(run: &Run, out: &Path) -> Result<()> {
    let model = run.model()?;
    let page = page(run, &model).map_err(|what| Error::file(out, what))?;
    write_atomic(out, page.as_bytes())?;
    let megabytes = page.len() as f64 / 1e6;
    print(&format!("exported a page of {megabytes:.1} MB: {}\n", out.display()))
}

/// The text of the page, or why there is none.
fn page(run: &Run, model: &Model<f32>) -> std::result::Result<String, String> {
    let (Some(config), Some(marching)) = (model.config.field.get::<InstantConfig>(), model.marching()) else {
        return Err(format!(
            "can be made of a field of the kind `instant` that is marched through, and this is `{}` with `{}`",
            model.config.field.kind(),
            model.config.sampler.kind()
        ));
    };
    if model.config.sampler.get::<MarchingConfig>().is_some_and(|c| c.quadrature != Quadrature::Midpoint) {
        return Err("can be made of a run with the quadrature `midpoint`".to_owned());
    }
    let features = config.grid.features;
    if features > 16 {
        return Err(format!("can be made of a table of up to 16 features, and this has {features}"));
    }
    let grid = HashGrid::new(&config.grid).map_err(|error| error.to_string())?;
    let data = json!({
        "view": view::first_view(run),
        "background": model.config.background.shown(),
        "gain": model.gain(),
        "reach": model.reach().map(|corner| corner.to_array().map(finite)),
        "span": model.extent.span,
        "space": space(model),
        "march": march(model, marching),
        "grid": {
            "features": features,
            "rows": grid.rows(),
            "levels": grid.levels().iter().map(|level| json!([
                level.resolution, u32::from(level.hashed), level.rows.start, level.rows.len() - 1,
            ])).collect::<Vec<_>>(),
        },
        "network": {
            "hidden": config.density_width,
            "features": config.features,
            "color": config.color_width,
            "depth": config.color_depth,
            "degree": config.direction_degree,
            "shift": log_density_shift(model.extent.unit),
        },
    });
    let files = json!({
        "table": base64(&table(model)?),
        "weights": base64(&weights(model, config)?),
        "words": base64(&marching.view_grid().words().iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<u8>>()),
    });
    let texts = [
        ("title", escaped(&run.name())),
        ("style", STYLE.to_owned()),
        ("camera", view::CAMERA.to_owned()),
        ("script", SCRIPT.to_owned()),
        ("shader", SHADER.to_owned()),
        // Within a script nothing may look like its end.
        ("data", data.to_string().replace("</", "<\\/")),
        ("files", files.to_string()),
    ];
    Ok(filled(PAGE, &texts))
}

/// JSON knows no infinity: as far as anything can be told apart.
fn finite(x: f64) -> f64 {
    x.clamp(-1e18, 1e18)
}

/// How places of the scene become places of the unit cube.
fn space(model: &Model<f32>) -> Value {
    let space = raygrad::nerf::space::Space { unbounded: model.config.unbounded, ..model.extent.space() };
    let [low, high] = space.bounds;
    match (space.unbounded, space.ndc) {
        (false, _) => json!({ "kind": 0, "middle": low.to_array(), "scale": 1.0 / space.side() }),
        (true, None) => {
            json!({ "kind": 1, "middle": (0.5 * (low + high)).to_array(), "scale": 2.0 / (high - low).min_element() })
        }
        (true, Some(ndc)) => json!({
            "kind": 2,
            "middle": ndc.eye.to_array(),
            "scale": 1.0,
            "axes": ndc.axes.to_cols_array(),
            "across": [0.5 / (ndc.slopes[0] * ndc.near), 0.5 / (ndc.slopes[1] * ndc.near), 1.0 / ndc.near],
        }),
    }
}

fn march(model: &Model<f32>, marching: &Marching) -> Value {
    let (grid, step) = (marching.view_grid(), marching.view_spacing());
    let limits = model.sampler.limits();
    json!({
        "bounds": grid.bounds().map(|corner| corner.to_array()),
        "resolution": grid.resolution(),
        "cascades": grid.cascades(),
        "step": step.length,
        "cone": step.cone,
        "termination": limits.termination,
        "budget": limits.color_budget,
    })
}

fn parameter<'a>(model: &'a Model<f32>, name: &str) -> std::result::Result<(&'a [f32], [usize; 2]), String> {
    let id = model.params.find(name).ok_or_else(|| format!("needs the parameter `{name}`"))?;
    let tensor = model.params.get(id);
    let shape = tensor.shape();
    Ok((tensor.as_slice(), [shape[0], shape[1]]))
}

/// The table in half precision.
fn table(model: &Model<f32>) -> std::result::Result<Vec<u8>, String> {
    let (table, _) = parameter(model, "field.table")?;
    Ok(table.iter().flat_map(|x| f16::from_f32(*x).to_le_bytes()).collect())
}

/// The weights of all layers, each row of outputs filled up to a multiple of four, each layer to such a number of rows; before
/// the first layer of colours what the mean code of the photographs adds to its outputs.
fn weights(model: &Model<f32>, config: &InstantConfig) -> std::result::Result<Vec<u8>, String> {
    let field: &dyn Any = &*model.field;
    let levels = field.downcast_ref::<Instant>().and_then(|field| field.grid().weights());
    let mut out: Vec<f32> = vec![];
    let mut layer = |rows: &[f32], outputs: usize| {
        for row in rows.chunks(outputs) {
            out.extend(row);
            out.resize(out.len().next_multiple_of(4), 0.0);
        }
        let filled = (rows.len() / outputs).next_multiple_of(4) - rows.len() / outputs;
        out.resize(out.len() + filled * outputs.next_multiple_of(4), 0.0);
    };
    for name in ["field.density.0.weight", "field.density.1.weight"] {
        let (values, [_, outputs]) = parameter(model, name)?;
        match levels.filter(|_| name.contains("density.0")) {
            // What features are multiplied by may as well be in the weights.
            Some(levels) => {
                let scaled = values.chunks(outputs).enumerate().flat_map(|(row, weights)| {
                    let level = levels[row / config.grid.features] as f32;
                    weights.iter().map(move |weight| level * weight)
                });
                layer(&scaled.collect::<Vec<_>>(), outputs);
            }
            None => layer(values, outputs),
        }
    }
    let inputs = config.features + config.direction_degree * config.direction_degree;
    for i in 0..=config.color_depth {
        let (values, [_, outputs]) = parameter(model, &format!("field.color.{i}.weight"))?;
        if i > 0 {
            layer(values, outputs);
            continue;
        }
        let (seen, coded) = values.split_at(inputs * outputs);
        let mut added = vec![0.0; outputs];
        if config.codes > 0 {
            let (codes, [count, width]) = parameter(model, "field.codes")?;
            for (number, row) in coded.chunks(outputs).enumerate() {
                let mean = codes.chunks(width).map(|code| code[number]).sum::<f32>() / count as f32;
                added.iter_mut().zip(row).for_each(|(added, weight)| *added += mean * weight);
            }
        }
        layer(&added, outputs);
        layer(seen, outputs);
    }
    Ok(out.iter().flat_map(|x| x.to_le_bytes()).collect())
}
