//! The façade: a machine in, trajectories out.

use std::path::PathBuf;
use std::sync::OnceLock;

use hydroflex_openapi::channel::Channel;
use hydroflex_openapi::job::{Integrator, SolverPath};
use hydroflex_openapi::machine::MachineFile;

use crate::equilibrium::{Equilibrium, equilibrium, general_start, start_lengths_m};
use crate::fast::{self, NotPlanar, PlanarModel};
use crate::general::GeneralRun;
use crate::integrate::Scheme;
use crate::linearise::{Actuation, Linearisation, linearise};
use crate::machine::Machine;
use crate::reduction::{ReducedBody, ReductionError};
use crate::scenario::Reach;
use crate::system::{System, SystemError};
use crate::trajectory::recorder::Recorder;
use crate::trajectory::{
    ACCURATE_TOLERANCE, InputError, RunFailure, RunInput, RunSettings, Trajectory, channels,
};
use crate::tree::{NotTree, TreeModel};

/// Spectral radius of the generalised-α scheme that runs can ask for.
const SPECTRAL_RADIUS: f64 = 0.7;

/// Why a machine cannot run at all.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SimulatorError {
    /// A flexible body cannot be reduced.
    #[error("{0}")]
    Reduction(#[from] ReductionError),
    /// The reduced machine cannot become a system of equations.
    #[error(transparent)]
    System(#[from] SystemError),
    /// The minimal coordinates do not exist with this payload.
    #[error("no minimal coordinates: {0}")]
    Planar(NotPlanar),
}

/// A machine ready to run. Share it behind an `Arc`: every method takes `&self`.
///
/// Bodies are reduced when first needed, once for runs without and once for runs with payload.
#[derive(Debug)]
pub struct Simulator {
    machine: Machine,
    cache_dir: Option<PathBuf>,
    channels: Vec<Channel>,
    variants: [OnceLock<Result<Variant, SimulatorError>>; 2],
}

/// What is constant for runs with, or without, a payload.
#[derive(Debug)]
struct Variant {
    reduced: Vec<ReducedBody>,
    system: System,
    recorder: Recorder,
    planar: Result<PlanarModel, NotPlanar>,
    tree: Result<TreeModel, NotTree>,
}

/// Which equations a run with the accurate integrator solves.
#[derive(Debug, Clone, PartialEq)]
pub enum AccuratePath {
    /// Minimal coordinates of a planar machine.
    Planar,
    /// Free coordinates of a planar tree with loops.
    Tree,
    /// Redundant coordinates with constraints, for the reasons given.
    General {
        /// Why it is not one planar boom.
        not_planar: NotPlanar,
        /// Why it is not a planar tree.
        not_tree: NotTree,
    },
}

impl Simulator {
    /// A simulator of a machine.
    ///
    /// # Errors
    /// None at present: what a machine's check cannot see is found by [`Simulator::prepare`].
    pub fn new(machine: Machine) -> Result<Self, SimulatorError> {
        Ok(Self::with_cache(machine, None))
    }

    /// A simulator that keeps reduced bodies in a folder.
    #[must_use]
    pub fn with_cache(machine: Machine, cache_dir: Option<PathBuf>) -> Self {
        let channels = channels(machine.file());
        Self {
            machine,
            cache_dir,
            channels,
            variants: [OnceLock::new(), OnceLock::new()],
        }
    }

    /// The machine.
    #[must_use]
    pub fn machine(&self) -> &Machine {
        &self.machine
    }

    /// Channels in column order.
    #[must_use]
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }

    /// Reduces the bodies now, so that a machine that cannot run is refused before any run starts.
    ///
    /// # Errors
    /// If a body cannot be reduced, or the system has no equations.
    pub fn prepare(&self, with_payload: bool) -> Result<(), SimulatorError> {
        self.variant(with_payload).map(|_| ())
    }

    /// Reduced flexible bodies for runs without or with payload, in the machine's order.
    ///
    /// # Errors
    /// As [`Simulator::prepare`].
    pub fn reduced(&self, with_payload: bool) -> Result<&[ReducedBody], SimulatorError> {
        Ok(&self.variant(with_payload)?.reduced)
    }

    fn variant(&self, with_payload: bool) -> Result<&Variant, SimulatorError> {
        let made = self.variants[usize::from(with_payload)].get_or_init(|| {
            let file = self.machine.file();
            let reduced = self.machine.reduce(with_payload, self.cache_dir.as_deref())?;
            // The mass is replaced run by run; here it only says that there is one.
            let system = System::new(file, &reduced, if with_payload { 1.0 } else { 0.0 })?;
            let recorder = Recorder::new(file, &reduced, &system);
            let planar = match reduced.as_slice() {
                [body] => PlanarModel::new(file, body, with_payload),
                _ => Err(NotPlanar::Bodies {
                    bodies: file.bodies.len(),
                }),
            };
            let tree = TreeModel::new(file, &reduced, with_payload);
            Ok(Variant {
                reduced,
                system,
                recorder,
                planar,
                tree,
            })
        });
        match made {
            Ok(variant) => Ok(variant),
            Err(error) => Err(error.clone()),
        }
    }

    /// Static equilibrium at the given angles.
    ///
    /// # Errors
    /// If the machine cannot be assembled or held there.
    pub fn equilibrium(&self, payload_kg: f64, angles_rad: &[f64]) -> Result<Equilibrium, RunFailure> {
        let variant = self.variant(payload_kg > 0.0)?;
        let system = variant.system.with_payload_mass(payload_kg);
        Ok(equilibrium(
            &system,
            self.machine.file(),
            angles_rad,
            &mut system.new_workspace(),
        )?)
    }

    /// Small motions about the equilibrium at the given angles.
    ///
    /// # Errors
    /// If there is no equilibrium, or no eigenvalues are found.
    pub fn linearise(
        &self,
        payload_kg: f64,
        angles_rad: &[f64],
        actuation: &Actuation,
    ) -> Result<Linearisation, RunFailure> {
        let variant = self.variant(payload_kg > 0.0)?;
        let system = variant.system.with_payload_mass(payload_kg);
        let mut ws = system.new_workspace();
        let start = equilibrium(&system, self.machine.file(), angles_rad, &mut ws)?;
        Ok(linearise(&system, &start.state, actuation, &mut ws)?)
    }

    /// Which path the accurate integrator takes for runs without or with payload.
    ///
    /// # Errors
    /// As [`Simulator::prepare`].
    pub fn accurate_path(&self, with_payload: bool) -> Result<AccuratePath, SimulatorError> {
        let variant = self.variant(with_payload)?;
        Ok(match (&variant.planar, &variant.tree) {
            (Ok(_), _) => AccuratePath::Planar,
            (_, Ok(_)) => AccuratePath::Tree,
            (Err(not_planar), Err(not_tree)) => AccuratePath::General {
                not_planar: not_planar.clone(),
                not_tree: not_tree.clone(),
            },
        })
    }

    /// Which equations a run with or without payload solves.
    ///
    /// # Errors
    /// As [`Simulator::prepare`].
    pub fn solver_path(
        &self,
        integrator: Integrator,
        with_payload: bool,
    ) -> Result<SolverPath, SimulatorError> {
        Ok(match integrator {
            Integrator::TrapezoidalIndex2 { .. } => SolverPath::TrapezoidalIndex2,
            Integrator::GeneralizedAlpha { .. } => SolverPath::GeneralizedAlpha,
            Integrator::Accurate => match self.accurate_path(with_payload)? {
                AccuratePath::Planar => SolverPath::Planar,
                AccuratePath::Tree => SolverPath::Tree,
                AccuratePath::General { .. } => SolverPath::General,
            },
        })
    }

    /// Whether [`Simulator::run_batch`] simulates runs side by side, rather than one after the other.
    #[must_use]
    pub fn runs_side_by_side(&self, settings: &RunSettings, with_payload: bool) -> bool {
        settings.integrator == Integrator::Accurate
            && matches!(self.accurate_path(with_payload), Ok(AccuratePath::Planar))
    }

    /// Simulates many runs on the calling thread; results in the order of the inputs, each bit for
    /// bit what [`Simulator::run`] gives. Where the accurate integrator has minimal coordinates,
    /// runs share the vector registers: they cost a third of what they cost alone if many have one payload,
    /// and half if each has its own.
    #[must_use]
    pub fn run_batch(
        &self,
        inputs: &[RunInput],
        settings: &RunSettings,
    ) -> Vec<Result<Trajectory, RunFailure>> {
        let mut results: Vec<Option<Result<Trajectory, RunFailure>>> = inputs.iter().map(|_| None).collect();
        for with_payload in [false, true] {
            let wanted = inputs.iter().any(|i| (i.payload_kg > 0.0) == with_payload);
            if !wanted || settings.integrator != Integrator::Accurate {
                continue;
            }
            let Ok(Variant {
                planar: Ok(model), ..
            }) = self.variant(with_payload)
            else {
                continue;
            };
            let (places, group): (Vec<usize>, Vec<RunInput>) = inputs
                .iter()
                .enumerate()
                .filter(|(_, input)| (input.payload_kg > 0.0) == with_payload)
                .filter(|(_, input)| check(self.machine.file(), input, settings).is_ok())
                .map(|(place, input)| (place, input.clone()))
                .unzip();
            let mut ws = fast::Workspace::default();
            let runs = model.run_batch(&group, settings.sample_time_s, ACCURATE_TOLERANCE, &mut ws);
            for (place, run) in places.into_iter().zip(runs) {
                results[place] = Some(run);
            }
        }
        // What is left goes the general way, or fails there with its reason.
        results
            .into_iter()
            .zip(inputs)
            .map(|(result, input)| result.unwrap_or_else(|| self.run(input, settings)))
            .collect()
    }

    /// Simulates one run.
    ///
    /// # Errors
    /// Where a run fails: it is data, with its reason.
    pub fn run(&self, input: &RunInput, settings: &RunSettings) -> Result<Trajectory, RunFailure> {
        self.run_within(input, settings, ACCURATE_TOLERANCE)
    }

    /// Simulates one run with the accurate integrator to another tolerance than its own 1e-3: the largest error of
    /// any channel but accelerations, over the channel's range. A tighter one shows how far `accurate` is from
    /// converged; below 1e-3 the solution costs more, about as tolerance^(-1/2) on the general path.
    ///
    /// # Errors
    /// As [`Simulator::run`], or if the tolerance is not within 1e-8 and 1e-2.
    pub fn run_to(
        &self,
        input: &RunInput,
        sample_time_s: f64,
        tolerance: f64,
    ) -> Result<Trajectory, RunFailure> {
        if !(1e-8..=1e-2).contains(&tolerance) {
            return Err(InputError::Number {
                name: "tolerance",
                value: tolerance,
                allowed: "between 1e-8 and 1e-2",
            }
            .into());
        }
        let settings = RunSettings {
            integrator: Integrator::Accurate,
            sample_time_s,
        };
        self.run_within(input, &settings, tolerance)
    }

    fn run_within(
        &self,
        input: &RunInput,
        settings: &RunSettings,
        tolerance: f64,
    ) -> Result<Trajectory, RunFailure> {
        check(self.machine.file(), input, settings)?;
        let variant = self.variant(input.payload_kg > 0.0)?;
        if let (Integrator::Accurate, Ok(model)) = (settings.integrator, &variant.planar) {
            let mut ws = fast::Workspace::default();
            return model.run(input, settings.sample_time_s, tolerance, &mut ws);
        }
        if let (Integrator::Accurate, Ok(model)) = (settings.integrator, &variant.tree) {
            let model = model.with_payload_mass(input.payload_kg);
            return model.run(self.machine.file(), input, settings.sample_time_s, tolerance);
        }
        let system = variant.system.with_payload_mass(input.payload_kg);
        // What is held rests: the loose start belongs to runs that move, where its transient is part of the answer.
        let is_held = input.valves_ratio.iter().flatten().all(|ratio| *ratio == 0.0);
        let find_start = if is_held { equilibrium } else { general_start };
        let start = find_start(
            &system,
            self.machine.file(),
            &input.angles_rad,
            &mut system.new_workspace(),
        )?;
        let run = GeneralRun {
            system: &system,
            recorder: &variant.recorder,
            start: &start.state,
            valves_ratio: &input.valves_ratio,
            sample_time_s: settings.sample_time_s,
        };
        let trajectory = match settings.integrator {
            Integrator::TrapezoidalIndex2 { step_s } => {
                let steps = steps_per_sample(settings.sample_time_s, step_s)?;
                run.fixed(Scheme::TRAPEZOIDAL_INDEX_2, steps)
            }
            Integrator::GeneralizedAlpha { step_s } => {
                let steps = steps_per_sample(settings.sample_time_s, step_s)?;
                run.fixed(Scheme::generalized_alpha(SPECTRAL_RADIUS), steps)
            }
            Integrator::Accurate => run.accurate(&self.channels, tolerance),
        };
        let mut trajectory = trajectory?;
        trajectory.statistics.path = match settings.integrator {
            Integrator::TrapezoidalIndex2 { .. } => SolverPath::TrapezoidalIndex2,
            Integrator::GeneralizedAlpha { .. } => SolverPath::GeneralizedAlpha,
            Integrator::Accurate => SolverPath::General,
        };
        Ok(trajectory)
    }
}

