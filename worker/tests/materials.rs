//! Runs of a job of several materials.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use hydroflex_dataset::{RunKind, RunRecord};
use hydroflex_openapi::job::{JobSpec, MaterialRef};
use hydroflex_openapi::machine::MaterialSpec;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::Simulator;
use hydroflex_worker::machines::ReadyMachine;
use hydroflex_worker::run::{PlannedRun, plan, side_by_side, simulate_together};

/// Largest vertical deflection of the tip, m.
fn deflection_m(record: &RunRecord, simulator: &Simulator) -> f64 {
    let mut channels = simulator.channels().iter();
    let column = channels.position(|c| c.name == "deflection_tip_y_m").unwrap();
    let samples = record.samples().unwrap();
    samples.columns[column]
        .iter()
        .fold(0.0, |most: f64, x| most.max(x.abs()))
}

#[test]
fn runs_of_several_materials_are_each_what_they_are_alone() {
    let spec: JobSpec = serde_json::from_str(
        r#"{"runs": 12, "seed": 3, "payload_kg": 100, "duration_s": 0.2, "materials": ["steel", "aluminium"]}"#,
    )
    .unwrap();
    let materials: Vec<MaterialSpec> = spec.materials.iter().filter_map(MaterialRef::material).collect();
    let cache = std::env::temp_dir().join("hydroflex-test-cache");
    let machine = ReadyMachine::new(Machine::load("lift-boom", &[]).unwrap(), &materials, &cache);
    let planned = |spec: &JobSpec| -> Vec<PlannedRun> {
        (0..spec.runs)
            .map(|index| plan(spec, &machine, RunKind::Job, index).unwrap())
            .collect()
    };
    assert!(side_by_side(&planned(&spec), &spec, &machine));
    let together = simulate_together(planned(&spec), &spec, &machine);
    let alone: Vec<RunRecord> = planned(&spec)
        .into_iter()
        .map(|run| run.simulate(&spec, &machine))
        .collect();
    assert_eq!(together, alone);
    let steel_only = JobSpec {
        materials: Vec::new(),
        ..spec.clone()
    };
    let plain = simulate_together(planned(&steel_only), &steel_only, &machine);
    let mut seen = [0, 0];
    for (record, plain) in together.iter().zip(&plain) {
        assert_eq!(
            (plain.material.as_ref(), &plain.angles_rad),
            (None, &record.angles_rad)
        );
        let simulator = &machine.simulator;
        let ratio = deflection_m(record, simulator) / deflection_m(plain, simulator);
        if record.material.as_deref() == Some("aluminium") {
            // a third of the stiffness under the same payload, and a third of the weight
            assert!((1.5..4.0).contains(&ratio), "{ratio}");
            seen[1] += 1;
        } else {
            // the built-in boom is of steel, as its file says
            assert!((ratio - 1.0).abs() < 1e-9, "{ratio}");
            seen[0] += 1;
        }
    }
    assert!(seen[0] > 2 && seen[1] > 2, "{seen:?}");
}
