//! The REST interface: one file per resource, one map from errors to statuses.
//!
//! Deliberately absent: any request field that names a path or a URL which the service would read.

#![allow(
    clippy::missing_errors_doc,
    reason = "the comment of a handler is its description in the OpenAPI document, which lists its errors one by one"
)]

pub mod error;
pub mod auth;
pub mod extract;
pub mod body;
pub mod jobs;
pub mod events;
pub mod datasets;
pub mod files;
pub mod archive;
pub mod trainings;
pub mod sweeps;
pub mod models;
pub mod predict;
pub mod aliases;
pub mod inference;
pub mod machines;
pub mod meshes;
pub mod operations;
pub mod serve;

use crate::coordinator::Coordinator;
use crate::prediction::ModelRegistry;
use crate::prediction::gate::Gate;
use axum::Router;
use axum::extract::{DefaultBodyLimit, Request};
use axum::http::{Method, Uri};
use axum::response::{IntoResponse, Redirect, Response};
use error::ApiError;
use hydroflex_ledger::Ledger;
use hydroflex_ledger::blobs::Blobs;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tower_http::CompressionLevel;
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::compression::CompressionLayer;
use tower_http::compression::predicate::{NotForContentType, Predicate, SizeAbove};
use tower_http::decompression::RequestDecompressionLayer;
use tower_http::timeout::RequestBodyTimeoutLayer;
use utoipa::OpenApi;
use utoipa_axum::router::{OpenApiRouter, UtoipaMethodRouterExt};
use utoipa_axum::routes;
use utoipa_swagger_ui::SwaggerUi;

/// Answers from this size on are compressed for callers who ask for it.
const COMPRESSED_FROM_BYTES: u64 = 1024;
/// Silence in the middle of a body after which its sender is given up.
const BODY_SILENCE: Duration = Duration::from_secs(30);

/// What every handler may use.
#[derive(Clone)]
pub struct AppState {
    coordinator: Coordinator,
    models: Arc<ModelRegistry>,
    gate: Arc<Gate>,
    door: Arc<auth::Door>,
}

impl AppState {
    /// The state of a service around a coordinator.
    #[must_use]
    pub fn new(coordinator: Coordinator) -> Self {
        Self {
            coordinator,
            models: Arc::default(),
            gate: Arc::default(),
            door: Arc::new(auth::Door::new(false)),
        }
    }

    /// The same, asking for API keys.
    #[must_use]
    pub fn behind_keys(mut self) -> Self {
        self.door = Arc::new(auth::Door::new(true));
        self
    }

    /// The same behind another gate.
    #[must_use]
    pub fn behind_gate(mut self, gate: Gate) -> Self {
        self.gate = Arc::new(gate);
        self
    }

    /// Who may come in.
    #[must_use]
    pub fn door(&self) -> &auth::Door {
        &self.door
    }

    /// The coordinator.
    #[must_use]
    pub fn coordinator(&self) -> &Coordinator {
        &self.coordinator
    }

    /// The ledger.
    #[must_use]
    pub fn ledger(&self) -> &Ledger {
        self.coordinator.ledger()
    }

    /// The store.
    #[must_use]
    pub fn blobs(&self) -> &Blobs {
        self.coordinator.blobs()
    }

    /// How much is estimated at once.
    #[must_use]
    pub fn gate(&self) -> &Gate {
        &self.gate
    }

    /// Directory for recordings that are too long for memory.
    #[must_use]
    pub fn prediction_scratch(&self) -> PathBuf {
        self.coordinator.config().scratch.join("predictions")
    }

    /// Models in memory.
    #[must_use]
    pub fn models(&self) -> &ModelRegistry {
        &self.models
    }
}

/// Head of the published document.
#[derive(OpenApi)]
#[openapi(
    info(
        title = "hydroflex",
        description = "Simulate hydraulically driven flexible booms, train SLIDE networks, estimate \
            deflection, strain and stress.\n\nUnits are the last part of every name. Errors are \
            `application/problem+json` and say which field, what value, what is allowed.",
    ),
    tags(
        (name = "jobs", description = "Batches of random runs, and the networks trained on them"),
        (name = "data sets", description = "Published trajectories, immutable, addressed by content"),
        (name = "trainings", description = "Networks for published data sets"),
        (name = "sweeps", description = "Structures × sensors × windows × seeds on a published data set, as one request"),
        (name = "models", description = "Trained networks and their estimates"),
        (name = "inference", description = "The same estimates by the Open Inference Protocol, version 2"),
        (name = "machines", description = "What can be simulated"),
        (name = "operations", description = "For whoever runs the service"),
    ),
)]
struct Document;

