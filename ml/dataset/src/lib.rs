//! Trajectory data sets on disk: shards in, published Parquet out.
//!
//! ```text
//! RunRecord → ShardWriter → shard (private, any cut) → ShardReader → Publisher → data set → Dataset
//! ```
//!
//! The published bytes are a function of what was asked for, never of how the work was divided:
//! see `README.md` beside this crate for the layout, the choice of encodings and their cost.

pub mod record;
pub mod shard;
pub mod cut;
pub mod guard;
pub mod samples;
pub mod statistics;
pub mod window;
pub mod sink;
pub mod publish;
mod sample_file;
pub mod runs_table;
pub mod card;
pub mod croissant;
pub mod open;

pub use open::{Dataset, OpenError, RunColumns};
pub use publish::{PublishError, PublishSpec, Published, Publisher, RunLengths};
pub use record::{RunKind, RunOutcome, RunRecord, RunSamples, RunStatistics};
pub use shard::{ShardError, ShardReader, ShardSchema, ShardWriter};
pub use sink::{DirectorySink, MemorySink, Sink, SinkFile};
