//! What can be said of all cameras together, from their poses alone.

use super::nearby::Nearby;
use super::poses::{Convention, Focus, extents};
use super::report::{FindingKind as Kind, Findings, Severity};
use crate::camera::{Camera, clip_span};
use crate::dataset::{Capture, Format, Scope, Split, Survey, View, evenly_spaced};
use crate::numbers::median;
use Severity::{Error, Note, Warning};
use glam::{DAffine3, DVec3};

/// Fewer photographs than these are too few, and hardly enough.
const FEW: [usize; 2] = [5, 20];
/// Cameras that are not farther apart than this share of their distance from the origin stand in one place.
const ONE_PLACE: f64 = 1e-9;
/// Cameras whose second extent is a smaller share of the first stand on a line.
const LINE: f64 = 0.02;
/// The cosine of half of the cone around the poles in which roll and azimuth say nothing.
const POLE: f64 = 0.9;
/// The angle in degrees that a camera may be turned about its optical axis.
const ROLL: f64 = 30.0;
/// The angle in degrees, as seen from the middle, that may be without a camera.
const GAP: f64 = 120.0;

/// Adds what is wrong with the cameras that have photographs, as a whole.
pub(super) fn examine(capture: &Capture, survey: Option<&Survey>, findings: &mut Findings) {
    let views: Vec<&View> = capture.present().collect();
    few(capture, &views, findings);
    if views.len() < 2 {
        return;
    }
    let poses: Vec<DAffine3> = views.iter().map(|view| view.camera.pose).collect();
    let places: Vec<DVec3> = poses.iter().map(|pose| pose.translation).collect();
    let size = extents(&places);
    let focus = Focus::of(&poses);
    let meant = by_points(capture, &views).or_else(|| by_axes(&poses, focus, size[0]));
    match meant {
        Some((Convention::OpenCv, Error)) => opencv_axes(findings),
        Some((Convention::OpenCv, _)) => looks_away(findings),
        Some((_, severity)) => world_to_camera(severity, findings),
        None => (),
    }
    let apart = size[0] > ONE_PLACE * (1.0 + median(places.iter().map(|place| place.length())));
    if !apart && !matches!(meant, Some((Convention::WorldToCamera | Convention::WorldToOpenCv, _))) {
        findings.add(
            Kind::OnePlace,
            Error,
            "all cameras stand in one place: no depth can be found",
            "Photographs that are to give depth are taken from different places. If these were, their positions are lost: \
             look at the last column of the matrices.",
            vec![],
        );
    }
    if !apart {
        return;
    }
    if views.len() >= 4 && size[1] < LINE * size[0] {
        findings.add(
            Kind::OnALine,
            Warning,
            "all cameras stand on a line: depth is found along it alone",
            "Take photographs from above and below that line too; edges along it have no depth otherwise.",
            vec![],
        );
    }
    pairs(&views, &places, focus.map_or(size[0], |focus| focus.distance.max(size[0])), size[0], findings);
    far_cameras(&views, &places, size[0], findings);
    scale(capture, &places, size[0], findings);
    if let Some(survey) = survey {
        let up = survey.placement.rotation.transpose() * DVec3::Z;
        roll(&views, up, findings);
        if let Some(focus) = focus.filter(Focus::is_inward) {
            coverage(&places, focus, up, findings);
        }
        in_the_box(&views, survey, findings);
    }
}

fn few(capture: &Capture, views: &[&View], findings: &mut Findings) {
    if views.len() < FEW[1] {
        let severity = if views.len() < FEW[0] { Error } else { Warning };
        let what = match views.len() {
            0 => "there is no photograph".to_owned(),
            1 => "there is only 1 photograph".to_owned(),
            count => format!("there are only {count} photographs"),
        };
        let advice = "Use 50 to 200 photographs, each part of the scene on at least three of them: more from where it has much \
                      detail or hides things.";
        findings.add(Kind::FewPhotographs, severity, what, advice, vec![]);
    }
    if !views.is_empty() && !capture.present().any(|view| view.split != Some(Split::Train)) {
        findings.add(
            Kind::NothingHeldOut,
            Note,
            "no photograph is held out: a model of this capture cannot be measured",
            "Put some photographs, one of eight is usual, in a split to test on.",
            vec![],
        );
    }
}

