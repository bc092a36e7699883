//! Rules for the Markdown files of the repository: line widths, sentence lengths, phrases, links, commands, paths and the
//! summary of the book.
//!
//! `cargo test --test testsuite documents -- --nocapture` prints the figures, also for comments of the sources.

use std::collections::{HashMap, HashSet};
use std::fmt;
use std::path::{Component, Path, PathBuf};

/// The longest line in characters, in tables too.
const WIDTH: usize = 120;
/// The most words of a sentence.
const LONGEST: usize = 30;
/// Phrases that have shorter synonyms.
const BANNED: [&str; 8] =
    ["it is said", "is found out", "whoever", "is dear", "one's own", "as it lies", "goes on", "is asked for"];
/// Generated pages of short facts.
const GENERATED: [&str; 2] = ["docs/reference/commands.md", "docs/reference/config.md"];
/// First line of a checkpoint, which is no call of the program.
const CHECKPOINT: &str = "raygrad checkpoint VERSION";
/// Their full stop ends no sentence.
const ABBREVIATIONS: [&str; 7] = ["al.", "e.g.", "i.e.", "vs.", "cf.", "Fig.", "No."];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The repository's files with an extension, by path from its root.
fn files(extension: &str) -> Vec<PathBuf> {
    fn visit(folder: &Path, extension: &str, files: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let entry = entry.unwrap();
            let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
            if entry.file_type().unwrap().is_dir() {
                // Build output, hidden folders and runs.
                let is_skipped =
                    name.starts_with('.') || name.starts_with("target") || path.join("config.json").exists();
                if !is_skipped && name != "node_modules" {
                    visit(&path, extension, files);
                }
            } else if path.extension().is_some_and(|own| own == extension) {
                files.push(path.strip_prefix(root()).unwrap().to_path_buf());
            }
        }
    }
    let mut found = vec![];
    visit(root(), extension, &mut found);
    found.sort();
    found
}

/// The Markdown files of the repository.
fn pages() -> Vec<PathBuf> {
    let found = files("md");
    assert!(!found.is_empty(), "no Markdown file is below {}", root().display());
    found
}

/// The Markdown files that people write and that are of today: the changelog has names of earlier versions.
fn current_pages() -> impl Iterator<Item = PathBuf> {
    let is_current =
        |file: &PathBuf| file != Path::new("CHANGELOG.md") && !GENERATED.iter().any(|page| file == Path::new(page));
    pages().into_iter().filter(is_current)
}

fn read(file: &Path) -> String {
    std::fs::read_to_string(root().join(file)).unwrap_or_else(|error| panic!("{}: {error}", file.display()))
}

/// A violation of a rule.
struct Finding {
    file: PathBuf,
    line: usize,
    what: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}: {}", self.file.display(), self.line, self.what)
    }
}

#[track_caller]
fn assert_none(rule: &str, findings: &[Finding]) {
    let lines: Vec<String> = findings.iter().map(|finding| format!("\n  {finding}")).collect();
    assert!(findings.is_empty(), "{rule}: {} findings{}", findings.len(), lines.concat());
}

/// The kind of a line of Markdown.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Kind {
    Code,
    Table,
    Heading,
    Blank,
    /// The first line of a list item.
    Item,
    Text,
}

/// The lines of a Markdown text, with their kinds.
fn lines(text: &str) -> Vec<(Kind, &str)> {
    let mut fence: Option<&str> = None;
    let mut is_comment = false;
    let kind = |line| {
        let bare: &str = str::trim_start(line);
        let bare = bare.trim_start_matches("> ");
        if let Some(open) = fence {
            if bare.starts_with(open) {
                fence = None;
            }
            return Kind::Code;
        }
        if let Some(open) = ["```", "~~~"].into_iter().find(|open| bare.starts_with(open)) {
            fence = Some(open);
            return Kind::Code;
        }
        if is_comment || bare.starts_with("<!--") {
            is_comment = !bare.contains("-->");
            return Kind::Code;
        }
        let digits = bare.trim_start_matches(|c: char| c.is_ascii_digit());
        match () {
            () if bare.is_empty() => Kind::Blank,
            () if bare.starts_with('|') => Kind::Table,
            () if bare.starts_with('#') && bare.trim_start_matches('#').starts_with(' ') => Kind::Heading,
            // A directive of mdBook or an HTML tag.
            () if bare.starts_with("{{") || bare.starts_with('<') && bare.ends_with('>') => Kind::Blank,
            () if ["- ", "* ", "+ "].iter().any(|mark| bare.starts_with(mark)) => Kind::Item,
            () if digits.len() < bare.len() && digits.starts_with(". ") => Kind::Item,
            () => Kind::Text,
        }
    };
    let mut kind = kind;
    text.lines().map(|line| (kind(line), line)).collect()
}

