//! Videos for pages: one at a time, by `raygrad render` in a child process.

use std::ffi::OsString;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};

use raygrad::nerf::{Error, Result};
use raygrad::tensor::parallel::locked;
use serde_json::{Value, json};

use super::messages::{ServerMessage, VideoRequest};
use super::requests::{Requests, text};
use crate::interrupt;
use crate::output::{make_folder, remove};
use crate::ranks;
use crate::render::{frames_of, video_ending};
use crate::run::Run;
use crate::scene::Scene;

/// Most videos in a run's folder.
const MOST: u32 = 999;

/// Renders videos of a run.
pub struct VideoJobs {
    run: Arc<Run>,
    scene: Option<Scene>,
    requests: Arc<Requests>,
    /// Held only briefly, since pages wait for it.
    work: Mutex<Work>,
}

/// State of the video, until its process has ended.
enum Work {
    Nothing,
    /// The process is being started.
    Begun,
    /// A running process. It ends when its standard input closes, also if this program ends.
    Video {
        _input: Option<ChildStdin>,
    },
    /// A cancelled video, whose process finishes its frame.
    Ending,
}

impl VideoJobs {
    pub fn new(run: Arc<Run>, scene: Option<Scene>, requests: Arc<Requests>) -> Self {
        VideoJobs { run, scene, requests, work: Mutex::new(Work::Nothing) }
    }

    fn lock(&self) -> MutexGuard<'_, Work> {
        locked(&self.work)
    }

    /// Starts a video and reports its progress to all pages.
    ///
    /// # Errors
    ///
    /// Fails if another video is being rendered or the run's folder is not writable.
    pub fn begin(self: &Arc<Self>, video: &VideoRequest) -> Result<()> {
        // Determined once, since it looks for an encoder of ffmpeg.
        static ENDING: OnceLock<&str> = OnceLock::new();
        let program = std::env::current_exe().map_err(|e| Error::setting("video", format!("cannot be made: {e}")))?;
        self.make(&program, video, || ENDING.get_or_init(video_ending))
    }

    fn make(
        self: &Arc<Self>,
        program: &Path,
        video: &VideoRequest,
        ending: impl FnOnce() -> &'static str,
    ) -> Result<()> {
        self.claim()?;
        let begun = self.start(program, video, ending());
        if begun.is_err() {
            *self.lock() = Work::Nothing;
        }
        begun
    }

    /// Reserves the only video slot.
    pub fn claim(&self) -> Result<()> {
        let mut work = self.lock();
        let busy = match *work {
            Work::Nothing => {
                *work = Work::Begun;
                return Ok(());
            }
            Work::Begun | Work::Video { .. } => "another video is rendering: wait for it or cancel it",
            Work::Ending => "the last video stops after its frame: try again then",
        };
        Err(Error::setting("video", busy))
    }

    fn start(self: &Arc<Self>, program: &Path, video: &VideoRequest, ending: &str) -> Result<()> {
        let path = new_file(&self.run.file("videos"), &video.path)?;
        let out = path.with_extension(ending);
        let begun = self.spawn(program, video, &path, &out);
        begun.map_err(|e| {
            remove(std::slice::from_ref(&path));
            Error::file(&path, format!("cannot start the video: {e}"))
        })
    }

    fn spawn(self: &Arc<Self>, program: &Path, video: &VideoRequest, path: &Path, out: &Path) -> std::io::Result<()> {
        let mut command = Command::new(program);
        command.args(arguments(&self.run.folder, self.scene.as_ref(), video, path, out));
        ranks::leave(&mut command);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn()?;
        let input = child.stdin.take();
        let mut work = self.lock();
        // If the video was cancelled meanwhile, the input closes here and the process ends.
        if matches!(*work, Work::Begun) {
            *work = Work::Video { _input: input };
        }
        drop(work);
        let (video_jobs, path, out) = (self.clone(), path.to_owned(), out.to_owned());
        // Without the thread, the closed input ends the process.
        std::thread::Builder::new().name("video".into()).spawn(move || video_jobs.follow(child, &path, &out)).map(drop)
    }

    /// Reports the progress of a video until it ends. Removes the files of a cancelled one.
    fn follow(&self, mut child: Child, path: &Path, out: &Path) {
        self.tell(out, "started", false);
        let (words, mut last) = (child.stderr.take(), String::new());
        for line in words.into_iter().flat_map(|words| BufReader::new(words).lines().map_while(|line| line.ok())) {
            self.tell(out, line.trim(), false);
            last = line;
        }
        let words = match child.wait() {
            Ok(status) if status.success() => "done",
            // The program has printed the reason.
            Ok(status) if status.code().is_some_and(|code| code != i32::from(interrupt::EXIT_CODE)) => &last,
            _ => {
                let _ = fs::remove_dir_all(frames_of(out));
                remove(&[path.to_owned()]);
                "cancelled"
            }
        };
        // The slot is free before pages are told, since a page may start the next video then.
        *self.lock() = Work::Nothing;
        self.tell(out, words, true);
    }

    /// Cancels the video after its current frame.
    pub fn end(&self) {
        let mut work = self.lock();
        if !matches!(*work, Work::Nothing) {
            *work = Work::Ending;
        }
    }

    fn tell(&self, video: &Path, words: &str, ended: bool) {
        let file = video.display().to_string();
        self.requests.tell(&text(&ServerMessage::Video { file, words: words.to_owned(), ended }));
    }
}

