//! `f(x Wᵀ + b)` as one differentiable operation.
//!
//! burn's own operations would do, but its activations are scalar library calls that are computed
//! again in the backward pass. This operation keeps what the derivative needs (the output; for
//! SiLU the input), adds the bias in the same pass, and leaves out the gradient of the first
//! layer's input, which nobody asks for.

use super::elementwise;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::flex::FlexTensor;
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, backend_extension};
use burn::tensor::Tensor;
use hydroflex_openapi::model::Activation;

/// Applies a layer to a batch: `[batch, inputs]`, weight `[outputs, inputs]`, bias `[outputs]`.
#[must_use]
pub fn dense(x: Tensor<2>, weight: Tensor<2>, bias: Tensor<1>, activations: &[Activation]) -> Tensor<2> {
    let output = <Dispatch as DenseOps>::dense(
        x.into_dispatch(),
        weight.into_dispatch(),
        bias.into_dispatch(),
        activations.first().copied(),
    );
    // Letters in a row without an L between them: rare, so burn's own operations do.
    activations
        .iter()
        .skip(1)
        .fold(Tensor::from_dispatch(output), |y, activation| match activation {
            Activation::Tanh => y.tanh(),
            Activation::Sigmoid => burn::tensor::activation::sigmoid(y),
            Activation::Relu => burn::tensor::activation::relu(y),
            Activation::Elu => burn::tensor::activation::elu(y, 1.0),
            Activation::Silu => burn::tensor::activation::silu(y),
        })
}

/// The layer as a backend operation.
#[backend_extension(Flex, Autodiff)]
pub trait DenseOps: Backend {
    /// `f(x Wᵀ + b)`.
    fn dense(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        activation: Option<Activation>,
    ) -> FloatTensor<Self>;
}

/// What a backend computes for [`DenseOps`].
pub trait DenseKernels: Backend {
    /// Output, and what the backward pass needs.
    fn dense_forward(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: &FloatTensor<Self>,
        activation: Option<Activation>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);

    /// `grad · f'`, and its sum over the batch (the gradient of the bias).
    fn dense_chain(
        saved: &FloatTensor<Self>,
        grad: FloatTensor<Self>,
        activation: Option<Activation>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);
}

impl DenseKernels for Flex {
    fn dense_forward(
        x: FlexTensor,
        weight: FlexTensor,
        bias: &FlexTensor,
        activation: Option<Activation>,
    ) -> (FlexTensor, FlexTensor) {
        let mut z = Self::float_matmul(x, Self::float_transpose(weight));
        let bias: &[f32] = bias.storage();
        let values = z.storage_mut::<f32>();
        for row in values.chunks_exact_mut(bias.len()) {
            for (v, b) in row.iter_mut().zip(bias) {
                *v += b;
            }
        }
        let Some(activation) = activation else {
            return (z.clone(), z);
        };
        if elementwise::saves_input(activation) {
            let mut y = FlexTensor::empty(z.layout().shape().clone(), z.dtype());
            y.storage_mut::<f32>().copy_from_slice(z.storage());
            elementwise::apply(activation, y.storage_mut());
            (y, z)
        } else {
            elementwise::apply(activation, values);
            (z.clone(), z)
        }
    }

    fn dense_chain(
        saved: &FlexTensor,
        grad: FlexTensor,
        activation: Option<Activation>,
    ) -> (FlexTensor, FlexTensor) {
        let mut grad = grad.to_contiguous();
        if let Some(activation) = activation {
            elementwise::chain(activation, saved.storage(), grad.storage_mut());
        }
        let outputs = grad.layout().shape()[1];
        let mut sum = FlexTensor::zeros([outputs].into(), grad.dtype());
        let sums = sum.storage_mut::<f32>();
        for row in grad.storage::<f32>().chunks_exact(outputs) {
            for (s, g) in sums.iter_mut().zip(row) {
                *s += g;
            }
        }
        (grad, sum)
    }
}

impl DenseOps for Flex {
    fn dense(
        x: FlexTensor,
        weight: FlexTensor,
        bias: FlexTensor,
        activation: Option<Activation>,
    ) -> FlexTensor {
        Self::dense_forward(x, weight, &bias, activation).0
    }
}

/// Gradient of [`DenseOps::dense`]; holds nothing, its state is in the graph.
#[derive(Debug)]
struct DenseBackward;

/// Input, weight and what the activation's derivative needs.
#[derive(Debug, Clone)]
struct DenseState<B: Backend> {
    x: FloatTensor<B>,
    weight: FloatTensor<B>,
    saved: FloatTensor<B>,
    activation: Option<Activation>,
}

