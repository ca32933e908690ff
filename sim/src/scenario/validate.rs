//! Is a job one that can be run on this machine? If not: which field, what value, what is allowed.

use crate::machine::material_numbers;
use crate::trajectory::channels;
use hydroflex_openapi::channel::Channel;
use hydroflex_openapi::job::{Excitation, Integrator, JobSpec, TrainingSpec, ValueOrRange, WindowRule};
use hydroflex_openapi::machine::{BodySpec, MachineFile, MaterialSpec};
use hydroflex_openapi::problem::FieldError;
use serde::Serialize;
use serde_json::Value;

/// Runs of a job.
pub const MAX_RUNS: u64 = 100_000_000;
/// Steps of a run.
pub const MAX_STEPS: f64 = 1_000_000.0;
/// Settling runs of a job.
pub const MAX_SETTLING_RUNS: u64 = 10_000;
/// Materials of a job; bodies are reduced for each.
pub const MAX_MATERIALS: usize = 16;
/// Networks of a job.
pub const MAX_TRAININGS: usize = 256;

/// Checks a job against its machine; collects every error rather than the first.
///
/// # Errors
/// The fields that must change.
pub fn validate(spec: &JobSpec, machine: &MachineFile) -> Result<(), Vec<FieldError>> {
    let mut errors = Errors(Vec::new());
    size(spec, &mut errors);
    time(spec, &mut errors);
    payload(spec, machine, &mut errors);
    materials(spec, machine, &mut errors);
    angles(spec, machine, &mut errors);
    excitation(spec, machine, &mut errors);
    split(spec, &mut errors);
    let channels = channels(machine);
    columns(spec, &channels, &mut errors);
    for (index, training) in spec.train.iter().enumerate() {
        train(spec, training, index, &channels, &mut errors);
    }
    if errors.0.is_empty() {
        Ok(())
    } else {
        Err(errors.0)
    }
}

struct Errors(Vec<FieldError>);

impl Errors {
    fn require(
        &mut self,
        holds: bool,
        pointer: impl Into<String>,
        value: impl Serialize,
        allowed: impl Into<String>,
    ) {
        if !holds {
            let value = serde_json::to_value(value).unwrap_or(Value::Null);
            let detail = match &value {
                Value::Object(_) | Value::Array(_) => "not allowed".to_owned(),
                scalar => format!("{scalar} is not allowed"),
            };
            let error = FieldError::new(pointer, detail).value(value);
            self.0.push(error.allowed(allowed));
        }
    }
}

fn size(spec: &JobSpec, errors: &mut Errors) {
    errors.require(
        (1..=MAX_RUNS).contains(&spec.runs),
        "/runs",
        spec.runs,
        format!("1 to {MAX_RUNS}"),
    );
    errors.require(
        spec.settling_runs <= MAX_SETTLING_RUNS,
        "/settling_runs",
        spec.settling_runs,
        format!("0 to {MAX_SETTLING_RUNS}"),
    );
    let title = spec.title.as_deref().unwrap_or_default();
    errors.require(
        title.chars().count() <= 200 && !title.chars().any(char::is_control),
        "/title",
        title,
        "at most 200 characters on one line",
    );
    errors.require(
        spec.train.len() <= MAX_TRAININGS,
        "/train",
        spec.train.len(),
        format!("at most {MAX_TRAININGS} trainings"),
    );
}

fn time(spec: &JobSpec, errors: &mut Errors) {
    let sample_time_s = spec.sample_time_s;
    let sample_time_fits = (1e-5..=1.0).contains(&sample_time_s);
    errors.require(sample_time_fits, "/sample_time_s", sample_time_s, "1e-5 to 1 s");
    if !sample_time_fits {
        return; // every further sentence counts in sample times
    }
    let steps = spec.duration_s / sample_time_s;
    errors.require(
        is_whole(steps) && (1.0..=MAX_STEPS).contains(&steps.round()),
        "/duration_s",
        spec.duration_s,
        format!("a multiple of sample_time_s ({sample_time_s} s), 1 to {MAX_STEPS} of them"),
    );
    if let Integrator::TrapezoidalIndex2 { step_s } | Integrator::GeneralizedAlpha { step_s } =
        spec.integrator
    {
        let ratio = sample_time_s / step_s;
        errors.require(
            step_s > 0.0 && is_whole(ratio) && (1.0..=1e4).contains(&ratio.round()),
            "/integrator/step_s",
            step_s,
            format!("sample_time_s ({sample_time_s} s) divided by a whole number, 1 to 10000"),
        );
    }
}

