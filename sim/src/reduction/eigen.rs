//! Lowest modes of `K v = ω² M v` by a block Krylov method with the factor of `K + s M`.
//!
//! Shift-and-invert turns the lowest modes into the largest eigenvalues `θ = 1/(ω² + s)` of the
//! operator `A = (K + s M)⁻¹ M`, which is symmetric in the M inner product. Each block `A V_j` is
//! made M-orthonormal to all earlier ones (twice, which is enough: Giraud et al. 2005), and the
//! Rayleigh-Ritz step works on all of them. A block rather than one vector finds the equal
//! frequencies of symmetric structures.

use super::ReductionError;
use super::factor::StiffnessFactor;
use crate::fe::NodalMass;
use nalgebra::{DMatrix, DVector};

/// Modes over the free unknowns, ascending in frequency.
pub(super) struct Modes {
    /// ω², 1/s². Negative only by rounding, for rigid motions.
    pub(super) omega_squared: Vec<f64>,
    /// M-orthonormal columns.
    pub(super) shapes: DMatrix<f64>,
}

/// Residual `‖A v − θ v‖_M / θ` at which a mode counts as found: the error of the shape is this
/// over the relative gap of the frequencies, that of the frequency its square.
const RESIDUAL_TOLERANCE: f64 = 1e-13;

/// Below this a residual that no longer shrinks is rounding of a badly conditioned mesh, and taken.
const ROUNDING_RESIDUAL: f64 = 1e-9;

/// Blocks after which the search is given up; about six are needed.
const MAX_BLOCKS: usize = 60;

/// Finds the `count` lowest modes. `shift_per_s2` is the shift the factor was made with.
pub(super) fn lowest_modes(
    factor: &StiffnessFactor,
    mass: &NodalMass,
    shift_per_s2: f64,
    count: usize,
) -> Result<Modes, ReductionError> {
    let n = factor.size();
    if count == 0 {
        return Ok(Modes {
            omega_squared: Vec::new(),
            shapes: DMatrix::zeros(n, 0),
        });
    }
    if count > n {
        return Err(ReductionError::TooManyModes {
            wanted: count,
            unknowns: n,
        });
    }
    let width = (count + 2).min(n).min(8);
    let mut search = Search {
        factor,
        mass,
        basis: Vec::new(),
        mass_basis: Vec::new(),
        image: Vec::new(),
    };
    let mut block = start_block(n, width);
    let mut worst_residual = f64::INFINITY;
    for _ in 0..MAX_BLOCKS {
        let last_residual = worst_residual;
        let first_new = search.basis.len();
        search.append(block);
        if search.basis.len() > first_new {
            search.apply_operator(first_new);
        }
        let exhausted = search.basis.len() == first_new || search.basis.len() == n;
        if search.basis.len() >= count {
            let ritz = search.ritz(count);
            worst_residual = ritz.worst_residual;
            let stalled = worst_residual < ROUNDING_RESIDUAL && worst_residual > 0.5 * last_residual;
            if worst_residual < RESIDUAL_TOLERANCE || stalled || exhausted {
                return Ok(ritz.into_modes(shift_per_s2));
            }
        }
        if exhausted {
            break;
        }
        block = DMatrix::from_columns(&search.image[first_new..]);
    }
    Err(ReductionError::ModesNotConverged {
        wanted: count,
        residual: worst_residual,
    })
}

/// A fixed, smooth and generic start: no random numbers, no symmetry of its own.
fn start_block(n: usize, width: usize) -> DMatrix<f64> {
    DMatrix::from_fn(n, width, |row, column| {
        let (i, j) = (row as f64 + 1.0, column as f64 + 1.0);
        (0.37 * i * (1.0 + 0.11 * j)).sin() + 0.5 * (0.011 * i + j).cos() + 0.1 * j
    })
}

struct Search<'a> {
    factor: &'a StiffnessFactor,
    mass: &'a NodalMass,
    /// M-orthonormal vectors V.
    basis: Vec<DVector<f64>>,
    /// M V.
    mass_basis: Vec<DVector<f64>>,
    /// A V.
    image: Vec<DVector<f64>>,
}

struct Ritz {
    theta: Vec<f64>,
    shapes: DMatrix<f64>,
    worst_residual: f64,
}

impl Ritz {
    fn into_modes(self, shift_per_s2: f64) -> Modes {
        Modes {
            omega_squared: self.theta.iter().map(|t| 1.0 / t - shift_per_s2).collect(),
            shapes: self.shapes,
        }
    }
}

impl Search<'_> {
    fn mass_times(&self, x: &DMatrix<f64>) -> DMatrix<f64> {
        let mut nodal = DMatrix::zeros(3 * self.mass.node_count(), x.ncols());
        self.factor.scatter(x, &mut nodal);
        self.factor.gather(&self.mass.multiply(&nodal))
    }

    /// Orthonormalises the columns against the basis and each other, and appends them; a column
    /// that lies in the span already is dropped.
    fn append(&mut self, block: DMatrix<f64>) {
        for column in block.column_iter() {
            let mut v = column.into_owned();
            let mut length = self.norm(&v).0;
            if length == 0.0 || !length.is_finite() {
                continue;
            }
            v /= length;
            for _ in 0..3 {
                for (b, mb) in self.basis.iter().zip(&self.mass_basis) {
                    v.axpy(-mb.dot(&v), b, 1.0);
                }
                length = self.norm(&v).0;
                if length < 1e-10 {
                    break;
                }
                v /= length;
            }
            if length >= 1e-10 {
                let mv = self.norm(&v).1;
                self.basis.push(v);
                self.mass_basis.push(mv);
            }
        }
    }

    /// M norm of a vector, and M times it.
    fn norm(&self, v: &DVector<f64>) -> (f64, DVector<f64>) {
        let column = DMatrix::from_column_slice(v.len(), 1, v.as_slice());
        let mv = self.mass_times(&column).column(0).into_owned();
        (v.dot(&mv).max(0.0).sqrt(), mv)
    }

    fn apply_operator(&mut self, first: usize) {
        let mut image = DMatrix::from_columns(&self.mass_basis[first..]);
        self.factor.solve_in_place(&mut image);
        self.image
            .extend(image.column_iter().map(|column| column.into_owned()));
    }

    fn ritz(&self, count: usize) -> Ritz {
        let size = self.basis.len();
        let t = DMatrix::from_fn(size, size, |i, j| {
            0.5 * (self.mass_basis[i].dot(&self.image[j]) + self.mass_basis[j].dot(&self.image[i]))
        });
        let eigen = t.symmetric_eigen();
        let mut order: Vec<usize> = (0..size).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
        order.truncate(count);

        let n = self.basis[0].len();
        let mut shapes = DMatrix::zeros(n, count);
        let mut images = DMatrix::zeros(n, count);
        for (column, which) in order.iter().enumerate() {
            for (i, s) in eigen.eigenvectors.column(*which).iter().enumerate() {
                shapes.column_mut(column).axpy(*s, &self.basis[i], 1.0);
                images.column_mut(column).axpy(*s, &self.image[i], 1.0);
            }
        }
        let theta: Vec<f64> = order.iter().map(|i| eigen.eigenvalues[*i]).collect();
        let mut worst_residual: f64 = 0.0;
        for (column, theta) in theta.iter().enumerate() {
            let residual = images.column(column) - shapes.column(column) * *theta;
            worst_residual = worst_residual.max(self.norm(&residual).0 / theta.abs());
        }
        Ritz {
            theta,
            shapes,
            worst_residual,
        }
    }
}
