//! The equations against their definition, node by node.

use super::constants::Constants;
use super::dynamics::{Heading, PerMode, Point, Rates, Regime, evaluate};
use super::model::{Modes, Order, PlanarModel};
use super::solve::{Factors, factor, solve};
use super::statics::rest;
use crate::testing::{Cloud, Numbers};
use hydroflex_openapi::machine::MachineFile;
use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, Vector3};

const NODES: usize = 9;
const MODES: usize = 6;
const PAYLOAD_KG: f64 = 2.5;

/// A machine around the cloud: pivot at the root, cylinder and payload at the end.
fn machine() -> MachineFile {
    let text = r#"
        format = 1
        name = "cloud"
        gravity_m_per_s2 = [0.3, -9.8, 0.2]
        [[body]]
        kind = "flexible"
        name = "cloud"
        mesh = { given = "none" }
        material = { name = "x", youngs_modulus_pa = 1.0, poisson_ratio = 0.3, density_kg_per_m3 = 1.0 }
        normal_modes = 0
        damping = { kind = "rayleigh", mass_factor_per_s = 0.0, stiffness_factor_s = 1e-3 }
        interface = []
        [[joint]]
        name = "pivot"
        kind = "revolute"
        from = { body = "ground", point_m = [-0.1, 1.2, 0.0] }
        to = { body = "cloud", interface = "root" }
        [[cylinder]]
        name = "lift"
        base = { body = "ground", point_m = [0.4, 0.1, -0.05] }
        rod = { body = "cloud", interface = "end" }
        closed_length_m = 0.6
        stroke_m = 1.5
        piston_diameter_m = 0.05
        rod_diameter_m = 0.03
        damping_n_s_per_m = 2e3
        hose = { diameter_m = 0.01, length_m = 1.0 }
        fluid = { bulk_modulus_oil_pa = 1.6e9, bulk_modulus_cylinder_pa = 2e11, bulk_modulus_hose_pa = 7e8 }
        valve = { flow_coefficient_m3_per_s_per_sqrt_pa = 1e-7, supply_pressure_pa = 1.4e7, tank_pressure_pa = 1e5 }
        friction = { kind = "brown_mcphee", coulomb_n = 20.0, static_n = 30.0, viscous_n_s_per_m = 33.0, transition_velocity_m_per_s = 5e-2 }
        parallel_spring = { stiffness_n_per_m = 200.0, cubic_stiffness_n_per_m3 = 300.0, damping_n_s_per_m = 10.0, free_length_m = 0.1 }
        initial_pressure_pa = 1e6
        [[angle]]
        name = "lift"
        body = "cloud"
        range_deg = [-10.0, 50.0]
        [payload]
        at = { body = "cloud", interface = "end" }
        range_kg = [0.0, 10.0]
        [[sensor]]
        name = "end"
        quantity = "deflection"
        body = "cloud"
        near_m = [0.0, 0.0, 0.0]
        within_m = 9.0
        components = ["x", "y", "z"]
    "#;
    toml::from_str(text).unwrap()
}

type Numbered = Point<f64, 8, 8, 8>;

struct Fixture {
    cloud: Cloud,
    modes: Modes,
    constants: Constants<f64, 8, 8, 8>,
    stiffness: DMatrix<f64>,
    damping: DMatrix<f64>,
}

/// The cloud with its modes taken as `order` says.
fn fixture(order: &Order) -> Fixture {
    let cloud = Cloud::new(NODES, MODES, 5);
    let body = cloud.reduce(4e4, 1e-3);
    let model = PlanarModel::new(&machine(), &body, true).unwrap();
    let modes = model.modes(PAYLOAD_KG).unwrap();
    let constants = model.constants(&modes, order).unwrap();
    Fixture {
        cloud,
        modes,
        constants,
        stiffness: body.stiffness_modal,
        damping: body.damping_modal,
    }
}

/// Nothing is simplified.
fn all_coupled() -> Order {
    Order {
        coupled: (0..MODES).collect(),
        ..Order::default()
    }
}

/// One or two modes of every kind.
fn mixed() -> Order {
    Order {
        coupled: vec![0, 2],
        plain: vec![1, 3],
        followers: vec![4],
        lagging: vec![5],
    }
}

fn random_state(seed: u64) -> Numbered {
    let mut x = Numbers::new(seed);
    let mut y = Point::zero();
    y.theta = 0.8 * x.next();
    y.omega = x.next();
    for k in 0..MODES {
        y.z.coupled[k] = 0.02 * x.next();
        y.v.coupled[k] = 0.5 * x.next();
    }
    y.p = [3e6 + 2e6 * x.next(), 2e6 + 1e6 * x.next()];
    y
}

fn rates_at(
    c: &Constants<f64, 8, 8, 8>,
    y: &Numbered,
    opening: f64,
    regime: &Regime<f64>,
) -> Rates<f64, 8, 8, 8> {
    let mut r = Rates::zero();
    evaluate::<true, _, _, 8, 8, 8>(c, y, &Heading::new(y.theta), opening, regime, &mut r);
    r
}

