//! The accurate integrator of planar machines against the converged solution of an independent
//! solver.
//!
//! `HYDROFLEX_REFERENCE` names the folder with `liftboom/runs.parquet` and
//! `liftboom/trajectories.parquet` (Exudyn 1.13.6); without it the comparison passes and says so.

#![allow(
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::compute::{cast, concat_batches};
use arrow::datatypes::{DataType, Float64Type};
use hydroflex_sim::fast::{PlanarModel, Workspace};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::{AccuratePath, Simulator};
use hydroflex_sim::trajectory::RunInput;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use std::path::{Path, PathBuf};

const SAMPLE_S: f64 = 0.005;

/// Our column, the reference's name, and whether its bound is ten times the tolerance.
const CHANNELS: [(usize, &str, bool); 12] = [
    (0, "U", false),
    (1, "s", false),
    (2, "ds", false),
    (3, "p1", false),
    (4, "p2", false),
    (5, "F_cyl", false),
    (6, "theta", false),
    (7, "dtheta", false),
    (8, "ddtheta", true),
    (10, "delta_y", false),
    (12, "eps_xy", false),
    (13, "sigma_xx", false),
];

fn read(path: &Path) -> RecordBatch {
    let file = std::fs::File::open(path).unwrap();
    let reader = ParquetRecordBatchReaderBuilder::try_new(file).unwrap();
    let schema = reader.schema().clone();
    let batches: Vec<RecordBatch> = reader.build().unwrap().map(Result::unwrap).collect();
    concat_batches(&schema, &batches).unwrap()
}

fn numbers(batch: &RecordBatch, column: &str) -> Vec<f64> {
    let column = cast(batch.column_by_name(column).unwrap(), &DataType::Float64).unwrap();
    column.as_primitive::<Float64Type>().values().to_vec()
}

fn texts(batch: &RecordBatch, column: &str) -> Vec<String> {
    let column = cast(batch.column_by_name(column).unwrap(), &DataType::Utf8).unwrap();
    let column = column.as_string::<i32>();
    (0..column.len()).map(|i| column.value(i).to_owned()).collect()
}

/// A run of the reference with its converged solution `c`, columns as in [`CHANNELS`].
struct ReferenceRun {
    kind: String,
    flagged: bool,
    input: RunInput,
    columns: Vec<Vec<f64>>,
}

fn reference(folder: &Path) -> Vec<ReferenceRun> {
    let runs = read(&folder.join("runs.parquet"));
    let rows = read(&folder.join("trajectories.parquet"));
    let (of_run, solution) = (numbers(&rows, "run"), texts(&rows, "solution"));
    let channels: Vec<Vec<f64>> = CHANNELS.iter().map(|(_, name, _)| numbers(&rows, name)).collect();
    let (ids, kinds, flags) = (numbers(&runs, "run"), texts(&runs, "kind"), texts(&runs, "flags"));
    let (payloads, angles) = (numbers(&runs, "payload"), numbers(&runs, "theta_in"));
    (0..ids.len())
        .map(|i| {
            let of_this: Vec<usize> = (0..of_run.len())
                .filter(|&row| (of_run[row] - ids[i]).abs() < 0.5 && solution[row] == "c")
                .collect();
            let columns: Vec<Vec<f64>> = channels
                .iter()
                .map(|c| of_this.iter().map(|&row| c[row]).collect())
                .collect();
            ReferenceRun {
                kind: kinds[i].clone(),
                flagged: flags[i].contains("stroke_cutoff"),
                input: RunInput {
                    run_id: i as u64,
                    payload_kg: payloads[i],
                    angles_rad: vec![angles[i].to_radians()],
                    valves_ratio: vec![columns[0][1..].to_vec()],
                },
                columns,
            }
        })
        .collect()
}

fn range(values: &[f64]) -> f64 {
    let most = values.iter().fold(f64::NEG_INFINITY, |a, &b| a.max(b));
    let least = values.iter().fold(f64::INFINITY, |a, &b| a.min(b));
    most - least
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    0.5 * (values[(n - 1) / 2] + values[n / 2])
}

/// Every channel of every unflagged run stays within the tolerance of the median range of that
/// channel over the random runs of the same payload, accelerations within ten times as much (2e-3 at least): at the
/// default tolerance 1e-3 and at 1e-4, the two that are promised. `c` itself is good to 1e-5.
#[test]
fn meets_its_tolerance_against_the_converged_reference() {
    let Some(folder) = std::env::var_os("HYDROFLEX_REFERENCE") else {
        eprintln!("HYDROFLEX_REFERENCE is not set: comparison with the reference skipped");
        return;
    };
    let folder = PathBuf::from(folder).join("liftboom");
    let mesh = folder.join("Job-1.inp").to_string_lossy().into_owned();
    let simulator = Simulator::new(Machine::load("lift-boom-published", &[mesh]).unwrap()).unwrap();
    let runs = reference(&folder);
    let models = [false, true].map(|payload| {
        assert_eq!(simulator.accurate_path(payload).unwrap(), AccuratePath::Planar);
        let body = &simulator.reduced(payload).unwrap()[0];
        PlanarModel::new(simulator.machine().file(), body, payload).unwrap()
    });
    for tolerance in [1e-3, 1e-4] {
        for payload_kg in [0.0, 50.0, 100.0] {
            let of_payload: Vec<&ReferenceRun> = runs
                .iter()
                .filter(|r| (r.input.payload_kg - payload_kg).abs() < 0.5 && !r.flagged)
                .collect();
            let inputs: Vec<RunInput> = of_payload.iter().map(|r| r.input.clone()).collect();
            let model = &models[usize::from(payload_kg > 0.0)];
            let results = model.run_batch(&inputs, SAMPLE_S, tolerance, &mut Workspace::default());
            for (k, (ours, name, loose)) in CHANNELS.iter().enumerate() {
                let random = of_payload.iter().filter(|r| r.kind == "random");
                let scale = median(random.map(|r| range(&r.columns[k])).collect());
                // `c` itself is good to 2e-3 in accelerations (its own step halving).
                let bound = if *loose {
                    (10.0 * tolerance).max(2e-3)
                } else {
                    tolerance
                };
                for (run, result) in of_payload.iter().zip(&results) {
                    let column = &result.as_ref().unwrap().columns[*ours];
                    assert_eq!(column.len(), run.columns[k].len());
                    if run.kind == "hold" {
                        // A shut valve: the machine stays where it is, to the last digits.
                        assert!(
                            range(column) <= 1e-9 * scale,
                            "{name} moves in run {}",
                            run.input.run_id
                        );
                    }
                    let from = if run.kind == "hold" { &column[..1] } else { column };
                    let error = from
                        .iter()
                        .zip(&run.columns[k])
                        .map(|(a, b)| (a - b).abs())
                        .fold(0.0, f64::max);
                    assert!(
                        error <= bound * scale,
                        "run {} {name}: {:.2e} of range, bound {bound:.0e}",
                        run.input.run_id,
                        error / scale
                    );
                }
            }
        }
    }
}
