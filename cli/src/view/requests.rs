//! Where what pages ask for meets what is painted: one thread paints, and each page has tasks of its own.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::Notify;

use super::messages::{self, File, Made, ServerMessage, View};

/// Messages that wait for a page, beside a picture: more than it can have asked for in earnest.
const WAITING: usize = 64;
/// Pictures to keep that wait to be painted or sent, of one page.
const SAVES: usize = 4;

/// What a page wants to see, as long as one does: pages that want the same share it.
#[derive(Debug)]
pub struct RenderRequest {
    pub view: View,
    last: Mutex<Option<Arc<RenderedFrame>>>,
}

/// A picture for pages.
#[derive(Debug)]
pub struct RenderedFrame {
    pub made: Made,
    pub jpeg: Vec<u8>,
}

/// What is on its way to a page.
#[derive(Default)]
pub struct Outbox {
    waiting: Mutex<Waiting>,
    pub changed: Notify,
}

#[derive(Default)]
struct Waiting {
    /// The newest picture; one that nobody has seen yet is not worth sending any more.
    picture: Option<(u32, Arc<RenderedFrame>)>,
    others: VecDeque<Outgoing>,
    /// How training goes, of which the newest is enough.
    told: Option<String>,
    /// Which picture was sent and has not been seen.
    flying: Option<InFlight>,
    overrun: bool,
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

/// That something cannot be had, and why.
pub fn sorry(what: &str) -> Outgoing {
    text(&ServerMessage::Sorry { what: what.to_owned() })
}

/// A message of text.
pub fn text(tell: &ServerMessage) -> Outgoing {
    Outgoing::Text(messages::text(tell))
}

impl Outbox {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Something for the page, in order.
    pub fn post(&self, message: Outgoing) {
        let mut waiting = self.lock();
        waiting.overrun |= waiting.others.len() >= WAITING;
        if !waiting.overrun {
            waiting.others.push_back(message);
        }
        drop(waiting);
        self.changed.notify_one();
    }

    fn show(&self, id: u32, shot: Arc<RenderedFrame>) {
        self.lock().picture = Some((id, shot));
        self.changed.notify_one();
    }

    /// The picture that waits is not wanted any more.
    fn forget(&self) {
        self.lock().picture = None;
    }

    /// What is to be sent next, if anything may be.
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
        // Nobody has to wait while it is copied.
        drop(waiting);
        Some(Outgoing::Bytes(File::Picture { id, made: shot.made }.message(&shot.jpeg)))
    }

    /// Since when a picture is under way that the page has not seen, and of how many bytes.
    pub fn flying(&self) -> Option<(Instant, usize)> {
        self.lock().flying.as_ref().map(|flying| (flying.since, flying.bytes))
    }

    /// How many files wait to be sent.
    pub fn files(&self) -> usize {
        self.lock().others.iter().filter(|message| matches!(message, Outgoing::Bytes(_))).count()
    }

    fn tell_state(&self, text: &str) {
        self.lock().told = Some(text.to_owned());
        self.changed.notify_one();
    }

    /// Whether the page does not take what it has asked for.
    pub fn is_overrun(&self) -> bool {
        self.lock().overrun
    }

    /// The page has the picture.
    pub fn seen(&self, id: u32) {
        self.lock().flying.take_if(|flying| flying.id == id);
        self.changed.notify_one();
    }
}

struct Client {
    wish: Option<(u32, Arc<RenderRequest>)>,
    outbox: Arc<Outbox>,
}

/// A picture to keep.
pub struct Save {
    pub client: u64,
    pub view: View,
}

#[derive(Default)]
struct State {
    clients: BTreeMap<u64, Client>,
    next: u64,
    saves: VecDeque<Save>,
    /// Whether something was asked for since somebody last waited.
    news: bool,
    /// Whether training is to wait, and whether it is to end.
    paused: bool,
    stops: bool,
    /// The share of time that pictures get of training.
    share: f64,
    /// What a page is told of the scene when it comes.
    about: String,
}

/// What pages and the renderer share.
#[derive(Default)]
pub struct Requests {
    state: Mutex<State>,
    wake: Condvar,
}

impl Requests {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Says what pages are told of the scene when they come from now on.
    pub fn introduce(&self, about: String) {
        self.lock().about = about;
    }

    /// What a page is told of the scene when it comes.
    pub fn about(&self) -> String {
        self.lock().about.clone()
    }

    /// A page comes, if there are fewer than so many.
    pub fn join(&self, most: usize) -> Option<(u64, Arc<Outbox>)> {
        let mut state = self.lock();
        if state.clients.len() >= most {
            return None;
        }
        let (number, outbox) = (state.next, Arc::new(Outbox::default()));
        state.next += 1;
        state.clients.insert(number, Client { wish: None, outbox: outbox.clone() });
        Some((number, outbox))
    }

    /// A page goes.
    pub fn leave(&self, client: u64) {
        let mut state = self.lock();
        state.clients.remove(&client);
        state.saves.retain(|save| save.client != client);
        self.news(&mut state);
    }

