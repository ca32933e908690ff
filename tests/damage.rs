//! Damaged files: every parser of what comes from outside answers or refuses, and never panics, hangs or
//! takes all memory. Bodies of requests have the same test beside the service.
//!
//! `HYDROFLEX_DAMAGES=1000000 cargo test --release --workspace --test damage` tries more of them;
//! `HYDROFLEX_DAMAGE_SEED` others.

#![allow(clippy::unwrap_used, reason = "a test stops at what it did not expect")]

use damage::damaged;
use hydroflex_dataset::Dataset;
use hydroflex_ml::model::Model;
use hydroflex_openapi::dataset::SplitName;
use hydroflex_openapi::job::{Excitation, JobSpec};
use hydroflex_sim::fe::read_abaqus;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::scenario;
use std::fmt::Write as _;
use std::path::Path;

#[path = "../server/tests/common/damage.rs"]
mod damage;

fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|text| text.parse().unwrap())
}

/// As many seeds as are asked for, or a number that takes a moment.
fn seeds(few: u64) -> std::ops::Range<u64> {
    let first = number("HYDROFLEX_DAMAGE_SEED").unwrap_or(1) << 32;
    first..first + number("HYDROFLEX_DAMAGES").unwrap_or(few)
}

#[test]
fn damaged_machine_files_are_read_or_refused() {
    let mut refused = 0;
    for seed in seeds(3_000) {
        let names = Machine::built_in_names();
        let text = Machine::built_in_text(names[usize::try_from(seed).unwrap() % names.len()]).unwrap();
        let text = String::from_utf8_lossy(&damaged(text.as_bytes(), seed)).into_owned();
        if let Err(error) = Machine::parse_file(&text) {
            refused += 1;
            assert!(!error.to_string().is_empty());
        }
    }
    assert!(refused > 100, "{refused} were refused");
}

#[test]
fn damaged_meshes_are_read_or_refused() {
    let mut whole = String::from("*Node\n");
    for k in 0..4 {
        for j in 0..4 {
            for i in 0..4 {
                writeln!(whole, "{}, {i}., {j}., {k}.", 1 + i + 4 * j + 16 * k).unwrap();
            }
        }
    }
    whole += "*Element, type=C3D4, elset=Solid\n1, 1, 2, 5, 17\n2, 6, 5, 2, 22\n3, 18, 17, 22, 2\n\
              *Nset, nset=eye, generate\n1, 16, 1\n*Elset, elset=all\n1, 2,\n 3\n";
    for seed in seeds(20_000) {
        let text = String::from_utf8_lossy(&damaged(whole.as_bytes(), seed)).into_owned();
        if let Ok(mesh) = read_abaqus(&text) {
            assert!(mesh.node_count() <= 200);
        }
    }
}

#[test]
fn damaged_jobs_are_checked_or_refused() {
    let machine = Machine::parse_file(Machine::built_in_text("lift-boom").unwrap()).unwrap();
    let whole = serde_json::json!({
        "title": "night", "machine": "lift-boom", "runs": 80, "seed": 7, "duration_s": 1.0, "sample_time_s": 0.005,
        "payload_kg": { "min": 0.0, "max": 100.0, "empty": 0.2 }, "initial_angle_deg": { "lift": [-10.0, 50.0] },
        "excitation": { "kind": "given", "valve_ratio": { "lift": [0.0, 0.5, 1.0] } },
        "split": { "train": 0.8, "validation": 0.1, "test": 0.1 }, "exclude_flags": ["cavitation"],
        "columns": ["deflection_tip_y_m"], "file_size_mb": 64,
        "train": [{ "structure": "RLR", "targets": ["deflection_tip_y_m"], "seed": 3 }],
    })
    .to_string();
    let mut checked = 0;
    for seed in seeds(20_000) {
        if let Ok(spec) = serde_json::from_slice::<JobSpec>(&damaged(whole.as_bytes(), seed)) {
            checked += 1;
            let valid = scenario::validate(&spec, &machine).is_ok();
            // What is accepted is bounded in every dimension that costs memory.
            if valid {
                assert!(
                    spec.steps() < 10_000_000
                        && !matches!(&spec.excitation, Excitation::Given { valve_ratio } if valve_ratio.is_empty())
                );
            }
        }
    }
    assert!(checked > 100, "{checked} could be read at all");
}