impl Reach for Simulator {
    /// On the undeformed machine. A configuration whose loops do not close is none to start from.
    fn can_start(&self, with_payload: bool, angles_rad: &[f64]) -> bool {
        let file = self.machine.file();
        let closed_form: Option<Vec<f64>> = file
            .cylinders
            .iter()
            .map(|cylinder| self.machine.start_length_m(cylinder, angles_rad))
            .collect();
        let lengths_m = match closed_form {
            Some(lengths_m) => lengths_m,
            None => match self
                .variant(with_payload)
                .map(|variant| (&variant.tree, &variant.system))
            {
                Ok((Ok(tree), _)) => match tree.start_lengths_m(file, angles_rad) {
                    Ok(lengths_m) => lengths_m,
                    Err(_) => return false,
                },
                Ok((Err(_), system)) => {
                    match start_lengths_m(system, file, angles_rad, &mut system.new_workspace()) {
                        Ok(lengths_m) => lengths_m,
                        Err(_) => return false,
                    }
                }
                // A machine that cannot run is refused elsewhere, with its reason.
                Err(_) => return true,
            },
        };
        file.cylinders.iter().zip(lengths_m).all(|(cylinder, length_m)| {
            let whole = [
                cylinder.closed_length_m,
                cylinder.closed_length_m + cylinder.stroke_m,
            ];
            let [least, most] = cylinder.start_length_m.unwrap_or(whole);
            (least..=most).contains(&length_m)
        })
    }
}

