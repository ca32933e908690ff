//! A reduced body in its floating frame of reference: inertia, velocity and elastic terms.
//!
//! Notation of theory note §3. Generalised forces and virtual displacements are taken in
//! `[δr (global), δφ (body frame), δη]`: with Euler parameters `δφ = G δθ`, and because
//! `G θ = 0`, the rows of the Euler parameters are `Gᵀ` times ours, while the multiplier of the
//! normalisation condition is zero. A rigid body is one without modes.

use nalgebra::{DMatrix, Matrix3, SymmetricEigen, Vector3, Vector4};

use super::rotation::{rate_map, rotation_matrix, skew};
use crate::instruction_set::widest;
use crate::reduction::ReducedBody;

/// Why a reduced body cannot move.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BodyError {
    /// The reduced mass matrix has no Cholesky factor.
    #[error("reduced mass matrix of body `{body}` is not positive definite")]
    MassNotPositiveDefinite {
        /// Body name.
        body: String,
    },
    /// A generalised mode has no positive stiffness.
    #[error("mode {mode} of body `{body}` has stiffness {stiffness:e} s⁻², which must be positive")]
    StiffnessNotPositive {
        /// Body name.
        body: String,
        /// Number of the mode, from zero.
        mode: usize,
        /// Eigenvalue ω² of the mode.
        stiffness: f64,
    },
    /// The damping matrix couples generalised modes.
    #[error(
        "damping of body `{body}` couples modes {first} and {second}: only Rayleigh and modal damping are known"
    )]
    DampingNotModal {
        /// Body name.
        body: String,
        /// One mode.
        first: usize,
        /// The other mode.
        second: usize,
    },
}

/// Constants of a body in its generalised modes: `Ψᵀ M Ψ = 1`, `Ψᵀ K Ψ = diag(ω²)`.
///
/// The change of basis does not change the response (theory note §4.1); it makes mass, stiffness
/// and damping of the modal coordinates diagonal. Modal coordinates η have unit m √kg.
#[derive(Debug, Clone, PartialEq)]
pub struct FloatingFrame {
    mass_kg: f64,
    /// m χ.
    pub(crate) first_moment_kg_m: Vector3<f64>,
    /// Θ₀ about the frame origin.
    pub(crate) inertia_kg_m2: Matrix3<f64>,
    /// ω² of every mode, s⁻².
    pub(crate) stiffness: Vec<f64>,
    /// Ψᵀ D Ψ of every mode, s⁻¹.
    pub(crate) damping: Vec<f64>,
    /// Columns of C_pt.
    pub(crate) c_pt: Vec<Vector3<f64>>,
    /// Columns of C_xp.
    pub(crate) c_xp: Vec<Vector3<f64>>,
    /// Blocks N_m, each 9 values column by column.
    pub(crate) n_blocks: Vec<f64>,
    /// Row m: blocks B_mk for all k, each 9 values column by column.
    pub(crate) b_rows: Vec<f64>,
    /// Row m: vectors c_mk for all k.
    pub(crate) c_rows: Vec<f64>,
    /// Columns: generalised modes in the coordinates of the reduced body.
    basis: DMatrix<f64>,
}

/// Motion of a body at an instant, and what follows from it. May be dirty between uses.
#[derive(Debug, Clone, Default)]
pub struct BodyMotion {
    /// Frame origin r, m, global.
    pub origin_m: Vector3<f64>,
    /// A, body → global.
    pub rotation: Matrix3<f64>,
    /// ṙ, global.
    pub velocity_m_per_s: Vector3<f64>,
    /// r̈, global.
    pub acceleration_m_per_s2: Vector3<f64>,
    /// ω, body frame.
    pub omega_rad_per_s: Vector3<f64>,
    /// ω̇, body frame.
    pub alpha_rad_per_s2: Vector3<f64>,
    /// η.
    pub eta: Vec<f64>,
    /// η̇.
    pub eta_rate: Vec<f64>,
    /// η̈.
    pub eta_acceleration: Vec<f64>,
    /// m χ + C_pt η.
    moment_kg_m: Vector3<f64>,
    /// Θ.
    pub(crate) inertia_kg_m2: Matrix3<f64>,
    /// N_m + Σ_k η_k B_km, blocks of 9.
    f_blocks: Vec<f64>,
    /// Columns of R.
    r_columns: Vec<f64>,
    /// Σ_k η̇_k c_km.
    coriolis: Vec<f64>,
}

