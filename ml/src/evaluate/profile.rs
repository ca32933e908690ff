//! Where errors stand: over time, over the size of the quantity, over frequency; what a single mean does not show.

use super::Evaluation;

/// Bins over time.
const TIME_BINS: usize = 40;
/// Bins over amplitude: tenths of the samples.
const AMPLITUDE_BINS: usize = 10;
/// Bands per octave over frequency.
const BANDS_PER_OCTAVE: f64 = 3.0;
/// Samples of a stretch whose spectrum is taken; shorter runs are one stretch, halved until it fits.
const STRETCH: usize = 512;

/// Errors of one target, in its column's unit.
#[derive(Debug, Clone, PartialEq)]
pub struct Profile {
    /// Mean absolute error by time since the start of a run.
    pub over_time: Vec<ProfilePoint>,
    /// Mean absolute error by the reference's distance from its mean, in tenths of the samples.
    pub over_amplitude: Vec<ProfilePoint>,
    /// Root of the mean square of the error by frequency, in bands of a third of an octave.
    pub over_frequency: Vec<ProfilePoint>,
    /// The same of the reference itself.
    pub reference_over_frequency: Vec<ProfilePoint>,
}

/// A bin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProfilePoint {
    /// Middle of the bin: s, the column's unit, or Hz.
    pub at: f64,
    /// The model.
    pub network: f64,
    /// Least squares on the same windows.
    pub least_squares: f64,
}

/// The profile of target `target` over all runs of an evaluation; `sample_time_s` between samples.
#[must_use]
pub fn profile(evaluation: &Evaluation, target: usize, sample_time_s: f64) -> Profile {
    let mut samples = Vec::new();
    let mut bands = Bands::default();
    for run in &evaluation.runs {
        let (reference, estimate) = (&run.reference[target], &run.estimate[target]);
        let linear = &run.least_squares[target];
        for (k, &truth) in reference.iter().enumerate() {
            samples.push(Sample {
                time_s: run.time_s[k],
                reference: truth,
                network: (estimate[k] - truth).abs(),
                linear: (linear[k] - truth).abs(),
            });
        }
        let errors = |of: &[f64]| -> Vec<f64> { of.iter().zip(reference).map(|(e, r)| e - r).collect() };
        bands.add([&errors(estimate), &errors(linear), reference], sample_time_s);
    }
    let (over_frequency, reference_over_frequency) = bands.points();
    Profile {
        over_time: over_time(&samples),
        over_amplitude: over_amplitude(&mut samples),
        over_frequency,
        reference_over_frequency,
    }
}

#[derive(Clone, Copy)]
struct Sample {
    time_s: f64,
    reference: f64,
    network: f64,
    linear: f64,
}

fn mean_of(at: f64, samples: &[Sample]) -> ProfilePoint {
    let count = samples.len().max(1) as f64;
    ProfilePoint {
        at,
        network: samples.iter().map(|s| s.network).sum::<f64>() / count,
        least_squares: samples.iter().map(|s| s.linear).sum::<f64>() / count,
    }
}

fn over_time(samples: &[Sample]) -> Vec<ProfilePoint> {
    let first = samples.iter().map(|s| s.time_s).fold(f64::INFINITY, f64::min);
    let last = samples.iter().map(|s| s.time_s).fold(0.0, f64::max);
    let width = (last - first) / TIME_BINS as f64;
    if width.is_nan() || width <= 0.0 {
        return Vec::new();
    }
    let mut bins = vec![Vec::new(); TIME_BINS];
    for sample in samples {
        #[allow(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a bin of a few"
        )]
        let bin = ((sample.time_s - first) / width) as usize;
        bins[bin.min(TIME_BINS - 1)].push(*sample);
    }
    bins.iter()
        .enumerate()
        .filter(|(_, bin)| !bin.is_empty())
        .map(|(k, bin)| mean_of(first + (k as f64 + 0.5) * width, bin))
        .collect()
}

fn over_amplitude(samples: &mut [Sample]) -> Vec<ProfilePoint> {
    let count = samples.len();
    let mean = samples.iter().map(|s| s.reference).sum::<f64>() / count.max(1) as f64;
    let size = |sample: &Sample| (sample.reference - mean).abs();
    samples.sort_by(|a, b| size(a).total_cmp(&size(b)));
    (0..AMPLITUDE_BINS)
        .map(|k| &samples[k * count / AMPLITUDE_BINS..(k + 1) * count / AMPLITUDE_BINS])
        .filter(|bin| !bin.is_empty())
        .map(|bin| mean_of(bin.iter().map(size).sum::<f64>() / bin.len() as f64, bin))
        .collect()
}

/// Mean squares by frequency of three signals: error of the network, of least squares, and the reference.
#[derive(Default)]
struct Bands {
    sums: std::collections::BTreeMap<i64, [f64; 3]>,
    stretches: usize,
}

