//! Equilibrium at a given angle with the pressures that hold it (theory note §9).

use super::constants::{Constants, ModeSet};
use super::dynamics::{Heading, Point, Rates, Regime, evaluate};
use crate::equilibrium::EquilibriumError;
use crate::trajectory::RunFailure;

/// A state at rest.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rest<const A: usize, const B: usize, const Q: usize> {
    /// State, with the pressures that hold it.
    pub(super) state: Point<f64, A, B, Q>,
    /// Eye-to-eye length, m.
    pub(super) length_m: f64,
}

/// Iterations of the angle; the correction shrinks by the ratio of body to gravity stiffness, about
/// 1e-3 for a boom, per iteration.
const ITERATIONS: usize = 60;

/// Finds the equilibrium with the cylinder as long as it is at `angle_rad` undeformed.
pub(super) fn rest<const A: usize, const B: usize, const Q: usize>(
    c: &Constants<f64, A, B, Q>,
    angle_rad: f64,
) -> Result<Rest<A, B, Q>, RunFailure> {
    let shut = Regime {
        opening: 0.0,
        opening_per_s: 0.0,
        line_pa: [c.cylinder.supply_pa; 2],
        filled: [1.0; 2],
    };
    let mut y = Point::<f64, A, B, Q>::zero();
    y.theta = angle_rad;
    y.p = [c.cylinder.initial_pa; 2];
    let mut r = Rates::zero();
    let at = |y: &Point<f64, A, B, Q>, r: &mut Rates<f64, A, B, Q>| {
        evaluate::<false, f64, f64, A, B, Q>(c, y, &Heading::new(y.theta), 0.0, &shut, r);
    };
    at(&y, &mut r);
    let length_m = r.length;
    let mut correction = f64::INFINITY;
    for _ in 0..ITERATIONS {
        // Moment balance gives the total force along the cylinder, the modes follow from it.
        let [gx, gy] = r.gravity;
        let force = (r.moment[0] * gy - r.moment[1] * gx) / r.jt;
        deflect(&c.coupled, [gx, gy], force, r.n, &mut y.z.coupled);
        deflect(&c.plain, [gx, gy], force, r.n, &mut y.z.plain);
        deflect(&c.follower, [gx, gy], force, r.n, &mut y.z.follower);
        at(&y, &mut r);
        let step = (length_m - r.length) / r.jt;
        y.theta += step;
        at(&y, &mut r);
        if !step.is_finite() {
            return Err(RunFailure::NotFinite {
                quantity: "equilibrium angle",
                t_s: 0.0,
            });
        }
        // Two equal corrections in a row are rounding.
        if step.abs() < 1e-16 || (step.abs() < 1e-12 && step.abs() >= correction) {
            y.lag = force;
            y.p = holding_pressures(c, force - (r.force - r.cylinder_force));
            return Ok(Rest { state: y, length_m });
        }
        correction = step.abs();
    }
    Err(RunFailure::NoEquilibrium(EquilibriumError::NotConverged {
        iterations: ITERATIONS,
        increment: correction,
    }))
}

/// Static deflection of modes under their weight and the cylinder's force.
fn deflect<const N: usize>(
    set: &ModeSet<f64, N>,
    gravity: [f64; 2],
    force: f64,
    n: [f64; 3],
    z: &mut [f64; N],
) {
    for i in 0..set.used {
        let weight = gravity[0] * set.weight[0][i] + gravity[1] * set.weight[1][i] + set.weight_axial[i];
        let j = n[0] * set.rod[0][i] + n[1] * set.rod[1][i] + n[2] * set.rod[2][i];
        z[i] = (weight - force * j) / set.w2[i];
    }
}

/// Pressures with A₂ p₂ − A₁ p₁ = `force_n`: the rod side keeps its initial pressure as long as the
/// piston side stays between tank and supply.
fn holding_pressures<const A: usize, const B: usize, const Q: usize>(
    c: &Constants<f64, A, B, Q>,
    force_n: f64,
) -> [f64; 2] {
    let cylinder = &c.cylinder;
    let [a1, a2] = cylinder.area_m2;
    let rod = cylinder.initial_pa;
    let piston = (a2 * rod - force_n) / a1;
    if piston > cylinder.tank_pa && piston < cylinder.supply_pa {
        return [piston, rod];
    }
    // A little distance: at the very end one metering edge has no pressure drop.
    let margin = 0.02 * (cylinder.supply_pa - cylinder.tank_pa);
    let piston = piston.clamp(cylinder.tank_pa + margin, cylinder.supply_pa - margin);
    [piston, (force_n + a1 * piston) / a2]
}
