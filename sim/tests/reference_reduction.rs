//! The reduction against independently computed reference data (Exudyn 1.13.6, SciPy), staged:
//! mesh, mass, interfaces, stiffness, frequencies, reduced matrices, strain.
//!
//! `HYDROFLEX_REFERENCE` names the folder with `liftboom/checks.json` and `liftboom/Job-1.inp`;
//! without it these tests pass and say so.
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use hydroflex_sim::fe::{
    InterfaceNodes, MassKind, Material, Mesh, Surface, area_weights, assemble_mass, assemble_stiffness,
    nodes_on_cylinder, read_abaqus, uniform_weights,
};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::reduction::{
    Damping, FlexibleModel, ReducedBody, clamped_hz, free_free_hz, mode_basis, reduce,
};
use nalgebra::{DMatrix, Matrix3, Vector3};
use serde_json::Value;
use std::path::PathBuf;

struct Reference {
    mesh: Mesh,
    checks: Value,
}

fn reference() -> Option<Reference> {
    let Some(folder) = std::env::var_os("HYDROFLEX_REFERENCE") else {
        eprintln!("HYDROFLEX_REFERENCE is not set: comparison with the reference skipped");
        return None;
    };
    let folder = PathBuf::from(folder).join("liftboom");
    let read = |name: &str| std::fs::read_to_string(folder.join(name)).unwrap();
    Some(Reference {
        mesh: read_abaqus(&read("Job-1.inp")).unwrap(),
        checks: serde_json::from_str(&read("checks.json")).unwrap(),
    })
}

const STEEL: Material = Material {
    youngs_modulus_pa: 2.1e11,
    poisson_ratio: 0.3,
    density_kg_per_m3: 7850.0,
};

fn numbers(value: &Value) -> Vec<f64> {
    match value {
        Value::Array(values) => values.iter().flat_map(numbers).collect(),
        value => vec![value.as_f64().unwrap()],
    }
}

fn matrix(value: &Value) -> DMatrix<f64> {
    let rows = value.as_array().unwrap().len();
    let numbers = numbers(value);
    DMatrix::from_row_slice(rows, numbers.len() / rows, &numbers)
}

fn indices(value: &Value) -> Vec<u32> {
    value
        .as_array()
        .unwrap()
        .iter()
        .map(|v| u32::try_from(v.as_u64().unwrap()).unwrap())
        .collect()
}

fn assert_close(found: f64, wanted: f64, relative: f64, what: &str) {
    assert!(
        (found - wanted).abs() <= relative * wanted.abs(),
        "{what}: {found:e} instead of {wanted:e}"
    );
}

/// Largest difference over the largest entry.
fn difference(found: &DMatrix<f64>, wanted: &DMatrix<f64>) -> f64 {
    assert_eq!(found.shape(), wanted.shape());
    (found - wanted).amax() / wanted.amax()
}

fn interface(reference: &Reference, name: &str) -> InterfaceNodes {
    let facts = &reference.checks["interfaces"][name];
    let point = |key: &str| Vector3::from_vec(numbers(&facts[key]));
    let nodes = nodes_on_cylinder(
        &reference.mesh,
        point("axis_a"),
        point("axis_b"),
        facts["radius"].as_f64().unwrap(),
        facts["tolerance"].as_f64().unwrap(),
    );
    let weights = if facts.get("area_weighted").is_some() {
        area_weights(&reference.mesh, &Surface::of(&reference.mesh), &nodes).unwrap()
    } else {
        uniform_weights(nodes.len())
    };
    InterfaceNodes {
        name: name.to_owned(),
        nodes,
        weights,
    }
}

#[test]
fn mesh_mass_and_inertia_agree() {
    let Some(r) = reference() else { return };
    let facts = &r.checks["mesh"];
    assert_eq!(r.mesh.node_count() as u64, facts["n_nodes"]);
    assert_eq!(r.mesh.elements().len() as u64, facts["n_tets"]);
    let surface = Surface::of(&r.mesh);
    assert_eq!(surface.triangles().len() as u64, facts["n_surface_triangles"]);
    // the same sums in another order
    let area = facts["surface_area"].as_f64().unwrap();
    assert_close(surface.area_m2(&r.mesh), area, 1e-12, "surface");
    let volume = facts["volume"].as_f64().unwrap();
    assert_close(r.mesh.volume_m3(), volume, 1e-12, "volume");
}

