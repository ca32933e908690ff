//! Identifiers. Jobs, trainings, sweeps and shards are things that happen: a time-ordered UUID. Data sets and
//! models are things that are: the first half of a SHA-256 over their content.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
use utoipa::ToSchema;
use uuid::Uuid;

/// A text that is not an identifier of the kind asked for.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is not {expected}")]
pub struct IdError {
    /// The text as given.
    pub text: String,
    /// What an identifier of this kind looks like.
    pub expected: &'static str,
}

macro_rules! event_id {
    ($name:ident, $doc:literal) => {
        #[doc = $doc]
        #[derive(
            Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
        )]
        #[serde(transparent)]
        #[schema(value_type = String, format = "uuid", example = "019aaf3e-5d2c-7c31-9d0f-3c1f5a5e8d10")]
        pub struct $name(Uuid);

        impl $name {
            /// A new identifier; later ones sort after earlier ones.
            #[must_use]
            pub fn generate() -> Self {
                Self(Uuid::now_v7())
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(f)
            }
        }

        impl FromStr for $name {
            type Err = IdError;
            fn from_str(text: &str) -> Result<Self, IdError> {
                // One spelling per identifier: the hyphenated lower-case one that we hand out.
                match Uuid::parse_str(text) {
                    Ok(id) if id.to_string() == text => Ok(Self(id)),
                    _ => Err(IdError {
                        text: text.to_owned(),
                        expected: "a UUID such as 019aaf3e-5d2c-7c31-9d0f-3c1f5a5e8d10",
                    }),
                }
            }
        }
    };
}

event_id!(JobId, "A job.");
event_id!(TrainingId, "A training.");
event_id!(SweepId, "A sweep: many trainings on one data set.");
event_id!(ShardId, "A shard of a job: what one worker holds at a time.");

macro_rules! content_id {
    ($name:ident, $doc:literal) => {
        #[doc = $doc]
        #[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema)]
        #[serde(try_from = "String", into = "String")]
        #[schema(value_type = String, pattern = "^[0-9a-f]{32}$", example = "9f86d081884c7d659a2feaa0c55ad015")]
        pub struct $name(String);

        impl $name {
            /// The identifier of the content with this SHA-256 (64 lower-case hexadecimal digits).
            ///
            /// # Errors
            /// Refuses anything else.
            pub fn of_sha256(sha256: &str) -> Result<Self, IdError> {
                match sha256.get(..32) {
                    Some(head) if sha256.len() == 64 && is_lower_hex(sha256) => Ok(Self(head.to_owned())),
                    _ => Err(IdError { text: sha256.to_owned(), expected: "64 hexadecimal digits" }),
                }
            }

            /// As text.
            #[must_use]
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }

        impl FromStr for $name {
            type Err = IdError;
            fn from_str(text: &str) -> Result<Self, IdError> {
                if text.len() == 32 && is_lower_hex(text) {
                    Ok(Self(text.to_owned()))
                } else {
                    Err(IdError { text: text.to_owned(), expected: "32 lower-case hexadecimal digits" })
                }
            }
        }

        impl TryFrom<String> for $name {
            type Error = IdError;
            fn try_from(text: String) -> Result<Self, IdError> {
                text.parse()
            }
        }

        impl From<$name> for String {
            fn from(id: $name) -> Self {
                id.0
            }
        }
    };
}

content_id!(DatasetId, "A data set, by its content.");
content_id!(ModelId, "A model, by its content.");

/// A name that points at a model and can be moved to another one: `boom@stable`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "String", into = "String")]
#[schema(
    value_type = String,
    pattern = "^[a-z0-9][a-z0-9_.-]{0,62}@[a-z0-9][a-z0-9_.-]{0,62}$",
    example = "boom@stable"
)]
pub struct AliasName(String);

impl AliasName {
    /// As text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for AliasName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for AliasName {
    type Err = IdError;
    fn from_str(text: &str) -> Result<Self, IdError> {
        let is_part = |part: &str| {
            let first = part.bytes().next();
            let is_letter = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit();
            part.len() <= 63
                && first.is_some_and(is_letter)
                && part.bytes().all(|byte| is_letter(byte) || b"_.-".contains(&byte))
        };
        match text.split_once('@') {
            Some((name, tag)) if is_part(name) && is_part(tag) => Ok(Self(text.to_owned())),
            _ => Err(IdError {
                text: text.to_owned(),
                expected: "an alias such as boom@stable: two parts of lower-case letters, digits, `_`, `.`, `-`",
            }),
        }
    }
}

impl TryFrom<String> for AliasName {
    type Error = IdError;
    fn try_from(text: String) -> Result<Self, IdError> {
        text.parse()
    }
}

impl From<AliasName> for String {
    fn from(name: AliasName) -> Self {
        name.0
    }
}

/// A model by its content or by a name that points at it.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum ModelRef {
    /// By its content: always the same model.
    Id(ModelId),
    /// By the name that points at it now.
    Alias(AliasName),
}

impl fmt::Display for ModelRef {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Id(id) => id.fmt(f),
            Self::Alias(alias) => alias.fmt(f),
        }
    }
}

impl FromStr for ModelRef {
    type Err = IdError;
    fn from_str(text: &str) -> Result<Self, IdError> {
        if let Ok(id) = text.parse() {
            return Ok(Self::Id(id));
        }
        text.parse().map(Self::Alias).map_err(|_| IdError {
            text: text.to_owned(),
            expected: "a model (32 lower-case hexadecimal digits) or an alias such as boom@stable",
        })
    }
}

fn is_lower_hex(text: &str) -> bool {
    text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn content_ids_are_the_first_half_of_the_hash() {
        let hash = "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08";
        let id = DatasetId::of_sha256(hash).unwrap();
        assert_eq!(id.as_str(), "9f86d081884c7d659a2feaa0c55ad015");
        assert_eq!(id.as_str().parse::<DatasetId>().unwrap(), id);
    }

    #[test]
    fn ids_that_could_name_a_path_are_refused() {
        for text in [
            "",
            "../../etc/passwd",
            "9F86D081884C7D659A2FEAA0C55AD015",
            "9f86d081884c7d65",
        ] {
            assert!(text.parse::<DatasetId>().is_err(), "{text}");
            assert!(text.parse::<JobId>().is_err(), "{text}");
        }
        assert!("019AAF3E-5D2C-7C31-9D0F-3C1F5A5E8D10".parse::<JobId>().is_err());
    }
    #[test]
    fn aliases_are_two_plain_words() {
        for text in ["boom@stable", "a@b", "crane-2.1@2026_11"] {
            assert_eq!(text.parse::<AliasName>().unwrap().to_string(), text);
            assert!(matches!(text.parse::<ModelRef>(), Ok(ModelRef::Alias(_))));
        }
        let long = "x".repeat(64);
        for text in [
            "",
            "@",
            "boom",
            "boom@",
            "@stable",
            "Boom@stable",
            "boom@a@b",
            "../x@y",
            "boom@..",
            "boom@a/b",
            &format!("{long}@a"),
        ] {
            assert!(text.parse::<AliasName>().is_err(), "{text}");
        }
        let id = "9f86d081884c7d659a2feaa0c55ad015";
        assert!(matches!(id.parse::<ModelRef>(), Ok(ModelRef::Id(_))));
    }
}
