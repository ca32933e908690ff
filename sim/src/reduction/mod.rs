//! From a finite-element model to a reduced body.
#![doc = include_str!("../../theory/craig_bampton.md")]

mod cache;
mod craig_bampton;
mod damping;
mod eigen;
mod factor;
mod inertia_integrals;
mod reduced_body;

pub use cache::cached;
pub use craig_bampton::{
    ClampedModel, FlexibleModel, ModeBasis, clamped_hz, free_free_hz, mode_basis, reduce,
};
pub use damping::Damping;
pub use reduced_body::{ReducedBody, ReducedInterface, ReducedNode, ReductionReport};

/// A body that cannot be reduced.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ReductionError {
    /// No interface is a boundary.
    #[error("no interface is a boundary; the first one carries the body's frame")]
    NoBoundary,
    /// A node in two boundary interfaces.
    #[error("interface `{interface}` shares node {node} (zero-based) with another boundary interface")]
    OverlappingBoundaries {
        /// Second interface.
        interface: String,
        /// Node, zero-based.
        node: u32,
    },
    /// The structure is a mechanism, or not held.
    #[error(
        "the stiffness matrix is singular at node {node} (zero-based): the part around it is not held, or hinges on an edge or a node"
    )]
    SingularStiffness {
        /// Node, zero-based.
        node: u32,
    },
    /// More modes than unknowns.
    #[error("{wanted} modes are asked for, the mesh has {unknowns} free unknowns")]
    TooManyModes {
        /// Asked for.
        wanted: usize,
        /// Available.
        unknowns: usize,
    },
    /// The eigenvalue search did not settle.
    #[error("{wanted} modes could not be found: relative residual {residual:e}")]
    ModesNotConverged {
        /// Asked for.
        wanted: usize,
        /// Largest relative residual.
        residual: f64,
    },
    /// Not enough memory.
    #[error("not enough memory to factor a stiffness matrix of {unknowns} unknowns")]
    OutOfMemory {
        /// Unknowns.
        unknowns: usize,
    },
}
