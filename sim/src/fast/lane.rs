//! Numbers that travel in lock-step: one run per lane, the same source for one lane and for many.
//!
//! No operation mixes lanes and none is contracted into a fused multiply-add, so every lane of every
//! width computes bit for bit what a single run computes.

use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub, SubAssign};

/// Adding and subtracting this rounds a double of magnitude below 2⁵¹ to the nearest integer.
pub(super) const ROUND_TO_INTEGER: f64 = 6_755_399_441_055_744.0; // 1.5 · 2⁵²

/// A pack of `WIDTH` doubles.
pub(super) trait Lane:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
{
    /// Runs side by side.
    const WIDTH: usize;

    /// The same number in every lane.
    fn splat(x: f64) -> Self;
    /// One lane's number.
    fn get(&self, lane: usize) -> f64;
    /// Replaces one lane's number.
    fn set(&mut self, lane: usize, x: f64);
    /// Square root, correctly rounded.
    fn sqrt(self) -> Self;
    /// Magnitude.
    fn abs(self) -> Self;
    /// `self > other ? self : other`, so a NaN in `self` yields `other`.
    fn max(self, other: Self) -> Self;
    /// Magnitude of `self` with the sign of `sign`.
    fn copysign(self, sign: Self) -> Self;
    /// `a < b ? self : other`.
    fn where_less(self, a: Self, b: Self, other: Self) -> Self;
    /// 2ⁿ of an integer n in [−1022, 1023] given as n + [`ROUND_TO_INTEGER`].
    fn exp2_biased(self) -> Self;
    /// How many of `padded` entries a loop visits: a single run takes all of them, the padding being
    /// zero, so that the compiler sees a constant; a wide pack skips the padding.
    fn trip(padded: usize, used: usize) -> usize;
}

/// A constant of the step loop: a number for all lanes, or a pack with one for each.
pub(super) trait Coefficient<L>: Copy {
    /// In every lane what is meant for it.
    fn pack(self) -> L;
}

impl<L: Lane> Coefficient<L> for f64 {
    #[inline(always)]
    fn pack(self) -> L {
        L::splat(self)
    }
}

impl Lane for f64 {
    const WIDTH: usize = 1;

    #[inline(always)]
    fn splat(x: f64) -> Self {
        x
    }
    #[inline(always)]
    fn get(&self, _lane: usize) -> f64 {
        *self
    }
    #[inline(always)]
    fn set(&mut self, _lane: usize, x: f64) {
        *self = x;
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        f64::sqrt(self)
    }
    #[inline(always)]
    fn abs(self) -> Self {
        f64::abs(self)
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        if self > other { self } else { other }
    }
    #[inline(always)]
    fn copysign(self, sign: Self) -> Self {
        f64::copysign(self, sign)
    }
    #[inline(always)]
    fn where_less(self, a: Self, b: Self, other: Self) -> Self {
        if a < b { self } else { other }
    }
    #[inline(always)]
    fn exp2_biased(self) -> Self {
        f64::from_bits(self.to_bits().wrapping_add(1023) << 52)
    }
    #[inline(always)]
    fn trip(padded: usize, _used: usize) -> usize {
        padded
    }
}
