//! Remarks on a job that can be done as it is, but may not be what is meant.
//!
//! A network that looks at windows longer than a third of a run sees few of them, and hardly any of a machine that has
//! settled. Which window a job's networks will have is known before it runs: they take it from the job's settling runs, which are
//! functions of the job. The first of them are simulated here, with the largest payload and the softest material: eight if runs go side by side (a few
//! milliseconds), two where each run takes a multiple of that, none where even these would keep a submission
//! waiting. Then the eigenvalues say how long the window is, about. The bodies are reduced by then, as a job is
//! not accepted before they are.

use hydroflex_dataset::RunSamples;
use hydroflex_dataset::window::WindowCollector;
use hydroflex_openapi::dataset::WindowFacts;
use hydroflex_openapi::job::{Integrator, JobSpec, MaterialRef, ValueOrRange, WindowRule};
use hydroflex_openapi::status::JobNotice;
use hydroflex_sim::scenario::{plan_settling_run, settling_steps};
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::summary::eigenvalue_window_s;
use hydroflex_sim::trajectory::{RunInput, RunSettings};
use hydroflex_worker::machines::ReadyMachine;

/// Runs shorter than this many windows are remarked on.
const WINDOWS_LEAST: f64 = 3.0;
/// Settling runs that are looked at, side by side and one by one.
const RUNS_TOGETHER: u64 = 8;
const RUNS_ALONE: u64 = 2;
/// Steps of all these runs together up to which a submission waits for them: a second or two on the slowest path.
const STEPS_MOST: f64 = 20_000.0;
/// Proposed durations are multiples of this where the sample time allows it, s.
const ROUND_S: f64 = 0.1;

/// The remarks.
#[must_use]
pub fn of(machine: &ReadyMachine, spec: &JobSpec) -> Vec<JobNotice> {
    window(machine, spec).into_iter().collect()
}

fn window(machine: &ReadyMachine, spec: &JobSpec) -> Option<JobNotice> {
    let payload_kg = largest_payload_kg(spec);
    let mut rules: Vec<WindowRule> = spec.train.iter().map(|training| training.window).collect();
    if rules.is_empty() {
        rules.push(WindowRule::default());
    }
    let softest = softest(spec);
    let simulator = machine.simulator_of(softest);
    let simulated = rules
        .iter()
        .any(|rule| matches!(rule, WindowRule::Band | WindowRule::Paper))
        .then(|| settling(machine, spec, softest, payload_kg))
        .flatten();
    let (window_s, how) = rules
        .iter()
        .filter_map(|rule| length(*rule, simulator, payload_kg, simulated.as_ref()))
        .max_by(|a, b| a.0.total_cmp(&b.0))?;
    // Whole sample times: three windows of 0.1 s fit into 0.3 s.
    if WINDOWS_LEAST * window_s <= spec.duration_s * (1.0 + 1e-9) {
        return None;
    }
    let proposed_s = proposal_s(window_s, spec.sample_time_s);
    Some(JobNotice {
        pointer: "/duration_s".to_owned(),
        detail: format!(
            "the SLIDE window with {payload_kg} kg is about {window_s:.3} s ({how}), more than a third of a run ({} s): networks see \
             few windows, hardly any of them settled; {proposed_s} s or longer would do",
            spec.duration_s
        ),
        proposed: serde_json::Number::from_f64(proposed_s).map(Into::into),
    })
}

/// Length of the window by a rule, s, and where it is from.
fn length(
    rule: WindowRule,
    simulator: &Simulator,
    payload_kg: f64,
    simulated: Option<&WindowFacts>,
) -> Option<(f64, &'static str)> {
    let by_eigenvalues = || {
        let window_s = eigenvalue_window_s(simulator, payload_kg)?;
        Some((window_s, "decay of the slowest motion to 1 %"))
    };
    match rule {
        WindowRule::Given { window_s } => Some((window_s, "given")),
        WindowRule::Eigenvalues => by_eigenvalues(),
        WindowRule::Band | WindowRule::Paper => {
            let (window_s, how) = match rule {
                WindowRule::Paper => (
                    simulated.and_then(|facts| facts.paper_s),
                    "settling runs, the paper's rule",
                ),
                _ => (
                    simulated.and_then(|facts| facts.band_s),
                    "settling runs, band of 5 %",
                ),
            };
            window_s
                .filter(|s| *s > 0.0)
                .map(|s| (s, how))
                .or_else(by_eigenvalues)
        }
    }
}

/// SLIDE's window from the eigenvalues of the slowest machine of a job, s, to the microsecond: their last digits differ
/// between instruction sets. None where a motion does not decay.
#[must_use]
pub(super) fn eigenvalue_window_of_job_s(machine: &ReadyMachine, spec: &JobSpec) -> Option<f64> {
    let window_s = eigenvalue_window_s(machine.simulator_of(softest(spec)), largest_payload_kg(spec))?;
    Some((window_s * 1e6).round() / 1e6)
}

fn largest_payload_kg(spec: &JobSpec) -> f64 {
    match spec.payload_kg {
        ValueOrRange::Value(kg) | ValueOrRange::Range { max: kg, .. } => kg,
    }
}

