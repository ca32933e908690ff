//! Identities of theory note §14: the body's terms equal their assembly from point masses.

use nalgebra::{DMatrix, DVector, Matrix3xX, Vector3, Vector4};

use super::floating_frame::{BodyMotion, FloatingFrame};
use super::rotation::{rate_map, rotation_matrix, skew};
use crate::testing::{Cloud, Numbers};

const MODES: usize = 5;

struct Case {
    cloud: Cloud,
    frame: FloatingFrame,
    q: Vec<f64>,
    v: Vec<f64>,
}

fn case(seed: u64) -> Case {
    let cloud = Cloud::new(9, MODES, seed);
    let frame = FloatingFrame::flexible(&cloud.reduce(2e3, 1e-3)).unwrap();
    let mut x = Numbers::new(seed + 100);
    let theta = x.unit4();
    let mut q = x.list(3);
    q.extend(theta.iter());
    q.extend(x.list(MODES));
    let mut v = x.list(3);
    v.extend((rate_map(&theta).transpose() * x.vector() * 0.5).iter());
    v.extend(x.list(MODES));
    Case { cloud, frame, q, v }
}

impl Case {
    fn motion(&self, v: &[f64], a: &[f64]) -> BodyMotion {
        let mut motion = self.frame.new_motion();
        self.frame.evaluate(&self.q, v, a, &mut motion);
        motion
    }

    /// Residual without gravity: inertia, velocity and elastic terms.
    fn residual(&self, v: &[f64], a: &[f64]) -> DVector<f64> {
        let (mut rigid, mut modal) = ([0.0; 6], vec![0.0; MODES]);
        self.frame
            .add_inertia_and_elastic(&self.motion(v, a), &mut rigid, &mut modal);
        DVector::from_iterator(6 + MODES, rigid.into_iter().chain(modal))
    }

    /// Accelerations whose quasi-coordinates [r̈, ω̇, η̈] are the given ones.
    fn acceleration(&self, quasi: &DVector<f64>) -> Vec<f64> {
        let theta = Vector4::from_column_slice(&self.q[3..7]);
        let turn = rate_map(&theta).transpose() * Vector3::new(quasi[3], quasi[4], quasi[5]) * 0.25;
        let mut a = quasi.as_slice()[..3].to_vec();
        a.extend(turn.iter());
        a.extend(&quasi.as_slice()[6..]);
        a
    }

    /// Deformed position in the body frame and velocity Jacobian [1, −A p̃, A Ψ V] of a node.
    fn node(&self, i: usize) -> (Vector3<f64>, Matrix3xX<f64>) {
        let psi = &self.cloud.shapes[i] * self.frame.basis();
        let rotation = rotation_matrix(&Vector4::from_column_slice(&self.q[3..7]));
        let p = self.cloud.points_m[i] + &psi * DVector::from_column_slice(&self.q[7..]);
        let mut jacobian = Matrix3xX::zeros(6 + MODES);
        jacobian.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
        jacobian
            .fixed_view_mut::<3, 3>(0, 3)
            .copy_from(&-(rotation * skew(&p)));
        jacobian.columns_mut(6, MODES).copy_from(&(rotation * psi));
        (p, jacobian)
    }

    fn assemble(&self, of_node: impl Fn(usize) -> Vector3<f64>) -> DVector<f64> {
        let nodes = self.cloud.points_m.len();
        (0..nodes)
            .map(|i| self.node(i).1.transpose() * of_node(i) * self.cloud.masses_kg[i])
            .sum()
    }
}

