//! Batches of rays, and packed samples: the samples of all rays stand one after another.

use super::bounds::clip_near_far;
use super::pinhole::{Camera, Ray};
use crate::random::Jitter;
use glam::DVec3;
use raygrad_autograd::{Pool, Scalar, Segments, Tensor};
use std::ops::Range;

/// A batch of rays.
#[derive(Debug, Clone, Default)]
pub struct Rays<T> {
    /// Origins in scene units.
    pub origins: Vec<[T; 3]>,
    /// Unit directions.
    pub directions: Vec<[T; 3]>,
    /// The near and far distance of each ray, in scene units; equal if nothing is to be sampled.
    pub spans: Vec<[T; 2]>,
}

impl<T: Scalar> Rays<T> {
    /// Creates an empty batch.
    pub fn new() -> Self {
        Rays { origins: vec![], directions: vec![], spans: vec![] }
    }

    /// Adds a ray with its `[near, far]` distances.
    pub fn push(&mut self, ray: &Ray, span: [f64; 2]) {
        self.origins.push(ray.origin.to_array().map(T::from_f64));
        self.directions.push(ray.direction.to_array().map(T::from_f64));
        self.spans.push(span.map(T::from_f64));
    }

    /// Adds the ray through the centre of a camera's pixel.
    ///
    /// Its span is the part of `span` (near and far distance) within the box `bounds` (lower and upper corner).
    pub fn push_pixel(&mut self, camera: &Camera, [column, row]: [usize; 2], bounds: [DVec3; 2], span: [f64; 2]) {
        let ray = camera.pixel_ray(column, row);
        self.push(&ray, clip_near_far(&ray, bounds, span));
    }

    /// Returns the number of rays.
    pub fn len(&self) -> usize {
        self.origins.len()
    }

    /// Returns whether there are no rays.
    pub fn is_empty(&self) -> bool {
        self.origins.is_empty()
    }

    /// Converts the rays to another precision.
    pub fn cast<U: Scalar>(&self) -> Rays<U> {
        fn all<const N: usize, T: Scalar, U: Scalar>(x: &[[T; N]]) -> Vec<[U; N]> {
            x.iter().map(|x| x.map(|x| U::from_f64(x.to_f64()))).collect()
        }
        Rays { origins: all(&self.origins), directions: all(&self.directions), spans: all(&self.spans) }
    }

    /// Returns the rays with indices in `range`.
    ///
    /// # Panics
    /// If the range leaves the batch.
    pub fn slice(&self, range: Range<usize>) -> Self {
        Rays {
            origins: self.origins[range.clone()].to_vec(),
            directions: self.directions[range.clone()].to_vec(),
            spans: self.spans[range].to_vec(),
        }
    }
}

/// Samples along rays, packed: `segments` assigns rows to rays.
#[derive(Debug, Clone)]
pub struct Samples<T: Scalar> {
    /// Origins of the rays, `[rays, 3]`, in scene units.
    pub origins: Tensor<T>,
    /// Unit viewing directions, `[rays, 3]`.
    pub directions: Tensor<T>,
    /// Distances `t` along the rays, `[samples]`, in scene units, rising within a ray.
    pub t: Tensor<T>,
    /// Length of each sample's interval, `[samples]`, in scene units. With two nodes per interval it is the length of
    /// the interval that begins at the node, or 0.
    pub delta: Tensor<T>,
    /// The rows of each ray's samples.
    pub segments: Segments,
}

impl<T: Scalar> Samples<T> {
    /// Creates samples at distances `t` with intervals of length `delta`, both `[samples]`.
    ///
    /// # Panics
    /// If `t` or `delta` does not have one entry per row, or `segments` not one segment per ray.
    pub fn new(rays: &Rays<T>, segments: Segments, t: Tensor<T>, delta: Tensor<T>, pool: &Pool<T>) -> Self {
        assert_eq!(segments.len(), rays.len(), "segments must have one entry per ray");
        let rows = |values: &[[T; 3]]| pool.copy_of(&[rays.len(), 3], values.as_flattened());
        let rays = [rows(&rays.origins), rows(&rays.directions)];
        Samples::along(rays, segments, t, delta)
    }

    /// Creates other samples of the same rays.
    ///
    /// # Panics
    /// If `t` or `delta` does not have one entry per row, or `segments` not one segment per ray.
    pub fn at(&self, segments: Segments, t: Tensor<T>, delta: Tensor<T>) -> Self {
        assert_eq!(segments.len(), self.segments.len(), "segments must have one entry per ray");
        Samples::along([self.origins.clone(), self.directions.clone()], segments, t, delta)
    }

    fn along([origins, directions]: [Tensor<T>; 2], segments: Segments, t: Tensor<T>, delta: Tensor<T>) -> Self {
        assert_eq!([t.len(), delta.len()], [segments.rows(); 2], "t and delta must have one entry per sample");
        Samples { origins, directions, t, delta, segments }
    }

