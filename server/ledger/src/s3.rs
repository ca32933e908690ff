//! S3 and what speaks it: `s3://BUCKET/PREFIX`, everything else from the usual `AWS_…` variables.

use crate::blobs::BlobError;
use crate::tls;
use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey};
use object_store::path::Path as Key;
use object_store::prefix::PrefixStore;
use object_store::{BackoffConfig, ClientOptions, ObjectStore, RetryConfig};
use std::sync::Arc;
use std::time::Duration;

/// A connection that takes longer than this will hardly come about.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Silence of the store after which a request is made again.
const READ_TIMEOUT: Duration = Duration::from_secs(20);
/// The store's own repetitions of a request; whoever asked repeats on a longer scale.
const RETRY_TIMEOUT: Duration = Duration::from_secs(30);

/// A bucket and where in it.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Place {
    bucket: String,
    prefix: String,
}

/// Reads what follows `s3://`.
fn place(rest: &str) -> Result<Place, BlobError> {
    let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
    let refused = |what: &'static str, value: &str, allowed: &'static str| {
        Err(BlobError::S3Url {
            what,
            value: value.to_owned(),
            allowed,
        })
    };
    // Letters, digits, dots and hyphens: an @ or a colon would be a password on its way into a log.
    let is_plain = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || b".-".contains(&byte);
    if !(3..=63).contains(&bucket.len()) || !bucket.bytes().all(is_plain) {
        return refused(
            "bucket",
            &bucket
                .chars()
                .take(63)
                .filter(char::is_ascii_graphic)
                .collect::<String>(),
            "3 to 63 small letters, digits, dots and hyphens; credentials go into AWS_ACCESS_KEY_ID and \
             AWS_SECRET_ACCESS_KEY",
        );
    }
    let prefix = prefix.trim_end_matches('/');
    let is_word = |part: &str| {
        !part.is_empty()
            && part != "."
            && part != ".."
            && part
                .bytes()
                .all(|byte| byte.is_ascii_alphanumeric() || b"-_.=+".contains(&byte))
    };
    if !prefix.is_empty() && !prefix.split('/').all(is_word) {
        return refused(
            "prefix",
            prefix,
            "words of letters, digits and -_.=+ with single slashes between",
        );
    }
    Ok(Place {
        bucket: bucket.to_owned(),
        prefix: prefix.to_owned(),
    })
}

/// Opens a bucket with these `AWS_…` variables; others are not looked at. Nothing is sent yet.
pub(crate) fn open(
    rest: &str,
    variables: impl IntoIterator<Item = (String, String)>,
) -> Result<Arc<dyn ObjectStore>, BlobError> {
    tls::ready();
    let Place { bucket, prefix } = place(rest)?;
    let mut builder = AmazonS3Builder::new();
    for (name, value) in variables {
        // Unknown ones are somebody else's, as AWS_PAGER is.
        if let Some(key) = name
            .starts_with("AWS_")
            .then(|| name.to_ascii_lowercase().parse().ok())
            .flatten()
        {
            builder = builder.with_config(key, value);
        }
    }
    let builder = builder.with_bucket_name(bucket);
    let endpoint = [AmazonS3ConfigKey::S3Endpoint, AmazonS3ConfigKey::Endpoint]
        .iter()
        .find_map(|key| builder.get_config_value(key));
    // Who writes http:// means it: a store on this machine, or on a network of one's own.
    let is_plain = endpoint.is_some_and(|endpoint| endpoint.starts_with("http://"));
    let options = ClientOptions::new()
        .with_allow_http(is_plain)
        // Without TLS there is nobody to trust; a small image may hold no certificates at all.
        .with_no_system_certificates(is_plain)
        // A slow reader of a large file may take its time: only silence is an error.
        .with_timeout_disabled()
        .with_connect_timeout(CONNECT_TIMEOUT)
        .with_read_timeout(READ_TIMEOUT);
    let store = builder
        .with_client_options(options)
        .with_retry(RetryConfig {
            backoff: BackoffConfig {
                init_backoff: Duration::from_millis(100),
                max_backoff: Duration::from_secs(3),
                base: 2.0,
            },
            max_retries: 6,
            retry_timeout: RETRY_TIMEOUT,
        })
        .build()?;
    Ok(if prefix.is_empty() {
        Arc::new(store)
    } else {
        Arc::new(PrefixStore::new(store, Key::from(prefix)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bucket_and_a_prefix_are_read_and_nothing_else() {
        let read = |rest: &str| place(rest).map(|place| (place.bucket, place.prefix));
        let pair = |bucket: &str, prefix: &str| (bucket.to_owned(), prefix.to_owned());
        assert_eq!(read("boom").unwrap(), pair("boom", ""));
        assert_eq!(read("boom/").unwrap(), pair("boom", ""));
        assert_eq!(read("my.boom-1/a/b_c/").unwrap(), pair("my.boom-1", "a/b_c"));
        for refused in [
            "",
            "ab",
            "Boom",
            "key:secret@boom",
            "boom//a",
            "boom/../x",
            "boom/a?b=c",
            "boom/a b",
        ] {
            let error = read(refused).unwrap_err().to_string();
            assert!(error.contains("s3://"), "{refused}: {error}");
        }
    }
}
