//! Scales between columns in SI units and the network's numbers.

use crate::runs::Runs;
use hydroflex_openapi::channel::Channel;
use hydroflex_openapi::model::ScaledChannel;

/// One affine map per channel: `scaled = (value − offset) / scale`.
#[derive(Debug, Clone, PartialEq)]
pub struct Scaling {
    channels: Vec<ScaledChannel>,
}

/// Fixed divisors of the paper by quantity (Khadim et al. 2025): the barrel's outer length, the
/// largest velocity, the supply pressure's order, the largest deflection.
const PAPER_LENGTH_M: f64 = 1.355;
const PAPER_VELOCITY_M_PER_S: f64 = 6.67;
const PAPER_PRESSURE_PA: f64 = 200e5;
const PAPER_DEFLECTION_M: f64 = 30e-3;

/// A channel whose training values vary by less than this part of their size counts as constant.
const CONSTANT_RELATIVE: f64 = 1e-12;

impl Scaling {
    /// From a stored configuration.
    #[must_use]
    pub fn from_config(channels: &[ScaledChannel]) -> Self {
        Self {
            channels: channels.to_vec(),
        }
    }

    /// Zero mean and unit variance over all rows of `runs`; a constant channel keeps its size.
    #[must_use]
    pub fn fit(runs: &Runs) -> Self {
        let channels = runs
            .channels
            .iter()
            .enumerate()
            .map(|(i, channel)| {
                let (mean, std) =
                    mean_and_std(runs.runs.iter().flat_map(|run| run.columns[i].iter().copied()));
                let constant = std <= CONSTANT_RELATIVE * mean.abs().max(f64::MIN_POSITIVE);
                scaled(channel, mean, if constant { 1.0 } else { std })
            })
            .collect();
        Self { channels }
    }

    /// The paper's fixed scales where it has one for the quantity (by the unit in the name), else
    /// the largest magnitude in `runs`; never an offset.
    #[must_use]
    pub fn paper(runs: &Runs) -> Self {
        let channels = runs
            .channels
            .iter()
            .enumerate()
            .map(|(i, channel)| {
                let name = channel.name.as_str();
                let scale = if name.starts_with("length_") {
                    PAPER_LENGTH_M
                } else if name.starts_with("velocity_") {
                    PAPER_VELOCITY_M_PER_S
                } else if name.starts_with("pressure_") {
                    PAPER_PRESSURE_PA
                } else if name.starts_with("deflection_") {
                    PAPER_DEFLECTION_M
                } else if name.starts_with("valve_") {
                    1.0
                } else {
                    let largest = runs
                        .runs
                        .iter()
                        .flat_map(|run| run.columns[i].iter())
                        .fold(0.0, |m: f64, v| m.max(v.abs()));
                    if largest > 0.0 { largest } else { 1.0 }
                };
                scaled(channel, 0.0, scale)
            })
            .collect();
        Self { channels }
    }

    /// Number of channels.
    #[must_use]
    pub fn len(&self) -> usize {
        self.channels.len()
    }

    /// Whether there is no channel.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.channels.is_empty()
    }

    /// Channels with their maps.
    #[must_use]
    pub fn channels(&self) -> &[ScaledChannel] {
        &self.channels
    }

    /// One value into the network's numbers, still f64.
    #[must_use]
    pub fn scale(&self, channel: usize, value: f64) -> f64 {
        let c = &self.channels[channel];
        (value - c.offset) / c.scale
    }

    /// One scaled value back into the column's unit.
    #[must_use]
    pub fn unscale(&self, channel: usize, scaled: f64) -> f64 {
        let c = &self.channels[channel];
        c.offset + c.scale * scaled
    }

    /// Scales `column` into every `stride`-th value of `out`, beginning with its first.
    pub fn scale_column(&self, channel: usize, column: &[f64], out: &mut [f32], stride: usize) {
        for (value, slot) in column.iter().zip(out.iter_mut().step_by(stride)) {
            #[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
            {
                *slot = self.scale(channel, *value) as f32;
            }
        }
    }
}

fn scaled(channel: &Channel, offset: f64, scale: f64) -> ScaledChannel {
    ScaledChannel {
        name: channel.name.clone(),
        unit: channel.unit.clone(),
        offset,
        scale,
    }
}

/// Mean and standard deviation by Welford's update, stable for large offsets.
pub(crate) fn mean_and_std(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (mut count, mut mean, mut squares) = (0.0_f64, 0.0_f64, 0.0_f64);
    for value in values {
        count += 1.0;
        let delta = value - mean;
        mean += delta / count;
        squares += delta * (value - mean);
    }
    if count == 0.0 {
        (0.0, 1.0)
    } else {
        (mean, (squares / count).sqrt())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runs::RunSamples;
    use hydroflex_openapi::channel::ChannelRole;

    fn runs() -> Runs {
        let channel = |name: &str| Channel {
            name: name.to_owned(),
            unit: String::new(),
            quantity: String::new(),
            frame: None,
            role: ChannelRole::Sensor,
        };
        Runs {
            channels: vec![channel("pressure_lift_piston_pa"), channel("angle_lift_rad")],
            sample_time_s: 0.005,
            runs: vec![RunSamples {
                run_id: 0,
                columns: vec![vec![1e7, 1.2e7], vec![0.5, 0.5]],
            }],
        }
    }

    #[test]
    fn fitted_scales_have_zero_mean_and_unit_variance() {
        let scaling = Scaling::fit(&runs());
        assert!((scaling.scale(0, 1e7) + 1.0).abs() < 1e-12);
        assert!((scaling.unscale(0, 1.0) - 1.2e7).abs() < 1e-3);
        assert!(
            scaling.scale(1, 0.5).abs() < 1e-15,
            "a constant channel scales to zero"
        );
    }

    #[test]
    fn paper_scales_are_fixed() {
        let scaling = Scaling::paper(&runs());
        assert!((scaling.scale(0, 200e5) - 1.0).abs() < 1e-15);
        assert!((scaling.scale(1, 0.5) - 1.0).abs() < 1e-15);
    }
}
