//! Against burn's autodiff, finite differences, and itself on other numbers of threads.

use super::network::First;
use super::*;
use crate::least_squares::TargetRows;
use crate::network::init::initial_parameters;
use crate::network::{NetworkTensors, batch_tensor};
use crate::structure::{Form, Structure};
use crate::window::{Series, Windows};
use burn::tensor::{Device, Tensor};
use hydroflex_openapi::job::WindowCut;

const STEPS: usize = 7;
const WIDTH: usize = 3;
const VALUES: usize = STEPS * WIDTH;
const TARGETS: usize = 2;

/// Numbers between -1 and 1.
pub(super) fn values(count: usize, seed: u32) -> Vec<f32> {
    let mut state = seed;
    (0..count)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / 8_388_608.0 - 1.0
        })
        .collect()
}

/// Four runs of 150 random rows.
fn part() -> Part {
    let run_rows: Vec<usize> = (0..=4).map(|run| 150 * run).collect();
    Part {
        series: Series {
            width: WIDTH,
            values: values(600 * WIDTH, 1),
            run_rows: run_rows.clone(),
        },
        windows: Windows::new(&run_rows, STEPS, WindowCut::Overlapping),
        wanted: values(600 * TARGETS, 2),
        targets: TargetRows {
            width: TARGETS,
            values: vec![0.0; 600 * TARGETS],
        },
    }
}

fn whitening(components: usize) -> Whitening {
    Whitening {
        projection: values(components * VALUES, 3),
        offset: values(components, 4),
    }
}

fn layers(name: &str, inputs: usize) -> Vec<DenseLayer> {
    Structure::parse(name, 20, (name == "best").then_some(40))
        .unwrap()
        .layers(inputs, TARGETS)
}

/// Mean loss and gradient of `batch` by burn's autodiff, with `parameters` and whitening applied window by window.
fn by_burn(
    part: &Part,
    layers: &[DenseLayer],
    whitening: &Whitening,
    parameters: &[f32],
    batch: &[u32],
    loss: Loss,
) -> (f32, Vec<f32>) {
    let device = Device::flex().autodiff();
    let (mut inputs, mut wanted) = (Vec::new(), Vec::new());
    for &window in batch {
        let first = part.windows.first_row(window as usize);
        let window = part.series.window(first, STEPS);
        if whitening.components() == 0 {
            inputs.extend_from_slice(window);
        }
        for (row, o) in whitening.projection.chunks(VALUES).zip(&whitening.offset) {
            let product = row.iter().zip(window).map(|(p, x)| f64::from(p * x)).sum::<f64>();
            inputs.push(product as f32 + o);
        }
        let row = first + STEPS - 1;
        wanted.extend_from_slice(&part.wanted[row * TARGETS..(row + 1) * TARGETS]);
    }
    let mut gradient = vec![0.0; parameters.len()];
    let inputs: Tensor<2> = batch_tensor(inputs, batch.len(), &device);
    let value = NetworkTensors::new(Form::Dense, layers, parameters, &device).loss_and_gradient(
        inputs,
        batch_tensor(wanted, batch.len(), &device),
        loss,
        (batch.len() * TARGETS) as f32,
        &mut gradient,
    );
    (value, gradient)
}

/// Slope of the loss along its gradient, as a difference that f32 resolves, divided by what it has to be: the gradient's
/// square.
fn relative_slope(parameters: &[f32], gradient: &[f32], mut loss_at: impl FnMut(&[f32]) -> f64) -> f64 {
    let square: f64 = gradient.iter().map(|&g| f64::from(g) * f64::from(g)).sum();
    let h = 1e-3 / square.sqrt();
    let mut moved = |sign: f64| {
        let pairs = parameters.iter().zip(gradient);
        let there: Vec<f32> = pairs
            .map(|(&p, &g)| (f64::from(p) + sign * h * f64::from(g)) as f32)
            .collect();
        loss_at(&there)
    };
    (moved(1.0) - moved(-1.0)) / (2.0 * h) / square
}

