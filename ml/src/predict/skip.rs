//! The skip connection in f64: coefficients that follow slow signals, see [`crate::scheduled`].
//!
//! Packed twice and computed in two ways, as [`super::kernel`] does in f32, with the same bits: many
//! windows side by side, or few windows with outputs side by side. Every sum is made in four parts, those of few
//! outputs (constant coefficients have one for each target) in eight, which are the lanes where windows are rows. f64
//! because the coefficients are large and act on small differences of neighbouring samples; the
//! samples themselves are the scaled f32 values that the network takes, as in training. It costs
//! little: a scheduled map has a twentieth of our own network's products.

#![allow(
    unsafe_code,
    unsafe_op_in_unsafe_fn,
    clippy::inline_always,
    clippy::needless_range_loop,
    clippy::too_many_arguments,
    reason = "vector code has to be inlined into the function that enables the instructions, and a bound check per \
              load would double its cost: lengths are compared before the loops"
)]

use super::kernel::{Level, PANEL, level, pack};
use crate::model::weights::{SkipWeights, Weights};
use crate::simd::{Simd, dispatch};
use hydroflex_openapi::model::{ModelConfig, ScaledChannel, Schedule};

/// Outputs in a group.
const GROUP: usize = 8;
/// Outputs in a tile.
const TILE: usize = 12;
/// Parts of a sum.
const PARTS: usize = 4;
/// Outputs up to which there are more.
const NARROW: usize = 4;
/// Parts of such a sum.
const NARROW_PARTS: usize = 8;

/// A packed skip connection.
#[derive(Debug, Clone, PartialEq)]
pub struct SkipKernel {
    inputs: usize,
    targets: usize,
    /// `[group][input][8]`.
    groups: Vec<[f64; GROUP]>,
    /// `[tile][input][outputs of the tile]`; of few outputs `[output][input]`, filled up to whole parts.
    tiles: Vec<f64>,
    bias: Vec<f64>,
    slow: Vec<SlowSignal>,
    /// Terms × slow signals, and an estimate where the coefficients follow one.
    exponents: Vec<Vec<i32>>,
}

/// Skip connections whose coefficients follow an estimate of the payload, see [`crate::payload`].
#[derive(Debug, Clone, PartialEq)]
pub struct FollowingKernel {
    /// Middle and half of the payload's range, kg.
    range_kg: [f64; 2],
    /// Of the estimate, first to last: one target each.
    estimates: Vec<SkipKernel>,
    empty: Option<EmptyKernel>,
}

#[derive(Debug, Clone, PartialEq)]
struct EmptyKernel {
    /// Limit of the estimate below which the machine counts as empty.
    below: f64,
    map: SkipKernel,
    /// Of the network's output, one per target.
    gain: Vec<f32>,
}

/// The whole skip connection of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct Skip {
    map: SkipKernel,
    payload: Option<FollowingKernel>,
}

impl Skip {
    /// Packs a model's maps; none without skip connection.
    #[must_use]
    pub fn new(config: &ModelConfig, weights: &Weights) -> Option<Self> {
        let kernel = |map: &SkipWeights, schedule: Option<&Schedule>, targets| {
            SkipKernel::new(map, schedule, &config.inputs, targets)
        };
        let targets = config.targets.len();
        let map = kernel(weights.skip.as_ref()?, config.schedule.as_ref(), targets);
        let payload = config.payload.as_ref().map(|payload| FollowingKernel {
            range_kg: [payload.centre_kg, payload.half_range_kg],
            estimates: payload
                .estimates
                .iter()
                .zip(&weights.payload)
                .map(|(schedule, map)| kernel(map, Some(schedule), 1))
                .collect(),
            empty: payload
                .empty
                .as_ref()
                .zip(weights.empty.as_ref())
                .map(|(empty, map)| EmptyKernel {
                    below: (empty.below_kg - payload.centre_kg) / payload.half_range_kg,
                    map: kernel(map, Some(&empty.schedule), targets),
                    gain: gain(&empty.network_gain, targets),
                }),
        });
        Some(Self { map, payload })
    }

