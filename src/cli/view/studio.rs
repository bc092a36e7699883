//! Films that pages have made: one at a time, by `raygrad render` in a process of its own.

use std::fs;
use std::io::{BufRead, BufReader, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};

use raygrad::nerf::{Error, Result};
use serde_json::Value;

use super::hub::Hub;
use super::messages::{Show, Tell};
use super::server;
use crate::cli::output::make_folder;
use crate::cli::render::film_ending;
use crate::cli::run::Run;
use crate::cli::scene::Scene;

/// Films in a run's folder, after which no page gets another.
const MOST: u32 = 999;

/// Makes films of a run.
pub struct Studio {
    run: Arc<Run>,
    scene: Option<Scene>,
    hub: Arc<Hub>,
    /// What makes the film that is being made.
    at_work: Mutex<Option<Child>>,
}

impl Studio {
    pub fn new(run: Arc<Run>, scene: Option<Scene>, hub: Arc<Hub>) -> Self {
        Studio { run, scene, hub, at_work: Mutex::default() }
    }

    /// Begins a film along a camera path, as `raygrad render --path` reads it; all pages are told how it goes.
    ///
    /// # Errors
    /// If another is being made, or the run's folder takes no files.
    pub fn begin(self: &Arc<Self>, path: &Value, show: Show) -> Result<()> {
        let mut at_work = self.at_work.lock().unwrap_or_else(PoisonError::into_inner);
        if at_work.is_some() {
            return Err(Error::setting("film", "one is being made: wait for it, or end it"));
        }
        let show = show.rendered().ok_or_else(|| Error::setting("film", "shows colours, depth, normals or opacity"))?;
        let file = new_file(&self.run.file("films"), path)?;
        let film = file.with_extension(film_ending());
        let folder = &self.run.folder;
        let bad = |e: std::io::Error| Error::file(folder, format!("no film can be made: {e}"));
        let mut command = Command::new(std::env::current_exe().map_err(bad)?);
        command.arg("render").arg(&self.run.folder).arg("--path").arg(&file).arg("--out").arg(&film);
        command.args(["--show", show]);
        if let Some(scene) = &self.scene {
            command.arg("--scene").arg(scene.to_string());
        }
        let mut child =
            command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().map_err(bad)?;
        let words = child.stderr.take();
        *at_work = Some(child);
        let studio = self.clone();
        let follow = move || {
            studio.tell(&film, "begun", false);
            let mut last = String::new();
            for line in words.into_iter().flat_map(|words| BufReader::new(words).lines().map_while(|line| line.ok())) {
                studio.tell(&film, line.trim(), false);
                last = line;
            }
            let child = studio.at_work.lock().unwrap_or_else(PoisonError::into_inner).take();
            match child.map(|mut child| child.wait()) {
                Some(Ok(status)) if status.success() => studio.tell(&film, "done", true),
                // It says itself why.
                Some(Ok(status)) if status.code().is_some() => studio.tell(&film, &last, true),
                _ => studio.tell(&film, "ended", true),
            }
        };
        std::thread::Builder::new().name("film".into()).spawn(follow).map_err(bad)?;
        Ok(())
    }

    /// Ends the film that is being made; its frames stay, for `raygrad render` to go on with.
    pub fn end(&self) {
        if let Some(child) = self.at_work.lock().unwrap_or_else(PoisonError::into_inner).as_mut() {
            // One that has ended by itself is not to be ended.
            let _ = child.kill();
        }
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
