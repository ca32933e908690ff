//! Bodies and machines for tests.

use nalgebra::{DMatrix, DVector, Matrix3, Matrix3xX, Vector3, Vector4};

use hydroflex_openapi::machine::{
    Attachment, BodySpec, DampingSpec, FlexibleBodySpec, JointKind, JointSpec, MachineFile, MarkerRotation,
    MassMatrixKind, MaterialSpec, MeshSource,
};

use crate::body::rotation::{rate_map, skew};
use crate::reduction::{ReducedBody, ReducedInterface, ReducedNode, ReductionReport};
use crate::system::{State, System};

/// Repeatable numbers in (−1, 1).
pub(crate) struct Numbers(u64);

impl Numbers {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }

    pub(crate) fn next(&mut self) -> f64 {
        // A multiplicative congruential generator; the upper bits are good enough for test data.
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }

    pub(crate) fn vector(&mut self) -> Vector3<f64> {
        Vector3::new(self.next(), self.next(), self.next())
    }

    pub(crate) fn list(&mut self, n: usize) -> Vec<f64> {
        (0..n).map(|_| self.next()).collect()
    }

    pub(crate) fn unit4(&mut self) -> Vector4<f64> {
        Vector4::new(self.next(), self.next(), self.next(), self.next() + 2.0).normalize()
    }
}

/// A cloud of point masses with random mode shapes: everything a reduced body has, with the nodes
/// still at hand.
pub(crate) struct Cloud {
    pub(crate) masses_kg: Vec<f64>,
    pub(crate) points_m: Vec<Vector3<f64>>,
    /// 3 × n rows of every node.
    pub(crate) shapes: Vec<Matrix3xX<f64>>,
}

impl Cloud {
    pub(crate) fn new(nodes: usize, modes: usize, seed: u64) -> Self {
        let mut x = Numbers::new(seed);
        Self {
            masses_kg: (0..nodes).map(|_| 1.0 + 0.5 * x.next()).collect(),
            points_m: (0..nodes)
                .map(|_| x.vector() + Vector3::new(1.0, 0.0, 0.0))
                .collect(),
            shapes: (0..nodes)
                .map(|_| Matrix3xX::from_vec(x.list(3 * modes)))
                .collect(),
        }
    }

    /// The reduced body, straight from the definitions of theory note §3.1. The interfaces
    /// `root` (without modal motion) and `end` (node 0) carry joints.
    pub(crate) fn reduce(&self, stiffness: f64, damping_s: f64) -> ReducedBody {
        let n = self.shapes[0].ncols();
        let sum3 = |f: &dyn Fn(usize) -> Matrix3<f64>| (0..self.points_m.len()).map(f).sum::<Matrix3<f64>>();
        let mut mass = DMatrix::zeros(n, n);
        let (mut c_pt, mut c_xp) = (Matrix3xX::zeros(n), Matrix3xX::zeros(n));
        let mut first = Vector3::zeros();
        for ((m, x), psi) in self.masses_kg.iter().zip(&self.points_m).zip(&self.shapes) {
            mass += psi.transpose() * psi * *m;
            c_pt += psi * *m;
            c_xp += skew(x).transpose() * psi * *m;
            first += x * *m;
        }
        let column = |i: usize, k: usize| -> Vector3<f64> { self.shapes[i].column(k).into() };
        let total: f64 = self.masses_kg.iter().sum();
        let stiffness_modal = DMatrix::from_diagonal(&DVector::from_fn(n, |k, _| stiffness * (k + 1) as f64));
        ReducedBody {
            name: "cloud".to_owned(),
            mass_kg: total,
            centre_of_mass_m: first / total,
            inertia_origin_kg_m2: sum3(&|i| {
                skew(&self.points_m[i]).transpose() * skew(&self.points_m[i]) * self.masses_kg[i]
            }),
            damping_modal: &stiffness_modal * damping_s,
            mass_modal: mass,
            stiffness_modal,
            c_pt,
            c_xp,
            n_blocks: (0..n)
                .map(|k| {
                    sum3(&|i| skew(&self.points_m[i]).transpose() * skew(&column(i, k)) * self.masses_kg[i])
                })
                .collect(),
            b_blocks: (0..n * n)
                .map(|mk| {
                    sum3(&|i| {
                        skew(&column(i, mk / n)).transpose() * skew(&column(i, mk % n)) * self.masses_kg[i]
                    })
                })
                .collect(),
            c_vectors: (0..n * n)
                .map(|mk| {
                    (0..self.points_m.len())
                        .map(|i| skew(&column(i, mk / n)).transpose() * column(i, mk % n) * self.masses_kg[i])
                        .sum()
                })
                .collect(),
            interfaces: vec![
                ReducedInterface {
                    name: "root".to_owned(),
                    position_m: Vector3::zeros(),
                    translation: Matrix3xX::zeros(n),
                    rotation: Matrix3xX::zeros(n),
                    node_count: 3,
                },
                ReducedInterface {
                    name: "end".to_owned(),
                    position_m: self.points_m[0],
                    translation: self.shapes[0].clone(),
                    rotation: self.shapes[1].clone(),
                    node_count: 3,
                },
            ],
            sensor_nodes: vec![ReducedNode {
                node: 0,
                position_m: self.points_m[0],
                translation: self.shapes[0].clone(),
                strain: DMatrix::zeros(6, n),
                stress_pa: DMatrix::zeros(6, n),
            }],
            report: ReductionReport::default(),
        }
    }
}

