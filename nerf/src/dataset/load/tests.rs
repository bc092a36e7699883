use super::*;
use crate::dataset::capture::Format;
use crate::dataset::formats;
use crate::dataset::image::Image;
use crate::dataset::image_size::{same_shape, smaller_copy};
use crate::dataset::scene_type::SceneType;
use glam::DVec3;
use std::sync::Mutex;

/// A capture of images of 12 x 8 pixels with rising brightness; the third image is absent.
fn capture(folder: &Path, count: usize) -> Capture {
    let view = |i: usize| {
        let name = format!("images/{i:02}.png");
        let path = folder.join(&name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let data = (0..12 * 8 * 3).map(|k| ((k + i) % 200) as f32 / 255.0).collect();
        let image = Image { width: 12, height: 8, channels: 3, data };
        std::fs::write(&path, image.to_png()).unwrap();
        let eye = DVec3::new(i as f64, 3.0, 1.0);
        let camera = Camera::from_angle(24, 16, 0.8, Camera::look_at(eye, DVec3::ZERO, DVec3::Z));
        View {
            image: (i != 2).then_some(path),
            ..View::new(name, format!("frames[{i}]"), Camera { centre: [13.0, 7.0], ..camera })
        }
    };
    Capture::new(folder, folder.join("transforms.json"), Format::Transforms, (0..count).rev().map(view).collect())
}

fn numbers(views: &[&View]) -> Vec<String> {
    views.iter().map(|view| view.field.clone()).collect()
}

#[test]
fn every_eighth_image_is_held_out() {
    let folder = tempfile::tempdir().unwrap();
    let mut whole = capture(folder.path(), 17);
    whole.split_by_default();
    assert_eq!(numbers(&whole.split(Split::Test).unwrap()), ["frames[0]", "frames[8]", "frames[16]"]);
    assert_eq!(numbers(&whole.split(Split::Val).unwrap()), ["frames[0]", "frames[8]", "frames[16]"]);
    let train = numbers(&whole.split(Split::Train).unwrap());
    assert!(train.len() == 14 && train[0] == "frames[1]" && !train.contains(&"frames[8]".to_owned()), "{train:?}");
    // An absent image does not move others to another split.
    let mut lost = capture(folder.path(), 17);
    lost.views.iter_mut().find(|view| view.field == "frames[5]").unwrap().image = None;
    lost.split_by_default();
    assert_eq!(numbers(&lost.split(Split::Test).unwrap()), ["frames[0]", "frames[8]", "frames[16]"]);
    // The order of the images does not matter.
    assert!(!capture(folder.path(), 17).holds_out_every_eighth() && whole.holds_out_every_eighth());
    whole.views.rotate_left(3);
    assert!(whole.holds_out_every_eighth());
    whole.views[2].split = Some(Split::Test);
    assert!(!whole.holds_out_every_eighth());
    let mut one = capture(folder.path(), 1);
    one.views[0].split = Some(Split::Test);
    assert!(!one.holds_out_every_eighth(), "there is nothing to hold it out of");
    let mut few = capture(folder.path(), 2);
    few.split_by_default();
    assert!(few.split(Split::Test).is_err() && few.split(Split::Train).unwrap().len() == 2);
    // With a training list alone, all others become test images; with more lists, nothing is added.
    let mut listed = capture(folder.path(), 4);
    listed.views[1].split = Some(Split::Train);
    listed.split_by_default();
    assert_eq!(listed.split(Split::Test).unwrap().len(), 3);
    let mut listed = capture(folder.path(), 4);
    listed.views[1].split = Some(Split::Test);
    listed.split_by_default();
    assert_eq!(listed.split(Split::Train).unwrap().len(), 3, "and the reverse");
    // Views of one image are in one split.
    let mut twice = capture(folder.path(), 17);
    (twice.views[0].image, twice.views[0].name) = (twice.views[16].image.clone(), "images/99.png".into());
    twice.split_by_default();
    twice.check_splits().unwrap();
    assert_eq!(numbers(&twice.split(Split::Test).unwrap()), ["frames[0]", "frames[8]", "frames[16]"]);
    assert!(twice.holds_out_every_eighth());
    let mut both = capture(folder.path(), 4);
    (both.views[1].split, both.views[2].split) = (Some(Split::Train), Some(Split::Val));
    both.split_by_default();
    assert_eq!((both.split(Split::Test).unwrap().len(), both.split(Split::Train).unwrap().len()), (1, 1));
}

#[test]
fn image_in_two_splits_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 17);
    capture.split_by_default();
    capture.check_splits().unwrap();
    let analysis = capture.analyze_scene(None).unwrap();
    let names = |split: Split| {
        let data = capture.load(split, &analysis, &LoadOptions::default()).unwrap();
        data.frames.into_iter().map(|frame| frame.name).collect::<Vec<_>>()
    };
    let (train, test) = (names(Split::Train), names(Split::Test));
    assert!(!test.is_empty() && test.iter().all(|name| !train.contains(name)));
    let image = capture.views.iter().find(|view| view.field == "frames[8]").unwrap().image.clone();
    capture.views.iter_mut().find(|view| view.field == "frames[3]").unwrap().image = image;
    let message = capture.check_splits().unwrap_err().to_string();
    assert!(message.contains("frames[8]") && message.contains("frames[3]"), "{message}");
}

