//! Findings from all poses together.

use super::kinds::{FindingKind as Kind, Severity};
use super::nearby::{Nearby, usual_gap};
use super::poses::{Convention, Focus, extents};
use super::report::{Finding, Findings};
use crate::camera::{Camera, Lens};
use crate::dataset::{Capture, Format, SceneAnalysis, SceneType, Split, View, evenly_spaced};
use crate::numbers::{mean, median};
use Severity::{Error, Note, Warning};
use glam::{DAffine3, DVec3};

/// Fewer images than the first are an error; fewer than the second are a warning.
const FEW: [usize; 2] = [5, 20];
/// The largest spread of cameras in one place, as a share of their distance from the origin.
const ONE_PLACE: f64 = 1e-9;
/// The largest second extent of cameras on a line, as a share of the first.
const LINE: f64 = 0.02;
/// The cosine of half of the cone around the poles, in which roll and azimuth are meaningless.
const POLE: f64 = 0.9;
/// The largest rotation about the optical axis, in degrees.
const ROLL: f64 = 30.0;
/// The largest angle without a camera, seen from the centre, in degrees.
const GAP: f64 = 120.0;

/// Adds findings about all cameras that have images.
pub(super) fn examine(capture: &Capture, analysis: Option<&SceneAnalysis>, findings: &mut Findings) {
    let views: Vec<&View> = capture.present().collect();
    few(capture, &views, findings);
    if views.len() < 2 {
        return;
    }
    let places: Vec<DVec3> = views.iter().map(|view| view.camera.pose.translation).collect();
    let far = far_cameras(&places);
    findings.about(Kind::FarCamera, far.iter().map(|i| views[*i]), &[]);
    // Far cameras, which are probably wrong, would hide what the others have in common.
    let of_extents = |poses: &[DAffine3]| extents(&poses.iter().map(|pose| pose.translation).collect::<Vec<_>>());
    let all: Vec<DAffine3> = views.iter().map(|view| view.camera.pose).collect();
    let is_near = |i: &usize| far.binary_search(i).is_err();
    let mut poses: Vec<DAffine3> = (0..views.len()).filter(is_near).map(|i| all[i]).collect();
    let least = ONE_PLACE * (1.0 + median(places.iter().map(|place| place.length())));
    if !(of_extents(&poses)[0] > least) {
        poses = all;
    }
    let (size, focus) = (of_extents(&poses), Focus::of(&poses));
    let meant = by_points(capture, &views).unwrap_or_else(|| {
        // COLMAP has one convention, and the axes of panoramas are no views.
        let is_fixed = capture.format == Format::Colmap || views.iter().any(|view| is_panorama(&view.camera));
        if is_fixed { None } else { by_axes(&poses, focus, size[0]) }
    });
    if let Some((convention, severity)) = meant {
        let kind = match (convention, severity) {
            (Convention::OpenCv, Error) => Kind::OpenCvAxes,
            (Convention::OpenCv, _) => Kind::LooksAway,
            _ => Kind::WorldToCamera,
        };
        findings.add(kind, &[]).severity = severity;
    }
    if !(size[0] > least) {
        if !matches!(meant, Some((Convention::WorldToCamera | Convention::WorldToOpenCv, _))) {
            findings.add(Kind::OnePlace, &[]);
        }
        return;
    }
    if views.len() >= 4 && size[1] < LINE * size[0] {
        findings.add(Kind::OnALine, &[]);
    }
    pairs(&views, &places, focus.map_or(size[0], |focus| focus.distance.max(size[0])), size[0], findings);
    scale(capture, &places, size[0], findings);
    if let Some(analysis) = analysis {
        let up = analysis.transform.rotation.transpose() * DVec3::Z;
        roll(&views, up, findings);
        let is_inward = |focus: &Focus| focus.is_inward() && !views.iter().any(|view| is_panorama(&view.camera));
        if let Some(focus) = focus.filter(is_inward) {
            coverage(&places, focus, up, findings);
        }
        in_the_box(&views, analysis, findings);
    }
}

