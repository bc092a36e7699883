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

fn shot(halvings: u32) -> RenderedFrame {
    RenderedFrame { made: Made { halvings, milliseconds: 1.0, compared: None, step: 0 }, jpeg: vec![halvings as u8] }
}

/// The last byte of the next render that is sent.
fn sent(outbox: &Outbox) -> Option<u8> {
    match outbox.take()? {
        Outgoing::Bytes(bytes) => bytes.last().copied(),
        Outgoing::Text(text) => panic!("{text}"),
    }
}

#[test]
fn pages_share_a_request_and_get_the_newest() {
    let requests = Requests::default();
    let ([a, b], [from_a, from_b]) = {
        let [(a, out), (b, other)] =
            [requests.join(Network::LOCAL, 9), requests.join(Network::LOCAL, 9)].map(Option::unwrap);
        ([a, b], [out, other])
    };
    assert_eq!(requests.connected(), 2);
    requests.wish(a, 1, view(1));
    requests.wish(b, 9, view(1));
    let wishes = requests.wishes();
    assert!(wishes.len() == 1 && requests.wants(&wishes[0]));
    requests.show(&wishes[0], shot(2));
    assert_eq!([sent(&from_a), sent(&from_b)], [Some(2); 2]);
    // The next render is sent after the acknowledgement, and it is the newest one.
    requests.show(&wishes[0], shot(1));
    requests.show(&wishes[0], shot(0));
    assert_eq!(sent(&from_a), None);
    from_a.seen(7);
    assert_eq!(sent(&from_a), None, "that was another");
    from_a.seen(1);
    assert_eq!([sent(&from_a), sent(&from_a)], [Some(0), None]);
    // A later page gets the existing render at once.
    let (c, from_c) = requests.join(Network::LOCAL, 9).unwrap();
    requests.wish(c, 3, view(1));
    assert_eq!(sent(&from_c), Some(0));
    requests.leave(c);
    // A waiting render of an old request is dropped.
    requests.wish(b, 10, view(2));
    from_b.seen(9);
    assert_eq!(sent(&from_b), None);
    assert_eq!(requests.wishes().len(), 2);
    requests.wish(a, 2, view(2));
    assert!(!requests.wants(&wishes[0]) && requests.wishes().len() == 1);
    requests.refuse(&wishes[0], "nobody wants it");
    assert_eq!(from_a.take(), None);
    requests.refuse(&requests.wishes()[0], "it is lost");
    assert!(requests.wishes().is_empty());
    assert!(matches!(from_a.take(), Some(Outgoing::Text(text)) if text.contains("it is lost")));
    requests.wish(a, 3, view(2));
    requests.wish(b, 11, view(2));
    assert!(requests.is_here(a) && requests.is_here(b) && !requests.is_here(c));
    requests.rest(a);
    assert_eq!(requests.wishes().len(), 1, "that of the other");
    requests.leave(a);
    requests.leave(b);
    assert!(requests.wishes().is_empty() && requests.connected() == 0);
}

#[test]
fn page_of_a_crowded_network_gives_way() {
    let requests = Requests::default();
    let [crowd, other] = ["10.0.0.1", "10.0.0.2"].map(|ip| Network::of(ip.parse().unwrap()));
    let join = |network| requests.join(network, 3);
    let first: Vec<_> = (0..3).map(|_| join(crowd).unwrap()).collect();
    assert!(join(crowd).is_none(), "no network replaces its own");
    let closed = || first.iter().map(|(_, outbox)| outbox.closing().is_some()).collect::<Vec<_>>();
    let _second = join(other).unwrap();
    assert_eq!((requests.connected(), closed()), (3, vec![false, false, true]));
    assert!(!requests.is_here(first[2].0));
    // Two pages and one: neither gives way any more.
    assert!(join(other).is_none() && join(crowd).is_none());
    assert_eq!(closed(), [false, false, true]);
    // The end of a closed page changes nothing.
    requests.leave(first[2].0);
    assert_eq!(requests.connected(), 3);
}

#[test]
fn outbox_over_the_limit_is_overrun() {
    let requests = Requests::default();
    let (page, outbox) = requests.join(Network::LOCAL, 9).unwrap();
    assert!((0..SAVES).all(|i| requests.save(page, view(i))) && !requests.save(page, view(9)));
    let (other, _) = requests.join(Network::LOCAL, 2).unwrap();
    assert!(requests.join(Network::LOCAL, 2).is_none());
    assert!(requests.save(other, view(0)), "each its own");
    requests.leave(page);
    assert!(requests.next_save().is_some_and(|save| save.client == other) && requests.next_save().is_none());
    // Saves keep their order. Rendered but unsent saves count towards the limit.
    let (third, files) = requests.join(Network::LOCAL, 9).unwrap();
    requests.save(third, view(1));
    requests.save(third, view(2));
    let numbers = [(); 2].map(|()| requests.next_save().unwrap().view.eye);
    assert_eq!(numbers, [1, 2].map(Eye::Photograph));
    (0..SAVES).for_each(|_| files.post(Outgoing::Bytes(vec![])));
    assert!(!requests.save(third, view(3)));
    files.take();
    assert!(requests.save(third, view(3)) && files.files() == SAVES - 1);
    // Only the newest state of training is sent.
    requests.tell_state("one");
    requests.tell_state("two");
    while files.files() > 0 {
        files.take();
    }
    assert_eq!([files.take(), files.take()], [Some(Outgoing::Text("two".to_owned())), None]);
    for _ in 0..WAITING {
        outbox.post(Outgoing::Text(String::new()));
    }
    assert!(outbox.closing().is_none());
    // The overrun is permanent, and excess messages are dropped.
    for _ in 0..2 {
        outbox.post(Outgoing::Bytes(vec![]));
        assert!(outbox.closing().is_some() && outbox.files() == 0);
    }
    assert_eq!(std::iter::from_fn(|| outbox.take()).count(), WAITING);
    outbox.post(Outgoing::Text(String::new()));
    assert!(outbox.closing().is_some() && outbox.take().is_none());
}

