//! Finds the files of a capture that was moved or renamed after its description was written.
//!
//! A listed path counts as it stands. If no file of a listed folder exists, the folder with the longest common end of
//! the path takes its place. Letter case, Unicode normal form and the extension of an image may differ. Two folders or
//! files that fit equally well are an error.

use super::paths::{self, any_extension, composed, extension, folded, usual_extension};
use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::ffi::{OsStr, OsString};
use std::fs::{DirEntry, FileType};
use std::path::{Component, Path, PathBuf};

/// The deepest folder that is searched, and the most entries.
pub(in crate::dataset) const DEEPEST: usize = 8;
const MOST_ENTRIES: usize = 200_000;

/// Names of folders with the images of a split. Those of one split never take the place of another's.
const SPLITS: [&str; 4] = ["train", "val", "eval", "test"];
/// Words in the names of folders with other files than images.
const LAYERS: [&str; 12] = [
    "mask",
    "depth",
    "normal",
    "segment",
    "confidence",
    "alpha",
    "label",
    "dispar",
    "semantic",
    "instance",
    "thumb",
    "preview",
];
/// Further ones, which may be parts of other words.
const LAYER_WORDS: [&str; 6] = ["seg", "flow", "edge", "edges", "matte", "mattes"];
/// Returns true for the name of a folder with other files than images, such as masks or depths.
pub fn is_layer(name: &str) -> bool {
    let name = folded(name);
    LAYERS.iter().any(|layer| name.contains(layer)) || words(&name).any(|word| LAYER_WORDS.contains(&word))
}

/// The last parts of a listed path that state its kind; those before are the user's.
const STATED: usize = 2;

/// A file of a capture.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Located {
    pub(super) path: PathBuf,
    /// The factor of a folder of downscaled images, such as `images_4`, that took the place of `images`; otherwise 1.
    pub(super) factor: usize,
}

/// A name's index and a message.
pub(super) type Ambiguity = (usize, String);

