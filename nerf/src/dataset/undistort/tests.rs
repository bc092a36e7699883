use super::*;
use glam::DAffine3;
use raygrad_tensor::Real;
use std::path::Path;

fn camera(lens: Lens) -> Camera {
    Camera { width: 160, height: 120, focal: [110.0, 112.0], centre: [78.0, 61.5], lens, pose: DAffine3::IDENTITY }
}

fn barrel() -> Lens {
    Lens::Brown { k: [-0.2, 0.05, 0.0, 0.0, 0.0, 0.0], p: [1e-3, -2e-3] }
}

fn pincushion() -> Lens {
    Lens::Brown { k: [0.15, 0.02, 0.0, 0.0, 0.0, 0.0], p: [0.0, 1e-3] }
}

fn fisheye() -> Lens {
    Lens::Fisheye { k: [0.01, -0.02, 0.0, 0.0], p: [0.0; 2], s: [0.0; 2] }
}

/// A smooth function of the direction, with a wavelength of about ten pixels.
fn color(direction: DVec3) -> [f32; 3] {
    let DVec3 { x, y, z } = direction;
    [(9.0 * x + 3.0 * y).sin(), (8.0 * y * z - 2.0 * x).cos(), (7.0 * (x * y + z)).sin()]
        .map(|value| (0.5 + 0.4 * value) as f32)
}

/// Writes a camera's image of it, as 16-bit PNG.
fn taken(camera: &Camera, path: &Path) {
    let pixels = (0..camera.width * camera.height).map(|i| (i % camera.width, i / camera.width));
    let words = pixels.flat_map(|(x, y)| color(camera.pixel_ray(x, y).direction).map(|v| (v * 65535.0).round() as u16));
    let (width, height) = (camera.width as u32, camera.height as u32);
    image::ImageBuffer::<image::Rgb<u16>, _>::from_raw(width, height, words.collect::<Vec<_>>())
        .unwrap()
        .save(path)
        .unwrap();
}

fn view(camera: Camera, path: &Path) -> View {
    View { image: Some(path.into()), ..View::new("photo.png", "frames[0]", camera) }
}

#[test]
fn undistorted_image_equals_a_pinhole_image() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("photo.png");
    for lens in [barrel(), pincushion(), fisheye(), Lens::Fov { omega: 0.9 }, Lens::Pinhole] {
        let view = view(camera(lens), &path);
        taken(&view.camera, &path);
        let to = Camera::undistorted(&[&view.camera_of_image().unwrap()]).unwrap();
        let (photo, mask) = view.seen_by(&to).unwrap();
        assert!(mask.is_none() && photo.bytes() == 6 * to.width * to.height, "16 bits stay 16 bits");
        let mut worst = 0.0_f32;
        for (x, y) in (0..to.height).flat_map(|y| (0..to.width).map(move |x| (x, y))) {
            let expected = color(to.pixel_ray(x, y).direction);
            let pixel = photo.pixel(x, y);
            let off = pixel.iter().zip(expected).map(|(a, b)| (a - b).abs());
            // The source image ends within a pixel of the border.
            let inside = (2..to.width - 2).contains(&x) && (2..to.height - 2).contains(&y);
            worst = off.fold(worst, |worst, off| if inside { Real::maximum(worst, off) } else { worst });
        }
        assert!(worst < 2e-3, "{lens:?}: {worst}");
    }
}

#[test]
fn undistorted_size_is_the_largest_without_gaps() {
    for lens in [barrel(), pincushion(), Lens::Pinhole] {
        let from = camera(lens);
        let to = Camera::undistorted(&[&from]).unwrap();
        let inside = |x: f64, y: f64| {
            let [u, v] = from.pixel_of(to.ray(x, y).at(1.0)).unwrap();
            (-1e-6..=160.0 + 1e-6).contains(&u) && (-1e-6..=120.0 + 1e-6).contains(&v)
        };
        let [w, h] = [to.width as f64, to.height as f64];
        let border = |grow: f64| {
            (0..=500).map(|i| f64::from(i) / 500.0).all(|t| {
                let (x, y) = (t * (w + 2.0 * grow) - grow, t * (h + 2.0 * grow) - grow);
                inside(x, -grow) && inside(x, h + grow) && inside(-grow, y) && inside(w + grow, y)
            })
        };
        assert!(border(0.0) && !border(1.5), "{lens:?}: {w}x{h}");
        assert_eq!((to.focal, to.centre), ([(110.0_f64 * 112.0).sqrt(); 2], [0.5 * w, 0.5 * h]));
        // The loss is at most the corners that a pincushion pulls in.
        assert!(lens == barrel() || w * h > 0.75 * 160.0 * 120.0, "{lens:?}: {w}x{h}");
    }
}

