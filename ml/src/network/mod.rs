//! Networks on burn tensors: what burn differentiates, and what the training step of processors is checked against.
//!
//! Parameters stand in one flat vector, layer by layer: weight (outputs × inputs, row-major, as
//! PyTorch has it), then bias. The optimiser, the checkpoint and the model folder see only that.

pub mod dense;
pub mod elementwise;
pub mod init;

use crate::structure::{Form, KERNEL};
use burn::tensor::activation::{relu, sigmoid};
use burn::tensor::module::conv1d;
use burn::tensor::ops::ConvOptions;
use burn::tensor::{Device, Tensor, TensorData};
use dense::dense;
use hydroflex_openapi::model::DenseLayer;

/// Leaves of the graph for one pass over a batch.
pub struct NetworkTensors {
    form: Form,
    layers: Vec<LayerTensors>,
}

/// What is minimised, as a function of each error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Loss {
    /// e².
    Square,
    /// 2 (√(1 + e²) − 1): e² for small errors, 2 |e| for large ones, so that rare large errors do
    /// not decide.
    PseudoHuber,
}

impl Loss {
    fn of(self, error: Tensor<2>) -> Tensor<2> {
        let square = error.clone() * error;
        match self {
            Self::Square => square,
            Self::PseudoHuber => ((square + 1.0).sqrt() - 1.0) * 2.0,
        }
    }

    /// Derivative of [`Self::value`].
    #[must_use]
    pub fn slope(self, error: f32) -> f32 {
        match self {
            Self::Square => 2.0 * error,
            Self::PseudoHuber => 2.0 * error / (1.0 + error * error).sqrt(),
        }
    }

    /// Of one error.
    #[must_use]
    pub fn value(self, error: f64) -> f64 {
        match self {
            Self::Square => error * error,
            Self::PseudoHuber => 2.0 * ((1.0 + error * error).sqrt() - 1.0),
        }
    }
}

struct LayerTensors {
    weight: Tensor<2>,
    bias: Tensor<1>,
    layer: DenseLayer,
}

impl NetworkTensors {
    /// Tensors with the values of `parameters` on `device`; with gradients where `device` records them.
    ///
    /// # Panics
    /// When `parameters` has another length than the layers need.
    #[must_use]
    pub fn new(form: Form, layers: &[DenseLayer], parameters: &[f32], device: &Device) -> Self {
        let mut rest = parameters;
        let mut take = |count: usize| {
            let (head, tail) = rest.split_at(count);
            rest = tail;
            head.to_vec()
        };
        let tensors = layers
            .iter()
            .map(|layer| {
                let weight = take(layer.outputs * layer.inputs);
                let bias = take(layer.outputs);
                let weight =
                    Tensor::from_data(TensorData::new(weight, [layer.outputs, layer.inputs]), device);
                let bias = Tensor::from_data(TensorData::new(bias, [layer.outputs]), device);
                let (weight, bias) = if device.is_autodiff() {
                    (weight.require_grad(), bias.require_grad())
                } else {
                    (weight, bias)
                };
                LayerTensors {
                    weight,
                    bias,
                    layer: layer.clone(),
                }
            })
            .collect();
        assert!(rest.is_empty(), "{} parameters too many", rest.len());
        Self {
            form,
            layers: tensors,
        }
    }

    /// Output of the network for a batch of scaled windows: `[batch, inputs]` to `[batch, targets]`.
    #[must_use]
    pub fn forward(&self, windows: Tensor<2>) -> Tensor<2> {
        match self.form {
            Form::Dense => self.dense(windows),
            Form::Rnn { steps } => self.rnn(windows, steps),
            Form::Lstm { steps } => self.lstm(windows, steps),
            Form::Cnn { steps } => self.cnn(windows, steps),
        }
    }

    fn dense(&self, windows: Tensor<2>) -> Tensor<2> {
        self.layers.iter().fold(windows, |x, tensors| {
            dense(
                x,
                tensors.weight.clone(),
                tensors.bias.clone(),
                &tensors.layer.activations,
            )
        })
    }

    fn linear(&self, layer: usize, x: Tensor<2>) -> Tensor<2> {
        dense(
            x,
            self.layers[layer].weight.clone(),
            self.layers[layer].bias.clone(),
            &[],
        )
    }

