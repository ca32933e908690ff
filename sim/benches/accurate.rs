//! Cost of an accurate run of 1 s (200 samples of 5 ms, every channel recorded), alone and in a batch.
//!
//! ```text
//! cargo bench -p hydroflex-sim --bench accurate
//! HYDROFLEX_REFERENCE=DIR cargo bench -p hydroflex-sim --bench accurate
//! ```
//!
//! The first measures the built-in boom with random runs as a job plans them. The second takes the
//! published boom with the random runs of the reference, and adds the largest error of each channel
//! against its converged solution (over the median range of the channel, random runs of the payload).
//!
//! `-- --machine FILE --mesh FILE` take another one-cylinder machine, `--json` prints one line per payload
//! for `sim/validation/benchmark_exudyn.py`.
//!
//! Processor time of the measuring thread, smallest of several repetitions, warm: the machine is
//! reduced; the modes of the payload are found anew in every single run and once in a batch. The
//! static start is inside, the planning of signals is not. The published schemes, on the general path,
//! take steps of 5 ms.

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::compute::{cast, concat_batches};
use arrow::datatypes::{DataType, Float64Type};
use hydroflex_openapi::job::{Integrator, JobSpec};
use hydroflex_sim::fast::{InstructionSet, PlanarModel, Workspace};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::scenario::plan_run;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::{ACCURATE_TOLERANCE, RunInput, RunSettings, Trajectory};
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use std::path::{Path, PathBuf};

/// Runs per measurement: eight rounds of eight lanes.
const RUNS: u32 = 64;
const REPETITIONS: usize = 15;
/// Runs per measurement of the published schemes.
const GENERAL_RUNS: usize = 8;
const SAMPLE_S: f64 = 0.005;

/// Our column and the reference's.
const CHANNELS: [(usize, &str); 11] = [
    (1, "s"),
    (2, "ds"),
    (3, "p1"),
    (4, "p2"),
    (5, "F_cyl"),
    (6, "theta"),
    (7, "dtheta"),
    (8, "ddtheta"),
    (10, "delta_y"),
    (12, "eps_xy"),
    (13, "sigma_xx"),
];

/// Processor time of this thread, µs.
fn processor_us() -> f64 {
    // Linux brings a running thread's account up to date at ticks of some milliseconds, and when it yields.
    std::thread::yield_now();
    let usage = getrusage(UsageWho::RUSAGE_THREAD).expect("getrusage knows this thread");
    (usage.user_time().num_microseconds() + usage.system_time().num_microseconds()) as f64
}

fn best_us(runs: usize, mut work: impl FnMut()) -> f64 {
    (0..REPETITIONS)
        .map(|_| {
            let start = processor_us();
            work();
            (processor_us() - start) / runs as f64
        })
        .fold(f64::INFINITY, f64::min)
}

