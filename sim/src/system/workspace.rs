//! Scratch memory of an evaluation. May be dirty between uses; one per thread.

use crate::body::floating_frame::BodyMotion;
use crate::body::marker::MarkerMotion;
use crate::hydraulics::cylinder::LineForce;

use super::lu::DenseLu;

/// Eye-to-eye motion of a cylinder.
#[derive(Debug, Clone, Copy, Default)]
pub struct CylinderMotion {
    /// Eye-to-eye length L, m.
    pub length_m: f64,
    /// L̇, m/s.
    pub velocity_m_per_s: f64,
    /// Total force along the line, tension positive.
    pub force: LineForce,
}

/// Rows of constraints (joints first, then one per cylinder: ∂L/∂q).
#[derive(Debug, Clone, Default)]
pub struct Rows {
    /// Frame columns, row by row.
    pub frame: Vec<f64>,
    /// Modal columns, row by row.
    pub modal: Vec<f64>,
    /// Frame columns of one row.
    pub frame_count: usize,
    /// Modal columns of one row.
    pub modal_count: usize,
}

impl Rows {
    pub(crate) fn frame(&self, row: usize) -> &[f64] {
        &self.frame[row * self.frame_count..(row + 1) * self.frame_count]
    }

    pub(crate) fn modal(&self, row: usize) -> &[f64] {
        &self.modal[row * self.modal_count..(row + 1) * self.modal_count]
    }
}

/// Scratch memory sized for one system.
#[derive(Debug, Clone, Default)]
pub struct Workspace {
    /// Motions of the bodies.
    pub bodies: Vec<BodyMotion>,
    /// Motions of the markers.
    pub markers: Vec<MarkerMotion>,
    /// Motions and forces of the cylinders.
    pub cylinders: Vec<CylinderMotion>,
    /// Constraint and cylinder rows.
    pub rows: Rows,
    /// Residual of the frame rows (force, moment per body; force of the payload), N and N m.
    pub residual_frame: Vec<f64>,
    /// Residual of the modal rows.
    pub residual_modal: Vec<f64>,
    /// Residual of the joint rows: gaps (position level) or gap rates (velocity level); then one
    /// entry per cylinder: deviation of its length where it is locked, else zero.
    pub residual_rows: Vec<f64>,
    /// Forces that hold locked cylinders, tension positive, N; zero where nothing is locked.
    pub lock_forces_n: Vec<f64>,
    /// Solution: frame increments [δr, δφ] per body, then the payload's.
    pub delta_frame: Vec<f64>,
    /// Solution: modal increments.
    pub delta_modal: Vec<f64>,
    /// Solution: increments of the multipliers, then of the locks' forces.
    pub delta_multipliers: Vec<f64>,
    pub(crate) velocity_frame: Vec<f64>,
    pub(crate) lu: DenseLu,
    pub(crate) right: Vec<f64>,
    /// Coupling of every mode with its body's local unknowns, body after body.
    pub(crate) coupling: Vec<f64>,
    /// Pivots of the modal unknowns.
    pub(crate) modal_pivots: Vec<f64>,
    pub(crate) local: Vec<f64>,
}
