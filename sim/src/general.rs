//! The general path: a run in redundant coordinates, for any machine.

use hydroflex_openapi::channel::Channel;
use hydroflex_openapi::job::RunFlag;

use crate::integrate::{Newton, Scheme, Stepper};
use crate::system::{State, System};
use crate::trajectory::recorder::{FlagSet, Recorder};
use crate::trajectory::{ACCURATE_TOLERANCE, RunFailure, Trajectory};

/// Spectral radius of the scheme behind accurate runs: it damps what no step resolves, and keeps
/// the joints closed.
const SPECTRAL_RADIUS: f64 = 0.7;
/// Longest step with which an accurate run starts, s.
const STEP_LONGEST_S: f64 = 1.01e-3;
/// Shortest one, s. Runs whose valve chatters at the stroke cut-off never settle; they end here.
const STEP_SHORTEST_S: f64 = 1e-5;
/// Steps into which every step of the first sample is cut where the start is not at rest: what is left of the static
/// solution settles faster than anything that follows, and would alone decide the step of the whole run.
const FIRST_SAMPLE_PARTS: u32 = 16;
/// Shortest piece of a sample between kinks, as part of it: closer to a sample's end a kink is taken as being there.
const PIECE_LEAST: f64 = 1e-3;
/// Part of a step by which the steps of a piece may be longer than asked for, before there is one more of them.
const STEP_STRETCH: f64 = 0.25;
/// Largest change of a channel between the last two step sizes, relative to the channel's range, at which the two are extrapolated.
/// Halving the step of a second-order scheme leaves a third of that change as error; the extrapolation takes most
/// of it away (nine tenths on the published crane, two thirds are needed for 1e-3).
const CHANGE_EXTRAPOLATED_MOST: f64 = 8e-3;
/// The same where extrapolation is out of place, because something switches.
const CHANGE_MOST: f64 = 1e-3;

/// One run and what it needs.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GeneralRun<'a> {
    pub(crate) system: &'a System,
    pub(crate) recorder: &'a Recorder,
    pub(crate) start: &'a State,
    /// One list per cylinder, all of one length.
    pub(crate) valves_ratio: &'a [Vec<f64>],
    pub(crate) sample_time_s: f64,
}

/// Where steps end within a sample.
#[derive(Debug, Clone, Copy)]
struct Grid {
    /// Steps of the coarsest grid.
    coarse_per_sample: u32,
    /// Parts of every such step.
    parts: u32,
    /// Parts of every one of these in the first sample.
    parts_first: u32,
    /// Also where a valve signal crosses zero: there the metering edge changes, and a step across
    /// that kink would lose the scheme's order.
    split_at_zero: bool,
}

