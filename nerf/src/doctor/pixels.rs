//! Findings from pixels: blur, exposure, colour balance, masks, alpha and duplicates.

use super::kinds::{FindingKind as Kind, Severity};
use super::look::Look;
use super::report::Findings;
use crate::dataset::image_size::used_size;
use crate::dataset::load::mask_fits;
use crate::dataset::{Capture, EmptyBackground, Photo, SceneAnalysis, SceneType, Split, View};
use crate::error::{Error, Result};
use crate::numbers::{median, spread};
use glam::DVec3;
use std::collections::{HashMap, HashSet};

/// An image and the measurements of its pixels.
pub(super) struct Seen<'a> {
    pub view: &'a View,
    pub look: &'a Look,
}

/// The least distance of an outlier from the others, in robust standard deviations.
const FAR: f64 = 5.0;
/// The smallest reported ratios of edge contrast, brightness and colour balance.
const BLUR: f64 = 4.0;
const BRIGHTNESS: f64 = 1.5;
const COLOUR: f64 = 1.2;
/// The neighbours that an image is compared with, and the range of the search before and after it in the file.
const NEIGHBOURS: usize = 6;
const AROUND: usize = 1000;

/// The most sizes that a finding lists.
const LISTED: usize = 8;

/// The sizes of the images, from their headers, the most frequent first.
pub(super) fn sizes(capture: &Capture, findings: &mut Findings) -> Vec<([usize; 2], usize)> {
    let mut counts: HashMap<[usize; 2], usize> = HashMap::new();
    let (mut shapes, mut first) = (vec![], String::new());
    let (mut masks, mut first_mask) = (vec![], String::new());
    for view in capture.present() {
        let Some(Ok([stored, shown])) = view.image.as_ref().map(Photo::size_of_file) else { continue };
        let used = used_size([stored, shown], &view.camera);
        *counts.entry(used.unwrap_or(shown)).or_default() += 1;
        if view.camera.width > 0 && used.is_none() {
            if shapes.is_empty() {
                let [w, h] = shown;
                first = format!("{w}x{h} pixels, the camera has {}x{}", view.camera.width, view.camera.height);
            }
            shapes.push(view);
        }
        let Some(Ok([_, mask])) = view.mask.as_ref().map(Photo::size_of_file) else { continue };
        if !mask_fits(mask, stored) && !mask_fits(mask, shown) {
            if masks.is_empty() {
                first_mask = format!("{}x{} pixels, the image has {}x{}", mask[0], mask[1], shown[0], shown[1]);
            }
            masks.push(view);
        }
    }
    findings.about(Kind::ShapeMismatch, shapes, &[&first]);
    findings.about(Kind::MaskShape, masks, &[&first_mask]);
    let mut counts: Vec<_> = counts.into_iter().collect();
    counts.sort_by_key(|(size, count)| (std::cmp::Reverse(*count), *size));
    if counts.len() > 1 {
        let mut listed: Vec<String> = counts.iter().take(LISTED).map(|([w, h], n)| format!("{n} of {w}x{h}")).collect();
        if counts.len() > LISTED {
            listed.push(format!("and {} more", counts.len() - LISTED));
        }
        findings.add(Kind::MixedResolutions, &[&listed.join(", ")]);
    }
    counts
}

/// Returns true if the images show an object on a transparent background.
fn is_cutout(analysis: Option<&SceneAnalysis>) -> bool {
    let is_cut = |analysis: &SceneAnalysis| {
        analysis.scene_type == SceneType::Bounded && analysis.empty == Some(EmptyBackground::Transparent)
    };
    analysis.is_some_and(is_cut)
}

/// Adds a finding about images without an alpha channel among those that show an object on a transparent background.
pub(super) fn without_alpha(capture: &Capture, analysis: Option<&SceneAnalysis>, findings: &mut Findings) {
    if !is_cutout(analysis) {
        return;
    }
    let has_alpha = |view: &View| Photo::file_has_alpha(view.image.as_ref()?).ok();
    let (with, without): (Vec<_>, Vec<_>) =
        capture.present().filter_map(|view| Some((view, has_alpha(view)?))).partition(|(_, has_alpha)| *has_alpha);
    if without.len() < with.len() {
        findings.about(Kind::NoAlpha, without.into_iter().map(|(view, _)| view), &[]);
    }
}