/// The arguments of `raygrad` for a video.
fn arguments(run: &Path, scene: Option<&Scene>, video: &VideoRequest, path: &Path, out: &Path) -> Vec<OsString> {
    let show = json!(video.show);
    let mut arguments: Vec<OsString> = vec!["--threads".into(), rayon::current_num_threads().to_string().into()];
    arguments.extend(["render".into(), run.into(), "--path".into(), path.into(), "--out".into(), out.into()]);
    arguments.extend(["--show", show.as_str().unwrap_or_default(), "--ends-with-input"].map(OsString::from));
    let background = video.background.map(|[red, green, blue]| format!("{red},{green},{blue}"));
    let others = [
        ("--scene", scene.map(Scene::to_string)),
        ("--background", background),
        ("--skip", video.skip.map(|skip| skip.to_string())),
    ];
    for (flag, value) in others {
        arguments.extend(value.into_iter().flat_map(|value| [flag.into(), value.into()]));
    }
    arguments
}

/// Writes a path to the first free name for it and its video: `video-1.json`, `video-2.json` ...
fn new_file(folder: &Path, path: &Value) -> Result<PathBuf> {
    make_folder(folder)?;
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let names: Vec<String> = entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    let is_free = |name: &String| !names.iter().any(|taken| taken.starts_with(name));
    let Some(name) = (1..=MOST).map(|number| format!("video-{number}.")).find(is_free) else {
        return Err(Error::file(folder, format!("holds {MOST} videos, the most allowed: remove some")));
    };
    let file = folder.join(name + "json");
    // A file that another program has just created is kept.
    let written = fs::File::create_new(&file).and_then(|mut out| out.write_all(path.to_string().as_bytes()));
    written.map_err(|e| Error::file(&file, format!("cannot be written: {e}")))?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::shown::Show;
    use raygrad::nerf::space::occupancy::Skip;

    #[test]
    fn new_file_skips_used_names() {
        let folder = tempfile::tempdir().unwrap();
        let videos = folder.path().join("videos");
        let made = |value: u32| new_file(&videos, &Value::from(value)).unwrap();
        let [first, second] = [made(1), made(2)];
        assert!(first.ends_with("video-1.json") && second.ends_with("video-2.json"));
        fs::remove_file(&first).unwrap();
        assert_eq!(made(3), first);
        assert_eq!(fs::read_to_string(&first).unwrap() + &fs::read_to_string(&second).unwrap(), "32");
        // A video without its path file also counts.
        fs::write(videos.join("video-3.mp4"), "").unwrap();
        fs::write(videos.join("video-4.gif"), "").unwrap();
        fs::create_dir(videos.join("video-5.mp4.frames")).unwrap();
        fs::write(videos.join("video-60.mp4"), "").unwrap();
        assert!(made(4).ends_with("video-6.json"));
        for number in 7..=MOST - 1 {
            fs::write(videos.join(format!("video-{number}.json")), "").unwrap();
        }
        assert!(made(5).ends_with("video-999.json"));
        let full = new_file(&videos, &Value::Null).unwrap_err().to_string();
        assert!(full.contains("holds 999 videos, the most allowed: remove some"), "{full}");
    }

    fn video() -> VideoRequest {
        VideoRequest { path: Value::Null, show: Show::Color, background: None, skip: None }
    }

    #[test]
    fn arguments_contain_the_requested_options() {
        let of = |scene: Option<&Scene>, video: &VideoRequest| -> Vec<String> {
            let all = arguments("run".as_ref(), scene, video, "video-1.json".as_ref(), "video-1.gif".as_ref());
            all.into_iter().map(|argument| argument.into_string().unwrap()).collect()
        };
        let threads = rayon::current_num_threads();
        let usual = |show: &str| {
            let all = format!(
                "--threads {threads} render run --path video-1.json --out video-1.gif --show {show} --ends-with-input"
            );
            all.split(' ').map(str::to_owned).collect::<Vec<_>>()
        };
        let with = |flag: &str, value: &str| [usual("color"), vec![flag.to_owned(), value.to_owned()]].concat();
        assert_eq!(of(None, &video()), usual("color"));
        assert_eq!(of(None, &VideoRequest { show: Show::Normals, ..video() }), usual("normals"));
        let scene = Scene::Folder("my scene".into());
        assert_eq!(of(Some(&scene), &video()), with("--scene", "my scene"));
        let background = Some([0, 128, 255]);
        assert_eq!(of(None, &VideoRequest { background, ..video() }), with("--background", "0,128,255"));
        assert_eq!(of(None, &VideoRequest { skip: Some(Skip::Off), ..video() }), with("--skip", "off"));
    }

    /// Tests with scripts in place of the program.
    #[cfg(unix)]
    mod scripted {
        use super::*;
        use crate::fuzz::run_config;
        use crate::view::requests::{Outbox, Outgoing};
        use std::sync::mpsc::channel;
        use std::time::{Duration, Instant};

        const LONG: Duration = Duration::from_secs(30);

        struct Place {
            folder: tempfile::TempDir,
            video_jobs: Arc<VideoJobs>,
            outbox: Arc<Outbox>,
        }

        impl Place {
            fn new() -> Self {
                let (folder, requests) = (tempfile::tempdir().unwrap(), Arc::new(Requests::default()));
                let outbox = requests.join(crate::view::networks::Network::LOCAL, 1).unwrap().1;
                let run = Arc::new(Run { folder: folder.path().to_owned(), config: run_config() });
                Place { folder, video_jobs: Arc::new(VideoJobs::new(run, None, requests)), outbox }
            }

            /// Creates a script. Its argument `$8` is the path of the video.
            fn script(&self, name: &str, text: &str) -> PathBuf {
                let file = self.folder.path().join(name);
                // A child process writes the script. A file that is open for writing here cannot be executed, nor while
                // a child of another test has inherited it.
                let write = r#"printf '#!/bin/sh\n%s' "$1" > "$2" && chmod 755 "$2""#;
                let written = Command::new("sh").args(["-c", write, "sh", text]).arg(&file).status().unwrap();
                assert!(written.success());
                file
            }

            fn make(&self, program: &Path) -> std::result::Result<(), String> {
                self.video_jobs.make(program, &video(), || "gif").map_err(|e| e.to_string())
            }

            /// The next message to pages, and whether it is the last one of a video.
            fn told(&self) -> (String, bool) {
                let start = Instant::now();
                while start.elapsed() < LONG {
                    match self.outbox.take() {
                        Some(Outgoing::Text(text)) => {
                            let told: Value = serde_json::from_str(&text).unwrap();
                            assert!(told["file"].as_str().unwrap().ends_with(".gif"), "{told}");
                            return (told["words"].as_str().unwrap().to_owned(), told["ended"].as_bool().unwrap());
                        }
                        Some(bytes) => panic!("{bytes:?}"),
                        None => std::thread::sleep(Duration::from_millis(2)),
                    }
                }
                panic!("nothing is told")
            }

            fn tells(&self, words: &str, ended: bool) {
                assert_eq!(self.told(), (words.to_owned(), ended));
            }

            /// The files in the folder of videos.
            fn videos(&self) -> Vec<String> {
                let entries = fs::read_dir(self.folder.path().join("videos")).unwrap();
                let mut names: Vec<_> =
                    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
                names.sort();
                names
            }
        }

        #[test]
        fn cancelled_video_blocks_until_it_ends() {
            let place = Place::new();
            let go = place.folder.path().join("go");
            let first = place.script(
                "first",
                &format!(
                    "mkdir \"$8.frames\"\ncat > /dev/null\nwhile [ ! -e {} ]; do sleep 0.01; done\nexit 130",
                    go.display()
                ),
            );
            let second = place.script("second", "cat > /dev/null\nexit 130");
            place.video_jobs.end();
            place.make(&first).unwrap();
            place.tells("started", false);
            let refused = place.make(&second).unwrap_err();
            assert_eq!(refused, "`video`: another video is rendering: wait for it or cancel it");
            assert!(place.video_jobs.begin(&video()).is_err());
            for _ in 0..2 {
                place.video_jobs.end();
                let refused = place.make(&second).unwrap_err();
                assert_eq!(refused, "`video`: the last video stops after its frame: try again then");
            }
            fs::write(go, "").unwrap();
            place.tells("cancelled", true);
            assert_eq!(place.videos(), [""; 0], "nothing is left of it");
            // The second video is another job and continues.
            place.make(&second).unwrap();
            place.tells("started", false);
            assert!(matches!(*place.video_jobs.lock(), Work::Video { .. }));
            assert_eq!(place.videos(), ["video-1.json"]);
            place.video_jobs.end();
            place.tells("cancelled", true);
            assert_eq!(place.videos(), [""; 0]);
        }

        #[test]
        fn video_formats_are_found_without_blocking() {
            let place = Place::new();
            let script = place.script("script", "cat > /dev/null\nexit 130");
            let ((asks, asked), (answers, answer)) = (channel(), channel());
            let video_jobs = place.video_jobs.clone();
            let making = std::thread::spawn(move || {
                let ending = || {
                    asks.send(()).unwrap();
                    answer.recv_timeout(LONG).unwrap()
                };
                video_jobs.make(&script, &video(), ending).unwrap();
            });
            asked.recv_timeout(LONG).unwrap();
            let (done, ended) = channel();
            let video_jobs = place.video_jobs.clone();
            std::thread::spawn(move || {
                video_jobs.end();
                done.send(()).unwrap();
            });
            ended.recv_timeout(LONG / 2).expect("it waits");
            assert!(place.make("other".as_ref()).unwrap_err().contains("the last video stops after its frame"));
            answers.send("gif").unwrap();
            making.join().unwrap();
            // The video was cancelled before its process started.
            place.tells("started", false);
            place.tells("cancelled", true);
            assert_eq!(place.videos(), [""; 0]);
        }

        #[test]
        fn video_that_cannot_start_leaves_nothing() {
            let place = Place::new();
            for _ in 0..2 {
                let refused = place.make(&place.folder.path().join("absent")).unwrap_err();
                assert!(refused.contains("video-1.json: cannot start the video"), "{refused}");
                assert_eq!(place.videos(), [""; 0]);
            }
            place.make(&place.script("script", "echo video > \"$8\"")).unwrap();
            place.tells("started", false);
            place.tells("done", true);
            assert_eq!(place.videos(), ["video-1.gif", "video-1.json"]);
        }

        #[test]
        fn follow_reports_program_output() {
            let place = Place::new();
            place.make(&place.script("fails", "echo ' one' >&2\necho two >&2\nexit 1")).unwrap();
            for words in ["started", "one", "two"] {
                place.tells(words, false);
            }
            place.tells("two", true);
            assert_eq!(place.videos(), ["video-1.json"], "what it complains of");
            place.make(&place.script("killed", "echo one >&2\nkill -9 $$")).unwrap();
            for words in ["started", "one"] {
                place.tells(words, false);
            }
            place.tells("cancelled", true);
            assert_eq!(place.videos(), ["video-1.json"]);
        }
    }
}
