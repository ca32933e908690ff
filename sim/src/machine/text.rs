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
        match toml::from_str::<MachineFile>(text) {
            Ok(file) => Ok((parsed, file)),
            Err(error) => Err(parsed.explain(&error)),
        }
    }

    /// Refuses the value at a key path such as `body[0].interface[1].select`.
    pub(super) fn refuse(&self, key: impl Into<String>, problem: Problem) -> MachineError {
        let key = key.into();
        MachineError::Refused {
            place: Place {
                file: self.name.to_owned(),
                line: Some(line_of(self.text, self.position(&key))),
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
        let quoted = quoted_words(message);
        let (problem, position, key) = if message.starts_with("unknown field") {
            let (found, allowed) = quoted.split_first().map_or(("", &[][..]), |(f, a)| (*f, a));
            let problem = Problem::UnknownKey {
                hint: unit_hint(found, allowed),
                allowed: allowed.iter().map(|a| (*a).to_owned()).collect(),
            };
            let position = self.find_key(found, &span).unwrap_or(span.start);
            (problem, position, found.to_owned())
        } else if message.starts_with("missing field") {
            let key = quoted.first().map_or("", |key| *key).to_owned();
            (Problem::MissingKey { key }, span.start, prefix)
        } else {
            let message = message.to_owned();
            let key = self.key_at(&span).unwrap_or(prefix);
            (Problem::WrongType { message }, span.start, key)
        };
        MachineError::Refused {
            place: Place {
                file: self.name.to_owned(),
                line: Some(line_of(self.text, position)),
                key,
            },
            problem: Box::new(problem),
        }
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
            if key == name && found.is_none_or(|f| span.start < f) && span.start >= within.start {
                found = Some(span.start);
            }
        });
        found
    }

    /// The key whose value has this span, or is the smallest that contains it.
    fn key_at(&self, span: &Range<usize>) -> Option<String> {
        let mut best: Option<(usize, String)> = None;
        visit(self.table.get_ref(), &mut |key, _, value| {
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

/// Calls `f(key, span of the key, span of the value)` for every key.
fn visit(table: &DeTable<'_>, f: &mut impl FnMut(&str, Range<usize>, Range<usize>)) {
    for (name, value) in table {
        f(name.get_ref(), name.span(), value.span());
        visit_value(value.get_ref(), f);
    }
}

fn visit_value(value: &DeValue<'_>, f: &mut impl FnMut(&str, Range<usize>, Range<usize>)) {
    if let Some(table) = value.as_table() {
        visit(table, f);
    } else if let Some(array) = value.as_array() {
        for item in array {
            visit_value(item.get_ref(), f);
        }
    }
}

fn line_of(text: &str, position: usize) -> usize {
    let end = position.min(text.len());
    1 + text.as_bytes()[..end]
        .iter()
        .filter(|byte| **byte == b'\n')
        .count()
}

fn quoted_words(message: &str) -> Vec<&str> {
    message.split('`').skip(1).step_by(2).collect()
}

/// Units that may end a key, longest first: ours, and ones that people reach for.
const UNITS: [&str; 34] = [
    "_m3_per_s_per_sqrt_pa",
    "_l_per_min",
    "_kg_per_m3",
    "_g_per_cm3",
    "_n_s_per_m",
    "_n_per_m3",
    "_n_per_mm",
    "_m_per_s2",
    "_n_per_m",
    "_m_per_s",
    "_kg_m2",
    "_per_s",
    "_ratio",
    "_mpa",
    "_gpa",
    "_kpa",
    "_bar",
    "_psi",
    "_deg",
    "_rad",
    "_mm",
    "_cm",
    "_kg",
    "_kn",
    "_ms",
    "_in",
    "_pa",
    "_m3",
    "_t",
    "_g",
    "_l",
    "_n",
    "_m",
    "_s",
];

fn stem(key: &str) -> &str {
    UNITS
        .iter()
        .find_map(|unit| key.strip_suffix(unit))
        .unwrap_or(key)
}

/// What a key with a wrong or missing unit was probably meant to be.
fn unit_hint(found: &str, allowed: &[&str]) -> Option<String> {
    let meant = allowed
        .iter()
        .find(|key| stem(key) == stem(found) && **key != found)?;
    let unit = meant.strip_prefix(stem(meant))?.trim_start_matches('_');
    Some(if unit.is_empty() {
        format!("write `{meant}`")
    } else {
        format!("write `{meant}`; the unit is {}", unit.replace('_', " "))
    })
}
