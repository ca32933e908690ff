//! `model.onnx`: the network with its scales, for onnxruntime and whatever else reads ONNX.
//!
//! ```text
//! window [batch, steps, inputs] f64 → scale → flatten ─► f32 → layers → f64 ─► + ─► unscale → estimates [batch, targets]
//!                                                    └► f64 skip, times powers of the slow signals ─┘
//! ```
//!
//! and between the sum and the unscaling the bounds: `Max`, `Min` with the guide's output and the target's range.
//!
//! Only the messages and fields that this graph needs are declared, with the numbers of
//! `onnx.proto` (IR version 8, operator set 17).

use super::weights::{LinearWeights, SkipWeights, Weights};
use hydroflex_openapi::model::{Activation, Guard, ModelConfig, ScaledChannel, Schedule};
use prost::Message;

const IR_VERSION: i64 = 8;
const OPSET_VERSION: i64 = 17;

const FLOAT: i32 = 1;
const INT64: i32 = 7;
const DOUBLE: i32 = 11;

const ATTRIBUTE_INT: i32 = 2;

#[derive(Clone, PartialEq, Message)]
struct ModelProto {
    #[prost(int64, tag = "1")]
    ir_version: i64,
    #[prost(string, tag = "2")]
    producer_name: String,
    #[prost(string, tag = "3")]
    producer_version: String,
    #[prost(message, optional, tag = "7")]
    graph: Option<GraphProto>,
    #[prost(message, repeated, tag = "8")]
    opset_import: Vec<OperatorSetId>,
}

#[derive(Clone, PartialEq, Message)]
struct OperatorSetId {
    #[prost(string, tag = "1")]
    domain: String,
    #[prost(int64, tag = "2")]
    version: i64,
}

#[derive(Clone, PartialEq, Message)]
struct GraphProto {
    #[prost(message, repeated, tag = "1")]
    node: Vec<NodeProto>,
    #[prost(string, tag = "2")]
    name: String,
    #[prost(message, repeated, tag = "5")]
    initializer: Vec<TensorProto>,
    #[prost(string, tag = "10")]
    doc_string: String,
    #[prost(message, repeated, tag = "11")]
    input: Vec<ValueInfo>,
    #[prost(message, repeated, tag = "12")]
    output: Vec<ValueInfo>,
}

#[derive(Clone, PartialEq, Message)]
struct NodeProto {
    #[prost(string, repeated, tag = "1")]
    input: Vec<String>,
    #[prost(string, repeated, tag = "2")]
    output: Vec<String>,
    #[prost(string, tag = "3")]
    name: String,
    #[prost(string, tag = "4")]
    op_type: String,
    #[prost(message, repeated, tag = "5")]
    attribute: Vec<AttributeProto>,
}

#[derive(Clone, PartialEq, Message)]
struct AttributeProto {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(int64, tag = "3")]
    i: i64,
    #[prost(int32, tag = "20")]
    kind: i32,
}

#[derive(Clone, PartialEq, Message)]
struct TensorProto {
    #[prost(int64, repeated, tag = "1")]
    dims: Vec<i64>,
    #[prost(int32, tag = "2")]
    data_type: i32,
    #[prost(string, tag = "8")]
    name: String,
    #[prost(bytes = "vec", tag = "9")]
    raw_data: Vec<u8>,
}

#[derive(Clone, PartialEq, Message)]
struct ValueInfo {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(message, optional, tag = "2")]
    kind: Option<TypeProto>,
    #[prost(string, tag = "3")]
    doc_string: String,
}

#[derive(Clone, PartialEq, Message)]
struct TypeProto {
    #[prost(message, optional, tag = "1")]
    tensor_type: Option<TensorType>,
}

#[derive(Clone, PartialEq, Message)]
struct TensorType {
    #[prost(int32, tag = "1")]
    elem_type: i32,
    #[prost(message, optional, tag = "2")]
    shape: Option<TensorShape>,
}

#[derive(Clone, PartialEq, Message)]
struct TensorShape {
    #[prost(message, repeated, tag = "1")]
    dim: Vec<Dimension>,
}

#[derive(Clone, PartialEq, Message)]
struct Dimension {
    #[prost(oneof = "dimension::Value", tags = "1, 2")]
    value: Option<dimension::Value>,
}

mod dimension {
    #[derive(Clone, PartialEq, prost::Oneof)]
    pub(super) enum Value {
        #[prost(int64, tag = "1")]
        DimValue(i64),
        #[prost(string, tag = "2")]
        DimParam(String),
    }
}