    /// What the first layer makes of each sample: `steps` tensors `[batch, outputs]`.
    fn samples(&self, windows: Tensor<2>, steps: usize) -> impl Iterator<Item = Tensor<2>> + '_ {
        let [batch, values] = windows.dims();
        let channels = values / steps;
        (0..steps).map(move |step| {
            // The windows are cut, which have no gradient, not what the layer makes of them: the gradient of a cut is
            // as large as what it was cut from.
            let sample = windows
                .clone()
                .slice([0..batch, step * channels..(step + 1) * channels]);
            self.linear(0, sample)
        })
    }

    /// h ← tanh(W x + b + V h + c) over the samples, from h = 0; the last h decides.
    fn rnn(&self, windows: Tensor<2>, steps: usize) -> Tensor<2> {
        let start = Tensor::zeros(
            [windows.dims()[0], self.layers[1].layer.inputs],
            &windows.device(),
        );
        let hidden = self
            .samples(windows, steps)
            .fold(start, |hidden, sample| (sample + self.linear(1, hidden)).tanh());
        self.linear(2, hidden)
    }

    /// Hochreiter and Schmidhuber's cell with a forget gate, over the samples; the last output decides.
    fn lstm(&self, windows: Tensor<2>, steps: usize) -> Tensor<2> {
        let (batch, width) = (windows.dims()[0], self.layers[1].layer.inputs);
        let mut hidden = Tensor::<2>::zeros([batch, width], &windows.device());
        let mut cell = hidden.clone();
        for sample in self.samples(windows, steps) {
            let gates = sample + self.linear(1, hidden);
            let gate = |g: usize| gates.clone().slice([0..batch, g * width..(g + 1) * width]);
            let (take, keep, give) = (sigmoid(gate(0)), sigmoid(gate(1)), sigmoid(gate(3)));
            cell = keep * cell + take * gate(2).tanh();
            hidden = give * cell.clone().tanh();
        }
        self.linear(2, hidden)
    }

    /// Two convolutions of stride 2 with ReLU, then a linear layer.
    fn cnn(&self, windows: Tensor<2>, steps: usize) -> Tensor<2> {
        let [batch, values] = windows.dims();
        let mut x = windows.reshape([batch, steps, values / steps]).swap_dims(1, 2);
        for tensors in &self.layers[..2] {
            let shape = [tensors.layer.outputs, x.dims()[1], KERNEL];
            let options = ConvOptions::new([2], [KERNEL / 2], [1], 1);
            let weight = tensors.weight.clone().reshape(shape);
            x = relu(conv1d(x, weight, Some(tensors.bias.clone()), options));
        }
        let [_, channels, left] = x.dims();
        self.linear(2, x.reshape([batch, channels * left]))
    }

    /// Loss of a batch, and its gradient added to `gradient` (flat, as the parameters).
    ///
    /// `divisor` is the number of values that the mean is over; it may exceed this batch when the
    /// batch is one part of a larger one.
    ///
    /// # Panics
    /// When the device does not record gradients, or `gradient` has another length.
    pub fn loss_and_gradient(
        &self,
        windows: Tensor<2>,
        targets: Tensor<2>,
        loss: Loss,
        divisor: f32,
        gradient: &mut [f32],
    ) -> f32 {
        let error = self.forward(windows) - targets;
        let loss = loss.of(error).sum() / divisor;
        let value = first_value(&loss.clone().inner().into_data());
        let mut grads = loss.backward();
        let mut rest = gradient;
        for tensors in &self.layers {
            let weight = tensors.weight.grad_remove(&mut grads).map(Tensor::into_data);
            let bias = tensors.bias.grad_remove(&mut grads).map(Tensor::into_data);
            for (data, count) in [
                (weight, tensors.layer.outputs * tensors.layer.inputs),
                (bias, tensors.layer.outputs),
            ] {
                let (head, tail) = rest.split_at_mut(count);
                rest = tail;
                let data = data.expect("every parameter takes part in the loss");
                for (slot, g) in head
                    .iter_mut()
                    .zip(data.as_slice::<f32>().expect("parameters are f32"))
                {
                    *slot += g;
                }
            }
        }
        value
    }
}

fn first_value(data: &TensorData) -> f32 {
    data.as_slice::<f32>().expect("a loss is f32")[0]
}

