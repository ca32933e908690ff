//! From a data set and a specification to a well-posed training problem.

use super::TrainError;
use crate::evaluate::metrics::quantile;
use crate::least_squares::{LinearMap, Spectrum, TargetRows, WindowMoments};
use crate::network::Loss;
use crate::network::init::initial_parameters;
use crate::noise::Noise;
use crate::payload::{Payloads, Skip};
use crate::runs::{RunSamples, Runs};
use crate::scaling::Scaling;
use crate::scheduled::{RANGE_FACTOR, Sample};
use crate::structure::{Form, Structure, StructureError};
use crate::window::{Series, WindowError, Windows, window_steps};
use hydroflex_openapi::channel::{Channel, ChannelRole};
use hydroflex_openapi::job::{TrainingSpec, WindowCut, WindowRule};
use hydroflex_openapi::model::DenseLayer;
use rayon::prelude::*;
use std::collections::HashMap;

/// Fewest training runs: with fewer the scales and the linear map say nothing about other runs.
pub const MIN_TRAIN_RUNS: usize = 2;

/// Steps of a training of our own when neither epochs nor a time limit are given.
const DEFAULT_STEPS: usize = 3000;
/// Most epochs of the paper's recipe.
const PAPER_EPOCHS: usize = 1000;
/// The paper's recipe stops at this training loss.
const PAPER_LOSS_THRESHOLD: f64 = 5e-6;
/// The paper's learning rate.
const PAPER_LEARNING_RATE: f64 = 1e-4;
/// Ours.
const LEARNING_RATE: f64 = 1e-3;
/// Our batch.
const BATCH: usize = 1024;

/// Part of the values that dropout leaves out by default: ours, the paper names none.
const DROPOUT: f64 = 0.1;

/// Whitening keeps directions whose variance exceeds this part of the largest …
const WHITENING_CUT: f64 = 1e-9;
/// … and divides by the root of variance plus this part of the largest, so that directions that
/// hold only rounding are not blown up to unit size.
const WHITENING_FLOOR: f64 = 1e-8;

/// The guide is the linear map that would be best if every sample had an independent error of this part of its
/// channel's standard deviation: exact enough to be a bound, and too tame to explode on signals unlike the training's.
const GUIDE_NOISE: f64 = 0.01;

/// First stream of the noise that does not change from epoch to epoch; epochs count from 0.
const SEEN_STREAM: u64 = 1 << 32;

/// Runs to learn from, with all the channels of their data set.
#[derive(Debug, Clone)]
pub struct TrainingData {
    /// Runs whose errors are minimised.
    pub train: Runs,
    /// Runs that choose the ridge and the best epoch.
    pub validation: Runs,
    /// Runs without a flag that are not trained on, by kind (short, long): they calibrate the intervals and the
    /// envelope. Where none is as long as a window, the validation runs do.
    pub calibration: Vec<Runs>,
    /// Payload of each run, kg, where it is known: what the linear part of our network may learn to tell.
    pub payloads_kg: HashMap<u64, f64>,
    /// Hash of the data set.
    pub dataset_sha256: String,
}

/// How a training proceeds, defaults filled in.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// Largest number of epochs.
    pub epochs: usize,
    /// Largest training time, s.
    pub time_limit_s: Option<f64>,
    /// Learning rate at the start.
    pub learning_rate: f64,
    /// Whether it falls to zero along a cosine.
    pub cosine: bool,
    /// Windows per batch.
    pub batch: usize,
    /// Training loss at which to stop.
    pub loss_threshold: Option<f64>,
    /// Seed.
    pub seed: u64,
    /// Part of the values that dropout leaves out.
    pub dropout: f64,
}

/// Windows of one part of the runs with what the network shall say at their ends.
#[derive(Debug, Clone)]
pub struct Part {
    /// Scaled inputs.
    pub series: Series,
    /// Windows.
    pub windows: Windows,
    /// What the network learns, row by row as the series: scaled targets, or what the linear map
    /// leaves over, in units of its standard deviation.
    pub wanted: Vec<f32>,
    /// Scaled targets in f64.
    pub targets: TargetRows,
}

