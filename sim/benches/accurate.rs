//! Cost of an accurate run of 1 s (200 samples of 5 ms, all channels recorded), alone and in a
//! batch: `cargo bench -p hydroflex-sim --bench accurate`.
//!
//! The built-in boom; with `HYDROFLEX_REFERENCE` the published one. Processor time of this thread,
//! best of several repetitions, warm: machine reduced, modes of the payload known in a batch and
//! found anew in every single run. Random runs as a job plans them, signals given.

use hydroflex_openapi::job::JobSpec;
use hydroflex_sim::fast::{InstructionSet, PlanarModel, TOLERANCE, Workspace};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::scenario::plan_run;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::RunInput;
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;

const RUNS: u64 = 64;
const REPETITIONS: usize = 15;
const SAMPLE_S: f64 = 0.005;

/// Processor time of this thread, µs.
fn processor_us() -> f64 {
    let usage = getrusage(UsageWho::RUSAGE_THREAD).expect("getrusage knows this thread");
    (usage.user_time().num_microseconds() + usage.system_time().num_microseconds()) as f64
}

fn best_us(mut work: impl FnMut()) -> f64 {
    (0..REPETITIONS)
        .map(|_| {
            let start = processor_us();
            work();
            (processor_us() - start) / RUNS as f64
        })
        .fold(f64::INFINITY, f64::min)
}

fn simulator() -> Simulator {
    let (name, meshes) = match std::env::var("HYDROFLEX_REFERENCE") {
        Ok(folder) => (
            "lift-boom-published",
            vec![format!("{folder}/liftboom/Job-1.inp")],
        ),
        Err(_) => ("lift-boom", Vec::new()),
    };
    let machine = Machine::load(name, &meshes).expect("the machine loads");
    Simulator::new(machine).expect("the machine is complete")
}

#[allow(clippy::print_stdout, reason = "a benchmark reports on standard output")]
fn main() {
    let simulator = simulator();
    let file = simulator.machine().file().clone();
    println!(
        "{}, {RUNS} random runs of 1 s, µs of processor time per run",
        file.name
    );
    println!("payload | steps rejected | alone | batch by instruction set");
    for payload_kg in [0.0, 50.0, 100.0] {
        let spec: JobSpec = serde_json::from_value(serde_json::json!({
            "runs": RUNS, "seed": 7, "payload_kg": payload_kg,
        }))
        .expect("a valid job");
        let inputs: Vec<RunInput> = (0..RUNS)
            .map(|index| plan_run(&spec, &file, index).expect("a valid plan"))
            .collect();
        let with_payload = payload_kg > 0.0;
        let body = &simulator.reduced(with_payload).expect("the body reduces")[0];
        let model = PlanarModel::new(&file, body, with_payload).expect("the machine is planar");
        let mut ws = Workspace::default();
        let (mut steps, mut rejected) = (0, 0);
        for run in model.run_batch(&inputs, SAMPLE_S, TOLERANCE, &mut ws) {
            let statistics = run.expect("the run ends").statistics;
            steps += statistics.steps;
            rejected += statistics.rejected;
        }
        let alone = best_us(|| {
            for input in &inputs {
                let run = model.run(input, SAMPLE_S, TOLERANCE, &mut Workspace::default());
                std::hint::black_box(&run);
            }
        });
        let batch: Vec<String> = InstructionSet::available()
            .into_iter()
            .map(|set| {
                let us = best_us(|| {
                    let runs = model.run_batch_on(set, &inputs, SAMPLE_S, TOLERANCE, &mut ws);
                    std::hint::black_box(&runs);
                });
                format!("{set:?} {us:.0}")
            })
            .collect();
        println!(
            "{payload_kg:3} kg | {:.0} {:.0} | {alone:.0} | {}",
            steps as f64 / RUNS as f64,
            rejected as f64 / RUNS as f64,
            batch.join(", ")
        );
    }
}
