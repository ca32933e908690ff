//! The linear system of a Newton step.
//!
//! Unknowns: frame increments `[δr, δφ]` per body and the payload's, modal increments, multipliers.
//! In generalised modes the modal block is diagonal once every cylinder's tangent stiffness
//! `k g gᵀ` is written with its force increment as unknown: `g·δ − f/k = 0`. Modes are
//! eliminated one by one; a dense system of frames, joint rows and cylinders remains (12 unknowns for
//! a boom with 8 modes, 18 with payload and 14 modes).

use super::evaluate::Level;
use super::system::System;
use super::workspace::Workspace;

/// Factors of mass, damping and stiffness in the Jacobian `m M + d D + k K`, and the level of the joints.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coefficients {
    /// Factor of the mass matrix.
    pub mass: f64,
    /// Factor of the damping matrix.
    pub damping: f64,
    /// Factor of the stiffness matrix.
    pub stiffness: f64,
    /// What the rows of the cylinders do.
    pub cylinders: CylinderRows,
}

/// What the rows of the cylinders do in a linear system.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CylinderRows {
    /// They carry the tangent stiffness of the cylinders' forces.
    Tangent,
    /// They hold the cylinders' lengths.
    Locked,
}

impl System {
    /// Assembles and factors the Jacobian at the last evaluated state. Returns false where it is singular.
    ///
    /// Neglected: derivatives of the inertia and gravity terms and of the rows. Their size relative
    /// to the mass term is ω h/2 and F h²/(m L): a few thousandths at 5 ms, so Newton's method
    /// converges linearly and fast.
    #[must_use]
    pub fn factorise(&self, coefficients: Coefficients, ws: &mut Workspace) -> bool {
        let order = self.frame_count() + self.row_count();
        let Coefficients {
            mass,
            damping,
            stiffness,
            ..
        } = coefficients;
        ws.lu.values.fill(0.0);
        for (k, (entry, motion)) in self.bodies.iter().zip(&ws.bodies).enumerate() {
            entry
                .frame
                .add_rigid_mass(motion, mass, &mut ws.lu.values, order, 6 * k);
        }
        if let Some(payload) = &self.payload {
            for k in payload.first_frame..payload.first_frame + 3 {
                ws.lu.values[k * order + k] += mass * payload.mass_kg;
            }
        }
        self.border(coefficients, ws, order);
        for (k, (entry, motion)) in self.bodies.iter().zip(&ws.bodies).enumerate() {
            let n = entry.frame.mode_count();
            let width = 6 + entry.rows.len();
            let local = &mut ws.local[..width * width];
            local.fill(0.0);
            for mode in 0..n {
                let column = &mut ws.coupling[entry.first_coupling + mode * width..][..width];
                for (c, x) in column.iter_mut().zip(entry.frame.modal_coupling(motion, mode)) {
                    *c = mass * x;
                }
                for (c, &row) in column[6..].iter_mut().zip(&entry.rows) {
                    *c = if self.is_live(row, coefficients, &ws.cylinders) {
                        ws.rows.modal[row * self.modal_count + entry.first_modal + mode]
                    } else {
                        0.0
                    };
                }
                let pivot =
                    mass + damping * entry.frame.damping[mode] + stiffness * entry.frame.stiffness[mode];
                if !(pivot.is_finite() && pivot > 0.0) {
                    return false;
                }
                ws.modal_pivots[entry.first_modal + mode] = pivot;
                let inverse = 1.0 / pivot;
                for i in 0..width {
                    let factor = column[i] * inverse;
                    for (l, c) in local[i * width..(i + 1) * width].iter_mut().zip(column.iter()) {
                        *l += factor * c;
                    }
                }
            }
            let place = |i: usize| {
                if i < 6 {
                    6 * k + i
                } else {
                    self.frame_count() + entry.rows[i - 6]
                }
            };
            for i in 0..width {
                for j in 0..width {
                    ws.lu.values[place(i) * order + place(j)] -= local[i * width + j];
                }
            }
        }
        ws.lu.factorise()
    }

