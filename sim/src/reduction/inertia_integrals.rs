//! Inertia integrals of the nodal floating frame (theory note §3.1; Zwölfer, Gerstmayr 2021).
//!
//! With isotropic nodal blocks `M_ij = m_ij I` every integral is a contraction of node vectors with
//! `y = M x`:
//!
//! ```text
//! til(a)ᵀ M til(b) = Σ_i (a_i · y_i) I − y_i a_iᵀ        with y = M b
//! til(a)ᵀ M b      = −Σ_i a_i × y_i
//! ```

use crate::fe::{Mesh, NodalMass};
use nalgebra::{DMatrix, Matrix3, Matrix3xX, Vector3};

/// Integrals of a body in a basis of n modes, body frame, SI. Names as in
/// [`ReducedBody`](super::ReducedBody).
pub(super) struct InertiaIntegrals {
    pub(super) mass_kg: f64,
    pub(super) centre_of_mass_m: Vector3<f64>,
    pub(super) inertia_origin_kg_m2: Matrix3<f64>,
    pub(super) mass_modal: DMatrix<f64>,
    pub(super) c_pt: Matrix3xX<f64>,
    pub(super) c_xp: Matrix3xX<f64>,
    pub(super) n_blocks: Vec<Matrix3<f64>>,
    pub(super) b_blocks: Vec<Matrix3<f64>>,
    pub(super) c_vectors: Vec<Vector3<f64>>,
}

/// `Σ_i y_i a_iᵀ` over nodal vectors.
fn moment(y: &[f64], a: &[f64]) -> Matrix3<f64> {
    let mut sum = Matrix3::zeros();
    for (y, a) in y.chunks_exact(3).zip(a.chunks_exact(3)) {
        for c in 0..3 {
            for r in 0..3 {
                sum[(r, c)] += y[r] * a[c];
            }
        }
    }
    sum
}

/// `til(a)ᵀ M til(b)` from the moment of y = M b with a.
fn tilde_tilde(moment: &Matrix3<f64>) -> Matrix3<f64> {
    Matrix3::from_diagonal_element(moment.trace()) - moment
}

/// `til(a)ᵀ M b = −Σ a × y` from the moment `P = Σ y aᵀ`: `(a × y)_x = a_y y_z − a_z y_y`.
fn tilde_plain(moment: &Matrix3<f64>) -> Vector3<f64> {
    let p = moment;
    -Vector3::new(
        p[(2, 1)] - p[(1, 2)],
        p[(0, 2)] - p[(2, 0)],
        p[(1, 0)] - p[(0, 1)],
    )
}

/// Computes all integrals. `modes` is Ψ, 3·nodes × n.
pub(super) fn integrate(mesh: &Mesh, mass: &NodalMass, modes: &DMatrix<f64>) -> InertiaIntegrals {
    let n = modes.ncols();
    let mut positions = DMatrix::zeros(3 * mesh.node_count(), 1);
    for (i, x) in mesh.nodes_m().iter().enumerate() {
        positions.fixed_view_mut::<3, 1>(3 * i, 0).copy_from(x);
    }
    let sum = |y: &[f64]| -> Vector3<f64> { y.chunks_exact(3).map(|y| Vector3::new(y[0], y[1], y[2])).sum() };

    let mass_positions = mass.multiply(&positions);
    let mass_kg = mass.total_kg();
    let x = positions.as_slice();
    let mass_modes = mass.multiply(modes);
    let rows = modes.nrows();
    let mode = |m: usize| &modes.as_slice()[m * rows..(m + 1) * rows];
    let mass_mode = |m: usize| &mass_modes.as_slice()[m * rows..(m + 1) * rows];

    let mut integrals = InertiaIntegrals {
        mass_kg,
        centre_of_mass_m: sum(mass_positions.as_slice()) / mass_kg,
        inertia_origin_kg_m2: tilde_tilde(&moment(mass_positions.as_slice(), x)),
        mass_modal: DMatrix::zeros(n, n),
        c_pt: Matrix3xX::zeros(n),
        c_xp: Matrix3xX::zeros(n),
        n_blocks: Vec::with_capacity(n),
        b_blocks: vec![Matrix3::zeros(); n * n],
        c_vectors: vec![Vector3::zeros(); n * n],
    };
    for k in 0..n {
        let y = mass_mode(k);
        integrals.c_pt.set_column(k, &sum(y));
        let with_positions = moment(y, x);
        integrals.c_xp.set_column(k, &tilde_plain(&with_positions));
        integrals.n_blocks.push(tilde_tilde(&with_positions));
        for m in 0..=k {
            let p = moment(y, mode(m));
            let (b, c) = (tilde_tilde(&p), tilde_plain(&p));
            integrals.mass_modal[(m, k)] = p.trace();
            integrals.mass_modal[(k, m)] = p.trace();
            integrals.b_blocks[m * n + k] = b;
            integrals.b_blocks[k * n + m] = b.transpose();
            // zero for m = k but for rounding
            let c = if m == k { Vector3::zeros() } else { c };
            integrals.c_vectors[m * n + k] = c;
            integrals.c_vectors[k * n + m] = -c;
        }
    }
    integrals
}
