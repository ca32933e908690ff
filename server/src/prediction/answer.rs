//! One JSON request for estimates, checked field by field and answered.

use super::{LoadedModel, SAMPLE_TIME_TOLERANCE, columns};
use hydroflex_openapi::model::ModelConfig;
use hydroflex_openapi::prediction::{PredictRequest, PredictResponse, Signal};
use hydroflex_openapi::problem::FieldError;
use std::borrow::Cow;
use std::collections::BTreeMap;

impl LoadedModel {
    /// Estimates for recorded signals.
    ///
    /// # Errors
    /// The inputs at fault: missing, in another unit, unknown, too short, of different lengths, not finite.
    pub fn predict(&self, request: &PredictRequest) -> Result<PredictResponse, Vec<FieldError>> {
        let config = self.config();
        let columns = check(config, request)?;
        let views: Vec<&[f64]> = columns.iter().map(std::convert::AsRef::as_ref).collect();
        let predictor = self.predictor();
        let series = self.with_workspace(|workspace| predictor.predict_series_with(&views, workspace));
        let named = |columns: Vec<Vec<f64>>| -> BTreeMap<String, Vec<f64>> {
            let names = config.targets.iter().map(|target| target.name.clone());
            names.zip(columns).collect()
        };
        let bound = |sign: f64| {
            predictor.has_intervals().then(|| {
                let columns = series.columns.iter().enumerate().map(|(target, column)| {
                    let half = |(k, y): (usize, &f64)| {
                        let payload_kg = series.payload_kg.get(k).copied();
                        y + sign * predictor.half_width(target, *y, payload_kg).unwrap_or(f64::NAN)
                    };
                    column.iter().enumerate().map(half).collect()
                });
                named(columns.collect())
            })
        };
        Ok(PredictResponse {
            model_id: self.id().clone(),
            dataset_id: self.dataset_id().clone(),
            provenance: self.provenance().clone(),
            sample_time_s: config.sample_time_s,
            window_steps: config.window_steps as u64,
            first_step: series.first_row as u64,
            count: series.columns.first().map_or(0, Vec::len) as u64,
            lower: bound(-1.0),
            upper: bound(1.0),
            inside_envelope: (!series.inside.is_empty()).then(|| series.inside.clone()),
            estimates: named(series.columns),
        })
    }
}

/// One column per input of the model, in its order.
fn check<'a>(
    config: &ModelConfig,
    request: &'a PredictRequest,
) -> Result<Vec<Cow<'a, [f64]>>, Vec<FieldError>> {
    let mut errors = Vec::new();
    if let Some(sample_time_s) = request.sample_time_s {
        errors.extend(check_sample_time(config, sample_time_s));
    }
    let names: Vec<&str> = config.inputs.iter().map(|input| input.name.as_str()).collect();
    let given: Vec<&str> = request.inputs.keys().map(String::as_str).collect();
    let missing = columns::missing(config, &given, pointer);
    for name in given.iter().filter(|name| !names.contains(name)) {
        let pointer = pointer(name);
        // One that is there in another unit is told once.
        if missing.iter().all(|error| error.pointer != pointer) {
            let error = FieldError::new(pointer, "not an input of this model");
            errors.push(error.allowed(names.join(", ")));
        }
    }
    errors.extend(missing);
    let steps = config.window_steps;
    let length = request.inputs.iter().find_map(|(name, signal)| match signal {
        Signal::Samples(samples) => Some((name.as_str(), samples.len())),
        Signal::Constant(_) => None,
    });
    let (first, length) = length.unwrap_or(("", steps));
    let mut columns = Vec::with_capacity(names.len());
    for name in &names {
        match request.inputs.get(*name) {
            None => {}
            Some(Signal::Constant(value)) => {
                check_finite(name, &[*value], &mut errors);
                columns.push(Cow::Owned(vec![*value; length]));
            }
            Some(Signal::Samples(samples)) => {
                if samples.len() != length {
                    let error = FieldError::new(pointer(name), "inputs differ in length");
                    errors.push(
                        error
                            .value(samples.len())
                            .allowed(format!("{length} samples, as in {first}")),
                    );
                } else if samples.len() < steps {
                    let error = FieldError::new(pointer(name), "shorter than one window");
                    errors.push(
                        error
                            .value(samples.len())
                            .allowed(format!("at least {steps} samples")),
                    );
                }
                check_finite(name, samples, &mut errors);
                columns.push(Cow::Borrowed(samples.as_slice()));
            }
        }
    }
    if errors.is_empty() {
        Ok(columns)
    } else {
        Err(errors)
    }
}

/// An error if a sample time is not the model's.
#[must_use]
pub fn check_sample_time(config: &ModelConfig, sample_time_s: f64) -> Option<FieldError> {
    let expected = config.sample_time_s;
    let same = (sample_time_s / expected - 1.0).abs() <= SAMPLE_TIME_TOLERANCE;
    (!same).then(|| {
        FieldError::new("/sample_time_s", "the model was trained with another sample time")
            .value(sample_time_s)
            .allowed(expected.to_string())
    })
}

fn pointer(name: &str) -> String {
    format!("/inputs/{}", name.replace('~', "~0").replace('/', "~1"))
}

/// JSON has no NaN, but 1e999 becomes infinite.
fn check_finite(name: &str, samples: &[f64], errors: &mut Vec<FieldError>) {
    if let Some(step) = samples.iter().position(|value| !value.is_finite()) {
        let error = FieldError::new(format!("{}/{step}", pointer(name)), "not a finite number");
        errors.push(error.value(samples[step].to_string()));
    }
}
