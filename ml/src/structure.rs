//! Structures by name: the paper's letters, and our own.

use hydroflex_openapi::job::TrainingSpec;
use hydroflex_openapi::model::{Activation, DenseLayer};

/// What is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct Structure {
    /// As asked for.
    pub name: String,
    /// Whether the least-squares map of the window (coefficients following the pose) is added, and
    /// the network learns the rest.
    pub linear_skip: bool,
    /// How its layers are put together.
    pub form: Form,
    hidden: Vec<Hidden>,
}

/// A hidden layer and what follows it.
#[derive(Debug, Clone, PartialEq)]
struct Hidden {
    width: usize,
    activations: Vec<Activation>,
    /// Whether some of its values are left out at random, in training only.
    dropout: bool,
}

impl Hidden {
    fn new(width: usize, activations: Vec<Activation>) -> Self {
        Self {
            width,
            activations,
            dropout: false,
        }
    }
}

/// How layers are put together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// One after the other: what is exported and served.
    Dense,
    /// Elman's recurrent network over the samples of a window; for comparison.
    Rnn {
        /// Samples in a window.
        steps: usize,
    },
    /// Long short-term memory over the samples of a window; for comparison.
    Lstm {
        /// Samples in a window.
        steps: usize,
    },
    /// Two convolutions over time, each halving it, and a linear layer; for comparison.
    Cnn {
        /// Samples in a window.
        steps: usize,
    },
}

/// Samples that a convolution sees.
pub(crate) const KERNEL: usize = 5;
/// Hidden values of the recurrent networks, and channels of the second convolution.
const COMPARISON_WIDTH: usize = 64;

/// Widths of our own network's hidden layers; chosen by trial, see the model notes.
const BEST_WIDTHS: [usize; 3] = [256, 256, 128];

/// Why a structure was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StructureError {
    /// Unknown letter.
    #[error(
        "structure {name:?}: letter {letter:?} is unknown; give \"best\", or letters of L (linear), T (tanh), \
         S (sigmoid), R (ReLU), E (ELU), D (dropout) such as L, TLT, TLTLT, TLSLT, TLSLTLSLT, ELE, RLR, RDLR"
    )]
    UnknownLetter {
        /// Structure.
        name: String,
        /// Letter.
        letter: char,
    },
    /// Not to be exported.
    #[error(
        "structure {name:?} is there for comparison, in `hydroflex reproduce-paper --structures {name}`: it is neither \
         exported nor served; give \"best\", or letters such as RLR"
    )]
    Comparison {
        /// Structure.
        name: String,
    },
    /// Dropout in a place where it says nothing.
    #[error(
        "structure {name:?}: D (dropout) comes last before an L or the end, and once, as in RDLR or TLTD"
    )]
    MisplacedDropout {
        /// Structure.
        name: String,
    },
    /// No letter.
    #[error("the structure is empty; give \"best\", or letters such as RLR")]
    Empty,
    /// More than a hidden layer may have.
    #[error(
        "the width in windows comes to {width} values a layer, allowed is at most {}",
        TrainingSpec::WIDEST
    )]
    TooWide {
        /// Width.
        width: usize,
    },
    /// Width 0.
    #[error("the width of the hidden layers must be at least 1")]
    NoWidth,
}

impl Structure {
    /// Parses `best` or letters.
    ///
    /// Letters stand between an input layer (window values → width) and an output layer
    /// (width → targets), as in the published scripts: `RLR` with 300 inputs and width 60 is
    /// 300 → 60, ReLU, 60 → 60, ReLU, 60 → 1. The width is that of the window in steps, or given;
    /// for `best` a given width is that of its widest layers.
    ///
    /// # Errors
    /// An unknown letter, or a width of 0.
    pub fn parse(name: &str, window_steps: usize, width: Option<usize>) -> Result<Self, StructureError> {
        if name.is_empty() {
            return Err(StructureError::Empty);
        }
        if width == Some(0) {
            return Err(StructureError::NoWidth);
        }
        if Self::is_comparison(name) {
            return Err(StructureError::Comparison {
                name: name.to_owned(),
            });
        }
        if name == "best" {
            let widest = width.unwrap_or(BEST_WIDTHS[0]);
            let hidden = BEST_WIDTHS
                .iter()
                .map(|&w| Hidden::new((w * widest).div_ceil(BEST_WIDTHS[0]), vec![Activation::Silu]))
                .collect();
            return Ok(Self {
                name: name.to_owned(),
                linear_skip: true,
                form: Form::Dense,
                hidden,
            });
        }
        let width = width.unwrap_or(window_steps);
        let mut hidden = vec![Hidden::new(width, Vec::new())];
        for letter in name.chars() {
            if letter != 'L' && hidden.last().is_some_and(|layer| layer.dropout) {
                return Err(StructureError::MisplacedDropout {
                    name: name.to_owned(),
                });
            }
            let activation = match letter {
                'L' => {
                    hidden.push(Hidden::new(width, Vec::new()));
                    continue;
                }
                'D' => {
                    if let Some(layer) = hidden.last_mut() {
                        layer.dropout = true;
                    }
                    continue;
                }
                'T' => Activation::Tanh,
                'S' => Activation::Sigmoid,
                'R' => Activation::Relu,
                'E' => Activation::Elu,
                letter => {
                    return Err(StructureError::UnknownLetter {
                        name: name.to_owned(),
                        letter,
                    });
                }
            };
            if let Some(layer) = hidden.last_mut() {
                layer.activations.push(activation);
            }
        }
        Ok(Self {
            name: name.to_owned(),
            linear_skip: false,
            form: Form::Dense,
            hidden,
        })
    }

