//! Losses of power: a disk as the recorded system calls of a command leave it, opened by the next command.
//!
//! `strace` records what a command writes. A model of the disk replays every prefix of these calls in four ways: with
//! all of it kept; with that alone which was flushed; and with one file that was not flushed empty, cut or missing. The
//! same command, or the one that resumes it, must find the old state or the new one.
//!
//! `POWER=all cargo test --test cli power -- --nocapture` opens every distinct state; the suite opens some of them.

use super::faults::has_strace;
use super::resume::assert_same;
use super::{Place, SMALL};
use std::collections::{BTreeMap, HashSet};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// The calls that change files.
const CALLS: &str = "trace=mkdir,mkdirat,openat,write,pwrite64,lseek,ftruncate,fsync,fdatasync,rename,renameat,renameat2,\
                     link,linkat,unlink,unlinkat,rmdir,copy_file_range,sendfile";

/// States of each command that the suite opens.
const OPENED: usize = 12;

/// A file or a folder of the model.
enum Node {
    File { now: Vec<u8>, flushed: Vec<u8> },
    Folder { now: BTreeMap<String, usize>, flushed: BTreeMap<String, usize> },
}

/// The content of a disk: files by path, and folders, which have none.
pub type Tree = BTreeMap<PathBuf, Option<Vec<u8>>>;

/// A disk on which writes and names last only when they are flushed.
struct Disk {
    root: PathBuf,
    nodes: Vec<Node>,
    /// Open files: the node and the position, if writes do not append.
    open: BTreeMap<u32, (usize, Option<usize>)>,
}

impl Disk {
    /// The disk as it is, with everything flushed.
    fn read(root: &Path) -> Self {
        let mut disk = Disk { root: root.to_owned(), nodes: vec![], open: BTreeMap::new() };
        disk.load(root);
        disk
    }

    fn load(&mut self, path: &Path) -> usize {
        let node = self.nodes.len();
        self.nodes.push(Node::File { now: vec![], flushed: vec![] });
        self.nodes[node] = if path.is_dir() {
            let entries = std::fs::read_dir(path).unwrap().map(|entry| entry.unwrap());
            let entries: BTreeMap<String, usize> =
                entries.map(|entry| (entry.file_name().into_string().unwrap(), self.load(&entry.path()))).collect();
            Node::Folder { flushed: entries.clone(), now: entries }
        } else {
            let bytes = std::fs::read(path).unwrap();
            Node::File { flushed: bytes.clone(), now: bytes }
        };
        node
    }

    fn entries(&mut self, folder: usize) -> &mut BTreeMap<String, usize> {
        let Node::Folder { now, .. } = &mut self.nodes[folder] else { panic!("a file with entries") };
        now
    }

    fn bytes(&mut self, file: usize) -> &mut Vec<u8> {
        let Node::File { now, .. } = &mut self.nodes[file] else { panic!("a folder with bytes") };
        now
    }

    /// The node of a path; `None` outside of the disk or without such an entry.
    fn find(&mut self, path: &Path) -> Option<usize> {
        let inside = path.strip_prefix(&self.root).ok()?.to_owned();
        inside.iter().try_fold(0, |node, name| match &self.nodes[node] {
            Node::Folder { now, .. } => now.get(name.to_str().unwrap()).copied(),
            Node::File { .. } => None,
        })
    }

    /// The folder of a path, and its name there.
    fn place(&mut self, path: &Path) -> Option<(usize, String)> {
        Some((self.find(path.parent()?)?, path.file_name()?.to_str()?.to_owned()))
    }

    fn add(&mut self, path: &Path, node: Node) -> Option<usize> {
        let (folder, name) = self.place(path)?;
        self.nodes.push(node);
        let new = self.nodes.len() - 1;
        self.entries(folder).insert(name, new);
        Some(new)
    }

