//! One step: predictor, Newton iterations, and halving where they do not converge.

use super::scheme::Scheme;
use super::update::{Increment, add_increment, normalise};
use crate::system::{Coefficients, CylinderRows, Oil, State, System, Workspace};
use crate::trajectory::SolverStatistics;

/// Newton iterations after which a step is given up.
const ITERATIONS_MOST: u32 = 25;
/// Times a step is halved before the run is given up: 5 ms become 5 µs.
const HALVINGS_MOST: u32 = 10;

/// Units of rounding of the largest coordinate to which a coordinate is solved at most.
const ROUNDINGS: f64 = 4.0;
/// Multiple of that below which an increment that stopped falling counts as solved. Stiff bodies in closed
/// loops magnify rounding: 5e-14 m was seen on the crane, 1e-8 of what its tip deflects.
const STALLED_ROUNDINGS: f64 = 200.0;

/// Why a step failed.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum StepError {
    /// Newton's method did not converge even in the shortest step.
    #[error(
        "no convergence at {t_s} s after {iterations} iterations: increment {increment:e}, tolerance {tolerance:e}"
    )]
    NotConverged {
        /// Time at the start of the step, s.
        t_s: f64,
        /// Iterations of the last attempt.
        iterations: u32,
        /// Last increment, m, rad or modal coordinate.
        increment: f64,
        /// What it should have been below.
        tolerance: f64,
    },
    /// A quantity is not a finite number.
    #[error("{quantity} not finite at {t_s} s")]
    NotFinite {
        /// Which.
        quantity: &'static str,
        /// Time at the start of the step, s.
        t_s: f64,
    },
}

/// How far Newton's method goes within a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Newton {
    /// What is missing of the accelerations when a step counts as solved, m/s² (√kg for modes).
    pub acceleration_tolerance: f64,
    /// Factors of one step serve the next ones of equal length, as long as they contract by at least
    /// `CONTRACTION_SLOW`. Only the way to the solution differs, not the solution.
    pub keeps_factors: bool,
}

impl Newton {
    /// New factors in every iteration, to rounding: what a comparison of schemes needs.
    pub const EXACT: Self = Self {
        acceleration_tolerance: 1e-6,
        keeps_factors: false,
    };
    /// For runs whose steps are halved until they settle: in steps of half a millisecond this leaves 1e-10 m and
    /// 1e-7 m/s, a ten-thousandth of what is promised.
    pub const FRUGAL: Self = Self {
        acceleration_tolerance: 1e-3,
        keeps_factors: true,
    };
}

/// Contraction above which kept factors are made anew.
const CONTRACTION_SLOW: f64 = 0.3;

/// Carries a state forward. Owns all memory that a step needs.
#[derive(Debug)]
pub struct Stepper<'a> {
    system: &'a System,
    scheme: Scheme,
    newton: Newton,
    /// Step whose factors the workspace holds, s; not a number where it holds none.
    factored_s: f64,
    /// State at the end of the last step.
    pub state: State,
    start: State,
    valves: Vec<f64>,
    /// Scratch memory; after a step it holds the evaluation at its end.
    pub workspace: Workspace,
    /// Counts.
    pub statistics: SolverStatistics,
}

impl<'a> Stepper<'a> {
    /// Starts from a state; accelerations are made consistent with it.
    ///
    /// # Errors
    /// If the accelerations cannot be computed.
    pub fn new(system: &'a System, scheme: Scheme, state: State) -> Result<Self, StepError> {
        Self::with_newton(system, scheme, Newton::EXACT, state)
    }

    /// The same with a choice of how far Newton's method goes.
    ///
    /// # Errors
    /// As [`Stepper::new`].
    pub fn with_newton(
        system: &'a System,
        scheme: Scheme,
        newton: Newton,
        state: State,
    ) -> Result<Self, StepError> {
        let mut stepper = Self {
            system,
            scheme,
            newton,
            factored_s: f64::NAN,
            start: state.clone(),
            state,
            valves: vec![0.0; system.cylinders().len()],
            workspace: system.new_workspace(),
            statistics: SolverStatistics::default(),
        };
        stepper.start_accelerations()?;
        Ok(stepper)
    }

