//! `raygrad prepare` on videos and images, with scripts instead of ffmpeg and COLMAP.

use super::render::has_ffmpeg;
use super::{CLASSIC, Place, complained, complained_of, wait};
use raygrad::nerf::Image;
use raygrad::nerf::dataset::Photo;
use raygrad_test_support::skip::skipped;
use std::os::unix::fs::PermissionsExt;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Replaces ffmpeg: logs its arguments and writes 30 frames of `LENGTH` seconds, of which the second of every three is
/// sharp.
const FFMPEG: &str = r#"#!/bin/sh
echo "ffmpeg $*" >> "$LOG"
case "$*" in
  *"-i"*"%06d.jpg") ;;
  *-i*) echo "  Duration: 00:00:${LENGTH:-10}.00, start: 0.000000, bitrate: 1 kb/s" >&2
     echo "  Stream #0:0: Video: h264, yuv420p, 16x8, 30 fps, 30 tbr" >&2
     echo "At least one output file must be specified" >&2; exit 1 ;;
  *) exit 0 ;;
esac
for out; do :; done
folder=$(dirname "$out")
from=$(dirname "$LOG")
i=1
while [ $i -le 30 ]; do
  if [ $((i % 3)) -eq 2 ]; then image=sharp.jpg; else image=soft.jpg; fi
  cp "$from/$image" "$folder/$(printf %06d $i).jpg"
  echo "frame=$i"
  i=$((i + 1))
done
echo progress=end
"#;

/// Replaces colmap: registers all images but the last two, in the second of two models.
const COLMAP: &str = r#"#!/bin/sh
echo "colmap $*" >> "$LOG"
case "$*" in "-h"|*" -h") echo "  --$GPU.use_gpu arg (=1)"; exit 0 ;; esac
previous=
for argument; do
  case "$previous" in
    --image_list_path|--match_list_path) while read -r line; do echo "list $line" >> "$LOG"; done < "$argument" ;;
  esac
  previous=$argument
done
if [ "$1" = "$FAILS" ]; then echo "Processed file [1/3]"; echo "elapsed"; echo "out of luck" >&2; exit 3; fi
if [ "$1" = "$SLEEPS" ]; then echo "begun $$" >> "$LOG"; exec sleep 60; fi
if [ "$1" = feature_extractor ]; then : > "$3"; echo "Processed file [1/10]"; fi
[ "$1" = mapper ] || exit 0
while [ $# -gt 0 ]; do
  [ "$1" = --image_path ] && images=$2
  [ "$1" = --output_path ] && models=$2
  shift
done
if [ "$MODELS" = none ]; then echo "ERROR: failed to create sparse model" >&2; exit 1; fi
for model in 0 1; do
  mkdir -p "$models/$model"
  echo "1 OPENCV 16 8 20 20 8 4 0.01 0 0 0" > "$models/$model/cameras.txt"
  : > "$models/$model/points3D.txt"
done
id=1
count=$(ls "$images" | wc -l)
for name in $(ls "$images"); do
  [ $id -gt $((count - 2)) ] && break
  echo "Registering image #$id ($id)"
  [ $id -le 2 ] && printf '%s 1 0 0 0 0 0 %s 1 %s\n\n' $id $id "$name" >> "$models/0/images.txt"
  printf '%s 1 0 0 0 %s 0 3 1 %s\n\n' $id $id "$name" >> "$models/1/images.txt"
  id=$((id + 1))
done
"#;

/// A folder with both scripts in `bin`, a video, and images in `photos`.
pub fn place() -> Place {
    let place = Place::empty();
    std::fs::create_dir(place.path("bin")).unwrap();
    for (name, script) in [("ffmpeg", FFMPEG), ("colmap", COLMAP)] {
        let path = place.path(&format!("bin/{name}"));
        std::fs::write(&path, script).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
    }
    // Only the tools that the scripts need: a system may have the real programs.
    for tool in ["cp", "dirname", "ls", "mkdir", "sleep", "wc"] {
        let there = ["/bin", "/usr/bin"].map(|folder| std::path::Path::new(folder).join(tool));
        let there = there.iter().find(|path| path.exists()).unwrap();
        std::os::unix::fs::symlink(there, place.path(&format!("bin/{tool}"))).unwrap();
    }
    std::fs::write(place.path("walk.mp4"), "a video").unwrap();
    std::fs::create_dir(place.path("photos")).unwrap();
    for (name, period) in [("sharp.jpg", 2), ("soft.jpg", 16)] {
        std::fs::write(place.path(name), jpeg(period, 1)).unwrap();
    }
    for i in 0..5 {
        std::fs::write(place.path(&format!("photos/{i}.JPG")), jpeg(4, 1)).unwrap();
    }
    place
}

#[test]
fn prepare_takes_the_folder_with_most_images_and_names_unread_poses() {
    let place = place();
    std::fs::create_dir(place.path("scene")).unwrap();
    std::fs::rename(place.path("photos"), place.path("scene/input")).unwrap();
    std::fs::write(place.path("scene/cover.jpg"), jpeg(4, 1)).unwrap();
    std::fs::write(place.path("scene/transforms.json"), "{\"frames\": [],}").unwrap();
    let output = command(&place, "prepare scene --out made").output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    for part in [
        "note: scene: its camera poses are not used: ",
        "transforms.json: ",
        "note: used the 5 images of scene/input, not the 1 of scene",
    ] {
        assert!(said.contains(part), "{part} in {said}");
    }
    assert!(place.path("made/images/4.JPG").exists() && !place.path("made/images/cover.jpg").exists());
    // Of equally many, the folder itself counts; without images, poses that cannot be read are the error.
    std::fs::create_dir_all(place.path("lost/images")).unwrap();
    std::fs::write(place.path("lost/transforms.json"), "{").unwrap();
    place.fails("prepare lost --out other", &["transforms.json: "]);
}

#[test]
fn images_below_a_folder_are_found_if_one_holds_them() {
    let place = place();
    std::fs::create_dir_all(place.path("card/DCIM/.thumbs")).unwrap();
    std::fs::rename(place.path("photos"), place.path("card/DCIM/100APPLE")).unwrap();
    std::fs::write(place.path("card/DCIM/.thumbs/0.jpg"), jpeg(4, 1)).unwrap();
    let output = run(&place, "prepare card --out made");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("note: card: holds no images itself: used the 5 of card/DCIM/100APPLE"), "{said}");
    assert!(place.path("made/images/4.JPG").exists());
    // Of several folders, the user chooses one.
    std::fs::create_dir(place.path("card/DCIM/101APPLE")).unwrap();
    std::fs::write(place.path("card/DCIM/101APPLE/5.jpg"), jpeg(4, 1)).unwrap();
    complained_of(
        "two folders",
        &run(&place, "prepare card --out other"),
        "card: holds no images itself, but others do, card/DCIM/100APPLE (5), card/DCIM/101APPLE (1): name one of them",
    );
    std::fs::create_dir(place.path("films")).unwrap();
    std::fs::rename(place.path("walk.mp4"), place.path("films/walk.mp4")).unwrap();
    complained_of(
        "a video",
        &run(&place, "prepare films --out other"),
        "films: holds no images, but a video: name that, as `raygrad prepare films/walk.mp4`",
    );
    std::fs::create_dir(place.path("films/previews")).unwrap();
    std::fs::create_dir(place.path("films/covers")).unwrap();
    for name in ["previews", "covers"] {
        std::fs::write(place.path(&format!("films/{name}/0.jpg")), jpeg(4, 1)).unwrap();
    }
    complained_of(
        "a video and an image",
        &run(&place, "prepare films --out other"),
        "films: holds no images itself, but others do, films/covers (1), films/walk.mp4: name one of them",
    );
    std::fs::create_dir_all(place.path("raw/a")).unwrap();
    std::fs::write(place.path("raw/a/0.CR2"), "").unwrap();
    complained_of(
        "raw images",
        &run(&place, "prepare raw --out other"),
        "raw/a: 1 images are raw or GIF, which raygrad cannot read: convert them to JPEG, PNG or TIFF",
    );
    // Training prepares them too.
    std::fs::remove_dir_all(place.path("card/DCIM/101APPLE")).unwrap();
    let output = run(&place, &format!("train card --scene-type bounded --steps 1 {CLASSIC}"));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(place.path("card-prepared/images/4.JPG").exists());
}

