//! A machine: read from TOML, checked whole against meshes and physics.
//!
//! Holding a [`Machine`] is the proof that every name resolves, every number is plausible, every
//! mesh is valid and every interface has its nodes.

mod built_in;
mod check;
mod error;
mod flexible;
mod from_spec;
mod reach;
mod text;

pub(crate) use check::material_numbers;
pub use error::{MachineError, MeshArgumentProblem, Place, Problem};
pub use flexible::{FlexibleBody, REDUCTION_VERSION};

use crate::fe::{GivenMatrices, Mesh, read_abaqus, read_matrices};
use crate::reduction::{ReducedBody, ReductionError, cached};
use hydroflex_openapi::machine::{BodySpec, MachineFile, MaterialSpec, MatricesSpec, MeshSource};
use sha2::{Digest, Sha256};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use text::MachineText;

/// A checked machine.
#[derive(Debug, Clone)]
pub struct Machine {
    file: MachineFile,
    text: String,
    flexible: Vec<FlexibleBody>,
}

/// A `--mesh` argument: `FILE`, or `BODY=FILE`.
#[derive(Debug, Clone)]
struct MeshArgument {
    body: Option<String>,
    path: PathBuf,
}

/// Where meshes may come from.
enum MeshAccess<'a> {
    /// The command line: files relative to a folder, and `--mesh` arguments.
    Local {
        folder: &'a Path,
        given: Vec<MeshArgument>,
    },
    /// Text from outside: meshes that the binary carries or that came as text themselves, by body;
    /// and nothing else.
    Texts(&'a MeshTexts),
}

/// Abaqus texts of meshes by the name of their body.
pub type MeshTexts = BTreeMap<String, String>;

impl Machine {
    /// Loads a built-in machine by name, or a TOML file by path. `meshes` are `FILE` or
    /// `BODY=FILE`; without a body name, the machine must have one body whose mesh is to be given.
    ///
    /// # Errors
    /// [`MachineError`] with file, line, key, value and what is allowed.
    pub fn load(name_or_path: &str, meshes: &[String]) -> Result<Self, MachineError> {
        if let Some(machine) = built_in::MACHINES.iter().find(|m| m.name == name_or_path) {
            let given = parse_mesh_arguments(meshes);
            let folder = Path::new("");
            return Self::build(machine.name, machine.text, &MeshAccess::Local { folder, given });
        }
        let path = Path::new(name_or_path);
        if !path.is_file() && path.extension().is_none() {
            return Err(MachineError::Unknown {
                name: name_or_path.to_owned(),
                built_in: Self::built_in_names(),
            });
        }
        let text = std::fs::read_to_string(path).map_err(|source| MachineError::Read {
            path: path.to_owned(),
            source,
        })?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let given = parse_mesh_arguments(meshes);
        Self::build(name_or_path, &text, &MeshAccess::Local { folder, given })
    }

    /// A machine from text that came from outside, such as a request: it may use built-in meshes
    /// and those given as text, and can name no path.
    ///
    /// # Errors
    /// [`MachineError`].
    pub fn from_untrusted_toml(text: &str, meshes: &MeshTexts) -> Result<Self, MachineError> {
        Self::build("machine", text, &MeshAccess::Texts(meshes))
    }

    /// A built-in machine with meshes that came from outside as text.
    ///
    /// # Errors
    /// [`MachineError`].
    pub fn built_in(name: &str, meshes: &MeshTexts) -> Result<Self, MachineError> {
        match built_in::MACHINES.iter().find(|m| m.name == name) {
            Some(machine) => Self::build(machine.name, machine.text, &MeshAccess::Texts(meshes)),
            None => Err(MachineError::Unknown {
                name: name.to_owned(),
                built_in: Self::built_in_names(),
            }),
        }
    }

    /// A machine from trusted text; mesh files are relative to the working directory.
    ///
    /// # Errors
    /// [`MachineError`].
    pub fn from_toml(text: &str, meshes: &[String]) -> Result<Self, MachineError> {
        let given = parse_mesh_arguments(meshes);
        let folder = Path::new("");
        Self::build("machine", text, &MeshAccess::Local { folder, given })
    }

