//! Order, energy and known answers of the schemes.

use super::{Scheme, Stepper};
use crate::system::{State, System};
use crate::testing::{free_cloud, random_state, rig};

/// A heavy pendulum: the rig's arm without its cylinder.
fn pendulum() -> System {
    let mut file = rig();
    file.cylinders.clear();
    System::new(&file, &[], 0.0).unwrap()
}

/// Pendulum at an angle about Z, at rest, its pivot in place.
fn pendulum_state(system: &System, angle_rad: f64) -> State {
    let mut state = system.new_state();
    state.q[..3].copy_from_slice(&[-0.09, 1.4261, 0.0]);
    let theta = crate::body::rotation::euler_parameters_about_z(angle_rad);
    state.q[3..7].copy_from_slice(theta.as_slice());
    state
}

fn swing(scheme: Scheme, step_s: f64, end_s: f64) -> (f64, f64, f64) {
    let system = pendulum();
    let mut stepper = Stepper::new(&system, scheme, pendulum_state(&system, 0.3)).unwrap();
    let steps = (end_s / step_s).round();
    for k in 0..steps as usize {
        stepper.advance(k as f64 * step_s, step_s, &[], &[]).unwrap();
    }
    let motion = &stepper.workspace.bodies[0];
    let angle = crate::equilibrium::angle_about_z(&motion.rotation);
    (angle, motion.omega_rad_per_s.z, stepper.state.multipliers[1])
}

#[test]
fn both_schemes_are_of_second_order_in_position_velocity_and_joint_force() {
    for scheme in [Scheme::TRAPEZOIDAL_INDEX_2, Scheme::generalized_alpha(0.7)] {
        let end_s = 0.8;
        let exact = swing(scheme, 1e-4, end_s);
        let error = |step_s| {
            let found = swing(scheme, step_s, end_s);
            [found.0 - exact.0, found.1 - exact.1, found.2 - exact.2].map(f64::abs)
        };
        let (coarse, fine) = (error(8e-3), error(4e-3));
        for k in 0..3 {
            let order = libm::log2(coarse[k] / fine[k]);
            // Not yet in the limit, and the comparison solution has an error of its own.
            assert!(
                (1.8..2.3).contains(&order),
                "{scheme:?}: quantity {k} has order {order}"
            );
        }
    }
}

#[test]
fn a_pendulum_keeps_its_period() {
    let system = pendulum();
    let (mass, arm2, gravity) = (120.0, 1.1_f64.powi(2) + 0.05_f64.powi(2), 9.81);
    let inertia = 94.0 + mass * arm2;
    let rate = (mass * gravity * arm2.sqrt() / inertia).sqrt();
    // It hangs where the centre of mass is below the pivot; start 1 mrad beside that.
    let hanging = -std::f64::consts::FRAC_PI_2 - libm::atan(0.05 / 1.1);
    let period_s = std::f64::consts::TAU / rate;
    let mut stepper = Stepper::new(
        &system,
        Scheme::TRAPEZOIDAL_INDEX_2,
        pendulum_state(&system, hanging + 1e-3),
    )
    .unwrap();
    let steps = 2000;
    for k in 0..steps {
        let h = period_s / f64::from(steps);
        stepper.advance(f64::from(k) * h, h, &[], &[]).unwrap();
    }
    let angle = crate::equilibrium::angle_about_z(&stepper.workspace.bodies[0].rotation) - hanging;
    // After one period: the phase error (ω h)²/12 of the rule is 5e-6 rad of a turn, squared in the
    // cosine; finite amplitude adds 1e-6/16. Rounding of the angle is 1e-13 of 1e-3.
    assert!((angle / 1e-3 - 1.0).abs() < 1e-9, "{angle}");
    assert!(stepper.workspace.bodies[0].omega_rad_per_s.z.abs() < 1e-3 * rate * 1e-4);
}

#[test]
fn a_free_body_keeps_its_energy_better_with_shorter_steps() {
    let system = free_cloud(2e3);
    let energy = |stepper: &Stepper<'_>| {
        let motion = &stepper.workspace.bodies[0];
        system.body(0).kinetic_energy_j(motion) + system.body(0).elastic_energy_j(motion)
    };
    let drift = |steps: u32| {
        let mut start = random_state(&system, 2);
        // Small deflections: the modes of the cloud are random, not gentle.
        start.q[7..].iter_mut().for_each(|x| *x *= 0.05);
        let mut stepper = Stepper::new(&system, Scheme::TRAPEZOIDAL_INDEX_2, start).unwrap();
        let before = energy(&stepper);
        let mut worst = 0.0_f64;
        for k in 0..steps {
            let h = 0.5 / f64::from(steps);
            stepper.advance(f64::from(k) * h, h, &[], &[]).unwrap();
            worst = worst.max((energy(&stepper) / before - 1.0).abs());
        }
        worst
    };
    let (coarse, fine) = (drift(250), drift(500));
    assert!(fine < 1e-3, "{fine}");
    let order = libm::log2(coarse / fine);
    assert!((1.7..2.4).contains(&order), "order {order}: {coarse:e} {fine:e}");
}

#[test]
fn position_level_joints_stay_closed_and_velocity_level_ones_drift_with_the_square_of_the_step() {
    let gap = |scheme, steps: u32| {
        let system = pendulum();
        let mut stepper = Stepper::new(&system, scheme, pendulum_state(&system, 0.0)).unwrap();
        for k in 0..steps {
            let h = 1.0 / f64::from(steps);
            stepper.advance(f64::from(k) * h, h, &[], &[]).unwrap();
        }
        (stepper.workspace.markers[1].position_m - nalgebra::Vector3::new(-0.09, 1.4261, 0.0)).norm()
            + (nalgebra::Vector4::from_column_slice(&stepper.state.q[3..7]).norm() - 1.0).abs()
    };
    assert!(gap(Scheme::generalized_alpha(0.7), 100) < 1e-12);
    let (coarse, fine) = (
        gap(Scheme::TRAPEZOIDAL_INDEX_2, 100),
        gap(Scheme::TRAPEZOIDAL_INDEX_2, 200),
    );
    assert!(coarse < 1e-3);
    assert!(libm::log2(coarse / fine) > 1.7, "{coarse:e} {fine:e}");
}
