//! Isoparametric tetrahedra with 4 and 10 nodes, sizes known at compile time.
//!
//! Node order as in Abaqus (C3D4, C3D10): corners 1–4, then the midpoints of the edges
//! 1-2, 2-3, 3-1, 1-4, 2-4, 3-4. Positive volume when corner 4 lies on the side of the face
//! 1-2-3 to which its right-handed normal points.

use super::material::Material;
use super::quadrature::{FOUR_POINTS, FOURTEEN_POINTS, ONE_POINT, QuadraturePoint};
use nalgebra::{Matrix3, SMatrix, Vector3};

/// A tetrahedral element with `N` nodes.
pub trait Tetrahedron<const N: usize> {
    /// Name in an Abaqus file.
    const NAME: &'static str;
    /// Barycentric coordinates of the nodes.
    const NODES: [[f64; 4]; N];

    /// Shape functions at barycentric coordinates.
    fn shape(l: [f64; 4]) -> [f64; N];

    /// Derivatives of the shape functions with respect to the four barycentric coordinates, taken
    /// as independent.
    fn shape_derivatives(l: [f64; 4]) -> [[f64; 4]; N];

    /// Points for the stiffness.
    fn stiffness_points() -> &'static [QuadraturePoint];

    /// Points for the consistent mass.
    fn mass_points() -> &'static [QuadraturePoint];

    /// Jacobian `J = ∂x/∂(L₂, L₃, L₄)` with `L₁ = 1 − L₂ − L₃ − L₄`; columns are tangents.
    #[must_use]
    fn jacobian(x: &[Vector3<f64>; N], l: [f64; 4]) -> Matrix3<f64> {
        let derivatives = Self::shape_derivatives(l);
        let mut j = Matrix3::zeros();
        for (x, d) in x.iter().zip(derivatives) {
            for c in 0..3 {
                let slope = d[c + 1] - d[0];
                for r in 0..3 {
                    j[(r, c)] += slope * x[r];
                }
            }
        }
        j
    }

    /// Shape-function gradients in space, 1/m, and `det J` (six times the volume for straight
    /// edges), m³. `None` where the Jacobian is singular.
    #[must_use]
    fn gradients(x: &[Vector3<f64>; N], l: [f64; 4]) -> Option<([Vector3<f64>; N], f64)> {
        let j = Self::jacobian(x, l);
        let det = j.determinant();
        // adjugate over determinant keeps sliver elements as accurate as the determinant is
        let inverse_transposed = j.try_inverse()?.transpose();
        let derivatives = Self::shape_derivatives(l);
        let mut g = [Vector3::zeros(); N];
        for (g, d) in g.iter_mut().zip(derivatives) {
            *g = inverse_transposed * Vector3::new(d[1] - d[0], d[2] - d[0], d[3] - d[0]);
        }
        Some((g, det))
    }

    /// Smallest `det J` over the integration points and the nodes, m³: positive for a valid element.
    #[must_use]
    fn smallest_determinant(x: &[Vector3<f64>; N]) -> f64 {
        let at = |l: [f64; 4]| Self::jacobian(x, l).determinant();
        let points = Self::stiffness_points().iter().chain(Self::mass_points());
        points
            .map(|(l, _)| at(*l))
            .chain(Self::NODES.map(at))
            .fold(f64::INFINITY, |a, b| if b.is_nan() { b } else { a.min(b) })
    }

    /// Volume, m³.
    #[must_use]
    fn volume(x: &[Vector3<f64>; N]) -> f64 {
        Self::mass_points()
            .iter()
            .map(|(l, w)| w / 6.0 * Self::jacobian(x, *l).determinant())
            .sum()
    }

    /// Stiffness as 3 × 3 blocks per pair of nodes, N/m.
    ///
    /// ```text
    /// K_ab = ∫ λ g_a g_bᵀ + μ g_b g_aᵀ + μ (g_a · g_b) I dV
    /// ```
    ///
    /// `g_a` is the gradient of shape function a; λ, μ are Lamé's parameters.
    #[must_use]
    fn stiffness(x: &[Vector3<f64>; N], material: &Material) -> [[Matrix3<f64>; N]; N] {
        let (lambda, mu) = (material.lame_lambda_pa(), material.shear_modulus_pa());
        let mut k = [[Matrix3::zeros(); N]; N];
        for (l, weight) in Self::stiffness_points() {
            let Some((g, det)) = Self::gradients(x, *l) else {
                continue;
            };
            let volume = weight / 6.0 * det;
            for a in 0..N {
                for b in 0..N {
                    let outer = g[a] * g[b].transpose();
                    let block = outer * lambda
                        + outer.transpose() * mu
                        + Matrix3::from_diagonal_element(mu * g[a].dot(&g[b]));
                    k[a][b] += block * volume;
                }
            }
        }
        k
    }

