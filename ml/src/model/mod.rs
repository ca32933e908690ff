//! The model folder: everything that is needed to predict, to judge and to make the model again.
//!
//! | file | content |
//! |---|---|
//! | `config.json` | [`ModelConfig`]: window, channels, scales, layers, metrics, provenance, golden predictions |
//! | `model.safetensors` | `net.N.weight`, `net.N.bias`, `skip.weight`, `skip.bias` (f64), `guard.weight`, `guard.bias`, as PyTorch has them |
//! | `auxiliary.safetensors` | linear baselines, envelope |
//! | `model.onnx` | the same network with the scales in its graph |
//! | `README.md` | model card |
//! | `distribution.svg`, `learning.svg` | its pictures |
//! | `SHA256SUMS` | hashes of the others; its own hash names the model |

pub mod write;
pub mod weights;
pub mod card;
pub mod onnx;

use crate::predict::Predictor;
use hydroflex_openapi::model::{MODEL_FORMAT_VERSION, ModelConfig, Schedule};
use sha2::{Digest, Sha256};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use weights::{Auxiliary, Weights};

/// Largest difference of a golden prediction at load, relative to the target's scale: another
/// processor sums in another order.
const GOLDEN_TOLERANCE: f64 = 1e-5;

/// Why a model folder cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A file.
    #[error("cannot {action} {}", path.display())]
    File {
        /// `read` or `write`.
        action: &'static str,
        /// File.
        path: PathBuf,
        /// Cause.
        #[source]
        source: std::io::Error,
    },
    /// A model would be written over what is not one.
    #[error("{} {what}; a model is written to a folder that is absent or empty, or replaces another model", path.display())]
    Occupied {
        /// Folder.
        path: PathBuf,
        /// What is there.
        what: String,
    },
    /// `config.json` is not what this version reads.
    #[error("cannot read {}", path.display())]
    Config {
        /// File.
        path: PathBuf,
        /// Cause.
        #[source]
        source: serde_json::Error,
    },
    /// Another format.
    #[error("{} has format {found}, this version reads {}", path.display(), MODEL_FORMAT_VERSION)]
    Format {
        /// File.
        path: PathBuf,
        /// Its version.
        found: u32,
    },
    /// Tensors.
    #[error("cannot read tensors of {}", path.display())]
    Tensors {
        /// File.
        path: PathBuf,
        /// Cause.
        #[source]
        source: safetensors::SafeTensorError,
    },
    /// A tensor is missing or has another shape than the configuration says.
    #[error("{}: tensor {name:?} should have shape {expected:?}, it has {found:?}", path.display())]
    TensorShape {
        /// File.
        path: PathBuf,
        /// Tensor.
        name: String,
        /// By the configuration.
        expected: Vec<usize>,
        /// In the file; absent when it is not there.
        found: Option<Vec<usize>>,
    },
    /// The configuration contradicts itself.
    #[error("{}: {what}", path.display())]
    Inconsistent {
        /// File.
        path: PathBuf,
        /// In which way.
        what: &'static str,
    },
    /// A file differs from its hash.
    #[error("{} does not have the hash that SHA256SUMS gives", path.display())]
    Hash {
        /// File.
        path: PathBuf,
    },
    /// A golden prediction is not reproduced.
    #[error(
        "golden prediction {index} of {target:?}: the stored value is {expected}, this machine gives {found}"
    )]
    Golden {
        /// Which.
        index: usize,
        /// Target.
        target: String,
        /// Stored.
        expected: f64,
        /// Computed.
        found: f64,
    },
}

/// A model in memory, checked.
#[derive(Debug, Clone)]
pub struct Model {
    config: Arc<ModelConfig>,
    weights: Arc<Weights>,
    auxiliary: Arc<Auxiliary>,
    sha256: String,
    predictor: Arc<Predictor>,
}

impl Model {
    /// Reads a model folder: hashes, shapes and golden predictions are checked.
    ///
    /// # Errors
    /// Anything that would let the model answer wrongly.
    pub fn load(dir: &Path) -> Result<Self, ModelError> {
        let sha256 = check_hashes(dir)?;
        let config = read_config(&dir.join("config.json"))?;
        let weights = Weights::load(&dir.join("model.safetensors"), &config)?;
        let auxiliary = Auxiliary::load(&dir.join("auxiliary.safetensors"), &config)?;
        let predictor = Predictor::new(&config, &weights, &auxiliary);
        let model = Self {
            config: Arc::new(config),
            weights: Arc::new(weights),
            auxiliary: Arc::new(auxiliary),
            sha256,
            predictor: Arc::new(predictor),
        };
        model.check_golden()?;
        Ok(model)
    }

