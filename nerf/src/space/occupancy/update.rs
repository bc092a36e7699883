//! Updates of the grid from a field: some cells at a time in training, all relevant ones before rendering.

use super::lattice::{CELLS, Lattice, cell, uncarved};
use super::{OccupancyGrid, TASK, bits, exceeding};
use crate::random::stream;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use raygrad_tensor::parallel::{self, Scratch};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// A function that writes the density (1 / scene unit) at each position (scene units) to the same index of the output.
///
/// It is called from several threads, with at most [`POINTS`] positions that lie close together.
pub type DensityFn<'a> = dyn Fn(&[[f32; 3]], &mut [f32]) + Sync + 'a;

/// Maximum number of positions per call of a [`DensityFn`].
pub const POINTS: usize = 4096;
/// Samples along each edge of a cell in [`OccupancyGrid::rebuild`].
const REBUILD: usize = 2;

/// Samples along each edge of a cell that [`OccupancyGrid::prune`] would empty.
const CLOSELY: usize = 4;

/// The processes that share the [update](OccupancyGrid::update_shared) of a grid. All have the same grid.
pub struct Shares<'a> {
    /// The number of this process, from 0.
    pub rank: usize,
    /// Number of processes.
    pub ranks: usize,
    /// Sends numbers to all processes, and returns those of each, by rank. The second argument is their number from each
    /// rank. `None` if that fails: the grid is then updated in part.
    #[allow(clippy::type_complexity)]
    pub gather: &'a mut dyn FnMut(Vec<f32>, &[usize]) -> Option<Vec<Vec<f32>>>,
}

/// The cells that [`OccupancyGrid::update`] samples, and how.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Update {
    /// Every cell is sampled once in this many updates, at least 1.
    pub every: u32,
    /// Every occupied cell is sampled once in this many updates, at least 1.
    pub occupied_every: u32,
    /// Samples along each edge of a cell, 1 to 4: 2 means 2 x 2 x 2 samples, one random point per octant.
    pub samples: u32,
    /// Factor of a cell's old density when it is sampled, 0 to 1; the larger of that and the new density is kept.
    pub decay: f32,
}

impl Update {
    /// All cells, the usual choice for the first 256 steps of training.
    pub const ALL: Update = Update { every: 1, occupied_every: 1, samples: 1, decay: 0.95 };
    /// Occupied cells and one in sixteen of the others, for later steps. On scenes of solid objects it is as good as
    /// the usual one in four, at half the cost.
    pub const PARTIAL: Update = Update { every: 16, ..Update::ALL };
}

/// Sample positions in a cell, as shares of its edges: a random point in each of the boxes with these lower corners and
/// this size. A size of 0 gives fixed points.
struct Places {
    corners: Vec<[f64; 3]>,
    size: f64,
}

impl Places {
    /// A random point in each of `n` x `n` x `n` parts.
    fn random(n: usize) -> Self {
        Places { corners: parts(n, 0.0), size: 1.0 / n as f64 }
    }

    /// The centre of each of `n` x `n` x `n` parts.
    fn middles(n: usize) -> Self {
        Places { corners: parts(n, 0.5), size: 0.0 }
    }
}

/// The points `shift` parts from the lower corners of `n` x `n` x `n` parts.
fn parts(n: usize, shift: f64) -> Vec<[f64; 3]> {
    (0..n * n * n).map(|i| [i % n, i / n % n, i / (n * n)].map(|k| (k as f64 + shift) / n as f64)).collect()
}

/// Positions to sample, and their cells.
#[derive(Default)]
struct Waiting {
    cells: Vec<usize>,
    points: Vec<[f32; 3]>,
    densities: Vec<f32>,
}