/// Paragraphs and list items as one line each, with the number of their first line.
fn paragraphs(text: &str) -> Vec<(usize, String)> {
    let mut all: Vec<(usize, String)> = vec![];
    let mut is_open = false;
    for (i, (kind, line)) in lines(text).into_iter().enumerate() {
        let bare = line.trim().trim_start_matches("> ").trim_end_matches('\\');
        match kind {
            Kind::Item => {
                let bare = bare.trim_start_matches(|c: char| c.is_ascii_digit());
                all.push((i + 1, bare[1..].trim_start().to_owned()));
                is_open = true;
            }
            Kind::Text if is_open => {
                let (_, paragraph) = all.last_mut().unwrap();
                *paragraph += " ";
                *paragraph += bare;
            }
            Kind::Text => {
                all.push((i + 1, bare.to_owned()));
                is_open = true;
            }
            _ => is_open = false,
        }
    }
    all
}

/// The words of a paragraph as they are read: code is one word, and of a link the text counts.
fn plain(paragraph: &str) -> String {
    let mut text = String::new();
    for (part, is_code) in paragraph.split('`').zip([false, true].into_iter().cycle()) {
        text += if is_code { "code" } else { part };
    }
    while let Some((start, after)) = text.split_once("](") {
        let rest = after.split_once(')').map_or("", |(_, rest)| rest);
        text = format!("{}{rest}", start.replace(['[', '!'], ""));
    }
    text.replace("**", "")
}

/// The sentences of a paragraph.
fn sentences(paragraph: &str) -> Vec<String> {
    let (mut all, mut sentence) = (vec![], vec![]);
    let text = plain(paragraph);
    for word in text.split_whitespace() {
        if word.chars().any(char::is_alphanumeric) {
            sentence.push(word);
        }
        let bare = word.trim_end_matches(['"', ')', '*', '_', '\'', '”', ']']);
        let bare = bare.trim_start_matches('(');
        if bare.ends_with(['.', '!', '?']) && !bare.ends_with("..") && !ABBREVIATIONS.contains(&bare) {
            all.push(std::mem::take(&mut sentence).join(" "));
        }
    }
    all.push(sentence.join(" "));
    all.retain(|sentence| !sentence.is_empty());
    all
}

fn words(sentence: &str) -> usize {
    sentence.split(' ').count()
}

/// Statistics of sentence lengths.
#[derive(Default)]
struct Lengths {
    sentences: usize,
    words: usize,
    longest: (usize, String),
    long: usize,
}

impl Lengths {
    fn add(&mut self, sentence: &str, file: &Path, line: usize) {
        let words = words(sentence);
        self.sentences += 1;
        self.words += words;
        self.long += usize::from(words > LONGEST);
        if words > self.longest.0 {
            self.longest = (words, format!("{}:{line}", file.display()));
        }
    }
}

impl fmt::Display for Lengths {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (mean, (longest, place)) = (self.words as f64 / self.sentences.max(1) as f64, &self.longest);
        let (count, long) = (self.sentences, self.long);
        write!(f, "{count} sentences, mean {mean:.1} words, longest {longest} ({place}), {long} over {LONGEST} words")
    }
}

/// The banned phrases in a text.
fn banned(text: &str) -> impl Iterator<Item = &'static str> {
    let text = format!(" {} ", text.to_lowercase().replace('’', "'"));
    BANNED.into_iter().filter(move |phrase| {
        text.match_indices(phrase).any(|(at, _)| {
            let [before, after] = [text[..at].chars().next_back(), text[at + phrase.len()..].chars().next()];
            [before, after].iter().all(|c| !c.is_some_and(char::is_alphanumeric))
        })
    })
}

