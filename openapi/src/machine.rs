//! The machine description as a person writes it: TOML, versioned, units in the names.
//!
//! Data flow: `MachineFile` (this module, any text that parses) → `hydroflex_sim::machine::Machine`
//! (checked whole against meshes and physics).

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Version of the machine file format this build reads.
pub const MACHINE_FORMAT: u32 = 1;

/// A machine: bodies, joints, hydraulic cylinders, payload, sensors and ranges of configurations.
///
/// The global frame has X forward, Y up, Z out of the plane of the boom. Lengths in metres.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MachineFile {
    /// Version of this format, [`MACHINE_FORMAT`].
    pub format: u32,
    /// Short name, lower case with hyphens.
    pub name: String,
    /// One or more sentences for people; sources belong here.
    #[serde(default)]
    pub description: String,
    /// Gravity in the global frame.
    pub gravity_m_per_s2: [f64; 3],
    /// Conventions of the mechanics; the better physics is the default.
    #[serde(default)]
    pub conventions: Conventions,
    /// Bodies; `ground` exists by itself.
    #[serde(rename = "body")]
    pub bodies: Vec<BodySpec>,
    /// Joints between two attachments.
    #[serde(rename = "joint", default)]
    pub joints: Vec<JointSpec>,
    /// Hydraulic cylinders, each with its valve.
    #[serde(rename = "cylinder", default)]
    pub cylinders: Vec<CylinderSpec>,
    /// Angles that describe a configuration, in the order in which run tables name them.
    #[serde(rename = "angle", default)]
    pub angles: Vec<AngleSpec>,
    /// Where a payload hangs; absent if the machine carries none.
    #[serde(default)]
    pub payload: Option<PayloadSpec>,
    /// What is measured on the bodies, beside what every cylinder and angle reports.
    #[serde(rename = "sensor", default)]
    pub sensors: Vec<SensorSpec>,
}

/// Switches between the better physics (default) and conventions of published models.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Conventions {
    /// Which centre of mass enters the gravity moment of a flexible body.
    pub gravity_moment: GravityMoment,
    /// How a marker's angular velocity combines rigid and modal rotation.
    pub marker_rotation: MarkerRotation,
    /// Where the static start of runs in redundant coordinates ends (the fixed-step schemes, and `accurate` where it has no
    /// minimal coordinates). Absent, and in runs whose valves stay shut: at rest to rounding.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub statics: Option<LooseStatics>,
}

/// A static start that ends where Exudyn's static solver ends with the same settings: loads grow in equal steps,
/// each ends when the norm of the residual falls below a part of what it was at the step's beginning.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LooseStatics {
    /// Steps in which gravity grows to its whole, at least 1.
    pub load_steps: u32,
    /// Residual at which a step ends, relative to the residual at its beginning.
    pub relative_tolerance: f64,
    /// A body welded to the ground that carries everything the machine file attaches to `ground`. It never moves, but
    /// its weight and the forces on it count in the norm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ground_body: Option<GroundBody>,
}

/// The body behind `ground` in a published model, welded at the global origin.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GroundBody {
    /// Mass.
    pub mass_kg: f64,
    /// Centre of mass, global.
    pub centre_of_mass_m: [f64; 3],
}

/// Gravity moment of a flexible body (theory note §3.5).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GravityMoment {
    /// With the modal shift of the centre of mass: the consistent expression.
    #[default]
    Deformed,
    /// Without it, as Exudyn's reduced-order body does.
    Undeformed,
}

/// Angular velocity of a marker on a deformed interface (theory note §5).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MarkerRotation {
    /// `A (ω + exp(θ~) T(θ) θ̇)`.
    #[default]
    Exact,
    /// `A (ω + T(θ) θ̇)`, as Exudyn does.
    Additive,
}

/// One body.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum BodySpec {
    /// A finite-element body, reduced by Hurty/Craig-Bampton.
    Flexible(FlexibleBodySpec),
    /// A rigid body with given inertia.
    Rigid(RigidBodySpec),
}

impl BodySpec {
    /// The body's name.
    #[must_use]
    pub fn name(&self) -> &str {
        match self {
            Self::Flexible(body) => &body.name,
            Self::Rigid(body) => &body.name,
        }
    }
}