#[test]
fn damaged_data_sets_and_models_are_opened_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (data, model) = (folder.path().join("data"), folder.path().join("model"));
    let table = folder.path().join("runs.parquet");
    write_runs(&table);
    let run = |arguments: &[&str]| hydroflex_tests::command(arguments).unwrap();
    let path = |path: &Path| path.to_str().unwrap().to_owned();
    run(&[
        "simulate",
        "--runs",
        &path(&table),
        "--out",
        &path(&data),
        "--integrator",
        "generalized-alpha",
    ]);
    run(&[
        "train",
        "--data",
        &path(&data),
        "--out",
        &path(&model),
        "--structure",
        "L",
        "--window-s",
        "0.05",
        "--epochs",
        "1",
    ]);

    let files = |below: &Path| {
        let mut found: Vec<std::path::PathBuf> = Vec::new();
        let mut folders = vec![below.to_owned()];
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).unwrap().flatten() {
                if entry.path().is_dir() {
                    folders.push(entry.path());
                } else {
                    found.push(entry.path());
                }
            }
        }
        found.sort();
        found
    };
    let (data_files, model_files) = (files(&data), files(&model));
    assert!(data_files.len() > 3 && model_files.len() > 3);
    let everything = data_files.iter().chain(&model_files).cloned().collect::<Vec<_>>();
    for seed in seeds(1_500) {
        let file = &everything[usize::try_from(seed).unwrap() % everything.len()];
        let whole = std::fs::read(file).unwrap();
        std::fs::write(file, damaged(&whole, seed)).unwrap();
        if file.extension().is_some_and(|end| end == "parquet") {
            let names = ["valve_lift_ratio".to_owned()];
            let _ = hydroflex_ml::recording::read_parquet(file, &names, 0.005);
        }
        if file.starts_with(&data) {
            if let Ok(dataset) = Dataset::open(&data) {
                for split in [SplitName::Train, SplitName::Validation] {
                    let _ = dataset.load(split, &["deflection_tip_y_m", "valve_lift_ratio"]);
                }
            }
        } else {
            let _ = Model::load(&model);
        }
        std::fs::write(file, whole).unwrap();
    }
    assert!(Dataset::open(&data).is_ok() && Model::load(&model).is_ok());
}

/// A table of ten short runs.
fn write_runs(path: &Path) {
    use arrow::array::{Float64Array, Float64Builder, Int64Array, ListBuilder, RecordBatch};
    use std::sync::Arc;
    let mut valve = ListBuilder::new(Float64Builder::new());
    for run in 0..10 {
        for k in 0..60 {
            valve
                .values()
                .append_value(((f64::from(k) + f64::from(run)) * 0.2).sin());
        }
        valve.append(true);
    }
    let batch = RecordBatch::try_from_iter([
        ("run_id", Arc::new(Int64Array::from_iter_values(0..10)) as _),
        (
            "payload_kg",
            Arc::new(Float64Array::from_iter_values((0..10).map(|_| 0.0))) as _,
        ),
        (
            "angle_lift_rad",
            Arc::new(Float64Array::from_iter_values(
                (0..10).map(|run| 0.05 * f64::from(run)),
            )) as _,
        ),
        ("valve_lift_ratio", Arc::new(valve.finish()) as _),
    ])
    .unwrap();
    let file = std::fs::File::create(path).unwrap();
    let mut writer = parquet::arrow::ArrowWriter::try_new(file, batch.schema(), None).unwrap();
    writer.write(&batch).unwrap();
    writer.close().unwrap();
}
