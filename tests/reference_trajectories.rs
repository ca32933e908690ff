//! Statics, eigenvalues and trajectories against an independent solver (Exudyn 1.13.6, November 2026).
//!
//! `HYDROFLEX_REFERENCE` names the folder with `liftboom/`; without it these tests pass and say so.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

use std::path::PathBuf;
use std::sync::OnceLock;

use arrow::array::AsArray;
use arrow::compute::cast;
use arrow::datatypes::{DataType, Float64Type};
use hydroflex_openapi::job::Integrator;
use hydroflex_sim::linearise::Actuation;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::{RunInput, RunSettings, Trajectory};
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use serde_json::Value;

/// Reference column, our channel, bound relative to the range: the 1e-5, and 1e-4 for the
/// angular acceleration. The independent solver's own Newton variants differ by 7e-8 and 2e-6.
const CHANNELS: [(&str, &str, f64); 11] = [
    ("s", "length_lift_m", 1e-5),
    ("ds", "velocity_lift_m_per_s", 1e-5),
    ("p1", "pressure_lift_piston_pa", 1e-5),
    ("p2", "pressure_lift_rod_pa", 1e-5),
    ("F_cyl", "force_lift_n", 1e-5),
    ("theta", "angle_lift_rad", 1e-5),
    ("dtheta", "angular_velocity_lift_rad_per_s", 1e-5),
    ("ddtheta", "angular_acceleration_lift_rad_per_s2", 1e-4),
    ("delta_y", "deflection_tip_y_m", 1e-5),
    ("eps_xy", "strain_tip_xy", 1e-5),
    ("sigma_xx", "stress_root_xx_pa", 1e-5),
];

/// Runs in which the reference itself misses its equations: a step accepted before Newton's method
/// had converged. Put into the trapezoidal law of the pressures, its samples leave 249 Pa in run 37
/// (solution a, step 591) and 1640 Pa in run 21 (solution b, step 117), where the largest remainder
/// of all other steps is 0.04 Pa and ours is 5e-9 Pa.
const UNCONVERGED: [(u64, &str); 2] = [(37, "a"), (21, "b")];

/// Runs whose reference starts before the static solution has converged: with an angular
/// acceleration of 0.028 and 0.037 rad/s² instead of zero, which the trapezoidal rule carries on.
const UNSETTLED_START: [u64; 2] = [0, 11];

struct Reference {
    folder: PathBuf,
    simulator: Simulator,
    runs: Vec<Value>,
    columns: Vec<(String, Vec<f64>)>,
    solution: Vec<String>,
}

fn reference() -> Option<&'static Reference> {
    static LOADED: OnceLock<Option<Reference>> = OnceLock::new();
    let loaded = LOADED.get_or_init(|| {
        let folder = PathBuf::from(std::env::var_os("HYDROFLEX_REFERENCE")?).join("liftboom");
        let mesh = folder.join("Job-1.inp").to_str().unwrap().to_owned();
        let machine = Machine::load("lift-boom-published", &[mesh]).unwrap();
        // Python writes NaN where a run has no convergence figure; JSON knows no such word.
        let text = std::fs::read_to_string(folder.join("runs.json"))
            .unwrap()
            .replace("NaN", "null");
        let runs: Value = serde_json::from_str(&text).unwrap();
        let runs = runs.get("runs").unwrap_or(&runs).as_array().unwrap().clone();
        let (columns, solution) = read_table(&folder.join("trajectories.parquet"));
        Some(Reference {
            folder,
            simulator: Simulator::new(machine).unwrap(),
            runs,
            columns,
            solution,
        })
    });
    if loaded.is_none() {
        eprintln!("HYDROFLEX_REFERENCE is not set: comparison with the reference skipped");
    }
    loaded.as_ref()
}

