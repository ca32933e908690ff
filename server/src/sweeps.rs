//! Sweeps: from a request to its cells, and from what the cells found to a table and a picture.
//!
//! The order of the cells is that of the request: structures, then sensors, then windows, then seeds.

use hydroflex_ledger::{SweepCellRecord, SweepRecord};
use hydroflex_ml::evaluate::table::{baseline_name, display_unit, significant};
use hydroflex_ml::plot::errors::{ErrorKind, ErrorPanel, ErrorPicture, ErrorRow};
use hydroflex_openapi::channel::Channel;
use hydroflex_openapi::job::{TrainingSpec, WindowRule};
use hydroflex_openapi::model::TargetMetrics;
use hydroflex_openapi::problem::FieldError;
use hydroflex_openapi::sweep::{
    CellResult, MAX_CELLS, SensorSet, Sensors, SweepGrid, SweepRequest, SweepRow, SweepState, SweepTable,
};
use serde::Serialize;
use std::collections::BTreeSet;
use std::fmt::Write as _;

/// A request with its lists filled in.
#[derive(Debug, Clone, PartialEq)]
pub struct Sweep {
    asked: SweepRequest,
    structures: Vec<String>,
    sensors: Vec<(Sensors, Vec<String>)>,
    windows: Vec<WindowRule>,
    seeds: Vec<u64>,
}

/// Which entry of each list a cell has.
type Place = [usize; 4];

impl Sweep {
    /// Fills the lists of a request in; `channels` are those of its data set.
    ///
    /// # Errors
    /// Empty lists, entries that are there twice, sensors that the data set lacks, too many cells.
    pub fn new(asked: &SweepRequest, channels: &[Channel]) -> Result<Self, Vec<FieldError>> {
        let spec = &asked.spec;
        let published = asked.grid == Some(SweepGrid::Published);
        let structures = asked.structures.clone().unwrap_or_else(|| {
            if published {
                SweepGrid::STRUCTURES.map(str::to_owned).to_vec()
            } else {
                vec![spec.structure.clone()]
            }
        });
        let sensors = asked.sensors.clone().unwrap_or_else(|| {
            if published {
                SensorSet::ALL.map(Sensors::Set).to_vec()
            } else if spec.inputs.is_empty() {
                vec![Sensors::Set(SensorSet::All)]
            } else {
                vec![Sensors::Channels(spec.inputs.clone())]
            }
        });
        let windows = asked.windows.clone().unwrap_or_else(|| vec![spec.window]);
        let seeds = asked.seeds.clone().unwrap_or_else(|| {
            if published {
                (0..SweepGrid::SEEDS).collect()
            } else {
                vec![spec.seed]
            }
        });
        let mut errors = Vec::new();
        check_list("/structures", &structures, &mut errors);
        check_list("/sensors", &sensors, &mut errors);
        check_list("/windows", &windows, &mut errors);
        check_list("/seeds", &seeds, &mut errors);
        let cells = [structures.len(), sensors.len(), windows.len(), seeds.len()]
            .iter()
            .try_fold(1_usize, |product, count| product.checked_mul(*count))
            .unwrap_or(usize::MAX);
        if cells > MAX_CELLS {
            errors.push(
                FieldError::new("", "structures × sensors × windows × seeds are too many networks")
                    .value(cells)
                    .allowed(format!("at most {MAX_CELLS} in a sweep")),
            );
        }
        let mut chosen = Vec::new();
        for (k, sensors) in sensors.into_iter().enumerate() {
            let inputs: Vec<String> = match &sensors {
                Sensors::Set(set) => set.of(channels),
                Sensors::Channels(names) => names.clone(),
            };
            if inputs.is_empty() {
                errors.push(
                    FieldError::new(
                        format!("/sensors/{k}"),
                        "no channel of the data set is among them",
                    )
                    .value(serde_json::to_value(&sensors).unwrap_or_default())
                    .allowed("all, usp, usdp2, usd, us, or a list of at least one channel"),
                );
            }
            chosen.push((sensors, inputs));
        }
        if errors.is_empty() {
            Ok(Self {
                asked: asked.clone(),
                structures,
                sensors: chosen,
                windows,
                seeds,
            })
        } else {
            Err(errors)
        }
    }

    /// The request with its lists filled in: the same cells, whatever a grid will be called in later versions.
    #[must_use]
    pub fn request(&self) -> SweepRequest {
        SweepRequest {
            dataset_id: self.asked.dataset_id.clone(),
            grid: self.asked.grid,
            structures: Some(self.structures.clone()),
            sensors: Some(self.sensors.iter().map(|(sensors, _)| sensors.clone()).collect()),
            windows: Some(self.windows.clone()),
            seeds: Some(self.seeds.clone()),
            spec: self.asked.spec.clone(),
        }
    }

