//! The hydroflex engine: a machine in, a trajectory out. No network, no clock, no hidden seed.

#![cfg_attr(
    test,
    allow(
        clippy::cast_possible_truncation,
        clippy::cast_possible_wrap,
        clippy::cast_sign_loss,
        clippy::float_cmp,
        reason = "small known numbers; equal means equal"
    )
)]

pub mod fe;
pub mod machine;
pub mod reduction;
pub mod body;
pub mod joint;
pub mod hydraulics;
pub mod force;
pub mod system;
pub mod integrate;
pub mod equilibrium;
pub mod fast;
pub mod tree;
pub mod trajectory;
pub mod linearise;
mod loose_statics;
mod general;
pub mod simulator;
pub mod summary;
pub mod scenario;
pub mod instruction_set;

#[cfg(test)]
pub(crate) mod testing;