    fn write(&mut self, fd: u32, at: Option<usize>, bytes: &[u8]) {
        let Some(&(file, position)) = self.open.get(&fd) else { return };
        let content = self.bytes(file);
        let start = at.or(position).unwrap_or(content.len());
        content.resize(content.len().max(start + bytes.len()), 0);
        content[start..start + bytes.len()].copy_from_slice(bytes);
        if at.is_none() && position.is_some() {
            self.open.insert(fd, (file, Some(start + bytes.len())));
        }
    }

    /// Carries out a call that succeeded.
    fn apply(&mut self, call: &Call) {
        let Call { name, arguments, result } = call;
        let path = |i: usize| call.path(i, &self.root);
        let number = |i: usize| arguments[i].trim().parse::<usize>().ok();
        match name.as_str() {
            "mkdir" | "mkdirat" => {
                let path = path(usize::from(name == "mkdirat"));
                self.add(&path, Node::Folder { now: BTreeMap::new(), flushed: BTreeMap::new() });
            }
            "openat" => {
                let (path, fd) = (path(1), fd(result));
                self.open.remove(&fd);
                let flags = &arguments[2];
                if flags.contains("O_TMPFILE") || flags.contains("O_DIRECTORY") {
                    return;
                }
                let mut node = self.find(&path);
                if node.is_none() && flags.contains("O_CREAT") {
                    node = self.add(&path, Node::File { now: vec![], flushed: vec![] });
                }
                let Some(node) = node else { return };
                if flags.contains("O_TRUNC") {
                    self.bytes(node).clear();
                }
                if flags.contains("O_WRONLY") || flags.contains("O_RDWR") {
                    self.open.insert(fd, (node, (!flags.contains("O_APPEND")).then_some(0)));
                }
            }
            "write" => self.write(fd(&arguments[0]), None, &text(&arguments[1])),
            "pwrite64" => self.write(fd(&arguments[0]), number(3), &text(&arguments[1])),
            "copy_file_range" | "sendfile" => {
                let (from, to) = if name == "sendfile" { (1, 0) } else { (0, 2) };
                let bytes = std::fs::read(path_of(&arguments[from])).unwrap();
                let count = result.parse::<usize>().unwrap();
                // The source is copied as a whole, in one call or in several.
                let start = match self.open.get(&fd(&arguments[to])) {
                    Some((_, Some(start))) => *start,
                    _ => return,
                };
                self.write(fd(&arguments[to]), None, &bytes[start..start + count]);
            }
            "lseek" => {
                if let Some((_, Some(position))) = self.open.get_mut(&fd(&arguments[0])) {
                    *position = result.parse().unwrap();
                }
            }
            "ftruncate" => {
                if let (Some(&(file, _)), Some(length)) = (self.open.get(&fd(&arguments[0])), number(1)) {
                    self.bytes(file).resize(length, 0);
                }
            }
            "fsync" | "fdatasync" => {
                let Some(node) = self.find(&path_of(&arguments[0])) else { return };
                match &mut self.nodes[node] {
                    Node::File { now, flushed } => flushed.clone_from(now),
                    Node::Folder { now, flushed } => flushed.clone_from(now),
                }
            }
            "rename" | "renameat" | "renameat2" => {
                let step = if name == "rename" { [0, 1] } else { [1, 3] };
                let (from, to) = (path(step[0]), path(step[1]));
                let Some((folder, name)) = self.place(&from) else { return };
                let node = self.entries(folder).remove(&name).unwrap();
                let (folder, name) = self.place(&to).unwrap();
                self.entries(folder).insert(name, node);
            }
            "unlink" | "rmdir" | "unlinkat" => {
                let path = path(usize::from(name == "unlinkat"));
                if let Some((folder, name)) = self.place(&path) {
                    self.entries(folder).remove(&name);
                }
            }
            other => panic!("{other} is not replayed"),
        }
    }

