//! Loss and gradient of a batch on processors: what burn's autodiff computes, on buffers that are made once.
//!
//! ```text
//! windows (where they stand) → whitened → layer → … → layer → error → gradients of weights and biases
//! ```
//!
//! A batch is cut into two halves for two threads, a half into blocks of 96 windows, which go forward and
//! backward through the whole network while they are in the second-level cache. Halves are fixed and added in order:
//! the bits do not depend on the number of threads.
//!
//! Whitening, `z = P x + o`, is linear, as is what the first layer does with z: `W z + b = (W P) x + (W o + b)`. Where it
//! costs less, the product W P is made once per batch and the windows stay as they are; the gradient
//! with respect to W is then the one with respect to W P, times Pᵀ, plus that of the bias, times oᵀ.

mod products;

use super::prepare::{Part, Whitening};
use crate::activate;
use crate::network::{Loss, elementwise};
use crate::simd::{Level, level};
use hydroflex_openapi::model::DenseLayer;
use products::{LANES, Rows, multiply, multiply_transposed, transpose};

/// Windows that go through the network together.
const BLOCK: usize = 96;
/// Parts into which every batch is cut, one per thread. Fixed, so that sums do not depend on the
/// number of threads.
const BATCH_PARTS: usize = 2;
/// Smaller batches are not cut: starting a thread's work would cost more than it saves.
const SMALLEST_CUT: usize = 256;

/// A network ready to be trained on batches; holds every buffer that a step needs.
pub struct Step {
    network: Network,
    loss: Loss,
    halves: Vec<Scratch>,
}

/// Values that are left out of a step, by chance: a function of the seed, the window, the layer and the value, of nothing
/// else. Those that stay are larger by as much, so that the sum is the same in the mean.
#[derive(Debug, Clone, Copy)]
struct Mask {
    seed: u64,
    /// Part left out.
    rate: f64,
}

impl Mask {
    /// Multiplies a row of values (or of derivatives) of the window that begins at `window` by 0 or 1 / (1 − rate).
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "the rate is in [0, 1)"
    )]
    fn apply(self, layer: usize, window: usize, row: &mut [f32]) {
        let dropped = (self.rate * 2f64.powi(32)) as u64;
        let kept = (1.0 / (1.0 - self.rate)) as f32;
        let mut state =
            mixed(self.seed ^ mixed(window as u64) ^ mixed((layer as u64).wrapping_add(0x5851_f42d)));
        for value in row {
            state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
            *value *= if mixed(state) >> 32 < dropped { 0.0 } else { kept };
        }
    }
}

/// `SplitMix64`'s output function.
fn mixed(state: u64) -> u64 {
    let z = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Seed of the values left out of step `batch` of epoch `epoch`.
#[must_use]
pub fn dropout_seed(seed: u64, epoch: usize, batch: usize) -> u64 {
    mixed(mixed(mixed(seed).wrapping_add(epoch as u64)).wrapping_add(batch as u64))
}

/// What a window is before the first layer.
enum First {
    /// The window as it is.
    Window,
    /// The window as it is; whitening is part of the first layer. `projection`: a row per component.
    Folded {
        projection: Rows,
        places: Vec<usize>,
        offset: Vec<f32>,
    },
    /// The whitened window. `projection`: a row per window value.
    Projected { projection: Rows, offset: Rows },
}

struct Network {
    level: Level,
    /// As many as the widest layer has outputs.
    zeros: Rows,
    first: First,
    layers: Vec<Layer>,
}

/// A layer with the current weights, turned as the products want them.
struct Layer {
    shape: DenseLayer,
    /// Whether values are left out after it in training.
    dropout: bool,
    /// A row per input: for the way forward. In a folded first layer, per window value.
    forward: Rows,
    /// A row per output: for the way back; empty in the first layer.
    backward: Rows,
    bias: Rows,
    /// A row per input, unfolded: what the folded one is made of.
    unfolded: Rows,
    /// Where the rows of a block of outputs begin.
    places: Vec<usize>,
}

/// What one thread needs.
struct Scratch {
    level: Level,
    /// Where the block's windows begin in the series.
    windows: Vec<usize>,
    /// Whitened windows.
    whitened: Rows,
    whitened_places: Vec<usize>,
    /// Per layer: its sums, then what each activation made of them where that is kept beside them.
    values: Vec<Vec<Rows>>,
    /// Derivatives of the loss with respect to the outputs of a layer, and of the one before it.
    delta: [Rows; 2],
    /// Per layer, laid out as its weights and bias.
    gradients: Vec<(Rows, Rows)>,
    /// What is left out at present; nothing when a loss is judged.
    mask: Option<Mask>,
    loss: f64,
}

/// Windows to train on or to judge with.
#[derive(Clone, Copy)]
pub struct Samples<'a> {
    /// Scaled inputs and what is wanted.
    pub part: &'a Part,
    /// First row of each window.
    pub first_rows: &'a [u32],
}

