//! The page of `raygrad view` in installed browsers: headless Chromium and Firefox.
//!
//! `SHOTS=DIR cargo test --test cli browser` saves screenshots of the page.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use super::view::{Server, serve};
use super::{CLASSIC, Place, SMALL, png};
use driver::{Browser, Kind};
use raygrad::nerf::Image;
use raygrad::nerf::imaging::metrics::psnr;
use serde_json::{Value, json};

#[path = "browser/driver.rs"]
mod driver;

/// Decodes an RGBA image that a page returned as bytes.
fn image(bytes: &Value, [width, height]: [usize; 2]) -> Image {
    let rgba = bytes.as_array().unwrap().chunks(4);
    let data = rgba.flat_map(|rgba| rgba[..3].iter().map(|x| x.as_u64().unwrap() as f32 / 255.0));
    Image { width, height, channels: 3, data: data.collect() }
}

#[test]
fn browser_renders_the_scene_and_moves_the_camera() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 300 --out run {SMALL}"));
    let server = serve(&place, "view run");
    Browser::all().for_each(|browser| shows_the_scene(browser, &place, &server));
}

fn shows_the_scene(mut browser: Browser, place: &Place, server: &Server) {
    browser.visit(server);
    let first = browser.picture(place);
    let file = format!("first-{:?}.png", browser.kind);
    place.succeeds(&format!("render run --frames 1 --size {}x{} --out {file}", first.width, first.height));
    let expected = png(&place.path(&file));
    assert!(psnr(&first, &expected) > 40.0, "{}", psnr(&first, &expected));
    browser.shot("first");
    // Every camera control changes the image, and R resets it.
    let pose = |browser: &mut Browser| browser.value("JSON.stringify([view.eye, view.back])");
    let mut seen = vec![pose(&mut browser)];
    let away = "Math.hypot(...view.eye.map((x, i) => x - view.pivot[i]))";
    let far = browser.value(away).as_f64().unwrap();
    let azimuth = "Math.atan2(view.eye[1] - view.pivot[1], view.eye[0] - view.pivot[0])";
    let before = browser.value(azimuth).as_f64().unwrap();
    browser.drag([60.0, 20.0], "left");
    // The scene follows the pointer: the camera moves in the opposite direction.
    let turned = (browser.value(azimuth).as_f64().unwrap() - before).sin();
    assert!(turned < -0.05, "{turned}");
    assert!((browser.value(away).as_f64().unwrap() - far).abs() < 1e-9 * far, "an orbit keeps its distance");
    assert!(browser.value("Math.abs(view.right[2]) < 1e-9") == true, "and the horizon level");
    seen.push(pose(&mut browser));
    browser.drag([-20.0, -10.0], "right");
    seen.push(pose(&mut browser));
    browser.wheel(-200);
    browser.until(&format!("{away} < {}", 0.95 * far));
    seen.push(pose(&mut browser));
    for key in ["ArrowLeft", "ArrowUp", "w", "a", "q", "+"] {
        browser.key(key);
        seen.push(pose(&mut browser));
    }
    for pair in seen.windows(2) {
        assert_ne!(pair[0], pair[1]);
    }
    browser.rested();
    let moved = browser.picture(place);
    assert!(psnr(&moved, &first) < 30.0);
    browser.shot("moved");
    browser.key("r");
    browser.rested();
    // Tiles depend on the available time, so the last bits differ.
    let same = |image: &Image| psnr(image, &first) > 45.0;
    assert!(same(&browser.picture(place)));
    for (key, show) in [("2", "depth"), ("3", "normals"), ("4", "opacity"), ("1", "color")] {
        browser.key(key);
        browser.rested();
        assert_eq!(browser.value("mode()"), show);
        browser.shot(show);
        assert_eq!(same(&browser.picture(place)), show == "color", "{show}");
    }
    // To an image's camera and back.
    browser.key("n");
    browser.rested();
    assert!(browser.value("view.photograph !== null && photo.hidden") == true);
    browser.key("b");
    browser.until("!photo.hidden && photo.style.opacity === '0.5'");
    browser.shot("blended");
    browser.key("5");
    browser.rested();
    assert!(browser.value("document.getElementById('status').textContent.includes('dB')") == true);
    browser.shot("error");
    browser.key("1");
    browser.key("c");
    browser.value("document.getElementById('crop').click()");
    browser.rested();
    browser.until("marks.querySelectorAll('.camera').length >= 10");
    browser.key("r");
    browser.rested();
    browser.shot("box");
    // A face of the box, here the upper one of y, follows the pointer towards the middle.
    let at = "(() => { const box = marks.querySelectorAll('.handle')[3].getBoundingClientRect(); \
              return [box.x + box.width / 2, box.y + box.height / 2]; })()";
    let at = browser.value(at);
    let at = [at[0].as_f64().unwrap(), at[1].as_f64().unwrap()];
    let side = browser.value("box()[1][1]").as_f64().unwrap();
    let inwards = 25.0 * (browser.middle()[0] - at[0]).signum();
    browser.drag_from(at, [inwards, 0.0], "left");
    let moved = browser.value("box()[1][1]").as_f64().unwrap();
    assert!(moved < side - 0.05, "{moved} {side}");
    browser.rested();
    browser.shot("cropped");
    browser.value("document.getElementById('crop').click()");
    // The slider steps through checkpoints. Keys typed in a control do not act as shortcuts.
    let slide = |browser: &mut Browser, to: u32| {
        let id = "document.getElementById('checkpoint')";
        browser.value(&format!("{id}.focus(); {id}.value = {to}; {id}.dispatchEvent(new Event('input'))"));
        browser.rested();
    };
    slide(&mut browser, 0);
    assert_eq!(browser.value("[shown.step, document.getElementById('checkpoint-out').textContent].join()"), "0,step 0");
    browser.key("3");
    browser.key("r");
    assert_eq!(browser.value("mode()"), "color");
    browser.shot("checkpoint");
    slide(&mut browser, 2);
    assert_eq!(browser.value("document.getElementById('checkpoint-out').textContent"), "final model");
    browser.value("document.getElementById('skip').value = 'off'; document.getElementById('skip').dispatchEvent(new Event('change'))");
    browser.rested();
    browser.value("stage.focus()");
    browser.key("r");
    browser.rested();
    assert!(same(&browser.picture(place)), "nothing is left out that shows");
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
}

