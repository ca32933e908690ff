//! Time integration with fixed steps (theory note §10).
#![doc = ""]
#![doc = include_str!("../../theory/time_integration.md")]

mod scheme;
mod step;
mod update;

pub use scheme::Scheme;
pub use step::{Newton, StepError, Stepper};
pub(crate) use update::{Increment, add_increment, normalise};

#[cfg(test)]
mod tests;
