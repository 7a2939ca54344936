// The page: loads what there is, follows what comes, and says when it is old.
import { get, listen } from "./api.js";
import * as card from "./card.js";
import { Charts, plan } from "./charts.js";
import { hear } from "./course_entry.js";
import * as courses from "./courses.js";
import { Data } from "./data.js";
import * as faceplate from "./faceplate.js";
import * as foresight from "./foresight.js";
import { clock, duration, element, say, zone } from "./format.js";
import * as log from "./log.js";
import * as ranges from "./ranges.js";
import { steer } from "./steering.js";
import { View } from "./view.js";
import * as weeks from "./weeks.js";

const $ = (id) => document.getElementById(id);
const SPANS = [["5 min", 300], ["1 h", 3600], ["8 h", 28800], ["1 d", 86400], ["7 d", 604800]];
const AGAIN_MS = 2000; // before what failed is tried again
const SETTLE_MS = 150; // after the last of several steps through time the journal is asked
const GAP = 5; // periods without a scan, as the server has it
const PATIENCE = 5; // seconds without news, beside three periods, after which what is seen is old

const data = new Data();
let about = null;
let state = null;
let heard = 0; // when a state was shown last
let describing = null; // the description that is on its way
let described = ""; // the controller whose description is complete
let again = 0; // the timer of a trend that failed and is asked for again
let broken = false;
let hidden = new Set(JSON.parse(localStorage.getItem("hidden") || "null") || []);

const now = () => (state && state.time && !broken && state.alive ? Math.max(state.time, data.time.at(-1) || 0) : Date.now() / 1000);
const view = new View(Number(localStorage.getItem("span")) || SPANS[0][1], now, (span) => Math.max(foresight.ahead(span), courses.ahead(span)));
const zoomed = (from, to) => look(() => view.look(from, to));
const live = () => look(() => view.follow());
const charts = new Charts($("charts"), { zoomed, back: live });

// Another time is shown: what is here of it at once, the rest when the journal has answered.
function look(act) {
  act();
  if (view.live) localStorage.setItem("span", String(view.span));
  $("follow").setAttribute("aria-pressed", String(view.live));
  $("follow").textContent = view.live ? "Live" : "Paused";
  $("to-live").hidden = view.live;
  for (const button of $("spans").children) button.setAttribute("aria-pressed", String(view.live && Number(button.dataset.span) === view.span));
  const [from, to] = view.bounds();
  const times = view.live ? `the last ${duration(view.span)}` : `${clock(from)} to ${clock(to)}`;
  say($("time-shown"), times);
  charts.forget();
  draw();
  clearTimeout(again);
  again = setTimeout(reload, SETTLE_MS);
}

const draw = () => charts.draw(...view.shown());

async function reload() {
  clearTimeout(again);
  const [from, to] = view.bounds();
  try {
    if (await data.load(from, to)) draw();
  } catch (error) {
    old(error.message);
    clearTimeout(again);
    again = setTimeout(reload, AGAIN_MS);
  }
}

function describe() {
  return (describing ??= describeAll()
    .catch((error) => old(error.message))
    .finally(() => (describing = null)));
}

async function describeAll() {
  const found = await get("/api/about");
  const stands = state || (await get("/api/state")); // the trend is asked for in the loop's time, not in this machine's
  about = found;
  data.longest = (GAP * about.period_s) / (about.speed || 1);
  $("title").textContent = about.title;
  faceplate.describe(about);
  foresight.describe(about);
  ranges.describe(about);
  courses.describe(about);
  card.describe(about);
  choice();
  build();
  show(state || stands);
  await log.load();
  described = about.card.sha256;
  await reload();
}

function build() {
  charts.build(plan(about).filter((chart) => !(hidden.has(chart.name) || (chart.optional && !hidden.has(`+${chart.name}`)))), data);
}

// The signals that are drawn; the law's own numbers only when they are asked for.
function choice() {
  $("shown").replaceChildren(
    ...plan(about).map((chart) => {
      const key = chart.optional ? `+${chart.name}` : chart.name;
      const box = element("input", { type: "checkbox", checked: chart.optional ? hidden.has(key) : !hidden.has(key) });
      box.addEventListener("change", () => {
        hidden[hidden.has(key) ? "delete" : "add"](key);
        localStorage.setItem("hidden", JSON.stringify([...hidden]));
        build();
        draw();
      });
      return element("label", {}, box, ` ${chart.name}${chart.optional ? " (law)" : ""}`);
    }),
  );
}

