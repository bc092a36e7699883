//! `docs/reference/commands.md`: every command and flag, from clap's definitions.

use std::collections::HashSet;
use std::fmt::Write;

use clap::{Arg, ArgAction, Command, CommandFactory};

use super::{compare, markdown, sentence, wrap};
use crate::Cli;
use crate::tests::commands;

/// The syntax of an argument.
fn usage(arg: &Arg) -> String {
    // Styles are for terminals. Without them, `to_string` gives plain text.
    let text = arg.to_string();
    match arg.get_short() {
        Some(short) if arg.get_long().is_some() => format!("-{short}, {text}"),
        _ => text,
    }
}

/// The error message for this value of an argument; `None` if the value is valid.
fn refusal(command: &str, arg: &Arg, value: &str) -> Option<String> {
    let flag = format!("--{}={value}", arg.get_long()?);
    let words: Vec<&str> = if command == "raygrad" { vec!["raygrad"] } else { vec!["raygrad", command] };
    let error = Cli::command().try_get_matches_from(words.into_iter().chain([flag.as_str()])).err()?.to_string();
    let text = error.lines().next()?.strip_prefix("error: invalid value ")?;
    Some(text.split_once("': ")?.1.to_owned())
}

/// Converts `0 is not in 1..=1024` to `1 to 1024`.
fn range(refused: &str) -> Option<String> {
    let (_, range) = refused.split_once(" is not in ")?;
    let (low, high) = range.split_once("..")?;
    let high = high.trim_start_matches('=');
    let is_open = high.is_empty() || high == u64::MAX.to_string() || high == u32::MAX.to_string();
    Some(if is_open { format!("{low} or more") } else { format!("{low} to {high}") })
}

/// The valid values of a flag in words, from its definition or from its parser's error message.
fn values(command: &str, arg: &Arg) -> Option<String> {
    if let Some(range) = ["0", "99999999999999999999", "18446744073709551615", "4000000000"]
        .iter()
        .find_map(|value| range(&refusal(command, arg, value)?))
    {
        return Some(format!("Range: {range}"));
    }
    let refused = refusal(command, arg, "!")?;
    Some(match refused.as_str() {
        "invalid digit found in string" => "Value: an integer of 0 or more".into(),
        "invalid float literal" => "Value: a number".into(),
        text => {
            // "`skip`: there is no `!`; use off or fast", "`background`: must be white or black, is `!`".
            let text = text.split_once("`: ").filter(|(name, _)| name.starts_with('`')).map_or(text, |(_, what)| what);
            let text = text.split_once("; use ").map_or(text, |(_, values)| values);
            let text = ["write ", "use ", "must be ", "`!` is not "]
                .iter()
                .fold(text, |text, word| text.trim_start_matches(word));
            format!("Value: {}", text.trim_end_matches(", is `!`"))
        }
    })
}

/// The name of a flag without its value, or of an argument.
fn name(arg: &Arg) -> String {
    arg.get_long().map_or_else(|| usage(arg), |long| format!("--{long}"))
}

/// Facts about an argument as short sentences. `said` and `default` are the range and the default in its description.
fn facts(command: &Command, arg: &Arg, said: Option<&str>, default: Option<String>) -> Vec<String> {
    let mut facts = vec![];
    let possible: Vec<String> = arg.get_possible_values().iter().map(|v| format!("`{}`", v.get_name())).collect();
    let takes_value = arg.get_action().takes_values();
    let values = values(command.get_name(), arg).filter(|_| takes_value && possible.is_empty());
    match (said, values) {
        (Some(said), Some(values)) if values.starts_with("Range: ") => {
            let what = format!("{} {}: the help says `{said}`", command.get_name(), usage(arg));
            assert_eq!(format!("Range: {said}"), values, "{what}");
            facts.push(values);
        }
        (Some(said), _) => facts.push(format!("Range: {said}")),
        (None, Some(values)) => facts.push(values.replace('<', "\\<")),
        (None, None) => {}
    }
    if takes_value && !possible.is_empty() {
        facts.push(format!("Values: {}", possible.join(", ")));
    }
    let defaults: Vec<String> = arg.get_default_values().iter().map(|v| format!("`{}`", v.to_string_lossy())).collect();
    let default = default.or_else(|| (takes_value && !defaults.is_empty()).then(|| defaults.join(", ")));
    facts.extend(default.map(|default| format!("Default: {default}")));
    if matches!(arg.get_action(), ArgAction::Append) && !arg.is_positional() {
        facts.push("May be given several times".into());
    }
    if arg.is_required_set() {
        facts.push("Required".into());
    }
    // clap lists a conflict for one of the two flags only.
    let own = command.get_arg_conflicts_with(arg);
    let conflicts = command.get_arguments().filter(|other| {
        own.iter().any(|own| own.get_id() == other.get_id())
            || command.get_arg_conflicts_with(other).iter().any(|other| other.get_id() == arg.get_id())
    });
    let conflicts: Vec<String> = conflicts.map(|other| format!("`{}`", name(other))).collect();
    if !conflicts.is_empty() {
        facts.push(format!("Not with {}", conflicts.join(", ")));
    }
    facts
}

