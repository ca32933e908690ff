//! `report.md`: tables in physical units, means over the seeds.

use super::{Args, Cell, NoiseChoice, Payload, Recipe};
use hydroflex_ml::evaluate::faults::{EFFECT, STRETCH_S};
use hydroflex_ml::evaluate::table::{PUBLISHED, display_unit, significant};
use hydroflex_ml::plot::errors::{ErrorKind, ErrorPanel, ErrorPicture, ErrorRow};
use hydroflex_openapi::model::{EvaluationReport, TargetMetrics};
use std::fmt::Write as _;

/// The whole report.
pub(super) fn markdown(args: &Args, machine: &str, cells: &[Cell]) -> String {
    let mut text = format!(
        "# The published study, repeated\n\n\
         Machine `{machine}`, integrator `{:?}` at 5 ms, {} training runs of 1 s per payload, all overlapping \
         windows unless trained as published, {} seed{} per cell (means are shown, the range of the seeds in brackets). None of \
         the evaluation signals was seen: the published 10 s cycle, and the first {} random 10 s runs that stay \
         within stroke and pressures.\n",
        args.integrator,
        several(&args.runs),
        args.seeds,
        if args.seeds == 1 { "" } else { "s" },
        args.signals,
    );
    let targets = cells.first().map_or(&[][..], |cell| &cell.cycle.targets);
    for (t, target) in targets.iter().enumerate() {
        let unit = display_unit(&target.target).map_or(target.unit.as_str(), |u| u.label);
        // Writing to a String cannot fail.
        let _ = write!(
            text,
            "\n## `{}` [{unit}]\n\n\
             | payload | sensors | structure | cycle MAE | RMSE | p95 | max | random MAE | RMSE | p95 | max | MAE / range | s |\n\
             |---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
            target.target
        );
        for group in groups(cells) {
            text.push_str(&row(group, t));
        }
        for group in groups(cells) {
            if first_with_baselines(cells, group) {
                text.push_str(&baselines(&group[0], t));
            }
        }
    }
    if args.runs.len() > 1 {
        super::by_runs::tables(&mut text, cells);
    }
    intervals(&mut text, cells);
    envelope(&mut text, cells);
    text.push_str("\n## Published, for comparison\n\nMAE of the vertical deflection over the published cycle, recovered from the plotted curves of Khadim et al. (arXiv 2503.07528), in mm:\n\n");
    for published in PUBLISHED {
        let _ = writeln!(
            text,
            "- {:.0} kg: {}",
            published.payload_kg,
            significant(published.deflection_mae_mm)
        );
    }
    text
}

/// `80, 160 or 320`.
fn several(numbers: &[u64]) -> String {
    let names: Vec<String> = numbers.iter().map(u64::to_string).collect();
    match names.split_last() {
        Some((last, first)) if !first.is_empty() => format!("{} or {last}", first.join(", ")),
        _ => names.concat(),
    }
}

fn percent(value: f64) -> String {
    format!("{:.1} %", 100.0 * value)
}

/// `97.5 %`, or `97.5–99.0 %` where they differ.
fn percents(values: impl Iterator<Item = f64>) -> String {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    });
    if low > high {
        return String::new();
    }
    let (first, last) = (percent(low), percent(high));
    if first == last {
        first
    } else {
        format!("{:.1}–{last}", 100.0 * low)
    }
}

/// Coverage of the intervals on the cycle and on all random runs without a flag, by thirds of amplitude.
fn intervals(text: &mut String, cells: &[Cell]) {
    text.push_str(
        "\n## 90 % intervals\n\nCalibrated on other random 10 s runs and on the validation runs. Coverage of the cycle and of \
         all random 10 s runs without a flag, lowest and highest of the targets and seeds; of the random runs also by thirds of \
         the reference's distance from the mean. Width: first target.\n\n\
         | payload | sensors | structure | runs | cycle | random | smallest third | middle | largest | mean width |\n\
         |---|---|---|---|---|---|---|---|---|---|\n",
    );
    for group in groups(cells) {
        let head = &group[0];
        let Some(first) = head.calm.targets.first().filter(|t| t.coverage.is_some()) else {
            continue;
        };
        let (factor, unit) = display(first);
        let span = |get: &dyn Fn(&Cell, usize) -> Option<f64>| {
            let values = group
                .iter()
                .flat_map(|c| (0..c.calm.targets.len()).filter_map(move |t| get(c, t)));
            percents(values)
        };
        let third = |i: usize| {
            span(&move |c: &Cell, t: usize| c.calm.targets[t].coverage_thirds.map(|thirds| thirds[i]))
        };
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} | {} | {} | {} | {} {unit} |",
            label(head),
            head.calm.runs,
            span(&|c, t| c.cycle.targets[t].coverage),
            span(&|c, t| c.calm.targets[t].coverage),
            third(0),
            third(1),
            third(2),
            average(group, |c| factor
                * c.calm.targets[0].interval_width.unwrap_or(0.0)),
        );
    }
}