    /// Its trainings, in order.
    #[must_use]
    pub fn cells(&self) -> Vec<TrainingSpec> {
        let lengths = [
            self.structures.len(),
            self.sensors.len(),
            self.windows.len(),
            self.seeds.len(),
        ];
        places(lengths).map(|place| self.cell(place)).collect()
    }

    fn cell(&self, [structure, sensors, window, seed]: Place) -> TrainingSpec {
        TrainingSpec {
            structure: self.structures[structure].clone(),
            inputs: self.sensors[sensors].1.clone(),
            window: self.windows[window],
            seed: self.seeds[seed],
            ..self.asked.spec.clone()
        }
    }

    /// Trainings that together have every entry of every list, each with the places of its entries: what has to be
    /// checked, instead of every combination.
    #[must_use]
    pub fn probes(&self) -> Vec<(Place, TrainingSpec)> {
        let mut probes = vec![[0; 4]];
        for (list, length) in [self.structures.len(), self.sensors.len(), self.windows.len()]
            .into_iter()
            .enumerate()
        {
            probes.extend((1..length).map(|k| {
                let mut place = [0; 4];
                place[list] = k;
                place
            }));
        }
        probes
            .into_iter()
            .map(|place| (place, self.cell(place)))
            .collect()
    }

    /// Where in the request a field of the training at `place` comes from: `rest` is a pointer into that training.
    #[must_use]
    pub fn pointer(&self, place: Place, rest: &str) -> String {
        let [structure, sensors, window, _] = place;
        let given = &self.asked;
        if given.structures.is_some() && rest == "/structure" {
            return format!("/structures/{structure}");
        }
        if let Some(list) = &given.sensors
            && let Some(channel) = rest.strip_prefix("/inputs")
        {
            return match list.get(sensors) {
                Some(Sensors::Channels(_)) => format!("/sensors/{sensors}{channel}"),
                _ => format!("/sensors/{sensors}"),
            };
        }
        if given.windows.is_some()
            && let Some(field) = rest.strip_prefix("/window")
            && (field.is_empty() || field.starts_with('/'))
        {
            return format!("/windows/{window}{field}");
        }
        format!("/spec{rest}")
    }
}

/// Refuses a list without entries, or with one that is there twice.
fn check_list<T: Serialize>(pointer: &str, list: &[T], errors: &mut Vec<FieldError>) {
    if list.is_empty() {
        errors.push(
            FieldError::new(pointer, "the list is empty")
                .value(serde_json::json!([]))
                .allowed("at least one entry, or no list at all"),
        );
    }
    let mut seen = BTreeSet::new();
    for (k, entry) in list.iter().enumerate() {
        let value = serde_json::to_value(entry).unwrap_or_default();
        if !seen.insert(value.to_string()) {
            errors.push(
                FieldError::new(format!("{pointer}/{k}"), "it is there twice")
                    .value(value)
                    .allowed("each entry once"),
            );
        }
    }
}

/// Every combination, the last list fastest.
fn places(lengths: [usize; 4]) -> impl Iterator<Item = Place> {
    (0..lengths.iter().product()).map(move |index| {
        let mut rest = index;
        let mut place = [0; 4];
        for list in (0..4).rev() {
            place[list] = rest % lengths[list];
            rest /= lengths[list];
        }
        place
    })
}

/// The table of a sweep, as far as it is.
#[must_use]
pub fn table(sweep: &SweepRecord, state: SweepState, cells: Vec<SweepCellRecord>) -> SweepTable {
    let labels: Vec<String> = sweep.spec.sensors.iter().flatten().map(Sensors::label).collect();
    let lengths = [
        sweep.spec.structures.as_ref().map_or(1, Vec::len),
        labels.len().max(1),
        sweep.spec.windows.as_ref().map_or(1, Vec::len),
        sweep.spec.seeds.as_ref().map_or(1, Vec::len),
    ];
    let rows = places(lengths)
        .zip(cells)
        .map(|(place, cell)| {
            let training = cell.training;
            SweepRow {
                training_id: training.id,
                sensors: labels.get(place[1]).cloned().unwrap_or_default(),
                structure: training.spec.structure,
                window: training.spec.window,
                seed: training.spec.seed,
                state: training.state,
                reason: training.reason,
                model_id: training.model_id,
                result: cell
                    .metrics
                    .and_then(|mut metrics| metrics.get_mut("judged").map(serde_json::Value::take))
                    .and_then(|judged| serde_json::from_value(judged).ok()),
            }
        })
        .collect();
    SweepTable {
        sweep_id: sweep.id,
        dataset_id: sweep.dataset_id.clone(),
        state,
        rows,
    }
}

