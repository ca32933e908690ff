//! Spring-damper parallel to a cylinder, as published scripts have it.

use hydroflex_openapi::machine::ParallelSpringSpec;

use crate::hydraulics::cylinder::LineForce;

/// `F = k u + d L̇ + c u³`, `u = L − L_free`, tension positive.
#[must_use]
pub fn force(spec: &ParallelSpringSpec, length_m: f64, velocity_m_per_s: f64) -> LineForce {
    let u = length_m - spec.free_length_m;
    LineForce {
        force_n: u * (spec.stiffness_n_per_m + spec.cubic_stiffness_n_per_m3 * u * u)
            + spec.damping_n_s_per_m * velocity_m_per_s,
        by_length: spec.stiffness_n_per_m + 3.0 * spec.cubic_stiffness_n_per_m3 * u * u,
        by_velocity: spec.damping_n_s_per_m,
    }
}