    /// Accelerations and multipliers of a state at rest: `[M Gᵀ; G 0] [q̈; λ] = [f; 0]`.
    fn start_accelerations(&mut self) -> Result<(), StepError> {
        let (system, state, ws) = (self.system, &mut self.state, &mut self.workspace);
        state.a.fill(0.0);
        state.algorithmic.fill(0.0);
        state.multipliers.fill(0.0);
        system.evaluate(state, Oil::Given, self.scheme.level, ws);
        ws.residual_rows.fill(0.0);
        let coefficients = Coefficients {
            mass: 1.0,
            damping: 0.0,
            stiffness: 0.0,
            cylinders: CylinderRows::Tangent,
        };
        if !system.factorise(coefficients, ws) {
            return Err(StepError::NotFinite {
                quantity: "initial accelerations",
                t_s: 0.0,
            });
        }
        system.solve(1.0, self.scheme.level, 1.0, ws);
        let q = state.q.clone();
        add_increment(
            system,
            ws,
            Increment {
                velocity_factor: 0.0,
                acceleration_factor: 1.0,
            },
            state,
        );
        state.q.copy_from_slice(&q);
        state.algorithmic.copy_from_slice(&state.a);
        system.evaluate_motion(state, ws);
        match state.non_finite() {
            Some(quantity) => Err(StepError::NotFinite { quantity, t_s: 0.0 }),
            None => Ok(()),
        }
    }

    /// Advances by `step_s` from `t_s`. Valves are linear in time from `valves_start` to
    /// `valves_end`, and enter at the end of every (sub-)step.
    ///
    /// # Errors
    /// If the step fails even in its smallest pieces; the state is then that of the last good one.
    pub fn advance(
        &mut self,
        t_s: f64,
        step_s: f64,
        valves_start: &[f64],
        valves_end: &[f64],
    ) -> Result<(), StepError> {
        let mut pieces_total: u32 = 1;
        let mut pieces_done: u32 = 0;
        while pieces_done < pieces_total {
            let piece_s = step_s / f64::from(pieces_total);
            let part = f64::from(pieces_done + 1) / f64::from(pieces_total);
            for ((v, a), b) in self.valves.iter_mut().zip(valves_start).zip(valves_end) {
                *v = a + (b - a) * part;
            }
            let t_piece_s = t_s + piece_s * f64::from(pieces_done);
            self.start.copy_from(&self.state);
            match self.attempt(t_piece_s, piece_s) {
                Ok(()) => {
                    self.statistics.steps += 1;
                    pieces_done += 1;
                    // Grow again where the finer grid meets the coarser one.
                    while pieces_total > 1 && pieces_done.is_multiple_of(2) && pieces_done < pieces_total {
                        pieces_total /= 2;
                        pieces_done /= 2;
                    }
                }
                Err(error) => {
                    self.statistics.rejected += 1;
                    self.state.copy_from(&self.start);
                    if pieces_total >= 1 << HALVINGS_MOST {
                        return Err(error);
                    }
                    pieces_total *= 2;
                    pieces_done *= 2;
                }
            }
        }
        Ok(())
    }

