//! Bit operations compared with sets of cells, updates with their rules, and skipping with its error bound.

use super::*;
use crate::random::Jitter;
use crate::volume::{OpticalDepth, accumulate, weights};
use crate::{Ray, Rays};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::{Pool, Scalar, Tape};
use raygrad_nn::{Exchange, InProcess};
use std::collections::BTreeSet;
use std::sync::Mutex;

const BOX: [DVec3; 2] = [DVec3::NEG_ONE, DVec3::new(1.0, 2.0, 3.0)];

fn grid(resolution: usize, cascades: usize) -> OccupancyGrid {
    OccupancyGrid::new(BOX, &OccupancyConfig { resolution, cascades, ..OccupancyConfig::default() }).unwrap()
}

/// The cell of a bit of a word, in its cascade.
fn place(lattice: &Lattice, word: usize, bit: usize) -> [usize; 3] {
    let (_, block) = lattice.place(word);
    let cell = lattice::cell(bit);
    [0, 1, 2].map(|axis| block[axis] * 4 + cell[axis])
}

/// The set cells of cascade 0.
fn set(words: &[u64], lattice: &Lattice) -> BTreeSet<[usize; 3]> {
    let all = (0..lattice.blocks()).flat_map(|word| (0..CELLS).map(move |bit| (word, bit)));
    all.filter(|(word, bit)| words[*word] >> bit & 1 == 1).map(|(word, bit)| place(lattice, word, bit)).collect()
}

/// Random cells, few enough that not all are occupied after dilation.
fn random_words(lattice: &Lattice, share: f64, seed: u64) -> Vec<u64> {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    (0..lattice.words())
        .map(|_| (0..CELLS).fold(0, |word, bit| word | u64::from(rng.random::<f64>() < share) << bit))
        .collect()
}

/// A smooth density with a few balls in it; 0 to 20.
fn balls(points: &[[f32; 3]], out: &mut [f32]) {
    let centres = [[0.1, 0.4, 0.9], [-0.6, 1.2, 2.1], [0.5, -0.5, -0.4]];
    for (p, out) in points.iter().zip(out) {
        let distance = |c: &[f32; 3]| (0..3).map(|a| (p[a] - c[a]).powi(2)).sum::<f32>().sqrt();
        *out = centres.iter().map(|c| (20.0 * (0.3 - distance(c)).min(1.0)).max(0.0)).sum();
    }
}

#[test]
fn shared_updates_equal_those_of_one_process() {
    let grid = || grid(48, 2);
    let plans = [Update::ALL, Update { every: 3, occupied_every: 2, ..Update::PARTIAL }, Update::PARTIAL];
    let threshold = Threshold { min_sigma: 0.5, or_mean: false, dilate: false };
    let mut alone = grid();
    let mut evaluations = 0;
    for (step, plan) in (0..).zip(&plans) {
        evaluations += alone.update(plan, 5, step, &balls);
        alone.threshold(&threshold);
    }
    for ranks in [1, 2, 3, 7] {
        let update = |mut exchange: InProcess| {
            let (mut grid, mut evaluations, rank) = (grid(), 0, exchange.rank());
            let mut gather = |own: Vec<f32>, counts: &[usize]| {
                assert_eq!(own.len(), counts[rank]);
                let mut bytes = vec![];
                f32::write_le(&own, &mut bytes);
                let all = exchange.all_gather(&bytes).ok()?;
                Some(all.iter().map(|bytes| f32::read_le(bytes)).collect())
            };
            for (step, plan) in (0..).zip(&plans) {
                let shares = &mut Shares { rank, ranks, gather: &mut gather };
                evaluations += grid.update_shared(plan, 5, step, &balls, shares);
                grid.threshold(&threshold);
            }
            (grid.to_bytes(), evaluations)
        };
        let found: Vec<(Vec<u8>, u64)> = std::thread::scope(|scope| {
            let update = &update;
            let threads: Vec<_> =
                InProcess::ranks(ranks).into_iter().map(|rank| scope.spawn(move || update(rank))).collect();
            threads.into_iter().map(|thread| thread.join().unwrap()).collect()
        });
        assert!(found.iter().all(|(bytes, _)| *bytes == alone.to_bytes()), "{ranks} ranks");
        assert_eq!(found.iter().map(|(_, evaluations)| evaluations).sum::<u64>(), evaluations, "{ranks} ranks");
        let fair = evaluations / ranks as u64;
        assert!(found.iter().all(|(_, own)| (fair / 2..=2 * fair).contains(own)), "{ranks} ranks");
    }
}

