"use strict";
// Axes, lines and dots as SVG. Texts enter as text nodes alone: nothing that a log brings along can become markup.

const SVG = "http://www.w3.org/2000/svg";

function svg(name, attributes, parent, text) {
  const made = document.createElementNS(SVG, name);
  for (const key in attributes) made.setAttribute(key, attributes[key]);
  if (text !== undefined) made.textContent = text;
  if (parent) parent.appendChild(made);
  return made;
}

function element(name, attributes, parent, text) {
  const made = document.createElement(name);
  for (const key in attributes) made.setAttribute(key, attributes[key]);
  if (text !== undefined) made.textContent = text;
  if (parent) parent.appendChild(made);
  return made;
}

// whole numbers in groups of three digits, as in the tables
function grouped(text) {
  return /^\d+$/.test(text) ? text.replace(/\B(?=(\d{3})+$)/g, "\u202f") : text;
}

// three digits that say something
function number(value) {
  if (value === null || !isFinite(value)) return "–";
  if (value === 0) return "0";
  const digits = Math.min(6, Math.max(0, 2 - Math.floor(Math.log10(Math.abs(value)))));
  return (value < 0 ? "\u2212" : "") + grouped(Math.abs(value).toFixed(digits));
}

function tickText(value) {
  if (value === 0) return "0";
  const size = Math.abs(value);
  const text = size >= 1e5 || size < 1e-4 ? size.toExponential(0).replace("e", "·10^") : grouped(String(+size.toPrecision(4)));
  return (value < 0 ? "\u2212" : "") + text;
}

function linearTicks(low, high, count) {
  const rough = (high - low) / Math.max(1, count);
  const power = Math.pow(10, Math.floor(Math.log10(rough)));
  const step = power * [1, 2, 5, 10].find((s) => s * power >= rough * 0.999);
  const ticks = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) ticks.push(+(i * step).toPrecision(12));
  return ticks;
}

function logTicks(low, high, count) {
  const decades = Math.log10(high / low);
  const steps = decades > count ? [1] : decades > count / 2 ? [1, 3] : [1, 2, 5];
  const skip = Math.max(1, Math.ceil(decades / count));
  const ticks = [];
  for (let d = Math.floor(Math.log10(low)); d <= Math.ceil(Math.log10(high)); d++) {
    if (steps.length === 1 && d % skip) continue;
    for (const s of steps) {
      const value = s * Math.pow(10, d);
      if (value >= low * 0.999 && value <= high * 1.001) ticks.push(+value.toPrecision(6));
    }
  }
  return ticks.length > 1 ? ticks : linearTicks(low, high, count).filter((v) => v > 0);
}

// maps values to pixels
function scale(low, high, from, to, log) {
  const f = log ? (v) => Math.log10(Math.max(v, 1e-12)) : (v) => v;
  const a = f(low), b = f(high) === f(low) ? f(low) + 1 : f(high);
  const place = (v) => from + ((f(v) - a) / (b - a)) * (to - from);
  place.inverse = (p) => { const v = a + ((p - from) / (to - from)) * (b - a); return log ? Math.pow(10, v) : v; };
  place.ticks = (count) => (log ? logTicks(low, high, count) : linearTicks(low, high, count));
  return place;
}

// a range with some room, in which a value of the data that stands alone is in the middle
function roomy(values, log, fromZero) {
  const known = values.filter((v) => v !== null && isFinite(v) && (!log || v > 0));
  if (!known.length) return log ? [0.1, 10] : [0, 1];
  let low = known.reduce((a, b) => Math.min(a, b)), high = known.reduce((a, b) => Math.max(a, b));
  if (log) {
    const room = Math.max(Math.pow(high / low, 0.06), low === high ? 1.5 : 1.05);
    return [low / room, high * room];
  }
  if (fromZero) low = Math.min(low, 0);
  const room = (high - low || Math.abs(high) || 1) * 0.07;
  return [fromZero && low === 0 ? 0 : low - room, high + room];
}

function path(points) {
  let text = "", pen = "M";
  for (const [x, y] of points) {
    if (x === null || y === null || !isFinite(x) || !isFinite(y)) { pen = "M"; continue; }
    text += pen + x.toFixed(1) + " " + y.toFixed(1);
    pen = "L";
  }
  return text;
}

