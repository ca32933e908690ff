//! `/v1/trainings`: a network for a published data set.

use super::AppState;
use super::error::ApiError;
use super::extract::{Id, JsonBody, accepted, idempotency_key};
use axum::Json;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::Response;
use hydroflex_openapi::id::TrainingId;
use hydroflex_openapi::problem::Problem;
use hydroflex_openapi::status::{TrainingRequest, TrainingStatus};

/// Train a network on a data set
#[utoipa::path(
    post, path = "/v1/trainings", tag = "trainings", operation_id = "submit_training",
    request_body = TrainingRequest,
    params(("Idempotency-Key" = Option<String>, Header, description = "1 to 128 characters that name this request")),
    responses(
        (status = 202, description = "Accepted", body = TrainingStatus, headers(
            ("Location" = String, description = "Where to look for the training"),
            ("Retry-After" = u64, description = "Seconds after which to look"),
        )),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn submit(
    State(state): State<AppState>,
    headers: HeaderMap,
    body: JsonBody<TrainingRequest>,
) -> Result<Response, ApiError> {
    let key = idempotency_key(&headers, &body.bytes)?;
    let TrainingRequest { dataset_id, spec } = body.value;
    state.coordinator().accept_training(&dataset_id, &spec).await?;
    let created = state
        .ledger()
        .create_training(&dataset_id, &spec, key.as_ref())
        .await?;
    let training = find(&state, created.id()).await?;
    let location = format!("/v1/trainings/{}", training.training_id);
    Ok(accepted(location, 2, training))
}

/// Show a training with its progress
#[utoipa::path(
    get, path = "/v1/trainings/{training_id}", tag = "trainings", operation_id = "show_training",
    params(("training_id" = TrainingId, Path)),
    responses(
        (status = 200, description = "The training", body = TrainingStatus),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn show(
    State(state): State<AppState>,
    Id(id): Id<TrainingId>,
) -> Result<Json<TrainingStatus>, ApiError> {
    find(&state, id).await.map(Json)
}

async fn find(state: &AppState, id: TrainingId) -> Result<TrainingStatus, ApiError> {
    let training = state.ledger().training(id).await?;
    training
        .map(|record| record.status())
        .ok_or_else(|| ApiError::NotFound(format!("no training {id}")))
}
