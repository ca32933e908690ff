//! Kinematics and residual: `M q̈ − f + Gᵀ λ`, and the joints at position or velocity level.

use nalgebra::Vector3;

use super::state::State;
use super::system::System;
use super::workspace::{Rows, Workspace};
use crate::body::floating_frame::{BodyMotion, add_vector};
use crate::body::marker::{BodyMarker, Marker, MarkerMotion};
use crate::joint::RowSink;

/// Level at which joints are enforced.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// Index 3: gaps are zero.
    Position,
    /// Index 2: gap rates are zero.
    Velocity,
}

/// Where pressures come from.
#[derive(Debug, Clone, Copy)]
pub enum Oil<'a> {
    /// From the state.
    Given,
    /// From the trapezoidal rule over a step; written to the state.
    Trapezoidal {
        /// Half the step, s.
        half_step_s: f64,
        /// State at the start of the step.
        start: &'a State,
        /// Valve of every cylinder at the end of the step.
        valves_ratio: &'a [f64],
    },
}

impl System {
    /// Evaluates motions, rows, forces and residuals at a state.
    pub fn evaluate(&self, state: &mut State, oil: Oil<'_>, level: Level, ws: &mut Workspace) {
        self.evaluate_motion(state, ws);
        self.evaluate_forces(state, oil, ws);
        self.evaluate_joints(level, ws);
        self.evaluate_residual(state, ws);
    }

    /// Motions of bodies, markers and cylinders, and the rows.
    pub fn evaluate_motion(&self, state: &State, ws: &mut Workspace) {
        for (entry, motion) in self.bodies.iter().zip(&mut ws.bodies) {
            let range = entry.first_q..entry.first_q + 7 + entry.frame.mode_count();
            entry.frame.evaluate(
                &state.q[range.clone()],
                &state.v[range.clone()],
                &state.a[range],
                motion,
            );
        }
        for ((marker, &needs_frame), out) in self.markers.iter().zip(&self.marker_frames).zip(&mut ws.markers)
        {
            match marker {
                Marker::Ground(point) => {
                    *out = MarkerMotion {
                        position_m: *point,
                        orientation: nalgebra::Matrix3::identity(),
                        ..MarkerMotion::default()
                    };
                }
                Marker::Payload => {
                    if let Some(payload) = &self.payload {
                        let range = payload.first_q..payload.first_q + 3;
                        out.position_m = Vector3::from_column_slice(&state.q[range.clone()]);
                        out.velocity_m_per_s = Vector3::from_column_slice(&state.v[range]);
                    }
                }
                Marker::Body(on) => {
                    on.evaluate_point(&ws.bodies[on.body], out);
                    if needs_frame {
                        on.evaluate_frame(&ws.bodies[on.body], self.conventions.marker_rotation, out);
                    }
                }
            }
        }
        ws.rows.frame.fill(0.0);
        ws.rows.modal.fill(0.0);
        let mut sink = Writer {
            system: self,
            bodies: &ws.bodies,
            markers: &ws.markers,
            rows: &mut ws.rows,
            gaps: &mut ws.residual_rows,
        };
        for joint in &self.joints {
            joint.write_rows(&ws.markers[joint.from], &ws.markers[joint.to], &mut sink);
        }
        for (k, &[base, rod]) in self.cylinder_markers.iter().enumerate() {
            let (from, to) = (&ws.markers[base], &ws.markers[rod]);
            let line = to.position_m - from.position_m;
            let length = line.norm();
            let direction = line / length;
            let row = self.joint_rows + k;
            sink.add_point(row, rod, &direction);
            sink.add_point(row, base, &-direction);
            ws.cylinders[k].length_m = length;
            ws.cylinders[k].velocity_m_per_s = direction.dot(&(to.velocity_m_per_s - from.velocity_m_per_s));
        }
    }

    /// Forces of the cylinders, and with [`Oil::Trapezoidal`] the pressures.
    fn evaluate_forces(&self, state: &mut State, oil: Oil<'_>, ws: &mut Workspace) {
        for (k, (cylinder, motion)) in self.cylinders.iter().zip(&mut ws.cylinders).enumerate() {
            let (length, velocity) = (motion.length_m, motion.velocity_m_per_s);
            motion.force = match oil {
                Oil::Given => cylinder.force(length, velocity, state.pressures_pa[k]),
                Oil::Trapezoidal {
                    half_step_s,
                    start,
                    valves_ratio,
                } => {
                    let (p, rate) = (start.pressures_pa[k], start.pressure_rates_pa_per_s[k]);
                    let before = [(p[0], rate[0]), (p[1], rate[1])];
                    let (force, chambers) =
                        cylinder.trapezoidal_step(valves_ratio[k], half_step_s, before, length, velocity);
                    state.pressures_pa[k] = chambers.map(|c| c.pressure_pa);
                    state.pressure_rates_pa_per_s[k] = chambers.map(|c| c.rate_pa_per_s);
                    force
                }
            };
        }
    }

