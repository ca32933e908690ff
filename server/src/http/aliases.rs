//! `/v1/aliases`: names that point at models and can be moved.

use super::AppState;
use super::error::ApiError;
use super::extract::{Id, JsonBody};
use crate::prediction::registry::ModelUnusable;
use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use hydroflex_ledger::{AliasCondition, AliasMove, AliasRecord};
use hydroflex_openapi::catalogue::{AliasInfo, AliasList, AliasRequest};
use hydroflex_openapi::id::AliasName;
use hydroflex_openapi::problem::{FieldError, Problem};

/// List aliases by name
#[utoipa::path(
    get, path = "/v1/aliases", tag = "models", operation_id = "list_aliases",
    responses(
        (status = 200, description = "Every alias", body = AliasList),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn list(State(state): State<AppState>) -> Result<Json<AliasList>, ApiError> {
    let records = state.ledger().aliases().await?;
    Ok(Json(AliasList {
        aliases: records.iter().map(AliasRecord::info).collect(),
    }))
}

/// Show where an alias points
#[utoipa::path(
    get, path = "/v1/aliases/{alias}", tag = "models", operation_id = "show_alias",
    params(("alias" = AliasName, Path)),
    responses(
        (status = 200, description = "The alias; its generation is the ETag", body = AliasInfo),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn show(State(state): State<AppState>, Id(alias): Id<AliasName>) -> Result<Response, ApiError> {
    let record = state
        .ledger()
        .alias(&alias)
        .await?
        .ok_or_else(|| ApiError::NotFound(format!("no alias {alias}")))?;
    Ok(answer(StatusCode::OK, &record))
}

/// Point an alias at a model
///
/// The model is loaded and its golden predictions are checked first: one that does not pass is
/// refused and the alias stays. From the answer on, requests by alias go to the new model; none
/// fails meanwhile. `If-Match` with the ETag refuses to undo somebody else's move, `If-None-Match: *`
/// makes a new alias only.
#[utoipa::path(
    put, path = "/v1/aliases/{alias}", tag = "models", operation_id = "move_alias",
    params(
        ("alias" = AliasName, Path),
        ("If-Match" = Option<String>, Header, description = "ETag of the alias as it was seen"),
        ("If-None-Match" = Option<String>, Header, description = "`*`: only if there is no such alias"),
    ),
    request_body = AliasRequest,
    responses(
        (status = 200, description = "It points there now", body = AliasInfo),
        (status = 201, description = "It is new and points there", body = AliasInfo),
        (status = 409, description = "The model does not pass its checks", body = Problem, content_type = "application/problem+json"),
        (status = 412, description = "It is not as If-Match or If-None-Match says", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn put(
    State(state): State<AppState>,
    Id(alias): Id<AliasName>,
    headers: HeaderMap,
    body: JsonBody<AliasRequest>,
) -> Result<Response, ApiError> {
    let condition = condition(&headers)?;
    let model = &body.value.model_id;
    match state.models().get(model, state.ledger(), state.blobs()).await {
        Ok(_) => {}
        Err(ModelUnusable::Unknown(detail)) => {
            return Err(ApiError::field(
                FieldError::new("/model_id", detail).value(model.as_str()),
            ));
        }
        Err(error @ ModelUnusable::Damaged { .. }) => return Err(ApiError::Conflict(error.to_string())),
        Err(error @ ModelUnusable::Unavailable(_)) => return Err(error.into()),
    }
    match state.ledger().move_alias(&alias, model, condition).await? {
        AliasMove::Moved(record) => {
            state.models().note_alias(record.clone());
            let is_new = record.generation == 1;
            Ok(answer(
                if is_new {
                    StatusCode::CREATED
                } else {
                    StatusCode::OK
                },
                &record,
            ))
        }
        AliasMove::Unchanged(record) => Ok(answer(StatusCode::OK, &record)),
        AliasMove::Refused(found) => Err(ApiError::PreconditionFailed(match found {
            Some(record) => format!(
                "{alias} is at generation {}, model {}",
                record.generation, record.model_id
            ),
            None => format!("there is no alias {alias}"),
        })),
    }
}

fn condition(headers: &HeaderMap) -> Result<AliasCondition, ApiError> {
    let text = |name: header::HeaderName| -> Result<Option<String>, ApiError> {
        headers
            .get(&name)
            .map(|value| {
                value
                    .to_str()
                    .map(|text| text.trim().to_owned())
                    .map_err(|_| ApiError::Malformed(format!("{name} is not text")))
            })
            .transpose()
    };
    match (text(header::IF_MATCH)?, text(header::IF_NONE_MATCH)?) {
        (None, None) => Ok(AliasCondition::None),
        (None, Some(any)) if any == "*" => Ok(AliasCondition::Absent),
        (Some(any), None) if any == "*" => Ok(AliasCondition::Present),
        (Some(tag), None) => Ok(tag
            .strip_prefix('"')
            .and_then(|tag| tag.strip_suffix('"'))
            .and_then(|tag| tag.parse().ok())
            // A tag that no alias ever had matches none.
            .map_or(AliasCondition::Generation(0), AliasCondition::Generation)),
        (_, Some(other)) => Err(ApiError::Malformed(format!(
            "if-none-match is {other:?}; `*` alone is understood here, and not beside if-match"
        ))),
    }
}

fn answer(status: StatusCode, record: &AliasRecord) -> Response {
    let mut response = (status, Json(record.info())).into_response();
    if let Ok(tag) = HeaderValue::from_str(&format!("\"{}\"", record.generation)) {
        response.headers_mut().insert(header::ETAG, tag);
    }
    response
}
