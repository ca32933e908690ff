//! Structures by name: the paper's letters, and our own.

use hydroflex_openapi::model::{Activation, DenseLayer};

/// What is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct Structure {
    /// As asked for.
    pub name: String,
    /// Whether the least-squares map of the window (coefficients following the pose) is added, and
    /// the network learns the rest.
    pub linear_skip: bool,
    /// Widths of the hidden layers and what follows each of them.
    hidden: Vec<(usize, Vec<Activation>)>,
}

/// Widths of our own network's hidden layers; chosen by trial, see the model notes.
const BEST_WIDTHS: [usize; 3] = [256, 256, 128];

/// Why a structure was refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StructureError {
    /// Unknown letter.
    #[error(
        "structure {name:?}: letter {letter:?} is unknown; give \"best\", or letters of L (linear), T (tanh), \
         S (sigmoid), R (ReLU), E (ELU) such as L, TLT, TLTLT, TLSLT, TLSLTLSLT, ELE, RLR"
    )]
    UnknownLetter {
        /// Structure.
        name: String,
        /// Letter.
        letter: char,
    },
    /// No letter.
    #[error("the structure is empty; give \"best\", or letters such as RLR")]
    Empty,
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
        if name == "best" {
            let widest = width.unwrap_or(BEST_WIDTHS[0]);
            let hidden = BEST_WIDTHS
                .iter()
                .map(|&w| ((w * widest).div_ceil(BEST_WIDTHS[0]), vec![Activation::Silu]))
                .collect();
            return Ok(Self {
                name: name.to_owned(),
                linear_skip: true,
                hidden,
            });
        }
        let width = width.unwrap_or(window_steps);
        let mut hidden: Vec<(usize, Vec<Activation>)> = vec![(width, Vec::new())];
        for letter in name.chars() {
            let activation = match letter {
                'L' => {
                    hidden.push((width, Vec::new()));
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
            if let Some((_, activations)) = hidden.last_mut() {
                activations.push(activation);
            }
        }
        Ok(Self {
            name: name.to_owned(),
            linear_skip: false,
            hidden,
        })
    }

    /// Layers for a number of window values and targets. Names count linear maps and activations
    /// alike, as in a PyTorch `Sequential`.
    #[must_use]
    pub fn layers(&self, inputs: usize, targets: usize) -> Vec<DenseLayer> {
        let mut layers = Vec::with_capacity(self.hidden.len() + 1);
        let mut position = 0;
        let mut width = inputs;
        for (outputs, activations) in &self.hidden {
            layers.push(DenseLayer {
                name: format!("net.{position}"),
                inputs: width,
                outputs: *outputs,
                activations: activations.clone(),
            });
            position += 1 + activations.len();
            width = *outputs;
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
    fn an_unknown_letter_is_refused() {
        let error = Structure::parse("RXR", 60, None).unwrap_err();
        assert!(matches!(error, StructureError::UnknownLetter { letter: 'X', .. }));
    }
}
