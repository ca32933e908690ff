//! From a data set on disk to runs in memory: the one place where the two meet.

use crate::model::Model;
use crate::runs::{RunSamples, Runs};
use crate::train::TrainError;
use crate::train::prepare::{TrainingData, default_inputs, default_targets};
use hydroflex_dataset::{Dataset, OpenError, RunColumns};
use hydroflex_openapi::dataset::{DatasetSource, SplitName};
use hydroflex_openapi::job::{RunFlag, TrainingSpec, WindowRule};
use std::collections::HashSet;

/// Of a data set without validation runs, every fifth training run validates (20 %, as in the paper).
const VALIDATION_STRIDE: usize = 5;

/// Loads what `spec` needs, and fills in its channels and its window.
///
/// Runs with a flag that the data set's job excludes are left out. The validation runs without any flag calibrate
/// intervals and envelope, and so do those of `calibration`.
///
/// # Errors
/// A channel is not there, a file is damaged, or the window cannot be told.
pub fn training_data(
    dataset: &Dataset,
    spec: &TrainingSpec,
    calibration: Option<&Runs>,
) -> Result<(TrainingData, TrainingSpec), TrainError> {
    let mut spec = spec.clone();
    if spec.inputs.is_empty() {
        spec.inputs = default_inputs(dataset.channels());
    }
    if spec.targets.is_empty() {
        spec.targets = default_targets(dataset.channels());
    }
    spec.window = WindowRule::Given {
        window_s: window_s(dataset, spec.window)?,
    };
    let names: Vec<String> = spec.inputs.iter().chain(&spec.targets).cloned().collect();
    let excluded = excluded_runs(dataset);
    let load = |split| -> Result<Runs, TrainError> {
        let mut runs = load(dataset, split, &names)?;
        runs.runs.retain(|run| !excluded.contains(&run.run_id));
        Ok(runs)
    };
    let (mut train, mut validation) = (load(SplitName::Train)?, load(SplitName::Validation)?);
    if validation.runs.is_empty() {
        let runs = std::mem::take(&mut train.runs);
        let chosen = |index: &usize| index % VALIDATION_STRIDE == VALIDATION_STRIDE - 1;
        for (index, run) in runs.into_iter().enumerate() {
            if chosen(&index) {
                validation.runs.push(run);
            } else {
                train.runs.push(run);
            }
        }
    }
    let calm = |run: &&RunSamples| dataset.run(run.run_id).is_none_or(|row| row.flags.is_empty());
    let short = Runs {
        channels: validation.channels.clone(),
        sample_time_s: validation.sample_time_s,
        runs: validation.runs.iter().filter(calm).cloned().collect(),
    };
    let mut calibrating = vec![short];
    if let Some(long) = calibration {
        calibrating.push(long.select(&names)?);
    }
    let dataset_sha256 = dataset.dataset_sha256().to_owned();
    Ok((
        TrainingData {
            train,
            validation,
            calibration: calibrating,
            payloads_kg: dataset
                .runs()
                .iter()
                .map(|run| (run.run_id, run.payload_kg))
                .collect(),
            dataset_sha256,
        },
        spec,
    ))
}

/// Runs on which to judge a model: all of a data set it has not seen; of the one that it was trained
/// on, the test runs, or the validation runs where there are none.
///
/// # Errors
/// A channel is not there or a file is damaged.
pub fn evaluation_runs(dataset: &Dataset, model: &Model) -> Result<Runs, OpenError> {
    let config = model.config();
    let names: Vec<String> = config
        .inputs
        .iter()
        .chain(&config.targets)
        .map(|c| c.name.clone())
        .collect();
    if dataset.dataset_sha256() != config.provenance.dataset_sha256 {
        return load_all(dataset, &names);
    }
    let test = load(dataset, SplitName::Test, &names)?;
    if test.runs.is_empty() {
        load(dataset, SplitName::Validation, &names)
    } else {
        Ok(test)
    }
}

/// Every run of a data set, the channels `names`.
///
/// # Errors
/// A channel is not there or a file is damaged.
pub fn load_all(dataset: &Dataset, names: &[String]) -> Result<Runs, OpenError> {
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    to_runs(dataset, &names, dataset.load_all(&names)?)
}

fn load(dataset: &Dataset, split: SplitName, names: &[String]) -> Result<Runs, OpenError> {
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    to_runs(dataset, &names, dataset.load(split, &names)?)
}

fn to_runs(dataset: &Dataset, names: &[&str], runs: Vec<RunColumns>) -> Result<Runs, OpenError> {
    Ok(Runs {
        channels: names
            .iter()
            .map(|name| dataset.channel(name).cloned())
            .collect::<Result<_, _>>()?,
        sample_time_s: dataset.sample_time_s(),
        runs: runs
            .into_iter()
            .map(|run| RunSamples {
                run_id: run.run_id,
                columns: run.columns,
            })
            .collect(),
    })
}

fn excluded_runs(dataset: &Dataset) -> HashSet<u64> {
    let DatasetSource::Job { spec } = &dataset.manifest().source else {
        return HashSet::new();
    };
    let excluded = |flag: &RunFlag| spec.exclude_flags.contains(flag);
    dataset
        .runs()
        .iter()
        .filter(|run| run.flags.iter().any(excluded))
        .map(|run| run.run_id)
        .collect()
}

fn window_s(dataset: &Dataset, rule: WindowRule) -> Result<f64, TrainError> {
    if let WindowRule::Given { window_s } = rule {
        return Ok(window_s);
    }
    let facts = dataset.window()?.ok_or(TrainError::NoWindow)?;
    let length = match rule {
        WindowRule::Band => facts.band_s,
        WindowRule::Paper => facts.paper_s,
        WindowRule::Eigenvalues => facts.eigenvalues_s,
        WindowRule::Given { .. } => None,
    };
    length.filter(|s| *s > 0.0).ok_or(TrainError::NoWindow)
}
