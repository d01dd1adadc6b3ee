"use strict";

/* Draws the splats of a .splat file with WebGL 2: a quad with a gaussian for each, far ones first.

   scene: width, height, fx, fy, cx, cy in px; position, rotation (camera to world, rows) and focus
   of the first camera; up; near. A drag turns the camera about the focus, a wheel or a pinch moves
   it. While it moves, as many pixels are drawn as the renderer keeps up with. */
function viewSplats(canvas, bytes, scene) {
  const RECORD = 32, WIDTH = 3072, BINS = 65536, STILL = 120, SLOW = 120, FAST = 40;
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
  if (!gl) return false;

  const count = bytes.length / RECORD;
  const floats = new Float32Array(bytes.buffer), centers = new Float32Array(3 * count);
  const rows = Math.max(1, Math.ceil((3 * count) / WIDTH));
  const texels = new Uint32Array(4 * WIDTH * rows), values = new Float32Array(texels.buffer);
  for (let k = 0; k < count; k++) {
    const from = 8 * k, to = 12 * k, byte = RECORD * k;
    const [x, y, z] = floats.subarray(from, from + 3), s = floats.subarray(from + 3, from + 6);
    centers.set([x, y, z], 3 * k);
    const q = [28, 29, 30, 31].map((place) => (bytes[byte + place] - 128) / 128);
    const r = rotationOf(q), cov = [];
    for (const [i, j] of [[0, 0], [0, 1], [0, 2], [1, 1], [1, 2], [2, 2]]) {
      cov.push(r[i][0] * r[j][0] * s[0] ** 2 + r[i][1] * r[j][1] * s[1] ** 2
        + r[i][2] * r[j][2] * s[2] ** 2);
    }
    values.set([x, y, z], to);
    texels[to + 3] = bytes[byte + 24] | (bytes[byte + 25] << 8) | (bytes[byte + 26] << 16)
      | (bytes[byte + 27] << 24);
    values.set(cov, to + 4);
  }

  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return false;
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);
  const places = { view: uniform("view"), eye: uniform("eye"), focal: uniform("focal") };
  places.center = uniform("center");
  places.size = uniform("size");
  gl.uniform1f(uniform("near"), scene.near);
  nearest(gl, gl.createTexture());
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, WIDTH, rows, 0, gl.RGBA_INTEGER,
    gl.UNSIGNED_INT, texels);
  // The order is a texture, not an instance's attribute: a software renderer takes as long for an
  // instance as for hundreds of vertices.
  const orderRows = Math.max(1, Math.ceil(count / 1024)), order = new Uint32Array(1024 * orderRows);
  gl.activeTexture(gl.TEXTURE1);
  nearest(gl, gl.createTexture());
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, 1024, orderRows);
  gl.uniform1i(uniform("order"), 1);
  const corners = new Uint32Array(6 * count);
  for (let k = 0; k < count; k++) {
    [0, 1, 2, 2, 1, 3].forEach((corner, place) => { corners[6 * k + place] = 4 * k + corner; });
  }
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  gl.clearColor(0, 0, 0, 1);

  const bins = new Uint32Array(count);
  const starts = new Uint32Array(BINS + 1), depths = new Float32Array(count);
  function sort(eye, forward) {
    let low = Infinity, high = -Infinity;
    for (let k = 0; k < count; k++) {
      const depth = (centers[3 * k] - eye[0]) * forward[0]
        + (centers[3 * k + 1] - eye[1]) * forward[1] + (centers[3 * k + 2] - eye[2]) * forward[2];
      depths[k] = depth;
      if (depth > scene.near && depth < low) low = depth;
      if (depth > high) high = depth;
    }
    // By the logarithm: near ones are told apart as finely as far ones.
    const step = (BINS - 1) / Math.log(Math.max(high / low, 1 + 1e-6));
    starts.fill(0);
    let visible = 0;
    for (let k = 0; k < count; k++) {
      if (!(depths[k] > scene.near)) { bins[k] = BINS; continue; }
      bins[k] = BINS - 1 - Math.min(BINS - 1, Math.floor(step * Math.log(depths[k] / low)));
      starts[bins[k] + 1]++;
      visible++;
    }
    for (let b = 0; b < BINS; b++) starts[b + 1] += starts[b];
    for (let k = 0; k < count; k++) if (bins[k] < BINS) order[starts[bins[k]]++] = k;
    return visible;
  }

  let yaw = 0, pitch = 0, zoom = 1, timer = 0, asked = false, quick = 0.5;
  const outward = subtract(scene.position, scene.focus);
  const right = scene.rotation.map((row) => row[0]);
  function draw(scale) {
    const turn = multiply(about(scene.up, yaw), about(right, pitch));
    const rotation = multiply(turn, scene.rotation);
    const eye = apply(turn, outward).map((v, k) => scene.focus[k] + zoom * v);
    const w = Math.round(scale * scene.width), h = Math.round(scale * scene.height);
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    gl.viewport(0, 0, w, h);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniform3fv(places.eye, eye);
    gl.uniformMatrix3fv(places.view, false, rotation.flat());  // columns: its transpose
    gl.uniform2f(places.focal, scale * scene.fx, scale * scene.fy);
    gl.uniform2f(places.center, scale * scene.cx, scale * scene.cy);
    gl.uniform2f(places.size, w, h);
    const visible = sort(eye, rotation.map((row) => row[2]));
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 1024, orderRows, gl.RED_INTEGER, gl.UNSIGNED_INT, order);
    gl.drawElements(gl.TRIANGLES, 6 * visible, gl.UNSIGNED_INT, 0);
    // Waits until it is drawn, so that frames do not queue up behind a slow renderer.
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    canvas.dataset.frames = Number(canvas.dataset.frames || 0) + 1;
    canvas.dataset.drawn = scale < 1 ? "quick" : "whole";
  }
  function moved() {
    clearTimeout(timer);
    timer = setTimeout(() => draw(1), STILL);
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      const began = performance.now();
      draw(quick);
      const took = performance.now() - began;
      if (took > SLOW) quick = Math.max(0.2, 0.8 * quick);
      if (took < FAST) quick = Math.min(1, 1.25 * quick);
    });
  }
  function turnBy(x, y) {
    yaw -= x;
    pitch = Math.max(-1.4, Math.min(1.4, pitch - y));
    moved();
  }
  function zoomBy(factor) {
    zoom = Math.max(0.05, Math.min(20, zoom * factor));
    moved();
  }

  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = fingers.get(event.pointerId);
    if (!last) return;
    const now = [event.clientX, event.clientY];
    const other = [...fingers].find(([id]) => id !== event.pointerId);
    fingers.set(event.pointerId, now);
    if (other) {
      const distance = (p) => Math.hypot(p[0] - other[1][0], p[1] - other[1][1]);
      zoomBy(distance(last) / Math.max(1, distance(now)));
    } else {
      const unit = Math.PI / canvas.clientWidth;
      turnBy((now[0] - last[0]) * unit, (now[1] - last[1]) * unit);
    }
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomBy(Math.exp(event.deltaY / 1000));
  }, { passive: false });
  canvas.addEventListener("dblclick", () => {
    [yaw, pitch, zoom] = [0, 0, 1];
    moved();
  });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1],
      ArrowDown: [0, 0.1] }[event.key];
    if (!step) return;
    event.preventDefault();
    turnBy(...step);
  });
  draw(1);
  return true;
}

