//! Packs of doubles in x86-64 vector registers.
//!
//! Every method compiles to one or a few instructions when it is inlined into a function compiled
//! for the instruction set ([`super::dispatch`] makes sure of that).
#![allow(
    unsafe_code,
    reason = "vendor intrinsics; reached only after the instruction set was detected"
)]

use super::lane::{Coefficient, Lane};
use core::arch::x86_64::{
    __m256d, __m512d, _CMP_LT_OQ, _mm256_add_epi64, _mm256_add_pd, _mm256_and_pd, _mm256_andnot_pd,
    _mm256_blendv_pd, _mm256_castpd_si256, _mm256_castsi256_pd, _mm256_cmp_pd, _mm256_div_pd, _mm256_max_pd,
    _mm256_mul_pd, _mm256_or_pd, _mm256_set1_epi64x, _mm256_set1_pd, _mm256_slli_epi64, _mm256_sqrt_pd,
    _mm256_sub_pd, _mm256_xor_pd, _mm512_abs_pd, _mm512_add_epi64, _mm512_add_pd, _mm512_castpd_si512,
    _mm512_castsi512_pd, _mm512_cmp_pd_mask, _mm512_div_pd, _mm512_mask_blend_pd, _mm512_max_pd,
    _mm512_mul_pd, _mm512_set1_epi64, _mm512_set1_pd, _mm512_slli_epi64, _mm512_sqrt_pd, _mm512_sub_pd,
    _mm512_ternarylogic_epi64, _mm512_xor_epi64,
};
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};

/// Four runs in AVX2 registers.
#[derive(Debug, Clone, Copy)]
#[repr(transparent)]
pub(super) struct Pack4(__m256d);

/// Eight runs in AVX-512 registers.
#[derive(Debug, Clone, Copy)]
#[repr(transparent)]
pub(super) struct Pack8(__m512d);

macro_rules! operators {
    ($pack:ident, $add:ident, $sub:ident, $mul:ident, $div:ident) => {
        impl Add for $pack {
            type Output = Self;
            #[inline(always)]
            fn add(self, other: Self) -> Self {
                // SAFETY: values of this type exist only where the instruction set does.
                Self(unsafe { $add(self.0, other.0) })
            }
        }
        impl Sub for $pack {
            type Output = Self;
            #[inline(always)]
            fn sub(self, other: Self) -> Self {
                // SAFETY: as above.
                Self(unsafe { $sub(self.0, other.0) })
            }
        }
        impl Mul for $pack {
            type Output = Self;
            #[inline(always)]
            fn mul(self, other: Self) -> Self {
                // SAFETY: as above.
                Self(unsafe { $mul(self.0, other.0) })
            }
        }
        impl Div for $pack {
            type Output = Self;
            #[inline(always)]
            fn div(self, other: Self) -> Self {
                // SAFETY: as above.
                Self(unsafe { $div(self.0, other.0) })
            }
        }
        impl AddAssign for $pack {
            #[inline(always)]
            fn add_assign(&mut self, other: Self) {
                *self = *self + other;
            }
        }
        impl SubAssign for $pack {
            #[inline(always)]
            fn sub_assign(&mut self, other: Self) {
                *self = *self - other;
            }
        }
    };
}

impl Coefficient<Self> for Pack4 {
    #[inline(always)]
    fn pack(self) -> Self {
        self
    }
}

impl Coefficient<Self> for Pack8 {
    #[inline(always)]
    fn pack(self) -> Self {
        self
    }
}

operators!(Pack4, _mm256_add_pd, _mm256_sub_pd, _mm256_mul_pd, _mm256_div_pd);
operators!(Pack8, _mm512_add_pd, _mm512_sub_pd, _mm512_mul_pd, _mm512_div_pd);

