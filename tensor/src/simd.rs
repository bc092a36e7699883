//! Selects the instruction set at run time, so that one binary uses each machine's best.
//!
//! [`dispatch`] calls a closure inside a function that is compiled for AVX-512, for AVX2 + FMA, or for the target's
//! baseline. LLVM vectorises the plain loops inside. Other places that name instructions are the streaming
//! store of large transposes and the walk over their tiles.
//!
//! `RAYGRAD_SIMD` caps the choice, for tests and measurements. `scalar` selects the plain fallback, `v3` at most AVX2 +
//! FMA, and `v4` (the default) the best available. It is read once, at the first call.

use std::env::VarError;
use std::sync::OnceLock;

use pulp::Arch;

/// Calls `f` with the best instruction set of this machine and returns its result.
///
/// Only code that is *inlined* into `f` is compiled for that instruction set. A call leads back to baseline code. There
/// a fused multiply-add is itself a call, and a loop over `vmath` takes a hundred times as long. So:
/// - mark `#[inline(always)]` the closure, and every closure and function that is called for each element;
/// - write the loop as `for`, not as `for_each`, `map` or `fold`. Those are functions of the standard library; a large
///   body that was inlined into them is too large to be inlined further;
/// - cut slices to their common length inside the closure. The compiler does not know lengths from outside, and a
///   bounds check for each element prevents vectorisation.
///
/// A call takes two to three nanoseconds longer than a direct loop, so pass a whole slice rather than an element.
///
/// ```
/// use raygrad_tensor::{simd, vmath};
///
/// let x = [0.0_f32, 1.0, 2.0];
/// let mut y = [0.0; 3];
/// simd::dispatch(
///     #[inline(always)]
///     || {
///         for (y, &x) in y.iter_mut().zip(&x) {
///             *y = vmath::f32::exp(x);
///         }
///     },
/// );
/// assert_eq!(y, [1.0, 2.7182817, 7.389056]);
/// ```
///
/// # Panics
/// At the first call, if `RAYGRAD_SIMD` has a value other than `scalar`, `v3` or `v4`.
#[inline(always)]
pub fn dispatch<R>(f: impl FnOnce() -> R) -> R {
    arch().dispatch(f)
}

/// The name of the instruction set that [`dispatch`] uses here: `scalar`, `v3` (AVX2 + FMA), `v4` (AVX-512) or `neon`.
pub fn name() -> &'static str {
    match arch() {
        Arch::Scalar => "scalar",
        #[cfg(target_arch = "x86_64")]
        Arch::V3(_) => "v3",
        #[cfg(target_arch = "x86_64")]
        Arch::V4(_) => "v4",
        #[cfg(target_arch = "aarch64")]
        _ => "neon",
        #[cfg(not(target_arch = "aarch64"))]
        #[allow(unreachable_patterns)] // `Arch` is non-exhaustive on some targets only.
        _ => "other",
    }
}

/// Prefetches the cache line at `address`, which may be any address, to the second-level cache.
#[inline(always)]
pub fn prefetch<T>(address: *const T) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
        // SAFETY: a prefetch is a hint: it reads nothing that the program sees and faults at no address. The instruction
        // belongs to SSE, which every x86-64 has. `prefetching_any_address_is_harmless` runs it.
        unsafe { _mm_prefetch::<_MM_HINT_T1>(address.cast()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = address;
}

fn arch() -> Arch {
    static ARCH: OnceLock<Arch> = OnceLock::new();
    *ARCH.get_or_init(|| from_environment().unwrap_or_else(|message| panic!("{message}")))
}

/// Checks `RAYGRAD_SIMD`, for a program that reports a bad value itself instead of the panic of [`dispatch`].
///
/// # Errors
/// If it has an unknown value.
pub fn check_environment() -> Result<(), String> {
    from_environment().map(drop)
}

fn from_environment() -> Result<Arch, String> {
    match std::env::var("RAYGRAD_SIMD") {
        Err(VarError::NotPresent) => Ok(Arch::new()),
        Err(VarError::NotUnicode(cap)) => Err(format!("RAYGRAD_SIMD is {cap:?}: set it to scalar, v3 or v4")),
        Ok(cap) => capped(&cap).ok_or_else(|| format!("RAYGRAD_SIMD is {cap:?}: set it to scalar, v3 or v4")),
    }
}

/// The best instruction set up to `cap`; `None` if there is no cap of that name.
fn capped(cap: &str) -> Option<Arch> {
    match cap {
        "scalar" => Some(Arch::Scalar),
        #[cfg(target_arch = "x86_64")]
        "v3" => Some(pulp::x86::V3::try_new().map_or(Arch::Scalar, Arch::V3)),
        #[cfg(not(target_arch = "x86_64"))]
        "v3" => Some(Arch::new()),
        "v4" => Some(Arch::new()),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prefetching_any_address_is_harmless() {
        for address in [0, 1, 4096, usize::MAX] {
            prefetch(std::ptr::without_provenance::<u64>(address));
        }
    }

    #[test]
    fn the_cap_is_obeyed() {
        assert!(matches!(capped("scalar"), Some(Arch::Scalar)));
        #[cfg(target_arch = "x86_64")]
        assert!(!matches!(capped("v3"), Some(Arch::V4(_))));
        assert!(capped("v4").is_some());
        assert!(capped("avx").is_none());
    }

    #[test]
    fn a_result_and_borrows_pass_through() {
        let x = [1.0_f32, 2.0, 3.0];
        let mut y = [0.0; 3];
        let sum: f32 = dispatch(|| {
            y.iter_mut().zip(&x).for_each(|(y, x)| *y = 2.0 * x);
            y.iter().sum()
        });
        assert_eq!((y, sum), ([2.0, 4.0, 6.0], 12.0));
    }
}
