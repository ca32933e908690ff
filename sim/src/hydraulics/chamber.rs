//! One chamber with its hose: lumped oil with a stroke-dependent stiffness.

use std::f64::consts::FRAC_PI_4;

use hydroflex_openapi::machine::{CylinderSpec, ValveSpec};

use super::valve::{flow_m3_per_s, implicit_pressure, signed_sqrt};

/// Which chamber.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// Without the rod: grows as the cylinder extends.
    Piston,
    /// Around the rod: shrinks as the cylinder extends.
    Rod,
}

/// Constants of a chamber. Stroke x is counted from the rod fully in.
#[derive(Debug, Clone, PartialEq)]
pub struct Chamber {
    /// Piston area that the oil sees, m².
    pub area_m2: f64,
    /// +1 where the volume grows with the stroke, −1 where it shrinks; also the sign with which
    /// the chamber follows the valve signal.
    pub sign: f64,
    /// Compliance V/B_e at x = 0, m³/Pa.
    compliance_closed_m3_per_pa: f64,
    /// Its derivative with respect to x, m²/Pa.
    compliance_slope_m2_per_pa: f64,
    /// Smallest compliance used: that of a hundredth of the hose.
    compliance_least_m3_per_pa: f64,
    /// Oil volume at x = 0, m³.
    volume_closed_m3: f64,
    /// Floor of the pressure, Pa.
    floor_pa: f64,
}

/// Chamber at the end of an implicit step.
#[derive(Debug, Clone, Copy, Default)]
pub struct ChamberStep {
    /// Pressure, Pa.
    pub pressure_pa: f64,
    /// Its rate, Pa/s.
    pub rate_pa_per_s: f64,
    /// ∂p/∂x, Pa/m.
    pub by_stroke: f64,
    /// ∂p/∂ẋ, Pa s/m.
    pub by_velocity: f64,
}

/// Rate of a chamber's pressure, and its derivatives.
#[derive(Debug, Clone, Copy, Default)]
pub struct ChamberRate {
    /// Pa/s.
    pub rate_pa_per_s: f64,
    /// ∂ṗ/∂p, 1/s.
    pub by_pressure: f64,
    /// ∂ṗ/∂x, Pa/(s m).
    pub by_stroke: f64,
    /// ∂ṗ/∂ẋ, Pa/m.
    pub by_velocity: f64,
    /// ∂ṗ/∂U, Pa/s.
    pub by_valve: f64,
}

/// Root of the pressure drop below which the slope of the flow is taken as that at this root, √Pa.
const ROOT_LEAST: f64 = 30.0;

impl Chamber {
    /// The chamber of a cylinder.
    ///
    /// `1/B_e = 1/B_oil + (V − V_h)/(V B_cyl) + V_h/(V B_hose)`, so `V/B_e` is linear in the
    /// stroke; a modulus of zero means that its term is left out.
    #[must_use]
    pub fn new(spec: &CylinderSpec, side: Side) -> Self {
        let piston_area = FRAC_PI_4 * spec.piston_diameter_m.powi(2);
        let hose = FRAC_PI_4 * spec.hose.diameter_m.powi(2) * spec.hose.length_m;
        let (area, sign, barrel_closed) = match side {
            Side::Piston => (piston_area, 1.0, 0.0),
            Side::Rod => {
                let area = piston_area - FRAC_PI_4 * spec.rod_diameter_m.powi(2);
                (area, -1.0, area * spec.stroke_m)
            }
        };
        let inverse = |modulus: f64| if modulus > 0.0 { 1.0 / modulus } else { 0.0 };
        let barrel = inverse(spec.fluid.bulk_modulus_oil_pa) + inverse(spec.fluid.bulk_modulus_cylinder_pa);
        let in_hose = inverse(spec.fluid.bulk_modulus_oil_pa) + inverse(spec.fluid.bulk_modulus_hose_pa);
        Self {
            area_m2: area,
            sign,
            compliance_closed_m3_per_pa: hose * in_hose + barrel_closed * barrel,
            compliance_slope_m2_per_pa: sign * area * barrel,
            compliance_least_m3_per_pa: 0.01 * hose * in_hose,
            volume_closed_m3: hose + barrel_closed,
            floor_pa: spec.fluid.vapour_pressure_pa.unwrap_or(f64::NEG_INFINITY),
        }
    }

    /// Oil volume, m³.
    #[must_use]
    pub fn volume_m3(&self, stroke_m: f64) -> f64 {
        self.volume_closed_m3 + self.sign * self.area_m2 * stroke_m
    }

    /// V/B_e, m³/Pa.
    #[inline]
    #[must_use]
    pub fn compliance_m3_per_pa(&self, stroke_m: f64) -> f64 {
        (self.compliance_closed_m3_per_pa + self.compliance_slope_m2_per_pa * stroke_m)
            .max(self.compliance_least_m3_per_pa)
    }

