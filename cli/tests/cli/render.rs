//! Paths, videos, and layers saved beside frames.

use super::SMALL;
use super::{Place, SIZE, complained, complained_of, png};
use raygrad::nerf::dataset::{Capture, Depths, Split};
use raygrad::nerf::glam::{DAffine3, DVec3};
use raygrad::nerf::{Camera, Config, Image, Model, SceneBox};
use raygrad_scenes::ANGLE_X;
use raygrad_test_support::skip::skipped;
use serde_json::{Value, json};
use std::process::{Command, Stdio};

/// The largest difference of two images of one size, in steps of 8 bits.
#[track_caller]
fn apart(a: &Image, b: &Image) -> f32 {
    assert_eq!([a.width, a.height, a.channels], [b.width, b.height, b.channels]);
    let worst = a.data.iter().zip(&b.data).map(|(a, b)| (a - b).abs());
    255.0 * worst.fold(0.0, raygrad::Real::maximum)
}

#[test]
fn paths_follow_images_and_files() {
    let place = Place::with_run();
    assert!(place.succeeds("render run --path test --frames 2 --out two").contains("rendered 2 frames"));
    place.succeeds("render run --path test --out test");
    let test = [0, 1, 2].map(|i| png(&place.path(&format!("test/000{i}.png"))));
    assert!(apart(&test[0], &test[1]) > 3.0 && apart(&test[1], &test[2]) > 3.0);
    // A spline passes its images, given by number or by name.
    for (out, through) in [("numbers", "2,0"), ("names", "test/r_2,test/r_0")] {
        place.succeeds(&format!("render run --path spline --keyframes {through} --split test --frames 3 --out {out}"));
        let spline = [0, 1, 2].map(|i| png(&place.path(&format!("{out}/000{i}.png"))));
        assert!(apart(&spline[0], &test[2]) <= 1.0 && apart(&spline[2], &test[0]) <= 1.0);
        assert!(apart(&spline[1], &test[0]) > 3.0 && apart(&spline[1], &test[2]) > 3.0);
    }
    // A closed path returns where an open one ends.
    place.succeeds("render run --path spline --keyframes 2,0 --split test --closed --frames 4 --out closed");
    assert!(apart(&png(&place.path("closed/0002.png")), &test[0]) <= 1.0);
    // The cameras of a file are in capture coordinates.
    let transforms = place.transforms(Split::Test);
    let shot = |i: usize| {
        let rows = transforms["frames"][i]["transform_matrix"].as_array().unwrap().clone();
        let flat: Vec<_> = rows.iter().flat_map(|row| row.as_array().unwrap().clone()).collect();
        json!({ "camera_to_world": flat, "fov": ANGLE_X.to_degrees(), "aspect": 1.0 })
    };
    let path = json!({
        "render_width": SIZE, "render_height": SIZE, "fps": 20, "seconds": 0.15, "camera_type": "perspective",
        "camera_path": [shot(1), shot(2)],
    });
    std::fs::write(place.path("path.json"), path.to_string()).unwrap();
    assert!(place.succeeds("render run --path path.json").contains("rendered 2 frames of 24x24: run/path"));
    for i in [1, 2] {
        assert!(apart(&png(&place.path(&format!("run/path/000{}.png", i - 1))), &test[i]) <= 1.0);
    }
    assert!(place.succeeds("render run --path path.json --out half.gif --size 12x12").contains("2 frames of 12x12"));
    let gif = place.bytes("half.gif");
    let mut decoder = gif::Decoder::new(&gif[..]).unwrap();
    assert_eq!(decoder.read_next_frame().unwrap().unwrap().delay, 5, "20 frames a second, as the file says");
    // Other path types show other views.
    place.succeeds("render run --path spiral --frames 3 --aspect 3:2 --radius 3 --out spiral");
    let spiral = [0, 1].map(|i| png(&place.path(&format!("spiral/000{i}.png"))));
    assert!([spiral[0].width, spiral[0].height] == [36, 24] && apart(&spiral[0], &spiral[1]) > 3.0);
    let one = |flags: &str| {
        place.succeeds(&format!("render run {flags} --out one.png --overwrite"));
        png(&place.path("one.png"))
    };
    let usual = one("");
    for flags in ["--radius 2", "--elevation -20", "--fov 20", "--background 255,0,0", "--show opacity", "--show depth"]
    {
        assert!(apart(&one(flags), &usual) > 3.0, "{flags}");
    }
    // At twice the tangent of half the field of view, the former image is in the middle at half the size.
    let wide = one("--size 48x48 --fov 71.507778");
    let middle = |x: usize, y: usize| wide.pixel(12 + x, 12 + y).to_vec();
    let worst = (0..SIZE * SIZE).map(|i| {
        let (x, y) = (i % SIZE, i / SIZE);
        usual.pixel(x, y).iter().zip(middle(x, y)).map(|(a, b)| (a - b).abs()).fold(0.0, raygrad::Real::maximum)
    });
    assert!(255.0 * worst.fold(0.0_f32, raygrad::Real::maximum) <= 2.0);
}