#[test]
fn cameras_scale_with_their_images() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 9);
    capture.split_by_default();
    let analysis = capture.analyze_scene(None).unwrap();
    let seen = Mutex::new(vec![]);
    let progress = |done: usize, total: usize| seen.lock().unwrap().push((done, total));
    let reading = LoadOptions { downscale: 5, views: 3, progress: &progress, ..LoadOptions::default() };
    let data = capture.load(Split::Train, &analysis, &reading).unwrap();
    assert_eq!((data.frames.len(), &data.skipped[..]), (3, &["images/02.png".to_owned()][..]));
    let frame = &data.frames[0];
    let view = capture.views.iter().find(|view| view.name == frame.name).unwrap();
    // 12 / 5 and 8 / 5, rounded; the camera has the size 24 x 16.
    assert_eq!([frame.image.width, frame.image.height, frame.camera.width, frame.camera.height], [2, 2, 2, 2]);
    assert!((frame.camera.centre[0] - 13.0 / 12.0).abs() < 1e-12 && (frame.camera.centre[1] - 7.0 / 8.0).abs() < 1e-12);
    assert!((frame.camera.focal[0] - view.camera.focal[0] / 12.0).abs() < 1e-12);
    let eye = analysis.transform.point(view.camera.pose.translation);
    assert!(frame.camera.pose.translation.distance(eye) < 1e-12 && data.transform == analysis.transform);
    assert_eq!(seen.lock().unwrap().iter().max(), Some(&(3, 3)));
    let full = capture.load(Split::Train, &analysis, &LoadOptions::default()).unwrap();
    assert_eq!(full.frames[0].image.bytes(), 12 * 8 * 3);
    for (name, wrong) in [
        ("views", LoadOptions { views: 0, ..LoadOptions::default() }),
        ("downscale", LoadOptions { downscale: 0, ..LoadOptions::default() }),
    ] {
        let message = capture.load(Split::Train, &analysis, &wrong).unwrap_err().to_string();
        assert!(message.starts_with(&format!("`{name}`")), "{message}");
    }
}

#[test]
fn image_of_other_shape_than_camera_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 9);
    capture.split_by_default();
    let analysis = capture.analyze_scene(None).unwrap();
    for name in ["03", "05"] {
        let image = Image::new(13, 8, 3);
        std::fs::write(folder.path().join(format!("images/{name}.png")), image.to_png()).unwrap();
    }
    let message = capture.load(Split::Train, &analysis, &LoadOptions::default()).unwrap_err().to_string();
    assert!(
        message.contains("frames[3]") && message.contains("03.png: has 13x8 pixels") && message.contains("24x16"),
        "{message}"
    );
    let camera = |width: usize, height: usize| Camera { width, height, ..capture.views[0].camera.clone() };
    for (size, of, fits) in [
        ([24, 24], [24, 24], true),
        ([24, 25], [24, 24], false),
        ([1000, 750], [4000, 3000], true),
        ([1001, 750], [4000, 3000], false),
        ([333, 250], [4000, 3000], true),
        ([750, 1000], [4000, 3000], false),
        ([270, 480], [1080, 1920], true),
        ([360, 270], [1440, 1083], true),
        ([361, 270], [1440, 1083], false),
        ([120, 67], [1440, 815], true),
        ([120, 66], [1440, 815], false),
        ([360, 2], [1440, 11], true),
    ] {
        assert_eq!(same_shape(size, &camera(of[0], of[1])), fits, "{size:?} for {of:?}");
    }
}

#[test]
fn downscaled_image_folders_are_used() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 4);
    capture.split_by_default();
    std::fs::create_dir(folder.path().join("images_4")).unwrap();
    let small = Image { width: 3, height: 2, channels: 3, data: vec![1.0; 18] };
    std::fs::write(folder.path().join("images_4/01.png"), small.to_png()).unwrap();
    let analysis = capture.analyze_scene(None).unwrap();
    let data = capture.load(Split::Train, &analysis, &LoadOptions { downscale: 4, ..LoadOptions::default() }).unwrap();
    assert!(data.frames[0].name == "images/01.png" && data.frames[0].image.to_image() == small);
    assert_eq!([data.frames[1].image.width, data.frames[1].image.height], [3, 2]);
    // A copy in another format, unless it is that of another image.
    let [own, other] = ["images/03.png", "images/03.jpg"].map(|name| folder.path().join(name));
    let copy = folder.path().join("images_4/03.jpg");
    std::fs::write(&copy, "").unwrap();
    let smaller = |own: &Path, folder: &Path| smaller_copy(folder, own, own.strip_prefix(folder).unwrap(), 4);
    assert_eq!(smaller(&own, folder.path()), Some(copy));
    std::fs::write(other, "").unwrap();
    assert_eq!(smaller(&own, folder.path()), None);
    assert_eq!(smaller(Path::new("images/scene/01.png"), Path::new("images/scene")), None);
}

#[test]
fn downscaled_images_of_another_size_are_not_used() {
    let folder = tempfile::tempdir().unwrap();
    let capture = capture(folder.path(), 4);
    std::fs::create_dir(folder.path().join("images_4")).unwrap();
    let view = &capture.views[0];
    let (image, camera) = (view.image.clone().unwrap(), &view.camera);
    let name = image.file_name().unwrap();
    let copy = folder.path().join("images_4").join(name);
    let [w, h] = Header::read(&image).unwrap().sizes[0];
    let factor = || made_smaller(folder.path(), &image, camera, 4).unwrap();
    // Half the right size; turned, as by ffmpeg, which leaves out the orientation; and no image.
    for (width, height, is_used) in [(w / 4, h / 4, true), (w / 8, h / 8, false), (h / 4, w / 4, false), (0, 0, false)]
    {
        let pixels = Image { width, height, channels: 3, data: vec![1.0; 3 * width * height] };
        std::fs::write(&copy, if width > 0 { pixels.to_png() } else { vec![] }).unwrap();
        let (path, _, size, rest) = factor();
        let expected = if is_used { (copy.clone(), [width, height], 1) } else { (image.clone(), [w, h], 4) };
        assert_eq!((path, size, rest), expected, "{width}x{height}");
    }
    // The capture itself lists downscaled images.
    let listed = folder.path().join("images_4").join(name);
    std::fs::copy(&image, &listed).unwrap();
    assert_eq!(made_smaller(folder.path(), &listed, camera, 8).unwrap().3, 2);
    assert_eq!(made_smaller(folder.path(), &listed, camera, 4).unwrap().3, 1);
}

