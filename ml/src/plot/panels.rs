//! Curves on logarithmic axes, a few panels of them.

use super::{GRID, QUIET, WIDTH, escape, open_svg};
use std::fmt::Write as _;

const LEFT: f64 = 84.0;
const GAP: f64 = 84.0;
const RIGHT: f64 = 24.0;
const TOP: f64 = 112.0;
const PANEL: f64 = 190.0;
const ROW_GAP: f64 = 92.0;

/// Colours of curves that are told apart by people with any colour vision (Okabe and Ito).
pub const COLORS: [&str; 6] = ["#0b4f8a", "#d98e04", "#009e73", "#cc79a7", "#616e7c", "#56b4e9"];

/// A curve.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// Of its line.
    pub color: &'static str,
    /// Abscissa and ordinate; what has no logarithm where it needs one is left out.
    pub points: Vec<(f64, f64)>,
}

/// A panel of curves. The ordinate is logarithmic.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// Title.
    pub title: String,
    /// Quantity and unit of the abscissa.
    pub x: String,
    /// Unit of the ordinate.
    pub y: String,
    /// Whether the abscissa is logarithmic, too.
    pub log: bool,
    /// Drawn in this order.
    pub curves: Vec<Curve>,
}

/// Panels, two beside each other, below a title and what the colours of the curves mean.
#[must_use]
pub fn picture(title: &str, subtitle: &str, legend: &[(&str, String)], panels: &[Panel]) -> String {
    let mut svg = String::new();
    // Writing to a String cannot fail.
    let _ = draw(&mut svg, title, subtitle, legend, panels);
    svg
}

fn draw(
    svg: &mut String,
    title: &str,
    subtitle: &str,
    legend: &[(&str, String)],
    panels: &[Panel],
) -> std::fmt::Result {
    let rows = panels.len().div_ceil(2) as f64;
    open_svg(svg, TOP + rows * (PANEL + ROW_GAP) - 20.0, title)?;
    writeln!(
        svg,
        "<text x=\"24\" y=\"34\" font-size=\"20\" font-weight=\"600\">{}</text>\
         <text x=\"24\" y=\"56\" fill=\"{QUIET}\">{}</text>",
        escape(title),
        escape(subtitle)
    )?;
    let mut x = 24.0;
    for (color, name) in legend {
        writeln!(
            svg,
            "<line x1=\"{x:.0}\" x2=\"{:.0}\" y1=\"76\" y2=\"76\" stroke=\"{color}\" stroke-width=\"3\"/>\
             <text x=\"{:.0}\" y=\"80.5\" font-size=\"12\">{}</text>",
            x + 18.0,
            x + 24.0,
            escape(name)
        )?;
        x += 24.0 + 6.6 * name.chars().count() as f64 + 22.0;
    }
    let width = (WIDTH - LEFT - GAP - RIGHT) / 2.0;
    for (index, panel) in panels.iter().enumerate() {
        let left = LEFT + (index % 2) as f64 * (width + GAP);
        let top = TOP + (index / 2) as f64 * (PANEL + ROW_GAP);
        panel.draw(svg, left, top, width)?;
    }
    writeln!(svg, "</svg>")
}

