//! The hydroflex service: coordinator, REST interface, predictions, and the command line around them.

pub mod client;
pub mod commands;