    fn maps(&self) -> impl Iterator<Item = &SkipKernel> {
        let payload = self.payload.iter();
        let others = payload.flat_map(|p| p.estimates.iter().chain(p.empty.iter().map(|empty| &empty.map)));
        std::iter::once(&self.map).chain(others)
    }

    /// Values of scratch memory per window, also of a panel's.
    #[must_use]
    pub fn padded(&self) -> usize {
        // The estimate, and the sums of one map after the other.
        let widest = self.maps().map(SkipKernel::padded).max().unwrap_or(0);
        widest + usize::from(self.payload.is_some())
    }

    /// Whether the coefficients follow a payload.
    #[must_use]
    pub fn follows_payload(&self) -> bool {
        self.payload.is_some()
    }

    /// Payloads, kg, that [`Self::add`] or [`Self::add_panel`] found last, from its scratch memory; nothing where none is followed.
    pub fn payloads_kg<'a>(&'a self, scratch: &'a [f64]) -> impl Iterator<Item = f64> + 'a {
        let of = |payload: &'a FollowingKernel| {
            let [centre, half] = payload.range_kg;
            scratch.iter().map(move |estimate| centre + half * estimate)
        };
        self.payload.iter().flat_map(of)
    }

    /// Whether windows that are rows need not be turned into a panel, however many there are.
    #[must_use]
    pub fn is_narrow(&self) -> bool {
        self.maps().all(SkipKernel::is_narrow)
    }

    /// As [`SkipKernel::add`].
    ///
    /// # Panics
    /// When a slice is too short.
    pub fn add(&self, x: &[f32], stride: usize, rows: usize, scratch: &mut [f64], out: &mut [f32]) {
        let Some(payload) = &self.payload else {
            return self.map.add(x, stride, rows, scratch, out);
        };
        let (estimates, scratch) = scratch.split_at_mut(rows);
        let value = |row: usize| move |position: usize| x[row * stride + position];
        for (k, map) in payload.estimates.iter().enumerate() {
            map.sums(level(), x, stride, rows, scratch);
            for (row, estimate) in estimates.iter_mut().enumerate() {
                let sums = &scratch[row * map.padded()..];
                let followed = (k > 0).then_some(*estimate);
                *estimate = map.combined(0, value(row), |output| sums[output], followed);
            }
        }
        let targets = self.map.targets;
        let mut add_where =
            |map: &SkipKernel, is_its: &dyn Fn(f64) -> bool, gain: Option<&[f32]>, scratch: &mut [f64]| {
                if !estimates.iter().any(|&e| is_its(e)) {
                    return;
                }
                map.sums(level(), x, stride, rows, scratch);
                for (row, &estimate) in estimates.iter().enumerate().filter(|(_, e)| is_its(**e)) {
                    let sums = &scratch[row * map.padded()..];
                    let followed = gain.is_none().then_some(estimate);
                    let out = &mut out[row * targets..(row + 1) * targets];
                    multiply(out, gain);
                    map.combine(value(row), |output| sums[output], followed, out);
                }
            };
        match &payload.empty {
            Some(EmptyKernel { below, map, gain }) => {
                add_where(map, &|e| e < *below, Some(gain), scratch);
                add_where(&self.map, &|e| e >= *below || e.is_nan(), None, scratch);
            }
            None => add_where(&self.map, &|_| true, None, scratch),
        }
    }

    /// As [`SkipKernel::add_panel`].
    ///
    /// # Panics
    /// When a slice is too short or there are more columns than [`PANEL`].
    pub fn add_panel(
        &self,
        x: &[f32],
        places: &[usize],
        columns: usize,
        scratch: &mut [f64],
        out: &mut [f32],
    ) {
        let Some(payload) = &self.payload else {
            return self.map.add_panel(x, places, columns, scratch, out);
        };
        let (estimates, scratch) = scratch.split_at_mut(PANEL);
        let estimates = &mut estimates[..columns];
        let value = |column: usize| move |position: usize| x[places[position] + column];
        for (k, map) in payload.estimates.iter().enumerate() {
            map.panel_sums(level(), x, places, columns, scratch);
            for (column, estimate) in estimates.iter_mut().enumerate() {
                let followed = (k > 0).then_some(*estimate);
                let sum = |output: usize| scratch[output * PANEL + column];
                *estimate = map.combined(0, value(column), sum, followed);
            }
        }
        let targets = self.map.targets;
        let mut add_where =
            |map: &SkipKernel, is_its: &dyn Fn(f64) -> bool, gain: Option<&[f32]>, scratch: &mut [f64]| {
                if !estimates.iter().any(|&e| is_its(e)) {
                    return;
                }
                map.panel_sums(level(), x, places, columns, scratch);
                for (column, &estimate) in estimates.iter().enumerate().filter(|(_, e)| is_its(**e)) {
                    let followed = gain.is_none().then_some(estimate);
                    let out = &mut out[column * targets..(column + 1) * targets];
                    multiply(out, gain);
                    let sum = |output: usize| scratch[output * PANEL + column];
                    map.combine(value(column), sum, followed, out);
                }
            };
        match &payload.empty {
            Some(EmptyKernel { below, map, gain }) => {
                add_where(map, &|e| e < *below, Some(gain), scratch);
                add_where(&self.map, &|e| e >= *below || e.is_nan(), None, scratch);
            }
            None => add_where(&self.map, &|_| true, None, scratch),
        }
    }
}