    /// Returns the positions `origin + t direction`, `[samples, 3]`, in scene units.
    pub fn positions(&self, pool: &Pool<T>) -> Tensor<T> {
        let mut positions = pool.tensor(&[self.len(), 3]);
        let out = positions.as_mut_slice();
        let rays = self.origins.as_slice().chunks_exact(3).zip(self.directions.as_slice().chunks_exact(3));
        for (rows, (origin, direction)) in self.segments.ranges().zip(rays) {
            let (origin, direction) = ([origin[0], origin[1], origin[2]], [direction[0], direction[1], direction[2]]);
            let places = out[3 * rows.start..3 * rows.end].chunks_exact_mut(3);
            for (position, &t) in places.zip(&self.t.as_slice()[rows]) {
                for axis in 0..3 {
                    position[axis] = origin[axis] + t * direction[axis];
                }
            }
        }
        positions
    }

    /// Returns the samples with these rising indices; all rays remain, some without samples.
    ///
    /// # Panics
    /// If an index is out of range.
    pub fn select(&self, rows: &[u32], pool: &Pool<T>) -> Self {
        let mut offsets = Vec::with_capacity(self.segments.len() + 1);
        offsets.push(0);
        let mut taken = 0;
        for range in self.segments.ranges() {
            taken += rows[taken..].iter().take_while(|&&row| (row as usize) < range.end).count();
            offsets.push(taken as u32);
        }
        let (mut t, mut delta) = (pool.tensor(&[rows.len()]), pool.tensor(&[rows.len()]));
        let (all_t, all_delta) = (self.t.as_slice(), self.delta.as_slice());
        let out = t.as_mut_slice().iter_mut().zip(delta.as_mut_slice());
        for ((t, delta), &row) in out.zip(rows) {
            (*t, *delta) = (all_t[row as usize], all_delta[row as usize]);
        }
        self.at(Segments::new(offsets), t, delta)
    }

    /// Returns a ray for each of `pieces`: the index of a ray and a range of its rows.
    ///
    /// # Panics
    /// If an index is out of range.
    pub fn pieces(&self, pieces: &[(usize, Range<usize>)], pool: &Pool<T>) -> Self {
        let ends = pieces.iter().scan(0, |end, (_, rows)| {
            *end += rows.len() as u32;
            Some(*end)
        });
        let segments = Segments::new([0].into_iter().chain(ends).collect::<Vec<_>>());
        let (mut t, mut delta) = (pool.tensor(&[segments.rows()]), pool.tensor(&[segments.rows()]));
        let mut rays = [pool.tensor(&[pieces.len(), 3]), pool.tensor(&[pieces.len(), 3])];
        let [origins, directions] = &mut rays;
        let lines = origins.as_mut_slice().chunks_exact_mut(3).zip(directions.as_mut_slice().chunks_exact_mut(3));
        let (out_t, out_delta) = (t.as_mut_slice(), delta.as_mut_slice());
        for (((ray, rows), to), (origin, direction)) in pieces.iter().zip(segments.ranges()).zip(lines) {
            out_t[to.clone()].copy_from_slice(&self.t.as_slice()[rows.clone()]);
            out_delta[to].copy_from_slice(&self.delta.as_slice()[rows.clone()]);
            origin.copy_from_slice(&self.origins.as_slice()[3 * ray..3 * ray + 3]);
            direction.copy_from_slice(&self.directions.as_slice()[3 * ray..3 * ray + 3]);
        }
        Samples::along(rays, segments, t, delta)
    }

    /// Converts the samples to another precision.
    pub fn cast<U: Scalar>(&self) -> Samples<U> {
        Samples {
            origins: self.origins.cast(),
            directions: self.directions.cast(),
            t: self.t.cast(),
            delta: self.delta.cast(),
            segments: self.segments.clone(),
        }
    }

    /// Returns the number of samples.
    pub fn len(&self) -> usize {
        self.segments.rows()
    }

    /// Returns whether there are no samples.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Places one sample in each of `count` equal bins between near and far (Mildenhall et al. 2020, equation 2).
///
/// `delta` is the width of the bin. With random places this converges faster than the distance to the next sample.
pub fn stratified<T: Scalar>(rays: &Rays<T>, count: usize, jitter: &mut Jitter<'_>, pool: &Pool<T>) -> Samples<T> {
    let segments = Segments::uniform(rays.len(), count);
    let (mut t, mut delta) = (pool.tensor(&[segments.rows()]), pool.tensor(&[segments.rows()]));
    let lanes =
        t.as_mut_slice().chunks_exact_mut(count.max(1)).zip(delta.as_mut_slice().chunks_exact_mut(count.max(1)));
    for (span, (t, delta)) in rays.spans.iter().zip(lanes) {
        let [near, far] = span.map(T::to_f64);
        let width = (far - near) / count as f64;
        for (i, t) in t.iter_mut().enumerate() {
            *t = T::from_f64(near + width * (i as f64 + jitter.draw()));
        }
        delta.fill(T::from_f64(width));
    }
    Samples::new(rays, segments, t, delta, pool)
}