/// Finds the files with these names, relative to `folder`; `None` for those that do not exist. Files of `taken` belong
/// to others, such as masks.
///
/// Adds a sentence to `assumptions` for each listed folder whose files were found elsewhere.
///
/// # Errors
/// If two files fit a name, or a file fits two names.
pub(super) fn locate(
    folder: &Path,
    names: &[&str],
    taken: &HashSet<PathBuf>,
    assumptions: &mut Vec<String>,
) -> Result<Vec<Option<Located>>, Ambiguity> {
    let mut listings: HashMap<&str, Directory> = HashMap::new();
    let all: HashSet<&str> = names.iter().copied().collect();
    for (i, name) in names.iter().enumerate().filter(|(_, name)| any_extension(name).is_none()) {
        let [place, last] = split(name);
        let directory = listings.entry(place).or_insert_with(|| Directory::read(folder, Path::new(place)));
        let files =
            directory.with_ending(last).into_iter().map(|file| directory.inside.join(file).display().to_string());
        if let [one, two, ..] = &files.filter(|file| !all.contains(file.as_str())).collect::<Vec<_>>()[..] {
            return Err((i, format!("`{name}` has no ending, and `{one}` and `{two}` fit: write the ending")));
        }
    }
    let exact = |name: &&str| paths::find(folder, name).map(|path| Located { path, factor: 1 });
    let mut found: Vec<Option<Located>> = names.iter().map(exact).collect();
    let listed: Vec<[&str; 2]> = names.iter().map(|name| split(name)).collect();
    let existing: HashSet<&str> = (0..names.len()).filter(|&i| found[i].is_some()).map(|i| listed[i][0]).collect();
    let mut groups: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    for i in (0..names.len()).filter(|&i| found[i].is_none()) {
        groups.entry(listed[i][0]).or_default().push(i);
    }
    // Files with an owner take no other name's place.
    let exact: HashSet<PathBuf> = found.iter().flatten().map(|file| file.path.clone()).collect();
    let is_free = |path: &PathBuf| !exact.contains(path) && !taken.contains(path);
    let mut owners: HashMap<PathBuf, usize> = HashMap::new();
    let mut tree = None;
    for (place, group) in groups {
        // Images with another extension, in a folder of which others exist as listed, are others.
        let is_there = existing.contains(place);
        let own;
        let directories = if is_there {
            own = Directory::read(folder, Path::new(place));
            vec![&own]
        } else {
            let names: Vec<&str> = group.iter().map(|&i| listed[i][1]).collect();
            tree.get_or_insert_with(|| Tree::new(folder)).best(place, &names)
        };
        let (mut first, mut count) = (None, 0);
        let own: HashSet<&OsStr> = group.iter().map(|&i| listed[i][1].as_ref()).collect();
        for i in group {
            let of = |directory: &'_ Directory| -> Option<(usize, Vec<PathBuf>)> {
                let (rule, files) = directory.of(listed[i][1], !is_there)?;
                // A file with another's exact name is that one's.
                let files = files.into_iter().filter(|file| *file == listed[i][1] || !own.contains(file.as_os_str()));
                let files = files.map(|file| directory.inside.join(file));
                Some((rule, files.filter(|file| is_free(&folder.join(file))).collect()))
            };
            let rated: Vec<(usize, Vec<PathBuf>)> = directories.iter().filter_map(|directory| of(directory)).collect();
            let best = rated.iter().filter(|(_, files)| !files.is_empty()).map(|(rule, _)| *rule).min();
            let fitting = rated.into_iter().filter(|(rule, _)| Some(*rule) == best);
            let mut fitting: Vec<PathBuf> = fitting.flat_map(|(_, files)| files).collect();
            let Some(file) = fitting.pop() else { continue };
            if let Some(other) = fitting.pop() {
                let [one, two] = [&other, &file].map(|path| path.display().to_string());
                let form = other_form(&one, &two);
                let what = format!("`{}` does not exist; `{one}` and `{two}`{form} fit: correct the path", names[i]);
                return Err((i, what));
            }
            if let Some(&other) = owners.get(&file).filter(|&&other| names[other] != names[i]) {
                let (one, two, file) = (names[other], names[i], file.display());
                let what = format!("`{one}` and `{two}` do not exist; `{file}` fits both: correct the paths");
                return Err((i, what));
            }
            owners.insert(file.clone(), i);
            first.get_or_insert_with(|| (i, file.display().to_string()));
            count += 1;
            found[i] = Some(Located { path: folder.join(&file), factor: factor_of(&file) });
        }
        if let Some((i, file)) = first {
            let rest = match count - 1 {
                0 => String::new(),
                1 => ", and 1 file likewise".to_owned(),
                others => format!(", and {others} files likewise"),
            };
            let form = other_form(names[i], &file);
            assumptions.push(format!("`{}` does not exist: used `{file}`{form}{rest}", names[i]));
        }
    }
    Ok(found)
}

/// Names of image folders.
pub(super) const IMAGES: [&str; 4] = ["images", "image", "rgb", "input"];

/// The folders in `root` with these names in any case, in the order of the names; exact names come first.
pub(super) fn folders(root: &Path, names: &[&str]) -> Vec<PathBuf> {
    let rated = |entry: DirEntry| {
        let name = entry.file_name();
        let place = names.iter().position(|own| name.eq_ignore_ascii_case(own))?;
        entry.path().is_dir().then(|| (place, name != names[place], entry.path()))
    };
    let mut found: Vec<_> = std::fs::read_dir(root).into_iter().flatten().flatten().filter_map(rated).collect();
    found.sort();
    found.into_iter().map(|(.., path)| path).collect()
}

/// A path below a folder, which is `.` itself.
pub(super) fn shown(inside: &Path) -> String {
    if inside.as_os_str().is_empty() { ".".to_owned() } else { inside.display().to_string() }
}

/// A path's folder and file name.
fn split(path: &str) -> [&str; 2] {
    let (place, name) = path.rsplit_once('/').unwrap_or(("", path));
    [place, name]
}

/// Says that two paths look alike, but their characters differ.
fn other_form(one: &str, two: &str) -> &'static str {
    if one != two && folded(one) == folded(two) && one.to_lowercase() != two.to_lowercase() {
        " (in another Unicode normal form)"
    } else {
        ""
    }
}

