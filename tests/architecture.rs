//! The house keeps its doors: which crate may use which, as ARCHITECTURE.md says.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

/// Crate → crates of ours that it may use (ARCHITECTURE.md, "Doors").
const ALLOWED: &[(&str, &[&str])] = &[
    ("hydroflex-openapi", &[]),
    ("hydroflex-sim", &["hydroflex-openapi"]),
    ("hydroflex-dataset", &["hydroflex-openapi"]),
    ("hydroflex-ml", &["hydroflex-openapi", "hydroflex-dataset"]),
    ("hydroflex-ledger", &["hydroflex-openapi"]),
    (
        "hydroflex-worker",
        &[
            "hydroflex-openapi",
            "hydroflex-sim",
            "hydroflex-ledger",
            "hydroflex-dataset",
        ],
    ),
    (
        "hydroflex-server",
        &[
            "hydroflex-openapi",
            "hydroflex-sim",
            "hydroflex-ledger",
            "hydroflex-dataset",
            "hydroflex-ml",
            "hydroflex-worker",
        ],
    ),
];

#[test]
fn crates_use_only_what_the_architecture_allows() {
    let manifest = concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.toml");
    let output = Command::new(env!("CARGO"))
        .args([
            "metadata",
            "--format-version=1",
            "--no-deps",
            "--offline",
            "--manifest-path",
            manifest,
        ])
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let metadata: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let allowed: BTreeMap<&str, BTreeSet<&str>> = ALLOWED
        .iter()
        .map(|(name, uses)| (*name, uses.iter().copied().collect()))
        .collect();
    let mut seen = BTreeSet::new();
    for package in metadata["packages"].as_array().unwrap() {
        let name = package["name"].as_str().unwrap();
        seen.insert(name.to_owned());
        if name == "hydroflex-tests" {
            continue;
        }
        let may = allowed
            .get(name)
            .unwrap_or_else(|| panic!("{name} is not in the table of doors"));
        for dependency in package["dependencies"].as_array().unwrap() {
            let used = dependency["name"].as_str().unwrap();
            // Tests of a crate may look further than the crate itself.
            if used.starts_with("hydroflex-") && dependency["kind"] != "dev" {
                assert!(may.contains(used), "{name} must not use {used}");
            }
        }
    }
    for (name, _) in ALLOWED {
        assert!(
            seen.contains(*name),
            "{name} is in the table, not in the workspace"
        );
    }
}

#[test]
fn only_the_named_files_of_the_simulator_read_the_contract() {
    // What is sent is defined in `openapi`; inside `sim` the crossing has few, known places.
    let root = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../sim/src"));
    for kernel in ["fe", "reduction", "integrate"] {
        for entry in std::fs::read_dir(root.join(kernel)).unwrap() {
            let path = entry.unwrap().path();
            if path.extension().is_some_and(|extension| extension == "rs") {
                let text = std::fs::read_to_string(&path).unwrap();
                assert!(
                    !text.contains("hydroflex_openapi"),
                    "{} reads the contract",
                    path.display()
                );
            }
        }
    }
}
