//! The page of `raygrad view` and `raygrad train --view`, as seen by another client.

use std::collections::VecDeque;
use std::io::ErrorKind::{TimedOut, WouldBlock};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};
use std::sync::LazyLock;
use std::time::{Duration, Instant};

use super::resume::assert_same;
use super::{Kept, Place, SIZE, SMALL, png};
use raygrad::nerf::Image;
use raygrad::nerf::imaging::colormap;
use raygrad::nerf::imaging::metrics::psnr;
use serde_json::{Value, json};
use tungstenite::handshake::client::generate_key;
use tungstenite::http::Request;
use tungstenite::stream::MaybeTlsStream;
use tungstenite::{Message, WebSocket};

/// A program that serves a page; it ends when this is dropped.
pub struct Server {
    pub child: Child,
    /// Host and port.
    pub address: String,
    /// Token of its link.
    pub token: String,
}

impl Server {
    /// The printed link.
    pub fn link(&self) -> String {
        format!("http://{}/#token={}", self.address, self.token)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Starts a server and reads its link.
pub fn serve(place: &Place, arguments: &str) -> Server {
    serve_with(place.command(arguments).stderr(Stdio::null()))
}

fn serve_with(command: &mut Command) -> Server {
    let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
    let mut out = BufReader::new(child.stdout.take().unwrap());
    let mut line = String::new();
    while !line.starts_with("view ") {
        line.clear();
        assert!(out.read_line(&mut line).unwrap() > 0, "it has ended without a link");
    }
    // Drains the rest of its output.
    std::thread::spawn(move || std::io::copy(&mut out, &mut std::io::sink()));
    let (address, token) = line.split("http://").nth(1).unwrap().trim().split_once("/#token=").unwrap();
    Server { child, address: address.to_owned(), token: token.to_owned() }
}

/// Sends a plain request and returns status, head and body.
fn request(address: &str, head: &str) -> (u16, String, String) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.write_all(format!("{head}\r\nConnection: close\r\n\r\n").as_bytes()).unwrap();
    let mut answer = String::new();
    stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    stream.read_to_string(&mut answer).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap_or((&answer, ""));
    (head.split(' ').nth(1).unwrap().parse().unwrap(), head.to_lowercase(), body.to_owned())
}

/// A client without a browser.
pub struct Page {
    pub socket: WebSocket<MaybeTlsStream<TcpStream>>,
    /// Received messages that were not used yet.
    texts: VecDeque<Value>,
    files: VecDeque<(Value, Vec<u8>)>,
    /// The time of the last request, to limit the wait for an answer.
    said: Instant,
}

impl Page {
    pub fn open(Server { address, token, .. }: &Server) -> (Self, Value) {
        let request = Request::builder().uri(format!("ws://{address}/messages?token={token}"));
        let request = request.header("Host", address).header("Origin", format!("http://{address}"));
        let request = request.header("Connection", "Upgrade").header("Upgrade", "websocket");
        let request = request.header("Sec-WebSocket-Version", "13").header("Sec-WebSocket-Key", generate_key());
        let (socket, _) = tungstenite::connect(request.body(()).unwrap()).unwrap();
        if let MaybeTlsStream::Plain(stream) = socket.get_ref() {
            stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        }
        let mut page = Page { socket, texts: VecDeque::new(), files: VecDeque::new(), said: Instant::now() };
        let about = page.text("about");
        (page, about)
    }

    pub fn say(&mut self, message: Value) {
        self.said = Instant::now();
        self.socket.send(Message::text(message.to_string())).unwrap();
    }

    fn patience(&self, limit: Duration) {
        if let MaybeTlsStream::Plain(stream) = self.socket.get_ref() {
            stream.set_read_timeout(Some(limit)).unwrap();
        }
    }

    /// Receives messages for this long.
    fn hear(&mut self, within: Duration) {
        let start = Instant::now();
        self.patience(Duration::from_millis(20));
        while start.elapsed() < within {
            let _ = self.read();
        }
        self.patience(Duration::from_secs(60));
    }

    /// Returns true if no image arrives within this time.
    fn is_quiet(&mut self, within: Duration) -> bool {
        self.files.clear();
        self.hear(within);
        self.files.is_empty()
    }

    /// Reads one message; returns the reason if the connection was closed.
    fn read(&mut self) -> Result<(), String> {
        assert!(self.said.elapsed() < Duration::from_secs(300), "no answer");
        match self.socket.read() {
            Ok(Message::Text(text)) => self.texts.push_back(serde_json::from_str(&text).unwrap()),
            Ok(Message::Binary(bytes)) => {
                let length = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
                let head: Value = serde_json::from_slice(&bytes[4..4 + length]).unwrap();
                if head["file"] == "picture" {
                    let seen = json!({ "ask": "seen", "id": head["id"] });
                    self.socket.send(Message::text(seen.to_string())).unwrap();
                }
                self.files.push_back((head, bytes[4 + length..].to_vec()));
            }
            Ok(Message::Close(frame)) => return Err(frame.map_or(String::new(), |frame| frame.reason.to_string())),
            Ok(_) => (),
            Err(error) => return Err(error.to_string()),
        }
        Ok(())
    }

    /// Waits for the end of training and returns its message.
    fn ended(&mut self) -> Value {
        loop {
            self.said = Instant::now();
            let told = self.text("training");
            if !told["ended"].is_null() {
                return told;
            }
        }
    }

    fn text(&mut self, kind: &str) -> Value {
        loop {
            while let Some(text) = self.texts.pop_front() {
                if text["tell"] == kind {
                    return text;
                }
            }
            self.read().unwrap();
        }
    }

    pub fn file(&mut self, kind: &str) -> (Value, Vec<u8>) {
        loop {
            while let Some(file) = self.files.pop_front() {
                if file.0["file"] == kind {
                    return file;
                }
            }
            self.read().unwrap();
        }
    }

    /// The images of a view from coarse to complete, with their messages.
    fn look(&mut self, id: u32, view: &Value) -> Vec<(Value, Image)> {
        self.say(json!({ "ask": "view", "id": id, "view": view }));
        let mut pictures = vec![];
        loop {
            let (head, bytes) = self.file("picture");
            if head["id"] == id {
                let whole = head["halvings"] == 0;
                pictures.push((head, decoded(&bytes)));
                if whole {
                    return pictures;
                }
            }
        }
    }

