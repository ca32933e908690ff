//! From the machine file's bodies to finite-element models: the one crossing from contract types.

use super::error::{MachineError, Problem};
use super::flexible::FlexibleBody;
use super::text::MachineText;
use crate::fe::{
    InterfaceNodes, MassKind, Material, Mesh, MeshError, Surface, area_weights, nodes_on_cylinder,
    uniform_weights,
};
use crate::reduction::Damping;
use hydroflex_openapi::machine::{
    BodySpec, Boundary, DampingSpec, FlexibleBodySpec, InterfaceSpec, MachineFile, MassMatrixKind,
    MaterialSpec, Selection, SensorSpec, WeightKind,
};
use nalgebra::Vector3;
use std::sync::Arc;

impl From<&MaterialSpec> for Material {
    fn from(spec: &MaterialSpec) -> Self {
        Self {
            youngs_modulus_pa: spec.youngs_modulus_pa,
            poisson_ratio: spec.poisson_ratio,
            density_kg_per_m3: spec.density_kg_per_m3,
        }
    }
}

impl From<MassMatrixKind> for MassKind {
    fn from(kind: MassMatrixKind) -> Self {
        match kind {
            MassMatrixKind::Consistent => Self::Consistent,
            MassMatrixKind::Lumped => Self::Lumped,
        }
    }
}

impl From<DampingSpec> for Damping {
    fn from(spec: DampingSpec) -> Self {
        match spec {
            DampingSpec::Rayleigh {
                mass_factor_per_s,
                stiffness_factor_s,
            } => Self::Rayleigh {
                mass_factor_per_s,
                stiffness_factor_s,
            },
            DampingSpec::Modal { damping_ratio } => Self::Modal { ratio: damping_ratio },
        }
    }
}

/// Builds the model of a flexible body on its mesh; `index` is its place in the file.
pub(super) fn flexible_body(
    text: &MachineText<'_>,
    file: &MachineFile,
    index: usize,
    mesh: Mesh,
    mesh_sha256: [u8; 32],
) -> Result<FlexibleBody, MachineError> {
    let BodySpec::Flexible(spec) = &file.bodies[index] else {
        unreachable!("only flexible bodies have meshes")
    };
    let surface = Surface::of(&mesh);
    let mut interfaces: Vec<InterfaceNodes> = Vec::new();
    for (i, interface) in spec.interfaces.iter().enumerate() {
        let key = format!("body[{index}].interface[{i}]");
        interfaces.push(
            interface_nodes(&mesh, &surface, interface)
                .map_err(|problem| text.refuse(format!("{key}.select"), problem))?,
        );
    }
    check_overlap(text, spec, index, &interfaces)?;
    check_connected(text, spec, index, &mesh, &interfaces)?;

    let mut sensor_nodes = Vec::new();
    for (i, sensor) in file.sensors.iter().enumerate() {
        if sensor.body == spec.name {
            let node = nearest_surface_node(&mesh, &surface, sensor)
                .map_err(|problem| text.refuse(format!("sensor[{i}].near_m"), problem))?;
            sensor_nodes.push(node);
        }
    }
    let boundaries = |with_payload: bool| -> Vec<usize> {
        let belongs = |boundary| match boundary {
            Boundary::Always => true,
            Boundary::WithPayload => with_payload,
            Boundary::Never => false,
        };
        (0..spec.interfaces.len())
            .filter(|i| belongs(spec.interfaces[*i].boundary))
            .collect()
    };
    Ok(FlexibleBody {
        name: spec.name.clone(),
        body_index: index,
        matrices: None,
        material: Material::from(&spec.material),
        mass_kind: spec.mass_matrix.into(),
        normal_modes: spec.normal_modes,
        damping: spec.damping.into(),
        boundary_without_payload: boundaries(false),
        boundary_with_payload: boundaries(true),
        interfaces,
        sensor_nodes,
        mesh: Arc::new(mesh),
        mesh_sha256,
    })
}

