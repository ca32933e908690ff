//! Runs in lock-step, one per lane, each with its own time, step and constraints.
//!
//! Lanes share the instructions and nothing else: a run's numbers do not depend on its neighbours.

use super::constants::Constants;
use super::dynamics::{Point, Regime};
use super::lane::Lane;
use super::record::machine_channels;
use super::statics::rest;
use super::step::{StepBuffer, step};
use super::sums::sums;
use super::tableau::{RODAS5P, Tableau};
use super::track::{Outcome, Track, Verdict};
use crate::trajectory::{RunFailure, RunInput, Trajectory};

/// Result of one run of a batch.
pub(super) type RunResult = Result<Trajectory, RunFailure>;

/// What all runs of a batch have in common.
#[derive(Debug, Clone, Copy)]
pub(super) struct Common {
    /// Time between samples, s.
    pub(super) sample_time_s: f64,
    /// Reciprocal squared local tolerance.
    pub(super) per_tolerance2: f64,
    /// Method.
    pub(super) method: &'static Tableau,
}

impl Common {
    /// `tolerance` is the promised largest error of a channel over its range. Local errors add up
    /// and the stiff modes lower the order, so the local tolerance falls with its square; the factor
    /// is measured on the published boom (`sim/theory/minimal_coordinates.md`, §6).
    pub(super) fn new(sample_time_s: f64, tolerance: f64) -> Self {
        let local = (700.0 * tolerance * tolerance).clamp(1e-12, 1e-2);
        Self {
            sample_time_s,
            per_tolerance2: 1.0 / (local * local),
            method: &RODAS5P,
        }
    }
}

/// Simulates `inputs` in the order of `jobs` and puts each result into its place of `results`.
#[inline(always)]
pub(super) fn simulate<L: Lane, const N: usize, const A: usize>(
    c: &Constants<N, A>,
    common: &Common,
    inputs: &[RunInput],
    jobs: &[usize],
    buffer: &mut StepBuffer<L, N>,
    results: &mut [Option<RunResult>],
) {
    let zero = L::splat(0.0);
    let cylinder = &c.cylinder;
    let channels = super::record::MACHINE_CHANNELS + c.readouts.len();
    let mut queue = jobs.iter();
    let mut tracks: Vec<Option<Track<'_>>> = (0..L::WIDTH).map(|_| None).collect();
    let mut state = Point::<L, N>::zero();
    let mut step_s = L::splat(common.sample_time_s);
    let mut regime = Regime {
        opening: zero,
        opening_per_s: zero,
        line_pa: [L::splat(cylinder.supply_pa), L::splat(cylinder.tank_pa)],
        filled: [L::splat(1.0); 2],
    };
    let mut readings = vec![zero; c.sensors.len()];
    // A lane without a run keeps computing; start it where a run starts, so that it stays finite.
    let mut idle_ready = false;
    loop {
        let mut busy = false;
        for lane in 0..L::WIDTH {
            while tracks[lane].is_none() {
                let Some(&job) = queue.next() else { break };
                match rest(c, inputs[job].angles_rad[0]) {
                    Ok(start) => {
                        if !idle_ready {
                            idle_ready = true;
                            for other in 0..L::WIDTH {
                                load(&mut state, other, &start.state, c.used);
                            }
                        }
                        load(&mut state, lane, &start.state, c.used);
                        let track = Track::new(
                            job,
                            &inputs[job],
                            common.sample_time_s,
                            channels,
                            start.length_m,
                            cylinder,
                        );
                        tracks[lane] = Some(track);
                    }
                    Err(failure) => results[job] = Some(Err(failure)),
                }
            }
            if let Some(track) = &mut tracks[lane] {
                busy = true;
                track.plan();
                step_s.set(lane, track.step_s);
                let (opening, rate, lines) = track.valve_state(cylinder);
                regime.opening.set(lane, opening);
                regime.opening_per_s.set(lane, rate);
                for i in 0..2 {
                    regime.line_pa[i].set(lane, lines[i]);
                    let filled = if track.empty[i] { 0.0 } else { 1.0 };
                    regime.filled[i].set(lane, filled);
                    if track.empty[i] {
                        state.p[i].set(lane, cylinder.floor_pa);
                    }
                }
            }
        }
        if !busy {
            return;
        }
        step(c, common.method, &state, step_s, &regime, buffer);
        if tracks.iter().flatten().any(|t| t.record_due) {
            let count = L::trip(N, c.used);
            for (reading, row) in readings.iter_mut().zip(&c.sensors) {
                let [sum] = sums(count, |i| [state.z[i] * L::splat(row[i])]);
                *reading = sum;
            }
        }
        let error2 = buffer.error2 * L::splat(common.per_tolerance2);
        for lane in 0..L::WIDTH {
            let Some(mut track) = tracks[lane].take() else {
                continue;
            };
            match advance(&mut track, &state, buffer, &readings, error2.get(lane), lane, c) {
                Ok(Some(Verdict::Accept)) => {
                    take(&mut state, lane, &buffer.next, c.used);
                    tracks[lane] = Some(track);
                }
                Ok(Some(Verdict::Repeat)) => tracks[lane] = Some(track),
                Ok(None) => {
                    let job = track.job;
                    results[job] = Some(Ok(track.finish()));
                }
                Err(failure) => results[track.job] = Some(Err(failure)),
            }
        }
    }
}