proptest! {
    #[test]
    fn dilation_equals_neighbour_sets(seed in 0..1000u64, share in 0.0..0.02f64, side in 1..5usize) {
        let lattice = Lattice { bounds: BOX, resolution: 4 * side, cascades: 1 };
        let words = random_words(&lattice, share, seed);
        let mut expected = BTreeSet::new();
        for cell in set(&words, &lattice) {
            for i in 0..27 {
                let shift = [i % 3, i / 3 % 3, i / 9];
                let near = [0, 1, 2].map(|axis| (cell[axis] + shift[axis]).wrapping_sub(1));
                if near.iter().all(|x| *x < lattice.resolution) {
                    expected.insert(near);
                }
            }
        }
        let mut dilated = words;
        bits::dilate(&mut dilated, &lattice);
        prop_assert_eq!(set(&dilated, &lattice), expected);
    }

    #[test]
    fn occupied_share_equals_cell_count(seed in 0..1000u64, share in 0.0..0.005f64) {
        let mut grid = grid(16, 1);
        let words = random_words(&grid.lattice, share, seed);
        let cells = set(&words, &grid.lattice);
        grid.occupy(words, false);
        prop_assert_eq!(grid.occupied_share(), cells.len() as f64 / 4096.0);
    }

    #[test]
    fn leaps_equal_growing_cubes(seed in 0..1000u64, share in 0.0..0.002f64, octant in 0..8usize) {
        let lattice = Lattice { bounds: BOX, resolution: 20, cascades: 1 };
        let words = random_words(&lattice, share, seed);
        let leaps = Leaps::new(&words, &lattice);
        for (word, &leap) in leaps.octant(octant).iter().enumerate() {
            let (_, block) = lattice.place(word);
            let is_empty = |edge: usize| {
                (0..edge.pow(3)).map(|i| [i % edge, i / edge % edge, i / edge / edge]).all(|shift| {
                    let at = |a: usize| if octant >> a & 1 == 1 { block[a].wrapping_sub(shift[a]) } else { block[a] + shift[a] };
                    let at = [at(0), at(1), at(2)];
                    at.iter().any(|x| *x >= 5) || words[at[0] + 5 * (at[1] + 5 * at[2])] == 0
                })
            };
            let expected = (1..=5).take_while(|edge| is_empty(*edge)).count();
            prop_assert_eq!(usize::from(leap.min(5)), expected, "block {:?}", block);
        }
    }
}

#[test]
fn coarsen_covers_finer_cascades() {
    let lattice = Lattice { bounds: BOX, resolution: 32, cascades: 3 };
    let mut words: Vec<u64> = random_words(&lattice, 0.001, 4);
    words[lattice.cascade(1).start..].fill(0);
    let fine = words.clone();
    bits::coarsen(&mut words, &lattice);
    for cascade in 1..3 {
        let side = 1 << cascade;
        let start = lattice.cascade(cascade).start;
        let coarse = set(&words[start..], &lattice);
        let expected = set(&fine, &lattice).iter().map(|cell| cell.map(|x| (x / side) + 16 - 16 / side)).collect();
        assert_eq!(coarse, expected, "cascade {cascade}");
    }
    assert_eq!(lattice.used_cells(), 32 * 32 * 32 * 3 - 2 * 16 * 16 * 16);
    let used = (0..lattice.words()).filter(|word| lattice.is_used(*word)).count();
    assert_eq!(used * CELLS, lattice.used_cells());
}