/// Content of `model.onnx`.
#[must_use]
pub fn to_onnx(config: &ModelConfig, weights: &Weights) -> Vec<u8> {
    let mut graph = Graph::default();
    let window_values = config.window_steps * config.inputs.len();
    let flat = graph.scale_inputs(config, window_values);
    let mut x = graph.cast(&flat, FLOAT);
    let window = x.clone();
    // The skip computes in f64 with what the network sees, as in training.
    let rounded = graph.cast(&x, DOUBLE);
    for (layer, map) in config.layers.iter().zip(&weights.layers) {
        x = graph.gemm(&layer.name, &x, map);
        for &activation in &layer.activations {
            x = graph.activation(&x, activation);
        }
    }
    x = graph.cast(&x, DOUBLE);
    let (steps, targets) = (config.output_steps, config.targets.len());
    if let Some(skip) = &weights.skip {
        let (linear, gain) = graph.skip_of_steps(config, weights, skip, &rounded);
        x = if config.layers.is_empty() {
            linear
        } else {
            let x = gain.map_or(x.clone(), |gain| graph.node("Mul", &[&x, &gain], Vec::new()));
            graph.node("Add", &[&x, &linear], Vec::new())
        };
    }
    let all = x.clone();
    if steps > 1 {
        x = graph.columns("last_step", &x, (steps - 1) * targets, targets);
    }
    if let Some((guard, guide)) = config.guard.as_ref().zip(weights.guard.as_ref()) {
        x = graph.limit(guard, guide, &config.targets, &window, &x);
    }
    let names = |channels: &[ScaledChannel]| {
        channels
            .iter()
            .map(|c| c.name.as_str())
            .collect::<Vec<_>>()
            .join(", ")
    };
    graph.unscale_outputs(&config.targets, &x);
    let mut output = vec![value_info("estimates", &names(&config.targets), &[targets])];
    if steps > 1 {
        graph.all_steps(config, &all);
        output.push(value_info(
            "all_steps",
            &format!(
                "the last {steps} samples of the window, oldest first: {}",
                names(&config.targets)
            ),
            &[steps, targets],
        ));
    }
    let proto = ModelProto {
        ir_version: IR_VERSION,
        producer_name: "hydroflex".to_owned(),
        producer_version: config.provenance.hydroflex_version.clone(),
        opset_import: vec![OperatorSetId {
            domain: String::new(),
            version: OPSET_VERSION,
        }],
        graph: Some(GraphProto {
            node: graph.nodes,
            name: "slide".to_owned(),
            initializer: graph.initializers,
            doc_string: format!(
                "SLIDE network: window of {} samples, oldest first; {} s between samples",
                config.window_steps, config.sample_time_s
            ),
            input: vec![value_info(
                "window",
                &names(&config.inputs),
                &[config.window_steps, config.inputs.len()],
            )],
            output,
        }),
    };
    proto.encode_to_vec()
}

/// Nodes and constants so far; values are named by the order of their making.
#[derive(Default)]
struct Graph {
    nodes: Vec<NodeProto>,
    initializers: Vec<TensorProto>,
}

/// A linear map whose coefficients follow slow signals.
#[derive(Clone, Copy)]
struct Terms<'a> {
    name: &'a str,
    map: &'a SkipWeights,
    schedule: Option<&'a Schedule>,
    /// The estimate that they follow too, within ±1.
    estimate: Option<&'a str>,
    targets: usize,
}

impl Graph {
    fn node(&mut self, op_type: &str, inputs: &[&str], attribute: Vec<AttributeProto>) -> String {
        let output = format!("v{}", self.nodes.len());
        self.named_node(op_type, inputs, attribute, output)
    }

    fn named_node(
        &mut self,
        op_type: &str,
        inputs: &[&str],
        attribute: Vec<AttributeProto>,
        output: String,
    ) -> String {
        self.nodes.push(NodeProto {
            input: inputs.iter().map(|&i| i.to_owned()).collect(),
            output: vec![output.clone()],
            name: format!("{}_{}", op_type.to_lowercase(), self.nodes.len()),
            op_type: op_type.to_owned(),
            attribute,
        });
        output
    }

    /// A constant is made once; another one has another name.
    fn constant(&mut self, name: &str, data_type: i32, dims: &[usize], raw_data: Vec<u8>) -> String {
        if self.initializers.iter().any(|tensor| tensor.name == name) {
            return name.to_owned();
        }
        let dims = dims.iter().map(|&d| to_i64(d)).collect();
        self.initializers.push(TensorProto {
            dims,
            data_type,
            name: name.to_owned(),
            raw_data,
        });
        name.to_owned()
    }