#[test]
fn interfaces_and_weights_agree() {
    let Some(r) = reference() else { return };
    for name in ["pivot", "piston", "payload"] {
        let facts = &r.checks["interfaces"][name];
        let interface = interface(&r, name);
        assert_eq!(interface.nodes, indices(&facts["nodes_zero_based"]));
        for (found, wanted) in interface.weights.iter().zip(numbers(&facts["weights"])) {
            assert_close(*found, wanted, 1e-12, name);
        }
        let mean = Vector3::from_vec(numbers(&facts["weighted_mean"]));
        assert!((interface.weighted_mean_m(&r.mesh) - mean).norm() < 1e-15);
    }
}

#[test]
fn stiffness_and_mass_action_agree() {
    let Some(r) = reference() else { return };
    let facts = &r.checks["stiffness"];
    let x = DMatrix::from_fn(3 * r.mesh.node_count(), 1, |i, _| {
        let i = i as f64;
        libm::sin(0.37 * (i + 1.0)) + 0.5 * libm::cos(0.011 * (i + 1.0))
    });
    let k = assemble_stiffness(&r.mesh, &STEEL);
    let kx = k.multiply(&x);
    let value = |key: &str| facts[key].as_f64().unwrap();
    // sums over 15,255 terms of mixed sign
    assert_close(x.dot(&kx), value("x_dot_Kx"), 1e-11, "x·Kx");
    assert_close(kx.norm(), value("norm2_Kx"), 1e-12, "|Kx|");
    assert_close(kx.amax(), value("maxabs_Kx"), 1e-12, "max |Kx|");
    assert_close(k.trace(), value("trace"), 1e-12, "trace");
    assert_close(k.norm(), value("frobenius"), 1e-12, "Frobenius norm");
    for (dof, wanted) in indices(&facts["dofs"]).iter().zip(numbers(&facts["Kx"])) {
        let error = (kx[*dof as usize] - wanted).abs();
        assert!(error < 1e-11 * kx.amax().min(100.0 * wanted.abs()));
    }
    for (kind, key) in [
        (MassKind::Lumped, "x_dot_Mx"),
        (MassKind::Consistent, "x_dot_Mconsistent_x"),
    ] {
        let m = assemble_mass(&r.mesh, &STEEL, kind);
        assert_close(x.dot(&m.multiply(&x)), value(key), 1e-11, key);
    }
}

#[test]
fn free_and_clamped_frequencies_agree() {
    let Some(r) = reference() else { return };
    let k = assemble_stiffness(&r.mesh, &STEEL);
    for (kind, key) in [(MassKind::Lumped, "lumped"), (MassKind::Consistent, "consistent")] {
        let m = assemble_mass(&r.mesh, &STEEL, kind);
        let found = free_free_hz(&k, &m, 100.0, 12).unwrap();
        let wanted = numbers(&r.checks["free_free"][key]["first_12_elastic_Hz"]);
        // the reference's higher lumped modes are 2e-9 above ours, and Rayleigh quotients err upwards
        for (found, wanted) in found.iter().zip(wanted) {
            assert_close(*found, wanted, 3e-9, key);
        }
    }
    let m = assemble_mass(&r.mesh, &STEEL, MassKind::Lumped);
    for (names, wanted) in r.checks["fixed_interface_Hz"].as_object().unwrap() {
        let mut is_fixed = vec![false; r.mesh.node_count()];
        for name in names.split('+') {
            for node in interface(&r, name).nodes {
                is_fixed[node as usize] = true;
            }
        }
        let found = clamped_hz(&k, &m, &is_fixed, 6).unwrap();
        for (found, wanted) in found.iter().zip(numbers(wanted)) {
            assert_close(*found, wanted, 1e-9, names);
        }
    }
}

fn model<'a>(
    r: &'a Reference,
    interfaces: &'a [InterfaceNodes],
    sensors: &'a [u32],
    boundaries: usize,
) -> FlexibleModel<'a> {
    FlexibleModel {
        name: "boom",
        mesh: &r.mesh,
        matrices: None,
        material: STEEL,
        mass_kind: MassKind::Lumped,
        normal_modes: 2,
        damping: Damping::Rayleigh {
            mass_factor_per_s: 0.0,
            stiffness_factor_s: 3.35e-3,
        },
        interfaces,
        boundary: (0..boundaries).collect(),
        sensor_nodes: sensors,
    }
}

