//! Why a machine is refused.

use crate::fe::{MatrixError, MeshError};
use std::path::PathBuf;

/// A machine that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MachineError {
    /// Neither a built-in machine nor a file.
    #[error("no machine is called `{name}` and there is no such file; built in: {}", built_in.join(", "))]
    Unknown {
        /// As asked for.
        name: String,
        /// Names of the built-in machines.
        built_in: Vec<&'static str>,
    },
    /// A file that cannot be read.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A `--mesh` argument that fits no body.
    #[error("--mesh {argument}: {problem}")]
    MeshArgument {
        /// The argument.
        argument: String,
        /// Why.
        problem: MeshArgumentProblem,
    },
    /// A place in the machine file.
    #[error("{place}: {problem}")]
    Refused {
        /// Where.
        place: Place,
        /// What.
        problem: Box<Problem>,
    },
}

/// What is wrong with a `--mesh` argument.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MeshArgumentProblem {
    /// No flexible body of that name.
    #[error("there is no flexible body `{body}`; flexible bodies: {}", known.join(", "))]
    UnknownBody {
        /// Named body.
        body: String,
        /// Flexible bodies.
        known: Vec<String>,
    },
    /// A file without body name, and several bodies that want one.
    #[error("write BODY=FILE: {} bodies take a mesh ({})", bodies.len(), bodies.join(", "))]
    Ambiguous {
        /// Bodies whose mesh is given on the command line.
        bodies: Vec<String>,
    },
    /// Two files for one body.
    #[error("body `{body}` is given two meshes")]
    Twice {
        /// The body.
        body: String,
    },
}

/// A place in a machine file: file, line counted from 1, key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// File, or another name of the text.
    pub file: String,
    /// Line, where it is known.
    pub line: Option<usize>,
    /// Key path, such as `cylinder[0].stroke_m`; may be empty.
    pub key: String,
}

impl std::fmt::Display for Place {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.file)?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        if !self.key.is_empty() {
            write!(f, ": {}", self.key)?;
        }
        Ok(())
    }
}

