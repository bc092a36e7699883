//! The WebSocket connection of a page.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use axum::extract::ws::{CloseFrame, Message, WebSocket};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use raygrad::nerf::{Error, Result};
use tokio::sync::Semaphore;
use tokio::time::{timeout, timeout_at};

use super::messages::{ClientMessage, File};
use super::networks::Network;
use super::requests::{Outbox, Outgoing, sorry};
use super::served::{Limits, Served};

/// JPEG quality of images, 1 to 100.
const QUALITY: u8 = 88;
/// A message without effect, which shows pages that the connection works.
const ALIVE: &str = r#"{"tell":"alive"}"#;
/// Longest reason in a close frame, in bytes, below the limit of the protocol.
const REASON: usize = 120;

/// The connection of one page.
pub struct Connection {
    client: u64,
    outbox: Arc<Outbox>,
    served: Arc<Served>,
    /// Held while an image is read.
    reader: Arc<Semaphore>,
    /// True while a message is being sent.
    sending: AtomicBool,
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.served.requests.leave(self.client);
    }
}

impl Connection {
    /// Creates the connection, unless there are too many pages and its network has its share of them.
    pub fn join(served: Arc<Served>, network: Network) -> Option<Self> {
        let (client, outbox) = served.requests.join(network, served.limits.pages)?;
        Some(Connection {
            client,
            outbox,
            served,
            reader: Arc::new(Semaphore::new(1)),
            sending: AtomicBool::new(false),
        })
    }

    /// Exchanges messages until the page disconnects or violates a limit.
    pub async fn talk(self, socket: WebSocket) {
        self.outbox.post(Outgoing::Text(self.served.requests.about()));
        let patience = self.served.limits.patience;
        let (mut out, mut heard) = socket.split();
        let reason = tokio::select! {
            reason = self.write(&mut out) => reason.map(str::to_owned),
            reason = self.read(&mut heard) => reason,
        };
        drop(self);
        if let Some(reason) = reason {
            let close = CloseFrame { code: 1008, reason: shortened(reason).into() };
            let _ = timeout(patience, out.send(Message::Close(Some(close)))).await;
        }
    }

