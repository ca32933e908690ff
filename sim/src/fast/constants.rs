//! Constants of the step loop: the body with one payload in its own modes, and the cylinder.

use super::record::Readout;
use hydroflex_openapi::machine::{CylinderSpec, EndStopSpec, FrictionSpec};

/// The body with its payload in mass-normalised modes, padded with zeros to `N` modes. The first
/// `A` modes are those whose products enter the inertia (`sim/theory/minimal_coordinates.md`, §3).
#[derive(Debug, Clone)]
pub(super) struct Constants<const N: usize, const A: usize> {
    /// Modes in use.
    pub(super) used: usize,
    /// Modes with inertia products.
    pub(super) coupled: usize,
    /// Θ₀ about the pivot with the payload, kg m².
    pub(super) inertia_kg_m2: f64,
    /// h₀: coupling of rotation and modes, √kg m.
    pub(super) h0: [f64; N],
    /// c: first-order change of inertia, √kg m.
    pub(super) c: [f64; N],
    /// B, symmetric.
    pub(super) b: [[f64; A]; A],
    /// C by columns: `cc[j][i]` = C_ij, antisymmetric.
    pub(super) cc: [[f64; A]; A],
    /// w², 1/s².
    pub(super) w2: [f64; N],
    /// Diagonal of the damping matrix, 1/s.
    pub(super) d: [f64; N],
    /// Rod end per mode: x, y, z.
    pub(super) rod: [[f64; N]; 3],
    /// Undeformed rod end relative to the pivot; z relative to the cylinder base, m.
    pub(super) rod_m: [f64; 3],
    /// Modal force per gravity component x, y of the body frame.
    pub(super) weight: [[f64; N]; 2],
    /// Modal force of gravity along the axis of rotation.
    pub(super) weight_axial: [f64; N],
    /// First moment Σ m (x, y) that gravity acts on, kg m.
    pub(super) moment_kg_m: [f64; 2],
    /// Its change per mode.
    pub(super) moment: [[f64; N]; 2],
    /// Rows over the modes that sensors read.
    pub(super) sensors: Vec<[f64; N]>,
    /// One per sensor channel.
    pub(super) readouts: Vec<Readout>,
    /// Pivot to cylinder base in the global frame, m.
    pub(super) base_m: [f64; 2],
    /// Gravity in the global frame, m/s².
    pub(super) gravity_m_per_s2: [f64; 2],
    /// Hydraulics.
    pub(super) cylinder: Cylinder,
    /// What a unit of error is.
    pub(super) scale: Scale,
}

/// Typical ranges against which the local error is measured.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scale {
    /// Reciprocal pressure range, 1/Pa.
    pub(super) per_pa: f64,
    /// Reciprocal rod travel, 1/m.
    pub(super) per_m: f64,
    /// Reciprocal rod speed, s/m.
    pub(super) per_m_per_s: f64,
    /// Reciprocal strain energy under the cylinder's full force, 1/J.
    pub(super) per_j: f64,
}

/// Hydraulic cylinder, valve, friction and parallel spring in the form the loop needs.
#[derive(Debug, Clone)]
pub(super) struct Cylinder {
    /// Piston and rod-side areas, m².
    pub(super) area_m2: [f64; 2],
    /// Eye-to-eye length with the rod in, m.
    pub(super) closed_length_m: f64,
    /// Stroke, m.
    pub(super) stroke_m: f64,
    /// Compliance of hose and oil in it: V/K at zero piston volume, m³/Pa.
    pub(super) compliance_m3_per_pa: [f64; 2],
    /// Growth of the compliance with chamber length, m²/Pa.
    pub(super) compliance_slope_m2_per_pa: [f64; 2],
    /// Flow per root of pressure drop, fully open.
    pub(super) flow: f64,
    /// Supply and tank pressure, Pa.
    pub(super) supply_pa: f64,
    /// Tank pressure, Pa.
    pub(super) tank_pa: f64,
    /// Vapour pressure, Pa; −∞ without a floor.
    pub(super) floor_pa: f64,
    /// Viscous damping of the cylinder, N s/m.
    pub(super) damping: f64,
    /// Parallel spring: stiffness, cubic stiffness, damping, free length; zeros if absent.
    pub(super) spring: [f64; 4],
    /// Friction law.
    pub(super) friction: FrictionSpec,
    /// End stops, if any.
    pub(super) stop: Option<EndStopSpec>,
    /// Lengths outside which the valve is shut.
    pub(super) cutoff_m: Option<[f64; 2]>,
    /// Pressure with which the equilibrium search starts, Pa.
    pub(super) initial_pa: f64,
}

impl Cylinder {
    /// Areas, volumes and moduli of a cylinder of the machine file.
    pub(super) fn new(spec: &CylinderSpec) -> Self {
        let disc = |diameter_m: f64| std::f64::consts::FRAC_PI_4 * diameter_m * diameter_m;
        let piston = disc(spec.piston_diameter_m);
        let rod_side = piston - disc(spec.rod_diameter_m);
        let hose_m3 = disc(spec.hose.diameter_m) * spec.hose.length_m;
        // A modulus of zero leaves the term out (theory note §7).
        let reciprocal = |modulus: f64| if modulus > 0.0 { 1.0 / modulus } else { 0.0 };
        let oil = reciprocal(spec.fluid.bulk_modulus_oil_pa);
        let wall = reciprocal(spec.fluid.bulk_modulus_cylinder_pa);
        let hose = reciprocal(spec.fluid.bulk_modulus_hose_pa);
        // V/K = V/K_oil + (V − V_h)/K_wall + V_h/K_hose with V = V_h + A s
        let compliance = hose_m3 * (oil + hose);
        let spring = spec.parallel_spring.map_or([0.0; 4], |s| {
            [
                s.stiffness_n_per_m,
                s.cubic_stiffness_n_per_m3,
                s.damping_n_s_per_m,
                s.free_length_m,
            ]
        });
        Self {
            area_m2: [piston, rod_side],
            closed_length_m: spec.closed_length_m,
            stroke_m: spec.stroke_m,
            compliance_m3_per_pa: [compliance; 2],
            compliance_slope_m2_per_pa: [piston * (oil + wall), rod_side * (oil + wall)],
            flow: spec.valve.flow_coefficient_m3_per_s_per_sqrt_pa,
            supply_pa: spec.valve.supply_pressure_pa,
            tank_pa: spec.valve.tank_pressure_pa,
            floor_pa: spec.fluid.vapour_pressure_pa.unwrap_or(f64::NEG_INFINITY),
            damping: spec.damping_n_s_per_m,
            spring,
            friction: spec.friction,
            stop: spec.end_stop,
            cutoff_m: spec.stroke_cutoff.map(|c| [c.min_length_m, c.max_length_m]),
            initial_pa: spec.initial_pressure_pa,
        }
    }
}