    /// The tree of what is flushed, or of everything. The bytes of the file `changed.0` are replaced; without bytes it
    /// is missing.
    fn tree(&self, is_flushed: bool, changed: Option<(usize, Option<Vec<u8>>)>) -> Tree {
        let mut tree = Tree::new();
        let mut waiting = vec![(PathBuf::new(), 0)];
        while let Some((path, node)) = waiting.pop() {
            match &self.nodes[node] {
                Node::Folder { now, flushed } => {
                    let entries = if is_flushed { flushed } else { now };
                    waiting.extend(entries.iter().map(|(name, node)| (path.join(name), *node)));
                    tree.insert(path, None);
                }
                Node::File { now, flushed } => {
                    let bytes = match &changed {
                        Some((file, bytes)) if *file == node => bytes.clone(),
                        _ => Some(if is_flushed { flushed } else { now }.clone()),
                    };
                    bytes.map(|bytes| tree.insert(path, Some(bytes)));
                }
            }
        }
        tree
    }

    /// The trees that a loss of power may leave now.
    fn states(&self) -> Vec<Tree> {
        let mut states = vec![self.tree(false, None), self.tree(true, None)];
        for (node, file) in self.nodes.iter().enumerate() {
            if let Node::File { now, flushed } = file
                && now != flushed
            {
                // What was flushed before the end of a file stays; anything else may be lost.
                let kept = if now.starts_with(flushed) { flushed.len() } else { 0 };
                let cut = |length: usize| Some(now[..length].to_vec());
                let missing = if kept == 0 { None } else { cut(kept) };
                for bytes in [cut(kept), cut(kept.midpoint(now.len())), missing] {
                    states.push(self.tree(false, Some((node, bytes))));
                }
            }
        }
        states
    }
}

/// A line of `strace`.
struct Call {
    name: String,
    arguments: Vec<String>,
    result: String,
}

impl Call {
    /// Parses a line of `strace -f`; `None` if the call failed.
    fn parse(line: &str) -> Option<Call> {
        let line = line.split_once(' ')?.1.trim_start();
        assert!(!line.contains("unfinished ...") && !line.contains("resumed>"), "calls of two threads overlap: {line}");
        let (name, rest) = line.split_once('(')?;
        let (arguments, result) = rest.rsplit_once(" = ")?;
        let arguments = arguments.trim_end().strip_suffix(')')?;
        // All strings are hexadecimal, so that commas separate arguments.
        let arguments = arguments.split(", ").map(str::to_owned).collect();
        (!result.starts_with('-')).then(|| Call { name: name.to_owned(), arguments, result: result.to_owned() })
    }

    /// The absolute path of a string argument.
    fn path(&self, i: usize, cwd: &Path) -> PathBuf {
        let name = PathBuf::from(String::from_utf8(text(&self.arguments[i])).unwrap());
        // A folder's descriptor before it, if any.
        let folder = i.checked_sub(1).map(|before| &self.arguments[before]).filter(|before| before.contains('<'));
        folder.map_or_else(|| cwd.to_owned(), |folder| path_of(folder)).join(name)
    }
}

/// The bytes of a hexadecimal string.
fn text(argument: &str) -> Vec<u8> {
    let (start, end) = (argument.find('"').unwrap() + 1, argument.rfind('"').unwrap());
    assert!(!argument.ends_with("..."), "a string is cut");
    argument[start..end].split("\\x").skip(1).map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect()
}

/// The number of a descriptor such as `3</tmp/x>`.
fn fd(argument: &str) -> u32 {
    argument.split('<').next().unwrap().parse().unwrap()
}

/// The path of a descriptor such as `3<\x2f>`.
fn path_of(argument: &str) -> PathBuf {
    let bytes = argument[argument.find('<').unwrap() + 1..argument.rfind('>').unwrap()].split("\\x").skip(1);
    PathBuf::from(String::from_utf8(bytes.map(|byte| u8::from_str_radix(&byte[..2], 16).unwrap()).collect()).unwrap())
}

