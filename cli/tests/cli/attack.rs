//! The viewer under attack by another user of the machine, and by a page that has the link.
//!
//! The attacker is this test program again, as the user "nobody" where the test may change users. In the suite an attack
//! takes two seconds. This command attacks for 20 seconds and prints the latencies:
//!
//! ```sh
//! RAYGRAD_ATTACK_SECONDS=20 cargo test -p raygrad-cli --test cli attack -- --nocapture --test-threads 1
//! ```

use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::process::CommandExt;
use std::process::Command;
use std::time::{Duration, Instant};

use super::view::{Page, Server, first, serve, trained};
use raygrad_test_support::skip::skipped;
use serde_json::{Value, json};
use tungstenite::Message;

/// The user id of "nobody".
const NOBODY: u32 = 65_534;
/// The environment variable that makes a test program the attacker.
const ATTACK: &str = "RAYGRAD_ATTACK";

/// Length of an attack.
fn length() -> Duration {
    let seconds = std::env::var("RAYGRAD_ATTACK_SECONDS").ok().and_then(|text| text.parse().ok());
    Duration::from_secs(seconds.unwrap_or(2))
}

/// Requests of a neighbour who does not have the link.
fn neighbour(address: &str, until: Instant) -> Counts {
    let mut counts = Counts::default();
    // More connections than the server keeps, without a request or with a part of one.
    let mut half_open: Vec<TcpStream> = vec![];
    for turn in 0.. {
        if Instant::now() > until {
            break;
        }
        if half_open.len() >= 300 {
            half_open.remove(0);
        }
        let mut stream = TcpStream::connect(address).unwrap();
        let _ = stream.write_all(if turn % 2 == 0 { b"GET / HTTP/1.1\r\nHo" } else { b"" });
        half_open.push(stream);
        let hosts = [address, "evil.example", "127.0.0.1.evil.example"];
        let origins = [&*format!("http://{address}"), "http://evil.example", "null"];
        let paths = [
            "/messages",
            "/messages?token=",
            "/messages?token=0123456789abcdef0123456789abcdef",
            "/../../../etc/passwd",
            "/%2e%2e/%2e%2e/etc/passwd",
            "//etc/passwd",
            "/config.json",
            "/model.safetensors",
        ];
        let (host, origin, path) = (hosts[turn % 3], origins[turn / 3 % 3], paths[turn % paths.len()]);
        let upgrade = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
                       Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==";
        let head = format!("GET {path} HTTP/1.1\r\nHost: {host}\r\nOrigin: {origin}\r\n{upgrade}\r\n\r\n");
        let mut stream = TcpStream::connect(address).unwrap();
        let mut answer = [0; 12];
        stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        if stream.write_all(head.as_bytes()).and_then(|()| stream.read_exact(&mut answer)).is_ok() {
            counts.answers += 1;
            counts.opened += usize::from(&answer[9..12] == b"101" || &answer[9..12] == b"200");
        }
        counts.requests += 1;
        std::thread::sleep(Duration::from_micros(300));
    }
    counts
}

/// What an attacker did: requests, their answers, and those that opened something.
#[derive(Default)]
struct Counts {
    requests: usize,
    answers: usize,
    opened: usize,
}

/// Runs in the attacker's process; does nothing otherwise.
#[test]
fn attacker() {
    let Ok(order) = std::env::var(ATTACK) else { return };
    let (address, milliseconds) = order.split_once(' ').unwrap();
    let counts = neighbour(address, Instant::now() + Duration::from_millis(milliseconds.parse().unwrap()));
    println!("attacked {} {} {}", counts.requests, counts.answers, counts.opened);
}

/// Starts an attacker, as another user if possible.
fn attack(server: &Server, length: Duration, user: Option<u32>) -> std::process::Child {
    // The path of the test program may be closed to other users.
    let mut command = Command::new("/proc/self/exe");
    command.args(["--exact", "attack::attacker", "--nocapture"]).current_dir("/");
    command.env(ATTACK, format!("{} {}", server.address, length.as_millis())).stdout(std::process::Stdio::piped());
    if let Some(user) = user {
        command.uid(user).gid(user);
    }
    command.spawn().unwrap()
}

/// Returns true if this program may change users.
fn is_root() -> bool {
    let output = Command::new("id").arg("-u").output().unwrap();
    output.stdout.trim_ascii() == b"0"
}

/// Latencies of the owner in milliseconds, sorted: renders of a small view in an open page, and opening a page.
struct Latencies {
    renders: Vec<f64>,
    pages: Vec<f64>,
}

