//! Loss and gradient of a batch by burn: what [`super::step`] is checked against, and what trains the networks for
//! comparison, which have no step of their own.

use super::prepare::Part;
use super::step::Samples;
use crate::network::{Loss, NetworkTensors, batch_tensor};
use crate::structure::Form;
use burn::tensor::Device;
use hydroflex_openapi::model::DenseLayer;

/// Windows per batch where no gradient is needed; bounds memory.
const LARGEST_BATCH: usize = 2048;

/// A network that burn differentiates.
#[derive(Debug, Clone)]
pub struct Autodiff {
    /// How its layers are put together.
    pub form: Form,
    /// Layers.
    pub layers: Vec<DenseLayer>,
    /// What is minimised.
    pub loss: Loss,
}

impl Autodiff {
    /// Mean loss of the windows `batch` of `samples`, and its gradient (flat, as the parameters).
    ///
    /// # Panics
    /// When `parameters` or `gradient` have another length than the layers need.
    #[must_use]
    pub fn gradient(
        &self,
        samples: Samples<'_>,
        parameters: &[f32],
        batch: &[u32],
        gradient: &mut [f32],
    ) -> f64 {
        let plain = Device::flex();
        let device = plain.autodiff();
        let rows = batch.iter().map(|&window| samples.first_rows[window as usize]);
        let (windows, wanted) = gather(samples.part, rows);
        gradient.fill(0.0);
        let loss = NetworkTensors::new(self.form, &self.layers, parameters, &device).loss_and_gradient(
            batch_tensor(windows, batch.len(), &device),
            batch_tensor(wanted, batch.len(), &device),
            self.loss,
            (batch.len() * samples.part.targets.width) as f32,
            gradient,
        );
        f64::from(loss)
    }

    /// Mean loss of all windows of `samples`.
    #[must_use]
    pub fn loss(&self, samples: Samples<'_>, parameters: &[f32]) -> f64 {
        let outputs = self.outputs(samples, parameters);
        let width = samples.part.targets.width;
        let rows = samples
            .first_rows
            .iter()
            .map(|&row| row as usize + samples.part.windows.steps - 1);
        let sum: f64 = rows
            .zip(outputs.chunks(width))
            .flat_map(|(row, outputs)| outputs.iter().zip(&samples.part.wanted[row * width..]))
            .map(|(output, wanted)| self.loss.value(f64::from(output - wanted)))
            .sum();
        sum / outputs.len().max(1) as f64
    }

    /// Outputs for all windows of `samples`, window by window.
    ///
    /// # Panics
    /// When `parameters` has another length than the layers need.
    #[must_use]
    pub fn outputs(&self, samples: Samples<'_>, parameters: &[f32]) -> Vec<f32> {
        let device = Device::flex();
        let network = NetworkTensors::new(self.form, &self.layers, parameters, &device);
        let mut outputs = Vec::with_capacity(samples.first_rows.len() * samples.part.targets.width);
        for some in samples.first_rows.chunks(LARGEST_BATCH) {
            let (windows, _) = gather(samples.part, some.iter().copied());
            let output = network
                .forward(batch_tensor(windows, some.len(), &device))
                .into_data();
            outputs.extend_from_slice(output.as_slice::<f32>().expect("the network's output is f32"));
        }
        outputs
    }
}

/// Copies windows and what is wanted at their ends.
fn gather(part: &Part, first_rows: impl ExactSizeIterator<Item = u32>) -> (Vec<f32>, Vec<f32>) {
    let width = part.targets.width;
    let mut values = Vec::with_capacity(first_rows.len() * part.windows.steps * part.series.width);
    let mut wanted = Vec::with_capacity(first_rows.len() * width);
    for first in first_rows.map(|row| row as usize) {
        let row = first + part.windows.steps - 1;
        values.extend_from_slice(part.series.window(first, part.windows.steps));
        wanted.extend_from_slice(&part.wanted[row * width..(row + 1) * width]);
    }
    (values, wanted)
}
