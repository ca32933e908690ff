//! Dense layers in f32 without a tensor framework: packed weights, register blocks, no allocation.
//!
//! A layer is packed twice, because windows come in two forms:
//!
//! - **Rows**, one window after the other: outputs are the lanes. Weights are packed into groups of 16
//!   outputs (`group[input][16]`), a block of six rows × four vectors of outputs is summed in registers, and
//!   one value of each row at a time is multiplied with the weights of its input. Values are read where they
//!   are; the result has the form that the next layer takes.
//! - **Side by side**, as the overlapping windows of a recording are (`panel[value][window]`, [`PANEL`] of
//!   them): windows are the lanes, a block of 12 outputs × 2 vectors of windows is summed in registers, and one
//!   weight at a time is multiplied with both vectors. Nothing is copied to make a window of a recording, and
//!   nothing is padded: 60 outputs cost 60.
//!
//! Both add the same products in the same order, fused alike: an estimate has the same bits whichever
//! way it is computed and whatever stands beside it. A layer of few outputs (`NARROW`) would fill few
//! lanes, and each of its sums would wait for itself: it adds in 16 parts, which are the lanes where windows are
//! rows.
//!
//! A group of outputs that is not full costs as much as a full one. What else is a linear map of the same inputs
//! can stand there, *beside* the layer, see [`PackedLayer::with_beside`].

#![allow(
    unsafe_code,
    unsafe_op_in_unsafe_fn,
    clippy::inline_always,
    clippy::needless_range_loop,
    clippy::too_many_arguments,
    reason = "vector code has to be inlined into the function that enables the instructions, and a bound check per \
              load would double its cost: lengths are compared before the loops"
)]

use crate::activate::activate;
use crate::model::weights::LinearWeights;
pub use crate::simd::{Level, level};
use crate::simd::{Simd, dispatch};
use hydroflex_openapi::model::Activation;

/// Windows in a panel: two AVX-512 registers.
pub const PANEL: usize = 32;
/// Outputs in a group: one AVX-512 register.
const GROUP: usize = 16;
/// Outputs in a tile: as many as two vectors each leave registers for.
const TILE: usize = 12;
/// Outputs up to which sums are made in parts.
const NARROW: usize = 6;
/// Parts of such a sum.
const PARTS: usize = 16;

/// Sixteen weights on a cache line of their own.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(64))]
struct Lanes([f32; GROUP]);

/// `f(W x + b)` with packed W, and linear outputs beside it.
#[derive(Debug, Clone, PartialEq)]
pub struct PackedLayer {
    inputs: usize,
    /// Those beside too.
    outputs: usize,
    /// The last ones, which no activation touches.
    beside: usize,
    /// `[group][input][16]`; none of a narrow layer.
    groups: Vec<Lanes>,
    /// `[tile][input][outputs of the tile]`; of a narrow layer `[output][input]`.
    tiles: Vec<f32>,
    bias: Vec<f32>,
    activations: Vec<Activation>,
}

/// The weights (row-major, a row per output) as tiles of `tile` outputs each, `[tile][input][outputs of the tile]`;
/// each one is also handed to `into_group` with its output and input.
pub(super) fn pack<T: Copy + Default>(
    weights: &[T],
    outputs: usize,
    tile: usize,
    mut into_group: impl FnMut(usize, usize, T),
) -> Vec<T> {
    let inputs = weights.len() / outputs.max(1);
    let mut tiles = vec![T::default(); outputs * inputs];
    for (output, row) in weights.chunks(inputs.max(1)).enumerate() {
        let first = output - output % tile;
        let width = tile.min(outputs - first);
        for (input, &weight) in row.iter().enumerate() {
            into_group(output, input, weight);
            tiles[first * inputs + input * width + output - first] = weight;
        }
    }
    tiles
}

