//! Oil: chambers, valve and cylinder (theory note §7).

pub mod valve;
pub mod chamber;
pub mod cylinder;