impl Latencies {
    fn measure(server: &Server, page: &mut Page, about: &Value, length: Duration) -> Self {
        let start = Instant::now();
        let (mut renders, mut pages) = (vec![], vec![]);
        let mut view = first(about, [16, 16]);
        for id in 0.. {
            view["eye"]["free"]["pose"][0][3] = json!(0.001 * f64::from(id));
            let asked = Instant::now();
            page.say(json!({ "ask": "view", "id": id, "view": view }));
            while page.file("picture").0["id"] != id {}
            renders.push(asked.elapsed().as_secs_f64() * 1e3);
            if id % 5 == 0 {
                let asked = Instant::now();
                drop(Page::open(server));
                pages.push(asked.elapsed().as_secs_f64() * 1e3);
            }
            if start.elapsed() >= length {
                break;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        for times in [&mut renders, &mut pages] {
            times.sort_by(f64::total_cmp);
        }
        Latencies { renders, pages }
    }

    /// The 50th and 99th percentiles.
    fn percentiles(times: &[f64]) -> [f64; 2] {
        [0.5, 0.99].map(|share| times[((times.len() - 1) as f64 * share) as usize])
    }

    fn print(&self, when: &str) {
        for (what, times) in [("render", &self.renders), ("page", &self.pages)] {
            let [median, last] = Self::percentiles(times);
            println!(
                "{when:<8} {what:<8} median {median:7.2} ms, 99th percentile {last:7.2} ms, {} times",
                times.len()
            );
        }
    }
}

/// Fails if the owner waits much longer than without the attack. The bound is loose, since tests run side by side; the
/// campaign prints the latencies.
fn delays_nobody(server: &Server, mut attacked: impl FnMut()) {
    let (mut page, about) = Page::open(server);
    let quiet = Latencies::measure(server, &mut page, &about, length());
    let during = std::thread::scope(|scope| {
        let attack = scope.spawn(|| {
            let (mut page, about) = Page::open(server);
            Latencies::measure(server, &mut page, &about, length())
        });
        attacked();
        attack.join().unwrap()
    });
    // The first page was idle during the attack and answered no ping, so a long attack ends its connection.
    let (mut page, about) = Page::open(server);
    let after = Latencies::measure(server, &mut page, &about, length());
    for (when, times) in [("before", &quiet), ("during", &during), ("after", &after)] {
        times.print(when);
        for (times, quiet) in [(&times.renders, &quiet.renders), (&times.pages, &quiet.pages)] {
            let [last, quiet] = [times, quiet].map(|times| Latencies::percentiles(times)[1]);
            assert!(last < 250.0 + 10.0 * quiet, "{when}: {last} ms, and {quiet} ms before");
        }
    }
}

#[test]
fn attack_of_another_user_opens_nothing() {
    let user = is_root().then_some(NOBODY);
    if user.is_none() {
        skipped("only root can be another user; the attacker is the same user");
    }
    let place = trained();
    let server = serve(&place, "view run");
    let mut counts = vec![];
    delays_nobody(&server, || {
        let output = attack(&server, length(), user).wait_with_output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let line = text.lines().find_map(|line| line.split("attacked ").nth(1)).unwrap_or_else(|| panic!("{text}"));
        counts = line.split(' ').map(|count| count.parse::<usize>().unwrap()).collect();
    });
    println!("requests, answers and successes of the attacker: {counts:?}");
    assert!(counts[0] > 100 && counts[1] > counts[0] / 2 && counts[2] == 0, "{counts:?}");
}

#[test]
fn malformed_messages_and_slow_pages_delay_nobody() {
    let place = trained();
    let server = serve(&place, "view run");
    let malformed = [
        "{",
        "null",
        "[]",
        "{\"ask\":\"view\"}",
        "{\"ask\":\"view\",\"id\":-1}",
        "\u{0}",
        "{\"ask\":\"share\",\"share\":1e999}",
    ];
    let mut closed = 0;
    delays_nobody(&server, || {
        // Pages that ask for images and read none of them.
        let mut slow: Vec<Page> = (0..8).map(|_| Page::open(&server).0).collect();
        for page in &mut slow {
            (0..8).for_each(|number| page.say(json!({ "ask": "photograph", "number": number })));
        }
        let until = Instant::now() + length();
        while Instant::now() < until {
            let (mut page, _) = Page::open(&server);
            page.socket.send(Message::text(malformed[closed % malformed.len()])).unwrap();
            assert!(!page.closed().is_empty());
            closed += 1;
        }
    });
    println!("{closed} malformed messages");
    assert!(closed > 50, "{closed}");
}
