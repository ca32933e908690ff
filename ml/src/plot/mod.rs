//! The picture of an evaluation: reference and estimate over time, and below each its error.
//!
//! SVG written directly: a few hundred elements, no fonts to ship, sharp at any size.

pub mod axis;
pub mod distribution;
pub mod errors;
pub mod panels;
pub mod profile;

use crate::evaluate::table::{display_unit, significant};
use crate::evaluate::{EvaluateError, Evaluation};
use crate::model::Model;
use crate::runs::Runs;
use axis::{Axis, label, padded_range, simplify};
use std::fmt::Write;

/// What a picture shows.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Title.
    pub title: String,
    /// Line below the title.
    pub subtitle: String,
    /// Time of every sample, s.
    pub time_s: Vec<f64>,
    /// First sample with an estimate.
    pub first_row: usize,
    /// Commanded signals with their names, drawn as a strip on top.
    pub commands: Vec<(String, Vec<f64>)>,
    /// One per target.
    pub rows: Vec<PictureRow>,
}

/// One target of a [`Picture`], values in the unit shown.
#[derive(Debug, Clone, PartialEq)]
pub struct PictureRow {
    /// Name for people.
    pub name: String,
    /// Unit.
    pub unit: String,
    /// Every sample.
    pub reference: Vec<f64>,
    /// From `first_row` on.
    pub estimate: Vec<f64>,
    /// From `first_row` on: half width of the 90 % interval.
    pub half_width: Option<Vec<f64>>,
    /// From `first_row` on: least squares on the same window.
    pub least_squares: Vec<f64>,
}

const WIDTH: f64 = 1120.0;
const LEFT: f64 = 92.0;
const RIGHT: f64 = 24.0;
const HEADER: f64 = 96.0;
const COMMAND_HEIGHT: f64 = 46.0;
const SIGNAL_HEIGHT: f64 = 142.0;
const ERROR_HEIGHT: f64 = 78.0;
const INNER_GAP: f64 = 27.0;
const ROW_GAP: f64 = 24.0;
const FOOTER: f64 = 52.0;

// Okabe and Ito's colours, told apart by people with any colour vision.
const REFERENCE: &str = "#9fb3c8";
const ESTIMATE: &str = "#0b4f8a";
const BASELINE: &str = "#d98e04";
const COMMAND: &str = "#4b5563";
const INK: &str = "#1f2933";
const QUIET: &str = "#616e7c";
const GRID: &str = "#e4e7eb";

/// Picture of one run of an evaluation.
///
/// # Errors
/// The run or a channel is not there.
pub fn of_run(
    model: &Model,
    runs: &Runs,
    evaluation: &Evaluation,
    run: usize,
    title: &str,
) -> Result<Picture, EvaluateError> {
    let config = model.config();
    let evaluated = &evaluation.runs[run.min(evaluation.runs.len() - 1)];
    let names = |channels: &[hydroflex_openapi::model::ScaledChannel]| -> Vec<String> {
        channels.iter().map(|c| c.name.clone()).collect()
    };
    let targets = runs.select(&names(&config.targets))?;
    let inputs = runs.select(&names(&config.inputs))?;
    let position = runs
        .runs
        .iter()
        .position(|r| r.run_id == evaluated.run_id)
        .unwrap_or(0);
    let samples = &targets.runs[position];
    let first_row = config.window_steps - 1;
    let predictor = model.predictor();
    let rows = config
        .targets
        .iter()
        .enumerate()
        .map(|(t, channel)| {
            let unit = display_unit(&channel.name);
            let factor = unit.map_or(1.0, |u| u.factor);
            let scaled = |values: &[f64]| -> Vec<f64> { values.iter().map(|v| v * factor).collect() };
            let half_width = evaluated.estimate[t]
                .iter()
                .enumerate()
                .map(|(k, &e)| {
                    let payload_kg = evaluated.payload_kg.get(k).copied();
                    predictor.half_width(t, e, payload_kg).map(|h| h * factor)
                })
                .collect();
            PictureRow {
                name: readable(&channel.name),
                unit: unit.map_or(channel.unit.as_str(), |u| u.label).to_owned(),
                reference: scaled(&samples.columns[t]),
                estimate: scaled(&evaluated.estimate[t]),
                half_width,
                least_squares: scaled(&evaluated.least_squares[t]),
            }
        })
        .collect();
    let commands = inputs
        .channels
        .iter()
        .zip(&inputs.runs[position].columns)
        .filter(|(channel, _)| channel.name.starts_with("valve_"))
        .map(|(channel, column)| (readable(&channel.name), column.clone()))
        .collect();
    Ok(Picture {
        title: title.to_owned(),
        subtitle: format!(
            "{} on a window of {:.0} ms ({} samples of {} sensors), trained on {} runs; this signal was never seen",
            structure_name(&config.structure),
            config.window_s * 1e3,
            config.window_steps,
            config.inputs.len(),
            config.provenance.train_runs,
        ),
        time_s: (0..samples.len())
            .map(|row| row as f64 * runs.sample_time_s)
            .collect(),
        first_row,
        commands,
        rows,
    })
}