/// A rigid arm on a pivot, held by one cylinder with every kind of force.
pub(crate) fn rig() -> MachineFile {
    toml::from_str(include_str!("testing_rig.toml")).unwrap()
}

/// A free flexible cloud, without gravity.
pub(crate) fn free_cloud(stiffness: f64) -> System {
    let mut file = cloud_file();
    file.bodies.retain(|b| b.name() == "cloud");
    file.joints.clear();
    file.cylinders.clear();
    file.gravity_m_per_s2 = [0.0; 3];
    System::new(&file, &[Cloud::new(9, 4, 5).reduce(stiffness, 0.0)], 0.0).unwrap()
}

/// Two flexible clouds and an arm with one joint of every kind, and a cylinder between two bodies.
pub(crate) fn linkage() -> System {
    let mut file = cloud_file();
    let mut second = Cloud::new(8, 3, 6).reduce(2e4, 0.0);
    second.name = "second".to_owned();
    let bodies = [Cloud::new(9, 4, 5).reduce(1e4, 0.0), second];
    file.conventions.marker_rotation = MarkerRotation::Exact;
    System::new(&file, &bodies, 50.0).unwrap()
}

fn cloud_file() -> MachineFile {
    let mut file = rig();
    let flexible = |name: &str| {
        BodySpec::Flexible(FlexibleBodySpec {
            name: name.to_owned(),
            mesh: MeshSource::Given(String::new()),
            matrices: None,
            material: MaterialSpec {
                name: "none".to_owned(),
                youngs_modulus_pa: 1.0,
                poisson_ratio: 0.0,
                density_kg_per_m3: 1.0,
            },
            mass_matrix: MassMatrixKind::Lumped,
            normal_modes: 0,
            damping: DampingSpec::Rayleigh {
                mass_factor_per_s: 0.0,
                stiffness_factor_s: 0.0,
            },
            interfaces: Vec::new(),
        })
    };
    file.bodies.push(flexible("cloud"));
    file.bodies.push(flexible("second"));
    let at = |body: &str, interface: &str| Attachment {
        body: body.to_owned(),
        interface: Some(interface.to_owned()),
        point_m: None,
    };
    let on_arm = |x: f64| Attachment {
        body: "arm".to_owned(),
        interface: None,
        point_m: Some([x, 0.1, 0.2]),
    };
    let joint = |name: &str, kind, from, to| JointSpec {
        name: name.to_owned(),
        kind,
        from,
        to,
    };
    file.joints = vec![
        joint("a", JointKind::Revolute, at("cloud", "end"), at("second", "end")),
        joint("b", JointKind::Fixed, at("cloud", "end"), on_arm(1.0)),
        joint("c", JointKind::PlanarPin, at("second", "end"), on_arm(2.0)),
        joint("d", JointKind::Spherical, at("second", "root"), on_arm(0.5)),
    ];
    file.cylinders[0].base = at("second", "end");
    file.cylinders[0].rod = at("cloud", "end");
    file
}