impl FloatingFrame {
    /// A rigid body: inertia about the centre of mass, in the body frame.
    #[must_use]
    pub fn rigid(mass_kg: f64, centre_of_mass_m: Vector3<f64>, inertia_centre_kg_m2: Matrix3<f64>) -> Self {
        let offset = skew(&centre_of_mass_m);
        Self {
            mass_kg,
            first_moment_kg_m: mass_kg * centre_of_mass_m,
            inertia_kg_m2: inertia_centre_kg_m2 - mass_kg * offset * offset,
            stiffness: Vec::new(),
            damping: Vec::new(),
            c_pt: Vec::new(),
            c_xp: Vec::new(),
            n_blocks: Vec::new(),
            b_rows: Vec::new(),
            c_rows: Vec::new(),
            basis: DMatrix::zeros(0, 0),
        }
    }

    /// Takes the constants of a reduced body into its generalised modes.
    ///
    /// # Errors
    /// If the reduced mass or stiffness is not positive definite, or damping couples modes.
    pub fn flexible(body: &ReducedBody) -> Result<Self, BodyError> {
        let n = body.mode_count();
        let (basis, stiffness) = generalised_modes(body)?;
        let damping_full = basis.transpose() * &body.damping_modal * &basis;
        for i in 0..n {
            for j in 0..i {
                // Rounding of the stiff modes' entries reaches 1e-9 of the diagonal.
                let scale = (damping_full[(i, i)] * damping_full[(j, j)]).abs().sqrt() + 1e-9;
                if damping_full[(i, j)].abs() > 1e-6 * scale {
                    return Err(BodyError::DampingNotModal {
                        body: body.name.clone(),
                        first: j,
                        second: i,
                    });
                }
            }
        }
        let columns = |m: &nalgebra::Matrix3xX<f64>| -> Vec<Vector3<f64>> {
            let t = m * &basis;
            (0..n).map(|k| t.column(k).into_owned()).collect()
        };
        let mut n_blocks = vec![0.0; 9 * n];
        for k in 0..n {
            let block: Matrix3<f64> = (0..n).map(|i| body.n_blocks[i] * basis[(i, k)]).sum();
            n_blocks[9 * k..9 * k + 9].copy_from_slice(block.as_slice());
        }
        // Two-sided change of basis, one side at a time: O(n³) instead of O(n⁴).
        let mut half_b = vec![Matrix3::zeros(); n * n];
        let mut half_c = vec![Vector3::zeros(); n * n];
        for m in 0..n {
            for k in 0..n {
                for i in 0..n {
                    half_b[m * n + k] += body.b_blocks[i * n + k] * basis[(i, m)];
                    half_c[m * n + k] += body.c_vectors[i * n + k] * basis[(i, m)];
                }
            }
        }
        let mut b_rows = vec![0.0; 9 * n * n];
        let mut c_rows = vec![0.0; 3 * n * n];
        for m in 0..n {
            for k in 0..n {
                let (mut b, mut c) = (Matrix3::zeros(), Vector3::zeros());
                for j in 0..n {
                    b += half_b[m * n + j] * basis[(j, k)];
                    c += half_c[m * n + j] * basis[(j, k)];
                }
                b_rows[9 * (m * n + k)..][..9].copy_from_slice(b.as_slice());
                c_rows[3 * (m * n + k)..][..3].copy_from_slice(c.as_slice());
            }
        }
        Ok(Self {
            mass_kg: body.mass_kg,
            first_moment_kg_m: body.mass_kg * body.centre_of_mass_m,
            inertia_kg_m2: body.inertia_origin_kg_m2,
            stiffness,
            damping: (0..n).map(|k| damping_full[(k, k)]).collect(),
            c_pt: columns(&body.c_pt),
            c_xp: columns(&body.c_xp),
            n_blocks,
            b_rows,
            c_rows,
            basis,
        })
    }

    /// Number of modes n.
    #[must_use]
    pub fn mode_count(&self) -> usize {
        self.stiffness.len()
    }

    /// Mass, kg.
    #[must_use]
    pub fn mass_kg(&self) -> f64 {
        self.mass_kg
    }

    /// Generalised modes as columns in the reduced body's modal coordinates: `ζ = V η`.
    #[must_use]
    pub fn basis(&self) -> &DMatrix<f64> {
        &self.basis
    }

    /// Takes a linear map of ζ with three rows into the generalised modes.
    #[must_use]
    pub fn map_columns(&self, map: &nalgebra::Matrix3xX<f64>) -> Vec<Vector3<f64>> {
        let t = map * &self.basis;
        (0..self.mode_count()).map(|k| t.column(k).into_owned()).collect()
    }

