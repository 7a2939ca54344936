// Numbers that operators change of a law that reads `operate`: ranges, limits, uses, ranks, resting values, costs; signal by signal.
import { ask } from "./dialog.js";
import * as foresight from "./foresight.js";
import { duration, element, figure, number, say, unit } from "./format.js";
import { whatIf } from "./what_if.js";

const NEAR = 1e-6; // of a signal's range: nearer to a limit is at it
const SOON = 0.5; // of the time for which a reading is bridged, after which somebody should look
let law = ""; // of which these are
let entries = new Map(); // name -> { entry, i }
let bridge_s = 0;
let period_s = 0;
let given = null; // the state that is shown
let signals = []; // those of which something is foreseen

// about: what the loop is.
export function describe(about) {
  entries = new Map((about.operate || []).map((entry, i) => [entry.name, { entry, i }]));
  [law, bridge_s, period_s] = [about.title, about.bridge_s || 0, about.period_s];
  signals = [...about.signals.mv, ...about.signals.pv];
}

export const steers = () => entries.size > 0;

// The value of an entry, as the loop has it now; undefined where the law has no such entry.
const value = (name) => (entries.has(name) ? given?.operate?.[entries.get(name).i] : undefined);
const of = (signal, what) => value(signal ? `${signal.name}.${what}` : what);

// [low, high] that operators have set of a signal, or null where the law has no such entries.
export function range(signal) {
  const [low, high] = [of(signal, "low"), of(signal, "high")];
  return low === undefined || high === undefined || low === null || high === null ? null : [low, high];
}

// ------------------------------------------------------------------------------------------------------ what is shown
const FACTS = {
  pv: [["range", "Range"], ["track", "Set point"], ["rank", "Priority"], ["cost", "Cost"], ["reading", "Reading"], ["expected", "Expected"]],
  mv: [["range", "Limits"], ["max_move", "Largest move"], ["rest", "Resting value"], ["cost", "Cost"], ["why", "Why"]],
  law: [["speed", "Speed"], ["caution", "Caution"], ["missing", "Why"]],
};
const LATER = ["reading", "expected", "why", "missing"]; // no entries, but news of the law; hidden while there are none
const PARTS = { range: "low", rest: "rest_use" }; // entries that a fact is made of, where its name is another one
const has = (signal, what) => LATER.includes(what) || of(signal, PARTS[what] || what) !== undefined;

// The part of a signal's block that belongs to operators; null where the law has none of it.
export function part(group, signal, state) {
  given = state;
  if (!steers() || (group !== "pv" && group !== "mv" && group !== "law")) return null;
  const facts = FACTS[group].filter(([what]) => has(signal, what));
  if (!facts.some(([what]) => !LATER.includes(what)) && of(signal, "use") === undefined) return null;
  const rows = facts.flatMap(([what, words]) => [element("dt", {}, words), element("dd", { "data-fact": what })]);
  return element(
    "div",
    { class: "operated", "data-operated": signal ? signal.name : "law" },
    element("p", { class: "stands", hidden: true }),
    element("dl", {}, ...rows),
  );
}

// Written at each state; only what is new is touched.
export function fill(part, group, signal, state, i) {
  given = state;
  const stands = standing(group, signal, i);
  const line = part.querySelector(".stands");
  line.hidden = !stands;
  line.dataset.level = stands?.level || "";
  say(line, stands ? `${{ alarm: "▲ ", watch: "◆ " }[stands.level] || ""}${stands.words}` : "");
  for (const cell of part.querySelectorAll("[data-fact]")) {
    const what = cell.dataset.fact;
    const words = fact(what, signal, i);
    cell.hidden = cell.previousSibling.hidden = LATER.includes(what) && !words;
    say(cell, words);
    cell.classList.toggle("moved", moved(signal, what));
  }
}

function fact(what, signal, i) {
  const shown = (v) => `${number(v, signal)} ${unit(signal)}`.trim();
  switch (what) {
    case "range": {
      const [low, high] = range(signal);
      return `${number(low, signal)} … ${shown(high)}`;
    }
    case "track":
      return of(signal, "track") ? `followed${heavier(signal)}` : "left alone within its range";
    case "rank":
      return figure(of(signal, "rank"));
    case "cost":
      return of(signal, "cost") ? `${figure(of(signal, "cost"))} ${costUnit(signal)}` : "none";
    case "max_move":
      return `${figure(of(signal, "max_move"))} ${unit(signal)} a ${period()}`;
    case "rest":
      return of(signal, "rest_use") ? shown(of(signal, "rest")) : "none";
    case "reading":
      return reading(i);
    case "expected":
      return foresight.expected(signal);
    case "why":
      return foresight.reasons(signal);
    case "missing":
      return foresight.why() && `not known: ${foresight.why()}`;
    default:
      return `× ${figure(of(null, what))}`;
  }
}