/// A JPEG of 16 x 8 pixels with stripes and an EXIF orientation.
fn jpeg(period: usize, orientation: u8) -> Vec<u8> {
    let mut exif = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".to_vec();
    exif.extend([orientation, 0, 0, 0, 0, 0, 0]);
    jpeg_with(period, &exif)
}

/// The same with a focal length in millimetres of a 35 mm camera.
fn jpeg_of_lens(focal: u8) -> Vec<u8> {
    let mut exif = b"MM\0*\0\0\0\x08\0\x01\x87\x69\0\x04\0\0\0\x01\0\0\0\x1a\0\0\0\0".to_vec();
    exif.extend(b"\0\x01\xa4\x05\0\x03\0\0\0\x01\0");
    exif.extend([focal, 0, 0, 0, 0, 0, 0]);
    jpeg_with(4, &exif)
}

/// A JPEG of 16 x 8 pixels with stripes and EXIF data.
fn jpeg_with(period: usize, exif: &[u8]) -> Vec<u8> {
    let file = tempfile::Builder::new().suffix(".jpg").tempfile().unwrap();
    let stripe = |x: usize| if x % period < period / 2 { 1.0 } else { 0.0 };
    let data = (0..16 * 8).flat_map(|i| [stripe(i % 16); 3]).collect();
    Photo::from(Image { width: 16, height: 8, channels: 3, data }).save(file.path()).unwrap();
    let plain = std::fs::read(file.path()).unwrap();
    let size = (8 + exif.len() as u16).to_be_bytes();
    [&plain[..2], b"\xff\xe1", &size, b"Exif\0\0", exif, &plain[2..]].concat()
}

fn command(place: &Place, arguments: &str) -> Command {
    let mut command = place.command(arguments);
    command.env("PATH", place.path("bin")).env("LOG", place.path("log")).env("GPU", "SiftExtraction");
    command.env("FAILS", "").env("SLEEPS", "").env("MODELS", "");
    command
}

fn run(place: &Place, arguments: &str) -> Output {
    command(place, arguments).output().unwrap()
}

/// Blocks of these colours from left to right, as raw RGB.
const BLOCKS: [[u8; 3]; 8] =
    [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255], [0, 0, 0], [32, 176, 64], [200, 90, 30], [128, 128, 128]];

