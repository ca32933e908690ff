//! A client of the service's own REST interface, for the command line and the demo.
//!
//! Blocking on purpose: commands do one thing after the other. Errors carry the service's problem
//! details, so that the command line says which field, what value, what is allowed.

use anyhow::{Context, bail};
use hydroflex_openapi::problem::Problem;
use hydroflex_openapi::status::{JobState, JobStatus, TrainingState};
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use reqwest::StatusCode;
use reqwest::blocking::{Client as Http, RequestBuilder, Response};
use reqwest::header::{AUTHORIZATION, HeaderMap, HeaderValue};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::fmt::Write as _;
use std::io::IsTerminal as _;
use std::time::{Duration, Instant};

/// Environment variable with the API key; an argument could be read by every user of the machine.
const KEY: &str = "HYDROFLEX_KEY";

/// How often a job is looked at.
const POLL: Duration = Duration::from_millis(100);

/// How often a line says how a job goes on where bars cannot be drawn.
const LINE: Duration = Duration::from_secs(10);

/// How long a service may be away (a restart) before following a job gives up.
const PATIENCE: Duration = Duration::from_mins(1);

/// A service at a base URL.
#[derive(Debug, Clone)]
pub struct Client {
    base: String,
    http: Http,
}

impl Client {
    /// A client of the service at a base URL.
    ///
    /// # Errors
    /// If the URL is not `http://…` or `https://…`.
    pub fn new(url: &str) -> anyhow::Result<Self> {
        if !(url.starts_with("http://") || url.starts_with("https://")) {
            bail!("the service's address is {url:?}; it must begin with http:// or https://");
        }
        hydroflex_ledger::tls::ready();
        let mut http = Http::builder()
            .timeout(None)
            .connect_timeout(Duration::from_secs(10));
        if let Ok(key) = std::env::var(KEY) {
            let mut value = HeaderValue::from_str(&format!("Bearer {key}"))
                .with_context(|| format!("{KEY} holds no key"))?;
            value.set_sensitive(true);
            http = http.default_headers(HeaderMap::from_iter([(AUTHORIZATION, value)]));
        }
        if url.starts_with("http://") {
            // Nobody's certificate is looked at: none need be installed.
            http = http.tls_certs_only([]);
        }
        let http = http.build().context("cannot set up the HTTP client")?;
        Ok(Self {
            base: url.trim_end_matches('/').to_owned(),
            http,
        })
    }

    /// Address of a path.
    #[must_use]
    pub fn url(&self, path: &str) -> String {
        format!("{}{path}", self.base)
    }

    /// A GET request, for callers that need its headers.
    pub fn request(&self, path: &str) -> RequestBuilder {
        self.http.get(self.url(path))
    }

    /// Reads a resource.
    ///
    /// # Errors
    /// If the service cannot be reached, refuses, or answers something else.
    pub fn get<T: DeserializeOwned>(&self, path: &str) -> anyhow::Result<T> {
        self.read(self.request(path), path)
    }

    /// Posts a body.
    ///
    /// # Errors
    /// If the service cannot be reached, refuses, or answers something else.
    pub fn post<T: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> anyhow::Result<T> {
        self.read(self.http.post(self.url(path)).json(body), path)
    }

    /// Posts a JSON text as it stands: what is wrong with it is for the service to say.
    ///
    /// # Errors
    /// If the service cannot be reached, refuses, or answers something else.
    pub fn post_text<T: DeserializeOwned>(&self, path: &str, body: String) -> anyhow::Result<T> {
        let request = self
            .http
            .post(self.url(path))
            .header("content-type", "application/json")
            .body(body);
        self.read(request, path)
    }

    /// Posts a file.
    ///
    /// # Errors
    /// If the service cannot be reached, refuses, or answers something else.
    pub fn post_bytes<T: DeserializeOwned>(&self, path: &str, body: Vec<u8>) -> anyhow::Result<T> {
        let request = self
            .http
            .post(self.url(path))
            .header("content-type", "application/octet-stream")
            .body(body);
        self.read(request, path)
    }

