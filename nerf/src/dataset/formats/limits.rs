//! Limits for the contents of a capture's files.

/// The most pixels of an image side; more means that the file is damaged.
pub(super) const MOST_PIXELS: usize = 1 << 24;

/// The start of a word from a file, short enough for a one-line message.
pub(super) fn start(word: &str) -> String {
    word.chars().take(80).flat_map(char::escape_debug).collect()
}