/// Encodes a second of [`BLOCKS`] without loss to a video or image, through ffmpeg filters, with tags of the stream.
fn record(place: &Place, name: &str, [width, height]: [usize; 2], filters: &str, tags: &str) {
    let pixel = |i: usize| BLOCKS[i % width * BLOCKS.len() / width];
    let frame: Vec<u8> = (0..width * height).flat_map(pixel).collect();
    std::fs::write(place.path("raw"), frame.repeat(3)).unwrap();
    let size = format!("{width}x{height}");
    let mut ffmpeg = Command::new("ffmpeg");
    ffmpeg.args(["-v", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-r", "3", "-s", &size, "-i"]);
    ffmpeg.arg(place.path("raw")).args(["-vf", filters]);
    match name.ends_with(".mkv") {
        true => ffmpeg.args(["-c:v", "ffv1"]),
        false => ffmpeg.args(["-frames:v", "1", "-update", "1"]),
    };
    let output = ffmpeg.args(tags.split_whitespace()).arg(place.path(name)).output().unwrap();
    assert!(output.status.success(), "{name}: {output:?}");
}

/// The largest error of a block's middle in the frames that `prepare` takes from a video, of 255.
fn color_error(place: &Place, name: &str, blocks: &[usize]) -> f32 {
    let output = command(place, &format!("prepare {name} --out made --frames 3")).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let error = color_error_of(&place.path("made/images/frame_00001.jpg"), blocks);
    std::fs::remove_dir_all(place.path("made")).unwrap();
    error
}

/// The same of an image.
fn color_error_of(image: &std::path::Path, blocks: &[usize]) -> f32 {
    let frame = Photo::open(image, None).unwrap();
    let error = |block: usize| {
        let seen = frame.pixel((2 * block + 1) * frame.width / (2 * BLOCKS.len()), frame.height / 2);
        let apart = BLOCKS[block].iter().zip(seen).map(|(own, seen)| (255.0 * seen - f32::from(*own)).abs());
        apart.fold(0.0, f32::max)
    };
    blocks.iter().map(|block| error(*block)).fold(0.0, f32::max)
}

/// A place whose ffmpeg is the real one.
fn place_with_ffmpeg() -> Place {
    let (place, folders) = (place(), std::env::var_os("PATH").unwrap());
    let real = std::env::split_paths(&folders).map(|folder| folder.join("ffmpeg")).find(|path| path.exists());
    std::fs::remove_file(place.path("bin/ffmpeg")).unwrap();
    std::os::unix::fs::symlink(real.unwrap(), place.path("bin/ffmpeg")).unwrap();
    place
}

#[test]
fn frames_keep_the_colours_of_a_video() {
    if !has_ffmpeg() {
        return;
    }
    let place = place_with_ffmpeg();
    let all: Vec<usize> = (0..BLOCKS.len()).collect();
    let yuv = |matrix: &str, range: &str| format!("scale=out_color_matrix={matrix}:out_range={range},format=yuv444p");
    for (name, size, filters, tags) in [
        ("709.mkv", [1280, 720], yuv("bt709", "tv"), "-colorspace bt709 -color_primaries bt709 -color_trc bt709"),
        ("small-709.mkv", [320, 240], yuv("bt709", "tv"), "-colorspace bt709"),
        ("full-709.mkv", [320, 240], yuv("bt709", "full"), "-colorspace bt709 -color_range pc"),
        ("untagged.mkv", [1280, 720], yuv("bt709", "tv"), "-colorspace unknown"),
        ("601.mkv", [1280, 720], yuv("bt601", "tv"), "-colorspace smpte170m"),
        ("small.mkv", [320, 240], yuv("bt601", "tv"), "-colorspace unknown"),
        ("2020.mkv", [320, 240], yuv("bt2020", "tv"), "-colorspace bt2020nc"),
    ] {
        record(&place, name, size, &filters, tags);
        let error = color_error(&place, name, &all);
        assert!(error <= 3.0, "{name}: {error}");
    }
}

#[test]
fn hdr_frames_become_srgb() {
    if !has_ffmpeg() {
        return;
    }
    let filters = Command::new("ffmpeg").args(["-hide_banner", "-filters"]).output().unwrap().stdout;
    if !String::from_utf8_lossy(&filters).contains(" zscale ") {
        return skipped("ffmpeg has no filter zscale");
    }
    let place = place_with_ffmpeg();
    for transfer in ["arib-std-b67", "smpte2084"] {
        let filters = format!(
            "zscale=tin=iec61966-2-1:pin=bt709:min=gbr:rin=full:npl=203:t={transfer}:p=bt2020:m=bt2020nc:r=tv,\
             format=yuv444p10le"
        );
        let tags = format!("-colorspace bt2020nc -color_primaries bt2020 -color_trc {transfer}");
        record(&place, "hdr.mkv", [320, 240], &filters, &tags);
        // Colours that tone mapping keeps: black and the mixed ones.
        let error = color_error(&place, "hdr.mkv", &[4, 5, 7]);
        assert!(error <= 5.0, "{transfer}: {error}");
        std::fs::remove_file(place.path("hdr.mkv")).unwrap();
    }
}

/// A PNG file with the chunk `cICP`.
fn with_codes(png: &[u8], primaries: u8, transfer: u8) -> Vec<u8> {
    let data = [b"cICP", &[primaries, transfer, 0, 1][..]].concat();
    let chunk = [&[0, 0, 0, 4], &data[..], &crc32fast::hash(&data).to_be_bytes()].concat();
    // The signature and the chunk `IHDR`.
    [&png[..33], &chunk, &png[33..]].concat()
}

#[test]
fn images_of_high_range_become_srgb() {
    if !has_ffmpeg() {
        return;
    }
    let place = place_with_ffmpeg();
    let lacks = Command::new("ffmpeg").args(["-hide_banner", "-filters"]).output().unwrap().stdout;
    if !String::from_utf8_lossy(&lacks).contains(" zscale ") {
        return skipped("ffmpeg has no filter zscale");
    }
    let input = "zscale=tin=iec61966-2-1:pin=bt709:min=gbr:rin=full:npl=203";
    let filters = format!("{input}:t=linear:p=bt709:m=gbr:r=full,format=gbrpf32le");
    record(&place, "linear.exr", [160, 80], &filters, "");
    // Content counts. Beside other images, files of this format are often depths.
    std::fs::copy(place.path("linear.exr"), place.path("photos/linear.png")).unwrap();
    std::fs::rename(place.path("linear.exr"), place.path("photos/depth.exr")).unwrap();
    for (name, transfer, code) in [("pq", "smpte2084", 16), ("hlg", "arib-std-b67", 18)] {
        for (primaries, number) in [("bt2020", 9), ("smpte432", 12)] {
            let path = format!("photos/{name}-{primaries}.png");
            let filters = format!("{input}:t={transfer}:p={primaries}:m=gbr:r=full,format=rgb48be");
            record(&place, &path, [160, 80], &filters, "");
            let png = std::fs::read(place.path(&path)).unwrap();
            std::fs::write(place.path(&path), with_codes(&png, number, code)).unwrap();
        }
    }
    // Another image has the name of the copy.
    std::fs::write(place.path("photos/PQ-bt2020.jpg"), jpeg(4, 1)).unwrap();
    let output = run(&place, "prepare photos --out made");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    let expected = "note: 5 images of high dynamic range become sRGB: values up to 0.7 of white stay, those up to 5 \
                    times white are compressed\n";
    assert!(said.contains(expected), "{said}");
    let expected = "note: photos: 1 TIFF, BMP and EXR files are not used: other images are as many or more\n";
    assert!(said.contains(expected), "{said}");
    for name in ["linear", "pq-bt2020.png", "pq-smpte432", "hlg-bt2020", "hlg-smpte432"] {
        // Colours that tone mapping keeps up to a hundredth: black and the mixed ones.
        let error = color_error_of(&place.path(&format!("made/images/{name}.jpg")), &[4, 5, 7]);
        assert!(error <= 7.0, "{name}: {error}");
    }
    assert!(!place.path("made/images/depth.jpg").exists() && !place.path("made/images/linear.png").exists());
    assert_eq!(place.bytes("made/images/PQ-bt2020.jpg"), jpeg(4, 1));
    // Without the filter, and without ffmpeg.
    std::fs::remove_file(place.path("photos/depth.exr")).unwrap();
    std::fs::remove_file(place.path("bin/ffmpeg")).unwrap();
    let expected =
        ["photos/hlg-bt2020.png: is EXR or HDR PNG, which ffmpeg reads: install it with `apt install ffmpeg`"];
    complained("no ffmpeg", &run(&place, "prepare photos --out other"), &expected);
    std::fs::write(place.path("bin/ffmpeg"), CONVERTER).unwrap();
    std::fs::set_permissions(place.path("bin/ffmpeg"), std::fs::Permissions::from_mode(0o755)).unwrap();
    let expected = ["is EXR or HDR PNG, which this ffmpeg cannot map to sRGB: install one with the filter zscale"];
    complained("no filter", &run(&place, "prepare photos --out other"), &expected);
}

/// The script in place of ffmpeg has no filters.
#[test]
fn hdr_without_tone_mapping_gives_a_warning() {
    let place = place();
    let hdr = FFMPEG.replace("yuv420p", "yuv420p10le(tv, bt2020nc/bt2020/arib-std-b67)");
    std::fs::write(place.path("bin/ffmpeg"), hdr).unwrap();
    let output = run(&place, "prepare walk.mp4 --out made --frames 10");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.contains("warning: the video is HDR (HLG): this ffmpeg lacks"), "{said}");
    assert!(ran(&place, &["-vf fps=3.000000,scale=", "in_color_matrix=bt2020"]), "{}", log(&place));
}

/// Names that ffmpeg would take for a protocol, an option or a pattern; and an end of frames, whatever the file says.
#[test]
fn video_names_reach_ffmpeg_as_files() {
    let place = place();
    for name in ["2024-05-01T12:30.mp4", "http:host.mp4", "./-i.mp4", "100%d.mp4"] {
        std::fs::copy(place.path("walk.mp4"), place.path(name)).unwrap();
        succeeds(&place, &format!("prepare {name} --out 50%d --frames 10"));
        let own = format!("/{} ", name.trim_start_matches("./"));
        assert!(ran(&place, &["-protocol_whitelist file -i file:/", &own, "-frames:v 31", " %06d.jpg"]), "{name}");
        std::fs::remove_dir_all(place.path("50%d")).unwrap();
    }
}

#[track_caller]
fn succeeds(place: &Place, arguments: &str) -> String {
    let output = run(place, arguments);
    assert!(output.status.success(), "{arguments}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

fn log(place: &Place) -> String {
    String::from_utf8(place.bytes("log")).unwrap()
}

/// Returns true if a line of the log contains all of these in this order.
fn ran(place: &Place, parts: &[&str]) -> bool {
    log(place).lines().any(|line| {
        let mut rest = line;
        parts.iter().all(|part| rest.split_once(part).map(|(_, after)| rest = after).is_some())
    })
}

/// The new files in the folder of the place.
fn made(place: &Place) -> Vec<String> {
    let there = ["bin", "walk.mp4", "photos", "sharp.jpg", "soft.jpg", "log"];
    let entries = std::fs::read_dir(place.path("")).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter(|name| !there.contains(&name.as_str())).collect()
}

#[test]
fn video_becomes_a_dataset_of_sharp_frames() {
    let place = place();
    let said = succeeds(&place, "prepare walk.mp4 --out made --frames 10");
    assert!(said.contains("images   10 sharp frames from walk.mp4, one in 1.00 s\n"), "{said}");
    assert!(said.contains("cameras  8 of 10 images registered, in the largest of 2 models\n"), "{said}");
    assert!(said.contains("no pose  frame_00009.jpg, frame_00010.jpg\n"), "{said}");
    // The doctor ran: cameras in a row that look the same way give findings.
    assert!(said.contains("written: made/doctor/cameras.png, made/doctor/doctor.html\n"), "{said}");
    assert!(said.contains("\nnext     raygrad doctor made ") && said.contains("raygrad train made "), "{said}");
    // Three candidates per frame: 30 from 10 seconds.
    assert!(ran(&place, &["ffmpeg ", "-progress pipe:1", "walk.mp4", "fps=3.000000", "-q:v 1", "%06d.jpg"]));
    assert!(ran(
        &place,
        &["feature_extractor", "camera_model OPENCV", "single_camera 1", "--SiftExtraction.use_gpu 0"]
    ));
    assert!(ran(&place, &["exhaustive_matcher", "--database_path"]) && !log(&place).contains("sequential"));
    assert!(ran(&place, &["mapper", "--database_path", "--image_path", "--output_path"]));
    for i in 1..=10 {
        assert_eq!(place.bytes(&format!("made/images/frame_{i:05}.jpg")), place.bytes("sharp.jpg"), "{i}");
    }
    let mut names: Vec<_> = std::fs::read_dir(place.path("made")).unwrap().map(|e| e.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(
        (names, made(&place)),
        (vec!["doctor".into(), "images".into(), "sparse".into()], vec!["made".to_owned()])
    );
    assert!(place.path("made/sparse/0/cameras.txt").exists() && !place.path("made/sparse/1").exists());
    assert_eq!(std::fs::metadata(place.path("made")).unwrap().permissions().mode() & 0o700, 0o700);
    // Frames of a long video are farther apart.
    let output = command(&place, "prepare walk.mp4 --out long --frames 10").env("LENGTH", "45").output().unwrap();
    let [said, notes] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    assert!(said.contains("images   10 sharp frames from walk.mp4, one in 4.50 s\n"), "{said}");
    assert!(notes.contains("may overlap too little for COLMAP: `raygrad prepare --frames N` takes"), "{notes}");
    complained("a folder", &run(&place, "prepare photos --out other --frames 9"), &["`frames`: is for videos"]);
    // It is a dataset, and no second one overwrites it.
    place.succeeds(&format!("train made --scene-type bounded --steps 1 {CLASSIC}"));
    complained("again", &run(&place, "prepare walk.mp4 --out made"), &["made: is not empty: choose another folder"]);
}

#[test]
fn images_become_an_upright_dataset() {
    let place = place();
    std::fs::write(place.path("photos/notes.txt"), "").unwrap();
    // What macOS puts beside images.
    for name in ["._0.JPG", ".DS_Store", ".hidden.png"] {
        std::fs::write(place.path(&format!("photos/{name}")), "no image").unwrap();
    }
    // Stored in landscape, shown in portrait: the size is turned, so only the others share a camera.
    std::fs::write(place.path("photos/turned.jpg"), jpeg(4, 6)).unwrap();
    let said = succeeds(&place, "prepare photos --out made --lens fisheye");
    assert!(said.contains("images   6 images from photos\ncameras  4 of 6 images"), "{said}");
    let extractors = log(&place).lines().filter(|line| line.contains("camera_model OPENCV_FISHEYE")).count();
    let shared = ["feature_extractor", "single_camera 1", "--image_list_path", "camera-0.txt"];
    assert!(extractors == 2 && ran(&place, &shared), "{}", log(&place));
    assert!(ran(&place, &["exhaustive_matcher"]) && !log(&place).contains("ffmpeg"));
    assert_eq!(place.bytes("made/images/0.JPG"), place.bytes("photos/0.JPG"));
    assert_eq!(Photo::size_of_file(place.path("made/images/turned.jpg")).unwrap(), [[8, 16]; 2]);
    assert!(!place.path("made/images/notes.txt").exists());
    // Newer versions of COLMAP have another name for the GPU option.
    std::fs::remove_dir_all(place.path("made")).unwrap();
    let output = command(&place, "prepare photos --out made").env("GPU", "FeatureExtraction").output().unwrap();
    assert!(
        output.status.success() && ran(&place, &["feature_extractor", "--FeatureExtraction.use_gpu 0"]),
        "{output:?}"
    );
}

#[test]
fn missing_programs_are_named_with_install_commands() {
    let place = place();
    let bare = |arguments: &str| command(&place, arguments).env("PATH", place.path("photos")).output().unwrap();
    let install =
        |name: &str| format!("`apt install {name}`, `brew install {name}`, `conda install -c conda-forge {name}`");
    complained(
        "ffmpeg",
        &bare("prepare walk.mp4 --out made"),
        &["`ffmpeg`: is not on the PATH", &install("ffmpeg"), "winget"],
    );
    complained(
        "colmap",
        &bare("prepare photos --out made"),
        &["`colmap`: is not on the PATH", &install("colmap"), "winget"],
    );
    // Input errors come before missing programs.
    std::fs::create_dir(place.path("empty")).unwrap();
    complained("empty", &bare("prepare empty --out made"), &["empty: holds no images"]);
    std::fs::write(place.path("one.heic"), "").unwrap();
    complained(
        "one",
        &bare("prepare one.heic --out made"),
        &["one.heic: is a single image: name the folder that holds the images"],
    );
    assert!(!place.path("made").exists());
}

#[test]
fn failing_programs_show_their_last_words() {
    let place = place();
    for step in ["feature_extractor", "exhaustive_matcher", "mapper"] {
        let output = command(&place, "prepare photos --out made").env("FAILS", step).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{said}");
        for expected in ["  elapsed\n", "  out of luck\n", &format!("raygrad: `colmap {step}`: failed (exit code 3), ")]
        {
            assert!(said.contains(expected), "{said}");
        }
        assert_eq!(made(&place), [""; 0]);
    }
    let output = command(&place, "prepare photos --out made").env("MODELS", "none").output().unwrap();
    complained("no model", &output, &["`colmap mapper`: found no camera poses", "overlap too little"]);
    std::fs::write(place.path("bin/ffmpeg"), "#!/bin/sh\necho walk.mp4: Invalid data found >&2\nexit 1\n").unwrap();
    let output = run(&place, "prepare walk.mp4 --out made");
    complained("no video", &output, &["walk.mp4: ffmpeg cannot read it as a video", "walk.mp4: Invalid data found"]);
    assert_eq!(made(&place), [""; 0]);
}

#[test]
fn ctrl_c_ends_the_program_and_leaves_nothing() {
    let place = place();
    let mut command = command(&place, "prepare photos --out made");
    command.env("SLEEPS", "mapper").stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    wait(&mut child, || std::fs::read_to_string(place.path("log")).is_ok_and(|log| log.contains("begun")));
    assert_eq!(made(&place).len(), 1, "it works in a folder of its own");
    let start = Instant::now();
    let sent = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{output:?}");
    assert_eq!(made(&place), [""; 0]);
    let log = log(&place);
    let colmap = log.lines().find_map(|line| line.strip_prefix("begun ")).unwrap();
    let lives = Command::new("kill").args(["-0", colmap]).stderr(Stdio::null()).status().unwrap();
    assert!(start.elapsed() < Duration::from_secs(30) && !lives.success(), "colmap goes on");
}

#[test]
fn next_command_removes_what_a_killed_one_left() {
    let place = place();
    let killed = |out: &str| {
        let _ = std::fs::remove_file(place.path("log"));
        let mut command = command(&place, &format!("prepare photos --out {out}"));
        command.env("SLEEPS", "mapper").stdout(Stdio::null()).stderr(Stdio::null());
        let mut child = command.spawn().unwrap();
        wait(&mut child, || std::fs::read_to_string(place.path("log")).is_ok_and(|log| log.contains("begun")));
        child
    };
    let mut first = killed("made");
    let left = made(&place);
    // Another dataset is in the making beside it.
    let mut other = killed("other");
    assert_eq!(made(&place).len(), 2, "the first one still works");
    first.kill().unwrap();
    first.wait().unwrap();
    assert_eq!(made(&place).len(), 2, "nothing could remove it");
    let output = run(&place, "prepare photos --out made");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
    assert!(
        said.contains(&format!("{}: removed ", left[0])) && said.contains(" MB that a killed command left"),
        "{said}"
    );
    let now = made(&place);
    assert!(now.len() == 2 && !now.contains(&left[0]) && now.iter().any(|name| name == "made"), "{now:?}");
    assert!(!place.path("made/.raygrad-lock").exists());
    other.kill().unwrap();
    other.wait().unwrap();
}

#[test]
fn bad_inputs_are_named() {
    let place = place();
    std::fs::create_dir(place.path("empty")).unwrap();
    complained_of("absent", &run(&place, "prepare absent --out made"), "absent: there is no such file or folder");
    complained_of(
        "empty",
        &run(&place, "prepare empty --out made"),
        "empty: holds no images: put .jpg, .png, .tif, .webp or .heic files in it or in its folder `images`",
    );
    std::fs::write(place.path("empty/0.DNG"), "").unwrap();
    complained_of(
        "tiff",
        &run(&place, "prepare empty --out made"),
        "empty: 1 images are raw or GIF, which raygrad cannot read: convert them to JPEG, PNG or TIFF",
    );
    complained("no cameras", &run(&place, "prepare photos --out made --to colmap"), &["photos: is not a dataset"]);
    complained_of("a file", &run(&place, "prepare photos --out walk.mp4"), "walk.mp4: is not a folder");
    succeeds(&place, "prepare photos --out made");
    complained_of(
        "a dataset",
        &run(&place, "prepare made --out other"),
        "made: already has camera poses: train on it, or choose a format to convert it to with --to",
    );
    std::fs::write(place.path("photos/4.JPG"), "no picture").unwrap();
    complained("a damaged one", &run(&place, "prepare photos --out other"), &["4.JPG: cannot be decoded"]);
    assert!(!made(&place).iter().any(|name| name.contains("other")));
    for (arguments, expected) in [
        ("prepare photos", "--out"),
        ("prepare photos --out made --to tiff", "possible values: nerfstudio, colmap, colmap-text, llff, blender"),
        ("prepare photos --out made --frames 0", "write a whole number from 1 to 10000"),
        ("prepare photos --out made --to colmap --frames 3", "cannot be used with"),
    ] {
        let output = run(&place, arguments);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && said.contains(expected), "{arguments}: {said}");
    }
}

/// A folder with so many images.
fn many(place: &Place, count: usize) -> String {
    let (name, photo) = (format!("many-{count}"), jpeg(4, 1));
    std::fs::create_dir(place.path(&name)).unwrap();
    (0..count).for_each(|i| std::fs::write(place.path(&format!("{name}/{i:03}.jpg")), &photo).unwrap());
    name
}

#[test]
fn many_images_are_matched_in_sequence_and_by_likeness() {
    let place = place();
    for (count, matcher, others) in [(200, "exhaustive_matcher", false), (201, "sequential_matcher", true)] {
        let _ = std::fs::remove_file(place.path("log"));
        let name = many(&place, count);
        if others {
            std::fs::rename(place.path(&format!("{name}/200.jpg")), place.path(&format!("{name}/2 00.jpg"))).unwrap();
        }
        let output = run(&place, &format!("prepare {name} --out made-{count}"));
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{said}");
        assert!(ran(&place, &[matcher, "--database_path", &format!("made-{count}")]), "{}", log(&place));
        let importer = ["matches_importer", "--match_list_path", "pairs.txt", "--match_type pairs"];
        assert_eq!(ran(&place, &importer), others);
        // All images are the same, so that each has pairs; not those that the sequential matcher has.
        let pairs = log(&place).lines().filter(|line| line.starts_with("list ")).count();
        assert_eq!(pairs > 1000, others, "{pairs}");
        assert!(!log(&place).contains("list 000.jpg 001.jpg") && !log(&place).contains("2 00.jpg"));
        assert_eq!(said.contains("1 images have spaces in their names"), others, "{said}");
    }
}

#[test]
fn lenses_have_a_camera_each() {
    let place = place();
    for (i, focal) in [26, 13, 26, 13, 77].into_iter().enumerate() {
        std::fs::write(place.path(&format!("photos/{i}.JPG")), jpeg_of_lens(focal)).unwrap();
    }
    let output = run(&place, "prepare photos --out made");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.contains("5 images have 3 combinations of lens and size"), "{said}");
    let log = log(&place);
    let parts: Vec<&str> = log.split("colmap feature_extractor --database").skip(1).collect();
    let lists = parts.iter().map(|part| part.lines().filter(|line| line.starts_with("list ")).collect::<Vec<_>>());
    assert_eq!(
        lists.collect::<Vec<_>>(),
        [vec!["list 0.JPG", "list 2.JPG"], vec!["list 1.JPG", "list 3.JPG"], vec!["list 4.JPG"]]
    );
    let shares = parts.iter().map(|part| part.contains("--ImageReader.single_camera 1"));
    assert_eq!(shares.collect::<Vec<_>>(), [true, true, false]);
    // With one lens there is one camera and no list.
    (0..5).for_each(|i| std::fs::write(place.path(&format!("photos/{i}.JPG")), jpeg_of_lens(26)).unwrap());
    std::fs::remove_file(place.path("log")).unwrap();
    succeeds(&place, "prepare photos --out again");
    assert!(ran(&place, &["feature_extractor", "--ImageReader.single_camera 1"]));
    assert!(!self::log(&place).contains("image_list_path"));
}

#[test]
fn glomap_finds_the_poses_of_many_images() {
    let place = place();
    let script = COLMAP.replace("echo \"colmap ", "echo \"glomap ");
    std::fs::write(place.path("bin/glomap"), script).unwrap();
    std::fs::set_permissions(place.path("bin/glomap"), std::fs::Permissions::from_mode(0o755)).unwrap();
    for (count, used, models) in [(200, "colmap", "work/models"), (201, "glomap", "work/global")] {
        let _ = std::fs::remove_file(place.path("log"));
        let name = many(&place, count);
        succeeds(&place, &format!("prepare {name} --out made-{count}"));
        let mappers = log(&place).lines().filter(|line| line.contains(" mapper ")).count();
        assert!(ran(&place, &[used, " mapper --database_path", models]) && mappers == 1, "{}", log(&place));
        assert!(place.path(&format!("made-{count}/sparse/0/cameras.txt")).exists());
    }
    // It fails, or finds nothing.
    for (i, script) in ["#!/bin/sh\nexit 1\n", "#!/bin/sh\nexit 0\n"].into_iter().enumerate() {
        std::fs::write(place.path("bin/glomap"), script).unwrap();
        let output = run(&place, &format!("prepare many-201 --out fails-{i}"));
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && said.contains("GLOMAP found no poses: COLMAP tries it\n"), "{said}");
    }
}

/// Options of training runs on the cameras of the script in place of COLMAP.
const TRAIN: &str = "--scene-type bounded";

#[test]
fn train_prepares_images_and_videos_once() {
    let place = place();
    for (input, about) in [("photos", "5 images from photos"), ("walk.mp4", "30 sharp frames from walk.mp4")] {
        let train = format!("train {input} {TRAIN} --steps 1 {CLASSIC} --out run-{input}");
        let said = succeeds(&place, &train);
        let line = format!("prepare  {input} has no camera poses: making {input}-prepared with COLMAP\n");
        assert!(said.starts_with(&line) && said.contains(about) && said.contains(" images registered"), "{said}");
        let made = place.path(&format!("{input}-prepared")).canonicalize().unwrap();
        assert_eq!(place.json(&format!("run-{input}/config.json"))["scene"]["folder"], made.to_str().unwrap());
        // The next run uses the same dataset.
        std::fs::remove_file(place.path("log")).unwrap();
        let said = succeeds(&place, &train.replace("--out run", "--out again"));
        assert!(said.starts_with(&format!("prepared {input}-prepared, made before from {input}\n")), "{said}");
        assert!(!place.path("log").exists() || !log(&place).contains("mapper"));
    }
    // Another video of the same name, and changed images.
    let video = place.bytes("walk.mp4");
    std::fs::write(place.path("walk.mp4"), [&video[..], b"more"].concat()).unwrap();
    let refused = "walk.mp4-prepared: was not made from walk.mp4: remove or rename it";
    complained("changed video", &run(&place, &format!("train walk.mp4 {TRAIN} --steps 1 {CLASSIC}")), &[refused]);
    // Other images than before, and a folder of something else.
    let train = format!("train photos {TRAIN} --steps 1 {CLASSIC}");
    std::fs::write(place.path("photos/new.jpg"), jpeg(4, 1)).unwrap();
    let refused = "photos-prepared: was not made from photos: remove or rename it";
    complained("new image", &run(&place, &train), &[refused]);
    std::fs::remove_dir_all(place.path("photos-prepared")).unwrap();
    std::fs::create_dir(place.path("photos-prepared")).unwrap();
    std::fs::write(place.path("photos-prepared/notes.txt"), "mine").unwrap();
    let output = run(&place, &train);
    assert!(String::from_utf8_lossy(&output.stderr).contains(refused), "{output:?}");
    assert_eq!(place.bytes("photos-prepared/notes.txt"), b"mine");
}

#[test]
fn train_without_colmap_names_other_ways() {
    let place = place();
    let output = command(&place, "train photos").env("PATH", place.path("photos")).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    let lines: Vec<&str> = said.lines().collect();
    assert!(output.status.code() == Some(1) && lines.len() == 2, "{said}");
    assert!(lines[0].contains("photos: has no camera poses") && lines[0].contains("Polycam or Record3D"), "{said}");
    assert!(lines[1].contains("`colmap`: is not on the PATH; install it with `apt install colmap`"), "{said}");
    assert!(!place.path("photos-prepared").exists());
}

#[test]
fn train_prepares_no_folder_that_has_cameras() {
    let place = place();
    succeeds(&place, "prepare photos --out made");
    std::fs::remove_file(place.path("log")).unwrap();
    complained("inner", &run(&place, "train made/images"), &["is not a dataset, but `made` is"]);
    std::fs::create_dir_all(place.path("photos/keyframes")).unwrap();
    complained("export", &run(&place, "train photos"), &["is a raw export of Polycam"]);
    std::fs::create_dir(place.path("empty")).unwrap();
    complained("empty", &run(&place, "train empty"), &["is not a dataset: expected transforms.json"]);
    complained("image", &run(&place, "train sharp.jpg"), &["sharp.jpg: does not describe a capture"]);
    assert!(!place.path("log").exists());
}

#[test]
fn ctrl_c_after_preparing_saves_the_model() {
    let place = place();
    let mut command = command(&place, &format!("train photos {TRAIN} --budget 1h {CLASSIC} --out run"));
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    wait(&mut child, || std::fs::metadata(place.path("run/metrics.jsonl")).is_ok_and(|file| file.len() > 0));
    let sent = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("stopped "), "{output:?}");
    assert!(String::from_utf8_lossy(&output.stderr).contains("stopping after this step"), "{output:?}");
}