fn interface_nodes(mesh: &Mesh, surface: &Surface, spec: &InterfaceSpec) -> Result<InterfaceNodes, Problem> {
    let interface = || spec.name.clone();
    let nodes = match &spec.select {
        Selection::Cylinder {
            axis_start_m,
            axis_end_m,
            radius_m,
            tolerance_m,
        } => nodes_on_cylinder(
            mesh,
            Vector3::from(*axis_start_m),
            Vector3::from(*axis_end_m),
            *radius_m,
            *tolerance_m,
        ),
        Selection::NodeSet(name) => mesh
            .node_set(name)
            .ok_or_else(|| Problem::UnknownName {
                kind: "node set",
                name: name.clone(),
                known: mesh.node_set_names().map(str::to_owned).collect(),
            })?
            .to_vec(),
    };
    if nodes.is_empty() {
        return Err(Problem::NoNodes {
            interface: interface(),
            nearest: what_lies_near(mesh, &spec.select),
        });
    }
    let weights = match spec.weights {
        WeightKind::Uniform => uniform_weights(nodes.len()),
        WeightKind::Area => area_weights(mesh, surface, &nodes).ok_or_else(|| Problem::NoTriangles {
            interface: interface(),
        })?,
    };
    let nodes = InterfaceNodes {
        name: interface(),
        nodes,
        weights,
    };
    // W of n points on a line has a zero eigenvalue; 1e-9 of its trace is below any real bore
    let w = nodes.second_moment_m2(mesh);
    if w.symmetric_eigenvalues().min() <= 1e-9 * w.trace() {
        return Err(Problem::Collinear {
            interface: interface(),
            count: nodes.nodes.len(),
        });
    }
    Ok(nodes)
}

/// Helps to correct a cylinder that selects nothing.
fn what_lies_near(mesh: &Mesh, select: &Selection) -> Option<String> {
    let Selection::Cylinder {
        axis_start_m,
        axis_end_m,
        radius_m,
        tolerance_m,
    } = select
    else {
        return None;
    };
    let (a, b) = (Vector3::from(*axis_start_m), Vector3::from(*axis_end_m));
    let length = (b - a).norm();
    let direction = (b - a) / length;
    let miss = |x: &Vector3<f64>| {
        let along = (x - a).dot(&direction);
        let radial = ((x - a - direction * along).norm() - radius_m).abs();
        let axial = (-along).max(along - length).max(0.0);
        radial.max(axial)
    };
    let nearest = mesh.nodes_m().iter().min_by(|x, y| miss(x).total_cmp(&miss(y)))?;
    Some(format!(
        "the nearest, at ({:.4}, {:.4}, {:.4}) m, misses the mantle by {:.2e} m where tolerance_m is {tolerance_m:e}",
        nearest.x,
        nearest.y,
        nearest.z,
        miss(nearest)
    ))
}

fn check_overlap(
    text: &MachineText<'_>,
    spec: &FlexibleBodySpec,
    index: usize,
    interfaces: &[InterfaceNodes],
) -> Result<(), MachineError> {
    for (i, second) in interfaces.iter().enumerate() {
        for (first, first_spec) in interfaces[..i].iter().zip(&spec.interfaces) {
            // markers may lie anywhere; boundaries move rigidly and must not share nodes
            let never = |spec: &InterfaceSpec| spec.boundary == Boundary::Never;
            if never(first_spec) || never(&spec.interfaces[i]) {
                continue;
            }
            let shares = |node: &&u32| first.nodes.binary_search(node).is_ok();
            let count = second.nodes.iter().filter(shares).count();
            if count > 0 {
                let problem = Problem::Overlap {
                    first: first.name.clone(),
                    second: second.name.clone(),
                    count,
                };
                return Err(text.refuse(format!("body[{index}].interface[{i}].select"), problem));
            }
        }
    }
    Ok(())
}

/// Boundary interfaces move rigidly and may hold parts of a mesh together, as the published tilt
/// boom's pins do its side plates.
fn check_connected(
    text: &MachineText<'_>,
    spec: &FlexibleBodySpec,
    index: usize,
    mesh: &Mesh,
    interfaces: &[InterfaceNodes],
) -> Result<(), MachineError> {
    let rigid: Vec<&[u32]> = interfaces
        .iter()
        .zip(&spec.interfaces)
        .filter(|(_, spec)| spec.boundary == Boundary::Always)
        .map(|(interface, _)| interface.nodes.as_slice())
        .collect();
    mesh.check_connected(&rigid).map_err(|defect| {
        let problem = Problem::Mesh {
            mesh: spec.name.clone(),
            error: MeshError::Defect(defect),
        };
        text.refuse(format!("body[{index}].mesh"), problem)
    })
}

fn nearest_surface_node(mesh: &Mesh, surface: &Surface, sensor: &SensorSpec) -> Result<u32, Problem> {
    let near = Vector3::from(sensor.near_m);
    let distance = |node: u32| (mesh.nodes_m()[node as usize] - near).norm();
    let node = surface
        .nodes()
        .into_iter()
        .min_by(|a, b| distance(*a).total_cmp(&distance(*b)))
        .unwrap_or_default();
    let distance_m = distance(node);
    if distance_m <= sensor.within_m {
        Ok(node)
    } else {
        Err(Problem::SensorTooFar {
            distance_m,
            within_m: sensor.within_m,
            node_m: mesh.nodes_m()[node as usize].into(),
        })
    }
}
