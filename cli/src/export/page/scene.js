// Scene page: renders a trained scene with WebGL. Runs after camera.js.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const stage = document.getElementById("stage"), picture = document.getElementById("picture"), status = document.getElementById("status");
const sorry = document.getElementById("sorry");

/** Target times in milliseconds: for a band of rows, and for the first render of a moving camera. */
const PIECE = 40, FIRST = 30;
const TABLE_WIDTH = 2048, TABLE_SHIFT = 11, WEIGHTS_WIDTH = 1024;

function bytes(name) {
  const text = atob(bytes.files[name]);
  const out = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
  return out;
}
bytes.files = JSON.parse(document.getElementById("files").textContent);

/** Shows the status, or an error, which screen readers announce at once. */
function tell(words, sad = false) {
  [status.hidden, sorry.hidden] = [sad, !sad];
  (sad ? sorry : status).textContent = words;
}

// ---- WebGL ------------------------------------------------------------------------------------------------------------
let gl = null, program = null, places = null;

function texture(unit, target, make) {
  const texture = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(target, texture);
  for (const [name, value] of [["MIN_FILTER", gl.NEAREST], ["MAG_FILTER", gl.NEAREST], ["WRAP_S", gl.CLAMP_TO_EDGE], ["WRAP_T", gl.CLAMP_TO_EDGE]]) {
    gl.texParameteri(target, gl[`TEXTURE_${name}`], value);
  }
  make();
  return texture;
}

/** Pads an array to this length. */
function padded(array, length) {
  const out = new array.constructor(length);
  out.set(array);
  return out;
}

/** A program that runs the fragment shader for each pixel. */
function programOf(fragment) {
  const program = gl.createProgram();
  const corner = "#version 300 es\nvoid main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }";
  const shaders = [[gl.VERTEX_SHADER, corner], [gl.FRAGMENT_SHADER, fragment]].map(([kind, text]) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    return shader;
  });
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    throw new Error(`The graphics card cannot compile the scene: ${shaders.map((s) => gl.getShaderInfoLog(s)).join(" ")} ${gl.getProgramInfoLog(program)}`);
  }
  gl.useProgram(program);
  return program;
}

/** Warning after the status of each render. */
let warning = "";

/** Detects drivers that end loops after about 10000 rounds, such as llvmpipe of Mesa. Rays need more. */
function endsLoopsEarly() {
  const program = programOf(`#version 300 es
precision highp float;
uniform int rounds;
out vec4 result;
void main() {
  float count = 0.0;
  for (int i = 0; i < rounds; i++) for (int j = 0; j < rounds; j++) count += fract(count) + 1.0;
  result = vec4(count == float(rounds * rounds));
}`);
  gl.uniform1i(gl.getUniformLocation(program, "rounds"), 300);
  targetOf(1, 1);
  gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
  gl.viewport(0, 0, 1, 1);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  const pixel = new Uint8Array(4);
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  return pixel[0] === 0;
}