#[test]
fn mass_matrix_equals_its_nodal_assembly() {
    for seed in 0..5 {
        let case = case(seed);
        let order = 6 + MODES;
        let still = vec![0.0; 7 + MODES];
        let at_rest = case.residual(&still, &still);
        let mass = DMatrix::from_columns(
            &(0..order)
                .map(|k| {
                    let unit = DVector::from_fn(order, |i, _| if i == k { 1.0 } else { 0.0 });
                    case.residual(&still, &case.acceleration(&unit)) - &at_rest
                })
                .collect::<Vec<_>>(),
        );
        let nodal: DMatrix<f64> = (0..case.cloud.points_m.len())
            .map(|i| {
                let jacobian = case.node(i).1;
                jacobian.transpose() * jacobian * case.cloud.masses_kg[i]
            })
            .sum();
        // The elastic forces of 1e3 N are subtracted: rounding of 1e-13 N against masses of 1..100.
        assert!(
            (&mass - &nodal).amax() < 1e-11 * nodal.amax(),
            "{:e}",
            (&mass - &nodal).amax()
        );
        assert!(nodal.cholesky().is_some(), "positive definite");

        // The blocks that the Jacobian uses are the same matrix.
        let motion = case.motion(&still, &still);
        let mut rigid = vec![0.0; 36];
        case.frame.add_rigid_mass(&motion, 1.0, &mut rigid, 6, 0);
        for i in 0..6 {
            for j in 0..6 {
                assert!((rigid[6 * i + j] - mass[(i, j)]).abs() < 1e-10);
            }
            for k in 0..MODES {
                let coupling = case.frame.modal_coupling(&motion, k);
                assert!((coupling[i] - mass[(i, 6 + k)]).abs() < 1e-10);
            }
        }
    }
}

#[test]
fn velocity_terms_equal_the_nodal_accelerations() {
    for seed in 0..5 {
        let case = case(seed);
        let still = vec![0.0; 7 + MODES];
        let motion = case.motion(&case.v, &still);
        let rate = DVector::from_column_slice(&case.v[7..]);
        // Damping is elastic, not inertial: take it out.
        let mut expected = case.assemble(|i| {
            let (p, _) = case.node(i);
            let w = motion.omega_rad_per_s;
            let shape_rate = &case.cloud.shapes[i] * case.frame.basis() * &rate;
            motion.rotation * (w.cross(&w.cross(&p)) + 2.0 * w.cross(&shape_rate))
        });
        for k in 0..MODES {
            expected[6 + k] += case.frame.damping[k] * rate[k];
        }
        let found = case.residual(&case.v, &still) - case.residual(&still, &still);
        assert!(
            (&found - &expected).amax() < 1e-11 * expected.amax().max(1e3),
            "seed {seed}"
        );
    }
}

#[test]
fn gravity_is_the_weight_of_every_node() {
    let case = case(7);
    let still = vec![0.0; 7 + MODES];
    let gravity = Vector3::new(0.3, -9.8, 1.0);
    let expected = case.assemble(|_| gravity);
    let (mut rigid, mut modal) = ([0.0; 6], vec![0.0; MODES]);
    case.frame.subtract_gravity(
        &case.motion(&still, &still),
        &gravity,
        true,
        &mut rigid,
        &mut modal,
    );
    for (found, wanted) in rigid.iter().chain(&modal).zip(expected.iter()) {
        assert!((found + wanted).abs() < 1e-11 * expected.amax());
    }
    // The published convention differs in the moment alone, by the moment of the modal shift.
    let (mut other, mut other_modal) = ([0.0; 6], vec![0.0; MODES]);
    case.frame.subtract_gravity(
        &case.motion(&still, &still),
        &gravity,
        false,
        &mut other,
        &mut other_modal,
    );
    assert_eq!(modal, other_modal);
    assert_eq!(rigid[..3], other[..3]);
    let shift: Vector3<f64> = case
        .frame
        .c_pt
        .iter()
        .zip(&case.q[7..])
        .map(|(c, eta)| c * *eta)
        .sum();
    let local = rotation_matrix(&Vector4::from_column_slice(&case.q[3..7])).transpose() * gravity;
    for k in 0..3 {
        assert!((rigid[3 + k] - other[3 + k] + shift.cross(&local)[k]).abs() < 1e-11 * expected.amax());
    }
}

#[test]
fn kinetic_energy_is_that_of_the_nodes() {
    let case = case(3);
    let still = vec![0.0; 7 + MODES];
    let motion = case.motion(&case.v, &still);
    let mut quasi = case.v[..3].to_vec();
    quasi.extend(motion.omega_rad_per_s.iter());
    quasi.extend(&case.v[7..]);
    let quasi = DVector::from_vec(quasi);
    let nodal: f64 = (0..case.cloud.points_m.len())
        .map(|i| 0.5 * case.cloud.masses_kg[i] * (case.node(i).1 * &quasi).norm_squared())
        .sum();
    assert!((case.frame.kinetic_energy_j(&motion) - nodal).abs() < 1e-12 * nodal.max(1.0));
}
