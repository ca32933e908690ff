//! The `accurate` integrator of machines whose bodies move in one plane: a tree of revolute joints and welds, with
//! loops closed by pins, any number of cylinders, perhaps a payload.

#![allow(
    clippy::needless_range_loop,
    reason = "several lists share an index; zipping four of them hides the formula"
)]
#![doc = ""]
#![doc = include_str!("../../theory/planar_tree.md")]

mod model;
mod motion;
mod in_plane;
mod step;
mod statics;
mod run;

pub use model::{NotTree, TreeModel};

#[cfg(test)]
mod tests;