    /// Lowest pressure, Pa: vapour pressure, or minus infinity.
    #[must_use]
    pub fn floor_pa(&self) -> f64 {
        self.floor_pa
    }

    /// ṗ, Pa/s. At the floor the pressure can only rise.
    #[inline]
    #[must_use]
    pub fn pressure_rate_pa_per_s(
        &self,
        valve: &ValveSpec,
        valve_ratio: f64,
        stroke_m: f64,
        velocity_m_per_s: f64,
        pressure_pa: f64,
    ) -> f64 {
        let flow = flow_m3_per_s(valve, self.sign * valve_ratio, pressure_pa);
        let rate = (flow - self.sign * self.area_m2 * velocity_m_per_s) / self.compliance_m3_per_pa(stroke_m);
        if pressure_pa <= self.floor_pa {
            rate.max(0.0)
        } else {
            rate
        }
    }

    /// ṗ of a filled chamber and its derivatives, while the valve's signal keeps the sign that `extends` says (true: the
    /// piston side is fed), zero included.
    #[inline]
    #[must_use]
    pub fn rate_and_slopes(
        &self,
        valve: &ValveSpec,
        valve_ratio: f64,
        extends: bool,
        stroke_m: f64,
        velocity_m_per_s: f64,
        pressure_pa: f64,
    ) -> ChamberRate {
        // A full opening's flow at the drop over the edge that this sign opens.
        let is_fed = extends == (self.sign > 0.0);
        let drop = if is_fed {
            valve.supply_pressure_pa - pressure_pa
        } else {
            valve.tank_pressure_pa - pressure_pa
        };
        let root = signed_sqrt(drop) * valve.flow_coefficient_m3_per_s_per_sqrt_pa;
        let direction = if extends { 1.0 } else { -1.0 };
        let opening = (direction * valve_ratio).max(0.0);
        let compliance = self.compliance_m3_per_pa(stroke_m);
        let rate = (opening * root - self.sign * self.area_m2 * velocity_m_per_s) / compliance;
        // The slope of the root is unbounded at zero drop; a bound there costs accuracy only.
        let root_slope =
            0.5 * valve.flow_coefficient_m3_per_s_per_sqrt_pa / drop.abs().sqrt().max(ROOT_LEAST);
        ChamberRate {
            rate_pa_per_s: rate,
            by_pressure: -opening * root_slope / compliance,
            by_stroke: -rate * self.compliance_slope_m2_per_pa / compliance,
            by_velocity: -self.sign * self.area_m2 / compliance,
            by_valve: direction * root / compliance,
        }
    }