    /// Consistent mass per pair of nodes, kg; the same for the three directions.
    #[must_use]
    fn consistent_mass(x: &[Vector3<f64>; N], material: &Material) -> SMatrix<f64, N, N> {
        let mut m = SMatrix::zeros();
        for (l, weight) in Self::mass_points() {
            let shape = SMatrix::<f64, N, 1>::from(Self::shape(*l));
            let mass = material.density_kg_per_m3 * weight / 6.0 * Self::jacobian(x, *l).determinant();
            m += shape * shape.transpose() * mass;
        }
        m
    }

    /// Lumped mass per node, kg.
    fn lumped_mass(x: &[Vector3<f64>; N], material: &Material) -> [f64; N];
}

/// Linear tetrahedron: constant strain.
#[derive(Debug, Clone, Copy)]
pub struct Tet4;

impl Tetrahedron<4> for Tet4 {
    const NAME: &'static str = "C3D4";
    const NODES: [[f64; 4]; 4] = [
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ];

    fn shape(l: [f64; 4]) -> [f64; 4] {
        l
    }

    fn shape_derivatives(_: [f64; 4]) -> [[f64; 4]; 4] {
        Self::NODES
    }

    fn stiffness_points() -> &'static [QuadraturePoint] {
        &ONE_POINT
    }

    fn mass_points() -> &'static [QuadraturePoint] {
        &FOUR_POINTS
    }

    /// A quarter of the element mass on each node.
    fn lumped_mass(x: &[Vector3<f64>; 4], material: &Material) -> [f64; 4] {
        [material.density_kg_per_m3 * Self::volume(x) / 4.0; 4]
    }
}

/// Quadratic tetrahedron: linear strain.
#[derive(Debug, Clone, Copy)]
pub struct Tet10;

/// Corners that an edge midpoint lies between, in the order of the midpoints.
pub(super) const EDGES: [[usize; 2]; 6] = [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]];

impl Tetrahedron<10> for Tet10 {
    const NAME: &'static str = "C3D10";
    const NODES: [[f64; 4]; 10] = [
        [1.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        [0.5, 0.5, 0.0, 0.0],
        [0.0, 0.5, 0.5, 0.0],
        [0.5, 0.0, 0.5, 0.0],
        [0.5, 0.0, 0.0, 0.5],
        [0.0, 0.5, 0.0, 0.5],
        [0.0, 0.0, 0.5, 0.5],
    ];

    fn shape(l: [f64; 4]) -> [f64; 10] {
        let mut n = [0.0; 10];
        for i in 0..4 {
            n[i] = l[i] * (2.0 * l[i] - 1.0);
        }
        for (n, [i, j]) in n[4..].iter_mut().zip(EDGES) {
            *n = 4.0 * l[i] * l[j];
        }
        n
    }

    fn shape_derivatives(l: [f64; 4]) -> [[f64; 4]; 10] {
        let mut d = [[0.0; 4]; 10];
        for i in 0..4 {
            d[i][i] = 4.0 * l[i] - 1.0;
        }
        for (d, [i, j]) in d[4..].iter_mut().zip(EDGES) {
            d[i] = 4.0 * l[j];
            d[j] = 4.0 * l[i];
        }
        d
    }

    fn stiffness_points() -> &'static [QuadraturePoint] {
        &FOUR_POINTS
    }

