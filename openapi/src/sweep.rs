//! A sweep: one request for structures × sensors × windows × seeds on a published data set.

use crate::channel::Channel;
use crate::id::{DatasetId, ModelId, SweepId, TrainingId};
use crate::job::{TrainingSpec, WindowRule};
use crate::model::TargetMetrics;
use crate::status::TrainingState;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Most networks of a sweep.
pub const MAX_CELLS: usize = 1024;

/// What `POST /v1/sweeps` takes. Each list that is absent is that of the grid, or, without one, the single value of
/// `spec`; every combination of their entries is trained.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct SweepRequest {
    /// The data set to learn from.
    pub dataset_id: DatasetId,
    /// Lists by name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub grid: Option<SweepGrid>,
    /// Structures, as in `spec`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub structures: Option<Vec<String>>,
    /// Sensors in: sets by name, or lists of channels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensors: Option<Vec<Sensors>>,
    /// Windows, as in `spec`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub windows: Option<Vec<WindowRule>>,
    /// Seeds of initial weights and batches.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seeds: Option<Vec<u64>>,
    /// What the trainings have in common.
    #[serde(default)]
    pub spec: TrainingSpec,
}

/// Lists by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SweepGrid {
    /// The published study: five structures, five sensor sets, seeds 0 to 4, the data set's window.
    Published,
}

impl SweepGrid {
    /// Structures of the published study.
    pub const STRUCTURES: [&'static str; 5] = ["L", "TLTLT", "TLSLTLSLT", "ELE", "RLR"];
    /// Seeds over which its results are repeated here.
    pub const SEEDS: u64 = 5;
}

/// Sensors that a network sees.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
#[serde(
    untagged,
    expecting = "invalid value, expected a sensor set (`all`, `usp`, `usdp2`, `usd`, `us`) or a list of channels"
)]
pub enum Sensors {
    /// As in the paper, of every cylinder.
    Set(SensorSet),
    /// Channels by name.
    Channels(Vec<String>),
}

impl Sensors {
    /// For people: `U s p1 p2`, or the channels.
    #[must_use]
    pub fn label(&self) -> String {
        match self {
            Self::Set(set) => set.label().to_owned(),
            Self::Channels(names) => names.join(" "),
        }
    }
}

/// The paper's sensor sets: valve U, length s, velocity ds, piston-side p1 and rod-side pressure p2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SensorSet {
    /// U s ds p1 p2.
    All,
    /// U s p1 p2.
    Usp,
    /// U s ds p2.
    Usdp2,
    /// U s ds.
    Usd,
    /// U s.
    Us,
}

impl SensorSet {
    /// Every set.
    pub const ALL: [Self; 5] = [Self::All, Self::Usp, Self::Usdp2, Self::Usd, Self::Us];

    /// Its name in JSON.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::All => "all",
            Self::Usp => "usp",
            Self::Usdp2 => "usdp2",
            Self::Usd => "usd",
            Self::Us => "us",
        }
    }

    /// How the paper writes it.
    #[must_use]
    pub fn label(self) -> &'static str {
        match self {
            Self::All => "U s ds p1 p2",
            Self::Usp => "U s p1 p2",
            Self::Usdp2 => "U s ds p2",
            Self::Usd => "U s ds",
            Self::Us => "U s",
        }
    }

    /// Names of those channels that belong to it, in their order.
    #[must_use]
    pub fn of(self, channels: &[Channel]) -> Vec<String> {
        let names = channels.iter().map(|channel| channel.name.clone());
        names.filter(|name| self.has(name)).collect()
    }

    /// Whether a channel of this name belongs to it.
    #[must_use]
    pub fn has(self, channel: &str) -> bool {
        let is = |family: &str| channel.starts_with(family);
        is("valve_")
            || is("length_")
            || (is("velocity_") && matches!(self, Self::All | Self::Usdp2 | Self::Usd))
            || (is("pressure_")
                && match self {
                    Self::All | Self::Usp => true,
                    Self::Usdp2 => channel.ends_with("_rod_pa"),
                    Self::Usd | Self::Us => false,
                })
    }
}

/// A sweep and how far it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SweepStatus {
    /// Identifier.
    pub sweep_id: SweepId,
    /// The data set that its networks learn from.
    pub dataset_id: DatasetId,
    /// State.
    pub state: SweepState,
    /// Its trainings, counted.
    pub progress: SweepProgress,
    /// What was asked for, lists filled in.
    pub spec: SweepRequest,
    /// When it was accepted (RFC 3339, UTC).
    pub created_at: String,
    /// When its last training ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub finished_at: Option<String>,
}