    /// Sends messages to the page. Returns the reason for closing the connection, or `None` if the page has gone.
    async fn write(&self, out: &mut SplitSink<WebSocket, Message>) -> Option<&'static str> {
        let (outbox, limits) = (&self.outbox, &self.served.limits);
        let mut pinged = Instant::now();
        loop {
            while let Some(message) = outbox.take() {
                let (bytes, message) = framed(message);
                // A page does not send while it receives a long message, so its silence does not count.
                self.sending.store(true, Ordering::Relaxed);
                let sent = timeout(limits.patience_for(bytes), out.send(message)).await;
                self.sending.store(false, Ordering::Relaxed);
                if !matches!(sent, Ok(Ok(()))) {
                    return None;
                }
            }
            if let Some(reason) = outbox.closing() {
                return Some(reason);
            }
            let seen = outbox.flying().map(|(since, bytes)| since + limits.patience_for(bytes));
            if seen.is_some_and(|until| until <= Instant::now()) {
                return Some("an image was not acknowledged");
            }
            // Browsers answer pings by themselves, also for idle pages.
            if pinged.elapsed() >= limits.idle {
                pinged = Instant::now();
                let send = async {
                    out.send(Message::Ping(Default::default())).await?;
                    // Pages do not see pings.
                    out.send(Message::Text(ALIVE.into())).await
                };
                if !matches!(timeout(limits.patience, send).await, Ok(Ok(()))) {
                    return None;
                }
            }
            let _ = timeout_at(next(pinged, seen, limits).into(), outbox.changed.notified()).await;
        }
    }

    /// Handles messages of the page. Returns the reason for closing the connection, or `None` if the page has gone.
    async fn read(&self, heard: &mut SplitStream<WebSocket>) -> Option<String> {
        let limits = &self.served.limits;
        let (mut allowed, mut last) = (limits.burst, Instant::now());
        loop {
            let message = match timeout(limits.silence, heard.next()).await {
                Ok(Some(Ok(message))) => message,
                Err(_) if self.sending.load(Ordering::Relaxed) => continue,
                _ => return None,
            };
            allowed = limits.allowed(allowed, last.elapsed().as_secs_f64());
            last = Instant::now();
            if allowed < 0.0 {
                return Some("too many messages".to_owned());
            }
            match message {
                Message::Text(text) => match ClientMessage::read(&text) {
                    Ok(ask) => self.answer(ask),
                    Err(what) => return Some(what),
                },
                Message::Binary(_) => return Some("messages must be text".to_owned()),
                Message::Close(_) => return None,
                Message::Ping(_) | Message::Pong(_) => (),
            }
        }
    }

    fn answer(&self, ask: ClientMessage) {
        let Connection { client, outbox, served, reader, .. } = self;
        let (client, requests) = (*client, &served.requests);
        match ask {
            ClientMessage::View { id, view } => requests.wish(client, id, view),
            ClientMessage::Seen { id } => outbox.seen(id),
            ClientMessage::Save { view } => {
                if !requests.save(client, view) {
                    outbox.post(sorry("too many saves are waiting: try again when one is done"));
                }
            }
            ClientMessage::Photograph { .. } if outbox.files() > served.limits.files => {
                outbox.post(sorry("too many images are waiting: try again when one has arrived"));
            }
            ClientMessage::Photograph { number } => match reader.clone().try_acquire_owned() {
                Ok(permit) => {
                    let (outbox, served) = (outbox.clone(), served.clone());
                    tokio::spawn(async move {
                        let photograph = photograph(number, &served).await;
                        drop(permit);
                        outbox.post(photograph);
                    });
                }
                Err(_) => outbox.post(sorry("another image is still loading: try again")),
            },
            ClientMessage::Pause { pause } => requests.pause(pause),
            ClientMessage::Stop {} => requests.stop(),
            ClientMessage::Share { share } => requests.set_share(share),
            ClientMessage::Rest {} => requests.rest(client),
            ClientMessage::Video(video) => match served.video_jobs.clone() {
                // Starting a video blocks, since it looks for installed programs.
                Some(video_jobs) => {
                    let outbox = outbox.clone();
                    tokio::task::spawn_blocking(move || {
                        let begun = video.fits().and_then(|()| video_jobs.begin(&video).map_err(|e| e.to_string()));
                        if let Err(what) = begun {
                            outbox.post(sorry(&what));
                        }
                    });
                }
                None => outbox.post(sorry("videos can be rendered only after training")),
            },
            ClientMessage::EndVideo {} => {
                if let Some(video_jobs) = &served.video_jobs {
                    video_jobs.end();
                }
            }
        }
    }
}

/// The WebSocket message and its length in bytes.
fn framed(message: Outgoing) -> (usize, Message) {
    match message {
        Outgoing::Text(text) => (text.len(), Message::Text(text.into())),
        Outgoing::Bytes(bytes) => (bytes.len(), Message::Binary(bytes.into())),
    }
}

/// Next time of a ping, or of the time-out of an unacknowledged render.
fn next(pinged: Instant, seen: Option<Instant>, limits: &Limits) -> Instant {
    let ping = pinged + limits.idle;
    seen.map_or(ping, |seen| seen.min(ping))
}

/// Shortens a reason to fit in a close frame.
fn shortened(mut reason: String) -> String {
    let room = (0..=REASON).rev().find(|at| reason.is_char_boundary(*at)).unwrap_or(0);
    reason.truncate(room);
    reason
}

