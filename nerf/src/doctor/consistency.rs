//! Findings from how well images match their neighbours: the convention and the order of the poses, and single wrong
//! poses.

use super::agreement::{Pair, Placed, Tally, compare};
use super::kinds::{FindingKind as Kind, Severity};
use super::order::Order;
use super::picture::Picture;
use super::poses::Convention;
use super::report::Findings;
use crate::dataset::{View, evenly_spaced};
use crate::numbers::median;
use glam::DAffine3;
use std::collections::BTreeMap;

/// Images compared with their neighbours under each convention.
const TRIED: usize = 12;
/// The fewest matched patches for a verdict.
const ENOUGH: usize = 100;
/// Fewer matched patches as read count as no agreement when hypotheses are compared with it.
const SOME: usize = 25;
/// The fewest for a single image, and its least distance from the others in standard deviations.
const FEWEST: usize = 8;
const DEVIATIONS: f64 = 4.0;
/// The agreement of good cameras.
const GOOD: f64 = 0.2;
/// Above this agreement, no hypothesis about the poses is tried.
const CLEAR: f64 = 0.7;
/// Below this agreement, images and cameras do not match. The report calls it poor.
const NONE: f64 = 0.1;
/// An image is wrong if its agreement is below this share of the median.
const WRONG: f64 = 0.35;

/// What may be wrong with all poses.
#[derive(Clone, Copy)]
enum Hypothesis {
    Convention(Convention),
    Order(Order),
}

/// Adds findings about agreement between images; returns the agreement, if enough patches match, and the number of
/// images that were compared for it.
pub(super) fn examine(all: &[(&View, &Picture)], most: usize, findings: &mut Findings) -> (Option<f64>, usize) {
    let poses: Vec<DAffine3> = all.iter().map(|(view, _)| view.camera.pose).collect();
    let placed = |pose: &dyn Fn(usize) -> DAffine3| -> Vec<Placed<'_>> {
        all.iter().enumerate().map(|(i, (_, picture))| Placed { picture, pose: pose(i) }).collect()
    };
    let as_read = placed(&|i| poses[i]);
    let tried = evenly_spaced((0..all.len()).collect(), TRIED);
    let pairs = compare(&as_read, &tried);
    let read = total(&pairs);
    let own = if read.trials >= SOME { read.skill() } else { 0.0 };
    if own < CLEAR {
        let names: Vec<&str> = all.iter().map(|(view, _)| &view.name[..]).collect();
        let conventions = Convention::ALL[1..]
            .iter()
            .map(|&convention| (Hypothesis::Convention(convention), placed(&|i| convention.apply(poses[i]))));
        let orders = Order::ALL.iter().filter_map(|&order| {
            let from = order.poses(&names)?;
            Some((Hypothesis::Order(order), placed(&|i| poses[from[i]])))
        });
        let first: Vec<usize> = tried.iter().copied().skip(1).step_by(3).collect();
        let rest: Vec<usize> = tried.iter().copied().filter(|i| !first.contains(i)).collect();
        let tallies = conventions.chain(orders).map(|(hypothesis, placed)| {
            // Most hypotheses are wrong, and a third of the images shows it.
            let mut tally = total(&compare(&placed, &first));
            if tally.trials < SOME || tally.skill() > NONE {
                tally += total(&compare(&placed, &rest));
            }
            (hypothesis, tally)
        });
        let enough = tallies.filter(|(_, tally)| tally.trials >= ENOUGH);
        let best = enough.max_by(|a, b| a.1.skill().total_cmp(&b.1.skill()));
        if let Some((hypothesis, tally)) = best.filter(|(_, tally)| is_better(tally.skill(), own)) {
            another(hypothesis, [own, tally.skill()], findings);
            return (Some(own), tried.len());
        }
    }
    if read.trials < ENOUGH {
        return (None, tried.len());
    }
    if own > GOOD {
        // What poses alone suggested is not so.
        findings.0.retain(|finding| finding.severity == Severity::Error || !is_of_convention(finding.kind));
    }
    if own < NONE && read.trials >= 2 * ENOUGH {
        findings.add(Kind::NoAgreement, &[]);
        return (Some(own), tried.len());
    }
    let of = evenly_spaced((0..all.len()).collect(), most);
    let pairs = if of == tried { pairs } else { compare(&as_read, &of) };
    findings.about(Kind::WrongPose, wrong_poses(&pairs).into_iter().map(|i| all[i].0), &[]);
    (Some(total(&pairs).skill()), of.len())
}

