//! `/v1/models`: list, show, download.

use super::AppState;
use super::error::ApiError;
use super::extract::{Id, IdAndFile, Page, PageQuery, TimeCursor};
use super::files;
use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, Method, Response};
use hydroflex_ledger::{Ledger, ModelRecord};
use hydroflex_openapi::catalogue::{ModelInfo, ModelPage};
use hydroflex_openapi::id::ModelId;
use hydroflex_openapi::problem::Problem;

/// List models with their metrics, newest first
#[utoipa::path(
    get, path = "/v1/models", tag = "models", operation_id = "list_models", params(PageQuery),
    responses(
        (status = 200, description = "A page of models", body = ModelPage),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn list(State(state): State<AppState>, page: Page) -> Result<Json<ModelPage>, ApiError> {
    let after: Option<TimeCursor> = page.after()?;
    let before = after.as_ref().map(|cursor| (cursor.ms, cursor.id.as_str()));
    let mut records = state.ledger().models(before, page.ask()).await?;
    let next_cursor = page.cut(&mut records, |last| TimeCursor::new(last.created_ms, &last.id));
    Ok(Json(ModelPage {
        models: records.iter().map(ModelRecord::info).collect(),
        next_cursor,
    }))
}

/// Show a model
#[utoipa::path(
    get, path = "/v1/models/{model_id}", tag = "models", operation_id = "show_model",
    params(("model_id" = ModelId, Path)),
    responses(
        (status = 200, description = "The model", body = ModelInfo),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn show(State(state): State<AppState>, Id(id): Id<ModelId>) -> Result<Json<ModelInfo>, ApiError> {
    Ok(Json(find(state.ledger(), &id).await?.info()))
}

/// Download one file of a model
#[utoipa::path(
    get, path = "/v1/models/{model_id}/files/{path}", tag = "models", operation_id = "download_model_file",
    params(
        ("model_id" = ModelId, Path),
        ("path" = String, Path, description = "As listed, for example `model.safetensors`"),
        ("Range" = Option<String>, Header, description = "One range of bytes"),
    ),
    responses(
        (status = 200, description = "The file", body = Vec<u8>, content_type = "application/octet-stream"),
        (status = 206, description = "The range", body = Vec<u8>, content_type = "application/octet-stream"),
        (status = 304, description = "The file is as the ETag says"),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn file(
    State(state): State<AppState>,
    IdAndFile(id, path): IdAndFile<ModelId>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response<Body>, ApiError> {
    let model = find(state.ledger(), &id).await?;
    let entry = model
        .file(&path)
        .ok_or_else(|| ApiError::NotFound(format!("model {id} has no file {path:?}")))?;
    files::serve(
        state.blobs(),
        &model.key(&entry.path),
        entry,
        &headers,
        method == Method::HEAD,
    )
    .await
}

async fn find(ledger: &Ledger, id: &ModelId) -> Result<ModelRecord, ApiError> {
    ledger
        .model(id)
        .await?
        .ok_or_else(|| ApiError::NotFound(format!("no model {id}")))
}
