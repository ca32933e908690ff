//! From text to [`MachineFile`], with the line of whatever is wrong.

use super::error::{MachineError, Place, Problem};
use hydroflex_openapi::machine::{FlexibleBodySpec, MachineFile, RigidBodySpec};
use serde::Deserialize;
use std::ops::Range;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// A machine text with the positions of its keys.
pub(super) struct MachineText<'t> {
    name: &'t str,
    text: &'t str,
    table: Spanned<DeTable<'t>>,
}

impl<'t> MachineText<'t> {
    /// Parses the text; `name` stands for the file in messages.
    pub(super) fn parse(name: &'t str, text: &'t str) -> Result<(Self, MachineFile), MachineError> {
        let table = DeTable::parse(text).map_err(|error| MachineError::Refused {
            place: Place {
                file: name.to_owned(),
                line: error.span().map(|span| line_of(text, span.start)),
                key: String::new(),
            },
            problem: Box::new(Problem::Syntax {
                message: error.message().to_owned(),
            }),
        })?;
        let parsed = Self { name, text, table };
        let file = toml::from_str::<MachineFile>(text).map_err(|error| parsed.explain(&error))?;
        parsed.check_list_lengths()?;
        Ok((parsed, file))
    }

    /// The parser reads `[1, 2, 3, 4]` into three numbers without a word.
    fn check_list_lengths(&self) -> Result<(), MachineError> {
        let mut wrong = None;
        visit(self.table.get_ref(), &mut |key, span, value| {
            let wanted = LIST_LENGTHS.iter().find(|(name, _)| *name == key);
            let (Some((_, wanted)), Some(list)) = (wanted, value.get_ref().as_array()) else {
                return;
            };
            if list.len() != *wanted && wrong.is_none() {
                wrong = Some((key.to_owned(), span, list.len(), *wanted));
            }
        });
        match wrong {
            None => Ok(()),
            Some((key, span, found, wanted)) => {
                Err(self.refuse_at(span.start, key, Problem::ListLength { found, wanted }))
            }
        }
    }

    /// Refuses the value at a key path such as `body[0].interface[1].select`.
    pub(super) fn refuse(&self, key: impl Into<String>, problem: Problem) -> MachineError {
        let key = key.into();
        self.refuse_at(self.position(&key), key, problem)
    }

    fn refuse_at(&self, position: usize, key: String, problem: Problem) -> MachineError {
        MachineError::Refused {
            place: Place {
                file: self.name.to_owned(),
                line: Some(line_of(self.text, position)),
                key,
            },
            problem: Box::new(problem),
        }
    }

    /// Byte at which the key path stands; of the deepest part that exists.
    fn position(&self, path: &str) -> usize {
        let mut position = 0;
        let mut table: Option<&DeTable<'_>> = Some(self.table.get_ref());
        for part in path.split('.') {
            let (key, indices) = part.split_once('[').unwrap_or((part, ""));
            let Some((name, value)) = table.and_then(|t| t.iter().find(|(name, _)| name.get_ref() == key))
            else {
                break;
            };
            position = name.span().start;
            let mut value = value;
            for index in indices.split('[').filter(|i| !i.is_empty()) {
                let item = index
                    .trim_end_matches(']')
                    .parse::<usize>()
                    .ok()
                    .and_then(|i| value.get_ref().get(i));
                let Some(item) = item else { return position };
                position = item.span().start;
                value = item;
            }
            table = value.get_ref().as_table();
        }
        position
    }

    /// Turns the parser's error into a place and a problem.
    fn explain(&self, error: &toml::de::Error) -> MachineError {
        // A body's `kind` makes the parser buffer it and lose positions: ask again, body by body.
        let better = self.body_error();
        let (error, prefix) = match &better {
            Some((error, index)) => (error, format!("body[{index}]")),
            None => (error, String::new()),
        };
        let message = error.message();
        let span = error.span().unwrap_or(0..self.text.len());
        if let Some((found, allowed)) = unknown_key(message) {
            let problem = Problem::UnknownKey {
                hint: unit_hint(found, &allowed),
                allowed: allowed.iter().map(|key| (*key).to_owned()).collect(),
            };
            let position = self.find_key(found, &span).unwrap_or(span.start);
            return self.refuse_at(position, found.to_owned(), problem);
        }
        let around = || self.key_at(&span).unwrap_or(prefix.clone());
        if message.starts_with("missing field") {
            let key = quoted_words(message).first().map_or("", |key| *key);
            let place = if prefix.is_empty() { around() } else { prefix };
            let key = key.to_owned();
            return self.refuse_at(span.start, place, Problem::MissingKey { key });
        }
        let message = message.to_owned();
        self.refuse_at(span.start, around(), Problem::WrongType { message })
    }

    fn body_error(&self) -> Option<(toml::de::Error, usize)> {
        let bodies = get(self.table.get_ref(), "body")?.get_ref().as_array()?;
        for (index, body) in bodies.iter().enumerate() {
            let table = body.get_ref().as_table()?;
            let kind = get(table, "kind").and_then(|kind| kind.get_ref().as_str());
            let fields: DeTable<'_> = table
                .iter()
                .filter(|(name, _)| name.get_ref() != "kind")
                .map(|(name, value)| (name.clone(), value.clone()))
                .collect();
            let value = Spanned::new(body.span(), DeValue::Table(fields));
            let value = toml::de::ValueDeserializer::from(value);
            let error = match kind {
                Some("flexible") => FlexibleBodySpec::deserialize(value).err(),
                Some("rigid") => RigidBodySpec::deserialize(value).err(),
                _ => None,
            };
            if let Some(error) = error {
                return Some((error, index));
            }
        }
        None
    }

