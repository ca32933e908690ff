//! Reader of Abaqus `.inp` meshes: nodes, C3D4 and C3D10 elements, node and element sets.
//!
//! One part, or one instance of one part, or a flat file. Keywords that carry no mesh (material,
//! step, …) are skipped; anything that would silently change the mesh (another element type, an
//! instance with a transformation, an include) is refused with its line.

mod sets;

use super::mesh::{Elements, Mesh, MeshDefect};
use nalgebra::Vector3;
use sets::{SetKind, Sets};
use std::collections::HashMap;

/// A mesh that cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MeshError {
    /// The text is wrong at a line (counted from 1).
    #[error("line {line}: {problem}")]
    Line {
        /// Line, from 1.
        line: usize,
        /// What is wrong there.
        problem: MeshProblem,
    },
    /// The text has no nodes.
    #[error("the file has no *NODE data")]
    NoNodes,
    /// The text has no elements.
    #[error("the file has no *ELEMENT data of type C3D4 or C3D10")]
    NoElements,
    /// The mesh as a whole is wrong.
    #[error(transparent)]
    Defect(#[from] MeshDefect),
}

/// What can be wrong on a line.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MeshProblem {
    /// A number was expected.
    #[error("`{text}` is not {wanted}")]
    NotANumber {
        /// What stands there.
        text: String,
        /// What was wanted.
        wanted: &'static str,
    },
    /// Too few or too many entries.
    #[error("{found} entries where {wanted} are needed")]
    EntryCount {
        /// Found.
        found: usize,
        /// Needed.
        wanted: &'static str,
    },
    /// Element type that is not read.
    #[error("element type `{0}` is not read; C3D4 and C3D10 are (export the volume elements only)")]
    ElementType(String),
    /// Both kinds in one file.
    #[error("C3D4 and C3D10 elements are mixed in one mesh")]
    MixedElements,
    /// Keyword without a needed parameter.
    #[error("*{keyword} needs {parameter}=…")]
    MissingParameter {
        /// Keyword.
        keyword: &'static str,
        /// Parameter.
        parameter: &'static str,
    },
    /// A label used twice.
    #[error("{kind} {label} is defined twice")]
    Duplicate {
        /// `node` or `element`.
        kind: &'static str,
        /// Label.
        label: u64,
    },
    /// A label that is not defined.
    #[error("{kind} {label} is not defined")]
    Undefined {
        /// `node` or `element`.
        kind: &'static str,
        /// Label.
        label: u64,
    },
    /// A set name that is not defined.
    #[error("set `{0}` is not defined before this line")]
    UndefinedSet(String),
    /// Sets that hold each other, or the same ranges, too often.
    #[error("sets have more than {0} members from other sets or ranges")]
    SetsTooLarge(usize),
    /// A GENERATE line with a bad range.
    #[error("GENERATE range {first}, {last}, {step} is empty or has no step")]
    BadRange {
        /// First label.
        first: u64,
        /// Last label.
        last: u64,
        /// Increment.
        step: u64,
    },
    /// A keyword that would change the mesh and is not read.
    #[error("*{0} is not read")]
    Keyword(String),
    /// An instance with a translation or rotation.
    #[error("the instance is translated or rotated; export the part in its own frame")]
    TransformedInstance,
    /// Data before the first keyword.
    #[error("data before the first keyword")]
    StrayData,
    /// The last element of a block is cut off.
    #[error("the element is cut off: {found} of {wanted} numbers")]
    CutOff {
        /// Numbers found.
        found: usize,
        /// Numbers needed.
        wanted: usize,
    },
}

