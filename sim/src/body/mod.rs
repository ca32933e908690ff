//! Bodies: rotation, the reduced flexible body in its floating frame, and markers on it.
#![doc = ""]
#![doc = include_str!("../../theory/floating_frame.md")]

pub mod rotation;
pub mod floating_frame;
pub mod marker;

#[cfg(test)]
mod floating_frame_tests;
