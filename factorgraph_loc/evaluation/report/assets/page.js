"use strict";
// What is on the page besides its text: legends that hide and show, charts, and choices.

const page = JSON.parse(document.getElementById("page").textContent);
const names = page.variants;
const hidden = new Set(names.map((_, v) => v).filter((v) => v >= page.shown));
const draws = []; // all that must be drawn again when a legend or the width changes

function legend(place) {
  names.forEach((name, v) => {
    const button = element("button", { type: "button", class: "chip", "data-v": v }, place);
    element("i", { class: "key " + colour(v) }, button);
    element("span", {}, button, name);
    button.addEventListener("click", () => {
      if (hidden.has(v)) hidden.delete(v); else hidden.add(v);
      drawAll();
    });
  });
}

function drawAll() {
  for (const chip of document.querySelectorAll(".chip")) chip.setAttribute("aria-pressed", !hidden.has(+chip.dataset.v));
  for (const draw of draws) draw();
}

function distributions(section) {
  const controls = section.querySelector(".controls");
  const select = element("select", { "aria-label": "log" }, controls);
  ["all logs", ...page.logs].forEach((log, i) => element("option", { value: i - 1 }, select, log));
  const draw = () => {
    for (const place of section.querySelectorAll("[data-kind]")) {
      const found = page.errors[place.dataset.kind];
      const logs = +select.value < 0 ? common(found) : [found[+select.value]];
      const series = names.map((_, v) => ({ v, points: ecdf(logs, v) }));
      const visible = series.filter((s) => !hidden.has(s.v)).flatMap((s) => s.points);
      const low = visible.filter((p) => p[1] >= 4).map((p) => p[0]).reduce((a, b) => Math.min(a, b), Infinity);
      const high = visible.map((p) => p[0]).reduce((a, b) => Math.max(a, b), 0);
      const range = isFinite(low) && high > 0 ? [low, Math.max(high, low * 2)] : [0.01, 1];
      const y = { title: "share of times below [%]", range: [0, 100] };
      const inside = series.map((s) => ({ v: s.v, points: s.points.filter((p) => p[0] >= range[0]) }));
      drawLines(place, { series: inside, x: { title: "position error [m]", log: true, range }, y, height: 300 }, names, hidden);
    }
  };
  select.addEventListener("change", draw);
  draws.push(draw);
}

// the logs of which every estimator that is shown, and has any errors at all, has some: others would not be compared fairly
function common(found) {
  const shown = names.map((_, v) => v).filter((v) => !hidden.has(v) && found.some((of) => of[v].length));
  return found.filter((of) => shown.every((v) => of[v].length));
}

// share of times [%] at which the error lies below; of several logs each counts the same
function ecdf(logs, v) {
  const lists = logs.map((of) => of[v]).filter((list) => list.length);
  if (!lists.length) return [];
  const all = lists.flat().sort((a, b) => a - b);
  const step = Math.max(1, Math.floor(all.length / 150));
  return all.map((e, i) => [Math.max(e, 1e-6), (100 * i) / (all.length - 1)]).filter((_, i) => i % step === 0 || i === all.length - 1);
}

function choice(controls, options, onChoose) {
  const select = element("select", { "aria-label": "metric" }, controls);
  options.forEach((option, i) => element("option", { value: i }, select, option));
  select.addEventListener("change", () => onChoose(+select.value));
  onChoose(0);
}

for (const place of document.querySelectorAll(".legend")) legend(place);
for (const place of document.querySelectorAll("[data-chart]")) {
  const spec = page.charts[place.dataset.chart];
  const draw = spec.rows ? drawDots : drawLines;
  draws.push(() => draw(place, spec, names, spec.all ? new Set() : hidden));
}
const byLog = document.getElementById("by-log");
if (byLog) {
  const tables = [...byLog.querySelectorAll("[data-metric]")];
  choice(byLog.querySelector(".controls"), tables.map((t) => t.dataset.metric), (i) => tables.forEach((t, k) => { t.hidden = k !== i; }));
}
const trajectories = document.getElementById("trajectories");
if (trajectories) {
  const tracks = new Tracks(trajectories, page.drawn, names, hidden);
  draws.push(() => tracks.draw());
}
const spread = document.getElementById("distributions");
if (spread) distributions(spread);
const configs = document.getElementById("configs");
if (configs) {
  const texts = JSON.parse(document.getElementById("config-texts").textContent);
  const show = configs.querySelector("pre");
  choice(configs.querySelector(".controls"), texts.map((one) => one.run), (i) => { show.textContent = texts[i].text; });
}
drawAll();
let width = window.innerWidth;
window.addEventListener("resize", () => {
  if (window.innerWidth !== width) { width = window.innerWidth; drawAll(); } // a phone's bars come and go: no other width
});
document.documentElement.dataset.ready = "yes";
