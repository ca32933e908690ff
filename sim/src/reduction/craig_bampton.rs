//! Hurty/Craig-Bampton reduction with rigid interfaces (theory note §4.1).

use super::eigen::lowest_modes;
use super::factor::StiffnessFactor;
use super::inertia_integrals::integrate;
use super::{Damping, ReducedBody, ReducedInterface, ReducedNode, ReductionError, ReductionReport};
use crate::fe::{
    BlockMatrix, GivenMatrices, InterfaceNodes, MassKind, Material, Mesh, NodalMass, assemble_mass,
    assemble_stiffness, nodal_strain_map, stress_from_strain,
};
use nalgebra::{DMatrix, Matrix3, Matrix3xX, Vector3};
use std::borrow::Cow;

/// A finite-element body and what is to be kept of it.
#[derive(Debug, Clone)]
pub struct FlexibleModel<'a> {
    /// Body name.
    pub name: &'a str,
    /// Checked mesh.
    pub mesh: &'a Mesh,
    /// Mass and stiffness that came with the mesh; absent where we assemble them.
    pub matrices: Option<&'a GivenMatrices>,
    /// Material.
    pub material: Material,
    /// Kind of mass matrix.
    pub mass_kind: MassKind,
    /// Number of fixed-interface normal modes.
    pub normal_modes: usize,
    /// Structural damping.
    pub damping: Damping,
    /// All interfaces, as markers.
    pub interfaces: &'a [InterfaceNodes],
    /// Positions in `interfaces` of the boundary interfaces; the first carries the floating frame.
    pub boundary: Vec<usize>,
    /// Nodes of sensors.
    pub sensor_nodes: &'a [u32],
}

/// Full mode basis Ψ, 3·nodes × n: static modes of the boundary interfaces after the first, six
/// each (tx, ty, tz, rx, ry, rz; rotation modes `u = p × e`, i.e. minus the usual `e × p`), then
/// mass-normalised normal modes with all boundary interfaces fixed.
#[derive(Debug, Clone, PartialEq)]
pub struct ModeBasis {
    /// Ψ.
    pub modes: DMatrix<f64>,
    /// Frequencies of the normal modes, Hz.
    pub fixed_interface_hz: Vec<f64>,
}

/// Reduces a body.
///
/// # Errors
/// [`ReductionError`] when the structure is not held by its interfaces, or modes cannot be found.
pub fn reduce(model: &FlexibleModel<'_>) -> Result<ReducedBody, ReductionError> {
    let (stiffness, mass) = (model.stiffness(), model.mass());
    let basis = mode_basis(model, &stiffness, &mass)?;
    Ok(project(model, &stiffness, &mass, basis))
}

/// Computes the mode basis.
///
/// # Errors
/// As [`reduce`].
pub fn mode_basis(
    model: &FlexibleModel<'_>,
    stiffness: &BlockMatrix,
    mass: &NodalMass,
) -> Result<ModeBasis, ReductionError> {
    let mut is_fixed = vec![false; model.mesh.node_count()];
    for interface in model.boundary_interfaces()? {
        for &node in &interface.nodes {
            if std::mem::replace(&mut is_fixed[node as usize], true) {
                return Err(ReductionError::OverlappingBoundaries {
                    interface: interface.name.clone(),
                    node,
                });
            }
        }
    }
    let factor = StiffnessFactor::new(stiffness, mass, 0.0, &is_fixed)?;

    let mut modes = rigid_interface_motions(model)?;
    let static_count = modes.ncols();
    relax_interior(&factor, stiffness, &mut modes);

    let normal = lowest_modes(&factor, mass, 0.0, model.normal_modes)?;
    modes = modes.resize_horizontally(static_count + model.normal_modes, 0.0);
    let mut shapes = DMatrix::zeros(modes.nrows(), model.normal_modes);
    factor.scatter(&normal.shapes, &mut shapes);
    for mut shape in shapes.column_iter_mut() {
        make_largest_entry_positive(shape.as_mut_slice());
    }
    modes
        .columns_mut(static_count, model.normal_modes)
        .copy_from(&shapes);
    Ok(ModeBasis {
        modes,
        fixed_interface_hz: normal.omega_squared.iter().copied().map(hertz).collect(),
    })
}

/// First elastic frequencies of the free body, Hz, at most `count`: motions without strain are left
/// out, six of a body in one piece. `scale_hz` is about where the first one is expected.
///
/// # Errors
/// As [`reduce`].
pub fn free_free_hz(
    stiffness: &BlockMatrix,
    mass: &NodalMass,
    scale_hz: f64,
    count: usize,
) -> Result<Vec<f64>, ReductionError> {
    // a shift near the square of the wanted frequencies makes K + s M definite and well scaled
    let shift_per_s2 = (2.0 * std::f64::consts::PI * scale_hz).powi(2);
    let factor = StiffnessFactor::new(stiffness, mass, shift_per_s2, &vec![false; mass.node_count()])?;
    let modes = lowest_modes(&factor, mass, shift_per_s2, count + 6)?;
    // rounding leaves rigid motions at about 1e-6 of the scale
    let elastic = modes.omega_squared.iter().copied().map(hertz);
    Ok(elastic.filter(|hz| *hz > 1e-3 * scale_hz).collect())
}

