"use strict";
const get = id => document.getElementById(id);
const data = JSON.parse(get("data").textContent), byId = new Map(data.instances.map(i => [i.id, i]));
const canvas = get("scene"), search = get("search");
let selected = null, hovered = null, dark = matchMedia("(prefers-color-scheme: dark)").matches;

function make(kind, text, more) {
  const element = document.createElement(kind);
  if (text !== undefined) element.textContent = text;
  return Object.assign(element, more || {});
}

// ---------------------------------------------------------------- the list and its search

const spoken = text => text.toLowerCase().normalize("NFD").replace(/\p{M}/gu, "").split(/[^\p{L}\p{N}#]+/u).filter(Boolean);
const stem = word => word.length > 3 ? word.replace(/(?<=ch|sh|x|ss)es$|(?<!s)s$/, "") : word;
const UNSAID = new Set("a an the is are there where wheres my me i find show please of some any what which do does to".split(" "));
const BEYOND = /\b(on|in|under|near|next|between|above|below|behind|left|right|not|without|how many|closest|largest|biggest|smallest|highest|lowest)\b/i;
const words = new Map(data.instances.map(i => [i.id, [
  [...spoken(i.name), "#" + i.id, String(i.id)], spoken(i.description),
  i.nouns.flatMap(n => data.nouns[n] || []).flatMap(spoken)].map(w => w.map(stem))]));

function rank(id, asked) { // how badly words fit: 0 for the name itself, 1 the description, 2 another word for it
  let worst = 0;
  for (const word of asked) {
    const at = words.get(id).findIndex(said => said.some(s => s === word || (word.length > 2 && s.startsWith(word))));
    if (at < 0) return -1;
    worst = Math.max(worst, at);
  }
  return worst;
}
function find(text) {
  const asked = spoken(text).filter(w => !UNSAID.has(w)).map(stem);
  const ranks = new Map(data.instances.map(i => [i.id, rank(i.id, asked)]));
  return data.instances.filter(i => ranks.get(i.id) >= 0)
    .sort((a, b) => ranks.get(a.id) - ranks.get(b.id) || a.structure - b.structure || b.confidence - a.confidence || a.id - b.id);
}
const rows = new Map();
for (const i of data.instances) {
  const row = make("button", undefined, {type: "button"}), told = make("span", i.name), crop = data.crops[i.id];
  told.appendChild(make("small", [i.id, i.description === i.name ? "" : i.description, i.state].filter(Boolean).join(" \u00b7 ")));
  row.append(crop ? make("img", undefined, {src: "data:image/jpeg;base64," + crop, alt: "", loading: "lazy"}) : make("i"), told);
  row.addEventListener("click", () => select(i.id, true));
  row.addEventListener("pointerenter", () => hover(i.id));
  row.addEventListener("pointerleave", () => hover(null));
  rows.set(i.id, row);
}
function list() {
  const text = search.value.trim(), found = find(text);
  get("list").replaceChildren(...found.map(i => rows.get(i.id)));
  const limits = "This search knows names, other words for them in seven languages, colours and ids. ";
  get("said").textContent = !text ? data.instances.length + " things and surfaces"
    : found.length ? found.length + " found for \u201c" + text + "\u201d" : "Nothing found for \u201c" + text + "\u201d. " + limits
    + (BEYOND.test(text) ? "Where things stand to each other, counts and sizes it cannot answer: list3r find can." : "Empty the field for all.");
  return found;
}
search.addEventListener("input", list);
document.querySelector("form").addEventListener("submit", event => {
  event.preventDefault();
  const found = list();
  select(search.value.trim() && found.length ? found[0].id : null, true);
});

// ---------------------------------------------------------------- selecting

const length = v => data.units === "about m" ? "about " + v.toPrecision(1) : v.toFixed(2);
const unit = data.units.replace("about ", "").replace(/^unit$/, "units");
function select(id, fly) {
  rows.get(selected)?.classList.remove("selected");
  selected = byId.has(id) ? id : null;
  const i = byId.get(selected), about = get("about");
  about.hidden = !i;
  if (i) {
    rows.get(id).classList.add("selected");
    rows.get(id).scrollIntoView({block: "nearest"});
    const known = i.size.every(v => v !== null) && i.center.every(v => v !== null);
    about.replaceChildren(make("b", i.name), make("div", i.description), make("small", (known
      ? i.size.map(length).join(" x ") + " " + unit + ", centre at " + i.center.map(v => v.toFixed(2)).join(", ") + "; " : "")
      + "id " + i.id + ", confidence " + i.confidence.toFixed(2) + (drawn.has(id) ? "" : "; not in the picture: its place against the rest is not known")));
    if (fly && known && drawn.has(id)) flyTo(i);
  }
  draw();
}
function hover(id) {
  if (id === hovered) return;
  rows.get(hovered)?.classList.remove("hovered");
  hovered = byId.has(id) ? id : null;
  rows.get(hovered)?.classList.add("hovered");
  draw();
}

// ---------------------------------------------------------------- the surfaces: triangles, or points where there are none

const cloud = data.cloud, count = cloud.kept, low = cloud.low, span = cloud.span, after = 12 * cloud.faces;
const bytes = Uint8Array.from(atob(get("points").textContent), c => c.charCodeAt(0));
const corner = new Uint32Array(bytes.buffer, 0, 3 * cloud.faces), steps = new Uint16Array(bytes.buffer, after, 3 * count), ink = bytes.subarray(after + 6 * count);
const drawn = new Map();
let start = 0, face = 0;
for (const [id, many, size, faces] of cloud.runs) { drawn.set(id, {start, many, size, face, faces}); start += many; face += faces; }
const gl = canvas.getContext("webgl2", {antialias: true});
if (!gl) { get("broken").hidden = false; get("broken").textContent = "This browser draws no 3D (WebGL is off); the list works without."; }

function program(vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const at = name => gl.getUniformLocation(made, name);
  return {made, place: gl.getAttribLocation(made, "place"), color: gl.getAttribLocation(made, "color"),
    view: at("view"), low: at("low"), span: at("span"), size: at("size"), tint: at("tint"), most: at("most")};
}
const buffer = (kind, content) => { const b = gl.createBuffer(); gl.bindBuffer(kind, b); gl.bufferData(kind, content, gl.STATIC_DRAW); return b; };
const [dots, sheets] = gl ? ["if (length(gl_PointCoord - 0.5) > 0.5) discard; ", ""].map(round => program(
  "attribute vec3 place, color; uniform mat4 view; uniform vec3 low; uniform float span, size, most; varying vec3 ink;" +
  "void main() { gl_Position = view * vec4(low + span * place, 1.0); gl_PointSize = clamp(size / gl_Position.w, 1.5, most); ink = color; }",
  "precision mediump float; uniform vec4 tint; varying vec3 ink;" +
  "void main() { " + round + "gl_FragColor = vec4(mix(ink, tint.rgb, tint.a), 1.0); }")) : [];
const edges = gl && program("attribute vec3 place; uniform mat4 view; void main() { gl_Position = view * vec4(place, 1.0); }",
  "precision mediump float; uniform vec4 tint; void main() { gl_FragColor = vec4(tint.rgb, 1.0); }");
const places = gl && buffer(gl.ARRAY_BUFFER, steps), colors = gl && buffer(gl.ARRAY_BUFFER, ink), box = gl && gl.createBuffer();
const corners = gl && buffer(gl.ELEMENT_ARRAY_BUFFER, corner);
const EDGES = [...Array(8).keys()].flatMap(a => [1, 2, 4].map(bit => [a, a ^ bit])).filter(([a, b]) => a < b).flat();
const HUE = [1, 0.78, 0];

// ---------------------------------------------------------------- the camera: it looks at `eye.at` from `eye.far` away

const add = (a, b, k = 1) => a.map((v, n) => v + k * b[n]), dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const middle = (() => { // of the things, which a far stray point does not move
  const c = data.instances.filter(i => drawn.has(i.id) && i.center.every(v => v !== null)).map(i => i.center);
  return c.length ? [0, 1, 2].map(n => c.reduce((s, v) => s + v[n], 0) / c.length) : low.map(v => v + span / 2);
})();
let eye = {at: middle, far: 0.95 * span, yaw: -2, pitch: 0.95};
const away = e => [Math.cos(e.pitch) * Math.cos(e.yaw), Math.cos(e.pitch) * Math.sin(e.yaw), Math.sin(e.pitch)];
function axes() { const z = away(eye), x = [-Math.sin(eye.yaw), Math.cos(eye.yaw), 0]; return [x, cross(z, x), z]; }
function matrix() {
  const [x, y, z] = axes(), place = add(eye.at, z, eye.far), near = eye.far / 50, far = eye.far + 4 * span;
  const f = 1.7, aspect = canvas.width / canvas.height, a = -(far + near) / (far - near), b = -2 * far * near / (far - near);
  const rows = [[...x.map(v => v * f / aspect), -dot(x, place) * f / aspect], [...y.map(v => v * f), -dot(y, place) * f],
    [...z.map(v => v * a), -dot(z, place) * a + b], [...z.map(v => -v), dot(z, place)]];
  return new Float32Array([0, 1, 2, 3].flatMap(c => rows.map(r => r[c])));
}
let flight = 0;
function flyTo(i) {
  const reach = Math.max(2.5 * Math.hypot(...i.size), 0.12 * span), from = {...eye}, began = performance.now(), mine = ++flight;
  const seen = i.eye && i.eye.every(v => v !== null) ? add(i.eye, i.center, -1) : away(eye), length = Math.hypot(...seen) || 1;
  const to = {at: i.center, far: i.eye ? Math.min(reach, length) : reach, yaw: Math.atan2(seen[1], seen[0]), pitch: Math.asin(Math.min(1, seen[2] / length))};
  to.yaw = from.yaw + Math.atan2(Math.sin(to.yaw - from.yaw), Math.cos(to.yaw - from.yaw));
  const lasts = matchMedia("(prefers-reduced-motion: reduce)").matches ? 1 : 700;
  const step = now => {
    if (mine !== flight) return;
    const t = Math.min(1, Math.max(0, now - began) / lasts), k = t * t * (3 - 2 * t), mix = (a, b) => a + k * (b - a);
    eye = {at: from.at.map((v, n) => mix(v, to.at[n])), far: mix(from.far, to.far), yaw: mix(from.yaw, to.yaw), pitch: mix(from.pitch, to.pitch)};
    draw();
    if (t < 1) requestAnimationFrame(step);
  };
  requestAnimationFrame(step);
}

// ---------------------------------------------------------------- drawing

let waits = false;
function draw() { if (!waits && gl) { waits = true; requestAnimationFrame(() => { waits = false; picture(); }); } }
function surfaces(view, tint) { // one side only: a room is seen from outside through its walls
  gl.enable(gl.CULL_FACE);
  for (const kind of [sheets, dots]) {
    gl.useProgram(kind.made);
    gl.uniformMatrix4fv(kind.view, false, view); gl.uniform3fv(kind.low, low); gl.uniform1f(kind.span, span);
    gl.uniform1f(kind.most, gl.getParameter(gl.ALIASED_POINT_SIZE_RANGE)[1]);
    gl.bindBuffer(gl.ARRAY_BUFFER, places); gl.enableVertexAttribArray(kind.place); gl.vertexAttribPointer(kind.place, 3, gl.UNSIGNED_SHORT, true, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, colors); gl.enableVertexAttribArray(kind.color); gl.vertexAttribPointer(kind.color, 3, gl.UNSIGNED_BYTE, true, 0, 0);
    for (const [id, run] of drawn) {
      if ((kind === sheets) !== run.faces > 0) continue;
      gl.uniform1f(kind.size, run.size * 1.7 * canvas.height / 2);
      gl.uniform4fv(kind.tint, tint(id));
      if (run.faces) gl.drawElements(gl.TRIANGLES, 3 * run.faces, gl.UNSIGNED_INT, 12 * run.face);
      else gl.drawArrays(gl.POINTS, run.start, run.many);
    }
    gl.disableVertexAttribArray(kind.color);
  }
}
function clear(color) {
  gl.viewport(0, 0, canvas.width, canvas.height); gl.enable(gl.DEPTH_TEST);
  gl.clearColor(...color, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
}
function picture() {
  const ratio = Math.min(devicePixelRatio || 1, 2), w = Math.round(canvas.clientWidth * ratio), h = Math.round(canvas.clientHeight * ratio);
  if (!w || !h) return;
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  clear(dark ? [0.09, 0.094, 0.1] : [0.957, 0.957, 0.95]);
  const view = matrix();
  surfaces(view, id => [...HUE, id === selected ? 0.4 : id === hovered ? 0.2 : 0]);
  for (const id of new Set([hovered, selected])) {
    const i = byId.get(id);
    if (!i || !drawn.has(id) || i.corners.some(v => v === null)) continue;
    gl.useProgram(edges.made); gl.uniformMatrix4fv(edges.view, false, view); gl.uniform4fv(edges.tint, [...HUE, 1]);
    gl.bindBuffer(gl.ARRAY_BUFFER, box);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(EDGES.flatMap(n => i.corners.slice(3 * n, 3 * n + 3))), gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(edges.place); gl.vertexAttribPointer(edges.place, 3, gl.FLOAT, false, 0, 0);
    gl.drawArrays(gl.LINES, 0, EDGES.length);
  }
  const i = byId.get(hovered ?? selected), tag = get("name");
  tag.style.display = "none";
  if (i && drawn.has(i.id) && i.corners.every(v => v !== null)) {
    const top = [i.center[0], i.center[1], Math.max(...i.corners.filter((_, n) => n % 3 === 2)), 1];
    const at = [0, 1, 3].map(r => top.reduce((s, v, c) => s + v * view[4 * c + r], 0));
    if (at[2] > 0) {
      tag.textContent = i.name;
      tag.style.cssText = "display:block;left:" + (at[0] / at[2] + 1) * canvas.clientWidth / 2 + "px;top:" + (1 - at[1] / at[2]) * canvas.clientHeight / 2 + "px";
    }
  }
}
function met(event) { // what is under the pointer: the surfaces are drawn with their numbers as colours, and one pixel is read
  const ids = [...drawn.keys()], area = canvas.getBoundingClientRect(), pixel = new Uint8Array(4);
  clear([0, 0, 0]);
  surfaces(matrix(), id => { const n = ids.indexOf(id) + 1; return [(n & 255) / 255, (n >> 8 & 255) / 255, (n >> 16) / 255, 1]; });
  const ratio = canvas.width / area.width;
  gl.readPixels((event.clientX - area.left) * ratio, canvas.height - (event.clientY - area.top) * ratio - 1, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  picture();
  return ids[pixel[0] + 256 * pixel[1] + 65536 * pixel[2] - 1] ?? null;
}

// ---------------------------------------------------------------- pointers, keys, light

const fingers = new Map();
let moved = 0, pinch = 0, rests = 0;
canvas.addEventListener("pointerdown", e => { canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, e); moved = 0; pinch = 0; flight++; });
canvas.addEventListener("pointermove", e => {
  const last = fingers.get(e.pointerId);
  clearTimeout(rests);
  if (!last) { if (gl) rests = setTimeout(() => hover(met(e)), 120); return; }
  const dx = e.clientX - last.clientX, dy = e.clientY - last.clientY;
  fingers.set(e.pointerId, e);
  moved += Math.abs(dx) + Math.abs(dy);
  const [a, b] = [...fingers.values()], apart = b ? Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) : 0;
  if (b && pinch) eye.far *= pinch / Math.max(apart, 1);
  pinch = apart;
  if (b || e.shiftKey || e.buttons & 2) {
    const [x, y] = axes(), k = 1.2 * eye.far / canvas.clientHeight / (b ? 2 : 1);
    eye.at = add(add(eye.at, x, -dx * k), y, dy * k);
  } else { eye.yaw -= dx * 0.007; eye.pitch = Math.max(-1.5, Math.min(1.5, eye.pitch + dy * 0.007)); }
  draw();
});
for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, e => {
  if (end === "pointerup" && fingers.size === 1 && moved < 5 && gl) select(met(e), false);
  fingers.delete(e.pointerId);
});
canvas.addEventListener("pointerleave", () => { clearTimeout(rests); hover(null); });
canvas.addEventListener("contextmenu", e => e.preventDefault());
canvas.addEventListener("wheel", e => { e.preventDefault(); flight++; eye.far = Math.min(6 * span, Math.max(span / 200, eye.far * Math.exp(e.deltaY * 0.0012))); draw(); }, {passive: false});
addEventListener("keydown", e => { if (e.key === "Escape") select(null); });
addEventListener("resize", draw);
function light() { document.documentElement.classList.toggle("dark", dark); draw(); }
get("dark").addEventListener("click", () => { dark = !dark; light(); });
get("facts").textContent = data.lengths + " " + (count < cloud.known ? count.toLocaleString("en") + " of " + cloud.known.toLocaleString("en") + " points of surfaces are in this file."
  : "All " + count.toLocaleString("en") + " points of surfaces are in this file.") + (data.elsewhere ? " " + data.elsewhere + " things lie in parts that are not placed against this one; they are listed, not drawn." : "");
list();
light();
