//! A checked mesh of one kind of tetrahedron.

use super::element::{Tet4, Tet10, Tetrahedron};
use nalgebra::Vector3;
use std::collections::BTreeMap;

/// Elements of one kind: zero-based node numbers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Elements {
    /// Linear tetrahedra, C3D4.
    Tet4(Vec<[u32; 4]>),
    /// Quadratic tetrahedra, C3D10.
    Tet10(Vec<[u32; 10]>),
}

impl Elements {
    /// Number of elements.
    #[must_use]
    pub fn len(&self) -> usize {
        match self {
            Self::Tet4(elements) => elements.len(),
            Self::Tet10(elements) => elements.len(),
        }
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Nodes of an element.
    #[must_use]
    pub fn nodes(&self, element: usize) -> &[u32] {
        match self {
            Self::Tet4(elements) => &elements[element],
            Self::Tet10(elements) => &elements[element],
        }
    }

    /// Name in an Abaqus file.
    #[must_use]
    pub fn kind_name(&self) -> &'static str {
        match self {
            Self::Tet4(_) => Tet4::NAME,
            Self::Tet10(_) => Tet10::NAME,
        }
    }
}

/// Nodes, elements and named sets. Numbers are zero-based positions in the file's order; the
/// file's own labels are kept for messages.
#[derive(Debug, Clone, PartialEq)]
pub struct Mesh {
    pub(super) nodes_m: Vec<Vector3<f64>>,
    pub(super) elements: Elements,
    pub(super) node_labels: Vec<u64>,
    pub(super) element_labels: Vec<u64>,
    /// Upper-case names, as Abaqus compares them.
    pub(super) node_sets: BTreeMap<String, Vec<u32>>,
    pub(super) element_sets: BTreeMap<String, Vec<u32>>,
}

/// What is wrong with a mesh as a whole. Labels are those of the file.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MeshDefect {
    /// Negative or zero volume somewhere in an element.
    #[error(
        "element {element} is inverted or flat (smallest Jacobian determinant {determinant_m3:e} m³): \
         check its node order"
    )]
    Inverted {
        /// Element label.
        element: u64,
        /// Smallest det J, m³.
        determinant_m3: f64,
    },
    /// A node that no element uses.
    #[error("node {node} belongs to no element ({count} such nodes)")]
    LooseNode {
        /// First such node's label.
        node: u64,
        /// How many there are.
        count: usize,
    },
    /// Parts that share no node.
    #[error(
        "the mesh falls into {parts} parts that share no node; one of {part_elements} elements holds element {element}"
    )]
    Disconnected {
        /// Number of parts.
        parts: usize,
        /// Elements of the smallest part.
        part_elements: usize,
        /// An element of it, by label.
        element: u64,
    },
}

impl Mesh {
    /// Positions of the nodes, m.
    #[must_use]
    pub fn nodes_m(&self) -> &[Vector3<f64>] {
        &self.nodes_m
    }

    /// The elements.
    #[must_use]
    pub fn elements(&self) -> &Elements {
        &self.elements
    }

    /// Number of nodes.
    #[must_use]
    pub fn node_count(&self) -> usize {
        self.nodes_m.len()
    }

    /// A node set by name, compared without case as Abaqus does; ascending.
    #[must_use]
    pub fn node_set(&self, name: &str) -> Option<&[u32]> {
        self.node_sets.get(&name.to_uppercase()).map(Vec::as_slice)
    }

    /// An element set by name, ascending.
    #[must_use]
    pub fn element_set(&self, name: &str) -> Option<&[u32]> {
        self.element_sets.get(&name.to_uppercase()).map(Vec::as_slice)
    }

    /// Names of the node sets, in upper case.
    pub fn node_set_names(&self) -> impl Iterator<Item = &str> {
        self.node_sets.keys().map(String::as_str)
    }

    /// Volume, m³.
    #[must_use]
    pub fn volume_m3(&self) -> f64 {
        match &self.elements {
            Elements::Tet4(elements) => self.sum_volumes::<4, Tet4>(elements),
            Elements::Tet10(elements) => self.sum_volumes::<10, Tet10>(elements),
        }
    }