impl PackedLayer {
    /// Packs `map`.
    ///
    /// # Panics
    /// When weights and biases do not fit.
    #[must_use]
    pub fn new(map: &LinearWeights, activations: &[Activation]) -> Self {
        let outputs = map.bias.len();
        let inputs = map.weight.len() / outputs.max(1);
        assert_eq!(map.weight.len(), outputs * inputs, "weights fit biases");
        let is_narrow = outputs <= NARROW;
        let group_count = outputs.div_ceil(GROUP);
        let mut groups = vec![Lanes([0.0; GROUP]); if is_narrow { 0 } else { group_count * inputs }];
        let tile = if is_narrow { 1 } else { TILE };
        let tiles = pack(&map.weight, outputs, tile, |output, input, weight| {
            if !is_narrow {
                groups[output / GROUP * inputs + input].0[output % GROUP] = weight;
            }
        });
        let mut bias = map.bias.clone();
        bias.resize(group_count * GROUP, 0.0);
        Self {
            inputs,
            outputs,
            beside: 0,
            groups,
            tiles,
            bias,
            activations: activations.to_vec(),
        }
    }

    /// Packs `map`, and beside it another map of the same inputs, whose outputs are not activated.
    ///
    /// # Panics
    /// When weights and biases do not fit, or the maps have other inputs.
    #[must_use]
    pub fn with_beside(map: &LinearWeights, activations: &[Activation], beside: &LinearWeights) -> Self {
        let inputs = |map: &LinearWeights| map.weight.len() / map.bias.len().max(1);
        assert_eq!(inputs(map), inputs(beside), "maps of the same inputs");
        let both = LinearWeights {
            weight: [map.weight.as_slice(), &beside.weight].concat(),
            bias: [map.bias.as_slice(), &beside.bias].concat(),
        };
        Self {
            beside: beside.bias.len(),
            ..Self::new(&both, activations)
        }
    }

    /// Whether so many outputs beside a layer of `outputs` cost next to nothing.
    #[must_use]
    pub fn has_room(outputs: usize, beside: usize) -> bool {
        outputs + beside <= NARROW
            || (outputs > NARROW && outputs % GROUP + beside <= GROUP && !outputs.is_multiple_of(GROUP))
    }

    /// Values in.
    #[must_use]
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Values out, without padding and without those beside.
    #[must_use]
    pub fn outputs(&self) -> usize {
        self.outputs - self.beside
    }

    /// Values beside them.
    #[must_use]
    pub fn beside(&self) -> usize {
        self.beside
    }

    /// Values out, filled up to whole groups.
    #[must_use]
    pub fn padded(&self) -> usize {
        self.bias.len()
    }

    fn is_narrow(&self) -> bool {
        self.outputs <= NARROW
    }

    /// Output for `rows` of inputs that begin `stride` values apart in `x`, written row by row with
    /// [`Self::padded`] values each.
    ///
    /// # Panics
    /// When a slice is too short.
    pub fn forward(&self, x: &[f32], stride: usize, rows: usize, out: &mut [f32]) {
        self.forward_at(level(), x, stride, rows, out, None);
    }

    /// As [`Self::forward`]; the outputs beside come to `beside`, [`Self::beside`] values a row.
    ///
    /// # Panics
    /// When a slice is too short.
    pub fn forward_with(&self, x: &[f32], stride: usize, rows: usize, out: &mut [f32], beside: &mut [f32]) {
        self.forward_at(level(), x, stride, rows, out, Some(beside));
    }

    fn forward_at(
        &self,
        level: Level,
        x: &[f32],
        stride: usize,
        rows: usize,
        out: &mut [f32],
        beside: Option<&mut [f32]>,
    ) {
        if rows == 0 {
            return;
        }
        assert!(
            x.len() >= (rows - 1) * stride + self.inputs,
            "inputs of {rows} rows"
        );
        assert!(out.len() >= rows * self.padded(), "room for {rows} rows");
        let beside = beside.unwrap_or_default();
        assert!(
            beside.is_empty() || beside.len() >= rows * self.beside,
            "room beside {rows} rows"
        );
        let layer = self;
        dispatch!(level, PackedLayer::rows(layer: &PackedLayer, x: &[f32], stride: usize, rows: usize, out: &mut [f32], beside: &mut [f32]));
    }

    /// Output for a panel: value i of the window in column c is `x[places[i] + c]`, output o comes
    /// to stand at `out[o · PANEL + c]`, those beside after the others. The columns up to the next multiple of 16
    /// are computed too.
    ///
    /// # Panics
    /// When a slice is too short or there are more columns than [`PANEL`].
    pub fn forward_panel(&self, x: &[f32], places: &[usize], columns: usize, out: &mut [f32]) {
        self.forward_panel_at(level(), x, places, columns, out);
    }

