//! Machines by reference: loaded, checked and reduced once per process, and once per cache directory.

use hydroflex_ledger::blobs::{BlobError, Blobs, mesh_key};
use hydroflex_openapi::job::{JobSpec, MachineRef, ValueOrRange};
use hydroflex_sim::machine::{Machine, MachineError, MeshTexts};
use hydroflex_sim::simulator::{Simulator, SimulatorError};
use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, OnceLock};

/// Machines kept in memory. A reduced boom takes a few hundred kilobytes, its mesh a few megabytes.
const KEPT: usize = 8;

/// Why a machine cannot be simulated. All but [`RefusedMachine::Store`] are so for good: the same text
/// fails in the same way everywhere.
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
    /// No such mesh was uploaded.
    #[error("mesh {sha256} of body {body:?} is not in the store")]
    NoMesh {
        /// Body.
        body: String,
        /// SHA-256 of the mesh as given.
        sha256: String,
    },
    /// The store did not give a mesh; it may do so later.
    #[error("the mesh of body {body:?} cannot be read: {reason}")]
    Store {
        /// Body.
        body: String,
        /// What the store says.
        reason: String,
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

/// What a job says of its machine: the reference, and the meshes it gives by body and hash.
type Asked = (MachineRef, BTreeMap<String, String>);

/// The machines that this process has used lately.
pub struct Machines {
    cache: PathBuf,
    slots: Mutex<VecDeque<(Asked, Slot)>>,
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

    /// The machine of a job, loaded with its meshes from the store and reduced as the job's payloads
    /// need it. Takes seconds the first time: for a blocking thread of a runtime, not an async one.
    ///
    /// # Errors
    /// Says why the machine is refused.
    pub fn ready(&self, spec: &JobSpec, blobs: &Blobs) -> Result<Arc<ReadyMachine>, RefusedMachine> {
        let machine = self.loaded((spec.machine.clone(), spec.meshes.clone()), blobs)?;
        let with_payload = match spec.payload_kg {
            ValueOrRange::Value(value) => value > 0.0,
            ValueOrRange::Range { max, .. } => max > 0.0,
        };
        let refused = |error| RefusedMachine::Structure(Arc::new(error));
        machine.simulator.prepare(with_payload).map_err(refused)?;
        Ok(machine)
    }

    fn loaded(&self, asked: Asked, blobs: &Blobs) -> Result<Arc<ReadyMachine>, RefusedMachine> {
        let slot = {
            let mut slots = self
                .slots
                .lock()
                .unwrap_or_else(std::sync::PoisonError::into_inner);
            let known = slots.iter().position(|(known, _)| *known == asked);
            let slot = match known.and_then(|index| slots.remove(index)) {
                Some((_, slot)) => slot,
                None => Slot::default(),
            };
            slots.push_back((asked.clone(), slot.clone()));
            while slots.len() > KEPT {
                slots.pop_front();
            }
            slot
        };
        let (reference, meshes) = asked;
        // A store that does not answer now is no verdict on the machine, so it does not enter the slot.
        let texts = if slot.get().is_none() {
            fetch(&meshes, blobs)?
        } else {
            MeshTexts::new()
        };
        // Outside the lock, and once: who asks for the same machine meanwhile waits for it.
        slot.get_or_init(|| prepare(&reference, &texts, self.cache.clone()).map(Arc::new))
            .clone()
    }
}

/// Texts of the meshes that a job names by hash.
fn fetch(meshes: &BTreeMap<String, String>, blobs: &Blobs) -> Result<MeshTexts, RefusedMachine> {
    let runtime = tokio::runtime::Handle::current();
    let fetched = meshes.iter().map(|(body, sha256)| {
        let no_mesh = || RefusedMachine::NoMesh {
            body: body.clone(),
            sha256: sha256.clone(),
        };
        let key = mesh_key(sha256).ok_or_else(no_mesh)?;
        let content = runtime.block_on(blobs.read(&key, sha256)).map_err(|error| {
            if matches!(&error, BlobError::Store(_)) && error.is_loss() {
                no_mesh()
            } else {
                RefusedMachine::Store {
                    body: body.clone(),
                    reason: error.to_string(),
                }
            }
        })?;
        // What was uploaded was checked to be text; a byte that is not fails in the reader, with its line.
        let text = String::from_utf8_lossy(&content).into_owned();
        Ok((body.clone(), text))
    });
    fetched.collect()
}

/// Loads and checks a machine without reducing it. A reference comes from outside, so it may name
/// what the binary carries and what was uploaded, and nothing else.
fn load(reference: &MachineRef, meshes: &MeshTexts) -> Result<Machine, RefusedMachine> {
    let loaded = match reference {
        MachineRef::BuiltIn(name) => {
            let known = Machine::built_in_names();
            if !known.contains(&name.as_str()) {
                return Err(RefusedMachine::Unknown {
                    name: name.clone(),
                    known,
                });
            }
            Machine::built_in(name, meshes)
        }
        MachineRef::Inline { toml } => Machine::from_untrusted_toml(toml, meshes),
    };
    loaded.map_err(|error| RefusedMachine::File(Arc::new(error)))
}

fn prepare(
    reference: &MachineRef,
    meshes: &MeshTexts,
    cache: PathBuf,
) -> Result<ReadyMachine, RefusedMachine> {
    let machine = load(reference, meshes)?;
    let sha256 = hex::encode(machine.content_hash());
    Ok(ReadyMachine {
        sha256,
        simulator: Simulator::with_cache(machine, Some(cache)),
    })
}
