//! Writing a model folder.

use super::weights::{Auxiliary, LinearWeights, SkipWeights, Weights};
use super::{Model, ModelError, card};
use crate::evaluate::{self, metrics::metrics};
use crate::least_squares::{Spectrum, TargetRows, WindowMoments};
use crate::plot;
use crate::predict::Predictor;
use crate::runs::Runs;
use crate::scheduled::RANGE_FACTOR;
use crate::structure::parameter_count;
use crate::train::Outcome;
use crate::train::prepare::{Part, Problem, TrainingData};
use crate::window::{Series, Windows};
use hydroflex_openapi::job::WindowCut;
use hydroflex_openapi::model::{
    DenseLayer, Envelope, GoldenPrediction, Guard, MODEL_FORMAT_VERSION, ModelConfig, ModelProvenance,
    ModelSummary, TargetMetrics,
};
use sha2::{Digest, Sha256};
use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::Path;

/// Hashes of a model's files.
const SUMS: &str = "SHA256SUMS";
/// What every model has.
const CONFIG: &str = "config.json";
/// Windows stored with their estimates.
const GOLDEN_WINDOWS: usize = 3;
/// Version of the tensor framework, as in the workspace's manifest.
const BURN_VERSION: &str = "0.22.1";
/// Room around the training range of each input, relative to it: as far as our network follows.
const ENVELOPE_MARGIN: f64 = 0.5 * (RANGE_FACTOR - 1.0);

/// Room around the largest distance between estimate, or target, and guide on the training and validation runs …
const GUARD_ROOM: f64 = 1.5;
/// … and around the range of the targets, relative to it.
const GUARD_MARGIN: f64 = 0.5;

/// Assembles the model and writes its folder; a model that is there is replaced.
///
/// # Errors
/// Something else than a model is there, a file cannot be written, or the written model cannot be read back.
pub fn write_model(
    problem: &Problem,
    data: &TrainingData,
    outcome: &Outcome,
    out_dir: &Path,
) -> Result<ModelSummary, ModelError> {
    let weights = fold(problem, &outcome.parameters);
    let (mut envelope, projection) = envelope(problem);
    set_limits(&mut envelope, problem, &projection);
    let auxiliary = Auxiliary {
        least_squares: LinearWeights::from(&problem.linear),
        quasi_static: quasi_static(problem),
        envelope: Some(projection),
    };
    let mut config = config(problem, outcome, data);
    config.envelope = Some(envelope);
    config.guard = Some(guard(problem, &Predictor::new(&config, &weights, &auxiliary)));
    let predictor = Predictor::new(&config, &weights, &auxiliary);
    let judged = judge(problem, &predictor);
    config.validation = judged.network;
    config.validation_least_squares = judged.least_squares;
    config.intervals = judged.intervals;
    config.golden = golden(problem, &predictor);
    let pictures = [
        card::Picture {
            file: "distribution.svg",
            caption: "Distribution of the training data, scaled as the network sees them",
            svg: plot::distribution::of_problem(problem),
        },
        card::Picture {
            file: "learning.svg",
            caption: "Learning curve",
            svg: plot::profile::of_learning(&config),
        },
    ];
    write_parts(&config, &weights, &auxiliary, &pictures, out_dir)?;
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
    pictures: &[card::Picture],
    out_dir: &Path,
) -> Result<(), ModelError> {
    let tensors = |source| ModelError::Tensors {
        path: out_dir.to_owned(),
        source,
    };
    let mut files = vec![
        ("README.md", card::card(config, pictures).into_bytes()),
        ("auxiliary.safetensors", auxiliary.to_file().map_err(tensors)?),
        (CONFIG, to_json(config)),
        ("model.onnx", super::onnx::to_onnx(config, weights)),
        (
            "model.safetensors",
            weights.to_file(&config.layers).map_err(tensors)?,
        ),
    ];
    files.extend(
        pictures
            .iter()
            .map(|picture| (picture.file, picture.svg.clone().into_bytes())),
    );
    write_folder(out_dir, &files)
}

/// What stands where a model is to be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// Nothing, or an empty folder.
    Free,
    /// A model, and nothing beside its files.
    Model,
}

