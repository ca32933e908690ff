//! The part of a reduced body that moves in the plane of its joints.
//!
//! A revolute joint lets its two interfaces turn about Z and nothing else. The boundary interfaces' motions out
//! of the plane are left out exactly (their coordinates are in the basis); of the normal modes those that
//! neither a weight, an inertia nor a motion of the plane excites.

use nalgebra::{DMatrix, Matrix3, Matrix3xX, Vector3};

use crate::reduction::{ReducedBody, ReducedInterface, ReducedNode};

/// Largest in-plane coupling of a normal mode that is left out, relative to what couples fully. What it would
/// add to the motion in the plane is of the order of its square.
const COUPLING_LEAST: f64 = 1e-2;

/// How far a body may be from symmetric about the plane: coupling of motions across it with motions in it, relative to
/// full coupling. On the published meshes it is up to 0.9, and strains at their sides miss up to 2 % without it.
const ASYMMETRY_MOST: f64 = 1e-6;

/// The body with the modes that move in the plane, or the coupling that makes it more than a plane's.
pub(super) fn in_plane(body: &ReducedBody) -> Result<ReducedBody, f64> {
    let n = body.mode_count();
    let mut forbidden: Vec<Vec<f64>> = Vec::new();
    let boundaries = || {
        body.interfaces
            .iter()
            .filter(|i| body.report.boundary_names.contains(&i.name))
    };
    for interface in boundaries() {
        let (t, r) = (&interface.translation, &interface.rotation);
        for row in [t.row(2), r.row(0), r.row(1)] {
            // Unit motions of an interface are of order one: this is their rounding.
            if row.amax() > 1e-9 {
                forbidden.push(row.iter().copied().collect());
            }
        }
    }
    let touched: Vec<bool> = (0..n)
        .map(|k| forbidden.iter().any(|row| row[k].abs() > 1e-9))
        .collect();
    let moves_boundary: Vec<bool> = (0..n)
        .map(|k| {
            boundaries().any(|i| i.translation.column(k).amax() > 1e-9 || i.rotation.column(k).amax() > 1e-9)
        })
        .collect();
    let mut columns: Vec<Vec<f64>> = Vec::new();
    let unit = |k: usize| {
        (0..n)
            .map(|i| if i == k { 1.0 } else { 0.0 })
            .collect::<Vec<f64>>()
    };
    let mixed: Vec<usize> = (0..n).filter(|&k| touched[k]).collect();
    columns.extend((0..n).filter(|&k| moves_boundary[k] && !touched[k]).map(unit));
    columns.extend(null_space(&forbidden, &mixed, n));
    let boundary_count = columns.len();
    let basis = |columns: &[Vec<f64>]| DMatrix::from_fn(n, columns.len(), |i, j| columns[j][i]);
    let moving = basis(&columns[..boundary_count]);
    let mut left_out = 0.0_f64;
    for k in (0..n).filter(|&k| !moves_boundary[k]) {
        let coupled = coupling(body, &moving, k);
        if coupled > COUPLING_LEAST {
            columns.push(unit(k));
        } else {
            left_out = left_out.max(coupled);
        }
    }
    let kept = basis(&columns);
    for &k in &mixed {
        left_out = left_out.max(across(body, &kept, k));
    }
    if left_out > ASYMMETRY_MOST {
        return Err(left_out);
    }
    Ok(project(body, &kept))
}

/// Largest coupling of a boundary motion across the plane with the motions that are kept.
fn across(body: &ReducedBody, kept: &DMatrix<f64>, mode: usize) -> f64 {
    let share = |matrix: &DMatrix<f64>| {
        let own = matrix[(mode, mode)];
        (0..kept.ncols())
            .map(|j| {
                let column = kept.column(j);
                let other = column.dot(&(matrix * column));
                (matrix.row(mode) * column)[(0, 0)].abs() / (own * other).sqrt()
            })
            .fold(0.0, f64::max)
    };
    share(&body.mass_modal).max(share(&body.stiffness_modal))
}