/// The anchors of a page by GitHub's rules.
fn anchors(file: &Path, text: &str) -> Vec<String> {
    let mut all: Vec<String> = vec![];
    let mut seen: HashMap<String, usize> = HashMap::new();
    for (kind, line) in lines(text) {
        if kind == Kind::Heading {
            let title = heading(line.trim_start_matches(['#', ' ', '>']));
            let count = seen.entry(title.clone()).or_default();
            all.push(if *count == 0 { title.clone() } else { format!("{title}-{count}") });
            *count += 1;
        }
        // An mdBook include.
        if let Some(other) = line.trim().strip_prefix("{{#include ").and_then(|rest| rest.strip_suffix("}}")) {
            let other = normal(&file.with_file_name(other));
            all.extend(anchors(&other, &read(&other)));
        }
        for tag in ["id=\"", "name=\""] {
            all.extend(line.split(tag).skip(1).filter_map(|rest| Some(rest.split_once('"')?.0.to_owned())));
        }
    }
    all
}

/// The anchor of a heading: lower case, without punctuation, hyphens for spaces.
fn heading(title: &str) -> String {
    let mut text = title.trim().to_owned();
    while let Some((start, after)) = text.split_once("](") {
        let rest = after.split_once(')').map_or("", |(_, rest)| rest);
        text = format!("{}{rest}", start.replace(['[', '!'], ""));
    }
    let kept = text.chars().filter(|c| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_'));
    kept.flat_map(char::to_lowercase).map(|c| if c == ' ' { '-' } else { c }).collect()
}

/// Normalises a path without `..`.
fn normal(path: &Path) -> PathBuf {
    let mut out = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir if out.pop() => {}
            Component::CurDir => {}
            part => out.push(part),
        }
    }
    out
}

/// The targets of a page's links and images, with their lines.
fn links(text: &str) -> Vec<(usize, String)> {
    let mut all = vec![];
    for (i, (kind, line)) in lines(text).into_iter().enumerate().filter(|(_, (kind, _))| *kind != Kind::Code) {
        // Without inline code.
        let bare: String = line.split('`').step_by(2).collect::<Vec<_>>().join("code");
        let target = |rest: &str| rest.split([')', ' ']).next().unwrap_or_default().to_owned();
        all.extend(bare.split("](").skip(1).map(|rest| (i + 1, target(rest))));
        for tag in ["src=\"", "href=\""] {
            let targets = line.split(tag).skip(1).filter_map(|rest| Some(rest.split_once('"')?.0.to_owned()));
            all.extend(targets.map(|target| (i + 1, target)));
        }
        if kind == Kind::Text
            && bare.starts_with('[')
            && let Some((_, rest)) = bare.split_once("]: ")
        {
            all.push((i + 1, target(rest)));
        }
    }
    let is_local = |target: &str| !target.contains("://") && !target.starts_with("mailto:") && !target.is_empty();
    all.retain(|(_, target)| is_local(target));
    all
}

/// Parts of a page in inline code, with their lines.
fn inline_code(text: &str) -> Vec<(usize, String)> {
    let others = lines(text).into_iter().enumerate().filter(|(_, (kind, _))| *kind != Kind::Code);
    let parts = |(i, (_, line)): (usize, (Kind, &str))| {
        line.split('`').skip(1).step_by(2).map(|code| (i + 1, code.to_owned())).collect::<Vec<_>>()
    };
    others.flat_map(parts).collect()
}

/// Lines of code blocks, with the number of their first line; those that end in a backslash go on.
fn code_lines(text: &str) -> Vec<(usize, String)> {
    let mut all: Vec<(usize, String)> = vec![];
    let mut goes_on = false;
    for (i, (kind, line)) in lines(text).into_iter().enumerate() {
        if kind != Kind::Code {
            goes_on = false;
            continue;
        }
        let bare = line.trim_end_matches('\\');
        match all.last_mut().filter(|_| goes_on) {
            Some((_, whole)) => *whole += bare,
            None => all.push((i + 1, bare.to_owned())),
        }
        goes_on = line.ends_with('\\');
    }
    all
}

/// The program's commands in a line of code: the words after `raygrad`, each up to the end of its command.
fn program_calls(code: &str) -> Vec<Vec<&str>> {
    let mut calls: Vec<Vec<&str>> = vec![];
    let mut is_open = false;
    if code.starts_with(CHECKPOINT) {
        return calls;
    }
    let mut before = "";
    for word in code.split_whitespace() {
        let ends = ["|", "||", "&&", ";", ">", "2>", "#", "&", "\\"].contains(&word);
        if word == "raygrad" && !["-p", "-n", "--bin", "add", "install", "cd", "use", "crate"].contains(&before) {
            calls.push(vec![]);
            is_open = true;
        } else if ends {
            is_open = false;
        } else if is_open {
            calls.last_mut().unwrap().push(word.trim_end_matches([',', ';', ')', '.', ':']));
        }
        before = word;
    }
    calls
}

