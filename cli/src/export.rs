//! `raygrad export`: cameras, datasets, geometry and scene pages for other programs.

mod geometry;
mod page;

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use raygrad::nerf::dataset::Capture;
use raygrad::nerf::dataset::formats::transforms;
use raygrad::nerf::geometry::files::Format;
use raygrad::nerf::{Error, Model, Result, write_atomic};
use raygrad::nn::TEMPORARY_PREFIX;
use serde_json::json;

use super::builtin;
use super::interrupt::{self, Work};
use super::output::{parent, print};
use super::overwrite::Job;
use super::photographs::{learned_transform, trained};
use super::prepare::convert::{Conversion, Target, relative};
use super::run::{Run, check_output};
use super::scene::Scene;
use super::scratch::ScratchFolder;

/// Export cameras, a mesh, points or a scene page
///
/// Everything is in the coordinates of the capture. If the run refined poses, training images get the refined ones,
/// aligned as a whole to the given ones. Other images keep their poses and get the refined focal length and lens.
///
/// A mesh or point cloud has normals and colours. It covers the scene box, or --bounds. A page (.html) renders the
/// whole scene in any browser with WebGL 2, without a server or a network.
///
/// The same command replaces its own files, and no others unless --overwrite is given.
///
/// Example: raygrad export my-run mesh.ply --triangles 50000
#[derive(clap::Args)]
pub struct Args {
    /// Run folder, made by `raygrad train`
    run: PathBuf,
    /// .json (cameras), .ply, .obj, .glb, .html, or a folder
    ///
    /// FILE.json: cameras as in transforms.json; its paths start at the image folder. FILE.ply, .obj or .glb: a
    /// mesh or points. FILE.html: the scene as one page. With --to: a folder for a whole dataset.
    #[arg(value_name = "OUT")]
    out: PathBuf,
    /// Write a dataset in this format
    ///
    /// nerfstudio: transforms.json, also of instant-ngp. colmap: sparse/0/*.bin. colmap-text: sparse/0/*.txt. llff:
    /// poses_bounds.npy. blender: transforms_train.json, as in the NeRF-synthetic scenes.
    #[arg(long, help_heading = "Output", hide_possible_values = true, value_enum, value_name = "FORMAT")]
    to: Option<Target>,
    /// Image folder, if it moved after training
    ///
    /// Without it, raygrad reads the images from where they were during training.
    #[arg(long, help_heading = "Scene")]
    scene: Option<Scene>,
    /// Replace files that another command wrote
    #[arg(long, help_heading = "Output", conflicts_with = "to")]
    overwrite: bool,
    /// Also copy files from outside the capture
    ///
    /// By default a new dataset takes no file from outside the capture folder, not even through a link. Only with --to.
    #[arg(long, help_heading = "Output", requires = "to")]
    allow_outside: bool,
    #[command(flatten)]
    shape: geometry::GeometryOptions,
}

/// Kind of the output, from the file name's extension.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Cameras,
    Shape,
    Page,
}

impl Kind {
    fn of(out: &Path) -> Result<Self> {
        if Format::of(out).is_some() {
            return Ok(Kind::Shape);
        }
        match out.extension().and_then(|ending| ending.to_str()).map(str::to_ascii_lowercase).as_deref() {
            Some("json") => Ok(Kind::Cameras),
            Some("html") => Ok(Kind::Page),
            _ => {
                let known = "use .json for cameras, .ply, .obj or .glb for a mesh, .html for a scene page, or name a \
                             format with --to";
                Err(Error::file(out, format!("has no known file extension: {known}")))
            }
        }
    }
}

/// Runs the export.
pub fn run(args: &Args) -> Work<()> {
    let run = Run::open(&args.run)?;
    let kind = if args.to.is_some() { Kind::Cameras } else { Kind::of(&args.out)? };
    let arguments = json!({ "run": run.identity(), "shape": args.shape });
    let job = Job::new("export", &arguments, args.overwrite);
    if kind != Kind::Shape {
        args.shape.check_absent()?;
    }
    check_output(&args.out)?;
    if args.to.is_none() {
        job.check(&args.out)?;
    }
    match kind {
        Kind::Shape => return Ok(geometry::run(&run, args.scene.as_ref(), &args.shape, &args.out, &job)?),
        Kind::Page => return Ok(page::run(&run, &args.out, &job)?),
        Kind::Cameras => {}
    }
    let model = run.model()?;
    let pictures = tempfile::tempdir().map_err(|error| Error::setting("out", error))?;
    let mut capture = match run.scene(args.scene.as_ref())? {
        Scene::Folder(_) => run.capture(args.scene.as_ref())?,
        scene => builtin::capture(scene, None, args.to.map(|_| pictures.path()))?,
    };
    let refined = refine(&mut capture, &model, &run)?;
    let cameras = capture.views.len();
    match args.to {
        None => write(capture, &args.out, &job)?,
        Some(target) => {
            interrupt::listen_to_remove();
            Conversion { capture, target, undistort: false, allow_outside: args.allow_outside }.run(&args.out)?;
        }
    }
    print(&format!("exported {cameras} cameras, {refined} of them refined: {}\n", args.out.display()))?;
    Ok(())
}

/// Sets the cameras of the capture to those with pose refinement. Returns the number of training images.
///
/// The learned transform of all cameras is undone, since images do not determine it. So other cameras and the points
/// keep their coordinates.
fn refine(capture: &mut Capture, model: &Model<f32>, run: &Run) -> Result<usize> {
    if model.camera_optimizer.is_none() {
        return Ok(0);
    }
    let drift = learned_transform(model);
    let transform = model.scene_box.transform;
    let trained: HashMap<String, usize> =
        trained(run, capture)?.iter().enumerate().map(|(number, view)| (view.field.clone(), number)).collect();
    for view in &mut capture.views {
        let given = transform.camera(&view.camera);
        let found = match trained.get(&view.field) {
            Some(&number) => model.learned_camera(number, &given),
            None => model.other_camera(&given),
        };
        if found != given {
            view.camera = transform.camera_back(&drift.camera_back(&found));
        }
    }
    Ok(trained.len())
}

/// Writes the cameras only.
fn write(mut capture: Capture, out: &Path, job: &Job) -> Result<()> {
    // Points would need a file of their own.
    capture.points.clear();
    for view in capture.views.iter_mut().filter(|view| view.image.is_some()) {
        // Paths start at the capture's folder, as those of masks and depths do.
        view.name = relative(&capture.folder, view)?;
    }
    let bad = |e: std::io::Error| Error::file(out, format!("cannot be written: {e}"));
    let folder = ScratchFolder::new(parent(out), TEMPORARY_PREFIX).map_err(bad)?;
    // The user knows the file by its own name.
    transforms::write(&capture, folder.path()).map_err(|error| match error {
        Error::File { what, .. } => Error::file(out, what),
        other => other,
    })?;
    let text = std::fs::read_to_string(folder.path().join("transforms.json")).map_err(bad)?;
    // An extra field for the mark. Other programs ignore unknown fields.
    let text = text.replacen('{', &format!("{{\n  \"exported_by\": \"{}\",", job.mark()), 1);
    job.check(out)?;
    write_atomic(out, text.as_bytes())
}
