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

/// Corners of the four faces, seen from outside in positive order.
const FACES: [[usize; 3]; 4] = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]];

/// A face of an element.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct ElementFace {
    /// Corner nodes, ascending.
    pub(super) nodes: [u32; 3],
    /// Element.
    pub(super) element: usize,
    /// Which corners of the element, seen from outside in positive order.
    pub(super) corners: [usize; 3],
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
    /// Parts that share nodes but can turn against each other: the stiffness would be singular.
    #[error(
        "the mesh falls into {parts} parts that hang together by edges or single nodes only; one of {part_elements} elements holds element {element}"
    )]
    Hinged {
        /// Number of parts.
        parts: usize,
        /// Elements of the smallest part.
        part_elements: usize,
        /// An element of it, by label.
        element: u64,
    },
    /// More than two elements on one face.
    #[error("{count} elements share one face, among them element {element}")]
    CrowdedFace {
        /// How many.
        count: usize,
        /// One of them, by label.
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

    /// All faces of all elements in ascending order, so that equal ones are side by side.
    ///
    /// Put into one bucket per smallest node first: a bucket holds some twenty faces, and sorting those
    /// costs a fifth of sorting all.
    pub(super) fn sorted_faces(&self) -> Vec<ElementFace> {
        let of_element = |element: usize| {
            let all = self.elements.nodes(element);
            FACES.map(|corners| {
                let [a, b, c] = corners.map(|k| all[k]);
                let (low, high) = (a.min(b), a.max(b));
                let nodes = [low.min(c), high.min(low.max(c)), high.max(c)];
                ElementFace {
                    nodes,
                    element,
                    corners,
                }
            })
        };
        let count = self.elements.len();
        let mut next = vec![0_u32; self.node_count() + 1];
        for element in 0..count {
            for face in of_element(element) {
                next[face.nodes[0] as usize + 1] += 1;
            }
        }
        for i in 1..next.len() {
            next[i] += next[i - 1];
        }
        let empty = ElementFace {
            nodes: [0; 3],
            element: 0,
            corners: FACES[0],
        };
        let mut faces = vec![empty; 4 * count];
        for element in 0..count {
            for face in of_element(element) {
                let place = &mut next[face.nodes[0] as usize];
                faces[*place as usize] = face;
                *place += 1;
            }
        }
        // Now `next` holds the ends of the buckets.
        let mut start = 0;
        for end in next {
            let end = end as usize;
            if end > start {
                faces[start..end].sort_unstable();
                start = end;
            }
        }
        faces
    }

    /// Checks every element and node by itself: valid elements, no loose node, at most two elements
    /// on a face.
    ///
    /// # Errors
    /// The first defect found.
    pub fn check(&self) -> Result<(), MeshDefect> {
        match &self.elements {
            Elements::Tet4(elements) => self.check_determinants::<4, Tet4>(elements)?,
            Elements::Tet10(elements) => self.check_determinants::<10, Tet10>(elements)?,
        }
        let (offsets, _) = self.attached_elements();
        let loose = |node: &usize| offsets[*node] == offsets[*node + 1];
        if let Some(node) = (0..self.node_count()).find(loose) {
            return Err(MeshDefect::LooseNode {
                node: self.node_labels[node],
                count: (node..self.node_count()).filter(loose).count(),
            });
        }
        for same in self.sorted_faces().chunk_by(|a, b| a.nodes == b.nodes) {
            if same.len() > 2 {
                return Err(MeshDefect::CrowdedFace {
                    count: same.len(),
                    element: self.element_labels[same[0].element],
                });
            }
        }
        Ok(())
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

    /// Checks that the mesh is one rigid piece, together with sets of nodes that move rigidly.
    ///
    /// Elements that share a face are one part, and so are parts, or a part and a rigid set, that
    /// share three nodes off a line: what is left over after that can move without strain.
    ///
    /// # Errors
    /// [`MeshDefect::Disconnected`] or [`MeshDefect::Hinged`].
    pub fn check_connected(&self, rigid_sets: &[&[u32]]) -> Result<(), MeshDefect> {
        let mut parts = Parts::singles(self.elements.len() + rigid_sets.len());
        for same in self.sorted_faces().chunk_by(|a, b| a.nodes == b.nodes) {
            for pair in same.windows(2) {
                parts.join(pair[0].element, pair[1].element);
            }
        }
        if parts.sizes(self.elements.len()).len() == 1 {
            return Ok(());
        }
        while self.join_rigidly(rigid_sets, &mut parts) {}
        let sizes = parts.sizes(self.elements.len());
        let Some(&(part_elements, element)) = sizes.iter().min().filter(|_| sizes.len() > 1) else {
            return Ok(());
        };
        let element = self.element_labels[element];
        let shares_nodes = !self.shared_nodes(&[], &mut parts).is_empty();
        let parts = sizes.len();
        Err(if shares_nodes {
            MeshDefect::Hinged {
                parts,
                part_elements,
                element,
            }
        } else {
            MeshDefect::Disconnected {
                parts,
                part_elements,
                element,
            }
        })
    }

    /// Nodes shared by pairs of parts; rigid sets count after the elements.
    fn shared_nodes(&self, rigid_sets: &[&[u32]], parts: &mut Parts) -> BTreeMap<(usize, usize), Vec<u32>> {
        let mut touching: Vec<(u32, usize)> = Vec::new();
        for element in 0..self.elements.len() {
            let part = parts.of(element);
            touching.extend(self.elements.nodes(element).iter().map(|node| (*node, part)));
        }
        for (i, set) in rigid_sets.iter().enumerate() {
            let part = parts.of(self.elements.len() + i);
            touching.extend(set.iter().map(|node| (*node, part)));
        }
        touching.sort_unstable();
        touching.dedup();
        let mut shared: BTreeMap<_, Vec<u32>> = BTreeMap::new();
        for same in touching.chunk_by(|a, b| a.0 == b.0) {
            for (i, a) in same.iter().enumerate() {
                for b in &same[i + 1..] {
                    shared.entry((a.1, b.1)).or_default().push(a.0);
                }
            }
        }
        shared
    }

    /// Joins parts that share three nodes off a line; whether any were.
    fn join_rigidly(&self, rigid_sets: &[&[u32]], parts: &mut Parts) -> bool {
        let mut joined = false;
        for ((a, b), nodes) in self.shared_nodes(rigid_sets, parts) {
            if !self.on_a_line(&nodes) {
                joined |= parts.join(a, b);
            }
        }
        joined
    }

    fn on_a_line(&self, nodes: &[u32]) -> bool {
        let position = |node: &u32| self.nodes_m[*node as usize];
        let [first, rest @ ..] = nodes else {
            return true;
        };
        let first = position(first);
        let longest = rest
            .iter()
            .map(|node| position(node) - first)
            .max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()));
        let Some(longest) = longest else { return true };
        let off_line = |node: &u32| (position(node) - first).cross(&longest).norm();
        // an angle of 1e-6 rad is no lever for any material
        rest.iter()
            .all(|node| off_line(node) <= 1e-6 * longest.norm_squared())
    }
}

/// Disjoint sets of elements, and of rigid sets after them.
struct Parts {
    parent: Vec<usize>,
}

impl Parts {
    fn singles(count: usize) -> Self {
        Self {
            parent: (0..count).collect(),
        }
    }

    /// Smallest element of the part.
    fn of(&mut self, mut element: usize) -> usize {
        while self.parent[element] != element {
            self.parent[element] = self.parent[self.parent[element]];
            element = self.parent[element];
        }
        element
    }

    fn join(&mut self, a: usize, b: usize) -> bool {
        let (a, b) = (self.of(a), self.of(b));
        self.parent[a.max(b)] = a.min(b);
        a != b
    }

    /// (elements, smallest element) of every part with elements.
    fn sizes(&mut self, elements: usize) -> Vec<(usize, usize)> {
        let mut sizes = vec![0; elements];
        for element in 0..elements {
            sizes[self.of(element)] += 1;
        }
        let parts = sizes.into_iter().enumerate();
        parts
            .filter(|(_, size)| *size > 0)
            .map(|(part, size)| (size, part))
            .collect()
    }
}
