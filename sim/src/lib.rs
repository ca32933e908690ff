//! The hydroflex engine: a machine in, a trajectory out. No network, no clock, no hidden seed.

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
mod general;
pub mod simulator;
pub mod summary;
pub mod scenario;
pub mod instruction_set;

#[cfg(test)]
pub(crate) mod testing;
