//! Extraction of sharp frames.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use raygrad::nerf::Error;
use raygrad::nerf::dataset::Photo;

use super::photographs::{decoding_memory, ends};
use super::program::{FFMPEG, file_url};
use super::tone::{self, TO_JPEG};
use super::workplace::Workplace;
use crate::interrupt::Work;
use crate::output::{complain, entries};
use crate::progress::Progress;

/// Candidate frames per selected frame.
const CANDIDATES: usize = 3;
/// Temporary folder of the candidates.
const FOLDER: &str = "candidates";

/// File extensions of videos.
const ENDINGS: [&str; 8] = ["mp4", "mov", "m4v", "mkv", "webm", "avi", "3gp", "mts"];
/// Matrices from RGB to YUV: their tags in ffmpeg's output, and their names in its filter `scale`.
const MATRICES: [(&str, &str); 7] = [
    ("bt709", "bt709"),
    ("smpte170m", "bt601"),
    ("bt470bg", "bt601"),
    ("fcc", "fcc"),
    ("smpte240m", "smpte240m"),
    ("bt2020nc", "bt2020"),
    ("bt2020c", "bt2020"),
];
/// Transfer curves of HDR: their tags in ffmpeg's output, and their usual names.
const HDR: [(&str, &str); 2] = [("arib-std-b67", "HLG"), ("smpte2084", "PQ")];

/// Properties of a video from ffmpeg.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Video {
    /// Length in seconds.
    seconds: f64,
    /// Frames per second.
    rate: f64,
    /// Matrix from RGB to YUV, as the filter `scale` names it.
    matrix: &'static str,
    /// Entry of [`HDR`].
    hdr: Option<(&'static str, &'static str)>,
}

/// Returns true if a file has the name of a video.
pub fn is_video(file: &Path) -> bool {
    ends(file, &ENDINGS)
}

/// Writes about `count` sharp frames of a video to `images`. Of each three consecutive candidates, the sharpest is
/// kept. Returns how many there are and how many seconds each stands for.
pub fn frames(video: &Path, count: usize, place: &Workplace) -> Work<(usize, f64)> {
    let input = file_url(video)?;
    let mut question: Vec<&OsStr> =
        ["-hide_banner", "-nostdin", "-protocol_whitelist", "file", "-i"].map(OsStr::new).to_vec();
    question.push(&input);
    let said = FFMPEG.ask(&question)?;
    let Some(about) = Video::parse(&said) else {
        let last = said.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or("nothing").trim();
        return Err(Error::file(video, format!("ffmpeg cannot read it as a video: {last}")).into());
    };
    let rate = (CANDIDATES as f64 * count as f64 / about.seconds).min(about.rate);
    let wanted = (rate * about.seconds).max(1.0);
    let folder = place.make(FOLDER)?;
    let progress = Progress::new();
    let mut command = FFMPEG.command();
    // ffmpeg runs in the folder, since it would read a `%` in the folder's name as a pattern.
    command.current_dir(&folder);
    command.args(["-hide_banner", "-nostdin", "-loglevel", "error", "-nostats", "-progress", "pipe:1"]);
    command.args(["-protocol_whitelist", "file", "-i"]).arg(&input);
    command.arg("-map").arg("0:v:0").arg("-vf").arg(format!("fps={rate:.6},{}", about.colors()?));
    // A file may be longer than it says.
    command.args(["-frames:v", &(CANDIDATES * count + 1).to_string()]);
    // The best JPEG quality. ffmpeg uses 1 only if the minimum is 1 too.
    command.args(["-qmin", "1", "-q:v", "1", "%06d.jpg"]);
    FFMPEG.run(&mut command, None, |line| {
        let Some(frame) = line.strip_prefix("frame=").and_then(|n| n.trim().parse::<f64>().ok()) else { return };
        progress.set(frame / wanted, || format!("{frame} of about {wanted:.0} frames extracted"));
    })?;
    let candidates = entries(&folder)?;
    if candidates.is_empty() {
        return Err(Error::file(video, "ffmpeg extracted no frames: check that the video plays").into());
    }
    let kept = keep_sharp(&candidates, count, &place.make("images")?, &progress)?;
    place.remove(FOLDER);
    Ok((kept, about.seconds / kept as f64))
}

impl Video {
    /// Parses the lines `Duration: 00:01:23.45, ..` and `Stream #0:0: Video: .., 29.97 fps, ..`.
    fn parse(said: &str) -> Option<Video> {
        let stream = said.lines().find(|line| line.contains(" Video: "))?;
        let rate = stream.split(',').find_map(|part| {
            let part = part.trim();
            part.strip_suffix(" fps").or_else(|| part.strip_suffix(" tbr"))?.trim().parse::<f64>().ok()
        });
        let duration = said.lines().find_map(|line| line.trim().strip_prefix("Duration: "))?.split(',').next()?;
        let mut parts = duration.trim().split(':').map(|part| part.parse::<f64>().ok());
        let (hours, minutes, seconds) = (parts.next()??, parts.next()??, parts.next()??);
        let seconds = 3600.0 * hours + 60.0 * minutes + seconds;
        let (matrix, hdr) = colors_of(stream);
        let video = Video { seconds, rate: rate.unwrap_or(30.0), matrix, hdr };
        let good = |x: f64| x > 0.0 && x.is_finite();
        (good(video.seconds) && good(video.rate)).then_some(video)
    }