/// Returns true if images agree so much better under a hypothesis that the poses as read are wrong.
fn is_better(other: f64, own: f64) -> bool {
    other > GOOD && (other > 2.0 * own || 1.0 - other < 0.5 * (1.0 - own))
}

fn total(pairs: &[Pair]) -> Tally {
    let mut total = Tally::default();
    pairs.iter().for_each(|pair| total += pair.tally);
    total
}

/// Returns true for findings about the convention from poses and points.
fn is_of_convention(kind: Kind) -> bool {
    matches!(kind, Kind::LooksAway | Kind::OpenCvAxes | Kind::WorldToCamera)
}

/// Adds the finding that images match under a hypothesis.
fn another(hypothesis: Hypothesis, [own, other]: [f64; 2], findings: &mut Findings) {
    // The images decide, so findings from poses alone are obsolete.
    findings.0.retain(|finding| !is_of_convention(finding.kind) && finding.kind != Kind::OnePlace);
    let finding = match hypothesis {
        Hypothesis::Order(order) => findings.add(Kind::PoseOrder, &[&order.text()]),
        Hypothesis::Convention(convention) => match convention {
            Convention::AsRead => return,
            Convention::OpenCv => findings.add(Kind::OpenCvAxes, &[]),
            Convention::UpsideDown | Convention::Mitsuba => findings.add(Kind::TurnedCameras, &[]),
            Convention::WorldToCamera | Convention::WorldToOpenCv => findings.add(Kind::WorldToCamera, &[]),
            Convention::Mirrored | Convention::MirroredUpsideDown | Convention::MirroredBackwards => {
                findings.add(Kind::Mirrored, &[])
            }
        },
    };
    finding.what += &format!(" (agreement {other:.2} if changed, {own:.2} as read)");
    finding.advice += match hypothesis {
        Hypothesis::Convention(Convention::WorldToOpenCv) => {
            " Then negate the second and third columns: the camera axes are OpenCV's."
        }
        Hypothesis::Convention(Convention::UpsideDown) => {
            " These are the first and the second one. Or turn the images, if their EXIF orientation counts in the poses \
             alone."
        }
        Hypothesis::Convention(Convention::Mitsuba) => {
            " These are the first and the third one: the camera axes are Mitsuba's."
        }
        _ => "",
    };
}

/// The indices of images that do not match their neighbours, although the neighbours match each other.
fn wrong_poses(pairs: &[Pair]) -> Vec<usize> {
    let mut wrong: Vec<usize> = vec![];
    // Removes the worst first, since one wrong camera lowers the agreement of its neighbours.
    loop {
        let mut tallies: BTreeMap<usize, Tally> = BTreeMap::new();
        for pair in pairs.iter().filter(|pair| pair.views.iter().all(|view| !wrong.contains(view))) {
            pair.views.iter().for_each(|view| *tallies.entry(*view).or_default() += pair.tally);
        }
        tallies.retain(|_, tally| tally.trials >= FEWEST);
        let usual = median(tallies.values().map(|tally| tally.skill()));
        let worst = tallies.into_iter().min_by(|a, b| a.1.skill().total_cmp(&b.1.skill()));
        match worst.filter(|(_, tally)| usual >= GOOD && is_wrong(*tally, usual)) {
            Some((view, _)) => wrong.push(view),
            None => break,
        }
    }
    wrong.sort_unstable();
    wrong
}

/// Returns true if an image matches significantly less than the others.
fn is_wrong(tally: Tally, usual: f64) -> bool {
    let (count, rate) = (tally.trials as f64, Tally::rate(usual));
    let deviation = (count * rate * (1.0 - rate)).sqrt();
    tally.skill() < WRONG * usual && (tally.wins as f64) < count * rate - DEVIATIONS * deviation
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hypotheses_must_agree_far_better() {
        // Twice the agreement, or half of the disagreement.
        for (other, own, expected) in [
            (0.45, 0.2, true),
            (0.35, 0.2, false),
            (0.8, 0.54, true),
            (0.7, 0.54, false),
            (0.9, 0.69, true),
            (0.19, 0.0, false),
            (0.21, 0.0, true),
            (f64::NAN, 0.0, false),
        ] {
            assert_eq!(is_better(other, own), expected, "{other} for {own}");
        }
    }
}