#[test]
fn browser_saves_images_and_paths() {
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 60 --out run --scene-type unbounded {SMALL} --set sampler.cone=0.1"));
    let server = serve(&place, "view run");
    Browser::all().for_each(|browser| keeps_pictures(browser, &place, &server));
}

fn keeps_pictures(mut browser: Browser, place: &Place, server: &Server) {
    browser.visit(server);
    browser.key("p");
    let saved = png(&browser.kept("view.png"));
    assert!(psnr(&browser.picture(place), &saved) > 35.0);
    // Keyframes at the initial camera and elsewhere; the video starts at the current view.
    browser.key("k");
    browser.drag([60.0, -5.0], "left");
    browser.key("k");
    assert_eq!(browser.value("keys.length"), 2);
    browser.value("document.getElementById('save-path').click()");
    let path = browser.kept("path.json");
    std::fs::copy(path, place.path("path.json")).unwrap();
    // The window's size would take long.
    browser.value("freeSizes = () => [48, 12]; document.getElementById('seconds').value = 0.5; document.getElementById('video').click()");
    browser.until(
        "document.getElementById('video-progress').textContent.endsWith('mp4: done') \
                   || document.getElementById('video-progress').textContent.endsWith('gif: done')",
    );
    assert!(browser.value("document.getElementById('end-video').hidden") == true);
    let video = if browser.kind == Kind::Chromium { 1 } else { 2 };
    let [ours, its] = ["path.json", &format!("run/videos/video-{video}.json")].map(|name| place.json(name));
    let fov = |path: &Value| path["keyframes"][1]["fov"].as_f64().unwrap();
    assert!((fov(&ours) - fov(&its)).abs() < 1e-5 && ours["is_cycle"] == its["is_cycle"]);
    let size = format!("{}x{}", saved.width, saved.height);
    let rendered =
        place.command(&format!("render run --path path.json --frames 2 --size {size} --out video")).output().unwrap();
    // The file names its coordinate transform.
    let said = String::from_utf8_lossy(&rendered.stderr);
    assert!(rendered.status.success() && !said.contains("assuming capture coordinates"), "{said}");
    std::fs::rename(place.path("video"), place.path(&format!("video-{:?}", browser.kind))).unwrap();
    let [from, to] = ["0000", "0001"].map(|name| png(&place.path(&format!("video-{:?}/{name}.png", browser.kind))));
    assert!(psnr(&from, &saved) > 42.0, "{}", psnr(&from, &saved));
    browser.rested();
    let seen = browser.picture(place);
    assert!(psnr(&seen, &to) > 35.0 && psnr(&seen, &from) < psnr(&seen, &to) - 3.0, "{}", psnr(&seen, &to));
    browser.shot("path");
    // The path survives a reload and is restored from its file.
    let there = |browser: &mut Browser, path: &str| {
        browser.value(&format!("JSON.stringify(keys) !== '[]' && size(sub(keys[1].eye, {path}.eye)) + size(sub(keys[1].back, {path}.back)) < 1e-9"))
    };
    let last = browser.value("window.before = true, JSON.stringify(keys[1])");
    browser.reload();
    assert_eq!(browser.value("typeof before + location.hash"), "undefined");
    assert_eq!(there(&mut browser, last.as_str().unwrap()), true);
    browser.value("keys = [], listKeys()");
    let file = json!(std::fs::read_to_string(place.path("path.json")).unwrap());
    browser.value(&format!(
        "(() => {{ const given = new DataTransfer(); given.items.add(new File([{file}], 'path.json')); \
         $('load-path').files = given.files; $('load-path').dispatchEvent(new Event('change')); }})()"
    ));
    browser.until("keys.length === 2 && document.querySelectorAll('#keys li').length === 2");
    assert_eq!(there(&mut browser, last.as_str().unwrap()), true);
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
}