/// Reduced body whose normal modes have the reference's signs (chosen at the tip, or where the
/// boom's tip is clamped at the stress node).
fn check_reduced(r: &Reference, body: &ReducedBody, key: &str) {
    let facts = &r.checks["reduced"][key];
    let n = body.mode_count();
    assert_eq!(n as u64, facts["n_modes"]);
    for (found, wanted) in body
        .report
        .fixed_interface_hz
        .iter()
        .zip(numbers(&facts["eigenmode_Hz"]))
    {
        assert_close(*found, wanted, 1e-9, "fixed-interface frequency");
    }
    let wanted_rows = matrix(&facts["stress_node_mode_rows"]);
    let found_rows = DMatrix::from_fn(3, n, |i, j| body.sensor_nodes[1].translation[(i, j)]);
    let signs = DMatrix::from_diagonal(&nalgebra::DVector::from_fn(n, |j, _| {
        found_rows.column(j).dot(&wanted_rows.column(j)).signum()
    }));
    for j in 0..n - 2 {
        assert!(signs[(j, j)] > 0.0, "static mode {j} keeps its sign");
    }
    let signed = |m: &DMatrix<f64>| &signs * m * &signs;
    // the reference's own residual of the static modes is 1e-12, of the stiffness symmetry 1e-11
    assert!(difference(&signed(&body.mass_modal), &matrix(&facts["mass"])) < 1e-9);
    assert!(difference(&signed(&body.stiffness_modal), &matrix(&facts["stiffness"])) < 1e-9);
    for (sensor, rows, strain) in [
        (0, "tip_mode_rows", "tip_strain_modes"),
        (1, "stress_node_mode_rows", "stress_node_strain_modes"),
    ] {
        let node = &body.sensor_nodes[sensor];
        let found = DMatrix::from_fn(3, n, |i, j| node.translation[(i, j)]) * &signs;
        assert!(difference(&found, &matrix(&facts[rows])) < 1e-9, "{rows}");
        let found = &node.strain * &signs;
        // a strain is a difference of mode displacements (up to 8) over an element (20 mm)
        let scale = body.sensor_nodes[0].translation.amax() / 0.02;
        let error = (found - matrix(&facts[strain]).transpose()).amax();
        assert!(error < 1e-12 * scale, "{strain}: {error:e}");
    }
    for interface in &body.interfaces {
        let Some(wanted) = facts["interface_mean_mode_rows"].get(&interface.name) else {
            continue;
        };
        let found = DMatrix::from_fn(3, n, |i, j| interface.translation[(i, j)]);
        assert!((found - matrix(wanted)).amax() < 1e-12);
    }
    let rigid = &r.checks["rigid_body"]["lumped"];
    assert_close(body.mass_kg, rigid["mass"].as_f64().unwrap(), 1e-12, "mass");
    let com = Vector3::from_vec(numbers(&rigid["com"]));
    assert!((body.centre_of_mass_m - com).norm() < 1e-12);
    let inertia = Matrix3::from_row_slice(&numbers(&rigid["inertia_about_origin"]));
    assert!((body.inertia_origin_kg_m2 - inertia).amax() < 1e-12 * inertia.amax());
}

#[test]
fn reduced_bodies_agree() {
    let Some(r) = reference() else { return };
    let interfaces = ["pivot", "piston", "payload"].map(|name| interface(&r, name));
    let sensor = |key: &str| u32::try_from(r.checks["sensors"][key].as_u64().unwrap()).unwrap();
    let sensors = [sensor("tip_node_zero_based"), sensor("stress_node_zero_based")];
    for (boundaries, key) in [(2, "no_payload"), (3, "with_payload")] {
        let body = reduce(&model(&r, &interfaces, &sensors, boundaries)).unwrap();
        check_reduced(&r, &body, key);
    }
}

#[test]
fn static_modes_are_in_equilibrium_and_normal_modes_orthonormal() {
    let Some(r) = reference() else { return };
    let interfaces = ["pivot", "piston", "payload"].map(|name| interface(&r, name));
    let model = model(&r, &interfaces, &[], 3);
    let k = assemble_stiffness(&r.mesh, &STEEL);
    let m = assemble_mass(&r.mesh, &STEEL, MassKind::Lumped);
    let modes = mode_basis(&model, &k, &m).unwrap().modes;
    let reaction = k.multiply(&modes);
    let boundary: Vec<u32> = interfaces.iter().flat_map(|i| i.nodes.clone()).collect();
    let mut interior: f64 = 0.0;
    for node in 0..r.mesh.node_count() {
        if !boundary.contains(&u32::try_from(node).unwrap()) {
            interior = interior.max(reaction.view((3 * node, 0), (3, 12)).amax());
        }
    }
    assert!(interior < 1e-12 * k.norm());
    let normal = modes.columns(12, 2).into_owned();
    let gram = normal.transpose() * m.multiply(&normal);
    assert!((gram - DMatrix::identity(2, 2)).amax() < 1e-12);
}

