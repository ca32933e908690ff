//! The accurate integrator of planar machines: run for run the same in any company, and never
//! without an end.

#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

use hydroflex_openapi::job::{Integrator, RunFlag};
use hydroflex_sim::fast::{InstructionSet, PlanarModel, Workspace};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::{ACCURATE_TOLERANCE, RunInput, RunSettings, Trajectory};

const SAMPLE_S: f64 = 0.005;

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
    // Every tolerance sorts the modes in its own way, and has its own sizes of the step loop.
    for payload in [false, true] {
        let body = &simulator.reduced(payload).unwrap()[0];
        let model = PlanarModel::new(simulator.machine().file(), body, payload).unwrap();
        let some: Vec<RunInput> = inputs
            .iter()
            .filter(|i| (i.payload_kg > 0.0) == payload)
            .rev()
            .cloned()
            .collect();
        for tolerance in [ACCURATE_TOLERANCE, 1e-4, 1e-6] {
            let mut ws = Workspace::default();
            let alone: Vec<_> = some
                .iter()
                .map(|input| bits(&model.run(input, SAMPLE_S, tolerance, &mut ws).unwrap()))
                .collect();
            for set in InstructionSet::available() {
                let results = model.run_batch_on(set, &some, SAMPLE_S, tolerance, &mut ws);
                for (alone, result) in alone.iter().zip(results) {
                    assert_eq!(*alone, bits(&result.unwrap()), "{set:?} at {tolerance:e}");
                }
            }
        }
    }
}

/// The same for payloads drawn from a range, in which every run has its own modes, and for some runs of one
/// payload among them.
#[test]
fn payloads_side_by_side_change_no_bit() {
    let simulator = built_in();
    let body = &simulator.reduced(true).unwrap()[0];
    let model = PlanarModel::new(simulator.machine().file(), body, true).unwrap();
    let inputs: Vec<RunInput> = (0..27)
        .map(|i| {
            let payload_kg = if i % 5 == 0 { 100.0 } else { 1.0 + 7.3 * i as f64 };
            random_run(i, payload_kg, 15 + (7 * i as usize) % 20)
        })
        .collect();
    let mut ws = Workspace::default();
    let alone: Vec<_> = inputs
        .iter()
        .map(|input| bits(&model.run(input, SAMPLE_S, ACCURATE_TOLERANCE, &mut ws).unwrap()))
        .collect();
    for set in InstructionSet::available() {
        for inputs in [&inputs[..], &inputs[3..]] {
            let results = model.run_batch_on(set, inputs, SAMPLE_S, ACCURATE_TOLERANCE, &mut ws);
            for (input, result) in inputs.iter().zip(results) {
                let alone = &alone[usize::try_from(input.run_id).unwrap()];
                assert_eq!(*alone, bits(&result.unwrap()), "{set:?}, run {}", input.run_id);
            }
        }
    }
}

/// Minimal and redundant coordinates describe the same machine: with small steps of the general path
/// every channel of the fast one is within its tolerance. Friction, full gravity moment and cavitation
/// floor are those of the built-in boom. The general path's trapezoidal rule differs from its limit by
/// about 3e-2 of range at 5 ms and falls with the square of the step, so by 3e-6 at 0.05 ms; kinks of
/// the valve's metering edge inside a step cost more. Accelerations get ten times the bound.
#[test]
fn both_paths_agree_at_small_steps() {
    let simulator = built_in();
    let general = RunSettings {
        integrator: Integrator::TrapezoidalIndex2 { step_s: 5e-5 },
        sample_time_s: SAMPLE_S,
    };
    for (run_id, payload_kg) in [(3, 0.0), (4, 50.0), (5, 150.0)] {
        let input = random_run(run_id, payload_kg, 60);
        let body = &simulator.reduced(payload_kg > 0.0).unwrap()[0];
        let model = PlanarModel::new(simulator.machine().file(), body, payload_kg > 0.0).unwrap();
        let theirs = simulator.run(&input, &general).unwrap();
        for tolerance in [ACCURATE_TOLERANCE, 1e-4] {
            let ours = model
                .run(&input, SAMPLE_S, tolerance, &mut Workspace::default())
                .unwrap();
            for (k, channel) in simulator.channels().iter().enumerate() {
                let (a, b) = (&ours.columns[k], &theirs.columns[k]);
                let most = b.iter().fold(f64::NEG_INFINITY, |m, &x| m.max(x));
                let least = b.iter().fold(f64::INFINITY, |m, &x| m.min(x));
                let off = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                let bound = if channel.name.contains("acceleration") {
                    10.0 * tolerance.max(2e-4)
                } else {
                    tolerance.max(2e-4)
                };
                assert!(
                    off <= bound * (most - least),
                    "{}: {:.1e} of range in run {run_id} at tolerance {tolerance:e}",
                    channel.name,
                    off / (most - least)
                );
            }
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

/// The measure of stillness: the tip, 2.85 m from the pivot, within a nanometre for a second.
#[test]
fn the_built_in_boom_with_its_valve_shut_does_not_move() {
    let simulator = built_in();
    for payload_kg in [0.0, 100.0] {
        for integrator in [
            Integrator::Accurate,
            Integrator::TrapezoidalIndex2 { step_s: SAMPLE_S },
            Integrator::GeneralizedAlpha { step_s: SAMPLE_S },
        ] {
            let input = RunInput {
                run_id: 0,
                payload_kg,
                angles_rad: vec![0.3],
                valves_ratio: vec![vec![0.0; 200]],
            };
            let settings = RunSettings {
                integrator,
                sample_time_s: SAMPLE_S,
            };
            let run = simulator.run(&input, &settings).unwrap();
            let column = |name: &str| {
                let at = simulator.channels().iter().position(|c| c.name == name).unwrap();
                &run.columns[at]
            };
            let drift = |column: &[f64]| column.iter().fold(0.0_f64, |m, x| m.max((x - column[0]).abs()));
            let tip_m = 2.85 * drift(column("angle_lift_rad"))
                + drift(column("deflection_tip_x_m"))
                + drift(column("deflection_tip_y_m"))
                + drift(column("deflection_tip_z_m"));
            assert!(tip_m < 1e-9, "{integrator:?}, {payload_kg} kg: {tip_m:e} m");
            assert_eq!(run.flags, []);
        }
    }
}