#[test]
fn browser_controls_reach_all_functions() {
    let place = Place::empty();
    place.add_landscape();
    let point = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                 property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0.0 0.0 0.0 10 20 30\n";
    std::fs::write(place.path("around/points.ply"), point).unwrap();
    let mut transforms = place.json("around/transforms.json");
    transforms["ply_file_path"] = json!("points.ply");
    std::fs::write(place.path("around/transforms.json"), transforms.to_string()).unwrap();
    place.succeeds(&format!("train around --steps 60 --out run {SMALL} --set sampler.cone=0.1"));
    let server = serve(&place, "view run");
    Browser::all().for_each(|browser| reaches_everything(browser, &place, &server));
}

fn reaches_everything(mut browser: Browser, place: &Place, server: &Server) {
    browser.visit(server);
    let first = browser.picture(place);
    // Screen readers need an accessible name of each control.
    let unnamed = "[...document.querySelectorAll('input, select, button')].filter((it) => !(it.getAttribute('aria-label') \
                   || (it.labels && [...it.labels].some((label) => label.textContent.trim())) || it.textContent.trim())).map((it) => it.id || it.outerHTML).join()";
    assert_eq!(browser.value(unnamed), "");
    // Images: by name, the next, the previous, wrapping at the end.
    let photograph = "view.photograph";
    let count = browser.number("about.photographs.length");
    let seen = |browser: &mut Browser| browser.value(photograph);
    browser.set("photograph", "3");
    assert_eq!(seen(&mut browser), 3);
    browser.rested();
    assert_eq!(browser.value("[picture.width / picture.height > 1.2, shown.whole].join()"), "true,true");
    browser.click("next");
    assert_eq!(seen(&mut browser), 4);
    browser.click("previous");
    browser.value("stage.focus()");
    browser.key(",");
    assert_eq!(seen(&mut browser), 2);
    browser.key(".");
    assert_eq!(seen(&mut browser), 3);
    browser.set("photograph", "0");
    browser.click("previous");
    assert_eq!(seen(&mut browser), count - 1.0);
    browser.click("next");
    assert_eq!(seen(&mut browser), 0);
    // The image overlay, by the blend setting.
    browser.set("blend", 100);
    browser.until("!photo.hidden && photo.style.opacity === '1' && stage.dataset.photograph === '0'");
    let name = browser.value("about.photographs[0].name").as_str().unwrap().to_owned();
    let file = ["", ".png", ".jpg"].map(|end| place.path(&format!("around/{name}{end}")));
    let file = file.into_iter().find(|path| path.is_file()).unwrap();
    let (shown, truth) = (browser.canvas("photo", place), png(&file));
    let truth = if truth.channels == 4 { truth.over([1.0; 3]) } else { truth };
    assert!(psnr(&shown, &truth) > 28.0, "{}", psnr(&shown, &truth));
    browser.set("blend", 30);
    assert_eq!(
        browser.value("[photo.style.opacity, document.getElementById('blend-out').textContent].join()"),
        "0.3,30 %"
    );
    browser.set("blend", 0);
    assert_eq!(browser.value("photo.hidden"), true);
    browser.set("photograph", "");
    assert_eq!(seen(&mut browser), Value::Null);
    // From a free camera, the nearest image: the last one selected.
    browser.set("photograph", "5");
    browser.value("stage.focus()");
    browser.key("Shift+ArrowLeft");
    assert_eq!(seen(&mut browser), Value::Null);
    browser.set("blend", 50);
    assert_eq!(seen(&mut browser), 5);
    browser.click("reset");
    // The rest tests scripts, which `page_scripts_pass_their_checks` covers in both browsers.
    if browser.kind == Kind::Firefox {
        assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
        return;
    }
    // The field of view, which frees the camera.
    browser.set("fov", 90);
    browser.rested();
    assert_eq!(browser.value("[view.fov, document.getElementById('fov-out').textContent].join()"), "90,90°");
    assert!(psnr(&browser.picture(place), &first) < 30.0);
    browser.click("reset");
    browser.set("size", "400");
    browser.until("shown.size[1] * 2 ** shown.halvings >= 400");
    browser.set("size", "fit");
    browser.rested();
    // The background shows where the crop box leaves nothing.
    browser.set("crop", true);
    for (number, axis) in ["x", "y", "z"].into_iter().enumerate() {
        let lower = browser.number(&format!("about.bounds[0][{number}]"));
        browser.set(&format!("box-{axis}-1"), lower);
    }
    browser.set("background", "#ff8000");
    browser.rested();
    let corner = browser.picture(place).data[..3].to_vec();
    assert!(corner.iter().zip([1.0, 0.5, 0.0]).all(|(a, b)| (a - b).abs() < 0.05), "{corner:?}");
    // The sides of the box keep their order, and each handle moves its own side.
    browser.value("makeBox(); view.fov = 100; settled()");
    for axis in 0..3 {
        for end in 0..2 {
            browser.click("reset");
            // From the side, and from a distance that shows the whole box.
            browser.value(&format!("orbit(0.5, {}), zoom(3), markAll()", if axis == 2 { 0.1 } else { 0.6 }));
            let before = browser.value("box()");
            let at = browser.centre(&format!("marks.querySelectorAll('.handle')[{}]", 2 * axis + end));
            let towards = browser.value(&format!(
                "(() => {{ const middle = times(0.5, add(...box())), far = [...middle]; far[{axis}] = box()[{end}][{axis}]; \
                 const [a, b] = [project(far), project(middle)]; return [b[0] - a[0], b[1] - a[1]]; }})()"
            ));
            let by = [0, 1].map(|i| 0.3 * towards[i].as_f64().unwrap());
            browser.drag_from(at, by, "left");
            let after = browser.value("box()");
            for (other, side) in (0..2).flat_map(|end| (0..3).map(move |axis| (end, axis))) {
                let [was, is] = [&before, &after].map(|sides| sides[other][side].as_f64().unwrap());
                let inwards = if other == 0 { is - was } else { was - is };
                assert!((inwards > 1e-3) == ((other, side) == (end, axis)), "{axis} {end} {other} {side}: {was} {is}");
            }
        }
    }
    browser.set("crop", false);
    browser.click("reset");
    // Markers.
    let marked = |browser: &mut Browser| {
        browser.value(
            "(markAll(), [marks.querySelectorAll('.camera').length, dots.hidden ? 0 : \
             dots.getContext('2d').getImageData(0, 0, dots.width, dots.height).data.some((x) => x > 0) ? 1 : 0].join())",
        )
    };
    assert_eq!(marked(&mut browser), "0,0");
    browser.set("cameras", true);
    assert_eq!(marked(&mut browser), format!("{count},0"));
    browser.set("cameras", false);
    browser.set("points", true);
    browser.value("(place(about.pose, 60), view.eye = add(view.eye, times(2, view.back)))");
    let point = "(markAll(), project(about.points[0][0]))";
    let inside = format!(
        "(() => {{ const at = {point}; return at !== null && at[0] > 0 && at[0] < dots.clientWidth && at[1] > 0 && at[1] < dots.clientHeight; }})()"
    );
    let inside = browser.value(&inside) == true;
    assert_eq!(marked(&mut browser), if inside { "0,1" } else { "0,0" });
    browser.set("points", false);
    // Keyframes can be visited, played and removed; a closed path returns to its start.
    browser.click("reset");
    for turn in ["0", "0.8", "0.8"] {
        browser.value(&format!("orbit({turn}, 0)"));
        browser.click("key");
    }
    let eye = "view.eye.map((x) => x.toFixed(6)).join()";
    let last = browser.value(eye);
    browser.value("document.querySelector('#keys li:nth-child(2) button').click()");
    let second = browser.value(eye);
    assert_ne!(second, last);
    assert_eq!(second, browser.value("keys[1].eye.map((x) => x.toFixed(6)).join()"));
    browser.set("seconds", 0.5);
    browser.click("play");
    browser.until(&format!("{eye} === '{}'", last.as_str().unwrap()));
    // Every camera control ends the playback.
    browser.set("seconds", 600);
    browser.click("play");
    browser.value("new Promise((done) => setTimeout(done, 100))");
    browser.value("stage.focus()");
    browser.key("ArrowLeft");
    let stopped = browser.value(eye);
    browser.value("new Promise((done) => setTimeout(done, 200))");
    assert_eq!(browser.value(eye), stopped);
    let gap = "(() => { const f = flight(100); return size(sub(f[99].eye, f[0].eye)) / size(sub(keys[1].eye, keys[0].eye)); })()";
    let open = browser.number(gap);
    browser.set("closed", true);
    let closed = browser.number(gap);
    assert!(closed < 0.1 && open > 0.5, "{closed} {open}");
    browser.value("document.querySelector('#keys li:nth-child(2) button:last-child').click()");
    assert_eq!(browser.value("[keys.length, document.querySelectorAll('#keys li').length].join()"), "2,2");
    assert_eq!(browser.value("keys[1].eye.map((x) => x.toFixed(6)).join()"), last);
    // The page states the limits of videos, and that a path needs two keyframes.
    browser.set("crop", true);
    browser.value("document.getElementById('box-x-0').value = 1e9");
    browser.click("video");
    browser.until("!$('sorry').hidden && $('sorry').textContent.includes('turn off the crop box')");
    browser.set("crop", false);
    browser.value("document.querySelector('#keys li button:last-child').click()");
    // The message is visible at the end of the controls too.
    browser.value("document.querySelector('aside').scrollTo(0, 1e6)");
    browser.click("play");
    browser.until("$('sorry').textContent.includes('two keyframes')");
    assert!(browser.sees("sorry"));
    // A hidden page is not rendered; rendering resumes when it is visible.
    browser.click("reset");
    browser.rested();
    let hide = |browser: &mut Browser, hidden: bool| {
        browser.value(&format!(
            "Object.defineProperty(document, 'hidden', {{ value: {hidden}, configurable: true }}), \
             document.dispatchEvent(new Event('visibilitychange'))"
        ));
    };
    hide(&mut browser, true);
    let before = browser.value("asked");
    browser.value("orbit(0.3, 0)");
    browser.value("new Promise((done) => setTimeout(done, 200))");
    assert_eq!(browser.value("asked"), before);
    hide(&mut browser, false);
    browser.rested();
    assert_ne!(browser.value("asked"), before);
    browser.shot("controls");
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
}

