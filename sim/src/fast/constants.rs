//! Constants of the step loop: the body with one payload in its own modes, and the cylinder.
//!
//! `K` is what a constant is: a number where all runs share the modes, a pack where every lane has its own
//! ([`Coefficient`]).

use super::lane::Lane;
use super::record::Readout;
use hydroflex_openapi::machine::{CylinderSpec, EndStopSpec, FrictionSpec};

/// Constants of one kind of modes, padded with zeros to `N`.
#[derive(Debug, Clone)]
pub(super) struct ModeSet<K, const N: usize> {
    /// Modes in use.
    pub(super) used: usize,
    /// w², 1/s².
    pub(super) w2: [K; N],
    /// Diagonal of the damping matrix, 1/s.
    pub(super) d: [K; N],
    /// h₀: coupling of rotation and modes, √kg m.
    pub(super) h0: [K; N],
    /// Rod end per mode: x, y, z.
    pub(super) rod: [[K; N]; 3],
    /// Modal force per gravity component x, y of the body frame.
    pub(super) weight: [[K; N]; 2],
    /// Modal force of gravity along the axis of rotation.
    pub(super) weight_axial: [K; N],
    /// Change of the first moment that gravity acts on, per mode.
    pub(super) moment: [[K; N]; 2],
}

/// What a sensor row reads.
#[derive(Debug, Clone)]
pub(super) struct SensorRow<K, const A: usize, const B: usize, const Q: usize> {
    /// Per coupled mode.
    pub(super) coupled: [K; A],
    /// Per plain mode.
    pub(super) plain: [K; B],
    /// Per follower.
    pub(super) follower: [K; Q],
    /// Of modes that lag: per gravity x, gravity y, 1, and lagged force x, y, z.
    pub(super) lagging: [K; 6],
}

/// The body with its payload in mass-normalised modes, by what they take part in
/// (`sim/theory/minimal_coordinates.md`, §3): `A` coupled modes, whose products enter the inertia; `B`
/// plain ones, linear; `Q` followers, which do not act back. Modes that lag have no state.
#[derive(Debug, Clone)]
pub(super) struct Constants<K, const A: usize, const B: usize, const Q: usize> {
    /// Coupled modes.
    pub(super) coupled: ModeSet<K, A>,
    /// Plain modes.
    pub(super) plain: ModeSet<K, B>,
    /// Followers.
    pub(super) follower: ModeSet<K, Q>,
    /// Θ₀ − |h₀|² over the modes that act back, kg m²: what moves with the frame whatever they do.
    pub(super) hub_kg_m2: K,
    /// Its first-order change g = c + Cᵀh₀, √kg m, nearly zero where the modes are many.
    pub(super) hub_change: [K; A],
    /// Its second-order change G = B − CᵀC, symmetric.
    pub(super) hub_curvature: [[K; A]; A],
    /// c: half the first-order change of Θ, √kg m.
    pub(super) c: [K; A],
    /// B, symmetric.
    pub(super) b: [[K; A]; A],
    /// C by columns: `cc[j][i]` = C_ij, antisymmetric.
    pub(super) cc: [[K; A]; A],
    /// c of plain modes.
    pub(super) plain_c: [K; B],
    /// Rows of C for plain modes, by columns of coupled modes.
    pub(super) plain_cc: [[K; B]; A],
    /// The same of followers.
    pub(super) follower_c: [K; Q],
    /// The same of followers.
    pub(super) follower_cc: [[K; Q]; A],
    /// Reciprocal of the lag, 1/s; 0 if no mode lags.
    pub(super) lag_per_s: K,
    /// Undeformed rod end relative to the pivot; z relative to the cylinder base, m.
    pub(super) rod_m: [f64; 3],
    /// First moment Σ m (x, y) that gravity acts on, kg m.
    pub(super) moment_kg_m: [K; 2],
    /// Rows over the modes that sensors read.
    pub(super) sensors: Vec<SensorRow<K, A, B, Q>>,
    /// One per sensor channel.
    pub(super) readouts: Vec<Readout>,
    /// Pivot to cylinder base in the global frame, m.
    pub(super) base_m: [f64; 2],
    /// Gravity in the global frame, m/s².
    pub(super) gravity_m_per_s2: [f64; 2],
    /// Hydraulics.
    pub(super) cylinder: Cylinder,
    /// What a unit of error is.
    pub(super) scale: Scale<K>,
}

