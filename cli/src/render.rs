//! `raygrad render`: renders new views.

mod animation;
mod camera_motion;
pub mod frames;
pub mod path_file;
pub mod shown;
mod video;

use std::path::{Path, PathBuf};
use std::time::Instant;

use raygrad::nerf::space::occupancy::Skip;
use raygrad::nerf::{Camera, Error, Result, write_atomic};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::interrupt::{self, Stop, Work};
use super::merge;
use super::output::{check_writable, note, other_numbered, parent, print, quoted};
use super::overwrite::{Job, png_with_text};
use super::precision::{Precision, Renderer};
use super::progress::{Progress, spoken};
use super::run::{Run, check_output};
use super::scene::Scene;
use super::shard::{Complete, Shard, Whole};
use super::{parse, ranks};
use camera_motion::{CameraMotion, CameraPath, CameraPathArgs};
use frames::{DIGITS, Frames};
use shown::{Layer, Show, Shown};
pub use video::frames_of;
use video::{VideoFormat, VideoWriter, video_of};

/// Render images or a video
///
/// The same command replaces its own images and videos, and no others unless --overwrite is given. A video's frames
/// go to FILE.frames/ first. After a Ctrl-C or a crash the same command resumes there.
///
/// Example: raygrad render my-run --out orbit.mp4 --seconds 6 --size 800x800
#[derive(clap::Args)]
pub struct Args {
    /// Run folder, made by `raygrad train`
    run: PathBuf,
    #[command(flatten)]
    flight: CameraPathArgs,
    /// A folder, or .png, .gif, .apng, .mp4, .webm
    ///
    /// A folder takes one PNG per frame; FILE.png takes the first frame. MP4 and WebM need ffmpeg. [default:
    /// RUN/PATH]
    #[arg(long, help_heading = "Output", value_name = "OUT")]
    out: Option<PathBuf>,
    /// color, depth, normals or opacity
    ///
    /// color: as an image shows it. depth: false colour, yellow near, violet far, black empty. normals: red, green
    /// and blue for x, y and z in the capture's axes, from -1 to 1. opacity: white where all light is blocked.
    #[arg(long, help_heading = "Output", hide_possible_values = true, value_enum, default_value_t)]
    show: Show,
    /// Extra layers: depth,normals,opacity,alpha
    ///
    /// Layers go to folders beside the frames. depth: depth along the optical axis, depth/NUMBER.png, 16 bits in
    /// steps of --depth-unit, 0 where empty. depth-npy: the same in capture units, depth/NUMBER.npy, f32 [height,
    /// width]. normals: 0.5 + 0.5 n in the capture's axes, black where empty. opacity: grey. alpha: RGBA without
    /// the background, not premultiplied.
    #[arg(
        long,
        help_heading = "Output",
        hide_possible_values = true,
        value_enum,
        value_name = "LAYERS",
        value_delimiter = ','
    )]
    save: Vec<Layer>,
    /// One 16-bit depth step, in capture units
    ///
    /// If the capture is in metres, 0.001 is a millimetre. [default: 0.001]
    #[arg(long, help_heading = "Output", value_name = "LENGTH", value_parser = parse::above_zero)]
    depth_unit: Option<f64>,
    /// Background: white, black or R,G,B
    ///
    /// R, G and B range from 0 to 255. By default the background is that of training.
    #[arg(long, help_heading = "Output", value_name = "COLOR", value_parser = parse::color)]
    background: Option<[f32; 3]>,
    /// Empty-space skipping: off, near-lossless, fast
    ///
    /// near-lossless changes a colour by at most 0.6 % of its range, fast by at most 6 %. By default rendering
    /// skips as much as the run's config says.
    #[arg(long, help_heading = "Advanced", value_parser = parse::word::<Skip>)]
    skip: Option<Skip>,
    /// Arithmetic: f32 or f64
    ///
    /// f64 renders every sample in occupied cells in double precision and skips nothing else. It is slow, and a
    /// reference for measurements.
    #[arg(long, help_heading = "Advanced", hide_possible_values = true, value_enum, default_value_t)]
    precision: Precision,
    /// Render every Nth frame, starting with the Ith
    ///
    /// For several programs, such as a job array, that write to one folder. Give each the same command with another
    /// I of I/N. The last one to finish makes the video. See `raygrad merge`.
    #[arg(long, help_heading = "Output", value_name = "I/N")]
    pub shard: Option<Shard>,
    /// Keep a video's frames in FILE.frames/
    #[arg(long, help_heading = "Output")]
    keep_frames: bool,
    /// Replace files that another command wrote
    #[arg(long, help_heading = "Output")]
    overwrite: bool,
    /// Image folder, if it moved after training
    ///
    /// Without it, raygrad reads the images from where they were during training.
    #[arg(long, help_heading = "Scene")]
    scene: Option<Scene>,
    /// Stop, as by a Ctrl-C, when standard input ends
    #[arg(long, hide = true)]
    ends_with_input: bool,
}

