//! Meshes and point clouds of a run.

use std::f64::consts::FRAC_PI_2;
use std::path::Path;
use std::time::Instant;

use raygrad::nerf::dataset::{Split, evenly_spaced};
use raygrad::nerf::geometry::files;
use raygrad::nerf::geometry::{Stage, SurfaceConfig};
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
    /// The configuration of a mesh.
    fn surface_config(&self) -> SurfaceConfig {
        let default = SurfaceConfig::default();
        SurfaceConfig {
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

/// Extracts and writes the geometry.
pub fn run(run: &Run, scene: Option<&Scene>, options: &GeometryOptions, out: &Path, job: &Job) -> Result<()> {
    check_writable(parent(out))?;
    let model = run.model()?;
    let cameras = cameras(run, &model, scene)?;
    let start = Instant::now();
    let mut display = Display::new();
    let mut show = |stage: Stage, done: f64| display.set(stage, done);
    let (shape, said) = match options.points {
        Some(count) => {
            let cloud = model.point_cloud(&cameras, count, &mut show)?;
            let points = cloud.colored_mesh.mesh.positions.len();
            (
                cloud.colored_mesh,
                format!("{points} points, from {} surface samples in {} views", cloud.sights, cameras.len()),
            )
        }
        None => {
            let surface = model.surface(&cameras, &options.surface_config(), &mut show)?;
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
    let bytes = files::write_with_comment(&shape.into_capture(&model.scene_box.transform), out, job.mark())?;
    let part = if model.config.unbounded { ", cropped to the scene box" } else { "" };
    let (size, seconds) = (bytes as f64 / 1e6, start.elapsed().as_secs_f64());
    print(&format!("exported {said}{part}: {} ({size:.1} MB, {seconds:.1} s)\n", out.display()))
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
    use raygrad::nerf::glam::DVec3;
    use std::f64::consts::PI;

    #[test]
    fn mesh_flags_reach_the_surface_config() {
        #[derive(Parser)]
        struct Flags {
            #[command(flatten)]
            options: GeometryOptions,
        }
        let config =
            |flags: &str| Flags::parse_from(format!("export {flags}").split_whitespace()).options.surface_config();
        let default = SurfaceConfig {
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