const period = () => `period (${duration(period_s)})`;

// A cost is the price of one unit over one period.
const costUnit = (signal) => `per ${unit(signal) || "unit"} and ${period()}`;

function heavier(signal) {
  const weight = of(signal, "weight");
  return weight === undefined || weight === 1 ? "" : `, × ${figure(weight)} its weight`;
}

function reading(i) {
  const gone = given.unread_s?.[i];
  if (gone === undefined || gone === null) return "–";
  return gone > 0 ? `predicted; last read ${duration(gone)} ago` : "new";
}

// Whether operators, or a file of settings, made it another one than the law's own.
function moved(signal, what) {
  if (LATER.includes(what)) return false;
  const names = { range: ["low", "high"], rest: ["rest_use"], track: ["track", "weight"] }[what] || [what];
  const known = names.map((n) => entries.get(signal ? `${signal.name}.${n}` : n)).filter(Boolean);
  return known.some(({ entry }) => value(entry.name) !== entry.default);
}

// All that keeps a signal from being controlled as usual; with a level only where somebody is needed.
function standing(group, signal, i) {
  if (group === "law") return null;
  const out = of(signal, "use") === 0;
  if (group === "mv") {
    if (given.local?.[signal.name]) return { level: "watch", words: `the plant has it: ${given.local[signal.name]}` };
    return out ? { words: byHand(signal, i) } : limited(signal, i);
  }
  const [shed, bridged] = [given.shed?.[signal.name], given.bridged?.[signal.name]];
  if (shed !== undefined) return { level: "alarm", words: `left out, not controlled: ${shed}` };
  if (bridged !== undefined) {
    const gone = given.unread_s?.[i] || 0;
    return { level: gone > SOON * bridge_s ? "watch" : "", words: `bridged by prediction: ${bridged}` };
  }
  const gone = outside(signal, given.pv?.[i]);
  if (out) return gone ? { level: "watch", words: `taken out, and ${gone.words}: nothing holds it` } : { words: "taken out: not controlled" };
  return gone;
}

// An MV that its operator has.
function byHand(signal, i) {
  const [goal, now] = [given.goal?.[i], given.mv?.[i]];
  if (goal === undefined || goal === null || now === null || now === undefined) return "by hand: it stays where it is";
  const shown = `${number(goal, signal)} ${unit(signal)}`.trim();
  return Math.abs(goal - now) > NEAR * (signal.high - signal.low) ? `by hand: on its way to ${shown}` : `by hand: it stays at ${shown}`;
}

// The signals that the law does not have, each with the reason.
export function leftOut(state, { pv, mv }) {
  given = state;
  const why = (group, { name }) => {
    if (given.shed?.[name]) return `left out: ${given.shed[name]}`;
    if (given.local?.[name]) return `the plant has it: ${given.local[name]}`;
    return value(`${name}.use`) === 0 ? { pv: "taken out: not controlled", mv: "by hand" }[group] : "";
  };
  const all = [...pv.map((s) => [s, why("pv", s)]), ...mv.map((s) => [s, why("mv", s)])];
  return all.filter(([, words]) => words).map(([s, words]) => ({ name: s.name, words }));
}

// A limit that operators set, and that the law would pass; the end of the MV itself is no one's choice.
function limited(signal, i) {
  const [ends, wanted] = [range(signal), given.law?.[i]];
  if (!ends || wanted === null || wanted === undefined || given.mode !== "AUTO") return null;
  const slack = NEAR * (signal.high - signal.low);
  if (ends[1] < signal.high && wanted >= ends[1] - slack) return { level: "watch", words: "held at its high limit" };
  if (ends[0] > signal.low && wanted <= ends[0] + slack) return { level: "watch", words: "held at its low limit" };
  return null;
}

function outside(signal, stands) {
  const ends = range(signal);
  if (!ends || stands === null || stands === undefined) return null;
  if (stands > ends[1]) return { level: "watch", words: "above its range" };
  return stands < ends[0] ? { level: "watch", words: "below its range" } : null;
}

