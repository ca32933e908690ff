//! Writing a model folder.

use super::weights::{Auxiliary, LinearWeights, SkipWeights, Weights};
use super::{Model, ModelError, card};
use crate::evaluate::{self, metrics::metrics};
use crate::least_squares::{Spectrum, TargetRows, WindowMoments};
use crate::predict::Predictor;
use crate::scheduled::RANGE_FACTOR;
use crate::structure::parameter_count;
use crate::train::Outcome;
use crate::train::prepare::{Part, Problem, TrainingData};
use crate::window::{Series, Windows};
use hydroflex_openapi::job::WindowCut;
use hydroflex_openapi::model::{
    DenseLayer, Envelope, EnvelopeGroup, GoldenPrediction, MODEL_FORMAT_VERSION, ModelConfig,
    ModelProvenance, ModelSummary, TargetMetrics,
};
use sha2::{Digest, Sha256};
use std::fs::{self, File};
use std::io::Write;
use std::path::Path;

/// Windows stored with their estimates.
const GOLDEN_WINDOWS: usize = 3;
/// Version of the tensor framework, as in the workspace's manifest.
const BURN_VERSION: &str = "0.22.1";
/// Directions of the envelope have at least this part of the largest variance: below, rounding of the
/// scaled inputs to f32 would be seen.
const ENVELOPE_CUT: f64 = 1e-12;
/// Variances within a group differ by at most this many powers of ten.
const ENVELOPE_DECADES: f64 = 2.0;
/// Part of the validation windows within each group's limit, before the limit is widened …
const ENVELOPE_QUANTILE: f64 = 0.998;
/// … by this factor, for what a few runs did not show.
const ENVELOPE_ROOM: f64 = 1.5;
/// Room around the training range of each input, relative to it: as far as our network follows.
const ENVELOPE_MARGIN: f64 = 0.5 * (RANGE_FACTOR - 1.0);

/// Assembles the model and writes its folder, replacing what is there.
///
/// # Errors
/// A file cannot be written, or the written model cannot be read back.
pub fn write_model(
    problem: &Problem,
    data: &TrainingData,
    outcome: &Outcome,
    out_dir: &Path,
) -> Result<ModelSummary, ModelError> {
    let weights = fold(problem, &outcome.parameters);
    let (envelope, projection) = envelope(problem, data);
    let auxiliary = Auxiliary {
        least_squares: LinearWeights::from(&problem.linear),
        quasi_static: quasi_static(problem),
        envelope: Some(projection),
    };
    let mut config = config(problem, outcome, data);
    config.envelope = Some(envelope);
    let predictor = Predictor::new(&config, &weights, &auxiliary);
    let judged = judge(problem, data, &predictor);
    config.validation = judged.network;
    config.validation_least_squares = judged.least_squares;
    config.intervals = judged.intervals;
    if let Some(envelope) = &mut config.envelope {
        set_limits(&mut envelope.groups, problem, &auxiliary);
    }
    config.golden = golden(problem, data, &predictor);
    write_parts(&config, &weights, &auxiliary, out_dir)?;
    let model = Model::load(out_dir)?;
    Ok(summary(&model, problem, outcome))
}

/// Writes the folder of a model, replacing what is there.
///
/// # Errors
/// A file cannot be written.
pub(crate) fn write_parts(
    config: &ModelConfig,
    weights: &Weights,
    auxiliary: &Auxiliary,
    out_dir: &Path,
) -> Result<(), ModelError> {
    let tensors = |source| ModelError::Tensors {
        path: out_dir.to_owned(),
        source,
    };
    let files = [
        ("README.md", card::card(config).into_bytes()),
        ("auxiliary.safetensors", auxiliary.to_file().map_err(tensors)?),
        ("config.json", to_json(config)),
        ("model.onnx", super::onnx::to_onnx(config, weights)),
        (
            "model.safetensors",
            weights.to_file(&config.layers).map_err(tensors)?,
        ),
    ];
    write_folder(out_dir, &files)
}

