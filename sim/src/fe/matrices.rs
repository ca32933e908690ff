//! Mass and stiffness that Abaqus assembled, in place of our own: the text files of `*MATRIX OUTPUT`.
//!
//! ```text
//! FORMAT=MATRIX INPUT    row node, row dof, column node, column dof, entry
//! FORMAT=COORDINATE      row, column, entry            row = 3·(place of the node by ascending label) + dof
//! ```
//!
//! Entries are separated by commas or blanks; one triangle or both may be given. The matrices are those of a free body with three
//! translations per node: every entry must belong to a node of the mesh, motions without strain must meet no force, and the
//! mass must be a number per pair of nodes, as shape functions and lumping make it (the floating frame needs that).

use super::assembly::{BlockMatrix, ConsistentMass, NodalMass, NodePattern};
use super::mesh::Mesh;
use nalgebra::{DMatrix, Matrix3, Vector3};
use std::fmt;

/// Relative difference up to which two entries are the same number: files carry 15 or 16 digits.
const SAME: f64 = 1e-9;
/// Force of a motion without strain, relative to the largest force of one of its terms.
const FREE: f64 = 1e-6;

/// Mass and stiffness of a free body on the nodes of a mesh.
#[derive(Debug, Clone, PartialEq)]
pub struct GivenMatrices {
    /// Stiffness, N/m.
    pub stiffness: BlockMatrix,
    /// Mass, kg.
    pub mass: NodalMass,
}

/// Which of the two matrices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MatrixKind {
    /// N/m.
    Stiffness,
    /// kg.
    Mass,
}

impl fmt::Display for MatrixKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Stiffness => "stiffness",
            Self::Mass => "mass",
        })
    }
}

/// A matrix that cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MatrixError {
    /// The text is wrong at a line.
    #[error("line {line} of the {kind} matrix: {problem}")]
    Line {
        /// Which matrix.
        kind: MatrixKind,
        /// Line, from 1.
        line: usize,
        /// What is wrong there.
        problem: MatrixProblem,
    },
    /// The matrix as a whole is wrong.
    #[error("the {kind} matrix {defect}")]
    Whole {
        /// Which matrix.
        kind: MatrixKind,
        /// What is wrong with it.
        defect: MatrixDefect,
    },
}

/// What can be wrong on a line.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MatrixProblem {
    /// Neither format, or both in one file.
    #[error(
        "{found} numbers; allowed are 5 (node, dof, node, dof, entry) or 3 (row, column, entry), the same on every line"
    )]
    EntryCount {
        /// Numbers on the line.
        found: usize,
    },
    /// A number was expected.
    #[error("`{text}` is not {wanted}")]
    NotANumber {
        /// What stands there.
        text: String,
        /// What was wanted.
        wanted: &'static str,
    },
    /// A node that the mesh lacks.
    #[error("the mesh has no node {label}")]
    UnknownNode {
        /// Label; internal nodes have negative ones.
        label: i64,
    },
    /// A degree of freedom that solid elements do not have.
    #[error("degree of freedom {dof}; allowed are 1 to 3")]
    Dof {
        /// As given.
        dof: i64,
    },
    /// A row or column that the mesh lacks.
    #[error("row or column {found}; the mesh's nodes have 1 to {most}")]
    Row {
        /// As given.
        found: i64,
        /// Three per node.
        most: usize,
    },
    /// An unsymmetric matrix.
    #[error("an unsymmetric matrix; allowed is a symmetric one")]
    Unsymmetric,
}

