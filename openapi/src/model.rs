//! A trained model as stored and sent: `config.json` of a model folder, its metrics, a training's
//! progress and result.
//!
//! Quantities are in the unit of their column. Nothing here depends on the time or the host of a
//! training, so the same seed gives the same folder, byte for byte.

use crate::job::TrainingSpec;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Version of [`ModelConfig`] that this code writes.
pub const MODEL_FORMAT_VERSION: u32 = 1;

/// `config.json` of a model folder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ModelConfig {
    /// [`MODEL_FORMAT_VERSION`] of the writer.
    pub format_version: u32,
    /// `best`, or the letters of the paper.
    pub structure: String,
    /// Samples in a window; the estimate belongs to the last one.
    pub window_steps: usize,
    /// Window in time, `window_steps · sample_time_s`.
    pub window_s: f64,
    /// Time between samples.
    pub sample_time_s: f64,
    /// Channels in, in the order in which they stand in a window row.
    pub inputs: Vec<ScaledChannel>,
    /// Channels out.
    pub targets: Vec<ScaledChannel>,
    /// Samples that the network estimates at once, the last ones of the window: it gives `output_steps` rows of the
    /// targets, oldest first. Estimates are the last row.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub output_steps: usize,
    /// Whether a linear map (`skip.*`) is added to the network's output: a map of the last `window_steps + 1 − output_steps` samples up to
    /// each one that is estimated.
    pub linear_skip: bool,
    /// Slow signals that the coefficients of the linear map follow; absent when they are constant.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub schedule: Option<Schedule>,
    /// The payload that the coefficients of the linear map follow beside the slow signals, where training runs had different ones;
    /// absent: they do not.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub payload: Option<FollowedPayload>,
    /// Smallest and largest value of each input, in its column's unit, at which it is held before it enters
    /// the model: far outside its training data a polynomial says nothing, and says it loudly. Absent: not held.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub input_limits: Vec<[f64; 2]>,
    /// Bounds of the estimates; absent in models of earlier versions, whose estimates are not bounded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub guard: Option<Guard>,
    /// Layers of the network (`net.*`), first to last; empty when the skip is the whole model.
    pub layers: Vec<DenseLayer>,
    /// Where the model comes from.
    pub provenance: ModelProvenance,
    /// Errors on the validation runs, single step, one per target.
    pub validation: Vec<TargetMetrics>,
    /// The same errors for least squares on the same windows.
    pub validation_least_squares: Vec<TargetMetrics>,
    /// Half widths of 90 % intervals, one per target; absent when too few validation windows.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub intervals: Vec<IntervalTable>,
    /// The region of inputs that the model was trained on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub envelope: Option<Envelope>,
    /// Windows with their estimates, checked whenever the model is loaded.
    pub golden: Vec<GoldenPrediction>,
}

impl ModelConfig {
    /// Samples that the linear map takes for each sample that is estimated, that one among them.
    #[must_use]
    pub fn skip_steps(&self) -> usize {
        (self.window_steps + 1).saturating_sub(self.output_steps)
    }
}

fn one() -> usize {
    1
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "the signature is serde's")]
fn is_one(steps: &usize) -> bool {
    *steps == 1
}

/// A channel with the affine map into the network's numbers: `scaled = (value − offset) / scale`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ScaledChannel {
    /// Column name, unit last.
    pub name: String,
    /// Unit as text.
    pub unit: String,
    /// Offset, in the column's unit.
    pub offset: f64,
    /// Scale, in the column's unit, positive.
    pub scale: f64,
}

/// The skip's coefficients are polynomials of slow signals at the end of the window:
///
/// ```text
/// skip = Σ_t m_t · (W_t window + b_t),   m_t = Π_c u_c ^ exponents[t][c],
/// u_c = clamp((value_c − centre_c) / half_range_c, −1, 1)
/// ```
///
/// Row `t · targets + target` of `skip.weight` and `skip.bias` belongs to term t and that target.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Schedule {
    /// Positions of the slow signals among the inputs.
    pub inputs: Vec<usize>,
    /// Middle of the range in which the coefficients follow a signal, in its column's unit.
    pub centre: Vec<f64>,
    /// Half of that range, in its column's unit; beyond it the coefficients stay what they are at its edge.
    pub half_range: Vec<f64>,
    /// One row per term: the exponent of each signal.
    pub exponents: Vec<Vec<u32>>,
}

/// A payload that nobody tells the model: estimated from the window, each estimate better than the one before, because its
/// coefficients follow that one.
///
/// ```text
/// e_k = Σ_t m_t · (W_t window + b_t)        (tensors `payload.k.weight`, `payload.k.bias`, in f64)
/// ```
///
/// with the schedule `estimates[k]`. `e` is the payload in units of its range, `(payload − centre_kg) / half_range_kg`. The schedules
/// of the later estimates and of the skip have an exponent more per term than slow signals, the last one: that of
/// `clamp(e_(k−1), −1, 1)`. Where there is `empty` and the last estimate is below its limit, the linear map `empty.*` takes the
/// place of the skip, and the network's output is multiplied by its gain.
///
/// With `output_steps` above 1 all of it is done for each estimated sample, with the samples up to it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct FollowedPayload {
    /// Middle of the range, kg.
    pub centre_kg: f64,
    /// Half of it, kg; beyond it the coefficients stay what they are at its edge.
    pub half_range_kg: f64,
    /// Of each estimate, first to last.
    pub estimates: Vec<Schedule>,
    /// The machine without payload, which is another one: nothing hangs on its interface.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub empty: Option<EmptyMachine>,
}