impl Waiting {
    /// Samples the waiting positions. `scale` is the factor of the densities of a word's cells. `keep` combines a
    /// cell's old density and the largest new one.
    fn flush(
        &mut self,
        density: &DensityFn<'_>,
        samples: usize,
        out: &mut [f32],
        scale: impl Fn(usize) -> f32,
        keep: impl Fn(f32, f32) -> f32,
    ) {
        if self.points.is_empty() {
            return;
        }
        self.densities.clear();
        self.densities.resize(self.points.len(), f32::NAN);
        density(&self.points, &mut self.densities);
        for (&cell, found) in self.cells.iter().zip(self.densities.chunks_exact(samples)) {
            let found = found.iter().fold(f32::NEG_INFINITY, |a, &b| larger(a, b));
            out[cell] = keep(out[cell], scale(cell / CELLS) * found);
        }
        self.cells.clear();
        self.points.clear();
    }
}

/// The larger of two densities; NaN if the field gave NaN, so that the cell stays occupied.
fn larger(old: f32, new: f32) -> f32 {
    if new <= old || old.is_nan() { old } else { new }
}

/// The cells of word `word` that have their turn, if every cell has one turn in `every` steps.
fn turn(word: usize, step: u64, every: u32) -> u64 {
    // Neighbouring words start their rounds at unrelated cells (multiples of the golden ratio).
    let start = (word as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
    let every = u64::from(every.max(1));
    let first = (start + step) % every;
    (first..CELLS as u64).step_by(every as usize).fold(0, |cells, bit| cells | 1 << bit)
}

impl OccupancyGrid {
    /// Samples some cells and returns the number of density evaluations.
    ///
    /// Each cell's density becomes `max(decay * old, largest new)`. Occupancy changes only with the next
    /// [`threshold`](Self::threshold). `step` counts the updates; with `seed` it determines cells and points, on any
    /// number of threads.
    ///
    /// # Panics
    /// If a value of `plan` is out of range.
    pub fn update(&mut self, plan: &Update, seed: u64, step: u64, density: &DensityFn<'_>) -> u64 {
        let alone = &mut |own, _: &[usize]| Some(vec![own]);
        self.update_shared(plan, seed, step, density, &mut Shares { rank: 0, ranks: 1, gather: alone })
    }

    /// As [`update`](Self::update), with the evaluations shared between processes. The grid gets the same bits for any
    /// number of them. Returns the number of evaluations of this process.
    ///
    /// # Panics
    /// As [`update`](Self::update).
    pub fn update_shared(
        &mut self,
        plan: &Update,
        seed: u64,
        step: u64,
        density: &DensityFn<'_>,
        shares: &mut Shares<'_>,
    ) -> u64 {
        assert!(plan.every > 0 && plan.occupied_every > 0, "`every` and `occupied_every` must be at least 1: {plan:?}");
        assert!((1..=4).contains(&plan.samples), "`samples` must be 1 to 4: {plan:?}");
        assert!((0.0..=1.0).contains(&plan.decay), "`decay` must be 0 to 1: {plan:?}");
        let words = std::mem::take(&mut self.words);
        let chosen = |word: usize| turn(word, step, plan.every) | words[word] & turn(word, step, plan.occupied_every);
        let rng = |task: usize| stream(seed, [step, task as u64]);
        // A NaN of the field replaces the known density.
        let keep = |old: f32, new: f32| if new <= plan.decay * old { plan.decay * old } else { new };
        // Neighbouring tasks have similar numbers of occupied cells.
        let (rank, ranks) = (shares.rank, shares.ranks);
        let own = |word: usize| if word / TASK % ranks == rank { chosen(word) } else { 0 };
        // Which cells those are depends on the old densities.
        let cells = if ranks > 1 { self.cells_of_ranks(chosen, ranks) } else { vec![] };
        let count = self.look(&Places::random(plan.samples as usize), own, rng, keep, density);
        if ranks > 1 {
            self.gather(&cells, shares);
        }
        self.words = words;
        count
    }

    /// The chosen cells that each process samples, in order.
    fn cells_of_ranks(&self, chosen: impl Fn(usize) -> u64, ranks: usize) -> Vec<Vec<u32>> {
        let mut of_ranks = vec![vec![]; ranks];
        for (word, densities) in self.densities.chunks_exact(CELLS).enumerate() {
            let cells = cells(&self.lattice, word, densities, &chosen);
            // A grid has at most 2^30 cells.
            of_ranks[word / TASK % ranks].extend(bits_of(cells).map(|bit| (word * CELLS + bit) as u32));
        }
        of_ranks
    }

    /// Takes the densities of these cells from the processes that have sampled them.
    fn gather(&mut self, of_ranks: &[Vec<u32>], shares: &mut Shares<'_>) {
        let densities = Arc::make_mut(&mut self.densities);
        let own = of_ranks[shares.rank].iter().map(|&cell| densities[cell as usize]).collect();
        let counts: Vec<usize> = of_ranks.iter().map(Vec::len).collect();
        let Some(found) = (shares.gather)(own, &counts) else { return };
        for (cells, found) in of_ranks.iter().zip(found) {
            cells.iter().zip(found).for_each(|(&cell, found)| densities[cell as usize] = found);
        }
    }

    /// Finds the occupied cells of a trained field anew, for rendering, and returns the number of density evaluations.
    ///
    /// Samples are the centres of a cell's eight octants. One is evaluated in each cell; then all eight in each empty
    /// cell that touches an occupied one, until there are no more. The result equals eight samples in every cell,
    /// except for groups of touching cells that all miss in their first sample. A box of one cell's size with more than
    /// `min_sigma` everywhere is never missed. Of a group that is found, each cell with such a box of half that edge is
    /// occupied. Cells touch within a cascade; a cell also touches those of larger cascades, but no smaller ones.
    ///
    /// With `dilate`, the 26 neighbours of each occupied cell are occupied too, in its cascade and in those around it.
    pub fn rebuild(&mut self, min_sigma: f32, dilate: bool, density: &DensityFn<'_>) -> u64 {
        let all = Places::middles(REBUILD);
        let one = Places { corners: all.corners[..1].to_vec(), ..all };
        // Fixed points draw no random numbers.
        let rng = |_| stream(0, [0, 0]);
        let mut count = self.look(&one, |_| u64::MAX, rng, |_, new| new, density);
        let mut occupied = self.exceeding(min_sigma);
        let mut seen = occupied.clone();
        loop {
            let mut front = occupied.clone();
            bits::dilate(&mut front, &self.lattice);
            for (i, (front, seen)) in front.iter_mut().zip(&mut seen).enumerate() {
                *front = if self.lattice.is_used(i) { *front & !*seen } else { 0 };
                *seen |= *front;
            }
            if front.iter().all(|word| *word == 0) {
                break;
            }
            count += self.look(&all, |word| front[word], rng, larger, density);
            for (word, densities) in self.densities.chunks_exact(CELLS).enumerate().filter(|(i, _)| front[*i] != 0) {
                occupied[word] |= exceeding(densities, min_sigma) & front[word];
            }
        }
        self.occupy(occupied, dilate);
        count
    }

    /// Empties the occupied cells of a trained field where no sampled density exceeds `min_sigma`, and returns the
    /// number of density evaluations.
    ///
    /// It samples the centres of a cell's eight octants, and before emptying it one random point in each of 64 parts,
    /// so that thin structures are seldom missed. Stored densities do not change, so copies of the grid share them.
    pub fn prune(&mut self, min_sigma: f32, density: &DensityFn<'_>) -> u64 {
        let (fixed, random) = (Places::middles(REBUILD), Places::random(CLOSELY));
        let (lattice, mut occupied) = (&self.lattice, self.words.clone());
        let prune = |(waiting, found): &mut (Waiting, Vec<f32>), task: usize, words: &mut [u64]| {
            found.clear();
            found.resize(CELLS * words.len(), f32::NAN);
            let mut look = |places: &Places, words: &[u64], rng: Pcg64Mcg| {
                let chosen = |word: usize| words[word - task * TASK];
                let count = Look { lattice, places, density }.at(task, found, chosen, rng, |_, new| new, waiting);
                (count, found.chunks_exact(CELLS).map(|densities| exceeding(densities, min_sigma)).collect::<Vec<_>>())
            };
            let (count, exceeding) = look(&fixed, words, stream(0, [0, 0]));
            let emptied: Vec<u64> = words.iter().zip(exceeding).map(|(word, exceeding)| word & !exceeding).collect();
            let (more, exceeding) = look(&random, &emptied, stream(1, [0, task as u64]));
            for (i, (word, exceeding)) in words.iter_mut().zip(exceeding).enumerate() {
                *word &= if lattice.is_used(task * TASK + i) { exceeding } else { 0 };
            }
            count + more
        };
        let count = counted(occupied.chunks_mut(TASK), prune);
        self.occupy(occupied, false);
        count
    }

    /// Samples the chosen cells of each word.
    fn look(
        &mut self,
        places: &Places,
        chosen: impl Fn(usize) -> u64 + Sync,
        rng: impl Fn(usize) -> Pcg64Mcg + Sync,
        keep: impl Fn(f32, f32) -> f32 + Sync,
        density: &DensityFn<'_>,
    ) -> u64 {
        let look = Look { lattice: &self.lattice, places, density };
        counted(
            Arc::make_mut(&mut self.densities).chunks_mut(CELLS * TASK),
            |waiting: &mut Waiting, task, densities| look.at(task, densities, &chosen, rng(task), &keep, waiting),
        )
    }
}

/// The chosen cells of a word, whose densities are `densities`, that can be occupied.
fn cells(lattice: &Lattice, word: usize, densities: &[f32], chosen: impl Fn(usize) -> u64) -> u64 {
    match if lattice.is_used(word) { chosen(word) } else { 0 } {
        0 => 0,
        cells => cells & uncarved(densities),
    }
}

/// The numbers of the bits that are set, in order.
fn bits_of(mut word: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let bit = (word != 0).then(|| word.trailing_zeros() as usize)?;
        word &= word - 1;
        Some(bit)
    })
}

