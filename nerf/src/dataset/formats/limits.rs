//! What no file of a capture has.

/// An image side of more pixels than this is taken for damage to the file.
pub(super) const MOST_PIXELS: usize = 1 << 24;

/// So much of what a file says as a message may hold, which is one line.
pub(super) fn start(word: &str) -> String {
    word.chars().take(80).flat_map(char::escape_debug).collect()
}
