//! The constant part: a tree of bodies in one plane, its loops, and where their coordinates are.

use hydroflex_openapi::machine::{JointKind, MachineFile};
use nalgebra::Vector2;

use super::in_plane::in_plane;
use crate::body::floating_frame::FloatingFrame;
use crate::body::marker::Marker;
use crate::reduction::ReducedBody;
use crate::system::{DenseLu, System, SystemError};
use crate::trajectory::recorder::Recorder;

/// Why a machine has no planar tree; the general path then runs it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NotTree {
    /// The machine does not become a system of equations.
    #[error(transparent)]
    System(#[from] SystemError),
    /// Gravity has a component along the axes of the joints.
    #[error("gravity has a component along Z, the axis of the joints")]
    Gravity,
    /// A joint lets bodies leave the plane.
    #[error("joint `{joint}` is spherical: it lets bodies leave the plane")]
    Spherical {
        /// Joint.
        joint: String,
    },
    /// A weld closes a loop.
    #[error("joint `{joint}` is fixed and closes a loop")]
    FixedLoop {
        /// Joint.
        joint: String,
    },
    /// A body hangs on nothing.
    #[error("body `{body}` is not joined to the ground")]
    Loose {
        /// Body.
        body: String,
    },
    /// No angles to close the loops with.
    #[error(
        "{loops} loops need {needed} bodies that turn and whose angle is not given, and the machine has {found}"
    )]
    Undetermined {
        /// Loops.
        loops: usize,
        /// Angles needed.
        needed: usize,
        /// Angles found.
        found: usize,
    },
    /// The valve is cut off at given lengths: it chatters there, which needs fixed steps.
    #[error("cylinder `{cylinder}` has a stroke cut-off")]
    StrokeCutoff {
        /// Cylinder.
        cylinder: String,
    },
    /// A body that does not stay in the plane although its joints do.
    #[error(
        "body `{body}` is not symmetric about the plane: its motions in it and across it couple by {coupling:.1e}"
    )]
    Unsymmetric {
        /// Body.
        body: String,
        /// Coupling, 1 where it is full.
        coupling: f64,
    },
    /// No cylinder.
    #[error("the machine has no cylinder")]
    NoCylinder,
}

/// A point of a body or of the ground in the plane.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PlanarMarker {
    /// Body, or none: a point of the ground.
    pub(super) body: Option<usize>,
    /// Undeformed position, body frame (or global), m.
    pub(super) point_m: Vector2<f64>,
    /// Its coordinate along Z, m.
    pub(super) z_m: f64,
    /// In-plane displacement per mode.
    pub(super) x: Vec<f64>,
    /// The same along the body's y.
    pub(super) y: Vec<f64>,
    /// Rotation about Z per mode.
    pub(super) turn: Vec<f64>,
}

/// How a body sits on the one before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mount {
    /// It turns; the number of its angle among the coordinates.
    Turns(usize),
    /// It is welded.
    Welded,
}

/// A body in the plane: mass-normalised modes, as in [`FloatingFrame`].
#[derive(Debug, Clone)]
pub(super) struct PlanarBody {
    pub(super) mass_kg: f64,
    /// m χ.
    pub(super) first_moment_kg_m: Vector2<f64>,
    /// About the frame's origin.
    pub(super) inertia_kg_m2: f64,
    pub(super) w2: Vec<f64>,
    pub(super) damping: Vec<f64>,
    /// C_pt by components.
    pub(super) cx: Vec<f64>,
    pub(super) cy: Vec<f64>,
    /// h₀: coupling of rotation and modes.
    pub(super) h0: Vec<f64>,
    /// Σ m p·ψ: half the first-order change of inertia.
    pub(super) c: Vec<f64>,
    /// Rows m of B_mk.
    pub(super) b: Vec<f64>,
    /// Rows m of the Z components of c_mk, antisymmetric.
    pub(super) cc: Vec<f64>,
    /// First modal coordinate.
    pub(super) first: usize,
    /// Marker on the ground or on an earlier body, and own marker, that the joint connects.
    pub(super) on: usize,
    pub(super) own: usize,
    pub(super) mount: Mount,
}

