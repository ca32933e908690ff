//! Bookkeeping of one run in one lane: where it is in its signal, how long the next step is, what
//! happened so far.

use super::constants::Cylinder;
use super::record::MACHINE_CHANNELS;
use super::schedule::{Piece, pieces};
use crate::trajectory::{RunFailure, RunInput, SolverStatistics, Trajectory};
use hydroflex_openapi::job::{RunFlag, SolverPath};

/// Attempts within one piece of signal before a run is given up: two thousand times the usual one.
const ATTEMPTS: u32 = 2000;
/// Shortest step, s: a hundred thousandth of the fastest oil transient.
const SHORTEST_S: f64 = 1e-9;
/// Part of the pressure range around a chamber's line in which a step may end with a twelfth of the usual
/// error only: the flow's slope has no bound at equal pressures, and the estimate, which comes from the
/// same stages, sees little of it. The same where a step crosses the line.
const LINE_BAND: f64 = 0.03;
pub(super) const LINE_CAUTION: f64 = 12.0;
/// Friction turns over within its transition velocity, often within one step, and its force is too
/// small for the error estimate to see; the acceleration at the end of the step sees it. So the last step
/// before a sample may change the speed by at most this many transition velocities …
const REVERSAL_MOST: f64 = 0.7;
/// … if the speed came closer to zero than this many, and ends within that many; farther away the
/// acceleration has recovered.
const REVERSAL_TOUCHES: f64 = 1.2;
const REVERSAL_ENDS: f64 = 6.0;
/// Change of speed, in transition velocities, that is left for the last step when another is cut.
const REVERSAL_LEAVES: f64 = 0.4;
/// Steps shorter than this are not cut for friction, s.
const REVERSAL_SHORTEST_S: f64 = 1e-5;
/// A constraint that switches this close to the start of a step switches at its start, s.
const SWITCH_S: f64 = 1e-6;

/// One run on its way.
#[derive(Debug)]
pub(super) struct Track<'a> {
    /// Position in the batch.
    pub(super) job: usize,
    input: &'a RunInput,
    sample_time_s: f64,
    line_caution2: f64,
    /// Samples reached.
    sample: usize,
    /// A sample waits to be recorded with the rates at the start of the coming step.
    pub(super) record_due: bool,
    piece: Piece,
    later: Option<Piece>,
    at_s: f64,
    /// Angular acceleration at the start of the coming step; zero at rest.
    pub(super) alpha: f64,
    /// Step under way, s.
    pub(super) step_s: f64,
    suggested_s: f64,
    attempts: u32,
    /// The valve is held shut in this piece.
    shut: bool,
    /// Chambers at vapour pressure.
    pub(super) empty: [bool; 2],
    flags: u8,
    statistics: SolverStatistics,
    columns: Vec<Vec<f64>>,
}

/// What a step did in this lane.
#[derive(Debug, Clone, Copy)]
pub(super) struct Outcome {
    /// Σ (error/scale)² over tolerance².
    pub(super) error2: f64,
    /// Pressures at both ends, Pa.
    pub(super) pressure_pa: [[f64; 2]; 2],
    /// Pressure rates of filled chambers at both ends, Pa/s.
    pub(super) rate: [[f64; 2]; 2],
    /// Angular acceleration at the end, rad/s².
    pub(super) alpha: f64,
    /// Rod speed at the end, m/s.
    pub(super) speed_m_per_s: f64,
    /// Lowest and highest rod speed among the stages, m/s.
    pub(super) speed_range_m_per_s: [f64; 2],
    /// Length at the end, m.
    pub(super) length_m: f64,
    /// Whether every number of the new state is finite.
    pub(super) finite: bool,
}

/// What to do next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Take the new state; chambers named sit at vapour pressure from now on.
    Accept,
    /// Try again from the old state.
    Repeat,
}

