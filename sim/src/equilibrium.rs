//! Consistent start: pose, modal coordinates and chamber pressures (theory note §9).

use hydroflex_openapi::machine::{BodySpec, JointKind, LooseStatics, MachineFile};
use nalgebra::{DMatrix, DVector, Matrix3};

use crate::body::marker::Marker;
use crate::body::rotation::euler_parameters_about_z;
use crate::integrate::{Increment, add_increment, normalise};
use crate::loose_statics::LooseNewton;
use crate::system::{Coefficients, CylinderRows, Level, Oil, State, System, Workspace};

/// Iterations of the loop closure and of the static solution.
const ITERATIONS_MOST: usize = 60;
/// Largest gap of a joint in an assembled machine, m.
const GAP_MOST_M: f64 = 1e-9;

/// Why there is no equilibrium.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum EquilibriumError {
    /// The run gives another number of angles than the machine has.
    #[error("{given} angles given, the machine has {expected}")]
    AngleCount {
        /// Given.
        given: usize,
        /// Expected.
        expected: usize,
    },
    /// Joints cannot be closed together at the given angles.
    #[error("joint `{joint}` stays {gap_m:e} m open: the loop cannot close at these angles")]
    LoopOpen {
        /// Joint with the largest gap.
        joint: String,
        /// Its gap, m.
        gap_m: f64,
    },
    /// With all cylinders locked something can still move.
    #[error("the machine can move although its cylinders are locked, so no pressures hold it")]
    NotHeld,
    /// Newton's method did not converge.
    #[error("no static equilibrium: increment {increment:e} after {iterations} iterations")]
    NotConverged {
        /// Iterations.
        iterations: usize,
        /// Last increment, m, rad or modal coordinate.
        increment: f64,
    },
    /// The loosely converged start that the machine asks for was not reached.
    #[error(
        "no static start as `conventions.statics` asks for it: residual {residual:e} after {iterations} iterations of load step {load_step}"
    )]
    LooseNotConverged {
        /// Load step, from 1.
        load_step: u32,
        /// Iterations in it.
        iterations: usize,
        /// Norm of the last residual, N and N m.
        residual: f64,
    },
}

/// A machine at rest.
#[derive(Debug, Clone, PartialEq)]
pub struct Equilibrium {
    /// Complete state, velocities zero.
    pub state: State,
    /// Eye-to-eye lengths, m.
    pub lengths_m: Vec<f64>,
    /// Forces that would hold the cylinders at equal initial pressures, tension positive, N.
    pub lock_forces_n: Vec<f64>,
    /// Pressures that hold the machine instead, piston and rod side, Pa.
    pub pressures_pa: Vec<[f64; 2]>,
    /// Angles of the bodies that the machine's angles name, about global Z, rad.
    pub angles_rad: Vec<f64>,
    /// Newton iterations of the static solution.
    pub iterations: usize,
}

/// Finds the equilibrium at the given angles (as run tables give them).
///
/// Cylinders are locked at the lengths of the undeformed machine, all chambers start at their
/// initial pressure; the locks' forces are then taken over by the piston side alone. Where that
/// would leave the range between tank and supply, the rod side takes the rest.
///
/// # Errors
/// If the machine cannot be assembled or does not come to rest.
pub fn equilibrium(
    system: &System,
    file: &MachineFile,
    angles_rad: &[f64],
    ws: &mut Workspace,
) -> Result<Equilibrium, EquilibriumError> {
    settle(system, file, angles_rad, None, ws)
}

/// Where runs of the general path start: the equilibrium, or where `conventions.statics` stops short of it.
///
/// # Errors
/// As [`equilibrium`].
pub(crate) fn general_start(
    system: &System,
    file: &MachineFile,
    angles_rad: &[f64],
    ws: &mut Workspace,
) -> Result<Equilibrium, EquilibriumError> {
    settle(system, file, angles_rad, system.conventions.statics, ws)
}

fn settle(
    system: &System,
    file: &MachineFile,
    angles_rad: &[f64],
    loose: Option<LooseStatics>,
    ws: &mut Workspace,
) -> Result<Equilibrium, EquilibriumError> {
    let mut state = assemble(system, file, angles_rad, ws)?;
    system.evaluate_motion(&state, ws);
    let locked: Vec<f64> = ws.cylinders.iter().map(|c| c.length_m).collect();
    let iterations = match loose {
        Some(loose) => LooseNewton::new(system, loose, &locked).solve(&mut state, ws)?,
        None => relax(system, &locked, &mut state, ws)?,
    };
    let lock_forces_n = ws.lock_forces_n.clone();
    ws.lock_forces_n.fill(0.0);
    ws.residual_rows.fill(0.0);
    for (k, cylinder) in system.cylinders().iter().enumerate() {
        state.pressures_pa[k] = holding_pressures(cylinder, lock_forces_n[k]);
    }
    let angles = file
        .angles
        .iter()
        .filter_map(|angle| system.body_index(&angle.body))
        .map(|body| angle_about_z(&ws.bodies[body].rotation))
        .collect();
    Ok(Equilibrium {
        pressures_pa: state.pressures_pa.clone(),
        state,
        lengths_m: locked,
        lock_forces_n,
        angles_rad: angles,
        iterations,
    })
}

