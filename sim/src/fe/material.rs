//! Linear elastic isotropic material.

/// Isotropic Hooke material with density.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// Young's modulus E, Pa.
    pub youngs_modulus_pa: f64,
    /// Poisson's ratio ν, in (-1, 0.5).
    pub poisson_ratio: f64,
    /// Density ρ, kg/m³.
    pub density_kg_per_m3: f64,
}

impl Material {
    /// Lamé's first parameter `λ = E ν / ((1 + ν)(1 − 2ν))`, Pa.
    #[must_use]
    pub fn lame_lambda_pa(&self) -> f64 {
        let (e, nu) = (self.youngs_modulus_pa, self.poisson_ratio);
        e * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    }

    /// Shear modulus `μ = E / (2 (1 + ν))`, Pa.
    #[must_use]
    pub fn shear_modulus_pa(&self) -> f64 {
        self.youngs_modulus_pa / (2.0 * (1.0 + self.poisson_ratio))
    }
}
