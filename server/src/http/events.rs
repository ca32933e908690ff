//! `/v1/jobs/{id}/events`: what happens to a job as it happens, replayed from any point.

use super::AppState;
use super::error::ApiError;
use super::extract::Id;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures::stream::{self, Stream};
use hydroflex_ledger::{Ledger, LedgerError};
use hydroflex_openapi::event::JobEvent;
use hydroflex_openapi::id::JobId;
use hydroflex_openapi::problem::{FieldError, Problem};
use std::collections::VecDeque;
use std::time::Duration;

/// How often the ledger is asked for news. Workers write to it from other processes, so nothing in
/// this one could wake a listener earlier.
const POLL: Duration = Duration::from_millis(200);
/// Events fetched at a time.
const BATCH: u64 = 256;

/// Follow a job
///
/// Server-sent events; the `id` of each is its sequence number, the `data` a `JobEvent`. Reconnect with
/// `Last-Event-ID` to go on where the connection broke, even over a restart of the service. The stream
/// ends when the job does; after that the answer is 204.
#[utoipa::path(
    get, path = "/v1/jobs/{job_id}/events", tag = "jobs", operation_id = "follow_job",
    params(
        ("job_id" = JobId, Path),
        ("Last-Event-ID" = Option<u64>, Header, description = "Sequence number of the last event seen"),
    ),
    responses(
        (status = 200, description = "Events", body = JobEvent, content_type = "text/event-stream"),
        (status = 204, description = "The job is over and every event has been seen"),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn follow(
    State(state): State<AppState>,
    Id(id): Id<JobId>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let after = match headers.get("last-event-id") {
        None => 0,
        Some(value) => value
            .to_str()
            .ok()
            .and_then(|text| text.parse().ok())
            .ok_or_else(|| {
                ApiError::field(
                    FieldError::new("Last-Event-ID", "not a sequence number").allowed("a whole number"),
                )
            })?,
    };
    let job = state
        .ledger()
        .job(id)
        .await?
        .ok_or_else(|| ApiError::NotFound(format!("no job {id}")))?;
    if job.state.is_final() && after >= job.last_sequence {
        return Ok(StatusCode::NO_CONTENT.into_response());
    }
    let keep_alive = KeepAlive::new().interval(Duration::from_secs(15));
    Ok(Sse::new(events(state.ledger().clone(), id, after))
        .keep_alive(keep_alive)
        .into_response())
}

struct Follower {
    ledger: Ledger,
    job: JobId,
    after: u64,
    pending: VecDeque<JobEvent>,
    over: bool,
}

fn events(ledger: Ledger, job: JobId, after: u64) -> impl Stream<Item = Result<Event, LedgerError>> {
    let follower = Follower {
        ledger,
        job,
        after,
        pending: VecDeque::new(),
        over: false,
    };
    stream::try_unfold(follower, |mut follower| async move {
        loop {
            if let Some(event) = follower.pending.pop_front() {
                follower.after = event.sequence;
                let data = serde_json::to_string(&event)?;
                let sent = Event::default()
                    .id(event.sequence.to_string())
                    .event(event.what.name())
                    .data(data);
                return Ok(Some((sent, follower)));
            }
            if follower.over {
                return Ok(None);
            }
            let news = follower
                .ledger
                .events(follower.job, follower.after, BATCH)
                .await?;
            if news.is_empty() {
                let job = follower.ledger.job(follower.job).await?;
                match job {
                    Some(job) if !job.state.is_final() => tokio::time::sleep(POLL).await,
                    // An event may have come between the two questions.
                    Some(job) if job.last_sequence > follower.after => {}
                    _ => follower.over = true,
                }
            }
            follower.pending = news.into();
        }
    })
}