    fn forward_panel_at(&self, level: Level, x: &[f32], places: &[usize], columns: usize, out: &mut [f32]) {
        let columns = columns.next_multiple_of(PANEL / 2);
        assert!(columns <= PANEL, "a panel has {PANEL} columns");
        assert!(places.len() >= self.inputs, "a place for each input");
        let last = places[..self.inputs].iter().max().copied().unwrap_or(0);
        assert!(x.len() >= last + columns, "inputs of a panel");
        assert!(out.len() >= self.outputs * PANEL, "room for a panel");
        let layer = self;
        dispatch!(level, PackedLayer::many(layer: &PackedLayer, x: &[f32], places: &[usize], columns: usize, out: &mut [f32]));
    }

    // --- side by side ---

    /// Lengths were compared by the caller.
    #[inline(always)]
    unsafe fn many<S: Simd>(layer: &Self, x: &[f32], places: &[usize], columns: usize, out: &mut [f32]) {
        let places = &places[..layer.inputs];
        if layer.is_narrow() {
            for column in (0..columns).step_by(S::LANES) {
                let (x, out) = (x.as_ptr().add(column), out.as_mut_ptr().add(column));
                for output in 0..layer.outputs {
                    layer.narrow_column::<S>(output, x, places, out);
                }
            }
            layer.activate_panel::<S>(columns, &mut out[..layer.outputs() * PANEL]);
            return;
        }
        for first in (0..layer.outputs).step_by(TILE) {
            let width = TILE.min(layer.outputs - first);
            let mut column = 0;
            while column + 2 * S::LANES <= columns {
                layer.tile::<S, 2>(
                    first,
                    width,
                    x.as_ptr().add(column),
                    places,
                    out.as_mut_ptr().add(column),
                );
                column += 2 * S::LANES;
            }
            while column < columns {
                layer.tile::<S, 1>(
                    first,
                    width,
                    x.as_ptr().add(column),
                    places,
                    out.as_mut_ptr().add(column),
                );
                column += S::LANES;
            }
            // While its sums are in the first-level cache.
            let activated = (first + width).min(layer.outputs()).max(first);
            layer.activate_panel::<S>(columns, &mut out[first * PANEL..activated * PANEL]);
        }
    }

    #[inline(always)]
    unsafe fn activate_panel<S: Simd>(&self, columns: usize, out: &mut [f32]) {
        for &activation in &self.activations {
            if columns == PANEL {
                activate::<S>(activation, out);
            } else {
                for row in out.chunks_exact_mut(PANEL) {
                    activate::<S>(activation, &mut row[..columns]);
                }
            }
        }
    }

    /// Outputs `first..first + width` of P vectors of columns.
    #[inline(always)]
    unsafe fn tile<S: Simd, const P: usize>(
        &self,
        first: usize,
        width: usize,
        x: *const f32,
        places: &[usize],
        out: *mut f32,
    ) {
        let weights = self.tiles.as_ptr().add(first * self.inputs);
        let mut done = 0;
        while width - done >= S::OUTPUTS {
            let (w, at) = (weights.add(done), first + done);
            match S::OUTPUTS {
                12 => self.block::<S, 12, P>(w, width, at, x, places, out),
                6 => self.block::<S, 6, P>(w, width, at, x, places, out),
                _ => self.block::<S, 4, P>(w, width, at, x, places, out),
            }
            done += S::OUTPUTS;
        }
        while done < width {
            let (w, at) = (weights.add(done), first + done);
            let rest = width - done;
            let taken = if rest >= 8 {
                self.block::<S, 8, P>(w, width, at, x, places, out);
                8
            } else if rest >= 4 {
                self.block::<S, 4, P>(w, width, at, x, places, out);
                4
            } else if rest >= 2 {
                self.block::<S, 2, P>(w, width, at, x, places, out);
                2
            } else {
                self.block::<S, 1, P>(w, width, at, x, places, out);
                1
            };
            done += taken;
        }
    }

