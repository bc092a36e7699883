//! Videos of frames in a folder: GIF and APNG with Rust encoders, MP4 and WebM with ffmpeg.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use raygrad::nerf::{Error, Image, Result, rename_durable};
use raygrad::nn::TEMPORARY_PREFIX;
use serde::{Deserialize, Serialize};

use super::animation::Animation;
use super::frames::DIGITS;
use crate::interrupt::{self, Stop, Work};
use crate::output::{check_writable, note, numbered, parent};
use crate::overwrite::Job;
use crate::parse::LARGEST;
use crate::prepare::program::{FFMPEG, file_url};
use crate::progress::Progress;
use crate::scratch::ScratchFolder;

/// Largest frame rate of a GIF, with two hundredths of a second per frame. Players slow down faster ones.
const FASTEST_GIF: f64 = 50.0;

/// Label of the progress while a video is encoded.
const IN_FILM: &str = "frames encoded";

/// Video file formats.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VideoFormat {
    Gif,
    Apng,
    Mp4,
    Webm,
}

/// A video to write.
pub struct VideoWriter<'a> {
    /// Folder of the frames.
    pub folder: &'a Path,
    /// Number of frames.
    pub count: usize,
    /// Width and height of the frames.
    pub size: [usize; 2],
    /// Frames per second.
    pub fps: f64,
    /// The job, whose mark goes into the file's metadata.
    pub job: &'a Job,
    /// Checks, before the video replaces a file, that the frames are still the program's.
    pub check: &'a dyn Fn() -> Result<()>,
}

impl VideoFormat {
    /// The format of a file extension.
    pub fn of(ending: &str) -> Option<VideoFormat> {
        VideoFormat::from_str(ending, true).ok()
    }

    /// Checks that the video can be written, before frames are rendered.
    pub fn check(self, out: &Path, fps: f64, size: [usize; 2]) -> Result<()> {
        check_writable(parent(out))?;
        if self == VideoFormat::Gif && fps > FASTEST_GIF {
            let what = format!("is {fps}; a GIF shows at most {FASTEST_GIF} frames a second: use .apng or .mp4");
            return Err(Error::setting("fps", what));
        }
        if let Some(side) = size.into_iter().find(|side| *side > LARGEST) {
            return Err(Error::setting(
                "size",
                format!("has a side of {side} pixels; use at most {LARGEST} for a video"),
            ));
        }
        match self {
            VideoFormat::Gif | VideoFormat::Apng => Ok(()),
            VideoFormat::Mp4 | VideoFormat::Webm => self.check_encoder(out),
        }
    }

    /// Checks that ffmpeg is installed and has the encoder.
    pub fn check_encoder(self, out: &Path) -> Result<()> {
        let or = "or use .gif or .apng, which need no ffmpeg";
        let encoders = FFMPEG.ask(&["-hide_banner", "-encoders"]).map_err(|stop| match stop {
            Stop::Failed(error) => Error::file(out, format!("{error}; {or}")),
            Stop::Interrupted => Error::file(out, "was interrupted"),
        })?;
        let encoder = self.encoder();
        if encoders.split_whitespace().any(|word| word == encoder) {
            return Ok(());
        }
        Err(Error::file(out, format!("needs {encoder}, which this ffmpeg lacks: install an ffmpeg that has it, {or}")))
    }

