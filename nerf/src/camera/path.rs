//! Camera paths between keyframes.

use super::pinhole::Camera;
use glam::{DAffine3, DMat3, DQuat, DVec3};

/// A pose and a field of view on a camera path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Keyframe {
    /// Camera-to-world transform with the axes of a [`Camera`]: a rotation and a translation.
    pub pose: DAffine3,
    /// The vertical field of view in radians, between 0 and pi.
    pub angle_y: f64,
}

impl Keyframe {
    /// Takes the pose and field of view of a camera; lens and principal point are dropped.
    pub fn of(camera: &Camera) -> Self {
        Keyframe { pose: camera.pose, angle_y: 2.0 * (0.5 * camera.height as f64 / camera.focal[1]).atan() }
    }

    /// Returns a pinhole camera with square pixels and its principal point at the image centre.
    ///
    /// `focal = height / (2 tan(angle_y / 2))`.
    pub fn camera(&self, [width, height]: [usize; 2]) -> Camera {
        let tangent = (0.5 * self.angle_y).tan();
        let angle_x = 2.0 * (tangent * width as f64 / height as f64).atan();
        Camera::from_angle(width, height, angle_x, self.pose)
    }

    /// Interpolates to another keyframe; a `share` below 0 or above 1 extrapolates.
    ///
    /// Positions lie on a straight line, rotations turn about one axis the short way round (slerp, Shoemake 1985), and
    /// the focal length changes geometrically.
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

/// The rotation between two poses, as a vector in the axes of the first, of length 0 to pi.
fn turn(from: &DAffine3, to: &DAffine3) -> DVec3 {
    let turn = DQuat::from_mat3(&(from.matrix3.transpose() * to.matrix3));
    // Of the two quaternions of a rotation, the shorter turn.
    (if turn.w < 0.0 { -turn } else { turn }).to_scaled_axis()
}

/// The type of curve between keyframes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Curve {
    /// An interpolating Catmull-Rom spline, as in nerfstudio: the pyramid of Barry and Goldman (1988) of
    /// [`Keyframe::mix`], for rotations after Schlag (1991). Velocities are continuous. Between keyframes a camera
    /// should turn by less than a right angle. The position over time is a monotone cubic function (Fritsch and Butland
    /// 1984), so uneven times never reverse the camera.
    Through,
    /// An approximating uniform cubic B-spline, as in instant-ngp: at a keyframe's time it has the weight 4/6 and its
    /// neighbours 1/6 each. Rotations are weighted means of quaternions.
    Near,
}

/// A camera path through keyframes.
///
/// ```
/// use raygrad_nerf::camera::{CameraPath, Keyframe};
/// use raygrad_nerf::glam::{DAffine3, DVec3};
/// let key = |x: f64, angle_y: f64| Keyframe { pose: DAffine3::from_translation(DVec3::new(x, 0.0, 1.0)), angle_y };
/// let path = CameraPath::through(vec![key(0.0, 0.8), key(1.0, 0.8), key(2.0, 0.8)], false);
/// assert!((path.at(0.25).pose.translation.x - 0.5).abs() < 1e-12);
/// assert_eq!(path.shares(), [0.0, 0.5, 1.0]);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct CameraPath {
    keys: Vec<Keyframe>,
    /// The time of each keyframe, from 0. A closed path has the first one again at the end.
    times: Vec<f64>,
    /// The curve's parameter at each time.
    knots: Vec<f64>,
    closed: bool,
    curve: Curve,
}

/// The shortest leg, as a share of the median one. Keyframes at one place keep a duration above 0.
const LEAST_LEG: f64 = 1e-3;

/// The shortest time of a leg, as a share of the longest. Sums of times keep it apart.
const LEAST_TIME: f64 = 1e-6;

impl CameraPath {
    /// Creates a path of [`Curve::Through`], which returns to the first keyframe if `closed`.
    ///
    /// The time between keyframes is the square root of their distance, in which turning and moving count equally over
    /// the path. With this centripetal parameter, curves have neither loops nor cusps (Yuksel, Schaefer and Keyser
    /// 2011).
    ///
    /// # Panics
    /// If there is no keyframe.
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

    /// Creates a path with given times between keyframes, in any unit.
    ///
    /// There is one time fewer than keyframes or, if the path is `closed`, as many. A time below a millionth of the
    /// longest counts as that. Times do not bend the curve: its parameter rises by one between keyframes.
    ///
    /// # Panics
    /// If there is no keyframe, another number of times, or a time that is not above 0 and finite.
    pub fn timed(keys: Vec<Keyframe>, times: Vec<f64>, closed: bool, curve: Curve) -> Self {
        assert!(!keys.is_empty(), "a path needs at least one keyframe");
        assert_eq!(
            times.len(),
            legs(&keys, closed).len(),
            "a path needs one time for each pair of neighbouring keyframes"
        );
        assert!(times.iter().all(|time| *time > 0.0 && time.is_finite()), "times must be finite and above 0");
        let least = LEAST_TIME * times.iter().copied().fold(0.0, f64::max);
        let mut reached = vec![0.0];
        for time in times {
            reached.push(reached[reached.len() - 1] + time.max(least));
        }
        let knots = (0..reached.len()).map(|i| i as f64).collect();
        CameraPath { keys, times: reached, knots, closed, curve }
    }