#[test]
fn browser_reconnects_and_fits_a_phone() {
    let Some(mut browser) = Browser::open(Kind::Chromium) else { return };
    let place = Place::with_scene();
    place.succeeds(&format!("train scene --steps 100 --out run {SMALL}"));
    let server = serve(&place, "view run");
    browser.visit(&server);
    browser.drag([70.0, 0.0], "left");
    let pose = browser.value("JSON.stringify(view.eye)");
    let port = server.address.rsplit(':').next().unwrap().to_owned();
    drop(server);
    browser.until("!document.getElementById('lost').hidden");
    browser.shot("lost");
    // The new server has another token, and the old tab keeps its camera.
    let server = serve(&place, &format!("view run --port {port}"));
    browser.until("document.getElementById('lost').textContent.startsWith('This link does not open the viewer')");
    browser.shot("refused");
    browser.go(&server.link());
    browser.until("document.getElementById('lost').hidden");
    browser.rested();
    assert_eq!(browser.value("JSON.stringify(view.eye)"), pose, "where it was");
    browser.complaints.clear();
    browser.size(390, 440, true);
    browser.visit(&server);
    browser.until("document.documentElement.scrollWidth <= innerWidth");
    let wide = browser.value("stage.getBoundingClientRect().width").as_f64().unwrap();
    assert!((wide - 390.0).abs() < 1.0, "{wide}");
    browser.shot("phone");
    // The scene stays visible while its controls scroll, and so do their messages.
    let stays = "(scrollTo(0, 1e6), (({ top, bottom }) => scrollY > 300 && Math.abs(top) < 1 && bottom < innerHeight)(stage.getBoundingClientRect()))";
    assert_eq!(browser.value(stays), true);
    browser.click("play");
    browser.until("!$('sorry').hidden");
    assert!(browser.sees("sorry"));
    browser.shot("scrolled");
    browser.value("scrollTo(0, 0)");
    // Pinching with two fingers zooms in.
    let away = "Math.hypot(...view.eye.map((x, i) => x - view.pivot[i]))";
    let far = browser.value(away).as_f64().unwrap();
    browser.call("Emulation.setTouchEmulationEnabled", json!({ "enabled": true, "maxTouchPoints": 2 }));
    let touch = |browser: &mut Browser, kind: &str, apart: f64| {
        let points =
            [json!({ "x": 195.0 - apart, "y": 200, "id": 1 }), json!({ "x": 195.0 + apart, "y": 200, "id": 2 })];
        let points = if kind == "touchEnd" { json!([]) } else { json!(points) };
        browser.call("Input.dispatchTouchEvent", json!({ "type": kind, "touchPoints": points }));
    };
    touch(&mut browser, "touchStart", 40.0);
    for apart in [50.0, 60.0, 80.0] {
        touch(&mut browser, "touchMove", apart);
    }
    touch(&mut browser, "touchEnd", 0.0);
    assert!(browser.value(away).as_f64().unwrap() < 0.8 * far);
    let scheme = json!({ "name": "prefers-color-scheme", "value": "dark" });
    browser.call("Emulation.setEmulatedMedia", json!({ "features": [scheme] }));
    browser.rested();
    browser.shot("dark");
    assert_ne!(browser.value("getComputedStyle(document.body).backgroundColor"), "rgb(255, 255, 255)");
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
}

