//! Structural damping of the modal coordinates.

use nalgebra::DMatrix;

/// Damping law of a flexible body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Damping {
    /// `D = a M + b K`.
    Rayleigh {
        /// a, 1/s.
        mass_factor_per_s: f64,
        /// b, s.
        stiffness_factor_s: f64,
    },
    /// Ratio ξ in every generalised mode of the reduced body.
    Modal {
        /// ξ.
        ratio: f64,
    },
}

impl Damping {
    /// Damping matrix from the reduced mass and stiffness.
    ///
    /// ```text
    /// modal: D = M Φ diag(2 ξ ω) Φᵀ M     with K Φ = M Φ diag(ω²), Φᵀ M Φ = I
    /// ```
    #[must_use]
    pub fn matrix(&self, mass: &DMatrix<f64>, stiffness: &DMatrix<f64>) -> DMatrix<f64> {
        match *self {
            Self::Rayleigh {
                mass_factor_per_s: a,
                stiffness_factor_s: b,
            } => mass * a + stiffness * b,
            Self::Modal { ratio } => {
                // a singular reduced mass cannot come from a basis of independent modes
                let Some(cholesky) = mass.clone().cholesky() else {
                    return DMatrix::zeros(mass.nrows(), mass.ncols());
                };
                let l = cholesky.l();
                // C = L⁻¹ K L⁻ᵀ = V ω² Vᵀ and Φ = L⁻ᵀ V, so M Φ = L V
                let half = l.solve_lower_triangular(stiffness).unwrap_or_default();
                let c = l.solve_lower_triangular(&half.transpose()).unwrap_or_default();
                let eigen = ((&c + c.transpose()) * 0.5).symmetric_eigen();
                let lv = l * eigen.eigenvectors;
                let scale = eigen.eigenvalues.map(|w2| 2.0 * ratio * w2.max(0.0).sqrt());
                &lv * DMatrix::from_diagonal(&scale) * lv.transpose()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modal_damping_gives_every_mode_its_ratio() {
        let mass = DMatrix::from_row_slice(2, 2, &[3.0, 1.0, 1.0, 2.0]);
        let stiffness = DMatrix::from_row_slice(2, 2, &[500.0, -200.0, -200.0, 300.0]);
        let d = Damping::Modal { ratio: 0.02 }.matrix(&mass, &stiffness);
        // D M⁻¹ D = (2 ξ)² K for a constant ratio
        let inverse = mass.clone().try_inverse().unwrap();
        let difference = &d * inverse * &d - &stiffness * (0.04_f64 * 0.04);
        assert!(difference.amax() < 1e-12 * stiffness.amax());
    }
}
