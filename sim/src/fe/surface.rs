//! The surface of a mesh as triangles.

use super::element::EDGES;
use super::mesh::{ElementFace, Elements, Mesh};
use nalgebra::Vector3;

/// Surface triangles with outward orientation. A quadratic facet counts as four triangles over its
/// corners and midpoints.
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    triangles: Vec<[u32; 3]>,
}

impl Surface {
    /// Facets that belong to exactly one element.
    #[must_use]
    pub fn of(mesh: &Mesh) -> Self {
        let faces = mesh.sorted_faces();
        let mut triangles = Vec::new();
        for same in faces.chunk_by(|a, b| a.nodes == b.nodes) {
            if let [face] = same {
                push_facet(mesh.elements(), face, &mut triangles);
            }
        }
        Self { triangles }
    }

    /// The triangles, zero-based node numbers.
    #[must_use]
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// Nodes on the surface, ascending.
    #[must_use]
    pub fn nodes(&self) -> Vec<u32> {
        let mut nodes: Vec<u32> = self.triangles.iter().flatten().copied().collect();
        nodes.sort_unstable();
        nodes.dedup();
        nodes
    }

    /// Area, m².
    #[must_use]
    pub fn area_m2(&self, mesh: &Mesh) -> f64 {
        self.triangles
            .iter()
            .map(|t| triangle_area_m2(mesh.nodes_m(), *t))
            .sum()
    }
}

fn push_facet(elements: &Elements, face: &ElementFace, triangles: &mut Vec<[u32; 3]>) {
    let nodes = elements.nodes(face.element);
    let [a, b, c] = face.corners;
    match elements {
        Elements::Tet4(_) => triangles.push([nodes[a], nodes[b], nodes[c]]),
        Elements::Tet10(_) => {
            let middle = |i: usize, j: usize| {
                let edge = EDGES
                    .iter()
                    .position(|e| *e == [i, j] || *e == [j, i])
                    .unwrap_or_else(|| unreachable!("every pair of corners is an edge"));
                nodes[4 + edge]
            };
            let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
            triangles.extend([
                [nodes[a], ab, ca],
                [ab, nodes[b], bc],
                [ca, bc, nodes[c]],
                [ab, bc, ca],
            ]);
        }
    }
}

/// Area of a triangle, m².
pub(super) fn triangle_area_m2(nodes_m: &[Vector3<f64>], triangle: [u32; 3]) -> f64 {
    let [a, b, c] = triangle.map(|node| nodes_m[node as usize]);
    (b - a).cross(&(c - a)).norm() / 2.0
}