/// What the network gave, where another map than the loaded machine's is added to it.
fn multiply(out: &mut [f32], gain: Option<&[f32]>) {
    for (value, gain) in out.iter_mut().zip(gain.unwrap_or(&[])) {
        *value *= gain;
    }
}

/// One gain per target; 1 where none is told.
#[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
fn gain(told: &[f64], targets: usize) -> Vec<f32> {
    match told {
        [] => vec![1.0; targets],
        told => told.iter().map(|&gain| gain as f32).collect(),
    }
}

/// u = clamp(gain · scaled + shift, −1, 1) of one value of the window.
#[derive(Debug, Clone, PartialEq)]
struct SlowSignal {
    position: usize,
    gain: f64,
    shift: f64,
}

impl SkipKernel {
    /// Packs a map; without a schedule it is one term with constant coefficients.
    ///
    /// # Panics
    /// When weights, biases, schedule, channels and targets do not fit: the vector code trusts them.
    #[must_use]
    pub fn new(
        map: &SkipWeights,
        schedule: Option<&Schedule>,
        channels: &[ScaledChannel],
        targets: usize,
    ) -> Self {
        let outputs = map.bias.len();
        let inputs = map.weight.len() / outputs.max(1);
        assert_eq!(map.weight.len(), outputs * inputs, "weights fit biases");
        let terms = schedule.map_or(1, |schedule| schedule.exponents.len());
        assert_eq!(
            outputs,
            terms * targets,
            "one output for each term of each target"
        );
        assert!(inputs >= channels.len(), "a window has a sample of every channel");
        let (groups, tiles) = if outputs <= NARROW {
            let mut tiles = Vec::new();
            for row in map.weight.chunks(inputs.max(1)) {
                tiles.extend_from_slice(row);
                tiles.resize(tiles.len().next_multiple_of(NARROW_PARTS), 0.0);
            }
            (Vec::new(), tiles)
        } else {
            let mut groups = vec![[0.0; GROUP]; outputs.div_ceil(GROUP) * inputs];
            let tiles = pack(&map.weight, outputs, TILE, |output, input, weight| {
                groups[output / GROUP * inputs + input][output % GROUP] = weight;
            });
            (groups, tiles)
        };
        let mut bias = map.bias.clone();
        bias.resize(outputs.next_multiple_of(GROUP), 0.0);
        let slow = schedule.map_or_else(Vec::new, |schedule| {
            schedule
                .inputs
                .iter()
                .zip(schedule.centre.iter().zip(&schedule.half_range))
                .map(|(&input, (centre, half_range))| SlowSignal {
                    position: inputs - channels.len() + input,
                    gain: channels[input].scale / half_range,
                    shift: (channels[input].offset - centre) / half_range,
                })
                .collect()
        });
        let exponents = schedule.map_or_else(
            || vec![Vec::new()],
            |schedule| {
                let power = |&e: &u32| i32::try_from(e).unwrap_or(i32::MAX);
                schedule
                    .exponents
                    .iter()
                    .map(|e| e.iter().map(power).collect())
                    .collect()
            },
        );
        Self {
            inputs,
            targets,
            groups,
            tiles,
            bias,
            slow,
            exponents,
        }
    }