#[test]
fn masks_drop_black_and_unlit_pixels() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 4);
    capture.split_by_default();
    let path = folder.path().join("mask.png");
    let mut mask = Image { width: 24, height: 16, channels: 1, data: vec![1.0; 24 * 16] };
    mask.pixel_mut(9, 2)[0] = 0.0;
    std::fs::write(&path, mask.to_png()).unwrap();
    capture.views.iter_mut().for_each(|view| view.mask = Some(path.clone()));
    let analysis = capture.analyze_scene(None).unwrap();
    let data = capture.load(Split::Train, &analysis, &LoadOptions::default()).unwrap();
    let used = data.frames[0].mask.as_ref().unwrap();
    assert!(used.used() == 12 * 8 - 1 && !used.uses(4, 1), "one pixel, at half the size");
    for (size, fits) in [([24, 16], true), ([6, 4], true), ([5, 3], true), ([16, 24], false), ([6, 6], false)] {
        std::fs::write(
            &path,
            Image { width: size[0], height: size[1], channels: 1, data: vec![1.0; size[0] * size[1]] }.to_png(),
        )
        .unwrap();
        let read = capture.load(Split::Train, &analysis, &LoadOptions::default());
        assert_eq!(read.is_ok(), fits, "{size:?}");
        let expected = format!("mask.png: has {}x{} pixels but its image 12x8; use one aspect ratio", size[0], size[1]);
        assert!(read.err().is_none_or(|e| e.to_string().contains(&expected)));
    }
    // Sides are rounded.
    assert!(mask_fits([1334, 1000], [333, 250]) && mask_fits([333, 250], [1334, 1000]));
    assert!(!mask_fits([1334, 1010], [333, 250]) && !mask_fits([333, 252], [1334, 1000]));
    // A mask of half the size hides the pixels that its black one covers, and those that it touches.
    let mut mask = Image { width: 6, height: 4, channels: 1, data: vec![1.0; 24] };
    mask.pixel_mut(2, 1)[0] = 0.0;
    std::fs::write(&path, mask.to_png()).unwrap();
    let data = capture.load(Split::Train, &analysis, &LoadOptions::default()).unwrap();
    let used = data.frames[0].mask.as_ref().unwrap();
    let hidden = (0..96).map(|i| [i % 12, i / 12]).filter(|[x, y]| !used.uses(*x, *y)).collect::<Vec<_>>();
    assert!([[4, 2], [5, 2], [4, 3], [5, 3]].iter().all(|pixel| hidden.contains(pixel)), "{hidden:?}");
    assert!(hidden.iter().all(|[x, y]| (2..8).contains(x) && (0..6).contains(y)), "{hidden:?}");
    std::fs::write(&path, Image::new(24, 16, 1).to_png()).unwrap();
    let message = capture.load(Split::Train, &analysis, &LoadOptions::default()).unwrap_err().to_string();
    assert!(message.contains("has no usable pixel"), "{message}");
    // Half a turn is 31.4 pixels from the centre of a fisheye with the focal length 10.
    let lens = Lens::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] };
    let camera =
        Camera { width: 100, height: 60, focal: [10.0; 2], centre: [50.0, 30.0], lens, pose: DAffine3::IDENTITY };
    let lit = Lit::default();
    let mask = lit.of(&camera).unwrap();
    for (x, y) in (0..100).flat_map(|x| (0..60).map(move |y| (x, y))) {
        let r = f64::hypot(x as f64 - 49.5, y as f64 - 29.5);
        assert_eq!(mask.uses(x, y), r <= 10.0 * std::f64::consts::PI, "{x} {y}");
    }
    let moved = Camera { pose: DAffine3::from_translation(DVec3::X), ..camera.clone() };
    assert!(Arc::ptr_eq(&mask, &lit.of(&moved).unwrap()), "one for each camera, wherever it stands");
    assert!(lit.of(&Camera { focal: [40.0; 2], ..camera }).is_none());
}

