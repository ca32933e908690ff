//! What a user asks for: a job of random runs of one machine, and what to learn from it.
//!
//! Units are in the names. Absent keys take the defaults documented here; unknown keys are refused.

use crate::machine::MaterialSpec;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use utoipa::ToSchema;

/// A batch of simulated runs, and optionally the networks to train on them.
///
/// A run is a pure function of (`seed`, run index) and this specification.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct JobSpec {
    /// A title for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub title: Option<String>,
    /// Built-in machine by name, or a machine file's text (TOML).
    #[serde(default = "default_machine")]
    pub machine: MachineRef,
    /// Meshes that were uploaded, by body: `{"lift": "SHA-256 as POST /v1/meshes answered"}`. They go before
    /// those the machine file names, and are needed where it says that a mesh is given.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub meshes: BTreeMap<String, String>,
    /// Number of runs.
    pub runs: u64,
    /// Seed of every random choice.
    #[serde(default)]
    pub seed: u64,
    /// Length of a run.
    #[serde(default = "default_duration_s")]
    pub duration_s: f64,
    /// Time between samples; the valve signal is piecewise linear between them.
    #[serde(default = "default_sample_time_s")]
    pub sample_time_s: f64,
    /// Payload: a value, or a range from which each run draws uniformly.
    #[serde(default = "default_payload")]
    pub payload_kg: ValueOrRange,
    /// Materials to vary: each run draws one, of which all its flexible bodies are, and `meta/runs.parquet` names it. Absent: those of
    /// the machine file. At most 16.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub materials: Vec<MaterialRef>,
    /// Ranges of the initial angles by name (`{"lift": [-10, 50]}`); default: the machine's.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub initial_angle_deg: BTreeMap<String, [f64; 2]>,
    /// Valve signal of every cylinder.
    #[serde(default)]
    pub excitation: Excitation,
    /// How runs are divided.
    #[serde(default)]
    pub split: Split,
    /// Time integration.
    #[serde(default)]
    pub integrator: Integrator,
    /// Flags whose runs are kept in the data set but not trained on.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub exclude_flags: Vec<RunFlag>,
    /// Sample type of the published files.
    #[serde(default)]
    pub sample_type: SampleType,
    /// Columns of the samples that are kept, beside `run_id`, `step` and `time_s`; all if absent.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub columns: Vec<String>,
    /// Size at which a file of samples ends and the next begins: what such a file takes on disk, about,
    /// 1 to 4096 MB.
    #[serde(
        default = "default_file_size_mb",
        skip_serializing_if = "is_default_file_size"
    )]
    #[schema(minimum = 1, maximum = 4096)]
    pub file_size_mb: u32,
    /// Extra runs with the test signal, from which the SLIDE window follows; not counted in `runs`.
    #[serde(default = "default_settling_runs")]
    pub settling_runs: u64,
    /// Networks to train when the data set is published.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub train: Vec<TrainingSpec>,
    /// Jobs of higher priority go first, −100 to 100; of equal ones the older. No part of the data set.
    #[serde(default, skip_serializing_if = "is_default_priority")]
    #[schema(minimum = -100, maximum = 100)]
    pub priority: i32,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_default_priority(priority: &i32) -> bool {
    *priority == 0
}

fn default_file_size_mb() -> u32 {
    128
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_default_file_size(size: &u32) -> bool {
    *size == default_file_size_mb()
}

fn default_machine() -> MachineRef {
    MachineRef::BuiltIn("lift-boom".to_owned())
}
fn default_duration_s() -> f64 {
    1.0
}
fn default_sample_time_s() -> f64 {
    0.005
}
fn default_payload() -> ValueOrRange {
    ValueOrRange::Value(0.0)
}
fn default_settling_runs() -> u64 {
    8
}

impl JobSpec {
    /// Priorities that a job may have.
    pub const PRIORITIES: std::ops::RangeInclusive<i32> = -100..=100;

    /// Whether the data set has this column of the simulator's.
    #[must_use]
    pub fn keeps(&self, channel: &str) -> bool {
        self.columns.is_empty() || self.columns.iter().any(|name| name == channel)
    }

    /// Steps of a run: its length in sample times, rounded. A run has one sample more.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "`as` saturates, and validation bounds the length"
    )]
    pub fn steps(&self) -> usize {
        (self.duration_s / self.sample_time_s).round() as usize
    }
}

