//! Dense LU factorisation with partial pivoting, in place and without allocation.

use crate::instruction_set::widest;

/// Factors of a square matrix stored row by row.
#[derive(Debug, Clone, Default)]
pub struct DenseLu {
    order: usize,
    /// Matrix, later its factors.
    pub values: Vec<f64>,
    pivots: Vec<usize>,
}

impl DenseLu {
    /// Room for a matrix of the given order, zero.
    #[must_use]
    pub fn new(order: usize) -> Self {
        Self {
            order,
            values: vec![0.0; order * order],
            pivots: vec![0; order],
        }
    }

    /// Order of the matrix.
    #[must_use]
    pub fn order(&self) -> usize {
        self.order
    }

    /// Factors `values`. Returns false where a pivot is zero or not finite.
    #[must_use]
    pub fn factorise(&mut self) -> bool {
        factorise(self)
    }

    /// Solves in place with the factors.
    pub fn solve(&self, right: &mut [f64]) {
        solve(self, right);
    }

    /// Solves with the transposed matrix, in place.
    pub fn solve_transposed(&self, right: &mut [f64]) {
        let n = self.order;
        debug_assert_eq!(right.len(), n);
        for i in 0..n {
            let x = right[i] / self.values[i * n + i];
            right[i] = x;
            for (r, u) in right[i + 1..]
                .iter_mut()
                .zip(&self.values[i * n + i + 1..(i + 1) * n])
            {
                *r -= u * x;
            }
        }
        for i in (0..n).rev() {
            let x = right[i];
            for (r, l) in right[..i].iter_mut().zip(&self.values[i * n..i * n + i]) {
                *r -= l * x;
            }
        }
        for k in (0..n).rev() {
            right.swap(k, self.pivots[k]);
        }
    }
}

widest! {
    fn factorise(lu: &mut DenseLu) -> bool {
        let n = lu.order;
        for k in 0..n {
            let mut pivot = k;
            let mut largest = lu.values[k * n + k].abs();
            for i in k + 1..n {
                let candidate = lu.values[i * n + k].abs();
                if candidate > largest {
                    (pivot, largest) = (i, candidate);
                }
            }
            if !(largest > 0.0 && largest.is_finite()) {
                return false;
            }
            lu.pivots[k] = pivot;
            if pivot != k {
                let (head, tail) = lu.values.split_at_mut(pivot * n);
                head[k * n..(k + 1) * n].swap_with_slice(&mut tail[..n]);
            }
            let (head, tail) = lu.values.split_at_mut((k + 1) * n);
            let top = &head[k * n + k..];
            let inverse = 1.0 / top[0];
            for row in tail.chunks_exact_mut(n) {
                let row = &mut row[k..];
                if row[0] == 0.0 {
                    continue;
                }
                let factor = row[0] * inverse;
                row[0] = factor;
                for (r, t) in row[1..].iter_mut().zip(&top[1..]) {
                    *r -= factor * t;
                }
            }
        }
        true
    }
}

widest! {
    fn solve(lu: &DenseLu, right: &mut [f64]) {
        let n = lu.order;
        debug_assert_eq!(right.len(), n);
        for k in 0..n {
            right.swap(k, lu.pivots[k]);
        }
        for i in 0..n {
            right[i] -= dot(&lu.values[i * n..i * n + i], &right[..i]);
        }
        for i in (0..n).rev() {
            let row = &lu.values[i * n..(i + 1) * n];
            right[i] = (right[i] - dot(&row[i + 1..], &right[i + 1..])) / row[i];
        }
    }
}

/// Sum of products in four strands: one strand would wait for every addition.
#[allow(
    clippy::inline_always,
    reason = "part of a function that enables wide instructions"
)]
#[inline(always)]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut strands = [0.0; 4];
    let ((a4, a_rest), (b4, b_rest)) = (a.as_chunks::<4>(), b.as_chunks::<4>());
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(x, y)| x * y).sum();
    for (x, y) in a4.iter().zip(b4) {
        let products: [f64; 4] = std::array::from_fn(|k| x[k] * y[k]);
        strands = std::array::from_fn(|k| strands[k] + products[k]);
    }
    (strands[0] + strands[1]) + (strands[2] + strands[3]) + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_a_system_that_needs_row_exchanges() {
        let n = 7;
        let entry = |i: usize, j: usize| {
            if i == j {
                0.0
            } else {
                libm::sin((3 * i + 7 * j + 1) as f64 * 0.77)
            }
        };
        let mut lu = DenseLu::new(n);
        for i in 0..n {
            for j in 0..n {
                lu.values[i * n + j] = entry(i, j);
            }
        }
        let x: Vec<f64> = (0..n).map(|i| i as f64 - 2.5).collect();
        let mut right: Vec<f64> = (0..n).map(|i| (0..n).map(|j| entry(i, j) * x[j]).sum()).collect();
        assert!(lu.factorise());
        lu.solve(&mut right);
        for (a, b) in right.iter().zip(&x) {
            assert!((a - b).abs() < 1e-12, "{a} {b}");
        }
    }

    #[test]
    fn solves_with_the_transposed_matrix() {
        let n = 6;
        // Large beside the diagonal, so that rows are exchanged.
        let entry = |i: usize, j: usize| {
            let large = if j == (i + 2) % n { 4.0 } else { 0.0 };
            large + libm::cos((5 * i + 3 * j * j + 1) as f64 * 0.61)
        };
        let mut lu = DenseLu::new(n);
        for i in 0..n {
            for j in 0..n {
                lu.values[i * n + j] = entry(i, j);
            }
        }
        let x: Vec<f64> = (0..n).map(|i| 1.5 - i as f64).collect();
        let mut right: Vec<f64> = (0..n).map(|i| (0..n).map(|j| entry(j, i) * x[j]).sum()).collect();
        assert!(lu.factorise());
        lu.solve_transposed(&mut right);
        for (a, b) in right.iter().zip(&x) {
            assert!((a - b).abs() < 1e-11, "{a} {b}");
        }
    }

    #[test]
    fn says_when_a_matrix_is_singular() {
        let mut lu = DenseLu::new(2);
        lu.values.copy_from_slice(&[1.0, 2.0, 0.0, 0.0]);
        assert!(!lu.factorise());
    }
}
