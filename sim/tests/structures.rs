//! Finite elements and reduction on structures with known answers: a steel block of 1 m × 0.1 m ×
//! 0.05 m, meshed here, read through the Abaqus reader.
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use hydroflex_sim::fe::{
    InterfaceNodes, MassKind, Material, Mesh, Surface, assemble_mass, assemble_stiffness, nodal_strain_map,
    read_abaqus, stress_from_strain, uniform_weights,
};
use hydroflex_sim::reduction::{
    Damping, FlexibleModel, ReducedBody, ReductionError, clamped_hz, free_free_hz, mode_basis, reduce,
};
use nalgebra::{DMatrix, Matrix3, Vector3};
use std::f64::consts::PI;

mod block;
use block::{SIZE_M, block_text};

const STEEL: Material = Material {
    youngs_modulus_pa: 2.1e11,
    poisson_ratio: 0.3,
    density_kg_per_m3: 7850.0,
};

fn block(cells: [usize; 3], quadratic: bool) -> Mesh {
    read_abaqus(&block_text(cells, quadratic)).unwrap()
}

fn interface(mesh: &Mesh, name: &str) -> InterfaceNodes {
    let nodes = mesh.node_set(name).unwrap().to_vec();
    InterfaceNodes {
        name: name.to_owned(),
        weights: uniform_weights(nodes.len()),
        nodes,
    }
}

fn nodal(mesh: &Mesh, f: impl Fn(&Vector3<f64>) -> Vector3<f64>) -> DMatrix<f64> {
    DMatrix::from_iterator(
        3 * mesh.node_count(),
        1,
        mesh.nodes_m()
            .iter()
            .flat_map(|x| f(x).iter().copied().collect::<Vec<_>>()),
    )
}

#[test]
fn volume_surface_mass_and_inertia_of_a_block_are_exact() {
    let [a, b, c] = SIZE_M;
    let mass_kg = STEEL.density_kg_per_m3 * a * b * c;
    for quadratic in [false, true] {
        let mesh = block([6, 2, 1], quadratic);
        assert!((mesh.volume_m3() / (a * b * c) - 1.0).abs() < 1e-13);
        let area = Surface::of(&mesh).area_m2(&mesh);
        assert!((area / (2.0 * (a * b + b * c + c * a)) - 1.0).abs() < 1e-13);
        let m = assemble_mass(&mesh, &STEEL, MassKind::Consistent);
        assert!((m.total_kg() / mass_kg - 1.0).abs() < 1e-13);
        // ρ ∫ x² = m a²/3 about the corner: linear fields are in the span of both elements
        let x = nodal(&mesh, |x| Vector3::new(x.x, 0.0, 0.0));
        let moment = x.dot(&m.multiply(&x));
        assert!((moment / (mass_kg * a * a / 3.0) - 1.0).abs() < 1e-12);
    }
}

#[test]
fn a_uniform_strain_is_recovered_exactly_and_needs_no_force_inside() {
    let h = Matrix3::new(1.0, 0.4, -0.2, 0.1, -0.7, 0.3, 0.5, 0.2, 0.6) * 1e-4;
    for quadratic in [false, true] {
        let mesh = block([4, 2, 2], quadratic);
        let u = nodal(&mesh, |x| h * x);
        let force = assemble_stiffness(&mesh, &STEEL).multiply(&u);
        let surface = Surface::of(&mesh).nodes();
        let inside = |node: &u32| surface.binary_search(node).is_err();
        let mut count = 0;
        for node in (0..u32::try_from(mesh.node_count()).unwrap()).filter(inside) {
            count += 1;
            assert!(force.rows(3 * node as usize, 3).amax() < 1e-12 * force.amax());
        }
        assert!(count > 0);
        let strain = nodal_strain_map(&mesh, 5, &u);
        let exact = [
            h[(0, 0)],
            h[(1, 1)],
            h[(2, 2)],
            h[(1, 2)] + h[(2, 1)],
            h[(0, 2)] + h[(2, 0)],
            h[(0, 1)] + h[(1, 0)],
        ];
        for (found, exact) in strain.iter().zip(exact) {
            assert!((found - exact).abs() < 1e-16);
        }
        // uniaxial part of Hooke's law: σ = E ε for ε = (1, −ν, −ν)
        let nu = STEEL.poisson_ratio;
        let uniaxial = DMatrix::from_column_slice(6, 1, &[1.0, -nu, -nu, 0.0, 0.0, 0.0]);
        let stress = stress_from_strain(&STEEL, &uniaxial);
        assert!((stress[0] / STEEL.youngs_modulus_pa - 1.0).abs() < 1e-12);
        assert!(stress.rows(1, 5).amax() < 1e-4);
    }
}