/// A scene whose coordinates differ from those of its capture.
#[test]
fn paths_follow_the_scene_transform() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 30 --out run --scene-type unbounded {SMALL}"));
    let config = place.json("run/config.json");
    let extent: SceneBox = serde_json::from_value(config["scene_box"].clone()).unwrap();
    assert!((extent.transform.scale - 1.0).abs() > 0.01, "the test is of coordinates that differ");
    let settings: Config = serde_json::from_value(config["config"].clone()).unwrap();
    let model = Model::<f32>::load(place.path("run/model.safetensors"), settings, extent).unwrap();
    let capture = Capture::read(place.path("scene")).unwrap();
    let given = &capture.split(Split::Test).unwrap()[1].camera;
    let expected = model.render(&extent.transform.camera(given), model.config.background.shown()).color;
    assert!(apart(&model.render(given, [1.0; 3]).color, &expected) > 6.0, "where it is matters");
    place.succeeds("render run --path test --out test");
    assert!(apart(&png(&place.path("test/0001.png")), &expected) <= 1.0);
    let rows = place.transforms(Split::Test)["frames"][1]["transform_matrix"].as_array().unwrap().clone();
    let flat: Vec<_> = rows.iter().flat_map(|row| row.as_array().unwrap().clone()).collect();
    let path = json!({
        "render_width": SIZE, "render_height": SIZE,
        "camera_path": [{ "camera_to_world": flat, "fov": ANGLE_X.to_degrees() }],
    });
    std::fs::write(place.path("path.json"), path.to_string()).unwrap();
    place.succeeds("render run --path path.json --out path");
    assert!(apart(&png(&place.path("path/0000.png")), &expected) <= 1.0);
    // A file that names its transform needs no warning.
    let said = |path: &Value, flags: &str| {
        std::fs::write(place.path("path.json"), path.to_string()).unwrap();
        let output = place.command(&format!("render run --path path.json {flags} --out said")).output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let mut own = path.clone();
    own["coordinates"] = json!("capture");
    for (path, is_told) in [(&path, true), (&own, false)] {
        let (code, said) = said(path, "");
        assert!(code == Some(0) && said.contains("assuming capture coordinates") == is_told, "{said}");
        assert!(apart(&png(&place.path("said/0000.png")), &expected) <= 1.0);
    }
    let (code, words) = said(&own, "--path-transform path.json");
    assert!(
        code == Some(1)
            && words.contains("`coordinates`")
            && words.contains("is already `capture`: remove --path-transform"),
        "{words}"
    );
    own["coordinates"] = json!("scene");
    let (code, words) = said(&own, "");
    assert!(code == Some(1) && words.contains("path.json") && words.contains("`scene`, expected `capture`"), "{words}");

    // nerfstudio's own coordinates, for a file with another transform.
    place.succeeds("prepare scene --to nerfstudio --out captured");
    let mut transforms = place.json("captured/transforms.json");
    let before = DAffine3::from_cols_array(&[1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0, 0.5, 0.2, -0.3]);
    let rows = |map: DAffine3| {
        [0, 1, 2].map(|r| [map.matrix3.row(r).x, map.matrix3.row(r).y, map.matrix3.row(r).z, map.translation[r]])
    };
    transforms["applied_transform"] = json!(rows(before));
    transforms["applied_scale"] = json!(2.0);
    std::fs::write(place.path("captured/transforms.json"), transforms.to_string()).unwrap();
    let own = DAffine3 { translation: DVec3::new(-0.4, 0.1, 0.7), ..DAffine3::from_rotation_z(0.6) };
    let shrunk = 0.25;
    let dataparser = json!({ "transform": rows(own * before), "scale": 2.0 * shrunk });
    std::fs::write(place.path("dataparser_transforms.json"), dataparser.to_string()).unwrap();
    let moved = own * given.pose;
    let moved = DAffine3 { translation: shrunk * moved.translation, ..moved };
    let flat = [rows(moved).concat(), vec![0.0, 0.0, 0.0, 1.0]].concat();
    let path = json!({
        "render_width": SIZE, "render_height": SIZE,
        "camera_path": [{ "camera_to_world": flat, "fov": ANGLE_X.to_degrees() }],
    });
    std::fs::write(place.path("moved.json"), path.to_string()).unwrap();
    let flags = "--scene captured --path moved.json --path-transform dataparser_transforms.json";
    place.succeeds(&format!("render run {flags} --out moved"));
    assert!(apart(&png(&place.path("moved/0000.png")), &expected) <= 1.0);
}