// axes below and to the left, with a pale grid
function axes(root, box, x, y, titles) {
  const g = svg("g", { class: "axes" }, root);
  for (const v of x.ticks(Math.max(2, Math.floor((box.right - box.left) / 80)))) {
    svg("line", { x1: x(v), x2: x(v), y1: box.top, y2: box.bottom }, g);
    svg("text", { x: x(v), y: box.bottom + 16, "text-anchor": "middle" }, g, tickText(v));
  }
  if (y) {
    for (const v of y.ticks(Math.max(2, Math.floor((box.bottom - box.top) / 36)))) {
      svg("line", { x1: box.left, x2: box.right, y1: y(v), y2: y(v) }, g);
      svg("text", { x: box.left - 6, y: y(v) + 4, "text-anchor": "end" }, g, tickText(v));
    }
  }
  if (titles.x) svg("text", { x: (box.left + box.right) / 2, y: box.bottom + 34, "text-anchor": "middle", class: "title" }, g, titles.x);
  if (titles.y) svg("text", { x: box.left - 44, y: box.top - 10, class: "title" }, g, titles.y);
}

const tip = element("div", { class: "tip", role: "status" });

function showTip(event, lines) {
  if (!tip.isConnected) document.body.appendChild(tip);
  tip.replaceChildren();
  lines.forEach((line, i) => element(i ? "div" : "strong", {}, tip, line));
  tip.style.display = "block";
  const left = Math.min(event.clientX + 14, window.innerWidth - tip.offsetWidth - 8);
  const above = event.clientY + 18 + tip.offsetHeight > window.innerHeight;
  tip.style.left = Math.max(4, left) + "px";
  tip.style.top = (above ? event.clientY - tip.offsetHeight - 12 : event.clientY + 18) + "px";
}

function hideTip() { tip.style.display = "none"; }

// the nearest of what lies within reach of the pointer: marks are {x, y, lines} in pixels
function hover(root, marks) {
  const ring = svg("circle", { r: 6, class: "ring" }, root);
  ring.style.display = "none";
  root.addEventListener("pointermove", (event) => {
    const place = root.getBoundingClientRect();
    const px = event.clientX - place.left, py = event.clientY - place.top;
    let best = null, reach = 30;
    for (const mark of marks) {
      const far = Math.hypot(mark.x - px, mark.y - py);
      if (far < reach) { reach = far; best = mark; }
    }
    ring.style.display = best ? "" : "none";
    if (!best) { hideTip(); return; }
    ring.setAttribute("cx", best.x);
    ring.setAttribute("cy", best.y);
    showTip(event, best.lines);
  });
  root.addEventListener("pointerleave", () => { ring.style.display = "none"; hideTip(); });
}

// of line k of n: those drawn first are broader, so that they show below those that lie on them
const thickness = (k, n) => 1.6 + 0.7 * Math.min(3, n - 1 - k);

const colour = (v) => "c" + (v % 7) + (v >= 7 ? " d" + (Math.floor(v / 7) % 3) : "");

