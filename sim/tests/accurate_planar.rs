//! The accurate integrator of planar machines: against the converged reference solution, against
//! the general path, and run for run the same in any company.
//!
//! `HYDROFLEX_REFERENCE` names the folder with `liftboom/runs.parquet` and
//! `liftboom/trajectories.parquet` (Exudyn 1.13.6); without it the comparison passes and says so.

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::compute::{cast, concat_batches};
use arrow::datatypes::{DataType, Float64Type};
use hydroflex_openapi::job::{Integrator, RunFlag};
use hydroflex_sim::fast::{InstructionSet, PlanarModel, Workspace};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::{AccuratePath, Simulator};
use hydroflex_sim::trajectory::{RunInput, RunSettings, Trajectory};
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
/// channel over the random runs of the same payload, accelerations within ten times as much: at the
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
                let bound = if *loose { 10.0 * tolerance } else { tolerance };
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

/// Numbers that repeat: a multiplicative congruential generator, upper bits.
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// A run with a random pose and a signal of steps, ramps and noise.
fn random_run(run_id: u64, payload_kg: f64, samples: usize) -> RunInput {
    let mut x = Numbers(run_id.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
    x.next();
    let angle = (-10.0 + 60.0 * x.next()).to_radians();
    let mut valve = Vec::with_capacity(samples);
    while valve.len() < samples {
        let length = 1 + (x.next() * 25.0) as usize;
        let (kind, from, to) = (x.next(), 2.0 * x.next() - 1.0, 2.0 * x.next() - 1.0);
        for k in 0..length {
            valve.push(match kind {
                k if k < 0.2 => 1.0,
                k if k < 0.4 => -1.0,
                k if k < 0.6 => 0.0,
                k if k < 0.8 => 2.0 * x.next() - 1.0,
                _ => from + (to - from) * k as f64 / length as f64,
            });
        }
    }
    valve.truncate(samples);
    RunInput {
        run_id,
        payload_kg,
        angles_rad: vec![angle],
        valves_ratio: vec![valve],
    }
}

fn built_in() -> Simulator {
    Simulator::new(Machine::load("lift-boom", &[]).unwrap()).unwrap()
}

const ACCURATE: RunSettings = RunSettings {
    integrator: Integrator::Accurate,
    sample_time_s: SAMPLE_S,
};

fn bits(run: &Trajectory) -> Vec<u64> {
    run.columns.iter().flatten().map(|x| x.to_bits()).collect()
}

/// A run's numbers are the same alone, among seven others, on every instruction set, and whatever
/// the others are.
#[test]
fn neighbours_and_registers_change_no_bit() {
    let simulator = built_in();
    let inputs: Vec<RunInput> = (0..11)
        .map(|i| random_run(i, if i % 3 == 0 { 80.0 } else { 0.0 }, 20 + i as usize))
        .collect();
    let alone: Vec<_> = inputs
        .iter()
        .map(|i| simulator.run(i, &ACCURATE).unwrap())
        .collect();
    let together = simulator.run_batch(&inputs, &ACCURATE);
    for (a, b) in alone.iter().zip(&together) {
        let b = b.as_ref().unwrap();
        assert_eq!(bits(a), bits(b));
        assert_eq!((a.flags.clone(), a.statistics), (b.flags.clone(), b.statistics));
    }
    let body = &simulator.reduced(false).unwrap()[0];
    let model = PlanarModel::new(simulator.machine().file(), body, false).unwrap();
    let some: Vec<RunInput> = inputs
        .iter()
        .filter(|i| i.payload_kg == 0.0)
        .rev()
        .cloned()
        .collect();
    for set in InstructionSet::available() {
        let results = model.run_batch_on(
            set,
            &some,
            SAMPLE_S,
            hydroflex_sim::fast::TOLERANCE,
            &mut Workspace::default(),
        );
        for (input, result) in some.iter().zip(results) {
            assert_eq!(
                bits(&alone[input.run_id as usize]),
                bits(&result.unwrap()),
                "{set:?}"
            );
        }
    }
}

/// Random runs over the whole range of poses, payloads and signals end, with finite numbers, and a
/// chamber never below vapour pressure. `HYDROFLEX_RUNS` asks for more of them.
#[test]
fn random_runs_end_with_finite_numbers() {
    let runs: u64 = std::env::var("HYDROFLEX_RUNS")
        .ok()
        .and_then(|n| n.parse().ok())
        .unwrap_or(150);
    let simulator = built_in();
    let cylinder = &simulator.machine().file().cylinders[0];
    let floor = cylinder.fluid.vapour_pressure_pa.unwrap_or(f64::NEG_INFINITY);
    let inputs: Vec<RunInput> = (0..runs)
        .map(|i| random_run(1000 + i, [0.0, 50.0, 100.0, 200.0][i as usize % 4], 200))
        .collect();
    let (mut failed, mut flags) = (0_u64, std::collections::BTreeMap::<RunFlag, u64>::new());
    for (input, result) in inputs.iter().zip(simulator.run_batch(&inputs, &ACCURATE)) {
        let run = match result {
            Ok(run) => run,
            Err(reason) => {
                eprintln!("run {}: {reason}", input.run_id);
                failed += 1;
                continue;
            }
        };
        assert_eq!(run.sample_count, 201);
        for column in &run.columns {
            assert_eq!(column.len(), 201);
            assert!(column.iter().all(|x| x.is_finite()), "run {}", input.run_id);
        }
        for chamber in [3, 4] {
            assert!(
                run.columns[chamber].iter().all(|&p| p >= floor),
                "run {}",
                input.run_id
            );
        }
        for flag in run.flags {
            *flags.entry(flag).or_default() += 1;
        }
    }
    eprintln!("{failed} of {runs} failed; flags {flags:?}");
    assert_eq!(failed, 0);
}
