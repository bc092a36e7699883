//! After its first steps, training takes every tensor from the pools of its tapes: no allocation has tensor size.
//!
//! The test has its own binary, since it counts all allocations of the process.

use raygrad::nerf::dataset::Split;
use raygrad::nerf::sampling::hierarchical::HierarchicalConfig;
use raygrad::nerf::{ClassicConfig, Config, FieldConfig, Preset, Trainer};
use raygrad_scenes::embedded;
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Rays per step: few enough that the lists of rays, drawn anew for each step, stay below [`SIZE`].
const BATCH: usize = 128;

/// Bytes of a tile's smallest tensor, one number per coarse sample: 8 rays of 64 samples.
const SIZE: usize = 8 * 64 * 4;

/// The number of allocations of at least [`SIZE`] bytes.
static LARGE: AtomicUsize = AtomicUsize::new(0);

/// The system's allocator, with a counter.
struct Counting;

fn count(layout: Layout, size: usize) {
    // Vectors of f32 have the alignment of f32. This leaves out the scratch space of the matrix product, which is
    // aligned to cache lines, and the tape's bookkeeping, which holds pointers.
    if size >= SIZE && layout.align() == align_of::<f32>() {
        LARGE.fetch_add(1, Relaxed);
    }
}

// SAFETY: every request goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout, layout.size());
        // SAFETY: the caller's promises hold for the system's allocator too.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(ptr, layout) }
    }

    unsafe fn realloc(&self, ptr: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(layout, size);
        // SAFETY: as above.
        unsafe { System.realloc(ptr, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn training_step_allocates_no_tensor() {
    let data = Arc::new(embedded(Split::Val, 32));
    let mut small = Config::preset(Preset::Small);
    let quarter = ClassicConfig { width: 64, view_width: 32, ..ClassicConfig::paper() };
    let mut classic = Config { field: FieldConfig::new(quarter.clone()), ..Config::preset(Preset::Classic) };
    for config in [&mut small, &mut classic] {
        let Some(sampler) = config.sampler.get_mut::<HierarchicalConfig>() else { panic!("not hierarchical") };
        sampler.batch = BATCH;
    }
    if let Some(sampler) = classic.sampler.get_mut::<HierarchicalConfig>() {
        sampler.proposal = quarter;
    }
    for (name, config) in [("small", small), ("classic at a quarter of its width", classic)] {
        let Some(sampler) = config.sampler.get::<HierarchicalConfig>() else { panic!("not hierarchical") };
        assert!(4 * sampler.tile * sampler.coarse >= SIZE, "{name}");
        for threads in [1, 2] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut trainer = Trainer::new(config.clone(), data.clone()).unwrap();
            let mut count = || {
                let before = LARGE.load(Relaxed);
                pool.install(|| trainer.step(0.1));
                LARGE.load(Relaxed) - before
            };
            // Which thread keeps the memory of which sum varies, so two threads take more steps to fill their pools.
            let mut counts: Vec<usize> = (0..6).map(|_| count()).collect();
            while threads > 1 && counts.len() < 30 && counts[counts.len() - 4..] != [0; 4] {
                counts.push(count());
            }
            let later = (0..4 * (threads - 1)).filter(|_| count() > 0).count();
            println!("{name}, {threads} threads: {counts:?}, then {later} of 4 later steps");
            assert!(later < threads, "{name}, {threads} threads: {later} of 4 later steps allocate");
            assert!(counts[0] > 50, "the first step fills the pools, so the counter should have seen it");
            assert_eq!(counts[counts.len() - 4..], [0; 4], "{name}, {threads} threads");
        }
    }
}