// ------------------------------------------------------------------------------------------------- what is changed
const USE = [[1, "in use"], [0, "taken out"]];
const FIELDS = {
  pv: [
    ["use", "Use", USE],
    ["track", "Set point", [[1, "followed"], [0, "left alone within its range"]]],
    ["weight", "Weight of its set point, times what was designed"],
    ["low", "Range, low end"],
    ["high", "Range, high end"],
    ["rank", "Priority of its range (1 is kept first)"],
    ["cost", "Cost"],
  ],
  mv: [
    ["use", "Use", USE],
    ["low", "Low limit"],
    ["high", "High limit"],
    ["max_move", "Largest move"],
    ["rest_use", "Resting value", [[1, "goes there when nothing else decides"], [0, "none"]]],
    ["rest", "Resting value"],
    ["cost", "Cost"],
  ],
  law: [["speed", "Speed, times what was designed"], ["caution", "Caution, times what was designed"]],
};

// No `min` and `max`: the loop itself says what is wrong, in one line, beside the entry.
export function askChange(group, signal) {
  const fields = FIELDS[group]
    .map(([what, label, choices]) => ({ what, found: entries.get(signal ? `${signal.name}.${what}` : what), label, choices }))
    .filter(({ found }) => found && found.entry.low !== found.entry.high)
    .map(({ what, found: { entry }, label, choices }) => {
      const now = value(entry.name);
      const written = (v) => (["low", "high", "rest"].includes(entry.what) ? number(v, signal) : figure(v));
      const ends = what === "cost" ? "" : `${figure(entry.low)} … ${figure(entry.high)}`; // of a cost only ratios count
      const measure = { cost: () => costUnit(signal), max_move: () => `${unit(signal)} a ${period()}`.trim() }[what]?.() ?? entry.unit;
      const allowed = [`${label} ${measure && `[${measure}]`}`.trim(), ends].filter(Boolean).join(", ");
      return {
        name: entry.name,
        label: choices ? label : allowed,
        said: label,
        unit: choices ? "" : measure,
        now: choices ? choices.find(([v]) => v === now)?.[1] : written(now),
        value: choices ? now : Number(written(now)),
        choices,
      };
    });
  ask({
    title: `Change ${signal ? signal.name : law}`,
    words: "It counts from the next scan on.",
    fields,
    foresee,
    request: (values) => ({ do: "operate", value: values }),
  });
}

// -------------------------------------------------------------------------------------------- one MV by hand, and back
export function handButtons(group, signal) {
  const entry = signal && entries.get(`${signal.name}.use`)?.entry;
  if (group !== "mv" || !entry || entry.low === entry.high) return [];
  const made = (what, words, act) =>
    element("button", { type: "button", [`data-${what}`]: signal.name, "aria-label": `${words.replace("…", "")}: ${signal.name}…`, hidden: true, onclick: () => act(signal) }, words);
  return [made("by-hand", "By hand…", askByHand), made("back", "Back to the law…", askBack)];
}

export function fillHand(block, signal, state) {
  given = state;
  const [take, back] = [block.querySelector("[data-by-hand]"), block.querySelector("[data-back]")];
  if (!take) return;
  take.hidden = !["AUTO", "HOLD"].includes(state.mode) || Boolean(state.local?.[signal.name]); // in MANUAL all are by hand
  back.hidden = of(signal, "use") !== 0;
}

function askByHand(signal) {
  const i = signals.findIndex((s) => s.name === signal.name); // MVs stand first
  const stands = [given.goal, given.mv, given.applied].map((of) => of?.[i]).find((v) => v !== null && v !== undefined);
  const fastest = signal.max_move ? `by at most ${figure(signal.max_move)} ${unit(signal)} a ${period()}` : "with the next scan";
  const at = (v) => ({ [`${signal.name}.use`]: 1, [`${signal.name}.low`]: v, [`${signal.name}.high`]: v }); // as if the law had to
  ask({
    title: `${signal.name} by hand`,
    words: `The law leaves it to you, knows what it does, and goes on with the others. It goes there ${fastest}.`,
    fields: [{ name: signal.name, label: `${signal.name} [${unit(signal) || "–"}], ${number(signal.low, signal)} … ${number(signal.high, signal)}`, value: stands === undefined ? "" : Number(number(stands, signal)) }],
    foresee: (values) => foresee(at(values[signal.name])),
    request: (values) => ({ do: "by_hand", value: values }),
  });
}

function askBack(signal) {
  ask({
    title: `${signal.name} back to the law`,
    words: "The law goes on from where it stands, without a bump.",
    request: () => ({ do: "operate", value: { [`${signal.name}.use`]: 1 } }),
  });
}

// Courses of the signals after a change, where the law can be asked for it.
export const foresee = (changes) => whatIf({ changes }, signals, value);
export const foreseeCourse = (course) => whatIf({ course }, signals, value);