/// Everything that the training loop needs.
#[derive(Debug, Clone)]
pub struct Problem {
    /// The specification with defaults filled in.
    pub spec: TrainingSpec,
    /// Structure.
    pub structure: Structure,
    /// Samples in a window.
    pub steps: usize,
    /// Samples that are estimated at once.
    pub output_steps: usize,
    /// Samples that the skip takes for each of them.
    pub skip_steps: usize,
    /// Scales of the inputs.
    pub input_scaling: Scaling,
    /// Scales of the targets.
    pub target_scaling: Scaling,
    /// Training part.
    pub train: Part,
    /// Validation part.
    pub validation: Part,
    /// Inputs of the training runs as the model will see them: with noise, where there is any.
    pub seen: Runs,
    /// The same of the validation runs, of which [`Self::validation`] is made.
    pub validation_inputs: Runs,
    /// Runs that calibrate: inputs as the model will see them, and targets.
    pub calibration: Vec<(Runs, Runs)>,
    /// Sensor noise.
    pub noise: Option<Noise>,
    /// Clean inputs of the training runs, to which every epoch adds other noise; only where there is noise.
    pub clean: Option<Runs>,
    /// Moments of the training windows.
    pub moments: WindowMoments,
    /// Their spectrum.
    pub spectrum: Spectrum,
    /// Least squares on the window: baseline of every model.
    pub linear: LinearMap,
    /// The same with coefficients that follow the pose: the skip connection of our network.
    pub skip: Option<Skip>,
    /// A linear map with small coefficients, near which estimates are kept.
    pub guide: LinearMap,
    /// What is minimised.
    pub loss: Loss,
    /// Values at which inputs are held, in their columns' units; none for the paper's structures.
    pub input_limits: Vec<[f64; 2]>,
    /// Typical size of what the network learns, per target, in scaled units (1 without skip).
    pub wanted_scale: Vec<f64>,
    /// What it is multiplied by where a window takes the map of empty machines; none where there is no such map.
    pub empty_gain: Vec<f64>,
    /// Rows that whiten a window, and what they make of the mean window; empty for the paper's recipe.
    pub whitening: Whitening,
    /// Layers as trained: the first one takes the whitened window.
    pub layers: Vec<DenseLayer>,
    /// Weights at the start.
    pub parameters: Vec<f32>,
    /// How to proceed.
    pub recipe: Recipe,
}

/// `z = P x − P x̄`, folded into the first layer when the training is over.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Whitening {
    /// components × window values, row-major.
    pub projection: Vec<f32>,
    /// −P x̄.
    pub offset: Vec<f32>,
}

impl Whitening {
    /// Number of components.
    #[must_use]
    pub fn components(&self) -> usize {
        self.offset.len()
    }
}

/// Inputs by default: valve, length, velocity and both pressures of every cylinder.
#[must_use]
pub fn default_inputs(channels: &[Channel]) -> Vec<String> {
    let wanted = ["valve_", "length_", "velocity_", "pressure_"];
    let is_input =
        |c: &&Channel| c.role != ChannelRole::Target && wanted.iter().any(|w| c.name.starts_with(w));
    channels.iter().filter(is_input).map(|c| c.name.clone()).collect()
}

/// Targets by default: every structural channel except axial and out-of-plane deflection.
#[must_use]
pub fn default_targets(channels: &[Channel]) -> Vec<String> {
    let secondary =
        |name: &str| name.starts_with("deflection_") && (name.ends_with("_x_m") || name.ends_with("_z_m"));
    channels
        .iter()
        .filter(|c| c.role == ChannelRole::Target && !secondary(&c.name))
        .map(|c| c.name.clone())
        .collect()
}

