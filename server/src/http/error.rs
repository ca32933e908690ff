//! The one map from errors to statuses: everything that is not a success is a [`Problem`].

use axum::Json;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use hydroflex_ledger::LedgerError;
use hydroflex_ledger::blobs::BlobError;
use hydroflex_openapi::problem::{FieldError, PROBLEM_MEDIA_TYPE, Problem};

/// Why a request was not fulfilled.
#[derive(Debug)]
pub enum ApiError {
    /// No key, or one that is not valid.
    Unauthorized(String),
    /// The key is valid, and not for this.
    Forbidden(String),
    /// Nothing is at that address.
    NotFound(String),
    /// The address exists, the method does not.
    MethodNotAllowed(String),
    /// The body is not JSON, or cannot be read.
    Malformed(String),
    /// The body is JSON, but says something that is not allowed.
    Invalid(Vec<FieldError>),
    /// The request does not go with the state of things.
    Conflict(String),
    /// The idempotency key was used with another body.
    KeyReused(String),
    /// The body is not of a type that is read here.
    MediaType(String),
    /// The body is too large.
    TooLarge {
        /// Largest body.
        limit_bytes: u64,
    },
    /// The range lies outside the file.
    RangeNotSatisfiable {
        /// Size of the file.
        size_bytes: u64,
    },
    /// No form of an answer that the caller takes is given here.
    NotAcceptable(String),
    /// The state of things is not what the request's condition says.
    PreconditionFailed(String),
    /// The address speaks another protocol.
    UpgradeRequired(String),
    /// As much as can be done is being done.
    TooManyRequests(String),
    /// The service cannot answer now.
    Unavailable(String),
    /// The service is at fault.
    Internal(String),
}

impl ApiError {
    /// One field at fault.
    #[must_use]
    pub fn field(error: FieldError) -> Self {
        Self::Invalid(vec![error])
    }

    #[allow(clippy::too_many_lines, reason = "one line of the map after the other")]
    fn parts(self) -> (StatusCode, &'static str, &'static str, String, Vec<FieldError>) {
        match self {
            Self::Unauthorized(detail) => (
                StatusCode::UNAUTHORIZED,
                "unauthorized",
                "Unauthorized",
                detail,
                Vec::new(),
            ),
            Self::Forbidden(detail) => (
                StatusCode::FORBIDDEN,
                "forbidden",
                "Forbidden",
                detail,
                Vec::new(),
            ),
            Self::NotFound(detail) => (
                StatusCode::NOT_FOUND,
                "not-found",
                "Not found",
                detail,
                Vec::new(),
            ),
            Self::MethodNotAllowed(detail) => (
                StatusCode::METHOD_NOT_ALLOWED,
                "method-not-allowed",
                "Method not allowed",
                detail,
                Vec::new(),
            ),
            Self::Malformed(detail) => (
                StatusCode::BAD_REQUEST,
                "malformed",
                "Malformed request",
                detail,
                Vec::new(),
            ),
            Self::Invalid(errors) => {
                let detail = match errors.as_slice() {
                    [one] => format!("{}: {}", one.pointer, one.detail),
                    many => format!("{} fields are not acceptable", many.len()),
                };
                (
                    StatusCode::UNPROCESSABLE_ENTITY,
                    "invalid-field",
                    "Invalid field",
                    detail,
                    errors,
                )
            }
            Self::Conflict(detail) => (StatusCode::CONFLICT, "conflict", "Conflict", detail, Vec::new()),
            Self::KeyReused(detail) => (
                StatusCode::UNPROCESSABLE_ENTITY,
                "idempotency-key-reused",
                "Idempotency key reused",
                detail,
                Vec::new(),
            ),
            Self::MediaType(detail) => (
                StatusCode::UNSUPPORTED_MEDIA_TYPE,
                "unsupported-media-type",
                "Unsupported media type",
                detail,
                Vec::new(),
            ),
            Self::TooLarge { limit_bytes } => (
                StatusCode::PAYLOAD_TOO_LARGE,
                "too-large",
                "Body too large",
                format!("at most {limit_bytes} bytes are read here"),
                Vec::new(),
            ),
            Self::RangeNotSatisfiable { size_bytes } => (
                StatusCode::RANGE_NOT_SATISFIABLE,
                "range-not-satisfiable",
                "Range not satisfiable",
                format!("the file has {size_bytes} bytes"),
                Vec::new(),
            ),
            Self::NotAcceptable(detail) => (
                StatusCode::NOT_ACCEPTABLE,
                "not-acceptable",
                "Not acceptable",
                detail,
                Vec::new(),
            ),
            Self::PreconditionFailed(detail) => (
                StatusCode::PRECONDITION_FAILED,
                "precondition-failed",
                "Precondition failed",
                detail,
                Vec::new(),
            ),
            Self::UpgradeRequired(detail) => (
                StatusCode::UPGRADE_REQUIRED,
                "upgrade-required",
                "Upgrade required",
                detail,
                Vec::new(),
            ),
            Self::TooManyRequests(detail) => (
                StatusCode::TOO_MANY_REQUESTS,
                "too-many-requests",
                "Too many requests",
                detail,
                Vec::new(),
            ),
            Self::Unavailable(detail) => (
                StatusCode::SERVICE_UNAVAILABLE,
                "unavailable",
                "Unavailable",
                detail,
                Vec::new(),
            ),
            Self::Internal(detail) => {
                // The reader of the log can act on the cause; the caller cannot.
                tracing::error!(cause = detail, "request failed");
                (
                    StatusCode::INTERNAL_SERVER_ERROR,
                    "internal",
                    "Internal error",
                    "the service failed; its log says why".to_owned(),
                    Vec::new(),
                )
            }
        }
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let size = match &self {
            Self::RangeNotSatisfiable { size_bytes } => Some(*size_bytes),
            _ => None,
        };
        let (status, kind, title, detail, errors) = self.parts();
        let problem = Problem {
            kind: format!("/problems/{kind}"),
            title: title.to_owned(),
            status: status.as_u16(),
            detail,
            errors,
        };
        let mut response = (status, Json(problem)).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(PROBLEM_MEDIA_TYPE));
        let retry_after = match status {
            StatusCode::SERVICE_UNAVAILABLE => Some("2"),
            StatusCode::TOO_MANY_REQUESTS => Some("1"),
            _ => None,
        };
        if let Some(seconds) = retry_after {
            headers.insert(header::RETRY_AFTER, HeaderValue::from_static(seconds));
        }
        if status == StatusCode::UPGRADE_REQUIRED {
            headers.insert(header::UPGRADE, HeaderValue::from_static("websocket"));
        }
        if status == StatusCode::UNAUTHORIZED {
            headers.insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
        }
        if let Some(size) = size
            && let Ok(value) = HeaderValue::from_str(&format!("bytes */{size}"))
        {
            headers.insert(header::CONTENT_RANGE, value);
        }
        response
    }
}

impl From<LedgerError> for ApiError {
    fn from(error: LedgerError) -> Self {
        match error {
            LedgerError::KeyReused { .. } => Self::KeyReused(error.to_string()),
            LedgerError::NoJob { .. } => Self::NotFound(error.to_string()),
            _ if error.is_transient() => Self::Unavailable(error.to_string()),
            _ => Self::Internal(error.to_string()),
        }
    }
}

impl From<BlobError> for ApiError {
    fn from(error: BlobError) -> Self {
        match error {
            BlobError::Store(_) => Self::Unavailable(error.to_string()),
            _ => Self::Internal(error.to_string()),
        }
    }
}
