//! Errors of many estimators side by side: one dot each on a logarithmic axis, one panel per case.

use super::{BASELINE, ESTIMATE, GRID, QUIET, REFERENCE, WIDTH, escape, open_svg};
use crate::evaluate::table::significant;
use std::fmt::Write as _;

/// A picture of errors.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorPicture {
    /// Title.
    pub title: String,
    /// Line below the title.
    pub subtitle: String,
    /// Unit of all values.
    pub unit: String,
    /// Cases, top to bottom.
    pub panels: Vec<ErrorPanel>,
}

/// One case.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorPanel {
    /// Name.
    pub name: String,
    /// Estimators.
    pub rows: Vec<ErrorRow>,
}

/// One estimator.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorRow {
    /// Name.
    pub name: String,
    /// Mean error, positive.
    pub mean: f64,
    /// Smallest and largest.
    pub range: (f64, f64),
    /// Colour.
    pub kind: ErrorKind,
}

/// What an estimator is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ErrorKind {
    /// A network.
    Network,
    /// A simple estimator.
    Baseline,
    /// Somebody else's figure.
    Published,
}

const NAMES: f64 = 330.0;
const VALUES: f64 = 84.0;
const TOP: f64 = 84.0;
const ROW: f64 = 19.0;
const PANEL_HEAD: f64 = 30.0;
const BOTTOM: f64 = 52.0;

impl ErrorPicture {
    /// The picture as an SVG document.
    #[must_use]
    pub fn to_svg(&self) -> String {
        let mut svg = String::new();
        // Writing to a String cannot fail.
        let _ = self.write_svg(&mut svg);
        svg
    }

    fn write_svg(&self, svg: &mut String) -> std::fmt::Result {
        let rows = || self.panels.iter().flat_map(|panel| &panel.rows);
        let positive = || {
            rows()
                .flat_map(|row| [row.mean, row.range.0])
                .filter(|v| *v > 0.0)
        };
        let first = positive().fold(1.0, f64::min).log10().floor();
        let last = rows()
            .map(|row| row.mean.max(row.range.1))
            .fold(f64::MIN_POSITIVE, f64::max)
            .log10()
            .ceil()
            .max(first + 1.0);
        let (left, right) = (NAMES, WIDTH - VALUES);
        let x = |value: f64| {
            let part = (value.max(f64::MIN_POSITIVE).log10() - first) / (last - first);
            left + part.clamp(0.0, 1.0) * (right - left)
        };
        let count = rows().count() as f64;
        let height = TOP + self.panels.len() as f64 * PANEL_HEAD + count * ROW + BOTTOM;
        let bottom = height - BOTTOM + 6.0;
        open_svg(svg, height, &self.title)?;
        writeln!(
            svg,
            "<text x=\"24\" y=\"34\" font-size=\"20\" font-weight=\"600\">{}</text>\
             <text x=\"24\" y=\"56\" fill=\"{QUIET}\">{}</text>",
            escape(&self.title),
            escape(&self.subtitle)
        )?;
        let mut power = first;
        while power <= last {
            let at = x(10f64.powf(power));
            writeln!(
                svg,
                "<line x1=\"{at:.1}\" x2=\"{at:.1}\" y1=\"{TOP}\" y2=\"{bottom:.1}\" stroke=\"{GRID}\"/>\
                 <text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"{QUIET}\">{}</text>",
                bottom + 18.0,
                power_label(power)
            )?;
            power += 1.0;
        }
        writeln!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">Mean absolute error [{}]</text>",
            f64::midpoint(left, right),
            bottom + 38.0,
            escape(&self.unit)
        )?;
        let mut y = TOP;
        for panel in &self.panels {
            y += PANEL_HEAD;
            writeln!(
                svg,
                "<text x=\"24\" y=\"{:.1}\" font-weight=\"600\">{}</text>",
                y - 8.0,
                escape(&panel.name)
            )?;
            for row in &panel.rows {
                row.write(svg, y, &x)?;
                y += ROW;
            }
        }
        writeln!(svg, "</svg>")
    }
}

impl ErrorRow {
    fn write(&self, svg: &mut String, top: f64, x: &impl Fn(f64) -> f64) -> std::fmt::Result {
        let color = match self.kind {
            ErrorKind::Network => ESTIMATE,
            ErrorKind::Baseline => BASELINE,
            ErrorKind::Published => REFERENCE,
        };
        let middle = top + ROW / 2.0;
        writeln!(
            svg,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>\
             <line x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{middle:.1}\" y2=\"{middle:.1}\" stroke=\"{color}\" stroke-width=\"3\" opacity=\"0.5\"/>\
             <circle cx=\"{:.1}\" cy=\"{middle:.1}\" r=\"5\" fill=\"{color}\"/>\
             <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\" fill=\"{QUIET}\">{}</text>",
            NAMES - 14.0,
            middle + 4.5,
            escape(&self.name),
            x(self.range.0),
            x(self.range.1),
            x(self.mean),
            WIDTH - 16.0,
            middle + 4.5,
            significant(self.mean)
        )
    }
}

/// `0.001`, `1`, `100`; powers beyond as `1e-6`.
fn power_label(power: f64) -> String {
    if (-5.0..5.0).contains(&power) {
        format!("{}", 10f64.powf(power))
    } else {
        format!("1e{power:.0}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_larger_error_stands_further_right_and_every_row_is_drawn() {
        let row = |name: &str, mean: f64, kind| ErrorRow {
            name: name.to_owned(),
            mean,
            range: (0.9 * mean, 1.1 * mean),
            kind,
        };
        let svg = ErrorPicture {
            title: "A < B".to_owned(),
            subtitle: String::new(),
            unit: "mm".to_owned(),
            panels: vec![ErrorPanel {
                name: "0 kg".to_owned(),
                rows: vec![
                    row("network", 2e-5, ErrorKind::Network),
                    row("least squares", 0.012, ErrorKind::Baseline),
                    row("published", 0.024, ErrorKind::Published),
                ],
            }],
        }
        .to_svg();
        assert!(svg.contains("A &lt; B") && svg.trim_end().ends_with("</svg>"));
        let at: Vec<f64> = svg
            .split("<circle cx=\"")
            .skip(1)
            .map(|rest| {
                rest.split('"')
                    .next()
                    .and_then(|x| x.parse().ok())
                    .expect("a number")
            })
            .collect();
        assert_eq!(at.len(), 3);
        assert!(at[0] < at[1] && at[1] < at[2], "{at:?}");
        assert!(svg.contains(">0.00001<") && svg.contains(">0.1<"), "{svg}");
    }
}
