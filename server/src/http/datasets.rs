//! `/v1/datasets`: list, show, download whole or in part.

use super::AppState;
use super::error::ApiError;
use super::extract::{Id, IdAndFile, Page, PageQuery, TimeCursor};
use super::{archive, files};
use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, Method, Response};
use hydroflex_ledger::{DatasetRecord, Ledger};
use hydroflex_openapi::catalogue::{DatasetInfo, DatasetPage};
use hydroflex_openapi::id::DatasetId;
use hydroflex_openapi::problem::Problem;

/// List data sets, newest first
#[utoipa::path(
    get, path = "/v1/datasets", tag = "data sets", operation_id = "list_datasets", params(PageQuery),
    responses(
        (status = 200, description = "A page of data sets", body = DatasetPage),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn list(State(state): State<AppState>, page: Page) -> Result<Json<DatasetPage>, ApiError> {
    let after: Option<TimeCursor> = page.after()?;
    let before = after.as_ref().map(|cursor| (cursor.ms, cursor.id.as_str()));
    let mut records = state.ledger().datasets(before, page.ask()).await?;
    let next_cursor = page.cut(&mut records, |last| TimeCursor::new(last.created_ms, &last.id));
    Ok(Json(DatasetPage {
        datasets: records.iter().map(DatasetRecord::info).collect(),
        next_cursor,
    }))
}

/// Show a data set with its files
#[utoipa::path(
    get, path = "/v1/datasets/{dataset_id}", tag = "data sets", operation_id = "show_dataset",
    params(("dataset_id" = DatasetId, Path)),
    responses(
        (status = 200, description = "The data set", body = DatasetInfo),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn show(
    State(state): State<AppState>,
    Id(id): Id<DatasetId>,
) -> Result<Json<DatasetInfo>, ApiError> {
    Ok(Json(find(state.ledger(), &id).await?.info()))
}

/// Download one file
///
/// With strong ETags and byte ranges, so that pandas, polars and DuckDB read it by its URL.
#[utoipa::path(
    get, path = "/v1/datasets/{dataset_id}/files/{path}", tag = "data sets", operation_id = "download_dataset_file",
    params(
        ("dataset_id" = DatasetId, Path),
        ("path" = String, Path, description = "As listed, for example `data/train-00000-of-00001.parquet`"),
        ("Range" = Option<String>, Header, description = "One range of bytes"),
        ("If-None-Match" = Option<String>, Header, description = "ETags that need not be sent again"),
        ("If-Range" = Option<String>, Header, description = "ETag for which the range was meant"),
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
    IdAndFile(id, path): IdAndFile<DatasetId>,
    method: Method,
    headers: HeaderMap,
) -> Result<Response<Body>, ApiError> {
    let dataset = find(state.ledger(), &id).await?;
    // Only what is listed exists: a path is compared, never followed.
    let entry = dataset
        .file(&path)
        .ok_or_else(|| ApiError::NotFound(format!("data set {id} has no file {path:?}")))?;
    files::serve(
        state.blobs(),
        &dataset.key(&entry.path),
        entry,
        &headers,
        method == Method::HEAD,
    )
    .await
}

/// Download the whole data set as a tar archive
#[utoipa::path(
    get, path = "/v1/datasets/{dataset_id}/archive.tar", tag = "data sets", operation_id = "download_dataset",
    params(("dataset_id" = DatasetId, Path)),
    responses(
        (status = 200, description = "The archive", body = Vec<u8>, content_type = "application/x-tar"),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn archive(
    State(state): State<AppState>,
    Id(id): Id<DatasetId>,
    method: Method,
) -> Result<Response<Body>, ApiError> {
    let dataset = find(state.ledger(), &id).await?;
    archive::serve(state.blobs(), &dataset, method == Method::HEAD)
}

async fn find(ledger: &Ledger, id: &DatasetId) -> Result<DatasetRecord, ApiError> {
    ledger
        .dataset(id)
        .await?
        .ok_or_else(|| ApiError::NotFound(format!("no data set {id}")))
}
