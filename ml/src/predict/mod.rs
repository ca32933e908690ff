//! Estimates from a trained model, off the tensor framework.
//!
//! The kernel is deterministic for a given instruction set and allocates nothing: callers bring a
//! [`Workspace`]. A window of row-major samples is a slice, and neighbouring windows of a series
//! overlap in memory, so sliding over a recording copies nothing either.

pub mod kernel;
pub mod skip;
pub mod guard;
pub mod sliding;
pub mod synthetic;

use crate::model::weights::{Auxiliary, LinearWeights, Weights};
use crate::scaling::Scaling;
use guard::GuardKernel;
use hydroflex_openapi::model::{Activation, EnvelopeGroup, IntervalTable, ModelConfig};
use kernel::PackedLayer;
use skip::SkipKernel;

/// Rows computed at once; activations of a block stay in the second-level cache.
const BLOCK_ROWS: usize = 48;

/// A model ready to estimate. Shared between threads; each brings its own [`Workspace`].
#[derive(Debug, Clone, PartialEq)]
pub struct Predictor {
    steps: usize,
    inputs: Scaling,
    /// Offset and 1 / scale of every value of one sample row.
    input_maps: Vec<(f64, f64)>,
    targets: Scaling,
    /// Scaled values at which inputs are held; infinite where they are not.
    limits: Vec<[f64; 2]>,
    /// First to last; none when the skip is the whole model.
    layers: Vec<PackedLayer>,
    skip: Option<SkipKernel>,
    guard: Option<GuardKernel>,
    intervals: Vec<IntervalTable>,
    envelope: Option<EnvelopeKernel>,
}

#[derive(Debug, Clone, PartialEq)]
struct EnvelopeKernel {
    projection: PackedLayer,
    groups: Vec<EnvelopeGroup>,
    min: Vec<f64>,
    max: Vec<f64>,
}

/// Scratch memory of one thread.
#[derive(Debug, Clone)]
pub struct Workspace {
    window: Vec<f32>,
    scaled: Vec<f32>,
    ping: Vec<f32>,
    pong: Vec<f32>,
    skip: Vec<f64>,
    guide: Vec<f32>,
    /// Whether the guard changed an estimate of each window of the last block.
    limited: Vec<bool>,
    projected: Vec<f32>,
}

/// Estimates of a recording: row k of every column belongs to sample `first_row + k`.
#[derive(Debug, Clone, PartialEq)]
pub struct SeriesEstimates {
    /// First sample with an estimate: window steps − 1.
    pub first_row: usize,
    /// One column per target, in the column's unit.
    pub columns: Vec<Vec<f64>>,
    /// Whether the window is inside the model's envelope; empty when it has none.
    pub inside: Vec<bool>,
}

/// Mean square of the coordinates of each group.
pub fn group_squares<'a>(
    groups: &'a [EnvelopeGroup],
    coordinates: &'a [f32],
) -> impl Iterator<Item = f64> + 'a {
    let mut rest = coordinates;
    groups.iter().map(move |group| {
        let (head, tail) = rest.split_at(group.components);
        rest = tail;
        let sum: f64 = head.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
        sum / group.components.max(1) as f64
    })
}

fn scaled_limits(config: &ModelConfig) -> Vec<[f64; 2]> {
    let limits = |input: usize| {
        let channel = &config.inputs[input];
        config
            .input_limits
            .get(input)
            .map_or([f64::NEG_INFINITY, f64::INFINITY], |limits| {
                limits.map(|value| (value - channel.offset) / channel.scale)
            })
    };
    (0..config.inputs.len()).map(limits).collect()
}

/// Layers with nothing between them are one linear map: `W₂ (W₁ x + b₁) + b₂ = (W₂ W₁) x + (W₂ b₁ + b₂)`,
/// multiplied in f64. Folded where that makes the network smaller.
fn fold(config: &ModelConfig, weights: &Weights) -> Vec<(Vec<Activation>, LinearWeights)> {
    let mut folded: Vec<(Vec<Activation>, LinearWeights)> = Vec::with_capacity(config.layers.len());
    for (layer, map) in config.layers.iter().zip(&weights.layers) {
        if let Some((activations, before)) = folded.last_mut()
            && activations.is_empty()
        {
            let (inner, outputs) = (before.bias.len(), map.bias.len());
            let inputs = before.weight.len() / inner;
            if inputs * outputs <= inputs * inner + inner * outputs {
                *before = compose(before, map, inputs);
                activations.clone_from(&layer.activations);
                continue;
            }
        }
        folded.push((layer.activations.clone(), map.clone()));
    }
    folded
}