/// At the size of the training images, whose sides were rounded separately: 28 x 21 to 14 x 11.
#[test]
fn test_views_render_as_in_eval() {
    let place = Place::empty();
    place.succeeds("prepare landscape --to nerfstudio --size 28 --out scene");
    place.succeeds(&format!("train scene --downscale 2 --steps 20 --out run {SMALL}"));
    place.succeeds("eval run --views 1");
    place.succeeds("render run --path test --frames 1 --out test");
    let [seen, drawing] = ["test/0000.png", "run/eval-test-fast-1/000.png"].map(|file| png(&place.path(file)));
    assert_eq!([seen.width, seen.height, drawing.width, drawing.height], [14, 11, 4 * 14, 11]);
    // Ground truth, render, error and depth are side by side.
    for (x, y) in (0..14).flat_map(|x| (0..11).map(move |y| (x, y))) {
        let apart = seen.pixel(x, y).iter().zip(drawing.pixel(14 + x, y)).map(|(a, b)| (a - b).abs());
        assert!(255.0 * apart.fold(0.0, raygrad::Real::maximum) <= 1.0, "{x} {y}");
    }
}

#[test]
fn conflicting_flags_are_named() {
    let place = Place::with_run();
    for (flags, expected) in [
        ("--path test --radius 2", "`radius`: does not apply to --path test: it is for orbit and spiral"),
        ("--path spline", "`keyframes`: is missing: --path spline needs images, such as --keyframes 0,5,9"),
        (
            "--path spline --keyframes 0,6",
            "`keyframes`: `6` is not a train image: use numbers from 0 to 5, or names such as train/r_0",
        ),
        ("--save depth --out one.png", "`save`: needs a folder: name one with --out"),
        ("--save depth --out one.gif", "`save`: needs a folder: name one with --out"),
        ("--depth-unit 0.01", "`depth-unit`: needs --save depth"),
        ("--keep-frames", "`keep-frames`: needs a video: name a .mp4, .webm, .gif or .apng file with --out"),
        ("--fps 30", "`fps`: needs a video or --seconds"),
        ("--fps 60 --out fast.gif", "`fps`: is 60; a GIF shows at most 50 frames a second: use .apng or .mp4"),
        (
            "--out video.MOV",
            "video.MOV: `.mov` is not an image or video extension: use .png, .gif, .apng, .mp4 or .webm, or end a \
             folder's name with `/`",
        ),
    ] {
        place.fails_with(&format!("render run {flags}"), expected);
    }
    place.fails("render run --path absent.json", &["absent.json: cannot be read: "]);
    place.fails("render run --out absent/video.apng", &["absent: cannot be written to: "]);
    let listed = json!({
        "render_width": 4, "render_height": 4,
        "camera_path": [{ "camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1], "fov": 50 }],
    });
    std::fs::write(place.path("path.json"), listed.to_string()).unwrap();
    let output = place.command("render run --path path.json --frames 3").output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains("`frames`: does not apply to a file that lists every frame"), "{said}");
    assert!(output.status.code() == Some(1) && said.contains("add --path-transform"), "{said}");
    for flags in [
        "--seconds 0",
        "--seconds 2 --fps 0.009",
        "--seconds 2 --fps 241",
        "--fov 180",
        "--elevation 90",
        "--aspect 4",
        "--background grey",
        "--save all",
    ] {
        let output = place.command(&format!("render run {flags}")).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{flags}: {output:?}");
    }
    let left: Vec<_> = std::fs::read_dir(place.path("run")).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert!(!left.iter().any(|name| name == "orbit"), "{left:?}");
    // An existing folder may have any name. Keyframes of a file give the number of frames by its speed.
    std::fs::create_dir(place.path("clip.mov")).unwrap();
    place.succeeds("render run --frames 1 --out clip.mov");
    let key = |x: f64| json!({ "matrix": [1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1], "fov": 50 });
    let keys = json!({ "render_width": 4, "render_height": 4, "keyframes": [key(0.0), key(0.5)], "seconds": 0.5 });
    std::fs::write(place.path("keys.json"), keys.to_string()).unwrap();
    assert!(place.succeeds("render run --path keys.json --fps 10 --out keys").contains("rendered 5 frames of 4x4"));
    let output = place.command("render run --path keys.json --fps 240 --seconds 500 --out keys").output().unwrap();
    assert!(
        String::from_utf8_lossy(&output.stderr).contains("`seconds`: 120000 frames are more than the limit of 100000")
    );
}

#[test]
fn saved_layers_belong_to_their_frames() {
    let place = Place::empty();
    place.succeeds(&format!("train --downscale 5 --steps 150 --out run {SMALL}"));
    let save = "--save depth,depth-npy,normals,opacity,alpha --depth-unit 0.01";
    place.succeeds(&format!("render run --frames 2 --size 20x14 --background 0,0,255 {save} --out frames"));
    for frame in ["0000", "0001"] {
        let seen = png(&place.path(&format!("frames/{frame}.png")));
        let alpha = png(&place.path(&format!("frames/alpha/{frame}.png")));
        assert_eq!([alpha.width, alpha.height, alpha.channels], [20, 14, 4]);
        assert!(apart(&alpha.over([0.0, 0.0, 1.0]), &seen) <= 2.0);
        let opacity = png(&place.path(&format!("frames/opacity/{frame}.png")));
        let normals = png(&place.path(&format!("frames/normals/{frame}.png")));
        let decoder = png::Decoder::new(std::io::Cursor::new(place.bytes(&format!("frames/depth/{frame}.png"))));
        let mut reader = decoder.read_info().unwrap();
        assert_eq!(reader.output_color_type(), (png::ColorType::Grayscale, png::BitDepth::Sixteen));
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut bytes).unwrap();
        let npy = place.bytes(&format!("frames/depth/{frame}.npy"));
        let floats = npy[npy.len() - 4 * 20 * 14..].chunks_exact(4).map(|x| f32::from_le_bytes(x.try_into().unwrap()));
        let mut solid = 0;
        for (i, (whole, depth)) in bytes.chunks_exact(2).zip(floats).enumerate() {
            let whole = u16::from_be_bytes([whole[0], whole[1]]);
            assert!(
                (f32::from(whole) - depth / 0.01).abs() < 0.501,
                "hundredths, in the order of PNG: {whole} {depth}"
            );
            let (opacity, alpha) = (opacity.data[3 * i], alpha.data[4 * i + 3]);
            assert!((opacity - alpha).abs() < 1.5 / 255.0);
            assert_eq!(depth > 0.0, opacity >= 127.5 / 255.0, "{i}: {opacity}");
            assert_eq!(depth > 0.0, normals.data[3 * i..3 * i + 3].iter().any(|x| *x > 0.0));
            if depth > 0.0 {
                solid += 1;
                assert!((2.0..6.0).contains(&depth), "{depth}");
                let normal = normals.data[3 * i..3 * i + 3].iter().map(|x| (2.0 * x - 1.0).powi(2)).sum::<f32>().sqrt();
                assert!((normal - 1.0).abs() < 0.02, "{normal}");
            }
        }
        assert!(solid > 20, "{solid} pixels of {frame} are solid");
    }
    assert!(!place.path("frames/unfinished.json").exists());
    // Layers of frames that were replaced without them stay, with a note.
    let noted = |flags: &str| {
        let arguments = format!("render run --frames 2 --size 20x14 {flags} --out frames --overwrite");
        String::from_utf8(place.command(&arguments).output().unwrap().stderr).unwrap()
    };
    let note = "8 layers of earlier frames stay, such as frames/depth/0000.npy: they do not belong to the new";
    assert!(noted("--save depth").contains(note));
    std::fs::remove_dir_all(place.path("frames/depth")).unwrap();
    assert_eq!(noted("--save normals,opacity,alpha"), "");
    // A warning counts the depths beyond 16 bits.
    let output = place.command("render run --frames 1 --save depth --depth-unit 1e-6 --out fine").output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.contains("or --save depth-npy"), "{said}");
}

