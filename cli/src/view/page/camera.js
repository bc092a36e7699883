// Camera controls. Coordinates are in scene units, with z up. Columns of a pose are right, up, back and eye.
// The page's script defines `free`, called before the camera moves, and `ask`, called after.
"use strict";

// ---- vectors ------------------------------------------------------------------------------------------------------
const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const times = (k, a) => [k * a[0], k * a[1], k * a[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const size = (a) => Math.hypot(a[0], a[1], a[2]);
const unit = (a) => times(1 / (size(a) || 1), a);
const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
const radians = Math.PI / 180;

/** Rotates a vector about a unit axis. */
function turned(a, axis, angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return add(add(times(c, a), times(s, cross(axis, a))), times((1 - c) * dot(axis, a), axis));
}

// ---- camera ---------------------------------------------------------------------------------------------------------
const view = { eye: [0, -4, 1], right: [1, 0, 0], up: [0, 0, 1], back: [0, -1, 0], pivot: [0, 0, 0], fov: 50, photograph: null };
/** The corners of the scene box, once known. */
let bounds = null;

const rows = (v) => [0, 1, 2].map((i) => [v.right[i], v.up[i], v.back[i], v.eye[i]]);

function place(pose, fov) {
  const column = (c) => [0, 1, 2].map((r) => pose[r][c]);
  [view.right, view.up, view.back, view.eye] = [0, 1, 2, 3].map(column);
  view.fov = fov;
}

/** The vertical field of view at which a view of aspect ratio `own` fits into a window in both directions. */
function fitting(fov, own, window) {
  // A page that is not shown has a window of size 0.
  const half = Math.tan(0.5 * fov * radians) * (own > window && window > 0 ? own / window : 1);
  return clamp((2 * Math.atan(half)) / radians, 1, 120);
}

/** Sets the initial camera for a window of this aspect ratio. */
function enter({ pose, fov, proportion }, window) {
  place(pose, fitting(fov, proportion, window));
  view.pivot = times(0.5, add(...bounds));
  // A camera at the centre looks outwards, so that the pivot is ahead of it.
  if (size(sub(view.eye, view.pivot)) < 0.05 * side()) view.pivot = sub(view.eye, times(0.5 * side(), view.back));
}

/** Levels the horizon, which images taken at an angle need. Has no effect if the view is vertical. */
function level() {
  const right = cross([0, 0, 1], view.back);
  if (Math.abs(view.right[2]) < 1e-9 || size(right) < 0.05) return;
  view.right = unit(right);
  view.up = cross(view.back, view.right);
}

function orbit(dx, dy) {
  free();
  level();
  const turn = (axis, angle) => {
    for (const name of ["right", "up", "back"]) view[name] = unit(turned(view[name], axis, angle));
    view.eye = add(view.pivot, turned(sub(view.eye, view.pivot), axis, angle));
  };
  turn([0, 0, 1], -dx);
  // Not over the poles, where left and right swap. From beyond a pole, the camera may return.
  const height = Math.asin(clamp(view.back[2], -1, 1));
  const upright = view.up[2] > -1e-6;
  turn(view.right, upright ? -clamp(dy, Math.min(0, -1.5 - height), Math.max(0, 1.5 - height)) : -dy);
  ask();
}

function pan(dx, dy) {
  free();
  const step = add(times(-dx, view.right), times(dy, view.up));
  const reach = size(sub(view.eye, view.pivot)) * Math.tan(0.5 * view.fov * radians) * 2;
  const moved = times(reach, step);
  view.eye = add(view.eye, moved);
  view.pivot = add(view.pivot, moved);
  ask();
}

/** Smallest distance to the pivot, as a fraction of the scene's side. */
const NEAREST = 0.02;

function zoom(factor) {
  free();
  const away = sub(view.eye, view.pivot);
  const backwards = size(away) > 0 ? unit(away) : view.back;
  const distance = Math.min(size(away) * factor, 100 * side());
  view.eye = add(view.pivot, times(distance, backwards));
  // At this distance the pivot moves with the camera, so that zooming never stops.
  view.pivot = sub(view.eye, times(Math.max(distance, NEAREST * side()), backwards));
  ask();
}

function fly(right, up, ahead) {
  free();
  const step = add(add(times(right, view.right), times(up, view.up)), times(-ahead, view.back));
  const moved = times(0.25 * Math.max(0.2 * side(), size(sub(view.eye, view.pivot))), step);
  view.eye = add(view.eye, moved);
  view.pivot = add(view.pivot, moved);
  ask();
}

const side = () => Math.max(...sub(bounds[1], bounds[0]));

/** Adds pointer and wheel controls. */
function listen(stage) {
  /** Active pointers with their last positions. */
  const pointers = new Map();
  stage.addEventListener("pointerdown", (event) => {
    if (event.target.classList && event.target.classList.contains("handle")) return;
    stage.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  stage.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before || !bounds) return;
    // A third finger disables the gesture.
    if (pointers.size > 2) {
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      return;
    }
    const area = stage.getBoundingClientRect();
    const [dx, dy] = [(event.clientX - before[0]) / area.height, (event.clientY - before[1]) / area.height];
    if (pointers.size === 2) {
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
      const distance = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      const now = distance([event.clientX, event.clientY]);
      if (now > 4) zoom(distance(before) / now);
      pan(0.5 * dx, 0.5 * dy);
    } else if (event.buttons & 2 || event.buttons & 4 || event.shiftKey) pan(dx, dy);
    else orbit(3 * dx, 3 * dy);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    stage.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  stage.addEventListener("contextmenu", (event) => event.preventDefault());
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaY * (event.deltaMode === 1 ? 30 : event.deltaMode === 2 ? 300 : 1);
    if (bounds) zoom(Math.exp(clamp(lines, -300, 300) * 0.0015));
  }, { passive: false });
}

/** Moves the camera for a key; returns false for other keys. */
function steer(event) {
  const step = 0.12;
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  const flies = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], e: [0, 1, 0], q: [0, -1, 0] }[event.key.toLowerCase()];
  if (arrows && event.shiftKey) pan(0.3 * step * arrows[0], 0.3 * step * arrows[1]);
  else if (arrows) orbit(step * arrows[0], step * arrows[1]);
  else if (flies) fly(...flies.map((x) => 0.2 * x));
  else if (event.key === "+" || event.key === "=") zoom(0.9);
  else if (event.key === "-") zoom(1 / 0.9);
  else return false;
  return true;
}