fn regime() -> Regime<f64> {
    Regime {
        opening: 0.4,
        opening_per_s: 30.0,
        line_pa: [1.4e7, 1e5],
        filled: [1.0; 2],
    }
}

/// d'Alembert at every node: the virtual power of inertia, weight, cylinder and elastic forces is
/// zero for the rotation and for every mode, with positions, velocities and accelerations built from
/// the definition of the floating frame, gravity moment of the deformed body.
#[test]
fn inertia_and_applied_forces_balance_node_by_node() {
    let f = fixture(&all_coupled());
    for seed in 0..5 {
        let y = random_state(seed);
        let r = rates_at(&f.constants, &y, 0.4, &regime());

        // Back to the body's modal coordinates.
        let zeta = |x: &[f64; 8]| {
            DVector::from_fn(MODES, |i, _| {
                (0..MODES).map(|k| f.modes.phi[(i, k)] * x[k]).sum::<f64>()
            })
        };
        let (u, ud, udd) = (zeta(&y.z.coupled), zeta(&y.v.coupled), zeta(&r.a.coupled));
        let turn: Matrix3<f64> = *Rotation3::from_axis_angle(&Vector3::z_axis(), y.theta).matrix();
        let axis = Vector3::z();
        let mut masses = f.cloud.masses_kg.clone();
        let (mut points, mut shapes) = (f.cloud.points_m.clone(), f.cloud.shapes.clone());
        masses.push(PAYLOAD_KG);
        points.push(f.cloud.points_m[0]);
        shapes.push(f.cloud.shapes[0].clone());

        // Cylinder: from the ground point to node 0.
        let rod = turn * (points[0] + &shapes[0] * &u);
        let along = rod - Vector3::new(0.5, -1.1, -0.05);
        let n = along / along.norm();
        assert!((r.length - along.norm()).abs() < 1e-14);
        let rod_speed = turn * (axis.cross(&(points[0] + &shapes[0] * &u)) * y.omega + &shapes[0] * &ud);
        assert!((r.speed - n.dot(&rod_speed)).abs() < 1e-13);

        let mut power_rotation = 0.0;
        let mut power_modes = -(&f.stiffness * &u + &f.damping * &ud);
        let mut size = 0.0;
        for i in 0..masses.len() {
            let p = points[i] + &shapes[i] * &u;
            let w = axis * y.omega;
            let acceleration = turn
                * (axis.cross(&p) * r.alpha
                    + w.cross(&w.cross(&p))
                    + w.cross(&(&shapes[i] * &ud)) * 2.0
                    + &shapes[i] * &udd);
            let mut force = (Vector3::new(0.3, -9.8, 0.2) - acceleration) * masses[i];
            if i == 0 {
                force -= n * r.force;
            }
            power_rotation += force.dot(&(turn * axis.cross(&p)));
            power_modes += (turn * &shapes[i]).transpose() * force;
            size += force.norm();
        }
        // Rounding of sums over nodes and of the eigenproblem.
        assert!(power_rotation.abs() < 1e-9 * size, "{power_rotation} of {size}");
        assert!(
            power_modes.amax() < 1e-9 * size,
            "{} of {size}",
            power_modes.amax()
        );
    }
}

/// All of state and rates as one list: θ, z, ω, v, lagged force, pressures.
fn pack(c: &Constants<f64, 8, 8, 8>, y: &Numbered) -> DVector<f64> {
    let modes = |x: &PerMode<f64, 8, 8, 8>| {
        let mut all = x.coupled[..c.coupled.used].to_vec();
        all.extend_from_slice(&x.plain[..c.plain.used]);
        all.extend_from_slice(&x.follower[..c.follower.used]);
        all
    };
    let mut x = vec![y.theta];
    x.extend(modes(&y.z));
    x.push(y.omega);
    x.extend(modes(&y.v));
    x.push(y.lag);
    x.extend(y.p);
    DVector::from_vec(x)
}

fn unpack(c: &Constants<f64, 8, 8, 8>, x: &DVector<f64>) -> Numbered {
    let mut from = x.iter().copied();
    let mut y = Point::zero();
    let modes = |from: &mut dyn Iterator<Item = f64>, to: &mut PerMode<f64, 8, 8, 8>| {
        let coupled = to.coupled[..c.coupled.used].iter_mut();
        let rest = to.plain[..c.plain.used].iter_mut();
        for to in coupled.chain(rest).chain(&mut to.follower[..c.follower.used]) {
            *to = from.next().unwrap();
        }
    };
    y.theta = from.next().unwrap();
    modes(&mut from, &mut y.z);
    y.omega = from.next().unwrap();
    modes(&mut from, &mut y.v);
    y.lag = from.next().unwrap();
    y.p = [from.next().unwrap(), from.next().unwrap()];
    y
}

fn rates(c: &Constants<f64, 8, 8, 8>, x: &DVector<f64>) -> DVector<f64> {
    let y = unpack(c, x);
    let r = rates_at(c, &y, 0.4, &regime());
    let change = Point {
        theta: y.omega,
        z: y.v,
        omega: r.alpha,
        v: r.a,
        lag: r.lag,
        p: r.p,
    };
    pack(c, &change)
}

