//! The accurate integrator of planar machines: run for run the same in any company, and never
//! without an end.

use hydroflex_openapi::job::{Integrator, RunFlag};
use hydroflex_sim::fast::{InstructionSet, PlanarModel, TOLERANCE, Workspace};
use hydroflex_sim::machine::Machine;
use hydroflex_sim::simulator::Simulator;
use hydroflex_sim::trajectory::{RunInput, RunSettings, Trajectory};

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
    let body = &simulator.reduced(false).unwrap()[0];
    let model = PlanarModel::new(simulator.machine().file(), body, false).unwrap();
    let some: Vec<RunInput> = inputs
        .iter()
        .filter(|i| i.payload_kg == 0.0)
        .rev()
        .cloned()
        .collect();
    for set in InstructionSet::available() {
        let results = model.run_batch_on(set, &some, SAMPLE_S, TOLERANCE, &mut Workspace::default());
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
