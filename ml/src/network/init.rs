//! Initial weights and random order, both from a counter-based generator: any epoch's order can be
//! made again without the epochs before it, so a resumed training sees what it would have seen.

use hydroflex_openapi::model::DenseLayer;
use rand_chacha::ChaCha12Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

/// Stream of the initial weights; epochs use streams 1, 2, ….
const STREAM_WEIGHTS: u64 = 0;

fn generator(seed: u64, stream: u64) -> ChaCha12Rng {
    let mut rng = ChaCha12Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    rng
}

/// Uniform in [−1, 1), 24 random bits.
fn symmetric(rng: &mut ChaCha12Rng) -> f32 {
    let bits = u16::try_from(rng.next_u32() >> 16).unwrap_or(0);
    (f32::from(bits) + 0.5) / 32768.0 - 1.0
}

/// Weights and biases uniform in ±1/√inputs, PyTorch's default for linear layers, which the
/// published networks started from. `scale_last` multiplies the last layer's.
#[must_use]
pub fn initial_parameters(layers: &[DenseLayer], seed: u64, scale_last: f32) -> Vec<f32> {
    let mut rng = generator(seed, STREAM_WEIGHTS);
    let mut parameters = Vec::with_capacity(crate::structure::parameter_count(layers));
    for (position, layer) in layers.iter().enumerate() {
        let last = position + 1 == layers.len();
        let bound = (layer.inputs as f32).sqrt().recip() * if last { scale_last } else { 1.0 };
        parameters.extend((0..layer.outputs * (layer.inputs + 1)).map(|_| bound * symmetric(&mut rng)));
    }
    parameters
}

/// The order of `count` windows in epoch `epoch`: Fisher–Yates.
#[must_use]
pub fn epoch_order(count: usize, seed: u64, epoch: usize) -> Vec<u32> {
    let count = u32::try_from(count).unwrap_or(u32::MAX);
    let mut order: Vec<u32> = (0..count).collect();
    let mut rng = generator(seed, 1 + epoch as u64);
    for i in (1..order.len()).rev() {
        // Bias of the multiplication is below count / 2³², invisible here.
        let j = (u64::from(rng.next_u32()) * (i as u64 + 1)) >> 32;
        order.swap(i, usize::try_from(j).unwrap_or(0));
    }
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_epoch_visits_every_window_once() {
        let mut order = epoch_order(1000, 3, 5);
        assert_ne!(order, epoch_order(1000, 3, 6));
        order.sort_unstable();
        assert!(order.iter().enumerate().all(|(i, &o)| i == o as usize));
    }
}