#[test]
fn cascade_thresholds_halve_each_time() {
    for (sigma, expected) in [(0.9, [false, true, true]), (1.1, [true, true, true]), (0.4, [false, false, true])] {
        let mut grid = grid(32, 3);
        grid.update(&Update::ALL, 0, 0, &|points, out| out[..points.len()].fill(sigma));
        grid.threshold(&Threshold { min_sigma: 1.0, or_mean: false, dilate: false });
        let lattice = &grid.lattice;
        let occupied = [0, 1, 2].map(|cascade| {
            let words = lattice.cascade(cascade).filter(|word| lattice.is_used(*word));
            words.map(|word| grid.words[word]).collect::<Vec<_>>()
        });
        for (cascade, words) in occupied.iter().enumerate() {
            assert!(
                words.iter().all(|word| *word == if expected[cascade] { u64::MAX } else { 0 }),
                "{sigma} {cascade}"
            );
        }
        // The least visible fog, through all boxes from corner to corner. The first box contributes its diagonal. Each
        // further one has half the density in the half of its diagonal that is beyond the box before.
        let [low, high] = grid.bounds();
        assert!(grid.longest_path() >= (1.0 + 0.5 * 1.0 + 0.25 * 2.0) * low.distance(high));
    }
}

#[test]
fn lattice_cells_tile_the_boxes() {
    let lattice = Lattice { bounds: BOX, resolution: 16, cascades: 2 };
    let [low, high] = lattice.extent(1);
    assert_eq!((low, high), (DVec3::new(-2.0, -2.5, -3.0), DVec3::new(2.0, 3.5, 5.0)));
    let volume = |word: usize| {
        let [_, size] = lattice.block(word);
        size.element_product() * CELLS as f64
    };
    let total: f64 = (0..lattice.words()).filter(|word| lattice.is_used(*word)).map(volume).sum();
    assert!((total / (high - low).element_product() - 1.0).abs() < 1e-12);
    let [corner, size] = lattice.block(lattice.words() - 1);
    assert!((corner + 4.0 * size).distance(high) < 1e-12);
}

#[test]
fn new_grid_and_unqueried_cells_are_occupied() {
    let mut grid = grid(16, 2);
    assert_eq!(grid.occupied_share(), 1.0);
    grid.threshold(&Threshold { min_sigma: 0.1, or_mean: true, dilate: false });
    assert_eq!(grid.occupied_share(), 1.0);
    grid.update(&Update::ALL, 0, 0, &|_, out| out.fill(0.0));
    grid.threshold(&Threshold { min_sigma: 0.1, or_mean: false, dilate: true });
    assert_eq!(grid.occupied_share(), 0.0);
    grid.update(&Update::ALL, 0, 0, &|_, out| out.fill(f32::NAN));
    grid.threshold(&Threshold { min_sigma: 0.1, or_mean: false, dilate: false });
    assert_eq!(grid.occupied_share(), 1.0, "a field's NaN is not empty space");
}

#[test]
fn updates_decay_and_take_the_larger() {
    let mut grid = grid(8, 1);
    let mut expect = |sigma: f32, decay: f32, expected: f32| {
        let plan = Update { decay, samples: 2, ..Update::ALL };
        assert_eq!(grid.update(&plan, 1, 0, &|_, out| out.fill(sigma)), 8 * 512);
        assert!(grid.densities.iter().all(|x| *x == expected), "{expected}: {:?}", &grid.densities[..4]);
    };
    expect(2.0, 0.5, 2.0);
    expect(0.25, 0.5, 1.0);
    expect(0.75, 0.5, 0.75);
    expect(f32::INFINITY, 0.5, f32::INFINITY);
    assert_eq!(grid.mean_density(), f64::INFINITY);
}

#[test]
fn update_samples_lie_in_their_cells() {
    let mut grid = grid(16, 3);
    let outside = Mutex::new(0);
    let (low, high) = (grid.outer_bounds()[0].as_vec3() - 1e-5, grid.outer_bounds()[1].as_vec3() + 1e-5);
    // The density encodes the position: after one sample, a cell's density must be that of a point within it.
    let density = |points: &[[f32; 3]], out: &mut [f32]| {
        for (p, out) in points.iter().zip(out) {
            *outside.lock().unwrap() += usize::from((0..3).any(|a| !(low[a]..=high[a]).contains(&p[a])));
            *out = p[0] + 10.0;
        }
    };
    assert_eq!(grid.update(&Update::ALL, 3, 5, &density), grid.cells() as u64);
    assert_eq!(*outside.lock().unwrap(), 0);
    for word in (0..grid.words.len()).filter(|word| grid.lattice.is_used(*word)) {
        let [corner, size] = grid.lattice.block(word);
        for bit in 0..CELLS {
            let low = corner.x + size.x * lattice::cell(bit)[0] as f64;
            let x = f64::from(grid.densities[word * CELLS + bit] / grid.lattice.enlargement(word)) - 10.0;
            assert!((low - 1e-5..=low + size.x + 1e-5).contains(&x), "{x} from {low}");
        }
    }
}

