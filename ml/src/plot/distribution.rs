//! How the training data are distributed: each channel as the network sees it, with the normal distribution of the same
//! mean and deviation. Khadim et al. show this figure; where the two differ much, a scale is wrong or a signal clips.

use super::axis::{Axis, label};
use super::{BASELINE, ESTIMATE, GRID, QUIET, REFERENCE, WIDTH, escape, open_svg, readable, tick_step};
use crate::evaluate::table::significant;
use crate::scaling::mean_and_std;
use crate::train::prepare::Problem;
use hydroflex_openapi::model::ScaledChannel;
use std::fmt::Write;

const COLUMNS: usize = 4;
const LEFT: f64 = 24.0;
const GAP: f64 = 26.0;
const TOP: f64 = 118.0;
const PANEL: f64 = 118.0;
const ROW_GAP: f64 = 66.0;
const BINS: usize = 48;
/// A signal that rests in one bin would flatten every other: panels end at so many times the normal's peak.
const TALLEST: f64 = 2.5;

/// One channel.
struct Panel {
    name: String,
    is_target: bool,
    mean: f64,
    std: f64,
    min: f64,
    max: f64,
    /// Probability density of each of [`BINS`] equal parts from `min` to `max`; none for a constant.
    density: Vec<f64>,
}

/// The picture of the training runs' inputs and targets, scaled as the network sees them.
#[must_use]
pub fn of_problem(problem: &Problem) -> String {
    let inputs = problem.input_scaling.channels().iter().enumerate();
    let mut panels: Vec<Panel> = inputs
        .map(|(c, channel)| {
            let values = || {
                let runs = problem.seen.runs.iter();
                runs.flat_map(move |run| run.columns[c].iter())
                    .map(move |&value| problem.input_scaling.scale(c, value))
            };
            Panel::new(channel, false, values)
        })
        .collect();
    let targets = &problem.train.targets;
    let channels = problem.target_scaling.channels().iter().enumerate();
    panels.extend(channels.map(|(t, channel)| {
        Panel::new(channel, true, || {
            targets.values.iter().copied().skip(t).step_by(targets.width)
        })
    }));
    let mut svg = String::new();
    // Writing to a String cannot fail.
    let _ = draw(&mut svg, problem.seen.runs.len(), &panels);
    svg
}

fn draw(svg: &mut String, runs: usize, panels: &[Panel]) -> std::fmt::Result {
    let rows = panels.len().div_ceil(COLUMNS) as f64;
    let title = "Distribution of the training data";
    open_svg(svg, TOP + rows * (PANEL + ROW_GAP) - 20.0, title)?;
    writeln!(
        svg,
        "<text x=\"{LEFT}\" y=\"34\" font-size=\"20\" font-weight=\"600\">{title}</text>\
         <text x=\"{LEFT}\" y=\"56\" fill=\"{QUIET}\">Every sample of {runs} training runs, scaled as the network sees it; the line is the \
         normal distribution with the same mean and deviation</text>\
         <text x=\"{LEFT}\" y=\"76\" font-size=\"12\"><tspan fill=\"{ESTIMATE}\" font-weight=\"600\">sensor</tspan> · \
         <tspan fill=\"#a96f00\" font-weight=\"600\">target</tspan></text>"
    )?;
    let width = (WIDTH - 2.0 * LEFT - (COLUMNS - 1) as f64 * GAP) / COLUMNS as f64;
    for (index, panel) in panels.iter().enumerate() {
        let left = LEFT + (index % COLUMNS) as f64 * (width + GAP);
        let top = TOP + (index / COLUMNS) as f64 * (PANEL + ROW_GAP);
        panel.draw(svg, left, top, width)?;
    }
    writeln!(svg, "</svg>")
}

