use serde_json::json;

use super::*;
use crate::view::networks::Network;
use crate::view::requests::Outbox;
use crate::view::row_tiles::tests::{fog, free};

#[test]
fn expected_rate_is_the_geometric_mean() {
    let rates = [expected(1e5, 4e5), expected(1e5, 1e5), expected(1e5, 1e3), speed(300, Duration::from_millis(20))];
    for (rate, wanted) in rates.into_iter().zip([2e5, 1e5, 1e4, 1.5e4]) {
        assert!((rate / wanted - 1.0).abs() < 1e-12, "{rate} {wanted}");
    }
}

#[test]
fn sync_resting_job_restarts_when_due() {
    let requests = Arc::new(Requests::default());
    let (client, _outbox) = requests.join(Network::LOCAL, 1).unwrap();
    let view = json!({ "eye": { "photograph": 0 }, "size": [800, 800], "show": "color" });
    requests.wish(client, 1, serde_json::from_value(view).unwrap());
    let long_ago = Instant::now().checked_sub(2 * AGAIN).unwrap();
    // Halvings of the next render of a view that was rendered at step 7, if there is one.
    let goes_on = |halvings: u32, when: Instant, spent: Duration, step: u64| {
        let mut renderer = Renderer::new(requests.clone(), None, None);
        renderer.sync(7);
        let job = &mut renderer.jobs[0];
        (job.halvings, job.whole, job.spent) = (halvings, Some((7, when)), spent);
        renderer.sync(step);
        let job = &renderer.jobs[0];
        job.whole.is_none().then_some(job.halvings)
    };
    let none = Duration::ZERO;
    // A paused model gives finer renders up to full size. A changed model gives the size for half a second.
    assert_eq!([3, 1, 0].map(|halvings| goes_on(halvings, long_ago, none, 7)), [Some(2), Some(0), None]);
    assert_eq!([3, 0].map(|halvings| goes_on(halvings, long_ago, none, 8)), [Some(2), Some(2)]);
    // No restart before the interval has passed, nor after a render that took longer than that.
    assert_eq!([7, 8].map(|step| goes_on(3, Instant::now(), none, step)), [None, None]);
    assert_eq!([7, 8].map(|step| goes_on(3, long_ago, 4 * AGAIN, step)), [None, None]);
}

#[test]
fn finer_for_paused_or_fast_models() {
    // A paused model reaches full size. A model in training stops at the size for the interval.
    let all = [(3, true, 5), (1, true, 0), (0, true, 0), (3, false, 2), (3, false, 3), (3, false, 5), (0, false, 0)];
    let expected = [Some(2), Some(0), None, Some(2), None, None, None];
    assert_eq!(all.map(|(halvings, is_still, soon)| finer(halvings, is_still, soon)), expected);
}

/// A renderer with one page that requests this view, and the page's outbox.
fn renderer(view: View) -> (Renderer, u64, Arc<Outbox>) {
    let requests = Arc::new(Requests::default());
    let (client, outbox) = requests.join(Network::LOCAL, 9).unwrap();
    requests.wish(client, 1, view);
    (Renderer::new(requests, None, None), client, outbox)
}

fn text(outbox: &Outbox) -> String {
    match outbox.take() {
        Some(Outgoing::Text(text)) => text,
        other => panic!("{other:?}"),
    }
}

#[test]
fn prepare_limits_large_renders() {
    let (mut renderer, _, _) = renderer(free(0.0, [1100, 1000]));
    for x in 1..5 {
        let (client, _) = renderer.requests.join(Network::LOCAL, 9).unwrap();
        renderer.requests.wish(client, 1, free(f64::from(x), [1100, 1000]));
    }
    renderer.rates.insert((Show::Color, None), 1e12);
    let model = fog();
    renderer.sync(0);
    let begun = |renderer: &mut Renderer| (0..5).map(|i| renderer.prepare(i, &model, 0).is_some()).collect::<Vec<_>>();
    assert_eq!(begun(&mut renderer), [true, true, true, true, false]);
    renderer.jobs[1].begin(0);
    assert!(renderer.prepare(4, &model, 0).is_some() && renderer.prepare(1, &model, 0).is_none());
    // A small render does not count towards the limit.
    let (client, _) = renderer.requests.join(Network::LOCAL, 9).unwrap();
    renderer.requests.wish(client, 1, free(9.0, [1024, 1024]));
    renderer.sync(0);
    assert!(renderer.prepare(5, &model, 0).is_some());
    renderer.clear();
    assert!(renderer.jobs.is_empty());
}