impl Problem {
    /// Checks the data against the specification and fits everything that has a closed form.
    ///
    /// # Errors
    /// The data cannot answer the specification.
    #[allow(clippy::too_many_lines, reason = "one check after the other")]
    pub fn new(data: &TrainingData, spec: &TrainingSpec) -> Result<Self, TrainError> {
        let spec = with_defaults(data, spec);
        check_names(&spec)?;
        let train_inputs = data.train.select(&spec.inputs)?;
        let train_targets = data.train.select(&spec.targets)?;
        let validation_inputs = data.validation.select(&spec.inputs)?;
        let validation_targets = data.validation.select(&spec.targets)?;
        for runs in [
            &train_inputs,
            &train_targets,
            &validation_inputs,
            &validation_targets,
        ] {
            runs.check()?;
        }
        let noise = spec
            .noise
            .as_ref()
            .map(|noise| Noise::new(noise, &train_inputs.channels, train_inputs.sample_time_s))
            .transpose()?;
        let noisy = |runs: &Runs, stream: u64| {
            noise
                .as_ref()
                .map_or_else(|| runs.clone(), |noise| noise.add(runs, spec.seed, stream))
        };
        let train_inputs = match &noise {
            Some(noise) => noise.differentiated(&train_inputs),
            None => train_inputs,
        };
        let seen = noisy(&train_inputs, SEEN_STREAM);
        let validation_inputs = noisy(&validation_inputs, SEEN_STREAM + 1);
        let published = spec.windows == WindowCut::Disjoint;
        let window = match spec.window {
            WindowRule::Given { window_s } => window_steps(window_s, data.train.sample_time_s)?,
            _ => return Err(TrainError::NoWindow),
        };
        let width = spec.width.or(spec.width_windows.map(|times| times * window));
        if let (Some(width), Some(_)) = (width, spec.width_windows)
            && width > TrainingSpec::WIDEST
        {
            return Err(StructureError::TooWide { width }.into());
        }
        let structure = Structure::parse_any(&spec.structure, window, width)?;
        let output_steps = spec.output_steps.unwrap_or(1);
        if output_steps > 1 && structure.form != Form::Dense {
            return Err(TrainError::SingleStep {
                structure: structure.name,
            });
        }
        if spec.dropout.is_some() && !structure.dropouts().contains(&true) {
            return Err(TrainError::NoDropout {
                structure: structure.name,
            });
        }
        // Every sample that is estimated has the whole window before it.
        let steps = if output_steps > 1 {
            window + output_steps
        } else {
            window
        };

        let scaling: fn(&Runs) -> Scaling = if published { Scaling::paper } else { Scaling::fit };
        let (input_scaling, target_scaling) = (scaling(&seen), scaling(&train_targets));
        let part = |inputs: &Runs, targets: &Runs, cut| -> Result<Part, TrainError> {
            let series = Series::new(inputs, &input_scaling);
            let windows = Windows::new(&series.run_rows, steps, cut);
            check_lengths(inputs, steps, &windows)?;
            Ok(Part {
                targets: target_rows(targets, &target_scaling),
                series,
                windows,
                wanted: Vec::new(),
            })
        };
        if data.train.runs.len() < MIN_TRAIN_RUNS || data.validation.runs.is_empty() {
            return Err(TrainError::TooFewRuns {
                train: data.train.runs.len(),
                validation: data.validation.runs.len(),
            });
        }
        let mut train = part(&train_inputs, &train_targets, spec.windows)?;
        let mut validation = part(&validation_inputs, &validation_targets, WindowCut::Overlapping)?;

        // The linear map uses every window even where the network gets the published few.
        let every = Windows::new(&train.series.run_rows, steps, WindowCut::Overlapping);
        let mut moments = WindowMoments::gather(&train.series, &every, &train.targets);
        if let Some(noise) = &noise {
            moments.add_noise(&noise.covariance(steps, &input_scaling));
        }
        let calibration = calibration(data, &spec, steps, &noisy)?;
        // The skip is the same map for every sample that is estimated, of the samples before it.
        let skip_steps = steps + 1 - output_steps;
        let judge = WindowMoments::gather(&validation.series, &validation.windows, &validation.targets);
        let spectrum = Spectrum::new(&moments)?;
        let linear = spectrum.best_map(&moments, &judge);
        let guide = spectrum.ridge_map(
            &moments,
            GUIDE_NOISE * GUIDE_NOISE
                / spectrum
                    .values
                    .last()
                    .copied()
                    .unwrap_or(1.0)
                    .max(f64::MIN_POSITIVE),
        );
        let skip = if structure.linear_skip {
            let payloads = [&data.train, &data.validation].map(|runs| payloads(data, runs));
            let payloads = match &payloads {
                [Some(train), Some(judge)] => Some(Payloads { train, judge }),
                _ => None,
            };
            let [every, judged] = [&train, &validation]
                .map(|part| Windows::new(&part.series.run_rows, skip_steps, WindowCut::Overlapping));
            let covariance = noise
                .as_ref()
                .map(|noise| noise.covariance(skip_steps, &input_scaling));
            Some(Skip::fit(
                sample(&train, &every),
                sample(&validation, &judged),
                payloads,
                &input_scaling,
                &slow_inputs(&train_inputs),
                covariance.as_ref(),
            )?)
        } else {
            None
        };
        // What the network learns is what the skip leaves over of windows as the model sees them.
        if noise.is_some() {
            train.series = Series::new(&seen, &input_scaling);
        }
        let errors =
            [&train, &validation].map(|part| skip_errors(part, skip_steps, skip.as_ref(), &input_scaling));
        let (wanted_scale, empty_gain) = wanted_scale(&train, skip.as_ref(), &errors[0]);
        for (part, errors) in [&mut train, &mut validation].into_iter().zip(errors) {
            part.wanted = errors.in_units_of(&wanted_scale, &empty_gain);
        }

        let input_limits = if structure.linear_skip {
            input_limits(&seen)
        } else {
            Vec::new()
        };
        let whitening = if published || structure.form != Form::Dense {
            Whitening::default()
        } else {
            whitening(&spectrum, &moments)
        };
        let window_values = steps * spec.inputs.len();
        let first_inputs = match whitening.components() {
            0 => window_values,
            components => components,
        };
        let layers = structure.layers(first_inputs, output_steps * spec.targets.len());
        let recipe = recipe(&spec, published, data.train.runs.len(), train.windows.len());
        let parameters = initial_parameters(&layers, spec.seed, 1.0);
        Ok(Self {
            spec,
            steps,
            output_steps,
            skip_steps,
            input_scaling,
            target_scaling,
            train,
            validation,
            clean: noise.is_some().then_some(train_inputs),
            seen,
            validation_inputs,
            calibration,
            noise,
            moments,
            spectrum,
            linear,
            skip,
            guide,
            input_limits,
            loss: if structure.linear_skip {
                Loss::PseudoHuber
            } else {
                Loss::Square
            },
            structure,
            wanted_scale,
            empty_gain,
            whitening,
            layers,
            parameters,
            recipe,
        })
    }
}

