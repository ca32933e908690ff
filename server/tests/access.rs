//! Who may come in, and when the house is full.

#![allow(
    clippy::unwrap_used,
    reason = "a test stops at what it did not expect; its numbers are small"
)]

mod common;

use common::{Answer, Desk};
use hydroflex_ledger::keys::Scope;

async fn ask(desk: &Desk, method: &str, path: &str, key: Option<&str>) -> Answer {
    let authorization = key.map(|key| format!("Bearer {key}"));
    let mut headers = vec![("content-type", "application/json")];
    if let Some(value) = &authorization {
        headers.push(("authorization", value));
    }
    let body = if method == "POST" { r#"{"runs": 80}"# } else { "" };
    desk.send(method, path, &headers, body).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_key_opens_what_its_scopes_say_and_nothing_without_one() {
    let desk = Desk::with(1000, true).await;
    let key = |scopes: &'static [Scope], expires_ms| {
        let ledger = desk.ledger.clone();
        async move { ledger.create_key("test", scopes, expires_ms).await.unwrap() }
    };
    let (reader, _) = key(&[Scope::Read], None).await;
    let (submitter, submitting) = key(&[Scope::Submit], None).await;
    let (admin, _) = key(&[Scope::Admin], None).await;
    let (expired, _) = key(&[Scope::Admin], Some(1)).await;

    // Open to everybody.
    for path in ["/health/live", "/health/ready", "/openapi.json"] {
        assert_eq!(ask(&desk, "GET", path, None).await.status, 200, "{path}");
    }
    for key in [None, Some("hfx_0000"), Some(expired.as_str())] {
        for path in ["/v1/jobs", "/metrics", "/v1/nothing"] {
            let refused = ask(&desk, "GET", path, key).await;
            assert_eq!(refused.header("www-authenticate"), "Bearer");
            let problem = refused.problem(401);
            assert!(!problem.detail.contains("0000"), "{}", problem.detail);
        }
    }
    assert_eq!(ask(&desk, "GET", "/v1/jobs", Some(&reader)).await.status, 200);
    assert_eq!(ask(&desk, "GET", "/metrics", Some(&reader)).await.status, 200);
    let refused = ask(&desk, "POST", "/v1/jobs", Some(&reader)).await.problem(403);
    assert!(refused.detail.contains("scope submit"), "{}", refused.detail);
    assert_eq!(ask(&desk, "POST", "/v1/jobs", Some(&submitter)).await.status, 202);
    ask(&desk, "GET", "/v1/jobs", Some(&submitter)).await.problem(403);
    for (method, path, status) in [
        ("GET", "/v1/jobs", 200),
        ("POST", "/v1/jobs", 202),
        ("GET", "/v1/nothing", 404),
    ] {
        assert_eq!(
            ask(&desk, method, path, Some(&admin)).await.status,
            status,
            "{method} {path}"
        );
    }
    // A key that the service has just seen is believed for a few seconds; one that it has not is not.
    let (fresh, revoked) = key(&[Scope::Admin], None).await;
    assert!(desk.ledger.revoke_key(revoked.id).await.unwrap());
    ask(&desk, "GET", "/v1/jobs", Some(&fresh)).await.problem(401);
    assert!(desk.ledger.revoke_key(submitting.id).await.unwrap());
}

#[tokio::test(flavor = "multi_thread")]
async fn one_job_too_many_is_refused_with_a_time_to_come_back() {
    let desk = Desk::with(2, false).await;
    let key = [("content-type", "application/json"), ("idempotency-key", "first")];
    let first = desk.send("POST", "/v1/jobs", &key, r#"{"runs": 80}"#).await;
    assert_eq!(first.status, 202);
    assert_eq!(ask(&desk, "POST", "/v1/jobs", None).await.status, 202);
    let full = ask(&desk, "POST", "/v1/jobs", None).await;
    assert!(!full.header("retry-after").is_empty());
    let problem = full.problem(429);
    assert_eq!(problem.kind, "/problems/too-many-requests");
    // What was accepted before may be asked again.
    let again = desk.send("POST", "/v1/jobs", &key, r#"{"runs": 80}"#).await;
    assert_eq!(
        (again.status, again.header("location")),
        (first.status, first.header("location"))
    );
    let cancel = format!("{}/cancel", first.header("location"));
    assert_eq!(desk.post(&cancel, "").await.status, 200);
    assert_eq!(ask(&desk, "POST", "/v1/jobs", None).await.status, 202);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_priority_outside_the_range_is_refused() {
    let desk = Desk::new().await;
    let refused = desk
        .post("/v1/jobs", r#"{"runs": 80, "priority": 101}"#)
        .await
        .problem(422);
    assert_eq!(refused.errors[0].pointer, "/priority");
    assert_eq!(
        desk.post("/v1/jobs", r#"{"runs": 80, "priority": -100}"#)
            .await
            .status,
        202
    );
}