#[test]
fn render_of_old_request_is_dropped() {
    let requests = Requests::default();
    let (page, outbox) = requests.join(Network::LOCAL, 9).unwrap();
    let wish = |id: u32| {
        requests.wish(page, id, view(1));
        let wish = requests.wishes().pop().unwrap();
        requests.show(&wish, shot(1));
        wish
    };
    // One render is unacknowledged, and another one waits.
    wish(1);
    assert_eq!(sent(&outbox), Some(1));
    wish(2);
    requests.rest(page);
    outbox.seen(1);
    assert_eq!(sent(&outbox), None, "nothing is looked at");
    requests.refuse(&wish(3), "it is lost");
    assert_eq!(outbox.take(), Some(sorry("it is lost")));
    assert_eq!(outbox.take(), None);
    // The send time is known until the acknowledgement.
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
fn outbox_notifies_of_each_message() {
    let requests = Requests::default();
    let (page, outbox) = requests.join(Network::LOCAL, 9).unwrap();
    let is_woken = || outbox.changed.notified().now_or_never().is_some();
    assert!(!is_woken());
    requests.wish(page, 1, view(1));
    let shows = || requests.show(&requests.wishes()[0], shot(0));
    let changes: [&dyn Fn(); 6] = [
        &|| outbox.post(sorry("it is lost")),
        &|| requests.post(page, sorry("it is lost")),
        &|| requests.tell(&sorry("it is lost")),
        &|| requests.tell_state("now"),
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
fn messages_reach_their_pages_only() {
    let requests = Requests::default();
    let [(a, from_a), (b, from_b)] =
        [requests.join(Network::LOCAL, 9), requests.join(Network::LOCAL, 9)].map(Option::unwrap);
    assert_ne!(a, b);
    let say = |text: &str| Outgoing::Text(text.to_owned());
    requests.post(a, say("one"));
    requests.post(7, say("nobody"));
    requests.tell(&say("all"));
    let heard = |outbox: &Outbox| std::iter::from_fn(|| outbox.take()).collect::<Vec<_>>();
    assert_eq!([heard(&from_a), heard(&from_b)], [vec![say("one"), say("all")], vec![say("all")]]);
    assert_eq!(requests.about(), "");
    requests.introduce("a scene".to_owned());
    assert_eq!(requests.about(), "a scene");
}

/// Returns true if something has changed since the last call.
fn is_news(requests: &Requests) -> bool {
    std::mem::take(&mut requests.lock().news)
}

#[test]
fn renderer_is_woken_by_every_change() {
    let requests = Requests::default();
    let (page, _outbox) = requests.join(Network::LOCAL, 9).unwrap();
    assert!(!requests.paused() && !requests.stops() && !is_news(&requests));
    let changes: [&dyn Fn(); 6] = [
        &|| requests.wish(page, 1, view(1)),
        &|| assert!(requests.save(page, view(1))),
        &|| requests.pause(true),
        &|| requests.stop(),
        &|| requests.wake(),
        &|| requests.leave(page),
    ];
    for (i, change) in changes.into_iter().enumerate() {
        change();
        assert!(is_news(&requests), "{i}");
    }
    assert!(requests.paused() && requests.stops() && !is_news(&requests), "once");
    requests.pause(false);
    assert!(!requests.paused());
}

#[test]
fn waiter_is_woken_by_earlier_and_later_changes() {
    let requests = Arc::new(Requests::default());
    requests.wake();
    let start = Instant::now();
    requests.wait(Duration::from_secs(60));
    assert!(start.elapsed() < Duration::from_secs(30));
    let start = Instant::now();
    requests.wait(Duration::from_millis(30));
    assert!(start.elapsed() >= Duration::from_millis(30), "once");
    let (waiting, start) = (requests.clone(), Instant::now());
    let waits = std::thread::spawn(move || waiting.wait(Duration::from_secs(60)));
    std::thread::sleep(Duration::from_millis(50));
    requests.wake();
    waits.join().unwrap();
    assert!(start.elapsed() < Duration::from_secs(30));
    requests.set_share(0.25);
    assert_eq!(requests.share(), 0.25);
}