    fn doubles(&mut self, name: &str, values: impl Iterator<Item = f64>) -> String {
        let raw: Vec<u8> = values.flat_map(f64::to_le_bytes).collect();
        self.constant(name, DOUBLE, &[raw.len() / 8], raw)
    }

    fn scale_inputs(&mut self, config: &ModelConfig, window_values: usize) -> String {
        let channels = &config.inputs;
        let offset = self.doubles("input_offset", channels.iter().map(|c| c.offset));
        let scale = self.doubles("input_scale", channels.iter().map(|c| c.scale));
        let flat = [-1, to_i64(window_values)]
            .iter()
            .flat_map(|d: &i64| d.to_le_bytes())
            .collect();
        let shape = self.constant("window_shape", INT64, &[2], flat);
        let mut window = "window".to_owned();
        if !config.input_limits.is_empty() {
            let low = self.doubles("input_low", config.input_limits.iter().map(|l| l[0]));
            let high = self.doubles("input_high", config.input_limits.iter().map(|l| l[1]));
            let above = self.node("Max", &[&window, &low], Vec::new());
            window = self.node("Min", &[&above, &high], Vec::new());
        }
        let centred = self.node("Sub", &[&window, &offset], Vec::new());
        let scaled = self.node("Div", &[&centred, &scale], Vec::new());
        self.node("Reshape", &[&scaled, &shape], Vec::new())
    }

    /// Every estimated sample, held within the range of its target.
    fn all_steps(&mut self, config: &ModelConfig, x: &str) {
        let shape = [-1, to_i64(config.output_steps), to_i64(config.targets.len())]
            .iter()
            .flat_map(|d: &i64| d.to_le_bytes())
            .collect();
        let shape = self.constant("all_steps_shape", INT64, &[3], shape);
        let mut x = self.node("Reshape", &[x, &shape], Vec::new());
        let targets = &config.targets;
        let scale = self.doubles("all_steps_scale", targets.iter().map(|c| c.scale));
        let offset = self.doubles("all_steps_offset", targets.iter().map(|c| c.offset));
        x = self.node("Mul", &[&x, &scale], Vec::new());
        x = self.node("Add", &[&x, &offset], Vec::new());
        if let Some(guard) = &config.guard {
            let low = self.doubles("all_steps_low", guard.min.iter().copied());
            let high = self.doubles("all_steps_high", guard.max.iter().copied());
            x = self.node("Max", &[&x, &low], Vec::new());
            x = self.node("Min", &[&x, &high], Vec::new());
        }
        self.named_node("Identity", &[&x], Vec::new(), "all_steps".to_owned());
    }

    fn cast(&mut self, x: &str, data_type: i32) -> String {
        self.node("Cast", &[x], vec![integer("to", i64::from(data_type))])
    }

    /// Columns `first .. first + count` of a matrix.
    fn columns(&mut self, name: &str, x: &str, first: usize, count: usize) -> String {
        let raw = (first..first + count)
            .flat_map(|i| to_i64(i).to_le_bytes())
            .collect();
        let indices = self.constant(name, INT64, &[count], raw);
        self.node("Gather", &[x, &indices], vec![integer("axis", 1)])
    }

    /// The linear map of the samples up to each one that is estimated, step by step, and what the network is multiplied by, if anything.
    fn skip_of_steps(
        &mut self,
        config: &ModelConfig,
        weights: &Weights,
        map: &SkipWeights,
        flat: &str,
    ) -> (String, Option<String>) {
        let (steps, channels) = (config.output_steps, config.inputs.len());
        let values = config.skip_steps() * channels;
        if steps == 1 {
            return self.skip(config, weights, map, flat, values);
        }
        let raw = |values: &mut dyn Iterator<Item = i64>| values.flat_map(i64::to_le_bytes).collect();
        let mut places = (0..steps).flat_map(|step| (step * channels..step * channels + values).map(to_i64));
        let places = self.constant("skip_windows", INT64, &[steps, values], raw(&mut places));
        let windows = self.node("Gather", &[flat, &places], vec![integer("axis", 1)]);
        let row = raw(&mut [-1, to_i64(values)].into_iter());
        let row = self.constant("skip_window_shape", INT64, &[2], row);
        let windows = self.node("Reshape", &[&windows, &row], Vec::new());
        let (estimates, gain) = self.skip(config, weights, map, &windows, values);
        let all = raw(&mut [-1, to_i64(steps * config.targets.len())].into_iter());
        let all = self.constant("skip_steps_shape", INT64, &[2], all);
        let mut of_steps = |rows: &str| self.node("Reshape", &[rows, &all], Vec::new());
        (of_steps(&estimates), gain.map(|gain| of_steps(&gain)))
    }

