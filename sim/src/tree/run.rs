//! A run: pieces of the valve signals, error control, chambers at vapour pressure, records.

use hydroflex_openapi::job::{RunFlag, SolverPath};
use hydroflex_openapi::machine::MachineFile;
use nalgebra::Matrix3;

use super::model::TreeModel;
use super::step::{Point, Signal, Stepper};
use crate::system::{State, Workspace};
use crate::trajectory::recorder::FlagSet;
use crate::trajectory::{ACCURATE_TOLERANCE, RunFailure, RunInput, SolverStatistics, Trajectory};

/// Local error over typical ranges that keeps this promise: on the published crane with the modes in the plane it leaves
/// 3.5e-4 of range (three times this number still 5e-4).
const LOCAL_TOLERANCE: f64 = 1e-4;
/// Attempts within one piece of signal before a run is given up.
const ATTEMPTS_PER_PIECE: u32 = 2000;
/// Attempts of a whole run, per piece of its signal: several hundred times what is usual.
const ATTEMPTS_MEAN: u64 = 200;
/// Shortest step, s.
const SHORTEST_S: f64 = 1e-9;
/// A chamber that empties or fills this close to the start of a step does so at its start, s.
const SWITCH_S: f64 = 1e-6;
/// A crossing of zero this close to a piece's end, in samples, is taken as being there.
const CROSSING_LEAST: f64 = 1e-6;

/// One run on its way.
struct Run<'a> {
    model: &'a TreeModel,
    input: &'a RunInput,
    sample_time_s: f64,
    per_tolerance2: f64,
    stepper: Stepper,
    state: Point,
    signals: Vec<Signal>,
    /// Step to try next, s.
    suggested_s: f64,
    /// First step of the last piece: what the kink at a piece's start asks for.
    first_s: f64,
    attempts: u64,
    statistics: SolverStatistics,
    flags: FlagSet,
    /// What the recorder reads.
    shown: (State, Workspace),
    columns: Vec<Vec<f64>>,
}

impl TreeModel {
    /// Simulates one run of the payload that the model carries. `tolerance` bounds the error of every channel but
    /// accelerations, over its usual range.
    ///
    /// # Errors
    /// [`RunFailure`] if the run cannot be finished.
    pub fn run(
        &self,
        file: &MachineFile,
        input: &RunInput,
        sample_time_s: f64,
        tolerance: f64,
    ) -> Result<Trajectory, RunFailure> {
        let mut stepper = Stepper::new(self);
        let state = self.rest(file, &input.angles_rad, &mut stepper.motion)?;
        let samples = input.valves_ratio.first().map_or(0, Vec::len);
        let local = LOCAL_TOLERANCE * tolerance / ACCURATE_TOLERANCE;
        let mut run = Run {
            model: self,
            input,
            sample_time_s,
            per_tolerance2: 1.0 / (local * local),
            stepper,
            state,
            signals: vec![Signal::default(); self.cylinders.len()],
            suggested_s: sample_time_s,
            first_s: sample_time_s,
            attempts: 0,
            statistics: SolverStatistics {
                path: SolverPath::Tree,
                ..SolverStatistics::default()
            },
            flags: FlagSet::default(),
            shown: (self.system.new_state(), self.system.new_workspace()),
            columns: self.recorder.new_columns(samples + 1),
        };
        run.record(0)?;
        let mut ends = Vec::new();
        for sample in 1..=samples {
            run.piece_ends(sample, &mut ends);
            let mut begin = 0.0;
            for &end in &ends {
                run.piece(sample, begin, end)?;
                begin = end;
            }
            run.record(sample)?;
        }
        Ok(Trajectory {
            sample_count: samples + 1,
            columns: run.columns,
            flags: run.flags.list(),
            statistics: run.statistics,
        })
    }
}