/// Returns true if a camera sees all around itself, so that its axes are no view.
pub(super) fn is_panorama(camera: &Camera) -> bool {
    camera.lens == Lens::Equirectangular
}

fn few(capture: &Capture, views: &[&View], findings: &mut Findings) {
    let what = match views.len() {
        0 => "no images",
        1 => "only 1 image",
        count => &format!("only {count} images"),
    };
    // A panorama shows as much as the six sides of a cube.
    let shown: usize = views.iter().map(|view| if is_panorama(&view.camera) { 6 } else { 1 }).sum();
    // Where the files list enough, those that do not exist are the fault.
    if shown < FEW[1] && capture.views.len() < FEW[1] {
        let finding = findings.add(Kind::FewImages, &[&what]);
        if shown < FEW[0] {
            finding.severity = Error;
        }
    }
    if !views.is_empty() && !capture.present().any(|view| view.split != Some(Split::Train)) {
        findings.add(Kind::NothingHeldOut, &[]);
    }
}

/// The convention, other than the one used, under which the capture's points are in the images: `Some(None)` if they are
/// as it is read, `None` if the points do not tell.
fn by_points(capture: &Capture, views: &[&View]) -> Option<Option<(Convention, Severity)>> {
    /// The fewest points; the most points and cameras that are used.
    const COUNTS: [usize; 3] = [50, 200, 40];
    /// The share of the points that cameras see at least.
    const SEEN: f64 = 0.05;
    if capture.points.len() < COUNTS[0] {
        return None;
    }
    let points = evenly_spaced(capture.points.iter().map(|point| point.position).collect(), COUNTS[1]);
    let views = evenly_spaced(views.to_vec(), COUNTS[2]);
    let share = |convention: Convention| {
        let seen = views.iter().map(|view| {
            let camera = Camera { pose: convention.apply(view.camera.pose), ..view.camera.clone() };
            points.iter().filter(|point| camera.shows(**point)).count()
        });
        seen.sum::<usize>() as f64 / (views.len() * points.len()) as f64
    };
    // Mirrored captures mirror their points too, so points cannot reveal it.
    let others = [Convention::OpenCv, Convention::WorldToCamera, Convention::WorldToOpenCv].map(|c| (share(c), c));
    let (best, convention) = others.into_iter().max_by(|a, b| a.0.total_cmp(&b.0))?;
    match share(Convention::AsRead) {
        own if own > SEEN && own >= 0.5 * best => Some(None),
        own => (own <= SEEN && best > 4.0 * SEEN).then_some(Some((convention, Error))),
    }
}

/// The convention that the camera axes suggest. It is not proven: cameras inside a room look away from each other too.
fn by_axes(poses: &[DAffine3], focus: Option<Focus>, size: f64) -> Option<(Convention, Severity)> {
    if focus.is_some_and(|focus| focus.is_inward() && size > 1e-3 * focus.distance) {
        return None;
    }
    let under =
        |convention: Convention| -> Vec<DAffine3> { poses.iter().map(|pose| convention.apply(*pose)).collect() };
    for convention in [Convention::WorldToCamera, Convention::WorldToOpenCv] {
        let poses = under(convention);
        let places: Vec<DVec3> = poses.iter().map(|pose| pose.translation).collect();
        // Sharper than otherwise and over a wide range of directions: wrongly inverted poses rarely converge so well.
        let fits = |focus: Focus| focus.is_inward() && focus.miss < 0.15 && extents(&places)[1] > 0.2 * focus.distance;
        if Focus::of(&poses).is_some_and(fits) && !focus.is_some_and(|focus| focus.miss < 0.3 && focus.ahead < 0.1) {
            return Some((convention, Warning));
        }
    }
    let away = |focus: Focus| focus.miss < 0.3 && focus.ahead < 0.1 && size > 1e-3 * focus.distance;
    focus.is_some_and(away).then_some((Convention::OpenCv, Warning))
}

