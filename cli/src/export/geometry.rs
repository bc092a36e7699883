//! Meshes and point clouds of a run.

use std::f64::consts::FRAC_PI_2;
use std::path::Path;
use std::time::Instant;

use raygrad::nerf::dataset::{Split, evenly_spaced};
use raygrad::nerf::geometry::files;
use raygrad::nerf::geometry::{Stage, SurfaceConfig};
use raygrad::nerf::{Camera, Error, Extent, Model, Result};
use serde::Serialize;

use crate::cameras::Viewpoint;
use crate::output::{check_writable, note, parent, print};
use crate::overwrite::Job;
use crate::parse;
use crate::photographs::photographs;
use crate::progress::{Progress, spoken};
use crate::run::Run;
use crate::scene::Scene;

/// Cameras in each of the rings that look at the scene.
const RING: usize = 12;
/// Photographs whose cameras look at the scene too, at most.
const PHOTOGRAPHS: usize = 100;

/// Most points of a cloud.
const MOST_POINTS: usize = 10_000_000;

/// What is made of a model's shape.
#[derive(clap::Args, Serialize)]
pub struct Options {
    /// Write a point cloud of at most N points in place of a mesh [default: 200000]
    #[arg(
        long,
        value_name = "N",
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = "200000",
        value_parser = parse::count(MOST_POINTS)
    )]
    points: Option<usize>,
    /// Make the mesh's triangles fewer, down to N
    #[arg(long, value_name = "N", conflicts_with = "points")]
    triangles: Option<usize>,
    /// Cells along the longest side of the box in which the surface is looked for [default: 2 for each of the occupancy grid]
    #[arg(long, value_name = "N", conflicts_with = "points")]
    resolution: Option<usize>,
    /// Density on the surface, in 1 / scene unit [default: that where views see it]
    #[arg(long, value_name = "X", conflicts_with = "points")]
    level: Option<f64>,
    /// Leave out parts with less than this share, 0 to 1, of the largest one's area; 0 keeps all [default: 0.01]
    #[arg(long, value_name = "SHARE", conflicts_with = "points")]
    parts: Option<f64>,
    /// Do not take what no view sees to be solid
    #[arg(long, conflicts_with = "points")]
    hollow: bool,
    /// Let the surface end at the border of the box, where it is closed otherwise
    #[arg(long, conflicts_with = "points")]
    open: bool,
}

impl Options {
    /// Whether nothing of this is asked for, which cameras have no use for.
    pub fn check_absent(&self) -> Result<()> {
        let given = [
            ("points", self.points.is_some()),
            ("triangles", self.triangles.is_some()),
            ("resolution", self.resolution.is_some()),
            ("level", self.level.is_some()),
            ("parts", self.parts.is_some()),
            ("hollow", self.hollow),
            ("open", self.open),
        ];
        match given.iter().find(|(_, given)| *given) {
            Some((name, _)) => Err(Error::setting(name, "is for shapes: name a file that ends in .ply, .obj or .glb")),
            None => Ok(()),
        }
    }
}

/// Makes the shape and writes it.
pub fn run(run: &Run, scene: Option<&Scene>, options: &Options, out: &Path, job: &Job) -> Result<()> {
    check_writable(parent(out))?;
    let model = run.model()?;
    let cameras = cameras(run, &model, scene)?;
    let start = Instant::now();
    let mut display = Display::new();
    let mut show = |stage: Stage, done: f64| display.set(stage, done);
    let (shape, said) = match options.points {
        Some(count) => {
            let cloud = model.point_cloud(&cameras, count, &mut show)?;
            let points = cloud.shape.mesh.positions.len();
            (cloud.shape, format!("{points} points, of {} places that {} views see", cloud.sights, cameras.len()))
        }
        None => {
            let default = SurfaceConfig::default();
            let config = SurfaceConfig {
                resolution: options.resolution,
                level: options.level,
                parts: options.parts.unwrap_or(default.parts),
                triangles: options.triangles,
                filled: !options.hollow,
                closed: !options.open,
            };
            let surface = model.surface(&cameras, &config, &mut show)?;
            let mesh = &surface.shape.mesh;
            if let Some(most) = options.triangles.filter(|most| mesh.triangles.len() > *most) {
                let count = mesh.triangles.len();
                note(&format!(
                    "the mesh keeps {count} triangles, more than {most}: with fewer it would fold or lose a part"
                ));
            }
            let said = format!(
                "{} vertices, {} triangles, {}; density {:.4} per scene unit, {} cells along the box, {} small parts left out",
                mesh.positions.len(),
                mesh.triangles.len(),
                if mesh.is_closed() { "closed" } else { "not closed" },
                surface.level,
                surface.resolution,
                surface.dropped
            );
            (surface.shape, said)
        }
    };
    drop(display);
    job.check(out)?;
    let bytes = files::write_with_comment(&shape.placed_back(&model.extent.placement), out, job.mark())?;
    let part = if model.config.unbounded { ", of the box where the cameras look" } else { "" };
    let (size, seconds) = (bytes as f64 / 1e6, start.elapsed().as_secs_f64());
    print(&format!("exported {said}{part}: {} ({size:.1} MB, {seconds:.1} s)\n", out.display()))
}

