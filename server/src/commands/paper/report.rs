//! `report.md`: tables in physical units, means over the seeds.

use super::{Args, Cell, RANDOM_EVALUATED};
use hydroflex_ml::evaluate::table::{PUBLISHED, display_unit, significant};
use hydroflex_openapi::model::{EvaluationReport, TargetMetrics};
use std::fmt::Write as _;

/// The whole report.
pub(super) fn markdown(args: &Args, machine: &str, cells: &[Cell]) -> String {
    let mut text = format!(
        "# The published study, repeated\n\n\
         Machine `{machine}`, integrator `{:?}` at 5 ms, {} training runs of 1 s per payload, all overlapping \
         windows, {} seed{} per cell (means are shown, the range of the seeds in brackets). None of the evaluation \
         signals was seen: the published 10 s cycle, and the first {RANDOM_EVALUATED} random 10 s runs that stay within \
         stroke and pressures.\n",
        args.integrator,
        args.runs,
        args.seeds,
        if args.seeds == 1 { "" } else { "s" },
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
            if first_of_its_sensors(cells, group) {
                text.push_str(&baselines(&group[0], t));
            }
        }
    }
    text.push_str("\n## Intervals and envelope\n\n| payload | sensors | structure | target | 90 % interval covers: cycle | random | inside the envelope: cycle | random |\n|---|---|---|---|---|---|---|---|\n");
    for group in groups(cells) {
        let cell = &group[0];
        for (t, target) in cell.cycle.targets.iter().enumerate() {
            let part = |value: Option<f64>| value.map_or_else(String::new, |v| format!("{:.1} %", 100.0 * v));
            let _ = writeln!(
                text,
                "| {} kg | {} | {} | `{}` | {} | {} | {} | {} |",
                cell.payload_kg,
                cell.sensors.label(),
                cell.structure,
                target.target,
                part(target.coverage),
                part(cell.random.targets[t].coverage),
                part(cell.cycle.inside_envelope),
                part(cell.random.inside_envelope),
            );
        }
    }
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

/// One line for the terminal.
pub(super) fn line(cell: &Cell) -> String {
    let mut text = format!(
        "{} kg, {}, {}, seed {} ({:.0} s):",
        cell.payload_kg,
        cell.sensors.label(),
        cell.structure,
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

fn display(metrics: &TargetMetrics) -> (f64, &str) {
    display_unit(&metrics.target).map_or((1.0, metrics.unit.as_str()), |u| (u.factor, u.label))
}

fn same(a: &Cell, b: &Cell) -> bool {
    a.payload_kg.to_bits() == b.payload_kg.to_bits() && a.sensors == b.sensors && a.structure == b.structure
}

/// Cells that differ in the seed alone; they stand side by side.
fn groups(cells: &[Cell]) -> impl Iterator<Item = &[Cell]> {
    cells.chunk_by(same)
}

fn first_of_its_sensors(cells: &[Cell], group: &[Cell]) -> bool {
    let head = &group[0];
    cells
        .iter()
        .find(|c| c.payload_kg.to_bits() == head.payload_kg.to_bits() && c.sensors == head.sensors)
        .is_some_and(|first| first.structure == head.structure)
}

/// Mean over the seeds; with the range of the seeds where there are several.
fn mean(group: &[Cell], value: impl Fn(&Cell) -> f64) -> String {
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
    let mut text = format!(
        "| {} kg | {} | {} |",
        head.payload_kg,
        head.sensors.label(),
        head.structure
    );
    let reports: [fn(&Cell) -> &EvaluationReport; 2] = [|c| &c.cycle, |c| &c.random];
    for report in reports {
        let metric = |get: fn(&TargetMetrics) -> f64| mean(group, |c| factor * get(&report(c).targets[t]));
        let _ = write!(
            text,
            " {} | {} | {} | {} |",
            metric(|m| m.mae),
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
            "| {} kg | {} | *{}* |",
            cell.payload_kg,
            cell.sensors.label(),
            cycle.name.replace('_', " ")
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
