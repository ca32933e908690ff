//! The contract of hydroflex: what is sent and stored. No numerics and no I/O.
//!
//! Every type here is a plain description with units in its field names. What is *true* about a
//! description (does the mesh exist, is the stiffness regular, can the loop close) is decided in
//! `hydroflex-sim` and `hydroflex-ml`, which convert these types once, at the edge.

#![cfg_attr(
    test,
    allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "small known numbers; equal means equal"
    )
)]

pub mod machine;
pub mod channel;
pub mod job;
pub mod dataset;
pub mod id;
pub mod status;
pub mod sweep;
pub mod event;
pub mod catalogue;
pub mod prediction;
pub mod inference;
pub mod stream;
pub mod problem;
pub mod model;