    fn sum_volumes<const N: usize, E: Tetrahedron<N>>(&self, elements: &[[u32; N]]) -> f64 {
        elements.iter().map(|e| E::volume(&self.corners(e))).sum()
    }

    /// Positions of an element's nodes, m.
    pub(super) fn corners<const N: usize>(&self, element: &[u32; N]) -> [Vector3<f64>; N] {
        element.map(|node| self.nodes_m[node as usize])
    }

    /// Elements attached to each node: `offsets[node]..offsets[node + 1]` of the second list.
    pub(super) fn attached_elements(&self) -> (Vec<u32>, Vec<u32>) {
        let n = self.node_count();
        let mut offsets = vec![0_u32; n + 1];
        for e in 0..self.elements.len() {
            for &node in self.elements.nodes(e) {
                offsets[node as usize + 1] += 1;
            }
        }
        for i in 0..n {
            offsets[i + 1] += offsets[i];
        }
        let mut next = offsets.clone();
        let mut attached = vec![0_u32; offsets[n] as usize];
        for (e, label) in (0_u32..).take(self.elements.len()).enumerate() {
            for &node in self.elements.nodes(e) {
                attached[next[node as usize] as usize] = label;
                next[node as usize] += 1;
            }
        }
        (offsets, attached)
    }

    /// Checks what a stiffness matrix needs: valid elements, no loose node, one piece.
    ///
    /// # Errors
    /// The first defect found.
    pub fn check(&self) -> Result<(), MeshDefect> {
        match &self.elements {
            Elements::Tet4(elements) => self.check_determinants::<4, Tet4>(elements)?,
            Elements::Tet10(elements) => self.check_determinants::<10, Tet10>(elements)?,
        }
        let (offsets, attached) = self.attached_elements();
        let loose = |node: &usize| offsets[*node] == offsets[*node + 1];
        if let Some(node) = (0..self.node_count()).find(loose) {
            return Err(MeshDefect::LooseNode {
                node: self.node_labels[node],
                count: (node..self.node_count()).filter(loose).count(),
            });
        }
        self.check_connected(&offsets, &attached)
    }

    fn check_determinants<const N: usize, E: Tetrahedron<N>>(
        &self,
        elements: &[[u32; N]],
    ) -> Result<(), MeshDefect> {
        for (element, label) in elements.iter().zip(&self.element_labels) {
            let determinant_m3 = E::smallest_determinant(&self.corners(element));
            // a NaN is refused too
            if !(determinant_m3 > 0.0 && determinant_m3.is_finite()) {
                return Err(MeshDefect::Inverted {
                    element: *label,
                    determinant_m3,
                });
            }
        }
        Ok(())
    }

    fn check_connected(&self, offsets: &[u32], attached: &[u32]) -> Result<(), MeshDefect> {
        let count = self.elements.len();
        let mut part_of = vec![usize::MAX; count];
        let mut sizes: Vec<(usize, usize)> = Vec::new(); // (elements, first element)
        let mut stack = Vec::new();
        for seed in 0..count {
            if part_of[seed] != usize::MAX {
                continue;
            }
            let part = sizes.len();
            sizes.push((0, seed));
            part_of[seed] = part;
            stack.push(seed);
            while let Some(element) = stack.pop() {
                sizes[part].0 += 1;
                for &node in self.elements.nodes(element) {
                    let range = offsets[node as usize] as usize..offsets[node as usize + 1] as usize;
                    for &next in &attached[range] {
                        if part_of[next as usize] == usize::MAX {
                            part_of[next as usize] = part;
                            stack.push(next as usize);
                        }
                    }
                }
            }
        }
        match sizes.iter().min() {
            Some(&(part_elements, element)) if sizes.len() > 1 => Err(MeshDefect::Disconnected {
                parts: sizes.len(),
                part_elements,
                element: self.element_labels[element],
            }),
            _ => Ok(()),
        }
    }
}
