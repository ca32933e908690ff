//! The Open Inference Protocol's tensors: a request's bytes in, an answer's bytes out.
//!
//! A body is JSON, or JSON of a length given in a header followed by the tensors' bytes in the
//! order in which the JSON names them. Everything is checked before anything is computed.

use super::{LoadedModel, numbers};
use hydroflex_ml::predict::{PerWindow, Predictor};
use hydroflex_openapi::model::ModelConfig;
use serde::de::{Deserializer, SeqAccess, Visitor};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// Header that says how many bytes of a body are JSON.
pub const HEADER_LENGTH: &str = "inference-header-content-length";
/// Name of the tensor in.
pub const WINDOW: &str = "window";

/// Dimensions that `data` may be nested in: batch, steps, inputs.
const DEEPEST: usize = 3;

/// Tensors out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Output {
    /// One per target.
    Estimates,
    /// Lower ends of the 90 % intervals.
    Lower,
    /// Upper ends.
    Upper,
    /// One flag per window.
    InsideEnvelope,
}

impl Output {
    /// Those that a model has.
    #[must_use]
    pub fn of(predictor: &Predictor) -> Vec<Self> {
        let mut outputs = vec![Self::Estimates];
        if predictor.has_intervals() {
            outputs.extend([Self::Lower, Self::Upper]);
        }
        if predictor.has_envelope() {
            outputs.push(Self::InsideEnvelope);
        }
        outputs
    }

    /// Its name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Estimates => "estimates",
            Self::Lower => "lower",
            Self::Upper => "upper",
            Self::InsideEnvelope => "inside_envelope",
        }
    }

    /// Its datatype.
    #[must_use]
    pub fn datatype(self) -> &'static str {
        match self {
            Self::InsideEnvelope => "BOOL",
            Self::Estimates | Self::Lower | Self::Upper => "FP64",
        }
    }
}

/// Windows as sent.
#[derive(Debug, Clone, PartialEq)]
pub enum Samples {
    /// `FP32`.
    Single(Vec<f32>),
    /// `FP64`.
    Double(Vec<f64>),
}

/// A request, checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Batch {
    /// As sent.
    pub id: Option<String>,
    /// Row-major `[windows, steps, inputs]`.
    pub samples: Samples,
    /// Number of windows.
    pub windows: usize,
    /// Outputs asked for, and whether as bytes.
    pub outputs: Vec<(Output, bool)>,
}

#[derive(Deserialize)]
struct Request<'a> {
    #[serde(default, borrow)]
    id: Option<Cow<'a, str>>,
    #[serde(default)]
    parameters: RequestParameters,
    #[serde(borrow)]
    inputs: Vec<Input<'a>>,
    #[serde(default, borrow)]
    outputs: Option<Vec<Requested<'a>>>,
}

#[derive(Default, Deserialize)]
struct RequestParameters {
    #[serde(default)]
    binary_data_output: bool,
}

#[derive(Deserialize)]
struct Input<'a> {
    #[serde(borrow)]
    name: Cow<'a, str>,
    #[serde(borrow)]
    datatype: Cow<'a, str>,
    shape: Vec<u64>,
    #[serde(default)]
    parameters: InputParameters,
    #[serde(default)]
    data: Option<Flat>,
}

#[derive(Default, Deserialize)]
struct InputParameters {
    binary_data_size: Option<u64>,
}

#[derive(Deserialize)]
struct Requested<'a> {
    #[serde(borrow)]
    name: Cow<'a, str>,
    #[serde(default)]
    parameters: RequestedParameters,
}

#[derive(Default, Deserialize)]
struct RequestedParameters {
    binary_data: Option<bool>,
    #[serde(default)]
    classification: Option<u64>,
}

/// Numbers in row-major order, however they are nested.
#[derive(Debug, Default, PartialEq)]
struct Flat(Vec<f64>);

