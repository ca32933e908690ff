//! Channels: the named, unit-carrying columns of a trajectory.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// What a channel is to a learner.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ChannelRole {
    /// Commanded from outside.
    Command,
    /// Measured by a sensor that a machine has or could cheaply have.
    Sensor,
    /// A rigid-body quantity.
    Motion,
    /// Structural quantity that a network estimates.
    Target,
}

/// One column of samples.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Channel {
    /// Column name, unit last: `pressure_lift_piston_pa`.
    pub name: String,
    /// Unit as text: `Pa`, `m/s`, `1`.
    pub unit: String,
    /// Quantity in words: `pressure`.
    pub quantity: String,
    /// Frame in which a component is expressed, where that matters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<String>,
    /// Role.
    pub role: ChannelRole,
}
