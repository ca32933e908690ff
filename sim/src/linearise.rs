//! Linearisation at rest, oil included: damped eigenvalues, and from them how long a motion is
//! remembered (theory note §11 and §12.1).

use nalgebra::linalg::balancing;
use nalgebra::{Complex, DMatrix, DVector, Vector3, Vector4};

use crate::body::rotation::rate_map;
use crate::system::{Level, Oil, State, System, Workspace};

/// Eigenvalues closer to zero than this are structural: trapped oil, and rounding. 1/s.
const ZERO_PER_S: f64 = 1e-2;
/// Unit of pressure inside the state matrix, Pa; it keeps its entries comparable.
const PRESSURE_UNIT_PA: f64 = 1e6;
/// Perturbation for difference quotients, m, rad or modal coordinate.
const PERTURBATION: f64 = 1e-6;

/// What the cylinders do.
#[derive(Debug, Clone, PartialEq)]
pub enum Actuation {
    /// Oil as modelled, valves held at these openings, one per cylinder.
    Oil {
        /// Openings.
        valves_ratio: Vec<f64>,
    },
    /// Lengths held by rigid actuators; the machine's structure alone.
    Locked,
}

/// Why a state cannot be linearised.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LinearisationError {
    /// The reduced mass matrix is singular.
    #[error("the mass matrix of the free motions is singular")]
    SingularMass,
    /// The eigenvalue iteration failed.
    #[error("the eigenvalues of the linearised machine did not converge")]
    NotConverged,
}

/// Small motions about a state at rest.
#[derive(Debug, Clone, PartialEq)]
pub struct Linearisation {
    /// Eigenvalues s, 1/s, without the structural zeros; slowest decay first.
    pub eigenvalues_per_s: Vec<Complex<f64>>,
    /// Number of structural zeros: two per cylinder with a shut valve.
    pub structural_zeros: usize,
    /// Free motions, without joints' directions.
    pub degrees_of_freedom: usize,
}

impl Linearisation {
    /// Time until the slowest component has decayed to `amplitude` (0.01 in the SLIDE paper), s.
    ///
    /// `t_d = −ln(A_d) / min |Re s|`. None where an eigenvalue does not decay.
    #[must_use]
    pub fn settling_time_s(&self, amplitude: f64) -> Option<f64> {
        let slowest = self.eigenvalues_per_s.first()?.re;
        (slowest < 0.0).then(|| -libm::log(amplitude) / -slowest)
    }

    /// Frequencies of oscillating pairs, Hz, ascending.
    #[must_use]
    pub fn frequencies_hz(&self) -> Vec<f64> {
        let turn = std::f64::consts::TAU;
        let mut found: Vec<f64> = self
            .eigenvalues_per_s
            .iter()
            .filter(|s| s.im > ZERO_PER_S)
            .map(|s| s.im / turn)
            .collect();
        found.sort_by(f64::total_cmp);
        found
    }
}