impl PlanarBody {
    pub(super) fn modes(&self) -> usize {
        self.w2.len()
    }
}

/// Typical ranges of one cylinder against which local errors are measured.
#[derive(Debug, Clone, Copy)]
pub(super) struct CylinderScale {
    pub(super) pressure_pa: f64,
    pub(super) speed_m_per_s: f64,
    pub(super) travel_m: f64,
}

/// A machine of bodies that move in one plane: a tree of revolute joints and welds with loops closed by
/// pins, in the coordinates that are left free. Coordinates: independent angles (absolute), modes, then the angles that
/// the loops determine.
#[derive(Debug, Clone)]
pub struct TreeModel {
    pub(super) system: System,
    pub(super) recorder: Recorder,
    pub(super) bodies: Vec<PlanarBody>,
    /// Bodies in the order of the tree.
    pub(super) order: Vec<usize>,
    pub(super) markers: Vec<PlanarMarker>,
    /// Markers that loops hold together.
    pub(super) loops: Vec<[usize; 2]>,
    /// Names of the joints that close the loops.
    pub(super) loop_names: Vec<String>,
    /// Base and rod markers of the cylinders.
    pub(super) cylinders: Vec<[usize; 2]>,
    /// Marker that carries the payload.
    pub(super) payload: Option<usize>,
    pub(super) payload_kg: f64,
    pub(super) gravity_m_per_s2: Vector2<f64>,
    pub(super) deformed_gravity: bool,
    /// Independent coordinates.
    pub(super) free: usize,
    /// Independent angles among them; they come first.
    pub(super) free_angles: usize,
    /// All coordinates.
    pub(super) all: usize,
    pub(super) scales: Vec<CylinderScale>,
    /// Strain energy under the cylinders' full forces, J.
    pub(super) energy_j: f64,
}

impl TreeModel {
    /// Builds the tree of a machine around its reduced bodies (in the variant that belongs to the payload).
    ///
    /// # Errors
    /// [`NotTree`] says why the machine is outside what this path covers.
    pub fn new(file: &MachineFile, reduced: &[ReducedBody], with_payload: bool) -> Result<Self, NotTree> {
        if file.gravity_m_per_s2[2] != 0.0 {
            return Err(NotTree::Gravity);
        }
        if file.cylinders.is_empty() {
            return Err(NotTree::NoCylinder);
        }
        if let Some(c) = file.cylinders.iter().find(|c| c.stroke_cutoff.is_some()) {
            return Err(NotTree::StrokeCutoff {
                cylinder: c.name.clone(),
            });
        }
        let planar: Vec<ReducedBody> = reduced
            .iter()
            .map(|body| {
                in_plane(body).map_err(|coupling| NotTree::Unsymmetric {
                    body: body.name.clone(),
                    coupling,
                })
            })
            .collect::<Result<_, _>>()?;
        let system = System::new(file, &planar, if with_payload { 1.0 } else { 0.0 })?;
        let recorder = Recorder::new(file, &planar, &system);
        Self::from_system(system, recorder, file)
    }