/// Reads and checks a mesh.
///
/// # Errors
/// [`MeshError`] with the line, or the defect of the whole mesh.
///
/// # Examples
/// ```
/// let text = "*NODE\n1, 0, 0, 0\n2, 1, 0, 0\n3, 0, 1, 0\n4, 0, 0, 1\n*ELEMENT, TYPE=C3D4\n1, 1, 2, 3, 4\n";
/// let mesh = hydroflex_sim::fe::read_abaqus(text)?;
/// assert!((mesh.volume_m3() - 1.0 / 6.0).abs() < 1e-15);
/// # Ok::<(), hydroflex_sim::fe::MeshError>(())
/// ```
pub fn read_abaqus(text: &str) -> Result<Mesh, MeshError> {
    let mut reader = Reader::default();
    for (line, content) in logical_lines(text) {
        reader
            .line(line, &content)
            .map_err(|problem| MeshError::Line { line, problem })?;
    }
    let mesh = reader.finish()?;
    mesh.check()?;
    Ok(mesh)
}

/// Lines without comments and blanks, numbered from 1; keyword lines that end in a comma are
/// joined with their continuation.
fn logical_lines(text: &str) -> impl Iterator<Item = (usize, String)> {
    let mut lines = text
        .lines()
        .enumerate()
        .map(|(i, line)| (i + 1, line.trim()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with("**"));
    std::iter::from_fn(move || {
        let (number, line) = lines.next()?;
        let mut line = line.to_owned();
        while line.starts_with('*') && line.ends_with(',') {
            let Some((_, more)) = lines.next() else { break };
            line.push_str(more);
        }
        Some((number, line))
    })
}

/// A keyword line: upper-case keyword, parameters with upper-case names.
struct Keyword<'a> {
    name: String,
    parameters: Vec<(String, Option<&'a str>)>,
}

impl<'a> Keyword<'a> {
    fn parse(line: &'a str) -> Self {
        let mut entries = line.trim_start_matches('*').split(',').map(str::trim);
        let name = entries.next().unwrap_or_default();
        let name = name
            .split_whitespace()
            .collect::<Vec<_>>()
            .join(" ")
            .to_uppercase();
        let parameters = entries
            .filter(|entry| !entry.is_empty())
            .map(|entry| match entry.split_once('=') {
                Some((key, value)) => (key.trim().to_uppercase(), Some(unquote(value.trim()))),
                None => (entry.to_uppercase(), None),
            })
            .collect();
        Self { name, parameters }
    }

    fn value(&self, parameter: &str) -> Option<&'a str> {
        let (_, value) = self.parameters.iter().find(|(key, _)| key == parameter)?;
        *value
    }

    fn flag(&self, parameter: &str) -> bool {
        self.parameters.iter().any(|(key, _)| key == parameter)
    }
}

fn unquote(text: &str) -> &str {
    text.strip_prefix('"')
        .and_then(|text| text.strip_suffix('"'))
        .unwrap_or(text)
}

/// What the data lines after a keyword mean.
#[derive(Default)]
enum Section {
    #[default]
    Start,
    Skipped,
    Nodes {
        set: Option<String>,
    },
    Elements {
        nodes: usize,
        set: Option<String>,
    },
    Set {
        kind: SetKind,
        name: String,
        generate: bool,
    },
    Instance,
}

#[derive(Default)]
struct Reader {
    section: Section,
    nodes_m: Vec<Vector3<f64>>,
    node_labels: Vec<u64>,
    node_of_label: HashMap<u64, u32>,
    elements: Option<Elements>,
    element_labels: Vec<u64>,
    element_of_label: HashMap<u64, u32>,
    /// Numbers of an element that continues on the next line.
    partial: Vec<u64>,
    sets: Sets,
}

impl Reader {
    fn line(&mut self, number: usize, line: &str) -> Result<(), MeshProblem> {
        if line.starts_with('*') {
            self.check_partial()?;
            return self.keyword(&Keyword::parse(line));
        }
        match std::mem::take(&mut self.section) {
            Section::Start => return Err(MeshProblem::StrayData),
            Section::Skipped => self.section = Section::Skipped,
            Section::Instance => return Err(MeshProblem::TransformedInstance),
            Section::Nodes { set } => {
                self.node(line, set.as_deref())?;
                self.section = Section::Nodes { set };
            }
            Section::Elements { nodes, set } => {
                self.element(line, nodes, set.as_deref())?;
                self.section = Section::Elements { nodes, set };
            }
            Section::Set { kind, name, generate } => {
                self.sets.data(number, kind, &name, generate, line)?;
                self.section = Section::Set { kind, name, generate };
            }
        }
        Ok(())
    }

