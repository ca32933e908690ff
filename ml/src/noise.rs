//! Sensor noise: what a training adds to simulated signals, and what a judge should add as well.
//!
//! ```text
//! x̃_k = x_k + σ n_k,                      n white, normal
//! ṽ_k = (s̃_k − s̃_{k−1}) / h                 velocity differentiated from the noisy length of its cylinder
//! ```
//!
//! The velocity is the difference itself, not the true velocity with its noise: the two together with the noisy length
//! would give away the true length without noise. Only where the length is no input, the true velocity is taken. The covariance of a window's noise follows in closed form
//! and is added to that of the clean windows, so that least squares is exact for infinitely many noisy copies.

use crate::runs::Runs;
use crate::scaling::Scaling;
use faer::Mat;
use hydroflex_openapi::channel::Channel;
use hydroflex_openapi::job::{NoiseLevel, NoiseSpec};
use rand_chacha::ChaCha12Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

/// Measured on a crane at rest: cylinder length, m.
const CRANE_LENGTH_M: f64 = 0.49e-3;
/// Measured on a crane at rest: pressure, Pa.
const CRANE_PRESSURE_PA: f64 = 11.7e3;
/// Measured on a crane at rest: angle, rad (0.32°).
const CRANE_ANGLE_RAD: f64 = 0.32 * std::f64::consts::PI / 180.0;
/// One bit of a 12-bit valve command over −1 … 1.
const CRANE_VALVE: f64 = 2.0 / 4096.0;

/// Why noise cannot be added.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NoiseError {
    /// A channel that is no input.
    #[error("noise is given for {name:?}, which is no input; inputs are {}", inputs.join(", "))]
    NoInput {
        /// Channel.
        name: String,
        /// Inputs.
        inputs: Vec<String>,
    },
    /// Not a standard deviation.
    #[error("the noise of {name:?} is {value}; a standard deviation of 0 or more is allowed")]
    NotAllowed {
        /// Channel.
        name: String,
        /// Value.
        value: f64,
    },
}