    fn attempt(&mut self, t_s: f64, h: f64) -> Result<(), StepError> {
        let (system, scheme) = (self.system, self.scheme);
        let by = Increment {
            velocity_factor: scheme.velocity_factor(h),
            acceleration_factor: scheme.acceleration_factor(h),
        };
        self.predict(h, by);
        let level = scheme.level;
        normalise(system, level, by, &mut self.state);
        // An increment δ changes accelerations by β' δ.
        // In short steps the rounding of the coordinates, in metres, is larger than what this asks for.
        let rounding = ROUNDINGS * f64::EPSILON * largest_coordinate(&self.start.q);
        let tolerance = (self.newton.acceleration_tolerance / by.acceleration_factor).max(rounding);
        let scale = 1.0 / by.acceleration_factor;
        let coefficients = Coefficients {
            mass: 1.0,
            damping: scale * by.velocity_factor,
            stiffness: scale,
            cylinders: CylinderRows::Tangent,
        };
        let oil = Oil::Trapezoidal {
            half_step_s: 0.5 * h,
            start: &self.start,
            valves_ratio: &self.valves,
        };
        let mut previous = f64::INFINITY;
        for iteration in 1..=ITERATIONS_MOST {
            let ws = &mut self.workspace;
            system.evaluate(&mut self.state, oil, level, ws);
            // Parts of a sample differ by rounding; what was not factored is not a number.
            let same = (self.factored_s - h).abs() <= 1e-9 * h;
            if !(self.newton.keeps_factors && same) {
                self.factored_s = f64::NAN;
                if !system.factorise(coefficients, ws) {
                    return Err(StepError::NotFinite {
                        quantity: "Jacobian",
                        t_s,
                    });
                }
                self.factored_s = h;
                self.statistics.factorisations += 1;
            }
            self.statistics.iterations += 1;
            system.solve(scale, level, by.velocity_factor, ws);
            let increment = add_increment(system, ws, by, &mut self.state);
            normalise(system, level, by, &mut self.state);
            if !increment.is_finite() {
                return Err(StepError::NotFinite {
                    quantity: "Newton increment",
                    t_s,
                });
            }
            // What is still missing after this increment, from the observed contraction.
            let contraction = (increment / previous).min(1.0);
            if iteration > 1 && contraction > CONTRACTION_SLOW {
                self.factored_s = f64::NAN;
            }
            let missing = if iteration == 1 {
                increment
            } else {
                increment * contraction
            };
            // An increment that no longer falls, this close to rounding, is rounding.
            let stalled = iteration > 3 && contraction > 0.5 && increment <= STALLED_ROUNDINGS * rounding;
            if missing <= tolerance || stalled {
                system.evaluate(&mut self.state, oil, level, ws);
                return self.accept(t_s);
            }
            if iteration > 3 && contraction >= 1.0 && increment > 1e3 * tolerance {
                return Err(StepError::NotConverged {
                    t_s,
                    iterations: iteration,
                    increment,
                    tolerance,
                });
            }
            previous = increment;
        }
        Err(StepError::NotConverged {
            t_s,
            iterations: ITERATIONS_MOST,
            increment: previous,
            tolerance,
        })
    }

    /// Coordinates and velocities for the guess `q̈_T = q̈₀`, consistent with the scheme.
    fn predict(&mut self, h: f64, by: Increment) {
        let Scheme {
            alpha_m,
            alpha_f,
            beta,
            gamma,
            ..
        } = self.scheme;
        let (state, start) = (&mut self.state, &self.start);
        for i in 0..state.q.len() {
            let (a0, qdd0) = (start.algorithmic[i], start.a[i]);
            let a = (alpha_f * qdd0 - alpha_m * a0) / (1.0 - alpha_m);
            let delta = qdd0 / by.acceleration_factor;
            state.q[i] = start.q[i] + h * start.v[i] + h * h * ((0.5 - beta) * a0 + beta * a) + delta;
            state.v[i] = start.v[i] + h * ((1.0 - gamma) * a0 + gamma * a) + by.velocity_factor * delta;
            state.a[i] = qdd0;
        }
    }

    fn accept(&mut self, t_s: f64) -> Result<(), StepError> {
        let Scheme { alpha_m, alpha_f, .. } = self.scheme;
        let (state, start) = (&mut self.state, &self.start);
        for i in 0..state.q.len() {
            let a = (alpha_f * start.a[i] - alpha_m * start.algorithmic[i]) / (1.0 - alpha_m);
            state.algorithmic[i] = a + (1.0 - alpha_f) / (1.0 - alpha_m) * state.a[i];
        }
        match state.non_finite() {
            Some(quantity) => Err(StepError::NotFinite { quantity, t_s }),
            None => Ok(()),
        }
    }
}

/// Largest coordinate, at least one: positions in metres, Euler parameters.
fn largest_coordinate(q: &[f64]) -> f64 {
    q.iter().fold(1.0, |most: f64, x| most.max(x.abs()))
}