/// What the envelope flags: honest runs, faults, other payloads; and how large errors get where it should.
fn envelope(text: &mut String, cells: &[Cell]) {
    let _ = write!(
        text,
        "\n## Envelope\n\nPart of the windows that are flagged, lowest and highest of the seeds. A stuck sensor counts where the \
         truth is, on average over the window, at least {:.0} % of the training range away from the stuck value: before, nobody \
         can know. The worst sensor and the worst pair are named; in brackets the cases (a sensor stuck for {} s, a run with two \
         channels swapped) of which at least one such window is flagged. False alarms are flagged windows of honest runs, the \
         cycle and all random 10 s runs without a flag, that stay within the cylinder lengths of the training runs. Windows that \
         leave these lengths rightly are called unknown; beside, the part of all windows that do, and the part of those that is flagged.\n\n\
         | payload | sensors | structure | false alarms: cycle | random | windows beyond the lengths | flagged there | worst stuck sensor | worst swapped pair | other payloads |\n\
         |---|---|---|---|---|---|---|---|---|---|\n",
        100.0 * EFFECT,
        STRETCH_S,
    );
    for group in groups(cells) {
        let head = &group[0];
        if head.faults.is_empty() {
            continue;
        }
        let alarms = |report: fn(&Cell) -> &EvaluationReport| {
            percents(group.iter().filter_map(|c| {
                let report = report(c);
                match report.flagged_by_length {
                    Some(by_length) => by_length.flagged_within,
                    None => report.inside_envelope.map(|inside| 1.0 - inside),
                }
            }))
        };
        let by_length = || group.iter().filter_map(|c| c.calm.flagged_by_length);
        let worst = |kind: &str| {
            let kinds = || (0..head.faults.len()).filter(|&f| head.faults[f].fault.ends_with(kind));
            let rates = |f: usize| group.iter().filter_map(move |c| c.faults.get(f));
            let lowest = |f: usize| rates(f).map(|r| r.flagged).fold(f64::INFINITY, f64::min);
            kinds()
                .min_by(|&a, &b| lowest(a).total_cmp(&lowest(b)))
                .map_or_else(String::new, |f| {
                    format!(
                        "{}: {} ({})",
                        head.faults[f].fault.trim_end_matches(kind).trim_end(),
                        percents(rates(f).map(|r| r.flagged)),
                        percents(rates(f).map(|r| r.found))
                    )
                })
        };
        let all = || group.iter().flat_map(|cell| &cell.other_payloads);
        let others: Vec<String> = head
            .other_payloads
            .iter()
            .map(|&(kg, _)| {
                let flagged = all()
                    .filter(|other| other.0.to_bits() == kg.to_bits())
                    .map(|other| other.1);
                format!("{kg} kg: {}", percents(flagged))
            })
            .collect();
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} | {} | {} | {} | {} |",
            label(head),
            alarms(|c| &c.cycle),
            alarms(|c| &c.calm),
            percents(by_length().map(|l| l.beyond)),
            percents(by_length().filter_map(|l| l.flagged_beyond)),
            worst("stuck"),
            worst("swapped"),
            others.join("; ")
        );
    }
    text.push_str(
        "\n## Beyond the training region\n\nRandom 10 s runs that hit an end stop, cavitate or leave the supply's pressures: \
         first target, means of the seeds.\n\n| payload | sensors | structure | MAE | p95 | max | least squares MAE | p95 | max | flagged windows |\n\
         |---|---|---|---|---|---|---|---|---|---|\n",
    );
    for group in groups(cells) {
        let head = &group[0];
        let flagged: Vec<&EvaluationReport> = group.iter().filter_map(|c| c.flagged.as_ref()).collect();
        let Some(first) = flagged.first() else { continue };
        let (factor, unit) = display(&first.targets[0]);
        let _ = write!(text, "| {} |", label(head));
        let of_network = |report: &EvaluationReport| report.targets[0].clone();
        let of_linear = |report: &EvaluationReport| report.baselines[0].targets[0].clone();
        for metrics in [of_network, of_linear] {
            let all: Vec<TargetMetrics> = flagged.iter().map(|report| metrics(report)).collect();
            let sum = all.iter().fold([0.0; 3], |[mae, p95, max], m| {
                [mae + m.mae, p95 + m.p95, max + m.max]
            });
            for value in sum {
                let mean = value / all.len() as f64;
                let _ = write!(text, " {} {unit} |", significant(factor * mean));
            }
        }
        let outside = flagged.iter().filter_map(|report| report.inside_envelope);
        let _ = writeln!(text, " {} |", percents(outside.map(|inside| 1.0 - inside)));
    }
}

