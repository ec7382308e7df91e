"use strict";
// The viewer of trajectories: a map, and errors over time below, which share pointer and interval of time.
// Texts enter as text nodes alone: no name of a log can become markup.

const SVG = "http://www.w3.org/2000/svg";

function filled(made, attributes, parent, text) {
  for (const key in attributes) made.setAttribute(key, attributes[key]);
  if (text !== undefined) made.textContent = text;
  if (parent) parent.appendChild(made);
  return made;
}

const svg = (name, attributes, parent, text) => filled(document.createElementNS(SVG, name), attributes, parent, text);
const element = (name, attributes, parent, text) => filled(document.createElement(name), attributes, parent, text);

const colour = (v) => "c" + (v % 7) + (v >= 7 ? " d" + (Math.floor(v / 7) % 3) : "");

// numbers that are 1, 2 or 5 times a power of ten apart, about `count` of them
function ticks(low, high, count) {
  const rough = (high - low) / count, power = Math.pow(10, Math.floor(Math.log10(rough)));
  const step = power * [1, 2, 5, 10].find((s) => s * power >= rough * 0.999);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i <= high / step + 1e-9; i++) found.push(+(i * step).toPrecision(12));
  return found;
}

// maps the interval from low to high to that between two pixels
const scale = (low, high, from, to) => (value) => from + ((value - low) / (high - low || 1)) * (to - from);

// index of the first pose at a time or later
function poseAt(t, time) {
  const i = t.findIndex((at) => at >= time);
  return i < 0 ? t.length - 1 : i;
}

// a line through points [t, x, y], broken where there are none for long
function path(points) {
  const pause = points.length ? Math.max(5, (6 * (points.at(-1)[0] - points[0][0])) / points.length) : 0;
  return points
    .map(([t, x, y], i) => `${i && t - points[i - 1][0] <= pause ? "L" : "M"}${x.toFixed(3)} ${y.toFixed(3)}`)
    .join("");
}

class Viewer {
  constructor(section, { variants, logs, shown }) {
    this.names = variants;
    this.hidden = new Set(variants.map((_, v) => v).filter((v) => v >= shown));
    this.kind = "causal";
    this.map = section.querySelector(".map");
    this.strips = section.querySelector(".strips");
    this.chips = variants.map((name, v) => this.chip(section.querySelector(".legend"), name, v));
    const controls = section.querySelector(".controls");
    const select = element("select", { "aria-label": "log" }, controls);
    logs.forEach((log, i) => element("option", { value: i }, select, log));
    select.addEventListener("change", () => this.open(select.value));
    this.kinds = this.buttons(controls, ["causal", "final"], (kind) => { this.kind = kind; this.draw(); });
    this.buttons(controls, ["+", "−", "all"], (name) => {
      if (name === "all") this.reset();
      else this.zoom(name === "+" ? 0.6 : 1 / 0.6, this.view.x + this.view.w / 2, this.view.y - this.view.h / 2);
    });
    this.open(0);
  }

  // a button that hides and shows an estimator
  chip(legend, name, v) {
    const button = element("button", { type: "button", class: "chip" }, legend);
    element("i", { class: "key " + colour(v) }, button);
    element("span", {}, button, name);
    button.addEventListener("click", () => {
      if (!this.hidden.delete(v)) this.hidden.add(v);
      this.draw();
    });
    return button;
  }

  buttons(controls, names, onClick) {
    const group = element("span", { class: "choice", role: "group" }, controls);
    return names.map((name) => {
      const button = element("button", { type: "button" }, group, name);
      button.addEventListener("click", () => onClick(name));
      return button;
    });
  }

  open(index) {
    Object.assign(this, JSON.parse(document.getElementById("track-" + index).textContent)); // scene and runs
    this.reset();
  }

  reset() {
    this.view = null; // what the map shows [m]: left edge x, upper edge y, width, height
    this.window = null; // the chosen interval of time [s]
    this.draw();
  }

  draw() {
    this.chips.forEach((chip, v) => chip.setAttribute("aria-pressed", !this.hidden.has(v)));
    for (const button of this.kinds) button.setAttribute("aria-pressed", button.textContent === this.kind);
    this.shown = this.runs
      .filter((run) => !this.hidden.has(run.v) && run[this.kind])
      .map((run) => ({ ...run[this.kind], colour: colour(run.v), title: `${this.names[run.v]}, seed ${run.seed}` }));
    this.drawMap();
    this.drawStrips();
  }

  isInside(t) {
    return !this.window || (t >= this.window[0] && t <= this.window[1]);
  }

  // corners of map and reference; of the trajectories where there is neither
  bounds() {
    const { walls, reference, layers } = this.scene || { walls: [], reference: [], layers: {} };
    const { points, ...near } = layers; // points may be far away
    const ends = walls.flatMap(([a, b, c, d]) => [[a, b], [c, d]]);
    const known = [...ends, ...reference.flat(), ...Object.values(near).flat()];
    const places = known.length ? known : this.shown.flatMap((run) => run.x.map((x, i) => [x, run.y[i]]));
    const least = (axis) => places.reduce((low, place) => Math.min(low, place[axis]), Infinity);
    const most = (axis) => places.reduce((high, place) => Math.max(high, place[axis]), -Infinity);
    return places.length ? [least(0), most(0), least(1), most(1)] : [0, 1, 0, 1];
  }

