//! Pairs of images that probably show the same place.

use raygrad::nerf::dataset::Photo;
use rayon::prelude::*;
use std::f32::consts::PI;

/// Width and height of the thumbnail behind a descriptor, in pixels, and of its cells.
const SIDE: usize = 64;
const CELL: usize = 16;
/// Directions of gradients that a cell distinguishes.
const DIRECTIONS: usize = 8;
/// Images that follow by name, with which COLMAP's sequential matcher pairs an image by default.
const FOLLOWING: usize = 10;
/// The most pairs of an image by its place.
const NEAREST: usize = 10;

/// What an image looks like, with norm 1. Images of one place have a large dot product.
pub type Descriptor = Vec<f32>;

/// Computes histograms of gradients (Dalal and Triggs 2005) of a grey thumbnail, and their square roots as in RootSIFT
/// (Arandjelovic and Zisserman 2012). Correlation of thumbnails found less than half of the pairs in the test
/// below: it compares the horizon.
pub fn describe(photo: &Photo) -> Descriptor {
    let small = photo.resized([photo.width.min(SIDE), photo.height.min(SIDE)]);
    let grey = |x: usize, y: usize| {
        let [r, g, b, _] = small.pixel(x * small.width / SIDE, y * small.height / SIDE);
        0.299 * r + 0.587 * g + 0.114 * b
    };
    let mut histograms = vec![0.0; (SIDE / CELL).pow(2) * DIRECTIONS];
    for (x, y) in (1..SIDE - 1).flat_map(|y| (1..SIDE - 1).map(move |x| (x, y))) {
        let [along, across] = [grey(x + 1, y) - grey(x - 1, y), grey(x, y + 1) - grey(x, y - 1)];
        // The sign of a gradient depends on the light.
        let turn = across.atan2(along).rem_euclid(PI) / PI * DIRECTIONS as f32;
        let (first, size) = (turn as usize % DIRECTIONS, along.hypot(across));
        let cell = DIRECTIONS * (y / CELL * (SIDE / CELL) + x / CELL);
        histograms[cell + first] += size * (1.0 - turn.fract());
        histograms[cell + (first + 1) % DIRECTIONS] += size * turn.fract();
    }
    let norm = histograms.iter().sum::<f32>().max(1e-6);
    histograms.iter().map(|value| (value / norm).sqrt()).collect()
}

/// The dot product, in eight sums that a processor adds at once.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0; 8];
    for (a, b) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
        for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(b)) {
            *sum += a * b;
        }
    }
    sums.iter().sum()
}

/// Pairs each image, in order of names, with the `wanted` most similar ones, of which no two are closer than `apart`
/// by number, and with the nearest by latitude and longitude. Leaves out pairs that the sequential matcher has.
pub fn find(descriptors: &[Descriptor], places: &[Option<[f64; 2]>], wanted: usize, apart: usize) -> Vec<[usize; 2]> {
    let best = |i: usize, rate: &dyn Fn(usize) -> Option<f32>, wanted: usize, apart: usize| {
        let others = (0..descriptors.len()).filter(|j| i.abs_diff(*j) > FOLLOWING);
        let mut rated: Vec<(f32, usize)> = others.filter_map(|j| Some((rate(j)?, j))).collect();
        // A chosen one excludes fewer than twice `apart` others.
        let enough = wanted * (2 * apart).max(1);
        if rated.len() > enough {
            rated.select_nth_unstable_by(enough, |a, b| b.0.total_cmp(&a.0));
            rated.truncate(enough);
        }
        rated.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut chosen: Vec<usize> = vec![];
        for (_, j) in rated {
            if chosen.len() == wanted {
                break;
            }
            if chosen.iter().all(|other| other.abs_diff(j) >= apart) {
                chosen.push(j);
            }
        }
        chosen
    };
    let of = |i: usize| {
        let similar = best(i, &|j| Some(dot(&descriptors[i], &descriptors[j])), wanted, apart);
        let near = best(i, &|j| Some(-distance(places[i]?, places[j]?)), NEAREST, 0);
        similar.into_iter().chain(near).map(move |j| [i.min(j), i.max(j)]).collect::<Vec<_>>()
    };
    let mut pairs: Vec<[usize; 2]> = (0..descriptors.len()).into_par_iter().flat_map_iter(of).collect();
    pairs.par_sort_unstable();
    pairs.dedup();
    pairs
}