impl Args {
    /// Arguments for one image of a run, `render.png` in its folder.
    pub fn picture(run: &Path) -> Self {
        Args {
            run: run.into(),
            flight: CameraPathArgs::default(),
            out: Some(run.join("render.png")),
            show: Show::Color,
            save: vec![],
            depth_unit: None,
            background: None,
            skip: None,
            precision: Precision::F32,
            shard: None,
            keep_frames: false,
            overwrite: false,
            scene: None,
            ends_with_input: false,
        }
    }

    /// The kind of the output; fails if an option does not apply to it.
    fn kind(&self, out: &Path) -> Result<Kind> {
        let kind = Kind::of(out)?;
        let unfit = |flag: &str, what: &str| Err(Error::setting(flag, what));
        if kind != Kind::Folder && !self.save.is_empty() {
            return unfit("save", "needs a folder: name one with --out");
        }
        if kind == Kind::Png && self.shard.is_some() {
            return unfit("shard", "needs several frames: name a folder or a video with --out");
        }
        if !self.save.contains(&Layer::Depth) && self.depth_unit.is_some() {
            return unfit("depth-unit", "needs --save depth");
        }
        let video = matches!(kind, Kind::Video(_));
        if self.keep_frames && !video {
            return unfit("keep-frames", "needs a video: name a .mp4, .webm, .gif or .apng file with --out");
        }
        let counts = self.flight.seconds.is_some() || matches!(self.flight.path, CameraPath::File(_));
        if self.flight.fps.is_some() && !counts && !video {
            return unfit("fps", "needs a video or --seconds");
        }
        Ok(kind)
    }

    /// All arguments that affect the output, except for the model.
    fn arguments(&self, run: &Run) -> Value {
        let Args { flight, show, save, depth_unit, background, skip, precision, .. } = self;
        json!({
            "run": run.identity(),
            "flight": flight,
            "show": show,
            "save": save,
            "depth_unit": depth_unit,
            "background": background,
            "skip": skip.map(|skip| skip.to_string()),
            "precision": precision,
        })
    }
}

/// Renders and writes the files.
pub fn run(args: &Args) -> Work<()> {
    let run = Run::open(&args.run)?;
    let out = args.out.clone().unwrap_or_else(|| run.file(args.flight.path.name()));
    let kind = args.kind(&out)?;
    if kind == Kind::Png && ranks::is_silent() {
        return Ok(());
    }
    let arguments = args.arguments(&run);
    // Without --out, renders go to a folder of the run, which no one else writes to.
    let job = Job::new(COMMAND, &arguments, args.overwrite || args.out.is_none());
    check_output(&out)?;
    if kind != Kind::Folder {
        job.check(&out)?;
    }
    // The checksums are computed before the files are read. If a file is replaced meanwhile, frames of both models
    // never mix in one video.
    let stored = run.checksums()?;
    let mut model = run.model()?;
    if let Some(skip) = args.skip {
        model.set_skip(skip);
    }
    if args.scene.is_some() && args.flight.path == CameraPath::Orbit && !args.ends_with_input {
        note("--scene is not used: an orbit needs no images");
    }
    let CameraMotion { cameras, fps } = args.flight.cameras(&run, &model, args.scene.as_ref())?;
    let extent = model.scene_box;
    let background = args.background.unwrap_or(model.config.background.shown());
    let show = args.show;
    let depth_unit = args.depth_unit.unwrap_or(MILLI);
    let renderer = Renderer::new(model, args.precision)?;
    let shown = Shown { renderer: &renderer, extent, background, show, save: &args.save, depth_unit };
    let folder = match kind {
        Kind::Png => {
            check_writable(parent(&out))?;
            let picture = shown.frame(&cameras[0]).image.to_png();
            job.check(&out)?;
            write_atomic(&out, &png_with_text(&picture, job.mark()))?;
            return Ok(report(1, [cameras[0].width, cameras[0].height], &out)?);
        }
        Kind::Video(video) => {
            video.check(&out, fps, [cameras[0].width, cameras[0].height])?;
            frames_of(&out)
        }
        Kind::Folder => out.clone(),
    };
    let of = contents(args, stored, &cameras, &shown)?;
    let size = [cameras[0].width, cameras[0].height];
    let output = Output { kind, frames: cameras.len(), size, fps, keep_frames: args.keep_frames };
    let shard = args.shard.or_else(ranks::shard);
    // Before the first file: the record of frames that are not finished.
    if cameras.len() > 1 {
        interrupt::listen_to_go_on();
    }
    let mut frames = match shard {
        None => Frames::new(folder, of, &job, cameras.len(), &args.save)?,
        Some(shard) => {
            let inputs = json!(Inputs { arguments, of, output: output.clone() });
            let whole = Whole { command: COMMAND.to_owned(), inputs, items: cameras.len() };
            Frames::of_shard(folder, shard, whole, &job, &args.save)?
        }
    };
    if args.ends_with_input {
        interrupt::listen_to_input();
    }
    let rendered = render(&shown, &cameras, &mut frames);
    if let Err(Stop::Interrupted) = rendered {
        // Nothing resumes the video of a viewer that has ended.
        if args.ends_with_input {
            frames.remove();
            return rendered;
        }
        frames.stopped(AGAIN)?;
    }
    rendered?;
    let again = if args.ends_with_input { None } else { Some(AGAIN) };
    let Some(shard) = shard else { return output.complete(frames, &job, &out, again) };
    let folder = frames.folder().to_owned();
    frames.keep();
    merge::merge_if_complete(&folder, shard)
}

