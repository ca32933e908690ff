//! Estimates from a trained model, off the tensor framework.
//!
//! The kernel is deterministic for a given instruction set and allocates nothing: callers bring a
//! [`Workspace`]. A window of row-major samples is a slice, and neighbouring windows of a series
//! overlap in memory, so sliding over a recording copies nothing either.

pub mod kernel;
pub mod skip;

use crate::model::weights::{Auxiliary, Weights};
use crate::scaling::Scaling;
use hydroflex_openapi::model::{EnvelopeGroup, IntervalTable, ModelConfig};
use kernel::PackedLayer;
use skip::SkipKernel;

/// Rows computed at once; activations of a block stay in the second-level cache.
const BLOCK_ROWS: usize = 48;

/// A model ready to estimate. Shared between threads; each brings its own [`Workspace`].
#[derive(Debug, Clone, PartialEq)]
pub struct Predictor {
    steps: usize,
    inputs: Scaling,
    targets: Scaling,
    /// Scaled values at which inputs are held; infinite where they are not.
    limits: Vec<[f64; 2]>,
    /// First to last; none when the skip is the whole model.
    layers: Vec<PackedLayer>,
    skip: Option<SkipKernel>,
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
    /// Windows as the network and as the skip take them.
    window: Scaled,
    /// Estimates, scaled.
    estimates: Vec<f64>,
    ping: Vec<f32>,
    pong: Vec<f32>,
    skip: Vec<f64>,
    projected: Vec<f32>,
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
    let scaled = |input: usize, value: f64| {
        let channel = &config.inputs[input];
        (value - channel.offset) / channel.scale
    };
    (0..config.inputs.len())
        .map(|input| {
            config
                .input_limits
                .get(input)
                .map_or([f64::NEG_INFINITY, f64::INFINITY], |limits| {
                    limits.map(|value| scaled(input, value))
                })
        })
        .collect()
}

/// Scaled values in both precisions.
#[derive(Debug, Clone, Default)]
struct Scaled {
    single: Vec<f32>,
    double: Vec<f64>,
}

impl Scaled {
    fn resize(&mut self, values: usize) {
        self.single.resize(values, 0.0);
        self.double.resize(values, 0.0);
    }
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

impl Predictor {
    /// Packs a model's weights.
    #[must_use]
    pub fn new(config: &ModelConfig, weights: &Weights, auxiliary: &Auxiliary) -> Self {
        let layers = config
            .layers
            .iter()
            .zip(&weights.layers)
            .map(|(layer, map)| PackedLayer::new(map, &layer.activations))
            .collect();
        let skip = weights.skip.as_ref().map(|map| {
            SkipKernel::new(
                map,
                config.schedule.as_ref(),
                &config.inputs,
                config.targets.len(),
            )
        });
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
            targets: Scaling::from_config(&config.targets),
            limits: scaled_limits(config),
            layers,
            skip,
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
            window: Scaled::default(),
            estimates: vec![0.0; BLOCK_ROWS * self.targets.len()],
            ping: vec![0.0; BLOCK_ROWS * widest],
            pong: vec![0.0; BLOCK_ROWS * widest],
            skip: vec![0.0; BLOCK_ROWS * self.skip.as_ref().map_or(0, SkipKernel::padded)],
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
        assert_eq!(out.len(), self.targets.len(), "one estimate per target");
        let mut scaled = std::mem::take(&mut workspace.window);
        scaled.resize(window.len());
        self.scale_rows(window, &mut scaled);
        self.block(&scaled, 0, window.len(), 1, workspace);
        workspace.window = scaled;
        self.unscale(1, out, workspace);
    }