    /// The filters that bring its colours to JPEG files. HDR is mapped to sRGB, which needs filters that not every
    /// ffmpeg has.
    fn colors(&self) -> Work<String> {
        let Video { matrix, hdr, .. } = *self;
        let plain = format!("{TO_JPEG}:in_color_matrix={matrix}");
        let Some((transfer, name)) = hdr else { return Ok(plain) };
        if !tone::can_map()? {
            let what = "this ffmpeg lacks the filter zscale, so colours will be flat; record without HDR, or install an \
                        ffmpeg with zimg";
            complain(&format!("warning: the video is HDR ({name}): {what}"));
            return Ok(plain);
        }
        Ok(tone::map(&format!("tin={transfer}:min=bt2020nc:pin=bt2020")))
    }
}

/// The matrix and the entry of [`HDR`] from a stream's tags, such as `yuv420p10le(tv, bt2020nc/bt2020/arib-std-b67)` or
/// `yuv420p(tv, bt709)`. Without a tag, HDR is BT.2020, HD is BT.709, and other videos are BT.601.
fn colors_of(stream: &str) -> (&'static str, Option<(&'static str, &'static str)>) {
    let mut items = stream.split(['(', ')', ',']).map(str::trim);
    let hdr = HDR.into_iter().find(|(tag, _)| items.clone().any(|item| item.rsplit('/').next() == Some(*tag)));
    let tag = |item: &str| MATRICES.iter().find(|(tag, _)| item.split('/').next() == Some(*tag)).map(|(_, name)| *name);
    let size = |item: &str| -> Option<[usize; 2]> {
        let (width, height) = item.split_whitespace().next()?.split_once('x')?;
        Some([width.parse().ok()?, height.parse().ok()?])
    };
    let is_hd = items.clone().find_map(size).is_some_and(|[w, h]| w.max(h) >= 1280 || w.min(h) > 576);
    let matrix = items.find_map(tag).unwrap_or(match (hdr, is_hd) {
        (Some(_), _) => "bt2020",
        (None, true) => "bt709",
        (None, false) => "bt601",
    });
    (matrix, hdr)
}

/// Moves the sharpest frame of each group of candidates to a folder and returns their number.
fn keep_sharp(candidates: &[PathBuf], count: usize, to: &Path, progress: &Progress) -> Work<usize> {
    // A short video has fewer candidates, so that groups are smaller.
    let group = ((candidates.len() as f64 / count as f64).round() as usize).clamp(1, CANDIDATES);
    let costs = if group == 1 { vec![0; candidates.len()] } else { decoding_memory(candidates) };
    let sharpness = progress.each(&costs, "frames rated for sharpness", |i| {
        Ok(if group == 1 { 0.0 } else { Photo::open(&candidates[i], None)?.sharpness() })
    })?;
    let mut kept = 0;
    for (files, sharpness) in candidates.chunks(group).zip(sharpness.chunks(group)) {
        let best = sharpness.iter().zip(files).max_by(|a, b| a.0.total_cmp(b.0));
        let Some((_, file)) = best else { continue };
        kept += 1;
        let name = to.join(format!("frame_{kept:05}.jpg"));
        std::fs::rename(file, &name).map_err(|e| Error::file(&name, format!("cannot be written: {e}")))?;
    }
    Ok(kept)
}

#[cfg(test)]
mod tests {
    use super::{HDR, Video, colors_of};

    #[test]
    fn parse_ffmpeg_output_gives_length_and_rate() {
        let said = "Input #0, mov,mp4, from 'walk.mp4':\n  Metadata:\n    creation_time   : 2024-05-01\n  \
                    Duration: 00:01:02.50, start: 0.000000, bitrate: 9 kb/s\n  Stream #0:1[0x2](und): Audio: aac, 2 fps\n  \
                    Stream #0:0[0x1](und): Video: h264 (avc1 / 0x31637661), yuv420p(tv, bt709), 1920x1080, 9 kb/s, \
                    29.97 fps, 29.97 tbr, 90k tbn (default)\nAt least one output file must be specified\n";
        let video = Video { seconds: 62.5, rate: 29.97, matrix: "bt709", hdr: None };
        assert_eq!(Video::parse(said), Some(video));
        let no_rate = said.replace("29.97 fps, 29.97 tbr, ", "");
        assert_eq!(Video::parse(&no_rate), Some(Video { rate: 30.0, ..video }));
        for (from, to) in [("Video:", "Data:"), ("00:01:02.50", "N/A"), ("00:01:02.50", "00:00:00.00")] {
            assert_eq!(Video::parse(&said.replace(from, to)), None, "{to}");
        }
    }

    #[test]
    fn colors_come_from_tags_or_the_size() {
        let [hlg, pq] = HDR.map(Some);
        for (stream, expected) in [
            ("h264 (High) (avc1 / 0x31637661), yuv420p(tv, bt709, progressive), 1280x720 [SAR 1:1]", ("bt709", None)),
            ("h264, yuv420p(tv, smpte170m/unknown/unknown, progressive), 1920x1080, 7 kb/s", ("bt601", None)),
            ("h264, yuvj420p(pc, bt470bg/unknown/unknown), 3840x2160", ("bt601", None)),
            ("hevc, yuv420p10le(tv, bt2020nc/bt2020/arib-std-b67, progressive), 640x360", ("bt2020", hlg)),
            ("hevc, yuv420p10le(tv, bt2020nc/bt2020/smpte2084), 3840x2160", ("bt2020", pq)),
            ("hevc, yuv420p10le(tv, unknown/unknown/smpte2084), 640x360", ("bt2020", pq)),
            // The matrix comes first, and the transfer curve last.
            ("h264, yuv420p(tv, smpte170m/smpte432/bt709), 640x480", ("bt601", None)),
            ("h264, yuv420p, 1280x720", ("bt709", None)),
            ("h264, yuv420p(tv), 720x1280", ("bt709", None)),
            ("h264, yuv420p(progressive), 1024x576", ("bt601", None)),
            ("h264, yuv420p", ("bt601", None)),
        ] {
            assert_eq!(colors_of(stream), expected, "{stream}");
        }
    }
}