/// A batch as a tensor.
#[must_use]
pub fn batch_tensor(values: Vec<f32>, rows: usize, device: &Device) -> Tensor<2> {
    let columns = values.len() / rows.max(1);
    Tensor::from_data(TensorData::new(values, [rows, columns]), device)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::init::initial_parameters;
    use crate::structure::Structure;

    const STEPS: usize = 7;
    const CHANNELS: usize = 2;
    const WIDTH: usize = 4;

    /// W x + b in f64.
    fn affine(rest: &mut &[f32], x: &[f64], outputs: usize) -> Vec<f64> {
        let (weight, tail) = rest.split_at(outputs * x.len());
        let (bias, tail) = tail.split_at(outputs);
        *rest = tail;
        let row = |(row, b): (&[f32], &f32)| {
            f64::from(*b) + row.iter().zip(x).map(|(&w, x)| f64::from(w) * x).sum::<f64>()
        };
        weight.chunks(x.len()).zip(bias).map(row).collect()
    }

    fn rnn(parameters: &[f32], window: &[f64]) -> f64 {
        let mut hidden = vec![0.0; WIDTH];
        let mut rest = parameters;
        for sample in window.chunks(CHANNELS) {
            rest = parameters;
            let (a, b) = (
                affine(&mut rest, sample, WIDTH),
                affine(&mut rest, &hidden, WIDTH),
            );
            hidden = a.iter().zip(&b).map(|(a, b)| (a + b).tanh()).collect();
        }
        affine(&mut rest, &hidden, 1)[0]
    }

    fn lstm(parameters: &[f32], window: &[f64]) -> f64 {
        let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
        let (mut hidden, mut cell) = (vec![0.0; WIDTH], vec![0.0; WIDTH]);
        let mut rest = parameters;
        for sample in window.chunks(CHANNELS) {
            rest = parameters;
            let (a, b) = (
                affine(&mut rest, sample, 4 * WIDTH),
                affine(&mut rest, &hidden, 4 * WIDTH),
            );
            let gate = |g: usize, i: usize| a[g * WIDTH + i] + b[g * WIDTH + i];
            for (i, (cell, hidden)) in cell.iter_mut().zip(&mut hidden).enumerate() {
                *cell = sigmoid(gate(1, i)) * *cell + sigmoid(gate(0, i)) * gate(2, i).tanh();
                *hidden = sigmoid(gate(3, i)) * cell.tanh();
            }
        }
        affine(&mut rest, &hidden, 1)[0]
    }

    fn cnn(parameters: &[f32], window: &[f64]) -> f64 {
        let mut rest = parameters;
        // Values by sample.
        let mut x: Vec<Vec<f64>> = window.chunks(CHANNELS).map(<[f64]>::to_vec).collect();
        for outputs in [WIDTH / 2, WIDTH] {
            let channels = x[0].len();
            let mut after = rest;
            let seen = |centre: usize| -> Vec<f64> {
                let values = (0..channels).flat_map(|c| (0..KERNEL).map(move |k| (c, centre + k)));
                values
                    .map(|(c, at)| {
                        at.checked_sub(KERNEL / 2)
                            .and_then(|at| x.get(at))
                            .map_or(0.0, |x| x[c])
                    })
                    .collect()
            };
            let convolved = (0..x.len())
                .step_by(2)
                .map(|centre| {
                    after = rest;
                    let sums = affine(&mut after, &seen(centre), outputs);
                    sums.into_iter().map(|v| v.max(0.0)).collect()
                })
                .collect();
            x = convolved;
            rest = after;
        }
        let flat: Vec<f64> = (0..WIDTH).flat_map(|c| x.iter().map(move |x| x[c])).collect();
        affine(&mut rest, &flat, 1)[0]
    }

    type Definition = fn(&[f32], &[f64]) -> f64;

    #[test]
    fn networks_for_comparison_follow_their_definitions() {
        let device = Device::flex();
        let windows: Vec<f32> = (0..3 * STEPS * CHANNELS)
            .map(|i| (i as f32 * 0.7).sin())
            .collect();
        let definitions: [(&str, Definition); 3] = [("RNN", rnn), ("LSTM", lstm), ("CNN", cnn)];
        for (name, definition) in definitions {
            let structure = Structure::parse_any(name, STEPS, Some(WIDTH)).unwrap();
            let layers = structure.layers(STEPS * CHANNELS, 1);
            let parameters = initial_parameters(&layers, 8, 1.0);
            let network = NetworkTensors::new(structure.form, &layers, &parameters, &device);
            let output = network
                .forward(batch_tensor(windows.clone(), 3, &device))
                .into_data();
            for (found, window) in output
                .as_slice::<f32>()
                .unwrap()
                .iter()
                .zip(windows.chunks(STEPS * CHANNELS))
            {
                let window: Vec<f64> = window.iter().map(|&v| f64::from(v)).collect();
                let exact = definition(&parameters, &window);
                assert!(
                    (f64::from(*found) - exact).abs() < 1e-6,
                    "{name}: {found} {exact}"
                );
            }
        }
    }
}