#[test]
fn partial_updates_visit_every_cell_once_in_a_round() {
    for every in [1, 3, 4, 100] {
        let mut grid = grid(16, 2);
        grid.occupy(vec![0; grid.words.len()], false);
        let plan = Update { every, ..Update::ALL };
        let visits: u64 = (0..u64::from(every)).map(|step| grid.update(&plan, 7, step, &|_, out| out.fill(1.0))).sum();
        assert_eq!(visits, grid.cells() as u64, "each once");
        let used = (0..grid.words.len()).filter(|word| grid.lattice.is_used(*word));
        let all_ones = |word: usize| {
            let scale = grid.lattice.enlargement(word);
            grid.densities[word * CELLS..][..CELLS].iter().all(|x| *x == scale)
        };
        assert!(used.into_iter().all(all_ones), "all of them");
    }
    let mut grid = grid(16, 1);
    grid.update(&Update::ALL, 0, 0, &balls);
    grid.threshold(&Threshold { min_sigma: 0.01, or_mean: false, dilate: false });
    let occupied = (4096.0 * grid.occupied_share()) as u64;
    let asked = grid.update(&Update::PARTIAL, 0, 1, &balls);
    assert!(asked >= 256 && asked >= occupied && asked <= 256 + occupied, "{asked}, {occupied} occupied");
}

#[test]
fn updates_have_the_same_bits_on_any_threads() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut grid = grid(64, 2);
            for step in 0..3 {
                grid.update(&Update { every: 2, ..Update::ALL }, 11, step, &balls);
                grid.threshold(&Threshold { min_sigma: 0.5, or_mean: true, dilate: step == 2 });
            }
            let trained = grid.to_bytes();
            grid.rebuild(0.3, true, &balls);
            (trained, grid.to_bytes())
        })
    };
    let one = run(1);
    assert!(one == run(2) && one == run(5));
}

#[test]
fn rebuild_equals_eight_samples_per_cell() {
    for (cascades, dilate) in [(1, false), (1, true), (2, true)] {
        let mut grid = grid(32, cascades);
        let mut calls = 0;
        calls += grid.rebuild(0.2, dilate, &balls);
        let mut full = vec![0; grid.words.len()];
        for word in (0..full.len()).filter(|word| grid.lattice.is_used(*word)) {
            let [corner, size] = grid.lattice.block(word);
            for bit in 0..CELLS {
                let points: Vec<[f32; 3]> = (0..8)
                    .map(|i| {
                        let part = DVec3::from([i % 2, i / 2 % 2, i / 4].map(|x| 0.25 + 0.5 * x as f64));
                        let cell = DVec3::from(lattice::cell(bit).map(|x| x as f64));
                        (corner + size * (cell + part)).as_vec3().to_array()
                    })
                    .collect();
                let mut out = [0.0; 8];
                balls(&points, &mut out);
                full[word] |= u64::from(out.iter().any(|x| *x > 0.2)) << bit;
            }
        }
        let mut expected = grid.clone();
        expected.occupy(full, dilate);
        assert!(grid.words == expected.words, "{} of {}", grid.occupied_share(), expected.occupied_share());
        assert!(calls < 3 * grid.cells() as u64, "{calls}");
    }
}

#[test]
fn pruning_empties_faint_cells_and_fills_none() {
    let mut grid = grid(32, 1);
    // Half of the box; the field is not evaluated elsewhere.
    grid.carve(&|centre, radius| centre.x + radius < 0.0);
    grid.empty_carved();
    let before = set(&grid.words, &grid.lattice);
    assert!((0.45..0.55).contains(&grid.occupied_share()));
    let asked = Mutex::new(0);
    grid.prune(1.0, &|points, out| {
        *asked.lock().unwrap() += points.len() as u64;
        assert!(points.iter().all(|point| point[0] > -0.1));
        balls(points, out);
    });
    let after = set(&grid.words, &grid.lattice);
    assert!(after.is_subset(&before) && after.len() > 20 && after.len() < before.len() / 10, "{}", after.len());
    // Eight points per cell, and 64 more in emptied ones.
    let most = 72 * before.len() - 64 * after.len();
    let asked = asked.into_inner().unwrap() as usize;
    assert!((most..most + 64 * after.len()).contains(&asked), "{asked}, {most}");
}