#[test]
fn linked_images_are_copied_if_allowed() {
    use std::os::unix::fs::symlink;
    let place = place();
    // The input holds links alone; they lead to its parent folder, which is outside of the input.
    std::fs::create_dir_all(place.path("photos/linked")).unwrap();
    for i in 0..4 {
        symlink(place.path(&format!("photos/{i}.JPG")), place.path(&format!("photos/linked/{i}.jpg"))).unwrap();
    }
    let expected =
        ["photos/linked: photos/linked/", ".jpg lies outside of", "photos/linked: add --allow-outside to copy it"];
    complained("links", &run(&place, "prepare photos/linked --out made"), &expected);
    assert_eq!(made(&place), [""; 0]);
    succeeds(&place, "prepare photos/linked --out made --allow-outside");
    // Files that are no images are not copied, whatever their extension.
    std::fs::create_dir(place.path("photos/odd")).unwrap();
    let whole = std::fs::read(place.path("photos/0.JPG")).unwrap();
    std::fs::write(place.path("photos/odd/0.jpg"), &whole[..whole.len() / 2]).unwrap();
    complained("cut off", &run(&place, "prepare photos/odd --out other"), &["0.jpg: cannot be decoded"]);
}

#[test]
fn prepare_follows_a_link_as_output() {
    let place = place();
    std::fs::create_dir(place.path("disk")).unwrap();
    std::os::unix::fs::symlink(place.path("disk"), place.path("made")).unwrap();
    succeeds(&place, "prepare photos --out made");
    assert!(place.path("made").is_symlink() && place.path("disk/sparse/0/images.txt").exists());
    std::fs::create_dir(place.path("converted")).unwrap();
    succeeds(&place, "prepare made --to nerfstudio --out converted");
    assert!(place.path("converted/transforms.json").exists());
    let names: Vec<_> = std::fs::read_dir(place.path("converted")).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(names.len(), 2, "{names:?}");
}