/// The structured solve against the matrix 1/s − ∂f/∂y by central differences, with modes of every
/// kind. At rest with its pressures the terms that the Jacobian leaves out are the change of J with z
/// times the force, how weight and cylinder force turn on modes that are not coupled, and the couplings
/// of pressures' own rates, all below 2 % of the solution here.
#[test]
fn the_structured_solve_is_the_linearised_equation() {
    for order in [all_coupled(), mixed()] {
        let f = fixture(&order);
        let c = &f.constants;
        let mut start = rest(c, 0.3).unwrap().state;
        start.omega = 0.0;
        let x = pack(c, &start);
        let r = rates_at(c, &start, 0.4, &regime());
        let (n, s) = (x.len(), 1e-3);
        let states = (n - 5) / 2;
        let mut matrix = DMatrix::<f64>::identity(n, n) / s;
        for j in 0..n {
            let h = 1e-6 * x[j].abs().max(1e-2);
            let (mut up, mut down) = (x.clone(), x.clone());
            up[j] += h;
            down[j] -= h;
            let column = (rates(c, &up) - rates(c, &down)) / (2.0 * h);
            for i in 0..n {
                matrix[(i, j)] -= column[i];
            }
        }
        let mut factors = Factors::zero();
        factor(c, &start, &r, s, &mut factors);
        let lu = matrix.lu();
        for seed in 0..4 {
            let mut random = Numbers::new(seed);
            let mut rhs = DVector::from_fn(n, |_, _| random.next());
            // Pressures move by megapascals and forces by kilonewtons where angles move by milliradians.
            rhs[n - 1] *= 1e7;
            rhs[n - 2] *= 1e7;
            rhs[n - 3] *= 1e4;
            let exact = lu.solve(&rhs).unwrap();
            let mut u = Point::zero();
            solve(c, &factors, &r, &unpack(c, &rhs), &mut u);
            let ours = pack(c, &u);
            for (range, name) in [
                (0..states + 1, "positions"),
                (states + 1..n - 3, "rates"),
                (n - 3..n - 2, "lagged force"),
                (n - 2..n, "pressures"),
            ] {
                let size = range.clone().map(|i| exact[i].abs()).fold(0.0, f64::max);
                let off = range.map(|i| (exact[i] - ours[i]).abs()).fold(0.0, f64::max);
                assert!(off < 0.02 * size, "{name}: {off:e} of {size:e}, {order:?}");
            }
        }
    }
}

/// At rest every rate is zero to rounding, and the cylinder has the length of the undeformed pose.
#[test]
fn the_equilibrium_is_one() {
    for order in [all_coupled(), mixed()] {
        let f = fixture(&order);
        for angle in [-0.15, 0.2, 0.7] {
            let start = rest(&f.constants, angle).unwrap();
            let shut = Regime {
                opening: 0.0,
                opening_per_s: 0.0,
                ..regime()
            };
            let r = rates_at(&f.constants, &start.state, 0.0, &shut);
            assert!((r.length - start.length_m).abs() < 1e-13);
            // Forces of 1e3 N on 1e0 kg m², rounded.
            assert!(r.alpha.abs() < 1e-9, "{}", r.alpha);
            let all = r.a.coupled.iter().chain(&r.a.plain).chain(&r.a.follower);
            assert!(all.into_iter().all(|a| a.abs() < 1e-8), "{:?}", r.a);
            assert!(r.p.iter().all(|p| p.abs() < 1e-9), "{:?}", r.p);
            assert!(r.lag.abs() < 1e-6, "{}", r.lag);
        }
    }
}

/// The inertia of what moves with the frame is Θ − |h|², and stays positive however many products are
/// left out: as the small difference that it is with many modes, it came out negative once.
#[test]
fn the_hub_is_what_the_modes_leave_of_the_inertia() {
    let f = fixture(&all_coupled());
    let y = random_state(3);
    let r = rates_at(&f.constants, &y, 0.4, &regime());
    let zeta = DVector::from_fn(MODES, |i, _| {
        (0..MODES)
            .map(|k| f.modes.phi[(i, k)] * y.z.coupled[k])
            .sum::<f64>()
    });
    let mut masses = f.cloud.masses_kg.clone();
    let (mut points, mut shapes) = (f.cloud.points_m.clone(), f.cloud.shapes.clone());
    masses.push(PAYLOAD_KG);
    points.push(f.cloud.points_m[0]);
    shapes.push(f.cloud.shapes[0].clone());
    let inertia: f64 = (0..masses.len())
        .map(|i| {
            let p = points[i] + &shapes[i] * &zeta;
            masses[i] * (p.x * p.x + p.y * p.y)
        })
        .sum();
    // Sums of a few numbers of the size of the inertia, rounded.
    assert!(
        (r.inertia - inertia).abs() < 1e-12 * inertia,
        "{} {inertia}",
        r.inertia
    );
    let few = fixture(&mixed());
    let hub = few.constants.hub_kg_m2;
    assert!(hub > 0.0 && hub < inertia, "{hub}");
}
