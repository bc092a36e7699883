//! Findings from single cameras: field of view, principal point and lens.

use super::kinds::FindingKind as Kind;
use super::report::Findings;
use crate::camera::{Camera, Lens};
use crate::dataset::{Capture, Photo, View};
use crate::numbers::median;
use std::collections::HashMap;

/// Plausible fields of view in degrees, and the largest of fisheye lenses.
const VIEWS: [f64; 2] = [10.0, 150.0];
const WIDE: f64 = 230.0;
/// The largest relative difference of horizontal and vertical focal length with square pixels.
const ASPECT: f64 = 0.05;
/// The largest distance of the principal point from the middle, in sides of the image.
const OFF_CENTRE: f64 = 0.1;
/// The distortion at the border, in degrees, above which a lens is reported as strong.
const BENDS: f64 = 5.0;
/// The largest usual ratio of two focal lengths, also for square crops of the images of a phone; and the largest share of images of one size beyond it that is
/// reported: more may have another zoom or lens.
const ZOOM: f64 = 1.3;
const RARE: f64 = 0.1;
/// Points tested along a line from the principal point to the border.
const STEPS: usize = 32;

pub(super) fn examine(capture: &Capture, findings: &mut Findings) {
    let mut about = |kind: Kind, wrong: &dyn Fn(&Camera) -> bool| {
        let sized = capture.views.iter().filter(|view| view.camera.width > 0 && view.camera.height > 0);
        findings.about(kind, sized.filter(|view| wrong(&view.camera)), &[]);
    };
    about(Kind::FieldOfView, &|camera| {
        let most = if matches!(camera.lens, Lens::Fisheye { .. } | Lens::Fov { .. }) { WIDE } else { VIEWS[1] };
        camera.lens != Lens::Equirectangular
            && [0, 1].into_iter().any(|axis| !(VIEWS[0]..=most).contains(&field_of_view(camera, axis)))
    });
    about(Kind::PixelAspect, &|camera| {
        let [x, y] = camera.focal;
        camera.lens != Lens::Equirectangular && !((x / y - 1.0).abs() <= ASPECT)
    });
    let usual = usual_focals(capture);
    about(Kind::FocalLength, &|camera| {
        let usual = usual.get(&[camera.width, camera.height]);
        usual.is_some_and(|usual| is_other(camera.focal[0], *usual))
    });
    about(Kind::PrincipalPoint, &|camera| {
        let sides = [camera.width as f64, camera.height as f64];
        (0..2).any(|axis| !((camera.centre[axis] / sides[axis] - 0.5).abs() <= OFF_CENTRE))
    });
    about(Kind::LensFolds, &|camera| !reaches(camera));
    about(Kind::StrongDistortion, &|camera| reaches(camera) && bends(camera) > BENDS);
}

/// Adds a finding about focal lengths that are not about those of the EXIF data.
pub(super) fn of_exif(capture: &Capture, findings: &mut Findings) {
    let expected = |view: &View| {
        let Camera { width, height, lens, .. } = &view.camera;
        let exif = Photo::exif_of_file(view.image.as_ref()?).ok().filter(|_| *lens != Lens::Equirectangular)?;
        exif.focal_pixels([*width, *height])
    };
    let known = capture.present().filter_map(|view| Some((view, expected(view)?)));
    let wrong: Vec<_> = known.filter(|(view, expected)| is_other(view.camera.focal[0], *expected)).collect();
    let Some((first, expected)) = wrong.first() else { return };
    let first = format!("{:.0} pixels in `{}`, where {expected:.0} are expected", first.camera.focal[0], first.name);
    findings.about(Kind::ExifFocalLength, wrong.iter().map(|(view, _)| *view), &[&first]);
}

/// Returns true if a focal length is not about the usual one.
fn is_other(focal: f64, usual: f64) -> bool {
    !(1.0 / ZOOM..=ZOOM).contains(&(focal / usual))
}

/// The usual horizontal focal length of the images of each size, if nearly all have about that.
fn usual_focals(capture: &Capture) -> HashMap<[usize; 2], f64> {
    let mut of_size: HashMap<[usize; 2], Vec<f64>> = HashMap::new();
    for camera in capture.views.iter().map(|view| &view.camera) {
        of_size.entry([camera.width, camera.height]).or_default().push(camera.focal[0]);
    }
    let usual = |(size, focals): ([usize; 2], Vec<f64>)| {
        let usual = median(focals.iter().copied());
        let others = focals.iter().filter(|focal| is_other(**focal, usual)).count();
        (others as f64 <= RARE * focals.len() as f64).then_some((size, usual))
    };
    of_size.into_iter().filter_map(usual).collect()
}

/// The horizontal (`axis` 0) or vertical field of view in degrees, without distortion.
pub(super) fn field_of_view(camera: &Camera, axis: usize) -> f64 {
    let size = [camera.width, camera.height][axis] as f64;
    let half = 0.5 * size / camera.focal[axis];
    let radians = match camera.lens {
        // Image-plane positions are angles, at least nearly.
        Lens::Fisheye { .. } | Lens::Equirectangular | Lens::Fov { .. } => 2.0 * half,
        Lens::Pinhole | Lens::Brown { .. } => 2.0 * half.atan(),
    };
    radians.to_degrees()
}

