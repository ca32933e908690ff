//! The system of bodies, joints and cylinders: constants, state, evaluation and linear solve.

#[allow(clippy::module_inception, reason = "the system is what this module is about")]
mod system;
mod state;
mod workspace;
mod evaluate;
mod solve;
mod lu;

pub use evaluate::{Level, Oil};
pub use lu::DenseLu;
pub use solve::{Coefficients, CylinderRows};
pub use state::State;
pub use system::{PayloadMass, System, SystemError};
pub use workspace::{CylinderMotion, Workspace};

#[cfg(test)]
mod tests;
