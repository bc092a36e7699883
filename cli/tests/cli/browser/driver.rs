//! Drivers of headless browsers: Chromium by DevTools, Firefox by WebDriver BiDi.

use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, OnceLock};
use std::time::{Duration, Instant};

use base64::prelude::{BASE64_STANDARD, Engine};
use raygrad::nerf::Image;
use raygrad_test_support::skip::skipped;
use serde_json::{Map, Value, json};
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

use super::super::view::Server;
use super::super::{Place, png};

/// Width and height of the browser window, and the device pixel ratio. Debug builds render slowly.
const WINDOW: [u32; 2] = [780, 150];
const FINE: f64 = 0.5;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Chromium,
    Firefox,
}

impl Kind {
    /// The name of the installed program, if any.
    fn installed(self) -> Option<&'static str> {
        static NAMES: [OnceLock<Option<&str>>; 2] = [const { OnceLock::new() }; 2];
        let names: &[&str] = match self {
            Kind::Chromium => &["chromium", "chromium-browser", "google-chrome"],
            Kind::Firefox => &["firefox-esr", "firefox"],
        };
        let found = |name: &&&str| Command::new(name).arg("--version").output().is_ok_and(|o| o.status.success());
        *NAMES[self as usize].get_or_init(|| names.iter().find(found).copied())
    }
}

/// Runs a program until this one ends or closes its input; then removes a folder.
const UNTIL_LET_GO: &str = r#"folder="$1"; shift; "$@" & exec >&- 2>&-; read -r _; kill -9 $!; wait; rm -rf "$folder""#;

/// Idle Firefox programs for reuse, since starting one takes seconds.
static IDLE: Mutex<Vec<Program>> = Mutex::new(vec![]);

/// A running browser.
struct Program {
    child: Child,
    /// The virtual display that Firefox needs for WebGL, if installed.
    display: Option<Child>,
    socket: WebSocket<MaybeTlsStream<TcpStream>>,
    /// The folder with its settings and downloads.
    profile: PathBuf,
}

impl Drop for Program {
    fn drop(&mut self) {
        for child in [Some(&mut self.child), self.display.as_mut()].into_iter().flatten() {
            drop(child.stdin.take());
            let _ = child.wait();
        }
    }
}

