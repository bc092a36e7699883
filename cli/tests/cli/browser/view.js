// Unit tests of the page of `raygrad view`, with expected values by hand. The connection is closed first.
socket.onclose = socket.onmessage = null;
socket.close();
const real = { ask, say, orbit, pan, zoom, fly, draw, overlay, keep };
const S = Math.SQRT1_2;
/** Replaced timers, which tests run themselves. */
const timers = [];
let room = { x: 0, y: 0, width: 400, height: 200 };
fixed(stage, "getBoundingClientRect", () => room);
fixed(window, "devicePixelRatio", 1);
fixed(performance, "now", () => clock);
fixed(window, "setTimeout", (run, after) => timers.push({ run, after }));
say = (message) => { calls.push(message); };
ask = () => { calls.push("ask"); };

// ---- fake scene -------------------------------------------------------------------------------------------------------
/** Poses at a position that look along +y. The images differ in direction and aspect ratio. */
const along = ([x, y, z]) => [[1, 0, 0, x], [0, 0, -1, y], [0, 1, 0, z]];
const photographs = () => [
  { name: "a", split: "test", pose: along([0, -4, 0]), fov: 40, size: [200, 100], centre: [0.5, 0.5] },
  { name: "b", split: "train", pose: [[0, 0, 1, 4], [1, 0, 0, 0], [0, 1, 0, 0]], fov: 60, size: [100, 200], centre: [0.25, 0.75] },
  { name: "c", split: "train", pose: along([0, -4, 1]), fov: 150, size: [400, 100], centre: [0.5, 0.5] },
  { name: "d", split: "val", pose: [[-1, 0, 0, 0], [0, 0, 1, -4], [0, 1, 0, 0]], fov: 2, size: [100, 100], centre: [0.5, 0.5] },
];
const scene = (changes) => ({
  tell: "about", title: "fake", bounds: [[-1, -2, -3], [1, 2, 5]], photographs: photographs(), checkpoints: [100, 200], training: false,
  background: [1, 0.5, 0], pose: along([0, -9, 0]), fov: 50, proportion: 1, points: [[[0, 4, 0], [10, 20, 30]], [[0, -5, 0], [1, 2, 3]]],
  to_capture: [[0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3]], ...changes,
});
const eye = () => [view.eye, view.pivot];
const axes = () => [view.right, view.up, view.back];
/** Sets the camera at the origin, looking along +y. */
const ahead = () => Object.assign(view, { eye: [0, 0, 0], right: [1, 0, 0], up: [0, 0, 1], back: [0, -1, 0], fov: 90, pivot: [0, 4, 0], photograph: null });
const text = (id) => $(id).textContent;
const set = (id, value) => { $(id)[typeof value === "boolean" ? "checked" : "value"] = value; };

// ---- description of the scene -------------------------------------------------------------------------------------------
about = null;
keys = [1];
meet(scene());
is("reset", [rows(view), view.fov, view.pivot, view.photograph], [along([0, -9, 0]), 50, [0, 0, 1], null]);
is("names", [document.title, text("title")], ["fake - raygrad", "fake"]);
is("keys", keys, []);
const chosen = [...$("photograph").options].map((option) => [option.value, option.textContent, option.parentElement.label]);
is("photographs", chosen, [["", "-", undefined], ["1", "b", "training"], ["2", "c", "training"], ["3", "d", "validation"], ["0", "a", "test"]]);
is("background", $("background").value, "#ff8000");
const offered = () => ["photographs", "training", "checkpoints"].map((id) => $(id).hidden).concat([...$("skip").options].map((o) => o.disabled), $("video").disabled,
  document.querySelector("input[value=error]").disabled, $("checkpoint").max, $("checkpoint").value);
is("offered", offered(), [false, true, false, false, false, false, false, false, false, "2", "2"]);
is("sliders of the box", [...$("box").querySelectorAll("input")].map((i) => [i.id, i.min, i.max, i.value, i.getAttribute("aria-label")]), [
  ["box-x-0", "-1", "1", "-1", "lower x"], ["box-x-1", "-1", "1", "1", "upper x"], ["box-y-0", "-2", "2", "-2", "lower y"],
  ["box-y-1", "-2", "2", "2", "upper y"], ["box-z-0", "-3", "5", "-3", "lower z"], ["box-z-1", "-3", "5", "5", "upper z"]]);
// A second description keeps the user's choices.
ahead();
view.photograph = 2;
set("checkpoint", 0);
keys = [1, 2];
overlaid = requested = 2;
meet(scene({ training: true, background: [0, 0, 0], checkpoints: [50, 100, 200] }));
is("again", [view.eye, view.photograph, $("photograph").value, keys, $("background").value, overlaid, requested], [[0, 0, 0], 2, "2", [1, 2], "#ff8000", null, null]);
is("offered in training", offered(), [false, false, false, false, false, true, true, true, false, "3", "1"]);
set("checkpoint", 3);
meet(scene({ training: true, checkpoints: [50, 100, 200, 300] }));
is("the end stays the end", $("checkpoint").value, "4");
view.photograph = 3;
meet(scene({ photographs: photographs().slice(0, 3) }));
is("a photograph that is gone", view.photograph, null);
keys = [1, 2];
set("checkpoint", 0);
meet(scene({ photographs: [], checkpoints: [], bounds: [[-1, -2, -3], [1, 2, 3]] }));
is("elsewhere", [keys, view.eye, offered()], [[], [0, -9, 0], [true, true, true, false, false, false, false, false, true, "0", "0"]]);
meet(scene({ title: "other" }));
meet(scene());
keys = [];
told({ tell: "taken", photographs: photographs().slice(0, 1) });
is("taken", about.photographs.length, 1);
about = null;
told({ tell: "taken", photographs: [] });
is("taken before", about, null);
told(scene({ bounds: [[-1, -2, -3], [1, 2, 3]] }));
is("side", side(), 6);
called();