    /// R outputs × P vectors of columns, summed in registers over all inputs.
    #[inline(always)]
    unsafe fn block<S: Simd, const R: usize, const P: usize>(
        &self,
        mut weights: *const f32,
        stride: usize,
        first: usize,
        x: *const f32,
        places: &[usize],
        out: *mut f32,
    ) {
        let mut sums = [[S::splat(0.0); P]; R];
        for &place in places {
            let mut values = [S::splat(0.0); P];
            for p in 0..P {
                values[p] = S::load(x.add(place + p * S::LANES));
            }
            for r in 0..R {
                let weight = S::splat(*weights.add(r));
                for p in 0..P {
                    sums[r][p] = S::fma(weight, values[p], sums[r][p]);
                }
            }
            weights = weights.add(stride);
        }
        for r in 0..R {
            let bias = S::splat(self.bias[first + r]);
            for p in 0..P {
                S::store(
                    out.add((first + r) * PANEL + p * S::LANES),
                    S::add(sums[r][p], bias),
                );
            }
        }
    }

    /// One output of a narrow layer for one vector of columns.
    #[inline(always)]
    unsafe fn narrow_column<S: Simd>(&self, output: usize, x: *const f32, places: &[usize], out: *mut f32) {
        let mut sums = [S::splat(0.0); PARTS];
        let mut weights = self.tiles.as_ptr().add(output * self.inputs);
        let (whole, rest) = places.as_chunks::<PARTS>();
        for places in whole {
            for part in 0..PARTS {
                let value = S::load(x.add(places[part]));
                sums[part] = S::fma(S::splat(*weights.add(part)), value, sums[part]);
            }
            weights = weights.add(PARTS);
        }
        for (part, &place) in rest.iter().enumerate() {
            let value = S::load(x.add(place));
            sums[part] = S::fma(S::splat(*weights.add(part)), value, sums[part]);
        }
        // As halves of a vector are added, see `Simd::sum`.
        for half in [8, 4, 2, 1] {
            for part in 0..half {
                sums[part] = S::add(sums[part], sums[part + half]);
            }
        }
        S::store(
            out.add(output * PANEL),
            S::add(sums[0], S::splat(self.bias[output])),
        );
    }

    // --- rows ---

    /// Lengths were compared by the caller, except that of `beside`, which may be missing.
    #[inline(always)]
    unsafe fn rows<S: Simd>(
        layer: &Self,
        x: &[f32],
        stride: usize,
        rows: usize,
        out: &mut [f32],
        beside: &mut [f32],
    ) {
        let (from, to) = (x.as_ptr(), out.as_mut_ptr());
        let mut row = 0;
        while row < rows {
            let rest = rows - row;
            let (from, to) = (from.add(row * stride), to.add(row * layer.padded()));
            row += if rest >= S::ROWS {
                // As many blocks as there are: weights that stay in a cache meanwhile are read once.
                let blocks = rest / S::ROWS;
                if S::ROWS == 6 {
                    layer.strips::<S, 6>(from, stride, blocks, to);
                } else {
                    layer.strips::<S, 4>(from, stride, blocks, to);
                }
                blocks * S::ROWS
            } else if rest >= 4 {
                layer.strips::<S, 4>(from, stride, 1, to);
                4
            } else if rest >= 2 {
                layer.strips::<S, 2>(from, stride, 1, to);
                2
            } else {
                layer.strips::<S, 1>(from, stride, 1, to);
                1
            };
        }
        // By hand: a copy by the library, or one that the compiler makes vectors of, takes longer than the values' layer.
        if beside.len() >= rows * layer.beside {
            for row in 0..rows {
                for place in 0..layer.beside {
                    *beside.as_mut_ptr().add(row * layer.beside + place) =
                        *to.add(row * layer.padded() + layer.outputs() + place);
                }
            }
        }
        for &activation in &layer.activations {
            activate::<S>(activation, &mut out[..rows * layer.padded()]);
        }
    }

    /// All outputs of `blocks` times R rows.
    #[inline(always)]
    unsafe fn strips<S: Simd, const R: usize>(
        &self,
        x: *const f32,
        stride: usize,
        blocks: usize,
        out: *mut f32,
    ) {
        if self.is_narrow() {
            for block in 0..blocks {
                let (x, out) = (x.add(block * R * stride), out.add(block * R * self.padded()));
                for output in 0..self.outputs {
                    self.narrow_rows::<S, R>(output, x, stride, out);
                }
            }
            return;
        }
        let vectors = self.padded() / S::LANES;
        let mut vector = 0;
        while vector < vectors {
            // Few rows leave registers for more outputs.
            let most = if R <= 2 { 4 } else { S::VECTORS };
            vector += match (vectors - vector).min(most) {
                4.. => self.strip::<S, R, 4>(vector, x, stride, blocks, out),
                3 => self.strip::<S, R, 3>(vector, x, stride, blocks, out),
                2 => self.strip::<S, R, 2>(vector, x, stride, blocks, out),
                _ => self.strip::<S, R, 1>(vector, x, stride, blocks, out),
            };
        }
    }

