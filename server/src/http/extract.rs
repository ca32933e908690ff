//! Reading requests: every refusal names the field, the value and what is allowed.

use super::error::ApiError;
use axum::Json;
use axum::body::Bytes;
use axum::extract::{FromRequest, FromRequestParts, Path, Query, Request};
use axum::http::request::Parts;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use hydroflex_ledger::IdempotencyKey;
use hydroflex_openapi::problem::FieldError;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_path_to_error::Segment;
use std::str::FromStr;
use utoipa::IntoParams;

/// Largest JSON body: a job with given valve signals of a long run, or a long recording to estimate.
pub const BODY_LIMIT_BYTES: usize = 32 << 20;

/// A JSON body, with its bytes.
pub struct JsonBody<T> {
    /// What it says.
    pub value: T,
    /// As it was sent.
    pub bytes: Bytes,
}

impl<S: Send + Sync, T: DeserializeOwned> FromRequest<S> for JsonBody<T> {
    type Rejection = ApiError;

    async fn from_request(request: Request, state: &S) -> Result<Self, ApiError> {
        let media_type = request
            .headers()
            .get(header::CONTENT_TYPE)
            .and_then(|value| value.to_str().ok())
            .and_then(|value| value.split(';').next())
            .map(|value| value.trim().to_ascii_lowercase());
        match media_type.as_deref() {
            Some(json) if json == "application/json" || json.ends_with("+json") => {}
            other => {
                return Err(ApiError::MediaType(format!(
                    "content-type is {:?}, application/json is read here",
                    other.unwrap_or("missing")
                )));
            }
        }
        let bytes = Bytes::from_request(request, state).await.map_err(|rejection| {
            if rejection.status() == axum::http::StatusCode::PAYLOAD_TOO_LARGE {
                ApiError::TooLarge {
                    limit_bytes: BODY_LIMIT_BYTES as u64,
                }
            } else {
                ApiError::Malformed(rejection.body_text())
            }
        })?;
        let value = parse_json(&bytes)?;
        Ok(Self { value, bytes })
    }
}

/// Parses a body, naming the field at fault by JSON pointer.
///
/// # Errors
/// [`ApiError::Malformed`] if it is not JSON, [`ApiError::Invalid`] if it says the wrong thing.
pub fn parse_json<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, ApiError> {
    let mut deserializer = serde_json::Deserializer::from_slice(bytes);
    let error = match serde_path_to_error::deserialize(&mut deserializer) {
        Ok(value) => match deserializer.end() {
            Ok(()) => return Ok(value),
            Err(error) => return Err(ApiError::Malformed(format!("not JSON: {error}"))),
        },
        Err(error) => error,
    };
    let document: serde_json::Value =
        serde_json::from_slice(bytes).map_err(|error| ApiError::Malformed(format!("not JSON: {error}")))?;
    let mut pointer = String::new();
    for segment in error.path() {
        match segment {
            Segment::Seq { index } => pointer.extend(["/", &index.to_string()]),
            Segment::Map { key } => {
                pointer.extend(["/", &key.replace('~', "~0").replace('/', "~1")]);
            }
            Segment::Enum { .. } | Segment::Unknown => {}
        }
    }
    let text = error.into_inner().to_string();
    // serde_json adds where in the text it stopped; the pointer says it better.
    let text = text
        .rsplit_once(" at line ")
        .map_or(text.as_str(), |(head, _)| head);
    let (detail, allowed) = match text.split_once(", expected ") {
        Some((head, expected)) => (head, Some(in_words_of_json(expected))),
        None => (text, None),
    };
    let detail = match detail {
        "invalid type: map" => "invalid type: an object",
        "invalid type: sequence" => "invalid type: a list",
        other => other,
    };
    // An unknown field is the fault of that field, not of the object that holds it.
    if let Some(name) = detail
        .strip_prefix("unknown field `")
        .and_then(|rest| rest.strip_suffix('`'))
        && document
            .pointer(&pointer)
            .and_then(serde_json::Value::as_object)
            .is_some_and(|object| object.contains_key(name))
    {
        pointer.extend(["/", &name.replace('~', "~0").replace('/', "~1")]);
    }
    let mut field = FieldError::new(pointer.clone(), detail);
    if let Some(value) = document.pointer(&pointer) {
        // A whole signal need not be sent back.
        if !(value.is_array() || value.is_object()) {
            field = field.value(value.clone());
        }
    }
    if let Some(allowed) = allowed {
        field = field.allowed(allowed);
    }
    Err(ApiError::field(field))
}

