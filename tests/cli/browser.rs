//! The page of `raygrad view` in a real browser: Chromium without a window, where it is installed.
//!
//! `SHOTS=DIR cargo test --test cli browser` leaves pictures of the page to look at.

use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use super::resume::SMALL;
use super::view::{Server, serve};
use super::{Place, png};
use raygrad::nerf::Image;
use raygrad::nerf::pictures::metrics::psnr;
use serde_json::{Value, json};
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

/// A browser with one page, spoken to by the DevTools protocol.
struct Browser {
    child: Child,
    socket: WebSocket<MaybeTlsStream<TcpStream>>,
    session: Option<String>,
    number: u64,
    /// What scripts of the page complained of.
    complaints: Vec<String>,
    _profile: tempfile::TempDir,
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Browser {
    /// Nothing, which it says, where there is none.
    fn open() -> Option<Self> {
        let names = ["chromium", "chromium-browser", "google-chrome"];
        let found = |name: &&str| Command::new(name).arg("--version").output().is_ok_and(|o| o.status.success());
        let Some(name) = names.into_iter().find(found) else {
            println!("skipped: Chromium is not installed");
            return None;
        };
        let profile = tempfile::tempdir().unwrap();
        let flags = ["--headless=new", "--no-sandbox", "--no-first-run", "--remote-debugging-port=0"];
        // Without a graphics card.
        let flags = flags.into_iter().chain(["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]);
        let mut command = Command::new(name);
        command.args(flags).arg(format!("--user-data-dir={}", profile.path().display())).arg("about:blank");
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let mut words = BufReader::new(child.stderr.take().unwrap());
        let address = loop {
            let mut line = String::new();
            assert!(words.read_line(&mut line).unwrap() > 0, "{name} has ended");
            if let Some((_, address)) = line.split_once("DevTools listening on ") {
                break address.trim().to_owned();
            }
        };
        std::thread::spawn(move || std::io::copy(&mut words, &mut std::io::sink()));
        let (socket, _) = tungstenite::connect(address).unwrap();
        if let MaybeTlsStream::Plain(stream) = socket.get_ref() {
            stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        }
        let mut browser = Browser { child, socket, session: None, number: 0, complaints: vec![], _profile: profile };
        let target = browser.call("Target.createTarget", json!({ "url": "about:blank" }))["targetId"].clone();
        let attached = browser.call("Target.attachToTarget", json!({ "targetId": target, "flatten": true }));
        browser.session = Some(attached["sessionId"].as_str().unwrap().to_owned());
        for domain in ["Page", "Runtime", "Log"] {
            browser.call(&format!("{domain}.enable"), json!({}));
        }
        browser.size(WINDOW[0], WINDOW[1], false);
        Some(browser)
    }

    #[track_caller]
    fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.number += 1;
        let mut message = json!({ "id": self.number, "method": method, "params": parameters });
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        self.socket.send(Message::text(message.to_string())).unwrap();
        loop {
            let Message::Text(text) = self.socket.read().unwrap() else { continue };
            let answer: Value = serde_json::from_str(&text).unwrap();
            match answer["method"].as_str() {
                Some("Runtime.exceptionThrown") => self.complaints.push(answer["params"].to_string()),
                Some("Log.entryAdded") if answer["params"]["entry"]["level"] == "error" => {
                    self.complaints.push(answer["params"]["entry"]["text"].to_string());
                }
                _ => (),
            }
            if answer["id"] == self.number {
                assert!(answer.get("error").is_none(), "{method}: {answer}");
                return answer["result"].clone();
            }
        }
    }

    /// The value of an expression in the page.
    #[track_caller]
    fn value(&mut self, expression: &str) -> Value {
        let asked = json!({ "expression": expression, "awaitPromise": true, "returnByValue": true });
        let answer = self.call("Runtime.evaluate", asked);
        assert!(answer.get("exceptionDetails").is_none(), "{expression}: {answer}");
        answer["result"]["value"].clone()
    }

    #[track_caller]
    fn until(&mut self, expression: &str) {
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

    fn visit(&mut self, server: &Server) {
        self.call("Page.navigate", json!({ "url": format!("http://{}/", server.address) }));
        self.rested();
    }

    /// Waits for the whole picture of what was asked for last.
    #[track_caller]
    fn rested(&mut self) {
        // What was done is asked for a moment later.
        self.until("document.readyState === 'complete' && typeof about !== 'undefined' && about !== null");
        self.value("new Promise((done) => setTimeout(done, 60))");
        self.until("shown !== null && !waits && shown.id === asked && shown.whole");
    }

    fn mouse(&mut self, kind: &str, [x, y]: [f64; 2], more: Value) {
        let mut event = json!({ "type": kind, "x": x, "y": y });
        event.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        self.call("Input.dispatchMouseEvent", event);
    }

    /// From the middle of the scene, by so many pixels.
    fn drag(&mut self, by: [f64; 2], button: &str) {
        let middle = self.middle();
        self.drag_from(middle, by, button);
    }

    fn middle(&mut self) -> [f64; 2] {
        let stage =
            "(() => { const r = stage.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; })()";
        let middle = self.value(stage);
        [0, 1].map(|axis| middle[axis].as_f64().unwrap())
    }

    fn drag_from(&mut self, from: [f64; 2], by: [f64; 2], button: &str) {
        let to = [from[0] + by[0], from[1] + by[1]];
        let held = json!({ "button": button, "buttons": if button == "left" { 1 } else { 2 }, "clickCount": 1 });
        self.mouse("mousePressed", from, held.clone());
        for i in 1..=5 {
            let share = f64::from(i) / 5.0;
            let at = [0, 1].map(|axis| from[axis] + share * (to[axis] - from[axis]));
            self.mouse("mouseMoved", at, held.clone());
        }
        self.mouse("mouseReleased", to, held);
    }

    fn key(&mut self, key: &str) {
        for kind in ["keyDown", "keyUp"] {
            self.call("Input.dispatchKeyEvent", json!({ "type": kind, "key": key }));
        }
    }

    fn size(&mut self, width: u32, height: u32, phone: bool) {
        let metrics = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": phone });
        self.call("Emulation.setDeviceMetricsOverride", metrics);
    }

    fn dark(&mut self, dark: bool) {
        let scheme = json!({ "name": "prefers-color-scheme", "value": if dark { "dark" } else { "light" } });
        self.call("Emulation.setEmulatedMedia", json!({ "features": [scheme] }));
    }

    /// A picture of the page, for somebody to look at.
    fn shot(&mut self, name: &str) {
        let Ok(folder) = std::env::var("SHOTS") else { return };
        let png = self.call("Page.captureScreenshot", json!({ "format": "png" }));
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(Path::new(&folder).join(format!("{name}.png")), bytes(png["data"].as_str().unwrap())).unwrap();
    }

    /// What the page shows of the scene.
    fn picture(&mut self, place: &Place) -> Image {
        let url = self.value("picture.toDataURL('image/png')");
        let path = place.path("canvas.png");
        std::fs::write(&path, bytes(url.as_str().unwrap().split_once(',').unwrap().1)).unwrap();
        let image = png(&path);
        if image.channels == 4 { image.over([1.0; 3]) } else { image }
    }
}

/// What base 64 says.
fn bytes(text: &str) -> Vec<u8> {
    let digit = |letter: u8| match letter {
        b'A'..=b'Z' => letter - b'A',
        b'a'..=b'z' => letter - b'a' + 26,
        b'0'..=b'9' => letter - b'0' + 52,
        b'+' => 62,
        b'/' => 63,
        _ => panic!("{letter} is no digit"),
    };
    let digits: Vec<u8> = text.bytes().filter(|letter| *letter != b'=').map(digit).collect();
    let whole = |four: &[u8]| {
        let bits = four.iter().enumerate().fold(0_u32, |bits, (i, digit)| bits | u32::from(*digit) << (18 - 6 * i));
        bits.to_be_bytes()[1..four.len()].to_vec()
    };
    digits.chunks(4).flat_map(whole).collect()
}

/// The picture that a page has given as bytes, RGBA.
fn image(bytes: &Value, [width, height]: [usize; 2]) -> Image {
    let rgba = bytes.as_array().unwrap().chunks(4);
    let data = rgba.flat_map(|rgba| rgba[..3].iter().map(|x| x.as_u64().unwrap() as f32 / 255.0));
    Image { width, height, channels: 3, data: data.collect() }
}

/// Width and height of the browser's window: a program that is built for tests paints slowly.
const WINDOW: [u32; 2] = [780, 150];

#[test]
fn a_browser_shows_the_scene_and_moves_about_it() {
    let Some(mut browser) = Browser::open() else { return };
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 300 --out run {SMALL}"));
    let server = serve(&place, "view run");
    browser.visit(&server);
    let size = browser.value("[picture.width, picture.height]");
    place.succeeds(&format!("render run --frames 1 --size {}x{} --out first", size[0], size[1]));
    let expected = png(&place.path("first/0000.png"));
    let first = browser.picture(&place);
    assert!(psnr(&first, &expected) > 40.0, "{}", psnr(&first, &expected));
    browser.shot("first");
    // Whatever moves the camera changes the picture, and R brings it back.
    let pose = |browser: &mut Browser| browser.value("JSON.stringify([view.eye, view.back])");
    let mut seen = vec![pose(&mut browser)];
    let away = "Math.hypot(...view.eye.map((x, i) => x - view.pivot[i]))";
    let far = browser.value(away).as_f64().unwrap();
    let azimuth = "Math.atan2(view.eye[1] - view.pivot[1], view.eye[0] - view.pivot[0])";
    let before = browser.value(azimuth).as_f64().unwrap();
    browser.drag([60.0, 20.0], "left");
    // The scene follows the hand: the camera goes the other way, and up.
    let turned = (browser.value(azimuth).as_f64().unwrap() - before).sin();
    assert!(turned < -0.05, "{turned}");
    assert!((browser.value(away).as_f64().unwrap() - far).abs() < 1e-9 * far, "an orbit keeps its distance");
    assert!(browser.value("Math.abs(view.right[2]) < 1e-9") == true, "and the horizon level");
    seen.push(pose(&mut browser));
    browser.drag([-20.0, -10.0], "right");
    seen.push(pose(&mut browser));
    let middle = browser.middle();
    browser.mouse("mouseWheel", middle, json!({ "deltaX": 0, "deltaY": -200 }));
    browser.until(&format!("{away} < {}", 0.95 * far));
    seen.push(pose(&mut browser));
    for key in ["ArrowLeft", "ArrowUp", "w", "a", "q", "+"] {
        browser.key(key);
        seen.push(pose(&mut browser));
    }
    for pair in seen.windows(2) {
        assert_ne!(pair[0], pair[1]);
    }
    browser.rested();
    let moved = browser.picture(&place);
    assert!(psnr(&moved, &first) < 30.0);
    browser.shot("moved");
    browser.key("r");
    browser.rested();
    // Pieces are as large as there is time for: the last bits differ.
    let same = |image: &Image| psnr(image, &first) > 45.0;
    assert!(same(&browser.picture(&place)));
    for (key, show) in [("2", "depth"), ("3", "normals"), ("4", "opacity"), ("1", "color")] {
        browser.key(key);
        browser.rested();
        assert_eq!(browser.value("mode()"), show);
        browser.shot(show);
        assert_eq!(same(&browser.picture(&place)), show == "color", "{show}");
    }
    // To a photograph and back.
    browser.key("n");
    browser.rested();
    assert!(browser.value("view.photograph !== null && photo.hidden") == true);
    browser.key("b");
    browser.until("!photo.hidden && photo.style.opacity === '0.5'");
    browser.shot("blended");
    browser.key("5");
    browser.rested();
    assert!(browser.value("document.getElementById('status').textContent.includes('dB')") == true);
    browser.shot("error");
    browser.key("1");
    browser.key("c");
    browser.value("document.getElementById('crop').click()");
    browser.rested();
    assert!(browser.value("marks.querySelectorAll('.camera').length").as_u64().unwrap() >= 10);
    browser.key("r");
    browser.rested();
    browser.shot("box");
    // A face of the box, here the upper one of y, follows the pointer towards the middle.
    let at = "(() => { const box = marks.querySelectorAll('.handle')[3].getBoundingClientRect(); \
              return [box.x + box.width / 2, box.y + box.height / 2]; })()";
    let at = browser.value(at);
    let at = [at[0].as_f64().unwrap(), at[1].as_f64().unwrap()];
    let side = browser.value("box()[1][1]").as_f64().unwrap();
    let inwards = 25.0 * (browser.middle()[0] - at[0]).signum();
    browser.drag_from(at, [inwards, 0.0], "left");
    let moved = browser.value("box()[1][1]").as_f64().unwrap();
    assert!(moved < side - 0.05, "{moved} {side}");
    browser.rested();
    browser.shot("cropped");
    browser.value("document.getElementById('crop').click()");
    // The slider goes through checkpoints; letters that are typed in a control are its own.
    let slide = |browser: &mut Browser, to: u32| {
        let id = "document.getElementById('checkpoint')";
        browser.value(&format!("{id}.focus(); {id}.value = {to}; {id}.dispatchEvent(new Event('input'))"));
        browser.rested();
    };
    slide(&mut browser, 0);
    assert_eq!(browser.value("[shown.step, document.getElementById('checkpoint-out').textContent].join()"), "0,step 0");
    browser.key("3");
    browser.key("r");
    assert_eq!(browser.value("mode()"), "color");
    browser.shot("checkpoint");
    slide(&mut browser, 2);
    assert_eq!(browser.value("document.getElementById('checkpoint-out').textContent"), "the end");
    browser.value("document.getElementById('skip').value = 'off'; document.getElementById('skip').dispatchEvent(new Event('change'))");
    browser.rested();
    browser.value("stage.focus()");
    browser.key("r");
    browser.rested();
    assert!(same(&browser.picture(&place)), "nothing is left out that shows");
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
}

#[test]
fn a_browser_keeps_pictures_and_paths_that_are_the_programs() {
    let Some(mut browser) = Browser::open() else { return };
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 60 --out run --scope unbounded {SMALL}"));
    let server = serve(&place, "view run");
    let kept = json!({ "behavior": "allow", "downloadPath": place.path("") });
    browser.visit(&server);
    browser.call("Page.setDownloadBehavior", kept);
    let wait = |name: &str| {
        let start = Instant::now();
        while std::fs::metadata(place.path(name)).map_or(true, |file| file.len() == 0) {
            assert!(start.elapsed() < Duration::from_secs(30), "{name} was not kept");
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    browser.key("p");
    wait("view.png");
    let saved = png(&place.path("view.png"));
    assert!(psnr(&browser.picture(&place), &saved) > 35.0);
    // Key frames where the camera is at first, and elsewhere; the film begins with what is seen.
    browser.key("k");
    browser.drag([60.0, -5.0], "left");
    browser.key("k");
    assert_eq!(browser.value("keys.length"), 2);
    browser.value("document.getElementById('save-path').click()");
    wait("path.json");
    // As large as the window it would take long.
    browser.value("freeSizes = () => [48, 12]; document.getElementById('seconds').value = 0.5; document.getElementById('film').click()");
    browser.until(
        "document.getElementById('film-progress').textContent.endsWith('mp4: done') \
                   || document.getElementById('film-progress').textContent.endsWith('gif: done')",
    );
    assert!(browser.value("document.getElementById('end-film').hidden") == true);
    let [ours, its] = ["path.json", "run/films/film-1.json"].map(|name| place.json(name));
    let fov = |path: &Value| path["keyframes"][1]["fov"].as_f64().unwrap();
    assert!((fov(&ours) - fov(&its)).abs() < 1e-5 && ours["is_cycle"] == its["is_cycle"]);
    place.succeeds(&format!(
        "render run --path path.json --frames 2 --size {}x{} --out film",
        saved.width, saved.height
    ));
    let [from, to] = ["0000", "0001"].map(|name| png(&place.path(&format!("film/{name}.png"))));
    assert!(psnr(&from, &saved) > 45.0, "{}", psnr(&from, &saved));
    browser.rested();
    let seen = browser.picture(&place);
    assert!(psnr(&seen, &to) > 35.0 && psnr(&seen, &from) < psnr(&seen, &to) - 3.0, "{}", psnr(&seen, &to));
    browser.shot("path");
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
}

#[test]
fn a_browser_comes_back_to_a_program_that_does_and_fits_a_phone() {
    let Some(mut browser) = Browser::open() else { return };
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 100 --out run {SMALL}"));
    let server = serve(&place, "view run");
    browser.visit(&server);
    browser.drag([70.0, 0.0], "left");
    let pose = browser.value("JSON.stringify(view.eye)");
    let port = server.address.rsplit(':').next().unwrap().to_owned();
    drop(server);
    browser.until("!document.getElementById('lost').hidden");
    browser.shot("lost");
    let server = serve(&place, &format!("view run --port {port}"));
    browser.until("document.getElementById('lost').hidden");
    browser.rested();
    assert_eq!(browser.value("JSON.stringify(view.eye)"), pose, "where it was");
    browser.complaints.clear();
    browser.size(390, 440, true);
    browser.visit(&server);
    browser.until("document.documentElement.scrollWidth <= innerWidth");
    let wide = browser.value("stage.getBoundingClientRect().width").as_f64().unwrap();
    assert!((wide - 390.0).abs() < 1.0, "{wide}");
    browser.shot("phone");
    // Two fingers that part bring it nearer.
    let away = "Math.hypot(...view.eye.map((x, i) => x - view.pivot[i]))";
    let far = browser.value(away).as_f64().unwrap();
    browser.call("Emulation.setTouchEmulationEnabled", json!({ "enabled": true, "maxTouchPoints": 2 }));
    let touch = |browser: &mut Browser, kind: &str, apart: f64| {
        let points =
            [json!({ "x": 195.0 - apart, "y": 200, "id": 1 }), json!({ "x": 195.0 + apart, "y": 200, "id": 2 })];
        let points = if kind == "touchEnd" { json!([]) } else { json!(points) };
        browser.call("Input.dispatchTouchEvent", json!({ "type": kind, "touchPoints": points }));
    };
    touch(&mut browser, "touchStart", 40.0);
    for apart in [50.0, 60.0, 80.0] {
        touch(&mut browser, "touchMove", apart);
    }
    touch(&mut browser, "touchEnd", 0.0);
    assert!(browser.value(away).as_f64().unwrap() < 0.8 * far);
    browser.dark(true);
    browser.rested();
    browser.shot("dark");
    assert_ne!(browser.value("getComputedStyle(document.body).backgroundColor"), "rgb(255, 255, 255)");
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
}

#[test]
fn a_browser_shows_training_and_controls_it() {
    let Some(mut browser) = Browser::open() else { return };
    let place = Place::with_scene();
    let mut server = serve(&place, &format!("train scene --steps 100000 --view --out run {SMALL}"));
    browser.visit(&server);
    browser.until("training !== null && training.step > 20");
    browser.until("shown.step > 10");
    browser.value("document.getElementById('pause').click()");
    browser.until("training.paused === true && document.getElementById('pause').textContent === 'Go on'");
    let step = browser.value("training.step");
    browser.value("new Promise((done) => setTimeout(done, 900))");
    assert_eq!(browser.value("training.step"), step);
    browser.rested();
    browser.shot("training");
    assert!(browser.value("document.querySelectorAll('.curve path').length") == 3);
    browser.value("document.getElementById('pause').click()");
    browser.until(&format!("training.step > {step}"));
    browser.value("window.confirm = () => true; document.getElementById('stop').click()");
    browser.until("training.ended === 'stopped, and saved'");
    browser.shot("ended");
    browser.call("Page.navigate", json!({ "url": "about:blank" }));
    assert_eq!(server.child.wait().unwrap().code(), Some(0));
    assert!(place.path("run/model.safetensors").exists());
}

/// `PAGES=RUN,RUN cargo test --release --test cli ten_views -- --nocapture` measures runs of one's own, by their whole paths.
#[test]
fn a_page_and_the_program_agree_in_ten_views() {
    let given = std::env::var("PAGES").ok();
    let Some(mut browser) = Browser::open().filter(|_| given.is_some()) else { return };
    browser.size(200, 150, false);
    let place = Place::empty();
    for (number, run) in given.iter().flat_map(|runs| runs.split(',')).enumerate() {
        let page = place.path(&format!("{number}.html"));
        place.succeeds(&format!("export {run} {}", page.display()));
        place.succeeds(&format!("render {run} --path test --size 100x100 --out {number}"));
        let poses = super::view::test_cameras(&place, run);
        let start = Instant::now();
        browser.call("Page.navigate", json!({ "url": format!("file://{}", page.display()) }));
        browser.until("typeof whole !== 'undefined' && status.textContent.includes(' ms')");
        let first = start.elapsed().as_secs_f64();
        browser.until("whole === wanted");
        let mut decibels = vec![];
        let start = Instant::now();
        for (i, camera) in poses.iter().take(10).enumerate() {
            let asked =
                format!("render({}, {}, 100, 100).then((bytes) => Array.from(bytes))", camera["pose"], camera["fov"]);
            let image = image(&browser.value(&asked), [100, 100]);
            decibels.push(psnr(&image, &png(&place.path(&format!("{number}/{i:04}.png")))));
        }
        let seconds = start.elapsed().as_secs_f64() / decibels.len() as f64;
        decibels.sort_by(f64::total_cmp);
        println!(
            "{run}: {:.1} MB, first picture after {first:.1} s, {seconds:.1} s a picture of 100x100; {:.1} to {:.1} dB, {} views",
            std::fs::metadata(&page).unwrap().len() as f64 / 1e6,
            decibels[0],
            decibels[decibels.len() - 1],
            decibels.len()
        );
        assert!(decibels.len() == 10 && decibels[0] > 40.0, "{decibels:?}");
    }
}

/// Of scenes that end, that go on, and that all photographs look ahead at.
#[test]
fn a_browser_renders_a_page_as_the_program_renders_the_scene() {
    let Some(mut browser) = Browser::open() else { return };
    // What stands in for a graphics card is slow.
    browser.size(60, 45, false);
    let place = Place::with_scene();
    place.succeeds("prepare landscape --to nerfstudio --size 32 --out around");
    for (scene, flags, name) in [
        ("scene", "--steps 300", "object"),
        ("around", "--steps 100 --set field.codes=2 --refine exposure", "landscape"),
    ] {
        place.succeeds(&format!("train {scene} {flags} --out {name} {SMALL}"));
        place.succeeds(&format!("export {name} {name}.html"));
        place.succeeds(&format!("render {name} --frames 2 --size 40x30 --out seen"));
        let url = format!("file://{}", place.path(&format!("{name}.html")).display());
        browser.call("Page.navigate", json!({ "url": url }));
        browser.until("typeof whole !== 'undefined' && whole === wanted && whole >= 0");
        browser.shot(&format!("page-{name}"));
        let [width, height] = [40, 30];
        // From where it is looked at first, and from behind.
        let poses = [(0, "data.view.pose"), (1, "(reset(), orbit(-Math.PI, 0), rows(view))")];
        // Photographs of the landscape are from a part of the circle, on which an orbit swings.
        for (frame, pose) in poses.into_iter().take(if scene == "scene" { 2 } else { 1 }) {
            let asked = format!("render({pose}, data.view.fov, {width}, {height}).then((bytes) => Array.from(bytes))");
            let image = image(&browser.value(&asked), [width, height]);
            let expected = png(&place.path(&format!("seen/000{frame}.png")));
            assert!(psnr(&image, &expected) > 40.0, "{name} {frame}: {}", psnr(&image, &expected));
        }
    }
    // One that was ended before all of its detail had come.
    let train = format!("train scene --steps 4000 --refine poses --out early {SMALL}");
    let mut child = place.command(&train).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let metrics = place.path("early/metrics.jsonl");
    while std::fs::read_to_string(&metrics).map_or(0, |lines| lines.lines().count()) < 50 {
        std::thread::sleep(Duration::from_millis(20));
    }
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(130));
    place.succeeds("export early early.html");
    place.succeeds("render early --frames 1 --size 40x30 --out seen");
    let url = format!("file://{}", place.path("early.html").display());
    browser.call("Page.navigate", json!({ "url": url }));
    browser.until("typeof whole !== 'undefined' && whole === wanted && whole >= 0");
    let asked = "render(data.view.pose, data.view.fov, 40, 30).then((bytes) => Array.from(bytes))";
    let (seen, expected) = (image(&browser.value(asked), [40, 30]), png(&place.path("seen/0000.png")));
    assert!(psnr(&seen, &expected) > 40.0, "{}", psnr(&seen, &expected));
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    place.succeeds("train scene --preset small --steps 1 --out other");
    place.fails("export other other.html", &["other.html", "`instant`", "`classic`"]);
}