#[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
fn compose(first: &LinearWeights, second: &LinearWeights, inputs: usize) -> LinearWeights {
    let inner = first.bias.len();
    let mut weight = Vec::with_capacity(second.bias.len() * inputs);
    let mut bias = Vec::with_capacity(second.bias.len());
    for (row, &offset) in second.weight.chunks_exact(inner).zip(&second.bias) {
        let mut sums = vec![0.0_f64; inputs];
        let mut constant = f64::from(offset);
        for ((&factor, from), &b) in row.iter().zip(first.weight.chunks_exact(inputs)).zip(&first.bias) {
            let factor = f64::from(factor);
            constant += factor * f64::from(b);
            for (sum, &w) in sums.iter_mut().zip(from) {
                *sum += factor * f64::from(w);
            }
        }
        weight.extend(sums.into_iter().map(|sum| sum as f32));
        bias.push(constant as f32);
    }
    LinearWeights { weight, bias }
}

impl Predictor {
    /// Packs a model's weights.
    #[must_use]
    pub fn new(config: &ModelConfig, weights: &Weights, auxiliary: &Auxiliary) -> Self {
        let layers = fold(config, weights)
            .iter()
            .map(|(activations, map)| PackedLayer::new(map, activations))
            .collect();
        let skip = weights.skip.as_ref().map(|map| {
            SkipKernel::new(
                map,
                config.schedule.as_ref(),
                &config.inputs,
                config.targets.len(),
            )
        });
        let guard = config
            .guard
            .as_ref()
            .zip(weights.guard.as_ref())
            .map(|(guard, guide)| GuardKernel::new(guide, guard, &config.targets));
        let envelope = config
            .envelope
            .as_ref()
            .zip(auxiliary.envelope.as_ref())
            .map(|(envelope, map)| EnvelopeKernel {
                projection: PackedLayer::new(map, &[]),
                groups: envelope.groups.clone(),
                min: envelope.min.clone(),
                max: envelope.max.clone(),
            });
        Self {
            steps: config.window_steps,
            inputs: Scaling::from_config(&config.inputs),
            input_maps: config
                .inputs
                .iter()
                .map(|channel| (channel.offset, channel.scale.recip()))
                .collect(),
            targets: Scaling::from_config(&config.targets),
            limits: scaled_limits(config),
            layers,
            skip,
            guard,
            intervals: config.intervals.clone(),
            envelope,
        }
    }

    /// Samples in a window.
    #[must_use]
    pub fn window_steps(&self) -> usize {
        self.steps
    }

    /// Channels in.
    #[must_use]
    pub fn input_count(&self) -> usize {
        self.inputs.len()
    }

    /// Channels out.
    #[must_use]
    pub fn target_count(&self) -> usize {
        self.targets.len()
    }

    /// Values in a window.
    #[must_use]
    pub fn window_len(&self) -> usize {
        self.steps * self.inputs.len()
    }

    /// Whether the model knows the region that it was trained on.
    #[must_use]
    pub fn has_envelope(&self) -> bool {
        self.envelope.is_some()
    }

    /// Whether estimates come with intervals.
    #[must_use]
    pub fn has_intervals(&self) -> bool {
        self.intervals.len() == self.targets.len()
    }

    /// Scratch memory for one thread.
    #[must_use]
    pub fn workspace(&self) -> Workspace {
        let widest = self.layers.iter().map(PackedLayer::padded).max().unwrap_or(0);
        Workspace {
            window: vec![0.0; BLOCK_ROWS * self.window_len()],
            scaled: vec![0.0; BLOCK_ROWS * self.targets.len()],
            ping: vec![0.0; BLOCK_ROWS * widest],
            pong: vec![0.0; BLOCK_ROWS * widest],
            skip: vec![0.0; BLOCK_ROWS * self.skip.as_ref().map_or(0, SkipKernel::padded)],
            guide: vec![0.0; BLOCK_ROWS * self.guard.as_ref().map_or(0, GuardKernel::padded)],
            limited: vec![false; BLOCK_ROWS],
            projected: vec![
                0.0;
                self.envelope
                    .as_ref()
                    .map_or(0, |e| BLOCK_ROWS * e.projection.padded())
            ],
        }
    }

    /// Estimates for one window (`window_steps` rows of the inputs, row by row, in the columns'
    /// units), in the columns' units.
    ///
    /// # Panics
    /// When a slice has another length.
    pub fn predict_window(&self, window: &[f64], out: &mut [f64], workspace: &mut Workspace) {
        assert_eq!(window.len(), self.window_len(), "values of a window");
        self.predict_windows(window, out, workspace);
    }

    /// Estimates for windows that stand one after the other, each as in [`Self::predict_window`];
    /// `out` has one row of targets per window.
    ///
    /// # Panics
    /// When a slice has another length.
    pub fn predict_windows<T: Copy + Into<f64>>(
        &self,
        windows: &[T],
        out: &mut [f64],
        workspace: &mut Workspace,
    ) {
        self.predict_windows_with(windows, out, None, workspace);
    }