#[test]
fn browser_shows_and_controls_training() {
    let Some(mut browser) = Browser::open(Kind::Chromium) else { return };
    let place = Place::with_scene();
    let mut server = serve(&place, &format!("--threads 1 train scene --steps 1000000 --view --out run {SMALL}"));
    browser.go(&server.link());
    // On a busy machine no complete image arrives before training is paused.
    browser.until("typeof training !== 'undefined' && training !== null && training.step > 20 && shown !== null");
    browser.until("shown.step > 10");
    browser.value("document.getElementById('pause').click()");
    browser.until("training.paused === true && document.getElementById('pause').textContent === 'Resume'");
    let step = browser.value("training.step");
    browser.value("new Promise((done) => setTimeout(done, 900))");
    assert_eq!(browser.value("training.step"), step);
    browser.set("share", 60);
    browser.until("training.share === 0.6");
    assert_eq!(browser.value("document.getElementById('share-out').textContent"), "60 %");
    browser.rested();
    browser.shot("training");
    assert!(browser.value("document.querySelectorAll('.curve path').length") == 3);
    browser.value("document.getElementById('pause').click()");
    browser.until(&format!("training.step > {step}"));
    browser.value("window.confirm = () => true; document.getElementById('stop').click()");
    browser.until("training.ended === 'stopped and saved'");
    browser.shot("ended");
    browser.go("about:blank");
    assert_eq!(server.child.wait().unwrap().code(), Some(0));
    assert!(place.path("run/model.safetensors").exists());
}

