//! Simulates runs given as JSON and writes their channels as JSON: for experiments and profiles.
//!
//! `run_table MACHINE RUNS.json OUT.json INTEGRATOR [--mesh BODY=FILE]…`
//!
//! Runs: `[{"run_id": 0, "payload_kg": 0, "angles_rad": [..], "valves_ratio": [[..], ..]}, ..]`.

#![allow(clippy::print_stdout, reason = "this program's output is its purpose")]

use std::time::Instant;

use hydroflex_openapi::job::Integrator;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::{RunInput, RunSettings};
use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;
use serde_json::{Value, json};

/// User time of this thread, µs.
fn processor_us() -> nix::Result<i64> {
    // Linux brings a running thread's account up to date at ticks of some milliseconds, and when it yields.
    std::thread::yield_now();
    Ok(getrusage(UsageWho::RUSAGE_THREAD)?.user_time().num_microseconds())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [machine, runs, out, integrator, rest @ ..] = arguments.as_slice() else {
        return Err("run_table MACHINE RUNS.json OUT.json INTEGRATOR [--mesh BODY=FILE]…".into());
    };
    let meshes: Vec<String> = rest.iter().filter(|a| *a != "--mesh").cloned().collect();
    let simulator = Simulator::with_cache(
        Machine::load(machine, &meshes)?,
        Some(std::env::temp_dir().join("hydroflex-run-table")),
    );
    let integrator: Integrator = serde_json::from_value(json!({ "kind": integrator }))?;
    let settings = RunSettings {
        integrator,
        sample_time_s: 0.005,
    };
    let numbers = |v: &Value| -> Vec<f64> {
        let list = v.as_array().into_iter().flatten();
        list.filter_map(Value::as_f64).collect()
    };
    let mut results = Vec::new();
    let table: Vec<Value> = serde_json::from_str(&std::fs::read_to_string(runs)?)?;
    for run in &table {
        let input = RunInput {
            run_id: run["run_id"].as_u64().unwrap_or_default(),
            payload_kg: run["payload_kg"].as_f64().unwrap_or_default(),
            angles_rad: numbers(&run["angles_rad"]),
            valves_ratio: run["valves_ratio"]
                .as_array()
                .into_iter()
                .flatten()
                .map(numbers)
                .collect(),
        };
        simulator.prepare(input.payload_kg > 0.0)?;
        let (start, processor_start_us) = (Instant::now(), processor_us()?);
        let result = simulator.run(&input, &settings);
        let spent_s = start.elapsed().as_secs_f64();
        let processor_ms = 1e-3 * (processor_us()? - processor_start_us) as f64;
        match result {
            Ok(run) => {
                println!(
                    "run {}: {:.2} ms ({processor_ms:.2} ms of the processor), {:?} {:?}",
                    input.run_id,
                    1e3 * spent_s,
                    run.flags,
                    run.statistics
                );
                let names = simulator.channels().iter().map(|c| c.name.clone());
                let columns: serde_json::Map<String, Value> =
                    names.zip(run.columns.iter().map(|c| json!(c))).collect();
                results.push(json!({ "run_id": input.run_id, "columns": columns }));
            }
            Err(failure) => println!("run {}: {failure}", input.run_id),
        }
    }
    std::fs::write(out, serde_json::to_string(&results)?)?;
    Ok(())
}
