"use strict";
// Trajectories over the map, and errors over time below, which share pointer and stretch of time.

function unpack(packed) {
  if (packed.v) return packed.v.map((v) => (v === null ? null : v * packed.u));
  let sum = 0;
  return packed.d.map((d) => (sum += d) * packed.u);
}

const unpackAll = (run) => Object.fromEntries(Object.keys(run).map((key) => [key, unpack(run[key])]));

// index of the pose nearest in time
function nearest(t, at) {
  let low = 0, high = t.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (t[middle] < at) low = middle; else high = middle;
  }
  return Math.abs(t[low] - at) <= Math.abs(t[high] - at) ? low : high;
}

// time between two of so many poses above which no line joins them [s]
const longest = (duration, count) => Math.max(5, (6 * duration) / Math.max(1, count));

// errors at so few poses say nothing
const isScored = (track) => track.e.filter((e) => e !== null).length >= 10;

class Tracks {
  constructor(section, logs, names, hidden) {
    this.names = names;
    this.hidden = hidden;
    this.logs = logs;
    this.kind = "causal";
    this.map = section.querySelector(".map");
    this.strips = section.querySelector(".strips");
    this.window = null; // stretch of time that is looked at [s]
    const controls = section.querySelector(".controls");
    this.select = element("select", { "aria-label": "log" }, controls);
    logs.forEach((log, i) => element("option", { value: i }, this.select, log));
    this.select.addEventListener("change", () => this.open(+this.select.value));
    this.kinds = {};
    const group = element("span", { class: "choice", role: "group" }, controls);
    for (const kind of ["causal", "final"]) {
      this.kinds[kind] = element("button", { type: "button" }, group, kind);
      this.kinds[kind].addEventListener("click", () => { this.kind = kind; this.draw(); });
    }
    const zoom = element("span", { class: "choice", role: "group" }, controls);
    for (const [label, factor, title] of [["+", 0.6, "nearer"], ["−", 1 / 0.6, "farther"]]) {
      element("button", { type: "button", title, "aria-label": title }, zoom, label)
        .addEventListener("click", () => this.zoom(factor, this.view.x + this.view.w / 2, this.view.y + this.view.h / 2));
    }
    element("button", { type: "button", "data-reset": "" }, zoom, "all").addEventListener("click", () => this.reset());
    const first = Math.max(0, logs.findIndex((_, i) => { this.load(i); return this.shown().some((run) => isScored(run.causal)); }));
    this.select.value = first;
    this.load(first);
  }

  open(index) {
    this.load(index);
    this.draw();
  }

  load(index) {
    const content = JSON.parse(document.getElementById("track-" + index).textContent);
    this.scene = content.scene;
    this.runs = content.runs.map((run) => ({
      v: run.v, seed: run.seed, causal: run.causal && unpackAll(run.causal), final: run.final && unpackAll(run.final),
    }));
    this.window = null;
    this.view = null;
  }

  reset() {
    this.view = null;
    this.window = null;
    this.draw();
  }

  shown() {
    return this.runs.filter((run) => !this.hidden.has(run.v) && run[this.kind]);
  }

  draw() {
    for (const kind in this.kinds) this.kinds[kind].setAttribute("aria-pressed", kind === this.kind);
    this.drawMap();
    this.drawStrips();
  }

  // of map and reference; of the trajectories where there is neither
  bounds() {
    const xs = [], ys = [];
    const add = (flat) => flat.forEach((v, i) => (i % 2 ? ys : xs).push(v / 1000));
    if (this.scene) [this.scene.walls, ...Object.values(this.layers()), ...this.scene.reference].forEach(add);
    if (!xs.length) for (const run of this.shown()) { xs.push(...run[this.kind].x); ys.push(...run[this.kind].y); }
    if (!xs.length) return [0, 1, 0, 1];
    const least = (a) => a.reduce((p, q) => Math.min(p, q)), most = (a) => a.reduce((p, q) => Math.max(p, q));
    return [least(xs), most(xs), least(ys), most(ys)];
  }

  // things of the map by what they are, but for points, which are too many
  layers() {
    const { walls, reference, points, ...layers } = this.scene;
    return layers;
  }