/// What can be wrong with a matrix as a whole.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MatrixDefect {
    /// An entry is there twice.
    #[error("gives the entry of node {row} dof {row_dof} and node {column} dof {column_dof} twice")]
    Twice {
        /// Label of the row's node.
        row: u64,
        /// 1 to 3.
        row_dof: usize,
        /// Label of the column's node.
        column: u64,
        /// 1 to 3.
        column_dof: usize,
    },
    /// Both triangles are given and differ.
    #[error(
        "is not symmetric: node {row} dof {row_dof}, node {column} dof {column_dof} is {value:e}, its mirror image {mirrored:e}"
    )]
    Asymmetric {
        /// Label of the row's node.
        row: u64,
        /// 1 to 3.
        row_dof: usize,
        /// Label of the column's node.
        column: u64,
        /// 1 to 3.
        column_dof: usize,
        /// Lower triangle.
        value: f64,
        /// Upper triangle.
        mirrored: f64,
    },
    /// A degree of freedom without positive diagonal entry.
    #[error(
        "has {value:e} on the diagonal at node {node} dof {dof}; every node of the mesh needs a positive number for dof 1 to 3"
    )]
    Diagonal {
        /// Label.
        node: u64,
        /// 1 to 3.
        dof: usize,
        /// What is there; 0 if nothing is.
        value: f64,
    },
    /// The mass differs by direction, or couples directions.
    #[error(
        "is not one number per pair of nodes: between nodes {row} and {column} directions {dof} and {other_dof} hold {value:e} where {wanted:e} is needed"
    )]
    Directional {
        /// Label.
        row: u64,
        /// Label.
        column: u64,
        /// Direction of the row, 1 to 3.
        dof: usize,
        /// Direction of the column, 1 to 3.
        other_dof: usize,
        /// What is there.
        value: f64,
        /// What direction 1 says.
        wanted: f64,
    },
    /// A motion without strain meets a force.
    #[error(
        "is not that of a free body on this mesh: a {motion} meets {ratio:.1e} of the largest force of its terms, allowed is {FREE:.0e} \
         (supports, other nodes or another unit of length?)"
    )]
    NotFree {
        /// `translation` or `rotation`.
        motion: &'static str,
        /// Force, relative.
        ratio: f64,
    },
}

/// Reads and checks both matrices for a mesh.
///
/// # Errors
/// [`MatrixError`] with the line, or with what is wrong with the whole matrix.
pub fn read_matrices(mesh: &Mesh, stiffness: &str, mass: &str) -> Result<GivenMatrices, MatrixError> {
    let nodes = Nodes::of(mesh);
    let stiffness = Symmetric::read(&nodes, MatrixKind::Stiffness, stiffness)?;
    let mass = Symmetric::read(&nodes, MatrixKind::Mass, mass)?;
    // One pattern for both: sums K + s M go through it.
    let pairs = |matrix: &Symmetric| -> Vec<(u32, u32)> {
        let of_entry = |e: &Entry| {
            let (a, b) = (e.row / 3, e.column / 3);
            [(a, b), (b, a)]
        };
        matrix.entries.iter().flat_map(of_entry).collect()
    };
    let pattern = NodePattern::of(mesh).with(pairs(&stiffness).into_iter().chain(pairs(&mass)));
    let stiffness = block_matrix(&stiffness, pattern.clone());
    check_free(mesh, &stiffness)?;
    let mass = nodal_mass(&nodes, &mass, pattern)?;
    Ok(GivenMatrices { stiffness, mass })
}

/// Nodes of the mesh by label.
struct Nodes<'a> {
    labels: &'a [u64],
    /// Label and zero-based number, ascending by label.
    by_label: Vec<(u64, u32)>,
}

impl<'a> Nodes<'a> {
    fn of(mesh: &'a Mesh) -> Self {
        let mut by_label: Vec<(u64, u32)> = mesh.node_labels.iter().copied().zip(0_u32..).collect();
        by_label.sort_unstable();
        Self {
            labels: &mesh.node_labels,
            by_label,
        }
    }

    fn label(&self, unknown: u32) -> u64 {
        self.labels[unknown as usize / 3]
    }

    /// Unknown of a node's direction.
    fn unknown(&self, label: i64, dof: i64) -> Result<u32, MatrixProblem> {
        let place = u64::try_from(label)
            .ok()
            .and_then(|label| self.by_label.binary_search_by_key(&label, |n| n.0).ok())
            .ok_or(MatrixProblem::UnknownNode { label })?;
        match u32::try_from(dof) {
            Ok(dof @ 1..=3) => Ok(3 * self.by_label[place].1 + dof - 1),
            _ => Err(MatrixProblem::Dof { dof }),
        }
    }

    /// Unknown of a row counted through.
    fn row(&self, row: i64) -> Result<u32, MatrixProblem> {
        let most = 3 * self.by_label.len();
        let outside = MatrixProblem::Row { found: row, most };
        match usize::try_from(row) {
            Ok(row) if (1..=most).contains(&row) => {
                let dof = u32::try_from((row - 1) % 3).unwrap_or(0);
                Ok(3 * self.by_label[(row - 1) / 3].1 + dof)
            }
            _ => Err(outside),
        }
    }
}