// ---- vectors and camera -------------------------------------------------------------------------------------------------
is("turned", [turned([1, 0, 2], [0, 0, 1], Math.PI / 2), turned([0, 1, 0], [1, 0, 0], Math.PI / 2)], [[0, 1, 2], [0, 0, 1]]);
is("vectors", [cross([1, 2, 3], [4, 5, 7]), dot([1, 2, 3], [4, 5, 7]), size([2, 3, 6]), unit([0, 0, 0]), clamp(3, 0, 2)], [[-1, 5, -3], 35, 7, [0, 0, 0], 2]);
is("fitting", [fitting(90, 1, 2), fitting(90, 4, 1), fitting(60, 3, 2), fitting(0.1, 1, 1), fitting(90, 1, 0 / 0)], [90, 120, 81.78678929826181, 1, 90]);
place([[1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12]], 33);
is("place", [view.right, view.up, view.back, view.eye, view.fov, rows(view)[1]], [[1, 5, 9], [2, 6, 10], [3, 7, 11], [4, 8, 12], 33, [5, 6, 7, 8]]);
const [s5, c5, s3, c3] = [Math.sin(0.5), Math.cos(0.5), Math.sin(0.3), Math.cos(0.3)];
ahead();
const turn = playing;
orbit(0.5, 0);
is("orbit aside", [...eye(), ...axes()], [[-4 * s5, 4 - 4 * c5, 0], [0, 4, 0], [c5, -s5, 0], [0, 0, 1], [-s5, -c5, 0]]);
is("orbit ends playing and asks", [playing - turn, called()], [1, ["ask"]]);
ahead();
orbit(0, 0.3);
is("orbit upwards", [...eye(), ...axes()], [[0, 4 - 4 * c3, 4 * s3], [0, 4, 0], [1, 0, 0], [0, s3, c3], [0, -c3, s3]]);
for (const [by, end] of [[5, 1.5], [-9, -1.5]]) {
  ahead();
  orbit(0, by);
  is("orbit to a pole", view.eye, [0, 4 - 4 * Math.cos(end), 4 * Math.sin(end)]);
  orbit(0, 0);
  is("and stays", view.eye, [0, 4 - 4 * Math.cos(end), 4 * Math.sin(end)]);
}
for (const by of [0.3, 2]) {
  ahead();
  [view.right, view.up] = [[-1, 0, 0], [0, 0, -1]];
  orbit(0, by);
  is("orbit upside down", view.eye, [0, 4 - 4 * Math.cos(by), -4 * Math.sin(by)]);
}
// A tilted camera is levelled by the first orbit, unless it looks almost straight down.
ahead();
[view.right, view.up] = [[0, 0, -1], [1, 0, 0]];
orbit(0.5, 0);
is("orbit of a picture on its side", [...eye(), ...axes()], [[-4 * s5, 4 - 4 * c5, 0], [0, 4, 0], [c5, -s5, 0], [0, 0, 1], [-s5, -c5, 0]]);
const below = (tilt, dy) => {
  const [s, c] = [Math.sin(tilt), Math.cos(tilt)];
  Object.assign(view, { eye: [0, 0, 4], right: [c, 0, -s], up: [0, 1, 0], back: [s, 0, c], pivot: [0, 0, 0] });
  orbit(0, dy);
  return [view.eye, ...axes()];
};
const [s4, c4, sine, cosine] = [Math.sin(0.04), Math.cos(0.04), Math.sin(0.06), Math.cos(0.06)];
is("from above", [below(0.04, 0), below(0, 0.2)], [[[0, 0, 4], [c4, 0, -s4], [0, 1, 0], [s4, 0, c4]], [[0, 0, 4], [1, 0, 0], [0, 1, 0], [0, 0, 1]]]);
is("from nearly above", below(0.06, 0), [[0, 0, 4], [0, 1, 0], [-cosine, 0, sine], [sine, 0, cosine]]);
is("and away from there", below(0, -0.2)[0], [0, -4 * Math.sin(0.2), 4 * Math.cos(0.2)]);
const beyond = (dy) => {
  Object.assign(view, { eye: [0, 0, 4], right: [1, 0, 0], up: [0, Math.cos(0.02), Math.sin(0.02)], back: [0, -Math.sin(0.02), Math.cos(0.02)], pivot: [0, 0, 0] });
  orbit(0, dy);
  return view.back;
};
is("beyond where orbits end", [beyond(0), beyond(0.3), beyond(-0.2)], [0.02, 0.02, 0.22].map((tilt) => [0, -Math.sin(tilt), Math.cos(tilt)]));
const moves = [
  ["pan", () => pan(0.1, 0.2), [-0.8, 0, 1.6], [-0.8, 4, 1.6]],
  ["zoom", () => zoom(0.5), [0, 2, 0], [0, 4, 0]],
  ["zoom in to the end", () => zoom(1e-9), [0, 4 - 4e-9, 0], [0, 4.12 - 4e-9, 0]],
  ["zoom in further", () => { view.pivot = [0, 0.12, 0]; zoom(0.5); }, [0, 0.06, 0], [0, 0.18, 0]],
  ["zoom in from the pivot", () => { view.pivot = [0, 0, 0]; zoom(0.5); }, [0, 0, 0], [0, 0.12, 0]],
  ["zoom out from near", () => { view.pivot = [0, 0.06, 0]; zoom(1.5); }, [0, -0.03, 0], [0, 0.09, 0]],
  ["zoom out to the end", () => zoom(1e9), [0, -596, 0], [0, 4, 0]],
  ["fly", () => fly(1, 2, 4), [1, 4, 2], [1, 8, 2]],
  ["fly when near", () => { view.pivot = [0, 0.1, 0]; fly(1, 2, 4); }, [0.3, 1.2, 0.6], [0.3, 1.3, 0.6]],
];
for (const [name, move, to, pivot] of moves) {
  ahead();
  const turn = playing;
  called();
  move();
  is(name, [...eye(), playing - turn, called()], [to, pivot, 1, ["ask"]]);
}