    /// Values of scratch memory per window, also of a panel's.
    #[must_use]
    pub fn padded(&self) -> usize {
        self.bias.len()
    }

    /// Whether windows that are rows need not be turned into a panel, however many there are.
    #[must_use]
    pub fn is_narrow(&self) -> bool {
        self.outputs() <= NARROW
    }

    fn outputs(&self) -> usize {
        self.exponents.len() * self.targets
    }

    /// Adds the map of few `rows` scaled windows that begin `stride` values apart to `out`, one row
    /// of scaled targets per window. `scratch` holds [`Self::padded`] values per window.
    ///
    /// # Panics
    /// When a slice is too short.
    pub fn add(&self, x: &[f32], stride: usize, rows: usize, scratch: &mut [f64], out: &mut [f32]) {
        self.add_at(level(), x, stride, rows, scratch, out);
    }

    fn add_at(
        &self,
        level: Level,
        x: &[f32],
        stride: usize,
        rows: usize,
        scratch: &mut [f64],
        out: &mut [f32],
    ) {
        if rows == 0 {
            return;
        }
        self.sums(level, x, stride, rows, scratch);
        for row in 0..rows {
            let window = &x[row * stride..];
            let sums = &scratch[row * self.padded()..];
            self.combine(
                |position| window[position],
                |output| sums[output],
                None,
                &mut out[row * self.targets..(row + 1) * self.targets],
            );
        }
    }

    /// W_t x + b_t of every term, [`Self::padded`] values per row.
    fn sums(&self, level: Level, x: &[f32], stride: usize, rows: usize, scratch: &mut [f64]) {
        assert!(
            x.len() >= (rows - 1) * stride + self.inputs,
            "inputs of {rows} rows"
        );
        assert!(scratch.len() >= rows * self.padded(), "scratch of {rows} rows");
        let map = self;
        dispatch!(level, SkipKernel::few(map: &SkipKernel, x: &[f32], stride: usize, rows: usize, scratch: &mut [f64]));
    }

    /// The same for a panel: value i of the window in column c is `x[places[i] + c]`. `scratch` holds
    /// [`Self::padded`] values for each of [`PANEL`] columns.
    ///
    /// # Panics
    /// When a slice is too short or there are more columns than [`PANEL`].
    pub fn add_panel(
        &self,
        x: &[f32],
        places: &[usize],
        columns: usize,
        scratch: &mut [f64],
        out: &mut [f32],
    ) {
        self.add_panel_at(level(), x, places, columns, scratch, out);
    }

    fn add_panel_at(
        &self,
        level: Level,
        x: &[f32],
        places: &[usize],
        columns: usize,
        scratch: &mut [f64],
        out: &mut [f32],
    ) {
        self.panel_sums(level, x, places, columns, scratch);
        for column in 0..columns {
            self.combine(
                |position| x[places[position] + column],
                |output| scratch[output * PANEL + column],
                None,
                &mut out[column * self.targets..(column + 1) * self.targets],
            );
        }
    }

    /// W_t x + b_t of every term, [`PANEL`] values per output.
    fn panel_sums(&self, level: Level, x: &[f32], places: &[usize], columns: usize, scratch: &mut [f64]) {
        let computed = columns.next_multiple_of(PANEL / 2);
        assert!(computed <= PANEL, "a panel has {PANEL} columns");
        assert!(places.len() >= self.inputs, "a place for each input");
        let places = &places[..self.inputs];
        let last = places.iter().max().copied().unwrap_or(0);
        assert!(x.len() >= last + computed, "inputs of a panel");
        assert!(scratch.len() >= self.outputs() * PANEL, "scratch of a panel");
        let map = self;
        dispatch!(level, SkipKernel::many(map: &SkipKernel, x: &[f32], places: &[usize], computed: usize, scratch: &mut [f64]));
    }