/// Replaces heif-convert and ffmpeg: writes `converted.jpg` to its last argument.
const CONVERTER: &str = r#"#!/bin/sh
echo "$(pwd) $0 $*" >> "$LOG"
[ "$1" = -h ] && exit 0
if [ -n "$FAILS" ]; then echo "damaged input" >&2; exit 2; fi
for out; do :; done
[ -n "$SEVERAL" ] && out="${out%.jpg}-1.jpg"
cp "$(dirname "$LOG")/converted.jpg" "$out"
"#;

/// A [`place`] with three HEIC images of 16 x 8 pixels, and converters with these names.
fn place_with_heic(converters: &[&str]) -> Place {
    let place = place();
    std::fs::remove_file(place.path("bin/ffmpeg")).unwrap();
    for name in converters {
        let path = place.path(&format!("bin/{name}"));
        std::fs::write(&path, CONVERTER).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
    }
    // The pixels are upright already, but the orientation stayed.
    std::fs::write(place.path("converted.jpg"), jpeg(4, 6)).unwrap();
    for name in ["0.heic", "5.HEIC", "6.jpg"] {
        std::fs::write(place.path(&format!("photos/{name}")), heic([16, 8])).unwrap();
    }
    place
}

/// The start of a HEIC file.
fn heic([width, height]: [u32; 2]) -> Vec<u8> {
    let size = [&width.to_be_bytes()[..], &height.to_be_bytes()].concat();
    [b"\0\0\0\x18ftypheic\0\0\0\0mif1heic....ispe\0\0\0\0", &size[..]].concat()
}