/// First row of each window of `part`, to be kept for [`Samples`].
///
/// # Panics
/// With 2³² rows or more.
#[must_use]
pub fn first_rows(part: &Part) -> Vec<u32> {
    let row = |index| u32::try_from(part.windows.first_row(index)).expect("fewer than 2³² rows");
    (0..part.windows.len()).map(row).collect()
}

impl Step {
    /// Buffers for `layers` and batches of `batch` windows of `values` values.
    #[must_use]
    pub fn new(
        layers: &[DenseLayer],
        whitening: &Whitening,
        values: usize,
        batch: usize,
        loss: Loss,
    ) -> Self {
        Self::at(level(), layers, whitening, values, batch, loss)
    }

    fn at(
        level: Level,
        layers: &[DenseLayer],
        whitening: &Whitening,
        values: usize,
        batch: usize,
        loss: Loss,
    ) -> Self {
        let network = Network::new(level, layers, whitening, values, batch);
        let halves = (0..BATCH_PARTS).map(|_| Scratch::new(&network)).collect();
        Self {
            network,
            loss,
            halves,
        }
    }

    /// The same with dropout after the layers where `dropouts` says so.
    #[must_use]
    pub fn with_dropout(mut self, dropouts: &[bool]) -> Self {
        for (layer, &dropout) in self.network.layers.iter_mut().zip(dropouts) {
            layer.dropout = dropout;
        }
        self.halves = (0..BATCH_PARTS).map(|_| Scratch::new(&self.network)).collect();
        self
    }

    /// From now on gradients leave out the part `rate` of the values after layers with dropout, chosen by `seed`.
    pub fn leave_out(&mut self, rate: f64, seed: u64) {
        for half in &mut self.halves {
            half.mask = Some(Mask { seed, rate });
        }
    }

    /// Mean loss of the windows `batch` of `samples`, and its gradient (flat, as the parameters).
    ///
    /// # Panics
    /// When `parameters` or `gradient` have another length than the layers need.
    pub fn gradient(
        &mut self,
        samples: Samples<'_>,
        parameters: &[f32],
        batch: &[u32],
        gradient: &mut [f32],
    ) -> f64 {
        self.network.take(parameters);
        let (network, loss) = (&self.network, self.loss);
        let divisor = (batch.len() * network.outputs()) as f32;
        let (head, tail) = self.halves.split_at_mut(1);
        let (a, b) = (&mut head[0], &mut tail[0]);
        if batch.len() < SMALLEST_CUT {
            a.gradient(network, samples, batch, loss, divisor);
        } else {
            let (first, second) = batch.split_at(batch.len().div_ceil(BATCH_PARTS));
            both(
                || a.gradient(network, samples, first, loss, divisor),
                || b.gradient(network, samples, second, loss, divisor),
            );
            a.add(b);
        }
        self.network.give(&a.gradients, gradient);
        a.loss / f64::from(divisor)
    }

    /// Mean loss of all windows of `samples`.
    pub fn loss(&mut self, samples: Samples<'_>, parameters: &[f32]) -> f64 {
        self.network.take(parameters);
        let (network, loss) = (&self.network, self.loss);
        let windows = samples.first_rows;
        let (first, second) = windows.split_at(windows.len().div_ceil(BATCH_PARTS));
        let (head, tail) = self.halves.split_at_mut(1);
        let (a, b) = (&mut head[0], &mut tail[0]);
        both(
            || a.loss = a.loss_of(network, samples.part, first, loss),
            || b.loss = b.loss_of(network, samples.part, second, loss),
        );
        (a.loss + b.loss) / (windows.len() * network.outputs()) as f64
    }
}

