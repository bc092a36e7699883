//! A step that moves rows of a table takes no memory: its buffers are made at the first.
//!
//! The test has a binary of its own, because it counts what the whole process allocates.

use raygrad_autograd::{Gradient, Tensor};
use raygrad_nerf::encoding::hash_grid::{HashGrad, HashGrid, HashGridConfig};
use raygrad_nn::{Adam, AdamConfig, Optimizer, Params};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// How many bytes were asked for.
static BYTES: AtomicUsize = AtomicUsize::new(0);

/// The system's allocator, counting.
struct Counting;

// SAFETY: every request goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        BYTES.fetch_add(layout.size(), Relaxed);
        // SAFETY: the caller's promises are passed on.
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
fn a_step_of_a_lazy_table_takes_no_memory() {
    let config = HashGridConfig { levels: 6, features: 4, log2_table: 12, coarsest: 4, finest: 100 };
    let grid = HashGrid::new(&config).unwrap();
    let (mut adam, mut params) = (Adam::new(AdamConfig::default()), Params::new());
    params.add("table", grid.init::<f32>(1));
    params.set_lazy(|_| true, true);
    let tile = Arc::new(HashGrad {
        grid: grid.clone(),
        positions: Tensor::from_fn(&[300, 3], |i| (i as f32 * 0.618).fract()),
        d_out: Tensor::from_fn(&[300, grid.width()], |i| (i as f32 * 0.377).fract() - 0.5),
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
    // What rayon needs to hand a step over to its workers, and the table's reference count, are all there is: far less
    // than the smallest buffer of a tile, 300 samples of one level.
    let taken = BYTES.load(Relaxed) - before;
    assert!(taken <= 50 * 1024, "{taken} bytes in 50 steps");
}
