//! `raygrad render`: new views.

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use raygrad::nerf::dataset::Split;
use raygrad::nerf::dataset::scene::test_cameras;
use raygrad::nerf::space::occupancy::Skip;
use raygrad::nerf::{Camera, Error, Image, Model, Result, write_atomic};

use super::animation::Animation;
use super::cameras::fitted;
use super::output::{check_writable, depth_colors, make_folder, note, numbered, other_numbered, print};
use super::parse;
use super::precision::{Precision, Renderer};
use super::progress::Progress;
use super::run::Run;
use super::scene::Scene;

/// Frames of an orbit.
const ORBIT_FRAMES: usize = 60;

/// Render pictures or an animation of a model
///
/// Pictures of the same name are replaced.
#[derive(clap::Args)]
pub struct Args {
    /// Folder that `raygrad train` made
    run: PathBuf,
    /// Where the camera goes
    #[arg(long, value_enum, default_value_t = CameraPath::Orbit)]
    path: CameraPath,
    /// Number of frames [default: 60 for an orbit, one for each test view]
    #[arg(long, value_name = "N", value_parser = parse::count(100_000))]
    frames: Option<usize>,
    /// Size of the pictures, such as 400x300 [default: that of the training images]
    #[arg(long, value_name = "WxH", value_parser = parse::size)]
    size: Option<[usize; 2]>,
    /// Folder for PNG frames, or a file: FILE.png for the first frame, FILE.gif for an animation [default: RUN/PATH]
    #[arg(long, value_name = "DIR|FILE")]
    out: Option<PathBuf>,
    /// How much that hardly shows to leave out: off, lossless or fast [default: as in training]
    #[arg(long)]
    skip: Option<Skip>,
    /// Arithmetic of the pictures
    #[arg(long, value_enum, default_value_t)]
    precision: Precision,
    /// Show depth in false colour: yellow near, violet far, black where there is nothing
    #[arg(long)]
    depth: bool,
    /// Folder of the photographs, if the test views are no longer where they were for training
    #[arg(long)]
    scene: Option<Scene>,
}

/// Where the camera goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum CameraPath {
    /// Around the scene, or to and fro where photographs are from one side, at the distance and the height of the average training camera
    Orbit,
    /// From test view to test view
    Test,
}

impl CameraPath {
    fn name(self) -> &'static str {
        match self {
            CameraPath::Orbit => "orbit",
            CameraPath::Test => "test",
        }
    }
}

impl Args {
    /// One picture of a run, `picture.png` in its folder.
    pub fn picture(run: &Path) -> Self {
        Args {
            run: run.into(),
            path: CameraPath::Orbit,
            frames: None,
            size: None,
            out: Some(run.join("picture.png")),
            skip: None,
            precision: Precision::F32,
            depth: false,
            scene: None,
        }
    }
}

/// Renders and writes the files.
pub fn run(args: &Args) -> Result<()> {
    let run = Run::open(&args.run)?;
    let mut model = run.model()?;
    if let Some(skip) = args.skip {
        model.set_skip(skip);
    }
    let out = args.out.clone().unwrap_or_else(|| run.file(args.path.name()));
    let kind = Kind::of(&out);
    let mut cameras = cameras(args, &run, &model)?;
    if kind == Kind::Png {
        cameras.truncate(1);
    }
    let mut sink = Sink::new(kind, &out, [cameras[0].width, cameras[0].height])?;
    let background = model.config.background.shown();
    let span = model.extent.span;
    let renderer = Renderer::new(model, args.precision)?;
    let mut progress = Progress::new();
    for (i, camera) in cameras.iter().enumerate() {
        let picture = renderer.view(camera, background);
        let image = if args.depth { depth_colors(&picture, span) } else { picture.color };
        sink.push(i, &image)?;
        let (done, all) = (i + 1, cameras.len());
        progress.set(done as f64 / all as f64, || format!("frame {done} of {all}"));
    }
    drop(progress);
    sink.finish()?;
    if kind == Kind::Folder {
        let older = other_numbered(&out, DIGITS, &(0..cameras.len()).collect::<Vec<_>>());
        if !older.is_empty() {
            // They may be what somebody wants to keep.
            note(&format!("{} holds {} more numbered pictures, from a longer path", out.display(), older.len()));
        }
    }
    let [width, height] = [cameras[0].width, cameras[0].height];
    let frames = if cameras.len() == 1 { "frame" } else { "frames" };
    print(&format!("rendered {} {frames} of {width}x{height}: {}\n", cameras.len(), out.display()))
}

/// Digits of the number of a frame in a folder.
const DIGITS: usize = 4;

/// The cameras along the path; at least one.
fn cameras(args: &Args, run: &Run, model: &Model<f32>) -> Result<Vec<Camera>> {
    let config = &run.config;
    let view = &config.viewpoint;
    let size = args.size.unwrap_or([view.width, view.height]);
    let frames = args.frames.unwrap_or(ORBIT_FRAMES);
    let cameras = match (args.path, &config.scene) {
        (CameraPath::Orbit, Scene::Embedded) => test_cameras(frames, view.width),
        (CameraPath::Orbit, Scene::Landscape | Scene::Folder(_)) => view.orbit(&config.extent, frames),
        (CameraPath::Test, _) => {
            let scene = run.scene(args.scene.as_ref())?.open_for(&config.extent)?;
            let data = scene.load(Split::Test, config.downscale, args.frames.unwrap_or(usize::MAX))?;
            // Where the model has them, if it has learned something of cameras.
            data.frames.iter().map(|frame| model.other_camera(&frame.camera)).collect()
        }
    };
    Ok(cameras.iter().map(|camera| fitted(camera, size)).collect())
}

/// What the output is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// A folder of PNG files.
    Folder,
    Png,
    Gif,
}

impl Kind {
    fn of(out: &Path) -> Self {
        match out.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
            Some("png") => Kind::Png,
            Some("gif") => Kind::Gif,
            _ => Kind::Folder,
        }
    }
}

/// Takes frames and leaves files.
enum Sink<'a> {
    Folder(&'a Path),
    Png(&'a Path),
    Gif(&'a Path, Box<Animation>),
}

impl<'a> Sink<'a> {
    /// Sees to it that the files can be written before there is anything to write.
    fn new(kind: Kind, out: &'a Path, size: [usize; 2]) -> Result<Self> {
        if kind == Kind::Folder {
            make_folder(out)?;
            return Ok(Sink::Folder(out));
        }
        if out.is_dir() {
            return Err(Error::file(out, "is a folder, not a file"));
        }
        check_writable(out.parent().unwrap_or(Path::new(".")))?;
        if kind == Kind::Png {
            return Ok(Sink::Png(out));
        }
        let animation = Animation::new(size.map(|side| side as u16)).map_err(|e| Error::file(out, e))?;
        Ok(Sink::Gif(out, Box::new(animation)))
    }

    fn push(&mut self, index: usize, image: &Image) -> Result<()> {
        match self {
            Sink::Folder(folder) => image.save_png(folder.join(numbered(index, DIGITS))),
            Sink::Png(path) => image.save_png(path),
            Sink::Gif(path, animation) => animation.push(image).map_err(|e| Error::file(path, e)),
        }
    }

    fn finish(self) -> Result<()> {
        match self {
            Sink::Folder(_) | Sink::Png(_) => Ok(()),
            Sink::Gif(path, animation) => {
                let bytes = animation.finish().map_err(|e| Error::file(path, e))?;
                write_atomic(path, &bytes)
            }
        }
    }
}