/// Looks whether a model can be written to a folder without touching what is not a model's.
///
/// # Errors
/// Something else is there, or it cannot be looked at.
pub fn place(out_dir: &Path) -> Result<Place, ModelError> {
    let occupied = |what: String| ModelError::Occupied {
        path: out_dir.to_owned(),
        what,
    };
    let cannot_read = |source| ModelError::File {
        action: "read",
        path: out_dir.to_owned(),
        source,
    };
    if out_dir.file_name().is_none() {
        return Err(occupied("names no folder of its own".to_owned()));
    }
    match fs::symlink_metadata(out_dir) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Place::Free),
        Err(error) => return Err(cannot_read(error)),
        Ok(meta) if !meta.is_dir() => return Err(occupied("is not a folder".to_owned())),
        Ok(_) => {}
    }
    let mut names = Vec::new();
    for entry in fs::read_dir(out_dir).map_err(cannot_read)? {
        names.push(
            entry
                .map_err(cannot_read)?
                .file_name()
                .to_string_lossy()
                .into_owned(),
        );
    }
    if names.is_empty() {
        return Ok(Place::Free);
    }
    names.sort();
    let sums = fs::read_to_string(out_dir.join(SUMS)).unwrap_or_default();
    let mut own: Vec<&str> = sums
        .lines()
        .filter_map(|line| line.split_once("  ").map(|(_, name)| name))
        .collect();
    if !own.contains(&CONFIG) {
        own.clear();
    }
    let foreign = names
        .iter()
        .find(|name| *name != SUMS && !own.contains(&name.as_str()));
    match foreign {
        Some(name) => Err(occupied(format!("holds {name:?}, which is no model's file"))),
        None if own.is_empty() => Err(occupied(format!("holds {SUMS} alone"))),
        None => Ok(Place::Model),
    }
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
    let before = place(out_dir)?;
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
    let path = temporary.join(SUMS);
    write_durably(&path, sums.as_bytes()).map_err(file_error(&path))?;
    // An empty folder gives way to a rename; a model is moved aside first, so that one of both is always whole.
    if before == Place::Free {
        return fs::rename(&temporary, out_dir).map_err(file_error(out_dir));
    }
    let aside = out_dir.with_file_name(format!(".{name}.old"));
    if aside.exists() {
        fs::remove_dir_all(&aside).map_err(file_error(&aside))?;
    }
    fs::rename(out_dir, &aside).map_err(file_error(out_dir))?;
    fs::rename(&temporary, out_dir).map_err(file_error(out_dir))?;
    fs::remove_dir_all(&aside).map_err(file_error(&aside))
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
        problem.output_steps * problem.spec.targets.len(),
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
        let scales = problem.wanted_scale.iter().cycle();
        for (t, &scale) in scales.take(last.bias.len()).enumerate() {
            let scaled = |w: &mut f32| *w = (f64::from(*w) * scale) as f32;
            last.weight[t * inputs..(t + 1) * inputs]
                .iter_mut()
                .for_each(scaled);
            scaled(&mut last.bias[t]);
        }
    }
    let followed = problem.skip.as_ref().and_then(|skip| skip.payload.as_ref());
    Weights {
        layers,
        skip: problem.skip.as_ref().map(|skip| SkipWeights::from(&skip.map)),
        payload: followed.map_or_else(Vec::new, |f| f.estimates.iter().map(SkipWeights::from).collect()),
        empty: followed.and_then(|f| f.empty.as_ref().map(|(_, map)| SkipWeights::from(map))),
        guard: Some(LinearWeights::from(&problem.guide)),
    }
}