    /// Σₜ mₜ times the sums of term t, added to a window's scaled targets.
    fn combine(
        &self,
        value: impl Fn(usize) -> f32,
        sum: impl Fn(usize) -> f64,
        estimate: Option<f64>,
        out: &mut [f32],
    ) {
        for (target, slot) in out.iter_mut().enumerate() {
            let total = self.total(target, f64::from(*slot), &value, &sum, estimate);
            #[allow(clippy::cast_possible_truncation, reason = "scaled estimates are f32")]
            {
                *slot = total as f32;
            }
        }
    }

    /// The same of one target, in f64.
    fn combined(
        &self,
        target: usize,
        value: impl Fn(usize) -> f32,
        sum: impl Fn(usize) -> f64,
        estimate: Option<f64>,
    ) -> f64 {
        self.total(target, 0.0, &value, &sum, estimate)
    }

    fn total(
        &self,
        target: usize,
        mut total: f64,
        value: &impl Fn(usize) -> f32,
        sum: &impl Fn(usize) -> f64,
        estimate: Option<f64>,
    ) -> f64 {
        for (term, exponents) in self.exponents.iter().enumerate() {
            let power = |(slow, &exponent): (&SlowSignal, &i32)| {
                let u = slow.gain * f64::from(value(slow.position)) + slow.shift;
                u.clamp(-1.0, 1.0).powi(exponent)
            };
            let mut factor: f64 = self.slow.iter().zip(exponents).map(power).product();
            if let (Some(estimate), Some(&exponent)) = (estimate, exponents.get(self.slow.len())) {
                factor *= estimate.clamp(-1.0, 1.0).powi(exponent);
            }
            total += factor * sum(term * self.targets + target);
        }
        total
    }

    /// Lengths were compared by the caller.
    #[inline(always)]
    unsafe fn many<S: Simd>(map: &Self, x: &[f32], places: &[usize], columns: usize, out: &mut [f64]) {
        if map.is_narrow() {
            for output in 0..map.outputs() {
                for column in (0..columns).step_by(S::LANES / 2) {
                    map.narrow_column::<S>(
                        output,
                        x.as_ptr().add(column),
                        places,
                        out.as_mut_ptr().add(column),
                    );
                }
            }
            return;
        }
        for first in (0..map.outputs()).step_by(TILE) {
            let width = TILE.min(map.outputs() - first);
            for column in (0..columns).step_by(S::LANES) {
                map.tile::<S>(
                    first,
                    width,
                    x.as_ptr().add(column),
                    places,
                    out.as_mut_ptr().add(column),
                );
            }
        }
    }

    /// Outputs `first..first + width` of two vectors of columns.
    #[inline(always)]
    unsafe fn tile<S: Simd>(
        &self,
        first: usize,
        width: usize,
        x: *const f32,
        places: &[usize],
        out: *mut f64,
    ) {
        let weights = self.tiles.as_ptr().add(first * self.inputs);
        let mut done = 0;
        while done < width {
            let (w, at) = (weights.add(done), first + done);
            let rest = width - done;
            let taken = if rest >= 12 && S::OUTPUTS_F64 >= 12 {
                self.block::<S, 12>(w, width, at, x, places, out);
                12
            } else if rest >= 6 && S::OUTPUTS_F64 >= 6 {
                self.block::<S, 6>(w, width, at, x, places, out);
                6
            } else if rest >= 3 {
                self.block::<S, 3>(w, width, at, x, places, out);
                3
            } else {
                self.block::<S, 1>(w, width, at, x, places, out);
                1
            };
            done += taken;
        }
    }