    fn check_partial(&self) -> Result<(), MeshProblem> {
        match (&self.section, self.partial.len()) {
            (_, 0) => Ok(()),
            (Section::Elements { nodes, .. }, found) => Err(MeshProblem::CutOff {
                found,
                wanted: nodes + 1,
            }),
            _ => Ok(()),
        }
    }

    fn keyword(&mut self, keyword: &Keyword<'_>) -> Result<(), MeshProblem> {
        let owned = |name: &str| {
            let name = keyword.value(name).filter(|name| !name.is_empty());
            name.map(str::to_owned)
        };
        self.section = match keyword.name.as_str() {
            "NODE" => Section::Nodes { set: owned("NSET") },
            "ELEMENT" => {
                let kind = keyword.value("TYPE").ok_or(MeshProblem::MissingParameter {
                    keyword: "ELEMENT",
                    parameter: "TYPE",
                })?;
                Section::Elements {
                    nodes: self.begin_elements(kind)?,
                    set: owned("ELSET"),
                }
            }
            "NSET" => self.begin_set(SetKind::Nodes, keyword)?,
            "ELSET" => self.begin_set(SetKind::Elements, keyword)?,
            "INSTANCE" => Section::Instance,
            "INCLUDE" | "SYSTEM" | "NGEN" | "NCOPY" | "NFILL" | "ELGEN" | "ELCOPY" | "NMAP" => {
                return Err(MeshProblem::Keyword(keyword.name.clone()));
            }
            _ => Section::Skipped,
        };
        Ok(())
    }

    fn begin_elements(&mut self, kind: &str) -> Result<usize, MeshProblem> {
        match (kind.to_uppercase().as_str(), &self.elements) {
            ("C3D4", None) => {
                self.elements = Some(Elements::Tet4(Vec::new()));
                Ok(4)
            }
            ("C3D10", None) => {
                self.elements = Some(Elements::Tet10(Vec::new()));
                Ok(10)
            }
            ("C3D4", Some(Elements::Tet4(_))) => Ok(4),
            ("C3D10", Some(Elements::Tet10(_))) => Ok(10),
            ("C3D4" | "C3D10", Some(_)) => Err(MeshProblem::MixedElements),
            _ => Err(MeshProblem::ElementType(kind.to_owned())),
        }
    }

    fn begin_set(&mut self, kind: SetKind, keyword: &Keyword<'_>) -> Result<Section, MeshProblem> {
        let (word, parameter) = kind.words();
        let name = keyword
            .value(parameter)
            .filter(|name| !name.is_empty())
            .ok_or(MeshProblem::MissingParameter {
                keyword: word,
                parameter,
            })?
            .to_owned();
        self.sets.begin(kind, &name);
        Ok(Section::Set {
            kind,
            name,
            generate: keyword.flag("GENERATE"),
        })
    }

    fn node(&mut self, line: &str, set: Option<&str>) -> Result<(), MeshProblem> {
        let entries: Vec<&str> = entries(line).collect();
        if entries.len() < 4 {
            return Err(MeshProblem::EntryCount {
                found: entries.len(),
                wanted: "a label and three coordinates",
            });
        }
        let label = parse_label(entries[0])?;
        let mut x = Vector3::zeros();
        for (x, text) in x.iter_mut().zip(&entries[1..4]) {
            *x = parse_coordinate(text)?;
        }
        let node = next_index(self.nodes_m.len(), "node", label)?;
        if self.node_of_label.insert(label, node).is_some() {
            return Err(MeshProblem::Duplicate { kind: "node", label });
        }
        self.nodes_m.push(x);
        self.node_labels.push(label);
        if let Some(set) = set {
            self.sets.add_label(SetKind::Nodes, set, label);
        }
        Ok(())
    }