impl<'de> Deserialize<'de> for Flat {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut values = Vec::new();
        let list = List {
            values: &mut values,
            depth: 1,
        };
        deserializer.deserialize_seq(list)?;
        Ok(Self(values))
    }
}

struct List<'v> {
    values: &'v mut Vec<f64>,
    depth: usize,
}

impl<'de> Visitor<'de> for List<'_> {
    type Value = ();

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("an array of numbers")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<(), A::Error> {
        while seq
            .next_element_seed(Element {
                values: &mut *self.values,
                depth: self.depth,
            })?
            .is_some()
        {}
        Ok(())
    }
}

struct Element<'v> {
    values: &'v mut Vec<f64>,
    depth: usize,
}

impl<'de> serde::de::DeserializeSeed<'de> for Element<'_> {
    type Value = ();
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Element<'_> {
    type Value = ();

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a number")
    }

    fn visit_f64<E>(self, value: f64) -> Result<(), E> {
        self.values.push(value);
        Ok(())
    }

    fn visit_i64<E>(self, value: i64) -> Result<(), E> {
        self.values.push(value as f64);
        Ok(())
    }

    fn visit_u64<E>(self, value: u64) -> Result<(), E> {
        self.values.push(value as f64);
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, seq: A) -> Result<(), A::Error> {
        if self.depth == DEEPEST {
            return Err(serde::de::Error::custom(format!(
                "data is nested more than {DEEPEST} deep"
            )));
        }
        let depth = self.depth + 1;
        List {
            values: self.values,
            depth,
        }
        .visit_seq(seq)
    }
}

/// Reads and checks a request for a model.
///
/// # Errors
/// What is wrong, where, and what is allowed.
pub fn read(
    body: &[u8],
    json_length: Option<usize>,
    predictor: &Predictor,
    config: &ModelConfig,
) -> Result<Batch, String> {
    let length = json_length.unwrap_or(body.len());
    let Some((json, bytes)) = body.split_at_checked(length) else {
        return Err(format!(
            "Inference-Header-Content-Length is {length}, but the body has {} bytes",
            body.len()
        ));
    };
    let (rest, values) = numbers::apart(json, DEEPEST).unzip();
    let request = match rest.as_deref().and_then(without_values).zip(values) {
        Some((mut request, values)) => {
            request.inputs[0].data = Some(Flat(values));
            request
        }
        // Whole, as it is: also for whoever is told what is wrong with it and where.
        None => serde_json::from_slice(json)
            .map_err(|error| format!("the request is not what the protocol says: {error}"))?,
    };
    let [input] = <[Input<'_>; 1]>::try_from(request.inputs).map_err(|inputs| {
        let names: Vec<_> = inputs.iter().map(|input| input.name.as_ref()).collect();
        format!("inputs are {names:?}; the model takes one, {WINDOW:?}")
    })?;
    if input.name != WINDOW {
        return Err(format!(
            "there is no input {:?}; the model takes {WINDOW:?}",
            input.name
        ));
    }
    let windows = batch_size(&input.shape, predictor)?;
    let samples = samples(input, bytes, json_length.is_some())?;
    let outputs = outputs(request.outputs, request.parameters.binary_data_output, predictor)?;
    let batch = Batch {
        id: request.id.map(Cow::into_owned),
        samples,
        windows,
        outputs,
    };
    check_values(&batch, predictor, config)?;
    Ok(batch)
}

/// A request whose numbers were read apart: in place of those of its one input stands an empty array.
fn without_values(json: &[u8]) -> Option<Request<'_>> {
    let request: Request<'_> = serde_json::from_slice(json).ok()?;
    let is_empty = |input: &Input<'_>| input.data.as_ref().is_some_and(|Flat(values)| values.is_empty());
    matches!(request.inputs.as_slice(), [input] if is_empty(input)).then_some(request)
}