    /// The encoder of ffmpeg.
    fn encoder(self) -> &'static str {
        if self == VideoFormat::Webm { "libvpx-vp9" } else { "libx264" }
    }

    /// Writes the video and replaces the file atomically.
    pub fn write(self, reel: &VideoWriter<'_>, out: &Path) -> Work<()> {
        let bad = |e: std::io::Error| Error::file(out, format!("cannot be written: {e}"));
        let place = ScratchFolder::new(parent(out), TEMPORARY_PREFIX).map_err(bad)?;
        let file = std::path::absolute(place.path()).map_err(bad)?.join("video");
        let size = reel.size.map(|side| side as u16);
        match self {
            VideoFormat::Gif => animate(reel, out, &file, |to| Animation::gif(to, size, reel.fps, reel.job.mark()))?,
            VideoFormat::Apng => {
                let count = reel.count as u32;
                animate(reel, out, &file, |to| Animation::apng(to, size, reel.fps, count, reel.job.mark()))?;
            }
            VideoFormat::Mp4 | VideoFormat::Webm => self.encode(reel, out, &file)?,
        }
        reel.job.check(out)?;
        (reel.check)()?;
        Ok(rename_durable(&file, out)?)
    }

    /// Encodes with ffmpeg.
    fn encode(self, reel: &VideoWriter<'_>, out: &Path, file: &Path) -> Work<()> {
        let &VideoWriter { folder, count, size, fps, job, .. } = reel;
        let even = size.map(|side| side.next_multiple_of(2));
        if even != size {
            let [width, height] = even;
            note(&format!("{}: padded with black to {width}x{height}, because videos need even sides", out.display()));
        }
        let mut command = FFMPEG.command();
        // ffmpeg runs in the folder, since it would read a `%` in the folder's name as a pattern.
        command.current_dir(folder);
        command.args(["-hide_banner", "-nostdin", "-loglevel", "error", "-nostats", "-progress", "pipe:1", "-y"]);
        command.args(["-framerate", &fps.to_string(), "-start_number", "0", "-i", &format!("%0{DIGITS}d.png")]);
        command.args(["-frames:v", &count.to_string()]);
        // Players guess the colour matrix from the size if it is not stated.
        let filter = "pad=ceil(iw/2)*2:ceil(ih/2)*2,\
                      scale=out_color_matrix=bt709:out_range=tv:flags=accurate_rnd+full_chroma_int";
        command.args(["-vf", filter, "-pix_fmt", "yuv420p", "-colorspace", "bt709", "-color_primaries", "bt709"]);
        command.args(["-color_trc", "iec61966-2-1", "-color_range", "tv"]);
        command.args(["-c:v", self.encoder(), "-metadata", &format!("comment={}", job.mark())]);
        command.args(match self {
            // Without random identifiers, the same frames give the same file.
            VideoFormat::Webm => &["-crf", "24", "-b:v", "0", "-fflags", "+bitexact", "-f", "webm"][..],
            _ => &["-crf", "18", "-preset", "slow", "-movflags", "+faststart", "-f", "mp4"],
        });
        command.arg(file_url(file)?);
        let progress = Progress::new();
        FFMPEG.run(&mut command, None, |line| {
            if let Some(done) = line.strip_prefix("frame=").and_then(|n| n.trim().parse().ok()) {
                progress.count(done, count, IN_FILM);
            }
        })
    }
}

/// Encodes with a Rust encoder.
fn animate(
    reel: &VideoWriter<'_>,
    out: &Path,
    file: &Path,
    begin: impl FnOnce(BufWriter<File>) -> std::result::Result<Animation<BufWriter<File>>, String>,
) -> Work<()> {
    let bad = |what: String| Error::file(out, format!("cannot be written: {what}"));
    let to = File::create(file).map_err(|e| bad(e.to_string()))?;
    let mut animation = begin(BufWriter::new(to)).map_err(bad)?;
    let progress = Progress::new();
    for frame in 0..reel.count {
        if interrupt::requested() {
            return Err(Stop::Interrupted);
        }
        let picture = reel.folder.join(numbered(frame, DIGITS));
        let again =
            |e: Error| Error::file(&picture, format!("cannot be read ({e}): remove it, and repeat the command"));
        animation.push(&Image::open(&picture).map_err(again)?).map_err(bad)?;
        progress.count(frame + 1, reel.count, IN_FILM);
    }
    Ok(animation.finish().map_err(bad)?)
}

/// The folder of a video's frames, beside the video.
pub fn frames_of(video: &Path) -> PathBuf {
    let mut name = video.as_os_str().to_owned();
    name.push(FRAMES);
    name.into()
}

/// The end of the name of [`frames_of`].
const FRAMES: &str = ".frames";

/// The video of a folder of frames: the inverse of [`frames_of`].
pub fn video_of(frames: &Path) -> Result<PathBuf> {
    if frames.extension().is_some_and(|ending| *ending == FRAMES[1..]) {
        return Ok(frames.with_extension(""));
    }
    Err(Error::file(frames, format!("was renamed: name it as its video, with {FRAMES} at the end")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::Value;

    #[test]
    fn write_keeps_a_file_of_another_job() {
        let place = tempfile::tempdir().unwrap();
        let (folder, out) = (place.path(), place.path().join("walk.gif"));
        Image::new(4, 3, 3).save_png(folder.join(numbered(0, DIGITS))).unwrap();
        let written = |video: VideoFormat, overwrites: bool, check: &dyn Fn() -> Result<()>| {
            let job = Job::new("render", &Value::Null, overwrites);
            video.write(&VideoWriter { folder, count: 1, size: [4, 3], fps: 10.0, job: &job, check }, &out)
        };
        let write = |video: VideoFormat, overwrites: bool| written(video, overwrites, &|| Ok(()));
        for video in [VideoFormat::Gif, VideoFormat::Apng] {
            std::fs::write(&out, b"footage").unwrap();
            let Err(Stop::Failed(error)) = write(video, false) else { panic!("{video:?} is written") };
            assert!(
                error.to_string().contains("walk.gif: exists, and another command or other options made it"),
                "{error}"
            );
            assert_eq!(std::fs::read(&out).unwrap(), b"footage");
            // Another program has taken the frames meanwhile.
            assert!(written(video, true, &|| Err(Error::file(folder, "is lost"))).is_err());
            assert_eq!(std::fs::read(&out).unwrap(), b"footage");
            write(video, true).unwrap();
            // The job's own file is replaced.
            write(video, false).unwrap();
        }
        assert_eq!(std::fs::read_dir(folder).unwrap().count(), 2, "nothing is left beside it");
    }
}
