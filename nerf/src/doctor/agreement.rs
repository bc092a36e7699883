//! Agreement of images with their cameras along epipolar lines.
//!
//! Patches of one image are searched in another: along the epipolar line, and along parallel lines beside it. The share
//! of patches whose best match is on the epipolar line measures agreement: a fifth by chance, nearly all for right
//! cameras. Errors such as reflections affect all lines alike.

use super::nearby::{distinct, usual_gap};
use super::picture::{Patch, Picture};
use super::poses::Focus;
use glam::{DAffine3, DMat3, DVec3};
use raygrad_tensor::parallel;

/// The most neighbours that an image is compared with.
const NEIGHBOURS: usize = 5;
/// The angle between optical axes, in radians, beyond which images hardly match.
const ANGLE: f64 = 0.8;
/// Offsets of the compared lines from the epipolar line of a patch, in pixels.
const BESIDE: [f64; 5] = [0.0, -16.0, -8.0, 8.0, 16.0];
/// The normalised cross-correlation above which patches match.
const ALIKE: f32 = 0.8;
/// Pixels between the positions of a search, and the most positions.
const STEP: f64 = 1.3;
const MOST_STEPS: f64 = 160.0;

/// An image with its pose.
#[derive(Clone, Copy)]
pub(super) struct Placed<'a> {
    pub picture: &'a Picture,
    pub pose: DAffine3,
}

/// Counts of patches with the best match on the epipolar line.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Tally {
    /// Patches with the best match there.
    pub wins: usize,
    /// Patches that have a match on some line.
    pub trials: usize,
}

impl Tally {
    /// 1 if all match on the epipolar line, 0 at chance.
    pub fn skill(self) -> f64 {
        let chance = 1.0 / BESIDE.len() as f64;
        (self.wins as f64 / self.trials.max(1) as f64 - chance) / (1.0 - chance)
    }

    /// The win rate at this skill.
    pub fn rate(skill: f64) -> f64 {
        let chance = 1.0 / BESIDE.len() as f64;
        chance + (1.0 - chance) * skill
    }
}

impl std::ops::AddAssign for Tally {
    fn add_assign(&mut self, other: Tally) {
        *self = Tally { wins: self.wins + other.wins, trials: self.trials + other.trials };
    }
}

/// Two compared images, by index.
pub(super) struct Pair {
    pub views: [usize; 2],
    pub tally: Tally,
}

/// Compares the images with indices `of` with their neighbours, in parallel.
pub(super) fn compare(all: &[Placed<'_>], of: &[usize]) -> Vec<Pair> {
    let poses: Vec<DAffine3> = all.iter().map(|placed| placed.pose).collect();
    let focus = Focus::of(&poses).filter(|focus| focus.ahead > 0.75);
    let places: Vec<DVec3> = poses.iter().map(|pose| pose.translation).collect();
    // Several images from each place, as the sides of a cube, have neighbours too.
    let usual = usual_gap(&distinct(&places), NEIGHBOURS);
    let pairs: Vec<[usize; 2]> =
        of.iter().flat_map(|&i| neighbours(&poses, i, usual).into_iter().map(move |j| [i, j])).collect();
    let one = |&[i, j]: &[usize; 2]| {
        // Nothing is assumed nearer than a quarter of the distance to the cameras' common focus.
        let nearest = focus.map_or(0.0, |focus| 0.25 * focus.place.distance(poses[i].translation));
        Pair { views: [i, j], tally: matched(all[i], all[j], nearest) }
    };
    parallel::collect(pairs.len(), |i| one(&pairs[i]))
}

/// The indices of the nearest images with similar directions but other positions.
fn neighbours(poses: &[DAffine3], i: usize, usual: f64) -> Vec<usize> {
    let a = poses[i];
    let mut costs: Vec<(f64, usize)> = poses
        .iter()
        .enumerate()
        .filter_map(|(j, b)| {
            let gap = a.translation.distance(b.translation);
            let angle = a.matrix3.z_axis.angle_between(b.matrix3.z_axis);
            let apart = i != j && gap > 1e-2 * usual && angle < ANGLE;
            apart.then(|| ((gap / usual).powi(2) + (angle / 0.35).powi(2), j))
        })
        .collect();
    costs.sort_by(|a, b| a.0.total_cmp(&b.0));
    costs.into_iter().take(NEIGHBOURS).map(|(_, j)| j).collect()
}

/// Maps pixels of one image and inverse depths to pixels of another.
struct Transfer<'a> {
    from: &'a Picture,
    to: &'a Picture,
    rotation: DMat3,
    translation: DVec3,
}

