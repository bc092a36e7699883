//! Damage to files, for tests of parsers.

use proptest::prelude::*;

/// A change of a file at a position, which is a share of its length.
#[derive(Debug, Clone)]
pub enum Damage {
    /// Removes the rest.
    Truncate(f64),
    /// Flips a bit.
    Flip(f64, u8),
    /// Sets a byte.
    Set(f64, u8),
    /// Inserts bytes.
    Insert(f64, Vec<u8>),
    /// Removes bytes.
    Remove(f64, usize),
    /// Repeats bytes.
    Repeat(f64, usize),
    /// Copies a part to another position.
    Double(f64, f64),
    /// Replaces the next number or word of a text.
    Token(f64, &'static str),
    /// Replaces 1, 2, 4 or 8 bytes by an integer, little- or big-endian.
    Integer(f64, u64, usize, bool),
    /// Replaces the rest by a part of another whole file.
    Splice(f64, f64),
}

/// Critical values of counts and lengths.
const INTEGERS: [u64; 12] = [
    0,
    1,
    0x7f,
    0x80,
    0xffff,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    1 << 60,
    0x7fff_ffff_ffff_ffff,
    0x8000_0000_0000_0000,
    u64::MAX,
];

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
        1 => (place(), place()).prop_map(|(from, to)| Damage::Double(from, to)),
        5 => (place(), 0..TOKENS.len()).prop_map(|(at, i)| Damage::Token(at, TOKENS[i])),
        2 => (place(), 0..INTEGERS.len(), 0..4_u32, any::<bool>())
            .prop_map(|(at, i, log2, least)| Damage::Integer(at, INTEGERS[i], 1 << log2, least)),
        1 => (place(), place()).prop_map(|(at, from)| Damage::Splice(at, from)),
    ];
    prop::collection::vec(one, 1..5)
}

/// Applies all damages; `other` is another whole file.
pub fn damaged(bytes: &[u8], other: &[u8], damage: &[Damage]) -> Vec<u8> {
    let mut out = bytes.to_vec();
    for damage in damage {
        let within =
            |share: f64, bytes: &[u8]| ((share * bytes.len() as f64) as usize).min(bytes.len().saturating_sub(1));
        let at = |share: f64| within(share, &out);
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
            Damage::Double(from, to) => {
                let (from, to) = (at(from.min(*to)), at(from.max(*to)));
                let part = out[from..to].to_vec();
                drop(out.splice(to..to, part));
            }
            Damage::Integer(share, integer, size, least) => {
                let i = at(*share);
                let mut bytes = integer.to_le_bytes()[..*size].to_vec();
                if !least {
                    bytes.reverse();
                }
                drop(out.splice(i..(i + size).min(out.len()), bytes));
            }
            Damage::Splice(share, from) => {
                out.truncate(at(*share));
                out.extend(&other[within(*from, other)..]);
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

/// Checks that an error is one line and names the file.
#[track_caller]
pub fn clear(error: impl ToString, name: &str) {
    let text = error.to_string();
    assert!(text.contains(name) && text.lines().count() == 1 && text.len() < 2000, "{text}");
}
