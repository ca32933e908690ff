//! Vectors of f32 and f64 for the kernels: one source, compiled for AVX-512, AVX2 + FMA and the
//! target's baseline, chosen once per process.
//!
//! The methods are instructions, nothing else. A kernel is generic over [`Simd`], is inlined into a
//! function that enables the instructions (see [`dispatch`]), and so becomes code for them.

#![allow(
    unsafe_code,
    unsafe_op_in_unsafe_fn,
    clippy::inline_always,
    clippy::needless_range_loop,
    reason = "instructions beyond the baseline are unsafe to name, and have to be inlined to be one instruction each"
)]

use std::sync::OnceLock;

/// Instruction sets with a kernel of their own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// AVX-512F.
    Avx512,
    /// AVX2 and FMA.
    Avx2,
    /// The target's baseline.
    Portable,
}

/// The kernel that this process uses.
#[must_use]
#[inline]
pub fn level() -> Level {
    // Asked for each layer of each window, where the answers of several feature tests would be felt.
    static LEVEL: OnceLock<Level> = OnceLock::new();
    *LEVEL.get_or_init(detect)
}

fn detect() -> Level {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::is_x86_feature_detected as has;
        if has!("avx512f") && has!("avx512vl") && has!("avx2") && has!("fma") {
            return Level::Avx512;
        }
        if has!("avx2") && has!("fma") {
            return Level::Avx2;
        }
    }
    Level::Portable
}

/// Calls `$body::<S>($arguments)` compiled for the instruction set `$level`, which [`level`] found.
macro_rules! dispatch {
    ($level:expr, $owner:ident :: $body:ident ( $($name:ident : $type:ty),* $(,)? )) => {{
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx512f,avx512vl,avx2,fma")]
        #[allow(unsafe_code, clippy::too_many_arguments, reason = "the features are enabled here")]
        fn avx512($($name: $type),*) {
            // SAFETY: the features that this type names are enabled in this function.
            unsafe { $owner::$body::<$crate::simd::Avx512>($($name),*) }
        }
        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma")]
        #[allow(unsafe_code, clippy::too_many_arguments, reason = "the features are enabled here")]
        fn avx2($($name: $type),*) {
            // SAFETY: the features that this type names are enabled in this function.
            unsafe { $owner::$body::<$crate::simd::Avx2>($($name),*) }
        }
        match $level {
            #[cfg(target_arch = "x86_64")]
            #[allow(unsafe_code, reason = "the features were detected")]
            // SAFETY: `level` returns this only where the features were detected.
            $crate::simd::Level::Avx512 => unsafe { avx512($($name),*) },
            #[cfg(target_arch = "x86_64")]
            #[allow(unsafe_code, reason = "the features were detected")]
            // SAFETY: `level` returns this only where the features were detected.
            $crate::simd::Level::Avx2 => unsafe { avx2($($name),*) },
            #[cfg(not(target_arch = "x86_64"))]
            #[allow(unsafe_code, reason = "the baseline")]
            // SAFETY: this type needs the target's baseline only.
            $crate::simd::Level::Avx512 | $crate::simd::Level::Avx2 => unsafe {
                $owner::$body::<$crate::simd::Portable>($($name),*)
            },
            #[allow(unsafe_code, reason = "the baseline")]
            // SAFETY: this type needs the target's baseline only.
            $crate::simd::Level::Portable => unsafe { $owner::$body::<$crate::simd::Portable>($($name),*) },
        }
    }};
}
pub(crate) use dispatch;

/// Vectors of one instruction set.
///
/// # Safety
/// Methods may be called only where the instructions that the implementing type names are there;
/// pointers have to be valid for as many values as the vector has.
pub(crate) trait Simd: Copy {
    /// [`Self::LANES`] values of f32.
    type F: Copy;
    /// Half as many values of f64.
    type D: Copy;
    /// Values of f32 in a vector.
    const LANES: usize;
    /// Outputs whose sums, two vectors each, fit into the registers.
    const OUTPUTS: usize;
    /// The same for f64.
    const OUTPUTS_F64: usize;
    /// Rows whose sums, [`Self::VECTORS`] vectors each, fit into the registers.
    const ROWS: usize;
    /// Vectors of such a row.
    const VECTORS: usize;

