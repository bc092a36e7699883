//! Where what pages ask for meets what is painted: one thread paints, and each page has tasks of its own.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::Notify;

use super::messages::{self, File, Made, Tell, View};

/// Messages that wait for a page, beside a picture: more than it can have asked for in earnest.
const WAITING: usize = 64;
/// Pictures to keep that wait to be painted or sent, of one page.
const SAVES: usize = 4;

/// What a page wants to see, as long as one does: pages that want the same share it.
#[derive(Debug)]
pub struct Wish {
    pub view: View,
    last: Mutex<Option<Arc<Shot>>>,
}

/// A picture for pages.
#[derive(Debug)]
pub struct Shot {
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
    picture: Option<(u32, Arc<Shot>)>,
    others: VecDeque<Outgoing>,
    /// How training goes, of which the newest is enough.
    told: Option<String>,
    /// Which picture was sent and has not been seen.
    flying: Option<Flying>,
    /// How many messages of bytes are in `others`.
    files: usize,
    overrun: bool,
}

struct Flying {
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
    text(&Tell::Sorry { what: what.to_owned() })
}

/// A message of text.
pub fn text(tell: &Tell) -> Outgoing {
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
            waiting.files += usize::from(matches!(message, Outgoing::Bytes(_)));
            waiting.others.push_back(message);
        }
        drop(waiting);
        self.changed.notify_one();
    }

    fn show(&self, id: u32, shot: Arc<Shot>) {
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
            waiting.files -= usize::from(matches!(message, Outgoing::Bytes(_)));
            return Some(message);
        }
        if let Some(text) = waiting.told.take() {
            return Some(Outgoing::Text(text));
        }
        if waiting.flying.is_some() {
            return None;
        }
        let (id, shot) = waiting.picture.take()?;
        waiting.flying = Some(Flying { id, since: Instant::now(), bytes: shot.jpeg.len() });
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
        self.lock().files
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
    wish: Option<(u32, Arc<Wish>)>,
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
}

/// What pages and the painter share.
#[derive(Default)]
pub struct Hub {
    state: Mutex<State>,
    wake: Condvar,
    /// How many pages there are.
    connected: AtomicUsize,
    paused: AtomicBool,
    stops: AtomicBool,
    /// The share of time that pictures get of training, as the bits of an f64.
    share: AtomicU64,
    /// What a page is told of the scene when it comes.
    about: Mutex<String>,
}

impl Hub {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Says what pages are told of the scene when they come from now on.
    pub fn introduce(&self, about: String) {
        *self.about.lock().unwrap_or_else(PoisonError::into_inner) = about;
    }

    /// What a page is told of the scene when it comes.
    pub fn about(&self) -> String {
        self.about.lock().unwrap_or_else(PoisonError::into_inner).clone()
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
        self.connected.store(state.clients.len(), Ordering::Release);
        Some((number, outbox))
    }

    /// A page goes.
    pub fn leave(&self, client: u64) {
        let mut state = self.lock();
        state.clients.remove(&client);
        state.saves.retain(|save| save.client != client);
        self.connected.store(state.clients.len(), Ordering::Release);
        self.news(&mut state);
    }

    /// How many pages there are.
    pub fn connected(&self) -> usize {
        self.connected.load(Ordering::Acquire)
    }