/// Linearises about a state at rest. Multipliers and pressures are those of the state.
///
/// With coordinates along the null space N of the joints, `x = [ξ, ξ̇, p]`:
///
/// ```text
///     ⎡ 0                I              0              ⎤
/// A = ⎢ −Mn⁻¹ Kn         −Mn⁻¹ Dn       −Mn⁻¹ Nᵀ F_p   ⎥
///     ⎣ H_q N            H_q̇ N          H_p            ⎦
/// ```
///
/// where Kn contains the stiffness of the joint forces, `d(Gᵀλ)/dq`.
///
/// # Errors
/// If the mass of the free motions is singular or the eigenvalues do not converge.
pub fn linearise(
    system: &System,
    state: &State,
    actuation: &Actuation,
    ws: &mut Workspace,
) -> Result<Linearisation, LinearisationError> {
    let mut at_rest = state.clone();
    at_rest.v.fill(0.0);
    at_rest.a.fill(0.0);
    system.evaluate(&mut at_rest, Oil::Given, Level::Position, ws);
    let mass = mass_matrix(system, ws);
    let n = mass.nrows();
    let row = |ws: &Workspace, k: usize| DVector::from_iterator(n, full_row(ws, k));
    let mut fixed: Vec<DVector<f64>> = (0..system.joint_rows).map(|k| row(ws, k)).collect();
    let lines: Vec<DVector<f64>> = (system.joint_rows..system.row_count())
        .map(|k| row(ws, k))
        .collect();
    if *actuation == Actuation::Locked {
        fixed.extend(lines.iter().cloned());
    }
    let null = null_space(n, &fixed);
    let free = null.ncols();
    if free == 0 {
        return Ok(Linearisation {
            eigenvalues_per_s: Vec::new(),
            structural_zeros: 0,
            degrees_of_freedom: 0,
        });
    }
    let stiffness = derivative(system, &at_rest, ws, n, move_coordinates);
    let damping = derivative(system, &at_rest, ws, n, move_velocities);
    let reduced_mass = null.transpose() * mass * &null;
    let factors = reduced_mass.cholesky().ok_or(LinearisationError::SingularMass)?;
    let pressures = match actuation {
        Actuation::Oil { .. } => 2 * system.cylinders().len(),
        Actuation::Locked => 0,
    };
    let mut a = DMatrix::zeros(2 * free + pressures, 2 * free + pressures);
    a.view_mut((0, free), (free, free)).fill_with_identity();
    a.view_mut((free, 0), (free, free))
        .copy_from(&-factors.solve(&(null.transpose() * stiffness * &null)));
    a.view_mut((free, free), (free, free))
        .copy_from(&-factors.solve(&(null.transpose() * damping * &null)));
    if let Actuation::Oil { valves_ratio } = actuation {
        for (k, line) in lines.iter().enumerate() {
            let cylinder = &system.cylinders()[k];
            let along = null.transpose() * line;
            let (length, p) = (ws.cylinders[k].length_m, at_rest.pressures_pa[k]);
            let rates =
                |length, velocity, p| cylinder.pressure_rates_pa_per_s(valves_ratio[k], length, velocity, p);
            let areas = [-cylinder.piston.area_m2, cylinder.rod.area_m2];
            for side in 0..2 {
                let column = 2 * free + 2 * k + side;
                let force = factors.solve(&(&along * (areas[side] * PRESSURE_UNIT_PA)));
                a.view_mut((free, column), (free, 1)).copy_from(&-force);
                let quotient =
                    |at: &dyn Fn(f64) -> [f64; 2], h: f64| (at(h)[side] - at(-h)[side]) / (2.0 * h);
                let by_length = quotient(&|h| rates(length + h, 0.0, p), PERTURBATION) / PRESSURE_UNIT_PA;
                let by_velocity = quotient(&|h| rates(length, h, p), PERTURBATION) / PRESSURE_UNIT_PA;
                let by_pressure = quotient(
                    &|h| {
                        let mut moved = p;
                        moved[side] += h;
                        rates(length, 0.0, moved)
                    },
                    // Far below any pressure drop, far above rounding.
                    1.0,
                );
                a.view_mut((column, 0), (1, free))
                    .copy_from(&(along.transpose() * by_length));
                a.view_mut((column, free), (1, free))
                    .copy_from(&(along.transpose() * by_velocity));
                a[(column, column)] = by_pressure;
            }
        }
    }
    balancing::balance_parlett_reinsch(&mut a);
    let schur = a
        .try_schur(1e-14, 10_000)
        .ok_or(LinearisationError::NotConverged)?;
    let (zeros, mut eigenvalues): (Vec<_>, Vec<_>) = schur
        .complex_eigenvalues()
        .iter()
        .copied()
        .partition(|s| s.norm() < ZERO_PER_S);
    eigenvalues.sort_by(|x, y| y.re.total_cmp(&x.re).then(x.im.total_cmp(&y.im)));
    Ok(Linearisation {
        eigenvalues_per_s: eigenvalues,
        structural_zeros: zeros.len(),
        degrees_of_freedom: free,
    })
}

/// A row over frames and modes.
fn full_row(ws: &Workspace, row: usize) -> impl Iterator<Item = f64> {
    ws.rows.frame(row).iter().chain(ws.rows.modal(row)).copied()
}

