//! `/v1/models/{model}/predict` and `/v1/models/{model}/stream`: estimates in engineering units.

use super::AppState;
use super::body::{self, CLOSING, NotReceived, Received};
use super::error::ApiError;
use super::extract::{BODY_LIMIT_BYTES, Id, parse_json};
use crate::prediction::LoadedModel;
use crate::prediction::answer::check_sample_time;
use crate::prediction::gate::{Busy, Work};
use crate::prediction::session::Session;
use crate::prediction::spool::{ReceiveError, Spool};
use crate::prediction::table::{self, TableError, TableForm};
use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::QueryRejection;
use axum::extract::ws::{
    CloseFrame, Message, WebSocket, WebSocketUpgrade, close_code, rejection::WebSocketUpgradeRejection,
};
use axum::extract::{Query, Request, State};
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use hydroflex_openapi::id::ModelRef;
use hydroflex_openapi::prediction::{PredictRequest, PredictResponse, Signal};
use hydroflex_openapi::problem::{FieldError, Problem};
use hydroflex_openapi::stream::{StreamEstimate, StreamOpened, StreamSample};
use std::sync::Arc;
use std::time::Duration;

/// Longest recording.
const TABLE_LIMIT_BYTES: u64 = 8 << 30;
/// Longest table that is answered as JSON.
const JSON_LIMIT_ROWS: usize = 200_000;
/// JSON bodies up to here are read and answered on the spot: some ten windows.
const INLINE_BODY_BYTES: usize = 64 << 10;
/// Longest message of a session, many times a sample.
const MESSAGE_LIMIT_BYTES: usize = 64 << 10;
/// Silence after which a session's client is asked whether it is there, and then given up.
const SILENCE: Duration = Duration::from_secs(30);

/// What a query may say.
#[derive(Debug, Default, serde::Deserialize, utoipa::IntoParams)]
#[into_params(parameter_in = Query)]
pub struct PredictQuery {
    /// Time between samples, if the caller of a table without `time_s` wants it checked.
    #[serde(default)]
    #[param(value_type = Option<f64>)]
    sample_time_s: Option<String>,
}

/// What a body or an answer is written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Form {
    Json,
    Table(TableForm),
}

impl Form {
    const TAKEN: &'static str =
        "application/json, application/vnd.apache.arrow.stream, application/vnd.apache.parquet";

    fn of_media_type(text: &str) -> Option<Self> {
        let text = text
            .split(';')
            .next()
            .unwrap_or_default()
            .trim()
            .to_ascii_lowercase();
        match text.as_str() {
            "application/json" => Some(Self::Json),
            other => TableForm::from_media_type(other).map(Self::Table),
        }
    }

    fn of_body(headers: &HeaderMap) -> Result<Self, ApiError> {
        let text = headers
            .get(header::CONTENT_TYPE)
            .and_then(|value| value.to_str().ok());
        text.and_then(Self::of_media_type).ok_or_else(|| {
            ApiError::MediaType(format!(
                "content-type is {:?}; {} are read here",
                text.unwrap_or("missing"),
                Self::TAKEN
            ))
        })
    }

    /// The first form that the caller takes; that of the body if anything will do.
    fn of_answer(headers: &HeaderMap, body: Self) -> Result<Self, ApiError> {
        let Some(accept) = headers.get(header::ACCEPT) else {
            return Ok(body);
        };
        let accept = accept.to_str().unwrap_or_default();
        let refused = |range: &str| {
            let quality = range
                .split(';')
                .skip(1)
                .find_map(|part| part.trim().strip_prefix("q="));
            quality
                .and_then(|q| q.trim().parse::<f64>().ok())
                .is_some_and(|q| q <= 0.0)
        };
        accept
            .split(',')
            .filter(|range| !refused(range))
            .find_map(|range| {
                let text = range.split(';').next().unwrap_or_default().trim();
                if matches!(text, "*/*" | "application/*") {
                    Some(body)
                } else {
                    Self::of_media_type(text)
                }
            })
            .ok_or_else(|| {
                ApiError::NotAcceptable(format!("accept is {accept:?}; answers come as {}", Self::TAKEN))
            })
    }
}