/// The linear map (`empty.*`) of a machine without payload.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EmptyMachine {
    /// A machine whose estimated payload is below this counts as empty, kg.
    pub below_kg: f64,
    /// Of its linear map.
    pub schedule: Schedule,
    /// What the network's output is multiplied by for such a machine, one value per target: this map leaves less over. Absent: 1.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub network_gain: Vec<f64>,
}

/// Bounds of the estimates, one value per target, in its column's unit:
///
/// ```text
/// guide = guard.weight · scaled window + guard.bias        (unscaled; tensors of `model.safetensors`)
/// estimate = clamp(clamp(model, guide − slack, guide + slack), min, max)
/// ```
///
/// The guide is a linear map with small coefficients, which cannot be far off when the window is unlike all training
/// windows; the model's large coefficients can. On the training runs no estimate is changed. Where one is, the window is
/// outside the envelope.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Guard {
    /// Largest distance of an estimate from the guide.
    pub slack: Vec<f64>,
    /// Smallest estimate.
    pub min: Vec<f64>,
    /// Largest estimate.
    pub max: Vec<f64>,
}

/// `output = activation(weight · input + bias)`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct DenseLayer {
    /// Prefix of the layer's tensors: `net.0` owns `net.0.weight` (outputs × inputs) and `net.0.bias`.
    pub name: String,
    /// Values in.
    pub inputs: usize,
    /// Values out.
    pub outputs: usize,
    /// Applied one after the other to each output; most layers have one, the last has none.
    pub activations: Vec<Activation>,
}

/// Scalar function after a layer; the letter is the paper's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Activation {
    /// `T`: tanh x.
    Tanh,
    /// `S`: 1 / (1 + e⁻ˣ).
    Sigmoid,
    /// `R`: max(x, 0).
    Relu,
    /// `E`: x for x > 0, eˣ − 1 otherwise.
    Elu,
    /// x / (1 + e⁻ˣ).
    Silu,
}

/// Where a model comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ModelProvenance {
    /// What was asked for, defaults filled in.
    pub spec: TrainingSpec,
    /// Hash of the data set (SHA-256 of its `SHA256SUMS`), or of the samples where it has none.
    pub dataset_sha256: String,
    /// Training runs used.
    pub train_runs: usize,
    /// Validation runs used.
    pub validation_runs: usize,
    /// Windows on which intervals and envelope were calibrated: of runs without a flag that were not trained on.
    #[serde(default)]
    pub calibration_windows: usize,
    /// Longest of these runs.
    #[serde(default)]
    pub calibration_s: f64,
    /// Training windows in an epoch.
    pub train_windows: usize,
    /// Epochs done.
    pub epochs: usize,
    /// Epoch whose weights were kept.
    pub best_epoch: usize,
    /// Adam's learning rate at the start.
    pub learning_rate: f64,
    /// Windows per batch.
    pub batch: usize,
    /// Ridge of the linear map, relative to the largest eigenvalue of the windows' covariance.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ridge: Option<f64>,
    /// Learning curve.
    pub history: Vec<EpochRecord>,
    /// Why the training ended.
    pub ended_by: TrainingEnd,
    /// Version of hydroflex.
    pub hydroflex_version: String,
    /// Version of the tensor framework.
    pub burn_version: String,
}

/// A point of the learning curve: mean squared errors of the network's scaled outputs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EpochRecord {
    /// Epochs done.
    pub epoch: usize,
    /// Training windows, mean over the epoch.
    pub train_loss: f64,
    /// Validation windows.
    pub validation_loss: f64,
}

/// Why a training ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum TrainingEnd {
    /// The number of epochs was reached.
    Epochs,
    /// The time limit was reached.
    TimeLimit,
    /// The training loss fell below the threshold.
    LossThreshold,
    /// The validation error had not improved for a long time.
    EarlyStopping,
    /// Nothing to iterate: the linear map alone.
    LeastSquares,
}

/// Errors of one target, in its column's unit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct TargetMetrics {
    /// Column.
    pub target: String,
    /// Its unit.
    pub unit: String,
    /// Estimates compared.
    pub samples: u64,
    /// Mean absolute error.
    pub mae: f64,
    /// Root of the mean squared error.
    pub rmse: f64,
    /// Largest absolute error.
    pub max: f64,
    /// 95th percentile of the absolute error.
    pub p95: f64,
    /// Largest minus smallest reference value.
    pub range: f64,
    /// `mae / range`; 0 when the reference is constant.
    pub mae_relative_to_range: f64,
    /// Coefficient of determination; 0 when the reference is constant.
    pub r2: f64,
    /// Part of the samples inside the 90 % interval, where the model has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub coverage: Option<f64>,
    /// The same in thirds of the samples by the size of the reference: its distance from the target's training mean.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub coverage_thirds: Option<[f64; 3]>,
    /// Mean width of the intervals.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub interval_width: Option<f64>,
}