impl<B: DenseKernels> Backward<B, 3> for DenseBackward {
    type State = DenseState<B>;

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let [x_node, weight_node, bias_node] = ops.parents;
        let DenseState {
            x,
            weight,
            saved,
            activation,
        } = ops.state;
        let grad = grads.consume::<B>(&ops.node);
        let (grad, bias_grad) = B::dense_chain(&saved, grad, activation);
        if let Some(node) = bias_node {
            grads.register::<B>(node.id, bias_grad);
        }
        if let Some(node) = weight_node {
            grads.register::<B>(node.id, B::float_matmul(B::float_transpose(grad.clone()), x));
        }
        if let Some(node) = x_node {
            grads.register::<B>(node.id, B::float_matmul(grad, weight));
        }
    }
}

impl<B: DenseKernels, C: CheckpointStrategy> DenseOps for Autodiff<B, C> {
    fn dense(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        activation: Option<Activation>,
    ) -> FloatTensor<Self> {
        let prepared = DenseBackward
            .prepare::<C>([x.node(), weight.node(), bias.node()])
            .compute_bound()
            .stateful();
        let (x, weight) = (x.into_primitive(), weight.into_primitive());
        let (output, saved) = B::dense_forward(x.clone(), weight.clone(), bias.primitive(), activation);
        match prepared {
            OpsKind::Tracked(prepared) => prepared.finish(
                DenseState {
                    x,
                    weight,
                    saved,
                    activation,
                },
                output,
            ),
            OpsKind::UnTracked(prepared) => prepared.finish(output),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::{Loss, NetworkTensors, batch_tensor, init::initial_parameters};
    use crate::structure::{Form, Structure};
    use burn::tensor::Device;
    use hydroflex_openapi::model::DenseLayer;

    fn exact(activation: Activation, z: f64) -> f64 {
        match activation {
            Activation::Tanh => z.tanh(),
            Activation::Sigmoid => 1.0 / (1.0 + (-z).exp()),
            Activation::Relu => z.max(0.0),
            Activation::Elu if z > 0.0 => z,
            Activation::Elu => z.exp_m1(),
            Activation::Silu => z / (1.0 + (-z).exp()),
        }
    }

    /// Loss in f64, by the definition.
    fn loss_f64(
        layers: &[DenseLayer],
        parameters: &[f64],
        windows: &[f32],
        targets: &[f32],
        loss: Loss,
    ) -> f64 {
        let mut total = 0.0;
        for (window, target) in windows.chunks(6).zip(targets.chunks(2)) {
            let mut x: Vec<f64> = window.iter().map(|&v| f64::from(v)).collect();
            let mut rest = parameters;
            for layer in layers {
                let (weight, tail) = rest.split_at(layer.outputs * layer.inputs);
                let (bias, tail) = tail.split_at(layer.outputs);
                rest = tail;
                x = weight
                    .chunks(layer.inputs)
                    .zip(bias)
                    .map(|(row, b)| {
                        let z = b + row.iter().zip(&x).map(|(w, v)| w * v).sum::<f64>();
                        layer.activations.iter().fold(z, |z, &a| exact(a, z))
                    })
                    .collect();
            }
            total += x
                .iter()
                .zip(target)
                .map(|(a, &b)| loss.value(a - f64::from(b)))
                .sum::<f64>();
        }
        total / targets.len() as f64
    }

    #[test]
    fn gradients_agree_with_finite_differences_of_an_independent_loss() {
        for name in ["L", "RLR", "TLSLT", "ELE", "TS", "best"] {
            let width = if name == "best" { Some(8) } else { None };
            let layers = Structure::parse(name, 4, width).unwrap().layers(6, 2);
            let wide = |i: usize| ((i * 2_654_435_761) % 1000) as f32 / 500.0 - 1.0;
            let windows: Vec<f32> = (0..30).map(wide).collect();
            let targets: Vec<f32> = (30..40).map(wide).collect();
            let parameters = initial_parameters(&layers, 1, 1.0);
            let exact: Vec<f64> = parameters.iter().map(|&p| f64::from(p)).collect();
            let kind = if name == "best" {
                Loss::PseudoHuber
            } else {
                Loss::Square
            };
            let loss_of = |p: &[f64]| loss_f64(&layers, p, &windows, &targets, kind);
            let device = Device::flex().autodiff();
            let mut gradient = vec![0.0; parameters.len()];
            let loss = NetworkTensors::new(Form::Dense, &layers, &parameters, &device).loss_and_gradient(
                batch_tensor(windows.clone(), 5, &device),
                batch_tensor(targets.clone(), 5, &device),
                kind,
                10.0,
                &mut gradient,
            );
            assert!((f64::from(loss) - loss_of(&exact)).abs() < 1e-6, "{name}");
            for i in 0..parameters.len() {
                let h = 1e-5;
                let (mut up, mut down) = (exact.clone(), exact.clone());
                up[i] += h;
                down[i] -= h;
                let slope = (loss_of(&up) - loss_of(&down)) / (2.0 * h);
                // f32 arithmetic on values of size one.
                assert!(
                    (f64::from(gradient[i]) - slope).abs() < 2e-6,
                    "{name} parameter {i}: {} {slope}",
                    gradient[i]
                );
            }
        }
    }
}
