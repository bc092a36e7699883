#version 300 es
// Renders one pixel as raygrad does. The script inserts definitions of the names in capitals before this.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler3D;

uniform sampler2D table, weights;
uniform usampler3D words;
uniform ivec4 levels[LEVELS];
uniform mat3 turn;
uniform vec3 eye, background, gain;
uniform vec2 size;
uniform float focal;
uniform vec3 low, high, middle, across, boxLow, boxHigh;
uniform mat3 axes;
uniform vec2 span;
uniform float scale, stepLength, cone, termination, budget, shift;
uniform int resolution, cascades;

out vec4 result;

const int WIDTH = LEVELS * FEATURES;
const int IN4 = (WIDTH + 3) / 4, HIDDEN4 = (HIDDEN + 3) / 4, OUT4 = (OUT + 3) / 4;
const int SEEN4 = (OUT + DEGREE * DEGREE + 3) / 4, COLOR4 = (COLOR + 3) / 4;

vec4 weight(int i) { return texelFetch(weights, ivec2(i & 1023, i >> 10), 0); }

/// Maps a position to the unit cube.
vec3 cube(vec3 p) {
#if SPACE == 0
  return (p - middle) * scale;
#elif SPACE == 1
  vec3 x = (p - middle) * scale;
  float most = max(abs(x.x), max(abs(x.y), abs(x.z)));
  float r = most > 1e-30 ? most * length(x / most) : 0.0;
  if (r > 1.0) x *= (2.0 - 1.0 / min(r, 1e4)) / r;
  return 0.25 * x + 0.5;
#else
  vec3 local = transpose(axes) * (p - middle) * across;
  float depth = max(-local.z, 1.0);
  return vec3(local.xy / depth + 0.5, 1.0 - 1.0 / depth);
#endif
}

/// The hash grid features of a position, level by level.
void encode(vec3 p, out vec4 x[IN4]) {
  p = clamp(p, 0.0, 1.0);
  for (int i = 0; i < IN4; i++) x[i] = vec4(0.0);
  for (int l = 0; l < LEVELS; l++) {
    ivec4 level = levels[l];
    vec3 at = p * float(level.x);
    ivec3 cell = min(ivec3(at), ivec3(level.x - 1));
    vec3 place = at - vec3(cell);
    uvec3 stride = level.y == 1 ? uvec3(1u, 2654435761u, 805459861u) : uvec3(1u, uint(level.x + 1), uint(level.x + 1) * uint(level.x + 1));
    for (int corner = 0; corner < 8; corner++) {
      ivec3 side = ivec3(corner & 1, corner >> 1 & 1, corner >> 2);
      uvec3 step3 = uvec3(cell + side) * stride;
      uint row = level.y == 1 ? (step3.x ^ step3.y ^ step3.z) & uint(level.w) : step3.x + step3.y + step3.z;
      vec3 near = mix(1.0 - place, place, vec3(side));
      float share = near.x * (near.y * near.z);
      int texel = (level.z + int(row)) * TEXELS;
      for (int k = 0; k < TEXELS; k++) {
        vec4 value = share * texelFetch(table, ivec2((texel + k) & (TABLE_WIDTH - 1), (texel + k) >> TABLE_SHIFT), 0);
#if FEATURES >= 4
        x[l * TEXELS + k] += value;
#elif FEATURES == 2
        if ((l & 1) == 0) x[l >> 1].xy += value.xy; else x[l >> 1].zw += value.xy;
#else
        x[l >> 2][l & 3] += value.x;
#endif
      }
    }
  }
}

