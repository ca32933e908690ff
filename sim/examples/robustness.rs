//! Many random runs over a machine's whole range: how many fail, why, and what they cost.
//!
//! `robustness MACHINE RUNS DURATION_S PAYLOAD_KG[,PAYLOAD_KG…] [--mesh BODY=FILE]…`; RUNS is a number, or FROM..TO
//!
//! Configurations and valve signals are those of a job with seed 1. A panic ends the program, a hang shows as the
//! slowest run (processor time); a number that is not finite is counted as such although its run claims success.

#![allow(clippy::print_stdout, reason = "this program's output is its purpose")]

use std::collections::BTreeMap;
use std::time::Instant;

use hydroflex_openapi::job::{Integrator, JobSpec};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::scenario::plan_run;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::RunSettings;
use serde_json::json;

/// Time that this thread has computed: unlike the time of day it does not count what others compute meanwhile. The time of
/// day where the system does not tell.
fn computed_s(start: Instant) -> f64 {
    // Brings the system's count up to date, which otherwise happens every few milliseconds.
    std::thread::yield_now();
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    let nanoseconds = text.split(' ').next().and_then(|word| word.parse::<f64>().ok());
    nanoseconds.map_or_else(|| start.elapsed().as_secs_f64(), |ns| 1e-9 * ns)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [machine, runs, duration_s, payloads, rest @ ..] = arguments.as_slice() else {
        return Err("robustness MACHINE RUNS DURATION_S PAYLOAD_KG[,PAYLOAD_KG…] [--mesh BODY=FILE]…".into());
    };
    let meshes: Vec<String> = rest.iter().filter(|a| *a != "--mesh").cloned().collect();
    let cache = std::env::temp_dir().join("hydroflex-robustness");
    let simulator = Simulator::with_cache(Machine::load(machine, &meshes)?, Some(cache));
    let settings = RunSettings {
        integrator: Integrator::Accurate,
        sample_time_s: 0.005,
    };
    let (from, to) = match runs.split_once("..") {
        Some((from, to)) => (from.parse()?, to.parse()?),
        None => (0, runs.parse::<u64>()?),
    };
    let origin = Instant::now();
    for payload_kg in payloads.split(',') {
        let payload_kg: f64 = payload_kg.parse()?;
        let spec: JobSpec = serde_json::from_value(json!({
            "runs": to, "seed": 1, "payload_kg": payload_kg, "duration_s": duration_s.parse::<f64>()?,
        }))?;
        simulator.prepare(payload_kg > 0.0)?;
        let mut failures: BTreeMap<String, (u64, u64, String)> = BTreeMap::new();
        let mut flags: BTreeMap<&str, u64> = BTreeMap::new();
        let (mut not_finite, mut slowest, mut total_s) = (0_u64, (0.0, 0), 0.0);
        for index in from..to {
            let input = plan_run(&spec, simulator.machine().file(), &simulator, index)?;
            let start_s = computed_s(origin);
            let result = simulator.run(&input, &settings);
            let spent_s = computed_s(origin) - start_s;
            total_s += spent_s;
            if spent_s > slowest.0 {
                slowest = (spent_s, index);
            }
            match result {
                Ok(run) => {
                    if !run.columns.iter().flatten().all(|x| x.is_finite()) {
                        not_finite += 1;
                    }
                    for flag in run.flags {
                        *flags.entry(flag.as_str()).or_default() += 1;
                    }
                }
                Err(failure) => {
                    let text = failure.to_string();
                    // The reason without its numbers.
                    let kind: String = text
                        .split(|c: char| c.is_ascii_digit())
                        .next()
                        .unwrap_or_default()
                        .to_owned();
                    let entry = failures.entry(kind).or_insert((0, index, text));
                    entry.0 += 1;
                }
            }
        }
        let failed: u64 = failures.values().map(|f| f.0).sum();
        println!(
            "{machine}, {payload_kg} kg: {failed} of {} runs of {duration_s} s failed, {not_finite} with numbers that are not \
             finite; mean {:.3} ms, slowest {:.1} ms (run {}); {:?}; flags {flags:?}",
            to - from,
            1e3 * total_s / (to - from) as f64,
            1e3 * slowest.0,
            slowest.1,
            simulator.accurate_path(payload_kg > 0.0)?,
        );
        for (count, first, text) in failures.values() {
            println!("  {count} runs, first {first}: {text}");
        }
    }
    Ok(())
}
