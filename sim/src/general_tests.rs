//! Whole runs on the general path: stillness, oil balance, cavitation, end stops.

use hydroflex_openapi::job::RunFlag;
use hydroflex_openapi::machine::MachineFile;

use super::GeneralRun;
use crate::equilibrium::{Equilibrium, equilibrium};
use crate::hydraulics::valve::flow_m3_per_s;
use crate::integrate::Scheme;
use crate::system::System;
use crate::testing::rig;
use crate::trajectory::recorder::Recorder;
use crate::trajectory::{ACCURATE_TOLERANCE, Trajectory, channels};

struct Bench {
    file: MachineFile,
    system: System,
    start: Equilibrium,
}

fn bench(file: MachineFile, payload_kg: f64, angle_rad: f64) -> Bench {
    let system = System::new(&file, &[], payload_kg).unwrap();
    let start = equilibrium(&system, &file, &[angle_rad], &mut system.new_workspace()).unwrap();
    Bench { file, system, start }
}

impl Bench {
    fn run(
        &self,
        valve: Vec<f64>,
        sample_time_s: f64,
        how: impl Fn(&GeneralRun<'_>) -> Trajectory,
    ) -> Trajectory {
        let recorder = Recorder::new(&self.file, &[], &self.system);
        let run = GeneralRun {
            system: &self.system,
            recorder: &recorder,
            start: &self.start.state,
            valves_ratio: &[valve],
            sample_time_s,
        };
        how(&run)
    }

    fn column<'a>(&self, run: &'a Trajectory, name: &str) -> &'a [f64] {
        let index = channels(&self.file).iter().position(|c| c.name == name).unwrap();
        &run.columns[index]
    }
}

fn range(x: &[f64]) -> f64 {
    x.iter().fold(f64::NEG_INFINITY, |m, v| m.max(*v)) - x.iter().fold(f64::INFINITY, |m, v| m.min(*v))
}

#[test]
fn equilibrium_balances_moments_about_the_pivot() {
    for payload_kg in [0.0, 100.0] {
        let bench = bench(rig(), payload_kg, 0.4);
        let p = bench.start.pressures_pa[0];
        let cylinder = &bench.system.cylinders()[0];
        let force = cylinder.oil_force_n(p, 0.0);
        // Lever arm of the cylinder and of the weights, all by hand.
        let (sin, cos) = libm::sincos(0.4);
        let turn = |x: f64, y: f64| (cos * x - sin * y, sin * x + cos * y);
        let eye = turn(0.304, -0.083);
        let base = (0.17 + 0.09, 0.386 - 1.4261);
        let length = libm::hypot(eye.0 - base.0, eye.1 - base.1);
        let arm = (eye.0 * (eye.1 - base.1) - eye.1 * (eye.0 - base.0)) / length;
        let weights = 9.81 * (120.0 * turn(1.1, 0.05).0 + payload_kg * turn(2.85, 0.015).0);
        assert!(
            (-force * arm - weights).abs() < 1e-9 * weights,
            "{force} {arm} {weights}"
        );
        assert!((length - bench.start.lengths_m[0]).abs() < 1e-14);
        assert!((bench.start.angles_rad[0] - 0.4).abs() < 1e-14);
        // Only the piston side has moved away from the initial pressure.
        assert!((p[1] - 5e6).abs() < 1e-300);
    }
}

#[test]
fn pressures_that_one_chamber_cannot_hold_are_split_between_both() {
    let mut file = rig();
    // At 0.5 MPa on the rod side the piston side would have to be above supply for this load.
    file.cylinders[0].valve.supply_pressure_pa = 20e5;
    file.cylinders[0].initial_pressure_pa = 18e5;
    let bench = bench(file, 150.0, 0.0);
    let [p1, p2] = bench.start.pressures_pa[0];
    assert!(p1 > 1e5 && p1 < 20e5 && p2 < 18e5, "{p1} {p2}");
    let whole = bench.system.cylinders()[0].oil_force_n([p1, p2], 0.0);
    let start = bench.system.cylinders()[0].oil_force_n([18e5; 2], 0.0);
    assert!((whole - start - bench.start.lock_forces_n[0]).abs() < 1e-6);
}

#[test]
fn a_machine_with_its_valve_shut_stays_where_it_is() {
    for payload_kg in [0.0, 100.0] {
        let bench = bench(rig(), payload_kg, 0.2);
        let run = bench.run(vec![0.0; 200], 0.005, |r| {
            r.fixed(Scheme::generalized_alpha(0.7), 1).unwrap()
        });
        // The issue asks for 1 nm at the tip, 2.9 m from the pivot.
        assert!(2.9 * range(bench.column(&run, "angle_lift_rad")) < 1e-9);
        assert!(run.flags.is_empty());
        assert_eq!(run.sample_count, 201);
    }
}