// ---- pointers and keys --------------------------------------------------------------------------------------------------
for (const name of ["orbit", "pan", "zoom", "fly"]) window[name] = (...numbers) => { calls.push([name, ...numbers]); };
fixed(stage, "setPointerCapture", () => {});
const pointer = (kind, pointerId, x, y, more) => {
  stage.dispatchEvent(new PointerEvent(`pointer${kind}`, { pointerId, clientX: x, clientY: y, buttons: 1, bubbles: true, ...more }));
  return called();
};
is("a pointer that is not down", pointer("move", 7, 5, 5), []);
pointer("down", 7, 100, 100);
is("drag", pointer("move", 7, 110, 120), [["orbit", 0.15, 0.3]]);
is("drag on", pointer("move", 7, 110, 130), [["orbit", 0, 0.15]]);
is("right drag", pointer("move", 7, 120, 150, { buttons: 2 }), [["pan", 0.05, 0.1]]);
is("middle drag", pointer("move", 7, 130, 150, { buttons: 4 }), [["pan", 0.05, 0]]);
is("drag with Shift", pointer("move", 7, 130, 160, { shiftKey: true }), [["pan", 0, 0.05]]);
pointer("down", 8, 230, 160);
is("two fingers", pointer("move", 8, 330, 160), [["zoom", 0.5], ["pan", 0.25, 0]]);
is("on each other", pointer("move", 8, 133, 160), [["pan", -0.4925, 0]]);
pointer("down", 9, 0, 0);
is("three fingers", pointer("move", 8, 230, 160), []);
pointer("up", 9);
pointer("up", 7);
is("the one that is left", pointer("move", 8, 250, 160), [["orbit", 0.3, 0]]);
pointer("cancel", 8);
is("none is left", pointer("move", 8, 250, 160), []);
const wheel = (deltaY, deltaMode) => {
  const event = new WheelEvent("wheel", { deltaY, deltaMode, cancelable: true });
  stage.dispatchEvent(event);
  return [...called(), event.defaultPrevented];
};
const by = (x) => [["zoom", Math.exp(x)], true];
is("wheel", [wheel(100, 0), wheel(-2, 1), wheel(0.5, 2), wheel(900, 0), wheel(-900, 0)], [by(0.15), by(-0.09), by(0.225), by(0.45), by(-0.45)]);
const menu = new Event("contextmenu", { cancelable: true });
stage.dispatchEvent(menu);
is("no menu", menu.defaultPrevented, true);
const press = (key, more, where = stage) => {
  const event = new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true, ...more });
  where.dispatchEvent(event);
  return [...called(), event.defaultPrevented];
};
const step = 0.12, held = { shiftKey: true };
const steered = [
  ["ArrowLeft", ["orbit", -step, 0]], ["ArrowRight", ["orbit", step, 0]], ["ArrowUp", ["orbit", 0, -step]], ["ArrowDown", ["orbit", 0, step]],
  ["w", ["fly", 0, 0, 0.2]], ["s", ["fly", 0, 0, -0.2]], ["a", ["fly", -0.2, 0, 0]], ["D", ["fly", 0.2, 0, 0]], ["e", ["fly", 0, 0.2, 0]],
  ["q", ["fly", 0, -0.2, 0]], ["+", ["zoom", 0.9]], ["=", ["zoom", 0.9]], ["-", ["zoom", 1 / 0.9]],
];
for (const [key, call] of steered) is(key, [press(key), press(key, { repeat: true }), press(key, { ctrlKey: true }), press(key, {}, $("fov"))], [[call, true], [call, true], [false], [false]]);
is("arrows with Shift", [press("ArrowLeft", held), press("ArrowDown", held)], [[["pan", -0.3 * step, 0], true], [["pan", 0, 0.3 * step], true]]);
is("keys that mean nothing", [press("x"), press("0"), press("6"), press("Enter")], [[false], [false], [false], [false]]);
for (const [i, name] of ["color", "depth", "normals", "opacity", "error", "color"].entries()) {
  is(name, [press(String((i % 5) + 1)), mode()], [["ask", true], name]);
}
is("the cameras", [press("c"), $("cameras").checked, press("c", { repeat: true }), $("cameras").checked, press("c"), $("cameras").checked], [[true], true, [false], true, [true], false]);
is("the same with Alt or Meta", [press("c", { altKey: true }), press("c", { metaKey: true })], [[false], [false]]);
const ids = [["r", "reset"], ["p", "save"], ["n", "nearest"], [",", "previous"], [".", "next"], ["K", "key"]];
for (const [key, id] of ids) {
  let clicks = 0;
  const count = () => { clicks += 1; };
  $(id).addEventListener("click", count);
  press(key);
  $(id).removeEventListener("click", count);
  is(`a button's key, ${key}`, clicks, 1);
}
Object.assign(window, real);
ask = () => { calls.push("ask"); };
say = (message) => { calls.push(message); };
keys = [];
listKeys();

// ---- images -----------------------------------------------------------------------------------------------------------------
const state = () => [view.eye, view.pivot, view.fov, view.photograph, $("photograph").value, $("fov").value, text("fov-out")];
document.querySelector("input[value=error]").disabled = true;
is("no error without photographs", [press("5"), mode()], [[true], "color"]);
document.querySelector("input[value=error]").disabled = false;
goTo(1);
is("a photograph", state(), [[4, 0, 0], [0, 0, 0], 60, 1, "1", "60", "60°"]);
goTo(2);
is("a wide one", state(), [[0, -4, 1], [0, 0, 1], 120, 2, "2", "120", "120°"]);
goTo(3);
is("one that looks away", state(), [[0, -4, 0], [0, -4.3, 0], 5, 3, "3", "5", "5°"]);
const before = state(), playedTo = playing;
goTo(4);
is("none", [state(), playing], [before, playedTo]);
goTo(0);
is("playing ends", playing, playedTo + 1);
const from = (at, back) => { Object.assign(view, { eye: at, back, photograph: null }); return nearest(); };
is("nearest", [from([0, -4, 0.4], [0, -1, 0]), from([0, -4, 0.6], [0, -1, 0]), from([-0.5, -4, 0], [1, 0, 0]), from([0, -4, 0], [0, 1, 0])], [0, 2, 1, 3]);
const [s6, c6] = [Math.sin(0.6), Math.cos(0.6)];
about.photographs = [[[1, 0, 0, 0], [0, 0, 1, -4], [0, 1, 0, 0]], [[1, 0, s6, 2.16], [0, 0, -c6, -3.6], [0, 1, 0, 0]]].map((pose) => ({ pose }));
is("nearest by the sum", from([0, -3.6, 0], [0, -1, 0]), 1);
about.photographs = photographs();
view.photograph = null;
const step1 = (id) => { $(id).click(); return view.photograph; };
view.eye = [4, 0.1, 0];
view.back = [1, 0, 0];
is("next, previous", [step1("next"), step1("next"), step1("next"), step1("next"), step1("previous"), step1("previous")], [1, 2, 3, 0, 3, 2]);
view.photograph = null;
is("the nearest first", step1("previous"), 2);
view.eye = [4, 0.1, 0];
view.back = [1, 0, 0];
is("the nearest", step1("nearest"), 1);
called();
// Blending moves to the nearest image, requests it once, and shows it when it arrives.
const dot20 = document.createElement("canvas");
[dot20.width, dot20.height] = [20, 10];
const blob = await new Promise((done) => dot20.toBlob(done));
free();
set("blend", 40);
blend();
is("blend", [view.photograph, text("blend-out"), photo.hidden, called()], [1, "40 %", true, [{ ask: "photograph", number: 1 }, "ask"]]);
blend();
is("asked for once", called(), []);
await overlay(1, blob);
is("comes", [photo.hidden, photo.style.opacity, photo.width, photo.height, overlaid, requested, stage.dataset.photograph], [false, "0.4", 20, 10, 1, null, "1"]);
set("blend", 0);
blend();
is("no blend", [photo.hidden, called()], [true, []]);
set("blend", 100);
goTo(2);
is("another", [photo.hidden, called()], [true, [{ ask: "photograph", number: 2 }, "ask"]]);
await overlay(1, blob);
is("one that is not wanted any more", [photo.hidden, called()], [true, [{ ask: "photograph", number: 2 }]]);
await overlay(2, new Blob(["none"]));
is("none", [requested, text("sorry"), $("sorry").hidden], [null, "The browser cannot decode the image.", false]);
free();
is("free", [view.photograph, $("photograph").value, $("blend").value, text("blend-out")], [null, "", "0", "0 %"]);
set("blend", 40);
set("fov", 70);
room = { x: 0, y: 0, width: 100, height: 200 };
reset();
const tall = (2 * Math.atan(2 * Math.tan(25 * radians))) / radians;
is("reset in a tall window", [view.fov, view.pivot, $("fov").value, text("fov-out"), $("blend").value, photo.hidden], [tall, [0, 0, 0], "86", "86°", "0", true]);
// A camera at the centre has its pivot ahead, and zooms towards it.
const begins = (height) => { about.pose = along([0, 0, height]); reset(); return view.pivot; };
is("reset in the middle", [begins(0.31), begins(-0.29), (zoom(0.5), view.eye)], [[0, 0, 0], [0, 3, -0.29], [0, 1.5, -0.29]]);
$("fov").value = 30;
goTo(1);
$("fov").value = 31;
$("fov").dispatchEvent(new Event("input"));
is("another lens", [view.fov, view.photograph, text("fov-out")], [31, null, "31°"]);
set("checkpoint", 1);
settled();
is("a checkpoint", text("checkpoint-out"), "step 200");
set("checkpoint", 2);
settled();
is("the end", text("checkpoint-out"), "final model");
room = { x: 0, y: 0, width: 400, height: 200 };

