//! Bodies that are received before they are computed, and what becomes of those that are not.
//!
//! Receiving is what takes long of a large body, so the gate is asked before the first byte of it: one
//! whose length is told is admitted or refused at its head, any other as soon as it turns out to be large.

use crate::prediction::gate::{Busy, Gate};
use axum::body::{Body, BodyDataStream, Bytes};
use axum::http::{HeaderMap, HeaderName, header};
use futures::StreamExt;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::{Instant, sleep, timeout_at};

/// Bodies up to here are received without asking: that takes less than a refusal saves.
pub const LARGE_BYTES: usize = 256 << 10;
/// Time in which a large body is there if its sender is no slower than this service. Afterwards it takes
/// the place of an upload: a slow sender costs no time, and must not keep the others away.
const PROMPT: Duration = Duration::from_millis(500);
/// Time for which the rest of a refused body is read away, so that clients that read only when they have
/// sent everything see the answer and no reset.
const LINGER: Duration = Duration::from_secs(10);
/// Pause after each piece (up to 64 KiB) that is read away: 16 MB/s.
const LINGER_PAUSE: Duration = Duration::from_millis(4);

/// Header of an answer after which the rest of the request is not waited for.
pub const CLOSING: [(HeaderName, &str); 1] = [(header::CONNECTION, "close")];

/// A body, and its place among the large ones until this is dropped.
pub struct Received {
    /// The body, decompressed.
    pub bytes: Bytes,
    /// Kept to the end of the work.
    pub place: Option<OwnedSemaphorePermit>,
}

/// Why a body was not received.
#[derive(Debug)]
pub enum NotReceived {
    /// Too many large ones are. Answered with [`CLOSING`].
    Busy,
    /// It is larger than this. Answered with [`CLOSING`].
    TooLarge {
        /// Largest body.
        limit_bytes: usize,
    },
    /// It broke off, fell silent or cannot be decompressed.
    Broken(String),
}

/// Receives a body of at most `limit_bytes`. The rest of one that is refused is read away for a while.
///
/// # Errors
/// If the body is refused or does not come.
pub async fn receive(
    gate: &Gate,
    headers: &HeaderMap,
    body: Body,
    limit_bytes: usize,
) -> Result<Received, NotReceived> {
    let mut body = body.into_data_stream();
    match collect(gate, headers, &mut body, limit_bytes).await {
        Err(NotReceived::Broken(detail)) => Err(NotReceived::Broken(detail)),
        Err(refused) => {
            read_away(gate, headers, body);
            Err(refused)
        }
        received => received,
    }
}

async fn collect(
    gate: &Gate,
    headers: &HeaderMap,
    body: &mut BodyDataStream,
    limit_bytes: usize,
) -> Result<Received, NotReceived> {
    // Missing where the body is chunked or compressed.
    let told_bytes: Option<usize> = headers
        .get(header::CONTENT_LENGTH)
        .and_then(|value| value.to_str().ok()?.parse().ok());
    if told_bytes.is_some_and(|told| told > limit_bytes) {
        return Err(NotReceived::TooLarge { limit_bytes });
    }
    let mut place = None;
    let mut prompt_until = None;
    let mut expected_bytes = told_bytes.unwrap_or(0);
    let mut first = Bytes::new();
    let mut all = Vec::new();
    loop {
        if expected_bytes > LARGE_BYTES && place.is_none() {
            place = Some(gate.large().await?);
            prompt_until = Some(Instant::now() + PROMPT);
        }
        let piece = match prompt_until {
            None => body.next().await,
            Some(until) => {
                if let Ok(piece) = timeout_at(until, body.next()).await {
                    piece
                } else {
                    place = Some(gate.upload()?);
                    prompt_until = None;
                    continue;
                }
            }
        };
        let received_bytes = first.len() + all.len();
        let Some(piece) = piece else {
            let bytes = if all.is_empty() { first } else { all.into() };
            return Ok(Received { bytes, place });
        };
        let piece = piece.map_err(|error| NotReceived::Broken(error.to_string()))?;
        if received_bytes + piece.len() > limit_bytes {
            return Err(NotReceived::TooLarge { limit_bytes });
        }
        // Most bodies are one piece, which is not copied.
        if received_bytes == 0 {
            first = piece;
        } else {
            if all.is_empty() {
                all.reserve(expected_bytes.max(2 * LARGE_BYTES));
                all.extend_from_slice(&first);
                first = Bytes::new();
            }
            all.extend_from_slice(&piece);
        }
        expected_bytes = expected_bytes.max(first.len() + all.len());
    }
}

impl From<Busy> for NotReceived {
    fn from(Busy: Busy) -> Self {
        Self::Busy
    }
}

/// Reads the rest of a refused body, so slowly that it costs the others nothing. A system that closes a
/// connection with unread bytes resets it, and the client may lose the answer that it has not read yet.
pub fn read_away(gate: &Gate, headers: &HeaderMap, mut body: BodyDataStream) {
    if headers.contains_key(header::EXPECT) {
        // The client asked first: it has sent nothing, and to read would be to tell it to.
        return;
    }
    let leftovers: Arc<_> = gate.leftovers();
    tokio::spawn(tokio::time::timeout(LINGER, async move {
        let _turn = leftovers.acquire().await;
        while let Some(Ok(_)) = body.next().await {
            sleep(LINGER_PAUSE).await;
        }
    }));
}