/// The depth of each pixel is the distance along the ray times a cosine, for any lens. The test uses another
/// implementation of the reader's convention.
#[test]
fn depths_are_along_the_axis() {
    let camera = Camera::from_angle(3, 1, 2.0 * 2.0_f64.atan(), DAffine3::IDENTITY);
    let distances = Image { width: 3, height: 1, channels: 1, data: vec![2.0; 3] };
    let npy = Depths::new(&distances, &camera, 10.0).to_npy();
    let depths: Vec<f32> =
        npy[npy.len() - 12..].chunks_exact(4).map(|x| f32::from_le_bytes(x.try_into().unwrap())).collect();
    // Half a width of 1.5 pixels is two focal lengths: the outer pixel centre is 4/3 focal lengths aside, with a cosine
    // of 3/5.
    for (found, expected) in depths.iter().zip([12.0, 20.0, 12.0]) {
        assert!((found - expected).abs() < 1e-5, "{depths:?}");
    }
}

#[test]
fn flags_beyond_what_exists_are_noted() {
    let place = Place::with_run();
    let said = |arguments: &str| {
        let output = place.command(arguments).output().unwrap();
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stderr).unwrap()
    };
    for (arguments, expected) in [
        ("render run --path test --frames 9 --size 4x4 --out a", "--frames 9: there are only 3 test images"),
        ("render run --path test --frames 3 --size 4x4 --out b", ""),
        ("eval run --views 9", "--views 9: there are only 3 images to compare"),
        ("eval run --views 3", ""),
        ("render run --frames 1 --size 4x4 --out c --scene scene", "--scene is not used: an orbit needs no images"),
        ("render run --path test --frames 1 --size 4x4 --out d --scene scene", ""),
    ] {
        let said = said(arguments);
        assert!(said.contains(expected) && said.is_empty() == expected.is_empty(), "{arguments}: {said}");
    }
}