// ---- sizes ------------------------------------------------------------------------------------------------------------------
const sized = (high, photograph, width = 400, height = 200) => {
  set("size", high);
  view.photograph = photograph;
  room = { x: 0, y: 0, width, height };
  return sizes();
};
is("sizes", [sized("fit", null), sized("fit", 1), sized("fit", 2), sized("800", null), sized("800", 1)], [[400, 200], [100, 200], [400, 100], [1600, 800], [400, 800]]);
is("limits", [sized("fit", null, 8000, 2000), sized("fit", null, 4, 2), sized("fit", null, 2, 8), sized("fit", null, 401, 199.7), sized("fit", null, 80000, 1000), sized("fit", null, 10, 9000)],
  [[4096, 1024], [16, 8], [8, 8], [399, 199], [4096, 228], [8, 4096]]);
fixed(window, "devicePixelRatio", 1.25);
is("finer displays", [sized("fit", null), sized("fit", 2), sized("800", null)], [[500, 250], [500, 125], [1600, 800]]);
fixed(window, "devicePixelRatio", 3);
is("the finest", [sized("fit", null), sized("fit", 2)], [[600, 300], [600, 150]]);
fixed(window, "devicePixelRatio", 1);
sized("1080", 1);
is("of key frames", [freeSizes(), view.photograph, (sized("fit", 1), freeSizes())], [[1920, 960], 1, [400, 200]]);
is("even sides", evenly([7, 33.2, 101, 99]), [16, 34, 102, 100]);
view.photograph = null;
shown = null;
is("the frame before a picture", frame(), { x: 0, y: 0, w: 400, h: 200 });
shown = { size: [50, 50] };
is("a square", frame(), { x: 100, y: 0, w: 200, h: 200 });
room = { x: 0, y: 0, width: 401, height: 199 };
shown = { size: [51, 25], halvings: 3 };
is("a coarse one fills what the whole one will", frame(), { x: 0, y: 0, w: 401, h: 199 });
shown = { size: [100, 50], halvings: 2 };
is("one of another window", frame(), { x: 1.5, y: 0, w: 398, h: 199 });
room = { x: 0, y: 0, width: 400, height: 200 };
shown = { size: [800, 200] };
layout();
is("a band", [frame(), ...[picture, photo].map(({ style }) => [style.left, style.top, style.width, style.height])], [{ x: 0, y: 50, w: 400, h: 100 }, ["0px", "50px", "400px", "100px"], ["0px", "50px", "400px", "100px"]]);

// ---- requests ---------------------------------------------------------------------------------------------------------------
ahead();
set("own-background", false);
const free90 = { free: { pose: along([0, 0, 0]), fov: 90 } };
is("wanted", wanted(), { eye: free90, size: [400, 200], show: "color" });
goTo(1);
set("skip", "fast");
set("checkpoint", 0);
set("own-background", true);
set("background", "#0a80ff");
document.querySelector("input[value=depth]").checked = true;
is("more is wanted", wanted(), { eye: { photograph: 1 }, size: [100, 200], show: "depth", skip: "fast", checkpoint: 100, background: [10, 128, 255] });
document.querySelector("input[value=error]").checked = true;
set("skip", "");
set("checkpoint", 2);
set("own-background", false);
set("crop", true);
set("box-y-1", 0.5);
set("box-z-0", -1.5);
is("a box, and the error", wanted(), { eye: { photograph: 1 }, size: [100, 200], compared: true, crop: [[-1e9, -1e9, -1.5], [1e9, 0.5, 1e9]] });
document.querySelector("input[value=color]").checked = true;
called();
$("save").click();
is("to save", called(), [{ ask: "save", view: wanted() }]);
set("crop", false);
const change = (id, name) => { $(id).dispatchEvent(new Event(name)); return called(); };
is("controls ask", [change("skip", "change"), change("size", "change"), change("own-background", "change")], [["ask"], ["ask"], ["ask"]]);
set("crop", true);
is("a box asks", [change("crop", "change"), $("box").hidden, change("box-x-0", "input")], [["ask"], false, ["ask"]]);
is("a box has a command", [$("box-export").hidden, $("box-command").textContent],
  [false, "raygrad export RUN mesh.glb --bounds scene:-1,-2,-1.5,1,0.5,3"]);
set("crop", false);
is("and goes", [change("crop", "change"), $("box").hidden, $("box-export").hidden], [["ask"], true, true]);
is("a background asks", [change("background", "input"), $("own-background").checked], [["ask"], true]);
set("own-background", false);
$("pause").click();
training = { paused: true };
$("pause").click();
set("share", 45);
is("training", [called(), change("share", "input")], [[{ ask: "pause", pause: true }, { ask: "pause", pause: false }], [{ ask: "share", share: 0.45 }]]);
window.confirm = () => false;
$("stop").click();
is("not stopped", called(), []);
window.confirm = () => true;
$("stop").click();
$("end-video").click();
is("stopped", called(), [{ ask: "stop" }, { ask: "end-video" }]);

// ---- request rate -------------------------------------------------------------------------------------------------------------
ask = real.ask;
timers.length = 0;
ahead();
[waits, unseen, again, asked, clock] = [false, null, false, 4294967294, 5000];
ask();
ask();
is("once a frame", [timers.length, timers[0].after, waits, called()], [1, 16, true, []]);
timers.pop().run();
is("asked", [called(), waits, unseen, again, asked], [[{ ask: "view", id: 4294967295, view: wanted() }], false, 5000, false, 4294967295]);
clock = 5999;
ask();
is("waits for a picture", [timers.length, again], [0, true]);
clock = 6000;
ask();
is("not longer", timers.length, 1);
timers.pop().run();
is("numbers go round", [asked, unseen, again], [0, 6000, false]);
called();
answered();
is("nothing has moved", [timers.length, unseen], [0, null]);
[unseen, again] = [6000, true];
answered();
is("something has", [timers.length, unseen], [1, null]);
timers.pop().run();
called();
const hidden = (is) => { fixed(document, "hidden", is); document.dispatchEvent(new Event("visibilitychange")); };
hidden(true);
is("hidden", [called(), unseen], [[{ ask: "rest" }], null]);
ask();
is("asks for nothing", timers.length, 0);
fixed(document, "hidden", false);
ask();
fixed(document, "hidden", true);
timers.pop().run();
is("hidden in between", [called(), waits, unseen], [[], false, null]);
hidden(false);
is("seen", [timers.length, called()], [1, []]);
timers.pop().run();
ask = () => { calls.push("ask"); };

