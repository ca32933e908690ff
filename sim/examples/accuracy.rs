//! How far `accurate` is from converged over many random runs of a one-cylinder machine, and where.
//!
//! `accuracy MACHINE RUNS SEED PAYLOAD_KG[,PAYLOAD_KG…] [--mesh BODY=FILE]… [--second RUNS STEP_S] [--worst N]`
//!
//! Runs of 1 s as a job with that seed plans them. Converged is the same method at tolerance 1e-6, every mode
//! with all its terms; `--second` compares the first RUNS of each payload with the general path's
//! trapezoidal rule too. Errors are the largest over a run, over the median range of the channel.

#![allow(
    clippy::print_stdout,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "this program's output is its purpose; its numbers are small"
)]

use hydroflex_openapi::job::{Integrator, JobSpec};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::scenario::plan_run;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::{RunFailure, RunInput, RunSettings, Trajectory};
use rayon::prelude::*;
use serde_json::json;

const SAMPLE_S: f64 = 0.005;
/// Tolerance of what counts as converged, if none is given.
const CONVERGED: f64 = 1e-6;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let mut positional = Vec::new();
    let mut meshes = Vec::new();
    let (mut second, mut worst, mut tight) = (None, 3, CONVERGED);
    let mut next = |name: &str| arguments.next().ok_or(format!("{name} is missing"));
    while let Ok(argument) = next("") {
        match argument.as_str() {
            "--mesh" => meshes.push(next("--mesh BODY=FILE")?),
            "--second" => {
                second = Some((next("--second RUNS")?.parse()?, next("--second STEP_S")?.parse()?));
            }
            "--converged" => tight = next("--converged TOLERANCE")?.parse()?,
            "--worst" => worst = next("--worst N")?.parse()?,
            _ => positional.push(argument),
        }
    }
    let [machine, runs, seed, payloads] = positional.as_slice() else {
        return Err("accuracy MACHINE RUNS SEED PAYLOAD_KG[,PAYLOAD_KG…] [options]".into());
    };
    let cache = std::env::temp_dir().join("hydroflex-accuracy");
    let simulator = Simulator::with_cache(Machine::load(machine, &meshes)?, Some(cache));
    for payload_kg in payloads.split(',') {
        let payload_kg: f64 = payload_kg.parse()?;
        let spec: JobSpec = serde_json::from_value(json!({
            "runs": runs.parse::<u64>()?, "seed": seed.parse::<u64>()?, "payload_kg": payload_kg,
        }))?;
        let inputs: Vec<RunInput> = (0..spec.runs)
            .map(|index| plan_run(&spec, simulator.machine().file(), &simulator, index))
            .collect::<Result<_, _>>()?;
        simulator.prepare(payload_kg > 0.0)?;
        let settings = RunSettings {
            integrator: Integrator::Accurate,
            sample_time_s: SAMPLE_S,
        };
        let each = |run: &(dyn Fn(&RunInput) -> Result<Trajectory, RunFailure> + Sync)| {
            finished(inputs.par_iter().map(run).collect())
        };
        let ours = each(&|input| simulator.run(input, &settings));
        let converged = each(&|input| simulator.run_to(input, SAMPLE_S, tight));
        let count = ours.len().max(1) as f64;
        let mean =
            |of: &dyn Fn(&Trajectory) -> u64| ours.iter().flatten().map(of).sum::<u64>() as f64 / count;
        println!(
            "{machine}, {payload_kg} kg, {} runs with seed {seed}, {:?} path: {:.0} steps, {:.1} rejected, {:.0} factorisations a run",
            inputs.len(),
            simulator.solver_path(Integrator::Accurate, payload_kg > 0.0)?,
            mean(&|run| run.statistics.steps),
            mean(&|run| run.statistics.rejected),
            mean(&|run| run.statistics.factorisations),
        );
        println!("  against tolerance {tight:e}:");
        let scales = report(&simulator, &inputs, &ours, &converged, worst, None);
        if let Some((few, step_s)) = second {
            let few: usize = few;
            let settings = RunSettings {
                integrator: Integrator::TrapezoidalIndex2 { step_s },
                sample_time_s: SAMPLE_S,
            };
            let few = few.min(inputs.len());
            let other: Vec<_> = inputs[..few]
                .par_iter()
                .map(|input| simulator.run(input, &settings).ok())
                .collect();
            println!("  against the general path's trapezoidal rule with {step_s} s:");
            report(
                &simulator,
                &inputs[..few],
                &ours[..few],
                &other,
                worst,
                Some(&scales),
            );
            println!("  and that of tolerance {tight:e} against it:");
            report(
                &simulator,
                &inputs[..few],
                &converged[..few],
                &other,
                worst,
                Some(&scales),
            );
        }
    }
    Ok(())
}

/// Failed runs leave none.
fn finished<E: std::fmt::Display>(runs: Vec<Result<Trajectory, E>>) -> Vec<Option<Trajectory>> {
    runs.into_iter()
        .enumerate()
        .map(|(index, run)| run.map_err(|reason| println!("  run {index}: {reason}")).ok())
        .collect()
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Prints the errors of every channel; returns the scales.
fn report(
    simulator: &Simulator,
    inputs: &[RunInput],
    ours: &[Option<Trajectory>],
    other: &[Option<Trajectory>],
    worst: usize,
    scales: Option<&[f64]>,
) -> Vec<f64> {
    let mut taken = Vec::new();
    for (k, channel) in simulator.channels().iter().enumerate().skip(1) {
        let ranges = other.iter().flatten().map(|run| {
            let (least, most) = run.columns[k]
                .iter()
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), &x| {
                    (a.min(x), b.max(x))
                });
            most - least
        });
        let scale = scales.map_or_else(|| median(ranges.collect()), |s| s[k - 1]);
        taken.push(scale);
        // Per run: largest error, the sample where it is, and where it first exceeds half of it.
        let mut errors: Vec<(f64, usize, usize, usize)> = ours
            .iter()
            .zip(other)
            .enumerate()
            .filter_map(|(index, (a, b))| {
                let (a, b) = (&a.as_ref()?.columns[k], &b.as_ref()?.columns[k]);
                let off: Vec<f64> = a.iter().zip(b).map(|(a, b)| (a - b).abs() / scale).collect();
                let (at, most) = off
                    .iter()
                    .copied()
                    .enumerate()
                    .fold((0, 0.0), |best, x| if x.1 > best.1 { x } else { best });
                let first = off.iter().position(|x| *x > 0.5 * most).unwrap_or(0);
                Some((most, index, at, first))
            })
            .collect();
        errors.sort_by(|a, b| b.0.total_cmp(&a.0));
        let quantile = |q: f64| {
            let n = errors.len();
            errors
                .get(((1.0 - q) * n as f64) as usize)
                .map_or(f64::NAN, |e| e.0)
        };
        let places: Vec<String> = errors
            .iter()
            .take(worst)
            .map(|(most, index, at, first)| {
                let flags = ours[*index]
                    .as_ref()
                    .map(|run| run.flags.clone())
                    .unwrap_or_default();
                let flags: Vec<&str> = flags.iter().map(|f| f.as_str()).collect();
                format!(
                    "{most:.1e} in run {} at {:.3} s (since {:.3} s; {})",
                    inputs[*index].run_id,
                    *at as f64 * SAMPLE_S,
                    *first as f64 * SAMPLE_S,
                    flags.join(" ")
                )
            })
            .collect();
        println!(
            "    {:32} median {:.1e}, 95 % {:.1e}, largest {}",
            channel.name,
            quantile(0.5),
            quantile(0.95),
            places.join("; ")
        );
    }
    taken
}