/// The finding that axes are OpenCV's.
pub(super) fn opencv_axes(findings: &mut Findings) {
    findings.add(
        Kind::OpenCvAxes,
        Error,
        "the matrices have OpenCV's camera axes, looking along +z with y down, and are read as OpenGL's",
        "Change the signs of the second and third column of each camera-to-world matrix.",
        vec![],
    );
}

/// The finding that matrices lead from the world to the camera.
pub(super) fn world_to_camera(severity: Severity, findings: &mut Findings) {
    findings.add(
        Kind::WorldToCamera,
        severity,
        "the matrices seem to lead from the world to the camera: inverted, all cameras look at one place",
        "Write the inverse of each matrix: files hold camera-to-world matrices, whose last column is where the camera is.",
        vec![],
    );
}

fn looks_away(findings: &mut Findings) {
    findings.add(
        Kind::LooksAway,
        Warning,
        "all cameras look away from the middle of where they stand",
        "If they stand around a thing and look at it, the matrices have OpenCV's axes: change the signs of the second and third \
         column. If they stand in the middle of a room and look around, this is right.",
        vec![],
    );
}

/// The convention, other than the one that is read, under which cameras have the points of the capture in their images.
fn by_points(capture: &Capture, views: &[&View]) -> Option<(Convention, Severity)> {
    /// Too few points; those that are looked at; cameras that are looked at.
    const COUNTS: [usize; 3] = [50, 200, 40];
    if capture.points.len() < COUNTS[0] {
        return None;
    }
    let points = evenly_spaced(capture.points.iter().map(|point| point.position).collect(), COUNTS[1]);
    let views = evenly_spaced(views.to_vec(), COUNTS[2]);
    let share = |convention: Convention| {
        let seen = views.iter().map(|view| {
            let camera = Camera { pose: convention.apply(view.camera.pose), ..view.camera.clone() };
            points.iter().filter(|point| is_seen(&camera, **point)).count()
        });
        seen.sum::<usize>() as f64 / (views.len() * points.len()) as f64
    };
    if share(Convention::AsRead) > 0.05 {
        return None;
    }
    // Mirrored cameras have mirrored points: these say nothing of mirrors.
    let others = [Convention::OpenCv, Convention::WorldToCamera, Convention::WorldToOpenCv].map(|c| (share(c), c));
    let (best, convention) = others.into_iter().max_by(|a, b| a.0.total_cmp(&b.0))?;
    (best > 0.2).then_some((convention, Error))
}

/// Whether a point lies in the image of a camera.
fn is_seen(camera: &Camera, point: DVec3) -> bool {
    camera
        .pixel_of(point)
        .is_some_and(|[x, y]| (0.0..camera.width as f64).contains(&x) && (0.0..camera.height as f64).contains(&y))
}

/// The same, from what cameras look at: as those that look around in a room look away from each other too, that is no proof.
fn by_axes(poses: &[DAffine3], focus: Option<Focus>, size: f64) -> Option<(Convention, Severity)> {
    if focus.is_some_and(|focus| focus.is_inward() && size > 1e-3 * focus.distance) {
        return None;
    }
    let under =
        |convention: Convention| -> Vec<DAffine3> { poses.iter().map(|pose| convention.apply(*pose)).collect() };
    for convention in [Convention::WorldToCamera, Convention::WorldToOpenCv] {
        let poses = under(convention);
        let places: Vec<DVec3> = poses.iter().map(|pose| pose.translation).collect();
        // Sharper than elsewhere, and over a wide range of directions: what is inverted by mistake rarely meets so well.
        let fits = |focus: Focus| focus.is_inward() && focus.miss < 0.15 && extents(&places)[1] > 0.2 * focus.distance;
        if Focus::of(&poses).is_some_and(fits) && !focus.is_some_and(|focus| focus.miss < 0.3 && focus.ahead < 0.1) {
            return Some((convention, Warning));
        }
    }
    let away = |focus: Focus| focus.miss < 0.3 && focus.ahead < 0.1 && size > 1e-3 * focus.distance;
    focus.is_some_and(away).then_some((Convention::OpenCv, Warning))
}

