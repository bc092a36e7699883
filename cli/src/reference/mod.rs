//! Generated pages of `docs/reference`. `UPDATE_SNAPSHOTS=1 cargo test -p raygrad-cli --bin raygrad reference` writes
//! them.

mod commands;
mod config;
mod samples;
mod source;

use std::path::{Path, PathBuf};

/// Longest line of a page.
const WIDTH: usize = 120;

/// The root of the workspace.
fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Compares a generated page with its file, or writes the file.
#[track_caller]
fn compare(name: &str, page: &str) {
    let file = root().join("docs/reference").join(name);
    if std::env::var_os("UPDATE_SNAPSHOTS").is_some() {
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(&file, page).unwrap();
    }
    let written = std::fs::read_to_string(&file).unwrap_or_default();
    if let Some((line, (new, old))) =
        page.lines().zip(written.lines().chain(std::iter::repeat(""))).enumerate().find(|(_, (new, old))| new != old)
    {
        panic!("docs/reference/{name}:{}: is `{old}`, should be `{new}`; UPDATE_SNAPSHOTS=1 writes it anew", line + 1);
    }
    assert_eq!(page.len(), written.len(), "docs/reference/{name} is too long; UPDATE_SNAPSHOTS=1 writes it anew");
}

/// Wraps words in lines of at most [`WIDTH`] characters. The first line starts with `first`, the others with `indent`.
fn wrap(first: &str, indent: &str, text: &str) -> String {
    let (mut page, mut line) = (String::new(), first.to_owned());
    let mut is_empty = true;
    for word in text.split_whitespace() {
        if !is_empty && line.chars().count() + 1 + word.chars().count() > WIDTH {
            page += &line;
            page.push('\n');
            line = indent.to_owned();
            is_empty = true;
        }
        if !is_empty {
            line.push(' ');
        }
        line += word;
        is_empty = false;
    }
    page + &line + "\n"
}

/// Converts plain text to Markdown. Flags and text after `Example:` become code, and special characters are escaped.
fn markdown(text: &str) -> String {
    let (text, example) = match text.split_once("Example: ") {
        Some((text, example)) => (text, Some(example)),
        None => (text, None),
    };
    let mut page = String::new();
    for (part, is_code) in text.split('`').zip([false, true].into_iter().cycle()) {
        if is_code {
            page += &format!("`{part}`");
            continue;
        }
        for word in part.split_inclusive(' ') {
            let flag = word.find(|c: char| !c.is_ascii_alphanumeric() && c != '-').unwrap_or(word.len());
            if word.starts_with("--") && flag > 2 {
                page += &format!("`{}`{}", &word[..flag], &word[flag..]);
            } else {
                page += &word.replace('*', "\\*").replace('<', "\\<");
            }
        }
    }
    match example {
        Some(example) => page + &format!("Example: `{}`.", example.trim_end_matches('.')),
        None => page,
    }
}

/// A text with a final full stop.
fn sentence(text: &str) -> String {
    let text = text.trim();
    if text.is_empty() || text.ends_with(['.', ':', '?']) { text.to_owned() } else { format!("{text}.") }
}

#[test]
fn wrap_keeps_words_within_width() {
    let text = "word ".repeat(100) + "`--set a=b` end";
    let page = wrap("- ", "  ", &text);
    assert!(page.lines().all(|line| line.chars().count() <= WIDTH));
    assert_eq!(page.trim_start_matches("- ").split_whitespace().count(), 103);
    assert_eq!(
        markdown("see --to, a*b and `x --y`. Example: raygrad x"),
        "see `--to`, a\\*b and `x --y`. Example: `raygrad x`."
    );
}
