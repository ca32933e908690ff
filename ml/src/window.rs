//! Windows by index arithmetic: nothing is materialised but the batch at hand.
//!
//! Scaled inputs stand in one array of rows (one row per sample, runs one after the other, channels
//! interleaved), so a window of `steps` samples is a *contiguous* slice of `steps · inputs` values
//! that starts at its first row. 286,720 overlapping windows of 300 values cost 8 MB, not 344 MB.

use crate::runs::{Runs, RunsError};
use crate::scaling::Scaling;
use hydroflex_openapi::job::WindowCut;

/// Scaled samples of several runs, f32, ready for windows to be cut from.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Values per row.
    pub width: usize,
    /// Rows of all runs, row-major.
    pub values: Vec<f32>,
    /// First row of each run, and the number of rows at the end.
    pub run_rows: Vec<usize>,
}

impl Series {
    /// Scales every channel of `runs`: the one place where f64 becomes f32.
    ///
    /// # Panics
    /// When `scaling` has another number of channels.
    #[must_use]
    pub fn new(runs: &Runs, scaling: &Scaling) -> Self {
        let width = runs.channels.len();
        assert_eq!(width, scaling.len(), "one scale per channel");
        let rows: usize = runs.runs.iter().map(crate::runs::RunSamples::len).sum();
        let mut values = vec![0.0_f32; rows * width];
        let mut run_rows = Vec::with_capacity(runs.runs.len() + 1);
        let mut first_row = 0;
        for run in &runs.runs {
            run_rows.push(first_row);
            for (channel, column) in run.columns.iter().enumerate() {
                scaling.scale_column(channel, column, &mut values[first_row * width + channel..], width);
            }
            first_row += run.len();
        }
        run_rows.push(first_row);
        Self {
            width,
            values,
            run_rows,
        }
    }

    /// Number of rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.values.len() / self.width
    }

    /// One row.
    #[must_use]
    pub fn row(&self, row: usize) -> &[f32] {
        &self.values[row * self.width..(row + 1) * self.width]
    }

    /// The window of `steps` rows that starts at `first_row`.
    #[must_use]
    pub fn window(&self, first_row: usize, steps: usize) -> &[f32] {
        &self.values[first_row * self.width..(first_row + steps) * self.width]
    }
}

/// Which windows there are: a map from a window's number to its first row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Windows {
    /// Rows in a window.
    pub steps: usize,
    /// Rows from one window of a run to its next.
    stride: usize,
    /// First row of each run.
    run_rows: Vec<usize>,
    /// Number of the first window of each run, and the number of windows at the end.
    first_window: Vec<usize>,
}

impl Windows {
    /// Windows of `steps` rows of runs that begin at `run_rows` (as in [`Series`]).
    ///
    /// A run of n rows has n − steps + 1 overlapping windows or ⌊n / steps⌋ disjoint ones; a run
    /// that is shorter than a window has none.
    ///
    /// # Panics
    /// When `steps` is 0 or `run_rows` is empty.
    #[must_use]
    pub fn new(run_rows: &[usize], steps: usize, cut: WindowCut) -> Self {
        assert!(steps > 0, "a window has at least one row");
        assert!(!run_rows.is_empty(), "run_rows ends with the number of rows");
        let mut first_window = vec![0];
        let mut total = 0;
        for rows in run_rows.windows(2) {
            let length = rows[1] - rows[0];
            total += match cut {
                WindowCut::Overlapping => (length + 1).saturating_sub(steps),
                WindowCut::Disjoint => length / steps,
            };
            first_window.push(total);
        }
        Self {
            steps,
            stride: match cut {
                WindowCut::Overlapping => 1,
                WindowCut::Disjoint => steps,
            },
            run_rows: run_rows[..run_rows.len() - 1].to_vec(),
            first_window,
        }
    }

