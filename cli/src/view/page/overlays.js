// What the page of `raygrad view` draws over the image: cameras, points, the path and the crop box.
"use strict";

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
