//! Machines by reference: loaded, checked and reduced once per process, and once per cache directory.

use hydroflex_ledger::blobs::{Blobs, mesh_key};
use hydroflex_openapi::job::{JobSpec, MachineRef, MaterialRef, ValueOrRange};
use hydroflex_openapi::machine::MaterialSpec;
use hydroflex_openapi::problem::FieldError;
use hydroflex_sim::machine::{Machine, MachineError, MeshTexts};
use hydroflex_sim::scenario::validate_materials;
use hydroflex_sim::simulator::{Simulator, SimulatorError};
use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
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
    /// A material of the job is none.
    #[error("{}: {}, allowed is {}", .0.pointer, .0.detail, .0.allowed.as_deref().unwrap_or_default())]
    Material(FieldError),
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
    /// Simulators of the same machine made of the job's materials, in the job's order.
    of_materials: Vec<Simulator>,
}

impl ReadyMachine {
    /// A machine of its own material and of these; reduced bodies are kept in the directory `cache`.
    #[must_use]
    pub fn new(machine: Machine, materials: &[MaterialSpec], cache: &Path) -> Self {
        let cache = Some(cache.to_path_buf());
        Self {
            sha256: hex::encode(machine.content_hash()),
            of_materials: materials
                .iter()
                .map(|material| Simulator::with_cache(machine.of_material(material), cache.clone()))
                .collect(),
            simulator: Simulator::with_cache(machine, cache),
        }
    }

    /// The simulator of the machine made of one of the job's materials, or as its file says.
    ///
    /// # Panics
    /// When this machine was not made for so many materials.
    #[must_use]
    pub fn simulator_of(&self, material: Option<usize>) -> &Simulator {
        material.map_or(&self.simulator, |index| &self.of_materials[index])
    }

    /// Every simulator that the job's runs need.
    fn simulators(&self) -> &[Simulator] {
        if self.of_materials.is_empty() {
            std::slice::from_ref(&self.simulator)
        } else {
            &self.of_materials
        }
    }

    /// The machine.
    #[must_use]
    pub fn machine(&self) -> &Machine {
        self.simulator.machine()
    }
}

type Slot = Arc<OnceLock<Result<Arc<ReadyMachine>, RefusedMachine>>>;

/// What a job says of its machine: the reference, the meshes it gives by body and hash, and materials.
#[derive(Clone, PartialEq)]
struct Asked {
    machine: MachineRef,
    meshes: BTreeMap<String, String>,
    materials: Vec<MaterialRef>,
}

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
        let machine = self.loaded(spec, blobs)?;
        // A machine without payload is reduced without its interface: another body.
        let kinds: &[bool] = match spec.payload_kg {
            ValueOrRange::Value(value) => &[value > 0.0],
            ValueOrRange::Range { max, empty, .. } if max == 0.0 || empty >= 1.0 => &[false],
            ValueOrRange::Range { empty: 0.0, .. } => &[true],
            ValueOrRange::Range { .. } => &[true, false],
        };
        let refused = |error| RefusedMachine::Structure(Arc::new(error));
        // One after the other: a reduction has the cores to itself, and its factor in memory.
        for simulator in machine.simulators() {
            for &with_payload in kinds {
                simulator.prepare(with_payload).map_err(refused)?;
            }
        }
        Ok(machine)
    }

    fn loaded(&self, spec: &JobSpec, blobs: &Blobs) -> Result<Arc<ReadyMachine>, RefusedMachine> {
        let asked = Asked {
            machine: spec.machine.clone(),
            meshes: spec.meshes.clone(),
            materials: spec.materials.clone(),
        };
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
            slots.push_back((asked, slot.clone()));
            while slots.len() > KEPT {
                slots.pop_front();
            }
            slot
        };
        // A store that does not answer now is no verdict on the machine, so it does not enter the slot.
        let texts = if slot.get().is_none() {
            fetch(&spec.meshes, blobs)?
        } else {
            MeshTexts::new()
        };
        // Outside the lock, and once: who asks for the same machine meanwhile waits for it.
        slot.get_or_init(|| prepare(spec, &texts, &self.cache).map(Arc::new))
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
            // One that is damaged will be no better the next time: there is none of this hash. A directory that
            // is gone as a whole may come back.
            let away = blobs.local_path("").is_some_and(|root| !root.is_dir());
            if error.is_loss() && !away {
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

fn prepare(spec: &JobSpec, meshes: &MeshTexts, cache: &Path) -> Result<ReadyMachine, RefusedMachine> {
    let machine = load(&spec.machine, meshes)?;
    if let Err(errors) = validate_materials(spec, machine.file())
        && let Some(first) = errors.into_iter().next()
    {
        return Err(RefusedMachine::Material(first));
    }
    let materials: Vec<MaterialSpec> = spec.materials.iter().filter_map(MaterialRef::material).collect();
    Ok(ReadyMachine::new(machine, &materials, cache))
}