#[test]
fn loss_and_gradient_are_those_of_autodiff() {
    let part = part();
    let first_rows = first_rows(&part);
    let samples = Samples {
        part: &part,
        first_rows: &first_rows,
    };
    // A batch of one block, of several that are cut, and of an odd number.
    for count in [5_u32, 300, 391] {
        let batch: Vec<u32> = (0..count).map(|i| (i * 37) % 576).collect();
        // No whitening; components few enough to be applied first, and to be folded.
        for components in [0, 4, 21] {
            let whitening = if components == 0 {
                Whitening::default()
            } else {
                whitening(components)
            };
            for name in ["L", "RLR", "ELE", "TLSLT", "TLSLTLSLT", "TS", "best"] {
                let inputs = if components == 0 { VALUES } else { components };
                let layers = layers(name, inputs);
                let parameters = initial_parameters(&layers, 5, 1.0);
                let loss = if name == "best" {
                    Loss::PseudoHuber
                } else {
                    Loss::Square
                };
                let (exact, wanted) = by_burn(&part, &layers, &whitening, &parameters, &batch, loss);
                for level in [level(), Level::Portable] {
                    let mut step = Step::at(level, &layers, &whitening, VALUES, batch.len(), loss);
                    let mut gradient = vec![f32::NAN; parameters.len()];
                    for _ in 0..2 {
                        let value = step.gradient(samples, &parameters, &batch, &mut gradient);
                        let case = format!("{name}, {count} windows, {components} components, {level:?}");
                        assert!(
                            (value - f64::from(exact)).abs() < 2e-6 * value,
                            "{case}: {value} {exact}"
                        );
                        for (i, (found, wanted)) in gradient.iter().zip(&wanted).enumerate() {
                            // f32 sums of values of size ten at most.
                            assert!(
                                (found - wanted).abs() < 1e-5,
                                "{case}, parameter {i}: {found} {wanted}"
                            );
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn both_forms_of_the_first_layer_are_tried() {
    let form = |components: usize, batch: usize| {
        let layers = layers("RLR", components);
        let step = Step::new(&layers, &whitening(components), VALUES, batch, Loss::Square);
        matches!(step.network.first, First::Folded { .. })
    };
    assert!(form(21, 391) && !form(4, 391) && !form(21, 5));
}

#[test]
fn the_gradient_is_the_slope_of_the_loss() {
    let part = part();
    let first_rows = first_rows(&part);
    let samples = Samples {
        part: &part,
        first_rows: &first_rows,
    };
    let batch: Vec<u32> = (0..576).collect();
    for name in ["L", "TLSLT", "ELE", "best"] {
        let whitening = whitening(21);
        let layers = layers(name, 21);
        let parameters = initial_parameters(&layers, 6, 1.0);
        let mut step = Step::new(&layers, &whitening, VALUES, batch.len(), Loss::PseudoHuber);
        let mut gradient = vec![0.0; parameters.len()];
        let loss = step.gradient(samples, &parameters, &batch, &mut gradient);
        let again = step.loss(samples, &parameters);
        assert!((loss - again).abs() < 1e-9, "{name}: {loss} {again}");
        let slope = relative_slope(&parameters, &gradient, |there| step.loss(samples, there));
        assert!((slope - 1.0).abs() < 2e-3, "{name}: {slope}");
    }
}

#[test]
fn several_steps_are_the_last_rows_of_the_window() {
    let part = part();
    let first_rows = first_rows(&part);
    let samples = Samples {
        part: &part,
        first_rows: &first_rows,
    };
    let batch: Vec<u32> = (0..300).map(|i| (i * 37) % 576).collect();
    let layers = Structure::parse("TLT", 20, None)
        .unwrap()
        .layers(VALUES, 3 * TARGETS);
    let parameters = initial_parameters(&layers, 5, 1.0);
    let mut step = Step::new(&layers, &Whitening::default(), VALUES, batch.len(), Loss::Square);
    let mut gradient = vec![0.0; parameters.len()];
    let loss = step.gradient(samples, &parameters, &batch, &mut gradient);
    // The bias of the last layer: its gradient is the mean error of each output, which autodiff gives for one
    // sample at a time with the rows of that sample alone.
    let last = layers.last().unwrap();
    let (inputs, size) = (last.inputs, last.inputs * last.outputs + last.outputs);
    let head = parameters.len() - size;
    let mut sum = 0.0;
    for s in 0..3 {
        let mut single = layers.clone();
        single.last_mut().unwrap().outputs = TARGETS;
        let rows = |from: usize, width: usize| {
            let first = head + from + s * TARGETS * width;
            parameters[first..first + TARGETS * width].to_vec()
        };
        let mut own = parameters[..head].to_vec();
        own.extend(rows(0, inputs));
        own.extend(rows(inputs * last.outputs, 1));
        let mut shifted = part.clone();
        shifted.wanted.rotate_right((2 - s) * TARGETS);
        let (value, exact) = by_burn(
            &shifted,
            &single,
            &Whitening::default(),
            &own,
            &batch,
            Loss::Square,
        );
        sum += f64::from(value) / 3.0;
        let bias = &gradient[head + inputs * last.outputs + s * TARGETS..][..TARGETS];
        for (found, wanted) in bias.iter().zip(&exact[exact.len() - TARGETS..]) {
            assert!((3.0 * found - wanted).abs() < 1e-5, "{found} {wanted}");
        }
    }
    assert!((loss - sum).abs() < 1e-5 * sum, "{loss} {sum}");
}

#[test]
fn dropout_s_gradient_is_the_slope_of_its_loss_and_it_is_off_when_judged() {
    let part = part();
    let first_rows = first_rows(&part);
    let samples = Samples {
        part: &part,
        first_rows: &first_rows,
    };
    let batch: Vec<u32> = (0..576).collect();
    for name in ["TDLTD", "RDLR", "EDLTSD", "DLD"] {
        let structure = Structure::parse(name, 20, None).unwrap();
        let layers = structure.layers(21, TARGETS);
        let whitening = whitening(21);
        let parameters = initial_parameters(&layers, 6, 1.0);
        let new = || Step::new(&layers, &whitening, VALUES, batch.len(), Loss::PseudoHuber);
        let mut step = new().with_dropout(&structure.dropouts());
        let mut gradient = vec![0.0; parameters.len()];
        let whole = step.gradient(samples, &parameters, &batch, &mut gradient);
        assert!((whole - step.loss(samples, &parameters)).abs() < 1e-9, "{name}");
        step.leave_out(0.3, 17);
        let masked = step.gradient(samples, &parameters, &batch, &mut gradient);
        assert!((masked - whole).abs() > 1e-4, "{name}: nothing was left out");
        assert!((whole - step.loss(samples, &parameters)).abs() < 1e-9, "{name}");
        let mut unused = vec![0.0; parameters.len()];
        let slope = relative_slope(&parameters, &gradient, |there| {
            step.gradient(samples, there, &batch, &mut unused)
        });
        // A ReLU's kinks are crossed.
        let tolerance = if name.contains('R') { 2e-2 } else { 2e-3 };
        assert!((slope - 1.0).abs() < tolerance, "{name}: {slope}");
    }
}

#[test]
fn dropout_leaves_out_its_part_and_keeps_the_mean() {
    let mut row = vec![1.0_f32; 20_000];
    let mask = Mask { seed: 3, rate: 0.1 };
    mask.apply(2, 700, &mut row);
    let dropped = row.iter().filter(|&&v| v < 0.5).count();
    assert!((1800..2200).contains(&dropped), "{dropped}");
    let mut again = vec![1.0_f32; 20_000];
    mask.apply(2, 700, &mut again);
    assert_eq!(row, again);
    mask.apply(3, 700, &mut again);
    assert_ne!(row, again);
}

#[test]
fn threads_do_not_change_a_bit() {
    let part = part();
    let first_rows = first_rows(&part);
    let batch: Vec<u32> = (0..576).rev().collect();
    let bits = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| {
            let samples = Samples {
                part: &part,
                first_rows: &first_rows,
            };
            let layers = layers("TLSLT", 21);
            let parameters = initial_parameters(&layers, 7, 1.0);
            let mut step = Step::new(&layers, &whitening(21), VALUES, batch.len(), Loss::Square);
            let mut gradient = vec![0.0; parameters.len()];
            let loss = step.gradient(samples, &parameters, &batch, &mut gradient);
            let bits: Vec<u32> = gradient.iter().map(|g| g.to_bits()).collect();
            (loss.to_bits(), bits)
        })
    };
    let one = bits(1);
    assert_eq!(one, bits(2));
    assert_eq!(one, bits(5));
}