/// Cameras that look at the scene: those of its photographs, if they are still there or `scene` says where, and others around it.
fn cameras(run: &Run, model: &Model<f32>, scene: Option<&Scene>) -> Result<Vec<Camera>> {
    let around = rings(&run.config.viewpoint, &run.config.extent);
    let own = match photographs(run, model, scene, Split::Train) {
        Ok(own) => evenly_spaced(own, PHOTOGRAPHS),
        Err(error) if scene.is_some() => return Err(error),
        Err(error) => {
            note(&format!("looking from around the scene alone, as its photographs' cameras are not known: {error}"));
            vec![]
        }
    };
    Ok(own.into_iter().map(|photograph| photograph.camera).chain(around).collect())
}

/// Cameras around the scene, at the mean height of its photographs, lower, and higher.
fn rings(viewpoint: &Viewpoint, extent: &Extent) -> Vec<Camera> {
    let mean = viewpoint.elevation;
    let elevations = [0.1 * mean, 0.5 * mean, mean, 0.5 * (mean + FRAC_PI_2.copysign(mean))];
    let ring = |elevation| Viewpoint { elevation, ..*viewpoint }.orbit(extent, RING);
    let mut around: Vec<Camera> = vec![];
    for camera in elevations.into_iter().flat_map(ring) {
        // What swings to and fro comes by places twice, and rings at the horizon are one.
        if !around.iter().any(|other| other.pose.abs_diff_eq(camera.pose, 1e-9)) {
            around.push(camera);
        }
    }
    around
}

/// How far each stage is, and how long it may take.
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
            Stage::Seeing => "looking at the scene",
            Stage::Meshing => "finding the surface",
            Stage::Simplifying => "making triangles fewer",
            Stage::Coloring => "finding colours",
        };
        self.progress
            .set(done, || if done > 0.0 { format!("{doing}, {} left", spoken(left)) } else { doing.to_owned() });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::glam::DVec3;
    use std::f64::consts::PI;

    #[test]
    fn no_camera_around_a_scene_is_there_twice() {
        let extent = Extent::new([DVec3::NEG_ONE, DVec3::new(1.0, 2.0, 1.0)], [0.5, 9.0]);
        let around = |elevation: f64, reach: f64| {
            let view = Viewpoint { width: 40, height: 30, angle_x: 0.8, distance: 4.0, elevation, azimuth: 0.2, reach };
            rings(&view, &extent)
        };
        let count = |elevation: f64, reach: f64| around(elevation, reach).len();
        // Low, lower, as the photographs are, and half way from there to the pole; the middle of the box is at 0.
        for sign in [1.0, -1.0] {
            let heights = around(0.4 * sign, PI).into_iter().step_by(12).map(|camera| camera.pose.translation.z);
            let expected = [0.04_f64, 0.2, 0.4, 0.2 + PI / 4.0].map(|angle| sign * 4.0 * angle.sin());
            assert!(heights.zip(expected).all(|(height, expected)| (height - expected).abs() < 1e-12), "{sign}");
        }
        // A swing of twelve cameras is at seven places.
        assert_eq!([count(0.4, PI), count(-0.4, PI), count(0.4, 0.6)], [48, 48, 28]);
        // At the horizon, and half way up.
        assert_eq!([count(0.0, PI), count(0.0, 0.6)], [24, 14]);
    }
}
