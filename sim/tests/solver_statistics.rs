//! What runs cost, watched: the path through the solver, steps, rejections, Newton iterations and factorisations of some random
//! runs of every built-in machine and payload, compared with `solver_statistics.json`. A solver that became slower, or a
//! machine that fell to another path, shows as a difference here.
//!
//! Counts follow from the input and the instruction-set level: vector units and fused operations change last digits, and an error
//! just at its bound may then be judged otherwise. So the file is keyed by level. On a level that it has every count is
//! compared exactly; on another one the path, and the counts within 5 % (and 3) of another level's. (When sines and exponentials
//! moved from the C library to `libm`, which changes last digits, 8 of 120 runs changed, all of the crane's Newton
//! iterations and factorisations, by at most 3.)
//!
//! `HYDROFLEX_UPDATE_STATISTICS=1 cargo test --release --workspace --test solver_statistics` rewrites the counts of this level. The
//! published machines need their meshes: set `HYDROFLEX_REFERENCE` as for the other comparisons; without it they are
//! neither compared nor rewritten.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use hydroflex_openapi::job::{Integrator, JobSpec, SolverPath};
use hydroflex_sim::instruction_set;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::scenario::plan_run;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::{RunSettings, SolverStatistics};
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Random runs of a payload with `accurate`; the fixed-step schemes take the first only.
const RUNS: u64 = 4;
const PAYLOADS_KG: [f64; 4] = [0.0, 50.0, 100.0, 200.0];
const SAMPLE_S: f64 = 0.005;

/// Counts of one run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Counts {
    path: SolverPath,
    steps: u64,
    rejected: u64,
    iterations: u64,
    factorisations: u64,
}

impl From<SolverStatistics> for Counts {
    fn from(s: SolverStatistics) -> Self {
        Self {
            path: s.path,
            steps: s.steps,
            rejected: s.rejected,
            iterations: s.iterations,
            factorisations: s.factorisations,
        }
    }
}

impl Counts {
    /// Whether another instruction-set level may count so.
    fn resembles(self, other: Self) -> bool {
        let close = |a: u64, b: u64| a.abs_diff(b) as f64 <= 3.0 + 0.05 * a.max(b) as f64;
        self.path == other.path
            && close(self.steps, other.steps)
            && close(self.rejected, other.rejected)
            && close(self.iterations, other.iterations)
            && close(self.factorisations, other.factorisations)
    }
}

/// Counts by what ran.
type Table = BTreeMap<String, Counts>;

fn snapshot() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/solver_statistics.json")
}

fn count(name: &str, machine: Machine, table: &mut Table) {
    let simulator = Simulator::new(machine).unwrap();
    let file = simulator.machine().file();
    let most_kg = file.payload.as_ref().map_or(0.0, |p| p.range_kg[1]);
    for payload_kg in PAYLOADS_KG.into_iter().filter(|kg| *kg <= most_kg) {
        let spec: JobSpec = serde_json::from_value(json!({
            "runs": RUNS, "seed": 1, "payload_kg": payload_kg, "duration_s": 1.0, "sample_time_s": SAMPLE_S,
        }))
        .unwrap();
        for (scheme, integrator, runs) in [
            ("accurate", Integrator::Accurate, RUNS),
            (
                "trapezoidal-index-2",
                Integrator::TrapezoidalIndex2 { step_s: SAMPLE_S },
                1,
            ),
            (
                "generalized-alpha",
                Integrator::GeneralizedAlpha { step_s: SAMPLE_S },
                1,
            ),
        ] {
            let settings = RunSettings {
                integrator,
                sample_time_s: SAMPLE_S,
            };
            for index in 0..runs {
                let input = plan_run(&spec, file, &simulator, index).unwrap();
                let run = simulator.run(&input, &settings).unwrap();
                let expected = simulator.solver_path(integrator, payload_kg > 0.0).unwrap();
                assert_eq!(
                    run.statistics.path, expected,
                    "{name}: the path is not the one announced"
                );
                table.insert(
                    format!("{name}, {scheme}, {payload_kg} kg, run {index}"),
                    run.statistics.into(),
                );
            }
        }
    }
}