/// Adds findings about images with the pose of another. Each is named once, however many others there are.
fn pairs(views: &[&View], places: &[DVec3], distance: f64, size: f64, findings: &mut Findings) {
    /// The tolerances of equal poses: a share of a length, and radians.
    const SAME: [f64; 2] = [1e-6, 1e-5];
    const NEARLY: [f64; 2] = [1e-3, 3e-3];
    // Images in no split are not used.
    let is_in = |i: usize, trained: bool| views[i].split.is_some_and(|split| (split == Split::Train) == trained);
    let turned = |i: usize, j: usize| {
        let [a, b] = [i, j].map(|i| views[i].camera.pose.matrix3);
        (0..3).map(|axis| a.col(axis).distance_squared(b.col(axis))).sum::<f64>()
    };
    // For each image of one set (trained on or held out), an image of another set with the same pose.
    let alike = |of: bool, among: bool, length: f64, [share, angle]: [f64; 2]| -> Vec<[usize; 2]> {
        let nearby = Nearby::new(places, |i| is_in(i, among), share * length);
        let is_other = |i: usize, j: usize| of != among || j < i;
        let find = |i: usize| nearby.of(i).find(|&j| is_other(i, j) && turned(i, j) <= 2.0 * angle * angle);
        (0..views.len()).filter(|i| is_in(*i, of)).filter_map(|i| Some([i, find(i)?])).collect()
    };
    let shown =
        |pairs: Vec<[usize; 2]>| -> Vec<[&View; 2]> { pairs.into_iter().map(|pair| pair.map(|i| views[i])).collect() };
    let mut duplicates = [true, false].map(|trained| alike(trained, trained, size, SAME)).concat();
    duplicates.sort_unstable();
    findings.alike(Kind::DuplicatePoses, &shown(duplicates));
    findings.alike(Kind::Leak, &shown(alike(false, true, distance, NEARLY)));
}

/// The cameras that are far from all others, in order.
fn far_cameras(places: &[DVec3]) -> Vec<usize> {
    let middle = DVec3::from([0, 1, 2].map(|axis| median(places.iter().map(|place| place[axis]))));
    let usual = median(places.iter().map(|place| place.distance(middle)));
    let nearby = Nearby::new(places, |_| true, (8.0 * usual_gap(places, 1)).max(ONE_PLACE * (1.0 + middle.length())));
    let far = |i: &usize| places[*i].distance(middle) > 4.0 * usual && nearby.of(*i).all(|j| j == *i);
    (0..places.len()).filter(far).collect()
}

fn scale(capture: &Capture, places: &[DVec3], size: f64, findings: &mut Findings) {
    /// Plausible spreads of the cameras, as shares of the distance to the scene.
    const PLAUSIBLE: [f64; 2] = [3e-3, 100.0];
    let mean = mean(places.iter().copied());
    if capture.points.len() >= 10 {
        let distance = median(capture.points.iter().map(|point| point.position.distance(mean)));
        let share = size / distance;
        if !(PLAUSIBLE[0]..=PLAUSIBLE[1]).contains(&share) {
            findings.add(Kind::Scale, &[&format_args!("{share:.1e}")]);
        }
    }
    let from_origin = median(places.iter().map(|place| place.length()));
    if capture.format == Format::Blender && !(1.0..=20.0).contains(&from_origin) {
        findings.0.push(Finding {
            kind: Kind::Scale,
            severity: Note,
            what: format!(
                "the cameras are {from_origin:.3} units from the origin; Blender captures usually use about 4"
            ),
            advice:
                "raygrad finds the scene's size from the cameras, so training is fine. For other programs, scale the \
                positions."
                    .to_owned(),
            views: vec![],
        });
    }
    if mean.length() > 1e5 * size {
        findings.add(Kind::FarFromOrigin, &[&format_args!("{:.1e}", mean.length()), &format_args!("{size:.1e}")]);
    }
}