/// What serde expects, as somebody who writes JSON calls it.
fn in_words_of_json(expected: &str) -> &str {
    match expected {
        "f64" | "f32" => "a number",
        "u8" | "u16" | "u32" | "u64" | "usize" => "a whole number, 0 or more",
        "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number",
        "a sequence" => "a list",
        "a map" => "an object",
        "string or map" => "a string or an object",
        other if other.starts_with("internally tagged enum WindowRule") => "an object with `rule`",
        other if other.starts_with("internally tagged enum ") => "an object with `kind`",
        other if other.starts_with("struct ") => "an object",
        other => other,
    }
}

/// An identifier in the path. One that cannot exist is not found, like one that does not.
pub struct Id<T>(pub T);

impl<S: Send + Sync, T: FromStr<Err: std::fmt::Display> + Send> FromRequestParts<S> for Id<T> {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ApiError> {
        let Path(text) = Path::<String>::from_request_parts(parts, state)
            .await
            .map_err(|rejection| ApiError::NotFound(rejection.body_text()))?;
        text.parse()
            .map(Self)
            .map_err(|error: T::Err| ApiError::NotFound(error.to_string()))
    }
}

/// An identifier and the path of a file below it.
pub struct IdAndFile<T>(pub T, pub String);

impl<S: Send + Sync, T: FromStr<Err: std::fmt::Display> + Send> FromRequestParts<S> for IdAndFile<T> {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ApiError> {
        let Path((id, file)) = Path::<(String, String)>::from_request_parts(parts, state)
            .await
            .map_err(|rejection| ApiError::NotFound(rejection.body_text()))?;
        let id = id
            .parse()
            .map_err(|error: T::Err| ApiError::NotFound(error.to_string()))?;
        Ok(Self(id, file))
    }
}

/// Which page of a list.
#[derive(Debug, Clone, Default, serde::Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct PageQuery {
    /// Entries on a page, 1 to 200; 50 if absent.
    #[serde(default)]
    #[param(minimum = 1, maximum = 200)]
    limit: Option<String>,
    /// `next_cursor` of the page before.
    #[serde(default)]
    cursor: Option<String>,
}

/// A page as asked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Page {
    /// Entries on it.
    pub limit: u64,
    /// Where the page before ended.
    pub cursor: Option<String>,
}

impl<S: Send + Sync> FromRequestParts<S> for Page {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ApiError> {
        let Query(query) = Query::<PageQuery>::from_request_parts(parts, state)
            .await
            .map_err(|rejection| ApiError::Malformed(rejection.body_text()))?;
        let limit = match query.limit {
            None => 50,
            Some(text) => {
                if let Ok(limit @ 1..=200) = text.parse() {
                    limit
                } else {
                    let error = FieldError::new("?limit", "not a page size")
                        .value(text)
                        .allowed("1 to 200");
                    return Err(ApiError::field(error));
                }
            }
        };
        Ok(Self {
            limit,
            cursor: query.cursor,
        })
    }
}

impl Page {
    /// Entries to ask for: one more says whether there is another page.
    #[must_use]
    pub fn ask(&self) -> u64 {
        self.limit + 1
    }

    /// Cuts what was asked for to the page; the cursor of the next one, if there is one, names its last entry.
    pub fn cut<T, C: ToString>(
        &self,
        records: &mut Vec<T>,
        cursor_of: impl FnOnce(&T) -> C,
    ) -> Option<String> {
        let limit = usize::try_from(self.limit).unwrap_or(usize::MAX);
        let more = records.len() > limit;
        records.truncate(limit);
        let last = records.last().filter(|_| more)?;
        Some(cursor_of(last).to_string())
    }

    /// The cursor in its own type.
    ///
    /// # Errors
    /// Names the cursor if no page ended with it.
    pub fn after<T: FromStr>(&self) -> Result<Option<T>, ApiError> {
        self.cursor
            .as_ref()
            .map(|text| {
                text.parse().map_err(|_| {
                    let error = FieldError::new("?cursor", "not a cursor")
                        .value(text.as_str())
                        .allowed("the next_cursor of an earlier page");
                    ApiError::field(error)
                })
            })
            .transpose()
    }
}

/// Place in a list ordered by time and identifier.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TimeCursor {
    /// Time of the last entry, ms since 1970.
    pub ms: i64,
    /// Its identifier.
    pub id: String,
}

impl std::fmt::Display for TimeCursor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:x}-{}", self.ms, self.id)
    }
}

