//! `/v1/jobs`: submit, list, show, cancel.

use super::AppState;
use super::error::ApiError;
use super::extract::{Id, JsonBody, Page, PageQuery, accepted, idempotency_key};
use axum::Json;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::Response;
use hydroflex_ledger::{Created, JobRecord, Ledger, LedgerError, clock};
use hydroflex_openapi::id::JobId;
use hydroflex_openapi::job::JobSpec;
use hydroflex_openapi::problem::Problem;
use hydroflex_openapi::status::{JobPage, JobStatus};

/// Submit a job
///
/// Answers at once; the job is worked on in the background. With an `Idempotency-Key`, repeating the
/// request makes no second job.
#[utoipa::path(
    post, path = "/v1/jobs", tag = "jobs", operation_id = "submit_job",
    request_body = JobSpec,
    params(("Idempotency-Key" = Option<String>, Header, description = "1 to 128 characters that name this request")),
    responses(
        (status = 202, description = "Accepted", body = JobStatus, headers(
            ("Location" = String, description = "Where to look for the job"),
            ("Retry-After" = u64, description = "Seconds after which to look"),
        )),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn submit(
    State(state): State<AppState>,
    headers: HeaderMap,
    body: JsonBody<JobSpec>,
) -> Result<Response, ApiError> {
    let key = idempotency_key(&headers, &body.bytes)?;
    if !state.ledger().knows_key(key.as_ref()).await? {
        state.coordinator().refuse_if_full().await?;
    }
    let new = state.coordinator().accept(body.value).await?;
    let created = state.ledger().create_job(&new, key.as_ref()).await?;
    if let Created::New(id) = created {
        tracing::info!(job = %id, runs = new.spec.runs, "job accepted");
        state.coordinator().wake();
    }
    let job = show_job(state.ledger(), created.id()).await?;
    let location = format!("/v1/jobs/{}", job.job_id);
    Ok(accepted(location, 1, job))
}

/// List jobs, newest first
#[utoipa::path(
    get, path = "/v1/jobs", tag = "jobs", operation_id = "list_jobs", params(PageQuery),
    responses(
        (status = 200, description = "A page of jobs", body = JobPage),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn list(State(state): State<AppState>, page: Page) -> Result<Json<JobPage>, ApiError> {
    let mut records = state.ledger().jobs(page.after()?, page.ask()).await?;
    let next_cursor = page.cut(&mut records, |last| last.id);
    let mut jobs = Vec::with_capacity(records.len());
    for record in records {
        jobs.push(status_of(state.ledger(), record).await?);
    }
    Ok(Json(JobPage { jobs, next_cursor }))
}

/// Show a job with its progress
#[utoipa::path(
    get, path = "/v1/jobs/{job_id}", tag = "jobs", operation_id = "show_job", params(("job_id" = JobId, Path)),
    responses(
        (status = 200, description = "The job", body = JobStatus),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn show(State(state): State<AppState>, Id(id): Id<JobId>) -> Result<Json<JobStatus>, ApiError> {
    show_job(state.ledger(), id).await.map(Json)
}

/// Cancel a job
///
/// What is running stops within a second or two. A published data set stays. Cancelling a job that is
/// over changes nothing.
#[utoipa::path(
    post, path = "/v1/jobs/{job_id}/cancel", tag = "jobs", operation_id = "cancel_job",
    params(("job_id" = JobId, Path)),
    responses(
        (status = 200, description = "The job, cancelled or over before", body = JobStatus),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn cancel(State(state): State<AppState>, Id(id): Id<JobId>) -> Result<Json<JobStatus>, ApiError> {
    if state.ledger().cancel_job(id).await? {
        tracing::info!(job = %id, "job cancelled");
        state.coordinator().wake();
    }
    show_job(state.ledger(), id).await.map(Json)
}

/// Do again what failed
///
/// Of a job that is over: the runs that were given up because every attempt at them ended with its worker,
/// then the data set, which is a new one, and its trainings; or, if every run is there, the trainings that
/// failed. What is there already is not simulated again.
#[utoipa::path(
    post, path = "/v1/jobs/{job_id}/retry", tag = "jobs", operation_id = "retry_job",
    params(("job_id" = JobId, Path)),
    responses(
        (status = 200, description = "The job, in work again", body = JobStatus),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn retry(State(state): State<AppState>, Id(id): Id<JobId>) -> Result<Json<JobStatus>, ApiError> {
    if !state.ledger().retry_job(id).await? {
        return Err(ApiError::Conflict(format!(
            "job {id} is not over, or nothing of it can be done again: a cancelled job, or one without a data \
             set, is submitted anew"
        )));
    }
    tracing::info!(job = %id, "what failed is done again");
    state.coordinator().wake();
    show_job(state.ledger(), id).await.map(Json)
}

async fn show_job(ledger: &Ledger, id: JobId) -> Result<JobStatus, ApiError> {
    match ledger.job(id).await? {
        Some(record) => Ok(status_of(ledger, record).await?),
        None => Err(ApiError::NotFound(format!("no job {id}"))),
    }
}

/// A job as the contract shows it.
///
/// # Errors
/// Passes on what the ledger says.
pub async fn status_of(ledger: &Ledger, record: JobRecord) -> Result<JobStatus, LedgerError> {
    let trainings = ledger.trainings_of(record.id).await?;
    let notices = ledger.notices(record.id).await?;
    let dataset = match &record.dataset_id {
        Some(id) => ledger.dataset(id).await?,
        None => None,
    };
    Ok(JobStatus {
        job_id: record.id,
        state: record.state,
        reason: record.reason,
        spec: record.spec,
        machine_sha256: record.machine_sha256,
        instruction_set: record.instruction_set,
        notices,
        progress: record.progress,
        dataset_id: record.dataset_id,
        dataset_sha256: dataset.map(|dataset| dataset.sha256),
        model_ids: trainings
            .iter()
            .filter_map(|training| training.model_id.clone())
            .collect(),
        trainings: trainings
            .iter()
            .map(hydroflex_ledger::TrainingRecord::status)
            .collect(),
        created_at: clock::rfc3339(record.created_ms),
        started_at: record.started_ms.map(clock::rfc3339),
        finished_at: record.finished_ms.map(clock::rfc3339),
    })
}
