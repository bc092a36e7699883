//! Export of a scene page: one HTML file with the hash table, the MLPs and the occupancy grid. Its WebGL shader marches
//! rays as renders of raygrad do.

use std::any::Any;
use std::path::Path;

use base64::prelude::{BASE64_STANDARD, Engine};
use half::f16;
use raygrad::nerf::component::ComponentConfig;
use raygrad::nerf::encoding::hash_grid::HashGrid;
use raygrad::nerf::field::{Instant, InstantConfig, log_density_shift};
use raygrad::nerf::sampling::marching::{Marching, MarchingConfig};
use raygrad::nerf::sampling::proposal::ProposalConfig;
use raygrad::nerf::space::occupancy::OccupancyGrid;
use raygrad::nerf::volume::quadrature::Quadrature;
use raygrad::nerf::{Error, Model, Result, write_atomic};
use serde_json::{Value, json};

use crate::html::{escaped, filled, in_script};
use crate::output::print;
use crate::overwrite::Job;
use crate::run::Run;
use crate::view;

const PAGE: &str = include_str!("page/scene.html");
const STYLE: &str = include_str!("page/scene.css");
const SCRIPT: &str = include_str!("page/scene.js");
const SHADER: &str = include_str!("page/scene.frag");

/// Most features per table entry, and most width of a layer, that the shader supports.
const MOST_FEATURES: usize = 16;
const MOST_WIDTH: usize = 256;
/// The factor of the steps of a page where proposals placed the samples: surfaces are thinner than marching makes them.
const FINER: f64 = 0.5;

/// Writes the page of a run.
pub fn run(run: &Run, out: &Path, job: &Job) -> Result<()> {
    let model = marched(run.model()?, MarchingConfig::default())?;
    let page = page(run, &model, job.mark()).map_err(|what| Error::file(out, what))?;
    job.check(out)?;
    write_atomic(out, page.as_bytes())?;
    let megabytes = page.len() as f64 / 1e6;
    print(&format!("exported a scene page of {megabytes:.1} MB: {}\n", out.display()))
}

/// The model with samples by marching, as the shader takes them. Proposals become steps, by `config`, through the cells
/// that the field occupies.
fn marched(mut model: Model<f32>, mut config: MarchingConfig) -> Result<Model<f32>> {
    if model.config.sampler.kind() == ProposalConfig::KIND {
        if model.config.unbounded {
            config = config.cascaded();
        }
        config.view_step *= FINER;
        let grid = OccupancyGrid::new(model.space().bounds, &config.occupancy)?;
        model.sampler = Box::new(Marching::new(config, grid));
        model.finish();
    }
    Ok(model)
}

/// Checks that a page can show the model; returns the reason if not.
fn check(model: &Model<f32>) -> std::result::Result<(&InstantConfig, &Marching), String> {
    let (Some(config), Some(marching)) = (model.config.field.get::<InstantConfig>(), model.marching()) else {
        return Err(format!(
            "a scene page needs the field `instant` and the sampler `marching` or `proposal`; the run has `{}` and `{}`",
            model.config.field.kind(),
            model.config.sampler.kind()
        ));
    };
    if model.config.sampler.get::<MarchingConfig>().is_some_and(|c| c.quadrature != Quadrature::Midpoint) {
        return Err(
            "a scene page needs the quadrature `midpoint`: train with --set sampler.quadrature=midpoint".to_owned()
        );
    }
    for (most, what, own) in [
        (MOST_FEATURES, "`grid.features`", config.grid.features),
        (MOST_WIDTH, "`density_width`", config.density_width),
        (MOST_WIDTH, "`features`", config.features),
        (MOST_WIDTH, "`color_width`", config.color_width),
    ] {
        if own > most {
            return Err(format!("a scene page needs {what} of at most {most}; the run has {own}"));
        }
    }
    Ok((config, marching))
}

