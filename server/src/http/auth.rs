//! API keys: who may do what.
//!
//! ```text
//! Authorization: Bearer hfx_…   GET → read · POST …/predict, …/infer → predict · other changes → submit
//! ```
//!
//! Open to everybody: health, the page that describes the interface, and its document.

use super::AppState;
use super::error::ApiError;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, Method, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use hydroflex_ledger::keys::{self, KeyRecord, Scope};
use hydroflex_ledger::{Ledger, LedgerError, clock};
use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// How long an answer of the ledger about a key is believed: a prediction must not wait for the
/// database. A revoked key opens nothing after this time.
const BELIEVED: Duration = Duration::from_secs(5);

/// Keys remembered; guesses must not fill the memory.
const REMEMBERED: usize = 1024;

/// The door. One per service.
pub struct Door {
    locked: bool,
    seen: Mutex<HashMap<String, (Option<KeyRecord>, Instant)>>,
}

impl Door {
    /// A door that asks for keys, or one that stands open.
    #[must_use]
    pub fn new(locked: bool) -> Self {
        Self {
            locked,
            seen: Mutex::default(),
        }
    }

    async fn key(&self, ledger: &Ledger, key: &str) -> Result<Option<KeyRecord>, LedgerError> {
        let sha256 = keys::hash(key);
        let remembered = {
            let seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
            seen.get(&sha256)
                .filter(|(_, at)| at.elapsed() < BELIEVED)
                .map(|(record, _)| record.clone())
        };
        if let Some(record) = remembered {
            return Ok(record);
        }
        let record = ledger.key(&sha256).await?;
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        if seen.len() >= REMEMBERED {
            seen.clear();
        }
        seen.insert(sha256, (record.clone(), Instant::now()));
        Ok(record)
    }
}

/// What a request needs; `None` if everybody may.
fn needed(method: &Method, path: &str) -> Option<Scope> {
    let is_guarded = path == "/metrics" || ["/v1/", "/v2/"].iter().any(|root| path.starts_with(root));
    if !is_guarded {
        return None;
    }
    let last = path.trim_end_matches('/').rsplit('/').next().unwrap_or_default();
    let is_estimate = ["predict", "infer", "stream"].contains(&last);
    Some(match *method {
        _ if is_estimate => Scope::Predict,
        Method::GET | Method::HEAD | Method::OPTIONS => Scope::Read,
        _ => Scope::Submit,
    })
}

fn bearer(headers: &HeaderMap) -> Option<&str> {
    let value = headers.get(header::AUTHORIZATION)?.to_str().ok()?;
    let (scheme, key) = value.split_once(' ')?;
    scheme.eq_ignore_ascii_case("bearer").then_some(key.trim())
}

/// Lets a request through, or says what it lacks.
pub async fn guard(State(state): State<AppState>, request: Request, next: Next) -> Response {
    let scope = needed(request.method(), request.uri().path());
    match check(&state, scope, request.headers()).await {
        Ok(()) => next.run(request).await,
        Err(error) => error.into_response(),
    }
}

async fn check(state: &AppState, scope: Option<Scope>, headers: &HeaderMap) -> Result<(), ApiError> {
    let door = state.door();
    let Some(scope) = scope.filter(|_| door.locked) else {
        return Ok(());
    };
    let key = bearer(headers).ok_or_else(|| {
        ApiError::Unauthorized("this service asks for a key: Authorization: Bearer KEY (`hydroflex key create`, where the service runs, makes one)"
                .to_owned())
    })?;
    // Unknown and ended keys get the same answer at the same cost: a lookup by hash.
    let record = door
        .key(state.ledger(), key)
        .await?
        .ok_or_else(|| ApiError::Unauthorized("the key is not known here".to_owned()))?;
    if let Some(why) = record.ended(clock::now_ms()) {
        return Err(ApiError::Unauthorized(format!("the key {} is {why}", record.id)));
    }
    if record.opens(scope) {
        Ok(())
    } else {
        let own: Vec<&str> = record.scopes.iter().map(|scope| scope.as_str()).collect();
        Err(ApiError::Forbidden(format!(
            "this needs the scope {scope}; the key {} has {}",
            record.id,
            own.join(", ")
        )))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_path_needs_the_scope_that_its_method_says() {
        for (method, path, scope) in [
            (Method::GET, "/health/ready", None),
            (Method::GET, "/docs/", None),
            (Method::GET, "/openapi.json", None),
            (Method::GET, "/metrics", Some(Scope::Read)),
            (Method::GET, "/v1/jobs", Some(Scope::Read)),
            (Method::HEAD, "/v1/datasets/x/files/README.md", Some(Scope::Read)),
            (Method::POST, "/v1/jobs", Some(Scope::Submit)),
            (Method::POST, "/v1/jobs/x/cancel", Some(Scope::Submit)),
            (Method::DELETE, "/v1/jobs/x", Some(Scope::Submit)),
            (Method::POST, "/v1/models/x/predict", Some(Scope::Predict)),
            (Method::GET, "/v1/models/x/stream", Some(Scope::Predict)),
            (Method::POST, "/v2/models/x/infer", Some(Scope::Predict)),
            (Method::GET, "/v2/health/ready", Some(Scope::Read)),
        ] {
            assert_eq!(needed(&method, path), scope, "{method} {path}");
        }
    }

    #[test]
    fn a_bearer_key_is_read_and_nothing_else() {
        let read = |value: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::AUTHORIZATION, value.parse().unwrap());
            bearer(&headers).map(str::to_owned)
        };
        assert_eq!(read("Bearer hfx_1").as_deref(), Some("hfx_1"));
        assert_eq!(read("bearer  hfx_1 ").as_deref(), Some("hfx_1"));
        assert_eq!(read("Basic hfx_1"), None);
        assert_eq!(read("hfx_1"), None);
    }
}
