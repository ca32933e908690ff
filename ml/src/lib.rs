//! SLIDE networks: windows, training, evaluation, prediction.
//!
//! ```text
//! Dataset → Runs → windows (index arithmetic) → scaled batch → network → model folder → Predictor
//! ```
//!
//! A SLIDE network (Manzl et al. 2024) estimates a structural quantity at time t from the sensor
//! samples of a window that ends at t. The window is as long as a disturbance needs to decay, so
//! what happened before it does not matter and no initial state is fed.
//!
//! * [`runs`], [`window`], [`scaling`]: recorded signals, and how windows are cut from them.
//! * [`structure`], [`network`]: what can be trained; the letters are the paper's.
//! * [`least_squares`]: the best linear map of a window, a baseline; [`scheduled`]: the same with
//!   coefficients that follow the machine's pose, the skip connection of our network.
//! * [`envelope`]: what tells a window unlike the training's; [`noise`]: sensor noise to train and judge with.
//! * [`train`]: the training loop with checkpoints; a step of our own on processors, burn for the networks for comparison.
//! * [`model`]: the model folder; [`predict`]: estimates without the tensor framework.
//! * [`evaluate`], [`plot`]: errors in physical units, and the picture of them.

#![cfg_attr(
    test,
    allow(
        clippy::cast_possible_truncation,
        clippy::float_cmp,
        reason = "small known numbers; equal means equal"
    )
)]

pub mod runs;
pub mod dataset;
pub mod recording;
pub mod window;
pub mod scaling;
pub mod structure;
pub mod least_squares;
mod cholesky;
pub mod scheduled;
pub mod payload;
pub mod envelope;
pub mod noise;
mod simd;
mod activate;
pub mod network;
pub mod train;
pub mod model;
pub mod predict;
pub mod evaluate;
pub mod plot;