    /// Number of windows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.first_window[self.first_window.len() - 1]
    }

    /// Whether there is no window.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// First row of window `index`.
    ///
    /// # Panics
    /// When there is no such window.
    #[must_use]
    pub fn first_row(&self, index: usize) -> usize {
        assert!(index < self.len(), "window {index} of {}", self.len());
        let run = self.first_window.partition_point(|&first| first <= index) - 1;
        self.run_rows[run] + (index - self.first_window[run]) * self.stride
    }

    /// Row to which the estimate of window `index` belongs: its last.
    #[must_use]
    pub fn last_row(&self, index: usize) -> usize {
        self.first_row(index) + self.steps - 1
    }

    /// Runs of consecutive windows: (first row, number of windows) for each run that has any.
    pub fn spans(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        self.first_window
            .windows(2)
            .zip(&self.run_rows)
            .map(|(w, &row)| (row, w[1] - w[0]))
            .filter(|&(_, count)| count > 0)
    }

    /// Rows between the first rows of neighbouring windows of a run.
    #[must_use]
    pub fn stride(&self) -> usize {
        self.stride
    }
}

/// Number of samples in a window of `window_s` seconds.
///
/// # Errors
/// When it is not positive or shorter than one sample.
pub fn window_steps(window_s: f64, sample_time_s: f64) -> Result<usize, WindowError> {
    let steps = (window_s / sample_time_s).round();
    if !steps.is_finite() || steps < 1.0 {
        return Err(WindowError::TooShort {
            window_s,
            sample_time_s,
        });
    }
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "finite, at least 1, and \
        saturates far beyond any run"
    )]
    Ok(steps as usize)
}

/// Why a window cannot be cut.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum WindowError {
    /// Shorter than a sample.
    #[error("a window of {window_s} s is shorter than a sample of {sample_time_s} s")]
    TooShort {
        /// Window.
        window_s: f64,
        /// Time between samples.
        sample_time_s: f64,
    },
    /// Longer than the longest run.
    #[error(
        "a window of {steps} samples ({window_s} s) is longer than the longest run ({longest} samples); \
         choose a window of at most {longest_s} s, or longer runs"
    )]
    LongerThanRun {
        /// Samples in the window.
        steps: usize,
        /// Window.
        window_s: f64,
        /// Samples in the longest run.
        longest: usize,
        /// Its length in time.
        longest_s: f64,
    },
    /// Recorded values are unusable.
    #[error(transparent)]
    Runs(#[from] RunsError),
}

impl WindowError {
    /// No run of `runs` holds a window of `steps` samples.
    pub(crate) fn longer_than(runs: &Runs, steps: usize) -> Self {
        let lengths = runs.runs.iter().map(crate::runs::RunSamples::len);
        let longest = lengths.max().unwrap_or(0);
        Self::LongerThanRun {
            steps,
            window_s: steps as f64 * runs.sample_time_s,
            longest,
            longest_s: longest as f64 * runs.sample_time_s,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn overlapping_windows_visit_every_row_but_the_first_ones() {
        let windows = Windows::new(&[0, 5, 7, 11], 3, WindowCut::Overlapping);
        let rows: Vec<usize> = (0..windows.len()).map(|i| windows.first_row(i)).collect();
        assert_eq!(rows, [0, 1, 2, 7, 8], "the run of two rows has no window");
        assert_eq!(windows.last_row(3), 9);
        assert_eq!(windows.spans().collect::<Vec<_>>(), [(0, 3), (7, 2)]);
    }

    #[test]
    fn disjoint_windows_are_as_published() {
        let windows = Windows::new(&[0, 7, 13], 3, WindowCut::Disjoint);
        let rows: Vec<usize> = (0..windows.len()).map(|i| windows.first_row(i)).collect();
        assert_eq!(rows, [0, 3, 7, 10]);
    }

    #[test]
    fn steps_are_rounded_to_samples() {
        assert_eq!(window_steps(0.3, 0.005).unwrap(), 60);
        assert_eq!(window_steps(0.2549, 0.005).unwrap(), 51);
        assert!(window_steps(0.001, 0.005).is_err());
        assert!(window_steps(f64::NAN, 0.005).is_err());
    }
}