  drawMap() {
    const width = this.map.clientWidth;
    const [x0, x1, y0, y1] = this.bounds();
    const room = 0.06 * Math.max(x1 - x0, y1 - y0, 1);
    const w = x1 - x0 + 2 * room, h = y1 - y0 + 2 * room;
    const height = Math.round(Math.min(Math.max((width * h) / w, 260), 0.72 * window.innerHeight, 620));
    if (!this.view) {
      const metres = Math.max(w / width, h / height); // a pixel
      this.view = { w: metres * width, h: metres * height, x: (x0 + x1 - metres * width) / 2, y: -(y0 + y1 + metres * height) / 2 };
    }
    this.width = width;
    this.root = svg("svg", { width, height, class: "plan", tabindex: 0, role: "img", "aria-label": "trajectories over the map" });
    this.plan = svg("g", {}, this.root);
    this.drawScene();
    const runs = this.shown();
    runs.forEach((run, k) => {
      const { t, x, y } = run[this.kind];
      const g = svg("g", { class: colour(run.v), "stroke-width": thickness(k, runs.length) }, this.plan);
      const inside = t.map((at) => !this.window || (at >= this.window[0] && at <= this.window[1]));
      if (this.window) svg("path", { d: this.line(t, x, y), class: "line away" }, g);
      svg("path", { d: this.line(t, x.map((v, i) => (inside[i] ? v : null)), y), class: "line" }, g);
    });
    this.cursors = svg("g", {}, this.root);
    this.scaleBar = svg("g", { class: "axes" }, this.root);
    this.place();
    this.listen();
    this.map.replaceChildren(this.root);
  }

  drawScene() {
    if (!this.scene) return;
    const pairs = (flat) => flat.reduce((all, v, i) => (i % 2 ? all[all.length - 1].push(-v / 1000) : all.push([v / 1000]), all), []);
    const g = svg("g", { class: "scene" }, this.plan);
    const join = (points) => "M" + points.map((p) => p[0].toFixed(3) + " " + p[1].toFixed(3)).join("L");
    const points = pairs(this.scene.points || []);
    if (points.length) svg("path", { d: points.map((p) => `M${p[0].toFixed(2)} ${p[1].toFixed(2)}h0`).join(""), class: "points" }, g);
    for (const piece of this.scene.reference) if (piece.length) svg("path", { d: join(pairs(piece)), class: "reference" }, g);
    let walls = "";
    const ends = pairs(this.scene.walls);
    for (let i = 0; i + 1 < ends.length; i += 2) walls += join([ends[i], ends[i + 1]]);
    if (walls) svg("path", { d: walls, class: "walls" }, g);
    this.symbols = svg("g", { class: "symbols" }, this.root);
    this.places = Object.entries(this.layers()).reverse().flatMap(([name, of]) => pairs(of).map((p) => [p, name === "tags" ? "rect" : "path"]));
  }

  // broken where there are no poses for long
  line(t, x, y) {
    const pause = longest(t[t.length - 1] - t[0], t.length);
    let text = "", pen = "M";
    for (let i = 0; i < x.length; i++) {
      if (x[i] === null) { pen = "M"; continue; }
      if (i && t[i] - t[i - 1] > pause) pen = "M";
      text += pen + x[i].toFixed(3) + " " + (-y[i]).toFixed(3);
      pen = "L";
    }
    return text;
  }

  // where metres are in pixels
  place() {
    const k = this.width / this.view.w;
    this.plan.setAttribute("transform", `scale(${k}) translate(${-this.view.x} ${-this.view.y})`);
    if (this.scene && this.symbols) {
      this.symbols.replaceChildren();
      for (const [[x, y], shape] of this.places) {
        const px = (x - this.view.x) * k, py = (y - this.view.y) * k;
        if (shape === "rect") svg("rect", { x: px - 3, y: py - 3, width: 6, height: 6 }, this.symbols);
        else svg("path", { d: `M${px - 4.5} ${py + 3.5}h9l-4.5 -8z` }, this.symbols);
      }
    }
    const power = Math.pow(10, Math.floor(Math.log10(150 / k)));
    const metres = power * [5, 2, 1].find((s) => s * power * k <= 150);
    const bottom = +this.root.getAttribute("height") - 14;
    this.scaleBar.replaceChildren();
    svg("path", { d: `M14 ${bottom - 5}v5h${metres * k}v-5`, class: "ruler" }, this.scaleBar);
    svg("text", { x: 14 + (metres * k) / 2, y: bottom - 6, "text-anchor": "middle" }, this.scaleBar, tickText(metres) + " m");
    this.cursors.replaceChildren();
  }

  zoom(factor, x, y) {
    const v = this.view;
    this.view = { w: v.w * factor, h: v.h * factor, x: x - (x - v.x) * factor, y: y - (y - v.y) * factor };
    this.place();
  }

