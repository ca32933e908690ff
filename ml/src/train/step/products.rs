//! The two matrix products of a training step, over rows of vectors.
//!
//! Both keep a tile of sums in registers and multiply one value, spread over a vector, with vectors of a row of the
//! right factor. The left factor's rows may begin anywhere, so windows are read where they stand in their series. Each
//! sum adds its products in order, fused: its bits depend neither on the tile it fell into nor on its neighbours.

#![allow(
    unsafe_code,
    unsafe_op_in_unsafe_fn,
    clippy::inline_always,
    clippy::needless_range_loop,
    clippy::too_many_arguments,
    reason = "vector code has to be inlined into the function that enables the instructions, and a bound check per \
              load would double its cost: lengths are compared before the loops"
)]

use crate::simd::{Level, Simd, dispatch};

/// Values to which rows are filled up: one AVX-512 register.
pub(super) const LANES: usize = 16;

/// A cache line of its own.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(64))]
struct Line([f32; LANES]);

/// Rows of f32 that begin on cache lines and are filled up with zeros to whole ones.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Rows {
    lines: Vec<Line>,
    width: usize,
}

impl Rows {
    /// `rows` rows of `columns` values and what fills them up, all 0.
    pub(super) fn new(rows: usize, columns: usize) -> Self {
        let width = columns.next_multiple_of(LANES);
        Self {
            lines: vec![Line([0.0; LANES]); rows * width / LANES],
            width,
        }
    }

    /// The rows of `values`, a row-major matrix.
    pub(super) fn of(values: &[f32], columns: usize) -> Self {
        let mut rows = Self::new(values.len() / columns.max(1), columns);
        let width = rows.width;
        for (row, values) in rows.values_mut().chunks_mut(width).zip(values.chunks(columns)) {
            row[..columns].copy_from_slice(values);
        }
        rows
    }

    /// Values per row, those included that fill it up.
    pub(super) fn width(&self) -> usize {
        self.width
    }

    /// All of them, row by row.
    pub(super) fn values(&self) -> &[f32] {
        // SAFETY: `Line` is `repr(C)` and as large as its array, so lines one after the other are f32 one after the
        // other.
        unsafe { std::slice::from_raw_parts(self.lines.as_ptr().cast(), self.lines.len() * LANES) }
    }

    /// All of them, row by row.
    pub(super) fn values_mut(&mut self) -> &mut [f32] {
        // SAFETY: as above.
        unsafe { std::slice::from_raw_parts_mut(self.lines.as_mut_ptr().cast(), self.lines.len() * LANES) }
    }

    /// Where each row begins.
    pub(super) fn places(&self) -> Vec<usize> {
        (0..self.lines.len() * LANES).step_by(self.width).collect()
    }
}

/// `out[r] = start + Σ_k left[places[r] + k] · right[k]` for the rows r of `places` and k below `count`; rows of
/// `right`, `start` and `out` have `width` values.
///
/// # Panics
/// When a slice is too short, or `width` is not a whole number of cache lines.
pub(super) fn multiply(
    level: Level,
    left: &[f32],
    places: &[usize],
    count: usize,
    right: &[f32],
    width: usize,
    start: &[f32],
    out: &mut [f32],
) {
    let last = places.iter().max().copied().unwrap_or(0);
    assert!(places.is_empty() || left.len() >= last + count, "left factor");
    assert!(width.is_multiple_of(LANES), "rows are whole cache lines");
    assert!(right.len() >= count * width, "right factor");
    assert!(
        start.len() >= width && out.len() >= places.len() * width,
        "room for the product"
    );
    dispatch!(level, Multiply::run(left: &[f32], places: &[usize], count: usize, right: &[f32], width: usize, start: &[f32], out: &mut [f32]));
}

/// `out[k] += Σ_r left[places[r] + k] · right[r]` for k below `count` and the rows r of `places`; rows of `right` and
/// `out` have `width` values.
///
/// # Panics
/// When a slice is too short, or `width` is not a whole number of cache lines.
pub(super) fn multiply_transposed(
    level: Level,
    left: &[f32],
    places: &[usize],
    count: usize,
    right: &[f32],
    width: usize,
    out: &mut [f32],
) {
    let last = places.iter().max().copied().unwrap_or(0);
    assert!(places.is_empty() || left.len() >= last + count, "left factor");
    assert!(width.is_multiple_of(LANES), "rows are whole cache lines");
    assert!(right.len() >= places.len() * width, "right factor");
    assert!(out.len() >= count * width, "room for the product");
    dispatch!(level, MultiplyTransposed::run(left: &[f32], places: &[usize], count: usize, right: &[f32], width: usize, out: &mut [f32]));
}

/// Rows of a tile of P vectors: as many as leave registers for the right factor and one value of the left.
const fn tile_rows<S: Simd>(vectors: usize) -> usize {
    match (S::LANES, vectors) {
        (16, 4) | (8, _) => 6,
        (16, _) => 8,
        _ => 4,
    }
}

