//! Node and element sets: collected by label while reading, resolved at the end.

use super::{MeshProblem, entries, parse_label};
use std::collections::{BTreeMap, HashMap};

/// Kind of set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum SetKind {
    Nodes,
    Elements,
}

impl SetKind {
    /// Keyword and the parameter that carries the name.
    pub(super) fn words(self) -> (&'static str, &'static str) {
        match self {
            Self::Nodes => ("NSET", "NSET"),
            Self::Elements => ("ELSET", "ELSET"),
        }
    }

    fn noun(self) -> &'static str {
        match self {
            Self::Nodes => "node",
            Self::Elements => "element",
        }
    }
}

/// Most members that sets of a file take over from other sets: far above every real mesh, and low enough that no
/// small file becomes a large one by sets that hold each other many times.
const MOST_TAKEN_OVER: usize = 8_000_000;

/// The same for labels looked at in GENERATE ranges.
const MOST_LOOKED_AT: usize = 100_000_000;

/// A member: a label with the line that names it (0 for definition lines), or an inclusive range.
#[derive(Debug, Clone, Copy)]
enum Member {
    Label {
        line: usize,
        label: u64,
    },
    Range {
        line: usize,
        first: u64,
        last: u64,
        step: u64,
    },
}

/// Sets by kind and upper-case name.
#[derive(Debug, Default)]
pub(super) struct Sets {
    members: BTreeMap<(SetKind, String), Vec<Member>>,
    /// Members that came from other sets.
    taken_over: usize,
}

type Resolved = BTreeMap<String, Vec<u32>>;

impl Sets {
    /// Makes the set exist.
    pub(super) fn begin(&mut self, kind: SetKind, name: &str) {
        self.members.entry((kind, name.to_uppercase())).or_default();
    }

    /// Adds a label that is known to exist.
    pub(super) fn add_label(&mut self, kind: SetKind, name: &str, label: u64) {
        self.members
            .entry((kind, name.to_uppercase()))
            .or_default()
            .push(Member::Label { line: 0, label });
    }

    /// Reads a data line of the set.
    pub(super) fn data(
        &mut self,
        line: usize,
        kind: SetKind,
        name: &str,
        generate: bool,
        text: &str,
    ) -> Result<(), MeshProblem> {
        let mut added = Vec::new();
        let name = (kind, name.to_uppercase());
        if generate {
            added.push(parse_range(line, text)?);
        } else {
            for entry in entries(text) {
                if entry.starts_with(|c: char| c.is_ascii_digit()) {
                    let label = parse_label(entry)?;
                    added.push(Member::Label { line, label });
                } else {
                    let other_name = (kind, entry.to_uppercase());
                    let other = self
                        .members
                        .get(&other_name)
                        .ok_or_else(|| MeshProblem::UndefinedSet(entry.chars().take(40).collect()))?;
                    // A set holds itself already.
                    if other_name != name {
                        self.taken_over += other.len();
                        if self.taken_over > MOST_TAKEN_OVER {
                            return Err(MeshProblem::SetsTooLarge(MOST_TAKEN_OVER));
                        }
                        added.extend_from_slice(other);
                    }
                }
            }
        }
        self.members.entry(name).or_default().extend(added);
        Ok(())
    }

    /// Turns labels into ascending indices. Labels inside a range that do not exist are skipped, as
    /// Abaqus does; a label by itself must exist.
    pub(super) fn resolve(
        self,
        nodes: &HashMap<u64, u32>,
        elements: &HashMap<u64, u32>,
    ) -> Result<(Resolved, Resolved), (usize, MeshProblem)> {
        let (mut node_sets, mut element_sets) = (BTreeMap::new(), BTreeMap::new());
        let sorted = |index: &HashMap<u64, u32>| {
            let mut labels: Vec<(u64, u32)> = index.iter().map(|(&label, &index)| (label, index)).collect();
            labels.sort_unstable();
            labels
        };
        let (sorted_nodes, sorted_elements) = (sorted(nodes), sorted(elements));
        let mut looked_at = 0;
        for ((kind, name), members) in self.members {
            let (index, sorted, sets) = match kind {
                SetKind::Nodes => (nodes, &sorted_nodes, &mut node_sets),
                SetKind::Elements => (elements, &sorted_elements, &mut element_sets),
            };
            let mut found = Vec::new();
            for member in members {
                match member {
                    Member::Label { line, label } => {
                        let undefined = MeshProblem::Undefined {
                            kind: kind.noun(),
                            label,
                        };
                        found.push(*index.get(&label).ok_or((line, undefined))?);
                    }
                    // A range may be far longer than the mesh: only labels that exist are looked at.
                    Member::Range {
                        line,
                        first,
                        last,
                        step,
                    } => {
                        let from = sorted.partition_point(|(label, _)| *label < first);
                        let inside = sorted[from..].iter().take_while(|(label, _)| *label <= last);
                        for (label, index) in inside {
                            looked_at += 1;
                            if looked_at > MOST_LOOKED_AT {
                                return Err((line, MeshProblem::SetsTooLarge(MOST_LOOKED_AT)));
                            }
                            if (label - first) % step == 0 {
                                found.push(*index);
                            }
                        }
                    }
                }
            }
            found.sort_unstable();
            found.dedup();
            sets.insert(name, found);
        }
        Ok((node_sets, element_sets))
    }
}

fn parse_range(line: usize, text: &str) -> Result<Member, MeshProblem> {
    let numbers = entries(text).map(parse_label).collect::<Result<Vec<_>, _>>()?;
    let (first, last, step) = match numbers[..] {
        [first, last] => (first, last, 1),
        [first, last, step] => (first, last, step),
        _ => {
            return Err(MeshProblem::EntryCount {
                found: numbers.len(),
                wanted: "first, last and increment",
            });
        }
    };
    if last < first {
        return Err(MeshProblem::BadRange { first, last, step });
    }
    Ok(Member::Range {
        line,
        first,
        last,
        step,
    })
}
