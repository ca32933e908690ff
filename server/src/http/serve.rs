//! Connections: how many, and how patient the service is with each of them.
//!
//! A client that sends its headers too slowly, takes nothing of its answer or is gone without a word
//! costs one idle connection for a minute and nothing else.

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use socket2::{SockRef, TcpKeepalive};
use std::io;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

/// Connections at once; more wait in the system's queue.
const CONNECTIONS: usize = 16_384;
/// Time for the headers of a request, counted from the end of the one before.
const HEADER_TIME: Duration = Duration::from_mins(1);
/// Largest head of a request.
const HEAD_LIMIT_BYTES: usize = 64 << 10;
/// Time for a client to take what was sent.
const SEND_TIME: Duration = Duration::from_mins(1);
/// Pause between two times that measurements are counted into their histograms: until then each takes
/// memory, and nobody may ever ask for them.
const UPKEEP: Duration = Duration::from_secs(5);
/// Pause when the system has no more descriptors.
const EXHAUSTED: Duration = Duration::from_millis(100);

/// Serves until told to stop, then lets open requests end.
///
/// # Errors
/// Nothing that a client does; only what makes listening impossible.
pub async fn serve(listener: TcpListener, router: Router, stop: CancellationToken) -> io::Result<()> {
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIME)
        .max_buf_size(HEAD_LIMIT_BYTES);
    let places = Arc::new(Semaphore::new(CONNECTIONS));
    let open = TaskTracker::new();
    let upkeep = tokio::spawn(async {
        loop {
            tokio::time::sleep(UPKEEP).await;
            super::operations::recorder().run_upkeep();
        }
    });
    loop {
        // The semaphore is never closed.
        let Ok(place) = places.clone().acquire_owned().await else {
            break;
        };
        let stream = tokio::select! {
            () = stop.cancelled() => break,
            accepted = listener.accept() => match accepted {
                Ok((stream, _)) => stream,
                Err(error) => {
                    // A connection that ended while it waited is nobody's loss; without descriptors
                    // the next attempt would fail at once.
                    if !matches!(error.kind(), io::ErrorKind::ConnectionAborted | io::ErrorKind::ConnectionReset) {
                        tracing::warn!(%error, "cannot accept a connection");
                        tokio::time::sleep(EXHAUSTED).await;
                    }
                    continue;
                }
            },
        };
        prepare(&stream);
        let connection = http
            .serve_connection(TokioIo::new(stream), TowerToHyperService::new(router.clone()))
            .with_upgrades();
        let stop = stop.clone();
        open.spawn(async move {
            let mut connection = std::pin::pin!(connection);
            // An error here is a client that went away or spoke something else.
            tokio::select! {
                _ = connection.as_mut() => {}
                () = stop.cancelled() => {
                    connection.as_mut().graceful_shutdown();
                    let _ = connection.await;
                }
            }
            drop(place);
        });
    }
    open.close();
    open.wait().await;
    upkeep.abort();
    Ok(())
}

/// Answers leave at once; a peer that is gone or takes nothing is noticed. Without these options the
/// connection works too, so a system that has not got one of them is no reason to refuse it.
fn prepare(stream: &TcpStream) {
    let _ = stream.set_nodelay(true);
    let socket = SockRef::from(stream);
    let _ = socket.set_tcp_keepalive(&TcpKeepalive::new().with_time(SEND_TIME));
    #[cfg(target_os = "linux")]
    let _ = socket.set_tcp_user_timeout(Some(SEND_TIME));
}