    /// Configuration.
    #[must_use]
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// Hash of the folder.
    #[must_use]
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// Weights.
    #[must_use]
    pub fn weights(&self) -> &Weights {
        &self.weights
    }

    /// Baselines.
    #[must_use]
    pub fn auxiliary(&self) -> &Auxiliary {
        &self.auxiliary
    }

    /// Estimates without the tensor framework; cheap to share.
    #[must_use]
    pub fn predictor(&self) -> Arc<Predictor> {
        Arc::clone(&self.predictor)
    }

    fn check_golden(&self) -> Result<(), ModelError> {
        let mut workspace = self.predictor.workspace();
        let mut estimates = vec![0.0; self.config.targets.len()];
        for (index, golden) in self.config.golden.iter().enumerate() {
            self.predictor
                .predict_window(&golden.window, &mut estimates, &mut workspace);
            for ((target, &expected), &found) in
                self.config.targets.iter().zip(&golden.estimates).zip(&estimates)
            {
                // `!(a <= b)` also catches NaN.
                #[allow(clippy::neg_cmp_op_on_partial_ord, reason = "NaN must fail")]
                if !((found - expected).abs() <= GOLDEN_TOLERANCE * target.scale.abs()) {
                    return Err(ModelError::Golden {
                        index,
                        target: target.name.clone(),
                        expected,
                        found,
                    });
                }
            }
        }
        Ok(())
    }
}

fn read(path: &Path) -> Result<Vec<u8>, ModelError> {
    fs::read(path).map_err(|source| ModelError::File {
        action: "read",
        path: path.to_owned(),
        source,
    })
}

