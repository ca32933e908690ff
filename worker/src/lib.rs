//! The worker: begin, simulate, put, commit.
//!
//! - `machines`: machines by reference, reduced once, shared by every shard
//! - `run`: one run of a job into calls of the simulator, and back into a record
//! - `shard`: the runs of a shard, encoded
//! - `delivery`: an object on its way, and its commit, beside the next shard
//! - `shard_loop`: claims and sends off; heartbeat and shutdown around it
//! - `outage`: a store that is away, at nobody's cost
//! - `standstill`: a run that takes longer than it may
//! - `memory`: a run that eats more than it may
//! - `lifetime`: a worker never outlives the process that started it
//!
//! Numbers are made on blocking threads only: the async threads keep the heartbeat going.

mod delivery;
pub mod machines;
pub mod run;
pub mod shard;
pub mod shard_loop;
mod memory;
mod outage;
mod standstill;
pub mod lifetime;