#[test]
fn undistorted_shape_keeps_the_most() {
    // The principal point is far from the middle; the result covers everything around it.
    let aside = Camera { centre: [60.0, 61.5], focal: [110.0; 2], ..camera(Lens::Pinhole) };
    let to = Camera::undistorted(&[&aside]).unwrap();
    assert_eq!([to.width, to.height], [120, 117]);
    for lens in [barrel(), pincushion()] {
        let from = Camera { centre: [60.0, 61.5], ..camera(lens) };
        let to = Camera::undistorted(&[&from]).unwrap();
        let half = [to.width, to.height].map(|side| 0.5 * side as f64 / to.focal[0]);
        for step in 1..100 {
            let scale = 1.02_f64.powi(step - 50);
            let x = half[0] * scale;
            let y = last(0.0, |y| sees_all(&from, [x, y]));
            assert!(x * y < 1.04 * half[0] * half[1], "{lens:?}: {half:?} and not {:?}", [x, y]);
        }
    }
}

#[test]
fn undistorted_fisheye_is_100_degrees_at_most() {
    let from = Camera { width: 1000, height: 1000, focal: [300.0; 2], centre: [500.0; 2], ..camera(fisheye()) };
    let to = Camera::undistorted(&[&from]).unwrap();
    let angle = |side: usize| 2.0 * (0.5 * side as f64 / 300.0).atan().to_degrees();
    assert!((99.5..=100.0).contains(&angle(to.width)) && (99.5..=100.0).contains(&angle(to.height)), "{to:?}");
}

#[test]
fn undistorted_camera_fits_different_cameras() {
    let (wide, tall) = (camera(barrel()), Camera { width: 120, height: 160, centre: [60.0, 80.0], ..camera(barrel()) });
    let both = Camera::undistorted(&[&wide, &tall]).unwrap();
    let each = [&wide, &tall].map(|camera| Camera::undistorted(&[camera]).unwrap());
    let area = |camera: &Camera| camera.width * camera.height;
    assert!(each.iter().all(|one| area(one) >= area(&both)) && area(&both) > 120 * 100, "{both:?}");
    let half = [0.5 * both.width as f64 / both.focal[0], 0.5 * both.height as f64 / both.focal[1]];
    assert!(sees_all(&wide, half) && sees_all(&tall, half));
    let bad = |camera: Camera, expected: &str| {
        let message = Camera::undistorted(&[&camera]).unwrap_err().to_string();
        assert!(message.starts_with("`undistort`: ") && message.contains(expected), "{message}");
    };
    bad(Camera { centre: [-20.0, 60.0], ..camera(Lens::Pinhole) }, "cameras that see their optical axis");
    bad(camera(Lens::Equirectangular), "equirectangular images");
    assert!(Camera::undistorted(&[]).is_err());
}

#[test]
fn undistorted_masks_stay_black_or_white() {
    let folder = tempfile::tempdir().unwrap();
    let [image, mask] = ["photo.png", "mask.png"].map(|name| folder.path().join(name));
    let mut view = view(camera(barrel()), &image);
    taken(&view.camera, &image);
    // Half of the size, black to the right of the middle.
    let picture = image::GrayImage::from_fn(80, 60, |x, _| image::Luma([if x < 40 { 255 } else { 0 }]));
    picture.save(&mask).unwrap();
    view.mask = Some(mask);
    let to = Camera::undistorted(&[&view.camera]).unwrap();
    let (_, mask) = view.seen_by(&to).unwrap();
    let mask = mask.unwrap();
    assert_eq!([mask.width, mask.height, mask.channels], [to.width, to.height, 1]);
    for (x, y) in (0..to.height).flat_map(|y| (0..to.width).map(move |x| (x, y))) {
        assert!(matches!(mask.pixel(x, y), [0.0] | [1.0]), "{:?}", mask.pixel(x, y));
        let [u, _] = place(&to, &view.camera, [x as f64 + 0.5, y as f64 + 0.5]);
        let expected = if u < 80.0 { 1.0 } else { 0.0 };
        assert!((u - 80.0).abs() < 2.1 || mask.pixel(x, y) == [expected], "{x} {y}");
    }
}