/// 90 % intervals by conformal prediction, in classes of the estimate's distance from the target's
/// mean: an estimate `y` has the half width of the first class whose `upper_edge ≥ |y − centre|`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct IntervalTable {
    /// Centre of the classes, in the column's unit.
    pub centre: f64,
    /// Upper edges of the classes but the last, ascending, in the column's unit.
    pub upper_edges: Vec<f64>,
    /// Half widths, one per class, in the column's unit.
    pub half_widths: Vec<f64>,
    /// Where the model follows a payload: what the half width is multiplied by.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub payload: Option<PayloadWidths>,
}

/// Factors of half widths in classes of the last estimate of the payload, that of the first class whose `upper_edge_kg` is at least the estimate.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct PayloadWidths {
    /// Upper edges of the classes but the last, ascending, kg.
    pub upper_edges_kg: Vec<f64>,
    /// Factors, one per class.
    pub factors: Vec<f64>,
}

/// Region of the training windows: a window is inside when every value is within the range of its channel
/// and, in each group, the mean square of its coordinates is at most the group's limit.
///
/// The coordinates are the window's principal components, divided by their standard deviation (tensors `envelope.*`
/// of `auxiliary.safetensors`), largest variance first. Those of large variance tell unusual motions; those of
/// small variance are relations that the physics keeps, which a stuck sensor or another payload breaks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Envelope {
    /// Rows of `envelope.weight`.
    pub components: usize,
    /// Consecutive components of similar variance; together they are all of them.
    pub groups: Vec<EnvelopeGroup>,
    /// Smallest value of each input, in its column's unit.
    pub min: Vec<f64>,
    /// Largest value of each input, in its column's unit.
    pub max: Vec<f64>,
}

/// Components that are judged together.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EnvelopeGroup {
    /// How many.
    pub components: usize,
    /// Largest mean square of the coordinates inside the envelope.
    pub limit: f64,
}

/// A window and what the model says about it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct GoldenPrediction {
    /// `window_steps` rows of the inputs, row by row, in the columns' units.
    pub window: Vec<f64>,
    /// One estimate per target, in the columns' units.
    pub estimates: Vec<f64>,
}

/// Result of a training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ModelSummary {
    /// SHA-256 over the files of the model folder.
    pub model_sha256: String,
    /// Hash of the data set.
    pub dataset_sha256: String,
    /// Structure.
    pub structure: String,
    /// Channels in.
    pub inputs: Vec<String>,
    /// Channels out.
    pub targets: Vec<String>,
    /// Samples in a window.
    pub window_steps: usize,
    /// Window in time.
    pub window_s: f64,
    /// Epochs done.
    pub epochs: usize,
    /// Why the training ended.
    pub ended_by: TrainingEnd,
    /// Weights and biases.
    pub parameters: usize,
    /// Time spent training, of all attempts together.
    pub train_seconds: f64,
    /// Errors on the validation runs.
    pub validation: Vec<TargetMetrics>,
    /// The same for least squares on the same windows.
    pub validation_least_squares: Vec<TargetMetrics>,
}

/// Result of `hydroflex evaluate`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct EvaluationReport {
    /// Hash of the model folder.
    pub model_sha256: String,
    /// Hash of the data set.
    pub dataset_sha256: String,
    /// Runs evaluated.
    pub runs: usize,
    /// Errors of the model, one per target.
    pub targets: Vec<TargetMetrics>,
    /// Errors of simple estimators on the same samples.
    pub baselines: Vec<BaselineMetrics>,
    /// Part of the windows inside the model's envelope, where it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inside_envelope: Option<f64>,
    /// What the envelope flags, by whether the windows stay within the cylinder lengths of the training runs; where the model has
    /// an envelope and sees lengths.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flagged_by_length: Option<FlaggedByLength>,
}

/// Flagged windows within and beyond the cylinder lengths of the training runs: of honest runs, those within are false alarms.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FlaggedByLength {
    /// Part of the windows with a sample in which a cylinder is shorter or longer than in any training run.
    pub beyond: f64,
    /// Part of the other windows that are flagged; absent where there are none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flagged_within: Option<f64>,
    /// Part of the windows beyond that are flagged; absent where there are none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flagged_beyond: Option<f64>,
}

/// Errors of a simple estimator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct BaselineMetrics {
    /// `least_squares`: linear map of the same window, fitted on the model's training runs;
    /// `quasi_static`: linear map of the window's last row;
    /// `persistence`: the true value where the window begins, as if the structure had been measured until then.
    pub name: String,
    /// One per target.
    pub targets: Vec<TargetMetrics>,
}

/// How often the envelope flags a fault of the sensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FaultRate {
    /// What is wrong.
    pub fault: String,
    /// Windows in which it can be known.
    pub windows: u64,
    /// Part of them that are flagged.
    pub flagged: f64,
    /// Cases with such windows.
    pub cases: u64,
    /// Part of them with a flag.
    pub found: f64,
}