impl Network {
    fn new(level: Level, layers: &[DenseLayer], whitening: &Whitening, values: usize, batch: usize) -> Self {
        let components = whitening.components();
        let outputs = layers[0].outputs;
        // Products per batch with and without folding.
        let folded = 2 * outputs * values * (components + batch);
        let projected = batch * components * (values + 2 * outputs);
        let first = if components == 0 {
            First::Window
        } else if folded < projected {
            let projection = Rows::of(&whitening.projection, values);
            First::Folded {
                places: projection.places(),
                projection,
                offset: whitening.offset.clone(),
            }
        } else {
            let mut projection = Rows::new(values, components);
            let width = projection.width();
            transpose(
                &whitening.projection,
                values,
                components,
                values,
                projection.values_mut(),
                width,
            );
            First::Projected {
                projection,
                offset: Rows::of(&whitening.offset, components),
            }
        };
        let widest = layers.iter().map(|l| l.inputs.max(l.outputs)).max().unwrap_or(0);
        let layers = layers
            .iter()
            .enumerate()
            .map(|(position, shape)| {
                let folded = position == 0 && matches!(first, First::Folded { .. });
                let inputs = if folded { values } else { shape.inputs };
                Layer {
                    forward: Rows::new(inputs, shape.outputs),
                    backward: Rows::new(if position == 0 { 0 } else { shape.outputs }, shape.inputs),
                    bias: Rows::new(1, shape.outputs),
                    unfolded: Rows::new(if folded { shape.inputs } else { 0 }, shape.outputs),
                    places: Rows::new(BLOCK, shape.outputs).places(),
                    shape: shape.clone(),
                    dropout: false,
                }
            })
            .collect();
        Self {
            level,
            zeros: Rows::new(1, widest),
            first,
            layers,
        }
    }

    /// Values that it gives: the targets of one sample, or of several.
    fn outputs(&self) -> usize {
        self.layers.last().map_or(0, |layer| layer.shape.outputs)
    }

    /// Turns the parameters.
    fn take(&mut self, parameters: &[f32]) {
        let mut rest = parameters;
        for layer in &mut self.layers {
            let (inputs, outputs) = (layer.shape.inputs, layer.shape.outputs);
            let (weight, tail) = rest.split_at(outputs * inputs);
            let (bias, tail) = tail.split_at(outputs);
            rest = tail;
            layer.bias.values_mut()[..outputs].copy_from_slice(bias);
            let width = layer.bias.width();
            let turned = if layer.unfolded.values().is_empty() {
                &mut layer.forward
            } else {
                &mut layer.unfolded
            };
            transpose(weight, inputs, outputs, inputs, turned.values_mut(), width);
            let back = layer.backward.width();
            for (row, values) in layer
                .backward
                .values_mut()
                .chunks_mut(back)
                .zip(weight.chunks(inputs))
            {
                row[..inputs].copy_from_slice(values);
            }
        }
        assert!(rest.is_empty(), "{} parameters too many", rest.len());
        if let First::Folded {
            projection,
            places,
            offset,
        } = &self.first
        {
            let layer = &mut self.layers[0];
            let (level, width) = (self.level, layer.bias.width());
            let unfolded = layer.unfolded.values();
            // Rows of the product do not know of each other: two threads, the same bits.
            let values = layer.forward.values().len() / width;
            let cut = (values / 2).next_multiple_of(LANES).min(values);
            let (head, tail) = layer.forward.values_mut().split_at_mut(cut * width);
            let fold = |first: usize, out: &mut [f32]| {
                out.fill(0.0);
                let count = out.len() / width;
                multiply_transposed(
                    level,
                    &projection.values()[first..],
                    places,
                    count,
                    unfolded,
                    width,
                    out,
                );
            };
            both(|| fold(0, head), || fold(cut, tail));
            let bias = layer.bias.values_mut();
            for (row, o) in unfolded.chunks(width).zip(offset) {
                for (b, w) in bias.iter_mut().zip(row) {
                    *b += o * w;
                }
            }
        }
    }

    /// Turns gradients into one that stands as the parameters do. The unfolded weights make room for their gradient.
    fn give(&mut self, gradients: &[(Rows, Rows)], gradient: &mut [f32]) {
        let mut rest = gradient;
        for (position, (layer, (weights, bias))) in self.layers.iter_mut().zip(gradients).enumerate() {
            let (inputs, outputs) = (layer.shape.inputs, layer.shape.outputs);
            let (weight_out, tail) = rest.split_at_mut(outputs * inputs);
            let (bias_out, tail) = tail.split_at_mut(outputs);
            rest = tail;
            bias_out.copy_from_slice(&bias.values()[..outputs]);
            let width = bias.width();
            let weights = if position == 0 && matches!(self.first, First::Folded { .. }) {
                unfold(
                    self.level,
                    &self.first,
                    self.zeros.values(),
                    weights,
                    bias,
                    &mut layer.unfolded,
                );
                &layer.unfolded
            } else {
                weights
            };
            transpose(weights.values(), width, inputs, outputs, weight_out, inputs);
        }
    }
}

