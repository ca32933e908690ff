//! Quadrature on the unit tetrahedron, in barycentric coordinates with weights that sum to one.
//!
//! Multiply by the element volume (or by `det J / 6` of a curved element).

/// A point: barycentric coordinates (L₁, L₂, L₃, L₄) and weight.
pub(super) type QuadraturePoint = ([f64; 4], f64);

/// Centroid, exact for polynomials of degree 1.
pub(super) const ONE_POINT: [QuadraturePoint; 1] = [([0.25; 4], 1.0)];

/// Four points, exact for degree 2 (Hammer, Marlowe, Stroud 1956).
pub(super) const FOUR_POINTS: [QuadraturePoint; 4] = {
    // (5 ± 3√5)/20 and (5 − √5)/20
    const A: f64 = 0.585_410_196_624_968_5;
    const B: f64 = 0.138_196_601_125_010_5;
    [
        ([A, B, B, B], 0.25),
        ([B, A, B, B], 0.25),
        ([B, B, A, B], 0.25),
        ([B, B, B, A], 0.25),
    ]
};

/// Fourteen points, exact for degree 5, all weights positive (Walkington 2000).
///
/// Degree 4 integrates the consistent mass of a straight tetrahedron with 10 nodes exactly.
pub(super) const FOURTEEN_POINTS: [QuadraturePoint; 14] = {
    const A: f64 = 0.310_885_919_263_300_6;
    const A3: f64 = 1.0 - 3.0 * A;
    const WA: f64 = 0.112_687_925_718_015_85;
    const B: f64 = 0.092_735_250_310_891_23;
    const B3: f64 = 1.0 - 3.0 * B;
    const WB: f64 = 0.073_493_043_116_361_95;
    const C: f64 = 0.045_503_704_125_649_65;
    const D: f64 = 0.5 - C;
    const WC: f64 = 0.042_546_020_777_081_47;
    [
        ([A3, A, A, A], WA),
        ([A, A3, A, A], WA),
        ([A, A, A3, A], WA),
        ([A, A, A, A3], WA),
        ([B3, B, B, B], WB),
        ([B, B3, B, B], WB),
        ([B, B, B3, B], WB),
        ([B, B, B, B3], WB),
        ([C, C, D, D], WC),
        ([C, D, C, D], WC),
        ([C, D, D, C], WC),
        ([D, C, C, D], WC),
        ([D, C, D, C], WC),
        ([D, D, C, C], WC),
    ]
};

#[cfg(test)]
mod tests {
    use super::*;

    /// `∫ L₁ᵃ L₂ᵇ L₃ᶜ L₄ᵈ dV / V = 3! a! b! c! d! / (a+b+c+d+3)!`.
    fn exact(powers: [u32; 4]) -> f64 {
        let factorial = |n: u32| (1..=n).map(f64::from).product::<f64>();
        let sum: u32 = powers.iter().sum();
        6.0 * powers.iter().map(|&p| factorial(p)).product::<f64>() / factorial(sum + 3)
    }

    fn integrate(points: &[QuadraturePoint], powers: [u32; 4]) -> f64 {
        points
            .iter()
            .map(|(l, w)| {
                w * l
                    .iter()
                    .zip(powers)
                    .map(|(l, p)| l.powi(p.try_into().unwrap()))
                    .product::<f64>()
            })
            .sum()
    }

    #[test]
    fn rules_are_exact_up_to_their_degree_and_not_beyond() {
        for (points, degree) in [
            (&ONE_POINT[..], 1_u32),
            (&FOUR_POINTS[..], 2),
            (&FOURTEEN_POINTS[..], 5),
        ] {
            for a in 0..=degree {
                for b in 0..=degree - a {
                    for c in 0..=degree - a - b {
                        let powers = [a, b, c, degree - a - b - c];
                        // coefficients are given to 16 digits
                        assert!((integrate(points, powers) - exact(powers)).abs() < 1e-15);
                    }
                }
            }
            let beyond = [degree + 1, 0, 0, 0];
            assert!((integrate(points, beyond) - exact(beyond)).abs() > 1e-6);
        }
    }
}
