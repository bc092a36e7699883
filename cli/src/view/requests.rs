//! Shared state of pages and the renderer. One thread renders, and each page has its own tasks.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use raygrad::tensor::parallel::locked;
use tokio::sync::Notify;

use super::messages::{self, File, Made, ServerMessage, View};
use super::networks::{Network, largest};

/// Most messages that wait for a page. Well-behaved pages stay far below.
const WAITING: usize = 64;
/// Most saves of one page that wait to be rendered or sent.
const SAVES: usize = 4;

/// A requested view, shared by all pages that request the same one.
#[derive(Debug)]
pub struct RenderRequest {
    pub view: View,
    last: Mutex<Option<Arc<RenderedFrame>>>,
}

/// A render for pages.
#[derive(Debug)]
pub struct RenderedFrame {
    pub made: Made,
    pub jpeg: Vec<u8>,
}

/// Messages that wait to be sent to a page.
#[derive(Default)]
pub struct Outbox {
    waiting: Mutex<Waiting>,
    pub changed: Notify,
}

#[derive(Default)]
struct Waiting {
    /// The newest render. It replaces one that was not sent yet.
    picture: Option<(u32, Arc<RenderedFrame>)>,
    others: VecDeque<Outgoing>,
    /// The newest state of training.
    told: Option<String>,
    /// The render that was sent but not acknowledged.
    flying: Option<InFlight>,
    /// Reason for closing the connection.
    closing: Option<&'static str>,
}

struct InFlight {
    id: u32,
    since: Instant,
    bytes: usize,
}

/// A message to a page.
#[derive(Debug, Clone, PartialEq)]
pub enum Outgoing {
    Text(String),
    Bytes(Vec<u8>),
}

/// The message that a request failed, with the reason.
pub fn sorry(what: &str) -> Outgoing {
    text(&ServerMessage::Sorry { what: what.to_owned() })
}

/// A text message.
pub fn text(tell: &ServerMessage) -> Outgoing {
    Outgoing::Text(messages::text(tell))
}

impl Outbox {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        locked(&self.waiting)
    }

    /// Appends a message.
    pub fn post(&self, message: Outgoing) {
        let mut waiting = self.lock();
        if waiting.others.len() >= WAITING {
            waiting.closing.get_or_insert("too many unsent replies");
        }
        if waiting.closing.is_none() {
            waiting.others.push_back(message);
        }
        drop(waiting);
        self.changed.notify_one();
    }

    fn show(&self, id: u32, shot: Arc<RenderedFrame>) {
        self.lock().picture = Some((id, shot));
        self.changed.notify_one();
    }

    /// Drops the waiting render.
    fn forget(&self) {
        self.lock().picture = None;
    }

    /// The next message, if one may be sent.
    pub fn take(&self) -> Option<Outgoing> {
        let mut waiting = self.lock();
        if let Some(message) = waiting.others.pop_front() {
            return Some(message);
        }
        if let Some(text) = waiting.told.take() {
            return Some(Outgoing::Text(text));
        }
        if waiting.flying.is_some() {
            return None;
        }
        let (id, shot) = waiting.picture.take()?;
        waiting.flying = Some(InFlight { id, since: Instant::now(), bytes: shot.jpeg.len() });
        // The lock is released before the render is copied.
        drop(waiting);
        Some(Outgoing::Bytes(File::Picture { id, made: shot.made }.message(&shot.jpeg)))
    }

    /// Send time and length in bytes of the unacknowledged render.
    pub fn flying(&self) -> Option<(Instant, usize)> {
        self.lock().flying.as_ref().map(|flying| (flying.since, flying.bytes))
    }

    /// Number of waiting files.
    pub fn files(&self) -> usize {
        self.lock().others.iter().filter(|message| matches!(message, Outgoing::Bytes(_))).count()
    }

    fn tell_state(&self, text: &str) {
        self.lock().told = Some(text.to_owned());
        self.changed.notify_one();
    }

    /// Reason for closing the connection, if there is one.
    pub fn closing(&self) -> Option<&'static str> {
        self.lock().closing
    }

    /// Closes the connection.
    fn close(&self, reason: &'static str) {
        self.lock().closing = Some(reason);
        self.changed.notify_one();
    }

    /// Acknowledges a render.
    pub fn seen(&self, id: u32) {
        self.lock().flying.take_if(|flying| flying.id == id);
        self.changed.notify_one();
    }
}

