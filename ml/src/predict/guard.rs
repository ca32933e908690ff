//! Bounds of the estimates: near a linear map with small coefficients, see
//! [`hydroflex_openapi::model::Guard`].

use super::kernel::{PANEL, PackedLayer};
use crate::model::weights::LinearWeights;
use hydroflex_openapi::model::{Guard, ScaledChannel};

/// The guide, packed, and the bounds in scaled units.
#[derive(Debug, Clone, PartialEq)]
pub struct GuardKernel {
    /// None when its values come from beside the network's first layer.
    guide: Option<PackedLayer>,
    slack: Vec<f32>,
    range: Vec<[f32; 2]>,
}

impl GuardKernel {
    /// Packs the guide of targets with these scales, if it is not beside the network's first layer.
    ///
    /// # Panics
    /// When weights and biases do not fit.
    #[must_use]
    #[allow(clippy::cast_possible_truncation, reason = "scaled estimates are f32")]
    pub fn new(guide: Option<&LinearWeights>, guard: &Guard, targets: &[ScaledChannel]) -> Self {
        let scaled = |value: f64, channel: &ScaledChannel| ((value - channel.offset) / channel.scale) as f32;
        Self {
            guide: guide.map(|guide| PackedLayer::new(guide, &[])),
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
        self.guide.as_ref().map_or(self.slack.len(), PackedLayer::padded)
    }

    /// Limits the estimates of `rows` scaled windows that begin `stride` values apart, one row of scaled targets
    /// per window, and says for each window whether one of them was changed. `scratch` has room for [`Self::padded`]
    /// values per window; if the guide is beside another layer, its values stand there, one row of targets per window.
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
        if let Some(guide) = &self.guide {
            guide.forward(x, stride, rows, scratch);
        }
        self.clip(scratch, [self.padded(), 1], estimates, &mut limited[..rows]);
    }

    /// The same for a panel: value i of the window in column c is `x[places[i] + c]`. `scratch` holds
    /// [`Self::padded`] values for each of [`PANEL`] columns; if the guide is beside another layer, target by target its
    /// values for all columns.
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
        if let Some(guide) = &self.guide {
            guide.forward_panel(x, places, columns, scratch);
        }
        self.clip(scratch, [1, PANEL], estimates, &mut limited[..columns]);
    }

    /// Limits a row of estimates for each of `limited`, and says whether one of them was changed. The guide of row r
    /// and target t is `guides[r · strides[0] + t · strides[1]]`.
    fn clip(&self, guides: &[f32], strides: [usize; 2], estimates: &mut [f32], limited: &mut [bool]) {
        let targets = self.slack.len();
        limited.fill(false);
        for (target, (&slack, &[min, max])) in self.slack.iter().zip(&self.range).enumerate() {
            let hold = |slot: &mut f32, guide: f32, limited: &mut bool| {
                let within = slot.max(guide - slack).min(guide + slack).max(min).min(max);
                // A NaN becomes a bound, and differs from what it was.
                #[allow(clippy::float_cmp, reason = "whether the value was touched at all")]
                {
                    *limited |= within != *slot;
                }
                *slot = within;
            };
            let guides = &guides[target * strides[1]..];
            if targets == 1 && strides[0] == 1 {
                // What the compiler makes vectors of.
                for ((slot, &guide), limited) in estimates.iter_mut().zip(guides).zip(&mut *limited) {
                    hold(slot, guide, limited);
                }
            } else {
                for (row, limited) in limited.iter_mut().enumerate() {
                    hold(
                        &mut estimates[row * targets + target],
                        guides[row * strides[0]],
                        limited,
                    );
                }
            }
        }
    }
}
