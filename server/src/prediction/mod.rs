//! Estimates from registered models.
//!
//! - `registry`: models in memory, by content and by alias
//! - `answer`: a JSON request, checked field by field
//! - `columns`: which column of a request is which input
//! - `table`: recordings of any length as Arrow or Parquet, a batch of rows at a time
//! - `infer`: the Open Inference Protocol's tensors
//! - `numbers`: the numbers of their JSON
//! - `session`: a live signal, one sample at a time
//! - `gate`: how much is done at once, and what is refused
//!
//! Nothing here knows a socket; `http/` does.

pub mod registry;
pub mod columns;
pub mod answer;
pub mod table;
pub mod spool;
pub mod infer;
mod numbers;
pub mod session;
pub mod gate;

pub use registry::{LoadedModel, ModelRegistry};

/// Sample times that differ by less than this part are the same: 0.005 may come as 1/200.
pub const SAMPLE_TIME_TOLERANCE: f64 = 1e-6;