    /// V vectors of outputs of `blocks` times R rows; returns V.
    #[inline(always)]
    unsafe fn strip<S: Simd, const R: usize, const V: usize>(
        &self,
        first: usize,
        x: *const f32,
        stride: usize,
        blocks: usize,
        out: *mut f32,
    ) -> usize {
        for block in 0..blocks {
            self.block_of_rows::<S, R, V>(
                first,
                x.add(block * R * stride),
                stride,
                out.add(block * R * self.padded()),
            );
        }
        V
    }

    /// R rows × V vectors of outputs, summed in registers over all inputs.
    #[inline(always)]
    unsafe fn block_of_rows<S: Simd, const R: usize, const V: usize>(
        &self,
        first: usize,
        x: *const f32,
        stride: usize,
        out: *mut f32,
    ) {
        let weights = self.groups.as_ptr().cast::<f32>();
        let mut pointers = [weights; V];
        for v in 0..V {
            let lane = (first + v) * S::LANES;
            pointers[v] = weights.add(lane / GROUP * self.inputs * GROUP + lane % GROUP);
        }
        let mut sums = [[S::splat(0.0); V]; R];
        for input in 0..self.inputs {
            let mut lanes = [S::splat(0.0); V];
            for v in 0..V {
                lanes[v] = S::load(pointers[v].add(input * GROUP));
            }
            for r in 0..R {
                let value = S::splat(*x.add(r * stride + input));
                for v in 0..V {
                    sums[r][v] = S::fma(value, lanes[v], sums[r][v]);
                }
            }
        }
        for r in 0..R {
            for v in 0..V {
                let lane = (first + v) * S::LANES;
                S::store(
                    out.add(r * self.padded() + lane),
                    S::add(sums[r][v], S::load(self.bias.as_ptr().add(lane))),
                );
            }
        }
    }

    /// One output of a narrow layer for R rows.
    #[inline(always)]
    unsafe fn narrow_rows<S: Simd, const R: usize>(
        &self,
        output: usize,
        x: *const f32,
        stride: usize,
        out: *mut f32,
    ) {
        let weights = self.tiles.as_ptr().add(output * self.inputs);
        let mut totals = [0.0; R];
        match S::LANES {
            16 => self.dots::<S, R, 1>(weights, x, stride, &mut totals),
            8 => self.dots::<S, R, 2>(weights, x, stride, &mut totals),
            _ => self.dots::<S, R, 4>(weights, x, stride, &mut totals),
        }
        for r in 0..R {
            *out.add(r * self.padded() + output) = totals[r] + self.bias[output];
        }
    }