/// The text of the page, or the reason why there is none. `mark` identifies the job that wrote it.
fn page(run: &Run, model: &Model<f32>, mark: &str) -> std::result::Result<String, String> {
    let (config, marching) = check(model)?;
    let grid = HashGrid::new(&config.grid).map_err(|error| error.to_string())?;
    let data = json!({
        "view": view::first_view(run),
        "background": model.config.background.shown(),
        "gain": model.gain(),
        "reach": model.reach().map(|corner| corner.to_array().map(finite)),
        "span": model.view_near_far().map(finite),
        "space": space(model),
        "march": march(model, marching),
        "grid": {
            "features": config.grid.features,
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
            "shift": log_density_shift(model.scene_box.unit),
        },
    });
    let files = json!({
        "table": BASE64_STANDARD.encode(table(model)?),
        "weights": BASE64_STANDARD.encode(weights(model, config)?),
        "words": BASE64_STANDARD.encode(marching.view_grid().words().iter().flat_map(|word| word.to_le_bytes()).collect::<Vec<u8>>()),
    });
    let texts = [
        ("title", escaped(&run.name())),
        ("style", STYLE.to_owned()),
        ("camera", view::CAMERA.to_owned()),
        ("script", SCRIPT.to_owned()),
        ("shader", SHADER.to_owned()),
        // The data must not end the script element.
        ("data", in_script(&data.to_string())),
        ("files", files.to_string()),
        ("mark", mark.to_owned()),
    ];
    Ok(filled(PAGE, &texts))
}

/// JSON has no infinity, so that a large number replaces it.
fn finite(x: f64) -> f64 {
    x.clamp(-1e18, 1e18)
}

/// The map from scene coordinates to the unit cube.
fn space(model: &Model<f32>) -> Value {
    let space = model.space();
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
    let limits = model.sampler.tolerance();
    json!({
        "bounds": grid.bounds().map(|corner| corner.to_array()),
        "resolution": grid.resolution(),
        "cascades": grid.cascades(),
        "step": step.length,
        "cone": step.cone,
        "termination": limits.early_stop_eps,
        "budget": limits.color_budget,
    })
}

fn parameter<'a>(model: &'a Model<f32>, name: &str) -> std::result::Result<(&'a [f32], [usize; 2]), String> {
    let id = model
        .params
        .find(name)
        .ok_or_else(|| format!("a scene page needs the parameter `{name}`, which the model lacks"))?;
    let tensor = model.params.get(id);
    let shape = tensor.shape();
    Ok((tensor.as_slice(), [shape[0], shape[1]]))
}

/// The hash table in half precision.
fn table(model: &Model<f32>) -> std::result::Result<Vec<u8>, String> {
    let (table, _) = parameter(model, "field.table")?;
    let halves: Vec<f16> = table.iter().map(|x| f16::from_f32(*x)).collect();
    match halves.iter().all(|x| x.is_finite()) {
        true => Ok(halves.iter().flat_map(|x| x.to_le_bytes()).collect()),
        false => Err("a scene page stores the hash table in 16 bits, and this one has larger values".to_owned()),
    }
}