#[test]
fn the_published_machine_file_gives_the_reference_bodies() {
    let Some(r) = reference() else { return };
    let folder = PathBuf::from(std::env::var_os("HYDROFLEX_REFERENCE").unwrap());
    let mesh = folder.join("liftboom/Job-1.inp").display().to_string();
    let machine = Machine::load("lift-boom-published", &[mesh]).unwrap();
    for (with_payload, key) in [(false, "no_payload"), (true, "with_payload")] {
        let bodies = machine.reduce(with_payload, None).unwrap();
        let mut body = bodies[0].clone();
        // sensors: tip deflection, tip strain, root stress
        body.sensor_nodes.remove(0);
        check_reduced(&r, &body, key);
    }
}

#[test]
fn the_published_crane_gives_the_reference_bodies() {
    let Some(folder) = std::env::var_os("HYDROFLEX_REFERENCE") else {
        eprintln!("HYDROFLEX_REFERENCE is not set: comparison with the reference skipped");
        return;
    };
    let folder = PathBuf::from(folder).join("patu");
    let mesh = |body: &str, file: &str| format!("{body}={}", folder.join(file).display());
    let meshes = [
        mesh("lift", "LiftBoom-Job-1.inp"),
        mesh("tilt", "TiltBoom-Job-1.inp"),
    ];
    let machine = Machine::load("crane-published", &meshes).unwrap();
    let checks: Value =
        serde_json::from_str(&std::fs::read_to_string(folder.join("checks.json")).unwrap()).unwrap();
    let bodies = machine.reduce(true, None).unwrap();
    for (body, full) in bodies.iter().zip(machine.flexible_bodies()) {
        let facts = &checks[&body.name];
        let value = |key: &str| facts[key].as_f64().unwrap();
        assert_eq!(body.mode_count() as u64, facts["n_modes"]);
        assert_close(body.mass_kg, value("mass"), 1e-12, "mass");
        let inertia = Matrix3::from_row_slice(&numbers(&facts["inertia_about_origin"]));
        assert!((body.inertia_origin_kg_m2 - inertia).amax() < 1e-12 * inertia.amax());
        let names = ["pivot", "piston", "cyl2", "link", "tilt", "ext"];
        for (interface, reduced) in full.interfaces.iter().zip(&body.interfaces) {
            let name = match interface.name.as_str() {
                "tilt_base" => "cyl2",
                "extension" => "ext",
                name => name,
            };
            assert!(names.contains(&name));
            let wanted = &facts["interfaces"][name];
            assert_eq!(interface.nodes, indices(&wanted["nodes_zero_based"]));
            let mean = Vector3::from_vec(numbers(&wanted["weighted_mean"]));
            assert!((reduced.position_m - mean).norm() < 1e-14);
        }
        let frequencies = body.report.fixed_interface_hz.iter();
        for (found, wanted) in frequencies.zip(numbers(&facts["eigenmode_Hz"])) {
            // the reference's highest modes are 1e-9 above ours, and Rayleigh quotients err upwards
            assert_close(*found, wanted, 1e-8, "fixed-interface frequency");
        }
        let l = body.mass_modal.clone().cholesky().unwrap().l();
        let half = l.solve_lower_triangular(&body.stiffness_modal).unwrap();
        let c = l.solve_lower_triangular(&half.transpose()).unwrap();
        let mut found: Vec<f64> = c
            .symmetric_eigenvalues()
            .iter()
            .map(|w2| w2.sqrt() / (2.0 * std::f64::consts::PI))
            .collect();
        found.sort_by(f64::total_cmp);
        for (found, wanted) in found.iter().zip(numbers(&facts["reduced_system_Hz"])) {
            assert_close(*found, wanted, 1e-8, "reduced frequency");
        }
        let sensor = facts["sensors"]["stress_mesh"].as_u64().unwrap();
        assert!(body.sensor_nodes.iter().any(|node| node.node as u64 == sensor));
    }
}