/// The calibration runs that are as long as a window, or else the validation runs.
fn calibration(
    data: &TrainingData,
    spec: &TrainingSpec,
    steps: usize,
    noisy: &dyn Fn(&Runs, u64) -> Runs,
) -> Result<Vec<(Runs, Runs)>, TrainError> {
    let part = |runs: &Runs, stream: u64| -> Result<(Runs, Runs), TrainError> {
        let (inputs, targets) = (runs.select(&spec.inputs)?, runs.select(&spec.targets)?);
        inputs.check()?;
        targets.check()?;
        Ok((noisy(&inputs, stream), targets))
    };
    let long_enough = |runs: &&Runs| runs.runs.iter().any(|run| run.len() >= steps);
    let parts = data
        .calibration
        .iter()
        .filter(long_enough)
        .zip(SEEN_STREAM + 2..)
        .map(|(runs, stream)| part(runs, stream))
        .collect::<Result<Vec<_>, _>>()?;
    if parts.is_empty() {
        return Ok(vec![part(&data.validation, SEEN_STREAM + 1)?]);
    }
    Ok(parts)
}

impl Problem {
    /// The training part as epoch `epoch` sees it: with noise of its own, where there is any.
    #[must_use]
    pub fn epoch_part(&self, epoch: usize) -> Option<Part> {
        let (noise, clean) = self.noise.as_ref().zip(self.clean.as_ref())?;
        let runs = noise.add(clean, self.spec.seed, epoch as u64);
        let mut part = Part {
            series: Series::new(&runs, &self.input_scaling),
            windows: self.train.windows.clone(),
            wanted: Vec::new(),
            targets: self.train.targets.clone(),
        };
        let errors = skip_errors(&part, self.skip_steps, self.skip.as_ref(), &self.input_scaling);
        part.wanted = errors.in_units_of(&self.wanted_scale, &self.empty_gain);
        Some(part)
    }
}

fn with_defaults(data: &TrainingData, spec: &TrainingSpec) -> TrainingSpec {
    let mut spec = spec.clone();
    if spec.inputs.is_empty() {
        spec.inputs = default_inputs(&data.train.channels);
    }
    if spec.targets.is_empty() {
        spec.targets = default_targets(&data.train.channels);
    }
    spec
}