/// The weights of all layers. Rows are padded to a multiple of four outputs, and layers to a multiple of four rows.
/// Before the first colour layer comes the contribution of the mean appearance embedding to its outputs.
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
            // The level weights of features are multiplied into the MLP weights.
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
        if config.appearance_embedding_dim > 0 {
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

#[cfg(test)]
mod tests {
    use raygrad::nerf::dataset::SceneType;
    use raygrad::nerf::encoding::hash_grid::HashGridConfig;
    use raygrad::nerf::glam::{DMat3, DVec3};
    use raygrad::nerf::imaging::metrics::psnr;
    use raygrad::nerf::{Camera, Config, FieldConfig, Ndc, Preset, SamplerConfig, SceneBox};

    use super::*;

    /// Small enough for expected values by hand.
    fn small() -> InstantConfig {
        InstantConfig {
            grid: HashGridConfig { levels: 4, features: 1, log2_table: 4, coarsest: 1, finest: 4 },
            density_width: 5,
            features: 3,
            color_width: 2,
            color_depth: 1,
            direction_degree: 1,
            appearance_embedding_dim: 2,
            gradient_cut: 0.0,
        }
    }

    fn model(config: InstantConfig, change: impl FnOnce(&mut Config, &mut SceneBox)) -> Model<f32> {
        let mut extent =
            SceneBox { frames: 2, ..SceneBox::new([DVec3::NEG_ONE, DVec3::new(1.0, 3.0, 1.0)], [0.5, 9.0]) };
        let mut config = Config { field: FieldConfig::new(config), ..Config::preset(Preset::Instant) };
        change(&mut config, &mut extent);
        if let Some(marching) = config.sampler.get_mut::<MarchingConfig>() {
            marching.occupancy.resolution = 16;
            marching.occupancy.cascades = if config.unbounded { 2 } else { 1 };
        }
        Model::new(config, extent, 0).unwrap()
    }

    fn few_cells() -> MarchingConfig {
        let mut config = MarchingConfig::default();
        config.occupancy.resolution = 32;
        config
    }

    fn as_it_is(_: &mut Config, _: &mut SceneBox) {}

    fn give(model: &mut Model<f32>, name: &str, values: &[f32]) {
        let id = model.params.find(name).unwrap();
        model.params.get_mut(id).as_mut_slice().copy_from_slice(values);
    }

    /// Steps through the cells show what proposals show, in a fog.
    #[test]
    fn proposals_become_steps() {
        let unbounded = |config: &mut Config, _: &mut SceneBox| {
            config.sampler = SamplerConfig::new(ProposalConfig::default());
            *config = config.clone().with_scene_type(SceneType::Unbounded);
        };
        let model = model(small(), unbounded);
        let pose = Camera::look_at(DVec3::new(0.9, 1.0, 0.2), DVec3::Y, DVec3::Z);
        let camera = Camera::from_angle(16, 12, 0.8, pose);
        let by_proposals = model.render(&camera, [1.0; 3]).color;
        let error = check(&model).err().unwrap();
        assert!(error.contains("`marching` or `proposal`"), "{error}");
        let stepped = marched(model, few_cells()).unwrap();
        assert!(check(&stepped).is_ok());
        let by_steps = stepped.render(&camera, [1.0; 3]).color;
        let alike = psnr(&by_steps, &by_proposals);
        assert!(alike > 30.0 && by_steps != by_proposals, "{alike} dB");
        let darkest = by_steps.data.iter().copied().fold(1.0, f32::min);
        assert!(darkest < 0.9, "the fog is visible: {darkest}");
    }

    /// Steps skip cells without density. A bounded model has one box.
    #[test]
    fn steps_in_place_of_proposals_skip_empty_cells() {
        for unbounded in [false, true] {
            let mut model = model(small(), |config, _| {
                config.sampler = SamplerConfig::new(ProposalConfig::default());
                if unbounded {
                    *config = config.clone().with_scene_type(SceneType::Unbounded);
                }
            });
            let occupied = |model: Model<f32>| {
                let stepped = marched(model, few_cells()).unwrap();
                let grid = stepped.marching().unwrap().view_grid();
                assert_eq!(grid.bounds() != grid.outer_bounds(), unbounded);
                grid.occupied_share()
            };
            assert!(occupied(model.clone()) > 0.9);
            for name in ["field.table", "field.density.0.weight", "field.density.1.weight"] {
                let id = model.params.find(name).unwrap();
                let value = if name.contains(".1.") { -1.0 } else { 1.0 };
                model.params.get_mut(id).as_mut_slice().fill(value);
            }
            assert_eq!(occupied(model), 0.0);
        }
    }

    #[test]
    fn weights_are_padded_with_mean_embedding() {
        let config = small();
        let mut model = model(config.clone(), as_it_is);
        let count = |from: u32, count: u32| (from..from + count).map(|x| x as f32).collect::<Vec<f32>>();
        give(&mut model, "field.density.0.weight", &count(100, 20));
        give(&mut model, "field.density.1.weight", &count(200, 15));
        give(&mut model, "field.color.0.weight", &count(300, 12));
        give(&mut model, "field.color.1.weight", &count(400, 6));
        // The mean embedding is (2, 3), for the rows (308, 309) and (310, 311).
        give(&mut model, "field.codes", &[1.0, 2.0, 3.0, 4.0]);
        let bytes = weights(&model, &config).unwrap();
        let found: Vec<f32> = bytes.chunks(4).map(|x| f32::from_le_bytes(x.try_into().unwrap())).collect();
        let rows = |first: u32, rows: u32, outputs: u32, wide: usize, all: usize| {
            let mut out: Vec<f32> = vec![];
            for row in 0..rows {
                out.extend(count(first + row * outputs, outputs));
                out.resize((row as usize + 1) * wide, 0.0);
            }
            out.resize(all * wide, 0.0);
            out
        };
        let added = [2.0 * 308.0 + 3.0 * 310.0, 2.0 * 309.0 + 3.0 * 311.0, 0.0, 0.0];
        let expected = [
            rows(100, 4, 5, 8, 4),
            rows(200, 5, 3, 4, 8),
            added.to_vec(),
            vec![0.0; 12],
            rows(300, 4, 2, 4, 4),
            rows(400, 2, 3, 4, 4),
        ];
        assert_eq!(found, expected.concat());
        // At half of the detail, the finest level in the last row has weight one half.
        model.set_detail(0.5);
        let bytes = weights(&model, &config).unwrap();
        let half = bytes.chunks(4).map(|x| f32::from_le_bytes(x.try_into().unwrap()));
        for (at, (half, whole)) in half.zip(found).enumerate() {
            let share = if (24..32).contains(&at) { 0.5 } else { 1.0 };
            assert!((half - share * whole).abs() <= 1e-6 * whole, "{at}: {half} {whole}");
        }
    }

    #[test]
    fn table_is_half_precision_or_fails() {
        let mut model = model(small(), as_it_is);
        let mut values = vec![0.0; model.params.get(model.params.find("field.table").unwrap()).as_slice().len()];
        (values[0], values[1]) = (1.0, -2.5);
        give(&mut model, "field.table", &values);
        let bytes = table(&model).unwrap();
        assert_eq!((bytes.len(), &bytes[..5]), (2 * values.len(), &[0x00, 0x3c, 0x00, 0xc1, 0x00][..]));
        values[3] = 1e6;
        give(&mut model, "field.table", &values);
        assert!(table(&model).is_err_and(|what| what.contains("larger values")));
    }

    #[test]
    fn space_maps_to_the_unit_cube() {
        assert_eq!(space(&model(small(), as_it_is)), json!({ "kind": 0, "middle": [-1.0, -1.0, -1.0], "scale": 0.25 }));
        let unbounded = model(small(), |config, _| config.unbounded = true);
        assert_eq!(space(&unbounded), json!({ "kind": 1, "middle": [0.0, 1.0, 0.0], "scale": 1.0 }));
        let ahead = model(small(), |config, extent| {
            config.unbounded = true;
            let eye = DVec3::new(1.0, 2.0, 3.0);
            extent.ndc = Some(Ndc { eye, axes: DMat3::IDENTITY, slopes: [0.5, 0.25], near: 2.0 });
        });
        assert_eq!(
            space(&ahead),
            json!({
                "kind": 2, "middle": [1.0, 2.0, 3.0], "scale": 1.0, "across": [0.5, 1.0, 0.5],
                "axes": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            })
        );
        assert_eq!([f64::INFINITY, f64::NEG_INFINITY, -3.5].map(finite), [1e18, -1e18, -3.5]);
    }

    #[test]
    fn march_settings_equal_those_of_renders() {
        let model = model(small(), as_it_is);
        let marching = model.marching().unwrap();
        let (told, step, limits) = (march(&model, marching), marching.view_spacing(), model.sampler.tolerance());
        assert_eq!(json!([told["step"], told["cone"]]), json!([step.length, step.cone]));
        assert_eq!(json!([told["termination"], told["budget"]]), json!([limits.early_stop_eps, limits.color_budget]));
        let grid = marching.view_grid();
        assert_eq!(json!([told["resolution"], told["cascades"]]), json!([grid.resolution(), grid.cascades()]));
        assert_eq!(told["bounds"], json!([[-1.0, -1.0, -1.0], [1.0, 3.0, 1.0]]));
    }

    #[test]
    fn check_unsupported_models_gives_the_reason() {
        let refused = |model: &Model<f32>| check(model).map(drop).unwrap_err();
        let with = |change: &dyn Fn(&mut InstantConfig)| {
            let mut config = small();
            change(&mut config);
            refused(&model(config, as_it_is))
        };
        assert!(with(&|config| config.grid.features = 32).contains("`grid.features`"));
        assert!(with(&|config| config.density_width = 257).contains("`density_width` of at most 256"));
        assert!(with(&|config| config.features = 257).contains("`features`"));
        assert!(with(&|config| config.color_width = 257).contains("`color_width`"));
        let mut most = InstantConfig { density_width: 256, features: 256, color_width: 256, ..small() };
        most.grid.features = 16;
        assert!(check(&model(most, as_it_is)).is_ok());
        let classic = model(small(), |config, _| config.sampler = Config::preset(Preset::Classic).sampler);
        assert!(refused(&classic).contains("`instant` and `hierarchical`"));
        let gauss = model(small(), |config, _| {
            config.sampler =
                SamplerConfig::new(MarchingConfig { quadrature: Quadrature::Gauss2, ..MarchingConfig::default() });
        });
        assert!(refused(&gauss).contains("`midpoint`"));
    }
}