/// Eye-to-eye lengths of the cylinders of the undeformed machine at the given angles, m.
///
/// # Errors
/// If the machine cannot be assembled.
pub(crate) fn start_lengths_m(
    system: &System,
    file: &MachineFile,
    angles_rad: &[f64],
    ws: &mut Workspace,
) -> Result<Vec<f64>, EquilibriumError> {
    let state = assemble(system, file, angles_rad, ws)?;
    system.evaluate_motion(&state, ws);
    Ok(ws.cylinders.iter().map(|c| c.length_m).collect())
}

/// Angle of a frame about global Z, in (−π, π].
#[must_use]
pub fn angle_about_z(rotation: &Matrix3<f64>) -> f64 {
    libm::atan2(rotation[(1, 0)], rotation[(0, 0)])
}

/// `−A₁ Δp₁ + A₂ Δp₂ = lock`, with Δp₂ = 0 where that is possible.
pub(crate) fn holding_pressures(cylinder: &crate::hydraulics::cylinder::Cylinder, lock_n: f64) -> [f64; 2] {
    let spec = cylinder.spec();
    let (start, supply, tank) = (
        spec.initial_pressure_pa,
        spec.valve.supply_pressure_pa,
        spec.valve.tank_pressure_pa,
    );
    let piston = start - lock_n / cylinder.piston.area_m2;
    // Keep a little distance: at the very end one metering edge has no pressure drop.
    let margin = 0.02 * (supply - tank);
    if piston > tank && piston < supply {
        return [piston, start];
    }
    let piston = piston.clamp(tank + margin, supply - margin);
    let rod = start + (lock_n + cylinder.piston.area_m2 * (piston - start)) / cylinder.rod.area_m2;
    [piston, rod]
}

/// Static Newton iterations with locked cylinders.
fn relax(
    system: &System,
    locked_m: &[f64],
    state: &mut State,
    ws: &mut Workspace,
) -> Result<usize, EquilibriumError> {
    let by = Increment {
        velocity_factor: 0.0,
        acceleration_factor: 0.0,
    };
    let coefficients = Coefficients {
        mass: 0.0,
        damping: 0.0,
        stiffness: 1.0,
        cylinders: CylinderRows::Locked,
    };
    let mut last = f64::INFINITY;
    ws.lock_forces_n.fill(0.0);
    for iteration in 1..=ITERATIONS_MOST {
        system.evaluate(state, Oil::Given, Level::Position, ws);
        for (k, length) in locked_m.iter().enumerate() {
            ws.residual_rows[system.joint_rows + k] = ws.cylinders[k].length_m - length;
        }
        if !system.factorise(coefficients, ws) {
            return Err(EquilibriumError::NotHeld);
        }
        system.solve(1.0, Level::Position, 1.0, ws);
        let increment = add_increment(system, ws, by, state);
        normalise(system, Level::Position, by, state);
        for (lock, delta) in ws
            .lock_forces_n
            .iter_mut()
            .zip(&ws.delta_multipliers[system.joint_rows..])
        {
            *lock += delta;
        }
        if !increment.is_finite() || increment > 10.0 {
            return Err(EquilibriumError::NotHeld);
        }
        // Convergence is linear with a factor of about 1e-3: an increment at rounding, or one that
        // stops falling close to it, is the end.
        if increment < 1e-15 || (increment < 1e-12 && increment > 0.3 * last) {
            system.evaluate(state, Oil::Given, Level::Position, ws);
            return Ok(iteration);
        }
        last = increment;
    }
    Err(EquilibriumError::NotConverged {
        iterations: ITERATIONS_MOST,
        increment: last,
    })
}

/// Places all bodies: orientations from the angles, positions along the joints, loops closed by
/// Newton's method in which bodies with a given angle keep it.
fn assemble(
    system: &System,
    file: &MachineFile,
    angles_rad: &[f64],
    ws: &mut Workspace,
) -> Result<State, EquilibriumError> {
    if angles_rad.len() != file.angles.len() {
        return Err(EquilibriumError::AngleCount {
            given: angles_rad.len(),
            expected: file.angles.len(),
        });
    }
    let mut state = system.new_state();
    let mut given = vec![false; system.bodies.len()];
    let mut turn = vec![0.0; system.bodies.len()];
    for (k, spec) in file.bodies.iter().enumerate() {
        if let BodySpec::Rigid(rigid) = spec {
            turn[k] = rigid.start_angle_deg.to_radians();
        }
        if let Some(angle) = file.angles.iter().position(|a| a.body == spec.name()) {
            let minus = file.angles[angle].minus.as_ref();
            let subtracted = minus.and_then(|name| file.angles.iter().position(|a| &a.name == name));
            turn[k] = angles_rad[angle] - subtracted.map_or(0.0, |other| angles_rad[other]);
            given[k] = true;
        }
    }
    place_along_joints(system, &mut turn, &mut state, ws);
    close_loops(system, &given, &mut state, ws)?;
    if let Some(payload) = &system.payload {
        system.evaluate_motion(&state, ws);
        if let Some(joint) = system
            .joints
            .iter()
            .find(|j| matches!(system.markers[j.to], Marker::Payload))
        {
            let at = ws.markers[joint.from].position_m;
            state.q[payload.first_q..payload.first_q + 3].copy_from_slice(at.as_slice());
        }
    }
    Ok(state)
}

