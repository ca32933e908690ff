//! Finite elements: a mesh in, sparse mass and stiffness out.
//!
//! `abaqus` reads a mesh, `matrices` what Abaqus assembled itself, `element` integrates one tetrahedron, `assembly` adds them up, `surface`
//! and `interface` find the nodes that act as points, `recovery` brings strain back to nodes.
#![doc = include_str!("../../theory/finite_elements.md")]

mod abaqus;
mod assembly;
mod element;
mod interface;
mod material;
mod mesh;
mod matrices;
mod quadrature;
mod recovery;
mod surface;

pub use abaqus::{MeshError, MeshProblem, read_abaqus};
pub use assembly::{BlockMatrix, MassKind, NodalMass, assemble_mass, assemble_stiffness};
pub use element::{Tet4, Tet10, Tetrahedron};
pub use interface::{InterfaceNodes, area_weights, nodes_on_cylinder, uniform_weights};
pub use material::Material;
pub use matrices::{GivenMatrices, MatrixDefect, MatrixError, MatrixKind, MatrixProblem, read_matrices};
pub use mesh::{Elements, Mesh, MeshDefect};
pub use recovery::{nodal_strain_map, stress_from_strain};
pub use surface::Surface;