    /// Residual of the joints; the position level was written with the rows.
    fn evaluate_joints(&self, level: Level, ws: &mut Workspace) {
        if level == Level::Position {
            return;
        }
        for (k, body) in ws.bodies.iter().enumerate() {
            ws.velocity_frame[6 * k..6 * k + 3].copy_from_slice(body.velocity_m_per_s.as_slice());
            ws.velocity_frame[6 * k + 3..6 * k + 6].copy_from_slice(body.omega_rad_per_s.as_slice());
        }
        if let (Some(payload), Some(motion)) = (&self.payload, self.payload_marker().map(|m| &ws.markers[m]))
        {
            ws.velocity_frame[payload.first_frame..payload.first_frame + 3]
                .copy_from_slice(motion.velocity_m_per_s.as_slice());
        }
        for row in 0..self.joint_rows {
            let mut rate = dot(ws.rows.frame(row), &ws.velocity_frame);
            let modal = ws.rows.modal(row);
            for (entry, motion) in self.bodies.iter().zip(&ws.bodies) {
                let n = entry.frame.mode_count();
                rate += dot(&modal[entry.first_modal..entry.first_modal + n], &motion.eta_rate);
            }
            ws.residual_rows[row] = rate;
        }
    }

    /// Residual of the equations of motion.
    fn evaluate_residual(&self, state: &State, ws: &mut Workspace) {
        ws.residual_frame.fill(0.0);
        ws.residual_modal.fill(0.0);
        let deformed = self.deformed_gravity();
        for (k, (entry, motion)) in self.bodies.iter().zip(&ws.bodies).enumerate() {
            let frame = &mut ws.residual_frame[6 * k..6 * k + 6];
            let range = entry.first_modal..entry.first_modal + entry.frame.mode_count();
            let modal = &mut ws.residual_modal[range];
            entry.frame.add_inertia_and_elastic(motion, frame, modal);
            entry
                .frame
                .subtract_gravity(motion, &self.gravity_m_per_s2, deformed, frame, modal);
        }
        if let Some(payload) = &self.payload {
            let acceleration = Vector3::from_column_slice(&state.a[payload.first_q..payload.first_q + 3]);
            let force = payload.mass_kg * (acceleration - self.gravity_m_per_s2);
            add_vector(
                &mut ws.residual_frame[payload.first_frame..payload.first_frame + 3],
                &force,
            );
        }
        for row in 0..self.row_count() {
            let factor = if row < self.joint_rows {
                state.multipliers[row]
            } else {
                ws.cylinders[row - self.joint_rows].force.force_n + ws.lock_forces_n[row - self.joint_rows]
            };
            let (frame, modal) = (ws.rows.frame(row), ws.rows.modal(row));
            for (r, x) in ws.residual_frame.iter_mut().zip(frame) {
                *r += factor * x;
            }
            for (r, x) in ws.residual_modal.iter_mut().zip(modal) {
                *r += factor * x;
            }
        }
    }

    fn payload_marker(&self) -> Option<usize> {
        self.markers.iter().position(|m| matches!(m, Marker::Payload))
    }
}

pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// Writes rows for the markers of a system.
struct Writer<'a> {
    system: &'a System,
    bodies: &'a [BodyMotion],
    markers: &'a [MarkerMotion],
    rows: &'a mut Rows,
    gaps: &'a mut [f64],
}

impl Writer<'_> {
    fn parts(&mut self, row: usize, on: &BodyMarker) -> (&mut [f64], &mut [f64]) {
        let entry = &self.system.bodies[on.body];
        let frame = row * self.rows.frame_count + 6 * on.body;
        let modal = row * self.rows.modal_count + entry.first_modal;
        let n = entry.frame.mode_count();
        (
            &mut self.rows.frame[frame..frame + 6],
            &mut self.rows.modal[modal..modal + n],
        )
    }
}

impl RowSink for Writer<'_> {
    fn add_point(&mut self, row: usize, marker: usize, direction: &Vector3<f64>) {
        match &self.system.markers[marker] {
            Marker::Ground(_) => {}
            Marker::Payload => {
                if let Some(payload) = &self.system.payload {
                    let first = row * self.rows.frame_count + payload.first_frame;
                    add_vector(&mut self.rows.frame[first..first + 3], direction);
                }
            }
            Marker::Body(on) => {
                let local = self.bodies[on.body].rotation.tr_mul(direction);
                let moment = self.markers[marker].local_m.cross(&local);
                let (frame, modal) = self.parts(row, on);
                add_vector(&mut frame[..3], direction);
                add_vector(&mut frame[3..], &moment);
                for (m, psi) in modal.iter_mut().zip(&on.translation) {
                    *m += psi.dot(&local);
                }
            }
        }
    }

    fn add_rotation(&mut self, row: usize, marker: usize, direction: &Vector3<f64>) {
        if let Marker::Body(on) = &self.system.markers[marker] {
            let local = self.bodies[on.body].rotation.tr_mul(direction);
            let through = self.markers[marker].rotation_rate_map.tr_mul(&local);
            let (frame, modal) = self.parts(row, on);
            add_vector(&mut frame[3..], &local);
            for (m, psi) in modal.iter_mut().zip(&on.rotation) {
                *m += psi.dot(&through);
            }
        }
    }

    fn set_residual(&mut self, row: usize, value: f64) {
        self.gaps[row] = value;
    }
}
