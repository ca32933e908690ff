//! Points of the system to which joints, cylinders and payloads attach (theory note §5).

use nalgebra::{Matrix3, Vector3};

use super::floating_frame::BodyMotion;
use super::rotation::{exponential, tangent};
use hydroflex_openapi::machine::MarkerRotation;

/// A point with a frame.
#[derive(Debug, Clone, PartialEq)]
pub enum Marker {
    /// Fixed in space, global coordinates in m.
    Ground(Vector3<f64>),
    /// On a body.
    Body(BodyMarker),
    /// The payload's point mass.
    Payload,
}

/// A point of a body: weighted mean of an interface's nodes, or a point of a rigid body.
#[derive(Debug, Clone, PartialEq)]
pub struct BodyMarker {
    /// Number of the body in the system.
    pub body: usize,
    /// Undeformed position, m, body frame.
    pub position_m: Vector3<f64>,
    /// Columns of Ψ_P in generalised modes; empty on a rigid body.
    pub translation: Vec<Vector3<f64>>,
    /// Columns of Ψ_R in generalised modes; empty on a rigid body.
    pub rotation: Vec<Vector3<f64>>,
}

/// Motion of a marker at an instant.
#[derive(Debug, Clone, Copy, Default)]
pub struct MarkerMotion {
    /// Global position, m.
    pub position_m: Vector3<f64>,
    /// Global velocity, m/s.
    pub velocity_m_per_s: Vector3<f64>,
    /// Position in the body frame, deformed, m.
    pub local_m: Vector3<f64>,
    /// Orientation, marker → global. Valid if asked for.
    pub orientation: Matrix3<f64>,
    /// Angular velocity, global, rad/s. Valid if asked for.
    pub omega_rad_per_s: Vector3<f64>,
    /// Map from small interface rotations' rates to angular velocity in the body frame:
    /// `exp(θ̃) T(θ)`, or `T(θ)` by the additive convention. Valid if asked for.
    pub rotation_rate_map: Matrix3<f64>,
}

impl BodyMarker {
    /// Position and velocity.
    #[inline]
    pub fn evaluate_point(&self, body: &BodyMotion, out: &mut MarkerMotion) {
        let (mut local, mut local_rate) = (self.position_m, Vector3::zeros());
        for ((psi, eta), rate) in self.translation.iter().zip(&body.eta).zip(&body.eta_rate) {
            local += psi * *eta;
            local_rate += psi * *rate;
        }
        out.local_m = local;
        out.position_m = body.origin_m + body.rotation * local;
        out.velocity_m_per_s =
            body.velocity_m_per_s + body.rotation * (body.omega_rad_per_s.cross(&local) + local_rate);
    }

    /// Orientation and angular velocity.
    pub fn evaluate_frame(&self, body: &BodyMotion, convention: MarkerRotation, out: &mut MarkerMotion) {
        let (mut angle, mut rate) = (Vector3::zeros(), Vector3::zeros());
        for ((psi, eta), eta_rate) in self.rotation.iter().zip(&body.eta).zip(&body.eta_rate) {
            angle += psi * *eta;
            rate += psi * *eta_rate;
        }
        let turn = exponential(&angle);
        out.orientation = body.rotation * turn;
        out.rotation_rate_map = match convention {
            MarkerRotation::Exact => turn * tangent(&angle),
            MarkerRotation::Additive => tangent(&angle),
        };
        out.omega_rad_per_s = body.rotation * (body.omega_rad_per_s + out.rotation_rate_map * rate);
    }
}