    /// Motion with room for this body's modes.
    #[must_use]
    pub fn new_motion(&self) -> BodyMotion {
        let n = self.mode_count();
        BodyMotion {
            eta: vec![0.0; n],
            eta_rate: vec![0.0; n],
            eta_acceleration: vec![0.0; n],
            f_blocks: vec![0.0; 9 * n],
            r_columns: vec![0.0; 3 * n],
            coriolis: vec![0.0; 3 * n],
            ..BodyMotion::default()
        }
    }

    /// Evaluates the motion from coordinates `[r, θ, η]` and their first and second derivatives.
    pub fn evaluate(&self, q: &[f64], v: &[f64], a: &[f64], out: &mut BodyMotion) {
        evaluate(self, q, v, a, out);
    }

    /// Adds `M q̈ − f_v − f_e` to the residual rows: force (global), moment (body frame), modal.
    pub fn add_inertia_and_elastic(&self, motion: &BodyMotion, frame: &mut [f64], modal: &mut [f64]) {
        add_inertia_and_elastic(self, motion, frame, modal);
    }

    /// Subtracts gravity from the residual rows (theory note §3.5). With `deformed` the moment
    /// uses the centre of mass of the deformed body.
    pub fn subtract_gravity(
        &self,
        motion: &BodyMotion,
        gravity_m_per_s2: &Vector3<f64>,
        deformed: bool,
        frame: &mut [f64],
        modal: &mut [f64],
    ) {
        let local = motion.rotation.tr_mul(gravity_m_per_s2);
        let arm = if deformed {
            &motion.moment_kg_m
        } else {
            &self.first_moment_kg_m
        };
        add_vector(&mut frame[..3], &(-self.mass_kg * gravity_m_per_s2));
        add_vector(&mut frame[3..6], &-arm.cross(&local));
        for (row, c) in modal.iter_mut().zip(&self.c_pt) {
            *row -= c.dot(&local);
        }
    }

    /// Rigid 6 × 6 block of the mass matrix, rows `[δr, δφ]`, scaled by `scale`, added at
    /// (`first`, `first`) of the row-major square matrix `out` of order `order`.
    pub(crate) fn add_rigid_mass(
        &self,
        motion: &BodyMotion,
        scale: f64,
        out: &mut [f64],
        order: usize,
        first: usize,
    ) {
        let coupling = -(motion.rotation * skew(&motion.moment_kg_m));
        for i in 0..3 {
            out[(first + i) * order + first + i] += scale * self.mass_kg;
            for j in 0..3 {
                let c = scale * coupling[(i, j)];
                out[(first + i) * order + first + 3 + j] += c;
                out[(first + 3 + j) * order + first + i] += c;
                out[(first + 3 + i) * order + first + 3 + j] += scale * motion.inertia_kg_m2[(i, j)];
            }
        }
    }

    /// Column k of the rigid–modal block of the mass matrix: `[A C_pt; −R]`.
    pub(crate) fn modal_coupling(&self, motion: &BodyMotion, k: usize) -> [f64; 6] {
        let t = motion.rotation * self.c_pt[k];
        let r = &motion.r_columns[3 * k..3 * k + 3];
        [t.x, t.y, t.z, -r[0], -r[1], -r[2]]
    }

    /// Kinetic energy, J.
    #[must_use]
    pub fn kinetic_energy_j(&self, motion: &BodyMotion) -> f64 {
        let w = &motion.omega_rad_per_s;
        let v = motion.rotation.tr_mul(&motion.velocity_m_per_s);
        let mut modal = 0.0;
        let (mut s_rate, mut r_eta) = (Vector3::zeros(), Vector3::zeros());
        for k in 0..self.mode_count() {
            let rate = motion.eta_rate[k];
            modal += rate * rate;
            s_rate += self.c_pt[k] * rate;
            r_eta += Vector3::from_column_slice(&motion.r_columns[3 * k..3 * k + 3]) * rate;
        }
        0.5 * (self.mass_kg * v.norm_squared() + w.dot(&(motion.inertia_kg_m2 * w)) + modal)
            + v.dot(&(w.cross(&motion.moment_kg_m) + s_rate))
            - w.dot(&r_eta)
    }

    /// Elastic energy, J.
    #[must_use]
    pub fn elastic_energy_j(&self, motion: &BodyMotion) -> f64 {
        0.5 * self
            .stiffness
            .iter()
            .zip(&motion.eta)
            .map(|(k, e)| k * e * e)
            .sum::<f64>()
    }

