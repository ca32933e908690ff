//! Euler parameters and small rotations (theory note §1.1 and §5).

use nalgebra::{Matrix3, Matrix3x4, Vector3, Vector4};

/// Matrix `ã` with `ã b = a × b`.
#[must_use]
pub fn skew(a: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -a.z, a.y, a.z, 0.0, -a.x, -a.y, a.x, 0.0)
}

/// Rotation matrix `A` (body → global) of the Euler parameters `θ = [e0, e1, e2, e3]`.
///
/// Forms that agree on the unit sphere differ away from `|θ| = 1`, where velocity-level constraints and unfinished Newton
/// iterations let the solution drift. This one has `1 − 2 (e_j² + e_k²)` on the diagonal, as Exudyn (its `RotationMatrix`
/// at θ = (0.9, 0.1, 0.3, 0.2) begins with 0.74); with theory note §1.1's `2 (e0² + e_i²) − 1` angles and lengths of the
/// index-2 solution differ from it by 2e-6 of range.
#[must_use]
pub fn rotation_matrix(theta: &Vector4<f64>) -> Matrix3<f64> {
    let (e0, e1, e2, e3) = (theta[0], theta[1], theta[2], theta[3]);
    2.0 * Matrix3::new(
        0.5 - e2 * e2 - e3 * e3,
        e1 * e2 - e0 * e3,
        e1 * e3 + e0 * e2,
        e1 * e2 + e0 * e3,
        0.5 - e1 * e1 - e3 * e3,
        e2 * e3 - e0 * e1,
        e1 * e3 - e0 * e2,
        e2 * e3 + e0 * e1,
        0.5 - e1 * e1 - e2 * e2,
    )
}

/// Map `G(θ)`, 3 × 4, with body-frame angular velocity `ω = G θ̇` and `Ġ θ̇ = 0`.
#[must_use]
pub fn rate_map(theta: &Vector4<f64>) -> Matrix3x4<f64> {
    let (e0, e1, e2, e3) = (theta[0], theta[1], theta[2], theta[3]);
    2.0 * Matrix3x4::new(-e1, e0, e3, -e2, -e2, -e3, e0, e1, -e3, e2, -e1, e0)
}

/// Euler parameters of a rotation by `angle_rad` about the global Z axis.
#[must_use]
pub fn euler_parameters_about_z(angle_rad: f64) -> Vector4<f64> {
    let (sin, cos) = libm::sincos(0.5 * angle_rad);
    Vector4::new(cos, 0.0, 0.0, sin)
}

/// Rotation matrix of the rotation vector `v`: `exp(ṽ)`.
#[must_use]
pub fn exponential(v: &Vector3<f64>) -> Matrix3<f64> {
    let phi2 = v.norm_squared();
    let phi = phi2.sqrt();
    let (a, b) = if phi < 1e-2 {
        (
            1.0 - phi2 / 6.0 + phi2 * phi2 / 120.0,
            0.5 - phi2 / 24.0 + phi2 * phi2 / 720.0,
        )
    } else {
        (libm::sin(phi) / phi, (1.0 - libm::cos(phi)) / phi2)
    };
    let s = skew(v);
    Matrix3::identity() + s * a + s * s * b
}

/// Tangent operator `T(v)` of the exponential map: `T v̇` is the angular velocity in the rotated
/// frame. `T = I − (1 − cos φ)/φ² ṽ + (1 − sin φ / φ)/φ² ṽ²`.
#[must_use]
pub fn tangent(v: &Vector3<f64>) -> Matrix3<f64> {
    let phi2 = v.norm_squared();
    let phi = phi2.sqrt();
    let (b, c) = if phi < 1e-2 {
        (
            0.5 - phi2 / 24.0 + phi2 * phi2 / 720.0,
            1.0 / 6.0 - phi2 / 120.0 + phi2 * phi2 / 5040.0,
        )
    } else {
        ((1.0 - libm::cos(phi)) / phi2, (1.0 - libm::sin(phi) / phi) / phi2)
    };
    let s = skew(v);
    Matrix3::identity() - s * b + s * s * c
}

#[cfg(test)]
mod tests {
    use super::*;

    fn theta() -> Vector4<f64> {
        Vector4::new(0.6, -0.3, 0.5, 0.2).normalize()
    }

    #[test]
    fn rotation_matrix_is_orthonormal_on_the_unit_sphere() {
        let a = rotation_matrix(&theta());
        // Rounding of a few products of numbers below one.
        assert!((a * a.transpose() - Matrix3::identity()).norm() < 1e-15 * 10.0);
        assert!((a.determinant() - 1.0).abs() < 1e-14);
    }

    #[test]
    fn rotation_matrix_off_the_unit_sphere_is_that_of_exudyn() {
        // mbs.GetNodeOutput(node, RotationMatrix) of Exudyn 1.13.6.
        let a = rotation_matrix(&Vector4::new(0.9, 0.1, 0.3, 0.2));
        let exudyn = Matrix3::new(0.74, -0.3, 0.58, 0.42, 0.9, -0.06, -0.5, 0.3, 0.8);
        assert!((a - exudyn).norm() < 1e-15, "{a}");
    }

    #[test]
    fn rate_map_gives_the_body_frame_angular_velocity() {
        // Central difference of A along a unit-norm curve: Aᵀ Ȧ = ω̃.
        let rate = {
            let g = rate_map(&theta());
            g.transpose() * Vector3::new(0.3, -0.7, 0.4) * 0.25
        };
        let h = 1e-6;
        let a_dot =
            (rotation_matrix(&(theta() + rate * h)) - rotation_matrix(&(theta() - rate * h))) / (2.0 * h);
        let omega = rate_map(&theta()) * rate;
        // The second difference has an error of h² ≈ 1e-12 and rounding of 1e-16/h = 1e-10.
        assert!((rotation_matrix(&theta()).transpose() * a_dot - skew(&omega)).norm() < 1e-9);
        assert!((omega - Vector3::new(0.3, -0.7, 0.4)).norm() < 1e-14);
        assert!((rate_map(&rate) * rate).norm() < 1e-15);
    }

    #[test]
    fn tangent_operator_is_the_derivative_of_the_exponential() {
        for scale in [1e-3, 0.9e-2, 1.1e-2, 0.8] {
            let v = Vector3::new(0.5, -0.4, 0.3) * scale;
            let v_dot = Vector3::new(-0.2, 0.9, 0.6);
            let h = 1e-6;
            let e_dot = (exponential(&(v + v_dot * h)) - exponential(&(v - v_dot * h))) / (2.0 * h);
            let local = exponential(&v).transpose() * e_dot;
            assert!(
                (local - skew(&(tangent(&v) * v_dot))).norm() < 1e-9,
                "scale {scale}"
            );
        }
    }
}
