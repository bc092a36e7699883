// Camera paths of the page of `raygrad view`: keyframes, playing, files and videos.
"use strict";

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
