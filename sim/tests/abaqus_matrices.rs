//! Matrices that came with the mesh: our own, written as Abaqus writes them, give the body that our assembly gives; what is wrong
//! with a file is named.
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use hydroflex_sim::fe::{
    MassKind, Material, MatrixDefect, MatrixError, MatrixProblem, Mesh, assemble_mass, assemble_stiffness,
    read_abaqus, read_matrices,
};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::reduction::ReducedBody;
use nalgebra::DMatrix;
use std::fmt::Write;

mod block;
use block::block_text;

const STEEL: Material = Material {
    youngs_modulus_pa: 2.1e11,
    poisson_ratio: 0.3,
    density_kg_per_m3: 7850.0,
};

const CELLS: [usize; 3] = [4, 1, 1];

/// Which entries a file has.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Part {
    Lower,
    Upper,
    Square,
}

/// The nonzero entries of a matrix over the unknowns of the block.
fn entries(matrix: &DMatrix<f64>, part: Part) -> Vec<(usize, usize, f64)> {
    let wanted = |r: usize, c: usize| match part {
        Part::Lower => r >= c,
        Part::Upper => r <= c,
        Part::Square => true,
    };
    let n = matrix.nrows();
    (0..n)
        .flat_map(|r| (0..n).map(move |c| (r, c)))
        .filter(|(r, c)| wanted(*r, *c) && matrix[(*r, *c)] != 0.0)
        .map(|(r, c)| (r, c, matrix[(r, c)]))
        .collect()
}

/// Labels of the block's nodes in the order of its file, which is not that of the labels.
fn labels() -> Vec<usize> {
    let text = block_text(CELLS, true);
    let nodes = text.lines().skip(1).take_while(|line| !line.starts_with('*'));
    nodes
        .map(|line| line.split(',').next().unwrap().trim().parse().unwrap())
        .collect()
}

fn matrix_input(matrix: &DMatrix<f64>, part: Part) -> String {
    let labels = labels();
    let mut text = "** MATRIX INPUT\n*MATRIX INPUT, NAME=K, TYPE=SYMMETRIC\n".to_owned();
    for (r, c, value) in entries(matrix, part) {
        let (row, column) = (labels[r / 3], labels[c / 3]);
        writeln!(text, "{row},{}, {column},{},  {value:.16e}", 1 + r % 3, 1 + c % 3).unwrap();
    }
    text
}

fn coordinate(matrix: &DMatrix<f64>, part: Part) -> String {
    // the block's labels are 1 to their number
    let row = |unknown: usize, labels: &[usize]| 3 * (labels[unknown / 3] - 1) + unknown % 3 + 1;
    let labels = labels();
    let mut text = String::new();
    for (r, c, value) in entries(matrix, part) {
        // as Fortran writes it
        let value = format!("{value:.16e}").replace('e', "D");
        writeln!(text, "  {}  {}  {value}", row(r, &labels), row(c, &labels)).unwrap();
    }
    text
}

fn mesh() -> Mesh {
    read_abaqus(&block_text(CELLS, true)).unwrap()
}

/// Stiffness and mass, written out.
fn assembled(mesh: &Mesh) -> [DMatrix<f64>; 2] {
    let unit = DMatrix::identity(3 * mesh.node_count(), 3 * mesh.node_count());
    [
        assemble_stiffness(mesh, &STEEL).multiply(&unit),
        assemble_mass(mesh, &STEEL, MassKind::Consistent).multiply(&unit),
    ]
}