    /// The linear map in f64, with the payload that it follows, and what the network is multiplied by, if anything.
    fn skip(
        &mut self,
        config: &ModelConfig,
        weights: &Weights,
        map: &SkipWeights,
        flat: &str,
        window_values: usize,
    ) -> (String, Option<String>) {
        let targets = config.targets.len();
        let terms = |graph: &mut Self, name: &str, map, schedule, estimate: Option<&str>, targets| {
            let terms = Terms {
                name,
                map,
                schedule,
                estimate,
                targets,
            };
            graph.terms(config, &terms, flat, window_values)
        };
        let Some(payload) = &config.payload else {
            let linear = terms(self, "skip", map, config.schedule.as_ref(), None, targets);
            return (linear, None);
        };
        let mut estimate: Option<String> = None;
        let mut followed: Option<String> = None;
        for (k, (schedule, map)) in payload.estimates.iter().zip(&weights.payload).enumerate() {
            let name = format!("payload.{k}");
            let next = terms(self, &name, map, Some(schedule), followed.as_deref(), 1);
            followed = Some(self.within_one(&next));
            estimate = Some(next);
        }
        let loaded = terms(
            self,
            "skip",
            map,
            config.schedule.as_ref(),
            followed.as_deref(),
            targets,
        );
        match (&payload.empty, &weights.empty, estimate) {
            (Some(empty), Some(map), Some(estimate)) => {
                let empty_map = terms(self, "empty", map, Some(&empty.schedule), None, targets);
                let below = (empty.below_kg - payload.centre_kg) / payload.half_range_kg;
                let below = self.doubles("empty_below", std::iter::once(below));
                let is_empty = self.node("Less", &[&estimate, &below], Vec::new());
                let linear = self.node("Where", &[&is_empty, &empty_map, &loaded], Vec::new());
                let gain = (!empty.network_gain.is_empty()).then(|| {
                    let gain = self.doubles("empty_gain", empty.network_gain.iter().copied());
                    let one = self.doubles("one", std::iter::once(1.0));
                    self.node("Where", &[&is_empty, &gain, &one], Vec::new())
                });
                (linear, gain)
            }
            _ => (loaded, None),
        }
    }

    /// `Σ_t m_t (W_t x + b_t)` in f64.
    fn terms(&mut self, config: &ModelConfig, terms: &Terms<'_>, flat: &str, window_values: usize) -> String {
        let Terms {
            name,
            map,
            schedule,
            estimate,
            targets,
        } = *terms;
        let outputs = map.bias.len();
        let raw = |values: &[f64]| values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let dims = [outputs, map.weight.len() / outputs.max(1)];
        let weight = self.constant(&format!("{name}.weight"), DOUBLE, &dims, raw(&map.weight));
        let bias = self.constant(&format!("{name}.bias"), DOUBLE, &[outputs], raw(&map.bias));
        let all = self.node("Gemm", &[flat, &weight, &bias], vec![integer("transB", 1)]);
        let Some(schedule) = schedule else {
            return all;
        };
        let mut slow = self.slow_signals(config, name, schedule, flat, window_values);
        slow.extend(estimate.map(str::to_owned));
        let mut sum: Option<String> = None;
        for (term, exponents) in schedule.exponents.iter().enumerate() {
            let mut part = self.columns(&format!("{name}.term_{term}"), &all, term * targets, targets);
            for (signal, &exponent) in slow.iter().zip(exponents) {
                for _ in 0..exponent {
                    part = self.node("Mul", &[&part, signal], Vec::new());
                }
            }
            sum = Some(match sum {
                Some(sum) => self.node("Add", &[&sum, &part], Vec::new()),
                None => part,
            });
        }
        sum.unwrap_or(all)
    }

    /// u of each slow signal: `[batch, 1]`, f64.
    fn slow_signals(
        &mut self,
        config: &ModelConfig,
        name: &str,
        schedule: &Schedule,
        flat: &str,
        window_values: usize,
    ) -> Vec<String> {
        schedule
            .inputs
            .iter()
            .zip(schedule.centre.iter().zip(&schedule.half_range))
            .map(|(&input, (centre, half_range))| {
                let channel = &config.inputs[input];
                let last = window_values - config.inputs.len() + input;
                let scaled = self.columns(&format!("{name}.slow_{input}"), flat, last, 1);
                // (scale · scaled + offset − centre) / half_range
                let gain = channel.scale / half_range;
                let shift = (channel.offset - centre) / half_range;
                let gain = self.doubles(&format!("{name}.slow_{input}_gain"), std::iter::once(gain));
                let shift = self.doubles(&format!("{name}.slow_{input}_shift"), std::iter::once(shift));
                let grown = self.node("Mul", &[&scaled, &gain], Vec::new());
                let moved = self.node("Add", &[&grown, &shift], Vec::new());
                self.within_one(&moved)
            })
            .collect()
    }

