//! Bodies: rotation, the reduced flexible body in its floating frame, and markers on it.

pub mod rotation;
pub mod floating_frame;
pub mod marker;

#[cfg(test)]
mod floating_frame_tests;