/// A boom of the block on the rig's cylinder; `matrices` is a line of its body, or nothing.
fn machine_text(matrices: &str) -> String {
    format!(
        r#"
format = 1
name = "block"
gravity_m_per_s2 = [0.0, -9.81, 0.0]
[[body]]
kind = "flexible"
name = "beam"
mesh = {{ file = "block.inp" }}
{matrices}
material = {{ name = "steel", youngs_modulus_pa = 2.1e11, poisson_ratio = 0.3, density_kg_per_m3 = 7850.0 }}
normal_modes = 4
damping = {{ kind = "modal", damping_ratio = 0.01 }}
interface = [
    {{ name = "left", select = {{ node_set = "LEFT" }} }},
    {{ name = "right", select = {{ node_set = "RIGHT" }} }},
]
[[joint]]
name = "pivot"
kind = "revolute"
from = {{ body = "ground", point_m = [0.0, 0.05, 0.025] }}
to = {{ body = "beam", interface = "left" }}
[[cylinder]]
name = "lift"
base = {{ body = "ground", point_m = [0.0, -1.0, 0.025] }}
rod = {{ body = "beam", interface = "right" }}
closed_length_m = 1.0
stroke_m = 0.8
piston_diameter_m = 0.1
rod_diameter_m = 0.056
damping_n_s_per_m = 6.4e5
hose = {{ diameter_m = 0.0127, length_m = 1.5 }}
fluid = {{ bulk_modulus_oil_pa = 1.65e9, bulk_modulus_cylinder_pa = 2.1e11, bulk_modulus_hose_pa = 0.7e9, vapour_pressure_pa = 2e3 }}
valve = {{ flow_coefficient_m3_per_s_per_sqrt_pa = 3.6e-7, supply_pressure_pa = 140e5, tank_pressure_pa = 1e5 }}
friction = {{ kind = "none" }}
initial_pressure_pa = 5e6
[[angle]]
name = "lift"
body = "beam"
range_deg = [-5.0, 20.0]
"#
    )
}

/// Largest difference between two matrices, relative to the largest entry.
fn difference(a: &DMatrix<f64>, b: &DMatrix<f64>) -> f64 {
    (a - b).amax() / b.amax()
}

