//! The model card: what a person should know before using a model.

use crate::evaluate::table::{display_unit, significant};
use hydroflex_openapi::model::{ModelConfig, TargetMetrics};
use std::fmt::Write;

/// A picture beside the card.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Name of its file.
    pub file: &'static str,
    /// What it shows.
    pub caption: &'static str,
    /// The picture.
    pub svg: String,
}

/// `README.md` of a model folder with these pictures.
#[must_use]
pub fn card(config: &ModelConfig, pictures: &[Picture]) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = write_card(&mut text, config, pictures);
    text
}

fn write_card(text: &mut String, config: &ModelConfig, pictures: &[Picture]) -> std::fmt::Result {
    let provenance = &config.provenance;
    writeln!(
        text,
        "---\nlibrary_name: hydroflex\ntags: [slide, hydraulics, flexible-multibody, virtual-sensor]\n---\n"
    )?;
    writeln!(text, "# SLIDE network `{}`\n", config.structure)?;
    writeln!(
        text,
        "Estimates {} from a window of {} samples ({} s at {} s per sample) of {} signals. The estimate belongs \
         to the last sample of the window; the first {} samples of a recording have none.\n",
        list(config.targets.iter().map(|c| c.name.as_str())),
        config.window_steps,
        significant(config.window_s),
        config.sample_time_s,
        config.inputs.len(),
        config.window_steps - 1,
    )?;
    writeln!(
        text,
        "## Signals\n\n| | column | unit | offset | scale |\n|---|---|---|---|---|"
    )?;
    for (role, channels) in [("in", &config.inputs), ("out", &config.targets)] {
        for c in channels {
            writeln!(
                text,
                "| {role} | `{}` | {} | {:.6e} | {:.6e} |",
                c.name, c.unit, c.offset, c.scale
            )?;
        }
    }
    writeln!(
        text,
        "\n`scaled = (value − offset) / scale`. A window is row-major: all signals of the oldest sample first.\n"
    )?;
    writeln!(text, "## Errors on the validation runs\n")?;
    writeln!(
        text,
        "| target | estimator | MAE | RMSE | p95 | max | MAE / range | R² |\n|---|---|---|---|---|---|---|---|"
    )?;
    for (network, linear) in config.validation.iter().zip(&config.validation_least_squares) {
        metrics_line(text, "network", network)?;
        metrics_line(text, "least squares", linear)?;
    }
    writeln!(
        text,
        "\nThese runs chose the weights' epoch and the intervals; judge the model on runs that it has never seen \
         (`hydroflex evaluate`).\n"
    )?;
    for picture in pictures {
        writeln!(text, "![{}]({})\n", picture.caption, picture.file)?;
    }
    writeln!(text, "## Origin\n")?;
    writeln!(text, "- data set `{}`", provenance.dataset_sha256)?;
    writeln!(
        text,
        "- {} training and {} validation runs, {} windows per epoch, {} epochs, weights of epoch {}",
        provenance.train_runs,
        provenance.validation_runs,
        provenance.train_windows,
        provenance.epochs,
        provenance.best_epoch
    )?;
    writeln!(
        text,
        "- Adam from {:.1e}, batch {}, seed {}",
        provenance.learning_rate, provenance.batch, provenance.spec.seed
    )?;
    writeln!(
        text,
        "- hydroflex {}, burn {}\n",
        provenance.hydroflex_version, provenance.burn_version
    )?;
    if let Some(payload) = &config.payload {
        let empty = payload.empty.as_ref().map_or_else(String::new, |empty| {
            format!(
                "; below {:.1} kg the machine counts as empty and has coefficients of its own",
                empty.below_kg
            )
        });
        writeln!(
            text,
            "The payload differed between the training runs. The model is not told it: it estimates it from the window, \
             {} times, each time better, and its coefficients follow the last estimate{empty}.\n",
            payload.estimates.len()
        )?;
    }
    writeln!(text, "## Limits\n")?;
    let noise = if provenance.spec.noise.is_some() {
        "with the sensor noise named in `config.json`"
    } else {
        "without noise"
    };
    writeln!(
        text,
        "Trained on simulated signals {noise}, of one machine and the payloads of its data set. Inputs outside \
         the envelope in `config.json` are flagged, not refused, and estimates are held near a tame linear map. Intervals are \
         meant to hold the true value 9 times out of 10; they and the envelope were calibrated on {} windows of runs of up to \
         {:.1} s that were not trained on, without end stops or cavitation.",
        provenance.calibration_windows, provenance.calibration_s
    )
}

fn metrics_line(text: &mut String, estimator: &str, m: &TargetMetrics) -> std::fmt::Result {
    let (factor, unit) = display_unit(&m.target).map_or((1.0, m.unit.as_str()), |u| (u.factor, u.label));
    writeln!(
        text,
        "| `{}` [{unit}] | {estimator} | {} | {} | {} | {} | {:.4} % | {:.6} |",
        m.target,
        significant(m.mae * factor),
        significant(m.rmse * factor),
        significant(m.p95 * factor),
        significant(m.max * factor),
        100.0 * m.mae_relative_to_range,
        m.r2
    )
}

fn list<'a>(names: impl Iterator<Item = &'a str>) -> String {
    names.map(|n| format!("`{n}`")).collect::<Vec<_>>().join(", ")
}
