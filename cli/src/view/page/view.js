// Page of `raygrad view`. Runs after camera.js.
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

// ---- overlays -------------------------------------------------------------------------------------------------------------
/** The area of the stage that renders fill, while overlays are drawn. */
let area = null;

/** Near plane of overlays, as a fraction of the scene's side. */
const NEAR = 1e-3;
const depthOf = (point) => -dot(sub(point, view.eye), view.back);

/** Projects a point to the stage; null for points behind the camera. */
function project(point) {
  const local = sub(point, view.eye);
  const depth = depthOf(point);
  if (depth < NEAR * side()) return null;
  const { x, y, w, h } = area;
  const focal = (0.5 * h) / Math.tan(0.5 * view.fov * radians);
  // Overlays ignore lens distortion.
  const [across, down] = view.photograph === null ? [0.5, 0.5] : about.photographs[view.photograph].centre;
  return [x + across * w + (focal * dot(local, view.right)) / depth, y + down * h - (focal * dot(local, view.up)) / depth];
}

/** SVG path of the segments between consecutive points, clipped to the near plane. A null point interrupts the path. */
function path(points) {
  let text = "";
  const near = 1.01 * NEAR * side();
  points.slice(1).forEach((to, i) => {
    const from = points[i];
    if (!from || !to) return;
    const [a, b] = [depthOf(from), depthOf(to)];
    if (a < near && b < near) return;
    const cut = (inside, outside, deep, short) => add(inside, times((deep - near) / (deep - short), sub(outside, inside)));
    const [start, end] = [a < near ? cut(to, from, b, a) : from, b < near ? cut(from, to, a, b) : to].map(project);
    text += `M${start.map((x) => x.toFixed(1)).join(" ")}L${end.map((x) => x.toFixed(1)).join(" ")}`;
  });
  return text;
}

function frustum({ pose, fov, size: [width, height] }) {
  const column = (c) => [0, 1, 2].map((r) => pose[r][c]);
  const [right, up, back, eye] = [0, 1, 2, 3].map(column);
  const deep = 0.06 * side();
  const high = deep * Math.tan(0.5 * Math.min(fov, 120) * radians);
  const wide = (high * width) / height;
  const corner = (x, y) => add(add(eye, times(-deep, back)), add(times(x * wide, right), times(y * high, up)));
  const corners = [corner(-1, -1), corner(1, -1), corner(1, 1), corner(-1, 1)];
  return path([...corners, corners[0], null, corners[0], eye, corners[1], null, corners[2], eye, corners[3]]);
}

function svg(name, attributes, parent) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (parent) parent.append(element);
  return element;
}

let marking = false;
function marksOf() {
  if (!about || marking) return;
  marking = true;
  requestAnimationFrame(() => {
    marking = false;
    markAll();
  });
}

function markAll() {
  const made = document.createDocumentFragment();
  area = frame();
  // The error has the camera of the nearest image, so that overlays would not match.
  const here = !(mode() === "error" && view.photograph === null);
  if (here) makeMarks(made);
  marks.replaceChildren(made);
  dots.hidden = !(here && $("points").checked);
  if (!dots.hidden) drawPoints();
}

/** Draws the points on a canvas, since thousands of SVG elements would be slow. */
function drawPoints() {
  const room = stage.getBoundingClientRect();
  const fine = Math.min(devicePixelRatio, 2);
  [dots.width, dots.height] = [room.width, room.height].map((side) => Math.max(1, Math.round(side * fine)));
  const pen = dots.getContext("2d");
  pen.scale(dots.width / room.width, dots.height / room.height);
  for (const [place, color] of about.points) {
    const at = project(place);
    if (!at) continue;
    pen.fillStyle = `rgb(${color})`;
    pen.fillRect(at[0] - 1.5, at[1] - 1.5, 3, 3);
  }
}