#[test]
fn turned_photos_follow_the_size_of_their_camera_in_every_format() {
    let write_transforms = |folder: &Path, [w, h]: [usize; 2], centre: Option<[f64; 2]>| {
        let pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4]];
        let frames = serde_json::json!([{ "file_path": "images/0.jpg", "transform_matrix": pose }]);
        let mut document = serde_json::json!({ "fl_x": 20, "frames": frames });
        if w > 0 {
            (document["w"], document["h"]) = (w.into(), h.into());
        }
        if let Some([x, y]) = centre {
            (document["cx"], document["cy"]) = (x.into(), y.into());
        }
        std::fs::write(folder.join("transforms.json"), document.to_string()).unwrap();
    };
    let transforms = |folder: &Path, size: [usize; 2]| write_transforms(folder, size, None);
    let capture = |folder: &Path, [w, h]: [usize; 2], format: Format| {
        let pose = Camera::look_at(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, DVec3::Z);
        let image = Some(folder.join("images/0.jpg"));
        let view =
            View { image, bounds: Some([1.0, 2.0]), ..View::new("0.jpg", "0", Camera::from_angle(w, h, 0.8, pose)) };
        Capture::new(folder, folder.join("capture"), format, vec![view])
    };
    let colmap = |folder: &Path, size: [usize; 2]| {
        let encoding = formats::colmap::Encoding::Binary;
        formats::colmap::write(&capture(folder, size, Format::Colmap), folder, encoding).unwrap();
    };
    let llff = |folder: &Path, size: [usize; 2]| {
        formats::llff::write(&capture(folder, size, Format::Llff), folder).unwrap();
    };
    // The size of the camera, and the corner with the white quarter, if the image is turned as 6 asks or not.
    let sized = [([16, 8], 0), ([8, 16], 1), ([32, 16], 0), ([16, 32], 1)];
    let without = [([0, 0], 0)];
    type Writer<'a> = &'a dyn Fn(&Path, [usize; 2]);
    let formats: [(Writer<'_>, Vec<_>); 3] =
        [(&transforms, sized.into_iter().chain(without).collect()), (&colmap, sized.to_vec()), (&llff, sized.to_vec())];
    for (format, (write, cases)) in formats.into_iter().enumerate() {
        for (size, corner) in cases {
            let folder = tempfile::tempdir().unwrap();
            std::fs::create_dir(folder.path().join("images")).unwrap();
            std::fs::write(folder.path().join("images/0.jpg"), crate::dataset::photo::tests::jpeg(6)).unwrap();
            write(folder.path(), size);
            let capture = Capture::read(folder.path()).unwrap();
            let camera = &capture.views[0].camera;
            assert_eq!([camera.width, camera.height], if size == [0, 0] { [16, 8] } else { size });
            let note = "1 images have an EXIF orientation but no `w` and `h`, such as `images/0.jpg`: used their \
                        pixels as stored; give the width and height of the turned images to turn them";
            assert_eq!(capture.assumptions, if size == [0, 0] { vec![note] } else { vec![] });
            let photo = capture.photo(&capture.views[0]).unwrap();
            let [w, h] = [photo.width, photo.height];
            let seen = [[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]].map(|[x, y]| photo.pixel(x, y)[0] > 0.5);
            assert_eq!(seen, [0, 1, 2, 3].map(|i| i == corner), "format {format}, {size:?}");
            let plan = Plan::new(&capture, &capture.views[0], LoadOptions::default()).unwrap();
            assert_eq!([plan.size, [w, h]], [if corner == 0 { [16, 8] } else { [8, 16] }; 2]);
        }
    }
    // Without a size, the principal point decides.
    for (centre, size, notes) in
        [([4.0, 8.0], [8, 16], 0), ([4.6, 6.9], [8, 16], 0), ([8.1, 3.8], [16, 8], 0), ([6.0, 6.0], [16, 8], 1)]
    {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("images")).unwrap();
        std::fs::write(folder.path().join("images/0.jpg"), crate::dataset::photo::tests::jpeg(6)).unwrap();
        write_transforms(folder.path(), [0, 0], Some(centre));
        let capture = Capture::read(folder.path()).unwrap();
        let camera = &capture.views[0].camera;
        assert_eq!(([camera.width, camera.height], camera.centre), (size, centre));
        assert_eq!(capture.assumptions.len(), notes, "{centre:?}");
        let photo = capture.photo(&capture.views[0]).unwrap();
        assert_eq!([photo.width, photo.height], size);
    }
}

#[test]
fn dynamic_masks_use_only_their_black_pixels() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 4);
    capture.split_by_default();
    let path = folder.path().join("mask.png");
    let save = |channels: usize, pixels: &[([usize; 2], &[f32])]| {
        let mut mask = Image::new(12, 8, channels);
        pixels.iter().for_each(|(at, value)| mask.pixel_mut(at[0], at[1]).copy_from_slice(value));
        mask.save_png(&path).unwrap();
    };
    capture.views.iter_mut().for_each(|view| (view.mask, view.mask_is_dynamic) = (Some(path.clone()), true));
    let analysis = capture.analyze_scene(None).unwrap();
    let unused = |options: &LoadOptions<'_>| {
        let frame = capture.load(Split::Train, &analysis, options).unwrap().frames.swap_remove(0);
        let used = frame.mask.unwrap();
        let [width, height] = used.size();
        let all = (0..height).flat_map(|y| (0..width).map(move |x| [x, y]));
        all.filter(|[x, y]| !used.uses(*x, *y)).collect::<Vec<_>>()
    };
    let options = LoadOptions::default();
    // Any value above 0 in any colour, also where it is transparent.
    save(3, &[([3, 2], &[1.0; 3]), ([4, 2], &[0.0, 0.0, 0.004]), ([7, 7], &[0.0, 0.5, 0.0])]);
    assert_eq!(unused(&options), [[3, 2], [4, 2], [7, 7]]);
    assert_eq!(unused(&LoadOptions { downscale: 2, ..options }), [[1, 1], [2, 1], [3, 3]], "no part of a pixel");
    save(1, &[([0, 0], &[0.004])]);
    assert_eq!(unused(&options), [[0, 0]], "a mask of small values is none of object numbers");
    save(4, &[([5, 1], &[1.0, 1.0, 1.0, 0.0]), ([6, 1], &[1.0; 4])]);
    assert_eq!(unused(&options), [[5, 1], [6, 1]]);
    let to = capture.views[0].camera_of_image().unwrap();
    let undistorted = capture.views[0].seen_by(&to).unwrap().1.unwrap();
    let black = undistorted.data.iter().enumerate().filter(|(_, value)| **value == 0.0).map(|(i, _)| [i % 12, i / 12]);
    assert!(black.clone().count() > 0 && black.clone().all(|[x, y]| (4..8).contains(&x) && y < 3), "around two pixels");
    // They cut out no object: moving people would become empty space.
    let alpha = LoadOptions { mask_as_alpha: true, ..options };
    let message = capture.load(Split::Train, &analysis, &alpha).unwrap_err().to_string();
    assert!(message.contains("has no mask to cut out the object"), "{message}");
    for view in capture.present() {
        Image { data: vec![1.0; 12 * 8 * 4], ..Image::new(12, 8, 4) }.save_png(view.image.as_ref().unwrap()).unwrap();
    }
    assert_eq!(unused(&alpha), [[5, 1], [6, 1]]);
    assert_eq!(capture.cutout(&capture.views[0]).unwrap().transparent_share(), 0.0);
    save(3, &[]);
    assert_eq!(unused(&options).len(), 0);
}