function begin() {
  gl = picture.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
  if (!gl) throw new Error("This browser has no WebGL 2, which the scene needs.");
  if (endsLoopsEarly()) warning = " · this browser's driver leaves parts of the scene out; try another browser";
  const { grid, network, space, march } = data;
  const each = grid.features, texels = Math.ceil(each / 4);
  const defines = {
    LEVELS: grid.levels.length, FEATURES: each, TEXELS: texels, HIDDEN: network.hidden, OUT: network.features, COLOR: network.color,
    DEPTH: network.depth, DEGREE: network.degree, SPACE: space.kind, TABLE_WIDTH, TABLE_SHIFT,
  };
  const [version, ...rest] = document.getElementById("shader").textContent.trim().split("\n");
  const head = Object.entries(defines).map(([name, value]) => `#define ${name} ${value}`);
  program = programOf([version, ...head, ...rest].join("\n"));
  places = (name) => gl.getUniformLocation(program, name);

  // The hash table has up to four features per texel.
  const [format, inside] = each === 1 ? [gl.RED, gl.R16F] : each === 2 ? [gl.RG, gl.RG16F] : [gl.RGBA, gl.RGBA16F];
  const height = Math.ceil((grid.rows * texels) / TABLE_WIDTH);
  const blocks = march.resolution / 4;
  if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE) || blocks * march.cascades > gl.getParameter(gl.MAX_3D_TEXTURE_SIZE)) {
    throw new Error("The scene is too large for this graphics card.");
  }
  texture(0, gl.TEXTURE_2D, () => {
    const values = padded(new Uint16Array(bytes("table").buffer), TABLE_WIDTH * height * Math.min(each, 4));
    gl.texImage2D(gl.TEXTURE_2D, 0, inside, TABLE_WIDTH, height, 0, format, gl.HALF_FLOAT, values);
  });
  texture(1, gl.TEXTURE_2D, () => {
    const values = new Float32Array(bytes("weights").buffer);
    const rows = Math.ceil(values.length / 4 / WEIGHTS_WIDTH);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, WEIGHTS_WIDTH, rows, 0, gl.RGBA, gl.FLOAT, padded(values, 4 * WEIGHTS_WIDTH * rows));
  });
  texture(2, gl.TEXTURE_3D, () => {
    gl.texImage3D(gl.TEXTURE_3D, 0, gl.RG32UI, blocks, blocks, blocks * march.cascades, 0, gl.RG_INTEGER, gl.UNSIGNED_INT, new Uint32Array(bytes("words").buffer));
  });
  bytes.files = null;
  const whole = { table: 0, weights: 1, words: 2, resolution: march.resolution, cascades: march.cascades };
  for (const [name, value] of Object.entries(whole)) gl.uniform1i(places(name), value);
  gl.uniform4iv(places("levels"), grid.levels.flat());
  const numbers = {
    scale: space.scale, stepLength: march.step, cone: march.cone, termination: march.termination, budget: march.budget, shift: network.shift,
  };
  for (const [name, value] of Object.entries(numbers)) gl.uniform1f(places(name), value);
  const vectors = {
    gain: data.gain, background: data.background, low: data.reach[0], high: data.reach[1], middle: space.middle, boxLow: march.bounds[0],
    boxHigh: march.bounds[1], across: space.across || [1, 1, 1],
  };
  for (const [name, value] of Object.entries(vectors)) gl.uniform3fv(places(name), value);
  gl.uniform2fv(places("span"), data.span);
  gl.uniformMatrix3fv(places("axes"), false, space.axes || [1, 0, 0, 0, 1, 0, 0, 0, 1]);
  gl.bindVertexArray(gl.createVertexArray());
  gl.enable(gl.SCISSOR_TEST);
}

/** The off-screen render target. */
let target = null;
function targetOf(width, height) {
  if (target && target.width === width && target.height === height) return target;
  if (target) { gl.deleteFramebuffer(target.frame); gl.deleteTexture(target.texture); }
  const made = texture(3, gl.TEXTURE_2D, () => gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, width, height));
  const frame = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, made, 0);
  target = { width, height, frame, texture: made };
  return target;
}

/** Renders rows of an image of this size, counted from below. Returns the time in milliseconds. */
async function rowsOf({ pose, fov }, width, height, from, count) {
  targetOf(width, height);
  gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
  gl.viewport(0, 0, width, height);
  gl.scissor(0, from, width, count);
  const column = (c) => [0, 1, 2].map((r) => pose[r][c]);
  gl.uniformMatrix3fv(places("turn"), false, [...column(0), ...column(1), ...column(2)]);
  gl.uniform3fv(places("eye"), column(3));
  gl.uniform2f(places("size"), width, height);
  gl.uniform1f(places("focal"), (0.5 * height) / Math.tan(0.5 * fov * radians));
  const start = performance.now();
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  gl.flush();
  for (;;) {
    const state = gl.clientWaitSync(fence, 0, 0);
    if (state === gl.ALREADY_SIGNALED || state === gl.CONDITION_SATISFIED) break;
    if (state === gl.WAIT_FAILED) throw new Error("The graphics card failed to render.");
    await new Promise((done) => setTimeout(done, 1));
  }
  gl.deleteSync(fence);
  return performance.now() - start;
}

