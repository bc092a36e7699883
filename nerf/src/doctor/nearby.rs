//! A spatial index: finds places near a place in linear time.

use crate::dataset::evenly_spaced;
use crate::numbers::median;
use glam::DVec3;
use std::collections::{HashMap, HashSet};

/// Points in the cells of a cubic lattice. Memory and time are linear in their number.
pub(super) struct Nearby<'a> {
    places: &'a [DVec3],
    /// The side of a cell, and the radius of the search.
    radius: f64,
    cells: HashMap<[i64; 3], Vec<usize>>,
}

/// The most points tested for one query. In a crowded place the nearest is most likely among them.
const LOOKED_AT: usize = 500;

impl<'a> Nearby<'a> {
    /// Sorts those of the places that are `wanted` into cells of side `radius`, which is positive.
    pub fn new(places: &'a [DVec3], wanted: impl Fn(usize) -> bool, radius: f64) -> Self {
        let mut cells: HashMap<_, Vec<usize>> = HashMap::new();
        for (i, place) in places.iter().enumerate().filter(|(i, _)| wanted(*i)) {
            cells.entry(cell(*place, radius)).or_default().push(i);
        }
        Nearby { places, radius, cells }
    }

    /// The indices of the wanted points at most `radius` from point `i`, including itself, in no particular order. Of
    /// very many, only the first are found.
    pub fn of(&self, i: usize) -> impl Iterator<Item = usize> {
        let (place, [x, y, z]) = (self.places[i], cell(self.places[i], self.radius));
        let steps = |at: i64| [at, at.saturating_sub(1), at.saturating_add(1)];
        let around = steps(x).into_iter().flat_map(move |x| steps(y).into_iter().map(move |y| [x, y]));
        let around = around.flat_map(move |[x, y]| steps(z).into_iter().map(move |z| [x, y, z]));
        let found = around.filter_map(|cell| self.cells.get(&cell)).flatten().copied().take(LOOKED_AT);
        found.filter(move |j| self.places[*j].distance(place) <= self.radius)
    }
}

/// The median distance of a point from its `away`-th nearest neighbour, over at most `ASKED` points.
pub(super) fn usual_gap(places: &[DVec3], away: usize) -> f64 {
    /// The most points in the median.
    const ASKED: usize = 500;
    median(evenly_spaced(places.to_vec(), ASKED).into_iter().map(|place| {
        let mut gaps: Vec<f64> = places.iter().map(|other| other.distance(place)).collect();
        gaps.sort_by(f64::total_cmp);
        gaps.get(away).or(gaps.last()).copied().unwrap_or(0.0)
    }))
}

/// One of the points in each place. Points that differ by rounding alone are in one place, but for a few.
pub(super) fn distinct(places: &[DVec3]) -> Vec<DVec3> {
    /// The side of a place, as a share of the extent of all.
    const PLACE: f64 = 1e-7;
    let Some(first) = places.first().copied() else { return vec![] };
    let extent = places.iter().map(|place| place.distance(first)).fold(0.0, f64::max);
    let side = (PLACE * extent).max(f64::MIN_POSITIVE);
    let mut taken = HashSet::new();
    places.iter().copied().filter(|place| taken.insert(cell(*place - first, side))).collect()
}

/// The cell of a point.
fn cell(place: DVec3, side: f64) -> [i64; 3] {
    // Casts saturate, so all points beyond 2^63 cells share the last one.
    (place / side).floor().to_array().map(|x| x as i64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64Mcg;

    #[test]
    fn nearby_equals_brute_force() {
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        let mut places: Vec<DVec3> =
            (0..300).map(|_| DVec3::from_array(std::array::from_fn(|_| rng.random::<f64>() * 4.0 - 2.0))).collect();
        // Points on the borders of cells, and coinciding points.
        places.extend([DVec3::ZERO, DVec3::X, -DVec3::X, DVec3::splat(0.5), DVec3::splat(0.5)]);
        for radius in [0.1, 0.5, 1.0] {
            let nearby = Nearby::new(&places, |i| i % 3 != 1, radius);
            for i in 0..places.len() {
                let mut found: Vec<usize> = nearby.of(i).collect();
                found.sort_unstable();
                let near = |j: &usize| *j % 3 != 1 && places[*j].distance(places[i]) <= radius;
                assert_eq!(found, (0..places.len()).filter(near).collect::<Vec<_>>(), "{i} {radius}");
            }
        }
    }

    #[test]
    fn nearby_limits_the_points_of_a_crowded_place() {
        let places = [vec![DVec3::ONE; 100_000], vec![DVec3::splat(1e300), DVec3::splat(-1e300)]].concat();
        let nearby = Nearby::new(&places, |_| true, 1e-6);
        assert!((0..places.len()).all(|i| (1..=LOOKED_AT).contains(&nearby.of(i).count())));
    }
}