#[test]
fn masks_as_alpha_cut_out_the_object() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 4);
    capture.split_by_default();
    let path = folder.path().join("mask.png");
    // White on the left, a grey column, black on the right.
    let value = |x: usize| [1.0, 0.4, 0.0][usize::from(x >= 6) + usize::from(x >= 7)];
    let data: Vec<f32> = (0..96).map(|i| value(i % 12)).collect();
    std::fs::write(&path, Image { width: 12, height: 8, channels: 1, data }.to_png()).unwrap();
    capture.views.iter_mut().for_each(|view| view.mask = Some(path.clone()));
    let analysis = capture.analyze_cutout(None).unwrap();
    assert_eq!((analysis.scene_type, &analysis.reason[..25]), (SceneType::Bounded, "masks cut out an object; "));
    // Masks that are inverted leave a border in place of an object.
    let inverted = folder.path().join("inverted.png");
    let inside = |i: usize| (3..9).contains(&(i % 12)) && (2..6).contains(&(i / 12));
    let data = (0..96).map(|i| if inside(i) { 0.0 } else { 1.0 }).collect();
    std::fs::write(&inverted, Image { width: 12, height: 8, channels: 1, data }.to_png()).unwrap();
    let mut wrong = capture.clone();
    wrong.views.iter_mut().for_each(|view| view.mask = Some(inverted.clone()));
    assert_eq!([&wrong, &capture].map(|capture| capture.analyze_cutout(None).unwrap().hollow), [true, false]);
    assert_eq!(capture.analyze_cutout(Some(SceneType::Unbounded)).unwrap().scene_type, SceneType::Unbounded);
    assert_ne!(capture.analyze_scene(None).unwrap().scene_type, SceneType::Bounded);
    let options = LoadOptions { mask_as_alpha: true, ..LoadOptions::default() };
    let data = capture.load(Split::Train, &analysis, &options).unwrap();
    let frame = &data.frames[0];
    assert!(data.has_alpha() && frame.mask.is_none());
    let view = capture.views.iter().find(|view| view.name == frame.name).unwrap();
    let plain = capture.photo(view).unwrap();
    for (x, y) in (0..12).flat_map(|x| (0..8).map(move |y| (x, y))) {
        let [r, g, b, _] = plain.pixel(x, y);
        assert_eq!(frame.image.pixel(x, y), [r, g, b, value(x)], "{x} {y}");
    }
    assert_eq!(capture.cutout(view).unwrap(), frame.image);
    // Colours of the background do not bleed: the new pixel has those of its white and grey half.
    let small = capture.load(Split::Train, &analysis, &LoadOptions { downscale: 4, ..options }).unwrap();
    let pixel = small.frames[0].image.pixel(1, 0);
    let place = |x: usize, y: usize| plain.pixel(x, y)[0] * value(x);
    let sum: f32 = (0..4).flat_map(|y| (4..8).map(move |x| (x, y))).map(|(x, y)| place(x, y)).sum();
    assert!((pixel[3] - 2.4 / 4.0).abs() < 3e-3 && (pixel[0] - sum / (4.0 * 2.4)).abs() < 3e-3, "{pixel:?}");
    // The mask of the lens stays.
    let lens = Lens::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] };
    let mut wide = capture.clone();
    for view in &mut wide.views {
        (view.camera.lens, view.camera.focal, view.camera.centre) = (lens, [2.0; 2], [12.0, 8.0]);
    }
    let used = wide.load(Split::Train, &analysis, &options).unwrap().frames[0].mask.clone().unwrap();
    assert!(!used.uses(0, 0) && used.uses(8, 4), "black in the mask, but seen");
    // An image without a mask would show the background that others cut out, unless it is transparent itself.
    let bare = capture.views.iter_mut().find(|view| view.field == "frames[3]").unwrap();
    (bare.mask, bare.split) = (None, Some(Split::Train));
    let own = bare.image.clone().unwrap();
    let message = capture.load(Split::Train, &analysis, &options).unwrap_err().to_string();
    let expected =
        "03.png: has no mask to cut out the object, and no transparency: add its mask, or use masks to ignore";
    assert!(message.contains("frames[3]") && message.contains(expected), "{message}");
    std::fs::write(own, Image::new(12, 8, 4).to_png()).unwrap();
    assert!(capture.load(Split::Train, &analysis, &options).is_ok());
}

