//! Newmark and generalised-α formulas.

use crate::system::Level;

/// Parameters of a scheme of the Newmark family:
///
/// ```text
/// q_T = q₀ + h q̇₀ + h² ((1/2 − β) a₀ + β a_T)
/// q̇_T = q̇₀ + h ((1 − γ) a₀ + γ a_T)
/// (1 − α_m) a_T + α_m a₀ = (1 − α_f) q̈_T + α_f q̈₀
/// ```
///
/// Equations of motion hold at the end of the step (Arnold and Brüls 2007). Pressures follow the
/// trapezoidal rule.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scheme {
    /// α_m.
    pub alpha_m: f64,
    /// α_f.
    pub alpha_f: f64,
    /// β.
    pub beta: f64,
    /// γ.
    pub gamma: f64,
    /// Level of the joints.
    pub level: Level,
}

impl Scheme {
    /// Trapezoidal rule with velocity-level joints: β = 1/4, γ = 1/2, a = q̈.
    pub const TRAPEZOIDAL_INDEX_2: Self = Self {
        alpha_m: 0.0,
        alpha_f: 0.0,
        beta: 0.25,
        gamma: 0.5,
        level: Level::Velocity,
    };

    /// Generalised-α with position-level joints and the given spectral radius at infinity, in [0, 1).
    #[must_use]
    pub fn generalized_alpha(spectral_radius: f64) -> Self {
        let alpha_m = (2.0 * spectral_radius - 1.0) / (spectral_radius + 1.0);
        let alpha_f = spectral_radius / (spectral_radius + 1.0);
        let gamma = 0.5 - alpha_m + alpha_f;
        let beta = 0.25 * (gamma + 0.5) * (gamma + 0.5);
        Self {
            alpha_m,
            alpha_f,
            beta,
            gamma,
            level: Level::Position,
        }
    }

    /// γ' = dq̇/dq within a step, 1/s.
    #[must_use]
    pub fn velocity_factor(&self, step_s: f64) -> f64 {
        self.gamma / (self.beta * step_s)
    }

    /// β' = dq̈/dq within a step, 1/s².
    #[must_use]
    pub fn acceleration_factor(&self, step_s: f64) -> f64 {
        (1.0 - self.alpha_m) / (self.beta * step_s * step_s * (1.0 - self.alpha_f))
    }
}
