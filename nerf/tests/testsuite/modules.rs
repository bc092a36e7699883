//! Layers: a module uses only modules before it, and no files use each other in a cycle.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// The modules in the order of the layers. A module uses none of a later line.
const ROOMS: [&str; 22] = [
    "error",
    "range",
    "random",
    "files",
    "memory",
    "numbers",
    "camera",
    "dataset",
    "doctor",
    "imaging",
    "encoding",
    "space",
    "component",
    "field",
    "volume",
    "sampling",
    "losses",
    "analytic",
    "model",
    "rendering",
    "geometry",
    "training",
];
/// Files that only collect items of others.
const GATHERING: [&str; 3] = ["lib.rs", "catalogue.rs", "compiled.rs"];

/// The code of a file without comments and without tests.
fn code(file: &Path) -> String {
    let text = std::fs::read_to_string(file).unwrap();
    let tests = ["mod tests {", "pub(crate) mod tests {"].map(|tests| text.find(&format!("#[cfg(test)]\n{tests}")));
    let text = &text[..tests.into_iter().flatten().min().unwrap_or(text.len())];
    text.lines().map(|line| line.split("//").next().unwrap()).collect::<Vec<_>>().join("\n")
}

/// All files without tests, by module, such as `["space", "occupancy", "march"]`.
fn modules(root: &Path) -> BTreeMap<Vec<String>, PathBuf> {
    let (mut found, mut folders) = (BTreeMap::new(), vec![root.to_path_buf()]);
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(root).unwrap().with_extension("");
            let mut module: Vec<String> = name.iter().map(|part| part.to_str().unwrap().to_owned()).collect();
            if path.is_dir() {
                folders.push(path);
            } else if !module.iter().any(|part| part == "tests")
                && !GATHERING.contains(&path.file_name().unwrap().to_str().unwrap())
            {
                module.pop_if(|last| last == "mod");
                found.insert(module, path);
            }
        }
    }
    found
}

/// The paths of a `use` tree: `a::{b, c::d}` is `a::b` and `a::c::d`.
fn leaves(tree: &str) -> Vec<String> {
    let tree = tree.trim();
    let Some(open) = tree.find('{') else {
        return vec![tree.split(" as ").next().unwrap().trim().to_owned()];
    };
    let (prefix, inner) = (&tree[..open], &tree[open + 1..tree.rfind('}').unwrap()]);
    let (mut depth, mut parts) = (0, vec![String::new()]);
    for c in inner.chars() {
        match c {
            ',' if depth == 0 => parts.push(String::new()),
            _ => {
                depth += i32::from(c == '{') - i32::from(c == '}');
                parts.last_mut().unwrap().push(c);
            }
        }
    }
    let parts = parts.iter().filter(|part| !part.trim().is_empty());
    parts.flat_map(|part| leaves(part)).map(|leaf| format!("{prefix}{leaf}")).collect()
}

/// Every path in a file, from `use` and elsewhere. Names of `pub use` are returned separately.
fn paths(code: &str) -> (Vec<String>, Vec<String>) {
    let (mut own, mut handed, mut rest) = (vec![], vec![], String::new());
    for statement in code.split_inclusive(';') {
        let at = ["pub(crate) use ", "pub use ", "use "].into_iter().filter_map(|word| {
            let at = statement.match_indices(word).map(|(at, _)| at);
            // Only at the start of a line: elsewhere the word is part of a message.
            let starts = |at: &usize| statement[..*at].trim_end_matches(' ').ends_with('\n') || *at == 0;
            Some((at.into_iter().find(starts)?, word))
        });
        let Some((at, word)) = at.min_by_key(|(at, _)| *at) else {
            rest += statement;
            continue;
        };
        rest += &statement[..at];
        let list = if word.starts_with("pub") { &mut handed } else { &mut own };
        list.extend(leaves(statement[at + word.len()..].trim_end_matches(';')));
    }
    let is_path = |c: char| c.is_alphanumeric() || c == '_' || c == ':';
    own.extend(rest.split(|c| !is_path(c)).filter(|path| path.contains("::")).map(str::to_owned));
    (own, handed)
}