/// Mass matrix over frames `[δr, δφ]`, payload, modes.
fn mass_matrix(system: &System, ws: &Workspace) -> DMatrix<f64> {
    let (frames, modes) = (system.frame_count(), system.modal_count);
    let mut rigid = vec![0.0; frames * frames];
    let mut mass = DMatrix::zeros(frames + modes, frames + modes);
    for (k, (entry, motion)) in system.bodies.iter().zip(&ws.bodies).enumerate() {
        entry.frame.add_rigid_mass(motion, 1.0, &mut rigid, frames, 6 * k);
        for mode in 0..entry.frame.mode_count() {
            let column = frames + entry.first_modal + mode;
            mass[(column, column)] = 1.0;
            for (i, x) in entry.frame.modal_coupling(motion, mode).into_iter().enumerate() {
                mass[(6 * k + i, column)] = x;
                mass[(column, 6 * k + i)] = x;
            }
        }
    }
    if let Some(payload) = &system.payload {
        for k in payload.first_frame..payload.first_frame + 3 {
            rigid[k * frames + k] = payload.mass_kg;
        }
    }
    for i in 0..frames {
        for j in 0..frames {
            mass[(i, j)] = rigid[i * frames + j];
        }
    }
    mass
}

/// Orthonormal basis of the motions that no row forbids.
fn null_space(n: usize, rows: &[DVector<f64>]) -> DMatrix<f64> {
    let mut padded = DMatrix::zeros(n, n);
    for (mut column, row) in padded.column_iter_mut().zip(rows) {
        column.copy_from(row);
    }
    let decomposition = padded.col_piv_qr();
    let r = decomposition.r();
    let largest = r[(0, 0)].abs();
    // Rows beyond the rank repeat others: a redundant joint forbids nothing new.
    let rank = (0..n)
        .take_while(|&k| r[(k, k)].abs() > 1e-10 * largest && largest > 0.0)
        .count();
    decomposition.q().columns(rank, n - rank).into_owned()
}

/// Central differences of the residual for perturbations of frames and modes.
fn derivative(
    system: &System,
    state: &State,
    ws: &mut Workspace,
    n: usize,
    perturb: fn(&System, &mut State, usize, f64),
) -> DMatrix<f64> {
    let mut matrix = DMatrix::zeros(n, n);
    let mut at = |column: usize, h: f64| {
        let mut moved = state.clone();
        perturb(system, &mut moved, column, h);
        system.evaluate(&mut moved, Oil::Given, Level::Position, ws);
        DVector::from_iterator(n, ws.residual_frame.iter().chain(&ws.residual_modal).copied())
    };
    for column in 0..n {
        let difference = (at(column, PERTURBATION) - at(column, -PERTURBATION)) / (2.0 * PERTURBATION);
        matrix.column_mut(column).copy_from(&difference);
    }
    // Leave the workspace at the state itself.
    at(0, 0.0);
    matrix
}

/// Where an unknown acts: `values[index]` for every weight.
fn directions(system: &System, state: &State, column: usize) -> Vec<(usize, f64)> {
    let frames = system.frame_count();
    if column >= frames {
        let mode = column - frames;
        for entry in &system.bodies {
            if (entry.first_modal..entry.first_modal + entry.frame.mode_count()).contains(&mode) {
                return vec![(entry.first_q + 7 + mode - entry.first_modal, 1.0)];
            }
        }
        return Vec::new();
    }
    if let Some(payload) = system.payload.as_ref().filter(|p| column >= p.first_frame) {
        return vec![(payload.first_q + column - payload.first_frame, 1.0)];
    }
    let first = system.bodies[column / 6].first_q;
    match column % 6 {
        axis @ 0..3 => vec![(first + axis, 1.0)],
        turn => {
            let theta = Vector4::from_column_slice(&state.q[first + 3..first + 7]);
            let weights = rate_map(&theta).tr_mul(&Vector3::ith(turn - 3, 0.25));
            (0..4).map(|k| (first + 3 + k, weights[k])).collect()
        }
    }
}

fn move_coordinates(system: &System, state: &mut State, column: usize, h: f64) {
    for (index, weight) in directions(system, state, column) {
        state.q[index] += h * weight;
    }
}