    fn from_system(system: System, recorder: Recorder, file: &MachineFile) -> Result<Self, NotTree> {
        let markers: Vec<PlanarMarker> = system.markers.iter().map(planar_marker).collect();
        let count = system.bodies.len();
        let payload_marker = |m: usize| matches!(system.markers[m], Marker::Payload);
        let mut placed = vec![false; count];
        let mut mounts: Vec<Option<(usize, usize, JointKind)>> = vec![None; count];
        let mut used = vec![false; system.joints.len()];
        let mut order = Vec::new();
        let is_placed = |m: usize, placed: &[bool]| markers[m].body.is_none_or(|b| placed[b]);
        for _ in 0..count {
            for (k, joint) in system.joints.iter().enumerate() {
                if used[k] || payload_marker(joint.to) {
                    continue;
                }
                for (on, own) in [(joint.from, joint.to), (joint.to, joint.from)] {
                    let Some(body) = markers[own].body else { continue };
                    if used[k] || placed[body] || !is_placed(on, &placed) {
                        continue;
                    }
                    if joint.kind == JointKind::Spherical {
                        return Err(NotTree::Spherical {
                            joint: joint.name.clone(),
                        });
                    }
                    mounts[body] = Some((on, own, joint.kind));
                    (placed[body], used[k]) = (true, true);
                    order.push(body);
                }
            }
        }
        let (mut loops, mut loop_names, mut payload) = (Vec::new(), Vec::new(), None);
        for (joint, _) in system.joints.iter().zip(&used).filter(|(_, used)| !**used) {
            if payload_marker(joint.to) {
                payload = Some(joint.from);
                continue;
            }
            match joint.kind {
                JointKind::Revolute | JointKind::PlanarPin => {
                    loops.push([joint.from, joint.to]);
                    loop_names.push(joint.name.clone());
                }
                JointKind::Spherical => {
                    return Err(NotTree::Spherical {
                        joint: joint.name.clone(),
                    });
                }
                JointKind::Fixed => {
                    return Err(NotTree::FixedLoop {
                        joint: joint.name.clone(),
                    });
                }
            }
        }
        let turns = |b: usize| !matches!(mounts[b], Some((_, _, JointKind::Fixed)) | None);
        let given = |b: usize| file.angles.iter().any(|a| a.body == system.bodies[b].name);
        // Later bodies close the loops, so that a chain's free end follows its root.
        let mut dependent: Vec<usize> = order.iter().copied().filter(|&b| turns(b) && !given(b)).collect();
        let needed = 2 * loops.len();
        if dependent.len() < needed {
            return Err(NotTree::Undetermined {
                loops: loops.len(),
                needed,
                found: dependent.len(),
            });
        }
        dependent.drain(..dependent.len() - needed);
        let free_angles = order.iter().filter(|&&b| turns(b)).count() - needed;
        let modes: usize = system.bodies.iter().map(|b| b.frame.mode_count()).sum();
        let free = free_angles + modes;
        let (mut next_angle, mut next_mode) = (0, free_angles);
        let mut bodies = Vec::with_capacity(count);
        for (b, entry) in system.bodies.iter().enumerate() {
            let Some((on, own, kind)) = mounts[b] else {
                return Err(NotTree::Loose {
                    body: entry.name.clone(),
                });
            };
            let mount = if kind == JointKind::Fixed {
                Mount::Welded
            } else if let Some(k) = dependent.iter().position(|&d| d == b) {
                Mount::Turns(free + k)
            } else {
                next_angle += 1;
                Mount::Turns(next_angle - 1)
            };
            bodies.push(planar_body(&entry.frame, next_mode, on, own, mount));
            next_mode += entry.frame.mode_count();
        }
        let mut model = Self {
            gravity_m_per_s2: system.gravity_m_per_s2.xy(),
            deformed_gravity: system.deformed_gravity(),
            cylinders: system.cylinder_markers.clone(),
            payload_kg: system.payload.as_ref().map_or(0.0, |p| p.mass_kg),
            recorder,
            bodies,
            order,
            markers,
            loops,
            loop_names,
            payload,
            free,
            free_angles,
            all: free + needed,
            scales: Vec::new(),
            energy_j: 0.0,
            system,
        };
        model.set_scales();
        Ok(model)
    }

    /// The same machine with another payload, kg; only for machines that carry one.
    #[must_use]
    pub fn with_payload_mass(&self, mass_kg: f64) -> Self {
        let mut model = self.clone();
        model.system = model.system.with_payload_mass(mass_kg);
        model.payload_kg = if model.payload.is_some() { mass_kg } else { 0.0 };
        model
    }

    /// Coordinates that are left free.
    #[must_use]
    pub fn coordinate_count(&self) -> usize {
        self.free
    }

    /// The system of the same in-plane bodies for the general path; for comparisons.
    #[must_use]
    pub fn system(&self) -> &System {
        &self.system
    }