/// A flexible body.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlexibleBodySpec {
    /// Name, unique among bodies.
    pub name: String,
    /// Where the mesh comes from.
    pub mesh: MeshSource,
    /// Mass and stiffness that Abaqus assembled for this mesh, in place of our own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub matrices: Option<MatricesSpec>,
    /// Linear elastic isotropic material. Of a body with `matrices` it makes stress out of strain, and nothing else.
    pub material: MaterialSpec,
    /// Lumped or consistent mass matrix, where we assemble it.
    #[serde(default)]
    pub mass_matrix: MassMatrixKind,
    /// Fixed-interface normal modes kept beside the static ones.
    pub normal_modes: usize,
    /// Structural damping, acting on the modal coordinates.
    pub damping: DampingSpec,
    /// Interfaces; the first boundary interface carries the floating frame.
    #[serde(rename = "interface")]
    pub interfaces: Vec<InterfaceSpec>,
}

/// Source of a mesh.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MeshSource {
    /// A mesh that the binary carries, by name.
    BuiltIn(String),
    /// An Abaqus `.inp` file, relative to the machine file.
    File(String),
    /// Given on the command line: `--mesh FILE` or `--mesh BODY=FILE`. The text says which mesh is
    /// meant and where it comes from, for the error when none is given.
    Given(String),
}

/// Text files of Abaqus's `*MATRIX OUTPUT, STIFFNESS, MASS` in the format `MATRIX INPUT` or `COORDINATE`, relative to the machine
/// file, in N/m and kg.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MatricesSpec {
    /// Stiffness of the free body, such as `boom_STIF1.mtx`.
    pub stiffness: String,
    /// Mass, such as `boom_MASS1.mtx`.
    pub mass: String,
}

/// Isotropic material.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct MaterialSpec {
    /// Name for reports.
    pub name: String,
    /// Young's modulus.
    pub youngs_modulus_pa: f64,
    /// Poisson's ratio, in (-1, 0.5).
    pub poisson_ratio: f64,
    /// Density.
    pub density_kg_per_m3: f64,
}

impl MaterialSpec {
    /// Names of the materials that [`MaterialSpec::named`] knows.
    pub const NAMES: [&'static str; 3] = ["steel", "aluminium", "titanium"];

    /// A material by name: structural steel (EN 1993-1-1, 3.2.6; density EN 1991-1-1, table A.4), wrought aluminium alloys
    /// (EN 1999-1-1, 3.2.5), titanium Ti-6Al-4V, annealed (ASM Aerospace Specification Metals, MTP641).
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        let (youngs_modulus_pa, poisson_ratio, density_kg_per_m3) = match name {
            "steel" => (2.1e11, 0.3, 7850.0),
            "aluminium" => (7.0e10, 0.3, 2700.0),
            "titanium" => (1.138e11, 0.342, 4430.0),
            _ => return None,
        };
        Some(Self {
            name: name.to_owned(),
            youngs_modulus_pa,
            poisson_ratio,
            density_kg_per_m3,
        })
    }
}

/// Kind of mass matrix.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MassMatrixKind {
    /// From the shape functions.
    #[default]
    Consistent,
    /// Diagonal: for tetrahedra with 4 nodes a quarter of the element mass on each node; for 10
    /// nodes HRZ lumping (diagonal of the consistent matrix scaled to the element mass).
    Lumped,
}

/// Damping of a flexible body.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum DampingSpec {
    /// `D = a M + b K` of the reduced matrices.
    Rayleigh {
        /// Factor `a` of the mass matrix.
        mass_factor_per_s: f64,
        /// Factor `b` of the stiffness matrix.
        stiffness_factor_s: f64,
    },
    /// The same damping ratio in every generalised mode of the reduced body.
    Modal {
        /// Damping ratio ξ.
        damping_ratio: f64,
    },
}

/// A set of mesh nodes that acts as one point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InterfaceSpec {
    /// Name, unique in the body.
    pub name: String,
    /// Which nodes.
    pub select: Selection,
    /// Node weights of the marker.
    #[serde(default)]
    pub weights: WeightKind,
    /// When the interface is a boundary of the Craig-Bampton basis.
    #[serde(default)]
    pub boundary: Boundary,
}