/// Photographs with the pose of another one; each is named once, whatever the number of others.
fn pairs(views: &[&View], places: &[DVec3], distance: f64, size: f64, findings: &mut Findings) {
    /// How near poses are that are the same: as a share of a length, and in radians.
    const SAME: [f64; 2] = [1e-6, 1e-5];
    const NEARLY: [f64; 2] = [1e-3, 3e-3];
    let is_trained = |i: usize| views[i].split == Some(Split::Train);
    let turned = |i: usize, j: usize| {
        let [a, b] = [i, j].map(|i| views[i].camera.pose.matrix3);
        (0..3).map(|axis| a.col(axis).distance_squared(b.col(axis))).sum::<f64>()
    };
    // Of each photograph that is trained on, or held out, one that is trained on, or held out, and has its pose.
    let alike = |of: bool, among: bool, length: f64, [share, angle]: [f64; 2]| -> Vec<[usize; 2]> {
        let nearby = Nearby::new(places, |i| is_trained(i) == among, share * length);
        let is_other = |i: usize, j: usize| of != among || j < i;
        let find = |i: usize| nearby.of(i).find(|&j| is_other(i, j) && turned(i, j) <= 2.0 * angle * angle);
        (0..views.len()).filter(|i| is_trained(*i) == of).filter_map(|i| Some([i, find(i)?])).collect()
    };
    let named = |pairs: Vec<[usize; 2]>| -> Vec<[String; 2]> {
        pairs.into_iter().map(|pair| pair.map(|i| views[i].name.clone())).collect()
    };
    let mut duplicates = [true, false].map(|trained| alike(trained, trained, size, SAME)).concat();
    duplicates.sort_unstable();
    findings.alike(
        Kind::DuplicatePoses,
        Warning,
        named(duplicates),
        |count| format!("the pose of {count} is exactly that of another"),
        "Two photographs are hardly ever taken from the same place: if the images differ, one of the poses is wrong; leave it \
         out.",
    );
    leak(named(alike(false, true, distance, NEARLY)), findings);
}

/// The finding that these photographs are trained and tested on.
pub(super) fn leak(pairs: Vec<[String; 2]>, findings: &mut Findings) {
    findings.alike(
        Kind::Leak,
        Warning,
        pairs,
        |count| {
            format!("of those held out, {count} can be found among those to train on, or taken from the same place")
        },
        "Test on photographs from other places: what is measured on these says nothing of new views.",
    );
}

fn far_cameras(views: &[&View], places: &[DVec3], size: f64, findings: &mut Findings) {
    /// The most cameras of which the distance to the nearest other is found.
    const ASKED: usize = 500;
    let middle = DVec3::from([0, 1, 2].map(|axis| median(places.iter().map(|place| place[axis]))));
    let usual = median(places.iter().map(|place| place.distance(middle)));
    let nearest = |i: usize| {
        let others = places.iter().enumerate().filter(|(j, _)| *j != i);
        others.map(|(_, other)| other.distance(places[i])).fold(f64::INFINITY, f64::min)
    };
    let gap = median(evenly_spaced((0..places.len()).collect(), ASKED).into_iter().map(nearest));
    let nearby = Nearby::new(places, |_| true, (8.0 * gap).max(ONE_PLACE * size));
    let far = |i: &usize| places[*i].distance(middle) > 4.0 * usual && nearby.of(*i).all(|j| j == *i);
    let names = (0..views.len()).filter(far).map(|i| views[i].name.clone()).collect();
    findings.about(
        Kind::FarCamera,
        Warning,
        names,
        |count| format!("the camera of {count} was far from all others"),
        "Their poses are probably wrong: leave them out. A single far camera makes the scene small in its box.",
    );
}

