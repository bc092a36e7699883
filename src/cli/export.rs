//! `raygrad export`: what a run has found out, for other programs.

mod geometry;
mod page;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use raygrad::nerf::dataset::formats::transforms;
use raygrad::nerf::dataset::{Capture, Split};
use raygrad::nerf::{Error, Model, Result};

use super::output::{parent, print};
use super::photographs::{check_trained, present};
use super::prepare::convert::{Target, convert, relative};
use super::prepare::program::Stop;
use super::run::Run;
use super::scene::Scene;
use super::{builtin, interrupt};

/// Write the cameras or the shape of a run for other programs, or the scene as a page
///
/// All is in the coordinates of the photographs' own files. Where the run has learned poses, photographs that it was
/// trained on have the refined ones, moved as a whole to where the given ones are; of others, held-out ones, only focal length
/// and lens follow. A file that ends in .ply, .obj or .glb has the surface as a mesh, or with --points as points, with normals and
/// colours; of a scene that goes on, what is within the box where the cameras look. One that ends in .html has the whole scene as
/// a page that renders itself in any browser with WebGL 2, to be sent to others: it needs no server and no network.
#[derive(clap::Args)]
pub struct Args {
    /// Folder that `raygrad train` made
    run: PathBuf,
    /// File for the cameras, such as cameras.json, in the form of transforms.json: its paths begin at the folder of the
    /// photographs. Or one for the shape, such as mesh.ply, mesh.obj or mesh.glb. With --to, a folder for a whole dataset
    #[arg(value_name = "OUT")]
    out: PathBuf,
    /// Write a whole dataset in this format, photographs and all
    #[arg(long, value_enum, value_name = "FORMAT")]
    to: Option<Target>,
    /// Folder of the photographs, if they are no longer where they were for training
    #[arg(long)]
    scene: Option<Scene>,
    #[command(flatten)]
    shape: geometry::Options,
}

/// Writes the cameras, or the shape.
pub fn run(args: &Args) -> Result<ExitCode> {
    let run = Run::open(&args.run)?;
    if args.to.is_none() && geometry::is_shape(&args.out) {
        return geometry::run(&run, args.scene.as_ref(), &args.shape, &args.out).map(|()| ExitCode::SUCCESS);
    }
    args.shape.check_absent()?;
    if args.to.is_none() && page::is_page(&args.out) {
        return page::run(&run, &args.out).map(|()| ExitCode::SUCCESS);
    }
    let model = run.model()?;
    let pictures = tempfile::tempdir().map_err(|error| Error::setting("out", error))?;
    let mut capture = match run.scene(args.scene.as_ref())? {
        Scene::Folder(folder) => Capture::read(folder)?,
        scene => builtin::capture(scene, None, args.to.map(|_| pictures.path()))?,
    };
    let refined = refine(&mut capture, &model, &run)?;
    let cameras = capture.views.len();
    match args.to {
        None => write(capture, &args.out)?,
        Some(target) => {
            interrupt::listen_to_remove();
            match convert(capture, target, false, &args.out) {
                Ok(()) => {}
                Err(Stop::Interrupted) => return Ok(interrupt::EXIT_CODE.into()),
                Err(Stop::Failed(error)) => return Err(error),
            }
        }
    }
    print(&format!("exported {cameras} cameras, {refined} of them refined: {}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// Puts the cameras of the photographs that the model was trained on where it has found them to be; says how many those are.
///
/// What cameras have done as a whole is undone, which no photograph shows: so those of other photographs, and points, stay
/// where they belong.
fn refine(capture: &mut Capture, model: &Model<f32>, run: &Run) -> Result<usize> {
    let Some(refine) = &model.refine else { return Ok(0) };
    let drift = refine.placement(&model.params).unwrap_or_default();
    let placement = model.extent.placement;
    let views = present(capture, Split::Train)?;
    check_trained(run, capture, &views, model.extent.frames)?;
    let trained: HashMap<String, usize> =
        views.iter().enumerate().map(|(number, view)| (view.field.clone(), number)).collect();
    for view in &mut capture.views {
        let given = placement.camera(&view.camera);
        let found = match trained.get(&view.field) {
            Some(&number) => model.learned_camera(number, &given),
            None => model.other_camera(&given),
        };
        if found != given {
            view.camera = placement.camera_back(&drift.camera_back(&found));
        }
    }
    Ok(trained.len())
}

/// Writes the cameras alone.
fn write(mut capture: Capture, out: &Path) -> Result<()> {
    // Points would be a file of their own.
    capture.points.clear();
    for view in capture.views.iter_mut().filter(|view| view.image.is_some()) {
        // As masks and depths are: from the folder of the capture.
        view.name = relative(&capture.folder, view)?;
    }
    if out.is_dir() {
        return Err(Error::file(out, "is a folder: name a file such as cameras.json, or a format with --to"));
    }
    let bad = |e: std::io::Error| Error::file(out, format!("cannot be written: {e}"));
    let folder = tempfile::tempdir_in(parent(out)).map_err(bad)?;
    transforms::write(&capture, folder.path())?;
    std::fs::rename(folder.path().join("transforms.json"), out).map_err(bad)
}