    /// The reason why the program closes the connection, which it must.
    #[track_caller]
    pub fn closed(&mut self) -> String {
        let start = Instant::now();
        loop {
            assert!(start.elapsed() < Duration::from_secs(60), "the connection is still open");
            match self.socket.read() {
                Ok(Message::Close(frame)) => return frame.map_or(String::new(), |frame| frame.reason.to_string()),
                Ok(_) => (),
                Err(tungstenite::Error::Io(error)) if matches!(error.kind(), WouldBlock | TimedOut) => {
                    panic!("the connection is still open: {error}")
                }
                Err(error) => return error.to_string(),
            }
        }
    }
}

fn decoded(bytes: &[u8]) -> Image {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("picture");
    std::fs::write(&path, bytes).unwrap();
    png(&path)
}

/// The cameras of a run's test views as pages receive them.
pub fn test_cameras(place: &Place, run: &str) -> Vec<Value> {
    let server = serve(place, &format!("view {run}"));
    let about = Page::open(&server).1;
    let photographs = about["photographs"].as_array().unwrap();
    photographs.iter().filter(|photograph| photograph["split"] == "test").cloned().collect()
}

/// A place with a run that renders quickly.
pub fn trained() -> Place {
    static TRAINED: LazyLock<Kept> = LazyLock::new(|| {
        let place = Place::with_scene();
        place.succeeds(&format!("train scene --steps 60 --out run {SMALL}"));
        Kept::of(&place)
    });
    TRAINED.place()
}

/// The initial view of the scene.
pub fn first(about: &Value, size: [usize; 2]) -> Value {
    json!({ "eye": { "free": { "pose": about["pose"], "fov": about["fov"] } }, "size": size })
}

#[test]
fn page_image_equals_render() {
    let place = trained();
    place.succeeds("render run --frames 1 --size 96x96 --out seen");
    let expected = png(&place.path("seen/0000.png"));
    let server = serve(&place, "view run");
    let (mut page, about) = Page::open(&server);
    assert_eq!(json!([about["title"], about["training"], about["size"]]), json!(["run", false, [SIZE, SIZE]]));
    let names: Vec<_> = about["photographs"].as_array().unwrap().iter().map(|p| p["name"].clone()).collect();
    assert_eq!(names.len(), 11);
    assert_eq!(json!([names[0], names[6], names[8]]), json!(["train/r_0", "val/r_0", "test/r_0"]));
    let (view, start) = (first(&about, [96, 96]), Instant::now());
    let pictures = page.look(7, &view);
    let milliseconds: f64 = pictures.iter().map(|(head, _)| head["milliseconds"].as_f64().unwrap()).sum();
    assert!(milliseconds > 0.1 && milliseconds < 1e3 * start.elapsed().as_secs_f64(), "{milliseconds}");
    assert!(pictures.len() > 1, "of a program that knows nothing yet, a coarse one first");
    let (head, whole) = pictures.last().unwrap();
    assert!(psnr(whole, &expected) > 40.0, "{}", psnr(whole, &expected));
    assert!(head["compared"].is_null());
    // Coarse images show the same; each has half the size of the next.
    for pair in pictures.windows(2) {
        assert_eq!(pair[0].1.width, pair[1].1.width.div_ceil(2));
    }
    // Another client gets the rendered image at once.
    let (mut other, _) = Page::open(&server);
    assert_eq!(other.look(1, &view)[0].1, *whole);
    let shows = ["depth", "normals", "opacity"].map(|show| {
        place.succeeds(&format!("render run --frames 1 --size 96x96 --show {show} --out {show}"));
        let mut view = view.clone();
        view["show"] = json!(show);
        let seen = page.look(8, &view).pop().unwrap().1;
        let expected = png(&place.path(&format!("{show}/0000.png")));
        let expected = if expected.channels == 1 {
            Image { channels: 3, data: expected.data.iter().flat_map(|x| [*x; 3]).collect(), ..expected }
        } else {
            expected
        };
        // After few steps, colours vary from pixel to pixel, which JPEG compresses badly.
        assert!(psnr(&seen, &expected) > 30.0, "{show}: {}", psnr(&seen, &expected));
        seen
    });
    assert!(shows[0] != shows[1] && shows[1] != shows[2]);
    // A crop box and a background.
    let mut cropped = view.clone();
    cropped["crop"] = json!([[50.0, 50.0, 50.0], [51.0, 51.0, 51.0]]);
    cropped["background"] = json!([0, 0, 255]);
    let nothing = page.look(9, &cropped).pop().unwrap().1;
    assert!(nothing.data.chunks(3).all(|pixel| pixel[2] > 0.97 && pixel[0] < 0.03), "blue");
    // Saved images are exact.
    page.say(json!({ "ask": "save", "view": view }));
    let (head, bytes) = page.file("save");
    assert_eq!(head["name"], "view.png");
    // Tiles may end a ray a sample earlier or later.
    assert!(psnr(&decoded(&bytes), &expected) > 50.0);
    // Several are saved one after the other; too many are refused with a message.
    for _ in 0..12 {
        page.say(json!({ "ask": "save", "view": view }));
    }
    page.text("sorry");
    page.file("save");
}

#[test]
fn image_is_rendered_once_and_none_for_hidden_pages() {
    let place = Place::with_scene();
    let server = serve(&place, &format!("--threads 1 train scene --steps 1000000 --view --out run {SMALL}"));
    let (mut page, about) = Page::open(&server);
    // During training the view is rendered again, but not at a slow resolution.
    page.say(json!({ "ask": "view", "id": 1, "view": first(&about, [900, 900]) }));
    let shots: Vec<Value> = (0..4).map(|_| page.file("picture").0).collect();
    assert!(shots.iter().all(|head| head["halvings"] != 0), "{shots:?}");
    assert!(shots[3]["step"].as_u64().unwrap() > shots[0]["step"].as_u64().unwrap(), "{shots:?}");
    // Quick views are rendered twice a second, not at every step.
    page.look(5, &first(&about, [24, 24]));
    page.files.clear();
    page.texts.clear();
    page.hear(Duration::from_millis(1600));
    assert!((1..=4).contains(&page.files.len()), "{}", page.files.len());
    // Progress is not sent at every step either.
    assert!((1..=5).contains(&page.texts.len()), "{}", page.texts.len());
    let told = page.text("training");
    assert!(told["psnr"].as_f64().unwrap() > 5.0 && told["loss"].as_f64().unwrap() < 1.0, "{told}");
    assert!(told["left"] != "0 s" && told["curves"]["speed"][0].as_f64().unwrap() > 10.0, "{told}");
    page.say(json!({ "ask": "rest" }));
    page.hear(Duration::from_millis(500));
    assert!(page.is_quiet(Duration::from_millis(1200)));
    // Checkpoints are available after training.
    let mut view = first(&about, [8, 8]);
    view["checkpoint"] = json!(0);
    page.say(json!({ "ask": "view", "id": 2, "view": view }));
    assert!(page.text("sorry")["what"].as_str().unwrap().contains("only after training"));
    // While paused, the view is rendered once at full resolution.
    page.say(json!({ "ask": "view", "id": 6, "view": first(&about, [300, 300]) }));
    page.hear(Duration::from_millis(500));
    let is_whole = |head: &Value| head["halvings"] == 0;
    let went = page.files.drain(..).any(|(head, _)| is_whole(&head));
    page.say(json!({ "ask": "pause", "pause": true }));
    // Quick views are complete during training too.
    while !went && !is_whole(&page.file("picture").0) {}
    page.look(3, &first(&about, [64, 64]));
    assert!(page.is_quiet(Duration::from_millis(1200)));
}

/// A scene that is not cubic, is unbounded and is rotated in its coordinates.
#[test]
fn captures_keep_proportions_and_positions() {
    let place = Place::empty();
    place.add_landscape();
    let point = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                 property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0.25 -1.5 0.75 10 20 30\n";
    std::fs::write(place.path("around/points.ply"), point).unwrap();
    let mut transforms = place.json("around/transforms.json");
    transforms["ply_file_path"] = json!("points.ply");
    std::fs::write(place.path("around/transforms.json"), transforms.to_string()).unwrap();
    place.succeeds(&format!("train around --steps 30 --out run {SMALL}"));
    let server = serve(&place, "view run");
    let (mut page, about) = Page::open(&server);
    assert_eq!(json!([about["size"], about["photographs"][0]["size"]]), json!([[32, 24], [32, 24]]));
    assert!((about["proportion"].as_f64().unwrap() - 4.0 / 3.0).abs() < 1e-9);
    // In capture coordinates the point has its original position.
    let (given, to) = (about["points"][0][0].clone(), about["to_capture"].clone());
    let row = |r: usize| -> f64 {
        (0..3).map(|c| to[r][c].as_f64().unwrap() * given[c].as_f64().unwrap()).sum::<f64>()
            + to[r][3].as_f64().unwrap()
    };
    for (r, expected) in [0.25, -1.5, 0.75].into_iter().enumerate() {
        assert!((row(r) - expected).abs() < 1e-3, "{} {expected}", row(r));
    }
    assert_eq!(about["points"][0][1], json!([10, 20, 30]));
    assert!(row(0) != given[0].as_f64().unwrap(), "it was moved");
    // The whole image is shown in its own proportions, and normals are in the capture's axes.
    place.succeeds("render run --path test --size 32x24 --out color");
    place.succeeds("render run --path test --size 32x24 --show normals --out normals");
    let photographs = about["photographs"].as_array().unwrap();
    let first = photographs.iter().position(|photograph| photograph["split"] == "test").unwrap();
    for (id, show) in [(1, "color"), (2, "normals")] {
        let view = json!({ "eye": { "photograph": first + 1 }, "size": [32, 90], "show": show });
        page.say(json!({ "ask": "save", "view": view }));
        let (seen, expected) = (decoded(&page.file("save").1), png(&place.path(&format!("{show}/0001.png"))));
        assert_eq!([seen.width, seen.height], [32, 24]);
        assert!(psnr(&seen, &expected) > 40.0, "{show} {id}: {}", psnr(&seen, &expected));
    }
    // As a pinhole camera at that pose sees it.
    let photograph = &photographs[first + 1];
    let eye = json!({ "free": { "pose": photograph["pose"], "fov": photograph["fov"] } });
    page.say(json!({ "ask": "save", "view": { "eye": eye, "size": [32, 24] } }));
    let (seen, expected) = (decoded(&page.file("save").1), png(&place.path("color/0001.png")));
    assert!(psnr(&seen, &expected) > 40.0, "{}", psnr(&seen, &expected));
    assert_eq!(photograph["centre"], json!([0.5, 0.5]));
}

#[test]
fn built_in_images_are_distinct() {
    let place = Place::empty();
    place.succeeds(&format!("train embedded --downscale 20 --steps 1 --out run {SMALL}"));
    let server = serve(&place, "view run");
    let (mut page, _) = Page::open(&server);
    let photographs = [0, 3].map(|number| {
        page.say(json!({ "ask": "photograph", "number": number }));
        page.file("photograph").1
    });
    assert_ne!(photographs[0], photographs[1]);
}

#[test]
fn images_are_compared_from_their_cameras() {
    let place = trained();
    place.succeeds("eval run --split val");
    let scores = place.json("run/eval-val-fast.json");
    let server = serve(&place, "view run");
    let (mut page, about) = Page::open(&server);
    let view = json!({ "eye": { "photograph": 7 }, "size": [SIZE, SIZE], "compared": true });
    let (head, _) = page.look(1, &view).pop().unwrap();
    let errors =
        page.look(13, &json!({ "eye": { "photograph": 9 }, "size": [SIZE, SIZE], "compared": true })).pop().unwrap().1;
    place.succeeds(&format!("render run --path test --size {SIZE}x{SIZE} --out test"));
    let truth = png(&place.path("scene/test/r_1.png")).over([1.0; 3]);
    let map = colormap::error_map(&png(&place.path("test/0001.png")), &truth);
    assert!(psnr(&errors, &map) > 25.0, "{}", psnr(&errors, &map));
    // A crop box and another background do not count as errors.
    let mut cropped = view.clone();
    (cropped["crop"], cropped["background"]) = (json!([[50, 50, 50], [51, 51, 51]]), json!([0, 0, 255]));
    assert_eq!(page.look(11, &cropped).pop().unwrap().0["compared"], head["compared"]);
    assert_eq!(head["compared"][0], 7);
    let [seen, expected] = [&head["compared"][1], &scores["per_view"][1]["psnr"]].map(|x| x.as_f64().unwrap());
    assert!((seen - expected).abs() < 0.01, "{seen} {expected}");
    // An image is not enlarged for a comparison, and is shown whole beside others.
    let large = json!({ "eye": { "photograph": 7 }, "size": [300, 90], "compared": true });
    let (head, picture) = page.look(3, &large).pop().unwrap();
    assert_eq!([picture.width, picture.height], [SIZE, SIZE]);
    assert!((head["compared"][1].as_f64().unwrap() - expected).abs() < 0.01 && head["compared"][2] == true);
    // At another size the value differs, and coarse images have none.
    let pictures = page.look(14, &json!({ "eye": { "photograph": 7 }, "size": [20, 20], "compared": true }));
    let compared: Vec<&Value> = pictures.iter().map(|(head, _)| &head["compared"]).collect();
    assert!(compared.last().unwrap()[1].is_f64() && compared.iter().all(|told| told[2] == false), "{compared:?}");
    assert!(compared[..compared.len() - 1].iter().all(|told| told[1].is_null()), "{compared:?}");
    let large = json!({ "eye": { "photograph": 7 }, "size": [300, 90] });
    let picture = page.look(4, &large).pop().unwrap().1;
    assert_eq!([picture.width, picture.height], [90, 90]);
    // From a free camera, the nearest image.
    let mut near = view.clone();
    near["eye"] = json!({ "free": { "pose": about["photographs"][4]["pose"], "fov": 30.0 } });
    assert_eq!(page.look(2, &near).pop().unwrap().0["compared"][0], 4);
    // The orientation of a camera counts as much as its position.
    let [mut pose, other] = [5, 4].map(|i: usize| about["photographs"][i]["pose"].clone());
    for row in 0..3 {
        let [own, other] = [&pose, &other].map(|pose| pose[row][3].as_f64().unwrap());
        pose[row][3] = json!(0.45 * own + 0.55 * other);
    }
    near["eye"] = json!({ "free": { "pose": pose, "fov": 30.0 } });
    assert_eq!(page.look(12, &near).pop().unwrap().0["compared"][0], 5);
    page.say(json!({ "ask": "photograph", "number": 3 }));
    let (head, bytes) = page.file("photograph");
    let photograph = png(&place.path("scene/train/r_3.png")).over([1.0; 3]);
    assert!(head["number"] == 3 && psnr(&decoded(&bytes), &photograph) > 30.0);
    page.say(json!({ "ask": "photograph", "number": 99 }));
    assert!(page.text("sorry")["what"].as_str().unwrap().contains("no image 99"));
    // With the background of evaluations; and each test image is listed once.
    place.succeeds("prepare scene --to nerfstudio --out captured");
    place.succeeds(&format!("train captured --scene-type bounded --background black --steps 150 --out black {SMALL}"));
    place.succeeds("eval black");
    let server = serve(&place, "view black");
    let (mut page, about) = Page::open(&server);
    let tests = |about: &Value| -> Vec<usize> {
        let photographs = about["photographs"].as_array().unwrap().iter().enumerate();
        photographs.filter(|(_, photograph)| photograph["split"] == "test").map(|(i, _)| i).collect()
    };
    let numbers = tests(&about);
    let scores = place.json("black/eval-test-fast.json");
    assert_eq!(numbers.len(), scores["per_view"].as_array().unwrap().len());
    let mut names: Vec<String> =
        about["photographs"].as_array().unwrap().iter().map(|photograph| photograph["name"].to_string()).collect();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), about["photographs"].as_array().unwrap().len());
    let asked = json!({ "eye": { "photograph": numbers[0] }, "size": [SIZE, SIZE], "compared": true });
    let (head, _) = page.look(1, &asked).pop().unwrap();
    let [seen, expected] = [&head["compared"][1], &scores["per_view"][0]["psnr"]].map(|x| x.as_f64().unwrap());
    assert!((seen - expected).abs() < 0.02, "{seen} {expected}");
    // The background is that of training, also behind images.
    let (_, seen) = page.look(2, &first(&about, [32, 32])).pop().unwrap();
    page.say(json!({ "ask": "photograph", "number": numbers[0] }));
    let photograph = decoded(&page.file("photograph").1);
    assert!(seen.data[0] < 0.2 && photograph.data[0] < 0.2, "{} {}", seen.data[0], photograph.data[0]);
    // Without images, or with other ones, the rest works.
    let server = serve(&place, "view run --scene captured");
    assert_eq!(Page::open(&server).1["photographs"], json!([]));
    std::fs::rename(place.path("scene"), place.path("gone")).unwrap();
    let server = serve(&place, "view run --scene gone");
    assert_eq!(Page::open(&server).1["photographs"].as_array().unwrap().len(), 11);
    let server = serve(&place, "view run");
    let (mut page, about) = Page::open(&server);
    assert_eq!(about["photographs"], json!([]));
    for (id, view) in [(1, &view), (2, &json!({ "eye": { "photograph": 0 }, "size": [8, 8] }))] {
        page.say(json!({ "ask": "view", "id": id, "view": view }));
        assert!(page.text("sorry")["what"].as_str().unwrap().contains("not available"));
    }
    page.say(json!({ "ask": "photograph", "number": 0 }));
    assert!(page.text("sorry")["what"].as_str().unwrap().contains("not available"));
}

