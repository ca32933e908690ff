//! Loss and gradient of a batch on processors: what burn's autodiff computes, on buffers that are made once.
//!
//! ```text
//! windows (where they stand) → whitened → layer → … → layer → error → gradients of weights and biases
//! ```
//!
//! A batch is cut into two halves for two threads, a half into blocks of 96 windows, which go forward and
//! backward through the whole network while they are in the second-level cache. Halves are fixed and added in order:
//! the bits do not depend on the number of threads.

mod dropout;
mod network;
mod pass;
mod products;
#[cfg(test)]
mod tests;

pub use dropout::dropout_seed;

use super::prepare::{Part, Whitening};
use crate::network::Loss;
use crate::simd::{Level, level};
use dropout::Mask;
use hydroflex_openapi::model::DenseLayer;
use network::Network;
use pass::Scratch;

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
