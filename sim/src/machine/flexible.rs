//! A flexible body of a checked machine: mesh, interfaces, sensors, and how it is reduced.

use crate::fe::{GivenMatrices, InterfaceNodes, MassKind, Material, Mesh};
use crate::reduction::{Damping, FlexibleModel, ReducedBody, ReductionError, reduce};
use sha2::{Digest, Sha256};
use std::sync::Arc;

/// Raised whenever the same input gives other numbers: part of every content hash, so that no
/// stale reduction is ever read.
// 2: elementary functions of `libm` instead of the C library's.
pub const REDUCTION_VERSION: u32 = 2;

/// A flexible body on its mesh.
#[derive(Debug, Clone)]
pub struct FlexibleBody {
    /// Name.
    pub name: String,
    /// Position among the machine's bodies.
    pub body_index: usize,
    /// Checked mesh.
    pub mesh: Arc<Mesh>,
    /// SHA-256 of the mesh file.
    pub mesh_sha256: [u8; 32],
    /// Mass and stiffness that came with the mesh, with the SHA-256 of their files.
    pub matrices: Option<(Arc<GivenMatrices>, [u8; 32])>,
    /// Material.
    pub material: Material,
    /// Kind of mass matrix.
    pub mass_kind: MassKind,
    /// Normal modes kept.
    pub normal_modes: usize,
    /// Damping.
    pub damping: Damping,
    /// Interfaces in the file's order.
    pub interfaces: Vec<InterfaceNodes>,
    /// Boundary interfaces of runs without payload.
    pub boundary_without_payload: Vec<usize>,
    /// Boundary interfaces of runs with payload.
    pub boundary_with_payload: Vec<usize>,
    /// One node per sensor of this body, in the file's order.
    pub sensor_nodes: Vec<u32>,
}

impl FlexibleBody {
    /// The model to reduce.
    #[must_use]
    pub fn model(&self, with_payload: bool) -> FlexibleModel<'_> {
        FlexibleModel {
            name: &self.name,
            mesh: &self.mesh,
            matrices: self.matrices.as_ref().map(|(given, _)| given.as_ref()),
            material: self.material,
            mass_kind: self.mass_kind,
            normal_modes: self.normal_modes,
            damping: self.damping,
            interfaces: &self.interfaces,
            boundary: if with_payload {
                self.boundary_with_payload.clone()
            } else {
                self.boundary_without_payload.clone()
            },
            sensor_nodes: &self.sensor_nodes,
        }
    }

    /// Reduces the body.
    ///
    /// # Errors
    /// [`ReductionError`], such as a singular stiffness.
    pub fn reduce(&self, with_payload: bool) -> Result<ReducedBody, ReductionError> {
        reduce(&self.model(with_payload))
    }

    /// Hash of everything that the reduced body depends on.
    #[must_use]
    pub fn reduction_key(&self, with_payload: bool) -> [u8; 32] {
        let model = self.model(with_payload);
        let mut hash = Sha256::new();
        hash.update(b"hydroflex reduced body\0");
        hash.update(REDUCTION_VERSION.to_le_bytes());
        hash.update(self.mesh_sha256);
        if let Some((_, sha256)) = &self.matrices {
            hash.update(b"matrices\0");
            hash.update(sha256);
        }
        // Debug prints every bit of a float that matters (shortest text that reads back the same)
        hash.update(format!(
            "{:?}",
            (
                model.name,
                model.material,
                model.mass_kind,
                model.normal_modes,
                model.damping,
                model.interfaces,
                &model.boundary,
                model.sensor_nodes,
            )
        ));
        hash.finalize().into()
    }
}
