//! `croissant.json`: the data set described for machines (MLCommons Croissant 1.0).

use crate::card::split_counts;
use crate::publish::PublishSpec;
use hydroflex_openapi::dataset::{ManifestFile, RunCounts};
use hydroflex_openapi::job::SampleType;
use serde::ser::{Serialize, SerializeMap, Serializer};

/// JSON whose objects keep their order, whatever features `serde_json` is built with.
#[derive(Debug, Clone)]
pub(crate) enum Json {
    Text(String),
    List(Vec<Json>),
    Object(Vec<(&'static str, Json)>),
}

impl Serialize for Json {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Text(text) => serializer.serialize_str(text),
            Self::List(items) => serializer.collect_seq(items),
            Self::Object(pairs) => {
                let mut map = serializer.serialize_map(Some(pairs.len()))?;
                for (key, value) in pairs {
                    map.serialize_entry(key, value)?;
                }
                map.end()
            }
        }
    }
}

fn text(value: impl Into<String>) -> Json {
    Json::Text(value.into())
}

fn reference(id: impl Into<String>) -> Json {
    Json::Object(vec![("@id", text(id))])
}

/// The document.
#[must_use]
pub(crate) fn document(spec: &PublishSpec, counts: &RunCounts, files: &[ManifestFile]) -> Json {
    let mut distribution = Vec::new();
    for file in files.iter().filter(|file| file.rows.is_some()) {
        distribution.push(Json::Object(vec![
            ("@type", text("cr:FileObject")),
            ("@id", text(&file.path)),
            ("name", text(&file.path)),
            ("contentUrl", text(&file.path)),
            ("contentSize", text(format!("{} B", file.bytes))),
            ("encodingFormat", text("application/x-parquet")),
            ("sha256", text(&file.sha256)),
        ]));
    }
    let mut record_sets = Vec::new();
    for (split, runs) in split_counts(counts) {
        if runs > 0 {
            let prefix = format!("data/{split}-");
            let of_split = files.iter().filter(|file| file.path.starts_with(&prefix));
            for file in of_split {
                record_sets.push(samples_record_set(spec, &file.path));
            }
        }
    }
    record_sets.push(runs_record_set(spec));
    Json::Object(vec![
        ("@context", context()),
        ("@type", text("sc:Dataset")),
        ("name", text(format!("hydroflex-{}", spec.machine.name))),
        (
            "description",
            text(format!(
                "{} simulated runs of the machine {}, sampled every {} s.",
                counts.total, spec.machine.name, spec.sample_time_s
            )),
        ),
        ("conformsTo", text("http://mlcommons.org/croissant/1.0")),
        ("version", text(&spec.code.version)),
        ("distribution", Json::List(distribution)),
        ("recordSet", Json::List(record_sets)),
    ])
}

fn samples_record_set(spec: &PublishSpec, path: &str) -> Json {
    let float = match spec.sample_type {
        SampleType::Float64 => "cr:Float64",
        SampleType::Float32 => "cr:Float32",
    };
    let id = path.trim_end_matches(".parquet");
    let mut fields = vec![
        field(path, id, "run_id", "sc:Integer", "key of the run"),
        field(path, id, "step", "sc:Integer", "sample number in the run"),
        field(path, id, "time_s", "cr:Float64", "time, s"),
    ];
    for channel in &spec.channels {
        let description = format!("{}, {}", channel.quantity, channel.unit);
        fields.push(field(path, id, &channel.name, float, &description));
    }
    record_set(id, fields)
}

fn runs_record_set(spec: &PublishSpec) -> Json {
    let (path, id) = (crate::runs_table::RUNS_PATH, "meta/runs");
    let mut fields = vec![
        field(path, id, "run_id", "sc:Integer", "key of the run"),
        field(path, id, "split", "sc:Text", "part of the data set"),
        field(path, id, "payload_kg", "cr:Float64", "payload, kg"),
    ];
    for angle in &spec.machine.angles {
        let name = format!("angle_{angle}_rad");
        fields.push(field(path, id, &name, "cr:Float64", "initial angle, rad"));
    }
    fields.push(field(path, id, "status", "sc:Text", "ok or failed"));
    record_set(id, fields)
}

fn record_set(id: &str, fields: Vec<Json>) -> Json {
    Json::Object(vec![
        ("@type", text("cr:RecordSet")),
        ("@id", text(id)),
        ("name", text(id)),
        ("field", Json::List(fields)),
    ])
}

fn field(file: &str, set: &str, column: &str, data_type: &str, description: &str) -> Json {
    Json::Object(vec![
        ("@type", text("cr:Field")),
        ("@id", text(format!("{set}/{column}"))),
        ("name", text(format!("{set}/{column}"))),
        ("description", text(description)),
        ("dataType", text(data_type)),
        (
            "source",
            Json::Object(vec![
                ("fileObject", reference(file)),
                ("extract", Json::Object(vec![("column", text(column))])),
            ]),
        ),
    ])
}

/// The standard's own context for version 1.0, term by term; most terms are `cr:` and their name.
fn context() -> Json {
    const PLAIN: [(&str, &str); 25] = [
        ("citeAs", "cr:citeAs"),
        ("column", "cr:column"),
        ("equivalentProperty", "cr:equivalentProperty"),
        ("extract", "cr:extract"),
        ("field", "cr:field"),
        ("fileObject", "cr:fileObject"),
        ("fileProperty", "cr:fileProperty"),
        ("fileSet", "cr:fileSet"),
        ("format", "cr:format"),
        ("includes", "cr:includes"),
        ("isLiveDataset", "cr:isLiveDataset"),
        ("jsonPath", "cr:jsonPath"),
        ("key", "cr:key"),
        ("md5", "cr:md5"),
        ("parentField", "cr:parentField"),
        ("path", "cr:path"),
        ("recordSet", "cr:recordSet"),
        ("references", "cr:references"),
        ("regex", "cr:regex"),
        ("repeated", "cr:repeated"),
        ("replace", "cr:replace"),
        ("samplingRate", "cr:samplingRate"),
        ("separator", "cr:separator"),
        ("source", "cr:source"),
        ("subField", "cr:subField"),
    ];
    let typed = |id: &str, kind: &str| Json::Object(vec![("@id", text(id)), ("@type", text(kind))]);
    let mut terms = vec![
        ("@language", text("en")),
        ("@vocab", text("https://schema.org/")),
        ("sc", text("https://schema.org/")),
        ("cr", text("http://mlcommons.org/croissant/")),
        ("rai", text("http://mlcommons.org/croissant/RAI/")),
        ("dct", text("http://purl.org/dc/terms/")),
        ("conformsTo", text("dct:conformsTo")),
        ("transform", text("cr:transform")),
        ("data", typed("cr:data", "@json")),
        ("dataType", typed("cr:dataType", "@vocab")),
        ("examples", typed("cr:examples", "@json")),
    ];
    terms.extend(PLAIN.map(|(term, id)| (term, text(id))));
    Json::Object(terms)
}
