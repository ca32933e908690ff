//! The training loop.
//!
//! [`train`] reads as a contents page: prepare, fit, write the model folder. A training whose length
//! is given in epochs is a function of its data and specification: the same seed gives the same
//! bytes on the same machine, on any number of threads, killed and resumed or not. One with a time
//! limit depends on how fast the machine was.

pub mod prepare;
pub mod adam;
pub mod autodiff;
pub mod checkpoint;
pub mod comparison;
pub mod step;

use crate::least_squares::SpectrumError;
use crate::model::ModelError;
use crate::network::init::epoch_order;
use crate::runs::{Runs, RunsError};
use crate::scheduled::NormalEquationsError;
use crate::structure::{Form, Structure, StructureError};
use crate::window::WindowError;
use autodiff::Autodiff;
use checkpoint::TrainState;
use hydroflex_openapi::job::TrainingSpec;
use hydroflex_openapi::model::{EpochRecord, ModelSummary, TrainingEnd};
use prepare::{Problem, TrainingData};
use sha2::{Digest, Sha256};
use std::ops::ControlFlow;
use std::path::Path;
use std::time::{Duration, Instant};
use step::{Samples, Step};

/// Validations of a training that goes its whole length (after every 20 of 1,000 epochs, as in the paper).
const VALIDATIONS: f64 = 50.0;
/// Least time between two checkpoints.
const CHECKPOINT_INTERVAL: Duration = Duration::from_secs(2);
/// Early stopping: validations without improvement after which a training ends. A schedule that
/// falls to zero improves until its end, so this is for the paper's recipe.
const PATIENCE: usize = 15;
/// A loss this many times that of predicting the mean is divergence.
const DIVERGENCE: f64 = 1e4;

/// Where a training stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// Epochs done.
    pub epoch: usize,
    /// Largest number of epochs, where there is one.
    pub epochs: Option<usize>,
    /// Part of the schedule done, 0 to 1.
    pub fraction: f64,
    /// Mean squared error over the last epoch, scaled.
    pub train_loss: f64,
    /// At the last validation, scaled.
    pub validation_loss: Option<f64>,
    /// Smallest so far.
    pub best_loss: Option<f64>,
    /// Time spent, s.
    pub elapsed_s: f64,
    /// Epoch at which a checkpoint was taken up.
    pub resumed_at: Option<usize>,
}