fn place_along_joints(system: &System, turn: &mut [f64], state: &mut State, ws: &mut Workspace) {
    let mut placed = vec![false; system.bodies.len()];
    let body_of = |marker: usize| match &system.markers[marker] {
        Marker::Body(on) => Some(on.body),
        Marker::Ground(_) | Marker::Payload => None,
    };
    let is_placed = |marker: usize, placed: &[bool]| match &system.markers[marker] {
        Marker::Ground(_) => true,
        Marker::Body(on) => placed[on.body],
        Marker::Payload => false,
    };
    for _ in 0..system.bodies.len() {
        for joint in &system.joints {
            for (from, to) in [(joint.from, joint.to), (joint.to, joint.from)] {
                let Some(body) = body_of(to) else { continue };
                if placed[body] || !is_placed(from, &placed) {
                    continue;
                }
                if joint.kind == JointKind::Fixed {
                    turn[body] = body_of(from).map_or(0.0, |b| turn[b]);
                }
                let first = system.bodies[body].first_q;
                let theta = euler_parameters_about_z(turn[body]);
                state.q[first + 3..first + 7].copy_from_slice(theta.as_slice());
                state.q[first..first + 3].fill(0.0);
                system.evaluate_motion(state, ws);
                let shift = ws.markers[from].position_m - ws.markers[to].position_m;
                state.q[first..first + 3].copy_from_slice(shift.as_slice());
                placed[body] = true;
            }
        }
    }
}

fn close_loops(
    system: &System,
    given: &[bool],
    state: &mut State,
    ws: &mut Workspace,
) -> Result<(), EquilibriumError> {
    let rows: Vec<usize> = system
        .joints
        .iter()
        .filter(|j| !matches!(system.markers[j.to], Marker::Payload))
        .flat_map(|j| j.first_row..j.first_row + crate::joint::row_count(j.kind))
        .collect();
    // Columns of what may move: every origin, and the rotation of bodies without a given angle.
    let columns: Vec<usize> = (0..6 * system.bodies.len())
        .filter(|c| c % 6 < 3 || !given[c / 6])
        .collect();
    if rows.is_empty() || columns.is_empty() {
        return Ok(());
    }
    let by = Increment {
        velocity_factor: 0.0,
        acceleration_factor: 0.0,
    };
    let mut gap = f64::INFINITY;
    for _ in 0..ITERATIONS_MOST {
        system.evaluate(state, Oil::Given, Level::Position, ws);
        let residual = DVector::from_iterator(rows.len(), rows.iter().map(|&r| ws.residual_rows[r]));
        gap = residual.amax();
        if gap < 1e-14 {
            break;
        }
        let jacobian = DMatrix::from_fn(rows.len(), columns.len(), |i, j| {
            ws.rows.frame(rows[i])[columns[j]]
        });
        // The pseudo-inverse takes the smallest correction, and leaves alone what no joint asks for.
        let Ok(step) = jacobian.svd(true, true).solve(&residual, 1e-9) else {
            break;
        };
        ws.delta_frame.fill(0.0);
        ws.delta_modal.fill(0.0);
        ws.delta_multipliers.fill(0.0);
        // A rough pose may be far off: limit the turn of one iteration.
        let limit = (0.5 / step.amax().max(1e-300)).min(1.0);
        for (&column, delta) in columns.iter().zip(step.iter()) {
            ws.delta_frame[column] = -limit * delta;
        }
        let increment = add_increment(system, ws, by, state);
        normalise(system, Level::Position, by, state);
        if increment < 1e-15 {
            break;
        }
    }
    system.evaluate(state, Oil::Given, Level::Position, ws);
    if gap <= GAP_MOST_M {
        return Ok(());
    }
    let worst = system.joints.iter().map(|j| {
        let rows = j.first_row..j.first_row + crate::joint::row_count(j.kind);
        let largest = ws.residual_rows[rows].iter().fold(0.0_f64, |m, x| m.max(x.abs()));
        (j, largest)
    });
    let (joint, gap_m) = worst.fold(
        (None, 0.0),
        |(best, most), (j, g)| if g > most { (Some(j), g) } else { (best, most) },
    );
    Err(EquilibriumError::LoopOpen {
        joint: joint.map_or_else(String::new, |j| j.name.clone()),
        gap_m,
    })
}

#[cfg(test)]
#[path = "equilibrium_tests.rs"]
mod tests;
