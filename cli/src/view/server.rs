//! HTTP server of the page and its WebSocket.

use std::net::{IpAddr, SocketAddr, TcpListener, UdpSocket};
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::{Extension, Query, State};
use axum::http::header::{self, HeaderMap};
use axum::http::{Method, StatusCode, Uri};
use axum::middleware;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use raygrad::nerf::Error;
use tokio::sync::Semaphore;
use tokio::time::timeout;

use super::access::{AccessToken, check_access};
use super::connection::Connection;
use super::networks::{Connections, Network};
use super::photo_cache::PhotoCache;
use super::requests::Requests;
use super::served::{Limits, Served};
use super::video_jobs::VideoJobs;

pub use super::requests::{sorry, text};

/// Longest request head, in bytes.
const HEAD: usize = 1 << 14;

/// The static files.
const FILES: [(&str, &str, &str); 6] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/view.css", "text/css; charset=utf-8", include_str!("page/view.css")),
    ("/camera.js", "text/javascript; charset=utf-8", super::CAMERA),
    ("/overlays.js", "text/javascript; charset=utf-8", include_str!("page/overlays.js")),
    ("/path.js", "text/javascript; charset=utf-8", include_str!("page/path.js")),
    ("/view.js", "text/javascript; charset=utf-8", include_str!("page/view.js")),
];

/// A bound port, and the host name that pages may use.
pub struct Listener {
    listener: TcpListener,
    address: SocketAddr,
    host: String,
}

impl Listener {
    /// Binds a port; 0 selects a free one.
    ///
    /// # Errors
    ///
    /// Fails if the host is unknown or the port is in use.
    pub fn bind(host: &str, port: u16) -> raygrad::nerf::Result<Self> {
        let bad = |e: std::io::Error| Error::setting("host", format!("{host}:{port} cannot be used: {e}"));
        let listener = TcpListener::bind((host, port)).map_err(bad)?;
        listener.set_nonblocking(true).map_err(bad)?;
        Ok(Listener { address: listener.local_addr().map_err(bad)?, listener, host: host.to_owned() })
    }
}

/// Starts the server threads and returns the link, whose token gives access.
///
/// # Errors
///
/// Fails if the system cannot start a thread.
pub fn serve(
    limits: Limits,
    Listener { listener, address, host }: Listener,
    requests: Arc<Requests>,
    photos: Option<Arc<PhotoCache>>,
    video_jobs: Option<Arc<VideoJobs>>,
    background: [f32; 3],
) -> raygrad::nerf::Result<String> {
    let bad = |e: std::io::Error| Error::setting("host", format!("{address} cannot be served: {e}"));
    let token = format!("{:032x}", rand::random::<u128>());
    let link = link(address, &host, outward(address.ip(), beyond(address.ip())), &token);
    let served = Served { requests, photos, video_jobs, background, host, token, readers: Semaphore::new(2), limits };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(bad)?;
    let run = move || {
        runtime.block_on(async move {
            match tokio::net::TcpListener::from_std(listener) {
                Ok(listener) => accept(listener, router(Arc::new(served)), limits).await,
                Err(error) => crate::output::complain(&format!("warning: pages cannot be served: {error}")),
            }
        });
    };
    std::thread::Builder::new().name("pages".into()).spawn(run).map_err(bad)?;
    Ok(link)
}

/// The link to an address. It uses the requested host, or the outward address if the server listens on all addresses.
/// Browsers keep the fragment of a page's address to themselves; the page sends the token with its own requests.
fn link(address: SocketAddr, host: &str, outward: Option<IpAddr>, token: &str) -> String {
    let host = match address.ip() {
        ip if ip.is_loopback() => ip.to_string(),
        ip if ip.is_unspecified() => outward.unwrap_or(ip).to_string(),
        _ => host.to_owned(),
    };
    let host = if host.contains(':') { format!("[{host}]") } else { host };
    format!("http://{host}:{}/#token={token}", address.port())
}

/// The local address of outgoing connections to another address. Sends nothing.
fn outward(own: IpAddr, other: &str) -> Option<IpAddr> {
    let socket = UdpSocket::bind((own, 0)).ok()?;
    socket.connect(other).ok()?;
    Some(socket.local_addr().ok()?.ip()).filter(|ip| !ip.is_unspecified())
}

/// An address reserved for documentation, which is outside of any local network.
fn beyond(own: IpAddr) -> &'static str {
    if own.is_ipv4() { "192.0.2.1:9" } else { "[2001:db8::1]:9" }
}

async fn accept(listener: tokio::net::TcpListener, router: Router, limits: Limits) {
    let mut connections = Connections::new(limits.connections);
    loop {
        let Ok((stream, address)) = listener.accept().await else {
            // For example, too many files are open.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        let _ = stream.set_nodelay(true);
        let network = Network::of(address.ip());
        let service = TowerToHyperService::new(router.clone().layer(Extension(network)));
        connections.spawn(network, async move {
            let mut http = hyper::server::conn::http1::Builder::new();
            http.timer(TokioTimer::new()).header_read_timeout(limits.patience).max_buf_size(HEAD);
            // Errors of a connection need no handling. After an upgrade, the page's own task handles the connection.
            let served = http.serve_connection(TokioIo::new(stream), service).with_upgrades();
            let _ = timeout(limits.connected, served).await;
        });
        // A flood of connections leaves time to serve each of them.
        tokio::task::yield_now().await;
    }
}

fn router(served: Arc<Served>) -> Router {
    let guarded = middleware::from_fn_with_state(served.clone(), check_access);
    Router::new()
        .route("/access", get(access))
        .route("/messages", get(messages))
        .fallback(file)
        .layer(guarded)
        .with_state(served)
}

/// The page's files, which are the same for every scene.
async fn file(method: Method, uri: Uri) -> Response {
    let Some((_, kind, text)) = FILES.iter().find(|(path, _, _)| *path == uri.path()) else {
        return (StatusCode::NOT_FOUND, "No such page.\n").into_response();
    };
    if method != Method::GET && method != Method::HEAD {
        return (StatusCode::METHOD_NOT_ALLOWED, [(header::ALLOW, "GET, HEAD")]).into_response();
    }
    ([(header::CONTENT_TYPE, *kind)], Body::from(*text)).into_response()
}

/// Says whether a token is right: browsers do not tell pages why a WebSocket was refused.
async fn access(State(served): State<Arc<Served>>, query: Query<AccessToken>) -> Response {
    if !query.opens(&served.token) { forbidden() } else { StatusCode::NO_CONTENT.into_response() }
}

fn forbidden() -> Response {
    (StatusCode::FORBIDDEN, "The token is missing or wrong. Open the link that raygrad printed.\n").into_response()
}

async fn messages(
    State(served): State<Arc<Served>>,
    query: Query<AccessToken>,
    Extension(network): Extension<Network>,
    headers: HeaderMap,
    upgrade: WebSocketUpgrade,
) -> Response {
    if !query.opens(&served.token) {
        return forbidden();
    }
    // Browsers always send the origin of a WebSocket request.
    if headers.get(header::ORIGIN).is_none() {
        return (StatusCode::FORBIDDEN, "Only the viewer page may connect.\n").into_response();
    }
    let longest = served.limits.longest;
    let Some(page) = Connection::join(served, network) else {
        return (StatusCode::SERVICE_UNAVAILABLE, "Too many viewer pages are open. Close one.\n").into_response();
    };
    let upgrade = upgrade.max_message_size(longest).max_frame_size(longest);
    upgrade.on_upgrade(move |socket| page.talk(socket))
}

#[cfg(test)]
mod tests;
