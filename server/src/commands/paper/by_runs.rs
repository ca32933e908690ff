//! What more training runs are worth: the same networks on data sets of several sizes.

use super::Cell;
use super::report::{display, groups, label, mean};
use hydroflex_ml::plot::panels::{self, COLORS, Curve, Panel};
use std::fmt::Write as _;

/// Cells that differ in the number of training runs and the seed alone, in the order of the study.
fn series(cells: &[Cell]) -> Vec<(String, Vec<&[Cell]>)> {
    let mut found: Vec<(String, Vec<&[Cell]>)> = Vec::new();
    for group in groups(cells) {
        let name = label(&Cell {
            runs: None,
            ..group[0].clone()
        });
        match found.iter_mut().find(|(known, _)| *known == name) {
            Some((_, sizes)) => sizes.push(group),
            None => found.push((name, vec![group])),
        }
    }
    found
}

/// One table per target: a line per network, a column per number of runs.
pub(super) fn tables(text: &mut String, cells: &[Cell]) {
    let mut runs: Vec<u64> = cells.iter().filter_map(|cell| cell.runs).collect();
    runs.sort_unstable();
    runs.dedup();
    text.push_str("\n## By the number of training runs\n\nMean absolute error on the published cycle / on the random 10 s runs.\n");
    let targets = cells.first().map_or(&[][..], |cell| &cell.cycle.targets);
    for (t, target) in targets.iter().enumerate() {
        let (factor, unit) = display(target);
        // Writing to a String cannot fail.
        let _ = write!(
            text,
            "\n`{}` [{unit}]\n\n| payload | sensors | structure |",
            target.target
        );
        for runs in &runs {
            let _ = write!(text, " {runs} |");
        }
        let _ = writeln!(text, "\n|---|---|---|{}", "---|".repeat(runs.len()));
        for (name, sizes) in series(cells) {
            let _ = write!(text, "| {name} |");
            for wanted in &runs {
                match sizes.iter().find(|group| group[0].runs == Some(*wanted)) {
                    Some(group) => {
                        let _ = write!(
                            text,
                            " {} / {} |",
                            mean(group, |c| factor * c.cycle.targets[t].mae),
                            mean(group, |c| factor * c.random.targets[t].mae)
                        );
                    }
                    None => text.push_str(" |"),
                }
            }
            text.push('\n');
        }
    }
}

/// Errors of the first target over the number of runs, two panels per payload: on the published cycle, and on the
/// random runs.
pub(super) fn picture(cells: &[Cell]) -> String {
    let title = "Errors by the number of training runs";
    let Some(target) = cells.first().and_then(|cell| cell.cycle.targets.first()) else {
        return panels::picture(title, "", &[], &[]);
    };
    let (factor, unit) = display(target);
    // `100 kg | U s | best`: payload, and network.
    let series: Vec<(String, String, Vec<&[Cell]>)> = series(cells)
        .into_iter()
        .map(|(name, sizes)| {
            let (payload, network) = name.split_once(" | ").unwrap_or((name.as_str(), ""));
            (payload.to_owned(), network.replace(" |", ","), sizes)
        })
        .collect();
    let networks = distinct(series.iter().map(|(_, network, _)| network));
    let color = |network: &String| {
        let position = networks.iter().position(|known| *known == network).unwrap_or(0);
        COLORS[position % COLORS.len()]
    };
    let panel = |payload: &String, signals: &str, error: fn(&Cell) -> f64| Panel {
        title: format!("{payload}, {signals}"),
        x: "Training runs of 1 s".to_owned(),
        y: format!("MAE [{unit}]"),
        log: true,
        curves: series
            .iter()
            .filter(|(of, _, _)| of == payload)
            .map(|(_, network, sizes)| Curve {
                color: color(network),
                points: sizes
                    .iter()
                    .filter_map(|group| {
                        let sum: f64 = group.iter().map(error).sum();
                        Some((group[0].runs? as f64, factor * sum / group.len() as f64))
                    })
                    .collect(),
            })
            .collect(),
    };
    let both: Vec<Panel> = distinct(series.iter().map(|(payload, _, _)| payload))
        .iter()
        .flat_map(|payload| {
            [
                panel(payload, "published 10 s cycle", |c| c.cycle.targets[0].mae),
                panel(payload, "random 10 s runs", |c| c.random.targets[0].mae),
            ]
        })
        .collect();
    let legend: Vec<(&str, String)> = networks.iter().map(|&name| (color(name), name.clone())).collect();
    let subtitle = format!(
        "{}: mean over the seeds, signals never seen in training",
        target.target
    );
    panels::picture(title, &subtitle, &legend, &both)
}

fn distinct<'a>(names: impl Iterator<Item = &'a String>) -> Vec<&'a String> {
    let mut found = Vec::new();
    for name in names {
        if !found.contains(&name) {
            found.push(name);
        }
    }
    found
}