fn roll(views: &[&View], up: DVec3, findings: &mut Findings) {
    let turned = |view: &&&View| {
        let axes = view.camera.pose.matrix3;
        let level = axes.z_axis.dot(up).abs() < POLE;
        level && !is_panorama(&view.camera) && axes.x_axis.dot(up).atan2(axes.y_axis.dot(up)).abs().to_degrees() > ROLL
    };
    findings.about(Kind::Roll, views.iter().filter(turned).copied(), &[]);
}

fn coverage(places: &[DVec3], focus: Focus, up: DVec3, findings: &mut Findings) {
    let east = up.any_orthonormal_vector();
    let north = up.cross(east);
    let offsets = places.iter().map(|place| (*place - focus.place).normalize()).filter(|d| d.dot(up).abs() < POLE);
    let mut azimuths: Vec<f64> = offsets.map(|d| d.dot(north).atan2(d.dot(east)).to_degrees()).collect();
    azimuths.sort_by(f64::total_cmp);
    let Some((first, last)) = azimuths.first().zip(azimuths.last()) else { return };
    let around = first + 360.0 - last;
    let gap = azimuths.windows(2).map(|pair| pair[1] - pair[0]).fold(around, f64::max);
    if gap > GAP {
        findings.add(Kind::CoverageGap, &[&format_args!("{gap:.0}")]);
    }
}

fn in_the_box(views: &[&View], analysis: &SceneAnalysis, findings: &mut Findings) {
    /// Rays along each side of an image; the second number applies if all of the first miss, since a small box may lie
    /// between them.
    const RAYS: [usize; 2] = [12, 200];
    if analysis.scene_type != SceneType::Bounded {
        return;
    }
    let [low, high] = analysis.bounds;
    let placed = |view: &View| analysis.transform.camera(&view.camera);
    let inside = |view: &&&View| {
        let eye = placed(view).pose.translation;
        eye.cmpge(low).all() && eye.cmple(high).all()
    };
    let misses = |view: &&&View| {
        let camera = placed(view);
        let meets = |rays: usize| camera.meets(analysis.bounds, [analysis.near, analysis.far], [rays; 2]);
        camera.width > 0 && !RAYS.into_iter().any(meets)
    };
    findings.about(Kind::CameraInBox, views.iter().filter(inside).copied(), &[]);
    findings.about(Kind::MissesBox, views.iter().filter(misses).copied(), &[]);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_images_are_found_unless_others_are_absent() {
        let severity = |listed: usize, present: usize, lens: Lens| {
            let camera = Camera { lens, ..Camera::from_angle(8, 6, 0.7, DAffine3::IDENTITY) };
            let view = |i: usize| {
                let image = (i < present).then(|| "0.png".into());
                View { image, split: Some(Split::Test), ..View::new(i.to_string(), "", camera.clone()) }
            };
            let views = (0..listed).map(view).collect();
            let capture = Capture::new("scene".as_ref(), "transforms.json".into(), Format::Transforms, views);
            let mut findings = Findings::default();
            few(&capture, &capture.present().collect::<Vec<_>>(), &mut findings);
            let found = findings.sorted(None);
            assert!(found.iter().all(|finding| finding.kind == Kind::FewImages), "{found:?}");
            found.first().map(|finding| finding.severity)
        };
        for (listed, present, expected) in [
            (4, 4, Some(Error)),
            (5, 5, Some(Warning)),
            (19, 19, Some(Warning)),
            (19, 3, Some(Error)),
            (20, 20, None),
            (20, 0, None),
            (40, 3, None),
        ] {
            assert_eq!(severity(listed, present, Lens::Pinhole), expected, "{present} of {listed}");
        }
        assert_eq!(severity(4, 4, Lens::Equirectangular), None, "they show as much as 24");
    }
}