#[test]
fn videos_hold_the_frames_at_their_speed() {
    let place = Place::with_run();
    place.succeeds("render run --frames 3 --size 21x13 --out frames");
    let frames = [0, 1, 2].map(|i| png(&place.path(&format!("frames/000{i}.png"))));
    place.succeeds("render run --frames 3 --size 21x13 --fps 10 --out video.gif");
    let gif = place.bytes("video.gif");
    let mut decoder = gif::Decoder::new(&gif[..]).unwrap();
    let mut delays = vec![];
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        delays.push(frame.delay);
    }
    assert_eq!(delays, [10; 3]);
    place.succeeds("render run --seconds 0.12 --size 21x13 --out video.apng");
    let apng = place.bytes("video.apng");
    let mut reader = png::Decoder::new(std::io::Cursor::new(&apng[..])).read_info().unwrap();
    let control = *reader.info().animation_control().unwrap();
    assert_eq!((control.num_frames, control.num_plays), (3, 0));
    for frame in &frames {
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut bytes).unwrap();
        let control = *reader.info().frame_control().unwrap();
        assert_eq!((control.delay_num, control.delay_den), (100, 2500), "25 frames a second");
        let expected: Vec<u8> = frame.data.iter().map(|x| (255.0 * x).round() as u8).collect();
        assert!(bytes == expected, "not a color is lost");
    }
    // The frames are removed after the video, except with `--keep-frames`.
    assert!(!place.path("video.gif.frames").exists() && !place.path("video.apng.frames").exists());
    place.succeeds("render run --frames 3 --size 21x13 --out video.gif --keep-frames --overwrite");
    assert_eq!(png(&place.path("video.gif.frames/0002.png")), frames[2]);
    assert!(!place.path("video.gif.frames/unfinished.json").exists());
}

