//! From a finite-element model to a reduced body.

mod reduced_body;

pub use reduced_body::{ReducedBody, ReducedInterface, ReducedNode, ReductionReport};