/// Why a training ended without a model.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// Unusable values or channels.
    #[error(transparent)]
    Runs(#[from] RunsError),
    /// Unusable window.
    #[error(transparent)]
    Window(#[from] WindowError),
    /// Unusable structure.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// The windows' covariance.
    #[error(transparent)]
    Spectrum(#[from] SpectrumError),
    /// The skip connection's coefficients.
    #[error(transparent)]
    NormalEquations(#[from] NormalEquationsError),
    /// Nothing to feed or to learn.
    #[error("the data set has no {what} channel by default; name the {what}s")]
    NoChannels {
        /// `input` or `target`.
        what: &'static str,
    },
    /// A target that is fed to the network.
    #[error("channel {name:?} is input and target at once")]
    TargetIsInput {
        /// Channel.
        name: String,
    },
    /// Not a positive number.
    #[error("{what} must be positive, it is {value}")]
    NotPositive {
        /// Field.
        what: &'static str,
        /// Value.
        value: f64,
    },
    /// Several samples at once from a network that gives one.
    #[error(
        "output_steps is above 1: structure {structure:?} estimates one sample; give `best` or letters such as RLR"
    )]
    SingleStep {
        /// Structure.
        structure: String,
    },
    /// A rate for a dropout that is not there.
    #[error("dropout is given, but structure {structure:?} has no letter D")]
    NoDropout {
        /// Structure.
        structure: String,
    },
    /// Not a part of a whole.
    #[error("dropout must be at least 0 and below 1, it is {value}")]
    NoPart {
        /// Value.
        value: f64,
    },
    /// The data set does not say how long a window is.
    #[error(
        "the data set does not tell the window length by this rule (no settling runs, none that settles, or a table of runs, whose eigenvalues nobody computed); give the window in seconds"
    )]
    NoWindow,
    /// The data set cannot be read.
    #[error(transparent)]
    Dataset(#[from] hydroflex_dataset::OpenError),
    /// Unusable noise.
    #[error(transparent)]
    Noise(#[from] crate::noise::NoiseError),
    /// Too few runs.
    #[error(
        "{train} training and {validation} validation runs are too few: at least {} and 1 are needed",
        prepare::MIN_TRAIN_RUNS
    )]
    TooFewRuns {
        /// Training runs.
        train: usize,
        /// Validation runs.
        validation: usize,
    },
    /// The loss grew beyond bounds or is not a number; the checkpoint before it is kept.
    #[error(
        "the training diverged in epoch {epoch}: loss {loss:.3e} with learning rate {learning_rate:.3e}; try a smaller one"
    )]
    Diverged {
        /// Epoch.
        epoch: usize,
        /// Loss.
        loss: f64,
        /// Learning rate.
        learning_rate: f64,
    },
    /// Asked to stop; the checkpoint is kept.
    #[error("the training was cancelled in epoch {epoch}")]
    Cancelled {
        /// Epoch.
        epoch: usize,
    },
    /// The checkpoint cannot be written.
    #[error("cannot write the checkpoint")]
    Checkpoint(#[source] std::io::Error),
    /// The model folder cannot be written.
    #[error(transparent)]
    Model(#[from] ModelError),
}

/// Trains a network on a data set; see [`train`]. `calibration`: further runs without a flag, long ones, on which
/// intervals and envelope are calibrated beside the data set's validation runs.
///
/// # Errors
/// As [`train`], or the data set cannot be read.
pub fn train_dataset(
    dataset: &hydroflex_dataset::Dataset,
    spec: &TrainingSpec,
    calibration: Option<&Runs>,
    progress: &mut dyn FnMut(Progress) -> ControlFlow<()>,
    checkpoint_dir: &Path,
    out_dir: &Path,
) -> Result<ModelSummary, TrainError> {
    let (data, spec) = crate::dataset::training_data(dataset, spec, calibration)?;
    train(&data, &spec, progress, checkpoint_dir, out_dir)
}

/// Trains a network and writes its model folder to `out_dir`.
///
/// `progress` is called several times a second and stops the training by returning
/// `ControlFlow::Break`. `checkpoint_dir` holds the state of an unfinished training; a training
/// started again with the same data and specification goes on from there.
///
/// # Errors
/// The data cannot answer the specification, the loss diverges, the training is cancelled, or a
/// file cannot be written.
pub fn train(
    data: &TrainingData,
    spec: &TrainingSpec,
    progress: &mut dyn FnMut(Progress) -> ControlFlow<()>,
    checkpoint_dir: &Path,
    out_dir: &Path,
) -> Result<ModelSummary, TrainError> {
    if Structure::is_comparison(&spec.structure) {
        return Err(TrainError::Structure(StructureError::Comparison {
            name: spec.structure.clone(),
        }));
    }
    // Before the work, not after it.
    crate::model::write::place(out_dir)?;
    let problem = Problem::new(data, spec)?;
    let outcome = fit(&problem, &data.dataset_sha256, progress, checkpoint_dir)?;
    let summary = crate::model::write::write_model(&problem, data, &outcome, out_dir)?;
    TrainState::remove(checkpoint_dir).map_err(TrainError::Checkpoint)?;
    Ok(summary)
}

/// Result of the loop.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Best weights, first layer still in whitened coordinates.
    pub parameters: Vec<f32>,
    /// Epochs done.
    pub epochs: usize,
    /// Epoch of the best weights.
    pub best_epoch: usize,
    /// Learning curve.
    pub history: Vec<EpochRecord>,
    /// Why it ended.
    pub ended_by: TrainingEnd,
    /// Time spent, s.
    pub elapsed_s: f64,
}

