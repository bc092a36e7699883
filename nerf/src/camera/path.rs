//! Paths that cameras fly along, between key frames.

use super::pinhole::Camera;
use glam::{DAffine3, DMat3, DQuat, DVec3};

/// Where a camera is on a path, and how much it sees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Keyframe {
    /// Camera-to-world, with the axes of a [`Camera`]: a rotation and a translation.
    pub pose: DAffine3,
    /// The vertical field of view in radians, between 0 and pi.
    pub angle_y: f64,
}

impl Keyframe {
    /// That of a camera: its lens and its principal point are left behind.
    pub fn of(camera: &Camera) -> Self {
        Keyframe { pose: camera.pose, angle_y: 2.0 * (0.5 * camera.height as f64 / camera.focal[1]).atan() }
    }

    /// A pinhole camera there, with square pixels and its principal point in the middle:
    /// `focal = height / (2 tan(angle_y / 2))`.
    pub fn camera(&self, [width, height]: [usize; 2]) -> Camera {
        let tangent = (0.5 * self.angle_y).tan();
        let angle_x = 2.0 * (tangent * width as f64 / height as f64).atan();
        Camera::from_angle(width, height, angle_x, self.pose)
    }

    /// The key that is `share` of the way to another, beyond it above 1 and before this one below 0: on a straight
    /// line, by a turn about one axis, the short way round (slerp, Shoemake 1985), and with the focal length changing
    /// by a constant factor.
    pub fn mix(&self, other: &Keyframe, share: f64) -> Keyframe {
        let (from, to) = (&self.pose, &other.pose);
        let turn = DQuat::from_scaled_axis(share * turn(from, to));
        let rotation = (DQuat::from_mat3(&from.matrix3) * turn).normalize();
        let focal = |key: &Keyframe| (0.5 * key.angle_y).tan().ln();
        Keyframe {
            pose: DAffine3 {
                matrix3: DMat3::from_quat(rotation),
                translation: from.translation + share * (to.translation - from.translation),
            },
            angle_y: 2.0 * (focal(self) + share * (focal(other) - focal(self))).exp().atan(),
        }
    }
}

/// The rotation from one pose to another, as a vector in the first one's axes of a length up to pi.
fn turn(from: &DAffine3, to: &DAffine3) -> DVec3 {
    let turn = DQuat::from_mat3(&(from.matrix3.transpose() * to.matrix3));
    // Of the two quaternions of a rotation that of the short way.
    (if turn.w < 0.0 { -turn } else { turn }).to_scaled_axis()
}

/// How a path goes by its keys.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Curve {
    /// Through each: a Catmull-Rom spline by the pyramid of Barry and Goldman (1988) of [`Keyframe::mix`], for rotations as
    /// Schlag (1991) has it. Speeds of moving, of turning and of zooming are continuous. From key to key a camera
    /// should turn by less than a right angle. How far along it a camera is at a time is a monotone cubic function (Fritsch and
    /// Butland 1984), so that times, however uneven, move cameras to and fro nowhere. Nerfstudio's paths are such ones.
    Through,
    /// Near each, as smooth as a uniform cubic B-spline: in the middle of a leg's end, a key counts four sixths and its
    /// neighbours one. Rotations are weighted means of quaternions. These are the paths of instant-ngp.
    Near,
}

/// A path by key frames.
///
/// ```
/// use raygrad_nerf::camera::{CameraPath, Key};
/// use raygrad_nerf::glam::{DAffine3, DVec3};
/// let key = |x: f64, angle_y: f64| Key { pose: DAffine3::from_translation(DVec3::new(x, 0.0, 1.0)), angle_y };
/// let path = CameraPath::through(vec![key(0.0, 0.8), key(1.0, 0.8), key(2.0, 0.8)], false);
/// assert!((path.at(0.25).pose.translation.x - 0.5).abs() < 1e-12);
/// assert_eq!(path.shares(), [0.0, 0.5, 1.0]);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct CameraPath {
    keys: Vec<Keyframe>,
    /// When each key is reached, from 0 on; of a closed path, the first once more.
    times: Vec<f64>,
    /// The curve's parameter there.
    knots: Vec<f64>,
    closed: bool,
    curve: Curve,
}

/// A leg takes at least this share of the time of the usual one: keys in one place are passed, and not skipped.
const LEAST_LEG: f64 = 1e-3;