/// Which machine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(
    untagged,
    expecting = "invalid value, expected the name of a built-in machine, or `{\"toml\": \"…\"}` with the text of a machine file"
)]
pub enum MachineRef {
    /// A machine that the binary carries.
    BuiltIn(String),
    /// A machine file as text.
    Inline {
        /// TOML text.
        toml: String,
    },
}

/// Which material.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(
    untagged,
    expecting = "invalid value, expected `steel`, `aluminium`, `titanium`, or an object with name, youngs_modulus_pa, poisson_ratio and density_kg_per_m3"
)]
pub enum MaterialRef {
    /// `steel`, `aluminium` or `titanium`.
    Named(String),
    /// Any isotropic one.
    Given(MaterialSpec),
}

impl MaterialRef {
    /// Its name.
    #[must_use]
    pub fn name(&self) -> &str {
        match self {
            Self::Named(name) => name,
            Self::Given(material) => &material.name,
        }
    }

    /// The material; absent if nothing is known by the name.
    #[must_use]
    pub fn material(&self) -> Option<MaterialSpec> {
        match self {
            Self::Named(name) => MaterialSpec::named(name),
            Self::Given(material) => Some(material.clone()),
        }
    }
}

/// A number, or a range `{"min": a, "max": b}`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(
    untagged,
    deny_unknown_fields,
    expecting = "invalid value, expected a number, or `{\"min\": …, \"max\": …}` for a random one of each run, with `\"empty\": …` for the \
                 part of the runs at exactly 0"
)]
pub enum ValueOrRange {
    /// The same for every run.
    Value(f64),
    /// Uniform in `[min, max]`.
    Range {
        /// Smallest value.
        min: f64,
        /// Largest value.
        max: f64,
        /// Part of the runs that carry exactly nothing instead, from 0 to 1, drawn run by run. A machine without payload is another one than
        /// one with a small payload (no mass at its interface, other modes): a network knows it only if runs of it are in its training.
        #[serde(default, skip_serializing_if = "is_zero")]
        empty: f64,
    },
}

/// Whether a part is what it is by default: such specifications are written as they were before there was a choice.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_zero(part: &f64) -> bool {
    *part == 0.0
}

/// Commanded valve signal of a run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Excitation {
    /// The paper's random signal: 20 % of the samples each at +1, −1, 0, random linear ramps and
    /// uniform noise; segments shuffled, then a few samples swapped.
    #[default]
    Random,
    /// The settling test: open for a part of the run, then shut.
    OpenThenShut {
        /// Part of the run during which the valve is open, in (0, 1).
        #[serde(default = "default_open_part")]
        open_part: f64,
    },
    /// The published evaluation cycle: steps 0, +1, 0, −1 and trapezoids, stretched to the run.
    Cycle,
    /// Given values, one list per cylinder, one value per sample.
    Given {
        /// Valve values in [−1, 1] by cylinder name.
        valve_ratio: BTreeMap<String, Vec<f64>>,
    },
}

fn default_open_part() -> f64 {
    0.2
}

/// Parts of the runs, by whole runs; must sum to 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Split {
    /// Training part.
    pub train: f64,
    /// Validation part.
    pub validation: f64,
    /// Test part.
    #[serde(default)]
    pub test: f64,
}

impl Default for Split {
    fn default() -> Self {
        Self {
            train: 0.8,
            validation: 0.2,
            test: 0.0,
        }
    }
}

/// Time integration.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(tag = "kind", rename_all = "kebab-case", try_from = "IntegratorFields")]
pub enum Integrator {
    /// Error-controlled; every channel but accelerations within 1e-3 of converged.
    #[default]
    Accurate,
    /// The published scripts' scheme: Newmark β = 1/4, γ = 1/2 with velocity-level constraints.
    // As on the command line; serde's kebab case would write `trapezoidal-index2`.
    #[serde(rename = "trapezoidal-index-2")]
    TrapezoidalIndex2 {
        /// Step.
        #[serde(default = "default_sample_time_s")]
        step_s: f64,
    },
    /// Generalised-α with spectral radius 0.7 and position-level constraints.
    GeneralizedAlpha {
        /// Step.
        #[serde(default = "default_sample_time_s")]
        step_s: f64,
    },
}