/// Runs a command in a place and replays it. `open` opens each distinct state in a place of its own, with the old and the
/// new tree of the disk; it panics if both are lost.
fn survives(place: &Place, command: &str, open: impl Fn(&Place, &[Tree; 2])) {
    let root = place.path("").canonicalize().unwrap();
    let mut disk = Disk::read(&root);
    let log = tempfile::NamedTempFile::new().unwrap();
    let mut strace = Command::new("strace");
    strace.current_dir(&root).args(["-f", "-qq", "-y", "-xx", "-s", "100000000", "-e", CALLS, "-o"]).arg(log.path());
    strace.arg(env!("CARGO_BIN_EXE_raygrad")).args(["--threads", "1"]).args(command.split_whitespace());
    let output = strace.output().unwrap();
    assert!(is_done(&output), "{output:?}");
    let old = disk.tree(false, None);
    let (mut prefixes, mut seen, mut states) = (0, HashSet::new(), vec![]);
    for line in std::fs::read_to_string(log.path()).unwrap().lines() {
        let Some(call) = Call::parse(line) else { continue };
        disk.apply(&call);
        prefixes += 1;
        for state in disk.states() {
            let mut hasher = DefaultHasher::new();
            state.hash(&mut hasher);
            if seen.insert(hasher.finish()) {
                states.push(state);
            }
        }
    }
    let new = disk.tree(false, None);
    let mut real = Disk::read(&root).tree(false, None);
    real.retain(|path, _| !path.ends_with("strace.log"));
    assert!(new == real, "the replay ends as the disk: {:?}", differing(&new, &real));
    let flushed = disk.tree(true, None);
    let lost: Vec<_> =
        new.iter().filter(|(path, bytes)| flushed.get(*path) != Some(bytes)).map(|(path, _)| path).collect();
    assert!(lost.is_empty(), "in the end these are not flushed: {lost:?}");
    let all = std::env::var("POWER").is_ok_and(|which| which == "all");
    let stride = if all { 1 } else { states.len().div_ceil(OPENED) };
    let trees = [old, new];
    let mut opened = 0;
    for state in states.iter().step_by(stride) {
        let place = Place::empty();
        for (path, bytes) in state.iter().filter(|(path, _)| !path.as_os_str().is_empty()) {
            let path = place.path("").join(path);
            match bytes {
                Some(bytes) => std::fs::write(path, bytes).unwrap(),
                None => std::fs::create_dir(path).unwrap(),
            }
        }
        open(&place, &trees);
        opened += 1;
    }
    println!("{command}: {prefixes} calls, {} distinct states, {opened} opened, none lost", states.len());
}

/// Returns true if a command has done its work: 3 means that the doctor has found something.
fn is_done(output: &Output) -> bool {
    matches!(output.status.code(), Some(0 | 3))
}

/// The paths at which two trees differ.
pub fn differing(a: &Tree, b: &Tree) -> Vec<PathBuf> {
    let paths: std::collections::BTreeSet<_> = a.keys().chain(b.keys()).collect();
    paths.into_iter().filter(|path| a.get(*path) != b.get(*path)).cloned().collect()
}

/// The files below a folder of a tree.
fn below(tree: &Tree, folder: &str) -> Tree {
    let inside = tree.iter().filter_map(|(path, bytes)| Some((path.strip_prefix(folder).ok()?, bytes)));
    // The lock of a temporary folder is removed after its renaming.
    let inside = inside.filter(|(path, _)| !path.ends_with(".raygrad-lock"));
    inside.map(|(path, bytes)| (path.to_owned(), bytes.clone())).collect()
}

pub fn on_disk(place: &Place) -> Tree {
    Disk::read(&place.path("").canonicalize().unwrap()).tree(false, None)
}