impl<'a> Track<'a> {
    /// Starts a run at its equilibrium.
    pub(super) fn new(
        job: usize,
        input: &'a RunInput,
        sample_time_s: f64,
        line_caution2: f64,
        channels: usize,
        length_m: f64,
        cylinder: &Cylinder,
    ) -> Self {
        let rows = input.valves_ratio[0].len() + 1;
        let mut track = Self {
            job,
            input,
            sample_time_s,
            line_caution2,
            sample: 0,
            record_due: true,
            piece: Piece {
                length_s: sample_time_s,
                from: 0.0,
                to: 0.0,
            },
            later: None,
            at_s: 0.0,
            alpha: 0.0,
            step_s: 0.0,
            suggested_s: sample_time_s,
            attempts: 0,
            shut: false,
            empty: [false; 2],
            flags: 0,
            statistics: SolverStatistics {
                path: SolverPath::Planar,
                ..SolverStatistics::default()
            },
            columns: (0..channels).map(|_| Vec::with_capacity(rows)).collect(),
        };
        track.enter_sample(length_m, cylinder);
        track
    }

    fn valve(&self) -> &'a [f64] {
        &self.input.valves_ratio[0]
    }

    /// Time of the run, s.
    pub(super) fn time_s(&self) -> f64 {
        let before = if self.later.is_none() && self.piece.length_s < self.sample_time_s {
            self.sample_time_s - self.piece.length_s
        } else {
            0.0
        };
        self.sample as f64 * self.sample_time_s + before + self.at_s
    }

    /// Valve signal at the last sample reached; step 0 is shut.
    pub(super) fn valve_at_sample(&self) -> f64 {
        match self.sample {
            0 => 0.0,
            k => self.valve()[k - 1],
        }
    }

    fn enter_sample(&mut self, length_m: f64, cylinder: &Cylinder) {
        if let Some(&to) = self.valve().get(self.sample) {
            (self.piece, self.later) = pieces(self.valve_at_sample(), to, self.sample_time_s);
        }
        self.enter_piece(length_m, cylinder);
    }

    fn enter_piece(&mut self, length_m: f64, cylinder: &Cylinder) {
        self.at_s = 0.0;
        self.attempts = 0;
        self.shut = cylinder
            .cutoff_m
            .is_some_and(|[least, most]| length_m < least || length_m > most);
        if self.shut && self.sample < self.valve().len() {
            self.raise(RunFlag::StrokeCutoff);
        }
    }

    /// Chooses the coming step.
    pub(super) fn plan(&mut self) {
        let left = self.piece.length_s - self.at_s;
        self.step_s = if self.suggested_s >= left {
            left
        } else if self.suggested_s > 0.5 * left {
            0.5 * left
        } else {
            self.suggested_s
        };
    }

    /// Opening at the start of the coming step, its rate, and the lines of the two chambers.
    pub(super) fn valve_state(&self, cylinder: &Cylinder) -> (f64, f64, [f64; 2]) {
        let (opening, rate) = if self.shut {
            (0.0, 0.0)
        } else {
            self.piece.opening(self.at_s)
        };
        let lines = if self.piece.extends() {
            [cylinder.supply_pa, cylinder.tank_pa]
        } else {
            [cylinder.tank_pa, cylinder.supply_pa]
        };
        (opening, rate, lines)
    }

    /// Judges a step and plans the next attempt.
    pub(super) fn judge(&mut self, outcome: &Outcome, cylinder: &Cylinder) -> Result<Verdict, RunFailure> {
        self.attempts += 1;
        self.statistics.factorisations += 1;
        let error2 = if self.meets_line(outcome, cylinder) {
            outcome.error2 * self.line_caution2
        } else {
            outcome.error2
        };
        // Written so that a NaN is a rejection.
        let passed = outcome.finite && error2 <= 1.0;
        // error^(-1/4) from its square; the estimate's order is 3 or 4.
        let ideal = 0.9 / error2.max(1e-12).sqrt().sqrt().sqrt();
        if !passed {
            self.statistics.rejected += 1;
            let factor = if outcome.finite && error2.is_finite() {
                ideal.clamp(0.1, 0.7)
            } else {
                0.2
            };
            return self.retry(self.step_s * factor, outcome);
        }
        if let Some(part) = self.switches(outcome, cylinder) {
            self.statistics.rejected += 1;
            let shorter = (self.step_s * part).max(SWITCH_S);
            return self.retry(shorter.min(self.step_s), outcome);
        }
        if let Some(part) = self.reverses(outcome, cylinder) {
            self.statistics.rejected += 1;
            return self.retry(self.step_s * part, outcome);
        }
        self.statistics.steps += 1;
        self.at_s += self.step_s;
        self.alpha = outcome.alpha;
        let grown = self.step_s * ideal.min(4.0);
        // A step cut short by the end of a piece says nothing against the last suggestion.
        self.suggested_s = if ideal >= 1.0 {
            grown.max(self.suggested_s)
        } else {
            grown
        };
        self.note(outcome, cylinder);
        if self.at_s >= self.piece.length_s * (1.0 - 1e-9) {
            if let Some(later) = self.later.take() {
                self.piece = later;
                self.enter_piece(outcome.length_m, cylinder);
            } else {
                self.sample += 1;
                self.record_due = true;
                self.enter_sample(outcome.length_m, cylinder);
            }
        }
        Ok(Verdict::Accept)
    }

    fn retry(&mut self, step_s: f64, outcome: &Outcome) -> Result<Verdict, RunFailure> {
        if step_s < SHORTEST_S || self.attempts >= ATTEMPTS {
            return Err(if outcome.finite {
                RunFailure::NotConverged {
                    t_s: self.time_s(),
                    iterations: self.attempts,
                    increment: outcome.error2.sqrt(),
                    tolerance: 1.0,
                }
            } else {
                RunFailure::NotFinite {
                    quantity: "state",
                    t_s: self.time_s(),
                }
            });
        }
        self.suggested_s = step_s;
        Ok(Verdict::Repeat)
    }

    /// Whether a chamber ends close to the pressure of its line, or passes it, with the valve open.
    fn meets_line(&self, outcome: &Outcome, cylinder: &Cylinder) -> bool {
        let shut = self.shut || (self.piece.from == 0.0 && self.piece.to == 0.0);
        if shut {
            return false;
        }
        let (_, _, lines) = self.valve_state(cylinder);
        let band = LINE_BAND * (cylinder.supply_pa - cylinder.tank_pa);
        (0..2).any(|i| {
            let before = lines[i] - outcome.pressure_pa[0][i];
            let after = lines[i] - outcome.pressure_pa[1][i];
            !self.empty[i] && (after.abs() < band || before * after < 0.0)
        })
    }

    /// Looks for friction that turns over in a step that ends at a sample. Returns the part of the step
    /// to take first, if it must be repeated.
    fn reverses(&self, outcome: &Outcome, cylinder: &Cylinder) -> Option<f64> {
        let width = cylinder.reversal_m_per_s;
        let at_sample = self.later.is_none() && self.step_s >= self.piece.length_s - self.at_s;
        if width <= 0.0 || !at_sample || self.step_s < REVERSAL_SHORTEST_S {
            return None;
        }
        let [low, high] = outcome.speed_range_m_per_s.map(|v| v / width);
        let change = high - low;
        let touches = low < REVERSAL_TOUCHES && high > -REVERSAL_TOUCHES;
        let ends = outcome.speed_m_per_s.abs() < REVERSAL_ENDS * width;
        (touches && ends && change > REVERSAL_MOST).then(|| (1.0 - REVERSAL_LEAVES / change).clamp(0.3, 0.95))
    }

    /// Looks for a chamber that reaches vapour pressure or leaves it within the step. Returns the
    /// part of the step after which it does, if the step must be repeated.
    fn switches(&mut self, outcome: &Outcome, cylinder: &Cylinder) -> Option<f64> {
        let floor = cylinder.floor_pa;
        if floor == f64::NEG_INFINITY {
            return None;
        }
        // Undershoot that is cut off without being located: a hundred thousandth of the range.
        let band = 1e-5 * (cylinder.supply_pa - cylinder.tank_pa);
        let mut first: Option<f64> = None;
        for i in 0..2 {
            let [start, end] = [outcome.rate[0][i], outcome.rate[1][i]];
            let part = if self.empty[i] {
                if start > 0.0 {
                    self.empty[i] = false;
                    Some(1.0)
                } else if end > 0.0 && self.step_s > SWITCH_S {
                    Some(start / (start - end))
                } else {
                    None
                }
            } else {
                let (from, to) = (outcome.pressure_pa[0][i], outcome.pressure_pa[1][i]);
                if to >= floor - band {
                    None
                } else if start <= 0.0 && from <= floor + band {
                    self.empty[i] = true;
                    self.raise(RunFlag::Cavitation);
                    Some(1.0)
                } else if self.step_s <= SWITCH_S {
                    None
                } else {
                    Some(((from - floor) / (from - to)).clamp(0.0, 0.95))
                }
            };
            first = match (first, part) {
                (Some(a), Some(b)) => Some(a.min(b)),
                (a, b) => a.or(b),
            };
        }
        first
    }

    /// Raises flags that the new state deserves.
    fn note(&mut self, outcome: &Outcome, cylinder: &Cylinder) {
        let stroke = outcome.length_m - cylinder.closed_length_m;
        if stroke < 0.0 || stroke > cylinder.stroke_m {
            self.raise(RunFlag::EndStop);
        }
        for pressure in outcome.pressure_pa[1] {
            if pressure < cylinder.tank_pa {
                self.raise(RunFlag::BelowTankPressure);
            }
            if pressure > cylinder.supply_pa {
                self.raise(RunFlag::AboveSupplyPressure);
            }
            if pressure <= cylinder.floor_pa.max(0.0) {
                self.raise(RunFlag::Cavitation);
            }
        }
    }

    fn raise(&mut self, flag: RunFlag) {
        self.flags |= 1 << flag as u8;
    }

    /// Appends a row.
    pub(super) fn record(
        &mut self,
        machine: &[f64; MACHINE_CHANNELS],
        sensor: impl Fn(usize) -> f64,
    ) -> Result<(), RunFailure> {
        self.record_due = false;
        // One sum finds any NaN or infinity among accelerations, forces, pressures and motion.
        if !machine.iter().sum::<f64>().is_finite() {
            return Err(RunFailure::NotFinite {
                quantity: "sample",
                t_s: self.time_s(),
            });
        }
        let (own, sensors) = self.columns.split_at_mut(MACHINE_CHANNELS);
        for (column, x) in own.iter_mut().zip(machine) {
            column.push(*x);
        }
        for (k, column) in sensors.iter_mut().enumerate() {
            column.push(sensor(k));
        }
        Ok(())
    }

    /// Whether the last sample is recorded.
    pub(super) fn done(&self) -> bool {
        !self.record_due && self.sample == self.valve().len()
    }

    /// The finished run.
    pub(super) fn finish(self) -> Trajectory {
        let flags = [
            RunFlag::StrokeCutoff,
            RunFlag::EndStop,
            RunFlag::Cavitation,
            RunFlag::BelowTankPressure,
            RunFlag::AboveSupplyPressure,
        ];
        Trajectory {
            sample_count: self.sample + 1,
            columns: self.columns,
            flags: flags
                .into_iter()
                .filter(|&f| self.flags & 1 << f as u8 != 0)
                .collect(),
            statistics: self.statistics,
        }
    }
}