fn read_table(path: &std::path::Path) -> (Vec<(String, Vec<f64>)>, Vec<String>) {
    let file = std::fs::File::open(path).unwrap();
    let reader = ParquetRecordBatchReaderBuilder::try_new(file)
        .unwrap()
        .build()
        .unwrap();
    let mut columns: Vec<(String, Vec<f64>)> = Vec::new();
    let mut solution = Vec::new();
    for batch in reader {
        let batch = batch.unwrap();
        for (field, column) in batch.schema().fields().iter().zip(batch.columns()) {
            if field.name() == "solution" {
                let text = cast(column, &DataType::Utf8).unwrap();
                solution.extend(text.as_string::<i32>().iter().map(|s| s.unwrap().to_owned()));
                continue;
            }
            let values = cast(column, &DataType::Float64).unwrap();
            let values = values.as_primitive::<Float64Type>().values().to_vec();
            match columns.iter_mut().find(|(name, _)| name == field.name()) {
                Some((_, all)) => all.extend(values),
                None => columns.push((field.name().clone(), values)),
            }
        }
    }
    (columns, solution)
}

impl Reference {
    fn column(&self, name: &str) -> &[f64] {
        &self.columns.iter().find(|(n, _)| n == name).unwrap().1
    }

    /// Values of a column of one run and solution, by step.
    fn series(&self, run: u64, solution: &str, name: &str) -> Vec<f64> {
        let (runs, steps, values) = (self.column("run"), self.column("step"), self.column(name));
        let mut rows: Vec<(f64, f64)> = (0..values.len())
            .filter(|&i| runs[i] as u64 == run && self.solution[i] == solution)
            .map(|i| (steps[i], values[i]))
            .collect();
        rows.sort_by(|a, b| a.0.total_cmp(&b.0));
        rows.into_iter().map(|(_, v)| v).collect()
    }

    fn simulate(&self, run: &Value, integrator: Integrator) -> Trajectory {
        let id = run["run"].as_u64().unwrap();
        let input = RunInput {
            run_id: id,
            payload_kg: run["payload"].as_f64().unwrap(),
            angles_rad: vec![run["theta_in"].as_f64().unwrap().to_radians()],
            valves_ratio: vec![self.series(id, "a", "U")[1..].to_vec()],
        };
        self.simulator
            .run(
                &input,
                &RunSettings {
                    integrator,
                    sample_time_s: 0.005,
                },
            )
            .unwrap()
    }

    /// Compares all runs with a solution; returns what exceeds its bound.
    fn compare(&self, solution: &str, integrator: Integrator, bounds: impl Fn(f64) -> f64) -> Vec<String> {
        let regular = |run: &Value| {
            run["kind"] != "hold"
                && !run["flags"]
                    .as_str()
                    .unwrap_or("")
                    .contains("stroke_cutoff_active")
        };
        // Scale as the judge has it: median range over the regular random runs of the payload.
        let scale = |payload: &Value, column: &str| {
            let mut ranges: Vec<f64> = self
                .runs
                .iter()
                .filter(|r| regular(r) && r["kind"] == "random" && &r["payload"] == payload)
                .map(|r| range(&self.series(r["run"].as_u64().unwrap(), solution, column)))
                .collect();
            ranges.sort_by(f64::total_cmp);
            0.5 * (ranges[(ranges.len() - 1) / 2] + ranges[ranges.len() / 2])
        };
        let mut short = Vec::new();
        for payload in [0, 50, 100].map(Value::from) {
            let scales: Vec<f64> = CHANNELS
                .iter()
                .map(|(theirs, _, _)| scale(&payload, theirs))
                .collect();
            for run in self
                .runs
                .iter()
                .filter(|r| regular(r) && r["payload"].as_f64() == payload.as_f64())
            {
                let id = run["run"].as_u64().unwrap();
                if UNCONVERGED.contains(&(id, solution)) {
                    continue;
                }
                let ours = self.simulate(run, integrator);
                for ((theirs, name, bound), scale) in CHANNELS.iter().zip(&scales) {
                    let index = self
                        .simulator
                        .channels()
                        .iter()
                        .position(|c| &c.name == name)
                        .unwrap();
                    let expected = self.series(id, solution, theirs);
                    assert_eq!(expected.len(), ours.sample_count);
                    let largest = expected
                        .iter()
                        .zip(&ours.columns[index])
                        .fold(0.0_f64, |m, (a, b)| m.max((a - b).abs() / scale));
                    let bound = if *theirs == "ddtheta" && UNSETTLED_START.contains(&id) {
                        // Their initial acceleration over a range of 77 rad/s².
                        6e-4_f64.max(bounds(*bound))
                    } else {
                        bounds(*bound)
                    };
                    if largest > bound || !largest.is_finite() {
                        short.push(format!("run {id} {theirs}: {largest:.2e} exceeds {bound:.0e}"));
                    }
                }
            }
        }
        short
    }
}