/// Resolves paths from within a module to the modules of their items.
struct House {
    files: BTreeMap<Vec<String>, PathBuf>,
    /// For each module, the names that it re-exports from its children.
    handed: BTreeMap<Vec<String>, BTreeMap<String, Vec<String>>>,
}

impl House {
    fn resolve(&self, from: &[String], path: &str) -> Option<Vec<String>> {
        let mut module = from.to_vec();
        let mut parts = path.split("::").map(str::trim).peekable();
        match *parts.peek()? {
            "crate" => {
                module.clear();
                parts.next();
            }
            "self" => drop(parts.next()),
            "super" => {
                while parts.next_if_eq(&"super").is_some() {
                    module.pop();
                }
            }
            // A child of this module, or a name of another crate.
            child => {
                let mut inner = module.clone();
                inner.push(child.to_owned());
                self.files.get(&inner)?;
            }
        }
        for part in parts {
            let mut inner = module.clone();
            inner.push(part.to_owned());
            if self.files.contains_key(&inner) {
                module = inner;
            } else if let Some(target) = self.handed.get(&module).and_then(|handed| handed.get(part)) {
                return Some(target.clone());
            } else if module.is_empty() {
                let is_error = matches!(part, "Error" | "Result");
                assert!(is_error, "{from:?} takes `{path}` from the root");
                return is_error.then(|| vec!["error".to_owned()]);
            } else {
                break;
            }
        }
        (module != from && !module.is_empty()).then_some(module)
    }
}

/// The modules that each module uses.
fn uses() -> BTreeMap<Vec<String>, BTreeSet<Vec<String>>> {
    let files = modules(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"));
    let mut house = House { files, handed: BTreeMap::new() };
    let found: Vec<_> = house.files.iter().map(|(module, file)| (module.clone(), paths(&code(file)))).collect();
    for (module, (_, handed)) in &found {
        let pairs = handed.iter().filter_map(|path| {
            let target = house.resolve(module, path)?;
            Some((path.rsplit("::").next()?.to_owned(), target))
        });
        let pairs = pairs.collect();
        house.handed.insert(module.clone(), pairs);
    }
    let of = |(module, (own, _)): (Vec<String>, (Vec<String>, Vec<String>))| {
        let targets = own.iter().filter_map(|path| house.resolve(&module, path)).filter(|target| *target != module);
        let targets = targets.collect();
        (module, targets)
    };
    found.into_iter().map(of).collect()
}

#[test]
fn modules_use_earlier_modules_alone() {
    let place = |module: &[String]| ROOMS.iter().position(|room| *room == module[0]);
    let mut count = 0;
    for (module, targets) in uses() {
        let own = place(&module).unwrap_or_else(|| panic!("{module:?} is in no room of this list"));
        for target in targets {
            assert!(place(&target).unwrap() <= own, "{} uses {}", module.join("::"), target.join("::"));
            count += 1;
        }
    }
    assert!(count > 150, "the test sees {count} uses");
}

#[test]
fn modules_have_no_cycles() {
    let mut uses = uses();
    // Modules without uses are in no cycle.
    loop {
        let done: Vec<_> =
            uses.iter().filter(|(_, targets)| targets.is_empty()).map(|(module, _)| module.clone()).collect();
        if done.is_empty() {
            break;
        }
        uses.retain(|module, _| !done.contains(module));
        uses.values_mut().for_each(|targets| targets.retain(|target| !done.contains(target)));
    }
    // Modules without users are in no cycle either.
    loop {
        let used: BTreeSet<_> = uses.values().flatten().cloned().collect();
        let before = uses.len();
        uses.retain(|module, _| used.contains(module));
        if uses.len() == before {
            break;
        }
    }
    let left: Vec<_> = uses.iter().map(|(module, targets)| format!("{module:?} uses {targets:?}")).collect();
    assert!(left.is_empty(), "circles:\n{}", left.join("\n"));
}
