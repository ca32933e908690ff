//! One file over HTTP as RFC 9110 wants it: strong ETag, Range, If-Range, If-None-Match.

use super::error::ApiError;
use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, Response, StatusCode, header};
use hydroflex_ledger::blobs::Blobs;
use hydroflex_openapi::catalogue::FileEntry;
use std::ops::Range;

/// What part of a file to send.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Part {
    Whole,
    Range(Range<u64>),
    NotSatisfiable,
    NotModified,
}

/// Answers a request for a file; axum drops the body of an answer to HEAD.
///
/// # Errors
/// 416 for a range outside the file; 503 if the store does not answer.
pub async fn serve(
    blobs: &Blobs,
    key: &str,
    file: &FileEntry,
    headers: &HeaderMap,
    is_head: bool,
) -> Result<Response<Body>, ApiError> {
    let etag = format!("\"{}\"", file.sha256);
    let part = choose(headers, &etag, file.size_bytes);
    let (status, range) = match part {
        Part::NotSatisfiable => {
            return Err(ApiError::RangeNotSatisfiable {
                size_bytes: file.size_bytes,
            });
        }
        Part::NotModified => (StatusCode::NOT_MODIFIED, 0..0),
        Part::Whole => (StatusCode::OK, 0..file.size_bytes),
        Part::Range(range) => (StatusCode::PARTIAL_CONTENT, range),
    };
    let length = range.end - range.start;
    let mut response = Response::builder()
        .status(status)
        .header(header::ETAG, &etag)
        .header(header::ACCEPT_RANGES, "bytes")
        // Addressed by content: what is behind this URL never changes.
        .header(header::CACHE_CONTROL, "public, max-age=31536000, immutable");
    if status != StatusCode::NOT_MODIFIED {
        response = response
            .header(header::CONTENT_TYPE, media_type(&file.path))
            .header(header::CONTENT_LENGTH, length);
    }
    if status == StatusCode::PARTIAL_CONTENT {
        let content_range = format!("bytes {}-{}/{}", range.start, range.end - 1, file.size_bytes);
        response = response.header(header::CONTENT_RANGE, content_range);
    }
    let body = if is_head || status == StatusCode::NOT_MODIFIED {
        Body::empty()
    } else {
        Body::from_stream(blobs.stream(key, range).await?)
    };
    response
        .body(body)
        .map_err(|error| ApiError::Internal(error.to_string()))
}

fn choose(headers: &HeaderMap, etag: &str, size: u64) -> Part {
    if let Some(value) = headers.get(header::IF_NONE_MATCH)
        && lists_etag(value, etag)
    {
        return Part::NotModified;
    }
    let Some(range) = headers.get(header::RANGE).and_then(|value| value.to_str().ok()) else {
        return Part::Whole;
    };
    // Strong comparison; a date never matches, because there are no modification dates here.
    if let Some(condition) = headers.get(header::IF_RANGE)
        && condition.as_bytes() != etag.as_bytes()
    {
        return Part::Whole;
    }
    parse_range(range, size)
}

/// Weak comparison, as If-None-Match asks for.
fn lists_etag(value: &HeaderValue, etag: &str) -> bool {
    let Ok(text) = value.to_str() else { return false };
    text.split(',')
        .map(str::trim)
        .any(|tag| tag == "*" || tag.trim_start_matches("W/") == etag)
}

/// One range of bytes. Several, or what cannot be read, are ignored, as the RFC allows: the whole
/// file is then the answer.
fn parse_range(text: &str, size: u64) -> Part {
    let Some((first, last)) = text
        .strip_prefix("bytes=")
        .and_then(|spec| spec.trim().split_once('-'))
    else {
        return Part::Whole;
    };
    let number = |text: &str| -> Option<u64> {
        if text.is_empty() || !text.bytes().all(|byte| byte.is_ascii_digit()) {
            None
        } else {
            text.parse().ok()
        }
    };
    match (number(first), number(last)) {
        (Some(first), _) if first >= size && (last.is_empty() || number(last).is_some()) => {
            Part::NotSatisfiable
        }
        (Some(first), Some(last)) if first <= last => Part::Range(first..last.saturating_add(1).min(size)),
        (Some(first), None) if last.is_empty() => Part::Range(first..size),
        (None, Some(0)) if first.is_empty() => Part::NotSatisfiable,
        (None, Some(_)) if first.is_empty() && size == 0 => Part::NotSatisfiable,
        (None, Some(count)) if first.is_empty() => Part::Range(size.saturating_sub(count)..size),
        _ => Part::Whole,
    }
}

fn media_type(path: &str) -> &'static str {
    match path.rsplit_once('.').map(|(_, extension)| extension) {
        Some("parquet") => "application/vnd.apache.parquet",
        Some("json") => "application/json",
        Some("md") => "text/markdown; charset=utf-8",
        Some("svg") => "image/svg+xml",
        _ if path == "SHA256SUMS" => "text/plain; charset=utf-8",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(header::HeaderName, &str)]) -> HeaderMap {
        pairs
            .iter()
            .map(|(name, value)| (name.clone(), HeaderValue::from_str(value).unwrap()))
            .collect()
    }

    #[test]
    fn ranges_are_read_as_the_standard_says() {
        for (text, expected) in [
            ("bytes=0-9", Part::Range(0..10)),
            ("bytes=90-", Part::Range(90..100)),
            ("bytes=90-500", Part::Range(90..100)),
            ("bytes=-8", Part::Range(92..100)),
            ("bytes=-800", Part::Range(0..100)),
            ("bytes=100-", Part::NotSatisfiable),
            ("bytes=100-200", Part::NotSatisfiable),
            ("bytes=-0", Part::NotSatisfiable),
            ("bytes=9-3", Part::Whole),
            ("bytes=0-1,5-6", Part::Whole),
            ("lines=0-9", Part::Whole),
            ("bytes=a-b", Part::Whole),
            ("bytes=+1-2", Part::Whole),
            ("bytes=-", Part::Whole),
            ("bytes=0-18446744073709551615", Part::Range(0..100)),
        ] {
            assert_eq!(parse_range(text, 100), expected, "{text}");
        }
        assert_eq!(parse_range("bytes=-5", 0), Part::NotSatisfiable);
    }

    #[test]
    fn conditions_decide_first() {
        let etag = "\"abc\"";
        let range = (header::RANGE, "bytes=0-9");
        assert_eq!(
            choose(
                &headers(&[(header::IF_NONE_MATCH, "\"x\", W/\"abc\"")]),
                etag,
                100
            ),
            Part::NotModified
        );
        assert_eq!(
            choose(&headers(&[(header::IF_NONE_MATCH, "\"x\"")]), etag, 100),
            Part::Whole
        );
        let fresh = headers(&[range.clone(), (header::IF_RANGE, etag)]);
        assert_eq!(choose(&fresh, etag, 100), Part::Range(0..10));
        let stale = headers(&[range, (header::IF_RANGE, "\"old\"")]);
        assert_eq!(choose(&stale, etag, 100), Part::Whole);
    }
}