/// The name of the command in marks and records.
pub const COMMAND: &str = "render";
/// How to resume after an interruption.
const AGAIN: &str = "run the same command";

/// All inputs of the frames of shards.
#[derive(Serialize, Deserialize)]
struct Inputs {
    arguments: Value,
    of: Value,
    output: Output,
}

/// Merges the frames of complete shards.
pub fn merge(complete: Complete) -> Work<()> {
    let Inputs { of, output, .. } = complete.inputs()?;
    let folder = complete.at().to_owned();
    let out = match output.kind {
        Kind::Video(_) => video_of(&folder)?,
        _ => folder.clone(),
    };
    let save = Vec::<Layer>::deserialize(&of["save"]).map_err(|e| Error::file(&folder, e))?;
    let (frames, job) = Frames::of_shards(complete, of, &save)?;
    let again = format!("run `raygrad merge {}`", quoted(&folder));
    output.complete(frames, &job, &out, Some(&again))
}

/// What is made of the frames.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Output {
    kind: Kind,
    frames: usize,
    size: [usize; 2],
    fps: f64,
    keep_frames: bool,
}

impl Output {
    /// Makes the video and removes its frames, or keeps them. `again` is how to resume after an interruption.
    fn complete(&self, frames: Frames, job: &Job, out: &Path, again: Option<&str>) -> Work<()> {
        let &Output { kind, frames: count, size, fps, keep_frames } = self;
        if let Kind::Video(video) = kind {
            let (folder, check) = (frames.folder(), &|| frames.check_lock());
            let written = video.write(&VideoWriter { folder, count, size, fps, job, check }, out);
            match (&written, again) {
                (Err(Stop::Interrupted), Some(again)) => frames.stopped(again)?,
                (Err(Stop::Interrupted), None) => {
                    frames.remove();
                    return written;
                }
                _ => {}
            }
            written?;
        }
        frames.drop_shards()?;
        match kind {
            Kind::Video(_) if !keep_frames => frames.remove(),
            _ => {
                frames.keep();
                let older = other_numbered(out, DIGITS, &(0..count).collect::<Vec<_>>());
                if !older.is_empty() {
                    // They may be files that users want to keep.
                    note(&format!("{} also holds {} numbered images of a longer path", out.display(), older.len()));
                }
            }
        }
        Ok(report(count, size, out)?)
    }
}

/// The default video extension: MP4, which plays everywhere, or else GIF, which needs no other program.
pub fn video_ending() -> &'static str {
    match VideoFormat::Mp4.check_encoder(Path::new("FILE.mp4")) {
        Ok(()) => "mp4",
        Err(_) => "gif",
    }
}

/// Default step of 16-bit depths.
const MILLI: f64 = 1e-3;

