//! The tree against the general path, the planar path and itself.

use hydroflex_openapi::job::{RunFlag, SolverPath};
use hydroflex_openapi::machine::MachineFile;
use nalgebra::Vector3;

use super::NotTree;
use super::model::TreeModel;
use super::motion::Motion;
use crate::body::rotation::euler_parameters_about_z;
use crate::equilibrium::equilibrium;
use crate::general::GeneralRun;
use crate::integrate::Scheme;
use crate::reduction::ReducedBody;
use crate::system::{Level, Oil, State, System};
use crate::testing::{Numbers, closed_crane, rig};
use crate::trajectory::recorder::Recorder;
use crate::trajectory::{ACCURATE_TOLERANCE, RunInput, Trajectory, channels};

fn random_motion(model: &TreeModel, seed: u64) -> [Vec<f64>; 3] {
    let mut x = Numbers::new(seed);
    let (file, _) = closed_crane();
    let mut motion = model.new_motion();
    // Near a pose in which the loop closes, deformed and moving.
    let rest = model.rest(&file, &[0.3, 0.1], &mut motion).unwrap();
    let near: Vec<f64> = rest.u().iter().map(|u| u + 0.01 * x.next()).collect();
    [near, x.list(model.free), x.list(model.free)]
}

/// The general path's state of the same motion.
fn general_state(model: &TreeModel, m: &Motion) -> State {
    let mut state = model.system.new_state();
    for ((entry, frame), body) in model.system.bodies.iter().zip(&m.frames).zip(&model.bodies) {
        let q = entry.first_q;
        let theta = euler_parameters_about_z(frame.angle);
        // θ̇ = Gᵀω/4, θ̈ = Gᵀω̇/4 − |ω|²θ/4.
        let turn = crate::body::rotation::rate_map(&theta).transpose() * 0.25;
        let rate = turn * Vector3::new(0.0, 0.0, frame.omega);
        let acceleration =
            turn * Vector3::new(0.0, 0.0, frame.alpha) - theta * (0.25 * frame.omega * frame.omega);
        for (list, origin, angular, modal) in [
            (&mut state.q, frame.origin, theta, &m.y),
            (&mut state.v, frame.velocity, rate, &m.v),
            (&mut state.a, frame.acceleration, acceleration, &m.a),
        ] {
            list[q..q + 2].copy_from_slice(origin.as_slice());
            list[q + 3..q + 7].copy_from_slice(angular.as_slice());
            list[q + 7..q + 7 + body.modes()].copy_from_slice(&modal[body.first..body.first + body.modes()]);
        }
    }
    if let (Some(payload), Some(at)) = (&model.system.payload, model.payload) {
        let point = &m.points[at];
        state.q[payload.first_q..payload.first_q + 2].copy_from_slice(point.position.as_slice());
        state.v[payload.first_q..payload.first_q + 2].copy_from_slice(point.velocity.as_slice());
        state.a[payload.first_q..payload.first_q + 2].copy_from_slice(point.acceleration.as_slice());
    }
    state
}

#[test]
fn residual_is_the_virtual_power_of_the_general_one() {
    for deformed in [false, true] {
        let (mut file, reduced) = closed_crane();
        if !deformed {
            file.conventions.gravity_moment = hydroflex_openapi::machine::GravityMoment::Undeformed;
        }
        let model = TreeModel::new(&file, &reduced, true)
            .unwrap()
            .with_payload_mass(70.0);
        assert_eq!((model.loops.len(), model.all - model.free), (1, 2));
        for seed in 0..4 {
            let [u, v, a] = random_motion(&model, seed);
            let mut m = model.new_motion();
            m.y[model.free..].copy_from_slice(&closing_angles(&model));
            assert!(model.evaluate_motion(&u, &v, &a, &mut m));
            let mut state = general_state(&model, &m);
            for k in 0..2 {
                state.pressures_pa[k] = [7e6, 4e6 + 1e6 * k as f64];
            }
            let mut ws = model.system.new_workspace();
            model
                .system
                .evaluate(&mut state, Oil::Given, Level::Position, &mut ws);
            // Joints hold at every level, so multipliers do no work.
            let gap = ws.residual_rows[..model.system.joint_rows]
                .iter()
                .fold(0.0_f64, |most, x| most.max(x.abs()));
            assert!(gap < 1e-12, "{gap}");
            for (k, line) in m.lines.iter().enumerate() {
                assert!((line.length_m - ws.cylinders[k].length_m).abs() < 1e-13);
                assert!((line.velocity_m_per_s - ws.cylinders[k].velocity_m_per_s).abs() < 1e-11);
            }
            let forces: Vec<f64> = ws.cylinders.iter().map(|c| c.force.force_n).collect();
            model.residual(|k| forces[k], &mut m);
            let found = m.residual[..model.free].to_vec();
            let largest = found.iter().fold(0.0_f64, |most, x| most.max(x.abs()));
            let still = vec![0.0; model.free];
            for (j, found) in found.iter().enumerate() {
                let mut unit = still.clone();
                unit[j] = 1.0;
                assert!(model.evaluate_motion(&u, &unit, &still, &mut m));
                let mut power = 0.0;
                for ((b, frame), body) in m.frames.iter().enumerate().zip(&model.bodies) {
                    power += ws.residual_frame[6 * b] * frame.velocity.x
                        + ws.residual_frame[6 * b + 1] * frame.velocity.y
                        + ws.residual_frame[6 * b + 5] * frame.omega;
                    let first = model.system.bodies[b].first_modal;
                    for k in 0..body.modes() {
                        power += ws.residual_modal[first + k] * m.v[body.first + k];
                    }
                }
                if let (Some(payload), Some(at)) = (&model.system.payload, model.payload) {
                    let velocity = m.points[at].velocity;
                    power += ws.residual_frame[payload.first_frame] * velocity.x
                        + ws.residual_frame[payload.first_frame + 1] * velocity.y;
                }
                assert!(
                    (power - found).abs() < 1e-10 * largest,
                    "seed {seed}, coordinate {j}: {power} {found}"
                );
            }
        }
    }
}