/// The corners of the image and the middles of its sides, in the image plane.
fn border(camera: &Camera) -> impl Iterator<Item = [f64; 2]> {
    let [width, height] = [camera.width as f64, camera.height as f64];
    let [cx, cy] = camera.centre;
    let [fx, fy] = camera.focal;
    let ends = |side: f64| [0.5, 0.5 * side, side - 0.5];
    ends(width).into_iter().flat_map(move |x| ends(height).map(move |y| [(x - cx) / fx, (y - cy) / fy]))
}

/// Returns true if the lens sees all of the image, and the angle to the axis grows with the distance from the principal
/// point.
fn reaches(camera: &Camera) -> bool {
    if matches!(camera.lens, Lens::Pinhole | Lens::Equirectangular) {
        return true;
    }
    border(camera).all(|[x, y]| {
        let mut last = 0.0;
        (1..=STEPS).all(|step| {
            let share = step as f64 / STEPS as f64;
            let Some(direction) = camera.lens.direction([share * x, share * y]) else { return false };
            let angle = direction.truncate().length().atan2(direction.z);
            let grows = angle > last || x.hypot(y) < 1e-3;
            last = angle;
            grows
        })
    })
}

/// The largest angle at the border, in degrees, between the lens's direction and that of a pinhole.
fn bends(camera: &Camera) -> f64 {
    if !matches!(camera.lens, Lens::Brown { .. }) {
        return 0.0;
    }
    let angles = border(camera).map(|place| {
        let plain = Lens::Pinhole.direction(place).zip(camera.lens.direction(place));
        plain.map_or(0.0, |(plain, bent)| plain.angle_between(bent))
    });
    angles.fold(0.0, f64::max).to_degrees()
}

/// A lens and its coefficients, without trailing zeros.
pub(super) fn described(lens: &Lens) -> String {
    let listed = |name: &str, values: &[f64]| {
        let used = values.iter().rposition(|x| *x != 0.0).map_or(0, |last| last + 1);
        let numbered = values[..used].iter().enumerate().map(|(i, x)| format!(", {name}{} {x}", i + 1));
        numbered.collect::<String>()
    };
    match lens {
        Lens::Pinhole => "pinhole".to_owned(),
        Lens::Brown { k, p } => {
            let coefficients = listed("k", k) + &listed("p", p);
            if coefficients.is_empty() { "pinhole".to_owned() } else { format!("Brown{coefficients}") }
        }
        Lens::Fisheye { k, p, s } => format!("fisheye{}{}{}", listed("k", k), listed("p", p), listed("sx", s)),
        Lens::Fov { omega } => format!("FOV, omega {omega}"),
        Lens::Equirectangular => "equirectangular".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::Format;
    use glam::DAffine3;
    use image::codecs::png::PngEncoder;
    use image::{ExtendedColorType, ImageEncoder};

    /// A PNG of 36 x 24 pixels, the size of the film in millimetres, as a photograph of this focal length.
    fn photograph(focal_35mm: Option<u8>) -> Vec<u8> {
        let mut bytes = vec![];
        let mut encoder = PngEncoder::new(&mut bytes);
        if let Some(focal) = focal_35mm {
            let mut exif = b"MM\0*\0\0\0\x08\0\x01\x87\x69\0\x04\0\0\0\x01\0\0\0\x1a\0\0\0\0".to_vec();
            exif.extend(b"\0\x01\xa4\x05\0\x03\0\0\0\x01\0");
            exif.extend([focal, 0, 0, 0, 0, 0, 0]);
            encoder.set_exif_metadata(exif).unwrap();
        }
        encoder.write_image(&[99; 36 * 24 * 3], 36, 24, ExtendedColorType::Rgb8).unwrap();
        bytes
    }

    #[test]
    fn focal_lengths_are_those_of_the_exif_data() {
        let folder = tempfile::tempdir().unwrap();
        let panorama = Camera { lens: Lens::Equirectangular, ..Camera::from_angle(36, 24, 0.7, DAffine3::IDENTITY) };
        let pinhole = |focal: f64| Camera { focal: [focal; 2], lens: Lens::Pinhole, ..panorama.clone() };
        let resized = pinhole(28.0).resized(360, 240);
        let lost = View::new("lost", "", pinhole(9.0));
        let unsized_camera = Camera { width: 0, height: 0, ..pinhole(28.0) };
        let views = [
            (Some(28), pinhole(28.0)),
            (Some(28), pinhole(35.0)),
            (Some(28), pinhole(38.0)),
            (Some(28), pinhole(14.0)),
            (None, pinhole(14.0)),
            (Some(0), pinhole(14.0)),
            (Some(28), panorama.clone()),
            (Some(28), resized),
            (Some(28), unsized_camera),
        ];
        let view = |(i, (focal, camera)): (usize, (Option<u8>, Camera))| {
            let path = folder.path().join(format!("{i}.png"));
            std::fs::write(&path, photograph(focal)).unwrap();
            View { image: Some(path), ..View::new(i.to_string(), "", camera) }
        };
        let views = views.into_iter().enumerate().map(view).chain([lost]).collect();
        let capture = Capture::new(folder.path(), "transforms.json".into(), Format::Transforms, views);
        let mut findings = Findings::default();
        of_exif(&capture, &mut findings);
        let [found] = &findings.sorted(None)[..] else { panic!("not one finding") };
        assert_eq!((found.kind, &found.views[..]), (Kind::ExifFocalLength, &["2".to_owned(), "3".to_owned()][..]));
        assert!(found.what.contains("of 2 images is far"), "{}", found.what);
        assert!(found.what.ends_with(": 38 pixels in `2`, where 28 are expected"), "{}", found.what);
    }
}
