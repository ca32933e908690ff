//! `/v2`: the Open Inference Protocol over HTTP, for clients such as `tritonclient[http]`.
//!
//! A model's name is its identifier or an alias (`boom@stable`). Versions of an alias are the models
//! that it has pointed at, counted from 1; a bare name takes the tag as its version (`boom`, `stable`).

use super::AppState;
use super::body::{self, CLOSING, NotReceived, Received};
use crate::prediction::LoadedModel;
use crate::prediction::gate::{Busy, Work};
use crate::prediction::infer::{self, HEADER_LENGTH, Output, WINDOW};
use crate::prediction::registry::ModelUnusable;
use axum::Json;
use axum::body::Body;
use axum::extract::{FromRequestParts, Path, State};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use hydroflex_openapi::id::{AliasName, ModelId, ModelRef};
use hydroflex_openapi::inference::{
    InferError, InferRequest, InferResponse, ModelMetadata, ModelParameters, ModelReady, ServerLive,
    ServerMetadata, ServerReady, TensorMetadata,
};
use std::sync::Arc;

/// Largest body of a request.
pub const BODY_LIMIT_BYTES: usize = 64 << 20;
/// Batches up to here are computed on the spot; larger ones get a thread of their own.
const INLINE_WINDOWS: usize = 512;
/// Bodies with bytes up to here are read on the spot.
const INLINE_BODY_BYTES: usize = 1 << 20;
/// JSON bodies up to here are read on the spot: a millisecond or two.
const INLINE_TEXT_BYTES: usize = 256 << 10;
/// Version of a model that is asked for by its content: it has no other.
const ONLY_VERSION: &str = "1";

/// An error in the protocol's form.
#[derive(Debug)]
pub struct InferenceError {
    status: StatusCode,
    detail: String,
}

impl InferenceError {
    fn new(status: StatusCode, detail: impl Into<String>) -> Self {
        let detail = detail.into();
        Self { status, detail }
    }
}

impl IntoResponse for InferenceError {
    fn into_response(self) -> Response {
        let mut response = (self.status, Json(InferError { error: self.detail })).into_response();
        if self.status == StatusCode::TOO_MANY_REQUESTS || self.status == StatusCode::SERVICE_UNAVAILABLE {
            response
                .headers_mut()
                .insert(header::RETRY_AFTER, HeaderValue::from_static("1"));
        }
        response
    }
}

impl From<ModelUnusable> for InferenceError {
    fn from(error: ModelUnusable) -> Self {
        let status = match error {
            ModelUnusable::Unknown(_) => StatusCode::NOT_FOUND,
            ModelUnusable::Damaged { .. } | ModelUnusable::Unavailable(_) => StatusCode::SERVICE_UNAVAILABLE,
        };
        Self::new(status, error.to_string())
    }
}

impl From<Busy> for InferenceError {
    fn from(Busy: Busy) -> Self {
        Self::new(
            StatusCode::TOO_MANY_REQUESTS,
            "as much as this machine can do is being estimated",
        )
    }
}

/// A model as the path names it.
pub struct Named {
    name: String,
    version: String,
    versions: Vec<String>,
    model: Arc<LoadedModel>,
}

impl FromRequestParts<AppState> for Named {
    type Rejection = InferenceError;

    async fn from_request_parts(parts: &mut Parts, state: &AppState) -> Result<Self, InferenceError> {
        #[derive(serde::Deserialize)]
        struct InPath {
            model: String,
            version: Option<String>,
        }
        let Path(InPath { model, version }) = Path::<InPath>::from_request_parts(parts, state)
            .await
            .map_err(|rejection| InferenceError::new(StatusCode::NOT_FOUND, rejection.body_text()))?;
        let lists = !parts.uri.path().ends_with("/infer");
        find(state, model, version, lists).await
    }
}