/// Checks a run against the machine.
fn check(file: &MachineFile, input: &RunInput, settings: &RunSettings) -> Result<(), InputError> {
    if input.valves_ratio.len() != file.cylinders.len() {
        return Err(InputError::ValveCount {
            given: input.valves_ratio.len(),
            expected: file.cylinders.len(),
        });
    }
    let samples = input.valves_ratio.first().map_or(0, Vec::len);
    for valve in &input.valves_ratio {
        if valve.len() != samples {
            return Err(InputError::ValveLengths {
                first: samples,
                other: valve.len(),
            });
        }
        if let Some(k) = valve.iter().position(|u| !(-1.0..=1.0).contains(u)) {
            return Err(InputError::ValveRange {
                value: valve[k],
                sample: k + 1,
            });
        }
    }
    let positive = |name, value: f64| {
        if value.is_finite() && value > 0.0 {
            Ok(())
        } else {
            Err(InputError::Number {
                name,
                value,
                allowed: "positive",
            })
        }
    };
    positive("sample time", settings.sample_time_s)?;
    if let Integrator::TrapezoidalIndex2 { step_s } | Integrator::GeneralizedAlpha { step_s } =
        settings.integrator
    {
        positive("step", step_s)?;
    }
    if !(input.payload_kg.is_finite() && input.payload_kg >= 0.0) {
        return Err(InputError::Number {
            name: "payload",
            value: input.payload_kg,
            allowed: "not negative",
        });
    }
    if let Some(value) = input.angles_rad.iter().find(|a| !a.is_finite()) {
        return Err(InputError::Number {
            name: "angle",
            value: *value,
            allowed: "a number of radians",
        });
    }
    Ok(())
}

/// Whole number of steps in a sample.
fn steps_per_sample(sample_time_s: f64, step_s: f64) -> Result<u32, InputError> {
    let ratio = sample_time_s / step_s;
    let whole = ratio.round();
    // Decimal fractions like 0.005/0.00005 are whole up to rounding.
    if (1.0..=1e6).contains(&whole) && (ratio - whole).abs() < 1e-9 * whole {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "checked to be within 1 and 1e6"
        )]
        return Ok(whole as u32);
    }
    Err(InputError::Number {
        name: "step",
        value: step_s,
        allowed: "a whole fraction of the sample time",
    })
}
