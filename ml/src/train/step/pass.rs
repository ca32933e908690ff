//! Forward and backward through the network, a block of windows at a time.

use super::Samples;
use super::dropout::Mask;
use super::network::{First, Network};
use super::products::{Rows, multiply, multiply_transposed};
use crate::activate;
use crate::network::{Loss, elementwise};
use crate::simd::Level;
use crate::train::prepare::Part;
use hydroflex_openapi::model::Activation;

/// Windows that go through the network together.
pub(super) const BLOCK: usize = 96;

/// What one thread needs.
pub(super) struct Scratch {
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
    pub(super) gradients: Vec<(Rows, Rows)>,
    /// What is left out at present; nothing when a loss is judged.
    pub(super) mask: Option<Mask>,
    pub(super) loss: f64,
}

impl Scratch {
    pub(super) fn new(network: &Network) -> Self {
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
    pub(super) fn gradient(
        &mut self,
        network: &Network,
        samples: Samples<'_>,
        batch: &[u32],
        loss: Loss,
        divisor: f32,
    ) {
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
    pub(super) fn loss_of(&mut self, network: &Network, part: &Part, first_rows: &[u32], loss: Loss) -> f64 {
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

    pub(super) fn add(&mut self, other: &Self) {
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
fn is_beside(position: usize, activation: Activation) -> bool {
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