// ---- received messages --------------------------------------------------------------------------------------------------------
const message = (head, bytes) => {
  const words = new TextEncoder().encode(JSON.stringify(head));
  const all = new Uint8Array(4 + words.length + bytes.length);
  new DataView(all.buffer).setUint32(0, words.length, true);
  all.set(words, 4);
  all.set(bytes, 4 + words.length);
  return all.buffer;
};
for (const name of ["draw", "overlay", "keep"]) window[name] = (...given) => { calls.push([name, ...given.map((x) => (x instanceof Blob ? [x.size, x.type] : x))]); };
[asked, unseen, again] = [8, 1, false];
called();
brought(message({ file: "picture", id: 7 }, [1, 2, 3]));
is("an older picture", [called(), unseen], [[{ ask: "seen", id: 7 }, ["draw", { file: "picture", id: 7 }, [3, "image/jpeg"]]], 1]);
brought(message({ file: "picture", id: 8 }, [1, 2]));
is("the newest", [called().length, unseen], [2, null]);
brought(message({ file: "save", name: "n.png" }, [1]));
brought(message({ file: "photograph", number: 3 }, [1, 2, 3, 4]));
is("files", called(), [["keep", [1, "image/png"], "n.png"], ["overlay", 3, [4, "image/jpeg"]]]);
Object.assign(window, { draw: real.draw, overlay: real.overlay, keep: real.keep });
timers.length = 0;
[requested, unseen, again] = [3, 1, true];
told({ tell: "sorry", what: "It cannot." });
is("sorry", [text("sorry"), $("sorry").hidden, timers.map((t) => t.after), requested, unseen, called()], ["It cannot.", false, [8000], null, null, ["ask"]]);
timers.pop().run();
is("for a while", $("sorry").hidden, true);
again = false;
told({ tell: "video", file: "f.mp4", words: "3 of 9", ended: false });
is("a video", [text("video-progress"), $("video-progress").hidden, $("end-video").hidden], ["f.mp4: 3 of 9", false, false]);
told({ tell: "video", file: "f.mp4", words: "done", ended: true });
is("its end", [text("video-progress"), $("end-video").hidden], ["f.mp4: done", true]);
// The newest render stays, whichever is decoded first.
const coming = [];
fixed(window, "createImageBitmap", () => new Promise((done) => coming.push(done)));
const bitmap = (width, height) => { const canvas = document.createElement("canvas"); [canvas.width, canvas.height] = [width, height]; canvas.close = () => {}; return canvas; };
const head = (id, more) => ({ id, halvings: 0, milliseconds: 12.6, step: 0, ...more });
const drawn = [draw(head(1), null), draw(head(2, { halvings: 2 }), null), draw(head(3, { milliseconds: 3.2 }), null), draw(head(4), null)];
coming[1](bitmap(20, 10));
await drawn[1];
is("a coarse one", [text("status"), shown.id, shown.whole, shown.size, picture.width, picture.height], ["20×10 (coarse) · 13 ms", 2, false, [20, 10], 20, 10]);
is("and its data", [stage.dataset.shown, stage.dataset.halvings, stage.dataset.step], ["2", "2", "0"]);
coming[0](bitmap(40, 10));
await drawn[0];
is("an older one", [shown.id, picture.width], [2, 20]);
coming[3](null);
coming[2](bitmap(30, 15));
await Promise.all(drawn);
is("the next, and one that is none", [text("status"), shown.id, shown.whole, picture.style.width], ["30×15 · 3 ms", 3, true, "400px"]);
const status = async (more) => { const done = draw(head(9, more), null); coming.pop()(bitmap(30, 15)); await done; return text("status"); };
is("compared", [await status({ compared: [1, 31.456, true] }), await status({ compared: [0, 31.456, false] }), await status({ compared: [2, null, false], step: 7 })], ["30×15 · 13 ms · against b: 31.46 dB", "30×15 · 13 ms · against a: about 31.46 dB", "30×15 · 13 ms · against c: - dB · step 7"]);
about.training = true;
is("in training", await status({}), "30×15 · 13 ms · step 0");
about.training = false;

// ---- overlays -------------------------------------------------------------------------------------------------------------------
ahead();
area = { x: 10, y: 5, w: 200, h: 100 };
is("project", [project([1, 2, 0.5]), project([0, -1, 0]), project([0, 0.005, 0]), project([0, 0.007, 0])], [[135, 42.5], null, null, [110, 55]]);
view.fov = (2 * Math.atan(0.5)) / radians;
is("project through a longer lens", [project([1, 2, 0.5]), project([0, 1, 0.1])], [[160, 30], [110, 45]]);
view.fov = 90;
view.photograph = 1;
is("off the middle", project([1, 2, 0.5]), [85, 67.5]);
view.photograph = null;
is("depth", depthOf([5, 3, 1]), 3);
is("lines", [path([[0, 2, 0], [1, 2, 0]]), path([[0, 2, 0], null, [1, 2, 0]]), path([[0, -2, 0], [1, -2, 0]]), path([[0, 2, 0], [0, 2, 1], [1, 2, 0]])],
  ["M110.0 55.0L135.0 55.0", "", "", "M110.0 55.0L110.0 30.0M110.0 30.0L135.0 55.0"]);
const least = 1.01e-3 * 6, edge = `${(110 + (50 * 2 * (2 - least)) / 4 / least).toFixed(1)} ${(55 - (50 * (2 - least)) / 4 / least).toFixed(1)}`;
is("lines that end behind", [path([[0, 2, 0], [2, -2, 1]]), path([[2, -2, 1], [0, 2, 0]])], [`M110.0 55.0L${edge}`, `M${edge}L110.0 55.0`]);
const [left, right, over, under] = ["83.5", "136.5", "41.8", "68.2"], middle = "110.0 55.0";
const lines = [[`${left} ${under}`, `${right} ${under}`], [`${right} ${under}`, `${right} ${over}`], [`${right} ${over}`, `${left} ${over}`], [`${left} ${over}`, `${left} ${under}`],
  [`${left} ${under}`, middle], [middle, `${right} ${under}`], [`${right} ${over}`, middle], [middle, `${left} ${over}`]].map(([a, b]) => `M${a}L${b}`).join("");