/// Returns true if ffmpeg is installed; prints a skip message otherwise.
pub fn has_ffmpeg() -> bool {
    let found = Command::new("ffmpeg").arg("-version").stdout(Stdio::null()).status().is_ok();
    if !found {
        skipped("ffmpeg is not installed");
    }
    found
}

#[test]
fn ffmpeg_writes_the_same_bytes_again() {
    if !has_ffmpeg() {
        return;
    }
    let place = Place::with_run();
    for ending in ["webm", "mp4"] {
        let written = |name: &str| {
            place.succeeds(&format!("render run --frames 2 --size 16x16 --out {name}.{ending}"));
            place.bytes(&format!("{name}.{ending}"))
        };
        assert!(written("one") == written("two"), "{ending}");
    }
}

#[test]
fn ffmpeg_videos_have_the_frames_colours() {
    if !has_ffmpeg() {
        return;
    }
    let place = Place::with_run();
    // A folder whose name contains a number format.
    std::fs::create_dir(place.path("a%03d b")).unwrap();
    for video in ["video.mp4", "video.webm"] {
        let video = format!("a%03d b/{video}");
        let mut command =
            place.command("render run --frames 5 --size 63x41 --fps 12.5 --background 200,30,60 --keep-frames --out");
        let output = command.arg(&video).output().unwrap();
        assert!(output.status.success(), "{video}: {output:?}");
        assert!(String::from_utf8_lossy(&output.stderr).contains("padded with black to 64x42"), "{output:?}");
        let bytes = place.bytes(&video);
        let is_webm = bytes.starts_with(&[0x1a, 0x45, 0xdf, 0xa3]);
        assert!(
            if video.ends_with("webm") { is_webm } else { &bytes[4..8] == b"ftyp" },
            "{video}: {:x?}",
            &bytes[..12]
        );
        let first = place.path("first.png");
        let taken = Command::new("ffmpeg")
            .args(["-y", "-loglevel", "error", "-i"])
            .arg(place.path(&video))
            .args(["-vf", "select=eq(n\\,3),scale=in_color_matrix=auto:in_range=auto", "-frames:v", "1"])
            .arg(&first)
            .status();
        assert!(taken.unwrap().success());
        let (seen, frame) = (png(&first), png(&place.path(&format!("{video}.frames/0003.png"))));
        assert_eq!([seen.width, seen.height], [64, 42]);
        // Chroma has half the resolution, and luma the full one.
        let bright = |x: usize| seen.pixel(x, 5).iter().zip([0.2126, 0.7152, 0.0722]).map(|(x, w)| x * w).sum::<f32>();
        assert!(bright(63) < 0.6 * bright(62), "black is at the right: {} {}", bright(63), bright(62));
        // A corner shows only background, without chroma of other parts.
        let [corner, expected] = [seen.pixel(3, 3), frame.pixel(3, 3)];
        let worst = corner.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, raygrad::Real::maximum);
        assert!(255.0 * worst <= 6.0, "{video}: {corner:?} {expected:?}");
        let said = Command::new("ffmpeg").arg("-i").arg(place.path(&video)).output().unwrap().stderr;
        let said = String::from_utf8_lossy(&said).into_owned();
        assert!(said.contains("12.50 fps") && said.contains("00:00:00.40") && said.contains("bt709"), "{said}");
    }
    let left = std::fs::read_dir(place.path("a%03d b")).unwrap().count();
    assert_eq!(left, 4, "two videos and their frames");
}

