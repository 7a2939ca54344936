// The page: loads plant and controllers, lets a person act on them, and shows what follows.
import * as ort from "onnxruntime-web";
import { Controller, Refused, within } from "loopwright/controller";
import { Faceplate } from "loopwright/faceplate";
import { field } from "loopwright/fields";
import { has, read } from "loopwright/files";
import { element, say, unit } from "loopwright/format";
import { Plant } from "loopwright/plant";
import { LANES, Simulation } from "loopwright/simulation";
import { Trends, duration, plan } from "loopwright/trends";

const $ = (id) => document.getElementById(id);
const WASM = "ort-wasm-simd-threaded.wasm";
const SPEEDS = [[1, "1 sample/s"], [2, "2 samples/s"], [5, "5 samples/s"], [10, "10 samples/s"], [20, "20 samples/s"], [50, "50 samples/s"], [Infinity, "as fast as it can"]];
const USUAL = 20; // samples a second
const SPANS = [[100, "100 samples"], [300, "300"], [1000, "1000"], [Infinity, "all"]]; // all: as many as are kept, see simulation.js
const FRAME_MS = 40; // of computing, after which the picture is drawn
const MOST_EVENTS = 200;

let simulation, trends, charts, faceplates;
let fields = []; // [field, the value that it shows]
let running = false;
let speed = USUAL;
let span = 300;
let shown = new Set(); // optional charts that were asked for
let moved = ""; // the parameters that have a chart

async function start() {
  ort.env.wasm.numThreads = 1; // more would need headers of the server, and gain nothing on graphs this small
  if (has(WASM)) ort.env.wasm.wasmBinary = (await read(WASM)).buffer;
  else ort.env.wasm.wasmPaths = { wasm: new URL(`../onnxruntime-web/${WASM}`, document.baseURI).href };
  const about = JSON.parse(new TextDecoder().decode(await read("case.json")));
  const create = (bytes) => ort.InferenceSession.create(bytes, { executionProviders: ["wasm"], graphOptimizationLevel: "all", executionMode: "sequential", intraOpNumThreads: 1, interOpNumThreads: 1, logSeverityLevel: 4 });
  const plant = await Plant.load(ort, create, read, about);
  const controllers = {};
  // Browsers compute digests for https, localhost and files; elsewhere the file is taken as it is.
  const load = crypto.subtle ? Controller.load : Controller.undigested;
  for (const c of about.controllers)
    controllers[c.name] = await load(ort, await read(c.file), c, "wasm").catch((error) => {
      throw error instanceof Refused ? new Error(`${c.file}: ${error.message}: it was changed after the page was written`) : error;
    });
  simulation = new Simulation(about, plant, controllers);
  simulation.heard = event;
  await simulation.reset();
  build(about);
  window.playground = { simulation, steps }; // for tests and for who is curious
  $("main").inert = false;
  document.body.dataset.ready = "yes";
}

