//! The hydroflex service: coordinator, REST interface, predictions, and the command line around them.

#![cfg_attr(
    test,
    allow(
        clippy::cast_possible_truncation,
        reason = "small known numbers; equal means equal"
    )
)]

mod allocator;
pub mod calibration;
pub mod sweeps;
pub mod http;
pub mod coordinator;
pub mod prediction;
pub mod service;
pub mod client;
pub mod commands;

pub use http::router as app;