/// A folded file name, without the extension of an image in any format.
pub(super) fn stem(name: &str) -> String {
    let ending = any_extension(name).map_or(0, |ending| ending.len() + 1);
    folded(&name[..name.len() - ending])
}

/// The paths that fit a name best: the name itself, or else paths that end in it, or else those without their extension,
/// or else paths that it ends in, or else any of these in another case or with another extension of images.
pub(in crate::dataset) fn fitting<'a>(paths: impl Iterator<Item = &'a str> + Clone, name: &str) -> Vec<&'a str> {
    let is_end =
        |path: &str, end: &str| path.strip_suffix(end).is_some_and(|rest| rest.is_empty() || rest.ends_with('/'));
    let rules: [&dyn Fn(&str) -> bool; 5] = [
        &|path| path == name,
        &|path| is_end(path, name),
        &|path| path.rsplit_once('.').is_some_and(|(stem, _)| is_end(stem, name)),
        &|path| is_end(name, path),
        &|path| {
            let [path, name] = [path, name].map(stem);
            is_end(&path, &name) || is_end(&name, &path)
        },
    ];
    let of = |rule: &dyn Fn(&str) -> bool| -> Vec<&'a str> { paths.clone().filter(|path| rule(path)).collect() };
    rules.into_iter().map(of).find(|paths| !paths.is_empty()).unwrap_or_default()
}

/// The files of a folder.
#[derive(Clone)]
pub(super) struct Directory {
    /// The path below the capture's folder.
    pub(super) inside: PathBuf,
    /// The names of the files with a stem.
    files: HashMap<String, Vec<OsString>>,
}

impl Directory {
    fn new(inside: PathBuf, names: Vec<OsString>) -> Self {
        let mut files: HashMap<String, Vec<OsString>> = HashMap::new();
        for name in names {
            files.entry(stem(&name.to_string_lossy())).or_default().push(name);
        }
        Directory { inside, files }
    }

    /// Reads a single folder, which counts as empty if it cannot be read.
    fn read(folder: &Path, inside: &Path) -> Self {
        let entries = std::fs::read_dir(folder.join(inside)).into_iter().flatten().flatten().take(MOST_ENTRIES);
        let files = entries.filter(|entry| !is_hidden(&entry.file_name()) && is_file(entry));
        let mut names: Vec<OsString> = files.map(|entry| entry.file_name()).collect();
        names.sort();
        Directory::new(inside.to_owned(), names)
    }

    /// The names of the files, sorted.
    pub(super) fn names(&self) -> Vec<&OsString> {
        let mut names: Vec<&OsString> = self.files.values().flatten().collect();
        names.sort();
        names
    }

    /// The files of a name without an ending: one of each decoded format, unless a file has the name itself.
    fn with_ending(&self, name: &str) -> Vec<&OsString> {
        let all = self.files.get(&stem(name)).map_or(&[][..], Vec::as_slice);
        if all.iter().any(|file| file == name) {
            return vec![];
        }
        let mut endings = HashSet::new();
        let is_new = |file: &&OsString| {
            let file = file.to_string_lossy();
            let ending = usual_extension(&file).filter(|ending| file[..file.len() - ending.len() - 1] == *name);
            ending.is_some_and(|ending| endings.insert(ending.to_lowercase()))
        };
        all.iter().filter(is_new).collect()
    }

    /// The number of the rule by which files fit a name best, and the files: of the same name, or else in another Unicode normal form, or else in other
    /// letter case, or else, if `others` is true, with the extension of another image format: of a usual one, or
    /// else of one that is decoded, or else of any.
    fn of(&self, name: &str, others: bool) -> Option<(usize, Vec<&OsString>)> {
        let all = self.files.get(&stem(name)).map_or(&[][..], Vec::as_slice);
        let fits = |test: &dyn Fn(&str) -> bool| -> Vec<&OsString> {
            all.iter().filter(|file| test(&file.to_string_lossy())).collect()
        };
        let rules: [&dyn Fn(&str) -> bool; 6] = [
            &|file| file == name,
            &|file| composed(file) == composed(name),
            &|file| folded(file) == folded(name),
            &|file| others && usual_extension(file).is_some(),
            &|file| others && extension(file).is_some(),
            &|file| others && any_extension(file).is_some(),
        ];
        rules.into_iter().map(fits).enumerate().find(|(_, files)| !files.is_empty())
    }
}