/// The full model with some nodes held, factored once: what a reduction is measured against.
pub struct ClampedModel<'a> {
    stiffness: &'a BlockMatrix,
    mass: &'a NodalMass,
    factor: StiffnessFactor,
}

impl<'a> ClampedModel<'a> {
    /// Factors the stiffness over the nodes that are not held.
    ///
    /// # Errors
    /// As [`reduce`], where the held nodes do not hold the body.
    pub fn new(
        stiffness: &'a BlockMatrix,
        mass: &'a NodalMass,
        is_fixed: &[bool],
    ) -> Result<Self, ReductionError> {
        Ok(Self {
            stiffness,
            mass,
            factor: StiffnessFactor::new(stiffness, mass, 0.0, is_fixed)?,
        })
    }

    /// Number of nodes, held ones counted.
    #[must_use]
    pub fn node_count(&self) -> usize {
        self.mass.node_count()
    }

    /// Lowest frequencies, Hz.
    ///
    /// # Errors
    /// If the search for them does not settle.
    pub fn lowest_hz(&self, count: usize) -> Result<Vec<f64>, ReductionError> {
        let modes = lowest_modes(&self.factor, self.mass, 0.0, count)?;
        Ok(modes.omega_squared.iter().copied().map(hertz).collect())
    }

    /// Static displacements under nodal loads: 3·nodes × k, m for N; zero at the held nodes.
    #[must_use]
    pub fn deflections_m(&self, loads_n: &DMatrix<f64>) -> DMatrix<f64> {
        let mut nodal = DMatrix::zeros(loads_n.nrows(), loads_n.ncols());
        let mut free = DMatrix::zeros(self.factor.size(), loads_n.ncols());
        // The second pass takes the rounding of the factor away.
        for _ in 0..2 {
            let mut correction = self.factor.gather(&(loads_n - self.stiffness.multiply(&nodal)));
            self.factor.solve_in_place(&mut correction);
            free += correction;
            self.factor.scatter(&free, &mut nodal);
        }
        nodal
    }
}

/// Lowest frequencies with the given nodes held, Hz.
///
/// # Errors
/// As [`reduce`].
pub fn clamped_hz(
    stiffness: &BlockMatrix,
    mass: &NodalMass,
    is_fixed: &[bool],
    count: usize,
) -> Result<Vec<f64>, ReductionError> {
    ClampedModel::new(stiffness, mass, is_fixed)?.lowest_hz(count)
}

fn hertz(omega_squared: f64) -> f64 {
    omega_squared.max(0.0).sqrt() / (2.0 * std::f64::consts::PI)
}

impl<'a> FlexibleModel<'a> {
    /// Stiffness of the free body, N/m.
    #[must_use]
    pub fn stiffness(&self) -> Cow<'a, BlockMatrix> {
        match self.matrices {
            Some(given) => Cow::Borrowed(&given.stiffness),
            None => Cow::Owned(assemble_stiffness(self.mesh, &self.material)),
        }
    }

    /// Its mass, kg.
    #[must_use]
    pub fn mass(&self) -> Cow<'a, NodalMass> {
        match self.matrices {
            Some(given) => Cow::Borrowed(&given.mass),
            None => Cow::Owned(assemble_mass(self.mesh, &self.material, self.mass_kind)),
        }
    }

    fn boundary_interfaces(&self) -> Result<Vec<&InterfaceNodes>, ReductionError> {
        if self.boundary.is_empty() {
            return Err(ReductionError::NoBoundary);
        }
        Ok(self.boundary.iter().map(|i| &self.interfaces[*i]).collect())
    }
}

/// Rigid motions T of the boundary interfaces after the first, zero elsewhere: per node
/// `[I, skew(x − P)]` with P the unweighted mean of the interface's nodes.
fn rigid_interface_motions(model: &FlexibleModel<'_>) -> Result<DMatrix<f64>, ReductionError> {
    let boundary = model.boundary_interfaces()?;
    let mut modes = DMatrix::zeros(3 * model.mesh.node_count(), 6 * (boundary.len() - 1));
    for (k, interface) in boundary[1..].iter().enumerate() {
        let centre = interface.mean_m(model.mesh);
        for &node in &interface.nodes {
            let p = model.mesh.nodes_m()[node as usize] - centre;
            let row = 3 * node as usize;
            modes
                .fixed_view_mut::<3, 3>(row, 6 * k)
                .copy_from(&Matrix3::identity());
            modes
                .fixed_view_mut::<3, 3>(row, 6 * k + 3)
                .copy_from(&p.cross_matrix());
        }
    }
    Ok(modes)
}