/// The description: the short line, then the rest.
fn description(short: Option<String>, long: Option<String>) -> Vec<String> {
    let text = long.or(short).unwrap_or_default();
    let mut paragraphs: Vec<String> = text.split("\n\n").map(|p| p.replace('\n', " ").trim().to_owned()).collect();
    if let Some(first) = paragraphs.first_mut() {
        *first = sentence(first);
    }
    paragraphs.retain(|paragraph| !paragraph.is_empty());
    paragraphs
}

fn entry(command: &Command, arg: &Arg) -> String {
    let text = description(arg.get_help().map(|s| s.to_string()), arg.get_long_help().map(|s| s.to_string()));
    // Ranges and defaults in the text become facts.
    let mut text = text.join(" ");
    let mut take = |before: &str, after: &str| {
        let (start, rest) = text.split_once(before)?;
        let (fact, end) = rest.split_once(after).unwrap_or((rest, ""));
        let (fact, left) = (fact.to_owned(), format!("{} {}", sentence(start), end.trim_start_matches('.').trim()));
        text = left.trim().to_owned();
        Some(fact)
    };
    let (default, range) = (take("[default: ", "]"), take("Range: ", ". "));
    let facts = facts(command, arg, range.as_deref().map(|range| range.trim_end_matches('.')), default);
    let mut page = wrap("", "", &format!("**`{}`**", usage(arg)));
    page.push('\n');
    page += &wrap("", "", &markdown(&text));
    if !facts.is_empty() {
        page.push('\n');
        for fact in facts {
            page += &wrap("- ", "  ", &sentence(&fact));
        }
    }
    page.push('\n');
    page
}

/// Returns true for `--help` and `--version`.
fn is_own_help(arg: &Arg) -> bool {
    matches!(arg.get_id().as_str(), "help" | "version")
}

fn page() -> String {
    let mut page = "# Commands\n\n".to_owned();
    page += &wrap(
        "",
        "",
        "Every command and every flag of `raygrad`. This page is generated from the definitions in the program; \
         `UPDATE_SNAPSHOTS=1 cargo test -p raygrad-cli --bin raygrad reference` writes it. In a terminal, `-h` prints one line \
         per option, and `--help` all text.",
    );
    page += "\n| command | does |\n|---|---|\n";
    let all = commands();
    for command in &all[1..] {
        let name = command.get_name();
        let about = command.get_about().map(|s| s.to_string()).unwrap_or_default();
        writeln!(page, "| [`{name}`](#raygrad-{name}) | {} |", sentence(&about)).unwrap();
    }
    page += "| `help` | Prints the help of a command. |\n\n";
    for command in &all {
        let name = command.get_name();
        let title = if name == "raygrad" { name.to_owned() } else { format!("raygrad {name}") };
        write!(page, "## {title}\n\n").unwrap();
        let about =
            description(command.get_about().map(|s| s.to_string()), command.get_long_about().map(|s| s.to_string()));
        for paragraph in about {
            page += &wrap("", "", &markdown(&paragraph));
            page.push('\n');
        }
        let usage = command.clone().render_usage().to_string();
        write!(page, "```text\n{}\n```\n\n", usage.trim()).unwrap();
        let args: Vec<&Arg> = command.get_arguments().filter(|arg| !is_own_help(arg) && !arg.is_hide_set()).collect();
        let shown: Vec<&Arg> = args.iter().copied().filter(|arg| arg.is_positional()).collect();
        if !shown.is_empty() {
            page += "### Arguments\n\n";
            shown.iter().for_each(|arg| page += &entry(command, arg));
        }
        let is_global = |arg: &Arg| name != "raygrad" && arg.get_id() == "threads";
        let flags: Vec<&Arg> = args.iter().copied().filter(|arg| !arg.is_positional() && !is_global(arg)).collect();
        let mut headings: Vec<&str> = flags.iter().map(|arg| arg.get_help_heading().unwrap_or("Options")).collect();
        let mut seen = HashSet::new();
        headings.retain(|heading| seen.insert(*heading));
        for heading in headings {
            write!(page, "### {heading}\n\n").unwrap();
            let group = flags.iter().filter(|arg| arg.get_help_heading().unwrap_or("Options") == heading);
            group.for_each(|arg| page += &entry(command, arg));
        }
        if name == "raygrad" {
            let after = command.get_after_help().map(|s| s.to_string()).unwrap_or_default();
            page += "### Exit codes\n\n| code | meaning |\n|---|---|\n";
            for line in after.lines().skip(1) {
                let (code, meaning) = line.trim().split_once(' ').unwrap();
                writeln!(page, "| {code} | {} |", meaning.trim()).unwrap();
            }
            page.push('\n');
        }
    }
    page.trim_end().to_owned() + "\n"
}

#[test]
fn commands_page_equals_generated_text() {
    compare("commands.md", &page());
}

#[test]
fn commands_page_contains_every_flag() {
    let page = page();
    for command in commands() {
        for arg in command.get_arguments().filter(|arg| !is_own_help(arg) && !arg.is_hide_set()) {
            assert!(page.contains(&format!("**`{}`**", usage(arg))), "{}: {}", command.get_name(), usage(arg));
        }
    }
}