/// A structure as people say it.
fn structure_name(structure: &str) -> String {
    if structure == "best" {
        "Network with linear skip".to_owned()
    } else {
        format!("{structure} network")
    }
}

/// `deflection_tip_y_m` as people say it: `Tip deflection y`.
fn readable(name: &str) -> String {
    let parts: Vec<&str> = name.split('_').collect();
    let text = match parts.as_slice() {
        [
            quantity @ ("deflection" | "strain" | "stress"),
            place,
            component,
            ..,
        ] => format!("{place} {quantity} {component}"),
        ["valve", cylinder, ..] => format!("{cylinder} valve"),
        [quantity @ ("length" | "velocity"), cylinder, ..] => format!("{cylinder} cylinder's {quantity}"),
        ["pressure", cylinder, side, ..] => format!("{cylinder} cylinder's pressure, {side} side"),
        ["angle", joint, ..] => format!("{joint} angle"),
        _ => name.to_owned(),
    };
    let mut letters = text.chars();
    letters
        .next()
        .map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}

impl Picture {
    /// Height of the drawing, px.
    fn height(&self) -> f64 {
        let commands = if self.commands.is_empty() {
            0.0
        } else {
            COMMAND_HEIGHT + ROW_GAP
        };
        let rows = self.rows.len() as f64;
        HEADER
            + commands
            + rows * (SIGNAL_HEIGHT + INNER_GAP + ERROR_HEIGHT)
            + (rows - 1.0).max(0.0) * ROW_GAP
            + FOOTER
    }

    /// The picture as an SVG document.
    #[must_use]
    pub fn to_svg(&self) -> String {
        let mut svg = String::with_capacity(200_000);
        // Writing to a String cannot fail.
        let _ = self.write_svg(&mut svg);
        svg
    }

    fn write_svg(&self, svg: &mut String) -> std::fmt::Result {
        let height = self.height();
        open_svg(svg, height, &self.title)?;
        self.header(svg)?;
        let time = Axis {
            min: self.time_s.first().copied().unwrap_or(0.0),
            max: self.time_s.last().copied().unwrap_or(1.0),
            start_px: LEFT,
            end_px: WIDTH - RIGHT,
        };
        let mut top = HEADER;
        if !self.commands.is_empty() {
            self.command_strip(svg, &time, top)?;
            top += COMMAND_HEIGHT + ROW_GAP;
        }
        for row in &self.rows {
            self.signal_panel(svg, &time, row, top)?;
            top += SIGNAL_HEIGHT + INNER_GAP;
            self.error_panel(svg, &time, row, top)?;
            top += ERROR_HEIGHT + ROW_GAP;
        }
        time_labels(svg, &time, top - ROW_GAP)?;
        writeln!(svg, "</svg>")
    }

    fn header(&self, svg: &mut String) -> std::fmt::Result {
        writeln!(
            svg,
            "<text x=\"{LEFT}\" y=\"34\" font-size=\"20\" font-weight=\"600\">{}</text>",
            escape(&self.title)
        )?;
        writeln!(
            svg,
            "<text x=\"{LEFT}\" y=\"56\" fill=\"{QUIET}\">{}</text>",
            escape(&self.subtitle)
        )?;
        let entries = [
            (REFERENCE, 5.0, "simulation (reference)"),
            (ESTIMATE, 1.6, "network (estimate), and its error"),
            (BASELINE, 1.4, "error of least squares on the same window"),
        ];
        let mut x = LEFT;
        for (color, width, text) in entries {
            writeln!(
                svg,
                "<line x1=\"{x:.0}\" x2=\"{:.0}\" y1=\"76\" y2=\"76\" stroke=\"{color}\" stroke-width=\"{width}\" stroke-linecap=\"round\"/>\
                 <text x=\"{:.0}\" y=\"80.5\">{text}</text>",
                x + 26.0,
                x + 34.0
            )?;
            x += 34.0 + 7.0 * text.len() as f64 + 30.0;
        }
        Ok(())
    }

    fn command_strip(&self, svg: &mut String, time: &Axis, top: f64) -> std::fmt::Result {
        let value = Axis {
            min: -1.1,
            max: 1.1,
            start_px: top + COMMAND_HEIGHT,
            end_px: top,
        };
        frame(svg, time, &value, top, COMMAND_HEIGHT, &[-1.0, 0.0, 1.0], 1.0)?;
        axis_title(svg, top + COMMAND_HEIGHT / 2.0, "Valve", "")?;
        for (_, column) in &self.commands {
            self.line(svg, time, &value, 0, column, COMMAND, 1.3)?;
        }
        Ok(())
    }

