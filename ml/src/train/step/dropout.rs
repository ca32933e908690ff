//! What a step leaves out by chance.

/// Values that are left out of a step, by chance: a function of the seed, the window, the layer and the value, of nothing
/// else. Those that stay are larger by as much, so that the sum is the same in the mean.
#[derive(Debug, Clone, Copy)]
pub(super) struct Mask {
    pub(super) seed: u64,
    /// Part left out.
    pub(super) rate: f64,
}

impl Mask {
    /// Multiplies a row of values (or of derivatives) of the window that begins at `window` by 0 or 1 / (1 − rate).
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "the rate is in [0, 1)"
    )]
    pub(super) fn apply(self, layer: usize, window: usize, row: &mut [f32]) {
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