    /// One step of the trapezoidal rule, `p = p₀ + h/2 (ṗ₀ + ṗ)`, solved for given motion at the
    /// end of the step.
    #[inline]
    #[must_use]
    pub fn trapezoidal_step(
        &self,
        valve: &ValveSpec,
        valve_ratio: f64,
        half_step_s: f64,
        start: (f64, f64),
        stroke_m: f64,
        velocity_m_per_s: f64,
    ) -> ChamberStep {
        let (pressure_start, rate_start) = start;
        let opening = self.sign * valve_ratio;
        let compliance = self.compliance_m3_per_pa(stroke_m);
        let kappa = half_step_s / compliance;
        let displaced = -self.sign * self.area_m2 * velocity_m_per_s;
        let base = pressure_start + half_step_s * rate_start + kappa * displaced;
        let (pressure, slope) = implicit_pressure(valve, opening, base, kappa);
        if pressure <= self.floor_pa {
            let rate =
                self.pressure_rate_pa_per_s(valve, valve_ratio, stroke_m, velocity_m_per_s, self.floor_pa);
            return ChamberStep {
                pressure_pa: self.floor_pa,
                rate_pa_per_s: rate,
                by_stroke: 0.0,
                by_velocity: 0.0,
            };
        }
        let inflow = flow_m3_per_s(valve, opening, pressure) + displaced;
        ChamberStep {
            pressure_pa: pressure,
            rate_pa_per_s: inflow / compliance,
            by_stroke: -slope * kappa * inflow * self.compliance_slope_m2_per_pa / compliance,
            by_velocity: -slope * kappa * self.sign * self.area_m2,
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use hydroflex_openapi::machine::{Attachment, FluidSpec, FrictionSpec, HoseSpec};

    /// The published lift cylinder.
    pub(crate) fn published() -> CylinderSpec {
        let eye = Attachment {
            body: "ground".to_owned(),
            interface: None,
            point_m: Some([0.0; 3]),
        };
        CylinderSpec {
            name: "lift".to_owned(),
            base: eye.clone(),
            rod: eye,
            closed_length_m: 0.820,
            stroke_m: 0.535,
            piston_diameter_m: 0.1,
            rod_diameter_m: 0.056,
            damping_n_s_per_m: 6.4e5,
            hose: HoseSpec {
                diameter_m: 0.0127,
                length_m: 1.5,
            },
            fluid: FluidSpec {
                bulk_modulus_oil_pa: 1650e6,
                bulk_modulus_cylinder_pa: 2.1e11,
                bulk_modulus_hose_pa: 700e6,
                vapour_pressure_pa: None,
            },
            valve: ValveSpec {
                flow_coefficient_m3_per_s_per_sqrt_pa: 3.60022e-7,
                supply_pressure_pa: 160e5,
                tank_pressure_pa: 1e5,
            },
            friction: FrictionSpec::None,
            parallel_spring: None,
            end_stop: None,
            start_length_m: None,
            stroke_cutoff: None,
            initial_pressure_pa: 1e7,
        }
    }

    #[test]
    fn compliance_is_the_formula_of_the_theory_note() {
        let spec = published();
        for side in [Side::Piston, Side::Rod] {
            let chamber = Chamber::new(&spec, side);
            for x in [0.0, 0.2, 0.5] {
                let hose = FRAC_PI_4 * 0.0127_f64.powi(2) * 1.5;
                let v = chamber.volume_m3(x);
                let inverse = 1.0 / 1650e6 + (v - hose) / (v * 2.1e11) + hose / (v * 700e6);
                let expected = v * inverse;
                assert!((chamber.compliance_m3_per_pa(x) / expected - 1.0).abs() < 1e-13);
            }
        }
    }

    #[test]
    fn oil_in_minus_oil_out_is_oil_stored() {
        // Closed valve, constant modulus: p − p₀ = −B ln(V/V₀) in the limit of small steps.
        let mut spec = published();
        spec.fluid.bulk_modulus_cylinder_pa = 0.0;
        spec.fluid.bulk_modulus_hose_pa = 0.0;
        let chamber = Chamber::new(&spec, Side::Piston);
        let (x0, velocity, steps, h) = (0.1, -0.01, 1000, 1e-3);
        let (mut p, mut rate) = (1e5, 0.0);
        rate += chamber.pressure_rate_pa_per_s(&spec.valve, 0.0, x0, velocity, p);
        for k in 1..=steps {
            let x = x0 + velocity * h * f64::from(k);
            let end = chamber.trapezoidal_step(&spec.valve, 0.0, 0.5 * h, (p, rate), x, velocity);
            (p, rate) = (end.pressure_pa, end.rate_pa_per_s);
        }
        let exact = 1e5 - 1650e6 * libm::log(chamber.volume_m3(x0 - 0.01) / chamber.volume_m3(x0));
        // Trapezoidal rule, relative step of the volume 1e-4: error far below 1e-7.
        assert!((p / exact - 1.0).abs() < 1e-7, "{p} {exact}");
    }

    #[test]
    fn step_derivatives_match_differences() {
        let spec = published();
        for side in [Side::Piston, Side::Rod] {
            let chamber = Chamber::new(&spec, side);
            for u in [-0.7, 0.0, 0.4] {
                let at = |x: f64, v: f64| chamber.trapezoidal_step(&spec.valve, u, 0.0025, (6e6, 1e7), x, v);
                let (x, v, dx, dv) = (0.2, 0.03, 1e-6, 1e-6);
                let by_x = (at(x + dx, v).pressure_pa - at(x - dx, v).pressure_pa) / (2.0 * dx);
                let by_v = (at(x, v + dv).pressure_pa - at(x, v - dv).pressure_pa) / (2.0 * dv);
                let mid = at(x, v);
                // Rounding of pressures near 1e7 over a difference of 1e-6.
                assert!(
                    (by_x - mid.by_stroke).abs() < 1e-6 * by_x.abs() + 1e-2,
                    "{by_x} {}",
                    mid.by_stroke
                );
                assert!((by_v - mid.by_velocity).abs() < 1e-6 * by_v.abs() + 1e-2);
                let rate = chamber.pressure_rate_pa_per_s(&spec.valve, u, x, v, mid.pressure_pa);
                assert!((mid.pressure_pa - 6e6 - 0.0025 * (1e7 + rate)).abs() < 1e-3);
            }
        }
    }

    #[test]
    fn a_chamber_never_falls_below_vapour_pressure() {
        let mut spec = published();
        spec.fluid.vapour_pressure_pa = Some(2e3);
        let chamber = Chamber::new(&spec, Side::Piston);
        let end = chamber.trapezoidal_step(&spec.valve, 0.0, 0.0025, (1e5, 0.0), 0.2, 0.5);
        assert!((end.pressure_pa - 2e3).abs() < 1e-9);
        assert!(end.rate_pa_per_s.abs() < 1e-9);
        // And it rises again as soon as the piston comes back.
        let back = chamber.trapezoidal_step(&spec.valve, 0.0, 0.0025, (2e3, 0.0), 0.2, -0.01);
        assert!(back.pressure_pa > 2e3 && back.rate_pa_per_s > 0.0);
    }
}