/// Renders the missing frames.
fn render(shown: &Shown<'_>, cameras: &[Camera], frames: &mut Frames) -> Work<()> {
    let (start, first, all) = (Instant::now(), frames.done(), frames.count());
    if first > 0 {
        note(&format!("resuming after {first} of {all} frames: {}", frames.folder().display()));
    }
    let progress = Progress::new();
    let mut beyond = 0;
    while let Some(number) = frames.next() {
        if interrupt::requested() {
            return Err(Stop::Interrupted);
        }
        let frame = shown.frame(&cameras[number]);
        frames.push(number, &frame.image.to_png(), &frame.layers)?;
        beyond += usize::from(frame.beyond > 0);
        let done = frames.done();
        progress.set(done as f64 / all as f64, || {
            format!(
                "frame {done} of {all}  {} left",
                spoken(time_left(start.elapsed().as_secs_f64(), [first, done, all]))
            )
        });
    }
    drop(progress);
    if beyond > 0 {
        let most = f64::from(u16::MAX) * shown.depth_unit;
        note(&format!(
            "{beyond} frames have depths above {most}, the 16-bit limit, saved as 0: use a larger --depth-unit or \
             --save depth-npy"
        ));
    }
    Ok(())
}

/// Estimated remaining seconds. `seconds` is the time since the `first` rendered frame.
fn time_left(seconds: f64, [first, done, all]: [usize; 3]) -> f64 {
    seconds * (all - done) as f64 / (done - first) as f64
}

fn report(count: usize, [width, height]: [usize; 2], out: &Path) -> Result<()> {
    let frames = if count == 1 { "frame" } else { "frames" };
    print(&format!("rendered {count} {frames} of {width}x{height}: {}\n", out.display()))
}

/// All inputs of the frames, including the checksums of model and configuration.
fn contents(args: &Args, [model, config]: [String; 2], cameras: &[Camera], shown: &Shown<'_>) -> Result<Value> {
    let flown = serde_json::to_vec(cameras).map_err(|e| Error::setting("path", e))?;
    Ok(json!({
        "raygrad": env!("CARGO_PKG_VERSION"),
        "model": model,
        "config": config,
        "cameras": crc32fast::hash(&flown),
        "frames": cameras.len(),
        "size": [cameras[0].width, cameras[0].height],
        "show": shown.show,
        "save": shown.save,
        "depth_unit": shown.depth_unit,
        "background": shown.background,
        "skip": args.skip.map(|skip| skip.to_string()),
        "precision": args.precision,
    }))
}

/// Kind of the output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
enum Kind {
    /// A folder of PNG files.
    Folder,
    Png,
    Video(VideoFormat),
}

impl Kind {
    /// The kind of a file extension.
    fn of(out: &Path) -> Result<Self> {
        if is_named_as_folder(out) {
            return Ok(Kind::Folder);
        }
        match out.extension().and_then(|ending| ending.to_str()).map(str::to_ascii_lowercase).as_deref() {
            Some("png") => Ok(Kind::Png),
            Some(ending) => match VideoFormat::of(ending) {
                Some(video) => Ok(Kind::Video(video)),
                None if out.is_dir() => Ok(Kind::Folder),
                None => {
                    let known = "use .png, .gif, .apng, .mp4 or .webm, or end a folder's name with `/`";
                    Err(Error::file(out, format!("`.{ending}` is not an image or video extension: {known}")))
                }
            },
            None => Ok(Kind::Folder),
        }
    }
}

/// Returns true if a path ends with a separator.
fn is_named_as_folder(out: &Path) -> bool {
    out.as_os_str().to_string_lossy().ends_with(std::path::is_separator)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kind_of_unknown_extension_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let dotted = folder.path().join("orbit.2");
        let of = |name: &str| Kind::of(&folder.path().join(name));
        for (name, kind) in [
            ("a.PNG", Kind::Png),
            ("a.b.gif", Kind::Video(VideoFormat::Gif)),
            ("orbit", Kind::Folder),
            ("orbit.2/", Kind::Folder),
            ("orbit.gif/", Kind::Folder),
            (".hidden", Kind::Folder),
        ] {
            assert_eq!(of(name).unwrap(), kind, "{name}");
        }
        for name in ["walk.mkv", "walk.mov", "picture.jpg", "a.json", "orbit.2"] {
            let message = of(name).unwrap_err().to_string();
            let known = "use .png, .gif, .apng, .mp4 or .webm, or end a folder's name with `/`";
            assert!(message.contains("is not an image or video extension: ") && message.ends_with(known), "{message}");
        }
        std::fs::create_dir(&dotted).unwrap();
        assert_eq!(of("orbit.2").unwrap(), Kind::Folder);
    }

    #[test]
    fn time_left_excludes_resumed_frames() {
        assert_eq!(time_left(6.0, [20, 22, 100]), 234.0);
        assert_eq!(time_left(6.0, [0, 3, 3]), 0.0);
    }
}
