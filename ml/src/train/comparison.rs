//! Networks for comparison (RNN, LSTM, CNN): trained and judged as the others, but neither exported nor served.

use super::autodiff::Autodiff;
use super::prepare::{Part, Problem, TrainingData};
use super::step::{Samples, first_rows};
use super::{Progress, TrainError, checkpoint::TrainState, fit};
use crate::evaluate::{EvaluateError, metrics::metrics, with_noise};
use crate::least_squares::TargetRows;
use crate::runs::Runs;
use crate::structure::parameter_count;
use crate::window::{Series, WindowError, Windows};
use hydroflex_openapi::job::{TrainingSpec, WindowCut};
use hydroflex_openapi::model::{EvaluationReport, TargetMetrics};
use std::ops::ControlFlow;
use std::path::Path;

/// A trained network that stays where it is.
#[derive(Debug, Clone)]
pub struct Comparison {
    problem: Problem,
    parameters: Vec<f32>,
    /// Time of the training, s.
    pub train_seconds: f64,
}

impl Comparison {
    /// Trains `spec`'s structure on a data set, as [`super::train_dataset`] would.
    ///
    /// # Errors
    /// As there.
    pub fn train_dataset(
        dataset: &hydroflex_dataset::Dataset,
        spec: &TrainingSpec,
        progress: &mut dyn FnMut(Progress) -> ControlFlow<()>,
        checkpoint_dir: &Path,
    ) -> Result<Self, TrainError> {
        let (data, spec) = crate::dataset::training_data(dataset, spec, None)?;
        Self::train(&data, &spec, progress, checkpoint_dir)
    }

    /// Trains `spec`'s structure, as [`super::train`] would.
    ///
    /// # Errors
    /// As there.
    pub fn train(
        data: &TrainingData,
        spec: &TrainingSpec,
        progress: &mut dyn FnMut(Progress) -> ControlFlow<()>,
        checkpoint_dir: &Path,
    ) -> Result<Self, TrainError> {
        let problem = Problem::new(data, spec)?;
        let outcome = fit(&problem, &data.dataset_sha256, progress, checkpoint_dir)?;
        TrainState::remove(checkpoint_dir).map_err(TrainError::Checkpoint)?;
        Ok(Self {
            problem,
            parameters: outcome.parameters,
            train_seconds: outcome.elapsed_s,
        })
    }

    /// Weights and biases.
    #[must_use]
    pub fn parameters(&self) -> usize {
        parameter_count(&self.problem.layers)
    }

    /// Channels that it needs: inputs, then targets.
    #[must_use]
    pub fn channels(&self) -> Vec<String> {
        let spec = &self.problem.spec;
        spec.inputs.iter().chain(&spec.targets).cloned().collect()
    }

    /// `runs` with the noise of its training on the inputs; see [`crate::evaluate::with_noise_of_training`].
    ///
    /// # Errors
    /// A channel is missing.
    pub fn with_noise_of_training(&self, runs: &Runs, seed: u64) -> Result<Runs, EvaluateError> {
        let spec = &self.problem.spec;
        with_noise(spec.noise.as_ref(), &spec.inputs, runs, seed)
    }

    /// Errors on every run of `runs` that is long enough.
    ///
    /// # Errors
    /// A channel is missing, a value is not finite, or no run is long enough.
    pub fn evaluate(&self, runs: &Runs, dataset_sha256: &str) -> Result<EvaluationReport, EvaluateError> {
        let Problem { spec, steps, .. } = &self.problem;
        let (inputs, targets) = (runs.select(&spec.inputs)?, runs.select(&spec.targets)?);
        inputs.check()?;
        targets.check()?;
        let series = Series::new(&inputs, &self.problem.input_scaling);
        let windows = Windows::new(&series.run_rows, *steps, WindowCut::Overlapping);
        if windows.is_empty() {
            return Err(WindowError::longer_than(&inputs, *steps).into());
        }
        let width = spec.targets.len();
        let part = Part {
            wanted: vec![0.0; series.rows() * width],
            targets: TargetRows {
                width,
                values: Vec::new(),
            },
            series,
            windows,
        };
        let first_rows = first_rows(&part);
        let samples = Samples {
            part: &part,
            first_rows: &first_rows,
        };
        let outputs = autodiff(&self.problem).outputs(samples, &self.parameters);
        let judge = |t: usize| -> TargetMetrics {
            let scaling = &self.problem.target_scaling;
            let estimate: Vec<f64> = outputs
                .iter()
                .skip(t)
                .step_by(width)
                .map(|&value| scaling.unscale(t, f64::from(value)))
                .collect();
            let reference: Vec<f64> = targets
                .runs
                .iter()
                .flat_map(|run| run.columns[t].iter().skip(steps - 1).copied())
                .collect();
            let channel = &targets.channels[t];
            metrics(&channel.name, &channel.unit, &estimate, &reference)
        };
        Ok(EvaluationReport {
            model_sha256: String::new(),
            dataset_sha256: dataset_sha256.to_owned(),
            runs: targets.runs.iter().filter(|run| run.len() >= *steps).count(),
            targets: (0..width).map(judge).collect(),
            baselines: Vec::new(),
            inside_envelope: None,
            flagged_by_length: None,
        })
    }
}

/// `problem`'s network as burn differentiates it.
pub(super) fn autodiff(problem: &Problem) -> Autodiff {
    Autodiff {
        form: problem.structure.form,
        layers: problem.layers.clone(),
        loss: problem.loss,
    }
}