/// Whole, but for rounding of decimal fractions.
fn is_whole(x: f64) -> bool {
    (x - x.round()).abs() <= 1e-9 * x.abs().max(1.0)
}

fn payload(spec: &JobSpec, machine: &MachineFile, errors: &mut Errors) {
    let [min, max] = machine.payload.as_ref().map_or([0.0; 2], |p| p.range_kg);
    let fits = |kg: f64| kg == 0.0 || (min..=max).contains(&kg);
    let allowed = if machine.payload.is_some() {
        format!("0, or {min} to {max} kg, min not above max")
    } else {
        format!("0: machine {} carries no payload", machine.name)
    };
    let holds = match spec.payload_kg {
        ValueOrRange::Value(kg) => fits(kg),
        ValueOrRange::Range { min, max, .. } => fits(min) && fits(max) && min <= max,
    };
    errors.require(holds, "/payload_kg", spec.payload_kg, allowed);
    if let ValueOrRange::Range { empty, .. } = spec.payload_kg {
        errors.require(
            (0.0..=1.0).contains(&empty),
            "/payload_kg/empty",
            empty,
            "a part of the runs, 0 to 1".to_owned(),
        );
    }
}

/// Checks the materials of a job alone: bodies are reduced of them before the rest of a job is looked at.
///
/// # Errors
/// The fields that must change.
pub fn validate_materials(spec: &JobSpec, machine: &MachineFile) -> Result<(), Vec<FieldError>> {
    let mut errors = Errors(Vec::new());
    materials(spec, machine, &mut errors);
    if errors.0.is_empty() {
        Ok(())
    } else {
        Err(errors.0)
    }
}

fn materials(spec: &JobSpec, machine: &MachineFile, errors: &mut Errors) {
    let listed = &spec.materials;
    errors.require(
        listed.len() <= MAX_MATERIALS,
        "/materials",
        listed.len(),
        format!("at most {MAX_MATERIALS} materials"),
    );
    let is_flexible = |body: &BodySpec| matches!(body, BodySpec::Flexible(_));
    errors.require(
        listed.is_empty() || machine.bodies.iter().any(is_flexible),
        "/materials",
        listed.len(),
        format!("none: machine {} has no flexible body", machine.name),
    );
    let with_matrices = machine.bodies.iter().find_map(|body| match body {
        BodySpec::Flexible(body) if body.matrices.is_some() => Some(&body.name),
        _ => None,
    });
    if let Some(body) = with_matrices {
        errors.require(
            listed.is_empty(),
            "/materials",
            listed.len(),
            format!(
                "none: body {body} of machine {} has matrices of its own",
                machine.name
            ),
        );
    }
    for (k, material) in listed.iter().enumerate() {
        let pointer = format!("/materials/{k}");
        let name = material.name();
        errors.require(
            !listed[..k].iter().any(|other| other.name() == name),
            &pointer,
            name,
            "every name once",
        );
        let Some(numbers) = material.material() else {
            let known = MaterialSpec::NAMES.join(", ");
            let allowed = format!(
                "{known}, or {{\"name\", \"youngs_modulus_pa\", \"poisson_ratio\", \"density_kg_per_m3\"}}"
            );
            errors.require(false, pointer, name, allowed);
            continue;
        };
        errors.require(
            (1..=64).contains(&name.chars().count()) && !name.chars().any(char::is_control),
            format!("{pointer}/name"),
            name,
            "1 to 64 characters on one line",
        );
        for (key, value, (low, high), unit) in material_numbers(&numbers) {
            errors.require(
                (low..=high).contains(&value),
                format!("{pointer}/{key}"),
                value,
                format!("{low:e} to {high:e} {unit}").trim_end(),
            );
        }
    }
}

