//! A double-acting cylinder: two chambers, damping, friction, parallel spring and end stops.

use hydroflex_openapi::machine::{CylinderSpec, StrokeCutoffSpec, ValveSpec};

use super::chamber::{Chamber, ChamberStep, Side};
use crate::force::{end_stop, friction, spring};

/// Constants of a cylinder.
#[derive(Debug, Clone, PartialEq)]
pub struct Cylinder {
    spec: CylinderSpec,
    /// Chamber without rod.
    pub piston: Chamber,
    /// Chamber with rod.
    pub rod: Chamber,
}

/// Force along the line between the eyes, tension positive, and its derivatives.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LineForce {
    /// Force, N.
    pub force_n: f64,
    /// ∂F/∂L, N/m.
    pub by_length: f64,
    /// ∂F/∂L̇, N s/m.
    pub by_velocity: f64,
}

impl std::ops::AddAssign for LineForce {
    fn add_assign(&mut self, other: Self) {
        self.force_n += other.force_n;
        self.by_length += other.by_length;
        self.by_velocity += other.by_velocity;
    }
}

impl Cylinder {
    /// A cylinder as described.
    #[must_use]
    pub fn new(spec: &CylinderSpec) -> Self {
        Self {
            piston: Chamber::new(spec, Side::Piston),
            rod: Chamber::new(spec, Side::Rod),
            spec: spec.clone(),
        }
    }

    /// Name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.spec.name
    }

    /// Valve and supply.
    #[must_use]
    pub fn valve(&self) -> &ValveSpec {
        &self.spec.valve
    }

    /// Description.
    #[must_use]
    pub fn spec(&self) -> &CylinderSpec {
        &self.spec
    }

    /// Stroke x, m, from the eye-to-eye length.
    #[inline]
    #[must_use]
    pub fn stroke_m(&self, length_m: f64) -> f64 {
        length_m - self.spec.closed_length_m
    }

    /// Whether the valve is held shut at this length.
    #[must_use]
    pub fn is_cut_off(&self, length_m: f64) -> bool {
        self.spec.stroke_cutoff.is_some_and(
            |StrokeCutoffSpec {
                 min_length_m,
                 max_length_m,
             }| { length_m < min_length_m || length_m > max_length_m },
        )
    }

    /// Force of oil and cylinder damping, `−p₁A₁ + p₂A₂ + d L̇`: the channel `force_*_n`.
    #[inline]
    #[must_use]
    pub fn oil_force_n(&self, pressures_pa: [f64; 2], velocity_m_per_s: f64) -> f64 {
        self.rod.area_m2 * pressures_pa[1] - self.piston.area_m2 * pressures_pa[0]
            + self.spec.damping_n_s_per_m * velocity_m_per_s
    }

    /// Everything that acts beside oil and cylinder damping: friction, parallel spring, end stops.
    #[must_use]
    pub fn parallel_force(&self, length_m: f64, velocity_m_per_s: f64) -> LineForce {
        let mut force = friction::force(&self.spec.friction, velocity_m_per_s);
        if let Some(spec) = &self.spec.parallel_spring {
            force += spring::force(spec, length_m, velocity_m_per_s);
        }
        if let Some(spec) = &self.spec.end_stop {
            force += end_stop::force(
                spec,
                self.spec.stroke_m,
                self.stroke_m(length_m),
                velocity_m_per_s,
            );
        }
        force
    }

    /// Total force with given pressures; derivatives at constant pressures.
    #[must_use]
    pub fn force(&self, length_m: f64, velocity_m_per_s: f64, pressures_pa: [f64; 2]) -> LineForce {
        let mut force = self.parallel_force(length_m, velocity_m_per_s);
        force += LineForce {
            force_n: self.oil_force_n(pressures_pa, velocity_m_per_s),
            by_length: 0.0,
            by_velocity: self.spec.damping_n_s_per_m,
        };
        force
    }

    /// Rates of both pressures, Pa/s.
    #[must_use]
    pub fn pressure_rates_pa_per_s(
        &self,
        valve_ratio: f64,
        length_m: f64,
        velocity_m_per_s: f64,
        pressures_pa: [f64; 2],
    ) -> [f64; 2] {
        let x = self.stroke_m(length_m);
        let valve = &self.spec.valve;
        [
            self.piston
                .pressure_rate_pa_per_s(valve, valve_ratio, x, velocity_m_per_s, pressures_pa[0]),
            self.rod
                .pressure_rate_pa_per_s(valve, valve_ratio, x, velocity_m_per_s, pressures_pa[1]),
        ]
    }

    /// Total force and both chambers at the end of a step of the trapezoidal rule. Derivatives
    /// include the pressures' dependence on the motion: the pressures need no unknowns.
    #[must_use]
    pub fn trapezoidal_step(
        &self,
        valve_ratio: f64,
        half_step_s: f64,
        start: [(f64, f64); 2],
        length_m: f64,
        velocity_m_per_s: f64,
    ) -> (LineForce, [ChamberStep; 2]) {
        let x = self.stroke_m(length_m);
        let valve = &self.spec.valve;
        let piston =
            self.piston
                .trapezoidal_step(valve, valve_ratio, half_step_s, start[0], x, velocity_m_per_s);
        let rod = self
            .rod
            .trapezoidal_step(valve, valve_ratio, half_step_s, start[1], x, velocity_m_per_s);
        let mut force = self.force(length_m, velocity_m_per_s, [piston.pressure_pa, rod.pressure_pa]);
        let (a1, a2) = (self.piston.area_m2, self.rod.area_m2);
        force.by_length += a2 * rod.by_stroke - a1 * piston.by_stroke;
        force.by_velocity += a2 * rod.by_velocity - a1 * piston.by_velocity;
        (force, [piston, rod])
    }
}
