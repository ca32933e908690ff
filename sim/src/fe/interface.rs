//! Sets of nodes that act as one point.

use super::mesh::Mesh;
use super::surface::{Surface, triangle_area_m2};
use nalgebra::Vector3;

/// Nodes of an interface with marker weights that sum to one.
#[derive(Debug, Clone, PartialEq)]
pub struct InterfaceNodes {
    /// Name.
    pub name: String,
    /// Zero-based node numbers, ascending.
    pub nodes: Vec<u32>,
    /// Marker weights, one per node.
    pub weights: Vec<f64>,
}

impl InterfaceNodes {
    /// Unweighted mean of the nodes: the point about which a rigid interface moves, m.
    #[must_use]
    pub fn mean_m(&self, mesh: &Mesh) -> Vector3<f64> {
        let sum: Vector3<f64> = self.nodes.iter().map(|n| mesh.nodes_m()[*n as usize]).sum();
        sum / self.nodes.len() as f64
    }

    /// Weighted mean of the nodes: the marker point, m.
    #[must_use]
    pub fn weighted_mean_m(&self, mesh: &Mesh) -> Vector3<f64> {
        self.nodes
            .iter()
            .zip(&self.weights)
            .map(|(n, w)| mesh.nodes_m()[*n as usize] * *w)
            .sum()
    }

    /// `W = −Σ w skew(p)²` with p from the weighted mean, m²: singular for collinear nodes.
    #[must_use]
    pub fn second_moment_m2(&self, mesh: &Mesh) -> nalgebra::Matrix3<f64> {
        let centre = self.weighted_mean_m(mesh);
        let mut w = nalgebra::Matrix3::zeros();
        for (node, weight) in self.nodes.iter().zip(&self.weights) {
            let tilde = (mesh.nodes_m()[*node as usize] - centre).cross_matrix();
            w -= tilde * tilde * *weight;
        }
        w
    }
}

/// Nodes on the mantle of a cylinder, ascending: axial position within the segment ± tolerance,
/// distance to the axis within radius ± tolerance.
#[must_use]
pub fn nodes_on_cylinder(
    mesh: &Mesh,
    axis_start_m: Vector3<f64>,
    axis_end_m: Vector3<f64>,
    radius_m: f64,
    tolerance_m: f64,
) -> Vec<u32> {
    let length = (axis_end_m - axis_start_m).norm();
    let direction = (axis_end_m - axis_start_m) / length;
    let on_mantle = |x: &Vector3<f64>| {
        let from_start = x - axis_start_m;
        let along = from_start.dot(&direction);
        let distance = (from_start - direction * along).norm();
        along >= -tolerance_m && along <= length + tolerance_m && (distance - radius_m).abs() <= tolerance_m
    };
    (0_u32..)
        .zip(mesh.nodes_m())
        .filter_map(|(node, x)| on_mantle(x).then_some(node))
        .collect()
}

/// `1/n` each.
#[must_use]
pub fn uniform_weights(count: usize) -> Vec<f64> {
    vec![1.0 / count as f64; count]
}

/// Area weights: every surface triangle whose three nodes belong to the set gives each of them a
/// third of its area; normalised to one. `None` if the set holds no whole triangle.
///
/// `nodes` must be ascending.
#[must_use]
pub fn area_weights(mesh: &Mesh, surface: &Surface, nodes: &[u32]) -> Option<Vec<f64>> {
    let mut weights = vec![0.0; nodes.len()];
    let mut total = 0.0;
    for triangle in surface.triangles() {
        let [Ok(a), Ok(b), Ok(c)] = triangle.map(|node| nodes.binary_search(&node)) else {
            continue;
        };
        let area = triangle_area_m2(mesh.nodes_m(), *triangle);
        total += area;
        for i in [a, b, c] {
            weights[i] += area / 3.0;
        }
    }
    (total > 0.0).then(|| weights.iter().map(|w| w / total).collect())
}