function makeMarks(marks) {
  if ($("cameras").checked) {
    about.photographs.forEach((photograph, i) => {
      if (i !== view.photograph) svg("path", { d: frustum(photograph), class: `camera ${photograph.split}` }, marks);
    });
  }
  if ($("crop").checked) boxMarks(marks);
  if (keys.length > 1) svg("path", { d: path(flight(64).map((key) => key.eye)), class: "path" }, marks);
}

// ---- crop box ---------------------------------------------------------------------------------------------------------------
function makeBox() {
  const [lower, upper] = about.bounds;
  const holder = $("box");
  holder.replaceChildren();
  ["x", "y", "z"].forEach((name, axis) => {
    holder.append(name);
    [0, 1].forEach((end) => {
      const input = document.createElement("input");
      Object.assign(input, { type: "range", min: lower[axis], max: upper[axis], step: "any", value: [lower, upper][end][axis] });
      input.id = `box-${name}-${end}`;
      input.setAttribute("aria-label", `${end ? "upper" : "lower"} ${name}`);
      input.addEventListener("input", () => moveSide(axis, end, Number(input.value)));
      holder.append(input);
    });
  });
  tellBox();
}

/** The command that exports the box. */
function tellBox() {
  $("box-command").textContent = `raygrad export RUN mesh.glb --bounds scene:${box().flat().map((x) => Number(x.toPrecision(5)))}`;
}

/** Slider ends stand for these bounds, so that nothing is cropped. */
const EVERYWHERE = 1e9;
function box() {
  const end = (i) => ["x", "y", "z"].map((name) => Number($(`box-${name}-${i}`).value));
  return [end(0), end(1)];
}

/** Moves a face of the box, up to the opposite one. */
function moveSide(axis, end, value) {
  const [moved, other] = [end, 1 - end].map((i) => $(`box-${"xyz"[axis]}-${i}`));
  moved.value = String((end ? Math.max : Math.min)(value, Number(other.value)));
  tellBox();
  ask();
}

function boxMarks(marks) {
  const ends = box();
  const corner = (i) => [ends[i & 1][0], ends[(i >> 1) & 1][1], ends[(i >> 2) & 1][2]];
  for (let i = 0; i < 8; i++) {
    for (const bit of [1, 2, 4]) {
      if (!(i & bit)) svg("path", { d: path([corner(i), corner(i | bit)]), class: "box" }, marks);
    }
  }
  const middle = times(0.5, add(...ends));
  // Fingers need larger handles.
  const r = matchMedia("(pointer: coarse)").matches ? 16 : 7;
  for (const axis of [0, 1, 2]) {
    for (const end of [0, 1]) {
      const place = [...middle];
      place[axis] = ends[end][axis];
      const at = project(place);
      if (at) {
        const handle = svg("circle", { cx: at[0], cy: at[1], r, class: "handle" }, marks);
        handle.addEventListener("pointerdown", (event) => dragFace(event, axis, end));
      }
    }
  }
}

/** Moves a face of the box along its axis with the pointer. */
function dragFace(down, axis, end) {
  down.preventDefault();
  down.stopPropagation();
  const ends = box();
  const place = times(0.5, add(...ends));
  place[axis] = ends[end][axis];
  const beyond = [...place];
  const small = 1e-3 * side();
  beyond[axis] += small;
  const [a, b] = [project(place), project(beyond)];
  if (!a || !b) return;
  const along = [(b[0] - a[0]) / small, (b[1] - a[1]) / small];
  const square = along[0] ** 2 + along[1] ** 2;
  const from = ends[end][axis];
  const move = (event) => {
    const moved = ((event.clientX - down.clientX) * along[0] + (event.clientY - down.clientY) * along[1]) / (square || 1);
    moveSide(axis, end, from + moved);
  };
  const up = () => ["pointerup", "pointercancel"].forEach((end) => { removeEventListener("pointermove", move); removeEventListener(end, up); });
  addEventListener("pointermove", move);
  for (const end of ["pointerup", "pointercancel"]) addEventListener(end, up);
}

// ---- camera paths -----------------------------------------------------------------------------------------------------------
const snapshot = () => ({ eye: [...view.eye], right: [...view.right], up: [...view.up], back: [...view.back], fov: view.fov, pivot: [...view.pivot] });

