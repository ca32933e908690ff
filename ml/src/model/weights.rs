//! Tensors of a model folder.

use super::ModelError;
use crate::least_squares::LinearMap;
use crate::scheduled::ScheduledMap;
use crate::train::checkpoint::{from_bytes, to_bytes};
use hydroflex_openapi::model::{DenseLayer, ModelConfig, Schedule};
use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
use std::path::Path;

/// A linear map in f32.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LinearWeights {
    /// outputs × inputs, row-major.
    pub weight: Vec<f32>,
    /// One per output.
    pub bias: Vec<f32>,
}

impl From<&LinearMap> for LinearWeights {
    #[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
    fn from(map: &LinearMap) -> Self {
        Self {
            weight: map.weight.iter().map(|&w| w as f32).collect(),
            bias: map.bias.iter().map(|&b| b as f32).collect(),
        }
    }
}

/// A linear map in f64.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SkipWeights {
    /// (terms · targets) × window values, row-major.
    pub weight: Vec<f64>,
    /// One per row.
    pub bias: Vec<f64>,
}

impl From<&ScheduledMap> for SkipWeights {
    fn from(map: &ScheduledMap) -> Self {
        Self {
            weight: map.weight.clone(),
            bias: map.bias.clone(),
        }
    }
}

/// `model.safetensors`.
#[derive(Debug, Clone, PartialEq)]
pub struct Weights {
    /// Of each layer.
    pub layers: Vec<LinearWeights>,
    /// Of the skip, where there is one. f64: its large coefficients act on small differences of
    /// neighbouring samples.
    pub skip: Option<SkipWeights>,
    /// Of the estimates of the payload, first to last.
    pub payload: Vec<SkipWeights>,
    /// Of the linear map of a machine without payload.
    pub empty: Option<SkipWeights>,
    /// The guide of the estimates, where the configuration has bounds.
    pub guard: Option<LinearWeights>,
}

/// `auxiliary.safetensors`: estimators to compare with, and the envelope's projection.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Auxiliary {
    /// Least squares on the whole window.
    pub least_squares: LinearWeights,
    /// Least squares on the window's last row.
    pub quasi_static: LinearWeights,
    /// Rows that whiten a window (no bias: the offset is in it).
    pub envelope: Option<LinearWeights>,
}

struct Tensor {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

/// Weight and bias from little-endian bytes.
fn pair(prefix: &str, dtype: Dtype, outputs: usize, inputs: usize, bytes: [Vec<u8>; 2]) -> [Tensor; 2] {
    let [weight, bias] = bytes;
    let tensor = |part: &str, shape: Vec<usize>, bytes| Tensor {
        name: format!("{prefix}.{part}"),
        dtype,
        shape,
        bytes,
    };
    [
        tensor("weight", vec![outputs, inputs], weight),
        tensor("bias", vec![outputs], bias),
    ]
}

fn linear(prefix: &str, map: &LinearWeights) -> [Tensor; 2] {
    let outputs = map.bias.len();
    let bytes = [to_bytes(&map.weight), to_bytes(&map.bias)];
    pair(
        prefix,
        Dtype::F32,
        outputs,
        map.weight.len() / outputs.max(1),
        bytes,
    )
}

fn skip_tensors(prefix: &str, map: &SkipWeights) -> [Tensor; 2] {
    let outputs = map.bias.len();
    let bytes = [&map.weight, &map.bias].map(|values| values.iter().flat_map(|v| v.to_le_bytes()).collect());
    pair(
        prefix,
        Dtype::F64,
        outputs,
        map.weight.len() / outputs.max(1),
        bytes,
    )
}

fn to_file(tensors: &[Tensor]) -> Result<Vec<u8>, safetensors::SafeTensorError> {
    let views = tensors
        .iter()
        .map(|t| {
            Ok((
                t.name.as_str(),
                TensorView::new(t.dtype, t.shape.clone(), &t.bytes)?,
            ))
        })
        .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()?;
    serialize(views, None)
}

struct Reader<'a> {
    path: &'a Path,
    tensors: SafeTensors<'a>,
}

impl<'a> Reader<'a> {
    fn new(path: &'a Path, content: &'a [u8]) -> Result<Self, ModelError> {
        let tensors = SafeTensors::deserialize(content).map_err(|source| ModelError::Tensors {
            path: path.to_owned(),
            source,
        })?;
        Ok(Self { path, tensors })
    }

    fn take(&self, name: &str, expected: &[usize]) -> Result<Vec<f32>, ModelError> {
        self.bytes(name, Dtype::F32, expected).map(from_bytes)
    }

    fn take_f64(&self, name: &str, expected: &[usize]) -> Result<Vec<f64>, ModelError> {
        let bytes = self.bytes(name, Dtype::F64, expected)?;
        Ok(bytes
            .as_chunks::<8>()
            .0
            .iter()
            .map(|b| f64::from_le_bytes(*b))
            .collect())
    }