/** Copies the render target to the canvas. */
function show() {
  gl.bindFramebuffer(gl.READ_FRAMEBUFFER, target.frame);
  gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
  gl.scissor(0, 0, picture.width, picture.height);
  gl.blitFramebuffer(0, 0, target.width, target.height, 0, 0, picture.width, picture.height, gl.COLOR_BUFFER_BIT, gl.LINEAR);
}

// ---- progressive rendering ---------------------------------------------------------------------------------------------
/** Estimated rays per millisecond. */
let rate = 500;
/** Number of the newest view, true while rendering, and number of the last complete view. */
let wanted = 0, working = false, whole = -1;

const free = () => {};
function ask() {
  wanted += 1;
  if (!working) work();
}

/** Renders an image in bands of rows. Returns false if a newer view cancelled it. */
async function paint(seen, width, height, piece) {
  const own = wanted;
  let band = Math.max(1, Math.floor((rate * piece) / width)), spent = 0;
  for (let from = 0; from < height;) {
    const count = Math.min(height - from, band);
    const took = Math.max(0.5, await rowsOf(seen, width, height, from, count));
    spent += took;
    from += count;
    // At most twofold growth, as later rows may be slower.
    band = clamp(Math.floor((count * piece) / took), 1, 2 * count);
    if (wanted !== own && piece === PIECE) return false;
  }
  // The rate of the whole image, since rays through empty space are fast.
  rate += 0.5 * ((width * height) / spent - rate);
  return true;
}

async function work() {
  working = true;
  try {
    while (whole !== wanted) {
      const own = wanted, start = performance.now();
      const share = Math.min(devicePixelRatio, 2);
      const [width, height] = [stage.clientWidth, stage.clientHeight].map((side) => Math.max(1, Math.round(side * share)));
      if (picture.width !== width || picture.height !== height) [picture.width, picture.height] = [width, height];
      const seen = { pose: rows(view), fov: view.fov };
      // The largest size that fits the target time.
      const fits = Math.min(1, Math.sqrt((rate * FIRST) / (width * height)));
      const [w, h] = [width, height].map((side) => Math.max(1, Math.floor(side * fits)));
      await paint(seen, w, h, FIRST);
      show();
      tell(`${w}×${h} · ${(performance.now() - start).toFixed(0)} ms${warning}`);
      if (wanted !== own) continue;
      if (fits < 1) {
        if (!(await paint(seen, width, height, PIECE))) continue;
        show();
        tell(`${width}×${height} · ${(performance.now() - start).toFixed(0)} ms${warning}`);
      }
      whole = own;
      stage.dataset.whole = String(whole);
    }
  } catch (error) {
    // The handler of the lost context has its own message.
    if (!gl.isContextLost()) tell(error.message, true);
  }
  working = false;
}

/** RGBA bytes of a render, row by row from above: for tests and other programs. */
async function render(pose, fov, width, height) {
  while (working) await new Promise((done) => setTimeout(done, 10));
  working = true;
  await paint({ pose, fov }, width, height, PIECE);
  working = false;
  gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
  const out = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, out);
  const row = (y) => out.subarray(4 * width * (height - 1 - y), 4 * width * (height - y));
  return Uint8Array.from(Array.from({ length: height }, (_, y) => [...row(y)]).flat());
}

function reset() {
  enter(data.view, stage.clientWidth / stage.clientHeight);
  ask();
}

try {
  begin();
  bounds = data.view.bounds;
  listen(stage);
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "r") reset();
    else if (!steer(event)) return;
    event.preventDefault();
  });
  picture.addEventListener("webglcontextlost", () => tell("The browser lost the graphics card: reload the page.", true));
  document.getElementById("reset").addEventListener("click", reset);
  reset();
  // A page may load before it is shown, in a window of size 0.
  let shown = stage.clientHeight > 0;
  new ResizeObserver(() => {
    if (shown || stage.clientHeight === 0) return ask();
    shown = true;
    reset();
  }).observe(stage);
} catch (error) {
  tell(error.message, true);
}
