//! Strain and stress at nodes.

use super::element::{Tet4, Tet10, Tetrahedron};
use super::material::Material;
use super::mesh::{Elements, Mesh};
use nalgebra::{DMatrix, Vector3};

/// Strain at a node per column of nodal displacements: 6 × k, rows xx, yy, zz, yz, xz, xy with
/// engineering shear.
///
/// C3D4: plain average of the constant strains of the attached elements, as the published models
/// have it. C3D10: strain of each attached element at the node itself, averaged by volume.
/// `displacements_m` has 3·nodes rows.
#[must_use]
pub fn nodal_strain_map(mesh: &Mesh, node: u32, displacements_m: &DMatrix<f64>) -> DMatrix<f64> {
    match mesh.elements() {
        Elements::Tet4(elements) => average::<4, Tet4>(mesh, elements, node, displacements_m, |_| 1.0),
        Elements::Tet10(elements) => {
            average::<10, Tet10>(mesh, elements, node, displacements_m, Tet10::volume)
        }
    }
}

fn average<const N: usize, E: Tetrahedron<N>>(
    mesh: &Mesh,
    elements: &[[u32; N]],
    node: u32,
    displacements_m: &DMatrix<f64>,
    weight: impl Fn(&[Vector3<f64>; N]) -> f64,
) -> DMatrix<f64> {
    let mut strain = DMatrix::zeros(6, displacements_m.ncols());
    let mut total = 0.0;
    for element in elements {
        let Some(local) = element.iter().position(|n| *n == node) else {
            continue;
        };
        let x = mesh.corners(element);
        let Some((gradients, _)) = E::gradients(&x, E::NODES[local]) else {
            continue;
        };
        let weight = weight(&x);
        total += weight;
        for (mode, displacement) in displacements_m.column_iter().enumerate() {
            let mut column = strain.column_mut(mode);
            for (n, g) in element.iter().zip(&gradients) {
                let u = displacement.fixed_rows::<3>(3 * *n as usize);
                column[0] += weight * g.x * u[0];
                column[1] += weight * g.y * u[1];
                column[2] += weight * g.z * u[2];
                column[3] += weight * (g.y * u[2] + g.z * u[1]);
                column[4] += weight * (g.x * u[2] + g.z * u[0]);
                column[5] += weight * (g.x * u[1] + g.y * u[0]);
            }
        }
    }
    strain / total
}

/// Hooke's law on columns of strain (6 × k, engineering shear): stress in Pa, same order.
///
/// ```text
/// σ_xx = 2 μ ε_xx + λ (ε_xx + ε_yy + ε_zz),   τ_xy = μ γ_xy
/// ```
#[must_use]
pub fn stress_from_strain(material: &Material, strain: &DMatrix<f64>) -> DMatrix<f64> {
    let (lambda, mu) = (material.lame_lambda_pa(), material.shear_modulus_pa());
    DMatrix::from_fn(6, strain.ncols(), |row, column| {
        let e = strain.column(column);
        if row < 3 {
            2.0 * mu * e[row] + lambda * (e[0] + e[1] + e[2])
        } else {
            mu * e[row]
        }
    })
}
