//! What takes long to make, made beside all else, of which a few are kept.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use raygrad::nerf::Result;

/// What comes of asking for something.
pub enum Cached<V> {
    Here(Arc<V>),
    /// It is being made, or something else before it.
    Coming,
    /// Why it cannot be had; who asks again lets it be tried again.
    Failed(String),
}

/// Makes one thing at a time and keeps those that were asked for last.
pub struct Cache<K, V>(Arc<Mutex<State<K, V>>>);

struct State<K, V> {
    most: usize,
    /// What was used last comes first.
    kept: VecDeque<(K, Arc<V>)>,
    coming: Option<K>,
    failed: Option<(K, String)>,
}

impl<K: Copy + PartialEq + Send + 'static, V: Send + Sync + 'static> Cache<K, V> {
    /// One that keeps so many.
    pub fn new(most: usize) -> Self {
        Cache(Arc::new(Mutex::new(State { most, kept: VecDeque::new(), coming: None, failed: None })))
    }

    fn lock(&self) -> MutexGuard<'_, State<K, V>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What is kept under this key; if it is not, it begins to be made on a thread of its own, which calls `done` when it has
    /// ended.
    pub fn get(
        &self,
        key: K,
        make: impl FnOnce() -> Result<V> + Send + 'static,
        done: impl FnOnce() + Send + 'static,
    ) -> Cached<V> {
        let mut state = self.lock();
        if let Some(found) = state.find(key) {
            return Cached::Here(found);
        }
        if let Some((_, what)) = state.failed.take_if(|(own, _)| *own == key) {
            return Cached::Failed(what);
        }
        if state.coming.is_none() {
            state.coming = Some(key);
            let store = Cache(self.0.clone());
            let run = move || {
                // Of a panic it is not waited for either.
                let made = std::panic::catch_unwind(std::panic::AssertUnwindSafe(make));
                let made =
                    made.map_err(|_| "loading failed".to_owned()).and_then(|made| made.map_err(|e| e.to_string()));
                let mut state = store.lock();
                state.coming = None;
                match made {
                    Ok(value) => state.keep(key, Arc::new(value)),
                    Err(what) => state.failed = Some((key, what)),
                }
                drop(state);
                done();
            };
            if let Err(error) = std::thread::Builder::new().name("store".into()).spawn(run) {
                state.coming = None;
                return Cached::Failed(error.to_string());
            }
        }
        Cached::Coming
    }

    /// The same at once, on this thread.
    pub fn get_now(&self, key: K, make: impl FnOnce() -> Result<V>) -> Result<Arc<V>> {
        if let Some(found) = self.lock().find(key) {
            return Ok(found);
        }
        let made = Arc::new(make()?);
        self.lock().keep(key, made.clone());
        Ok(made)
    }
}

impl<K: Copy + PartialEq, V> State<K, V> {
    fn find(&mut self, key: K) -> Option<Arc<V>> {
        let at = self.kept.iter().position(|(own, _)| *own == key)?;
        let entry = self.kept.remove(at)?;
        let found = entry.1.clone();
        self.kept.push_front(entry);
        Some(found)
    }

    fn keep(&mut self, key: K, value: Arc<V>) {
        self.kept.retain(|(own, _)| *own != key);
        self.kept.push_front((key, value));
        self.kept.truncate(self.most);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::Error;
    use std::sync::mpsc::channel;

    fn wait(store: &Cache<u32, u32>, key: u32, made: Result<u32>) {
        let (done, ended) = channel();
        assert!(matches!(store.get(key, || made, move || done.send(()).unwrap()), Cached::Coming));
        ended.recv_timeout(std::time::Duration::from_secs(20)).unwrap();
    }

    #[test]
    fn what_was_used_last_is_kept() {
        let store = Cache::new(2);
        let again = |key| match store.get(key, || panic!("it is here"), || ()) {
            Cached::Here(value) => Some(*value),
            _ => None,
        };
        wait(&store, 1, Ok(10));
        wait(&store, 2, Ok(20));
        assert_eq!(again(1), Some(10));
        // The one that was used longest ago makes room.
        wait(&store, 3, Ok(30));
        assert_eq!([again(1), again(3)], [Some(10), Some(30)]);
        assert_eq!(*store.get_now(1, || panic!("it is here")).unwrap(), 10);
        assert_eq!(*store.get_now(2, || Ok(21)).unwrap(), 21);
        assert_eq!([again(1), again(2)], [Some(10), Some(21)]);
        wait(&store, 3, Ok(31));
    }

    #[test]
    fn cache_makes_one_value_and_tells_an_error_once() {
        let store = Cache::new(2);
        let ((go, waits), (done, ended)) = (channel::<()>(), channel());
        let slow = move || {
            waits.recv().unwrap();
            Ok(1)
        };
        assert!(matches!(store.get(1, slow, move || done.send(()).unwrap()), Cached::Coming));
        for key in [1, 2] {
            assert!(matches!(store.get(key, || panic!("not yet"), || panic!("not yet")), Cached::Coming), "{key}");
        }
        go.send(()).unwrap();
        ended.recv().unwrap();
        assert!(matches!(store.get(1, || panic!("it is here"), || ()), Cached::Here(_)));
        wait(&store, 2, Err(Error::setting("photograph", "is damaged")));
        assert!(
            matches!(store.get(2, || panic!("it has failed"), || ()), Cached::Failed(what) if what.contains("damaged"))
        );
        wait(&store, 2, Ok(5));
        assert!(matches!(store.get(2, || panic!("it is here"), || ()), Cached::Here(value) if *value == 5));
        let (done, ended) = channel();
        assert!(matches!(store.get(3, || panic!("on purpose"), move || done.send(()).unwrap()), Cached::Coming));
        ended.recv().unwrap();
        assert!(matches!(store.get(3, || Ok(3), || ()), Cached::Failed(_)));
    }
}
