//! The current weights as the products want them, and gradients as the parameters stand.
//!
//! Whitening, `z = P x + o`, is linear, as is what the first layer does with z: `W z + b = (W P) x + (W o + b)`. Where it
//! costs less, the product W P is made once per batch and the windows stay as they are; the gradient
//! with respect to W is then the one with respect to W P, times Pᵀ, plus that of the bias, times oᵀ.

use super::both;
use super::pass::BLOCK;
use super::products::{LANES, Rows, multiply, multiply_transposed, transpose};
use crate::simd::Level;
use crate::train::prepare::Whitening;
use hydroflex_openapi::model::DenseLayer;

/// What a window is before the first layer.
pub(super) enum First {
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

pub(super) struct Network {
    pub(super) level: Level,
    /// As many as the widest layer has outputs.
    pub(super) zeros: Rows,
    pub(super) first: First,
    pub(super) layers: Vec<Layer>,
}

/// A layer with the current weights, turned as the products want them.
pub(super) struct Layer {
    pub(super) shape: DenseLayer,
    /// Whether values are left out after it in training.
    pub(super) dropout: bool,
    /// A row per input: for the way forward. In a folded first layer, per window value.
    pub(super) forward: Rows,
    /// A row per output: for the way back; empty in the first layer.
    pub(super) backward: Rows,
    pub(super) bias: Rows,
    /// A row per input, unfolded: what the folded one is made of.
    pub(super) unfolded: Rows,
    /// Where the rows of a block of outputs begin.
    pub(super) places: Vec<usize>,
}

impl Network {
    pub(super) fn new(
        level: Level,
        layers: &[DenseLayer],
        whitening: &Whitening,
        values: usize,
        batch: usize,
    ) -> Self {
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
    pub(super) fn outputs(&self) -> usize {
        self.layers.last().map_or(0, |layer| layer.shape.outputs)
    }

    /// Turns the parameters.
    pub(super) fn take(&mut self, parameters: &[f32]) {
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
    pub(super) fn give(&mut self, gradients: &[(Rows, Rows)], gradient: &mut [f32]) {
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
