//! What can be chosen of a study, beside numbers.

use hydroflex_ml::structure::Structure;
use hydroflex_openapi::job::{NoiseLevel, NoiseSpec, WindowCut};
use hydroflex_openapi::sweep::SensorSet;
use serde::{Deserialize, Serialize};

/// Reads a sensor set by its name, and lists the names in the help text.
pub(super) fn sensor_set() -> impl clap::builder::TypedValueParser<Value = SensorSet> {
    use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser as _};
    let names = SensorSet::ALL.map(|set| PossibleValue::new(set.name()).help(set.label()));
    PossibleValuesParser::new(names).try_map(|name| {
        let named = SensorSet::ALL.into_iter().find(|set| set.name() == name);
        named.ok_or("not a sensor set")
    })
}

/// Noise to study.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NoiseChoice {
    /// None, as in the paper
    None,
    /// As measured on a crane
    Crane,
}

impl NoiseChoice {
    pub(super) fn spec(self) -> Option<NoiseSpec> {
        match self {
            Self::None => None,
            Self::Crane => Some(NoiseSpec::Level(NoiseLevel::Crane)),
        }
    }
}

/// How a network is trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Recipe {
    /// All overlapping windows, a learning rate that falls to zero
    #[default]
    Ours,
    /// As in the published scripts
    Published,
}

impl Recipe {
    /// Whether a structure is trained in this way: the published way belongs to the paper's letters.
    pub(super) fn applies_to(self, structure: &str) -> bool {
        self == Self::Ours || !(structure == "best" || Structure::is_comparison(structure))
    }

    pub(super) fn windows(self) -> WindowCut {
        match self {
            Self::Ours => WindowCut::Overlapping,
            Self::Published => WindowCut::Disjoint,
        }
    }
}
