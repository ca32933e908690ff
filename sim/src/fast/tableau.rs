//! Coefficients of the Rosenbrock method, in the transformed form that needs no product with the
//! Jacobian: (1/(γ h) − J) uᵢ = f(y + Σ aᵢⱼ uⱼ) + Σ cᵢⱼ/h uⱼ + γᵢ h ∂f/∂t.

/// Most stages of a method.
pub(crate) const STAGES: usize = 8;

/// A stiffly accurate Rosenbrock method: the new state is the last stage's argument plus the last
/// increment, which is also the error estimate.
#[derive(Debug)]
pub(crate) struct Tableau {
    /// Stages in use.
    pub(crate) stages: usize,
    /// First stage whose argument is the previous stage's argument plus its increment.
    pub(crate) chain: usize,
    /// γ.
    pub(crate) gamma: f64,
    /// aᵢⱼ.
    pub(crate) a: [[f64; STAGES]; STAGES],
    /// cᵢⱼ.
    pub(crate) c: [[f64; STAGES]; STAGES],
    /// Times of the stages over the step.
    pub(crate) time: [f64; STAGES],
    /// γᵢ.
    pub(crate) d: [f64; STAGES],
    /// Σᵣ hᵣⱼ of the dense output: its derivative at the end of the step is
    /// (y₁ − y₀ − Σ slopeⱼ uⱼ)/h.
    pub(crate) slope: [f64; STAGES],
}

/// Rodas5P: order 5 with an estimate of order 4, 8 stages. Steinebach, *Construction of
/// Rosenbrock–Wanner method Rodas5P and numerical benchmarks within the Julia differential equations
/// package*, BIT Numerical Mathematics 63 (2023), table 1.
#[rustfmt::skip]
pub(crate) static RODAS5P: Tableau = Tableau {
    stages: 8,
    chain: 6,
    gamma: 0.211_937_563_194_290_14,
    a: [
        [0.0; STAGES],
        [3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [2.849_394_379_747_939, 0.458_422_422_044_639_23, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [-6.954_028_509_809_101, 2.489_845_061_869_568, -10.358_996_098_473_584, 0.0, 0.0, 0.0, 0.0, 0.0],
        [2.802_998_627_562_896_4, 0.507_246_473_622_820_6, -0.398_831_254_177_052_4, -0.047_211_872_304_046_41, 0.0, 0.0, 0.0, 0.0],
        [-7.502_846_399_306_121, 2.561_846_144_803_919, -11.627_539_656_261_098, -0.182_687_676_599_422_56, 0.030_198_172_008_377_946, 0.0, 0.0, 0.0],
        [0.0; STAGES],
        [0.0; STAGES],
    ],
    c: [
        [0.0; STAGES],
        [-14.155_112_264_123_755, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [-17.972_960_358_859_52, -2.859_693_295_451_294, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [147.121_502_757_117_16, -1.412_214_027_182_13, 71.689_402_513_023_58, 0.0, 0.0, 0.0, 0.0, 0.0],
        [165.435_170_248_716_76, -0.459_282_345_649_112_6, 42.909_383_369_586_03, -5.961_986_721_573_306, 0.0, 0.0, 0.0, 0.0],
        [24.854_864_614_690_072, -3.000_922_700_283_218_6, 47.493_111_002_076_8, 5.581_419_782_155_812_5, -0.661_069_182_524_947_1, 0.0, 0.0, 0.0],
        [30.912_732_140_285_99, -3.120_824_334_993_797_4, 77.799_546_460_708_92, 34.286_460_282_947_83, -19.097_331_116_725_623, -28.087_943_162_872_662, 0.0, 0.0],
        [37.802_771_233_905_63, -3.257_196_902_907_227_6, 112.269_188_494_963_27, 66.934_723_124_404_7, -40.066_189_370_910_02, -54.667_802_628_779_68, -9.488_616_523_096_27, 0.0],
    ],
    time: [0.0, 0.635_812_689_582_870_4, 0.409_579_839_339_753_5, 0.976_930_672_506_071_6, 0.428_840_360_955_866_4, 1.0, 1.0, 1.0],
    d: [0.211_937_563_194_290_14, -0.423_875_126_388_580_27, -0.338_462_712_623_592_4, 1.804_645_287_288_273_4, 2.325_825_639_765_069, 0.0, 0.0, 0.0],
    slope: [27.453_001_925_634_41, -0.639_002_429_382_439_5, 86.398_999_089_147_01, 53.261_968_677_742_11, -31.371_784_490_122_536, -42.685_163_807_375_74, -6.517_579_526_804_206, -1.999_171_094_911_204_7],
};

#[cfg(test)]
mod tests {
    use super::*;

    fn integrate(method: &Tableau, steps: u32) -> f64 {
        // y' = −y² + t, y(0) = 1: nonlinear and non-autonomous.
        let h = 1.0 / f64::from(steps);
        let mut y = 1.0;
        for step in 0..steps {
            let t = f64::from(step) * h;
            let w = 1.0 / (method.gamma * h) + 2.0 * y;
            let mut u = [0.0; STAGES];
            let mut arg = y;
            for i in 0..method.stages {
                arg = if i >= method.chain {
                    arg + u[i - 1]
                } else {
                    y + (0..i).map(|j| method.a[i][j] * u[j]).sum::<f64>()
                };
                let carried: f64 = (0..i).map(|j| method.c[i][j] * u[j] / h).sum();
                let f = -arg * arg + t + method.time[i] * h;
                u[i] = (f + carried + method.d[i] * h) / w;
            }
            y = arg + u[method.stages - 1];
        }
        y
    }

    #[test]
    fn shows_its_order() {
        let fine = integrate(&RODAS5P, 400);
        let coarse = (integrate(&RODAS5P, 8) - fine).abs();
        let halved = (integrate(&RODAS5P, 16) - fine).abs();
        let seen = libm::log2(coarse / halved);
        // Half an order of slack: higher terms still show at these steps.
        assert!((seen - 5.0).abs() < 0.6, "order {seen}");
    }
}