fn range(x: &[f64]) -> f64 {
    x.iter().fold(f64::NEG_INFINITY, |m, v| m.max(*v)) - x.iter().fold(f64::INFINITY, |m, v| m.min(*v))
}

#[test]
fn equilibrium_forces_and_pressures_are_the_reference_s() {
    let Some(reference) = reference() else { return };
    let text = std::fs::read_to_string(reference.folder.join("checks.json")).unwrap();
    let checks: Value = serde_json::from_str(&text).unwrap();
    for case in checks["statics"].as_array().unwrap() {
        let number = |key: &str| case[key].as_f64().unwrap();
        let angle = number("theta_in_deg").to_radians();
        let found = reference
            .simulator
            .equilibrium(number("payload"), &[angle])
            .unwrap();
        // Their static solution stops at a tolerance of 1e-7; its forces are good to 3e-3 N.
        assert!(
            (found.lock_forces_n[0] + number("constraint_force")).abs() < 5e-3,
            "{case}"
        );
        assert!((found.pressures_pa[0][0] - number("p1")).abs() < 1.0);
        assert!((found.pressures_pa[0][1] - number("p2")).abs() < 1e-6);
        assert!((found.lengths_m[0] - number("actuator_length")).abs() < 1e-12);
        assert!((found.angles_rad[0].to_degrees() - number("theta_deg")).abs() < 2e-9);
    }
}

#[test]
fn damped_eigenvalues_on_a_locked_actuator_are_the_reference_s() {
    let Some(reference) = reference() else { return };
    let text = std::fs::read_to_string(reference.folder.join("checks.json")).unwrap();
    let checks: Value = serde_json::from_str(&text).unwrap();
    for case in checks["locked_actuator_undamped_Hz"].as_array().unwrap() {
        let angle = case["theta_in_deg"].as_f64().unwrap().to_radians();
        let payload = case["payload"].as_f64().unwrap();
        let found = reference
            .simulator
            .linearise(payload, &[angle], &Actuation::Locked)
            .unwrap();
        for pair in case["damped_oscillating_pairs"].as_array().unwrap() {
            let (re, im) = (pair[0].as_f64().unwrap(), pair[1].as_f64().unwrap());
            let nearest = found
                .eigenvalues_per_s
                .iter()
                .map(|s| (s.re - re).hypot(s.im - im) / re.hypot(im))
                .fold(f64::INFINITY, f64::min);
            // Theirs leaves out the stiffness of the joint forces, a few parts in 1e4 here.
            assert!(nearest < 2e-3, "payload {payload}, {re} {im}: {nearest:e}");
        }
    }
}

#[test]
fn the_published_scheme_gives_solution_a() {
    let Some(reference) = reference() else { return };
    let short = reference.compare("a", Integrator::TrapezoidalIndex2 { step_s: 0.005 }, |bound| {
        bound
    });
    assert!(short.is_empty(), "{short:#?}");
}

#[test]
fn generalised_alpha_gives_solution_b() {
    let Some(reference) = reference() else { return };
    let short = reference.compare("b", Integrator::GeneralizedAlpha { step_s: 0.005 }, |bound| bound);
    assert!(short.is_empty(), "{short:#?}");
}

#[test]
fn accurate_runs_are_within_a_thousandth_of_the_converged_solution() {
    let Some(reference) = reference() else { return };
    let short = reference.compare("c", Integrator::Accurate, |bound| 100.0 * bound);
    assert!(short.is_empty(), "{short:#?}");
}
