//! Networks of a study, and what each is worth.

use super::super::print_line;
use super::super::train::{show, training_bar};
use super::choices::{NoiseChoice, Recipe};
use super::sets::{Payload, Sets, evaluation_parts, parts_for};
use super::{Args, DEFAULT_SIGNALS, SAMPLE_S, report};
use anyhow::Context as _;
use hydroflex_dataset::Dataset;
use hydroflex_ml::evaluate::evaluate;
use hydroflex_ml::evaluate::faults::fault_rates;
use hydroflex_ml::model::Model;
use hydroflex_ml::plot::profile;
use hydroflex_ml::runs::Runs;
use hydroflex_ml::structure::Structure;
use hydroflex_ml::train::comparison::Comparison;
use hydroflex_ml::train::{Progress, TrainError, train_dataset};
use hydroflex_openapi::job::{TrainingSpec, WindowRule};
use hydroflex_openapi::model::{EvaluationReport, FaultRate};
use hydroflex_openapi::sweep::SensorSet;
use serde::{Deserialize, Serialize};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

fn default_signals() -> u64 {
    DEFAULT_SIGNALS
}

/// One trained network and what it is worth on one payload.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Cell {
    /// Of the evaluation.
    pub(super) payload_kg: f64,
    /// Random signals asked for.
    #[serde(default = "default_signals")]
    pub(super) signals: u64,
    /// Of the training runs.
    pub(super) trained: Payload,
    /// Training runs, where the study has several numbers of them.
    #[serde(default)]
    pub(super) runs: Option<u64>,
    pub(super) sensors: SensorSet,
    pub(super) structure: String,
    #[serde(default)]
    pub(super) recipe: Recipe,
    pub(super) noise: NoiseChoice,
    pub(super) seed: u64,
    /// As asked for.
    pub(super) spec: TrainingSpec,
    pub(super) window_steps: usize,
    pub(super) parameters: usize,
    pub(super) train_seconds: f64,
    /// On the published cycle.
    pub(super) cycle: EvaluationReport,
    /// On the first random 10 s runs.
    pub(super) random: EvaluationReport,
    /// On all random 10 s runs without a flag: intervals and envelope.
    pub(super) calm: EvaluationReport,
    /// On all random 10 s runs with a flag: end stops, cavitation.
    pub(super) flagged: Option<EvaluationReport>,
    /// Stuck and swapped sensors in the runs of `calm`.
    pub(super) faults: Vec<FaultRate>,
    /// Part of the windows flagged of the other payloads' random runs without a flag.
    pub(super) other_payloads: Vec<(f64, f64)>,
    /// On the validation runs: short, of the same kind as the training runs.
    pub(super) validation_mae: Vec<f64>,
    /// Hash of the training data, where no model folder says it: of networks for comparison.
    #[serde(default)]
    pub(super) trained_on: Option<String>,
}

/// A training as it was asked for.
struct Asked {
    sensors: SensorSet,
    recipe: Recipe,
    noise: NoiseChoice,
    spec: TrainingSpec,
    /// Of its files.
    name: String,
}

/// What the trainings on one data set share.
pub(super) struct Study<'a> {
    pub(super) args: &'a Args,
    pub(super) sets: &'a [Sets],
    pub(super) trained: &'a Sets,
}

