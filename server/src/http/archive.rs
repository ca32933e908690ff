//! A whole data set as one tar stream, in constant memory.

use super::error::ApiError;
use axum::body::Body;
use axum::http::{Response, header};
use bytes::Bytes;
use futures::stream::{self, Stream, StreamExt};
use hydroflex_ledger::DatasetRecord;
use hydroflex_ledger::blobs::Blobs;
use std::io;

const BLOCK: u64 = 512;

/// Answers with every file of the data set below a folder named after it.
///
/// # Errors
/// If a header cannot be made.
pub fn serve(blobs: &Blobs, dataset: &DatasetRecord, is_head: bool) -> Result<Response<Body>, ApiError> {
    let folder = format!("hydroflex-{}", dataset.id);
    let mut length = 2 * BLOCK;
    let mut entries = Vec::new();
    for file in &dataset.files {
        let head = entry_head(&format!("{folder}/{}", file.path), file.size_bytes)
            .map_err(|error| ApiError::Internal(error.to_string()))?;
        length += head.len() as u64 + file.size_bytes.div_ceil(BLOCK) * BLOCK;
        entries.push((head, dataset.key(&file.path), file.size_bytes));
    }
    let response = Response::builder()
        .header(header::CONTENT_TYPE, "application/x-tar")
        .header(header::CONTENT_LENGTH, length)
        .header(
            header::CONTENT_DISPOSITION,
            format!("attachment; filename=\"{folder}.tar\""),
        )
        .header(header::ETAG, format!("\"tar-{}\"", dataset.sha256));
    let body = if is_head {
        Body::empty()
    } else {
        Body::from_stream(content(blobs.clone(), entries))
    };
    response
        .body(body)
        .map_err(|error| ApiError::Internal(error.to_string()))
}

/// Header blocks of one entry: without owner or time, so that equal data sets make equal archives.
fn entry_head(path: &str, size: u64) -> io::Result<Bytes> {
    let mut header = tar::Header::new_ustar();
    header.set_path(path)?;
    header.set_size(size);
    header.set_mode(0o644);
    header.set_mtime(0);
    header.set_uid(0);
    header.set_gid(0);
    header.set_entry_type(tar::EntryType::Regular);
    header.set_cksum();
    Ok(Bytes::copy_from_slice(header.as_bytes()))
}

fn content(
    blobs: Blobs,
    entries: Vec<(Bytes, String, u64)>,
) -> impl Stream<Item = io::Result<Bytes>> + Send + 'static {
    let files = stream::iter(entries).then(move |(head, key, size)| {
        let blobs = blobs.clone();
        async move {
            let padding = size.div_ceil(BLOCK) * BLOCK - size;
            let head = stream::once(async move { Ok(head) });
            let tail = stream::once(async move { Ok(zeros(padding)) });
            match blobs.stream(&key, 0..size).await {
                Ok(body) => head
                    .chain(body.map(|part| part.map_err(io::Error::other)))
                    .chain(tail)
                    .boxed(),
                // The connection breaks off, so that nobody takes a part for the whole.
                Err(error) => stream::once(async move { Err(io::Error::other(error)) }).boxed(),
            }
        }
    });
    files
        .flatten()
        .chain(stream::once(async { Ok(zeros(2 * BLOCK)) }))
}

fn zeros(count: u64) -> Bytes {
    static ZEROS: [u8; 1024] = [0; 1024]; // two blocks, the most that is asked for
    Bytes::from_static(&ZEROS[..usize::try_from(count).unwrap_or(0)])
}
