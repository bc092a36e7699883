//! A cache of values that are computed in a background thread.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};

use raygrad::nerf::Result;
use raygrad::tensor::parallel::locked;

/// Result of a request to the cache.
pub enum Cached<V> {
    Here(Arc<V>),
    /// This value or another one is being computed.
    Coming,
    /// The computation failed with this message. The next request tries again.
    Failed(String),
}

/// Computes one value at a time and keeps the most recently used ones.
pub struct Cache<K, V>(Arc<Mutex<State<K, V>>>);

struct State<K, V> {
    most: usize,
    /// Most recently used first.
    kept: VecDeque<(K, Arc<V>)>,
    coming: Option<K>,
    failed: Option<(K, String)>,
}

impl<K: Copy + PartialEq + Send + 'static, V: Send + Sync + 'static> Cache<K, V> {
    /// A cache of at most this many values.
    pub fn new(most: usize) -> Self {
        Cache(Arc::new(Mutex::new(State { most, kept: VecDeque::new(), coming: None, failed: None })))
    }

    fn lock(&self) -> MutexGuard<'_, State<K, V>> {
        locked(&self.0)
    }

    /// Returns the value of a key. If it is not cached, starts its computation in a thread, which calls `done` at the
    /// end.
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
                // A panic counts as a failure, so that callers do not wait forever.
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

    /// Like [`get`](Self::get), but computes the value on this thread.
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
    fn cache_full_evicts_the_least_recently_used() {
        let store = Cache::new(2);
        let again = |key| match store.get(key, || panic!("it is here"), || ()) {
            Cached::Here(value) => Some(*value),
            _ => None,
        };
        wait(&store, 1, Ok(10));
        wait(&store, 2, Ok(20));
        assert_eq!(again(1), Some(10));
        // The least recently used value is evicted.
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
