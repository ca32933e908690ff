//! Estimates from a trained model, off the tensor framework.
//!
//! The kernel allocates nothing: callers bring a [`Workspace`]. An estimate has the same bits on
//! every processor with AVX2, whatever is estimated beside it and however many windows there are.
//! Windows of a recording overlap in memory, so sliding over it copies nothing either: a value of
//! neighbouring windows is a piece of its column.

pub mod kernel;
pub mod panel;
mod scale;
pub mod skip;
pub mod guard;
pub mod sliding;
pub mod synthetic;

use crate::evaluate::intervals;
use crate::model::weights::{Auxiliary, LinearWeights, Weights};
use crate::scaling::Scaling;
use guard::GuardKernel;
use hydroflex_openapi::model::{Activation, EnvelopeGroup, IntervalTable, ModelConfig};
use kernel::{PANEL, PackedLayer};
pub use scale::Sample;
use scale::ScaleMap;
use skip::Skip;

/// Windows from which on those that are rows are turned into a panel where that is faster: for a skip connection.
const MANY: usize = 8;
/// Windows that go through the network together: blocks of six where they are rows, whole panels otherwise.
const ROWS: usize = 48;

/// A model ready to estimate. Shared between threads; each brings its own [`Workspace`].
#[derive(Debug, Clone, PartialEq)]
pub struct Predictor {
    steps: usize,
    inputs: Scaling,
    /// Of the values of one window.
    maps: ScaleMap,
    targets: Scaling,
    /// First to last; none when the skip is the whole model.
    layers: Vec<PackedLayer>,
    /// The same for all estimated samples; none when that is one.
    all_steps: Option<AllSteps>,
    skip: Option<Skip>,
    /// First value of a window that the skip takes for its last sample.
    skip_from: usize,
    guard: Option<GuardKernel>,
    /// Of the values of a panel.
    places: Vec<usize>,
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

/// A network that estimates several samples at once.
#[derive(Debug, Clone, PartialEq)]
struct AllSteps {
    steps: usize,
    layers: Vec<PackedLayer>,
    /// Smallest and largest estimate of each target.
    limits: Vec<[f64; 2]>,
}

/// Scaled windows.
#[derive(Clone, Copy)]
enum Windows<'x> {
    /// One after the other, `stride` values apart.
    Rows { x: &'x [f32], stride: usize },
    /// Side by side: value i of window c is `x[places[i] + c]`.
    Panel { x: &'x [f32], places: &'x [usize] },
}

/// Scratch memory of one thread.
#[derive(Debug, Clone)]
pub struct Workspace {
    window: Vec<f32>,
    panel: Vec<f32>,
    scaled: Vec<f32>,
    ping: Vec<f32>,
    pong: Vec<f32>,
    skip: Vec<f64>,
    guide: Vec<f32>,
    /// Whether the guard changed an estimate of each window of the last block.
    limited: Vec<bool>,
    /// Payload of each window of the last block, kg; empty where none is followed.
    payload_kg: Vec<f64>,
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
    /// Payload that the model told from the window, kg; empty when it follows none.
    pub payload_kg: Vec<f64>,
}

/// What is asked for beside the estimates, one place per window.
#[derive(Debug, Default)]
pub struct PerWindow<'a> {
    /// Whether it is inside the envelope; every window is when the model has none.
    pub inside: Option<&'a mut [bool]>,
    /// Payload that the model told from it, kg; NaN when it follows none.
    pub payload_kg: Option<&'a mut [f64]>,
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

/// Payloads of the first `count` windows.
fn note(payload_kg: &mut [f64], found: impl Iterator<Item = f64>, count: usize) {
    for (slot, kg) in payload_kg.iter_mut().zip(found.take(count)) {
        *slot = kg;
    }
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

/// The weights of a network that estimates several samples at once, without those of all samples but the last.
fn last_step(config: &ModelConfig, weights: &Weights) -> Weights {
    let targets = config.targets.len();
    let mut own = weights.clone();
    if let Some(last) = own.layers.last_mut() {
        let inputs = last.weight.len() / last.bias.len().max(1);
        last.bias.drain(..last.bias.len() - targets);
        last.weight.drain(..last.weight.len() - targets * inputs);
    }
    own
}

/// The network's layers, with `guide` beside the first one where that has room.
fn packed(config: &ModelConfig, weights: &Weights, guide: Option<&LinearWeights>) -> Vec<PackedLayer> {
    let layers = fold(config, weights);
    let mut packed: Vec<PackedLayer> = layers
        .iter()
        .map(|(activations, map)| PackedLayer::new(map, activations))
        .collect();
    if let (Some(first), Some((activations, map)), Some(guide)) = (packed.first_mut(), layers.first(), guide)
        && PackedLayer::has_room(map.bias.len(), guide.bias.len())
    {
        *first = PackedLayer::with_beside(map, activations, guide);
    }
    packed
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
        let several = config.output_steps > 1;
        let guide = config.guard.as_ref().and(weights.guard.as_ref());
        let layers = if several {
            packed(config, &last_step(config, weights), guide)
        } else {
            packed(config, weights, guide)
        };
        let all_steps = several.then(|| AllSteps {
            steps: config.output_steps,
            layers: packed(config, weights, None),
            limits: config.guard.as_ref().map_or_else(
                || vec![[f64::NEG_INFINITY, f64::INFINITY]; config.targets.len()],
                |guard| {
                    guard
                        .min
                        .iter()
                        .zip(&guard.max)
                        .map(|(&low, &high)| [low, high])
                        .collect()
                },
            ),
        });
        let most = layers.iter().map(PackedLayer::inputs).max().unwrap_or(0);
        let most = most.max(config.window_steps * config.inputs.len());
        let skip = Skip::new(config, weights);
        let is_beside = layers.first().is_some_and(|first| first.beside() > 0);
        let guard =
            config.guard.as_ref().zip(guide).map(|(guard, guide)| {
                GuardKernel::new((!is_beside).then_some(guide), guard, &config.targets)
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
            maps: ScaleMap::new(config),
            targets: Scaling::from_config(&config.targets),
            layers,
            all_steps,
            skip,
            skip_from: (config.window_steps - config.skip_steps()) * config.inputs.len(),
            guard,
            places: (0..most).map(|place| place * PANEL).collect(),
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

    /// Whether the model tells the payload from the window, and its linear part follows it.
    #[must_use]
    pub fn follows_payload(&self) -> bool {
        self.skip.as_ref().is_some_and(Skip::follows_payload)
    }

    /// Whether estimates come with intervals.
    #[must_use]
    pub fn has_intervals(&self) -> bool {
        self.intervals.len() == self.targets.len()
    }

    /// Samples that the network estimates at once.
    #[must_use]
    pub fn output_steps(&self) -> usize {
        self.all_steps.as_ref().map_or(1, |all| all.steps)
    }

    /// Estimates of the last [`Self::output_steps`] samples of one window, oldest first, a row of targets each, in the
    /// columns' units: what a model that estimates several samples gives at once, held within the range of each target.
    /// [`Self::predict_window`] gives the last row, bounded more closely.
    ///
    /// # Panics
    /// When the window has another length.
    #[must_use]
    pub fn predict_all_steps(&self, window: &[f64], workspace: &mut Workspace) -> Vec<f64> {
        assert_eq!(window.len(), self.window_len(), "values of a window");
        let targets = self.targets.len();
        let Some(all) = &self.all_steps else {
            let mut out = vec![0.0; targets];
            self.predict_window(window, &mut out, workspace);
            return out;
        };
        let mut x = std::mem::take(&mut workspace.window);
        self.maps.scale(window, &mut x);
        let x_scaled = &x[..window.len()];
        let mut values = vec![0.0; all.steps * targets];
        if let Some((first, others)) = all.layers.split_first() {
            values = vec![0.0; first.padded()];
            first.forward(x_scaled, x_scaled.len(), 1, &mut values);
            for layer in others {
                let mut out = vec![0.0; layer.padded()];
                layer.forward(&values, values.len(), 1, &mut out);
                values = out;
            }
        }
        if let Some(kernel) = &self.skip {
            // One window for each step, a sample apart.
            let mut scratch = vec![0.0; kernel.padded() * all.steps];
            let values = &mut values[..all.steps * targets];
            kernel.add(x_scaled, self.inputs.len(), all.steps, &mut scratch, values);
        }
        workspace.window = x;
        values[..all.steps * targets]
            .iter()
            .enumerate()
            .map(|(place, &value)| {
                let target = place % targets;
                let [low, high] = all.limits[target];
                self.targets.unscale(target, f64::from(value)).clamp(low, high)
            })
            .collect()
    }

    /// Scratch memory for one thread.
    #[must_use]
    pub fn workspace(&self) -> Workspace {
        let widest = self.layers.iter().map(PackedLayer::padded).max().unwrap_or(0);
        let skip = self.skip.as_ref().map_or(0, Skip::padded);
        let is_turned = self.skip.as_ref().is_some_and(|skip| !skip.is_narrow());
        let projected = self.envelope.as_ref().map_or(0, |e| e.projection.padded());
        Workspace {
            window: vec![0.0; ROWS * self.window_len()],
            panel: vec![0.0; if is_turned { PANEL * self.window_len() } else { 0 }],
            scaled: vec![0.0; ROWS * self.targets.len()],
            ping: vec![0.0; ROWS * widest],
            pong: vec![0.0; ROWS * widest],
            skip: vec![0.0; ROWS * skip],
            guide: vec![0.0; ROWS * self.guard.as_ref().map_or(0, GuardKernel::padded)],
            limited: vec![false; ROWS],
            payload_kg: vec![0.0; if self.follows_payload() { ROWS } else { 0 }],
            projected: vec![0.0; ROWS * projected],
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
    pub fn predict_windows<T: Sample>(&self, windows: &[T], out: &mut [f64], workspace: &mut Workspace) {
        self.predict_windows_with(windows, out, PerWindow::default(), workspace);
    }

    /// As [`Self::predict_windows`], and for each window what `asked` has room for.
    ///
    /// # Panics
    /// When a slice has another length.
    pub fn predict_windows_with<T: Sample>(
        &self,
        windows: &[T],
        out: &mut [f64],
        asked: PerWindow<'_>,
        workspace: &mut Workspace,
    ) {
        let PerWindow {
            mut inside,
            mut payload_kg,
        } = asked;
        let size = self.window_len();
        let targets = self.targets.len();
        assert_eq!(windows.len() % size, 0, "whole windows");
        let count = windows.len() / size;
        assert_eq!(out.len(), count * targets, "one row of estimates per window");
        assert!(
            inside.as_ref().is_none_or(|inside| inside.len() == count)
                && payload_kg.as_ref().is_none_or(|kg| kg.len() == count),
            "one flag and payload per window"
        );
        let mut scaled = std::mem::take(&mut workspace.window);
        for (block, samples) in windows.chunks(ROWS * size).enumerate() {
            let rows = samples.len() / size;
            let first = block * ROWS;
            self.maps.scale(samples, &mut scaled);
            let arranged = Windows::Rows {
                x: &scaled,
                stride: size,
            };
            self.block(arranged, rows, workspace);
            self.unscale(
                rows,
                &mut out[first * targets..(first + rows) * targets],
                workspace,
            );
            if let Some(payload_kg) = payload_kg.as_deref_mut() {
                let found = workspace.payload_kg.iter().copied();
                let found = found.chain(std::iter::repeat(f64::NAN));
                (payload_kg[first..first + rows].iter_mut().zip(found)).for_each(|(kg, found)| *kg = found);
            }
            if let Some(inside) = inside.as_deref_mut() {
                let inside = &mut inside[first..first + rows];
                self.inside_block(arranged, rows, inside, workspace);
                for (flag, window) in inside.iter_mut().zip(samples.chunks_exact(size)) {
                    *flag &= self.maps.in_range(window);
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
        for first in (0..rows).step_by(ROWS) {
            let block = ROWS.min(rows - first);
            let x = &scaled[first * stride..];
            self.block(Windows::Rows { x, stride }, block, workspace);
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
        let count = (rows + 1).saturating_sub(self.steps);
        let targets = self.targets.len();
        let mut estimates = vec![Vec::with_capacity(count); targets];
        let mut inside = vec![true; if self.envelope.is_some() { count } else { 0 }];
        let mut payload_kg = Vec::with_capacity(if self.follows_payload() { count } else { 0 });
        // Column by column, where a value of neighbouring windows is a slice, with room to read a
        // whole panel at the end; a few windows row by row.
        let (between_rows, between_columns) = if count < MANY {
            (width, 1)
        } else {
            (1, rows + PANEL)
        };
        let mut scaled = vec![0.0_f32; (rows + PANEL) * width];
        for (channel, column) in columns.iter().enumerate() {
            for (row, &value) in column.iter().enumerate() {
                scaled[channel * between_columns + row * between_rows] = self.maps.scaled(channel, value);
            }
        }
        let places: Vec<usize> = (0..self.window_len())
            .map(|place| place % width * between_columns + place / width * between_rows)
            .collect();
        for first in (0..count).step_by(PANEL) {
            let block = PANEL.min(count - first);
            let x = &scaled[first * between_rows..];
            let windows = if count < MANY {
                Windows::Rows { x, stride: width }
            } else {
                Windows::Panel { x, places: &places }
            };
            self.block(windows, block, workspace);
            for row in workspace.scaled[..block * targets].chunks(targets) {
                for (t, (column, &value)) in estimates.iter_mut().zip(row).enumerate() {
                    column.push(self.targets.unscale(t, f64::from(value)));
                }
            }
            payload_kg.extend(workspace.payload_kg.iter().take(block));
            if !inside.is_empty() {
                self.inside_block(windows, block, &mut inside[first..first + block], workspace);
            }
        }
        self.outside_range(columns, &mut inside);
        SeriesEstimates {
            first_row: self.steps - 1,
            columns: estimates,
            inside,
            payload_kg,
        }
    }

    /// Half width of the 90 % interval around an estimate, with the payload of its window where the model follows one; absent when the model
    /// has none.
    #[must_use]
    pub fn half_width(&self, target: usize, estimate: f64, payload_kg: Option<f64>) -> Option<f64> {
        intervals::half_width(self.intervals.get(target)?, estimate, payload_kg)
    }

    /// Estimates for at most [`ROWS`] windows, or [`PANEL`] side by side, one row of scaled targets per window in
    /// `workspace.scaled`.
    fn block(&self, windows: Windows<'_>, rows: usize, workspace: &mut Workspace) {
        let targets = self.targets.len();
        let Workspace {
            panel,
            scaled,
            ping,
            pong,
            skip,
            guide,
            limited,
            payload_kg,
            ..
        } = workspace;
        let scaled = &mut scaled[..rows * targets];
        let (mut from, mut to) = (ping, pong);
        scaled.fill(0.0);
        match windows {
            Windows::Rows { x, stride } => {
                if let Some((layer, others)) = self.layers.split_first() {
                    layer.forward_with(x, stride, rows, from, guide);
                    let mut width = layer.padded();
                    for layer in others {
                        layer.forward(from, width, rows, to);
                        width = layer.padded();
                        std::mem::swap(&mut from, &mut to);
                    }
                    for (row, out) in scaled.chunks_exact_mut(targets).enumerate() {
                        // Not by the library: a call for each row would be felt.
                        for (slot, &value) in out.iter_mut().zip(&from[row * width..]) {
                            *slot = value;
                        }
                    }
                }
                if let Some(kernel) = &self.skip {
                    let x = &x[self.skip_from..];
                    if kernel.is_narrow() || rows < MANY {
                        kernel.add(x, stride, rows, skip, scaled);
                        note(payload_kg, kernel.payloads_kg(skip), rows);
                    } else {
                        for first in (0..rows).step_by(PANEL) {
                            let (x, columns) = (&x[first * stride..], PANEL.min(rows - first));
                            panel::transpose(x, stride, columns, self.window_len() - self.skip_from, panel);
                            let scaled = &mut scaled[first * targets..(first + columns) * targets];
                            kernel.add_panel(panel, &self.places, columns, skip, scaled);
                            let found = kernel.payloads_kg(skip);
                            note(payload_kg.get_mut(first..).unwrap_or(&mut []), found, columns);
                        }
                    }
                }
                if let Some(kernel) = &self.guard {
                    kernel.limit(x, stride, rows, guide, scaled, limited);
                }
            }
            Windows::Panel { x, places } => {
                if let Some((layer, others)) = self.layers.split_first() {
                    layer.forward_panel(x, places, rows, from);
                    let (first, count) = (layer.outputs() * PANEL, layer.beside() * PANEL);
                    guide[..count].copy_from_slice(&from[first..first + count]);
                    for layer in others {
                        layer.forward_panel(from, &self.places, rows, to);
                        std::mem::swap(&mut from, &mut to);
                    }
                    for (row, out) in scaled.chunks_mut(targets).enumerate() {
                        for (target, slot) in out.iter_mut().enumerate() {
                            *slot = from[target * PANEL + row];
                        }
                    }
                }
                if let Some(kernel) = &self.skip {
                    kernel.add_panel(x, &places[self.skip_from..], rows, skip, scaled);
                    note(payload_kg, kernel.payloads_kg(skip), rows);
                }
                if let Some(kernel) = &self.guard {
                    kernel.limit_panel(x, places, rows, guide, scaled, limited);
                }
            }
        }
    }

    /// Whether each of the windows that [`Self::block`] estimated last is near the training windows: inside the
    /// envelope, and its estimate not limited. Ranges are not looked at.
    fn inside_block(
        &self,
        windows: Windows<'_>,
        rows: usize,
        inside: &mut [bool],
        workspace: &mut Workspace,
    ) {
        inside.fill(true);
        if let Some(envelope) = &self.envelope {
            let projected = &mut workspace.projected;
            match windows {
                Windows::Rows { x, stride } => {
                    envelope.projection.forward(x, stride, rows, projected);
                    let rows = projected.chunks(envelope.projection.padded());
                    for (flag, row) in inside.iter_mut().zip(rows) {
                        *flag = group_squares(&envelope.groups, row)
                            .zip(&envelope.groups)
                            .all(|(square, group)| square <= group.limit);
                    }
                }
                Windows::Panel { x, places } => {
                    envelope.projection.forward_panel(x, places, rows, projected);
                    let mut coordinates = projected.chunks_exact(PANEL);
                    for group in &envelope.groups {
                        let mut sums = [0.0_f64; PANEL];
                        for values in coordinates.by_ref().take(group.components) {
                            for (sum, &v) in sums.iter_mut().zip(values) {
                                *sum += f64::from(v) * f64::from(v);
                            }
                        }
                        for (flag, sum) in inside.iter_mut().zip(sums) {
                            *flag &= sum / group.components.max(1) as f64 <= group.limit;
                        }
                    }
                }
            }
        }
        for (flag, limited) in inside.iter_mut().zip(&workspace.limited) {
            *flag &= !limited;
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
