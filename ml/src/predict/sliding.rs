//! A window that slides one sample at a time, as a live signal comes in.

use super::{Predictor, Windows, Workspace};

/// The last `window_steps` samples of a signal, scaled, in one piece of memory.
///
/// Every sample is stored twice, `window_steps` rows apart, so that the window is a slice wherever
/// it begins: a sample costs two copies of its row and moves nothing else.
#[derive(Debug, Clone)]
pub struct SlidingWindow {
    scaled: Vec<f32>,
    /// Whether each sample has all its values in range.
    in_range: Vec<bool>,
    width: usize,
    steps: usize,
    /// Row of the oldest sample, below `steps`.
    first: usize,
    /// Samples in the window, at most `steps`.
    held: usize,
}

/// What a window shows beside the estimates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Found {
    /// Whether it is inside the envelope; true when the model has none.
    pub inside: bool,
    /// The payload that the model told from it, kg, where it follows one.
    pub payload_kg: Option<f64>,
}

impl SlidingWindow {
    /// An empty window for a model.
    #[must_use]
    pub fn new(predictor: &Predictor) -> Self {
        let (steps, width) = (predictor.window_steps(), predictor.input_count());
        Self {
            scaled: vec![0.0; 2 * steps * width],
            in_range: vec![true; steps],
            width,
            steps,
            first: 0,
            held: 0,
        }
    }

    /// Samples in the window.
    #[must_use]
    pub fn len(&self) -> usize {
        self.held
    }

    /// Whether it holds no sample.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.held == 0
    }

    /// Whether an estimate can be made.
    #[must_use]
    pub fn is_full(&self) -> bool {
        self.held == self.steps
    }

    /// Forgets every sample.
    pub fn clear(&mut self) {
        (self.first, self.held) = (0, 0);
    }

    /// Takes the next sample, one value per input, in the columns' units.
    ///
    /// # Panics
    /// When the sample has another number of values.
    pub fn push(&mut self, predictor: &Predictor, sample: &[f64]) {
        assert_eq!(sample.len(), self.width, "one value per input");
        let row = (self.first + self.held) % self.steps;
        self.write(predictor, row, sample);
        if self.held == self.steps {
            self.first = (self.first + 1) % self.steps;
        } else {
            self.held += 1;
        }
    }

    /// Replaces the sample that came `age` samples before the last one.
    ///
    /// # Panics
    /// When the window does not hold it, or the sample has another number of values.
    pub fn replace(&mut self, predictor: &Predictor, age: usize, sample: &[f64]) {
        assert_eq!(sample.len(), self.width, "one value per input");
        assert!(age < self.held, "a sample of the window");
        let row = (self.first + self.held - 1 - age) % self.steps;
        self.write(predictor, row, sample);
    }

    fn write(&mut self, predictor: &Predictor, row: usize, sample: &[f64]) {
        let at = row * self.width;
        let twin = at + self.steps * self.width;
        predictor
            .maps
            .scale(sample, &mut self.scaled[at..at + self.width]);
        self.scaled.copy_within(at..at + self.width, twin);
        self.in_range[row] = predictor.maps.in_range(sample);
    }

    /// Estimates for the window in the columns' units, whether it is inside the envelope, and the payload that it tells.
    /// Without a whole window nothing is estimated.
    ///
    /// # Panics
    /// When `out` has not one place per target.
    pub fn predict(
        &self,
        predictor: &Predictor,
        out: &mut [f64],
        workspace: &mut Workspace,
    ) -> Option<Found> {
        if !self.is_full() {
            return None;
        }
        let size = self.steps * self.width;
        let window = &self.scaled[self.first * self.width..][..size];
        let windows = Windows::Rows {
            x: window,
            stride: size,
        };
        predictor.block(windows, 1, workspace);
        predictor.unscale(1, out, workspace);
        let mut inside = [true];
        predictor.inside_block(windows, 1, &mut inside, workspace);
        Some(Found {
            inside: inside[0] && self.in_range.iter().all(|&in_range| in_range),
            payload_kg: workspace.payload_kg.first().copied(),
        })
    }
}
