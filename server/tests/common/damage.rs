//! Input as it comes from broken tools, bad disks and people who try.

/// A body with a few bytes changed, lost, doubled, moved or cut off; the same for the same seed.
pub(crate) fn damaged(body: &[u8], seed: u64) -> Vec<u8> {
    // What means something to one of the formats.
    const TELLING: &[&[u8]] = &[
        b"null",
        b"1e999",
        b"-0",
        b"-1",
        b"[[[[[[[[",
        b"{}",
        b"\"",
        b"\\ud800",
        b"NaN",
        b"18446744073709551616",
        b",",
        b"\0",
        b"\n",
        b"\xff\xff\xff\xff",
        b"9223372036854775807",
        b"../../",
    ];
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = |below: usize| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        usize::try_from(state >> 33).unwrap_or(0) % below.max(1)
    };
    let mut body = body.to_vec();
    for _ in 0..=next(4) {
        let at = next(body.len());
        let length = next(16).min(body.len() - at);
        match next(7) {
            0 => body.truncate(at),
            1 => drop(body.drain(at..at + length)),
            2 => {
                let piece = body[at..at + length].to_vec();
                let to = next(body.len() + 1);
                drop(body.splice(to..to, piece));
            }
            3 => {
                if let Some(byte) = body.get_mut(at) {
                    *byte ^= 1 << next(8);
                }
            }
            4 => {
                if let Some(byte) = body.get_mut(at) {
                    *byte = u8::try_from(next(256)).unwrap_or(0);
                }
            }
            _ => {
                let telling = TELLING[next(TELLING.len())].iter().copied();
                drop(body.splice(at..at + length, telling));
            }
        }
    }
    body
}