/// Selection of nodes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Selection {
    /// Nodes on the mantle of a cylinder: axial position within the segment ± tolerance and
    /// distance to the axis within radius ± tolerance.
    Cylinder {
        /// One end of the axis, body frame.
        axis_start_m: [f64; 3],
        /// Other end of the axis, body frame.
        axis_end_m: [f64; 3],
        /// Radius.
        radius_m: f64,
        /// Tolerance, axially and radially.
        tolerance_m: f64,
    },
    /// A node set of the mesh file.
    NodeSet(String),
}

/// Marker weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WeightKind {
    /// All nodes alike.
    #[default]
    Uniform,
    /// By the area of the surface triangles whose three nodes belong to the set.
    Area,
}

/// When an interface belongs to the basis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Boundary {
    /// In every run.
    #[default]
    Always,
    /// In runs with payload only.
    WithPayload,
    /// Never: the interface is a marker only.
    Never,
}

/// A rigid body.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RigidBodySpec {
    /// Name, unique among bodies.
    pub name: String,
    /// Mass.
    pub mass_kg: f64,
    /// Centre of mass, body frame.
    pub centre_of_mass_m: [f64; 3],
    /// Inertia about the centre of mass, body frame: xx, yy, zz, xy, xz, yz.
    pub inertia_kg_m2: [f64; 6],
    /// Rough angle about global Z at which the assembly starts, absolute.
    #[serde(default)]
    pub start_angle_deg: f64,
}

/// A point of a body, or of the ground.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Attachment {
    /// Body name, or `ground`.
    pub body: String,
    /// Interface of a flexible body.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interface: Option<String>,
    /// Point in the frame of a rigid body or of the ground.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub point_m: Option<[f64; 3]>,
}

/// A joint between two attachments.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointSpec {
    /// Name, unique among joints.
    pub name: String,
    /// What it leaves free.
    pub kind: JointKind,
    /// First attachment; the joint frame is fixed here.
    pub from: Attachment,
    /// Second attachment.
    pub to: Attachment,
}

/// Kind of joint; every free axis is the global Z of the reference pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JointKind {
    /// Rotation about Z free.
    Revolute,
    /// All rotations free.
    Spherical,
    /// Nothing free.
    Fixed,
    /// X and Y of the first frame locked, the rest free: closes a planar loop without redundancy.
    PlanarPin,
}

/// A double-acting cylinder with a 4/3 valve (theory note §7).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CylinderSpec {
    /// Name, part of the channel names.
    pub name: String,
    /// Barrel eye.
    pub base: Attachment,
    /// Rod eye.
    pub rod: Attachment,
    /// Eye-to-eye length with the rod fully in.
    pub closed_length_m: f64,
    /// Stroke.
    pub stroke_m: f64,
    /// Piston diameter.
    pub piston_diameter_m: f64,
    /// Rod diameter.
    pub rod_diameter_m: f64,
    /// Viscous damping inside the cylinder.
    pub damping_n_s_per_m: f64,
    /// Hoses, one per chamber.
    pub hose: HoseSpec,
    /// Oil and walls.
    pub fluid: FluidSpec,
    /// Valve and supply.
    pub valve: ValveSpec,
    /// Friction between piston and barrel.
    pub friction: FrictionSpec,
    /// Spring-damper parallel to the cylinder, as published scripts have it.
    #[serde(default)]
    pub parallel_spring: Option<ParallelSpringSpec>,
    /// End stops at the stroke's limits; absent: the piston may leave the barrel, as published.
    #[serde(default)]
    pub end_stop: Option<EndStopSpec>,
    /// Eye-to-eye lengths at which a random configuration may start; absent: anywhere within the stroke.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start_length_m: Option<[f64; 2]>,
    /// Lengths beyond which the valve is shut before a step, as published scripts do.
    #[serde(default)]
    pub stroke_cutoff: Option<StrokeCutoffSpec>,
    /// Pressures with which the equilibrium search starts; the rod side keeps it.
    pub initial_pressure_pa: f64,
}

/// Hose of a chamber.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HoseSpec {
    /// Inner diameter.
    pub diameter_m: f64,
    /// Length.
    pub length_m: f64,
}