    fn mass_points() -> &'static [QuadraturePoint] {
        &FOURTEEN_POINTS
    }

    /// HRZ lumping (Hinton, Rock, Zienkiewicz 1976): the diagonal of the consistent mass, scaled to
    /// the element mass; row sums would be negative at the corners.
    fn lumped_mass(x: &[Vector3<f64>; 10], material: &Material) -> [f64; 10] {
        let consistent = Self::consistent_mass(x, material);
        let scale = consistent.sum() / consistent.trace();
        std::array::from_fn(|i| consistent[(i, i)] * scale)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEEL: Material = Material {
        youngs_modulus_pa: 2.1e11,
        poisson_ratio: 0.3,
        density_kg_per_m3: 7850.0,
    };

    fn corners() -> [Vector3<f64>; 4] {
        [
            Vector3::new(0.1, -0.2, 0.05),
            Vector3::new(0.35, -0.1, 0.0),
            Vector3::new(0.2, 0.15, 0.1),
            Vector3::new(0.15, 0.0, 0.4),
        ]
    }

    fn quadratic(corners: [Vector3<f64>; 4]) -> [Vector3<f64>; 10] {
        std::array::from_fn(|i| Tet10::NODES[i].iter().zip(&corners).map(|(l, x)| x * *l).sum())
    }

    /// Bends the edges a little, so that the Jacobian varies.
    fn curved() -> [Vector3<f64>; 10] {
        let mut x = quadratic(corners());
        for (i, x) in x.iter_mut().enumerate().skip(4) {
            let i = f64::from(u32::try_from(i).unwrap());
            *x += Vector3::new(libm::sin(3.0 * i), libm::cos(5.0 * i), libm::sin(7.0 * i)) * 0.004;
        }
        x
    }

    fn check_identities<const N: usize, E: Tetrahedron<N>>(x: &[Vector3<f64>; N]) {
        let l = [0.17, 0.31, 0.12, 0.4];
        assert!((E::shape(l).iter().sum::<f64>() - 1.0).abs() < 1e-15);
        for (i, node) in E::NODES.iter().enumerate() {
            for (j, n) in E::shape(*node).iter().enumerate() {
                assert!((n - f64::from(u8::from(i == j))).abs() < 1e-15);
            }
        }
        let (g, _) = E::gradients(x, l).unwrap();
        assert!(g.iter().sum::<Vector3<f64>>().norm() < 1e-13);
        // Σ x_a g_aᵀ = I: linear fields are reproduced
        let identity: Matrix3<f64> = x.iter().zip(&g).map(|(x, g)| x * g.transpose()).sum();
        assert!((identity - Matrix3::identity()).norm() < 1e-13);

        let k = E::stiffness(x, &STEEL);
        let scale = k[0][0].norm();
        let w = Vector3::new(0.3, -0.5, 0.2);
        for (a, row) in k.iter().enumerate() {
            let shift: Matrix3<f64> = row.iter().sum();
            let turn: Vector3<f64> = row.iter().zip(x).map(|(k, x)| k * w.cross(x)).sum();
            assert!(shift.norm() < 1e-13 * scale && turn.norm() < 1e-13 * scale);
            for (b, k_ab) in row.iter().enumerate() {
                assert!((k_ab - k[b][a].transpose()).norm() < 1e-14 * scale);
            }
        }
        let mass = STEEL.density_kg_per_m3 * E::volume(x);
        assert!((E::consistent_mass(x, &STEEL).sum() / mass - 1.0).abs() < 1e-14);
        assert!((E::lumped_mass(x, &STEEL).iter().sum::<f64>() / mass - 1.0).abs() < 1e-14);
        assert!(E::lumped_mass(x, &STEEL).iter().all(|m| *m > 0.0));
        assert!(E::smallest_determinant(x) > 0.0);
    }

    #[test]
    fn shape_functions_stiffness_and_mass_satisfy_their_identities() {
        check_identities::<4, Tet4>(&corners());
        check_identities::<10, Tet10>(&quadratic(corners()));
        check_identities::<10, Tet10>(&curved());
    }

    #[test]
    fn mass_of_a_straight_linear_element_has_the_closed_form() {
        let mass = STEEL.density_kg_per_m3 * Tet4::volume(&corners());
        let m = Tet4::consistent_mass(&corners(), &STEEL);
        for a in 0..4 {
            for b in 0..4 {
                let exact = mass / if a == b { 10.0 } else { 20.0 };
                assert!((m[(a, b)] / exact - 1.0).abs() < 1e-14);
            }
        }
    }

    #[test]
    fn energy_of_a_uniform_strain_is_exact_for_both_elements() {
        // u = H x with symmetric H; energy density μ H:H + λ/2 tr(H)²
        let h = Matrix3::new(1.0, 0.4, -0.2, 0.4, -0.7, 0.1, -0.2, 0.1, 0.5) * 1e-4;
        let density = STEEL.shear_modulus_pa() * h.norm_squared()
            + 0.5 * STEEL.lame_lambda_pa() * (h.trace() * h.trace());
        let energy = |x: &[Vector3<f64>], k: &dyn Fn(usize, usize) -> Matrix3<f64>| {
            let n = x.len();
            (0..n * n)
                .map(|i| (h * x[i / n]).dot(&(k(i / n, i % n) * h * x[i % n])))
                .sum::<f64>()
                / 2.0
        };
        let x = corners();
        let k = Tet4::stiffness(&x, &STEEL);
        let exact = density * Tet4::volume(&x);
        assert!((energy(&x, &|a, b| k[a][b]) / exact - 1.0).abs() < 1e-12);
        let x = quadratic(corners());
        let k = Tet10::stiffness(&x, &STEEL);
        assert!((energy(&x, &|a, b| k[a][b]) / exact - 1.0).abs() < 1e-12);
    }

    #[test]
    fn an_inverted_element_has_a_negative_determinant() {
        let mut x = corners();
        x.swap(0, 1);
        assert!(Tet4::smallest_determinant(&x) < 0.0);
        let mut x = quadratic(corners());
        x[4] = x[0] * 0.9 + x[1] * 0.1; // midpoint beyond the quarter point folds the element
        assert!(Tet10::smallest_determinant(&x) < 0.0);
    }
}