/// Reads and writes single lanes through memory.
macro_rules! lanes {
    ($width:literal) => {
        const WIDTH: usize = $width;

        #[inline(always)]
        fn get(&self, lane: usize) -> f64 {
            assert!(lane < $width);
            // SAFETY: the register type is `$width` doubles without padding; the index is checked.
            unsafe { *std::ptr::from_ref(self).cast::<f64>().add(lane) }
        }
        #[inline(always)]
        fn set(&mut self, lane: usize, x: f64) {
            assert!(lane < $width);
            // SAFETY: as in `get`.
            unsafe { *std::ptr::from_mut(self).cast::<f64>().add(lane) = x };
        }
        #[inline(always)]
        fn trip(padded: usize, used: usize) -> usize {
            used.min(padded)
        }
    };
}

// SAFETY of all blocks below: values of these types exist only where the instruction set does.

impl Neg for Pack4 {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self(unsafe { _mm256_xor_pd(self.0, _mm256_set1_pd(-0.0)) })
    }
}

impl Lane for Pack4 {
    lanes!(4);

    #[inline(always)]
    fn splat(x: f64) -> Self {
        Self(unsafe { _mm256_set1_pd(x) })
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(unsafe { _mm256_sqrt_pd(self.0) })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(unsafe { _mm256_andnot_pd(_mm256_set1_pd(-0.0), self.0) })
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(unsafe { _mm256_max_pd(self.0, other.0) })
    }
    #[inline(always)]
    fn copysign(self, sign: Self) -> Self {
        unsafe {
            let mask = _mm256_set1_pd(-0.0);
            let size = _mm256_andnot_pd(mask, self.0);
            Self(_mm256_or_pd(size, _mm256_and_pd(mask, sign.0)))
        }
    }
    #[inline(always)]
    fn where_less(self, a: Self, b: Self, other: Self) -> Self {
        unsafe {
            let less = _mm256_cmp_pd::<_CMP_LT_OQ>(a.0, b.0);
            Self(_mm256_blendv_pd(other.0, self.0, less))
        }
    }
    #[inline(always)]
    fn exp2_biased(self) -> Self {
        unsafe {
            let bits = _mm256_castpd_si256(self.0);
            let biased = _mm256_add_epi64(bits, _mm256_set1_epi64x(1023));
            Self(_mm256_castsi256_pd(_mm256_slli_epi64::<52>(biased)))
        }
    }
}

impl Neg for Pack8 {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        unsafe {
            let bits = _mm512_castpd_si512(self.0);
            Self(_mm512_castsi512_pd(_mm512_xor_epi64(
                bits,
                _mm512_set1_epi64(i64::MIN),
            )))
        }
    }
}

impl Lane for Pack8 {
    lanes!(8);

    #[inline(always)]
    fn splat(x: f64) -> Self {
        Self(unsafe { _mm512_set1_pd(x) })
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(unsafe { _mm512_sqrt_pd(self.0) })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(unsafe { _mm512_abs_pd(self.0) })
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(unsafe { _mm512_max_pd(self.0, other.0) })
    }
    #[inline(always)]
    fn copysign(self, sign: Self) -> Self {
        unsafe {
            // Bit by bit: mask ? sign : self.
            let mask = _mm512_set1_epi64(i64::MIN);
            let (x, s) = (_mm512_castpd_si512(self.0), _mm512_castpd_si512(sign.0));
            Self(_mm512_castsi512_pd(_mm512_ternarylogic_epi64::<0xCA>(mask, s, x)))
        }
    }
    #[inline(always)]
    fn where_less(self, a: Self, b: Self, other: Self) -> Self {
        unsafe {
            let less = _mm512_cmp_pd_mask::<_CMP_LT_OQ>(a.0, b.0);
            Self(_mm512_mask_blend_pd(less, other.0, self.0))
        }
    }
    #[inline(always)]
    fn exp2_biased(self) -> Self {
        unsafe {
            let bits = _mm512_castpd_si512(self.0);
            let biased = _mm512_add_epi64(bits, _mm512_set1_epi64(1023));
            Self(_mm512_castsi512_pd(_mm512_slli_epi64::<52>(biased)))
        }
    }
}
