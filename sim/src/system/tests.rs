//! Rows are gradients, and the elimination of modes solves the whole system.

use super::{Coefficients, CylinderRows, Level, Oil, State, System};
use crate::testing::{linkage, random_state};

fn moved(system: &System, state: &State, h: f64) -> State {
    let mut other = state.clone();
    for (q, v) in other.q.iter_mut().zip(&state.v) {
        *q += h * v;
    }
    // Bring the Euler parameters back to the sphere; along a tangent this is a second-order change.
    for entry in &system.bodies {
        let range = entry.first_q + 3..entry.first_q + 7;
        let norm = other.q[range.clone()].iter().map(|x| x * x).sum::<f64>().sqrt();
        other.q[range].iter_mut().for_each(|x| *x /= norm);
    }
    other
}

#[test]
fn rows_times_velocities_are_rates_of_gaps_and_lengths() {
    let system = linkage();
    let mut ws = system.new_workspace();
    for seed in 0..4 {
        let mut state = random_state(&system, seed);
        let h = 1e-6;
        let mut at = |h: f64| {
            let mut other = moved(&system, &state, h);
            system.evaluate(&mut other, Oil::Given, Level::Position, &mut ws);
            (ws.residual_rows.clone(), ws.cylinders[0].length_m)
        };
        let ((before, length_before), (after, length_after)) = (at(-h), at(h));
        system.evaluate(&mut state, Oil::Given, Level::Velocity, &mut ws);
        for row in 0..system.joint_rows {
            let rate = (after[row] - before[row]) / (2.0 * h);
            // Truncation h² and rounding 1e-16/h.
            assert!(
                (rate - ws.residual_rows[row]).abs() < 1e-8,
                "row {row}: {rate} {}",
                ws.residual_rows[row]
            );
        }
        let rate = (length_after - length_before) / (2.0 * h);
        assert!((rate - ws.cylinders[0].velocity_m_per_s).abs() < 1e-8);
        // The cylinder's row is the same gradient, so its force does the work F L̇.
        let row = system.joint_rows;
        let mut by_row: f64 = ws
            .rows
            .frame(row)
            .iter()
            .zip(&ws.velocity_frame)
            .map(|(a, b)| a * b)
            .sum();
        for (entry, motion) in system.bodies.iter().zip(&ws.bodies) {
            for (k, rate) in motion.eta_rate.iter().enumerate() {
                by_row += ws.rows.modal(row)[entry.first_modal + k] * rate;
            }
        }
        assert!((by_row - ws.cylinders[0].velocity_m_per_s).abs() < 1e-12);
    }
}

#[test]
fn accelerations_from_the_linear_solve_leave_no_residual() {
    let system = linkage();
    let mut ws = system.new_workspace();
    let mut state = random_state(&system, 11);
    state.a.fill(0.0);
    system.evaluate(&mut state, Oil::Given, Level::Position, &mut ws);
    ws.residual_rows.fill(0.0);
    let coefficients = Coefficients {
        mass: 1.0,
        damping: 0.0,
        stiffness: 0.0,
        cylinders: CylinderRows::Tangent,
    };
    assert!(system.factorise(coefficients, &mut ws));
    system.solve(1.0, Level::Position, 1.0, &mut ws);
    let by = crate::integrate::Increment {
        velocity_factor: 0.0,
        acceleration_factor: 1.0,
    };
    let q = state.q.clone();
    crate::integrate::add_increment(&system, &ws, by, &mut state);
    state.q.copy_from_slice(&q);
    let scale = ws
        .residual_frame
        .iter()
        .chain(&ws.residual_modal)
        .fold(0.0_f64, |m, x| m.max(x.abs()));
    system.evaluate(&mut state, Oil::Given, Level::Position, &mut ws);
    for x in ws.residual_frame.iter().chain(&ws.residual_modal) {
        // Relative to the forces before, with some room for the condition of the joint rows.
        assert!(x.abs() < 1e-9 * scale, "{x:e} of {scale:e}");
    }
}

#[test]
fn a_cylinder_tangent_is_the_derivative_of_its_force() {
    // One Newton step for a change of length alone must find the force's change.
    let system = linkage();
    let cylinder = &system.cylinders()[0];
    for (length, velocity) in [(1.0, 0.02), (0.815, -0.05), (1.36, 0.1), (1.1, -3e-3)] {
        let start = [(5e6, 1e6), (6e6, -2e6)];
        let force = |l, v| cylinder.trapezoidal_step(0.4, 1e-4, start, l, v).0.force_n;
        let at = cylinder.trapezoidal_step(0.4, 1e-4, start, length, velocity).0;
        let h = 1e-7;
        let by_length = (force(length + h, velocity) - force(length - h, velocity)) / (2.0 * h);
        let by_velocity = (force(length, velocity + h) - force(length, velocity - h)) / (2.0 * h);
        // Rounding of forces near 1e5 N over 1e-7.
        assert!(
            (by_length - at.by_length).abs() < 1e-5 * by_length.abs() + 1e-2,
            "{by_length} {}",
            at.by_length
        );
        assert!((by_velocity - at.by_velocity).abs() < 1e-5 * by_velocity.abs() + 1e-2);
    }
}