    /// Sends a request and turns problem details into an error.
    ///
    /// # Errors
    /// If the service cannot be reached or refuses.
    pub fn send(&self, request: RequestBuilder) -> anyhow::Result<Response> {
        let response = request.send().with_context(|| {
            format!(
                "cannot reach the service at {} (is `hydroflex serve` running there?)",
                self.base
            )
        })?;
        let status = response.status();
        if status.is_success() {
            return Ok(response);
        }
        let body = response.text().unwrap_or_default();
        bail!("{}", describe(status, &body))
    }

    fn read<T: DeserializeOwned>(&self, request: RequestBuilder, path: &str) -> anyhow::Result<T> {
        self.send(request)?
            .json()
            .with_context(|| format!("unexpected answer from {}", self.url(path)))
    }

    /// Follows a job to its end, drawing a bar for each stage, and returns its last state. A service
    /// that restarts in between is waited for.
    ///
    /// # Errors
    /// If the service stays away.
    pub fn follow(&self, job: &str, quiet: bool) -> anyhow::Result<JobStatus> {
        let mut stages = Stages::new(quiet);
        // Bars are for terminals; a log gets lines.
        let mut lines = (!quiet && !std::io::stderr().is_terminal()).then(Lines::default);
        let mut away_since: Option<Instant> = None;
        loop {
            match self.get::<JobStatus>(&format!("/v1/jobs/{job}")) {
                Ok(status) => {
                    away_since = None;
                    stages.show(&status);
                    if let Some(lines) = &mut lines {
                        lines.show(&status);
                    }
                    if status.state.is_final() {
                        stages.finish(&status);
                        return Ok(status);
                    }
                }
                Err(error) => {
                    let unreachable = error.downcast_ref::<reqwest::Error>().is_some();
                    let since = *away_since.get_or_insert_with(Instant::now);
                    if !unreachable || since.elapsed() > PATIENCE {
                        return Err(error);
                    }
                }
            }
            std::thread::sleep(POLL);
        }
    }
}

/// Problem details in the words of the command line.
fn describe(status: StatusCode, body: &str) -> String {
    let Ok(problem) = serde_json::from_str::<Problem>(body) else {
        return format!(
            "the service answered {status}: {}",
            body.chars().take(300).collect::<String>()
        );
    };
    let mut text = format!("{} ({}): {}", problem.title, problem.status, problem.detail);
    for field in &problem.errors {
        let _ = write!(text, "\n  {}: {}", field.pointer, field.detail);
        if let Some(value) = &field.value {
            let _ = write!(text, "; it is {value}");
        }
        if let Some(allowed) = &field.allowed {
            let _ = write!(text, "; allowed: {allowed}");
        }
    }
    text
}

/// A line on standard error whenever a job is in another state, and now and then between.
#[derive(Default)]
struct Lines {
    last: Option<(JobState, Instant)>,
}

impl Lines {
    fn show(&mut self, status: &JobStatus) {
        if let Some((state, since)) = self.last
            && state == status.state
            && since.elapsed() < LINE
        {
            return;
        }
        self.last = Some((status.state, Instant::now()));
        let progress = &status.progress;
        let mut line = format!(
            "{}: {} of {} runs",
            status.state, progress.runs_done, progress.runs_total
        );
        let training = status
            .trainings
            .iter()
            .filter_map(|training| training.progress.as_ref());
        for (number, progress) in training.enumerate() {
            let _ = write!(
                line,
                ", training {} {:.0} %",
                number + 1,
                100.0 * progress.fraction
            );
        }
        eprintln!("{line}");
    }
}

/// One bar for each stage of a job.
struct Stages {
    bars: MultiProgress,
    simulate: ProgressBar,
    publish: Option<ProgressBar>,
    train: Vec<ProgressBar>,
    quiet: bool,
}

