// Page of `raygrad view`. Runs after camera.js, overlays.js and path.js, which use its elements and state.
"use strict";

const $ = (id) => document.getElementById(id);
const stage = $("stage"), picture = $("picture"), photo = $("photo"), dots = $("dots"), marks = $("marks");

// ---- messages from the server ---------------------------------------------------------------------------------------
let about = null;
let socket = null, attempts = 0;
/** Number of the last request, and the last render. */
let asked = 0, shown = null;
let training = null;

let keys = [];
/** Number of the current playback. Any camera motion increments it, which stops playback. */
let playing = 0;

/** Access token of the link. */
let token = "";

/** Takes the token of the link out of the address bar and the history, and keeps it for reloads of this tab. */
function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  try {
    if (given) sessionStorage.setItem("token", given);
    token = given || sessionStorage.getItem("token") || "";
    if (given) history.replaceState(null, "", location.pathname);
  } catch {
    // Without storage, reloads need the token in the address bar.
    token = given || token;
  }
}

/** An address of the server that needs the token. */
function withToken(path) {
  return new URL(`${path}?token=${encodeURIComponent(token)}`, location.href);
}

/** True if the server refuses the token. Browsers do not tell why a socket fails. */
async function isRefused() {
  try {
    return (await fetch(withToken("access"), { signal: AbortSignal.timeout(3000) })).status === 403;
  } catch {
    return false;
  }
}

function connect() {
  const address = withToken("messages");
  address.protocol = address.protocol.replace("http", "ws");
  const own = socket = new WebSocket(address);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { attempts = 0; $("lost").hidden = true; unseen = null; lastHeard = performance.now(); };
  socket.onmessage = (event) => {
    lastHeard = performance.now();
    return typeof event.data === "string" ? told(JSON.parse(event.data)) : brought(event.data);
  };
  socket.onclose = async (event) => {
    // A new link has opened another socket.
    if (socket !== own) return;
    $("lost").textContent = training && training.ended ? "Training has ended and raygrad has exited. Open the run with raygrad view."
      : event.reason ? `raygrad closed the connection: ${event.reason}. Reconnecting…`
      : "raygrad does not respond. Reconnecting…";
    $("lost").hidden = false;
    attempts += 1;
    const again = setTimeout(() => { if (socket === own) connect(); }, Math.min(5000, 250 * 2 ** attempts));
    if (!event.reason && await isRefused()) {
      clearTimeout(again);
      $("lost").textContent = "This link does not open the viewer. Open the link that raygrad printed last.";
    }
  };
}

/** Time of the last message. raygrad sends one at least every five seconds, but a large image may take long. */
let lastHeard = 0;
/** The silence in milliseconds after which the page asks if raygrad is there, and after which the connection is dead. */
const QUIET = 15000, DEAD = 60000;

// A network that comes back from sleep loses connections without closing them.
async function probe() {
  const silence = () => performance.now() - lastHeard;
  if (document.hidden || socket.readyState !== WebSocket.OPEN || silence() < QUIET) return;
  const own = socket;
  const isThere = await fetch(withToken("access"), { signal: AbortSignal.timeout(3000) }).then(() => true, () => false);
  if (socket !== own || silence() < (isThere ? DEAD : QUIET)) return;
  $("lost").textContent = "raygrad does not respond. Reconnecting…";
  $("lost").hidden = false;
  socket.close();
  connect();
}
setInterval(probe, 5000);

// A new link, opened in the same tab.
addEventListener("hashchange", () => {
  if (!location.hash) return;
  takeToken();
  socket.close();
  connect();
});

function say(message) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function told(message) {
  if (message.tell === "about") meet(message);
  else if (message.tell === "training") follow(message);
  else if (message.tell === "taken") moved(message);
  else if (message.tell === "video") videoed(message);
  else if (message.tell === "sorry") apologise(message.what);
}

/** The last request has its render or failed. */
function answered() {
  unseen = null;
  if (again) ask();
}

function apologise(what) {
  requested = null;
  answered();
  $("sorry").textContent = what;
  $("sorry").hidden = false;
  clearTimeout(apologise.timer);
  apologise.timer = setTimeout(() => { $("sorry").hidden = true; }, 8000);
}