/// Static equilibrium of the interior: `Ψ_i ← Ψ_i − K_ii⁻¹ (K Ψ)_i`, twice. The second pass is one
/// step of iterative refinement and takes the rounding of the factor away.
fn relax_interior(factor: &StiffnessFactor, stiffness: &BlockMatrix, modes: &mut DMatrix<f64>) {
    let mut interior = DMatrix::zeros(factor.size(), modes.ncols());
    for _ in 0..2 {
        let mut correction = factor.gather(&stiffness.multiply(modes));
        factor.solve_in_place(&mut correction);
        interior -= correction;
        factor.scatter(&interior, modes);
    }
}

fn make_largest_entry_positive(shape: &mut [f64]) {
    let largest = shape
        .iter()
        .copied()
        .fold(0.0_f64, |a, b| if b.abs() > a.abs() { b } else { a });
    if largest < 0.0 {
        for x in shape {
            *x = -*x;
        }
    }
}

fn project(
    model: &FlexibleModel<'_>,
    stiffness: &BlockMatrix,
    mass: &NodalMass,
    basis: ModeBasis,
) -> ReducedBody {
    let modes = &basis.modes;
    let integrals = integrate(model.mesh, mass, modes);
    let mut mass_modal = integrals.mass_modal;
    let k = modes.transpose() * stiffness.multiply(modes);
    let mut stiffness_modal = (&k + k.transpose()) * 0.5;
    clear_rounding(&mut mass_modal);
    clear_rounding(&mut stiffness_modal);
    let damping_modal = model.damping.matrix(&mass_modal, &stiffness_modal);
    ReducedBody {
        name: model.name.to_owned(),
        mass_kg: integrals.mass_kg,
        centre_of_mass_m: integrals.centre_of_mass_m,
        inertia_origin_kg_m2: integrals.inertia_origin_kg_m2,
        mass_modal,
        stiffness_modal,
        damping_modal,
        c_pt: integrals.c_pt,
        c_xp: integrals.c_xp,
        n_blocks: integrals.n_blocks,
        b_blocks: integrals.b_blocks,
        c_vectors: integrals.c_vectors,
        interfaces: model
            .interfaces
            .iter()
            .map(|interface| marker(model.mesh, interface, modes))
            .collect(),
        sensor_nodes: model
            .sensor_nodes
            .iter()
            .map(|node| sensor_node(model, *node, modes))
            .collect(),
        report: ReductionReport {
            node_count: model.mesh.node_count(),
            element_count: model.mesh.elements().len(),
            fixed_interface_hz: basis.fixed_interface_hz,
            boundary_names: model
                .boundary
                .iter()
                .map(|i| model.interfaces[*i].name.clone())
                .collect(),
        },
    }
}

/// Sets entries below 1e-13 of the largest to zero, as the reference does: the blocks between
/// static and normal modes vanish by construction.
fn clear_rounding(matrix: &mut DMatrix<f64>) {
    let limit = 1e-13 * matrix.amax();
    matrix.iter_mut().for_each(|x| {
        if x.abs() < limit {
            *x = 0.0;
        }
    });
}

/// Ψ rows of a node, 3 × n.
fn node_rows(modes: &DMatrix<f64>, node: u32) -> Matrix3xX<f64> {
    Matrix3xX::from_fn(modes.ncols(), |r, c| modes[(3 * node as usize + r, c)])
}

/// Ψ_P = Σ w Ψ and Ψ_R = W⁻¹ Σ w skew(p) Ψ (theory note §5).
fn marker(mesh: &Mesh, interface: &InterfaceNodes, modes: &DMatrix<f64>) -> ReducedInterface {
    let position_m = interface.weighted_mean_m(mesh);
    let n = modes.ncols();
    let (mut translation, mut turning) = (Matrix3xX::zeros(n), Matrix3xX::zeros(n));
    for (&node, &weight) in interface.nodes.iter().zip(&interface.weights) {
        let rows = node_rows(modes, node);
        let p: Vector3<f64> = mesh.nodes_m()[node as usize] - position_m;
        turning += p.cross_matrix() * weight * &rows;
        translation += rows * weight;
    }
    // collinear nodes are refused when the machine is checked
    let inverse = interface
        .second_moment_m2(mesh)
        .try_inverse()
        .unwrap_or_else(Matrix3::zeros);
    ReducedInterface {
        name: interface.name.clone(),
        position_m,
        translation,
        rotation: inverse * turning,
        node_count: interface.nodes.len(),
    }
}

fn sensor_node(model: &FlexibleModel<'_>, node: u32, modes: &DMatrix<f64>) -> ReducedNode {
    let strain = nodal_strain_map(model.mesh, node, modes);
    ReducedNode {
        node: node as usize,
        position_m: model.mesh.nodes_m()[node as usize],
        translation: node_rows(modes, node),
        stress_pa: stress_from_strain(&model.material, &strain),
        strain,
    }
}
