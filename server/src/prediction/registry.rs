//! Models in memory: loaded by content when first asked for, checked at load, found by alias.

use crate::http::error::ApiError;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ledger::{AliasRecord, Ledger, LedgerError, ModelRecord};
use hydroflex_ml::model::Model;
use hydroflex_ml::predict::{Predictor, Workspace};
use hydroflex_openapi::dataset::Manifest;
use hydroflex_openapi::id::{AliasName, DatasetId, ModelId, ModelRef};
use hydroflex_openapi::model::ModelConfig;
use hydroflex_openapi::prediction::PredictionProvenance;
use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::{Duration, Instant};

const MANIFEST_FILE: &str = "manifest.json";
/// Models kept in memory; one takes a few megabytes.
const KEPT: usize = 64;
/// Age at which an alias is looked up again: another coordinator may have moved it.
const ALIAS_AGE: Duration = Duration::from_secs(1);
/// Workspaces kept per model, more than threads that compute at once.
const WORKSPACES: usize = 32;

/// A model in memory.
pub struct LoadedModel {
    id: ModelId,
    dataset_id: DatasetId,
    provenance: PredictionProvenance,
    model: Model,
    predictor: Arc<Predictor>,
    workspaces: Mutex<Vec<Workspace>>,
}

impl LoadedModel {
    /// By its content.
    #[must_use]
    pub fn id(&self) -> &ModelId {
        &self.id
    }

    /// The data set it learned from.
    #[must_use]
    pub fn dataset_id(&self) -> &DatasetId {
        &self.dataset_id
    }

    /// Hashes and versions behind its estimates.
    #[must_use]
    pub fn provenance(&self) -> &PredictionProvenance {
        &self.provenance
    }

    /// Its configuration.
    #[must_use]
    pub fn config(&self) -> &ModelConfig {
        self.model.config()
    }

    /// Its kernel.
    #[must_use]
    pub fn predictor(&self) -> &Arc<Predictor> {
        &self.predictor
    }

    /// Lends scratch memory, which is kept for the next caller.
    pub fn with_workspace<T>(&self, work: impl FnOnce(&mut Workspace) -> T) -> T {
        let pool = || self.workspaces.lock().unwrap_or_else(PoisonError::into_inner);
        let kept = pool().pop();
        let mut workspace = kept.unwrap_or_else(|| self.predictor.workspace());
        let result = work(&mut workspace);
        let mut pool = pool();
        if pool.len() < WORKSPACES {
            pool.push(workspace);
        }
        result
    }
}

/// Why a model cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ModelUnusable {
    /// There is no such model, alias or version.
    #[error("{0}")]
    Unknown(String),
    /// It is registered, but does not pass its checks.
    #[error("model {id} does not pass its checks: {reason}")]
    Damaged {
        /// Model.
        id: ModelId,
        /// Which.
        reason: String,
    },
    /// Ledger or store did not answer.
    #[error("{0}")]
    Unavailable(String),
}

impl From<LedgerError> for ModelUnusable {
    fn from(error: LedgerError) -> Self {
        Self::Unavailable(error.to_string())
    }
}

impl From<ModelUnusable> for ApiError {
    fn from(error: ModelUnusable) -> Self {
        match error {
            ModelUnusable::Unknown(detail) => Self::NotFound(detail),
            ModelUnusable::Damaged { .. } => Self::Internal(error.to_string()),
            ModelUnusable::Unavailable(detail) => Self::Unavailable(detail),
        }
    }
}

struct Kept {
    model: Arc<LoadedModel>,
    used: AtomicU64,
}

#[derive(Clone)]
struct KnownAlias {
    record: AliasRecord,
    looked_up: Instant,
}

/// The models in memory.
#[derive(Default)]
pub struct ModelRegistry {
    kept: RwLock<HashMap<ModelId, Kept>>,
    aliases: RwLock<HashMap<AliasName, KnownAlias>>,
    /// Counts uses, so that the model used last is known without a clock.
    uses: AtomicU64,
    loading: tokio::sync::Mutex<()>,
}

impl ModelRegistry {
    /// A model by content or alias, loaded if it is not in memory.
    ///
    /// # Errors
    /// If there is none, it is damaged, or ledger or store do not answer.
    pub async fn find(
        &self,
        reference: &ModelRef,
        ledger: &Ledger,
        blobs: &Blobs,
    ) -> Result<Arc<LoadedModel>, ModelUnusable> {
        match reference {
            ModelRef::Id(id) => self.get(id, ledger, blobs).await,
            ModelRef::Alias(alias) => {
                let record = self.alias(alias, ledger).await?;
                self.get(&record.model_id, ledger, blobs).await
            }
        }
    }

    /// Where an alias points, as far as known a moment ago.
    ///
    /// # Errors
    /// If there is none, or the ledger does not answer and never has.
    pub async fn alias(&self, alias: &AliasName, ledger: &Ledger) -> Result<AliasRecord, ModelUnusable> {
        let known = self
            .aliases
            .read()
            .unwrap_or_else(PoisonError::into_inner)
            .get(alias)
            .cloned();
        if let Some(known) = &known
            && known.looked_up.elapsed() < ALIAS_AGE
        {
            return Ok(known.record.clone());
        }
        match (ledger.alias(alias).await, known) {
            (Ok(Some(record)), _) => {
                self.note_alias(record.clone());
                Ok(record)
            }
            (Ok(None), _) => Err(ModelUnusable::Unknown(format!("no alias {alias}"))),
            // What an alias pointed at a moment ago is better than no answer.
            (Err(_), Some(known)) => Ok(known.record),
            (Err(error), None) => Err(error.into()),
        }
    }