/// Mean absolute error of the baseline `name` at a target.
fn baseline<'a>(result: &'a CellResult, name: &str, target: usize) -> Option<&'a TargetMetrics> {
    result
        .baselines
        .iter()
        .find(|baseline| baseline.name == name)?
        .targets
        .get(target)
}

/// Names of the baselines that a table has.
fn baselines_of(table: &SweepTable) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for result in table.rows.iter().filter_map(|row| row.result.as_ref()) {
        for baseline in &result.baselines {
            if !names.contains(&baseline.name) {
                names.push(baseline.name.clone());
            }
        }
    }
    names
}

/// One line per network and target, errors in the units of the columns. Nothing in it depends on when or where a
/// network was trained.
#[must_use]
pub fn csv(table: &SweepTable) -> String {
    let baselines = baselines_of(table);
    let mut text = "structure,sensors,window_s,window_steps,seed,state,target,unit,mae,rmse,p95,max,range,\
                    mae_relative_to_range,r2"
        .to_owned();
    for name in &baselines {
        let _ = write!(text, ",{name}_mae");
    }
    text.push_str(",samples,parameters,epochs,judged_on,model_id\n");
    for row in &table.rows {
        let Some(result) = &row.result else {
            let empty = ",".repeat(14 + baselines.len());
            let _ = writeln!(
                text,
                "{},{},,,{},{}{empty}",
                row.structure, row.sensors, row.seed, row.state
            );
            continue;
        };
        for (t, m) in result.targets.iter().enumerate() {
            let _ = write!(
                text,
                "{},{},{},{},{},{},{},{},{:e},{:e},{:e},{:e},{:e},{:e},{}",
                row.structure,
                row.sensors,
                result.window_s,
                result.window_steps,
                row.seed,
                row.state,
                m.target,
                m.unit,
                m.mae,
                m.rmse,
                m.p95,
                m.max,
                m.range,
                m.mae_relative_to_range,
                m.r2
            );
            for name in &baselines {
                match baseline(result, name, t) {
                    Some(of_baseline) => {
                        let _ = write!(text, ",{:e}", of_baseline.mae);
                    }
                    None => text.push(','),
                }
            }
            let model = row.model_id.as_ref().map(ToString::to_string).unwrap_or_default();
            let _ = writeln!(
                text,
                ",{},{},{},{},{model}",
                m.samples, result.parameters, result.epochs, result.judged_on
            );
        }
    }
    text
}

/// Networks that differ in their seeds alone, with their results.
struct Group<'a> {
    structure: &'a str,
    sensors: &'a str,
    results: Vec<&'a CellResult>,
    unfinished: usize,
}

fn groups(table: &SweepTable) -> Vec<Group<'_>> {
    let mut groups: Vec<(WindowRule, Group<'_>)> = Vec::new();
    for row in &table.rows {
        let same = |(window, group): &&mut (WindowRule, Group<'_>)| {
            *window == row.window && group.structure == row.structure && group.sensors == row.sensors
        };
        let group = if let Some((_, group)) = groups.iter_mut().find(same) {
            group
        } else {
            let new = Group {
                structure: &row.structure,
                sensors: &row.sensors,
                results: Vec::new(),
                unfinished: 0,
            };
            groups.push((row.window, new));
            match groups.last_mut() {
                Some((_, group)) => group,
                None => continue,
            }
        };
        match &row.result {
            Some(result) => group.results.push(result),
            None => group.unfinished += 1,
        }
    }
    groups.into_iter().map(|(_, group)| group).collect()
}

impl Group<'_> {
    /// Mean, smallest and largest over the seeds.
    fn spread(&self, value: impl Fn(&CellResult) -> Option<f64>) -> Option<[f64; 3]> {
        let values: Vec<f64> = self.results.iter().filter_map(|result| value(result)).collect();
        if values.is_empty() {
            return None;
        }
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        Some([mean, low, high])
    }

    fn window(&self) -> String {
        self.results.first().map_or_else(
            || "–".to_owned(),
            |result| format!("{} ({} s)", result.window_steps, significant(result.window_s)),
        )
    }
}

/// Targets with the factor and the name of the unit they are shown in.
fn targets_of(table: &SweepTable) -> Vec<(String, f64, String)> {
    let first = table.rows.iter().find_map(|row| row.result.as_ref());
    first
        .iter()
        .flat_map(|result| &result.targets)
        .map(|m| {
            let unit = display_unit(&m.target);
            (
                m.target.clone(),
                unit.map_or(1.0, |u| u.factor),
                unit.map_or_else(|| m.unit.clone(), |u| u.label.to_owned()),
            )
        })
        .collect()
}

