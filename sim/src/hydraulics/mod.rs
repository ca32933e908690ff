//! Oil: chambers, valve and cylinder (theory note §7).
#![doc = ""]
#![doc = include_str!("../../theory/hydraulics.md")]

pub mod valve;
pub mod chamber;
pub mod cylinder;