impl GeneralRun<'_> {
    /// A fixed number of equal steps per sample.
    pub(crate) fn fixed(&self, scheme: Scheme, steps_per_sample: u32) -> Result<Trajectory, RunFailure> {
        let grid = Grid {
            coarse_per_sample: steps_per_sample,
            parts: 1,
            parts_first: 1,
            split_at_zero: false,
        };
        self.march(scheme, Newton::EXACT, grid)
    }

    /// Halves the step until the channels settle, and extrapolates the last two step sizes to a vanishing one
    /// (Richardson): `x = x_f + (x_f − x_c)/3` for a scheme of second order.
    ///
    /// Where a chamber empties or a cylinder reaches its end the order is lost, and only the finer run counts.
    /// `tolerance` bounds the error of every channel but accelerations, over its range ([`ACCURATE_TOLERANCE`] by default).
    pub(crate) fn accurate(&self, channels: &[Channel], tolerance: f64) -> Result<Trajectory, RunFailure> {
        let tighter = tolerance / ACCURATE_TOLERANCE;
        let newton = if tighter < 1.0 {
            Newton::EXACT
        } else {
            Newton::FRUGAL
        };
        let scheme = Scheme::generalized_alpha(SPECTRAL_RADIUS);
        let resolutions: Vec<f64> = channels.iter().map(resolution).collect();
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "small and positive"
        )]
        let coarsest = (self.sample_time_s / STEP_LONGEST_S).ceil().clamp(1.0, 1e6) as u32;
        let first_parts = match self.system.conventions.statics {
            Some(_) => FIRST_SAMPLE_PARTS,
            None => 1,
        };
        let march = |parts| {
            let grid = Grid {
                coarse_per_sample: coarsest,
                parts,
                parts_first: first_parts,
                split_at_zero: true,
            };
            self.march(scheme, newton, grid)
        };
        let mut parts = 1;
        let mut coarse = march(parts)?;
        loop {
            parts *= 2;
            let mut fine = march(parts)?;
            fine.statistics.steps += coarse.statistics.steps;
            fine.statistics.rejected += coarse.statistics.rejected;
            fine.statistics.iterations += coarse.statistics.iterations;
            fine.statistics.factorisations += coarse.statistics.factorisations;
            let change = change(&coarse, &fine, &resolutions);
            let switches = |run: &Trajectory| {
                let kinks = [RunFlag::Cavitation, RunFlag::EndStop, RunFlag::StrokeCutoff];
                run.flags.iter().any(|flag| kinks.contains(flag))
            };
            if change <= tighter * CHANGE_EXTRAPOLATED_MOST && !switches(&coarse) && !switches(&fine) {
                extrapolate(&coarse, &mut fine);
                return Ok(fine);
            }
            if change <= tighter * CHANGE_MOST
                || self.sample_time_s / f64::from(coarsest * parts) < STEP_SHORTEST_S
            {
                return Ok(fine);
            }
            coarse = fine;
        }
    }

    /// Valve of a cylinder at a sample; the signal starts at zero.
    fn valve(&self, cylinder: usize, sample: usize) -> f64 {
        if sample == 0 {
            0.0
        } else {
            self.valves_ratio[cylinder][sample - 1]
        }
    }

    fn march(&self, scheme: Scheme, newton: Newton, grid: Grid) -> Result<Trajectory, RunFailure> {
        let cylinders = self.system.cylinders();
        let samples = self.valves_ratio.first().map_or(0, Vec::len);
        let mut columns = self.recorder.new_columns(samples + 1);
        let mut flags = FlagSet::default();
        let (mut from, mut to) = (vec![0.0; cylinders.len()], vec![0.0; cylinders.len()]);
        let steps = (grid.coarse_per_sample as usize + cylinders.len() + 1)
            * (grid.parts * grid.parts_first) as usize;
        let mut ends = Vec::with_capacity(steps + cylinders.len() + 2);
        let mut stepper = Stepper::with_newton(self.system, scheme, newton, self.start.clone())?;
        let record = |stepper: &Stepper<'_>, sample, columns: &mut Vec<Vec<f64>>| {
            let valves = |k| self.valve(k, sample);
            self.recorder
                .record(self.system, &stepper.state, &stepper.workspace, valves, columns);
        };
        record(&stepper, 0, &mut columns);
        for sample in 1..=samples {
            self.step_ends(grid, sample, &mut ends);
            let mut begin = 0.0;
            for &end in &ends {
                for (k, cylinder) in cylinders.iter().enumerate() {
                    let (before, after) = (self.valve(k, sample - 1), self.valve(k, sample));
                    from[k] = before + (after - before) * begin;
                    // The last step ends exactly on the sample's value.
                    to[k] = if end >= 1.0 {
                        after
                    } else {
                        before + (after - before) * end
                    };
                    if cylinder.is_cut_off(stepper.workspace.cylinders[k].length_m) {
                        (from[k], to[k]) = (0.0, 0.0);
                        flags.set(RunFlag::StrokeCutoff);
                    }
                }
                let t_s = self.sample_time_s * ((sample - 1) as f64 + begin);
                stepper.advance(t_s, self.sample_time_s * (end - begin), &from, &to)?;
                for (k, cylinder) in cylinders.iter().enumerate() {
                    let length_m = stepper.workspace.cylinders[k].length_m;
                    flags.watch(cylinder, length_m, stepper.state.pressures_pa[k]);
                }
                begin = end;
            }
            record(&stepper, sample, &mut columns);
        }
        Ok(Trajectory {
            sample_count: samples + 1,
            columns,
            flags: flags.list(),
            statistics: stepper.statistics,
        })
    }

    /// Ends of the steps of a sample, as parts of it: ascending, the last one is 1.
    fn step_ends(&self, grid: Grid, sample: usize, ends: &mut Vec<f64>) {
        ends.clear();
        let halvings = if sample == 1 {
            grid.parts * grid.parts_first
        } else {
            grid.parts
        };
        // Kinks first …
        if grid.split_at_zero {
            for k in 0..self.valves_ratio.len() {
                let (before, after) = (self.valve(k, sample - 1), self.valve(k, sample));
                if before * after < 0.0 {
                    ends.push(before / (before - after));
                }
            }
            ends.sort_unstable_by(f64::total_cmp);
            let mut last = 0.0;
            ends.retain(|&end| {
                let keep = end - last > PIECE_LEAST && 1.0 - end > PIECE_LEAST;
                if keep {
                    last = end;
                }
                keep
            });
        }
        ends.push(1.0);
        // … then equal steps between them: every step of a finer grid is half a step of the coarser one, without
        // which the error would not fall to a quarter and could not be extrapolated.
        let pieces = ends.len();
        let mut begin = 0.0;
        for piece in 0..pieces {
            let end = ends[piece];
            #[expect(
                clippy::cast_possible_truncation,
                clippy::cast_sign_loss,
                reason = "between 1 and the steps of a sample"
            )]
            let coarse = ((end - begin) * f64::from(grid.coarse_per_sample) - STEP_STRETCH)
                .ceil()
                .max(1.0) as u32;
            let steps = coarse * halvings;
            let at = |k: u32| begin + (end - begin) * f64::from(k) / f64::from(steps);
            ends.extend((1..steps).map(at));
            begin = end;
        }
        ends.sort_unstable_by(f64::total_cmp);
    }
}

/// Takes the error of second order out of the finer run.
fn extrapolate(coarse: &Trajectory, fine: &mut Trajectory) {
    for (a, b) in coarse.columns.iter().zip(&mut fine.columns) {
        for (x, y) in a.iter().zip(b) {
            *y += (*y - x) / 3.0;
        }
    }
}

/// Largest difference of a channel, relative to its range in the finer run or to its resolution, whichever
/// is larger.
fn change(coarse: &Trajectory, fine: &Trajectory, resolutions: &[f64]) -> f64 {
    let mut largest = 0.0_f64;
    for ((a, b), resolution) in coarse.columns.iter().zip(&fine.columns).zip(resolutions) {
        let (low, high) = b.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| {
            (l.min(*x), h.max(*x))
        });
        let scale = (high - low).max(*resolution);
        for (x, y) in a.iter().zip(b) {
            largest = largest.max((x - y).abs() / scale);
        }
    }
    largest
}

/// Range below which a channel counts as still: a machine at rest need not be resolved in its
/// rounding. Accelerations are never judged.
fn resolution(channel: &Channel) -> f64 {
    match channel.unit.as_str() {
        "m" | "rad" => 1e-5,
        "m/s" | "rad/s" => 1e-4,
        "Pa" => 1e4,
        "N" => 1e2,
        "rad/s^2" => f64::INFINITY,
        _ => 1e-8,
    }
}

#[cfg(test)]
#[path = "general_tests.rs"]
mod tests;