/// Noise of some inputs.
#[derive(Debug, Clone, PartialEq)]
pub struct Noise {
    inputs: Vec<InputNoise>,
    sample_time_s: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum InputNoise {
    /// Standard deviation in the column's unit.
    White(f64),
    /// Difference of the white noise of another source, over the sample time.
    Differentiated { source: Source, std: f64 },
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Source {
    /// The noise of this input.
    Input(usize),
    /// Noise of a length that is no input.
    Own,
}

impl Noise {
    /// Noise of `channels`, the inputs of a model.
    ///
    /// # Errors
    /// A channel that is no input, or a negative standard deviation.
    pub fn new(spec: &NoiseSpec, channels: &[Channel], sample_time_s: f64) -> Result<Self, NoiseError> {
        let inputs = match spec {
            NoiseSpec::Level(NoiseLevel::Crane) => channels.iter().map(|c| crane(c, channels)).collect(),
            NoiseSpec::Channels(stds) => {
                for (name, &value) in stds {
                    if !channels.iter().any(|c| c.name == *name) {
                        return Err(NoiseError::NoInput {
                            name: name.clone(),
                            inputs: channels.iter().map(|c| c.name.clone()).collect(),
                        });
                    }
                    if !(value.is_finite() && value >= 0.0) {
                        return Err(NoiseError::NotAllowed {
                            name: name.clone(),
                            value,
                        });
                    }
                }
                let white = |c: &Channel| InputNoise::White(stds.get(&c.name).copied().unwrap_or(0.0));
                channels.iter().map(white).collect()
            }
        };
        Ok(Self {
            inputs,
            sample_time_s,
        })
    }

    /// `runs` with noise on every column, one column per input; other `stream`s give other noise.
    ///
    /// # Panics
    /// When the runs have another number of columns.
    #[must_use]
    pub fn add(&self, runs: &Runs, seed: u64, stream: u64) -> Runs {
        let mut noisy = self.differentiated(runs);
        let mut rng = ChaCha12Rng::seed_from_u64(seed);
        rng.set_stream(stream);
        for run in &mut noisy.runs {
            assert_eq!(run.columns.len(), self.inputs.len(), "one column per input");
            let rows = run.len();
            // One number more: the sample before the first, for its difference.
            let white: Vec<Vec<f64>> = (0..self.inputs.len())
                .map(|_| normals(&mut rng, rows + 1))
                .collect();
            for (input, (column, noise)) in run.columns.iter_mut().zip(&self.inputs).enumerate() {
                match *noise {
                    InputNoise::White(std) => {
                        for (value, n) in column.iter_mut().zip(&white[input][1..]) {
                            *value += std * n;
                        }
                    }
                    InputNoise::Differentiated { source, std } => {
                        let n = match source {
                            Source::Input(of) => &white[of],
                            Source::Own => &white[input],
                        };
                        // The columns hold the clean difference.
                        for (value, pair) in column.iter_mut().zip(n.windows(2)) {
                            *value += std * (pair[1] - pair[0]) / self.sample_time_s;
                        }
                    }
                }
            }
        }
        noisy
    }

    /// `runs` without noise, but with velocities differentiated from lengths where the noise model does that; the first
    /// sample's is that of the second.
    ///
    /// # Panics
    /// When the runs have another number of columns.
    #[must_use]
    pub fn differentiated(&self, runs: &Runs) -> Runs {
        let mut clean = runs.clone();
        for run in &mut clean.runs {
            assert_eq!(run.columns.len(), self.inputs.len(), "one column per input");
            for (input, noise) in self.inputs.iter().enumerate() {
                let InputNoise::Differentiated {
                    source: Source::Input(of),
                    ..
                } = *noise
                else {
                    continue;
                };
                let length = run.columns[of].clone();
                let velocity = &mut run.columns[input];
                for k in 1..length.len() {
                    velocity[k] = (length[k] - length[k - 1]) / self.sample_time_s;
                }
                if length.len() > 1 {
                    velocity[0] = velocity[1];
                }
            }
        }
        clean
    }

    /// Covariance of the noise of a scaled window of `steps` samples, whole matrix.
    #[must_use]
    pub fn covariance(&self, steps: usize, scaling: &Scaling) -> Mat<f64> {
        let width = self.inputs.len();
        let h = self.sample_time_s;
        // Weights of the source's numbers n_k and n_{k−1} in each input.
        let parts: Vec<(usize, f64, f64)> = self
            .inputs
            .iter()
            .enumerate()
            .map(|(input, noise)| match *noise {
                InputNoise::White(std) => (input, std, 0.0),
                InputNoise::Differentiated { source, std } => {
                    let of = match source {
                        Source::Input(of) => of,
                        Source::Own => input,
                    };
                    (of, std / h, -std / h)
                }
            })
            .collect();
        let scales: Vec<f64> = scaling.channels().iter().map(|c| c.scale).collect();
        Mat::from_fn(steps * width, steps * width, |i, j| {
            let ((a, k), (b, l)) = ((i % width, i / width), (j % width, j / width));
            let ((source_a, now_a, before_a), (source_b, now_b, before_b)) = (parts[a], parts[b]);
            if source_a != source_b {
                return 0.0;
            }
            let product = if k == l {
                now_a * now_b + before_a * before_b
            } else if k + 1 == l {
                now_a * before_b
            } else if l + 1 == k {
                before_a * now_b
            } else {
                0.0
            };
            product / (scales[a] * scales[b])
        })
    }
}

fn crane(channel: &Channel, channels: &[Channel]) -> InputNoise {
    let name = channel.name.as_str();
    if name.starts_with("length_") {
        InputNoise::White(CRANE_LENGTH_M)
    } else if name.starts_with("pressure_") {
        InputNoise::White(CRANE_PRESSURE_PA)
    } else if name.starts_with("angle_") {
        InputNoise::White(CRANE_ANGLE_RAD)
    } else if name.starts_with("valve_") {
        InputNoise::White(CRANE_VALVE)
    } else if let Some(rest) = name.strip_prefix("velocity_") {
        let length = format!("length_{}", rest.trim_end_matches("_per_s"));
        let source = channels
            .iter()
            .position(|c| c.name == length)
            .map_or(Source::Own, Source::Input);
        InputNoise::Differentiated {
            source,
            std: CRANE_LENGTH_M,
        }
    } else {
        InputNoise::White(0.0)
    }
}

/// Standard normal numbers, by Box and Muller.
fn normals(rng: &mut ChaCha12Rng, count: usize) -> Vec<f64> {
    // 53 random bits, above 0 so that the logarithm is finite.
    let mut uniform = || ((rng.next_u64() >> 11) as f64 + 0.5) / (1_u64 << 53) as f64;
    let mut values = Vec::with_capacity(count + 1);
    while values.len() < count {
        let radius = (-2.0 * uniform().ln()).sqrt();
        let (sine, cosine) = (std::f64::consts::TAU * uniform()).sin_cos();
        values.extend([radius * cosine, radius * sine]);
    }
    values.truncate(count);
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runs::RunSamples;
    use crate::window::{Series, Windows};
    use hydroflex_openapi::channel::ChannelRole;
    use hydroflex_openapi::job::WindowCut;

    fn quiet(names: &[&str], rows: usize) -> Runs {
        Runs {
            channels: names
                .iter()
                .map(|name| Channel {
                    name: (*name).to_owned(),
                    unit: String::new(),
                    quantity: String::new(),
                    frame: None,
                    role: ChannelRole::Sensor,
                })
                .collect(),
            sample_time_s: 0.005,
            runs: vec![RunSamples {
                run_id: 0,
                columns: vec![vec![0.0; rows]; names.len()],
            }],
        }
    }

    #[test]
    fn the_covariance_is_that_of_the_noise() {
        let names = [
            "valve_lift_ratio",
            "length_lift_m",
            "velocity_lift_m_per_s",
            "pressure_lift_rod_pa",
        ];
        let runs = quiet(&names, 60_000);
        let noise = Noise::new(&NoiseSpec::Level(NoiseLevel::Crane), &runs.channels, 0.005).unwrap();
        let noisy = noise.add(&runs, 3, 1);
        assert_ne!(noisy, noise.add(&runs, 3, 2));
        assert_eq!(noisy, noise.add(&runs, 3, 1));
        // Scaled so that every variance is 1.
        let scaling = Scaling::fit(&noisy);
        let series = Series::new(&noisy, &scaling);
        let windows = Windows::new(&series.run_rows, 3, WindowCut::Overlapping);
        let expected = noise.covariance(3, &scaling);
        for i in 0..12 {
            for j in 0..12 {
                let sum: f64 = (0..windows.len())
                    .map(|w| series.window(windows.first_row(w), 3))
                    .map(|x| f64::from(x[i]) * f64::from(x[j]))
                    .sum();
                let found = sum / windows.len() as f64;
                // Five standard errors of a mean of 60,000 products of size one.
                assert!(
                    (found - expected[(i, j)]).abs() < 0.025,
                    "({i}, {j}): {found} {}",
                    expected[(i, j)]
                );
            }
        }
        let length = &noisy.runs[0].columns[1];
        let velocity = &noisy.runs[0].columns[2];
        assert!(((length[7] - length[6]) / 0.005 - velocity[7]).abs() < 1e-12);
    }

    #[test]
    fn a_differentiated_velocity_tells_no_more_than_the_noisy_length() {
        let mut runs = quiet(&["length_lift_m", "velocity_lift_m_per_s"], 50);
        for k in 0..50_u32 {
            let t = f64::from(k) * 0.005;
            runs.runs[0].columns[0][k as usize] = (9.0 * t).sin();
            runs.runs[0].columns[1][k as usize] = 9.0 * (9.0 * t).cos();
        }
        let noise = Noise::new(&NoiseSpec::Level(NoiseLevel::Crane), &runs.channels, 0.005).unwrap();
        let noisy = noise.add(&runs, 0, 0);
        let [length, velocity] = [&noisy.runs[0].columns[0], &noisy.runs[0].columns[1]];
        for k in 1..50 {
            // Rounding of a difference of numbers of size one, over the sample time.
            assert!(((length[k] - length[k - 1]) / 0.005 - velocity[k]).abs() < 1e-12);
        }
    }

    #[test]
    fn noise_of_a_channel_that_is_no_input_is_refused() {
        let spec = NoiseSpec::Channels([("force_lift_n".to_owned(), 1.0)].into());
        let error = Noise::new(&spec, &quiet(&["length_lift_m"], 1).channels, 0.005).unwrap_err();
        assert!(error.to_string().contains("force_lift_n"), "{error}");
        let spec = NoiseSpec::Channels([("length_lift_m".to_owned(), -1.0)].into());
        let error = Noise::new(&spec, &quiet(&["length_lift_m"], 1).channels, 0.005).unwrap_err();
        assert!(error.to_string().contains("-1"), "{error}");
    }
}
