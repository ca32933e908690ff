//! The state of a training on disk, so that a killed one goes on and ends with the same weights.
//!
//! One safetensors file, replaced as a whole after every few epochs; the counters stand in its
//! metadata. A file that is damaged or belongs to another training is as good as none.

use super::adam::Adam;
use hydroflex_openapi::model::EpochRecord;
use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

const FILE: &str = "checkpoint.safetensors";
const METADATA_KEY: &str = "hydroflex.training";

/// What changes from epoch to epoch.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainState {
    /// Counters.
    pub counters: Counters,
    /// Weights.
    pub parameters: Vec<f32>,
    /// Optimiser.
    pub adam: Adam,
    /// Weights with the smallest validation loss.
    pub best_parameters: Vec<f32>,
}

/// The small part of [`TrainState`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Counters {
    /// Epochs done.
    pub epoch: usize,
    /// Epoch of the best weights.
    pub best_epoch: usize,
    /// Their validation loss; absent before the first validation.
    pub best_loss: Option<f64>,
    /// Part of the schedule at the last validation.
    pub validated_at: f64,
    /// Learning curve.
    pub history: Vec<EpochRecord>,
    /// Time spent, all attempts together, s.
    pub elapsed_s: f64,
    /// Optimiser steps.
    pub steps: u64,
    /// What the training is a function of; another value is another training.
    pub fingerprint: String,
}

impl TrainState {
    /// Before the first epoch.
    #[must_use]
    pub fn new(parameters: Vec<f32>, fingerprint: String) -> Self {
        Self {
            counters: Counters {
                epoch: 0,
                best_epoch: 0,
                best_loss: None,
                validated_at: 0.0,
                history: Vec::new(),
                elapsed_s: 0.0,
                steps: 0,
                fingerprint,
            },
            adam: Adam::new(parameters.len()),
            best_parameters: parameters.clone(),
            parameters,
        }
    }

    /// Replaces the checkpoint in `dir`, durably.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn save(&mut self, dir: &Path) -> io::Result<()> {
        fs::create_dir_all(dir)?;
        self.counters.steps = self.adam.steps;
        let vectors = [
            ("parameters", &self.parameters),
            ("first", &self.adam.first),
            ("second", &self.adam.second),
            ("best", &self.best_parameters),
        ];
        let bytes: Vec<(&str, Vec<u8>)> = vectors.iter().map(|(name, v)| (*name, to_bytes(v))).collect();
        let views = bytes
            .iter()
            .map(|(name, data)| Ok((*name, TensorView::new(Dtype::F32, vec![data.len() / 4], data)?)))
            .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()
            .map_err(io::Error::other)?;
        let metadata = HashMap::from([(
            METADATA_KEY.to_owned(),
            serde_json::to_string(&self.counters).map_err(io::Error::other)?,
        )]);
        let content = serialize(views, Some(metadata)).map_err(io::Error::other)?;
        let temporary = dir.join(format!("{FILE}.part"));
        let mut file = File::create(&temporary)?;
        file.write_all(&content)?;
        file.sync_all()?;
        fs::rename(&temporary, path(dir))?;
        File::open(dir)?.sync_all()
    }

    /// The checkpoint in `dir`, if it is whole and belongs to this training.
    #[must_use]
    pub fn load(dir: &Path, fingerprint: &str) -> Option<Self> {
        let content = fs::read(path(dir)).ok()?;
        let (_, metadata) = SafeTensors::read_metadata(&content).ok()?;
        let counters: Counters =
            serde_json::from_str(metadata.metadata().as_ref()?.get(METADATA_KEY)?).ok()?;
        if counters.fingerprint != fingerprint {
            return None;
        }
        let tensors = SafeTensors::deserialize(&content).ok()?;
        let vector = |name: &str| Some(from_bytes(tensors.tensor(name).ok()?.data()));
        let adam = Adam {
            first: vector("first")?,
            second: vector("second")?,
            steps: counters.steps,
        };
        Some(Self {
            parameters: vector("parameters")?,
            best_parameters: vector("best")?,
            adam,
            counters,
        })
    }

    /// Removes the checkpoint: the training is over and its model written.
    ///
    /// # Errors
    /// The file is there and cannot be removed.
    pub fn remove(dir: &Path) -> io::Result<()> {
        match fs::remove_file(path(dir)) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
            _ => Ok(()),
        }
    }
}

fn path(dir: &Path) -> PathBuf {
    dir.join(FILE)
}

/// Little-endian bytes, as safetensors has them.
#[must_use]
pub fn to_bytes(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// Values of little-endian bytes; a tail of fewer than four bytes is left out.
#[must_use]
pub fn from_bytes(bytes: &[u8]) -> Vec<f32> {
    bytes
        .chunks_exact(4)
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
        .collect()
}