/// `PAGES=RUN,RUN cargo test --release --test cli ten_views -- --ignored --nocapture` measures runs, by their whole paths.
#[test]
#[ignore = "measurement: PAGES names the runs to show"]
fn a_page_and_the_program_agree_in_ten_views() {
    let runs = std::env::var("PAGES").expect("PAGES=RUN,RUN names the runs to show");
    let mut browser = Browser::open(Kind::Chromium).expect("Chromium shows the pages");
    browser.size(200, 150, false);
    let place = Place::empty();
    for (number, run) in runs.split(',').enumerate() {
        let page = place.path(&format!("{number}.html"));
        place.succeeds(&format!("export {run} {}", page.display()));
        place.succeeds(&format!("render {run} --path test --size 100x100 --out {number}"));
        let poses = super::view::test_cameras(&place, run);
        let start = Instant::now();
        browser.go(&format!("file://{}", page.display()));
        browser.until("typeof whole !== 'undefined' && status.textContent.includes(' ms')");
        let first = start.elapsed().as_secs_f64();
        browser.until("whole === wanted");
        let mut decibels = vec![];
        let start = Instant::now();
        for (i, camera) in poses.iter().take(10).enumerate() {
            let asked =
                format!("render({}, {}, 100, 100).then((bytes) => Array.from(bytes))", camera["pose"], camera["fov"]);
            let image = image(&browser.value(&asked), [100, 100]);
            decibels.push(psnr(&image, &png(&place.path(&format!("{number}/{i:04}.png")))));
        }
        let seconds = start.elapsed().as_secs_f64() / decibels.len() as f64;
        decibels.sort_by(f64::total_cmp);
        println!(
            "{run}: {:.1} MB, first picture after {first:.1} s, {seconds:.1} s a picture of 100x100; {:.1} to {:.1} dB, {} views",
            std::fs::metadata(&page).unwrap().len() as f64 / 1e6,
            decibels[0],
            decibels[decibels.len() - 1],
            decibels.len()
        );
        assert!(decibels.len() == 10 && decibels[0] > 40.0, "{decibels:?}");
    }
}

