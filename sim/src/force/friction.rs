//! Friction between piston and barrel as a function of velocity (theory note §8).

use hydroflex_openapi::machine::FrictionSpec;

use crate::hydraulics::cylinder::LineForce;

/// Friction force, tension positive: it has the sign of the velocity.
///
/// Brown and McPhee (2016), with `r = v/v_t`:
///
/// ```text
/// F = F_c tanh(4 r) + (F_s − F_c) r / (r²/4 + 3/4)² + σ₂ v
/// ```
///
/// Their viscous term carries a factor `tanh(4 F_N/F_nt)` that is one for a loaded piston.
///
/// Stribeck, as the published scripts have it, with `μ_d + μ_s` at the end of the linear part:
///
/// ```text
/// F = (μ_d + μ_s) v / v_r                              |v| ≤ v_r
/// F = sign(v) (μ_d + μ_s exp(−(|v| − v_r)/v_e))        otherwise
/// ```
#[must_use]
pub fn force(spec: &FrictionSpec, velocity_m_per_s: f64) -> LineForce {
    let v = velocity_m_per_s;
    let (force_n, by_velocity) = match *spec {
        FrictionSpec::None => (0.0, 0.0),
        FrictionSpec::BrownMcphee {
            coulomb_n,
            static_n,
            viscous_n_s_per_m,
            transition_velocity_m_per_s,
        } => {
            let r = v / transition_velocity_m_per_s;
            let tanh = libm::tanh(4.0 * r);
            let bell = 0.25 * r * r + 0.75;
            let extra = static_n - coulomb_n;
            let force = coulomb_n * tanh + extra * r / (bell * bell) + viscous_n_s_per_m * v;
            let slope = (coulomb_n * 4.0 * (1.0 - tanh * tanh) + extra * (bell - r * r) / bell.powi(3))
                / transition_velocity_m_per_s
                + viscous_n_s_per_m;
            (force, slope)
        }
        FrictionSpec::Stribeck {
            dynamic_n,
            static_offset_n,
            decay_velocity_m_per_s,
            regularisation_velocity_m_per_s,
        } => {
            let beyond = v.abs() - regularisation_velocity_m_per_s;
            if beyond <= 0.0 {
                let slope = (dynamic_n + static_offset_n) / regularisation_velocity_m_per_s;
                (slope * v, slope)
            } else {
                let decaying = static_offset_n * libm::exp(-beyond / decay_velocity_m_per_s);
                (
                    (dynamic_n + decaying).copysign(v),
                    -decaying / decay_velocity_m_per_s,
                )
            }
        }
    };
    LineForce {
        force_n,
        by_length: 0.0,
        by_velocity,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn laws() -> [FrictionSpec; 2] {
        [
            FrictionSpec::BrownMcphee {
                coulomb_n: 210.0,
                static_n: 300.0,
                viscous_n_s_per_m: 330.0,
                transition_velocity_m_per_s: 5e-3,
            },
            FrictionSpec::Stribeck {
                dynamic_n: 1.0,
                static_offset_n: 1.5,
                decay_velocity_m_per_s: 1e-3,
                regularisation_velocity_m_per_s: 1e-4,
            },
        ]
    }

    #[test]
    fn slope_is_the_derivative_and_force_is_odd() {
        for law in laws() {
            for v in [-0.1, -3e-3, -2e-4, 0.5e-4, 2e-3, 7e-3, 0.2] {
                let h = 1e-8;
                let difference = (force(&law, v + h).force_n - force(&law, v - h).force_n) / (2.0 * h);
                let slope = force(&law, v).by_velocity;
                // Truncation h²/v_t² and rounding 1e-13/h.
                assert!(
                    (difference - slope).abs() < 1e-4 * slope.abs() + 1e-4,
                    "{law:?} {v}"
                );
                assert!((force(&law, v).force_n + force(&law, -v).force_n).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn brown_mcphee_has_its_named_values() {
        let law = laws()[0];
        // At the transition velocity: F_c tanh 4 + (F_s − F_c) + σ₂ v_t, close to static friction.
        let expected = 210.0 * libm::tanh(4.0) + 90.0 + 330.0 * 5e-3;
        assert!((force(&law, 5e-3).force_n - expected).abs() < 1e-10);
        // Far beyond it Coulomb and viscous friction remain.
        let far = force(&law, 1.0).force_n;
        assert!((far - 210.0 - 330.0).abs() < 1e-3, "{far}");
    }
}