/// Returns true for a file or a link to one. Only links cost a look at the file.
fn is_file(entry: &DirEntry) -> bool {
    entry.file_type().is_ok_and(|kind| kind.is_file() || kind.is_symlink() && entry.path().is_file())
}

fn is_hidden(name: &OsStr) -> bool {
    name.as_encoded_bytes().starts_with(b".")
}

/// All folders of a capture, itself included, in the order of their paths. Hidden entries are left out.
struct Tree {
    /// The parts of the path of the capture's folder.
    root: Vec<String>,
    directories: Vec<Directory>,
    /// The indices of the folders with a stem.
    holders: HashMap<String, Vec<usize>>,
}

impl Tree {
    fn new(folder: &Path) -> Self {
        let root = parts(&std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned()));
        let directories = walk(folder, DEEPEST);
        let mut holders: HashMap<String, Vec<usize>> = HashMap::new();
        for (i, directory) in directories.iter().enumerate() {
            directory.files.keys().for_each(|stem| holders.entry(stem.clone()).or_default().push(i));
        }
        Tree { root, directories, holders }
    }

    /// The folders for the names of the listed folder `place`, whose paths have the longest common end with it; several
    /// if they are equally long. Without a common part, a folder must hold most names.
    ///
    /// A folder `images_4` counts as `images`, after folders of full size; the least downscaled counts. If no folder fits,
    /// those of several splits together count as the folder around them.
    fn best(&self, place: &str, names: &[&str]) -> Vec<&Directory> {
        let mut counts: BTreeMap<usize, usize> = BTreeMap::new();
        for name in names {
            for holder in self.holders.get(&stem(name)).into_iter().flatten() {
                *counts.entry(*holder).or_default() += 1;
            }
        }
        let (wanted, all) = (wanted(place), counts.values().sum());
        let is_split = |part: &String| SPLITS.contains(&part.as_str());
        let around = |directory: &Directory| {
            let mut own = parts(&directory.inside);
            own.retain(|part| !is_split(part));
            own
        };
        // The folders with the highest rating: by their own path, or by the one around their split.
        let highest = |by_split: bool| {
            let rate = |directory: &Directory, count: usize| {
                let own = if by_split { around(directory) } else { parts(&directory.inside) };
                let path = self.root.iter().chain(&own);
                let common = path.rev().zip(wanted.iter().rev()).take_while(|(a, b)| a == b).count();
                (is_of_kind(&own, &wanted) && (common > 0 || 2 * count > names.len()))
                    .then_some((common, Reverse(factor_of(&directory.inside))))
            };
            let holders = counts.iter().map(|(i, count)| (&self.directories[*i], if by_split { all } else { *count }));
            let rated: Vec<_> = holders.filter_map(|(holder, count)| Some((rate(holder, count)?, holder))).collect();
            let most = rated.iter().map(|(rating, _)| *rating).max();
            rated.into_iter().filter(|(rating, _)| Some(*rating) == most).map(|(_, holder)| holder).collect::<Vec<_>>()
        };
        let found = highest(false);
        if !found.is_empty() || wanted.iter().any(is_split) {
            return found;
        }
        let found = highest(true);
        let splits: HashSet<Option<String>> =
            found.iter().map(|directory| parts(&directory.inside).into_iter().find(is_split)).collect();
        // A single split may be another one than that of the names, and several captures may have some.
        let is_whole = splits.len() > 1 && found.iter().all(|directory| around(directory) == around(found[0]));
        if is_whole { found } else { vec![] }
    }
}

/// The folded parts of a listed folder.
fn wanted(place: &str) -> Vec<String> {
    place.split('/').filter(|part| !matches!(*part, "" | "." | "..")).map(lower).collect()
}