/// A system in a random state of motion, for identities that hold in any state.
pub(crate) fn random_state(system: &System, seed: u64) -> State {
    let mut x = Numbers::new(seed);
    let mut state = system.new_state();
    for value in state.q.iter_mut().chain(&mut state.v).chain(&mut state.a) {
        *value = 0.3 * x.next();
    }
    for entry in &system.bodies {
        let range = entry.first_q + 3..entry.first_q + 7;
        let theta = x.unit4();
        let rate = rate_map(&theta).transpose() * x.vector() * 0.25;
        state.q[range.clone()].copy_from_slice(theta.as_slice());
        state.v[range].copy_from_slice(rate.as_slice());
    }
    state
}

/// A crane in the plane: a rigid arm, a flexible boom on it with a second one welded to its end, and two links
/// that close a loop between arm and boom; two cylinders, payload at the end of all.
pub(crate) fn closed_crane() -> (MachineFile, Vec<ReducedBody>) {
    let planar = |name: &str, seed: u64, modes: usize| {
        let mut cloud = Cloud::new(9, modes, seed);
        for shape in &mut cloud.shapes {
            shape.row_mut(2).fill(0.0);
        }
        cloud.points_m[0] = Vector3::new(0.9, 0.3, 0.0);
        let mut body = cloud.reduce(3e6, 2e-3);
        body.name = name.to_owned();
        let rotation = &mut body.interfaces[1].rotation;
        rotation.row_mut(0).fill(0.0);
        rotation.row_mut(1).fill(0.0);
        body
    };
    let mut file = cloud_file();
    file.conventions.marker_rotation = MarkerRotation::Exact;
    let rigid = |name: &str, start_angle_deg: f64| {
        let mut body = rig().bodies.remove(0);
        if let BodySpec::Rigid(rigid) = &mut body {
            name.clone_into(&mut rigid.name);
            rigid.mass_kg = 9.0;
            rigid.centre_of_mass_m = [0.3, 0.01, 0.0];
            rigid.inertia_kg_m2 = [0.1, 0.3, 0.3, 0.0, 0.0, 0.0];
            rigid.start_angle_deg = start_angle_deg;
        }
        body
    };
    file.bodies.push(rigid("rocker", 100.0));
    file.bodies.push(rigid("coupler", 10.0));
    let point = |body: &str, x: f64, y: f64| Attachment {
        body: body.to_owned(),
        interface: None,
        point_m: Some([x, y, 0.0]),
    };
    let interface = |body: &str, name: &str| Attachment {
        body: body.to_owned(),
        interface: Some(name.to_owned()),
        point_m: None,
    };
    let joint = |name: &str, kind, from, to| JointSpec {
        name: name.to_owned(),
        kind,
        from,
        to,
    };
    let (revolute, fixed) = (JointKind::Revolute, JointKind::Fixed);
    file.joints = vec![
        joint(
            "pivot",
            revolute,
            point("ground", -0.09, 1.4261),
            point("arm", 0.0, 0.0),
        ),
        joint(
            "boom",
            revolute,
            point("arm", 2.5, 0.1),
            interface("cloud", "root"),
        ),
        joint(
            "rocker",
            revolute,
            point("arm", 2.2, 0.0),
            point("rocker", 0.0, 0.0),
        ),
        joint(
            "coupler",
            revolute,
            point("rocker", 0.7, 0.02),
            point("coupler", 0.0, 0.0),
        ),
        joint(
            "closing",
            JointKind::PlanarPin,
            point("coupler", 1.3, 0.0),
            interface("cloud", "end"),
        ),
        joint(
            "weld",
            fixed,
            interface("cloud", "end"),
            interface("second", "root"),
        ),
    ];
    let mut tilt = file.cylinders[0].clone();
    file.cylinders[0].base = point("ground", 0.17, 0.386);
    file.cylinders[0].rod = point("arm", 0.304, -0.083);
    tilt.name = "tilt".to_owned();
    tilt.base = point("arm", 1.0, 0.2);
    tilt.rod = point("rocker", 0.7, 0.02);
    tilt.closed_length_m = 1.0;
    file.cylinders.push(tilt);
    let mut angle = file.angles[0].clone();
    angle.name = "tilt".to_owned();
    angle.body = "cloud".to_owned();
    file.angles.push(angle);
    if let Some(payload) = &mut file.payload {
        payload.at = interface("second", "end");
    }
    (file, vec![planar("cloud", 5, 4), planar("second", 6, 3)])
}
