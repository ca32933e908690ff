//! What moves.

/// State of a system at an instant.
///
/// Coordinates are body by body `[r (3), θ (4), η]`, the payload's position last.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct State {
    /// Coordinates.
    pub q: Vec<f64>,
    /// Velocities q̇.
    pub v: Vec<f64>,
    /// Accelerations q̈.
    pub a: Vec<f64>,
    /// Algorithmic accelerations of the generalised-α scheme.
    pub algorithmic: Vec<f64>,
    /// Multipliers of the joint rows, N or N m.
    pub multipliers: Vec<f64>,
    /// Chamber pressures of every cylinder, piston and rod side, Pa.
    pub pressures_pa: Vec<[f64; 2]>,
    /// Their rates, Pa/s.
    pub pressure_rates_pa_per_s: Vec<[f64; 2]>,
}

impl State {
    /// Copies without allocating; both states belong to one system.
    pub fn copy_from(&mut self, other: &Self) {
        self.q.copy_from_slice(&other.q);
        self.v.copy_from_slice(&other.v);
        self.a.copy_from_slice(&other.a);
        self.algorithmic.copy_from_slice(&other.algorithmic);
        self.multipliers.copy_from_slice(&other.multipliers);
        self.pressures_pa.copy_from_slice(&other.pressures_pa);
        self.pressure_rates_pa_per_s
            .copy_from_slice(&other.pressure_rates_pa_per_s);
    }

    /// First quantity that is not a finite number.
    #[must_use]
    pub fn non_finite(&self) -> Option<&'static str> {
        let finite = |values: &[f64]| values.iter().all(|x| x.is_finite());
        if !finite(&self.q) {
            Some("coordinates")
        } else if !finite(&self.v) {
            Some("velocities")
        } else if !finite(&self.a) {
            Some("accelerations")
        } else if !self.pressures_pa.iter().flatten().all(|x| x.is_finite()) {
            Some("pressures")
        } else {
            None
        }
    }
}