/// For people: a table per target, means over the seeds with their range.
#[must_use]
pub fn markdown(table: &SweepTable) -> String {
    let baselines = baselines_of(table);
    let groups = groups(table);
    let done = table.rows.iter().filter(|row| row.result.is_some()).count();
    let mut text = format!(
        "# Sweep on data set {}\n\n{done} of {} networks, {}. Means over the seeds, smallest and largest in brackets",
        table.dataset_id,
        table.rows.len(),
        table.state.as_str(),
    );
    if let Some(result) = table.rows.iter().find_map(|row| row.result.as_ref()) {
        let _ = write!(text, "; judged on {} {} runs", result.runs, result.judged_on);
    }
    text.push_str(".\n");
    for (t, (target, factor, unit)) in targets_of(table).iter().enumerate() {
        let _ = write!(
            text,
            "\n## `{target}` [{unit}]\n\n| structure | sensors | window steps | seeds | MAE | RMSE | p95 | max | MAE / range |"
        );
        for name in &baselines {
            let _ = write!(text, " {} MAE |", baseline_name(name));
        }
        let _ = writeln!(text, "\n|{}", "---|".repeat(9 + baselines.len()));
        for group in &groups {
            let show = |value: &dyn Fn(&CellResult) -> Option<f64>| match group.spread(value) {
                None => "–".to_owned(),
                Some([mean, ..]) if group.results.len() < 2 => significant(mean * factor),
                Some([mean, low, high]) => format!(
                    "{} ({}–{})",
                    significant(mean * factor),
                    significant(low * factor),
                    significant(high * factor)
                ),
            };
            let of = |get: fn(&TargetMetrics) -> f64| {
                show(&move |result: &CellResult| result.targets.get(t).map(get))
            };
            let relative = group
                .spread(|result| result.targets.get(t).map(|m| m.mae_relative_to_range))
                .map_or_else(|| "–".to_owned(), |[mean, ..]| format!("{:.4} %", 100.0 * mean));
            let _ = write!(
                text,
                "| {} | {} | {} | {} | {} | {} | {} | {} | {relative} |",
                group.structure,
                group.sensors,
                group.window(),
                group.results.len(),
                of(|m| m.mae),
                of(|m| m.rmse),
                of(|m| m.p95),
                of(|m| m.max),
            );
            for name in &baselines {
                let error = group
                    .results
                    .first()
                    .and_then(|result| baseline(result, name, t))
                    .map_or_else(|| "–".to_owned(), |m| significant(m.mae * factor));
                let _ = write!(text, " {error} |");
            }
            text.push('\n');
        }
    }
    for row in table.rows.iter().filter(|row| row.result.is_none()) {
        let reason = row.reason.as_deref().unwrap_or("no result yet");
        let _ = write!(
            text,
            "\n- {} {} seed {}: {} ({reason})",
            row.structure, row.sensors, row.seed, row.state
        );
    }
    text
}

/// The mean absolute errors as a picture: a panel per target, sensors and window, a dot per structure.
#[must_use]
pub fn picture(table: &SweepTable) -> ErrorPicture {
    let groups = groups(table);
    let targets = targets_of(table);
    let baselines = baselines_of(table);
    let mut panels: Vec<ErrorPanel> = Vec::new();
    for (t, (target, factor, unit)) in targets.iter().enumerate() {
        for group in groups.iter().filter(|group| !group.results.is_empty()) {
            let name = format!("{target} [{unit}], {}, window {}", group.sensors, group.window());
            let index = panels.iter().position(|panel| panel.name == name);
            let index = index.unwrap_or_else(|| {
                let simple = baselines.iter().filter_map(|name| {
                    let mae = baseline(group.results[0], name, t)?.mae * factor;
                    Some(ErrorRow {
                        name: baseline_name(name).to_owned(),
                        mean: mae,
                        range: (mae, mae),
                        kind: ErrorKind::Baseline,
                    })
                });
                panels.push(ErrorPanel {
                    rows: simple.collect(),
                    name,
                });
                panels.len() - 1
            });
            let Some([mean, low, high]) =
                group.spread(|result| result.targets.get(t).map(|m| m.mae * factor))
            else {
                continue;
            };
            panels[index].rows.push(ErrorRow {
                name: group.structure.to_owned(),
                mean,
                range: (low, high),
                kind: ErrorKind::Network,
            });
        }
    }
    let first = table.rows.iter().find_map(|row| row.result.as_ref());
    ErrorPicture {
        title: "Networks of a sweep".to_owned(),
        subtitle: format!(
            "data set {}; {}",
            table.dataset_id,
            first.map_or_else(
                || "nothing is trained yet".to_owned(),
                |result| format!(
                    "{} {} runs; a dot is the mean over the seeds, its bar their range",
                    result.runs, result.judged_on
                )
            )
        ),
        unit: "as each panel says".to_owned(),
        panels,
    }
}
