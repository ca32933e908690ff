//! `README.md` of a data set: a card that people read, with the header that hubs read.

use crate::publish::PublishSpec;
use hydroflex_openapi::dataset::{DatasetSource, DatasetStatistics, RunCounts, SplitName, WindowFacts};
use std::collections::BTreeMap;
use std::fmt::Write;

/// The card.
#[must_use]
pub(crate) fn text(
    spec: &PublishSpec,
    counts: &RunCounts,
    flags: &BTreeMap<String, u64>,
    window: &WindowFacts,
    statistics: &DatasetStatistics,
) -> String {
    let mut out = String::new();
    // writing to a String cannot fail
    let _ = header(&mut out, spec, counts, statistics);
    let _ = body(&mut out, spec, counts, flags, window, statistics);
    out
}

fn title(spec: &PublishSpec) -> String {
    match &spec.source {
        DatasetSource::Job { spec: job } => job.title.clone(),
        DatasetSource::RunTable { .. } => None,
    }
    .unwrap_or_else(|| format!("Trajectories of {}", spec.machine.name))
}

/// A YAML string in double quotes; JSON strings are YAML.
fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

fn header(
    out: &mut String,
    spec: &PublishSpec,
    counts: &RunCounts,
    statistics: &DatasetStatistics,
) -> std::fmt::Result {
    let rows = statistics.all.values().map(|s| s.count).max().unwrap_or(0);
    writeln!(out, "---")?;
    writeln!(out, "pretty_name: {}", quoted(&title(spec)))?;
    writeln!(
        out,
        "tags:\n- hydraulics\n- multibody-dynamics\n- time-series\n- simulation"
    )?;
    writeln!(out, "size_categories:\n- {}", size_category(rows))?;
    writeln!(
        out,
        "configs:\n- config_name: samples\n  default: true\n  data_files:"
    )?;
    for (split, runs) in split_counts(counts) {
        if runs > 0 {
            writeln!(out, "  - split: {split}\n    path: data/{split}-*.parquet")?;
        }
    }
    writeln!(
        out,
        "- config_name: runs\n  data_files:\n  - split: runs\n    path: meta/runs.parquet"
    )?;
    if counts.settling > 0 {
        writeln!(
            out,
            "- config_name: settling\n  data_files:\n  - split: settling\n    path: meta/settling.parquet"
        )?;
    }
    writeln!(out, "---\n")
}

fn size_category(rows: u64) -> &'static str {
    match rows {
        0..1_000 => "n<1K",
        1_000..10_000 => "1K<n<10K",
        10_000..100_000 => "10K<n<100K",
        100_000..1_000_000 => "100K<n<1M",
        1_000_000..10_000_000 => "1M<n<10M",
        10_000_000..100_000_000 => "10M<n<100M",
        100_000_000..1_000_000_000 => "100M<n<1B",
        _ => "n>1B",
    }
}

pub(crate) fn split_counts(counts: &RunCounts) -> [(SplitName, u64); 3] {
    [
        (SplitName::Train, counts.train),
        (SplitName::Validation, counts.validation),
        (SplitName::Test, counts.test),
    ]
}

fn body(
    out: &mut String,
    spec: &PublishSpec,
    counts: &RunCounts,
    flags: &BTreeMap<String, u64>,
    window: &WindowFacts,
    statistics: &DatasetStatistics,
) -> std::fmt::Result {
    writeln!(out, "# {}\n", title(spec))?;
    writeln!(
        out,
        "{} simulated runs of the machine `{}`, sampled every {} s. Made by hydroflex {}; \
         `manifest.json` names everything needed to make the same bytes again.\n",
        counts.total, spec.machine.name, spec.sample_time_s, spec.code.version
    )?;
    writeln!(out, "| part | runs |\n|---|---|")?;
    for (split, runs) in split_counts(counts) {
        writeln!(out, "| {split} | {runs} |")?;
    }
    writeln!(
        out,
        "\n{} runs failed (a row in `meta/runs.parquet`, no samples).",
        counts.failed
    )?;
    if !flags.is_empty() {
        let listed: Vec<String> = flags
            .iter()
            .map(|(flag, runs)| format!("{flag} {runs}"))
            .collect();
        writeln!(out, "Runs with flags: {}.", listed.join(", "))?;
    }
    writeln!(
        out,
        "\n## Samples\n\nOne row per run and step, sorted by `run_id` and `step`; step 0 is the \
         state at t = 0. Runs never cross a row group; parts hold whole runs.\n\n\
         | column | unit | quantity | frame | min | max | mean | std |\n|---|---|---|---|---|---|---|---|"
    )?;
    for channel in &spec.channels {
        write!(
            out,
            "| `{}` | {} | {} | {} |",
            channel.name,
            channel.unit,
            channel.quantity,
            channel.frame.as_deref().unwrap_or("")
        )?;
        match statistics.all.get(&channel.name) {
            Some(s) => writeln!(
                out,
                " {:.4e} | {:.4e} | {:.4e} | {:.4e} |",
                s.min, s.max, s.mean, s.std
            )?,
            None => writeln!(out, " | | | |")?,
        }
    }
    if let (Some(channel), Some(band_s)) = (&window.channel, window.band_s) {
        writeln!(
            out,
            "\n## SLIDE window\n\n{} settling runs (`meta/settling.parquet`), decided by `{channel}`: \
             {band_s:.4} s until it stays within 5 % of its range, counted from the closing of the valve. \
             Other rules and channels: `meta/window.json`.",
            window.settling_runs
        )?;
    }
    writeln!(
        out,
        "\n## Reading\n\n```python\nimport pandas, polars, duckdb, datasets\n\
         pandas.read_parquet(\"data\")\n\
         polars.scan_parquet(\"data/*.parquet\")\n\
         duckdb.sql(\"select * from 'data/*.parquet' where run_id = 3\")\n\
         datasets.load_dataset(\".\")\n```\n\n\
         `sha256sum -c SHA256SUMS` checks every file."
    )
}