impl Transfer<'_> {
    /// The position in the other image of the point at the inverse depth `inverse` on a pixel's ray; `None` if it is
    /// behind that camera.
    fn place(&self, [x, y]: [f64; 2], inverse: f64) -> Option<[f64; 2]> {
        let Picture { focal, centre, .. } = self.from;
        let direction = DVec3::new((x - centre[0]) / focal[0], (y - centre[1]) / focal[1], 1.0);
        let point = self.rotation * direction + inverse * self.translation;
        let Picture { focal, centre, .. } = self.to;
        (point.z > 0.1).then(|| [point.x / point.z * focal[0] + centre[0], point.y / point.z * focal[1] + centre[1]])
    }

    /// The position, and the steps there for a pixel to the right and one down, on a surface that faces the first
    /// camera.
    fn patch(&self, [x, y]: [f64; 2], inverse: f64) -> Option<([f64; 2], [[f64; 2]; 2])> {
        let place = self.place([x, y], inverse)?;
        let step = |other: [f64; 2]| [other[0] - place[0], other[1] - place[1]];
        let [across, down] = [step(self.place([x + 1.0, y], inverse)?), step(self.place([x, y + 1.0], inverse)?)];
        let area = across[0] * down[1] - across[1] * down[0];
        (0.3..3.0).contains(&area).then_some((place, [across, down]))
    }
}

/// Searches for the patches of one image in another.
fn matched(a: Placed<'_>, b: Placed<'_>, nearest: f64) -> Tally {
    // From OpenGL's axes to those of images.
    let axes = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let back = axes * b.pose.matrix3.transpose();
    let transfer = Transfer {
        from: a.picture,
        to: b.picture,
        rotation: back * a.pose.matrix3 * axes,
        translation: back * (a.pose.translation - b.pose.translation),
    };
    // Images of points nearer than about the distance between the cameras differ too much to match.
    let most = (1.2 / transfer.translation.length()).min(nearest.recip());
    let mut tally = Tally::default();
    for &corner in &a.picture.corners {
        let Some(patch) = a.picture.patch(corner, [[1.0, 0.0], [0.0, 1.0]]) else { continue };
        if let Some(first) = best_line(&transfer, corner, &patch, most) {
            tally.trials += 1;
            tally.wins += usize::from(first);
        }
    }
    tally
}

/// Returns true if the epipolar line, and not a parallel one, has the best match of a patch.
///
/// `None` if no line has a good match, or if their lengths within the image differ too much.
fn best_line(transfer: &Transfer<'_>, corner: [f64; 2], patch: &Patch, most: f64) -> Option<bool> {
    let start = transfer.place(corner, 0.0)?;
    let mut last = most;
    let end = loop {
        match transfer.place(corner, last) {
            Some(place) => break place,
            None => last *= 0.8,
        }
        if last < 1e-3 * most {
            return None;
        }
    };
    let line = [end[0] - start[0], end[1] - start[1]];
    let length = line[0].hypot(line[1]);
    let beside = if length > 2.0 { [-line[1] / length, line[0] / length] } else { [0.0, 1.0] };
    let steps = (length / STEP).clamp(2.0, MOST_STEPS).ceil();
    let (mut best, mut counts) = ([-1.0_f32; BESIDE.len()], [0_usize; BESIDE.len()]);
    for step in 0..=steps as usize {
        let Some((place, frame)) = transfer.patch(corner, last * step as f64 / steps) else { continue };
        for (i, offset) in BESIDE.iter().enumerate() {
            let moved = [place[0] + offset * beside[0], place[1] + offset * beside[1]];
            let inside = moved[0] > 0.0
                && moved[1] > 0.0
                && moved[0] < transfer.to.width as f64
                && moved[1] < transfer.to.height as f64;
            counts[i] += usize::from(inside);
            let alike = if inside { transfer.to.correlation(patch, moved, frame) } else { None };
            best[i] = best[i].max(alike.unwrap_or(-1.0));
        }
    }
    // A line outside of the image cannot win, so it must not count as a loss.
    let longest = counts.into_iter().max()?;
    let fair = counts.iter().all(|count| 2 * count >= longest);
    let others = best[1..].iter().copied().fold(-1.0, f32::max);
    (fair && best[0].max(others) > ALIKE).then_some(best[0] > others)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use std::f64::consts::FRAC_PI_2;

    /// Six images from each place, in all directions: the neighbours of each are from the next places, not the first
    /// ones of the capture.
    #[test]
    fn images_from_shared_places_have_near_neighbours() {
        let place = |i: usize| DVec3::new((i / 6) as f64, 0.1 * (i / 6 % 3) as f64, 0.0);
        let side = |i: usize| match i % 6 {
            side @ 0..4 => DQuat::from_rotation_y(side as f64 * FRAC_PI_2),
            side => DQuat::from_rotation_x((side as f64 - 4.5) * 2.0 * FRAC_PI_2),
        };
        let pose = |i: usize| DAffine3::from_rotation_translation(side(i), place(i));
        let poses: Vec<DAffine3> = (0..300).map(pose).collect();
        let places: Vec<DVec3> = (0..300).map(place).collect();
        assert_eq!(distinct(&places).len(), 50);
        let usual = usual_gap(&distinct(&places), NEIGHBOURS);
        for i in [0, 7, 150, 299] {
            let found = neighbours(&poses, i, usual);
            assert_eq!(found.len(), NEIGHBOURS);
            assert!(found.iter().all(|j| j % 6 == i % 6 && j.abs_diff(i) <= 6 * NEIGHBOURS), "{i}: {found:?}");
        }
    }
}
