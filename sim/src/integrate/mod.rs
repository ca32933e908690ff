//! Time integration with fixed steps (theory note §10).

mod scheme;
mod step;
mod update;

pub use scheme::Scheme;
pub use step::{StepError, Stepper};
pub(crate) use update::{Increment, add_increment, normalise};

#[cfg(test)]
mod tests;
