//! Columns of a run.

use super::dynamics::{Point, Rates};
use super::lane::Lane;

/// Channels before the sensors: valve, length, velocity, two pressures, force, angle, angular
/// velocity, angular acceleration.
pub(super) const MACHINE_CHANNELS: usize = 9;

/// How a sensor channel is read from rows over the modes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Readout {
    /// One row.
    Row(usize),
    /// Von Mises stress of six rows in the order xx, yy, zz, yz, xz, xy.
    VonMises {
        /// The first of them.
        first: usize,
    },
}

impl Readout {
    /// The channel's value in one lane.
    pub(super) fn value<L: Lane>(self, readings: &[L], lane: usize) -> f64 {
        match self {
            Self::Row(row) => readings[row].get(lane),
            Self::VonMises { first } => {
                let [xx, yy, zz, yz, xz, xy] = [0, 1, 2, 3, 4, 5].map(|i| readings[first + i].get(lane));
                let normal = (xx - yy) * (xx - yy) + (yy - zz) * (yy - zz) + (zz - xx) * (zz - xx);
                (0.5 * normal + 3.0 * (yz * yz + xz * xz + xy * xy)).sqrt()
            }
        }
    }
}

/// What the machine's own channels read in one lane.
pub(super) fn machine_channels<L: Lane, const A: usize, const B: usize, const Q: usize>(
    valve_ratio: f64,
    alpha: f64,
    y: &Point<L, A, B, Q>,
    r: &Rates<L, A, B, Q>,
    lane: usize,
) -> [f64; MACHINE_CHANNELS] {
    [
        valve_ratio,
        r.length.get(lane),
        r.speed.get(lane),
        y.p[0].get(lane),
        y.p[1].get(lane),
        r.cylinder_force.get(lane),
        y.theta.get(lane),
        y.omega.get(lane),
        alpha,
    ]
}