    /// As [`Self::predict_windows`], and for each window whether it is inside the envelope, if
    /// asked for; every window is inside when the model has none.
    ///
    /// # Panics
    /// When a slice has another length.
    pub fn predict_windows_with<T: Copy + Into<f64>>(
        &self,
        windows: &[T],
        out: &mut [f64],
        mut inside: Option<&mut [bool]>,
        workspace: &mut Workspace,
    ) {
        let size = self.window_len();
        let targets = self.targets.len();
        assert_eq!(windows.len() % size, 0, "whole windows");
        let count = windows.len() / size;
        assert_eq!(out.len(), count * targets, "one row of estimates per window");
        assert!(
            inside.as_ref().is_none_or(|inside| inside.len() == count),
            "one flag per window"
        );
        let mut scaled = std::mem::take(&mut workspace.window);
        for (block, samples) in windows.chunks(BLOCK_ROWS * size).enumerate() {
            let rows = samples.len() / size;
            let first = block * BLOCK_ROWS;
            self.scale_rows(samples, &mut scaled);
            self.block(&scaled, size, rows, workspace);
            self.unscale(
                rows,
                &mut out[first * targets..(first + rows) * targets],
                workspace,
            );
            if let Some(inside) = inside.as_deref_mut() {
                let inside = &mut inside[first..first + rows];
                self.inside_block(&scaled, size, rows, inside, workspace);
                for (flag, window) in inside.iter_mut().zip(samples.chunks_exact(size)) {
                    *flag &= self.in_range(window);
                }
            }
        }
        workspace.window = scaled;
    }

    /// Scaled estimates for windows of scaled values that begin `stride` values apart: the network
    /// alone. `out` has one row of targets per window.
    ///
    /// # Panics
    /// When a slice has another length.
    pub fn predict_scaled(
        &self,
        scaled: &[f32],
        stride: usize,
        rows: usize,
        out: &mut [f32],
        workspace: &mut Workspace,
    ) {
        let targets = self.targets.len();
        assert_eq!(out.len(), rows * targets, "one row of estimates per window");
        for first in (0..rows).step_by(BLOCK_ROWS) {
            let block = BLOCK_ROWS.min(rows - first);
            self.block(&scaled[first * stride..], stride, block, workspace);
            out[first * targets..(first + block) * targets]
                .copy_from_slice(&workspace.scaled[..block * targets]);
        }
    }

    /// Estimates for a recording, the window sliding by one sample: one column of equal length per
    /// input, in the columns' units. Shorter than a window gives no estimate.
    ///
    /// # Panics
    /// When columns differ in length or number.
    #[must_use]
    pub fn predict_series(&self, columns: &[&[f64]]) -> SeriesEstimates {
        let mut workspace = self.workspace();
        self.predict_series_with(columns, &mut workspace)
    }

    /// As [`Self::predict_series`], with the caller's workspace.
    ///
    /// # Panics
    /// When columns differ in length or number.
    #[must_use]
    pub fn predict_series_with(&self, columns: &[&[f64]], workspace: &mut Workspace) -> SeriesEstimates {
        assert_eq!(columns.len(), self.inputs.len(), "one column per input");
        let rows = columns[0].len();
        assert!(columns.iter().all(|c| c.len() == rows), "columns of one length");
        let width = self.inputs.len();
        let mut scaled = vec![0.0_f32; rows * width];
        for (channel, (column, (offset, inverse))) in columns.iter().zip(&self.input_maps).enumerate() {
            let slots = scaled.iter_mut().skip(channel).step_by(width);
            for (value, slot) in column.iter().zip(slots) {
                #[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
                {
                    *slot = ((value - offset) * inverse)
                        .clamp(self.limits[channel][0], self.limits[channel][1])
                        as f32;
                }
            }
        }
        let count = (rows + 1).saturating_sub(self.steps);
        let targets = self.targets.len();
        let mut estimates = vec![Vec::with_capacity(count); targets];
        let mut inside = vec![true; if self.envelope.is_some() { count } else { 0 }];
        let mut first = 0;
        while first < count {
            let block = BLOCK_ROWS.min(count - first);
            let x = &scaled[first * width..];
            self.block(x, width, block, workspace);
            for row in workspace.scaled[..block * targets].chunks(targets) {
                for (t, (column, &value)) in estimates.iter_mut().zip(row).enumerate() {
                    column.push(self.targets.unscale(t, f64::from(value)));
                }
            }
            if !inside.is_empty() {
                self.inside_block(x, width, block, &mut inside[first..first + block], workspace);
            }
            first += block;
        }
        self.outside_range(columns, &mut inside);
        SeriesEstimates {
            first_row: self.steps - 1,
            columns: estimates,
            inside,
        }
    }

