//! Rays and the samples along them, packed: the samples of all rays stand one after another.

use crate::camera::pinhole::Ray;
use crate::random::Jitter;
use raygrad_autograd::{Pool, Scalar, Segments, Tensor};

/// A batch of rays.
#[derive(Debug, Clone, Default)]
pub struct Rays<T> {
    /// Origins in scene units.
    pub origins: Vec<[T; 3]>,
    /// Unit directions.
    pub directions: Vec<[T; 3]>,
    /// For each ray the distances `[near, far]` between which it is sampled; equal where there is nothing to sample.
    pub spans: Vec<[T; 2]>,
}

impl<T: Scalar> Rays<T> {
    /// No rays.
    pub fn new() -> Self {
        Rays { origins: vec![], directions: vec![], spans: vec![] }
    }

    /// Adds a ray that is sampled over `[near, far]`.
    pub fn push(&mut self, ray: &Ray, span: [f64; 2]) {
        self.origins.push(ray.origin.to_array().map(T::from_f64));
        self.directions.push(ray.direction.to_array().map(T::from_f64));
        self.spans.push(span.map(T::from_f64));
    }

    /// Number of rays.
    pub fn len(&self) -> usize {
        self.origins.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.origins.is_empty()
    }

    /// The same rays in another precision.
    pub fn cast<U: Scalar>(&self) -> Rays<U> {
        fn all<const N: usize, T: Scalar, U: Scalar>(x: &[[T; N]]) -> Vec<[U; N]> {
            x.iter().map(|x| x.map(|x| U::from_f64(x.to_f64()))).collect()
        }
        Rays { origins: all(&self.origins), directions: all(&self.directions), spans: all(&self.spans) }
    }

    /// The rays with these numbers.
    ///
    /// # Panics
    /// If the range leaves the batch.
    pub fn slice(&self, range: std::ops::Range<usize>) -> Self {
        Rays {
            origins: self.origins[range.clone()].to_vec(),
            directions: self.directions[range.clone()].to_vec(),
            spans: self.spans[range].to_vec(),
        }
    }
}

/// Where rays are sampled: `segments` says which rows belong to which ray.
#[derive(Debug, Clone)]
pub struct Samples<T: Scalar> {
    /// Positions, `[samples, 3]`, in scene units.
    pub positions: Tensor<T>,
    /// Unit viewing directions, `[rays, 3]`.
    pub directions: Tensor<T>,
    /// Distances along the rays, `[samples]`, rising within a ray.
    pub t: Tensor<T>,
    /// Length of the interval that each sample stands for, `[samples]`.
    pub delta: Tensor<T>,
    /// The rows of each ray.
    pub segments: Segments,
}

impl<T: Scalar> Samples<T> {
    /// Samples at distances `t`, each standing for an interval of length `delta`.
    ///
    /// # Panics
    /// If there are not as many distances and intervals as rows, or not as many segments as rays.
    pub fn new(rays: &Rays<T>, segments: Segments, t: Tensor<T>, delta: Tensor<T>, pool: &Pool<T>) -> Self {
        assert_eq!(segments.len(), rays.len(), "one segment for each ray");
        assert_eq!([t.len(), delta.len()], [segments.rows(); 2], "one distance and one interval for each sample");
        let mut positions = pool.tensor(&[segments.rows(), 3]);
        let out = positions.as_mut_slice();
        for (ray, rows) in segments.ranges().enumerate() {
            let (origin, direction) = (rays.origins[ray], rays.directions[ray]);
            for (position, &t) in out[3 * rows.start..3 * rows.end].chunks_exact_mut(3).zip(&t.as_slice()[rows]) {
                for axis in 0..3 {
                    position[axis] = origin[axis] + t * direction[axis];
                }
            }
        }
        let directions = pool.copy_of(&[rays.len(), 3], rays.directions.as_flattened());
        Samples { positions, directions, t, delta, segments }
    }

    /// The samples with these rising numbers; rays keep their number, some without samples.
    ///
    /// # Panics
    /// If a number is out of range.
    pub fn select(&self, rows: &[u32], pool: &Pool<T>) -> Self {
        let mut offsets = Vec::with_capacity(self.segments.len() + 1);
        offsets.push(0);
        let mut taken = 0;
        for range in self.segments.ranges() {
            taken += rows[taken..].partition_point(|&row| (row as usize) < range.end);
            offsets.push(taken as u32);
        }
        let (mut positions, mut t, mut delta) =
            (pool.tensor(&[rows.len(), 3]), pool.tensor(&[rows.len()]), pool.tensor(&[rows.len()]));
        let all = (self.positions.as_slice(), self.t.as_slice(), self.delta.as_slice());
        let out = (positions.as_mut_slice(), t.as_mut_slice(), delta.as_mut_slice());
        for (i, &row) in rows.iter().enumerate() {
            let row = row as usize;
            out.0[3 * i..3 * i + 3].copy_from_slice(&all.0[3 * row..3 * row + 3]);
            out.1[i] = all.1[row];
            out.2[i] = all.2[row];
        }
        Samples { positions, directions: self.directions.clone(), t, delta, segments: Segments::new(offsets) }
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.segments.rows()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// One sample in each of `count` equal bins between a ray's near and far distance (Mildenhall et al. 2020, equation 2).
/// Each stands for its bin: with random places that converges faster than the distance to the next sample.
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