impl Panel {
    fn new<I: Iterator<Item = f64>>(
        channel: &ScaledChannel,
        is_target: bool,
        values: impl Fn() -> I,
    ) -> Self {
        let (mean, std) = mean_and_std(values());
        let (min, max) = values().fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), v| {
            (min.min(v), max.max(v))
        });
        let width = (max - min) / BINS as f64;
        let density = if width > 1e-9 * max.abs().max(1.0) {
            let mut counts = vec![0_u64; BINS];
            let mut all = 0_u64;
            for value in values() {
                #[allow(
                    clippy::cast_possible_truncation,
                    clippy::cast_sign_loss,
                    reason = "0 to BINS, as value is within min and max"
                )]
                let bin = ((value - min) / width) as usize;
                counts[bin.min(BINS - 1)] += 1;
                all += 1;
            }
            counts.iter().map(|&n| n as f64 / (all as f64 * width)).collect()
        } else {
            Vec::new()
        };
        Self {
            name: readable(&channel.name),
            is_target,
            mean,
            std,
            min,
            max,
            density,
        }
    }

    fn draw(&self, svg: &mut String, left: f64, top: f64, width: f64) -> std::fmt::Result {
        let color = if self.is_target { BASELINE } else { ESTIMATE };
        let ink = if self.is_target { "#a96f00" } else { ESTIMATE };
        writeln!(
            svg,
            "<text x=\"{left:.1}\" y=\"{:.1}\" font-size=\"12\" font-weight=\"600\" fill=\"{ink}\">{}</text>\
             <text x=\"{:.1}\" y=\"{:.1}\" font-size=\"11\" text-anchor=\"end\" fill=\"{QUIET}\">μ {}, σ {}</text>\
             <rect x=\"{left:.1}\" y=\"{top:.1}\" width=\"{width:.1}\" height=\"{PANEL}\" fill=\"none\" stroke=\"#cbd2d9\"/>",
            top - 20.0,
            escape(&self.name),
            left + width,
            top - 5.0,
            // What rounding leaves of a mean that was taken away.
            significant(if self.mean.abs() < 1e-9 * self.std {
                0.0
            } else {
                self.mean
            }),
            significant(self.std)
        )?;
        if self.density.is_empty() {
            return writeln!(
                svg,
                "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"{QUIET}\">always {}</text>",
                left + width / 2.0,
                top + PANEL / 2.0,
                significant(self.mean)
            );
        }
        let value = Axis {
            min: self.min.min(self.mean - 3.0 * self.std),
            max: self.max.max(self.mean + 3.0 * self.std),
            start_px: left,
            end_px: left + width,
        };
        let normal = |x: f64| {
            let z = (x - self.mean) / self.std;
            (-0.5 * z * z).exp() / (self.std * std::f64::consts::TAU.sqrt())
        };
        let peak = normal(self.mean);
        let highest = self
            .density
            .iter()
            .copied()
            .fold(peak, f64::max)
            .min(TALLEST * peak)
            * 1.05;
        let y = |density: f64| top + PANEL * (1.0 - (density / highest).min(1.0));
        let ticks = value.ticks(4);
        for &tick in &ticks {
            let x = value.px(tick);
            writeln!(
                svg,
                "<line x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{top:.1}\" y2=\"{:.1}\" stroke=\"{GRID}\"/>\
                 <text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\" font-size=\"11\" fill=\"{QUIET}\">{}</text>",
                top + PANEL,
                top + PANEL + 16.0,
                label(tick, tick_step(&ticks))
            )?;
        }
        let step = (self.max - self.min) / BINS as f64;
        write!(
            svg,
            "<path fill=\"{REFERENCE}\" d=\"M{:.1},{:.1}",
            value.px(self.min),
            top + PANEL
        )?;
        for (bin, &density) in self.density.iter().enumerate() {
            let end = value.px(self.min + (bin + 1) as f64 * step);
            write!(svg, "V{:.1}H{end:.1}", y(density))?;
        }
        write!(svg, "V{:.1}Z\"/>", top + PANEL)?;
        write!(
            svg,
            "<polyline fill=\"none\" stroke=\"{color}\" stroke-width=\"1.8\" points=\""
        )?;
        for point in 0..=80 {
            let x = value.min + (value.max - value.min) * f64::from(point) / 80.0;
            write!(svg, "{:.1},{:.1} ", value.px(x), y(normal(x)))?;
        }
        writeln!(svg, "\"/>")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panel(values: &[f64]) -> Panel {
        let channel = ScaledChannel {
            name: "pressure_lift_piston_pa".to_owned(),
            unit: "Pa".to_owned(),
            offset: 0.0,
            scale: 1.0,
        };
        Panel::new(&channel, false, || values.iter().copied())
    }

    #[test]
    fn a_histogram_is_a_density_that_holds_every_sample() {
        let values: Vec<f64> = (0..1000).map(|i| f64::from(i) / 999.0).collect();
        let panel = panel(&values);
        let width = (panel.max - panel.min) / BINS as f64;
        let whole: f64 = panel.density.iter().map(|density| density * width).sum();
        assert!((whole - 1.0).abs() < 1e-12, "{whole}");
        // Uniform on 0 to 1: density 1 everywhere, mean 1/2, deviation 1/√12.
        assert!(panel.density.iter().all(|density| (density - 1.0).abs() < 0.06));
        assert!((panel.mean - 0.5).abs() < 1e-12 && (panel.std - 12f64.sqrt().recip()).abs() < 1e-3);
    }

    #[test]
    fn constant_channels_and_lone_peaks_are_drawn_too() {
        let mut rest = vec![0.0; 990];
        rest.extend([1.0; 10]);
        let mut svg = String::new();
        draw(&mut svg, 1, &[panel(&[0.7; 5]), panel(&rest)]).unwrap();
        assert!(svg.contains("always 0.7") && svg.trim_end().ends_with("</svg>"));
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
