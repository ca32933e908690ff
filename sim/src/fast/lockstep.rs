//! Runs in lock-step, one per lane, each with its own time, step and constraints.
//!
//! Lanes share the instructions and nothing else: a run's numbers do not depend on its neighbours.

use super::constants::{Constants, Cylinder};
use super::dynamics::{Point, Rates, Regime};
use super::lane::{Coefficient, Lane};
use super::model::PlanarModel;
use super::record::machine_channels;
use super::statics::rest;
use super::step::{StepBuffer, step};
use super::sums::sums;
use super::tableau::{RODAS5P, Tableau};
use super::track::{LINE_CAUTION, Outcome, Track, Verdict};
use crate::simulator::SimulatorError;
use crate::trajectory::{RunFailure, RunInput, Trajectory};

/// Result of one run of a batch.
pub(super) type RunResult = Result<Trajectory, RunFailure>;

/// Smallest local tolerance: below it the error estimate is rounding.
const LEAST_LOCAL: f64 = 5e-9;

/// What all runs of a batch have in common.
#[derive(Debug, Clone, Copy)]
pub(super) struct Common {
    /// Time between samples, s.
    pub(super) sample_time_s: f64,
    /// Promised largest error of a channel over its range.
    pub(super) tolerance: f64,
    /// Reciprocal squared local tolerance.
    pub(super) per_tolerance2: f64,
    /// Squared part of the usual error that is accepted where oil meets its line, as a reciprocal.
    pub(super) line_caution2: f64,
    /// Method.
    pub(super) method: &'static Tableau,
}

impl Common {
    /// `tolerance` is the promised largest error of a channel over its range. Local errors add up
    /// and the stiff modes lower the order, so the local tolerance falls with its square; the factor
    /// is measured on the published boom (`sim/theory/minimal_coordinates.md`, §6).
    pub(super) fn new(sample_time_s: f64, tolerance: f64) -> Self {
        let local = (400.0 * tolerance * tolerance).clamp(LEAST_LOCAL, 1e-2);
        let caution = LINE_CAUTION.min(local / LEAST_LOCAL);
        Self {
            sample_time_s,
            tolerance,
            per_tolerance2: 1.0 / (local * local),
            line_caution2: caution * caution,
            method: &RODAS5P,
        }
    }
}

/// Where the constants of a run come from.
pub(super) trait Bodies<L, const A: usize, const B: usize, const Q: usize> {
    /// What a constant is.
    type Constant: Coefficient<L>;

    /// The cylinder, which all runs have in common.
    fn cylinder(&self) -> &Cylinder;

    /// Makes the lane ready for a run and gives its constants; `None` if they do not fit the sizes of
    /// this loop, and the run is left without a result.
    fn enter(
        &mut self,
        lane: usize,
        input: &RunInput,
    ) -> Result<Option<&Constants<f64, A, B, Q>>, RunFailure>;

    /// Those of all lanes; `None` before the first run.
    fn constants(&self) -> Option<&Constants<Self::Constant, A, B, Q>>;
}

/// All runs have the same payload.
impl<L: Lane, const A: usize, const B: usize, const Q: usize> Bodies<L, A, B, Q>
    for &Constants<f64, A, B, Q>
{
    type Constant = f64;

    fn cylinder(&self) -> &Cylinder {
        &self.cylinder
    }

    fn enter(&mut self, _: usize, _: &RunInput) -> Result<Option<&Constants<f64, A, B, Q>>, RunFailure> {
        Ok(Some(self))
    }

    fn constants(&self) -> Option<&Constants<f64, A, B, Q>> {
        Some(self)
    }
}

/// Every run has its own payload, and every lane its own constants.
pub(super) struct OwnBodies<'a, L, const A: usize, const B: usize, const Q: usize> {
    model: &'a PlanarModel,
    tolerance: f64,
    packed: Option<Box<Constants<L, A, B, Q>>>,
    last: Option<Box<Constants<f64, A, B, Q>>>,
}

impl<'a, L, const A: usize, const B: usize, const Q: usize> OwnBodies<'a, L, A, B, Q> {
    /// For runs of a model.
    pub(super) fn new(model: &'a PlanarModel, tolerance: f64) -> Self {
        Self {
            model,
            tolerance,
            packed: None,
            last: None,
        }
    }
}