/// The distance of two near places in degrees of latitude.
fn distance(a: [f64; 2], b: [f64; 2]) -> f32 {
    // A date line may lie between them.
    let east = (a[1] - b[1] + 540.0).rem_euclid(360.0) - 180.0;
    (a[0] - b[0]).hypot(east * a[0].to_radians().cos()) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::glam::DVec3;
    use raygrad::nerf::{Camera, Image};
    use raygrad_scenes::Landscape;
    use std::f64::consts::TAU;

    /// Images of two walks around the bulldozer, `count` each: the second one farther, higher and half a step ahead.
    fn two_loops(count: usize) -> Vec<Descriptor> {
        let landscape = Landscape::new();
        let image = |[radius, height, ahead]: [f64; 3], i: usize| {
            let angle = TAU * (i as f64 + ahead) / count as f64;
            let eye = DVec3::new(radius * angle.cos(), radius * angle.sin(), Landscape::GROUND + height);
            let pose = Camera::look_at(eye, DVec3::new(0.0, 0.0, Landscape::GROUND + 0.8), DVec3::Z);
            describe(&landscape.render(&Camera::from_angle(128, 96, 1.0, pose), 1).into())
        };
        let loops = [[3.8, 1.0, 0.0], [4.2, 1.4, 0.5]];
        let all: Vec<(usize, usize)> = (0..2).flat_map(|lap| (0..count).map(move |i| (lap, i))).collect();
        all.into_par_iter().map(|(lap, i)| image(loops[lap], i)).collect()
    }

    /// The share of images of the first loop that have a pair within two steps of the same place in the second one.
    fn linked(pairs: &[[usize; 2]], count: usize) -> f64 {
        let is_same_place = |a: usize, b: usize| {
            let steps = (b + count - a) % count;
            steps.min(count - steps) <= 2
        };
        let is_linked = |i: &usize| pairs.iter().any(|[a, b]| a == i && *b >= count && is_same_place(*a, *b - count));
        (0..count).filter(is_linked).count() as f64 / count as f64
    }

    #[test]
    fn two_loops_are_linked_at_the_same_places() {
        let count = 60;
        let descriptors = two_loops(count);
        let places = vec![None; 2 * count];
        for (wanted, apart) in [(20, 0), (5, 10)] {
            let pairs = find(&descriptors, &places, wanted, apart);
            let share = linked(&pairs, count);
            assert!(share > 0.9, "{wanted} {apart}: {share}");
            assert!(pairs.len() <= wanted * 2 * count && pairs.iter().all(|[a, b]| a + FOLLOWING < *b));
        }
    }

    #[test]
    fn near_places_are_paired() {
        // A line of 60 places, walked twice, 11 metres apart; the images show nothing.
        let place = |i: usize| Some([48.0 + 1e-4 * (i % 30) as f64, 179.9999 - if i < 30 { 0.0 } else { 359.9999 }]);
        let blank = describe(&Image::new(8, 6, 3).into());
        assert!(blank.iter().all(|value| *value == 0.0));
        let places: Vec<_> = (0..60).map(place).collect();
        let pairs = find(&vec![blank; 60], &places, 0, 0);
        assert!((0..30).all(|i| pairs.contains(&[i, i + 30])), "{pairs:?}");
        assert!(find(&vec![vec![0.0; 8]; 60], &[None; 60], 0, 0).is_empty());
    }
}
