//! Layers on burn tensors: what the training loop differentiates.
//!
//! Parameters stand in one flat vector, layer by layer: weight (outputs × inputs, row-major, as
//! PyTorch has it), then bias. The optimiser, the checkpoint and the model folder see only that.

pub mod dense;
pub mod elementwise;
pub mod init;

use burn::tensor::{Device, Tensor, TensorData};
use dense::dense;
use hydroflex_openapi::model::DenseLayer;

/// Leaves of the graph for one pass over a batch.
pub struct NetworkTensors {
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
    pub fn new(layers: &[DenseLayer], parameters: &[f32], device: &Device) -> Self {
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
        Self { layers: tensors }
    }

    /// Output of the network for a batch of scaled windows: `[batch, inputs]` to `[batch, targets]`.
    #[must_use]
    pub fn forward(&self, windows: Tensor<2>) -> Tensor<2> {
        self.layers.iter().fold(windows, |x, tensors| {
            dense(
                x,
                tensors.weight.clone(),
                tensors.bias.clone(),
                &tensors.layer.activations,
            )
        })
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