function show(found) {
  state = found;
  data.mode(found.time, found.mode);
  ranges.show(found);
  foresight.follow(found.mode);
  faceplate.show(found);
  hear(found);
  courses.show(found);
  card.show(found);
  fresh();
  foreseen();
}

// A prediction and the points of courses are asked for with each state, and drawn once they are here.
async function foreseen() {
  if (!about) return;
  const news = await Promise.all([foresight.refresh(), courses.refresh()]);
  if (!news.some(Boolean)) return;
  faceplate.foreseen();
  if (view.live) draw();
}

function onState(found) {
  show(found);
  if (described !== found.sha256) describe(); // another controller took over, or the last try failed
}

function onScans(rows) {
  if (!view.live) return;
  const thin = data.append(rows, now() - 1.1 * view.span);
  draw();
  if (thin) reload();
}

function old(words) {
  $("banner").hidden = false;
  say($("banner"), `▲ ${words}`);
  document.body.classList.add("old");
}

function fresh() {
  heard = Date.now();
  if (broken || (state && !state.alive)) return;
  document.body.classList.remove("old");
  const trouble = state && (state.journal ? `The journal cannot be written: ${state.journal}` : "");
  $("banner").hidden = !trouble;
  if (trouble) say($("banner"), `▲ ${trouble}`);
}

function watch() {
  $("clock").textContent = `${clock(Date.now() / 1000)} ${zone()}`;
  if (!state) {
    if (broken) old("The page's server gives no news: what you see is old.");
    return;
  }
  const patience = PATIENCE + (3 * about?.period_s || 0) / (about?.speed || 1);
  if (broken || (Date.now() - heard) / 1000 > patience) old(`No news since ${clock(heard / 1000)}: what you see is old.`);
  else if (!state.alive) old(`The loop does not scan; its last scan was at ${clock(state.time)}: what you see is old. ${state.connection || ""}`);
}

function buttons() {
  $("spans").replaceChildren(
    ...SPANS.map(([words, seconds]) =>
      element("button", { type: "button", "data-span": seconds, onclick: () => look(() => view.follow(seconds)) }, words),
    ),
  );
  const steps = { earlier: () => view.pan(-1), later: () => view.pan(1), wider: () => view.zoom(2), closer: () => view.zoom(0.5) };
  for (const [id, act] of Object.entries(steps)) $(id).addEventListener("click", () => look(act));
  $("follow").addEventListener("click", () => look(() => (view.live ? view.stop() : view.follow())));
  $("to-live").addEventListener("click", () => {
    live();
    $("charts").focus({ preventScroll: true }); // the button is gone
  });
  steer($("charts"), view, { changed: () => look(() => {}), read: (by) => say($("time-shown"), charts.step(by)) });
  $("scale").addEventListener("click", () => {
    charts.whole = !charts.whole;
    $("scale").setAttribute("aria-pressed", String(charts.whole));
    draw();
  });
  for (const menu of [$("choice"), $("help")]) {
    menu.addEventListener("keydown", (event) => {
      if (event.key !== "Escape" || !menu.open) return;
      menu.open = false;
      menu.querySelector("summary").focus();
    });
  }
  $("theme").addEventListener("click", () => theme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"));
  const system = matchMedia("(prefers-color-scheme: dark)");
  const given = () => theme(localStorage.getItem("theme") || (system.matches ? "dark" : "light"), false);
  system.addEventListener("change", given);
  given();
}

function theme(name, keep = true) {
  document.documentElement.dataset.theme = name;
  $("theme").textContent = name === "dark" ? "Light" : "Dark";
  $("theme").setAttribute("aria-label", `${$("theme").textContent} colours`);
  if (keep) localStorage.setItem("theme", name);
  if (about) {
    build();
    draw();
  }
}

buttons();
look(() => {});
watch();
weeks.watch();
setInterval(watch, 1000);
const lost = () => {
  broken = true;
  watch();
};
// Events of the meantime are asked for: the stream fills up scans, not events.
const found = () => {
  if (!broken) return;
  broken = false;
  described = "";
  reload();
};
describe();
listen({ state: onState, scans: onScans, log: log.add, reset: reload }, lost, found);
