//! Machines by reference: loaded, checked and reduced once per process, and once per cache directory.

use hydroflex_openapi::job::{JobSpec, MachineRef, ValueOrRange};
use hydroflex_sim::machine::{Machine, MachineError};
use hydroflex_sim::simulator::{Simulator, SimulatorError};
use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, OnceLock};

/// Machines kept in memory. A reduced boom takes a few hundred kilobytes, its mesh a few megabytes.
const KEPT: usize = 8;

/// Why a machine cannot be simulated. All of these are so for good: the same text fails in the same
/// way everywhere.
#[derive(Debug, Clone, thiserror::Error)]
pub enum RefusedMachine {
    /// No machine of that name is built in.
    #[error("no machine {name:?}; built in are {}", known.join(", "))]
    Unknown {
        /// Name as given.
        name: String,
        /// Built-in names.
        known: Vec<&'static str>,
    },
    /// The file or one of its meshes is refused.
    #[error("{0}")]
    File(Arc<MachineError>),
    /// The structure cannot be reduced, or the machine cannot become equations.
    #[error("{0}")]
    Structure(Arc<SimulatorError>),
}

/// A machine that passed every check, with its simulator.
pub struct ReadyMachine {
    /// SHA-256 of the machine, hexadecimal.
    pub sha256: String,
    /// Its simulator.
    pub simulator: Simulator,
}

impl ReadyMachine {
    /// The machine.
    #[must_use]
    pub fn machine(&self) -> &Machine {
        self.simulator.machine()
    }
}

type Slot = Arc<OnceLock<Result<Arc<ReadyMachine>, RefusedMachine>>>;

/// The machines that this process has used lately.
pub struct Machines {
    cache: PathBuf,
    slots: Mutex<VecDeque<(MachineRef, Slot)>>,
}

impl Machines {
    /// None yet; reduced bodies are kept in the directory `cache`.
    #[must_use]
    pub fn new(cache: PathBuf) -> Self {
        Self {
            cache,
            slots: Mutex::default(),
        }
    }

    /// The machine of a job, loaded and reduced as the job's payloads need it. Takes seconds the
    /// first time: not for async threads.
    ///
    /// # Errors
    /// Says why the machine is refused.
    pub fn ready(&self, spec: &JobSpec) -> Result<Arc<ReadyMachine>, RefusedMachine> {
        let machine = self.loaded(&spec.machine)?;
        let with_payload = match spec.payload_kg {
            ValueOrRange::Value(value) => value > 0.0,
            ValueOrRange::Range { max, .. } => max > 0.0,
        };
        let refused = |error| RefusedMachine::Structure(Arc::new(error));
        machine.simulator.prepare(with_payload).map_err(refused)?;
        Ok(machine)
    }

    fn loaded(&self, reference: &MachineRef) -> Result<Arc<ReadyMachine>, RefusedMachine> {
        let slot = {
            let mut slots = self
                .slots
                .lock()
                .unwrap_or_else(std::sync::PoisonError::into_inner);
            let known = slots.iter().position(|(known, _)| known == reference);
            let slot = match known.and_then(|index| slots.remove(index)) {
                Some((_, slot)) => slot,
                None => Slot::default(),
            };
            slots.push_back((reference.clone(), slot.clone()));
            while slots.len() > KEPT {
                slots.pop_front();
            }
            slot
        };
        // Outside the lock, and once: who asks for the same machine meanwhile waits for it.
        slot.get_or_init(|| prepare(reference, self.cache.clone()).map(Arc::new))
            .clone()
    }
}

/// Loads and checks a machine without reducing it. A reference comes from outside, so it may name
/// what the binary carries, and nothing else.
///
/// # Errors
/// Says why the machine is refused.
pub fn load(reference: &MachineRef) -> Result<Machine, RefusedMachine> {
    match reference {
        MachineRef::BuiltIn(name) => {
            let known = Machine::built_in_names();
            if known.contains(&name.as_str()) {
                Machine::load(name, &[]).map_err(|error| RefusedMachine::File(Arc::new(error)))
            } else {
                Err(RefusedMachine::Unknown {
                    name: name.clone(),
                    known,
                })
            }
        }
        MachineRef::Inline { toml } => {
            Machine::from_untrusted_toml(toml).map_err(|error| RefusedMachine::File(Arc::new(error)))
        }
    }
}

fn prepare(reference: &MachineRef, cache: PathBuf) -> Result<ReadyMachine, RefusedMachine> {
    let machine = load(reference)?;
    let sha256 = hex::encode(machine.content_hash());
    Ok(ReadyMachine {
        sha256,
        simulator: Simulator::with_cache(machine, Some(cache)),
    })
}
