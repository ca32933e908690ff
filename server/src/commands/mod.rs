//! One file per subcommand.

pub mod demo;
pub mod serve;
pub mod worker;
pub mod simulate;
pub mod machine;
pub mod job;
pub mod dataset;
pub mod train;
pub mod evaluate;
pub mod model;
pub mod predict;
