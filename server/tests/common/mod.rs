#![allow(
    dead_code,
    unused_imports,
    reason = "every test file is a crate of its own and uses a part of this"
)]
//! The whole router around a ledger and a store in a temporary directory; no workers, no sockets.

pub(crate) mod damage;
pub(crate) mod models;

pub(crate) use damage::damaged;

use axum::Router;
use axum::body::Body;
use axum::http::{HeaderMap, Request, StatusCode};
use hydroflex_ledger::Ledger;
use hydroflex_ledger::blobs::Blobs;
use hydroflex_openapi::problem::{PROBLEM_MEDIA_TYPE, Problem};
use hydroflex_server::coordinator::{Coordinator, CoordinatorConfig};
use hydroflex_server::http::AppState;
use std::time::Duration;
use tower::ServiceExt;

pub(crate) struct Desk {
    pub(crate) ledger: Ledger,
    pub(crate) blobs: Blobs,
    pub(crate) state: AppState,
    router: Router,
    _folder: tempfile::TempDir,
}

pub(crate) struct Answer {
    pub(crate) status: StatusCode,
    pub(crate) headers: HeaderMap,
    pub(crate) body: Vec<u8>,
}

impl Desk {
    pub(crate) async fn new() -> Self {
        Self::with(1000, false).await
    }

    /// A desk that looks after at most so many jobs, or asks for keys.
    pub(crate) async fn with(most_jobs: u64, keys: bool) -> Self {
        Self::changed(most_jobs, |state| if keys { state.behind_keys() } else { state }).await
    }

    /// A desk whose state is changed before it opens.
    pub(crate) async fn changed(most_jobs: u64, change: impl FnOnce(AppState) -> AppState) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let url = format!("sqlite:{}", folder.path().join("ledger.sqlite").display());
        let ledger = Ledger::create(&url).await.unwrap();
        let blobs = Blobs::directory(&folder.path().join("store")).unwrap();
        let config = CoordinatorConfig {
            scratch: folder.path().join("scratch"),
            // Reduced bodies are kept between tests: making them takes seconds.
            cache: std::env::temp_dir().join("hydroflex-test-cache"),
            workers: 2,
            lease: Duration::from_secs(10),
            most_jobs,
            orphan_grace: Duration::from_mins(10),
        };
        let coordinator = Coordinator::new(ledger.clone(), blobs.clone(), config);
        let state = change(AppState::new(coordinator));
        let router = hydroflex_server::app(state.clone());
        Self {
            ledger,
            blobs,
            state,
            router,
            _folder: folder,
        }
    }

    pub(crate) async fn send(
        &self,
        method: &str,
        path: &str,
        headers: &[(&str, &str)],
        body: impl Into<Body>,
    ) -> Answer {
        let mut request = Request::builder().method(method).uri(path);
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        let response = self
            .router
            .clone()
            .oneshot(request.body(body.into()).unwrap())
            .await
            .unwrap();
        let (parts, body) = response.into_parts();
        let body = axum::body::to_bytes(body, usize::MAX).await.unwrap().to_vec();
        Answer {
            status: parts.status,
            headers: parts.headers,
            body,
        }
    }

    /// Serves on a free port until the test ends.
    pub(crate) async fn listen(&self) -> std::net::SocketAddr {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let stop = tokio_util::sync::CancellationToken::new();
        tokio::spawn(hydroflex_server::http::serve::serve(
            listener,
            self.router.clone(),
            stop,
        ));
        address
    }

    pub(crate) async fn get(&self, path: &str) -> Answer {
        self.send("GET", path, &[], Body::empty()).await
    }

    pub(crate) async fn post(&self, path: &str, body: &str) -> Answer {
        self.send(
            "POST",
            path,
            &[("content-type", "application/json")],
            body.to_owned(),
        )
        .await
    }
}

impl Answer {
    pub(crate) fn header(&self, name: &str) -> &str {
        self.headers.get(name).map_or("", |value| value.to_str().unwrap())
    }

    pub(crate) fn json<T: serde::de::DeserializeOwned>(&self) -> T {
        serde_json::from_slice(&self.body)
            .unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&self.body)))
    }

    /// The problem, if the answer is one of this status.
    pub(crate) fn problem(&self, status: u16) -> Problem {
        assert_eq!(
            self.status.as_u16(),
            status,
            "{}",
            String::from_utf8_lossy(&self.body)
        );
        assert_eq!(self.header("content-type"), PROBLEM_MEDIA_TYPE);
        let problem: Problem = self.json();
        assert_eq!(problem.status, status);
        problem
    }
}
