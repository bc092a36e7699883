use std::io::ErrorKind::{TimedOut, WouldBlock};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Instant;

use super::*;
use crate::render::shown::Show;
use crate::view::messages::{Eye, Made, View};
use crate::view::requests::{Outgoing, RenderedFrame};
use serde_json::{Value, json};
use tungstenite::handshake::client::generate_key;
use tungstenite::http::Request;
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Message, WebSocket};

/// Longer than any step of a test.
const LONG: Duration = Duration::from_secs(30);
/// Length of a message that exceeds all socket buffers.
const HUGE: usize = 48 << 20;

fn served_at(host: &str, limits: Limits) -> (String, Arc<Requests>) {
    let requests = Arc::new(Requests::default());
    requests.introduce(r#"{"tell":"about"}"#.to_owned());
    let listener = Listener::bind(host, 0).unwrap();
    let link = serve(limits, listener, requests.clone(), None, None, [1.0; 3]).unwrap();
    (link.strip_prefix("http://").unwrap().to_owned(), requests)
}

/// The host and the token of a link.
fn parts(link: &str) -> (String, String) {
    let (address, token) = link.split_once("/#token=").unwrap();
    (address.trim_start_matches("http://").to_owned(), token.to_owned())
}

/// Address and token of a local server.
#[derive(Clone)]
struct Local {
    address: String,
    token: String,
}

/// Starts a local server.
fn served(limits: Limits) -> (Local, Arc<Requests>) {
    let (link, requests) = served_at("127.0.0.1", limits);
    let (address, token) = parts(&link);
    (Local { address, token }, requests)
}

fn connect(address: &str) -> TcpStream {
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(LONG)).unwrap();
    stream
}