    unsafe fn splat(value: f32) -> Self::F;
    unsafe fn load(from: *const f32) -> Self::F;
    /// The first `count` values of a vector, and zeros; reads no others.
    unsafe fn load_first(from: *const f32, count: usize) -> Self::F;
    unsafe fn store(to: *mut f32, value: Self::F);
    /// All values added: the halves of the vector, the halves of what that gives, and so on.
    unsafe fn sum(value: Self::F) -> f32;
    unsafe fn add(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn mul(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn div(a: Self::F, b: Self::F) -> Self::F;
    /// `a b + c`, fused where the instruction exists: the library's fused form is slow elsewhere.
    unsafe fn fma(a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// The larger one; `b` if either is not a number.
    unsafe fn max(a: Self::F, b: Self::F) -> Self::F;
    /// The smaller one; `b` if either is not a number.
    unsafe fn min(a: Self::F, b: Self::F) -> Self::F;
    /// 2ᵏ for `1.5·2²³ + k`, whose low bits are k, −126 ≤ k ≤ 127.
    unsafe fn pow2(shifted: Self::F) -> Self::F;

    unsafe fn splat_f64(value: f64) -> Self::D;
    unsafe fn load_f64(from: *const f64) -> Self::D;
    /// Loads half a vector of f32 and widens it.
    unsafe fn widen(from: *const f32) -> Self::D;
    /// The first `count` values of [`Self::widen`], and zeros; reads no others.
    unsafe fn widen_first(from: *const f32, count: usize) -> Self::D;
    /// As [`Self::sum`].
    unsafe fn sum_f64(value: Self::D) -> f64;
    unsafe fn store_f64(to: *mut f64, value: Self::D);
    unsafe fn add_f64(a: Self::D, b: Self::D) -> Self::D;
    unsafe fn fma_f64(a: Self::D, b: Self::D, c: Self::D) -> Self::D;
}

/// The target's baseline: arrays that the compiler makes vectors of.
#[derive(Clone, Copy)]
pub(crate) struct Portable;

#[inline(always)]
fn zip<T: Copy, const N: usize>(a: [T; N], b: [T; N], f: impl Fn(T, T) -> T) -> [T; N] {
    let mut out = a;
    for lane in 0..N {
        out[lane] = f(a[lane], b[lane]);
    }
    out
}

impl Simd for Portable {
    type F = [f32; 4];
    type D = [f64; 2];
    const LANES: usize = 4;
    const OUTPUTS: usize = 4;
    const OUTPUTS_F64: usize = 4;
    const ROWS: usize = 4;
    const VECTORS: usize = 2;

    #[inline(always)]
    unsafe fn splat(value: f32) -> Self::F {
        [value; 4]
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self::F {
        from.cast::<[f32; 4]>().read_unaligned()
    }
    #[inline(always)]
    unsafe fn load_first(from: *const f32, count: usize) -> Self::F {
        let mut values = [0.0; 4];
        for lane in 0..count.min(4) {
            values[lane] = from.add(lane).read();
        }
        values
    }
    #[inline(always)]
    unsafe fn store(to: *mut f32, value: Self::F) {
        to.cast::<[f32; 4]>().write_unaligned(value);
    }
    #[inline(always)]
    unsafe fn sum([a, b, c, d]: Self::F) -> f32 {
        (a + c) + (b + d)
    }
    #[inline(always)]
    unsafe fn add(a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| a + b)
    }
    #[inline(always)]
    unsafe fn mul(a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| a * b)
    }
    #[inline(always)]
    unsafe fn div(a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| a / b)
    }
    #[inline(always)]
    unsafe fn fma(a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        Self::add(Self::mul(a, b), c)
    }
    #[inline(always)]
    unsafe fn max(a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    unsafe fn min(a: Self::F, b: Self::F) -> Self::F {
        zip(a, b, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    unsafe fn pow2(shifted: Self::F) -> Self::F {
        zip(shifted, shifted, |value, _| {
            f32::from_bits((value.to_bits() << 23).wrapping_add(1.0_f32.to_bits()))
        })
    }
    #[inline(always)]
    unsafe fn splat_f64(value: f64) -> Self::D {
        [value; 2]
    }
    #[inline(always)]
    unsafe fn load_f64(from: *const f64) -> Self::D {
        from.cast::<[f64; 2]>().read_unaligned()
    }
    #[inline(always)]
    unsafe fn widen(from: *const f32) -> Self::D {
        let [a, b] = from.cast::<[f32; 2]>().read_unaligned();
        [f64::from(a), f64::from(b)]
    }
    #[inline(always)]
    unsafe fn widen_first(from: *const f32, count: usize) -> Self::D {
        let mut values = [0.0; 2];
        for lane in 0..count.min(2) {
            values[lane] = f64::from(from.add(lane).read());
        }
        values
    }
    #[inline(always)]
    unsafe fn sum_f64([a, b]: Self::D) -> f64 {
        a + b
    }
    #[inline(always)]
    unsafe fn store_f64(to: *mut f64, value: Self::D) {
        to.cast::<[f64; 2]>().write_unaligned(value);
    }
    #[inline(always)]
    unsafe fn add_f64(a: Self::D, b: Self::D) -> Self::D {
        zip(a, b, |a, b| a + b)
    }
    #[inline(always)]
    unsafe fn fma_f64(a: Self::D, b: Self::D, c: Self::D) -> Self::D {
        Self::add_f64(zip(a, b, |a, b| a * b), c)
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) use x86::{Avx2, Avx512};

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::Simd;
    #[allow(clippy::wildcard_imports, reason = "every name begins with _mm")]
    use std::arch::x86_64::*;

    /// AVX2 and FMA.
    #[derive(Clone, Copy)]
    pub(crate) struct Avx2;

    /// AVX-512F.
    #[derive(Clone, Copy)]
    pub(crate) struct Avx512;

    impl Simd for Avx2 {
        type F = __m256;
        type D = __m256d;
        const LANES: usize = 8;
        const OUTPUTS: usize = 6;
        const OUTPUTS_F64: usize = 6;
        const ROWS: usize = 6;
        const VECTORS: usize = 2;

        #[inline(always)]
        unsafe fn splat(value: f32) -> Self::F {
            _mm256_set1_ps(value)
        }
        #[inline(always)]
        unsafe fn load(from: *const f32) -> Self::F {
            _mm256_loadu_ps(from)
        }
        #[inline(always)]
        unsafe fn load_first(from: *const f32, count: usize) -> Self::F {
            let lanes = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
            #[allow(
                clippy::cast_possible_truncation,
                clippy::cast_possible_wrap,
                reason = "at most as many as there are lanes"
            )]
            let count = _mm256_set1_epi32(count as i32);
            _mm256_maskload_ps(from, _mm256_cmpgt_epi32(count, lanes))
        }
        #[inline(always)]
        unsafe fn store(to: *mut f32, value: Self::F) {
            _mm256_storeu_ps(to, value);
        }
        #[inline(always)]
        unsafe fn sum(value: Self::F) -> f32 {
            let four = _mm_add_ps(_mm256_castps256_ps128(value), _mm256_extractf128_ps::<1>(value));
            let two = _mm_add_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_add_ss(two, _mm_movehdup_ps(two)))
        }
        #[inline(always)]
        unsafe fn add(a: Self::F, b: Self::F) -> Self::F {
            _mm256_add_ps(a, b)
        }
        #[inline(always)]
        unsafe fn mul(a: Self::F, b: Self::F) -> Self::F {
            _mm256_mul_ps(a, b)
        }
        #[inline(always)]
        unsafe fn div(a: Self::F, b: Self::F) -> Self::F {
            _mm256_div_ps(a, b)
        }
        #[inline(always)]
        unsafe fn fma(a: Self::F, b: Self::F, c: Self::F) -> Self::F {
            _mm256_fmadd_ps(a, b, c)
        }
        #[inline(always)]
        unsafe fn max(a: Self::F, b: Self::F) -> Self::F {
            _mm256_max_ps(a, b)
        }
        #[inline(always)]
        unsafe fn min(a: Self::F, b: Self::F) -> Self::F {
            _mm256_min_ps(a, b)
        }
        #[inline(always)]
        unsafe fn pow2(shifted: Self::F) -> Self::F {
            let exponent = _mm256_slli_epi32::<23>(_mm256_castps_si256(shifted));
            _mm256_castsi256_ps(_mm256_add_epi32(
                exponent,
                _mm256_castps_si256(_mm256_set1_ps(1.0)),
            ))
        }
        #[inline(always)]
        unsafe fn splat_f64(value: f64) -> Self::D {
            _mm256_set1_pd(value)
        }
        #[inline(always)]
        unsafe fn load_f64(from: *const f64) -> Self::D {
            _mm256_loadu_pd(from)
        }
        #[inline(always)]
        unsafe fn widen(from: *const f32) -> Self::D {
            _mm256_cvtps_pd(_mm_loadu_ps(from))
        }
        #[inline(always)]
        unsafe fn widen_first(from: *const f32, count: usize) -> Self::D {
            #[allow(
                clippy::cast_possible_truncation,
                clippy::cast_possible_wrap,
                reason = "at most as many as there are lanes"
            )]
            let count = _mm_set1_epi32(count as i32);
            let mask = _mm_cmpgt_epi32(count, _mm_setr_epi32(0, 1, 2, 3));
            _mm256_cvtps_pd(_mm_maskload_ps(from, mask))
        }
        #[inline(always)]
        unsafe fn sum_f64(value: Self::D) -> f64 {
            let two = _mm_add_pd(_mm256_castpd256_pd128(value), _mm256_extractf128_pd::<1>(value));
            _mm_cvtsd_f64(_mm_add_sd(two, _mm_unpackhi_pd(two, two)))
        }
        #[inline(always)]
        unsafe fn store_f64(to: *mut f64, value: Self::D) {
            _mm256_storeu_pd(to, value);
        }
        #[inline(always)]
        unsafe fn add_f64(a: Self::D, b: Self::D) -> Self::D {
            _mm256_add_pd(a, b)
        }
        #[inline(always)]
        unsafe fn fma_f64(a: Self::D, b: Self::D, c: Self::D) -> Self::D {
            _mm256_fmadd_pd(a, b, c)
        }
    }

    impl Simd for Avx512 {
        type F = __m512;
        type D = __m512d;
        const LANES: usize = 16;
        const OUTPUTS: usize = 12;
        const OUTPUTS_F64: usize = 12;
        const ROWS: usize = 6;
        const VECTORS: usize = 4;

        #[inline(always)]
        unsafe fn splat(value: f32) -> Self::F {
            _mm512_set1_ps(value)
        }
        #[inline(always)]
        unsafe fn load(from: *const f32) -> Self::F {
            _mm512_loadu_ps(from)
        }
        #[inline(always)]
        unsafe fn load_first(from: *const f32, count: usize) -> Self::F {
            #[allow(clippy::cast_possible_truncation, reason = "a bit for each lane")]
            let mask = ((1_u32 << count) - 1) as __mmask16;
            _mm512_maskz_loadu_ps(mask, from)
        }
        #[inline(always)]
        unsafe fn store(to: *mut f32, value: Self::F) {
            _mm512_storeu_ps(to, value);
        }
        #[inline(always)]
        unsafe fn sum(value: Self::F) -> f32 {
            let upper = _mm256_castpd_ps(_mm512_extractf64x4_pd::<1>(_mm512_castps_pd(value)));
            Avx2::sum(_mm256_add_ps(_mm512_castps512_ps256(value), upper))
        }
        #[inline(always)]
        unsafe fn add(a: Self::F, b: Self::F) -> Self::F {
            _mm512_add_ps(a, b)
        }
        #[inline(always)]
        unsafe fn mul(a: Self::F, b: Self::F) -> Self::F {
            _mm512_mul_ps(a, b)
        }
        #[inline(always)]
        unsafe fn div(a: Self::F, b: Self::F) -> Self::F {
            _mm512_div_ps(a, b)
        }
        #[inline(always)]
        unsafe fn fma(a: Self::F, b: Self::F, c: Self::F) -> Self::F {
            _mm512_fmadd_ps(a, b, c)
        }
        #[inline(always)]
        unsafe fn max(a: Self::F, b: Self::F) -> Self::F {
            _mm512_max_ps(a, b)
        }
        #[inline(always)]
        unsafe fn min(a: Self::F, b: Self::F) -> Self::F {
            _mm512_min_ps(a, b)
        }
        #[inline(always)]
        unsafe fn pow2(shifted: Self::F) -> Self::F {
            let exponent = _mm512_slli_epi32::<23>(_mm512_castps_si512(shifted));
            _mm512_castsi512_ps(_mm512_add_epi32(
                exponent,
                _mm512_castps_si512(_mm512_set1_ps(1.0)),
            ))
        }
        #[inline(always)]
        unsafe fn splat_f64(value: f64) -> Self::D {
            _mm512_set1_pd(value)
        }
        #[inline(always)]
        unsafe fn load_f64(from: *const f64) -> Self::D {
            _mm512_loadu_pd(from)
        }
        #[inline(always)]
        unsafe fn widen(from: *const f32) -> Self::D {
            _mm512_cvtps_pd(_mm256_loadu_ps(from))
        }
        #[inline(always)]
        unsafe fn widen_first(from: *const f32, count: usize) -> Self::D {
            #[allow(clippy::cast_possible_truncation, reason = "a bit for each lane")]
            let mask = ((1_u32 << count) - 1) as __mmask8;
            _mm512_cvtps_pd(_mm256_maskz_loadu_ps(mask, from))
        }
        #[inline(always)]
        unsafe fn sum_f64(value: Self::D) -> f64 {
            let upper = _mm512_extractf64x4_pd::<1>(value);
            Avx2::sum_f64(_mm256_add_pd(_mm512_castpd512_pd256(value), upper))
        }
        #[inline(always)]
        unsafe fn store_f64(to: *mut f64, value: Self::D) {
            _mm512_storeu_pd(to, value);
        }
        #[inline(always)]
        unsafe fn add_f64(a: Self::D, b: Self::D) -> Self::D {
            _mm512_add_pd(a, b)
        }
        #[inline(always)]
        unsafe fn fma_f64(a: Self::D, b: Self::D, c: Self::D) -> Self::D {
            _mm512_fmadd_pd(a, b, c)
        }
    }
}