/// First bending frequency of a Timoshenko cantilever in the plane of height h, Hz, by the
/// Southwell-Dunkerley combination of bending and shear; good to about 0.5 % at this slenderness.
fn cantilever_hz(height_m: f64) -> f64 {
    let (e, rho, l) = (STEEL.youngs_modulus_pa, STEEL.density_kg_per_m3, SIZE_M[0]);
    let radius_squared = height_m * height_m / 12.0;
    let bending = 1.875_104_f64.powi(2) / (2.0 * PI * l * l) * (e / rho * radius_squared).sqrt();
    let shear = (5.0 / 6.0 * STEEL.shear_modulus_pa() / rho).sqrt() / (4.0 * l);
    1.0 / (bending.powi(-2) + shear.powi(-2)).sqrt()
}

#[test]
fn a_cantilever_swings_as_beam_theory_says_and_linear_elements_are_stiffer() {
    let frequencies = |quadratic| {
        let mesh = block([12, 2, 1], quadratic);
        let k = assemble_stiffness(&mesh, &STEEL);
        let m = assemble_mass(&mesh, &STEEL, MassKind::Consistent);
        let mut is_fixed = vec![false; mesh.node_count()];
        for node in mesh.node_set("left").unwrap() {
            is_fixed[*node as usize] = true;
        }
        clamped_hz(&k, &m, &is_fixed, 2).unwrap()
    };
    let quadratic = frequencies(true);
    for (found, height) in quadratic.iter().zip([SIZE_M[2], SIZE_M[1]]) {
        // the clamped face also suppresses Poisson's contraction: about 1 % stiffer
        let ratio = found / cantilever_hz(height);
        assert!((0.995..1.02).contains(&ratio), "{ratio}");
    }
    let linear = frequencies(false);
    assert!(linear[0] > 1.3 * quadratic[0], "linear elements lock in bending");
}

#[test]
fn a_free_block_has_its_six_rigid_motions_and_no_more() {
    let mesh = block([6, 1, 1], true);
    let k = assemble_stiffness(&mesh, &STEEL);
    for kind in [MassKind::Consistent, MassKind::Lumped] {
        let m = assemble_mass(&mesh, &STEEL, kind);
        let elastic = free_free_hz(&k, &m, 100.0, 2).unwrap();
        assert_eq!(elastic.len(), 2, "six motions without strain");
        // free-free bar: (4.730/1.875)² times the cantilever, less some shear
        let ratio = elastic[0] / (cantilever_hz(SIZE_M[2]) * (4.730_041_f64 / 1.875_104).powi(2));
        assert!((0.97..1.03).contains(&ratio), "{kind:?} {ratio}");
    }
}

fn reduced(mesh: &Mesh, normal_modes: usize, interfaces: &[InterfaceNodes]) -> ReducedBody {
    reduce(&model(mesh, normal_modes, interfaces)).unwrap()
}

fn model<'a>(mesh: &'a Mesh, normal_modes: usize, interfaces: &'a [InterfaceNodes]) -> FlexibleModel<'a> {
    FlexibleModel {
        name: "block",
        mesh,
        matrices: None,
        material: STEEL,
        mass_kind: MassKind::Consistent,
        normal_modes,
        damping: Damping::Modal { ratio: 0.01 },
        interfaces,
        boundary: (0..interfaces.len()).collect(),
        sensor_nodes: &[],
    }
}

#[test]
fn static_modes_carry_interface_loads_exactly() {
    let mesh = block([10, 2, 1], true);
    let interfaces = [interface(&mesh, "left"), interface(&mesh, "right")];
    let body = reduced(&mesh, 0, &interfaces);
    // 1 kN down at the right face: reduced compliance against beam theory
    let mut load = nalgebra::DVector::zeros(6);
    load[1] = -1000.0;
    let bent = body.stiffness_modal.clone().cholesky().unwrap().solve(&load);
    let [l, h, w] = SIZE_M;
    let second_moment = w * h.powi(3) / 12.0;
    let bending = 1000.0 * l.powi(3) / (3.0 * STEEL.youngs_modulus_pa * second_moment);
    let shear = 1000.0 * l / (5.0 / 6.0 * STEEL.shear_modulus_pa() * h * w);
    let ratio = -bent[1] / (bending + shear);
    assert!((0.98..1.005).contains(&ratio), "{ratio}");
    // the right face turns by F l²/(2 E I) about −z; a rotation mode is minus a right-handed one
    let turn = 1000.0 * l * l / (2.0 * STEEL.youngs_modulus_pa * second_moment);
    let ratio = bent[5] / turn;
    assert!((0.98..1.005).contains(&ratio), "{ratio}");
    // the marker sees it the right way round
    let marker = &body.interfaces[1];
    let seen = &marker.rotation * &bent;
    assert!((seen[2] + bent[5]).abs() < 1e-12 * turn);
}