  listen() {
    const root = this.root, down = new Map();
    const metres = () => this.view.w / this.width;
    const at = (event) => { const r = root.getBoundingClientRect(); return [event.clientX - r.left, event.clientY - r.top]; };
    const inWorld = ([px, py]) => [this.view.x + px * metres(), this.view.y + py * metres()];
    root.addEventListener("wheel", (event) => {
      if (document.activeElement !== root && !event.ctrlKey) return; // the page scrolls until the map is clicked
      event.preventDefault();
      this.zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.004), ...inWorld(at(event)));
    }, { passive: false });
    root.addEventListener("dblclick", () => this.reset());
    root.addEventListener("pointerdown", (event) => { down.set(event.pointerId, at(event)); root.setPointerCapture(event.pointerId); });
    const up = (event) => down.delete(event.pointerId);
    root.addEventListener("pointerup", up);
    root.addEventListener("pointercancel", up);
    root.addEventListener("pointermove", (event) => {
      const now = at(event), before = down.get(event.pointerId);
      if (!before) { this.point(event, inWorld(now), 26 * metres()); return; }
      const other = [...down.entries()].find(([id]) => id !== event.pointerId);
      if (other) {
        const apart = (p) => Math.hypot(p[0] - other[1][0], p[1] - other[1][1]) || 1;
        this.zoom(apart(before) / apart(now), ...inWorld(other[1]));
      } else {
        this.view.x -= (now[0] - before[0]) * metres();
        this.view.y -= (now[1] - before[1]) * metres();
        this.place();
      }
      down.set(event.pointerId, now);
    });
    root.addEventListener("pointerleave", () => this.leave());
  }

  // the pose of any trajectory that is nearest to a place of the map
  point(event, [x, y], reach) {
    let best = null;
    for (const run of this.shown()) {
      const track = run[this.kind];
      for (let i = 0; i < track.t.length; i++) {
        if (this.window && (track.t[i] < this.window[0] || track.t[i] > this.window[1])) continue;
        const far = Math.hypot(track.x[i] - x, -track.y[i] - y);
        if (far < reach) { reach = far; best = { run, i }; }
      }
    }
    if (!best) { this.leave(); return; }
    this.mark(best.run[this.kind].t[best.i]);
    showTip(event, this.tell(best.run, best.i));
  }

  tell(run, i) {
    const k = run[this.kind], at = (list) => (list.length ? list[i] : null);
    const lines = [this.names[run.v], `${number(k.t[i])} s, seed ${run.seed}`, `x ${number(k.x[i])} m, y ${number(k.y[i])} m`];
    if (at(k.e) !== null) lines.push(`error ${number(at(k.e))} m, 2σ ${number(at(k.s))} m`);
    else if (at(k.s) !== null) lines.push(`2σ ${number(at(k.s))} m`);
    if (at(k.h) !== null) lines.push(`heading error ${number(at(k.h))}°, 2σ ${number(at(k.g))}°`);
    return lines;
  }

  // where everyone is at a time
  mark(t) {
    const k = this.width / this.view.w;
    this.cursors.replaceChildren();
    for (const run of this.shown()) {
      const track = run[this.kind], i = nearest(track.t, t);
      const g = svg("g", { class: colour(run.v) }, this.cursors);
      svg("circle", { cx: (track.x[i] - this.view.x) * k, cy: (-track.y[i] - this.view.y) * k, r: 5.5, class: "cursor" }, g);
    }
    for (const strip of this.drawn) {
      strip.cursor.setAttribute("x1", strip.x(t));
      strip.cursor.setAttribute("x2", strip.x(t));
      strip.cursor.style.display = "";
    }
  }

  leave() {
    hideTip();
    this.cursors.replaceChildren();
    for (const strip of this.drawn) strip.cursor.style.display = "none";
  }

  drawStrips() {
    this.strips.replaceChildren();
    this.drawn = [];
    const runs = this.shown().filter((run) => isScored(run[this.kind]));
    if (!runs.length) { element("p", { class: "note" }, this.strips, "No error over time: the log has no reference."); return; }
    const last = Math.max(...runs.map((run) => run[this.kind].t[run[this.kind].t.length - 1]));
    const first = Math.min(...runs.map((run) => run[this.kind].t[0]));
    runs.forEach((run, k) => this.strip(run, this.window || [first, last], k === runs.length - 1));
  }

  // position error of one estimator, over twice its stated standard deviation
  strip(run, [from, to], isLast) {
    const track = run[this.kind], width = this.strips.clientWidth, height = isLast ? 128 : 94;
    const box = { left: 46, right: width - 10, top: 22, bottom: height - (isLast ? 44 : 10) };
    const inside = track.t.map((t, i) => i).filter((i) => track.t[i] >= from && track.t[i] <= to);
    const seen = inside.flatMap((i) => [track.e[i], Math.min(track.s[i] ?? 0, 4 * (track.e[i] ?? 0))]).filter((v) => v !== null);
    const high = seen.length ? 1.1 * seen.reduce((a, b) => Math.max(a, b)) || 1 : 1;
    const x = scale(from, to, box.left, box.right), y = scale(0, high, box.bottom, box.top);
    const root = svg("svg", { width, height, role: "img", "aria-label": "position error over time, " + this.names[run.v] }, this.strips);
    const clip = "clip" + run.v;
    svg("rect", { x: box.left, y: box.top, width: box.right - box.left, height: box.bottom - box.top }, svg("clipPath", { id: clip }, root));
    const g = svg("g", { class: "axes" }, root);
    for (const v of y.ticks(2)) {
      svg("line", { x1: box.left, x2: box.right, y1: y(v), y2: y(v) }, g);
      svg("text", { x: box.left - 6, y: y(v) + 4, "text-anchor": "end" }, g, tickText(v));
    }
    if (isLast) {
      for (const v of x.ticks(Math.max(2, Math.floor(width / 90)))) svg("text", { x: x(v), y: box.bottom + 16, "text-anchor": "middle" }, g, tickText(v));
      svg("text", { x: (box.left + box.right) / 2, y: box.bottom + 34, "text-anchor": "middle", class: "title" }, g, "time from the log's start [s]");
    }
    const data = svg("g", { class: colour(run.v), "clip-path": `url(#${clip})` }, root);
    const known = inside.filter((i) => track.s.length && track.s[i] !== null);
    const band = [[x(track.t[known[0]]), y(0)], ...known.map((i) => [x(track.t[i]), y(track.s[i])]), [x(track.t[known[known.length - 1]]), y(0)]];
    if (known.length) svg("path", { d: path(band) + "Z", class: "sigma" }, data);
    const scored = inside.filter((i) => track.e[i] !== null);
    const pause = longest(to - from, scored.length);
    const line = scored.flatMap((i, k) => [...(k && track.t[i] - track.t[scored[k - 1]] > pause ? [[null, null]] : []), [x(track.t[i]), y(track.e[i])]]);
    svg("path", { d: path(line), class: "line thin" }, data);
    svg("text", { x: box.left, y: 13, class: "label " + colour(run.v) }, root, `${this.names[run.v]}: position error [m], seed ${run.seed}`);
    const cursor = svg("line", { y1: box.top, y2: box.bottom, class: "ref" }, root);
    cursor.style.display = "none";
    this.drawn.push({ cursor, x });
    this.listenStrip(root, run, x, box, [from, to]);
  }

  listenStrip(root, run, x, box, [from, to]) {
    const at = (event) => Math.max(from, Math.min(to, x.inverse(event.clientX - root.getBoundingClientRect().left)));
    let began = null, drawn = null;
    root.addEventListener("pointerdown", (event) => {
      if (event.pointerType === "touch") return; // a finger scrolls the page
      began = at(event);
      drawn = svg("rect", { y: box.top, height: box.bottom - box.top, class: "chosen" }, root);
      root.setPointerCapture(event.pointerId);
    });
    root.addEventListener("pointermove", (event) => {
      const t = at(event), i = nearest(run[this.kind].t, t);
      this.mark(run[this.kind].t[i]);
      showTip(event, this.tell(run, i));
      if (drawn) {
        drawn.setAttribute("x", Math.min(x(began), x(t)));
        drawn.setAttribute("width", Math.abs(x(t) - x(began)));
      }
    });
    root.addEventListener("pointerup", (event) => {
      if (began === null) return;
      const chosen = [began, at(event)].sort((a, b) => a - b);
      began = null;
      drawn.remove();
      drawn = null;
      if (x(chosen[1]) - x(chosen[0]) < 8) return;
      this.window = chosen;
      this.draw();
    });
    root.addEventListener("dblclick", () => { this.window = null; this.draw(); });
    root.addEventListener("pointerleave", () => this.leave());
  }
}
