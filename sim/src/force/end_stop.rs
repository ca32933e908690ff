//! End stops: the piston meets the barrel's ends.

use hydroflex_openapi::machine::EndStopSpec;

use crate::hydraulics::cylinder::LineForce;

/// Depth over which the damping of a stop grows from nothing to its full value, m. It makes the
/// force continuous when the piston arrives with a velocity.
pub const DAMPING_DEPTH_M: f64 = 1e-4;

/// Force of the stops, tension positive: `k·depth + d·min(1, depth/δ)·(depth rate)`, at least zero, pushing
/// the piston back into its range `0 ≤ x ≤ stroke`.
#[must_use]
pub fn force(spec: &EndStopSpec, stroke_limit_m: f64, stroke_m: f64, velocity_m_per_s: f64) -> LineForce {
    // Sign: at the inner stop the force pushes the eyes apart (negative), at the outer one it pulls.
    let (sign, depth) = if stroke_m < 0.0 {
        (-1.0, -stroke_m)
    } else if stroke_m > stroke_limit_m {
        (1.0, stroke_m - stroke_limit_m)
    } else {
        return LineForce::default();
    };
    let rate = sign * velocity_m_per_s;
    let share = (depth / DAMPING_DEPTH_M).min(1.0);
    let push = spec.stiffness_n_per_m * depth + spec.damping_n_s_per_m * share * rate;
    if push <= 0.0 {
        return LineForce::default();
    }
    let share_slope = if share < 1.0 { rate / DAMPING_DEPTH_M } else { 0.0 };
    LineForce {
        force_n: sign * push,
        by_length: spec.stiffness_n_per_m + spec.damping_n_s_per_m * share_slope,
        by_velocity: spec.damping_n_s_per_m * share,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STOP: EndStopSpec = EndStopSpec {
        stiffness_n_per_m: 1e8,
        damping_n_s_per_m: 1e5,
    };

    #[test]
    fn stops_push_inwards_and_never_pull() {
        assert!(force(&STOP, 0.5, -1e-3, 0.0).force_n < 0.0);
        assert!(force(&STOP, 0.5, 0.501, 0.0).force_n > 0.0);
        assert!(force(&STOP, 0.5, 0.25, 3.0).force_n.abs() < 1e-300);
        assert!(force(&STOP, 0.5, 0.5001, -10.0).force_n.abs() < 1e-300);
        // Continuous at first touch, whatever the velocity.
        assert!(force(&STOP, 0.5, 0.5 + 1e-12, 1.0).force_n < 1.1e-2);
    }

    #[test]
    fn derivatives_match_differences() {
        for (x, v) in [(-0.5e-4, -0.1), (-2e-3, 0.3), (0.500_05, 0.1), (0.503, -0.2)] {
            let h = 1e-9;
            let f = |x, v| force(&STOP, 0.5, x, v).force_n;
            let at = force(&STOP, 0.5, x, v);
            // Piecewise quadratic: central differences are exact up to rounding 1e-11/h.
            assert!(
                ((f(x + h, v) - f(x - h, v)) / (2.0 * h) - at.by_length).abs() < 1e-5 * at.by_length.abs()
            );
            assert!(((f(x, v + h) - f(x, v - h)) / (2.0 * h) - at.by_velocity).abs() < 1e-4 * at.by_velocity);
        }
    }
}