fn routes() -> OpenApiRouter<AppState> {
    OpenApiRouter::with_openapi(Document::openapi())
        .routes(routes!(jobs::submit, jobs::list))
        .routes(routes!(jobs::show))
        .routes(routes!(jobs::cancel))
        .routes(routes!(jobs::retry))
        .routes(routes!(events::follow))
        .routes(routes!(datasets::list))
        .routes(routes!(datasets::show))
        .routes(routes!(datasets::archive))
        .routes(routes!(trainings::submit))
        .routes(routes!(trainings::show))
        .routes(routes!(sweeps::submit, sweeps::list))
        .routes(routes!(sweeps::show))
        .routes(routes!(sweeps::cancel))
        .routes(routes!(sweeps::retry))
        .routes(routes!(sweeps::table))
        .routes(routes!(sweeps::table_csv))
        .routes(routes!(sweeps::table_markdown))
        .routes(routes!(sweeps::plot))
        .routes(routes!(models::list))
        .routes(routes!(models::show))
        .merge(prediction_routes())
        .routes(routes!(machines::list))
        .routes(routes!(machines::show))
        .routes(routes!(meshes::upload).layer(DefaultBodyLimit::max(meshes::MESH_LIMIT_BYTES)))
        .routes(routes!(operations::live))
        .routes(routes!(operations::ready))
        .routes(routes!(operations::metrics))
}

/// Estimates: bodies may be compressed, and must not be silent for long.
fn prediction_routes() -> OpenApiRouter<AppState> {
    let worth_it = SizeAbove::new(COMPRESSED_FROM_BYTES)
        .and(NotForContentType::new("application/vnd.apache"))
        .and(NotForContentType::SSE);
    let inference = OpenApiRouter::new()
        .routes(routes!(inference::server))
        .routes(routes!(inference::live))
        .routes(routes!(inference::ready))
        .routes(routes!(inference::model))
        .routes(routes!(inference::model_version))
        .routes(routes!(inference::model_ready))
        .routes(routes!(inference::model_version_ready))
        .routes(routes!(inference::infer))
        .routes(routes!(inference::infer_version));
    OpenApiRouter::new()
        .routes(routes!(predict::predict))
        .merge(inference)
        .layer(RequestDecompressionLayer::new())
        .layer(
            CompressionLayer::new()
                .quality(CompressionLevel::Fastest)
                .compress_when(worth_it),
        )
        .layer(RequestBodyTimeoutLayer::new(BODY_SILENCE))
        .routes(routes!(predict::stream))
        .routes(routes!(aliases::list))
        .routes(routes!(aliases::show, aliases::put))
}

/// Handlers whose path holds slashes: axum writes `{*path}`, OpenAPI has no word for it.
fn file_routes() -> Router<AppState> {
    Router::new()
        .route(
            "/v1/datasets/{dataset_id}/files/{*path}",
            axum::routing::get(datasets::file),
        )
        .route(
            "/v1/models/{model_id}/files/{*path}",
            axum::routing::get(models::file),
        )
}

/// Document of the two handlers of [`file_routes`].
#[derive(OpenApi)]
#[openapi(paths(datasets::file, models::file))]
struct FileDocument;

/// The published document.
#[must_use]
pub fn openapi() -> utoipa::openapi::OpenApi {
    let (_, mut document) = routes().split_for_parts();
    document.merge(FileDocument::openapi());
    document.merge(predict::StreamDocument::openapi());
    document
}

/// The whole service as one function.
pub fn router(state: AppState) -> Router {
    // From the first request on; it is there once per process however many routers are made.
    let _ = operations::recorder();
    let (router, _) = routes().split_for_parts();
    router
        .merge(file_routes())
        .with_state(state.clone())
        .merge(SwaggerUi::new("/docs").url("/openapi.json", openapi()))
        .route(
            "/",
            axum::routing::get(|| async { Redirect::temporary("/docs/") }),
        )
        .fallback(unknown_path)
        .method_not_allowed_fallback(unknown_method)
        .layer(DefaultBodyLimit::max(extract::BODY_LIMIT_BYTES))
        .layer(axum::middleware::from_fn_with_state(state, auth::guard))
        .layer(CatchPanicLayer::custom(panicked))
        .layer(axum::middleware::from_fn(operations::measure))
}

async fn unknown_path(uri: Uri) -> ApiError {
    ApiError::NotFound(format!("nothing is at {}", uri.path()))
}

async fn unknown_method(method: Method, request: Request) -> ApiError {
    ApiError::MethodNotAllowed(format!("{method} is not done at {}", request.uri().path()))
}

#[allow(clippy::needless_pass_by_value, reason = "the signature is tower-http's")]
fn panicked(cause: Box<dyn std::any::Any + Send>) -> Response {
    let text = cause
        .downcast_ref::<String>()
        .map(String::as_str)
        .or_else(|| cause.downcast_ref::<&str>().copied())
        .unwrap_or("a panic without a message");
    ApiError::Internal(format!("panic: {text}")).into_response()
}
