//! The page and its messages, over HTTP on one port, and nothing else.

use std::net::{IpAddr, SocketAddr, TcpListener, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use axum::Router;
use axum::body::Body;
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade};
use axum::extract::{Query, Request, State};
use axum::http::header::{self, HeaderMap, HeaderValue};
use axum::http::{Method, StatusCode, Uri};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use raygrad::nerf::{Error, Result};
use serde::Deserialize;
use tokio::sync::Semaphore;
use tokio::time::{timeout, timeout_at};

use super::album::Album;
use super::hub::{Hub, Outbox, Outgoing};
use super::messages::{self, Ask, File, Tell};
use super::studio::Studio;

/// Pages at a time, and connections that are no pages yet.
const PAGES: usize = 64;
const CONNECTIONS: usize = 128;
/// How long one may last that does not become a page.
const CONNECTED: Duration = Duration::from_secs(60);
/// Bytes of a message from a page.
const LONGEST: usize = 1 << 14;
/// Messages a second from a page, and how many may come at once.
const RATE: f64 = 300.0;
const BURST: f64 = 600.0;
/// How long a request may take to arrive, and a page to take a message or say that it has seen a picture, beside what its bytes
/// take, at so many a second.
const PATIENCE: Duration = Duration::from_secs(10);
const SLOWEST: usize = 50_000;
/// How often a page is asked whether it is still there, and how long it is not heard before it is taken to be gone.
const IDLE: Duration = Duration::from_secs(5);
const SILENCE: Duration = Duration::from_secs(30);
/// Files that may wait for a page when it asks for a photograph.
const MOST_FILES: usize = 4;
/// Quality of photographs as JPEG files, 1 to 100.
const QUALITY: u8 = 88;

/// Nothing from elsewhere, and nothing of it elsewhere.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// What is served.
const FILES: [(&str, &str, &str); 4] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/view.css", "text/css; charset=utf-8", include_str!("page/view.css")),
    ("/camera.js", "text/javascript; charset=utf-8", super::CAMERA),
    ("/view.js", "text/javascript; charset=utf-8", include_str!("page/view.js")),
];

/// A port that is taken, and the name of this machine that pages may use.
pub struct Listener {
    listener: TcpListener,
    address: SocketAddr,
    host: String,
}

impl Listener {
    /// Takes a port, 0 for any that is free.
    ///
    /// # Errors
    /// If the host is not known or the port is taken.
    pub fn bind(host: &str, port: u16) -> Result<Self> {
        let bad = |e: std::io::Error| Error::setting("host", format!("{host}:{port} cannot be used: {e}"));
        let listener = TcpListener::bind((host, port)).map_err(bad)?;
        listener.set_nonblocking(true).map_err(bad)?;
        Ok(Listener { address: listener.local_addr().map_err(bad)?, listener, host: host.to_owned() })
    }
}

/// What all connections know.
struct Served {
    hub: Arc<Hub>,
    album: Option<Arc<Album>>,
    /// What makes films, if they can be made.
    studio: Option<Arc<Studio>>,
    /// What photographs that have transparency stand before.
    background: [f32; 3],
    /// The name of this machine that pages may use, beside its addresses.
    host: String,
    /// What links must have, where others than this machine can follow them.
    token: Option<String>,
    /// Photographs that are read at a time.
    readers: Semaphore,
}

/// Begins to serve, on threads of its own; gives the link.
///
/// # Errors
/// If the system has no thread left.
pub fn serve(
    Listener { listener, address, host }: Listener,
    hub: Arc<Hub>,
    album: Option<Arc<Album>>,
    studio: Option<Arc<Studio>>,
    background: [f32; 3],
) -> Result<String> {
    let bad = |e: std::io::Error| Error::setting("host", format!("{address} cannot be served: {e}"));
    let token = (!address.ip().is_loopback()).then(|| format!("{:032x}", rand::random::<u128>()));
    let link = link(address, &host, token.as_deref());
    let served = Served { hub, album, studio, background, host, token, readers: Semaphore::new(2) };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(bad)?;
    let run = move || {
        runtime.block_on(async move {
            match tokio::net::TcpListener::from_std(listener) {
                Ok(listener) => accept(listener, router(Arc::new(served))).await,
                Err(error) => crate::cli::output::complain(&format!("warning: pages cannot be served: {error}")),
            }
        });
    };
    std::thread::Builder::new().name("pages".into()).spawn(run).map_err(bad)?;
    Ok(link)
}