impl Stages {
    fn new(quiet: bool) -> Self {
        let bars = MultiProgress::new();
        if quiet {
            bars.set_draw_target(indicatif::ProgressDrawTarget::hidden());
        }
        let simulate = bars.add(bar("simulate", 0));
        Self {
            bars,
            simulate,
            publish: None,
            train: Vec::new(),
            quiet,
        }
    }

    fn show(&mut self, status: &JobStatus) {
        let progress = &status.progress;
        self.simulate
            .set_length(progress.runs_total + progress.settling_total);
        self.simulate
            .set_position(progress.runs_done + progress.settling_done);
        let mut note = String::new();
        if let Some(rate) = progress.runs_per_s {
            let _ = write!(note, "{rate:.0} runs/s");
        }
        if progress.runs_failed > 0 {
            let _ = write!(note, ", {} failed", progress.runs_failed);
        }
        self.simulate.set_message(note);
        if matches!(
            status.state,
            JobState::Publishing | JobState::Training | JobState::Succeeded
        ) {
            if !self.simulate.is_finished() {
                self.simulate.finish();
            }
            let publish = self
                .publish
                .get_or_insert_with(|| self.bars.add(bar("publish", 1)));
            if status.dataset_id.is_some() && !publish.is_finished() {
                publish.set_position(1);
                publish.finish();
            }
        }
        for (index, training) in status.trainings.iter().enumerate() {
            if self.train.len() <= index {
                let label = format!("train {}", training.spec.structure);
                self.train.push(self.bars.add(bar(&label, 1000)));
            }
            let bar = &self.train[index];
            if let Some(progress) = &training.progress {
                #[expect(
                    clippy::cast_possible_truncation,
                    clippy::cast_sign_loss,
                    reason = "a fraction in [0, 1]"
                )]
                bar.set_position((progress.fraction.clamp(0.0, 1.0) * 1000.0) as u64);
                if let Some(loss) = progress.validation_loss.or(progress.loss) {
                    bar.set_message(format!("loss {loss:.2e}"));
                }
            }
            if training.state == TrainingState::Succeeded && !bar.is_finished() {
                bar.set_position(1000);
                bar.finish();
            } else if training.state.is_final() && !bar.is_finished() {
                bar.abandon_with_message(
                    training
                        .reason
                        .clone()
                        .unwrap_or_else(|| training.state.to_string()),
                );
            }
        }
    }

    fn finish(&self, status: &JobStatus) {
        if !self.quiet && status.state != JobState::Succeeded {
            let reason = status.reason.as_deref().unwrap_or("no reason given");
            let _ = self
                .bars
                .println(format!("job {} {}: {reason}", status.job_id, status.state));
        }
        for bar in std::iter::once(&self.simulate)
            .chain(&self.publish)
            .chain(&self.train)
        {
            if !bar.is_finished() {
                bar.abandon();
            }
        }
    }
}

/// A progress bar in the style of all our commands.
#[must_use]
pub fn bar(label: &str, length: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{prefix:>12} {bar:30} {percent:>3} %  {msg}")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(length)
        .with_style(style)
        .with_prefix(label.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_problem_names_field_value_and_what_is_allowed() {
        let body = r#"{"type":"/problems/invalid-field","title":"Invalid job","status":422,"detail":"1 field",
            "errors":[{"pointer":"/runs","value":0,"detail":"too few","allowed":"1 to 10000000"}]}"#;
        let text = describe(StatusCode::UNPROCESSABLE_ENTITY, body);
        for part in ["Invalid job", "/runs", "it is 0", "1 to 10000000"] {
            assert!(text.contains(part), "{text}");
        }
    }

    #[test]
    fn an_answer_that_is_no_problem_is_shown_as_it_is() {
        assert!(describe(StatusCode::BAD_GATEWAY, "upstream is down").contains("upstream is down"));
    }

    #[test]
    fn an_address_without_scheme_is_refused() {
        assert!(
            Client::new("localhost:8080")
                .unwrap_err()
                .to_string()
                .contains("http://")
        );
    }
}
