//! Meshes and point clouds of a run.

use std::f64::consts::FRAC_PI_2;
use std::path::Path;
use std::time::Instant;

use raygrad::nerf::dataset::{Split, evenly_spaced};
use raygrad::nerf::geometry::files;
use raygrad::nerf::geometry::{OrientedBox, Stage, SurfaceConfig};
use raygrad::nerf::glam::DVec3;
use raygrad::nerf::{Camera, Error, Model, Result, SceneBox};
use serde::Serialize;

use crate::cameras::Viewpoint;
use crate::output::{check_writable, note, parent, print};
use crate::overwrite::Job;
use crate::parse;
use crate::photographs::photographs;
use crate::progress::{Progress, spoken};
use crate::run::Run;
use crate::scene::Scene;

/// Cameras per ring around the scene.
const RING: usize = 12;
/// Most training cameras that are used.
const PHOTOGRAPHS: usize = 100;

/// Most points of a cloud.
const MOST_POINTS: usize = 10_000_000;

/// Options of meshes and point clouds.
#[derive(clap::Args, Serialize)]
pub struct GeometryOptions {
    /// Write at most N points instead of a mesh
    ///
    /// Without a number, 200000 points.
    #[arg(
        long, help_heading = "Mesh",
        value_name = "N",
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = "200000",
        value_parser = parse::count(MOST_POINTS)
    )]
    points: Option<usize>,
    /// Box of the mesh or points
    ///
    /// X0,Y0,Z0,X1,Y1,Z1: the lower and the upper corner in capture units, along the axes of the capture. raygrad
    /// prints the extent of each mesh in this form. scene:X0,Y0,Z0,X1,Y1,Z1 is along the axes of the scene box, in
    /// scene units; the viewer shows its crop box in this form. [default: the scene box]
    #[arg(long, help_heading = "Mesh", value_name = "BOX", value_parser = bounds, allow_hyphen_values = true)]
    bounds: Option<Bounds>,
    /// Decimate the mesh to N triangles
    #[arg(long, help_heading = "Mesh", value_name = "N", conflicts_with = "points")]
    triangles: Option<usize>,
    /// Cells along the box's longest side
    ///
    /// The default is twice the resolution of the occupancy grid.
    #[arg(long, help_heading = "Mesh", value_name = "N", conflicts_with = "points")]
    resolution: Option<usize>,
    /// Density on the surface, per scene unit
    ///
    /// The default is the lower quartile of the densities at which rays have lost half of their light.
    #[arg(long, help_heading = "Mesh", value_name = "X", conflicts_with = "points")]
    iso_value: Option<f64>,
    /// Drop components below this area share
    ///
    /// A share of the largest component's area, 0 to 1. 0 keeps all components. [default: 0.01]
    #[arg(long, help_heading = "Mesh", value_name = "SHARE", conflicts_with = "points")]
    min_component: Option<f64>,
    /// Keep cavities that no view sees
    ///
    /// By default space that no view sees counts as solid.
    #[arg(long, help_heading = "Mesh", conflicts_with = "points")]
    no_fill_unseen: bool,
    /// Leave the mesh open at the scene box
    ///
    /// By default the mesh is closed there.
    #[arg(long, help_heading = "Mesh", conflicts_with = "points")]
    open_boundary: bool,
}

impl GeometryOptions {
    /// The configuration of a mesh in this box.
    fn surface_config(&self, region: Option<OrientedBox>) -> SurfaceConfig {
        let default = SurfaceConfig::default();
        SurfaceConfig {
            region,
            resolution: self.resolution,
            iso_value: self.iso_value,
            min_component: self.min_component.unwrap_or(default.min_component),
            triangles: self.triangles,
            fill_unseen: !self.no_fill_unseen,
            closed: !self.open_boundary,
        }
    }

    /// Whether nothing of this is asked for, which cameras have no use for.
    pub fn check_absent(&self) -> Result<()> {
        let given = [
            ("points", self.points.is_some()),
            ("bounds", self.bounds.is_some()),
            ("triangles", self.triangles.is_some()),
            ("resolution", self.resolution.is_some()),
            ("iso-value", self.iso_value.is_some()),
            ("min-component", self.min_component.is_some()),
            ("no-fill-unseen", self.no_fill_unseen),
            ("open-boundary", self.open_boundary),
        ];
        match given.iter().find(|(_, given)| *given) {
            Some((name, _)) => {
                Err(Error::setting(name, "applies to meshes and point clouds: name a .ply, .obj or .glb file"))
            }
            None => Ok(()),
        }
    }
}