/// What is wrong at a place.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Problem {
    /// The text is not TOML.
    #[error("not valid TOML: {message}")]
    Syntax {
        /// The parser's words.
        message: String,
    },
    /// A key that this format does not have.
    #[error("unknown key{}; allowed: {}", hint.as_ref().map_or(String::new(), |h| format!(" ({h})")), allowed.join(", "))]
    UnknownKey {
        /// What was probably meant.
        hint: Option<String>,
        /// Keys that may stand here.
        allowed: Vec<String>,
    },
    /// A key that must be there.
    #[error("the key `{key}` is missing")]
    MissingKey {
        /// Key.
        key: String,
    },
    /// A value of the wrong kind.
    #[error("{message}")]
    WrongType {
        /// What was found and what is allowed, in the parser's words.
        message: String,
    },
    /// A list of the wrong length.
    #[error("{found} numbers where {wanted} are needed")]
    ListLength {
        /// Found.
        found: usize,
        /// Needed.
        wanted: usize,
    },
    /// A format version that this build does not read.
    #[error("format {found} is not read; this build reads format {supported}")]
    Format {
        /// Found.
        found: u32,
        /// Read.
        supported: u32,
    },
    /// A number out of its range.
    #[error("{} is outside the allowed range {} to {} {unit}", short(*value), short(*low), short(*high))]
    OutOfRange {
        /// Value.
        value: f64,
        /// Smallest allowed.
        low: f64,
        /// Largest allowed.
        high: f64,
        /// Unit.
        unit: &'static str,
    },
    /// A pair that must be ascending.
    #[error("the range runs from {low} to {high}; the first must be the smaller")]
    Descending {
        /// First.
        low: f64,
        /// Second.
        high: f64,
    },
    /// Two values that contradict each other.
    #[error("{value} contradicts {other_key} = {other}: {rule}")]
    Contradiction {
        /// Value at the place.
        value: f64,
        /// The other key.
        other_key: &'static str,
        /// Its value.
        other: f64,
        /// What must hold.
        rule: &'static str,
    },
    /// A name with characters that column names cannot have.
    #[error("the name `{name}` must be lower-case letters, digits and {separator}, starting with a letter")]
    BadName {
        /// Name.
        name: String,
        /// `_` or `-`.
        separator: char,
    },
    /// A name used twice.
    #[error("the name `{name}` is used twice")]
    DuplicateName {
        /// Name.
        name: String,
    },
    /// A name that is not defined.
    #[error("there is no {kind} `{name}`; there are: {}", known.join(", "))]
    UnknownName {
        /// `body`, `interface`, …
        kind: &'static str,
        /// Name.
        name: String,
        /// Defined names.
        known: Vec<String>,
    },
    /// An attachment that says too little or too much.
    #[error("attach {body} by {wanted}")]
    Attachment {
        /// Body.
        body: String,
        /// What is needed.
        wanted: &'static str,
    },
    /// Something must be there at least once.
    #[error("at least one {what} is needed")]
    Missing {
        /// What.
        what: &'static str,
    },
    /// The first interface of a body carries its frame and must be a boundary in every run.
    #[error("the first interface carries the body's frame: its boundary must be \"always\"")]
    FirstInterface,
    /// Inertia that no body can have.
    #[error(
        "no body has these moments of inertia: the matrix must be positive definite and each principal moment at most the sum of the other two"
    )]
    Inertia,
    /// A body that no joint holds.
    #[error("body `{body}` is not connected to the ground by joints")]
    Unconnected {
        /// Body.
        body: String,
    },
    /// Axis of zero length.
    #[error("the axis has no length")]
    NoAxis,
    /// No mesh was given.
    #[error(
        "body `{body}` needs a mesh: {what}; give it with --mesh {body}=FILE, over REST with POST /v1/meshes and the job's `meshes`"
    )]
    MeshNotGiven {
        /// Body.
        body: String,
        /// Which mesh.
        what: String,
    },
    /// A built-in mesh that does not exist.
    #[error("there is no built-in mesh `{name}`; built in: {}", known.join(", "))]
    UnknownMesh {
        /// Name.
        name: String,
        /// Names.
        known: Vec<&'static str>,
    },
    /// A machine text from outside may not name files.
    #[error("a machine sent as text cannot name a file; upload the mesh and name it in the job's `meshes`, or use a built-in one ({})", known.join(", "))]
    FileNotAllowed {
        /// Names of built-in meshes.
        known: Vec<&'static str>,
    },
    /// A mesh file that cannot be read.
    #[error("cannot read the mesh {path}: {reason}")]
    MeshUnreadable {
        /// Path.
        path: String,
        /// The operating system's words.
        reason: String,
    },
    /// Matrices in text that came from outside.
    #[error("a machine that is sent as text can name no files of matrices; simulate it from its file")]
    MatricesNotAllowed,
    /// A matrix that cannot be read.
    #[error("cannot read the matrix {path}: {reason}")]
    MatrixUnreadable {
        /// Path.
        path: String,
        /// The operating system's words.
        reason: String,
    },
    /// Matrices that cannot be used.
    #[error("{0}")]
    Matrices(#[from] MatrixError),
    /// A mesh that cannot be used.
    #[error("mesh {mesh}: {error}")]
    Mesh {
        /// Mesh file or name.
        mesh: String,
        /// Why.
        error: MeshError,
    },
    /// An interface without nodes.
    #[error("interface `{interface}` selects no node of the mesh{}", nearest.as_ref().map_or(String::new(), |n| format!("; {n}")))]
    NoNodes {
        /// Interface.
        interface: String,
        /// What lies nearest, if that helps.
        nearest: Option<String>,
    },
    /// Fewer than three nodes, or nodes on a line: no rotation can be measured.
    #[error("the {count} nodes of interface `{interface}` lie on a line; a rotation needs three that do not")]
    Collinear {
        /// Interface.
        interface: String,
        /// Nodes.
        count: usize,
    },
    /// Area weights without triangles.
    #[error(
        "interface `{interface}` has no surface triangle with all three nodes in it; use uniform weights"
    )]
    NoTriangles {
        /// Interface.
        interface: String,
    },
    /// Two interfaces share nodes.
    #[error("interfaces `{first}` and `{second}` share {count} nodes")]
    Overlap {
        /// First.
        first: String,
        /// Second.
        second: String,
        /// Shared nodes.
        count: usize,
    },
    /// A sensor away from the surface.
    #[error("the surface node nearest to this point is {distance_m:.4} m away, at ({:.4}, {:.4}, {:.4}); within_m allows {within_m}", node_m[0], node_m[1], node_m[2])]
    SensorTooFar {
        /// Distance, m.
        distance_m: f64,
        /// Allowed, m.
        within_m: f64,
        /// That node, m.
        node_m: [f64; 3],
    },
    /// An angle that the cylinder cannot reach.
    #[error(
        "at {angle_deg:.2}° the eyes of cylinder `{cylinder}` are {length_m:.4} m apart, outside its {shortest_m:.4} to {longest_m:.4} m"
    )]
    OutOfReach {
        /// Cylinder.
        cylinder: String,
        /// Angle, degrees.
        angle_deg: f64,
        /// Eye distance, m.
        length_m: f64,
        /// Closed length, m.
        shortest_m: f64,
        /// Closed length and stroke, m.
        longest_m: f64,
    },
    /// The eyes coincide, so the cylinder has no direction.
    #[error("both eyes of the cylinder belong to body `{body}`")]
    SameBody {
        /// Body.
        body: String,
    },
}

/// A number as a person would write it: powers of ten where there would be many zeros.
fn short(x: f64) -> String {
    if x == 0.0 || (1e-3..1e5).contains(&x.abs()) || !x.is_finite() {
        x.to_string()
    } else {
        format!("{x:e}")
    }
}