/// The flags in a help text.
fn flags(help: &str) -> HashSet<&str> {
    let flag = |word: &str| word.len() - word.trim_start_matches(|c: char| c == '-' || c.is_ascii_alphanumeric()).len();
    let words = help.split(|c: char| c.is_whitespace() || "[`'\"(".contains(c)).filter(|word| word.starts_with("--"));
    words.map(|word| &word[..flag(word)]).collect()
}

/// What is wrong with a call of the program, if anything: its subcommand or a flag.
fn check_call(call: &[&str]) -> Option<String> {
    let help = |name: &str| std::fs::read_to_string(root().join(format!("cli/tests/help/{name}.txt"))).ok();
    let is_name = |word: &&str| word.chars().all(|c| c.is_ascii_lowercase());
    // Global flags may stand before it, with values.
    let at = call.iter().position(|word| !word.starts_with("--") && word.parse::<usize>().is_err());
    let name = at.map(|at| call[at]).filter(is_name);
    let text = match name {
        // `raygrad COMMAND`, `raygrad = ...`, or the program alone.
        None if at.is_some() => return None,
        None => help("raygrad")?,
        Some("help") => return None,
        Some(name) => match help(name) {
            Some(text) => text,
            None => return Some(format!("`raygrad {name}` is not a subcommand")),
        },
    };
    let known = flags(&text);
    let mut given = call.iter().filter(|word| word.starts_with("--")).map(|word| word.split('=').next().unwrap());
    let wrong = given.find(|flag| !known.contains(flag) && *flag != "--")?;
    Some(format!("`raygrad {}` has no {wrong}", name.unwrap_or_default()))
}

/// Folders whose files code in documents names by path from the root.
const FOLDERS: [&str; 11] =
    ["cli/", "nerf/", "tensor/", "autograd/", "scenes/", "tests/", "examples/", "benches/", "docs/", ".ci/", "src/"];
/// Endings of files that may be named by the end of their path, such as `volume/rounds.rs`.
const ENDINGS: [&str; 6] = [".rs", ".md", ".py", ".toml", ".js", ".sh"];

/// The paths of files of the repository in a part of inline code.
fn paths(code: &str) -> Vec<&str> {
    let words = code.split_whitespace().map(|word| {
        let word = word.trim_matches(['(', ')', ',', ';', '"', '\'']).trim_end_matches('.');
        word.split([':', '#']).next().unwrap()
    });
    let is_path = |word: &&str| {
        let is_plain = word.chars().all(|c| c.is_ascii_alphanumeric() || "/._-".contains(c));
        let ends = word.contains('/') && ENDINGS.iter().any(|ending| word.ends_with(ending));
        is_plain && (ends || FOLDERS.iter().any(|folder| word.starts_with(folder)))
    };
    words.filter(is_path).collect()
}

/// What is wrong with a link, if anything.
fn check_link(file: &Path, target: &str) -> Option<String> {
    let (path, anchor) = target.split_once('#').map_or((target, None), |(path, anchor)| (path, Some(anchor)));
    let other = if path.is_empty() { file.to_path_buf() } else { normal(&file.with_file_name(path)) };
    if !root().join(&other).exists() {
        return Some(format!("`{target}`: there is no {}", other.display()));
    }
    let anchor = anchor?;
    if other.extension().is_none_or(|extension| extension != "md") {
        return None;
    }
    let known = anchors(&other, &read(&other)).iter().any(|own| own == anchor);
    (!known).then(|| format!("`{target}`: {} has no heading of this anchor", other.display()))
}

#[test]
fn documents_lines_fit_120_characters() {
    let mut findings = vec![];
    for file in pages() {
        for (i, (kind, line)) in lines(&read(&file)).into_iter().enumerate() {
            let width = line.chars().count();
            if kind != Kind::Code && width > WIDTH {
                findings.push(Finding { file: file.clone(), line: i + 1, what: format!("{width} characters") });
            }
        }
    }
    assert_none("Markdown lines have at most 120 characters", &findings);
}

