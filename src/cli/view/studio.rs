//! Films that pages have made: one at a time, by `raygrad render` in a process of its own.

use std::fs;
use std::io::{BufRead, BufReader, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use raygrad::nerf::{Error, Result};
use serde_json::{Value, json};

use super::hub::Hub;
use super::messages::{Film, Tell};
use super::server;
use crate::cli::interrupt;
use crate::cli::output::{make_folder, remove};
use crate::cli::render::{film_ending, frames_of};
use crate::cli::run::Run;
use crate::cli::scene::Scene;

/// Films in a run's folder, after which no page gets another.
const MOST: u32 = 999;

/// Makes films of a run.
pub struct Studio {
    run: Arc<Run>,
    scene: Option<Scene>,
    hub: Arc<Hub>,
    /// The film that is being made goes on for as long as this is held, and ends with this program.
    at_work: Mutex<Option<ChildStdin>>,
}

impl Studio {
    pub fn new(run: Arc<Run>, scene: Option<Scene>, hub: Arc<Hub>) -> Self {
        Studio { run, scene, hub, at_work: Mutex::default() }
    }

    fn lock(&self) -> MutexGuard<'_, Option<ChildStdin>> {
        self.at_work.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Begins a film; all pages are told how it goes.
    ///
    /// # Errors
    /// If another is being made, or the run's folder takes no files.
    pub fn begin(self: &Arc<Self>, film: &Film) -> Result<()> {
        let mut at_work = self.lock();
        if at_work.is_some() {
            return Err(Error::setting("film", "one is being made: wait for it, or end it"));
        }
        let path = new_file(&self.run.file("films"), &film.path)?;
        let out = path.with_extension(film_ending());
        let bad = |e: std::io::Error| Error::file(&path, format!("no film can be made of it: {e}"));
        let mut command = Command::new(std::env::current_exe().map_err(bad)?);
        command.args(["--threads", &rayon::current_num_threads().to_string()]);
        command.arg("render").arg(&self.run.folder).arg("--path").arg(&path).arg("--out").arg(&out);
        command.arg("--show").args(json!(film.show).as_str()).arg("--ends-with-input");
        if let Some(scene) = &self.scene {
            command.arg("--scene").arg(scene.to_string());
        }
        if let Some([red, green, blue]) = film.background {
            command.args(["--background", &format!("{red},{green},{blue}")]);
        }
        if let Some(skip) = film.skip {
            command.args(["--skip", &skip.to_string()]);
        }
        let (input, output) = (Stdio::piped(), Stdio::null());
        let mut child = command.stdin(input).stdout(output).stderr(Stdio::piped()).spawn().map_err(bad)?;
        let input = child.stdin.take();
        let (studio, path) = (self.clone(), path.clone());
        // Without the thread the child ends with its input.
        std::thread::Builder::new()
            .name("film".into())
            .spawn(move || studio.follow(child, &path, &out))
            .map_err(bad)?;
        *at_work = input;
        Ok(())
    }

    /// Tells of a film until it has ended; of one that nobody wants any more nothing is left.
    fn follow(&self, mut child: Child, path: &Path, out: &Path) {
        self.tell(out, "begun", false);
        let (words, mut last) = (child.stderr.take(), String::new());
        for line in words.into_iter().flat_map(|words| BufReader::new(words).lines().map_while(|line| line.ok())) {
            self.tell(out, line.trim(), false);
            last = line;
        }
        let ended = child.wait();
        *self.lock() = None;
        match ended {
            Ok(status) if status.success() => self.tell(out, "done", true),
            // It says itself why.
            Ok(status) if status.code().is_some_and(|code| code != i32::from(interrupt::EXIT_CODE)) => {
                self.tell(out, &last, true);
            }
            _ => {
                let _ = fs::remove_dir_all(frames_of(out));
                remove(&[path.to_owned()]);
                self.tell(out, "ended", true);
            }
        }
    }

    /// Ends the film that is being made, with its frame.
    pub fn end(&self) {
        *self.lock() = None;
    }

    fn tell(&self, film: &Path, words: &str, ended: bool) {
        let file = film.display().to_string();
        self.hub.tell(&server::text(&Tell::Film { file, words: words.to_owned(), ended }));
    }
}

/// Writes a path to the first file of a folder that is free: `film-1.json`, `film-2.json` ...
fn new_file(folder: &Path, path: &Value) -> Result<PathBuf> {
    make_folder(folder)?;
    for number in 1..=MOST {
        let file = folder.join(format!("film-{number}.json"));
        match fs::File::create_new(&file) {
            Ok(mut out) => {
                let written = out.write_all(path.to_string().as_bytes());
                written.map_err(|e| Error::file(&file, format!("cannot be written: {e}")))?;
                return Ok(file);
            }
            Err(e) if e.kind() == ErrorKind::AlreadyExists => (),
            Err(e) => return Err(Error::file(&file, format!("cannot be written: {e}"))),
        }
    }
    Err(Error::file(folder, format!("holds {MOST} films: remove some")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_film_takes_the_place_of_another() {
        let folder = tempfile::tempdir().unwrap();
        let films = folder.path().join("films");
        let made = |value: u32| new_file(&films, &Value::from(value)).unwrap();
        let [first, second] = [made(1), made(2)];
        assert!(first.ends_with("film-1.json") && second.ends_with("film-2.json"));
        fs::remove_file(&first).unwrap();
        assert_eq!(made(3), first);
        assert_eq!(fs::read_to_string(first).unwrap() + &fs::read_to_string(second).unwrap(), "32");
    }
}
