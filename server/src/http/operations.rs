//! For operators: health, readiness, metrics.

use super::AppState;
use super::error::ApiError;
use axum::extract::{MatchedPath, Request, State};
use axum::http::{Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use hydroflex_openapi::problem::Problem;
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// Probes ask often: one that hangs is answered "not ready" instead.
const READY_WITHIN: Duration = Duration::from_secs(5);

/// The process's recorder of metrics; made by whoever asks first.
#[must_use]
pub fn recorder() -> &'static PrometheusHandle {
    static HANDLE: OnceLock<PrometheusHandle> = OnceLock::new();
    HANDLE.get_or_init(|| {
        let buckets = [
            0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0,
        ];
        let builder = PrometheusBuilder::new();
        let builder = match builder.set_buckets_for_metric(
            Matcher::Full("hydroflex_http_request_seconds".to_owned()),
            &buckets,
        ) {
            Ok(builder) => builder,
            Err(_) => PrometheusBuilder::new(),
        };
        let recorder = builder.build_recorder();
        let handle = recorder.handle();
        // Fails only if a library user has installed another recorder; ours then stays empty.
        let _ = metrics::set_global_recorder(recorder);
        handle
    })
}

/// Counts and times a request by its route, never by its path: paths are without number.
pub async fn measure(request: Request, next: Next) -> Response {
    let method = match *request.method() {
        Method::GET => "GET",
        Method::HEAD => "HEAD",
        Method::POST => "POST",
        _ => "other",
    };
    let route = request
        .extensions()
        .get::<MatchedPath>()
        .map_or_else(|| "none".to_owned(), |path| path.as_str().to_owned());
    let start = Instant::now();
    let response = next.run(request).await;
    let status = response.status().as_u16().to_string();
    metrics::counter!(
        "hydroflex_http_requests_total", "method" => method, "route" => route.clone(), "status" => status
    )
    .increment(1);
    metrics::histogram!("hydroflex_http_request_seconds", "method" => method, "route" => route)
        .record(start.elapsed().as_secs_f64());
    response
}

/// The process answers
#[utoipa::path(
    get, path = "/health/live", tag = "operations", operation_id = "live",
    responses((status = 200, description = "Alive", body = String, content_type = "text/plain")),
)]
pub async fn live() -> &'static str {
    "live\n"
}

/// The service can do its work: database and store answer
#[utoipa::path(
    get, path = "/health/ready", tag = "operations", operation_id = "ready",
    responses(
        (status = 200, description = "Ready", body = String, content_type = "text/plain"),
        (status = "default", description = "Not ready", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn ready(State(state): State<AppState>) -> Result<&'static str, ApiError> {
    let asked = async {
        state
            .ledger()
            .ping()
            .await
            .map_err(|error| ApiError::Unavailable(error.to_string()))?;
        state
            .blobs()
            .ping()
            .await
            .map_err(|error| ApiError::Unavailable(error.to_string()))
    };
    match tokio::time::timeout(READY_WITHIN, asked).await {
        Ok(Ok(())) => Ok("ready\n"),
        Ok(Err(error)) => Err(error),
        Err(_) => Err(ApiError::Unavailable(format!(
            "database and store did not answer within {} s",
            READY_WITHIN.as_secs()
        ))),
    }
}

/// Metrics in Prometheus' text format
#[utoipa::path(
    get, path = "/metrics", tag = "operations", operation_id = "metrics",
    responses(
        (status = 200, description = "Metrics", body = String, content_type = "text/plain"),
        (status = "default", description = "Refused", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub async fn metrics(State(state): State<AppState>) -> Result<Response, ApiError> {
    for (job_state, count) in state.ledger().job_counts().await? {
        metrics::gauge!("hydroflex_jobs", "state" => job_state.as_str()).set(count as f64);
    }
    for (shard_state, count) in state.ledger().shard_counts().await? {
        metrics::gauge!("hydroflex_shards", "state" => shard_state).set(count as f64);
    }
    let spent = state.ledger().time_spent().await?;
    for (what, seconds) in [
        ("simulate", spent.simulate_s),
        ("encode", spent.encode_s),
        ("put", spent.put_s),
        ("wait", spent.wait_s),
    ] {
        metrics::gauge!("hydroflex_worker_seconds", "what" => what).set(seconds);
    }
    metrics::gauge!("hydroflex_workers").set(state.ledger().beats().await?.len() as f64);
    let text = recorder().render();
    Ok((
        StatusCode::OK,
        [(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")],
        text,
    )
        .into_response())
}