#[test]
fn alpha_and_bits_that_say_nothing_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 9);
    capture.split_by_default();
    let analyze = |pixel: &dyn Fn(usize) -> [u16; 4]| {
        let values: Vec<u16> = (0..12 * 8).flat_map(pixel).collect();
        let image = image::ImageBuffer::<image::Rgba<u16>, _>::from_raw(12, 8, values).unwrap();
        capture.present().for_each(|view| image.save(view.image.as_ref().unwrap()).unwrap());
        capture.analyze_scene(None).map(|analysis| analysis.scene_type).map_err(|error| error.to_string())
    };
    let whole = u16::MAX;
    for alpha in [0, whole / 2] {
        let message = analyze(&|i| [9 * i as u16, 9000, 50000, alpha]).unwrap_err();
        assert!(message.contains("in every pixel") && message.contains("remove the alpha channel"), "{message}");
    }
    for (bits, factor) in [(8, 257), (10, 64), (12, 16)] {
        let message = analyze(&|_| [(1 << bits) - 1, 3, 1, whole]).unwrap_err();
        assert!(message.contains(&format!("no value above {} of 65535", (1 << bits) - 1)), "{message}");
        assert!(message.ends_with(&format!("multiply all values by {factor}")), "{message}");
    }
    let opaque = |i: usize| [9 * i as u16, 9000, 50000, 65279];
    assert_eq!(analyze(&opaque).unwrap(), SceneType::Unbounded, "254 of 255 is a rounding error");
    assert_eq!(analyze(&|i| [5000, 0, 0, if i < 40 { 0 } else { whole / 2 }]).unwrap(), SceneType::Bounded);
    assert_eq!(analyze(&|_| [1 << 12, 0, 0, whole]).unwrap(), SceneType::Unbounded, "13 bits may be a dark image");
    assert_eq!(analyze(&|_| [0, 0, 0, whole]).unwrap(), SceneType::Unbounded, "black images have no bits");
    assert_eq!(analyze(&|_| [whole; 4]).unwrap(), SceneType::Bounded, "opaque alpha changes nothing of white");
}

#[test]
fn object_in_front_of_white_is_bounded() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 9);
    capture.split_by_default();
    let paint = |border: f32, spoilt: usize| {
        for (i, view) in capture.views.iter().enumerate() {
            let mut image = Image::new(12, 8, 3);
            image.data.iter_mut().enumerate().for_each(|(k, value)| {
                let (x, y) = (k / 3 % 12, k / 36);
                let is_border = x == 0 || y == 0 || x == 11 || y == 7;
                // A little darker than white in one channel, as after JPEG compression.
                *value = if is_border { border - 0.02 * (k % 3 / 2) as f32 } else { 0.3 };
            });
            if i < spoilt {
                // One of the 36 border pixels.
                image.data[3 * 11] = 0.5;
            }
            std::fs::write(
                folder.path().join(format!("images/{:02}.png", view.field[7..8].parse::<u8>().unwrap())),
                image.to_png(),
            )
            .unwrap();
        }
        capture.analyze_scene(None).unwrap()
    };
    let white = paint(1.0, 0);
    assert_eq!((white.scene_type, &white.reason[..36]), (SceneType::Bounded, "images show an object before white; "));
    assert_eq!(paint(0.9, 0).scene_type, SceneType::Unbounded);
    assert_eq!(paint(1.0, 9).scene_type, SceneType::Unbounded, "a spot on the border of each");
    // All of the three images read must have a white border.
    assert_eq!(paint(1.0, 3).scene_type, SceneType::Unbounded);
}

#[test]
fn distances_are_read_if_requested() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 9);
    capture.split_by_default();
    let path = folder.path().join("depth.png");
    image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(12, 8, image::Luma([500])).save(&path).unwrap();
    let measured = capture.views.iter_mut().find(|view| view.field == "frames[3]").unwrap();
    measured.depth = Some((path, 0.01));
    let analysis = capture.analyze_scene(None).unwrap();
    let read = |distances| {
        let reading = LoadOptions { distances, ..LoadOptions::default() };
        capture.load(Split::Train, &analysis, &reading).unwrap()
    };
    assert!(read(false).frames.iter().all(|frame| frame.distances.is_none()));
    let data = read(true);
    data.check_distances(true).unwrap();
    for frame in &data.frames {
        let Some(found) = &frame.distances else { continue };
        assert_eq!((frame.name.as_str(), [found.width, found.height]), ("images/03.png", [12, 8]));
        // A depth of 5 in units of the capture.
        let place = frame.camera.ray(1.5, 2.5).at(f64::from(found.data[2 * 12 + 1]));
        let depth = -frame.camera.pose.inverse().transform_point3(place).z / analysis.transform.scale;
        assert!((depth - 5.0).abs() < 1e-5, "{depth}");
    }
    assert_eq!(data.frames.iter().filter(|frame| frame.distances.is_some()).count(), 1);
}