impl FromStr for TimeCursor {
    type Err = ();
    fn from_str(text: &str) -> Result<Self, ()> {
        let (ms, id) = text.split_once('-').ok_or(())?;
        let ms = i64::from_str_radix(ms, 16).map_err(drop)?;
        if id.len() == 32 {
            Ok(Self {
                ms,
                id: id.to_owned(),
            })
        } else {
            Err(())
        }
    }
}

impl TimeCursor {
    /// The cursor of an entry.
    pub fn new(ms: i64, id: &impl ToString) -> Self {
        Self {
            ms,
            id: id.to_string(),
        }
    }
}

/// The `Idempotency-Key` header with the body it goes with.
///
/// # Errors
/// Names the header if it is not 1 to 128 visible characters.
pub fn idempotency_key(headers: &HeaderMap, body: &[u8]) -> Result<Option<IdempotencyKey>, ApiError> {
    let Some(value) = headers.get("idempotency-key") else {
        return Ok(None);
    };
    match value.to_str() {
        Ok(key) if (1..=128).contains(&key.len()) => Ok(Some(IdempotencyKey::new(key, body))),
        _ => Err(ApiError::field(
            FieldError::new("Idempotency-Key", "not a key").allowed("1 to 128 visible ASCII characters"),
        )),
    }
}

/// What was asked for is accepted: where to look for it, and after how many seconds.
pub fn accepted<T: Serialize>(location: String, look_after_s: u32, status: T) -> Response {
    (
        StatusCode::ACCEPTED,
        [
            (header::LOCATION, location),
            (header::RETRY_AFTER, look_after_s.to_string()),
        ],
        Json(status),
    )
        .into_response()
}

#[cfg(test)]
mod tests {
    use super::*;
    use hydroflex_openapi::job::JobSpec;

    fn refusal(body: &str) -> FieldError {
        match parse_json::<JobSpec>(body.as_bytes()) {
            Err(ApiError::Invalid(mut errors)) => errors.remove(0),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_field_at_fault_is_named() {
        let wrong_type = refusal(r#"{"runs": 80, "split": {"train": "most", "validation": 0.2}}"#);
        assert_eq!(wrong_type.pointer, "/split/train");
        assert_eq!(wrong_type.value, Some("most".into()));
        assert_eq!(wrong_type.allowed.as_deref(), Some("a number"));

        let unknown = refusal(r#"{"runs": 80, "split": {"training": 0.8, "validation": 0.2}}"#);
        assert_eq!(unknown.pointer, "/split/training");
        assert_eq!(unknown.detail, "unknown field `training`");
        assert!(unknown.allowed.is_some_and(|allowed| allowed.contains("`train`")));

        let missing = refusal("{}");
        assert_eq!(
            (missing.pointer.as_str(), missing.detail.as_str()),
            ("", "missing field `runs`")
        );

        let nested = refusal(r#"{"runs": 80, "initial_angle_rad": {"min": 0}}"#);
        assert_eq!(nested.pointer, "/initial_angle_rad");
        let range = refusal(r#"{"runs": 80, "payload_kg": [0, 100]}"#);
        assert_eq!(
            (range.pointer.as_str(), range.detail.as_str()),
            ("/payload_kg", "invalid value")
        );
        assert!(range.allowed.is_some_and(|allowed| allowed.contains("min")));
        let step = refusal(r#"{"runs": 80, "integrator": {"kind": "accurate", "step_s": 0.01}}"#);
        assert_eq!(step.pointer, "/integrator");
        assert!(
            step.detail.contains("0.01") && step.allowed.is_some(),
            "{}",
            step.detail
        );
        let object = refusal(r#"{"runs": 80, "train": {}}"#);
        assert_eq!(
            (object.detail.as_str(), object.allowed.as_deref()),
            ("invalid type: an object", Some("a list"))
        );

        let negative = refusal(r#"{"runs": -3}"#);
        assert_eq!(negative.pointer, "/runs");
        assert_eq!(negative.value, Some((-3).into()));
    }

    #[test]
    fn what_is_not_json_is_malformed() {
        for body in ["", "{", "{\"runs\": 80} {}", "\u{0}", &"[".repeat(100_000)] {
            assert!(
                matches!(
                    parse_json::<JobSpec>(body.as_bytes()),
                    Err(ApiError::Malformed(_))
                ),
                "{body:.20}"
            );
        }
    }

    #[test]
    fn cursors_come_back_as_they_were() {
        let cursor = TimeCursor {
            ms: 1_763_800_000_123,
            id: "9f86d081884c7d659a2feaa0c55ad015".to_owned(),
        };
        assert_eq!(cursor.to_string().parse(), Ok(cursor));
        assert!("zz".parse::<TimeCursor>().is_err());
    }
}