    /// A page wants to see something else: what it wanted before is forgotten.
    pub fn wish(&self, client: u64, id: u32, view: View) {
        let mut state = self.lock();
        let same = state.clients.values().filter_map(|other| other.wish.as_ref()).find(|(_, wish)| wish.view == view);
        let wish = same.map(|(_, wish)| wish.clone());
        let wish = wish.unwrap_or_else(|| Arc::new(Wish { view, last: Mutex::default() }));
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
    pub fn wishes(&self) -> Vec<Arc<Wish>> {
        let mut wishes: Vec<Arc<Wish>> = vec![];
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
    pub fn wants(&self, wish: &Arc<Wish>) -> bool {
        self.lock().clients.values().filter_map(|client| client.wish.as_ref()).any(|(_, own)| Arc::ptr_eq(own, wish))
    }

    /// This cannot be seen: all who want it are told why, and wait for nothing.
    pub fn refuse(&self, wish: &Arc<Wish>, what: &str) {
        for client in self.lock().clients.values_mut() {
            if client.wish.take_if(|(_, own)| Arc::ptr_eq(own, wish)).is_some() {
                client.outbox.forget();
                client.outbox.post(sorry(what));
            }
        }
    }

    /// A picture is ready: all who want it get it.
    pub fn show(&self, wish: &Arc<Wish>, shot: Shot) {
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
        self.paused.load(Ordering::Relaxed)
    }

    /// Lets training wait or go on.
    pub fn pause(&self, pause: bool) {
        self.paused.store(pause, Ordering::Relaxed);
        self.wake();
    }

    /// Whether training is to end.
    pub fn stops(&self) -> bool {
        self.stops.load(Ordering::Relaxed)
    }

    /// Lets training end.
    pub fn stop(&self) {
        self.stops.store(true, Ordering::Relaxed);
        self.wake();
    }

    /// The share of time that pictures get of training.
    pub fn share(&self) -> f64 {
        f64::from_bits(self.share.load(Ordering::Relaxed))
    }

    /// Sets it.
    pub fn set_share(&self, share: f64) {
        self.share.store(share.to_bits(), Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::shown::Show;
    use crate::view::messages::Eye;
    use futures_util::FutureExt;

    fn view(number: usize) -> View {
        let eye = Eye::Photograph(number);
        View {
            eye,
            size: [8, 8],
            show: Show::Color,
            compared: false,
            background: None,
            crop: None,
            skip: None,
            checkpoint: None,
        }
    }

    fn shot(halvings: u32) -> Shot {
        Shot { made: Made { halvings, milliseconds: 1.0, compared: None, step: 0 }, jpeg: vec![halvings as u8] }
    }

    /// The last byte of the picture that is sent next.
    fn sent(outbox: &Outbox) -> Option<u8> {
        match outbox.take()? {
            Outgoing::Bytes(bytes) => bytes.last().copied(),
            Outgoing::Text(text) => panic!("{text}"),
        }
    }

    #[test]
    fn pages_that_want_the_same_share_it_and_the_newest_wish_counts() {
        let hub = Hub::default();
        let ([a, b], [from_a, from_b]) = {
            let [(a, out), (b, other)] = [hub.join(9), hub.join(9)].map(Option::unwrap);
            ([a, b], [out, other])
        };
        assert_eq!(hub.connected(), 2);
        hub.wish(a, 1, view(1));
        hub.wish(b, 9, view(1));
        let wishes = hub.wishes();
        assert!(wishes.len() == 1 && hub.wants(&wishes[0]));
        hub.show(&wishes[0], shot(2));
        assert_eq!([sent(&from_a), sent(&from_b)], [Some(2); 2]);
        // Until it is seen no other is sent, and then the newest.
        hub.show(&wishes[0], shot(1));
        hub.show(&wishes[0], shot(0));
        assert_eq!(sent(&from_a), None);
        from_a.seen(7);
        assert_eq!(sent(&from_a), None, "that was another");
        from_a.seen(1);
        assert_eq!([sent(&from_a), sent(&from_a)], [Some(0), None]);
        // One that comes later gets what there is at once.
        let (c, from_c) = hub.join(9).unwrap();
        hub.wish(c, 3, view(1));
        assert_eq!(sent(&from_c), Some(0));
        hub.leave(c);
        // What waits of an old wish is not sent any more.
        hub.wish(b, 10, view(2));
        from_b.seen(9);
        assert_eq!(sent(&from_b), None);
        assert_eq!(hub.wishes().len(), 2);
        hub.wish(a, 2, view(2));
        assert!(!hub.wants(&wishes[0]) && hub.wishes().len() == 1);
        hub.refuse(&wishes[0], "nobody wants it");
        assert_eq!(from_a.take(), None);
        hub.refuse(&hub.wishes()[0], "it is lost");
        assert!(hub.wishes().is_empty());
        assert!(matches!(from_a.take(), Some(Outgoing::Text(text)) if text.contains("it is lost")));
        hub.wish(a, 3, view(2));
        hub.wish(b, 11, view(2));
        assert!(hub.is_here(a) && hub.is_here(b) && !hub.is_here(c));
        hub.rest(a);
        assert_eq!(hub.wishes().len(), 1, "that of the other");
        hub.leave(a);
        hub.leave(b);
        assert!(hub.wishes().is_empty() && hub.connected() == 0);
    }

    #[test]
    fn a_page_has_so_much_waiting_and_no_more() {
        let hub = Hub::default();
        let (page, outbox) = hub.join(9).unwrap();
        assert!((0..SAVES).all(|i| hub.save(page, view(i))) && !hub.save(page, view(9)));
        let (other, _) = hub.join(2).unwrap();
        assert!(hub.join(2).is_none());
        assert!(hub.save(other, view(0)), "each its own");
        hub.leave(page);
        assert!(hub.next_save().is_some_and(|save| save.client == other) && hub.next_save().is_none());
        // In the order in which they were asked for; what is painted and not sent counts.
        let (third, files) = hub.join(9).unwrap();
        hub.save(third, view(1));
        hub.save(third, view(2));
        let numbers = [(); 2].map(|()| hub.next_save().unwrap().view.eye);
        assert_eq!(numbers, [1, 2].map(Eye::Photograph));
        (0..SAVES).for_each(|_| files.post(Outgoing::Bytes(vec![])));
        assert!(!hub.save(third, view(3)));
        files.take();
        assert!(hub.save(third, view(3)) && files.files() == SAVES - 1);
        // Of how training goes, the newest is told.
        hub.tell_state("one");
        hub.tell_state("two");
        while files.files() > 0 {
            files.take();
        }
        assert_eq!([files.take(), files.take()], [Some(Outgoing::Text("two".to_owned())), None]);
        for _ in 0..WAITING {
            outbox.post(Outgoing::Text(String::new()));
        }
        assert!(!outbox.is_overrun());
        // It stays so, and what is too much is not kept.
        for _ in 0..2 {
            outbox.post(Outgoing::Bytes(vec![]));
            assert!(outbox.is_overrun() && outbox.files() == 0);
        }
        assert_eq!(std::iter::from_fn(|| outbox.take()).count(), WAITING);
        outbox.post(Outgoing::Text(String::new()));
        assert!(outbox.is_overrun() && outbox.take().is_none());
    }

    #[test]
    fn what_waits_of_an_old_wish_is_not_sent() {
        let hub = Hub::default();
        let (page, outbox) = hub.join(9).unwrap();
        let wish = |id: u32| {
            hub.wish(page, id, view(1));
            let wish = hub.wishes().pop().unwrap();
            hub.show(&wish, shot(1));
            wish
        };
        // A picture is under way, and another waits.
        wish(1);
        assert_eq!(sent(&outbox), Some(1));
        wish(2);
        hub.rest(page);
        outbox.seen(1);
        assert_eq!(sent(&outbox), None, "nothing is looked at");
        hub.refuse(&wish(3), "it is lost");
        assert_eq!(outbox.take(), Some(sorry("it is lost")));
        assert_eq!(outbox.take(), None);
        // Of how long one is under way there is a record until it is seen.
        assert_eq!(outbox.flying(), None);
        let before = Instant::now();
        wish(4);
        assert_eq!(sent(&outbox), Some(1));
        let (since, bytes) = outbox.flying().unwrap();
        assert!(since >= before && since <= Instant::now() && bytes == 1);
        outbox.seen(3);
        assert!(outbox.flying().is_some());
        outbox.seen(4);
        assert_eq!(outbox.flying(), None);
    }

    #[test]
    fn who_sends_is_woken_by_all_there_is_to_send() {
        let hub = Hub::default();
        let (page, outbox) = hub.join(9).unwrap();
        let is_woken = || outbox.changed.notified().now_or_never().is_some();
        assert!(!is_woken());
        hub.wish(page, 1, view(1));
        let shows = || hub.show(&hub.wishes()[0], shot(0));
        let changes: [&dyn Fn(); 6] = [
            &|| outbox.post(sorry("it is lost")),
            &|| hub.post(page, sorry("it is lost")),
            &|| hub.tell(&sorry("it is lost")),
            &|| hub.tell_state("now"),
            &shows,
            &|| outbox.seen(1),
        ];
        for (i, change) in changes.into_iter().enumerate() {
            change();
            assert!(is_woken() && !is_woken(), "{i}");
        }
        assert_eq!(std::iter::from_fn(|| outbox.take()).count(), 5);
    }

    #[test]
    fn messages_are_for_whom_they_are_for() {
        let hub = Hub::default();
        let [(a, from_a), (b, from_b)] = [hub.join(9), hub.join(9)].map(Option::unwrap);
        assert_ne!(a, b);
        let say = |text: &str| Outgoing::Text(text.to_owned());
        hub.post(a, say("one"));
        hub.post(7, say("nobody"));
        hub.tell(&say("all"));
        let heard = |outbox: &Outbox| std::iter::from_fn(|| outbox.take()).collect::<Vec<_>>();
        assert_eq!([heard(&from_a), heard(&from_b)], [vec![say("one"), say("all")], vec![say("all")]]);
        assert_eq!(hub.about(), "");
        hub.introduce("a scene".to_owned());
        assert_eq!(hub.about(), "a scene");
    }

    /// Whether something was asked for since this was called last.
    fn is_news(hub: &Hub) -> bool {
        std::mem::take(&mut hub.lock().news)
    }

    #[test]
    fn who_paints_is_woken_by_all_that_changes_what_there_is_to_paint() {
        let hub = Hub::default();
        let (page, _outbox) = hub.join(9).unwrap();
        assert!(!hub.paused() && !hub.stops() && !is_news(&hub));
        let changes: [&dyn Fn(); 6] = [
            &|| hub.wish(page, 1, view(1)),
            &|| assert!(hub.save(page, view(1))),
            &|| hub.pause(true),
            &|| hub.stop(),
            &|| hub.wake(),
            &|| hub.leave(page),
        ];
        for (i, change) in changes.into_iter().enumerate() {
            change();
            assert!(is_news(&hub), "{i}");
        }
        assert!(hub.paused() && hub.stops() && !is_news(&hub), "once");
        hub.pause(false);
        assert!(!hub.paused());
    }

    #[test]
    fn who_waits_is_woken_by_what_came_before_and_meanwhile() {
        let hub = Arc::new(Hub::default());
        hub.wake();
        let start = Instant::now();
        hub.wait(Duration::from_secs(60));
        assert!(start.elapsed() < Duration::from_secs(30));
        let start = Instant::now();
        hub.wait(Duration::from_millis(30));
        assert!(start.elapsed() >= Duration::from_millis(30), "once");
        let (waiting, start) = (hub.clone(), Instant::now());
        let waits = std::thread::spawn(move || waiting.wait(Duration::from_secs(60)));
        std::thread::sleep(Duration::from_millis(50));
        hub.wake();
        waits.join().unwrap();
        assert!(start.elapsed() < Duration::from_secs(30));
        hub.set_share(0.25);
        assert_eq!(hub.share(), 0.25);
    }
}