#[test]
fn oil_that_came_in_minus_oil_that_went_out_is_stored() {
    let bench = bench(rig(), 50.0, 0.2);
    let valve: Vec<f64> = (0..400).map(|k| libm::sin(f64::from(k) * 0.02) * 0.6).collect();
    let dt = 5e-4;
    let run = bench.run(valve.clone(), dt, |r| {
        r.fixed(Scheme::generalized_alpha(0.7), 1).unwrap()
    });
    let cylinder = &bench.system.cylinders()[0];
    for (name, chamber, sign) in [
        ("pressure_lift_piston_pa", &cylinder.piston, 1.0),
        ("pressure_lift_rod_pa", &cylinder.rod, -1.0),
    ] {
        let (p, length) = (bench.column(&run, name), bench.column(&run, "length_lift_m"));
        // ∫ Q dt = ΔV + ∫ (V/B) dp, both integrals by the trapezoidal rule over the samples.
        let (mut inflow, mut compressed, mut flow_total) = (0.0, 0.0, 0.0);
        for k in 1..run.sample_count {
            let u = |k: usize| if k == 0 { 0.0 } else { sign * valve[k - 1] };
            let flow = 0.5
                * (flow_m3_per_s(cylinder.valve(), u(k), p[k])
                    + flow_m3_per_s(cylinder.valve(), u(k - 1), p[k - 1]));
            let compliance = |k: usize| chamber.compliance_m3_per_pa(cylinder.stroke_m(length[k]));
            inflow += flow * dt;
            flow_total += flow.abs() * dt;
            compressed += 0.5 * (compliance(k) + compliance(k - 1)) * (p[k] - p[k - 1]);
        }
        let swept = sign * chamber.area_m2 * (length[run.sample_count - 1] - length[0]);
        // Both rules are of second order; the samples resolve the motion to about 1e-5.
        assert!(
            (inflow - swept - compressed).abs() < 2e-5 * flow_total,
            "{name}: {inflow:e} {swept:e} {compressed:e}"
        );
    }
}

#[test]
fn a_cavitating_run_is_flagged_and_stays_above_vapour_pressure() {
    let mut file = rig();
    // Hardly any damping: closing the valve on a moving load empties a chamber.
    file.cylinders[0].damping_n_s_per_m = 1e3;
    let bench = bench(file, 200.0, 0.3);
    let mut valve = vec![1.0; 60];
    valve.extend(vec![0.0; 140]);
    let run = bench.run(valve, 0.005, |r| {
        r.fixed(Scheme::generalized_alpha(0.7), 10).unwrap()
    });
    let lowest = |name| {
        bench
            .column(&run, name)
            .iter()
            .fold(f64::INFINITY, |m, v| m.min(*v))
    };
    assert!(
        run.flags.contains(&RunFlag::Cavitation),
        "{:?} {:e}",
        run.flags,
        lowest("pressure_lift_rod_pa")
    );
    assert!(run.flags.contains(&RunFlag::BelowTankPressure));
    assert!(lowest("pressure_lift_piston_pa") >= 2e3 && lowest("pressure_lift_rod_pa") >= 2e3);
}

#[test]
fn an_end_stop_holds_the_piston() {
    let bench = bench(rig(), 0.0, 0.8);
    let run = bench.run(vec![1.0; 400], 0.005, |r| {
        r.fixed(Scheme::generalized_alpha(0.7), 4).unwrap()
    });
    let length = bench.column(&run, "length_lift_m");
    let longest = length.iter().fold(0.0_f64, |m, v| m.max(*v));
    assert!(run.flags.contains(&RunFlag::EndStop), "{longest}");
    // Full supply pressure against 1e8 N/m: 1.1 mm.
    assert!(longest < 0.82 + 0.535 + 2e-3, "{longest}");
}

#[test]
fn accurate_runs_agree_with_short_steps() {
    let bench = bench(rig(), 100.0, 0.2);
    let valve: Vec<f64> = (0..60)
        .map(|k| if k % 17 < 6 { -0.7 } else { libm::sin(f64::from(k)) })
        .collect();
    let listed = channels(&bench.file);
    let accurate = bench.run(valve.clone(), 0.005, |r| {
        r.accurate(&listed, ACCURATE_TOLERANCE).unwrap()
    });
    let fine = bench.run(valve, 0.005, |r| {
        r.fixed(Scheme::generalized_alpha(0.7), 400).unwrap()
    });
    for (k, channel) in listed.iter().enumerate() {
        let largest = accurate.columns[k]
            .iter()
            .zip(&fine.columns[k])
            .fold(0.0_f64, |m, (a, b)| m.max((a - b).abs()));
        let bound = if channel.unit == "rad/s^2" { 1e-2 } else { 1e-3 };
        assert!(
            largest <= bound * range(&fine.columns[k]),
            "{}: {largest:e}",
            channel.name
        );
    }
}

#[test]
fn the_same_run_twice_gives_the_same_bits() {
    let bench = bench(rig(), 100.0, 0.2);
    let valve: Vec<f64> = (0..100).map(|k| libm::sin(f64::from(k) * 1.7)).collect();
    let once = |_: u8| {
        bench.run(valve.clone(), 0.005, |r| {
            r.fixed(Scheme::TRAPEZOIDAL_INDEX_2, 1).unwrap()
        })
    };
    let (a, b) = (once(0), once(1));
    let bits = |t: &Trajectory| {
        t.columns
            .iter()
            .flatten()
            .map(|x| x.to_bits())
            .collect::<Vec<_>>()
    };
    assert_eq!(bits(&a), bits(&b));
    assert_eq!(a.statistics, b.statistics);
}