/// Runs epochs until one of the limits is reached.
///
/// # Errors
/// Divergence, cancellation, or a checkpoint that cannot be written.
pub fn fit(
    problem: &Problem,
    dataset_sha256: &str,
    progress: &mut dyn FnMut(Progress) -> ControlFlow<()>,
    checkpoint_dir: &Path,
) -> Result<Outcome, TrainError> {
    let fingerprint = fingerprint(problem, dataset_sha256);
    let resumed = TrainState::load(checkpoint_dir, &fingerprint);
    let resumed_at = resumed.as_ref().map(|state| state.counters.epoch);
    let mut state = resumed.unwrap_or_else(|| TrainState::new(problem.parameters.clone(), fingerprint));
    let mut clock = Clock {
        started: Instant::now(),
        before_s: state.counters.elapsed_s,
    };
    let mut saved_at = Instant::now();
    let limits = Limits {
        problem,
        steps_per_epoch: problem.train.windows.len().div_ceil(problem.recipe.batch),
    };
    let mut trainer = Trainer::new(problem);
    let ended_by = loop {
        if let Some(end) = limits.reached(&state, clock.elapsed_s()) {
            break end;
        }
        let mut report = |fraction: f64, train_loss: f64, state: &TrainState, clock: &Clock| {
            progress(Progress {
                epoch: state.counters.epoch,
                epochs: (problem.recipe.epochs < usize::MAX).then_some(problem.recipe.epochs),
                fraction,
                train_loss,
                validation_loss: state.counters.history.last().map(|h| h.validation_loss),
                best_loss: state.counters.best_loss,
                elapsed_s: clock.elapsed_s(),
                resumed_at,
            })
        };
        let train_loss = epoch(&mut trainer, &limits, &mut state, &clock, &mut report)?;
        state.counters.epoch += 1;
        let fraction = limits.fraction(&state, state.counters.epoch, 0, clock.elapsed_s());
        let last = fraction >= 1.0 || problem.recipe.loss_threshold.is_some_and(|t| train_loss < t);
        if last || intervals(fraction) > intervals(state.counters.validated_at) {
            validate(&mut trainer, &mut state, train_loss, fraction);
        }
        state.counters.elapsed_s = clock.elapsed_s();
        clock = Clock {
            started: Instant::now(),
            before_s: state.counters.elapsed_s,
        };
        if saved_at.elapsed() >= CHECKPOINT_INTERVAL {
            state.save(checkpoint_dir).map_err(TrainError::Checkpoint)?;
            saved_at = Instant::now();
        }
        if report(fraction, train_loss, &state, &clock).is_break() {
            state.save(checkpoint_dir).map_err(TrainError::Checkpoint)?;
            return Err(TrainError::Cancelled {
                epoch: state.counters.epoch,
            });
        }
    };
    if state.counters.best_loss.is_none() {
        let loss = state.counters.history.last().map_or(f64::NAN, |h| h.train_loss);
        validate(&mut trainer, &mut state, loss, 1.0);
    }
    Ok(Outcome {
        parameters: state.best_parameters,
        epochs: state.counters.epoch,
        best_epoch: state.counters.best_epoch,
        history: state.counters.history,
        ended_by,
        elapsed_s: clock.elapsed_s(),
    })
}

/// Whole intervals between validations that lie before `fraction` of the schedule.
fn intervals(fraction: f64) -> f64 {
    // An epoch that ends where an interval does is not left to rounding.
    (fraction * VALIDATIONS + 1e-6).floor()
}

/// Who differentiates.
enum Network {
    Own(Box<Step>),
    Burn(Autodiff),
}

impl Network {
    fn gradient(
        &mut self,
        samples: Samples<'_>,
        parameters: &[f32],
        batch: &[u32],
        gradient: &mut [f32],
    ) -> f64 {
        match self {
            Self::Own(step) => step.gradient(samples, parameters, batch, gradient),
            Self::Burn(network) => network.gradient(samples, parameters, batch, gradient),
        }
    }

    fn loss(&mut self, samples: Samples<'_>, parameters: &[f32]) -> f64 {
        match self {
            Self::Own(step) => step.loss(samples, parameters),
            Self::Burn(network) => network.loss(samples, parameters),
        }
    }
}

/// The problem with what every step needs.
struct Trainer<'a> {
    problem: &'a Problem,
    network: Network,
    train_rows: Vec<u32>,
    validation_rows: Vec<u32>,
    gradient: Vec<f32>,
}

impl<'a> Trainer<'a> {
    fn new(problem: &'a Problem) -> Self {
        Self {
            problem,
            network: match problem.structure.form {
                Form::Dense => {
                    let step = Step::new(
                        &problem.layers,
                        &problem.whitening,
                        problem.steps * problem.train.series.width,
                        problem.recipe.batch,
                        problem.loss,
                    );
                    Network::Own(Box::new(step.with_dropout(&problem.structure.dropouts())))
                }
                _ => Network::Burn(comparison::autodiff(problem)),
            },
            train_rows: step::first_rows(&problem.train),
            validation_rows: step::first_rows(&problem.validation),
            gradient: vec![0.0; problem.parameters.len()],
        }
    }
}

/// Time spent in this attempt and those before it.
struct Clock {
    started: Instant,
    before_s: f64,
}

impl Clock {
    fn elapsed_s(&self) -> f64 {
        self.before_s + self.started.elapsed().as_secs_f64()
    }
}

struct Limits<'a> {
    problem: &'a Problem,
    steps_per_epoch: usize,
}

