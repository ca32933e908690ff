//! Machines at the front desk: refused before anything runs, with the field at fault.

use super::notices;
use hydroflex_dataset::PublishSpec;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_openapi::catalogue::MachineInfo;
use hydroflex_openapi::dataset::{CodeFacts, MachineFacts};
use hydroflex_openapi::job::{JobSpec, MachineRef};
use hydroflex_openapi::machine::{BodySpec, MachineFile, MeshSource};
use hydroflex_openapi::problem::FieldError;
use hydroflex_openapi::status::JobNotice;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::scenario;
use hydroflex_worker::machines::{Machines, ReadyMachine, RefusedMachine};
use std::path::PathBuf;
use std::sync::Arc;

/// Makes machines ready, off the async threads.
pub struct MachineDesk {
    machines: Arc<Machines>,
    blobs: Blobs,
}

/// A machine that passed every check.
#[derive(Clone)]
pub struct CheckedMachine(Arc<ReadyMachine>);

impl MachineDesk {
    /// Keeps reduced bodies in `cache`, where workers find them; finds uploaded meshes in `blobs`.
    #[must_use]
    pub fn new(cache: PathBuf, blobs: Blobs) -> Self {
        Self {
            machines: Arc::new(Machines::new(cache)),
            blobs,
        }
    }

    /// The machine of a job, checked and reduced.
    ///
    /// # Errors
    /// Says what is wrong with it.
    pub async fn checked(&self, spec: &JobSpec) -> Result<Arc<CheckedMachine>, FieldError> {
        let (machines, blobs, asked) = (self.machines.clone(), self.blobs.clone(), spec.clone());
        let ready = tokio::task::spawn_blocking(move || machines.ready(&asked, &blobs)).await;
        match ready {
            Ok(Ok(ready)) => Ok(Arc::new(CheckedMachine(ready))),
            Ok(Err(refused)) => Err(refusal(spec, &refused)),
            Err(panic) => {
                tracing::error!(%panic, "a machine made its check panic");
                Err(FieldError::new("/machine", "this machine cannot be checked"))
            }
        }
    }

    /// Remarks on a job of this machine.
    pub async fn notices(&self, machine: Arc<CheckedMachine>, spec: &JobSpec) -> Vec<JobNotice> {
        let spec = spec.clone();
        let found = tokio::task::spawn_blocking(move || notices::of(machine.ready(), &spec)).await;
        found.unwrap_or_else(|panic| {
            // No job is refused because a remark on it fails.
            tracing::error!(%panic, "a job made the look for remarks panic");
            Vec::new()
        })
    }
}

fn refusal(spec: &JobSpec, refused: &RefusedMachine) -> FieldError {
    match (&spec.machine, refused) {
        (_, RefusedMachine::Unknown { name, known }) => {
            FieldError::new("/machine", "no such machine is built in")
                .value(name.as_str())
                .allowed(known.join(", "))
        }
        (_, RefusedMachine::NoMesh { body, sha256 }) => {
            FieldError::new(format!("/meshes/{body}"), "no such mesh was uploaded")
                .value(sha256.as_str())
                .allowed("the mesh_sha256 that POST /v1/meshes answered")
        }
        (_, RefusedMachine::Material(error)) => error.clone(),
        (_, RefusedMachine::Store { body, .. }) => {
            FieldError::new(format!("/meshes/{body}"), refused.to_string())
        }
        (MachineRef::BuiltIn(name), _) => {
            FieldError::new("/machine", refused.to_string()).value(name.as_str())
        }
        (MachineRef::Inline { .. }, _) => FieldError::new("/machine/toml", refused.to_string()),
    }
}

/// Random configurations looked at before a job is accepted, and the part of them from which the machine must be able
/// to start. A run draws up to a thousand times.
const REACH_DRAWS: u64 = 100;
const REACH_LEAST: f64 = 0.05;