function brought(data) {
  const length = new DataView(data).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  const bytes = new Uint8Array(data, 4 + length);
  if (head.file === "picture") {
    say({ ask: "seen", id: head.id });
    if (head.id === asked) answered();
    draw(head, new Blob([bytes], { type: "image/jpeg" }));
  } else if (head.file === "save") {
    keep(new Blob([bytes], { type: "image/png" }), head.name);
  } else if (head.file === "photograph") {
    overlay(head.number, new Blob([bytes], { type: "image/jpeg" }));
  }
}

/** The cameras of the images have changed. */
function moved(taken) {
  if (!about) return;
  Object.assign(about, taken);
  ask();
}

/** Handles the description of the scene, after each connection. */
function meet(message) {
  const before = about;
  // After a reconnection, another program may serve another scene.
  const elsewhere = before === null || before.title !== message.title || String(bounds) !== String(message.bounds);
  const first = before === null || elsewhere;
  const checkpoint = before ? before.checkpoints[Number($("checkpoint").value)] : undefined;
  about = message;
  if (view.photograph >= about.photographs.length) view.photograph = null;
  bounds = about.bounds;
  if (elsewhere) recall();
  overlaid = requested = null;
  // A video that continues sends its progress.
  $("video-progress").hidden = $("end-video").hidden = true;
  document.title = `${about.title} - raygrad`;
  $("title").textContent = about.title;
  $("photographs").hidden = about.photographs.length === 0;
  $("training").hidden = !about.training;
  const select = $("photograph");
  select.replaceChildren(new Option("-", ""));
  for (const split of ["train", "val", "test"]) {
    const group = document.createElement("optgroup");
    group.label = { train: "training", val: "validation", test: "test" }[split];
    about.photographs.forEach((photograph, i) => {
      if (photograph.split === split) group.append(new Option(photograph.name, String(i)));
    });
    if (group.children.length) select.append(group);
  }
  if (first) {
    const hex = (x) => Math.round(255 * x).toString(16).padStart(2, "0");
    $("background").value = "#" + about.background.map(hex).join("");
  }
  for (const option of $("skip").options) option.disabled = about.training && !["", "off"].includes(option.value);
  $("video").disabled = about.training;
  // The position after the last checkpoint is the final model.
  const count = about.checkpoints.length, known = about.checkpoints.indexOf(checkpoint);
  const chosen = first || known < 0 ? count : known;
  document.querySelector("input[name=show][value=error]").disabled = about.photographs.length === 0;
  $("checkpoints").hidden = count === 0;
  $("checkpoint").max = String(count);
  $("checkpoint").value = String(chosen);
  if (elsewhere) { makeBox(); listKeys(); }
  if (first) reset();
  else {
    select.value = view.photograph === null ? "" : String(view.photograph);
    blend();
    settled();
  }
}

// ---- requests for renders ---------------------------------------------------------------------------------------------
let waits = false;
/** Time of the request without a render yet, and true if the camera has moved since. */
let unseen = null, again = false;
/** Milliseconds to wait for a render before the next request. Without the wait, a moving camera would get no renders. */
const PATIENCE = 1000;
/** A number as text, or "-". */
const digits = (x, count) => (typeof x === "number" ? x.toFixed(count) : "-");

/** Requests a render of the current view, at most once per display frame. */
function ask() {
  marksOf();
  if (waits || !about) return;
  if (document.hidden) return;
  if (unseen !== null && performance.now() - unseen < PATIENCE) {
    again = true;
    return;
  }
  waits = true;
  setTimeout(() => {
    waits = false;
    if (document.hidden) return;
    [unseen, again] = [performance.now(), false];
    asked = (asked + 1) >>> 0;
    say({ ask: "view", id: asked, view: wanted() });
  }, 16);
}

function wanted() {
  const [width, height] = sizes();
  const eye = view.photograph === null
    ? { free: { pose: rows(view), fov: view.fov } } : { photograph: view.photograph };
  const answer = { eye, size: [width, height], ...shows() };
  if ($("skip").value) answer.skip = $("skip").value;
  const checkpoint = about.checkpoints[Number($("checkpoint").value)];
  if (checkpoint !== undefined) answer.checkpoint = checkpoint;
  if ($("own-background").checked) {
    answer.background = [1, 3, 5].map((i) => parseInt($("background").value.slice(i, i + 2), 16));
  }
  if ($("crop").checked) answer.crop = box().map((corner, end) => corner.map((x, axis) => (x === bounds[end][axis] ? [-1, 1][end] * EVERYWHERE : x)));
  return answer;
}

