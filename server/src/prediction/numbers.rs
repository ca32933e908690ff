//! The numbers of a request's `data`, read apart from the rest of its JSON.
//!
//! A window is three hundred numbers and little else: a JSON parser for everything spends more on them than the
//! network does. Here they are read by a loop that knows nothing else. Whatever it does not know is left to the
//! parser for everything, so that both say the same of every request: the loop is a shortcut, not a second grammar.

/// The key whose array is read.
const KEY: &[u8] = b"\"data\"";
/// Integers up to here are exact in f64, …
const EXACT: u64 = 1 << 53;
/// … and so are these powers of ten: product and quotient of two exact numbers are rounded once, as they should be.
const POWERS: [f64; 23] = [
    1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18,
    1e19, 1e20, 1e21, 1e22,
];
/// Digits that a u64 has room for, whichever they are.
const MOST_DIGITS: usize = 19;

/// The numbers of the only `"data"` in a JSON text, row-major however they are nested, and the text with an empty
/// array in their place. None if there is no such array or another one beside it, or it holds anything but numbers in
/// arrays nested up to `deepest`, or a key holds an escape.
#[must_use]
pub(super) fn apart(json: &[u8], deepest: usize) -> Option<(Vec<u8>, Vec<f64>)> {
    let mut found: Option<(std::ops::Range<usize>, Vec<f64>)> = None;
    let mut at = 0;
    while let Some(&byte) = json.get(at) {
        if byte != b'"' {
            at += 1;
            continue;
        }
        let end = string_end(json, at)?;
        let colon = skip_space(json, end);
        if json.get(colon) != Some(&b':') {
            at = end;
            continue;
        }
        // Escapes can spell `data` in other ways.
        if json[at..end].contains(&b'\\') {
            return None;
        }
        if &json[at..end] != KEY {
            at = end;
            continue;
        }
        if found.is_some() {
            return None;
        }
        let open = skip_space(json, colon + 1);
        let mut values = Vec::with_capacity(json.len() / 8);
        at = arrays(json, open, deepest, &mut values)?;
        found = Some((open..at, values));
    }
    let (array, values) = found?;
    Some(([&json[..array.start], b"[]", &json[array.end..]].concat(), values))
}

/// Where a string that begins at `at` has ended.
fn string_end(json: &[u8], at: usize) -> Option<usize> {
    let mut place = at + 1;
    loop {
        match json.get(place)? {
            b'"' => return Some(place + 1),
            b'\\' => place += 2,
            _ => place += 1,
        }
    }
}

fn skip_space(json: &[u8], mut at: usize) -> usize {
    while matches!(json.get(at), Some(b' ' | b'\n' | b'\t' | b'\r')) {
        at += 1;
    }
    at
}

/// Reads an array at `at`, and those in it; returns where it has ended.
fn arrays(json: &[u8], at: usize, deepest: usize, values: &mut Vec<f64>) -> Option<usize> {
    if json.get(at) != Some(&b'[') {
        return None;
    }
    let (mut at, mut depth) = (skip_space(json, at + 1), 1);
    // Whether the innermost array is still empty: only then may it end where a value could stand.
    let mut is_empty = true;
    loop {
        match json.get(at)? {
            b'[' => {
                depth += 1;
                if depth > deepest {
                    return None;
                }
                is_empty = true;
                at = skip_space(json, at + 1);
                continue;
            }
            b']' if is_empty => {}
            _ => {
                let (value, end) = number(json, at)?;
                values.push(value);
                at = skip_space(json, end);
            }
        }
        // After a value, or at the end of an array.
        while json.get(at)? == &b']' {
            depth -= 1;
            at += 1;
            if depth == 0 {
                return Some(at);
            }
            at = skip_space(json, at);
        }
        if json.get(at)? != &b',' {
            return None;
        }
        at = skip_space(json, at + 1);
        is_empty = false;
    }
}

/// Reads digits into `mantissa` as long as they come; returns where they end.
#[inline]
fn digits(json: &[u8], mut at: usize, mantissa: &mut u64) -> usize {
    while let Some(&byte) = json.get(at) {
        let digit = byte.wrapping_sub(b'0');
        if digit > 9 {
            break;
        }
        *mantissa = mantissa.wrapping_mul(10).wrapping_add(u64::from(digit));
        at += 1;
    }
    at
}