/// `out = P · folded + o · biasᵀ`.
fn unfold(level: Level, first: &First, zeros: &[f32], folded: &Rows, bias: &Rows, out: &mut Rows) {
    let First::Folded {
        projection,
        places,
        offset,
    } = first
    else {
        return;
    };
    let width = folded.width();
    let values = folded.values().len() / width;
    let cut = places.len() / 2;
    let (head, tail) = out.values_mut().split_at_mut(cut * width);
    let unfold = |places: &[usize], offset: &[f32], out: &mut [f32]| {
        multiply(
            level,
            projection.values(),
            places,
            values,
            folded.values(),
            width,
            zeros,
            out,
        );
        for (row, o) in out.chunks_mut(width).zip(offset) {
            for (g, b) in row.iter_mut().zip(bias.values()) {
                *g += o * b;
            }
        }
    };
    both(
        || unfold(&places[..cut], &offset[..cut], head),
        || unfold(&places[cut..], &offset[cut..], tail),
    );
}

impl Scratch {
    fn new(network: &Network) -> Self {
        let widest = network.layers.iter().map(|l| l.bias.width()).max().unwrap_or(0);
        let whitened = match &network.first {
            First::Projected { offset, .. } => Rows::new(BLOCK, offset.width()),
            _ => Rows::new(0, 1),
        };
        Self {
            level: network.level,
            windows: Vec::with_capacity(BLOCK),
            whitened_places: Rows::new(BLOCK, whitened.width()).places(),
            whitened,
            values: network
                .layers
                .iter()
                .map(|layer| {
                    let kept = layer.shape.activations.iter().enumerate();
                    let beside = kept.filter(|&(position, &a)| is_beside(position, a)).count();
                    let stages = 1 + beside + usize::from(layer.dropout);
                    vec![Rows::new(BLOCK, layer.shape.outputs); stages]
                })
                .collect(),
            delta: [Rows::new(BLOCK, widest), Rows::new(BLOCK, widest)],
            gradients: network
                .layers
                .iter()
                .map(|layer| (layer.forward.clone(), layer.bias.clone()))
                .collect(),
            mask: None,
            loss: 0.0,
        }
    }

    /// Gradient of the windows `batch`; the loss is their sum.
    fn gradient(&mut self, network: &Network, samples: Samples<'_>, batch: &[u32], loss: Loss, divisor: f32) {
        self.loss = 0.0;
        for (weights, bias) in &mut self.gradients {
            weights.values_mut().fill(0.0);
            bias.values_mut().fill(0.0);
        }
        let rows = |window: &u32| samples.first_rows[*window as usize];
        for block in batch.chunks(BLOCK) {
            self.forward(network, samples.part, block.iter().map(rows), self.mask);
            self.loss += self.errors(network, samples.part, block.iter().map(rows), loss, divisor);
            self.backward(network, &samples.part.series.values);
        }
    }

    /// Sum of the losses of the windows that begin at `first_rows`.
    fn loss_of(&mut self, network: &Network, part: &Part, first_rows: &[u32], loss: Loss) -> f64 {
        let mut sum = 0.0;
        for block in first_rows.chunks(BLOCK) {
            self.forward(network, part, block.iter().copied(), None);
            sum += self.errors(network, part, block.iter().copied(), loss, 1.0);
        }
        sum
    }

    /// Outputs of all layers for the windows that begin at `first_rows`, without what `mask` leaves out.
    fn forward(
        &mut self,
        network: &Network,
        part: &Part,
        first_rows: impl Iterator<Item = u32>,
        mask: Option<Mask>,
    ) {
        let series = &part.series;
        self.windows.clear();
        self.windows
            .extend(first_rows.map(|row| row as usize * series.width));
        let count = self.windows.len();
        if let First::Projected { projection, offset } = &network.first {
            let width = projection.width();
            multiply(
                self.level,
                &series.values,
                &self.windows,
                projection.values().len() / width,
                projection.values(),
                width,
                offset.values(),
                self.whitened.values_mut(),
            );
        }
        for (position, layer) in network.layers.iter().enumerate() {
            let (before, from) = self.values.split_at_mut(position);
            let stages = &mut from[0];
            let (input, places): (&[f32], &[usize]) = match before.last() {
                Some(stages) => (
                    stages.last().map_or(&[], Rows::values),
                    &network.layers[position - 1].places[..count],
                ),
                None => first_input(
                    &self.whitened,
                    &self.whitened_places,
                    &self.windows,
                    &series.values,
                ),
            };
            let width = layer.bias.width();
            multiply(
                self.level,
                input,
                places,
                layer.forward.values().len() / width,
                layer.forward.values(),
                width,
                layer.bias.values(),
                stages[0].values_mut(),
            );
            let mut stage = 0;
            for (position, &activation) in layer.shape.activations.iter().enumerate() {
                if is_beside(position, activation) {
                    let (head, tail) = stages.split_at_mut(stage + 1);
                    tail[0].values_mut()[..count * width]
                        .copy_from_slice(&head[stage].values()[..count * width]);
                    stage += 1;
                }
                activate::apply(
                    self.level,
                    activation,
                    &mut stages[stage].values_mut()[..count * width],
                );
            }
            if layer.dropout {
                // Beside what it reads: the derivatives of activations need that.
                let (head, tail) = stages.split_at_mut(stage + 1);
                let values = &mut tail[0].values_mut()[..count * width];
                values.copy_from_slice(&head[stage].values()[..count * width]);
                if let Some(mask) = mask {
                    for (row, &window) in values.chunks_mut(width).zip(&self.windows) {
                        mask.apply(position, window, row);
                    }
                }
            }
        }
    }