/// Angles of the loop at rest, from which closure starts.
fn closing_angles(model: &TreeModel) -> Vec<f64> {
    let (file, _) = closed_crane();
    let mut motion = model.new_motion();
    model.rest(&file, &[0.3, 0.1], &mut motion).unwrap();
    motion.y[model.free..].to_vec()
}

#[test]
fn mass_matrix_is_the_derivative_of_the_residual() {
    let (file, reduced) = closed_crane();
    let model = TreeModel::new(&file, &reduced, true)
        .unwrap()
        .with_payload_mass(70.0);
    let n = model.free;
    let [u, v, a] = random_motion(&model, 9);
    let mut m = model.new_motion();
    m.y[n..].copy_from_slice(&closing_angles(&model));
    assert!(model.evaluate_motion(&u, &v, &a, &mut m));
    let mut mass = vec![0.0; n * n];
    let mut rows = std::array::from_fn(|_| vec![0.0; model.all]);
    model.mass(&mut mass, &mut rows, &mut m);
    model.residual(|_| 1e4, &mut m);
    let base = m.residual[..n].to_vec();
    let largest = mass.iter().fold(0.0_f64, |most, x| most.max(x.abs()));
    for j in 0..n {
        let mut moved = a.clone();
        moved[j] += 1.0;
        assert!(model.evaluate_motion(&u, &v, &moved, &mut m));
        model.residual(|_| 1e4, &mut m);
        for i in 0..n {
            let difference = m.residual[i] - base[i];
            // Elastic forces of 1e5 N are subtracted.
            assert!(
                (difference - mass[i * n + j]).abs() < 1e-9 * largest.max(1.0),
                "({i}, {j}): {difference} {}",
                mass[i * n + j]
            );
        }
    }
}

/// The same run on the tree and, with short steps, on the general path; largest differences over ranges by channel name.
fn differences(
    file: &MachineFile,
    reduced: &[ReducedBody],
    input: &RunInput,
    steps: u32,
) -> (Trajectory, Vec<(String, f64)>) {
    let with_payload = input.payload_kg > 0.0;
    let model = TreeModel::new(file, reduced, with_payload)
        .unwrap()
        .with_payload_mass(input.payload_kg);
    let found = model.run(file, input, 0.005, ACCURATE_TOLERANCE).unwrap();
    let system = System::new(file, reduced, input.payload_kg).unwrap();
    let recorder = Recorder::new(file, reduced, &system);
    let start = equilibrium(&system, file, &input.angles_rad, &mut system.new_workspace()).unwrap();
    let general = GeneralRun {
        system: &system,
        recorder: &recorder,
        start: &start.state,
        valves_ratio: &input.valves_ratio,
        sample_time_s: 0.005,
    };
    let expected = general.fixed(Scheme::generalized_alpha(0.7), steps).unwrap();
    let listed = channels(file);
    let by_channel = listed
        .iter()
        .zip(found.columns.iter().zip(&expected.columns))
        .map(|(channel, (a, b))| {
            let range = b.iter().fold(f64::NEG_INFINITY, |m, x| m.max(*x))
                - b.iter().fold(f64::INFINITY, |m, x| m.min(*x));
            let largest = a.iter().zip(b).fold(0.0_f64, |m, (x, y)| m.max((x - y).abs()));
            // A channel that does not move (across the plane) has no range to compare with.
            let share = if range < 1e-12 { 0.0 } else { largest / range };
            (channel.name.clone(), share)
        })
        .collect();
    (found, by_channel)
}

