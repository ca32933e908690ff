//! Sparse mass and stiffness of a mesh.
//!
//! Unknowns belong to nodes, so matrices are stored by node: the stiffness as 3 × 3 blocks, the
//! mass as one number per pair of nodes (`M_ij = m_ij I`, which the nodal floating frame needs).

use super::element::{Tet4, Tet10, Tetrahedron};
use super::material::Material;
use super::mesh::{Elements, Mesh};
use nalgebra::{DMatrix, Matrix3, Vector3};

/// Kind of mass matrix.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MassKind {
    /// From the shape functions.
    Consistent,
    /// Diagonal.
    Lumped,
}

/// Which pairs of nodes share an element: rows with ascending columns, diagonal included.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct NodePattern {
    pub(crate) row_start: Vec<usize>,
    pub(crate) columns: Vec<u32>,
}

impl NodePattern {
    pub(super) fn of(mesh: &Mesh) -> Self {
        let (offsets, attached) = mesh.attached_elements();
        let mut row_start = Vec::with_capacity(mesh.node_count() + 1);
        row_start.push(0);
        let mut columns = Vec::new();
        let mut row = Vec::new();
        for node in 0..mesh.node_count() {
            row.clear();
            for &e in &attached[offsets[node] as usize..offsets[node + 1] as usize] {
                row.extend_from_slice(mesh.elements().nodes(e as usize));
            }
            row.sort_unstable();
            row.dedup();
            columns.extend_from_slice(&row);
            row_start.push(columns.len());
        }
        Self { row_start, columns }
    }

    /// The same with these pairs, too.
    pub(super) fn with(&self, pairs: impl Iterator<Item = (u32, u32)>) -> Self {
        let nodes = self.row_start.len() - 1;
        let own = (0_u32..)
            .zip(self.row_start.windows(2))
            .flat_map(|(row, ends)| self.columns[ends[0]..ends[1]].iter().map(move |c| (row, *c)));
        let mut all: Vec<(u32, u32)> = own.chain(pairs).collect();
        all.sort_unstable();
        all.dedup();
        let mut row_start = vec![0; nodes + 1];
        for (row, _) in &all {
            row_start[*row as usize + 1] += 1;
        }
        for row in 0..nodes {
            row_start[row + 1] += row_start[row];
        }
        Self {
            row_start,
            columns: all.into_iter().map(|(_, column)| column).collect(),
        }
    }

    pub(super) fn position(&self, row: u32, column: u32) -> usize {
        let start = self.row_start[row as usize];
        let columns = &self.columns[start..self.row_start[row as usize + 1]];
        start
            + columns
                .binary_search(&column)
                .unwrap_or_else(|_| unreachable!("the pattern holds every pair of an element"))
    }

    pub(crate) fn row(&self, row: usize) -> std::ops::Range<usize> {
        self.row_start[row]..self.row_start[row + 1]
    }
}

/// A symmetric matrix of 3 × 3 blocks, both triangles stored. N/m for a stiffness.
#[derive(Debug, Clone, PartialEq)]
pub struct BlockMatrix {
    pub(crate) pattern: NodePattern,
    pub(crate) blocks: Vec<Matrix3<f64>>,
}

impl BlockMatrix {
    /// Number of nodes.
    #[must_use]
    pub fn node_count(&self) -> usize {
        self.pattern.row_start.len() - 1
    }

    /// `K x` for nodal columns (3·nodes × k, order x0, y0, z0, x1, …).
    #[must_use]
    pub fn multiply(&self, x: &DMatrix<f64>) -> DMatrix<f64> {
        let mut y = DMatrix::zeros(x.nrows(), x.ncols());
        for column in 0..x.ncols() {
            for node in 0..self.node_count() {
                let mut sum = Vector3::zeros();
                for i in self.pattern.row(node) {
                    let j = 3 * self.pattern.columns[i] as usize;
                    sum += self.blocks[i] * x.fixed_view::<3, 1>(j, column);
                }
                y.fixed_view_mut::<3, 1>(3 * node, column).copy_from(&sum);
            }
        }
        y
    }

    /// Sum of the diagonal.
    #[must_use]
    pub fn trace(&self) -> f64 {
        (0..self.node_count())
            .flat_map(|node| self.pattern.row(node).map(move |i| (node, i)))
            .filter(|(node, i)| self.pattern.columns[*i] as usize == *node)
            .map(|(_, i)| self.blocks[i].trace())
            .sum()
    }

    /// Frobenius norm.
    #[must_use]
    pub fn norm(&self) -> f64 {
        self.blocks.iter().map(Matrix3::norm_squared).sum::<f64>().sqrt()
    }
}