fn batch_size(shape: &[u64], predictor: &Predictor) -> Result<usize, String> {
    let (steps, inputs) = (predictor.window_steps() as u64, predictor.input_count() as u64);
    match *shape {
        [batch, s, i] if s == steps && i == inputs && batch > 0 => {
            usize::try_from(batch).map_err(|_| format!("a batch of {batch} windows is too large"))
        }
        _ => Err(format!(
            "input {WINDOW:?} has shape {shape:?}; the model takes [batch, {steps}, {inputs}] with a batch of at least 1"
        )),
    }
}

fn samples(input: Input<'_>, bytes: &[u8], has_bytes: bool) -> Result<Samples, String> {
    let count = input
        .shape
        .iter()
        .try_fold(1_u64, |product, &size| product.checked_mul(size))
        .unwrap_or(u64::MAX);
    let is_single = match input.datatype.as_ref() {
        "FP32" => true,
        "FP64" => false,
        other => {
            return Err(format!(
                "input {WINDOW:?} has datatype {other:?}; FP32 and FP64 are taken"
            ));
        }
    };
    match (input.parameters.binary_data_size, input.data) {
        (Some(_), Some(_)) => Err(format!(
            "input {WINDOW:?} has both data and binary_data_size; give one of them"
        )),
        (None, None) => Err(format!(
            "input {WINDOW:?} has no values: give data, or binary_data_size and bytes after the JSON"
        )),
        (Some(_), None) if !has_bytes => Err(format!(
            "input {WINDOW:?} has binary_data_size, but the request has no header Inference-Header-Content-Length"
        )),
        (Some(size), None) => {
            let width = if is_single { 4 } else { 8 };
            if count.checked_mul(width) != Some(size) {
                return Err(format!(
                    "input {WINDOW:?}: binary_data_size is {size}, shape {:?} of {} takes {}",
                    input.shape,
                    input.datatype,
                    count.saturating_mul(width)
                ));
            }
            if bytes.len() as u64 != size {
                return Err(format!(
                    "{} bytes follow the JSON; binary_data_size of {WINDOW:?} says {size}",
                    bytes.len()
                ));
            }
            Ok(if is_single {
                Samples::Single(
                    bytes
                        .as_chunks()
                        .0
                        .iter()
                        .map(|b| f32::from_le_bytes(*b))
                        .collect(),
                )
            } else {
                Samples::Double(
                    bytes
                        .as_chunks()
                        .0
                        .iter()
                        .map(|b| f64::from_le_bytes(*b))
                        .collect(),
                )
            })
        }
        (None, Some(Flat(values))) => {
            if values.len() as u64 != count {
                return Err(format!(
                    "input {WINDOW:?} has {} values, shape {:?} takes {count}",
                    values.len(),
                    input.shape
                ));
            }
            if !bytes.is_empty() {
                return Err(format!(
                    "{} bytes follow the JSON, but no input has binary_data_size",
                    bytes.len()
                ));
            }
            Ok(Samples::Double(values))
        }
    }
}

fn outputs(
    requested: Option<Vec<Requested<'_>>>,
    binary: bool,
    predictor: &Predictor,
) -> Result<Vec<(Output, bool)>, String> {
    let known = Output::of(predictor);
    let requested = requested.unwrap_or_default();
    if requested.is_empty() {
        return Ok(known.into_iter().map(|output| (output, binary)).collect());
    }
    let mut outputs: Vec<(Output, bool)> = Vec::with_capacity(requested.len());
    for wanted in requested {
        let Some(&output) = known.iter().find(|output| output.name() == wanted.name) else {
            let names: Vec<_> = known.iter().map(|output| output.name()).collect();
            return Err(format!(
                "there is no output {:?}; the model gives {names:?}",
                wanted.name
            ));
        };
        if wanted
            .parameters
            .classification
            .is_some_and(|classes| classes > 0)
        {
            return Err(format!(
                "output {:?}: classification is not done here; estimates are numbers",
                wanted.name
            ));
        }
        if outputs.iter().any(|(before, _)| *before == output) {
            return Err(format!("output {:?} is asked for twice", wanted.name));
        }
        outputs.push((output, wanted.parameters.binary_data.unwrap_or(binary)));
    }
    Ok(outputs)
}