/// The image as a JPEG message.
async fn photograph(number: usize, served: &Arc<Served>) -> Outgoing {
    let Ok(_permit) = served.readers.acquire().await else { return sorry("the image cannot be read") };
    let (photos, background) = (served.photos.clone(), served.background);
    let read = move || -> Result<Vec<u8>> {
        let photos = photos
            .ok_or_else(|| Error::setting("image", "the run's images are not available; the terminal shows why"))?;
        Ok(File::Photograph { number }.message(&photos.photo(number)?.over(background).to_jpeg(QUALITY)))
    };
    match tokio::task::spawn_blocking(read).await {
        Ok(Ok(bytes)) => Outgoing::Bytes(bytes),
        Ok(Err(error)) => sorry(&error.to_string()),
        Err(_) => sorry("the image cannot be read"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fuzz::run_config;
    use crate::run::Run;
    use crate::view::messages::View;
    use crate::view::requests::Requests;
    use crate::view::video_jobs::VideoJobs;
    use serde_json::{Value, json};
    use std::time::Duration;

    /// A page without a socket, of a scene without images.
    fn page(video_jobs: impl FnOnce(&Arc<Requests>) -> Option<Arc<VideoJobs>>) -> Connection {
        let requests = Arc::new(Requests::default());
        let video_jobs = video_jobs(&requests);
        let (readers, limits) = (Semaphore::new(1), Limits::USUAL);
        let (background, host) = ([1.0; 3], String::new());
        let served = Arc::new(Served {
            requests,
            photos: None,
            video_jobs,
            background,
            host,
            token: String::new(),
            readers,
            limits,
        });
        Connection::join(served, Network::LOCAL).unwrap()
    }

    fn view() -> View {
        serde_json::from_value(json!({ "eye": { "photograph": 0 }, "size": [8, 8] })).unwrap()
    }

    fn ask(page: &Connection, message: Value) {
        page.answer(ClientMessage::read(&message.to_string()).unwrap());
    }

    /// The text of the error that was sent, if any.
    fn apology(page: &Connection) -> Option<String> {
        match page.outbox.take()? {
            Outgoing::Text(text) => {
                let told: Value = serde_json::from_str(&text).unwrap();
                assert_eq!(told["tell"], "sorry");
                Some(told["what"].as_str().unwrap().to_owned())
            }
            Outgoing::Bytes(bytes) => panic!("{bytes:?}"),
        }
    }

    /// Like [`apology`], for answers of background tasks.
    async fn later(page: &Connection) -> String {
        for _ in 0..2000 {
            if let Some(what) = apology(page) {
                return what;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        panic!("nothing is said")
    }

    #[test]
    fn answer_handles_each_message() {
        let page = page(|_| None);
        let requests = &page.served.requests;
        page.answer(ClientMessage::View { id: 1, view: view() });
        assert_eq!(requests.wishes().len(), 1);
        page.answer(ClientMessage::Rest {});
        assert!(requests.wishes().is_empty());
        assert!(!requests.paused() && !requests.stops());
        page.answer(ClientMessage::Pause { pause: true });
        assert!(requests.paused() && !requests.stops());
        page.answer(ClientMessage::Pause { pause: false });
        page.answer(ClientMessage::Stop {});
        page.answer(ClientMessage::Share { share: 0.25 });
        assert!(!requests.paused() && requests.stops() && requests.share() == 0.25);
        page.answer(ClientMessage::EndVideo {});
        assert_eq!(apology(&page), None);
        ask(
            &page,
            json!({ "ask": "video", "path": { "render_width": 8, "render_height": 8, "seconds": 1, "fps": 1 } }),
        );
        assert_eq!(apology(&page).unwrap(), "videos can be rendered only after training");
        // Four saves may wait.
        let refused = (1..).find_map(|count| {
            page.answer(ClientMessage::Save { view: view() });
            apology(&page).map(|what| (count, what))
        });
        assert_eq!(refused, Some((5, "too many saves are waiting: try again when one is done".to_owned())));
        assert!(requests.next_save().is_some_and(|save| save.client == page.client));
        let requests = requests.clone();
        drop(page);
        assert_eq!(requests.connected(), 0);
    }

    #[tokio::test]
    async fn image_requests_are_read_one_at_a_time() {
        let page = page(|_| None);
        // Reads for other pages hold all permits.
        let others = page.served.readers.acquire().await.unwrap();
        ask(&page, json!({ "ask": "photograph", "number": 0 }));
        tokio::task::yield_now().await;
        assert_eq!(apology(&page), None);
        ask(&page, json!({ "ask": "photograph", "number": 1 }));
        assert_eq!(apology(&page).unwrap(), "another image is still loading: try again");
        drop(others);
        assert_eq!(later(&page).await, "`image`: the run's images are not available; the terminal shows why");
        ask(&page, json!({ "ask": "photograph", "number": 1 }));
        assert_eq!(later(&page).await, "`image`: the run's images are not available; the terminal shows why");
    }

    #[tokio::test]
    async fn image_requests_with_full_outbox_are_refused() {
        let page = page(|_| None);
        let limit = page.served.limits.files;
        for _ in 0..limit {
            page.outbox.post(Outgoing::Bytes(vec![]));
        }
        let asked = async |expected: &str| {
            ask(&page, json!({ "ask": "photograph", "number": 0 }));
            let files = page.outbox.files();
            (0..files).for_each(|_| assert!(matches!(page.outbox.take(), Some(Outgoing::Bytes(_)))));
            assert!(later(&page).await.contains(expected));
            (0..files + 1).for_each(|_| page.outbox.post(Outgoing::Bytes(vec![])));
        };
        asked("not available").await;
        // Above the limit by one and by two.
        asked("too many images are waiting: try again when one has arrived").await;
        asked("too many images are waiting: try again when one has arrived").await;
    }

    #[tokio::test]
    async fn video_errors_reach_the_page() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let run = Arc::new(Run { folder: file.path().to_owned(), config: run_config() });
        let page = page(|requests| Some(Arc::new(VideoJobs::new(run, None, requests.clone()))));
        let video =
            json!({ "ask": "video", "path": { "render_width": 8, "render_height": 8, "seconds": 1, "fps": 1 } });
        for _ in 0..2 {
            ask(&page, video.clone());
            assert!(later(&page).await.contains("videos"), "its folder is a file");
        }
        let path = json!({ "render_width": 2048, "render_height": 2048, "seconds": 600, "fps": 60 });
        ask(&page, json!({ "ask": "video", "path": path }));
        let expected = "36000 frames of this size are too many (at most 4096): lower the seconds, `fps` or size";
        assert_eq!(later(&page).await, expected);
        // Another page's video, which this page may cancel too.
        page.served.video_jobs.as_ref().unwrap().claim().unwrap();
        ask(&page, video.clone());
        assert_eq!(later(&page).await, "`video`: another video is rendering: wait for it or cancel it");
        page.answer(ClientMessage::EndVideo {});
        ask(&page, video);
        assert_eq!(later(&page).await, "`video`: the last video stops after its frame: try again then");
    }

    #[test]
    fn framed_messages_have_their_stated_length() {
        assert_eq!(framed(Outgoing::Text("\u{e4}x".to_owned())), (3, Message::Text("\u{e4}x".into())));
        assert_eq!(framed(Outgoing::Bytes(vec![7; 5])), (5, Message::Binary(vec![7; 5].into())));
    }

    #[test]
    fn next_deadline_is_the_earlier_one() {
        let (limits, start) = (Limits::USUAL, Instant::now());
        let after = |seconds: u64| start + Duration::from_secs(seconds);
        let next = |seen: Option<u64>| next(start, seen.map(after), &limits);
        assert_eq!([next(None), next(Some(1)), next(Some(60))], [after(5), after(1), after(5)]);
    }

    #[test]
    fn close_reason_is_cut_at_a_character() {
        assert_eq!(shortened("not taken".to_owned()), "not taken");
        assert_eq!(shortened("x".repeat(500)), "x".repeat(REASON));
        assert_eq!(shortened("\u{e4}".repeat(100)), "\u{e4}".repeat(REASON / 2));
        assert_eq!(shortened(format!("x{}", "\u{e4}".repeat(100))), format!("x{}", "\u{e4}".repeat(REASON / 2 - 1)));
        assert_eq!(shortened(String::new()), "");
    }
}