async fn find(
    state: &AppState,
    name: String,
    version: Option<String>,
    lists_versions: bool,
) -> Result<Named, InferenceError> {
    let unknown = |what: String| InferenceError::new(StatusCode::NOT_FOUND, what);
    let get = |id: ModelId| async move { state.models().get(&id, state.ledger(), state.blobs()).await };
    let reference: ModelRef = match (name.parse(), &version) {
        (Ok(reference), _) => reference,
        // A bare name: the version is the tag.
        (Err(_), Some(tag)) => {
            let alias: AliasName = format!("{name}@{tag}")
                .parse()
                .map_err(|_| unknown(format!("no model {name:?} with version {tag:?}")))?;
            let record = state.models().alias(&alias, state.ledger()).await?;
            return Ok(Named {
                name,
                version: tag.clone(),
                versions: vec![tag.clone()],
                model: get(record.model_id).await?,
            });
        }
        (Err(error), None) => return Err(unknown(error.to_string())),
    };
    match reference {
        ModelRef::Id(id) => {
            if let Some(version) = version.filter(|version| version != ONLY_VERSION) {
                return Err(unknown(format!(
                    "model {id} has version {ONLY_VERSION}, not {version:?}"
                )));
            }
            Ok(Named {
                name,
                version: ONLY_VERSION.to_owned(),
                versions: vec![ONLY_VERSION.to_owned()],
                model: get(id).await?,
            })
        }
        ModelRef::Alias(alias) => {
            let current = state.models().alias(&alias, state.ledger()).await?;
            if !lists_versions && version.is_none() {
                return Ok(Named {
                    name,
                    version: current.generation.to_string(),
                    versions: Vec::new(),
                    model: get(current.model_id).await?,
                });
            }
            let history = state
                .ledger()
                .alias_history(&alias)
                .await
                .map_err(ModelUnusable::from)?;
            let wanted = version.unwrap_or_else(|| current.generation.to_string());
            let record = history
                .iter()
                .find(|record| record.generation.to_string() == wanted)
                .ok_or_else(|| {
                    unknown(format!(
                        "alias {alias} has no version {wanted:?}; it has 1 to {}",
                        history.len()
                    ))
                })?;
            Ok(Named {
                name,
                version: wanted,
                versions: history
                    .iter()
                    .map(|record| record.generation.to_string())
                    .collect(),
                model: get(record.model_id.clone()).await?,
            })
        }
    }
}

/// What the server is (Open Inference Protocol)
#[utoipa::path(
    get, path = "/v2", tag = "inference", operation_id = "inference_server",
    responses((status = 200, description = "Name, version, extensions", body = ServerMetadata)),
)]
pub async fn server() -> Json<ServerMetadata> {
    Json(ServerMetadata {
        name: "hydroflex".to_owned(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        extensions: vec!["binary_tensor_data".to_owned()],
    })
}

/// The server answers (Open Inference Protocol)
#[utoipa::path(
    get, path = "/v2/health/live", tag = "inference", operation_id = "inference_live",
    responses((status = 200, description = "Alive", body = ServerLive)),
)]
pub async fn live() -> Json<ServerLive> {
    Json(ServerLive { live: true })
}

/// The server can do its work (Open Inference Protocol)
#[utoipa::path(
    get, path = "/v2/health/ready", tag = "inference", operation_id = "inference_ready",
    responses(
        (status = 200, description = "Ready", body = ServerReady),
        (status = "default", description = "Not ready", body = InferError),
    ),
)]
pub async fn ready(State(state): State<AppState>) -> Result<Json<ServerReady>, InferenceError> {
    state.ledger().ping().await.map_err(ModelUnusable::from)?;
    Ok(Json(ServerReady { ready: true }))
}

/// What a model takes and gives (Open Inference Protocol)
#[utoipa::path(
    get, path = "/v2/models/{model}", tag = "inference", operation_id = "inference_model",
    params(("model" = String, Path, description = "Model or alias", example = "boom@stable")),
    responses(
        (status = 200, description = "Tensors and versions", body = ModelMetadata),
        (status = "default", description = "Refused", body = InferError),
    ),
)]
pub async fn model(named: Named) -> Json<ModelMetadata> {
    Json(metadata(named))
}