    /// Names of the built-in machines; the first is the default.
    #[must_use]
    pub fn built_in_names() -> Vec<&'static str> {
        built_in::MACHINES.iter().map(|m| m.name).collect()
    }

    /// Text of a built-in machine file.
    #[must_use]
    pub fn built_in_text(name: &str) -> Option<&'static str> {
        let found = built_in::MACHINES.iter().find(|m| m.name == name);
        found.map(|m| m.text)
    }

    /// Reads and checks a machine file without its meshes: keys, units, numbers, names and
    /// references. For whoever needs the description alone.
    ///
    /// # Errors
    /// [`MachineError`].
    pub fn parse_file(text: &str) -> Result<MachineFile, MachineError> {
        let (located, file) = MachineText::parse("machine", text)?;
        check::check(&located, &file)?;
        Ok(file)
    }

    fn build(name: &str, text: &str, access: &MeshAccess<'_>) -> Result<Self, MachineError> {
        let (located, file) = MachineText::parse(name, text)?;
        check::check(&located, &file)?;
        check_mesh_arguments(&file, access)?;
        let mut flexible = Vec::new();
        for (index, body) in file.bodies.iter().enumerate() {
            let BodySpec::Flexible(spec) = body else {
                continue;
            };
            let key = format!("body[{index}].mesh");
            let refuse = |problem| located.refuse(key.clone(), problem);
            let (mesh_name, mesh_text) = mesh_text(&spec.name, &spec.mesh, access).map_err(&refuse)?;
            let mesh = read_abaqus(&mesh_text).map_err(|error| {
                refuse(Problem::Mesh {
                    mesh: mesh_name,
                    error,
                })
            })?;
            let sha256 = Sha256::digest(mesh_text.as_bytes()).into();
            let mut body_model = from_spec::flexible_body(&located, &file, index, mesh, sha256)?;
            if let Some(given) = &spec.matrices {
                let refuse = |problem| located.refuse(format!("body[{index}].matrices"), problem);
                body_model.matrices = Some(matrices(given, &body_model.mesh, access).map_err(refuse)?);
            }
            flexible.push(body_model);
        }
        let machine = Self {
            file,
            text: text.to_owned(),
            flexible,
        };
        machine.check_reach(&located)?;
        Ok(machine)
    }

    /// The description.
    #[must_use]
    pub fn file(&self) -> &MachineFile {
        &self.file
    }

    /// The description's text.
    #[must_use]
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The same machine with every flexible body of one material. Damping factors stay. Its text is that of this machine,
    /// and so is its content hash: who varies materials names them beside it.
    #[must_use]
    pub fn of_material(&self, material: &MaterialSpec) -> Self {
        let mut machine = self.clone();
        for body in &mut machine.file.bodies {
            if let BodySpec::Flexible(body) = body {
                body.material = material.clone();
            }
        }
        for body in &mut machine.flexible {
            body.material = material.into();
        }
        machine
    }

    /// Flexible bodies in the file's order.
    #[must_use]
    pub fn flexible_bodies(&self) -> &[FlexibleBody] {
        &self.flexible
    }

    /// SHA-256 of the description, the meshes and the version of the reduction.
    #[must_use]
    pub fn content_hash(&self) -> [u8; 32] {
        let mut hash = Sha256::new();
        hash.update(b"hydroflex machine\0");
        hash.update(REDUCTION_VERSION.to_le_bytes());
        hash.update((self.text.len() as u64).to_le_bytes());
        hash.update(self.text.as_bytes());
        for body in &self.flexible {
            hash.update(body.mesh_sha256);
            if let Some((_, sha256)) = &body.matrices {
                hash.update(sha256);
            }
        }
        hash.finalize().into()
    }

    /// Reduced flexible bodies in the file's order, in the basis of runs with or without payload.
    /// With a cache folder, what was reduced before is read from there.
    ///
    /// # Errors
    /// [`ReductionError`], such as a singular stiffness.
    pub fn reduce(
        &self,
        with_payload: bool,
        cache_dir: Option<&Path>,
    ) -> Result<Vec<ReducedBody>, ReductionError> {
        let reduce = |body: &FlexibleBody| match cache_dir {
            Some(folder) => cached(folder, body.reduction_key(with_payload), || {
                body.reduce(with_payload)
            }),
            None => body.reduce(with_payload),
        };
        self.flexible.iter().map(reduce).collect()
    }
}

fn parse_mesh_arguments(arguments: &[String]) -> Vec<MeshArgument> {
    arguments
        .iter()
        .map(|argument| match argument.split_once('=') {
            // a name, not a path with `=` in it
            Some((body, path))
                if !body.is_empty()
                    && body
                        .chars()
                        .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_') =>
            {
                MeshArgument {
                    body: Some(body.to_owned()),
                    path: PathBuf::from(path),
                }
            }
            _ => MeshArgument {
                body: None,
                path: PathBuf::from(argument),
            },
        })
        .collect()
}