const seen = { pose: along([0, 1, 0]), fov: 90, size: [200, 100] };
is("a camera", frustum(seen), lines);
const wide = 0.36 * Math.tan(60 * radians);
is("a wide camera", frustum({ ...seen, fov: 170, size: [100, 100] }).split("L")[0], `M${(110 - (50 * wide) / 1.36).toFixed(1)} ${(55 + (50 * wide) / 1.36).toFixed(1)}`);
shown = { size: [400, 200] };
const marked = (name) => [...marks.querySelectorAll(name)].map((mark) => mark.getAttribute("class"));
const dotted = (x, y) => [...dots.getContext("2d").getImageData(x, y, 1, 1).data];
set("cameras", true);
set("points", true);
markAll();
is("marks", marked(".camera"), ["camera test", "camera train", "camera train", "camera val"]);
const opaque = dots.getContext("2d").getImageData(0, 0, 400, 200).data.reduce((sum, x, i) => sum + (i % 4 === 3 ? x : 0), 0);
is("a point of two", [dots.hidden, dots.width, dots.height, dotted(200, 100)], [false, 400, 200, [10, 20, 30, 255]]);
is("three pixels wide", opaque / 255, 9, 1.5);
is("pointers go through", getComputedStyle(dots).pointerEvents, "none");
fixed(window, "devicePixelRatio", 3);
markAll();
is("on a finer display", [dots.width, dots.height, dotted(400, 200)], [800, 400, [10, 20, 30, 255]]);
fixed(window, "devicePixelRatio", 1);
is("where", marks.querySelectorAll(".camera")[1].getAttribute("d"), frustum(about.photographs[1]));
view.photograph = 1;
markAll();
is("but not its own", marked(".camera"), ["camera test", "camera train", "camera val"]);
document.querySelector("input[value=error]").checked = true;
markAll();
const ofError = marked("path").length;
view.photograph = null;
markAll();
is("none over the error of another place", [ofError, marks.children.length, dots.hidden], [3, 0, true]);
document.querySelector("input[value=color]").checked = true;
set("cameras", false);
set("points", false);
markAll();
is("no points", dots.hidden, true);
set("crop", true);
set("box-x-0", -1), set("box-x-1", 0), set("box-y-0", 1), set("box-y-1", 2), set("box-z-0", -1), set("box-z-1", 3);
is("the box", box(), [[-1, 1, -1], [0, 2, 3]]);
markAll();
const found = [...marks.querySelectorAll(".box")].map((line) => line.getAttribute("d"));
const line = (a, b) => path([a, b]);
is("its edges", found.sort(), [
  line([-1, 1, -1], [0, 1, -1]), line([-1, 2, -1], [0, 2, -1]), line([-1, 1, 3], [0, 1, 3]), line([-1, 2, 3], [0, 2, 3]),
  line([-1, 1, -1], [-1, 2, -1]), line([0, 1, -1], [0, 2, -1]), line([-1, 1, 3], [-1, 2, 3]), line([0, 1, 3], [0, 2, 3]),
  line([-1, 1, -1], [-1, 1, 3]), line([0, 1, -1], [0, 1, 3]), line([-1, 2, -1], [-1, 2, 3]), line([0, 2, -1], [0, 2, 3])].sort());
const handles = [...marks.querySelectorAll(".handle")].map((mark) => [Number(mark.getAttribute("cx")), Number(mark.getAttribute("cy"))]);
is("its handles", handles, [[-1, 1.5, 1], [0, 1.5, 1], [-0.5, 1, 1], [-0.5, 2, 1], [-0.5, 1.5, -1], [-0.5, 1.5, 3]].map(project));
const grip = (axis, end, [x, y]) => {
  const handle = marks.querySelectorAll(".handle")[2 * axis + end];
  handle.dispatchEvent(new PointerEvent("pointerdown", { pointerId: 5, clientX: 50, clientY: 50, bubbles: true, cancelable: true }));
  dispatchEvent(new PointerEvent("pointermove", { clientX: 50 + x, clientY: 50 + y }));
  dispatchEvent(new PointerEvent("pointerup", {}));
  dispatchEvent(new PointerEvent("pointermove", { clientX: 300, clientY: 300 }));
  return box()[end][axis];
};
// At a depth of 1.5 and a focal length of 100 pixels, a unit spans 66.7 pixels.
is("moves a side", [grip(0, 1, [20, 7]), grip(0, 0, [-0.1, 0]), grip(2, 1, [5, 20]), grip(0, 0, [500, 0])], [0.3, -1, 2.7, 0.3], 1e-6);
const drag = (id, value) => { set(id, value); $(id).dispatchEvent(new Event("input")); return Number($(id).value); };
is("sides do not change places", [drag("box-y-0", 2), drag("box-y-0", 1), drag("box-y-1", -1), drag("box-y-1", 2)], [2, 1, 1, 2]);
const grips = (coarse) => { fixed(window, "matchMedia", (words) => ({ matches: coarse && words === "(pointer: coarse)" })); markAll(); return marks.querySelector(".handle").getAttribute("r"); };
is("for fingers, and a mouse", [grips(true), grips(false)], ["16", "7"]);
is("and the camera not", [view.eye, view.photograph], [[0, 0, 0], null]);
set("crop", false);

