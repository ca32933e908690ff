//! One request for estimates, checked field by field and answered.

use super::LoadedModel;
use hydroflex_openapi::model::ModelConfig;
use hydroflex_openapi::prediction::{PredictRequest, PredictResponse, Signal};
use hydroflex_openapi::problem::FieldError;
use std::borrow::Cow;

/// Sample times that differ by less than this part are the same: 0.005 may come as 1/200.
const SAMPLE_TIME_TOLERANCE: f64 = 1e-6;

impl LoadedModel {
    /// Estimates for recorded signals.
    ///
    /// # Errors
    /// The inputs at fault: missing, unknown, too short, of different lengths, not finite.
    pub fn predict(&self, request: &PredictRequest) -> Result<PredictResponse, Vec<FieldError>> {
        let config = self.model.config();
        let columns = columns(config, request)?;
        let views: Vec<&[f64]> = columns.iter().map(|column| column.as_ref()).collect();
        let series = self.model.predictor().predict_series(&views);
        let count = series.columns.first().map_or(0, Vec::len) as u64;
        let names = config.targets.iter().map(|target| target.name.clone());
        Ok(PredictResponse {
            model_id: self.id.clone(),
            dataset_id: self.dataset_id.clone(),
            sample_time_s: config.sample_time_s,
            window_steps: config.window_steps as u64,
            first_step: series.first_row as u64,
            count,
            estimates: names.zip(series.columns).collect(),
            inside_envelope: (!series.inside.is_empty()).then_some(series.inside),
        })
    }
}

/// One column per input of the model, in its order.
fn columns<'a>(
    config: &ModelConfig,
    request: &'a PredictRequest,
) -> Result<Vec<Cow<'a, [f64]>>, Vec<FieldError>> {
    let mut errors = Vec::new();
    if let Some(sample_time_s) = request.sample_time_s {
        let expected = config.sample_time_s;
        let same = (sample_time_s / expected - 1.0).abs() <= SAMPLE_TIME_TOLERANCE;
        if !same {
            let error = FieldError::new("/sample_time_s", "the model was trained with another sample time");
            errors.push(error.value(sample_time_s).allowed(expected.to_string()));
        }
    }
    let inputs: Vec<&str> = config.inputs.iter().map(|input| input.name.as_str()).collect();
    for name in request.inputs.keys() {
        if !inputs.contains(&name.as_str()) {
            let error = FieldError::new(pointer(name), "not an input of this model");
            errors.push(error.allowed(inputs.join(", ")));
        }
    }
    let steps = config.window_steps;
    let length = request.inputs.values().find_map(|signal| match signal {
        Signal::Samples(samples) => Some(samples.len()),
        Signal::Constant(_) => None,
    });
    let length = length.unwrap_or(steps);
    let mut columns = Vec::with_capacity(inputs.len());
    for name in &inputs {
        match request.inputs.get(*name) {
            None => errors.push(FieldError::new(
                pointer(name),
                "this input of the model is missing",
            )),
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
                            .allowed(format!("{length} samples, as in the first")),
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