/// Typical ranges against which the local error is measured.
#[derive(Debug, Clone, Copy)]
#[allow(clippy::struct_field_names, reason = "each is a reciprocal of a unit")]
pub(super) struct Scale<K> {
    /// Reciprocal pressure range, 1/Pa.
    pub(super) per_pa: K,
    /// Reciprocal rod travel, 1/m.
    pub(super) per_m: K,
    /// Reciprocal rod speed, s/m.
    pub(super) per_m_per_s: K,
    /// Reciprocal strain energy under the cylinder's full force, 1/J.
    pub(super) per_j: K,
}

impl<L: Lane, const A: usize, const B: usize, const Q: usize> Constants<L, A, B, Q> {
    /// The same body in every lane.
    pub(super) fn splat(from: &Constants<f64, A, B, Q>) -> Self {
        fn row<L: Lane, const N: usize>(from: &[f64; N]) -> [L; N] {
            from.map(L::splat)
        }
        fn set<L: Lane, const N: usize>(from: &ModeSet<f64, N>) -> ModeSet<L, N> {
            ModeSet {
                used: from.used,
                w2: row(&from.w2),
                d: row(&from.d),
                h0: row(&from.h0),
                rod: from.rod.map(|r| row(&r)),
                weight: from.weight.map(|r| row(&r)),
                weight_axial: row(&from.weight_axial),
                moment: from.moment.map(|r| row(&r)),
            }
        }
        let all = |x: &f64| L::splat(*x);
        let sensor = |from: &SensorRow<f64, A, B, Q>| SensorRow {
            coupled: row(&from.coupled),
            plain: row(&from.plain),
            follower: row(&from.follower),
            lagging: row(&from.lagging),
        };
        Self {
            coupled: set(&from.coupled),
            plain: set(&from.plain),
            follower: set(&from.follower),
            hub_kg_m2: all(&from.hub_kg_m2),
            hub_change: row(&from.hub_change),
            hub_curvature: from.hub_curvature.map(|r| row(&r)),
            c: row(&from.c),
            b: from.b.map(|r| row(&r)),
            cc: from.cc.map(|r| row(&r)),
            plain_c: row(&from.plain_c),
            plain_cc: from.plain_cc.map(|r| row(&r)),
            follower_c: row(&from.follower_c),
            follower_cc: from.follower_cc.map(|r| row(&r)),
            lag_per_s: all(&from.lag_per_s),
            rod_m: from.rod_m,
            moment_kg_m: row(&from.moment_kg_m),
            sensors: from.sensors.iter().map(sensor).collect(),
            readouts: from.readouts.clone(),
            base_m: from.base_m,
            gravity_m_per_s2: from.gravity_m_per_s2,
            cylinder: from.cylinder.clone(),
            scale: Scale {
                per_pa: all(&from.scale.per_pa),
                per_m: all(&from.scale.per_m),
                per_m_per_s: all(&from.scale.per_m_per_s),
                per_j: all(&from.scale.per_j),
            },
        }
    }