function listKeys() {
  const list = $("keys");
  list.replaceChildren();
  keys.forEach((key, i) => {
    const item = document.createElement("li");
    const go = document.createElement("button"), drop = document.createElement("button");
    go.textContent = "go to";
    go.setAttribute("aria-label", `Go to keyframe ${i + 1}`);
    go.addEventListener("click", () => { free(); Object.assign(view, structuredClone(key)); settled(); });
    drop.textContent = "remove";
    drop.setAttribute("aria-label", `Remove keyframe ${i + 1}`);
    drop.addEventListener("click", () => { keys.splice(i, 1); listKeys(); ask(); });
    item.append(go, drop);
    list.append(item);
  });
  remember();
}

/** The path through the keyframes for display: a Catmull-Rom spline. */
function flight(count) {
  const n = keys.length, closed = $("closed").checked;
  if (n < 2) return keys;
  const legs = closed ? n : n - 1;
  // Extrapolates linearly beyond the ends.
  const at = (i, name) => {
    if (closed) return keys[(i + n) % n][name];
    if (i < 0) return sub(times(2, keys[0][name]), keys[1][name]);
    return i < n ? keys[i][name] : sub(times(2, keys[n - 1][name]), keys[n - 2][name]);
  };
  const lens = (i) => Math.log(Math.tan(0.5 * keys[i % n].fov * radians));
  const mix = (name, i, t) => [0, 1, 2].map((axis) => {
    const [a, b, c, d] = [i - 1, i, i + 1, i + 2].map((key) => at(key, name)[axis]);
    return b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)));
  });
  return Array.from({ length: count }, (_, f) => {
    const place = (f / Math.max(1, closed ? count : count - 1)) * legs;
    const i = Math.min(legs - 1, Math.floor(place)), t = place - i;
    const back = unit(mix("back", i, t));
    const right = unit(cross(mix("up", i, t), back));
    return { eye: mix("eye", i, t), back, right, up: cross(back, right), fov: 2 * Math.atan(Math.exp(lens(i) + t * (lens(i + 1) - lens(i)))) / radians, pivot: mix("pivot", i, t) };
  });
}

/** Duration of the path in seconds. */
const duration = () => clamp(Number($("seconds").value) || 4, 0.5, 600);

function play() {
  if (keys.length < 2) return apologise("A path needs two keyframes.");
  free();
  const seconds = duration(), start = performance.now(), turn = playing;
  const frames = flight(Math.ceil(60 * seconds));
  const next = (now) => {
    // Another camera motion has stopped the playback.
    if (turn !== playing) return;
    const share = (now - start) / 1000 / seconds;
    Object.assign(view, structuredClone(frames[Math.min(frames.length - 1, Math.floor(share * frames.length))]));
    settled();
    if (share < 1) requestAnimationFrame(next);
  };
  requestAnimationFrame(next);
}

/** A pose in capture coordinates, row by row. */
function inCapture(key) {
  const to = about.to_capture;
  const scale = Math.hypot(to[0][0], to[1][0], to[2][0]);
  const turn = (a) => [0, 1, 2].map((r) => (to[r][0] * a[0] + to[r][1] * a[1] + to[r][2] * a[2]) / scale);
  const [right, up, back] = [turn(key.right), turn(key.up), turn(key.back)];
  const eye = [0, 1, 2].map((r) => dot(to[r], key.eye) + to[r][3]);
  return [0, 1, 2].flatMap((r) => [right[r], up[r], back[r], eye[r]]).concat([0, 0, 0, 1]);
}

/** A keyframe from a pose in capture coordinates. */
function fromCapture({ matrix, fov }) {
  const to = about.to_capture;
  const scale = Math.hypot(to[0][0], to[1][0], to[2][0]);
  const turn = (a) => [0, 1, 2].map((c) => (to[0][c] * a[0] + to[1][c] * a[1] + to[2][c] * a[2]) / scale);
  const column = (c) => [0, 1, 2].map((r) => matrix[4 * r + c]);
  const [right, up, back] = [0, 1, 2].map((c) => turn(column(c)));
  const eye = times(1 / scale, turn(sub(column(3), to.map((row) => row[3]))));
  return { eye, right, up, back, fov, pivot: lookedAt({ eye, back }) };
}

