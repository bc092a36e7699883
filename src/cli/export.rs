//! `raygrad export`: what a run has found out, for other programs.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use raygrad::nerf::dataset::formats::transforms;
use raygrad::nerf::dataset::{Capture, Split};
use raygrad::nerf::{Error, Model, Result};

use super::output::print;
use super::prepare::convert::{Target, convert};
use super::prepare::program::Stop;
use super::run::Run;
use super::scene::Scene;
use super::{builtin, interrupt};

/// Write the cameras of a run for other programs, as the run has refined them
///
/// They are in the coordinates of the photographs' own files. Where the run has learned poses, photographs that it was
/// trained on have the refined ones, and all others those that they were given.
#[derive(clap::Args)]
pub struct Args {
    /// Folder that `raygrad train` made
    run: PathBuf,
    /// File for the cameras, such as cameras.json, in the form of transforms.json: its paths begin at the folder of the
    /// photographs. With --to, a folder for a whole dataset
    #[arg(value_name = "OUT")]
    out: PathBuf,
    /// Write a whole dataset in this format, photographs and all
    #[arg(long, value_enum, value_name = "FORMAT")]
    to: Option<Target>,
    /// Folder of the photographs, if they are no longer where they were for training
    #[arg(long)]
    scene: Option<Scene>,
}

/// Writes the cameras.
pub fn run(args: &Args) -> Result<ExitCode> {
    let run = Run::open(&args.run)?;
    let model = run.model()?;
    let mut capture = match run.scene(args.scene.as_ref())? {
        Scene::Folder(folder) => Capture::read(folder)?,
        scene => builtin::capture(&scene, None, None)?,
    };
    let refined = refine(&mut capture, &model)?;
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
fn refine(capture: &mut Capture, model: &Model<f32>) -> Result<usize> {
    if model.refine.is_none() {
        return Ok(0);
    }
    let placement = model.extent.placement;
    // In the order in which they were read for training, which numbers them.
    let train = capture.split(Split::Train)?.into_iter();
    let made = capture.present().next().is_none();
    let train = train.filter(|view| made || view.image.is_some());
    let trained: Vec<String> = train.map(|view| view.field.clone()).collect();
    if trained.len() != model.extent.frames {
        let what = format!(
            "has {} photographs to train on, and the run was trained on {}: say with --scene where those are",
            trained.len(),
            model.extent.frames
        );
        return Err(Error::file(&capture.file, what));
    }
    let mut count = 0;
    for (number, field) in trained.iter().enumerate() {
        let Some(view) = capture.views.iter_mut().find(|view| view.field == *field) else { continue };
        view.camera = placement.camera_back(&model.learned_camera(number, &placement.camera(&view.camera)));
        count += 1;
    }
    Ok(count)
}

/// Writes the cameras alone.
fn write(mut capture: Capture, out: &Path) -> Result<()> {
    // Points would be a file of their own.
    capture.points.clear();
    if out.is_dir() {
        return Err(Error::file(out, "is a folder: name a file such as cameras.json, or a format with --to"));
    }
    let parent = out.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let bad = |e: std::io::Error| Error::file(out, format!("cannot be written: {e}"));
    let folder = tempfile::tempdir_in(parent).map_err(bad)?;
    transforms::write(&capture, folder.path())?;
    std::fs::rename(folder.path().join("transforms.json"), out).map_err(bad)
}