    fn element(&mut self, line: &str, nodes: usize, set: Option<&str>) -> Result<(), MeshProblem> {
        for entry in entries(line) {
            self.partial.push(parse_label(entry)?);
        }
        if self.partial.len() <= nodes {
            return if line.ends_with(',') {
                Ok(())
            } else {
                Err(MeshProblem::CutOff {
                    found: self.partial.len(),
                    wanted: nodes + 1,
                })
            };
        }
        if self.partial.len() > nodes + 1 {
            return Err(MeshProblem::EntryCount {
                found: self.partial.len(),
                wanted: if nodes == 4 { "5" } else { "11" },
            });
        }
        let numbers = std::mem::take(&mut self.partial);
        let label = numbers[0];
        let mut indices = [0_u32; 10];
        for (index, label) in indices.iter_mut().zip(&numbers[1..]) {
            *index = *self.node_of_label.get(label).ok_or(MeshProblem::Undefined {
                kind: "node",
                label: *label,
            })?;
        }
        let element = next_index(self.element_labels.len(), "element", label)?;
        if self.element_of_label.insert(label, element).is_some() {
            return Err(MeshProblem::Duplicate {
                kind: "element",
                label,
            });
        }
        self.element_labels.push(label);
        match &mut self.elements {
            Some(Elements::Tet4(list)) => {
                let [a, b, c, d, ..] = indices;
                list.push([a, b, c, d]);
            }
            Some(Elements::Tet10(list)) => list.push(indices),
            None => unreachable!("begin_elements comes first"),
        }
        if let Some(set) = set {
            self.sets.add_label(SetKind::Elements, set, label);
        }
        Ok(())
    }

    fn finish(self) -> Result<Mesh, MeshError> {
        if self.nodes_m.is_empty() {
            return Err(MeshError::NoNodes);
        }
        let elements = match self.elements {
            Some(elements) if !elements.is_empty() => elements,
            _ => return Err(MeshError::NoElements),
        };
        let (node_sets, element_sets) = self
            .sets
            .resolve(&self.node_of_label, &self.element_of_label)
            .map_err(|(line, problem)| MeshError::Line { line, problem })?;
        Ok(Mesh {
            nodes_m: self.nodes_m,
            elements,
            node_labels: self.node_labels,
            element_labels: self.element_labels,
            node_sets,
            element_sets,
        })
    }
}

fn next_index(count: usize, kind: &'static str, label: u64) -> Result<u32, MeshProblem> {
    // more than 2³² nodes would not fit in memory; the error is there for form
    u32::try_from(count).map_err(|_| MeshProblem::Duplicate { kind, label })
}

/// Entries of a data line; a trailing comma adds none.
fn entries(line: &str) -> impl Iterator<Item = &str> {
    line.strip_suffix(',').unwrap_or(line).split(',').map(str::trim)
}

fn parse_label(text: &str) -> Result<u64, MeshProblem> {
    text.parse()
        .ok()
        .filter(|label| *label > 0)
        .ok_or_else(|| not_a_number(text, "a label (1, 2, …)"))
}

fn parse_coordinate(text: &str) -> Result<f64, MeshProblem> {
    let parsed = text.parse::<f64>().or_else(|error| {
        // Fortran exponents
        if text.contains(['d', 'D']) {
            text.replace(['d', 'D'], "e").parse()
        } else {
            Err(error)
        }
    });
    parsed
        .ok()
        .filter(|x| x.is_finite())
        .ok_or_else(|| not_a_number(text, "a finite coordinate"))
}

fn not_a_number(text: &str, wanted: &'static str) -> MeshProblem {
    MeshProblem::NotANumber {
        text: text.chars().take(40).collect(),
        wanted,
    }
}

#[cfg(test)]
mod tests;