    /// Estimates for windows that stand one after the other, each as in [`Self::predict_window`];
    /// `out` has one row of targets per window.
    ///
    /// # Panics
    /// When a slice has another length.
    pub fn predict_windows(&self, windows: &[f64], out: &mut [f64], workspace: &mut Workspace) {
        let size = self.window_len();
        assert_eq!(windows.len() % size, 0, "whole windows");
        assert_eq!(
            out.len(),
            windows.len() / size * self.targets.len(),
            "one row of estimates per window"
        );
        let mut scaled = std::mem::take(&mut workspace.window);
        scaled.resize(BLOCK_ROWS * size);
        for (block, estimates) in windows
            .chunks(BLOCK_ROWS * size)
            .zip(out.chunks_mut(BLOCK_ROWS * self.targets.len()))
        {
            self.scale_rows(block, &mut scaled);
            let rows = block.len() / size;
            self.block(&scaled, 0, size, rows, workspace);
            self.unscale(rows, estimates, workspace);
        }
        workspace.window = scaled;
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
        let mut scaled = Scaled::default();
        scaled.resize(rows * width);
        for (channel, column) in columns.iter().enumerate() {
            for (row, &value) in column.iter().enumerate() {
                self.scale_value(channel, value, &mut scaled, row * width + channel);
            }
        }
        let count = (rows + 1).saturating_sub(self.steps);
        let targets = self.targets.len();
        let mut estimates = vec![Vec::with_capacity(count); targets];
        let mut inside = Vec::with_capacity(if self.envelope.is_some() { count } else { 0 });
        let mut first = 0;
        while first < count {
            let block = BLOCK_ROWS.min(count - first);
            self.block(&scaled, first * width, width, block, workspace);
            for row in workspace.estimates[..block * targets].chunks(targets) {
                for (t, (column, &value)) in estimates.iter_mut().zip(row).enumerate() {
                    column.push(self.targets.unscale(t, value));
                }
            }
            let x = &scaled.single[first * width..];
            self.inside_block(x, width, block, &mut inside, workspace);
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

    /// Whether one window (as in [`Self::predict_window`]) is inside the envelope; absent when the
    /// model has none.
    pub fn window_inside(&self, window: &[f64], workspace: &mut Workspace) -> Option<bool> {
        let envelope = self.envelope.as_ref()?;
        let width = self.inputs.len();
        let in_range = window.chunks(width).all(|row| {
            row.iter()
                .zip(&envelope.min)
                .zip(&envelope.max)
                .all(|((v, min), max)| v >= min && v <= max)
        });
        let mut scaled = std::mem::take(&mut workspace.window);
        scaled.resize(window.len());
        self.scale_rows(window, &mut scaled);
        let mut inside = Vec::with_capacity(1);
        self.inside_block(&scaled.single, window.len(), 1, &mut inside, workspace);
        workspace.window = scaled;
        Some(in_range && inside == [true])
    }

    /// Estimates for scaled windows that begin at value `first` and `stride` values apart, one row of
    /// scaled targets per window in `workspace.estimates`.
    fn block(&self, scaled: &Scaled, first: usize, stride: usize, rows: usize, workspace: &mut Workspace) {
        let targets = self.targets.len();
        let Workspace {
            estimates,
            ping,
            pong,
            skip,
            ..
        } = workspace;
        let estimates = &mut estimates[..rows * targets];
        if let Some((layer, others)) = self.layers.split_first() {
            layer.forward(&scaled.single[first..], stride, rows, ping);
            let (mut from, mut to) = (ping, pong);
            let mut width = layer.padded();
            for layer in others {
                layer.forward(from, width, rows, to);
                width = layer.padded();
                std::mem::swap(&mut from, &mut to);
            }
            for (row, out) in estimates.chunks_mut(targets).enumerate() {
                for (slot, &value) in out.iter_mut().zip(&from[row * width..]) {
                    *slot = f64::from(value);
                }
            }
        } else {
            estimates.fill(0.0);
        }
        if let Some(kernel) = &self.skip {
            kernel.add(&scaled.double[first..], stride, rows, skip, estimates);
        }
    }

    fn inside_block(
        &self,
        x: &[f32],
        stride: usize,
        rows: usize,
        inside: &mut Vec<bool>,
        workspace: &mut Workspace,
    ) {
        let Some(envelope) = &self.envelope else { return };
        envelope
            .projection
            .forward(x, stride, rows, &mut workspace.projected);
        let padded = envelope.projection.padded();
        for row in workspace.projected[..rows * padded].chunks(padded) {
            inside.push(
                group_squares(&envelope.groups, row)
                    .zip(&envelope.groups)
                    .all(|(square, group)| square <= group.limit),
            );
        }
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

    fn scale_rows(&self, rows: &[f64], out: &mut Scaled) {
        let width = self.inputs.len();
        for (position, &value) in rows.iter().enumerate() {
            self.scale_value(position % width, value, out, position);
        }
    }

    #[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
    fn scale_value(&self, channel: usize, value: f64, out: &mut Scaled, position: usize) {
        let [low, high] = self.limits[channel];
        let scaled = self.inputs.scale(channel, value).clamp(low, high);
        out.double[position] = scaled;
        out.single[position] = scaled as f32;
    }

    fn unscale(&self, rows: usize, out: &mut [f64], workspace: &Workspace) {
        let targets = self.targets.len();
        for (estimates, row) in out
            .chunks_mut(targets)
            .zip(workspace.estimates[..rows * targets].chunks(targets))
        {
            for (t, (slot, &value)) in estimates.iter_mut().zip(row).enumerate() {
                *slot = self.targets.unscale(t, value);
            }
        }
    }
}