/// What a version of a model takes and gives (Open Inference Protocol)
#[utoipa::path(
    get, path = "/v2/models/{model}/versions/{version}", tag = "inference", operation_id = "inference_model_version",
    params(
        ("model" = String, Path, description = "Model or alias"),
        ("version" = String, Path, description = "Generation of the alias; 1 for a model"),
    ),
    responses(
        (status = 200, description = "Tensors and versions", body = ModelMetadata),
        (status = "default", description = "Refused", body = InferError),
    ),
)]
pub async fn model_version(named: Named) -> Json<ModelMetadata> {
    Json(metadata(named))
}

fn metadata(named: Named) -> ModelMetadata {
    let predictor = named.model.predictor();
    let config = named.model.config();
    let size = |count: usize| i64::try_from(count).unwrap_or(i64::MAX);
    ModelMetadata {
        name: named.name,
        versions: named.versions,
        platform: "hydroflex_slide".to_owned(),
        inputs: vec![TensorMetadata {
            name: WINDOW.to_owned(),
            datatype: "FP64".to_owned(),
            shape: vec![-1, size(predictor.window_steps()), size(predictor.input_count())],
        }],
        outputs: Output::of(predictor)
            .into_iter()
            .map(|output| TensorMetadata {
                name: output.name().to_owned(),
                datatype: output.datatype().to_owned(),
                shape: match output {
                    Output::InsideEnvelope => vec![-1],
                    Output::Estimates | Output::Lower | Output::Upper => {
                        vec![-1, size(predictor.target_count())]
                    }
                },
            })
            .collect(),
        parameters: ModelParameters {
            model_id: named.model.id().to_string(),
            model_sha256: named.model.provenance().model_sha256.clone(),
            inputs: config.inputs.iter().map(|input| input.name.clone()).collect(),
            targets: config.targets.iter().map(|target| target.name.clone()).collect(),
            sample_time_s: config.sample_time_s,
        },
    }
}

/// A model is loaded and has passed its checks (Open Inference Protocol)
#[utoipa::path(
    get, path = "/v2/models/{model}/ready", tag = "inference", operation_id = "inference_model_ready",
    params(("model" = String, Path, description = "Model or alias")),
    responses(
        (status = 200, description = "Ready", body = ModelReady),
        (status = "default", description = "Not ready", body = InferError),
    ),
)]
pub async fn model_ready(named: Named) -> Json<ModelReady> {
    Json(ModelReady {
        name: named.name,
        ready: true,
    })
}

/// A version of a model is loaded and has passed its checks (Open Inference Protocol)
#[utoipa::path(
    get, path = "/v2/models/{model}/versions/{version}/ready", tag = "inference",
    operation_id = "inference_model_version_ready",
    params(
        ("model" = String, Path, description = "Model or alias"),
        ("version" = String, Path, description = "Generation of the alias; 1 for a model"),
    ),
    responses(
        (status = 200, description = "Ready", body = ModelReady),
        (status = "default", description = "Not ready", body = InferError),
    ),
)]
pub async fn model_version_ready(named: Named) -> Json<ModelReady> {
    model_ready(named).await
}