#[test]
fn pruning_keeps_a_sheet_between_octant_centres() {
    let mut grid = grid(32, 1);
    let [low, high] = grid.bounds();
    let (first, size) = (low.x as f32, ((high.x - low.x) / 32.0) as f32);
    let sheet = |points: &[[f32; 3]], out: &mut [f32]| {
        for (point, out) in points.iter().zip(out) {
            let place = (point[0] - first) / size;
            *out = if (5.4..5.6).contains(&place) { 50.0 } else { 0.0 };
        }
    };
    grid.prune(1.0, &sheet);
    assert_eq!(grid.occupied_share(), 1.0 / 32.0, "all cells that it crosses, and no other");
}

#[test]
fn carved_cells_are_never_sampled_and_stay_empty() {
    let mut grid = grid(16, 1);
    grid.carve(&|centre, _| centre.y < 0.5);
    let everywhere = |points: &[[f32; 3]], out: &mut [f32]| {
        assert!(points.iter().all(|point| point[1] > 0.3));
        out.fill(9.0);
    };
    assert_eq!(grid.update(&Update::ALL, 0, 0, &everywhere), 8 * 16 * 16);
    grid.threshold(&Threshold { min_sigma: 1.0, or_mean: true, dilate: false });
    assert_eq!(grid.occupied_share(), 0.5);
    assert_eq!(grid.mean_density(), 9.0);
}

#[test]
fn occupancy_grid_round_trips() {
    let mut stored = grid(16, 2);
    stored.update(&Update { every: 2, ..Update::ALL }, 0, 0, &balls);
    stored.threshold(&Threshold { min_sigma: 0.1, or_mean: false, dilate: true });
    let bytes = stored.to_bytes();
    let read = OccupancyGrid::from_bytes(&bytes).unwrap();
    assert_eq!((read.to_bytes() == bytes, &read.words, &read.lattice), (true, &stored.words, &stored.lattice));
    let message = |bytes: &[u8]| OccupancyGrid::from_bytes(bytes).unwrap_err().to_string();
    // Renders need a bit per cell alone.
    let occupied = stored.occupied_to_bytes();
    assert_eq!(occupied.len(), 64 + 2 * 16 * 16 * 16 / 8);
    let seen = OccupancyGrid::from_bytes(&occupied).unwrap();
    assert_eq!((&seen.words, &seen.lattice), (&stored.words, &stored.lattice));
    assert!(seen.occupied_to_bytes() == occupied && seen.occupied_share() < 1.0);
    let march = |grid: &OccupancyGrid| {
        let mut rays = Rays::<f32>::new();
        rays.push(&Ray { origin: DVec3::new(0.1, 0.2, -9.0), direction: DVec3::Z }, [0.0, 20.0]);
        let mut found = MarchBuffer::default();
        grid.march(&rays, &Step::uniform(0.01), &mut Jitter::Middle, &mut found);
        found.t
    };
    assert!(march(&seen) == march(&stored) && !march(&seen).is_empty());
    assert!(message(&occupied[..occupied.len() - 8]).contains("save the model again"));
    assert!(message(&[&occupied[..], &[0; 4]].concat()).contains("save the model again"));
    for length in [0, 7, 8, 60, 64, bytes.len() - 1] {
        assert!(message(&bytes[..length]).starts_with("`occupancy grid`: "), "{length}");
    }
    assert!(message(&[&bytes[..], &[0]].concat()).contains("save the model again"));
    let edited = |at: usize, value: &[u8]| {
        let mut bytes = bytes.clone();
        bytes[at..at + value.len()].copy_from_slice(value);
        message(&bytes)
    };
    assert!(edited(0, b"?").contains("not an occupancy grid"));
    assert!(edited(8, &u32::MAX.to_le_bytes()).contains("occupancy.resolution"));
    assert!(edited(12, &9_u32.to_le_bytes()).contains("occupancy.cascades"));
    assert!(edited(16, &f64::NAN.to_le_bytes()).contains("use finite corners, the lower below the upper"));
}

