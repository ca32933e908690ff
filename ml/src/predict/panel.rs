//! Windows side by side: from rows of values to [`PANEL`] columns of windows.

#![allow(
    unsafe_code,
    unsafe_op_in_unsafe_fn,
    reason = "shuffles are instructions beyond the baseline; lengths are compared before the loops"
)]

use super::kernel::PANEL;
use crate::simd::{Level, level};

/// Rows and values that are turned at once.
const BLOCK: usize = 8;

/// `out[value · PANEL + row] = x[row · stride + value]` for `rows` rows of `values` values. Columns
/// up to the next multiple of 16 are 0.
///
/// # Panics
/// When a slice is too short or there are more rows than [`PANEL`].
pub fn transpose(x: &[f32], stride: usize, rows: usize, values: usize, out: &mut [f32]) {
    transpose_at(level(), x, stride, rows, values, out);
}

fn transpose_at(level: Level, x: &[f32], stride: usize, rows: usize, values: usize, out: &mut [f32]) {
    assert!(rows <= PANEL, "a panel has {PANEL} columns");
    assert!(out.len() >= values * PANEL, "room for a panel");
    if rows == 0 {
        return;
    }
    assert!(x.len() >= (rows - 1) * stride + values, "values of {rows} rows");
    let (mut whole_rows, mut whole_values) = (0, 0);
    if level != Level::Portable {
        whole_rows = rows - rows % BLOCK;
        whole_values = values - values % BLOCK;
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the level was detected; the last value of the last whole row is inside `x`, and
        // its column inside `out`.
        unsafe {
            blocks(x.as_ptr(), stride, whole_rows, whole_values, out.as_mut_ptr());
        }
    }
    for row in 0..rows {
        let first = if row < whole_rows { whole_values } else { 0 };
        for value in first..values {
            out[value * PANEL + row] = x[row * stride + value];
        }
    }
    let filled = rows.next_multiple_of(PANEL / 2);
    for columns in out[..values * PANEL].chunks_exact_mut(PANEL) {
        columns[rows..filled].fill(0.0);
    }
}

/// Multiples of eight rows and of eight values. Values outside, rows inside: lines of `out` are
/// written once and whole.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn blocks(x: *const f32, stride: usize, rows: usize, values: usize, out: *mut f32) {
    use std::arch::x86_64::{
        __m256, _MM_HINT_T1, _mm_prefetch, _mm256_loadu_ps, _mm256_permute2f128_ps, _mm256_shuffle_ps,
        _mm256_storeu_ps, _mm256_unpackhi_ps, _mm256_unpacklo_ps,
    };
    for value in (0..values).step_by(BLOCK) {
        for first in (0..rows).step_by(BLOCK) {
            // The next panel follows in memory where windows do: many short streams, which the
            // processor does not foresee.
            let ahead = x.wrapping_add(rows * stride + value * rows + first * BLOCK);
            for line in 0..4 {
                _mm_prefetch::<_MM_HINT_T1>(ahead.wrapping_add(16 * line).cast::<i8>());
            }
            let row = |r: usize| _mm256_loadu_ps(x.add((first + r) * stride + value));
            // Pairs of rows, then fours, then halves: after each step a register holds twice as many
            // rows of half as many values.
            let pairs = |r: usize| -> [__m256; 4] {
                let (a, b) = (row(r), row(r + 1));
                let (c, d) = (row(r + 2), row(r + 3));
                let (low, high) = (_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
                let (low2, high2) = (_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d));
                [
                    _mm256_shuffle_ps::<0b01_00_01_00>(low, low2),
                    _mm256_shuffle_ps::<0b11_10_11_10>(low, low2),
                    _mm256_shuffle_ps::<0b01_00_01_00>(high, high2),
                    _mm256_shuffle_ps::<0b11_10_11_10>(high, high2),
                ]
            };
            let (upper, lower) = (pairs(0), pairs(4));
            for (i, (&a, &b)) in upper.iter().zip(&lower).enumerate() {
                let to = out.add((value + i) * PANEL + first);
                _mm256_storeu_ps(to, _mm256_permute2f128_ps::<0x20>(a, b));
                _mm256_storeu_ps(to.add(4 * PANEL), _mm256_permute2f128_ps::<0x31>(a, b));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_comes_to_its_column() {
        for (rows, values, stride) in [(1, 1, 1), (32, 300, 300), (17, 19, 5), (9, 8, 11)] {
            let x: Vec<f32> = (0..(rows - 1) * stride + values).map(|i| i as f32).collect();
            for level in [level(), Level::Portable] {
                let mut out = vec![f32::NAN; values * PANEL];
                transpose_at(level, &x, stride, rows, values, &mut out);
                for (value, columns) in out.chunks(PANEL).enumerate() {
                    for (row, found) in columns.iter().take(rows.next_multiple_of(16)).enumerate() {
                        let wanted = if row < rows { x[row * stride + value] } else { 0.0 };
                        assert_eq!(found.to_bits(), wanted.to_bits(), "row {row}, value {value}");
                    }
                }
            }
        }
    }
}