/// Mass per pair of nodes, kg.
#[derive(Debug, Clone, PartialEq)]
pub enum NodalMass {
    /// One mass per node.
    Lumped(Vec<f64>),
    /// From the shape functions.
    Consistent(ConsistentMass),
}

/// Sparse symmetric nodal mass, both triangles stored.
#[derive(Debug, Clone, PartialEq)]
pub struct ConsistentMass {
    pub(crate) pattern: NodePattern,
    pub(crate) values: Vec<f64>,
}

impl NodalMass {
    /// Number of nodes.
    #[must_use]
    pub fn node_count(&self) -> usize {
        match self {
            Self::Lumped(masses) => masses.len(),
            Self::Consistent(mass) => mass.pattern.row_start.len() - 1,
        }
    }

    /// Mass of the body, kg.
    #[must_use]
    pub fn total_kg(&self) -> f64 {
        match self {
            Self::Lumped(masses) => masses.iter().sum(),
            Self::Consistent(mass) => mass.values.iter().sum(),
        }
    }

    /// `M x` for nodal columns (3·nodes × k).
    #[must_use]
    pub fn multiply(&self, x: &DMatrix<f64>) -> DMatrix<f64> {
        match self {
            Self::Lumped(masses) => DMatrix::from_fn(x.nrows(), x.ncols(), |row, column| {
                masses[row / 3] * x[(row, column)]
            }),
            Self::Consistent(mass) => {
                let mut y = DMatrix::zeros(x.nrows(), x.ncols());
                for column in 0..x.ncols() {
                    for node in 0..self.node_count() {
                        let mut sum = Vector3::zeros();
                        for i in mass.pattern.row(node) {
                            let j = 3 * mass.pattern.columns[i] as usize;
                            sum += x.fixed_view::<3, 1>(j, column) * mass.values[i];
                        }
                        y.fixed_view_mut::<3, 1>(3 * node, column).copy_from(&sum);
                    }
                }
                y
            }
        }
    }
}

/// Assembles the stiffness matrix, N/m.
#[must_use]
pub fn assemble_stiffness(mesh: &Mesh, material: &Material) -> BlockMatrix {
    let pattern = NodePattern::of(mesh);
    let mut blocks = vec![Matrix3::zeros(); pattern.columns.len()];
    match mesh.elements() {
        Elements::Tet4(elements) => {
            add_stiffness::<4, Tet4>(mesh, elements, material, &pattern, &mut blocks);
        }
        Elements::Tet10(elements) => {
            add_stiffness::<10, Tet10>(mesh, elements, material, &pattern, &mut blocks);
        }
    }
    BlockMatrix { pattern, blocks }
}

fn add_stiffness<const N: usize, E: Tetrahedron<N>>(
    mesh: &Mesh,
    elements: &[[u32; N]],
    material: &Material,
    pattern: &NodePattern,
    blocks: &mut [Matrix3<f64>],
) {
    for element in elements {
        let k = E::stiffness(&mesh.corners(element), material);
        for (a, k) in element.iter().zip(&k) {
            for (b, k) in element.iter().zip(k) {
                blocks[pattern.position(*a, *b)] += k;
            }
        }
    }
}

/// Assembles the mass matrix, kg.
#[must_use]
pub fn assemble_mass(mesh: &Mesh, material: &Material, kind: MassKind) -> NodalMass {
    match mesh.elements() {
        Elements::Tet4(elements) => add_mass::<4, Tet4>(mesh, elements, material, kind),
        Elements::Tet10(elements) => add_mass::<10, Tet10>(mesh, elements, material, kind),
    }
}

fn add_mass<const N: usize, E: Tetrahedron<N>>(
    mesh: &Mesh,
    elements: &[[u32; N]],
    material: &Material,
    kind: MassKind,
) -> NodalMass {
    match kind {
        MassKind::Lumped => {
            let mut masses = vec![0.0; mesh.node_count()];
            for element in elements {
                let m = E::lumped_mass(&mesh.corners(element), material);
                for (node, m) in element.iter().zip(m) {
                    masses[*node as usize] += m;
                }
            }
            NodalMass::Lumped(masses)
        }
        MassKind::Consistent => {
            let pattern = NodePattern::of(mesh);
            let mut values = vec![0.0; pattern.columns.len()];
            for element in elements {
                let m = E::consistent_mass(&mesh.corners(element), material);
                for (i, a) in element.iter().enumerate() {
                    for (j, b) in element.iter().enumerate() {
                        values[pattern.position(*a, *b)] += m[(i, j)];
                    }
                }
            }
            NodalMass::Consistent(ConsistentMass { pattern, values })
        }
    }
}