#[test]
fn unlit_pixels_are_dropped_with_or_without_mask() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 4);
    capture.split_by_default();
    // Half a turn is 3.14 of the 12 x 8 pixels from the centre; the camera has the size 24 x 16.
    let lens = Lens::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] };
    for view in &mut capture.views {
        (view.camera.lens, view.camera.focal, view.camera.centre) = (lens, [2.0; 2], [12.0, 8.0]);
    }
    let analysis = capture.analyze_scene(Some(SceneType::Bounded)).unwrap();
    let lit = |x: usize, y: usize| f64::hypot(x as f64 - 5.5, y as f64 - 3.5) <= std::f64::consts::PI;
    let check = |capture: &Capture, hidden: Option<[usize; 2]>| {
        let data = capture.load(Split::Train, &analysis, &LoadOptions::default()).unwrap();
        let mask = data.frames[0].mask.as_ref().unwrap();
        for (x, y) in (0..12).flat_map(|x| (0..8).map(move |y| (x, y))) {
            assert_eq!(mask.uses(x, y), lit(x, y) && hidden != Some([x, y]), "{x} {y} {hidden:?}");
        }
    };
    check(&capture, None);
    let path = folder.path().join("mask.png");
    let mut mask = Image { width: 12, height: 8, channels: 1, data: vec![1.0; 12 * 8] };
    mask.pixel_mut(5, 3)[0] = 0.0;
    std::fs::write(&path, mask.to_png()).unwrap();
    capture.views.iter_mut().for_each(|view| view.mask = Some(path.clone()));
    check(&capture, Some([5, 3]));
}

#[test]
fn images_beyond_the_memory_are_refused_before_decoding() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 9);
    capture.split_by_default();
    let analysis = capture.analyze_scene(Some(SceneType::Bounded)).unwrap();
    // A large image in a small file. Most of its pixels are not there, so decoding it would fail.
    let huge = folder.path().join("images/huge.png");
    let mut bytes = Image::new(16_384, 16_384, 1).to_png();
    bytes.truncate(100);
    bytes.resize(1 << 16, 0);
    std::fs::write(&huge, bytes).unwrap();
    for view in capture.views.iter_mut().filter(|view| view.image.is_some()) {
        view.image = Some(huge.clone());
        view.camera = Camera::from_angle(24, 24, 0.8, view.camera.pose);
        view.split = Some(Split::Train);
    }
    let load = |memory: u64, downscale: usize| {
        let options = LoadOptions { memory: Some(memory), downscale, ..LoadOptions::default() };
        capture.load(Split::Train, &analysis, &options).unwrap_err().to_string()
    };
    // 8 images of 2^28 pixels with three bytes, and one decoded with one byte more.
    let message = load(4_000_000_000, 1);
    assert!(message.contains("transforms.json: 8 images need 7.5 GB of memory, but 4.0 GB are free"), "{message}");
    assert!(message.ends_with("a downscale of 2 needs 2.7 GB"), "{message}");
    let message = load(1_100_000_000, 2);
    assert!(
        message.contains("need 2.7 GB of memory, but 1.1 GB") && message.ends_with("of 16 needs 1.1 GB"),
        "{message}"
    );
    assert!(load(500_000_000, 1).ends_with("use smaller images, or fewer"));
    // With enough memory they are decoded, which fails here.
    let message = load(1 << 40, 1);
    assert!(message.contains("huge.png") && message.contains("cannot be decoded"), "{message}");
}

#[test]
fn little_memory_loads_the_same_images_in_turns() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 9);
    capture.split_by_default();
    let analysis = capture.analyze_scene(Some(SceneType::Bounded)).unwrap();
    let load = |memory: u64| {
        let options = LoadOptions { memory: Some(memory), ..LoadOptions::default() };
        capture.load(Split::Train, &analysis, &options)
    };
    let all = load(1 << 40).unwrap();
    // Images of 12 x 8 pixels with 3 bytes, and one more that is decoded.
    let least = (all.frames.len() as u64 + 1) * 3 * 12 * 8;
    assert_eq!(load(least).unwrap(), all);
    assert!(load(least - 1).is_err());
}

#[test]
fn plan_counts_the_mask_and_the_depths() {
    let folder = tempfile::tempdir().unwrap();
    let capture = capture(folder.path(), 1);
    let mut view = capture.views[0].clone();
    let plan = |view: &View, distances: bool| {
        let plan = Plan::new(&capture, view, LoadOptions { distances, ..LoadOptions::default() }).unwrap();
        (plan.decoding, plan.loaded())
    };
    let pixels = 12 * 8;
    assert_eq!(plan(&view, true), (3 * pixels, 3 * pixels));
    // A grey mask is converted to RGB.
    let [mask, depth] = ["mask.png", "depth.npy"].map(|name| folder.path().join(name));
    std::fs::write(&mask, Image::new(24, 16, 1).to_png()).unwrap();
    view.mask = Some(mask);
    let resampled = 3 * pixels;
    let masked = 3 * pixels + 4 * 24 * 16;
    assert_eq!(plan(&view, true), (masked + resampled, 4 * pixels));
    // As alpha it is applied to the image before downscaling, and no mask is left.
    let options = LoadOptions { mask_as_alpha: true, downscale: 2, ..LoadOptions::default() };
    let cut = Plan::new(&capture, &view, options).unwrap();
    assert_eq!((cut.decoding, cut.loaded()), (masked + resampled + 4 * pixels, 4 * pixels / 4));
    // Depths are the file and twice as much in f64.
    let header = b"\x93NUMPY".to_vec();
    std::fs::write(&depth, [header, vec![0; 1000]].concat()).unwrap();
    view.depth = Some((depth, 1.0));
    assert_eq!(plan(&view, false), (masked + resampled, 4 * pixels));
    assert_eq!(plan(&view, true), (masked + resampled + 3 * 1006, 8 * pixels));
    assert_eq!(view.decoding_memory(), masked + 3 * 1006);
}