fn link(address: SocketAddr, host: &str, token: Option<&str>) -> String {
    let host = match address.ip() {
        ip if ip.is_loopback() => ip.to_string(),
        ip if ip.is_unspecified() => outward(ip).unwrap_or(ip).to_string(),
        _ => host.to_owned(),
    };
    let host = if host.contains(':') { format!("[{host}]") } else { host };
    let token = token.map(|token| format!("?token={token}")).unwrap_or_default();
    format!("http://{host}:{}/{token}", address.port())
}

/// The address of this machine by which it goes out, where all of them are listened to. Nothing is sent.
fn outward(all: IpAddr) -> Option<IpAddr> {
    // Addresses that are kept for documentation, beyond any network of one's own.
    let beyond = if all.is_ipv4() { "192.0.2.1:9" } else { "[2001:db8::1]:9" };
    let socket = UdpSocket::bind((all, 0)).ok()?;
    socket.connect(beyond).ok()?;
    Some(socket.local_addr().ok()?.ip()).filter(|ip| !ip.is_unspecified())
}

async fn accept(listener: tokio::net::TcpListener, router: Router) {
    let permits = Arc::new(Semaphore::new(CONNECTIONS));
    loop {
        let Ok(permit) = permits.clone().acquire_owned().await else { return };
        let Ok((stream, _)) = listener.accept().await else {
            // Too many files are open, say.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        let _ = stream.set_nodelay(true);
        let service = TowerToHyperService::new(router.clone());
        tokio::spawn(async move {
            let mut http = hyper::server::conn::http1::Builder::new();
            http.timer(TokioTimer::new()).header_read_timeout(PATIENCE).max_buf_size(1 << 14);
            // A connection that is cut off is nobody's loss; what becomes of one that is a page is no longer seen here.
            let served = http.serve_connection(TokioIo::new(stream), service).with_upgrades();
            let _ = timeout(CONNECTED, served).await;
            drop(permit);
        });
    }
}

fn router(served: Arc<Served>) -> Router {
    let guarded = middleware::from_fn_with_state(served.clone(), guard);
    Router::new().route("/messages", get(messages)).fallback(file).layer(guarded).with_state(served)
}

/// Lets nobody in who comes by another name than this machine has: a page of elsewhere, whose name leads here since a moment ago,
/// could read all. And no page of elsewhere.
async fn guard(State(served): State<Arc<Served>>, request: Request, next: Next) -> Response {
    let refused = refusal(request.headers(), &served.host);
    let mut response = match refused {
        Some(refused) => refused.into_response(),
        None => next.run(request).await,
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-store"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    headers.insert("cross-origin-resource-policy", HeaderValue::from_static("same-origin"));
    response
}

/// Why a request is not answered, if it is not.
fn refusal(headers: &HeaderMap, own: &str) -> Option<(StatusCode, &'static str)> {
    let text = |name| headers.get(name).map(|value: &HeaderValue| value.to_str().unwrap_or_default());
    let host = text(header::HOST).unwrap_or_default();
    if !is_own(host, own) {
        return Some((StatusCode::MISDIRECTED_REQUEST, "This is not served under that name.\n"));
    }
    let foreign = text(header::ORIGIN).is_some_and(|origin| !is_same(origin, host));
    foreign.then_some((StatusCode::FORBIDDEN, "Pages of elsewhere may not ask.\n"))
}

/// Whether a `Host` is an address, which no name can be turned to, or one of this machine's names.
fn is_own(host: &str, own: &str) -> bool {
    let Ok(authority) = host.parse::<axum::http::uri::Authority>() else { return false };
    let name = authority.host().trim_start_matches('[').trim_end_matches(']');
    !authority.as_str().contains('@')
        && (name.parse::<IpAddr>().is_ok()
            || name.eq_ignore_ascii_case("localhost")
            || (!own.is_empty() && name.eq_ignore_ascii_case(own)))
}

/// Whether an `Origin` is that of a page from here.
fn is_same(origin: &str, host: &str) -> bool {
    origin
        .parse::<Uri>()
        .is_ok_and(|origin| origin.authority().is_some_and(|authority| authority.as_str().eq_ignore_ascii_case(host)))
}

async fn file(method: Method, uri: Uri, State(served): State<Arc<Served>>, query: Query<Key>) -> Response {
    let Some((path, kind, text)) = FILES.iter().find(|(path, _, _)| *path == uri.path()) else {
        return (StatusCode::NOT_FOUND, "There is no such page.\n").into_response();
    };
    if method != Method::GET && method != Method::HEAD {
        return (StatusCode::METHOD_NOT_ALLOWED, [(header::ALLOW, "GET, HEAD")]).into_response();
    }
    // Style and script are no secret.
    if *path == "/" && !served.lets_in(&query) {
        return (StatusCode::FORBIDDEN, "The link has a token at its end, which this one has not.\n").into_response();
    }
    ([(header::CONTENT_TYPE, *kind)], Body::from(*text)).into_response()
}

#[derive(Deserialize)]
struct Key {
    token: Option<String>,
}

impl Served {
    fn lets_in(&self, key: &Key) -> bool {
        self.token.is_none() || self.token == key.token
    }
}

async fn messages(
    State(served): State<Arc<Served>>,
    query: Query<Key>,
    headers: HeaderMap,
    upgrade: WebSocketUpgrade,
) -> Response {
    // Browsers always say where a page is from that asks for this.
    let origin = headers.get(header::ORIGIN).is_some();
    if !served.lets_in(&query) || !origin {
        return (StatusCode::FORBIDDEN, "Only the page may ask.\n").into_response();
    }
    let Some(page) = Page::join(served) else {
        return (StatusCode::SERVICE_UNAVAILABLE, "Too many pages are open.\n").into_response();
    };
    let upgrade = upgrade.max_message_size(LONGEST).max_frame_size(LONGEST);
    upgrade.on_upgrade(move |socket| page.talk(socket))
}

/// One page, from when it comes to when it goes.
struct Page {
    client: u64,
    outbox: Arc<Outbox>,
    served: Arc<Served>,
    /// Whether a photograph is being read.
    reader: Arc<Semaphore>,
    /// Whether something is being sent.
    sending: AtomicBool,
}

impl Drop for Page {
    fn drop(&mut self) {
        self.served.hub.leave(self.client);
    }
}

impl Page {
    fn join(served: Arc<Served>) -> Option<Self> {
        let (client, outbox) = served.hub.join(PAGES)?;
        Some(Page { client, outbox, served, reader: Arc::new(Semaphore::new(1)), sending: AtomicBool::new(false) })
    }

    async fn talk(self, socket: WebSocket) {
        self.outbox.post(Outgoing::Text(self.served.hub.about()));
        let (mut out, mut heard) = socket.split();
        let reason = tokio::select! {
            reason = self.write(&mut out) => reason.map(str::to_owned),
            reason = self.read(&mut heard) => reason,
        };
        drop(self);
        if let Some(mut reason) = reason {
            // A close frame has room for so much.
            let room = (0..=120).rev().find(|at| reason.is_char_boundary(*at)).unwrap_or(0);
            reason.truncate(room);
            let close = CloseFrame { code: 1008, reason: reason.into() };
            let _ = timeout(PATIENCE, out.send(Message::Close(Some(close)))).await;
        }
    }

    /// Sends what there is for the page; gives why it is no longer sent anything, if it is there.
    async fn write(&self, out: &mut SplitSink<WebSocket, Message>) -> Option<&'static str> {
        let outbox = &self.outbox;
        let mut pinged = Instant::now();
        loop {
            while let Some(message) = outbox.take() {
                let message = match message {
                    Outgoing::Text(text) => Message::Text(text.into()),
                    Outgoing::Bytes(bytes) => Message::Binary(bytes.into()),
                };
                // Meanwhile it cannot say anything.
                self.sending.store(true, Ordering::Relaxed);
                let sent = timeout(patience_for(&message), out.send(message)).await;
                self.sending.store(false, Ordering::Relaxed);
                if !matches!(sent, Ok(Ok(()))) {
                    return None;
                }
            }
            if outbox.is_overrun() {
                return Some("too much was asked for");
            }
            let flown = outbox.flying();
            if flown.is_some_and(|until| until <= Instant::now()) {
                return Some("a picture was not taken");
            }
            // Whether it is still there: a browser answers by itself, also one that looks on and says nothing.
            if pinged.elapsed() >= IDLE {
                pinged = Instant::now();
                if !matches!(timeout(PATIENCE, out.send(Message::Ping(Default::default()))).await, Ok(Ok(()))) {
                    return None;
                }
            }
            let until = flown.map_or(pinged + IDLE, |until| until.min(pinged + IDLE));
            let _ = timeout_at(until.into(), outbox.changed.notified()).await;
        }
    }

    /// Takes what the page says; gives why it is listened to no longer, if it is there.
    async fn read(&self, heard: &mut SplitStream<WebSocket>) -> Option<String> {
        let (mut allowed, mut last) = (BURST, Instant::now());
        loop {
            let message = match timeout(SILENCE, heard.next()).await {
                Ok(Some(Ok(message))) => message,
                Err(_) if self.sending.load(Ordering::Relaxed) => continue,
                _ => return None,
            };
            allowed = (allowed + RATE * last.elapsed().as_secs_f64()).min(BURST) - 1.0;
            last = Instant::now();
            if allowed < 0.0 {
                return Some("too many messages".to_owned());
            }
            match message {
                Message::Text(text) => match Ask::read(&text) {
                    Ok(ask) => self.answer(ask),
                    Err(what) => return Some(what),
                },
                Message::Binary(_) => return Some("messages are text".to_owned()),
                Message::Close(_) => return None,
                Message::Ping(_) | Message::Pong(_) => (),
            }
        }
    }

    fn answer(&self, ask: Ask) {
        let Page { client, outbox, served, reader, .. } = self;
        let (client, hub) = (*client, &served.hub);
        match ask {
            Ask::View { id, view } => hub.wish(client, id, view),
            Ask::Seen { id } => outbox.seen(id),
            Ask::Save { view } => {
                if !hub.save(client, view) {
                    outbox.post(sorry("so many pictures are saved one after the other"));
                }
            }
            Ask::Photograph { .. } if outbox.files() > MOST_FILES => outbox.post(sorry("so many files are not taken")),
            Ask::Photograph { number } => match reader.clone().try_acquire_owned() {
                Ok(permit) => {
                    let (outbox, served) = (outbox.clone(), served.clone());
                    tokio::spawn(async move {
                        let photograph = photograph(number, &served).await;
                        drop(permit);
                        outbox.post(photograph);
                    });
                }
                Err(_) => outbox.post(sorry("one photograph is read after the other")),
            },
            Ask::Pause { pause } => hub.pause(pause),
            Ask::Stop {} => hub.stop(),
            Ask::Share { share } => hub.set_share(share),
            Ask::Rest {} => hub.rest(client),
            Ask::Film(film) => match served.studio.clone() {
                // It looks for what is installed.
                Some(studio) => {
                    let outbox = outbox.clone();
                    tokio::task::spawn_blocking(move || {
                        if let Err(error) = studio.begin(&film) {
                            outbox.post(sorry(&error.to_string()));
                        }
                    });
                }
                None => outbox.post(sorry("films are made when training has ended")),
            },
            Ask::EndFilm {} => {
                if let Some(studio) = &served.studio {
                    studio.end();
                }
            }
        }
    }
}

/// How long a message may take to be sent.
fn patience_for(message: &Message) -> Duration {
    match message {
        Message::Text(text) => patience(text.len()),
        Message::Binary(bytes) => patience(bytes.len()),
        _ => PATIENCE,
    }
}

/// How long so many bytes may take.
pub fn patience(bytes: usize) -> Duration {
    PATIENCE + Duration::from_secs((bytes / SLOWEST) as u64)
}

/// A photograph as the page wants it.
async fn photograph(number: usize, served: &Arc<Served>) -> Outgoing {
    let Ok(_permit) = served.readers.acquire().await else { return sorry("it cannot be read") };
    let (album, background) = (served.album.clone(), served.background);
    let read = move || -> Result<Vec<u8>> {
        let album = album.ok_or_else(|| Error::setting("photograph", "the run's photographs are not known"))?;
        Ok(File::Photograph { number }.message(&album.photo(number)?.over(background).to_jpeg(QUALITY)))
    };
    match tokio::task::spawn_blocking(read).await {
        Ok(Ok(bytes)) => Outgoing::Bytes(bytes),
        Ok(Err(error)) => sorry(&error.to_string()),
        Err(_) => sorry("it cannot be read"),
    }
}

/// That something cannot be had, and why.
pub fn sorry(what: &str) -> Outgoing {
    text(&Tell::Sorry { what: what.to_owned() })
}

/// A message of text.
pub fn text(tell: &Tell) -> Outgoing {
    Outgoing::Text(messages::text(tell))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_addresses_and_own_names_are_served() {
        for host in
            ["127.0.0.1:7007", "127.0.0.1", "[::1]:80", "localhost:7007", "LOCALHOST", "192.168.1.9:1", "box.lan:7007"]
        {
            assert!(is_own(host, "box.lan"), "{host}");
        }
        for host in [
            "",
            "evil.example",
            "evil.example:7007",
            "localhost.evil.example",
            "127.0.0.1.nip.io",
            "a@127.0.0.1",
            "::1",
            "a b",
        ] {
            assert!(!is_own(host, "box.lan"), "{host}");
        }
        assert!(!is_own("box.lan", "0.0.0.0") && !is_own("", ""));
    }

    #[test]
    fn only_pages_from_here_may_ask() {
        assert!(is_same("http://127.0.0.1:7007", "127.0.0.1:7007") && is_same("https://box.lan", "box.lan"));
        for origin in [
            "null",
            "",
            "http://127.0.0.1:7008",
            "http://evil.example",
            "file://",
            "http://127.0.0.1:7007.evil.example",
        ] {
            assert!(!is_same(origin, "127.0.0.1:7007"), "{origin}");
        }
    }

    #[test]
    fn links_lead_where_it_listens() {
        let of = |address: &str, host, token| link(address.parse().unwrap(), host, token);
        assert_eq!(of("127.0.0.1:7007", "localhost", None), "http://127.0.0.1:7007/");
        assert_eq!(of("[::1]:80", "::1", None), "http://[::1]:80/");
        assert_eq!(of("10.0.0.2:80", "box.lan", Some("abc")), "http://box.lan:80/?token=abc");
        // One that can be followed from elsewhere, if there is a network.
        let all = of("0.0.0.0:80", "0.0.0.0", None);
        let address = outward("0.0.0.0".parse().unwrap()).unwrap_or("0.0.0.0".parse().unwrap());
        assert_eq!(all, format!("http://{address}:80/"));
    }

    #[test]
    fn what_is_large_may_take_longer() {
        let of = |bytes: usize| patience_for(&Message::Binary(vec![0; bytes].into()));
        assert_eq!([of(0), of(1_000_000)], [PATIENCE, PATIENCE + Duration::from_secs(20)]);
    }
}