    /// Potential of gravity, J, with the centre of mass of the deformed body.
    #[must_use]
    pub fn gravity_potential_j(&self, motion: &BodyMotion, gravity_m_per_s2: &Vector3<f64>) -> f64 {
        -gravity_m_per_s2.dot(&(self.mass_kg * motion.origin_m + motion.rotation * motion.moment_kg_m))
    }
}

widest! {
    fn evaluate(body: &FloatingFrame, q: &[f64], v: &[f64], a: &[f64], out: &mut BodyMotion) {
        let theta = Vector4::from_column_slice(&q[3..7]);
        let map = rate_map(&theta);
        out.origin_m = Vector3::from_column_slice(&q[..3]);
        out.rotation = rotation_matrix(&theta);
        out.velocity_m_per_s = Vector3::from_column_slice(&v[..3]);
        out.acceleration_m_per_s2 = Vector3::from_column_slice(&a[..3]);
        out.omega_rad_per_s = map * Vector4::from_column_slice(&v[3..7]);
        out.alpha_rad_per_s2 = map * Vector4::from_column_slice(&a[3..7]);
        out.eta.copy_from_slice(&q[7..]);
        out.eta_rate.copy_from_slice(&v[7..]);
        out.eta_acceleration.copy_from_slice(&a[7..]);

        let n = body.mode_count();
        out.moment_kg_m = body.first_moment_kg_m;
        out.f_blocks.copy_from_slice(&body.n_blocks);
        out.coriolis.fill(0.0);
        for (k, c) in body.c_xp.iter().enumerate() {
            out.r_columns[3 * k..3 * k + 3].copy_from_slice(c.as_slice());
        }
        for m in 0..n {
            out.moment_kg_m += body.c_pt[m] * out.eta[m];
        }
        add_combination(&mut out.f_blocks, &out.eta, &body.b_rows);
        add_combination(&mut out.r_columns, &out.eta, &body.c_rows);
        add_combination(&mut out.coriolis, &out.eta_rate, &body.c_rows);
        // Θ = Θ₀ + Xᵀ + Σ η_k F_k, because Σ η_k F_k = X + Σ η_m η_k B_mk.
        let mut sum = [0.0; 9];
        let mut x = [0.0; 9];
        for k in 0..n {
            add_scaled(&mut sum, out.eta[k], &out.f_blocks[9 * k..9 * k + 9]);
            add_scaled(&mut x, out.eta[k], &body.n_blocks[9 * k..9 * k + 9]);
        }
        out.inertia_kg_m2 = body.inertia_kg_m2
            + Matrix3::from_column_slice(&sum)
            + Matrix3::from_column_slice(&x).transpose();
    }
}

widest! {
    #[allow(clippy::needless_range_loop, reason = "many lists share the mode's number")]
    fn add_inertia_and_elastic(body: &FloatingFrame, motion: &BodyMotion, frame: &mut [f64], modal: &mut [f64]) {
        let w = &motion.omega_rad_per_s;
        let wd = &motion.alpha_rad_per_s2;
        let s = &motion.moment_kg_m;
        let a_local = motion.rotation.tr_mul(&motion.acceleration_m_per_s2);
        let (mut s_rate, mut s_acceleration) = (Vector3::zeros(), Vector3::zeros());
        let (mut theta_rate, mut r_eta) = ([0.0; 9], Vector3::zeros());
        for k in 0..body.mode_count() {
            let (rate, acceleration) = (motion.eta_rate[k], motion.eta_acceleration[k]);
            s_rate += body.c_pt[k] * rate;
            s_acceleration += body.c_pt[k] * acceleration;
            let block = &motion.f_blocks[9 * k..9 * k + 9];
            add_scaled(&mut theta_rate, rate, block);
            let r_k = Vector3::from_column_slice(&motion.r_columns[3 * k..3 * k + 3]);
            r_eta += r_k * acceleration;
            let c_k = Vector3::from_column_slice(&motion.coriolis[3 * k..3 * k + 3]);
            modal[k] += body.c_pt[k].dot(&a_local) - r_k.dot(wd) + acceleration
                - quadratic_form(block, w)
                - 2.0 * c_k.dot(w)
                + body.stiffness[k] * motion.eta[k]
                + body.damping[k] * rate;
        }
        let local = wd.cross(s) + w.cross(&w.cross(s)) + 2.0 * w.cross(&s_rate) + s_acceleration;
        let force = body.mass_kg * motion.acceleration_m_per_s2 + motion.rotation * local;
        let moment = s.cross(&a_local) + motion.inertia_kg_m2 * wd - r_eta
            + w.cross(&(motion.inertia_kg_m2 * w))
            + 2.0 * (Matrix3::from_column_slice(&theta_rate) * w);
        add_vector(&mut frame[..3], &force);
        add_vector(&mut frame[3..6], &moment);
    }
}

