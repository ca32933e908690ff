//! A model against runs it has not seen.

pub mod metrics;
pub mod intervals;
pub mod table;
pub mod faults;
pub mod lengths;
pub mod profile;

use crate::model::Model;
use crate::model::weights::LinearWeights;
use crate::noise::Noise;
use crate::runs::{Runs, RunsError};
use crate::scaling::Scaling;
use crate::window::WindowError;
use hydroflex_openapi::job::NoiseSpec;
use hydroflex_openapi::model::{BaselineMetrics, EvaluationReport, TargetMetrics};
use lengths::{Counts, TrainedLengths};
use metrics::metrics;

/// Stream of the noise of evaluations; trainings use others.
const EVALUATION_STREAM: u64 = 1 << 40;

/// Two sample times are the same within this relative difference.
const SAMPLE_TIME_TOLERANCE: f64 = 1e-6;

/// Why a model cannot be evaluated on some runs.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// Channels or values.
    #[error(transparent)]
    Runs(#[from] RunsError),
    /// No run is as long as a window.
    #[error(transparent)]
    Window(#[from] WindowError),
    /// Noise that does not fit the model.
    #[error(transparent)]
    Noise(#[from] crate::noise::NoiseError),
    /// Another time between samples.
    #[error("the model was trained with {model_s} s between samples, the data have {data_s} s")]
    SampleTime {
        /// Model.
        model_s: f64,
        /// Data.
        data_s: f64,
    },
}

/// Estimates of one run beside the reference.
#[derive(Debug, Clone, PartialEq)]
pub struct RunEvaluation {
    /// Key of the run.
    pub run_id: u64,
    /// Time of each row, s.
    pub time_s: Vec<f64>,
    /// One column per target, in its unit.
    pub reference: Vec<Vec<f64>>,
    /// The model's.
    pub estimate: Vec<Vec<f64>>,
    /// Payload that the model told from each window, kg; empty when it follows none.
    pub payload_kg: Vec<f64>,
    /// Least squares on the same windows.
    pub least_squares: Vec<Vec<f64>>,
}

/// Estimates of all runs and their errors.
#[derive(Debug, Clone, PartialEq)]
pub struct Evaluation {
    /// Errors over all runs.
    pub report: EvaluationReport,
    /// Run by run; runs shorter than a window are left out.
    pub runs: Vec<RunEvaluation>,
}

/// Checks that `sample_time_s` is the model's.
///
/// # Errors
/// It is not.
pub fn check_sample_time(model: &Model, sample_time_s: f64) -> Result<(), EvaluateError> {
    let model_s = model.config().sample_time_s;
    if (sample_time_s - model_s).abs() > SAMPLE_TIME_TOLERANCE * model_s {
        return Err(EvaluateError::SampleTime {
            model_s,
            data_s: sample_time_s,
        });
    }
    Ok(())
}

/// Evaluates `model` on every run of `runs` that is long enough.
///
/// # Errors
/// A channel is missing, a value is not finite, the sample times differ, or no run is long enough.
#[allow(clippy::too_many_lines, reason = "one stage after the other")]
pub fn evaluate(model: &Model, runs: &Runs, dataset_sha256: &str) -> Result<Evaluation, EvaluateError> {
    let config = model.config();
    check_sample_time(model, runs.sample_time_s)?;
    let names = |channels: &[hydroflex_openapi::model::ScaledChannel]| -> Vec<String> {
        channels.iter().map(|c| c.name.clone()).collect()
    };
    let inputs = runs.select(&names(&config.inputs))?;
    let targets = runs.select(&names(&config.targets))?;
    inputs.check()?;
    targets.check()?;

    let predictor = model.predictor();
    let mut workspace = predictor.workspace();
    let count = config.targets.len();
    let scaling = (
        Scaling::from_config(&config.inputs),
        Scaling::from_config(&config.targets),
    );
    let mut all = Columns::new(count);
    let (mut inside, mut windows) = (0_usize, 0_usize);
    let lengths = TrainedLengths::of(config);
    let mut counts = Counts::default();
    let mut evaluated = Vec::new();
    for (input, target) in inputs.runs.iter().zip(&targets.runs) {
        if input.len() < config.window_steps {
            continue;
        }
        let columns: Vec<&[f64]> = input.columns.iter().map(Vec::as_slice).collect();
        let series = predictor.predict_series_with(&columns, &mut workspace);
        let first = series.first_row;
        let reference: Vec<Vec<f64>> = target.columns.iter().map(|c| c[first..].to_vec()).collect();
        let least_squares = linear_series(
            &model.auxiliary().least_squares,
            &scaling,
            &columns,
            config.window_steps,
            first,
        );
        let quasi_static = linear_series(&model.auxiliary().quasi_static, &scaling, &columns, 1, first);
        inside += series.inside.iter().filter(|&&i| i).count();
        windows += reference[0].len();
        if let Some(lengths) = &lengths {
            counts.add(lengths, &columns, config.window_steps, &series.inside);
        }
        for t in 0..count {
            all.reference[t].extend_from_slice(&reference[t]);
            all.estimate[t].extend_from_slice(&series.columns[t]);
            all.least_squares[t].extend_from_slice(&least_squares[t]);
            all.quasi_static[t].extend_from_slice(&quasi_static[t]);
            // The reference where the window begins.
            all.persistence[t].extend_from_slice(&target.columns[t][..reference[t].len()]);
        }
        evaluated.push(RunEvaluation {
            run_id: input.run_id,
            time_s: (first..input.len())
                .map(|row| row as f64 * runs.sample_time_s)
                .collect(),
            reference,
            estimate: series.columns,
            payload_kg: series.payload_kg,
            least_squares,
        });
    }
    if evaluated.is_empty() {
        return Err(WindowError::longer_than(&inputs, config.window_steps).into());
    }
    let judge = |estimate: &[Vec<f64>]| -> Vec<TargetMetrics> {
        config
            .targets
            .iter()
            .zip(estimate.iter().zip(&all.reference))
            .map(|(channel, (estimate, reference))| {
                metrics(&channel.name, &channel.unit, estimate, reference)
            })
            .collect()
    };
    let mut of_model = judge(&all.estimate);
    if predictor.has_intervals() {
        let payload_kg: Vec<f64> = (evaluated.iter())
            .flat_map(|run| run.payload_kg.iter().copied())
            .collect();
        for (t, metrics) in of_model.iter_mut().enumerate() {
            let coverage = coverage(
                &all.estimate[t],
                &all.reference[t],
                config.targets[t].offset,
                |window, estimate| {
                    let half = predictor.half_width(t, estimate, payload_kg.get(window).copied());
                    half.unwrap_or(0.0)
                },
            );
            metrics.coverage = Some(coverage.all);
            metrics.coverage_thirds = Some(coverage.thirds);
            metrics.interval_width = Some(coverage.width);
        }
    }
    let report = EvaluationReport {
        model_sha256: model.sha256().to_owned(),
        dataset_sha256: dataset_sha256.to_owned(),
        runs: evaluated.len(),
        targets: of_model,
        baselines: vec![
            BaselineMetrics {
                name: "least_squares".to_owned(),
                targets: judge(&all.least_squares),
            },
            BaselineMetrics {
                name: "quasi_static".to_owned(),
                targets: judge(&all.quasi_static),
            },
            BaselineMetrics {
                name: "persistence".to_owned(),
                targets: judge(&all.persistence),
            },
        ],
        inside_envelope: predictor.has_envelope().then(|| inside as f64 / windows as f64),
        flagged_by_length: lengths.map(|_| counts.parts()),
    };
    Ok(Evaluation {
        report,
        runs: evaluated,
    })
}

struct Coverage {
    all: f64,
    thirds: [f64; 3],
    width: f64,
}

/// Part of the reference values within the half width of their estimates, all and by thirds of their distance from
/// `centre`, and the mean width. `half_width`: of a window by its number and estimate.
fn coverage(
    estimate: &[f64],
    reference: &[f64],
    centre: f64,
    half_width: impl Fn(usize, f64) -> f64,
) -> Coverage {
    let mut width = 0.0;
    let mut samples: Vec<(f64, bool)> = estimate
        .iter()
        .zip(reference)
        .enumerate()
        .map(|(window, (&e, &r))| {
            let half = half_width(window, e);
            width += 2.0 * half;
            ((r - centre).abs(), (e - r).abs() <= half)
        })
        .collect();
    samples.sort_by(|a, b| a.0.total_cmp(&b.0));
    let part = |some: &[(f64, bool)]| {
        some.iter().filter(|sample| sample.1).count() as f64 / some.len().max(1) as f64
    };
    let count = samples.len();
    Coverage {
        all: part(&samples),
        thirds: std::array::from_fn(|third| part(&samples[third * count / 3..(third + 1) * count / 3])),
        width: width / count.max(1) as f64,
    }
}

/// `runs` with the noise that the model was trained with on its inputs, other noise than in training; unchanged for
/// a model that was trained without.
///
/// # Errors
/// A channel is missing.
pub fn with_noise_of_training(model: &Model, runs: &Runs, seed: u64) -> Result<Runs, EvaluateError> {
    let config = model.config();
    let names: Vec<String> = config.inputs.iter().map(|c| c.name.clone()).collect();
    with_noise(config.provenance.spec.noise.as_ref(), &names, runs, seed)
}

/// The same for noise `spec` on the channels `names`.
pub(crate) fn with_noise(
    spec: Option<&NoiseSpec>,
    names: &[String],
    runs: &Runs,
    seed: u64,
) -> Result<Runs, EvaluateError> {
    let Some(spec) = spec else {
        return Ok(runs.clone());
    };
    let positions = runs.positions(names)?;
    let inputs = runs.select(names)?;
    let noisy = Noise::new(spec, &inputs.channels, runs.sample_time_s)?.add(&inputs, seed, EVALUATION_STREAM);
    let mut disturbed = runs.clone();
    for (run, noisy) in disturbed.runs.iter_mut().zip(noisy.runs) {
        for (&position, column) in positions.iter().zip(noisy.columns) {
            run.columns[position] = column;
        }
    }
    Ok(disturbed)
}

struct Columns {
    reference: Vec<Vec<f64>>,
    estimate: Vec<Vec<f64>>,
    least_squares: Vec<Vec<f64>>,
    quasi_static: Vec<Vec<f64>>,
    persistence: Vec<Vec<f64>>,
}

impl Columns {
    fn new(count: usize) -> Self {
        let empty = || vec![Vec::new(); count];
        Self {
            reference: empty(),
            estimate: empty(),
            least_squares: empty(),
            quasi_static: empty(),
            persistence: empty(),
        }
    }
}

/// A linear map of the last `steps` rows, for every row from `first` on.
fn linear_series(
    map: &LinearWeights,
    (inputs, targets): &(Scaling, Scaling),
    columns: &[&[f64]],
    steps: usize,
    first: usize,
) -> Vec<Vec<f64>> {
    let width = columns.len();
    let rows = columns[0].len();
    let mut scaled = vec![0.0_f32; rows * width];
    for (channel, column) in columns.iter().enumerate() {
        inputs.scale_column(channel, column, &mut scaled[channel..], width);
    }
    let size = steps * width;
    (0..map.bias.len())
        .map(|t| {
            let weights = &map.weight[t * size..(t + 1) * size];
            (first..rows)
                .map(|row| {
                    let window = &scaled[(row + 1 - steps) * width..(row + 1) * width];
                    let sum: f64 = weights
                        .iter()
                        .zip(window)
                        .map(|(&w, &x)| f64::from(w) * f64::from(x))
                        .sum();
                    targets.unscale(t, sum + f64::from(map.bias[t]))
                })
                .collect()
        })
        .collect()
}
