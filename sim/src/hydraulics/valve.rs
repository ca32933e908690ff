//! Flow through one metering edge of a 4/3 valve.

use hydroflex_openapi::machine::ValveSpec;

/// `sign(x) √|x|`.
#[inline]
#[must_use]
pub fn signed_sqrt(x: f64) -> f64 {
    x.abs().sqrt().copysign(x)
}

/// Flow into a chamber at `pressure_pa` with the given opening in [−1, 1], m³/s: from the supply
/// where the opening is positive, to the tank where it is negative.
#[inline]
#[must_use]
pub fn flow_m3_per_s(valve: &ValveSpec, opening_ratio: f64, pressure_pa: f64) -> f64 {
    let coefficient = opening_ratio * valve.flow_coefficient_m3_per_s_per_sqrt_pa;
    if opening_ratio >= 0.0 {
        coefficient * signed_sqrt(valve.supply_pressure_pa - pressure_pa)
    } else {
        coefficient * signed_sqrt(pressure_pa - valve.tank_pressure_pa)
    }
}

/// Solution of `p = b + κ Q(p)` and `dp/db`, for `κ ≥ 0`.
///
/// With `x` the pressure drop over the open edge and `z = sign(x) √|x|`, both edges lead to
/// `z |z| + C z = D`, `C = κ |opening| Q_n`, whose only root is written down below. No iteration
/// can fail here, and the infinite slope of the square root at `x = 0` does no harm.
#[inline]
#[must_use]
pub fn implicit_pressure(valve: &ValveSpec, opening_ratio: f64, base_pa: f64, kappa: f64) -> (f64, f64) {
    let c = kappa * opening_ratio.abs() * valve.flow_coefficient_m3_per_s_per_sqrt_pa;
    if c <= 0.0 {
        return (base_pa, 1.0);
    }
    let root = |d: f64| {
        // −C/2 + √(C²/4 + |D|), written without cancellation.
        let half = 0.5 * c;
        (d.abs() / (half + (half * half + d.abs()).sqrt())).copysign(d)
    };
    let (z, pressure) = if opening_ratio >= 0.0 {
        let z = root(valve.supply_pressure_pa - base_pa);
        (z, valve.supply_pressure_pa - z * z.abs())
    } else {
        let z = root(base_pa - valve.tank_pressure_pa);
        (z, valve.tank_pressure_pa + z * z.abs())
    };
    (pressure, 2.0 * z.abs() / (2.0 * z.abs() + c))
}

#[cfg(test)]
mod tests {
    use super::*;

    const VALVE: ValveSpec = ValveSpec {
        flow_coefficient_m3_per_s_per_sqrt_pa: 3.6e-7,
        supply_pressure_pa: 140e5,
        tank_pressure_pa: 1e5,
    };

    #[test]
    fn implicit_pressure_solves_its_equation() {
        let kappa = 0.0025 * 2.5e12;
        for opening in [-1.0, -0.3, -1e-6, 0.0, 1e-6, 0.2, 1.0] {
            for base in [-3e5, 0.5e5, 1e5, 1.2e5, 50e5, 139.9e5, 140e5, 180e5] {
                let (p, slope) = implicit_pressure(&VALVE, opening, base, kappa);
                let residual = p - base - kappa * flow_m3_per_s(&VALVE, opening, p);
                // Rounding of numbers near 1e7; at zero drop the square root magnifies it.
                assert!(
                    residual.abs() < 1e-1,
                    "opening {opening}, base {base}: {residual}"
                );
                // At zero drop the slope has a cusp; differences say nothing there.
                let near = |edge: f64| (base - edge).abs() < 1e3;
                if near(VALVE.supply_pressure_pa) || near(VALVE.tank_pressure_pa) {
                    continue;
                }
                let step = 10.0;
                let (above, _) = implicit_pressure(&VALVE, opening, base + step, kappa);
                let (below, _) = implicit_pressure(&VALVE, opening, base - step, kappa);
                let difference = (above - below) / (2.0 * step);
                // Curvature over ten pascals, and rounding of 1e7 over ten pascals.
                assert!(
                    (difference - slope).abs() < 1e-6,
                    "{opening} {base}: {difference} {slope}"
                );
                assert!((0.0..=1.0).contains(&slope));
            }
        }
    }

    #[test]
    fn oil_runs_from_supply_and_to_tank() {
        assert!(flow_m3_per_s(&VALVE, 1.0, 50e5) > 0.0);
        assert!(flow_m3_per_s(&VALVE, 1.0, 150e5) < 0.0);
        assert!(flow_m3_per_s(&VALVE, -1.0, 50e5) < 0.0);
        assert!(flow_m3_per_s(&VALVE, -1.0, 0.5e5) > 0.0);
        let nominal = flow_m3_per_s(&VALVE, 0.5, 140e5 - 35e5);
        assert!((nominal - 0.5 * 3.6e-7 * 35e5_f64.sqrt()).abs() < 1e-18);
    }
}
