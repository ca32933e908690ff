//! Models with random weights, registered as a training would have done it.

#[path = "register.rs"]
mod register;

use super::Desk;
use hydroflex_ml::predict::synthetic::{SyntheticModel, SyntheticSpec};
use hydroflex_openapi::id::ModelId;
pub(crate) use register::register_folder;

/// A small model of three targets.
pub(crate) fn synthetic(structure: &str, seed: u64) -> SyntheticModel {
    SyntheticModel::new(&SyntheticSpec {
        structure: structure.to_owned(),
        window_steps: 12,
        targets: 3,
        seed,
    })
    .unwrap()
}

impl Desk {
    /// Registers a model and says how it is addressed.
    pub(crate) async fn register(&self, model: &SyntheticModel) -> ModelId {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model");
        model.write(&path).unwrap();
        register_folder(&self.ledger, &self.blobs, &path).await
    }
}
