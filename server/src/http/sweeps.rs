//! `/v1/sweeps`: many networks on one data set, and what they found.

use super::AppState;
use super::error::ApiError;
use super::extract::{Id, JsonBody, Page, PageQuery, accepted, idempotency_key};
use crate::sweeps;
use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use hydroflex_ledger::{Created, Ledger, SweepRecord};
use hydroflex_openapi::id::SweepId;
use hydroflex_openapi::problem::Problem;
use hydroflex_openapi::sweep::{SweepPage, SweepRequest, SweepStatus, SweepTable};

/// Train many networks on a data set
///
/// Every combination of the lists is a training of its own; trainings that were asked for one by one come first. A
/// trainer that is killed is replaced and goes on from its checkpoint.
#[utoipa::path(
    post, path = "/v1/sweeps", tag = "sweeps", operation_id = "submit_sweep",
    request_body = SweepRequest,
    params(("Idempotency-Key" = Option<String>, Header, description = "1 to 128 characters that name this request")),
    responses(
        (status = 202, description = "Accepted", body = SweepStatus, headers(
            ("Location" = String, description = "Where to look for the sweep"),
            ("Retry-After" = u64, description = "Seconds after which to look"),
        )),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn submit(
    State(state): State<AppState>,
    headers: HeaderMap,
    body: JsonBody<SweepRequest>,
) -> Result<Response, ApiError> {
    let key = idempotency_key(&headers, &body.bytes)?;
    if !state.ledger().knows_key(key.as_ref()).await? {
        state.coordinator().refuse_sweep_if_full().await?;
    }
    let sweep = state.coordinator().accept_sweep(&body.value).await?;
    let cells = sweep.cells();
    let created = state
        .ledger()
        .create_sweep(&sweep.request(), &cells, key.as_ref())
        .await?;
    if let Created::New(id) = created {
        tracing::info!(sweep = %id, networks = cells.len(), "sweep accepted");
    }
    let status = show_sweep(state.ledger(), created.id()).await?;
    let location = format!("/v1/sweeps/{}", status.sweep_id);
    Ok(accepted(location, 2, status))
}

/// List sweeps, newest first
#[utoipa::path(
    get, path = "/v1/sweeps", tag = "sweeps", operation_id = "list_sweeps", params(PageQuery),
    responses(
        (status = 200, description = "A page of sweeps", body = SweepPage),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn list(State(state): State<AppState>, page: Page) -> Result<Json<SweepPage>, ApiError> {
    let mut records = state.ledger().sweeps(page.after()?, page.ask()).await?;
    let next_cursor = page.cut(&mut records, |last| last.id);
    let mut sweeps = Vec::with_capacity(records.len());
    for record in records {
        sweeps.push(status_of(state.ledger(), &record).await?);
    }
    Ok(Json(SweepPage { sweeps, next_cursor }))
}

/// Show a sweep with its progress
#[utoipa::path(
    get, path = "/v1/sweeps/{sweep_id}", tag = "sweeps", operation_id = "show_sweep",
    params(("sweep_id" = SweepId, Path)),
    responses(
        (status = 200, description = "The sweep", body = SweepStatus),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn show(State(state): State<AppState>, Id(id): Id<SweepId>) -> Result<Json<SweepStatus>, ApiError> {
    show_sweep(state.ledger(), id).await.map(Json)
}

/// Cancel a sweep
///
/// What is running stops within a second or two. Models that are there stay. Cancelling a sweep that is over
/// changes nothing.
#[utoipa::path(
    post, path = "/v1/sweeps/{sweep_id}/cancel", tag = "sweeps", operation_id = "cancel_sweep",
    params(("sweep_id" = SweepId, Path)),
    responses(
        (status = 200, description = "The sweep, cancelled or over before", body = SweepStatus),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn cancel(
    State(state): State<AppState>,
    Id(id): Id<SweepId>,
) -> Result<Json<SweepStatus>, ApiError> {
    let cancelled = state.ledger().cancel_sweep(id).await?;
    if cancelled > 0 {
        tracing::info!(sweep = %id, cancelled, "sweep cancelled");
    }
    show_sweep(state.ledger(), id).await.map(Json)
}

/// Do again what failed or was cancelled
///
/// What is trained already is not trained again.
#[utoipa::path(
    post, path = "/v1/sweeps/{sweep_id}/retry", tag = "sweeps", operation_id = "retry_sweep",
    params(("sweep_id" = SweepId, Path)),
    responses(
        (status = 200, description = "The sweep, in work again", body = SweepStatus),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn retry(
    State(state): State<AppState>,
    Id(id): Id<SweepId>,
) -> Result<Json<SweepStatus>, ApiError> {
    find(state.ledger(), id).await?;
    if state.ledger().retry_sweep(id).await? == 0 {
        return Err(ApiError::Conflict(format!(
            "no training of sweep {id} failed or was cancelled"
        )));
    }
    show_sweep(state.ledger(), id).await.map(Json)
}

/// What a sweep found, as far as it is
#[utoipa::path(
    get, path = "/v1/sweeps/{sweep_id}/table", tag = "sweeps", operation_id = "show_sweep_table",
    params(("sweep_id" = SweepId, Path)),
    responses(
        (status = 200, description = "A row per network", body = SweepTable),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn table(State(state): State<AppState>, Id(id): Id<SweepId>) -> Result<Json<SweepTable>, ApiError> {
    table_of(state.ledger(), id).await.map(Json)
}

/// What a sweep found, for spreadsheets: a line per network and target
#[utoipa::path(
    get, path = "/v1/sweeps/{sweep_id}/table.csv", tag = "sweeps", operation_id = "show_sweep_csv",
    params(("sweep_id" = SweepId, Path)),
    responses(
        (status = 200, description = "Comma-separated values, errors in the units of the columns", body = String,
         content_type = "text/csv"),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn table_csv(State(state): State<AppState>, Id(id): Id<SweepId>) -> Result<Response, ApiError> {
    let table = table_of(state.ledger(), id).await?;
    Ok(text("text/csv; charset=utf-8", sweeps::csv(&table)))
}

/// What a sweep found, for people: means over the seeds, in mm, microstrain and N/mm²
#[utoipa::path(
    get, path = "/v1/sweeps/{sweep_id}/table.md", tag = "sweeps", operation_id = "show_sweep_markdown",
    params(("sweep_id" = SweepId, Path)),
    responses(
        (status = 200, description = "Markdown", body = String, content_type = "text/markdown"),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn table_markdown(
    State(state): State<AppState>,
    Id(id): Id<SweepId>,
) -> Result<Response, ApiError> {
    let table = table_of(state.ledger(), id).await?;
    Ok(text("text/markdown; charset=utf-8", sweeps::markdown(&table)))
}

/// What a sweep found, as a picture
#[utoipa::path(
    get, path = "/v1/sweeps/{sweep_id}/plot.svg", tag = "sweeps", operation_id = "show_sweep_plot",
    params(("sweep_id" = SweepId, Path)),
    responses(
        (status = 200, description = "Mean absolute errors on a logarithmic axis", body = String,
         content_type = "image/svg+xml"),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn plot(State(state): State<AppState>, Id(id): Id<SweepId>) -> Result<Response, ApiError> {
    let table = table_of(state.ledger(), id).await?;
    Ok(text("image/svg+xml", sweeps::picture(&table).to_svg()))
}

fn text(media_type: &'static str, body: String) -> Response {
    ([(header::CONTENT_TYPE, media_type)], body).into_response()
}

async fn find(ledger: &Ledger, id: SweepId) -> Result<SweepRecord, ApiError> {
    ledger
        .sweep(id)
        .await?
        .ok_or_else(|| ApiError::NotFound(format!("no sweep {id}")))
}

async fn status_of(ledger: &Ledger, record: &SweepRecord) -> Result<SweepStatus, ApiError> {
    let (progress, finished_ms) = ledger.sweep_progress(record.id).await?;
    Ok(record.status(progress, finished_ms))
}

async fn show_sweep(ledger: &Ledger, id: SweepId) -> Result<SweepStatus, ApiError> {
    status_of(ledger, &find(ledger, id).await?).await
}

async fn table_of(ledger: &Ledger, id: SweepId) -> Result<SweepTable, ApiError> {
    let record = find(ledger, id).await?;
    let (progress, _) = ledger.sweep_progress(id).await?;
    Ok(sweeps::table(
        &record,
        progress.state(),
        ledger.sweep_cells(id).await?,
    ))
}