#[test]
fn heic_images_become_upright_jpegs() {
    for (converters, several, program) in [
        (&["heif-convert", "ffmpeg"][..], "", "heif-convert -q 95 /"),
        (&["heif-dec"], "1", "heif-dec -q 95 /"),
        (&["ffmpeg"], "", "-protocol_whitelist file -f mov -i file:/"),
    ] {
        let place = place_with_heic(converters);
        // A JPEG by its content.
        std::fs::write(place.path("photos/7.heic"), jpeg(4, 6)).unwrap();
        let output = command(&place, "prepare photos --out made").env("SEVERAL", several).output().unwrap();
        assert!(output.status.success(), "{output:?}");
        for name in ["0.heic", "5.HEIC", "6.jpg"] {
            assert!(ran(&place, &["/foreign-", program, &format!("/photos/{name}"), " 0.jpg"]), "{}", log(&place));
        }
        assert!(!ran(&place, &[program, "7.heic"]) && !ran(&place, &[program, "0.JPG"]));
        let mut names: Vec<_> = std::fs::read_dir(place.path("made/images")).unwrap().collect();
        names.sort_by_key(|entry| entry.as_ref().unwrap().file_name());
        let names: Vec<_> = names.into_iter().map(|entry| entry.unwrap().file_name()).collect();
        let all = ["0.JPG", "0.heic.jpg", "1.JPG", "2.JPG", "3.JPG", "4.JPG", "5.jpg", "6.jpg", "7.jpg"];
        assert_eq!(names, all);
        assert_eq!(place.bytes("made/images/0.JPG"), place.bytes("photos/0.JPG"));
        for name in ["0.heic.jpg", "5.jpg", "6.jpg"] {
            assert_eq!(place.bytes(&format!("made/images/{name}")), jpeg(4, 1), "{name}");
        }
        // raygrad itself turns this one.
        assert_eq!(Photo::size_of_file(place.path("made/images/7.jpg")).unwrap(), [[8, 16]; 2]);
        let left = std::fs::read_dir(place.path("made")).unwrap().map(|entry| entry.unwrap().file_name());
        assert!(left.into_iter().all(|name| !name.to_str().unwrap().starts_with("foreign")));
    }
}

