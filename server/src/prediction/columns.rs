//! Which column of a request is which input of the model, and what to say when one is missing.

use hydroflex_openapi::model::ModelConfig;
use hydroflex_openapi::problem::FieldError;

/// Endings of column names that say a unit, longer ones before those that they end with.
const UNITS: [&str; 34] = [
    "m_per_s2",
    "mm_per_s2",
    "rad_per_s2",
    "deg_per_s2",
    "mm_per_s",
    "km_per_h",
    "m_per_s",
    "rad_per_s",
    "deg_per_s",
    "n_per_mm2",
    "n_per_m2",
    "percent",
    "microstrain",
    "strain",
    "ratio",
    "degrees",
    "deg",
    "rad",
    "kpa",
    "mpa",
    "mbar",
    "bar",
    "psi",
    "pa",
    "inch",
    "mm",
    "cm",
    "m",
    "kg",
    "kn",
    "n",
    "mv",
    "v",
    "s",
];

/// A column name without its unit: `pressure_lift_piston` of `pressure_lift_piston_pa`.
fn stem(name: &str) -> (&str, &str) {
    UNITS
        .iter()
        .find_map(|unit| {
            let stem = name.strip_suffix(unit)?.strip_suffix('_')?;
            (!stem.is_empty()).then_some((stem, *unit))
        })
        .unwrap_or((name, ""))
}

/// Errors for inputs of the model that a request lacks; one that is there in another unit is named.
#[must_use]
pub fn missing(config: &ModelConfig, present: &[&str], pointer: impl Fn(&str) -> String) -> Vec<FieldError> {
    config
        .inputs
        .iter()
        .filter(|input| !present.contains(&input.name.as_str()))
        .map(|input| missing_one(&input.name, present, &pointer))
        .collect()
}

fn missing_one(name: &str, present: &[&str], pointer: impl Fn(&str) -> String) -> FieldError {
    let (wanted, unit) = stem(name);
    match present.iter().find(|other| stem(other).0 == wanted) {
        Some(other) => {
            let found = match stem(other).1 {
                "" => "without a unit".to_owned(),
                unit => format!("in {unit}"),
            };
            FieldError::new(
                pointer(other),
                format!("{wanted} is {found}; give it in {unit}, as {name}"),
            )
            .value(*other)
            .allowed(name)
        }
        None => {
            FieldError::new(pointer(name), format!("the input {name} of the model is missing")).allowed(name)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_a_stem_and_a_unit() {
        for (name, expected) in [
            ("pressure_lift_piston_pa", ("pressure_lift_piston", "pa")),
            ("pressure_lift_piston_mpa", ("pressure_lift_piston", "mpa")),
            ("pressure_lift_piston_bar", ("pressure_lift_piston", "bar")),
            ("velocity_lift_m_per_s", ("velocity_lift", "m_per_s")),
            ("velocity_lift_mm_per_s", ("velocity_lift", "mm_per_s")),
            ("valve_lift_ratio", ("valve_lift", "ratio")),
            ("length_lift", ("length_lift", "")),
            ("m", ("m", "")),
        ] {
            assert_eq!(stem(name), expected);
        }
    }

    #[test]
    fn another_unit_is_told_from_a_missing_column() {
        let pointer = |name: &str| format!("/inputs/{name}");
        let other = missing_one("pressure_lift_piston_pa", &["pressure_lift_piston_bar"], pointer);
        assert_eq!(other.pointer, "/inputs/pressure_lift_piston_bar");
        assert_eq!(
            other.detail,
            "pressure_lift_piston is in bar; give it in pa, as pressure_lift_piston_pa"
        );
        let none = missing_one("pressure_lift_piston_pa", &["pressure_lift_rod_pa"], pointer);
        assert_eq!(none.pointer, "/inputs/pressure_lift_piston_pa");
        assert!(none.detail.contains("missing"));
    }
}