/// Writes `files` into a fresh folder beside `out_dir`, then puts it in place.
fn write_folder(out_dir: &Path, files: &[(&str, Vec<u8>)]) -> Result<(), ModelError> {
    let file_error = |path: &Path| {
        let path = path.to_owned();
        move |source| ModelError::File {
            action: "write",
            path,
            source,
        }
    };
    let name = out_dir
        .file_name()
        .map(|n| n.to_string_lossy().into_owned())
        .unwrap_or_default();
    let temporary = out_dir.with_file_name(format!(".{name}.part"));
    if temporary.exists() {
        fs::remove_dir_all(&temporary).map_err(file_error(&temporary))?;
    }
    fs::create_dir_all(&temporary).map_err(file_error(&temporary))?;
    let mut sums = String::new();
    for (name, content) in files {
        write_durably(&temporary.join(name), content).map_err(file_error(&temporary.join(name)))?;
        sums.extend([hex::encode(Sha256::digest(content)).as_str(), "  ", name, "\n"]);
    }
    let path = temporary.join("SHA256SUMS");
    write_durably(&path, sums.as_bytes()).map_err(file_error(&path))?;
    if out_dir.exists() {
        fs::remove_dir_all(out_dir).map_err(file_error(out_dir))?;
    }
    fs::rename(&temporary, out_dir).map_err(file_error(out_dir))
}

fn write_durably(path: &Path, content: &[u8]) -> std::io::Result<()> {
    let mut file = File::create(path)?;
    file.write_all(content)?;
    file.sync_all()
}

fn to_json(config: &ModelConfig) -> Vec<u8> {
    let mut json = serde_json::to_vec_pretty(config).unwrap_or_default();
    json.push(b'\n');
    json
}

/// Layers with their real input: the first one takes the scaled window itself.
fn final_layers(problem: &Problem) -> Vec<DenseLayer> {
    problem.structure.layers(
        problem.steps * problem.spec.inputs.len(),
        problem.spec.targets.len(),
    )
}

/// Folds whitening into the first layer and the residual's scale into the last one, in f64.
#[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
fn fold(problem: &Problem, parameters: &[f32]) -> Weights {
    let mut rest = parameters;
    let mut layers: Vec<LinearWeights> = problem
        .layers
        .iter()
        .map(|layer| {
            let (weight, tail) = rest.split_at(layer.outputs * layer.inputs);
            let (bias, tail) = tail.split_at(layer.outputs);
            rest = tail;
            LinearWeights {
                weight: weight.to_vec(),
                bias: bias.to_vec(),
            }
        })
        .collect();
    let components = problem.whitening.components();
    if let Some(size) = problem.whitening.projection.len().checked_div(components) {
        let first = &mut layers[0];
        let mut weight = Vec::with_capacity(first.bias.len() * size);
        for (row, bias) in first.weight.chunks(components).zip(&mut first.bias) {
            let mut sum = vec![0.0_f64; size];
            for (&w, direction) in row.iter().zip(problem.whitening.projection.chunks(size)) {
                for (s, &p) in sum.iter_mut().zip(direction) {
                    *s += f64::from(w) * f64::from(p);
                }
            }
            let shift: f64 = row
                .iter()
                .zip(&problem.whitening.offset)
                .map(|(&w, &o)| f64::from(w) * f64::from(o))
                .sum();
            *bias = (f64::from(*bias) + shift) as f32;
            weight.extend(sum.iter().map(|&s| s as f32));
        }
        first.weight = weight;
    }
    if let Some(last) = layers.last_mut() {
        let inputs = last.weight.len() / last.bias.len();
        for (t, &scale) in problem.wanted_scale.iter().enumerate() {
            let scaled = |w: &mut f32| *w = (f64::from(*w) * scale) as f32;
            last.weight[t * inputs..(t + 1) * inputs]
                .iter_mut()
                .for_each(scaled);
            scaled(&mut last.bias[t]);
        }
    }
    Weights {
        layers,
        skip: problem.skip.as_ref().map(SkipWeights::from),
    }
}

/// Least squares on single rows: what a static formula could do.
fn quasi_static(problem: &Problem) -> LinearWeights {
    let last_rows = |part: &Part| -> (Series, Windows, TargetRows) {
        // Only rows that end a window, so that it is judged on the same samples.
        let width = part.series.width;
        let mut values = Vec::new();
        let mut targets = Vec::new();
        let mut run_rows = vec![0];
        for (first, count) in
            Windows::new(&part.series.run_rows, problem.steps, WindowCut::Overlapping).spans()
        {
            let (from, to) = (first + problem.steps - 1, first + problem.steps - 1 + count);
            values.extend_from_slice(&part.series.values[from * width..to * width]);
            targets
                .extend_from_slice(&part.targets.values[from * part.targets.width..to * part.targets.width]);
            run_rows.push(values.len() / width);
        }
        let windows = Windows::new(&run_rows, 1, WindowCut::Overlapping);
        (
            Series {
                width,
                values,
                run_rows,
            },
            windows,
            TargetRows {
                width: part.targets.width,
                values: targets,
            },
        )
    };
    let (series, windows, targets) = last_rows(&problem.train);
    let moments = WindowMoments::gather(&series, &windows, &targets);
    match Spectrum::new(&moments) {
        Ok(spectrum) => LinearWeights::from(&spectrum.ridge_map(&moments, 1e-10)),
        Err(_) => LinearWeights {
            weight: vec![0.0; series.width * targets.width],
            bias: vec![0.0; targets.width],
        },
    }
}

