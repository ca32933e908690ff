//! A live signal: the session holds the window, each sample brings an estimate.
//!
//! Samples are numbered. One that is lost is filled in: between its neighbours by a straight line
//! once the next one comes, a silent sensor by its last value. The answer says how many samples of
//! the window are filled in, and gives no estimate beyond a limit. A sample that comes late takes
//! its place if the window still holds it; one that comes twice is answered twice and used once.
//!
//! ```text
//! binary sample:  step u64 │ one f64 (or one f32) per input, NaN for a silent sensor     little endian
//! binary answer:  step u64 │ status u8 │ inside u8 (255: unknown) │ filled u16 │ 4 × 0 │
//!                 estimate, lower, upper as f64 per target (NaN: there is none)
//! ```

use super::LoadedModel;
use hydroflex_ml::predict::sliding::SlidingWindow;
use hydroflex_openapi::stream::{SampleStatus, StreamEstimate, StreamOpened, StreamSample};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Flag of a binary answer: the model has no envelope, or there is no estimate.
const UNKNOWN: u8 = 255;

/// Filled-in samples up to which estimates are given, as a part of the window.
const MAX_FILLED_PART: usize = 4;

/// One streaming session.
pub struct Session {
    model: Arc<LoadedModel>,
    window: SlidingWindow,
    /// For each sample of the window, whether it was filled in.
    is_filled: VecDeque<bool>,
    filled: usize,
    max_filled: usize,
    last_step: Option<u64>,
    last_sample: Vec<f64>,
    sample: Vec<f64>,
    between: Vec<f64>,
    estimates: Vec<f64>,
    /// Of the last estimate; `None` when there was none.
    inside: Option<bool>,
    /// Payload that the model told from the last window, kg.
    payload_kg: Option<f64>,
    has_estimate: bool,
}

/// What became of a sample; the session holds the estimate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Taken {
    /// Number of the sample.
    pub step: u64,
    /// How it was taken.
    pub status: SampleStatus,
    /// Whether the session's estimate goes with it.
    pub has_estimate: bool,
}

impl Session {
    /// An empty session.
    #[must_use]
    pub fn new(model: Arc<LoadedModel>) -> Self {
        let predictor = model.predictor();
        Self {
            window: SlidingWindow::new(predictor),
            is_filled: VecDeque::with_capacity(predictor.window_steps() + 1),
            filled: 0,
            max_filled: predictor.window_steps() / MAX_FILLED_PART,
            last_step: None,
            last_sample: vec![0.0; predictor.input_count()],
            sample: vec![0.0; predictor.input_count()],
            between: vec![0.0; predictor.input_count()],
            estimates: vec![0.0; predictor.target_count()],
            inside: None,
            payload_kg: None,
            has_estimate: false,
            model,
        }
    }

    /// What the session takes and gives.
    #[must_use]
    pub fn opened(&self) -> StreamOpened {
        let config = self.model.config();
        StreamOpened {
            model_id: self.model.id().clone(),
            inputs: config.inputs.iter().map(|input| input.name.clone()).collect(),
            targets: config.targets.iter().map(|target| target.name.clone()).collect(),
            sample_time_s: config.sample_time_s,
            window_steps: config.window_steps as u64,
            max_filled: self.max_filled as u64,
        }
    }

    /// Answers one sample given as JSON.
    ///
    /// # Errors
    /// What is wrong with it; the session stays as it was.
    pub fn text(&mut self, text: &str) -> Result<StreamEstimate, String> {
        let sample: StreamSample =
            serde_json::from_str(text).map_err(|error| format!("not a sample: {error}"))?;
        let inputs = &self.model.config().inputs;
        if let Some(unknown) = sample
            .inputs
            .keys()
            .find(|name| inputs.iter().all(|input| input.name != **name))
        {
            let names: Vec<&str> = inputs.iter().map(|input| input.name.as_str()).collect();
            return Err(format!(
                "step {}: {unknown:?} is not an input of the model; its inputs are {}",
                sample.step,
                names.join(", ")
            ));
        }
        for (slot, input) in self.sample.iter_mut().zip(inputs) {
            *slot = match sample.inputs.get(&input.name) {
                Some(Some(value)) => *value,
                Some(None) => f64::NAN,
                None => {
                    return Err(format!(
                        "step {}: input {:?} is missing; give null for a sensor that gave nothing",
                        sample.step, input.name
                    ));
                }
            };
        }
        let taken = self.take(sample.step)?;
        let targets = &self.model.config().targets;
        let predictor = self.model.predictor();
        let named = |value: &dyn Fn(usize, f64) -> f64| -> BTreeMap<String, f64> {
            targets
                .iter()
                .enumerate()
                .map(|(target, channel)| (channel.name.clone(), value(target, self.estimates[target])))
                .collect()
        };
        let bound = |sign: f64| {
            (taken.has_estimate && predictor.has_intervals()).then(|| {
                named(&|target, y| {
                    y + sign
                        * predictor
                            .half_width(target, y, self.payload_kg)
                            .unwrap_or(f64::NAN)
                })
            })
        };
        Ok(StreamEstimate {
            step: taken.step,
            status: taken.status,
            filled: self.filled as u64,
            estimates: taken.has_estimate.then(|| named(&|_, y| y)),
            lower: bound(-1.0),
            upper: bound(1.0),
            inside_envelope: self.inside.filter(|_| taken.has_estimate),
        })
    }