/// Tests the camera controls of a scene page, which has no program.
fn moves_about_a_page(browser: &mut Browser) {
    let whole = "!working && whole === wanted";
    let seen = |browser: &mut Browser| {
        browser.until(whole);
        browser.value("[JSON.stringify(rows(view)), picture.toDataURL()]")
    };
    browser.size(24, 18, false);
    browser.until("stage.clientWidth === 24");
    browser.value("stage.focus(), reset()");
    let first = seen(browser);
    let mut before = first.clone();
    let away = browser.number("size(sub(view.eye, view.pivot))");
    browser.drag([8.0, 0.0], "left");
    for key in ["ArrowUp", "w", "+"] {
        let now = seen(browser);
        assert!(now[0] != before[0] && now[1] != before[1], "{key}");
        before = now;
        browser.key(key);
    }
    browser.wheel(-100);
    browser.until(&format!("size(sub(view.eye, view.pivot)) < {}", 0.9 * away));
    browser.key("x");
    browser.key("r");
    assert_eq!(seen(browser), first);
    // The image has the size and the resolution of the window.
    browser.size(32, 24, false);
    browser.until("picture.width === 32 && picture.height === 24 && target.width === 32");
    browser.until(whole);
    browser.size(24, 18, false);
    browser.until("picture.width === 24");
    assert_eq!(seen(browser), first);
}

/// Runs the checks of a page's scripts; they return the failures.
#[track_caller]
fn parts_are_right(browser: &mut Browser, checks: &str) {
    let wrong =
        browser.value(&format!("(async () => {{ {}\n{checks}\nreturn wrong; }})()", include_str!("browser/is.js")));
    let wrong = wrong.as_array().unwrap().iter().map(|line| line.as_str().unwrap()).collect::<Vec<_>>();
    assert!(wrong.is_empty(), "{:?}:\n{}", browser.kind, wrong.join("\n"));
}

#[test]
fn page_scripts_pass_their_checks() {
    let place = Place::with_scene();
    place.succeeds(&format!(
        "train scene --steps 20 --out run {SMALL} --set field.density_width=16 --set field.color_width=16"
    ));
    place.succeeds("export run run.html");
    let server = serve(&place, "view run");
    for mut browser in Browser::all() {
        browser.visit(&server);
        parts_are_right(&mut browser, include_str!("browser/view.js"));
        browser.size(60, 45, false);
        browser.go(&format!("file://{}", place.path("run.html").display()));
        if browser.draws() {
            parts_are_right(&mut browser, include_str!("browser/scene.js"));
        }
        assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    }
}

/// The share of detail in a model file.
fn detail(file: &[u8]) -> f64 {
    let (length, rest) = file.split_first_chunk().unwrap();
    let (head, data) = rest.split_at(u64::from_le_bytes(*length) as usize);
    let head: Value = serde_json::from_slice(head).unwrap();
    let at = head["detail"]["data_offsets"][0].as_u64().unwrap() as usize;
    f64::from_le_bytes(*data[at..].first_chunk().unwrap())
}