#[test]
fn missing_ffmpeg_is_named_before_rendering() {
    let place = Place::with_run();
    let output = place.command("render run --out video.mp4").env("PATH", place.path("")).output().unwrap();
    complained(
        "no ffmpeg",
        &output,
        &["video.mp4", "`ffmpeg`: is not on the PATH", "apt install ffmpeg", "or use .gif or .apng"],
    );
    assert!(!place.path("video.mp4.frames").exists());
}

#[cfg(unix)]
#[test]
fn ffmpeg_errors_and_missing_encoders_are_shown() {
    use std::os::unix::fs::PermissionsExt;
    let place = Place::with_run();
    let with = |script: &str| {
        let ffmpeg = place.path("ffmpeg");
        std::fs::write(&ffmpeg, format!("#!/bin/sh\n{script}\n")).unwrap();
        std::fs::set_permissions(&ffmpeg, std::fs::Permissions::from_mode(0o755)).unwrap();
        let command = "render run --frames 1 --size 8x6 --out video.mp4";
        let path = format!("{}:/usr/bin:/bin", place.path("").display());
        place.command(command).env("PATH", path).output().unwrap()
    };
    let output = with("echo ' V..... libvpx-vp9  VP9'");
    let expected = "video.mp4: needs libx264, which this ffmpeg lacks: install an ffmpeg that has it, or use .gif or \
                    .apng, which need no ffmpeg";
    complained_of("no encoder", &output, expected);
    assert!(!place.path("video.mp4.frames").exists());
    // The script fails after an error message and a long progress report.
    let output = with(
        "case $* in *-encoders*) echo ' V..... libx264 H.264';; *) echo 'the disk is full' >&2; sleep 0.3
         i=0; while [ $i -lt 20 ]; do echo frame=$i; i=$((i+1)); done; exit 3;; esac",
    );
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(said.contains("  the disk is full") && said.contains("`ffmpeg`: failed (exit code 3)"), "{said}");
}

