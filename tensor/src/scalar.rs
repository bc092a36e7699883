//! The number types of tensors.

use crate::{Real, vmath};
use std::fmt::{Debug, Display};
use std::iter::Sum;
use std::ops::{AddAssign, BitOr, MulAssign, SubAssign};

mod sealed {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// The number type of a tensor: `f32` or `f64`.
pub trait Scalar:
    sealed::Sealed
    + Copy
    + Debug
    + Default
    + Display
    + PartialEq
    + PartialOrd
    + Send
    + Sync
    + Sum
    + Real
    + AddAssign
    + SubAssign
    + MulAssign
    + 'static
{
    /// `"f32"` or `"f64"`.
    const NAME: &'static str;
    /// 0.
    const ZERO: Self;
    /// 1.
    const ONE: Self;
    /// The distance from 1 to the next larger number.
    const EPSILON: f64;

    /// The nearest number to `x`.
    fn from_f64(x: f64) -> Self;
    /// The same number, exactly.
    fn to_f64(self) -> f64;
    /// Whether the number is neither infinite nor NaN.
    fn is_finite(self) -> bool;
    /// Appends numbers as little-endian bytes, as in safetensors files.
    fn write_le(values: &[Self], out: &mut Vec<u8>);
    /// Reads numbers from little-endian bytes: the inverse of [`write_le`](Self::write_le). Bytes beyond the last whole
    /// number are left out.
    fn read_le(bytes: &[u8]) -> Vec<Self>;

    /// Flags of as many bits as the number, so that they share a vector's lanes. The highest bit is the flag.
    #[doc(hidden)]
    type Flags: Copy + Debug + Default + BitOr<Output = Self::Flags>;
    /// Flagged if `sin_quick` and `cos_quick` are not valid for this number. NaN is flagged, infinities are too.
    #[doc(hidden)]
    fn outside(self) -> Self::Flags;
    /// Flagged if the exponent is not in the middle half of its range. Zero and infinity are not flagged.
    #[doc(hidden)]
    fn is_extreme(self) -> Self::Flags;
    /// Flagged if infinite or NaN; or below the normal numbers, and `other` is above 1.
    #[doc(hidden)]
    fn is_lost(self, other: Self) -> Self::Flags;
    /// Whether the flag is set.
    #[doc(hidden)]
    fn is_set(flags: Self::Flags) -> bool;
    /// The sine, unless [`outside`](Self::outside).
    #[doc(hidden)]
    fn sin_quick(self) -> Self;
    /// The cosine, unless [`outside`](Self::outside).
    #[doc(hidden)]
    fn cos_quick(self) -> Self;

    /// `c = a b`, or `c += a b` with `accumulate`. [`crate::matmul::gemm`] is the one caller, and checks the sizes.
    ///
    /// # Safety
    /// `a` (`m x k`), `b` (`k x n`) and `c` (`m x n`) must be valid for every index of these dimensions and
    /// `[row, column]` strides. The strides of `c` are `[c_row, 1]`, and `c` must not overlap the others.
    #[doc(hidden)]
    // SAFETY: kept by `gemm`, which checks all sizes.
    unsafe fn gemm_raw(
        mkn: [usize; 3],
        a: (*const Self, [isize; 2]),
        b: (*const Self, [isize; 2]),
        c: *mut Self,
        c_row: usize,
        accumulate: bool,
    );
}

macro_rules! scalar {
    ($t:ident, $bits:ident, $least:expr, $gemm:ident, $matrixmultiply:path) => {
        impl Scalar for $t {
            const NAME: &'static str = stringify!($t);
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
            const EPSILON: f64 = $t::EPSILON as f64;

            #[inline(always)]
            fn from_f64(x: f64) -> Self {
                x as $t
            }
            #[inline(always)]
            fn to_f64(self) -> f64 {
                self as f64
            }
            #[inline(always)]
            fn is_finite(self) -> bool {
                $t::is_finite(self)
            }
            fn write_le(values: &[Self], out: &mut Vec<u8>) {
                let start = out.len();
                out.resize(start + size_of_val(values), 0);
                for (bytes, x) in out[start..].as_chunks_mut().0.iter_mut().zip(values) {
                    *bytes = x.to_le_bytes();
                }
            }
            fn read_le(bytes: &[u8]) -> Vec<Self> {
                bytes.as_chunks().0.iter().map(|bytes| $t::from_le_bytes(*bytes)).collect()
            }

            type Flags = $bits;
            #[inline(always)]
            fn outside(self) -> $bits {
                // Below zero, and so with its highest bit set, where |x| is greater.
                vmath::$t::QUICK.to_bits().wrapping_sub(self.abs().to_bits())
            }
            #[inline(always)]
            fn is_extreme(self) -> $bits {
                // A difference has its highest bit set where it is below zero.
                let (least, bits) = ($least.to_bits(), self.abs().to_bits());
                let greatest = $t::to_bits(1.0 / $least);
                let is_small = bits.wrapping_sub(least) & bits.wrapping_neg();
                is_small | greatest.wrapping_sub(bits) & bits.wrapping_sub($t::INFINITY.to_bits())
            }
            #[inline(always)]
            fn is_lost(self, other: Self) -> $bits {
                let (bits, other) = (self.abs().to_bits(), other.abs().to_bits());
                let is_small = bits.wrapping_sub($t::MIN_POSITIVE.to_bits()) & $t::to_bits(1.0).wrapping_sub(other);
                is_small | $t::MAX.to_bits().wrapping_sub(bits)
            }
            #[inline(always)]
            fn is_set(flags: $bits) -> bool {
                flags > $bits::MAX / 2
            }
            #[inline(always)]
            fn sin_quick(self) -> Self {
                vmath::$t::sin_quick(self)
            }
            #[inline(always)]
            fn cos_quick(self) -> Self {
                vmath::$t::cos_quick(self)
            }

            // SAFETY: the trait says what callers promise.
            unsafe fn gemm_raw(
                [m, k, n]: [usize; 3],
                (a, [a_row, a_col]): (*const Self, [isize; 2]),
                (b, [b_row, b_col]): (*const Self, [isize; 2]),
                c: *mut Self,
                c_row: usize,
                accumulate: bool,
            ) {
                let c_row = c_row as isize;
                #[cfg(feature = "gemm")]
                {
                    // The kernels want columns in order, so this is c^T = b^T a^T; strides are (column, row).
                    let product = $gemm::gemm::$t::get_gemm_fn();
                    let (one, serial) = (1.0, gemm_common::Parallelism::None);
                    // SAFETY: the caller's promise.
                    unsafe {
                        product(
                            n, m, k, c, c_row, 1, accumulate, b, b_row, b_col, a, a_row, a_col, one, one, false, false,
                            false, serial,
                        );
                    }
                }
                #[cfg(not(feature = "gemm"))]
                {
                    let beta = if accumulate { 1.0 } else { 0.0 };
                    // SAFETY: the caller's promise.
                    unsafe { $matrixmultiply(m, k, n, 1.0, a, a_row, a_col, b, b_row, b_col, beta, c, c_row, 1) }
                }
            }
        }
    };
}

// The roots of the smallest normal numbers.
scalar!(f32, u32, 1.084_202_2e-19_f32, gemm_f32, matrixmultiply::sgemm);
scalar!(f64, u64, 1.491_668_146_240_041_3e-154_f64, gemm_f64, matrixmultiply::dgemm);
