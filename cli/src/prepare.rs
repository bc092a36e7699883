//! `raygrad prepare`: makes a dataset from a video, images, or another dataset.

pub mod beside;
mod bounds;
mod cameras;
pub mod convert;
mod foreign;
mod pairs;
mod photographs;
mod poses;
pub mod program;
mod root;
mod tone;
mod undistort;
mod video;
mod workplace;

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use raygrad::nerf::Error;
use raygrad::nerf::dataset::Capture;

use super::interrupt::Work;
use super::output::{complain, listed, note, print, quoted};
use super::parse;
use super::scene::{CaptureArgs, Scene, assumptions};
use super::shard::Shard;
use super::{builtin, doctor, interrupt};
use convert::{Conversion, Target};
use workplace::Workplace;

/// Frames to take from a video by default.
const FRAMES: usize = 120;
/// The time between frames, in seconds, in which a walking person takes two steps.
const SLOW: f64 = 1.0;
/// Names of images in a message. Further ones are counted.
const NAMED: usize = 8;

/// Make a dataset from a video, images or a dataset
///
/// ffmpeg extracts the frames of a video, and COLMAP finds the camera poses; both must be installed. --to and
/// --undistort convert a dataset that already has poses.
///
/// Example: raygrad prepare walk.mp4 --out my-scene
#[derive(clap::Args)]
pub struct Args {
    /// A video, an image folder, a dataset or a built-in scene
    ///
    /// Built-in scenes: embedded and landscape.
    input: PathBuf,
    /// New or empty folder for the dataset
    #[arg(long, help_heading = "Output", value_name = "DIR")]
    out: PathBuf,
    /// Convert a dataset to this format
    ///
    /// nerfstudio: transforms.json, also of instant-ngp. colmap: sparse/0/*.bin. colmap-text: sparse/0/*.txt. llff:
    /// poses_bounds.npy. blender: transforms_train.json, as in the NeRF-synthetic scenes.
    #[arg(long, help_heading = "Output", hide_possible_values = true, value_enum, value_name = "FORMAT")]
    to: Option<Target>,
    /// Remove lens distortion from the images
    ///
    /// The images are cropped so that no pixel is empty.
    #[arg(long, help_heading = "Output")]
    undistort: bool,
    /// Frames to take from a video [default: 120]
    ///
    /// raygrad extracts three times as many and keeps the sharpest.
    #[arg(long, help_heading = "Scene", value_name = "N", value_parser = parse::count(10_000),
          conflicts_with_all = ["to", "undistort"])]
    frames: Option<usize>,
    /// perspective or fisheye
    ///
    /// perspective: straight lines stay nearly straight. fisheye: they bend, as with action cameras.
    #[arg(long, help_heading = "Scene", hide_possible_values = true, value_enum, default_value_t, conflicts_with_all = ["to", "undistort"])]
    lens: Glass,
    /// Also copy files from outside the input
    ///
    /// By default a new dataset takes no file from outside the input folder, not even through a link.
    #[arg(long, help_heading = "Output")]
    allow_outside: bool,
    /// Convert every Nth image, starting with the Ith
    ///
    /// For several programs, such as a job array, that convert one dataset to a new folder. Give each the same command
    /// with another I of I/N. The last one to finish makes the folder. See `raygrad merge`. Only with --to or
    /// --undistort.
    #[arg(long, help_heading = "Output", value_name = "I/N")]
    shard: Option<Shard>,
    /// Image width of a built-in scene, in pixels
    ///
    /// The default is 200 for embedded and 400 for landscape. Only with --to.
    #[arg(long, help_heading = "Scene", value_name = "PIXELS", value_parser = parse::count(8192), requires = "to")]
    size: Option<usize>,
}

/// Kinds of lenses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
enum Glass {
    /// Straight lines are nearly straight
    #[default]
    Perspective,
    /// Straight lines are bent, as by action cameras
    Fisheye,
}

impl Glass {
    /// COLMAP's name of the camera model.
    fn model(self) -> &'static str {
        match self {
            Glass::Perspective => "OPENCV",
            Glass::Fisheye => "OPENCV_FISHEYE",
        }
    }
}

