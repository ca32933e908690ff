//! Sums over modes in one fixed order, whatever the number of lanes.

use super::lane::Lane;

/// `M` sums of `term` over `0..count`: four partial sums by index modulo 4, then
/// `(s₀ + s₁) + (s₂ + s₃)`. Zero terms at the end do not change the result.
#[inline(always)]
pub(super) fn sums<L: Lane, const M: usize>(count: usize, term: impl Fn(usize) -> [L; M]) -> [L; M] {
    let zero = L::splat(0.0);
    let mut part = [[zero; M]; 4];
    let whole = count - count % 4;
    let mut start = 0;
    while start < whole {
        for (r, part) in part.iter_mut().enumerate() {
            let t = term(start + r);
            for (p, t) in part.iter_mut().zip(t) {
                *p += t;
            }
        }
        start += 4;
    }
    for r in 0..count % 4 {
        // A constant index per arm keeps the partial sums in registers.
        let t = term(whole + r);
        let target = match r {
            0 => &mut part[0],
            1 => &mut part[1],
            _ => &mut part[2],
        };
        for (p, t) in target.iter_mut().zip(t) {
            *p += t;
        }
    }
    let mut total = [zero; M];
    for m in 0..M {
        total[m] = (part[0][m] + part[1][m]) + (part[2][m] + part[3][m]);
    }
    total
}
