//! Every kernel against plain loops in f64, at sizes around those at which it is cut into lanes, blocks, strips, pieces
//! and threads; in f32 and f64, at every instruction set that the machine has, with one thread and with more.
//!
//! Numbers are such that f64 sums and products of them are exact in any order (see [`support::values`]): f64 results
//! that only add and multiply must be right to the bit, and f32 results within the error that their documentation
//! states. A lost element or a wrong border is far beyond either.

#[cfg(feature = "gemm")]
mod elementwise;
#[cfg(feature = "gemm")]
mod extremum;
#[cfg(feature = "gemm")]
mod indices;
#[cfg(feature = "gemm")]
mod layout;
mod matmul;
#[cfg(feature = "gemm")]
mod reduce;
#[cfg(feature = "gemm")]
mod rows;
mod support;
mod windows;

use std::process::Command;

/// The instruction set and the number of threads are chosen once a process: so this suite is run again in others, with
/// the plain fallback, with AVX2 and with AVX-512 (as far as the machine has them), on one, three and eight threads, and
/// from within a pool of three threads.
#[test]
fn naive_agrees_on_all_simd_levels_and_threads() {
    // In a child, which runs the others.
    if std::env::var_os(support::INSTALLED).is_some() {
        return;
    }
    let least = if cfg!(feature = "gemm") { 16 } else { 2 };
    let runs = [("scalar", "1", ""), ("v3", "3", ""), ("v4", "8", ""), ("v3", "2", "3")];
    let children = runs.map(|(level, threads, installed)| {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["naive::", "--test-threads", "1"]);
        command.env("RAYGRAD_SIMD", level).env("RAYON_NUM_THREADS", threads).env(support::INSTALLED, installed);
        ((level, threads, installed), command.output().unwrap())
    });
    for (run, output) in children {
        let text = String::from_utf8_lossy(&output.stdout);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{run:?}:\n{text}\n{errors}");
        let passed = text.lines().find_map(|line| line.strip_prefix("test result: ok. ")?.split(' ').next());
        assert!(passed.and_then(|count| count.parse().ok()).unwrap_or(0) >= least, "{run:?} tested nothing:\n{text}");
    }
}