    /// Another payload's body in one lane. The machine is the same.
    pub(super) fn set_lane(&mut self, lane: usize, from: &Constants<f64, A, B, Q>) {
        fn row<L: Lane, const N: usize>(lane: usize, to: &mut [L; N], from: &[f64; N]) {
            for (to, from) in to.iter_mut().zip(from) {
                to.set(lane, *from);
            }
        }
        fn rows<L: Lane, const N: usize, const M: usize>(
            lane: usize,
            to: &mut [[L; N]; M],
            from: &[[f64; N]; M],
        ) {
            for (to, from) in to.iter_mut().zip(from) {
                row(lane, to, from);
            }
        }
        fn set<L: Lane, const N: usize>(lane: usize, to: &mut ModeSet<L, N>, from: &ModeSet<f64, N>) {
            // Modes that a lane has not are zero in it and stay so.
            to.used = to.used.max(from.used);
            row(lane, &mut to.w2, &from.w2);
            row(lane, &mut to.d, &from.d);
            row(lane, &mut to.h0, &from.h0);
            rows(lane, &mut to.rod, &from.rod);
            rows(lane, &mut to.weight, &from.weight);
            row(lane, &mut to.weight_axial, &from.weight_axial);
            rows(lane, &mut to.moment, &from.moment);
        }
        set(lane, &mut self.coupled, &from.coupled);
        set(lane, &mut self.plain, &from.plain);
        set(lane, &mut self.follower, &from.follower);
        self.hub_kg_m2.set(lane, from.hub_kg_m2);
        row(lane, &mut self.hub_change, &from.hub_change);
        rows(lane, &mut self.hub_curvature, &from.hub_curvature);
        row(lane, &mut self.c, &from.c);
        rows(lane, &mut self.b, &from.b);
        rows(lane, &mut self.cc, &from.cc);
        row(lane, &mut self.plain_c, &from.plain_c);
        rows(lane, &mut self.plain_cc, &from.plain_cc);
        row(lane, &mut self.follower_c, &from.follower_c);
        rows(lane, &mut self.follower_cc, &from.follower_cc);
        self.lag_per_s.set(lane, from.lag_per_s);
        row(lane, &mut self.moment_kg_m, &from.moment_kg_m);
        for (to, from) in self.sensors.iter_mut().zip(&from.sensors) {
            row(lane, &mut to.coupled, &from.coupled);
            row(lane, &mut to.plain, &from.plain);
            row(lane, &mut to.follower, &from.follower);
            row(lane, &mut to.lagging, &from.lagging);
        }
        self.scale.per_pa.set(lane, from.scale.per_pa);
        self.scale.per_m.set(lane, from.scale.per_m);
        self.scale.per_m_per_s.set(lane, from.scale.per_m_per_s);
        self.scale.per_j.set(lane, from.scale.per_j);
    }
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
    /// Speed over which friction turns over, m/s; 0 if that makes no difference.
    pub(super) reversal_m_per_s: f64,
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
            reversal_m_per_s: reversal_m_per_s(
                spec,
                piston * (spec.valve.supply_pressure_pa - spec.valve.tank_pressure_pa),
            ),
            stop: spec.end_stop,
            cutoff_m: spec.stroke_cutoff.map(|c| [c.min_length_m, c.max_length_m]),
            initial_pa: spec.initial_pressure_pa,
        }
    }
}

/// Speed over which friction turns over, m/s; 0 if its jump is below a thousandth of the largest
/// cylinder force. A straight transition of half-width v has the slope of Brown and McPhee's with 4 v.
fn reversal_m_per_s(spec: &CylinderSpec, force_n: f64) -> f64 {
    let (jump_n, width_m_per_s) = match spec.friction {
        FrictionSpec::None => (0.0, 0.0),
        FrictionSpec::BrownMcphee {
            static_n,
            transition_velocity_m_per_s,
            ..
        } => (2.0 * static_n, transition_velocity_m_per_s),
        FrictionSpec::Stribeck {
            dynamic_n,
            static_offset_n,
            regularisation_velocity_m_per_s,
            ..
        } => (
            2.0 * (dynamic_n + static_offset_n),
            4.0 * regularisation_velocity_m_per_s,
        ),
    };
    if jump_n > 1e-3 * force_n {
        width_m_per_s
    } else {
        0.0
    }
}