#[allow(clippy::too_many_lines, reason = "one check after the other")]
fn read_config(path: &Path) -> Result<ModelConfig, ModelError> {
    let config_error = |source| ModelError::Config {
        path: path.to_owned(),
        source,
    };
    let value: serde_json::Value = serde_json::from_slice(&read(path)?).map_err(config_error)?;
    let found = value
        .get("format_version")
        .and_then(serde_json::Value::as_u64)
        .unwrap_or(0);
    if found != u64::from(MODEL_FORMAT_VERSION) {
        return Err(ModelError::Format {
            path: path.to_owned(),
            found: u32::try_from(found).unwrap_or(u32::MAX),
        });
    }
    let config: ModelConfig = serde_json::from_value(value).map_err(config_error)?;
    let inconsistent = |what| ModelError::Inconsistent {
        path: path.to_owned(),
        what,
    };
    let window_values = config.window_steps * config.inputs.len();
    if window_values == 0 || config.targets.is_empty() {
        return Err(inconsistent("a model needs inputs, targets and a window"));
    }
    let mut width = window_values;
    for layer in &config.layers {
        if layer.inputs != width || layer.outputs == 0 {
            return Err(inconsistent(
                "a layer does not take what the layer before it gives",
            ));
        }
        width = layer.outputs;
    }
    if !config.layers.is_empty() && Some(width) != config.output_steps.checked_mul(config.targets.len()) {
        return Err(inconsistent(
            "the last layer does not give one value per target and estimated sample",
        ));
    }
    if config.output_steps == 0 || config.output_steps > config.window_steps {
        return Err(inconsistent(
            "a network estimates one or several samples of its window",
        ));
    }
    if config.layers.is_empty() && !config.linear_skip {
        return Err(inconsistent("a model needs layers or a linear map"));
    }
    // Each schedule, and whether it follows an estimate of the payload.
    let mut schedules: Vec<(&Schedule, bool)> = Vec::new();
    schedules.extend(config.schedule.iter().map(|s| (s, config.payload.is_some())));
    if let Some(payload) = &config.payload {
        if config.schedule.is_none() || payload.estimates.is_empty() {
            return Err(inconsistent(
                "a followed payload needs an estimate and a linear map with a schedule",
            ));
        }
        if !(payload.centre_kg.is_finite()
            && payload.half_range_kg.is_finite()
            && payload.half_range_kg > 0.0
            && payload.empty.as_ref().is_none_or(|e| e.below_kg.is_finite()))
        {
            return Err(inconsistent("the followed payload's range is none"));
        }
        let gain = payload
            .empty
            .as_ref()
            .map_or(&[][..], |empty| &empty.network_gain);
        if !(gain.is_empty() || gain.len() == config.targets.len()) || gain.iter().any(|g| !g.is_finite()) {
            return Err(inconsistent(
                "the network's gain for empty machines must be finite, one value per target",
            ));
        }
        schedules.extend(payload.estimates.iter().enumerate().map(|(k, s)| (s, k > 0)));
        schedules.extend(payload.empty.iter().map(|empty| (&empty.schedule, false)));
    }
    for (schedule, follows) in schedules {
        let signals = schedule.inputs.len();
        if !config.linear_skip || schedule.exponents.is_empty() {
            return Err(inconsistent(
                "a schedule needs a linear map and at least one term",
            ));
        }
        if schedule.centre.len() != signals
            || schedule.half_range.len() != signals
            || (schedule.exponents.iter()).any(|e| e.len() != signals + usize::from(follows))
            || schedule.inputs.iter().any(|&i| i >= config.inputs.len())
            || schedule.half_range.iter().any(|h| !(h.is_finite() && *h > 0.0))
        {
            return Err(inconsistent(
                "the schedule's signals, ranges and exponents do not fit together",
            ));
        }
    }
    if config.envelope.as_ref().is_some_and(|envelope| {
        envelope.groups.iter().map(|g| g.components).sum::<usize>() != envelope.components
            || envelope.min.len() != config.inputs.len()
            || envelope.max.len() != config.inputs.len()
    }) {
        return Err(inconsistent(
            "the envelope's groups or ranges do not fit its components or the inputs",
        ));
    }
    let held = &config.input_limits;
    if !held.is_empty()
        && (held.len() != config.inputs.len()
            || held
                .iter()
                .any(|[low, high]| !(low.is_finite() && low <= high && high.is_finite())))
    {
        return Err(inconsistent(
            "input limits must be finite and ordered, one pair per input",
        ));
    }
    if config.guard.as_ref().is_some_and(|guard| {
        let count = config.targets.len();
        guard.slack.len() != count
            || guard.min.len() != count
            || guard.max.len() != count
            || guard.slack.iter().any(|s| !(s.is_finite() && *s >= 0.0))
            || guard
                .min
                .iter()
                .zip(&guard.max)
                .any(|(min, max)| min.is_nan() || max.is_nan() || min > max)
    }) {
        return Err(inconsistent(
            "the bounds of the estimates must be ordered, one set per target",
        ));
    }
    let payload_widths = config.intervals.iter().filter_map(|table| table.payload.as_ref());
    if payload_widths
        .clone()
        .any(|widths| config.payload.is_none() || widths.factors.len() != widths.upper_edges_kg.len() + 1)
    {
        return Err(inconsistent(
            "intervals that follow the payload need a model that does, and a factor per class",
        ));
    }
    let scales = config.inputs.iter().chain(&config.targets);
    if scales
        .clone()
        .any(|c| !(c.scale.is_finite() && c.scale > 0.0 && c.offset.is_finite()))
    {
        return Err(inconsistent("scales must be positive and finite"));
    }
    if config
        .golden
        .iter()
        .any(|g| g.window.len() != window_values || g.estimates.len() != config.targets.len())
    {
        return Err(inconsistent(
            "a golden prediction has another shape than the model",
        ));
    }
    Ok(config)
}

/// Checks the files of `SHA256SUMS` and returns its hash.
fn check_hashes(dir: &Path) -> Result<String, ModelError> {
    let sums = read(&dir.join("SHA256SUMS"))?;
    for line in String::from_utf8_lossy(&sums).lines() {
        if let Some((hash, name)) = line.split_once("  ") {
            let path = dir.join(name);
            if hex::encode(Sha256::digest(read(&path)?)) != hash {
                return Err(ModelError::Hash { path });
            }
        }
    }
    Ok(hex::encode(Sha256::digest(&sums)))
}