/// Records and judges one lane; `None` when the run is finished.
#[inline(always)]
fn advance<L: Lane, const N: usize, const A: usize>(
    track: &mut Track<'_>,
    state: &Point<L, N>,
    buffer: &StepBuffer<L, N>,
    readings: &[L],
    error2: f64,
    lane: usize,
    c: &Constants<N, A>,
) -> Result<Option<Verdict>, RunFailure> {
    if track.record_due {
        let machine = machine_channels(track.valve_at_sample(), track.alpha, state, &buffer.start, lane);
        track.record(&machine, |k| c.readouts[k].value(readings, lane))?;
        if track.done() {
            return Ok(None);
        }
    }
    let next = &buffer.next;
    let both = |f: fn(&super::dynamics::Rates<L, N>) -> &[L; 2]| {
        let (a, b) = (f(&buffer.start), f(&buffer.end));
        [[a[0].get(lane), a[1].get(lane)], [b[0].get(lane), b[1].get(lane)]]
    };
    let outcome = Outcome {
        error2,
        pressure_pa: [
            [state.p[0].get(lane), state.p[1].get(lane)],
            [next.p[0].get(lane), next.p[1].get(lane)],
        ],
        rate: both(|r| &r.p_raw),
        alpha: buffer.alpha.get(lane),
        length_m: buffer.end.length.get(lane),
        finite: (next.p[0].get(lane) + next.p[1].get(lane) + next.omega.get(lane)).is_finite(),
    };
    track.judge(&outcome, &c.cylinder).map(Some)
}

fn load<L: Lane, const N: usize>(state: &mut Point<L, N>, lane: usize, from: &Point<f64, N>, used: usize) {
    state.theta.set(lane, from.theta);
    state.omega.set(lane, from.omega);
    for i in 0..used {
        state.z[i].set(lane, from.z[i]);
        state.v[i].set(lane, from.v[i]);
    }
    for i in 0..2 {
        state.p[i].set(lane, from.p[i]);
    }
}

/// Copies one lane.
#[inline(always)]
fn take<L: Lane, const N: usize>(state: &mut Point<L, N>, lane: usize, from: &Point<L, N>, used: usize) {
    if L::WIDTH == 1 {
        *state = *from;
        return;
    }
    state.theta.set(lane, from.theta.get(lane));
    state.omega.set(lane, from.omega.get(lane));
    for i in 0..used {
        state.z[i].set(lane, from.z[i].get(lane));
        state.v[i].set(lane, from.v[i].get(lane));
    }
    for i in 0..2 {
        state.p[i].set(lane, from.p[i].get(lane));
    }
}
