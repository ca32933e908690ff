//! A whole service with one model, asked in process: no answer may be an error of its own.

#[path = "../../../server/tests/common/register.rs"]
mod register;

use axum::body::Body;
use axum::http::{Request, StatusCode};
use hydroflex_ledger::Ledger;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_ml::predict::synthetic::{SyntheticModel, SyntheticSpec};
use hydroflex_server::coordinator::{Coordinator, CoordinatorConfig};
use hydroflex_server::http::AppState;
use hydroflex_server::prediction::LoadedModel;
use hydroflex_server::prediction::session::Session;
use std::sync::{Arc, LazyLock};
use std::time::Duration;
use tower::ServiceExt;

struct Service {
    runtime: tokio::runtime::Runtime,
    router: axum::Router,
    id: String,
    model: Arc<LoadedModel>,
    _data: tempfile::TempDir,
}

static SERVICE: LazyLock<Service> = LazyLock::new(|| {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .expect("a runtime");
    let data = tempfile::tempdir().expect("a directory");
    let (state, id, model) = runtime.block_on(async {
        let url = format!("sqlite:{}", data.path().join("ledger.sqlite").display());
        let ledger = Ledger::create(&url).await.expect("a ledger");
        let blobs = Blobs::directory(&data.path().join("store")).expect("a store");
        let folder = data.path().join("model");
        SyntheticModel::new(&SyntheticSpec {
            structure: "RLR".to_owned(),
            window_steps: 4,
            targets: 1,
            seed: 1,
        })
        .expect("a model")
        .write(&folder)
        .expect("a model folder");
        let id = register::register_folder(&ledger, &blobs, &folder).await;
        let config = CoordinatorConfig {
            scratch: data.path().join("scratch"),
            cache: data.path().join("cache"),
            workers: 1,
            lease: Duration::from_secs(10),
            most_jobs: 1000,
            orphan_grace: Duration::from_mins(10),
        };
        let state = AppState::new(Coordinator::new(ledger, blobs, config));
        let model = state
            .models()
            .get(&id, state.ledger(), state.blobs())
            .await
            .expect("the model loads");
        (state, id.to_string(), model)
    });
    Service {
        runtime,
        router: hydroflex_server::app(state),
        id,
        model,
        _data: data,
    }
});

fn ask(request: Request<Body>) {
    let service = &*SERVICE;
    let status = service.runtime.block_on(async {
        let Ok(answer) = service.router.clone().oneshot(request).await;
        let status = answer.status();
        let _ = axum::body::to_bytes(answer.into_body(), usize::MAX).await;
        status
    });
    assert!(
        !status.is_server_error() || status == StatusCode::NOT_IMPLEMENTED,
        "{status}"
    );
}

fn path(of: &str) -> String {
    let id = &SERVICE.id;
    match of {
        "infer" => format!("/v2/models/{id}/infer"),
        "predict" => format!("/v1/models/{id}/predict"),
        other => format!("/v1/{other}"),
    }
}

/// A body of a media type.
///
/// # Panics
/// When the service answers with an error of its own.
pub fn post(to: &str, media_type: &str, body: &[u8]) {
    let request = Request::post(path(to))
        .header("content-type", media_type)
        .body(Body::from(body.to_vec()));
    ask(request.expect("a request"));
}

/// Binary tensors: the first two bytes are the length of the JSON.
///
/// # Panics
/// When the service answers with an error of its own.
pub fn infer_bytes(data: &[u8]) {
    let Some((length, body)) = data.split_first_chunk::<2>() else {
        return;
    };
    let request = Request::post(path("infer"))
        .header("content-type", "application/octet-stream")
        .header("inference-header-content-length", u16::from_le_bytes(*length))
        .body(Body::from(body.to_vec()));
    ask(request.expect("a request"));
}

/// A message of a live session, after a valid beginning of one.
pub fn message(data: &[u8]) {
    let Some((kind, content)) = data.split_first() else {
        return;
    };
    let mut session = Session::new(SERVICE.model.clone());
    if kind % 2 == 1 {
        if let Ok(text) = std::str::from_utf8(content) {
            let _ = session.text(text);
        }
    } else {
        let mut answer = Vec::new();
        for piece in content.chunks(48) {
            let _ = session.binary(piece, &mut answer);
        }
    }
}

/// The query of a list, as far as it can stand in a URL.
///
/// # Panics
/// When the service answers with an error of its own.
pub fn query(data: &[u8]) {
    for list in ["jobs", "datasets", "models", "machines"] {
        let text: String = data.iter().map(|&byte| char::from(byte)).collect();
        if let Ok(request) = Request::get(format!("/v1/{list}?{text}")).body(Body::empty()) {
            ask(request);
        }
        if let Ok(request) = Request::get(format!("/v1/{list}?limit=3&cursor={text}")).body(Body::empty()) {
            ask(request);
        }
    }
}