impl CheckedMachine {
    /// A machine that a worker would simulate.
    #[must_use]
    pub fn new(ready: Arc<ReadyMachine>) -> Self {
        Self(ready)
    }

    /// SHA-256 of the machine, hexadecimal.
    #[must_use]
    pub fn sha256(&self) -> &str {
        &self.0.sha256
    }

    /// The machine with its simulator.
    #[must_use]
    pub fn ready(&self) -> &ReadyMachine {
        &self.0
    }

    /// Checks every field of a job against the machine.
    ///
    /// # Errors
    /// The fields at fault.
    pub fn validate(&self, spec: &JobSpec) -> Result<(), Vec<FieldError>> {
        let file = self.0.machine().file();
        let mut errors = match scenario::validate(spec, file) {
            Ok(()) => Vec::new(),
            Err(errors) => errors,
        };
        if !JobSpec::PRIORITIES.contains(&spec.priority) {
            errors.push(
                FieldError::new("/priority", "not a priority")
                    .value(spec.priority)
                    .allowed("-100 to 100"),
            );
        }
        if !errors.is_empty() {
            return Err(errors);
        }
        // Any material will do: lengths are those of the undeformed machine.
        let simulator = self.0.simulator_of((!spec.materials.is_empty()).then_some(0));
        let part = scenario::reachable_part(spec, file, simulator, REACH_DRAWS);
        if part < REACH_LEAST {
            return Err(vec![FieldError::new(
                "/initial_angle_deg",
                format!(
                    "{:?}: in {:.0} of {REACH_DRAWS} random configurations a cylinder starts outside the lengths it may \
                     start at; choose ranges in which at least {} % can start",
                    spec.initial_angle_deg,
                    (1.0 - part) * REACH_DRAWS as f64,
                    100.0 * REACH_LEAST,
                ),
            )]);
        }
        Ok(())
    }

    /// What decides the bytes of a job's data set, beside its runs. `instruction_set` is the level that
    /// they were simulated on.
    #[must_use]
    pub fn publish_spec(&self, spec: JobSpec, instruction_set: &str) -> PublishSpec {
        // When a job's turn comes changes no byte of what it makes.
        let spec = JobSpec { priority: 0, ..spec };
        let file = self.0.machine().file();
        let machine = MachineFacts {
            name: file.name.clone(),
            toml: self.0.machine().text().to_owned(),
            content_sha256: self.0.sha256.clone(),
            angles: file.angles.iter().map(|angle| angle.name.clone()).collect(),
        };
        let code = CodeFacts {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            instruction_set: instruction_set.to_owned(),
        };
        let eigenvalue_window_s = super::notices::eigenvalue_window_of_job_s(&self.0, &spec);
        PublishSpec {
            eigenvalue_window_s,
            ..PublishSpec::of_job(spec, machine, code, self.0.simulator.channels().to_vec())
        }
    }
}

/// The machines that the binary carries.
#[must_use]
pub fn built_in() -> Vec<MachineInfo> {
    Machine::built_in_names()
        .into_iter()
        .filter_map(|name| {
            let toml = Machine::built_in_text(name)?;
            let file = Machine::parse_file(toml).ok()?;
            Some(info(name, toml, &file))
        })
        .collect()
}

fn info(name: &str, toml: &str, file: &MachineFile) -> MachineInfo {
    let has_meshes = file.bodies.iter().all(|body| match body {
        BodySpec::Flexible(body) => matches!(body.mesh, MeshSource::BuiltIn(_)),
        BodySpec::Rigid(_) => true,
    });
    MachineInfo {
        name: name.to_owned(),
        description: file.description.clone(),
        cylinders: file
            .cylinders
            .iter()
            .map(|cylinder| cylinder.name.clone())
            .collect(),
        angles: file.angles.iter().map(|angle| angle.name.clone()).collect(),
        available: has_meshes,
        toml: toml.to_owned(),
    }
}