fn signal(k: u32, phase: f64) -> f64 {
    let x = f64::from(k);
    if k % 23 < 6 {
        -0.8
    } else {
        libm::sin(0.7 * x + phase)
    }
}

#[test]
fn a_closed_crane_moves_as_on_the_general_path() {
    let (file, reduced) = closed_crane();
    for payload_kg in [0.0, 70.0] {
        let input = RunInput {
            run_id: 0,
            payload_kg,
            angles_rad: vec![0.3, 0.1],
            valves_ratio: vec![
                (0..60).map(|k| signal(k, 0.0)).collect(),
                (0..60).map(|k| signal(k, 1.0)).collect(),
            ],
        };
        let (found, shares) = differences(&file, &reduced, &input, 100);
        assert_eq!(found.statistics.path, SolverPath::Tree);
        for (name, share) in shares {
            let bound = if name.contains("acceleration") { 2e-2 } else { 5e-4 };
            assert!(share <= bound, "{name}, {payload_kg} kg: {share:e}");
        }
    }
}

#[test]
fn a_closed_crane_with_its_valves_shut_stays_where_it_is() {
    let (file, reduced) = closed_crane();
    let model = TreeModel::new(&file, &reduced, true)
        .unwrap()
        .with_payload_mass(70.0);
    let input = RunInput {
        run_id: 0,
        payload_kg: 70.0,
        angles_rad: vec![0.3, 0.1],
        valves_ratio: vec![vec![0.0; 200]; 2],
    };
    let run = model.run(&file, &input, 0.005, ACCURATE_TOLERANCE).unwrap();
    for (channel, column) in channels(&file).iter().zip(&run.columns) {
        if channel.name.starts_with("length") || channel.name.starts_with("angle") {
            let drift = column.iter().fold(0.0_f64, |m, x| m.max((x - column[0]).abs()));
            assert!(drift < 1e-10, "{}: {drift:e}", channel.name);
        }
    }
}

#[test]
fn a_chamber_that_runs_empty_is_held_at_vapour_pressure() {
    let mut file = rig();
    file.cylinders[0].damping_n_s_per_m = 1e4;
    let mut valve = vec![1.0; 60];
    valve.extend(vec![0.0; 140]);
    let input = RunInput {
        run_id: 0,
        payload_kg: 200.0,
        angles_rad: vec![0.3],
        valves_ratio: vec![valve],
    };
    let (found, shares) = differences(&file, &[], &input, 400);
    assert!(found.flags.contains(&RunFlag::Cavitation), "{:?}", found.flags);
    let pressures = &found.columns[3..5];
    assert!(pressures.iter().flatten().all(|p| *p >= 2e3 - 200.0));
    for (name, share) in shares {
        // The general path lets a chamber switch at the ends of its steps only.
        let bound = if name.contains("acceleration") { 0.2 } else { 5e-3 };
        assert!(share <= bound, "{name}: {share:e}");
    }
}

#[test]
fn an_end_stop_holds_the_piston() {
    let input = RunInput {
        run_id: 0,
        payload_kg: 0.0,
        angles_rad: vec![0.8],
        valves_ratio: vec![vec![1.0; 400]],
    };
    let (found, shares) = differences(&rig(), &[], &input, 40);
    assert!(found.flags.contains(&RunFlag::EndStop));
    for (name, share) in shares {
        let bound = if name.contains("acceleration") { 0.2 } else { 5e-3 };
        assert!(share <= bound, "{name}: {share:e}");
    }
}

#[test]
fn machines_outside_the_plane_are_named() {
    let (mut file, reduced) = closed_crane();
    file.gravity_m_per_s2[2] = 0.1;
    assert_eq!(
        TreeModel::new(&file, &reduced, false).unwrap_err(),
        NotTree::Gravity
    );
    let (mut file, reduced) = closed_crane();
    file.angles.push(hydroflex_openapi::machine::AngleSpec {
        name: "more".to_owned(),
        body: "coupler".to_owned(),
        ..file.angles[0].clone()
    });
    let refused = TreeModel::new(&file, &reduced, false).unwrap_err();
    assert_eq!(
        refused.to_string(),
        "1 loops need 2 bodies that turn and whose angle is not given, and the machine has 1"
    );
}

#[test]
fn a_loop_that_cannot_close_is_named() {
    let (mut file, reduced) = closed_crane();
    for joint in &mut file.joints {
        if joint.name == "closing" {
            joint.from.point_m = Some([0.02, 0.0, 0.0]);
        }
    }
    let model = TreeModel::new(&file, &reduced, false).unwrap();
    let error = model
        .rest(&file, &[0.3, 0.1], &mut model.new_motion())
        .unwrap_err();
    assert!(error.to_string().starts_with("joint `closing` stays"), "{error}");
}