/// Runs the command.
pub fn run(args: &Args) -> Work<()> {
    if args.shard.is_some() {
        if args.to.is_none() && !args.undistort {
            return Err(Error::setting("shard", "needs a conversion: add --to or --undistort").into());
        }
        interrupt::listen_to_go_on();
    } else {
        interrupt::listen_to_remove();
    }
    match (args.to, args.undistort) {
        (None, false) => prepare(args)?,
        (to, undistort) => {
            let pictures = tempfile::tempdir().map_err(|error| Error::setting("out", error))?;
            let scene = Scene::from(args.input.clone().into_os_string());
            let capture = builtin::capture(&scene, args.size, Some(pictures.path()))?;
            assumptions(&capture);
            let to = to.unwrap_or_else(|| Target::of(capture.format));
            let conversion = Conversion { capture, target: to, undistort, allow_outside: args.allow_outside };
            if let Some(shard) = args.shard {
                return conversion.run_shard(&args.out, shard);
            }
            conversion.run(&args.out)?;
        }
    }
    Ok(next(&args.out)?)
}

/// Prints the next commands for a dataset.
fn next(out: &Path) -> raygrad::nerf::Result<()> {
    let out = quoted(out);
    print(&format!("next     raygrad doctor {out}   to check it\n         raygrad train {out}   to train on it\n"))
}

/// A video or images without cameras.
struct Input<'a> {
    path: &'a Path,
    /// Frames to take from a video.
    frames: usize,
    lens: Glass,
    /// Whether links may lead out of a folder of images.
    allow_outside: bool,
}

/// Makes a dataset from a video or images, and examines it.
fn prepare(args: &Args) -> Work<()> {
    let input = &args.input;
    if !matches!(Scene::from(input.clone().into_os_string()), Scene::Folder(_)) {
        let what = "is a built-in scene: choose the format to write with --to";
        return Err(Error::file(input, what).into());
    }
    if !input.exists() {
        return Err(Error::file(input, "there is no such file or folder").into());
    }
    if !input.is_file() {
        if args.frames.is_some() {
            return Err(Error::setting("frames", "is for videos, and all images of a folder are taken").into());
        }
        match Capture::read(input) {
            Ok(_) => {
                let what = "already has camera poses: train on it, or choose a format to convert it to with --to";
                return Err(Error::file(input, what).into());
            }
            Err(error) if Capture::is_described(input) => {
                // Without images, it is for another program, which the error names.
                if !photographs::are_in(input) {
                    return Err(error.into());
                }
                complain(&format!("note: {}: its camera poses are not used: {error}", input.display()));
            }
            Err(_) => {}
        }
    }
    let Args { frames, lens, allow_outside, ref out, .. } = *args;
    make(&Input { path: input, frames: frames.unwrap_or(FRAMES), lens, allow_outside }, out)?;
    // The dataset is complete, so errors of the check are only warnings.
    let (scene, out) = (Scene::Folder(out.clone()), out.join("doctor"));
    let capture = CaptureArgs::default();
    let check = doctor::Args { scene, capture, compare: None, out, overwrite: false, json: false };
    if let Err(error) = doctor::run(&check) {
        complain(&format!("warning: {error}"));
    }
    Ok(())
}

/// Makes a dataset in `out`.
fn make(input: &Input<'_>, out: &Path) -> Work<()> {
    let Input { path, frames, lens, allow_outside } = *input;
    let is_video = path.is_file();
    // Checks the input first: a folder without images needs no COLMAP.
    let images = if is_video { vec![] } else { photographs::find(path)? };
    if is_video {
        photographs::check_no_image(path)?;
        program::FFMPEG.check()?;
    }
    poses::check()?;
    let place = Workplace::new(out)?;
    let count = if is_video {
        let (count, interval) = video::frames(path, frames, &place)?;
        print(&format!("images   {count} sharp frames from {}, one in {interval:.2} s\n", path.display()))?;
        if interval > SLOW && count >= frames {
            note("these frames may overlap too little for COLMAP: `raygrad prepare --frames N` takes more of them");
        }
        count
    } else {
        let count = photographs::copy(path, &images, allow_outside, &place)?;
        print(&format!("images   {count} images from {}\n", path.display()))?;
        count
    };
    let found = poses::find(&place, is_video, lens.model())?;
    place.finish()?;
    report(&found, count, out)
}

fn report(found: &poses::Found, count: usize, out: &Path) -> Work<()> {
    let poses::Found { registered, lost, models } = found;
    let models = if *models > 1 { format!(", in the largest of {models} models") } else { String::new() };
    print(&format!("cameras  {registered} of {count} images registered{models}\n"))?;
    if !lost.is_empty() {
        print(&format!("no pose  {}\n", listed(lost, NAMED)))?;
    }
    if 2 * registered < count {
        complain("warning: most images have no camera pose: take more images that overlap and are sharp");
    }
    print(&format!("scene    {}\n", out.display()))?;
    Ok(())
}