#[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
fn envelope(problem: &Problem, data: &TrainingData) -> (Envelope, LinearWeights) {
    let rows = problem.spectrum.whitening(ENVELOPE_CUT, 0.0);
    let bias = rows
        .iter()
        .map(|row| {
            -row.iter()
                .zip(&problem.moments.mean)
                .map(|(p, m)| p * m)
                .sum::<f64>() as f32
        })
        .collect();
    let projection = LinearWeights {
        weight: rows.iter().flatten().map(|&v| v as f32).collect(),
        bias,
    };
    let positions = data.train.positions(&problem.spec.inputs).unwrap_or_default();
    let (mut min, mut max) = (Vec::new(), Vec::new());
    for position in positions {
        let values = || {
            data.train
                .runs
                .iter()
                .flat_map(move |run| run.columns[position].iter().copied())
        };
        let (low, high) = (
            values().fold(f64::INFINITY, f64::min),
            values().fold(f64::NEG_INFINITY, f64::max),
        );
        let margin = ENVELOPE_MARGIN * (high - low);
        min.push(low - margin);
        max.push(high + margin);
    }
    (
        Envelope {
            components: rows.len(),
            groups: groups(&problem.spectrum.values, rows.len()),
            min,
            max,
        },
        projection,
    )
}

/// The first `count` directions, largest variance first, in groups of similar variance; no limits yet.
fn groups(ascending: &[f64], count: usize) -> Vec<EnvelopeGroup> {
    let largest = ascending.last().copied().unwrap_or(1.0);
    let mut groups: Vec<EnvelopeGroup> = Vec::new();
    let mut edge = f64::INFINITY;
    for value in ascending.iter().rev().take(count) {
        let decade = (value / largest).log10();
        match groups.last_mut() {
            Some(group) if decade > edge => group.components += 1,
            _ => {
                edge = decade - ENVELOPE_DECADES;
                groups.push(EnvelopeGroup {
                    components: 1,
                    limit: f64::MAX,
                });
            }
        }
    }
    groups
}

/// Limits that all but rare validation windows keep.
fn set_limits(groups: &mut [EnvelopeGroup], problem: &Problem, auxiliary: &Auxiliary) {
    let Some(map) = &auxiliary.envelope else { return };
    let projection = crate::predict::kernel::PackedLayer::new(map, &[]);
    let part = &problem.validation;
    let mut out = vec![0.0; projection.padded()];
    let mut squares = vec![Vec::with_capacity(part.windows.len()); groups.len()];
    for index in 0..part.windows.len() {
        let window = part.series.window(part.windows.first_row(index), problem.steps);
        projection.forward(window, window.len(), 1, &mut out);
        for (all, square) in squares
            .iter_mut()
            .zip(crate::predict::group_squares(groups, &out))
        {
            all.push(square);
        }
    }
    for (group, squares) in groups.iter_mut().zip(&mut squares) {
        group.limit = ENVELOPE_ROOM * evaluate::metrics::quantile(squares, ENVELOPE_QUANTILE);
    }
}

struct Judged {
    network: Vec<TargetMetrics>,
    least_squares: Vec<TargetMetrics>,
    intervals: Vec<hydroflex_openapi::model::IntervalTable>,
}

/// Errors on the validation runs, of the network as it will predict and of least squares.
fn judge(problem: &Problem, data: &TrainingData, predictor: &Predictor) -> Judged {
    let part = &problem.validation;
    let targets = problem.spec.targets.len();
    let scaling = &problem.target_scaling;
    let mut reference = vec![Vec::new(); targets];
    let mut linear = vec![Vec::new(); targets];
    let mut row = vec![0.0; targets];
    for index in 0..part.windows.len() {
        let first = part.windows.first_row(index);
        problem
            .linear
            .apply(part.series.window(first, problem.steps), &mut row);
        for t in 0..targets {
            reference[t].push(scaling.unscale(t, part.targets.row(first + problem.steps - 1)[t]));
            linear[t].push(scaling.unscale(t, row[t]));
        }
    }
    let mut estimates = vec![Vec::new(); targets];
    let positions = data
        .validation
        .positions(&problem.spec.inputs)
        .unwrap_or_default();
    let mut workspace = predictor.workspace();
    for run in &data.validation.runs {
        let columns: Vec<&[f64]> = positions.iter().map(|&p| run.columns[p].as_slice()).collect();
        let series = predictor.predict_series_with(&columns, &mut workspace);
        for (all, column) in estimates.iter_mut().zip(series.columns) {
            all.extend(column);
        }
    }
    let judge = |estimate: &[Vec<f64>]| -> Vec<TargetMetrics> {
        scaling
            .channels()
            .iter()
            .zip(estimate.iter().zip(&reference))
            .map(|(channel, (estimate, reference))| {
                metrics(&channel.name, &channel.unit, estimate, reference)
            })
            .collect()
    };
    let intervals = estimates
        .iter()
        .zip(&reference)
        .zip(scaling.channels())
        .filter_map(|((e, r), channel)| evaluate::intervals::fit(e, r, channel.offset))
        .collect::<Vec<_>>();
    Judged {
        network: judge(&estimates),
        least_squares: judge(&linear),
        intervals: if intervals.len() == targets {
            intervals
        } else {
            Vec::new()
        },
    }
}