#[test]
fn occupancy_settings_out_of_range_are_errors() {
    let check = |resolution, cascades| OccupancyConfig { resolution, cascades, skip: Skip::Off.into() }.check();
    assert!(check(4, 1).is_ok() && check(12, 1).is_ok() && check(1024, 1).is_ok() && check(512, 8).is_ok());
    for (resolution, cascades) in
        [(0, 1), (6, 1), (1028, 1), (12, 2), (0, 2), (16, 0), (16, 9), (528, 8), (1024, 2), (1024, 8)]
    {
        assert!(check(resolution, cascades).is_err(), "{resolution}, {cascades}");
    }
    assert!(OccupancyGrid::new([DVec3::ONE, DVec3::ONE], &OccupancyConfig::default()).is_err());
    for skip in [Skip::Off, Skip::NearLossless, Skip::Fast] {
        assert_eq!(skip.to_string().parse::<Skip>().unwrap(), skip);
    }
    assert!("slow".parse::<Skip>().unwrap_err().to_string().contains("off, near-lossless or fast"));
}

/// Colours of rays from all sides, and the number of samples: with the grid's samples.
fn render(grid: &OccupancyGrid, density: &DensityFn<'_>) -> (Vec<f32>, u64) {
    let mut rays = Rays::new();
    let mut rng = Pcg64Mcg::seed_from_u64(5);
    for _ in 0..200 {
        let point = |rng: &mut Pcg64Mcg| BOX[0] + (BOX[1] - BOX[0]) * DVec3::from_array(rng.random::<[f64; 3]>());
        let (origin, target) = (point(&mut rng) * 3.0, point(&mut rng));
        rays.push(&Ray { origin, direction: (target - origin).normalize() }, [0.0, 20.0]);
    }
    let mut found = MarchBuffer::default();
    grid.march(&rays, &Step::uniform(0.01), &mut Jitter::Middle, &mut found);
    let tape = Tape::new();
    let samples = found.samples(&rays, &Pool::new());
    let mut sigma = raygrad_autograd::Tensor::zeros(&[samples.len()]);
    let positions: Vec<[f32; 3]> = samples.positions(&Pool::new()).as_slice().as_chunks().0.to_vec();
    density(&positions, sigma.as_mut_slice());
    let color = raygrad_autograd::Tensor::from_fn(&[samples.len(), 1], |i| 0.5 + 0.5 * f32::sin(9.0 * positions[i][0]));
    let x = tape.apply(OpticalDepth::new(samples.delta.clone()), &[&tape.constant(sigma)]);
    let color = accumulate(&weights(&x, &samples.segments), &tape.constant(color), &samples.segments);
    let left = (-x.segment_sum(&samples.segments)).exp();
    // Over white.
    let pairs = color.value().as_slice().iter().zip(left.value().as_slice());
    (pairs.map(|(color, left)| color + left).collect(), samples.len() as u64)
}

/// docs/library/numerics.md, "Skipping": uniform fog with balls in it, above and just below the skipped density.
#[test]
fn skipping_error_is_within_its_bound() {
    let all = grid(32, 1);
    for skip in [Skip::NearLossless, Skip::Fast] {
        let min_sigma = skip.min_sigma(all.longest_path());
        for (fog, is_skipped) in [(0.99, false), (1.01 * min_sigma, false), (0.99 * min_sigma, true)] {
            let density = |points: &[[f32; 3]], out: &mut [f32]| {
                balls(points, out);
                out.iter_mut().for_each(|x| *x = x.max(fog));
            };
            let mut left = all.clone();
            left.rebuild(min_sigma, true, &density);
            assert_eq!(left.occupied_share() < 0.5, is_skipped);
            let ((reference, many), (skipped, few)) = (render(&all, &density), render(&left, &density));
            assert_eq!(few < many / 2, is_skipped, "{few} of {many}");
            let error =
                reference.iter().zip(&skipped).map(|(a, b)| (a - b).abs()).fold(0.0, raygrad_tensor::Real::maximum);
            assert!(f64::from(error) <= skip.error_bound(), "{skip}: {error}");
            assert_eq!(error > 0.0, is_skipped, "{skip}, fog {fog}: {error}");
        }
    }
    assert_eq!(Skip::Off.min_sigma(1.0), f32::NEG_INFINITY);
    let mut off = all.clone();
    off.rebuild(Skip::Off.min_sigma(all.longest_path()), false, &|_, out| out.fill(0.0));
    assert_eq!(off.occupied_share(), 1.0);
}
