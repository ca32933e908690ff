//! Tensors of a model folder.

use super::ModelError;
use crate::least_squares::LinearMap;
use crate::train::checkpoint::{from_bytes, to_bytes};
use hydroflex_openapi::model::{DenseLayer, ModelConfig};
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

/// `model.safetensors`.
#[derive(Debug, Clone, PartialEq)]
pub struct Weights {
    /// Of each layer.
    pub layers: Vec<LinearWeights>,
    /// Of the skip, where there is one.
    pub skip: Option<LinearWeights>,
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

struct Tensor<'a> {
    name: String,
    shape: Vec<usize>,
    values: &'a [f32],
}

fn linear<'a>(prefix: &str, map: &'a LinearWeights) -> [Tensor<'a>; 2] {
    let outputs = map.bias.len();
    [
        Tensor {
            name: format!("{prefix}.weight"),
            shape: vec![outputs, map.weight.len() / outputs.max(1)],
            values: &map.weight,
        },
        Tensor {
            name: format!("{prefix}.bias"),
            shape: vec![outputs],
            values: &map.bias,
        },
    ]
}

fn to_file(tensors: &[Tensor<'_>]) -> Result<Vec<u8>, safetensors::SafeTensorError> {
    let bytes: Vec<Vec<u8>> = tensors.iter().map(|t| to_bytes(t.values)).collect();
    let views = tensors
        .iter()
        .zip(&bytes)
        .map(|(t, data)| {
            Ok((
                t.name.as_str(),
                TensorView::new(Dtype::F32, t.shape.clone(), data)?,
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
        let tensor = self.tensors.tensor(name).ok().filter(|t| t.dtype() == Dtype::F32);
        match tensor {
            Some(tensor) if tensor.shape() == expected => Ok(from_bytes(tensor.data())),
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
        let mut tensors: Vec<Tensor<'_>> = layers
            .iter()
            .zip(&self.layers)
            .flat_map(|(layer, map)| linear(&layer.name, map))
            .collect();
        if let Some(skip) = &self.skip {
            tensors.extend(linear("skip", skip));
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
        let skip = config
            .linear_skip
            .then(|| reader.linear("skip", config.targets.len(), window_values))
            .transpose()?;
        Ok(Self { layers, skip })
    }
}

impl Auxiliary {
    /// Content of the file.
    ///
    /// # Errors
    /// A shape does not fit its values.
    pub fn to_file(&self) -> Result<Vec<u8>, safetensors::SafeTensorError> {
        let mut tensors: Vec<Tensor<'_>> = Vec::new();
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