fn angles(spec: &JobSpec, machine: &MachineFile, errors: &mut Errors) {
    for (name, range) in &spec.initial_angle_deg {
        let pointer = format!("/initial_angle_deg/{}", escaped(name));
        let Some(angle) = machine.angles.iter().find(|angle| &angle.name == name) else {
            let names: Vec<&str> = machine.angles.iter().map(|a| a.name.as_str()).collect();
            errors.require(
                false,
                pointer,
                range,
                format!("an angle of machine {}: {}", machine.name, names.join(", ")),
            );
            continue;
        };
        let allowed = || std::iter::once(angle.range_deg).chain(angle.instead.iter().map(|i| i.range_deg));
        let listed: Vec<String> = allowed().map(|[min, max]| format!("{min} to {max}")).collect();
        errors.require(
            range[0] <= range[1] && allowed().any(|[min, max]| min <= range[0] && range[1] <= max),
            pointer,
            range,
            format!(
                "[from, to] within {} degrees, from not above to",
                listed.join(", or ")
            ),
        );
    }
}

fn excitation(spec: &JobSpec, machine: &MachineFile, errors: &mut Errors) {
    match &spec.excitation {
        Excitation::Random | Excitation::Cycle => {}
        Excitation::OpenThenShut { open_part } => errors.require(
            *open_part > 0.0 && *open_part < 1.0,
            "/excitation/open_part",
            open_part,
            "above 0 and below 1",
        ),
        Excitation::Given { valve_ratio } => {
            let names: Vec<&str> = machine.cylinders.iter().map(|c| c.name.as_str()).collect();
            for name in &names {
                errors.require(
                    valve_ratio.contains_key(*name),
                    "/excitation/valve_ratio",
                    valve_ratio.keys().collect::<Vec<_>>(),
                    format!("a list for every cylinder: {}", names.join(", ")),
                );
            }
            for (name, signal) in valve_ratio {
                let pointer = format!("/excitation/valve_ratio/{}", escaped(name));
                errors.require(
                    names.contains(&name.as_str()),
                    &pointer,
                    name,
                    format!("a cylinder of machine {}: {}", machine.name, names.join(", ")),
                );
                errors.require(
                    signal.len() == spec.steps(),
                    &pointer,
                    signal.len(),
                    format!("{} values: duration_s / sample_time_s", spec.steps()),
                );
                if let Some(k) = signal.iter().position(|u| !(-1.0..=1.0).contains(u)) {
                    let value = signal[k];
                    errors.require(false, format!("{pointer}/{k}"), value, "-1 to 1");
                }
            }
        }
    }
}

fn split(spec: &JobSpec, errors: &mut Errors) {
    let split = spec.split;
    for (name, part) in [
        ("train", split.train),
        ("validation", split.validation),
        ("test", split.test),
    ] {
        errors.require(
            (0.0..=1.0).contains(&part),
            format!("/split/{name}"),
            part,
            "0 to 1",
        );
    }
    let sum = split.train + split.validation + split.test;
    errors.require(
        (sum - 1.0).abs() <= 1e-9,
        "/split",
        split,
        "train + validation + test = 1",
    );
}

/// A channel of the machine, named once.
fn known_once(names: &[String], k: usize, pointer: &str, channels: &[Channel], errors: &mut Errors) {
    let name = &names[k];
    let known: Vec<&str> = channels.iter().map(|c| c.name.as_str()).collect();
    errors.require(
        known.contains(&name.as_str()),
        pointer,
        name,
        format!("a channel of the machine: {}", known.join(", ")),
    );
    errors.require(!names[..k].contains(name), pointer, name, "every channel once");
}

fn columns(spec: &JobSpec, channels: &[Channel], errors: &mut Errors) {
    for k in 0..spec.columns.len() {
        known_once(&spec.columns, k, &format!("/columns/{k}"), channels, errors);
    }
    errors.require(
        (1..=4096).contains(&spec.file_size_mb),
        "/file_size_mb",
        spec.file_size_mb,
        "1 to 4096",
    );
}