/// Scenes that are bounded, unbounded and forward-facing, and one whose training ended before all detail was enabled.
#[test]
fn scene_page_in_browser_equals_render() {
    let place = Place::with_scene();
    place.add_landscape();
    // All cameras look the same way. Their images are wrong, but both renderers must agree.
    let mut transforms = place.json("around/transforms.json");
    let first = transforms["frames"][0]["transform_matrix"].clone();
    for frame in transforms["frames"].as_array_mut().unwrap() {
        for (row, column) in (0..3).flat_map(|row| (0..3).map(move |column| (row, column))) {
            frame["transform_matrix"][row][column] = first[row][column].clone();
        }
    }
    for (name, train) in [
        // Two runs march with uniform steps, like all bounded scenes.
        ("object", "scene --steps 80 --set sampler.cone=0"),
        // Few enough rounds per ray for all browsers, and levels that are not hashed.
        (
            "slight",
            "scene --steps 100 --set field.grid.levels=4 --set field.grid.log2_table=13 --set field.density_width=16 --set field.color_width=16 --set sampler.cone=0",
        ),
        ("landscape", "around --steps 40 --set field.appearance_embedding_dim=2 --refine exposure"),
        ("ahead", "around --steps 40 --scene-type forward-facing"),
    ] {
        if name == "ahead" {
            std::fs::write(place.path("around/transforms.json"), transforms.to_string()).unwrap();
        }
        // The last value of a setting counts.
        place.succeeds(&format!("train {SMALL} --out {name} {train}"));
    }
    let train = format!("train scene --steps 4000 --refine poses --out early {SMALL}");
    let mut child = place.command(&train).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let metrics = place.path("early/metrics.jsonl");
    while std::fs::read_to_string(&metrics).map_or(0, |lines| lines.lines().count()) < 8 {
        std::thread::sleep(Duration::from_millis(20));
    }
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(130));
    place.succeeds(&format!("train scene --steps 1 --out other {CLASSIC}"));
    place.fails("export other other.html", &["other.html", "`instant`", "`classic`"]);
    for name in ["object", "slight", "landscape", "ahead", "early"] {
        let said = place.succeeds(&format!("export {name} {name}.html"));
        let megabytes = std::fs::metadata(place.path(&format!("{name}.html"))).unwrap().len() as f64 / 1e6;
        assert!(said.contains(&format!("{megabytes:.1} MB")), "{said}");
        place.succeeds(&format!("render {name} --frames 2 --size 40x30 --out {name}-seen"));
    }
    for mut browser in Browser::all() {
        let scenes = [("object", 0), ("slight", 0), ("landscape", 1), ("ahead", 2), ("early", 0)];
        // If a software renderer leaves parts out, one scene is enough.
        let kept = |(name, _): &(&str, _)| browser.kind == Kind::Chromium || ["slight", "landscape"].contains(name);
        for (name, kind) in scenes.into_iter().filter(kept).collect::<Vec<_>>() {
            // Software rendering is slow, so the page's own image is small.
            browser.size(8, 6, false);
            let url = format!("file://{}", place.path(&format!("{name}.html")).display());
            browser.go(&url);
            if !browser.draws() {
                break;
            }
            browser.until("typeof whole !== 'undefined' && whole === wanted && whole >= 0");
            assert_eq!(browser.value("data.space.kind"), kind);
            if name == "early" {
                // One of the levels has a weight between 0 and 1.
                let levels = browser.number("data.grid.levels.length");
                let counts = 3.0 + detail(&place.bytes("early/model.safetensors")) * (levels - 3.0);
                assert!(counts > 3.0 && counts < levels && counts.fract() > 0.0, "{counts}");
            }
            browser.shot(&format!("page-{name}"));
            // The initial view and the opposite one. The landscape's images cover only a part of the circle.
            let poses = [(0, "data.view.pose"), (1, "(reset(), orbit(-Math.PI, 0), rows(view))")];
            for (frame, pose) in poses.into_iter().take(if name == "object" { 2 } else { 1 }) {
                let asked = format!("render({pose}, data.view.fov, 40, 30).then((bytes) => Array.from(bytes))");
                let image = image(&browser.value(&asked), [40, 30]);
                let expected = png(&place.path(&format!("{name}-seen/000{frame}.png")));
                let darkest = expected.data.iter().copied().fold(1.0, f32::min);
                assert!(darkest < 0.8, "{name} shows something: {darkest}");
                let alike = psnr(&image, &expected);
                // A software renderer that ends loops early leaves parts out, and the page says so.
                let partial = browser.value("status.textContent.includes('leaves parts')") == true;
                println!("{:?} {name} {frame}: {alike:.1} dB, {partial}", browser.kind);
                assert!(
                    alike > if partial && name != "slight" { 20.0 } else { 40.0 },
                    "{:?} {name} {frame}: {alike}",
                    browser.kind
                );
                assert!(!partial || browser.kind == Kind::Firefox);
            }
            if name == "slight" {
                moves_about_a_page(&mut browser);
            }
        }
        assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    }
}