    /// `weights · row` for R rows, in [`PARTS`] parts, V vectors of them.
    #[inline(always)]
    unsafe fn dots<S: Simd, const R: usize, const V: usize>(
        &self,
        weights: *const f32,
        x: *const f32,
        stride: usize,
        totals: &mut [f32; R],
    ) {
        let mut sums = [[S::splat(0.0); V]; R];
        let whole = self.inputs - self.inputs % PARTS;
        for input in (0..whole).step_by(PARTS) {
            for v in 0..V {
                let lanes = S::load(weights.add(input + v * S::LANES));
                for r in 0..R {
                    let values = S::load(x.add(r * stride + input + v * S::LANES));
                    sums[r][v] = S::fma(lanes, values, sums[r][v]);
                }
            }
        }
        for v in 0..V {
            let input = whole + v * S::LANES;
            if input < self.inputs {
                let count = (self.inputs - input).min(S::LANES);
                let lanes = S::load_first(weights.add(input), count);
                for r in 0..R {
                    let values = S::load_first(x.add(r * stride + input), count);
                    sums[r][v] = S::fma(lanes, values, sums[r][v]);
                }
            }
        }
        for r in 0..R {
            let mut half = V / 2;
            while half > 0 {
                for v in 0..half {
                    sums[r][v] = S::add(sums[r][v], sums[r][v + half]);
                }
                half /= 2;
            }
            totals[r] = S::sum(sums[r][0]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::panel::transpose;
    use super::*;

    fn map(outputs: usize, inputs: usize, seed: u32) -> LinearWeights {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f32::from((state >> 16) as u16) / 32768.0 - 1.0
        };
        LinearWeights {
            weight: (0..outputs * inputs).map(|_| next()).collect(),
            bias: (0..outputs).map(|_| next()).collect(),
        }
    }

    /// Levels of this machine: what it uses, and what older ones would.
    fn levels() -> Vec<Level> {
        match level() {
            Level::Avx512 => vec![Level::Avx512, Level::Avx2, Level::Portable],
            Level::Avx2 => vec![Level::Avx2, Level::Portable],
            Level::Portable => vec![Level::Portable],
        }
    }

    /// Both ways to compute a layer, row by row without padding.
    fn both(layer: &PackedLayer, level: Level, x: &[f32], stride: usize, rows: usize) -> [Vec<f32>; 2] {
        let mut few = vec![f32::NAN; rows * layer.padded()];
        layer.forward_at(level, x, stride, rows, &mut few, None);
        let few = few
            .chunks(layer.padded())
            .flat_map(|row| row[..layer.outputs()].to_vec());
        let places: Vec<usize> = (0..layer.inputs()).map(|i| i * PANEL).collect();
        let mut many = vec![0.0; rows * layer.outputs()];
        let mut panel = vec![f32::NAN; layer.inputs() * PANEL];
        let mut out = vec![f32::NAN; layer.outputs() * PANEL];
        for first in (0..rows).step_by(PANEL) {
            let columns = PANEL.min(rows - first);
            transpose(&x[first * stride..], stride, columns, layer.inputs(), &mut panel);
            layer.forward_panel_at(level, &panel, &places, columns, &mut out);
            for column in 0..columns {
                for output in 0..layer.outputs() {
                    many[(first + column) * layer.outputs() + output] = out[output * PANEL + column];
                }
            }
        }
        [few.collect(), many]
    }

    #[test]
    fn every_shape_and_row_count_agrees_with_the_definition_and_has_the_same_bits_both_ways() {
        for (outputs, inputs) in [
            (1, 1),
            (3, 500),
            (4, 33),
            (5, 61),
            (16, 7),
            (17, 60),
            (60, 300),
            (256, 33),
        ] {
            let weights = map(outputs, inputs, 3);
            let layer = PackedLayer::new(&weights, &[Activation::Tanh]);
            for rows in [1, 2, 7, 8, 17, 32, 45] {
                let stride = if rows % 2 == 0 { inputs } else { 1 };
                let x = map(1, rows * inputs + 2, 9).weight;
                for level in levels() {
                    let [few, many] = both(&layer, level, &x, stride, rows);
                    assert_eq!(few, many, "{level:?} {outputs}×{inputs}, {rows} rows");
                    for (place, &found) in few.iter().enumerate() {
                        let (r, o) = (place / outputs, place % outputs);
                        let z: f64 = (0..inputs)
                            .map(|i| f64::from(weights.weight[o * inputs + i]) * f64::from(x[r * stride + i]))
                            .sum::<f64>()
                            + f64::from(weights.bias[o]);
                        // Up to 500 f32 products of size one: rounding 6e-8 · √500 · √500.
                        assert!(
                            (f64::from(found) - z.tanh()).abs() < 3e-5,
                            "{level:?} {outputs}×{inputs}, row {r}: {found} {}",
                            z.tanh()
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn a_map_beside_a_layer_has_the_same_bits_as_alone_where_sums_are_made_alike_and_stays_linear() {
        for (outputs, beside, inputs) in [(60, 1, 300), (13, 3, 50), (1, 1, 300), (3, 3, 37), (90, 2, 31)] {
            assert!(PackedLayer::has_room(outputs, beside));
            let (main, other) = (map(outputs, inputs, 1), map(beside, inputs, 2));
            let layer = PackedLayer::with_beside(&main, &[Activation::Relu], &other);
            let alone = PackedLayer::new(&main, &[Activation::Relu]);
            assert_eq!((layer.outputs(), layer.beside()), (outputs, beside));
            for rows in [1, 9, 32] {
                let x = map(1, rows * inputs, 9).weight;
                for level in levels() {
                    let mut found = vec![f32::NAN; rows * layer.padded()];
                    let mut found_beside = vec![f32::NAN; rows * beside];
                    layer.forward_at(level, &x, inputs, rows, &mut found, Some(&mut found_beside));
                    let mut expected = vec![f32::NAN; rows * alone.padded()];
                    alone.forward_at(level, &x, inputs, rows, &mut expected, None);
                    let mut panel = vec![f32::NAN; inputs * PANEL];
                    let mut out = vec![f32::NAN; (outputs + beside) * PANEL];
                    transpose(&x, inputs, rows, inputs, &mut panel);
                    let places: Vec<usize> = (0..inputs).map(|i| i * PANEL).collect();
                    layer.forward_panel_at(level, &panel, &places, rows, &mut out);
                    for row in 0..rows {
                        for output in 0..outputs {
                            let bits = found[row * layer.padded() + output].to_bits();
                            let expected = expected[row * alone.padded() + output];
                            assert_eq!(bits, expected.to_bits(), "{level:?}");
                            assert_eq!(bits, out[output * PANEL + row].to_bits(), "{level:?}");
                        }
                        for b in 0..beside {
                            let value = found_beside[row * beside + b];
                            assert_eq!(
                                value.to_bits(),
                                out[(outputs + b) * PANEL + row].to_bits(),
                                "{level:?}"
                            );
                            let z: f64 = (0..inputs)
                                .map(|i| {
                                    f64::from(other.weight[b * inputs + i]) * f64::from(x[row * inputs + i])
                                })
                                .sum::<f64>()
                                + f64::from(other.bias[b]);
                            // Up to 300 f32 products of size one.
                            assert!((f64::from(value) - z).abs() < 3e-5, "{level:?}: {value} {z}");
                        }
                    }
                }
            }
        }
        assert!(!PackedLayer::has_room(256, 1) && !PackedLayer::has_room(4, 3));
    }

    #[test]
    fn activations_agree_with_the_library_in_f64() {
        let truth = |activation: Activation, x: f64| match activation {
            Activation::Tanh => x.tanh(),
            Activation::Sigmoid => 1.0 / (1.0 + (-x).exp()),
            Activation::Relu => x.max(0.0),
            Activation::Elu => x.max(x.min(0.0).exp_m1()),
            Activation::Silu => x / (1.0 + (-x).exp()),
        };
        // The identity, so that the layer is its activation.
        let identity = LinearWeights {
            weight: (0..GROUP * GROUP)
                .map(|i| if i % (GROUP + 1) == 0 { 1.0 } else { 0.0 })
                .collect(),
            bias: vec![0.0; GROUP],
        };
        let x: Vec<f32> = (-4000..4000)
            .map(|i| i as f32 * 0.005)
            .chain([-1e30, -200.0, -88.0, -1e-7, 1e-7, 88.0, 200.0, 1e30])
            .chain([0.0; 8])
            .collect();
        for activation in [
            Activation::Tanh,
            Activation::Sigmoid,
            Activation::Relu,
            Activation::Elu,
            Activation::Silu,
        ] {
            let layer = PackedLayer::new(&identity, &[activation]);
            for level in levels() {
                let [few, many] = both(&layer, level, &x, GROUP, x.len() / GROUP);
                assert_eq!(few, many, "{level:?} {activation:?}");
                for (x, &found) in x.iter().zip(&few) {
                    let truth = truth(activation, f64::from(*x));
                    // A few f32 roundings (6e-8) of values of size one, more for larger results.
                    let error = (f64::from(found) - truth).abs();
                    assert!(
                        error < 5e-7 * truth.abs().max(1.0),
                        "{level:?} {activation:?}({x}) = {found}, not {truth}"
                    );
                }
            }
        }
    }

    #[test]
    fn levels_agree_with_each_other() {
        let layer = PackedLayer::new(&map(40, 90, 5), &[Activation::Silu]);
        let x = map(1, 90 * 9, 6).weight;
        let found: Vec<Vec<f32>> = levels()
            .into_iter()
            .map(|level| both(&layer, level, &x, 90, 9)[0].clone())
            .collect();
        for (level, other) in levels().into_iter().zip(&found) {
            if level == Level::Portable {
                for (a, b) in found[0].iter().zip(other) {
                    assert!((a - b).abs() < 2e-5, "{a} {b}");
                }
            } else {
                assert_eq!(&found[0], other, "the same fused sums in the same order");
            }
        }
    }
}