/** The displayed quantity. The error mode compares colours. */
const shows = () => (mode() === "error" ? { compared: true } : { show: mode() });
const mode = () => document.querySelector("input[name=show]:checked").value;
/** Width and height of renders. */
function sizes() {
  const area = stage.getBoundingClientRect();
  const proportion = view.photograph === null ? area.width / area.height
    : about.photographs[view.photograph].size[0] / about.photographs[view.photograph].size[1];
  const high = $("size").value;
  let height = high === "fit" ? area.height * Math.min(devicePixelRatio, 1.5) : Number(high);
  if (proportion > area.width / area.height && high === "fit") height = (area.width * Math.min(devicePixelRatio, 1.5)) / proportion;
  const most = Math.sqrt((1 << 22) / proportion);
  height = clamp(Math.floor(Math.min(height, most)), 8, 4096);
  return [clamp(Math.floor(height * proportion), 8, 4096), height];
}

/** Width and height of keyframes, at most 1920 pixels. */
function freeSizes() {
  const photograph = view.photograph;
  view.photograph = null;
  const free = sizes();
  view.photograph = photograph;
  const share = Math.min(1, 1920 / Math.max(...free));
  return free.map((side) => side * share);
}
const evenly = (sides) => sides.map((side) => Math.max(16, 2 * Math.round(side / 2)));

/** The area of the stage that renders fill. */
function frame() {
  const area = stage.getBoundingClientRect();
  // Sides of coarse renders are rounded up. They fill the area of the full-size render.
  const whole = sizes(), coarse = shown && whole.map((side) => Math.ceil(side / 2 ** shown.halvings));
  const [width, height] = shown && String(shown.size) !== String(coarse) ? shown.size : whole;
  const share = Math.min(area.width / width, area.height / height);
  const [w, h] = [width * share, height * share];
  return { x: (area.width - w) / 2, y: (area.height - h) / 2, w, h };
}

let drawing = 0;
async function draw(head, blob) {
  const turn = ++drawing;
  const bitmap = await createImageBitmap(blob).catch(() => null);
  // A later render was decoded first.
  if (!bitmap || turn < (draw.last || 0)) return;
  draw.last = turn;
  const whole = head.halvings === 0;
  picture.width = bitmap.width;
  picture.height = bitmap.height;
  picture.getContext("2d").drawImage(bitmap, 0, 0);
  shown = { ...head, size: [bitmap.width, bitmap.height], whole };
  bitmap.close();
  stage.dataset.shown = String(head.id);
  stage.dataset.halvings = String(head.halvings);
  stage.dataset.step = String(head.step);
  layout();
  let text = `${shown.size.join("×")}${whole ? "" : " (coarse)"} · ${head.milliseconds.toFixed(0)} ms`;
  if (head.compared) {
    const [number, psnr, evaluated] = head.compared;
    text += ` · against ${about.photographs[number].name}: ${evaluated || psnr === null ? "" : "about "}${digits(psnr, 2)} dB`;
  }
  if (about.training || head.step > 0) text += ` · step ${head.step}`;
  $("status").textContent = text;
}

function layout() {
  const { x, y, w, h } = frame();
  for (const canvas of [picture, photo]) {
    Object.assign(canvas.style, { left: `${x}px`, top: `${y}px`, width: `${w}px`, height: `${h}px` });
  }
  marksOf();
}

// ---- camera motion ------------------------------------------------------------------------------------------------------
function free() {
  playing += 1;
  if (view.photograph === null) return;
  view.photograph = null;
  $("photograph").value = "";
  $("blend").value = 0;
  blend();
}

function reset() {
  playing += 1;
  const area = stage.getBoundingClientRect();
  enter(about, area.width / area.height);
  view.photograph = null;
  $("photograph").value = "";
  $("fov").value = String(Math.round(view.fov));
  photo.hidden = true;
  $("blend").value = 0;
  settled();
}