/// Largest coupling of a normal mode with motion and forces in the plane, relative to full coupling.
fn coupling(body: &ReducedBody, moving: &DMatrix<f64>, mode: usize) -> f64 {
    let norm = body.mass_modal[(mode, mode)].sqrt();
    let weight = libm::hypot(body.c_pt[(0, mode)], body.c_pt[(1, mode)]) / (norm * body.mass_kg.sqrt());
    let turn = body.c_xp[(2, mode)].abs() / (norm * body.inertia_origin_kg_m2[(2, 2)].sqrt());
    let with_boundary = (0..moving.ncols())
        .map(|j| {
            let column = moving.column(j);
            let own = column.dot(&(&body.mass_modal * column)).sqrt();
            (body.mass_modal.row(mode) * column)[(0, 0)].abs() / (norm * own)
        })
        .fold(0.0, f64::max);
    // Interfaces beside the basis' boundaries, such as a cylinder's eye on a rib: what they feel of this mode,
    // relative to the mode that moves them most.
    let beside = body
        .interfaces
        .iter()
        .filter(|i| !body.report.boundary_names.contains(&i.name))
        .map(|i| {
            let size = |k: usize| {
                libm::hypot(i.translation[(0, k)], i.translation[(1, k)])
                    / body.stiffness_modal[(k, k)].sqrt()
            };
            let most = (0..body.mode_count()).map(size).fold(f64::MIN_POSITIVE, f64::max);
            size(mode) / most
        })
        .fold(0.0, f64::max);
    weight.max(turn).max(with_boundary).max(beside)
}

/// Orthonormal combinations of the columns `among` that all rows forbid nothing of.
fn null_space(rows: &[Vec<f64>], among: &[usize], n: usize) -> Vec<Vec<f64>> {
    let m = among.len();
    if m == 0 {
        return Vec::new();
    }
    // Padded to a square matrix, so that the decomposition has all right vectors.
    let size = m.max(rows.len());
    let matrix = DMatrix::from_fn(size, m, |i, j| rows.get(i).map_or(0.0, |row| row[among[j]]));
    let gram = matrix.transpose() * &matrix;
    let eigen = gram.symmetric_eigen();
    let largest = eigen.eigenvalues.amax().max(f64::MIN_POSITIVE);
    (0..m)
        // Squares of singular values: rows are unit motions or absent.
        .filter(|&k| eigen.eigenvalues[k] <= 1e-12 * largest)
        .map(|k| {
            let mut column = vec![0.0; n];
            for (j, &place) in among.iter().enumerate() {
                column[place] = eigen.eigenvectors[(j, k)];
            }
            column
        })
        .collect()
}

/// The body in the basis `ζ = basis · ζ'`.
fn project(body: &ReducedBody, basis: &DMatrix<f64>) -> ReducedBody {
    let (n, k) = (body.mode_count(), basis.ncols());
    let both = |m: &DMatrix<f64>| basis.transpose() * m * basis;
    let three = |m: &Matrix3xX<f64>| m * basis;
    let pairs = |i: usize, j: usize| {
        (0..n)
            .flat_map(move |p| (0..n).map(move |q| (p, q)))
            .map(move |(p, q)| (p * n + q, basis[(p, i)] * basis[(q, j)]))
            .filter(|(_, weight)| *weight != 0.0)
    };
    ReducedBody {
        name: body.name.clone(),
        mass_kg: body.mass_kg,
        centre_of_mass_m: body.centre_of_mass_m,
        inertia_origin_kg_m2: body.inertia_origin_kg_m2,
        mass_modal: both(&body.mass_modal),
        stiffness_modal: both(&body.stiffness_modal),
        damping_modal: both(&body.damping_modal),
        c_pt: three(&body.c_pt),
        c_xp: three(&body.c_xp),
        n_blocks: (0..k)
            .map(|j| {
                (0..n)
                    .map(|p| body.n_blocks[p] * basis[(p, j)])
                    .sum::<Matrix3<f64>>()
            })
            .collect(),
        b_blocks: (0..k * k)
            .map(|ij| {
                pairs(ij / k, ij % k)
                    .map(|(at, w)| body.b_blocks[at] * w)
                    .sum::<Matrix3<f64>>()
            })
            .collect(),
        c_vectors: (0..k * k)
            .map(|ij| {
                pairs(ij / k, ij % k)
                    .map(|(at, w)| body.c_vectors[at] * w)
                    .sum::<Vector3<f64>>()
            })
            .collect(),
        interfaces: body
            .interfaces
            .iter()
            .map(|i| ReducedInterface {
                translation: three(&i.translation),
                rotation: three(&i.rotation),
                ..i.clone()
            })
            .collect(),
        sensor_nodes: body
            .sensor_nodes
            .iter()
            .map(|s| ReducedNode {
                translation: three(&s.translation),
                strain: &s.strain * basis,
                stress_pa: &s.stress_pa * basis,
                ..s.clone()
            })
            .collect(),
        report: body.report.clone(),
    }
}