    /// Half width of the 90 % interval around an estimate; absent when the model has none.
    #[must_use]
    pub fn half_width(&self, target: usize, estimate: f64) -> Option<f64> {
        let table = self.intervals.get(target)?;
        let distance = (estimate - table.centre).abs();
        let class = table.upper_edges.partition_point(|&edge| edge < distance);
        table.half_widths.get(class).copied()
    }

    /// Estimates for scaled windows that begin `stride` values apart, one row of scaled targets per
    /// window in `workspace.scaled`.
    fn block(&self, x: &[f32], stride: usize, rows: usize, workspace: &mut Workspace) {
        let targets = self.targets.len();
        let Workspace {
            scaled,
            ping,
            pong,
            skip,
            guide,
            limited,
            ..
        } = workspace;
        let scaled = &mut scaled[..rows * targets];
        if let Some((layer, others)) = self.layers.split_first() {
            layer.forward(x, stride, rows, ping);
            let (mut from, mut to) = (ping, pong);
            let mut width = layer.padded();
            for layer in others {
                layer.forward(from, width, rows, to);
                width = layer.padded();
                std::mem::swap(&mut from, &mut to);
            }
            for (row, out) in scaled.chunks_mut(targets).enumerate() {
                out.copy_from_slice(&from[row * width..][..targets]);
            }
        } else {
            scaled.fill(0.0);
        }
        if let Some(kernel) = &self.skip {
            kernel.add(x, stride, rows, skip, scaled);
        }
        if let Some(kernel) = &self.guard {
            kernel.limit(x, stride, rows, guide, scaled, limited);
        }
    }

    /// Whether each of the windows that [`Self::block`] estimated last is near the training windows: inside the
    /// envelope, and its estimate not limited. Ranges are not looked at.
    fn inside_block(
        &self,
        x: &[f32],
        stride: usize,
        rows: usize,
        inside: &mut [bool],
        workspace: &mut Workspace,
    ) {
        let Some(envelope) = &self.envelope else {
            inside.fill(true);
            return;
        };
        envelope
            .projection
            .forward(x, stride, rows, &mut workspace.projected);
        let padded = envelope.projection.padded();
        let rows = workspace.projected[..rows * padded].chunks(padded);
        for (flag, row) in inside.iter_mut().zip(rows) {
            *flag = group_squares(&envelope.groups, row)
                .zip(&envelope.groups)
                .all(|(square, group)| square <= group.limit);
        }
        for (flag, limited) in inside.iter_mut().zip(&workspace.limited) {
            *flag &= !limited;
        }
    }

    /// Whether every value of these sample rows is in the range of its channel.
    fn in_range<T: Copy + Into<f64>>(&self, rows: &[T]) -> bool {
        let Some(envelope) = &self.envelope else {
            return true;
        };
        rows.chunks_exact(self.inputs.len()).all(|row| {
            row.iter()
                .zip(&envelope.min)
                .zip(&envelope.max)
                .all(|((&value, min), max)| {
                    let value: f64 = value.into();
                    value >= *min && value <= *max
                })
        })
    }

    /// Clears `inside` for every window that holds a value outside its channel's range.
    fn outside_range(&self, columns: &[&[f64]], inside: &mut [bool]) {
        let Some(envelope) = &self.envelope else { return };
        for ((column, min), max) in columns.iter().zip(&envelope.min).zip(&envelope.max) {
            let mut blocked_until = 0;
            for (row, value) in column.iter().enumerate() {
                if !(value >= min && value <= max) {
                    blocked_until = row + self.steps;
                }
                if row + 1 >= self.steps && row < blocked_until {
                    inside[row + 1 - self.steps] = false;
                }
            }
        }
    }

    /// Scaled copies of sample rows.
    #[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
    fn scale_rows<T: Copy + Into<f64>>(&self, rows: &[T], out: &mut [f32]) {
        let width = self.inputs.len();
        for (row, slots) in rows.chunks_exact(width).zip(out.chunks_exact_mut(width)) {
            let maps = self.input_maps.iter().zip(&self.limits);
            for ((&value, slot), ((offset, inverse), [low, high])) in row.iter().zip(slots).zip(maps) {
                *slot = ((value.into() - offset) * inverse).clamp(*low, *high) as f32;
            }
        }
    }

    fn unscale(&self, rows: usize, out: &mut [f64], workspace: &Workspace) {
        let targets = self.targets.len();
        for (estimates, row) in out
            .chunks_mut(targets)
            .zip(workspace.scaled[..rows * targets].chunks(targets))
        {
            for (t, (slot, &value)) in estimates.iter_mut().zip(row).enumerate() {
                *slot = self.targets.unscale(t, f64::from(value));
            }
        }
    }
}
