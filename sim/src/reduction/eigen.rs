//! Lowest modes of `K v = ω² M v` by block Lanczos with the factor of `K + s M`.
//!
//! Shift-and-invert turns the lowest modes into the largest eigenvalues `θ = 1/(ω² + s)` of the
//! operator `A = (K + s M)⁻¹ M`, which is symmetric in the M inner product:
//!
//! ```text
//! A V_j = V_1 H_1j + … + V_j H_jj + V_{j+1} R,     V M-orthonormal
//! ```
//!
//! Each block is made orthogonal to all earlier ones twice (enough: Giraud et al. 2005). With
//! `T = Vᵀ M A V` and `T s = θ s`, the Ritz vector `V s` has the residual `‖R s_j‖`, where `s_j` is
//! the last block of s. A block rather than one vector finds the equal frequencies of symmetric
//! structures.

use super::ReductionError;
use super::factor::StiffnessFactor;
use crate::fe::NodalMass;
use nalgebra::DMatrix;

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

/// Blocks after which the search is given up; six to ten are needed.
const MAX_BLOCKS: usize = 80;

/// Part of a vector that must be left after taking out the basis; less is rounding.
const INDEPENDENT_PART: f64 = 1e-13;

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
    let mut search = Search {
        factor,
        mass,
        basis: DMatrix::zeros(n, 0),
        mass_basis: DMatrix::zeros(n, 0),
        projected: DMatrix::zeros(0, 0),
    };
    let mut last = search.append(start_block(n, (count + 2).min(n).min(8))).ncols();
    let mut residual = f64::INFINITY;
    for _ in 0..MAX_BLOCKS {
        let next = search.step(last);
        let size = search.projected.nrows();
        let eigen = search.projected.clone().symmetric_eigen();
        let mut order: Vec<usize> = (0..size).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
        order.truncate(count);
        let theta: Vec<f64> = order.iter().map(|i| eigen.eigenvalues[*i]).collect();

        let remainder = search.append(next);
        let exhausted = remainder.nrows() == 0 || size == n;
        if size >= count {
            let s = eigen.eigenvectors.select_columns(&order);
            let tail = remainder * s.rows(size - last, last);
            residual = tail
                .column_iter()
                .zip(&theta)
                .map(|(column, theta)| column.norm() / theta.abs())
                .fold(0.0, f64::max);
            if residual < RESIDUAL_TOLERANCE || exhausted {
                return Ok(Modes {
                    omega_squared: theta.iter().map(|t| 1.0 / t - shift_per_s2).collect(),
                    shapes: search.basis.columns(0, size) * s,
                });
            }
        }
        if exhausted {
            break;
        }
        last = search.basis.ncols() - size;
    }
    Err(ReductionError::ModesNotConverged {
        wanted: count,
        residual,
    })
}

/// A fixed, smooth and generic start: no random numbers, no symmetry of its own.
fn start_block(n: usize, width: usize) -> DMatrix<f64> {
    DMatrix::from_fn(n, width, |row, column| {
        let (i, j) = (row as f64 + 1.0, column as f64 + 1.0);
        libm::sin(0.37 * i * (1.0 + 0.11 * j)) + 0.5 * libm::cos(0.011 * i + j) + 0.1 * j
    })
}

struct Search<'a> {
    factor: &'a StiffnessFactor,
    mass: &'a NodalMass,
    /// M-orthonormal vectors V.
    basis: DMatrix<f64>,
    /// M V.
    mass_basis: DMatrix<f64>,
    /// T = Vᵀ M A V over the blocks that A was applied to.
    projected: DMatrix<f64>,
}

impl Search<'_> {
    fn mass_times(&self, x: &DMatrix<f64>) -> DMatrix<f64> {
        let mut nodal = DMatrix::zeros(3 * self.mass.node_count(), x.ncols());
        self.factor.scatter(x, &mut nodal);
        self.factor.gather(&self.mass.multiply(&nodal))
    }

    /// Applies A to the last block of `width` vectors, extends T, and returns what is orthogonal to
    /// the basis.
    fn step(&mut self, width: usize) -> DMatrix<f64> {
        let size = self.basis.ncols();
        let mut image = self.mass_basis.columns(size - width, width).into_owned();
        self.factor.solve_in_place(&mut image);
        let mut h = DMatrix::zeros(size, width);
        for _ in 0..2 {
            let part = self.mass_basis.tr_mul(&image);
            image -= &self.basis * &part;
            h += part;
        }
        let first = size - width;
        let mut t = std::mem::take(&mut self.projected).resize(size, size, 0.0);
        for j in 0..width {
            for i in 0..size {
                t[(i, first + j)] = h[(i, j)];
                t[(first + j, i)] = h[(i, j)];
            }
        }
        // the diagonal block is symmetric but for rounding
        for i in 0..width {
            for j in 0..i {
                let mean = 0.5 * (h[(first + i, j)] + h[(first + j, i)]);
                t[(first + i, first + j)] = mean;
                t[(first + j, first + i)] = mean;
            }
        }
        self.projected = t;
        image
    }

    /// M-orthonormalises the columns and appends them; returns R with `block = new vectors · R`. A
    /// column that the others span already is dropped.
    fn append(&mut self, mut block: DMatrix<f64>) -> DMatrix<f64> {
        let width = block.ncols();
        let mut mass_block = self.mass_times(&block);
        let mut r = DMatrix::zeros(width, width);
        let mut kept = 0;
        let scale = (0..width)
            .map(|j| block.column(j).dot(&mass_block.column(j)))
            .fold(0.0, f64::max)
            .sqrt();
        for j in 0..width {
            for _ in 0..2 {
                for i in 0..kept {
                    let part = mass_block.column(i).dot(&block.column(j));
                    r[(i, j)] += part;
                    let (q, mq) = (block.column(i).into_owned(), mass_block.column(i).into_owned());
                    block.column_mut(j).axpy(-part, &q, 1.0);
                    mass_block.column_mut(j).axpy(-part, &mq, 1.0);
                }
            }
            let length = block.column(j).dot(&mass_block.column(j)).max(0.0).sqrt();
            if length <= INDEPENDENT_PART * scale || !length.is_finite() {
                continue;
            }
            r[(kept, j)] = length;
            let (q, mq) = (block.column(j) / length, mass_block.column(j) / length);
            block.set_column(kept, &q);
            mass_block.set_column(kept, &mq);
            kept += 1;
        }
        let block = block.columns(0, kept).into_owned();
        // recomputed: updating M Q alongside loses digits
        let mass_block = self.mass_times(&block);
        let size = self.basis.ncols();
        let grow = |m: DMatrix<f64>| m.resize_horizontally(size + kept, 0.0);
        self.basis = grow(std::mem::take(&mut self.basis));
        self.mass_basis = grow(std::mem::take(&mut self.mass_basis));
        self.basis.columns_mut(size, kept).copy_from(&block);
        self.mass_basis.columns_mut(size, kept).copy_from(&mass_block);
        r.rows(0, kept).into_owned()
    }
}