impl From<Busy> for ApiError {
    fn from(Busy: Busy) -> Self {
        Self::TooManyRequests("as much as this machine can do is being estimated".to_owned())
    }
}

impl From<TableError> for ApiError {
    fn from(error: TableError) -> Self {
        match error {
            TableError::Malformed(detail) => Self::Malformed(format!("the table cannot be read: {detail}")),
            TableError::Invalid(errors) => Self::Invalid(errors),
            TableError::Failed(detail) => Self::Internal(detail),
        }
    }
}

/// Estimate deflection, strain and stress from sensor signals
///
/// As JSON, `inputs` holds every input of the model by column name; a number stands for a constant
/// signal. As an Arrow stream or Parquet, the body is a table of any length with a column per
/// input, and `run_id`, `step`, `time_s` where it has them: the window begins anew with every run,
/// steps have to follow each other and times have to be a sample time apart. `{model_id}` is a
/// model or an alias such as `boom@stable`. The answer is in the form that `Accept` asks for.
#[utoipa::path(
    post, path = "/v1/models/{model_id}/predict", tag = "models", operation_id = "predict",
    params(("model_id" = String, Path, description = "Model or alias", example = "boom@stable"), PredictQuery),
    request_body(content(
        (PredictRequest = "application/json"),
        (Vec<u8> = "application/vnd.apache.arrow.stream"),
        (Vec<u8> = "application/vnd.apache.parquet"),
    )),
    responses(
        (status = 200, description = "Estimates", content(
            (PredictResponse = "application/json"),
            (Vec<u8> = "application/vnd.apache.arrow.stream"),
            (Vec<u8> = "application/vnd.apache.parquet"),
        )),
        (status = 429, description = "Busy; Retry-After says when to ask again", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn predict(
    State(state): State<AppState>,
    Id(reference): Id<ModelRef>,
    query: Result<Query<PredictQuery>, QueryRejection>,
    request: Request,
) -> Result<Response, ApiError> {
    let Query(query) = query.map_err(|rejection| ApiError::Malformed(rejection.body_text()))?;
    let body_form = Form::of_body(request.headers())?;
    let answer_form = Form::of_answer(request.headers(), body_form)?;
    let model = state
        .models()
        .find(&reference, state.ledger(), state.blobs())
        .await?;
    if let Some(text) = query.sample_time_s {
        let error = match text.parse::<f64>() {
            Ok(sample_time_s) => check_sample_time(model.config(), sample_time_s),
            Err(_) => Some(FieldError::new("", "not a number").value(text)),
        };
        if let Some(mut error) = error {
            "?sample_time_s".clone_into(&mut error.pointer);
            return Err(ApiError::field(error));
        }
    }
    match body_form {
        Form::Json => predict_json(&state, model, request, answer_form).await,
        Form::Table(form) => predict_table(&state, model, request, form, answer_form).await,
    }
}

async fn predict_json(
    state: &AppState,
    model: Arc<LoadedModel>,
    request: Request,
    answer_form: Form,
) -> Result<Response, ApiError> {
    let (head, body) = request.into_parts();
    let received = body::receive(state.gate(), &head.headers, body, BODY_LIMIT_BYTES).await;
    let Received { bytes, place } = match received {
        Ok(received) => received,
        Err(NotReceived::Broken(detail)) => {
            return Err(ApiError::Malformed(format!("the body broke off: {detail}")));
        }
        Err(NotReceived::Busy) => return Ok((CLOSING, ApiError::from(Busy)).into_response()),
        Err(NotReceived::TooLarge { limit_bytes }) => {
            let limit_bytes = limit_bytes as u64;
            return Ok((CLOSING, ApiError::TooLarge { limit_bytes }).into_response());
        }
    };
    if bytes.len() <= INLINE_BODY_BYTES && answer_form == Form::Json {
        let _ticket = state.gate().inline(Work::Text, bytes.len()).await?;
        let request: PredictRequest = parse_json(&bytes)?;
        return Ok(Json(model.predict(&request).map_err(ApiError::Invalid)?).into_response());
    }
    let scratch = state.prediction_scratch();
    on_a_thread(state, move || {
        let request: PredictRequest = parse_json(&bytes)?;
        let answer = model.predict(&request).map_err(ApiError::Invalid)?;
        drop(place);
        match answer_form {
            Form::Json => Ok(Json(answer).into_response()),
            Form::Table(form) => {
                let spool = table::write_response(&model, &answer, form, Spool::new(&scratch))?;
                table_response(spool, form)
            }
        }
    })
    .await
}

async fn predict_table(
    state: &AppState,
    model: Arc<LoadedModel>,
    request: Request,
    form: TableForm,
    answer_form: Form,
) -> Result<Response, ApiError> {
    let (head, body) = request.into_parts();
    let stream = body.into_data_stream();
    let Ok(upload) = state.gate().upload() else {
        body::read_away(state.gate(), &head.headers, stream);
        return Ok((CLOSING, ApiError::from(Busy)).into_response());
    };
    let scratch = state.prediction_scratch();
    let table = Spool::receive(stream, &scratch, TABLE_LIMIT_BYTES)
        .await
        .map_err(|error| match error {
            ReceiveError::TooLarge => ApiError::TooLarge {
                limit_bytes: TABLE_LIMIT_BYTES,
            },
            ReceiveError::Broken(detail) => ApiError::Malformed(format!("the body broke off: {detail}")),
            ReceiveError::Disk(error) => ApiError::Internal(format!("cannot keep a body: {error}")),
        })?;
    let response = on_a_thread(state, move || match answer_form {
        Form::Table(answer_form) => {
            let answer = table::predict(&model, table, form, answer_form, Spool::new(&scratch))?;
            table_response(answer, answer_form)
        }
        Form::Json => {
            let columns = table::read_columns(&model, table, form, JSON_LIMIT_ROWS)?;
            let names = model.config().inputs.iter().map(|input| input.name.clone());
            let request = PredictRequest {
                inputs: names.zip(columns.into_iter().map(Signal::Samples)).collect(),
                sample_time_s: None,
            };
            Ok(Json(model.predict(&request).map_err(ApiError::Invalid)?).into_response())
        }
    })
    .await;
    drop(upload);
    response
}

/// Work that takes long: not on the threads that answer everybody.
async fn on_a_thread(
    state: &AppState,
    work: impl FnOnce() -> Result<Response, ApiError> + Send + 'static,
) -> Result<Response, ApiError> {
    let permit = state.gate().thread().await?;
    let work = move || {
        let result = work();
        // Held to the end of the work, even if the caller has gone.
        drop(permit);
        result
    };
    tokio::task::spawn_blocking(work).await.map_err(|error| {
        // A body that no reader of tables has met: its fault, but our log.
        ApiError::Internal(error.to_string())
    })?
}

fn table_response(spool: Spool, form: TableForm) -> Result<Response, ApiError> {
    let length = spool.len();
    let body = spool
        .into_body()
        .map_err(|error| ApiError::Internal(error.to_string()))?;
    Response::builder()
        .header(header::CONTENT_TYPE, form.media_type())
        .header(header::CONTENT_LENGTH, length)
        .body(body)
        .map_err(|error| ApiError::Internal(error.to_string()))
}

/// Estimate a live signal: a WebSocket session, one sample in, one estimate out
///
/// The service's first message is a `StreamOpened`. A sample is a text message (`StreamSample`,
/// answered with a `StreamEstimate`) or a binary one: `step` as u64, then one f64 (or one f32) per
/// input in the order of `StreamOpened.inputs`, NaN for a sensor that gave nothing, little endian
/// throughout. Its answer is binary: `step` u64, status u8 (0 ok, 1 filling, 2 filled, 3 gap,
/// 4 repeated, 5 late, 6 too late), inside u8 (0, 1, 255 unknown), filled-in samples u16, four
/// zero bytes, then estimate, lower and upper end as f64 per target, NaN where there is none.
///
/// Samples are numbered. Lost ones are filled in by a straight line when the next one comes, a
/// silent sensor by its last value; with more than a quarter of the window filled in there is no
/// estimate. A late sample takes its place if the window still holds it, a repeated one is answered
/// with the last estimate. A message that is not a sample is answered with `{"error": …}` and changes
/// nothing. The model stays the same for the whole session, even if an alias moves.
#[utoipa::path(
    get, path = "/v1/models/{model_id}/stream", tag = "models", operation_id = "stream",
    params(("model_id" = String, Path, description = "Model or alias", example = "boom@stable")),
    responses(
        (status = 101, description = "The session is open"),
        (status = 426, description = "Not a WebSocket request", body = Problem, content_type = "application/problem+json"),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn stream(
    State(state): State<AppState>,
    Id(reference): Id<ModelRef>,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, ApiError> {
    let model = state
        .models()
        .find(&reference, state.ledger(), state.blobs())
        .await?;
    let upgrade = upgrade.map_err(|rejection| ApiError::UpgradeRequired(rejection.body_text()))?;
    let permit = state.gate().session()?;
    Ok(upgrade
        .max_message_size(MESSAGE_LIMIT_BYTES)
        .max_frame_size(MESSAGE_LIMIT_BYTES)
        // A session in a thousand: small buffers, and every answer leaves at once.
        .read_buffer_size(4 << 10)
        .write_buffer_size(0)
        .max_write_buffer_size(256 << 10)
        .on_upgrade(move |socket| async move {
            metrics::gauge!("hydroflex_stream_sessions").increment(1.0);
            // However it ends, the client sees it; there is nobody else to tell.
            let _ = converse(socket, Session::new(model)).await;
            metrics::gauge!("hydroflex_stream_sessions").decrement(1.0);
            drop(permit);
        }))
}

async fn converse(mut socket: WebSocket, mut session: Session) -> Result<(), axum::Error> {
    let opened = serde_json::to_string(&session.opened()).map_err(axum::Error::new)?;
    send(&mut socket, Message::text(opened)).await?;
    let mut answer = Vec::new();
    let mut is_asked = false;
    loop {
        let message = match tokio::time::timeout(SILENCE, socket.recv()).await {
            Ok(None) => return Ok(()),
            Ok(Some(message)) => message?,
            Err(_) if is_asked => {
                let reason = CloseFrame {
                    code: close_code::POLICY,
                    reason: "nothing was heard from the client".into(),
                };
                return send(&mut socket, Message::Close(Some(reason))).await;
            }
            Err(_) => {
                is_asked = true;
                send(&mut socket, Message::Ping(axum::body::Bytes::new())).await?;
                continue;
            }
        };
        is_asked = false;
        let result = match message {
            Message::Text(text) => session
                .text(&text)
                .and_then(|estimate| serde_json::to_string(&estimate).map_err(|error| error.to_string()))
                .map(Message::text),
            Message::Binary(bytes) => session
                .binary(&bytes, &mut answer)
                .map(|()| Message::binary(Bytes::copy_from_slice(&answer))),
            Message::Ping(_) | Message::Pong(_) => continue,
            Message::Close(_) => return Ok(()),
        };
        let message =
            result.unwrap_or_else(|error| Message::text(serde_json::json!({ "error": error }).to_string()));
        send(&mut socket, message).await?;
    }
}

/// A client that does not read is given up: its answers would pile up.
async fn send(socket: &mut WebSocket, message: Message) -> Result<(), axum::Error> {
    match tokio::time::timeout(SILENCE, socket.send(message)).await {
        Ok(result) => result,
        Err(elapsed) => Err(axum::Error::new(elapsed)),
    }
}

/// Types of a session's messages, which no operation of the document names as a body.
#[derive(utoipa::OpenApi)]
#[openapi(components(schemas(StreamOpened, StreamSample, StreamEstimate)))]
pub struct StreamDocument;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_form_that_the_caller_takes_is_given() {
        let arrow = Form::Table(TableForm::Arrow);
        let of = |accept: &str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::ACCEPT, accept.parse().unwrap());
            Form::of_answer(&headers, arrow).ok()
        };
        assert_eq!(of("*/*"), Some(arrow));
        assert_eq!(of("application/json"), Some(Form::Json));
        assert_eq!(of("text/html, application/json; q=0.5, */*"), Some(Form::Json));
        assert_eq!(
            of("application/json;q=0, application/vnd.apache.parquet"),
            Some(Form::Table(TableForm::Parquet))
        );
        assert_eq!(of("text/html"), None);
        assert_eq!(Form::of_answer(&HeaderMap::new(), arrow).ok(), Some(arrow));
    }
}
