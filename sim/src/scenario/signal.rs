//! Valve signals: U₁ … Uₙ, one value per sample; U₀ = 0 is not listed.

use super::stream::Stream;

/// Pieces of the ramp part, and swaps of samples: from 5, from 1, to 19.
const PIECES: std::ops::RangeInclusive<usize> = 5..=19;
const SWAPS: std::ops::RangeInclusive<usize> = 1..=19;

/// The paper's random signal (theory note §13): a fifth of the samples each at +1, −1, 0, on random
/// ramps and of uniform noise; the five blocks in random order, then a few random samples swapped.
/// What does not divide by five goes to the noise.
#[must_use]
pub fn random(stream: &mut Stream, steps: usize) -> Vec<f64> {
    let share = steps / 5;
    let ramps = ramps(stream, share);
    let noise = (0..steps - 4 * share)
        .map(|_| stream.uniform(-1.0, 1.0))
        .collect();
    let mut blocks = [
        vec![1.0; share],
        vec![-1.0; share],
        vec![0.0; share],
        ramps,
        noise,
    ];
    stream.shuffle(&mut blocks);
    let mut signal = blocks.concat();
    if steps > 0 {
        for _ in 0..between(stream, &SWAPS) {
            let (a, b) = (stream.below(steps), stream.below(steps));
            signal.swap(a, b);
        }
    }
    signal
}

fn between(stream: &mut Stream, range: &std::ops::RangeInclusive<usize>) -> usize {
    range.start() + stream.below(range.end() - range.start() + 1)
}

/// Straight pieces of random length between random values.
fn ramps(stream: &mut Stream, steps: usize) -> Vec<f64> {
    if steps == 0 {
        return Vec::new();
    }
    let pieces = between(stream, &PIECES).min(steps);
    let mut cuts: Vec<usize> = (1..steps).collect();
    stream.shuffle(&mut cuts);
    cuts.truncate(pieces - 1);
    cuts.push(steps);
    cuts.sort_unstable();
    let mut signal = Vec::with_capacity(steps);
    for end in cuts {
        let (from, to) = (stream.uniform(-1.0, 1.0), stream.uniform(-1.0, 1.0));
        extend_line(&mut signal, from, to, end);
    }
    signal
}

/// Appends samples on a line up to this length; the first is `from`, the last is `to`.
fn extend_line(signal: &mut Vec<f64>, from: f64, to: f64, length: usize) {
    let count = length.saturating_sub(signal.len());
    let last = count.saturating_sub(1).max(1) as f64;
    signal.extend((0..count).map(|k| from + (to - from) * (k as f64 / last)));
}

/// The settling test: 1 for the first part, then 0.
#[must_use]
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a part of the number of steps"
)]
pub fn open_then_shut(open_part: f64, steps: usize) -> Vec<f64> {
    let open = ((open_part * steps as f64).round() as usize).min(steps);
    let mut signal = vec![1.0; open];
    signal.resize(steps, 0.0);
    signal
}

/// Segments of the published evaluation cycle: end in per cent of the run, first and last value.
/// Read off its 10 s signal of 2000 steps, which it reproduces.
const CYCLE: [(usize, f64, f64); 16] = [
    (10, 0.0, 0.0),
    (15, -1.0, -1.0),
    (21, 0.0, 0.0),
    (26, 1.0, 1.0),
    (32, 0.0, 0.0),
    (37, -1.0, -1.0),
    (47, 0.0, 0.0),
    (52, 1.0, 1.0),
    (62, 0.0, 0.0),
    (67, 0.0, -1.0),
    (71, -1.0, -1.0),
    (76, -1.0, 0.0),
    (86, 0.0, 0.0),
    (91, 0.0, 1.0),
    (95, 1.0, 1.0),
    (100, 1.0, 0.0),
];

/// The published evaluation cycle, steps and trapezoids, stretched to the run.
#[must_use]
pub fn cycle(steps: usize) -> Vec<f64> {
    let mut signal = Vec::with_capacity(steps);
    for (per_cent, from, to) in CYCLE {
        extend_line(&mut signal, from, to, (steps * per_cent + 50) / 100);
    }
    signal
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_random_signal_has_a_fifth_of_each_kind() {
        for seed in 0..50 {
            let signal = random(&mut Stream::new(seed, "valve/lift"), 200);
            assert_eq!(signal.len(), 200);
            assert!(signal.iter().all(|u| (-1.0..=1.0).contains(u)));
            let count = |value: f64| signal.iter().filter(|&&u| u == value).count();
            // the chance that noise or a ramp hits one of them exactly is nil
            assert_eq!([count(1.0), count(-1.0), count(0.0)], [40; 3], "seed {seed}");
        }
    }

    #[test]
    fn short_signals_are_signals_too() {
        for steps in 0..30 {
            assert_eq!(random(&mut Stream::new(3, "valve/lift"), steps).len(), steps);
            assert_eq!(cycle(steps).len(), steps);
            assert_eq!(open_then_shut(0.2, steps).len(), steps);
        }
    }

    #[test]
    fn the_valve_shuts_after_its_part() {
        let signal = open_then_shut(0.2, 200);
        assert_eq!(signal.iter().rposition(|&u| u == 1.0), Some(39));
        assert_eq!(signal[40..].iter().sum::<f64>(), 0.0);
    }

    #[test]
    fn the_cycle_has_the_published_corners() {
        // (k, U_k) where the published 10 s signal bends, from its file
        let corners = [
            (200, 0.0),
            (201, -1.0),
            (300, -1.0),
            (301, 0.0),
            (420, 0.0),
            (421, 1.0),
            (520, 1.0),
            (521, 0.0),
            (640, 0.0),
            (641, -1.0),
            (740, -1.0),
            (741, 0.0),
            (940, 0.0),
            (941, 1.0),
            (1040, 1.0),
            (1041, 0.0),
            (1241, 0.0),
            (1340, -1.0),
            (1421, -1.0),
            (1520, 0.0),
            (1721, 0.0),
            (1820, 1.0),
            (1901, 1.0),
            (2000, 0.0),
        ];
        let signal = cycle(2000);
        for (k, u) in corners {
            assert!((signal[k - 1] - u).abs() < 1e-12, "U_{k} = {}", signal[k - 1]);
        }
    }
}