impl Study<'_> {
    /// One network; a cell per payload that it is evaluated on: its own, or all of those in its range.
    pub(super) fn cells(
        &self,
        sensors: SensorSet,
        structure: &str,
        recipe: Recipe,
        noise: NoiseChoice,
        seed: u64,
    ) -> anyhow::Result<Vec<Cell>> {
        let spec = TrainingSpec {
            structure: structure.to_owned(),
            inputs: sensors.of(self.trained.training.channels()),
            targets: self.args.targets.clone(),
            window: WindowRule::Given {
                window_s: self.trained.payload.window_steps() as f64 * SAMPLE_S,
            },
            seed,
            // The published length belongs to the published way.
            epochs: self.args.epochs.filter(|_| recipe == Recipe::Ours),
            time_limit_s: self.args.time_limit_s,
            noise: noise.spec(),
            windows: recipe.windows(),
            ..TrainingSpec::default()
        };
        let asked = Asked {
            sensors,
            recipe,
            noise,
            spec,
            name: match self.trained.runs {
                None => name_of_files(sensors, structure, recipe, noise, seed),
                Some(runs) => format!(
                    "{}-{runs}-runs",
                    name_of_files(sensors, structure, recipe, noise, seed)
                ),
            },
        };
        if Structure::is_comparison(structure) {
            self.of_comparison(&asked)
        } else {
            self.of_model(&asked)
        }
    }

    /// Cells of a network that becomes a model folder.
    fn of_model(&self, asked: &Asked) -> anyhow::Result<Vec<Cell>> {
        let Sets {
            folder,
            training,
            calibration,
            ..
        } = self.trained;
        let (name, spec) = (&asked.name, &asked.spec);
        let model_dir = folder.join(name);
        let before = Model::load(&model_dir).ok();
        let before = before.filter(|m| m.config().provenance.dataset_sha256 == training.dataset_sha256());
        let others: Vec<f64> = self.other_sets().map(|(kg, _)| kg).collect();
        let is_ours = |cell: &Cell| {
            before
                .as_ref()
                .is_some_and(|model| cell.cycle.model_sha256 == model.sha256())
                && cell
                    .other_payloads
                    .iter()
                    .map(|&(kg, _)| kg)
                    .eq(others.iter().copied())
        };
        if let Some(cells) = self.earlier(asked, is_ours) {
            return Ok(cells);
        }
        let summary = self.with_bar(name, |progress, checkpoint| {
            train_dataset(
                training,
                spec,
                Some(calibration),
                progress,
                checkpoint,
                &model_dir,
            )
        })?;
        let model = Model::load(&model_dir)?;
        let mut cells = Vec::new();
        for (payload_kg, evaluation) in self.evaluated() {
            let runs = parts_for(&model, evaluation, spec.seed, self.args.signals)
                .with_context(|| format!("cannot evaluate {name} at {payload_kg} kg"))?;
            let sha256 = evaluation.dataset_sha256();
            let report = |runs: &Runs| anyhow::Ok(evaluate(&model, runs, sha256)?.report);
            let picture = folder.join(format!("{name}-at-{payload_kg}-kg.svg"));
            let title = format!("{name} at {payload_kg} kg");
            cells.push(Cell {
                payload_kg,
                signals: self.args.signals,
                trained: self.trained.payload,
                runs: self.trained.runs,
                sensors: asked.sensors,
                structure: spec.structure.clone(),
                recipe: asked.recipe,
                noise: asked.noise,
                seed: spec.seed,
                spec: spec.clone(),
                window_steps: self.trained.payload.window_steps(),
                parameters: summary.parameters,
                train_seconds: summary.train_seconds,
                cycle: report(&runs.cycle)?,
                random: evaluate_and_draw(&model, &runs.random, sha256, &picture, &title)?,
                calm: report(&runs.calm)?,
                flagged: (!runs.flagged.runs.is_empty())
                    .then(|| report(&runs.flagged))
                    .transpose()?,
                faults: fault_rates(&model, &runs.calm)?,
                other_payloads: self.other_payloads(&model, spec.seed)?,
                validation_mae: summary.validation.iter().map(|m| m.mae).collect(),
                trained_on: None,
            });
        }
        self.keep(name, cells)
    }

    /// The same for a network for comparison, which has no folder, intervals or envelope.
    fn of_comparison(&self, asked: &Asked) -> anyhow::Result<Vec<Cell>> {
        let training = &self.trained.training;
        let (name, spec) = (&asked.name, &asked.spec);
        let is_ours = |cell: &Cell| cell.trained_on.as_deref() == Some(training.dataset_sha256());
        if let Some(cells) = self.earlier(asked, is_ours) {
            return Ok(cells);
        }
        let network = self.with_bar(name, |progress, checkpoint| {
            Comparison::train_dataset(training, spec, progress, checkpoint)
        })?;
        let mut cells = Vec::new();
        for (payload_kg, evaluation) in self.evaluated() {
            let noisy = |runs: &Runs| network.with_noise_of_training(runs, spec.seed);
            let runs = evaluation_parts(&network.channels(), evaluation, self.args.signals, &noisy)
                .with_context(|| format!("cannot evaluate {name} at {payload_kg} kg"))?;
            let report = |runs: &Runs| network.evaluate(runs, evaluation.dataset_sha256());
            cells.push(Cell {
                payload_kg,
                signals: self.args.signals,
                trained: self.trained.payload,
                runs: self.trained.runs,
                sensors: asked.sensors,
                structure: spec.structure.clone(),
                recipe: asked.recipe,
                noise: asked.noise,
                seed: spec.seed,
                spec: spec.clone(),
                window_steps: self.trained.payload.window_steps(),
                parameters: network.parameters(),
                train_seconds: network.train_seconds,
                cycle: report(&runs.cycle)?,
                random: report(&runs.random)?,
                calm: report(&runs.calm)?,
                flagged: None,
                faults: Vec::new(),
                other_payloads: Vec::new(),
                validation_mae: Vec::new(),
                trained_on: Some(training.dataset_sha256().to_owned()),
            });
        }
        self.keep(name, cells)
    }

    /// Trains with a bar to look at; `train` is given what reports progress, and a directory for checkpoints.
    fn with_bar<T>(
        &self,
        name: &str,
        train: impl FnOnce(&mut dyn FnMut(Progress) -> ControlFlow<()>, &Path) -> Result<T, TrainError>,
    ) -> anyhow::Result<T> {
        let bar = training_bar(self.args.json);
        let mut progress = |progress: Progress| {
            show(&bar, &progress);
            ControlFlow::Continue(())
        };
        let checkpoint = self.trained.folder.join(format!(".{name}.checkpoint"));
        let trained = train(&mut progress, &checkpoint);
        bar.finish_and_clear();
        let trained =
            trained.with_context(|| format!("cannot train {name} at {}", self.trained.payload.name()))?;
        // Only an empty directory is removed: whatever else is in it is not ours.
        let _ = std::fs::remove_dir(&checkpoint);
        Ok(trained)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.trained.folder.join(format!("{name}.json"))
    }

    /// Cells of an earlier call that are ours, if they were asked for in the same way and belong to these evaluations.
    fn earlier(&self, asked: &Asked, is_ours: impl Fn(&Cell) -> bool) -> Option<Vec<Cell>> {
        let evaluated = self.evaluated();
        let text = std::fs::read(self.path(&asked.name)).ok()?;
        let cells: Vec<Cell> = serde_json::from_slice(&text).ok()?;
        let matches = |(cell, (kg, evaluation)): (&Cell, &(f64, &Dataset))| {
            cell.payload_kg.to_bits() == kg.to_bits()
                && cell.spec == asked.spec
                && cell.signals == self.args.signals
                && cell.cycle.dataset_sha256 == evaluation.dataset_sha256()
                && is_ours(cell)
        };
        (cells.len() == evaluated.len() && cells.iter().zip(&evaluated).all(matches)).then_some(cells)
    }

    /// Writes the cells for later calls, and says what they are.
    fn keep(&self, name: &str, cells: Vec<Cell>) -> anyhow::Result<Vec<Cell>> {
        if !self.args.json {
            for cell in &cells {
                print_line(format_args!("{}", report::line(cell)))?;
            }
        }
        let path = self.path(name);
        std::fs::write(&path, serde_json::to_vec_pretty(&cells)?)
            .with_context(|| format!("cannot write {}", path.display()))?;
        Ok(cells)
    }

    /// The evaluation sets of the payloads that the trained network is for.
    fn evaluated(&self) -> Vec<(f64, &Dataset)> {
        let payload = self.trained.payload;
        // The same for every number of training runs.
        self.sets
            .iter()
            .filter(|set| set.runs == self.trained.runs)
            .filter_map(|set| match (set.payload, &set.evaluation) {
                (Payload::Fixed(kg), Some(evaluation)) => Some((kg, evaluation)),
                _ => None,
            })
            .filter(|(kg, _)| match payload {
                Payload::Fixed(own) => own.to_bits() == kg.to_bits(),
                Payload::Range { .. } => true,
            })
            .collect()
    }

    /// Part of the windows outside the envelope, by payload, of the payloads that the model was not trained on.
    fn other_payloads(&self, model: &Model, seed: u64) -> anyhow::Result<Vec<(f64, f64)>> {
        let mut parts = Vec::new();
        for (kg, evaluation) in self.other_sets() {
            let runs = parts_for(model, evaluation, seed, self.args.signals)?.calm;
            let inside = evaluate(model, &runs, evaluation.dataset_sha256())?
                .report
                .inside_envelope;
            parts.extend(inside.map(|inside| (kg, 1.0 - inside)));
        }
        Ok(parts)
    }

    /// The evaluation sets of the payloads that a network for one payload was not trained on.
    fn other_sets(&self) -> impl Iterator<Item = (f64, &Dataset)> {
        let own = match self.trained.payload {
            Payload::Fixed(own) => Some(own),
            Payload::Range { .. } => None,
        };
        let sets = self.sets.iter().filter(|set| set.runs == self.trained.runs);
        sets.filter_map(move |set| match (own, set.payload, &set.evaluation) {
            (Some(own), Payload::Fixed(kg), Some(evaluation)) if kg.to_bits() != own.to_bits() => {
                Some((kg, evaluation))
            }
            _ => None,
        })
    }
}

/// Name of a network's files.
fn name_of_files(
    sensors: SensorSet,
    structure: &str,
    recipe: Recipe,
    noise: NoiseChoice,
    seed: u64,
) -> String {
    let noisy = if noise == NoiseChoice::Crane { "-crane" } else { "" };
    let published = if recipe == Recipe::Published {
        "-published"
    } else {
        ""
    };
    format!("{}-{structure}{published}{noisy}-{seed}", sensors.name())
}

/// Errors on `runs`, and a picture of where they stand.
fn evaluate_and_draw(
    model: &Model,
    runs: &Runs,
    dataset_sha256: &str,
    picture: &Path,
    title: &str,
) -> anyhow::Result<EvaluationReport> {
    let evaluation = evaluate(model, runs, dataset_sha256)?;
    std::fs::write(picture, profile::of_target(model, &evaluation, 0, title))
        .with_context(|| format!("cannot write {}", picture.display()))?;
    Ok(evaluation.report)
}