function settled() {
  $("fov").value = String(Math.round(view.fov));
  $("fov-out").textContent = `${view.fov.toFixed(0)}°`;
  $("blend-out").textContent = `${$("blend").value} %`;
  const checkpoint = about.checkpoints[Number($("checkpoint").value)];
  $("checkpoint-out").textContent = checkpoint === undefined ? "final model" : `step ${checkpoint}`;
  ask();
}

const modes = ["color", "depth", "normals", "opacity", "error"];
document.addEventListener("keydown", (event) => {
  // Keys belong to the focused control.
  if (!about || event.ctrlKey || event.metaKey || event.altKey || event.target.closest("aside")) return;
  const steered = steer(event);
  // Only camera keys repeat while they are held down.
  if (!steered && event.repeat) return;
  if (steered) { /* The camera has moved. */ }
  else if (event.key >= "1" && event.key <= "5") choose(modes[event.key - 1]);
  else {
    const buttons = { r: "reset", p: "save", n: "nearest", ",": "previous", ".": "next", k: "key" };
    const key = event.key.toLowerCase(), button = buttons[key];
    if (button) $(button).click();
    else if (key === "c") { $("cameras").checked = !$("cameras").checked; marksOf(); }
    else if (key === "b") { $("blend").value = Number($("blend").value) ? 0 : 50; blend(); }
    else return;
  }
  event.preventDefault();
});

function choose(name) {
  const input = document.querySelector(`input[name=show][value=${name}]`);
  if (input.disabled) return;
  input.checked = true;
  ask();
}

// ---- images -----------------------------------------------------------------------------------------------------------------
let overlaid = null, requested = null;

function goTo(number) {
  if (!about.photographs[number]) return;
  playing += 1;
  const photograph = about.photographs[number];
  place(photograph.pose, clamp(photograph.fov, 5, 120));
  view.photograph = number;
  view.pivot = lookedAt(view);
  $("photograph").value = String(number);
  $("fov").value = String(Math.round(view.fov));
  blend();
  settled();
}

/** The pivot of a camera: straight ahead, at the depth of the scene's centre. */
function lookedAt({ eye, back }) {
  const middle = times(0.5, add(...bounds));
  return sub(eye, times(Math.max(0.05 * side(), dot(sub(eye, middle), back)), back));
}

function nearest() {
  const reach = Math.max(1e-6, size(sub(view.eye, times(0.5, add(...bounds)))));
  const apart = ({ pose }) => size(sub([0, 1, 2].map((r) => pose[r][3]), view.eye)) / reach
    + size(sub([0, 1, 2].map((r) => pose[r][2]), view.back));
  let best = 0;
  about.photographs.forEach((photograph, i) => { if (apart(photograph) < apart(about.photographs[best])) best = i; });
  return best;
}

function blend() {
  const share = Number($("blend").value) / 100;
  $("blend-out").textContent = `${$("blend").value} %`;
  if (share > 0 && view.photograph === null && about.photographs.length) return goTo(nearest());
  photo.style.opacity = share;
  photo.hidden = share === 0 || overlaid !== view.photograph;
  if (share > 0 && overlaid !== view.photograph && requested === null) {
    requested = view.photograph;
    say({ ask: "photograph", number: requested });
  }
}

async function overlay(number, blob) {
  const bitmap = await createImageBitmap(blob).catch(() => null);
  requested = null;
  if (!bitmap) return apologise("The browser cannot decode the image.");
  photo.width = bitmap.width;
  photo.height = bitmap.height;
  photo.getContext("2d").drawImage(bitmap, 0, 0);
  bitmap.close();
  overlaid = number;
  stage.dataset.photograph = String(number);
  blend();
}

// ---- training -----------------------------------------------------------------------------------------------------------------
function follow(message) {
  training = message;
  const { step, loss, psnr, left, paused, share, ended } = message;
  $("progress").textContent = ended ? `${ended} after ${step} steps`
    : `step ${step} · loss ${typeof loss === "number" ? loss.toPrecision(3) : "-"} · PSNR ${digits(psnr, 2)} dB · ${paused ? "paused" : `${left} of training left`}`;
  $("pause").textContent = paused ? "Resume" : "Pause";
  for (const id of ["pause", "stop", "share"]) $(id).disabled = Boolean(ended);
  if (document.activeElement !== $("share")) $("share").value = String(100 * share);
  $("share-out").textContent = `${Math.round(100 * share)} %`;
  curve("curve-loss", "loss", message.curves.loss, true);
  curve("curve-psnr", "PSNR", message.curves.psnr, false);
  curve("curve-speed", "rays/s", message.curves.speed, false);
}