/// Evaluations use the embedding of each image, but pages use the mean of all.
#[test]
fn images_with_embeddings_have_no_psnr() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 60 --set field.appearance_embedding_dim=2 --out run {SMALL}"));
    place.succeeds("eval run");
    let scores = place.json("run/eval-test-fast.json");
    let server = serve(&place, "view run");
    let (mut page, _) = Page::open(&server);
    let mut compared = |number: usize| {
        let view = json!({ "eye": { "photograph": number }, "size": [SIZE, SIZE], "compared": true });
        page.look(number as u32, &view).pop().unwrap().0["compared"].clone()
    };
    assert_eq!(compared(1), json!([1, null, false]));
    let [seen, expected] = [&compared(8)[1], &scores["per_view"][0]["psnr"]].map(|x| x.as_f64().unwrap());
    assert!((seen - expected).abs() < 0.02, "{seen} {expected}");
}

#[test]
fn view_opens_the_browser() {
    use std::os::unix::fs::PermissionsExt;
    let place = Place::with_scene();
    let said = place.succeeds(&format!("train scene --steps 2 --out run {SMALL}"));
    for command in ["raygrad render run --out", "raygrad view run --open", "raygrad eval run"] {
        assert!(said.contains(command), "{command}: {said}");
    }
    let browser = place.path("xdg-open");
    std::fs::write(&browser, format!("#!/bin/sh\necho \"$1\" > {}\n", place.path("opened").display())).unwrap();
    std::fs::set_permissions(&browser, PermissionsExt::from_mode(0o755)).unwrap();
    let path = format!("{}:{}", place.path("").display(), std::env::var("PATH").unwrap());
    for (arguments, opens) in [("view run", false), ("view run --open", true)] {
        let mut command = place.command(arguments);
        let server = serve_with(command.env("PATH", &path).stderr(Stdio::null()));
        let start = Instant::now();
        let patience = Duration::from_secs(if opens { 30 } else { 1 });
        let opened = || std::fs::read_to_string(place.path("opened")).unwrap_or_default();
        while !opened().ends_with('\n') && start.elapsed() < patience {
            std::thread::sleep(Duration::from_millis(20));
        }
        let opened = opened();
        if !opens {
            assert_eq!(opened, "");
            continue;
        }
        // The browser gets a page that forwards, and not the token.
        let page = std::path::Path::new(opened.trim());
        assert!(
            !opened.contains(&server.token) && page.starts_with(place.path("run").canonicalize().unwrap()),
            "{opened}"
        );
        let text = std::fs::read_to_string(page).unwrap();
        assert!(text.contains(&format!("url={}\"", server.link())), "{text}");
        assert_eq!(std::fs::metadata(page).unwrap().permissions().mode() & 0o777, 0o600);
        // It stays, as a browser may be slow, and is removed when a page has connected.
        std::thread::sleep(Duration::from_millis(1500));
        assert!(page.exists());
        let (_page, _) = Page::open(&server);
        let start = Instant::now();
        while page.exists() {
            assert!(start.elapsed() < Duration::from_secs(30), "{opened}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

#[test]
fn viewer_refuses_others_without_the_token() {
    let place = trained();
    let server = serve(&place, "view run");
    let address = &server.address;
    let port = address.rsplit(':').next().unwrap();
    let (status, head, body) = request(address, &format!("GET / HTTP/1.1\r\nHost: {address}"));
    assert!(status == 200 && body.contains("<title>raygrad</title>"), "{head}");
    assert_eq!(request(address, &format!("GET / HTTP/1.1\r\nHost: evil.example:{port}")).0, 421);
    // An error names the port in use.
    place.fails(&format!("view run --port {port}"), &["`host`", port, "cannot be used"]);
    place.fails("view run --host nowhere.invalid", &["`host`", "nowhere.invalid"]);
    place.fails_with("train scene --steps 1 --out other --port 1", "`view`: is missing: --host and --port need --view");
    place.fails(&format!("train scene --steps 1 --view --port {port} --out other"), &["`host`", port]);
    assert!(!place.path("other").exists(), "nothing is begun");
    place.fails_with("view absent", "absent: there is no such folder");
    let server = serve(&place, "view run --host 0.0.0.0");
    let port = server.address.rsplit(':').next().unwrap().to_owned();
    let address = format!("127.0.0.1:{port}");
    let status = |path: &str| request(&address, &format!("GET {path} HTTP/1.1\r\nHost: {address}")).0;
    // The page holds no data; its messages need the token.
    assert_eq!([status("/"), status("/access"), status(&format!("/access?token={}", server.token))], [200, 403, 204]);
}

#[test]
fn malformed_message_closes_its_connection() {
    let place = trained();
    let server = serve(&place, "view run");
    let (mut good, about) = Page::open(&server);
    let (mut page, _) = Page::open(&server);
    page.say(json!({ "ask": "view", "id": 1, "view": first(&about, [4096, 4096]) }));
    assert!(page.closed().contains("4096x4096 is not a size"));
    // An error names an unknown image, and the other page is still served.
    good.say(json!({ "ask": "view", "id": 5, "view": { "eye": { "photograph": 4000 }, "size": [16, 16] } }));
    assert!(good.text("sorry")["what"].as_str().unwrap().contains("no such image"));
    assert_eq!(good.look(6, &first(&about, [16, 16])).pop().unwrap().0["id"], 6);
}

#[test]
fn newest_camera_replaces_older_requests() {
    let place = trained();
    let server = serve(&place, "view run");
    let (mut page, about) = Page::open(&server);
    let mut view = first(&about, [300, 300]);
    // All but the last of many views are hardly rendered.
    for id in 1..=100 {
        view["eye"]["free"]["pose"][0][3] = json!(0.01 * f64::from(id));
        page.say(json!({ "ask": "view", "id": id, "view": view }));
    }
    let mut pictures = 0;
    loop {
        let (head, _) = page.file("picture");
        pictures += 1;
        if head["id"] == 100 && head["halvings"] == 0 {
            break;
        }
        assert!(head["id"] == 100 || head["halvings"] != 0, "{head}");
    }
    assert!(pictures < 60, "{pictures}");
}

#[test]
fn training_viewer_pauses_and_stops_same_model() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 300 --out whole {SMALL}"));
    let said = std::fs::File::create(place.path("said")).unwrap();
    let mut command = place.command(&format!("train scene --steps 300 --view --out run {SMALL}"));
    let mut server = serve_with(command.stderr(said));
    let (mut page, about) = Page::open(&server);
    assert_eq!(about["training"], true);
    page.say(json!({ "ask": "pause", "pause": true }));
    while page.text("training")["paused"] != true {}
    let view = first(&about, [32, 32]);
    let (head, _) = page.look(1, &view).pop().unwrap();
    let held = head["step"].as_u64().unwrap();
    page.texts.clear();
    assert_eq!(page.text("training")["step"], held, "it waits");
    // A page that reconnects soon finds the training as it was.
    drop(page);
    std::thread::sleep(Duration::from_millis(600));
    let (mut page, _) = Page::open(&server);
    let told = page.text("training");
    assert_eq!(json!([told["paused"], told["step"]]), json!([true, held]));
    page.say(json!({ "ask": "view", "id": 2, "view": view }));
    page.say(json!({ "ask": "share", "share": 0.5 }));
    while page.text("training")["share"] != 0.5 {}
    page.say(json!({ "ask": "pause", "pause": false }));
    // Rendering continues with training until its end.
    let mut again = held;
    let ended = loop {
        while let Some((head, _)) = page.files.pop_front() {
            again = head["step"].as_u64().unwrap();
        }
        if let Some(told) = page.texts.pop_front().filter(|told| !told["ended"].is_null()) {
            break told;
        }
        page.read().unwrap();
    };
    assert!(again > held, "{again}");
    assert_eq!(json!([ended["step"], ended["ended"]]), json!([300, "done"]));
    assert!(ended["curves"]["loss"].as_array().unwrap().len() > 10, "{ended}");
    // The viewer stays open until its page closes; meanwhile the run is unlocked.
    page.say(json!({ "ask": "view", "id": 9, "view": view }));
    while page.file("picture").0["step"] != 300 {}
    place.succeeds("train --resume run --steps 300");
    drop(page);
    assert_eq!(server.child.wait().unwrap().code(), Some(0));
    assert_same(&place, "whole", "run");
    let said = String::from_utf8_lossy(&place.bytes("said")).into_owned();
    for words in ["training paused by the viewer", "training resumed", "the viewer stays open until its page closes"] {
        assert_eq!(said.matches(words).count(), 1, "{words}: {said}");
    }

    // A run stopped from the page can be resumed.
    let mut server = serve(&place, &format!("train scene --steps 300 --view --out other {SMALL}"));
    let (mut page, _) = Page::open(&server);
    page.say(json!({ "ask": "pause", "pause": true }));
    while page.text("training")["paused"] != true {}
    page.say(json!({ "ask": "stop" }));
    let ended = page.ended();
    assert!(ended["step"].as_u64().unwrap() < 300 && ended["ended"] == "stopped and saved", "{ended}");
    drop(page);
    assert_eq!(server.child.wait().unwrap().code(), Some(0));
    place.succeeds("train --resume other");
    assert_same(&place, "whole", "other");
}

#[test]
fn viewer_checkpoints_and_skips_equal_render() {
    let place = Place::with_scene();
    // With uniform steps, short ones skip visible parts.
    let train = format!("train scene --steps 150 --checkpoint-every 0.02s {SMALL} --set sampler.cone=0");
    place.succeeds(&format!("{train} --keep-checkpoints 500 --out run"));
    assert_eq!(place.command("train scene --keep-checkpoints 1").output().unwrap().status.code(), Some(2));
    let server = serve(&place, "view run");
    let (mut page, about) = Page::open(&server);
    let steps: Vec<u64> = about["checkpoints"].as_array().unwrap().iter().map(|step| step.as_u64().unwrap()).collect();
    assert!(steps.len() > 4 && steps.is_sorted() && [steps[0], steps[steps.len() - 1]] == [0, 150], "{steps:?}");
    let view = first(&about, [64, 64]);
    let with = |name: &str, value: Value| {
        let mut view = view.clone();
        view[name] = value;
        view
    };
    assert_eq!(page.look(1, &view).pop().unwrap().0["step"], 0, "the model itself");
    let kept = |page: &mut Page, view: &Value| {
        page.say(json!({ "ask": "save", "view": view }));
        decoded(&page.file("save").1)
    };
    let last = kept(&mut page, &view);
    // A run that ended at a checkpoint has the same model.
    let earlier = *steps.iter().find(|step| **step > 30).unwrap();
    place.succeeds(&format!("{train} --keep-checkpoints 3 --out other"));
    let checkpoints = place.path("other/checkpoints");
    assert_eq!(std::fs::read_dir(&checkpoints).unwrap().count(), 3);
    std::fs::remove_dir_all(&checkpoints).unwrap();
    std::fs::create_dir(&checkpoints).unwrap();
    let name = format!("{earlier:08}.checkpoint");
    std::fs::copy(place.path(&format!("run/checkpoints/{name}")), checkpoints.join(name)).unwrap();
    place.succeeds(&format!("train --resume other --steps {earlier}"));
    place.succeeds("render other --frames 1 --size 64x64 --out earlier");
    // On a busy machine this takes so long that the server drops the silent page.
    let (mut page, _) = Page::open(&server);
    let at_earlier = with("checkpoint", json!(earlier));
    assert_eq!(page.look(2, &at_earlier).pop().unwrap().0["step"], earlier);
    let before = kept(&mut page, &at_earlier);
    let expected = png(&place.path("earlier/0000.png"));
    assert!(psnr(&before, &expected) > 50.0, "{}", psnr(&before, &expected));
    assert!(psnr(&last, &expected) < 40.0, "{}", psnr(&last, &expected));
    // The last checkpoint equals the final model, up to its rounding.
    let same = kept(&mut page, &with("checkpoint", json!(150)));
    assert!(psnr(&same, &last) > 50.0, "{}", psnr(&same, &last));
    // More than fit in memory, and back.
    for (id, step) in (4..).zip([steps[1], steps[2], steps[3], steps[4], steps[1]]) {
        assert_eq!(page.look(id, &with("checkpoint", json!(step))).pop().unwrap().0["step"], step);
    }
    for (id, skip) in (10..).zip(["off", "near-lossless", "fast"]) {
        for (id, show) in [(id, "color"), (id + 10, "normals")] {
            place.succeeds(&format!(
                "render run --frames 1 --size 64x64 --skip {skip} --show {show} --out {skip}-{show}"
            ));
            let mut view = with("skip", json!(skip));
            view["show"] = json!(show);
            let seen = kept(&mut page, &view);
            let expected = png(&place.path(&format!("{skip}-{show}/0000.png")));
            assert!(psnr(&seen, &expected) > 45.0, "{skip} {show} {id}: {}", psnr(&seen, &expected));
        }
    }
    // Each skip setting gives its own image.
    let [off, fast] = ["off", "fast"].map(|skip| png(&place.path(&format!("{skip}-color/0000.png"))));
    assert!(psnr(&off, &fast) < 65.0, "{}", psnr(&off, &fast));
    for (skip, own, other) in [("off", &off, &fast), ("fast", &fast, &off)] {
        let seen = kept(&mut page, &with("skip", json!(skip)));
        assert!(psnr(&seen, own) > psnr(&seen, other), "{skip}: {} {}", psnr(&seen, own), psnr(&seen, other));
    }
    // An error names the absent checkpoint, and other requests continue.
    for kind in ["view", "save"] {
        page.say(
            json!({ "ask": kind, "id": 30, "view": with("checkpoint", json!(151)) })
                .as_object()
                .map(|asked| {
                    let mut asked = asked.clone();
                    if kind == "save" {
                        asked.remove("id");
                    }
                    Value::Object(asked)
                })
                .unwrap(),
        );
        let what = page.text("sorry")["what"].as_str().unwrap().to_owned();
        assert!(what.contains("no checkpoint of step 151"), "{kind}: {what}");
    }
    std::fs::write(place.path(&format!("run/checkpoints/{:08}.checkpoint", steps[1])), b"nothing").unwrap();
    for id in [32, 33] {
        page.say(json!({ "ask": "view", "id": id, "view": with("checkpoint", json!(steps[1])) }));
        let what = page.text("sorry")["what"].as_str().unwrap().to_owned();
        assert!(what.contains(&format!("{:08}.checkpoint", steps[1])) && what.contains("damaged"), "{what}");
    }
    assert_eq!(page.look(34, &view).pop().unwrap().0["step"], 0);
}

/// A path between two keyframes, as the page saves it.
fn path(about: &Value, seconds: f64) -> Value {
    let frame = |fov: f64| {
        let pose = about["photographs"][0]["pose"].as_array().unwrap();
        let mut matrix: Vec<Value> = pose.iter().flat_map(|row| row.as_array().unwrap().clone()).collect();
        matrix.extend([0, 0, 0, 1].map(Value::from));
        json!({ "matrix": matrix, "fov": fov })
    };
    json!({ "keyframes": [frame(40.0), frame(50.0)], "camera_type": "perspective", "render_width": 16, "render_height": 12,
        "is_cycle": false, "seconds": seconds, "fps": 5, "smoothness_value": 0, "camera_path": [] })
}

#[test]
fn videos_are_made_one_at_a_time_beside_views() {
    let place = trained();
    let server = serve(&place, "view run");
    let (mut page, about) = Page::open(&server);
    let ended = |page: &mut Page| loop {
        let told = page.text("video");
        if told["ended"] == true {
            return told;
        }
    };
    page.say(json!({ "ask": "video", "path": path(&about, 0.8), "show": "depth" }));
    let told = ended(&mut page);
    assert_eq!(told["words"], "done");
    let video = told["file"].as_str().unwrap();
    assert!(
        video.starts_with("run/videos/video-1.") && std::fs::metadata(place.path(video)).unwrap().len() > 100,
        "{video}"
    );
    assert!(!place.path(&format!("{video}.frames")).exists());
    // Rendering the same path by hand gives the same video.
    let ending = video.rsplit('.').next().unwrap();
    place.succeeds(&format!("render run --path run/videos/video-1.json --show depth --overwrite --out again.{ending}"));
    let bytes = [video, &format!("again.{ending}")].map(|name| std::fs::read(place.path(name)).unwrap());
    assert!(bytes[0] == bytes[1]);
    // A long video blocks a second one, but neither views nor its cancellation.
    page.say(json!({ "ask": "video", "path": path(&about, 600.0) }));
    page.text("video");
    page.say(json!({ "ask": "video", "path": path(&about, 1.0) }));
    assert!(page.text("sorry")["what"].as_str().unwrap().contains("another video is rendering"));
    page.look(1, &first(&about, [16, 16]));
    page.say(json!({ "ask": "end-video" }));
    assert_eq!(ended(&mut page)["words"], "cancelled");
    let videos = || std::fs::read_dir(place.path("run/videos")).unwrap().count();
    assert_eq!(videos(), 2, "nothing is left of it");
    // With the layer, background and skip settings of the view.
    for (video, flags) in [
        (json!({ "path": path(&about, 0.4), "show": "normals", "skip": "off" }), "--show normals --skip off"),
        (json!({ "path": path(&about, 0.4), "show": "opacity" }), "--show opacity"),
        (json!({ "path": path(&about, 0.4), "background": [0, 128, 255] }), "--background 0,128,255"),
    ] {
        let mut asked = video;
        asked["ask"] = json!("video");
        page.say(asked);
        let told = ended(&mut page);
        assert_eq!(told["words"], "done", "{told}");
        let video = told["file"].as_str().unwrap().to_owned();
        let path = video.replace(ending, "json");
        place.succeeds(&format!("render run --path {path} {flags} --overwrite --out again.{ending}"));
        let bytes = [&*video, &format!("again.{ending}")].map(|name| std::fs::read(place.path(name)).unwrap());
        assert!(bytes[0] == bytes[1], "{flags}");
    }
    // The parser's error names an invalid path.
    let mut fisheye = path(&about, 1.0);
    fisheye["camera_type"] = json!("fisheye");
    page.say(json!({ "ask": "video", "path": fisheye }));
    let words = ended(&mut page)["words"].as_str().unwrap().to_owned();
    assert!(words.contains("video-5.json") && words.contains("perspective"), "{words}");
    // A program that ends also ends its video.
    page.say(json!({ "ask": "video", "path": path(&about, 600.0) }));
    let video = page.text("video")["file"].as_str().unwrap().to_owned();
    let frames = place.path(&format!("{video}.frames"));
    while std::fs::read_dir(&frames).map_or(0, |found| found.count()) < 4 {
        std::thread::sleep(Duration::from_millis(20));
    }
    drop(server);
    let count = || std::fs::read_dir(&frames).map_or(0, |found| found.count());
    std::thread::sleep(Duration::from_millis(1000));
    let then = count();
    std::thread::sleep(Duration::from_millis(400));
    assert_eq!(count(), then);
    let server = serve(&place, "view run");
    let (mut page, about) = Page::open(&server);
    page.say(json!({ "ask": "end-video" }));
    page.look(2, &first(&about, [17, 16]));
    let server = serve(&place, &format!("--threads 1 train scene --steps 1000000 --view --out other {SMALL}"));
    let (mut page, about) = Page::open(&server);
    page.say(json!({ "ask": "video", "path": path(&about, 1.0) }));
    assert!(page.text("sorry")["what"].as_str().unwrap().contains("only after training"));
    assert!(!place.path("other/videos").exists());
}

#[test]
fn viewer_knows_refined_cameras() {
    let place = Place::with_scene();
    let server =
        serve(&place, &format!("--threads 1 train scene --steps 1000000 --refine poses --view --out run {SMALL}"));
    let (mut page, about) = Page::open(&server);
    let taken = page.text("taken");
    let poses =
        |told: &Value| told["photographs"].as_array().unwrap().iter().map(|p| p["pose"].clone()).collect::<Vec<_>>();
    assert!(poses(&taken).len() == poses(&about).len() && poses(&taken) != poses(&about));
    assert_ne!(taken["to_capture"], about["to_capture"]);
    // Each is close to its own given pose, not to another's.
    let apart = |a: &Value, b: &Value| -> f64 {
        let at = |pose: &Value, row: usize| pose[row][3].as_f64().unwrap();
        (0..3).map(|row| (at(a, row) - at(b, row)).powi(2)).sum()
    };
    for (i, own) in poses(&taken).iter().enumerate() {
        let nearest =
            poses(&about).iter().map(|other| apart(own, other)).enumerate().min_by(|a, b| a.1.total_cmp(&b.1));
        assert_eq!(nearest.unwrap().0, i);
    }
    // A page that connects later gets the current cameras.
    let (_, later) = Page::open(&server);
    assert_ne!(poses(&later), poses(&about));
}

#[test]
fn idle_page_uses_no_cpu_time() {
    let place = trained();
    let server = serve(&place, "view run");
    let (mut page, about) = Page::open(&server);
    page.look(1, &first(&about, [32, 32]));
    // In hundredths of a second, if the system reports it.
    let taken = || -> Option<u64> {
        let text = std::fs::read_to_string(format!("/proc/{}/stat", server.child.id())).ok()?;
        let numbers: Vec<&str> = text.rsplit(')').next()?.split_whitespace().collect();
        Some(numbers[11].parse::<u64>().ok()? + numbers[12].parse::<u64>().ok()?)
    };
    page.hear(Duration::from_millis(500));
    let before = taken();
    page.hear(Duration::from_secs(1));
    if let Some((before, after)) = before.zip(taken()) {
        assert!(after - before < 10, "{} hundredths of 100", after - before);
    }
}

#[test]
fn unreadable_images_are_named() {
    let place = trained();
    let server = serve(&place, "view run");
    let (mut page, about) = Page::open(&server);
    std::fs::write(place.path("scene/train/r_3.png"), b"nothing").unwrap();
    let view = json!({ "eye": { "photograph": 3 }, "size": [16, 16], "compared": true });
    page.say(json!({ "ask": "view", "id": 1, "view": view }));
    assert!(page.text("sorry")["what"].as_str().unwrap().contains("r_3.png"));
    page.say(json!({ "ask": "photograph", "number": 3 }));
    assert!(page.text("sorry")["what"].as_str().unwrap().contains("r_3.png"));
    page.look(2, &first(&about, [16, 16]));
}

/// The view turned about the vertical, in radians.
fn turned(view: &Value, angle: f64) -> Value {
    let (sin, cos) = angle.sin_cos();
    let mut view = view.clone();
    let pose = view["eye"]["free"]["pose"].clone();
    for column in 0..4 {
        let [x, y] = [0, 1].map(|row: usize| pose[row][column].as_f64().unwrap());
        view["eye"]["free"]["pose"][0][column] = json!(cos * x - sin * y);
        view["eye"]["free"]["pose"][1][column] = json!(sin * x + cos * y);
    }
    view
}

/// `VIEWED=RUN,RUN cargo test --release --test cli milliseconds -- --nocapture` measures other runs, given by absolute
/// paths.
#[test]
fn milliseconds_from_drag_to_first_and_final_image() {
    let place = trained();
    let given = std::env::var("VIEWED").ok();
    let runs = given.as_deref().unwrap_or("run").split(',');
    let sizes: &[usize] = if given.is_some() { &[400, 800] } else { &[40] };
    for (run, &side) in runs.flat_map(|run| sizes.iter().map(move |side| (run, side))) {
        let server = serve(&place, &format!("view {run}"));
        let (mut page, about) = Page::open(&server);
        let view = first(&about, [side, side]);
        // The first views measure the speed of the machine.
        page.look(0, &view);
        let count = if given.is_some() { 15 } else { 4 };
        let (mut firsts, mut wholes, mut coarse) = (vec![], vec![], 0);
        for id in 1..=count {
            let start = Instant::now();
            page.say(json!({ "ask": "view", "id": id, "view": turned(&view, 0.07 * f64::from(id)) }));
            let mut begun = None;
            loop {
                let (head, bytes) = page.file("picture");
                if head["id"] != id {
                    continue;
                }
                let milliseconds = 1e3 * start.elapsed().as_secs_f64();
                if begun.is_none() {
                    begun = Some(milliseconds);
                    coarse = decoded(&bytes).width;
                }
                if head["halvings"] == 0 {
                    wholes.push(milliseconds);
                    break;
                }
            }
            firsts.push(begun.unwrap());
        }
        // A continuous drag: the next view as soon as an image arrives.
        let (start, mut frames) = (Instant::now(), 0);
        let seconds = if given.is_some() { 5.0 } else { 0.5 };
        while start.elapsed().as_secs_f64() < seconds {
            frames += 1;
            let id = 100 + frames;
            page.say(json!({ "ask": "view", "id": id, "view": turned(&view, 0.02 * f64::from(frames)) }));
            while page.file("picture").0["id"] != id {}
        }
        let median = |values: &mut Vec<f64>| {
            values.sort_by(f64::total_cmp);
            values[values.len() / 2]
        };
        let rate = f64::from(frames) / start.elapsed().as_secs_f64();
        let [first, whole] = [median(&mut firsts), median(&mut wholes)];
        println!(
            "{run} at {side}x{side}: first picture ({coarse} wide) after {first:.0} ms, the whole after {whole:.0} ms; \
             {rate:.1} pictures a second while dragging"
        );
        assert!(first > 0.0 && first <= whole && rate > 1.0, "{first} {whole} {rate}");
    }
}

/// `COST=SCENE cargo test --release --test cli what_pages_cost -- --ignored --nocapture` measures how much longer training on
/// a scene takes.
#[test]
#[ignore = "measurement: COST names the scene to train on"]
fn what_pages_cost_training() {
    const ROUNDS: usize = 7;
    let scene = std::env::var("COST").expect("COST=SCENE names the scene to train on");
    let place = Place::empty();
    // The time and CPU use of training without a page, with a hidden page and with a visible one. The clock ticks of
    // ended children include those of other tests.
    let processor = || -> f64 {
        let text = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
        let (_, numbers) = text.rsplit_once(')').unwrap_or_default();
        numbers.split_whitespace().skip(13).take(2).flat_map(str::parse::<f64>).sum()
    };
    let seconds = |round: usize, looks: Option<bool>| {
        let used = processor();
        let view = if looks.is_some() { "--view" } else { "" };
        let start = Instant::now();
        let command = format!("train {scene} --steps 1000 {view} --out run-{round}-{looks:?}");
        let Some(looks) = looks else {
            place.succeeds(&command);
            return [start.elapsed().as_secs_f64(), processor() - used];
        };
        let mut server = serve(&place, &command);
        let (mut page, about) = Page::open(&server);
        let asked = match looks {
            true => json!({ "ask": "view", "id": 1, "view": first(&about, [400, 400]) }),
            false => json!({ "ask": "rest" }),
        };
        page.say(asked);
        page.ended();
        let seconds = start.elapsed().as_secs_f64();
        drop(page);
        assert_eq!(server.child.wait().unwrap().code(), Some(0));
        [seconds, processor() - used]
    };
    seconds(0, None);
    let (mut idle, mut busy, mut used) = (vec![], vec![], vec![]);
    for round in 1..=ROUNDS {
        let [without, rest, looks] = [None, Some(false), Some(true)].map(|looks| seconds(round, looks));
        idle.push(rest[0] / without[0]);
        busy.push(looks[0] / without[0]);
        // Only Linux reports it.
        if without[1] > 0.0 {
            used.push(rest[1] / without[1]);
        }
    }
    let all = [
        ("that nobody looks at", &mut idle),
        ("that is looked at", &mut busy),
        ("that nobody looks at, to the processor,", &mut used),
    ];
    for (what, ratios) in all.into_iter().filter(|(_, ratios)| !ratios.is_empty()) {
        ratios.sort_by(f64::total_cmp);
        let [least, middle, most] = [ratios[0], ratios[ROUNDS / 2], ratios[ROUNDS - 1]];
        println!("a page {what} makes training take {middle:.3} times as long ({least:.3} to {most:.3} of {ROUNDS})");
        assert!(least > 0.1 && most < 20.0, "{ratios:?}");
    }
}

/// `LOAD=all cargo test --release --test cli many_pages -- --nocapture` tests fifty pages and ten thousand invalid
/// messages.
#[test]
fn many_pages_do_not_affect_memory_or_training() {
    let all = std::env::var("LOAD").is_ok_and(|which| which == "all");
    let (pages, nonsense, steps) = if all { (50, 10_000, 6000) } else { (6, 100, 150) };
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps {steps} --out whole {SMALL}"));
    let mut server = serve(&place, &format!("train scene --steps {steps} --view --out run {SMALL}"));
    let memory = {
        let status = format!("/proc/{}/status", server.child.id());
        move || -> Option<f64> {
            let text = std::fs::read_to_string(&status).ok()?;
            let line = text.lines().find(|line| line.starts_with("VmRSS:"))?;
            line.split_whitespace().nth(1)?.parse::<f64>().ok().map(|kilobytes| kilobytes / 1e3)
        }
    };
    let (mut held, about) = Page::open(&server);
    held.say(json!({ "ask": "pause", "pause": true }));
    while held.text("training")["paused"] != true {}
    let before = memory();
    // Every third page reads nothing; pairs of pages share a view.
    let view = first(&about, [96, 96]);
    let mut others: Vec<Page> = (0..pages).map(|_| Page::open(&server).0).collect();
    for (i, page) in others.iter_mut().enumerate() {
        page.say(json!({ "ask": "view", "id": 1, "view": turned(&view, 0.1 * (i / 2) as f64) }));
    }
    // Pages that read get a complete image despite the others.
    let mut waiting: Vec<&mut Page> =
        others.iter_mut().enumerate().filter(|(i, _)| i % 3 != 0).map(|(_, p)| p).collect();
    while !waiting.is_empty() {
        waiting.retain_mut(|page| {
            page.hear(Duration::from_millis(20));
            assert!(page.said.elapsed() < Duration::from_secs(200), "no whole picture");
            !page.files.iter().any(|(head, _)| head["halvings"] == 0)
        });
    }
    let mut random = 7_u32;
    let letters = br#"{}[]":,0189.eE-+"askview idpose\u0000 "#;
    for which in 0..nonsense {
        if which % 100 == 0 {
            held.hear(Duration::from_millis(50));
        }
        let text: String = (0..40)
            .map(|_| {
                random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                char::from(letters[(random >> 16) as usize % letters.len()])
            })
            .collect();
        let (mut page, _) = Page::open(&server);
        page.socket.send(Message::text(text)).unwrap();
        let reason = page.closed();
        assert!(reason.contains(" at line 1 column ") || reason.contains("unknown variant"), "{reason}");
    }
    let after = memory();
    println!("{pages} pages, {nonsense} messages that are none: {before:?} MB before, {after:?} MB after");
    if let Some((before, after)) = before.zip(after) {
        assert!(after - before < 200.0, "{before} MB before, {after} MB after");
    }
    drop(others);
    held.say(json!({ "ask": "pause", "pause": false }));
    held.ended();
    drop(held);
    assert_eq!(server.child.wait().unwrap().code(), Some(0));
    assert_same(&place, "whole", "run");
}