    /// R outputs of two vectors of columns, one part after the other.
    #[inline(always)]
    unsafe fn block<S: Simd, const R: usize>(
        &self,
        weights: *const f64,
        stride: usize,
        first: usize,
        x: *const f32,
        places: &[usize],
        out: *mut f64,
    ) {
        let half = S::LANES / 2;
        let mut parts = [[[S::splat_f64(0.0); 2]; R]; PARTS];
        for part in 0..PARTS {
            let mut sums = [[S::splat_f64(0.0); 2]; R];
            let mut input = part;
            while input < places.len() {
                let from = x.add(*places.get_unchecked(input));
                let values = [S::widen(from), S::widen(from.add(half))];
                let weights = weights.add(input * stride);
                for r in 0..R {
                    let weight = S::splat_f64(*weights.add(r));
                    for p in 0..2 {
                        sums[r][p] = S::fma_f64(weight, values[p], sums[r][p]);
                    }
                }
                input += PARTS;
            }
            parts[part] = sums;
        }
        for r in 0..R {
            let bias = S::splat_f64(self.bias[first + r]);
            for p in 0..2 {
                let [a, b, c, d] = [parts[0][r][p], parts[1][r][p], parts[2][r][p], parts[3][r][p]];
                let sum = S::add_f64(S::add_f64(a, b), S::add_f64(c, d));
                S::store_f64(out.add((first + r) * PANEL + p * half), S::add_f64(sum, bias));
            }
        }
    }

    /// Lengths were compared by the caller.
    #[inline(always)]
    unsafe fn few<S: Simd>(map: &Self, x: &[f32], stride: usize, rows: usize, out: &mut [f64]) {
        if map.is_narrow() {
            let mut row = 0;
            while row < rows {
                let (from, to) = (
                    x.as_ptr().add(row * stride),
                    out.as_mut_ptr().add(row * map.padded()),
                );
                let is_block = rows - row >= S::ROWS;
                for output in 0..map.outputs() {
                    match (is_block, S::ROWS) {
                        (true, 6) => map.narrow_rows::<S, 6>(output, from, stride, to),
                        (true, _) => map.narrow_rows::<S, 4>(output, from, stride, to),
                        _ => map.narrow_rows::<S, 1>(output, from, stride, to),
                    }
                }
                row += if is_block { S::ROWS } else { 1 };
            }
            return;
        }
        let half = S::LANES / 2;
        for row in 0..rows {
            let x = x.as_ptr().add(row * stride);
            for first in (0..map.padded()).step_by(half) {
                let weights = map
                    .groups
                    .as_ptr()
                    .cast::<f64>()
                    .add(first / GROUP * map.inputs * GROUP + first % GROUP);
                let mut sums = [S::splat_f64(0.0); PARTS];
                let whole = map.inputs - map.inputs % PARTS;
                for input in (0..whole).step_by(PARTS) {
                    for part in 0..PARTS {
                        let value = S::splat_f64(f64::from(*x.add(input + part)));
                        sums[part] = S::fma_f64(
                            value,
                            S::load_f64(weights.add((input + part) * GROUP)),
                            sums[part],
                        );
                    }
                }
                for part in 0..map.inputs - whole {
                    let value = S::splat_f64(f64::from(*x.add(whole + part)));
                    sums[part] = S::fma_f64(
                        value,
                        S::load_f64(weights.add((whole + part) * GROUP)),
                        sums[part],
                    );
                }
                let sum = S::add_f64(S::add_f64(sums[0], sums[1]), S::add_f64(sums[2], sums[3]));
                let bias = S::load_f64(map.bias.as_ptr().add(first));
                S::store_f64(
                    out.as_mut_ptr().add(row * map.padded() + first),
                    S::add_f64(sum, bias),
                );
            }
        }
    }

    /// One of few outputs for one vector of columns.
    #[inline(always)]
    unsafe fn narrow_column<S: Simd>(&self, output: usize, x: *const f32, places: &[usize], out: *mut f64) {
        let mut sums = [S::splat_f64(0.0); NARROW_PARTS];
        let stride = self.inputs.next_multiple_of(NARROW_PARTS);
        let mut weights = self.tiles.as_ptr().add(output * stride);
        let (whole, rest) = places.as_chunks::<NARROW_PARTS>();
        for places in whole {
            for part in 0..NARROW_PARTS {
                let value = S::widen(x.add(places[part]));
                sums[part] = S::fma_f64(S::splat_f64(*weights.add(part)), value, sums[part]);
            }
            weights = weights.add(NARROW_PARTS);
        }
        for (part, &place) in rest.iter().enumerate() {
            let value = S::widen(x.add(place));
            sums[part] = S::fma_f64(S::splat_f64(*weights.add(part)), value, sums[part]);
        }
        // As halves of a vector are added, see `Simd::sum`.
        for half in [4, 2, 1] {
            for part in 0..half {
                sums[part] = S::add_f64(sums[part], sums[part + half]);
            }
        }
        let bias = S::splat_f64(self.bias[output]);
        S::store_f64(out.add(output * PANEL), S::add_f64(sums[0], bias));
    }