/// `100 kg | U s | best, crane noise`; a network that is not told the payload says so.
pub(super) fn label(cell: &Cell) -> String {
    let trained = match cell.trained {
        Payload::Fixed(_) => String::new(),
        Payload::Range { min, max } => format!(", payload unknown in {min}–{max} kg"),
    };
    let recipe = match cell.recipe {
        Recipe::Ours => "",
        Recipe::Published => ", trained as published",
    };
    let noise = match cell.noise {
        NoiseChoice::None => "",
        NoiseChoice::Crane => ", crane noise",
    };
    let runs = cell
        .runs
        .map_or_else(String::new, |runs| format!(", {runs} runs"));
    format!(
        "{} kg | {} | {}{recipe}{trained}{noise}{runs}",
        cell.payload_kg,
        cell.sensors.label(),
        cell.structure
    )
}

/// Errors of the first target on the published cycle, one panel per payload and sensors.
pub(super) fn picture(cells: &[Cell]) -> ErrorPicture {
    let unit = cells
        .first()
        .and_then(|cell| cell.cycle.targets.first())
        .map_or("", |target| display(target).1);
    let mut panels: Vec<ErrorPanel> = Vec::new();
    for group in groups(cells).filter(|group| matches!(group[0].trained, Payload::Fixed(_))) {
        let head = &group[0];
        let Some(target) = head.cycle.targets.first() else {
            continue;
        };
        let factor = display(target).0;
        let noise = if head.noise == NoiseChoice::Crane {
            ", crane noise"
        } else {
            ""
        };
        let runs = head
            .runs
            .map_or_else(String::new, |runs| format!(", {runs} runs"));
        let name = format!("{} kg, {}{noise}{runs}", head.payload_kg, head.sensors.label());
        if panels.iter().all(|panel| panel.name != name) {
            let mut rows = Vec::new();
            for baseline in &head.cycle.baselines {
                let mean = factor * baseline.targets[0].mae;
                rows.push(ErrorRow {
                    name: baseline.name.replace('_', " "),
                    mean,
                    range: (mean, mean),
                    kind: ErrorKind::Baseline,
                });
            }
            let published = PUBLISHED.iter().find(|p| {
                p.payload_kg.to_bits() == head.payload_kg.to_bits()
                    && target.target.starts_with("deflection_")
            });
            rows.extend(published.map(|p| ErrorRow {
                name: "published".to_owned(),
                mean: p.deflection_mae_mm,
                range: (p.deflection_mae_mm, p.deflection_mae_mm),
                kind: ErrorKind::Published,
            }));
            panels.push(ErrorPanel {
                name: name.clone(),
                rows,
            });
        }
        let values = || group.iter().map(|c| factor * c.cycle.targets[0].mae);
        let recipe = if head.recipe == Recipe::Published {
            ", trained as published"
        } else {
            ""
        };
        if let Some(panel) = panels.iter_mut().find(|panel| panel.name == name) {
            panel.rows.push(ErrorRow {
                name: format!("{}{recipe}", head.structure),
                mean: values().sum::<f64>() / group.len() as f64,
                range: (
                    values().fold(f64::INFINITY, f64::min),
                    values().fold(f64::NEG_INFINITY, f64::max),
                ),
                kind: ErrorKind::Network,
            });
        }
    }
    for panel in &mut panels {
        panel.rows.sort_by(|a, b| b.mean.total_cmp(&a.mean));
    }
    ErrorPicture {
        title: "Errors on the published 10 s cycle".to_owned(),
        subtitle: cells
            .first()
            .and_then(|cell| cell.cycle.targets.first())
            .map_or_else(String::new, |target| {
                format!(
                    "{}, never seen in training; bars: lowest to highest of the seeds",
                    target.target
                )
            }),
        unit: unit.to_owned(),
        panels,
    }
}