  drawMap() {
    const width = this.map.clientWidth;
    if (!this.view) {
      const [x0, x1, y0, y1] = this.bounds();
      const w = 1.12 * Math.max(x1 - x0, 1), h = 1.12 * Math.max(y1 - y0, 1);
      this.height = Math.min(Math.max((width * h) / w, 260), 0.72 * window.innerHeight, 620);
      const metres = Math.max(w / width, h / this.height); // of a pixel
      this.view = { w: metres * width, h: metres * this.height };
      this.view.x = (x0 + x1 - this.view.w) / 2;
      this.view.y = (y0 + y1 + this.view.h) / 2;
    }
    this.width = width;
    this.root = svg("svg", { width, height: this.height, class: "plan", tabindex: 0, "aria-label": "map" });
    this.plan = svg("g", {}, this.root);
    if (this.scene) this.drawScene();
    this.shown.forEach((run, k) => {
      // the first ones are broader, so that they show below those that lie on them
      const breadth = 1.6 + 0.7 * Math.min(3, this.shown.length - 1 - k);
      const g = svg("g", { class: run.colour, "stroke-width": breadth }, this.plan);
      const points = run.t.map((t, i) => [t, run.x[i], run.y[i]]);
      if (this.window) svg("path", { d: path(points), class: "line away" }, g);
      svg("path", { d: path(points.filter(([t]) => this.isInside(t))), class: "line" }, g);
    });
    for (const run of this.shown) run.cursor = svg("path", { class: "cursor " + run.colour }, this.plan);
    this.ruler = svg("path", { class: "ruler" }, this.root);
    this.rule = svg("text", { x: 18, y: this.height - 20 }, this.root);
    this.place();
    this.listen();
    this.map.replaceChildren(this.root);
  }

  drawScene() {
    const g = svg("g", { class: "scene" }, this.plan);
    const { walls, reference, layers } = this.scene;
    const draw = (name, d) => svg("path", { d, class: name }, g);
    for (const piece of reference) draw("reference", "M" + piece.map((p) => p.join(" ")).join("L"));
    draw("walls", walls.map(([a, b, c, d]) => `M${a} ${b}L${c} ${d}`).join(""));
    for (const name in layers) draw(name, layers[name].map((p) => `M${p.join(" ")}h0`).join(""));
  }

  // where metres are in pixels
  place() {
    const k = this.width / this.view.w;
    this.plan.setAttribute("transform", `scale(${k} ${-k}) translate(${-this.view.x} ${-this.view.y})`);
    const power = Math.pow(10, Math.floor(Math.log10(150 / k)));
    const metres = power * [5, 2, 1].find((s) => s * power * k <= 150);
    this.ruler.setAttribute("d", `M14 ${this.height - 19}v5h${metres * k}v-5`);
    this.rule.textContent = `${+metres.toPrecision(1)} m`;
  }

  zoom(factor, x, y) {
    const { w, h } = this.view;
    this.view = { w: w * factor, h: h * factor, x: x - (x - this.view.x) * factor, y: y - (y - this.view.y) * factor };
    this.place();
  }