#[test]
fn documents_sentences_fit_30_words() {
    let (mut findings, mut each) = (vec![], vec![]);
    let (mut all, mut written, mut manual) = <(Lengths, Lengths, Lengths)>::default();
    for file in pages() {
        let mut own = Lengths::default();
        let is_manual = file == Path::new("README.md") || file.starts_with("docs");
        for (line, paragraph) in paragraphs(&read(&file)) {
            for sentence in sentences(&paragraph) {
                let counts = [(&mut own, true), (&mut all, true), (&mut manual, is_manual)];
                counts.into_iter().filter(|(_, counts)| *counts).for_each(|(own, _)| own.add(&sentence, &file, line));
                if is_manual && !GENERATED.iter().any(|page| file == Path::new(page)) {
                    written.add(&sentence, &file, line);
                }
                let count = words(&sentence);
                if count > LONGEST {
                    let start: String = sentence.chars().take(60).collect();
                    findings.push(Finding { file: file.clone(), line, what: format!("{count} words: {start} ...") });
                }
            }
        }
        each.push(format!("  {}: {own}", file.display()));
    }
    println!("README.md and docs: {manual}\nthe same without generated pages: {written}\nall Markdown: {all}");
    println!("{}", each.join("\n"));
    assert_none("sentences have at most 30 words", &findings);
}

#[test]
fn documents_have_no_banned_phrase() {
    let mut findings = vec![];
    for file in pages() {
        let text = read(&file);
        let others =
            lines(&text).into_iter().enumerate().filter(|(_, (k, _))| matches!(k, Kind::Table | Kind::Heading));
        let others = others.map(|(i, (_, line))| (i + 1, line.to_owned()));
        for (line, text) in paragraphs(&text).into_iter().chain(others) {
            findings.extend(banned(&text).map(|phrase| Finding {
                file: file.clone(),
                line,
                what: format!("`{phrase}`"),
            }));
        }
    }
    assert_none("phrases to put plainly", &findings);
}

#[test]
fn documents_links_have_targets() {
    let (mut findings, mut count) = (vec![], 0);
    for file in pages() {
        for (line, target) in links(&read(&file)) {
            count += 1;
            findings.extend(check_link(&file, &target).map(|what| Finding { file: file.clone(), line, what }));
        }
    }
    println!("{count} relative links");
    assert_none("relative links and anchors exist", &findings);
    assert!(count > 0);
}

#[test]
fn documents_commands_and_flags_exist() {
    let (mut findings, mut count) = (vec![], 0);
    for file in current_pages() {
        let text = read(&file);
        for (line, code) in inline_code(&text).into_iter().chain(code_lines(&text)) {
            for call in program_calls(&code) {
                count += 1;
                findings.extend(check_call(&call).map(|what| Finding { file: file.clone(), line, what }));
            }
        }
    }
    println!("{count} calls of the program");
    assert_none("commands in documents are those of `raygrad --help`", &findings);
    assert!(count > 100, "{count}");
}

#[test]
fn documents_paths_in_code_exist() {
    let all: Vec<PathBuf> = ENDINGS.iter().flat_map(|ending| files(&ending[1..])).collect();
    let (mut findings, mut count) = (vec![], 0);
    for file in current_pages() {
        for (line, code) in inline_code(&read(&file)) {
            for path in paths(&code) {
                count += 1;
                let exists = root().join(path).exists() || all.iter().any(|own| own.ends_with(path));
                if !exists {
                    findings.push(Finding { file: file.clone(), line, what: format!("there is no {path}") });
                }
            }
        }
    }
    println!("{count} paths");
    assert_none("paths in inline code exist", &findings);
    assert!(count > 100, "{count}");
}

#[test]
fn documents_are_all_in_the_summary() {
    let summary = Path::new("docs/SUMMARY.md");
    let text = read(summary);
    let entries: Vec<(usize, PathBuf)> =
        links(&text).into_iter().map(|(line, target)| (line, normal(&summary.with_file_name(target)))).collect();
    let mut findings = vec![];
    let mut add = |line: usize, what: String| findings.push(Finding { file: summary.into(), line, what });
    for (i, (line, entry)) in entries.iter().enumerate() {
        if !root().join(entry).exists() {
            add(*line, format!("there is no {}", entry.display()));
        }
        if entries[..i].iter().any(|(_, other)| other == entry) {
            add(*line, format!("{} is in it twice", entry.display()));
        }
    }
    for page in pages().into_iter().filter(|file| file.starts_with("docs") && file != summary) {
        if !entries.iter().any(|(_, entry)| *entry == page) {
            add(1, format!("{} is not in it", page.display()));
        }
    }
    assert_none("the summary has each page of docs once", &findings);
}