/// An entry on or below the diagonal, by unknowns.
#[derive(Debug, Clone, Copy)]
struct Entry {
    row: u32,
    column: u32,
    value: f64,
}

/// A checked symmetric matrix: its lower triangle, ascending.
struct Symmetric {
    entries: Vec<Entry>,
}

impl Symmetric {
    fn read(nodes: &Nodes<'_>, kind: MatrixKind, text: &str) -> Result<Self, MatrixError> {
        let mut given: Vec<(Entry, bool)> = Vec::new();
        let mut width = None;
        for (index, line) in text.lines().enumerate() {
            let refuse = |problem| MatrixError::Line {
                kind,
                line: index + 1,
                problem,
            };
            let line = line.trim();
            if line.starts_with('*') && !line.starts_with("**") && line.to_uppercase().contains("UNSYMMETRIC")
            {
                return Err(refuse(MatrixProblem::Unsymmetric));
            }
            if line.is_empty() || line.starts_with('*') {
                continue;
            }
            let (row, column, value) = entry(nodes, line, &mut width).map_err(refuse)?;
            let is_upper = row < column;
            let (row, column) = (row.max(column), row.min(column));
            given.push((Entry { row, column, value }, is_upper));
        }
        Self::checked(nodes, given).map_err(|defect| MatrixError::Whole { kind, defect })
    }

    fn checked(nodes: &Nodes<'_>, mut given: Vec<(Entry, bool)>) -> Result<Self, MatrixDefect> {
        let largest = given
            .iter()
            .fold(0.0, |most: f64, (e, _)| most.max(e.value.abs()));
        given.sort_unstable_by_key(|(e, is_upper)| (e.row, e.column, *is_upper));
        // Which triangle a single one is does not matter, nor in which order of the nodes it is one.
        let is_square = given.windows(2).any(|pair| {
            let ((a, a_is_upper), (b, b_is_upper)) = (pair[0], pair[1]);
            (a.row, a.column) == (b.row, b.column) && a_is_upper != b_is_upper
        });
        let mut entries: Vec<Entry> = Vec::with_capacity(given.len());
        let mut diagonal = vec![0.0; 3 * nodes.labels.len()];
        let mut rest = given.as_slice();
        while let Some(((first, first_is_upper), tail)) = rest.split_first() {
            let mirrors = |(e, _): &(Entry, bool)| (e.row, e.column) == (first.row, first.column);
            let count = tail.iter().take_while(|e| mirrors(e)).count();
            let place = |e: &Entry| (nodes.label(e.row), 1 + e.row as usize % 3);
            let (row, row_dof) = place(first);
            let (column, column_dof) = (nodes.label(first.column), 1 + first.column as usize % 3);
            let second = match &tail[..count] {
                [] => None,
                [(second, second_is_upper)] if second_is_upper != first_is_upper => Some(second.value),
                _ => {
                    return Err(MatrixDefect::Twice {
                        row,
                        row_dof,
                        column,
                        column_dof,
                    });
                }
            };
            rest = &tail[count..];
            if is_square && first.row != first.column {
                let missing = second.unwrap_or(0.0);
                let (value, mirrored) = if *first_is_upper {
                    (missing, first.value)
                } else {
                    (first.value, missing)
                };
                // What is a rounding of the largest entry counts as nothing.
                let scale = value.abs().max(mirrored.abs()).max(1e-3 * largest);
                if (value - mirrored).abs() > SAME * scale {
                    return Err(MatrixDefect::Asymmetric {
                        row,
                        row_dof,
                        column,
                        column_dof,
                        value,
                        mirrored,
                    });
                }
            }
            if first.row == first.column {
                diagonal[first.row as usize] = first.value;
            }
            entries.push(*first);
        }
        match (0_u32..).zip(&diagonal).find(|(_, value)| **value <= 0.0) {
            None => Ok(Self { entries }),
            Some((unknown, value)) => Err(MatrixDefect::Diagonal {
                node: nodes.label(unknown),
                dof: 1 + unknown as usize % 3,
                value: *value,
            }),
        }
    }
}