/// Adds findings about images that cannot be decoded, and about their masks.
pub(super) fn unreadable(looks: &[(&View, Result<Look>)], findings: &mut Findings) {
    let errors = looks.iter().filter_map(|(view, look)| Some((*view, look.as_ref().err()?)));
    let is_of_mask =
        |(view, error): &(&View, &Error)| matches!(error, Error::File { path, .. } if view.mask.as_ref() == Some(path));
    let (masks, images): (Vec<_>, Vec<_>) = errors.partition(is_of_mask);
    for (kind, errors) in [(Kind::ImagesUndecodable, images), (Kind::MaskUnusable, masks)] {
        if let Some((_, first)) = errors.first() {
            findings.about(kind, errors.iter().map(|(view, _)| *view), &[first]);
        }
    }
}

/// Adds findings about images that can be decoded.
pub(super) fn examine(seen: &[Seen<'_>], analysis: Option<&SceneAnalysis>, findings: &mut Findings) {
    duplicates(seen, findings);
    blurred(seen, findings);
    light(seen, findings);
    masks(seen, findings);
    alpha(seen, is_cutout(analysis), findings);
    let unread = seen.iter().filter(|one| one.look.unread_profile);
    findings.about(Kind::ColorProfile, unread.map(|one| one.view), &[]);
}

fn duplicates(seen: &[Seen<'_>], findings: &mut Findings) {
    if seen.len() > 1 && seen.iter().all(|one| one.look.hash == seen[0].look.hash) {
        findings.about(Kind::IdenticalImages, seen.iter().map(|one| one.view), &[]);
        return;
    }
    let mut first: HashMap<u64, &View> = HashMap::new();
    let (mut same, mut leaks) = (vec![], vec![]);
    // Beside images in splits, those in none are not used.
    let has_splits = seen.iter().any(|one| one.view.split.is_some());
    for Seen { view, look } in seen {
        // All images of one colour are equal.
        if look.sharpness.is_none() || has_splits && view.split.is_none() {
            continue;
        }
        let Some(other) = first.get(&look.hash) else {
            first.insert(look.hash, view);
            continue;
        };
        let is_trained = [*view, *other].map(|view| view.split.map(|split| split == Split::Train));
        match is_trained {
            [Some(true), Some(false)] => leaks.push([*other, *view]),
            [Some(false), Some(true)] => leaks.push([*view, *other]),
            _ => same.push([*view, *other]),
        }
    }
    findings.alike(Kind::DuplicateImages, &same);
    let known: HashSet<String> = findings
        .0
        .iter()
        .filter(|finding| finding.kind == Kind::Leak)
        .flat_map(|finding| finding.views.clone())
        .collect();
    leaks.retain(|[view, _]| !known.contains(&view.name));
    findings.alike(Kind::Leak, &leaks);
}

/// The difference of each value from the median of its neighbours. A value that all neighbours share is not a fault.
fn residuals(seen: &[Seen<'_>], value: impl Fn(&Look) -> Option<f64>) -> Vec<Option<f64>> {
    let values: Vec<Option<f64>> = seen.iter().map(|one| value(one.look)).collect();
    let pose = |i: usize| seen[i].view.camera.pose;
    let gap = |i: usize, j: usize| pose(i).translation.distance(pose(j).translation);
    let middle = DVec3::from([0, 1, 2].map(|axis| median((0..seen.len()).map(|i| pose(i).translation[axis]))));
    let usual = median((0..seen.len()).map(|i| pose(i).translation.distance(middle))).max(f64::MIN_POSITIVE);
    let residual = |i: usize| {
        let own = values[i]?;
        // The nearest so far, in order of distance.
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

/// The images whose residual exceeds `least` and `FAR` deviations.
fn outliers<'a>(seen: &[Seen<'a>], residuals: &[Option<f64>], least: f64, wrong: impl Fn(f64) -> f64) -> Vec<&'a View> {
    let known: Vec<f64> = residuals.iter().flatten().copied().collect();
    let limit = (FAR * spread(&known)).max(least);
    let far = |residual: &Option<f64>| residual.is_some_and(|x| wrong(x) > limit);
    residuals.iter().zip(seen).filter(|(x, _)| far(x)).map(|(_, one)| one.view).collect()
}

fn blurred(seen: &[Seen<'_>], findings: &mut Findings) {
    let residuals = residuals(seen, |look| look.sharpness);
    findings.about(Kind::Blurred, outliers(seen, &residuals, BLUR.ln(), |x| -x), &[]);
}

fn light(seen: &[Seen<'_>], findings: &mut Findings) {
    let brightness = residuals(seen, |look| look.luminance);
    findings.about(Kind::ExposureJump, outliers(seen, &brightness, BRIGHTNESS.ln(), f64::abs), &[]);
    let unbalanced = |colour: usize| {
        let balance = residuals(seen, |look| look.luminance.map(|_| look.balance[colour]));
        outliers(seen, &balance, COLOUR.ln(), f64::abs)
    };
    let mut views = unbalanced(0);
    let known: HashSet<&str> = views.iter().map(|view| view.name.as_str()).collect();
    views.extend(unbalanced(1).into_iter().filter(|view| !known.contains(view.name.as_str())));
    findings.about(Kind::WhiteBalanceJump, views, &[]);
}

fn masks(seen: &[Seen<'_>], findings: &mut Findings) {
    let with = |share: f64| seen.iter().filter(move |one| one.look.used == Some(share)).map(|one| one.view);
    if let Some(finding) = findings.about(Kind::MaskHidesAll, with(0.0), &[])
        && finding.views.len() == seen.len()
    {
        finding.severity = Severity::Error;
    }
    findings.about(Kind::MaskHidesNothing, with(1.0), &[]);
}

fn alpha(seen: &[Seen<'_>], is_cutout: bool, findings: &mut Findings) {
    let with = |transparent| seen.iter().filter(move |one| one.look.transparent == Some(transparent));
    let hollow: Vec<&View> = seen.iter().filter(|one| one.look.hollow).map(|one| one.view).collect();
    // A ring or a window may surround single images.
    if 2 * hollow.len() > seen.len() {
        findings.about(Kind::HollowAlpha, hollow, &[]);
    }
    let opaque = findings.about(Kind::OpaqueAlpha, with(false).map(|one| one.view), &[]);
    // Of other scenes, undistortion may have cleared corners.
    let [clear, full] = [true, false].map(|transparent| with(transparent).count());
    if let Some(finding) = opaque
        && is_cutout
        && full < clear
    {
        finding.severity = Severity::Warning;
        finding.advice = Kind::NoAlpha.text().advice.to_owned();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::dataset::{Format, Image};
    use crate::doctor::look::look_at_all;
    use glam::{DAffine3, DVec3};
    use image::codecs::png::PngEncoder;
    use image::{ExtendedColorType, ImageEncoder};
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    #[test]
    fn unusable_masks_are_no_fault_of_images() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, contents: &[u8]| {
            let path = folder.path().join(name);
            std::fs::write(&path, contents).unwrap();
            Some(path)
        };
        let camera = Camera::from_angle(8, 6, 0.7, DAffine3::IDENTITY);
        let mut numbers = Image::new(8, 6, 1);
        (0..3).for_each(|i| numbers.data[i] = 0.1 * i as f32);
        let [good, numbers, damaged] = [Image::new(8, 6, 3).to_png(), numbers.to_png(), vec![1, 2]];
        let view = |i: usize| {
            let (image, mask) = [(&good, &good), (&good, &numbers), (&good, &damaged), (&damaged, &good)][i];
            let [image, mask] = [write(&format!("{i}.png"), image), write(&format!("mask{i}.png"), mask)];
            View { image, mask, ..View::new(i.to_string(), i.to_string(), camera.clone()) }
        };
        let views = (0..4).map(view).collect();
        let capture = Capture::new(folder.path(), "transforms.json".into(), Format::Transforms, views);
        let looks = look_at_all(&capture, &|_, _| {});
        let mut findings = Findings::default();
        unreadable(&looks, &mut findings);
        let found = findings.sorted(None);
        let found: Vec<_> =
            found.iter().map(|finding| (finding.kind, finding.views.join(" "), &finding.what)).collect();
        let [images, masks] = &found[..] else { panic!("{found:?}") };
        assert_eq!((images.0, images.1.as_str()), (Kind::ImagesUndecodable, "3"));
        assert_eq!((masks.0, masks.1.as_str()), (Kind::MaskUnusable, "1 2"));
        assert!(
            masks.2.contains("of 2 images; the first: ") && masks.2.contains("mask1.png: has no white"),
            "{masks:?}"
        );
    }

    #[test]
    fn masks_of_another_shape_are_found() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, width: usize, height: usize| {
            let path = folder.path().join(name);
            Image::new(width, height, 1).save_png(&path).unwrap();
            Some(path)
        };
        let camera = Camera::from_angle(8, 6, 0.7, DAffine3::IDENTITY);
        let view = |i: usize| {
            let [width, height] = [[16, 12], [4, 3], [8, 8], [6, 8]][i];
            let [image, mask] = [write("a.png", 8, 6), write(&format!("mask{i}.png"), width, height)];
            View { image, mask, ..View::new(i.to_string(), i.to_string(), camera.clone()) }
        };
        let views = (0..4).map(view).collect();
        let capture = Capture::new(folder.path(), "transforms.json".into(), Format::Transforms, views);
        let mut findings = Findings::default();
        assert_eq!(sizes(&capture, &mut findings), [([8, 6], 4)]);
        let [found] = &findings.sorted(None)[..] else { panic!("not one finding") };
        assert_eq!((found.kind, &found.views[..]), (Kind::MaskShape, &["2".to_owned(), "3".to_owned()][..]));
        assert!(found.what.ends_with("of 2 images: 8x8 pixels, the image has 8x6"), "{}", found.what);
    }

    #[test]
    fn sizes_are_those_that_the_cameras_have() {
        let folder = tempfile::tempdir().unwrap();
        let view = |(orientation, [width, height]): (u8, [usize; 2])| {
            let path = folder.path().join(format!("{orientation}-{width}.jpg"));
            std::fs::write(&path, crate::dataset::photo::tests::jpeg(orientation)).unwrap();
            let camera = Camera::from_angle(width, height, 0.7, DAffine3::IDENTITY);
            View { image: Some(path), ..View::new(format!("{orientation} {width}"), "", camera) }
        };
        for (images, sizes_found, findings_found) in [
            ([(1, [16, 8]), (6, [16, 8])], vec![([16, 8], 2)], vec![]),
            ([(6, [8, 16]), (8, [8, 16])], vec![([8, 16], 2)], vec![]),
            ([(6, [8, 16]), (6, [16, 8])], vec![([8, 16], 1), ([16, 8], 1)], vec![Kind::MixedResolutions]),
        ] {
            let views = images.map(view).into();
            let capture = Capture::new(folder.path(), "transforms.json".into(), Format::Transforms, views);
            let mut findings = Findings::default();
            assert_eq!(sizes(&capture, &mut findings), sizes_found, "{images:?}");
            let kinds: Vec<Kind> = findings.sorted(None).iter().map(|finding| finding.kind).collect();
            assert_eq!(kinds, findings_found, "{images:?}");
        }
    }

    #[test]
    fn unread_color_profiles_are_found() {
        let folder = tempfile::tempdir().unwrap();
        let view = |i: u32| {
            let path = folder.path().join(format!("{i}.png"));
            let mut bytes = vec![];
            let mut encoder = PngEncoder::new(&mut bytes);
            if i == 1 {
                encoder.set_icc_profile(vec![7; 300]).unwrap();
            }
            encoder.write_image(&[i as u8; 48], 4, 4, ExtendedColorType::Rgb8).unwrap();
            std::fs::write(&path, bytes).unwrap();
            let camera = Camera::from_angle(4, 4, 0.7, DAffine3::IDENTITY);
            View { image: Some(path), ..View::new(i.to_string(), i.to_string(), camera) }
        };
        let views = (0..3).map(view).collect();
        let capture = Capture::new(folder.path(), "transforms.json".into(), Format::Transforms, views);
        let looks = look_at_all(&capture, &|_, _| {});
        let seen: Vec<_> = looks.iter().map(|(view, look)| Seen { view, look: look.as_ref().unwrap() }).collect();
        let mut findings = Findings::default();
        examine(&seen, None, &mut findings);
        let [found] = &findings.sorted(None)[..] else { panic!("not one finding") };
        assert_eq!((found.kind, &found.views[..]), (Kind::ColorProfile, &["1".to_owned()][..]));
        assert_eq!(found.what, "cannot read the colour profile of 1 image; colours count as sRGB");
    }

    #[test]
    fn residuals_are_from_the_median_of_the_nearest() {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        for count in [3_usize, 4, 9, 40, 2500] {
            let mut number = || rng.random::<f64>();
            let views: Vec<View> = (0..count)
                .map(|i| {
                    let pose = Camera::look_at(DVec3::new(number(), number(), 1.0 + number()), DVec3::ZERO, DVec3::Z);
                    let camera = Camera::from_angle(8, 8, 0.7, pose);
                    View::new(i.to_string(), i.to_string(), camera)
                })
                .collect();
            let looks: Vec<Look> = (0..count)
                .map(|i| Look {
                    transparent: None,
                    hollow: false,
                    unread_profile: false,
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
            let places = || views.iter().map(|view| view.camera.pose.translation);
            let middle = DVec3::from([0, 1, 2].map(|axis| median(places().map(|place| place[axis]))));
            let usual = median(places().map(|place| place.distance(middle)));
            let found = residuals(&seen, |look| look.sharpness);
            for i in (0..count).step_by(count.div_ceil(60)) {
                // All images in the range of the search, in order.
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