    /// Answers one binary sample into `answer`, which is cleared first.
    ///
    /// # Errors
    /// What is wrong with it; the session stays as it was.
    pub fn binary(&mut self, bytes: &[u8], answer: &mut Vec<u8>) -> Result<(), String> {
        let width = self.sample.len();
        let Some((step, values)) = bytes.split_first_chunk::<8>() else {
            return Err(format!(
                "a binary sample begins with a step of 8 bytes; this one has {}",
                bytes.len()
            ));
        };
        let step = u64::from_le_bytes(*step);
        if values.len() == 8 * width {
            for (slot, value) in self.sample.iter_mut().zip(values.as_chunks().0) {
                *slot = f64::from_le_bytes(*value);
            }
        } else if values.len() == 4 * width {
            for (slot, value) in self.sample.iter_mut().zip(values.as_chunks().0) {
                *slot = f64::from(f32::from_le_bytes(*value));
            }
        } else {
            return Err(format!(
                "a binary sample of {width} inputs has {} (f64) or {} (f32) bytes; this one has {}",
                8 + 8 * width,
                8 + 4 * width,
                bytes.len()
            ));
        }
        let taken = self.take(step)?;
        let predictor = self.model.predictor();
        answer.clear();
        answer.extend(taken.step.to_le_bytes());
        let inside = self.inside.filter(|_| taken.has_estimate);
        answer.extend([taken.status.code(), inside.map_or(UNKNOWN, u8::from)]);
        answer.extend(u16::try_from(self.filled).unwrap_or(u16::MAX).to_le_bytes());
        answer.extend([0; 4]);
        for (target, &y) in self.estimates.iter().enumerate() {
            let values = if taken.has_estimate {
                let half = predictor
                    .half_width(target, y, self.payload_kg)
                    .unwrap_or(f64::NAN);
                [y, y - half, y + half]
            } else {
                [f64::NAN; 3]
            };
            answer.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        }
        Ok(())
    }

    /// Takes the sample in `self.sample`, NaN for a silent sensor.
    fn take(&mut self, step: u64) -> Result<Taken, String> {
        if let Some(place) = self.sample.iter().position(|value| value.is_infinite()) {
            let name = &self.model.config().inputs[place].name;
            return Err(format!("step {step}: {name:?} is infinite"));
        }
        let is_whole = self.sample.iter().all(|value| !value.is_nan());
        let steps = self.model.predictor().window_steps() as u64;
        match self.last_step {
            Some(last) if step == last => {
                return Ok(Taken {
                    step,
                    status: SampleStatus::Repeated,
                    has_estimate: self.has_estimate,
                });
            }
            Some(last) if step < last => return Ok(self.take_late(step, last - step, is_whole)),
            Some(last) if step - last <= steps => self.fill(step - last - 1),
            // The first sample, or after silence of a whole window: a new beginning.
            Some(_) | None => self.restart(),
        }
        if self.window.is_empty() && !is_whole {
            // Nothing to hold yet.
            return Ok(Taken {
                step,
                status: SampleStatus::Filling,
                has_estimate: false,
            });
        }
        for (value, last) in self.sample.iter_mut().zip(&self.last_sample) {
            if value.is_nan() {
                *value = *last;
            }
        }
        self.window.push(self.model.predictor(), &self.sample);
        self.note(!is_whole);
        self.last_sample.copy_from_slice(&self.sample);
        self.last_step = Some(step);
        Ok(self.estimate(step))
    }

    fn estimate(&mut self, step: u64) -> Taken {
        let status = if !self.window.is_full() {
            SampleStatus::Filling
        } else if self.filled > self.max_filled {
            SampleStatus::Gap
        } else if self.filled > 0 {
            SampleStatus::Filled
        } else {
            SampleStatus::Ok
        };
        self.has_estimate = matches!(status, SampleStatus::Ok | SampleStatus::Filled);
        if self.has_estimate {
            let predictor = self.model.predictor();
            let (window, estimates) = (&self.window, &mut self.estimates);
            let found = self
                .model
                .with_workspace(|workspace| window.predict(predictor, estimates, workspace));
            self.inside = found
                .map(|found| found.inside)
                .filter(|_| predictor.has_envelope());
            self.payload_kg = found.and_then(|found| found.payload_kg);
        }
        Taken {
            step,
            status,
            has_estimate: self.has_estimate,
        }
    }

    /// A sample whose turn was `age` samples ago.
    fn take_late(&mut self, step: u64, age: u64, is_whole: bool) -> Taken {
        let place = usize::try_from(age)
            .ok()
            .and_then(|age| self.is_filled.len().checked_sub(age)?.checked_sub(1));
        let status = match place {
            Some(place) if is_whole && self.is_filled[place] => {
                let age = self.is_filled.len() - 1 - place;
                self.window.replace(self.model.predictor(), age, &self.sample);
                self.is_filled[place] = false;
                self.filled -= 1;
                SampleStatus::Late
            }
            _ => SampleStatus::TooLate,
        };
        Taken {
            step,
            status,
            has_estimate: false,
        }
    }

    /// Fills `count` lost samples by a straight line to the one at hand.
    fn fill(&mut self, count: u64) {
        for lost in 1..=count {
            let part = lost as f64 / (count + 1) as f64;
            for ((between, &from), &to) in self.between.iter_mut().zip(&self.last_sample).zip(&self.sample) {
                let to = if to.is_nan() { from } else { to };
                *between = from + part * (to - from);
            }
            self.window.push(self.model.predictor(), &self.between);
            self.note(true);
        }
    }

    fn note(&mut self, filled: bool) {
        if self.is_filled.len() == self.model.predictor().window_steps() {
            let gone = self.is_filled.pop_front();
            self.filled -= usize::from(gone == Some(true));
        }
        self.is_filled.push_back(filled);
        self.filled += usize::from(filled);
    }

    fn restart(&mut self) {
        self.window.clear();
        self.is_filled.clear();
        self.filled = 0;
        self.has_estimate = false;
        self.last_step = None;
    }
}
