//! Pieces of the valve signal on which it is linear and of one sign.
//!
//! The metering edges change where the signal crosses zero: a kink of the pressure rates. Steps end
//! there and at samples, so no step spans a kink. The edge follows from the value in the middle of
//! a piece, never from a zero at its end.

/// A linear piece of the signal that does not change sign.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Piece {
    /// Duration, s.
    pub(super) length_s: f64,
    /// Value at its start.
    pub(super) from: f64,
    /// Value at its end.
    pub(super) to: f64,
}

impl Piece {
    /// Whether the piston side is fed: the sign of the middle value.
    pub(super) fn extends(&self) -> bool {
        self.from + self.to >= 0.0
    }

    /// Magnitude at a time into the piece, and its rate.
    pub(super) fn opening(&self, at_s: f64) -> (f64, f64) {
        let sign = if self.extends() { 1.0 } else { -1.0 };
        let rate = (self.to - self.from) / self.length_s;
        (sign * (self.from + rate * at_s), sign * rate)
    }
}

/// The one or two pieces between two samples.
pub(super) fn pieces(from: f64, to: f64, sample_s: f64) -> (Piece, Option<Piece>) {
    let whole = Piece {
        length_s: sample_s,
        from,
        to,
    };
    if from * to >= 0.0 {
        return (whole, None);
    }
    let part = from / (from - to);
    // A crossing within a millionth of a sample of its end is taken as being there.
    if !(1e-6..=1.0 - 1e-6).contains(&part) {
        return (whole, None);
    }
    let first = Piece {
        length_s: part * sample_s,
        from,
        to: 0.0,
    };
    let second = Piece {
        length_s: sample_s - first.length_s,
        from: 0.0,
        to,
    };
    (first, Some(second))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_change_of_sign_is_a_boundary() {
        let (first, second) = pieces(0.5, -1.5, 0.004);
        let second = second.unwrap();
        assert!((first.length_s - 0.001).abs() < 1e-15);
        assert!((first.length_s + second.length_s - 0.004).abs() < 1e-18);
        assert!(first.extends() && !second.extends());
        let (opening, rate) = second.opening(0.0015);
        assert!((opening - 0.75).abs() < 1e-12 && (rate - 500.0).abs() < 1e-9);
    }

    #[test]
    fn a_zero_at_the_end_is_none() {
        assert_eq!(pieces(0.0, -1.0, 1.0).1, None);
        assert_eq!(pieces(1.0, 0.0, 1.0).1, None);
        assert!(!pieces(0.0, -1.0, 1.0).0.extends());
        assert!(pieces(0.0, 0.0, 1.0).0.extends());
        assert_eq!(pieces(1e-9, -1.0, 1.0).1, None);
    }
}