/// The box of `--bounds`: lower and upper corner.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
enum Bounds {
    /// In capture units, along the axes of the capture.
    Capture([DVec3; 2]),
    /// In scene units, along the axes of the scene.
    Scene([DVec3; 2]),
}

/// Parses `--bounds`.
fn bounds(text: &str) -> std::result::Result<Bounds, String> {
    match text.strip_prefix("scene:") {
        Some(corners) => parse::corners(corners).map(Bounds::Scene),
        None => parse::corners(text).map(Bounds::Capture),
    }
}

/// Extracts and writes the geometry.
pub fn run(run: &Run, scene: Option<&Scene>, options: &GeometryOptions, out: &Path, job: &Job) -> Result<()> {
    check_writable(parent(out))?;
    let model = run.model()?;
    let region = options.bounds.map(|bounds| match bounds {
        Bounds::Capture(corners) => OrientedBox::in_capture(&model.scene_box.transform, corners),
        Bounds::Scene(corners) => corners.into(),
    });
    if let Some(line) = region.as_ref().map(|region| beyond(&model, region)).transpose()?.flatten() {
        note(&line);
    }
    let cameras = cameras(run, &model, scene)?;
    let start = Instant::now();
    let mut display = Display::new();
    let mut show = |stage: Stage, done: f64| display.set(stage, done);
    let (shape, said) = match options.points {
        Some(count) => {
            let cloud = model.point_cloud(&cameras, count, region, &mut show)?;
            let points = cloud.colored_mesh.mesh.positions.len();
            (
                cloud.colored_mesh,
                format!("{points} points, from {} surface samples in {} views", cloud.sights, cameras.len()),
            )
        }
        None => {
            let surface = model.surface(&cameras, &options.surface_config(region), &mut show)?;
            let mesh = &surface.colored_mesh.mesh;
            if let Some(most) = options.triangles.filter(|most| mesh.triangles.len() > *most) {
                let count = mesh.triangles.len();
                note(&format!(
                    "the mesh keeps {count} triangles, more than {most}: fewer would fold it or lose a component"
                ));
            }
            let said = format!(
                "{} vertices, {} triangles, {}; iso-value {:.4} per scene unit, {} cells along the box, {} small \
                 components removed",
                mesh.positions.len(),
                mesh.triangles.len(),
                if mesh.is_closed() { "closed" } else { "open" },
                surface.iso_value,
                surface.resolution,
                surface.dropped
            );
            (surface.colored_mesh, said)
        }
    };
    drop(display);
    job.check(out)?;
    let shape = shape.into_capture(&model.scene_box.transform);
    let bytes = files::write_with_comment(&shape, out, job.mark())?;
    let part = if model.config.unbounded && region.is_none() { ", cropped to the scene box" } else { "" };
    let within = shape.mesh.bounds().map_or(String::new(), |corners| format!("; bounds {}", written(corners)));
    let (size, seconds) = (bytes as f64 / 1e6, start.elapsed().as_secs_f64());
    print(&format!("exported {said}{part}{within}: {} ({size:.1} MB, {seconds:.1} s)\n", out.display()))
}

/// A box in the form of `--bounds`, to a ten-thousandth of its size.
fn written([low, high]: [DVec3; 2]) -> String {
    let digits = (4.0 - (high - low).max_element().log10()).clamp(0.0, 12.0) as usize;
    let numbers = [low, high].into_iter().flat_map(|corner| corner.to_array());
    numbers.map(|x| format!("{x:.digits$}")).collect::<Vec<_>>().join(",")
}