/// The job's softest material: the slowest, but for density.
fn softest(spec: &JobSpec) -> Option<usize> {
    let modulus = |material: &MaterialRef| material.material().map_or(f64::INFINITY, |m| m.youngs_modulus_pa);
    let listed = spec.materials.iter().enumerate();
    listed
        .min_by(|(_, a), (_, b)| modulus(a).total_cmp(&modulus(b)))
        .map(|(index, _)| index)
}

/// Windows of the job's first settling runs with this material and payload; none if it has no such run, or they would take
/// too long.
fn settling(
    machine: &ReadyMachine,
    spec: &JobSpec,
    material: Option<usize>,
    payload_kg: f64,
) -> Option<WindowFacts> {
    let simulator = machine.simulator_of(material);
    let settings = RunSettings {
        integrator: spec.integrator,
        sample_time_s: spec.sample_time_s,
    };
    let together = simulator.runs_side_by_side(&settings, payload_kg > 0.0);
    let runs = spec
        .settling_runs
        .min(if together { RUNS_TOGETHER } else { RUNS_ALONE });
    let steps_per_sample = match spec.integrator {
        Integrator::Accurate => 1.0,
        Integrator::TrapezoidalIndex2 { step_s } | Integrator::GeneralizedAlpha { step_s } => {
            (spec.sample_time_s / step_s).max(1.0)
        }
    };
    let steps = (runs * settling_steps(spec) as u64) as f64 * steps_per_sample;
    if runs == 0 || steps > STEPS_MOST {
        return None;
    }
    let same = JobSpec {
        payload_kg: ValueOrRange::Value(payload_kg),
        settling_runs: runs,
        ..spec.clone()
    };
    let mut windows = WindowCollector::new(simulator.channels(), spec.sample_time_s);
    // A run that fails or cannot be planned is the job's to report.
    let inputs: Vec<RunInput> = (0..runs)
        .filter_map(|index| plan_settling_run(&same, simulator.machine().file(), simulator, index).ok())
        .collect();
    for trajectory in simulator.run_batch(&inputs, &settings).into_iter().flatten() {
        windows.add(&RunSamples {
            sample_count: trajectory.sample_count,
            columns: trajectory.columns,
        });
    }
    Some(windows.finish())
}

/// Shortest duration of enough windows, rounded up.
fn proposal_s(window_s: f64, sample_time_s: f64) -> f64 {
    let least_s = WINDOWS_LEAST * window_s;
    let up = |unit_s: f64| (least_s / unit_s - 1e-9).ceil();
    let per_unit = ROUND_S / sample_time_s;
    if (per_unit - per_unit.round()).abs() < 1e-9 * per_unit {
        up(ROUND_S) / ROUND_S.recip()
    } else {
        up(sample_time_s) * sample_time_s
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hydroflex_openapi::job::MachineRef;
    use hydroflex_sim::machine::Machine;

    #[test]
    fn proposals_are_round_and_long_enough() {
        assert_eq!(proposal_s(0.412, 0.005).to_string(), "1.3");
        assert_eq!(proposal_s(0.4, 0.005).to_string(), "1.2");
        assert_eq!(proposal_s(0.02, 0.03).to_string(), "0.06");
    }

    #[test]
    fn a_job_of_short_runs_is_told_which_would_do() {
        let machine = Machine::load("lift-boom", &[]).unwrap();
        let cache = std::env::temp_dir().join("hydroflex-test-cache");
        let machine = ReadyMachine::new(machine, &[], &cache);
        let job = |text: &str| -> JobSpec { serde_json::from_str(text).unwrap() };
        let calm = job(r#"{"runs": 4, "payload_kg": 100}"#);
        assert_eq!(calm.machine, MachineRef::BuiltIn("lift-boom".to_owned()));
        assert_eq!(of(&machine, &calm), []);
        // the window of 200 kg is 0.4 s
        let short = JobSpec {
            payload_kg: ValueOrRange::Range {
                min: 0.0,
                max: 200.0,
                empty: 0.0,
            },
            ..calm.clone()
        };
        let notices = of(&machine, &short);
        assert_eq!(notices.len(), 1, "{notices:?}");
        assert_eq!(notices[0].pointer, "/duration_s");
        let proposed_s = notices[0].proposed.as_ref().unwrap().as_f64().unwrap();
        assert!((1.0..3.0).contains(&proposed_s), "{notices:?}");
        let longer = JobSpec {
            duration_s: proposed_s + 0.5,
            ..short
        };
        assert_eq!(of(&machine, &longer), []);
        let given = job(r#"{"runs": 4, "train": [{"window": {"rule": "given", "window_s": 0.4}}]}"#);
        assert_eq!(of(&machine, &given)[0].proposed, Some(1.2.into()));
        // Without settling runs, or with such as would take hours, the eigenvalues say it.
        for text in [
            r#"{"runs": 4, "settling_runs": 0, "payload_kg": 100}"#,
            r#"{"runs": 4, "payload_kg": 100, "sample_time_s": 1e-5,
                "integrator": {"kind": "generalized-alpha", "step_s": 1e-9}}"#,
        ] {
            let notices = of(&machine, &job(text));
            assert!(notices[0].detail.contains("slowest motion"), "{notices:?}");
        }
        let eigenvalues =
            job(r#"{"runs": 4, "payload_kg": 100, "train": [{"window": {"rule": "eigenvalues"}}]}"#);
        assert_eq!(of(&machine, &eigenvalues)[0].proposed, Some(1.5.into()));
    }
}