#[cfg(unix)]
#[test]
fn interrupted_video_resumes() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 3 {SMALL}"));
    let arguments = "render run --frames 100 --size 24x20 --out video.apng";
    let frame = |i: usize| place.path(&format!("video.apng.frames/{i:04}.png"));
    let mut child = place.command(arguments).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    super::wait(&mut child, || frame(2).exists());
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(130), "{said}");
    assert!(said.contains("of 100 frames, in video.apng.frames: run the same command to resume"), "{said}");
    let done = place.json("video.apng.frames/unfinished.json")["done"].as_u64().unwrap() as usize;
    assert!(done >= 3 && frame(done - 1).exists() && !frame(done).exists() && !place.path("video.apng").exists());
    // Existing frames are not rendered again: a mark on one stays.
    let mark = Image { width: 24, height: 20, channels: 3, data: vec![0.2; 3 * 24 * 20] };
    mark.save_png(frame(1)).unwrap();
    let output = place.command(arguments).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(said.contains(&format!("resuming after {done} of 100 frames")), "{said}");
    let frames = decoded(&place.path("video.apng"));
    assert!(frames.len() == 100 && frames[1].iter().all(|x| *x == 51) && !place.path("video.apng.frames").exists());
    // The other frames equal those of an uninterrupted video.
    place.succeeds("render run --frames 100 --size 24x20 --out whole.apng");
    let whole = decoded(&place.path("whole.apng"));
    assert!((0..100).all(|i| (whole[i] == frames[i]) == (i != 1)));
    // A different video starts again, if it may overwrite.
    place.succeeds("render run --frames 2 --size 12x10 --out video.gif --keep-frames");
    let video = "render run --frames 4000 --size 24x20 --out video.gif";
    place.fails(video, &["video.gif: exists, and another command or other options made it"]);
    std::fs::remove_file(place.path("video.gif")).unwrap();
    place.fails(video, &["video.gif.frames"]);
    std::fs::remove_dir_all(place.path("video.gif.frames")).unwrap();
    let kept = |done: usize| {
        let mut record = place.json("video.gif.frames/unfinished.json");
        record["done"] = json!(done);
        std::fs::write(place.path("video.gif.frames/unfinished.json"), record.to_string()).unwrap();
    };
    let begun = |flags: &str| {
        // The folder belongs to this call after it was replaced.
        let _ = std::fs::remove_file(place.path("video.gif.frames/0003.png"));
        let mut child = place.command(&format!("{video} {flags}"));
        let mut child = child.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        super::wait(&mut child, || place.path("video.gif.frames/0003.png").exists());
        Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
        String::from_utf8(child.wait_with_output().unwrap().stderr).unwrap()
    };
    begun("");
    kept(3);
    let said = begun("--fps 5 --overwrite");
    assert!(said.contains("resuming after 3 of 4000 frames"), "the speed is not in the frames: {said}");
    for flags in ["--show depth", "--background black", "--fov 30", "--skip off"] {
        // From the same frames each time.
        begun("--overwrite");
        kept(3);
        place.fails(&format!("{video} {flags}"), &["video.gif.frames"]);
        let said = begun(&format!("{flags} --overwrite"));
        assert!(
            !said.contains("already") && said.contains("replacing 3 frames that were rendered with another"),
            "{said}"
        );
    }
    // The same command with another model.
    begun("--overwrite");
    kept(3);
    place.succeeds("train --resume run --steps 4");
    let said = begun("");
    assert!(said.contains("that were rendered with another config, model"), "{said}");
    // Only one at a time.
    let mut child = place.command("render run --frames 400 --size 36x30 --out slow.gif").stdout(Stdio::null()).spawn();
    let child = child.as_mut().unwrap();
    super::wait(child, || place.path("slow.gif.frames/0000.png").exists());
    place.fails(
        "render run --frames 400 --size 36x30 --out slow.gif",
        &["slow.gif.frames: another raygrad is rendering to it"],
    );
    child.kill().unwrap();
    child.wait().unwrap();
}

/// The frames of an APNG file, in bytes.
#[cfg(unix)]
fn decoded(path: &std::path::Path) -> Vec<Vec<u8>> {
    let bytes = std::fs::read(path).unwrap();
    let mut reader = png::Decoder::new(std::io::Cursor::new(&bytes[..])).read_info().unwrap();
    let count = reader.info().animation_control().unwrap().num_frames;
    let frame = |_| {
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut bytes).unwrap();
        bytes
    };
    (0..count).map(frame).collect()
}
