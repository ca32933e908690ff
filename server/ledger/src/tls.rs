//! The one TLS implementation of this process: rustls with ring.

use std::sync::Once;

/// Makes TLS usable in this process. Every HTTP client needs it, also one that only ever speaks plain
/// HTTP; calling it again changes nothing.
pub fn ready() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // Fails only if somebody else in this process has chosen a provider before: theirs then serves.
        let _ = rustls::crypto::ring::default_provider().install_default();
    });
}