fn move_velocities(system: &System, state: &mut State, column: usize, h: f64) {
    for (index, weight) in directions(system, state, column) {
        state.v[index] += h * weight;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::equilibrium::equilibrium;
    use crate::integrate::{Scheme, Stepper};
    use crate::testing::rig;
    use hydroflex_openapi::machine::{FrictionSpec, MachineFile};

    fn lightly_damped() -> MachineFile {
        let mut file = rig();
        file.cylinders[0].damping_n_s_per_m = 8e4;
        file.cylinders[0].friction = FrictionSpec::None;
        file
    }

    fn shut() -> Actuation {
        Actuation::Oil {
            valves_ratio: vec![0.0],
        }
    }

    #[test]
    fn a_shut_valve_gives_two_zeros_and_the_oil_spring() {
        let file = lightly_damped();
        let system = System::new(&file, &[], 0.0).unwrap();
        let mut ws = system.new_workspace();
        let start = equilibrium(&system, &file, &[0.2], &mut ws).unwrap();
        let found = linearise(&system, &start.state, &shut(), &mut ws).unwrap();
        assert_eq!((found.structural_zeros, found.degrees_of_freedom), (2, 1));
        // One pair: s² m + s d + k = 0 about the pivot, with the lever arm of the cylinder.
        let cylinder = &system.cylinders()[0];
        let x = cylinder.stroke_m(start.lengths_m[0]);
        let spring = [&cylinder.piston, &cylinder.rod]
            .map(|c| c.area_m2.powi(2) / c.compliance_m3_per_pa(x))
            .iter()
            .sum::<f64>();
        let arm = ws.rows.frame(system.joint_rows)[5];
        let inertia = 94.0 + 120.0 * (1.1_f64.powi(2) + 0.05_f64.powi(2));
        let decay = 0.5 * 8e4 * arm * arm / inertia;
        let rate = (spring * arm * arm / inertia - decay * decay).sqrt();
        let s = found.eigenvalues_per_s[1];
        // Gravity and the cylinder's pull add a stiffness of a few thousandths of the oil's.
        assert!((s.re / -decay - 1.0).abs() < 1e-5, "{s} {decay}");
        assert!((s.im / rate - 1.0).abs() < 1e-2, "{s} {rate}");
        let settling = found.settling_time_s(0.01).unwrap();
        assert!((settling - libm::log(100.0) / decay).abs() < 1e-4 * settling);
    }

    #[test]
    fn a_released_machine_swings_as_its_eigenvalues_say() {
        let file = lightly_damped();
        let system = System::new(&file, &[], 100.0).unwrap();
        let mut ws = system.new_workspace();
        let start = equilibrium(&system, &file, &[0.2], &mut ws).unwrap();
        let s = *linearise(&system, &start.state, &shut(), &mut ws)
            .unwrap()
            .eigenvalues_per_s
            .iter()
            .find(|s| s.im > 1.0)
            .unwrap();
        // A slightly wrong pressure lets go; the velocity of the cylinder is a damped sine.
        let mut state = start.state.clone();
        state.pressures_pa[0][0] += 2e4;
        let mut stepper = Stepper::new(&system, Scheme::TRAPEZOIDAL_INDEX_2, state).unwrap();
        let period_s = std::f64::consts::TAU / s.im;
        let steps = 2000;
        let mut velocity = Vec::new();
        for k in 0..3 * steps {
            let h = period_s / f64::from(steps);
            stepper.advance(f64::from(k) * h, h, &[0.0], &[0.0]).unwrap();
            velocity.push(stepper.workspace.cylinders[0].velocity_m_per_s);
        }
        let at = |periods: f64| velocity[(periods * f64::from(steps)) as usize - 1];
        // One period apart, the motion has shrunk by exp(Re s T), whatever its phase.
        let shrunk = at(1.3) / at(0.3);
        let expected = libm::exp(s.re * period_s);
        assert!((shrunk / expected - 1.0).abs() < 5e-3, "{shrunk} {expected}");
    }

    #[test]
    fn locked_cylinders_leave_the_structure() {
        let file = rig();
        let system = System::new(&file, &[], 0.0).unwrap();
        let mut ws = system.new_workspace();
        let start = equilibrium(&system, &file, &[0.2], &mut ws).unwrap();
        let found = linearise(&system, &start.state, &Actuation::Locked, &mut ws).unwrap();
        // A rigid arm on a rigid actuator cannot move at all.
        assert_eq!(found.degrees_of_freedom, 0);
        assert!(found.eigenvalues_per_s.is_empty());
    }
}