    fn bytes(&self, name: &str, dtype: Dtype, expected: &[usize]) -> Result<&'a [u8], ModelError> {
        let tensor = self.tensors.tensor(name).ok().filter(|t| t.dtype() == dtype);
        match tensor {
            Some(tensor) if tensor.shape() == expected => Ok(tensor.data()),
            other => Err(ModelError::TensorShape {
                path: self.path.to_owned(),
                name: name.to_owned(),
                expected: expected.to_vec(),
                found: other.map(|t| t.shape().to_vec()),
            }),
        }
    }

    fn linear(&self, prefix: &str, outputs: usize, inputs: usize) -> Result<LinearWeights, ModelError> {
        Ok(LinearWeights {
            weight: self.take(&format!("{prefix}.weight"), &[outputs, inputs])?,
            bias: self.take(&format!("{prefix}.bias"), &[outputs])?,
        })
    }
}

impl Weights {
    /// Content of the file.
    ///
    /// # Errors
    /// A shape does not fit its values.
    pub fn to_file(&self, layers: &[DenseLayer]) -> Result<Vec<u8>, safetensors::SafeTensorError> {
        let mut tensors: Vec<Tensor> = layers
            .iter()
            .zip(&self.layers)
            .flat_map(|(layer, map)| linear(&layer.name, map))
            .collect();
        if let Some(skip) = &self.skip {
            tensors.extend(skip_tensors("skip", skip));
        }
        for (k, map) in self.payload.iter().enumerate() {
            tensors.extend(skip_tensors(&format!("payload.{k}"), map));
        }
        if let Some(empty) = &self.empty {
            tensors.extend(skip_tensors("empty", empty));
        }
        if let Some(guard) = &self.guard {
            tensors.extend(linear("guard", guard));
        }
        to_file(&tensors)
    }

    /// Reads the file; every tensor must have the shape that `config` says.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn load(path: &Path, config: &ModelConfig) -> Result<Self, ModelError> {
        let content = super::read(path)?;
        let reader = Reader::new(path, &content)?;
        let layers = config
            .layers
            .iter()
            .map(|layer| reader.linear(&layer.name, layer.outputs, layer.inputs))
            .collect::<Result<_, _>>()?;
        let window_values = config.window_steps * config.inputs.len();
        let skip_values = config.skip_steps() * config.inputs.len();
        let targets = config.targets.len();
        let map = |prefix: &str, schedule: Option<&Schedule>, targets: usize| -> Result<_, ModelError> {
            let rows = schedule.map_or(1, |s| s.exponents.len()) * targets;
            Ok(SkipWeights {
                weight: reader.take_f64(&format!("{prefix}.weight"), &[rows, skip_values])?,
                bias: reader.take_f64(&format!("{prefix}.bias"), &[rows])?,
            })
        };
        let skip = (config.linear_skip)
            .then(|| map("skip", config.schedule.as_ref(), targets))
            .transpose()?;
        let followed = config.payload.as_ref();
        let payload = followed.map_or(&[][..], |payload| &payload.estimates);
        let payload = (payload.iter().enumerate())
            .map(|(k, schedule)| map(&format!("payload.{k}"), Some(schedule), 1))
            .collect::<Result<_, _>>()?;
        let empty = followed
            .and_then(|payload| payload.empty.as_ref())
            .map(|empty| map("empty", Some(&empty.schedule), targets))
            .transpose()?;
        let guard = config
            .guard
            .as_ref()
            .map(|_| reader.linear("guard", config.targets.len(), window_values))
            .transpose()?;
        Ok(Self {
            layers,
            skip,
            payload,
            empty,
            guard,
        })
    }
}

impl Auxiliary {
    /// Content of the file.
    ///
    /// # Errors
    /// A shape does not fit its values.
    pub fn to_file(&self) -> Result<Vec<u8>, safetensors::SafeTensorError> {
        let mut tensors: Vec<Tensor> = Vec::new();
        tensors.extend(linear("least_squares", &self.least_squares));
        tensors.extend(linear("quasi_static", &self.quasi_static));
        if let Some(envelope) = &self.envelope {
            tensors.extend(linear("envelope", envelope));
        }
        to_file(&tensors)
    }

    /// Reads the file.
    ///
    /// # Errors
    /// A tensor is missing or has another shape.
    pub fn load(path: &Path, config: &ModelConfig) -> Result<Self, ModelError> {
        let content = super::read(path)?;
        let reader = Reader::new(path, &content)?;
        let window_values = config.window_steps * config.inputs.len();
        let targets = config.targets.len();
        Ok(Self {
            least_squares: reader.linear("least_squares", targets, window_values)?,
            quasi_static: reader.linear("quasi_static", targets, config.inputs.len())?,
            envelope: config
                .envelope
                .as_ref()
                .map(|e| reader.linear("envelope", e.components, window_values))
                .transpose()?,
        })
    }
}
