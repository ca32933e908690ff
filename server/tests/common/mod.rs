#![allow(
    dead_code,
    reason = "every test file is a crate of its own and uses a part of this"
)]
//! The whole router around a ledger and a store in a temporary directory; no workers, no sockets.

pub(crate) mod models;

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

/// What means something to one of the formats.
const TELLING: &[&[u8]] = &[
    b"null",
    b"1e999",
    b"-0",
    b"[[[[[[[[",
    b"{}",
    b"\"",
    b"\\ud800",
    b"NaN",
    b"18446744073709551616",
    b",",
    b"\0",
    b"\xff\xff\xff\xff",
    b"9223372036854775807",
];

/// A body with a few bytes changed, lost, doubled, moved or cut off; the same for the same seed.
pub(crate) fn damaged(body: &[u8], seed: u64) -> Vec<u8> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = |below: usize| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        usize::try_from(state >> 33).unwrap() % below.max(1)
    };
    let mut body = body.to_vec();
    for _ in 0..=next(4) {
        let at = next(body.len());
        let length = next(16).min(body.len() - at);
        match next(7) {
            0 => body.truncate(at),
            1 => drop(body.drain(at..at + length)),
            2 => {
                let piece = body[at..at + length].to_vec();
                let to = next(body.len() + 1);
                drop(body.splice(to..to, piece));
            }
            3 => {
                if let Some(byte) = body.get_mut(at) {
                    *byte ^= 1 << next(8);
                }
            }
            4 => {
                if let Some(byte) = body.get_mut(at) {
                    *byte = u8::try_from(next(256)).unwrap();
                }
            }
            _ => {
                let telling = TELLING[next(TELLING.len())].iter().copied();
                drop(body.splice(at..at + length, telling));
            }
        }
    }
    body
}