/// Bulk moduli.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FluidSpec {
    /// Oil.
    pub bulk_modulus_oil_pa: f64,
    /// Barrel wall.
    pub bulk_modulus_cylinder_pa: f64,
    /// Hose wall.
    pub bulk_modulus_hose_pa: f64,
    /// Vapour pressure: a chamber never goes below it. Absent: no floor, pressures may become
    /// negative, as published.
    #[serde(default)]
    pub vapour_pressure_pa: Option<f64>,
}

/// Valve and supply.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValveSpec {
    /// Flow over square root of pressure drop at full opening.
    pub flow_coefficient_m3_per_s_per_sqrt_pa: f64,
    /// Pump pressure, absolute.
    pub supply_pressure_pa: f64,
    /// Tank pressure, absolute.
    pub tank_pressure_pa: f64,
}

/// Friction of a cylinder (theory note §8).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum FrictionSpec {
    /// None.
    None,
    /// Brown and McPhee (2016), continuous in velocity.
    BrownMcphee {
        /// Coulomb friction.
        coulomb_n: f64,
        /// Static friction.
        static_n: f64,
        /// Viscous friction.
        viscous_n_s_per_m: f64,
        /// Transition velocity.
        transition_velocity_m_per_s: f64,
    },
    /// Stribeck with a linear part around zero, as the published scripts have it.
    Stribeck {
        /// Dynamic friction.
        dynamic_n: f64,
        /// Static friction above the dynamic one.
        static_offset_n: f64,
        /// Velocity of the exponential decay.
        decay_velocity_m_per_s: f64,
        /// Width of the linear part.
        regularisation_velocity_m_per_s: f64,
    },
}

/// `F = k u + d v + c u³`, `u = length − free length`, tension positive.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ParallelSpringSpec {
    /// k.
    pub stiffness_n_per_m: f64,
    /// c.
    pub cubic_stiffness_n_per_m3: f64,
    /// d.
    pub damping_n_s_per_m: f64,
    /// Free length.
    pub free_length_m: f64,
}

/// One-sided spring-damper at both ends of the stroke.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EndStopSpec {
    /// Stiffness.
    pub stiffness_n_per_m: f64,
    /// Damping, in contact and never pulling.
    pub damping_n_s_per_m: f64,
}

/// Length window outside which the valve is held shut.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StrokeCutoffSpec {
    /// Shortest length with a live valve.
    pub min_length_m: f64,
    /// Longest length with a live valve.
    pub max_length_m: f64,
}

/// An angle of a configuration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AngleSpec {
    /// Name, part of the channel names.
    pub name: String,
    /// Body whose frame angle about global Z it is, absolute.
    pub body: String,
    /// Angle subtracted from the run table's value to place the body, by name: the published
    /// crane places its tilt boom at `tilt − lift`.
    #[serde(default)]
    pub minus: Option<String>,
    /// Range of random configurations.
    pub range_deg: [f64; 2],
    /// Other ranges, where another angle says so; the first that fits counts.
    #[serde(default, rename = "instead", skip_serializing_if = "Vec::is_empty")]
    pub instead: Vec<InsteadSpec>,
}

/// A range that takes the place of an angle's own while another angle lies within limits.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InsteadSpec {
    /// The other angle, by name; an earlier one.
    pub angle: String,
    /// It lies above the first of these and not above the second.
    pub between_deg: [f64; 2],
    /// The range then.
    pub range_deg: [f64; 2],
}

/// A point mass on a spherical joint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PayloadSpec {
    /// Where it hangs.
    pub at: Attachment,
    /// Allowed masses.
    pub range_kg: [f64; 2],
}

/// A sensor on a flexible body. Channel names: `{quantity}_{name}_{component}[_{unit}]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorSpec {
    /// Name, part of the channel names; two quantities may share one.
    pub name: String,
    /// What is measured.
    pub quantity: SensorQuantity,
    /// Flexible body.
    pub body: String,
    /// Surface node nearest to this point of the body frame is used.
    pub near_m: [f64; 3],
    /// Largest allowed distance between that point and the node.
    pub within_m: f64,
    /// Components: `x, y, z` for deflection; `xx, yy, zz, yz, xz, xy` for strain and stress, and
    /// `von_mises` for stress.
    pub components: Vec<String>,
}

/// Quantity of a sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SensorQuantity {
    /// Displacement of the node in the body frame.
    Deflection,
    /// Engineering strain, body frame.
    Strain,
    /// Stress, body frame.
    Stress,
}