fn train(spec: &JobSpec, training: &TrainingSpec, index: usize, channels: &[Channel], errors: &mut Errors) {
    let at = |field: &str| format!("/train/{index}/{field}");
    let structure = training.structure.as_str();
    errors.require(
        structure == "best"
            || (!structure.is_empty()
                && structure.len() <= 32
                && structure.chars().all(|c| "LTSRED".contains(c))
                && structure
                    .as_bytes()
                    .windows(2)
                    .all(|pair| pair[0] != b'D' || pair[1] == b'L')),
        at("structure"),
        structure,
        "best, or letters of L, T, S, R, E, D as in TLSLTLSLT; D (dropout) before an L or the end",
    );
    for (field, names) in [("inputs", &training.inputs), ("targets", &training.targets)] {
        for (k, name) in names.iter().enumerate() {
            let pointer = format!("{}/{k}", at(field));
            known_once(names, k, &pointer, channels, errors);
            errors.require(
                spec.keeps(name),
                &pointer,
                name,
                "a channel that the job keeps: see /columns",
            );
            errors.require(
                field == "inputs" || !training.inputs.contains(name),
                &pointer,
                name,
                "a channel that is not among the inputs",
            );
        }
    }
    window(spec, training, &at("window"), errors);
    shape(spec, training, &at, errors);
    errors.require(
        training.epochs.is_none_or(|epochs| epochs >= 1),
        at("epochs"),
        training.epochs,
        "at least 1",
    );
    errors.require(
        training.time_limit_s.is_none_or(|s| s > 0.0 && s.is_finite()),
        at("time_limit_s"),
        training.time_limit_s,
        "above 0 s",
    );
    errors.require(
        training
            .learning_rate
            .is_none_or(|rate| rate > 0.0 && rate <= 1.0),
        at("learning_rate"),
        training.learning_rate,
        "above 0, at most 1",
    );
    errors.require(
        training.batch.is_none_or(|batch| batch >= 1),
        at("batch"),
        training.batch,
        "at least 1",
    );
    let trains = (0..spec.runs.min(1000))
        .any(|run| spec.split.of(run) == hydroflex_openapi::dataset::SplitName::Train);
    errors.require(
        trains,
        "/split/train",
        spec.split.train,
        "enough for one training run, where networks are to be trained",
    );
}

/// Width, outputs and dropout of a network.
fn shape(spec: &JobSpec, training: &TrainingSpec, at: &impl Fn(&str) -> String, errors: &mut Errors) {
    const WIDEST: usize = TrainingSpec::WIDEST;
    let structure = training.structure.as_str();
    errors.require(
        training.width.is_none_or(|width| (1..=WIDEST).contains(&width)),
        at("width"),
        training.width,
        format!("1 to {WIDEST}"),
    );
    errors.require(
        training
            .width_windows
            .is_none_or(|times| training.width.is_none() && (1..=16).contains(&times)),
        at("width_windows"),
        training.width_windows,
        "1 to 16, without width",
    );
    errors.require(
        training
            .output_steps
            .is_none_or(|steps| (1..=1000).contains(&steps)),
        at("output_steps"),
        training.output_steps,
        "1 to 1000",
    );
    // Each of several estimated samples has the whole window before it.
    let window_steps = match training.window {
        WindowRule::Given { window_s } => (window_s / spec.sample_time_s).round(),
        _ => 1.0,
    };
    let rows = spec.steps() as f64 + 1.0;
    errors.require(
        training
            .output_steps
            .is_none_or(|steps| steps == 1 || window_steps + steps as f64 <= rows),
        at("output_steps"),
        training.output_steps,
        format!("with the window's at most the {rows} samples of a run"),
    );
    errors.require(
        training
            .width_windows
            .is_none_or(|times| window_steps * times as f64 <= WIDEST as f64),
        at("width_windows"),
        training.width_windows,
        format!("at most {WIDEST} values a layer; this window has {window_steps} steps"),
    );
    errors.require(
        training
            .dropout
            .is_none_or(|part| (0.0..1.0).contains(&part) && structure.contains('D')),
        at("dropout"),
        training.dropout,
        "at least 0, below 1, for structures with the letter D",
    );
}

fn window(spec: &JobSpec, training: &TrainingSpec, pointer: &str, errors: &mut Errors) {
    match training.window {
        WindowRule::Given { window_s } => errors.require(
            window_s >= spec.sample_time_s && window_s <= spec.duration_s,
            format!("{pointer}/window_s"),
            window_s,
            format!(
                "sample_time_s ({} s) to duration_s ({} s)",
                spec.sample_time_s, spec.duration_s
            ),
        ),
        WindowRule::Band | WindowRule::Paper => errors.require(
            spec.settling_runs > 0,
            "/settling_runs",
            spec.settling_runs,
            format!("at least 1, because {pointer} takes the window from settling runs"),
        ),
        WindowRule::Eigenvalues => {}
    }
}

/// A name as part of a JSON Pointer.
fn escaped(name: &str) -> String {
    name.replace('~', "~0").replace('/', "~1")
}