fn measured() -> Table {
    let mut table = Table::new();
    count("lift-boom", Machine::load("lift-boom", &[]).unwrap(), &mut table);
    // A rigid arm, and the same one pulled out of its plane by gravity, which leaves it to the general path.
    let rig = include_str!("../src/testing_rig.toml");
    count("rig", Machine::from_toml(rig, &[]).unwrap(), &mut table);
    let tilted = rig.replacen("[0.0, -9.81, 0.0]", "[0.0, -9.81, 0.5]", 1);
    assert_ne!(rig, tilted);
    count(
        "tilted rig",
        Machine::from_toml(&tilted, &[]).unwrap(),
        &mut table,
    );
    if let Some(folder) = std::env::var_os("HYDROFLEX_REFERENCE") {
        let folder = PathBuf::from(folder);
        let mesh = |path: &str| folder.join(path).to_string_lossy().into_owned();
        let boom = Machine::load("lift-boom-published", &[mesh("liftboom/Job-1.inp")]);
        count("lift-boom-published", boom.unwrap(), &mut table);
        let meshes = [
            format!("lift={}", mesh("patu/LiftBoom-Job-1.inp")),
            format!("tilt={}", mesh("patu/TiltBoom-Job-1.inp")),
        ];
        let crane = Machine::load("crane-published", &meshes);
        count("crane-published", crane.unwrap(), &mut table);
    } else {
        eprintln!("HYDROFLEX_REFERENCE is not set: the published machines are left out");
    }
    table
}

/// One run a line.
fn text(levels: &BTreeMap<String, Table>) -> String {
    let mut out = "{\n".to_owned();
    for (i, (level, table)) in levels.iter().enumerate() {
        writeln!(out, "  {level:?}: {{").unwrap();
        for (k, (run, counts)) in table.iter().enumerate() {
            let comma = if k + 1 < table.len() { "," } else { "" };
            let counts = serde_json::to_string(counts).unwrap();
            writeln!(out, "    {run:?}: {counts}{comma}").unwrap();
        }
        writeln!(out, "  }}{}", if i + 1 < levels.len() { "," } else { "" }).unwrap();
    }
    out + "}\n"
}

fn machine_of(run: &str) -> &str {
    run.split(',').next().unwrap_or(run)
}

fn machines(table: &Table) -> BTreeSet<&str> {
    table.keys().map(|run| machine_of(run)).collect()
}

#[test]
fn runs_take_the_path_and_the_steps_that_they_took() {
    let found = measured();
    let level = instruction_set::level();
    let mut levels: BTreeMap<String, Table> =
        serde_json::from_str(&std::fs::read_to_string(snapshot()).unwrap_or_else(|_| "{}".to_owned()))
            .unwrap();
    if std::env::var_os("HYDROFLEX_UPDATE_STATISTICS").is_some() {
        let table = levels.entry(level.to_owned()).or_default();
        table.retain(|run, _| !machines(&found).contains(machine_of(run)));
        table.extend(found);
        std::fs::write(snapshot(), text(&levels)).unwrap();
        return;
    }
    let same = levels.get(level);
    let expected = same.or_else(|| levels.values().next()).unwrap();
    let gone = expected
        .keys()
        .filter(|run| machines(&found).contains(machine_of(run)) && !found.contains_key(*run))
        .map(|run| format!("{run} is no longer there"));
    let differences: Vec<String> = found
        .iter()
        .filter_map(|(run, counts)| {
            let fits = |e: &Counts| e == counts || (same.is_none() && e.resembles(*counts));
            let before = expected.get(run);
            (!before.is_some_and(fits)).then(|| format!("{run}: {counts:?}, was {before:?}"))
        })
        .chain(gone)
        .collect();
    assert!(
        differences.is_empty(),
        "{} of {} runs on {level} differ; if that is meant, HYDROFLEX_UPDATE_STATISTICS=1 rewrites the file:\n{}",
        differences.len(),
        found.len(),
        differences.join("\n")
    );
}
