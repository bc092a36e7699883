//! A sparse table update allocates no memory after the first step.
//!
//! The test has its own binary, since it counts all allocations of the process.

use raygrad_autograd::{Gradient, Tensor};
use raygrad_nerf::encoding::hash_grid::{HashGrad, HashGrid, HashGridConfig};
use raygrad_nn::{Adam, AdamConfig, Optimizer, Params};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// The number of requested bytes.
static BYTES: AtomicUsize = AtomicUsize::new(0);

/// The system's allocator, with a counter.
struct Counting;

// SAFETY: every request goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        BYTES.fetch_add(layout.size(), Relaxed);
        // SAFETY: the caller's promises hold for the system's allocator too.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(ptr, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn lazy_table_step_allocates_nothing() {
    let config = HashGridConfig { levels: 6, features: 4, log2_table: 12, coarsest: 4, finest: 100 };
    let grid = HashGrid::new(&config).unwrap();
    let (mut adam, mut params) = (Adam::new(AdamConfig::default()), Params::new());
    params.add("table", grid.init::<f32>(1));
    params.set_lazy(|_| true, true);
    let tile = Arc::new(HashGrad {
        grid: grid.clone(),
        positions: Tensor::from_fn(&[300, 3], |i| (i as f32 * 0.618).fract()),
        d_out: Tensor::from_fn(&[300, grid.width()], |i| (i as f32 * 0.377).fract() - 0.5),
        cuts: vec![0.0; grid.levels().len()],
    });
    let mut gradient = Gradient::zero(grid.shape());
    gradient.add_sparse(tile.clone());
    gradient.add_sparse(tile);
    let mut step = || adam.update(&mut params, std::slice::from_ref(&gradient), 1e-2).check().unwrap();
    step();
    let before = BYTES.load(Relaxed);
    for _ in 0..50 {
        step();
    }
    // rayon's hand-over to its workers and the table's reference count allocate little: far less than the smallest
    // buffer of a tile, 300 samples of one level.
    let taken = BYTES.load(Relaxed) - before;
    assert!(taken <= 50 * 1024, "{taken} bytes in 50 steps");
}