/// A leg takes at least this share of the time of the longest, which no sum of times makes vanish.
const LEAST_TIME: f64 = 1e-6;

impl CameraPath {
    /// Through keys, at least one, and back to the first if it is `closed`. A leg takes time as the square root of its
    /// length, in which turning counts as much as moving does in all: the centripetal parameter, with which curves have
    /// neither loops nor cusps between their keys (Yuksel, Schaefer and Keyser 2011).
    ///
    /// # Panics
    /// If there is no key.
    pub fn through(keys: Vec<Keyframe>, closed: bool) -> Self {
        let legs = legs(&keys, closed);
        let pairs = legs.iter().map(|&[from, to]| (&keys[from].pose, &keys[to].pose));
        let lengths = |of: fn(&DAffine3, &DAffine3) -> f64| -> Vec<f64> {
            let lengths: Vec<f64> = pairs.clone().map(|(from, to)| of(from, to)).collect();
            let mean = lengths.iter().sum::<f64>() / lengths.len().max(1) as f64;
            lengths.iter().map(|length| if mean > 0.0 { length / mean } else { 0.0 }).collect()
        };
        let moved = lengths(|from, to| from.translation.distance(to.translation));
        let turned = lengths(|from, to| turn(from, to).length());
        let times = moved.iter().zip(turned).map(|(moved, turned)| (0.5 * (moved + turned)).sqrt().max(LEAST_LEG));
        let path = CameraPath::timed(keys, times.collect(), closed, Curve::Through);
        CameraPath { knots: path.times.clone(), ..path }
    }

    /// By keys, with the time that each leg takes, in any unit: one less than keys or, if the path is `closed`, as many. One that
    /// is less than a millionth of the longest counts as that. Times do not bend the curve: its parameter rises by one in each leg.
    ///
    /// # Panics
    /// If there is no key, or not as many times, or one that is not above 0 and finite.
    pub fn timed(keys: Vec<Keyframe>, times: Vec<f64>, closed: bool, curve: Curve) -> Self {
        assert!(!keys.is_empty(), "a path of no keys");
        assert_eq!(times.len(), legs(&keys, closed).len(), "a time for each leg");
        assert!(times.iter().all(|time| *time > 0.0 && time.is_finite()), "times above 0");
        let least = LEAST_TIME * times.iter().copied().fold(0.0, f64::max);
        let mut reached = vec![0.0];
        for time in times {
            reached.push(reached[reached.len() - 1] + time.max(least));
        }
        let knots = (0..reached.len()).map(|i| i as f64).collect();
        CameraPath { keys, times: reached, knots, closed, curve }
    }

    /// Where along the path its keys are, 0 to 1.
    pub fn shares(&self) -> Vec<f64> {
        let length = self.length();
        self.times[..self.keys.len()].iter().map(|time| if length > 0.0 { time / length } else { 0.0 }).collect()
    }

    /// Where a camera is that has come so far, 0 to 1: by time, and so about evenly.
    pub fn at(&self, share: f64) -> Keyframe {
        if self.keys.len() == 1 {
            return self.keys[0];
        }
        let time = share.clamp(0.0, 1.0) * self.length();
        // The last key ends the last leg.
        let leg = self.times[1..self.times.len() - 1].partition_point(|reached| *reached <= time);
        let window: [(f64, Keyframe); 4] = std::array::from_fn(|i| self.key(leg as isize + i as isize - 1));
        let share = (time - self.times[leg]) / self.leg(leg)[0];
        match self.curve {
            Curve::Through => through(window, self.knots[leg] + self.passed(leg, share)),
            Curve::Near => near(window.map(|(_, key)| key), share),
        }
    }

    /// The time that a leg takes, and by how much the parameter rises in it.
    fn leg(&self, leg: usize) -> [f64; 2] {
        [&self.times, &self.knots].map(|of| of[leg + 1] - of[leg])
    }

    /// By how much the parameter has risen after a share of a leg's time: Hermite's polynomial.
    fn passed(&self, leg: usize, share: f64) -> f64 {
        let ([time, rise], left) = (self.leg(leg), 1.0 - share);
        let [start, end] = [leg, leg + 1].map(|key| time * self.speed(key));
        share * share * (3.0 - 2.0 * share) * rise + share * left * (left * start - share * end)
    }

