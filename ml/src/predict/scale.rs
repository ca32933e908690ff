//! From the columns' units to the network's: scaled, held at the limits, rounded to f32.

#![allow(
    unsafe_code,
    clippy::inline_always,
    clippy::needless_range_loop,
    reason = "vector code has to be inlined into the function that enables the instructions"
)]

use crate::simd::{Simd, dispatch, level};
use hydroflex_openapi::model::ModelConfig;

/// What is done to the values of one window, in their order.
#[derive(Debug, Clone, PartialEq)]
pub struct ScaleMap {
    offset: Vec<f64>,
    /// 1 / scale.
    inverse: Vec<f64>,
    /// Scaled values at which inputs are held; infinite where they are not.
    low: Vec<f64>,
    high: Vec<f64>,
    /// Range of the envelope, in the columns' units; infinite where there is none.
    min: Vec<f64>,
    max: Vec<f64>,
}

/// What windows come as.
pub trait Sample: Copy + Into<f64> + sealed::Scaled {}

impl Sample for f32 {}
impl Sample for f64 {}

mod sealed {
    use super::ScaleMap;

    /// Compiled for each instruction set.
    pub trait Scaled: Sized {
        /// Scales values that stand at the beginning of a window.
        fn scale(map: &ScaleMap, values: &[Self], out: &mut [f32]);
        /// Whether all of them are in range.
        fn in_range(map: &ScaleMap, values: &[Self]) -> bool;
    }
}

macro_rules! scaled {
    ($type:ty, $name:ident) => {
        struct $name;

        impl $name {
            #[allow(
                clippy::cast_possible_truncation,
                clippy::cast_lossless,
                reason = "networks are f32; one source for both types"
            )]
            #[inline(always)]
            unsafe fn scale<S: Simd>(map: &ScaleMap, values: &[$type], out: &mut [f32]) {
                let size = values.len();
                let (offset, inverse) = (&map.offset[..size], &map.inverse[..size]);
                let (low, high) = (&map.low[..size], &map.high[..size]);
                let out = &mut out[..size];
                for i in 0..size {
                    let value = (values[i] as f64 - offset[i]) * inverse[i];
                    out[i] = hold(value, low[i], high[i]) as f32;
                }
            }

            #[allow(clippy::cast_lossless, reason = "one source for both types")]
            #[inline(always)]
            unsafe fn in_range<S: Simd>(map: &ScaleMap, values: &[$type], inside: &mut bool) {
                let (min, max) = (&map.min[..values.len()], &map.max[..values.len()]);
                // To the end, whatever is found: a branch per value costs more.
                let mut outside = 0_u64;
                for i in 0..values.len() {
                    let value = values[i] as f64;
                    outside |= u64::from(!(min[i] <= value && value <= max[i]));
                }
                *inside = outside == 0;
            }
        }

        impl sealed::Scaled for $type {
            fn scale(map: &ScaleMap, values: &[Self], out: &mut [f32]) {
                dispatch!(level(), $name::scale(map: &ScaleMap, values: &[$type], out: &mut [f32]));
            }
            fn in_range(map: &ScaleMap, values: &[Self]) -> bool {
                let mut inside = true;
                {
                    let inside = &mut inside;
                    dispatch!(level(), $name::in_range(map: &ScaleMap, values: &[$type], inside: &mut bool));
                }
                inside
            }
        }
    };
}

scaled!(f32, Single);
scaled!(f64, Double);

/// The value, or the limit that it is beyond; not a number stays what it is.
#[inline(always)]
fn hold(value: f64, low: f64, high: f64) -> f64 {
    let value = if value < low { low } else { value };
    if value > high { high } else { value }
}

impl ScaleMap {
    pub(super) fn new(config: &ModelConfig) -> Self {
        let of = |value: &dyn Fn(usize) -> f64| -> Vec<f64> {
            let sample: Vec<f64> = (0..config.inputs.len()).map(value).collect();
            sample.repeat(config.window_steps)
        };
        let limit = |input: usize, end: usize, absent: f64| {
            let channel = &config.inputs[input];
            config
                .input_limits
                .get(input)
                .map_or(absent, |limits| (limits[end] - channel.offset) / channel.scale)
        };
        let envelope = config.envelope.as_ref();
        Self {
            offset: of(&|input| config.inputs[input].offset),
            inverse: of(&|input| config.inputs[input].scale.recip()),
            low: of(&|input| limit(input, 0, f64::NEG_INFINITY)),
            high: of(&|input| limit(input, 1, f64::INFINITY)),
            min: of(&|input| envelope.map_or(f64::NEG_INFINITY, |envelope| envelope.min[input])),
            max: of(&|input| envelope.map_or(f64::INFINITY, |envelope| envelope.max[input])),
        }
    }

    /// Scaled copies of windows, or of the first samples of one.
    pub(super) fn scale<T: Sample>(&self, values: &[T], out: &mut [f32]) {
        let size = self.offset.len().max(1);
        for (window, out) in values.chunks(size).zip(out.chunks_mut(size)) {
            T::scale(self, window, out);
        }
    }

    /// A value of a channel.
    #[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
    pub(super) fn scaled(&self, channel: usize, value: f64) -> f32 {
        let scaled = (value - self.offset[channel]) * self.inverse[channel];
        hold(scaled, self.low[channel], self.high[channel]) as f32
    }

    /// Whether every value of a window, or of its first samples, is in the range of its channel.
    pub(super) fn in_range<T: Sample>(&self, values: &[T]) -> bool {
        T::in_range(self, values)
    }
}