fn check_values(batch: &Batch, predictor: &Predictor, config: &ModelConfig) -> Result<(), String> {
    let bad = match &batch.samples {
        Samples::Single(values) => not_finite(values),
        Samples::Double(values) => not_finite(values),
    };
    let Some((place, value)) = bad else { return Ok(()) };
    let width = predictor.input_count();
    let (window, row) = (place / predictor.window_len(), place % predictor.window_len());
    Err(format!(
        "input {WINDOW:?}: {value} at [{window}, {}, {}], {:?}; estimates need finite numbers",
        row / width,
        row % width,
        config.inputs[row % width].name
    ))
}

/// The first value that is not finite, and where it is.
fn not_finite<T: Copy + Into<f64>>(values: &[T]) -> Option<(usize, f64)> {
    let finite = |value: T| -> bool { Into::<f64>::into(value).is_finite() };
    // Without a branch per value first, so that the common case is vector code.
    if values.iter().fold(true, |all, &value| all & finite(value)) {
        return None;
    }
    let place = values.iter().position(|&value| !finite(value))?;
    Some((place, values[place].into()))
}

/// An answer's bytes.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// JSON, then the outputs that were asked for as bytes.
    pub body: Vec<u8>,
    /// Bytes of JSON, where bytes follow.
    pub json_length: Option<usize>,
}

#[derive(Serialize)]
struct Response<'a> {
    model_name: &'a str,
    model_version: &'a str,
    #[serde(skip_serializing_if = "Option::is_none")]
    id: Option<&'a str>,
    outputs: Vec<Tensor<'a>>,
}

#[derive(Serialize)]
struct Tensor<'a> {
    name: &'static str,
    datatype: &'static str,
    shape: Shape,
    #[serde(skip_serializing_if = "Option::is_none")]
    parameters: Option<TensorParameters>,
    #[serde(skip_serializing_if = "Option::is_none")]
    data: Option<Values<'a>>,
}

#[derive(Serialize)]
#[serde(untagged)]
enum Shape {
    Flags([usize; 1]),
    Numbers([usize; 2]),
}

#[derive(Serialize)]
struct TensorParameters {
    binary_data_size: usize,
}

