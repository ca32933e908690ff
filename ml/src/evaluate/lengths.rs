//! Flagged windows within and beyond the cylinder lengths of the training runs.
//!
//! A run of 10 s goes farther than runs of 1 s did, and an envelope that says so is right. Only what it flags within the
//! trained lengths is a false alarm.

use crate::scheduled::RANGE_FACTOR;
use hydroflex_openapi::model::{FlaggedByLength, ModelConfig};

/// Position of a length among the inputs, and its range in training, m.
pub(super) struct TrainedLengths(Vec<(usize, [f64; 2])>);

impl TrainedLengths {
    /// None where the model has no envelope, or sees no length.
    pub(super) fn of(config: &ModelConfig) -> Option<Self> {
        let envelope = config.envelope.as_ref()?;
        let lengths: Vec<(usize, [f64; 2])> = config
            .inputs
            .iter()
            .enumerate()
            .filter(|(_, channel)| channel.name.starts_with("length_"))
            .map(|(input, _)| {
                // The envelope's ranges are the training's, widened.
                let (low, high) = (envelope.min[input], envelope.max[input]);
                let (centre, half) = (0.5 * (low + high), 0.5 * (high - low) / RANGE_FACTOR);
                (input, [centre - half, centre + half])
            })
            .collect();
        (!lengths.is_empty()).then_some(Self(lengths))
    }

    /// Whether some length at `row` is none of the training's.
    fn is_beyond(&self, columns: &[&[f64]], row: usize) -> bool {
        self.0
            .iter()
            .any(|&(input, [low, high])| !(low..=high).contains(&columns[input][row]))
    }
}

/// Windows within and beyond.
#[derive(Debug, Default)]
pub(super) struct Counts {
    windows: [u64; 2],
    flagged: [u64; 2],
}

impl Counts {
    /// Adds a run; `inside` belongs to the windows that end at samples `steps − 1`, `steps`, …
    pub(super) fn add(
        &mut self,
        lengths: &TrainedLengths,
        columns: &[&[f64]],
        steps: usize,
        inside: &[bool],
    ) {
        // Samples since the last one beyond.
        let mut calm = steps;
        for row in 0..steps - 1 + inside.len() {
            calm = if lengths.is_beyond(columns, row) {
                0
            } else {
                calm + 1
            };
            if let Some(&inside) = (row + 1).checked_sub(steps).and_then(|window| inside.get(window)) {
                let kind = usize::from(calm < steps);
                self.windows[kind] += 1;
                self.flagged[kind] += u64::from(!inside);
            }
        }
    }

    pub(super) fn parts(&self) -> FlaggedByLength {
        let part = |some: u64, all: u64| (all > 0).then(|| some as f64 / all as f64);
        FlaggedByLength {
            beyond: part(self.windows[1], self.windows[0] + self.windows[1]).unwrap_or(0.0),
            flagged_within: part(self.flagged[0], self.windows[0]),
            flagged_beyond: part(self.flagged[1], self.windows[1]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_is_beyond_as_long_as_one_of_its_samples_is() {
        let lengths = TrainedLengths(vec![(1, [0.0, 1.0])]);
        // Ten samples, windows of three: eight windows, those that end at samples 4, 5 and 6 hold sample 4.
        let valve = [9.0; 10];
        let mut length = [0.5; 10];
        length[4] = 1.2;
        let mut inside = [true; 8];
        inside[2] = false; // ends at sample 4
        inside[7] = false; // ends at sample 9
        let mut counts = Counts::default();
        counts.add(&lengths, &[&valve, &length], 3, &inside);
        assert_eq!((counts.windows, counts.flagged), ([5, 3], [1, 1]));
        let parts = counts.parts();
        assert_eq!(
            (parts.beyond, parts.flagged_within, parts.flagged_beyond),
            (3.0 / 8.0, Some(1.0 / 5.0), Some(1.0 / 3.0))
        );
        assert_eq!(Counts::default().parts().flagged_within, None);
    }
}