/// [`Integrator`] as it is written: serde would let `accurate` have any other fields.
#[derive(Deserialize)]
#[serde(
    deny_unknown_fields,
    expecting = "`{\"kind\": \"accurate\"}`, or `trapezoidal-index-2` or `generalized-alpha` with `step_s`"
)]
struct IntegratorFields {
    kind: IntegratorKind,
    step_s: Option<f64>,
}

#[derive(Deserialize)]
#[serde(rename_all = "kebab-case")]
enum IntegratorKind {
    Accurate,
    #[serde(rename = "trapezoidal-index-2")]
    TrapezoidalIndex2,
    GeneralizedAlpha,
}

impl TryFrom<IntegratorFields> for Integrator {
    type Error = String;

    fn try_from(fields: IntegratorFields) -> Result<Self, String> {
        let step_s = fields.step_s.unwrap_or_else(default_sample_time_s);
        match (fields.kind, fields.step_s) {
            (IntegratorKind::Accurate, None) => Ok(Self::Accurate),
            (IntegratorKind::Accurate, Some(step_s)) => Err(format!(
                "step_s is {step_s}, but `accurate` chooses its steps itself, expected a fixed-step scheme \
                 (`trapezoidal-index-2`, `generalized-alpha`) where a step is given"
            )),
            (IntegratorKind::TrapezoidalIndex2, _) => Ok(Self::TrapezoidalIndex2 { step_s }),
            (IntegratorKind::GeneralizedAlpha, _) => Ok(Self::GeneralizedAlpha { step_s }),
        }
    }
}

/// What a run met on its way. A flagged run is valid data.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum RunFlag {
    /// The valve was held shut by the stroke cut-off.
    StrokeCutoff,
    /// The piston touched an end stop, or left the barrel where the machine has none.
    EndStop,
    /// A chamber reached vapour pressure (without a floor: zero).
    Cavitation,
    /// A chamber fell below tank pressure.
    BelowTankPressure,
    /// A chamber rose above supply pressure.
    AboveSupplyPressure,
}

impl RunFlag {
    /// Every flag.
    pub const ALL: [Self; 5] = [
        Self::StrokeCutoff,
        Self::EndStop,
        Self::Cavitation,
        Self::BelowTankPressure,
        Self::AboveSupplyPressure,
    ];

    /// Name in JSON and in data sets.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::StrokeCutoff => "stroke_cutoff",
            Self::EndStop => "end_stop",
            Self::Cavitation => "cavitation",
            Self::BelowTankPressure => "below_tank_pressure",
            Self::AboveSupplyPressure => "above_supply_pressure",
        }
    }

    /// The flag of that name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|flag| flag.as_str() == name)
    }
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum RunStatus {
    /// Samples are in the data set.
    Ok,
    /// No samples: the solver did not converge or a number was not finite.
    Failed,
}

/// Which equations a run solved, and how. Chosen from the integrator asked for and what the machine is.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "kebab-case")]
pub enum SolverPath {
    /// `accurate`, minimal coordinates of one boom that moves in its plane; runs go side by side.
    Planar,
    /// `accurate`, free coordinates of a planar tree of bodies with closed loops.
    Tree,
    /// `accurate`, redundant coordinates with constraints: any machine.
    #[default]
    General,
    /// The published scripts' scheme in redundant coordinates, fixed steps.
    #[serde(rename = "trapezoidal-index-2")]
    TrapezoidalIndex2,
    /// Generalised-α in redundant coordinates, fixed steps.
    GeneralizedAlpha,
}

impl SolverPath {
    /// Every path.
    pub const ALL: [Self; 5] = [
        Self::Planar,
        Self::Tree,
        Self::General,
        Self::TrapezoidalIndex2,
        Self::GeneralizedAlpha,
    ];

    /// Name in JSON and in data sets.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Planar => "planar",
            Self::Tree => "tree",
            Self::General => "general",
            Self::TrapezoidalIndex2 => "trapezoidal-index-2",
            Self::GeneralizedAlpha => "generalized-alpha",
        }
    }

    /// The path of that name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|path| path.as_str() == name)
    }
}

