//! Sums over modes in one fixed order, whatever the number of lanes.

use super::lane::Lane;

/// `sums!(count, |i| [x, y, …])`: sums of the terms over `0..count`, four partial sums each by index
/// modulo 4, then `(s₀ + s₁) + (s₂ + s₃)`. Zero terms at the end do not change the result.
///
/// A macro, because a closure of this size is not inlined into the function that enables the vector
/// instructions, and then every operation in it is a call.
macro_rules! sums {
    ($count:expr, |$i:ident| $terms:expr) => {{
        let count: usize = $count;
        let mut part = crate::fast::sums::start();
        let whole = count - count % 4;
        let mut at = 0;
        while at < whole {
            for (r, part) in part.iter_mut().enumerate() {
                let $i = at + r;
                crate::fast::sums::add(part, $terms);
            }
            at += 4;
        }
        // A constant index per partial sum keeps them in registers.
        if whole < count {
            let $i = whole;
            crate::fast::sums::add(&mut part[0], $terms);
        }
        if whole + 1 < count {
            let $i = whole + 1;
            crate::fast::sums::add(&mut part[1], $terms);
        }
        if whole + 2 < count {
            let $i = whole + 2;
            crate::fast::sums::add(&mut part[2], $terms);
        }
        crate::fast::sums::total(part)
    }};
}
pub(super) use sums;

/// Partial sums before the first term.
#[inline(always)]
pub(super) fn start<L: Lane, const M: usize>() -> [[L; M]; 4] {
    [[L::splat(0.0); M]; 4]
}

/// Adds one term to each sum.
#[inline(always)]
pub(super) fn add<L: Lane, const M: usize>(part: &mut [L; M], terms: [L; M]) {
    for (part, term) in part.iter_mut().zip(terms) {
        *part += term;
    }
}

/// The sums of the parts.
#[inline(always)]
pub(super) fn total<L: Lane, const M: usize>(part: [[L; M]; 4]) -> [L; M] {
    let mut total = [L::splat(0.0); M];
    for (m, total) in total.iter_mut().enumerate() {
        *total = (part[0][m] + part[1][m]) + (part[2][m] + part[3][m]);
    }
    total
}
