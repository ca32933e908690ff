//! Sparse Cholesky of the stiffness of free nodes.

use super::ReductionError;
use crate::fe::{BlockMatrix, NodalMass};
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::{LltError, LltRegularization};
use faer::perm::PermRef;
use faer::sparse::linalg::amd;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LltRef, SymbolicCholesky, SymbolicCholeskyRaw, SymmetricOrdering,
    factorize_symbolic_cholesky,
};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMatRef};
use faer::{Conj, MatMut, Par, Side, Spec};
use nalgebra::DMatrix;

/// Smallest ratio of a Cholesky pivot to its diagonal entry that counts as stiff.
///
/// Both are stiffnesses of one unknown: with its neighbours held, and with them relaxed. A real
/// structure stays above about 1e-9 (a 3 m boom meshed with 10 mm elements: 1e-6); a mechanism
/// leaves rounding, 1e-13 and below.
const SINGULAR_PIVOT_RATIO: f64 = 1e-12;

/// Factor of `K + s M` over the free nodes, for repeated solves.
pub(super) struct StiffnessFactor {
    symbolic: SymbolicCholesky<usize>,
    values: Vec<f64>,
    /// Free nodes, ascending: unknown 3·i + c belongs to `free_nodes[i]`.
    pub(super) free_nodes: Vec<u32>,
}

impl StiffnessFactor {
    /// Factors the rows and columns of the nodes that are not fixed.
    ///
    /// `shift_per_s2` is s, 1/s²; with 0 the structure must be held by the fixed nodes.
    pub(super) fn new(
        stiffness: &BlockMatrix,
        mass: &NodalMass,
        shift_per_s2: f64,
        is_fixed: &[bool],
    ) -> Result<Self, ReductionError> {
        let free_nodes: Vec<u32> = (0_u32..)
            .zip(is_fixed)
            .filter_map(|(node, fixed)| (!fixed).then_some(node))
            .collect();
        let lower = LowerMatrix::new(stiffness, mass, shift_per_s2, &free_nodes);
        let order = node_ordering(stiffness, &free_nodes)?;
        let symbolic = factorize_symbolic_cholesky(
            lower.symbolic(),
            Side::Lower,
            SymmetricOrdering::Custom(PermRef::new_checked(
                &order.forward,
                &order.inverse,
                order.forward.len(),
            )),
            CholeskySymbolicParams::default(),
        )
        .map_err(|_| ReductionError::OutOfMemory {
            unknowns: lower.size(),
        })?;

        let mut values = vec![0.0; symbolic.len_val()];
        let scratch = symbolic.factorize_numeric_llt_scratch::<f64>(Par::Seq, Spec::default());
        let mut memory = MemBuffer::try_new(scratch).map_err(|_| ReductionError::OutOfMemory {
            unknowns: lower.size(),
        })?;
        // one thread: the factor is then the same for any number of cores
        let factored = symbolic.factorize_numeric_llt(
            &mut values,
            SparseColMatRef::new(lower.symbolic(), &lower.values),
            Side::Lower,
            LltRegularization::default(),
            Par::Seq,
            MemStack::new(&mut memory),
            Spec::default(),
        );
        let node_of = |unknown: usize| free_nodes[order.forward[unknown] / 3];
        if let Err(LltError::NonPositivePivot { index }) = factored {
            return Err(ReductionError::SingularStiffness {
                node: node_of(index.min(lower.size() - 1)),
            });
        }
        if shift_per_s2 == 0.0 {
            let diagonal = lower.diagonal();
            for (unknown, pivot) in pivots(&symbolic, &values).into_iter().enumerate() {
                let ratio = pivot * pivot / diagonal[order.forward[unknown]];
                if ratio < SINGULAR_PIVOT_RATIO || ratio.is_nan() {
                    return Err(ReductionError::SingularStiffness {
                        node: node_of(unknown),
                    });
                }
            }
        }
        Ok(Self {
            symbolic,
            values,
            free_nodes,
        })
    }

    /// Number of unknowns.
    pub(super) fn size(&self) -> usize {
        3 * self.free_nodes.len()
    }

    /// Solves in place for all columns.
    pub(super) fn solve_in_place(&self, rhs: &mut DMatrix<f64>) {
        let (rows, columns) = rhs.shape();
        assert_eq!(rows, self.size(), "right-hand side must match the free unknowns");
        if rows == 0 || columns == 0 {
            return;
        }
        let mut memory = MemBuffer::new(self.symbolic.solve_in_place_scratch::<f64>(columns, Par::Seq));
        LltRef::new(&self.symbolic, &self.values).solve_in_place_with_conj(
            Conj::No,
            MatMut::from_column_major_slice_mut(rhs.as_mut_slice(), rows, columns),
            Par::Seq,
            MemStack::new(&mut memory),
        );
    }

    /// Takes the rows of the free nodes out of nodal columns.
    pub(super) fn gather(&self, nodal: &DMatrix<f64>) -> DMatrix<f64> {
        DMatrix::from_fn(self.size(), nodal.ncols(), |row, column| {
            nodal[(3 * self.free_nodes[row / 3] as usize + row % 3, column)]
        })
    }

    /// Writes the rows of the free nodes into nodal columns.
    pub(super) fn scatter(&self, free: &DMatrix<f64>, nodal: &mut DMatrix<f64>) {
        for column in 0..free.ncols() {
            for (i, node) in self.free_nodes.iter().enumerate() {
                for c in 0..3 {
                    nodal[(3 * *node as usize + c, column)] = free[(3 * i + c, column)];
                }
            }
        }
    }
}