// ------------------------------------------------------------------ what a person acts on
function build(about) {
  document.title = `${about.title} · Loopwright playground`;
  $("title").textContent = about.title;
  $("speed").replaceChildren(...SPEEDS.map(([rate, words]) => element("option", { value: rate }, words)));
  $("speed").value = String(speed);
  $("speed").addEventListener("change", () => (speed = Number($("speed").value)));
  $("test").replaceChildren(...about.tests.map((test, i) => element("option", { value: i }, test.title)));
  $("test").addEventListener("change", () => reset(about.tests[$("test").value]));
  $("go").addEventListener("click", () => run(!running));
  $("step").addEventListener("click", () => steps(1));
  $("reset").addEventListener("click", () => reset());
  addEventListener("keydown", keys);

  hand($("setpoints"), about.sp.map((s, i) => ({
    name: `SP ${s.name}`, signal: s, of: () => simulation.sp[i],
    set: (value) => simulation.setSp(simulation.sp.map((v, j) => (j === i ? value : v))),
  })));
  hand($("disturbances"), about.dv.map((s, i) => ({
    name: `DV ${s.name}`, signal: s, of: () => simulation.dv[i],
    set: (value) => (simulation.dv = within(simulation.dv.map((v, j) => (j === i ? value : v)), about.dv, "measured disturbance")),
  })));
  const parameters = about.parameters.map((p, i) => ({ p, i })).sort((a, b) => b.p.tested - a.p.tested);
  const unmeasured = ({ p, i }) => ({
    name: `p ${p.name}`, signal: p, strict: false, nominal: p.value, of: () => simulation.p[i],
    set: (value) => {
      if (!Number.isFinite(value)) throw new Error(`${p.name} is no finite number; its own value is ${p.value} ${unit(p)}`.trim());
      simulation.p = simulation.p.map((v, j) => (j === i ? value : v));
    },
  });
  const tested = parameters.filter(({ p }) => p.tested);
  const others = parameters.filter(({ p }) => !p.tested);
  $("disturbances").append(element("p", { class: "hint" }, about.dv.length ? "Parameters of the plant, which no controller sees:" : "Parameters of the plant. No controller sees them."));
  hand($("disturbances"), tested.map(unmeasured));
  const rest = element("details", {}, element("summary", {}, tested.length ? `${others.length} others` : `${others.length} parameters`));
  hand(rest, others.map(unmeasured));
  if (others.length) $("disturbances").append(rest);

  hand($("faults"), [{
    name: "noise", signal: { name: "Noise", unit: "× usual", low: 0, high: 3 }, of: () => simulation.noise,
    set: (value) => {
      if (!(value >= 0 && Number.isFinite(value))) throw new Error(`the noise is ${value} times the usual; give 0 or more`);
      simulation.noise = value;
    },
    strict: false,
  }]);
  $("faults").append(element("p", { class: "hint" }, `Usual noise: ${about.pv.map((s, i) => `${s.name} ${about.noise_std[i]} ${unit(s)}`.trim()).join(", ")} (standard deviation).`));
  $("faults").append(...about.pv.map((s, i) => tick(`broken ${s.name}`, `The sensor of ${s.name} gives no value`, () => simulation.broken, i)));
  $("faults").append(...about.mv.map((s, i) => tick(`stuck ${s.name}`, `The valve of ${s.name} is stuck`, () => simulation.stuck, i)));

  faceplates = LANES.map((lane) => new Faceplate(document.querySelector(`.faceplate[data-lane=${lane}]`), lane, simulation, {
    changed: (who, words) => { event(who, words); refresh(); rechart(); },
    said: event,
  }));
  $("spans").replaceChildren(...SPANS.map(([samples, words]) => element("button", { type: "button", "data-span": samples, "aria-pressed": String(samples === span), onclick: () => look(samples) }, words)));
  $("scale").addEventListener("click", () => {
    trends.whole = !trends.whole;
    $("scale").setAttribute("aria-pressed", String(trends.whole));
    trends.draw(span);
  });
  trends = new Trends($("charts"), simulation);
  $("charts").addEventListener("dblclick", () => trends.draw(span));
  document.addEventListener("theme", () => { trends.build(charts); trends.draw(span); });
  rechart();
  refresh();
}

// Fields of what is set by hand; each change is written down.
function hand(box, rows) {
  for (const { name, signal, of, set, strict = true, nominal = null } of rows) {
    const back = nominal === null ? null : element("button", { type: "button", class: "back", hidden: true, "data-back": name, title: `back to ${nominal} ${unit(signal)}` }, "↺");
    const made = field({
      name, signal, strict, value: of(),
      apply: (value) => {
        const before = of();
        set(value);
        if (value !== before) later(name, `${signal.name} = ${+value.toPrecision(6)} ${unit(signal)}`.trim());
        rechart();
      },
      tag: (value) => {
        if (!back) return;
        back.hidden = value === nominal;
        back.parentElement?.classList.toggle("moved", value !== nominal);
      },
    });
    if (back) {
      back.setAttribute("aria-label", `${signal.name} back to ${nominal}`);
      back.addEventListener("click", () => {
        set(nominal);
        made.fresh(nominal);
        later(name, `${signal.name} = ${nominal} ${unit(signal)}`.trim());
      });
      made.node.append(back);
    }
    fields.push([made, of]);
    box.append(made.node);
  }
}

function tick(name, words, of, i) {
  const box = element("input", { type: "checkbox", "data-tick": name });
  box.addEventListener("change", () => {
    of()[i] = box.checked;
    event("you", `${words}${box.checked ? "" : ": no longer"}`);
  });
  fields.push([{ show: () => (box.checked = of()[i]), fresh: () => (box.checked = of()[i]) }, () => null]);
  return element("label", { class: "tick" }, box, ` ${words}`);
}