/// Cuts `$vectors` vectors into the widest tiles: `$body!(P, first vector)`.
macro_rules! across {
    ($S:ident, $vectors:expr, $body:ident) => {{
        let vectors = $vectors;
        let mut first = 0;
        if $S::LANES == 16 {
            while vectors - first >= 4 {
                $body!(4, first);
                first += 4;
            }
        }
        while vectors - first >= 2 {
            $body!(2, first);
            first += 2;
        }
        while first < vectors {
            $body!(1, first);
            first += 1;
        }
    }};
}

/// Cuts `$rows` rows into the highest tiles: `$body!(R, first row)`.
macro_rules! down {
    ($most:expr, $rows:expr, $body:ident) => {{
        let (most, rows) = ($most, $rows);
        let mut first = 0;
        while rows - first >= most {
            match most {
                8 => $body!(8, first),
                6 => $body!(6, first),
                _ => $body!(4, first),
            }
            first += most;
        }
        while rows - first >= 2 {
            $body!(2, first);
            first += 2;
        }
        if first < rows {
            $body!(1, first);
        }
    }};
}

struct Multiply;

impl Multiply {
    /// Lengths were compared by the caller.
    #[inline(always)]
    unsafe fn run<S: Simd>(
        left: &[f32],
        places: &[usize],
        count: usize,
        right: &[f32],
        width: usize,
        start: &[f32],
        out: &mut [f32],
    ) {
        let (left, right, start, out) = (left.as_ptr(), right.as_ptr(), start.as_ptr(), out.as_mut_ptr());
        macro_rules! columns {
            ($p:literal, $vector:expr) => {{
                let column = $vector * S::LANES;
                macro_rules! rows {
                    ($r:literal, $row:expr) => {
                        Self::tile::<S, $r, $p>(
                            left,
                            &places[$row..],
                            count,
                            right.add(column),
                            width,
                            start.add(column),
                            out.add($row * width + column),
                        )
                    };
                }
                down!(const { tile_rows::<S>($p) }, places.len(), rows);
            }};
        }
        across!(S, width / S::LANES, columns);
    }

    #[inline(always)]
    unsafe fn tile<S: Simd, const R: usize, const P: usize>(
        left: *const f32,
        places: &[usize],
        count: usize,
        mut right: *const f32,
        width: usize,
        start: *const f32,
        out: *mut f32,
    ) {
        let mut rows = [left; R];
        for r in 0..R {
            rows[r] = left.add(*places.get_unchecked(r));
        }
        // Windows stand anywhere: the processor does not foresee where the next ones begin.
        for &place in places.iter().skip(R).take(R) {
            for k in (0..count).step_by(LANES) {
                prefetch(left.add(place + k));
            }
        }
        let mut sums = [[S::splat(0.0); P]; R];
        for p in 0..P {
            let value = S::load(start.add(p * S::LANES));
            for r in 0..R {
                sums[r][p] = value;
            }
        }
        for k in 0..count {
            let mut values = [S::splat(0.0); P];
            for p in 0..P {
                values[p] = S::load(right.add(p * S::LANES));
            }
            for r in 0..R {
                let factor = S::splat(*rows[r].add(k));
                for p in 0..P {
                    sums[r][p] = S::fma(factor, values[p], sums[r][p]);
                }
            }
            right = right.add(width);
        }
        for r in 0..R {
            for p in 0..P {
                S::store(out.add(r * width + p * S::LANES), sums[r][p]);
            }
        }
    }
}

/// Asks for the cache line of a value.
#[inline(always)]
fn prefetch(value: *const f32) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: a hint, without effect on anything but the cache.
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T1>(value.cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}

struct MultiplyTransposed;

impl MultiplyTransposed {
    /// Lengths were compared by the caller.
    #[inline(always)]
    unsafe fn run<S: Simd>(
        left: &[f32],
        places: &[usize],
        count: usize,
        right: &[f32],
        width: usize,
        out: &mut [f32],
    ) {
        let (left, right, out) = (left.as_ptr(), right.as_ptr(), out.as_mut_ptr());
        macro_rules! columns {
            ($p:literal, $vector:expr) => {{
                let column = $vector * S::LANES;
                macro_rules! rows {
                    ($r:literal, $row:expr) => {
                        Self::tile::<S, $r, $p>(
                            left.add($row),
                            places,
                            right.add(column),
                            width,
                            out.add($row * width + column),
                        )
                    };
                }
                down!(const { tile_rows::<S>($p) }, count, rows);
            }};
        }
        across!(S, width / S::LANES, columns);
    }

