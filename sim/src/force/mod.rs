//! Forces along a cylinder's line beside the oil's. Gravity is with the bodies.

pub mod friction;
pub mod spring;
pub mod end_stop;