    /// One of few outputs for R rows.
    #[inline(always)]
    unsafe fn narrow_rows<S: Simd, const R: usize>(
        &self,
        output: usize,
        x: *const f32,
        stride: usize,
        out: *mut f64,
    ) {
        let weights = self
            .tiles
            .as_ptr()
            .add(output * self.inputs.next_multiple_of(NARROW_PARTS));
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

    /// `weights · row` for R rows, in [`NARROW_PARTS`] parts, V vectors of them.
    #[inline(always)]
    unsafe fn dots<S: Simd, const R: usize, const V: usize>(
        &self,
        weights: *const f64,
        x: *const f32,
        stride: usize,
        totals: &mut [f64; R],
    ) {
        let half = S::LANES / 2;
        let mut sums = [[S::splat_f64(0.0); V]; R];
        let whole = self.inputs - self.inputs % NARROW_PARTS;
        for input in (0..whole).step_by(NARROW_PARTS) {
            for v in 0..V {
                let lanes = S::load_f64(weights.add(input + v * half));
                for r in 0..R {
                    let values = S::widen(x.add(r * stride + input + v * half));
                    sums[r][v] = S::fma_f64(lanes, values, sums[r][v]);
                }
            }
        }
        for v in 0..V {
            let input = whole + v * half;
            if input < self.inputs {
                let count = (self.inputs - input).min(half);
                let lanes = S::load_f64(weights.add(input));
                for r in 0..R {
                    let values = S::widen_first(x.add(r * stride + input), count);
                    sums[r][v] = S::fma_f64(lanes, values, sums[r][v]);
                }
            }
        }
        for r in 0..R {
            let mut count = V / 2;
            while count > 0 {
                for v in 0..count {
                    sums[r][v] = S::add_f64(sums[r][v], sums[r][v + count]);
                }
                count /= 2;
            }
            totals[r] = S::sum_f64(sums[r][0]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channel(offset: f64, scale: f64) -> ScaledChannel {
        ScaledChannel {
            name: String::new(),
            unit: String::new(),
            offset,
            scale,
        }
    }

    #[test]
    fn it_agrees_with_the_definition_beyond_the_range_too() {
        // 11 samples of two channels, three terms, two targets; the slow signal is channel 1.
        let (size, targets) = (22, 2);
        let value = |i: usize| ((i * 2_654_435_761) % 1000) as f64 / 500.0 - 1.0;
        let map = SkipWeights {
            weight: (0..6 * size).map(value).collect(),
            bias: (900..906).map(value).collect(),
        };
        let schedule = Schedule {
            inputs: vec![1],
            centre: vec![0.5],
            half_range: vec![0.8],
            exponents: vec![vec![0], vec![1], vec![2]],
        };
        let channels = [channel(0.0, 1.0), channel(0.3, 1.5)];
        let kernel = SkipKernel::new(&map, Some(&schedule), &channels, targets);
        let x: Vec<f32> = (300..300 + 7 * 2 + size).map(|i| value(i) as f32).collect();
        let rows = 8;
        let mut scratch = vec![0.0; rows * kernel.padded()];
        let mut out = vec![1.0; rows * targets];
        kernel.add(&x, 2, rows, &mut scratch, &mut out);
        let mut clamped = 0;
        for row in 0..rows {
            let window = &x[row * 2..row * 2 + size];
            let length = 0.3 + 1.5 * f64::from(window[size - 1]);
            let u = (length - 0.5) / 0.8;
            clamped += usize::from(u.abs() > 1.0);
            let u = u.clamp(-1.0, 1.0);
            for t in 0..targets {
                let expected: f64 = (0..3)
                    .map(|term| {
                        let r = term * targets + t;
                        let linear: f64 = (0..size)
                            .map(|i| map.weight[r * size + i] * f64::from(window[i]))
                            .sum();
                        u.powi(i32::try_from(term).unwrap()) * (linear + map.bias[r])
                    })
                    .sum::<f64>()
                    + 1.0;
                // A sum in f64, rounded to f32; it is below ten.
                assert!(
                    (f64::from(out[row * targets + t]) - expected).abs() < 1e-6,
                    "row {row}"
                );
            }
        }
        assert!(clamped > 0, "the test should leave the range");
        // Side by side: value i of window c is x[i + 2 c]; columns of samples make that a panel.
        let mut panel = vec![0.0; size * PANEL];
        super::super::panel::transpose(&x, 2, rows, size, &mut panel);
        let places: Vec<usize> = (0..size).map(|i| i * PANEL).collect();
        for level in [level(), Level::Portable] {
            let (mut few, mut many) = (vec![1.0; rows * targets], vec![1.0; rows * targets]);
            let mut scratch = vec![0.0; PANEL * kernel.padded()];
            kernel.add_at(level, &x, 2, rows, &mut scratch, &mut few);
            kernel.add_panel_at(level, &panel, &places, rows, &mut scratch, &mut many);
            assert_eq!(few, many, "{level:?}");
        }
    }

    /// A map of six inputs and so many outputs, for three terms.
    fn of_three_terms(outputs: usize, channels: usize, targets: usize) -> SkipKernel {
        let map = SkipWeights {
            weight: vec![1.0; outputs * 6],
            bias: vec![0.0; outputs],
        };
        let schedule = Schedule {
            inputs: vec![0],
            centre: vec![0.0],
            half_range: vec![1.0],
            exponents: vec![vec![0], vec![1], vec![2]],
        };
        SkipKernel::new(&map, Some(&schedule), &vec![channel(0.0, 1.0); channels], targets)
    }

    #[test]
    #[should_panic(expected = "one output for each term of each target")]
    fn a_map_of_too_few_outputs_is_refused() {
        assert_eq!(of_three_terms(6, 2, 2).padded(), 8);
        let _ = of_three_terms(5, 2, 2);
    }

    #[test]
    #[should_panic(expected = "a window has a sample of every channel")]
    fn a_window_of_less_than_a_sample_is_refused() {
        let _ = of_three_terms(6, 7, 2);
    }

    #[test]
    fn constant_coefficients_agree_with_the_definition_and_have_the_same_bits_both_ways() {
        for (size, targets, rows) in [(300, 1, 32), (37, 3, 9), (8, 4, 1), (5, 2, 17)] {
            let value = |i: usize| ((i * 2_654_435_761) % 1000) as f64 / 500.0 - 1.0;
            let map = SkipWeights {
                weight: (0..targets * size).map(value).collect(),
                bias: (900..900 + targets).map(value).collect(),
            };
            let kernel = SkipKernel::new(&map, None, &[channel(0.0, 1.0)], targets);
            assert!(kernel.is_narrow());
            let x: Vec<f32> = (300..300 + rows * size).map(|i| value(i) as f32).collect();
            let mut panel = vec![f32::NAN; size * PANEL];
            super::super::panel::transpose(&x, size, rows, size, &mut panel);
            let places: Vec<usize> = (0..size).map(|i| i * PANEL).collect();
            for level in [level(), Level::Avx2, Level::Portable] {
                if level == Level::Avx2 && super::level() == Level::Portable {
                    continue;
                }
                let (mut few, mut many) = (vec![1.0; rows * targets], vec![1.0; rows * targets]);
                let mut scratch = vec![0.0; PANEL * kernel.padded()];
                kernel.add_at(level, &x, size, rows, &mut scratch, &mut few);
                kernel.add_panel_at(level, &panel, &places, rows, &mut scratch, &mut many);
                assert_eq!(few, many, "{level:?}");
                for (place, &found) in few.iter().enumerate() {
                    let (row, t) = (place / targets, place % targets);
                    let expected: f64 = (0..size)
                        .map(|i| map.weight[t * size + i] * f64::from(x[row * size + i]))
                        .sum::<f64>()
                        + map.bias[t]
                        + 1.0;
                    // A sum in f64, rounded to f32; it is below 300.
                    assert!((f64::from(found) - expected).abs() < 2e-5, "{level:?}, row {row}");
                }
            }
        }
    }
}