impl Bands {
    /// Adds the spectra of whole stretches of a run. A Hann window keeps what is large and slow out of the bands of what
    /// is small and fast.
    fn add(&mut self, signals: [&[f64]; 3], sample_time_s: f64) {
        let mut length = STRETCH;
        while length > signals[0].len() {
            length /= 2;
        }
        if length < 8 {
            return;
        }
        let hann: Vec<f64> = (0..length)
            .map(|i| (std::f64::consts::PI * i as f64 / length as f64).sin().powi(2))
            .collect();
        let energy = hann.iter().map(|w| w * w).sum::<f64>();
        for start in (0..=signals[0].len() - length).step_by(length) {
            self.stretches += 1;
            for (of, signal) in signals.iter().enumerate() {
                let stretch = &signal[start..start + length];
                let mean = stretch.iter().sum::<f64>() / length as f64;
                let values: Vec<f64> = stretch.iter().zip(&hann).map(|(v, w)| (v - mean) * w).collect();
                let spectrum = squares(&values);
                for (k, square) in spectrum.iter().enumerate().skip(1) {
                    let frequency_hz = k as f64 / (length as f64 * sample_time_s);
                    #[allow(clippy::cast_possible_truncation, reason = "a band of a few dozen")]
                    let band = (BANDS_PER_OCTAVE * frequency_hz.log2()).round() as i64;
                    // One side of the spectrum stands for both; Parseval with the window's energy.
                    let both = if 2 * k == length { 1.0 } else { 2.0 };
                    self.sums.entry(band).or_default()[of] += both * square / (length as f64 * energy);
                }
            }
        }
    }

    fn points(&self) -> (Vec<ProfilePoint>, Vec<ProfilePoint>) {
        let stretches = self.stretches.max(1) as f64;
        let root = |sum: f64| (sum / stretches).sqrt();
        self.sums
            .iter()
            .map(|(band, [network, linear, reference])| {
                let at = 2f64.powf(*band as f64 / BANDS_PER_OCTAVE);
                let own = ProfilePoint {
                    at,
                    network: root(*network),
                    least_squares: root(*linear),
                };
                let of_reference = ProfilePoint {
                    at,
                    network: root(*reference),
                    least_squares: root(*reference),
                };
                (own, of_reference)
            })
            .unzip()
    }
}

/// Squared sizes of the discrete Fourier transform up to half the sampling rate, by Goertzel's recurrence: exact for a
/// few hundred samples, and nothing to tune.
fn squares(values: &[f64]) -> Vec<f64> {
    let count = values.len();
    (0..=count / 2)
        .map(|k| {
            let twice = 2.0 * (2.0 * std::f64::consts::PI * k as f64 / count as f64).cos();
            let (mut before, mut last) = (0.0, 0.0);
            for value in values {
                (before, last) = (last, value + twice * last - before);
            }
            last * last + before * before - twice * last * before
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::RunEvaluation;
    use hydroflex_openapi::model::EvaluationReport;

    const SAMPLE_TIME_S: f64 = 0.005;

    /// An error of 0.1 that swings at 20 Hz, beside a linear one that grows in time.
    fn evaluation() -> Evaluation {
        let rows = 2000;
        let time_s: Vec<f64> = (0..rows).map(|k| f64::from(k) * SAMPLE_TIME_S).collect();
        let reference: Vec<f64> = time_s.iter().map(|t| 3.0 * (2.0 * t).sin()).collect();
        let swing = |t: f64| 0.1 * (2.0 * std::f64::consts::PI * 20.0 * t).sin();
        let estimate = reference
            .iter()
            .zip(&time_s)
            .map(|(r, t)| r + swing(*t))
            .collect();
        let least_squares = reference.iter().zip(&time_s).map(|(r, t)| r + 0.01 * t).collect();
        Evaluation {
            report: EvaluationReport {
                model_sha256: String::new(),
                dataset_sha256: String::new(),
                runs: 1,
                targets: Vec::new(),
                baselines: Vec::new(),
                inside_envelope: None,
                flagged_by_length: None,
            },
            runs: vec![RunEvaluation {
                run_id: 0,
                time_s,
                reference: vec![reference],
                estimate: vec![estimate],
                payload_kg: Vec::new(),
                least_squares: vec![least_squares],
            }],
        }
    }

    #[test]
    fn an_error_is_found_at_its_time_and_its_frequency() {
        let profile = profile(&evaluation(), 0, SAMPLE_TIME_S);
        assert_eq!(profile.over_time.len(), TIME_BINS);
        let last = profile.over_time[TIME_BINS - 1];
        assert!((last.least_squares - 0.01 * last.at).abs() < 1e-3, "{last:?}");
        assert!(
            (last.network - 0.2 / std::f64::consts::PI).abs() < 5e-3,
            "{last:?}"
        );
        assert_eq!(profile.over_amplitude.len(), AMPLITUDE_BINS);
        let largest = profile
            .over_frequency
            .iter()
            .max_by(|a, b| a.network.total_cmp(&b.network))
            .unwrap();
        assert!((largest.at / 20.0).log2().abs() < 0.2, "{largest:?}");
        assert!((largest.network - 0.1 / 2f64.sqrt()).abs() < 2e-3, "{largest:?}");
        let slow = profile
            .reference_over_frequency
            .iter()
            .max_by(|a, b| a.network.total_cmp(&b.network))
            .unwrap();
        assert!(slow.at < 1.0, "{slow:?}");
    }

    #[test]
    fn mean_squares_over_all_bands_are_that_of_the_signal() {
        let mut bands = Bands::default();
        let mut state = 1_u32;
        let noise: Vec<f64> = (0..51_200)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                f64::from(state >> 8) / 8_388_608.0 - 1.0
            })
            .collect();
        bands.add([&noise, &noise, &noise], SAMPLE_TIME_S);
        let (points, _) = bands.points();
        let sum: f64 = points.iter().map(|p| p.network * p.network).sum();
        assert!((sum * 3.0 - 1.0).abs() < 0.03, "{sum}");
    }
}