/// The sum of `f` over the parts, in parallel, with scratch space.
fn counted<P: Send, S: Default + Send>(
    parts: impl Iterator<Item = P>,
    f: impl Fn(&mut S, usize, P) -> u64 + Sync,
) -> u64 {
    let (scratch, count) = (Scratch::default(), AtomicU64::new(0));
    parallel::each_of(parts, |i, part| {
        let own = scratch.with(|scratch| parallel::serial(|| f(scratch, i, part)));
        count.fetch_add(own, Ordering::Relaxed);
    });
    count.into_inner()
}

/// The field, and the sample positions in a cell.
struct Look<'a> {
    lattice: &'a Lattice,
    places: &'a Places,
    density: &'a DensityFn<'a>,
}

impl Look<'_> {
    /// Samples the chosen cells of each word of a task, whose densities are `densities`, and returns the number of
    /// evaluations.
    fn at(
        &self,
        task: usize,
        densities: &mut [f32],
        chosen: impl Fn(usize) -> u64,
        mut rng: Pcg64Mcg,
        keep: impl Fn(f32, f32) -> f32,
        waiting: &mut Waiting,
    ) -> u64 {
        let Look { lattice, places, density } = *self;
        let samples = places.corners.len();
        let scale = |word: usize| lattice.enlargement(task * TASK + word);
        let mut count = 0;
        for word in 0..densities.len() / CELLS {
            let cells = cells(lattice, task * TASK + word, &densities[word * CELLS..(word + 1) * CELLS], &chosen);
            let [corner, size] = lattice.block(task * TASK + word).map(|x| x.to_array());
            count += samples * cells.count_ones() as usize;
            for bit in bits_of(cells) {
                if waiting.points.len() + samples > POINTS {
                    waiting.flush(density, samples, densities, scale, &keep);
                }
                waiting.cells.push(word * CELLS + bit);
                let cell = cell(bit);
                for part in &places.corners {
                    waiting.points.push(std::array::from_fn(|axis| {
                        let inside = if places.size > 0.0 { places.size * rng.random::<f64>() } else { 0.0 };
                        (corner[axis] + size[axis] * (cell[axis] as f64 + part[axis] + inside)) as f32
                    }));
                }
            }
        }
        waiting.flush(density, samples, densities, scale, &keep);
        count as u64
    }
}
