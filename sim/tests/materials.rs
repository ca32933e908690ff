//! Materials as a part of a job: drawn alike, refused by key, value and what is allowed.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use hydroflex_openapi::job::JobSpec;
use hydroflex_openapi::machine::MachineFile;
use hydroflex_openapi::problem::FieldError;
use hydroflex_sim::machine::Machine;
use hydroflex_sim::scenario::{Anywhere, material_index, plan_run, run_seed, validate_materials};

fn machine() -> MachineFile {
    let text = Machine::built_in_text("lift-boom-published").unwrap();
    Machine::parse_file(text).unwrap()
}

fn job(json: &str) -> JobSpec {
    serde_json::from_str(json).unwrap()
}

#[test]
fn materials_are_drawn_alike_and_change_no_other_number() {
    let machine = machine();
    let plain = job(r#"{"runs": 300, "payload_kg": {"min": 0, "max": 100}}"#);
    let varied = JobSpec {
        materials: job(r#"{"runs": 1, "materials": ["steel", "aluminium", "titanium"]}"#).materials,
        ..plain.clone()
    };
    let mut counts = [0; 3];
    for index in 0..plain.runs {
        let seed = run_seed(varied.seed, index);
        assert_eq!(material_index(&plain, seed), None);
        counts[material_index(&varied, seed).unwrap()] += 1;
        assert_eq!(
            plan_run(&plain, &machine, &Anywhere, index),
            plan_run(&varied, &machine, &Anywhere, index)
        );
    }
    // standard error 8
    assert!(counts.iter().all(|count| (70..130).contains(count)), "{counts:?}");
}

#[test]
fn materials_are_refused_by_key_value_and_what_is_allowed() {
    let refused = |materials: &str| -> Vec<FieldError> {
        let spec = job(&format!(r#"{{"runs": 1, "materials": {materials}}}"#));
        validate_materials(&spec, &machine()).unwrap_err()
    };
    let unknown = &refused(r#"["steel", "wood"]"#)[0];
    assert_eq!(
        (unknown.pointer.as_str(), unknown.value.clone()),
        ("/materials/1", Some("wood".into()))
    );
    assert!(
        unknown
            .allowed
            .as_ref()
            .unwrap()
            .starts_with("steel, aluminium, titanium")
    );
    let rubber =
        r#"[{"name": "rubber", "youngs_modulus_pa": 1e11, "poisson_ratio": 0.5, "density_kg_per_m3": 1}]"#;
    let pointers: Vec<String> = refused(rubber).into_iter().map(|error| error.pointer).collect();
    assert_eq!(
        pointers,
        ["/materials/0/poisson_ratio", "/materials/0/density_kg_per_m3"]
    );
    assert_eq!(
        refused(r#"["steel", "steel"]"#)[0].allowed.as_deref(),
        Some("every name once")
    );
    assert!(validate_materials(&job(r#"{"runs": 1, "materials": ["steel"]}"#), &machine()).is_ok());
}
