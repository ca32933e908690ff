//! Adding a Newton increment to a state, and keeping Euler parameters normalised.

use nalgebra::{Vector3, Vector4};

use crate::body::rotation::rate_map;
use crate::system::{Level, State, System, Workspace};

/// How velocities and accelerations follow an increment of the coordinates.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Increment {
    /// γ', 1/s.
    pub(crate) velocity_factor: f64,
    /// β', 1/s².
    pub(crate) acceleration_factor: f64,
}

/// Adds the increments in the workspace to the state. Returns the largest of them: m, rad, or
/// modal coordinate.
pub(crate) fn add_increment(system: &System, ws: &Workspace, by: Increment, state: &mut State) -> f64 {
    let mut largest = 0.0_f64;
    let add = |state: &mut State, index: usize, delta: f64| {
        state.q[index] += delta;
        state.v[index] += by.velocity_factor * delta;
        state.a[index] += by.acceleration_factor * delta;
    };
    for (k, entry) in system.bodies.iter().enumerate() {
        let delta = &ws.delta_frame[6 * k..6 * k + 6];
        let theta = Vector4::from_column_slice(&state.q[entry.first_q + 3..entry.first_q + 7]);
        let turn =
            rate_map(&theta).tr_mul(&Vector3::from_column_slice(&delta[3..])) / (4.0 * theta.norm_squared());
        for (i, shift) in delta[..3].iter().enumerate() {
            add(state, entry.first_q + i, *shift);
        }
        for i in 0..4 {
            add(state, entry.first_q + 3 + i, turn[i]);
        }
        for mode in 0..entry.frame.mode_count() {
            add(
                state,
                entry.first_q + 7 + mode,
                ws.delta_modal[entry.first_modal + mode],
            );
        }
    }
    if let Some(payload) = &system.payload {
        for i in 0..3 {
            add(
                state,
                payload.first_q + i,
                ws.delta_frame[payload.first_frame + i],
            );
        }
    }
    for (lambda, delta) in state.multipliers.iter_mut().zip(&ws.delta_multipliers) {
        *lambda += delta;
    }
    for delta in ws.delta_frame.iter().chain(&ws.delta_modal) {
        // A plain `max` would drop a NaN.
        if !delta.is_finite() {
            return f64::NAN;
        }
        largest = largest.max(delta.abs());
    }
    largest
}

/// Solves the normalisation condition of every body's Euler parameters along θ itself:
/// `|θ| = 1` at position level, `θ·θ̇ = 0` at velocity level.
pub(crate) fn normalise(system: &System, level: Level, by: Increment, state: &mut State) {
    for entry in &system.bodies {
        let range = entry.first_q + 3..entry.first_q + 7;
        // At velocity level the condition is quadratic in the correction; two steps reach rounding.
        let rounds = if level == Level::Velocity { 2 } else { 1 };
        for _ in 0..rounds {
            let theta = Vector4::from_column_slice(&state.q[range.clone()]);
            let correction = match level {
                Level::Position => 1.0 / theta.norm() - 1.0,
                Level::Velocity => {
                    let rate = Vector4::from_column_slice(&state.v[range.clone()]);
                    -theta.dot(&rate) / (by.velocity_factor * theta.norm_squared() + theta.dot(&rate))
                }
            };
            for i in 0..4 {
                let delta = correction * theta[i];
                state.q[range.start + i] += delta;
                state.v[range.start + i] += by.velocity_factor * delta;
                state.a[range.start + i] += by.acceleration_factor * delta;
            }
        }
    }
}
