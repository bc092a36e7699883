//! How programs write cameras to files: a file for each format, and none knows of another.

// What recognises a folder's format calls these.
#[allow(dead_code)]
pub(crate) mod colmap;
#[allow(dead_code)]
pub(crate) mod llff;
mod npy;
pub(crate) mod rigid;

/// An image side of more pixels than this is taken for damage to the file.
const MOST_PIXELS: usize = 1 << 24;

/// So much of what a file says as a message may hold, which is one line.
fn start(word: &str) -> String {
    word.chars().take(80).flat_map(char::escape_debug).collect()
}

#[cfg(test)]
#[path = "../../../../tests/stability/damage.rs"]
mod damage;

/// How many damaged files a test tries: `PROPTEST_CASES`, if that is set.
#[cfg(test)]
fn cases(short: u32) -> proptest::prelude::ProptestConfig {
    let cases = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(short);
    proptest::prelude::ProptestConfig { cases, ..Default::default() }
}