    /// Sum of the losses of the block, whose windows begin at `first_rows`; their derivatives come to
    /// stand in the first of `delta`.
    fn errors(
        &mut self,
        network: &Network,
        part: &Part,
        first_rows: impl Iterator<Item = u32>,
        loss: Loss,
        divisor: f32,
    ) -> f64 {
        let Some((layer, stages)) = network.layers.last().zip(self.values.last()) else {
            return 0.0;
        };
        let (targets, width) = (part.targets.width, layer.bias.width());
        // The last rows of the window, one after the other, as the outputs are.
        let count = layer.shape.outputs;
        let outputs = stages.last().map_or(&[][..], Rows::values);
        let mut sum = 0.0;
        for ((row, delta), first) in outputs
            .chunks(width)
            .zip(self.delta[0].values_mut().chunks_mut(width))
            .zip(first_rows)
        {
            let end = (first as usize + part.windows.steps) * targets;
            delta.fill(0.0);
            let wanted = &part.wanted[end - count..end];
            for ((slope, output), wanted) in delta.iter_mut().zip(row).zip(wanted) {
                let error = output - wanted;
                sum += loss.value(f64::from(error));
                *slope = loss.slope(error) / divisor;
            }
        }
        sum
    }

    /// Adds the block's part of the gradients.
    fn backward(&mut self, network: &Network, series: &[f32]) {
        let count = self.windows.len();
        let [delta, next] = &mut self.delta;
        for (position, layer) in network.layers.iter().enumerate().rev() {
            let width = layer.bias.width();
            let stages = &self.values[position];
            let values = &mut delta.values_mut()[..count * width];
            let mut stage = stages.len() - 1;
            if layer.dropout {
                stage -= 1;
                if let Some(mask) = self.mask {
                    for (row, &window) in values.chunks_mut(width).zip(&self.windows) {
                        mask.apply(position, window, row);
                    }
                }
            }
            for (position, &activation) in layer.shape.activations.iter().enumerate().rev() {
                let beside = is_beside(position, activation);
                let saved = &stages[stage - usize::from(elementwise::saves_input(activation))];
                elementwise::chain(activation, &saved.values()[..count * width], values);
                stage -= usize::from(beside);
            }
            let (weights, bias) = &mut self.gradients[position];
            let sums = bias.values_mut();
            for row in values.chunks_exact(width) {
                for (s, d) in sums.iter_mut().zip(row) {
                    *s += d;
                }
            }
            let (input, places) = if position == 0 {
                first_input(&self.whitened, &self.whitened_places, &self.windows, series)
            } else {
                (
                    self.values[position - 1].last().map_or(&[][..], Rows::values),
                    &network.layers[position - 1].places[..count],
                )
            };
            multiply_transposed(
                self.level,
                input,
                places,
                layer.forward.values().len() / width,
                values,
                width,
                weights.values_mut(),
            );
            if position > 0 {
                multiply(
                    self.level,
                    values,
                    &layer.places[..count],
                    layer.shape.outputs,
                    layer.backward.values(),
                    layer.backward.width(),
                    network.zeros.values(),
                    next.values_mut(),
                );
                std::mem::swap(delta, next);
            }
        }
    }

    fn add(&mut self, other: &Self) {
        self.loss += other.loss;
        for ((weights, bias), (other_weights, other_bias)) in self.gradients.iter_mut().zip(&other.gradients)
        {
            for (sum, other) in [(weights, other_weights), (bias, other_bias)] {
                for (s, o) in sum.values_mut().iter_mut().zip(other.values()) {
                    *s += o;
                }
            }
        }
    }
}

/// Whether the activation at `position` of its layer writes beside what it reads: because its derivative needs what it
/// read, or because that of the activation before it needs what that one wrote.
fn is_beside(position: usize, activation: hydroflex_openapi::model::Activation) -> bool {
    position > 0 || elementwise::saves_input(activation)
}