fn check_names(spec: &TrainingSpec) -> Result<(), TrainError> {
    if spec.inputs.is_empty() {
        return Err(TrainError::NoChannels { what: "input" });
    }
    if spec.targets.is_empty() {
        return Err(TrainError::NoChannels { what: "target" });
    }
    if let Some(name) = spec.targets.iter().find(|t| spec.inputs.contains(t)) {
        return Err(TrainError::TargetIsInput { name: name.clone() });
    }
    for (what, value) in [
        ("learning_rate", spec.learning_rate),
        ("time_limit_s", spec.time_limit_s),
    ] {
        if let Some(value) = value.filter(|v| !(v.is_finite() && *v > 0.0)) {
            return Err(TrainError::NotPositive { what, value });
        }
    }
    if let Some(value) = spec.dropout.filter(|part| !(0.0..1.0).contains(part)) {
        return Err(TrainError::NoPart { value });
    }
    for (what, value) in [
        ("epochs", spec.epochs),
        ("batch", spec.batch),
        ("output_steps", spec.output_steps),
        ("width_windows", spec.width_windows),
    ] {
        if value == Some(0) {
            return Err(TrainError::NotPositive { what, value: 0.0 });
        }
    }
    Ok(())
}

fn check_lengths(runs: &Runs, steps: usize, windows: &Windows) -> Result<(), TrainError> {
    if !windows.is_empty() {
        return Ok(());
    }
    Err(TrainError::Window(WindowError::longer_than(runs, steps)))
}

fn target_rows(runs: &Runs, scaling: &Scaling) -> TargetRows {
    let width = runs.channels.len();
    let rows: usize = runs.runs.iter().map(crate::runs::RunSamples::len).sum();
    let mut values = Vec::with_capacity(rows * width);
    for run in &runs.runs {
        for row in 0..run.len() {
            values.extend(
                run.columns
                    .iter()
                    .enumerate()
                    .map(|(t, column)| scaling.scale(t, column[row])),
            );
        }
    }
    TargetRows { width, values }
}

fn sample<'a>(part: &'a Part, windows: &'a Windows) -> Sample<'a> {
    Sample {
        series: &part.series,
        windows,
        targets: &part.targets,
        only: None,
        estimates: None,
    }
}

/// The payload of each run, kg, if all are known.
fn payloads(data: &TrainingData, runs: &Runs) -> Option<Vec<f64>> {
    let known = |run: &RunSamples| data.payloads_kg.get(&run.run_id).copied();
    runs.runs.iter().map(known).collect()
}

/// Inputs that tell the pose: lengths of cylinders, else angles.
fn slow_inputs(inputs: &Runs) -> Vec<usize> {
    let named = |prefix: &str| -> Vec<usize> {
        inputs
            .channels
            .iter()
            .enumerate()
            .filter(|(_, channel)| channel.name.starts_with(prefix))
            .map(|(position, _)| position)
            .collect()
    };
    let lengths = named("length_");
    if lengths.is_empty() {
        named("angle_")
    } else {
        lengths
    }
}

/// The training range of each input, widened as the slow signals' is.
fn input_limits(runs: &Runs) -> Vec<[f64; 2]> {
    (0..runs.channels.len())
        .map(|input| {
            let values = || {
                runs.runs
                    .iter()
                    .flat_map(|run| run.columns[input].iter().copied())
            };
            let low = values().fold(f64::INFINITY, f64::min);
            let high = values().fold(f64::NEG_INFINITY, f64::max);
            let room = 0.5 * (RANGE_FACTOR - 1.0) * (high - low);
            [low - room, high + room]
        })
        .collect()
}

/// What the skip leaves over of the scaled targets, row by row.
struct LeftOver {
    errors: Vec<f64>,
    /// Whether the window that ends at each row took the map of empty machines.
    is_empty: Vec<bool>,
}

/// Of a skip of so many samples; the targets themselves without one. Rows that no window estimates may be 0 where there is a skip.
fn skip_errors(part: &Part, steps: usize, skip: Option<&Skip>, scaling: &Scaling) -> LeftOver {
    let width = part.targets.width;
    let mut is_empty = vec![false; part.series.rows()];
    let Some(map) = skip else {
        return LeftOver {
            errors: part.targets.values.clone(),
            is_empty,
        };
    };
    let mut errors = vec![0.0; part.targets.values.len()];
    let windows = if steps == part.windows.steps {
        part.windows.clone()
    } else {
        Windows::new(&part.series.run_rows, steps, WindowCut::Overlapping)
    };
    let estimates: Vec<(Vec<f64>, bool)> = (0..windows.len())
        .into_par_iter()
        .map(|index| {
            let mut estimate = vec![0.0; width];
            let window = part.series.window(windows.first_row(index), steps);
            let is_empty = map.apply(scaling, window, &mut estimate);
            (estimate, is_empty)
        })
        .collect();
    for (index, (estimate, took_empty)) in estimates.iter().enumerate() {
        let row = windows.last_row(index);
        is_empty[row] = *took_empty;
        for (t, value) in estimate.iter().enumerate() {
            errors[row * width + t] = part.targets.row(row)[t] - value;
        }
    }
    LeftOver { errors, is_empty }
}