/// `out += Σ_m factors[m] · rows[m]`, in this order; a row is as long as `out`.
#[allow(
    clippy::inline_always,
    reason = "part of a function that enables wide instructions"
)]
#[inline(always)]
fn add_combination(out: &mut [f64], factors: &[f64], rows: &[f64]) {
    // Sums stay in registers: enough of them at once that none waits for the one before.
    let first = add_pieces::<48>(out, 0, factors, rows);
    let first = add_pieces::<8>(out, first, factors, rows);
    add_pieces::<1>(out, first, factors, rows);
}

/// The same for whole pieces of `WIDTH` values from `first` on; returns where they end.
#[allow(
    clippy::inline_always,
    reason = "part of a function that enables wide instructions"
)]
#[inline(always)]
fn add_pieces<const WIDTH: usize>(out: &mut [f64], mut first: usize, factors: &[f64], rows: &[f64]) -> usize {
    let length = out.len();
    while first + WIDTH <= length {
        let mut sums = [0.0; WIDTH];
        sums.copy_from_slice(&out[first..first + WIDTH]);
        for (factor, row) in factors.iter().zip(rows.chunks_exact(length)) {
            for (sum, x) in sums.iter_mut().zip(&row[first..first + WIDTH]) {
                *sum += factor * x;
            }
        }
        out[first..first + WIDTH].copy_from_slice(&sums);
        first += WIDTH;
    }
    first
}

/// `V` with `Vᵀ M V = 1` and `Vᵀ K V = diag(ω²)`, ascending, and `ω²`.
fn generalised_modes(body: &ReducedBody) -> Result<(DMatrix<f64>, Vec<f64>), BodyError> {
    let n = body.mode_count();
    let symmetric = |m: &DMatrix<f64>| 0.5 * (m + m.transpose());
    let cholesky =
        symmetric(&body.mass_modal)
            .cholesky()
            .ok_or_else(|| BodyError::MassNotPositiveDefinite {
                body: body.name.clone(),
            })?;
    let lower = cholesky.l();
    let not_positive = || BodyError::MassNotPositiveDefinite {
        body: body.name.clone(),
    };
    let half = lower
        .solve_lower_triangular(&symmetric(&body.stiffness_modal))
        .ok_or_else(not_positive)?;
    let standard = lower
        .solve_lower_triangular(&half.transpose())
        .ok_or_else(not_positive)?;
    let eigen = SymmetricEigen::new(symmetric(&standard));
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&i, &j| eigen.eigenvalues[i].total_cmp(&eigen.eigenvalues[j]));
    let sorted = DMatrix::from_fn(n, n, |i, j| eigen.eigenvectors[(i, order[j])]);
    let basis = lower
        .transpose()
        .solve_upper_triangular(&sorted)
        .ok_or_else(not_positive)?;
    let stiffness: Vec<f64> = order.iter().map(|&i| eigen.eigenvalues[i]).collect();
    if let Some(mode) = stiffness.iter().position(|&k| !(k.is_finite() && k > 0.0)) {
        return Err(BodyError::StiffnessNotPositive {
            body: body.name.clone(),
            mode,
            stiffness: stiffness[mode],
        });
    }
    Ok((basis, stiffness))
}

/// `out += factor · x`.
#[inline]
pub(crate) fn add_scaled(out: &mut [f64], factor: f64, x: &[f64]) {
    for (o, x) in out.iter_mut().zip(x) {
        *o += factor * x;
    }
}

/// `out += x`.
#[inline]
pub(crate) fn add_vector(out: &mut [f64], x: &Vector3<f64>) {
    out[0] += x.x;
    out[1] += x.y;
    out[2] += x.z;
}

/// `wᵀ B w` of a block stored column by column.
#[inline]
fn quadratic_form(block: &[f64], w: &Vector3<f64>) -> f64 {
    w.x * (block[0] * w.x + block[1] * w.y + block[2] * w.z)
        + w.y * (block[3] * w.x + block[4] * w.y + block[5] * w.z)
        + w.z * (block[6] * w.x + block[7] * w.y + block[8] * w.z)
}
