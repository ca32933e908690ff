//! Joints: residual, velocity and Jacobian rows (theory note §6).
//!
//! Every row is linear in the virtual displacements of the two bodies it connects; its velocity
//! level is the same row applied to the velocities.

use hydroflex_openapi::machine::JointKind;
use nalgebra::Vector3;

use crate::body::marker::MarkerMotion;

/// A joint between two markers, by their numbers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Joint {
    /// Name.
    pub name: String,
    /// What it leaves free.
    pub kind: JointKind,
    /// Marker that carries the joint frame.
    pub from: usize,
    /// The other marker.
    pub to: usize,
    /// Number of its first row.
    pub first_row: usize,
}

/// Receives rows: `direction · J` of a marker's position or rotation, with a sign.
pub trait RowSink {
    /// Adds the row of a displacement along a global direction.
    fn add_point(&mut self, row: usize, marker: usize, direction: &Vector3<f64>);
    /// Adds the row of a rotation about a global direction.
    fn add_rotation(&mut self, row: usize, marker: usize, direction: &Vector3<f64>);
    /// Sets the position-level residual.
    fn set_residual(&mut self, row: usize, value: f64);
}

/// Number of rows of a joint.
#[must_use]
pub fn row_count(kind: JointKind) -> usize {
    match kind {
        JointKind::Revolute => 5,
        JointKind::Spherical => 3,
        JointKind::Fixed => 6,
        JointKind::PlanarPin => 2,
    }
}

/// Whether a joint needs the orientation of its markers.
#[must_use]
pub fn needs_frames(kind: JointKind) -> bool {
    !matches!(kind, JointKind::Spherical)
}

impl Joint {
    /// Writes the rows for the given marker motions. The free axis is the z axis of the frames.
    pub fn write_rows(&self, from: &MarkerMotion, to: &MarkerMotion, sink: &mut impl RowSink) {
        let gap = to.position_m - from.position_m;
        let x0: Vector3<f64> = from.orientation.column(0).into();
        let y0: Vector3<f64> = from.orientation.column(1).into();
        let z0: Vector3<f64> = from.orientation.column(2).into();
        let x1: Vector3<f64> = to.orientation.column(0).into();
        let y1: Vector3<f64> = to.orientation.column(1).into();
        match self.kind {
            JointKind::Spherical => self.coincide(&gap, sink),
            JointKind::Revolute => {
                self.coincide(&gap, sink);
                self.perpendicular(3, &z0, &x1, sink);
                self.perpendicular(4, &z0, &y1, sink);
            }
            JointKind::Fixed => {
                self.coincide(&gap, sink);
                self.perpendicular(3, &z0, &y1, sink);
                self.perpendicular(4, &z0, &x1, sink);
                self.perpendicular(5, &x0, &y1, sink);
            }
            JointKind::PlanarPin => {
                for (k, axis) in [x0, y0].iter().enumerate() {
                    let row = self.first_row + k;
                    sink.add_point(row, self.to, axis);
                    sink.add_point(row, self.from, &-axis);
                    // The axis turns with its frame: d(a·D)/dt = a·Ḋ + (W₀ × a)·D.
                    sink.add_rotation(row, self.from, &axis.cross(&gap));
                    sink.set_residual(row, axis.dot(&gap));
                }
            }
        }
    }

    /// Three rows, global axes: `P₁ − P₀ = 0`.
    fn coincide(&self, gap: &Vector3<f64>, sink: &mut impl RowSink) {
        for k in 0..3 {
            let axis = Vector3::ith(k, 1.0);
            sink.add_point(self.first_row + k, self.to, &axis);
            sink.add_point(self.first_row + k, self.from, &-axis);
            sink.set_residual(self.first_row + k, gap[k]);
        }
    }

    /// One row: `a₀ · b₁ = 0`, rate `(W₁ − W₀) · (b₁ × a₀)`.
    fn perpendicular(&self, k: usize, a0: &Vector3<f64>, b1: &Vector3<f64>, sink: &mut impl RowSink) {
        let row = self.first_row + k;
        let direction = b1.cross(a0);
        sink.add_rotation(row, self.to, &direction);
        sink.add_rotation(row, self.from, &-direction);
        sink.set_residual(row, a0.dot(b1));
    }
}