// ---- paths ------------------------------------------------------------------------------------------------------------------------
const key = (at, more) => ({ eye: at, right: [1, 0, 0], up: [0, 0, 1], back: [0, -1, 0], fov: 90, pivot: [at[0], 9, 0], ...more });
const eyes = (count, axis) => flight(count).map((frame) => frame.eye[axis]);
set("closed", false);
keys = [key([0, 0, 0]), key([2, 0, 0], { back: [1, 0, 0], fov: (2 * Math.atan(0.25)) / radians })];
is("between two", [eyes(5, 0), flight(1)[0].eye], [[0, 0.5, 1, 1.5, 2], [0, 0, 0]]);
is("half way", flight(3)[1], { eye: [1, 0, 0], back: [S, -S, 0], right: [S, S, 0], up: [0, 0, 1], fov: (2 * Math.atan(0.5)) / radians, pivot: [1, 9, 0] });
keys = [key([0, 0, 0]), key([1, 1, 0]), key([2, 0, 0])];
is("a spline", [eyes(5, 0), eyes(5, 1), eyes(9, 1)[1]], [[0, 0.5, 1, 1.5, 2], [0, 0.625, 1, 0.625, 0], 0.296875]);
markAll();
is("is marked", marked(".path"), ["path"]);
is("where it goes", marks.querySelector(".path").getAttribute("d"), path(flight(64).map((frame) => frame.eye)));
set("closed", true);
is("closed", [eyes(3, 0), eyes(6, 0)[5], eyes(6, 1)[5], eyes(6, 0)[1], eyes(6, 1)[1]], [[0, 1, 2], 1, -0.125, 0.3125, 0.5625]);
const lasts = (value) => { set("seconds", value); return duration(); };
is("seconds", [lasts(""), lasts("0"), lasts("0.1"), lasts("1000"), lasts("7")], [4, 4, 0.5, 600, 7]);
is("in the capture", inCapture(key([1, 2, 3])), [0, 0, 1, -3, 1, 0, 0, 4, 0, 1, 0, 9, 0, 0, 0, 1]);
room = { x: 0, y: 0, width: 401, height: 199 };
goTo(1);
const written = {
  coordinates: "capture", keyframes: keys.map((key) => ({ matrix: inCapture(key), fov: 90 })), camera_type: "perspective", render_width: 402, render_height: 200,
  is_cycle: true, seconds: 7, fps: 25, smoothness_value: 0, camera_path: [],
};
is("a path", cameraPath(), written);
called();
free();
set("skip", "near-lossless");
makeVideo();
is("a video is asked for", called(), [{ ask: "video", path: written, show: "color", skip: "near-lossless", background: undefined }]);
const sorry = (change, back) => { change(); $("sorry").textContent = ""; makeVideo(); back(); return [text("sorry"), called()]; };
const whole = "A video shows the final model: turn off the crop box, the checkpoint and the error.";
is("with a box", sorry(() => set("crop", true), () => set("crop", false)), [whole, []]);
is("of a checkpoint", sorry(() => set("checkpoint", 0), () => set("checkpoint", 2)), [whole, []]);
is("of the error", sorry(() => { document.querySelector("input[value=error]").checked = true; }, () => { document.querySelector("input[value=color]").checked = true; }), [whole, []]);
const three = keys;
is("of many", sorry(() => { keys = Array.from({ length: 400 }, () => key([0.1, 1 / 3, 0])); }, () => { keys = three; }), ["Too many keyframes for the viewer: save the path and use raygrad render.", []]);
is("of one", sorry(() => { keys = three.slice(0, 1); }, () => { keys = three; }), ["A path needs two keyframes.", []]);
// A saved path loads again, with pivots straight ahead. An invalid path changes nothing.
const given = [key([0, -4, 0]), key([3, -5, 1], { right: [S, S, 0], back: [S, -S, 0], fov: 33 }), key([1, 1, 0.1], { right: [0.6, 0, 0.8], up: [-0.8, 0, 0.6] })];
const back = [[0, 0, 0], [-1, -1, 1], [1, 1.3, 0.1]].map((pivot, i) => ({ ...given[i], pivot }));
keys = given;
set("closed", true), set("seconds", "7.5");
const kept = JSON.stringify(cameraPath());
const load = async (words) => { $("sorry").textContent = ""; await loadPath(new File([words], "f.json")); return [keys, $("closed").checked, $("seconds").value, text("sorry")]; };
keys = [], set("closed", false), set("seconds", "2");
is("loaded", [await load(kept), $("keys").children.length], [[back, true, "7.5", ""], 3]);
const spoilt = (change) => { const path = JSON.parse(kept); change(path); return JSON.stringify(path); };
const bad = {
  text: "none", null: "null", number: "3", list: "[]", empty: spoilt((p) => { p.keyframes = []; }), elsewhere: spoilt((p) => { p.coordinates = "scene"; }),
  fov: spoilt((p) => { p.keyframes[1].fov = 130; }), noFov: spoilt((p) => { delete p.keyframes[1].fov; }), noKey: spoilt((p) => { p.keyframes[2] = null; }),
  short: spoilt((p) => { p.keyframes[0].matrix.pop(); }), word: spoilt((p) => { p.keyframes[0].matrix[3] = "1"; }), far: spoilt((p) => { p.keyframes[0].matrix[3] = 1e10; }),
  stretched: spoilt((p) => { p.keyframes[0].matrix = p.keyframes[0].matrix.map((x) => 1.1 * x); }), mirrored: spoilt((p) => { for (const i of [0, 4, 8]) p.keyframes[0].matrix[i] *= -1; }),
  many: spoilt((p) => { p.keyframes = Array.from({ length: 1001 }, () => ({ fov: 50, matrix: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1] })); }), long: kept + " ".repeat(1e6),
};
for (const [name, words] of Object.entries(bad)) is(`not loaded, ${name}`, await load(words), [back, true, "7.5", "f.json is not a path saved by this viewer (limits: 1000 keyframes, 1 MB)."]);
is("as many as may be", (await load(spoilt((p) => { p.keyframes = Array.from({ length: 1000 }, () => p.keyframes[0]); })))[0].length, 1000);
is("half of it is left out", (await load(spoilt((p) => { delete p.seconds; delete p.is_cycle; }))).slice(1), [false, "7.5", ""]);
const loader = loadPath;
loadPath = (file) => { calls.push(file.name); };
const carried = new DataTransfer();
carried.items.add(new File(["x"], "g.json"));
called();
$("load-path").files = carried.files;
$("load-path").dispatchEvent(new Event("change"));
is("by its button", [called(), $("load-path").files.length], [["g.json"], 0]);
$("load-path").dispatchEvent(new Event("change"));
is("none is chosen", called(), []);
loadPath = loader;
// A path survives a reload of the page and belongs to its scene.
const reload = (changes) => { about = null; meet(scene({ bounds: [[-1, -2, -3], [1, 2, 3]], ...changes })); return keys; };
set("closed", true);
$("closed").dispatchEvent(new Event("change"));
keys = given;
listKeys();
set("closed", false);
is("loaded again", [reload(), $("closed").checked, reload({ title: "other" }), reload({ bounds: [[-1, -2, -3], [1, 2, 4]] }), reload()], [back, true, [], [], back]);
set("seconds", "3");
$("seconds").dispatchEvent(new Event("change"));
set("seconds", "9");
is("with its time", [reload().length, $("seconds").value], [3, "3"]);
sessionStorage.setItem(pathName(), "{");
is("what was spoilt", reload(), []);
keys = given;
listKeys();
const storage = Object.getOwnPropertyDescriptor(window, "sessionStorage");
Object.defineProperty(window, "sessionStorage", { get() { throw new Error("no"); }, configurable: true });
is("nothing is kept", [(listKeys(), keys.length), reload()], [3, []]);
if (storage) Object.defineProperty(window, "sessionStorage", storage); else delete window.sessionStorage;
keys = [];
listKeys();
is("nor of no key frame", [sessionStorage.getItem(pathName()), reload()], [null, []]);
ahead();
set("closed", true), set("seconds", "7");
keys = three;
called();
listKeys();
is("buttons", [...$("keys").querySelectorAll("button")].map((b) => [b.textContent, b.getAttribute("aria-label")]).slice(2, 4), [["go to", "Go to keyframe 2"], ["remove", "Remove keyframe 2"]]);
$("keys").querySelectorAll("button")[2].click();
is("gone to", view.eye, [1, 1, 0]);
view.eye[0] = 5;
is("keys stay", keys[1].eye, [1, 1, 0]);
$("keys").querySelectorAll("button")[3].click();
is("removed", [keys.map((key) => key.eye[0]), $("keys").children.length], [[0, 2], 2]);
$("key").click();
is("added", [keys.length, keys[2], $("keys").children.length], [3, snapshot(), 3]);
is("of its own", keys[2].eye === view.eye, false);
// Playback, one display frame at a time.
let next = null;
const frames = window.requestAnimationFrame;
fixed(window, "requestAnimationFrame", (run) => { next = run; });
set("closed", false);
set("seconds", "2");
keys = [key([0, 0, 0]), key([2, 0, 0])];
marking = true;
clock = 3000;
play();
const at = (now) => { const run = next; next = null; run(now); return [view.eye[0], next !== null]; };
is("played", [at(3000), at(3500), at(4000)], [[0, true], [(2 * 30) / 119, true], [(2 * 60) / 119, true]]);
is("to its end", [at(5000), called().every((what) => what === "ask")], [[2, false], true]);
play();
at(3500);
view.eye = [7, 0, 0];
free();
is("ended by whatever moves", at(4000), [7, false]);
fixed(window, "requestAnimationFrame", frames);
marking = false;