    /// `clamp(x, −1, 1)`, f64.
    fn within_one(&mut self, x: &str) -> String {
        let minus_one = self.doubles("minus_one", std::iter::once(-1.0));
        let one = self.doubles("one", std::iter::once(1.0));
        let above = self.node("Max", &[x, &minus_one], Vec::new());
        self.node("Min", &[&above, &one], Vec::new())
    }

    /// Scaled estimates within the guard's bounds.
    fn limit(
        &mut self,
        guard: &Guard,
        guide: &LinearWeights,
        targets: &[ScaledChannel],
        window: &str,
        x: &str,
    ) -> String {
        let guide = self.gemm("guard", window, guide);
        let guide = self.cast(&guide, DOUBLE);
        let scaled = |values: &[f64]| -> Vec<f64> {
            let value = |(v, c): (&f64, &ScaledChannel)| (v - c.offset) / c.scale;
            values.iter().zip(targets).map(value).collect()
        };
        let slack = guard.slack.iter().zip(targets).map(|(s, c)| s / c.scale);
        let slack = self.doubles("guard_slack", slack);
        let low = self.node("Sub", &[&guide, &slack], Vec::new());
        let high = self.node("Add", &[&guide, &slack], Vec::new());
        let min = self.doubles("guard_min", scaled(&guard.min).into_iter());
        let max = self.doubles("guard_max", scaled(&guard.max).into_iter());
        let above = self.node("Max", &[x, &low], Vec::new());
        let near = self.node("Min", &[&above, &high], Vec::new());
        let above = self.node("Max", &[&near, &min], Vec::new());
        self.node("Min", &[&above, &max], Vec::new())
    }

    fn unscale_outputs(&mut self, channels: &[ScaledChannel], x: &str) {
        let offset = self.doubles("target_offset", channels.iter().map(|c| c.offset));
        let scale = self.doubles("target_scale", channels.iter().map(|c| c.scale));
        let scaled = self.node("Mul", &[x, &scale], Vec::new());
        self.named_node("Add", &[&scaled, &offset], Vec::new(), "estimates".to_owned());
    }

    fn gemm(&mut self, name: &str, x: &str, map: &LinearWeights) -> String {
        let outputs = map.bias.len();
        let raw = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let dims = [outputs, map.weight.len() / outputs.max(1)];
        let weight = self.constant(&format!("{name}.weight"), FLOAT, &dims, raw(&map.weight));
        let bias = self.constant(&format!("{name}.bias"), FLOAT, &[outputs], raw(&map.bias));
        self.node("Gemm", &[x, &weight, &bias], vec![integer("transB", 1)])
    }

    fn activation(&mut self, x: &str, activation: Activation) -> String {
        match activation {
            Activation::Tanh => self.node("Tanh", &[x], Vec::new()),
            Activation::Sigmoid => self.node("Sigmoid", &[x], Vec::new()),
            Activation::Relu => self.node("Relu", &[x], Vec::new()),
            Activation::Elu => self.node("Elu", &[x], Vec::new()),
            Activation::Silu => {
                let gate = self.node("Sigmoid", &[x], Vec::new());
                self.node("Mul", &[x, &gate], Vec::new())
            }
        }
    }
}

fn integer(name: &str, i: i64) -> AttributeProto {
    AttributeProto {
        name: name.to_owned(),
        i,
        kind: ATTRIBUTE_INT,
    }
}

fn to_i64(value: usize) -> i64 {
    i64::try_from(value).unwrap_or(i64::MAX)
}

/// A tensor of doubles whose first dimension is the batch.
fn value_info(name: &str, doc_string: &str, dims: &[usize]) -> ValueInfo {
    let batch = Dimension {
        value: Some(dimension::Value::DimParam("batch".to_owned())),
    };
    let fixed = dims.iter().map(|&d| Dimension {
        value: Some(dimension::Value::DimValue(to_i64(d))),
    });
    let shape = TensorShape {
        dim: std::iter::once(batch).chain(fixed).collect(),
    };
    let tensor_type = TensorType {
        elem_type: DOUBLE,
        shape: Some(shape),
    };
    ValueInfo {
        name: name.to_owned(),
        kind: Some(TypeProto {
            tensor_type: Some(tensor_type),
        }),
        doc_string: doc_string.to_owned(),
    }
}
