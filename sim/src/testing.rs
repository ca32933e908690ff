//! Bodies and machines for tests.

use nalgebra::{DMatrix, DVector, Matrix3, Matrix3xX, Vector3, Vector4};

use crate::body::rotation::skew;
use crate::reduction::{ReducedBody, ReducedInterface, ReducedNode, ReductionReport};

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