#[test]
fn power_loss_keeps_a_run() {
    if !has_strace() {
        return;
    }
    let train = format!("train scene --steps 12 --checkpoint-every 0.001s --tensorboard --out run {SMALL}");
    let whole = Place::with_scene();
    whole.succeeds(&format!("--threads 1 {train}"));
    let place = Place::with_scene();
    survives(&place, &train, |place, _| {
        let begun = place.path("run/config.json").exists();
        // The last checkpoint may be damaged, but not the one before it.
        let mut checkpoints: Vec<u64> = below(&on_disk(place), "run/checkpoints")
            .into_keys()
            .filter_map(|path| path.to_str()?.strip_suffix(".checkpoint")?.parse().ok())
            .collect();
        checkpoints.sort_unstable();
        if begun {
            let said = place.succeeds("--threads 1 train --resume run --checkpoint-every 0.001s");
            let at = said.lines().find_map(|line| line.strip_prefix("resumed  at step "));
            let at = at.and_then(|line| line.split(|c: char| !c.is_ascii_digit()).next()?.parse::<u64>().ok());
            let least = checkpoints.iter().rev().nth(1).copied().unwrap_or(0);
            assert!(at.unwrap_or(0) >= least, "{said}: {checkpoints:?}");
        } else {
            assert!(checkpoints.is_empty(), "{checkpoints:?}");
            place.succeeds(&format!("--threads 1 {train}"));
        }
        std::fs::rename(place.path("run"), place.path("whole")).unwrap();
        let run = whole.path("run");
        Command::new("cp").arg("-r").arg(run).arg(place.path("run")).status().unwrap();
        assert_same(place, "whole", "run");
    });
}

#[test]
fn power_loss_keeps_a_video_and_its_frames() {
    if !has_strace() {
        return;
    }
    let place = Place::with_scene();
    place.succeeds(&format!("--threads 1 train scene --steps 12 --out run {SMALL}"));
    let render =
        |frames: usize| format!("render run --path orbit --frames {frames} --size 8x6 --out film.gif --overwrite");
    place.succeeds(&format!("--threads 1 {}", render(2)));
    survives(&place, &render(3), |place, [old, new]| {
        let film = |tree: &Tree| tree.get(Path::new("film.gif")).cloned();
        let found = film(&on_disk(place));
        assert!([film(old), film(new)].contains(&found), "the video is neither the old nor the new one");
        place.succeeds(&format!("--threads 1 {}", render(3)));
        // The mark in it names the place.
        let length = |film: Option<Option<Vec<u8>>>| film.unwrap().unwrap().len();
        assert_eq!(length(film(&on_disk(place))), length(film(new)));
    });
}

#[test]
fn power_loss_keeps_a_converted_capture() {
    if !has_strace() {
        return;
    }
    let convert = "prepare scene --to nerfstudio --out captured";
    survives(&Place::with_scene(), convert, |place, [old, new]| {
        let found = below(&on_disk(place), "captured");
        assert!([below(old, "captured"), below(new, "captured")].contains(&found), "a part of the capture");
        if found.is_empty() {
            place.succeeds(convert);
            assert!(below(&on_disk(place), "captured") == below(new, "captured"));
        }
        assert!(below(&on_disk(place), "scene") == below(old, "scene"));
    });
}

#[test]
fn power_loss_keeps_exports_and_evaluations() {
    if !has_strace() {
        return;
    }
    let place = Place::with_scene();
    place.succeeds(&format!("--threads 1 train scene --steps 12 --out run {SMALL}"));
    place.succeeds("export run mesh.ply --resolution 8 --iso-value 0.01 --overwrite");
    for (command, file) in [
        ("export run mesh.ply --resolution 12 --iso-value 0.01 --overwrite", "mesh.ply"),
        ("export run page.html --overwrite", "page.html"),
        ("export run cameras.json --overwrite", "cameras.json"),
        ("eval run", "run/eval-test-fast.json"),
        ("doctor scene --out checked --overwrite", "checked/doctor.html"),
    ] {
        survives(&place, command, |place, [old, new]| {
            let at = |tree: &Tree| tree.get(Path::new(file)).cloned();
            let found = at(&on_disk(place));
            assert!([at(old), at(new)].contains(&found), "{file} is neither the old nor the new one");
            assert!(is_done(&place.command(command).output().unwrap()));
            assert!(at(&on_disk(place)).is_some());
        });
    }
}