/// Bounds that nothing in the training or validation runs touches: neither the targets nor the estimates of
/// `unlimited`, the model without bounds.
#[allow(
    clippy::needless_range_loop,
    reason = "k counts windows, and every target has an estimate for each"
)]
fn guard(problem: &Problem, unlimited: &Predictor) -> Guard {
    let scaling = &problem.target_scaling;
    let targets = problem.spec.targets.len();
    let mut distance = vec![0.0_f64; targets];
    let (mut low, mut high) = (vec![f64::INFINITY; targets], vec![f64::NEG_INFINITY; targets]);
    let mut guide = vec![0.0; targets];
    let mut workspace = unlimited.workspace();
    for (part, runs) in [
        (&problem.train, &problem.seen),
        (&problem.validation, &problem.validation_inputs),
    ] {
        let every = Windows::new(&part.series.run_rows, problem.steps, WindowCut::Overlapping);
        let mut index = 0;
        for run in &runs.runs {
            let columns: Vec<&[f64]> = run.columns.iter().map(Vec::as_slice).collect();
            let estimates = unlimited.predict_series_with(&columns, &mut workspace).columns;
            for k in 0..estimates[0].len() {
                let first = every.first_row(index);
                index += 1;
                problem
                    .guide
                    .apply(part.series.window(first, problem.steps), &mut guide);
                let truth = part.targets.row(first + problem.steps - 1);
                for t in 0..targets {
                    let estimate = scaling.scale(t, estimates[t][k]);
                    let off = (estimate - guide[t]).abs().max((truth[t] - guide[t]).abs());
                    distance[t] = distance[t].max(off);
                    low[t] = low[t].min(estimate).min(truth[t]);
                    high[t] = high[t].max(estimate).max(truth[t]);
                }
            }
        }
    }
    let channels = scaling.channels();
    Guard {
        slack: (0..targets)
            .map(|t| GUARD_ROOM * distance[t] * channels[t].scale)
            .collect(),
        min: (0..targets)
            .map(|t| scaling.unscale(t, low[t] - GUARD_MARGIN * (high[t] - low[t])))
            .collect(),
        max: (0..targets)
            .map(|t| scaling.unscale(t, high[t] + GUARD_MARGIN * (high[t] - low[t])))
            .collect(),
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

/// Envelope without limits, and its projection.
fn envelope(problem: &Problem) -> (Envelope, LinearWeights) {
    let (projection, groups) =
        crate::envelope::projection(&problem.moments, &problem.spectrum, problem.spec.inputs.len());
    let range = |input: usize| {
        let values = || {
            problem
                .seen
                .runs
                .iter()
                .flat_map(move |run| run.columns[input].iter().copied())
        };
        let (low, high) = (
            values().fold(f64::INFINITY, f64::min),
            values().fold(f64::NEG_INFINITY, f64::max),
        );
        let margin = ENVELOPE_MARGIN * (high - low);
        (low - margin, high + margin)
    };
    let (min, max) = (0..problem.spec.inputs.len()).map(range).unzip();
    (
        Envelope {
            components: projection.bias.len(),
            groups,
            min,
            max,
        },
        projection,
    )
}

/// Limits of the envelope from the calibration runs.
fn set_limits(envelope: &mut Envelope, problem: &Problem, projection: &LinearWeights) {
    let honest: Vec<(Series, Windows)> = problem
        .calibration
        .iter()
        .map(|(inputs, _)| {
            let series = Series::new(inputs, &problem.input_scaling);
            let windows = Windows::new(&series.run_rows, problem.steps, WindowCut::Overlapping);
            (series, windows)
        })
        .collect();
    let honest: Vec<(&Series, &Windows)> = honest.iter().map(|(s, w)| (s, w)).collect();
    crate::envelope::set_limits(&mut envelope.groups, projection, &honest);
}

struct Judged {
    network: Vec<TargetMetrics>,
    least_squares: Vec<TargetMetrics>,
    intervals: Vec<hydroflex_openapi::model::IntervalTable>,
}

/// Errors on the validation runs, of the network as it will predict and of least squares.
fn judge(problem: &Problem, predictor: &Predictor) -> Judged {
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
    let (estimates, _) = estimates(&problem.validation_inputs, predictor);
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
    let (mut estimated, mut truth) = (vec![Vec::new(); targets], vec![Vec::new(); targets]);
    let mut payload_kg = Vec::new();
    for (inputs, wanted) in &problem.calibration {
        let (of_windows, payloads) = self::estimates(inputs, predictor);
        for (all, part) in estimated.iter_mut().zip(of_windows) {
            all.extend(part);
        }
        payload_kg.extend(payloads);
        for run in &wanted.runs {
            for (all, column) in truth.iter_mut().zip(&run.columns) {
                all.extend(column.iter().skip(problem.steps - 1));
            }
        }
    }
    let intervals = estimated
        .iter()
        .zip(&truth)
        .zip(scaling.channels())
        .filter_map(|((e, r), channel)| {
            if predictor.follows_payload() {
                evaluate::intervals::fit_by_payload(e, r, &payload_kg, channel.offset)
            } else {
                evaluate::intervals::fit(e, r, channel.offset)
            }
        })
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

/// Estimates at the ends of all windows of some runs, run after run, one column per target, and the payload of each window, kg, where it is followed.
fn estimates(inputs: &Runs, predictor: &Predictor) -> (Vec<Vec<f64>>, Vec<f64>) {
    let mut estimates = vec![Vec::new(); predictor.target_count()];
    let mut payload_kg = Vec::new();
    let mut workspace = predictor.workspace();
    for run in &inputs.runs {
        let columns: Vec<&[f64]> = run.columns.iter().map(Vec::as_slice).collect();
        let series = predictor.predict_series_with(&columns, &mut workspace);
        for (all, column) in estimates.iter_mut().zip(series.columns) {
            all.extend(column);
        }
        payload_kg.extend(series.payload_kg);
    }
    (estimates, payload_kg)
}

/// Windows spread over the validation runs.
fn golden(problem: &Problem, predictor: &Predictor) -> Vec<GoldenPrediction> {
    let long: Vec<_> = problem
        .validation_inputs
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
                .flat_map(|row| run.columns.iter().map(move |column| column[row]))
                .collect();
            let mut estimates = vec![0.0; predictor.target_count()];
            predictor.predict_window(&window, &mut estimates, &mut workspace);
            Some(GoldenPrediction { window, estimates })
        })
        .collect()
}

fn config(problem: &Problem, outcome: &Outcome, data: &TrainingData) -> ModelConfig {
    let sample_time_s = data.train.sample_time_s;
    let calibrating: Vec<usize> = problem
        .calibration
        .iter()
        .flat_map(|(inputs, _)| inputs.runs.iter().map(crate::runs::RunSamples::len))
        .collect();
    ModelConfig {
        format_version: MODEL_FORMAT_VERSION,
        structure: problem.structure.name.clone(),
        window_steps: problem.steps,
        window_s: problem.steps as f64 * sample_time_s,
        sample_time_s,
        inputs: problem.input_scaling.channels().to_vec(),
        targets: problem.target_scaling.channels().to_vec(),
        output_steps: problem.output_steps,
        linear_skip: problem.structure.linear_skip,
        input_limits: problem.input_limits.clone(),
        schedule: problem.skip.as_ref().map(|skip| skip.map.schedule.clone()),
        payload: problem
            .skip
            .as_ref()
            .and_then(|skip| skip.payload.as_ref())
            .map(|following| following.config(&problem.empty_gain)),
        guard: None,
        layers: final_layers(problem),
        provenance: ModelProvenance {
            spec: problem.spec.clone(),
            dataset_sha256: data.dataset_sha256.clone(),
            train_runs: data.train.runs.len(),
            validation_runs: data.validation.runs.len(),
            calibration_windows: calibrating
                .iter()
                .map(|steps| (steps + 1).saturating_sub(problem.steps))
                .sum(),
            calibration_s: calibrating
                .iter()
                .max()
                .map_or(0.0, |&steps| steps as f64 * sample_time_s),
            train_windows: problem.train.windows.len(),
            epochs: outcome.epochs,
            best_epoch: outcome.best_epoch,
            learning_rate: problem.recipe.learning_rate,
            batch: problem.recipe.batch,
            ridge: Some(
                problem
                    .skip
                    .as_ref()
                    .map_or(problem.linear.ridge, |skip| skip.map.ridge),
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
    let targets = config.targets.len();
    let mut rows = 0;
    if config.linear_skip {
        rows += targets * config.schedule.as_ref().map_or(1, |s| s.exponents.len());
    }
    if let Some(payload) = &config.payload {
        rows += payload.estimates.iter().map(|s| s.exponents.len()).sum::<usize>();
        rows += targets * payload.empty.as_ref().map_or(0, |e| e.schedule.exponents.len());
    }
    let skip = rows * (config.skip_steps() * config.inputs.len() + 1);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_model_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("model");
        assert_eq!(place(&out).unwrap(), Place::Free);
        let files = [(CONFIG, b"{}".to_vec()), ("README.md", b"one".to_vec())];
        write_folder(&out, &files).unwrap();
        assert_eq!(place(&out).unwrap(), Place::Model);
        let files = [(CONFIG, b"{}".to_vec()), ("README.md", b"two".to_vec())];
        write_folder(&out, &files).unwrap();
        assert_eq!(fs::read(out.join("README.md")).unwrap(), b"two");

        fs::write(out.join("thesis.txt"), "mine").unwrap();
        let refused = write_folder(&out, &files).unwrap_err().to_string();
        assert!(refused.contains("thesis.txt"), "{refused}");
        assert_eq!(fs::read(out.join("thesis.txt")).unwrap(), b"mine");

        let mine = folder.path().join("mine");
        fs::create_dir(&mine).unwrap();
        assert_eq!(place(&mine).unwrap(), Place::Free);
        fs::write(mine.join("config.json"), "{}").unwrap();
        for dir in [
            mine.clone(),
            mine.join("config.json"),
            mine.join(".."),
            "..".into(),
            "/".into(),
        ] {
            assert!(
                matches!(write_folder(&dir, &files), Err(ModelError::Occupied { .. })),
                "{}",
                dir.display()
            );
        }
        let left: Vec<_> = fs::read_dir(folder.path())
            .unwrap()
            .map(|e| e.unwrap().file_name())
            .collect();
        assert_eq!(left.len(), 2, "{left:?}");
    }
}