/// Estimates for a batch of windows (Open Inference Protocol)
///
/// One input, `window`, of shape `[batch, steps, inputs]`: `data`, or `binary_data_size` and bytes
/// after the JSON, whose length is then in `Inference-Header-Content-Length`. Outputs come in the
/// same two forms. Bodies may be compressed with gzip or deflate, both ways.
#[utoipa::path(
    post, path = "/v2/models/{model}/infer", tag = "inference", operation_id = "infer",
    params(("model" = String, Path, description = "Model or alias", example = "boom@stable")),
    request_body = InferRequest,
    responses(
        (status = 200, description = "Estimates", body = InferResponse),
        (status = 429, description = "Busy; Retry-After says when to ask again", body = InferError),
        (status = "default", description = "Refused", body = InferError),
    ),
)]
pub async fn infer(
    State(state): State<AppState>,
    named: Named,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, InferenceError> {
    estimate(&state, named, &headers, body).await
}

/// Estimates for a batch of windows by a version of a model (Open Inference Protocol)
#[utoipa::path(
    post, path = "/v2/models/{model}/versions/{version}/infer", tag = "inference", operation_id = "infer_version",
    params(
        ("model" = String, Path, description = "Model or alias"),
        ("version" = String, Path, description = "Generation of the alias; 1 for a model"),
    ),
    request_body = InferRequest,
    responses(
        (status = 200, description = "Estimates", body = InferResponse),
        (status = 429, description = "Busy; Retry-After says when to ask again", body = InferError),
        (status = "default", description = "Refused", body = InferError),
    ),
)]
pub async fn infer_version(
    State(state): State<AppState>,
    named: Named,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, InferenceError> {
    estimate(&state, named, &headers, body).await
}

async fn estimate(
    state: &AppState,
    named: Named,
    headers: &HeaderMap,
    body: Body,
) -> Result<Response, InferenceError> {
    let received = body::receive(state.gate(), headers, body, BODY_LIMIT_BYTES).await;
    let Received { bytes: body, place } = match received {
        Ok(received) => received,
        Err(NotReceived::Broken(detail)) => {
            return Err(InferenceError::new(
                StatusCode::BAD_REQUEST,
                format!("the body broke off: {detail}"),
            ));
        }
        Err(NotReceived::Busy) => return Ok((CLOSING, InferenceError::from(Busy)).into_response()),
        Err(NotReceived::TooLarge { limit_bytes }) => {
            let detail = format!("at most {limit_bytes} bytes are read here");
            let error = InferenceError::new(StatusCode::PAYLOAD_TOO_LARGE, detail);
            return Ok((CLOSING, error).into_response());
        }
    };
    let json_length = match headers.get(HEADER_LENGTH) {
        None => None,
        Some(value) => Some(
            value
                .to_str()
                .ok()
                .and_then(|text| text.parse().ok())
                .ok_or_else(|| {
                    InferenceError::new(
                        StatusCode::BAD_REQUEST,
                        format!("Inference-Header-Content-Length is {value:?}, not a number of bytes"),
                    )
                })?,
        ),
    };
    // Windows at most, before the body is read: four bytes a value.
    let window_bytes = 4 * named.model.predictor().window_len().max(1);
    let most = 1 + body.len() / window_bytes;
    let (work, most_bytes) = if holds_bytes(body.len(), json_length) {
        (Work::Bytes, INLINE_BODY_BYTES)
    } else {
        (Work::Text, INLINE_TEXT_BYTES)
    };
    let answer = if body.len() <= most_bytes && most <= INLINE_WINDOWS {
        let _ticket = state.gate().inline(work, body.len()).await?;
        compute(&named, &body, json_length)
    } else {
        let permit = state.gate().thread().await?;
        tokio::task::spawn_blocking(move || {
            let answer = compute(&named, &body, json_length);
            // Held to the end of the work, even if the caller has gone.
            drop((permit, place));
            answer
        })
        .await
        .map_err(|error| {
            tracing::error!(cause = %error, "an inference panicked");
            InferenceError::new(
                StatusCode::INTERNAL_SERVER_ERROR,
                "the service failed; its log says why",
            )
        })?
    };
    let answer = answer.map_err(|detail| InferenceError::new(StatusCode::BAD_REQUEST, detail))?;
    let mut response = Response::new(answer.body.into());
    let headers = response.headers_mut();
    let media_type = match answer.json_length {
        None => "application/json",
        Some(length) => {
            headers.insert(HEADER_LENGTH, HeaderValue::from(length));
            "application/octet-stream"
        }
    };
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type));
    Ok(response)
}

fn compute(named: &Named, body: &[u8], json_length: Option<usize>) -> Result<infer::Answer, String> {
    let batch = infer::read(body, json_length, named.model.predictor(), named.model.config())?;
    infer::answer(&named.model, &named.name, &named.version, &batch)
}

/// Whether tensors follow the JSON: a header's word alone does not make cheap bytes of dear text.
fn holds_bytes(body_length: usize, json_length: Option<usize>) -> bool {
    json_length.is_some_and(|json_length| json_length < body_length)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_body_of_nothing_but_json_is_text_whatever_its_header_says() {
        assert!(holds_bytes(100, Some(40)));
        for json_length in [None, Some(100), Some(101)] {
            assert!(!holds_bytes(100, json_length), "{json_length:?}");
        }
    }
}