/** The saved form of a path. */
const saved = () => ({
  coordinates: "capture",
  keyframes: keys.map((key) => ({ matrix: inCapture(key), fov: key.fov })),
  is_cycle: $("closed").checked,
  seconds: duration(),
});

/** Limits of a path file: bytes and keyframes. */
const LARGEST = 1e6, MOST_KEYS = 1000;

/** Loads a saved path; returns false if it is invalid. */
function take(path) {
  const among = (x, low, high) => typeof x === "number" && x >= low && x <= high;
  const isKey = (key) => {
    if (!key || !among(key.fov, 1, 120) || !Array.isArray(key.matrix) || key.matrix.length !== 16) return false;
    if (!key.matrix.every((x) => among(x, -EVERYWHERE, EVERYWHERE))) return false;
    const axes = [0, 1, 2].map((c) => [0, 1, 2].map((r) => key.matrix[4 * r + c]));
    return axes.every((axis) => Math.abs(size(axis) - 1) < 1e-3) && dot(cross(axes[0], axes[1]), axes[2]) > 1 - 1e-3;
  };
  const frames = path && path.coordinates === "capture" && path.keyframes;
  if (!Array.isArray(frames) || frames.length === 0 || frames.length > MOST_KEYS || !frames.every(isKey)) return false;
  keys = frames.map(fromCapture);
  $("closed").checked = path.is_cycle === true;
  if (among(path.seconds, 0.5, 600)) $("seconds").value = String(path.seconds);
  return true;
}

async function loadPath(file) {
  const path = file.size > LARGEST ? null : await file.text().then(JSON.parse).catch(() => null);
  if (!take(path)) return apologise(`${file.name} is not a path saved by this viewer (limits: ${MOST_KEYS} keyframes, 1 MB).`);
  listKeys();
  marksOf();
}

/** Key of the scene's path in the session storage. */
const pathName = () => `path of ${about.title} in ${about.bounds}`;

function remember() {
  try {
    if (keys.length) sessionStorage.setItem(pathName(), JSON.stringify(saved()));
    else sessionStorage.removeItem(pathName());
  } catch { /* Some browsers keep nothing. */ }
}

function recall() {
  keys = [];
  try {
    take(JSON.parse(sessionStorage.getItem(pathName())));
  } catch { /* Nothing is kept. */ }
}

/** The path for `raygrad render`, if it has two keyframes. */
function cameraPath() {
  if (keys.length < 2) return apologise("A path needs two keyframes.");
  // The aspect ratio of the view, with even sides for encoders.
  const [width, height] = evenly(freeSizes());
  return {
    ...saved(),
    camera_type: "perspective",
    render_width: width,
    render_height: height,
    fps: 25,
    smoothness_value: 0,
    camera_path: [],
  };
}

function savePath() {
  const path = cameraPath();
  if (path) keep(new Blob([JSON.stringify(path, null, 1)], { type: "application/json" }), "path.json");
}

function makeVideo() {
  const path = cameraPath();
  if (!path) return;
  const seen = wanted();
  if (seen.crop || seen.checkpoint !== undefined || seen.compared) {
    return apologise("A video shows the final model: turn off the crop box, the checkpoint and the error.");
  }
  const text = JSON.stringify(path, (name, value) => (typeof value === "number" ? Number(value.toPrecision(12)) : value));
  if (text.length > 15000) return apologise("Too many keyframes for the viewer: save the path and use raygrad render.");
  say({ ask: "video", path: JSON.parse(text), show: seen.show, skip: seen.skip, background: seen.background });
}

function videoed({ file, words, ended }) {
  $("video-progress").hidden = false;
  $("video-progress").textContent = `${file}: ${words}`;
  $("end-video").hidden = ended;
}

function keep(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
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
