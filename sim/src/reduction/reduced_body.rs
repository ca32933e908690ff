//! The reduced flexible body: everything the dynamics needs, nothing of the mesh.
//!
//! All constants of the nodal floating frame of reference formulation (theory note §3.1), in the
//! mode basis as it stands (not orthogonalised). `n` is the number of modes. Body frame, SI.

use nalgebra::{DMatrix, Matrix3, Matrix3xX, Vector3};

/// Constants of one flexible body in one mode basis.
#[derive(Debug, Clone, PartialEq)]
pub struct ReducedBody {
    /// Body name.
    pub name: String,
    /// Mass, kg.
    pub mass_kg: f64,
    /// Undeformed centre of mass χ, m.
    pub centre_of_mass_m: Vector3<f64>,
    /// Inertia about the frame origin Θ₀, kg m².
    pub inertia_origin_kg_m2: Matrix3<f64>,
    /// Ψᵀ M Ψ, n × n.
    pub mass_modal: DMatrix<f64>,
    /// Ψᵀ K Ψ, n × n.
    pub stiffness_modal: DMatrix<f64>,
    /// Damping matrix of the modal coordinates, n × n.
    pub damping_modal: DMatrix<f64>,
    /// C_pt = Φᵀ M Ψ, 3 × n.
    pub c_pt: Matrix3xX<f64>,
    /// C_xp = til(x)ᵀ M Ψ, 3 × n.
    pub c_xp: Matrix3xX<f64>,
    /// N_m = til(x)ᵀ M til(ψ_m), n blocks.
    pub n_blocks: Vec<Matrix3<f64>>,
    /// B_mk = til(ψ_m)ᵀ M til(ψ_k), row-major in (m, k), n² blocks.
    pub b_blocks: Vec<Matrix3<f64>>,
    /// c_mk = til(ψ_m)ᵀ M ψ_k, row-major in (m, k), n² vectors.
    pub c_vectors: Vec<Vector3<f64>>,
    /// Markers: one per interface of the machine file, in its order.
    pub interfaces: Vec<ReducedInterface>,
    /// Sensor nodes, in the order of the machine's sensors on this body.
    pub sensor_nodes: Vec<ReducedNode>,
    /// What the reduction found out about itself.
    pub report: ReductionReport,
}

impl ReducedBody {
    /// Number of modes n.
    #[must_use]
    pub fn mode_count(&self) -> usize {
        self.mass_modal.nrows()
    }
}

/// An interface as marker: weighted mean of its nodes, and its small rotation.
#[derive(Debug, Clone, PartialEq)]
pub struct ReducedInterface {
    /// Interface name.
    pub name: String,
    /// Σ w x, m.
    pub position_m: Vector3<f64>,
    /// Ψ_P = Σ w Ψ, 3 × n.
    pub translation: Matrix3xX<f64>,
    /// Ψ_R, 3 × n (theory note §5).
    pub rotation: Matrix3xX<f64>,
    /// Number of nodes.
    pub node_count: usize,
}

/// A sensor node.
#[derive(Debug, Clone, PartialEq)]
pub struct ReducedNode {
    /// Zero-based node number in the mesh.
    pub node: usize,
    /// Reference position, m.
    pub position_m: Vector3<f64>,
    /// Ψ rows, 3 × n.
    pub translation: Matrix3xX<f64>,
    /// Engineering strain (xx, yy, zz, yz, xz, xy) per modal coordinate, 6 × n.
    pub strain: DMatrix<f64>,
    /// Stress (xx, yy, zz, yz, xz, xy) per modal coordinate, Pa, 6 × n.
    pub stress_pa: DMatrix<f64>,
}

/// Facts about a reduction, for people. Seconds are absent on purpose: the report is a function of
/// the input alone.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ReductionReport {
    /// Mesh nodes.
    pub node_count: usize,
    /// Mesh elements.
    pub element_count: usize,
    /// Clamped-interface frequencies of the normal modes, Hz.
    pub fixed_interface_hz: Vec<f64>,
    /// Boundary interfaces of the basis; the first carries the frame.
    pub boundary_names: Vec<String>,
}
