//! Where a model's errors stand, and how it learned: four panels on logarithmic axes.

use super::panels::{Curve, Panel, picture};
use super::{BASELINE, ESTIMATE, REFERENCE, readable};
use crate::evaluate::Evaluation;
use crate::evaluate::profile::{ProfilePoint, profile};
use crate::evaluate::table::display_unit;
use crate::model::Model;
use hydroflex_openapi::model::{EpochRecord, ModelConfig};

/// The picture of one target of an evaluation, with the learning curve of the model.
#[must_use]
pub fn of_target(model: &Model, evaluation: &Evaluation, target: usize, title: &str) -> String {
    let config = model.config();
    let channel = &config.targets[target];
    let unit = display_unit(&channel.name);
    let (factor, unit) = unit.map_or((1.0, channel.unit.as_str()), |u| (u.factor, u.label));
    let found = profile(evaluation, target, config.sample_time_s);
    let both = |points: &[ProfilePoint], across: f64| {
        let curve = |color, value: fn(&ProfilePoint) -> f64| Curve {
            color,
            points: points
                .iter()
                .map(|p| (p.at * across, value(p) * factor))
                .collect(),
        };
        vec![
            curve(BASELINE, |p| p.least_squares),
            curve(ESTIMATE, |p| p.network),
        ]
    };
    let mut over_frequency = both(&found.over_frequency, 1.0);
    over_frequency.insert(
        0,
        Curve {
            color: REFERENCE,
            points: found
                .reference_over_frequency
                .iter()
                .map(|p| (p.at, p.network * factor))
                .collect(),
        },
    );
    let panels = [
        Panel {
            title: "Mean absolute error over time".to_owned(),
            x: "Time since the start of the run [s]".to_owned(),
            y: unit.to_owned(),
            log: false,
            curves: both(&found.over_time, 1.0),
        },
        Panel {
            title: "Mean absolute error over amplitude (tenths of the samples)".to_owned(),
            x: format!("Distance of the reference from its mean [{unit}]"),
            y: unit.to_owned(),
            log: false,
            curves: both(&found.over_amplitude, factor),
        },
        Panel {
            title: "Root mean square by third octaves; grey: the reference itself".to_owned(),
            x: "Frequency [Hz]".to_owned(),
            y: unit.to_owned(),
            log: true,
            curves: over_frequency,
        },
        learning_panel(&config.provenance.history),
    ];
    let subtitle = format!(
        "{}, {} runs that were not trained on; {} network on {} samples of {} sensors",
        readable(&channel.name),
        evaluation.runs.len(),
        config.structure,
        config.window_steps,
        config.inputs.len()
    );
    let legend = [
        (ESTIMATE, "network".to_owned()),
        (BASELINE, "least squares on the same window".to_owned()),
    ];
    picture(title, &subtitle, &legend, &panels)
}

/// The picture of how a model learned.
#[must_use]
pub fn of_learning(config: &ModelConfig) -> String {
    let provenance = &config.provenance;
    let title = "Learning curve";
    let subtitle = format!(
        "{} network on {} samples of {} sensors, {} windows in an epoch; weights of epoch {}",
        config.structure,
        config.window_steps,
        config.inputs.len(),
        provenance.train_windows,
        provenance.best_epoch
    );
    picture(title, &subtitle, &[], &[learning_panel(&provenance.history)])
}

fn learning_panel(history: &[EpochRecord]) -> Panel {
    let curve = |color, value: fn(&EpochRecord) -> f64| Curve {
        color,
        points: history.iter().map(|h| (h.epoch as f64, value(h))).collect(),
    };
    Panel {
        title: "Learning curve: loss in training (grey) and validation".to_owned(),
        x: "Epoch".to_owned(),
        y: "loss".to_owned(),
        log: false,
        curves: vec![
            curve(REFERENCE, |h| h.train_loss),
            curve(ESTIMATE, |h| h.validation_loss),
        ],
    }
}