// rows of dots over one axis: small ones of single logs, a bar for what is said of all; {rows, x: {title, log, ref}}
function drawDots(place, spec, names, hidden) {
  const rows = spec.rows.filter((row) => !hidden.has(row.v));
  const longest = 16 + 7.2 * rows.reduce((most, row) => Math.max(most, names[row.v].length), 4);
  const width = place.clientWidth, narrow = longest > 0.4 * width, step = narrow ? 42 : 30, height = step * rows.length + 56;
  const box = { left: narrow ? 8 : longest, right: width - 12, top: 8, bottom: height - 44 };
  const values = rows.flatMap((row) => [...row.dots.map((d) => d[0]), row.mark, row.low, row.high, ...(row.band || [])]);
  if (spec.x.ref !== undefined) values.push(spec.x.ref);
  const [low, high] = roomy(values, spec.x.log);
  const x = scale(low, high, box.left + 6, box.right, spec.x.log);
  const root = svg("svg", { width, height, role: "img", "aria-label": spec.x.title });
  axes(root, box, x, null, { x: spec.x.title });
  const marks = [];
  if (spec.x.ref !== undefined) svg("line", { x1: x(spec.x.ref), x2: x(spec.x.ref), y1: box.top, y2: box.bottom, class: "ref" }, root);
  rows.forEach((row, i) => {
    const y = box.top + (narrow ? 28 : 15) + step * i;
    const g = svg("g", { class: colour(row.v) + (row.grey ? " faint" : "") }, root);
    if (row.band) svg("rect", { x: x(row.band[0]), width: Math.max(1, x(row.band[1]) - x(row.band[0])), y: y - 9, height: 18, class: "band" }, root);
    if (narrow) svg("text", { x: box.left, y: y - 13, class: "label" }, root, names[row.v]);
    else svg("text", { x: box.left - 6, y: y + 4, "text-anchor": "end", class: "label" }, root, names[row.v]);
    for (const [value, label] of row.dots) {
      if (value === null || (spec.x.log && value <= 0)) continue;
      svg("circle", { cx: x(value), cy: y, r: 3.5, class: "dot" }, g);
      marks.push({ x: x(value), y, lines: [names[row.v], label, number(value) + spec.x.unit] });
    }
    if (row.low !== null && row.low !== undefined) svg("line", { x1: x(row.low), x2: x(row.high), y1: y, y2: y, class: "bar" }, g);
    if (row.mark !== null && row.mark !== undefined) {
      svg("line", { x1: x(row.mark), x2: x(row.mark), y1: y - 8, y2: y + 8, class: "mark" }, g);
      marks.push({ x: x(row.mark), y, lines: [names[row.v], spec.markTitle, number(row.mark) + spec.x.unit] });
    }
  });
  hover(root, marks);
  place.replaceChildren(root);
}

// lines over two axes; {series: [{v, name, points: [[x, y, low, high]]}], x: {title, log, unit}, y: {...}}
function drawLines(place, spec, names, hidden) {
  const series = spec.series.filter((s) => !hidden.has(s.v) && s.points.length);
  const width = place.clientWidth, height = spec.height || 280;
  const box = { left: 52, right: width - 14, top: 28, bottom: height - 44 };
  const all = series.flatMap((s) => s.points);
  const [xLow, xHigh] = spec.x.range || roomy(all.map((p) => p[0]), spec.x.log);
  const [yLow, yHigh] = spec.y.range || roomy(all.flatMap((p) => [p[1], p[2], p[3]].filter((v) => v !== undefined)), spec.y.log, true);
  const x = scale(xLow, xHigh, box.left, box.right, spec.x.log), y = scale(yLow, yHigh, box.bottom, box.top, spec.y.log);
  const root = svg("svg", { width, height, role: "img", "aria-label": `${spec.y.title} over ${spec.x.title}` });
  axes(root, box, x, y, { x: spec.x.title, y: spec.y.title });
  const marks = [];
  series.forEach((s, k) => {
    const g = svg("g", { class: colour(s.v), "stroke-width": thickness(k, series.length) }, root);
    const aside = spec.dots ? (k - (series.length - 1) / 2) * 4 : 0; // intervals of several must not hide each other
    svg("path", { d: path(s.points.map((p) => [x(p[0]) + aside, p[1] === null ? null : y(p[1])])), class: "line" }, g);
    for (const [px, py, low, high] of s.points) {
      if (py === null) continue;
      if (spec.dots) {
        if (low !== null && low !== undefined) svg("line", { x1: x(px) + aside, x2: x(px) + aside, y1: y(low), y2: y(high), class: "whisker" }, g);
        svg("circle", { cx: x(px) + aside, cy: y(py), r: 3.5, class: "point" }, g);
      }
      const bounds = low === null || low === undefined ? "" : ` (${number(low)} to ${number(high)})`;
      marks.push({ x: x(px) + aside, y: y(py), lines: [s.name || names[s.v], `${spec.x.title}: ${number(px)}`, `${spec.y.title}: ${number(py)}${bounds}`] });
    }
  });
  hover(root, marks);
  place.replaceChildren(root);
}
