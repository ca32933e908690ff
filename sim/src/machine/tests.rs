//! What a machine file may say, and with which words it is refused.

use super::*;

const PUBLISHED: &str = include_str!("../../machines/lift-boom-published.toml");

fn refusal(text: &str) -> String {
    match Machine::parse_file(text) {
        Ok(_) => "accepted".to_owned(),
        Err(error) => error.to_string(),
    }
}

fn edited(from: &str, to: &str) -> String {
    assert!(PUBLISHED.contains(from), "{from}");
    refusal(&PUBLISHED.replacen(from, to, 1))
}

#[test]
fn the_published_machine_parses() {
    let file = Machine::parse_file(PUBLISHED).unwrap();
    assert_eq!(file.name, "lift-boom-published");
    assert_eq!(file.bodies.len(), 1);
}

#[test]
fn wrong_units_and_keys_are_refused_with_line_and_hint() {
    for (from, to) in [
        ("rod_diameter_m = 0.056", "rod_diameter_mm = 56.0"),
        ("radius_m = 0.025", "radius_mm = 25.0"),
        ("normal_modes = 2", "normal_modes = 2\nmodes = 3"),
        ("youngs_modulus_pa = 210e9", "youngs_modulus_pa = 210.0"),
        ("youngs_modulus_pa = 210e9", "youngs_modulus_gpa = 210.0"),
        ("supply_pressure_pa = 160e5", "supply_pressure_bar = 160.0"),
        ("supply_pressure_pa = 160e5", "supply_pressure_pa = 160.0"),
        ("density_kg_per_m3 = 7850.0", "density_kg_per_m3 = 0.0"),
        ("normal_modes = 2", "normal_modes = \"two\""),
        ("normal_modes = 2", ""),
        ("stroke_m = 0.535", "stroke_m = 0.835"),
        ("interface = \"piston\"", "interface = \"pistn\""),
        ("format = 1", "format = 2"),
        ("kind = \"revolute\"", "kind = \"hinge\""),
        ("kind = \"flexible\"", "kind = \"felxible\""),
        ("kind = \"stribeck\"", "kind = \"stribek\""),
        ("dynamic_n = 1.0", "dynamic_kn = 1.0"),
        ("components = [\"xx\"]", "components = [\"x\"]"),
        ("name = \"payload\"", "name = \"piston\""),
        ("format = 1", "format = "),
        ("range_deg = [-10.0, 50.0]", "range_deg = [-10.0, 50.0, 3.0]"),
    ] {
        eprintln!("{to}\n   -> {}", edited(from, to));
    }
}

#[test]
fn the_built_in_boom_is_a_credible_crane_boom() {
    let machine = Machine::load("lift-boom", &[]).unwrap();
    let [boom] = machine.flexible_bodies() else {
        panic!("one flexible body")
    };
    let mass_kg = boom.mesh.volume_m3() * boom.material.density_kg_per_m3;
    assert!((110.0..160.0).contains(&mass_kg), "{mass_kg} kg");
    for interface in &boom.interfaces {
        assert!(interface.nodes.len() > 100, "{}", interface.name);
    }
    let body = &machine.reduce(false, None).unwrap()[0];
    // "29 and 31 Hz" of the paper's boom; half the element size changes ours by 0.5 %
    for (found, near) in body.report.fixed_interface_hz.iter().zip([29.4, 30.4]) {
        assert!((found - near).abs() < 0.3, "{found} Hz");
    }
}