// ---- training -----------------------------------------------------------------------------------------------------------------------
for (const id of ["curve-loss", "curve-psnr", "curve-speed"]) fixed($(id), "clientWidth", 104);
const going = { step: 12, loss: 0.012345, psnr: 21.456, left: "3 min", paused: false, share: 0.35, ended: null, curves: { loss: [0, 1, 10, -3, 100], psnr: [null, 20, 30], speed: [1500.4] } };
const curves = () => ["loss", "psnr", "speed"].map((name) => [...$(`curve-${name}`).children].map((e) => e.getAttribute("d") || e.textContent));
document.activeElement.blur();
follow(going);
is("training", [text("progress"), text("pause"), $("share").value, text("share-out"), $("stop").disabled], ["step 12 · loss 0.0123 · PSNR 21.46 dB · 3 min of training left", "Pause", "35", "35 %", false]);
is("curves", curves(), [["M2.0 50.0L52.0 34.0L102.0 18.0", "loss 100.0"], ["M2.0 50.0L102.0 18.0", "PSNR 30.00"], ["M2.0 50.0", "rays/s 1,500"]]);
$("training").hidden = false;
$("share").focus();
follow({ ...going, loss: null, psnr: null, paused: true, share: 0.5, curves: { loss: [2, 2], psnr: [], speed: [1, 999.96] } });
is("paused", [text("progress"), text("pause"), $("share").value, text("share-out")], ["step 12 · loss - · PSNR - dB · paused", "Resume", "35", "50 %"]);
is("few points", curves(), [["M2.0 50.0L102.0 50.0", "loss 2.000"], [], ["M2.0 50.0L102.0 18.0", "rays/s 1000"]]);
told({ tell: "training", ...going, ended: "stopped" });
is("ended", [text("progress"), ["pause", "stop", "share"].map((id) => $(id).disabled)], ["stopped after 12 steps", [true, true, true]]);

// ---- connection ---------------------------------------------------------------------------------------------------------------------
const made = [];
fixed(window, "WebSocket", class { static OPEN = 1; constructor(address) { made.push(String(address)); this.readyState = 0; } send(words) { calls.push(words); } });
say = real.say;
timers.length = 0;
training = null;
$("lost").hidden = true;
called();
connect();
is("an address", [made, socket.binaryType], [[`ws://${location.host}/messages?token=${token}`], "arraybuffer"]);
is("the token of the link is hidden", [token.length, location.hash], [32, ""]);
/** What the server says of the token; null if it does not respond. */
let verdict = 204;
const fetched = [], cleared = [];
fixed(window, "clearTimeout", (timer) => cleared.push(timer));
fixed(window, "fetch", async (address) => { fetched.push(String(address)); if (!verdict) throw Error(); return { status: verdict }; });
say({ ask: "rest" });
is("nothing is said before", called(), []);
socket.readyState = 1;
say({ ask: "rest" });
is("said", called(), ['{"ask":"rest"}']);
const lost = async (reason) => { await socket.onclose({ reason }); return [text("lost"), $("lost").hidden, timers.pop()]; };
const [words, covers, timer] = await lost("");
is("lost", [words, covers, timer.after], ["raygrad does not respond. Reconnecting…", false, 500]);
is("why", (await lost("stalled"))[0], "raygrad closed the connection: stalled. Reconnecting…");
is("asks why unless told", fetched, [`http://${location.host}/access?token=${token}`]);
verdict = null;
const seldom = [];
for (let count = 0; count < 4; count++) seldom.push((await lost(""))[2].after);
is("more and more seldom", seldom, [2000, 4000, 5000, 5000]);
verdict = 403;
is("refused", (await lost(""))[0], "This link does not open the viewer. Open the link that raygrad printed last.");
is("and not tried again", cleared.length, 1);
verdict = 204;
timer.run();
unseen = 4;
socket.onopen();
is("found again", [made.length, $("lost").hidden, unseen, (await lost(""))[2].after], [2, true, null, 500]);
training = { ended: "done" };
is("after training", (await lost(""))[0], "Training has ended and raygrad has exited. Open the run with raygrad view.");
const heard = [];
told = (message) => heard.push(message);
brought = (data) => heard.push(data.byteLength);
socket.onmessage({ data: '{"tell":"x"}' });
socket.onmessage({ data: new ArrayBuffer(3) });
is("heard", heard, [{ tell: "x" }, 3]);
/** Requests, new sockets and calls of a probe after this silence, with raygrad within reach or not. */
const probed = async (silence, isThere) => {
  [clock, verdict] = [lastHeard + silence, isThere ? 204 : null];
  const [asked, opened] = [fetched.length, made.length];
  Object.assign(socket, { readyState: 1, close: () => calls.push("closed") });
  await probe();
  return [fetched.length - asked, made.length - opened, called()];
};
fixed(document, "hidden", false);
called();
is("a short silence", await probed(14000, false), [0, 0, []]);
is("a long message", await probed(20000, true), [1, 0, []]);
is("out of reach", await probed(20000, false), [1, 1, ["closed"]]);
is("a dead connection", [await probed(61000, true), $("lost").hidden], [[1, 1, ["closed"]], false]);
verdict = 204;

// ---- a new link in the same tab -----------------------------------------------------------------------------------------
const [first, old] = [token, socket];
old.close = () => calls.push("closed");
const stored = new Map();
fixed(window, "sessionStorage", { getItem: (name) => stored.get(name) ?? null, setItem: (name, value) => stored.set(name, value) });
called();
$("lost").hidden = true;
location.hash = "token=abc";
await new Promise((done) => addEventListener("hashchange", () => done(), { once: true }));
is("takes the new token", [token, location.hash, called(), made.at(-1)], ["abc", "", ["closed"], `ws://${location.host}/messages?token=abc`]);
await old.onclose({ reason: "" });
is("the old socket is forgotten", [$("lost").hidden, timers.length], [true, 0]);
token = "";
takeToken();
is("a reload finds it", token, "abc");
stored.clear();
token = "";
takeToken();
is("nothing to find", token, "");
fixed(window, "sessionStorage", null);
history.replaceState(null, "", "#token=def");
takeToken();
is("without storage the link keeps it", [token, location.hash], ["def", "#token=def"]);
history.replaceState(null, "", location.pathname);
token = first;