    fn signal_panel(&self, svg: &mut String, time: &Axis, row: &PictureRow, top: f64) -> std::fmt::Result {
        let (min, max) = padded_range(row.reference.iter().chain(&row.estimate), 0.08);
        let value = Axis {
            min,
            max,
            start_px: top + SIGNAL_HEIGHT,
            end_px: top,
        };
        let ticks = value.ticks(5);
        frame(svg, time, &value, top, SIGNAL_HEIGHT, &ticks, tick_step(&ticks))?;
        axis_title(svg, top + SIGNAL_HEIGHT / 2.0, &row.name, &row.unit)?;
        self.blind_part(svg, time, top, SIGNAL_HEIGHT, "first window")?;
        self.line(svg, time, &value, 0, &row.reference, REFERENCE, 5.0)?;
        self.line(svg, time, &value, self.first_row, &row.estimate, ESTIMATE, 1.6)
    }

    fn error_panel(&self, svg: &mut String, time: &Axis, row: &PictureRow, top: f64) -> std::fmt::Result {
        let reference = &row.reference[self.first_row.min(row.reference.len())..];
        let error =
            |estimate: &[f64]| -> Vec<f64> { estimate.iter().zip(reference).map(|(e, r)| e - r).collect() };
        let (network, linear) = (error(&row.estimate), error(&row.least_squares));
        let largest = network
            .iter()
            .chain(&linear)
            .fold(0.0_f64, |m, e| m.max(e.abs()))
            .max(1e-12)
            * 1.12;
        let value = Axis {
            min: -largest,
            max: largest,
            start_px: top + ERROR_HEIGHT,
            end_px: top,
        };
        let ticks = value.ticks(4);
        frame(svg, time, &value, top, ERROR_HEIGHT, &ticks, tick_step(&ticks))?;
        axis_title(svg, top + ERROR_HEIGHT / 2.0, "Error", &row.unit)?;
        self.blind_part(svg, time, top, ERROR_HEIGHT, "")?;
        self.line(svg, time, &value, self.first_row, &linear, BASELINE, 1.2)?;
        self.line(svg, time, &value, self.first_row, &network, ESTIMATE, 1.6)?;
        let mean = |errors: &[f64]| errors.iter().map(|e| e.abs()).sum::<f64>() / errors.len().max(1) as f64;
        let x = WIDTH - RIGHT;
        writeln!(
            svg,
            "<text x=\"{x}\" y=\"{:.1}\" text-anchor=\"end\" font-size=\"12\">\
             mean |error|: <tspan fill=\"{ESTIMATE}\" font-weight=\"600\">network {} {unit}</tspan>, \
             <tspan fill=\"#a96f00\">least squares {} {unit}</tspan></text>",
            top - 8.0,
            significant(mean(&network)),
            significant(mean(&linear)),
            unit = escape(&row.unit)
        )
    }

    /// Shades the samples before the first whole window.
    fn blind_part(
        &self,
        svg: &mut String,
        time: &Axis,
        top: f64,
        height: f64,
        text: &str,
    ) -> std::fmt::Result {
        let Some(&end) = self.time_s.get(self.first_row) else {
            return Ok(());
        };
        let width = time.px(end) - LEFT;
        writeln!(
            svg,
            "<rect x=\"{LEFT}\" y=\"{top}\" width=\"{width:.1}\" height=\"{height}\" fill=\"#7b8794\" opacity=\"0.10\"/>"
        )?;
        if text.is_empty() || width < 14.0 {
            return Ok(());
        }
        let (x, y) = (LEFT + width / 2.0 + 4.0, top + height - 8.0);
        writeln!(
            svg,
            "<text x=\"{x:.1}\" y=\"{y:.1}\" font-size=\"11\" fill=\"{QUIET}\" transform=\"rotate(-90 {x:.1} {y:.1})\">{text}</text>"
        )
    }

    #[allow(clippy::too_many_arguments, reason = "a line is where, what and how")]
    fn line(
        &self,
        svg: &mut String,
        time: &Axis,
        value: &Axis,
        first_row: usize,
        column: &[f64],
        color: &str,
        width: f64,
    ) -> std::fmt::Result {
        let points: Vec<(f64, f64)> = self
            .time_s
            .iter()
            .skip(first_row)
            .zip(column)
            .map(|(&t, &v)| (time.px(t), value.px(v)))
            .collect();
        write!(
            svg,
            "<polyline fill=\"none\" stroke=\"{color}\" stroke-width=\"{width}\" stroke-linejoin=\"round\" stroke-linecap=\"round\" points=\""
        )?;
        for (x, y) in simplify(&points) {
            write!(svg, "{x:.1},{y:.1} ")?;
        }
        writeln!(svg, "\"/>")
    }
}

