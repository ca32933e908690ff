//! The small generalised eigenproblem K φ = w² M φ, by Cholesky and Jacobi rotations.
//!
//! Only operations that IEEE 754 rounds correctly are used, in a fixed order, so that the modes of a
//! run do not depend on the machine that computes them.

use nalgebra::{DMatrix, DVector};

/// Eigenvalues in ascending order and the M-orthonormal vectors as columns: Φᵀ M Φ = I,
/// Φᵀ K Φ = diag(w²). `None` if M is not positive definite or a number is not finite.
pub(super) fn generalised(
    stiffness: &DMatrix<f64>,
    mass: &DMatrix<f64>,
) -> Option<(DVector<f64>, DMatrix<f64>)> {
    let n = mass.nrows();
    let lower = cholesky(mass)?;
    // A = L⁻¹ K L⁻ᵀ
    let mut a = stiffness.clone();
    solve_lower(&lower, &mut a);
    a.transpose_mut();
    solve_lower(&lower, &mut a);
    let mut vectors = DMatrix::identity(n, n);
    jacobi(&mut a, &mut vectors)?;
    // Φ = L⁻ᵀ V
    for column in 0..n {
        for i in (0..n).rev() {
            let mut sum = vectors[(i, column)];
            for k in i + 1..n {
                sum -= lower[(k, i)] * vectors[(k, column)];
            }
            vectors[(i, column)] = sum / lower[(i, i)];
        }
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&i, &j| a[(i, i)].total_cmp(&a[(j, j)]));
    let values = DVector::from_iterator(n, order.iter().map(|&i| a[(i, i)]));
    let sorted = DMatrix::from_fn(n, n, |i, j| vectors[(i, order[j])]);
    Some((values, sorted))
}

fn cholesky(m: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let n = m.nrows();
    let mut l = DMatrix::zeros(n, n);
    for j in 0..n {
        for i in j..n {
            let mut sum = 0.5 * (m[(i, j)] + m[(j, i)]);
            for k in 0..j {
                sum -= l[(i, k)] * l[(j, k)];
            }
            if i == j {
                if !(sum > 0.0 && sum.is_finite()) {
                    return None;
                }
                l[(j, j)] = sum.sqrt();
            } else {
                l[(i, j)] = sum / l[(j, j)];
            }
        }
    }
    Some(l)
}

/// B ← L⁻¹ B.
fn solve_lower(lower: &DMatrix<f64>, b: &mut DMatrix<f64>) {
    let n = lower.nrows();
    for column in 0..b.ncols() {
        for i in 0..n {
            let mut sum = b[(i, column)];
            for k in 0..i {
                sum -= lower[(i, k)] * b[(k, column)];
            }
            b[(i, column)] = sum / lower[(i, i)];
        }
    }
}

/// Cyclic Jacobi: leaves the eigenvalues on the diagonal of `a` and rotates `v` along.
fn jacobi(a: &mut DMatrix<f64>, v: &mut DMatrix<f64>) -> Option<()> {
    const SWEEPS: usize = 40;
    let n = a.nrows();
    for i in 0..n {
        for j in 0..i {
            let mean = 0.5 * (a[(i, j)] + a[(j, i)]);
            a[(i, j)] = mean;
            a[(j, i)] = mean;
        }
    }
    for _ in 0..SWEEPS {
        let mut rotated = false;
        for p in 0..n {
            for q in p + 1..n {
                let apq = a[(p, q)];
                // Relative criterion: small eigenvalues of a stiff matrix keep their digits.
                let size = (a[(p, p)] * a[(q, q)]).abs().sqrt();
                if !apq.is_finite() {
                    return None;
                }
                if apq.abs() <= 1e-16 * size || apq.abs() < f64::MIN_POSITIVE {
                    continue;
                }
                rotated = true;
                let tau = (a[(q, q)] - a[(p, p)]) / (2.0 * apq);
                let t = 1.0_f64.copysign(tau) / (tau.abs() + (1.0 + tau * tau).sqrt());
                let c = 1.0 / (1.0 + t * t).sqrt();
                let s = t * c;
                for k in 0..n {
                    let (akp, akq) = (a[(k, p)], a[(k, q)]);
                    a[(k, p)] = c * akp - s * akq;
                    a[(k, q)] = s * akp + c * akq;
                }
                for k in 0..n {
                    let (apk, aqk) = (a[(p, k)], a[(q, k)]);
                    a[(p, k)] = c * apk - s * aqk;
                    a[(q, k)] = s * apk + c * aqk;
                }
                for k in 0..n {
                    let (vkp, vkq) = (v[(k, p)], v[(k, q)]);
                    v[(k, p)] = c * vkp - s * vkq;
                    v[(k, q)] = s * vkp + c * vkq;
                }
            }
        }
        if !rotated {
            return Some(());
        }
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn diagonalises_both_matrices() {
        let n = 14;
        let base = DMatrix::from_fn(n, n, |i, j| libm::sin((3 * i + 5 * j + i * j) as f64 * 0.7));
        let mass = &base * base.transpose() + DMatrix::identity(n, n);
        let scale = DMatrix::from_fn(n, n, |i, j| if i == j { 10f64.powi(i as i32 / 2) } else { 0.0 });
        let other = DMatrix::from_fn(n, n, |i, j| libm::cos((i + 2 * j) as f64 * 1.3));
        let stiffness = &scale * (&other * other.transpose() + DMatrix::identity(n, n)) * &scale;
        let (values, phi) = generalised(&stiffness, &mass).unwrap();
        let unit = phi.transpose() * &mass * &phi - DMatrix::identity(n, n);
        assert!(unit.amax() < 1e-12, "{}", unit.amax());
        let diagonal = phi.transpose() * &stiffness * &phi;
        for i in 0..n {
            for j in 0..n {
                let expected = if i == j { values[i] } else { 0.0 };
                let size = (values[i] * values[j]).sqrt();
                assert!((diagonal[(i, j)] - expected).abs() < 1e-9 * size, "{i} {j}");
            }
            assert!(i == 0 || values[i] >= values[i - 1]);
        }
    }

    #[test]
    fn refuses_an_indefinite_mass() {
        let mut mass = DMatrix::identity(2, 2);
        mass[(1, 1)] = -1.0;
        assert!(generalised(&DMatrix::identity(2, 2), &mass).is_none());
    }
}