/// The real spherical harmonics of a direction, in the order of `SphericalHarmonics`.
void harmonics(vec3 d, out float y[16]) {
  float x = d.x, w = d.y, z = d.z, zz = z * z, five = 5.0 * zz, apart = x * x - w * w;
  y[0] = 0.28209479177387814;
  y[1] = -0.4886025119029199 * w;
  y[2] = 0.4886025119029199 * z;
  y[3] = -0.4886025119029199 * x;
  y[4] = 1.0925484305920792 * x * w;
  y[5] = -1.0925484305920792 * w * z;
  y[6] = 0.31539156525252005 * (3.0 * zz - 1.0);
  y[7] = -1.0925484305920792 * x * z;
  y[8] = 0.5462742152960396 * apart;
  y[9] = -0.5900435899266435 * w * (3.0 * x * x - w * w);
  y[10] = 2.890611442640554 * x * w * z;
  y[11] = -0.4570457994644658 * w * (five - 1.0);
  y[12] = 0.3731763325901154 * z * (five - 3.0);
  y[13] = -0.4570457994644658 * x * (five - 1.0);
  y[14] = 1.445305721320277 * z * apart;
  y[15] = -0.5900435899266435 * x * (x * x - 3.0 * w * w);
}

/// A layer without biases. Its weights start at `first`.
#define LAYER(NAME, IN, OUTS) \
void NAME(vec4 x[IN], int first, out vec4 y[OUTS]) { \
  for (int o = 0; o < OUTS; o++) { \
    vec4 sum = vec4(0.0); \
    for (int i = 0; i < IN; i++) { \
      int at = first + 4 * i * OUTS + o; \
      sum += x[i].x * weight(at) + x[i].y * weight(at + OUTS) + x[i].z * weight(at + 2 * OUTS) + x[i].w * weight(at + 3 * OUTS); \
    } \
    y[o] = sum; \
  } \
}

LAYER(hidden0, IN4, HIDDEN4)
LAYER(hidden1, HIDDEN4, OUT4)
LAYER(color0, SEEN4, COLOR4)
LAYER(colors, COLOR4, COLOR4)
LAYER(color3, COLOR4, 1)

const int SECOND = 4 * IN4 * HIDDEN4;
const int ADDED = SECOND + 4 * HIDDEN4 * OUT4;
const int FIRST_COLOR = ADDED + 4 * COLOR4;
const int NEXT_COLOR = FIRST_COLOR + 4 * SEEN4 * COLOR4;

/// The outputs of the density MLP at a position. The first one is the log density.
void features(vec3 p, out vec4 f[OUT4]) {
  vec4 x[IN4];
  vec4 h[HIDDEN4];
  encode(cube(p), x);
  hidden0(x, 0, h);
  for (int i = 0; i < HIDDEN4; i++) h[i] = max(h[i], 0.0);
  hidden1(h, SECOND, f);
}

vec3 shade(vec4 f[OUT4], vec4 direction[4]) {
  vec4 seen[SEEN4];
#if OUT % 4 == 0
  for (int i = 0; i < SEEN4; i++) seen[i] = i < OUT4 ? f[min(i, OUT4 - 1)] : direction[min(i - OUT4, 3)];
#else
  for (int i = 0; i < 4 * SEEN4; i++) {
    int j = i - OUT;
    seen[i >> 2][i & 3] = i < OUT ? f[i >> 2][i & 3] : j < DEGREE * DEGREE ? direction[j >> 2][j & 3] : 0.0;
  }
#endif
  vec4 a[COLOR4], b[COLOR4];
  color0(seen, FIRST_COLOR, a);
  for (int i = 0; i < COLOR4; i++) a[i] = max(a[i] + weight(ADDED + i), 0.0);
  int first = NEXT_COLOR;
  for (int l = 1; l < DEPTH; l++) {
    colors(a, first, b);
    for (int i = 0; i < COLOR4; i++) a[i] = max(b[i], 0.0);
    first += 4 * COLOR4 * COLOR4;
  }
  vec4 last[1];
  color3(a, first, last);
  return 1.0 / (1.0 + exp(-last[0].rgb));
}

