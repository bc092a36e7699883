//! What photographs say of their own quality, and of each other's.

use super::look::Look;
use super::report::{FindingKind as Kind, Findings, Severity};
use crate::dataset::load::same_shape;
use crate::dataset::{Capture, Photo, Split, View};
use crate::error::Result;
use crate::numbers::{median, spread};
use Severity::{Error, Note, Warning};
use std::collections::{HashMap, HashSet};

/// A photograph with what its pixels say.
pub(super) struct Seen<'a> {
    pub view: &'a View,
    pub look: &'a Look,
}

/// How many usual deviations an outlier is from the others.
const FAR: f64 = 5.0;
/// The least ratios that are worth a word: of the contrast of edges, of brightness, and of colours.
const BLUR: f64 = 4.0;
const BRIGHTNESS: f64 = 1.5;
const COLOUR: f64 = 1.2;
/// Neighbours that a photograph is compared with, and how far before it and behind it in the file they are looked for.
const NEIGHBOURS: usize = 6;
const AROUND: usize = 1000;

/// The sizes of the photographs, from the headers of their files, the most frequent first.
pub(super) fn sizes(capture: &Capture, findings: &mut Findings) -> Vec<([usize; 2], usize)> {
    let mut counts: HashMap<[usize; 2], usize> = HashMap::new();
    let (mut shapes, mut first) = (vec![], None);
    for view in capture.present() {
        let Some(Ok([stored, shown])) = view.image.as_ref().map(Photo::size_of_file) else { continue };
        *counts.entry(shown).or_default() += 1;
        if view.camera.width > 0 && !same_shape(stored, &view.camera) && !same_shape(shown, &view.camera) {
            let [w, h] = shown;
            first.get_or_insert_with(|| format!("{w}x{h} pixels for {}x{}", view.camera.width, view.camera.height));
            shapes.push(view.name.clone());
        }
    }
    let first = first.unwrap_or_default();
    findings.about(
        Kind::ShapeMismatch,
        Error,
        shapes,
        |count| format!("the shape of {count} is not that of the camera: {first}"),
        "Images that were cropped or turned after their cameras were measured cannot be used: take the original ones, or \
         measure again.",
    );
    let mut counts: Vec<_> = counts.into_iter().collect();
    counts.sort_by_key(|(size, count)| (std::cmp::Reverse(*count), *size));
    if counts.len() > 1 {
        let listed: Vec<String> = counts.iter().map(|([w, h], n)| format!("{n} of {w}x{h}")).collect();
        findings.add(
            Kind::MixedResolutions,
            Note,
            format!("photographs have several resolutions: {}", listed.join(", ")),
            "Nothing needs to be done: each is used at its own.",
            vec![],
        );
    }
    counts
}

/// Adds what photographs that cannot be read say.
pub(super) fn unreadable(looks: &[(String, Result<Look>)], findings: &mut Findings) {
    let errors: Vec<_> = looks.iter().filter_map(|(name, look)| Some((name, look.as_ref().err()?))).collect();
    let first = errors.first().map(|(_, error)| error.to_string()).unwrap_or_default();
    findings.about(
        Kind::ImagesUndecodable,
        Error,
        errors.iter().map(|(name, _)| (*name).clone()).collect(),
        |count| format!("the images or masks of {count} cannot be decoded; the first: {first}"),
        "Copy these files again, or take them out of the capture; PNG, JPEG and WebP can be read.",
    );
}