/// One line for the terminal.
pub(super) fn line(cell: &Cell) -> String {
    let mut text = format!(
        "{}, seed {} ({:.0} s):",
        label(cell).replace(" |", ","),
        cell.seed,
        cell.train_seconds
    );
    for (cycle, random) in cell.cycle.targets.iter().zip(&cell.random.targets) {
        let (factor, unit) = display(cycle);
        let _ = write!(
            text,
            " {} {} / {} {unit}",
            cycle.target,
            significant(cycle.mae * factor),
            significant(random.mae * factor)
        );
    }
    text
}

pub(super) fn display(metrics: &TargetMetrics) -> (f64, &str) {
    display_unit(&metrics.target).map_or((1.0, metrics.unit.as_str()), |u| (u.factor, u.label))
}

fn same(a: &Cell, b: &Cell) -> bool {
    same_data(a, b) && a.structure == b.structure && a.recipe == b.recipe
}

/// Same runs, sensors and noise: the baselines are the same.
fn same_data(a: &Cell, b: &Cell) -> bool {
    a.payload_kg.to_bits() == b.payload_kg.to_bits()
        && a.trained == b.trained
        && a.runs == b.runs
        && a.sensors == b.sensors
        && a.noise == b.noise
}

/// Cells that differ in the seed alone; they stand side by side.
pub(super) fn groups(cells: &[Cell]) -> impl Iterator<Item = &[Cell]> {
    cells.chunk_by(same)
}

fn first_with_baselines(cells: &[Cell], group: &[Cell]) -> bool {
    let head = &group[0];
    cells
        .iter()
        .find(|c| same_data(c, head) && !c.cycle.baselines.is_empty())
        .is_some_and(|first| same(first, head))
}

/// Mean over the seeds.
fn average(group: &[Cell], value: impl Fn(&Cell) -> f64) -> String {
    significant(group.iter().map(value).sum::<f64>() / group.len() as f64)
}

/// Mean over the seeds; with the range of the seeds where there are several.
pub(super) fn mean(group: &[Cell], value: impl Fn(&Cell) -> f64) -> String {
    let values: Vec<f64> = group.iter().map(value).collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if group.len() > 1 {
        format!(
            "{} ({}–{})",
            significant(mean),
            significant(low),
            significant(high)
        )
    } else {
        significant(mean)
    }
}

fn row(group: &[Cell], t: usize) -> String {
    let head = &group[0];
    let (factor, _) = display(&head.cycle.targets[t]);
    let mut text = format!("| {} |", label(head));
    let reports: [fn(&Cell) -> &EvaluationReport; 2] = [|c| &c.cycle, |c| &c.random];
    for report in reports {
        let metric = |get: fn(&TargetMetrics) -> f64| average(group, |c| factor * get(&report(c).targets[t]));
        let _ = write!(
            text,
            " {} | {} | {} | {} |",
            mean(group, |c| factor * report(c).targets[t].mae),
            metric(|m| m.rmse),
            metric(|m| m.p95),
            metric(|m| m.max)
        );
    }
    let relative = group
        .iter()
        .map(|c| {
            let (a, b) = (&c.cycle.targets[t], &c.random.targets[t]);
            a.mae_relative_to_range.max(b.mae_relative_to_range)
        })
        .sum::<f64>()
        / group.len() as f64;
    let seconds = group.iter().map(|c| c.train_seconds).sum::<f64>() / group.len() as f64;
    let _ = writeln!(text, " {relative:.1e} | {seconds:.0} |");
    text
}

/// Simple estimators on the same sensors: they have no seed.
fn baselines(cell: &Cell, t: usize) -> String {
    let mut text = String::new();
    for (cycle, random) in cell.cycle.baselines.iter().zip(&cell.random.baselines) {
        let _ = write!(
            text,
            "| {} |",
            label(cell).replacen(&cell.structure, &format!("*{}*", cycle.name.replace('_', " ")), 1)
        );
        for baseline in [cycle, random] {
            let m = &baseline.targets[t];
            let (factor, _) = display(m);
            for value in [m.mae, m.rmse, m.p95, m.max] {
                let _ = write!(text, " {} |", significant(factor * value));
            }
        }
        let worst = cycle.targets[t]
            .mae_relative_to_range
            .max(random.targets[t].mae_relative_to_range);
        let _ = writeln!(text, " {worst:.1e} | |");
    }
    text
}