impl Run<'_> {
    /// Valve of a cylinder at a sample; the signal starts at zero.
    fn valve(&self, cylinder: usize, sample: usize) -> f64 {
        if sample == 0 {
            0.0
        } else {
            self.input.valves_ratio[cylinder][sample - 1]
        }
    }

    /// Ends of the pieces of a sample in which no valve changes sign, as parts of it; the last one is 1.
    fn piece_ends(&self, sample: usize, ends: &mut Vec<f64>) {
        ends.clear();
        for k in 0..self.signals.len() {
            let (before, after) = (self.valve(k, sample - 1), self.valve(k, sample));
            if before * after < 0.0 {
                ends.push(before / (before - after));
            }
        }
        ends.sort_unstable_by(f64::total_cmp);
        let mut last = 0.0;
        ends.retain(|&end| {
            let keep = end - last > CROSSING_LEAST && 1.0 - end > CROSSING_LEAST;
            if keep {
                last = end;
            }
            keep
        });
        ends.push(1.0);
    }

    /// Steps through a piece of a sample.
    fn piece(&mut self, sample: usize, begin: f64, end: f64) -> Result<(), RunFailure> {
        let length_s = (end - begin) * self.sample_time_s;
        let start_s = ((sample - 1) as f64 + begin) * self.sample_time_s;
        let mut at_s = 0.0;
        let mut attempts = 0;
        self.suggested_s = self.suggested_s.min(1.5 * self.first_s);
        while at_s < length_s * (1.0 - 1e-9) {
            let left = length_s - at_s;
            let h = if self.suggested_s >= left {
                left
            } else if self.suggested_s > 0.5 * left {
                0.5 * left
            } else {
                self.suggested_s
            };
            for k in 0..self.signals.len() {
                let (before, after) = (self.valve(k, sample - 1), self.valve(k, sample));
                let at = |part: f64| before + (after - before) * part;
                self.signals[k].per_s = (after - before) / self.sample_time_s;
                self.signals[k].ratio = at(begin + at_s / self.sample_time_s);
                // The sign of the middle: at its ends a piece may be zero, or beyond by rounding.
                self.signals[k].extends = at(0.5 * (begin + end)) >= 0.0;
            }
            attempts += 1;
            self.attempts += 1;
            self.statistics.factorisations += 1;
            let finished = self.stepper.step(self.model, &self.state, h, &self.signals);
            let error2 = if finished {
                self.stepper.error2 * self.per_tolerance2
            } else {
                f64::INFINITY
            };
            let finite = self.stepper.next.values.iter().all(|x| x.is_finite());
            let ideal = 0.9 / error2.max(1e-12).sqrt().sqrt().sqrt();
            // A NaN is a rejection.
            let passed = finite && error2 <= 1.0;
            let shorter = if passed {
                self.switch(h).map(|part| (h * part).max(SWITCH_S).min(h))
            } else if finite && error2.is_finite() {
                Some(h * ideal.clamp(0.1, 0.7))
            } else {
                Some(0.2 * h)
            };
            if let Some(shorter) = shorter {
                self.statistics.rejected += 1;
                let budget = ATTEMPTS_MEAN * self.input.valves_ratio[0].len() as u64;
                if shorter < SHORTEST_S || attempts >= ATTEMPTS_PER_PIECE || self.attempts > budget {
                    let t_s = start_s + at_s;
                    return Err(if finite {
                        RunFailure::NotConverged {
                            t_s,
                            iterations: attempts,
                            increment: error2.sqrt(),
                            tolerance: 1.0,
                        }
                    } else {
                        RunFailure::NotFinite {
                            quantity: "state",
                            t_s,
                        }
                    });
                }
                self.suggested_s = shorter;
                continue;
            }
            self.statistics.steps += 1;
            if at_s == 0.0 {
                // A piece shorter than the step that it could bear says nothing.
                self.first_s = if h < length_s { h } else { self.first_s.max(h) };
            }
            at_s += h;
            std::mem::swap(&mut self.state.values, &mut self.stepper.next.values);
            self.note();
            let grown = h * ideal.min(4.0);
            // A step cut short by the end of a piece says nothing against the last suggestion.
            self.suggested_s = if ideal >= 1.0 {
                grown.max(self.suggested_s)
            } else {
                grown
            };
        }
        Ok(())
    }

    /// Looks for a chamber that reaches its lowest pressure within the step, or leaves it. Returns the part of the
    /// step after which the first one does, if the step must be repeated.
    fn switch(&mut self, h: f64) -> Option<f64> {
        let mut first: Option<f64> = None;
        for (k, cylinder) in self.model.system.cylinders().iter().enumerate() {
            let valve = cylinder.valve();
            let band = 1e-5 * (valve.supply_pressure_pa - valve.tank_pressure_pa);
            for c in 0..2 {
                let floor = [&cylinder.piston, &cylinder.rod][c].floor_pa();
                if floor == f64::NEG_INFINITY {
                    continue;
                }
                let (start, end) = (self.stepper.rates[0][k][c], self.stepper.rates[1][k][c]);
                let (from, to) = (self.state.pressures(k)[c], self.stepper.next.pressures(k)[c]);
                let empty = &mut self.signals[k].empty[c];
                let part = if *empty {
                    if start > 0.0 {
                        *empty = false;
                        Some(1.0)
                    } else if end > 0.0 && h > SWITCH_S {
                        Some((start / (start - end)).clamp(0.0, 0.95))
                    } else {
                        None
                    }
                } else if to >= floor - band {
                    None
                } else if start <= 0.0 && from <= floor + band {
                    *empty = true;
                    self.state.set_pressure(k, c, floor);
                    self.flags.set(RunFlag::Cavitation);
                    Some(1.0)
                } else if h <= SWITCH_S {
                    None
                } else {
                    Some(((from - floor) / (from - to)).clamp(0.0, 0.95))
                };
                first = match (first, part) {
                    (Some(a), Some(b)) => Some(a.min(b)),
                    (a, b) => a.or(b),
                };
            }
        }
        first
    }

    /// Flags of the new state.
    fn note(&mut self) {
        for (k, cylinder) in self.model.system.cylinders().iter().enumerate() {
            let length_m = self.stepper.motion.lines[k].length_m;
            self.flags.watch(cylinder, length_m, self.state.pressures(k));
        }
    }

    /// Appends a sample.
    fn record(&mut self, sample: usize) -> Result<(), RunFailure> {
        let t_s = sample as f64 * self.sample_time_s;
        let (model, motion) = (self.model, &mut self.stepper.motion);
        if !model.evaluate_motion(self.state.u(), self.state.v(), self.state.a(), motion) {
            return Err(RunFailure::NotFinite {
                quantity: "closure of a loop",
                t_s,
            });
        }
        let (state, ws) = &mut self.shown;
        for (k, line) in motion.lines.iter().enumerate() {
            ws.cylinders[k].length_m = line.length_m;
            ws.cylinders[k].velocity_m_per_s = line.velocity_m_per_s;
            state.pressures_pa[k] = self.state.pressures(k);
        }
        for ((body, frame), out) in model.bodies.iter().zip(&motion.frames).zip(&mut ws.bodies) {
            let (sin, cos) = (frame.sin, frame.cos);
            out.rotation = Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
            out.omega_rad_per_s.z = frame.omega;
            out.alpha_rad_per_s2.z = frame.alpha;
            out.eta
                .copy_from_slice(&motion.y[body.first..body.first + body.modes()]);
        }
        let input = self.input;
        let valve = |k: usize| {
            if sample == 0 {
                0.0
            } else {
                input.valves_ratio[k][sample - 1]
            }
        };
        model
            .recorder
            .record(&model.system, state, ws, valve, &mut self.columns);
        if self
            .columns
            .iter()
            .filter_map(|c| c.last())
            .sum::<f64>()
            .is_finite()
        {
            Ok(())
        } else {
            Err(RunFailure::NotFinite {
                quantity: "sample",
                t_s,
            })
        }
    }
}