    /// How fast the parameter rises at a key: the weighted harmonic mean of the legs around it, and at an end what the slope of a
    /// parabola through three keys is, but not backwards.
    fn speed(&self, key: usize) -> f64 {
        let legs = self.times.len() - 1;
        let of = |leg: usize| {
            let [time, rise] = self.leg(leg);
            (time, rise / time)
        };
        let ends = |near: usize, next: usize| {
            let ((time, speed), (time_next, speed_next)) = (of(near), of(next));
            (((2.0 * time + time_next) * speed - time * speed_next) / (time + time_next)).max(0.0)
        };
        match key {
            _ if legs == 1 => of(0).1,
            0 if !self.closed => ends(0, 1),
            last if last == legs && !self.closed => ends(legs - 1, legs - 2),
            inner => {
                let ((before, slow), (after, fast)) = (of((inner + legs - 1) % legs), of(inner % legs));
                let weights = [before + 2.0 * after, 2.0 * before + after];
                (weights[0] + weights[1]) / (weights[0] / slow + weights[1] / fast)
            }
        }
    }

    /// `count` keys along the path, evenly in time: from its beginning to its end or, of a closed one, up to where it
    /// begins again.
    pub fn frames(&self, count: usize) -> Vec<Keyframe> {
        let steps = if self.closed { count } else { count.saturating_sub(1).max(1) };
        (0..count).map(|i| self.at(i as f64 / steps as f64)).collect()
    }

    fn length(&self) -> f64 {
        self.times[self.times.len() - 1]
    }

    /// A key and its parameter; there are some before the first and after the last.
    fn key(&self, i: isize) -> (f64, Keyframe) {
        let count = self.keys.len() as isize;
        if self.closed {
            let at = i.rem_euclid(count) as usize;
            return (self.knots[at] + i.div_euclid(count) as f64 * self.knots[self.keys.len()], self.keys[at]);
        }
        let last = i.clamp(0, count - 1);
        if last == i {
            return (self.knots[i as usize], self.keys[i as usize]);
        }
        let inner = if last == 0 { 1 } else { last - 1 };
        let [(end, key), (before, other)] = [self.key(last), self.key(inner)];
        let beyond = match self.curve {
            // As if it went on as it began.
            Curve::Through => other.mix(&key, 2.0),
            Curve::Near => key,
        };
        (2.0 * end - before, beyond)
    }
}

/// The first and the last key of each leg.
fn legs(keys: &[Keyframe], closed: bool) -> Vec<[usize; 2]> {
    let count = if closed && keys.len() > 1 { keys.len() } else { keys.len().saturating_sub(1) };
    (0..count).map(|i| [i, (i + 1) % keys.len()]).collect()
}

/// The pyramid: between neighbours, between those, and between these, each by the parameters that it stands for.
fn through(keys: [(f64, Keyframe); 4], place: f64) -> Keyframe {
    let knots = keys.map(|(knot, _)| knot);
    let mix = |from: &Keyframe, to: &Keyframe, [start, end]: [usize; 2]| {
        from.mix(to, (place - knots[start]) / (knots[end] - knots[start]))
    };
    let first: [Keyframe; 3] = std::array::from_fn(|i| mix(&keys[i].1, &keys[i + 1].1, [i, i + 1]));
    let second: [Keyframe; 2] = std::array::from_fn(|i| mix(&first[i], &first[i + 1], [i, i + 2]));
    mix(&second[0], &second[1], [1, 2])
}

/// The weighted mean by the uniform cubic B-spline's weights.
fn near(keys: [Keyframe; 4], u: f64) -> Keyframe {
    let v = 1.0 - u;
    let middle = |u: f64| (3.0 * u * u * u - 6.0 * u * u + 4.0) / 6.0;
    let weights = [v * v * v / 6.0, middle(u), middle(v), u * u * u / 6.0];
    let middle = DQuat::from_mat3(&keys[1].pose.matrix3);
    let (mut rotation, mut translation, mut angle_y) = (DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), DVec3::ZERO, 0.0);
    for (key, weight) in keys.iter().zip(weights) {
        let other = DQuat::from_mat3(&key.pose.matrix3);
        rotation += other * (weight * if other.dot(middle) < 0.0 { -1.0 } else { 1.0 });
        translation += weight * key.pose.translation;
        angle_y += weight * key.angle_y;
    }
    let matrix3 = DMat3::from_quat(rotation.normalize());
    Keyframe { pose: DAffine3 { matrix3, translation }, angle_y }
}

#[cfg(test)]
mod tests;