/// Sends a raw request and returns status, head and body.
fn request(address: &str, head: &str) -> (u16, String, String) {
    let mut stream = connect(address);
    stream.write_all(format!("{head}\r\nConnection: close\r\n\r\n").as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    (head.split(' ').nth(1).unwrap().parse().unwrap(), head.to_lowercase(), body.to_owned())
}

/// Sends a WebSocket upgrade request with this origin and returns the status.
fn upgraded(address: &str, path: &str, origin: Option<&str>) -> (TcpStream, String) {
    let origin = origin.map(|origin| format!("Origin: {origin}\r\n")).unwrap_or_default();
    let head = format!(
        "GET {path} HTTP/1.1\r\nHost: {address}\r\n{origin}Connection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    );
    let mut stream = connect(address);
    stream.write_all(head.as_bytes()).unwrap();
    let mut start = [0; 12];
    stream.read_exact(&mut start).unwrap();
    let status = String::from_utf8_lossy(&start[9..]).into_owned();
    (stream, status)
}

/// Like [`upgraded`], with the origin of a page.
fn joined(Local { address, token }: &Local) -> (TcpStream, String) {
    upgraded(address, &format!("/messages?token={token}"), Some(&format!("http://{address}")))
}

/// Waits until the condition holds.
#[track_caller]
fn becomes(mut so: impl FnMut() -> bool) {
    let start = Instant::now();
    while !so() {
        assert!(start.elapsed() < LONG);
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A test client of the WebSocket.
struct Client {
    socket: WebSocket<TcpStream>,
    opened: Instant,
}

impl Client {
    fn open(server: &Local) -> Self {
        let mut page = Client::connect(server);
        assert_eq!(page.text()["tell"], "about");
        page
    }

    /// Connects without reading a message.
    fn connect(Local { address, token }: &Local) -> Self {
        let request = Request::builder().uri(format!("ws://{address}/messages?token={token}"));
        let request = request.header("Host", address).header("Origin", format!("http://{address}"));
        let request = request.header("Connection", "Upgrade").header("Upgrade", "websocket");
        let request = request.header("Sec-WebSocket-Version", "13").header("Sec-WebSocket-Key", generate_key());
        let config = WebSocketConfig::default().max_message_size(None).max_frame_size(None);
        let stream = connect(address);
        let opened = Instant::now();
        let answer = tungstenite::client::client_with_config(request.body(()).unwrap(), stream, Some(config));
        Client { socket: answer.unwrap().0, opened }
    }

    fn say(&mut self, message: &Value) {
        self.socket.send(Message::text(message.to_string())).unwrap();
    }

    /// The next message, or the reason for the end of the connection.
    #[track_caller]
    fn read(&mut self) -> Result<Message, String> {
        assert!(self.opened.elapsed() < 2 * LONG, "there is no end");
        match self.socket.read() {
            Ok(Message::Close(frame)) => Err(frame.map_or(String::new(), |frame| frame.reason.to_string())),
            Ok(message) => Ok(message),
            Err(error) => Err(error.to_string()),
        }
    }

    /// The next text message.
    #[track_caller]
    fn text(&mut self) -> Value {
        loop {
            if let Message::Text(text) = self.read().unwrap() {
                return serde_json::from_str(&text).unwrap();
            }
        }
    }

    /// Reads up to the end of the connection. Returns the number of binary messages and the reason for the end.
    #[track_caller]
    fn closed(&mut self) -> (usize, String) {
        let mut files = 0;
        loop {
            match self.read() {
                Ok(message) => files += usize::from(message.is_binary()),
                Err(reason) => return (files, reason),
            }
        }
    }
}

type Result<T, E> = std::result::Result<T, E>;

#[test]
fn server_refuses_other_hosts_and_other_paths() {
    let listener = Listener::bind("127.0.0.1", 0).unwrap();
    let link = serve(Limits::USUAL, listener, Arc::new(Requests::default()), None, None, [1.0; 3]).unwrap();
    let (address, token) = parts(&link);
    let port = address.rsplit(':').next().unwrap();
    let taken = Listener::bind("127.0.0.1", port.parse().unwrap()).map(drop).unwrap_err().to_string();
    assert!(taken.contains(port) && taken.contains("cannot be used"), "{taken}");
    let (status, head, page) = request(&address, &format!("GET / HTTP/1.1\r\nHost: {address}"));
    assert!(status == 200 && page.contains("<title>raygrad</title>"), "{head}");
    let told = |head: &str| {
        for header in [
            "content-security-policy: default-src 'none'",
            "x-frame-options: deny",
            "x-content-type-options: nosniff",
            "referrer-policy: no-referrer",
            "cache-control: no-store",
            "cross-origin-resource-policy: same-origin",
        ] {
            assert!(head.contains(header), "{header}: {head}");
        }
    };
    told(&head);
    // HEAD returns the type and the length.
    let (status, head, body) = request(&address, &format!("HEAD / HTTP/1.1\r\nHost: {address}"));
    assert!(status == 200 && body.is_empty(), "{head}");
    assert!(
        head.contains("content-type: text/html") && head.contains(&format!("content-length: {}", page.len())),
        "{head}"
    );
    // The files load nothing from other sites.
    for (file, content, _) in FILES {
        let kind = content.split(';').next().unwrap();
        let (status, head, body) = request(&address, &format!("GET {file} HTTP/1.1\r\nHost: localhost:{port}"));
        let foreign = body.replace("http://www.w3.org/2000/svg", "");
        assert!(status == 200 && !foreign.contains("//www") && !foreign.contains("https:"), "{file}");
        assert!(head.contains(&format!("content-type: {kind}")), "{file}: {head}");
    }
    for (head, expected, what) in [
        (
            format!("GET / HTTP/1.1\r\nHost: evil.example:{port}"),
            421,
            "Open the printed address, or restart with --host NAME",
        ),
        ("GET / HTTP/1.1\r\nHost: ".to_owned(), 421, "Unknown host name"),
        (format!("GET /view.js HTTP/1.1\r\nHost: 127.0.0.1.evil.example:{port}"), 421, "Unknown host name"),
        (format!("GET / HTTP/1.1\r\nHost: {address}\r\nOrigin: http://evil.example"), 403, "Requests from other sites"),
        (format!("GET / HTTP/1.1\r\nHost: {address}\r\nOrigin: null"), 403, "Requests from other sites"),
        (format!("POST / HTTP/1.1\r\nHost: {address}\r\nContent-Length: 0"), 405, ""),
        (format!("POST /nothing HTTP/1.1\r\nHost: {address}\r\nContent-Length: 0"), 404, "No such page"),
        (format!("GET /../Cargo.toml HTTP/1.1\r\nHost: {address}"), 404, "No such page"),
        (format!("GET /..%2f..%2fetc/passwd HTTP/1.1\r\nHost: {address}"), 404, "No such page"),
        (format!("GET //etc/passwd HTTP/1.1\r\nHost: {address}"), 404, "No such page"),
        (format!("GET /config.json HTTP/1.1\r\nHost: {address}"), 404, "No such page"),
        (format!("GET /messages HTTP/1.1\r\nHost: {address}"), 400, ""),
        (format!("GET /access HTTP/1.1\r\nHost: {address}"), 403, "Open the link that raygrad printed"),
    ] {
        let (status, answered, body) = request(&address, &head);
        assert!(status == expected && body.contains(what) && !body.contains("root:"), "{head}: {status} {body}");
        told(&answered);
    }
    for origin in [None, Some("http://evil.example"), Some("http://127.0.0.1:1"), Some("null")] {
        assert_eq!(upgraded(&address, &format!("/messages?token={token}"), origin).1, "403", "{origin:?}");
    }
    // A long request head is refused.
    let long = format!("GET / HTTP/1.1\r\nHost: {address}\r\nX-Long: {}", "x".repeat(8000));
    assert_eq!(request(&address, &long).0, 200);
    assert_eq!(request(&address, &(long + &"x".repeat(2 * HEAD))).0, 431);
}

#[test]
fn messages_need_the_token() {
    for host in ["127.0.0.1", "0.0.0.0"] {
        let (link, requests) = served_at(host, Limits::USUAL);
        let (address, token) = parts(&link);
        assert!(token.len() == 32 && token.bytes().all(|byte| byte.is_ascii_hexdigit()), "{token}");
        assert!(!token.contains("00000000"), "all of it is random: {token}");
        let address = format!("127.0.0.1:{}", address.rsplit(':').next().unwrap());
        let status = |path: &str| request(&address, &format!("GET {path} HTTP/1.1\r\nHost: {address}")).0;
        // The files hold no data of the scene.
        assert!(FILES.iter().all(|(path, ..)| status(path) == 200));
        let other = |digit: char| if digit == '0' { '1' } else { '0' };
        let near = format!("{}{}", &token[..31], other(token.chars().last().unwrap()));
        let origin = format!("http://{address}");
        let joins = |query: &str| upgraded(&address, &format!("/messages{query}"), Some(&origin)).1;
        let queries = ["", "?token=", "?token=1", &format!("?token={near}"), &format!("?token={token}0")];
        for query in queries {
            // The page asks for the status without an upgrade.
            assert_eq!((&*joins(query), status(&format!("/access{query}"))), ("403", 403), "{query}");
        }
        assert_eq!(requests.connected(), 0);
        let query = format!("?token={token}");
        assert_eq!((&*joins(&query), status(&format!("/access{query}"))), ("101", 204));
        assert_eq!(upgraded(&address, &format!("/messages?token={token}"), None).1, "403");
        becomes(|| requests.connected() == 0);
        // Unknown host names are refused, as no name was given.
        let (status, _, body) = request(&address, "GET / HTTP/1.1\r\nHost: box.lan");
        assert!(status == 421 && body.contains("--host NAME"), "{body}");
    }
}

#[test]
fn link_uses_a_reachable_address() {
    let of = |address: &str, host, outward: Option<&str>| {
        link(address.parse().unwrap(), host, outward.map(|ip| ip.parse().unwrap()), "abc")
    };
    assert_eq!(of("127.0.0.1:7007", "localhost", None), "http://127.0.0.1:7007/#token=abc");
    assert_eq!(of("[::1]:80", "::1", Some("10.0.0.2")), "http://[::1]:80/#token=abc");
    assert_eq!(of("10.0.0.2:80", "box.lan", Some("10.0.0.3")), "http://box.lan:80/#token=abc");
    // The outward address, if there is a network.
    assert_eq!(of("0.0.0.0:80", "0.0.0.0", Some("10.0.0.2")), "http://10.0.0.2:80/#token=abc");
    assert_eq!(of("[::]:80", "::", Some("2001:db8::2")), "http://[2001:db8::2]:80/#token=abc");
    assert_eq!(of("0.0.0.0:80", "0.0.0.0", None), "http://0.0.0.0:80/#token=abc");
}

#[test]
fn outward_gives_the_local_address() {
    let ip = |text: &str| text.parse::<IpAddr>().unwrap();
    assert_eq!(outward(ip("0.0.0.0"), "127.0.0.1:9"), Some(ip("127.0.0.1")));
    assert_eq!(outward(ip("127.0.0.1"), "nothing"), None);
    for own in ["0.0.0.0", "::"].map(ip) {
        let other: SocketAddr = beyond(own).parse().unwrap();
        assert_eq!(other.is_ipv4(), own.is_ipv4());
    }
}

#[test]
fn malformed_message_closes_its_connection() {
    let (server, requests) = served(Limits { rate: 0.0, burst: 3.0, ..Limits::USUAL });
    let mut good = Client::open(&server);
    // Long reasons are cut at a character.
    let long = json!({ "ask": "\u{e4}".repeat(100) }).to_string();
    for (message, expected) in [
        (Message::text("{"), "EOF"),
        (Message::text(long), "unknown variant"),
        (Message::text(json!({ "ask": "share", "share": 0.95 }).to_string()), "`share` must be from 0 to 0.9"),
        (Message::binary(vec![1, 2, 3]), "messages must be text"),
    ] {
        let mut page = Client::open(&server);
        page.socket.send(message.clone()).unwrap();
        let (_, reason) = page.closed();
        assert!(reason.contains(expected) && reason.len() <= 123, "{message:?}: {reason}");
    }
    // The largest burst, and one message more.
    let mut page = Client::open(&server);
    for _ in 0..3 {
        page.say(&json!({ "ask": "end-video" }));
    }
    page.say(&json!({ "ask": "share", "share": 0.5 }));
    assert_eq!(page.closed().1, "too many messages");
    assert_eq!(requests.share(), 0.0, "the last one is not seen to");
    // Other pages are still served, and three messages are within the limit.
    becomes(|| requests.connected() == 1);
    for share in [0.25, 0.5, 0.75] {
        good.say(&json!({ "ask": "share", "share": share }));
        becomes(|| requests.share() == share);
    }
    good.socket.close(None).unwrap();
    good.closed();
    becomes(|| requests.connected() == 0);
}

#[test]
fn message_over_the_limit_closes_the_page() {
    let (server, requests) = served(Limits::USUAL);
    let message = json!({ "ask": "share", "share": 0.5 }).to_string();
    let mut page = Client::open(&server);
    page.socket.send(Message::text(format!("{}{message}", " ".repeat((1 << 14) - message.len())))).unwrap();
    becomes(|| requests.share() == 0.5);
    requests.set_share(0.0);
    page.socket.send(Message::text(format!("{}{message}", " ".repeat((1 << 14) + 1 - message.len())))).unwrap();
    page.closed();
    becomes(|| requests.connected() == 0);
    assert_eq!(requests.share(), 0.0);
}

#[test]
fn server_limits_the_number_of_pages() {
    // A page does not occupy a connection permit.
    let silence = Duration::from_millis(400);
    let (server, requests) = served(Limits { pages: 3, connections: 1, silence, ..Limits::USUAL });
    let start = Instant::now();
    let mut pages: Vec<_> = (0..3).map(|_| joined(&server)).collect();
    assert!(pages.iter().all(|(_, status)| status == "101"));
    let full = joined(&server).1;
    assert!(full == "503" || start.elapsed() >= silence, "{full}");
    pages.pop();
    becomes(|| {
        let page = joined(&server);
        let is_in = page.1 == "101";
        pages.extend(is_in.then_some(page));
        is_in
    });
    // Pages that answer no pings count as gone.
    becomes(|| requests.connected() == 0);
    assert!(start.elapsed() >= silence);
}

#[test]
fn idle_page_is_pinged_and_stays() {
    let (idle, silence) = (Duration::from_millis(100), Duration::from_secs(2));
    let connected = Duration::from_millis(200);
    let (server, requests) = served(Limits { idle, silence, connected, ..Limits::USUAL });
    let start = Instant::now();
    let mut page = Client::open(&server);
    let mut pings = 0;
    requests.tell_state("{}");
    while start.elapsed() < silence + silence / 2 {
        let message = page.read().unwrap();
        if message.is_ping() {
            pings += 1;
            assert!(start.elapsed() >= pings * idle, "{pings}");
        } else {
            // Messages to the page do not delay pings.
            std::thread::sleep(Duration::from_millis(20));
            requests.tell_state("{}");
        }
    }
    assert!(pings >= 3, "{pings}");
    assert_eq!(requests.connected(), 1);
}

#[test]
fn slow_page_is_kept_during_a_long_message() {
    let silence = Duration::from_millis(200);
    let (server, requests) = served(Limits { silence, ..Limits::USUAL });
    requests.introduce("x".repeat(HUGE));
    let mut page = Client::connect(&server);
    std::thread::sleep(3 * silence);
    assert_eq!(requests.connected(), 1);
    let message = page.read().unwrap();
    assert!(message.is_text() && message.len() == HUGE);
}

#[test]
fn unread_messages_time_out() {
    let patience = Duration::from_millis(200);
    let (server, requests) = served(Limits { patience, slowest: 1 << 40, ..Limits::USUAL });
    let page = Client::open(&server);
    let start = Instant::now();
    requests.tell(&Outgoing::Bytes(vec![7; HUGE]));
    becomes(|| requests.connected() == 0);
    assert!(start.elapsed() >= patience);
    drop(page);
}

#[test]
fn overrun_page_gets_the_reason() {
    let (server, requests) = served(Limits::USUAL);
    let mut page = Client::open(&server);
    // This message exceeds the socket buffers, so that all others wait.
    requests.tell(&Outgoing::Bytes(vec![7; HUGE]));
    for _ in 0..100 {
        requests.tell(&text(&crate::view::messages::ServerMessage::Sorry { what: String::new() }));
    }
    assert_eq!(page.closed(), (1, "too many unsent replies".to_owned()));
}

fn view() -> View {
    View {
        eye: Eye::Photograph(0),
        size: [8, 8],
        show: Show::Color,
        compared: false,
        background: None,
        crop: None,
        skip: None,
        checkpoint: None,
    }
}

#[test]
fn unacknowledged_render_closes_the_page() {
    let patience = Duration::from_secs(1);
    let (server, requests) = served(Limits { patience, ..Limits::USUAL });
    let mut page = Client::open(&server);
    page.say(&json!({ "ask": "view", "id": 1, "view": { "eye": { "photograph": 0 }, "size": [8, 8] } }));
    becomes(|| !requests.wishes().is_empty());
    assert_eq!(requests.wishes()[0].view, view());
    let show = |halvings: u32| {
        let made = Made { halvings, milliseconds: 1.0, compared: None, step: 0 };
        requests.show(&requests.wishes()[0], RenderedFrame { made, jpeg: vec![7; 9] });
    };
    // A page with acknowledgements stays longer than the time-out.
    let start = Instant::now();
    for halvings in (0..3).rev() {
        show(halvings);
        while !page.read().unwrap().is_binary() {}
        page.say(&json!({ "ask": "seen", "id": 1 }));
        std::thread::sleep(2 * patience / 5);
    }
    assert!(start.elapsed() > patience && requests.connected() == 1);
    let start = Instant::now();
    show(1);
    show(0);
    let (pictures, reason) = page.closed();
    assert_eq!((pictures, &*reason), (1, "an image was not acknowledged"));
    assert!(start.elapsed() >= patience && start.elapsed() < LONG / 2);
}

#[test]
fn silent_connections_time_out() {
    let patience = Duration::from_millis(300);
    let (Local { address, .. }, _) = served(Limits { patience, ..Limits::USUAL });
    let start = Instant::now();
    let mut idle = connect(&address);
    let mut answer = Vec::new();
    let _ = idle.read_to_end(&mut answer);
    assert!(start.elapsed() >= patience && start.elapsed() < LONG / 2, "{:?}", start.elapsed());
}

#[test]
fn silent_connections_delay_no_other() {
    let (Local { address, .. }, _) = served(Limits { connections: 3, patience: 2 * LONG, ..Limits::USUAL });
    let idle: Vec<TcpStream> = (0..20).map(|_| connect(&address)).collect();
    let (status, _, _) = request(&address, &format!("GET / HTTP/1.1\r\nHost: {address}"));
    assert_eq!(status, 200);
    // The oldest were closed, and the last ones wait.
    let is_open = |mut stream: &TcpStream| {
        stream.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        matches!(stream.read(&mut [0]), Err(error) if [WouldBlock, TimedOut].contains(&error.kind()))
    };
    let open: Vec<bool> = idle.iter().map(is_open).collect();
    assert!(open[..17].iter().all(|open| !open) && open[18..].iter().all(|open| *open), "{open:?}");
}

#[test]
fn connection_without_upgrade_times_out() {
    let (Local { address, .. }, _) =
        served(Limits { connected: Duration::from_millis(200), patience: 2 * LONG, ..Limits::USUAL });
    let mut stream = connect(&address);
    stream.write_all(format!("GET /nothing HTTP/1.1\r\nHost: {address}\r\n\r\n").as_bytes()).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 404"), "{answer}");
}