const VERTEX = `#version 300 es
precision highp float;
precision highp usampler2D;
uniform usampler2D splats, order;
uniform mat3 view;
uniform vec3 eye;
uniform vec2 focal, center, size;
uniform float near;
out vec2 corner;
out vec4 color;
void main() {
  gl_Position = vec4(0, 0, 2, 1);  // outside: not drawn
  int number = gl_VertexID >> 2;
  uint index = texelFetch(order, ivec2(number & 1023, number >> 10), 0).x;
  ivec2 place = ivec2(int(index & 1023u) * 3, int(index >> 10));
  uvec4 first = texelFetch(splats, place, 0);
  vec4 a = uintBitsToFloat(texelFetch(splats, place + ivec2(1, 0), 0));
  vec2 b = uintBitsToFloat(texelFetch(splats, place + ivec2(2, 0), 0).xy);
  vec3 p = view * (uintBitsToFloat(first.xyz) - eye);
  color = vec4(uvec4(first.w, first.w >> 8, first.w >> 16, first.w >> 24) & 255u) / 255.0;
  if (p.z < near || color.a < 1.5 / 255.0) return;
  mat3 covariance = mat3(a.x, a.y, a.z, a.y, a.w, b.x, a.z, b.x, b.y);
  vec2 most = 1.3 * max(center, size - center) / focal, q = clamp(p.xy / p.z, -most, most);
  mat3 J = mat3(focal.x, 0, 0, 0, focal.y, 0, -focal * q, 0) / p.z;
  mat3 T = J * view, S = T * covariance * transpose(T);
  float x = S[0][0] + 0.3, y = S[1][1] + 0.3, xy = S[0][1];  // at least about a pixel wide
  float mean = 0.5 * (x + y), away = length(vec2(0.5 * (x - y), xy));
  vec2 axis = away < 1e-9 ? vec2(1, 0)
    : x > y ? vec2(0.5 * (x - y) + away, xy) : vec2(xy, 0.5 * (y - x) + away);
  axis = normalize(axis);
  float reach = sqrt(2.0 * log(255.0 * color.a));  // fainter than a step of a byte beyond
  vec2 sigma = sqrt(vec2(mean + away, max(mean - away, 0.1)));
  corner = reach * vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - reach;
  vec2 pixel = center + focal * p.xy / p.z
    + corner.x * sigma.x * axis + corner.y * sigma.y * vec2(-axis.y, axis.x);
  gl_Position = vec4(2.0 * pixel / size - 1.0, 0, 1) * vec4(1, -1, 1, 1);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 corner;
in vec4 color;
out vec4 result;
void main() {
  float alpha = color.a * exp(-0.5 * dot(corner, corner));
  result = vec4(color.rgb * alpha, alpha);
}`;

function nearest(gl, texture) {
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
}

function rotationOf([w, x, y, z]) {
  const n = 2 / (w * w + x * x + y * y + z * z);
  return [
    [1 - n * (y * y + z * z), n * (x * y - w * z), n * (x * z + w * y)],
    [n * (x * y + w * z), 1 - n * (x * x + z * z), n * (y * z - w * x)],
    [n * (x * z - w * y), n * (y * z + w * x), 1 - n * (x * x + y * y)],
  ];
}

/* The rotation by an angle about a unit vector. */
function about([x, y, z], angle) {
  const s = Math.sin(angle / 2);
  return rotationOf([Math.cos(angle / 2), s * x, s * y, s * z]);
}

const apply = (m, v) => m.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
const multiply = (a, b) =>
  a.map((row) => [0, 1, 2].map((k) => row[0] * b[0][k] + row[1] * b[1][k] + row[2] * b[2][k]));
const subtract = (a, b) => a.map((v, k) => v - b[k]);