/// Diagonal of L in pivot order.
fn pivots(symbolic: &SymbolicCholesky<usize>, values: &[f64]) -> Vec<f64> {
    match symbolic.raw() {
        SymbolicCholeskyRaw::Simplicial(factor) => factor
            .col_ptr()
            .iter()
            .take(factor.ncols())
            .map(|start| values[*start])
            .collect(),
        SymbolicCholeskyRaw::Supernodal(factor) => {
            let mut pivots = Vec::with_capacity(factor.ncols());
            for s in 0..factor.n_supernodes() {
                let columns = factor.supernode_end()[s] - factor.supernode_begin()[s];
                let rows = columns + factor.supernode(s).pattern().len();
                let start = factor.col_ptr_for_val()[s];
                pivots.extend((0..columns).map(|c| values[start + c * rows + c]));
            }
            pivots
        }
    }
}

/// Lower triangle over the free unknowns, compressed by column.
struct LowerMatrix {
    column_start: Vec<usize>,
    rows: Vec<usize>,
    values: Vec<f64>,
}

const FIXED: usize = usize::MAX;

/// Free index of every node, [`FIXED`] for the others.
fn free_index(node_count: usize, free_nodes: &[u32]) -> Vec<usize> {
    let mut index = vec![FIXED; node_count];
    for (i, node) in free_nodes.iter().enumerate() {
        index[*node as usize] = i;
    }
    index
}

impl LowerMatrix {
    fn new(stiffness: &BlockMatrix, mass: &NodalMass, shift_per_s2: f64, free_nodes: &[u32]) -> Self {
        let index = free_index(stiffness.node_count(), free_nodes);
        let mut column_start = vec![0];
        let (mut rows, mut values) = (Vec::new(), Vec::new());
        for &node in free_nodes {
            let column_node = index[node as usize];
            let range = stiffness.pattern.row(node as usize);
            for c in 0..3 {
                for i in range.clone() {
                    let neighbour = stiffness.pattern.columns[i] as usize;
                    let row_node = index[neighbour];
                    if row_node == FIXED || row_node < column_node {
                        continue;
                    }
                    let added = if shift_per_s2 == 0.0 {
                        0.0
                    } else {
                        shift_per_s2 * nodal_mass_entry(mass, node, neighbour, i)
                    };
                    for r in 0..3 {
                        if row_node == column_node && r < c {
                            continue;
                        }
                        rows.push(3 * row_node + r);
                        let value = stiffness.blocks[i][(c, r)];
                        values.push(if r == c { value + added } else { value });
                    }
                }
                column_start.push(rows.len());
            }
        }
        Self {
            column_start,
            rows,
            values,
        }
    }

    fn size(&self) -> usize {
        self.column_start.len() - 1
    }

    fn symbolic(&self) -> SymbolicSparseColMatRef<'_, usize> {
        SymbolicSparseColMatRef::new_checked(self.size(), self.size(), &self.column_start, None, &self.rows)
    }

    /// The first entry of each column is its diagonal.
    fn diagonal(&self) -> Vec<f64> {
        self.column_start[..self.size()]
            .iter()
            .map(|start| self.values[*start])
            .collect()
    }
}

/// Entry (node, neighbour) of the mass, kg; `i` is its position in the shared pattern.
fn nodal_mass_entry(mass: &NodalMass, node: u32, neighbour: usize, i: usize) -> f64 {
    match mass {
        NodalMass::Lumped(masses) if node as usize == neighbour => masses[neighbour],
        NodalMass::Lumped(_) => 0.0,
        NodalMass::Consistent(mass) => mass.values[i],
    }
}

struct Ordering {
    /// Pivot position → unknown.
    forward: Vec<usize>,
    /// Unknown → pivot position.
    inverse: Vec<usize>,
}

/// Approximate minimum degree on the graph of nodes; the three unknowns of a node stay together,
/// which is a third of the work and gives wide supernodes.
fn node_ordering(stiffness: &BlockMatrix, free_nodes: &[u32]) -> Result<Ordering, ReductionError> {
    let n = free_nodes.len();
    let out_of_memory = |()| ReductionError::OutOfMemory { unknowns: 3 * n };
    let index = free_index(stiffness.node_count(), free_nodes);
    let mut column_start = vec![0];
    let mut rows = Vec::new();
    for &node in free_nodes {
        let neighbours = &stiffness.pattern.columns[stiffness.pattern.row(node as usize)];
        rows.extend(
            neighbours
                .iter()
                .map(|neighbour| index[*neighbour as usize])
                .filter(|i| *i != FIXED),
        );
        column_start.push(rows.len());
    }
    let graph = SymbolicSparseColMatRef::new_checked(n, n, &column_start, None, &rows);
    let (mut forward, mut inverse) = (vec![0; n], vec![0; n]);
    let mut memory =
        MemBuffer::try_new(amd::order_scratch::<usize>(n, rows.len())).map_err(|_| out_of_memory(()))?;
    amd::order(
        &mut forward,
        &mut inverse,
        graph,
        amd::Control::default(),
        MemStack::new(&mut memory),
    )
    .map_err(|_| out_of_memory(()))?;
    let expand = |nodes: &[usize]| -> Vec<usize> {
        nodes
            .iter()
            .flat_map(|node| [3 * node, 3 * node + 1, 3 * node + 2])
            .collect()
    };
    Ok(Ordering {
        forward: expand(&forward),
        inverse: expand(&inverse),
    })
}