impl<L: Lane + Coefficient<L>, const A: usize, const B: usize, const Q: usize> Bodies<L, A, B, Q>
    for OwnBodies<'_, L, A, B, Q>
{
    type Constant = L;

    fn cylinder(&self) -> &Cylinder {
        self.model.cylinder()
    }

    fn enter(
        &mut self,
        lane: usize,
        input: &RunInput,
    ) -> Result<Option<&Constants<f64, A, B, Q>>, RunFailure> {
        let modes = self
            .model
            .modes(input.payload_kg)
            .map_err(|reason| RunFailure::Machine(SimulatorError::Planar(reason)))?;
        let order = self.model.order(&modes, self.tolerance);
        let Some(own) = self.model.constants(&modes, &order) else {
            return Ok(None);
        };
        match &mut self.packed {
            // A lane without a run has the first one's body, so that it stays finite.
            None => self.packed = Some(Box::new(Constants::splat(&own))),
            Some(packed) => packed.set_lane(lane, &own),
        }
        Ok(Some(self.last.insert(Box::new(own))))
    }

    fn constants(&self) -> Option<&Constants<L, A, B, Q>> {
        self.packed.as_deref()
    }
}

/// Simulates `inputs` in the order of `jobs` and puts each result into its place of `results`.
#[allow(clippy::too_many_lines, reason = "one loop over the steps of all lanes")]
#[inline(always)]
pub(super) fn simulate<L: Lane, const A: usize, const B: usize, const Q: usize>(
    bodies: &mut impl Bodies<L, A, B, Q>,
    common: &Common,
    inputs: &[RunInput],
    jobs: &[usize],
    buffer: &mut StepBuffer<L, A, B, Q>,
    results: &mut [Option<RunResult>],
) {
    let zero = L::splat(0.0);
    let cylinder = &bodies.cylinder().clone();
    let mut queue = jobs.iter();
    let mut tracks: Vec<Option<Track<'_>>> = (0..L::WIDTH).map(|_| None).collect();
    let mut state = Point::<L, A, B, Q>::zero();
    let mut step_s = L::splat(common.sample_time_s);
    let mut regime = Regime {
        opening: zero,
        opening_per_s: zero,
        line_pa: [L::splat(cylinder.supply_pa), L::splat(cylinder.tank_pa)],
        filled: [L::splat(1.0); 2],
    };
    let mut readings = Vec::new();
    // A lane without a run keeps computing; start it where a run starts, so that it stays finite.
    let mut idle_ready = false;
    loop {
        let mut busy = false;
        let mut recording = false;
        for (lane, place) in tracks.iter_mut().enumerate() {
            while place.is_none() {
                let Some(&job) = queue.next() else { break };
                let body = match bodies.enter(lane, &inputs[job]) {
                    Ok(Some(body)) => body,
                    Ok(None) => continue,
                    Err(failure) => {
                        results[job] = Some(Err(failure));
                        continue;
                    }
                };
                match rest(body, inputs[job].angles_rad[0]) {
                    Ok(start) => {
                        let channels = super::record::MACHINE_CHANNELS + body.readouts.len();
                        readings.resize(body.sensors.len(), zero);
                        if !idle_ready {
                            idle_ready = true;
                            for other in 0..L::WIDTH {
                                load(&mut state, other, &start.state);
                            }
                        }
                        load(&mut state, lane, &start.state);
                        let track = Track::new(
                            job,
                            &inputs[job],
                            common.sample_time_s,
                            common.line_caution2,
                            channels,
                            start.length_m,
                            cylinder,
                        );
                        *place = Some(track);
                    }
                    Err(failure) => results[job] = Some(Err(failure)),
                }
            }
            if let Some(track) = place {
                busy = true;
                recording |= track.record_due;
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
        let Some(c) = bodies.constants() else { return };
        let c = if L::WIDTH > 1 { std::hint::black_box(c) } else { c };
        step(c, common.method, &state, step_s, &regime, buffer);
        if recording {
            read(c, &state, &buffer.start, &mut readings);
        }
        let error2 = buffer.error2 * L::splat(common.per_tolerance2);
        let mut accepted = zero;
        for (lane, place) in tracks.iter_mut().enumerate() {
            let Some(track) = place else { continue };
            match advance(track, &state, buffer, &readings, error2.get(lane), lane, c) {
                Ok(Some(Verdict::Accept)) => accepted.set(lane, 1.0),
                Ok(Some(Verdict::Repeat)) => {}
                Ok(None) => {
                    if let Some(track) = place.take() {
                        let job = track.job;
                        results[job] = Some(Ok(track.finish()));
                    }
                }
                Err(failure) => {
                    results[track.job] = Some(Err(failure));
                    *place = None;
                }
            }
        }
        take(c, &mut state, &buffer.next, accepted);
    }
}

/// What the sensors' rows read.
#[inline(always)]
fn read<L: Lane, K: Coefficient<L>, const A: usize, const B: usize, const Q: usize>(
    c: &Constants<K, A, B, Q>,
    state: &Point<L, A, B, Q>,
    start: &Rates<L, A, B, Q>,
    readings: &mut [L],
) {
    let q = |x: K| x.pack();
    let z = &state.z;
    let [fx, fy, fz] = start.n.map(|n| n * state.lag);
    for (reading, row) in readings.iter_mut().zip(&c.sensors) {
        let [coupled] = sums!(L::trip(A, c.coupled.used), |i| [z.coupled[i] * q(row.coupled[i])]);
        let [plain] = sums!(L::trip(B, c.plain.used), |i| [z.plain[i] * q(row.plain[i])]);
        let [follower] = sums!(L::trip(Q, c.follower.used), |i| {
            [z.follower[i] * q(row.follower[i])]
        });
        let part = &row.lagging;
        let weight = start.gravity[0] * q(part[0]) + start.gravity[1] * q(part[1]) + q(part[2]);
        let force = fx * q(part[3]) + fy * q(part[4]) + fz * q(part[5]);
        *reading = (coupled + plain) + (follower + (weight + force));
    }
}

/// Records and judges one lane; `None` when the run is finished.
#[inline(always)]
fn advance<L: Lane, K: Coefficient<L>, const A: usize, const B: usize, const Q: usize>(
    track: &mut Track<'_>,
    state: &Point<L, A, B, Q>,
    buffer: &StepBuffer<L, A, B, Q>,
    readings: &[L],
    error2: f64,
    lane: usize,
    c: &Constants<K, A, B, Q>,
) -> Result<Option<Verdict>, RunFailure> {
    if track.record_due {
        let machine = machine_channels(track.valve_at_sample(), track.alpha, state, &buffer.start, lane);
        track.record(&machine, |k| c.readouts[k].value(readings, lane))?;
        if track.done() {
            return Ok(None);
        }
    }
    let next = &buffer.next;
    let both = |f: fn(&Rates<L, A, B, Q>) -> &[L; 2]| {
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
        speed_m_per_s: buffer.end.speed.get(lane),
        speed_range_m_per_s: [buffer.speed_range[0].get(lane), buffer.speed_range[1].get(lane)],
        length_m: buffer.end.length.get(lane),
        finite: (next.p[0].get(lane) + next.p[1].get(lane) + next.omega.get(lane)).is_finite(),
    };
    track.judge(&outcome, &c.cylinder).map(Some)
}

/// Puts a run's state into a lane, padding included.
fn load<L: Lane, const A: usize, const B: usize, const Q: usize>(
    state: &mut Point<L, A, B, Q>,
    lane: usize,
    from: &Point<f64, A, B, Q>,
) {
    state.theta.set(lane, from.theta);
    state.omega.set(lane, from.omega);
    state.lag.set(lane, from.lag);
    for i in 0..2 {
        state.p[i].set(lane, from.p[i]);
    }
    for (to, from) in [(&mut state.z, &from.z), (&mut state.v, &from.v)] {
        for (to, from) in to.coupled.iter_mut().zip(&from.coupled) {
            to.set(lane, *from);
        }
        for (to, from) in to.plain.iter_mut().zip(&from.plain) {
            to.set(lane, *from);
        }
        for (to, from) in to.follower.iter_mut().zip(&from.follower) {
            to.set(lane, *from);
        }
    }
}

/// Moves the lanes that are accepted (1, the others 0) to the new state.
#[inline(always)]
fn take<L: Lane, K: Coefficient<L>, const A: usize, const B: usize, const Q: usize>(
    c: &Constants<K, A, B, Q>,
    state: &mut Point<L, A, B, Q>,
    from: &Point<L, A, B, Q>,
    accepted: L,
) {
    let half = L::splat(0.5);
    let blend = |to: &mut L, from: &L| *to = from.where_less(half, accepted, *to);
    blend(&mut state.theta, &from.theta);
    blend(&mut state.omega, &from.omega);
    blend(&mut state.lag, &from.lag);
    for i in 0..2 {
        blend(&mut state.p[i], &from.p[i]);
    }
    for (to, from) in [(&mut state.z, &from.z), (&mut state.v, &from.v)] {
        for i in 0..L::trip(A, c.coupled.used) {
            blend(&mut to.coupled[i], &from.coupled[i]);
        }
        for i in 0..L::trip(B, c.plain.used) {
            blend(&mut to.plain[i], &from.plain[i]);
        }
        for i in 0..L::trip(Q, c.follower.used) {
            blend(&mut to.follower[i], &from.follower[i]);
        }
    }
}