    /// Notes where an alias points from now on. An older move never replaces a newer one.
    pub fn note_alias(&self, record: AliasRecord) {
        let mut aliases = self.aliases.write().unwrap_or_else(PoisonError::into_inner);
        let newer = aliases
            .get(&record.alias)
            .is_none_or(|known| known.record.generation <= record.generation);
        if newer {
            let looked_up = Instant::now();
            aliases.insert(record.alias.clone(), KnownAlias { record, looked_up });
        }
    }

    fn in_memory(&self, id: &ModelId) -> Option<Arc<LoadedModel>> {
        let kept = self.kept.read().unwrap_or_else(PoisonError::into_inner);
        let kept = kept.get(id)?;
        kept.used
            .store(self.uses.fetch_add(1, Ordering::Relaxed), Ordering::Relaxed);
        Some(kept.model.clone())
    }

    /// A model by content.
    ///
    /// # Errors
    /// As [`Self::find`].
    pub async fn get(
        &self,
        id: &ModelId,
        ledger: &Ledger,
        blobs: &Blobs,
    ) -> Result<Arc<LoadedModel>, ModelUnusable> {
        if let Some(model) = self.in_memory(id) {
            return Ok(model);
        }
        // One at a time: a hundred first requests load a model once.
        let _loading = self.loading.lock().await;
        if let Some(model) = self.in_memory(id) {
            return Ok(model);
        }
        let record = ledger
            .model(id)
            .await?
            .ok_or_else(|| ModelUnusable::Unknown(format!("no model {id}")))?;
        let model = Arc::new(load(&record, ledger, blobs).await?);
        let mut kept = self.kept.write().unwrap_or_else(PoisonError::into_inner);
        while kept.len() >= KEPT {
            let oldest = kept
                .iter()
                .min_by_key(|(_, kept)| kept.used.load(Ordering::Relaxed))
                .map(|(id, _)| id.clone());
            match oldest {
                Some(oldest) => kept.remove(&oldest),
                None => break,
            };
        }
        let used = AtomicU64::new(self.uses.fetch_add(1, Ordering::Relaxed));
        kept.insert(
            id.clone(),
            Kept {
                model: model.clone(),
                used,
            },
        );
        Ok(model)
    }
}

/// Brings a model into memory: hashes, shapes and golden predictions are checked.
async fn load(record: &ModelRecord, ledger: &Ledger, blobs: &Blobs) -> Result<LoadedModel, ModelUnusable> {
    let damaged = |reason: String| ModelUnusable::Damaged {
        id: record.id.clone(),
        reason,
    };
    let (folder, _temporary) = blobs
        .folder(&record.key(""), &record.files)
        .await
        .map_err(|error| {
            if error.is_loss() {
                damaged(error.to_string())
            } else {
                ModelUnusable::Unavailable(error.to_string())
            }
        })?;
    let model = tokio::task::spawn_blocking(move || Model::load(&folder))
        .await
        .map_err(|error| damaged(error.to_string()))?
        .map_err(|error| damaged(error.to_string()))?;
    if model.sha256() != record.sha256 {
        return Err(damaged(format!(
            "its files have hash {}, {} is registered",
            model.sha256(),
            record.sha256
        )));
    }
    let provenance = PredictionProvenance {
        model_sha256: record.sha256.clone(),
        dataset_sha256: model.config().provenance.dataset_sha256.clone(),
        simulator_version: simulator_version(&record.dataset_id, ledger, blobs).await?,
        trained_by_version: model.config().provenance.hydroflex_version.clone(),
    };
    Ok(LoadedModel {
        id: record.id.clone(),
        dataset_id: record.dataset_id.clone(),
        provenance,
        predictor: model.predictor(),
        model,
        workspaces: Mutex::default(),
    })
}

/// As the data set's manifest says; `None` where there is none, which a model can do without. What the store
/// cannot say now it may say later, and a model that is kept would be without it for as long.
async fn simulator_version(
    dataset: &DatasetId,
    ledger: &Ledger,
    blobs: &Blobs,
) -> Result<Option<String>, ModelUnusable> {
    let Some(dataset) = ledger.dataset(dataset).await? else {
        return Ok(None);
    };
    let Some(entry) = dataset.file(MANIFEST_FILE) else {
        return Ok(None);
    };
    match blobs.read(&dataset.key(MANIFEST_FILE), &entry.sha256).await {
        Ok(content) => {
            let manifest: Option<Manifest> = serde_json::from_slice(&content).ok();
            Ok(manifest.map(|manifest| manifest.code.version))
        }
        Err(error) if error.is_transient() => Err(ModelUnusable::Unavailable(error.to_string())),
        Err(_) => Ok(None),
    }
}