#[test]
fn more_normal_modes_bring_the_frequencies_of_the_full_model_from_above() {
    let mesh = block([8, 1, 1], true);
    let interfaces = [interface(&mesh, "left"), interface(&mesh, "right")];
    let k = assemble_stiffness(&mesh, &STEEL);
    let m = assemble_mass(&mesh, &STEEL, MassKind::Consistent);
    let mut is_fixed = vec![false; mesh.node_count()];
    for node in &interfaces[0].nodes {
        is_fixed[*node as usize] = true;
    }
    let full = clamped_hz(&k, &m, &is_fixed, 1).unwrap()[0];
    let mut last = f64::INFINITY;
    for normal_modes in [0, 2, 6] {
        let body = reduced(&mesh, normal_modes, &interfaces);
        let l = body.mass_modal.clone().cholesky().unwrap().l();
        let half = l.solve_lower_triangular(&body.stiffness_modal).unwrap();
        let c = l.solve_lower_triangular(&half.transpose()).unwrap();
        let lowest = c.symmetric_eigenvalues().min().sqrt() / (2.0 * PI);
        assert!(lowest < last * (1.0 + 1e-9) && lowest > full * (1.0 - 1e-9));
        last = lowest;
    }
    // 6 modes and a rigid end face: within 0.1 % of the full model
    assert!(last / full - 1.0 < 1e-3, "{last} Hz instead of {full} Hz");
}

#[test]
fn inertia_integrals_equal_their_nodal_sums() {
    let mesh = block([3, 1, 1], true);
    let interfaces = [interface(&mesh, "left"), interface(&mesh, "right")];
    let body = reduced(&mesh, 3, &interfaces);
    let n = body.mode_count();
    let m = assemble_mass(&mesh, &STEEL, MassKind::Consistent);
    let k = assemble_stiffness(&mesh, &STEEL);
    let basis = mode_basis(&model(&mesh, 3, &interfaces), &k, &m).unwrap().modes;
    // nodal sums, written out
    let tilde = |x: &DMatrix<f64>, mode: usize| -> DMatrix<f64> {
        let mut stacked = DMatrix::zeros(x.nrows(), 3);
        for node in 0..x.nrows() / 3 {
            let v = Vector3::new(
                x[(3 * node, mode)],
                x[(3 * node + 1, mode)],
                x[(3 * node + 2, mode)],
            );
            stacked
                .view_mut((3 * node, 0), (3, 3))
                .copy_from(&v.cross_matrix());
        }
        stacked
    };
    let positions = nodal(&mesh, |x| *x);
    let til_x = tilde(&positions, 0);
    let close = |a: &DMatrix<f64>, b: &DMatrix<f64>| (a - b).amax() < 1e-12 * b.amax().max(1e-3);
    let dynamic = |m: &Matrix3<f64>| DMatrix::from_fn(3, 3, |i, j| m[(i, j)]);
    assert!(close(
        &dynamic(&body.inertia_origin_kg_m2),
        &(til_x.transpose() * m.multiply(&til_x))
    ));
    assert!(close(
        &DMatrix::from_fn(3, n, |i, j| body.c_xp[(i, j)]),
        &(til_x.transpose() * m.multiply(&basis))
    ));
    for a in 0..n {
        let til_a = tilde(&basis, a);
        assert!(close(
            &dynamic(&body.n_blocks[a]),
            &(til_x.transpose() * m.multiply(&til_a))
        ));
        for b in 0..n {
            let til_b = tilde(&basis, b);
            assert!(close(
                &dynamic(&body.b_blocks[a * n + b]),
                &(til_a.transpose() * m.multiply(&til_b))
            ));
            let column = basis.columns(b, 1).into_owned();
            let c = til_a.transpose() * m.multiply(&column);
            assert!((body.c_vectors[a * n + b] - Vector3::new(c[0], c[1], c[2])).amax() < 1e-12);
        }
    }
}

#[test]
fn parts_that_hang_on_an_edge_are_refused() {
    // two tetrahedra that share one edge
    let text = "*NODE\n1, 0, 0, 0\n2, 0, 0, 1\n3, 1, 0, 0\n4, 0, 1, 0\n5, -1, 0, 0\n6, 0, -1, 0\n\
                *ELEMENT, TYPE=C3D4\n1, 1, 3, 4, 2\n2, 1, 5, 6, 2\n";
    assert_eq!(
        read_abaqus(text)
            .unwrap()
            .check_connected(&[])
            .unwrap_err()
            .to_string(),
        "the mesh falls into 2 parts that hang together by edges or single nodes only; one of 1 elements holds element 1"
    );
}

#[test]
fn a_structure_that_its_boundary_does_not_hold_is_refused() {
    let mesh = block([3, 1, 1], false);
    // two nodes hold it but for the rotation about their line
    let mut line = interface(&mesh, "left");
    line.nodes.truncate(2);
    line.weights = uniform_weights(2);
    let interfaces = [line];
    let error = reduce(&model(&mesh, 1, &interfaces)).unwrap_err();
    assert!(
        matches!(error, ReductionError::SingularStiffness { .. }),
        "{error}"
    );
}

#[test]
fn the_reduction_is_the_same_to_the_last_bit_every_time() {
    let mesh = block([6, 2, 1], true);
    let interfaces = [interface(&mesh, "left"), interface(&mesh, "right")];
    assert_eq!(reduced(&mesh, 4, &interfaces), reduced(&mesh, 4, &interfaces));
}
