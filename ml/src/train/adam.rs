//! Adam (Kingma and Ba 2015) on the flat parameter vector, one pass per step.
//!
//! ```text
//! m ← β₁ m + (1 − β₁) g,   v ← β₂ v + (1 − β₂) g²
//! p ← p − η m / (1 − β₁ᵗ) / (√(v / (1 − β₂ᵗ)) + ε)
//! ```

#![allow(
    clippy::inline_always,
    reason = "vector code has to be inlined into the function that enables the instructions"
)]

/// β₁, the usual value.
const BETA_1: f32 = 0.9;
/// β₂, the usual value.
const BETA_2: f32 = 0.999;
/// ε as in PyTorch.
const EPSILON: f32 = 1e-8;

/// Moments of the gradient.
#[derive(Debug, Clone, PartialEq)]
pub struct Adam {
    /// Mean of the gradient.
    pub first: Vec<f32>,
    /// Mean of its square.
    pub second: Vec<f32>,
    /// Steps done.
    pub steps: u64,
}

impl Adam {
    /// At rest, for `count` parameters.
    #[must_use]
    pub fn new(count: usize) -> Self {
        Self {
            first: vec![0.0; count],
            second: vec![0.0; count],
            steps: 0,
        }
    }

    /// One step with learning rate `rate`.
    ///
    /// # Panics
    /// When the lengths differ.
    pub fn step(&mut self, parameters: &mut [f32], gradient: &[f32], rate: f64) {
        assert_eq!(parameters.len(), self.first.len(), "one moment per parameter");
        assert_eq!(parameters.len(), gradient.len(), "one derivative per parameter");
        self.steps += 1;
        let t = i32::try_from(self.steps).unwrap_or(i32::MAX);
        let correction_1 = 1.0 - f64::from(BETA_1).powi(t);
        let correction_2 = 1.0 - f64::from(BETA_2).powi(t);
        #[allow(clippy::cast_possible_truncation, reason = "networks are f32")]
        let (rate, root) = ((rate / correction_1) as f32, correction_2.sqrt().recip() as f32);
        update(
            parameters,
            gradient,
            &mut self.first,
            &mut self.second,
            rate,
            root,
        );
    }
}

crate::network::elementwise::vectorised!(
    /// The equations above, element by element.
    update,
    update_generic,
    (parameters: &mut [f32], gradient: &[f32], first: &mut [f32], second: &mut [f32], rate: f32, root: f32)
);

#[inline(always)]
fn update_generic(
    parameters: &mut [f32],
    gradient: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    rate: f32,
    root: f32,
) {
    for (((p, g), m), v) in parameters.iter_mut().zip(gradient).zip(first).zip(second) {
        *m = BETA_1 * *m + (1.0 - BETA_1) * g;
        *v = BETA_2 * *v + (1.0 - BETA_2) * g * g;
        *p -= rate * *m / (v.sqrt() * root + EPSILON);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_step_has_the_size_of_the_learning_rate() {
        let mut adam = Adam::new(2);
        let mut p = [1.0, 1.0];
        adam.step(&mut p, &[0.5, -2e-3], 0.01);
        // m̂ / √v̂ = sign(g), but for ε.
        assert!((p[0] - 0.99).abs() < 1e-6 && (p[1] - 1.01).abs() < 1e-6, "{p:?}");
    }

    #[test]
    fn it_follows_the_equations_over_many_steps() {
        let mut adam = Adam::new(1);
        let mut p = [0.0];
        let (mut m, mut v, mut q) = (0.0_f64, 0.0_f64, 0.0_f64);
        for t in 1..=200 {
            let g = (f64::from(t) * 0.37).sin() + 0.2;
            adam.step(&mut p, &[g as f32], 1e-2);
            m = 0.9 * m + 0.1 * g;
            v = 0.999 * v + 0.001 * g * g;
            q -= 1e-2 * (m / (1.0 - 0.9_f64.powi(t))) / ((v / (1.0 - 0.999_f64.powi(t))).sqrt() + 1e-8);
        }
        // 200 f32 steps of 1e-2.
        assert!((f64::from(p[0]) - q).abs() < 1e-4, "{} {q}", p[0]);
    }
}