#[test]
fn transparent_pixels_of_a_mask_are_black_at_each_size() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mask.png");
    // White everywhere, with the shape in alpha.
    let mut mask = Image { width: 8, height: 8, channels: 4, data: vec![1.0; 8 * 8 * 4] };
    (0..4).for_each(|y| (0..8).for_each(|x| mask.pixel_mut(x, y)[3] = 0.0));
    mask.save_png(&path).unwrap();
    let view = View { mask: Some(path), ..View::new("", "", Camera::from_angle(16, 16, 0.8, DAffine3::IDENTITY)) };
    for side in [8, 4, 16] {
        let mask = used_pixels(&view, [16, 16], [side; 2]).unwrap().unwrap();
        assert!(!mask.uses(side / 2, 0) && mask.uses(side / 2, side - 1), "{side}");
    }
}

#[test]
fn brightest_value_of_a_mask_is_white() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mask.png");
    let view =
        View { mask: Some(path.clone()), ..View::new("", "", Camera::from_angle(3, 1, 0.8, DAffine3::IDENTITY)) };
    let read = |channels: usize, values: &[u8]| {
        let data = values.iter().map(|value| f32::from(*value) / 255.0).collect();
        Image { width: 3, height: 1, channels, data }.save_png(&path).unwrap();
        let mask = view.mask_photo(None).map_err(|error| error.to_string())?;
        Ok::<_, String>(mask.unwrap().pixels().map(|pixel| (255.0 * pixel[0]).round() as u8).collect::<Vec<_>>())
    };
    // One value besides black, of any channel and size, is white.
    for value in [1, 40, 128, 200, 255] {
        assert_eq!(read(1, &[0, value, value]).unwrap(), [0, 255, 255], "{value}");
        assert_eq!(read(3, &[0, 0, 0, 0, value, 9, 0, value, 9]).unwrap(), [0, 255, 255], "{value}");
        assert_eq!(read(4, &[9, 9, 9, 0, 0, value, 0, 255, 0, 0, 0, 255]).unwrap(), [0, 255, 0], "{value}");
    }
    assert_eq!(read(1, &[0, 0, 0]).unwrap(), [0; 3]);
    assert_eq!(read(1, &[0, 120, 240]).unwrap(), [0, 128, 255]);
    // One value alone hides nothing, as the mask of an image that an object fills.
    for value in [1, 128, 240] {
        assert_eq!(read(1, &[value; 3]).unwrap(), [255; 3], "{value}");
    }
    // Numbers of objects do not say which pixels to use.
    for values in [[0, 1, 2], [0, 100, 200], [1, 2, 2]] {
        let message = read(1, &values).unwrap_err();
        assert!(message.contains("mask.png: has no white, and not one value besides black: write 255"), "{message}");
    }
    // Colours of objects neither, whether bright or not.
    for value in [128, 255] {
        assert!(read(3, &[0, 0, 0, value, 0, 0, 0, value, 0]).is_err(), "{value}");
    }
    assert_eq!(read(3, &[0, 0, 0, 120, 118, 121, 255, 250, 252]).unwrap(), [0, 121, 255], "colours of JPEG");
}

#[test]
fn masks_without_white_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 4);
    capture.split_by_default();
    let path = folder.path().join("mask.png");
    let analysis = capture.analyze_scene(None).unwrap();
    capture.views.iter_mut().for_each(|view| view.mask = Some(path.clone()));
    let view = capture.views.iter().find(|view| view.image.is_some()).unwrap();
    let load = |mask_as_alpha| {
        capture.load(Split::Train, &analysis, &LoadOptions { mask_as_alpha, ..LoadOptions::default() }).map(drop)
    };
    for (others, is_refused) in [(0.0, false), (0.2, true)] {
        let data = (0..96).map(|i| if i < 40 { 0.5 } else { others }).collect();
        Image { width: 12, height: 8, channels: 1, data }.save_png(&path).unwrap();
        for read in [load(false), load(true), view.seen_by(&view.camera.resized(12, 8)).map(drop)] {
            let message = read.map_or_else(|error| error.to_string(), |()| String::new());
            assert_eq!(message.contains("mask.png: has no white"), is_refused, "{message}");
        }
    }
    // Without a used pixel in any image, the mask is named beside its image.
    Image { width: 12, height: 8, channels: 1, data: vec![0.0; 96] }.save_png(&path).unwrap();
    let message = load(false).unwrap_err().to_string();
    assert!(message.contains("has no usable pixel, by the mask `") && message.contains("mask.png`"), "{message}");
    // Otherwise the image is left out.
    let shown = capture.views.iter_mut().find(|view| view.image.is_some() && view.split == Some(Split::Train)).unwrap();
    let name = shown.name.clone();
    shown.mask = None;
    let data = capture.load(Split::Train, &analysis, &LoadOptions::default()).unwrap();
    assert_eq!(data.frames.iter().map(|frame| &frame.name).collect::<Vec<_>>(), [&name]);
    assert!(!data.masked.is_empty() && !data.masked.contains(&name), "{:?}", data.masked);
}

#[test]
fn opaque_alpha_is_no_empty_background() {
    let folder = tempfile::tempdir().unwrap();
    let mut capture = capture(folder.path(), 4);
    capture.format = Format::Blender;
    // One transparent pixel is less than 5 %.
    for (alpha, expected) in [(1.0, false), (0.5, true), (0.0, true)] {
        for view in &capture.views {
            let Some(path) = &view.image else { continue };
            let mut image = Image { width: 12, height: 8, channels: 4, data: vec![0.3; 12 * 8 * 4] };
            (0..96).for_each(|i| image.data[4 * i + 3] = 1.0);
            image.data[4 * 17 + 3] = alpha;
            image.save_png(path).unwrap();
        }
        let analysis = capture.analyze_scene(None).unwrap();
        assert_eq!(analysis.scene_type == SceneType::Bounded, expected, "{}", analysis.reason);
    }
}