fn read(path: &Path) -> RecordBatch {
    let file = std::fs::File::open(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let reader = ParquetRecordBatchReaderBuilder::try_new(file).expect("a Parquet file");
    let schema = reader.schema().clone();
    let batches: Vec<RecordBatch> = reader
        .build()
        .expect("a reader")
        .map(|batch| batch.expect("a batch"))
        .collect();
    concat_batches(&schema, &batches).expect("batches of one schema")
}

fn numbers(batch: &RecordBatch, column: &str) -> Vec<f64> {
    let column = batch
        .column_by_name(column)
        .unwrap_or_else(|| panic!("no column {column}"));
    let column = cast(column, &DataType::Float64).expect("numbers");
    column.as_primitive::<Float64Type>().values().to_vec()
}

fn texts(batch: &RecordBatch, column: &str) -> Vec<String> {
    let column = batch
        .column_by_name(column)
        .unwrap_or_else(|| panic!("no column {column}"));
    let column = cast(column, &DataType::Utf8).expect("text");
    let column = column.as_string::<i32>();
    (0..column.len()).map(|i| column.value(i).to_owned()).collect()
}

/// A random run of the reference and its converged solution, columns as in [`CHANNELS`].
struct Converged {
    input: RunInput,
    columns: Vec<Vec<f64>>,
}

fn reference(folder: &Path) -> Vec<Converged> {
    let runs = read(&folder.join("runs.parquet"));
    let rows = read(&folder.join("trajectories.parquet"));
    let (of_run, solution, valve) = (
        numbers(&rows, "run"),
        texts(&rows, "solution"),
        numbers(&rows, "U"),
    );
    let channels: Vec<Vec<f64>> = CHANNELS.iter().map(|(_, name)| numbers(&rows, name)).collect();
    let (ids, kinds, flags) = (numbers(&runs, "run"), texts(&runs, "kind"), texts(&runs, "flags"));
    let (payloads, angles) = (numbers(&runs, "payload"), numbers(&runs, "theta_in"));
    (0..ids.len())
        .filter(|&i| kinds[i] == "random" && !flags[i].contains("stroke_cutoff"))
        .map(|i| {
            let of_this: Vec<usize> = (0..of_run.len())
                .filter(|&row| (of_run[row] - ids[i]).abs() < 0.5 && solution[row] == "c")
                .collect();
            let pick = |column: &Vec<f64>| -> Vec<f64> { of_this.iter().map(|&row| column[row]).collect() };
            Converged {
                input: RunInput {
                    run_id: i as u64,
                    payload_kg: payloads[i],
                    angles_rad: vec![angles[i].to_radians()],
                    valves_ratio: vec![pick(&valve)[1..].to_vec()],
                },
                columns: channels.iter().map(pick).collect(),
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

/// Largest error of each channel over the runs, over the channel's median range.
fn errors(runs: &[&Converged], ours: &[Trajectory]) -> Vec<String> {
    let largest = |k: usize| {
        let scale = median(runs.iter().map(|r| range(&r.columns[k])).collect());
        let off = |(run, ours): (&&Converged, &Trajectory)| {
            let pairs = run.columns[k].iter().zip(&ours.columns[CHANNELS[k].0]);
            pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) / scale
        };
        runs.iter().zip(ours).map(off).fold(0.0, f64::max)
    };
    (0..CHANNELS.len())
        .map(|k| format!("{} {:.1e}", CHANNELS[k].1, largest(k)))
        .collect()
}

/// Random runs of a job with this payload, a number or a range.
fn planned(simulator: &Simulator, payload_kg: &serde_json::Value) -> Vec<RunInput> {
    let spec: JobSpec = serde_json::from_value(serde_json::json!({
        "runs": RUNS, "seed": 7, "payload_kg": payload_kg,
    }))
    .expect("a valid job");
    let file = simulator.machine().file();
    (0..u64::from(RUNS))
        .map(|index| plan_run(&spec, file, simulator, index).expect("a valid plan"))
        .collect()
}

/// What the runs of one payload cost, µs each.
struct Cost {
    payload_kg: f64,
    alone: f64,
    batch: Vec<(InstructionSet, f64)>,
    trapezoidal: f64,
    generalized_alpha: f64,
    steps: f64,
    rejected: f64,
    factorisations: f64,
    errors: Vec<String>,
}

fn measure(simulator: &Simulator, payload_kg: f64, converged: &[Converged]) -> Cost {
    let with_payload = payload_kg > 0.0;
    let body = &simulator.reduced(with_payload).expect("the body reduces")[0];
    let model =
        PlanarModel::new(simulator.machine().file(), body, with_payload).expect("the machine is planar");
    let known: Vec<&Converged> = converged
        .iter()
        .filter(|r| (r.input.payload_kg - payload_kg).abs() < 0.5)
        .collect();
    let inputs: Vec<RunInput> = if known.is_empty() {
        planned(simulator, &serde_json::json!(payload_kg))
    } else {
        let mut endless = known.iter().cycle();
        (0..RUNS)
            .filter_map(|_| endless.next())
            .map(|r| r.input.clone())
            .collect()
    };
    let mut ws = Workspace::default();
    let runs: Vec<Trajectory> = model
        .run_batch(&inputs, SAMPLE_S, ACCURATE_TOLERANCE, &mut ws)
        .into_iter()
        .map(|run| run.expect("the run ends"))
        .collect();
    let mean =
        |count: &dyn Fn(&Trajectory) -> u64| runs.iter().map(count).sum::<u64>() as f64 / runs.len() as f64;
    let alone = best_us(inputs.len(), || {
        for input in &inputs {
            let run = model.run(input, SAMPLE_S, ACCURATE_TOLERANCE, &mut Workspace::default());
            std::hint::black_box(&run);
        }
    });
    let batch = InstructionSet::available()
        .into_iter()
        .map(|set| {
            let us = best_us(inputs.len(), || {
                let runs = model.run_batch_on(set, &inputs, SAMPLE_S, ACCURATE_TOLERANCE, &mut ws);
                std::hint::black_box(&runs);
            });
            (set, us)
        })
        .collect();
    let general = |integrator| {
        let settings = RunSettings {
            integrator,
            sample_time_s: SAMPLE_S,
        };
        best_us(GENERAL_RUNS, || {
            for input in &inputs[..GENERAL_RUNS] {
                std::hint::black_box(&simulator.run(input, &settings));
            }
        })
    };
    Cost {
        payload_kg,
        alone,
        batch,
        trapezoidal: general(Integrator::TrapezoidalIndex2 { step_s: SAMPLE_S }),
        generalized_alpha: general(Integrator::GeneralizedAlpha { step_s: SAMPLE_S }),
        steps: mean(&|r| r.statistics.steps),
        rejected: mean(&|r| r.statistics.rejected),
        factorisations: mean(&|r| r.statistics.factorisations),
        errors: if known.is_empty() {
            Vec::new()
        } else {
            errors(&known, &runs[..known.len()])
        },
    }
}

#[allow(clippy::print_stdout, reason = "a benchmark reports on standard output")]
fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let value_of = |name: &str| {
        let at = arguments.iter().position(|a| a == name)?;
        arguments.get(at + 1).cloned()
    };
    let json = arguments.iter().any(|a| a == "--json");
    let reference_folder = std::env::var_os("HYDROFLEX_REFERENCE").map(|f| PathBuf::from(f).join("liftboom"));
    let (name, meshes, folder) = match (value_of("--machine"), &reference_folder) {
        (Some(machine), _) => (machine, value_of("--mesh").into_iter().collect(), None),
        (None, Some(folder)) => {
            let mesh = folder.join("Job-1.inp").display().to_string();
            ("lift-boom-published".to_owned(), vec![mesh], Some(folder))
        }
        (None, None) => ("lift-boom".to_owned(), Vec::new(), None),
    };
    let converged = folder.map(|folder| reference(folder)).unwrap_or_default();
    let machine = Machine::load(&name, &meshes).expect("the machine loads");
    let simulator = Simulator::new(machine).expect("it is complete");
    if !json {
        println!("{name}, {RUNS} random runs of 1 s, µs of processor time per run");
    }
    for payload_kg in [0.0, 50.0, 100.0] {
        let cost = measure(&simulator, payload_kg, &converged);
        if json {
            let batch = cost.batch.last().map_or(f64::NAN, |(_, us)| *us);
            let set = cost.batch.last().map(|(set, _)| format!("{set:?}"));
            println!(
                "{}",
                serde_json::json!({
                    "payload_kg": cost.payload_kg,
                    "alone_us": cost.alone,
                    "batch_us": batch,
                    "instruction_set": set,
                    "trapezoidal_us": cost.trapezoidal,
                    "generalized_alpha_us": cost.generalized_alpha,
                    "steps": cost.steps,
                })
            );
            continue;
        }
        let batch: Vec<String> = cost
            .batch
            .iter()
            .map(|(set, us)| format!("{set:?} {us:.0}"))
            .collect();
        println!(
            "{payload_kg:3} kg: alone {:.0}; batch {}; {:.0} steps, {:.1} rejected, {:.0} factorisations; \
             trapezoidal-index-2 {:.0}, generalized-alpha {:.0}",
            cost.alone,
            batch.join(", "),
            cost.steps,
            cost.rejected,
            cost.factorisations,
            cost.trapezoidal,
            cost.generalized_alpha,
        );
        if !cost.errors.is_empty() {
            println!("        largest error: {}", cost.errors.join(", "));
        }
    }
    if !json {
        // A payload of its own for every run: the modes are found anew for each.
        let inputs = planned(&simulator, &serde_json::json!({ "min": 1.0, "max": 100.0 }));
        let body = &simulator.reduced(true).expect("the body reduces")[0];
        let model = PlanarModel::new(simulator.machine().file(), body, true).expect("the machine is planar");
        let mut ws = Workspace::default();
        let batch = best_us(inputs.len(), || {
            std::hint::black_box(&model.run_batch(&inputs, SAMPLE_S, ACCURATE_TOLERANCE, &mut ws));
        });
        let alone = best_us(inputs.len(), || {
            for input in &inputs {
                let run = model.run(input, SAMPLE_S, ACCURATE_TOLERANCE, &mut Workspace::default());
                std::hint::black_box(&run);
            }
        });
        println!("1 to 100 kg: alone {alone:.0}; batch {batch:.0}");
    }
}