    #[inline(always)]
    unsafe fn tile<S: Simd, const R: usize, const P: usize>(
        left: *const f32,
        places: &[usize],
        mut right: *const f32,
        width: usize,
        out: *mut f32,
    ) {
        let mut sums = [[S::splat(0.0); P]; R];
        for r in 0..R {
            for p in 0..P {
                sums[r][p] = S::load(out.add(r * width + p * S::LANES));
            }
        }
        for &place in places {
            let row = left.add(place);
            let mut values = [S::splat(0.0); P];
            for p in 0..P {
                values[p] = S::load(right.add(p * S::LANES));
            }
            for r in 0..R {
                let factor = S::splat(*row.add(r));
                for p in 0..P {
                    sums[r][p] = S::fma(factor, values[p], sums[r][p]);
                }
            }
            right = right.add(width);
        }
        for r in 0..R {
            for p in 0..P {
                S::store(out.add(r * width + p * S::LANES), sums[r][p]);
            }
        }
    }
}

/// `out[column · out_width + row] = values[row · width + column]`.
pub(super) fn transpose(
    values: &[f32],
    width: usize,
    rows: usize,
    columns: usize,
    out: &mut [f32],
    out_width: usize,
) {
    const SIDE: usize = 8;
    assert!(values.len() >= (rows - 1) * width + columns, "matrix");
    assert!(
        out.len() >= (columns - 1) * out_width + rows,
        "room for its transpose"
    );
    let (whole_rows, whole_columns) = (rows - rows % SIDE, columns - columns % SIDE);
    for row in (0..whole_rows).step_by(SIDE) {
        for column in (0..whole_columns).step_by(SIDE) {
            let mut block = [[0.0_f32; SIDE]; SIDE];
            for (r, line) in block.iter_mut().enumerate() {
                line.copy_from_slice(&values[(row + r) * width + column..][..SIDE]);
            }
            for c in 0..SIDE {
                let turned = block.map(|line| line[c]);
                out[(column + c) * out_width + row..][..SIDE].copy_from_slice(&turned);
            }
        }
    }
    for row in 0..rows {
        let first = if row < whole_rows { whole_columns } else { 0 };
        for column in first..columns {
            out[column * out_width + row] = values[row * width + column];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::values;
    use super::*;
    use crate::simd::level;

    #[test]
    fn products_are_the_sums_that_define_them() {
        for (rows, count, columns) in [(1, 1, 1), (7, 5, 16), (13, 33, 60), (96, 20, 130), (9, 300, 250)] {
            let right = Rows::of(&values(count * columns, 3), columns);
            let width = right.width();
            let start = Rows::of(&values(columns, 4), columns);
            let series = values(count + 3 * rows, 5);
            let places: Vec<usize> = (0..rows).map(|r| 3 * (rows - 1 - r)).collect();
            for level in [level(), Level::Portable] {
                let mut out = Rows::new(rows, columns);
                multiply(
                    level,
                    &series,
                    &places,
                    count,
                    right.values(),
                    width,
                    start.values(),
                    out.values_mut(),
                );
                // The same product, turned: Σ_r left[r][k] out[r] on top of the start in row 0.
                let mut turned = Rows::new(count, columns);
                turned.values_mut()[..width].copy_from_slice(start.values());
                multiply_transposed(
                    level,
                    &series,
                    &places,
                    count,
                    out.values(),
                    width,
                    turned.values_mut(),
                );
                for column in 0..width {
                    for (row, &place) in places.iter().enumerate() {
                        let exact = (0..count)
                            .map(|k| {
                                f64::from(series[place + k]) * f64::from(right.values()[k * width + column])
                            })
                            .sum::<f64>()
                            + f64::from(start.values()[column]);
                        let found = f64::from(out.values()[row * width + column]);
                        // Up to 300 roundings of sums of size ten.
                        assert!((found - exact).abs() < 2e-5, "{row} {column}: {found} {exact}");
                    }
                    for k in 0..count {
                        let exact = places
                            .iter()
                            .enumerate()
                            .map(|(r, &place)| {
                                f64::from(series[place + k]) * f64::from(out.values()[r * width + column])
                            })
                            .sum::<f64>()
                            + if k == 0 {
                                f64::from(start.values()[column])
                            } else {
                                0.0
                            };
                        let found = f64::from(turned.values()[k * width + column]);
                        assert!((found - exact).abs() < 2e-4, "{k} {column}: {found} {exact}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_transpose_turns_every_value() {
        for (rows, columns) in [(1, 1), (8, 8), (60, 300), (17, 9)] {
            let matrix = values(rows * columns, 7);
            let mut out = Rows::new(columns, rows);
            let width = out.width();
            transpose(&matrix, columns, rows, columns, out.values_mut(), width);
            for (at, value) in matrix.iter().enumerate() {
                let found = out.values()[at % columns * width + at / columns];
                assert_eq!(found.to_bits(), value.to_bits());
            }
        }
    }
}