    /// Returns the position of each keyframe along the path, 0 to 1.
    pub fn shares(&self) -> Vec<f64> {
        let length = self.length();
        self.times[..self.keys.len()].iter().map(|time| if length > 0.0 { time / length } else { 0.0 }).collect()
    }

    /// Returns the keyframe at a share of the path's time, 0 to 1.
    pub fn at(&self, share: f64) -> Keyframe {
        if self.keys.len() == 1 {
            return self.keys[0];
        }
        let time = share.clamp(0.0, 1.0) * self.length();
        // The last keyframe belongs to the last leg.
        let leg = self.times[1..self.times.len() - 1].partition_point(|reached| *reached <= time);
        let window: [(f64, Keyframe); 4] = std::array::from_fn(|i| self.key(leg as isize + i as isize - 1));
        let share = (time - self.times[leg]) / self.leg(leg)[0];
        match self.curve {
            Curve::Through => through(window, self.knots[leg] + self.passed(leg, share)),
            Curve::Near => near(window.map(|(_, key)| key), share),
        }
    }

    /// The time of a leg and the increase of the parameter in it.
    fn leg(&self, leg: usize) -> [f64; 2] {
        [&self.times, &self.knots].map(|of| of[leg + 1] - of[leg])
    }

    /// The increase of the parameter after a share of a leg's time, by a cubic Hermite polynomial.
    fn passed(&self, leg: usize, share: f64) -> f64 {
        let ([time, rise], left) = (self.leg(leg), 1.0 - share);
        let [start, end] = [leg, leg + 1].map(|key| time * self.speed(key));
        share * share * (3.0 - 2.0 * share) * rise + share * left * (left * start - share * end)
    }

    /// The derivative of the parameter at a keyframe: the weighted harmonic mean of the adjacent legs. At an end it is
    /// the slope of a parabola through three keyframes, and at least 0.
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

    /// Returns `count` keyframes evenly in time, from start to end. On a closed path the last one leads back to the
    /// first.
    pub fn frames(&self, count: usize) -> Vec<Keyframe> {
        let steps = if self.closed { count } else { count.saturating_sub(1).max(1) };
        (0..count).map(|i| self.at(i as f64 / steps as f64)).collect()
    }

    fn length(&self) -> f64 {
        self.times[self.times.len() - 1]
    }

    /// A keyframe and its parameter, extrapolated before the first and after the last.
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
            // Extrapolates the end leg linearly.
            Curve::Through => other.mix(&key, 2.0),
            Curve::Near => key,
        };
        (2.0 * end - before, beyond)
    }
}

/// The first and the last keyframe of each leg.
fn legs(keys: &[Keyframe], closed: bool) -> Vec<[usize; 2]> {
    let count = if closed && keys.len() > 1 { keys.len() } else { keys.len().saturating_sub(1) };
    (0..count).map(|i| [i, (i + 1) % keys.len()]).collect()
}

/// The pyramid of Barry and Goldman: linear interpolation between neighbours by their parameters, three times.
fn through(keys: [(f64, Keyframe); 4], place: f64) -> Keyframe {
    let knots = keys.map(|(knot, _)| knot);
    let mix = |from: &Keyframe, to: &Keyframe, [start, end]: [usize; 2]| {
        from.mix(to, (place - knots[start]) / (knots[end] - knots[start]))
    };
    let first: [Keyframe; 3] = std::array::from_fn(|i| mix(&keys[i].1, &keys[i + 1].1, [i, i + 1]));
    let second: [Keyframe; 2] = std::array::from_fn(|i| mix(&first[i], &first[i + 1], [i, i + 2]));
    mix(&second[0], &second[1], [1, 2])
}

/// The mean of keyframes, weighted by the uniform cubic B-spline.
fn near(keys: [Keyframe; 4], u: f64) -> Keyframe {
    let v = 1.0 - u;
    let middle = |u: f64| (3.0 * u * u * u - 6.0 * u * u + 4.0) / 6.0;
    let weights = [v * v * v / 6.0, middle(u), middle(v), u * u * u / 6.0];
    // A rotation has two quaternions. Neighbours choose the nearer ones, so that all legs of a path choose alike.
    let mut turns = keys.map(|key| DQuat::from_mat3(&key.pose.matrix3));
    for i in 1..4 {
        if turns[i].dot(turns[i - 1]) < 0.0 {
            turns[i] = -turns[i];
        }
    }
    let (mut rotation, mut translation, mut angle_y) = (DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), DVec3::ZERO, 0.0);
    for ((key, turn), weight) in keys.iter().zip(turns).zip(weights) {
        rotation += turn * weight;
        translation += weight * key.pose.translation;
        angle_y += weight * key.angle_y;
    }
    let matrix3 = DMat3::from_quat(rotation.normalize());
    Keyframe { pose: DAffine3 { matrix3, translation }, angle_y }
}

#[cfg(test)]
mod tests;
