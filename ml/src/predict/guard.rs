//! Bounds of the estimates: near a linear map with small coefficients, see
//! [`hydroflex_openapi::model::Guard`].

use super::kernel::{PANEL, PackedLayer};
use crate::model::weights::LinearWeights;
use hydroflex_openapi::model::{Guard, ScaledChannel};

/// The guide, packed, and the bounds in scaled units.
#[derive(Debug, Clone, PartialEq)]
pub struct GuardKernel {
    guide: PackedLayer,
    slack: Vec<f32>,
    range: Vec<[f32; 2]>,
}

impl GuardKernel {
    /// Packs the guide of targets with these scales.
    ///
    /// # Panics
    /// When weights and biases do not fit.
    #[must_use]
    #[allow(clippy::cast_possible_truncation, reason = "scaled estimates are f32")]
    pub fn new(guide: &LinearWeights, guard: &Guard, targets: &[ScaledChannel]) -> Self {
        let scaled = |value: f64, channel: &ScaledChannel| ((value - channel.offset) / channel.scale) as f32;
        Self {
            guide: PackedLayer::new(guide, &[]),
            slack: guard
                .slack
                .iter()
                .zip(targets)
                .map(|(slack, channel)| (slack / channel.scale) as f32)
                .collect(),
            range: guard
                .min
                .iter()
                .zip(&guard.max)
                .zip(targets)
                .map(|((&min, &max), channel)| [scaled(min, channel), scaled(max, channel)])
                .collect(),
        }
    }

    /// Values of scratch memory per window.
    #[must_use]
    pub fn padded(&self) -> usize {
        self.guide.padded()
    }

    /// Limits the estimates of `rows` scaled windows that begin `stride` values apart, one row of scaled targets
    /// per window, and says for each window whether one of them was changed.
    ///
    /// # Panics
    /// When a slice is too short.
    pub fn limit(
        &self,
        x: &[f32],
        stride: usize,
        rows: usize,
        scratch: &mut [f32],
        estimates: &mut [f32],
        limited: &mut [bool],
    ) {
        self.guide.forward(x, stride, rows, scratch);
        let guides = scratch.chunks(self.guide.padded());
        let estimates = estimates.chunks_mut(self.slack.len());
        for ((guide, row), limited) in guides.zip(estimates).zip(&mut limited[..rows]) {
            *limited = self.clip(row, |target| guide[target]);
        }
    }

    /// The same for a panel: value i of the window in column c is `x[places[i] + c]`. `scratch` holds
    /// [`Self::padded`] values for each of [`PANEL`] columns.
    ///
    /// # Panics
    /// When a slice is too short or there are more columns than [`PANEL`].
    pub fn limit_panel(
        &self,
        x: &[f32],
        places: &[usize],
        columns: usize,
        scratch: &mut [f32],
        estimates: &mut [f32],
        limited: &mut [bool],
    ) {
        self.guide.forward_panel(x, places, columns, scratch);
        let estimates = estimates.chunks_mut(self.slack.len());
        for ((column, row), limited) in estimates.enumerate().zip(&mut limited[..columns]) {
            *limited = self.clip(row, |target| scratch[target * PANEL + column]);
        }
    }

    /// Limits one row of estimates; true if one was changed.
    fn clip(&self, row: &mut [f32], guide: impl Fn(usize) -> f32) -> bool {
        let mut limited = false;
        let bounds = self.slack.iter().zip(&self.range);
        for (target, (slot, (slack, [min, max]))) in row.iter_mut().zip(bounds).enumerate() {
            let guide = guide(target);
            let within = slot.max(guide - slack).min(guide + slack).max(*min).min(*max);
            // A NaN becomes a bound, and differs from what it was.
            #[allow(clippy::float_cmp, reason = "whether the value was touched at all")]
            {
                limited |= within != *slot;
            }
            *slot = within;
        }
        limited
    }
}