/// Median size of what the skip leaves over on the training windows, per target; 1 without skip:
/// rare windows with large errors do not set the scale of the others. A target that the skip explains to the last bit keeps a floor far below anything
/// measurable. Second, what to multiply these by where a window took the map of empty machines: what the two maps leave over differs in size,
/// and a network that learnt both in one unit would be as coarse for the one as for the other.
fn wanted_scale(part: &Part, skip: Option<&Skip>, left: &LeftOver) -> (Vec<f64>, Vec<f64>) {
    const FLOOR: f64 = 1e-7;
    let width = part.targets.width;
    let Some(skip) = skip else {
        return (vec![1.0; width], Vec::new());
    };
    let median = |rows: &[usize]| -> Vec<f64> {
        (0..width)
            .map(|t| {
                let mut sizes: Vec<f64> = rows
                    .iter()
                    .map(|row| left.errors[row * width + t].abs())
                    .collect();
                quantile(&mut sizes, 0.5).max(FLOOR)
            })
            .collect()
    };
    let ends = (0..part.windows.len()).map(|index| part.windows.last_row(index));
    let (empty, loaded): (Vec<usize>, Vec<usize>) = ends.partition(|&row| left.is_empty[row]);
    let has_empty = skip.payload.as_ref().is_some_and(|p| p.empty.is_some());
    if !has_empty || empty.is_empty() || loaded.is_empty() {
        return (median(&[empty, loaded].concat()), Vec::new());
    }
    let scale = median(&loaded);
    // Half way between one unit for all and one for each. With one for each an empty machine's windows, whose rest is mostly what nobody
    // can learn, took so much of the network that at 100 kg a tenth more error was left on the published boom (U s p1 p2).
    let gain = |(e, s): (&f64, &f64)| (e / s).sqrt();
    let gain = median(&empty).iter().zip(&scale).map(gain).collect();
    (scale, gain)
}

impl LeftOver {
    /// In the scale of each target, which is another one where the machine is empty.
    #[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
    fn in_units_of(&self, scale: &[f64], empty_gain: &[f64]) -> Vec<f32> {
        let of_row = |(row, is_empty): (&[f64], &bool)| -> Vec<f32> {
            let gain = |t: usize| {
                if *is_empty {
                    empty_gain.get(t).copied().unwrap_or(1.0)
                } else {
                    1.0
                }
            };
            let units = row.iter().zip(scale).enumerate();
            units.map(|(t, (e, s))| (e / (s * gain(t))) as f32).collect()
        };
        let rows = self.errors.chunks(scale.len()).zip(&self.is_empty);
        rows.flat_map(of_row).collect()
    }
}

#[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
fn whitening(spectrum: &Spectrum, moments: &WindowMoments) -> Whitening {
    let rows = spectrum.whitening(WHITENING_CUT, WHITENING_FLOOR);
    let offset = rows
        .iter()
        .map(|row| -row.iter().zip(&moments.mean).map(|(p, m)| p * m).sum::<f64>() as f32)
        .collect();
    Whitening {
        projection: rows.iter().flatten().map(|&v| v as f32).collect(),
        offset,
    }
}

fn recipe(spec: &TrainingSpec, published: bool, runs: usize, windows: usize) -> Recipe {
    let batch = spec
        .batch
        .unwrap_or(if published { (runs / 8).max(1) } else { BATCH })
        .min(windows);
    let steps_per_epoch = windows.div_ceil(batch);
    let epochs = match (spec.epochs, spec.time_limit_s, published) {
        (Some(epochs), ..) => epochs,
        (None, Some(_), _) => usize::MAX,
        (None, None, true) => PAPER_EPOCHS,
        (None, None, false) => DEFAULT_STEPS.div_ceil(steps_per_epoch),
    };
    Recipe {
        epochs,
        time_limit_s: spec.time_limit_s,
        learning_rate: spec.learning_rate.unwrap_or(if published {
            PAPER_LEARNING_RATE
        } else {
            LEARNING_RATE
        }),
        cosine: !published,
        batch,
        loss_threshold: published.then_some(PAPER_LOSS_THRESHOLD),
        seed: spec.seed,
        dropout: spec.dropout.unwrap_or(DROPOUT),
    }
}