/// A note on a box that reaches beyond what the model represents.
///
/// # Errors
/// If all of the box is beyond it.
fn beyond(model: &Model<f32>, region: &OrientedBox) -> Result<Option<String>> {
    let transform = model.scene_box.transform;
    let around =
        |corners: [DVec3; 8]| corners.iter().fold([corners[0]; 2], |[low, high], &x| [low.min(x), high.max(x)]);
    let ([low, high], [least, most]) = (model.reach(), around(region.corners()));
    // The box of the model, along the axes of the capture.
    let known = || written(around(OrientedBox::from([low, high]).corners().map(|corner| transform.point_back(corner))));
    let kind = if model.config.unbounded { "what the model represents" } else { "the scene box" };
    if !(least.cmplt(high).all() && most.cmpgt(low).all()) {
        return Err(Error::setting("bounds", format!("is outside of {kind}; choose a box within {}", known())));
    }
    if least.cmplt(low).any() || most.cmpgt(high).any() {
        return Ok(Some(format!("--bounds reaches beyond {kind}, which ends at {}", known())));
    }
    let ndc = model.scene_box.ndc.filter(|_| model.config.unbounded);
    let is_seen = ndc.is_none_or(|ndc| region.corners().iter().all(|corner| ndc.contains(*corner)));
    Ok((!is_seen)
        .then(|| "--bounds reaches beyond the views of the images, where the model has learned nothing".to_owned()))
}

/// Rings of cameras around the scene, and the training cameras. Their absence is an error only if `scene` is given.
fn cameras(run: &Run, model: &Model<f32>, scene: Option<&Scene>) -> Result<Vec<Camera>> {
    let around = rings(&run.config.viewpoint, &run.config.scene_box);
    let own = match photographs(run, model, scene, Split::Train) {
        Ok(own) => evenly_spaced(own, PHOTOGRAPHS),
        Err(error) if scene.is_some() => return Err(error),
        Err(error) => {
            note(&format!("using only cameras around the scene, because those of the images are unknown: {error}"));
            vec![]
        }
    };
    Ok(own.into_iter().map(|photograph| photograph.camera).chain(around).collect())
}

/// Rings of cameras around the scene at the mean elevation of the images, below and above.
fn rings(viewpoint: &Viewpoint, extent: &SceneBox) -> Vec<Camera> {
    let mean = viewpoint.elevation;
    let elevations = [0.1 * mean, 0.5 * mean, mean, 0.5 * (mean + FRAC_PI_2.copysign(mean))];
    let ring = |elevation| Viewpoint { elevation, ..*viewpoint }.orbit(extent, RING);
    let mut around: Vec<Camera> = vec![];
    for camera in elevations.into_iter().flat_map(ring) {
        // A swinging orbit visits positions twice, and rings at the horizon coincide.
        if !around.iter().any(|other| other.pose.abs_diff_eq(camera.pose, 1e-9)) {
            around.push(camera);
        }
    }
    around
}

/// Progress of the stages.
struct Display {
    progress: Progress,
    stage: Option<(Stage, Instant)>,
}

impl Display {
    fn new() -> Self {
        Display { progress: Progress::new(), stage: None }
    }