    /// Joint rows and cylinder rows of the dense matrix.
    fn border(&self, coefficients: Coefficients, ws: &mut Workspace, order: usize) {
        let frames = self.frame_count();
        for row in 0..self.row_count() {
            let place = frames + row;
            if !self.is_live(row, coefficients, &ws.cylinders) {
                ws.lu.values[place * order + place] = -1.0;
                continue;
            }
            for (j, x) in ws.rows.frame(row).iter().enumerate() {
                ws.lu.values[place * order + j] = *x;
                ws.lu.values[j * order + place] = *x;
            }
            if row >= self.joint_rows && coefficients.cylinders == CylinderRows::Tangent {
                let tangent = Self::tangent(row - self.joint_rows, coefficients, &ws.cylinders);
                ws.lu.values[place * order + place] = -1.0 / tangent;
            }
        }
    }

    fn tangent(
        cylinder: usize,
        coefficients: Coefficients,
        motions: &[super::workspace::CylinderMotion],
    ) -> f64 {
        let force = &motions[cylinder].force;
        coefficients.stiffness * force.by_length + coefficients.damping * force.by_velocity
    }

    /// Joint rows always act; a cylinder's row does if it has a tangent stiffness.
    fn is_live(
        &self,
        row: usize,
        coefficients: Coefficients,
        motions: &[super::workspace::CylinderMotion],
    ) -> bool {
        row < self.joint_rows
            || coefficients.cylinders == CylinderRows::Locked
            || Self::tangent(row - self.joint_rows, coefficients, motions) != 0.0
    }

    /// Solves with the last factors for the residuals of the last evaluation: `J δ = −r`, where the
    /// rows of motion are scaled by `scale` and the joints' by the inverse of their rate factor.
    ///
    /// Results are in `delta_frame`, `delta_modal` and `delta_multipliers` (unscaled) of the workspace.
    pub fn solve(&self, scale: f64, level: Level, rate_factor: f64, ws: &mut Workspace) {
        let frames = self.frame_count();
        let joint_scale = match level {
            Level::Position => 1.0,
            Level::Velocity => 1.0 / rate_factor,
        };
        ws.right.fill(0.0);
        for (r, x) in ws.right.iter_mut().zip(&ws.residual_frame) {
            *r = -scale * x;
        }
        for (row, (r, x)) in ws.right[frames..].iter_mut().zip(&ws.residual_rows).enumerate() {
            *r = if row < self.joint_rows {
                -joint_scale * x
            } else {
                -x
            };
        }
        for (k, entry) in self.bodies.iter().enumerate() {
            let width = 6 + entry.rows.len();
            for mode in 0..entry.frame.mode_count() {
                let index = entry.first_modal + mode;
                let reduced = -scale * ws.residual_modal[index] / ws.modal_pivots[index];
                let column = &ws.coupling[entry.first_coupling + mode * width..][..width];
                for (r, c) in ws.right[6 * k..6 * k + 6].iter_mut().zip(column) {
                    *r -= c * reduced;
                }
                for (&row, c) in entry.rows.iter().zip(&column[6..]) {
                    ws.right[frames + row] -= c * reduced;
                }
            }
        }
        ws.lu.solve(&mut ws.right);
        for (k, entry) in self.bodies.iter().enumerate() {
            let width = 6 + entry.rows.len();
            for mode in 0..entry.frame.mode_count() {
                let index = entry.first_modal + mode;
                let column = &ws.coupling[entry.first_coupling + mode * width..][..width];
                let mut sum = -scale * ws.residual_modal[index];
                for (c, x) in column.iter().zip(&ws.right[6 * k..6 * k + 6]) {
                    sum -= c * x;
                }
                for (&row, c) in entry.rows.iter().zip(&column[6..]) {
                    sum -= c * ws.right[frames + row];
                }
                ws.delta_modal[index] = sum / ws.modal_pivots[index];
            }
        }
        ws.delta_frame.copy_from_slice(&ws.right[..frames]);
        for (d, x) in ws.delta_multipliers.iter_mut().zip(&ws.right[frames..]) {
            *d = x / scale;
        }
    }
}
