//! Damage to files, for the tests of everything that reads one.

use proptest::prelude::*;

/// What is done to a file: at a place, as a share of its length.
#[derive(Debug, Clone)]
pub enum Damage {
    /// Cut off.
    Truncate(f64),
    /// One bit.
    Flip(f64, u8),
    /// One byte.
    Set(f64, u8),
    /// Bytes more.
    Insert(f64, Vec<u8>),
    /// Bytes less.
    Remove(f64, usize),
    /// Bytes twice.
    Repeat(f64, usize),
    /// In place of the next number or word of a text.
    Token(f64, &'static str),
}

const TOKENS: [&str; 24] = [
    "0",
    "-1",
    "1",
    "1e400",
    "-1e400",
    "1e-400",
    "NaN",
    "Infinity",
    "-Infinity",
    "null",
    "true",
    "\"\"",
    "\"x\"",
    "[]",
    "{}",
    "18446744073709551616",
    "18446744073709551615",
    "9223372036854775807",
    "4294967296",
    "65537",
    "[[]]",
    "[1,2,3,4]",
    "0.5",
    "\"\\ud800\"",
];

/// A few damages in a row.
pub fn damage() -> impl Strategy<Value = Vec<Damage>> {
    let place = || 0.0..1.0_f64;
    let one = prop_oneof![
        1 => place().prop_map(Damage::Truncate),
        3 => (place(), 0..8_u8).prop_map(|(at, bit)| Damage::Flip(at, bit)),
        2 => (place(), any::<u8>()).prop_map(|(at, byte)| Damage::Set(at, byte)),
        1 => (place(), prop::collection::vec(any::<u8>(), 1..9)).prop_map(|(at, bytes)| Damage::Insert(at, bytes)),
        1 => (place(), 1..40_usize).prop_map(|(at, count)| Damage::Remove(at, count)),
        1 => (place(), 1..40_usize).prop_map(|(at, count)| Damage::Repeat(at, count)),
        5 => (place(), 0..TOKENS.len()).prop_map(|(at, i)| Damage::Token(at, TOKENS[i])),
    ];
    prop::collection::vec(one, 1..5)
}

/// The file after all of that.
pub fn damaged(bytes: &[u8], damage: &[Damage]) -> Vec<u8> {
    let mut out = bytes.to_vec();
    for damage in damage {
        let at = |share: f64| ((share * out.len() as f64) as usize).min(out.len().saturating_sub(1));
        match damage {
            _ if out.is_empty() => {}
            Damage::Truncate(share) => out.truncate(at(*share)),
            Damage::Flip(share, bit) => {
                let i = at(*share);
                out[i] ^= 1 << bit
            }
            Damage::Set(share, byte) => {
                let i = at(*share);
                out[i] = *byte
            }
            Damage::Insert(share, bytes) => {
                let i = at(*share);
                drop(out.splice(i..i, bytes.iter().copied()))
            }
            Damage::Remove(share, count) => {
                let i = at(*share);
                drop(out.drain(i..(i + count).min(out.len())))
            }
            Damage::Repeat(share, count) => {
                let i = at(*share);
                let part = out[i..(i + count).min(out.len())].to_vec();
                drop(out.splice(i..i, part));
            }
            Damage::Token(share, token) => {
                let is_token = |b: &u8| b.is_ascii_alphanumeric() || b"-+._\"".contains(b);
                let start = out[at(*share)..].iter().position(is_token).map_or(out.len(), |i| i + at(*share));
                let end = out[start..].iter().position(|b| !is_token(b)).map_or(out.len(), |i| i + start);
                drop(out.splice(start..end, token.bytes()));
            }
        }
    }
    out
}

/// Errors are one line, and name the file that is at fault.
#[track_caller]
pub fn clear(error: impl ToString, name: &str) {
    let text = error.to_string();
    assert!(text.contains(name) && text.lines().count() == 1 && text.len() < 2000, "{text}");
}