    /// What a run typically covers: pressures between tank and supply, the speed of a cylinder with
    /// its valve open, a tenth of a second of it, the strain energy under a cylinder's full force.
    fn set_scales(&mut self) {
        let mut energy = f64::MIN_POSITIVE;
        let mut scales = Vec::new();
        for (cylinder, ends) in self.system.cylinders().iter().zip(&self.cylinders) {
            let valve = cylinder.valve();
            let range_pa = (valve.supply_pressure_pa - valve.tank_pressure_pa).max(1.0);
            let area = cylinder.piston.area_m2;
            let speed = (valve.flow_coefficient_m3_per_s_per_sqrt_pa * range_pa.sqrt() / area).max(1e-6);
            scales.push(CylinderScale {
                pressure_pa: range_pa,
                speed_m_per_s: speed,
                travel_m: 0.1 * speed,
            });
            for marker in ends.map(|m| &self.markers[m]) {
                let Some(body) = marker.body else { continue };
                let flexibility: f64 = marker
                    .x
                    .iter()
                    .zip(&marker.y)
                    .zip(&self.bodies[body].w2)
                    .map(|((x, y), w2)| (x * x + y * y) / w2)
                    .sum();
                energy = energy.max((range_pa * area).powi(2) * flexibility);
            }
        }
        // A machine of rigid bodies has no strain energy to watch.
        self.energy_j = if energy > 1e-12 { energy } else { 1.0 };
        self.scales = scales;
    }

    pub(super) fn new_loop_solver(&self) -> DenseLu {
        DenseLu::new(2 * self.loops.len())
    }
}

fn planar_marker(marker: &Marker) -> PlanarMarker {
    match marker {
        Marker::Ground(point) => PlanarMarker {
            body: None,
            point_m: point.xy(),
            z_m: point.z,
            x: Vec::new(),
            y: Vec::new(),
            turn: Vec::new(),
        },
        Marker::Body(on) => PlanarMarker {
            body: Some(on.body),
            point_m: on.position_m.xy(),
            z_m: on.position_m.z,
            x: on.translation.iter().map(|t| t.x).collect(),
            y: on.translation.iter().map(|t| t.y).collect(),
            turn: on.rotation.iter().map(|t| t.z).collect(),
        },
        // It is where its joint's other marker is.
        Marker::Payload => PlanarMarker {
            body: None,
            point_m: Vector2::zeros(),
            z_m: 0.0,
            x: Vec::new(),
            y: Vec::new(),
            turn: Vec::new(),
        },
    }
}

fn planar_body(frame: &FloatingFrame, first: usize, on: usize, own: usize, mount: Mount) -> PlanarBody {
    let n = frame.mode_count();
    PlanarBody {
        mass_kg: frame.mass_kg(),
        first_moment_kg_m: frame.first_moment_kg_m.xy(),
        inertia_kg_m2: frame.inertia_kg_m2[(2, 2)],
        w2: frame.stiffness.clone(),
        damping: frame.damping.clone(),
        cx: frame.c_pt.iter().map(|c| c.x).collect(),
        cy: frame.c_pt.iter().map(|c| c.y).collect(),
        h0: frame.c_xp.iter().map(|c| -c.z).collect(),
        c: (0..n).map(|k| frame.n_blocks[9 * k + 8]).collect(),
        b: (0..n * n).map(|mk| frame.b_rows[9 * mk + 8]).collect(),
        cc: (0..n * n).map(|mk| frame.c_rows[3 * mk + 2]).collect(),
        first,
        on,
        own,
        mount,
    }
}

/// Rotates by a quarter turn: `k × v`.
pub(super) fn quarter(v: &Vector2<f64>) -> Vector2<f64> {
    Vector2::new(-v.y, v.x)
}

/// Z component of `a × b`.
pub(super) fn cross(a: &Vector2<f64>, b: &Vector2<f64>) -> f64 {
    a.x * b.y - a.y * b.x
}