/// Trainings of a sweep, counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct SweepProgress {
    /// All of them.
    pub total: u64,
    /// Wait for a trainer.
    pub open: u64,
    /// In a trainer's hands.
    pub running: u64,
    /// With a model.
    pub succeeded: u64,
    /// Ended with a reason.
    pub failed: u64,
    /// Ended on request.
    pub cancelled: u64,
}

impl SweepProgress {
    /// The state that follows.
    #[must_use]
    pub fn state(&self) -> SweepState {
        if self.open + self.running > 0 {
            SweepState::Running
        } else if self.cancelled > 0 {
            SweepState::Cancelled
        } else if self.failed > 0 {
            SweepState::Failed
        } else {
            SweepState::Succeeded
        }
    }
}

/// Where a sweep is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SweepState {
    /// A training waits or is in work.
    Running,
    /// Every network is there.
    Succeeded,
    /// Over; a training failed.
    Failed,
    /// Over; a training was cancelled.
    Cancelled,
}

impl SweepState {
    /// True if nothing more will happen by itself.
    #[must_use]
    pub fn is_final(self) -> bool {
        self != Self::Running
    }

    /// As written in JSON.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }
}

/// A list of sweeps, newest first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SweepPage {
    /// Sweeps.
    pub sweeps: Vec<SweepStatus>,
    /// Ask with this `cursor` for the next page; absent on the last.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub next_cursor: Option<String>,
}

/// What a sweep found, as far as it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SweepTable {
    /// The sweep.
    pub sweep_id: SweepId,
    /// The data set.
    pub dataset_id: DatasetId,
    /// State.
    pub state: SweepState,
    /// One row per network, in the order of the request: structures, then sensors, then windows, then seeds.
    pub rows: Vec<SweepRow>,
}

/// A network of a sweep.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SweepRow {
    /// Its training.
    pub training_id: TrainingId,
    /// Structure.
    pub structure: String,
    /// Sensors, for people.
    pub sensors: String,
    /// Window as asked for.
    pub window: WindowRule,
    /// Seed.
    pub seed: u64,
    /// Where its training is.
    pub state: TrainingState,
    /// Why it failed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Its model, addressed by content.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub model_id: Option<ModelId>,
    /// What was measured, once it is trained.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub result: Option<CellResult>,
}

/// What was measured of a network. Nothing in it depends on time or host.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CellResult {
    /// Samples in a window.
    pub window_steps: u64,
    /// Window in time.
    pub window_s: f64,
    /// Weights and biases.
    pub parameters: u64,
    /// Epochs done.
    pub epochs: u64,
    /// Runs of the data set on which it was judged: its test runs, or, where it has none, the validation runs, which
    /// chose the best epoch.
    pub judged_on: String,
    /// How many.
    pub runs: u64,
    /// Errors of the network, one per target.
    pub targets: Vec<TargetMetrics>,
    /// Errors of simple estimators on the same samples.
    pub baselines: Vec<crate::model::BaselineMetrics>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_are_called_as_in_json() {
        for set in SensorSet::ALL {
            assert_eq!(serde_json::to_value(set).unwrap(), set.name());
        }
    }

    #[test]
    fn the_paper_s_sets_choose_channels_by_family() {
        let channels = [
            "valve_lift_ratio",
            "length_lift_m",
            "velocity_lift_m_per_s",
            "pressure_lift_piston_pa",
            "pressure_lift_rod_pa",
            "angle_lift_rad",
        ];
        let chosen = SensorSet::ALL.map(|set| channels.iter().filter(|name| set.has(name)).count());
        assert_eq!(chosen, [5, 4, 4, 3, 2]);
    }

    #[test]
    fn a_sweep_is_what_its_trainings_are() {
        let mut progress = SweepProgress {
            total: 3,
            running: 1,
            failed: 1,
            cancelled: 1,
            ..SweepProgress::default()
        };
        assert_eq!(progress.state(), SweepState::Running);
        progress.running = 0;
        assert_eq!(progress.state(), SweepState::Cancelled);
        progress.cancelled = 0;
        assert_eq!(progress.state(), SweepState::Failed);
        progress.failed = 0;
        assert_eq!(progress.state(), SweepState::Succeeded);
    }
}