/// Adds what is wrong with photographs that can be read.
pub(super) fn examine(seen: &[Seen<'_>], findings: &mut Findings) {
    duplicates(seen, findings);
    blurred(seen, findings);
    light(seen, findings);
    masks(seen, findings);
    alpha(seen, findings);
}

fn duplicates(seen: &[Seen<'_>], findings: &mut Findings) {
    let mut first: HashMap<u64, &View> = HashMap::new();
    let (mut same, mut leaks) = (vec![], vec![]);
    for Seen { view, look } in seen {
        // Images of one colour are all alike.
        if look.sharpness.is_none() {
            continue;
        }
        let Some(other) = first.get(&look.hash) else {
            first.insert(look.hash, view);
            continue;
        };
        let named = [view.name.clone(), other.name.clone()];
        let across = (view.split == Some(Split::Train)) != (other.split == Some(Split::Train));
        if across { leaks.push(named) } else { same.push(named) }
    }
    findings.alike(
        Kind::DuplicateImages,
        Warning,
        same,
        |count| format!("the image of {count} is pixel by pixel that of another"),
        "If their poses differ, one of them is wrong; if not, one photograph counts twice. Leave one out.",
    );
    if !leaks.is_empty() && !findings.0.iter().any(|finding| finding.kind == Kind::Leak) {
        super::layout::leak(leaks, findings);
    }
}

/// Of each value how far it is from the median of the neighbours' that have one: what all around share is no fault.
fn residuals(seen: &[Seen<'_>], value: impl Fn(&Look) -> Option<f64>) -> Vec<Option<f64>> {
    let values: Vec<Option<f64>> = seen.iter().map(|one| value(one.look)).collect();
    let pose = |i: usize| seen[i].view.camera.pose;
    let gap = |i: usize, j: usize| pose(i).translation.distance(pose(j).translation);
    let usual = median((0..seen.len()).map(|i| gap(i, 0))).max(f64::MIN_POSITIVE);
    let residual = |i: usize| {
        let own = values[i]?;
        // The nearest so far, the nearest first.
        let mut others: Vec<(f64, f64)> = vec![];
        for j in (i.saturating_sub(AROUND)..seen.len().min(i + AROUND)).filter(|j| *j != i) {
            let Some(value) = values[j] else { continue };
            let angle = pose(i).matrix3.z_axis.angle_between(pose(j).matrix3.z_axis);
            let distance = gap(i, j) / usual + angle;
            let place = others.partition_point(|(other, _)| other.total_cmp(&distance).is_le());
            if place < NEIGHBOURS {
                others.truncate(NEIGHBOURS - 1);
                others.insert(place, (distance, value));
            }
        }
        (others.len() >= 3).then(|| own - median(others.iter().map(|(_, value)| *value)))
    };
    (0..seen.len()).map(residual).collect()
}

/// The names of the photographs whose value is this far from their neighbours', and from what is usual.
fn outliers(seen: &[Seen<'_>], residuals: &[Option<f64>], least: f64, wrong: impl Fn(f64) -> f64) -> Vec<String> {
    let known: Vec<f64> = residuals.iter().flatten().copied().collect();
    let limit = (FAR * spread(&known)).max(least);
    let far = |residual: &Option<f64>| residual.is_some_and(|x| wrong(x) > limit);
    residuals.iter().zip(seen).filter(|(x, _)| far(x)).map(|(_, one)| one.view.name.clone()).collect()
}

fn blurred(seen: &[Seen<'_>], findings: &mut Findings) {
    let residuals = residuals(seen, |look| look.sharpness);
    findings.about(
        Kind::Blurred,
        Warning,
        outliers(seen, &residuals, BLUR.ln(), |x| -x),
        |count| format!("the sharpness of {count} is far below that of those beside"),
        "Leave them out if others show the same: what is blurred in a photograph becomes blurred in the scene.",
    );
}

fn light(seen: &[Seen<'_>], findings: &mut Findings) {
    let brightness = residuals(seen, |look| look.luminance);
    findings.about(
        Kind::ExposureJump,
        Warning,
        outliers(seen, &brightness, BRIGHTNESS.ln(), f64::abs),
        |count| format!("the brightness of {count} is far from that of those beside"),
        "Photograph with a fixed exposure. With photographs as they are, codes for each photograph (`--set field.codes=8`) \
         take up what differs.",
    );
    let unbalanced = |colour: usize| {
        let balance = residuals(seen, |look| look.luminance.map(|_| look.balance[colour]));
        outliers(seen, &balance, COLOUR.ln(), f64::abs)
    };
    let mut names = unbalanced(0);
    let known: HashSet<String> = names.iter().cloned().collect();
    names.extend(unbalanced(1).into_iter().filter(|name| !known.contains(name)));
    findings.about(
        Kind::WhiteBalanceJump,
        Warning,
        names,
        |count| format!("the balance of colours in {count} is far from that of those beside"),
        "Photograph with a fixed white balance. With photographs as they are, codes for each photograph \
         (`--set field.codes=8`) take up what differs.",
    );
}

fn masks(seen: &[Seen<'_>], findings: &mut Findings) {
    let with = |share: f64| -> Vec<String> {
        seen.iter().filter(|one| one.look.used == Some(share)).map(|one| one.view.name.clone()).collect()
    };
    findings.about(
        Kind::MaskHidesAll,
        Error,
        with(0.0),
        |count| format!("the masks of {count} hide all of it"),
        "Masks are white where a photograph is used: they may be the wrong way round. Leave these photographs out otherwise.",
    );
    findings.about(
        Kind::MaskHidesNothing,
        Note,
        with(1.0),
        |count| format!("the masks of {count} hide nothing"),
        "Nothing needs to be done if there is nothing to hide.",
    );
}

fn alpha(seen: &[Seen<'_>], findings: &mut Findings) {
    let names: Vec<String> =
        seen.iter().filter(|one| one.look.transparent == Some(false)).map(|one| one.view.name.clone()).collect();
    let mixed = seen.iter().any(|one| one.look.transparent == Some(true));
    let severity = if mixed { Warning } else { Note };
    findings.about(
        Kind::OpaqueAlpha,
        severity,
        names,
        |count| format!("the alpha channel of {count} is opaque throughout"),
        if mixed {
            "Others are transparent where there is nothing: these were saved without, and their background is learned as part \
             of the scene."
        } else {
            "They say nothing, and the scene is taken to go on behind. If it does not, save what is transparent as such."
        },
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use glam::{DAffine3, DVec3};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    #[test]
    fn residuals_are_from_the_median_of_the_nearest() {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        for count in [3, 4, 9, 40, 2500] {
            let mut number = || rng.random::<f64>();
            let views: Vec<View> = (0..count)
                .map(|i| {
                    let pose = Camera::look_at(DVec3::new(number(), number(), 1.0 + number()), DVec3::ZERO, DVec3::Z);
                    let camera = Camera::from_angle(8, 8, 0.7, pose);
                    let name = i.to_string();
                    let field = name.clone();
                    let (image, split, mask, depth, sharpness, bounds) = (None, None, None, None, None, None);
                    View { name, field, image, camera, split, mask, depth, sharpness, bounds }
                })
                .collect();
            let looks: Vec<Look> = (0..count)
                .map(|i| Look {
                    transparent: None,
                    hash: 0,
                    sharpness: (i % 5 != 2).then(&mut number),
                    luminance: None,
                    balance: [0.0; 2],
                    used: None,
                    picture: None,
                })
                .collect();
            let seen: Vec<Seen<'_>> = views.iter().zip(&looks).map(|(view, look)| Seen { view, look }).collect();
            let pose = |i: usize| -> DAffine3 { views[i].camera.pose };
            let gap = |i: usize, j: usize| pose(i).translation.distance(pose(j).translation);
            let usual = median((0..count).map(|i| gap(i, 0)));
            let found = residuals(&seen, |look| look.sharpness);
            for i in (0..count).step_by(count.div_ceil(60)) {
                // All that stand not too far away in the file, in order.
                let mut others: Vec<(f64, f64)> = (0..count)
                    .filter(|j| *j != i && i.saturating_sub(AROUND) <= *j && *j < i + AROUND)
                    .filter_map(|j| {
                        let angle = pose(i).matrix3.z_axis.angle_between(pose(j).matrix3.z_axis);
                        Some((gap(i, j) / usual + angle, looks[j].sharpness?))
                    })
                    .collect();
                others.sort_by(|a, b| a.0.total_cmp(&b.0));
                let nearest = others.iter().take(6).map(|(_, value)| *value);
                let expected = looks[i].sharpness.filter(|_| others.len() >= 3).map(|own| own - median(nearest));
                assert_eq!(found[i], expected, "{i} of {count}");
            }
        }
    }
}