/// Row, column and value of a line; `width` is the number of entries of the lines before.
fn entry(nodes: &Nodes<'_>, line: &str, width: &mut Option<usize>) -> Result<(u32, u32, f64), MatrixProblem> {
    let parts: Vec<&str> = line
        .split(|c: char| c == ',' || c.is_whitespace())
        .filter(|part| !part.is_empty())
        .collect();
    let found = parts.len();
    if *width.get_or_insert(found) != found {
        return Err(MatrixProblem::EntryCount { found });
    }
    let whole = |text: &str| {
        text.parse::<i64>().map_err(|_| MatrixProblem::NotANumber {
            text: text.to_owned(),
            wanted: "a whole number",
        })
    };
    let number = |text: &str| {
        // Fortran writes large exponents with a D.
        let value = text.replace(['d', 'D'], "e").parse::<f64>();
        value
            .ok()
            .filter(|value| value.is_finite())
            .ok_or_else(|| MatrixProblem::NotANumber {
                text: text.to_owned(),
                wanted: "a finite number",
            })
    };
    match parts[..] {
        [node, dof, other, other_dof, value] => Ok((
            nodes.unknown(whole(node)?, whole(dof)?)?,
            nodes.unknown(whole(other)?, whole(other_dof)?)?,
            number(value)?,
        )),
        [row, column, value] => Ok((
            nodes.row(whole(row)?)?,
            nodes.row(whole(column)?)?,
            number(value)?,
        )),
        _ => Err(MatrixProblem::EntryCount { found }),
    }
}

fn block_matrix(matrix: &Symmetric, pattern: NodePattern) -> BlockMatrix {
    let mut blocks = vec![Matrix3::zeros(); pattern.columns.len()];
    for e in &matrix.entries {
        let (r, c) = (e.row as usize % 3, e.column as usize % 3);
        blocks[pattern.position(e.row / 3, e.column / 3)][(r, c)] = e.value;
        blocks[pattern.position(e.column / 3, e.row / 3)][(c, r)] = e.value;
    }
    BlockMatrix { pattern, blocks }
}

fn nodal_mass(nodes: &Nodes<'_>, matrix: &Symmetric, pattern: NodePattern) -> Result<NodalMass, MatrixError> {
    let blocks = block_matrix(matrix, pattern);
    let largest = blocks.blocks.iter().fold(0.0, |most: f64, b| most.max(b.amax()));
    let mut values = Vec::with_capacity(blocks.blocks.len());
    for (row, label) in nodes.labels.iter().enumerate() {
        for i in blocks.pattern.row(row) {
            let block = &blocks.blocks[i];
            let mass_kg = block[(0, 0)];
            for (r, c) in (0..3).flat_map(|r| (0..3).map(move |c| (r, c))) {
                let wanted = if r == c { mass_kg } else { 0.0 };
                if (block[(r, c)] - wanted).abs() > SAME * largest {
                    return Err(MatrixError::Whole {
                        kind: MatrixKind::Mass,
                        defect: MatrixDefect::Directional {
                            row: *label,
                            column: nodes.labels[blocks.pattern.columns[i] as usize],
                            dof: r + 1,
                            other_dof: c + 1,
                            value: block[(r, c)],
                            wanted,
                        },
                    });
                }
            }
            values.push(mass_kg);
        }
    }
    Ok(NodalMass::Consistent(ConsistentMass {
        pattern: blocks.pattern,
        values,
    }))
}

/// Translations and rotations about the middle of the mesh must meet no force.
fn check_free(mesh: &Mesh, stiffness: &BlockMatrix) -> Result<(), MatrixError> {
    let nodes = mesh.nodes_m();
    let middle = nodes.iter().sum::<Vector3<f64>>() / nodes.len() as f64;
    let largest = stiffness
        .blocks
        .iter()
        .fold(0.0, |most: f64, block| most.max(block.amax()));
    let size_m = nodes
        .iter()
        .fold(0.0, |most: f64, x| most.max((x - middle).norm()));
    let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
    for (motion, scale) in [("translation", largest), ("rotation", largest * size_m)] {
        let mut moved = DMatrix::zeros(3 * nodes.len(), 3);
        for (k, axis) in axes.iter().enumerate() {
            for (i, x) in nodes.iter().enumerate() {
                let u = if motion == "rotation" {
                    axis.cross(&(x - middle))
                } else {
                    *axis
                };
                moved.fixed_view_mut::<3, 1>(3 * i, k).copy_from(&u);
            }
        }
        let ratio = stiffness.multiply(&moved).amax() / scale;
        if ratio > FREE {
            return Err(MatrixError::Whole {
                kind: MatrixKind::Stiffness,
                defect: MatrixDefect::NotFree { motion, ratio },
            });
        }
    }
    Ok(())
}