/// Windows spread over the validation runs.
fn golden(problem: &Problem, data: &TrainingData, predictor: &Predictor) -> Vec<GoldenPrediction> {
    let positions = data
        .validation
        .positions(&problem.spec.inputs)
        .unwrap_or_default();
    let long: Vec<_> = data
        .validation
        .runs
        .iter()
        .filter(|run| run.len() >= problem.steps)
        .collect();
    let mut workspace = predictor.workspace();
    (0..GOLDEN_WINDOWS)
        .filter_map(|i| {
            let run = long.get(i * long.len() / GOLDEN_WINDOWS)?;
            let first = (run.len() - problem.steps) * (i + 1) / (GOLDEN_WINDOWS + 1);
            let window: Vec<f64> = (first..first + problem.steps)
                .flat_map(|row| positions.iter().map(move |&p| run.columns[p][row]))
                .collect();
            let mut estimates = vec![0.0; predictor.target_count()];
            predictor.predict_window(&window, &mut estimates, &mut workspace);
            Some(GoldenPrediction { window, estimates })
        })
        .collect()
}

fn config(problem: &Problem, outcome: &Outcome, data: &TrainingData) -> ModelConfig {
    let sample_time_s = data.train.sample_time_s;
    ModelConfig {
        format_version: MODEL_FORMAT_VERSION,
        structure: problem.structure.name.clone(),
        window_steps: problem.steps,
        window_s: problem.steps as f64 * sample_time_s,
        sample_time_s,
        inputs: problem.input_scaling.channels().to_vec(),
        targets: problem.target_scaling.channels().to_vec(),
        linear_skip: problem.structure.linear_skip,
        input_limits: problem.input_limits.clone(),
        schedule: problem.skip.as_ref().map(|skip| skip.schedule.clone()),
        layers: final_layers(problem),
        provenance: ModelProvenance {
            spec: problem.spec.clone(),
            dataset_sha256: data.dataset_sha256.clone(),
            train_runs: data.train.runs.len(),
            validation_runs: data.validation.runs.len(),
            train_windows: problem.train.windows.len(),
            epochs: outcome.epochs,
            best_epoch: outcome.best_epoch,
            learning_rate: problem.recipe.learning_rate,
            batch: problem.recipe.batch,
            ridge: Some(
                problem
                    .skip
                    .as_ref()
                    .map_or(problem.linear.ridge, |skip| skip.ridge),
            ),
            history: outcome.history.clone(),
            ended_by: outcome.ended_by,
            hydroflex_version: env!("CARGO_PKG_VERSION").to_owned(),
            burn_version: BURN_VERSION.to_owned(),
        },
        validation: Vec::new(),
        validation_least_squares: Vec::new(),
        intervals: Vec::new(),
        envelope: None,
        golden: Vec::new(),
    }
}

fn summary(model: &Model, problem: &Problem, outcome: &Outcome) -> ModelSummary {
    let config = model.config();
    let skip = if config.linear_skip {
        let terms = config.schedule.as_ref().map_or(1, |s| s.exponents.len());
        terms * config.targets.len() * (config.window_steps * config.inputs.len() + 1)
    } else {
        0
    };
    ModelSummary {
        model_sha256: model.sha256().to_owned(),
        dataset_sha256: config.provenance.dataset_sha256.clone(),
        structure: config.structure.clone(),
        inputs: problem.spec.inputs.clone(),
        targets: problem.spec.targets.clone(),
        window_steps: config.window_steps,
        window_s: config.window_s,
        epochs: outcome.epochs,
        ended_by: outcome.ended_by,
        parameters: parameter_count(&config.layers) + skip,
        train_seconds: outcome.elapsed_s,
        validation: config.validation.clone(),
        validation_least_squares: config.validation_least_squares.clone(),
    }
}