impl Program {
    /// Starts a browser; returns `None` and prints a message if it is not installed.
    fn start(kind: Kind) -> Option<Self> {
        let Some(name) = kind.installed() else {
            skipped(&format!("{kind:?} is not installed"));
            return None;
        };
        let profile = tempfile::tempdir().unwrap().keep();
        let folder = profile.display();
        let (mut command, mut display) = (until_let_go(&profile, name), None);
        command.arg("--remote-debugging-port=0").env("HOME", &profile).env("TMPDIR", &profile);
        match kind {
            Kind::Chromium => {
                command.args(["--headless=new", "--no-sandbox", "--no-first-run"]);
                // Without a graphics card.
                command.args(["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]);
                command.arg(format!("--user-data-dir={folder}"));
            }
            Kind::Firefox => {
                let settings = format!(
                    "user_pref(\"browser.download.folderList\", 2);\nuser_pref(\"browser.download.dir\", \"{folder}\");\n\
                     user_pref(\"browser.download.always_ask_before_handling_new_types\", false);\n\
                     user_pref(\"webgl.force-enabled\", true);\n"
                );
                std::fs::write(profile.join("user.js"), settings).unwrap();
                command.args(["--no-remote", "--profile"]).arg(&profile);
                match screen() {
                    Some((child, number)) => {
                        command.env("DISPLAY", format!(":{number}"));
                        display = Some(child);
                    }
                    None => drop(command.arg("--headless")),
                }
            }
        }
        let mut child = command.arg("about:blank").stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let mut words = BufReader::new(child.stderr.take().unwrap());
        let address = loop {
            let mut line = String::new();
            assert!(words.read_line(&mut line).unwrap() > 0, "{name} has ended");
            if let Some((_, address)) = line.split_once(" listening on ") {
                break address.trim().to_owned();
            }
        };
        std::thread::spawn(move || std::io::copy(&mut words, &mut std::io::sink()));
        let address = if kind == Kind::Firefox { address + "/session" } else { address };
        let (socket, _) = tungstenite::connect(address).unwrap();
        if let MaybeTlsStream::Plain(stream) = socket.get_ref() {
            stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        }
        Some(Program { child, display, socket, profile })
    }
}

/// A command that ends with this program and then removes its folder.
fn until_let_go(folder: &Path, program: &str) -> Command {
    let mut command = Command::new("sh");
    command.args(["-c", UNTIL_LET_GO, "sh"]).arg(folder).arg(program).stdin(Stdio::piped());
    command
}

/// A browser with one page.
pub struct Browser {
    pub kind: Kind,
    /// Present until this is dropped.
    program: Option<Program>,
    /// The DevTools session, or the BiDi context.
    page: String,
    number: u64,
    /// Console errors of the page.
    pub complaints: Vec<String>,
}

impl Drop for Browser {
    fn drop(&mut self) {
        if self.kind == Kind::Firefox && !std::thread::panicking() {
            IDLE.lock().unwrap().extend(self.program.take());
        }
    }
}

impl Browser {
    /// All installed browsers; prints the absent ones.
    pub fn all() -> impl Iterator<Item = Self> {
        [Kind::Chromium, Kind::Firefox].into_iter().filter_map(Self::open)
    }

    /// Opens a browser; returns `None` and prints a message if it is not installed.
    pub fn open(kind: Kind) -> Option<Self> {
        let idle = if kind == Kind::Firefox { IDLE.lock().unwrap().pop() } else { None };
        let is_new = idle.is_none();
        let program = Some(idle.or_else(|| Program::start(kind))?);
        let mut browser = Browser { kind, program, page: String::new(), number: 0, complaints: vec![] };
        browser.begin(is_new);
        browser.window(WINDOW[0], WINDOW[1], FINE, false);
        Some(browser)
    }

    fn begin(&mut self, is_new: bool) {
        let text = |value: &Value| value.as_str().unwrap().to_owned();
        match self.kind {
            Kind::Chromium => {
                let target = self.call("Target.createTarget", json!({ "url": "about:blank" }))["targetId"].clone();
                let attached = self.call("Target.attachToTarget", json!({ "targetId": target, "flatten": true }));
                self.page = text(&attached["sessionId"]);
                for domain in ["Page", "Runtime", "Log"] {
                    self.call(&format!("{domain}.enable"), json!({}));
                }
                let kept = json!({ "behavior": "allow", "downloadPath": self.program().profile });
                self.call("Page.setDownloadBehavior", kept);
            }
            Kind::Firefox => {
                if is_new {
                    self.call("session.new", json!({ "capabilities": {} }));
                    self.call("session.subscribe", json!({ "events": ["log.entryAdded"] }));
                }
                self.page = text(&self.call("browsingContext.getTree", json!({}))["contexts"][0]["context"]);
                self.go("about:blank");
                // Errors of the previous page.
                self.complaints.clear();
            }
        }
    }

    fn program(&mut self) -> &mut Program {
        self.program.as_mut().unwrap()
    }

    /// Sends a protocol message and returns the answer.
    #[track_caller]
    pub fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.number += 1;
        let mut message = json!({ "id": self.number, "method": method, "params": parameters });
        if self.kind == Kind::Chromium && !self.page.is_empty() {
            message["sessionId"] = json!(self.page);
        }
        self.program().socket.send(Message::text(message.to_string())).unwrap();
        loop {
            let Message::Text(text) = self.program().socket.read().unwrap() else { continue };
            let answer: Value = serde_json::from_str(&text).unwrap();
            let told = &answer["params"];
            match answer["method"].as_str() {
                Some("Runtime.exceptionThrown") => self.complaints.push(told.to_string()),
                Some("Log.entryAdded") if told["entry"]["level"] == "error" => {
                    self.complaints.push(told["entry"]["text"].to_string());
                }
                Some("log.entryAdded") if told["level"] == "error" => self.complaints.push(told["text"].to_string()),
                _ => (),
            }
            if answer["id"] == self.number {
                assert!(answer.get("error").is_none(), "{method}: {answer}");
                return answer["result"].clone();
            }
        }
    }

    /// Evaluates an expression in the page.
    #[track_caller]
    pub fn value(&mut self, expression: &str) -> Value {
        let (asked, method) = match self.kind {
            Kind::Chromium => (json!({ "returnByValue": true }), "Runtime.evaluate"),
            Kind::Firefox => (json!({ "target": { "context": self.page } }), "script.evaluate"),
        };
        let mut asked = asked;
        (asked["expression"], asked["awaitPromise"]) = (json!(expression), json!(true));
        let answer = self.call(method, asked);
        assert!(answer.get("exceptionDetails").is_none(), "{expression}: {answer}");
        match self.kind {
            Kind::Chromium => answer["result"]["value"].clone(),
            Kind::Firefox => plain(&answer["result"]),
        }
    }

    /// Evaluates an expression to a number.
    #[track_caller]
    pub fn number(&mut self, expression: &str) -> f64 {
        let value = self.value(expression);
        value.as_f64().unwrap_or_else(|| panic!("{expression}: {value}"))
    }

    #[track_caller]
    pub fn until(&mut self, expression: &str) {
        let start = Instant::now();
        while self.value(expression) != true {
            if start.elapsed() > Duration::from_secs(40) {
                self.shot("stuck");
                let state = self.value("JSON.stringify([document.getElementById('status').textContent, typeof asked === 'number' ? [asked, shown, waits] : [wanted, whole]])");
                panic!("{expression} never came true: {state}; {:?}", self.complaints);
            }
            std::thread::sleep(Duration::from_millis(15));
        }
    }

    /// Opens a page and waits until its scripts have run.
    pub fn go(&mut self, url: &str) {
        match self.kind {
            Kind::Chromium => self.call("Page.navigate", json!({ "url": url })),
            Kind::Firefox => {
                self.call("browsingContext.navigate", json!({ "context": self.page, "url": url, "wait": "complete" }))
            }
        };
        self.until("document.readyState === 'complete'");
    }

    /// Opens a program's page and waits for the scene.
    pub fn visit(&mut self, server: &Server) {
        self.go(&server.link());
        self.sees_the_scene();
    }

    /// Opens the page again, as it is in the address bar, and waits for the scene.
    pub fn reload(&mut self) {
        let url = self.value("location.href").as_str().unwrap().to_owned();
        self.go(&url);
        self.sees_the_scene();
    }

    fn sees_the_scene(&mut self) {
        self.rested();
        // The layout may change the canvas size once more.
        self.until("String(shown.size) === String(sizes())");
    }

    /// Returns true if WebGL 2 is available; prints a skip message otherwise. Firefox needs a display for it.
    pub fn draws(&mut self) -> bool {
        let draws = self.value("document.createElement('canvas').getContext('webgl2') !== null") == true;
        assert!(draws || self.kind == Kind::Firefox);
        if !draws {
            skipped("Firefox has no WebGL 2 here");
        }
        draws
    }

    /// Waits for the complete image of the last request.
    #[track_caller]
    pub fn rested(&mut self) {
        self.until("document.readyState === 'complete' && typeof about !== 'undefined' && about !== null");
        // A change is requested a moment later.
        self.until("shown !== null && !waits && !again && shown.id === asked && shown.whole");
    }

    /// Drags from the middle of the scene, in pixels.
    pub fn drag(&mut self, by: [f64; 2], button: &str) {
        let middle = self.middle();
        self.drag_from(middle, by, button);
    }

    pub fn middle(&mut self) -> [f64; 2] {
        self.centre("stage")
    }

    /// The position of the middle of an element.
    pub fn centre(&mut self, element: &str) -> [f64; 2] {
        let at = self.value(&format!(
            "(() => {{ const r = {element}.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; }})()"
        ));
        [0, 1].map(|axis| at[axis].as_f64().unwrap())
    }

    /// Returns true if an element is visible and not covered.
    pub fn sees(&mut self, id: &str) -> bool {
        self.value(&format!(
            "(() => {{ const it = document.getElementById('{id}'), r = it.getBoundingClientRect(); \
             return it.contains(document.elementFromPoint(r.x + r.width / 2, r.y + r.height / 2)); }})()"
        )) == true
    }

    pub fn drag_from(&mut self, from: [f64; 2], by: [f64; 2], button: &str) {
        let at = |i: u32| [0, 1].map(|axis| from[axis] + by[axis] * f64::from(i) / 5.0);
        match self.kind {
            Kind::Chromium => {
                let held =
                    json!({ "button": button, "buttons": if button == "left" { 1 } else { 2 }, "clickCount": 1 });
                let mut event = |kind: &str, [x, y]: [f64; 2]| {
                    let mut event = held.clone();
                    (event["type"], event["x"], event["y"]) = (json!(kind), json!(x), json!(y));
                    self.call("Input.dispatchMouseEvent", event);
                };
                event("mousePressed", from);
                (1..=5).for_each(|i| event("mouseMoved", at(i)));
                event("mouseReleased", at(5));
            }
            Kind::Firefox => {
                let button = if button == "left" { 0 } else { 2 };
                let to = |[x, y]: [f64; 2]| json!({ "type": "pointerMove", "x": x.round() as i64, "y": y.round() as i64, "duration": 0 });
                let mut actions = vec![to(from), json!({ "type": "pointerDown", "button": button })];
                actions.extend((1..=5).map(|i| to(at(i))));
                actions.push(json!({ "type": "pointerUp", "button": button }));
                self.act(json!({ "type": "pointer", "id": "mouse", "actions": actions }));
            }
        }
    }

    /// Turns the wheel above the middle of the scene.
    pub fn wheel(&mut self, by: i32) {
        let [x, y] = self.middle();
        match self.kind {
            Kind::Chromium => {
                let event = json!({ "type": "mouseWheel", "x": x, "y": y, "deltaX": 0, "deltaY": by });
                self.call("Input.dispatchMouseEvent", event);
            }
            Kind::Firefox => {
                let [x, y] = [x, y].map(|x| x.round() as i64);
                let action = json!({ "type": "scroll", "x": x, "y": y, "deltaX": 0, "deltaY": by });
                self.act(json!({ "type": "wheel", "id": "wheel", "actions": [action] }));
            }
        }
    }

    /// Presses a key, with Shift if the name says so.
    pub fn key(&mut self, key: &str) {
        let (shift, key) = key.strip_prefix("Shift+").map_or((false, key), |key| (true, key));
        match self.kind {
            Kind::Chromium => {
                for kind in ["keyDown", "keyUp"] {
                    let event = json!({ "type": kind, "key": key, "modifiers": if shift { 8 } else { 0 } });
                    self.call("Input.dispatchKeyEvent", event);
                }
            }
            Kind::Firefox => {
                let value = match key {
                    "ArrowLeft" => "\u{e012}",
                    "ArrowUp" => "\u{e013}",
                    "ArrowRight" => "\u{e014}",
                    "ArrowDown" => "\u{e015}",
                    "Tab" => "\u{e004}",
                    letter => letter,
                };
                let press = |kind: &str, value: &str| json!({ "type": kind, "value": value });
                let mut actions = vec![press("keyDown", value), press("keyUp", value)];
                if shift {
                    actions.insert(0, press("keyDown", "\u{e008}"));
                    actions.push(press("keyUp", "\u{e008}"));
                }
                self.act(json!({ "type": "key", "id": "keys", "actions": actions }));
            }
        }
    }

    fn act(&mut self, source: Value) {
        self.call("input.performActions", json!({ "context": self.page, "actions": [source] }));
    }

    /// Sets the value of a control with its events.
    #[track_caller]
    pub fn set(&mut self, id: &str, value: impl Into<Value>) {
        let value = value.into();
        let name = if value.is_boolean() { "checked" } else { "value" };
        self.value(&format!(
            "(() => {{ const it = document.getElementById('{id}'); it.focus(); it.{name} = {value}; \
             it.dispatchEvent(new Event('input', {{ bubbles: true }})); \
             it.dispatchEvent(new Event('change', {{ bubbles: true }})); }})()"
        ));
    }

    #[track_caller]
    pub fn click(&mut self, id: &str) {
        self.value(&format!("document.getElementById('{id}').click()"));
    }

    pub fn size(&mut self, width: u32, height: u32, phone: bool) {
        self.window(width, height, 1.0, phone);
    }

    fn window(&mut self, width: u32, height: u32, fine: f64, phone: bool) {
        match self.kind {
            Kind::Chromium => {
                let metrics = json!({ "width": width, "height": height, "deviceScaleFactor": fine, "mobile": phone });
                self.call("Emulation.setDeviceMetricsOverride", metrics);
            }
            Kind::Firefox => {
                let size = json!({ "width": width, "height": height });
                let asked = json!({ "context": self.page, "viewport": size, "devicePixelRatio": fine });
                self.call("browsingContext.setViewport", asked);
            }
        }
    }

    /// Waits for a download.
    #[track_caller]
    pub fn kept(&mut self, name: &str) -> PathBuf {
        let (start, path) = (Instant::now(), self.program().profile.join(name));
        while std::fs::metadata(&path).map_or(true, |file| file.len() == 0) {
            assert!(start.elapsed() < Duration::from_secs(30), "{name} was not kept");
            std::thread::sleep(Duration::from_millis(20));
        }
        // Some browsers move the complete file there, others write it in place.
        std::thread::sleep(Duration::from_millis(100));
        path
    }

    /// Saves a screenshot, if requested.
    pub fn shot(&mut self, name: &str) {
        let Ok(folder) = std::env::var("SHOTS") else { return };
        let png = match self.kind {
            Kind::Chromium => self.call("Page.captureScreenshot", json!({ "format": "png" })),
            Kind::Firefox => self.call("browsingContext.captureScreenshot", json!({ "context": self.page })),
        };
        std::fs::create_dir_all(&folder).unwrap();
        let name = format!("{name}-{:?}.png", self.kind).to_lowercase();
        std::fs::write(Path::new(&folder).join(name), BASE64_STANDARD.decode(png["data"].as_str().unwrap()).unwrap())
            .unwrap();
    }

    /// The rendered image of the scene.
    pub fn picture(&mut self, place: &Place) -> Image {
        self.canvas("picture", place)
    }

    pub fn canvas(&mut self, id: &str, place: &Place) -> Image {
        let url = self.value(&format!("document.getElementById('{id}').toDataURL('image/png')"));
        let path = place.path("canvas.png");
        let bytes = BASE64_STANDARD.decode(url.as_str().unwrap().split_once(',').unwrap().1).unwrap();
        std::fs::write(&path, bytes).unwrap();
        let image = png(&path);
        if image.channels == 4 { image.over([1.0; 3]) } else { image }
    }
}

/// Starts a virtual display and returns its number.
fn screen() -> Option<(Child, String)> {
    let mut command = until_let_go(Path::new(""), "Xvfb");
    command.args(["-displayfd", "1", "-nolisten", "tcp", "-screen", "0", "1280x1024x24"]);
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().ok()?;
    let mut number = String::new();
    BufReader::new(child.stdout.take()?).read_line(&mut number).ok()?;
    Some((child, number.trim().to_owned()))
}

/// Converts a BiDi value, which carries its type.
fn plain(told: &Value) -> Value {
    let value = &told["value"];
    match told["type"].as_str().unwrap() {
        "undefined" | "null" => Value::Null,
        "array" => value.as_array().unwrap().iter().map(plain).collect(),
        "object" => {
            let entries = value.as_array().unwrap().iter();
            Value::Object(
                entries.map(|pair| (pair[0].as_str().unwrap().to_owned(), plain(&pair[1]))).collect::<Map<_, _>>(),
            )
        }
        "number" if value == "-0" => json!(-0.0),
        _ => value.clone(),
    }
}
