//! Assembly of closed loops.

use hydroflex_openapi::machine::{Attachment, BodySpec, JointKind, JointSpec, MachineFile, RigidBodySpec};

use super::{EquilibriumError, angle_about_z, equilibrium};
use crate::system::System;
use crate::testing::rig;

/// The rig's arm drives a four-bar: arm – link – rocker – ground.
fn four_bar(link_m: f64) -> MachineFile {
    let mut file = rig();
    let bar = |name: &str, start_angle_deg| {
        BodySpec::Rigid(RigidBodySpec {
            name: name.to_owned(),
            mass_kg: 5.0,
            centre_of_mass_m: [0.2, 0.0, 0.0],
            inertia_kg_m2: [0.1, 0.1, 0.1, 0.0, 0.0, 0.0],
            start_angle_deg,
        })
    };
    file.bodies.push(bar("link", 170.0));
    file.bodies.push(bar("rocker", 60.0));
    let at = |body: &str, x: f64, y: f64| Attachment {
        body: body.to_owned(),
        interface: None,
        point_m: Some([x, y, 0.0]),
    };
    let joint = |name: &str, kind, from, to| JointSpec {
        name: name.to_owned(),
        kind,
        from,
        to,
    };
    file.joints.push(joint(
        "arm to link",
        JointKind::Revolute,
        at("arm", 1.0, 0.3),
        at("link", 0.0, 0.0),
    ));
    file.joints.push(joint(
        "ground to rocker",
        JointKind::Revolute,
        at("ground", 0.0, 1.0),
        at("rocker", 0.0, 0.0),
    ));
    file.joints.push(joint(
        "closing",
        JointKind::PlanarPin,
        at("link", link_m, 0.0),
        at("rocker", 0.9, 0.0),
    ));
    file
}

#[test]
fn a_closed_loop_is_assembled_from_a_rough_pose_and_held() {
    let file = four_bar(0.8);
    let system = System::new(&file, &[], 0.0).unwrap();
    let mut ws = system.new_workspace();
    let found = equilibrium(&system, &file, &[0.2], &mut ws).unwrap();
    system.evaluate_motion(&found.state, &mut ws);
    for gap in &ws.residual_rows[..system.joint_rows] {
        assert!(gap.abs() < 1e-11, "{gap:e}");
    }
    // The given angle is kept; the others were found.
    assert!((angle_about_z(&ws.bodies[0].rotation) - 0.2).abs() < 1e-12);
    // With these pressures nothing accelerates.
    let stepper = crate::integrate::Stepper::new(
        &system,
        crate::integrate::Scheme::generalized_alpha(0.7),
        found.state.clone(),
    )
    .unwrap();
    assert!(
        stepper.state.a.iter().all(|a| a.abs() < 1e-8),
        "{:?}",
        stepper.state.a
    );
}

#[test]
fn a_loop_that_cannot_close_names_its_joint() {
    let file = four_bar(0.05);
    let system = System::new(&file, &[], 0.0).unwrap();
    match equilibrium(&system, &file, &[0.2], &mut system.new_workspace()) {
        Err(EquilibriumError::LoopOpen { joint, gap_m }) => assert!(gap_m > 1e-3 && !joint.is_empty()),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_machine_that_no_cylinder_holds_is_refused() {
    let mut file = rig();
    file.cylinders.clear();
    let system = System::new(&file, &[], 0.0).unwrap();
    let found = equilibrium(&system, &file, &[0.2], &mut system.new_workspace());
    assert_eq!(found.unwrap_err(), EquilibriumError::NotHeld);
}

#[test]
fn a_wrong_number_of_angles_is_refused() {
    let file = rig();
    let system = System::new(&file, &[], 0.0).unwrap();
    let found = equilibrium(&system, &file, &[], &mut system.new_workspace());
    assert_eq!(
        found.unwrap_err(),
        EquilibriumError::AngleCount {
            given: 0,
            expected: 1
        }
    );
}
