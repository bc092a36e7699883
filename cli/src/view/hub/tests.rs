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