impl Limits<'_> {
    /// Part of the schedule done: of the epochs or of the time, whichever is further.
    fn fraction(&self, _state: &TrainState, epoch: usize, batch: usize, elapsed_s: f64) -> f64 {
        let recipe = &self.problem.recipe;
        let epochs = epoch as f64 + batch as f64 / self.steps_per_epoch as f64;
        let by_epochs = epochs / recipe.epochs as f64;
        let by_time = recipe.time_limit_s.map_or(0.0, |limit| elapsed_s / limit);
        by_epochs.max(by_time).min(1.0)
    }

    fn rate(&self, fraction: f64) -> f64 {
        let recipe = &self.problem.recipe;
        if recipe.cosine {
            recipe.learning_rate * 0.5 * (1.0 + (std::f64::consts::PI * fraction).cos())
        } else {
            recipe.learning_rate
        }
    }

    fn reached(&self, state: &TrainState, elapsed_s: f64) -> Option<TrainingEnd> {
        let recipe = &self.problem.recipe;
        let counters = &state.counters;
        let last_loss = counters.history.last().map(|h| h.train_loss);
        if recipe
            .loss_threshold
            .zip(last_loss)
            .is_some_and(|(threshold, loss)| loss < threshold)
        {
            return Some(TrainingEnd::LossThreshold);
        }
        if counters.epoch >= recipe.epochs {
            return Some(TrainingEnd::Epochs);
        }
        if recipe.time_limit_s.is_some_and(|limit| elapsed_s >= limit) {
            return Some(TrainingEnd::TimeLimit);
        }
        let since_best = counters
            .history
            .iter()
            .rev()
            .take_while(|h| h.epoch > counters.best_epoch)
            .count();
        (!recipe.cosine && since_best >= PATIENCE).then_some(TrainingEnd::EarlyStopping)
    }
}

/// One pass over the training windows in this epoch's order; the mean loss.
fn epoch(
    trainer: &mut Trainer<'_>,
    limits: &Limits<'_>,
    state: &mut TrainState,
    clock: &Clock,
    report: &mut dyn FnMut(f64, f64, &TrainState, &Clock) -> ControlFlow<()>,
) -> Result<f64, TrainError> {
    let problem = trainer.problem;
    let number = state.counters.epoch;
    let noisy = problem.epoch_part(number);
    let samples = Samples {
        part: noisy.as_ref().unwrap_or(&problem.train),
        first_rows: &trainer.train_rows,
    };
    let order = epoch_order(problem.train.windows.len(), problem.recipe.seed, number);
    let mut sum = 0.0;
    let mut seen = 0_usize;
    let mut reported = Instant::now();
    let drops = problem.structure.dropouts().contains(&true);
    for (index, batch) in order.chunks(problem.recipe.batch).enumerate() {
        let elapsed_s = clock.elapsed_s();
        let fraction = limits.fraction(state, number, index, elapsed_s);
        if fraction >= 1.0 && index > 0 {
            break; // The time limit fell into this epoch.
        }
        let rate = limits.rate(fraction);
        if let Network::Own(step) = &mut trainer.network
            && drops
        {
            let seed = step::dropout_seed(problem.recipe.seed, number, index);
            step.leave_out(problem.recipe.dropout, seed);
        }
        let loss = trainer
            .network
            .gradient(samples, &state.parameters, batch, &mut trainer.gradient);
        if !loss.is_finite() || loss > DIVERGENCE {
            return Err(TrainError::Diverged {
                epoch: number,
                loss,
                learning_rate: rate,
            });
        }
        state.adam.step(&mut state.parameters, &trainer.gradient, rate);
        sum += loss * batch.len() as f64;
        seen += batch.len();
        if reported.elapsed() >= Duration::from_millis(100) {
            reported = Instant::now();
            if report(fraction, sum / seen as f64, state, clock).is_break() {
                return Err(TrainError::Cancelled { epoch: number });
            }
        }
    }
    Ok(sum / seen as f64)
}

/// Validation loss, and the best weights if these are.
fn validate(trainer: &mut Trainer<'_>, state: &mut TrainState, train_loss: f64, fraction: f64) {
    let samples = Samples {
        part: &trainer.problem.validation,
        first_rows: &trainer.validation_rows,
    };
    let loss = trainer.network.loss(samples, &state.parameters);
    state.counters.validated_at = fraction;
    state.counters.history.push(EpochRecord {
        epoch: state.counters.epoch,
        train_loss,
        validation_loss: loss,
    });
    if state.counters.best_loss.is_none_or(|best| loss < best) {
        state.counters.best_loss = Some(loss);
        state.counters.best_epoch = state.counters.epoch;
        state.best_parameters.copy_from_slice(&state.parameters);
    }
}

/// Hash of everything that the result is a function of.
fn fingerprint(problem: &Problem, dataset_sha256: &str) -> String {
    let mut hash = Sha256::new();
    hash.update(serde_json::to_vec(&problem.spec).unwrap_or_default());
    hash.update(dataset_sha256);
    hash.update(env!("CARGO_PKG_VERSION"));
    hash.update(checkpoint::to_bytes(&problem.train.wanted));
    hash.update(checkpoint::to_bytes(&problem.parameters));
    hex::encode(hash.finalize())
}