#[derive(Clone, Copy, Serialize)]
#[serde(untagged)]
enum Values<'a> {
    Numbers(&'a [f64]),
    Flags(&'a [bool]),
}

/// Refuses what is no finite number: JSON would say `null` for it.
fn check_finite(name: &str, numbers: &[f64], targets: usize) -> Result<(), String> {
    match numbers.iter().position(|number| !number.is_finite()) {
        None => Ok(()),
        Some(place) => Err(format!(
            "the {name} of target {} of window {} is {}, no finite number: the window is too far from everything \
             that the model has learned",
            place % targets,
            place / targets,
            numbers[place]
        )),
    }
}

/// What a model gives for a batch, window by window.
struct Estimated {
    estimates: Vec<f64>,
    /// Empty unless it was asked for.
    inside: Vec<bool>,
    /// Where bounds follow a payload; else empty.
    payload_kg: Vec<f64>,
}

fn estimate(model: &LoadedModel, batch: &Batch, wants_inside: bool, wants_bounds: bool) -> Estimated {
    let predictor = model.predictor();
    let follows = predictor.follows_payload() && wants_bounds;
    let mut found = Estimated {
        estimates: vec![0.0; batch.windows * predictor.target_count()],
        inside: vec![true; if wants_inside { batch.windows } else { 0 }],
        payload_kg: vec![0.0; if follows { batch.windows } else { 0 }],
    };
    let asked = PerWindow {
        inside: wants_inside.then_some(found.inside.as_mut_slice()),
        payload_kg: follows.then_some(found.payload_kg.as_mut_slice()),
    };
    model.with_workspace(|workspace| match &batch.samples {
        Samples::Single(values) => {
            predictor.predict_windows_with(values, &mut found.estimates, asked, workspace);
        }
        Samples::Double(values) => {
            predictor.predict_windows_with(values, &mut found.estimates, asked, workspace);
        }
    });
    found
}

/// Estimates for a checked batch.
///
/// # Errors
/// If an estimate or a bound is no finite number, which JSON cannot hold and nobody can use.
pub fn answer(model: &LoadedModel, name: &str, version: &str, batch: &Batch) -> Result<Answer, String> {
    let predictor = model.predictor();
    let targets = predictor.target_count();
    let wants = |output| batch.outputs.iter().any(|(wanted, _)| *wanted == output);
    let wants_bounds = wants(Output::Lower) || wants(Output::Upper);
    let Estimated {
        estimates,
        inside,
        payload_kg,
    } = estimate(model, batch, wants(Output::InsideEnvelope), wants_bounds);
    let bound = |sign: f64| -> Vec<f64> {
        estimates
            .iter()
            .enumerate()
            .map(|(place, y)| {
                let payload_kg = payload_kg.get(place / targets).copied();
                y + sign
                    * predictor
                        .half_width(place % targets, *y, payload_kg)
                        .unwrap_or(f64::NAN)
            })
            .collect()
    };
    let lower = if wants(Output::Lower) {
        bound(-1.0)
    } else {
        Vec::new()
    };
    let upper = if wants(Output::Upper) {
        bound(1.0)
    } else {
        Vec::new()
    };
    for (name, numbers) in [
        ("estimate", &estimates),
        ("lower bound", &lower),
        ("upper bound", &upper),
    ] {
        check_finite(name, numbers, targets)?;
    }
    let values = |output| match output {
        Output::Estimates => Values::Numbers(&estimates),
        Output::Lower => Values::Numbers(&lower),
        Output::Upper => Values::Numbers(&upper),
        Output::InsideEnvelope => Values::Flags(&inside),
    };
    let tensors = batch.outputs.iter().map(|&(output, binary)| {
        let values = values(output);
        let size = match values {
            Values::Numbers(numbers) => 8 * numbers.len(),
            Values::Flags(flags) => flags.len(),
        };
        Tensor {
            name: output.name(),
            datatype: output.datatype(),
            shape: match values {
                Values::Numbers(_) => Shape::Numbers([batch.windows, targets]),
                Values::Flags(_) => Shape::Flags([batch.windows]),
            },
            parameters: binary.then_some(TensorParameters {
                binary_data_size: size,
            }),
            data: (!binary).then_some(values),
        }
    });
    let response = Response {
        model_name: name,
        model_version: version,
        id: batch.id.as_deref(),
        outputs: tensors.collect(),
    };
    let mut body = Vec::with_capacity(256 + 24 * estimates.len() * batch.outputs.len());
    serde_json::to_writer(&mut body, &response).map_err(|error| error.to_string())?;
    let json_length = batch
        .outputs
        .iter()
        .any(|(_, binary)| *binary)
        .then_some(body.len());
    for (output, _) in batch.outputs.iter().filter(|(_, binary)| *binary) {
        match values(*output) {
            Values::Numbers(numbers) => body.extend(numbers.iter().flat_map(|value| value.to_le_bytes())),
            Values::Flags(flags) => body.extend(flags.iter().map(|&flag| u8::from(flag))),
        }
    }
    Ok(Answer { body, json_length })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_finite_number_is_named() {
        assert_eq!(check_finite("estimate", &[1.0, -2.0], 2), Ok(()));
        for bad in [f64::NAN, f64::INFINITY] {
            let refused = check_finite("estimate", &[1.0, 2.0, 3.0, bad], 2).unwrap_err();
            assert!(refused.contains("estimate of target 1 of window 1"), "{refused}");
        }
    }
}