function curve(id, name, values, logarithmic) {
  const holder = $(id);
  const [width, height] = [holder.clientWidth || 260, 54];
  const known = values.filter((value) => Number.isFinite(value) && (!logarithmic || value > 0));
  holder.replaceChildren();
  if (known.length < 1) return;
  const scale = logarithmic ? Math.log : (x) => x;
  const [low, high] = [Math.min(...known), Math.max(...known)].map(scale);
  const points = known.map((value, i) => {
    const x = (i / Math.max(1, known.length - 1)) * (width - 4) + 2;
    const y = height - 4 - ((scale(value) - low) / (high - low || 1)) * (height - 22);
    return `${i ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`;
  });
  svg("path", { d: points.join("") }, holder);
  const last = known[known.length - 1];
  svg("text", { x: 4, y: 12 }, holder).textContent = `${name} ${last >= 1000 ? Math.round(last).toLocaleString("en") : last.toPrecision(4)}`;
}

// ---- controls -----------------------------------------------------------------------------------------------------------------
for (const input of document.querySelectorAll("input[name=show], #skip, #own-background, #size, #crop")) {
  input.addEventListener("change", () => { $("box").hidden = $("box-export").hidden = !$("crop").checked; ask(); });
}
$("background").addEventListener("input", () => { $("own-background").checked = true; ask(); });
$("fov").addEventListener("input", () => { free(); view.fov = Number($("fov").value); settled(); });
$("blend").addEventListener("input", blend);
for (const id of ["cameras", "points", "closed"]) $(id).addEventListener("change", () => { marksOf(); });
for (const id of ["closed", "seconds"]) $(id).addEventListener("change", remember);
$("reset").addEventListener("click", reset);
$("save").addEventListener("click", () => say({ ask: "save", view: wanted() }));
$("photograph").addEventListener("change", () => ($("photograph").value === "" ? (free(), ask()) : goTo(Number($("photograph").value))));
const count = () => about.photographs.length;
$("next").addEventListener("click", () => goTo(view.photograph === null ? nearest() : (view.photograph + 1) % count()));
$("previous").addEventListener("click", () => goTo(view.photograph === null ? nearest() : (view.photograph + count() - 1) % count()));
$("nearest").addEventListener("click", () => goTo(nearest()));
$("key").addEventListener("click", () => { keys.push(snapshot()); listKeys(); marksOf(); });
$("play").addEventListener("click", play);
$("save-path").addEventListener("click", savePath);
$("load-path").addEventListener("change", () => {
  const [file] = $("load-path").files;
  if (file) loadPath(file);
  // Allows choosing the same file again.
  $("load-path").value = "";
});
$("video").addEventListener("click", makeVideo);
$("end-video").addEventListener("click", () => say({ ask: "end-video" }));
$("checkpoint").addEventListener("input", settled);
// Returns the focus to the scene after a click. Keyboard activation keeps it on the button.
document.querySelector("aside").addEventListener("click", (event) => {
  if (event.detail && event.target.closest("button")) stage.focus({ preventScroll: true });
});
$("pause").addEventListener("click", () => say({ ask: "pause", pause: !(training && training.paused) }));
$("stop").addEventListener("click", () => { if (confirm("Stop training and save the model?")) say({ ask: "stop" }); });
$("share").addEventListener("input", () => say({ ask: "share", share: Number($("share").value) / 100 }));
// Some browsers restore form values after a reload.
for (const input of document.querySelectorAll("input")) [input.checked, input.value] = [input.defaultChecked, input.defaultValue];
// Stops rendering while the page is hidden.
document.addEventListener("visibilitychange", () => {
  if (!document.hidden) return ask();
  // The pending render will not arrive.
  unseen = null;
  say({ ask: "rest" });
});
listen(stage);
new ResizeObserver(() => { if (about && stage.clientHeight) { layout(); ask(); } }).observe(stage);

takeToken();
connect();
