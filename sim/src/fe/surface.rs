//! The surface of a mesh as triangles.

use super::element::EDGES;
use super::mesh::{Elements, Mesh};
use nalgebra::Vector3;

/// Surface triangles with outward orientation. A quadratic facet counts as four triangles over its
/// corners and midpoints.
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    triangles: Vec<[u32; 3]>,
}

/// Corners of the four faces, seen from outside in positive order.
const FACES: [[usize; 3]; 4] = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]];

impl Surface {
    /// Facets that belong to exactly one element.
    #[must_use]
    pub fn of(mesh: &Mesh) -> Self {
        let elements = mesh.elements();
        // (sorted corners, element, face)
        let mut faces = Vec::with_capacity(4 * elements.len());
        for e in 0..elements.len() {
            let nodes = elements.nodes(e);
            for (f, corners) in FACES.iter().enumerate() {
                let mut key = corners.map(|c| nodes[c]);
                key.sort_unstable();
                faces.push((key, e, f));
            }
        }
        faces.sort_unstable();
        let mut triangles = Vec::new();
        let mut i = 0;
        while i < faces.len() {
            let same = faces[i..].iter().take_while(|f| f.0 == faces[i].0).count();
            if same == 1 {
                let (_, e, f) = faces[i];
                push_facet(elements, e, FACES[f], &mut triangles);
            }
            i += same;
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

fn push_facet(elements: &Elements, e: usize, face: [usize; 3], triangles: &mut Vec<[u32; 3]>) {
    let nodes = elements.nodes(e);
    let [a, b, c] = face;
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