struct Client {
    network: Network,
    wish: Option<(u32, Arc<RenderRequest>)>,
    outbox: Arc<Outbox>,
}

/// A render to save.
pub struct Save {
    pub client: u64,
    pub view: View,
}

#[derive(Default)]
struct State {
    clients: BTreeMap<u64, Client>,
    next: u64,
    saves: VecDeque<Save>,
    /// True if something has changed since the last wait.
    news: bool,
    /// True to pause training, and true to stop it.
    paused: bool,
    stops: bool,
    /// Fraction of time for renders during training.
    share: f64,
    /// The description of the scene for new pages.
    about: String,
}

/// State that pages and the renderer share.
#[derive(Default)]
pub struct Requests {
    state: Mutex<State>,
    wake: Condvar,
}

impl Requests {
    fn lock(&self) -> MutexGuard<'_, State> {
        locked(&self.state)
    }

    /// Sets the description of the scene for new pages.
    pub fn introduce(&self, about: String) {
        self.lock().about = about;
    }

    /// The description of the scene for new pages.
    pub fn about(&self) -> String {
        self.lock().about.clone()
    }

    /// Adds a page. If there are `most` already, it replaces the newest page of the network with the most pages, unless
    /// that is its own.
    pub fn join(&self, network: Network, most: usize) -> Option<(u64, Arc<Outbox>)> {
        let mut state = self.lock();
        if state.clients.len() >= most {
            let crowd = largest(state.clients.values().map(|client| client.network), network);
            let newest = state.clients.iter().rfind(|(_, client)| client.network == crowd && crowd != network);
            let newest = *newest?.0;
            if let Some(client) = self.remove(&mut state, newest) {
                client.outbox.close("too many viewer pages are open at your address");
            }
        }
        let (number, outbox) = (state.next, Arc::new(Outbox::default()));
        state.next += 1;
        state.clients.insert(number, Client { network, wish: None, outbox: outbox.clone() });
        Some((number, outbox))
    }

    /// Removes a page.
    pub fn leave(&self, client: u64) {
        self.remove(&mut self.lock(), client);
    }

    fn remove(&self, state: &mut State, client: u64) -> Option<Client> {
        state.saves.retain(|save| save.client != client);
        self.news(state);
        state.clients.remove(&client)
    }

    /// Number of connected pages.
    pub fn connected(&self) -> usize {
        self.lock().clients.len()
    }

    /// Replaces the request of a page.
    pub fn wish(&self, client: u64, id: u32, view: View) {
        let mut state = self.lock();
        let same = state.clients.values().filter_map(|other| other.wish.as_ref()).find(|(_, wish)| wish.view == view);
        let wish = same.map(|(_, wish)| wish.clone());
        let wish = wish.unwrap_or_else(|| Arc::new(RenderRequest { view, last: Mutex::default() }));
        if let Some(client) = state.clients.get_mut(&client) {
            let last = locked(&wish.last).clone();
            client.wish = Some((id, wish));
            // Drops the renders of the old request.
            client.outbox.forget();
            if let Some(shot) = last {
                client.outbox.show(id, shot);
            }
        }
        self.news(&mut state);
    }

    /// Removes the request of a page.
    pub fn rest(&self, client: u64) {
        if let Some(client) = self.lock().clients.get_mut(&client) {
            client.wish = None;
            client.outbox.forget();
        }
    }

    /// Queues a save of a page; returns false if too many wait.
    pub fn save(&self, client: u64, view: View) -> bool {
        let mut state = self.lock();
        let painted = state.clients.get(&client).map_or(0, |client| client.outbox.files());
        let fits = painted + state.saves.iter().filter(|save| save.client == client).count() < SAVES;
        if fits {
            state.saves.push_back(Save { client, view });
            self.news(&mut state);
        }
        fits
    }

    /// The requested views without duplicates.
    pub fn wishes(&self) -> Vec<Arc<RenderRequest>> {
        let mut wishes: Vec<Arc<RenderRequest>> = vec![];
        for (_, wish) in self.lock().clients.values().filter_map(|client| client.wish.as_ref()) {
            if !wishes.iter().any(|known| Arc::ptr_eq(known, wish)) {
                wishes.push(wish.clone());
            }
        }
        wishes
    }

    /// Takes the next save from the queue.
    pub fn next_save(&self) -> Option<Save> {
        self.lock().saves.pop_front()
    }

    /// Returns true if a page is connected.
    pub fn is_here(&self, client: u64) -> bool {
        self.lock().clients.contains_key(&client)
    }

    /// Returns true if a page still requests this view.
    pub fn wants(&self, wish: &Arc<RenderRequest>) -> bool {
        self.lock().clients.values().filter_map(|client| client.wish.as_ref()).any(|(_, own)| Arc::ptr_eq(own, wish))
    }

    /// Removes a request and sends the reason to its pages.
    pub fn refuse(&self, wish: &Arc<RenderRequest>, what: &str) {
        for client in self.lock().clients.values_mut() {
            if client.wish.take_if(|(_, own)| Arc::ptr_eq(own, wish)).is_some() {
                client.outbox.forget();
                client.outbox.post(sorry(what));
            }
        }
    }

    /// Sends a render to all pages that requested it.
    pub fn show(&self, wish: &Arc<RenderRequest>, shot: RenderedFrame) {
        let shot = Arc::new(shot);
        let state = self.lock();
        *locked(&wish.last) = Some(shot.clone());
        for client in state.clients.values() {
            if let Some((id, _)) = client.wish.as_ref().filter(|(_, own)| Arc::ptr_eq(own, wish)) {
                client.outbox.show(*id, shot.clone());
            }
        }
    }

    /// Sends a message to one page.
    pub fn post(&self, client: u64, message: Outgoing) {
        if let Some(client) = self.lock().clients.get(&client) {
            client.outbox.post(message);
        }
    }

    /// Sends a message to all pages.
    pub fn tell(&self, message: &Outgoing) {
        self.lock().clients.values().for_each(|client| client.outbox.post(message.clone()));
    }

    /// Sends the state of training to all pages.
    pub fn tell_state(&self, text: &str) {
        self.lock().clients.values().for_each(|client| client.outbox.tell_state(text));
    }

    /// Waits for a change since the last call, for at most this time.
    pub fn wait(&self, most: Duration) {
        let state = self.lock();
        let waited = self.wake.wait_timeout_while(state, most, |state| !state.news);
        waited.unwrap_or_else(PoisonError::into_inner).0.news = false;
    }

    /// Wakes the waiting renderer.
    pub fn wake(&self) {
        self.news(&mut self.lock());
    }

    fn news(&self, state: &mut State) {
        state.news = true;
        self.wake.notify_all();
    }

    /// Returns true if training must pause.
    pub fn paused(&self) -> bool {
        self.lock().paused
    }

    /// Pauses or resumes training.
    pub fn pause(&self, pause: bool) {
        let mut state = self.lock();
        state.paused = pause;
        self.news(&mut state);
    }

    /// Returns true if training must stop.
    pub fn stops(&self) -> bool {
        self.lock().stops
    }

    /// Stops training.
    pub fn stop(&self) {
        let mut state = self.lock();
        state.stops = true;
        self.news(&mut state);
    }

    /// Fraction of time for renders during training.
    pub fn share(&self) -> f64 {
        self.lock().share
    }

    /// Sets the fraction of time for renders.
    pub fn set_share(&self, share: f64) {
        self.lock().share = share;
    }
}

#[cfg(test)]
mod tests;