/// Type of samples in published files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SampleType {
    /// 64-bit.
    #[default]
    Float64,
    /// 32-bit.
    Float32,
}

/// How the length of the SLIDE window is found.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(tag = "rule", rename_all = "snake_case", deny_unknown_fields)]
pub enum WindowRule {
    /// Last time the deflection is outside 5 % of its range around its final value, counted from
    /// the closing of the valve; mean over the settling runs.
    #[default]
    Band,
    /// The paper's rule: first time after which the deflection stays below 1.05 times its mean for
    /// a tenth of the record, mean over the settling runs.
    Paper,
    /// From the damped eigenvalues of the machine, oil included: time to decay to 1 %.
    Eigenvalues,
    /// Given.
    Given {
        /// Window.
        window_s: f64,
    },
}

/// A network to train.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TrainingSpec {
    /// `best` (our default: least squares on the window plus a network for the rest), or the
    /// paper's letters: `L`, `RLR`, `TLTLT`, `TLSLTLSLT`, `ELE`, …, `RDLR` (with dropout)
    #[serde(default = "default_structure")]
    pub structure: String,
    /// Channels in; default: valve, length, velocity and both pressures of every cylinder.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub inputs: Vec<String>,
    /// Channels out; default: every structural channel except out-of-plane and axial deflection.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub targets: Vec<String>,
    /// Length of the window.
    #[serde(default)]
    pub window: WindowRule,
    /// Samples that the network estimates at once, the last ones of its window, which is longer by as many: 10, 15 and 30
    /// in the paper. Absent: the last one. Estimates of a recording or a signal are those of the last sample.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub output_steps: Option<usize>,
    /// Width of the hidden layers; default: the number of window steps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub width: Option<usize>,
    /// The width as a multiple of the number of window steps: 2 or 3 in the paper's supplement.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub width_windows: Option<usize>,
    /// Part of a layer's values that dropout (letter D) leaves out in training; default: 0.1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dropout: Option<f64>,
    /// Seed of initial weights and batches.
    #[serde(default)]
    pub seed: u64,
    /// Largest number of epochs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub epochs: Option<usize>,
    /// Largest training time; the schedule fits into it. Not reproducible to the byte.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_limit_s: Option<f64>,
    /// Adam's learning rate at the start.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub learning_rate: Option<f64>,
    /// Windows per batch.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub batch: Option<usize>,
    /// All overlapping windows (default), or the disjoint ones of the published scripts.
    #[serde(default)]
    pub windows: WindowCut,
    /// Sensor noise that is added to the inputs, in training and calibration; absent: none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub noise: Option<NoiseSpec>,
}

/// Sensor noise: a level by name, or standard deviations of the inputs by column, in their units; columns that are
/// not named are free of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(
    untagged,
    expecting = "invalid value, expected `crane`, or an object with a standard deviation per column"
)]
pub enum NoiseSpec {
    /// Measured on a machine.
    Level(NoiseLevel),
    /// White noise, standard deviations by column.
    Channels(BTreeMap<String, f64>),
}

/// Named levels of sensor noise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum NoiseLevel {
    /// As measured on a crane at rest: lengths 0.49 mm, pressures 11.7 kPa, angles 0.32°, valve commands one bit of
    /// twelve; velocities are differentiated from the noisy length.
    Crane,
}

fn default_structure() -> String {
    "best".to_owned()
}

impl TrainingSpec {
    /// Most values of a hidden layer whose width is asked for.
    pub const WIDEST: usize = 4096;
}

impl Default for TrainingSpec {
    fn default() -> Self {
        Self {
            structure: default_structure(),
            inputs: Vec::new(),
            targets: Vec::new(),
            window: WindowRule::default(),
            output_steps: None,
            width: None,
            width_windows: None,
            dropout: None,
            seed: 0,
            epochs: None,
            time_limit_s: None,
            learning_rate: None,
            batch: None,
            windows: WindowCut::default(),
            noise: None,
        }
    }
}

/// Which windows of a run are trained on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum WindowCut {
    /// Every window.
    #[default]
    Overlapping,
    /// floor(n / window) windows per run, as published.
    Disjoint,
}
