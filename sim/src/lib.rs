//! The hydroflex engine: a machine in, a trajectory out. No network, no clock, no hidden seed.

pub mod reduction;
pub mod trajectory;
