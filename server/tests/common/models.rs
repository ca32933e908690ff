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

/// Lower and upper end of the interval around an estimate, as the configuration describes it.
pub(crate) fn interval(
    model: &SyntheticModel,
    target: usize,
    estimate: f64,
    payload_kg: Option<f64>,
) -> [f64; 2] {
    let table = &model.config.intervals[target];
    let is_above = |edges: &[f64], value: f64| edges.iter().filter(|edge| **edge < value).count();
    let mut half = table.half_widths[is_above(&table.upper_edges, (estimate - table.centre).abs())];
    if let Some(widths) = &table.payload {
        half *= widths.factors[is_above(&widths.upper_edges_kg, payload_kg.unwrap())];
    }
    [estimate - half, estimate + half]
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