fn check_mesh_arguments(file: &MachineFile, access: &MeshAccess<'_>) -> Result<(), MachineError> {
    let flexible = |wants: fn(&MeshSource) -> bool| -> Vec<String> {
        file.bodies
            .iter()
            .filter_map(|body| match body {
                BodySpec::Flexible(body) if wants(&body.mesh) => Some(body.name.clone()),
                _ => None,
            })
            .collect()
    };
    let all = flexible(|_| true);
    let given = match access {
        MeshAccess::Local { given, .. } => given,
        MeshAccess::Texts(texts) => {
            return match texts.keys().find(|body| !all.contains(body)) {
                None => Ok(()),
                Some(body) => Err(MachineError::MeshArgument {
                    argument: body.clone(),
                    problem: MeshArgumentProblem::UnknownBody {
                        body: body.clone(),
                        known: all,
                    },
                }),
            };
        }
    };
    let wanting = flexible(|mesh| matches!(mesh, MeshSource::Given(_)));
    let mut seen: Vec<&str> = Vec::new();
    for argument in given {
        let refuse = |problem| {
            Err(MachineError::MeshArgument {
                argument: argument.path.display().to_string(),
                problem,
            })
        };
        let body = match &argument.body {
            Some(body) if !all.contains(body) => {
                return refuse(MeshArgumentProblem::UnknownBody {
                    body: body.clone(),
                    known: all.clone(),
                });
            }
            Some(body) => body,
            None => match (&wanting[..], &all[..]) {
                ([only], _) | ([], [only]) => only,
                _ => {
                    return refuse(MeshArgumentProblem::Ambiguous {
                        bodies: wanting.clone(),
                    });
                }
            },
        };
        if seen.contains(&body.as_str()) {
            let body = body.clone();
            return refuse(MeshArgumentProblem::Twice { body });
        }
        seen.push(body);
    }
    Ok(())
}

/// Name and text of a body's mesh. A `--mesh` argument goes before the file's own source.
fn mesh_text(
    body: &str,
    source: &MeshSource,
    access: &MeshAccess<'_>,
) -> Result<(String, Cow<'static, str>), Problem> {
    let read = |path: PathBuf| match std::fs::read_to_string(&path) {
        Ok(text) => Ok((path.display().to_string(), Cow::Owned(text))),
        Err(error) => Err(Problem::MeshUnreadable {
            path: path.display().to_string(),
            reason: error.to_string(),
        }),
    };
    if let MeshAccess::Local { given, .. } = access {
        let wants = matches!(source, MeshSource::Given(_));
        let fits = |argument: &&MeshArgument| match &argument.body {
            Some(name) => name == body,
            None => wants || given.len() == 1,
        };
        if let Some(argument) = given.iter().find(fits) {
            return read(argument.path.clone());
        }
    }
    if let MeshAccess::Texts(texts) = access
        && let Some(text) = texts.get(body)
    {
        return Ok((format!("mesh of body {body:?}"), Cow::Owned(text.clone())));
    }
    match (source, access) {
        (MeshSource::BuiltIn(name), _) => match built_in::mesh(name) {
            Some(text) => Ok((name.clone(), Cow::Borrowed(text))),
            None => Err(Problem::UnknownMesh {
                name: name.clone(),
                known: built_in::mesh_names(),
            }),
        },
        (MeshSource::File(_), MeshAccess::Texts(_)) => Err(Problem::FileNotAllowed {
            known: built_in::mesh_names(),
        }),
        (MeshSource::File(path), MeshAccess::Local { folder, .. }) => read(folder.join(path)),
        (MeshSource::Given(what), _) => Err(Problem::MeshNotGiven {
            body: body.to_owned(),
            what: what.clone(),
        }),
    }
}

/// Mass and stiffness of a body from files beside the machine file, with the hash of both.
fn matrices(
    spec: &MatricesSpec,
    mesh: &Mesh,
    access: &MeshAccess<'_>,
) -> Result<(Arc<GivenMatrices>, [u8; 32]), Problem> {
    let MeshAccess::Local { folder, .. } = access else {
        return Err(Problem::MatricesNotAllowed);
    };
    let read = |name: &str| {
        let path = folder.join(name);
        std::fs::read_to_string(&path).map_err(|error| Problem::MatrixUnreadable {
            path: path.display().to_string(),
            reason: error.to_string(),
        })
    };
    let (stiffness, mass) = (read(&spec.stiffness)?, read(&spec.mass)?);
    let given = read_matrices(mesh, &stiffness, &mass)?;
    let mut hash = Sha256::new();
    for text in [stiffness, mass] {
        hash.update((text.len() as u64).to_le_bytes());
        hash.update(text.as_bytes());
    }
    Ok((Arc::new(given), hash.finalize().into()))
}

#[cfg(test)]
mod tests;