/// Returns true if the files of a folder may be those of a listed one: of the same splits and layers.
fn is_of_kind(own: &[String], wanted: &[String]) -> bool {
    let splits = |parts: &[String]| SPLITS.map(|split| parts.iter().any(|part| words(part).any(|word| word == split)));
    let layers = |parts: &[String]| {
        let parts = || parts.iter().map(String::as_str);
        let contained = LAYERS.map(|layer| parts().any(|part| part.contains(layer)));
        (contained, LAYER_WORDS.map(|layer| parts().any(|part| words(part).any(|word| word == layer))))
    };
    let stated = layers(&wanted[wanted.len().saturating_sub(STATED)..]);
    splits(own).iter().zip(splits(wanted)).all(|(own, wanted)| *own <= wanted) && layers(own) == stated
}

/// All folders at most `deepest` below `folder`, itself included, in the order of their paths, without hidden ones.
pub(super) fn walk(folder: &Path, deepest: usize) -> Vec<Directory> {
    let (mut out, mut seen, mut entries) = (vec![], HashSet::new(), 0);
    let mut waiting = VecDeque::from([(PathBuf::new(), 0)]);
    while let Some((inside, depth)) = waiting.pop_front() {
        let here = folder.join(&inside);
        // Links may form cycles. They come last, so that folders keep their own names.
        if !here.canonicalize().is_ok_and(|path| seen.insert(path)) {
            continue;
        }
        let mut names = vec![];
        for entry in std::fs::read_dir(&here).into_iter().flatten().flatten() {
            entries += 1;
            // Of a larger folder, a file that fits might not be the only one.
            if entries > MOST_ENTRIES {
                return vec![];
            }
            let name = entry.file_name();
            if is_hidden(&name) {
                continue;
            }
            let is = |test: fn(&FileType) -> bool| entry.file_type().is_ok_and(|kind| test(&kind));
            if is_file(&entry) {
                names.push(name);
            } else if is(FileType::is_symlink) && depth < deepest {
                waiting.push_back((inside.join(name), depth + 1));
            } else if is(FileType::is_dir) && depth < deepest {
                waiting.push_front((inside.join(name), depth + 1));
            }
        }
        names.sort();
        out.push(Directory::new(inside, names));
    }
    out.sort_by(|a, b| a.inside.cmp(&b.inside));
    out
}

/// The words of a folder's name.
fn words(part: &str) -> impl Iterator<Item = &str> {
    part.split(|c: char| !c.is_alphabetic())
}

fn lower(part: &str) -> String {
    let part = folded(part);
    match part.rsplit_once('_') {
        Some(("images", factor)) if factor.parse::<usize>().is_ok() => "images".to_owned(),
        _ => part,
    }
}

/// The folded parts of a path, without the factor of downscaled images.
fn parts(path: &Path) -> Vec<String> {
    path.components()
        .filter_map(|part| match part {
            Component::Normal(part) => Some(lower(&part.to_string_lossy())),
            _ => None,
        })
        .collect()
}

/// The largest factor of a folder of downscaled images. Larger numbers are no factors, such as the year of `images_2024`.
const LARGEST_FACTOR: usize = 32;

/// The factor of a path in a folder of downscaled images, such as `images_4`; 1 for other paths.
pub(in crate::dataset) fn factor_of(inside: &Path) -> usize {
    let factor = |part: Component<'_>| factor_in(part.as_os_str().to_str()?, "images").filter(|factor| *factor > 1);
    inside.components().find_map(factor).unwrap_or(1)
}

/// The factor in a folder's name: 4 of `images_4`, and 1 of `images` itself; `None` for other names.
pub(super) fn factor_in(name: &str, base: &str) -> Option<usize> {
    let rest = name.strip_prefix(base)?;
    if rest.is_empty() {
        return Some(1);
    }
    rest.strip_prefix('_')?.parse().ok().filter(|factor| (2..=LARGEST_FACTOR).contains(factor))
}

#[cfg(test)]
mod tests;