/// Reads a number as JSON writes it; returns where it ends.
#[inline]
fn number(json: &[u8], begin: usize) -> Option<(f64, usize)> {
    let is_negative = json.get(begin)? == &b'-';
    let first = begin + usize::from(is_negative);
    let mut mantissa = 0;
    let mut at = digits(json, first, &mut mantissa);
    let mut count = at - first;
    // No digit, or one too many at the front.
    if count == 0 || (count > 1 && json[first] == b'0') {
        return None;
    }
    let mut decimals = 0;
    if json.get(at) == Some(&b'.') {
        let point = at + 1;
        at = point;
        at = digits(json, at, &mut mantissa);
        decimals = at - point;
        count += decimals;
        if decimals == 0 {
            return None;
        }
    }
    let mut end = at;
    if matches!(json.get(end), Some(b'e' | b'E')) {
        end += 1;
        end += usize::from(matches!(json.get(end), Some(b'+' | b'-')));
        let from = end;
        end = digits(json, end, &mut 0);
        if end == from {
            return None;
        }
    } else if count <= MOST_DIGITS && mantissa <= EXACT && decimals < POWERS.len() {
        let value = mantissa as f64 / POWERS[decimals];
        return Some((if is_negative { -value } else { value }, end));
    }
    let text = std::str::from_utf8(&json[begin..end]).ok()?;
    // An overflow is for the parser for everything to refuse.
    let value = text.parse().ok().filter(|value: &f64| value.is_finite())?;
    Some((value, end))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn read(array: &str) -> Option<Vec<f64>> {
        let text = format!("{{\"a\": \"\\\"data\\\": [7]\", \"data\" : {array}, \"b\": \"data\"}}");
        let (rest, values) = apart(text.as_bytes(), 3)?;
        let rest = String::from_utf8(rest).unwrap();
        assert_eq!(
            rest,
            "{\"a\": \"\\\"data\\\": [7]\", \"data\" : [], \"b\": \"data\"}"
        );
        Some(values)
    }

    #[test]
    fn numbers_are_read_however_they_are_nested() {
        assert_eq!(read("[]"), Some(vec![]));
        assert_eq!(read("[ 1 , -2.5\n]"), Some(vec![1.0, -2.5]));
        assert_eq!(
            read("[[[1,2],[3]],[],[[4.0e2]]]"),
            Some(vec![1.0, 2.0, 3.0, 400.0])
        );
        assert_eq!(
            read("[-0, 0.12345678, 0.1234567812345678]").map(|v| v[0].to_bits()),
            Some((-0.0_f64).to_bits())
        );
    }

    #[test]
    fn what_is_no_number_is_left_to_others() {
        for array in [
            "[01]",
            "[+1]",
            "[1.]",
            "[.5]",
            "[1e]",
            "[1e+]",
            "[-]",
            "[NaN]",
            "[null]",
            "[\"1\"]",
            "[1,]",
            "[,1]",
            "[1 2]",
            "[1",
            "[[1]",
            "[[[[1]]]]",
            "[1e999]",
            "[1]]",
            "{}",
            "3",
            "[1,,2]",
            "[[1],]",
            "[0x1]",
            "[1_0]",
            "[--1]",
        ] {
            let found = read_quietly(array);
            // A bracket too many is after the array, where the rest is read.
            assert!(found.is_none() || array == "[1]]", "{array}: {found:?}");
        }
        for text in [
            "{\"data\": [1], \"data\": [2]}",
            "{\"data\" [1]}",
            "\"data",
            "{\"datum\": [1]}",
            "{\"data\": [1], \"d\\u0061ta\": [2]}",
            "{\"d\\u0061ta\": [2], \"data\": [1]}",
            "",
        ] {
            assert_eq!(apart(text.as_bytes(), 3), None, "{text}");
        }
    }

    fn read_quietly(array: &str) -> Option<Vec<f64>> {
        apart(format!("{{\"data\": {array}}}").as_bytes(), 3).map(|(_, values)| values)
    }

    fn agrees(text: &str) {
        let expected: Option<Vec<f64>> = serde_json::from_str(text).ok();
        let bits = |values: Vec<f64>| -> Vec<u64> { values.into_iter().map(f64::to_bits).collect() };
        assert_eq!(read_quietly(text).map(bits), expected.map(bits), "{text}");
    }

    proptest! {
        #[test]
        fn every_number_is_what_the_other_parser_reads(
            value in any::<f64>().prop_filter("JSON has no others", |value| value.is_finite()),
            small in any::<f32>().prop_filter("JSON has no others", |value| value.is_finite()),
            digits in 0_usize..25,
        ) {
            agrees(&format!("[{value:?}, {value:e}, {small}, {small:?}]"));
            agrees(&format!("[{:.digits$}, {small:.digits$e}]", f64::from(small) % 1e9));
            agrees(&format!("[{}, {}]", value.to_bits(), small.to_bits()));
        }

        #[test]
        fn every_text_is_what_the_other_parser_reads_or_nothing(text in "[-+0-9.eE, ]{0,24}") {
            agrees(&format!("[{text}]"));
        }
    }
}