// A slider that is drawn writes one line, not a hundred.
const waiting = new Map();
function later(name, words) {
  clearTimeout(waiting.get(name));
  const k = simulation.k;
  waiting.set(name, setTimeout(() => event("you", words, false, k), 400));
}

// ------------------------------------------------------------------ time
async function run(go) {
  running = go;
  $("go").setAttribute("aria-pressed", String(go));
  say($("go"), go ? "Pause" : "Run");
  let next = performance.now();
  while (running) {
    const began = performance.now();
    if (!Number.isFinite(speed) || next < began - 1000) next = began; // what this machine is too slow for is not made up for
    while (running && performance.now() - began < FRAME_MS && next <= performance.now()) {
      await simulation.step();
      next += 1000 / speed;
      if (simulation.stopped) return run(false);
    }
    refresh();
    await new Promise(requestAnimationFrame);
  }
  refresh();
}

async function steps(n) {
  run(false);
  for (let i = 0; i < n; i++) await simulation.step();
  refresh();
}

async function reset(test) {
  run(false);
  await simulation.reset(test);
  $("events").replaceChildren();
  for (const [made, of] of fields) made.fresh(of());
  for (const faceplate of faceplates) faceplate.fresh();
  rechart();
  refresh();
}

function keys(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input, select")) return;
  if (event.key === " " && event.target.closest("button, summary")) return; // the browser presses it
  const act = { " ": () => run(!running), ArrowRight: () => steps(1), r: () => reset(), R: () => reset() }[event.key];
  if (!act) return;
  event.preventDefault();
  act();
}

// ------------------------------------------------------------------ what is shown
function refresh() {
  say($("clock"), `${duration(simulation.k * simulation.about.period_s)}, sample ${simulation.k}`);
  for (const [made, of] of fields) made.show(of());
  for (const faceplate of faceplates) faceplate.show();
  $("step").disabled = running || Boolean(simulation.stopped);
  $("go").disabled = Boolean(simulation.stopped);
  $("banner").hidden = !simulation.stopped;
  say($("banner"), simulation.stopped ? `▲ ${simulation.stopped}` : "");
  rechart();
  trends.draw(span);
}

// The charts: a parameter has one from the moment that it is moved, the law's own numbers once they are asked for.
function rechart() {
  const { about } = simulation;
  const infos = [...new Set(simulation.chosen.flatMap((name) => simulation.controllers[name].manifest.info))];
  const all = plan(about, infos, simulation.asked);
  for (const [i, p] of about.parameters.entries()) if (simulation.p[i] !== p.value) shown.add(`parameter ${p.name}`);
  const wanted = all.filter((c) => !c.optional || shown.has(`${c.optional} ${c.name}`));
  const key = wanted.map((c) => `${c.optional ?? ""} ${c.name}`).join() + infos.join() + simulation.asked;
  if (key === moved) return;
  moved = key;
  charts = wanted;
  trends.build(charts);
  trends.draw(span);
  $("shown").replaceChildren(...all.filter((c) => c.optional).map((c) => {
    const name = `${c.optional} ${c.name}`;
    const box = element("input", { type: "checkbox", checked: shown.has(name) });
    box.addEventListener("change", () => {
      shown[box.checked ? "add" : "delete"](name);
      rechart();
    });
    return element("label", {}, box, ` ${c.name} (${c.optional})`);
  }));
}

function look(samples) {
  span = samples;
  for (const button of $("spans").children) button.setAttribute("aria-pressed", String(Number(button.dataset.span) === span));
  trends.draw(span);
}

function event(who, words, quiet = false, k = simulation.k) {
  const list = $("events");
  const row = element("li", { class: quiet ? "quiet" : "", "data-k": k }, element("time", {}, duration(k * simulation.about.period_s)), element("span", { class: "who" }, who), element("span", { class: "what" }, words));
  list.insertBefore(row, [...list.children].find((other) => Number(other.dataset.k) <= k) ?? null); // the newest first
  while (list.children.length > MOST_EVENTS) list.lastChild.remove();
}

start().catch((error) => {
  $("banner").hidden = false;
  say($("banner"), `▲ ${error.message}`);
  say($("clock"), "");
  document.body.dataset.ready = "no";
});