fn scale(capture: &Capture, places: &[DVec3], size: f64, findings: &mut Findings) {
    /// Shares of the distance of what is seen that cameras are apart.
    const PLAUSIBLE: [f64; 2] = [3e-3, 100.0];
    let mean = places.iter().sum::<DVec3>() / places.len() as f64;
    if capture.points.len() >= 10 {
        let distance = median(capture.points.iter().map(|point| point.position.distance(mean)));
        let share = size / distance;
        if !(PLAUSIBLE[0]..=PLAUSIBLE[1]).contains(&share) {
            findings.add(
                Kind::Scale,
                Warning,
                format!("cameras are {share:.1e} times as far apart as the points of the scene are from them"),
                "Give positions of cameras and points in one unit: one of them may be in millimetres.",
                vec![],
            );
        }
    }
    let from_origin = median(places.iter().map(|place| place.length()));
    if capture.format == Format::Blender && !(1.0..=20.0).contains(&from_origin) {
        findings.add(
            Kind::Scale,
            Warning,
            format!("cameras are {from_origin:.3} units from the origin, and about 4 in other scenes of this format"),
            "The scene's size is found out from its cameras, and not taken from the convention; scale positions if other \
             programs are to read the files.",
            vec![],
        );
    }
    if mean.length() > 1e5 * size {
        findings.add(
            Kind::FarFromOrigin,
            Note,
            format!("the cameras are {:.1e} units from the origin and {size:.1e} from each other", mean.length()),
            "The scene is moved to its own origin here; other programs may lose digits. Move the positions before writing them.",
            vec![],
        );
    }
}

fn roll(views: &[&View], up: DVec3, findings: &mut Findings) {
    let turned = |view: &&&View| {
        let axes = view.camera.pose.matrix3;
        let level = axes.z_axis.dot(up).abs() < POLE;
        level && axes.x_axis.dot(up).atan2(axes.y_axis.dot(up)).abs().to_degrees() > ROLL
    };
    let names: Vec<String> = views.iter().filter(turned).map(|view| view.name.clone()).collect();
    findings.about(
        Kind::Roll,
        Note,
        names,
        |count| format!("in {count} the camera was turned by more than 30 degrees about its axis"),
        "This is right where portrait and landscape are mixed. If not, some images are turned (EXIF) and their poses are not. \
         Up is found from all cameras, and may be off.",
    );
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
        findings.add(
            Kind::CoverageGap,
            Note,
            format!("seen from the middle, no camera stands in an angle of {gap:.0} degrees"),
            "New views from there show what no photograph has seen. Nothing is wrong if nobody is to look from there.",
            vec![],
        );
    }
}

fn in_the_box(views: &[&View], survey: &Survey, findings: &mut Findings) {
    /// Rays that are tried along each side of an image; the second where all of the first miss a box that may lie between.
    const RAYS: [usize; 2] = [12, 200];
    if survey.scope != Scope::Bounded {
        return;
    }
    let [low, high] = survey.bounds;
    let placed = |view: &View| survey.placement.camera(&view.camera);
    let inside = |view: &&&View| {
        let eye = placed(view).pose.translation;
        eye.cmpge(low).all() && eye.cmple(high).all()
    };
    let misses = |view: &&&View| {
        let camera = placed(view);
        let place = |i: usize, rays: usize, size: usize| (i as f64 + 0.5) / rays as f64 * size as f64;
        let past = |rays: usize| {
            (0..rays * rays).all(|i| {
                let ray = camera.ray(place(i % rays, rays, camera.width), place(i / rays, rays, camera.height));
                let [enter, leave] = clip_span(&ray, survey.bounds, [survey.near, survey.far]);
                !(enter < leave)
            })
        };
        camera.width > 0 && RAYS.into_iter().all(past)
    };
    findings.about(
        Kind::CameraInBox,
        Warning,
        views.iter().filter(inside).map(|view| view.name.clone()).collect(),
        |count| format!("the camera of {count} stands in the box that is to hold the scene"),
        "A scene that ends at its box is seen from outside. If it is a room, train with `--scope unbounded`.",
    );
    findings.about(
        Kind::MissesBox,
        Warning,
        views.iter().filter(misses).map(|view| view.name.clone()).collect(),
        |count| format!("nothing of the box that is to hold the scene is seen in {count}"),
        "They look past it: their poses are wrong, or they belong to another scene; leave them out.",
    );
}
