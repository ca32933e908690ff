//! Estimates from registered models: loaded by content, checked at load, kept in memory.

mod answer;

use crate::http::error::ApiError;
use hydroflex_ledger::ModelRecord;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ml::model::Model;
use hydroflex_openapi::id::{DatasetId, ModelId};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

/// Models kept in memory; one takes a few megabytes.
const KEPT: usize = 64;

/// A model in memory.
pub struct LoadedModel {
    id: ModelId,
    dataset_id: DatasetId,
    model: Model,
}

/// The models in memory, the one used last at the back.
#[derive(Default)]
pub struct ModelRegistry {
    loaded: Mutex<VecDeque<Arc<LoadedModel>>>,
}

impl ModelRegistry {
    /// A model, if it is in memory.
    #[must_use]
    pub fn loaded(&self, id: &ModelId) -> Option<Arc<LoadedModel>> {
        let mut loaded = self.loaded.lock().unwrap_or_else(PoisonError::into_inner);
        let place = loaded.iter().position(|model| model.id == *id)?;
        let model = loaded.remove(place)?;
        loaded.push_back(model.clone());
        Some(model)
    }

    /// Brings a model into memory: hashes, shapes and golden predictions are checked.
    ///
    /// # Errors
    /// If the store does not answer or the model is damaged; the models in memory stay as they are.
    pub async fn load(&self, record: &ModelRecord, blobs: &Blobs) -> Result<Arc<LoadedModel>, ApiError> {
        let (folder, _temporary) = blobs.folder(&record.key(""), &record.files).await?;
        let model = tokio::task::spawn_blocking(move || Model::load(&folder))
            .await
            .map_err(|error| ApiError::Internal(error.to_string()))?
            .map_err(|error| ApiError::Internal(format!("model {} cannot be loaded: {error}", record.id)))?;
        let model = Arc::new(LoadedModel {
            id: record.id.clone(),
            dataset_id: record.dataset_id.clone(),
            model,
        });
        let mut loaded = self.loaded.lock().unwrap_or_else(PoisonError::into_inner);
        loaded.retain(|other| other.id != record.id);
        loaded.push_back(model.clone());
        while loaded.len() > KEPT {
            loaded.pop_front();
        }
        Ok(model)
    }
}