    /// How many pages there are.
    pub fn connected(&self) -> usize {
        self.lock().clients.len()
    }

    /// A page wants to see something else: what it wanted before is forgotten.
    pub fn wish(&self, client: u64, id: u32, view: View) {
        let mut state = self.lock();
        let same = state.clients.values().filter_map(|other| other.wish.as_ref()).find(|(_, wish)| wish.view == view);
        let wish = same.map(|(_, wish)| wish.clone());
        let wish = wish.unwrap_or_else(|| Arc::new(RenderRequest { view, last: Mutex::default() }));
        if let Some(client) = state.clients.get_mut(&client) {
            let last = wish.last.lock().unwrap_or_else(PoisonError::into_inner).clone();
            client.wish = Some((id, wish));
            // Of what it wanted before, nothing.
            client.outbox.forget();
            if let Some(shot) = last {
                client.outbox.show(id, shot);
            }
        }
        self.news(&mut state);
    }

    /// A page wants to see nothing for now.
    pub fn rest(&self, client: u64) {
        if let Some(client) = self.lock().clients.get_mut(&client) {
            client.wish = None;
            client.outbox.forget();
        }
    }

    /// A page wants a picture to keep; says whether it may.
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

    /// What pages want to see, each once.
    pub fn wishes(&self) -> Vec<Arc<RenderRequest>> {
        let mut wishes: Vec<Arc<RenderRequest>> = vec![];
        for (_, wish) in self.lock().clients.values().filter_map(|client| client.wish.as_ref()) {
            if !wishes.iter().any(|known| Arc::ptr_eq(known, wish)) {
                wishes.push(wish.clone());
            }
        }
        wishes
    }

    /// The next picture to keep.
    pub fn next_save(&self) -> Option<Save> {
        self.lock().saves.pop_front()
    }

    /// Whether a page is still there.
    pub fn is_here(&self, client: u64) -> bool {
        self.lock().clients.contains_key(&client)
    }

    /// Whether somebody still wants to see this.
    pub fn wants(&self, wish: &Arc<RenderRequest>) -> bool {
        self.lock().clients.values().filter_map(|client| client.wish.as_ref()).any(|(_, own)| Arc::ptr_eq(own, wish))
    }

    /// This cannot be seen: all who want it are told why, and wait for nothing.
    pub fn refuse(&self, wish: &Arc<RenderRequest>, what: &str) {
        for client in self.lock().clients.values_mut() {
            if client.wish.take_if(|(_, own)| Arc::ptr_eq(own, wish)).is_some() {
                client.outbox.forget();
                client.outbox.post(sorry(what));
            }
        }
    }

    /// A picture is ready: all who want it get it.
    pub fn show(&self, wish: &Arc<RenderRequest>, shot: RenderedFrame) {
        let shot = Arc::new(shot);
        let state = self.lock();
        *wish.last.lock().unwrap_or_else(PoisonError::into_inner) = Some(shot.clone());
        for client in state.clients.values() {
            if let Some((id, _)) = client.wish.as_ref().filter(|(_, own)| Arc::ptr_eq(own, wish)) {
                client.outbox.show(*id, shot.clone());
            }
        }
    }

    /// A message for one page.
    pub fn post(&self, client: u64, message: Outgoing) {
        if let Some(client) = self.lock().clients.get(&client) {
            client.outbox.post(message);
        }
    }

    /// A message for all pages.
    pub fn tell(&self, message: &Outgoing) {
        self.lock().clients.values().for_each(|client| client.outbox.post(message.clone()));
    }

    /// How training goes, for all pages.
    pub fn tell_state(&self, text: &str) {
        self.lock().clients.values().for_each(|client| client.outbox.tell_state(text));
    }

    /// Waits until something was asked for since it was called last, no longer than this.
    pub fn wait(&self, most: Duration) {
        let state = self.lock();
        let waited = self.wake.wait_timeout_while(state, most, |state| !state.news);
        waited.unwrap_or_else(PoisonError::into_inner).0.news = false;
    }

    /// Wakes who waits.
    pub fn wake(&self) {
        self.news(&mut self.lock());
    }

    fn news(&self, state: &mut State) {
        state.news = true;
        self.wake.notify_all();
    }

    /// Whether training is to wait.
    pub fn paused(&self) -> bool {
        self.lock().paused
    }

    /// Lets training wait or go on.
    pub fn pause(&self, pause: bool) {
        let mut state = self.lock();
        state.paused = pause;
        self.news(&mut state);
    }

    /// Whether training is to end.
    pub fn stops(&self) -> bool {
        self.lock().stops
    }

    /// Lets training end.
    pub fn stop(&self) {
        let mut state = self.lock();
        state.stops = true;
        self.news(&mut state);
    }

    /// The share of time that pictures get of training.
    pub fn share(&self) -> f64 {
        self.lock().share
    }

    /// Sets it.
    pub fn set_share(&self, share: f64) {
        self.lock().share = share;
    }
}

#[cfg(test)]
mod tests;