    /// First key of that name inside the span, where the parser only knows the enclosing table.
    fn find_key(&self, name: &str, within: &Range<usize>) -> Option<usize> {
        let mut found: Option<usize> = None;
        visit(self.table.get_ref(), &mut |key, span, _| {
            let inside = within.contains(&span.start) || within.is_empty();
            if key == name && inside && found.is_none_or(|f| span.start < f) {
                found = Some(span.start);
            }
        });
        found
    }

    /// The key whose value has this span, or is the smallest that contains it.
    fn key_at(&self, span: &Range<usize>) -> Option<String> {
        let mut best: Option<(usize, String)> = None;
        visit(self.table.get_ref(), &mut |key, _, value| {
            let value = value.span();
            if value.start <= span.start && value.end >= span.end {
                let size = value.len();
                if best.as_ref().is_none_or(|(s, _)| size < *s) {
                    best = Some((size, key.to_owned()));
                }
            }
        });
        best.map(|(_, key)| key)
    }
}

fn get<'a, 't>(table: &'a DeTable<'t>, key: &str) -> Option<&'a Spanned<DeValue<'t>>> {
    table
        .iter()
        .find(|(name, _)| name.get_ref() == key)
        .map(|(_, value)| value)
}

/// Calls `f(key, span of the key, value)` for every key.
fn visit<'a, 't>(table: &'a DeTable<'t>, f: &mut impl FnMut(&str, Range<usize>, &'a Spanned<DeValue<'t>>)) {
    for (name, value) in table {
        f(name.get_ref(), name.span(), value);
        visit_value(value.get_ref(), f);
    }
}

fn visit_value<'a, 't>(
    value: &'a DeValue<'t>,
    f: &mut impl FnMut(&str, Range<usize>, &'a Spanned<DeValue<'t>>),
) {
    if let Some(table) = value.as_table() {
        visit(table, f);
    } else if let Some(array) = value.as_array() {
        for item in array {
            visit_value(item.get_ref(), f);
        }
    }
}

/// Lists of fixed length.
const LIST_LENGTHS: [(&str, usize); 11] = [
    ("gravity_m_per_s2", 3),
    ("axis_start_m", 3),
    ("axis_end_m", 3),
    ("point_m", 3),
    ("near_m", 3),
    ("centre_of_mass_m", 3),
    ("inertia_kg_m2", 6),
    ("range_deg", 2),
    ("range_kg", 2),
    ("between_deg", 2),
    ("start_length_m", 2),
];

/// The unknown key and the allowed ones, from either of the parser's two ways to say so.
fn unknown_key(message: &str) -> Option<(&str, Vec<&str>)> {
    if message.starts_with("unknown field") {
        let quoted = quoted_words(message);
        let (found, allowed) = quoted.split_first()?;
        return Some((found, allowed.to_vec()));
    }
    let rest = message.strip_prefix("unexpected keys in table: ")?;
    let (found, allowed) = rest.split_once(", available keys: ")?;
    Some((found.split(", ").next()?, allowed.split(", ").collect()))
}

fn line_of(text: &str, position: usize) -> usize {
    let end = position.min(text.len());
    let newline = |byte: &&u8| **byte == b'\n';
    1 + text.as_bytes()[..end].iter().filter(newline).count()
}

fn quoted_words(message: &str) -> Vec<&str> {
    message.split('`').skip(1).step_by(2).collect()
}

/// Units that may end a key, longest first, as people read them: ours, and ones that people reach
/// for.
const UNITS: [(&str, &str); 34] = [
    ("_m3_per_s_per_sqrt_pa", "m³/(s √Pa)"),
    ("_l_per_min", "l/min"),
    ("_kg_per_m3", "kg/m³"),
    ("_g_per_cm3", "g/cm³"),
    ("_n_s_per_m", "N s/m"),
    ("_n_per_m3", "N/m³"),
    ("_n_per_mm", "N/mm"),
    ("_m_per_s2", "m/s²"),
    ("_n_per_m", "N/m"),
    ("_m_per_s", "m/s"),
    ("_kg_m2", "kg m²"),
    ("_per_s", "1/s"),
    ("_ratio", "1"),
    ("_mpa", "MPa"),
    ("_gpa", "GPa"),
    ("_kpa", "kPa"),
    ("_bar", "bar"),
    ("_psi", "psi"),
    ("_deg", "degrees"),
    ("_rad", "rad"),
    ("_mm", "mm"),
    ("_cm", "cm"),
    ("_kg", "kg"),
    ("_kn", "kN"),
    ("_ms", "ms"),
    ("_in", "in"),
    ("_pa", "Pa"),
    ("_m3", "m³"),
    ("_t", "t"),
    ("_g", "g"),
    ("_l", "l"),
    ("_n", "N"),
    ("_m", "m"),
    ("_s", "s"),
];

/// A key without its unit, and the unit in words.
fn split_unit(key: &str) -> (&str, Option<&'static str>) {
    UNITS
        .iter()
        .find_map(|(suffix, unit)| Some((key.strip_suffix(suffix)?, Some(*unit))))
        .unwrap_or((key, None))
}

/// What a key with a wrong or missing unit was probably meant to be.
fn unit_hint(found: &str, allowed: &[&str]) -> Option<String> {
    let stem = split_unit(found).0;
    let meant = allowed
        .iter()
        .find(|key| split_unit(key).0 == stem && **key != found)?;
    Some(match split_unit(meant).1 {
        Some(unit) => format!("write `{meant}`, in {unit}"),
        None => format!("write `{meant}`"),
    })
}