impl Panel {
    fn draw(&self, svg: &mut String, left: f64, top: f64, width: f64) -> std::fmt::Result {
        writeln!(
            svg,
            "<text x=\"{left:.1}\" y=\"{:.1}\" font-weight=\"600\" font-size=\"12\">{}</text>\
             <rect x=\"{left:.1}\" y=\"{top:.1}\" width=\"{width:.1}\" height=\"{PANEL}\" fill=\"none\" stroke=\"#cbd2d9\"/>\
             <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\" font-size=\"12\">{}</text>",
            top - 8.0,
            escape(&self.title),
            left + width / 2.0,
            top + PANEL + 36.0,
            escape(&self.x)
        )?;
        let points = || {
            let all = self.curves.iter().flat_map(|curve| &curve.points);
            all.copied().filter(|(x, y)| *y > 0.0 && (!self.log || *x > 0.0))
        };
        let across = |x: f64| if self.log { x.log10() } else { x };
        let (mut x_min, mut x_max) = (f64::INFINITY, f64::NEG_INFINITY);
        let (mut y_min, mut y_max) = (f64::INFINITY, f64::NEG_INFINITY);
        for (x, y) in points() {
            x_min = x_min.min(across(x));
            x_max = x_max.max(across(x));
            y_min = y_min.min(y.log10());
            y_max = y_max.max(y.log10());
        }
        if x_min > x_max {
            return writeln!(
                svg,
                "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"{QUIET}\">nothing to show</text>",
                left + width / 2.0,
                top + PANEL / 2.0
            );
        }
        let (y_low, y_high) = (y_min.floor(), y_max.ceil().max(y_min.floor() + 1.0));
        let x_span = (x_max - x_min).max(1e-12);
        let px = |x: f64| left + (across(x) - x_min) / x_span * width;
        let py = |y: f64| top + PANEL - (y.log10() - y_low) / (y_high - y_low) * PANEL;
        let mut power = y_low;
        while power <= y_high {
            let y = py(10f64.powf(power));
            writeln!(
                svg,
                "<line x1=\"{left:.1}\" x2=\"{:.1}\" y1=\"{y:.1}\" y2=\"{y:.1}\" stroke=\"{GRID}\"/>\
                 <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\" font-size=\"11\" fill=\"{QUIET}\">1e{power:.0}</text>",
                left + width,
                left - 6.0,
                y + 4.0
            )?;
            power += 1.0;
        }
        for tick in self.ticks(x_min, x_max) {
            let x = px(tick);
            writeln!(
                svg,
                "<line x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{top:.1}\" y2=\"{:.1}\" stroke=\"{GRID}\"/>\
                 <text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\" font-size=\"11\" fill=\"{QUIET}\">{}</text>",
                top + PANEL,
                top + PANEL + 16.0,
                crate::evaluate::table::significant(tick)
                    .trim_end_matches(".00")
                    .to_owned()
            )?;
        }
        let middle = top + PANEL / 2.0;
        let at = left - 52.0;
        writeln!(
            svg,
            "<text x=\"{at:.1}\" y=\"{middle:.1}\" text-anchor=\"middle\" font-size=\"11\" fill=\"{QUIET}\" \
             transform=\"rotate(-90 {at:.1} {middle:.1})\">{}</text>",
            escape(&self.y)
        )?;
        for curve in &self.curves {
            write!(
                svg,
                "<polyline fill=\"none\" stroke=\"{}\" stroke-width=\"1.8\" stroke-linejoin=\"round\" points=\"",
                curve.color
            )?;
            for &(x, y) in &curve.points {
                if y > 0.0 && (!self.log || x > 0.0) {
                    write!(svg, "{:.1},{:.1} ", px(x), py(y))?;
                }
            }
            writeln!(svg, "\"/>")?;
        }
        Ok(())
    }

    /// Round values of the abscissa.
    fn ticks(&self, min: f64, max: f64) -> Vec<f64> {
        if self.log {
            #[allow(clippy::cast_possible_truncation, reason = "a handful of powers of ten")]
            let powers = min.ceil() as i32..=max.floor() as i32;
            return powers.map(|power| 10f64.powi(power)).collect();
        }
        super::axis::Axis {
            min,
            max: max.max(min + 1e-12),
            start_px: 0.0,
            end_px: 1.0,
        }
        .ticks(6)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plot::ESTIMATE;

    #[test]
    fn panels_are_drawn_whole_with_values_that_have_no_logarithm_left_out() {
        let panel = |log| Panel {
            title: "A < B".to_owned(),
            x: "x".to_owned(),
            y: "mm".to_owned(),
            log,
            curves: vec![Curve {
                color: ESTIMATE,
                points: vec![(0.0, 0.1), (1.0, 0.0), (10.0, 0.01), (100.0, 0.2)],
            }],
        };
        let empty = Panel {
            curves: Vec::new(),
            ..panel(false)
        };
        let mut svg = String::new();
        let legend = [(ESTIMATE, "a > b".to_owned())];
        draw(
            &mut svg,
            "T & U",
            "",
            &legend,
            &[panel(false), panel(true), empty],
        )
        .unwrap();
        assert!(
            svg.contains("a &gt; b")
                && svg.contains("T &amp; U")
                && svg.contains("A &lt; B")
                && svg.trim_end().ends_with("</svg>")
        );
        assert_eq!(svg.matches("<polyline").count(), 2);
        assert!(svg.contains("nothing to show") && !svg.contains("NaN") && !svg.contains("inf"));
    }
}