    /// Whether `name` is that of a network for comparison: RNN, LSTM or CNN.
    #[must_use]
    pub fn is_comparison(name: &str) -> bool {
        matches!(name, "RNN" | "LSTM" | "CNN")
    }

    /// As [`Self::parse`], networks for comparison included; their width is 64 unless given.
    ///
    /// # Errors
    /// As [`Self::parse`].
    pub fn parse_any(name: &str, steps: usize, width: Option<usize>) -> Result<Self, StructureError> {
        if width == Some(0) {
            return Err(StructureError::NoWidth);
        }
        let form = match name {
            "RNN" => Form::Rnn { steps },
            "LSTM" => Form::Lstm { steps },
            "CNN" => Form::Cnn { steps },
            _ => return Self::parse(name, steps, width),
        };
        Ok(Self {
            name: name.to_owned(),
            linear_skip: false,
            form,
            hidden: vec![Hidden::new(width.unwrap_or(COMPARISON_WIDTH), Vec::new())],
        })
    }

    /// The linear maps of a network for comparison, for `inputs` window values.
    fn comparison_layers(&self, inputs: usize, targets: usize) -> Vec<DenseLayer> {
        let width = self.hidden[0].width;
        let shapes = match self.form {
            Form::Dense => return Vec::new(),
            Form::Rnn { steps } => [(inputs / steps, width), (width, width), (width, targets)],
            // Gates stand side by side: in, forget, candidate, out.
            Form::Lstm { steps } => [(inputs / steps, 4 * width), (width, 4 * width), (width, targets)],
            Form::Cnn { steps } => {
                let (half, left) = (width.div_ceil(2), steps.div_ceil(2).div_ceil(2));
                [
                    (KERNEL * inputs / steps, half),
                    (KERNEL * half, width),
                    (width * left, targets),
                ]
            }
        };
        let named = shapes.into_iter().zip(["input", "hidden", "output"]);
        named
            .map(|((inputs, outputs), name)| DenseLayer {
                name: name.to_owned(),
                inputs,
                outputs,
                activations: Vec::new(),
            })
            .collect()
    }

    /// Whether values of each hidden layer are left out at random in training.
    #[must_use]
    pub fn dropouts(&self) -> Vec<bool> {
        self.hidden.iter().map(|layer| layer.dropout).collect()
    }

    /// Layers for a number of window values and outputs. Names count linear maps, activations and dropout
    /// alike, as in a PyTorch `Sequential`.
    #[must_use]
    pub fn layers(&self, inputs: usize, targets: usize) -> Vec<DenseLayer> {
        if self.form != Form::Dense {
            return self.comparison_layers(inputs, targets);
        }
        let mut layers = Vec::with_capacity(self.hidden.len() + 1);
        let mut position = 0;
        let mut width = inputs;
        for hidden in &self.hidden {
            layers.push(DenseLayer {
                name: format!("net.{position}"),
                inputs: width,
                outputs: hidden.width,
                activations: hidden.activations.clone(),
            });
            position += 1 + hidden.activations.len() + usize::from(hidden.dropout);
            width = hidden.width;
        }
        layers.push(DenseLayer {
            name: format!("net.{position}"),
            inputs: width,
            outputs: targets,
            activations: Vec::new(),
        });
        layers
    }
}

/// Weights and biases of `layers`.
#[must_use]
pub fn parameter_count(layers: &[DenseLayer]) -> usize {
    layers
        .iter()
        .map(|layer| layer.outputs * (layer.inputs + 1))
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shapes(name: &str) -> Vec<(usize, usize, usize)> {
        let layers = Structure::parse(name, 60, None).unwrap().layers(300, 1);
        layers
            .iter()
            .map(|l| (l.inputs, l.outputs, l.activations.len()))
            .collect()
    }

    #[test]
    fn letters_stand_between_an_input_and_an_output_layer() {
        assert_eq!(shapes("RLR"), [(300, 60, 1), (60, 60, 1), (60, 1, 0)]);
        assert_eq!(shapes("L"), [(300, 60, 0), (60, 60, 0), (60, 1, 0)]);
        assert_eq!(shapes("TLSLTLSLT").len(), 6);
    }

    #[test]
    fn tensor_names_are_those_of_a_torch_sequential() {
        let layers = Structure::parse("RLR", 60, None).unwrap().layers(300, 1);
        let names: Vec<&str> = layers.iter().map(|l| l.name.as_str()).collect();
        assert_eq!(names, ["net.0", "net.2", "net.4"]);
    }

    #[test]
    fn dropout_is_no_layer_and_counts_in_names() {
        let structure = Structure::parse("RDLR", 60, None).unwrap();
        assert_eq!(structure.dropouts(), [true, false]);
        let layers = structure.layers(300, 1);
        let names: Vec<&str> = layers.iter().map(|l| l.name.as_str()).collect();
        assert_eq!(names, ["net.0", "net.3", "net.5"]);
        assert_eq!(shapes("RDLR"), shapes("RLR"));
        for name in ["DRL", "RDDL", "RDTL"] {
            let error = Structure::parse(name, 60, None).unwrap_err();
            assert!(matches!(error, StructureError::MisplacedDropout { .. }), "{name}");
        }
    }

    #[test]
    fn an_unknown_letter_is_refused() {
        let error = Structure::parse("RXR", 60, None).unwrap_err();
        assert!(matches!(error, StructureError::UnknownLetter { letter: 'X', .. }));
    }
}