#[test]
fn a_body_of_given_matrices_is_the_body_of_our_own() {
    let folder = std::env::temp_dir().join(format!("hydroflex-matrices-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("block.inp"), block_text(CELLS, true)).unwrap();
    let [stiffness, mass] = assembled(&mesh());
    let load = |name: &str, matrices: &str| -> Machine {
        let path = folder.join(name);
        std::fs::write(&path, machine_text(matrices)).unwrap();
        Machine::load(&path.to_string_lossy(), &[]).unwrap()
    };
    let reduced = |machine: &Machine| -> ReducedBody { machine.reduce(false, None).unwrap().remove(0) };
    let ours = load("ours.toml", "");
    let expected = reduced(&ours);
    let line = r#"matrices = { stiffness = "K.mtx", mass = "M.mtx" }"#;
    for part in [Part::Lower, Part::Upper, Part::Square] {
        for write in [matrix_input, coordinate] {
            std::fs::write(folder.join("K.mtx"), write(&stiffness, part)).unwrap();
            std::fs::write(folder.join("M.mtx"), write(&mass, part)).unwrap();
            let given = load("given.toml", line);
            let found = reduced(&given);
            assert!((found.mass_kg / expected.mass_kg - 1.0).abs() < 1e-12);
            assert!(difference(&found.stiffness_modal, &expected.stiffness_modal) < 1e-12);
            assert!(difference(&found.mass_modal, &expected.mass_modal) < 1e-12);
            assert!((found.centre_of_mass_m - expected.centre_of_mass_m).norm() < 1e-12);
            let inertia = (found.inertia_origin_kg_m2 - expected.inertia_origin_kg_m2).amax();
            assert!(inertia < 1e-12 * expected.inertia_origin_kg_m2.amax());
            for (a, b) in found
                .report
                .fixed_interface_hz
                .iter()
                .zip(&expected.report.fixed_interface_hz)
            {
                assert!((a / b - 1.0).abs() < 1e-12, "{a} {b}");
            }
            assert_ne!(given.content_hash(), ours.content_hash());
            let key = |machine: &Machine| machine.flexible_bodies()[0].reduction_key(false);
            assert_ne!(key(&given), key(&ours));
        }
    }
    // half the stiffness in the file is half the stiffness in the body: nothing of our own is left
    std::fs::write(
        folder.join("K.mtx"),
        matrix_input(&(&stiffness * 0.5), Part::Lower),
    )
    .unwrap();
    let softer = reduced(&load("given.toml", line));
    assert!(difference(&softer.stiffness_modal, &(&expected.stiffness_modal * 0.5)) < 1e-12);

    // what is wrong is said with the key of the machine file
    std::fs::write(folder.join("K.mtx"), "1, 1, 1, 1, 1.0\n1, 1, 999, 1, -1.0\n").unwrap();
    let path = folder.join("given.toml");
    let error = Machine::load(&path.to_string_lossy(), &[])
        .unwrap_err()
        .to_string();
    assert!(error.contains("body[0].matrices"), "{error}");
    assert!(
        error.contains("line 2 of the stiffness matrix: the mesh has no node 999"),
        "{error}"
    );
    let error = Machine::from_untrusted_toml(
        &machine_text(line),
        &std::iter::once(("beam".to_owned(), block_text(CELLS, true))).collect(),
    );
    assert!(
        error
            .unwrap_err()
            .to_string()
            .contains("can name no files of matrices")
    );
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn a_matrix_that_cannot_be_is_refused() {
    let mesh = mesh();
    let [stiffness, mass] = assembled(&mesh);
    let (k, m) = (
        matrix_input(&stiffness, Part::Lower),
        matrix_input(&mass, Part::Lower),
    );
    assert!(read_matrices(&mesh, &k, &m).is_ok());
    let refused = |k: &str, m: &str| read_matrices(&mesh, k, m).unwrap_err();
    let problem = |k: &str| match refused(k, &m) {
        MatrixError::Line { problem, line, .. } => (line, problem),
        other @ MatrixError::Whole { .. } => panic!("{other}"),
    };
    assert_eq!(problem("1,4,1,1,1.0"), (1, MatrixProblem::Dof { dof: 4 }));
    assert_eq!(
        problem("\n-3,1,1,1,1.0"),
        (2, MatrixProblem::UnknownNode { label: -3 })
    );
    assert_eq!(
        problem("1,1,1,1,1.0\n1,1,1.0"),
        (2, MatrixProblem::EntryCount { found: 3 })
    );
    assert!(matches!(
        problem("1,1,1,1,NaN"),
        (1, MatrixProblem::NotANumber { .. })
    ));
    assert!(matches!(
        problem("0 1 2.0"),
        (1, MatrixProblem::Row { found: 0, .. })
    ));
    assert_eq!(
        problem("*MATRIX INPUT, TYPE=UNSYMMETRIC"),
        (1, MatrixProblem::Unsymmetric)
    );

    let whole = |k: &str, m: &str| match refused(k, m) {
        MatrixError::Whole { defect, .. } => defect,
        other @ MatrixError::Line { .. } => panic!("{other}"),
    };
    assert!(matches!(
        whole("1,1,1,1,1.0", &m),
        MatrixDefect::Diagonal { node: 1, dof: 2, .. }
    ));
    assert!(matches!(
        whole("1,1,1,1,1.0\n1,1,1,1,1.0", &m),
        MatrixDefect::Twice { .. }
    ));
    let mut skew = stiffness.clone();
    skew[(4, 1)] *= 1.0 + 1e-6;
    let skew = matrix_input(&skew, Part::Square);
    assert!(
        matches!(whole(&skew, &m), MatrixDefect::Asymmetric { .. }),
        "{}",
        refused(&skew, &m)
    );
    // a support, left in
    let mut held = stiffness.clone();
    held[(0, 0)] *= 2.0;
    let defect = whole(&matrix_input(&held, Part::Lower), &m);
    assert!(
        matches!(
            defect,
            MatrixDefect::NotFree {
                motion: "translation",
                ..
            }
        ),
        "{defect}"
    );
    // nodes mixed up: translations are still free, rotations are not
    let n = stiffness.nrows();
    let turned = DMatrix::from_fn(n, n, |r, c| stiffness[((r + 3) % n, (c + 3) % n)]);
    let defect = whole(&matrix_input(&turned, Part::Lower), &m);
    assert!(
        matches!(
            defect,
            MatrixDefect::NotFree {
                motion: "rotation",
                ..
            }
        ),
        "{defect}"
    );
    let mut lopsided = mass.clone();
    lopsided[(1, 1)] *= 1.5;
    let defect = whole(&k, &matrix_input(&lopsided, Part::Lower));
    assert!(
        matches!(
            defect,
            MatrixDefect::Directional {
                dof: 2,
                other_dof: 2,
                ..
            }
        ),
        "{defect}"
    );
}