    fn set(&mut self, stage: Stage, done: f64) {
        let since = match self.stage {
            Some((now, since)) if now == stage => since,
            _ => self.stage.insert((stage, Instant::now())).1,
        };
        let left = since.elapsed().as_secs_f64() * (1.0 - done) / done.max(f64::MIN_POSITIVE);
        let doing = match stage {
            Stage::Seeing => "finding visible space",
            Stage::Meshing => "extracting the surface",
            Stage::Simplifying => "simplifying the mesh",
            Stage::Coloring => "colouring the mesh",
        };
        self.progress
            .set(done, || if done > 0.0 { format!("{doing}, {} left", spoken(left)) } else { doing.to_owned() });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use raygrad::nerf::dataset::SceneTransform;
    use raygrad::nerf::glam::DMat3;
    use raygrad::nerf::{Config, Ndc, Preset};
    use std::f64::consts::PI;

    #[test]
    fn mesh_flags_reach_the_surface_config() {
        #[derive(Parser)]
        struct Flags {
            #[command(flatten)]
            options: GeometryOptions,
        }
        let options = |flags: &str| Flags::parse_from(format!("export {flags}").split_whitespace()).options;
        let config = |flags: &str| options(flags).surface_config(None);
        let corners = [-1.0, 1.0].map(|x| x * DVec3::new(1.0, 2.0, 3.0));
        assert_eq!(options("--bounds -1,-2,-3,1,2,3").bounds, Some(Bounds::Capture(corners)));
        assert_eq!(options("--bounds scene:-1,-2,-3,1,2,3").bounds, Some(Bounds::Scene(corners)));
        assert!(bounds("world:-1,-2,-3,1,2,3").unwrap_err().contains("`world:-1` is not a finite number"));
        let default = SurfaceConfig {
            region: None,
            resolution: None,
            iso_value: None,
            min_component: 0.01,
            triangles: None,
            fill_unseen: true,
            closed: true,
        };
        for (flags, expected) in [
            ("", default),
            ("--resolution 70", SurfaceConfig { resolution: Some(70), ..default }),
            ("--iso-value 2.5", SurfaceConfig { iso_value: Some(2.5), ..default }),
            ("--min-component 0.25", SurfaceConfig { min_component: 0.25, ..default }),
            ("--min-component 0", SurfaceConfig { min_component: 0.0, ..default }),
            ("--triangles 80", SurfaceConfig { triangles: Some(80), ..default }),
            ("--no-fill-unseen", SurfaceConfig { fill_unseen: false, ..default }),
            ("--open-boundary", SurfaceConfig { closed: false, ..default }),
        ] {
            assert_eq!(config(flags), expected, "{flags}");
        }
    }

    #[test]
    fn bounds_beyond_the_model_are_noted_or_refused() {
        // In the capture, the scene box is from 9.5 to 10.5 along x.
        let transform = SceneTransform { scale: 2.0, origin: 10.0 * DVec3::X, ..SceneTransform::default() };
        let extent = SceneBox { transform, ..SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [0.1, 9.0]) };
        let said = |model: &Model<f32>, low: f64, high: f64| {
            let corners = [DVec3::new(low, -0.4, -0.4), DVec3::new(high, 0.4, 0.4)];
            beyond(model, &OrientedBox::in_capture(&transform, corners)).map_err(|error| error.to_string())
        };
        let within = "9.5000,-0.5000,-0.5000,10.5000,0.5000,0.5000";
        let mut config = Config::preset(Preset::Small);
        let bounded = Model::new(config.clone(), extent, 0).unwrap();
        assert_eq!(said(&bounded, 9.6, 10.4), Ok(None));
        let note = format!("--bounds reaches beyond the scene box, which ends at {within}");
        for (low, high) in [(9.6, 10.6), (9.4, 10.4)] {
            assert_eq!(said(&bounded, low, high), Ok(Some(note.clone())));
        }
        let refused = format!("`bounds`: is outside of the scene box; choose a box within {within}");
        assert_eq!(said(&bounded, 10.6, 10.7), Err(refused));
        // Without a grid an unbounded model represents all of space, or the frustum of forward-facing images.
        config.unbounded = true;
        let open = Model::new(config.clone(), extent, 0).unwrap();
        assert_eq!(said(&open, -90.0, 90.0), Ok(None));
        let axes = DMat3::from_cols(DVec3::Y, DVec3::Z, DVec3::X);
        let ndc = Some(Ndc { eye: 2.0 * DVec3::X, axes, slopes: [0.9; 2], near: 0.2 });
        let ahead = Model::new(config, SceneBox { ndc, ..extent }, 0).unwrap();
        assert_eq!(said(&ahead, 9.5, 10.4), Ok(None));
        assert!(said(&ahead, 9.5, 10.6).unwrap().unwrap().contains("beyond the views of the images"));
    }

    #[test]
    fn no_camera_around_a_scene_is_there_twice() {
        let extent = SceneBox::new([DVec3::NEG_ONE, DVec3::new(1.0, 2.0, 1.0)], [0.5, 9.0]);
        let around = |elevation: f64, reach: f64| {
            let view = Viewpoint { width: 40, height: 30, angle_x: 0.8, distance: 4.0, elevation, azimuth: 0.2, reach };
            rings(&view, &extent)
        };
        let count = |elevation: f64, reach: f64| around(elevation, reach).len();
        // Two lower rings, the mean elevation, and halfway from there to the pole. The centre of the box is at height
        // 0.
        for sign in [1.0, -1.0] {
            let heights = around(0.4 * sign, PI).into_iter().step_by(12).map(|camera| camera.pose.translation.z);
            let expected = [0.04_f64, 0.2, 0.4, 0.2 + PI / 4.0].map(|angle| sign * 4.0 * angle.sin());
            assert!(heights.zip(expected).all(|(height, expected)| (height - expected).abs() < 1e-12), "{sign}");
        }
        // A swing of twelve cameras has seven positions.
        assert_eq!([count(0.4, PI), count(-0.4, PI), count(0.4, 0.6)], [48, 48, 28]);
        // At the horizon, and halfway up.
        assert_eq!([count(0.0, PI), count(0.0, 0.6)], [24, 14]);
    }
}