#[test]
fn work_reports_unavailable_views() {
    let model = fog();
    for (change, expected) in [
        (json!({ "compared": true }), "there is no such image, or the run's images are not available"),
        (json!({ "eye": { "photograph": 0 } }), "there is no such image, or the run's images are not available"),
        (json!({ "checkpoint": 3 }), "checkpoints can be shown only after training"),
        (json!({ "skip": "fast" }), "during training, choose skipping `as in training` or `off`"),
        (json!({ "skip": "near-lossless" }), "during training, choose skipping `as in training` or `off`"),
    ] {
        let mut view = json!({ "eye": { "free": { "pose": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4]], "fov": 50 } }, "size": [8, 8] });
        view.as_object_mut().unwrap().extend(change.as_object().unwrap().clone());
        let (mut renderer, _, outbox) = renderer(serde_json::from_value(view).unwrap());
        assert!(!renderer.work(&model, 0));
        let said = text(&outbox);
        assert!(said.contains(expected), "{change}: {said}");
    }
    for skip in [None, Some(Skip::Off)] {
        let (mut renderer, _, outbox) = renderer(View { skip, ..free(0.0, [8, 8]) });
        assert!(renderer.work(&model, 0) && matches!(outbox.take(), Some(Outgoing::Bytes(_))));
    }
}

#[test]
fn delivered_frame_describes_its_render() {
    let model = fog();
    let (mut renderer, _, outbox) = renderer(free(0.0, [48, 36]));
    renderer.rates.insert((Show::Color, None), 1e6);
    while renderer.jobs.first().is_none_or(|job| job.whole.is_none()) {
        assert!(renderer.work(&model, 7));
    }
    let Some(Outgoing::Bytes(bytes)) = outbox.take() else { panic!("no picture") };
    let length = u32::from_le_bytes(bytes[..4].try_into().unwrap()) as usize;
    let head: serde_json::Value = serde_json::from_slice(&bytes[4..4 + length]).unwrap();
    assert_eq!(json!([head["step"], head["halvings"], head["compared"]]), json!([7, 0, null]));
    let now = 48.0 * 36.0 / (1e-3 * head["milliseconds"].as_f64().unwrap());
    let rate = renderer.rates[&(Show::Color, None)];
    assert!((rate / expected(1e6, now) - 1.0).abs() < 1e-9, "{rate} {now}");
}

#[test]
fn save_during_training_is_of_one_step() {
    let (mut renderer, client, outbox) = renderer(free(0.0, [8, 8]));
    renderer.requests.rest(client);
    renderer.requests.save(client, free(0.0, [16, 64]));
    // A rate so low that each tile has one row.
    renderer.rates.insert((Show::Color, None), 1.0);
    assert!(renderer.work(&fog(), 7));
    assert!(matches!(outbox.take(), Some(Outgoing::Bytes(_))));
}

#[test]
fn work_or_wait_without_jobs_waits() {
    let model = fog();
    let (mut renderer, client, _outbox) = renderer(free(0.0, [8, 8]));
    let took = |renderer: &mut Renderer, most: u64| {
        let start = Instant::now();
        renderer.work_or_wait(&model, 0, Duration::from_millis(most));
        start.elapsed()
    };
    assert!(took(&mut renderer, 60_000) < Duration::from_secs(30), "there is");
    renderer.requests.rest(client);
    renderer.requests.wait(Duration::ZERO);
    assert!(took(&mut renderer, 30) >= Duration::from_millis(30));
}

#[test]
fn work_alternates_between_jobs() {
    let requests = Arc::new(Requests::default());
    for number in 0..2 {
        let (client, _outbox) = requests.join(Network::LOCAL, 2).unwrap();
        requests.wish(client, 1, free(f64::from(number), [512, 512]));
    }
    let model = fog();
    let mut renderer = Renderer::new(requests, None, None);
    // A rate so low that the first tile has one row, and no tile is a whole render.
    renderer.rates.insert((Show::Color, None), 1.0);
    let mut turns = vec![];
    for _ in 0..5 {
        assert!(renderer.work(&model, 0));
        turns.push([0, 1].map(|i| renderer.jobs[i].turn));
    }
    // The second job is new after the first tile. It waits for another tile of the first job, then both alternate.
    assert_eq!(turns, [[1, 0], [2, 0], [2, 3], [4, 3], [4, 5]]);
}

#[test]
fn halvings_of_first_render_fit_the_time() {
    for (size, rate) in [([800, 800], 1e5), ([400, 300], 1e6), ([4000, 1000], 3e4)] {
        let times = halvings(size, rate, FIRST);
        let rays = |times: u32| size.map(|side: u32| f64::from(side.div_ceil(1 << times))).iter().product::<f64>();
        assert!(rays(times) <= 1.1 * FIRST * rate || times == MOST_HALVINGS, "{size:?}: {times}");
        assert!(times == 0 || rays(times - 1) > FIRST * rate, "{size:?}: {times}");
    }
    // The smallest render has a few pixels. Fast renders have full size.
    let at_once = |size: [u32; 2], rate: f64| halvings(size, rate, FIRST);
    assert_eq!([at_once([8, 8], 1.0), at_once([3, 3000], 1.0), at_once([640, 480], 1e9)], [1, 0, 0]);
    assert_eq!(at_once([800, 800], 1e5), 4, "640 000 rays are 183 times what 35 ms have");
}