#[test]
fn train_reuses_converted_images() {
    let place = place_with_heic(&["heif-convert"]);
    let train = format!("train photos {TRAIN} --steps 1 {CLASSIC}");
    assert!(succeeds(&place, &train).starts_with("prepare  photos has no camera poses"));
    assert!(succeeds(&place, &train).starts_with("prepared photos-prepared, made before from photos\n"));
}

#[test]
fn failed_conversions_name_the_image() {
    let install = "`apt install libheif-examples` or `brew install libheif`";
    let place = place_with_heic(&[]);
    let expected = ["photos/0.heic: is HEIC or AVIF, which heif-convert reads: install it with ", install];
    complained("no converter", &run(&place, "prepare photos --out made"), &expected);
    let place = place_with_heic(&["heif-convert"]);
    let output = command(&place, "prepare photos --out made").env("FAILS", "yes").output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("  damaged input\n"), "{said}");
    assert!(said.contains("raygrad: photos/0.heic: `heif-convert`: failed (exit code 2), "), "{said}");
    assert!(!made(&place).iter().any(|name| name.contains("made")));
    // Old versions of ffmpeg do not read HEIC, or read a single tile.
    let place = place_with_heic(&["ffmpeg"]);
    let output = command(&place, "prepare photos --out made").env("FAILS", "yes").output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains(&format!("is above; install heif-convert with {install}")), "{said}");
    std::fs::write(place.path("photos/5.HEIC"), heic([4032, 3024])).unwrap();
    let expected = ["photos/5.HEIC: was not converted: ffmpeg read only 16x8 of 4032x3024 pixels; ", install];
    complained("a tile", &run(&place, "prepare photos --out made"), &expected);
    assert!(!made(&place).iter().any(|name| name.contains("made")));
}