  listen() {
    const root = this.root;
    let before = null;
    const place = (event) => {
      const edge = root.getBoundingClientRect(), metres = this.view.w / this.width;
      return [this.view.x + (event.clientX - edge.left) * metres, this.view.y - (event.clientY - edge.top) * metres];
    };
    root.addEventListener("wheel", (event) => {
      if (document.activeElement !== root && !event.ctrlKey) return; // the page scrolls until the map is clicked
      event.preventDefault();
      this.zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.004), ...place(event));
    }, { passive: false });
    root.addEventListener("dblclick", () => this.reset());
    root.addEventListener("pointerdown", (event) => {
      before = place(event);
      root.setPointerCapture(event.pointerId);
    });
    root.addEventListener("pointerup", () => { before = null; });
    root.addEventListener("pointermove", (event) => {
      const [x, y] = place(event);
      if (!before) { this.point(x, y); return; }
      this.view.x -= x - before[0];
      this.view.y -= y - before[1];
      this.place();
    });
    root.addEventListener("pointerleave", () => this.leave());
  }

  // mark the time of the pose that is nearest to a place of the map
  point(x, y) {
    let reach = (26 * this.view.w) / this.width, time = null;
    for (const run of this.shown) {
      run.t.forEach((t, i) => {
        const far = Math.hypot(run.x[i] - x, run.y[i] - y);
        if (far < reach && this.isInside(t)) { reach = far; time = t; }
      });
    }
    if (time === null) this.leave();
    else this.mark(time);
  }

  // where everyone is at a time, and with which error
  mark(time) {
    for (const run of this.shown) {
      const i = poseAt(run.t, time);
      run.cursor.setAttribute("d", `M${run.x[i]} ${run.y[i]}h0`);
      if (!run.label) continue;
      const [error, sigma] = [run.e[i], run.s[i]].map((v) => (v === null ? "–" : v.toFixed(3)));
      run.label.textContent = `${run.title}: ${run.t[i].toFixed(1)} s, error ${error} m, 2σ ${sigma} m`;
      run.line.setAttribute("d", `M${run.across(time)} 22v62`);
    }
  }

  leave() {
    for (const run of this.shown) {
      run.cursor.removeAttribute("d");
      if (!run.label) continue;
      run.label.textContent = `${run.title}: position error [m]`;
      run.line.removeAttribute("d");
    }
  }

  drawStrips() {
    this.strips.replaceChildren();
    const runs = this.shown.filter((run) => run.e.filter((e) => e !== null).length >= 10);
    if (!runs.length) {
      element("p", { class: "note" }, this.strips, "No error over time: the log has no reference.");
      return;
    }
    const last = Math.max(...runs.map((run) => run.t.at(-1)));
    const range = this.window || [Math.min(...runs.map((run) => run.t[0])), last];
    for (const run of runs) this.strip(run, range);
    const width = this.strips.clientWidth, x = scale(...range, 46, width - 10);
    const root = svg("svg", { width, height: 40 }, this.strips);
    for (const t of ticks(...range, width / 90)) svg("text", { x: x(t), y: 12, "text-anchor": "middle" }, root, t);
    svg("text", { x: width / 2, y: 32, "text-anchor": "middle" }, root, "time from the log's start [s]");
    this.leave();
  }

  // position error of one estimator, over twice its stated standard deviation
  strip(run, range) {
    const width = this.strips.clientWidth, left = 46, right = width - 10, top = 22, bottom = 84;
    const points = run.t.map((t, i) => [t, run.e[i], run.s[i]]).filter(([t]) => t >= range[0] && t <= range[1]);
    const scored = points.filter(([, e]) => e !== null), stated = points.filter(([, , s]) => s !== null);
    // areas far above the errors are cut off
    const high = 1.1 * scored.reduce((most, [, e, s]) => Math.max(most, e, Math.min(s, 4 * e)), 0) || 1;
    const x = scale(...range, left, right), y = scale(0, high, bottom, top);
    const root = svg("svg", { width, height: 90, "aria-label": "position error over time" }, this.strips);
    for (const v of ticks(0, high, 2)) {
      svg("path", { d: `M${left} ${y(v)}H${right}`, class: "grid" }, root);
      svg("text", { x: left - 6, y: y(v) + 4, "text-anchor": "end" }, root, v);
    }
    const inner = svg("svg", { x: left, y: top, width: right - left, height: bottom - top, class: run.colour }, root);
    inner.setAttribute("viewBox", `${left} ${top} ${right - left} ${bottom - top}`);
    const area = stated.map(([t, , s]) => `${x(t)} ${y(s)}`).join("L");
    if (area) svg("path", { d: `M${x(stated[0][0])} ${bottom}L${area}V${bottom}Z`, class: "sigma" }, inner);
    svg("path", { d: path(scored.map(([t, e]) => [t, x(t), y(e)])), class: "line thin" }, inner);
    run.label = svg("text", { x: left, y: 13, class: "label" }, root);
    run.line = svg("path", { class: "marked" }, root);
    run.across = x;
    this.listenStrip(root, range, x);
  }

  listenStrip(root, [from, to], x) {
    const back = scale(x(from), x(to), from, to);
    const timeAt = (event) => Math.max(from, Math.min(to, back(event.clientX - root.getBoundingClientRect().left)));
    const chosen = svg("rect", { y: 22, height: 62, class: "chosen" }, root);
    let began = null;
    root.addEventListener("pointerdown", (event) => {
      if (event.pointerType === "touch") return; // a finger scrolls the page
      began = timeAt(event);
      root.setPointerCapture(event.pointerId);
    });
    root.addEventListener("pointermove", (event) => {
      const time = timeAt(event);
      this.mark(time);
      if (began === null) return;
      chosen.setAttribute("x", Math.min(x(began), x(time)));
      chosen.setAttribute("width", Math.abs(x(time) - x(began)));
    });
    root.addEventListener("pointerup", (event) => {
      const times = [began, timeAt(event)].sort((a, b) => a - b);
      if (began !== null && x(times[1]) - x(times[0]) >= 8) { this.window = times; this.draw(); }
      began = null;
      chosen.removeAttribute("width");
    });
    root.addEventListener("dblclick", () => { this.window = null; this.draw(); });
    root.addEventListener("pointerleave", () => this.leave());
  }
}

const content = JSON.parse(document.getElementById("viewer").textContent);
const viewer = new Viewer(document.getElementById("trajectories"), content);
let width = window.innerWidth;
window.addEventListener("resize", () => {
  if (window.innerWidth === width) return; // a phone's bars come and go
  width = window.innerWidth;
  viewer.reset();
});
