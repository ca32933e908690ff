//! The hydroflex service: coordinator, REST interface, predictions, and the command line around them.

pub mod calibration;
pub mod http;
pub mod coordinator;
pub mod prediction;
pub mod service;
pub mod client;
pub mod commands;

pub use http::router as app;