/// Prints figures of the sources' documentation comments, without a rule.
#[test]
fn documents_in_rustdoc_are_counted() {
    let mut crates: Vec<(String, Lengths)> = vec![];
    let (mut all, mut phrases) = (Lengths::default(), 0);
    for file in files("rs").iter().filter(|file| file.components().any(|part| part.as_os_str() == "src")) {
        let mut block = String::new();
        let text = read(file);
        for line in text.lines() {
            let line = line.trim_start();
            let comment = line.strip_prefix("///").or_else(|| line.strip_prefix("//!"));
            // Code between two comments ends a paragraph, and every line counts.
            block += comment.unwrap_or_default();
            block.push('\n');
        }
        let first = file.components().take_while(|part| part.as_os_str() != "src").collect::<PathBuf>();
        let name = if first.as_os_str().is_empty() { "raygrad".to_owned() } else { first.display().to_string() };
        if crates.last().is_none_or(|(last, _)| *last != name) {
            crates.push((name, Lengths::default()));
        }
        for (line, paragraph) in paragraphs(&block) {
            phrases += banned(&paragraph).count();
            for sentence in sentences(&paragraph) {
                all.add(&sentence, file, line);
                crates.last_mut().unwrap().1.add(&sentence, file, line);
            }
        }
    }
    println!("rustdoc: {all}; {phrases} banned phrases");
    crates.iter().for_each(|(name, lengths)| println!("  {name}: {lengths}"));
    assert!(all.sentences > 1000);
}

#[test]
fn documents_parser_finds_sentences_and_anchors() {
    let text = "# A `b` [c](d.md), e_f!\n\nOne two\nthree. Four (et al. 2020) `five six. x`. [Six](x.md) seven\n\n- item one\n  \
                more.\n- item\n\n```\ncode here. And here.\n```\n\n| a table. |\n\n## A\n## A\n1. first\n> quoted\n";
    let found: Vec<String> = paragraphs(text).iter().flat_map(|(_, paragraph)| sentences(paragraph)).collect();
    let expected =
        ["One two three.", "Four (et al. 2020) code.", "Six seven", "item one more.", "item", "first quoted"];
    assert_eq!(found, expected);
    assert_eq!(anchors(Path::new("x.md"), text), ["a-b-c-e_f", "a", "a-1"]);
    assert_eq!(links(text), [(1, "d.md".to_owned()), (4, "x.md".to_owned())]);
    assert_eq!(lines(text).iter().filter(|(kind, _)| *kind == Kind::Code).count(), 3);
    assert_eq!(normal(Path::new("docs/a/../../README.md")), Path::new("README.md"));
    assert_eq!(banned("The scene Goes on; it goes once.").collect::<Vec<_>>(), ["goes on"]);
    assert!(check_link(Path::new("README.md"), "no/such.md").is_some());
    assert_eq!(check_link(Path::new("docs/x.md"), "../Cargo.toml"), None);
    // Calls of the program.
    let calls = program_calls("cargo run -p raygrad # raygrad x\n");
    assert!(calls.iter().all(|call| call == &["x"]), "{calls:?}");
    assert_eq!(
        program_calls("A=1 raygrad train x --steps 5 | raygrad eval"),
        [vec!["train", "x", "--steps", "5"], vec!["eval"]]
    );
    let said = |code: &str| program_calls(code).iter().find_map(|call| check_call(call));
    for right in ["raygrad", "raygrad --threads 2 train --view", "raygrad export R x.html", "raygrad = { path }"] {
        assert_eq!(said(right), None, "{right}");
    }
    assert_eq!(said("raygrad fly").unwrap(), "`raygrad fly` is not a subcommand");
    assert_eq!(said("raygrad train x --step=5").unwrap(), "`raygrad train` has no --step");
    assert_eq!(said("raygrad --thread 5").unwrap(), "`raygrad ` has no --thread");
    let text = "a `b c` d `e`\n\n```sh\nraygrad train \\\n  --step 5\nx\n```\n";
    assert_eq!(inline_code(text), [(1, "b c".to_owned()), (1, "e".to_owned())]);
    assert_eq!(code_lines(text)[1..3], [(4, "raygrad train   --step 5".to_owned()), (6, "x".to_owned())]);
    assert_eq!(paths("cargo x a/b.rs:5 (cli/src) c.rs x/*.rs http://y.md/a.md"), ["a/b.rs", "cli/src"]);
}