void main() {
  vec2 at = (gl_FragCoord.xy - 0.5 * size) / focal;
  vec3 direction = normalize(turn * vec3(at, -1.0));
  vec3 inverse = 1.0 / mix(direction, vec3(1e-20), vec3(lessThan(abs(direction), vec3(1e-20))));
  // Interval of the ray within the box.
  vec3 a = (low - eye) * inverse, b = (high - eye) * inverse;
  vec3 enter = min(a, b), leave = max(a, b);
  float near = max(max(enter.x, enter.y), max(enter.z, span.x));
  float far = min(min(leave.x, leave.y), min(leave.z, span.y));
  vec4 harmonic[4];
  float y[16];
  harmonics(direction, y);
  for (int i = 0; i < 16; i++) harmonic[i >> 2][i & 3] = y[i];
  vec3 sum = vec3(0.0);
  float light = 1.0, weightSum = 0.0, uncolored = 0.0;
  float fromNear = stepLength + cone * near;
  float start = near + 0.5 * fromNear;
  float fromStart = stepLength + cone * start;
  vec3 centre = 0.5 * (boxLow + boxHigh), half3 = 0.5 * (boxHigh - boxLow);
  float cells = float(resolution);
  bool ended = false;
  int i = 0;
  for (int round = 0; round < 65536; round++) {
    float growth = cone > 0.0 ? (exp(float(i) * log(1.0 + cone)) - 1.0) / cone : float(i);
    float t = start + fromStart * growth;
    if (!(t < far)) break;
    vec3 p = eye + t * direction;
    vec3 away = abs(p - centre) / half3;
    float most = max(away.x, max(away.y, away.z));
    float cascade = most <= 1.0 ? 0.0 : ceil(log2(most));
    if (cascade > float(cascades - 1)) { if (most > exp2(float(cascades - 1)) * 1.0001) break; cascade = float(cascades - 1); }
    float larger = exp2(cascade);
    vec3 share = (p - centre) / (half3 * larger) * 0.5 + 0.5;
    ivec3 cell = clamp(ivec3(share * cells), ivec3(0), ivec3(resolution - 1));
    ivec3 block = cell >> 2;
    uvec2 word = texelFetch(words, ivec3(block.xy, block.z + int(cascade) * (resolution >> 2)), 0).xy;
    if ((word.x | word.y) == 0u) {
      // Skips the empty block, to the first step after it.
      vec3 side = vec3(block + ivec3(greaterThan(direction, vec3(0.0)))) * 4.0 / cells;
      vec3 faces = (((side - 0.5) * 2.0 * half3 * larger + centre) - eye) * inverse;
      float beyond = min(faces.x, min(faces.y, faces.z)) - start;
      float steps = cone > 0.0 ? log(max(1.0 + cone * beyond / fromStart, 1.0)) / log(1.0 + cone) : beyond / fromStart;
      i = max(i + 1, int(ceil(steps - 1e-3)));
      continue;
    }
    ivec3 inside = cell & 3;
    int bit = inside.x + 4 * inside.y + 16 * inside.z;
    uint part = bit < 32 ? word.x : word.y;
    float width = cone > 0.0 ? fromNear * (1.0 + cone * growth) : stepLength;
    i++;
    if ((part >> uint(bit & 31) & 1u) == 0u) continue;
    vec4 f[OUT4];
    features(p, f);
    float sigma = exp(min(f[0].x - shift, 60.0));
    float weight = light * (1.0 - exp(-min(sigma * width, 1e4)));
    light *= exp(-min(sigma * width, 1e4));
    weightSum += weight;
    // Samples with small weights get no colour query, within the budget.
    if (weight <= 0.0 || (uncolored + weight <= budget && 4.0 * weight <= budget)) uncolored += weight;
    else sum += weight * shade(f, harmonic);
    if (light <= termination) { ended = true; break; }
  }
  float colored = weightSum - uncolored;
  if (colored > 0.0) {
    sum *= (ended ? 1.0 : weightSum) / colored;
    if (ended) light = 0.0;
  }
  result = vec4(min(sum * gain, 1.0 - light) + light * background, 1.0);
}