/// Root element, title and white ground.
fn open_svg(svg: &mut String, height: f64, title: &str) -> std::fmt::Result {
    writeln!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" width=\"{WIDTH}\" height=\"{height}\" \
         font-family=\"Inter, 'Segoe UI', 'Helvetica Neue', Arial, 'DejaVu Sans', sans-serif\" font-size=\"13\" fill=\"{INK}\">"
    )?;
    writeln!(svg, "<title>{}</title>", escape(title))?;
    writeln!(svg, "<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>")
}

fn tick_step(ticks: &[f64]) -> f64 {
    if ticks.len() > 1 { ticks[1] - ticks[0] } else { 1.0 }
}

/// Grid, value labels and border of a panel.
fn frame(
    svg: &mut String,
    time: &Axis,
    value: &Axis,
    top: f64,
    height: f64,
    ticks: &[f64],
    step: f64,
) -> std::fmt::Result {
    let right = WIDTH - RIGHT;
    for tick in time.ticks(10) {
        let x = time.px(tick);
        writeln!(
            svg,
            "<line x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{top}\" y2=\"{}\" stroke=\"{GRID}\"/>",
            top + height
        )?;
    }
    for &tick in ticks {
        let y = value.px(tick);
        let stroke = if tick.abs() < step * 1e-6 { "#b8c1cb" } else { GRID };
        writeln!(
            svg,
            "<line x1=\"{LEFT}\" x2=\"{right}\" y1=\"{y:.1}\" y2=\"{y:.1}\" stroke=\"{stroke}\"/>"
        )?;
        writeln!(
            svg,
            "<text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\" font-size=\"12\" fill=\"{QUIET}\">{}</text>",
            LEFT - 8.0,
            y + 4.0,
            label(tick, step)
        )?;
    }
    writeln!(
        svg,
        "<rect x=\"{LEFT}\" y=\"{top}\" width=\"{}\" height=\"{height}\" fill=\"none\" stroke=\"#cbd2d9\"/>",
        right - LEFT
    )
}

/// Name and unit along the value axis.
fn axis_title(svg: &mut String, middle: f64, name: &str, unit: &str) -> std::fmt::Result {
    let x = 22.0;
    let text = if unit.is_empty() {
        escape(name)
    } else {
        format!("{} [{}]", escape(name), escape(unit))
    };
    writeln!(
        svg,
        "<text x=\"{x}\" y=\"{middle:.1}\" text-anchor=\"middle\" font-size=\"12\" transform=\"rotate(-90 {x} {middle:.1})\">{text}</text>"
    )
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
}

fn time_labels(svg: &mut String, time: &Axis, bottom: f64) -> std::fmt::Result {
    let ticks = time.ticks(10);
    for &tick in &ticks {
        let x = time.px(tick);
        writeln!(
            svg,
            "<text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"{QUIET}\">{}</text>",
            bottom + 18.0,
            label(tick, tick_step(&ticks))
        )?;
    }
    let middle = (LEFT + WIDTH - RIGHT) / 2.0;
    writeln!(
        svg,
        "<text x=\"{middle}\" y=\"{:.1}\" text-anchor=\"middle\">Time [s]</text>",
        bottom + 40.0
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_named_as_people_say() {
        assert_eq!(readable("deflection_tip_y_m"), "Tip deflection y");
        assert_eq!(readable("stress_root_xx_pa"), "Root stress xx");
        assert_eq!(readable("valve_lift_ratio"), "Lift valve");
    }

    #[test]
    fn a_picture_is_whole_and_holds_every_row() {
        let row = |name: &str| PictureRow {
            name: name.to_owned(),
            unit: "mm".to_owned(),
            reference: (0..100).map(|i| f64::from(i).sin()).collect(),
            estimate: (9..100).map(|i| f64::from(i).sin() + 0.01).collect(),
            half_width: None,
            least_squares: (9..100).map(|i| f64::from(i).sin() - 0.1).collect(),
        };
        let svg = Picture {
            title: "A < B".to_owned(),
            subtitle: String::new(),
            time_s: (0..100).map(|i| f64::from(i) * 0.005).collect(),
            first_row: 9,
            commands: Vec::new(),
            rows: vec![row("Tip deflection y"), row("Root stress xx")],
        }
        .to_svg();
        assert!(svg.trim_end().ends_with("</svg>") && svg.contains("A &lt; B"));
        assert_eq!(svg.matches("<polyline").count(), 2 * 4);
        assert!(svg.contains("network 0.0100 mm") && svg.contains("least squares 0.100 mm"));
    }
}