/// The whitened windows, or the windows where they stand.
fn first_input<'a>(
    whitened: &'a Rows,
    whitened_places: &'a [usize],
    windows: &'a [usize],
    series: &'a [f32],
) -> (&'a [f32], &'a [usize]) {
    if whitened.values().is_empty() {
        (series, windows)
    } else {
        (whitened.values(), &whitened_places[..windows.len()])
    }
}

/// Runs both, at the same time where there are two threads. The caller's own thread takes part: handing all to a pool
/// and sleeping meanwhile costs more than a small batch.
fn both(a: impl FnOnce(), b: impl FnOnce() + Send) {
    if rayon::current_num_threads() < 2 {
        a();
        b();
    } else {
        rayon::in_place_scope(|scope| {
            scope.spawn(|_| b());
            a();
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::least_squares::TargetRows;
    use crate::network::init::initial_parameters;
    use crate::network::{NetworkTensors, batch_tensor};
    use crate::structure::{Form, Structure};
    use crate::window::{Series, Windows};
    use burn::tensor::{Device, Tensor};
    use hydroflex_openapi::job::WindowCut;

    const STEPS: usize = 7;
    const WIDTH: usize = 3;
    const VALUES: usize = STEPS * WIDTH;
    const TARGETS: usize = 2;

    /// Numbers between -1 and 1.
    pub(super) fn values(count: usize, seed: u32) -> Vec<f32> {
        let mut state = seed;
        (0..count)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 8) as f32 / 8_388_608.0 - 1.0
            })
            .collect()
    }

    /// Four runs of 150 random rows.
    fn part() -> Part {
        let run_rows: Vec<usize> = (0..=4).map(|run| 150 * run).collect();
        Part {
            series: Series {
                width: WIDTH,
                values: values(600 * WIDTH, 1),
                run_rows: run_rows.clone(),
            },
            windows: Windows::new(&run_rows, STEPS, WindowCut::Overlapping),
            wanted: values(600 * TARGETS, 2),
            targets: TargetRows {
                width: TARGETS,
                values: vec![0.0; 600 * TARGETS],
            },
        }
    }

    fn whitening(components: usize) -> Whitening {
        Whitening {
            projection: values(components * VALUES, 3),
            offset: values(components, 4),
        }
    }

    fn layers(name: &str, inputs: usize) -> Vec<DenseLayer> {
        Structure::parse(name, 20, (name == "best").then_some(40))
            .unwrap()
            .layers(inputs, TARGETS)
    }

    /// Mean loss and gradient of `batch` by burn's autodiff, with `parameters` and whitening applied window by window.
    fn by_burn(
        part: &Part,
        layers: &[DenseLayer],
        whitening: &Whitening,
        parameters: &[f32],
        batch: &[u32],
        loss: Loss,
    ) -> (f32, Vec<f32>) {
        let device = Device::flex().autodiff();
        let (mut inputs, mut wanted) = (Vec::new(), Vec::new());
        for &window in batch {
            let first = part.windows.first_row(window as usize);
            let window = part.series.window(first, STEPS);
            if whitening.components() == 0 {
                inputs.extend_from_slice(window);
            }
            for (row, o) in whitening.projection.chunks(VALUES).zip(&whitening.offset) {
                let product = row.iter().zip(window).map(|(p, x)| f64::from(p * x)).sum::<f64>();
                inputs.push(product as f32 + o);
            }
            let row = first + STEPS - 1;
            wanted.extend_from_slice(&part.wanted[row * TARGETS..(row + 1) * TARGETS]);
        }
        let mut gradient = vec![0.0; parameters.len()];
        let inputs: Tensor<2> = batch_tensor(inputs, batch.len(), &device);
        let value = NetworkTensors::new(Form::Dense, layers, parameters, &device).loss_and_gradient(
            inputs,
            batch_tensor(wanted, batch.len(), &device),
            loss,
            (batch.len() * TARGETS) as f32,
            &mut gradient,
        );
        (value, gradient)
    }

    #[test]
    fn loss_and_gradient_are_those_of_autodiff() {
        let part = part();
        let first_rows = first_rows(&part);
        let samples = Samples {
            part: &part,
            first_rows: &first_rows,
        };
        // A batch of one block, of several that are cut, and of an odd number.
        for count in [5_u32, 300, 391] {
            let batch: Vec<u32> = (0..count).map(|i| (i * 37) % 576).collect();
            // No whitening; components few enough to be applied first, and to be folded.
            for components in [0, 4, 21] {
                let whitening = if components == 0 {
                    Whitening::default()
                } else {
                    whitening(components)
                };
                for name in ["L", "RLR", "ELE", "TLSLT", "TLSLTLSLT", "TS", "best"] {
                    let inputs = if components == 0 { VALUES } else { components };
                    let layers = layers(name, inputs);
                    let parameters = initial_parameters(&layers, 5, 1.0);
                    let loss = if name == "best" {
                        Loss::PseudoHuber
                    } else {
                        Loss::Square
                    };
                    let (exact, wanted) = by_burn(&part, &layers, &whitening, &parameters, &batch, loss);
                    for level in [level(), Level::Portable] {
                        let mut step = Step::at(level, &layers, &whitening, VALUES, batch.len(), loss);
                        let mut gradient = vec![f32::NAN; parameters.len()];
                        for _ in 0..2 {
                            let value = step.gradient(samples, &parameters, &batch, &mut gradient);
                            let case = format!("{name}, {count} windows, {components} components, {level:?}");
                            assert!(
                                (value - f64::from(exact)).abs() < 2e-6 * value,
                                "{case}: {value} {exact}"
                            );
                            for (i, (found, wanted)) in gradient.iter().zip(&wanted).enumerate() {
                                // f32 sums of values of size ten at most.
                                assert!(
                                    (found - wanted).abs() < 1e-5,
                                    "{case}, parameter {i}: {found} {wanted}"
                                );
                            }
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn both_forms_of_the_first_layer_are_tried() {
        let form = |components: usize, batch: usize| {
            let layers = layers("RLR", components);
            let step = Step::new(&layers, &whitening(components), VALUES, batch, Loss::Square);
            matches!(step.network.first, First::Folded { .. })
        };
        assert!(form(21, 391) && !form(4, 391) && !form(21, 5));
    }

    #[test]
    fn the_gradient_is_the_slope_of_the_loss() {
        let part = part();
        let first_rows = first_rows(&part);
        let samples = Samples {
            part: &part,
            first_rows: &first_rows,
        };
        let batch: Vec<u32> = (0..576).collect();
        for name in ["L", "TLSLT", "ELE", "best"] {
            let whitening = whitening(21);
            let layers = layers(name, 21);
            let parameters = initial_parameters(&layers, 6, 1.0);
            let mut step = Step::new(&layers, &whitening, VALUES, batch.len(), Loss::PseudoHuber);
            let mut gradient = vec![0.0; parameters.len()];
            let loss = step.gradient(samples, &parameters, &batch, &mut gradient);
            let again = step.loss(samples, &parameters);
            assert!((loss - again).abs() < 1e-9, "{name}: {loss} {again}");
            // Along the gradient, whose slope is its square: a difference that f32 resolves.
            let square: f64 = gradient.iter().map(|&g| f64::from(g) * f64::from(g)).sum();
            let h = 1e-3 / square.sqrt();
            let moved = |sign: f64| -> Vec<f32> {
                let pairs = parameters.iter().zip(&gradient);
                pairs
                    .map(|(&p, &g)| (f64::from(p) + sign * h * f64::from(g)) as f32)
                    .collect()
            };
            let slope = (step.loss(samples, &moved(1.0)) - step.loss(samples, &moved(-1.0))) / (2.0 * h);
            assert!((slope / square - 1.0).abs() < 2e-3, "{name}: {slope} {square}");
        }
    }

    #[test]
    fn several_steps_are_the_last_rows_of_the_window() {
        let part = part();
        let first_rows = first_rows(&part);
        let samples = Samples {
            part: &part,
            first_rows: &first_rows,
        };
        let batch: Vec<u32> = (0..300).map(|i| (i * 37) % 576).collect();
        let layers = Structure::parse("TLT", 20, None)
            .unwrap()
            .layers(VALUES, 3 * TARGETS);
        let parameters = initial_parameters(&layers, 5, 1.0);
        let mut step = Step::new(&layers, &Whitening::default(), VALUES, batch.len(), Loss::Square);
        let mut gradient = vec![0.0; parameters.len()];
        let loss = step.gradient(samples, &parameters, &batch, &mut gradient);
        // The bias of the last layer: its gradient is the mean error of each output, which autodiff gives for one
        // sample at a time with the rows of that sample alone.
        let last = layers.last().unwrap();
        let (inputs, size) = (last.inputs, last.inputs * last.outputs + last.outputs);
        let head = parameters.len() - size;
        let mut sum = 0.0;
        for s in 0..3 {
            let mut single = layers.clone();
            single.last_mut().unwrap().outputs = TARGETS;
            let rows = |from: usize, width: usize| {
                let first = head + from + s * TARGETS * width;
                parameters[first..first + TARGETS * width].to_vec()
            };
            let mut own = parameters[..head].to_vec();
            own.extend(rows(0, inputs));
            own.extend(rows(inputs * last.outputs, 1));
            let mut shifted = part.clone();
            shifted.wanted.rotate_right((2 - s) * TARGETS);
            let (value, exact) = by_burn(
                &shifted,
                &single,
                &Whitening::default(),
                &own,
                &batch,
                Loss::Square,
            );
            sum += f64::from(value) / 3.0;
            let bias = &gradient[head + inputs * last.outputs + s * TARGETS..][..TARGETS];
            for (found, wanted) in bias.iter().zip(&exact[exact.len() - TARGETS..]) {
                assert!((3.0 * found - wanted).abs() < 1e-5, "{found} {wanted}");
            }
        }
        assert!((loss - sum).abs() < 1e-5 * sum, "{loss} {sum}");
    }

    #[test]
    fn dropout_s_gradient_is_the_slope_of_its_loss_and_it_is_off_when_judged() {
        let part = part();
        let first_rows = first_rows(&part);
        let samples = Samples {
            part: &part,
            first_rows: &first_rows,
        };
        let batch: Vec<u32> = (0..576).collect();
        for name in ["TDLTD", "RDLR", "EDLTSD", "DLD"] {
            let structure = Structure::parse(name, 20, None).unwrap();
            let layers = structure.layers(21, TARGETS);
            let whitening = whitening(21);
            let parameters = initial_parameters(&layers, 6, 1.0);
            let new = || Step::new(&layers, &whitening, VALUES, batch.len(), Loss::PseudoHuber);
            let mut step = new().with_dropout(&structure.dropouts());
            let mut gradient = vec![0.0; parameters.len()];
            let whole = step.gradient(samples, &parameters, &batch, &mut gradient);
            assert!((whole - step.loss(samples, &parameters)).abs() < 1e-9, "{name}");
            step.leave_out(0.3, 17);
            let masked = step.gradient(samples, &parameters, &batch, &mut gradient);
            assert!((masked - whole).abs() > 1e-4, "{name}: nothing was left out");
            assert!((whole - step.loss(samples, &parameters)).abs() < 1e-9, "{name}");
            let square: f64 = gradient.iter().map(|&g| f64::from(g) * f64::from(g)).sum();
            let h = 1e-3 / square.sqrt();
            let mut unused = vec![0.0; parameters.len()];
            let mut moved = |sign: f64| {
                let pairs = parameters.iter().zip(&gradient);
                let there: Vec<f32> = pairs
                    .map(|(&p, &g)| (f64::from(p) + sign * h * f64::from(g)) as f32)
                    .collect();
                step.gradient(samples, &there, &batch, &mut unused)
            };
            let slope = (moved(1.0) - moved(-1.0)) / (2.0 * h);
            // A ReLU's kinks are crossed.
            let tolerance = if name.contains('R') { 2e-2 } else { 2e-3 };
            assert!(
                (slope / square - 1.0).abs() < tolerance,
                "{name}: {slope} {square}"
            );
        }
    }

    #[test]
    fn dropout_leaves_out_its_part_and_keeps_the_mean() {
        let mut row = vec![1.0_f32; 20_000];
        let mask = Mask { seed: 3, rate: 0.1 };
        mask.apply(2, 700, &mut row);
        let dropped = row.iter().filter(|&&v| v < 0.5).count();
        assert!((1800..2200).contains(&dropped), "{dropped}");
        let mut again = vec![1.0_f32; 20_000];
        mask.apply(2, 700, &mut again);
        assert_eq!(row, again);
        mask.apply(3, 700, &mut again);
        assert_ne!(row, again);
    }

    #[test]
    fn threads_do_not_change_a_bit() {
        let part = part();
        let first_rows = first_rows(&part);
        let batch: Vec<u32> = (0..576).rev().collect();
        let bits = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| {
                let samples = Samples {
                    part: &part,
                    first_rows: &first_rows,
                };
                let layers = layers("TLSLT", 21);
                let parameters = initial_parameters(&layers, 7, 1.0);
                let mut step = Step::new(&layers, &whitening(21), VALUES, batch.len(), Loss::Square);
                let mut gradient = vec![0.0; parameters.len()];
                let loss = step.gradient(samples, &parameters, &batch, &mut gradient);
                let bits: Vec<u32> = gradient.iter().map(|g| g.to_bits()).collect();
                (loss.to_bits(), bits)
            })
        };
        let one = bits(1);
        assert_eq!(one, bits(2));
        assert_eq!(one, bits(5));
    }
}
